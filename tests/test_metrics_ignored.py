"""Where labels may be incomplete, a reconstructed agent is neither right nor false, and nowhere else."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from worlds import tiny_log

from log2sim.datatypes import Agent, IgnoreRegions, ImageRegions, LabelView, MapFrame, Scenario, Waypoints
from log2sim.errors import LogError, ScenarioError
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.evaluation.metrics.truth import ignore_regions_of, truth_from_log
from log2sim.files.documents import check
from log2sim.geometry import Camera, box_corners, transform
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
EVERYWHERE = [0, 0, WIDTH, HEIGHT]


def agent(id, x, y=0.0, z=EYE_M, t_s=T_S, category="car", size_m=CAR):
    n = len(t_s)
    columns = [np.broadcast_to(np.asarray(v, dtype=float), n).copy() for v in (x, y, z, 0.0, 0.0)]
    return Agent(id, category, size_m, Waypoints(t_s, *columns, np.ones(n, dtype=bool), np.zeros(n)))


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


def grown(box, by_px=2.0):
    return np.asarray(box) + by_px * np.array([-1, -1, 1, 1])


def part(box, left, right):
    """The part of a box between two shares of its width."""
    u0, v0, u1, v1 = box
    return [u0 + left * (u1 - u0), v0, u0 + right * (u1 - u0), v1]


def counts(ours, truth, **kwargs):
    result = evaluate(ours, truth, **kwargs)
    check(result, "metrics-1", ScenarioError)
    return result, result["counts"]["false_ticks"], result["counts"]["ignored_ticks"]


def one(x=20.0, y=0.0):
    """A labeled car that is found, and a car without label at (x, y)."""
    return scenario(agent("a", 30.0, 10.0), agent("ghost", x, y))


TRUTH = scenario(agent("a", 30.0, 10.0))


def truth_with(*views, outside=False):
    return replace(TRUTH, ignore_regions=IgnoreRegions(tuple(views), outside))


def test_only_the_agent_in_a_region_is_ignored():
    ours = scenario(agent("a", 30.0, 10.0), agent("in", 20.0), agent("out", 20.0, -6.0))
    truth = truth_with(view([grown(front_face_px(20.0))]))
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
    _, false, left_out = counts(one(), truth_with(view([part(box, *p) for p in parts])))
    assert (false, left_out) == ((0, 21) if ignored else (21, 0))


def test_an_agent_matched_with_truth_in_a_region_is_right_and_a_missed_one_is_missed():
    truth = truth_with(view([EVERYWHERE]), outside=True)
    result, false, ignored = counts(TRUTH, truth)
    assert (result["recall"], result["precision"], false, ignored) == (1.0, 1.0, 0, 0)
    result, _, _ = counts(scenario(agent("ghost", 20.0)), truth)
    assert (result["recall"], result["counts"]["missed_ticks"]) == (0.0, 21)


def test_a_match_across_categories_is_not_ignored():
    """What a label of another group explains was never false, so there is nothing to ignore."""
    ours = scenario(agent("p", 30.0, 10.0, category="pedestrian"))
    _, false, ignored = counts(ours, truth_with(view([EVERYWHERE])))
    assert (false, ignored) == (0, 0)


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


def test_only_logs_labeled_by_camera_ignore_what_no_camera_shows():
    behind = one(-20.0)
    assert counts(behind, truth_with(view()))[1:] == (21, 0)
    assert counts(behind, truth_with(view(), outside=True))[1:] == (0, 21)
    assert counts(one(), truth_with(view(), outside=True))[1:] == (21, 0)
    assert counts(behind, truth_with(outside=True))[1:] == (0, 21)


def test_what_is_in_the_ego_is_invented_even_where_no_camera_shows_it():
    ego = agent("ego", -20.0)
    truth = replace(scenario(ego, agent("a", 30.0, 10.0)), ignore_regions=IgnoreRegions((view(),), outside_views=True))
    ours = scenario(ego, agent("a", 30.0, 10.0), agent("behind", -30.0), agent("phantom", -21.0, 0.5))
    found, false, ignored = counts(ours, truth)
    assert (false, ignored) == (0, 42)
    judged = found["correctness"]
    assert (judged["invented"]["ticks"], judged["in_ego"]["ticks"], judged["undecided_ticks"]) == (21, 21, 21)
    assert [row["id"] for row in judged["judged_agents"]] == ["a", "phantom"]


def test_an_agent_that_a_camera_shows_in_part_is_in_its_view():
    # The view is 45 degrees to each side. At y = 22 the car's right rear corner alone is inside it.
    assert counts(one(20.0, 22.0), truth_with(view(), outside=True))[1:] == (21, 0)
    assert counts(one(20.0, 23.1), truth_with(view(), outside=True))[1:] == (0, 21)
    # Beside the camera and reaching a little into the view: its outline at depth 1 is many views wide.
    assert counts(one(1.2, 2.0), truth_with(view(), outside=True))[1:] == (21, 0)
    assert counts(one(-1.2, 2.0), truth_with(view(), outside=True))[1:] == (0, 21)


@pytest.mark.parametrize(
    ("k1", "slope", "seen"), [(0.0, 0.95, True), (0.2, 0.95, False), (0.0, 1.05, False), (-0.2, 1.05, True)]
)
def test_a_lens_bends_what_is_in_view(k1, slope, seen):
    """The right rear corner's ray is at slope (1 + k1 slope^2) times the focal length; the image ends at once."""
    lens = replace(CAMERA, distortion_model="brown", distortion=(k1, 0.0, 0.0, 0.0))
    aside = one(20.0, 22.0 * slope + 1.0)
    assert counts(aside, truth_with(view(camera=lens), outside=True))[1:] == ((21, 0) if seen else (0, 21))


def test_one_camera_that_could_tell_outweighs_one_that_could_not():
    hidden, clear = view([EVERYWHERE]), view(camera=replace(CAMERA, name="second"))
    assert counts(one(), truth_with(hidden))[1:] == (0, 21)
    assert counts(one(), truth_with(hidden, clear))[1:] == (21, 0)
    assert counts(one(), truth_with(clear, hidden))[1:] == (21, 0)
    away = view(wxyz=np.array([0.5, -0.5, -0.5, 0.5]), camera=replace(CAMERA, name="rear"))
    assert counts(one(), truth_with(hidden, away, outside=True))[1:] == (0, 21)


def test_a_region_holds_for_its_own_frames():
    _, false, ignored = counts(one(), truth_with(view([EVERYWHERE], frames=range(5, 12))))
    assert (false, ignored) == (14, 7)


def test_without_a_frame_nothing_was_labeled_then():
    early = view(t_s=T_S[:11])
    # Ticks up to 0.15 s after the last frame still belong to it.
    assert counts(one(), truth_with(early, outside=True))[1:] == (12, 9)
    assert counts(one(), truth_with(view([EVERYWHERE], t_s=T_S[:11])))[1:] == (9, 12)


def test_between_frames_the_camera_is_where_it_was_then():
    """The camera drives at 30 m/s beside a car, with a frame every 0.2 s; the region fits the interpolated pose only.

    A frame's way behind, the side of the car next to its near end is where the region ends.
    """
    x = 30 * T_S
    every = slice(None, None, 2)
    position = np.stack([x, 0 * x, np.full(21, EYE_M)], axis=1)[every]
    region = grown(front_face_px(8.0, 3.0))
    ours = scenario(agent("a", 30.0, 10.0), agent("ghost", 8.0 + x, 3.0))
    _, false, ignored = counts(ours, truth_with(view([region], T_S[every], position)))
    assert (false, ignored) == (0, 21)


def test_start_and_offset_of_the_truth_do_not_matter():
    shift = np.array([3000.0, -7000.0, 100.0])
    moved_agents = tuple(
        replace(
            a,
            waypoints=replace(
                a.waypoints,
                t_s=a.waypoints.t_s + 5,
                x_m=a.waypoints.x_m - shift[0],
                y_m=a.waypoints.y_m - shift[1],
                z_m=a.waypoints.z_m - shift[2],
            ),
        )
        for a in TRUTH.agents
    )
    seen = view([grown(front_face_px(20.0))], T_S + 5, np.array([0, 0, EYE_M]) - shift)
    truth = Scenario(
        name="t",
        t0_ns=-5_000_000_000,
        duration_s=7.0,
        agents=moved_agents,
        map=MapFrame(offset_m=tuple(shift.tolist())),
        ignore_regions=IgnoreRegions((seen,), False),
    )
    assert counts(one(), truth)[1:] == (0, 21)
    assert counts(one(20.0, 5.0), truth)[1:] == (21, 0)


def painted_share(center, size, regions):
    """Share of the outline of a box ahead, painted pixel by pixel, that lies in regions; None where the image has none."""
    import cv2

    corners = box_corners(center[None], size[None], np.zeros(1))[0]
    if corners[:, 0].min() < 0.2:
        return None if corners[:, 0].max() < 0.1 else np.nan
    uv = np.stack([WIDTH / 2 - FOCAL * corners[:, 1], HEIGHT / 2 - FOCAL * (corners[:, 2] - EYE_M)], 1) / corners[:, :1]
    uv += np.array([WIDTH / 2, HEIGHT / 2]) * (1 - 1 / corners[:, :1])
    canvas = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    cv2.fillConvexPoly(canvas, cv2.convexHull(np.round(uv).astype(np.int32)), 1)
    if not canvas.any():
        return None
    inside = np.zeros_like(canvas)
    for u0, v0, u1, v1 in np.asarray(regions).astype(int):
        inside[v0:v1, u0:u1] = 1
    return float(inside[canvas > 0].mean())


@pytest.mark.slow
def test_random_worlds_against_painted_pixels():
    rng = np.random.default_rng(7)
    told = np.zeros(3, dtype=int)
    for _ in range(12):
        center = rng.uniform([-10, -25, 0.5], [45, 25, 2.0], (25, 3))
        size = rng.uniform([1, 0.5, 1], [10, 2.5, 3], (25, 3))
        low = rng.uniform([0, 80], [600, 200], (6, 2))
        regions = np.hstack([low, low + rng.uniform([40, 30], [250, 150], (6, 2))])
        ghosts = [agent(str(k), *c, size_m=tuple(s)) for k, (c, s) in enumerate(zip(center, size))]
        truth = scenario(agent("far", 900.0), ignore_regions=IgnoreRegions((view(regions.round()),), True))
        result, false, ignored = counts(scenario(*ghosts), truth)
        assert false + ignored == 25 * 21
        found = {row["id"] for row in result["ignored_agents"]}
        for k in range(25):
            share = painted_share(center[k], size[k], regions.round())
            if share is None or abs(share - 0.5) > 0.05:
                assert (str(k) in found) == (share is None or share > 0.5), (center[k], size[k], share)
                told += [share is None, share is not None and share > 0.5, share is not None and share < 0.5]
    assert told.min() > 20


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


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"t_s": [0.0]}, "1 stamps, 21 translations"),
        ({"t_s": [0.0, *[1.0] * 20]}, "t_s does not increase at index 2"),
        ({"region_frame": [21], "region_px": [[0, 0, 1, 1]]}, "region_frame"),
        ({"region_frame": [0, 1]}, "region_frame"),
        ({"region_frame": [-1]}, "region_frame"),
        ({"rotation_wxyz": [[2, 0, 0, 0]] * 21}, "unit quaternions"),
        ({"camera": 3}, "camera"),
    ],
)
def test_views_that_make_no_sense_are_refused(change, words):
    document = truth_with(view()).to_dict()
    document["unlabeled"]["views"][0].update(change)
    with pytest.raises(ScenarioError, match=words) as caught:
        Scenario.from_dict(document)
    assert "unlabeled.views[0]" in str(caught.value)


def labeled_by_camera(log, t_ns, boxes, cameras=("front",)):
    return replace(
        log,
        labels=replace(log.labels, cameras=cameras),
        ignored_regions={"front": ImageRegions(np.asarray(t_ns, dtype=np.int64), np.asarray(boxes, dtype=float))},
    )


def test_a_log_hands_its_regions_to_the_truth():
    log, _ = tiny_log()
    t_ns = log.streams["front"].t_ns
    # The second stamp is 2 ms off its frame, the third is of no frame.
    log = labeled_by_camera(
        log, [t_ns[0], t_ns[4] + 2_000_000, t_ns[-1] + 10**9], [[0, 0, 9, 9], [1, 1, 8, 8], EVERYWHERE]
    )
    truth = truth_from_log(log)
    (seen,) = truth.ignore_regions.views
    assert truth.ignore_regions.outside_views
    assert seen.region_frame.tolist() == [0, 4]
    assert seen.region_px.tolist() == [[0, 0, 9, 9], [1, 1, 8, 8]]
    np.testing.assert_array_equal(np.round(seen.t_s * 1e9).astype(np.int64) + truth.t0_ns, t_ns)
    np.testing.assert_allclose(seen.map_T_cam, log.map_T_sensor("front", t_ns)[0], atol=1e-9)
    all_around = replace(log, labels=replace(log.labels, cameras=None))
    assert not ignore_regions_of(all_around, 0).outside_views
    plain = replace(all_around, ignored_regions={})
    assert ignore_regions_of(plain, 0) is None
    partly = replace(plain, labels=replace(plain.labels, never_labeled=("bicycle",)))
    regions = ignore_regions_of(partly, 0)
    assert (regions.views, regions.outside_views, regions.categories) == ((), False, ("bicycle",))
    with pytest.raises(LogError, match=r"labels are of camera 'fronr'.*there are: front"):
        ignore_regions_of(labeled_by_camera(log, t_ns[:1], [EVERYWHERE], ("fronr",)), 0)


def test_a_native_log_keeps_its_regions_and_names_what_is_wrong(tmp_path):
    log, _ = tiny_log(duration_s=0.2)
    log = labeled_by_camera(log, log.streams["front"].t_ns[[0, 1]], [[0.5, 1, 20, 30], [4, 5, 60, 70]])
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


def test_the_rotation_of_the_test_camera_looks_ahead():
    pose = view().map_T_cam[0]
    expected = transform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), [0, 0, EYE_M])
    np.testing.assert_allclose(pose, expected, atol=1e-12)
