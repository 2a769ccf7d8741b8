"""Messages of ROS in all their layouts: clouds with their times, images, calibrations, transforms."""

from __future__ import annotations

from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from log_encoders import ros
from rosbags.typesys import get_types_from_msg

from log2sim.errors import RecordError
from log2sim.geometry import NS_PER_S, apply, inverse, project, rotation_from_rpy, transform
from log2sim.logs.ros.frames import FrameTree
from log2sim.logs.ros.messages import LidarTopic, sweep_from_livox
from log2sim.logs.ros.sensors import ENCODINGS, camera_from_info, image_from, offsets_ns, sweep_from

STAMP_NS, PERIOD_NS = 1_700_000_000_123_456_789, 1e8
PLAIN = LidarTopic(topic="/points")
XYZ = np.random.default_rng(3).normal(0, 20, (24, 3)).astype(np.float32)
CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def cloud(table: np.ndarray, *, height: int = 1, padding: int = 0, big: bool = False) -> SimpleNamespace:
    """A PointCloud2 of a structured array, with `padding` bytes after each row."""
    if big:
        table = table.astype(table.dtype.newbyteorder(">"))
    rows = table.reshape(height, -1)
    data = b"".join(row.tobytes() + b"\x7f" * padding for row in rows)
    fields = [
        SimpleNamespace(
            name=name, offset=offset, datatype=CODES[kind.base.str[1:]], count=int(np.prod(kind.shape)) or 1
        )
        for name, (kind, offset) in ((n, table.dtype.fields[n][:2]) for n in table.dtype.names)
    ]
    return SimpleNamespace(
        height=height, width=rows.shape[1], fields=fields, is_bigendian=big, point_step=table.itemsize,
        row_step=rows.shape[1] * table.itemsize + padding, data=np.frombuffer(data, np.uint8), is_dense=True,
    )  # fmt: skip


def table(kinds: dict[str, Any], itemsize: int | None = None, **columns: Any) -> np.ndarray:
    names = list(kinds)
    dtype = np.dtype(list(kinds.items()))
    if itemsize:
        offsets = [dtype.fields[n][1] + 3 for n in names]
        dtype = np.dtype({"names": names, "formats": list(kinds.values()), "offsets": offsets, "itemsize": itemsize})
    out = np.zeros(len(XYZ), dtype)
    for k, axis in enumerate("xyz"):
        out[axis] = XYZ[:, k]
    for name, values in columns.items():
        out[name] = values
    return out


LAYOUTS = {
    "packed": cloud(table({"x": "f4", "y": "f4", "z": "f4"})),
    "float64": cloud(table({"x": "f8", "y": "f8", "z": "f8"})),
    "gaps between fields": cloud(table({"x": "f4", "ring": "u2", "z": "f4", "intensity": "f4", "y": "f4"}, 48)),
    "rows with padding": cloud(table({"x": "f4", "y": "f4", "z": "f4", "i": "u1"}), height=4, padding=5),
    "big endian": cloud(table({"x": "f4", "y": "f4", "z": "f4", "ring": "u2"}), big=True),
    "a field of several values": cloud(table({"x": "f4", "y": "f4", "z": "f4", "normal": ("f4", (3,))})),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_points_are_the_same_in_every_layout(name: str) -> None:
    sweep = sweep_from(LAYOUTS[name], STAMP_NS, PERIOD_NS, PLAIN, "cloud")
    np.testing.assert_array_equal(sweep.xyz_m, XYZ)
    assert sweep.t_ns is None
    assert sweep.stamp_ns == STAMP_NS


def test_points_without_a_return_are_left_out_with_their_times() -> None:
    points = table({"x": "f4", "y": "f4", "z": "f4", "t": "u4"}, t=np.arange(24) * 4_000_000)
    points["y"][3], points["x"][5] = np.nan, np.inf
    for axis in "xyz":
        points[axis][7] = 0.0
    sweep = sweep_from(cloud(points), STAMP_NS, PERIOD_NS, PLAIN, "cloud")
    kept = np.delete(np.arange(24), [3, 5, 7])
    np.testing.assert_array_equal(sweep.xyz_m, XYZ[kept])
    assert sweep.t_ns is not None
    np.testing.assert_array_equal(sweep.t_ns - STAMP_NS, kept * 4_000_000)


# What drivers write for points measured from the stamp of the message until 92 ms after it.
AFTER_NS = np.arange(24, dtype=np.int64) * 4_000_000


@pytest.mark.parametrize(("stamp", "first_ms", "expected_ms"), [
    ("auto", 0.0, 0.0), ("auto", -92.0, -92.0), ("start", -92.0, 0.0), ("end", 0.0, -92.0), ("auto", -46.0, -46.0),
])  # fmt: skip
def test_the_stamp_is_the_start_or_the_end_of_the_turn(stamp: Any, first_ms: float, expected_ms: float) -> None:
    values = (AFTER_NS / 1e6 + first_ms) / 1e3
    offset = offsets_ns(values, STAMP_NS, PERIOD_NS, LidarTopic(topic="/p", stamp=stamp))
    assert offset is not None
    np.testing.assert_allclose(offset, AFTER_NS + expected_ms * 1e6, atol=1)


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 1 << 32), st.integers(0, 1 << 32), st.integers(0, 64), st.integers(0, 1 << 33),
    st.lists(st.tuples(st.sampled_from(["x", "y", "z", "t", ""]), st.integers(0, 1 << 31), st.integers(0, 9), st.integers(0, 1 << 31)), max_size=5),
)  # fmt: skip
@example(2, 1, 0, 1, [])
def test_contradicting_layouts_are_errors_of_the_record(height, width, step, row_step, fields) -> None:
    message = SimpleNamespace(
        height=height, width=width, point_step=step, row_step=row_step, is_bigendian=False, data=np.zeros(96, np.uint8),
        fields=[SimpleNamespace(name=n, offset=o, datatype=d, count=c) for n, o, d, c in fields],
    )  # fmt: skip
    with suppress(RecordError):
        assert len(sweep_from(message, STAMP_NS, PERIOD_NS, PLAIN, "cloud").xyz_m) <= 96


RGB = np.random.default_rng(5).integers(0, 256, (6, 8, 3)).astype(np.uint8)


def picture(encoding: str, pixels: np.ndarray, *, padding: int = 0, big: bool = False) -> SimpleNamespace:
    lines = pixels.reshape(len(pixels), -1).view(np.uint8)
    data = np.hstack([lines, np.full((len(lines), padding), 99, np.uint8)]).ravel()
    return SimpleNamespace(
        height=6, width=8, encoding=encoding, is_bigendian=int(big), step=lines.shape[1] + padding, data=data
    )


@pytest.mark.parametrize("padding", [0, 7])
@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8", "rgb16", "mono8", "mono16", "mono16 big"])
def test_images_of_every_encoding_become_bgr(encoding: str, padding: int) -> None:
    kind, big = encoding.split()[0], encoding.endswith("big")
    pixels = RGB[..., ::-1] if kind.startswith("bgr") else RGB[..., 0] if kind.startswith("mono") else RGB
    expected = np.repeat(RGB[..., :1], 3, axis=2) if kind.startswith("mono") else RGB[..., ::-1]
    if kind.endswith("a8"):
        pixels = np.dstack([pixels, np.zeros((6, 8), np.uint8)])
    if kind.endswith("16"):
        pixels = (pixels.astype(np.uint16) << 8 | 7).astype(">u2" if big else "<u2")
    message = picture(kind, np.ascontiguousarray(pixels), padding=padding, big=big)
    np.testing.assert_array_equal(image_from(message, "image", (8, 6)), expected)


@pytest.mark.parametrize("order", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_begin_with_the_pixel_that_they_name(order: str) -> None:
    """A picture of one color, so that interpolation does not matter."""
    color = {"r": 200, "g": 90, "b": 30}
    cells = np.array([[color[order[0]], color[order[1]]], [color[order[2]], color[order[3]]]], np.uint8)
    image = image_from(picture(f"bayer_{order}8", np.tile(cells, (3, 4))), "image", (8, 6))
    np.testing.assert_array_equal(image[2:4, 2:6], np.broadcast_to([30, 90, 200], (2, 4, 3)))


def test_images_that_contradict_their_size_are_errors_of_the_record() -> None:
    good = picture("rgb8", RGB)
    for change in ({"step": 20}, {"data": good.data[:-1]}, {"encoding": "32FC1"}, {"width": 9}, {"height": 1 << 31}):
        with pytest.raises(RecordError, match=r"^image: "):
            image_from(SimpleNamespace(**{**vars(good), **change}), "image", (8, 6))
    assert all(hasattr(cv2, conversion) for _, _, conversion in ENCODINGS.values() if conversion)


K = np.array([[700.0, 0, 330], [0, 710, 250], [0, 0, 1]])
POSE = transform(rotation_from_rpy(-np.pi / 2, 0, -np.pi / 2), [1.0, 0.2, 1.5])


def camera_info(
    *, ros1: bool = False, model: str = "plumb_bob", D: Any = (), R: Any = None, P: Any = None, **changes: Any
):
    region = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False)
    P = np.column_stack([K, np.zeros(3)]) if P is None else P
    matrices = {"D": np.array(D), "K": K.ravel(), "R": (np.eye(3) if R is None else R).ravel(), "P": P.ravel()}
    matrices = matrices if ros1 else {name.lower(): value for name, value in matrices.items()}
    values = {"width": 640, "height": 480, "distortion_model": model, "binning_x": 0, "binning_y": 0, "roi": region}
    return SimpleNamespace(**values | matrices | changes)


@pytest.mark.parametrize("ros1", [True, False])
@pytest.mark.parametrize(("model", "D", "expected"), [
    ("plumb_bob", [-0.3, 0.1, 0.001, -0.002, 0.01], ("brown", 5)), ("plumb_bob", [0.0] * 5, ("none", 0)),
    ("plumb_bob", [], ("none", 0)), ("", [-0.3, 0.1, 0.0, 0.0], ("brown", 4)),
    ("rational_polynomial", [0.1] * 8, ("brown", 8)), ("rational_polynomial", [0.1] * 8 + [0.0] * 6, ("brown", 8)),
    ("equidistant", [0.01, 0.002, -0.001, 0.0], ("fisheye", 4)),
])  # fmt: skip
def test_lens_models_of_ros_are_those_of_cameras(ros1: bool, model: str, D: Any, expected: Any) -> None:
    camera = camera_from_info("front", camera_info(ros1=ros1, model=model, D=D), ("ego", POSE), rectified=False)
    assert (camera.distortion_model, len(camera.distortion)) == expected
    np.testing.assert_array_equal(camera.distortion, D[: expected[1]])
    np.testing.assert_array_equal(camera.K, K)


def test_rectified_images_have_the_projection_and_the_turned_axes() -> None:
    turn = rotation_from_rpy(0.01, -0.02, 0.03)
    P = np.column_stack([K * [[0.9], [0.9], [1.0]], [-300.0, 0.0, 0.0]])
    info = camera_info(D=[-0.3, 0.1, 0, 0, 0], R=turn, P=P)
    point_frame = np.array([[0.3, -0.2, 6.0]])
    for stereo in (False, True):
        camera = camera_from_info("front", info, ("ego", POSE), rectified=True, stereo=stereo)
        assert camera.rectified
        uv, _ = project(camera, apply(inverse(camera.mount_T_cam) @ POSE, point_frame))
        expected = P[:, :3] @ turn @ point_frame[0] + (P[:, 3] if stereo else 0)
        np.testing.assert_allclose(uv[0], expected[:2] / expected[2])


def tf(parent: str, child: str, xyz: Any, t_s: float = 0.0, q: Any = (1.0, 0.0, 0.0, 0.0)) -> SimpleNamespace:
    vector = SimpleNamespace(x=float(xyz[0]), y=float(xyz[1]), z=float(xyz[2]))
    turn = SimpleNamespace(w=q[0], x=q[1], y=q[2], z=q[3])
    stamp = SimpleNamespace(sec=int(t_s), nanosec=round((t_s % 1) * 1e9))
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id=parent), child_frame_id=child,
        transform=SimpleNamespace(translation=vector, rotation=turn),
    )  # fmt: skip


def test_frames_are_connected_over_their_common_ancestor() -> None:
    half = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    tree = FrameTree("recording")
    tree.add(
        [
            tf("base_link", "rack", (1, 0, 2), q=half),
            tf("rack", "lidar", (0.5, 0, 0)),
            tf("/base_link", "/cam", (0, 1, 0)),
        ]
    )
    np.testing.assert_allclose(tree.mount("base_link", "lidar")[:3, 3], [1, 0.5, 2], atol=1e-12)
    np.testing.assert_allclose(tree.mount("cam", "lidar")[:3, 3], [1, -0.5, 2], atol=1e-12)
    assert tree.mount("base_link", "nowhere") is None
    assert tree.rigid_root("lidar") == "base_link"


def test_a_frame_that_moves_has_no_mount_but_a_track() -> None:
    tree = FrameTree("recording")
    tree.add(tf("odom", "base_link", (k, 0, 0), k / 10) for k in range(11))
    tree.add(
        [tf("map", "odom", (0, 5, 0), 0.2), tf("map", "odom", (0, 7, 0), 0.4), tf("base_link", "lidar", (0, 0, 2))]
    )
    tree.add(tf("base_link", "horn", (0, 0, 1), k / 10) for k in range(5))
    assert tree.mount("map", "lidar") is None
    assert tree.mount("base_link", "horn") is not None  # sent again and again, but the same
    assert tree.moving_ancestors("lidar") == ["odom", "map"]
    track = tree.track("map", "lidar")
    assert track is not None
    # The slower edge is held before its first and after its last stamp.
    np.testing.assert_allclose(track.map_T_ego[[0, 3, 10], :3, 3], [[0, 5, 2], [3, 6, 2], [10, 7, 2]])
    assert tree.track("world", "lidar") is None


LIVOX_POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"


LIVOX = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\nCustomPoint[] points\n"
)


@pytest.mark.parametrize("frame", ["livox_frame", "l", "of7char"])
@pytest.mark.parametrize("ros1", [True, False])
def test_clouds_of_the_livox_driver_are_those_that_another_library_writes(ros1: bool, frame: str) -> None:
    name = "livox_ros_driver2/msg/CustomMsg"
    store = ros.typestore(ros1)
    store.register({**get_types_from_msg(LIVOX_POINT, name.replace("Msg", "Point")), **get_types_from_msg(LIVOX, name)})
    make = {kind.rpartition("/")[2]: store.types[kind] for kind in store.types if kind != "std_msgs/msg/Time"}
    stamp = make["Time"](sec=STAMP_NS // NS_PER_S, nanosec=STAMP_NS % NS_PER_S)
    header = make["Header"](stamp=stamp, frame_id=frame, **({"seq": 5} if ros1 else {}))
    points = [
        make["CustomPoint"](offset_time=int(t), x=x, y=y, z=z, reflectivity=9, tag=16, line=3)
        for t, (x, y, z) in zip(AFTER_NS, XYZ.tolist())
    ]
    message = make["CustomMsg"](
        header=header, timebase=STAMP_NS, point_num=len(points), lidar_id=1, rsvd=np.zeros(3, np.uint8), points=points
    )
    raw = bytes(store.serialize_ros1(message, name) if ros1 else store.serialize_cdr(message, name))
    encoding = "ros1" if ros1 else "cdr"
    sweep = sweep_from_livox(raw, encoding, STAMP_NS, PLAIN, "cloud")
    np.testing.assert_array_equal(sweep.xyz_m, XYZ)
    np.testing.assert_array_equal(sweep.t_ns, STAMP_NS + AFTER_NS)
    for cut in (0, 10, 30, 60, len(raw) - 2):
        with pytest.raises(RecordError, match=r"^cloud: \d+ bytes"):
            sweep_from_livox(raw[:cut], encoding, STAMP_NS, PLAIN, "cloud")
