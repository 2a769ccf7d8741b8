"""Annotations of Argoverse 2 as labels: categories, riders joined with their vehicles, and when objects were scanned."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Labels
from log2sim.errors import LogError
from log2sim.geometry import Array, PoseTrack
from log2sim.logs.argoverse.poses import TRANSFORM, transforms_of
from log2sim.logs.arrow.tables import read_columns
from log2sim.logs.arrow.values import Kind
from log2sim.logs.notes import note_left_out
from log2sim.logs.spinning import compute_turn_share

SIZE = ("length_m", "width_m", "height_m")
COLUMNS: dict[str, Kind] = {
    "timestamp_ns": "int", "track_uuid": "text", "category": "text", **dict.fromkeys(SIZE, "float"), **TRANSFORM,
    "num_interior_pts": "int",
}  # fmt: skip

# By the taxonomy of the data set's user guide.
CATEGORY_OF = {
    "REGULAR_VEHICLE": "car",
    "LARGE_VEHICLE": "truck",
    "BOX_TRUCK": "truck",
    "TRUCK": "truck",
    "TRUCK_CAB": "truck",
    "BUS": "bus",
    "SCHOOL_BUS": "bus",
    "ARTICULATED_BUS": "bus",
    "MOTORCYCLE": "motorcycle",
    "MOTORCYCLIST": "motorcycle",
    "BICYCLE": "bicycle",
    "BICYCLIST": "cyclist",
    "PEDESTRIAN": "pedestrian",
    "OFFICIAL_SIGNALER": "pedestrian",
    "VEHICULAR_TRAILER": "other",
    "RAILED_VEHICLE": "other",
    "WHEELED_DEVICE": "other",
    "WHEELED_RIDER": "other",
    "WHEELCHAIR": "other",
    "STROLLER": "other",
}
NO_ROAD_USERS = {
    "BOLLARD", "CONSTRUCTION_CONE", "CONSTRUCTION_BARREL", "STOP_SIGN", "SIGN", "MOBILE_PEDESTRIAN_SIGN",
    "MOBILE_PEDESTRIAN_CROSSING_SIGN", "MESSAGE_BOARD_TRAILER", "TRAFFIC_LIGHT_TRAILER", "DOG", "ANIMAL",
}  # fmt: skip
# People who ride, by what they ride: both have boxes of their own.
RIDDEN_BY = {"BICYCLIST": "BICYCLE", "MOTORCYCLIST": "MOTORCYCLE", "WHEELED_RIDER": "WHEELED_DEVICE"}
# Between the centers of a rider and of the vehicle below, in the plane: less than half a bicycle.
MAX_RIDER_DISTANCE_M = 0.8

# The upper LiDAR turns clockwise in 0.1 s and looks in this direction at the stamp of a sweep (144.5 and 143.6 degrees in the
# two sweeps of the sample log, 143.4 in the rows that the user guide prints of another one); the lower one looks opposite.
START_AZIMUTH_RAD = np.radians(144.0)
PERIOD_NS = 100_000_000
HALF_TURN_NS = PERIOD_NS // 2


def read_labels(
    path: Path, ego: PoseTrack, upper_lidar_xy: Array, swept_ns: NDArray[np.int64], notes: list[str]
) -> Labels:
    """Read `annotations.feather`.

    Parameters
    ----------
    path : Path
    ego : PoseTrack
    upper_lidar_xy : (2,) float64, m
        Position of the upper LiDAR, ego frame.
    swept_ns : (F,) int64
        Stamps of the sweeps that are there.
    notes : list of str
        Takes what was left out.

    Notes
    -----
    A box is in the ego frame of its sweep's stamp, the start of the sweep, as the points are. It is drawn around the points
    of both LiDARs, which scan an object half a turn apart and each where it was at that time; ego motion alone is compensated.
    Hence the time of a box is the mean of both passages (`scan_time_ns`), not the stamp. In the two sweeps of the sample log,
    of the points on cars that drive faster than 5 m/s, moved by the car's speed to the time of the box, 99.6 % lie in the box
    with this time and 89 % with the stamp; of two cars at 10 m/s, whose rear the LiDARs hit, all and 24 to 30 %.
    """
    columns = _checked(read_columns(path, COLUMNS), path)
    ego_T_box = transforms_of(columns, path)
    kinds = columns["category"].astype(np.str_)
    size, ego_T_box, kinds, keep = _join_riders(columns, ego_T_box, kinds)
    map_T_ego, known = ego.at(columns["timestamp_ns"])
    if not known.all():
        notes.append(f"{np.sum(~known)} labels left out because the ego's pose is not known at their stamps")
    category = np.array([CATEGORY_OF.get(k, "") for k in kinds], dtype="<U16")
    note_left_out(kinds[keep & (category == "")].tolist(), NO_ROAD_USERS, notes)
    keep &= known & (category != "")
    keep &= _first_of_track(columns["timestamp_ns"], columns["track_uuid"].astype(np.str_))
    map_T_box = map_T_ego @ ego_T_box
    after_ns = scan_time_ns(ego_T_box[:, :2, 3] - upper_lidar_xy)
    labeled = np.unique(columns["timestamp_ns"])
    missing = len(labeled) - int(np.isin(labeled, swept_ns).sum())
    if missing:
        notes.append(f"sweeps are missing at {missing} of the {len(labeled)} stamps that were labeled")
    return Labels(
        t_ns=(columns["timestamp_ns"] + after_ns)[keep],
        track_id=columns["track_uuid"].astype(np.str_)[keep],
        category=category[keep],
        center_m=map_T_box[keep, :3, 3],
        size_m=size[keep],
        yaw_rad=np.arctan2(map_T_box[keep, 1, 0], map_T_box[keep, 0, 0]),
        visible=columns["num_interior_pts"][keep] > 0,
        kind=kinds[keep],
        labeled_ns=labeled + HALF_TURN_NS,
    )


def scan_time_ns(xy_lidar: Array) -> NDArray[np.int64]:
    """Compute when both LiDARs scan objects: the mean (N,), ns, after the stamp of the sweep.

    Parameters
    ----------
    xy_lidar : (N, 2) float64, m
        Positions of the objects from the LiDARs, axes of the ego.
    """
    upper_ns = np.round(compute_turn_share(xy_lidar, START_AZIMUTH_RAD) * PERIOD_NS).astype(np.int64)
    return np.asarray((upper_ns + (upper_ns + HALF_TURN_NS) % PERIOD_NS) // 2)


def _checked(columns: Mapping[str, NDArray[Any]], path: Path) -> Mapping[str, NDArray[Any]]:
    size = np.stack([columns[k] for k in SIZE], axis=1)
    bad = np.flatnonzero(~(size > 0).all(axis=1) | ~np.isfinite(size).all(axis=1))
    if len(bad):
        raise LogError(f"{path}, row {bad[0]}: size {size[bad[0]].tolist()}, expected length, width, height above 0 m")
    for name in ("track_uuid", "category"):
        missing = [k for k, word in enumerate(columns[name]) if word is None]
        if missing:
            raise LogError(f"{path}, row {missing[0]}: no '{name}'")
    return columns


def _first_of_track(t_ns: NDArray[np.int64], track_id: NDArray[np.str_]) -> NDArray[np.bool_]:
    """Mark (N,) the rows that do not repeat a track at a stamp."""
    first: NDArray[np.bool_] = np.zeros(len(t_ns), dtype=bool)
    pairs = np.rec.fromarrays([t_ns, track_id])
    first[np.unique(pairs, return_index=True)[1]] = True
    return first


def _join_riders(
    columns: Mapping[str, NDArray[Any]], ego_T_box: Array, kinds: NDArray[np.str_]
) -> tuple[Array, Array, NDArray[np.str_], NDArray[np.bool_]]:
    """Join each rider with the vehicle below: one road user with the vehicle's track, length and width, up to the rider's head.

    Returns sizes (N, 3), poses (N, 4, 4), kinds (N,) and what is kept (N,); a rider without a vehicle stays as it is.
    """
    size = np.stack([columns[k].astype(np.float64) for k in SIZE], axis=1)
    poses, kinds, keep = ego_T_box.copy(), kinds.copy(), np.ones(len(kinds), dtype=bool)
    t_ns, original = columns["timestamp_ns"], kinds.copy()
    for rider in np.flatnonzero(np.isin(original, list(RIDDEN_BY))):
        same = np.flatnonzero((t_ns == t_ns[rider]) & (original == RIDDEN_BY[str(original[rider])]))
        away = np.linalg.norm(ego_T_box[same, :2, 3] - ego_T_box[rider, :2, 3], axis=1)
        if not len(same) or away.min() > MAX_RIDER_DISTANCE_M:
            continue
        vehicle = same[np.argmin(away)]
        rows = [vehicle, rider]
        bottom = (ego_T_box[rows, 2, 3] - size[rows, 2] / 2).min()
        top = (ego_T_box[rows, 2, 3] + size[rows, 2] / 2).max()
        size[vehicle, 2], poses[vehicle, 2, 3] = top - bottom, (top + bottom) / 2
        kinds[vehicle], keep[rider] = original[rider], False
    return size, poses, kinds, keep
