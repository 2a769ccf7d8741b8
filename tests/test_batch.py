"""Batches: which logs are found, names, settings, tables, and runs on workers that are threads of this process."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from batch_logs import FAST, damage, install_reader, lay_out_logs, tell
from command_line import names, run

from log2sim import reconstruct_all
from log2sim.batch import run as cluster
from log2sim.batch.discovery import find_logs
from log2sim.batch.evaluation import pool
from log2sim.batch.folder import BatchFolder, BatchSettings, Row, html_of, make_jobs, write_parquet
from log2sim.config import Config
from log2sim.datatypes import Scenario
from log2sim.errors import ConfigError, LogError
from log2sim.files.documents import check
from log2sim.files.inputs import following_links
from log2sim.simulation.result import Replay
from log2sim.simulation.runner import replay

EVIL = "<script>alert('{{root}}')</script>&\"'"


def touch(*files: Path) -> None:
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("")


def ids(root: Path, **options: Any) -> list[tuple[str, str]]:
    return [(log.format, log.id) for log in find_logs(root, **options)]


def row(name: str, **changes: Any) -> Row:
    return Row(**{"name": name, "log": name, "format": "log2sim", "sequence": name, "status": "done"} | changes)


@pytest.fixture
def many_formats(tmp_path: Path) -> Path:
    """Folders of several formats, by what their readers look for: names alone."""
    drives = tmp_path / "kitti" / "2011_09_26"
    touch(*(drives / f"2011_09_26_drive_000{k}_sync/oxts/data/0.txt" for k in (1, 2)))
    touch(*(tmp_path / f"tracking/training/{part}" for part in ("calib/0000.txt", "image_02/0000/000000.png")))
    touch(*(tmp_path / f"pandaset/002/{part}" for part in ("lidar/poses.json", "camera/front_camera/0.jpg")))
    for place in ("a", "group/a", "group/deeper/b"):
        touch(tmp_path / place / "log.json", tmp_path / place / "front" / "log.json")
        (tmp_path / place / "log.json").write_text('{"log_version": 1}')
    touch(tmp_path / ".hidden" / "log.json", tmp_path / "notes" / "readme.txt")
    return tmp_path


def test_logs_of_all_formats_and_depths_are_found_once(many_formats: Path) -> None:
    assert ids(many_formats) == [
        ("log2sim", "a"),
        ("log2sim", "group/a"),
        ("log2sim", "group/deeper/b"),
        ("kitti", "kitti/2011_09_26/2011_09_26_drive_0001_sync"),
        ("kitti", "kitti/2011_09_26/2011_09_26_drive_0002_sync"),
        ("pandaset", "pandaset/002"),
        ("kitti-tracking", "tracking/training/0000"),
    ]


def test_links_are_followed_only_when_asked_for_and_loops_end(many_formats: Path) -> None:
    root = many_formats / "linked"
    root.mkdir()
    (root / "other").symlink_to(many_formats / "group")
    (root / "loop").symlink_to(root)
    with pytest.raises(LogError, match="holds no log"):
        find_logs(root)
    with following_links():
        assert ids(root) == [("log2sim", "other/a"), ("log2sim", "other/deeper/b")]


def test_scenarios_are_found_once_and_those_of_a_batch_by_the_names_of_their_logs(tmp_path: Path) -> None:
    for place in ("alone/a/scenario.json", "alone/a.json", "alone/scenario.json", "made/logs/a/scenario.json"):
        touch(tmp_path / place)
        (tmp_path / place).write_text('{"scenario_version": 1}')
    touch(tmp_path / "made" / "batch.json", tmp_path / "made" / "replay.json")
    (tmp_path / "alone" / "link.json").symlink_to(tmp_path / "alone" / "a.json")
    found = {root: [log.id for log in find_logs(tmp_path / root, format="scenario")] for root in ("alone", "made")}
    assert found == {"alone": ["a.json", "scenario.json", "a"], "made": ["a"]}
    (alone,) = find_logs(tmp_path / "alone" / "a.json", format="scenario")
    assert (alone.id, alone.path) == ("a.json", tmp_path / "alone" / "a.json")
    (tmp_path / "empty").mkdir()
    with pytest.raises(LogError, match="holds no scenario"):
        find_logs(tmp_path / "empty", format="scenario")


def test_a_batch_of_other_settings_is_refused_and_overwritten(tmp_path: Path) -> None:
    def wanted(**changes: Any) -> BatchSettings:
        return BatchSettings.create(tmp_path / "root", "auto", False, Config.load(**changes))

    first = BatchFolder.start(tmp_path / "out", wanted(), overwrite=False)
    assert BatchFolder.start(tmp_path / "out", wanted(), overwrite=False).settings == first.settings
    first.write_failure(row("a", status="failed"), "text")
    with pytest.raises(ConfigError, match=r"seed: 1, before 0"):
        BatchFolder.start(tmp_path / "out", wanted(seed=1), overwrite=False)
    assert first.read_row("a") == row("a", status="failed")
    again = BatchFolder.start(tmp_path / "out", wanted(seed=1), overwrite=True)
    assert again.settings.token != first.settings.token
    assert again.read_row("a") is None


def test_the_page_escapes_names_and_errors() -> None:
    rows = [
        row("a", log=EVIL, format=EVIL, ticks=3),
        row("b", log=EVIL, status="failed", error=EVIL, error_kind=EVIL, format=EVIL),
    ]
    made = BatchSettings.create(Path("/tmp") / EVIL.replace("/", ""), "auto", False, Config())
    page = html_of(rows, made, 2)
    assert page.count("<script>") == 1  # its own
    assert "alert(" not in page.replace("&lt;script&gt;alert(", "")
    assert "{{root}}" in page  # of the name: what is inserted is not searched again


def test_the_parquet_file_holds_the_rows(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    rows = [row("a", ticks=3, seconds=0.5), row("b", status="failed", error="no\nsuch file")]
    write_parquet(tmp_path / "t.parquet", rows)
    assert parquet.read_table(tmp_path / "t.parquet").to_pylist() == [r.model_dump() for r in rows]


def test_figures_are_pooled_over_the_ticks_of_all_logs() -> None:
    rng = np.random.default_rng(0)
    errors = [rng.normal(size=n) for n in (5, 40)]
    entries = [
        {
            "recall": len(e) / 50, "precision": len(e) / (len(e) + 2), "position_median_m": 0.1 * len(e), "yaw_median_deg": None,
            "size_median_m": None, "hota": 0.5, "id_switches": 1, "judged_ticks": 10, "wrong_ticks": k,
            "position_rmse_m": float(np.sqrt(np.mean(e**2))), "speed_rmse_mps": None,
            "counts": {"truth_ticks": 50, "matched_ticks": len(e), "false_ticks": 2},
        }
        for k, e in enumerate(errors)
    ]  # fmt: skip
    total = pool(entries)
    assert total["recall"] == pytest.approx(45 / 100)
    assert total["precision"] == pytest.approx(45 / 49, abs=1e-4)
    assert total["position_rmse_m"] == pytest.approx(np.sqrt(np.mean(np.concatenate(errors) ** 2)), abs=1e-4)
    assert total["mota"] == pytest.approx(1 - (55 + 4 + 2) / 100)
    assert total["wrong_share"] == pytest.approx(1 / 20)
    assert total["speed_rmse_mps"] is None
    assert total["median_of_logs"]["position_median_m"] == pytest.approx(2.25)
    assert pool([])["recall"] is None


@pytest.fixture
def thread_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers that are threads of this process: no start of processes, all else as with them."""
    distributed = pytest.importorskip("distributed")
    dask = pytest.importorskip("dask")

    @contextmanager
    def start(count: int) -> Iterator[cluster.Workers]:
        options = {"n_workers": 1, "threads_per_worker": 1, "processes": False}
        options |= {"dashboard_address": f"{cluster.HOST}:0", "worker_dashboard_address": f"{cluster.HOST}:0"}
        with (
            dask.config.set(cluster.SETTINGS),
            distributed.LocalCluster(**options) as local,
            distributed.Client(local) as client,
        ):
            yield cluster.Workers(client, are_ours=False)

    monkeypatch.setattr(cluster, "local_workers", start)


@pytest.mark.usefixtures("thread_workers")
@pytest.mark.slow
def test_a_batch_runs_repeats_resumes_and_is_evaluated(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, out = lay_out_logs(tmp_path / "root", tiny_folder, "good", "group/bad"), tmp_path / "out"
    damage(root / "group" / "bad")
    install_reader(tmp_path / "site")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    tell(root / "plugged", "fail-once", tiny_folder)
    arguments = ("batch", root, "--out", out, "--replay", *FAST)

    ran = run(*arguments)
    assert ran.code == 7, ran.err
    assert "failed: group/bad: " in ran.out
    assert names(out) == ["batch.json", "logs", "table.html", "table.parquet"]
    folder = BatchFolder.load(out)
    rows = {job.log: folder.read_row(job.name) for job in make_jobs(find_logs(root), out, "")}
    assert {log: (r.status, r.attempts, r.format) for log, r in rows.items() if r is not None} == {
        "good": ("done", 1, "log2sim"),
        "group/bad": ("failed", 1, "log2sim"),
        "plugged": ("done", 2, "told"),
    }
    good = rows["good"]
    assert good is not None
    assert good.agents == 3
    assert names(out / "logs" / "good") == ["replay.json", "report.json", "row.json", "scenario.json"]
    replayed = replay(Scenario.load(out / "logs" / "good" / "scenario.json"))
    assert replayed.to_dict() == Replay.load(out / "logs" / "good" / "replay.json").to_dict()
    assert good.cross_track_max_m == replayed.metrics["cross_track_max_m"] > 0
    (bad,) = (out / "logs").glob("group_bad-*")
    assert names(bad) == ["error.txt", "row.json"]

    ran = run("batch", out, "--out", tmp_path / "replays", "--format", "scenario")
    assert ran.code == 0, ran.err
    assert "2 scenarios below" in ran.out
    assert ran.out.rstrip().endswith("scenarios an hour")
    assert names(tmp_path / "replays" / "logs" / "good") == ["replay.json", "row.json"]
    files = [folder / "logs" / "good" / "replay.json" for folder in (out, tmp_path / "replays")]
    assert files[0].read_bytes() == files[1].read_bytes()
    again = BatchFolder.load(tmp_path / "replays").read_row("good")
    same = ("agents", "static", "doubtful", "duration_s", "cross_track_max_m", "new_collisions")
    assert again is not None
    assert [getattr(again, name) for name in same] == [getattr(good, name) for name in same]

    before = (out / "logs" / "good" / "row.json").stat().st_mtime_ns
    (root / "group" / "bad" / "log.json").write_bytes((tiny_folder / "log.json").read_bytes())
    ran = run(*arguments)
    assert ran.code == 0, ran.err
    assert "2 of them done before" in ran.out
    assert names(bad) == ["replay.json", "report.json", "row.json", "scenario.json"]
    assert (out / "logs" / "good" / "row.json").stat().st_mtime_ns == before

    steps: list[tuple[int, int]] = []
    config = Config.load(settings=FAST[3::2], detect={"name": FAST[1]})
    again = reconstruct_all(root, out, config, replay=True, progress=lambda done, total: steps.append((done, total)))
    assert [row.status for row in again] == ["done"] * 3
    assert steps == []  # nothing was left to do

    ran = run("evaluate", out, "--truth", root, "--out", tmp_path / "metrics.json")
    assert ran.code == 0, ran.err
    document = json.loads((tmp_path / "metrics.json").read_text())
    check(document, "batch-metrics-1", LogError)
    assert [entry["log"] for entry in document["logs"] if "error" not in entry] == ["good", "group/bad", "plugged"]
    ticks = [entry["counts"]["truth_ticks"] for entry in document["logs"]]
    assert ticks[0] == ticks[1] > 0
    assert document["total"]["counts"]["truth_ticks"] == sum(ticks)
    for key in ("labeled", "counted", "hit", "hit_matched"):
        assert document["total"]["coverage"][key] == sum(
            e["coverage"][key] for e in document["logs"] if "error" not in e
        )
    assert max(map(len, run("evaluate", out, "--truth", root, "-v").out.splitlines())) <= 100
