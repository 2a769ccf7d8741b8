"""Boxes found in a cloud as evidence: their points, ends and yaw; the boxes' own estimates over a track."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from worlds import Solid, cloud_at, scan, standing

from log2sim.agents.evidence import image_confidence
from log2sim.agents.moving import heading_log_odds
from log2sim.agents.size import independent
from log2sim.datatypes import GROUP_OF, Boxes3D, Measurements, Track
from log2sim.geometry import NS_PER_S, rotation_from_rpy, wrap_angle
from log2sim.perception.boxes import BOX_SIGMA_M, box_sigma, weighted_center
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.lidar.measure import measure
from log2sim.tracking.tracker import mark_unrecorded

ORIGIN = np.array([500.0, -200.0, 3.0])
SENSOR = (0.0, 0.0, 1.9)


def cloud_of(solids: list[Solid], *, turn_rad: float = 0.0, flip: float = 1.0, noise_m: float = 0.01) -> Cloud:
    """A sweep all around over flat ground, turned about the sensor or mirrored in y."""
    xyz, owner = scan(solids, azimuth_deg=(-180.0, 180.0), steps=(1440, 40), noise_m=noise_m, seed=1)
    xyz = (xyz * [1.0, flip, 1.0]) @ rotation_from_rpy(0, 0, turn_rad).T
    near = np.flatnonzero(np.abs(xyz[:, :2]).max(axis=1) < 70)
    ground = (owner < 0)[near]
    return cloud_at(xyz[near], stamp_ns=NS_PER_S, origin=ORIGIN, sensor=SENSOR, ground=ground)


def boxes_of(solids: list[Solid], *, turn_rad: float = 0.0, flip: float = 1.0, yaw_error_rad: float = 0.0) -> Boxes3D:
    m = len(solids)
    center = np.array([s.center_m for s in solids]).reshape(-1, 3) * [1.0, flip, 1.0]
    return Boxes3D(
        np.full(m, NS_PER_S), center @ rotation_from_rpy(0, 0, turn_rad).T + ORIGIN,
        np.array([s.size_m for s in solids]).reshape(-1, 3),
        np.array([flip * (s.yaw_rad + yaw_error_rad) + turn_rad for s in solids]), np.full(m, 0.9),
        np.full(m, "car", dtype="<U16"), np.full(m, 0.8), np.full(m, 40),
    )  # fmt: skip


CARS = [standing(12.0, 5.0, 20.0), standing(-15.0, 3.0, 170.0), standing(4.0, -18.0, -80.0)]


def test_boxes_have_their_points_and_places_all_around() -> None:
    rows = measure([], boxes_of(CARS), cloud_of(CARS))
    assert (rows.source == "lidar").all()
    assert (rows.camera == "").all()
    for k, car in enumerate(CARS):
        assert len(rows.cluster[k]) > 30
        assert np.hypot(*(rows.center_m[k] - car.center_m - ORIGIN)[:2]) < 0.1
        assert abs(wrap_angle(rows.yaw_rad[k] - car.yaw_rad)) < np.deg2rad(2)
    np.testing.assert_allclose(rows.bottom_m, ORIGIN[2], atol=0.05)


def test_points_correct_a_yaw_that_is_somewhat_wrong_and_keep_its_direction() -> None:
    rows = measure([], boxes_of(CARS, yaw_error_rad=np.deg2rad(6)), cloud_of(CARS))
    for k, car in enumerate(CARS):
        assert abs(wrap_angle(rows.yaw_rad[k] - car.yaw_rad)) < np.deg2rad(2)


@pytest.mark.parametrize(("turn_deg", "flip"), [(73.0, 1.0), (180.0, 1.0), (0.0, -1.0), (-140.0, -1.0)])
def test_turning_and_mirroring_the_world_turns_and_mirrors_the_rows(turn_deg: float, flip: float) -> None:
    turn = float(np.deg2rad(turn_deg))
    here = measure([], boxes_of(CARS), cloud_of(CARS))
    there = measure([], boxes_of(CARS, turn_rad=turn, flip=flip), cloud_of(CARS, turn_rad=turn, flip=flip))
    expected = ((here.center_m - ORIGIN) * [1.0, flip, 1.0]) @ rotation_from_rpy(0, 0, turn).T + ORIGIN
    np.testing.assert_allclose(there.center_m, expected, atol=0.03)
    np.testing.assert_allclose(wrap_angle(there.yaw_rad - (flip * here.yaw_rad + turn)), 0.0, atol=0.01)
    ends = here.ends_visible if flip > 0 else here.ends_visible[:, ::-1]
    assert (there.ends_visible == ends).mean() > 0.8


def test_the_better_of_two_centers_counts_more_and_a_missing_one_not_at_all() -> None:
    a, b, sigma = np.zeros((3, 2)), np.ones((3, 2)), np.full((3, 2), 0.1)
    a[2], b[1] = np.nan, np.nan
    center, left = weighted_center(a, sigma, b, 3 * sigma)
    np.testing.assert_allclose(center, [[0.1, 0.1], [0, 0], [1, 1]])
    np.testing.assert_allclose(left[:, 0], [0.1 * 0.9**0.5, 0.1, 0.3])
    for category in ("car", "cyclist", "pedestrian"):
        sigma = box_sigma(np.array([0, 5, 20, 100, 10**9]), np.full(5, category))
        assert (np.diff(sigma, axis=0) <= 0).all()
        assert sigma[-1] == pytest.approx(BOX_SIGMA_M[GROUP_OF[category]])


def track_of(
    ticks: int, score: float | np.ndarray = 0.8, *, heading: float = 0.9, camera: str = "", **moved: float
) -> Track:
    """A track of one car by boxes of sweeps, which turns by `flip` radians at a share `flipped` of its ticks."""
    rows = Measurements.join([measure([], boxes_of(CARS[:1]), cloud_of(CARS[:1]))] * ticks)
    yaw = rows.box_yaw_rad.copy()
    yaw[: round(ticks * moved.get("flipped", 0.0))] += np.pi
    t_ns = NS_PER_S + np.arange(ticks) * NS_PER_S // 10
    rows = replace(
        rows, t_ns=t_ns, score=np.broadcast_to(score, ticks).astype(float), box_yaw_rad=yaw,
        heading_score=np.full(ticks, heading), camera=np.full(ticks, camera),
    )  # fmt: skip
    return Track("car", np.arange(ticks), rows)


def test_more_ticks_are_surer_about_the_front_up_to_a_limit() -> None:
    yaw = CARS[0].yaw_rad
    odds = [heading_log_odds(track_of(n).measurements, yaw) for n in (1, 3, 30)]
    assert 0 < odds[0] < odds[1] < odds[2] < 2 * odds[0] + 1e-9
    np.testing.assert_allclose(heading_log_odds(track_of(3).measurements, yaw + np.pi), -odds[1])
    assert heading_log_odds(track_of(10, flipped=0.8).measurements, yaw) < 0
    assert heading_log_odds(track_of(10, flipped=0.5).measurements, yaw) == pytest.approx(0.0)
    assert heading_log_odds(track_of(3).measurements, yaw + np.pi / 2) == 0.0
    assert independent(1) == 1
    assert independent(10**6) == pytest.approx(2.0)


def test_ticks_at_which_no_picture_was_searched_do_not_count_against_what_pictures_show() -> None:
    whole = track_of(60, 0.7)
    shown = np.arange(60) % 3 == 0
    rows = whole.measurements
    track = Track("car", whole.tick, replace(rows, camera=np.where(shown, "front", "")))
    [always] = mark_unrecorded([track], {"": np.ones(60, dtype=bool), "front": np.ones(60, dtype=bool)})
    [third] = mark_unrecorded([track], {"": np.ones(60, dtype=bool), "front": shown})
    assert (always.searched, third.searched) == (1.0, pytest.approx(1 / 3))
    assert image_confidence(third) == pytest.approx(3 * image_confidence(always))
    everywhere = replace(track, measurements=replace(rows, camera=np.full(60, "front")))
    [certain] = mark_unrecorded([everywhere], {"front": np.ones(60, dtype=bool)})
    assert image_confidence(third) == pytest.approx(image_confidence(certain))
    # Shown by tiles that are searched at every second tick.
    by_turns = replace(track, measurements=replace(rows, camera=np.where(np.arange(60) % 2, "front", "")))
    [turns] = mark_unrecorded([by_turns], {"front": np.ones(60, dtype=bool)}, 2)
    assert image_confidence(turns) == pytest.approx(image_confidence(certain))
    [sweeps] = mark_unrecorded([whole], {"": np.ones(60, dtype=bool), "front": shown})
    assert sweeps.searched == 1.0
