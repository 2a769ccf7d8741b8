"""Poses of the vehicle in a recording: /tf, odometry, poses, or GNSS with an IMU, and why which of them is taken.

The first source that gives at least two poses counts, in this order: /tf from a frame of the map; Odometry; PoseStamped and
PoseWithCovarianceStamped; NavSatFix with the orientations of an Imu; /tf from any other frame, such as "odom". So a localization
goes before dead reckoning, and what was filtered goes before raw fixes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import MapFrame
from log2sim.errors import RecordError
from log2sim.geometry import Array, PoseTrack, shift_poses, transform, whole_kilometers, wrap_angle, yaw_of
from log2sim.logs.ros.bag import Bag
from log2sim.logs.ros.containers import printable
from log2sim.logs.ros.frames import FrameTree, pose_of
from log2sim.logs.ros.messages import MIN_POSES, MapSettings, PoseSettings, decode_bytes, describe_uncovered
from log2sim.logs.stamps import strictly_increasing

MAP_FRAMES = ("map", "world", "earth", "utm")
# The course of a moving vehicle shows whether the heading of the IMU counts from the east.
MIN_COURSE_STEP_M = 1.0
MAX_COURSE_ERROR_DEG = 30.0
MAX_LATITUDE_DEG, MAX_LONGITUDE_DEG = 90.0, 360.0


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
        for source, topic, read in self._candidates():
            used, reason = False, "a source before it is used"
            if found is None:
                try:
                    found = self._located(read(topic))
                    used, count = True, f"{len(found.t_ns)} poses, "
                    reason = count + (
                        "the first source of the order that has some"
                        if self.settings.source == "auto"
                        else "by the settings"
                    )
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
        wanted = self.settings
        above = self.tree.moving_ancestors(self.base)
        if wanted.fixed_frame:
            mapped, others = [wanted.fixed_frame], []
        else:
            mapped = [frame for frame in above if frame in MAP_FRAMES][-1:]
            others = [frame for frame in above[-1:] if frame not in MAP_FRAMES]
        topics = self.bag.topics
        # Poses in the map go before those in the frame of an odometry, then those that come more often.
        by_count = {
            kind: sorted(names, key=lambda n: (self.bag.frame_id(topics[n]) not in MAP_FRAMES, -len(topics[n])))
            for kind, names in self.topics.items()
            if kind in ("odometry", "pose", "gnss")
        }
        ordered: list[tuple[str, str, Callable[[str], FoundPoses]]] = [("tf", frame, self._from_tf) for frame in mapped]
        for kind, read in (("odometry", self._from_odometry), ("pose", self._from_poses), ("gnss", self._from_gnss)):
            ordered += [(kind, name, read) for name in by_count.get(kind, ())]
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
        child_T_base = self.tree.mount(child, self.base)
        notes: tuple[str, ...] = ()
        if child_T_base is None:
            if child:
                raise NoPoses(f"it is of the frame '{child}', from which there is no transform to '{self.base}'")
            notes = (f"{name}: names no child_frame_id; taken as the pose of '{self.base}'",)
            child_T_base = np.eye(4)
        return self._poses_from_messages(name, stamps, [m.pose.pose for m in messages], child_T_base, notes)

    def _from_poses(self, name: str) -> FoundPoses:
        messages, stamps = self._decoded(name)
        covariance = self.bag.topics[name].msgtype.endswith("PoseWithCovarianceStamped")
        poses = [m.pose.pose if covariance else m.pose for m in messages]
        notes = (f"{name}: does not say whose pose it is; taken as that of '{self.base}'",)
        return self._poses_from_messages(name, stamps, poses, np.eye(4), notes)

    def _poses_from_messages(
        self, name: str, stamps: NDArray[np.int64], messages: list[Any], child_T_base: Array, notes: tuple[str, ...]
    ) -> FoundPoses:
        source = "odometry" if name in self.topics.get("odometry", ()) else "pose"
        poses = [pose_of(m.position, m.orientation) for m in messages]
        valid = np.array([p is not None for p in poses], dtype=bool)
        if not valid.any():
            raise NoPoses("none of its orientations is a rotation")
        map_T_child = np.array([p for p in poses if p is not None])
        problems = list[str]()
        keep = strictly_increasing(stamps[valid], name, problems)
        if not valid.all():
            problems.append(
                f"{name}: {int((~valid).sum())} of {len(valid)} poses are not finite or no rotations; dropped"
            )
        base = map_T_child[keep] @ child_T_base
        return FoundPoses(stamps[valid][keep], base, self._local_map(), source, name, (*notes, *problems))

    def _from_gnss(self, name: str) -> FoundPoses:
        from log2sim.logs.stamps import map_frame_of, poses_from_geodetic

        imu, t_ns, base_R = self._orientations(name)
        fixes, stamps = self._decoded(name)
        rows = np.array([[m.latitude, m.longitude, m.altitude] for m in fixes]).reshape(-1, 3)
        good = np.isfinite(rows).all(axis=1) & np.array([int(m.status.status) >= 0 for m in fixes], dtype=bool)
        good &= (np.abs(rows[:, 0]) < MAX_LATITUDE_DEG) & (np.abs(rows[:, 1]) <= MAX_LONGITUDE_DEG)
        problems = list[str]()
        keep = strictly_increasing(stamps[good], name, problems)
        rows, stamps = rows[good][keep], stamps[good][keep]
        rotation, valid = PoseTrack(t_ns, transform(base_R, np.zeros(3))).at(stamps)
        if not (good.all() and valid.all()):
            problems.append(
                f"{name}: {len(good) - int(valid.sum())} of {len(good)} fixes have no position or no orientation"
            )
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
            poses = [None if m.orientation_covariance[0] < 0 else pose_of(_Zero, m.orientation) for m in messages]
            valid = np.array([p is not None for p in poses], dtype=bool)
            if valid.sum() >= MIN_POSES:
                rotations = np.array([p for p in poses if p is not None])[:, :3, :3]
                keep = strictly_increasing(stamps[valid], name, [])
                return name, stamps[valid][keep], rotations[keep] @ imu_T_base[:3, :3]
            reasons.append(f"{name} gives no orientation")
        raise NoPoses("; ".join(reasons) or "there is no Imu that gives the orientation")


class _Zero:
    x = y = z = 0.0


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
    return (
        f"{imu}: its heading is {off_deg:.0f} degrees off the direction of travel; is its orientation of axes east, north, up "
        "(REP 103)? ego.rotation_wxyz or a static transform of its frame in the settings can correct it",
    )
