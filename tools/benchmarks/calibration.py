"""Print how well time offset and yaw of a LiDAR are found in the sample and its sister scenes, and what is told of sound ones.

    python tools/bench.py calibration --seeds 10 --only crossing

Sweeps are cast and compared once for each scene; each seed draws new errors of GNSS and IMU, as large as those of the scene.
Columns: share of seeds in which an offset, a yaw, anything else is told; RMSE, mean sigma and NEES (1 where sigma is right) of both estimates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from entry import SAMPLES

from log2sim.config import CalibrationConfig
from log2sim.geometry import NS_PER_S, inverse
from log2sim.localization.clocks import OFFSET, YAW, Findings, fit_clock_and_mount
from log2sim.localization.surfaces import SweepPairs, exp_of, pair_sweeps
from log2sim.synth.scene import Scene, load_scene
from log2sim.synth.synthesis import synthesize

SCENES = {"crossing": SAMPLES / "crossing.toml"} | {f.stem: f for f in sorted((SAMPLES / "scenes").glob("*.toml"))}
WITHOUT_ERRORS = {"position_sigma_m": 0.0, "angle_sigma_deg": 0.0}


@dataclass(frozen=True)
class Injected:
    """What is wrong: stamps late by `offset_s`, and a mount yawed by `yaw_deg`."""

    name: str
    offset_s: float = 0.0
    yaw_deg: float = 0.0


CASES = (
    Injected("sound"), Injected("20 ms late", 0.02), Injected("50 ms early", -0.05), Injected("100 ms late", 0.1),
    Injected("yaw 0.2 deg", yaw_deg=0.2), Injected("yaw 1 deg", yaw_deg=1.0), Injected("yaw 3 deg", yaw_deg=3.0),
)  # fmt: skip


def injected(seen: SweepPairs, case: Injected) -> SweepPairs:
    """What the sweeps show with a fault: their motions are turned with the mount, their stamps are late."""
    turn = exp_of(np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.radians(case.yaw_deg)]))
    turn[:3, 3] = seen.sensor_m - turn[:3, :3] @ seen.sensor_m
    found = [replace(p.found, first_T_second=turn @ p.found.first_T_second @ inverse(turn)) for p in seen.pairs]
    pairs = tuple(replace(pair, found=f) for pair, f in zip(seen.pairs, found))
    return replace(seen, pairs=pairs, t_ns=seen.t_ns + round(case.offset_s * NS_PER_S))


def rows_of(scene: Scene, seeds: int) -> list[str]:
    """A line for each case; none for a scene without a LiDAR on the ego."""
    exact = scene.model_copy(update={"gnss": scene.gnss.model_copy(update=WITHOUT_ERRORS)})
    log, _ = synthesize(exact, seed=1, observe=False)
    lidar = next((name for name, lidar in log.lidars.items() if lidar.mount == "ego"), None)
    seen = None if lidar is None else pair_sweeps(log, lidar, None, lambda *_: None)
    if seen is None or lidar is None:
        return []
    tracks = [synthesize(scene, seed=seed, observe=False)[0].ego for seed in range(1, seeds + 1)]
    lines = []
    for case in CASES:
        figures = []
        for track in tracks:
            assert track is not None
            wrong = injected(replace(seen, track=track), case)
            found = fit_clock_and_mount(wrong)
            findings = Findings(lidar, found, wrong, CalibrationConfig())
            *tilt, turn = findings.turn_rad
            told = (findings.offset_s != 0, turn != 0, any((*tilt, *findings.shift_m)))
            late, yaw = found.values[OFFSET] + case.offset_s, found.values[YAW] + np.radians(case.yaw_deg)
            sigma = found.sigma[[OFFSET, YAW]]
            nees = (late / sigma[0]) ** 2, (yaw / sigma[1]) ** 2
            figures.append([*told, late, yaw, *sigma, *nees, found.shows_offset])
        lines.append(line(case.name, np.array(figures, dtype=np.float64)))
    return lines


def line(name: str, figures: np.ndarray) -> str:
    """A row of the table from the figures (S, 10) of all seeds."""
    offset, yaw, other = figures[:, :3].mean(axis=0)
    shown = figures[figures[:, 9] > 0]
    rmse = np.sqrt((figures[:, 4] ** 2).mean())
    yaw_words = f"{np.degrees(rmse):6.2f} {np.degrees(figures[:, 6].mean()):6.2f} {figures[:, 8].mean():5.1f}"
    offset_words = f"{'not shown':>19}"
    if len(shown):
        rmse_ms, sigma_ms = 1e3 * np.sqrt((shown[:, 3] ** 2).mean()), 1e3 * shown[:, 5].mean()
        offset_words = f"{rmse_ms:6.0f} {sigma_ms:6.0f} {shown[:, 7].mean():5.1f}"
    return f"{name:12} {offset:6.2f} {yaw:5.2f} {other:5.2f}   {offset_words}   {yaw_words}"


def main(seeds: int = 30, only: str = "") -> None:
    """Print a row for each scene and fault; `only`: a scene."""
    print(f"{'':12} told: offset yaw else   offset RMSE sigma NEES, ms   yaw RMSE sigma NEES, degrees")
    for name in [only] if only else SCENES:
        for row in rows_of(load_scene(SCENES[name]), seeds):
            print(f"{name:10} {row}", flush=True)
