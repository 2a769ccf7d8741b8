"""Scene files: the description of a synthetic log as pydantic models, checked when it is read.

Map frame: x east, y north, z up, in m; the ground is z = 0. Sensors are mounted on the ego (x forward, y left, z up, origin
at the middle of the rear axle on the ground) or in the map; yaw counter-clockwise, pitch positive upwards.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, JsonValue, Strict, ValidationError, model_validator

from log2sim.datatypes import TYPICAL_SIZE_M
from log2sim.errors import ConfigError
from log2sim.files.documents import first_problem
from log2sim.files.inputs import read_text

MAX_COORDINATE_M = 1e7

Number = Annotated[float, Strict()]
Whole = Annotated[int, Strict()]
Coordinate = Annotated[float, Strict(), Field(ge=-MAX_COORDINATE_M, le=MAX_COORDINATE_M)]
Extent = Annotated[float, Strict(), Field(ge=0.1, le=500)]
Angle = Annotated[float, Strict(), Field(ge=-90, le=90)]
Channel = Annotated[int, Strict(), Field(ge=0, le=255)]
Pixels = Annotated[int, Strict(), Field(ge=16, le=8192)]
Name = Annotated[str, Field(pattern=r"^[\w-]+$")]

Vec2 = tuple[Coordinate, Coordinate]
Vec3 = tuple[Coordinate, Coordinate, Coordinate]
Size = tuple[Extent, Extent, Extent]
Color = tuple[Channel, Channel, Channel]
Line = Annotated[tuple[Vec2, ...], Field(min_length=2)]


def key(description: str, default: Any = ..., unit: str | None = None, **limits: Any) -> Any:
    """Declare a key of a scene file: what it means, its default, its unit and its limits (`ge`, `le`, `max_length` ...)."""
    extra: dict[str, JsonValue] = {} if unit is None else {"unit": unit}
    return Field(default, description=description, json_schema_extra=extra, **limits)


class Table(BaseModel):
    """Base of all tables of a scene file: immutable, unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


PaintColor = Literal["white", "yellow"]
LampState = Literal["red", "red_yellow", "yellow", "green", "off"]
Share = Annotated[Number, Field(ge=0, le=1)]
Length = Annotated[Number, Field(ge=0.1, le=100)]

WORN = "Share of the paint that is worn off, in patches."


class Road(Table):
    """A road along a polyline, with markings and sidewalks."""

    line: Line = key("Center line, points [x, y].", unit="m")
    width_m: Number = key("Width of the carriageway.", 7.0, "m", ge=1, le=60)
    lanes: Whole = key("Number of lanes of equal width.", 2, ge=1, le=12)
    lanes_back: Whole | None = key(
        "Number of lanes that lead against the line, 0 for a one-way road; by default half of them.", None, ge=0, le=12
    )
    marking: Literal["dashed", "solid", "none"] = key("Marking between lanes.", "dashed")
    center_marking: Literal["dashed", "solid", "double", "none"] | None = key(
        "Marking between the two directions; by default as between lanes.", None
    )
    side_marking: Literal["dashed", "solid", "none"] = key("Markings along both sides.", "solid")
    side_line_m: Number = key("Width of the markings along both sides.", 0.1, "m", ge=0.05, le=0.5)
    side_inset_m: Number = key("From the middle of these markings to the end of the road.", 0.2, "m", ge=0.1, le=10)
    color: PaintColor = key("Color of the markings.", "white")
    center_color: PaintColor | None = key("Color of the marking between the two directions.", None)
    dash_m: tuple[Length, Length] | None = key(
        "Length of a dash and of the gap behind it; by default 3 and 3, begun anew at each point of the line.",
        None,
        "m",
    )
    worn: Share = key(WORN, 0.0, "1")
    missing_m: tuple[Vec2, ...] = key("Stretches [begin, end] along the line without any marking.", (), "m")
    old_m: tuple[Coordinate, ...] = key(
        "How far to the left of the markings between lanes removed ones still shine through.", (), "m"
    )
    sidewalk_m: Number = key("Width of the sidewalk on each side.", 2.5, "m", ge=0, le=20)

    @property
    def backward_lanes(self) -> int:
        """Number of lanes that lead against the line."""
        return self.lanes // 2 if self.lanes_back is None else self.lanes_back

    @model_validator(mode="after")
    def _some_lanes_back(self) -> Self:
        if self.backward_lanes > self.lanes:
            raise ValueError(f"road: lanes_back is {self.lanes_back}, but the road has {self.lanes} lanes")
        return self


class Zebra(Table):
    """A crosswalk."""

    line: Line = key("Its center line from one side of the road to the other, points [x, y].", unit="m")
    width_m: Number = key("Extent along the road.", 3.0, "m", ge=1, le=20)
    worn: Share = key(WORN, 0.0, "1")


class StopLine(Table):
    """A line across a lane at which vehicles wait."""

    line: Line = key("From one side of the lane to the other, points [x, y].", unit="m")
    width_m: Number = key("Extent along the lane.", 0.5, "m", ge=0.1, le=2)
    color: PaintColor = key("Color of the paint.", "white")
    worn: Share = key(WORN, 0.0, "1")


class Arrow(Table):
    """An arrow in a lane."""

    position: Vec2 = key("Its middle [x, y].", unit="m")
    yaw_deg: Number = key("Direction that it points in, of one that bends the direction of its shaft.", 0.0, "deg")
    shape: Literal["straight", "left", "right"] = key("Where it points.", "straight")
    length_m: Number = key("Its length.", 5.0, "m", ge=1, le=12)
    worn: Share = key(WORN, 0.0, "1")


class Building(Table):
    """A box with a facade."""

    center: Vec2 = key("Center [x, y].", unit="m")
    size_m: Size = key("Length, width, height.", unit="m")
    yaw_deg: Number = key("Direction of its length.", 0.0, "deg")
    color: Color = key("Color of the facade, RGB 0 to 255.", (190, 180, 165))
    shadow: Annotated[bool, Field(strict=True)] = key("Whether it throws a shadow on the ground.", False)


class TrafficLight(Table):
    """A signal head of a traffic light with a red, a yellow and a green lamp."""

    id: Name = key("Unique name of letters, digits, '_' and '-'.")
    position: Vec3 = key("Middle of its housing [x, y, z].", unit="m")
    yaw_deg: Number = key("Direction that its lamps face.", 0.0, "deg")
    program: Annotated[tuple[tuple[LampState, Length], ...], Field(min_length=1)] = key(
        "Rows [state, seconds], again and again.", unit="1, s"
    )
    start_s: Annotated[Number, Field(ge=-1000, le=0)] = key("Time at which the program begins.", 0.0, "s")
    pole: Annotated[bool, Field(strict=True)] = key("Whether a pole behind it carries it.", True)


class Shadow(Table):
    """A shadow on the ground with sharp edges, of a tree or a house that is not in the scene."""

    outline: Annotated[tuple[Vec2, ...], Field(min_length=3)] = key("Its convex outline, points [x, y].", unit="m")


MAX_SCENE_BYTES = 4 * 1024 * 1024
DB_PER_NEPER = 4.343


class Origin(Table):
    """Geodetic position of x = y = 0."""

    latitude_deg: Number = key("Latitude of the origin, WGS 84.", 52.52, "deg", ge=-80, le=84)
    longitude_deg: Number = key("Longitude of the origin, WGS 84.", 13.405, "deg", ge=-180, le=180)
    altitude_m: Number = key("Altitude of the ground.", 34.0, "m", ge=-500, le=9000)


class Environment(Table):
    """Light and weather, for pictures and clouds."""

    light: Literal["noon", "overcast", "dusk", "night"] = key("Time of day and clouds.", "noon")
    weather: Literal["clear", "rain", "fog"] = key("What is in the air.", "clear")
    visibility_m: Number = key("Meteorological visibility in fog.", 120.0, "m", ge=10, le=1000)
    rain_mm_h: Number = key("Rate of rain.", 15.0, "mm/h", ge=0.1, le=200)
    wetness: Number | None = key("Wetness of the road; by default as the weather makes it.", None, "1", ge=0, le=1)
    glare: Annotated[bool, Field(strict=True)] = key("Whether a wet road mirrors the sun and lamps.", False)

    @property
    def extinction_per_m(self) -> float:
        """Share of light lost on a meter, 1/m: fog after Koschmieder (1924), rain after Carbonneau & Wisely (SPIE 1998)."""
        if self.weather == "rain":
            return float(1.076 * self.rain_mm_h**0.67 / DB_PER_NEPER / 1000)
        return 3.912 / self.visibility_m if self.weather == "fog" else 0.0


class Ego(Table):
    """The recording vehicle; its waypoints guide the middle of its rear axle."""

    waypoints: tuple[Vec3, ...] = key("Rows [x, y, speed].", unit="m, m, m/s")
    size_m: Size = key("Length, width, height.", (4.6, 1.9, 1.6), "m")
    rear_axle_offset_m: Number = key("Distance from the rear axle forward to the box center.", 1.4, "m", ge=0, le=10)
    rounding_m: Number = key("Window over which corners of the path are rounded.", 25.0, "m", ge=0, le=200)
    wait_s: tuple[Vec2, ...] = key("Rows [index of a waypoint with speed 0, time to stand there].", (), "1, s")
    start_s: Number = key("Time at the first waypoint.", 0.0, "s")
    poses: Literal["gnss", "poses"] = key("Whether the log states GNSS fixes or poses in the map.", "gnss")


class AgentSpec(Table):
    """A road user, moving along `waypoints` or static at `pose`.

    The waypoints of cars, trucks and buses guide the rear axle, those of the others the center.
    """

    id: Name = key("Unique name of letters, digits, '_' and '-'.")
    category: Literal["car", "truck", "bus", "pedestrian", "cyclist"] = key("Kind of road user.")
    size_m: Size | None = key("Length, width, height; by default typical for the category.", None, "m")
    color: Color = key("Body or upper clothes, RGB 0 to 255.", (150, 30, 30))
    second_color: Color = key("Cab, stripe or trousers, RGB 0 to 255.", (45, 50, 66))
    skin: Color = key("Skin, RGB 0 to 255.", (196, 150, 122))
    hair: Color = key("Hair, RGB 0 to 255.", (52, 38, 28))
    shape: Literal["sedan", "hatch"] = key("Body of a car.", "sedan")
    waypoints: tuple[Vec3, ...] = key("Rows [x, y, speed].", (), "m, m, m/s")
    pose: Vec3 | None = key("Box center and heading [x, y, yaw] of a static agent.", None, "m, m, deg")
    rounding_m: Number | None = key(
        "Window over which corners of the path are rounded; by default 25 for vehicles, else 3.",
        None,
        "m",
        ge=0,
        le=200,
    )
    wait_s: tuple[Vec2, ...] = key("Rows [index of a waypoint with speed 0, time to stand there].", (), "1, s")
    start_s: Number = key("Time at the first waypoint; it stands or comes straight before.", 0.0, "s")

    @property
    def vehicle(self) -> bool:
        """Whether it steers like a car."""
        return self.category in ("car", "truck", "bus")

    @property
    def box_m(self) -> tuple[float, float, float]:
        """Length, width, height: as given or the category's typical size."""
        return self.size_m or TYPICAL_SIZE_M[self.category]

    @property
    def rear_axle_offset_m(self) -> float:
        """Distance from the guided point forward to the box center."""
        return 0.3 * self.box_m[0] if self.vehicle else 0.0

    @model_validator(mode="after")
    def _moving_or_parked(self) -> Self:
        if self.id == "ego":
            raise ValueError("agent 'ego': this id belongs to the recording vehicle; choose another")
        if bool(self.waypoints) == (self.pose is not None):
            raise ValueError(f"agent '{self.id}': give either 'waypoints' or 'pose' (x, y, yaw in degrees)")
        return self


class CameraSpec(Table):
    """A pinhole camera on the ego or at the roadside."""

    name: Name = key("Unique name of letters, digits, '_' and '-'.")
    mount: Literal["ego", "map"] = key("What it is fixed to: the ego, or the map for one at the roadside.", "ego")
    position_m: Vec3 = key("Position [x, y, z] on its mount.", unit="m")
    yaw_deg: Number = key("Viewing direction, 0 along the mount's x axis, counter-clockwise.", 0.0, "deg")
    pitch_deg: Number = key("Viewing direction, positive upwards.", 0.0, "deg", ge=-90, le=60)
    fov_deg: Number = key("Horizontal field of view.", 70.0, "deg", ge=5, le=150)
    size_px: tuple[Pixels, Pixels] = key("Width and height of the image.", (960, 600), "px")
    rate_hz: Number = key("Frame rate.", 10.0, "Hz", ge=0.1, le=200)
    offset_s: Number = key("Time of one of its frames.", 0.0, "s")


class LidarSpec(Table):
    """A spinning LiDAR on the ego or at the roadside.

    It turns clockwise over `azimuth_deg`, from the left (high) to the right (low). First it is rolled, then pitched, then turned.
    """

    name: Name = key("Unique name of letters, digits, '_' and '-'.")
    mount: Literal["ego", "map"] = key("What it is fixed to: the ego, or the map for one at the roadside.", "ego")
    position_m: Vec3 = key("Position [x, y, z] on its mount.", unit="m")
    yaw_deg: Number = key("Direction of azimuth 0, 0 along the mount's x axis, counter-clockwise.", 0.0, "deg")
    pitch_deg: Number = key("Tilt of azimuth 0, positive upwards.", 0.0, "deg", ge=-90, le=90)
    roll_deg: Number = key("Tilt to the right, seen along azimuth 0.", 0.0, "deg", ge=-180, le=180)
    channels: Whole = key("Number of channels, spread evenly over `elevation_deg`.", 32, ge=1, le=256)
    elevation_deg: Vec2 = key("Lowest and highest channel.", (-24.0, 6.0), "deg")
    channels_deg: Annotated[tuple[Angle, ...], Field(min_length=1, max_length=256)] = key(
        "Elevation of each channel; replaces `channels` and `elevation_deg`.", (), "deg"
    )
    azimuth_deg: Vec2 = key("Right and left end of the field of view.", (-180.0, 180.0), "deg")
    azimuth_step_deg: Number = key("Angle between two firings.", 0.4, "deg", ge=0.02, le=10)
    rate_hz: Number = key("Turns per second.", 10.0, "Hz", ge=0.1, le=100)
    offset_s: Number = key("End of one of its sweeps.", 0.0, "s")
    range_m: Number = key("Largest measured distance.", 80.0, "m", ge=1, le=500)
    noise_m: Number = key("Standard deviation of a distance.", 0.02, "m", ge=0, le=1)
    dropout: Number = key("Share of returns that are lost.", 0.03, "1", ge=0, le=0.99)
    resolution_m: Number = key("Step to which coordinates are rounded; 0 keeps them.", 0.01, "m", ge=0, le=0.1)


class Gnss(Table):
    """GNSS/IMU whose errors are first-order Gauss-Markov processes."""

    rate_hz: Number = key("Rate of the poses.", 100.0, "Hz", ge=0.5, le=1000)
    position_sigma_m: Number = key("Standard deviation of each coordinate.", 0.02, "m", ge=0, le=10)
    angle_sigma_deg: Number = key("Standard deviation of each angle.", 0.1, "deg", ge=0, le=10)


class Scene(Table):
    """A whole scene. TOML tables are named in the singular: [[road]], [[agent]], [[camera]] ..."""

    name: str = key("Name of the log and the scenario.")
    duration_s: Number = key("Length of the log.", unit="s", ge=0.1, le=600)
    ego: Ego | None = key("The recording vehicle; none where all sensors are mounted in the map.", None)
    start_ns: Whole = key(
        "Stamp of the log's begin, Unix time.", 1_700_000_000_000_000_000, "ns", ge=0, le=9_000_000_000_000_000_000
    )
    origin: Origin = key("Position on Earth.", Origin())
    traffic: Literal["right", "left"] = key("Side of the road on which vehicles drive.", "right")
    road: tuple[Road, ...] = key("Roads.", ())
    zebra: tuple[Zebra, ...] = key("Crosswalks.", ())
    stop_line: tuple[StopLine, ...] = key("Stop lines.", ())
    arrow: tuple[Arrow, ...] = key("Arrows on the road.", ())
    shadow: tuple[Shadow, ...] = key("Shadows on the ground, where the sun shines.", ())
    building: tuple[Building, ...] = key("Buildings.", ())
    traffic_light: tuple[TrafficLight, ...] = key("Traffic lights.", ())
    agent: tuple[AgentSpec, ...] = key("Road users besides the ego.", ())
    camera: tuple[CameraSpec, ...] = key("Cameras.", ())
    lidar: tuple[LidarSpec, ...] = key("LiDARs.", ())
    gnss: Gnss = key("Errors of the ego's poses.", Gnss())
    environment: Environment = key("Light and weather.", Environment())

    @model_validator(mode="after")
    def _unique_names_and_mounts(self) -> Self:
        sensors = [c.name for c in self.camera] + [d.name for d in self.lidar]
        lights = [light.id for light in self.traffic_light]
        for kind, names in (("agent", [a.id for a in self.agent]), ("sensor", sensors), ("traffic light", lights)):
            for name in names:
                if names.count(name) > 1:
                    raise ValueError(f"{kind} '{name}' occurs twice; names must be unique")
        on_ego = [s.name for s in self.camera if s.mount == "ego"] + [s.name for s in self.lidar if s.mount == "ego"]
        if on_ego and self.ego is None:
            raise ValueError(f"sensor '{on_ego[0]}' is mounted on the ego, but there is no [ego]; use mount = \"map\"")
        return self


def load_scene(path: Path | str) -> Scene:
    """Read a scene file.

    Raises `ConfigError`, which names file and key, when it is missing, no TOML, or holds an unknown key or impossible value.
    """
    path = Path(path)
    text = read_text(path, MAX_SCENE_BYTES, ConfigError)
    try:
        table = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as problem:
        raise ConfigError(f"{path}: not valid TOML: {problem}") from None
    try:
        return scene_from_table(table)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def scene_from_table(table: dict[str, Any]) -> Scene:
    """Check a TOML document and make it a scene.

    Raises `ConfigError` for the first unknown key or impossible value.
    """
    try:
        return Scene.model_validate(table)
    except ValidationError as error:
        raise ConfigError(first_problem(error, Scene)) from None
