"""Settings: defaults, then a file, then --set, then options; what is unknown or out of range is named."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest

from log2sim import config as config_module
from log2sim.config import Config, TrackConfig
from log2sim.errors import ConfigError


def write(folder: Path, text: str) -> Path:
    path = folder / "run.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_without_anything_the_defaults_hold() -> None:
    assert Config.load() == Config()
    assert Config.load(None, [], seed=None, cameras=None) == Config()


def test_a_file_changes_what_it_names_and_nothing_else(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        'seed = 7\ncameras = ["left", "right"]\nstart_s = 2\n[track]\nmax_gap_s = 1.5\n[measure]\nmode = "paper"\n',
    )
    config = Config.load(path)
    assert (config.seed, config.cameras, config.start_s) == (7, ("left", "right"), 2.0)
    assert config.track == TrackConfig(max_gap_s=1.5)
    assert config.measure.mode == "paper"
    assert (config.sync, config.detect, config.topdown, config.smooth) == (
        Config().sync,
        Config().detect,
        Config().topdown,
        Config().smooth,
    )


def test_the_later_word_counts(tmp_path: Path) -> None:
    path = write(tmp_path, "seed = 1\n[track]\nmax_gap_s = 1.0\nbirth_score = 0.1\nmin_life_s = 0.2\n")
    settings = ["track.max_gap_s=2.0", "seed=2", "track.birth_score=0.2", "track.birth_score=0.3"]
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
        (
            "track.max_gap=1",
            r"unknown setting 'track\.max_gap' \(did you mean 'max_gap_s'\?\); known: birth_score, max_gap_s",
        ),
        ("trak.max_gap_s=1", r"unknown setting 'trak' \(did you mean 'track'\?\)"),
        ("zzz=1", r"unknown setting 'zzz'; known: seed, "),
        ("track=1", r"'track' is a section; set one of its keys, e\.g\. track\.birth_score"),
        ("seed.x=1", r"'seed' is \{'x': 1\}, expected a whole number"),
        ("seed", r"--set seed: expected section\.key=value"),
        ("seed=1.5", r"'seed' is 1\.5, expected a whole number"),
        ("seed=true", r"'seed' is True, expected a whole number"),
        ("seed=-1", r"'seed' is -1, expected a number from 0 to"),
        ("detect.tiles=65", r"'detect\.tiles' is 65, expected a number from 0 to 64"),
        ("track.birth_score=1.1", r"'track\.birth_score' is 1\.1, expected a number from 0 to 1"),
        ("track.birth_score=high", r"'track\.birth_score' is 'high', expected a number"),
        ("track.birth_score=nan", r"'track\.birth_score' is nan, expected a finite number"),
        ("smooth.enabled=1", r"'smooth\.enabled' is 1, expected true or false"),
        ("smooth.enabled=yes", r"'smooth\.enabled' is 'yes', expected true or false"),
        ("measure.mode=robus", r"'measure\.mode' is 'robus', expected robust or paper"),
        ("detect.name=3", r"'detect\.name' is 3, expected a text"),
        ("cameras=3", r"'cameras' is 3, expected names separated by commas"),
        ("cameras=[1]", r"'cameras' is \[1\], expected names"),
        ("start_s=inf", r"'start_s' is inf, expected a finite number"),
        ("start_s=nan", r"'start_s' is nan, expected a finite number"),
    ],
)
def test_what_cannot_be_is_one_clear_line(setting: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        Config.load(settings=[setting])
    assert str(caught.value).startswith(f"--set {setting.split('=')[0]}")
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 2


def test_a_mistake_in_a_file_names_the_file(tmp_path: Path) -> None:
    path = write(tmp_path, "[smooth]\nenable = true\n")
    with pytest.raises(ConfigError, match=r"run\.toml: unknown setting 'smooth\.enable' \(did you mean 'enabled'\?\)"):
        Config.load(path)


def test_a_mistake_in_an_option_says_so() -> None:
    with pytest.raises(ConfigError, match=r"^options: 'seed' is -3"):
        Config.load(seed=-3)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"seed = \n", "not valid TOML"),
        (b"seed = 1\nseed = 2\n", "not valid TOML"),
        (b"\xff\xfe", "not valid TOML"),
        (b"a = " + b"[" * 5000, "not valid TOML"),
    ],
    ids=["cut", "twice", "encoding", "deep"],
)
def test_files_that_are_no_toml(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "run.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=rf"run\.toml: {message}"):
        Config.load(path)


def test_a_value_nested_without_end_is_a_text() -> None:
    with pytest.raises(ConfigError, match="expected a number"):
        Config.load(settings=["track.birth_score=" + "[" * 5000])


def test_a_missing_file_and_a_folder(tmp_path: Path) -> None:
    for path in (tmp_path / "none.toml", tmp_path):
        with pytest.raises(ConfigError, match="no such config file"):
            Config.load(path)


def test_a_file_larger_than_any_config_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path, "seed = 1\n")
    monkeypatch.setattr(config_module, "CONFIG_LIMIT_BYTES", 9)
    assert Config.load(path).seed == 1
    monkeypatch.setattr(config_module, "CONFIG_LIMIT_BYTES", 8)
    monkeypatch.setattr(Path, "read_text", lambda *_, **__: pytest.fail("read before its size was looked at"))
    with pytest.raises(ConfigError, match="larger than 8 bytes"):
        Config.load(path)


def test_what_is_printed_loads_back(tmp_path: Path) -> None:
    settings = [
        "seed=5",
        "cameras=a,b",
        "detect.name='say \"a\\b\"'",
        "smooth.enabled=false",
        "start_s=0.1",
        "sync.max_residual_s=1e-6",
    ]
    config = Config.load(settings=settings)
    assert config != Config()
    assert Config.load(write(tmp_path, config.to_toml())) == config
    assert Config.load(write(tmp_path, Config().to_toml())) == Config()


def test_the_document_of_a_config_is_nested_and_whole() -> None:
    document = Config().to_dict()
    assert document["track"]["max_gap_s"] == TrackConfig().max_gap_s
    assert set(document) == {f.name for f in fields(Config)}
    assert Config.load(**document) == Config()


def test_nothing_is_changed_in_place() -> None:
    config = Config()
    with pytest.raises(AttributeError):
        config.seed = 3  # type: ignore[misc]
    Config.load(settings=["track.max_gap_s=9"])
    assert Config().track.max_gap_s == TrackConfig().max_gap_s
