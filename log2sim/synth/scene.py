"""The description of a synthetic log: what stands and moves where, and which sensors look at it.

Map frame: x east, y north, z up, in m; the ground is z = 0. Sensors are given on the ego: x forward, y left, z up from the
middle of the rear axle on the ground; yaw counter-clockwise, pitch positive upwards.
"""

# ruff: noqa: RUF009  (`_of` is dataclasses.field with a check attached)

from __future__ import annotations

import difflib
import math
import tomllib
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any

from log2sim.datatypes import TYPICAL_SIZE_M
from log2sim.errors import ConfigError

SCENE_LIMIT_BYTES = 4 * 1024 * 1024
AGENT_CATEGORIES = ("car", "truck", "bus", "pedestrian", "cyclist")

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]


def _of(kind: str, default: Any = MISSING, **limits: Any) -> Any:
    """A field that `load_scene` checks: `kind` names the check, `low` and `high` bound numbers."""
    meta = {"kind": kind, **limits}
    return field(metadata=meta) if default is MISSING else field(default=default, metadata=meta)


@dataclass(frozen=True)
class Origin:
    """Where x = y = 0 lies on Earth."""

    latitude_deg: float = _of("number", 52.52, low=-80, high=84)
    longitude_deg: float = _of("number", 13.405, low=-180, high=180)
    altitude_m: float = _of("number", 34.0, low=-500, high=9000)


@dataclass(frozen=True)
class Road:
    """A road along a line, with a center marking and sidewalks."""

    line: tuple[Vec2, ...] = _of("points2")
    width_m: float = _of("number", 7.0, low=1, high=60)
    marking: str = _of("text", "dashed", choices=("dashed", "solid", "none"))
    sidewalk_m: float = _of("number", 2.5, low=0, high=20)


@dataclass(frozen=True)
class Zebra:
    """A crosswalk: its middle line goes from side to side of the road."""

    line: tuple[Vec2, ...] = _of("points2")
    width_m: float = _of("number", 3.0, low=1, high=20)


@dataclass(frozen=True)
class Building:
    """A box with a facade."""

    center: Vec2 = _of("vec2")
    size_m: Vec3 = _of("size")
    yaw_deg: float = _of("number", 0.0)
    color: tuple[int, int, int] = _of("color", (190, 180, 165))


@dataclass(frozen=True)
class Ego:
    """The recording vehicle; its waypoints guide the middle of its rear axle."""

    waypoints: tuple[Vec3, ...] = _of("points3")
    size_m: Vec3 = _of("size", (4.6, 1.9, 1.6))
    rear_axle_offset_m: float = _of("number", 1.4, low=0, high=10)
    rounding_m: float = _of("number", 25.0, low=0, high=200)
    wait_s: tuple[Vec2, ...] = _of("pairs", ())
    start_s: float = _of("number", 0.0)
    poses: str = _of("text", "gnss", choices=("gnss", "poses"))


@dataclass(frozen=True)
class AgentSpec:
    """A road user, on the way (`waypoints` of x, y, speed) or parked (`pose`: x and y of the box center, yaw in degrees).

    The waypoints of cars, trucks and buses guide the rear axle, those of the others the middle.
    """

    id: str = _of("text")
    category: str = _of("text", choices=AGENT_CATEGORIES)
    size_m: Vec3 | None = _of("size", None)
    color: tuple[int, int, int] = _of("color", (150, 30, 30))
    second_color: tuple[int, int, int] = _of("color", (45, 50, 66))
    skin: tuple[int, int, int] = _of("color", (196, 150, 122))
    hair: tuple[int, int, int] = _of("color", (52, 38, 28))
    shape: str = _of("text", "sedan", choices=("sedan", "hatch"))
    waypoints: tuple[Vec3, ...] = _of("points3", ())
    pose: Vec3 | None = _of("vec3", None)
    rounding_m: float | None = _of("number", None, low=0, high=200)
    wait_s: tuple[Vec2, ...] = _of("pairs", ())
    start_s: float = _of("number", 0.0)

    @property
    def vehicle(self) -> bool:
        return self.category in ("car", "truck", "bus")

    @property
    def box_m(self) -> Vec3:
        """Length, width, height: what was given or the category's typical size."""
        return self.size_m or TYPICAL_SIZE_M[self.category]

    @property
    def rear_axle_offset_m(self) -> float:
        """How far the box center lies ahead of the guided point."""
        return 0.3 * self.box_m[0] if self.vehicle else 0.0


@dataclass(frozen=True)
class CameraSpec:
    """A camera on the ego."""

    name: str = _of("text")
    position_m: Vec3 = _of("vec3")
    yaw_deg: float = _of("number", 0.0)
    pitch_deg: float = _of("number", 0.0, low=-60, high=60)
    fov_deg: float = _of("number", 70.0, low=5, high=150)
    size_px: tuple[int, int] = _of("size_px", (960, 600))
    rate_hz: float = _of("number", 10.0, low=0.1, high=200)
    offset_s: float = _of("number", 0.0)


@dataclass(frozen=True)
class LidarSpec:
    """A turning LiDAR on the ego. It turns clockwise over `azimuth_deg`, from the left (high) to the right (low).

    Its channels are spread evenly over `elevation_deg`, or stand where `channels_deg` says, which then counts instead.
    """

    name: str = _of("text")
    position_m: Vec3 = _of("vec3")
    yaw_deg: float = _of("number", 0.0)
    channels: int = _of("count", 32, low=1, high=256)
    elevation_deg: Vec2 = _of("vec2", (-24.0, 6.0))
    channels_deg: tuple[float, ...] = _of("angles", ())
    azimuth_deg: Vec2 = _of("vec2", (-180.0, 180.0))
    azimuth_step_deg: float = _of("number", 0.4, low=0.02, high=10)
    rate_hz: float = _of("number", 10.0, low=0.1, high=100)
    offset_s: float = _of("number", 0.0)
    range_m: float = _of("number", 80.0, low=1, high=500)
    noise_m: float = _of("number", 0.02, low=0, high=1)
    dropout: float = _of("number", 0.03, low=0, high=0.99)
    resolution_m: float = _of("number", 0.01, low=0, high=0.1)


@dataclass(frozen=True)
class Gnss:
    """GNSS/IMU: rate and standard deviations of its slowly wandering errors."""

    rate_hz: float = _of("number", 100.0, low=0.5, high=1000)
    position_sigma_m: float = _of("number", 0.02, low=0, high=10)
    angle_sigma_deg: float = _of("number", 0.1, low=0, high=10)


@dataclass(frozen=True)
class Scene:
    """A whole scene. TOML tables are named in the singular: [[road]], [[agent]], [[camera]] ..."""

    name: str = _of("text")
    duration_s: float = _of("number", low=0.1, high=600)
    ego: Ego = _of("table", cls=Ego)
    start_ns: int = _of("count", 1_700_000_000_000_000_000, low=0, high=9_000_000_000_000_000_000)
    origin: Origin = _of("table", Origin(), cls=Origin)
    road: tuple[Road, ...] = _of("tables", (), cls=Road)
    zebra: tuple[Zebra, ...] = _of("tables", (), cls=Zebra)
    building: tuple[Building, ...] = _of("tables", (), cls=Building)
    agent: tuple[AgentSpec, ...] = _of("tables", (), cls=AgentSpec)
    camera: tuple[CameraSpec, ...] = _of("tables", (), cls=CameraSpec)
    lidar: tuple[LidarSpec, ...] = _of("tables", (), cls=LidarSpec)
    gnss: Gnss = _of("table", Gnss(), cls=Gnss)


def load_scene(path: Path | str) -> Scene:
    """Read a scene file.

    Raises
    ------
    ConfigError
        When the file is missing, is no TOML, or holds an unknown key or an impossible value; names the file and the key.
    """
    path = Path(path)
    if not path.is_file():
        raise ConfigError(f"{path}: no such file")
    if path.stat().st_size > SCENE_LIMIT_BYTES:
        raise ConfigError(f"{path}: {path.stat().st_size} bytes, more than the {SCENE_LIMIT_BYTES} of a scene file")
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as problem:
        raise ConfigError(f"{path}: not valid TOML: {problem}") from None
    try:
        return scene_from_table(table)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def scene_from_table(table: dict[str, Any]) -> Scene:
    """A scene from a TOML document."""
    scene: Scene = _build(Scene, table, "")
    sensors = [c.name for c in scene.camera] + [d.name for d in scene.lidar]
    for kind, names in (("agent", [a.id for a in scene.agent]), ("sensor", sensors)):
        for name in names:
            if names.count(name) > 1:
                raise ConfigError(f"{kind} '{name}' stands twice; names must be unique")
            if not name or not all(c.isalnum() or c in "_-" for c in name):
                raise ConfigError(f"{kind} '{name}': a name may only have letters, digits, '_' and '-'")
    for agent in scene.agent:
        if agent.id == "ego":
            raise ConfigError("agent 'ego': this id belongs to the recording vehicle; choose another")
        if bool(agent.waypoints) == (agent.pose is not None):
            raise ConfigError(f"agent '{agent.id}': give either 'waypoints' or 'pose' (x, y, yaw in degrees)")
    return scene


def _build(cls: Any, table: Any, where: str) -> Any:
    if not isinstance(table, dict):
        raise ConfigError(f"{where or 'the file'}: expected a table, found {type(table).__name__}")
    known = {f.name: f for f in fields(cls)}
    for key in table:
        if key not in known:
            near = difflib.get_close_matches(key, known, 1, 0.0)[0]
            raise ConfigError(f"unknown key '{where}{key}'; did you mean '{where}{near}'?")
    values = {}
    for name, f in known.items():
        if name in table:
            values[name] = _checked(f.metadata, table[name], f"{where}{name}")
        elif f.default is MISSING:
            raise ConfigError(f"'{where}{name}' is missing")
    return cls(**values)


def _checked(meta: Any, value: Any, where: str) -> Any:
    kind = meta["kind"]
    if kind == "table":
        return _build(meta["cls"], value, f"{where}.")
    if kind == "tables":
        rows = _list(value, where)
        return tuple(_build(meta["cls"], row, f"{where}[{i}].") for i, row in enumerate(rows))
    if kind == "text":
        if not isinstance(value, str) or value not in meta.get("choices", (value,)):
            expected = "one of " + ", ".join(meta["choices"]) if "choices" in meta else "text"
            raise ConfigError(f"'{where}' is {value!r}, expected {expected}")
        return value
    if kind in ("number", "count"):
        return _number(value, where, meta.get("low", -math.inf), meta.get("high", math.inf), whole=kind == "count")
    if kind in ("points2", "points3", "pairs"):
        width = 3 if kind == "points3" else 2
        rows = [_vector(row, width, f"{where}[{i}]") for i, row in enumerate(_list(value, where))]
        if kind == "points2" and len(rows) < 2:
            raise ConfigError(f"'{where}' has {len(rows)} points, expected two or more")
        return tuple(rows)
    if kind == "angles":
        angles = _list(value, where)
        if not 1 <= len(angles) <= 256:
            raise ConfigError(f"'{where}' has {len(angles)} values, expected 1 to 256")
        return _vector(value, len(angles), where, low=-90, high=90)
    if kind == "size":
        return _vector(value, 3, where, low=0.1, high=500)
    if kind == "color":
        return _vector(value, 3, where, low=0, high=255, whole=True)
    if kind == "size_px":
        return _vector(value, 2, where, low=16, high=8192, whole=True)
    return _vector(value, 2 if kind == "vec2" else 3, where)


def _list(value: Any, where: str) -> list[Any]:
    if not isinstance(value, list):
        raise ConfigError(f"'{where}' is {value!r}, expected a list")
    return value


def _vector(
    value: Any, width: int, where: str, low: float = -1e7, high: float = 1e7, *, whole: bool = False
) -> tuple[Any, ...]:
    values = _list(value, where)
    if len(values) != width:
        raise ConfigError(f"'{where}' has {len(values)} values, expected {width}")
    return tuple(_number(v, f"{where}[{i}]", low, high, whole=whole) for i, v in enumerate(values))


def _number(value: Any, where: str, low: float, high: float, *, whole: bool = False) -> Any:
    good = isinstance(value, int if whole else (int, float)) and not isinstance(value, bool)
    if not good or not math.isfinite(value) or not low <= value <= high:
        raise ConfigError(
            f"'{where}' is {value!r}, expected a {'whole ' if whole else ''}number from {low:g} to {high:g}"
        )
    return value if whole else float(value)
