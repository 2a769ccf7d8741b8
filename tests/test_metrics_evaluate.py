"""Figures of whole scenarios: closed forms, what counts, invariances."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from metric_scenes import T_S, agent, moved, scenario, shifted, world

from log2sim.datatypes import MapFrame
from log2sim.errors import ScenarioError
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.evaluation.metrics.table import format_table, format_verdict
from log2sim.files.documents import check


def test_a_perfect_reconstruction_has_no_error():
    result = evaluate(world(), world())
    for key in ("recall", "precision", "recall_agents", "precision_agents", "mota", "hota", "det_a", "ass_a"):
        assert result[key] == 1.0, key
    for key in ("position_rmse_m", "position_median_m", "ade_m", "yaw_median_deg", "yaw_flipped", "speed_rmse_mps"):
        assert result[key] == 0.0, key
    assert result["size_median_m"] == 0.0
    assert result["id_switches"] == 0
    assert result["counts"]["truth_ticks"] == 5 * 31
    assert result["ego"] == {"ticks": 31, "position_rmse_m": 0.0, "yaw_median_deg": 0.0, "speed_rmse_mps": 0.0}


def test_a_result_keeps_its_schema_and_prints():
    for ours, truth in ((world(), world()), (scenario(), world()), (world(), scenario()), (scenario(), scenario())):
        result = evaluate(ours, truth)
        check(result, "metrics-1", ScenarioError)
        json.dumps(result, allow_nan=False)
        assert "recall" in format_verdict(result)
        assert ("recall %" in format_table(result)) == (result["recall"] is not None)
    blocks = format_table(evaluate(world(), world())).split("\n\n")
    rows = ["all", "0-20", "20-40", "car", "cyclist", "pedestrian"]
    assert [line.split()[0] for line in blocks[0].splitlines()[1:]] == rows
    lines = blocks[1].splitlines()
    assert [line.split()[0] for line in lines[1:]] == [*rows, "ego"]
    assert len(set(map(len, lines[:-1]))) == 1
    assert lines[1].split() == ["all", "5", "100.0", "100.0", "0.00", "0.00", "0.0", "0.00", "0.00", "1.000", "1.000"]
    shares = next(block for block in blocks if block.startswith("wrong in %")).splitlines()
    assert {"all", "0-15", "15-30"} <= {line.split()[0] for line in shares if line.strip()}


def test_a_known_shift_is_the_position_error_and_the_ego_stands_apart():
    ours = shifted(world(), 0.3, 0.4)
    ours = replace(ours, agents=(moved(world().ego, 1.0), *ours.others))
    result = evaluate(ours, world())
    for key in ("position_rmse_m", "position_median_m", "ade_m"):
        assert result[key] == pytest.approx(0.5, abs=1e-6)
    assert result["ego"]["position_rmse_m"] == pytest.approx(1.0, abs=1e-6)
    assert result["recall"] == 1.0


def test_known_errors_of_size_and_speed():
    truth = scenario(agent("ego", 0.0), agent("a", 10.0, speed=3.0), agent("b", 20.0, speed=1.0))
    ours = scenario(
        agent("ego", 0.0, speed=2.0),
        agent("x", 10.0, speed=3.5, size_m=(4.4 + 0.6, 1.8 - 0.3, 1.5)),
        agent("y", 20.0, speed=1.5, size_m=(4.4, 1.8, 1.5 + 0.9)),
    )
    result = evaluate(ours, truth)
    assert result["speed_rmse_mps"] == pytest.approx(0.5)
    assert result["size_median_m"] == pytest.approx(0.3)
    assert [result[f"{k}_median_m"] for k in ("length", "width", "height")] == pytest.approx([0.3, 0.15, 0.45])
    row = result["agents"][0]
    assert (row["id"], row["matched_ids"], row["length_error_m"], row["width_error_m"]) == ("a", {"x": 31}, 0.6, -0.3)
    assert result["ego"]["speed_rmse_mps"] == pytest.approx(2.0)


def test_a_flipped_box_is_an_error_of_yaw_only():
    truth = scenario(agent("a", 5 * T_S, speed=5.0))
    result = evaluate(scenario(agent("x", 5 * T_S, yaw=-np.pi, speed=-5.0)), truth)
    assert (result["yaw_median_deg"], result["yaw_flipped"], result["speed_rmse_mps"]) == (180.0, 1.0, 0.0)


def test_swapped_identities_are_two_switches():
    half = T_S < 1.5
    truth = scenario(agent("a", 0.0), agent("b", 20.0))
    ours = scenario(agent("x", np.where(half, 0.0, 20.0)), agent("y", np.where(half, 20.0, 0.0)))
    result = evaluate(ours, truth)
    assert (result["id_switches"], result["recall"], result["precision"]) == (2, 1.0, 1.0)
    assert result["mota"] == pytest.approx(1 - 2 / 62, abs=1e-6)
    assert result["det_a"] == 1.0
    assert result["ass_a"] < 0.55


def test_missed_and_false_agents():
    truth = scenario(agent("a", 0.0), agent("b", 20.0))
    ours = scenario(agent("x", 0.0), agent("ghost", 50.0), agent("ghost2", 60.0, t_s=T_S[:5]))
    result = evaluate(ours, truth)
    assert result["recall"] == 0.5
    assert result["precision"] == pytest.approx(31 / 67, abs=1e-6)
    assert result["mota"] == pytest.approx(1 - (31 + 36) / 62, abs=1e-6)
    assert (result["recall_agents"], result["precision_agents"]) == (0.5, pytest.approx(1 / 3, abs=1e-6))
    assert [r["id"] for r in result["false_agents"]] == ["ghost", "ghost2"]


def test_what_is_not_visible_is_neither_missed_nor_false():
    seen = T_S < 1.45  # 15 ticks
    truth = scenario(agent("a", 0.0, visible=seen), agent("hidden", 20.0, visible=False))
    result = evaluate(scenario(agent("x", 0.0), agent("y", 20.0)), truth)
    assert (result["counts"]["truth_ticks"], result["recall"], result["precision"]) == (15, 1.0, 1.0)
    assert result["counts"]["reconstructed_agents"] == 1
    nothing = evaluate(scenario(agent("far", 90.0, visible=None)), truth)
    assert (nothing["counts"]["missed_ticks"], nothing["recall"], nothing["precision"]) == (15, 0.0, 0.0)


@pytest.mark.parametrize(("ticks", "counts"), [(9, 0), (10, 1)])
def test_a_truth_agent_counts_from_one_second_in_total(ticks, counts):
    seen = np.zeros(31, dtype=bool)
    seen[: 2 * ticks : 2] = True  # in pieces
    result = evaluate(
        scenario(agent("x", 0.0)), scenario(agent("a", 0.0, visible=seen), agent("b", 9.0, visible=False))
    )
    assert result["counts"]["truth_agents"] == counts
    assert result["precision"] == (1.0 if counts else None)


def test_truth_at_other_instants_is_interpolated():
    late = T_S + 0.04
    truth = scenario(agent("a", 7 * late, speed=7.0, t_s=late), agent("b", 7 * late, 30.0, speed=7.0, t_s=late))
    ours = scenario(agent("x", 7 * T_S, speed=7.0), agent("y", 7 * T_S, 30.0, speed=7.0))
    result = evaluate(ours, truth)
    assert result["position_rmse_m"] == pytest.approx(0.0, abs=1e-6)
    # The first tick lies before the first label: not counted, not false.
    assert (result["counts"]["truth_ticks"], result["precision"]) == (60, 1.0)


def with_points(a, visible, points):
    return moved(a, visible=np.broadcast_to(visible, T_S.shape), lidar_points=np.broadcast_to(points, T_S.shape) + 0.0)


def test_what_is_labeled_counts_or_has_one_reason_not_to():
    """31 ticks of each: counts, has too few points, is in no picture, is far away, is of another category, is seen too briefly."""
    truth = scenario(
        world().ego,
        with_points(agent("counts", 10.0, 3.0), True, 100),
        with_points(agent("few", 10.0, -6.0), False, np.where(T_S < 1.0, 19, 3)),
        with_points(agent("outside", 20.0, -9.0), False, 20),
        with_points(agent("far", 300.0), True, 100),
        with_points(agent("walker", 5.0, 9.0, category="pedestrian"), True, 100),
        with_points(agent("brief", 25.0, 9.0), T_S < 0.45, 30),
        provenance={"visibility": "computed"},
    )
    ours = scenario(world().ego, agent("x", 10.0, 3.0), agent("y", 10.0, -6.0), agent("z", 300.0))
    result = evaluate(ours, truth, max_range_m=60.0, categories=["vehicle"])
    check(result, "metrics-1", ScenarioError)
    covered = result["coverage"]
    assert (covered["labeled"], covered["counted"]) == (6 * 31, 31)
    assert covered["why_not"] == {
        "other_category": 31, "out_of_range": 31, "few_points": 31, "not_in_picture": 31 + 26, "hidden": 0, "short": 5,
    }  # fmt: skip
    # The LiDAR hits those two that are found, one of them for 10 ticks, and two that are not.
    assert (covered["hit"], covered["hit_matched"]) == (31 + 10 + 31 + 31, 31 + 10)
    assert covered["hit_recall"] == pytest.approx(41 / 103, abs=1e-6)
    assert result["recall"] == 1.0
    assert result["by_category"]["car"]["coverage"] == {
        **covered,
        "labeled": 5 * 31,
        "why_not": {**covered["why_not"], "other_category": 0},
    }
    stated = evaluate(ours, replace(truth, provenance={}), max_range_m=60.0, categories=["vehicle"])["coverage"]
    assert stated["why_not"]["hidden"] == 31 + 31 + 26
    assert (stated["why_not"]["few_points"], stated["hit"]) == (0, covered["hit"])
    plain = evaluate(world(), world())["coverage"]
    assert (plain["labeled"], plain["counted"], plain["hit"], plain["hit_recall"]) == (155, 155, None, None)


def test_points_counted_in_a_label_are_of_its_time_only():
    """Simplification leaves a label a second, or the first and last of what stands; points are known for 0.25 s about each."""
    every_second = agent("a", 0.0, t_s=np.arange(4.0), quality={"waypoints_left_out": 27})
    ends = agent("a", 0.0, t_s=np.array([0.0, 3.0]), static=True)
    for labels, hit in ((every_second, 3 + 5 + 5 + 3), (ends, 3 + 3)):
        truth = scenario(moved(labels, lidar_points=np.full(len(labels.waypoints), 100.0)))
        covered = evaluate(scenario(agent("x", 0.0)), truth)["coverage"]
        assert (covered["labeled"], covered["counted"]) == (31, 31)
        assert (covered["hit"], covered["hit_matched"]) == (hit, hit)


def test_a_truth_in_another_projection_is_reprojected():
    """The scenario in UTM zone 32, its truth on the sphere of KITTI's drives and in zone 33, the headings turned to each grid."""
    from pyproj import Transformer

    zone32 = "+proj=utm +zone=32 +datum=WGS84"
    origin = np.array([620_000.0, 5_400_000.0])
    ours = replace(world(), map=MapFrame(projection=zone32, offset_m=(*origin, 0.0), altitude_m=100.0))
    for other, scale in (("+proj=utm +zone=33 +datum=WGS84", 2e-3), ("+proj=merc +R=6378137 +k_0=0.656", 4e-3)):
        to = Transformer.from_crs(zone32, other, always_xy=True)
        base = np.floor(np.array(to.transform(*origin)) / 1000) * 1000
        far = []
        for a in ours.agents:
            w = a.waypoints
            x, y = np.array(to.transform(w.x_m + origin[0], w.y_m + origin[1])) - base[:, None]
            ahead = (
                np.array(to.transform(w.x_m + origin[0] + np.cos(w.yaw_rad), w.y_m + origin[1] + np.sin(w.yaw_rad)))
                - base[:, None]
            )
            far.append(replace(a, waypoints=replace(w, x_m=x, y_m=y, yaw_rad=np.arctan2(ahead[1] - y, ahead[0] - x))))
        truth = replace(
            ours, agents=tuple(far), map=MapFrame(projection=other, offset_m=(*base, 0.0), altitude_m=100.0)
        )
        for with_ego in (True, False):
            known = truth if with_ego else replace(truth, agents=truth.others)
            result = evaluate(ours, known)
            assert result["placement"]["method"] == "projection"
            assert result["recall"] == result["precision"] == 1.0
            # With the ego the world around it stays rigid, so that both scales differ over the distance, up to 30 m.
            assert result["position_rmse_m"] < (30 * scale if with_ego else 1e-5)
            assert result["yaw_median_deg"] < 0.02
        assert result["placement"]["ego_apart_m"] is None
        assert evaluate(ours, truth)["ego"]["position_rmse_m"] < 1e-5


def test_without_a_georeference_the_truth_goes_where_the_egos_fit():
    """Rotated by 40 degrees and 1 km away; a standing ego has a heading, too."""
    turn = np.radians(40)
    for ego in (world().ego, agent("ego", 3.0, 1.0, yaw=0.3, static=True)):
        ours = scenario(ego, *world().others)
        far = []
        for a in ours.agents:
            w = a.waypoints
            x, y = np.cos(turn) * w.x_m - np.sin(turn) * w.y_m, np.sin(turn) * w.x_m + np.cos(turn) * w.y_m
            far.append(
                replace(a, waypoints=replace(w, x_m=x + 1000, y_m=y - 500, z_m=w.z_m + 7, yaw_rad=w.yaw_rad + turn))
            )
        result = evaluate(ours, replace(ours, agents=tuple(far), map=MapFrame(projection="+proj=utm +zone=33")))
        assert result["placement"]["method"] == "ego_path"
        assert result["placement"]["ego_apart_m"] < 1e-6
        assert result["position_rmse_m"] < 1e-6
        assert result["yaw_median_deg"] < 1e-6
    # Maps of one projection stay: a wrong pose is an error.
    assert evaluate(shifted(world(), 5.0), world())["placement"] == {"method": "ego_path", "ego_apart_m": 0.0}
    utm = MapFrame(projection="+proj=utm +zone=33")
    same = evaluate(replace(shifted(world(), 5.0), map=utm), replace(world(), map=utm))
    assert same["placement"] == {"method": "same_map", "ego_apart_m": 5.0}
