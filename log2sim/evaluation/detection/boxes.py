"""Boxes of several scenes as one table, found or true, and as a file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.datatypes import Boxes3D
from log2sim.errors import LogError
from log2sim.files.arrays import Columns
from log2sim.files.documents import check, load_schema, read_json, rounded, short_repr, write_json
from log2sim.geometry import Array


@dataclass(frozen=True, eq=False)
class SceneBoxes(Columns):
    """Boxes of several scenes, one row a box: those that a detector found, or the true ones."""

    # (M,) number of the scene (one sweep, one sample) that each box belongs to; only boxes of one scene match.
    scene: NDArray[np.int64]
    box: Array  # (M, 7), m and rad center x, y, z, length, width, height, yaw; found and true boxes in the same frame
    category: NDArray[np.str_]  # (M,)
    score: Array  # (M,) of found boxes; 1 for true ones
    points: NDArray[np.int64] | None  # (M,) number of LiDAR points in each box; None when it was not counted
    range_m: Array  # (M,) horizontal distance from the sensor
    # (M,) neither right nor wrong: true boxes that nobody has to find, found ones that truth cannot judge
    ignored: NDArray[np.bool_]

    def __post_init__(self) -> None:
        """Check that the columns fit each other and that scores are numbers."""
        rows = len(self.scene)
        if self.box.shape != (rows, 7):
            raise ValueError(f"box has the shape {self.box.shape}, expected ({rows}, 7)")
        for name in ("category", "score", "points", "range_m", "ignored"):
            column = getattr(self, name)
            if column is not None and column.shape != (rows,):
                raise ValueError(f"{name} has the shape {column.shape}, expected ({rows},)")
        if not np.isfinite(self.score).all():
            raise ValueError("a score is not finite")

    @classmethod
    def of(
        cls,
        box: ArrayLike,
        category: ArrayLike = "",
        score: ArrayLike = 1.0,
        *,
        scene: ArrayLike = 0,
        points: ArrayLike | None = None,
        range_m: ArrayLike | None = None,
        ignored: ArrayLike = False,
    ) -> Self:
        """Make a table from arrays; a single value holds for all rows.

        `box` (M, 7), m and rad: x, y, z, length, width, height, yaw. `category`, `score`, `scene`, `points`, `ignored`
        (M,) or a single value. `range_m` (M,) or a single value, optional: by default the distance from the origin of
        the boxes' frame.
        """
        rows = np.asarray(box, dtype=np.float64).reshape(-1, 7)
        away = np.hypot(rows[:, 0], rows[:, 1]) if range_m is None else range_m

        def column(values: ArrayLike, kind: Any = None) -> NDArray[Any]:
            return np.array(np.broadcast_to(np.asarray(values, dtype=kind), len(rows)))

        counts = None if points is None else column(points, np.int64)
        named = column(scene, np.int64), rows, column(category, np.str_), column(score, np.float64)
        return cls(*named, counts, column(away, np.float64), column(ignored, np.bool_))

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        """Join one table for each scene; scenes are numbered by their place in the sequence.

        The number of points is kept when all tables that are not empty have it.
        """
        numbered = [replace(part, scene=np.full(len(part), k)) for k, part in enumerate(parts)]
        some = [part for part in numbered if len(part)] or numbered[:1]
        return super().join(some) if some else cls.of(np.zeros((0, 7)))

    def ignoring(self, rows: NDArray[np.bool_]) -> Self:
        """Return the table with the boxes of a mask (M,) ignored, too."""
        return replace(self, ignored=self.ignored | rows)


FORMAT, VERSION = "log2sim-boxes", 1
DIGITS = 4  # 0.1 mm, 0.006 degrees, 0.01 % of a score


@dataclass(frozen=True, eq=False)
class DetectedBoxes:
    """Boxes that a detector found in a log, sweep by sweep."""

    __repr__ = short_repr

    # log, detector: names of both.
    log: str
    detector: str
    t_ns: NDArray[np.int64]  # (F,) absolute stamps of the sweeps, increasing; also of those in which nothing was found
    boxes: tuple[Boxes3D, ...]  # map frame of the log
    # Where the poses come from that place them there, see `PoseChoice.to_provenance`.
    poses: Mapping[str, Any] = field(default_factory=dict)

    def save(self, path: Path | str) -> None:
        """Write the file under a temporary name and rename it."""
        document: dict[str, Any] = {"format": FORMAT, "version": VERSION, "log": self.log, "detector": self.detector}
        document |= {"poses": dict(self.poses)} if self.poses else {}
        frames = []
        for t_ns, b in zip(self.t_ns.tolist(), self.boxes, strict=True):
            rows = [
                {
                    "center_m": [rounded(v, DIGITS) for v in b.center_m[k]],
                    "size_m": [rounded(v, DIGITS) for v in b.size_m[k]],
                    "yaw_rad": rounded(b.yaw_rad[k], DIGITS),
                    "heading_score": rounded(b.heading_score[k], DIGITS),
                    "category": str(b.category[k]),
                    "score": rounded(b.score[k], DIGITS),
                    "points": int(b.points[k]),
                }
                for k in range(len(b))
            ]
            frames.append({"t_ns": t_ns, "boxes": rows})
        write_json(path, {**document, "frames": frames})

    @classmethod
    def load(cls, path: Path | str) -> DetectedBoxes:
        """Read a file.

        Raises `LogError` for a file that is missing, too large or no JSON, violates the schema, or whose stamps do not
        increase.
        """
        document = read_json(path)
        try:
            return cls.from_dict(document)
        except LogError as error:
            raise LogError(f"{path}: {error}") from None

    @classmethod
    def from_dict(cls, document: Any) -> DetectedBoxes:
        """Build them from a document, which is checked against the schema.

        Raises `LogError`: as for `load`.
        """
        if not is_boxes_document(document):
            raise LogError(f"not a boxes file: expected format '{FORMAT}', as `log2sim detect` writes it")
        # The boxes are validated column by column: item by item, a long log takes minutes. Where that finds a fault, the full check gives its message.
        box: dict[str, Any] = load_schema("boxes-1")["$defs"]["box"]
        try:
            listed = all(type(frame["boxes"]) is list for frame in document["frames"])
            rows = [row for frame in document["frames"] for row in frame["boxes"]] if listed else []
            valid = listed and all(row.keys() == box["properties"].keys() for row in rows)
            valid = valid and all(_column_is_valid([row[k] for row in rows], v) for k, v in box["properties"].items())
        except (AttributeError, KeyError, TypeError):
            valid = False
        if valid:
            check({**document, "frames": [{**frame, "boxes": []} for frame in document["frames"]]}, "boxes-1", LogError)
        else:
            check(document, "boxes-1", LogError)
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
    low, above = expected.get("minimum", -math.inf), expected.get("exclusiveMinimum", -math.inf)
    return set(map(type, values)) <= types and above < min(values) >= low and max(values) <= expected["maximum"]


def _from_rows(rows: list[dict[str, Any]], t_ns: int) -> Boxes3D:
    if not rows:
        return Boxes3D.empty()
    kinds = {"category": np.str_, "points": np.int64}
    keys = ("center_m", "size_m", "yaw_rad", "heading_score", "category", "score", "points")
    columns: list[Any] = [np.array([row[key] for row in rows], dtype=kinds.get(key, np.float64)) for key in keys]
    return Boxes3D(np.full(len(rows), t_ns, dtype=np.int64), *columns)
