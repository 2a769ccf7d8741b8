"""Measure how well roadside units are registered: random worlds, errors of poses and delays of stamps, by kind of world.

python tools/bench.py registration --seeds 10
"""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass

import numpy as np
from entry import parser_of

from benchmarks.registration_worlds import World, WorldSpec, disturbed, draw_world, errors_of
from log2sim.config import Config
from log2sim.datatypes import Log
from log2sim.localization.roadside import RoadRegistration, register_road
from log2sim.plan import choose_detector, select_sensors

TARGET_M, TARGET_DEG, TARGET_S = 0.1, 0.3, 0.02
RATES_HZ = (10.0, 5.0, 2.0, 20.0)


@dataclass(frozen=True)
class Outcome:
    """One registration of one disturbed log."""

    world: str
    noise: tuple[float, float]
    delay_s: float
    error: tuple[float, float, float]
    kinds: tuple[str, ...]
    verified: bool
    moving: int
    took_s: float
    seen_through: float


def register(log: Log) -> tuple[RoadRegistration, float]:
    config = choose_detector(log, Config())
    start = time.perf_counter()
    found = register_road(log, config, select_sensors(log, config), progress=lambda *_: None)
    return found, time.perf_counter() - start


def measure(world: World, noise: tuple[float, float], delay_s: float) -> list[Outcome]:
    """Disturb every pole of a world in its own way and register them."""
    log = world.log
    for k, pole in enumerate(world.poles):
        rng = np.random.default_rng([world.spec.seed, k, round(100 * noise[0]), round(100 * noise[1])])
        log = disturbed(log, pole, *noise, delay_s, rng)
    found, took_s = register(log)
    outcomes = []
    for pole, figures in zip(world.poles, found.figures):
        objects = figures["objects"]["after"]
        kinds = tuple(fault.kind for fault in found.faults if fault.sensor == pole)
        outcomes.append(
            Outcome(
                f"{world.spec.kind} {world.spec.road_lidar}", noise, delay_s, errors_of(found.log, world.log, pole),
                kinds, figures["verified"], 0 if objects is None else objects["moving"], took_s / len(world.poles),
                figures["seen_through"]["before"] or 0.0,
            )
        )  # fmt: skip
    return outcomes


def row(name: str, outcomes: list[Outcome]) -> str:
    """Put a row of the table together."""
    away, turned, late = np.abs([o.error for o in outcomes]).T
    seen = np.array([o.moving > 0 for o in outcomes])
    wrong = sum("wrong_road_pose" in o.kinds for o in outcomes)
    unknown = sum("unknown_road_pose" in o.kinds for o in outcomes)
    told = sum("road_pose" in o.kinds or "road_clock" in o.kinds for o in outcomes)
    late_ms = late[seen] * 1e3 if seen.any() else np.array([np.nan])
    cells = [
        name, f"{len(outcomes)}", f"{np.median(away):.3f}", f"{np.quantile(away, 0.9):.2f}", f"{np.median(turned):.2f}",
        f"{np.quantile(turned, 0.9):.2f}", f"{np.mean((away <= TARGET_M) & (turned <= TARGET_DEG)):.2f}",
        f"{np.median(late_ms):.0f}", f"{np.quantile(late_ms, 0.9):.0f}", f"{np.mean(late_ms <= TARGET_S * 1e3):.2f}",
        f"{told}", f"{unknown}", f"{wrong}", f"{np.median([o.took_s for o in outcomes]):.1f}",
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def main(arguments: list[str] | None = None) -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--worlds", nargs="+", default=["street", "open"], choices=["street", "open"])
    parser.add_argument("--lidars", nargs="+", default=["tilted16", "level32", "level64"])
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first", type=int, default=100, help="first seed")
    parser.add_argument("--noise", nargs="+", default=["0/0", "0.25/1", "0.5/2"], help="m/degrees")
    parser.add_argument("--delays-ms", nargs="+", type=float, default=[0.0, 100.0, 300.0])
    parser.add_argument("--poles", type=int, default=1)
    parser.add_argument("--verbose", action="store_true")
    asked = parser.parse_args(arguments)
    noises = [tuple(float(v) for v in text.split("/")) for text in asked.noise]
    outcomes: list[Outcome] = []
    for kind, lidar, k in itertools.product(asked.worlds, asked.lidars, range(asked.seeds)):
        rates = RATES_HZ[k % 4], RATES_HZ[(k + k // 4 + 1) % 4]
        spec = WorldSpec(kind, asked.first + k, lidar, asked.poles, *rates)
        world = draw_world(spec)
        for noise, delay_ms in itertools.product(noises, asked.delays_ms):
            found = measure(world, noise, delay_ms / 1e3)  # type: ignore[arg-type]
            outcomes += found
            if asked.verbose:
                for o in found:
                    print(
                        spec.seed,
                        o.world,
                        rates,
                        noise,
                        delay_ms,
                        *(f"{v:.3f}" for v in o.error),
                        o.kinds,
                        o.moving,
                        flush=True,
                    )
    print("| world | registrations | error m | 90 % | degrees | 90 % | within 0.1 m, 0.3 deg | clock ms | 90 % | within 20 ms "
          "| corrected | unverified | left out | s |")  # fmt: skip
    print("|" + "---|" * 14)
    for noise, delay_ms in itertools.product(noises, asked.delays_ms):
        part = [o for o in outcomes if o.noise == noise and o.delay_s == delay_ms / 1e3]
        print(row(f"**{noise[0]:g} m, {noise[1]:g} degrees, {delay_ms:g} ms**", part))
        for world_name in dict.fromkeys(o.world for o in part):
            print(row(world_name, [o for o in part if o.world == world_name]))
