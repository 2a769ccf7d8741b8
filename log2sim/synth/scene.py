"""Scene files: the description of a synthetic log as pydantic models, from which the JSON Schema `scene-1` is generated.

Map frame: x east, y north, z up, in m; the ground is z = 0. Sensors are mounted on the ego (x forward, y left, z up, origin
at the middle of the rear axle on the ground) or in the map; yaw counter-clockwise, pitch positive upwards.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from log2sim.datatypes import TYPICAL_SIZE_M
from log2sim.errors import ConfigError
from log2sim.input_files import read_text
from log2sim.model_errors import first_problem
from log2sim.synth.scene_keys import Angle, Color, Name, Number, Pixels, Size, Table, Vec2, Vec3, Whole, key
from log2sim.synth.scene_places import Arrow, Building, Road, Shadow, StopLine, TrafficLight, Zebra

MAX_SCENE_BYTES = 4 * 1024 * 1024


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

    Raises
    ------
    ConfigError
        When the file is missing, is no TOML, or holds an unknown key or an impossible value; names the file and the key.
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

    Raises
    ------
    ConfigError
        For the first unknown key or impossible value.
    """
    try:
        return Scene.model_validate(table)
    except ValidationError as error:
        raise ConfigError(first_problem(error, Scene)) from None


def scene_schema() -> dict[str, Any]:
    """JSON Schema of scene files, as stored in `schemas/scene-1.json`."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **Scene.model_json_schema(),
        "title": "log2sim scene file, version 1",
    }
