"""Measure simulated sweeps against recorded ones that were left out, and from beside the path against true ones.

python tools/bench.py resim samples/crossing out/scenario.json
python tools/bench.py resim samples/scenes/bare.toml --sideways 0.5 1 2 3
python tools/bench.py resim samples/crossing out/scenario.json --picture out/sweeps.jpg --without bus-1
"""

from __future__ import annotations

import resource
import time
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from entry import parser_of
from scipy.spatial import cKDTree

from log2sim.datatypes import Log, Scenario
from log2sim.geometry import Array, apply, inverse
from log2sim.localization.choice import localize_like
from log2sim.logs.opening import open_log
from log2sim.resim.rays import Shots, all_shots, angles_of, poses_of, recorded_shots
from log2sim.resim.simulate import Simulation
from log2sim.resim.world import build_world
from log2sim.synth import load_scene, synthesize

EVERY = 5
LIMIT_M = 40.0
Figures = dict[str, float]


def compare(shots: Shots, points: Array, rows: Array) -> Figures:
    """Compare returns of rays; `points` (P, 3) simulated, in the sensor's frame, of the rays `rows` (P,)."""
    simulated = np.full(len(shots.t_ns), np.nan)
    simulated[rows] = np.linalg.norm(points, axis=1)
    came, comes = np.isfinite(shots.range_m), np.isfinite(simulated)
    near = came & comes & (shots.range_m < LIMIT_M)
    error = np.abs(simulated - shots.range_m)[near]
    true = (shots.direction * shots.range_m[:, None])[came & (shots.range_m < LIMIT_M)]
    return {
        "median m": float(np.median(error)),
        "90 % m": float(np.quantile(error, 0.9)),
        "return right": float((came == comes).mean()),
        **chamfer(true, points[np.linalg.norm(points, axis=1) < LIMIT_M]),
    }


def chamfer(true: Array, found: Array) -> Figures:
    """Return the mean distance of either cloud's points to the other, m."""
    return {"Chamfer m": float((cKDTree(true).query(found)[0].mean() + cKDTree(found).query(true)[0].mean()) / 2)}


def moved_sweep(log: Log, name: str, source: int, target: int) -> Array:
    """Return the points of one sweep where the sensor sees them at the stamp of another: the baseline."""
    t_ns = log.streams[name].t_ns
    shots = recorded_shots(log, name, log.streams[name].read(source))
    poses, moment, _ = poses_of(log, name, shots.t_ns)
    points = (
        np.einsum("nij,nj->ni", poses[moment, :3, :3], shots.direction * shots.range_m[:, None]) + poses[moment, :3, 3]
    )
    return apply(inverse(log.map_T_sensor(name, t_ns[target : target + 1])[0][0]), points)


def held_out(log: Log, scenario: Scenario, name: str) -> list[tuple[str, Figures]]:
    begin = time.process_time()
    world = build_world(log, scenario, [name], leave_out=lambda _, i: i % EVERY == EVERY // 2)
    count = len(log.streams[name].t_ns)
    build_s = (time.process_time() - begin) / count
    simulation, simulated, moved, cast_s = Simulation(log, world, scenario), [], [], []
    for i in range(EVERY // 2, count, EVERY):
        shots = simulation.shots(name, i)
        begin = time.process_time()
        sweep, rows = simulation.cast(name, shots, log, 0, np.random.default_rng(i))
        cast_s.append(time.process_time() - begin)
        simulated.append(compare(shots, sweep.xyz_m, rows))
        true = shots.direction * shots.range_m[:, None]
        true = true[shots.range_m < LIMIT_M]
        baseline = moved_sweep(log, name, i - 1, i)
        moved.append(chamfer(true, baseline[np.linalg.norm(baseline, axis=1) < LIMIT_M]))
    speed = {"build s/sweep": build_s, "sweeps/s": 1 / float(np.mean(cast_s)), "surfels": float(len(world.background))}
    return [("held out", {**mean(simulated), **speed}), ("nearest sweep, moved", mean(moved))]


def picture(log: Log, scenario: Scenario, name: str, index: int, without: str, path: Path) -> None:
    """Draw ranges of a recorded sweep, of the same simulated, and of the same without an agent."""
    world = build_world(log, scenario, [name], leave_out=lambda _, i: i == index)
    rest = replace(scenario, agents=tuple(a for a in scenario.agents if a.id != without))
    figure, axes = plt.subplots(3, 1, figsize=(11, 5.4), sharex=True, layout="constrained")
    titles = ("recorded", "simulated from the other sweeps", f"simulated without {without}")
    shots = Simulation(log, world, scenario).shots(name, index)
    azimuth, elevation = (np.degrees(a) for a in angles_of(shots.direction))
    for axis, title, what in zip(axes, titles, (None, scenario, rest), strict=True):
        rows, distance = np.arange(len(azimuth)), shots.range_m
        if what is not None:
            simulation = Simulation(log, world, what)
            sweep, rows = simulation.cast(name, shots, log, 0, np.random.default_rng(0))
            distance = np.linalg.norm(sweep.xyz_m, axis=1)
        axis.scatter(-azimuth[rows], elevation[rows], s=2.5, c=distance, cmap="turbo", vmin=3, vmax=40, linewidths=0)
        axis.set(title=title, ylabel="elevation, deg", facecolor="black")
    axes[-1].set(xlabel="azimuth, deg, to the right")
    figure.savefig(path, dpi=90)


def sideways(scene_path: Path, meters: list[float], every: int) -> list[tuple[str, Figures]]:
    """Cast from beside the sensor that recorded, and compare with the true sweep from there."""
    scene = load_scene(scene_path).model_copy(update={"camera": ()})
    log, truth = synthesize(scene, observe=False)
    name = scene.lidar[0].name
    world = build_world(log, truth, [name])
    out = []
    for off_m in meters:
        spec = scene.lidar[0]
        place = (spec.position_m[0], spec.position_m[1] + off_m, spec.position_m[2])
        lidars = (spec.model_copy(update={"position_m": place}), *scene.lidar[1:])
        true_log = synthesize(scene.model_copy(update={"lidar": lidars}), observe=False)[0].changed(ego=log.ego)
        simulation, figures = Simulation(log, world, truth), []
        for i in range(0, len(log.streams[name].t_ns), every):
            shots = all_shots(
                recorded_shots(true_log, name, true_log.streams[name].read(i)), world.models[name].pattern
            )
            sweep, rows = simulation.cast(name, shots, true_log, 0, np.random.default_rng(i))
            figures.append(compare(shots, sweep.xyz_m, rows))
        out.append((f"{off_m:g} m sideways", mean(figures)))
    return out


def mean(figures: list[Figures]) -> Figures:
    return {key: float(np.mean([f[key] for f in figures])) for key in figures[0]}


def main(argv: list[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("log", type=Path, help="a log, or a scene file for --sideways")
    parser.add_argument("scenario", type=Path, nargs="?", help="what was reconstructed from it")
    parser.add_argument("--lidar", help="by default the first of the log")
    parser.add_argument("--sideways", type=float, nargs="+", default=[0.0, 0.5, 1.0, 2.0, 3.0], metavar="M")
    parser.add_argument("--picture", type=Path, help="draw a sweep instead")
    parser.add_argument("--sweep", type=int, default=22, help="of --picture")
    parser.add_argument("--without", default="", metavar="AGENT", help="agent that --picture leaves out")
    parser.add_argument("--every", type=int, default=7, help="sweeps of a scene that are compared")
    given = parser.parse_args(argv)
    if given.scenario is None:
        rows = sideways(given.log, given.sideways, given.every)
    else:
        scenario = Scenario.load(given.scenario)
        log = localize_like(open_log(given.log), scenario.provenance)
        name = given.lidar or next(iter(log.lidars))
        if given.picture is not None:
            picture(log, scenario, name, given.sweep, given.without, given.picture)
            return 0
        rows = held_out(log, scenario, name)
    for label, figures in rows:
        print(f"{label:22s}", ", ".join(f"{key} {value:.3f}" for key, value in figures.items()))
    print(f"at most {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB")
    return 0
