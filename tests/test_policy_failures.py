"""Probabilities of failure against closed forms, and policies that fail, do not, and raise."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from statistics import NormalDist

import numpy as np
import pytest
from benchmarks.tag_worlds import traffic
from command_line import run
from worlds import waypoints

from log2sim.datatypes import EGO, Agent, MapFeatures, Marking, Scenario, Signal
from log2sim.errors import ConfigError
from log2sim.scenarios import failure
from log2sim.scenarios.failure import LIMITS, drive, judge_run, report_page, search, with_ego
from log2sim.scenarios.index import open_index
from log2sim.scenarios.logical import Base, Logical, choose_base, fit
from log2sim.scenarios.query import ask
from log2sim.simulation.metrics.all_metrics import parse_limits
from log2sim.simulation.policy import Controls
from log2sim.simulation.runner import replay
from log2sim.simulation.sensing import DelayedPolicy, Sensing, parse_sensing

pytest.importorskip("duckdb")
pytest.importorskip("pyarrow")


def half_space(beta: float, dimensions: int):
    """Failures beyond a plane that is `beta` from the origin: their probability is that of one normal score."""
    normal = np.ones(dimensions) / np.sqrt(dimensions)
    return lambda z: beta - z @ normal


@pytest.mark.parametrize(("beta", "runs"), [(1.0, 400), (3.0, 600), (4.5, 800)])
def test_the_interval_holds_the_probability_of_a_half_space_in_95_of_100_runs(beta, runs) -> None:
    exact = NormalDist().cdf(-beta)
    found = [search(half_space(beta, 3), 3, runs, np.random.default_rng([7, k])).estimate for k in range(100)]
    assert sum(e.low <= exact <= e.high for e in found) >= 93
    assert np.mean([e.probability for e in found]) == pytest.approx(exact, rel=0.05)
    assert np.median([(e.high - e.low) / exact for e in found]) < 0.8


def test_a_ring_of_failures_is_estimated() -> None:
    """Beyond a circle in two dimensions, exp(-r^2 / 2): failures in all directions, of which the search finds some."""
    exact = np.exp(-(2.0**2) / 2)
    found = [search(lambda z: 2.0 - np.hypot(*z.T), 2, 1000, np.random.default_rng([8, k])).estimate for k in range(40)]
    assert sum(e.low <= exact <= e.high for e in found) >= 36


@pytest.mark.parametrize("runs", [40, 400])
def test_a_policy_that_never_fails_has_an_upper_bound(runs: int) -> None:
    found = search(lambda z: np.full(len(z), 5.0), 2, runs, np.random.default_rng(0))
    assert found.estimate.probability == found.estimate.low == 0
    assert 0 < found.estimate.high < 40 / runs
    assert len(found.scores) == len(found.margins) == runs


def test_errors_of_a_policy_are_failures_of_it() -> None:
    found = search(lambda z: np.where(z[:, 0] > 0, -1e3, 1.0), 2, 400, np.random.default_rng(0))
    assert found.estimate.low < 0.5 < found.estimate.high


def test_runs_are_judged_by_what_the_ego_did(traffic_folder, monkeypatch) -> None:
    index = open_index(traffic_folder, jobs=1)
    rows = ask(index, "cut_in").rows
    logical, chosen = fit(rows), choose_base(fit(rows), rows)
    base = with_ego(Base.of(Scenario.load(index.folder / chosen["file"]), chosen))
    assert base.row["other"] == EGO
    assert {a.id for a in base.scenario.agents} == {EGO, chosen["agent"]}
    walks = replace(
        base.scenario,
        agents=tuple(
            replace(a, id=chosen["other"], category="cyclist") if a.id == EGO else a for a in base.scenario.agents
        ),
    )
    with pytest.raises(ConfigError, match="a cyclist, which no policy drives"):
        with_ego(replace(base, scenario=walks, row=chosen))
    near, far = np.array([18.0, 26.0, 4.0]), np.array([25.0, 20.0, 60.0])

    def keeps(seen):
        return Controls(0.0, 0.0)

    # A run of the same policy and values is driven once, whatever its limits.
    driven = cache(lambda policy, values: drive(base, logical, policy, "scenario", np.array(values)))
    monkeypatch.setattr(failure, "drive", lambda _, __, policy, agents, values: driven(policy, tuple(values)))
    hit = judge_run(base, logical, keeps, {}, "scenario", near)
    free = judge_run(base, logical, keeps, {}, "scenario", far)
    assert hit.margin < 0
    assert hit.values["impact_mps"] > 1
    assert free.margin > 10
    assert free.margin == free.values["min_gap_m"]
    # 30 m of room and no more are a failure once that is the limit.
    assert judge_run(
        base, logical, keeps, {"min_gap_m": free.values["min_gap_m"] + 1}, "scenario", far
    ).margin == pytest.approx(-1)

    # At constant speed along the path nothing is uncomfortable; 20 m/s are a failure where 15 are allowed.
    assert free.values["max_speed_mps"] == pytest.approx(20.0, abs=0.01)
    assert free.values["max_jerk_mps3"] < 0.5
    assert free.values["max_lateral_mps2"] < 0.5
    fast = judge_run(base, logical, keeps, {"max_speed_mps": 15.0, "max_jerk_mps3": 8.4}, "scenario", far)
    assert fast.margin == pytest.approx(-5.0, abs=0.01)
    swerving = judge_run(base, logical, lambda seen: Controls(0.0, 0.03), {"max_off_path_m": 1.0}, "scenario", far)
    assert swerving.margin == pytest.approx(1.0 - swerving.values["max_off_path_m"])
    assert swerving.values["max_lateral_mps2"] > free.values["max_lateral_mps2"]

    def raises(seen):
        raise ZeroDivisionError("of my own")

    wrong = judge_run(base, logical, raises, {}, "scenario", far)
    assert wrong.margin < -100
    assert "of my own" in wrong.problem
    values = np.stack([near, far, far])
    estimate = search(half_space(1, 2), 2, 60, np.random.default_rng(0)).estimate
    page = report_page("<b>", logical, values, [hit, free, wrong], estimate, {0: "run/view.html"})
    assert "<b> in" not in page
    assert "of my own" in page
    assert page.count('class="failed"') + page.count("class=failed") >= 2
    # Of many runs that fail alike, those with a page are in the table.
    many = report_page("alike", logical, np.tile(near, (50, 1)), [hit] * 50, estimate, {45: "run/view.html"})
    assert 'href="run/view.html"' in many
    assert many.count("<tr>") == 1 + failure.TABLE_ROWS + 1


@pytest.mark.parametrize(
    ("red_from_s", "expected_s", "lanes"),
    [(3.0, 2.4, True), (3.0, 2.4, False), (5.0, 0.4, True), (6.0, -0.6, True), (None, None, True)],
)
def test_who_passes_the_stop_line_of_a_red_light_breaks_a_rule(red_from_s, expected_s, lanes) -> None:
    """At 10 m/s its front is at the line at 5.4 s; the light stands across the junction, and another faces the road that crosses."""
    t = np.linspace(0.0, 14.0, 141)
    w = waypoints(t, 10.0 * (t - 5.62), speed_mps=10.0, sigma_m=0.0)
    line = Marking("s", "stop_line", np.array([[0.0, -1.75, 0.0], [0.0, 1.75, 0.0]]), 0.4, "white")
    times, states = (
        (np.array([0.0, red_from_s]), np.array(["yellow", "red"])) if red_from_s else (t[:1], np.array(["green"]))
    )
    lights = (Signal("a", np.array([20.0, 3.0, 4.0]), np.pi, times, states),
              Signal("b", np.array([8.0, 6.0, 4.0]), np.pi / 2, t[:1], np.array(["red"])))  # fmt: skip
    features = MapFeatures(markings=(line,)) if lanes else MapFeatures()
    if not lanes:  # nothing painted: it is to stop 3 m before the light
        lights = tuple(replace(s, position_m=s.position_m - np.array([17.0, 0, 0])) for s in lights)
    world = Scenario("light", 0, 14.0, (Agent(EGO, "car", (4.4, 1.8, 1.5), w),), signals=lights, map_features=features)
    times_s = {"start_s": 5.0, "t_s": 6.0, "end_s": 7.0}
    row = {"tag": "lane_change", "agent": EGO, **times_s, "agent.speed_mps": 10.0, "file": ""}
    base, logical = Base.of(world, row), Logical(("agent.speed_mps",), np.full((5, 1), 10.0))
    usual = np.array([10.0])
    drives = judge_run(base, logical, lambda seen: Controls(0.0, 0.0), {"max_red_s": 0.0}, "scenario", usual)
    if red_from_s == 5.0:
        brakes = judge_run(base, logical, lambda seen: Controls(-6.0, 0.0), {"max_red_s": 0.0}, "scenario", usual)
        assert "max_red_s" not in brakes.values  # who stands before it has passed nothing
        assert brakes.margin > 0
    if expected_s is None:
        assert "max_red_s" not in drives.values
    else:
        assert drives.values["max_red_s"] == pytest.approx(expected_s, abs=0.11)
        assert drives.margin == pytest.approx(-drives.values["max_red_s"])


@pytest.mark.parametrize(
    ("text", "said"),
    [("min_tt_s=1", "min_ttc_s"), ("min_ttc_s", "expected a number"), ("min_ttc_s=x", "expected a number")],
)
def test_limits_that_are_none_are_refused(text, said) -> None:
    with pytest.raises(ConfigError, match=said):
        parse_limits([text], list(LIMITS))
    assert parse_limits(["min_ttc_s=1.5", "max_brake_mps2=6"], list(LIMITS)) == {
        "min_ttc_s": 1.5,
        "max_brake_mps2": 6.0,
    }


@pytest.mark.slow
def test_a_policy_that_raises_in_every_run_is_told(traffic_folder, tmp_path) -> None:
    (tmp_path / "mine.py").write_text("def broken(seen):\n    raise ValueError('mine')\n")
    policy = f"{tmp_path / 'mine.py'}:broken"
    broken = run("test", policy, traffic_folder, "cut_in", "-o", tmp_path / "u", "-q", "--runs", 40, "--jobs", 1)
    assert "raises in every run" in broken.line
    assert "mine" in broken.line


def test_a_policy_sees_others_as_late_and_as_far_off_as_its_sensors_are() -> None:
    world = replace(traffic(0, count=8, duration_s=7.0).scenario, duration_s=4.0)
    exact: dict[float, dict[str, complex]] = {}
    seen: list[tuple[float, dict[str, complex]]] = []

    def places(o):
        return dict(zip(o.others.id.tolist(), (o.others.x_m + 1j * o.others.y_m).tolist()))

    def looks(o):
        seen.append((o.t_s, places(o)))
        return Controls(0.0, 0.0)

    class Spy(DelayedPolicy):
        def __call__(self, o):
            exact[round(o.t_s, 3)] = places(o)
            return super().__call__(o)

    def drive(sensing):
        exact.clear()
        seen.clear()
        replay(world, mode="exact", dt_s=0.05, ego=Spy(looks, sensing), agents="scenario")
        return list(seen)

    late = drive(Sensing(latency_s=0.3))
    assert not any(p for t, p in late if t < late[0][0] + 0.29)
    for t, p in late:
        if p:
            assert p == exact[round(t - 0.3, 3)]
    noisy = drive(Sensing(noise_m=0.5))
    off = np.array([p[id] - exact[round(t, 3)][id] for t, p in noisy for id in p])
    assert np.std(off.real) == pytest.approx(0.5, rel=0.25)
    assert drive(Sensing(noise_m=0.5)) == noisy
    moved = (replace(a, waypoints=replace(a.waypoints, x_m=a.waypoints.x_m + 1.0)) for a in world.agents)
    world = replace(world, agents=tuple(moved))
    other = drive(Sensing(noise_m=0.5))
    assert other[5] != noisy[5]
    spread = drive(Sensing(latency_s=0.3, latency_sigma_s=0.1))
    stamps = [(t, max(e for e, q in exact.items() if q == p)) for t, p in spread if p]
    assert np.ptp([t - e for t, e in stamps]) > 0.1  # not all are as old
    assert (np.diff([e for _, e in stamps]) >= 0).all()  # and nothing older follows


@pytest.mark.parametrize("text", ["x", "0.1:0.2:0.3", "-1", "", "nan"])
def test_latencies_that_are_none_are_refused(text) -> None:
    with pytest.raises(ConfigError, match="MEAN"):
        parse_sensing(text, 0.0)
