"""Cameras, pictures and clouds of a recording, decoded when they are read."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Stream, Sweep
from log2sim.datatypes.log import ROTATION_TOLERANCE
from log2sim.errors import RecordError
from log2sim.files.images import MAX_IMAGE_PX, decode_image, image_size
from log2sim.geometry import NS_PER_S, Array, Camera, Mount, inverse, transform
from log2sim.logs.records import MAX_SWEEP_POINTS, find_intensity_field, sweep_of
from log2sim.logs.ros import messages
from log2sim.logs.ros.bag import Bag
from log2sim.logs.ros.containers import printable
from log2sim.logs.ros.messages import CameraTopic, LidarTopic, Stamped, decode

COMPRESSED = "sensor_msgs/msg/CompressedImage"
BROWN, FISHEYE = ("plumb_bob", "rational_polynomial", "radtan", ""), ("equidistant", "fisheye", "kannala_brandt4")


class CalibrationProblem(ValueError):
    """A CameraInfo that gives no camera; the text is the reason."""


def camera_from_info(
    name: str, info: Any, pose: tuple[Mount, Array], *, rectified: bool, stereo: bool = False
) -> Camera:
    """Build a camera from a CameraInfo; `pose` is the mount and where the frame of the images is in it.

    `rectified`: whether the images are: then P is theirs, their axes are turned by R, and there is no distortion. `stereo`: whether
    another camera has the same frame, as the second of a stereo pair has in ROS: then the last column of P holds its position
    in it. Raises `CalibrationProblem` when it is not calibrated, or its lens model is none of those that `Camera` has.
    """
    mount, mount_T_cam = pose
    model, distortion = "none", tuple[float, ...]()
    K, P = _matrix(info, "K", (3, 3)), _matrix(info, "P", (3, 4))
    if rectified and P[0, 0] > 0 and P[1, 1] > 0 and np.isfinite(P).all():
        rotation = _matrix(info, "R", (3, 3))
        if not np.abs(rotation @ rotation.T - np.eye(3)).max() <= ROTATION_TOLERANCE:
            rotation = np.eye(3)
        mount_T_cam = mount_T_cam @ inverse(transform(rotation, np.zeros(3)))
        if stereo:
            # P = K [I | t] with the position t of the second camera of the pair in the frame of both.
            left = np.triu(P[:, :3])
            left[2, 2] = 1.0
            mount_T_cam = mount_T_cam @ inverse(transform(np.eye(3), np.linalg.solve(left, P[:, 3])))
        K = P[:, :3]
    elif not rectified:
        model, distortion = _lens(info)
    if not (K[0, 0] > 0 and K[1, 1] > 0 and np.isfinite(K).all()):
        raise CalibrationProblem(f"its focal lengths are {K[0, 0]:g} and {K[1, 1]:g} px: the camera is not calibrated")
    # The images may be a region of the sensor, binned; camera matrix and size are given for the whole.
    binning, roi = np.array([max(1, int(info.binning_x)), max(1, int(info.binning_y))]), info.roi
    whole = roi if roi.width and roi.height else info
    width, height = (np.array([int(whole.width), int(whole.height)]) // binning).tolist()
    K = K.copy()
    K[:2, 2] -= [int(roi.x_offset), int(roi.y_offset)]
    K[:2] /= binning[:, None]
    if not (width > 0 and height > 0):
        raise CalibrationProblem(f"its size is {width}x{height} px")
    return Camera(name, width, height, K, mount, mount_T_cam, model, distortion)


def _lens(info: Any) -> tuple[str, tuple[float, ...]]:
    values = _values(info, "D")
    kind = printable(info.distortion_model).strip().lower()
    if not values.any():
        return "none", ()
    if not np.isfinite(values).all():
        raise CalibrationProblem("its distortion is not finite")
    limit = 8 if kind in BROWN else 4
    if kind not in BROWN + FISHEYE or values[limit:].any():
        known = ", ".join((*BROWN[:2], FISHEYE[0]))
        raise CalibrationProblem(f"its distortion model '{kind}' with {len(values)} values is not read; known: {known}")
    length = 4 if kind in FISHEYE else next(n for n in (4, 5, 8) if n >= len(values[:limit]))
    padded = (*values[:limit].tolist(), *[0.0] * length)
    return "fisheye" if kind in FISHEYE else "brown", padded[:length]


def _matrix(info: Any, name: str, shape: tuple[int, int]) -> Array:
    values = _values(info, name)
    if values.size != shape[0] * shape[1]:
        raise CalibrationProblem(f"{name} has {values.size} values, expected {shape[0] * shape[1]}")
    return values.reshape(shape)


def _values(info: Any, name: str) -> Array:
    """Return the numbers of D, K, R or P, which ROS 2 writes in lower case."""
    return np.asarray(getattr(info, name if hasattr(info, name) else name.lower()), dtype=np.float64).ravel()


# Encodings of sensor_msgs/image_encodings.hpp: channels, bytes of each, conversion of OpenCV to BGR.
# OpenCV names Bayer patterns by their second row and column, ROS by the first pixel.
ENCODINGS: dict[str, tuple[int, int, str]] = {
    "bgr8": (3, 1, ""), "8UC3": (3, 1, ""), "rgb8": (3, 1, "COLOR_RGB2BGR"), "bgra8": (4, 1, "COLOR_BGRA2BGR"),
    "8UC4": (4, 1, "COLOR_BGRA2BGR"), "rgba8": (4, 1, "COLOR_RGBA2BGR"), "mono8": (1, 1, "COLOR_GRAY2BGR"),
    "8UC1": (1, 1, "COLOR_GRAY2BGR"), "mono16": (1, 2, "COLOR_GRAY2BGR"), "16UC1": (1, 2, "COLOR_GRAY2BGR"),
    "bgr16": (3, 2, ""), "rgb16": (3, 2, "COLOR_RGB2BGR"), "bgra16": (4, 2, "COLOR_BGRA2BGR"),
    "rgba16": (4, 2, "COLOR_RGBA2BGR"), "bayer_rggb8": (1, 1, "COLOR_BayerBG2BGR"), "bayer_bggr8": (1, 1, "COLOR_BayerRG2BGR"),
    "bayer_gbrg8": (1, 1, "COLOR_BayerGR2BGR"), "bayer_grbg8": (1, 1, "COLOR_BayerGB2BGR"),
    "bayer_rggb16": (1, 2, "COLOR_BayerBG2BGR"), "bayer_bggr16": (1, 2, "COLOR_BayerRG2BGR"),
    "bayer_gbrg16": (1, 2, "COLOR_BayerGR2BGR"), "bayer_grbg16": (1, 2, "COLOR_BayerGB2BGR"),
    "yuv422": (2, 1, "COLOR_YUV2BGR_UYVY"), "uyvy": (2, 1, "COLOR_YUV2BGR_UYVY"),
    "yuv422_yuy2": (2, 1, "COLOR_YUV2BGR_YUYV"), "yuyv": (2, 1, "COLOR_YUV2BGR_YUYV"),
}  # fmt: skip


def image_from(message: Any, where: str, size_px: tuple[int, int]) -> NDArray[np.uint8]:
    """Convert a decoded Image to (H, W, 3) uint8 BGR; of 16 bits the upper 8 are kept; `RecordError` where that is impossible."""
    import cv2

    width, height, step = int(message.width), int(message.height), int(message.step)
    if (width, height) != size_px or width * height > MAX_IMAGE_PX:
        raise RecordError(f"{where}: {width}x{height} px, the calibration is for {size_px[0]}x{size_px[1]}")
    if message.encoding not in ENCODINGS:
        raise RecordError(f"{where}: encoding '{printable(message.encoding)}' is not one of {', '.join(ENCODINGS)}")
    channels, depth, conversion = ENCODINGS[message.encoding]
    line = width * channels * depth
    data = np.asarray(message.data, dtype=np.uint8)
    if step < line or len(data) < (height - 1) * step + line:
        raise RecordError(
            f"{where}: {len(data)} bytes in lines of {step} for {width}x{height} px of {message.encoding}, "
            f"expected lines of at least {line}"
        )
    if len(data) < height * step:
        data = np.concatenate([data, np.zeros(height * step - len(data), np.uint8)])
    pixels = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :line])
    if depth == 2:
        pixels = (pixels.view(">u2" if message.is_bigendian else "<u2") >> 8).astype(np.uint8)
    pixels = pixels.reshape(height, width, channels) if channels > 1 else pixels.reshape(height, width)
    image = cv2.cvtColor(pixels, getattr(cv2, conversion)) if conversion else pixels
    return np.asarray(image, dtype=np.uint8)


# sensor_msgs/PointField: datatypes 1 to 8.
DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
TIME_FIELDS = (
    "t", "time", "times", "timestamp", "timestamps", "stamp", "stamps", "time_stamp", "offset_time", "time_offset", "t_offset",
    "point_time", "point_time_offset", "offset_ns", "ts",
)  # fmt: skip
UNITS_NS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
# Units are factors of 1000 apart: a sweep that spans a thirtieth to thirty times the period has one unit only.
MAX_SPAN_RATIO = 30.0
# Times up to this long count from the stamp of the message; larger ones are those of a clock.
MAX_RELATIVE_NS = 10e9
# A clock that is nearer to the stamps than this is the one that the stamps are of.
MAX_CLOCK_OFFSET_NS = 60e9
DEFAULT_PERIOD_NS = 1e8


def sweep_from(message: Any, t_ns: int, period_ns: float, settings: LidarTopic, where: str) -> Sweep:
    """Build a sweep from a decoded PointCloud2; by `period_ns` between two sweeps the unit of the times is recognized."""
    points = point_table(message, where)
    names = points.dtype.names or ()
    missing = [name for name in "xyz" if name not in names]
    if missing:
        raise RecordError(f"{where}: the points have no field '{missing[0]}', only {', '.join(names)}")
    kinds = [np.float64 if points[name].dtype.itemsize == 8 else np.float32 for name in "xyz"]
    xyz = np.stack([points[name].astype(kind) for name, kind in zip("xyz", kinds)], 1)
    # Drivers mark rays without a return by NaN or by zeros.
    kept = np.isfinite(xyz).all(axis=1) & xyz.any(axis=1)
    xyz = xyz[kept]
    timed = [n for n in names if (n == settings.time_field if settings.time_field else n.lower() in TIME_FIELDS)]
    offset = offsets_ns(points[timed[0]][kept], t_ns, period_ns, settings) if timed else None
    strength = find_intensity_field(points.dtype)
    intensity = None if strength is None else points[strength][kept]
    return sweep_of(xyz, t_ns, offset, "lidar", t_ns if settings.compensated else None, intensity)


def point_table(message: Any, where: str) -> NDArray[Any]:
    """View the data of a PointCloud2 as a structured array (N,); nothing is copied but padded rows."""
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    row_step = int(message.row_step) or width * step
    data = np.asarray(message.data, dtype=np.uint8)
    if height * width > MAX_SWEEP_POINTS:
        raise RecordError(f"{where}: {height * width} points, more than the {MAX_SWEEP_POINTS} that a sweep may have")
    order = ">" if message.is_bigendian else "<"
    layout: dict[str, tuple[str, int]] = {}
    for point_field in message.fields:
        code = DATATYPES.get(int(point_field.datatype))
        count, name = max(1, int(point_field.count)), printable(point_field.name)
        if code is not None and count <= step and name and name not in layout:
            layout[name] = order + code if count == 1 else f"({count},){order}{code}", int(point_field.offset)
    formats, offsets = zip(*layout.values()) if layout else ((), ())
    try:
        dtype = np.dtype({"names": [*layout], "formats": formats, "offsets": offsets, "itemsize": step})
    except (ValueError, TypeError) as problem:
        raise RecordError(f"{where}: the fields of the points do not fit into {step} bytes: {problem}") from None
    needed = (height - 1) * row_step + width * step if height and width else 0
    if row_step < width * step or len(data) < needed or (needed and not step):
        raise RecordError(
            f"{where}: {len(data)} bytes for {height} x {width} points of {step} bytes (rows of {row_step}), "
            f"expected at least {needed}"
        )
    if not needed:
        return np.zeros(0, dtype)
    if row_step == width * step:
        return np.frombuffer(data[:needed], dtype)
    rows = np.lib.stride_tricks.as_strided(data, (height, width * step), (row_step, 1))
    return np.frombuffer(np.ascontiguousarray(rows), dtype)


def offsets_ns(values: NDArray[Any], t_ns: int, period_ns: float, settings: LidarTopic) -> NDArray[np.int64] | None:
    """Compute times (N,) ns of points relative to the stamp of their message; None where no unit makes sense of them.

    Drivers give seconds, milliseconds, microseconds or nanoseconds under the same names, from the stamp or of a clock. The unit
    is the one in which the values span about the time between two sweeps. Values far from zero are of a clock: the stamps' own
    where it is near to them; otherwise the first of them is put at the stamp.
    """
    if not len(values) or values.ndim != 1:
        return None if values.ndim != 1 else np.zeros(0, dtype=np.int64)
    low = values.min()
    span = float(values.max()) - float(low) if values.dtype.kind == "f" else float(int(values.max()) - int(low))
    unit_ns = UNITS_NS.get(settings.time_unit)
    if unit_ns is None and span > 0:
        ratio = {unit: abs(np.log(span * unit / period_ns)) for unit in UNITS_NS.values()}
        best = min(ratio, key=ratio.__getitem__)
        unit_ns = best if ratio[best] <= np.log(MAX_SPAN_RATIO) else None
    if unit_ns is None or not np.isfinite(span):
        return None
    # The difference to the first is exact also for large clock values.
    forward: NDArray[np.int64] = np.round((values - low).astype(np.float64) * unit_ns).astype(np.int64)
    # Whole numbers of any size are converted exactly.
    whole = int(low)
    rest = 0 if isinstance(low, np.integer) else round((float(low) - whole) * unit_ns)
    first_ns = whole * round(unit_ns) + rest
    if settings.stamp != "auto":
        return forward if settings.stamp == "start" else forward - forward.max()
    if abs(first_ns) <= MAX_RELATIVE_NS:
        return forward + first_ns
    return forward + (first_ns - t_ns if abs(first_ns - t_ns) <= MAX_CLOCK_OFFSET_NS else 0)


def camera_stream(bag: Bag, chosen: CameraTopic, stamped: Stamped, camera: Camera) -> Stream:
    """Stream of the images of a camera; of compressed ones also as files."""
    topic, size_px = bag.topics[chosen.topic], (camera.width_px, camera.height_px)
    compressed = topic.msgtype == COMPRESSED

    def encoded(i: int) -> bytes:
        where = bag.where(topic, int(stamped.row[i]))
        message = decode(bag, topic, int(stamped.row[i]))
        data: bytes = np.asarray(message.data, dtype=np.uint8).tobytes()
        try:
            # The first bytes decide what it is, as drivers write any text as its format.
            image_size(data, where)
        except RecordError as error:
            raise RecordError(f"{error} (its format states '{printable(message.format)}')") from None
        return data

    def read(i: int) -> NDArray[np.uint8]:
        row = int(stamped.row[i])
        if compressed:
            return decode_image(encoded(i), bag.where(topic, row), size_px)
        return image_from(decode(bag, topic, row), bag.where(topic, row), size_px)

    return Stream(camera.name, stamped.t_ns, read, encoded if compressed else None)


def lidar_stream(bag: Bag, name: str, chosen: LidarTopic, stamped: Stamped) -> Stream:
    """Stream of the sweeps of a LiDAR."""
    topic, offset_ns = bag.topics[chosen.topic], round(chosen.offset_s * NS_PER_S)
    period_ns = float(np.median(np.diff(stamped.t_ns))) if len(stamped.t_ns) > 1 else DEFAULT_PERIOD_NS

    def read(i: int) -> Sweep:
        row, t_ns = int(stamped.row[i]), int(stamped.t_ns[i]) - offset_ns
        where = bag.where(topic, row)
        if topic.msgtype in messages.TYPES:
            sweep = messages.sweep_from_livox(bag.read(topic, row), topic.encoding, t_ns, chosen, where)
        else:
            sweep = sweep_from(decode(bag, topic, row), t_ns, period_ns, chosen, where)
        later_ns = None if sweep.t_ns is None else sweep.t_ns + offset_ns
        compensated_ns = None if sweep.compensated_ns is None else sweep.compensated_ns + offset_ns
        return replace(sweep, stamp_ns=sweep.stamp_ns + offset_ns, t_ns=later_ns, compensated_ns=compensated_ns)

    return Stream(name, stamped.t_ns, read)
