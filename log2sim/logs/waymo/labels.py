"""Labels of a segment: 3D boxes in the map, each at the time at which the TOP LiDAR scanned it, and boxes in the images."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import ImageLabels, Labels
from log2sim.geometry import Array, apply, rotation_from_rpy, yaw_of
from log2sim.logs.notes import note_left_out
from log2sim.logs.spinning import select_spaced
from log2sim.logs.waymo.range_images import turn_of
from log2sim.logs.waymo.segment import TYPES, BoxTable, LaserCalibration
from log2sim.logs.waymo.timing import FrameTimes

# Vehicles are cars, trucks, buses and motorcycles.
CATEGORY_OF = {"vehicle": "car", "pedestrian": "pedestrian", "cyclist": "cyclist"}
NO_ROAD_USERS = {"sign"}
# Of labels of one object; see `select_spaced`.
MIN_STEP_NS = 20_000_000
MAX_COORDINATE_M = 1e4


def labels_of(
    table: BoxTable, times: FrameTimes, map_T_vehicle: Array, top: LaserCalibration | None, notes: list[str]
) -> Labels:
    """Turn 3D boxes in the vehicle's frames into labels in the map.

    Parameters
    ----------
    table : BoxTable
        `frame` counts the frames in order.
    times : FrameTimes
    map_T_vehicle : (F, 4, 4) float64
        Poses that define the vehicle's frames.
    top : LaserCalibration or None
        None puts every label at the stamp of its frame's pose.
    notes : list of str
        Takes what was left out.

    Notes
    -----
    A box fits the points where they were measured, and the TOP LiDAR scans different directions at different times: the box
    has the time of its direction. The data set states no times of boxes; where it derives boxes from them (`camera_synced_box`) it calls them boxes at the
    start of the frame. On its sample the camera's label of a cyclist at 8.5 m/s is 13 px from the box at this time, 24 px
    from the box at the start; its box is 37 px wide.
    """
    if table.lost:
        notes.append(f"{table.lost} labels are damaged or of no frame, and left out")
    table, kind = _road_users(table, notes)
    turn = None if top is None else turn_of(table.center, top)
    t_ns = times.pose_ns[table.frame] if turn is None else times.at_turn(table.frame, turn)
    order = np.argsort(t_ns, kind="stable")
    keep = order[select_spaced(t_ns[order], table.track_id[order], MIN_STEP_NS)]
    table, kind, t_ns = table.take(keep), kind[keep], t_ns[keep]
    pose = map_T_vehicle[table.frame]
    turned = pose[:, :3, :3] @ rotation_from_rpy(0.0, 0.0, table.heading_rad)
    return Labels(
        t_ns,
        table.track_id,
        _categories(kind),
        apply(pose, table.center),
        table.size,
        yaw_of(turned),
        kind=kind,
        labeled_ns=times.pose_ns,
    )


def _road_users(table: BoxTable, notes: list[str]) -> tuple[BoxTable, NDArray[np.str_]]:
    """Select the usable boxes of road users; return them with the words for their kinds."""
    kind = np.array([TYPES.get(int(k), "unknown") for k in table.kind], dtype=np.str_)
    usable = (table.size > 0).all(axis=1) & np.isfinite(table.size).all(axis=1) & np.isfinite(table.heading_rad)
    usable &= (np.abs(table.center) < MAX_COORDINATE_M).all(axis=1)
    road_user = np.isin(kind, list(CATEGORY_OF))
    if (road_user & ~usable).any():
        notes.append(f"{np.sum(road_user & ~usable)} labels without a position or size left out")
    note_left_out(kind[~road_user].tolist(), NO_ROAD_USERS, notes)
    rows = np.flatnonzero(usable & road_user)
    return table.take(rows), kind[rows]


def image_labels_of(table: BoxTable, stamps_ns: NDArray[np.int64], size_px: tuple[int, int]) -> ImageLabels:
    """Turn boxes of one camera's images into labels, cut at the border of the image.

    Parameters
    ----------
    table : BoxTable
        `frame` counts the frames in order.
    stamps_ns : (F,) int64
        Of the camera's image in each frame; negative where there is none.
    size_px : (int, int)
        Width and height.
    """
    kind = np.array([TYPES.get(int(k), "unknown") for k in table.kind], dtype=np.str_)
    box = np.concatenate([table.center - table.size / 2, table.center + table.size / 2], axis=1)
    box = np.clip(box, 0, np.tile(np.asarray(size_px, dtype=np.float64), 2))
    t_ns = stamps_ns[table.frame]
    with np.errstate(invalid="ignore"):
        whole = np.isfinite(box).all(axis=1) & (box[:, 2:] > box[:, :2]).all(axis=1)
    rows = np.flatnonzero(whole & (t_ns >= 0) & np.isin(kind, list(CATEGORY_OF)))
    return ImageLabels(t_ns[rows], box[rows], _categories(kind[rows]))


@dataclass(frozen=True, eq=False)
class LabelsOnRequest(Mapping[str, ImageLabels]):
    """Image labels by camera that are read when one camera's are first used.

    Attributes
    ----------
    cameras : tuple of str
    read : callable
        Reads the labels of a camera.
    """

    cameras: tuple[str, ...]
    read: Callable[[str], ImageLabels]
    _found: dict[str, ImageLabels] = field(default_factory=dict)
    _lock: Lock = field(default_factory=Lock)

    def __getitem__(self, camera: str) -> ImageLabels:
        """Return the labels of a camera."""
        if camera not in self.cameras:
            raise KeyError(camera)
        with self._lock:
            if camera not in self._found:
                self._found[camera] = self.read(camera)
            return self._found[camera]

    def __iter__(self) -> Iterator[str]:
        """Return the cameras."""
        return iter(self.cameras)

    def __len__(self) -> int:
        """Return the number of cameras."""
        return len(self.cameras)


def _categories(kind: NDArray[np.str_]) -> NDArray[np.str_]:
    return np.array([CATEGORY_OF[str(word)] for word in kind], dtype="<U16")
