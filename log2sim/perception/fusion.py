"""Fusion: measurements of all sensors at one tick become one set of objects in the map frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, Measurements
from log2sim.perception.box_fitting import fit_box, rotate

# Two clusters are one object when this share of the smaller lies in the other's extent.
MIN_SHARED_POINTS = 0.4
MARGIN_M = 0.15
# Squared Mahalanobis distance of two independent positions, 2 degrees of freedom, 99 %.
CHI2_2DOF_99 = 9.21


def fuse(measurements: Measurements, *, across: bool = True) -> Measurements:
    """Join rows (M,) that are the same object, seen by two cameras or found twice by one.

    Rows with LiDAR points are the same object when they share its points; rows without, or whose points were not kept, are
    gated by their covariances.
    The joined row keeps the score, category and image box of the surest one. A person whose points are those of a vehicle
    is its driver or a false alarm and is dropped. With `across` off, for rows of one camera, nothing is joined: its doubles
    are dropped, which gives the same.
    """
    order = np.argsort(-measurements.score * np.where(measurements.truncated, 0.7, 1.0), kind="stable")
    rows = measurements.take(order)
    owner = np.full(len(rows), -1)
    possible = _gated_pairs(rows)
    for i in range(len(rows)):
        for j in np.flatnonzero(possible[i, :i]).tolist():
            if owner[j] == j and _share_points(rows, i, j):
                owner[i] = j
                break
        else:
            owner[i] = i
    leaders = np.flatnonzero(owner == np.arange(len(rows)))
    if across:
        out = Measurements.join([_join(rows, int(leader), np.flatnonzero(owner == leader)) for leader in leaders])
    else:
        out = rows.take(leaders)
    return out.take(~_is_driver(out))


def _gated_pairs(rows: Measurements) -> NDArray[np.bool_]:
    """Which pairs (M, M) of one group can be one object: near each other if both have points, else at one place in two cameras."""
    group = np.array([GROUP_OF[str(c)] for c in rows.category])
    with_points, placed = _has_points(rows), rows.source != ""
    reach = rows.size_m[:, :2].sum(axis=1) / 2
    dx, dy = (rows.center_m[:, None, axis] - rows.center_m[:, axis] for axis in range(2))
    near = np.hypot(dx, dy) <= reach[:, None] + reach
    c = rows.covariance[:, None] + rows.covariance
    determinant = c[..., 0, 0] * c[..., 1, 1] - c[..., 0, 1] ** 2
    squared = c[..., 1, 1] * dx**2 - 2 * c[..., 0, 1] * dx * dy + c[..., 0, 0] * dy**2
    other_camera = (rows.camera[:, None] != rows.camera) & placed[:, None] & placed
    same_place = other_camera & (squared <= CHI2_2DOF_99 * determinant)
    return (group[:, None] == group) & np.where(with_points[:, None] & with_points, near, same_place)


def _has_points(rows: Measurements) -> NDArray[np.bool_]:
    """Mask (M,) of rows whose LiDAR points are at hand."""
    return np.array([s == "lidar" and len(c) > 0 for s, c in zip(rows.source, rows.cluster)], dtype=bool)


def _share_points(rows: Measurements, i: int, j: int) -> bool:
    """Whether two rows share points; where one has none, their places have to be enough."""
    if not len(rows.cluster[i]) or not len(rows.cluster[j]):
        return True
    return max(_share_inside(rows, i, j), _share_inside(rows, j, i)) >= MIN_SHARED_POINTS


def _share_inside(rows: Measurements, i: int, j: int) -> float:
    """Share of the points of row `i` that lie inside the extent of the points of row `j`."""
    yaw = float(rows.yaw_rad[j])
    extent, points = rotate(rows.cluster[j][:, :2], -yaw), rotate(rows.cluster[i][:, :2], -yaw)
    low, high = extent.min(axis=0) - MARGIN_M, extent.max(axis=0) + MARGIN_M
    return float(((points >= low) & (points <= high)).all(axis=1).mean())


def _join(rows: Measurements, leader: int, members: NDArray[np.intp]) -> Measurements:
    row = rows.take([leader])
    with_points = _has_points(rows)
    others = [m for m in members if m != leader and rows.camera[m] != rows.camera[leader] and with_points[m]]
    if not others or not with_points[leader]:
        return row
    cluster = np.concatenate([rows.cluster[m] for m in [leader, *others]])
    ground_z = float(row.center_m[0, 2] - row.size_m[0, 2] / 2)
    origin = row.center_m[0]
    # Where one camera's box cut the object, another's may show its end.
    ends_visible: NDArray[np.bool_] = np.any(rows.ends_visible[[leader, *others]], axis=0)
    center, size, yaw, covariance = fit_box(
        cluster - origin, row.sensor_m[0] - origin, str(row.category[0]), ground_z - float(origin[2]), ends_visible
    )
    cut = bool(row.truncated[0]) and all(rows.truncated[m] for m in others)
    columns = dict(vars(row))
    columns |= {
        "center_m": (center + origin)[None], "size_m": size[None], "yaw_rad": np.array([yaw]),
        "covariance": covariance[None], "cluster": (cluster,), "truncated": np.array([cut]), "ends_visible": ends_visible[None],
        "points": np.array([int(rows.points[[leader, *others]].max())]),
    }  # fmt: skip
    return Measurements(**columns)


def _is_driver(rows: Measurements) -> NDArray[np.bool_]:
    """Mask (M,) of people whose points lie inside a vehicle's extent."""
    group = np.array([GROUP_OF[str(c)] for c in rows.category])
    drop, with_points = np.zeros(len(rows), dtype=bool), _has_points(rows)
    for i in np.flatnonzero((group == "pedestrian") & with_points):
        for j in np.flatnonzero((group == "vehicle") & with_points):
            near = np.hypot(*(rows.center_m[i] - rows.center_m[j])[:2]) < rows.size_m[j, 0]
            drop[i] |= bool(near) and _share_inside(rows, int(i), int(j)) >= 0.8
    return drop
