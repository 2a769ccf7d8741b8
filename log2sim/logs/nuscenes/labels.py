"""Annotations of nuScenes as labels: each at the time at which the LiDAR scanned it, interpolated between key frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Labels
from log2sim.errors import LogError
from log2sim.geometry import Array, apply, inverse, rotation_from_quaternion, wrap_angle, yaw_of
from log2sim.logs.notes import note_left_out
from log2sim.logs.nuscenes.scene import Channel, Scene
from log2sim.logs.nuscenes.sweeps import TURN_NS
from log2sim.logs.nuscenes.tables import Record, numbers_of, quaternions_of, stamp_ns_of, text_of
from log2sim.logs.spinning import compute_scan_offset_ns

ANNOTATIONS = "sample_annotation"
CATEGORY_OF = {
    "vehicle.car": "car",
    "vehicle.truck": "truck",
    "vehicle.bus.bendy": "bus",
    "vehicle.bus.rigid": "bus",
    "vehicle.motorcycle": "motorcycle",
    "vehicle.bicycle": "bicycle",
    "vehicle.construction": "other",
    "vehicle.emergency.ambulance": "other",
    "vehicle.emergency.police": "other",
    "vehicle.trailer": "other",
    "human.pedestrian.adult": "pedestrian",
    "human.pedestrian.child": "pedestrian",
    "human.pedestrian.construction_worker": "pedestrian",
    "human.pedestrian.police_officer": "pedestrian",
    "human.pedestrian.wheelchair": "pedestrian",
    "human.pedestrian.personal_mobility": "other",
    "human.pedestrian.stroller": "other",
}
NO_ROAD_USERS = {
    "animal", "movable_object.barrier", "movable_object.debris", "movable_object.pushable_pullable",
    "movable_object.trafficcone", "static_object.bicycle_rack",
}  # fmt: skip
WITH_RIDER = "cycle.with_rider"
# Visibility in the pictures of all cameras together: 1 is up to 40 %.
HARDLY_VISIBLE = "1"
# An object that crosses the direction in which the turns start would get two labels within a few ms.
MIN_STEP_NS = 10_000_000
# Key frames are 0.4 to 0.6 s apart; over more than a missing one nothing is interpolated.
MAX_GAP_NS = 1_100_000_000


@dataclass(frozen=True, eq=False)
class _Rows:
    """Annotations as columns, A rows, in the order of instances and stamps."""

    sample: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    track_id: NDArray[np.str_]
    kind: NDArray[np.str_]
    category: NDArray[np.str_]
    center_m: Array
    size_m: Array
    yaw_rad: Array
    visible: NDArray[np.bool_]

    def take(self, index: NDArray[Any], **changes: Any) -> _Rows:
        """Select rows; `changes` replace columns of the selection."""
        columns = {name: column[index] for name, column in vars(self).items()}
        return _Rows(**{**columns, **changes})


def read_labels(scene: Scene, lidar: Channel | None, offset_m: Array, notes: list[str]) -> Labels | None:
    """Read the annotations of a scene.

    Parameters
    ----------
    scene : Scene
    lidar : Channel or None
        In whose sweeps objects were labeled.
    offset_m : (3,) float64
        Taken off positions.
    notes : list of str
        Takes what was left out.

    Returns
    -------
    Labels or None
        None for a scene without annotations, as those of the test split are.

    Notes
    -----
    A box fits the points where they were measured, and the LiDAR scans different directions at different times of its
    turn. Of the one fast car with points at hand, the box ends 2 cm from points of 16 ms before the stamp, in which it
    drove 15 cm.
    Between annotations of an instance in consecutive samples boxes are added for each turn of the LiDAR: positions
    linear, yaw the shorter way, size, category and visibility of the nearer one. `labeled_ns` are the samples alone.
    """
    sample_path = scene.tables.path("sample")
    samples = {text_of(sample, "token", sample_path): k for k, sample in enumerate(scene.samples)}
    annotations = scene.tables.matching(ANNOTATIONS, "sample_token", samples)
    if not annotations:
        notes.append("the scene has no annotations: nothing is labeled")
        return None
    stamps = np.array([stamp_ns_of(sample, sample_path) for sample in scene.samples], dtype=np.int64)
    rows = _rows_of(scene, annotations, samples, notes)
    t_ns = scanned_ns(scene, lidar, stamps[rows.sample], rows.center_m)
    rows = rows.take(np.arange(len(rows.t_ns)), t_ns=t_ns)
    ends_ns = turn_ends(stamps if lidar is None else np.union1d(stamps, lidar.t_ns))
    rows = _joined([rows, _between(scene, lidar, rows, stamps, ends_ns)])
    return Labels(
        rows.t_ns,
        rows.track_id,
        rows.category,
        rows.center_m - offset_m,
        rows.size_m,
        rows.yaw_rad,
        visible=rows.visible,
        kind=rows.kind,
        labeled_ns=np.unique(stamps - (0 if lidar is None else TURN_NS // 2)),
    )


def turn_ends(t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Stamps of all turns of the LiDAR: those known (F,), and others about every 50 ms where they are farther apart.

    Tables with key frames alone know two turns a second. What is nearer than 10 ms to the one before is no turn.
    """
    t_ns = t_ns[np.diff(t_ns, prepend=t_ns[0] - MIN_STEP_NS) >= MIN_STEP_NS]
    step = np.diff(t_ns)
    missing = np.where(step <= MAX_GAP_NS, np.maximum(np.round(step / TURN_NS).astype(np.int64) - 1, 0), 0)
    first = np.repeat(np.arange(len(missing)), missing)
    number = np.arange(len(first)) - np.repeat(np.cumsum(missing) - missing, missing) + 1
    step_ns = (step // (missing + 1))[first]
    return np.union1d(t_ns, t_ns[first] + number * step_ns)


def scanned_ns(scene: Scene, lidar: Channel | None, t_ns: NDArray[np.int64], center_m: Array) -> NDArray[np.int64]:
    """Compute when (L,) the LiDAR scanned objects at `center_m` (L, 3) in the turns that end at `t_ns` (L,)."""
    if lidar is None:
        return t_ns
    map_T_ego, known = scene.ego.at(t_ns)
    local = apply(inverse(map_T_ego @ lidar.ego_T_sensor), center_m)
    return np.where(known, t_ns + compute_scan_offset_ns(local, TURN_NS), t_ns).astype(np.int64)


def _between(
    scene: Scene, lidar: Channel | None, rows: _Rows, stamps: NDArray[np.int64], ends_ns: NDArray[np.int64]
) -> _Rows:
    """Interpolate annotations of one instance in consecutive samples (S,) at the turns that end between them."""
    step_ns = np.diff(rows.t_ns)
    same = (rows.track_id[1:] == rows.track_id[:-1]) & (step_ns > 0) & (step_ns <= MAX_GAP_NS)
    before = np.flatnonzero(same & (np.diff(rows.sample) == 1))
    first = np.searchsorted(ends_ns, stamps[rows.sample[before]], side="right")
    count = np.maximum(np.searchsorted(ends_ns, stamps[rows.sample[before + 1]]) - first, 0)
    pair = np.repeat(before, count)
    end_ns = ends_ns[np.repeat(first, count) + np.arange(len(pair)) - np.repeat(np.cumsum(count) - count, count)]
    begin_ns, span_ns = rows.t_ns[pair], rows.t_ns[pair + 1] - rows.t_ns[pair]
    step = rows.center_m[pair + 1] - rows.center_m[pair]
    roughly = ((end_ns - TURN_NS // 2 - begin_ns) / span_ns)[:, None]
    t_ns = scanned_ns(scene, lidar, end_ns, rows.center_m[pair] + roughly * step)
    share = (t_ns - begin_ns) / span_ns
    keep = (t_ns - begin_ns >= MIN_STEP_NS) & (begin_ns + span_ns - t_ns >= MIN_STEP_NS)
    keep[1:] &= (pair[1:] != pair[:-1]) | (np.diff(t_ns) >= MIN_STEP_NS)
    turn = wrap_angle(rows.yaw_rad[pair + 1] - rows.yaw_rad[pair])
    center = rows.center_m[pair] + share[:, None] * step
    yaw = wrap_angle(rows.yaw_rad[pair] + share * turn)
    nearer = np.where(share <= 0.5, pair, pair + 1)
    return rows.take(nearer[keep], t_ns=t_ns[keep], center_m=center[keep], yaw_rad=yaw[keep])


def _joined(parts: list[_Rows]) -> _Rows:
    """Join rows in the order of their stamps."""
    columns = {name: np.concatenate([vars(part)[name] for part in parts]) for name in vars(parts[0])}
    return _Rows(**columns).take(np.argsort(columns["t_ns"], kind="stable"))


def _rows_of(scene: Scene, annotations: list[Record], samples: dict[str, int], notes: list[str]) -> _Rows:
    """Check annotations and return them as columns; stamps are still 0."""
    path = scene.tables.path(ANNOTATIONS)
    kinds = _kinds(scene, annotations, path)
    attributes = {token: str(r.get("name")) for token, r in scene.tables.all_of("attribute").items()}
    category = [
        _category(kind, {attributes.get(str(token), "") for token in _tokens(a, path)})
        for kind, a in zip(kinds, annotations)
    ]
    size = numbers_of(annotations, "size", (3,), path)[:, [1, 0, 2]]  # tables: width, length, height
    rows = _Rows(
        np.array([samples[a["sample_token"]] for a in annotations], dtype=np.int64),
        np.zeros(len(annotations), dtype=np.int64),
        np.array([a["instance_token"] for a in annotations]),
        np.array(kinds),
        np.array(category, dtype="<U16"),
        numbers_of(annotations, "translation", (3,), path),
        size,
        yaw_of(rotation_from_quaternion(quaternions_of(annotations, path))),
        np.array([_is_visible(a) for a in annotations], dtype=bool),
    )
    note_left_out((kind for kind, word in zip(kinds, category) if not word), NO_ROAD_USERS, notes)
    flat = ~(size > 0).all(axis=1)
    if flat.any():
        notes.append(f"{int(flat.sum())} labels left out because a size is not above 0")
    kept = np.flatnonzero((rows.category != "") & ~flat)
    kept = kept[np.lexsort((rows.sample[kept], rows.track_id[kept]))]
    same = (np.diff(rows.sample[kept]) == 0) & (rows.track_id[kept][1:] == rows.track_id[kept][:-1])
    if same.any():
        notes.append(f"{int(same.sum())} labels repeat an instance in its sample; dropped")
    return rows.take(kept[np.r_[True, ~same][: len(kept)]])


def _kinds(scene: Scene, annotations: list[Record], path: Path) -> list[str]:
    """Names of the categories of annotations."""
    tokens = [text_of(a, "instance_token", path) for a in annotations]
    instances = scene.tables.by_token("instance", tokens)
    categories = scene.tables.all_of("category")
    words = {}
    for token, instance in instances.items():
        wanted = text_of(instance, "category_token", scene.tables.path("instance"))
        if wanted not in categories:
            raise LogError(
                f"{scene.tables.path('category')}: no record with token '{wanted[:40]}', which instance.json names"
            )
        words[token] = text_of(categories[wanted], "name", scene.tables.path("category"))
    return [words[token] for token in tokens]


def _category(kind: str, attributes: set[str]) -> str:
    word = CATEGORY_OF.get(kind, "")
    return "cyclist" if word == "bicycle" and WITH_RIDER in attributes else word


def _tokens(annotation: Record, path: Path) -> list[Any]:
    tokens = annotation.get("attribute_tokens", [])
    if not isinstance(tokens, list):
        raise LogError(f"{path}, token {str(annotation.get('token'))[:40]!a}: 'attribute_tokens' is no list")
    return tokens


def _is_visible(annotation: Record) -> bool:
    """Whether the sensors hit an object and its visibility, where it is stated, is above 40 %."""
    counts = [annotation.get(key, 0) for key in ("num_lidar_pts", "num_radar_pts")]
    hit = any(isinstance(count, int) and count > 0 for count in counts)
    return hit and annotation.get("visibility_token") != HARDLY_VISIBLE
