"""Vehicle and road together: the three tests of Chen, "Intelligent Perception System for Vehicle-Road Cooperation", in random variants.

python tools/cooperation.py --test blind_area --variants 50 --seed 0 --json blind_area.json

Tests: range (A), blind_area (B), overlap (C), ap (random traffic, AP BEV .5), registration (pose and clock of the pole).
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from cooperation_worlds import blind_area, curve, hidden_traffic, overlap
from cooperation_worlds.runs import (
    ALONE,
    TABLE,
    WAYS,
    Found,
    Rows,
    detect,
    perceive,
    prepared,
    registration_figures,
    registration_row,
)
from cooperation_worlds.world import RoadError, World, disturb, draw_error, log_of
from entry import parser_of

from log2sim.datatypes import Log

DRAW = {"range": curve.draw_range, "blind_area": blind_area.draw_blind_area, "overlap": overlap.draw_overlap}
TESTS = (*DRAW, "ap", "registration")


@dataclass(frozen=True)
class Choices:
    """What to run; `noise` is the share of 0.5 m, 2 degrees and 0.3 s by which the road's end is off at most."""

    ways: tuple[str, ...]
    noise: float
    delayed: bool
    register: bool
    every: int
    rows: Rows

    def key(self, test: str, seed: int, way: str) -> tuple[Any, ...]:
        """Name a row."""
        return (test, seed, way, self.noise, self.delayed, self.register, self.every)

    def disturbed(self, log: Log, seed: int) -> tuple[Log, RoadError]:
        """Put an error on the road's end."""
        error = draw_error(seed, self.noise, delayed=self.delayed) if self.noise else RoadError()
        return (disturb(log, error) if self.noise else log), error


def main(arguments: Sequence[str] | None = None) -> None:
    """Run tests and print their tables."""
    parser = parser_of(__doc__)
    parser.add_argument("--test", action="append", choices=TESTS, help="May be given several times; all without.")
    parser.add_argument("--variants", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0, help="Variants are drawn from this seed and those that follow.")
    parser.add_argument("--ways", default=",".join(WAYS), help="Ends alone and levels of fusion, by commas.")
    parser.add_argument("--noise", type=float, default=0.0, metavar="SHARE", help="Of 0.5 m, 2 degrees and 0.3 s.")
    parser.add_argument("--no-delay", action="store_true", help="Noise in the pose alone.")
    parser.add_argument("--no-register", action="store_true", help="Take the road's pose and clock as they are.")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="Use one in N sweeps, which saves time.")
    parser.add_argument("--json", type=Path, metavar="FILE", help="Write the figures.")
    parser.add_argument(
        "--rows", type=Path, metavar="FILE", help="Keep rows here, and go on from those that are there."
    )
    a = parser.parse_args(arguments)
    choices = Choices(tuple(a.ways.split(",")), a.noise, not a.no_delay, not a.no_register, a.every, Rows(a.rows))
    out = {}
    for test in a.test or TESTS:
        out[test] = RUN[test](choices, range(a.seed, a.seed + a.variants))
        print("\n" + TABLE[test](out[test]) + "\n", flush=True)
    if a.json is not None:
        a.json.write_text(json.dumps(out, indent=1) + "\n")


def measured(
    test: str, choices: Choices, seeds: Sequence[int], measure: Callable[[World, Log, str, Found], Any]
) -> Iterator[tuple[World, dict[str, Any]]]:
    """Yield each world with a row for every way, in the order of the seeds."""
    for count, seed in enumerate(seeds, start=1):
        world = replace(DRAW[test](seed), every=choices.every)
        missing = [way for way in choices.ways if choices.key(test, seed, way) not in choices.rows]
        if missing:
            log, _ = choices.disturbed(log_of(world)[0], seed)
            both = prepared(log, register=choices.register) if set(missing) - set(ALONE) else log
            for way in missing:
                used = log if way in ALONE else both
                found = perceive(used, way, world.scene.start_ns)
                choices.rows[choices.key(test, seed, way)] = measure(world, used, way, found)
        say(test, count, len(seeds))
        yield world, {way: choices.rows[choices.key(test, seed, way)] for way in choices.ways}


def say(test: str, done: int, total: int) -> None:
    """Show how far a test is."""
    print(f"\r{test}: {done}/{total}", end="" if done < total else "\n", file=sys.stderr, flush=True)


def run_range(choices: Choices, seeds: Sequence[int]) -> dict[str, Any]:
    """Test A."""
    rows = [r for _, r in measured("range", choices, seeds, lambda w, _, __, f: curve.perceived(w, f).tolist())]
    return {way: curve.figures([np.array(r[way]) for r in rows]) for way in choices.ways}


def run_blind_area(choices: Choices, seeds: Sequence[int]) -> dict[str, Any]:
    """Test B."""
    results = list(measured("blind_area", choices, seeds, lambda w, _, __, f: blind_area.row(w, f)))
    rows = {way: [r[way] for _, r in results] for way in choices.ways}
    return blind_area.figures([world for world, _ in results], rows)


def run_overlap(choices: Choices, seeds: Sequence[int]) -> dict[str, Any]:
    """Test C, box by box and as a scenario."""

    def measure(world: World, log: Log, way: str, found: Found) -> dict[str, Any]:
        row = {"scenario": overlap.of_scenario(world, found).tolist()}
        # Tracks join after detection: their boxes are those of each end.
        return row if way == "tracks" else {**row, "boxes": overlap.from_boxes(world, *detect(log, way)).tolist()}

    rows = [r for _, r in measured("overlap", choices, seeds, measure)]
    return {
        of: overlap.figures([{way: r[way][of] for way in choices.ways if of in r[way]} for r in rows])
        for of in ("boxes", "scenario")
    }


def run_ap(choices: Choices, seeds: Sequence[int]) -> dict[str, Any]:
    """AP in random traffic, of all road users that both ends together have points of; too short to register."""
    ways = [way for way in choices.ways if way != "tracks"]
    for count, seed in enumerate(seeds, start=1):
        missing = [way for way in ways if choices.key("ap", seed, way) not in choices.rows]
        if missing:
            view = hidden_traffic.seen(hidden_traffic.draw_hidden_traffic(seed))
            log, _ = choices.disturbed(view.log, seed)
            for way in missing:
                found = detect(log, way, min_score=hidden_traffic.MIN_SCORE)
                choices.rows[choices.key("ap", seed, way)] = hidden_traffic.row(view, *found)
        say("ap", count, len(seeds))
    rows = {way: [choices.rows[choices.key("ap", seed, way)] for seed in seeds] for way in ways}
    return hidden_traffic.figures(rows)


def run_registration(choices: Choices, seeds: Sequence[int]) -> dict[str, Any]:
    """Errors of the pole's pose and clock before and after registration, in worlds of all three tests by turns."""
    for count, seed in enumerate(seeds, start=1):
        key = choices.key("registration", seed, "")
        if key not in choices.rows:
            world = replace(list(DRAW.values())[seed % len(DRAW)](seed), every=choices.every)
            error = draw_error(seed, choices.noise or 1.0, delayed=choices.delayed)
            row = registration_row(log_of(world)[0], error)
            choices.rows[key] = {"test": world.test, "seed": seed, **row}
        say("registration", count, len(seeds))
    rows = [choices.rows[choices.key("registration", seed, "")] for seed in seeds]
    return {"rows": rows, **registration_figures(rows)}


RUN: dict[str, Callable[[Choices, Sequence[int]], dict[str, Any]]] = {
    "range": run_range,
    "blind_area": run_blind_area,
    "overlap": run_overlap,
    "ap": run_ap,
    "registration": run_registration,
}

if __name__ == "__main__":
    main()
