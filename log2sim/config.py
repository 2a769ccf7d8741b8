"""Settings of a reconstruction, as sections with defaults, limits and units: defaults, then a TOML file, then `section.key=value`, then options.

A setting is here only when users of different logs need different values; everything else is a named constant beside the
code that uses it. The models also give `schemas/config-1.json` and the comments that `log2sim config` prints.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args, get_origin

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from log2sim.errors import ConfigError
from log2sim.files.documents import first_problem
from log2sim.files.inputs import read_text

LIDAR_PREFIX = "lidar:"  # names of detectors in LiDAR sweeps begin with it
GIVEN_PREFIX = "given:"  # names of detectors that a program handed to `reconstruct` begin with it


def setting(default: Any, description: str, *, unit: str = "", ge: float | None = None, le: float | None = None) -> Any:
    """Declare a setting: its default, meaning, unit, and limits `ge` and `le`, which belong to the range."""
    return Field(
        default=default, description=description, json_schema_extra={"unit": unit} if unit else None, ge=ge, le=le
    )


class Section(BaseModel):
    """Base of all settings: immutable, no unknown key, no conversion of types, no NaN and no infinity."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    @classmethod
    def choices(cls, key: str) -> tuple[str, ...]:
        """Return the values that a setting may have, the default first; none for a setting that is free."""
        annotation = cls.model_fields[key].annotation
        return get_args(annotation) if get_origin(annotation) is Literal else ()


class SyncConfig(Section):
    """Synchronization of the sensors."""

    reference: str = setting(
        "",
        "Camera whose frames set the ticks, without cameras the LiDAR whose sweeps do; empty: the log's own choice, of "
        "LiDARs the one with the most sweeps.",
    )
    max_residual_s: float = setting(
        0.1, "Largest time between a tick and a record that is used for it.", unit="s", ge=1e-6, le=10.0
    )


class PosesConfig(Section):
    """Poses of the ego."""

    source: Literal["given", "lidar", "camera", "auto"] = setting(
        "given",
        "given: the log's own, and for a log without any what auto takes; lidar: odometry of the LiDAR on the ego; camera: "
        "motion of a camera above the ground; auto: lidar where the log has no poses or the LiDAR shows that they are worse, "
        "camera where it has neither, else given.",
    )
    check: bool = setting(
        True,
        "Whether the log's own poses are checked for jumps, standstills of the data and gaps, and for drift by the sweeps of a "
        "LiDAR on the ego, and repaired.",
    )


class CalibrationConfig(Section):
    """Checks of clocks and mounts against the motion of the ego."""

    check: bool = setting(True, "Whether offsets of clocks and rotations of mounts are estimated from the log.")
    fix_time: bool = setting(False, "Whether stamps of sensors are corrected by the estimated offsets.")
    fix_mounts: bool = setting(False, "Whether mounts of sensors are corrected by the estimated rotations.")


AUTO = "auto"


class DetectConfig(Section):
    """Detection in images."""

    name: str = setting(
        AUTO,
        "Detector in images: ssd-mobilenet-v2, a path to an ONNX model, or labels (boxes of the log); in LiDAR sweeps: "
        "lidar:vehicle, lidar:roadside, lidar:FILE.onnx or lidar:labels; both, joined by +; auto: ssd-mobilenet-v2 where "
        "there are cameras, joined with lidar:vehicle, or lidar:roadside where all LiDARs are at the road and tilted.",
    )
    min_score: float = setting(
        0.0, "Lowest score of a detection that can continue a track; 0: the detector's own.", ge=0.0, le=1.0
    )
    tiles: int = setting(
        0,
        "Overlapping tiles that are searched besides the whole image; 0: chosen from the image size; where sweeps are "
        "searched, too, every second of these in turn, unless a sweep shows a person or a two-wheeler there.",
        ge=0,
        le=64,
    )
    layout: str = setting("", "Output layout of an ONNX model; empty: recognized from its outputs.")
    input_px: int = setting(
        0, "Side of the input of an ONNX model that takes any size; 0: usual for its layout.", unit="px", ge=0, le=8192
    )

    period_s: float = setting(
        0.0,
        "Time from one search of a camera's pictures to the next, where LiDAR sweeps are searched at every tick; 0: every "
        "picture is searched. 0.3 takes a third of the detector's time and finds fewer people.",
        unit="s",
        ge=0.0,
        le=10.0,
    )

    @property
    def in_images(self) -> str:
        """Name of the detector in images, "" where LiDAR sweeps alone are searched."""
        return self._names()[0]

    @property
    def in_sweeps(self) -> str:
        """Name of the detector in LiDAR sweeps with its prefix "lidar:", "" where images alone are searched."""
        return self._names()[1]

    def _names(self) -> tuple[str, str]:
        if self.name.startswith(LIDAR_PREFIX):
            return "", self.name
        images, plus, sweeps = self.name.rpartition("+" + LIDAR_PREFIX)
        return (images, LIDAR_PREFIX + sweeps) if plus else (self.name, "")


class LidarConfig(Section):
    """Detection in clouds."""

    decode: Literal["centers", "votes"] = setting(
        "centers",
        "centers: a box for every peak of the network's map of centers; votes: a box for every cluster of cells by where "
        "they vote their object's center to be (Zou et al. 2021).",
    )
    sweeps: int = setting(1, "Successive clouds that the network sees as one.", ge=1, le=10)
    range_m: float = setting(
        0.0,
        "Largest distance from the LiDAR, along x and along y of the map, at which objects are detected; 0: the network's "
        "own.",
        unit="m",
        ge=0.0,
        le=250.0,
    )
    min_score: float = setting(0.0, "Lowest score of a box; 0: the network's own for each group.", ge=0.0, le=1.0)


class MeasureConfig(Section):
    """Measurement of detected objects by LiDAR."""

    mode: Literal["robust", "paper"] = setting(
        "robust",
        "robust: the object's cluster with an oriented box; paper: depth of the point nearest to the center of the "
        "detection and extents of all its points.",
    )
    max_range_m: float = setting(
        80.0, "Largest distance from the ego at which objects are measured.", unit="m", ge=1.0, le=1000.0
    )


class TopdownConfig(Section):
    """Homography from each image to the ground."""

    method: Literal["time-aware", "calibrated", "min-frame", "per-frame", "per-frame-skimage", "straw-man", "off"] = (
        setting("time-aware", "How the homography is estimated; off: not at all.")
    )
    hypotheses: int = setting(
        0, "Samples that RANSAC draws, per camera or per frame; 0: as many as the data need.", ge=0, le=100_000
    )
    rig: Literal["apart", "together"] = setting(
        "apart",
        "apart: the homography of each camera alone; together: those of all cameras at once, by time-aware RANSAC over the "
        "whole rig.",
    )


class CooperationConfig(Section):
    """Sensors on the ego (the vehicle end) and fixed in the map (the road end) together."""

    ends: Literal["both", "vehicle", "road"] = setting("both", "Whose sensors are used.")
    fusion: Literal["points", "boxes"] = setting(
        "points",
        "What of the two ends is joined where both have LiDARs: points: their clouds, before detection; boxes: what is "
        "detected in the clouds of each.",
    )
    register_road: bool = setting(
        True, "Whether poses and clocks of the road's sensors are checked and corrected against what the vehicle sees."
    )
    matching: Literal["covariance", "overlap"] = setting(
        "covariance",
        "How boxes of the ends are joined; covariance: matched by overlap or by distance in relation to its error, each side "
        "merged by its variance; overlap: matched by overlap and class, centers averaged (Chen).",
    )
    road_detector: str = setting(
        "auto",
        "Detector in the road's clouds where the ends are searched separately, named as in detect.name; auto: the network that "
        "fits the mounting.",
    )


class TrackConfig(Section):
    """Tracking over time."""

    birth_score: float = setting(0.4, "Lowest score of a detection that can start a track.", ge=0.0, le=1.0)
    max_gap_s: float = setting(3.0, "Longest occlusion that a track bridges.", unit="s", ge=0.0, le=60.0)
    min_life_s: float = setting(0.3, "Shortest track that is kept.", unit="s", ge=0.0, le=60.0)
    static_for_all: bool = setting(
        True, "Whether static agents exist for the whole scenario, but where the log shows their place free."
    )
    quarantine_confidence: float = setting(
        0.33,
        "Agents of a lower confidence stay in the file, but are left out of replays and exports. Of agents at 0.33 two of three are "
        "wrong. Without a LiDAR most are placed wrong, which is no reason to lose them: a third of it counts.",
        ge=0.0,
        le=1.0,
    )


class SmoothConfig(Section):
    """Smoothing of trajectories."""

    enabled: bool = setting(True, "Whether trajectories are smoothed; false keeps measured positions, for comparison.")


class MapConfig(Section):
    """Map of the ground, and what is read from it."""

    lanes: bool = setting(True, "Whether markings, borders of roads and lanes are looked for.")
    cell_m: float = setting(0.05, "Edge of a cell of the map.", unit="m", ge=0.02, le=1.0)


class AppearanceConfig(Section):
    """What pictures show of agents and traffic lights."""

    colors: bool = setting(True, "Whether colors of vehicles are estimated.")
    signals: bool = setting(True, "Whether traffic lights and their states are looked for.")


CONFIG_LIMIT_BYTES = 1024 * 1024
# Types of JSON Schema in plain words.
KINDS = {
    "integer": "whole number",
    "number": "number",
    "boolean": "true or false",
    "string": "text",
    "array": "names separated by commas",
}


def _names(value: Any) -> Any:
    """Return names from a list or from a text that separates them by commas; anything else is left to the check."""
    items = value.split(",") if isinstance(value, str) else value
    if not isinstance(items, (list, tuple)):
        return value
    names = tuple(item.strip() if isinstance(item, str) else item for item in items)
    return tuple(name for name in names if name != "")


def _detector(value: Any) -> Any:
    """Return the section of a detector that is given by its name alone."""
    return {"name": value} if isinstance(value, str) else value


class Config(Section):
    """All settings of a reconstruction."""

    model_config = ConfigDict(
        title="log2sim settings, version 1",
        json_schema_extra={"$schema": "https://json-schema.org/draft/2020-12/schema"},
    )

    seed: int = setting(0, "Seed of all random numbers.", ge=0, le=2**32 - 1)
    cameras: Annotated[tuple[str, ...], BeforeValidator(_names)] = setting(
        (), "Cameras that are used; empty: all of the log."
    )
    start_s: float | None = setting(None, "First time that is used, from the start of the log.", unit="s")
    stop_s: float | None = setting(None, "Last time that is used, from the start of the log.", unit="s")
    poses: PosesConfig = PosesConfig()
    calibration: CalibrationConfig = CalibrationConfig()
    sync: SyncConfig = SyncConfig()
    detect: Annotated[DetectConfig, BeforeValidator(_detector)] = DetectConfig()
    lidar: LidarConfig = LidarConfig()
    measure: MeasureConfig = MeasureConfig()
    topdown: TopdownConfig = TopdownConfig()
    cooperation: CooperationConfig = CooperationConfig()
    track: TrackConfig = TrackConfig()
    smooth: SmoothConfig = SmoothConfig()
    map: MapConfig = MapConfig()
    appearance: AppearanceConfig = AppearanceConfig()

    @model_validator(mode="after")
    def _starts_before_it_stops(self) -> Self:
        if self.start_s is not None and self.stop_s is not None and self.stop_s < self.start_s:
            raise ValueError(f"stop_s is {self.stop_s:g}, expected start_s, {self.start_s:g}, or more")
        return self

    def __init__(self, **settings: Any) -> None:
        """Check the settings; `ConfigError` names the one that is wrong.

        A section is its model or a document of its settings; `detect="labels"` is short for `detect={"name": "labels"}`.
        """
        try:
            super().__init__(**settings)
        except ValidationError as problem:
            raise ConfigError(first_problem(problem, Config)) from None

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> Config:
        """Build settings from a document such as `to_dict` returns and the provenance of a scenario holds; what it lacks has its default.

        Raises `ConfigError` when it is no table, for an unknown key or a value out of its range.
        """
        if not isinstance(document, Mapping):
            raise ConfigError(f"settings: {type(document).__name__}, expected a table of settings")
        return _merged(cls(), document, "settings")

    @classmethod
    def load(cls, path: Path | str | None = None, settings: Iterable[str] = (), **overrides: Any) -> Config:
        """Read settings: defaults, then a TOML file, then `section.key=value`, then overrides that are not None.

        `settings`: entries such as "track.max_gap_s=2". `overrides`: settings by name; a section as a document or as its model.
        Raises `ConfigError` for an unreadable file, an unknown key (naming the nearest known one) or a value out of its range.
        """
        config = cls()
        if path is not None:
            text = read_text(path, CONFIG_LIMIT_BYTES, ConfigError, missing="no such config file")
            try:
                config = _merged(config, tomllib.loads(text), str(path))
            except (tomllib.TOMLDecodeError, RecursionError) as problem:
                raise ConfigError(f"{path}: not valid TOML: {problem}") from None
        for entry in settings:
            key, equals, text = entry.partition("=")
            if not equals:
                raise ConfigError(f"--set {entry}: expected section.key=value")
            nested: Any = _parse_value(text)
            for part in reversed(key.strip().split(".")):
                nested = {part: nested}
            config = _merged(config, nested, f"--set {entry}")
        return _merged(config, {k: v for k, v in overrides.items() if v is not None}, "options")

    def changed(self, **changes: Any) -> Config:
        """Return a copy with some settings changed, `ConfigError` as for `load`; a section takes a document of its changes."""
        return _merged(self, changes, "changes")

    def to_dict(self) -> dict[str, Any]:
        """Return all settings as a nested JSON document, as the provenance of a scenario holds them."""
        return {**self.model_dump(), "cameras": list(self.cameras)}

    def to_toml(self, *, comments: bool = False) -> str:
        """Write all settings as TOML that `load` reads back, optionally with the meaning of each as a comment."""
        top = [key for key in type(self).model_fields if not isinstance(getattr(self, key), Section)]
        lines = _toml_lines(self, top, comments=comments)
        for key in type(self).model_fields:
            section = getattr(self, key)
            if isinstance(section, Section):
                title = [f"# {section.__doc__}"] if comments else []
                lines += ["", *title, f"[{key}]", *_toml_lines(section, type(section).model_fields, comments=comments)]
        return "\n".join(lines) + "\n"


def _merged(config: Config, changes: Mapping[str, Any], where: str) -> Config:
    """Return checked settings with the changes of a document; `where` begins the message of an error."""
    merged = _deep_merged(config.model_dump(), changes)
    unnamed = [key for key in merged if not isinstance(key, str)]
    if unnamed:
        raise ConfigError(f"{where}: {unnamed[0]!r} is no name of a setting")
    try:
        return Config(**merged)
    except ConfigError as problem:
        raise ConfigError(f"{where}: {problem}") from None


def _deep_merged(document: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(document)
    for key, value in changes.items():
        old = merged.get(key)
        new = value.model_dump() if isinstance(value, Section) else _detector(value) if key == "detect" else value
        merged[key] = _deep_merged(old, new) if isinstance(old, dict) and isinstance(new, Mapping) else new
    return merged


def _toml_lines(section: Section, keys: Iterable[str], *, comments: bool) -> list[str]:
    """Write settings, with comments each after its meaning and, in brackets, its type or choices, unit, limits and default."""
    lines, schemas = [], type(section).model_json_schema()["properties"]
    for key in keys:
        value = getattr(section, key)
        if comments:
            schema = {**schemas[key], **schemas[key].get("anyOf", [{}])[0]}
            facts = [" | ".join(schema["enum"]) if "enum" in schema else KINDS[schema["type"]]]
            facts += [f"unit {schema['unit']}"] if "unit" in schema else []
            facts += [f"from {schema['minimum']:.10g} to {schema['maximum']:.10g}"] if "minimum" in schema else []
            default = schema["default"]
            facts.append("not set by default" if default is None else f"default {_toml_value(default)}")
            lines.append(f"# {schema['description']} [{', '.join(facts)}]")
        if value is not None:
            lines.append(f"{key} = {_toml_value(value)}")
        elif comments:
            lines.append(f"# {key} = ")
    return lines


def _parse_value(text: str) -> Any:
    """Read a value as TOML; anything else is a text, so that quotes are not needed on the command line."""
    try:
        document = tomllib.loads(f"value = {text}")
    except (tomllib.TOMLDecodeError, RecursionError):
        return text
    return document["value"] if len(document) == 1 else text


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml_value(v) for v in value) + "]"
    if isinstance(value, str):
        # The escapes of JSON are TOML's too; DEL is the one character that only TOML wants escaped.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)
