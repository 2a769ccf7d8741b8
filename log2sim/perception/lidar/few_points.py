"""Places of people of whom a LiDAR has too few points for a cluster: the image gives the direction, the points the depth.

A sensor with 32 layers has 2 to 6 points on a person at 20 to 30 m.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, TYPICAL_SIZE_M, Measurements
from log2sim.geometry import NS_PER_S, Array, apply, undistort
from log2sim.perception.box_completion import oriented_covariance
from log2sim.perception.box_fitting import rotate, upper_median
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.lidar.projection import ProjectedPoints, View, project_points

GROUPS_OF_FEW_POINTS = ("pedestrian", "two_wheeler")
# A single point may be dust or the edge of something else.
MIN_POINTS = 2
# Share of the box's width at either side in which points may be beside the body: sensors are aligned to about 0.05 degrees, which
# is 2 cm of 50 at 25 m.
SIDE_SHARE = 0.05
# Points of one body are nearer to each other in depth: half a stride.
MAX_DEPTH_GAP_M = 0.5
# Standard deviation of the heights of people (adults 0.07 m, DIN 33402-2, with half-grown children and the edges of the box), as
# a share, and how many of them a body may be off: 99 % of people.
HEIGHT_SIGMA_SHARE, MAX_HEIGHT_SIGMAS = 0.12, 2.5
# Standard deviations of the depth of a body behind its points, m, and of the box's middle, as a share of its width.
DEPTH_SIGMA_M, MIDDLE_SIGMA_SHARE = 0.15, 0.15
# From the front of a body to its middle, as a share of the typical width.
FRONT_SHARE = 0.25
# How far beside and above the box a wall or a pole is searched, in widths and in heights of the box.
BESIDE_SHARE, ABOVE_SHARE = 1.0, 0.25
# Points so near to those of another object belong to it.
OWNED_MARGIN_M = 0.1


def measure_few_points(rows: Measurements, view: View, cloud: Cloud) -> Measurements:
    """Place the people and riders among the rows (M,) of a camera frame who have no points of their own yet.

    Notes
    -----
    A body is where two or more points inside its box have a depth at which the box is as high as a person. Points that go
    on at that depth on both sides of the box or above it belong to a wall, a fence or a pole.
    """
    small = np.array([GROUP_OF[c] in GROUPS_OF_FEW_POINTS for c in rows.category.tolist()], dtype=bool)
    wanted = np.flatnonzero(small & (rows.source == "") & ~rows.truncated)
    if len(wanted) == 0:
        return rows
    visible = project_points(view, cloud.origin, cloud.obstacle_columns)

    def is_free(chosen: NDArray[np.intp]) -> NDArray[np.bool_]:
        return ~_owned(cloud.xyz[cloud.obstacles[visible.index[chosen]], :2] + cloud.origin[:2], rows)

    columns: dict[str, Any] = {k: v.copy() if isinstance(v, np.ndarray) else v for k, v in vars(rows).items()}
    for k in wanted.tolist():
        chosen = _body_points(visible, rows, k, is_free, float(view.camera.K[1, 1]))
        if len(chosen):
            _write(columns, k, view, cloud, cloud.obstacles[visible.index[chosen]], visible.depth[chosen])
    return Measurements(**columns)


def _body_points(
    visible: ProjectedPoints,
    rows: Measurements,
    k: int,
    is_free: Callable[[NDArray[np.intp]], NDArray[np.bool_]],
    focal_px: float,
) -> NDArray[np.intp]:
    """Choose the points of the body in the box of row `k` among the n points of an image; none where nothing fits.

    Parameters
    ----------
    visible : ProjectedPoints
    rows : Measurements
        Of the frame.
    k : int
    is_free : callable
        Marks those of some of the points that are no other object's.
    focal_px : float
        Vertical.
    """
    boxes_px, tall_m = rows.box_px, TYPICAL_SIZE_M[str(rows.category[k])][2]
    u0, v0, u1, v1 = boxes_px[k].tolist()
    width, height = u1 - u0, v1 - v0
    u, v, depth = visible.u, visible.v, visible.depth
    inner = np.abs(u - (u0 + u1) / 2) <= (0.5 - SIDE_SHARE) * width
    inside = np.flatnonzero(inner & (v >= v0) & (v <= v1))
    inside = inside[np.abs(_off_height(depth[inside], height, focal_px, tall_m)) <= MAX_HEIGHT_SIGMAS]
    inside = inside[is_free(inside)] if len(inside) >= MIN_POINTS else inside
    if len(inside) < MIN_POINTS:
        return inside[:0]
    inside = inside[np.argsort(depth[inside], kind="stable")]
    bodies = np.split(inside, np.flatnonzero(np.diff(depth[inside]) > MAX_DEPTH_GAP_M) + 1)
    around = _around(visible, boxes_px, k)
    bodies = [b for b in bodies if len(b) >= MIN_POINTS and not _goes_on(visible, b, around, boxes_px[k])]

    def likelihood(body: NDArray[np.intp]) -> float:
        off = _off_height(depth[body], height, focal_px, tall_m)
        return float(np.log(len(body)) - off.mean() ** 2 / 2)

    return max(bodies, key=likelihood, default=inside[:0])


def _off_height(depth_m: NDArray[np.float32], height_px: float, focal_px: float, tall_m: float) -> NDArray[np.float32]:
    """Return by how many sigma a body of some height in px would be off a person's at depths (n,)."""
    return np.asarray((height_px * depth_m / focal_px / tall_m - 1) / HEIGHT_SIGMA_SHARE)


def _owned(xy: Array, rows: Measurements) -> NDArray[np.bool_]:
    """Mark the points (n, 2) of the map within the extents of the points of any row."""
    owned = np.zeros(len(xy), dtype=bool)
    for j in np.flatnonzero(np.isfinite(rows.low_m[:, 0])):
        local = rotate(xy - rows.sensor_m[j, :2], -float(rows.yaw_rad[j]))
        low, high = rows.low_m[j] - OWNED_MARGIN_M, rows.high_m[j] + OWNED_MARGIN_M
        owned |= ((local >= low) & (local <= high)).all(axis=1)
    return owned


def _around(visible: ProjectedPoints, boxes_px: Array, k: int) -> NDArray[np.intp]:
    """Find the points left, right and above box `k` that no other box shows but one that surrounds it."""
    u0, v0, u1, v1 = boxes_px[k].tolist()
    beside, above = BESIDE_SHARE * (u1 - u0), ABOVE_SHARE * (v1 - v0)
    u, v = visible.u, visible.v
    near = np.flatnonzero((u >= u0 - beside) & (u <= u1 + beside) & (v >= v0 - above) & (v <= v1))
    u, v = u[near], v[near]
    found = (u < u0) | (u > u1) | (v < v0)
    for j, (a0, b0, a1, b1) in enumerate(boxes_px.tolist()):
        if j != k and not (a0 <= u0 and a1 >= u1):
            found &= ~((u >= a0) & (u <= a1) & (v >= b0) & (v <= b1))
    return np.asarray(near[found])


def _goes_on(visible: ProjectedPoints, body: NDArray[np.intp], around: NDArray[np.intp], box_px: Array) -> bool:
    """Return whether what the points of a body belong to goes on at both sides of its box, or above it."""
    depth = visible.depth[body]
    low, high = depth.min() - MAX_DEPTH_GAP_M, depth.max() + MAX_DEPTH_GAP_M
    same = around[(visible.depth[around] >= low) & (visible.depth[around] <= high)]
    u, v = visible.u[same], visible.v[same]
    within = (u >= box_px[0]) & (u <= box_px[2])
    return bool(((u < box_px[0]).any() and (u > box_px[2]).any()) or (within & (v < box_px[1])).any())


def _write(
    columns: dict[str, Any], k: int, view: View, cloud: Cloud, members: NDArray[np.intp], depth: NDArray[np.float32]
) -> None:
    """Write the place of a body into row `k`: along the middle of its image box, as deep as its points."""
    box, camera = columns["box_px"][k], view.camera
    category = str(columns["category"][k])
    front_m = float(depth.mean())
    middle = undistort(camera, np.array([[(box[0] + box[2]) / 2, (box[1] + box[3]) / 2]]))[0]
    if not np.isfinite(middle).all():
        return
    front = apply(view.map_T_cam, np.append(middle, 1.0)[None] * front_m)[0]
    ray = (front - view.map_T_cam[:3, 3])[:2]
    yaw = float(np.arctan2(ray[1], ray[0]))
    xyz = cloud.xyz[members].astype(np.float64)
    bottom_m = float(upper_median(xyz[:, 2] - cloud.height[members]) + cloud.origin[2])
    tall_m = float((box[3] - box[1]) * front_m / camera.K[1, 1])
    behind = FRONT_SHARE * TYPICAL_SIZE_M[category][1] * np.array([np.cos(yaw), np.sin(yaw)])
    across_m = MIDDLE_SIGMA_SHARE * (box[2] - box[0]) * front_m / camera.K[0, 0]
    columns["center_m"][k] = [*(front[:2] + behind), bottom_m + tall_m / 2]
    columns["covariance"][k] = oriented_covariance(np.array([DEPTH_SIGMA_M, max(across_m, DEPTH_SIGMA_M)]), yaw)
    columns["bottom_m"][k], columns["top_m"][k], columns["height_px_m"][k] = bottom_m, bottom_m + tall_m, tall_m
    columns["points"][k], columns["source"][k] = len(members), "lidar"
    columns["seen_by"][k] |= cloud.ends_of(members)
    columns["t_ns"][k] = cloud.stamp_ns + round(float(cloud.t_s[members].mean()) * NS_PER_S)
    columns["sensor_m"][k] = cloud.sensor + cloud.origin
