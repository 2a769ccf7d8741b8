"""What a track shows: seeded tracks of objects that stand and move, seen in turn, at rates from 2 to 20 Hz."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from test_size import measured
from worlds import measured_row, rows_at, scan, standing

from log2sim.agents import hypotheses
from log2sim.agents.hypotheses import explain_track, main_place
from log2sim.agents.smooth.fixed_interval import (
    PLACE_SIGMA_M,
    REPEATED_SHARE,
    STANDING,
    VIEW_S,
    MotionPriorSigmas,
    Positions,
    marginal_likelihood,
)
from log2sim.agents.static import MAX_SPEED_SIGMA_MPS, standing_speed_sigma
from log2sim.datatypes import Measurements, Track

RATES_HZ = [2.0, 5.0, 20.0]


def track_of(t_s: np.ndarray, xy: np.ndarray, category: str = "car", sigma_m: float = 0.2) -> Track:
    """A track without LiDAR points: centers and their covariances alone."""
    yaw = np.zeros(len(t_s))
    m = rows_at(xy, category, sigma_m=sigma_m, source="lidar", t_ns=np.round(t_s * 1e9).astype(np.int64), yaw_rad=yaw)
    return Track(category, np.arange(len(t_s)), m)


def view_noise(t_s: np.ndarray, seed: int, sigma_m: float = 0.2) -> np.ndarray:
    """Errors that repeat while the view stays the same, and small ones that do not."""
    rng = np.random.default_rng(seed)
    out = np.zeros((len(t_s), 2))
    for k in range(len(t_s)):
        stays = np.exp(-(t_s[k] - t_s[k - 1]) / 0.5) if k else 0.0
        out[k] = stays * out[k - 1] + rng.normal(0, sigma_m * np.sqrt(1 - stays**2), 2)
    return out + rng.normal(0, 0.03, out.shape)


def times(rate_hz: float, duration_s: float = 6.0) -> np.ndarray:
    return np.arange(0, duration_s, 1 / rate_hz)


def along(x_m: np.ndarray) -> np.ndarray:
    return np.column_stack([x_m, np.zeros(len(x_m))])


@pytest.mark.parametrize("rate_hz", RATES_HZ)
@pytest.mark.matrix
@pytest.mark.parametrize("seed", range(3))
def test_two_parked_cars_seen_in_turn_are_two_that_stand(rate_hz, seed):
    t = times(rate_hz)
    second = t > 3.0
    parts = explain_track(track_of(t, along(np.where(second, 5.5, 0.0)) + view_noise(t, seed)))
    assert [part.static for part in parts] == [True, True]
    places = sorted(float(np.median(part.track.measurements.center_m[:, 0])) for part in parts)
    assert places == pytest.approx([0.0, 5.5], abs=0.6)
    assert sorted(len(part.track) for part in parts) == sorted([int(second.sum()), int((~second).sum())])


@pytest.mark.parametrize("rate_hz", RATES_HZ)
@pytest.mark.matrix
@pytest.mark.parametrize("seed", range(3))
def test_a_motion_is_one_moving_object(rate_hz, seed):
    t = times(rate_hz)
    braking = np.where(t < 4.0, 8.0 * t - t**2, 16.0)
    ways = {"braking": braking, "starting": 0.75 * t**2, "slow": 1.5 * t, "motorway": 30.0 * t}
    for name, way in ways.items():
        (part,) = explain_track(track_of(t, along(way) + view_noise(t, seed)))
        assert not part.static, name
        assert len(part.track) == len(t), name


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_people_who_walk_are_not_people_who_stand_in_turn(rate_hz):
    t = times(rate_hz, 4.0)
    (part,) = explain_track(track_of(t, along(1.3 * t) + view_noise(t, 0, 0.1), "pedestrian", 0.1))
    assert not part.static


@pytest.mark.parametrize("rate_hz", RATES_HZ)
@pytest.mark.matrix
@pytest.mark.parametrize("seed", range(3))
def test_noise_at_rest_is_rest(rate_hz, seed):
    t = times(rate_hz)
    (part,) = explain_track(track_of(t, view_noise(t, seed)))
    assert part.static
    assert len(part.track) == len(t)


@pytest.mark.matrix
@pytest.mark.parametrize("seed", range(3))
def test_a_jump_to_another_moving_car_splits_the_track(seed):
    t = times(10.0, 5.0)
    second = t > 2.45
    way = along(np.where(second, 8.0 * t - 25.0, 8.0 * t)) + np.outer(second, [0.0, 3.5])
    parts = explain_track(track_of(t, way + view_noise(t, seed)))
    assert [part.static for part in parts] == [False, False]
    assert [len(part.track) for part in parts] == pytest.approx([25, 25], abs=2)


@pytest.mark.matrix
@pytest.mark.parametrize("seed", range(3))
def test_outliers_split_no_track(seed):
    t = times(10.0)
    way = along(6.0 * t) + view_noise(t, seed)
    way[[7, 23, 41]] += [[3.0, 2.0], [-4.0, 1.0], [2.0, -5.0]]
    (part,) = explain_track(track_of(t, way))
    assert (part.static, len(part.track)) == (False, 60)


def test_what_is_shown_in_between_is_no_object_of_its_own():
    t = times(10.0, 4.0)
    other = np.isin(np.arange(40), [8, 9, 17, 18, 25, 30, 31])
    (part,) = explain_track(track_of(t, along(np.where(other, 5.0, 0.0)) + view_noise(t, 1)))
    assert part.static
    assert len(part.track) == 40
    main = main_place(part.track)
    assert main is not None
    assert np.abs(main.measurements.center_m[:, 0]).max() < 2.0
    assert 20 <= len(main) <= 33


@pytest.mark.parametrize(("off_m", "kept"), [(0.8, 38), (3.5, 30)])
def test_partial_views_belong_to_a_car_that_stands_and_what_shows_a_neighbor_does_not(off_m, kept):
    t = times(10.0, 3.8)
    other = np.arange(38) % 5 == 3
    other[-1] = True
    (part,) = explain_track(track_of(t, along(np.where(other, off_m, 0.0)) + view_noise(t, 3, 0.05)))
    assert part.static
    assert len(part.at_place or part.track) == kept


@pytest.mark.parametrize("turn", [0.7, np.pi / 2, 3.0])
def test_neither_map_nor_clock_matters(turn):
    t = times(10.0)
    way = along(np.where(t > 3.0, 5.5, 0.0)) + view_noise(t, 2)
    c, s = np.cos(turn), np.sin(turn)
    moved = track_of(t + 1e3, way @ np.array([[c, s], [-s, c]]) + [4e5, 5e6])
    moved = replace(moved, measurements=replace(moved.measurements, yaw_rad=np.full(len(t), turn)))
    expected = [part.track.tick.tolist() for part in explain_track(track_of(t, way))]
    assert [part.track.tick.tolist() for part in explain_track(moved)] == expected


def test_the_evidence_is_the_likelihood_of_the_gaussian_process():
    t = np.array([0.0, 0.3, 0.5, 1.2, 2.0])
    variance = np.array([0.1, 0.2, 0.1, 0.3, 0.1])[:, None] * [1.0, 4.0]
    rng = np.random.default_rng(3)
    xy = np.column_stack([5.0 * t, 1.0 - t]) + rng.normal(0, 0.1, (5, 2))
    motion = MotionPriorSigmas(8.0, 2.5)
    # A path of velocity steps, each Gaussian, with positions summed: the Wiener process in the limit.
    steps = np.linspace(-1, 1, 4001)
    dt = steps[1] - steps[0]
    response = np.where(np.sign(steps) == np.sign(t - 1.0)[:, None], np.abs(t - 1.0)[:, None] - np.abs(steps), 0.0)
    response = np.maximum(response, 0.0)
    noise = np.sqrt(variance.T[:, :, None] * variance.T[:, None, :])
    noise = noise * (REPEATED_SHARE * np.exp(-np.abs(t[:, None] - t) / VIEW_S) + (1 - REPEATED_SHARE) * np.eye(5))
    # The noise is 1/4 to 4 times as large as stated, the factor log-normal with a standard deviation of an octave.
    octaves = np.arange(-2.0, 3.0)
    weights = np.exp(-0.5 * octaves**2) / np.exp(-0.5 * octaves**2).sum()
    moves = 64.0 * np.outer(t - 1, t - 1) + 6.25 * response @ response.T * dt
    for prior, spread in ((STANDING, 0.0), (motion, moves)):
        middle = np.median(xy, axis=0) if prior is STANDING else xy[3]
        expected = 0.0
        for k in range(2):
            each = [multivariate_normal(np.zeros(5), 4.0**o * noise[k] + PLACE_SIGMA_M**2 + spread) for o in octaves]
            expected += np.log(weights @ [np.exp(e.logpdf(xy[:, k] - middle[k])) for e in each])
        log, inlier = marginal_likelihood(Positions(t, xy, variance), prior)
        if inlier.all():
            assert log == pytest.approx(expected, abs=0.05)
        assert prior is STANDING or inlier.all()


@pytest.mark.parametrize("stated", [0.25, 1.0, 6.0])
@pytest.mark.parametrize("seed", range(3))
def test_stated_errors_may_be_wrong_by_far(stated, seed):
    t = times(10.0, 1.0)
    for speed_mps, sigma_m in ((0.0, 0.2), (1.0, 0.05)):
        way = along(speed_mps * t) + view_noise(t, seed, sigma_m)
        (part,) = explain_track(track_of(t, way, "pedestrian", sigma_m * stated))
        assert part.static == (speed_mps == 0)


def test_a_car_whose_points_a_neighbor_joins_at_times_stands():
    t = times(10.0, 4.0)
    joined = np.isin(np.arange(40), [0, 2, 6, 7, 11])
    way = along(np.where(joined, 2.3, 0.0)) + np.random.default_rng(2).normal(0, 0.02, (40, 2))
    m = (track := track_of(t, way)).measurements
    covariance = np.where(joined[:, None, None], np.diag([0.28, 0.02]), np.diag([1.4, 0.4]))
    (part,) = explain_track(replace(track, measurements=replace(m, covariance=covariance)))
    assert part.static


@pytest.mark.parametrize("speed_mps", [0.0, 1.2])
def test_a_walk_across_the_rays_of_a_camera_that_stands_is_told_from_standing(speed_mps):
    t = np.arange(0, 1, 0.1)
    xy = np.column_stack([0 * t, speed_mps * t]) + np.random.default_rng(5).normal(0, 0.03, (len(t), 2))
    track = track_of(t, xy, "pedestrian")
    m = replace(track.measurements, source=np.full(10, "topdown"), covariance=np.tile(np.diag([0.5, 0.06]), (10, 1, 1)))
    (part,) = explain_track(replace(track, measurements=m))
    assert part.static == (speed_mps == 0)


TRUCK = (18.0, 2.55, 3.8)


@pytest.mark.parametrize("factor", [0.5, 1.0, 3.0])
def test_the_speed_of_what_stands_is_as_uncertain_as_a_line_through_its_centers(factor):
    t, rng = np.arange(0, 20, 0.1), np.random.default_rng(2)
    xy = rng.normal(0, 0.1 * factor, (200, 2))
    expected = 0.1 * max(factor, 1.0) / np.sqrt(200 * np.var(t))
    assert standing_speed_sigma(track_of(t, xy, sigma_m=0.1).measurements, 0.0) == pytest.approx(expected, rel=0.15)
    xy[rng.choice(200, 20, replace=False)] += 2.0
    assert standing_speed_sigma(track_of(t, xy, sigma_m=0.1).measurements, 0.0) < 1.6 * expected
    assert standing_speed_sigma(track_of(t[:1], xy[:1]).measurements, 0.0) == MAX_SPEED_SIGMA_MPS


def passing(speed_mps: float):
    """A long truck seen from a sensor that drives past it at 6 m/s and sees 40 degrees to either side of its left."""
    states, sensors = [], []
    for k in range(30):
        states.append((20.0 + 0.1 * k * speed_mps, 8.0, 0.0))
        sensors.append((0.6 * k, 0.0, 1.9))
    return measured(states, TRUCK, "truck", sensors=sensors)


def test_a_long_truck_of_which_ever_more_shows_stands_and_a_slow_one_does_not():
    standing, creeping = passing(0.0), passing(1.0)
    # The center that a typical length gives moves as more of the truck is seen.
    grown = standing.measurements.center_m.copy()
    grown[:, 0] = np.linspace(24.0, 20.0, 30)
    assert explain_track(standing)[0].static
    object.__setattr__(standing.measurements, "center_m", grown)
    assert explain_track(standing)[0].static
    assert not explain_track(creeping)[0].static


SIZES = {"bus": (12.0, 2.55, 3.1), "car": (4.4, 1.85, 1.5)}
SPAN_S = 6.0


WAYS = {
    "stands": lambda t: 0.0 * t,
    "starts": lambda t: 0.2 * np.maximum(t - 2.5, 0.0) ** 2,
    "stops": lambda t: -0.2 * np.maximum(3.5 - t, 0.0) ** 2,
}


def seen_in_passing(category: str, way: str, rate_hz: float, seed: int = 0, ego_mps: float = 3.0) -> Track:
    """A vehicle ahead on the left of an ego that comes closer; of one tick, the points of its nearer half only."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, SPAN_S, 1 / rate_hz) + rng.uniform(0, 0.02)
    rows = []
    broken = int(rng.integers(2, len(t) - 2))
    for k, (at, x) in enumerate(zip(t, WAYS[way](t))):
        sensor = np.array([ego_mps * at, 0.0, 1.9])
        solid = standing(14.0 + x - sensor[0], 4.5, 2.0, SIZES[category])
        xyz, owner = scan([solid], azimuth_deg=(-180, 180), steps=(720, 10), noise_m=0.03, seed=seed + k)
        cluster = xyz[(owner == 0) & (xyz[:, 2] > 0.2)] + [*sensor[:2], 0.0]
        if k == broken:
            cluster = cluster[cluster[:, 0] < np.median(cluster[:, 0])]
        rows.append(measured_row(cluster, sensor, category, ends_visible=(True, True), t_ns=round(1e9 * at)))
    return Track(category, np.arange(len(rows)), Measurements.join(rows))


@pytest.mark.matrix
@pytest.mark.parametrize("rate_hz", RATES_HZ)
@pytest.mark.parametrize("category", SIZES)
@pytest.mark.parametrize("way", WAYS)
def test_what_starts_or_stops_moves_and_what_stands_does_not(category, way, rate_hz):
    track = seen_in_passing(category, way, rate_hz, seed=int(rate_hz))
    assert [part.static for part in explain_track(track)] == [way == "stands"]


@pytest.mark.parametrize("way", WAYS)
def test_odds_of_a_start_are_an_average_over_its_time_not_a_sum_over_those_tried(way, monkeypatch):
    track, odds = seen_in_passing("car", way, 5.0, seed=5), []
    for times_tried in (24, 96, 384):
        monkeypatch.setattr(hypotheses, "TIMES", times_tried)
        odds.append(hypotheses.motion_of_ends(track)[1])
    # Sums would grow by log(4) each.
    assert np.isfinite(odds).all()
    assert odds == pytest.approx([odds[0]] * 3, abs=0.2)


def test_what_is_seen_of_one_end_only_may_grow():
    track = seen_in_passing("bus", "starts", 5.0)
    m = track.measurements
    far = tuple(c[c[:, 0] > 18.0] for c in m.cluster)
    grown = tuple(np.concatenate([near[near[:, 0] <= 18.0], end]) for near, end in zip(m.cluster[:1] * len(far), far))
    object.__setattr__(m, "cluster", grown)
    assert explain_track(track)[0].static
