"""Files written whole or not at all, limits."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from log2sim.errors import ConfigError, LogError, ScenarioError
from log2sim.files import documents
from log2sim.files.documents import read_json, refuse_existing, replaced, write_json


def test_a_file_appears_whole(tmp_path: Path) -> None:
    target = tmp_path / "new" / "folder" / "result.json"
    with replaced(target) as temporary:
        assert temporary.parent == target.parent
        assert temporary.suffix == ".json"
        temporary.write_text("half")
        assert not target.exists()
        temporary.write_text("whole")
    assert target.read_text() == "whole"
    assert os.listdir(target.parent) == ["result.json"]


def test_two_writers_do_not_meet(tmp_path: Path) -> None:
    target = tmp_path / "result.json"
    with replaced(target) as first, replaced(target) as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert target.read_text() == "first"  # the outer block ends last
    assert os.listdir(tmp_path) == ["result.json"]


def test_an_existing_file_is_kept_unless_told_otherwise(tmp_path: Path) -> None:
    (tmp_path / "result.json").write_text("x")
    with pytest.raises(ConfigError, match=r"result\.json: exists already.*--overwrite"):
        refuse_existing(tmp_path / "result.json", overwrite=False)
    refuse_existing(tmp_path / "result.json", overwrite=True)
    refuse_existing(tmp_path / "new.json", overwrite=False)


TEXTS = st.text(st.characters(exclude_categories=["Cs"]))
DOCUMENTS = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63) | st.floats(allow_nan=False, allow_infinity=False) | TEXTS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXTS, inner, max_size=4),
    max_leaves=20,
)


@given(value=DOCUMENTS)
@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_document_is_read_as_it_was_written(tmp_path: Path, value: object) -> None:
    write_json(tmp_path / "a.json", value)
    read = read_json(tmp_path / "a.json")
    assert read == value
    assert repr(read) == repr(value)  # not 1 for 1.0 or True, not 0.0 for -0.0
    assert os.listdir(tmp_path) == ["a.json"]


def test_too_large_a_file_is_not_even_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps([0] * 100))
    monkeypatch.setattr(documents, "JSON_LIMIT_BYTES", path.stat().st_size)
    assert len(read_json(path)) == 100
    monkeypatch.setattr(documents, "JSON_LIMIT_BYTES", path.stat().st_size - 1)
    monkeypatch.setattr(Path, "read_text", lambda *_, **__: pytest.fail("read before its size was looked at"))
    with pytest.raises(ScenarioError, match=r"a\.json: 300 bytes, more than the 299"):
        read_json(path, ScenarioError)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'{"a": 1,\n "b" 2}', r"not valid JSON at line 2, column 6"),
        (b"\xff\xfe{}", r"not valid JSON: .*utf-8"),
        (b'{"a": {"b": [1, 2, {"c": 1e400}]}}', r"a\.b\[2\]\.c is 1e400, expected a finite number"),
        (b"[[0, -Infinity]]", r"\[0\]\[1\] is -Infinity"),
        (b"NaN", r"the document is NaN"),
        (b"[NaN", r"a number is NaN"),
        (b"[NaN, " + b"[" * 100_000, r"a number is NaN"),
        (b"[" * 100_000, r"not valid JSON"),
        (b"1" * 5000, r"a number is 1+, expected a finite number"),
        (b'{"a": [' + b"1" * 400 + b"]}", r"a\[0\] is 1+, expected a finite number"),
    ],
    ids=[
        "syntax",
        "encoding",
        "overflow",
        "infinity",
        "nan",
        "nan and cut",
        "nan and deep",
        "deep",
        "many digits",
        "no float64",
    ],
)
def test_what_is_wrong_with_a_json_file_is_named(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(LogError, match=message) as caught:
        read_json(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert len(str(caught.value)) < 400 + len(str(path))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": 1, "b": {"a": 2}, "a": 3}', "a key occurs twice in one object, first 'a'"),
        ('[{"x": [1], "x": [1]}, {"y": 1, "y": 2, "y": 3}]', "3 keys occur twice in one object, first 'x'"),
        ('{"\\u0061": 1, "a": 2}', "first 'a'"),
    ],
)
def test_keys_that_stand_twice_are_told_with_their_number(tmp_path: Path, text: str, message: str) -> None:
    """Which of the two is meant, no program can tell."""
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(ScenarioError, match=message):
        read_json(path, ScenarioError)
