"""What stands on the ground at seams between cameras, or hides it, by LiDAR points and by boxes in the images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.geometry import NS_PER_S, Array, Camera, apply, inverse
from log2sim.perception.first_pass import Observations, base_pose
from log2sim.perception.homography.rig import Rig
from log2sim.perception.homography.rig_rows import RigRows, heights_of
from log2sim.perception.homography.seams import CELL_M, LENGTH_M, SeamPlace, pixels_of
from log2sim.perception.sync import Schedule

# Ground points within this distance of a patch, so much time before and after, show that it lies on the ground.
NEAR_M, NEAR_S, MIN_GROUND_POINTS = 3.0, 2.0, 3
# Ground farther than this from the plane of the road is shown elsewhere by cameras in other places: half a usual curb of 0.15 m
# tells a sidewalk from the crown of a road.
MAX_STEP_M = 0.075
# LiDAR points above the ground stand for what is within this distance: one is kept of each voxel, and between the rings of a
# LiDAR with 32 lines lies 0.3 m on an object 15 m away.
POINT_REACH_M = 0.3
# Of the height of a camera: points above it hide no ground from it.
MAX_HEIGHT_SHARE = 0.95


@dataclass(frozen=True, eq=False)
class Standing:
    """What is known of the ground around the cameras at a tick, in the ground frame of the tick.

    Attributes
    ----------
    cameras : mapping of str to (3,) float64
        Positions over the ground, m.
    boxes_px : mapping of str to (M, 4) float64
        Of detected objects.
    points : (P, 3) float64 or None
        LiDAR points above the ground, heights over the ground; None without LiDAR.
    ground : (G, 3) float64
        LiDAR points on the ground within seconds.
    """

    cameras: Mapping[str, Array]
    boxes_px: Mapping[str, Array]
    points: Array | None
    ground: Array

    def hidden(
        self, place: SeamPlace, cameras: Mapping[str, Camera], roads: Mapping[str, Array], road_z_m: float | None = None
    ) -> dict[str, NDArray[np.bool_]] | None:
        """Mark the cells (R, C) of a place at which a camera sees something else than the ground; None where it is no road.

        `road_z_m` is the height of the road there, in the ground frame; without it any ground is taken for road.
        """
        if self.points is not None and not self._is_road(place, road_z_m):
            return None
        xy = place.cells()
        out = {}
        for name in (place.first, place.second):
            hidden = self._hidden_by_points(place, name, xy.shape[:2])
            if len(self.boxes_px[name]):
                uv, _ = pixels_of(cameras[name], roads[name], xy)
                low, high = uv.min(axis=(0, 1)), uv.max(axis=(0, 1))
                for box in self.boxes_px[name]:
                    if (box[:2] < high).all() and (box[2:] > low).all():
                        hidden |= ((uv >= box[:2]) & (uv <= box[2:])).all(axis=-1)
            out[name] = hidden
        return out

    def _is_road(self, place: SeamPlace, road_z_m: float | None) -> bool:
        near = self.ground[np.hypot(*(self.ground[:, :2] - place.center_m).T) < NEAR_M]
        if len(near) < MIN_GROUND_POINTS:
            return False
        return road_z_m is None or abs(float(np.median(near[:, 2])) - road_z_m) < MAX_STEP_M

    def _hidden_by_points(self, place: SeamPlace, name: str, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        marked = np.zeros(shape, dtype=np.uint8)
        xy = self._covered_xy[name]
        reach = np.hypot(LENGTH_M, place.width_m) / 2
        near = xy[(np.abs(xy - place.center_m) < reach).all(axis=1)]
        local = (near - place.center_m) @ place.axes.T + [LENGTH_M / 2, place.width_m / 2]
        index = np.floor(local / CELL_M).astype(np.int64)
        inside = ((index >= 0) & (index < shape)).all(axis=1)
        marked[index[inside, 0], index[inside, 1]] = 1
        side = 2 * int(POINT_REACH_M / CELL_M) + 1
        return np.asarray(cv2.dilate(marked, np.ones((side, side), np.uint8)) > 0)

    @cached_property
    def _covered_xy(self) -> dict[str, Array]:
        """Ground (N, 2) on which the points stand, and that which they hide from a camera, by camera."""
        out = {}
        for name, (x, y, height) in self.cameras.items():
            points = np.zeros((0, 3)) if self.points is None else self.points
            lower = points[points[:, 2] < MAX_HEIGHT_SHARE * height]
            at = np.array([x, y])
            behind = at + (lower[:, :2] - at) * (height / (height - lower[:, 2]))[:, None]
            out[name] = np.concatenate([lower[:, :2], behind])
        return out


def ground_points(log: Log, schedule: Schedule, observed: Observations) -> tuple[NDArray[np.int64], Array]:
    """Collect the LiDAR's ground points of all cameras and ticks: stamps (G,) of their ticks, and positions (G, 3), map frame.

    Their heights are those at which the rays of the cameras pass over them.
    """
    stamps, places = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3))]
    for camera, parts in observed.ground.items():
        rig = Rig.of({camera: log.cameras[camera]}, 0.0)
        for rows in (RigRows.of(rig, {camera: part}, 1.0, 0.1) for part in parts if len(part)):
            if len(rows):
                tick = int(rows.tick[0])
                pose = base_pose(log, int(log.streams[camera].t_ns[schedule.frames[camera][tick]]))
                xyz = np.column_stack([rows.xy + rig.origin_m[:2], heights_of(rig, rows)[0]])
                places.append(apply(pose, xyz))
                stamps.append(np.full(len(rows), schedule.t_ns[tick]))
    return np.concatenate(stamps), np.concatenate(places)


def standing_at(
    log: Log, schedule: Schedule, observed: Observations, ground: tuple[NDArray[np.int64], Array], tick: int
) -> Standing:
    """Collect what is known of a tick; `ground` comes from `ground_points`."""
    t_ns = int(schedule.t_ns[tick])
    base_T_map = inverse(base_pose(log, t_ns))
    cameras = {}
    for name, index in schedule.frames.items():
        pose, known = log.map_T_sensor(name, log.streams[name].t_ns[max(int(index[tick]), 0)])
        if index[tick] >= 0 and known[0]:
            cameras[name] = (base_T_map @ pose[0])[:3, 3] - [0.0, 0.0, log.ground_z_ego_m]
    m = observed.measurements[tick]
    points = None
    obstacles = observed.obstacles[tick] if tick < len(observed.obstacles) else None
    if obstacles is not None:
        points = apply(base_T_map, obstacles.xyz.astype(np.float64) + obstacles.origin)
        points[:, 2] -= log.ground_z_ego_m
    near = np.abs(ground[0] - t_ns) < NEAR_S * NS_PER_S
    boxes_px = {name: m.box_px[m.camera == name] for name in schedule.frames}
    return Standing(cameras, boxes_px, points, apply(base_T_map, ground[1][near]))
