"""Which ground a synthetic log shows: cells that a beam of a LiDAR met, or that a camera saw past all that stands there."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import NS_PER_S, Array, Camera, apply, inverse, rotation_from_rpy, transform
from log2sim.synth import raycast
from log2sim.synth.actors import MovingScene
from log2sim.synth.cameras import frame_stamps

CELL_M = 1.0
MAX_RANGE_M = 40.0
STEP_S = 0.5  # between instants that are looked at
MIN_DEPTH_M = 0.5

Cells = NDArray[np.int64]
Caster = Callable[[str, int], raycast.LabeledSweep]


def seen_ground(moving: MovingScene, cameras: Mapping[str, Camera], cast: Caster) -> dict[str, Any]:
    """Return the cells as runs along x: `cell_m`, and rows [column of the first cell, row, number of cells].

    Cell (i, j) reaches from (i, j) to (i + 1, j + 1) times `cell_m` in the map.
    """
    parts = [*_shown(moving, cameras), *_met(moving, cast)]
    cells = np.unique(np.concatenate([np.zeros((0, 2), np.int64), *parts]), axis=0)
    cells = cells[np.lexsort((cells[:, 0], cells[:, 1]))]
    new = np.ones(len(cells), dtype=bool)
    new[1:] = (np.diff(cells[:, 1]) != 0) | (np.diff(cells[:, 0]) != 1)
    first = np.flatnonzero(new)
    count = np.diff(np.append(first, len(cells)))
    return {"cell_m": CELL_M, "runs": np.column_stack([cells[first], count]).tolist()}


def _every(t_ns: NDArray[np.int64]) -> NDArray[np.intp]:
    """Choose records at least `STEP_S` apart."""
    _, first = np.unique((t_ns - t_ns[:1]) // int(STEP_S * NS_PER_S), return_index=True)
    return np.asarray(first)


def _met(moving: MovingScene, cast: Caster) -> Iterator[Cells]:
    """Yield cells (N, 2) that beams met."""
    for spec in moving.scene.lidar:
        for i in _every(raycast.sweep_stamps(spec, moving.scene)):
            labeled = cast(spec.name, int(i))
            on = (labeled.hit == raycast.GROUND) & (np.linalg.norm(labeled.sweep.xyz_m, axis=1) < MAX_RANGE_M)
            stamps = np.full(1, labeled.sweep.stamp_ns) if labeled.sweep.t_ns is None else labeled.sweep.t_ns[on]
            moments, column = np.unique(stamps, return_inverse=True)
            map_T_lidar = moving.map_T_mount(spec.mount, moments) @ raycast.mount_T_lidar(spec)
            xyz = labeled.sweep.xyz_m[on].astype(np.float64)
            at = np.einsum("nij,nj->ni", map_T_lidar[column, :3, :3], xyz) + map_T_lidar[column, :3, 3]
            yield np.unique(np.floor(at[:, :2] / CELL_M).astype(np.int64), axis=0)


def _shown(moving: MovingScene, cameras: Mapping[str, Camera]) -> Iterator[Cells]:
    """Yield cells (N, 2) whose middles cameras show."""
    for spec in moving.scene.camera:
        camera, stamps = cameras[spec.name], frame_stamps(spec, moving.scene)
        poses = moving.map_T_mount(camera.mount, stamps) @ camera.mount_T_cam
        for i in _every(stamps):
            yield _in_view(moving, camera, poses[i], int(stamps[i]))


def _in_view(moving: MovingScene, camera: Camera, map_T_cam: Array, t_ns: int) -> Cells:
    eye = map_T_cam[:3, 3]
    reach = np.arange(-int(MAX_RANGE_M / CELL_M), int(MAX_RANGE_M / CELL_M) + 1)
    i, j = np.meshgrid(reach, reach)
    cells = np.column_stack([i.ravel(), j.ravel()]) + np.floor(eye[:2] / CELL_M).astype(np.int64)
    middle = np.column_stack([(cells + 0.5) * CELL_M, np.zeros(len(cells))])
    p = apply(inverse(map_T_cam), middle)
    ahead = p[:, 2] > MIN_DEPTH_M
    uv = np.full((len(p), 2), -1.0)
    uv[ahead] = p[ahead, :2] / p[ahead, 2:] @ camera.K[:2, :2].T + camera.K[:2, 2]
    inside = ahead & (uv >= 0).all(1) & (uv < [camera.width_px, camera.height_px]).all(1)
    inside &= np.linalg.norm(middle - eye, axis=1) < MAX_RANGE_M
    cells, middle = cells[inside], middle[inside]
    free = np.ones(len(cells), dtype=bool)
    ray = middle - eye
    for map_T_box, size in _boxes(moving, camera.mount, t_ns):
        box_T_map = inverse(map_T_box)
        start = np.tile(apply(box_T_map, eye[None]), (len(ray), 1))
        hit = raycast.slab_distance(size, start, ray @ box_T_map[:3, :3].T)
        free &= ~(hit < 1.0)
    return cells[free]


def _boxes(moving: MovingScene, mount: Any, t_ns: int) -> Iterator[tuple[Array, Array]]:
    """Yield poses and sizes (3,) of all that hides the ground."""
    for building in moving.scene.building:
        size = np.array(building.size_m)
        turn = rotation_from_rpy(0.0, 0.0, np.deg2rad(building.yaw_deg))
        yield transform(turn, np.array([*building.center, size[2] / 2])), size
    for actor in moving.seen_from(mount):
        yield actor.at(moving.seconds(t_ns)).map_T_agent()[0], np.array(actor.spec.box_m)
