"""The tree of coordinate frames of a recording, where in it the ego is, and the poses of the vehicle.

These are from /tf, odometry, poses, or GNSS with an IMU. The first source that gives at least two poses counts, in this order: /tf from
a frame of the map; Odometry; PoseStamped and PoseWithCovarianceStamped; NavSatFix with the orientations of an Imu; /tf from any
other frame, such as "odom". So a localization goes before dead reckoning, and what was filtered goes before raw fixes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EgoVehicle, Lidar, MapFrame, Stream
from log2sim.errors import LogError, RecordError
from log2sim.geometry import (
    Array,
    PoseTrack,
    apply,
    inverse,
    rotation_from_quaternion,
    shift_poses,
    transform,
    whole_kilometers,
    wrap_angle,
    yaw_of,
)
from log2sim.logs.records import MAX_POSITION_M
from log2sim.logs.ros.bag import Bag
from log2sim.logs.ros.containers import printable
from log2sim.logs.ros.messages import (
    MIN_POSES,
    EgoSettings,
    MapSettings,
    PoseSettings,
    StaticTransform,
    decode_bytes,
    describe_uncovered,
)
from log2sim.logs.stamps import map_frame_of, poses_from_geodetic, strictly_increasing

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
        for edge in self._path_up(frame):
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
        path = self._path_up(frame)
        last = next((k for k, edge in enumerate(path) if edge.parent == fixed), None)
        if last is None:
            return None
        edges = path[: last + 1]
        t_ns = np.unique(max((e for e in edges if not e.static), key=lambda e: len(e.t_ns), default=edges[0]).t_ns)
        poses = np.repeat(np.eye(4)[None], len(t_ns), axis=0)
        for edge in edges:
            if edge.static:
                poses = edge.parent_T_child[0] @ poses
                continue
            # Of repeated stamps the last value counts.
            stamps, row = np.unique(edge.t_ns[::-1], return_index=True)
            own = PoseTrack(stamps, edge.parent_T_child[::-1][row])
            poses = own.at(np.clip(t_ns, stamps[0], stamps[-1]))[0] @ poses
        return PoseTrack(t_ns, poses)

    def _static_ancestors(self, frame: str) -> dict[str, Array]:
        """Poses ancestor_T_frame by ancestor, up to the first edge that moves."""
        found, pose = {frame: np.eye(4)}, np.eye(4)
        for edge in self._path_up(frame):
            if not edge.static:
                break
            pose = edge.parent_T_child[0] @ pose
            found[edge.parent] = pose
        return found

    def _path_up(self, frame: str) -> list[Edge]:
        path, passed = list[Edge](), [frame]
        while frame in self._rows:
            parents = self._rows[frame]
            if len(parents) > 1:
                names = "' and '".join(sorted(parents)[:2])
                raise LogError(f"{self._where}: frame '{frame}' has two parents in /tf, '{names}'; one is allowed")
            path.append(self._edge(frame, next(iter(parents))))
            frame = path[-1].parent
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
FIXED_FRAMES = ("map", "world", "earth", "odom")
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
    tree: FrameTree, sensor_frames: list[str], pose_frames: list[str], given: str
) -> tuple[str | None, str]:
    """Choose the vehicle's frame, that of the settings if they give one, and say why; `pose_frames` are those of odometry."""
    if given:
        return given, "the settings name it"
    known = {*tree.frames, *pose_frames, *sensor_frames}
    reasons = {frame: "by its name" for frame in BASE_FRAMES if frame in known}
    reasons |= {frame: "odometry gives its poses" for frame in pose_frames if frame not in reasons}
    # One that sensors are fixed to goes before one that they are not.
    ordered = sorted(reasons, key=lambda f: all(tree.mount(f, sensor) is None for sensor in sensor_frames))
    if ordered:
        return ordered[0], reasons[ordered[0]]
    roots = (tree.rigid_root(frame) for frame in sensor_frames)
    root = next((root for root in roots if root not in FIXED_FRAMES), None)
    if root is None:
        return None, "the sensors stand still"
    return root, f"all sensors are fixed to it, and no frame is named {BASE_FRAMES[0]}"


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
        points = apply(lidar.mount_T_lidar, sweep.xyz_m)
        dx, dy, dz = (points - lidar.mount_T_lidar[:3, 3]).T
        radius, height = np.hypot(dx, dy), -dz
        around = (radius > ROAD_RADIUS_M[0]) & (radius < ROAD_RADIUS_M[1])
        z = points[around & (height > MIN_SENSOR_HEIGHT_M) & (height < MAX_SENSOR_HEIGHT_M), 2]
        if len(z) < MIN_ROAD_POINTS:
            notes.append(f"{name}: {len(z)} points around and below the sensor, too few to find the road")
            continue
        counts = np.bincount(np.floor((z - z.min()) / ROAD_BIN_M).astype(np.int64))
        mode_m = z.min() + (counts.argmax() + 0.5) * ROAD_BIN_M
        ground_m = float(np.median(z[np.abs(z - mode_m) < 2 * ROAD_BIN_M]))
        side = "below" if ground_m <= 0 else "above"
        where = f"the origin of the ego in the frame '{frame.base}'"
        measured = f"measured in the first sweep of {name} (ego.ground_z_m)"
        return ground_m, (*notes, f"the road is {abs(ground_m):.2f} m {side} {where}, {measured}")
    return 0.0, (*notes, f"the height of the road in '{frame.base}' is not known; taken as 0 (ego.ground_z_m)")


MAP_FRAMES = ("map", "world", "earth", "utm")
# The course of a moving vehicle shows whether the heading of the IMU counts from the east.
MIN_COURSE_STEP_M = 1.0
MAX_COURSE_ERROR_DEG = 30.0
ORIGIN = SimpleNamespace(x=0.0, y=0.0, z=0.0)


class NoPoses(ValueError):
    """A source that gives no poses; the text is the reason."""


@dataclass(frozen=True, eq=False)
class FoundPoses:
    """Poses map_T_base (P, 4, 4) of the vehicle's frame at stamps (P,) ns, strictly increasing, and where they are from."""

    t_ns: NDArray[np.int64]
    map_T_base: Array
    map: MapFrame
    source: str
    topic: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class PoseSources:
    """What poses may come from."""

    bag: Bag
    topics: Mapping[str, Sequence[str]]  # topics by kind
    messages: Mapping[str, Sequence[bytes | None]]  # their messages
    tree: FrameTree
    base: str  # the vehicle's frame
    settings: PoseSettings
    map: MapSettings
    span_ns: tuple[int, int]  # first and last stamp of the sensors
    # Messages by topic that could not be read, of the topics that were tried
    damaged: dict[str, int] = field(default_factory=dict)

    def find(self) -> tuple[FoundPoses | None, list[dict[str, Any]]]:
        """Find the poses of the first source that has some, and what was considered, as JSON."""
        considered: list[dict[str, Any]] = []
        found: FoundPoses | None = None
        why = "the first source of the order that has some" if self.settings.source == "auto" else "by the settings"
        for source, topic, read in self._candidates():
            used, reason = False, "a source before it is used"
            if found is None:
                try:
                    found = self._located(read(topic))
                    used, reason = True, f"{len(found.t_ns)} poses, {why}"
                except NoPoses as reason_against:
                    reason = str(reason_against)
            considered.append({"source": source, "topic": topic, "used": used, "reason": reason})
        return found, considered

    def _located(self, poses: FoundPoses) -> FoundPoses:
        """Move the map's origin near to poses that cover the time of the sensors."""
        if problem := describe_uncovered(poses.t_ns, *self.span_ns):
            raise NoPoses(problem)
        damaged = self.damaged.get(poses.topic, 0)
        if damaged:
            note = f"{poses.topic}: {damaged} of {len(self.messages[poses.topic])} messages are damaged and left out"
            poses = replace(poses, notes=(*poses.notes, note))
        offset = whole_kilometers(poses.map_T_base[:, :3, 3])
        if not offset.any():
            return poses
        x, y, z = offset.tolist()
        shifted = shift_poses(poses.map_T_base, offset)
        return replace(poses, map_T_base=shifted, map=replace(poses.map, offset_m=(x, y, z)))

    def _candidates(self) -> list[tuple[str, str, Callable[[str], FoundPoses]]]:
        wanted, topics = self.settings, self.bag.topics
        above = self.tree.moving_ancestors(self.base)
        mapped = [frame for frame in above if frame in MAP_FRAMES][-1:]
        others = [frame for frame in above[-1:] if frame not in MAP_FRAMES]
        if wanted.fixed_frame:
            mapped, others = [wanted.fixed_frame], []
        ordered: list[tuple[str, str, Callable[[str], FoundPoses]]] = [("tf", frame, self._from_tf) for frame in mapped]
        for kind, read in (("odometry", self._from_odometry), ("pose", self._from_poses), ("gnss", self._from_gnss)):
            # Poses in the map go before those in the frame of an odometry, then those that come more often.
            named = sorted(
                self.topics.get(kind, ()),
                key=lambda n: (self.bag.frame_id(topics[n]) not in MAP_FRAMES, -len(topics[n])),
            )
            ordered += [(kind, name, read) for name in named]
        ordered += [("tf", frame, self._from_tf) for frame in others]
        if wanted.source != "auto":
            ordered = [c for c in ordered if c[0] == wanted.source]
        return [c for c in ordered if wanted.topic in ("", c[1]) or c[0] == "tf"]

    def _decoded(self, name: str) -> tuple[list[Any], NDArray[np.int64]]:
        """Messages of a topic that can be read, and their stamps (N,); how many cannot is kept in `damaged`."""
        topic, messages = self.bag.topics[name], []
        for i, raw in enumerate(self.messages[name]):
            if raw is None:
                continue
            try:
                messages.append(decode_bytes(topic, raw, self.bag.where(topic, i)))
            except RecordError:
                continue
        self.damaged[name] = len(self.messages[name]) - len(messages)
        stamps = [int(m.header.stamp.sec) * 1_000_000_000 + int(m.header.stamp.nanosec) for m in messages]
        return messages, np.array(stamps, dtype=np.int64)

    def _local_map(self) -> MapFrame:
        given = self.map
        return MapFrame(given.latitude_deg, given.longitude_deg, given.altitude_m, given.projection)

    def _from_tf(self, fixed: str) -> FoundPoses:
        track = self.tree.track(fixed, self.base)
        if track is None:
            raise NoPoses(f"no chain of transforms from '{fixed}' to '{self.base}'")
        return FoundPoses(track.t_ns, track.map_T_ego, self._local_map(), "tf", fixed)

    def _from_odometry(self, name: str) -> FoundPoses:
        messages, stamps = self._decoded(name)
        child = next((printable(m.child_frame_id).lstrip("/") for m in messages), "")
        child_T_base, note = self.tree.mount(child, self.base), ""
        if child_T_base is None:
            if child:
                raise NoPoses(f"it is of the frame '{child}', from which there is no transform to '{self.base}'")
            note = f"{name}: names no child_frame_id; taken as the pose of '{self.base}'"
            child_T_base = np.eye(4)
        poses = [m.pose.pose for m in messages]
        return self._poses_from_messages("odometry", name, stamps, poses, child_T_base, note)

    def _from_poses(self, name: str) -> FoundPoses:
        messages, stamps = self._decoded(name)
        covariance = self.bag.topics[name].msgtype.endswith("PoseWithCovarianceStamped")
        poses = [m.pose.pose if covariance else m.pose for m in messages]
        note = f"{name}: does not say whose pose it is; taken as that of '{self.base}'"
        return self._poses_from_messages("pose", name, stamps, poses, np.eye(4), note)

    def _poses_from_messages(
        self, source: str, name: str, stamps: NDArray[np.int64], messages: list[Any], child_T_base: Array, note: str
    ) -> FoundPoses:
        poses = [pose_of(m.position, m.orientation) for m in messages]
        valid = np.array([p is not None for p in poses], dtype=bool)
        if not valid.any():
            raise NoPoses("none of its orientations is a rotation")
        notes, known = [note] if note else [], np.array([p for p in poses if p is not None])
        keep = strictly_increasing(stamps[valid], name, notes)
        if not valid.all():
            notes.append(f"{name}: {int((~valid).sum())} of {len(valid)} poses are not finite or not rigid; dropped")
        base = known[keep] @ child_T_base
        return FoundPoses(stamps[valid][keep], base, self._local_map(), source, name, tuple(notes))

    def _from_gnss(self, name: str) -> FoundPoses:
        imu, t_ns, base_R = self._orientations(name)
        fixes, stamps = self._decoded(name)
        rows = np.array([[m.latitude, m.longitude, m.altitude] for m in fixes]).reshape(-1, 3)
        good = np.isfinite(rows).all(axis=1) & np.array([int(m.status.status) >= 0 for m in fixes], dtype=bool)
        good &= (np.abs(rows[:, 0]) < 90.0) & (np.abs(rows[:, 1]) <= 360.0)
        problems = list[str]()
        keep = strictly_increasing(stamps[good], name, problems)
        rows, stamps = rows[good][keep], stamps[good][keep]
        rotation, valid = PoseTrack(t_ns, transform(base_R, np.zeros(3))).at(stamps)
        if not (good.all() and valid.all()):
            problems.append(f"{name}: {len(good) - int(valid.sum())} of {len(good)} fixes lack position or orientation")
        rows, stamps, rotation = rows[valid], stamps[valid], rotation[valid]
        if len(rows) < MIN_POSES:
            raise NoPoses(f"{len(rows)} fixes with an orientation of {imu}")
        antenna = self.bag.frame_id(self.bag.topics[name])
        base_T_antenna = self.tree.mount(self.base, antenna)
        if base_T_antenna is None:
            problems.append(f"{name}: no transform from '{antenna}' to '{self.base}'; the antenna is taken to be there")
            base_T_antenna = np.eye(4)
        map_frame = map_frame_of(self._local_map(), *(float(v) for v in rows[0]))
        pitch = -np.arcsin(np.clip(rotation[:, 2, 0], -1.0, 1.0))
        angles = np.stack([np.arctan2(rotation[:, 2, 1], rotation[:, 2, 2]), pitch, yaw_of(rotation)], axis=1)
        poses = poses_from_geodetic(map_frame, rows, angles, where=f"{name}, map.projection")
        poses[:, :3, 3] -= (poses[:, :3, :3] @ base_T_antenna[:3, 3:])[..., 0]
        notes = (*problems, *_course_notes(poses, imu))
        return FoundPoses(stamps, poses, map_frame, "gnss", name, notes)

    def _orientations(self, fix: str) -> tuple[str, NDArray[np.int64], Array]:
        """Topic, stamps (N,) and rotations (N, 3, 3) of the vehicle's frame in east, north, up, by the best IMU."""
        topics = [self.settings.imu] if self.settings.imu else list(self.topics.get("imu", ()))
        parent = fix.rpartition("/")[0]
        # The one in the namespace of the fixes comes first, then the one with the most messages.
        reasons = []
        for name in sorted(topics, key=lambda n: (n.rpartition("/")[0] != parent, -len(self.bag.topics[n]))):
            messages, stamps = self._decoded(name)
            messages_frame = next((printable(m.header.frame_id).lstrip("/") for m in messages), "")
            imu_T_base = self.tree.mount(messages_frame, self.base)
            if imu_T_base is None:
                reasons.append(f"no transform from '{messages_frame}' of {name} to '{self.base}'")
                continue
            poses = [None if m.orientation_covariance[0] < 0 else pose_of(ORIGIN, m.orientation) for m in messages]
            valid = np.array([p is not None for p in poses], dtype=bool)
            if valid.sum() >= MIN_POSES:
                rotations = np.array([p for p in poses if p is not None])[:, :3, :3]
                keep = strictly_increasing(stamps[valid], name, [])
                return name, stamps[valid][keep], rotations[keep] @ imu_T_base[:3, :3]
            reasons.append(f"{name} gives no orientation")
        raise NoPoses("; ".join(reasons) or "there is no Imu that gives the orientation")


def _course_notes(poses: Array, imu: str) -> tuple[str, ...]:
    """Note when the heading of the IMU is not the direction of travel."""
    position, chosen = poses[:, :2, 3], [0]
    for k in range(1, len(poses)):
        if np.linalg.norm(position[k] - position[chosen[-1]]) >= MIN_COURSE_STEP_M:
            chosen.append(k)
    step = np.diff(position[chosen], axis=0)
    if len(step) < MIN_POSES:
        return ()
    off_deg = np.degrees(np.median(wrap_angle(yaw_of(poses[chosen[:-1]]) - np.arctan2(step[:, 1], step[:, 0]))))
    if abs(off_deg) <= MAX_COURSE_ERROR_DEG:
        return ()
    asked = "is its orientation of axes east, north, up (REP 103)?"
    advice = "ego.rotation_wxyz or a static transform of its frame in the settings can correct it"
    return (f"{imu}: its heading is {off_deg:.0f} degrees off the direction of travel; {asked} {advice}",)
