"""Settings of a run: one frozen record a stage, read from defaults, a TOML file and `section.key=value`, in this order.

A setting is here only when users of different logs need different values; everything else is a named constant beside the
code that uses it.
"""

from __future__ import annotations

import dataclasses
import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_type_hints

from log2sim.errors import ConfigError
from log2sim.registry import nearest

CONFIG_LIMIT_BYTES = 1024 * 1024


def _choice(*allowed: str) -> Any:
    return field(default=allowed[0], metadata={"allowed": allowed})


def _number(default: float, low: float, high: float) -> Any:
    return field(default=default, metadata={"low": low, "high": high})


@dataclass(frozen=True)
class SyncConfig:
    """`reference`: camera that sets the ticks, "" for the log's own choice; `max_residual_s`: farthest record still taken."""

    reference: str = ""
    max_residual_s: float = _number(0.1, 1e-6, 10.0)


@dataclass(frozen=True)
class DetectConfig:
    """`name`: detector or path of an ONNX file; `min_score`: lowest score that can continue a track, 0 for the detector's own.

    `input_px`: side of the input of a model that takes any size, 0 for what its family takes.
    """

    name: str = "ssd-mobilenet-v2"
    min_score: float = _number(0.0, 0.0, 1.0)
    tiles: int = field(default=0, metadata={"low": 0, "high": 64})
    layout: str = ""
    input_px: int = field(default=0, metadata={"low": 0, "high": 8192})


@dataclass(frozen=True)
class MeasureConfig:
    """`mode`: "robust" or the paper's; `max_range_m`: obstacles farther from the ego are not measured."""

    mode: str = _choice("robust", "paper")
    max_range_m: float = _number(80.0, 1.0, 1000.0)


@dataclass(frozen=True)
class TopdownConfig:
    """`method`: how the image-to-ground homography is estimated; "off" leaves it out.

    `hypotheses`: sets of four that RANSAC draws, for the stream or for each frame, 0 for as many as the data need.
    """

    method: str = _choice("time-aware", "calibrated", "min-frame", "per-frame", "straw-man", "off")
    hypotheses: int = field(default=0, metadata={"low": 0, "high": 100_000})


@dataclass(frozen=True)
class TrackConfig:
    """`birth_score`: lowest score that can start a track; `max_gap_s`: longest occlusion that is bridged."""

    birth_score: float = _number(0.4, 0.0, 1.0)
    max_gap_s: float = _number(3.0, 0.0, 60.0)
    min_life_s: float = _number(0.3, 0.0, 60.0)


@dataclass(frozen=True)
class SmoothConfig:
    """`enabled`: off keeps the measured positions as they are, for comparison."""

    enabled: bool = True


@dataclass(frozen=True)
class Config:
    """All settings of a reconstruction."""

    seed: int = field(default=0, metadata={"low": 0, "high": 2**32 - 1})
    cameras: tuple[str, ...] = ()
    start_s: float | None = None
    stop_s: float | None = None
    sync: SyncConfig = field(default_factory=SyncConfig)
    detect: DetectConfig = field(default_factory=DetectConfig)
    measure: MeasureConfig = field(default_factory=MeasureConfig)
    topdown: TopdownConfig = field(default_factory=TopdownConfig)
    track: TrackConfig = field(default_factory=TrackConfig)
    smooth: SmoothConfig = field(default_factory=SmoothConfig)

    @classmethod
    def load(cls, path: Path | str | None = None, settings: Iterable[str] = (), **overrides: Any) -> Config:
        """Defaults, then the TOML file, then `section.key=value` settings, then keyword overrides that are not None.

        Raises
        ------
        ConfigError
            For an unreadable file, an unknown key (naming the nearest known one) or a value out of its range.
        """
        document = _read_toml(Path(path)) if path is not None else {}
        config = _apply(cls(), document, "", str(path))
        for setting in settings:
            key, equals, text = setting.partition("=")
            if not equals:
                raise ConfigError(f"--set {setting}: expected section.key=value")
            nested: Any = _parse_value(text)
            for part in reversed(key.strip().split(".")):
                nested = {part: nested}
            config = _apply(config, nested, "", f"--set {setting}")
        return _apply(config, {k: v for k, v in overrides.items() if v is not None}, "", "options")

    def to_dict(self) -> dict[str, Any]:
        """All settings as a nested document, as it stands in a scenario's provenance."""
        return {**dataclasses.asdict(self), "cameras": list(self.cameras)}

    def to_toml(self) -> str:
        """All settings as TOML that `load` reads back."""
        document = self.to_dict()
        lines = [f"{k} = {_toml_value(v)}" for k, v in document.items() if not isinstance(v, dict) and v is not None]
        for section, values in document.items():
            if isinstance(values, dict):
                lines += ["", f"[{section}]", *(f"{k} = {_toml_value(v)}" for k, v in values.items())]
        return "\n".join(lines) + "\n"


def _apply(record: Any, document: Mapping[str, Any], prefix: str, where: str) -> Any:
    """A copy of a settings record with the document's values, each checked."""
    known = {f.name: f for f in dataclasses.fields(record)}
    hints = get_type_hints(type(record))
    changes: dict[str, Any] = {}
    for key, value in document.items():
        if key not in known:
            raise ConfigError(
                f"{where}: unknown setting '{prefix}{key}'{nearest(key, list(known))}; known: {', '.join(known)}"
            )
        current = getattr(record, key)
        if dataclasses.is_dataclass(current):
            if dataclasses.is_dataclass(value):
                changes[key] = value
                continue
            if not isinstance(value, Mapping):
                raise ConfigError(
                    f"{where}: '{prefix}{key}' is a section; set one of its keys, e.g. {_first_key(current, prefix + key)}"
                )
            changes[key] = _apply(current, value, f"{prefix}{key}.", where)
        else:
            changes[key] = _checked(value, hints[key], known[key], f"{where}: '{prefix}{key}'")
    return dataclasses.replace(record, **changes)


def _first_key(record: Any, prefix: str) -> str:
    return f"{prefix}.{dataclasses.fields(record)[0].name}"


def _checked(value: Any, hint: Any, declared: dataclasses.Field[Any], where: str) -> Any:
    text = str(hint)
    if "tuple" in text:
        items = value.split(",") if isinstance(value, str) else value
        if not isinstance(items, (list, tuple)) or not all(isinstance(v, str) for v in items):
            raise ConfigError(f"{where} is {value!r}, expected names separated by commas")
        return tuple(v.strip() for v in items if v.strip())
    if hint is bool:
        if not isinstance(value, bool):
            raise ConfigError(f"{where} is {value!r}, expected true or false")
        return value
    if hint is str:
        allowed = declared.metadata.get("allowed")
        if not isinstance(value, str) or (allowed and value not in allowed):
            raise ConfigError(f"{where} is {value!r}, expected {' or '.join(allowed) if allowed else 'a text'}")
        return value
    if isinstance(value, bool) or not isinstance(value, (int, float)) or (hint is int and not isinstance(value, int)):
        raise ConfigError(f"{where} is {value!r}, expected {'a whole number' if hint is int else 'a number'}")
    if not math.isfinite(value):
        raise ConfigError(f"{where} is {value!r}, expected a finite number")
    low, high = declared.metadata.get("low", float("-inf")), declared.metadata.get("high", float("inf"))
    if not low <= value <= high:
        raise ConfigError(f"{where} is {value!r}, expected a number from {low:g} to {high:g}")
    return value if hint is int else float(value)


def _read_toml(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise ConfigError(f"{path}: no such config file")
    if path.stat().st_size > CONFIG_LIMIT_BYTES:
        raise ConfigError(f"{path}: larger than {CONFIG_LIMIT_BYTES} bytes, which no config file needs")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as problem:
        raise ConfigError(f"{path}: not valid TOML: {problem}") from None


def _parse_value(text: str) -> Any:
    """A value as TOML would read it; anything else is a text, so that quotes are not needed on the command line."""
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
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return repr(value)
