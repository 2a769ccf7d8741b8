"""The tree of coordinate frames: /tf, /tf_static and what the settings add."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import LogError
from log2sim.geometry import Array, PoseTrack, inverse, rotation_from_quaternion, transform
from log2sim.logs.pose_checks import MAX_POSITION_M
from log2sim.logs.ros.containers import printable
from log2sim.logs.ros.settings import StaticTransform

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
    """Frames by name; each has at most one parent, which is checked where a frame is used.

    Parameters
    ----------
    where : str
        Names the recording in errors.
    """

    def __init__(self, where: str) -> None:
        self._where = where
        self._rows: dict[str, dict[str, list[tuple[int, Numbers]]]] = {}
        self._edges: dict[str, dict[str, Edge]] = {}
        self.refused = 0
        """Transforms that were left out, since their values are not finite or their quaternions no rotations."""

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
        """Compute dst_T_src (4, 4) of frames that do not move against each other; None when they do or are not connected.

        Raises
        ------
        LogError
            For a frame on the way that has two parents, and for a cycle.
        """
        if dst == src:
            return np.eye(4)
        src_up, dst_up = self._static_ancestors(src), self._static_ancestors(dst)
        common = next((frame for frame in src_up if frame in dst_up), None)
        return None if common is None else inverse(dst_up[common]) @ src_up[common]

    def track(self, fixed: str, frame: str) -> PoseTrack | None:
        """Poses of a frame in one of its ancestors, at the stamps of the edge that was sent most often.

        Other edges are interpolated, and held before their first and after their last stamp, as a localization that
        corrects an odometry now and then is used.
        """
        edges = []
        for _, edge in self._path_up(frame):
            edges.append(edge)
            if edge.parent == fixed:
                break
        else:
            return None
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
