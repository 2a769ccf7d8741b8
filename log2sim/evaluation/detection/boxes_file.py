"""The boxes file: what a detector found in the sweeps of a log (`schemas/boxes-1.json`)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Boxes3D
from log2sim.documents import check, load_schema, read_json, rounded, write_json
from log2sim.errors import LogError
from log2sim.numerals import short_repr

FORMAT, VERSION = "log2sim-boxes", 1
DIGITS = 4  # 0.1 mm, 0.006 degrees, 0.01 % of a score


@dataclass(frozen=True, eq=False)
class DetectedBoxes:
    """Boxes that a detector found in a log, sweep by sweep.

    Attributes
    ----------
    log, detector : str
        Names of both.
    t_ns : (F,) int64
        Absolute stamps of the sweeps, increasing; also of those in which nothing was found.
    boxes : F Boxes3D
        Map frame of the log.
    poses : mapping of str to Any
        Where the poses come from that place them there, see `PoseChoice.to_provenance`.
    """

    __repr__ = short_repr

    log: str
    detector: str
    t_ns: NDArray[np.int64]
    boxes: tuple[Boxes3D, ...]
    poses: Mapping[str, Any] = field(default_factory=dict)

    def save(self, path: Path | str) -> None:
        """Write the file under a temporary name and rename it."""
        frames = [
            {"t_ns": int(t), "boxes": _to_rows(found)} for t, found in zip(self.t_ns.tolist(), self.boxes, strict=True)
        ]
        document = {"format": FORMAT, "version": VERSION, "log": self.log, "detector": self.detector}
        document |= ({"poses": dict(self.poses)} if self.poses else {}) | {"frames": frames}
        write_json(path, document)

    @classmethod
    def load(cls, path: Path | str) -> DetectedBoxes:
        """Read a file.

        Raises
        ------
        LogError
            For a file that is missing, too large or no JSON, violates the schema, or whose stamps do not increase.
        """
        document = read_json(path)
        try:
            return cls.from_dict(document)
        except LogError as error:
            raise LogError(f"{path}: {error}") from None

    @classmethod
    def from_dict(cls, document: Any) -> DetectedBoxes:
        """Build them from a document, which is checked against the schema.

        Raises
        ------
        LogError
            As for `load`.
        """
        _check(document)
        frames = document["frames"]
        try:
            t_ns = np.array([f["t_ns"] for f in frames], dtype=np.int64)
        except OverflowError:
            raise LogError("frames: a stamp does not fit into 64 bits; expected nanoseconds") from None
        late = np.flatnonzero(np.diff(t_ns) <= 0) + 1
        if len(late):
            raise LogError(
                f"frames[{late[0]}].t_ns: {t_ns[late[0]]} does not follow {t_ns[late[0] - 1]}; expected increasing stamps"
            )
        boxes = tuple(_from_rows(f["boxes"], int(t)) for f, t in zip(frames, t_ns, strict=True))
        return cls(document["log"], document["detector"], t_ns, boxes, document.get("poses", {}))


def is_boxes_document(document: Any) -> bool:
    """Tell whether a document claims to be a boxes file."""
    return isinstance(document, dict) and document.get("format") == FORMAT


def _check(document: Any) -> None:
    """Validate a document, its boxes column by column: item by item, a long log takes minutes."""
    if not is_boxes_document(document):
        raise LogError(f"not a boxes file: expected format '{FORMAT}', as `log2sim detect` writes it")
    if not _boxes_are_valid(document.get("frames")):
        check(document, "boxes-1", LogError)
        return
    frames = [{**frame, "boxes": []} for frame in document["frames"]]
    check({**document, "frames": frames}, "boxes-1", LogError)


def _boxes_are_valid(frames: Any) -> bool:
    """Whether all boxes match the schema; False also where only the full check can tell."""
    box: dict[str, Any] = load_schema("boxes-1")["$defs"]["box"]
    try:
        if any(type(frame["boxes"]) is not list for frame in frames):
            return False
        rows = [row for frame in frames for row in frame["boxes"]]
        if any(row.keys() != box["properties"].keys() for row in rows):
            return False
        return all(_column_is_valid([row[k] for row in rows], v) for k, v in box["properties"].items())
    except (AttributeError, KeyError, TypeError):
        return False


def _column_is_valid(values: list[Any], expected: dict[str, Any]) -> bool:
    if "enum" in expected:
        return set(values) <= set(expected["enum"])
    if expected["type"] == "array":
        if any(type(v) is not list or len(v) != expected["minItems"] for v in values):
            return False
        values, expected = [number for v in values for number in v], expected["items"]
    if not values:
        return True
    types = {int} if expected["type"] == "integer" else {int, float}
    low = min(values) > expected.get("exclusiveMinimum", -math.inf) and min(values) >= expected.get(
        "minimum", -math.inf
    )
    return set(map(type, values)) <= types and low and max(values) <= expected["maximum"]


def _to_rows(boxes: Boxes3D) -> list[dict[str, Any]]:
    return [
        {
            "center_m": [rounded(v, DIGITS) for v in boxes.center_m[k]],
            "size_m": [rounded(v, DIGITS) for v in boxes.size_m[k]],
            "yaw_rad": rounded(boxes.yaw_rad[k], DIGITS),
            "heading_score": rounded(boxes.heading_score[k], DIGITS),
            "category": str(boxes.category[k]),
            "score": rounded(boxes.score[k], DIGITS),
            "points": int(boxes.points[k]),
        }
        for k in range(len(boxes))
    ]


def _from_rows(rows: list[dict[str, Any]], t_ns: int) -> Boxes3D:
    if not rows:
        return Boxes3D.empty()

    def column(key: str, kind: Any = np.float64) -> NDArray[Any]:
        return np.array([row[key] for row in rows], dtype=kind)

    return Boxes3D(
        np.full(len(rows), t_ns, dtype=np.int64),
        column("center_m"),
        column("size_m"),
        column("yaw_rad"),
        column("heading_score"),
        column("category", np.str_),
        column("score"),
        column("points", np.int64),
    )
