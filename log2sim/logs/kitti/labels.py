"""Labels of the KITTI tracking benchmark: boxes of objects in view of camera 2, and the ignored regions of its images."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import ImageLabels, ImageRegions, Labels
from log2sim.errors import LogError
from log2sim.geometry import Array, PoseTrack, apply, wrap_angle
from log2sim.logs.kitti import drive
from log2sim.logs.notes import note_damaged_rows
from log2sim.logs.pose_checks import MAX_POSITION_M
from log2sim.numerals import parse_float, parse_int

CATEGORY_OF = {
    "Car": "car",
    "Van": "car",
    "Truck": "truck",
    "Pedestrian": "pedestrian",
    "Person": "pedestrian",
    "Person_sitting": "pedestrian",
    "Cyclist": "cyclist",
    "Tram": "other",
    "Misc": "other",
}
NOT_LABELED = "DontCare"
NEVER_LABELED = ("bicycle",)
"""No class is for bicycles without riders (Geiger et al., "Vision meets robotics", 2013, section III)."""

LABEL_FIELDS = 17
RESULT_FIELDS = 18
"""Of a line that ends with a score."""
# A day and more at 10 Hz; stamps of much larger numbers do not fit into int64 ns.
MAX_FRAME = 1_000_000
CAMERA = "image_02"


@dataclass(frozen=True, eq=False)
class DriveLabels:
    """Contents of a label file; empty without one.

    Attributes
    ----------
    boxes_3d : Labels or None
    boxes_2d : mapping of str to ImageLabels
        By camera.
    ignored : mapping of str to ImageRegions
        By camera.
    text : str
        The file, for the log's digest.
    """

    boxes_3d: Labels | None = None
    boxes_2d: Mapping[str, ImageLabels] = field(default_factory=dict)
    ignored: Mapping[str, ImageRegions] = field(default_factory=dict)
    text: str = ""


@dataclass(frozen=True, eq=False)
class LabelRows:
    """Lines of a label file.

    Attributes
    ----------
    frame : (L,) int64
    track_id : (L,) str
    type : (L,) str
    values : (L, 14) float64
        The numbers from truncation on.
    """

    frame: NDArray[np.int64]
    track_id: NDArray[np.str_]
    type: NDArray[np.str_]
    values: Array

    def take(self, index: NDArray[np.bool_]) -> LabelRows:
        """Select the rows of a mask."""
        return LabelRows(self.frame[index], self.track_id[index], self.type[index], self.values[index])


def read_labels(
    path: Path,
    rig: drive.Rig,
    track: PoseTrack,
    stamp_of: Callable[[NDArray[np.int64]], NDArray[np.int64]],
    notes: list[str],
) -> DriveLabels:
    """Read a label file; `stamp_of` gives the stamps (L,) of frame numbers (L,), `notes` takes what was left out.

    Notes
    -----
    Only objects in view of camera 2 have labels. Regions of its images with objects too far, too occluded or too crowded to
    be labeled are marked by boxes of the type DontCare.
    """
    text = drive.read_text(path)
    damaged: list[str] = []
    rows = parse_labels(text, path, damaged)
    note_damaged_rows(damaged, len(rows.frame) + len(damaged), notes)
    return labels_of_rows(rows, rig.ego_T_rect, track, stamp_of, text)


def labels_of_rows(
    rows: LabelRows,
    ego_T_rect: Array,
    track: PoseTrack,
    stamp_of: Callable[[NDArray[np.int64]], NDArray[np.int64]],
    text: str,
) -> DriveLabels:
    """Place the rows of label files in the map; those of unlabeled regions become regions of the image.

    Parameters
    ----------
    rows : LabelRows
    ego_T_rect : (4, 4) float64
        Pose of the rectified camera 0.
    track : PoseTrack
        Poses of the ego.
    stamp_of : callable
        Gives the stamps (L,) of frame numbers (L,).
    text : str
        The files, for the log's digest.
    """
    is_ignored = rows.type == NOT_LABELED
    ignored = rows.take(is_ignored)
    rows = rows.take(~is_ignored)
    t_ns = stamp_of(rows.frame)
    category = np.array([CATEGORY_OF[name] for name in rows.type.tolist()], dtype="<U16")
    map_T_ego, known = track.at(t_ns)
    center, size, yaw = boxes_in_map(map_T_ego @ ego_T_rect, rows.values[:, 7:14])
    k = known
    return DriveLabels(
        Labels(
            t_ns[k],
            rows.track_id[k],
            category[k],
            center[k],
            size[k],
            yaw[k],
            cameras=(CAMERA,),
            kind=rows.type[k],
            occlusion=rows.values[k, 1].astype(np.int64),
            never_labeled=NEVER_LABELED,
        ),
        {CAMERA: ImageLabels(t_ns, rows.values[:, 3:7], category)},
        {CAMERA: ImageRegions(stamp_of(ignored.frame), ignored.values[:, 3:7])},
        text,
    )


def parse_labels(text: str, path: Path, damaged: list[str] | None = None) -> LabelRows:
    """Parse the lines of a label file.

    Parameters
    ----------
    text : str
    path : Path
        For messages.
    damaged : list of str, optional
        Takes a message for each line that is wrong, which is left out.

    Raises
    ------
    LogError
        Naming the first line that is wrong, without `damaged`.
    """
    frames, ids, types, values = [], [], [], []
    for k, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words:
            continue
        try:
            frame, row = _parse_words(words)
        except ValueError as problem:
            message = f"{path}, line {k}: {problem}"
            if damaged is None:
                raise LogError(message) from None
            damaged.append(message)
            continue
        frames.append(frame)
        ids.append(words[1])
        types.append(words[2])
        values.append(row)
    table = np.array(values, dtype=np.float64).reshape(-1, LABEL_FIELDS - 3)
    return LabelRows(
        np.array(frames, dtype=np.int64), np.array(ids, dtype="<U16"), np.array(types, dtype="<U16"), table
    )


def _parse_words(words: list[str]) -> tuple[int, list[float]]:
    """Return the number of the frame and the numbers after the type of a line; `ValueError` says what is wrong with it."""
    if not LABEL_FIELDS <= len(words) <= RESULT_FIELDS or (words[2] not in CATEGORY_OF and words[2] != NOT_LABELED):
        known = ", ".join([*CATEGORY_OF, NOT_LABELED])
        raise ValueError(f"expected frame, track id, type ({known}) and {LABEL_FIELDS - 3} numbers")
    try:
        frame, row = parse_int(words[0]), [parse_float(word) for word in words[3:LABEL_FIELDS]]
    except ValueError:
        raise ValueError(f"expected numbers after the type, found '{' '.join(words)[:60]}'") from None
    if not (np.abs(row) <= MAX_POSITION_M).all():  # False for NaN
        raise ValueError(f"a number is not finite, or larger than {MAX_POSITION_M:g}")
    if not 0 <= frame <= MAX_FRAME:
        raise ValueError(f"frame {words[0][:20]}, expected 0 to {MAX_FRAME}")
    return frame, row


def boxes_in_map(map_T_rect: Array, values: Array) -> tuple[Array, Array, Array]:
    """Box centers (L, 3), sizes (L, 3) and yaws (L,) in the map.

    Parameters
    ----------
    map_T_rect : (L, 4, 4)
        Pose of the rectified camera 0, whose frame the labels are in, at the stamp of each label.
    values : (L, 7)
        Height, width, length, x, y, z of the bottom's center, rotation about the camera's y axis.
    """
    height, width, length = values[:, 0], values[:, 1], values[:, 2]
    center = values[:, 3:6] - np.stack([np.zeros_like(height), height / 2, np.zeros_like(height)], axis=1)
    turn = values[:, 6]
    ahead = np.stack([np.cos(turn), np.zeros_like(turn), -np.sin(turn)], axis=1)
    heading = np.einsum("lij,lj->li", map_T_rect[:, :3, :3], ahead)
    yaw = wrap_angle(np.arctan2(heading[:, 1], heading[:, 0]))
    return apply(map_T_rect, center), np.stack([length, width, height], axis=1), yaw
