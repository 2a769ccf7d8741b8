"""Labels in images and in space, and when an agent counts as visible."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import ImageLabels, Labels
from log2sim.geometry import NS_PER_S, Array, Camera, apply, box_corners, inverse, project
from log2sim.synth.actors import Actor, MovingScene
from log2sim.synth.cameras import frame_stamps
from log2sim.synth.raycast import sweep_stamps
from log2sim.synth.scene import Scene

MIN_UNOCCLUDED = 1 / 3
MIN_BOX_INSIDE = 0.5
MIN_LIDAR_POINTS = 20
MIN_LABEL_PX = 8.0  # a smaller box is no label


@dataclass(frozen=True, eq=False)
class FrameVisibility:
    """Visibility of the actors in one camera frame.

    Attributes
    ----------
    t_ns : int
    unoccluded : (A,) float64
        Share of the silhouette that is visible.
    inside : (A,) float64
        Share of the projected box inside the image.
    box_px : (A, 4) float64, px
        Box of the visible part; NaN without one.
    """

    t_ns: int
    unoccluded: Array
    inside: Array
    box_px: Array


def visibility_by_camera(
    moving: MovingScene, cameras: Mapping[str, Camera], backdrop: Any
) -> dict[str, list[FrameVisibility]]:
    """Segment every frame of every camera."""
    from log2sim.synth.bodies import Body
    from log2sim.synth.render import SceneInstant, segment

    out: dict[str, list[FrameVisibility]] = {}
    for spec in moving.scene.camera:
        camera = cameras[spec.name]
        out[spec.name] = []
        for t_ns in frame_stamps(spec, moving.scene):
            t_s = moving.seconds(t_ns)
            map_T_cam = moving.map_T_mount(camera.mount, np.array([t_ns]))[0] @ camera.mount_T_cam
            bodies = [Body.of(actor, t_s) for actor in moving.seen_from(spec.mount)]
            parts = segment(camera, map_T_cam, SceneInstant(backdrop, bodies))[: len(moving.actors)]
            unoccluded = np.array([0.0 if p is None else p.visible_px / p.silhouette_px for p in parts])
            boxes = np.array([np.full(4, np.nan) if p is None else p.box_px for p in parts]).reshape(-1, 4)
            inside = np.array([_box_inside(camera, inverse(map_T_cam), a, t_s) for a in moving.actors])
            out[spec.name].append(FrameVisibility(int(t_ns), unoccluded, inside, boxes))
    return out


def _box_inside(camera: Camera, cam_T_map: Array, actor: Actor, t_s: float) -> float:
    """Share of the rectangle around the projected 3D box that lies inside the image; 0 unless all corners are ahead."""
    state = actor.at(t_s)
    uv, _ = project(camera, apply(cam_T_map, box_corners(state.center_m, actor.spec.box_m, state.yaw_rad)[0]))
    if not np.all(np.isfinite(uv)):
        return 0.0
    low, high = uv.min(0), uv.max(0)
    size = np.array([camera.width_px, camera.height_px])
    inside = np.clip(np.minimum(high, size) - np.maximum(low, 0), 0, None)
    return float(inside.prod() / (high - low).prod())


@dataclass(frozen=True, eq=False)
class LidarVisibility:
    """Points of one LiDAR on the actors.

    Attributes
    ----------
    t_ns : (F,) int64
        Middles of the sweeps.
    points : (F, A) int
        Points on each actor.
    """

    t_ns: NDArray[np.int64]
    points: NDArray[np.intp]


def visible_at(
    t_ns: NDArray[np.int64],
    frames: Mapping[str, Sequence[FrameVisibility]],
    sweeps: Mapping[str, LidarVisibility],
    count: int,
) -> NDArray[np.bool_]:
    """Decide which of `count` actors are visible: mask (T, A) at stamps (T,).

    An actor is visible when the frame of one camera and the sweep of one LiDAR nearest in time both show it well. Without
    cameras, or without LiDARs, the others decide.
    """
    by_camera = np.full((len(t_ns), count), not frames)
    for parts in frames.values():
        if parts:
            shown = np.array([(f.unoccluded >= MIN_UNOCCLUDED) & (f.inside >= MIN_BOX_INSIDE) for f in parts])
            by_camera |= shown[_nearest(np.array([f.t_ns for f in parts]), t_ns)]
    by_lidar = np.full_like(by_camera, not sweeps)
    for sweep in sweeps.values():
        if len(sweep.t_ns):
            by_lidar |= (sweep.points >= MIN_LIDAR_POINTS)[_nearest(sweep.t_ns, t_ns)]
    return np.asarray(by_camera & by_lidar)


def _nearest(stamps: NDArray[np.int64], t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.asarray(np.abs(stamps[None, :] - t_ns[:, None]).argmin(1))


def labels_2d(
    frames_by_camera: Mapping[str, list[FrameVisibility]], actors: tuple[Actor, ...]
) -> dict[str, ImageLabels]:
    """Boxes around the visible parts of agents that are at least a third unoccluded, by camera."""
    category = np.array([a.spec.category for a in actors])
    out = {}
    for name, frames in frames_by_camera.items():
        t_ns, boxes, categories = [], [], []
        for frame in frames:
            big = np.nan_to_num(frame.box_px[:, 2:] - frame.box_px[:, :2]).min(1) >= MIN_LABEL_PX
            rows = np.flatnonzero((frame.unoccluded >= MIN_UNOCCLUDED) & big)
            t_ns += [frame.t_ns] * len(rows)
            boxes.append(frame.box_px[rows])
            categories.append(category[rows])
        out[name] = ImageLabels(
            np.array(t_ns, dtype=np.int64),
            np.concatenate(boxes).reshape(-1, 4),
            np.concatenate(categories).astype("<U16"),
        )
    return out


def labels_3d(
    scene: Scene, frames_by_camera: Mapping[str, list[FrameVisibility]], actors: tuple[Actor, ...]
) -> Labels | None:
    """Boxes of all agents at the frames of the first camera, without one at the sweeps of the first LiDAR."""
    if not actors or not (scene.camera or scene.lidar):
        return None
    if scene.camera:
        t_ns = np.array([f.t_ns for f in frames_by_camera[scene.camera[0].name]], dtype=np.int64)
    else:
        t_ns = sweep_stamps(scene.lidar[0], scene)
    t_s = (t_ns - scene.start_ns) / NS_PER_S
    states = [a.at(t_s) for a in actors]
    return Labels(
        t_ns=np.tile(t_ns, len(actors)),
        track_id=np.repeat([a.spec.id for a in actors], len(t_ns)),
        category=np.repeat([a.spec.category for a in actors], len(t_ns)),
        center_m=np.concatenate([s.center_m for s in states]),
        size_m=np.repeat([a.spec.box_m for a in actors], len(t_ns), axis=0),
        yaw_rad=np.concatenate([s.yaw_rad for s in states]),
        visible=None,
    )
