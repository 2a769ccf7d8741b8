"""Any log as a log folder: the same scenario comes of it, and of a part what comes of that part."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from command_line import names, run
from log_encoders import argoverse, kitti, native, nuscenes, pandaset, waymo
from log_encoders.world import make_world, world_log
from plain_settings import AGENTS_ALONE

from log2sim.agents.estimate import TOLERANCE_M
from log2sim.config import Config
from log2sim.datatypes import Log, Scenario
from log2sim.logs.excerpt import RECORD_MARGIN_NS, cut_log
from log2sim.logs.opening import open_log, validate_log
from log2sim.pipeline import reconstruct

TWO_CAMERAS = [
    {"name": "front", "position_m": [1.7, 0.0, 1.5], "size_px": [480, 300], "offset_s": 0.05},
    {"name": "left", "position_m": [1.2, 0.6, 1.5], "yaw_deg": 60.0, "size_px": [320, 200], "offset_s": 0.02},
]


def scenario_of(path: Path, **changes: object) -> Scenario:
    return reconstruct(open_log(path), Config.load(detect={"name": "labels"}, **AGENTS_ALONE, **changes)).scenario


def assert_same(ours: Scenario, theirs: Scenario, atol_m: float) -> None:
    """The same agents in the same places at the same times; ids and map origins may differ."""
    assert ours.t0_ns == theirs.t0_ns
    assert len(ours.agents) == len(theirs.agents)
    shift = np.subtract(ours.map.offset_m, theirs.map.offset_m)
    for a in ours.agents:
        b = next(b for b in theirs.agents if b.id == a.id)
        assert (a.category, a.static) == (b.category, b.static)
        np.testing.assert_allclose(a.size_m, b.size_m, atol=atol_m)
        np.testing.assert_allclose(a.waypoints.t_s[[0, -1]], b.waypoints.t_s[[0, -1]], atol=1e-6)
        # Rounding may decide which waypoints are left out, as lines between their neighbors restore them to the centimeter.
        for column, offset in (("x_m", shift[0]), ("y_m", shift[1]), ("z_m", shift[2])):
            there = np.interp(b.waypoints.t_s, a.waypoints.t_s, getattr(a.waypoints, column))
            np.testing.assert_allclose(there + offset, getattr(b.waypoints, column), atol=atol_m + TOLERANCE_M)


ENCODERS = {
    "log2sim": native.encode, "kitti": kitti.encode_raw, "pandaset": pandaset.encode, "waymo": waymo.encode,
    "nuscenes": nuscenes.encode_world, "argoverse2": argoverse.encode,
}  # fmt: skip


@pytest.mark.matrix
@pytest.mark.parametrize("encode", ENCODERS.values(), ids=ENCODERS)
def test_a_converted_log_gives_the_same_scenario(tmp_path: Path, encode: Callable[[Log, Path], Path]) -> None:
    path = encode(world_log(), tmp_path / "from")
    ran = run("convert", path, "--out", tmp_path / "to")
    assert ran.code == 0, ran.err
    assert "records of" in ran.out
    assert validate_log(tmp_path / "to") == []
    before, after = scenario_of(path), scenario_of(tmp_path / "to")
    assert len(before.agents) >= 3
    # Points that were not whole millimeters are rounded to them, which decides what is still part of an object.
    assert_same(after, before, atol_m=0.005 if encode in (native.encode, kitti.encode_raw, pandaset.encode) else 0.03)
    log, back = open_log(path), open_log(tmp_path / "to")
    assert {n: s.t_ns.tolist() for n, s in back.streams.items()} == {n: s.t_ns.tolist() for n, s in log.streams.items()}
    for name in log.cameras:
        assert back.streams[name].encoded(2) == log.streams[name].encoded(2)


def test_what_surrounds_a_part_is_kept_for_interpolation() -> None:
    log = world_log()
    part = cut_log(log, start_s=0.3, stop_s=0.5)
    first, last = (int(part.streams["front"].t_ns[k]) for k in (0, -1))
    assert last - first == 200_000_000
    for stamps in (part.ego.t_ns, part.streams["top"].t_ns, part.labels.t_ns):
        assert stamps.min() < first
        assert stamps.max() > last
        assert (np.abs(stamps - (first + last) // 2) < 100_000_000 + 3 * RECORD_MARGIN_NS).all()
    for track in np.unique(log.labels.track_id):
        assert (part.labels.track_id == track).sum() == 5
    for i, t in enumerate(part.streams["top"].t_ns):
        k = int(np.searchsorted(log.streams["top"].t_ns, t))
        assert part.streams["top"].read(i) is log.streams["top"].read(k)
    assert part.digest != log.digest
    assert cut_log(log) is log


def test_every_field_of_labels_is_kept() -> None:
    log = world_log()
    n = len(log.labels.t_ns)
    full = replace(
        log.labels,
        visible=np.arange(n) % 2 == 0,
        cameras=("front",),
        kind=log.labels.category,
        occlusion=np.arange(n) % 4,
        labeled_ns=np.unique(log.labels.t_ns),
        never_labeled=("bicycle",),
    )
    assert all(getattr(full, f.name) is not None for f in fields(full))
    part = cut_log(replace(log, labels=full), start_s=0.0, stop_s=100.0).labels
    for field in fields(full):
        np.testing.assert_array_equal(getattr(part, field.name), getattr(full, field.name))


def test_labels_stay_with_their_cameras() -> None:
    log = make_world(camera=TWO_CAMERAS)
    labeled = replace(log, labels=replace(log.labels, cameras=("left",), never_labeled=("bicycle",)))
    assert cut_log(labeled, start_s=0.2).labels.never_labeled == ("bicycle",)
    assert cut_log(labeled, cameras=("left",)).labels.cameras == ("left",)
    assert cut_log(labeled, cameras=("front",)).labels is None
    assert cut_log(labeled, cameras=("front",)).reference_camera == "front"
    assert cut_log(labeled, cameras=("left",)).reference_camera is None


@pytest.mark.parametrize("importing", [False, True])
def test_nothing_is_lost_or_left_behind(
    log_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, importing: bool
) -> None:
    before = names(tmp_path)
    for out, words in ((log_folder, "exists already"), (tmp_path, "exists already")):
        assert words in run("convert", log_folder, "--out", out).line
    assert "holds the log" in run("convert", log_folder, "--out", log_folder, "--overwrite").line
    assert "no log folder" in run("convert", log_folder, "--out", tmp_path, "--overwrite").line

    written: list[str] = []

    def interrupted(data: bytes, where: str) -> None:
        written.append(where)
        if len(written) == 3 and importing:  # as compiled libraries do
            raise ImportError("initialization failed") from KeyboardInterrupt()
        if len(written) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr("log2sim.logs.native.writer.image_size", interrupted)
    ran = run("convert", log_folder, "--out", tmp_path / "to")
    assert ran.code == 130
    assert names(tmp_path) == before
