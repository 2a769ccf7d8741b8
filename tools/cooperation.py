"""Vehicle and road together: the three tests of Chen, "Intelligent Perception System for Vehicle-Road Cooperation", in random variants.

    python tools/cooperation.py blind_area --variants 50 --seed 0

Tests: range (A), blind_area (B), overlap (C), ap (random traffic, AP BEV .5). Variants are drawn
from the seed and those that follow. --ways are ends alone and levels of fusion, by commas; --noise is the share of 0.5 m, 2 degrees and 0.3 s by
which the road's end is off at most, --no-delay puts none into its clock; --no-register takes its pose and clock as they are; --every N uses
one sweep in N.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from cooperation_worlds import blind_area, curve, hidden_traffic, overlap
from cooperation_worlds.runs import ALONE, TABLE, WAYS, detect, perceive, prepared
from cooperation_worlds.world import disturb, log_of
from entry import run

from log2sim.datatypes import Log

DRAW = {
    "range": curve.draw_range, "blind_area": blind_area.draw_blind_area, "overlap": overlap.draw_overlap,
    "ap": lambda seed: hidden_traffic.seen(hidden_traffic.draw_hidden_traffic(seed)),
}  # fmt: skip


def main(test: str, variants: int = 50, seed: int = 0, ways: str = ",".join(WAYS), noise: float = 0.0, delay: bool = True,
         register: bool = True, every: int = 1) -> None:  # fmt: skip
    """Run a test and print its table."""
    worlds: list[Any] = []
    rows: dict[str, list[Any]] = {way: [] for way in ways.split(",")}
    for k in range(seed, seed + variants):
        world = DRAW[test](k)
        if test != "ap":
            world = replace(world, every=every)
        log = world.log if test == "ap" else log_of(world)[0]
        log = disturb(log, k, noise, delayed=delay) if noise else log
        # The sweeps of random traffic are too few to register.
        both = prepared(log, register=register) if test != "ap" and set(rows) - set(ALONE) else log
        for way, of_way in rows.items():
            of_way += measure(test, world, log if way in ALONE else both, way)
        worlds.append(world)
    print(TABLE[test](figures(test, worlds, rows)))


def measure(test: str, world: Any, log: Log, way: str) -> list[Any]:
    """What one way of perceiving makes of a variant."""
    if test == "ap":  # of all road users that both ends together have points of
        return hidden_traffic.sweeps(world, *detect(log, way, min_score=hidden_traffic.MIN_SCORE))
    found = perceive(log, way, world.scene.start_ns)
    if test == "range":
        return [curve.perceived(world, found)]
    if test == "blind_area":
        return [blind_area.row(world, found)]
    return [{"scenario": overlap.of_scenario(world, found), "boxes": overlap.from_boxes(world, *detect(log, way))}]


def figures(test: str, worlds: list[Any], rows: dict[str, list[Any]]) -> dict[str, Any]:
    """The figures of a test, by way; those of the overlap box by box and as a scenario."""
    if test == "ap":
        return hidden_traffic.figures(rows)
    if test == "range":
        return {way: curve.figures(of_way) for way, of_way in rows.items()}
    if test == "blind_area":
        return blind_area.figures(worlds, rows)
    by_variant = [dict(zip(rows, of_variant)) for of_variant in zip(*rows.values())]
    return {of: overlap.figures([{w: r[of] for w, r in v.items()} for v in by_variant]) for of in ("boxes", "scenario")}


if __name__ == "__main__":
    run(main, __doc__)
