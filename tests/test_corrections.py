"""Corrections by hand against closed forms; they find their agents again; wrong ones are one line."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import run
from test_edit import circling, parked, scenario, straight

from log2sim.datatypes import Finding, MapFeatures, MapFrame, Marking, Scenario
from log2sim.edit.corrections import correct, load_corrections
from log2sim.errors import ConfigError, ScenarioError
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.files.documents import check
from log2sim.geometry import NS_PER_S, wrap_angle

ROOT = Path(__file__).resolve().parents[1]


def at(t_s: float, x_m: float, y_m: float, **more: float) -> dict[str, Any]:
    return {"t_ns": round(t_s * NS_PER_S), "x_m": x_m, "y_m": y_m, **more}


def document(*entries: dict[str, Any], **more: Any) -> dict[str, Any]:
    made = {"format": "log2sim-corrections", "version": 1, "corrections": list(entries), **more}
    check(made, "corrections-1", ScenarioError)
    return made


def after(source: Scenario, *entries: dict[str, Any], **more: Any) -> Scenario:
    corrected = correct(source, document(*entries, **more))
    assert corrected.unmatched == ()
    assert Scenario.from_dict(json.loads(json.dumps(corrected.scenario.to_dict()))).digest == corrected.scenario.digest
    return corrected.scenario


def test_a_key_pose_moves_a_trajectory_as_the_kalman_gain_says() -> None:
    source = straight("car-1")  # 10 m/s along x, sigma 0.1 m
    pose = at(2.0, 20.0, 0.08, sigma_m=0.05)
    w = after(scenario(source), {"kind": "move", "agent": at(2.0, 20.0, 0.0), "poses": [pose]})["car-1"].waypoints
    gain = 0.1**2 / (0.1**2 + 0.05**2)
    k = int(np.argmin(np.abs(w.t_s - 2.0)))
    assert w.y_m[k] == pytest.approx(gain * 0.08, abs=1e-9)
    assert w.sigma_xy_m[k] == pytest.approx(math.sqrt((1 - gain) * 0.1**2), abs=1e-9)
    # A second later by the Matern correlation of 2 s, and the heading is that of the way.
    apart = math.sqrt(3) / 2.0
    j = int(np.argmin(np.abs(w.t_s - 3.0)))
    assert w.y_m[j] == pytest.approx(gain * 0.08 * (1 + apart) * math.exp(-apart), rel=1e-6)
    middle = slice(2, -2)
    assert np.allclose(np.tan(w.yaw_rad[middle]), np.gradient(w.y_m, w.x_m)[middle], atol=2e-4)


def test_a_static_agent_moves_as_one_and_by_all_its_poses() -> None:
    poses = [at(0.5, 30.1, -3.0, sigma_m=0.1, yaw_rad=0.45), at(3.0, 30.1, -3.0, sigma_m=0.1, yaw_rad=0.45)]
    w = after(scenario(parked()), {"kind": "move", "agent": at(1.0, 30.0, -3.0), "poses": poses})["parked"].waypoints
    assert np.allclose(w.x_m, 30.0 + 0.1 * 2 / 3)  # one prior and two measurements of the same sigma
    assert np.ptp(w.yaw_rad) == 0.0
    assert 0.4 < w.yaw_rad[0] < 0.45


def test_a_pose_far_beyond_the_sigmas_is_followed() -> None:
    source = straight("car-1")
    w = after(scenario(source), {"kind": "move", "agent": at(2.0, 20.0, 0.0), "poses": [at(2.0, 20.0, 3.0)]})[
        "car-1"
    ].waypoints
    k = int(np.argmin(np.abs(w.t_s - 2.0)))
    assert w.y_m[k] == pytest.approx(3.0, abs=0.01)


def test_moves_one_after_the_other_are_one_with_all_their_poses() -> None:
    poses = [at(1.0, 10.0, 0.1), at(1.6, 16.0, -0.05), at(3.0, 30.1, 0.0)]
    agent = at(2.5, 25.0, 0.0)
    both = after(scenario(straight("car-1")), {"kind": "move", "agent": agent, "poses": poses})["car-1"].waypoints
    parts = [{"kind": "move", "agent": agent, "poses": [pose]} for pose in poses]
    apart = after(scenario(straight("car-1")), *parts)["car-1"].waypoints
    for column in ("t_s", "x_m", "y_m", "yaw_rad", "sigma_xy_m"):
        np.testing.assert_allclose(getattr(apart, column), getattr(both, column), atol=1e-12)


def test_a_static_agent_that_is_put_at_different_places_moves_through_them_for_all_its_life() -> None:
    source = parked()  # at (30, -3) from 0 to 4 s
    poses = [at(1.0, 30.0, -3.0), at(2.0, 32.0, -3.0)]
    steps = [{"kind": "move", "agent": at(1.0, 30.0, -3.0), "poses": [pose]} for pose in poses]
    found = after(scenario(source), *steps)["parked"]
    assert not found.static
    assert found.waypoints.t_s[[0, -1]].tolist() == source.waypoints.t_s[[0, -1]].tolist()
    np.testing.assert_allclose(found.waypoints.x_m, 28.0 + 2.0 * found.waypoints.t_s, atol=1e-9)
    np.testing.assert_allclose(found.waypoints.speed_mps, 2.0, atol=1e-9)
    k = np.searchsorted(found.waypoints.t_s, [1.0, 4.0 - 1e-6])
    assert found.waypoints.sigma_xy_m[k[0]] < 0.06 < 2.0 < found.waypoints.sigma_xy_m[k[1]]


def test_a_track_goes_on_to_poses_outside_of_its_life() -> None:
    whole = straight("car-1", y_m=6.0)
    part = replace(whole, waypoints=whole.waypoints.take((whole.waypoints.t_s > 0.95) & (whole.waypoints.t_s < 2.05)))
    poses = [at(0.0, 0.0, 6.0), at(3.0, 30.0, 6.0), at(4.0, 40.0, 6.0)]
    move = {"kind": "move", "agent": at(1.5, 15.0, 6.0), "poses": poses}
    w = after(scenario(straight("ego"), part), move)["car-1"].waypoints
    assert w.t_s[[0, -1]] == pytest.approx([0.0, 4.0])
    np.testing.assert_allclose(w.x_m, 10.0 * w.t_s, atol=1e-6)
    np.testing.assert_allclose(w.speed_mps, 10.0, atol=1e-6)
    assert not w.observed[w.t_s > 2.1].any()


def test_a_pose_far_beyond_the_sigmas_bends_no_speed_where_these_change() -> None:
    source = straight("car-1")  # 10 m/s
    w = source.waypoints
    unsure = replace(source, waypoints=replace(w, sigma_xy_m=np.where(w.t_s < 1.0, 0.3, 0.1)))
    found = after(scenario(unsure), {"kind": "move", "agent": at(2.0, 20.0, 0.0), "poses": [at(2.0, 23.0, 0.0)]})[
        "car-1"
    ]
    # The push of 3 m comes and goes over seconds: at most by the steepest slope of the Matern correlation, exp(-1) 3 ** 0.5 / 2 s of it.
    steepest = 3.0 * math.exp(-1) * math.sqrt(3) / 2.0
    assert np.abs(found.waypoints.speed_mps - 10.0).max() < 1.2 * steepest


@pytest.mark.parametrize("source", [straight("car-1"), circling(40.0, 8.0)])
def test_merging_the_parts_of_a_trajectory_gives_it_back(source: Any) -> None:
    w = source.waypoints
    first, last = (
        replace(source, id="a", waypoints=w.take(w.t_s < 1.2)),
        replace(source, id="b", waypoints=w.take(w.t_s > 2.0)),
    )
    refs = [at(t, float(s.x_m[0]), float(s.y_m[0])) for t, s in ((0.5, source.at(0.5)), (2.5, source.at(2.5)))]
    out = after(scenario(first, last), {"kind": "merge", "agent": refs[0], "other": refs[1]})
    (agent_id,) = out
    merged = out[agent_id].waypoints
    truth = source.at(merged.t_s)
    assert agent_id == "a"
    assert np.hypot(merged.x_m - truth.x_m, merged.y_m - truth.y_m).max() < 0.01
    assert np.abs(merged.speed_mps - truth.speed_mps).max() < 0.05
    gap = (merged.t_s > 1.2) & (merged.t_s < 2.0)
    assert not merged.observed[gap].any()
    assert merged.sigma_xy_m[gap].max() > 0.1


def test_merged_tracks_of_the_same_time_are_averaged_by_their_variances() -> None:
    one, other = straight("a"), straight("b", y_m=0.9)
    other = replace(other, waypoints=replace(other.waypoints, sigma_xy_m=np.full(41, 0.2)))
    out = after(scenario(one, other), {"kind": "merge", "agent": at(1.0, 10.0, -0.5), "other": at(1.0, 10.0, 1.6)})
    assert np.allclose(out["a"].waypoints.y_m, 0.9 * 0.1**2 / (0.1**2 + 0.2**2))
    assert np.allclose(out["a"].waypoints.sigma_xy_m, 1 / math.hypot(10, 5))


def test_split_flip_size_category_confirm_color_and_delete() -> None:
    doubts = (Finding("heading_ambiguous"), Finding("jump", text="is 3 m off"))
    source = replace(parked(), doubts=doubts, confidence=0.2, quarantined=True)
    here = at(1.0, 30.0, -3.0)
    out = after(
        scenario(straight("ego"), straight("car-7", y_m=20.0), source),
        {"kind": "flip", "agent": here}, {"kind": "size", "agent": here, "size_m": [5.0, 2.0, 2.0]},
        {"kind": "category", "agent": here, "category": "truck"},
        {"kind": "color", "agent": here, "rgb": [200, 10, 10], "name": "red"},
        {"kind": "split", "agent": at(2.0, 20.0, 20.0), "t_ns": 2 * NS_PER_S},
    )  # fmt: skip
    changed = out["parked"]
    assert changed.waypoints.yaw_rad[0] == pytest.approx(0.4 - math.pi)
    assert changed.waypoints.z_m[0] == pytest.approx(0.8 + 0.2)  # its wheels stay on the ground
    assert (changed.category, changed.size_m, changed.color["name"]) == ("truck", (5.0, 2.0, 2.0), "red")
    assert [d.kind for d in changed.doubts] == ["jump"]
    parts = [out["car-7"].waypoints, out["car-1"].waypoints]
    assert parts[0].t_s[-1] < 2.0 <= parts[1].t_s[0]
    certain = after(out, {"kind": "confirm", "agent": here})["parked"]
    assert not certain.is_doubtful
    assert not certain.quarantined
    assert "parked" not in list(after(out, {"kind": "delete", "agent": here}))
    assert len(after(out, {"kind": "delete", "agent": here}).provenance["corrections"]) == 2


def test_an_added_agent_passes_its_poses() -> None:
    poses = [at(0.0, 0.0, 5.0), at(1.0, 10.0, 5.0), at(2.0, 20.0, 6.0)]
    added = after(scenario(straight("ego")), {"kind": "add", "category": "bus", "poses": poses})["bus-1"]
    there = added.at([0.0, 1.0, 2.0])
    assert np.allclose(np.stack([there.x_m, there.y_m]), [[0, 10, 20], [5, 5, 6]])
    assert not added.static
    assert after(scenario(), {"kind": "add", "category": "car", "poses": poses[:1]})["car-1"].static


def test_lines_are_drawn_and_erased_and_lanes_forget_them() -> None:
    line = Marking("line-1", "solid", np.array([[0.0, 0, 0], [50, 0, 0]]), 0.15)
    source = replace(scenario(straight("ego")), map_features=MapFeatures(markings=(line,)))
    drawn = {"kind": "draw", "feature": "curb", "points_m": [[0, 5, 0], [50, 5, 0]]}
    features = after(source, {"kind": "erase", "at": [25.0, 0.3, 0.0]}, drawn).map_features
    assert features.markings == ()
    assert [b.kind for b in features.borders] == ["curb"]
    lost = correct(source, document({"kind": "erase", "at": [25.0, 3.0, 0.0]})).unmatched
    assert len(lost) == 1
    assert lost[0].startswith("correction 1 (erase): no marking")


@pytest.mark.parametrize("seed", range(5))
def test_corrections_hold_for_another_reconstruction(seed: int) -> None:
    """Other ids, another order, another start, another offset of the map, positions off by 0.3 m and ends by 0.3 s."""
    rng = np.random.default_rng(seed)
    cars = [straight(f"car-{k}", y_m=2.5 * k) for k in range(5)]
    chosen = int(rng.integers(5))
    entry = {"kind": "category", "agent": at(2.0, 20.0, 2.5 * chosen), "category": "truck"}
    later = []
    for k in rng.permutation(5):
        w = cars[k].waypoints
        x, y = w.x_m + rng.normal(0, 0.15) + 1000.0, w.y_m + rng.normal(0, 0.15)
        cut = w.t_s > rng.uniform(0, 0.3)
        later.append(
            replace(
                cars[k],
                id=f"agent-{len(later)}",
                quality={"k": int(k)},
                waypoints=replace(w, t_s=w.t_s - 0.5, x_m=x, y_m=y).take(cut),
            )
        )
    moved = replace(scenario(*later), t0_ns=NS_PER_S // 2, map=MapFrame(offset_m=(-1000.0, 0.0, 0.0)))
    out = after(moved, entry, map_offset_m=[0.0, 0.0, 0.0])
    assert [a.quality["k"] for a in out.agents if a.category == "truck"] == [chosen]


def test_what_is_not_there_is_told_and_the_rest_is_done(tmp_path: Path) -> None:
    source = scenario(straight("ego"), parked())
    source.save(tmp_path / "s.json")
    entries = [{"kind": "delete", "agent": at(1.0, 90.0, 90.0)}, {"kind": "flip", "agent": at(1.0, 30.0, -3.0)}]
    (tmp_path / "c.json").write_text(json.dumps(document(*entries)))
    ran = run("correct", tmp_path / "s.json", tmp_path / "c.json", "--out", tmp_path / "o.json")
    assert ran.code == 0
    assert "correction 1 (delete): no agent within 1 m" in ran.out
    assert Scenario.load(tmp_path / "o.json")["parked"].waypoints.yaw_rad[0] < 0


def test_those_of_another_log_and_beyond_the_map_or_the_time_are_told() -> None:
    source, here = scenario(straight("ego"), parked()), at(1.0, 30.0, -3.0)
    add = {"kind": "add", "category": "car"}
    outside = [
        {"kind": "move", "agent": here, "poses": [at(1.0, 1e6, 0.0)]},
        {**add, "poses": [at(-3600.0, 1.0, 2.0)]},
        {"kind": "draw", "feature": "curb", "points_m": [[1e7, 0, 0], [1e7, 5, 0]]},
    ]
    result = correct(source, document(*outside, {"kind": "flip", "agent": here}, log="elsewhere"))
    assert [line.split(" (")[0] for line in result.unmatched] == ["correction 1", "correction 2", "correction 3"]
    assert len(result.scenario.agents) == 2
    with pytest.raises(ScenarioError, match="'elsewhere'"):
        correct(source, document(*outside, log="elsewhere"))
    # One that creeps more slowly than anything counts as moving has the heading of its way.
    creeping = correct(source, document({**add, "poses": [at(0.0, 1.0, 20.0), at(4.0, 1.0, 20.2)]})).scenario["car-1"]
    assert np.allclose(creeping.waypoints.yaw_rad, np.pi / 2)


def test_with_the_log_points_of_the_corrected_boxes_are_counted(tmp_path: Path) -> None:
    truth = Scenario.load(ROOT / "samples/crossing/truth.json")
    known = truth["car_parked"].at(1.0)
    place = {"t_ns": truth.t0_ns + NS_PER_S, "x_m": float(known.x_m[0]), "y_m": float(known.y_m[0])}
    empty = {"kind": "add", "category": "car", "poses": [{**place, "x_m": place["x_m"] + 40, "y_m": place["y_m"] + 40}]}
    made = document({"kind": "flip", "agent": place, "author": "me", "time": "now", "reason": "seen"}, empty)
    (tmp_path / "c.json").write_text(json.dumps(made))
    sample = ROOT / "samples/crossing"
    ran = run("correct", sample / "truth.json", tmp_path / "c.json", "--log", sample, "--out", tmp_path / "o.json")
    assert ran.code == 0
    assert "warning: car-1: the LiDAR has no point in its box" in ran.out
    after = Scenario.load(tmp_path / "o.json")
    assert after["car_parked"].quality["points_median"] > 50
    assert after["car-1"].quality["points_median"] == 0
    assert after.provenance["corrections"][0]["corrections"] == made["corrections"]


def test_contradictions_and_impossible_ones_are_refused() -> None:
    source, here = scenario(straight("ego"), parked(), straight("car-1", y_m=20.0)), at(1.0, 30.0, -3.0)
    two = [{"kind": "category", "agent": here, "category": name} for name in ("bus", "truck")]
    for entries in (two, [{"kind": "delete", "agent": here}, {"kind": "flip", "agent": here}],
                    [{"kind": "split", "agent": at(1.0, 10.0, 20.0), "t_ns": 90 * NS_PER_S}]):  # fmt: skip
        with pytest.raises(ConfigError):
            correct(source, document(*entries))
    # A correction never moves the ego, whose poses are those of the log.
    assert correct(source, document({"kind": "flip", "agent": at(1.0, 10.0, 0.0)})).unmatched


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 2}, "version"),
        ({"corrections": [{"kind": "flip"}]}, "agent"),
        ({"corrections": [{"kind": "paint"}]}, "paint"),
        ({"corrections": [{"kind": "move", "agent": at(1, 0, 0), "poses": []}]}, "poses"),
    ],
)
def test_a_file_of_another_form_is_one_line(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    (tmp_path / "c.json").write_text(
        json.dumps({"format": "log2sim-corrections", "version": 1, "corrections": [], **change})
    )
    with pytest.raises(ScenarioError, match=f"c.json.*{words}"):
        load_corrections(tmp_path / "c.json")


def truth() -> Scenario:
    return scenario(straight("ego", speed_mps=5.0), straight("a", y_m=6.0), parked("b"), straight("c", y_m=-10.0))


def spoiled() -> Scenario:
    """A car that stands and is turned round, one that is too long and doubted, one in two parts, and one that is not there."""
    ego, a, b, c = truth().agents
    w = b.waypoints
    turned = replace(b, waypoints=replace(w, yaw_rad=wrap_angle(w.yaw_rad + np.pi)))
    long = replace(a, size_m=(12.0, *a.size_m[1:]), doubts=(Finding("heading_ambiguous"),), confidence=0.3)
    first = replace(c, id="c-1", waypoints=c.waypoints.take(c.waypoints.t_s <= 2.5))
    last = replace(
        c, id="c-2", waypoints=c.waypoints.take(c.waypoints.t_s > 1.5), doubts=(Finding("heading_ambiguous"),)
    )
    ghost = replace(b, id="ghost", waypoints=replace(w, y_m=w.y_m - 20.0), confidence=0.45)
    return scenario(ego, long, turned, first, last, ghost)


def test_corrections_are_counted_and_confidence_is_compared_with_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import learn_corrections

    found = spoiled()

    def place(name: str) -> dict[str, float]:
        agent = found[name]
        t_s = float(np.mean(agent.waypoints.t_s[[0, -1]]))
        at = agent.at(t_s)
        return {"t_ns": found.t0_ns + round(t_s * NS_PER_S), "x_m": float(at.x_m[0]), "y_m": float(at.y_m[0])}

    made: list[dict[str, object]] = [
        {"kind": kind, "agent": place(name)} for kind, name in (("confirm", "a"), ("flip", "b"), ("delete", "ghost"))
    ]
    made += [
        {"kind": "size", "agent": place("a"), "size_m": list(truth()["a"].size_m)},
        {"kind": "merge", "agent": place("c-1"), "other": place("c-2")},
    ]
    after = correct(found, {"corrections": made})
    assert after.unmatched == ()
    before, corrected = (evaluate(s, truth()) for s in (found, after.scenario))
    assert before["correctness"]["wrong"]["agents"] == 4
    assert (corrected["correctness"]["wrong"]["share"], corrected["precision"], corrected["recall"]) == (0.0, 1.0, 1.0)
    found.save(tmp_path / "s.json")
    document = {"format": "log2sim-corrections", "version": 1, "corrections": made}
    (tmp_path / "s.corrections.json").write_text(json.dumps(document))
    learn_corrections.main([tmp_path / "s.json"])
    head, _, counts, *rest = capsys.readouterr().out.splitlines()
    kinds = dict(zip(head.split(" | ")[1:], counts.split(" | ")[1:]))
    counted = {"confirm": "1", "size": "1", "flip": "1", "delete": "1", "merge": "2"}
    assert {k.strip(" |"): n.strip(" |") for k, n in kinds.items()} == counted
    # Five agents, all of them wrong: confidences 0.3, 1, 1, 1 and 0.45.
    assert rest[-1] == f"expected calibration error of those judged: {(0.3 + 1 + 1 + 1 + 0.45) / 5:.3f}"
