"""Random traffic around a vehicle with a LiDAR and a pole with another: what hides from one is often seen by the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from typing import Any

import numpy as np
from benchmarks.table import cell, markdown
from numpy.typing import NDArray

from cooperation_worlds.runs import NAMES, detect
from cooperation_worlds.world import ROAD_LIDAR, ROAD_LINES, VEHICLE_LIDAR, Array, Parts
from log2sim.datatypes import GROUP_OF, Boxes3D, EgoVehicle, Lidar, Log, Stream, Sweep
from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.evaluation import precision_recall
from log2sim.evaluation.detection.protocols import Criterion, match_detections
from log2sim.geometry import NS_PER_S, rotation_from_rpy, transform
from log2sim.synth.polytope_caster import Returns, SensorState, Solid, cast_polytopes
from log2sim.synth.returns import LIDAR_MODELS, LidarModel
from log2sim.synth.scene import Environment
from log2sim.synth.traffic import TrafficScene, draw_scene
from log2sim.synth.traffic_data import (
    REAR_AXLE_OFFSET_M,
    REAR_AXLE_TO_LIDAR_M,
    START_NS,
    TrafficRun,
    poses_of,
    run_of,
    stamps_of,
)
from log2sim.synth.traffic_shapes import car

VEHICLE_MODELS = ("hdl64e", "pandar64", "os1-64", "vlp32c")
SWEEPS, PERIOD_S = 3, 0.1
POLE_HEIGHTS_M = (3.0, 6.0)
REACH_M = 50.0  # of the ego, within which road users count
MIN_POINTS = 5  # of both ends together, as labels of both clouds need
MIN_SCORE, REPORTED_SCORE = 0.02, 0.5
# DAIR-V2X's looser limits, half of a vehicle and a quarter of what is small.
IOU = {"vehicle": 0.5, "car": 0.5, "pedestrian": 0.25, "two_wheeler": 0.25}
# Of the counted vehicles, of which there are some, the share that hides from the vehicle.
MIN_HIDDEN_SHARE, MIN_COUNTED, MAX_TRIES = 0.2, 5, 200
KINDS = ("vehicle", "car", "pedestrian", "two_wheeler")


@dataclass(frozen=True, eq=False)
class HiddenTraffic:
    """A random scene with sensors at both ends."""

    seed: int
    run: TrafficRun
    pole: LidarModel
    place: SensorState  # of the pole's LiDAR
    ego_parts: Parts  # shape of the ego, as the pole sees it
    ego_size: tuple[float, float, float]
    late_s: float  # of the pole's sweeps after those of the vehicle

    def middle_s(self, name: str, index: int) -> float:
        """The time of the middle of a LiDAR's sweep."""
        return PERIOD_S * (index + 0.5) + (self.late_s if name == ROAD_LIDAR else 0.0)

    @cached_property
    def log(self) -> Log:
        height = float(self.run.scene.sensor.position_m[2])
        ego_T_lidar = transform(np.eye(3), np.array([REAR_AXLE_TO_LIDAR_M, 0.0, height]))
        map_T_pole = transform(self.place.rotation, self.place.position_m)

        def sweep(name: str, index: int) -> Sweep:
            r, (middle_ns,) = returns_of(self, name, index), stamps_of(np.array([self.middle_s(name, index)])).tolist()
            t_ns = middle_ns + np.rint(r.t_s.astype(np.float64) * NS_PER_S).astype(np.int64)
            end_ns = int(middle_ns + PERIOD_S / 2 * NS_PER_S)
            if name == VEHICLE_LIDAR:
                return Sweep(end_ns, r.xyz_m, "map", t_ns)
            local = ((r.xyz_m - map_T_pole[:3, 3]) @ map_T_pole[:3, :3]).astype(np.float32)
            return Sweep(end_ns, local, "lidar", t_ns)

        streams = {}
        for name in (VEHICLE_LIDAR, ROAD_LIDAR):
            sweeps = [sweep(name, index) for index in range(SWEEPS)]
            streams[name] = Stream(name, np.array([s.stamp_ns for s in sweeps]), sweeps.__getitem__)
        return Log(
            name=f"hidden_traffic_{self.seed}", format="synthetic", cameras={}, streams=streams,
            lidars={VEHICLE_LIDAR: Lidar(VEHICLE_LIDAR, "ego", ego_T_lidar), ROAD_LIDAR: Lidar(ROAD_LIDAR, "map", map_T_pole)},
            ego=poses_of(self.run, ego_T_lidar, np.arange(-0.1, SWEEPS * PERIOD_S + 0.2, 0.02)),
            ego_vehicle=EgoVehicle(self.ego_size, REAR_AXLE_OFFSET_M),
        )  # fmt: skip


@lru_cache(maxsize=2 * SWEEPS)
def returns_of(traffic: HiddenTraffic, name: str, index: int) -> Returns:
    """Cast a sweep of a LiDAR; the ego is the last of the objects that the pole sees."""
    scene = traffic.run.at(traffic.middle_s(name, index))
    if name == VEHICLE_LIDAR:
        return scene.cast(np.random.default_rng([traffic.seed, 4, index]))
    ahead = scene.sensor.rotation[:2, 0] / np.hypot(*scene.sensor.rotation[:2, 0])
    middle = _ego_xy(scene)
    floor, yaw = np.append(middle, scene.surface.elevation(middle)), float(np.arctan2(ahead[1], ahead[0]))
    users = [(o.parts, o.position_m, o.yaw_rad, o.speed_mps) for o in scene.objects if o.kind != "own car"]
    users.append((traffic.ego_parts, floor, yaw, float(np.hypot(*scene.sensor.velocity_mps))))
    solids = [Solid(parts, at, turn, pace * np.array([np.cos(turn), np.sin(turn)])) for parts, at, turn, pace in users]
    rng = np.random.default_rng([traffic.seed, 7, index])
    return cast_polytopes(traffic.pole, traffic.place, solids, scene.surface, rng, scene.returns)


def draw(seed: int) -> HiddenTraffic:
    """Draw a scene in which many vehicles hide from the LiDAR of the one that records, and a pole that may see them."""
    for attempt in range(MAX_TRIES):
        traffic = drawn(seed, attempt)
        # The first sweep of each end decides, as if they were cast at once.
        truth, hidden = truth_at(replace(traffic, late_s=0.0), START_NS + round(PERIOD_S * NS_PER_S), "vehicle")
        counted = ~truth.ignored
        if (hidden & counted).sum() >= MIN_HIDDEN_SHARE * max(counted.sum(), MIN_COUNTED):
            return traffic
    raise RuntimeError(f"hidden traffic, seed {seed}: none of {MAX_TRIES} scenes hides enough vehicles")


def drawn(seed: int, attempt: int) -> HiddenTraffic:
    """Draw a scene and a pole beside its road, 10 to 35 m from the vehicle."""
    rng = np.random.default_rng([seed, 11, attempt])
    model = LIDAR_MODELS[str(rng.choice(VEHICLE_MODELS))]
    scene = draw_scene("vehicle", np.random.default_rng([seed, 12, attempt]), lidar=model, weather=Environment())
    road, height = scene.roads[0], float(rng.uniform(*POLE_HEIGHTS_M))
    along, side = float(rng.choice([-1, 1], p=[0.3, 0.7])) * float(rng.uniform(10, 35)), float(rng.choice([-1, 1]))
    # The line passes the vehicle; ahead of it is where its LiDAR looks.
    if np.cos(road.yaw_rad - np.arctan2(scene.sensor.rotation[1, 0], scene.sensor.rotation[0, 0])) < 0:
        along = -along
    xy, direction = road.at(along, side * (road.half_width_m + float(rng.uniform(0.5, 3.0))))
    lean = np.deg2rad(rng.normal(0, 0.5, 2))
    rotation = rotation_from_rpy(lean[0], lean[1], direction + float(rng.uniform(-np.pi, np.pi)))
    ground = scene.surface.elevation(np.append(xy, 0.0))
    lines = int(rng.choice(ROAD_LINES))
    elevation = np.linspace(-35.0 if height > 4 else -25.0, 5.0, lines)
    pole = LidarModel(name="pole", elevation_deg=tuple(elevation.tolist()), azimuth_step_deg=0.3, range_m=100.0)
    size, parts = car(rng)
    while size[2] > scene.sensor.position_m[2] - 0.1 or size[0] > 5.2:
        size, parts = car(rng)
    place = SensorState(rotation, np.array([*xy, ground + height]), np.zeros(2))
    run = run_of(scene, SWEEPS * PERIOD_S + 0.2)
    return HiddenTraffic(seed, run, pole, place, parts, size, float(rng.uniform(0, 0.05)))


def points_of(view: HiddenTraffic, name: str, index: int) -> NDArray[np.int64]:
    """Number of points (M,) of a sweep on each object of the scene."""
    objects = view.run.scene.objects
    keep = [k for k, o in enumerate(objects) if name == VEHICLE_LIDAR or o.kind != "own car"]
    hit = returns_of(view, name, index).hit
    count = np.bincount(hit[(hit >= 0) & (hit < len(keep))], minlength=len(keep))
    out = np.zeros(len(objects), np.int64)
    out[keep] = count[: len(keep)]
    return out


def truth_at(view: HiddenTraffic, stamp_ns: int, kind: str) -> tuple[SceneBoxes, NDArray[np.bool_]]:
    """True boxes of a kind at the middle of a sweep that ends at a stamp, and which of them hide from the vehicle."""
    middle_s = (stamp_ns - START_NS) / NS_PER_S - PERIOD_S / 2
    index = int(np.clip(np.floor(middle_s / PERIOD_S), 0, SWEEPS - 1))
    scene = view.run.at(middle_s)
    vehicle, road = (points_of(view, name, index) for name in (VEHICLE_LIDAR, ROAD_LIDAR))
    rows = [k for k, o in enumerate(scene.objects) if _is(o.category, kind)]
    of = [scene.objects[k] for k in rows]
    boxes = [[*o.position_m[:2], o.position_m[2] + o.size_m[2] / 2, *o.size_m, o.yaw_rad] for o in of]
    boxes = np.array(boxes).reshape(-1, 7)
    away = np.hypot(*(boxes[:, :2] - _ego_xy(scene)).T)
    few = (vehicle + road)[rows] < MIN_POINTS
    return SceneBoxes.of(boxes, range_m=away, ignored=few | (away > REACH_M)), vehicle[rows] < MIN_POINTS


def found_at(view: HiddenTraffic, stamp_ns: int, found: Boxes3D, kind: str) -> SceneBoxes:
    """Found boxes of a kind, each moved with the object that it is nearest to from its own time to the middle of the sweep."""
    middle_s = (stamp_ns - START_NS) / NS_PER_S - PERIOD_S / 2
    now = view.run.at(middle_s)
    users = [k for k, o in enumerate(now.objects) if o.category]
    boxes = np.column_stack([found.center_m, found.size_m, found.yaw_rad])
    for row, t_ns in enumerate(found.t_ns):
        then = _at(view.run, (int(t_ns) - START_NS) / NS_PER_S)
        if users:
            k = min(users, key=lambda k: float(np.hypot(*(then.objects[k].position_m - boxes[row, :3])[:2])))
            boxes[row, :3] += now.objects[k].position_m - then.objects[k].position_m
    away = np.hypot(*(boxes[:, :2] - _ego_xy(now)).T)
    # The pole sees the ego, which is no other road user; far ones do not count.
    kept = np.array([_is(c, kind) for c in found.category], bool) & (away < REACH_M) & (away > 1.5)
    return SceneBoxes.of(boxes[kept], found.category[kept], found.score[kept], range_m=away[kept])


# By kind: found boxes of a sweep, true ones, and which of these hide from the vehicle.
BoxesOfSweep = dict[str, tuple[SceneBoxes, SceneBoxes, NDArray[np.bool_]]]


def measured(view: HiddenTraffic, log: Log, way: str) -> list[BoxesOfSweep]:
    """Boxes of each sweep beside the true ones, of all road users that both ends together have points of."""
    return sweeps(view, *detect(log, way, min_score=MIN_SCORE))


def sweeps(view: HiddenTraffic, t_ns: NDArray[np.int64], boxes: Sequence[Boxes3D]) -> list[BoxesOfSweep]:
    """Boxes of each sweep beside the true ones."""
    return [
        {kind: (found_at(view, t, found, kind), *truth_at(view, t, kind)) for kind in KINDS}
        for t, found in zip(t_ns.tolist(), boxes, strict=True)
    ]


def figures(rows: dict[str, list[BoxesOfSweep]]) -> dict[str, Any]:
    """AP BEV (R40) at the limits of `IOU` by kind and way, and recall at a score of 0.5 of what hides from the vehicle and of what does not."""
    ap: dict[str, dict[str, float | None]] = {kind: {} for kind in KINDS}
    recall: dict[str, dict[str, float]] = {"seen": {}, "hidden": {}}
    for way, of_way in rows.items():
        tables = {kind: [SceneBoxes.join([sweep[kind][k] for sweep in of_way]) for k in (0, 1)] for kind in KINDS}
        for kind, (found, truth) in tables.items():
            matches = match_detections(found, truth, Criterion("iou_bev", IOU[kind]))
            ap[kind][way] = precision_recall(found, matches).average()
        found, truth = tables["vehicle"]
        hidden = np.concatenate([sweep["vehicle"][2] for sweep in of_way])
        sure = found.take(found.score >= REPORTED_SCORE)
        right = match_detections(sure, truth, Criterion("iou_bev", IOU["vehicle"])).truth
        got = np.isin(np.arange(len(truth)), right[right >= 0])
        for name, of in (("seen", ~hidden), ("hidden", hidden)):
            counted = ~truth.ignored & of
            recall[name][way] = float(got[counted].mean()) if counted.any() else float("nan")
        count, share = int((~truth.ignored).sum()), float(hidden[~truth.ignored].mean())
    return {"ap": ap, "recall": recall, "vehicles": count, "hidden_from_vehicle": share}


def table(_: Sequence[HiddenTraffic], rows: dict[str, list[BoxesOfSweep]]) -> str:
    found = figures(rows)
    lines = [[kind, *(cell(ap[w] and 100 * ap[w], 1) for w in rows)] for kind, ap in found["ap"].items()]
    lines += [[f"recall, vehicles {what}", *(cell(of[w]) for w in rows)] for what, of in found["recall"].items()]
    share = f"{found['vehicles']} vehicles, {100 * found['hidden_from_vehicle']:.0f} % hidden from the vehicle"
    return markdown(["AP BEV .5; people, two-wheelers .25", *(NAMES[w] for w in rows)], lines) + "\n\n" + share


@cache
def _at(run: TrafficRun, t_s: float) -> TrafficScene:
    return run.at(t_s)


def _is(category: str, kind: str) -> bool:
    return bool(category) and (category == kind or GROUP_OF.get(category) == kind)


def _ego_xy(scene: TrafficScene) -> Array:
    ahead = scene.sensor.rotation[:2, 0] / np.hypot(*scene.sensor.rotation[:2, 0])
    return np.asarray(scene.sensor.position_m[:2] + (REAR_AXLE_OFFSET_M - REAR_AXLE_TO_LIDAR_M) * ahead)
