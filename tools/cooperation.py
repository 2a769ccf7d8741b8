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
from cooperation_worlds.runs import ALONE, NAMES, prepared
from cooperation_worlds.world import disturb, log_of
from entry import run

# Each draws a variant, says what one way of perceiving makes of it, and makes a table of what all ways make of all variants.
TESTS: dict[str, Any] = {"range": curve, "blind_area": blind_area, "overlap": overlap, "ap": hidden_traffic}


def main(test: str, variants: int = 50, seed: int = 0, ways: str = ",".join(NAMES), noise: float = 0.0, delay: bool = True,
         register: bool = True, every: int = 1) -> None:  # fmt: skip
    worlds: list[Any] = []
    rows: dict[str, list[Any]] = {way: [] for way in ways.split(",")}
    for k in range(seed, seed + variants):
        world = TESTS[test].draw(k)
        if test != "ap":
            world = replace(world, every=every)
        log = world.log if test == "ap" else log_of(world)[0]
        log = disturb(log, k, noise, delayed=delay) if noise else log
        # The sweeps of random traffic are too few to register.
        both = prepared(log, register=register) if test != "ap" and set(rows) - set(ALONE) else log
        for way, of_way in rows.items():
            of_way += TESTS[test].measured(world, log if way in ALONE else both, way)
        worlds.append(world)
    print(TESTS[test].table(worlds, rows))


if __name__ == "__main__":
    run(main, __doc__)
