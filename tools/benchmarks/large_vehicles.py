"""Large and close vehicles: one row of ten kinds of 4 to 19 m, in eight poses, with and without a second vehicle.

    python tools/bench.py large_vehicles --out large.json
    python tools/bench.py large_vehicles --kinds box_truck,bus --poses end_on --detector lidar:vehicle
    python tools/bench.py large_vehicles --kinds bus,road_train --poses oncoming,overtaking,overtaken --cameras 1

reconstructs a small synthetic log for each of them from the exact boxes of six cameras, or fewer, and the sweeps of one LiDAR, and prints
how far each vehicle is from the truth: recall (ticks at which its box has an agent), position, yaw up to half turns, length,
width, speed (medians over the ticks), backwards (share of its ticks). Ticks count whether or not a camera shows half of it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from entry import parser_of

from benchmarks.table import cell, markdown
from log2sim.config import Config
from log2sim.datatypes import GROUP_OF, Agent, Labels, Log, Scenario, Stream, Sweep
from log2sim.geometry import NS_PER_S, Array, wrap_angle
from log2sim.pipeline import reconstruct
from log2sim.synth.actors import Actor, MovingScene
from log2sim.synth.raycast import mount_T_lidar, ray_pattern, slab_distance, sweep_stamps
from log2sim.synth.scene import LidarSpec, Scene, scene_from_table
from log2sim.synth.synthesis import synthesize

# Length, width, height in m of common European vehicles: Directive 96/53/EC limits the long ones.
KINDS: Mapping[str, tuple[str, tuple[float, float, float]]] = {
    "hatchback": ("car", (4.0, 1.75, 1.5)),
    "sedan": ("car", (4.8, 1.85, 1.45)),
    "van": ("car", (5.9, 2.0, 2.6)),
    "light_truck": ("truck", (6.8, 2.3, 2.8)),
    "minibus": ("bus", (7.5, 2.3, 2.9)),
    "box_truck": ("truck", (8.4, 2.5, 3.3)),
    "bus": ("bus", (12.0, 2.55, 3.1)),
    "trailer": ("truck", (13.6, 2.55, 4.0)),
    "semitrailer": ("truck", (16.5, 2.55, 4.0)),
    "road_train": ("truck", (18.75, 2.55, 4.0)),
}
SECOND_SIZE_M = (4.5, 1.8, 1.5)
GAP_M = 1.5
DURATION_S = 2.6
CAMERA_YAWS_DEG = (0, 60, 120, 180, 240, 300)
EGO_FRONT_M = 3.7
STANDING = {"waypoints": [[0.0, 0.0, 0.0], [60.0, 0.0, 8.0]], "wait_s": [[0, 60.0]]}
# An agent stands for a vehicle while its center is in the vehicle's box, widened by the gate of `evaluate`.
GATE_M = 2.0


def driving(speed_mps: float) -> dict[str, Any]:
    """An ego that drives straight on."""
    return {"waypoints": [[0.0, 0.0, speed_mps], [60.0, 0.0, speed_mps]]}


@dataclass(frozen=True)
class Place:
    """Where a vehicle is, how it moves, and what the ego does."""

    xy_m: tuple[float, float]  # center of its box at the start
    yaw_deg: float
    ego: dict[str, Any]  # table of the scene
    speed_mps: float = 0.0  # constant, along its heading
    start_s: float | None = None  # it stands until then and accelerates to 4 m/s within 4 m
    second: int = -1  # whether a second vehicle is behind it (-1) or ahead of it (1): on the far side from the ego


def place_of(pose: str, size_m: tuple[float, float, float]) -> Place:
    """Place a vehicle of a size in one of the poses of `POSES`."""
    length, width, _ = size_m
    yaw = np.deg2rad(35.0)
    near_corner = np.array([12.0, 3.0]) + length / 2 * np.array([np.cos(yaw), np.sin(yaw)])
    return {
        # Its rear 12 m ahead of a waiting ego.
        "end_on": Place((EGO_FRONT_M + 12.0 + length / 2, 0.0), 0.0, STANDING, second=1),
        # In the next lane, as fast as the ego.
        "beside": Place((3.0, 3.4), 0.0, driving(8.0), 8.0),
        # Parked across a corner, approached slowly.
        "oblique": Place((float(near_corner[0]), float(near_corner[1])), 35.0, driving(3.0), second=1),
        # Parked at the curb, passed by the ego.
        "curb": Place((8.0 + length / 2, -2.4 - width / 2), 0.0, driving(8.0)),
        # Starts from rest beside a waiting ego.
        "start": Place((3.0 - length / 4, 2.2 + width / 2), 0.0, STANDING, start_s=0.5),
        # Passes the ego in the other direction, from behind, and is passed.
        "oncoming": Place((EGO_FRONT_M + 10.0 + length / 2, 3.4), 180.0, driving(7.0), 7.0),
        "overtaking": Place((-4.0 - length / 2, 3.4), 0.0, driving(8.0), 18.0),
        "overtaken": Place((EGO_FRONT_M + 4.0 + length / 2, -3.4), 0.0, driving(16.0), 6.0),
    }[pose]


POSES = ("end_on", "beside", "oblique", "curb", "start", "oncoming", "overtaking", "overtaken")


def scene_of(kind: str, pose: str, second: bool, *, exact: bool = False, cameras: int = len(CAMERA_YAWS_DEG)) -> Scene:
    """Make the scene of a kind in a pose; an exact one has a LiDAR and poses without noise. The first camera looks ahead."""
    category, size = KINDS[kind]
    place = place_of(pose, size)
    agents = [agent_at("target", category, size, place, place.xy_m)]
    if second:
        ahead = place.second * (size[0] / 2 + GAP_M + SECOND_SIZE_M[0] / 2)
        yaw = np.deg2rad(place.yaw_deg)
        xy = place.xy_m[0] + ahead * float(np.cos(yaw)), place.xy_m[1] + ahead * float(np.sin(yaw))
        agents.append(agent_at("second", "car", SECOND_SIZE_M, place, xy))
    return scene_from_table(
        table_of(f"{kind}-{pose}{'-second' if second else ''}", place.ego, agents, exact=exact, cameras=cameras)
    )


def table_of(
    name: str,
    ego: dict[str, Any],
    agents: Sequence[dict[str, Any]],
    *,
    exact: bool = False,
    cameras: int = len(CAMERA_YAWS_DEG),
) -> dict[str, Any]:
    """Make the table of a scene with some of six cameras and one LiDAR around the ego."""
    around = [
        {"name": f"camera_{yaw}", "position_m": [1.4, 0.0, 1.6], "yaw_deg": float(yaw), "fov_deg": 70.0,
         "size_px": [480, 300], "offset_s": 0.05}
        for yaw in CAMERA_YAWS_DEG[:cameras]
    ]  # fmt: skip
    lidar: dict[str, Any] = {
        "name": "top",
        "position_m": [1.2, 0.0, 2.0],
        "channels": 40,
        "elevation_deg": [-25.0, 15.0],
    }
    if exact:
        lidar |= {"noise_m": 0.0, "dropout": 0.0, "resolution_m": 0.0}
    sigma = 0.0 if exact else 0.02
    return {
        "name": name, "duration_s": DURATION_S, "ego": ego | {"poses": "poses"}, "agent": list(agents), "camera": around,
        "lidar": [lidar], "gnss": {"position_sigma_m": sigma, "angle_sigma_deg": sigma},
        "road": [{"line": [[-60.0, 0.0], [150.0, 0.0]], "width_m": 14.0}],
    }  # fmt: skip


def agent_at(
    name: str, category: str, size_m: tuple[float, float, float], place: Place, xy_m: tuple[float, float]
) -> dict[str, Any]:
    """Make the table of a vehicle whose box center starts at a position."""
    agent = {"id": name, "category": category, "size_m": list(size_m)}
    if not place.speed_mps and place.start_s is None:
        return agent | {"pose": [*xy_m, place.yaw_deg]}
    heading = np.array([np.cos(np.deg2rad(place.yaw_deg)), np.sin(np.deg2rad(place.yaw_deg))])
    rear = np.array(xy_m) - 0.3 * size_m[0] * heading
    if place.start_s is None:
        rows = [[*rear, place.speed_mps], [*(rear + 200.0 * heading), place.speed_mps]]
        return agent | {"waypoints": [[float(v) for v in row] for row in rows]}
    rows = [[*rear, 0.0], [*(rear + 4.0 * heading), 4.0], [*(rear + 40.0 * heading), 4.0]]
    return agent | {"waypoints": [[float(v) for v in row] for row in rows], "wait_s": [[0, place.start_s]]}


@dataclass(frozen=True)
class Figures:
    """How far a vehicle of a scenario is from the truth; medians over its ticks, None where it was not found."""

    kind: str
    pose: str
    vehicle: str
    recall: float
    position_m: float | None = None
    yaw_deg: float | None = None
    length_m: float | None = None
    width_m: float | None = None
    speed_mps: float | None = None
    backwards: float | None = None
    extra: int = 0


def states(agent: Agent, t_s: Array) -> tuple[Array, Array, Array]:
    """Return position (T, 2), yaw (T,) and speed (T,) at times (T,); NaN outside its life."""
    w = agent.waypoints
    there = (t_s >= w.t_s[0] - 1e-6) & (t_s <= w.t_s[-1] + 1e-6)
    xy = np.stack([np.interp(t_s, w.t_s, v) for v in (w.x_m, w.y_m)], axis=1)
    xy[~there] = np.nan
    return xy, np.interp(t_s, w.t_s, np.unwrap(w.yaw_rad)), np.interp(t_s, w.t_s, w.speed_mps)


def figures(kind: str, pose: str, vehicle: str, truth: Scenario, found: Scenario) -> Figures:
    """Compare a vehicle of the truth with the agents whose centers are in its box."""
    (true,) = (a for a in truth.agents if a.id == vehicle)
    t_s = np.unique(np.concatenate([a.waypoints.t_s for a in found.agents])) if found.agents else np.zeros(0)
    xy, yaw, speed = states(true, t_s + (found.t0_ns - truth.t0_ns) / 1e9)
    best: tuple[int, Agent, Any] | None = None
    near_ticks = 0
    for agent in found.others:
        if GROUP_OF[agent.category] != "vehicle":
            continue
        at, turn, pace = states(agent, t_s)
        offset = at - xy
        along = offset[:, 0] * np.cos(yaw) + offset[:, 1] * np.sin(yaw)
        across = offset[:, 1] * np.cos(yaw) - offset[:, 0] * np.sin(yaw)
        with np.errstate(invalid="ignore"):
            near = (np.abs(along) <= max(true.size_m[0] / 2, GATE_M)) & (np.abs(across) <= GATE_M)
        near_ticks += bool(near.any())
        if near.any() and (best is None or near.sum() > best[0]):
            best = int(near.sum()), agent, (np.hypot(along, across)[near], (turn - yaw)[near], (pace - speed)[near])
    if best is None:
        return Figures(kind, pose, vehicle, 0.0)
    count, agent, (error_m, turned, faster) = best
    turned = np.asarray(wrap_angle(turned))
    return Figures(
        kind, pose, vehicle, count / len(t_s), float(np.median(error_m)),
        float(np.degrees(np.median(np.minimum(np.abs(turned), np.pi - np.abs(turned))))),
        agent.size_m[0] - true.size_m[0], agent.size_m[1] - true.size_m[1],
        float(np.median(np.abs(faster))), float((np.abs(turned) > np.pi / 2).mean()), near_ticks - 1,
    )  # fmt: skip


def log_of(scene: Scene, *, seed: int) -> tuple[Log, Scenario]:
    """Make the log of a scene, with its labels, and the truth; vehicles are made of a few boxes, which is fast and exact."""
    moving = MovingScene.of(scene)
    log, truth = synthesize(scene, seed=seed, observe=False)
    stamps = log.streams[scene.camera[0].name].t_ns
    t_s = (stamps - scene.start_ns) / NS_PER_S
    states = [a.at(t_s) for a in moving.actors]
    labels = Labels(
        t_ns=np.tile(stamps, len(states)),
        track_id=np.repeat([a.spec.id for a in moving.actors], len(stamps)),
        category=np.repeat([a.spec.category for a in moving.actors], len(stamps)),
        center_m=np.concatenate([s.center_m for s in states]),
        size_m=np.repeat([a.spec.box_m for a in moving.actors], len(stamps), axis=0),
        yaw_rad=np.concatenate([s.yaw_rad for s in states]),
        visible=None,
    )
    spec = scene.lidar[0]
    sweeps = {
        int(t): cast(spec, moving, int(t), np.random.default_rng([seed, int(t) % 2**31]))
        for t in sweep_stamps(spec, scene)
    }
    ends = np.array(sorted(sweeps), dtype=np.int64)
    stream = Stream(spec.name, ends, lambda i: sweeps[int(ends[i])])
    return replace(log, labels=labels, streams={**log.streams, spec.name: stream}), truth


def parts_of(actor: Actor) -> list[tuple[Array, Array]]:
    """List the boxes of a vehicle, low and high corners (3,) relative to its center: cab and cargo, body and cabin."""
    length, width, height = size = np.array(actor.spec.box_m)
    low, high = -size / 2, size / 2
    if actor.spec.category == "car":
        return [
            (low * [1, 1, 0.7], high * [1, 1, 0.2]),
            (np.array([-0.4 * length, -0.42 * width, 0.0]), np.array([0.2 * length, 0.42 * width, height / 2])),
        ]
    if actor.spec.category == "bus":
        return [(low * [1, 1, 0.8], high)]
    cab = length / 2 - min(2.1, 0.3 * length)
    return [
        (low * [1, 1, 0.3], np.array([cab - 0.15, width / 2, height / 2])),
        (np.array([cab, -0.46 * width, -0.35 * height]), high * [1, 0.92, 0.7]),
        (low * [0.98, 0.6, 0.7], high * [0.96, 0.6, 0.0]),
    ]


def cast(spec: LidarSpec, moving: MovingScene, stamp_ns: int, rng: np.random.Generator) -> Sweep:
    """Cast one sweep against the boxes of all vehicles and flat ground; every point is in the lidar frame at its own time."""
    directions, ago_s = ray_pattern(spec)
    t_ns = stamp_ns - np.rint(ago_s * NS_PER_S).astype(np.int64)
    moments, column = np.unique(t_ns, return_inverse=True)
    pose = moving.map_T_mount("ego", moments) @ mount_T_lidar(spec)
    origin, ray = pose[column, :3, 3], np.einsum("nij,nj->ni", pose[column, :3, :3], directions)
    with np.errstate(divide="ignore"):
        distance = np.where(ray[:, 2] < -0.02, origin[:, 2] / -ray[:, 2], np.inf)
    for actor in moving.actors:
        states = actor.at((moments - moving.scene.start_ns) / NS_PER_S)
        turn = states.map_T_agent()[:, :3, :3].transpose(0, 2, 1)[column]
        at = np.einsum("nij,nj->ni", turn, origin - states.center_m[column])
        along = np.einsum("nij,nj->ni", turn, ray)
        for low, high in parts_of(actor):
            distance = np.minimum(distance, slab_distance(high - low, at - (low + high) / 2, along))
    kept = (distance < spec.range_m) & (rng.random(len(distance)) >= spec.dropout)
    far = distance[kept] + spec.noise_m * rng.normal(size=int(kept.sum()))
    return Sweep(stamp_ns, (directions[kept] * far[:, None]).astype(np.float32), "lidar", t_ns[kept])


def measured(
    kinds: Sequence[str],
    poses: Sequence[str],
    detector: str,
    seed: int,
    *,
    exact: bool = False,
    cameras: int = len(CAMERA_YAWS_DEG),
) -> Iterator[list[Figures]]:
    """Reconstruct every scene and compare its vehicles with the truth."""
    # Agents alone are compared: the ground and colors only take time.
    less = {"map": {"lanes": False}, "appearance": {"colors": False, "signals": False}}
    config = Config.load(None, [f"detect.name={detector}"], **less)
    for pose in poses:
        for kind in kinds:
            for second in (False, True):
                log, truth = log_of(scene_of(kind, pose, second, exact=exact, cameras=cameras), seed=seed)
                found = reconstruct(log, config).scenario
                names = [a.id for a in truth.others]
                yield [figures(kind, pose + ("+" if second else ""), name, truth, found) for name in names]


def row(f: Figures) -> list[str]:
    """Format a line of the table."""
    values = (f.recall, f.position_m, f.yaw_deg, f.length_m, f.width_m, f.speed_mps, f.backwards)
    return [f.kind, f.pose, f.vehicle, *map(cell, values), str(f.extra)]


HEAD = (
    "kind", "pose", "vehicle", "recall", "position m", "yaw deg", "length m", "width m", "speed m/s", "backwards", "extra",
)  # fmt: skip


def totals(rows: Sequence[Figures]) -> str:
    """Sum up by pose: means, and the share of vehicles within 0.3 m and 3 degrees."""
    lines = []
    for pose in (*dict.fromkeys(f.pose.rstrip("+") for f in rows), "all"):
        some = [f for f in rows if f.vehicle == "target" and pose in (f.pose.rstrip("+"), "all")]
        if not some:
            continue
        known = [f for f in some if f.position_m is not None]
        good = [f for f in known if f.position_m <= 0.3 and f.yaw_deg <= 3.0]
        columns = ("position_m", "yaw_deg", "length_m", "width_m", "speed_mps", "backwards")
        means = [float(np.mean([abs(getattr(f, c)) for f in known])) if known else np.nan for c in columns]
        lines.append([
            pose, str(len(some)), f"{np.mean([f.recall for f in some]):.2f}", *(f"{v:.2f}" for v in means),
            f"{len(good) / len(some):.2f}",
        ])  # fmt: skip
    head = ("pose", "scenes", "recall", *HEAD[4:10], "within 0.3 m and 3 deg")
    return markdown(head, lines)


def main(arguments: list[str] | None = None) -> None:
    """Run the benchmark."""
    parser = parser_of(__doc__)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--poses", default=",".join(POSES))
    parser.add_argument("--detector", default="labels")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--exact", action="store_true", help="LiDAR and poses without noise")
    parser.add_argument("--cameras", type=int, default=len(CAMERA_YAWS_DEG), help="the first looks ahead")
    parser.add_argument("--out", type=Path, help="file for the figures as JSON")
    args = parser.parse_args(arguments)
    rows: list[Figures] = []
    options = {"exact": args.exact, "cameras": args.cameras}
    for found in measured(args.kinds.split(","), args.poses.split(","), args.detector, args.seed, **options):
        rows += found
        for f in found:
            print(" | ".join(row(f)), flush=True)
    print(markdown(HEAD, [row(f) for f in rows]), totals(rows), sep="\n\n")
    if args.out is not None:
        args.out.write_text(json.dumps([asdict(f) for f in rows], indent=1), encoding="utf-8")
