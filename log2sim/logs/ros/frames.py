"""The tree of coordinate frames of a recording, and where in it the ego is."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EgoVehicle, Lidar, Stream
from log2sim.errors import LogError, RecordError
from log2sim.geometry import Array, PoseTrack, apply, inverse, rotation_from_quaternion, transform
from log2sim.logs.records import MAX_POSITION_M
from log2sim.logs.ros.containers import printable
from log2sim.logs.ros.messages import EgoSettings, StaticTransform

# Transforms that are sent again and again with the same values are static, as those of ROS 1 on /tf.
SAME_TRANSFORM = 1e-9
MAX_QUATERNION_ERROR = 0.05
# From a sensor to the root of the tree; usual are fewer than ten.
MAX_DEPTH = 100
# Position, and the quaternion scalar-first.
Numbers = tuple[float, float, float, float, float, float, float]


@dataclass(frozen=True, eq=False)
class Edge:
    """Pose of a frame in its parent: parent_T_child (N, 4, 4) at stamps (N,), sorted."""

    parent: str
    t_ns: NDArray[np.int64]
    parent_T_child: Array

    @property
    def static(self) -> bool:
        """Whether all its values are the same."""
        return bool(np.abs(self.parent_T_child - self.parent_T_child[0]).max() <= SAME_TRANSFORM)


class FrameTree:
    """Frames by name; each has at most one parent, which is checked where a frame is used; `where` names the recording."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._rows: dict[str, dict[str, list[tuple[int, Numbers]]]] = {}
        self._edges: dict[str, dict[str, Edge]] = {}
        self.refused = 0  # transforms whose values are not finite or whose quaternions are no rotations

    def add(self, transforms: Iterable[Any]) -> None:
        """Add transforms of a TFMessage."""
        for message in transforms:
            stamp, t, q = message.header.stamp, message.transform.translation, message.transform.rotation
            if not is_pose(t, q):
                self.refused += 1
                continue
            t_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
            parents = self._rows.setdefault(printable(message.child_frame_id).lstrip("/"), {})
            row = t_ns, (t.x, t.y, t.z, q.w, q.x, q.y, q.z)
            parents.setdefault(printable(message.header.frame_id).lstrip("/"), []).append(row)

    def add_static(self, given: Iterable[StaticTransform]) -> None:
        """Add transforms of the settings, which replace those of the recording."""
        for entry in given:
            row = 0, (*entry.translation_m, *entry.rotation_wxyz)
            self._rows[entry.child.lstrip("/")] = {entry.parent.lstrip("/"): [row]}

    @property
    def frames(self) -> set[str]:
        """All names."""
        return set(self._rows) | {parent for parents in self._rows.values() for parent in parents}

    def describe(self) -> list[dict[str, Any]]:
        """Return the edges as JSON: parent, child, whether static, number of messages."""
        return [
            {"parent": parent, "child": child, "static": self._edge(child, parent).static, "messages": len(rows)}
            for child, parents in sorted(self._rows.items())
            for parent, rows in sorted(parents.items())
        ]

    def moving_ancestors(self, frame: str) -> list[str]:
        """Ancestors of a frame that it moves against, from the nearest to the root."""
        moved, found = False, []
        for _, edge in self._path_up(frame):
            moved |= not edge.static
            if moved:
                found.append(edge.parent)
        return found

    def rigid_root(self, frame: str) -> str:
        """Return the highest ancestor that a frame does not move against; itself without one."""
        return list(self._static_ancestors(frame))[-1]

    def mount(self, dst: str, src: str) -> Array | None:
        """Compute dst_T_src (4, 4) of frames that do not move against each other; None when they do or are not connected."""
        if dst == src:
            return np.eye(4)
        src_up, dst_up = self._static_ancestors(src), self._static_ancestors(dst)
        common = next((frame for frame in src_up if frame in dst_up), None)
        return None if common is None else inverse(dst_up[common]) @ src_up[common]

    def track(self, fixed: str, frame: str) -> PoseTrack | None:
        """Poses of a frame in one of its ancestors, at the stamps of the edge that was sent most often.

        Others are interpolated, and held before their first and after their last stamp, as a localization that corrects an
        odometry now and then is used.
        """
        path = [edge for _, edge in self._path_up(frame)]
        last = next((k for k, edge in enumerate(path) if edge.parent == fixed), None)
        if last is None:
            return None
        edges = path[: last + 1]
        t_ns = np.unique(max((e for e in edges if not e.static), key=lambda e: len(e.t_ns), default=edges[0]).t_ns)
        poses = np.repeat(np.eye(4)[None], len(t_ns), axis=0)
        for edge in edges:
            poses = edge_at(edge, t_ns) @ poses
        return PoseTrack(t_ns, poses)

    def _static_ancestors(self, frame: str) -> dict[str, Array]:
        """Poses ancestor_T_frame by ancestor, up to the first edge that moves."""
        found, pose = {frame: np.eye(4)}, np.eye(4)
        for _, edge in self._path_up(frame):
            if not edge.static:
                break
            pose = edge.parent_T_child[0] @ pose
            found[edge.parent] = pose
        return found

    def _path_up(self, frame: str) -> list[tuple[str, Edge]]:
        path: list[tuple[str, Edge]] = []
        passed = [frame]
        while frame in self._rows:
            parents = self._rows[frame]
            if len(parents) > 1:
                names = "' and '".join(sorted(parents)[:2])
                raise LogError(
                    f"{self._where}: frame '{frame}' has two parents in /tf, '{names}'; a frame may have one"
                )
            edge = self._edge(frame, next(iter(parents)))
            path.append((frame, edge))
            frame = edge.parent
            if frame in passed:
                raise LogError(f"{self._where}: the frames of /tf form a cycle: {' -> '.join([*passed, frame])}")
            passed.append(frame)
            if len(path) > MAX_DEPTH:
                raise LogError(f"{self._where}: frame '{passed[0]}' has more than {MAX_DEPTH} frames above it in /tf")
        return path

    def _edge(self, child: str, parent: str) -> Edge:
        built = self._edges.setdefault(child, {})
        if parent not in built:
            rows = self._rows[child][parent]
            t_ns, values = np.array([t for t, _ in rows], dtype=np.int64), np.array([v for _, v in rows])
            order = np.argsort(t_ns, kind="stable")
            poses = transform(rotation_from_quaternion(values[order, 3:]), values[order, :3])
            built[parent] = Edge(parent, t_ns[order], poses)
        return built[parent]


def edge_at(edge: Edge, t_ns: NDArray[np.int64]) -> Array:
    """Interpolate an edge at stamps (N,): (N, 4, 4); held outside of its own."""
    if edge.static:
        return np.repeat(edge.parent_T_child[:1], len(t_ns), axis=0)
    # Of repeated stamps the last value counts.
    stamps, last = np.unique(edge.t_ns[::-1], return_index=True)
    track = PoseTrack(stamps, edge.parent_T_child[::-1][last])
    return track.at(np.clip(t_ns, stamps[0], stamps[-1]))[0]


def pose_of(translation: Any, rotation: Any) -> Array | None:
    """Pose (4, 4) of a position and a quaternion message; None where the quaternion is no rotation or a value not finite."""
    if not is_pose(translation, rotation):
        return None
    q = np.array([rotation.w, rotation.x, rotation.y, rotation.z])
    return transform(rotation_from_quaternion(q), np.array([translation.x, translation.y, translation.z]))


def is_pose(translation: Any, rotation: Any) -> bool:
    """Whether the position is finite and not farther than 1e9 m along an axis, and the quaternion has a norm near 1."""
    norm = math.hypot(rotation.w, rotation.x, rotation.y, rotation.z)
    near = all(abs(value) <= MAX_POSITION_M for value in (translation.x, translation.y, translation.z))
    return near and abs(norm - 1) < MAX_QUATERNION_ERROR


# Usual names of the frame of a vehicle, first that of REP 105.
BASE_FRAMES = ("base_link", "base_footprint", "ego_vehicle", "vehicle", "rear_axle", "base", "chassis", "ego")
GROUND_FRAME = "base_footprint"
# x forward, y left, z up out of the axes of an image: x right, y down, z forward.
CAMERA_R_EGO = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])

# The road is looked for in the first sweep around the vehicle, well below the sensor: a car's LiDAR is at least so high.
ROAD_RADIUS_M = (3.0, 20.0)
MIN_SENSOR_HEIGHT_M, MAX_SENSOR_HEIGHT_M = 0.5, 100.0
ROAD_BIN_M = 0.05
MIN_ROAD_POINTS = 200


@dataclass(frozen=True, eq=False)
class EgoFrame:
    """The vehicle's frame."""

    base: str | None  # its name; None for a recording of roadside sensors
    base_T_ego: Array  # (4, 4)
    ground_z_m: float | None  # height of the road in the ego frame; None where it has to be measured
    vehicle: EgoVehicle
    notes: tuple[str, ...]


def choose_base(
    tree: FrameTree, sensor_frames: list[str], pose_frames: Iterable[str], fixed_frames: tuple[str, ...], given: str
) -> tuple[str | None, str]:
    """Choose the vehicle's frame, that of the settings if they give one, and say why; `pose_frames` are those of odometry."""
    if given:
        return given, "the settings name it"
    pose_frames = list(pose_frames)
    known = tree.frames | set(pose_frames) | set(sensor_frames)
    reasons = {frame: "by its name" for frame in BASE_FRAMES if frame in known}
    reasons |= {frame: "odometry gives its poses" for frame in pose_frames if frame not in reasons}
    # One that sensors are fixed to goes before one that they are not.
    ordered = sorted(reasons, key=lambda f: all(tree.mount(f, sensor) is None for sensor in sensor_frames))
    if ordered:
        return ordered[0], reasons[ordered[0]]
    for frame in sensor_frames:
        root = tree.rigid_root(frame)
        if root not in fixed_frames:
            return root, f"all sensors are fixed to it, and no frame is named {BASE_FRAMES[0]}"
    return None, "the sensors stand still"


def place_ego(base: str | None, settings: EgoSettings, tree: FrameTree, camera_frames: Collection[str]) -> EgoFrame:
    """Place the ego in the vehicle's frame by the settings, else by the name of the frame."""
    notes, given, default = [], settings.model_fields_set, EgoVehicle()
    offset_m = default.rear_axle_offset_m if settings.rear_axle_offset_m is None else settings.rear_axle_offset_m
    vehicle = EgoVehicle(settings.size_m or default.size_m, offset_m)
    ground_m = settings.ground_z_m
    if base is None:
        return EgoFrame(None, np.eye(4), ground_m or 0.0, vehicle, ())
    in_image = base in camera_frames and "rotation_wxyz" not in given
    rotation = CAMERA_R_EGO if in_image else rotation_from_quaternion(settings.rotation_wxyz)
    base_T_ego = transform(rotation, settings.origin_m)
    if "origin_m" not in given:
        notes.append(f"the frame '{base}' is taken to be at the middle of the rear axle (ego.origin_m in the settings)")
    if settings.size_m is None:
        notes.append("the size of the ego is not known; that of a usual car is taken (ego.size_m)")
    if ground_m is None:
        footprint = tree.mount(base, GROUND_FRAME) if GROUND_FRAME in tree.frames and base != GROUND_FRAME else None
        if footprint is not None:
            ground_m = float((inverse(base_T_ego) @ footprint)[2, 3])
        elif base in BASE_FRAMES or "origin_m" in given:
            where = "ego.origin_m" if "origin_m" in given else f"'{base}'"
            notes.append(f"{where} is taken to be at the height of the road (ego.ground_z_m)")
            ground_m = 0.0
    return EgoFrame(base, base_T_ego, ground_m, vehicle, tuple(notes))


def measure_road(
    frame: EgoFrame, lidars: Mapping[str, Lidar], streams: Mapping[str, Stream]
) -> tuple[float, tuple[str, ...]]:
    """Measure the height of the road in the ego frame, with remarks; 0 where no LiDAR shows it.

    It is the most frequent one of the points around and below a sensor in its first sweep.
    """
    notes = []
    for name, lidar in lidars.items():
        try:
            sweep = streams[name].read(0)
        except RecordError as problem:
            notes.append(f"{name}: {problem}")
            continue
        ego_T_lidar = lidar.mount_T_lidar
        points = apply(ego_T_lidar, sweep.xyz_m)
        radius = np.hypot(points[:, 0] - ego_T_lidar[0, 3], points[:, 1] - ego_T_lidar[1, 3])
        around = (radius > ROAD_RADIUS_M[0]) & (radius < ROAD_RADIUS_M[1])
        height = ego_T_lidar[2, 3] - points[:, 2]
        z = points[around & (height > MIN_SENSOR_HEIGHT_M) & (height < MAX_SENSOR_HEIGHT_M), 2]
        if len(z) < MIN_ROAD_POINTS:
            notes.append(f"{name}: {len(z)} points around and below the sensor, too few to find the road")
            continue
        counts = np.bincount(np.floor((z - z.min()) / ROAD_BIN_M).astype(np.int64))
        mode_m = z.min() + (counts.argmax() + 0.5) * ROAD_BIN_M
        ground_m = float(np.median(z[np.abs(z - mode_m) < 2 * ROAD_BIN_M]))
        side = "below" if ground_m <= 0 else "above"
        notes.append(
            f"the road is {abs(ground_m):.2f} m {side} the origin of the ego in the frame '{frame.base}', measured in the "
            f"first sweep of {name} (ego.ground_z_m)"
        )
        return ground_m, tuple(notes)
    notes.append(f"the height of the road in '{frame.base}' is not known; taken as 0 (ego.ground_z_m)")
    return 0.0, tuple(notes)
