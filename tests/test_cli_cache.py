"""The cache on the terminal: what is known is said, `--no-cache` leaves it alone, `log2sim cache` shows, limits and clears it."""

from __future__ import annotations

import json
from pathlib import Path

from command_line import run
from test_detection_cache import TICKS, Seeing, entries, folder, made

__all__ = ["folder", "made"]  # fixtures

QUICK = ["map.lanes=false", "appearance.colors=false", "calibration.check=false", "stop_s=0.55"]


def reconstruct(log: Path, out: Path, *options: str) -> tuple[str, dict[str, int | None]]:
    """What a run prints, and what its report says of the cache."""
    changes = [part for change in QUICK for part in ("--set", change)]
    report = out.with_suffix(".report.json")
    ran = run("reconstruct", log, "--out", out, "--report", report, "--detector", "seeing", *changes, *options)
    assert ran.code == 0, ran.err
    return ran.out, json.loads(report.read_text())["detection_cache"]


def test_a_second_run_says_what_it_knows_and_the_command_shows_it(
    tiny_folder: Path, folder: Path, made: list[Seeing], tmp_path: Path
) -> None:
    assert run("cache").code == 0  # nothing is there yet
    out, cached = reconstruct(tiny_folder, tmp_path / "a.json", "--no-cache")
    assert cached is None
    assert not folder.exists()
    out, cached = reconstruct(tiny_folder, tmp_path / "b.json")
    assert "earlier runs" not in out
    assert cached == {"found": 0, "kept": TICKS, "problem": None}
    out, cached = reconstruct(tiny_folder, tmp_path / "c.json")
    assert f"{TICKS} pictures known from earlier runs" in out
    assert (tmp_path / "c.json").read_bytes() == (tmp_path / "a.json").read_bytes()
    shown = json.loads(run("cache", "--json").out)
    size = sum(path.stat().st_size for path in entries(folder))
    assert shown == {
        "folder": str(folder),
        "max_mb": 2048,
        "bytes": size,
        "pictures": TICKS,
        "detectors": [{"name": "seeing", "pictures": TICKS, "bytes": size}],
        "last_run": {"found": TICKS, "kept": 0},
    }
    assert f"{TICKS} by seeing" in run("cache").out
    assert run("cache", "--clear").out == f"{folder}: {TICKS} pictures removed\n"
    assert entries(folder) == []
