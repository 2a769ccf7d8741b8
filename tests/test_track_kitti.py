"""The tracker on the KITTI tracking benchmark: formats, frames, causality, and scores against second methods."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tools"))

import evaluate_kitti  # noqa: E402
import track_kitti  # noqa: E402
from conftest import SHARED  # noqa: E402
from evaluate_kitti import evaluate, recall_thresholds  # noqa: E402
from fits import kitti as fit_kitti  # noqa: E402
from kitti.boxes import (  # noqa: E402
    Boxes,
    Rows,
    overlap_3d,
    read_detections,
    read_tracks,
    write_tracks,
)
from kitti.choice import find_pairs, join_tracks, labeled_probability  # noqa: E402
from kitti.map import EGO_R_CAM, View, from_map, hidden_share, read_view, to_measurements  # noqa: E402
from kitti_crowd import walking_crowd  # noqa: E402

from log2sim.errors import LogError  # noqa: E402
from log2sim.geometry import bev_iou, box_corners_bev, rotation_from_rpy, transform  # noqa: E402

pytestmark = pytest.mark.slow

P = np.array([[720.0, 0.0, 610.0, 0.0], [0.0, 720.0, 173.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
KITTI = SHARED / "data" / "kitti_tracking"
CAR, PERSON = (1.5, 1.6, 4.0), (1.7, 0.6, 0.6)


def boxes(
    frame: object, xz: object, *, track: object = 0, score: object = 6.0, category: str = "Car", yaw: object = -1.57,
    size: tuple[float, float, float] = CAR, height_px: float = 60.0,
) -> Boxes:  # fmt: skip
    """Boxes on a flat road at places (N, 2) x, z of the camera."""
    frame, xz = np.atleast_1d(np.asarray(frame, dtype=np.int64)), np.asarray(xz, dtype=float).reshape(-1, 2)
    n = len(frame)
    u = 610 + 720 * xz[:, 0] / np.maximum(xz[:, 1], 1)
    return Boxes(
        frame=frame, track_id=np.broadcast_to(np.asarray(track, dtype=np.int64), n).copy(),
        category=np.full(n, category, dtype="<U16"), truncation=np.zeros(n), occlusion=np.zeros(n), alpha=np.zeros(n),
        box_px=np.column_stack([u - 20, np.full(n, 170.0), u + 20, np.full(n, 170.0 + height_px)]),
        size_hwl_m=np.tile(size, (n, 1)), bottom_m=np.column_stack([xz[:, 0], np.full(n, 1.7), xz[:, 1]]),
        yaw_rad=np.broadcast_to(np.asarray(yaw, dtype=float), n).copy(),
        score=np.broadcast_to(np.asarray(score, dtype=float), n).copy(),
    )  # fmt: skip


def standing_view(frames: int) -> View:
    return View(np.repeat(transform(EGO_R_CAM, np.zeros(3))[None], frames, axis=0), P)


def random_boxes(count: int, seed: int) -> Boxes:
    rng = np.random.default_rng(seed)
    b = boxes(
        np.zeros(count), rng.uniform(-2, 2, (count, 2)) + np.array([0, 20]), yaw=rng.uniform(-np.pi, np.pi, count)
    )
    return replace(
        b, size_hwl_m=rng.uniform(0.5, 4, (count, 3)), bottom_m=b.bottom_m + rng.uniform(-0.5, 0.5, (count, 3))
    )


# ---- formats and geometry


def test_results_survive_the_round_trip(tmp_path: Path) -> None:
    made = random_boxes(20, 0)
    made = replace(made, frame=np.arange(20) // 3, track_id=np.arange(20), score=np.linspace(-3, 9, 20))
    write_tracks(tmp_path / "0001.txt", made)
    back = read_tracks(tmp_path / "0001.txt")
    for name, column in vars(made).items():
        if name == "category":
            assert getattr(back, name).tolist() == column.tolist()
        else:
            np.testing.assert_allclose(getattr(back, name), column, atol=1e-6)
    assert all(len(line.split()) == 18 for line in (tmp_path / "0001.txt").read_text().splitlines())


def test_detections_are_read_by_their_columns(tmp_path: Path) -> None:
    path = tmp_path / "0000.txt"
    path.write_text(
        "3,2,10,20,30,40,8.5,1.5,1.6,3.9,-4,1.8,13,-2.1,-1.7\n4 1 10 20 30 40 0.5 1.7 0.6 0.7 1 1.8 9 0 0\n"
    )
    b = read_detections(path)
    assert (b.frame.tolist(), b.category.tolist(), b.score.tolist()) == ([3, 4], ["Car", "Pedestrian"], [8.5, 0.5])
    np.testing.assert_array_equal(b.size_hwl_m[0], [1.5, 1.6, 3.9])
    np.testing.assert_array_equal(b.bottom_m[0], [-4, 1.8, 13])
    assert (b.yaw_rad[0], b.alpha[0], b.box_px[0].tolist()) == (-2.1, -1.7, [10, 20, 30, 40])


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("1,2,3", "3 columns, expected 15"),
        ("0,2,1,1,2,2,nan,1,1,1,0,0,9,0,0", "finite"),
        ("0,7,1,1,2,2,5,1,1,1,0,0,9,0,0", "type 7"),
        ("0,2,1,1,2,2,x,1,1,1,0,0,9,0,0", "expected 15 numbers"),
        ("1e12,2,1,1,2,2,5,1,1,1,0,0,9,0,0", "frame"),
        ("0,2,1,1,2,2,5,1,0,1,0,0,9,0,0", "sizes greater than 0"),
    ],
)
def test_spoiled_detections_are_refused_with_their_place(tmp_path: Path, line: str, complaint: str) -> None:
    path = tmp_path / "0000.txt"
    path.write_text(line + "\n")
    with pytest.raises(LogError, match=complaint) as caught:
        read_detections(path)
    assert "0000.txt" in str(caught.value)


def test_overlap_in_3d_is_that_of_polygon_clipping() -> None:
    a, b = random_boxes(300, 1), random_boxes(300, 2)
    found = overlap_3d(a, b)
    assert (found > 0.02).sum() > 100
    for k in range(300):
        p, q = (
            box_corners_bev(c.bottom_m[k, [0, 2]], c.size_hwl_m[k, 2], c.size_hwl_m[k, 1], -c.yaw_rad[k])[0]
            for c in (a, b)
        )
        flat = bev_iou(p, q)
        area = [c.size_hwl_m[k, 1] * c.size_hwl_m[k, 2] for c in (a, b)]
        common = flat * sum(area) / (1 + flat)
        top, low = (f([c.bottom_m[k, 1] - h * c.size_hwl_m[k, 0] for c in (a, b)]) for f, h in ((max, 1), (min, 0)))
        volume = common * max(low - top, 0)
        assert found[k] == pytest.approx(volume / (sum(c.size_hwl_m[k].prod() for c in (a, b)) - volume), abs=1e-9)


@pytest.mark.parametrize("turn", [0.0, 0.3, np.pi / 2, -np.pi])
def test_overlap_of_equal_shifted_and_separate_boxes(turn: float) -> None:
    one = boxes(0, (0, 20), yaw=turn)
    assert overlap_3d(one, one)[0] == pytest.approx(1)
    along = np.array([np.cos(turn), 0, -np.sin(turn)])
    # A quarter of the length along: three quarters in common of five quarters together.
    assert overlap_3d(one, replace(one, bottom_m=one.bottom_m + along))[0] == pytest.approx(3 / 5)
    assert overlap_3d(one, replace(one, bottom_m=one.bottom_m + np.array([0, 0.75, 0])))[0] == pytest.approx(1 / 3)
    assert overlap_3d(one, replace(one, bottom_m=one.bottom_m + 4.1 * along))[0] == 0


def test_boxes_go_to_the_map_and_back() -> None:
    rng = np.random.default_rng(3)
    poses = transform(
        rotation_from_rpy(*rng.uniform(-0.02, 0.02, (2, 40)), rng.uniform(-3, 3, 40)), rng.uniform(-50, 50, (40, 3))
    )
    view = View(poses @ transform(EGO_R_CAM, np.zeros(3)), P)
    made = replace(random_boxes(40, 4), frame=np.arange(40))
    m = to_measurements(made, view)
    size = [np.column_stack([k.high_m - k.low_m, k.top_m - k.bottom_m]) for k in m]
    back = [from_map(k.center_m, size[i], k.yaw_rad, np.array([i]), view) for i, k in enumerate(m)]
    np.testing.assert_allclose(np.concatenate([b["bottom_m"] for b in back]), made.bottom_m, atol=0.1)
    np.testing.assert_allclose(np.concatenate([b["size_hwl_m"] for b in back]), made.size_hwl_m)
    difference = np.concatenate([b["yaw_rad"] for b in back]) - made.yaw_rad
    # Upright in the map is up to 0.02 rad of roll and pitch off upright in the camera.
    np.testing.assert_allclose(np.cos(difference), 1, atol=1e-3)


def test_a_hidden_share_is_the_part_behind_what_is_nearer() -> None:
    row = boxes([0, 0, 0, 1], [(0, 10), (0, 20), (8, 20), (0, 30)])
    row = replace(row, box_px=np.array([[0, 0, 50, 80], [0, 0, 100, 80], [200, 0, 300, 80], [0, 0, 50, 80.0]]))
    np.testing.assert_allclose(hidden_share(row, 2), [0, 0.5, 0, 0])


# ---- ego motion


def drive(folder: Path, speed_mps: float, frames: int) -> tuple[Path, Path]:
    """Calibration and ego motion of a car that drives straight on."""
    calib, motion = folder / "calib", folder / "ego_motion"
    calib.mkdir()
    motion.mkdir()
    rows = {"P2": P, "R0_rect": np.eye(3)}
    # Velodyne and IMU on the same axes: x forward, y left, z up.
    rows |= {"Tr_velo_to_cam": np.column_stack([EGO_R_CAM.T, [0, 0, 0]]), "Tr_imu_to_velo": np.eye(4)[:3]}
    lines = [f"{k}: " + " ".join(f"{v:.9g}" for v in np.ravel(m)) for k, m in rows.items()]
    (calib / "0000.txt").write_text("\n".join(lines) + "\n")
    poses = [f"{0.05 * k} {0.1 * speed_mps * k} 0 0 0 0 0 1" for k in range(frames)]
    (motion / "0000.txt").write_text("\n".join(poses) + "\n")
    return calib, motion


def write_detections(path: Path, b: Boxes) -> None:
    path.parent.mkdir(parents=True)
    number = {name: k for k, name in {1: "Pedestrian", 2: "Car", 3: "Cyclist"}.items()}
    rows = [
        [
            b.frame[k],
            number[str(b.category[k])],
            *b.box_px[k],
            b.score[k],
            *b.size_hwl_m[k],
            *b.bottom_m[k],
            b.yaw_rad[k],
            0,
        ]
        for k in range(len(b))
    ]
    path.write_text("".join(",".join(f"{v:.6f}" for v in row) + "\n" for row in rows).replace(".000000,", ","))


def test_with_ego_motion_what_stands_stays_where_it_is_in_the_map(tmp_path: Path) -> None:
    calib, motion = drive(tmp_path, speed_mps=20.0, frames=10)
    frame = np.arange(10)
    parked = boxes(frame, np.column_stack([np.full(10, 4.0), 40.0 - 2.0 * frame]))
    centers = np.concatenate(
        [m.center_m for m in to_measurements(parked, read_view(calib / "0000.txt", motion / "0000.txt", 10))]
    )
    np.testing.assert_allclose(centers, np.tile([40.0, -4.0, -1.7 + 0.75], (10, 1)), atol=1e-9)
    relative = np.concatenate([m.center_m for m in to_measurements(parked, read_view(calib / "0000.txt", None, 10))])
    np.testing.assert_allclose(relative[:, 0], 40.0 - 2.0 * frame, atol=1e-9)


@pytest.mark.parametrize("online", [True, False])
def test_without_ego_motion_it_says_so_and_tracks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], online: bool
) -> None:
    calib, motion = drive(tmp_path, speed_mps=20.0, frames=20)
    frame = np.repeat(np.arange(20), 2)
    xz = np.column_stack([np.where(np.arange(40) % 2, 4.0, -4.0), 60.0 - 2.0 * frame])
    write_detections(tmp_path / "detections" / "0000.txt", boxes(frame, xz))
    arguments = ["--detections", str(tmp_path / "detections"), "--calib", str(calib), "--out", str(tmp_path / "out")]
    mode = ["--online"] if online else []
    assert track_kitti.main([*arguments, *mode]) == 0
    assert "its motion is not known" in capsys.readouterr().out
    without = read_tracks(tmp_path / "out" / "0000.txt")
    assert track_kitti.main([*arguments, *mode, "--ego-motion", str(motion)]) == 0
    assert "map frame" in capsys.readouterr().out
    for tracks in (without, read_tracks(tmp_path / "out" / "0000.txt")):
        assert len(np.unique(tracks.track_id)) == 2
        for number in np.unique(tracks.track_id):
            assert len(np.unique(np.sign(tracks.bottom_m[tracks.track_id == number, 0]))) == 1


def test_ego_motion_that_ends_too_early_is_refused(tmp_path: Path) -> None:
    calib, motion = drive(tmp_path, speed_mps=5.0, frames=8)
    with pytest.raises(LogError, match="8 poses, expected one for each of 9 frames"):
        read_view(calib / "0000.txt", motion / "0000.txt", 9)
    (motion / "0000.txt").write_text("0 0 0 0 0 0 0 2\n")
    with pytest.raises(LogError, match="length 1"):
        read_view(calib / "0000.txt", motion / "0000.txt", 1)
    assert track_kitti.main(["--detections", str(tmp_path), "--calib", str(calib), "--out", str(tmp_path / "out")]) == 3


# ---- tracking


def crowd(frames: int, seed: int) -> Boxes:
    """Cars and false alarms in a scene with detections missing now and then."""
    rng = np.random.default_rng(seed)
    frame = np.repeat(np.arange(frames), 6)
    start, speed = rng.uniform([-12, 15], [12, 45], (6, 2)), rng.uniform(-0.4, 0.4, (6, 2))
    xz = (start[None] + np.arange(frames)[:, None, None] * speed[None]).reshape(-1, 2) + rng.normal(
        0, 0.05, (frames * 6, 2)
    )
    cars = boxes(frame, xz, score=rng.normal(5, 2, frames * 6)).take(rng.random(frames * 6) > 0.15)
    false = boxes(rng.integers(0, frames, frames), rng.uniform([-15, 10], [15, 60], (frames, 2)), score=-0.3)
    people = boxes(
        np.arange(frames),
        np.column_stack([np.full(frames, 3.0), 12 + 0.1 * np.arange(frames)]),
        category="Pedestrian",
        size=PERSON,
    )
    return Boxes.join([cars, false, people])


def test_online_never_looks_ahead() -> None:
    everything = crowd(40, 5)
    whole = track_kitti.track_boxes(everything, standing_view(40), online=True)
    assert len(whole) > 150
    for end in (1, 7, 23, 39):
        part = track_kitti.track_boxes(everything.take(everything.frame < end), standing_view(end), online=True)
        expected = whole.take(whole.frame < end)
        for name, column in vars(expected).items():
            np.testing.assert_array_equal(getattr(part, name), column, err_msg=f"{name} before frame {end}")


def test_offline_fills_short_gaps_of_what_is_believed_and_no_others() -> None:
    frame = np.array([k for k in range(40) if not 10 <= k < 14])
    good = boxes(frame, np.column_stack([-3 + 0.1 * frame, 20 + 0.3 * frame]))
    poor = boxes(frame, np.column_stack([5 + 0.1 * frame, 20 + 0.3 * frame]), score=0.5)
    out = track_kitti.track_boxes(Boxes.join([good, poor]), standing_view(40), online=False)
    first = out.take(out.bottom_m[:, 0] < 3)
    assert first.frame.tolist() == list(range(40))
    assert sorted(set(range(40)) - set(out.take(out.bottom_m[:, 0] > 3).frame.tolist())) == [10, 11, 12, 13]
    # Between its ends the path is that of the motion.
    np.testing.assert_allclose(first.bottom_m[:, 2], 20 + 0.3 * np.arange(40), atol=0.05)
    online = track_kitti.track_boxes(good, standing_view(40), online=True)
    assert set(online.frame.tolist()) >= {*range(10), *range(14, 40)}


def person(frame: object, x: object, score: object) -> Boxes:
    xz = np.column_stack([x, np.full(len(np.atleast_1d(frame)), 15.0)])
    return boxes(frame, xz, category="Pedestrian", size=PERSON, score=score)


def test_gaps_of_people_are_filled_up_to_a_second_and_a_half_if_they_are_believed() -> None:
    def told(gap: int, score: float) -> set[int]:
        frame = np.array([k for k in range(60) if not 20 <= k < 20 + gap])
        out = track_kitti.track_boxes(person(frame, np.full(60 - gap, 3.0), score), standing_view(60), online=False)
        return set(out.frame.tolist())

    assert told(15, 4.0) == set(range(60))
    assert told(16, 4.0) == set(range(60)) - set(range(20, 36))
    assert told(5, -1.2) == set(range(60)) - set(range(20, 25))


def test_what_walks_is_believed_before_what_stands_unless_nothing_is_known_to_stand() -> None:
    frame = np.arange(30)
    both = Boxes.join([person(frame, 0.2 * frame - 3, 2.0), person(frame, np.full(30, 6.0), 2.0)])
    view = standing_view(30)
    out = track_kitti.track_boxes(both, view, online=False)
    walks, stands = (out.score[side] for side in (out.bottom_m[:, 0] < 4, out.bottom_m[:, 0] > 5))
    assert len(walks) == len(stands) == 30
    assert walks.min() == pytest.approx(stands.max() + 1)
    blind = track_kitti.track_boxes(both, replace(view, motion_known=False), online=False)
    assert len(np.unique(blind.score)) == 1


def test_a_track_that_is_missed_often_is_believed_less() -> None:
    frame = np.arange(30)
    often = frame[frame % 3 == 0]
    both = Boxes.join([person(frame, np.full(30, -6.0), 2.0), person(often, np.full(len(often), 6.0), 2.0)])
    out = track_kitti.track_boxes(both, standing_view(30), online=False)
    assert out.score[out.bottom_m[:, 0] < 0].min() > out.score[out.bottom_m[:, 0] > 0].max() + 1


def test_boxes_too_small_to_be_errors_are_carried_on_and_others_end() -> None:
    def seen_from(z: float) -> list[int]:
        frame = np.arange(25, 45)
        b = boxes(frame, np.column_stack([0 * frame, z - 0.2 * frame]), score=4.0)
        out = track_kitti.track_boxes(b, standing_view(80), online=False)
        return out.frame.tolist()

    # A car of 1.5 m is 25 px high at 43 m.
    assert seen_from(75.0) == list(range(5, 65))
    assert set(seen_from(30.0)) >= set(range(25, 45))
    assert not set(seen_from(30.0)) & {*range(15), *range(55, 80)}


def test_where_another_track_is_seen_none_is_predicted() -> None:
    # Two parked cars; a third track is a fragment of the second, seen elsewhere in time.
    first = boxes(np.arange(20, 40), np.tile([0.0, 60.0], (20, 1)), score=6.0)
    moving = boxes(np.arange(10, 20), np.column_stack([np.full(10, 0.3), 60 + 3.0 * np.arange(-10, 0)]), score=6.0)
    out = track_kitti.track_boxes(Boxes.join([first, moving]), standing_view(60), online=False)
    for f in range(60):
        here = out.take(out.frame == f)
        i, j = np.triu_indices(len(here), 1)
        assert (overlap_3d(here.take(i), here.take(j)) < 0.1).all(), f


def test_a_rider_is_no_pedestrian_beside() -> None:
    frame = np.arange(30)
    way = np.column_stack([0.4 * frame - 3, np.full(30, 15.0)])
    rider = boxes(frame, way, category="Cyclist", score=5.0, size=(1.7, 0.6, 1.8))
    ghost = boxes(frame, way + 0.1, category="Pedestrian", score=np.where(frame % 9 == 0, 6.0, 2.0), size=PERSON)
    for online in (True, False):
        out = track_kitti.track_boxes(Boxes.join([ghost, rider]), standing_view(30), online=online)
        assert len(np.unique(out.track_id)) == 1
        assert set(out.category[out.frame > 2]) == {"Cyclist"}
        assert len(out) == 30


@pytest.mark.parametrize("online", [True, False])
def test_who_walks_is_a_pedestrian_though_the_rider_has_the_higher_score(online: bool) -> None:
    frame = np.arange(60)

    def both(speed_mps: float) -> Boxes:
        way = np.column_stack([0.1 * speed_mps * frame - 3, np.full(60, 15.0)])
        rider = boxes(frame, way, category="Cyclist", score=4.0, size=(1.7, 0.6, 1.8))
        return Boxes.join([rider, boxes(frame, way + 0.1, category="Pedestrian", score=2.5, size=PERSON)])

    for speed, category, length in ((1.2, "Pedestrian", 0.6), (4.0, "Cyclist", 1.8)):
        out = track_kitti.track_boxes(both(speed), standing_view(60), online=online)
        late = out.take(out.frame > 20)
        assert len(np.unique(out.track_id)) == 1
        assert set(late.category) == {category}
        # The box of the category, not that of the other detection.
        np.testing.assert_allclose(late.size_hwl_m[:, 2], length, atol=1e-6)


def test_the_nearest_of_both_kinds_are_pairs_and_each_is_in_one() -> None:
    people = boxes([0, 0, 1], [(0, 15), (0.5, 15), (0, 15)], category="Pedestrian", score=[1.0, 2.0, 3.0])
    riders = boxes([0, 1], [(0.4, 15), (3, 15)], category="Cyclist", score=[2.5, 2.5])
    pairs = find_pairs(Boxes.join([people, riders]))
    assert len(pairs.boxes) == 5
    assert pairs.count == 4
    tracked = pairs.tracked
    assert sorted(zip(tracked.frame.tolist(), tracked.category.tolist(), tracked.score.tolist())) == [
        (0, "Pedestrian", 1.0),
        (0, "Pedestrian", 2.0),
        (1, "Cyclist", 2.5),
        (1, "Pedestrian", 3.0),
    ]
    other = pairs.other[tracked.score == 2.0]
    assert pairs.boxes.score[other].tolist() == [2.5]
    # Alone they count as one against a missed other one.
    np.testing.assert_allclose(pairs.rider[tracked.score == 3.0], -1 - 3.0 - 1.0)
    np.testing.assert_allclose(pairs.rider[(tracked.score == 2.5)], 2.5 + 1 - 1.0)


def test_cars_that_others_hide_are_told_where_their_track_is_sure() -> None:
    frame = np.arange(30)
    front = boxes(frame, np.tile([0.0, 10.0], (30, 1)))
    for score, told in ((0.5, 0), (8.0, 30)):
        behind = boxes(frame, np.tile([0.0, 20.0], (30, 1)), score=score)
        out = track_kitti.track_boxes(Boxes.join([front, behind]), standing_view(30), online=True)
        assert (out.bottom_m[:, 2] > 15).sum() == told


@pytest.mark.parametrize("online", [True, False])
def test_an_object_has_one_size_and_a_heading_that_turns_slowly(online: bool) -> None:
    rng = np.random.default_rng(4)
    frame = np.arange(200)
    way = np.column_stack([np.zeros(200), 15 + 0.1 * frame])
    # Every other box is turned around, which is the same box.
    b = boxes(frame, way, yaw=-1.57 + rng.normal(0, 0.1, 200) + np.pi * (frame % 2))
    b = replace(b, size_hwl_m=b.size_hwl_m + rng.normal(0, 0.1, (200, 3)))
    out = track_kitti.track_boxes(b, standing_view(200), online=online)
    out = out.take((out.frame >= 100) & (out.frame < 200))
    np.testing.assert_allclose(out.size_hwl_m, np.tile(CAR, (100, 1)), atol=0.05)
    assert np.ptp(out.size_hwl_m, axis=0).max() == (0 if not online else pytest.approx(0, abs=0.02))
    off = np.abs(np.mod(out.yaw_rad + 1.57 + np.pi / 2, np.pi) - np.pi / 2)
    given = np.abs(np.mod(b.yaw_rad[100:] + 1.57 + np.pi / 2, np.pi) - np.pi / 2)
    assert np.sqrt((off**2).mean()) < (0.65 if online else 0.5) * np.sqrt((given**2).mean())
    np.testing.assert_array_equal(np.cos(out.yaw_rad + 1.57) > 0, frame[100:] % 2 == 0)
    # The ground is where it was, whatever the height.
    np.testing.assert_allclose(out.bottom_m[:, 1], 1.7, atol=1e-6)


# ---- scores


def labels_and_results(seed: int) -> tuple[Boxes, Boxes]:
    """Labels of objects far apart and results that miss some, add others and change identities."""
    rng = np.random.default_rng(seed)
    frame, track = np.divmod(np.arange(20 * 5), 5)
    label = boxes(frame, np.column_stack([-20 + 10.0 * track, np.full(100, 20.0)]), track=track)
    found = replace(label, track_id=label.track_id + 10 * (rng.random(100) < 0.15), score=np.ones(100))
    found = replace(found, bottom_m=found.bottom_m + rng.normal(0, 0.1, (100, 3))).take(rng.random(100) > 0.2)
    false = boxes(
        rng.integers(0, 20, 15),
        np.column_stack([rng.uniform(-20, 20, 15), np.full(15, 40.0)]),
        track=50 + np.arange(15),
        score=1.0,
    )
    return label, Boxes.join([found, false])


@pytest.mark.parametrize("seed", range(5))
def test_errors_are_those_that_motmetrics_counts(seed: int) -> None:
    motmetrics = pytest.importorskip("motmetrics")
    label, found = labels_and_results(seed)
    score = evaluate({"0": found}, {"0": label}, "Car")
    book = motmetrics.MOTAccumulator(auto_id=True)
    held: dict[int, tuple[int, int]] = {}
    after_gap = 0
    for f in range(20):
        a, b = label.take(label.frame == f), found.take(found.frame == f)
        pairs = overlap_3d(a.take(np.repeat(np.arange(len(a)), len(b))), b.take(np.tile(np.arange(len(b)), len(a))))
        distance = np.where(pairs >= 0.25, 1 - pairs, np.nan).reshape(len(a), len(b))
        book.update(a.track_id.tolist(), b.track_id.tolist(), distance)
        for i, j in zip(*np.nonzero(np.isfinite(distance))):
            last = held.get(int(a.track_id[i]), (f - 1, int(b.track_id[j])))
            # KITTI does not count a switch over frames in which the object was missed.
            after_gap += int(last[1] != b.track_id[j] and last[0] < f - 1)
            held[int(a.track_id[i])] = f, int(b.track_id[j])
    names = ["num_switches", "num_false_positives", "num_misses", "motp", "num_objects"]
    with np.errstate(all="ignore"):
        table = motmetrics.metrics.create().compute(book, metrics=names, name="x").loc["x"]
    assert score.false_positives == table["num_false_positives"]
    assert score.false_negatives == table["num_misses"]
    assert score.id_switches == table["num_switches"] - after_gap
    assert score.motp == pytest.approx(100 * (1 - table["motp"]))
    errors = score.false_positives + score.false_negatives + score.id_switches
    assert score.mota == pytest.approx(100 * (1 - errors / table["num_objects"]))


@pytest.mark.parametrize("seed", range(3))
def test_hota_is_that_of_trackeval(seed: int) -> None:
    metrics = pytest.importorskip("trackeval.metrics", reason="TrackEval is not installed: pip install trackeval")
    label, found = labels_and_results(seed)
    names = [np.unique(b.track_id, return_inverse=True)[1] for b in (label, found)]
    data = {"num_timesteps": 20, "gt_ids": [], "tracker_ids": [], "similarity_scores": []}
    for f in range(20):
        a, b = np.flatnonzero(label.frame == f), np.flatnonzero(found.frame == f)
        data["gt_ids"].append(names[0][a])
        data["tracker_ids"].append(names[1][b])
        pairs = overlap_3d(label.take(np.repeat(a, len(b))), found.take(np.tile(b, len(a))))
        data["similarity_scores"].append(pairs.reshape(len(a), len(b)))
    data |= {"num_gt_dets": len(label), "num_tracker_dets": len(found)}
    data |= {"num_gt_ids": names[0].max() + 1, "num_tracker_ids": names[1].max() + 1}
    expected = metrics.HOTA().eval_sequence(data)
    score = evaluate({"0": found}, {"0": label}, "Car")
    for mine, theirs in (("hota", "HOTA"), ("det_a", "DetA"), ("ass_a", "AssA")):
        assert getattr(score, mine) == pytest.approx(100 * expected[theirs].mean(), abs=1e-6)


def test_averages_over_recall_of_a_case_done_by_hand() -> None:
    # Two objects of 40 frames; one is found with score 2, one with score 1, and a false track of 20 frames has score 1.5.
    frame = np.tile(np.arange(40), 2)
    label = boxes(
        frame, np.column_stack([np.repeat([-10.0, 10.0], 40), np.full(80, 20.0)]), track=np.repeat([1, 2], 40)
    )
    false = boxes(np.arange(20), np.tile([0.0, 40.0], (20, 1)), track=9, score=1.5)
    found = Boxes.join([replace(label, score=np.repeat([2.0, 1.0], 40)), false])
    score = evaluate({"0": found}, {"0": label}, "Car")
    # Recalls 1/40 to 20/40 come with the first track alone, those beyond with all three, 20 false boxes for 80 labels.
    beyond = [min(1 - (20 - 80 * (1 - k / 40)) / (80 * k / 40), 1.0) for k in range(21, 41)]
    assert score.samota == pytest.approx(100 * (20 + sum(beyond)) / 40)
    assert score.amota == pytest.approx(100 * (20 * 0.5 + 20 * 0.75) / 40)
    assert (score.mota, score.false_positives, score.false_negatives, score.id_switches) == (
        pytest.approx(75),
        20,
        0,
        0,
    )
    assert (score.motp, score.amotp) == (pytest.approx(100), pytest.approx(100))


def test_recall_thresholds_are_the_scores_with_the_nearest_recall() -> None:
    scores = np.arange(80, 0, -1.0)
    steps = recall_thresholds(scores, 80)
    assert [r for _, r in steps] == pytest.approx([k / 40 for k in range(1, 41)])
    # The recall of the best n is n / 80.
    assert [s for s, _ in steps] == pytest.approx([80 - 2 * k + 1 for k in range(1, 41)])
    assert len(recall_thresholds(scores, 160)) == 20  # half of the truth is never found


def test_what_the_benchmark_ignores_is_no_error() -> None:
    label = boxes(np.arange(8), np.tile([0.0, 20.0], (8, 1)), track=1)
    score = np.ones(8)
    van = replace(boxes(np.arange(8), np.tile([10.0, 20.0], (8, 1)), track=2), category=np.full(8, "Van"))
    hidden = replace(boxes(np.arange(8), np.tile([-10.0, 20.0], (8, 1)), track=3), occlusion=np.full(8, 3.0))
    cut = replace(boxes(np.arange(8), np.tile([-20.0, 20.0], (8, 1)), track=4), truncation=np.ones(8))
    area = replace(boxes(np.arange(8), np.tile([0.0, 70.0], (8, 1)), track=-1), category=np.full(8, "DontCare"))
    truth = Boxes.join([label, van, hidden, cut, area])
    found = [replace(b, score=score, category=np.full(8, "Car")) for b in (label, van, cut)]
    small = boxes(np.arange(8), np.tile([30.0, 60.0], (8, 1)), track=5, score=1.0, height_px=25.0)
    inside = replace(area, score=score, category=np.full(8, "Car"), track_id=np.full(8, 6))
    found = [*found, small, inside]
    got = evaluate({"0": Boxes.join(found)}, {"0": truth}, "Car")
    assert (got.false_positives, got.false_negatives, got.mota) == (0, 0, 100)
    taller = replace(small, box_px=small.box_px + np.array([0, 0, 0, 0.5]))
    assert evaluate({"0": Boxes.join([*found, taller])}, {"0": truth}, "Car").false_positives == 8


@pytest.mark.parametrize("seed", [0, 1])
def test_people_in_a_crowd_are_tracked_through_what_hides_them(seed: int) -> None:
    view = standing_view(70)
    label, found = walking_crowd(view, count=14, rng=np.random.default_rng(seed))
    for online, samota, mota in ((False, 94.0, 94.0), (True, 90.0, 85.0)):
        out = track_kitti.track_boxes(found, view, online=online)
        score = evaluate({"0": out}, {"0": label}, "Pedestrian")
        assert score.id_switches <= 2
        assert score.samota > samota
        assert score.mota > mota


def test_sequences_without_results_are_missed() -> None:
    label = boxes(np.arange(8), np.tile([0.0, 20.0], (8, 1)), track=1)
    got = evaluate({"0": replace(label, score=np.ones(8))}, {"0": label, "1": label}, "Car")
    assert (got.false_negatives, got.mota) == (8, 50)
    assert evaluate({}, {"0": label}, "Car").mota == 0


@pytest.mark.slow
@pytest.mark.real
@pytest.mark.parametrize("online", [True, False])
def test_a_recorded_sequence_is_tracked_ahead_of_the_baseline(tmp_path: Path, online: bool) -> None:
    if not KITTI.is_dir():
        pytest.skip(
            "the KITTI tracking labels and detections are not beside this checkout (../shared/data/kitti_tracking)"
        )
    (tmp_path / "calib").mkdir()
    detections = tmp_path / "detections"
    detections.mkdir()
    (detections / "0004.txt").write_bytes((KITTI / "detections" / "pointrcnn_Car" / "0004.txt").read_bytes())
    arguments = [
        "--detections",
        str(detections),
        "--calib",
        str(KITTI / "calib"),
        "--ego-motion",
        str(KITTI / "ego_motion"),
    ]
    assert track_kitti.main([*arguments, "--out", str(tmp_path / "out"), *(["--online"] if online else [])]) == 0
    result = {"0004": read_tracks(tmp_path / "out" / "0004.txt")}
    score = evaluate(result, {"0004": read_tracks(KITTI / "label_02" / "0004.txt")}, "Car")
    assert score.id_switches <= 1
    # AB3DMOT with its repository settings has 90.4 and 83.7 here.
    assert score.samota > 94.0
    assert score.mota > (90.0 if online else 93.0)
    report = tmp_path / "score.json"
    folders = ["--results", str(tmp_path / "out"), "--labels", str(KITTI / "label_02")]
    assert evaluate_kitti.main([*folders, "--categories", "Car", "--out", str(report)]) == 0
    assert report.is_file()


def test_weights_are_found_from_labels_and_boxes_on_labels_are_told(tmp_path: Path) -> None:
    # Objects of which those with a high score are labeled.
    rng = np.random.default_rng(11)
    frame, number = np.divmod(np.arange(40 * 12), 12)
    xz = np.column_stack([-22 + 4.0 * number, 15 + 2.0 * number]) + rng.normal(0, 0.05, (480, 2))
    score = np.where(number % 2 == 0, 4.0, 0.5) + rng.normal(0, 0.7, 480)
    found = boxes(frame, xz, score=score).take(rng.random(480) > 0.1)
    label = boxes(frame, xz, track=number).take(number % 2 == 0)
    described = track_kitti.describe_sequence(found, standing_view(40), online=False)
    weights = [fit_kitti.fit([described], [label], seen=seen) for seen in (True, False)]
    for w, seen in zip(weights, (True, False)):
        p = labeled_probability(described.features, w)
        on_label = fit_kitti.labeled(described.boxes, label, "Car")
        rows = described.seen == seen
        assert np.nanmean(p[rows & (on_label == 1)]) > 0.85
        assert np.nanmean(p[rows & (on_label == 0)]) < 0.15


def test_logistic_regression_finds_the_weights_that_made_the_data() -> None:
    rng = np.random.default_rng(2)
    x = np.column_stack([np.ones(40_000), rng.normal(size=(40_000, 2))])
    y = rng.random(40_000) < 1 / (1 + np.exp(-x @ np.array([-1.0, 2.0, 0.5])))
    np.testing.assert_allclose(fit_kitti.logistic_regression(x, y.astype(float)), [-1.0, 2.0, 0.5], atol=0.08)


def test_tracks_are_one_where_one_is_predicted_on_the_other_and_both_are_never_seen_at_once() -> None:
    frame = np.array([0, 1, 2, 3, 2, 3, 4, 0, 1, 2])
    track = np.array([0, 0, 0, 0, 1, 1, 1, 2, 2, 2])
    source = np.array([0, 1, 2, -1, -1, 3, 4, 5, 6, -1])
    xz = np.array([[0, 20], [0, 20], [0, 20], [0, 20], [0, 20], [0, 20], [0, 20], [0.5, 20], [0.5, 20], [0.5, 20.0]])
    b = boxes(frame, xz, track=track)
    rows = Rows(frame, track, source, np.maximum(source, 0), xz, b.category)
    distance = np.array([0, 0, 0, 1, 1, 0, 0, 0, 0, 1])
    joined, kept = join_tracks(rows, b, distance)
    # The third is seen together with the first, so it is another object.
    assert joined.track.tolist() == [0] * 7 + [2] * 3
    assert joined.frame[kept].tolist() == [0, 1, 2, 3, 4, 0, 1, 2]
    assert source[kept].tolist() == [0, 1, 2, 3, 4, 5, 6, -1]
