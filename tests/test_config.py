"""Settings: defaults, then a file, then --set, then options; what is unknown or out of range is named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator

from log2sim import config as config_module
from log2sim.config import Config, TrackConfig
from log2sim.errors import ConfigError, ScenarioError
from log2sim.files import documents
from log2sim.files.documents import load_schema


def write(folder: Path, text: str) -> Path:
    path = folder / "run.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_later_word_counts(tmp_path: Path) -> None:
    path = write(tmp_path, "seed = 1\n[track]\nmax_gap_s = 1.0\nbirth_score = 0.1\nmin_life_s = 0.2\n")
    settings = ["track.max_gap_s=2.0", "seed=2", "track.birth_score=0.2", "track.birth_score=0.3"]
    assert Config.load(None, [], seed=None, cameras=None) == Config()
    config = Config.load(path, settings, seed=3, stop_s=None)
    assert config.seed == 3
    assert config.track == TrackConfig(birth_score=0.3, max_gap_s=2.0, min_life_s=0.2)
    assert config.stop_s is None


@pytest.mark.parametrize(
    ("setting", "read"),
    [
        ("detect.name=labels", lambda c: c.detect.name == "labels"),
        ('detect.name="labels"', lambda c: c.detect.name == "labels"),
        ("detect.name=C:\\models\\a b.onnx", lambda c: c.detect.name == "C:\\models\\a b.onnx"),
        ("detect.layout=a=b", lambda c: c.detect.layout == "a=b"),
        ("smooth.enabled=false", lambda c: c.smooth.enabled is False),
        (" track.max_gap_s =1", lambda c: c.track.max_gap_s == 1.0 and isinstance(c.track.max_gap_s, float)),
        ("detect.tiles=4", lambda c: c.detect.tiles == 4 and isinstance(c.detect.tiles, int)),
        ("cameras=left, right,", lambda c: c.cameras == ("left", "right")),
        ('cameras=["left"]', lambda c: c.cameras == ("left",)),
        ("start_s=0.5", lambda c: c.start_s == 0.5),
        ("sync.max_residual_s=1e-3", lambda c: c.sync.max_residual_s == 1e-3),
    ],
)
def test_settings_read_like_toml_or_as_text(setting: str, read: object) -> None:
    assert read(Config.load(settings=[setting]))  # type: ignore[operator]


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("track.max_gap=1", r"unknown key 'track\.max_gap'; did you mean 'track\.max_gap_s'\?"),
        ("trak.max_gap_s=1", r"unknown key 'trak'; did you mean 'track'\?"),
        ("zzz=1", r"unknown key 'zzz'; known: seed, "),
        ("track=1", r"'track' is 1, expected a table with birth_score, "),
        ("seed.x=1", r"'seed' is \{'x': 1\}, expected a whole number"),
        ("seed", r"--set seed: expected section\.key=value"),
        ("seed=1.5", r"'seed' is 1\.5, expected a whole number"),
        ("seed=true", r"'seed' is True, expected a whole number"),
        ("seed=-1", r"'seed' is -1, expected a whole number from 0 to 4294967295"),
        ("detect.tiles=65", r"'detect\.tiles' is 65, expected a whole number from 0 to 64"),
        ("track.birth_score=1.1", r"'track\.birth_score' is 1\.1, expected a number from 0 to 1"),
        ("track.birth_score=nan", r"'track\.birth_score' is nan, expected a finite number"),
        ("smooth.enabled=1", r"'smooth\.enabled' is 1, expected true or false"),
        ("measure.mode=robus", r"'measure\.mode' is 'robus', expected one of robust, paper"),
        ("detect.name=3", r"'detect\.name' is 3, expected text"),
        ("cameras=3", r"'cameras' is 3, expected a list"),
        ("cameras=[1]", r"'cameras\[0\]' is 1, expected text"),
        ("start_s=inf", r"'start_s' is inf, expected a finite number"),
    ],
)
def test_what_cannot_be_is_one_clear_line(setting: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        Config.load(settings=[setting])
    assert str(caught.value).startswith(f"--set {setting.split('=')[0]}")
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"seed = \n", "not valid TOML"),
        (b"seed = 1\nseed = 2\n", "not valid TOML"),
        (b"\xff\xfe", "not a text in UTF-8"),
        (b"a = " + b"[" * 5000, "not valid TOML"),
    ],
    ids=["cut", "twice", "encoding", "deep"],
)
def test_files_that_are_no_toml(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "run.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=rf"run\.toml: {message}"):
        Config.load(path)


def test_a_file_larger_than_any_config_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path, "seed = 1\n")
    monkeypatch.setattr(config_module, "CONFIG_LIMIT_BYTES", 9)
    assert Config.load(path).seed == 1
    monkeypatch.setattr(config_module, "CONFIG_LIMIT_BYTES", 8)
    with pytest.raises(ConfigError, match="9 bytes, more than the 8 that it may have"):
        Config.load(path)


def test_toml_of_a_file_loads_back(tmp_path: Path) -> None:
    config = Config.load(settings=["detect.name='say \"a\\b\"'", "cameras=a,b", "start_s=0.1"])
    assert Config.load(write(tmp_path, config.to_toml(comments=True))) == config


def test_the_schema_file_is_that_of_the_models_and_accepts_them() -> None:
    schema = load_schema("config-1")
    assert schema == Config.model_json_schema(), "write it again with tools/write_schemas.py"
    validator = Draft202012Validator(schema)
    assert validator.is_valid(Config().to_dict())
    assert validator.is_valid(json.loads(json.dumps(Config(cameras=("a",), start_s=1.0).to_dict())))
    for wrong in ({"seed": -1}, {"sead": 1}, {"track": {"max_gap_s": 61}}, {"measure": {"mode": "robus"}}):
        assert not validator.is_valid(wrong)


def test_a_changed_copy_is_checked() -> None:
    config = Config(seed=3).changed(track={"max_gap_s": 1.0}, cameras=["left"])
    assert (config.seed, config.track, config.cameras) == (3, TrackConfig(max_gap_s=1.0), ("left",))
    with pytest.raises(ConfigError, match=r"unknown key 'track\.max_gap'"):
        config.changed(track={"max_gap": 1.0})


COLUMN = {"type": "array", "minItems": 1, "maxItems": 5, "items": {"type": "number", "minimum": -10, "maximum": 10}}
FLAGS = {"type": "array", "items": {"type": "boolean"}}
WHOLE = {"type": "array", "items": {"type": "integer", "minimum": 0}}
ABOVE = {"type": "array", "items": {"type": "number", "exclusiveMinimum": 0}}
NAMES = {"type": "array", "items": {"type": "string"}}


@pytest.mark.parametrize(
    "expected", [COLUMN, FLAGS, WHOLE, ABOVE, NAMES], ids=["column", "flags", "whole", "above", "names"]
)
@pytest.mark.parametrize(
    "values",
    [
        [], [1.0], [1, 2.5, -10], [10.0, 10], [1.0, 10.1, 2.0], [-10.5, 0.0], [1.0, True], [False, True], [1.0, "2"], [1.0, None],
        [[1.0]], [0.0, 1.0], [0, 1], [1.0, 2.0, 3.0], [-1, 3], [1e300], [0] * 6, ["a"], "text", None, 3.0, {"0": 1.0},
    ],
    ids=str,
)  # fmt: skip
def test_a_column_is_judged_as_by_the_plain_validator(
    expected: dict[str, Any], values: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(documents, "load_schema", lambda name: {"properties": {"values": expected}})
    problem = next(Draft202012Validator({"properties": {"values": expected}}).iter_errors({"values": values}), None)
    if problem is None:
        documents.check({"values": values}, "any", ScenarioError)
    else:
        with pytest.raises(ScenarioError) as caught:
            documents.check({"values": values}, "any", ScenarioError)
        assert problem.message in str(caught.value)
        assert str(caught.value).startswith("values")


def test_a_part_of_a_log_does_not_end_before_it_begins() -> None:
    with pytest.raises(ConfigError, match="stop_s is 2, expected start_s, 3, or more"):
        Config(start_s=3.0, stop_s=2.0)
    assert Config(start_s=2.0, stop_s=2.0).stop_s == Config(stop_s=2.0).stop_s  # a single frame
