"""What is wrong with reconstructed agents: each measure in closed form, who is doubted, invariances, properties."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from metric_scenes import T_S, agent, moved, scenario, shifted, world

from log2sim.datatypes import CATEGORIES, Agent, Finding, Scenario
from log2sim.errors import ScenarioError
from log2sim.evaluation.metrics.comparison import Selection, compare_agents, reconstructed_states, truth_states
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.evaluation.metrics.table import format_table, format_verdict
from log2sim.evaluation.metrics.verdicts import REPORTED, judge_against_truth
from log2sim.files.documents import check

TICKS = len(T_S)
WALK = {"category": "pedestrian", "size_m": (0.6, 0.6, 1.7)}


def judged(ours, truth, **kwargs):
    ours, truth = (s if isinstance(s, Scenario) else scenario(*s) for s in (ours, truth))
    return evaluate(ours, truth, **kwargs)["correctness"]


def faults(found):
    """Ticks of each measure that is true somewhere."""
    return {name: found[name]["ticks"] for name in (*REPORTED, "wrong") if found[name]["ticks"]}


def driving(id, speed, *, yaw=0.0, true_speed=5.0, **kwargs):
    """An agent that moves with 5 m/s along x and says it has another speed and heading."""
    return agent(id, true_speed * T_S, yaw=yaw, speed=speed, **kwargs)


def test_a_perfect_scenario_has_nothing_wrong():
    found = judged(world(), world())
    assert faults(found) == {}
    assert (found["agents"], found["ticks"], found["undecided_ticks"], found["matched_ticks"]) == (5, 155, 0, 155)
    assert found["doubted"] == {"wrong_ticks": None, "right_ticks": 0.0, "wrong_agents": None, "right_agents": 0.0}
    assert list(found["by_kind"]) == ["vehicle", "two_wheeler", "pedestrian"]
    assert list(found["by_category"]) == ["car", "cyclist", "pedestrian"]
    assert found["confusion"]["ticks"] == {
        "car": {"car": 62},
        "cyclist": {"cyclist": 31},
        "pedestrian": {"pedestrian": 62},
    }
    assert found["calibration"]["agents"]["expected_calibration_error"] == 0.0


BUS = {"category": "bus", "size_m": (12.0, 2.5, 3.0)}
STANDING, WALKER = agent("a", 0.0), agent("a", T_S, speed=1.0, **WALK)


def sized(*size_m):
    return [agent("x", 0.0, size_m=size_m)], [STANDING]


def turned(degrees):
    return [agent("x", 0.0, yaw=np.radians(degrees))], [STANDING]


@pytest.mark.parametrize(
    ("ours", "truth", "expected"),
    [
        # Invented is what has no labeled object of its kind within 2 m, or a quarter of the length of a long one.
        ([agent("x", 1.99)], [STANDING], ""),
        ([agent("x", 2.01)], [STANDING], "invented"),
        ([agent("x", 2.9, **BUS)], [agent("a", 0.0, **BUS)], ""),
        ([agent("x", 3.1, **BUS)], [agent("a", 0.0, **BUS)], "invented"),
        # The matched object tells the class, and what a duplicate doubles, not a nearer one of another kind.
        ([agent("x", 0.0)], [agent("a", 1.0), agent("b", 0.1, category="pedestrian")], ""),
        ([agent("x", 0.0), agent("y", 1.5)], [STANDING, agent("b", 1.6, category="pedestrian")], "duplicate"),
        # A speed is wrong from 1 m/s, along the true heading: turned round with the right motion is backwards alone.
        *(([driving("x", v)], [driving("a", 5.0)], wrong) for v, wrong in
          ((4.01, ""), (5.99, ""), (3.99, "wrong_speed"), (6.01, "wrong_speed"), (-5.0, "wrong_speed wrong_motion"))),
        ([driving("x", -5.0, yaw=np.pi)], [driving("a", 5.0)], "backwards"),
        ([driving("x", 5.0, yaw=np.pi)], [driving("a", 5.0)], "wrong_speed wrong_motion backwards"),
        # Backwards is more than 90 degrees the short way round; standing pedestrians have no heading.
        *((*turned(d), "") for d in (89.0, 270.5)),
        *((*turned(d), "backwards") for d in (91.0, -91.0, 181.0)),
        ([agent("x", 0.0, yaw=3.0, **WALK)], [agent("a", 0.0, **WALK)], ""),
        ([agent("x", T_S, yaw=np.pi, speed=-1.0, **WALK)], [WALKER], "backwards"),
        # A size is wrong by a quarter of length or width, and by 30 cm.
        *((*sized(*size), "") for size in ((5.49, 1.8, 1.5), (4.4, 2.24, 1.5), (4.4, 1.8, 9.9))),
        *((*sized(*size), "wrong_size") for size in ((5.51, 1.8, 1.5), (3.29, 1.8, 1.5), (4.4, 2.26, 1.5))),
        ([agent("x", 0.0, category="pedestrian", size_m=(0.89, 0.6, 1.7))], [agent("a", 0.0, **WALK)], ""),
        ([agent("x", 0.0, category="pedestrian", size_m=(0.91, 0.6, 1.7))], [agent("a", 0.0, **WALK)], "wrong_size"),
        # An agent in the ego is right where its truth is in it.
        ([agent("ego", 0.0), agent("x", 0.0, 1.5)], [agent("ego", 0.0), agent("a", 0.0, 1.75)], ""),
        ([agent("ego", 0.0), agent("x", 0.0, 1.5)], [agent("ego", 0.0), agent("a", 0.0, 1.85)], "in_ego"),
    ],
)  # fmt: skip
def test_an_agent_is_wrong_by_these_limits(ours, truth, expected):
    found = judged(ours, truth)
    names = expected.split()
    assert faults(found) == dict.fromkeys([*names, *["wrong"][: len(names)]], TICKS)
    for name in names:
        assert (found[name]["ticks"], found[name]["agents"]) == (TICKS, 1)


@pytest.mark.parametrize(
    ("ours", "true", "wrong"),
    [(0.0, 0.99, False), (0.0, 1.01, True), (0.49, 1.3, True), (0.51, 1.3, False), (1.01, 0.0, True),
     (0.99, 0.0, False), (1.2, 0.49, True), (1.2, 0.51, False), (-0.6, 0.4, False), (-0.51, 0.51, True)],
)  # fmt: skip
def test_standing_and_moving_are_told_apart_with_a_margin(ours, true, wrong):
    labeled = agent("a", true * T_S, speed=true, visible=True, static=False)
    assert ("wrong_motion" in faults(judged([agent("x", true * T_S, speed=ours)], [labeled]))) == wrong


def test_a_second_agent_at_an_object_is_a_duplicate_even_where_the_object_is_hidden():
    for visible in (True, False):
        truth = [agent("a", 0.0, visible=visible), agent("b", 30.0)]
        found = judged([agent("x", 0.0), agent("y", 1.5)], truth)
        assert faults(found) == {"duplicate": TICKS, "wrong": TICKS}
        assert [(r["id"], r["taken_for"]) for r in found["judged_agents"]] == [("x", {"a": TICKS}), ("y", {"a": TICKS})]


def test_an_object_of_another_kind_is_no_object_of_the_kind():
    found = judged([agent("x", 0.0, category="cyclist")], [agent("a", 0.0, category="pedestrian")])
    assert faults(found) == {"invented": TICKS, "wrong_class": TICKS, "wrong": TICKS}
    assert found["confusion"] == {k: {"cyclist": {"pedestrian": n}} for k, n in (("ticks", TICKS), ("agents", 1))}


@pytest.mark.parametrize(("gap", "inside"), [(0.01, False), (-0.01, True)])
@pytest.mark.parametrize("turned", [0.0, np.pi / 2])
def test_an_agent_in_the_ego_is_wrong(gap, inside, turned):
    """An ego that drives, and an agent beside it, parallel or across, that may pass through it."""
    reach = 1.8 if turned == 0 else (1.8 + 4.4) / 2
    ego = agent("ego", 5 * T_S, speed=5.0)
    found = judged([ego, agent("x", 5 * T_S, reach + gap, yaw=turned)], [ego, agent("far", 99.0)])
    assert faults(found) == {"invented": 31, "wrong": 31} | ({"in_ego": 31} if inside else {})


@pytest.mark.parametrize(("ticks", "agents"), [(2, 0), (3, 1)])
def test_an_agent_is_wrong_when_more_than_a_fifth_of_its_ticks_are(ticks, agents):
    away = np.where(np.arange(10) < ticks, 50.0, 0.0)
    found = judged([agent("x", 0.0, away, t_s=T_S[:10])], [agent("a", 0.0)])
    assert found["invented"] == {"share": ticks / 10, "ticks": ticks, "agents": agents}
    assert found["wrong"]["agents"] == agents
    assert found["judged_agents"][0]["invented_ticks"] == ticks


def test_doubt_is_a_flag_or_a_confidence_below_one_half():
    ours = [
        agent("right", 0.0, confidence=0.9),
        agent("flagged", 20.0, confidence=0.9, doubts=(Finding("curvature", text="turns on the spot"),)),
        agent("unsure", 40.0, confidence=0.49),
        agent("sure", 60.0, confidence=0.5),
        agent("both", 80.0, confidence=0.1, doubts=(Finding("jump", text="jumps"),)),
    ]
    truth = [agent("a", 0.0), agent("b", 20.0)]
    found = judged(ours, truth)
    twice = {"wrong": pytest.approx(2 / 3, abs=1e-6), "right": 0.5}
    assert found["doubted"] == {f"{k}_{unit}": twice[k] for unit in ("ticks", "agents") for k in ("wrong", "right")}
    assert {r["id"]: r["doubts"] for r in found["judged_agents"]} == {
        "right": [], "flagged": ["curvature"], "unsure": ["confidence"], "sure": [], "both": ["confidence", "jump"],
    }  # fmt: skip


def test_a_doubt_counts_while_it_holds():
    half = np.where(np.arange(TICKS) < 10, 50.0, 0.0)
    hidden = Finding("hidden", end_s=float(T_S[9]), text="hidden at first")
    found = judged([agent("x", 0.0, half, doubts=(hidden,))], [agent("a", 0.0)])
    assert (found["doubted"]["wrong_ticks"], found["doubted"]["right_ticks"]) == (1.0, 0.0)


def test_confidence_is_compared_with_right_ticks_and_right_agents():
    half = np.where(np.arange(TICKS) < 10, 0.0, 50.0)
    found = judged(
        [agent("x", 0.0, half, confidence=0.75), agent("y", 20.0, confidence=0.95)], [agent("a", 0.0), agent("b", 20.0)]
    )
    ticks, agents = found["calibration"]["ticks"], found["calibration"]["agents"]
    assert ticks["expected_calibration_error"] == pytest.approx((0.75 - 10 / 31 + 0.05) / 2, abs=1e-6)
    assert agents["expected_calibration_error"] == pytest.approx((0.75 + 0.05) / 2)
    assert [(b["low"], b["count"], b["right"]) for b in agents["bins"] if b["count"]] == [(0.7, 1, 0.0), (0.9, 1, 1.0)]


def test_sigma_is_compared_with_the_errors_by_range():
    def with_sigma(a, first, last):
        return replace(a, waypoints=replace(a.waypoints, sigma_xy_m=np.linspace(first, last, TICKS)))

    truth = [agent("ego", 0.0), agent("a", 10.0), agent("b", 40.0)]
    ours = [
        agent("ego", 0.0),
        with_sigma(agent("x", 10.3, 0.4), 0.5, 0.5),
        with_sigma(agent("y", 40.0, 1.0), 0.25, 0.25),
    ]
    found = judged(ours, truth)
    assert found["by_range"]["0-15"]["sigma"]["nees"] == pytest.approx(0.5)
    assert found["by_range"]["30-50"]["sigma"]["nees"] == pytest.approx(8.0)
    assert found["sigma"]["nees"] == pytest.approx(4.25)
    assert (found["by_range"]["15-30"]["sigma"]["nees"], found["sigma"]["within_95"]) == (None, 0.5)
    thinned = with_sigma(ours[1], 0.5, 1.5)
    w = thinned.waypoints
    ends = {k: getattr(w, k)[[0, -1]] for k in (*w.FLOATS, "observed")}
    thinned = replace(thinned, static=True, waypoints=replace(w, **ends))
    expected = np.mean(0.5**2 / 2 / np.linspace(0.5, 1.5, TICKS) ** 2)
    assert judged([ours[0], thinned], truth)["sigma"]["nees"] == pytest.approx(expected, rel=1e-4)


def test_sigmas_of_yaw_and_speed_are_compared_with_their_errors():
    truth = [agent("ego", 0.0), agent("a", 10.0), agent("b", 40.0)]
    found = judged([agent("ego", 0.0), agent("x", 10.0), agent("y", 40.0)], truth)
    assert (found["sigma_yaw"]["count"], found["sigma_yaw"]["nees"], found["sigma_speed"]["nees"]) == (0, None, None)

    def off(a, yaw_rad, speed_mps):
        w = a.waypoints
        columns = {"sigma_yaw_rad": np.full(TICKS, 0.05), "sigma_speed_mps": np.full(TICKS, 0.25)}
        turned = replace(w, yaw_rad=w.yaw_rad + yaw_rad, speed_mps=w.speed_mps + speed_mps, **columns)
        return replace(a, waypoints=turned)

    # Turned round, a heading has no error that sigma_yaw should tell.
    found = judged(
        [agent("ego", 0.0), off(agent("x", 10.0), 0.1, 0.5), off(agent("y", 40.0), np.pi - 0.05, 0.0)], truth
    )
    assert found["by_range"]["0-15"]["sigma_yaw"]["nees"] == pytest.approx(4.0)
    assert found["by_range"]["0-15"]["sigma_speed"]["nees"] == pytest.approx(4.0)
    assert found["by_range"]["30-50"]["sigma_yaw"]["nees"] == pytest.approx(1.0)
    assert found["sigma_speed"]["nees"] == pytest.approx(2.0)


def test_ranges_are_those_of_the_reconstructed_agent_and_end_where_the_next_begins():
    ego = agent("ego", 0.0)
    xs = (5.0, 15.0, 29.9, 30.0, 50.0, 90.0)
    found = judged([ego, *(agent(f"x{k}", x) for k, x in enumerate(xs))], [ego, agent("a", 0.0, 60.0)])
    assert {k: v["agents"] for k, v in found["by_range"].items()} == {"0-15": 1, "15-30": 2, "30-50": 1, "50-": 2}
    limited = judged(
        [ego, *(agent(f"x{k}", x) for k, x in enumerate(xs))], [ego, agent("a", 0.0, 60.0)], max_range_m=30.0
    )
    assert (limited["agents"], limited["by_range"]["50-"]["ticks"]) == (4, 0)
    assert judged([agent("x", 0.0)], [agent("a", 0.0)])["by_range"] is None


def test_gaps_of_the_labels_say_nothing_of_states_nor_of_presence():
    kept = (T_S < 1.05) | (T_S > 1.95)
    truth = [agent("ego", 0.0), agent("a", T_S[kept], 5.0, speed=1.0, t_s=T_S[kept])]
    found = judged([agent("ego", 0.0), agent("x", T_S, 5.0, speed=9.0), agent("y", T_S, 6.0)], truth)
    gap = int((~kept).sum())
    assert (found["ticks"], found["undecided_ticks"]) == (2 * (TICKS - gap), 2 * gap)
    assert faults(found)["duplicate"] == faults(found)["wrong_speed"] == TICKS - gap


def test_what_is_not_selected_is_not_judged_at_all():
    ego_xy = np.zeros((TICKS, 2))
    ours = reconstructed_states((driving("x", 9.0, yaw=np.pi), agent("y", 0.0, 9.0, category="truck")), T_S, ego_xy)
    truth = truth_states((driving("a", 5.0), agent("b", 0.0, 9.0)), T_S, np.zeros(3), ego_xy)
    found = judge_against_truth(compare_agents(truth, ours, 0.1, Selection(8.0, frozenset(["car"]))), None)
    near = np.array([5 * T_S <= 8.0, np.zeros(TICKS, dtype=bool)])
    assert np.array_equal(found.judged, near)
    assert np.array_equal(found.wrong, near)
    assert np.array_equal(np.isfinite(found.error_m[..., 0]), near)
    for mask in (*found.measures.values(), found.matched >= 0, found.taken_for >= 0, found.undecided):
        assert not np.any(mask & ~near)


def broken():
    """The world with one agent of each fault."""
    car = {"size_m": (7.0, 2.8, 1.5), "confidence": 0.88}
    rest = [a for a in world().agents if a.id not in ("a", "b")]
    return scenario(
        *rest, agent("car-18", 10 + 5 * T_S, 3.0, speed=-5.0, yaw=np.pi, **car), agent("car-9", 15.0, -4.0, yaw=-2.0),
        agent("car-10", 15.0, -4.5, confidence=0.3), agent("ghost", 90.0, doubts=(Finding("jump", text="jumps"),)),
    )  # fmt: skip


def test_a_result_keeps_its_schema_and_the_worst_agents_are_named():
    result = evaluate(broken(), world())
    check(result, "metrics-1", ScenarioError)
    json.dumps(result, allow_nan=False)
    assert "car-18 backwards, wrong size (31 of 31 ticks)" in format_verdict(result)
    text = format_table(result)
    assert "car-18: backwards in 31, wrong size in 31 of 31 ticks, confidence 0.88, not doubted" in text
    assert "ghost: invented in 31 of 31 ticks, confidence 1.00, doubted (jump)" in text
    assert text.index("car-18:") < text.index("car-10:") < text.index("ghost:")
    assert "expected calibration error" in text


def without_names(found):
    """The figures without ids, agents in an order of their own."""
    rows = [{k: v for k, v in r.items() if k not in ("id", "taken_for")} for r in found["judged_agents"]]
    return {**found, "judged_agents": sorted(rows, key=str)}


def test_names_order_place_and_heading_of_the_world_make_no_difference():
    def turned(s, angle, dx):
        c, n = np.cos(angle), np.sin(angle)
        agents = [
            replace(
                a,
                id=a.id if a.id == "ego" else f"{k}-{a.id}",
                waypoints=replace(
                    w, x_m=c * w.x_m - n * w.y_m + dx, y_m=n * w.x_m + c * w.y_m, yaw_rad=w.yaw_rad + angle
                ),
            )
            for k, a in enumerate(s.agents)
            for w in [a.waypoints]
        ]
        return replace(s, agents=tuple(agents[::-1]))

    def flat(value):
        if isinstance(value, dict):
            return {k: flat(v) for k, v in value.items()}
        return (
            [flat(v) for v in value]
            if isinstance(value, list)
            else value
            if value is None
            else pytest.approx(value, abs=2e-6)
        )

    ours = shifted(broken(), 0.3)
    ours = replace(ours, agents=tuple(moved(a, sigma_xy_m=np.full(TICKS, 0.2)) for a in ours.agents))
    plain, other = evaluate(ours, world()), evaluate(turned(ours, 1.1, 1e4), turned(world(), 1.1, 1e4))
    for key in ("recall", "precision", "position_rmse_m", "yaw_median_deg", "speed_rmse_mps", "mota", "hota", "counts"):
        assert other[key] == pytest.approx(plain[key], abs=2e-6), key
    plain, other = (without_names(found["correctness"]) for found in (plain, other))
    rules = plain.pop("rules")
    assert other.pop("rules") == rules
    plain_rows, other_rows = plain.pop("judged_agents"), other.pop("judged_agents")
    assert other == {k: flat(v) for k, v in plain.items()}
    assert [{**r, "mean_range_m": 0} for r in other_rows] == [{**r, "mean_range_m": 0} for r in plain_rows]


@st.composite
def scenes(draw) -> list[Agent]:
    """Up to five agents on a small plot."""
    agents = []
    for k in range(draw(st.integers(0, 5))):
        spot = st.floats(-4, 4)
        agents.append(
            agent(
                f"n{k}", draw(spot), draw(spot), yaw=draw(st.floats(-3, 3)), speed=draw(st.floats(-3, 3)),
                category=draw(st.sampled_from(CATEGORIES)), t_s=T_S[: draw(st.integers(2, 12))],
                size_m=(draw(st.floats(0.5, 9)), 1.8, 1.5), confidence=draw(st.floats(0, 1)),
            )
        )  # fmt: skip
    return agents


@settings(max_examples=15, deadline=None)
@given(scenes(), scenes())
def test_doubting_everything_doubts_all_that_is_wrong_and_all_that_is_right(ours, truth):
    found = judged([replace(a, confidence=0.2) for a in ours], truth)
    assert all(s in (None, 1.0) for s in found["doubted"].values())


@settings(max_examples=15, deadline=None)
@given(scenes())
def test_false_ticks_are_invented_or_duplicate(ours):
    # Precision does not count what is at an object of another kind.
    truth = [agent("a", 0.0), agent("b", 3.0, 1.0, category="cyclist")]
    whole = evaluate(scenario(*ours), scenario(*truth))
    found = whole["correctness"]
    assert whole["counts"]["false_ticks"] <= found["invented"]["ticks"] + found["duplicate"]["ticks"]
