"""PandaSet's cuboids as labels: sizes and yaws turned to our axes, each at the time at which the LiDAR scanned it."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Labels
from log2sim.errors import LogError
from log2sim.geometry import Array, apply, inverse, wrap_angle
from log2sim.logs.notes import note_left_out
from log2sim.logs.pandaset.unpickle import Columns, read_pickled_table
from log2sim.logs.pose_checks import MAX_POSITION_M
from log2sim.logs.spinning import compute_scan_offset_ns, select_spaced

PERIOD_NS = 100_000_000
MIN_STEP_NS = 20_000_000

CATEGORY_OF = {
    "Car": "car",
    "Pickup Truck": "truck",
    "Medium-sized Truck": "truck",
    "Semi-truck": "truck",
    "Bus": "bus",
    "Motorcycle": "motorcycle",
    "Motorized Scooter": "motorcycle",
    "Pedestrian": "pedestrian",
    "Pedestrian with Object": "pedestrian",
    "Emergency Vehicle": "other",
    "Other Vehicle - Construction Vehicle": "other",
    "Other Vehicle - Pedicab": "other",
    "Other Vehicle - Uncommon": "other",
    "Personal Mobility Device": "other",
    "Towed Object": "other",
    "Train": "other",
    "Tram / Subway": "other",
}
# Things that are no road users.
NO_ROAD_USERS = {
    "Animals - Bird", "Animals - Other", "Cones", "Construction Signs", "Pylons", "Road Barriers", "Rolling Containers",
    "Signs", "Temporary Construction Barriers",
}  # fmt: skip
COLUMNS = (
    "uuid", "label", "yaw", "position.x", "position.y", "position.z", "dimensions.x", "dimensions.y", "dimensions.z",
)  # fmt: skip
# Columns that a file lacks where no object of its sweep has the attribute, and the values that they get then.
OPTIONAL: dict[str, str | int] = {"attributes.rider_status": "", "cuboids.sibling_id": "-", "cuboids.sensor_id": -1}
RIDER = {"With Rider": "cyclist", "Without Rider": "bicycle"}
GT_SENSOR = 1
# A bicycle in a sweep that does not state whether somebody rides it, until its other sweeps decide.
UNKNOWN_RIDER = "bicycle?"


def read_labels(
    files: dict[int, Path], t_ns: NDArray[np.int64], gt_t_ns: NDArray[np.int64], map_T_lidar: Array, notes: list[str]
) -> Labels:
    """Labels of the cuboid files by number of sweep.

    Parameters
    ----------
    files : mapping of the sweep's number to its cuboids
    t_ns, gt_t_ns : (N,) int64
        Stamps of the sweeps of the Pandar64 and of the PandarGT.
    map_T_lidar : (N, 4, 4)
        Poses of the Pandar64 at `t_ns`.
    notes : list of str
        Takes what was left out.

    Notes
    -----
    A cuboid fits the points where they were measured, and the Pandar64 scans different directions at different times; on
    moving cars of sequence 002 the time by `compute_scan_offset_ns` is off that of the points inside the box by 0.5 +- 0.4 ms:
    the turn takes 0.1 s and ends at the rear, at the stamp of the sweep. Of an object
    with a cuboid for each LiDAR the Pandar64's is kept.
    """
    parts = []
    left_out: list[str] = []
    twice = flat = 0
    for number, path in files.items():
        if number < len(t_ns):
            table = _checked(read_pickled_table(path, LogError), path)
            twice += len(table["uuid"]) - len(np.unique(table["uuid"].astype(np.str_)))
            flat += int((_sizes(table) <= 0).any(axis=1).sum())
            parts.append(_frame(table, int(t_ns[number]), int(gt_t_ns[number]), map_T_lidar[number], left_out))
    if twice:
        notes.append(f"{twice} cuboids left out: their sweep has another one of the same uuid")
    if flat:
        notes.append(f"{flat} cuboids left out: a side of them is 0 or less")
    note_left_out(left_out, NO_ROAD_USERS, notes)
    _note_missing(files, len(t_ns), notes)
    columns = [np.concatenate([p[k] for p in parts]) for k in range(6)] if parts else None
    if columns is None:
        raise LogError(f"{next(iter(files.values())).parent}: no cuboids of the sweeps of this log")
    keep = select_spaced(columns[0], columns[1], MIN_STEP_NS)
    t_ns, track_id, category, center, size, yaw = (c[keep] for c in columns)
    category = _settle_riders(track_id, category, notes)
    return Labels(t_ns, track_id, category, center, size, yaw)


def _note_missing(files: Collection[int], count: int, notes: list[str]) -> None:
    """Note the sweeps without a file of cuboids, where others have one."""
    missing = sorted(set(range(count)) - set(files))
    if missing:
        notes.append(f"annotations/cuboids: {len(missing)} of {count} files are missing, first number {missing[0]:02d}")


def _checked(table: Columns, path: Path) -> Columns:
    for name in COLUMNS:
        if name not in table:
            raise LogError(f"{path}: no column '{name}'; expected cuboids with {', '.join(COLUMNS)}")
    count = len(table["uuid"])
    table = {name: np.full(count, value) for name, value in OPTIONAL.items()} | table
    numbers = [n for n in COLUMNS if n.startswith(("yaw", "position", "dimensions"))]
    for name in numbers:
        if table[name].dtype.kind not in "fiu" or not (np.abs(table[name]) <= MAX_POSITION_M).all():
            raise LogError(f"{path}, column '{name}': expected finite numbers up to {MAX_POSITION_M:g}")
    return table


def _frame(c: Columns, t_ns: int, gt_t_ns: int, map_T_lidar: Array, left_out: list[str]) -> tuple[NDArray[Any], ...]:
    """Stamps, track ids, categories, centers, sizes and yaws of one sweep's cuboids; `left_out` takes the kinds of others."""
    category = np.array(
        [_category(str(k), str(r)) for k, r in zip(c["label"], c["attributes.rider_status"])], dtype="<U16"
    )
    left_out += [str(kind) for kind in c["label"][category == ""]]
    uuid, sibling = c["uuid"].astype(np.str_), c["cuboids.sibling_id"].astype(np.str_)
    of_gt = c["cuboids.sensor_id"] == GT_SENSOR
    # In sequence 002 one of the two names the other by a part of its uuid only.
    twin = of_gt & (np.isin(sibling, uuid[~of_gt]) | np.isin(uuid, sibling[~of_gt]))
    # A cuboid of the PandarGT alone still belongs to the track of its twin.
    track_id = np.where(of_gt & (np.char.str_len(sibling) > 1), sibling, uuid)
    center = np.stack([c[f"position.{k}"] for k in "xyz"], axis=1).astype(np.float64)
    stamp = np.where(of_gt, gt_t_ns, t_ns + compute_scan_offset_ns(apply(inverse(map_T_lidar), center), PERIOD_NS))
    size, yaw = _sizes(c), wrap_angle(c["yaw"] + np.pi / 2)
    keep = (category != "") & ~twin & (size > 0).all(axis=1)
    return tuple(column[keep] for column in (stamp, track_id, category, center, size, yaw))


def _sizes(c: Columns) -> Array:
    """Length, width and height (M, 3) of cuboids; the data set's x is the width and its y the length, a yaw of 0 faces +y."""
    return np.stack([c["dimensions.y"], c["dimensions.x"], c["dimensions.z"]], axis=1).astype(np.float64)


def _category(label: str, rider: str) -> str:
    if label == "Bicycle":
        return RIDER.get(rider, UNKNOWN_RIDER)
    return CATEGORY_OF.get(label, "")


def _settle_riders(track_id: NDArray[np.str_], category: NDArray[np.str_], notes: list[str]) -> NDArray[np.str_]:
    """Categories in which a bicycle of unknown rider is what it is in most other sweeps; without any, a bicycle."""
    settled = category.copy()
    alone = 0
    for track in np.unique(track_id[category == UNKNOWN_RIDER]):
        rows = track_id == track
        words, counts = np.unique(category[rows & (category != UNKNOWN_RIDER)], return_counts=True)
        settled[rows & (category == UNKNOWN_RIDER)] = words[np.argmax(counts)] if len(words) else "bicycle"
        alone += not len(words)
    if alone:
        notes.append(
            f"{alone} bicycle{'s' * (alone != 1)} taken as unridden: no sweep states whether somebody rides them"
        )
    return settled
