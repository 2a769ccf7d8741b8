"""Settings of a reconstruction: defaults, then a TOML file, then `section.key=value`, then options of the command line.

A setting is here only when users of different logs need different values; everything else is a named constant beside the
code that uses it. The models also give `schemas/config-1.json` and the comments that `log2sim config` prints.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, ConfigDict, ValidationError

from log2sim.config_sections import (
    AppearanceConfig,
    CalibrationConfig,
    CooperationConfig,
    DetectConfig,
    LidarConfig,
    MapConfig,
    MeasureConfig,
    PosesConfig,
    Section,
    SmoothConfig,
    SyncConfig,
    TopdownConfig,
    TrackConfig,
    setting,
)
from log2sim.errors import ConfigError
from log2sim.input_files import read_text
from log2sim.model_errors import first_problem

CONFIG_LIMIT_BYTES = 1024 * 1024
KINDS = {
    "integer": "whole number",
    "number": "number",
    "boolean": "true or false",
    "string": "text",
    "array": "names separated by commas",
}
"""Types of JSON Schema in plain words."""


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

        Raises
        ------
        ConfigError
            When it is no table, for an unknown key or a value out of its range.
        """
        if not isinstance(document, Mapping):
            raise ConfigError(f"settings: {type(document).__name__}, expected a table of settings")
        return _merged(cls(), document, "settings")

    @classmethod
    def load(cls, path: Path | str | None = None, settings: Iterable[str] = (), **overrides: Any) -> Config:
        """Read settings: defaults, then a TOML file, then `section.key=value`, then overrides that are not None.

        Parameters
        ----------
        path : path, optional
            TOML file.
        settings : iterable of str
            Entries such as "track.max_gap_s=2".
        **overrides
            Settings by name; a section as a document or as its model.

        Raises
        ------
        ConfigError
            For an unreadable file, an unknown key (naming the nearest known one) or a value out of its range.
        """
        config = cls()
        if path is not None:
            config = _merged(config, _read_toml(Path(path)), str(path))
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
        """Return a checked copy with some settings changed; a section takes a document of its changes.

        Raises
        ------
        ConfigError
            For an unknown key or a value out of its range.
        """
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


def _schema_of(section: type[Section], key: str) -> dict[str, Any]:
    """Return the JSON Schema of one setting, of its value where it may be absent."""
    schema: dict[str, Any] = section.model_json_schema()["properties"][key]
    return {**schema, **schema.get("anyOf", [{}])[0]}


def _toml_lines(section: Section, keys: Iterable[str], *, comments: bool) -> list[str]:
    lines = []
    for key in keys:
        value = getattr(section, key)
        if comments:
            lines.append(_comment(_schema_of(type(section), key)))
        if value is not None:
            lines.append(f"{key} = {_toml_value(value)}")
        elif comments:
            lines.append(f"# {key} = ")
    return lines


def _comment(schema: Mapping[str, Any]) -> str:
    """Return a setting's meaning and, in brackets, its type or choices, unit, limits and default, as a TOML comment."""
    facts = [" | ".join(schema["enum"]) if "enum" in schema else KINDS[schema["type"]]]
    if "unit" in schema:
        facts.append(f"unit {schema['unit']}")
    if "minimum" in schema:
        facts.append(f"from {schema['minimum']:.10g} to {schema['maximum']:.10g}")
    facts.append("not set by default" if schema["default"] is None else f"default {_toml_value(schema['default'])}")
    return f"# {schema['description']} [{', '.join(facts)}]"


def _read_toml(path: Path) -> dict[str, Any]:
    text = read_text(path, CONFIG_LIMIT_BYTES, ConfigError, missing="no such config file")
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as problem:
        raise ConfigError(f"{path}: not valid TOML: {problem}") from None


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
