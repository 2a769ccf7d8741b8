"""True boxes from a file of their own, for any log: KITTI tracking, nuScenes, OpenLABEL or the table of a log folder.

The format follows from the content. Boxes that are not of a known category are left out and noted.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from log2sim.datatypes import CATEGORIES, ImageRegions, Labels, Log
from log2sim.errors import LogError
from log2sim.files.documents import JSON_LIMIT_BYTES, parse_float, parse_int, read_json
from log2sim.files.inputs import read_file
from log2sim.geometry import NS_PER_S, Array, rotation_from_quaternion, rotation_from_rpy, transform, yaw_of
from log2sim.logs.checks import find_possible
from log2sim.logs.kitti import labels as kitti
from log2sim.logs.native.reader import BOX_3D_COLUMNS, BOX_3D_OPTIONAL, boxes_3d, read_csv_table
from log2sim.logs.nuscenes import scene as nuscenes
from log2sim.logs.stamps import count_words

EXPECTED = (
    "lines of KITTI's tracking labels, JSON of nuScenes (sample_annotation or results) or OpenLABEL, or a CSV table with the "
    f"columns {','.join(BOX_3D_COLUMNS)}"
)
MAX_STAMP_NS = 2**63 - 1
RELATIVE_S = 1e8
"""Smaller numbers count from the start of the log: three years; seconds since 1970 were larger from 1973 on."""

CATEGORY_OF: Mapping[str, str] = {
    "vehicle": "car", "person": "pedestrian", "motorbike": "motorcycle", "trailer": "other", "construction_vehicle": "other",
    **{word.lower(): name for word, name in (*kitti.CATEGORY_OF.items(), *nuscenes.CATEGORY_OF.items())},
    **{name: name for name in CATEGORIES},
}  # fmt: skip


def replace_labels(log: Log, path: Path) -> Log:
    """Return a log with the boxes of a file as its labels, in place of its own.

    Raises `LogError` for a file of none of the formats, and for one without a box at a time at which the log has a pose.
    """
    text = read_file(path, JSON_LIMIT_BYTES, LogError).decode("utf-8-sig", errors="replace")
    first = text[:4096].lstrip()
    notes: list[str] = []
    regions: dict[str, ImageRegions] = {}
    if first[:1] in ("{", "["):
        document = read_json(path)
        is_openlabel = isinstance(document, dict) and "openlabel" in document
        boxes = (
            _openlabel_boxes(log, path, document["openlabel"]) if is_openlabel else _nuscenes_boxes(log, path, document)
        )
        labels = _labels_of(log, path, list(boxes), notes)
    elif "," in first.partition("\n")[0]:
        labels = boxes_3d(read_csv_table(path, BOX_3D_COLUMNS, BOX_3D_OPTIONAL))
        labels = replace(labels, center_m=labels.center_m - np.array(log.map.offset_m))
    elif len(first.partition("\n")[0].split()) in (kitti.LABEL_FIELDS, kitti.RESULT_FIELDS):
        # Place the rows of a KITTI file: frames are those of the reference camera, boxes in its axes
        camera, stamps = _reference(log, path)
        if camera not in log.cameras:
            raise LogError(f"{path}: KITTI's boxes are in the frame of a camera, and {log.name} has none")
        rows = kitti.parse_labels_noting(text, path, notes)
        inside = rows.frame < len(stamps)
        if not inside.all():
            notes.append(f"{int((~inside).sum())} labels left out: of frames after the last of '{camera}'")
        poses_at = partial(log.map_T_sensor, camera)
        placed = kitti.labels_of_rows(rows.take(inside), poses_at, lambda frame: stamps[frame], "", camera)
        assert placed.boxes_3d is not None
        labels, regions = placed.boxes_3d, dict(placed.ignored)
    else:
        raise LogError(f"{path}: is no file of boxes; expected {EXPECTED}")
    possible = find_possible(labels)
    if not possible.all():
        row = int(np.argmin(possible))
        raise LogError(f"{path}: box of '{labels.track_id[row]}': no object has this size or place")
    if not len(labels.t_ns):
        raise LogError(f"{path}: no box at a time and place that {log.name} knows")
    spans = [s.t_ns[[0, -1]] for s in log.streams.values() if len(s.t_ns)]
    first_ns, last_ns = (min(s[0] for s in spans), max(s[1] for s in spans)) if spans else (0, MAX_STAMP_NS)
    if labels.t_ns.max() < first_ns or labels.t_ns.min() > last_ns:
        times = [f"{int(t) / NS_PER_S:.3f}" for t in (labels.t_ns.min(), labels.t_ns.max(), first_ns, last_ns)]
        spanned = f"its boxes are of {times[0]} to {times[1]} s, {log.name} of {times[2]} to {times[3]} s"
        raise LogError(f"{path}: {spanned}; are both of one drive?")
    said = [f"{path.name}: {note}" for note in notes]
    return log.changed(labels=labels, ignored_regions=regions, notes=lambda: (*log.notes, *said))


@dataclass(frozen=True, eq=False)
class _Box:
    """A box as a file states it: its pose in a named frame, "map", "ego" or that of a sensor."""

    where: str
    t_ns: int
    track_id: str
    word: str
    pose: Array
    size_m: Sequence[float]
    frame: str = "map"


def _labels_of(log: Log, path: Path, boxes: list[_Box], notes: list[str]) -> Labels:
    """Place boxes in the map."""
    unknown = [box.word for box in boxes if box.word.lower() not in CATEGORY_OF]
    if unknown:
        notes.append(f"labels left out, of no known category: {count_words(unknown)}")
    found = [box for box in boxes if box.word.lower() in CATEGORY_OF]
    if not found:
        raise LogError(f"{path}: no box of a known category; known: {', '.join(CATEGORY_OF)}")
    t_ns = np.array([box.t_ns for box in found], dtype=np.int64)
    map_T_box = np.stack([box.pose for box in found])
    frames = np.array([box.frame for box in found])
    known = np.ones(len(found), dtype=bool)
    for frame in np.unique(frames).tolist():
        rows = np.flatnonzero(frames == frame)
        if frame == "map":
            map_T_box[rows, :3, 3] -= np.array(log.map.offset_m)
            continue
        where = found[rows[0]].where
        if frame == "ego" and log.ego is None:
            raise LogError(f"{where}: is in the frame of the ego, and the log has none; state boxes in the map")
        if frame == "ego" and log.ego is not None:
            map_T_frame, known[rows] = log.ego.at(t_ns[rows])
        elif frame in log.cameras or frame in log.lidars:
            map_T_frame, known[rows] = log.map_T_sensor(frame, t_ns[rows])
        else:
            there = ", ".join(["map", "ego", *log.cameras, *log.lidars])
            raise LogError(f"{where}: coordinate system '{frame}' is not known; known: {there}")
        map_T_box[rows] = map_T_frame @ map_T_box[rows]
    if not known.all():
        notes.append(f"{int((~known).sum())} labels left out: the pose is not known at their time")
    return Labels(
        t_ns[known],
        np.array([box.track_id for box in found])[known],
        np.array([CATEGORY_OF[box.word.lower()] for box in found], dtype="<U16")[known],
        map_T_box[known, :3, 3],
        np.array([box.size_m for box in found], dtype=np.float64)[known],
        yaw_of(map_T_box[known]),
        kind=np.array([box.word for box in found])[known],
        labeled_ns=np.unique(t_ns),
    )


def _nuscenes_boxes(log: Log, path: Path, document: Any) -> Iterator[_Box]:
    """Read boxes of nuScenes in the map: annotations, with the tables beside them where they name tokens, or results."""
    entries = document
    if isinstance(document, dict):
        results = document.get("results")
        if not isinstance(results, dict) or not all(isinstance(boxes, list) for boxes in results.values()):
            raise LogError(f"{path}: JSON of no known kind of boxes; expected {EXPECTED}")
        entries = [{"sample_token": t, **b} for t, boxes in results.items() for b in boxes if isinstance(b, dict)]
    tables: dict[str, dict[str, Any]] = {}
    for name in ("sample", "instance", "category"):
        file = path.parent / f"{name}.json"
        table = read_json(file) if file.is_file() else []
        rows = table if isinstance(table, list) else []
        tables[name] = {str(row.get("token")): row for row in rows if isinstance(row, dict)}
    for k, entry in enumerate(entries):
        where = f"{path}, box {k}"
        if not isinstance(entry, dict):
            raise LogError(f"{where}: expected an object with translation, size and rotation")
        instance = tables["instance"].get(str(entry.get("instance_token")), {})
        category = tables["category"].get(str(instance.get("category_token")), {})
        sample = tables["sample"].get(str(entry.get("sample_token")), {})
        names = [entry.get(key) for key in ("detection_name", "tracking_name", "category_name")]
        word = next((name for name in (*names, category.get("name")) if isinstance(name, str)), None)
        stamp = entry.get("timestamp", sample.get("timestamp"))
        tracks = [entry.get(key) for key in ("tracking_id", "instance_token")]
        track = next((token for token in tracks if token not in (None, "")), None)
        named = "tracking_name, detection_name or category_name, or instance.json and category.json beside the file"
        for value, what in (
            (word, named),
            (stamp, "timestamp in microseconds, or sample.json beside the file"),
            (track, "tracking_id or instance_token: who is the same must be known over time"),
        ):
            if value is None:
                raise LogError(f"{where}: needs {what}")
        width, length, height = _numbers(entry.get("size"), (3,), f"{where}, size")
        rotation = _rotation(_numbers(entry.get("rotation"), (4,), f"{where}, rotation"), where)
        pose = transform(rotation, _numbers(entry.get("translation"), (3,), f"{where}, translation"))
        yield _Box(where, _stamp_ns(stamp, log, where), str(track), str(word), pose, (length, width, height))


def _openlabel_boxes(log: Log, path: Path, document: Any) -> Iterator[_Box]:
    """Read the cuboids of the frames of an OpenLABEL document (ASAM OpenLABEL 1.0.0, section 8)."""
    for key in ("frames", "objects", "coordinate_systems"):
        if not isinstance(document, dict) or not isinstance(document.get(key, {}), dict):
            raise LogError(f"{path}: openlabel.{key} is no object")
    systems = _inner(document, "coordinate_systems")
    for number, content in _inner(document, "frames").items():
        stamp = _inner(content, "frame_properties").get("timestamp")
        t_ns = None
        for uid, entry in _inner(content, "objects").items():
            word = _inner(_inner(document, "objects"), uid).get("type")
            cuboids = _inner(entry, "object_data").get("cuboid", [])
            for cuboid in cuboids if isinstance(cuboids, list) else [cuboids]:
                where = f"{path}, frame {number}, object '{uid[:40]}'"
                if not isinstance(cuboid, dict) or not isinstance(word, str):
                    expected = "expected a cuboid with 'val', and the object with its 'type' in 'objects'"
                    raise LogError(f"{where}: {expected}")
                if t_ns is None:
                    t_ns = _frame_ns(number, log, path) if stamp is None else _stamp_ns(stamp, log, where)
                values = _numbers(cuboid.get("val"), (9, 10), f"{where}, val")
                angles = len(values) == 9
                turn = rotation_from_rpy(*values[3:6]) if angles else _rotation(values[[6, 3, 4, 5]], where)
                name = str(cuboid.get("coordinate_system", ""))
                kind = str(_inner(systems, name).get("type"))
                frame = {"scene_cs": "map", "geo": "map", "local_cs": "ego"}.get(kind, name or "ego")
                yield _Box(where, t_ns, uid, word, transform(turn, values[:3]), values[-3:].tolist(), frame)


def _inner(entry: Any, key: str) -> dict[str, Any]:
    value = entry.get(key) if isinstance(entry, dict) else None
    return value if isinstance(value, dict) else {}


def _numbers(value: Any, counts: tuple[int, ...], where: str) -> Array:
    """Return a list of as many finite numbers as one of `counts`."""
    if not isinstance(value, list) or len(value) not in counts or any(type(v) not in (int, float) for v in value):
        raise LogError(f"{where}: expected {' or '.join(map(str, counts))} numbers")
    return np.array(value, dtype=np.float64)


def _rotation(quaternion: Array, where: str) -> Array:
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1) <= 0.01:  # as rounded to two decimals
        raise LogError(f"{where}: a rotation of length {length:g}, expected a unit quaternion")
    return rotation_from_quaternion(quaternion / length)


def _reference(log: Log, path: Path) -> tuple[str, Any]:
    """Return the sensor whose records number the frames of label files, and their stamps."""
    names = [*([log.reference_camera] if log.reference_camera else []), *log.cameras, *log.lidars]
    name = next((n for n in names if n in log.streams and len(log.streams[n].t_ns)), None)
    if name is None:
        raise LogError(f"{path}: counts frames, and {log.name} has neither pictures nor sweeps")
    return name, log.streams[name].t_ns


def _frame_ns(number: str, log: Log, path: Path) -> int:
    name, stamps = _reference(log, path)
    try:
        frame = parse_int(number)
    except ValueError:
        frame = -1
    if not 0 <= frame < len(stamps):
        there = f"'{name}' has the frames 0 to {len(stamps) - 1}; or state a timestamp"
        raise LogError(f"{path}, frame '{number[:20]}': {there}")
    return int(stamps[frame])


def _stamp_ns(value: Any, log: Log, where: str) -> int:
    """Return a stamp in ns: of a number in s, ms, us or ns since 1970, by its size, or in s since the start; or of an ISO 8601 text."""
    number: int | float | None = value if type(value) in (int, float) else None
    if isinstance(value, str):
        try:
            number = parse_int(value) if value.isdigit() else parse_float(value)
        except ValueError:
            try:
                moment = datetime.fromisoformat(value)
            except ValueError:
                raise LogError(f"{where}: timestamp '{value[:40]}', expected a number or an ISO 8601 time") from None
            moment = moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
            return round((moment - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds() * 1e6) * 1000
    if number is None or not 0 <= number <= MAX_STAMP_NS:
        raise LogError(f"{where}: timestamp {str(value)[:40]}, expected a number or an ISO 8601 time")
    if number < RELATIVE_S:
        starts = [int(s.t_ns[0]) for s in log.streams.values() if len(s.t_ns)]
        return min(starts, default=0) + round(number * NS_PER_S)
    scale = next(s for limit, s in ((1e11, NS_PER_S), (1e14, 10**6), (1e17, 10**3), (np.inf, 1)) if number < limit)
    return round(number * scale)
