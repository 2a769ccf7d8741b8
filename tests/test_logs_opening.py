"""Boxes of a file, in any of the formats that are read, as labels of any log."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from log2sim.datatypes import Labels, Log
from log2sim.errors import LogError
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.evaluation.metrics.truth import truth_from_log
from log2sim.geometry import NS_PER_S, inverse, quaternion_from_rotation, rotation_from_rpy, transform, wrap_angle
from log2sim.logs.opening import open_log


def _in_frame(labels: Labels, frame_T_map: Any) -> Any:
    """Poses (L, 4, 4) of labeled boxes in a frame."""
    rotation = rotation_from_rpy(0 * labels.yaw_rad, 0 * labels.yaw_rad, labels.yaw_rad)
    return frame_T_map @ transform(rotation, labels.center_m)


def _wxyz(poses: Any) -> list[list[float]]:
    rows: list[list[float]] = quaternion_from_rotation(poses[:, :3, :3]).tolist()
    return rows


def _kitti_lines(log: Log, labels: Labels) -> str:
    """Lines as the benchmark's own development kit describes them; its boxes stand upright in the camera's axes."""
    stamps = log.streams["front"].t_ns
    poses = _in_frame(labels, inverse(log.map_T_sensor("front", labels.t_ns)[0]))
    lines = []
    for k, pose in enumerate(poses):
        length, width, height = labels.size_m[k]
        x, y, z = pose[:3, 3]
        turn = -np.arctan2(pose[2, 0], pose[0, 0])
        kind = {"car": "Car", "pedestrian": "Pedestrian"}[labels.category[k]]
        numbers = [0, 0, 0, 1, 2, 30, 40, height, width, length, x, y + height / 2, z, turn]
        frame = int(np.argmin(np.abs(stamps - labels.t_ns[k])))
        lines.append(f"{frame} {labels.track_id[k]} {kind} {' '.join(map(repr, map(float, numbers)))}")
    return "\n".join(
        ["0 -1 DontCare -1 -1 -10 5 6 7 8 -1 -1 -1 -1000 -1000 -1000 -10", *lines, f"999 {lines[0].partition(' ')[2]}"]
    )


def _nuscenes_results(labels: Labels) -> str:
    poses = _in_frame(labels, np.eye(4))
    boxes = [
        {
            "sample_token": str(k % 3), "translation": pose[:3, 3].tolist(), "size": labels.size_m[k, [1, 0, 2]].tolist(),
            "rotation": turn, "tracking_id": str(labels.track_id[k]), "tracking_name": str(labels.category[k]),
            "timestamp": int(labels.t_ns[k]) // 1000,
        }
        for k, (pose, turn) in enumerate(zip(poses, _wxyz(poses), strict=True))
    ]  # fmt: skip
    return json.dumps({"meta": {}, "results": {t: [b for b in boxes if b["sample_token"] == t] for t in "012"}})


def _openlabel(log: Log, labels: Labels) -> str:
    """Boxes of the first half in the frame of the ego by Euler angles, the others in that of a sensor by quaternions."""
    frames: dict[str, Any] = {}
    for k, stamp in enumerate(labels.t_ns.tolist()):
        early = stamp < np.median(labels.t_ns)
        map_T = log.ego.at(np.array([stamp]))[0] if early else log.map_T_sensor("top", stamp)[0]  # type: ignore[union-attr]
        pose = inverse(map_T[0]) @ _in_frame(labels, np.eye(4))[k]
        w, x, y, z = quaternion_from_rotation(pose[:3, :3]).tolist()
        roll_pitch_yaw = [0.0, 0.0, float(np.arctan2(pose[1, 0], pose[0, 0]))]
        cuboid = {
            "name": "box", "val": [*pose[:3, 3].tolist(), *(roll_pitch_yaw if early else [x, y, z, w]), *labels.size_m[k].tolist()],
            "coordinate_system": "vehicle" if early else "top",
        }  # fmt: skip
        frame = frames.setdefault(str(stamp), {"frame_properties": {"timestamp": f"{stamp}"}, "objects": {}})
        frame["objects"][str(labels.track_id[k])] = {"object_data": {"cuboid": [cuboid]}}
    objects = {str(t): {"name": t, "type": str(c).capitalize()} for t, c in zip(labels.track_id, labels.category)}
    systems = {"vehicle": {"type": "local_cs"}, "top": {"type": "sensor_cs"}}
    return json.dumps(
        {"openlabel": {"metadata": {}, "coordinate_systems": systems, "objects": objects, "frames": frames}}
    )


def _table(labels: Labels) -> str:
    rows = [
        f"{t},{i},{c},{','.join(map(repr, [*map(float, center), *map(float, size), float(yaw)]))}"
        for t, i, c, center, size, yaw in zip(
            labels.t_ns, labels.track_id, labels.category, labels.center_m, labels.size_m, labels.yaw_rad, strict=True
        )
    ]
    return "\n".join(["t_ns,track_id,category,x_m,y_m,z_m,length_m,width_m,height_m,yaw_rad", *rows])


@pytest.mark.parametrize("kind", ["kitti", "nuscenes", "openlabel", "csv"])
def test_boxes_of_a_file_of_any_format_are_the_labels_of_any_log(kind: str, tiny_folder: Path, tmp_path: Path) -> None:
    log = open_log(tiny_folder)
    assert log.labels is not None
    own = log.labels
    if kind == "kitti":  # whose boxes are those of pictures
        stamps = log.streams["front"].t_ns
        k = np.flatnonzero(
            np.abs(own.t_ns - stamps[np.argmin(np.abs(stamps - own.t_ns[:, None]), axis=1)]) < 40_000_000
        )
        near = stamps[np.argmin(np.abs(stamps - own.t_ns[k][:, None]), axis=1)]
        own = Labels(near, own.track_id[k], own.category[k], own.center_m[k], own.size_m[k], own.yaw_rad[k])
    text = {
        "kitti": lambda: _kitti_lines(log, own), "nuscenes": lambda: _nuscenes_results(own),
        "openlabel": lambda: _openlabel(log, own), "csv": lambda: _table(own),
    }[kind]()  # fmt: skip
    (tmp_path / "boxes.any").write_text(text)
    found = open_log(tiny_folder, labels=tmp_path / "boxes.any")
    theirs = found.labels
    assert theirs is not None
    ours, other = (np.lexsort((side.t_ns, side.track_id)) for side in (own, theirs))
    if kind == "kitti":
        assert "DontCare" not in set(theirs.category)
        assert found.ignored_regions["front"].box_px.tolist() == [[5.0, 6.0, 7.0, 8.0]]
        assert any("after the last" in note for note in found.notes)
    assert theirs.track_id[other].tolist() == own.track_id[ours].tolist()
    assert theirs.category[other].tolist() == own.category[ours].tolist()
    np.testing.assert_allclose(theirs.t_ns[other], own.t_ns[ours], rtol=0, atol=1000)  # us of nuScenes
    np.testing.assert_allclose(theirs.center_m[other], own.center_m[ours], rtol=0, atol=1e-5)
    np.testing.assert_allclose(theirs.size_m[other], own.size_m[ours], rtol=0, atol=1e-9)
    np.testing.assert_allclose(wrap_angle(theirs.yaw_rad[other] - own.yaw_rad[ours]), 0, atol=1e-6)
    assert evaluate(truth_from_log(log), found)["recall"] == 1.0


BOX = {
    "translation": [1.0, 2.0, 3.0], "size": [1.0, 2.0, 3.0], "rotation": [1.0, 0.0, 0.0, 0.0], "tracking_id": "a",
    "tracking_name": "car", "timestamp": 1_700_000_000_000_000,
}  # fmt: skip
CUBOID = {"val": [0.0] * 6 + [1.0] * 3}


def _one_cuboid(cuboid: Any, stamp: Any = 1.0, kind: Any = "car") -> str:
    frame = {"frame_properties": {"timestamp": stamp}, "objects": {"1": {"object_data": {"cuboid": [cuboid]}}}}
    return json.dumps({"openlabel": {"objects": {"1": {"type": kind}}, "frames": {"0": frame}}})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected lines of KITTI"),
        ("t_ns,x\n1,2", "track_id"),
        (json.dumps([1]), "box 0"),
        (json.dumps([{**BOX, "size": [1, 2]}]), "size: expected 3 numbers"),
        (json.dumps([{**BOX, "size": [0, 2, 1]}]), "no object has this size"),
        (json.dumps([{**BOX, "rotation": [9, 0, 0, 0]}]), "unit quaternion"),
        (json.dumps([{**BOX, "tracking_name": "dragon"}]), "no box of a known category"),
        (json.dumps([{**BOX, "tracking_id": None}]), "tracking_id"),
        (json.dumps([{**BOX, "timestamp": 1}]).replace('"timestamp": 1', '"timestamp": 1e400'), "finite"),
        (json.dumps([{**BOX, "timestamp": 10**15}]), "both of one drive"),
        (_one_cuboid({**CUBOID, "coordinate_system": "moon"}), "'moon' is not known"),
        (_one_cuboid({**CUBOID, "val": [1, 2]}), "9 or 10 numbers"),
        (_one_cuboid(CUBOID, stamp="noon"), "'noon'"),
        (_one_cuboid(CUBOID, stamp=None).replace('"0":', '"7000":'), "has the frames"),
        ('{"openlabel": []}', "no object"),
    ],
)  # fmt: skip
def test_a_file_of_boxes_that_cannot_be_right_is_refused(
    text: str, words: str, tiny_folder: Path, tmp_path: Path
) -> None:
    (tmp_path / "boxes").write_text(text)
    with pytest.raises(LogError, match=re.escape(words)) as caught:
        open_log(tiny_folder, labels=tmp_path / "boxes")
    assert str(tmp_path / "boxes") in str(caught.value)


@pytest.mark.parametrize(
    "stamp", [0.5, 1.7e9 + 0.5, "2023-11-14T22:13:20.5Z", (17 * 10**8 + 0.5) * 1e3, (17 * 10**8 + 0.5) * 1e6]
)
def test_stamps_of_openlabel_are_seconds_or_finer_ones_since_1970_or_the_start(
    stamp: Any, tiny_folder: Path, tmp_path: Path
) -> None:
    (tmp_path / "boxes").write_text(_one_cuboid(CUBOID, stamp=stamp))
    log = open_log(tiny_folder, labels=tmp_path / "boxes")
    start_ns = min(int(s.t_ns[0]) for s in log.streams.values()) if stamp == 0.5 else 1_700_000_000 * NS_PER_S
    assert log.labels is not None
    assert abs(int(log.labels.t_ns[0]) - start_ns - 500_000_000) < 1000
