"""Parsers of logs on arbitrary bytes raise nothing but our errors; any small log survives writing and reading."""

from __future__ import annotations

import gzip
import io
import pickle
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from damaged_bytes import damaged, quick, result_or_refusal
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mutation.damages import npy

from log2sim.datatypes import CATEGORIES, EgoVehicle, Labels, Lidar, Log, MapFrame, Stream, Sweep
from log2sim.errors import RecordError
from log2sim.geometry import Camera, PoseTrack, RollingShutter, rotation_from_rpy, transform
from log2sim.logs.checks import list_calibration_problems, list_time_problems
from log2sim.logs.native.writer import write_log
from log2sim.logs.opening import open_log
from log2sim.logs.pandaset.unpickle import read_pickled_table
from log2sim.logs.records import read_sweep


def npz(**arrays: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


POINTS = np.arange(12.0).reshape(4, 3)
PCD = (
    b"VERSION 0.7\nFIELDS x y z t\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA "
    b"binary\n" + np.arange(8, dtype="<f4").tobytes()
)
SWEEPS = {
    ".bin": np.arange(16, dtype="<f4").tobytes(),
    ".npy": npy(POINTS),
    ".npz": npz(xyz_m=POINTS, t_offset_ns=np.arange(4)),
    ".pcd": PCD,
}


@pytest.mark.parametrize("suffix", SWEEPS)
@quick
@given(data=st.data())
def test_a_damaged_sweep_is_a_record_error_or_a_sweep(tmp_path: Path, suffix: str, data: st.DataObject) -> None:
    path = tmp_path / f"sweep{suffix}"
    path.write_bytes(data.draw(damaged(SWEEPS[suffix])))
    sweep = result_or_refusal(lambda: read_sweep(path, 10**18), RecordError, str(path))
    if sweep is not None:
        assert sweep.xyz_m.shape[1] == 3
        assert np.isfinite(sweep.xyz_m).all()
        assert sweep.t_ns is None or sweep.t_ns.shape == (len(sweep.xyz_m),)


def sound_pickle() -> bytes:
    pandas = pytest.importorskip("pandas")
    return pickle.dumps(pandas.DataFrame({"x": np.arange(3.0), "d": np.arange(3), "word": ["a", "b", "c"]}))


@pytest.mark.parametrize("packed", [False, True])
@quick
@given(data=st.data())
def test_a_damaged_pickle_is_an_error_or_a_table(tmp_path: Path, packed: bool, data: st.DataObject) -> None:
    content = data.draw(damaged(sound_pickle()))
    path = tmp_path / "table.pkl"
    path.write_bytes(gzip.compress(content) if packed else content)
    columns = result_or_refusal(lambda: read_pickled_table(path, limit_bytes=10_000_000), RecordError, str(path))
    assert columns is None or len({len(values) for values in columns.values()}) <= 1


coordinate = st.floats(-500.0, 500.0).map(lambda v: round(v, 3))
angle = st.floats(-3.0, 3.0)


@st.composite
def small_logs(draw: st.DrawFn) -> Log:
    """One camera and one LiDAR on an ego, or on a pole, with uneven stamps and arbitrary points."""
    count = draw(st.integers(2, 4))
    begin = draw(st.integers(-(10**15), 2 * 10**18))
    steps = draw(st.lists(st.integers(1, 10**9), min_size=count - 1, max_size=count - 1))
    t_ns = begin + np.concatenate([[0], np.cumsum(steps)]).astype(np.int64)
    roadside = draw(st.booleans())
    mount: Any = "map" if roadside else "ego"
    pose = transform(
        rotation_from_rpy(*(draw(angle) for _ in range(3))), np.array([draw(coordinate) for _ in range(3)])
    )
    far = draw(st.sampled_from([0.0, 457_000.0])) if roadside else 0.0
    pose[:3, 3] += far
    frame: Any = draw(st.sampled_from(["lidar", "map"]))
    clouds = [
        np.array(draw(st.lists(st.tuples(coordinate, coordinate, coordinate), max_size=5)), dtype=np.float64).reshape(
            -1, 3
        )
        + (far if frame == "map" else 0.0)
        for _ in range(count)
    ]
    timed = draw(st.booleans())
    offsets = [np.array([draw(st.integers(-(10**8), 10**8)) for _ in cloud], dtype=np.int64) for cloud in clouds]
    position = np.array([[draw(coordinate), draw(coordinate), 0.0] for _ in range(count)])
    ego = PoseTrack(
        t_ns, transform(rotation_from_rpy(0.0, 0.0, np.array([draw(angle) for _ in range(count)])), position)
    )
    K = np.array([[50.0, 0.0, 7.5], [0.0, 50.0, 7.5], [0.0, 0.0, 1.0]])
    image = np.full((16, 16, 3), draw(st.integers(0, 255)), np.uint8)
    png = cv2.imencode(".png", image)[1].tobytes()
    shutter = draw(
        st.none() | st.builds(RollingShutter, st.sampled_from(["down", "up", "right", "left"]), st.floats(0.0, 0.1))
    )
    # Points in the map are compensated as they are.
    at_ns = t_ns + draw(st.integers(-(10**8), 10**8)) if frame == "lidar" and draw(st.booleans()) else None
    return Log(
        name="any",
        format="memory",
        cameras={"cam": Camera("cam", 16, 16, K, mount, pose, rolling_shutter=shutter)},
        lidars={"lidar": Lidar("lidar", mount, pose)},
        streams={
            "cam": Stream("cam", t_ns, lambda i: image, draw(st.sampled_from([None, lambda i: png]))),
            "lidar": Stream(
                "lidar",
                t_ns,
                lambda i: Sweep(
                    int(t_ns[i]),
                    clouds[i],
                    frame,
                    t_ns[i] + offsets[i] if timed else None,
                    None if at_ns is None else int(at_ns[i]),
                ),
            ),
        },
        ego=None if roadside else ego,
        ego_vehicle=EgoVehicle(),
        map=MapFrame(),
        labels=draw(st.none() | labels_of(t_ns, far)),
    )


@st.composite
def labels_of(draw: st.DrawFn, t_ns: np.ndarray, far: float) -> Labels:
    """Some labels, with any of the columns that may be absent."""
    count = draw(st.integers(0, 4))

    def column(values: st.SearchStrategy[Any], dtype: Any) -> np.ndarray:
        return np.array([draw(values) for _ in range(count)], dtype=dtype)

    word = st.text(st.characters(categories=["L", "N", "P"]), min_size=1, max_size=6)
    center = np.array([[draw(coordinate) + far for _ in range(3)] for _ in range(count)]).reshape(-1, 3)
    size = np.array([[draw(st.floats(0.01, 30.0)) for _ in range(3)] for _ in range(count)]).reshape(-1, 3)
    return Labels(
        t_ns=column(st.sampled_from(t_ns.tolist()), np.int64),
        track_id=column(word, np.str_),
        category=column(st.sampled_from(CATEGORIES), np.str_),
        center_m=center,
        size_m=size,
        yaw_rad=column(angle, np.float64),
        visible=column(st.booleans(), bool) if draw(st.booleans()) else None,
        cameras=draw(st.sampled_from([None, ("cam",)])),
        kind=column(word, np.str_) if draw(st.booleans()) else None,
        occlusion=column(st.integers(0, 3), np.int64) if draw(st.booleans()) else None,
        labeled_ns=t_ns[: draw(st.integers(0, len(t_ns)))] if draw(st.booleans()) else None,
        never_labeled=draw(st.sampled_from([(), ("bicycle", "bus")])),
    )


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(log=small_logs())
def test_any_small_log_survives_writing_and_reading(tmp_path: Path, log: Log) -> None:
    write_log(log, tmp_path / "log", overwrite=True)
    back = open_log(tmp_path / "log")
    assert back.notes == (*list_calibration_problems(back), *list_time_problems(back))
    offset = np.array(back.map.offset_m)
    for name, stream in log.streams.items():
        np.testing.assert_array_equal(back.streams[name].t_ns, stream.t_ns)
        ours, known = log.map_T_sensor(name, stream.t_ns)
        theirs, also = back.map_T_sensor(name, stream.t_ns)
        theirs[:, :3, 3] += offset
        np.testing.assert_array_equal(known, also)
        np.testing.assert_allclose(theirs, ours, atol=1e-9)
    for i in range(len(log.streams["lidar"].t_ns)):
        a, b = log.streams["lidar"].read(i), back.streams["lidar"].read(i)
        np.testing.assert_allclose(b.xyz_m + (offset if b.frame == "map" else 0.0), a.xyz_m, atol=6e-4)
        assert (b.frame, b.stamp_ns, b.compensated_ns) == (a.frame, a.stamp_ns, a.compensated_ns)
        assert (a.t_ns is None) == (b.t_ns is None)
        if a.t_ns is not None:
            np.testing.assert_array_equal(b.t_ns, a.t_ns)
        assert np.abs(back.streams["cam"].read(i).astype(int) - log.streams["cam"].read(i)).max() <= 3
    assert back.cameras["cam"].rolling_shutter == log.cameras["cam"].rolling_shutter
    encoded = log.streams["cam"].encoded
    if encoded is not None:
        assert back.streams["cam"].encoded(0) == encoded(0)
    assert (back.labels is None) == (log.labels is None)
    if log.labels is not None:
        for column in set(vars(log.labels)) - {"center_m"}:
            np.testing.assert_array_equal(getattr(back.labels, column), getattr(log.labels, column), err_msg=column)
        np.testing.assert_allclose(back.labels.center_m + offset, log.labels.center_m, atol=1e-9)
