"""Settings that a recording lacks: a TOML file next to it (topics.toml) with topics, frames, poses and the ego."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationError, model_validator

from log2sim.config_sections import Section
from log2sim.errors import ConfigError
from log2sim.geometry import DISTORTION_LENGTHS
from log2sim.input_files import is_present, read_text
from log2sim.logs.pose_checks import QUATERNION_TOLERANCE
from log2sim.model_errors import first_problem

MAX_SETTINGS_BYTES = 1024 * 1024
MAX_OFFSET_S = 10.0
NAME = r"^[A-Za-z0-9_-]+$"


def _as_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


Vector = Annotated[tuple[float, float, float], BeforeValidator(_as_tuple)]
Quaternion = Annotated[tuple[float, float, float, float], BeforeValidator(_as_tuple)]
Numbers = Annotated[tuple[float, ...], BeforeValidator(_as_tuple)]
Name = Annotated[str, Field(pattern=NAME)]


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
            raise ValueError(
                f"distortion has {len(self.distortion)} values, '{self.distortion_model}' takes {expected}"
            )
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
        if abs(norm - 1) > QUATERNION_TOLERANCE:
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
    static_transforms: Annotated[tuple[StaticTransform, ...], BeforeValidator(_as_tuple)] = ()


def read_settings(places: Iterable[Path]) -> tuple[TopicSettings, Path | None]:
    """Read the first settings file that exists, and say which; defaults where there is none.

    Raises
    ------
    ConfigError
        For a file that is no TOML, an unknown key or a value out of its range; names file and key.
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
