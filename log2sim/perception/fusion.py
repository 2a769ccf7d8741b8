"""Rows of several cameras and sweeps become one of each object and tick."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import TYPICAL_SIZE_M, Measurements, groups_of
from log2sim.geometry import CHI2_2DOF_99, NS_PER_S
from log2sim.perception.boxes import fit_extents, place_boxes, provisional_sizes, rotate, top_of

# Clusters are one object when this share of the points of either is inside the extents of the other.
MIN_SHARED_POINTS = 0.4
MARGIN_M = 0.15
# A person with this share of points inside a vehicle is its driver.
MIN_DRIVER_SHARE = 0.8
# Truncated boxes lose to whole ones of the same score.
TRUNCATED_SCORE_FACTOR = 0.7
# What a detector in LiDAR sweeps adds to a row.
BOX_COLUMNS = ("box_center_m", "box_size_m", "box_yaw_rad", "heading_score")


def fuse(measurements: Sequence[Measurements], *, across: bool = True) -> list[Measurements]:
    """Fuse the measurements of all cameras at every tick, see `fuse_tick`.

    `across`: whether several cameras may have seen the same object.
    """
    return [fuse_tick(rows, across=across) for rows in measurements]


def fuse_tick(measurements: Measurements, *, across: bool = True) -> Measurements:
    """Join rows (M,) of one tick that are the same object, seen by two cameras or detected twice by one.

    Rows with LiDAR points are the same object when they share points; rows without are gated by their covariances. The
    joined row keeps the score, category and image box of the most confident one. A person whose points are those of a
    vehicle is its driver or a false alarm and is dropped. With `across` off, for rows of one camera, duplicates are dropped
    without joining, which gives the same result.
    """
    if not len(measurements):
        return measurements
    score = measurements.score * np.where(measurements.truncated, TRUNCATED_SCORE_FACTOR, 1.0)
    rows = measurements.take(np.argsort(-score, kind="stable"))
    # Pairs (M, M) of one group are gated: by distance if both have points, else by the covariances of two cameras.
    group, with_points, placed = groups_of(rows.category), _has_points(rows), rows.source != ""
    reach = provisional_sizes(rows).sum(axis=1) / 2
    dx, dy = (rows.center_m[:, None, axis] - rows.center_m[:, axis] for axis in range(2))
    near = np.hypot(dx, dy) <= reach[:, None] + reach
    c = rows.covariance[:, None] + rows.covariance
    determinant = c[..., 0, 0] * c[..., 1, 1] - c[..., 0, 1] ** 2
    squared = c[..., 1, 1] * dx**2 - 2 * c[..., 0, 1] * dx * dy + c[..., 0, 0] * dy**2
    other_camera = (rows.camera[:, None] != rows.camera) & placed[:, None] & placed
    same_place = other_camera & (squared <= CHI2_2DOF_99 * determinant)
    possible = np.where(with_points[:, None] & with_points, near, same_place) & (group[:, None] == group)
    # Boxes that a detector found in one sweep are different objects.
    possible &= ~((rows.camera[:, None] == "") & (rows.camera == ""))
    owner = np.arange(len(rows))
    for i in np.flatnonzero(np.tril(possible, -1).any(axis=1)).tolist():
        for j in np.flatnonzero(possible[i, :i]).tolist():
            # Without points their positions suffice.
            alike = not len(rows.cluster[i]) or not len(rows.cluster[j])
            if owner[j] == j and (
                alike or max(_share_inside(rows, *of) for of in ((i, j), (j, i))) >= MIN_SHARED_POINTS
            ):
                owner[i] = j
                break
    leaders = np.flatnonzero(owner == np.arange(len(rows)))
    out = rows.take(leaders)
    if across:  # with the LiDAR evidence that other cameras have
        seen_by = np.array([rows.seen_by[owner == leader].any(axis=0) for leader in leaders], dtype=bool)
        out = replace(out, seen_by=seen_by.reshape(-1, rows.seen_by.shape[1]))
        usable = with_points & with_points[owner] & (rows.camera != rows.camera[owner])
        joined = {}
        for k in np.flatnonzero(np.isin(leaders, owner[usable])).tolist():
            members = [int(leaders[k]), *np.flatnonzero(usable & (owner == leaders[k])).tolist()]
            joined[k] = _join(rows, out.take([k]), members)
        if joined:
            others = [k for k in range(len(leaders)) if k not in joined]
            out = Measurements.join([out.take(others), *joined.values()]).take(np.argsort([*others, *joined]))
    # People whose points are inside a vehicle's extents are dropped.
    group, with_points = groups_of(out.category), _has_points(out)
    drop, length_m = np.zeros(len(out), dtype=bool), provisional_sizes(out)[:, 0]
    people, vehicles = (np.flatnonzero((group == name) & with_points) for name in ("pedestrian", "vehicle"))
    apart = out.center_m[people, None, :2] - out.center_m[vehicles, :2]
    for k, n in np.argwhere(np.hypot(apart[..., 0], apart[..., 1]) < length_m[vehicles]).tolist():
        drop[people[k]] |= _share_inside(out, int(people[k]), int(vehicles[n])) >= MIN_DRIVER_SHARE
    return out.take(~drop)


def _has_points(rows: Measurements) -> NDArray[np.bool_]:
    """Mark the rows (M,) with LiDAR points."""
    return np.asarray((rows.source == "lidar") & (rows.kept_points > 0))


def _share_inside(rows: Measurements, i: int, j: int) -> float:
    """Return the share of the points of row `i` inside the extents of the points of row `j`."""
    yaw = float(rows.yaw_rad[j])
    extent, points = rotate(rows.cluster[j][:, :2], -yaw), rotate(rows.cluster[i][:, :2], -yaw)
    low, high = extent.min(axis=0) - MARGIN_M, extent.max(axis=0) + MARGIN_M
    return float(((points >= low) & (points <= high)).all(axis=1).mean())


def _join(rows: Measurements, row: Measurements, merged: list[int]) -> Measurements:
    """Return a leader's row with the points that it, the first of `merged`, and other cameras have of its object."""
    leader = merged[0]
    boxed = rows.take([next((m for m in merged if np.isfinite(rows.box_yaw_rad[m])), leader)])
    row = replace(row, **{column: getattr(boxed, column) for column in BOX_COLUMNS})
    # The points (n, 4) of all, with their times after the leader's stamp.
    parts = []
    for m in merged:
        points, late_s = rows.cluster[m], (int(rows.t_ns[m]) - int(row.t_ns[0])) / NS_PER_S
        timed = np.column_stack([points, np.zeros(len(points))]) if points.shape[1] == 3 else points
        parts.append(timed + np.array([0.0, 0.0, 0.0, late_s]))
    cluster = np.concatenate(parts)
    xy = cluster[:, :2] - row.sensor_m[0, :2]
    typical = np.array(TYPICAL_SIZE_M[str(row.category[0])])
    yaw, low, high = fit_extents(xy, typical, float(row.box_yaw_rad[0]))
    return place_boxes(replace(
        row, cluster=(cluster,), yaw_rad=np.array([yaw]), low_m=low[None], high_m=high[None],
        top_m=np.array([top_of(cluster[:, 2])]),
        # Where one camera's box cut the object, another's may show its end.
        ends_visible=np.asarray(rows.ends_visible[merged].any(axis=0, keepdims=True)),
        truncated=np.array([rows.truncated[merged].all()]), points=rows.points[merged].max(keepdims=True),
    ))  # fmt: skip
