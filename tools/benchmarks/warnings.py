"""How often the ego is warned in ordinary traffic, where nobody collides: warnings per minute of driving.

    python tools/bench.py warnings SCENARIO.json|SCENE.toml|LOG|KITTI_TRACKING ...

Logs are taken by their labels, and so are the sequences of the KITTI tracking benchmark with `ego_motion`. The second opinion is that of the replay's conflict metrics, which know where everybody goes: the
least time to collision at constant velocity of the ego and the agent, and the least post-encroachment time. A warning without
either below the limits is counted as false.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from kitti.boxes import in_map, read_tracks, read_view

from log2sim.datatypes import EGO, Agent, EgoVehicle, Scenario, Waypoints
from log2sim.evaluation.metrics.truth import is_static, speed_along, truth_from_log
from log2sim.geometry import NS_PER_S, wrap_angle, yaw_of
from log2sim.logs.kitti.labels import CATEGORY_OF
from log2sim.logs.opening import open_log
from log2sim.simulation.runner import replay
from log2sim.simulation.warnings import warn
from log2sim.synth.scene import load_scene
from log2sim.synth.synthesis import synthesize

# A driver who has to react within 1.5 s, or passes within 1 s of another, is in a conflict (Hyden 1987; Allen et al. 1978).
CONFLICT_TTC_S, CONFLICT_PET_S = 1.5, 1.0

# Warnings by the time to collision alone, as the simplest systems give them.
PLAIN_TTC_S = 2.5


def main(paths: list[Path]) -> None:
    """Print a line for each scenario and warning."""
    driven_s, counts, plain = 0.0, [0, 0], 0
    for name, scenario in (found for path in paths for found in scenarios(path)):
        if scenario.ego is None:
            print(f"{name:40} no ego")
            continue
        result = replay(scenario, mode="exact", dt_s=0.05)
        found = warn(scenario, result)
        warned = [w for w in found.events if w.warned is not None]
        driven_s += found.driven_s
        least = [e["min_ttc_s"] for e in result.metrics["conflicts"] if e["ego"] and e["min_ttc_s"]]
        plain += sum(ttc_s <= PLAIN_TTC_S for ttc_s in least)
        print(f"{name:40} {found.driven_s:6.1f} s driven, {len(warned)} warnings")
        for w in warned:
            near = [e for e in result.metrics["conflicts"] if {EGO, w.agent} == set(e["agents"])][:1]
            ttc_s, pet_s = (next((e[k] for e in near if e[k] is not None), np.inf) for k in ("min_ttc_s", "pet_s"))
            true = w.collision_s is not None or ttc_s <= CONFLICT_TTC_S or pet_s <= CONFLICT_PET_S
            counts[true] += 1
            print(f"  {w.agent:24} at {w.warned.t_s:6.1f} s, p {w.probability:.2f}, gap {w.warned.distance_m:5.1f} m; "
                  f"least ttc {ttc_s:5.2f} s, pet {pet_s:5.2f} s, {'conflict' if true else 'false'}")  # fmt: skip
    minutes = driven_s / 60
    print(f"agents within {PLAIN_TTC_S:g} s of the ego at constant velocity: {plain}, {plain / minutes:.2f} a minute")
    print(f"{driven_s:.0f} s driven: {sum(counts)} warnings, {sum(counts) / minutes:.2f} a minute; "
          f"{counts[0]} of them false, {counts[0] / minutes:.2f} a minute")  # fmt: skip


def scenarios(path: Path) -> Iterator[tuple[str, Scenario]]:
    """Yield the scenarios that a path stands for."""
    if path.suffix == ".json":
        yield path.parent.name + "/" + path.name, Scenario.load(path)
    elif path.suffix == ".toml":
        yield path.stem, synthesize(load_scene(path), observe=False)[1]
    elif (path / "label_02").is_dir() and (path / "ego_motion").is_dir():
        yield from kitti_tracking(path)
    else:
        yield path.name, labeled_log(path)


PERIOD_S = 0.1
# The camera is 0.27 m before the LiDAR, which is 0.76 m before the rear axle, and 1.65 m above the ground (Geiger et al., "Vision
# meets robotics", 2013, figure 3).
CAMERA_AHEAD_M, CAMERA_HEIGHT_M = 1.03, 1.65


def kitti_tracking(folder: Path) -> Iterator[tuple[str, Scenario]]:
    """Yield the scenarios of sequences with labels (`label_02`), `calib` and `ego_motion`."""
    for labels in sorted((folder / "label_02").glob("*.txt")):
        motion = folder / "ego_motion" / labels.name
        if not motion.is_file():
            continue
        frames = len(motion.read_text().splitlines())
        view, rows = read_view(folder / "calib" / labels.name, motion, frames), read_tracks(labels)
        rows = rows.take(np.isin(rows.category, list(CATEGORY_OF)) & (rows.frame < frames))
        kind = np.array([CATEGORY_OF[name] for name in rows.category.tolist()])
        agents = []
        for number, of in dict.fromkeys(zip(rows.track_id.tolist(), kind.tolist())):
            own = rows.take((rows.track_id == number) & (kind == of))
            size = tuple(np.median(own.size_hwl_m[:, ::-1], axis=0).tolist())
            agents.append(_agent(f"{of}-{number}", of, size, own.frame * PERIOD_S, *in_map(own, view)))
        yield labels.stem, Scenario(labels.stem, 0, frames * PERIOD_S, (_kitti_ego(view.map_T_cam), *agents))


def _kitti_ego(map_T_cam: np.ndarray) -> Agent:
    vehicle, forward = EgoVehicle(), map_T_cam[:, :3, 2]
    back_m = CAMERA_AHEAD_M - vehicle.rear_axle_offset_m
    center = map_T_cam[:, :3, 3] - back_m * forward + [0, 0, vehicle.size_m[2] / 2 - CAMERA_HEIGHT_M]
    t_s = np.arange(len(forward)) * PERIOD_S
    ego = _agent(EGO, "car", vehicle.size_m, t_s, center, np.arctan2(forward[:, 1], forward[:, 0]))
    return replace(ego, rear_axle_offset_m=vehicle.rear_axle_offset_m)


def _agent(id: str, kind: str, size_m: tuple, t_s: np.ndarray, center: np.ndarray, yaw: np.ndarray) -> Agent:
    static = id != EGO and is_static(t_s, center[:, :2])
    speed = np.zeros(len(t_s)) if static else speed_along(t_s, center[:, :2], yaw)
    known = np.ones(len(t_s), dtype=bool)
    waypoints = Waypoints(t_s, *center.T, wrap_angle(yaw), speed, known, np.zeros(len(t_s)))
    return Agent(id, kind, size_m, waypoints, static=static)


def labeled_log(path: Path) -> Scenario:
    """Return the labels of a log with the ego at all of its poses, whatever was recorded of sweeps and images."""
    log = open_log(path)
    truth = truth_from_log(log, cameras=[])
    if log.ego is None or truth.ego is None:
        return truth
    poses, known = log.ego.at(log.ego.t_ns)
    t_s = (log.ego.t_ns[known] - truth.t0_ns) / NS_PER_S
    every = max(1, round(0.5 * PERIOD_S / float(np.median(np.diff(t_s)))))
    rows = np.flatnonzero((t_s >= 0) & (t_s <= truth.duration_s))[::every]
    poses, t_s = poses[known][rows], t_s[rows]
    ego = _agent(EGO, "car", truth.ego.size_m, t_s, log.ego_centers(poses), yaw_of(poses))
    others = (replace(a, waypoints=replace(a.waypoints, visible=None)) for a in truth.others)
    return replace(truth, agents=(replace(ego, rear_axle_offset_m=truth.ego.rear_axle_offset_m), *others))
