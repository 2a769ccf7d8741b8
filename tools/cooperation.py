"""Vehicle and road together: the three tests of Chen, "Intelligent Perception System for Vehicle-Road Cooperation", in random variants.

python tools/cooperation.py --test blind_area --variants 50 --seed 0 --json blind_area.json --plot plots

Tests: range (A), blind_area (B), overlap (C), ap (random traffic, AP BEV .5), registration (pose and clock of the pole).
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from cooperation_worlds import (
    blind_area_measures,
    hidden_traffic,
    overlap_measures,
    range_measures,
    registration_measures,
    tables,
)
from cooperation_worlds.draw_blind_area import draw_blind_area
from cooperation_worlds.draw_overlap import draw_overlap
from cooperation_worlds.draw_range import draw_range
from cooperation_worlds.perturb import RoadError, disturb, draw_error
from cooperation_worlds.runs import WAYS, Found, detect, perceive
from cooperation_worlds.world import World, log_of

from log2sim.datatypes import Log

DRAW = {"range": draw_range, "blind_area": draw_blind_area, "overlap": draw_overlap}
TESTS = (*DRAW, "ap", "registration")


@dataclass(frozen=True)
class Choices:
    """What to run.

    Attributes
    ----------
    ways : tuple of str
        The ends alone and the levels of fusion.
    noise : float
        Share of 0.5 m, 2 degrees and 0.3 s by which the road's end is off at most.
    delayed : bool
        Whether the clock of the road's end is off, too.
    register : bool
        Whether the road's end is registered.
    plots : Path or None
    """

    ways: tuple[str, ...]
    noise: float
    delayed: bool
    register: bool
    plots: Path | None

    def disturbed(self, log: Log, seed: int) -> tuple[Log, RoadError]:
        """Put an error on the road's end."""
        error = draw_error(seed, self.noise, delayed=self.delayed) if self.noise else RoadError()
        return (disturb(log, error) if self.noise else log), error


def main(arguments: Sequence[str] | None = None) -> None:
    """Run tests and print their tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--test", action="append", choices=TESTS, help="May be given several times; all without.")
    parser.add_argument("--variants", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0, help="Variants are drawn from this seed and those that follow.")
    parser.add_argument("--ways", default=",".join(WAYS), help="Ends alone and levels of fusion, by commas.")
    parser.add_argument("--noise", type=float, default=0.0, metavar="SHARE", help="Of 0.5 m, 2 degrees and 0.3 s.")
    parser.add_argument("--no-delay", action="store_true", help="Noise in the pose alone.")
    parser.add_argument("--no-register", action="store_true", help="Take the road's pose and clock as they are.")
    parser.add_argument("--plot", type=Path, metavar="DIR", help="Draw the first ten variants of each test from above.")
    parser.add_argument("--json", type=Path, metavar="FILE")
    chosen = parser.parse_args(arguments)
    choices = Choices(
        tuple(chosen.ways.split(",")), chosen.noise, not chosen.no_delay, not chosen.no_register, chosen.plot
    )
    if choices.plots is not None:
        choices.plots.mkdir(parents=True, exist_ok=True)
    out = {}
    for test in chosen.test or TESTS:
        seeds = range(chosen.seed, chosen.seed + chosen.variants)
        out[test] = RUN[test](choices, seeds)
        print("\n" + tables.TABLE[test](out[test]) + "\n", flush=True)
    if chosen.json is not None:
        chosen.json.write_text(json.dumps(out, indent=1) + "\n")


def perceived(test: str, choices: Choices, seeds: Sequence[int]) -> Any:
    """Yield each world with what every way finds in it."""
    for count, seed in enumerate(seeds, start=1):
        world = DRAW[test](seed)
        log, _ = log_of(world)
        log, error = choices.disturbed(log, seed)
        found = {way: perceive(log, way, register=choices.register) for way in choices.ways}
        _draw(world, log, found, choices, count)
        print(f"\r{test}: {count}/{len(seeds)}", end="", file=sys.stderr, flush=True)
        yield world, log, error, found


def _draw(world: World, log: Log, found: dict[str, Found], choices: Choices, count: int) -> None:
    if choices.plots is not None and count <= 10:
        from cooperation_worlds.plots import plot_world

        times = {"range": (0.5, 2.5), "blind_area": (1.0, 4.2), "overlap": (1.0,)}[world.test]
        plot_world(world, log, found, choices.plots / f"{world.test}_{world.seed}.png", times)


def run_range(choices: Choices, seeds: Sequence[int]) -> dict[str, Any]:
    """Test A."""
    rows: dict[str, list[Any]] = {way: [] for way in choices.ways}
    for world, _, _, found in perceived("range", choices, seeds):
        for way, result in found.items():
            rows[way].append(range_measures.perceived(world, result))
    return {way: range_measures.figures(of_way) for way, of_way in rows.items()}


def run_blind_area(choices: Choices, seeds: Sequence[int]) -> dict[str, Any]:
    """Test B."""
    rows = [blind_area_measures.row(world, found) for world, _, _, found in perceived("blind_area", choices, seeds)]
    seen = [
        {"seed": s, **{w: {"before": r[w]["before_contact_s"], "hit": r[w]["collides"]} for w in r}}
        for s, r in zip(seeds, rows)
    ]
    return {"ways": blind_area_measures.figures(rows), "stopping_m": blind_area_measures.STOPPING_M, "variants": seen}


def run_overlap(choices: Choices, seeds: Sequence[int]) -> dict[str, Any]:
    """Test C, box by box and as a scenario."""
    scenarios, boxes = [], []
    for world, log, _, found in perceived("overlap", choices, seeds):
        scenarios.append({way: overlap_measures.of_scenario(world, result) for way, result in found.items()})
        sweeps = {way: detect(log, way, register=choices.register) for way in choices.ways if way != "tracks"}
        boxes.append({way: overlap_measures.of_boxes(world, *s) for way, s in sweeps.items()})
    return {"scenario": overlap_measures.figures(scenarios), "boxes": overlap_measures.figures(boxes)}


def run_ap(choices: Choices, seeds: Sequence[int]) -> dict[str, Any]:
    """AP in random traffic, of all road users that both ends together have points of."""
    ways = [way for way in choices.ways if way != "tracks"]
    pairs: dict[tuple[str, str], list[Any]] = {(way, kind): [] for way in ways for kind in hidden_traffic.KINDS}
    counted, hidden = 0, 0
    for count, seed in enumerate(seeds, start=1):
        view = hidden_traffic.seen(hidden_traffic.draw_hidden_traffic(seed))
        log, _ = choices.disturbed(view.log, seed)
        for way in ways:
            for stamp, boxes in zip(*detect(log, way, register=choices.register, min_score=0.02)):
                for kind in hidden_traffic.KINDS:
                    truth, unseen = hidden_traffic.truth_at(view, int(stamp), kind)
                    pairs[way, kind].append((hidden_traffic.found_at(view, int(stamp), boxes, kind), truth))
                    if way == "vehicle" and kind == "vehicle":
                        counted += int((~truth.ignored).sum())
                        hidden += int((unseen & ~truth.ignored).sum())
        print(f"\rap: {count}/{len(seeds)}", end="", file=sys.stderr, flush=True)
    ap = {
        kind: {way: hidden_traffic.average_precisions(pairs[way, kind]) for way in ways}
        for kind in hidden_traffic.KINDS
    }
    return {"ap": ap, "vehicles": counted, "hidden_from_vehicle": hidden / max(counted, 1)}


def run_registration(choices: Choices, seeds: Sequence[int]) -> dict[str, Any]:
    """Errors of the pole's pose and clock before and after registration, in worlds of all three tests."""
    rows = []
    for count, seed in enumerate(seeds, start=1):
        world = list(DRAW.values())[count % len(DRAW)](seed)
        log, _ = log_of(world)
        error = draw_error(seed, choices.noise or 1.0, delayed=choices.delayed)
        rows.append({"test": world.test, "seed": seed, **registration_measures.row(log, error)})
        print(f"\rregistration: {count}/{len(seeds)}", end="", file=sys.stderr, flush=True)
    return {"rows": rows, **registration_measures.figures(rows)}


RUN: dict[str, Callable[[Choices, Sequence[int]], dict[str, Any]]] = {
    "range": run_range,
    "blind_area": run_blind_area,
    "overlap": run_overlap,
    "ap": run_ap,
    "registration": run_registration,
}

if __name__ == "__main__":
    np.seterr(all="raise", under="ignore")
    main()
