"""Measure simulated sweeps and pictures against recorded ones that were left out, and from beside the path against true ones.

python tools/bench.py resim samples/crossing out/scenario.json
python tools/bench.py resim samples/crossing out/scenario.json --figures pictures --camera front
python tools/bench.py resim samples/scenes/bare.toml --figures sweeps --turned 5
python tools/bench.py resim samples/crossing.toml --figures pictures --sideways -1 --sideways -3
python tools/bench.py resim samples/crossing out/scenario.json --circle out/edited.json
python tools/bench.py resim samples/crossing out/scenario.json --picture out/sweeps.jpg --without bus-1
"""

from __future__ import annotations

import resource
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from log2sim.config import Config, LidarConfig
from log2sim.datatypes import Agent, Boxes3D, Frame, Log, Scenario, Sweep
from log2sim.evaluation.detection.boxes import DetectedBoxes
from log2sim.evaluation.detection.evaluation import DetectionOptions, evaluate_boxes
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.evaluation.metrics.truth import count_points
from log2sim.geometry import Array, apply, box_iou, inverse, rectangle_iou
from log2sim.localization.choice import localize_like
from log2sim.logs.opening import open_log
from log2sim.perception.detect.detectors import create_detector
from log2sim.perception.detect3d.detectors import open_shipped
from log2sim.perception.first_pass import cloud_origin
from log2sim.perception.lidar.cloud import assemble_cloud
from log2sim.pipeline import reconstruct
from log2sim.resim.cameras import Pictures
from log2sim.resim.rays import Shots, all_shots, poses_of, recorded_shots
from log2sim.resim.simulate import Simulation, simulated_log
from log2sim.resim.surfels import Surfels, Tiles
from log2sim.resim.world import World, build_world
from log2sim.scenarios.tagging import find_tags
from log2sim.synth import load_scene, synthesize
from log2sim.visualization.sensor_film import range_image, title_line, window_of

EVERY = 5
LIMIT_M = 40.0
NEAR_M = 0.1  # scale of the density-aware Chamfer distance: three times the error of range that is wanted
GROUND_STEP_M, GROUND_REACH_M = 0.7, 50.0  # of the baseline's flat ground, around the path
FIGURES, SIDEWAYS_M = ("sweeps", "boxes", "pictures"), (0.0, 0.5, 1.0, 2.0, 3.0)
SWEEP, EVERY_SIDEWAYS = 22, 7  # that is drawn; of a scene so many sweeps are compared
Figures = dict[str, float]


def compare(shots: Shots, sweep: Sweep, rows: Array) -> Figures:
    """Compare returns of rays; `sweep` has one point, in the sensor's frame, for each of the rays `rows` (P,).

    Intensity is compared where both rays return: the median error as a share of the mean.
    """
    simulated, strength = np.full((2, len(shots.t_ns)), np.nan)
    simulated[rows] = np.linalg.norm(sweep.xyz_m, axis=1)
    came, comes = np.isfinite(shots.range_m), np.isfinite(simulated)
    near = came & comes & (shots.range_m < LIMIT_M)
    error = np.abs(simulated - shots.range_m)[near]
    true = (shots.direction * shots.range_m[:, None])[came & (shots.range_m < LIMIT_M)]
    figures = {
        "median m": float(np.median(error)), "90 % m": float(np.quantile(error, 0.9)),
        "return right": float((came == comes).mean()),
    }  # fmt: skip
    if sweep.intensity is not None and np.isfinite(shots.intensity[near]).any():
        strength[rows] = sweep.intensity
        off = np.nanmedian(np.abs(strength - shots.intensity)[near])
        figures["intensity"] = float(off / np.nanmean(shots.intensity[near]))
    return figures | chamfer(true, sweep.xyz_m[simulated[rows] < LIMIT_M])


def chamfer(true: Array, found: Array) -> Figures:
    """Return the mean distance of either cloud's points to the other, m, and the density-aware one (Wu et al., NeurIPS 2021), 0 to 1.

    In the latter a point counts exp(-distance / 0.1 m), shared by all whose nearest point is the same.
    """
    means, aware = [], []
    for a, b in ((true, found), (found, true)):
        distance, nearest = cKDTree(b).query(a)
        sharing = np.bincount(nearest, minlength=len(b))[nearest]
        means.append(distance.mean())
        aware.append((1 - np.exp(-distance / NEAR_M) / sharing).mean())
    return {"Chamfer m": float(np.mean(means)), "density-aware": float(np.mean(aware))}


def moved_sweep(log: Log, name: str, source: int, target: int) -> Sweep:
    """Return one sweep where the sensor sees its points at the stamp of another: the baseline."""
    t_ns = log.streams[name].t_ns
    shots = recorded_shots(log, name, log.streams[name].read(source))
    poses, moment, _ = poses_of(log, name, shots.t_ns)
    points = (
        np.einsum("nij,nj->ni", poses[moment, :3, :3], shots.direction * shots.range_m[:, None]) + poses[moment, :3, 3]
    )
    points = apply(inverse(log.map_T_sensor(name, t_ns[target : target + 1])[0][0]), points)
    return Sweep(int(t_ns[target]), points, intensity=shots.intensity)


def nearest_rays(shots: Shots, sweep: Sweep, gap_rad: float) -> tuple[Sweep, NDArray[np.intp]]:
    """Return the points of a sweep that rays see, and which: for each ray the nearest point of those less than a gap between lines beside it."""
    distance = np.linalg.norm(sweep.xyz_m, axis=1)
    off, ray = cKDTree(shots.direction).query(sweep.xyz_m / distance[:, None])
    order = np.lexsort((distance, ray))
    order = order[off[order] < gap_rad / 2]
    order = order[np.unique(ray[order], return_index=True)[1]]
    strength = None if sweep.intensity is None else sweep.intensity[order]
    return replace(sweep, xyz_m=sweep.xyz_m[order], intensity=strength), ray[order]


def flat_world(log: Log, world: World) -> World:
    """Return flat ground along the path and nothing else, so that agents are the bodies of `synth`: the other baseline."""
    assert log.ego is not None
    path = log.ego.map_T_ego[:, :3, 3] + log.ego.map_T_ego[:, :3, 2] * log.ground_z_ego_m - world.shift_m
    low, high = path[:, :2].min(axis=0) - GROUND_REACH_M, path[:, :2].max(axis=0) + GROUND_REACH_M
    steps = [np.arange(a, b, GROUND_STEP_M) for a, b in zip(low, high)]
    places = np.stack(np.meshgrid(*steps), -1).reshape(-1, 2)
    away, at = cKDTree(path[:, :2]).query(places)
    center = np.column_stack([places, path[at, 2]])[away < GROUND_REACH_M].astype(np.float32)
    one = np.ones(len(center), np.float32)
    up = np.tile(np.array([0, 0, 1], np.float32), (len(center), 1))
    ground = Surfels(center, up, one * np.float32(GROUND_STEP_M), one, one, one)
    return replace(world, given=None, refined=None, background=Tiles(ground), agents={}, sightings={}, alignments={})


def held_out(log: Log, scenario: Scenario, name: str, world: World, first: int) -> list[tuple[str, Figures]]:
    simulation, cast_s, sent = Simulation(log, world, scenario), 0.0, 0
    bodies = Simulation(log, flat_world(log, world), scenario)
    rows: dict[str, list[Figures]] = {"held out": [], "nearest sweep, moved": [], "bodies on flat ground": []}
    for i in range(first, len(log.streams[name].t_ns), EVERY):
        shots = simulation.shots(name, i)
        begin = time.process_time()
        simulated = simulation.cast(name, shots, log, 0, np.random.default_rng(i))
        cast_s, sent = cast_s + time.process_time() - begin, sent + len(shots.t_ns)
        moved = moved_sweep(log, name, i - 1, i)
        of_rays = nearest_rays(shots, moved, world.models[name].pattern.gap_rad)
        drawn = bodies.cast(name, shots, log, 0, np.random.default_rng(i))
        for of, (sweep, ray) in zip(rows.values(), (simulated, of_rays, drawn)):
            of.append(compare(shots, sweep, ray))
        # Clouds are compared whole.
        near = [p[np.linalg.norm(p, axis=1) < LIMIT_M] for p in (shots.direction * shots.range_m[:, None], moved.xyz_m)]
        rows["nearest sweep, moved"][-1].update(chamfer(*near))
    count = len(rows["held out"])
    speed = {
        "sweeps/s": count / cast_s,
        "rays": sent / count,
        "surfels": float(sum(map(len, world.background.values()))),
    }
    return [(title, mean(of) | (speed if title == "held out" else {})) for title, of in rows.items()]


def found_again(overlap: NDArray[np.floating], least: float) -> Figures:
    """Shares of the boxes of one that the other has, of overlaps (A, B); counts, to be summed."""
    return {
        "recorded": overlap.shape[0], "found again": float((overlap.max(axis=1, initial=0) > least).sum()),
        "simulated": overlap.shape[1], "right": float((overlap.max(axis=0, initial=0) > least).sum()),
    }  # fmt: skip


def boxes_in_sweeps(log: Log, scenario: Scenario, name: str, world: World, first: int) -> list[tuple[str, Figures]]:
    """Detect in recorded sweeps that were left out and in simulated ones of the same moments, within 30 m, BEV IoU 0.7.

    No simulation finds more of the same boxes than the recorded sweep does when the noise of its ranges is drawn once more.
    """
    detector, simulation = open_shipped("vehicle", LidarConfig()), Simulation(log, world, scenario)
    out: tuple[list[Figures], list[Figures]] = [], []

    all_found: tuple[list[Boxes3D], list[Boxes3D]] = [], []
    t_ns = log.streams[name].t_ns
    chosen = np.arange(first, len(t_ns), EVERY)

    def boxes(i: int, sweep: Sweep, kept: list[Boxes3D]) -> Array:
        origin, ground_z = cloud_origin(log, int(t_ns[i]))
        cloud = assemble_cloud(log, {name: sweep}, origin=origin, ground_z=ground_z, max_range_m=50.0)
        found = detector.detect(cloud)
        kept.append(found)
        here = log.map_T_sensor(name, t_ns[i])[0][0][:2, 3]
        sure = (found.score > 0.5) & (np.linalg.norm(found.center_m[:, :2] - here, axis=1) < 30)
        return np.column_stack([found.center_m[:, :2], found.size_m[:, :2], found.yaw_rad])[sure]

    for i in chosen.tolist():
        sweep, _ = simulation.cast(name, simulation.shots(name, i), log, int(t_ns[i]), np.random.default_rng(i))
        recorded = log.streams[name].read(i)
        shots = recorded_shots(log, name, recorded)
        noisy_m = np.random.default_rng(i).normal(shots.range_m, world.models[name].noise_m)
        points = shots.direction * noisy_m[:, None]
        again = Sweep(sweep.stamp_ns, points, "lidar", shots.t_ns, intensity=shots.intensity)
        own, others = boxes(i, recorded, all_found[0]), (boxes(i, sweep, all_found[1]), boxes(i, again, []))
        for of, other in zip(out, others):
            a, b = np.broadcast_arrays(own[:, None], other[None])
            of.append(found_again(rectangle_iou(a, b).reshape(a.shape[:2]), 0.7))
    rows = [("boxes in sweeps", shares(out[0])), ("noise drawn again", shares(out[1]))]
    for title, found in zip(("recorded sweeps", "simulated sweeps"), all_found):
        if log.labels is not None:
            detected = DetectedBoxes(log.name, "lidar:vehicle", t_ns[chosen], tuple(found))
            rows.append((title, average_precision(detected, log)))
    return rows


def average_precision(detected: DetectedBoxes, log: Log) -> Figures:
    """AP R40 in BEV of each class that has labels within 30 m, against the labels of the recorded log."""
    judged = evaluate_boxes(detected, log, DetectionOptions("dair", max_range_m=30.0))
    rows = {
        name: next(f for f in of["figures"] if f["match"]["measure"] != "iou_3d")
        for name, of in judged["classes"].items()
    }
    return {f"AP {name}": float(row["ap_r40"]) for name, row in rows.items() if row["truths"]}


def moved(old: Agent | None, new: Agent) -> bool:
    """Whether an agent is elsewhere than before, or was not there."""
    if old is None:
        return True
    was = old.at(new.waypoints.t_s)
    return not (was.valid & (np.hypot(was.x_m - new.waypoints.x_m, was.y_m - new.waypoints.y_m) < 0.1)).all()


def around(log: Log, source: Scenario, edited: Scenario, name: str) -> list[tuple[str, Figures]]:
    """Reconstruct the recorded sweeps, and what is simulated of a scenario and of an edited one, and compare with what each shows."""
    world, rows = build_world(log, source, [name]), []
    known = {agent.id: agent for agent in source.agents}
    for title, now in (("recorded", source), ("simulated", source), ("simulated, edited", edited)):
        shown = log if title == "recorded" else simulated_log(Simulation(log, world, now))
        found = reconstruct(shown, Config(detect="lidar:vehicle")).scenario
        judged = evaluate(found, count_points(now, shown), max_range_m=LIMIT_M)
        figures = {k: float(judged[k]) for k in ("recall", "precision", "position_median_m")}
        figures["recall where there are points"] = float(judged["coverage"]["hit_recall"])
        changed = [row for row in judged["agents"] if moved(known.get(row["id"]), now[row["id"]])]
        if ticks := sum(r["ticks"] for r in changed):
            figures["recall of changed"] = sum(r["matched"] for r in changed) / ticks
        cut_ins = [sum(tag.tag == "cut_in" for tag in find_tags(s)) for s in (now, found)]
        rows.append(
            (title, figures | ({"cut-ins": float(cut_ins[0]), "found": float(cut_ins[1])} if cut_ins[0] else {}))
        )
    return rows


def shares(counts: list[Figures]) -> Figures:
    """Turn counts of several records to shares."""
    n = {key: sum(c[key] for c in counts) for key in ("recorded", "found again", "simulated", "right")}
    rest = {key: value for key, value in mean(counts).items() if key not in n}
    again, right = (n[a] / n[b] if n[b] else np.nan for a, b in (("found again", "recorded"), ("right", "simulated")))
    return {**rest, "boxes": n["recorded"], "found again": again, "right": right}


def compare_pictures(true: Array, other: Array) -> Figures:
    from skimage.metrics import peak_signal_noise_ratio, structural_similarity

    gray = [np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)) for image in (true, other)]
    signal = min(float(peak_signal_noise_ratio(true, other)), 99.0)
    return {"PSNR dB": signal, "SSIM": float(structural_similarity(*gray))}


def pictures(
    log: Log, scenario: Scenario, camera: str, world: World, first: int, count: int
) -> list[tuple[str, Figures]]:
    """Compare pictures that were left out with simulated ones, and with the nearest recorded ones as they are; and what SSD sees in both."""
    simulation = Simulation(log, world, scenario, 0, Pictures(log, world, scenario, lambda _, i: i % EVERY == first))
    detector, t_ns, read = create_detector("ssd-mobilenet-v2", log), log.streams[camera].t_ns, log.streams[camera].read

    def boxes(i: int, image: Array) -> Array:
        return detector.detect(Frame(log.cameras[camera], int(t_ns[i]), lambda: image)).box_px

    rows: tuple[list[Figures], list[Figures]] = [], []
    chosen = np.arange(first, len(t_ns), EVERY)
    for i in chosen[np.unique(np.linspace(0, len(chosen) - 1, count).astype(int))]:
        true, begin = read(i), time.process_time()
        image, unknown = simulation.picture(camera, int(t_ns[i]))
        spent = time.process_time() - begin
        own = boxes(i, true)
        more = {"made up": unknown.mean(), "s": spent}
        rows[0].append(compare_pictures(true, image) | found_again(box_iou(own, boxes(i, image)), 0.5) | more)
        before = read(i - 1)
        rows[1].append(compare_pictures(true, before) | found_again(box_iou(own, boxes(i, before)), 0.5))
    return [(f"pictures of {camera}", shares(rows[0])), ("the one before", shares(rows[1]))]


def draw_sweep(log: Log, scenario: Scenario, name: str, without: str, path: Path) -> None:
    """Draw ranges of a recorded sweep, of the same simulated, and of the same without an agent."""
    world = build_world(log, scenario, [name], leave_out=lambda _, i: i == SWEEP)
    rest = replace(scenario, agents=tuple(a for a in scenario.agents if a.id != without))
    shots = Simulation(log, world, scenario).shots(name, SWEEP)
    window = window_of(shots.direction)
    parts = [title_line("recorded"), range_image(shots.direction, shots.range_m, window)]
    for title, what in (("simulated from the other sweeps", scenario), (f"simulated without {without}", rest)):
        sweep, rows = Simulation(log, world, what).cast(name, shots, log, 0, np.random.default_rng(0))
        distance = np.linalg.norm(sweep.xyz_m, axis=1)
        parts += [title_line(title), range_image(shots.direction[rows], distance, window)]
    cv2.imwrite(str(path), np.vstack(parts))


def sweeps_sideways(scene_path: Path, meters: list[float], degrees: list[float]) -> list[tuple[str, Figures]]:
    """Cast from where the ego were beside its path or turned, and compare with the true sweep from there."""
    scene = load_scene(scene_path).model_copy(update={"camera": ()})
    log, truth = synthesize(scene, observe=False)
    name = scene.lidar[0].name
    world = build_world(log, truth, [name])
    out = []
    for off_m, turned_deg in [*((m, 0.0) for m in meters), *((0.0, d) for d in degrees)]:
        spec, c, s = scene.lidar[0], np.cos(np.deg2rad(turned_deg)), np.sin(np.deg2rad(turned_deg))
        x, y, z = spec.position_m
        place = (float(c * x - s * y), float(s * x + c * y) + off_m, z)
        there = spec.model_copy(update={"position_m": place, "yaw_deg": spec.yaw_deg + turned_deg})
        lidars = (there, *scene.lidar[1:])
        true_log = synthesize(scene.model_copy(update={"lidar": lidars}), observe=False)[0].changed(ego=log.ego)
        simulation, figures = Simulation(log, world, truth), []
        for i in range(0, len(log.streams[name].t_ns), EVERY_SIDEWAYS):
            recorded = recorded_shots(true_log, name, true_log.streams[name].read(i))
            shots = all_shots(recorded, world.models[name].pattern)
            sweep, rows = simulation.cast(name, shots, true_log, 0, np.random.default_rng(i))
            figures.append(compare(shots, sweep, rows))
        out.append((f"{turned_deg:g} degrees turned" if turned_deg else f"{off_m:g} m sideways", mean(figures)))
    return out


def pictures_sideways(scene_path: Path, meters: list[float]) -> list[tuple[str, Figures]]:
    """Make pictures from beside the first camera, and compare them, and those that it took, with the true ones from there."""
    scene = load_scene(scene_path)
    scene = scene.model_copy(update={"camera": scene.camera[:1]})
    log, truth = synthesize(scene, observe=False)
    world, spec, out = build_world(log, truth, [scene.lidar[0].name]), scene.camera[0], []
    made, t_ns = Pictures(log, world, truth), log.streams[spec.name].t_ns
    for off_m in meters:
        x, y, z = spec.position_m
        moved = scene.model_copy(update={"camera": (spec.model_copy(update={"position_m": (x, y + off_m, z)}),)})
        true_log = synthesize(moved, observe=False)[0].changed(ego=log.ego)
        rows: tuple[list[Figures], list[Figures]] = [], []
        for i in range(0, len(t_ns), EVERY_SIDEWAYS):
            true = true_log.streams[spec.name].read(i)
            image, unknown = made.make(true_log, truth, world.agents, spec.name, int(t_ns[i]))
            rows[0].append(compare_pictures(true, image) | {"made up": unknown.mean()})
            rows[1].append(compare_pictures(true, log.streams[spec.name].read(i)))
        out += [(f"picture {off_m:g} m sideways", mean(rows[0])), ("as it was taken", mean(rows[1]))]
    return out


def mean(figures: list[Figures]) -> Figures:
    keys = dict.fromkeys(key for f in figures for key in f)
    return {key: float(np.mean([f[key] for f in figures if key in f])) for key in keys}


def main(
    path: Path, scenario_path: Annotated[Path | None, typer.Argument(metavar="SCENARIO")] = None, figures: list[str] = list(FIGURES),
    camera: str = "", count: int = 8, sideways: list[float] = list(SIDEWAYS_M), turned: list[float] = [], circle: Path | None = None, picture: Path | None = None,
    without: str = "", first: list[int] = [EVERY // 2],
) -> None:  # fmt: skip
    """Measure a log beside what was reconstructed from it, or a scene file from beside its path.

    Every fifth record is left out, from each of `first` (0 to 4) on; figures are means over these worlds. `figures` of sweeps, boxes and `count` pictures of a camera; `circle` is an edit of the scenario, `picture` a file for a sweep without an agent.
    """
    if scenario_path is None:
        rows = sweeps_sideways(path, sideways, turned) if "sweeps" in figures else []
        rows += pictures_sideways(path, sideways) if "pictures" in figures else []
    else:
        scenario = Scenario.load(scenario_path)
        log = localize_like(open_log(path), scenario.provenance)
        name = next(iter(log.lidars))
        if picture is not None:
            draw_sweep(log, scenario, name, without, picture)
            return
        if circle is not None:
            rows = around(log, scenario, Scenario.load(circle), name)
        else:
            found: dict[str, list[Figures]] = {}
            for k in first:
                begin, rows = time.process_time(), []
                world = build_world(log, scenario, [name], leave_out=lambda _, i, k=k: i % EVERY == k)
                print(f"build s/sweep {(time.process_time() - begin) / len(log.streams[name].t_ns):.3f}")
                rows += held_out(log, scenario, name, world, k) if "sweeps" in figures else []
                rows += boxes_in_sweeps(log, scenario, name, world, k) if "boxes" in figures else []
                if "pictures" in figures and log.cameras:
                    rows += pictures(log, scenario, camera or next(iter(log.cameras)), world, k, count)
                for label, of in rows:
                    found.setdefault(label, []).append(of)
            rows = [(label, mean(of)) for label, of in found.items()]
    for label, of in rows:
        print(f"{label:22s}", ", ".join(f"{key} {value:.3f}" for key, value in of.items()))
    print(f"at most {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB")
