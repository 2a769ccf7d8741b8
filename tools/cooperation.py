"""Vehicle and road together: the three tests of Chen, "Intelligent Perception System for Vehicle-Road Cooperation", in random variants.

    python tools/cooperation.py blind_area --variants 50 --seed 0

Tests: range (A), blind_area (B), overlap (C), ap (random traffic, AP BEV .5). Variants are drawn
from the seed and those that follow. --ways are ends alone and levels of fusion, by commas; --noise is the share of 0.5 m, 2 degrees and 0.3 s by
which the road's end is off at most, --no-delay puts none into its clock; --no-register takes its pose and clock as they are; --every N uses
one sweep in N.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from cooperation_worlds import blind_area, curve, hidden_traffic, overlap
from cooperation_worlds.runs import (
    ALONE,
    TABLE,
    WAYS,
    Found,
    detect,
    perceive,
    prepared,
)
from cooperation_worlds.world import World, disturb, draw_error, log_of
from entry import run

from log2sim.datatypes import Log

DRAW = {"range": curve.draw_range, "blind_area": blind_area.draw_blind_area, "overlap": overlap.draw_overlap}


@dataclass(frozen=True)
class Choices:
    """What to run."""

    seeds: range
    ways: tuple[str, ...]
    noise: float
    delayed: bool
    register: bool
    every: int

    def disturbed(self, log: Log, seed: int) -> Log:
        """Put an error on the road's end."""
        return disturb(log, draw_error(seed, self.noise, delayed=self.delayed)) if self.noise else log


def main(test: str, variants: int = 50, seed: int = 0, ways: str = ",".join(WAYS), noise: float = 0.0, delay: bool = True,
         register: bool = True, every: int = 1) -> None:  # fmt: skip
    """Run a test and print its table."""
    choices = Choices(range(seed, seed + variants), tuple(ways.split(",")), noise, delay, register, every)
    print(TABLE[test](RUN[test](choices)))


def measured(
    test: str, choices: Choices, measure: Callable[[World, Log, str, Found], Any]
) -> Iterator[tuple[World, dict[str, Any]]]:
    """Yield each world with a row for every way, in the order of the seeds."""
    for seed in choices.seeds:
        world = replace(DRAW[test](seed), every=choices.every)
        log = choices.disturbed(log_of(world)[0], seed)
        both = prepared(log, register=choices.register) if set(choices.ways) - set(ALONE) else log
        logs = {way: log if way in ALONE else both for way in choices.ways}
        yield world, {way: measure(world, of, way, perceive(of, way, world.scene.start_ns)) for way, of in logs.items()}


def run_range(choices: Choices) -> dict[str, Any]:
    """Test A."""
    rows = [r for _, r in measured("range", choices, lambda world, _, __, found: curve.perceived(world, found))]
    return {way: curve.figures([r[way] for r in rows]) for way in choices.ways}


def run_blind_area(choices: Choices) -> dict[str, Any]:
    """Test B."""
    results = list(measured("blind_area", choices, lambda world, _, __, found: blind_area.row(world, found)))
    rows = {way: [r[way] for _, r in results] for way in choices.ways}
    return blind_area.figures([world for world, _ in results], rows)


def run_overlap(choices: Choices) -> dict[str, Any]:
    """Test C, box by box and as a scenario."""

    def measure(world: World, log: Log, way: str, found: Found) -> dict[str, Any]:
        return {"scenario": overlap.of_scenario(world, found), "boxes": overlap.from_boxes(world, *detect(log, way))}

    rows = [r for _, r in measured("overlap", choices, measure)]
    return {
        of: overlap.figures([{way: r[way][of] for way in choices.ways} for r in rows]) for of in ("boxes", "scenario")
    }


def run_ap(choices: Choices) -> dict[str, Any]:
    """AP in random traffic, of all road users that both ends together have points of; too short to register."""
    rows: dict[str, list[Any]] = {way: [] for way in choices.ways}
    for seed in choices.seeds:
        view = hidden_traffic.seen(hidden_traffic.draw_hidden_traffic(seed))
        log = choices.disturbed(view.log, seed)
        for way, of_way in rows.items():
            of_way += hidden_traffic.sweeps(view, *detect(log, way, min_score=hidden_traffic.MIN_SCORE))
    return hidden_traffic.figures(rows)


RUN: dict[str, Callable[[Choices], dict[str, Any]]] = {
    "range": run_range, "blind_area": run_blind_area, "overlap": run_overlap, "ap": run_ap,
}  # fmt: skip

if __name__ == "__main__":
    run(main, __doc__)
