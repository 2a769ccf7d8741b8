"""Where labels may be incomplete, a reconstructed agent is neither right nor false, and nowhere else."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from worlds import tiny_log, waypoints

from log2sim.datatypes import Agent, IgnoreRegions, ImageRegions, LabelView, Scenario
from log2sim.errors import LogError, ScenarioError
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.files.documents import check
from log2sim.geometry import Camera
from log2sim.logs.native.writer import write_log
from log2sim.logs.opening import open_log

T_S = np.arange(21) / 10
CAR = (4.0, 2.0, 1.5)
WIDTH, HEIGHT, FOCAL = 800, 400, 400.0
EYE_M = 1.5
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
CAMERA = Camera("front", WIDTH, HEIGHT, K, "map", np.eye(4))
AHEAD_WXYZ = np.array([0.5, -0.5, 0.5, -0.5])
"""The camera's z along the map's x, its x along the map's -y."""


def agent(id, x, y=0.0, z=EYE_M, t_s=T_S, category="car", size_m=CAR):
    return Agent(id, category, size_m, waypoints(t_s, x, y, z, sigma_m=0.0))


def scenario(*agents, **kwargs):
    return Scenario(**{"name": "s", "t0_ns": 0, "duration_s": 2.0, "agents": agents, **kwargs})


def view(regions=(), t_s=T_S, position=(0.0, 0.0, EYE_M), wxyz=AHEAD_WXYZ, frames=None, camera=CAMERA):
    """A camera that looks along the map's x, with the same regions in every frame (or those of `frames` alone)."""
    frames = range(len(t_s)) if frames is None else frames
    pairs = [(k, box) for k in frames for box in regions]
    return LabelView(
        camera,
        t_s,
        np.broadcast_to(np.asarray(position, dtype=float), (len(t_s), 3)).copy(),
        np.tile(wxyz, (len(t_s), 1)),
        np.array([k for k, _ in pairs], dtype=np.int64),
        np.array([box for _, box in pairs], dtype=np.float64).reshape(-1, 4),
    )


def front_face_px(x, y=0.0):
    """u0, v0, u1, v1 of the near side of a car ahead at eye level, which hides the rest of it where y is 0."""
    depth = x - CAR[0] / 2
    u, v = WIDTH / 2 - FOCAL * y / depth, HEIGHT / 2
    return np.array([u - FOCAL / depth, v - 0.75 * FOCAL / depth, u + FOCAL / depth, v + 0.75 * FOCAL / depth])


def part(box, left, right):
    """The part of a box between two shares of its width."""
    u0, v0, u1, v1 = box
    return [u0 + left * (u1 - u0), v0, u0 + right * (u1 - u0), v1]


def counts(ours, truth, **kwargs):
    result = evaluate(ours, truth, **kwargs)
    check(result, "metrics-1", ScenarioError)
    return result, result["counts"]["false_ticks"], result["counts"]["ignored_ticks"]


TRUTH = scenario(agent("a", 30.0, 10.0))


def truth_with(*views, outside=False):
    return replace(TRUTH, ignore_regions=IgnoreRegions(tuple(views), outside))


def test_only_the_agent_in_a_region_is_ignored():
    ours = scenario(agent("a", 30.0, 10.0), agent("in", 20.0), agent("out", 20.0, -6.0))
    truth = truth_with(view([front_face_px(20.0) + 2.0 * np.array([-1, -1, 1, 1])]))
    plain, false, ignored = counts(ours, TRUTH)
    assert (false, ignored, plain["precision"]) == (42, 0, pytest.approx(1 / 3, abs=1e-6))
    result, false, ignored = counts(ours, truth)
    assert (false, ignored, result["precision"]) == (21, 21, 0.5)
    assert [row["id"] for row in result["false_agents"]] == ["out"]
    assert [(row["id"], row["ignored_ticks"]) for row in result["ignored_agents"]] == [("in", 21)]
    assert result["mota"] == pytest.approx(0.0)
    assert plain["mota"] == pytest.approx(-1.0)
    assert result["hota"] == pytest.approx(np.sqrt(0.5), abs=1e-6)
    assert result["recall"] == plain["recall"] == 1.0
    assert "outline" in result["counting"]["ignored"]
    found = result["correctness"]
    assert (found["ticks"], found["undecided_ticks"], found["invented"]["ticks"]) == (42, 21, 21)
    assert [row["id"] for row in found["judged_agents"]] == ["a", "out"]


@pytest.mark.parametrize(
    ("parts", "ignored"),
    [
        ([(0.0, 0.45)], False),
        ([(0.0, 0.55)], True),
        ([(0.0, 0.3), (0.7, 1.0)], True),
        # Twice the same third is a third.
        ([(0.0, 0.35), (0.02, 0.37)], False),
        ([], False),
    ],
)
def test_half_of_the_outline_must_lie_in_the_union_of_the_regions(parts, ignored):
    box = front_face_px(20.0)
    ours = scenario(agent("a", 30.0, 10.0), agent("ghost", 20.0))  # which has no label
    _, false, left_out = counts(ours, truth_with(view([part(box, *p) for p in parts])))
    assert (false, left_out) == ((0, 21) if ignored else (21, 0))


def test_what_is_never_labeled_is_ignored_unless_it_matches_a_label():
    def kinds(category):
        return scenario(
            agent("a", 30.0, 10.0), agent("x", 20.0, category=category), agent("y", 10.0, category="bicycle")
        )

    rider = agent("rider", 10.0, category="cyclist")
    truth = scenario(agent("a", 30.0, 10.0), rider, ignore_regions=IgnoreRegions((), False, ("bicycle",)))
    found, false, ignored = counts(kinds("bicycle"), truth)
    assert (false, ignored, found["precision"]) == (0, 21, 1.0)
    assert found["correctness"]["undecided_ticks"] == 21
    assert counts(kinds("motorcycle"), truth)[1:] == (21, 0)
    assert counts(kinds("bicycle"), replace(truth, ignore_regions=None))[1:] == (21, 0)


def test_a_truth_file_keeps_its_views(tmp_path):
    rng = np.random.default_rng(3)
    q = rng.normal(size=(21, 4))
    lens = replace(CAMERA, distortion_model="brown", distortion=(0.1, -0.01, 0.001, 0.002))
    seen = replace(view([[1.5, 2, 30, 40]], camera=lens), rotation_wxyz=q / np.linalg.norm(q, axis=1)[:, None])
    truth = truth_with(seen, view(), outside=True)
    truth = replace(truth, ignore_regions=replace(truth.ignore_regions, categories=("bicycle",)))
    truth.save(tmp_path / "truth.json")
    again = Scenario.load(tmp_path / "truth.json")
    assert again.to_dict() == truth.to_dict()
    assert again.ignore_regions.views[0].camera.distortion == lens.distortion
    np.testing.assert_array_equal(again.ignore_regions.views[0].map_T_cam, seen.map_T_cam)
    TRUTH.save(tmp_path / "plain.json")
    assert "unlabeled" not in json.loads((tmp_path / "plain.json").read_text())


def test_a_native_log_keeps_its_regions_and_names_what_is_wrong(tmp_path):
    log, _ = tiny_log(duration_s=0.2)
    regions = ImageRegions(log.streams["front"].t_ns[:2], np.array([[0.5, 1, 20, 30], [4, 5, 60, 70]]))
    log = replace(log, labels=replace(log.labels, cameras=("front",)), ignored_regions={"front": regions})
    write_log(log, tmp_path / "log")
    again = open_log(tmp_path / "log")
    assert again.labels.cameras == ("front",)
    for column in ("t_ns", "box_px"):
        expected = getattr(log.ignored_regions["front"], column)
        np.testing.assert_array_equal(getattr(again.ignored_regions["front"], column), expected)
    table, manifest = tmp_path / "log/labels/ignored_2d.csv", tmp_path / "log/log.json"
    text = table.read_text()
    table.write_text(text.replace("60.0,70.0", "60.0,5.0"))
    with pytest.raises(LogError, match=r"ignored_2d.csv, line 3, field 'u1_px,v1_px'.*empty"):
        open_log(tmp_path / "log")
    table.write_text(text.replace(",front,", ",back,"))
    with pytest.raises(LogError, match=r"ignored_2d.csv, line 2, field 'camera': no camera 'back'"):
        open_log(tmp_path / "log")
    table.write_text(text)
    document = json.loads(manifest.read_text())
    document["labels"]["cameras"] = ["rear"]
    manifest.write_text(json.dumps(document))
    with pytest.raises(LogError, match=r"field 'labels.cameras': no camera 'rear'"):
        open_log(tmp_path / "log")
