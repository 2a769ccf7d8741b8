"""Errors say what to do about them."""

from __future__ import annotations

import json
from importlib import metadata
from pathlib import Path

import pytest

from log2sim import errors
from log2sim.errors import MissingExtra, install_command

ROOT = Path(__file__).resolve().parents[1]


class Installed:
    """An installed distribution of which pip noted this origin."""

    def __init__(self, origin: dict[str, object] | None) -> None:
        self.origin = origin

    def read_text(self, name: str) -> str | None:
        return json.dumps(self.origin) if name == "direct_url.json" and self.origin is not None else None


def installed_from(origin: dict[str, object] | None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(errors, "__file__", str(tmp_path / "site-packages/log2sim/errors.py"))
    monkeypatch.setattr(metadata, "distribution", lambda name: Installed(origin))


def test_in_a_checkout_the_advice_names_the_checkout() -> None:
    assert install_command("osi") == f"pip install --editable '{ROOT}[osi]'"
    assert str(MissingExtra("export to OSI", "osi")).endswith(f": {install_command('osi')}")


@pytest.mark.parametrize(
    ("origin", "command"),
    [
        (None, "pip install 'log2sim[osi]'"),
        ({"url": "file:///a%20b/log2sim", "dir_info": {}}, "pip install '/a b/log2sim[osi]'"),
        (
            {"url": "https://x.org/log2sim.git", "vcs_info": {"vcs": "git", "commit_id": "1"}},
            "pip install 'log2sim[osi] @ git+https://x.org/log2sim.git'",
        ),
        (
            {"url": "file:///w/log2sim-1.whl", "archive_info": {}},
            "pip install 'log2sim[osi] @ file:///w/log2sim-1.whl'",
        ),
    ],
)
def test_elsewhere_the_advice_names_the_origin_of_the_installation(
    origin: dict[str, object] | None, command: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    installed_from(origin, monkeypatch, tmp_path)
    assert install_command("osi") == command
