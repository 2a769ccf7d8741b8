"""Make the first passes over synthetic logs on which `fit.py confidence` fits: random traffic, sensors, rates and detectors.

    python tools/fit.py confidence_logs FOLDER --logs 40 --seed 1

Each log is random traffic (either side of the road, weather, LiDARs of the market, on a vehicle or at the roadside), with a
detector in sweeps, a simulated one in images, or both, and a second time without LiDAR. Simulated are the errors that detectors
in images have: boxes that jitter and are off, misses and scores that depend on the object and its height in the image, swapped
categories, one box over two objects, two boxes on one, boxes on what is no road user or on a fixed part of the image, and boxes
that appear for one frame; and those of a detector in sweeps that it has on recorded walls, hedges and fences, which are more
various than those that it was trained on. Poses wander as those of GNSS and IMU do, so that what stands seems to move. Files that exist
are left as they are.
"""

from __future__ import annotations

import os
import pickle
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from log2sim.config import Config
from log2sim.datatypes import (
    GROUP_OF,
    MAX_SIZE_M,
    MIN_SIZE_M,
    TYPICAL_SIZE_M,
    Boxes3D,
    Detections,
    Frame,
    Log,
    Scenario,
    Stream,
)
from log2sim.datatypes.log_odds import probability_of
from log2sim.evaluation.metrics.truth import points_in_labels, truth_from_log
from log2sim.files.stages import StageClock
from log2sim.geometry import (
    NS_PER_S,
    Array,
    PoseTrack,
    apply,
    box_iou,
    inverse,
    nearest_index,
    rotation_from_rpy,
    wrap_angle,
)
from log2sim.perception.detect.detectors import MIN_SIDE_PX
from log2sim.perception.detect3d.box_points import points_of_boxes
from log2sim.perception.detect3d.detectors import LidarDetector
from log2sim.perception.first_pass import Observations
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.lidar.projection import project_boxes_in_view, view_of
from log2sim.perception.run_detectors import Detectors
from log2sim.pipeline import infer_scenario, observe_log, start
from log2sim.report import Run
from log2sim.synth.traffic import TrafficScene
from log2sim.synth.traffic_data import TrafficSettings, draw_traffic, log_of

# Ticks a second, and how long a log of that rate lasts, s.
RATES = ((10.0, 2.5), (10.0, 4.5), (5.0, 6.0), (2.0, 9.0))
ROADSIDE_EVERY = 6
# Random traffic drives at up to 18 m/s; so many times as fast it is that of a motorway, on roads as straight as one.
FAST_EVERY, FAST, MAX_FAST_CURVATURE_PM = 3, 2.0, 0.003
# Poses wander by so much, from the best receivers to the worst, m and rad, correlated over so long, s.
WANDER_M, WANDER_RAD, WANDER_S = (0.005, 0.15), (0.0005, 0.005), 5.0
# Shares of logs by what is searched.
SEARCHED = {"images and sweeps": 0.45, "sweeps": 0.2, "images": 0.35}
# What LiDAR sees less of, a camera does not see either; what is hidden behind nearer objects by more is not found.
MIN_SEEN_POINTS, MAX_HIDDEN = 6, 0.6
MIN_SCORE = 0.35
LOOKS_LIKE = {
    "container": ("car", "truck", "bus"), "shelter": ("truck", "bus"), "building": ("truck", "bus"),
    "bush": ("car", "pedestrian"), "bin": ("car", "pedestrian"), "bench": ("bicycle", "motorcycle"),
    "pole": ("pedestrian",), "tree": ("pedestrian",), "stand": ("bicycle", "motorcycle"), "cone": ("pedestrian",),
    "fence": ("truck", "bicycle"),
}  # fmt: skip
TAKEN_FOR = {
    "car": ("truck",), "truck": ("car", "bus"), "bus": ("truck",), "cyclist": ("pedestrian", "motorcycle", "bicycle"),
    "motorcycle": ("cyclist", "bicycle"), "bicycle": ("cyclist", "motorcycle"), "pedestrian": ("cyclist",),
}  # fmt: skip


# Pieces of fronts and things in which a detector in sweeps sees road users for the whole log, by category; the share of them,
# which varies by log; log-odds of a box, of each thing and of each sweep; and how far sizes vary. On half of the fronts and fences the
# box is where most rays arrive, and slides along as the sensor passes.
SEEN_IN_SWEEPS = {
    "building": ("car", "truck", "bus"), "fence": ("car", "truck"), "container": ("car", "truck"), "shelter": ("car", "truck"),
    "bush": ("car", "pedestrian"), "stall": ("car",), "pole": ("pedestrian",), "tree": ("pedestrian",), "bin": ("pedestrian",),
}  # fmt: skip
SLIDING, SLIDING_SHARE = ("building", "fence"), 0.5
SEEN_SHARE, SEEN_ODDS, SWEEP_ODDS, SEEN_SIZE_SIGMA, MIN_SEEN_IN_BOX = 0.06, (0.2, 0.8), 0.5, 0.2, 8


@dataclass(frozen=True, eq=False)
class Case:
    """A run of a log up to its observations, with the truth; `second` goes on from there."""

    name: str
    run: Run
    observations: Observations
    truth: Scenario

    def second(self) -> Any:
        run = replace(self.run, clock=StageClock(), plan=self.run.plan.only_agents())
        return infer_scenario(run, self.observations)


@dataclass(frozen=True)
class Named:
    """What remains of a detector in a stored case."""

    name: str


def silent(*_: Any) -> None:
    """Report no progress."""


class SimulatedDetector:
    """Errs on labels as networks do; every box depends on the seed and its frame alone."""

    name, default_min_score = "simulated", MIN_SCORE

    def __init__(self, log: Log, scene: TrafficScene, true: PoseTrack | None, seed: int) -> None:
        self._log, self._true, self._seed = log, true, seed
        rng = np.random.default_rng([seed, 0])
        self._offset, false_share = rng.normal(0, 0.4), 0.05 * np.exp(rng.normal(0, 0.7))
        things = [o for o in scene.objects if not o.category and o.kind in LOOKS_LIKE and rng.random() < false_share]
        self._things = [(o, str(rng.choice(LOOKS_LIKE[o.kind])), rng.normal(-0.7, 0.8)) for o in things]
        camera = next(iter(log.cameras.values()))
        size = np.array([camera.width_px, camera.height_px] * 2)
        self._fixed = []
        for _ in range(rng.poisson(0.3)):
            u, v, w, h = rng.uniform([0, 0.4, 0.03, 0.05], [0.9, 0.9, 0.25, 0.4])
            box = np.clip(np.array([u, v, u + w, v + h]), 0, 1) * (size - 1)
            self._fixed.append((box, str(rng.choice(["car", "pedestrian", "truck"])), rng.normal(-1.0, 0.6)))

    def detect(self, frame: Frame) -> Detections:
        index = int((frame.t_ns - self._log.streams[frame.camera.name].t_ns[0]) // 1_000_000)
        rng = np.random.default_rng([self._seed, 1, index])
        rows = self._of_objects(frame, rng) + self._of_things(frame, rng)
        rows += [(b, c, o + rng.normal(0, 0.7)) for b, c, o in self._fixed]
        for _ in range(rng.poisson(0.12)):
            u, v = rng.uniform([0, 0.35], [0.95, 0.7]) * [frame.camera.width_px, frame.camera.height_px]
            h = rng.uniform(15, 90)
            category = str(rng.choice(["car", "pedestrian", "truck", "cyclist"], p=[0.5, 0.3, 0.1, 0.1]))
            w = h * (0.4 if category == "pedestrian" else 1.4)
            rows.append((np.array([u, v, u + w, v + h]), category, rng.normal(-0.6, 0.5)))
        limit = np.array([frame.camera.width_px - 1, frame.camera.height_px - 1] * 2)
        rows = [(np.clip(b, 0, limit), c, float(probability_of(o + self._offset))) for b, c, o in rows]
        rows = [r for r in rows if r[2] >= MIN_SCORE and (r[0][2:] - r[0][:2]).min() >= MIN_SIDE_PX]
        rows.sort(key=lambda r: -r[2])
        return Detections(
            np.array([r[0] for r in rows]).reshape(-1, 4),
            np.array([r[2] for r in rows], dtype=np.float64),
            np.array([r[1] for r in rows], dtype="<U16"),
        )

    def _of_objects(self, frame: Frame, rng: np.random.Generator) -> list[tuple[Array, str, float]]:
        names, categories, boxes, hidden = self._shown(frame)
        gone = set()
        for k, name in enumerate(names):
            # Two objects in one box, for the whole log.
            for j in range(k):
                both = np.random.default_rng([self._seed, 3, *sorted((name, names[j]))])
                if categories[j] == categories[k] and box_iou(boxes[j], boxes[k])[0, 0] > 0.15 and both.random() < 0.08:
                    boxes[j] = np.append(np.minimum(boxes[j][:2], boxes[k][:2]), np.maximum(boxes[j][2:], boxes[k][2:]))
                    gone.add(k)
        rows: list[tuple[Array, str, float]] = []
        for k, name in enumerate(names):
            if k in gone:
                continue
            own, category = np.random.default_rng([self._seed, 2, name]), categories[k]
            quality, bias = own.normal(1.2, 1.0), own.normal(0, 0.04, 4)
            other = str(own.choice(TAKEN_FOR.get(category, (category,))))
            swapped, split = own.random() < 0.05, own.random() < 0.03
            category = other if swapped or rng.random() < 0.03 else category
            side = np.tile(boxes[k][2:] - boxes[k][:2], 2)
            odds = quality + 0.8 * np.log2(side[1] / 50) - 2.5 * hidden[k] + rng.normal(0, 0.5)
            box = boxes[k] + side * (bias + rng.normal(0, 0.03, 4)) + rng.normal(0, 1.0, 4)
            rows.append((box, category, float(odds)))
            if split:
                part, end = box.copy(), int(own.integers(2))
                part[2 * end] += (1 - 2 * end) * own.uniform(0.35, 0.6) * side[0]
                rows.append((part, category, float(odds - own.uniform(0.2, 1.5))))
        return rows

    def _shown(self, frame: Frame) -> tuple[list[int], list[str], list[Array], list[float]]:
        """Numbers, categories, boxes and hidden shares of the road users that a frame shows, the nearest first."""
        labels, view = self._log.labels, view_of(self._log, frame.camera.name, frame.t_ns)
        if labels is None or view is None:
            return [], [], [], []
        rows = np.flatnonzero((labels.t_ns == frame.t_ns) & labels.visible)
        found = project_boxes_in_view(view, labels.center_m[rows], labels.size_m[rows], labels.yaw_rad[rows])
        names, categories, boxes, hidden = [], [], [], []
        for k in np.argsort(found.range_m, kind="stable"):
            if not found.valid[k]:
                continue
            box = found.box_px[k].copy()
            whole = (box[2:] - box[:2]).prod()
            for nearer in boxes:
                if nearer[1] <= box[1] + 0.3 * (box[3] - box[1]) and nearer[3] >= box[3] - 0.3 * (box[3] - box[1]):
                    if nearer[0] <= box[0] < nearer[2]:
                        box[0] = min(nearer[2], box[2])
                    if nearer[0] < box[2] <= nearer[2]:
                        box[2] = max(nearer[0], box[0])
            share = 1 - (box[2:] - box[:2]).prod() / whole if whole > 0 else 1.0
            if share <= MAX_HIDDEN:
                names.append(int(str(labels.track_id[rows[k]]).split("_")[-1]))
                categories.append(str(labels.category[rows[k]]))
                boxes.append(box)
                hidden.append(float(share))
        return names, categories, boxes, hidden

    def _of_things(self, frame: Frame, rng: np.random.Generator) -> list[tuple[Array, str, float]]:
        view = view_of(self._log, frame.camera.name, frame.t_ns)
        if view is None or not self._things:
            return []
        center = np.array([o.position_m + np.array([0, 0, o.size_m[2] / 2]) for o, _, _ in self._things])
        center = apply(seen_from(self._log, self._true, frame.t_ns), center)
        size, yaw = np.array([o.size_m for o, _, _ in self._things]), np.array([o.yaw_rad for o, _, _ in self._things])
        found = project_boxes_in_view(view, center, size, yaw)
        rows = []
        for k in np.flatnonzero(found.valid):
            side = np.tile(found.box_px[k][2:] - found.box_px[k][:2], 2)
            odds = self._things[k][2] + 0.4 * np.log2(max(side[1], 5) / 50) + rng.normal(0, 0.7)
            rows.append((found.box_px[k] + side * rng.normal(0, 0.05, 4), self._things[k][1], float(odds)))
        return rows


class MistakenDetector:
    """Adds boxes of road users on what is none to those of a detector in sweeps; every box depends on the seed and its sweep alone."""

    def __init__(
        self, detector: LidarDetector, log: Log, scene: TrafficScene, true: PoseTrack | None, seed: int
    ) -> None:
        self._detector, self._log, self._true, self._seed, self.name = detector, log, true, seed, detector.name
        rng = np.random.default_rng([seed, 4])
        share, self._seen = SEEN_SHARE * np.exp(rng.normal(0, 0.7)), []
        for thing in scene.objects:
            if thing.category or thing.kind not in SEEN_IN_SWEEPS or rng.random() > share:
                continue
            categories = rng.choice(SEEN_IN_SWEEPS[thing.kind], 2)
            size = np.array(TYPICAL_SIZE_M[str(categories[0])]) * np.exp(rng.normal(0, SEEN_SIZE_SIGMA, 3))
            size = np.clip(size, MIN_SIZE_M[str(categories[0])], MAX_SIZE_M[str(categories[0])])
            # Fronts face -y of the thing; the box is laid against what is seen of them.
            along = rng.uniform(-0.4, 0.4) * thing.size_m[0]
            depth = size[1] / 2 - 0.2 if thing.kind == "building" else 0.0
            c, s = np.cos(thing.yaw_rad), np.sin(thing.yaw_rad)
            at = thing.position_m + np.array([c * along - s * depth, s * along + c * depth, size[2] / 2])
            slides = thing.kind in SLIDING and rng.random() < SLIDING_SHARE
            reach_m = max(thing.size_m[0] - size[0], 0.0) / 2 if slides else 0.0
            yaw = thing.yaw_rad + rng.normal(0, 0.04)
            self._seen.append((at, size, yaw, categories, rng.normal(*SEEN_ODDS), reach_m, along))

    def detect(self, cloud: Cloud, earlier: Sequence[Cloud] = ()) -> Boxes3D:
        found = self._detector.detect(cloud, earlier)
        rng, rows = np.random.default_rng([self._seed, 5, cloud.stamp_ns // 1_000_000]), []
        moved = seen_from(self._log, self._true, cloud.stamp_ns)
        turn_rad = np.arctan2(moved[1, 0], moved[0, 0])
        for at, size, yaw, categories, odds, reach_m, along in self._seen:
            at, yaw = apply(moved, at), yaw + turn_rad
            forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
            if reach_m:  # level with the sensor, as far as the front reaches to both sides of its middle
                level_m = float(forward @ (cloud.origin + cloud.sensor - at))
                at = at + float(np.clip(level_m, -reach_m - along, reach_m - along)) * forward
            center, own = at + rng.normal(0, 0.25) * forward, size * np.exp(rng.normal(0, 0.06, 3))
            turned = yaw + np.pi * rng.integers(2) + rng.normal(0, 0.03)
            score = probability_of(odds + rng.normal(0, SWEEP_ODDS))
            category, box = str(categories[int(rng.random() < 0.2)]), (center - cloud.origin, own, turned)
            (points,) = points_of_boxes(cloud.xyz, *(np.array([v]) for v in box), ~cloud.ground).count
            known = (np.hypot(*(found.center_m - center)[:, :2].T) < 2).any()
            if score >= MIN_SCORE and points >= MIN_SEEN_IN_BOX and not known:
                rows.append((center, own, wrap_angle(turned), rng.uniform(0.5, 0.8), category, score, points))
        if not rows:
            return found
        center, own, yaw, heading, category, score, points = (np.array(column) for column in zip(*rows))
        stamps = np.full(len(rows), cloud.stamp_ns)
        mistaken = Boxes3D(stamps, center, own, yaw, heading, category.astype("<U16"), score, points)
        return Boxes3D.join([found, mistaken])


def seen_from(log: Log, true: PoseTrack | None, t_ns: int) -> Array:
    """Return how poses of a log move (4, 4) what is seen at a stamp, which `true` poses leave where it is."""
    if log.ego is None or true is None:
        return np.eye(4)
    return np.asarray(log.ego.at(t_ns)[0][0] @ inverse(true.at(t_ns)[0][0]))


def _wandering(log: Log, rng: np.random.Generator) -> Log:
    """Let the poses of a log wander, and its labels with them, which are made in the frame of the sensor."""
    if log.ego is None or log.labels is None:
        return log
    sigma = np.exp(rng.uniform(*np.log([WANDER_M, WANDER_M, WANDER_RAD]).T))
    keep = np.exp(-np.diff(log.ego.t_ns, prepend=log.ego.t_ns[0]) / NS_PER_S / WANDER_S)
    off = rng.normal(0, sigma, (len(keep), 3))  # along x and y, in yaw: an Ornstein-Uhlenbeck process each
    for k in range(1, len(off)):
        off[k] = keep[k] * off[k - 1] + np.sqrt(1 - keep[k] ** 2) * off[k]
    poses = log.ego.map_T_ego.copy()
    poses[:, :3, :3] = rotation_from_rpy(0.0, 0.0, off[:, 2]) @ poses[:, :3, :3]
    poses[:, :2, 3] += off[:, :2]
    moved, labels = log.changed(ego=replace(log.ego, map_T_ego=poses)), log.labels
    transforms = np.array([seen_from(moved, log.ego, int(t)) for t in labels.t_ns]).reshape(-1, 4, 4)
    center = np.einsum("nij,nj->ni", transforms[:, :3, :3], labels.center_m) + transforms[:, :3, 3]
    yaw = wrap_angle(labels.yaw_rad + np.arctan2(transforms[:, 1, 0], transforms[:, 0, 0]))
    return moved.changed(labels=replace(labels, center_m=center, yaw_rad=yaw))


def make_log(seed: int, index: int) -> tuple[Log, TrafficScene, PoseTrack | None]:
    """Make log `index` and return it with its scene and true poses; its sweeps are kept in memory, and its images are black."""
    rng = np.random.default_rng([seed, index, 9])
    mount = "roadside" if index % ROADSIDE_EVERY == ROADSIDE_EVERY - 1 else "vehicle"
    rate_hz, duration_s = RATES[int(rng.integers(len(RATES)))]
    scene, environment = draw_traffic(TrafficSettings(mount, seed=seed, sensor="random"), index)
    if index % FAST_EVERY == 0 and abs(scene.roads[0].curvature_per_m) < MAX_FAST_CURVATURE_PM:
        scene = _sped_up(scene)
    name, own_seed = f"{mount}-{index}", int(rng.integers(2**31))
    log = log_of(scene, environment, name, duration_s, own_seed, camera_rate_hz=rate_hz, image_labels=False)
    camera, lidar = log.streams["camera"], log.streams["lidar"]
    nearest = np.unique(nearest_index(lidar.t_ns, camera.t_ns))
    sweeps = [lidar.read(int(k)) for k in nearest]
    size = log.cameras["camera"]
    black = np.zeros((size.height_px, size.width_px, 3), dtype=np.uint8)
    streams = {
        "camera": Stream("camera", camera.t_ns, lambda i: black),
        "lidar": Stream("lidar", lidar.t_ns[nearest], lambda i: sweeps[i]),
    }
    log = log.changed(streams=streams)
    points, _ = points_in_labels(log, log.labels)
    log, true = log.changed(labels=replace(log.labels, visible=points >= MIN_SEEN_POINTS)), log.ego
    return _wandering(log, rng), scene, true


def _sped_up(scene: TrafficScene) -> TrafficScene:
    """Let the vehicles of a scene drive `FAST` times as fast, the sensor's too."""
    objects = [
        replace(o, speed_mps=FAST * o.speed_mps, turn_radps=FAST * o.turn_radps)
        if GROUP_OF.get(o.category) == "vehicle" or o.kind == "own car"
        else o
        for o in scene.objects
    ]
    sensor = replace(scene.sensor, velocity_mps=FAST * scene.sensor.velocity_mps)
    return replace(scene, objects=type(scene.objects)(objects), sensor=sensor)


def cases_of(seed: int, index: int) -> list[Case]:
    """Run the first passes of a log."""
    log, scene, true = make_log(seed, index)
    truth = truth_from_log(log)
    sweeps = "lidar:vehicle" if scene.mount == "vehicle" else "lidar:roadside"
    names = {"images and sweeps": f"labels+{sweeps}", "sweeps": sweeps, "images": "labels"}
    rng = np.random.default_rng([seed, index, 10])
    searched = names[str(rng.choice(list(SEARCHED), p=list(SEARCHED.values())))]
    blind = log.changed(lidars={}, streams={"camera": log.streams["camera"]})
    return [
        _case(log, scene, true, truth, searched, seed + index),
        _case(blind, scene, true, truth, "labels", seed + index),
    ]


def _case(log: Log, scene: TrafficScene, true: PoseTrack | None, truth: Scenario, detector: str, seed: int) -> Case:
    run = start(log, Config.load(settings=[f"detect.name={detector}"]))
    images = None if run.detectors.images is None else SimulatedDetector(log, scene, true, seed)
    sweeps = MistakenDetector(run.detectors.sweeps, run.log, scene, true, seed) if run.detectors.sweeps else None
    observations = observe_log(replace(run, detectors=Detectors(images, sweeps)))
    observations.records = None
    kept = run.log.changed(streams={k: Stream(k, np.asarray(s.t_ns), silent) for k, s in run.log.streams.items()})
    named = [None if d is None else Named(d.name) for d in (images, run.detectors.sweeps)]
    run = replace(run, log=kept, detectors=Detectors(*named), clock=None, progress=silent, earlier=None)
    kind = detector.replace("labels", "images") + ("" if log.lidars else ", no LiDAR")
    return Case(f"{log.name} ({kind})", run, observations, truth)


def main(folder: Path, logs: int = 40, first: int = 0, seed: int = 1) -> None:
    """Make so many logs, from the first index on."""
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(first, first + logs):
        path = folder / f"{seed}-{index:03d}.pkl"
        if path.exists():
            continue
        cases = cases_of(seed, index)
        try:
            content = pickle.dumps(cases, protocol=5)
        except AttributeError as error:  # a log whose poses were mended reads by functions
            print(f"{path.name} left out: {error}", flush=True)
            continue
        part = path.with_suffix(f".{os.getpid()}")
        part.write_bytes(content)
        part.replace(path)
        print(path.name, ", ".join(case.name for case in cases), flush=True)
