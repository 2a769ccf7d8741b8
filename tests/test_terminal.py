"""The terminal: one style of options, counts that agree, summaries for people, doctor, completion."""

from __future__ import annotations

import io
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command_line import run
from replay_maneuvers import scenario_of
from replay_scenes import LENGTH_M, line, parked
from test_layers import ROOT

from log2sim.cli import doctor
from log2sim.cli import doctor as installation
from log2sim.cli.progress import Bars
from log2sim.simulation.metrics.all_metrics import summarize
from log2sim.simulation.policy import Controls
from log2sim.simulation.runner import replay
from log2sim.visualization.progress import REDRAWN_EVERY_S, WORDS, show_progress


def test_the_readme_and_the_help_name_the_same_exit_codes() -> None:
    said = run("--help").out
    in_help = set(re.findall(r"^ +(\d+)  \w", said[said.index("Exit codes:") :], flags=re.MULTILINE))
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    sentence = readme[readme.index("Exit codes: ") :].split("\n\n")[0]
    assert set(re.findall(r"\b(\d+) [a-z]", sentence)) == in_help == {"0", "1", "2", "3", "4", "5", "6", "7", "130"}


def test_names_in_a_log_do_not_steer_the_terminal(tmp_path: Path) -> None:
    ran = run("inspect", tmp_path / "a\x1b[2Jb\u202ec\x07")
    assert ran.code == 3
    assert "a\\x1b[2Jb\\u202ec\\x07" in ran.err
    assert not set("\x1b\u202e\x07") & set(ran.out + ran.err)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("log2sim rec", ["reconstruct"]),
        ("log2sim replay s.json --mode p", ["pid"]),
        ("log2sim reconstruct LOG --detector lidar:v", ["lidar:vehicle"]),
        ("log2sim export s.json --to opens", ["openscenario"]),
    ],
)
def test_bash_completes(words: str, expected: list[str]) -> None:
    count = len(words.split()) - 1
    asked = {"_LOG2SIM_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(count)}
    command = [sys.executable, "-c", "from log2sim.cli import main; main()"]
    ran = subprocess.run(command, env=os.environ | asked, capture_output=True, text=True, check=False)
    assert ran.stdout.split() == expected, ran.stderr


def braked_at(wall_m: float, decel: float = 3.0, speed: float = 10.0):
    """An ego at constant speed in the scenario, which a policy brakes, with a parked car ahead."""
    scenario = scenario_of(line("ego", 0.0, speed=speed, duration_s=8.0), parked("wall", wall_m, 0.0))
    return replay(scenario, ego=lambda seen: Controls(-decel, 0.0), dt_s=0.02)


def test_the_figures_of_a_braking_ego_are_those_of_the_closed_form() -> None:
    result = braked_at(40.0)
    ego, figures = result.agent("ego"), result.metrics["ego"]
    assert (ego.driver, result.metrics["followers"]) == ("policy", 0)
    assert figures["path_m"] == pytest.approx(80.0, abs=0.01)
    assert figures["progress_m"] == pytest.approx(float(ego.x_m[-1] - ego.x_m[0]), abs=0.01)
    assert figures["progress_m"] == pytest.approx(10.0**2 / (2 * 3.0), rel=0.15)  # and the delay of the brakes
    assert figures["driven_m"] == pytest.approx(figures["progress_m"], abs=0.02)
    wall = result.agent("wall")
    assert figures["min_gap"]["m"] == pytest.approx(float(wall.x_m[0] - ego.x_m.max()) - LENGTH_M, abs=2e-3)
    assert figures["min_gap"]["agent"] == "wall"
    assert figures["max_brake"]["mps2"] == pytest.approx(3.0, rel=0.05)
    said = summarize(result)
    assert f"progress {figures['progress_m']:.1f} of 80.0 m" in said
    assert f"smallest gap {figures['min_gap']['m']:.2f} m to wall" in said
    assert "collisions none" in said


def test_a_replay_in_which_the_ego_hardly_brakes_is_written(tmp_path: Path) -> None:
    braked_at(40.0, decel=3e-4).save(tmp_path / "replay.json")
    assert json.loads((tmp_path / "replay.json").read_text())["metrics"]["ego"]["max_brake"] is None


def test_doctor_lists_extras_that_are_missing_with_the_line_that_adds_them(monkeypatch: pytest.MonkeyPatch) -> None:
    known = installation.version_of
    monkeypatch.setattr(installation, "version_of", lambda name: None if name == "small-gicp" else known(name))
    ran = run("doctor")
    assert ran.code == 0
    assert re.search(r"^ +odometry +missing ", ran.out, flags=re.MULTILINE)
    assert re.search(r"^ +pip install .*\[odometry\]", ran.out, flags=re.MULTILINE)
    document = json.loads(run("doctor", "--json").out)
    missing = {extra["name"]: extra["missing"] for extra in document["extras"]}
    assert missing["odometry"] == ["small-gicp"]
    assert document["broken"] == []


@pytest.mark.parametrize("broken", ["missing", "outdated", "unimportable"])
def test_doctor_exits_with_5_when_something_needed_is_broken(broken: str, monkeypatch: pytest.MonkeyPatch) -> None:
    known = installation.version_of
    if broken != "outdated":
        monkeypatch.setitem(sys.modules, "simplejpeg", None)
    if broken != "unimportable":
        version = None if broken == "missing" else "0.1"
        monkeypatch.setattr(installation, "version_of", lambda name: version if name == "simplejpeg" else known(name))
    ran = run("doctor")
    assert ran.code == doctor.BROKEN_CODE == 5
    assert "log2sim: simplejpeg: " in ran.err
    word = {
        "missing": "is missing: pip install 'simplejpeg>=",
        "outdated": "is too old",
        "unimportable": "cannot be imported",
    }
    assert word[broken] in ran.err


def test_a_stage_of_unknown_length_ends_with_the_next_one() -> None:
    from rich.console import Console
    from rich.progress import Progress

    display = Progress(console=Console(file=io.StringIO()))
    bars = Bars(display)
    bars("load", 0, 0)
    assert [task.description for task in display.tasks] == [WORDS["load"]]
    bars("detect and measure", 1, 2)
    bars("track", 0, 0)
    assert [task.description for task in display.tasks] == [WORDS["detect and measure"], WORDS["track"]]


def test_progress_of_functions_is_one_line_a_stage_that_is_written_anew(capsys: pytest.CaptureFixture[str]) -> None:
    show_progress("track", 0, 0)
    time.sleep(REDRAWN_EVERY_S)
    for done in range(1, 1001):
        show_progress("draw", done, 1000)
    show_progress(3, 3)  # of functions with a single stage
    lines = capsys.readouterr().out.split("\n")
    assert [line.rpartition("\r")[2].rstrip() for line in lines] == [
        "tracking",
        "drawing: 1000 of 1000",
        "done: 3 of 3",
        "",
    ]
    assert 1 < lines[1].count("\r") < 1000
    assert len({len(line) for line in "\r".join(lines[:3]).split("\r")[1:]} - {0}) == 1
