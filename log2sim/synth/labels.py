"""Who sees whom: labels in images and in space, and when an agent counts as visible."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import ImageLabels, Labels, Stream
from log2sim.geometry import NS_PER_S, Array, Camera, apply, box_corners, inverse, nearest_index, project
from log2sim.synth.actors import Actor, EgoMotion
from log2sim.synth.cameras import frame_stamps
from log2sim.synth.scene import Scene

MIN_UNOCCLUDED = 1 / 3
MIN_BOX_INSIDE = 0.5
MIN_LIDAR_POINTS = 20
MIN_LABEL_PX = 8.0  # a smaller box is no label


@dataclass(frozen=True, eq=False)
class Sighting:
    """One camera frame: by actor the unoccluded share (A,), the share of its box inside the image (A,), the box (A, 4)."""

    t_ns: int
    unoccluded: Array
    inside: Array
    box_px: Array


def sightings(
    scene: Scene, cameras: Mapping[str, Camera], ego: EgoMotion, actors: tuple[Actor, ...], backdrop: Any
) -> dict[str, list[Sighting]]:
    """Look through every camera at every frame."""
    from log2sim.synth.render import segment

    out: dict[str, list[Sighting]] = {}
    for spec in scene.camera:
        camera = cameras[spec.name]
        out[spec.name] = []
        for t_ns in frame_stamps(spec, scene):
            t_s = (int(t_ns) - scene.start_ns) / NS_PER_S
            map_T_cam = ego.map_T_ego_ns(np.array([t_ns]))[0] @ camera.mount_T_cam
            seen = segment(camera, map_T_cam, backdrop, actors, t_s)
            unoccluded = np.array([0.0 if s is None else s.visible_px / s.silhouette_px for s in seen])
            boxes = np.array([np.full(4, np.nan) if s is None else s.box_px for s in seen]).reshape(-1, 4)
            inside = np.array([_box_inside(camera, inverse(map_T_cam), a, t_s) for a in actors])
            out[spec.name].append(Sighting(int(t_ns), unoccluded, inside, boxes))
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


def visible_at(
    t_s: Array,
    scene: Scene,
    seen: Mapping[str, list[Sighting]],
    streams: Mapping[str, Stream],
    casts: Callable[[str, int], Any],
    count: int,
) -> NDArray[np.bool_]:
    """Mask (T, A): the frame of one camera and the sweep of one LiDAR nearest in time both show the agent well."""
    t_ns = scene.start_ns + np.rint(t_s * NS_PER_S).astype(np.int64)
    by_camera = np.zeros((len(t_s), count), dtype=bool)
    for frames in seen.values():
        if not frames:
            continue
        nearest = nearest_index(np.array([f.t_ns for f in frames]), t_ns)
        by_camera |= np.array([(f.unoccluded >= MIN_UNOCCLUDED) & (f.inside >= MIN_BOX_INSIDE) for f in frames])[
            nearest
        ]
    by_lidar = np.zeros_like(by_camera)
    for spec in scene.lidar:
        stamps = streams[spec.name].t_ns
        if len(stamps) == 0:
            continue
        hits = [np.bincount(h[h >= 0], minlength=count) for h in (casts(spec.name, i).hit for i in range(len(stamps)))]
        by_lidar |= (np.array(hits) >= MIN_LIDAR_POINTS)[
            nearest_index(stamps - round(NS_PER_S / spec.rate_hz / 2), t_ns)
        ]
    return by_camera & by_lidar


def labels_2d(seen: Mapping[str, list[Sighting]], actors: tuple[Actor, ...]) -> dict[str, ImageLabels]:
    """Boxes around the visible parts of agents that are at least a third unoccluded, by camera."""
    category = np.array([a.spec.category for a in actors])
    out = {}
    for name, frames in seen.items():
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
    scene: Scene, seen: Mapping[str, list[Sighting]], actors: tuple[Actor, ...], cameras: Mapping[str, Camera]
) -> Labels | None:
    """Boxes of all agents at the frames of the first camera."""
    if not scene.camera or not actors:
        return None
    frames = seen[scene.camera[0].name]
    t_ns = np.array([f.t_ns for f in frames], dtype=np.int64)
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
