"""Messages of a recording, their stamps, and the settings that it lacks.

The definitions are those that rosbags comes with, not those in the bag: rosbags compiles definitions to Python code, and a log
must not make log2sim run any. A topic whose own definition has other fields is not decoded.
"""

from __future__ import annotations

import re
import struct
import threading
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, model_validator

from log2sim.config import Section
from log2sim.datatypes import Sweep
from log2sim.datatypes.log import ROTATION_TOLERANCE
from log2sim.errors import ConfigError, MissingExtra, RecordError
from log2sim.files.documents import first_problem
from log2sim.files.inputs import is_present, read_text
from log2sim.geometry import DISTORTION_LENGTHS, NS_PER_S
from log2sim.logs.checks import Span, describe_gap
from log2sim.logs.records import MAX_SWEEP_POINTS, sweep_of
from log2sim.logs.ros.bag import ENCODINGS, STAMP, Bag, Topic, stamp_of
from log2sim.logs.ros.containers import one_line
from log2sim.logs.stamps import strictly_increasing

MAX_SETTINGS_BYTES = 1024 * 1024
MAX_OFFSET_S = 10.0

# Lists, as TOML has them, become tuples; their items are not converted.
Vector = Annotated[tuple[float, float, float], Field(strict=False)]
Quaternion = Annotated[tuple[float, float, float, float], Field(strict=False)]
Numbers = Annotated[tuple[float, ...], Field(strict=False)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]


class Intrinsics(Section):
    """Calibration of a camera without CameraInfo, as the native log folder has it."""

    width_px: int = Field(gt=0, le=100_000)
    height_px: int = Field(gt=0, le=100_000)
    fx_px: float = Field(gt=0)
    fy_px: float = Field(gt=0)
    cx_px: float
    cy_px: float
    distortion_model: Literal["none", "brown", "fisheye"] = "none"
    distortion: Numbers = ()

    @model_validator(mode="after")
    def _check_length(self) -> Intrinsics:
        lengths = DISTORTION_LENGTHS[self.distortion_model]
        if len(self.distortion) not in lengths:
            expected = " or ".join(map(str, lengths))
            raise ValueError(f"distortion has {len(self.distortion)} values; '{self.distortion_model}': {expected}")
        return self


class LineReadout(Section):
    """Rolling shutter of a camera, as `log2sim.geometry.RollingShutter` has it."""

    direction: Literal["down", "up", "right", "left"]
    readout_s: float = Field(gt=0, le=1)


class CameraTopic(Section):
    """A camera.

    `rectified` states whether the images are free of distortion, so that P of the CameraInfo is theirs; without it the name
    of the topic decides. `info` and `frame` default to what names and headers say. `offset_s` is added to the stamps, so that
    they are of the middle of the exposure and of the LiDAR's clock.
    """

    topic: str
    info: str = ""
    frame: str = ""
    rectified: bool | None = None
    stamps: Literal["header", "recorded"] = "header"
    offset_s: float = Field(default=0.0, ge=-MAX_OFFSET_S, le=MAX_OFFSET_S)
    rolling_shutter: LineReadout | None = None
    intrinsics: Intrinsics | None = None


class LidarTopic(Section):
    """A LiDAR.

    `time_field` is the field of the points' times ("none": there is none), `time_unit` its unit; both are recognized by
    default. `stamp` states whether the header's stamp is the start or the end of the sweep; by default times that are not
    negative count from it, and negative ones before it. `compensated`: a node has moved all points to that stamp. `offset_s` is
    added to all stamps.
    """

    topic: str
    frame: str = ""
    time_field: str = ""
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    stamp: Literal["auto", "start", "end"] = "auto"
    compensated: bool = False
    stamps: Literal["header", "recorded"] = "header"
    offset_s: float = Field(default=0.0, ge=-MAX_OFFSET_S, le=MAX_OFFSET_S)


class StaticTransform(Section):
    """A transform that /tf_static lacks: parent_T_child."""

    parent: str
    child: str
    translation_m: Vector = (0.0, 0.0, 0.0)
    rotation_wxyz: Quaternion = (1.0, 0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _check_norm(self) -> StaticTransform:
        norm = sum(v * v for v in self.rotation_wxyz) ** 0.5
        if abs(norm - 1) > ROTATION_TOLERANCE:
            raise ValueError(f"rotation_wxyz of '{self.child}' has norm {norm:.6g}, expected a unit quaternion")
        return self


class EgoSettings(Section):
    """The vehicle: its frame in the bag, where in it the ego's origin lies, its box.

    The origin is the point below the middle of the rear axle; `rotation_wxyz` turns the ego's axes (x forward, y left, z up)
    to those of the frame; `ground_z_m` is the height of the road above the origin.
    """

    base_frame: str = ""
    origin_m: Vector = (0.0, 0.0, 0.0)
    rotation_wxyz: Quaternion = (1.0, 0.0, 0.0, 0.0)
    ground_z_m: float | None = None
    size_m: Vector | None = None
    rear_axle_offset_m: float | None = None


class PoseSettings(Section):
    """The source of the ego's poses: its kind, its topic, of GNSS the topic of the Imu, of /tf the fixed frame."""

    source: Literal["auto", "tf", "odometry", "pose", "gnss", "none"] = "auto"
    topic: str = ""
    imu: str = ""
    fixed_frame: str = ""


class MapSettings(Section):
    """Where the map lies, for poses of GNSS; by default a transverse Mercator projection about the first fix."""

    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_m: float | None = None
    projection: str | None = None


class TopicSettings(Section):
    """The whole file; where cameras or LiDARs are listed, only those are used."""

    cameras: dict[Name, CameraTopic] = Field(default_factory=dict)
    lidars: dict[Name, LidarTopic] = Field(default_factory=dict)
    reference_camera: str | None = None
    ego: EgoSettings = EgoSettings()
    poses: PoseSettings = PoseSettings()
    map: MapSettings = MapSettings()
    static_transforms: Annotated[tuple[StaticTransform, ...], Field(strict=False)] = ()


def read_settings(places: Iterable[Path]) -> tuple[TopicSettings, Path | None]:
    """Read the first settings file that exists, and say which; defaults where there is none.

    Raises `ConfigError` for a file that is no TOML, an unknown key or a value out of its range; names file and key.
    """
    path = next((p for p in places if is_present(p)), None)
    if path is None:
        return TopicSettings(), None
    text = read_text(path, MAX_SETTINGS_BYTES, ConfigError)
    try:
        return TopicSettings.model_validate(tomllib.loads(text)), path
    except (tomllib.TOMLDecodeError, RecursionError) as problem:
        raise ConfigError(f"{path}: not valid TOML: {problem}") from None
    except ValidationError as problem:
        raise ConfigError(f"{path}: {first_problem(problem, TopicSettings)}") from None


MIN_POSES = 2
# A topic of single goals or starting points is no trajectory.
MIN_COVERED_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class Stamped:
    """Messages of a topic in the order of their stamps; F is their number."""

    t_ns: NDArray[np.int64]  # (F,): strictly increasing
    row: NDArray[np.intp]  # (F,): which message of the topic each is
    delay_s: float | None  # median from the header's stamp to the recorder's; None where the recorder's are used


def stamp_messages(topic: Topic, heads: Sequence[bytes | None], notes: list[str], *, recorded: bool = False) -> Stamped:
    """Take the stamps from the first bytes of the messages of a topic; None of them where a message is damaged.

    A damaged message keeps its place: it gets the recorder's stamp less the usual delay, so that reading it is what fails.
    """
    t_ns, known = np.zeros(len(topic), dtype=np.int64), np.zeros(len(topic), dtype=bool)
    for i, head in enumerate(heads):
        if head is not None and len(head) >= STAMP.stop:
            try:
                t_ns[i], known[i] = stamp_of(head, topic.encoding), True
            except struct.error:
                continue
    if recorded or not t_ns.any():
        if not recorded and known.any():
            notes.append(f"{topic.name}: its header stamps are all 0; those of the recorder are used")
        t_ns, known, delay_s = topic.recorded_ns, np.ones(len(topic), dtype=bool), None
    else:
        delay_ns = np.median(topic.recorded_ns[known] - t_ns[known])
        t_ns = np.where(known, t_ns, topic.recorded_ns - np.int64(delay_ns))
        delay_s = float(delay_ns) / NS_PER_S
    lost = int((~known).sum())
    if lost:
        notes.append(f"{topic.name}: {lost} of {len(topic)} messages are damaged, first at stamp {t_ns[~known][0]}")
    row = strictly_increasing(t_ns, topic.name, notes)
    return Stamped(t_ns[row], row, delay_s)


def describe_uncovered(t_ns: NDArray[np.int64], begin_ns: int, end_ns: int) -> str:
    """Say why poses at stamps (P,) ns do not cover the time of the sensors; "" where they do."""
    covered_ns = max(0, min(end_ns, int(t_ns[-1])) - max(begin_ns, int(t_ns[0]))) if len(t_ns) else 0
    if len(t_ns) >= MIN_POSES and covered_ns >= MIN_COVERED_SHARE * (end_ns - begin_ns):
        return ""
    poses, sensors = Span.of("poses", t_ns) if len(t_ns) else None, Span("frames and sweeps", begin_ns, end_ns)
    if poses is not None and poses.is_apart(sensors):
        return describe_gap(poses, sensors)
    seconds = f"{covered_ns / NS_PER_S:.1f} of {(end_ns - begin_ns) / NS_PER_S:.1f} s"
    return f"it gives {len(t_ns)} poses in {seconds} of the sensors"


TYPES = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")
# CustomPoint: time in ns after the stamp, position in m; then reflectivity, tag and line.
POINT_FORMATS = ("u4", "f4", "f4", "f4", "u1")
POINT_BYTES = 19
ENCAPSULATION_BYTES = 4


def sweep_from_livox(raw: bytes, encoding: str, t_ns: int, settings: LidarTopic, where: str) -> Sweep:
    """Build a sweep from the bytes of a CustomMsg; `RecordError`, beginning with `where`, when they are damaged.

    The points are viewed as an array: decoded one by one, 20,000 of them would take longer than a sweep lasts.
    """
    order = "<" if encoding == "ros1" or raw[1:2] == b"\1" else ">"
    try:
        (length,) = struct.unpack_from(order + "I", raw, STAMP.stop)
        position = STAMP.stop + 4 + length
        if encoding != "ros1":  # CDR aligns numbers to their size, counted from behind the encapsulation
            position += -(position - ENCAPSULATION_BYTES) % 8
        # timebase, point_num, lidar_id, rsvd[3]
        (count,) = struct.unpack_from(order + "I", raw, position + 16)
    except struct.error:
        raise RecordError(f"{where}: {len(raw)} bytes, too few for a CustomMsg") from None
    begin = position + 20
    step = POINT_BYTES if encoding == "ros1" else POINT_BYTES + 1
    if count > MAX_SWEEP_POINTS or begin + count * step - (step - POINT_BYTES) > len(raw):
        raise RecordError(f"{where}: {len(raw)} bytes for {count} points of {step} bytes")
    # CDR does not pad the last point.
    data = raw[begin : begin + count * step].ljust(count * step, b"\0")
    formats = [order + kind for kind in POINT_FORMATS]
    dtype = np.dtype({"names": list("txyzr"), "formats": formats, "offsets": [0, 4, 8, 12, 16], "itemsize": step})
    points: NDArray[Any] = np.frombuffer(data, dtype)
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float32)
    kept = xyz.any(axis=1)
    offset = points["t"][kept].astype(np.int64)
    if settings.stamp == "end" and len(offset):
        offset -= offset.max()
    times = None if settings.time_field == "none" else offset
    return sweep_of(xyz[kept], t_ns, times, "lidar", t_ns if settings.compensated else None, points["r"][kept])


# ROS 1 called it so before tf2.
ALIASES = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}
_FIELD = re.compile(r"^\s*[\w/<>=]+(?:\[[<>=\d]*\])?\s+(?P<name>[A-Za-z]\w*)\s*(?P<constant>=)?")
_COMPILING = threading.Lock()


def decode(bag: Bag, topic: Topic, i: int) -> Any:
    """Decode message `i` of a topic; `RecordError` where it is damaged."""
    return decode_bytes(topic, bag.read(topic, i), bag.where(topic, i))


def decode_bytes(topic: Topic, raw: bytes, where: str) -> Any:
    """Decode the bytes of a message; `RecordError`, beginning with `where`, when they are damaged."""
    if topic.encoding == "cdr" and raw[:2] not in (b"\0\0", b"\0\1"):
        raise RecordError(f"{where}: encapsulation {raw[:2].hex() or 'missing'}, only plain CDR (0000, 0001) is read")
    store = typestore(topic.encoding)
    kind = ALIASES.get(topic.msgtype, topic.msgtype)
    try:
        # rosbags compiles a type when it first meets it.
        with _COMPILING:
            return store.deserialize_ros1(raw, kind) if topic.encoding == "ros1" else store.deserialize_cdr(raw, kind)
    except Exception as problem:  # rosbags raises whatever its compiled code runs into
        raise RecordError(f"{where}: not a readable {topic.msgtype}: {one_line(problem)}") from None


def find_layout_problem(topic: Topic) -> str | None:
    """Say why messages of a topic cannot be decoded; None when they can."""
    if topic.encoding not in ENCODINGS:
        return f"its messages are encoded as '{topic.encoding}', only ros1 and cdr are read"
    if topic.msgtype in TYPES:
        expected = ["header", "timebase", "point_num", "lidar_id", "rsvd", "points"]
    else:
        definitions = typestore(topic.encoding).fielddefs
        expected = [name for name, _ in definitions[ALIASES.get(topic.msgtype, topic.msgtype)][1]]
    # Of the first message of a definition text.
    lines = topic.definition.partition("\n====")[0].splitlines()
    fields = [match for line in lines if (match := _FIELD.match(line.partition("#")[0])) and not match["constant"]]
    found = [match["name"] for match in fields]
    if topic.definition and found != expected:
        return f"its definition of {topic.msgtype} has the fields {', '.join(found)}, expected {', '.join(expected)}"
    return None


@cache
def typestore(encoding: str) -> Any:
    """Definitions that rosbags comes with, for ROS 1 (Noetic) or ROS 2 (Humble)."""
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise MissingExtra("reading ROS bags and MCAP files", "ros") from None
    if encoding != "ros1":
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", "tf2_msgs/msg/TFMessage"))
    return store
