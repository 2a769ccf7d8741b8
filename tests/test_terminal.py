"""The terminal: one style of options, counts that agree, summaries for people, doctor, completion."""

from __future__ import annotations

import io
import json
import os
import re
import shlex
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
import typer
from command_line import run
from export_worlds import straight, world
from replay_maneuvers import scenario_of
from replay_scenes import LENGTH_M, line, parked
from test_layers import ROOT

from log2sim.cli import doctor, entry
from log2sim.cli import doctor as installation
from log2sim.cli.progress import Bars, progress
from log2sim.cli.reconstruct import look_line, missing_lines
from log2sim.cli.shared import format_rows
from log2sim.datatypes import MapFeatures, Scenario, say_agents, say_categories
from log2sim.simulation.metrics.all_metrics import hardest_brake, summarize
from log2sim.simulation.policy import Controls
from log2sim.simulation.runner import replay
from log2sim.visualization.progress import REDRAWN_EVERY_S, WORDS, show_progress

GROUP = typer.main.get_command(entry.app)


def test_every_command_has_the_same_words_for_the_same_thing() -> None:
    for name, command in GROUP.commands.items():
        options = {flag: parameter for parameter in command.params for flag in parameter.opts}
        assert {"--debug", "--follow-links"} <= options.keys(), name
        for long, short in (("--out", "-o"), ("--quiet", "-q"), ("--verbose", "-v")):
            assert (long in options) == (short in options), f"{name} {long}"
        if "--out" in options:
            assert "--quiet" in options, name


@pytest.mark.parametrize("name", GROUP.commands)
def test_the_examples_in_the_help_parse(name: str) -> None:
    epilog = GROUP.commands[name].epilog or ""
    lines = re.findall(r"^ +(log2sim .*)$", epilog, flags=re.MULTILINE)
    assert lines, f"log2sim {name} --help shows no example"
    for example in lines:
        _, command, *arguments = shlex.split(example)
        GROUP.commands[command].make_context(command, arguments)


def test_the_readme_and_the_help_name_the_same_exit_codes() -> None:
    said = run("--help").out
    in_help = set(re.findall(r"^ +(\d+)  \w", said[said.index("Exit codes:") :], flags=re.MULTILINE))
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    sentence = readme[readme.index("Exit codes: ") :].split("\n\n")[0]
    assert set(re.findall(r"\b(\d+) [a-z]", sentence)) == in_help == {"0", "1", "2", "3", "4", "5", "6", "7", "130"}


def test_help_of_a_command_checks_no_option_with_pydantic() -> None:
    code = (
        "import sys; sys.argv = ['log2sim', 'replay', '-h']\nfrom log2sim import cli\ntry: cli.main()\n"
        "except SystemExit: pass\nsys.stderr.write(','.join(m for m in ('pydantic', 'rich') if m in sys.modules))"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stderr == ""
    assert "Examples:" in ran.stdout


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("log2sim rec", ["reconstruct"]),
        ("log2sim replay s.json --mode p", ["pid"]),
        ("log2sim reconstruct LOG --detector lidar:v", ["lidar:vehicle"]),
        ("log2sim export s.json --to open", ["openscenario"]),
    ],
)
def test_bash_completes(words: str, expected: list[str]) -> None:
    count = len(words.split()) - 1
    asked = {"_LOG2SIM_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(count)}
    command = [sys.executable, "-c", "from log2sim.cli import main; main()"]
    ran = subprocess.run(command, env=os.environ | asked, capture_output=True, text=True, check=False)
    assert ran.stdout.split() == expected, ran.stderr


def test_all_commands_count_the_same_agents(tmp_path: Path) -> None:
    path, words = tmp_path / "s.json", "2 agents and the ego"
    scenario_of(line("ego", 0.0, duration_s=1.0), line("a", 30.0, duration_s=1.0), parked("b", 90.0, 9.0)).save(path)
    assert json.loads(run("inspect", path, "--json").out)["agents"]["count"] == 2
    assert words in run("inspect", path).out
    assert words in run("edit", path, "--lateral", "a=0.1", "-o", tmp_path / "e.json").out
    assert words in run("view", path, "-o", tmp_path / "v.html").out


@pytest.mark.parametrize(
    ("ids", "words"),
    [
        ([], "0 agents"),
        (["ego"], "no agent but the ego"),
        (["a"], "1 agent"),
        (["a", "ego"], "1 agent and the ego"),
        (["a", "ego", "b"], "2 agents and the ego"),
    ],
)
def test_the_ego_is_told_apart_from_the_agents(ids: list[str], words: str) -> None:
    assert say_agents(ids) == words


def test_categories_are_counted_with_those_that_stand() -> None:
    agents = [straight("a"), parked("b", 0, 0), straight("c")]
    assert say_categories(agents) == "3 cars (1 static)"
    assert say_categories([]) == ""


def braked_at(wall_m: float, decel: float = 3.0, speed: float = 10.0):
    """An ego at constant speed in the scenario, which a policy brakes, with a parked car ahead."""
    scenario = scenario_of(line("ego", 0.0, speed=speed, duration_s=8.0), parked("wall", wall_m, 0.0))
    return replay(scenario, ego=lambda seen: Controls(-decel, 0.0))


def test_the_figures_of_a_braking_ego_are_those_of_the_closed_form() -> None:
    result = braked_at(40.0)
    ego, figures = result.agent("ego"), result.metrics["ego"]
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


@pytest.mark.slow
def test_an_ego_that_hits_something_has_no_gap_and_says_whom() -> None:
    result = braked_at(15.0)
    assert result.metrics["ego"]["min_gap"]["m"] == 0.0
    (event,) = result.metrics["collisions"]
    assert f"collisions with wall at {event['t_s']:.2f} s ({event['relative_speed_mps']:.1f} m/s)" in summarize(result)


def test_a_turned_box_is_as_near_as_its_corner() -> None:
    scenario = scenario_of(line("ego", 0.0, speed=10.0, duration_s=1.0), parked("wall", 40.0, 0.0, np.pi / 4))
    result = replay(scenario, ego=lambda seen: Controls(0.0, 0.0))
    ego, wall = result.agent("ego"), result.agent("wall")
    # The wall's corner nearest to the front of the ego, which is as wide as it: half its diagonal at 45 degrees less its turn.
    length, width, _ = wall.size_m
    corner_x = -(length + width) / 2 / np.sqrt(2)
    corner_y = (length - width) / 2 / np.sqrt(2)
    beside = max(abs(corner_y) - ego.size_m[1] / 2, 0.0)
    expected = np.hypot(wall.x_m[0] + corner_x - ego.x_m[-1] - LENGTH_M / 2, beside)
    assert result.metrics["ego"]["min_gap"]["m"] == pytest.approx(expected, abs=0.01)


def test_who_never_brakes_has_no_hardest_brake() -> None:
    result = replay(scenario_of(line("ego", 0.0, speed=5.0, duration_s=2.0)), ego=lambda seen: Controls(1.0, 0.0))
    assert hardest_brake(result.agent("ego")) is None
    assert result.metrics["ego"]["min_gap"] is None
    assert "ego" not in replay(scenario_of(line("ego", 0.0, duration_s=1.0))).metrics


def test_the_line_that_shows_a_scenario_parses() -> None:
    text = look_line(Path("a log/x"), "0002", Path("out/s.json"))
    _, command, *arguments = shlex.split(text)
    given = GROUP.commands[command].make_context(command, arguments).params
    assert (given["scenario"], given["out"]) == (Path("out/s.json"), Path("out/s.html"))
    assert (given["log"], given["sequence"]) == (Path("a log/x"), "0002")


def test_what_was_missing_is_said_once_for_each_reason() -> None:
    reason = "no camera is used"
    plan = tuple(
        {"stage": stage, "kept": False, "reason": reason} for stage in ("colors of vehicles", "traffic lights")
    )
    spared = {"stage": "smoothing of static agents", "kept": False, "reason": "1 of 2"}
    scenario = scenario_of(straight("a"))
    told = Scenario(
        "s", 0, 1.0, scenario.agents, stages=(*plan, spared), map_features=MapFeatures(notes=("no intensity",))
    )
    assert missing_lines(told) == ["colors of vehicles, traffic lights: no camera is used", "no intensity"]
    assert missing_lines(world(straight("a"))) == []


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


def test_the_requirements_are_the_same_in_the_checkout_and_in_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    here = installation.read_requirements()
    named = {(r.name, installation.extra_of(r)) for r in here}
    assert ("numpy", None) in named
    assert ("small-gicp", "odometry") in named
    monkeypatch.setattr(installation, "__file__", "/nowhere/log2sim/cli/installation.py")
    monkeypatch.setattr(metadata, "requires", lambda name: [str(r) for r in here])
    again = installation.read_requirements()
    assert {(r.name, installation.extra_of(r)) for r in again} == named


def test_a_pipe_gets_a_line_for_each_stage(capsys: pytest.CaptureFixture[str]) -> None:
    with progress(quiet=False) as report:
        for call in (
            ("open", 0, 0),
            ("load", 0, 0),
            ("detect and measure", 0, 2),
            ("detect and measure", 2, 2),
            ("track", 0, 0),
        ):
            report(*call)
    assert capsys.readouterr().err == "loading the detectors\ndetecting and measuring: 2 of 2\ntracking\n"


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


def test_rows_are_broken_at_the_width_of_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [("name", "one two three four five six seven eight nine ten eleven")]
    assert len(format_rows(rows)) == 1
    monkeypatch.setattr("log2sim.cli.shared.terminal_width", lambda: 40)
    broken = format_rows(rows)
    assert max(map(len, broken)) <= 40
    assert broken[1].startswith("      ")
    assert " ".join(" ".join(broken).split()) == "name one two three four five six seven eight nine ten eleven"


def test_a_stage_that_ends_early_is_shown_as_done_and_may_come_again() -> None:
    from rich.console import Console
    from rich.progress import Progress

    display = Progress(console=Console(file=io.StringIO()))
    bars = Bars(display)
    for call in (("check lidar", 19, 20), ("track", 1, 2)):
        bars(*call)
    assert [(task.completed, task.total) for task in display.tasks] == [(20, 20), (1, 2)]
    bars("check lidar", 1, 20)
    assert [(task.completed, task.total) for task in display.tasks] == [(1, 20), (2, 2)]


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
