"""Tracking: the motion model in closed form, and identities through crossings, gaps and occlusions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad_vec
from scipy.linalg import expm
from scipy.optimize import linear_sum_assignment
from worlds import rows_at

from log2sim.datatypes import Measurements, Track
from log2sim.geometry import NS_PER_S
from log2sim.geometry.statistics import NEVER, choose_pairs
from log2sim.tracking.forward import (
    ForwardTracker,
    innovation,
    predict,
    track_forward,
    update,
)
from log2sim.tracking.tracker import decide_category, min_hits, stitch, track

PERIOD_S = 0.1
START_NS = 1_700_000_000_000_000_000
OPTIONS = {"birth_score": 0.4, "max_gap_s": 3.0, "min_life_s": 0.3}
Way = Callable[[float], tuple[float, float]]


def stamps(ticks: int, period_s: float = PERIOD_S) -> np.ndarray:
    return START_NS + np.rint(np.arange(ticks) * period_s * NS_PER_S).astype(np.int64)


def seen(
    xy: np.ndarray,
    t_ns: np.ndarray | int,
    name: list[str] | str = "",
    category: list[str] | str = "car",
    score: float = 0.9,
    source: list[str] | str = "lidar",
    sigma_m: float = 0.1,
) -> Measurements:
    """Measurements at places (M, 2); `name` is the truth, hidden in the camera's name, which tracking does not read."""
    camera = np.array(name, dtype="<U16")
    rows = rows_at(xy, category, sigma_m=sigma_m, source=source, camera=camera, score=score, t_ns=t_ns)
    return replace(rows, yaw_rad=np.zeros(len(xy)), points=np.full(len(xy), 50))


def record(
    ways: dict[str, Way],
    ticks: int,
    hidden: dict[str, tuple[int, int]] | None = None,
    seed: int = 0,
    noise_m: float = 0.1,
    **columns: str,
) -> tuple[list[Measurements], np.ndarray]:
    """What is seen of named ways at every tick, in a new order each time; `hidden` names from and to ticks."""
    rng, t_ns, found = np.random.default_rng(seed), stamps(ticks), []
    for k in range(ticks):
        names = [n for n in ways if not (hidden and n in hidden and hidden[n][0] <= k < hidden[n][1])]
        rng.shuffle(names)
        xy = np.array([ways[n](k * PERIOD_S) for n in names]).reshape(-1, 2)
        found.append(seen(xy + rng.normal(0, noise_m, xy.shape), t_ns[k], names, **columns))
    return found, t_ns


def names_of(tracks: list[Track]) -> list[list[str]]:
    """Whose measurements every track holds."""
    return [sorted(set(t.measurements.camera.tolist())) for t in tracks]


def line(x: float, y: float, vx: float, vy: float) -> Way:
    return lambda t: (x + vx * t, y + vy * t)


def test_prediction_is_that_of_white_acceleration() -> None:
    f = np.zeros((4, 4))
    f[0, 2] = f[1, 3] = 1.0
    g = np.vstack([np.zeros((2, 2)), np.eye(2)])
    rng = np.random.default_rng(0)
    mean, root = rng.normal(0, 5, (3, 4)), rng.normal(0, 1, (3, 4, 4))
    covariance, acceleration, dt = root @ np.swapaxes(root, 1, 2), np.array([1.0, 2.5, 0.3]), np.array([0.1, 1.3, 0.7])
    found_mean, found_covariance = predict(mean, covariance, dt, acceleration)
    for k in range(3):
        q, _ = quad_vec(lambda s: expm(f * s) @ g @ g.T @ expm(f * s).T, 0.0, dt[k])
        step = expm(f * dt[k])
        np.testing.assert_allclose(found_mean[k], step @ mean[k], atol=1e-12)
        expected = step @ covariance[k] @ step.T + acceleration[k] ** 2 * q
        np.testing.assert_allclose(found_covariance[k], expected, rtol=1e-9, atol=1e-9)


def test_two_short_predictions_are_one_long_and_backward_adds_noise_too() -> None:
    mean, covariance, a = np.array([[1.0, 2.0, 3.0, -4.0]]), np.eye(4)[None], np.array([2.0])
    once = predict(mean, covariance, 0.8, a)
    twice = predict(*predict(mean, covariance, 0.3, a), 0.5, a)
    for one, two in zip(once, twice):
        np.testing.assert_allclose(one, two, rtol=1e-12)
    # A mirrored past: the same places and spreads as the future, with speeds and their correlation turned round.
    mirror = np.diag([1.0, 1.0, -1.0, -1.0])
    back = predict(mean @ mirror, covariance, -0.8, a)
    np.testing.assert_allclose(back[0] @ mirror, once[0], rtol=1e-12)
    np.testing.assert_allclose(mirror @ back[1] @ mirror, once[1], rtol=1e-12)


def test_update_and_innovation_are_those_of_the_textbook() -> None:
    rng = np.random.default_rng(1)
    mean, root = rng.normal(0, 3, (4, 4)), rng.normal(0, 1, (4, 4, 4))
    covariance = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(4)
    xy, r, age = (
        rng.normal(0, 3, (4, 2)),
        np.array([np.eye(2) * s + 0.01 for s in (0.1, 0.5, 1.0, 2.0)]),
        np.array([0.0, 0.05, -0.04, 1.0]),
    )
    found_mean, found_covariance = update(mean, covariance, xy, r, age)
    squared, log_determinant = innovation(mean, covariance, xy, r, age)
    for k in range(4):
        h = np.hstack([np.eye(2), age[k] * np.eye(2)])
        # Information form, a second way.
        information = np.linalg.inv(covariance[k]) + h.T @ np.linalg.inv(r[k]) @ h
        expected = np.linalg.solve(
            information, np.linalg.solve(covariance[k], mean[k]) + h.T @ np.linalg.solve(r[k], xy[k])
        )
        np.testing.assert_allclose(found_mean[k], expected, atol=1e-9)
        np.testing.assert_allclose(found_covariance[k], np.linalg.inv(information), atol=1e-9)
        for j in range(4):
            h = np.hstack([np.eye(2), age[j] * np.eye(2)])
            s, d = h @ covariance[k] @ h.T + r[j], xy[j] - h @ mean[k]
            assert squared[k, j] == pytest.approx(d @ np.linalg.solve(s, d))
            assert log_determinant[k, j] == pytest.approx(np.log(np.linalg.det(s)))


def test_a_covariance_stays_what_it_is_over_a_long_track() -> None:
    # Rounding leaves covariances a little asymmetric; without care that grows by a factor of ten in ten steps.
    mean, covariance = np.zeros((1, 4)), np.diag([0.04, 0.03, 100.0, 4.0])[None]
    for _ in range(300):
        mean, covariance = predict(mean, covariance, 0.1, np.array([2.5]))
        mean, covariance = update(
            mean, covariance, np.zeros((1, 2)), np.array([[[0.04, 0.01], [0.01, 0.03]]]), np.zeros(1)
        )
    np.testing.assert_array_equal(covariance, covariance.swapaxes(1, 2))
    again = update(
        *predict(mean, covariance, 0.1, np.array([2.5])),
        np.zeros((1, 2)),
        np.array([[[0.04, 0.01], [0.01, 0.03]]]),
        np.zeros(1),
    )
    np.testing.assert_allclose(again[1], covariance, rtol=1e-6)
    assert np.linalg.eigvalsh(covariance).min() > 0


@pytest.mark.matrix
@pytest.mark.parametrize("seed", range(4))
def test_every_way_becomes_one_track_with_all_its_measurements(seed: int) -> None:
    ways = {"a": line(0, 0, 12, 0), "b": line(60, 3.5, -14, 0), "c": line(20, -8, 0, 0), "d": line(5, 30, 3, -6)}
    found, t_ns = record(ways, 40, seed=seed)
    tracks = track(found, t_ns, **OPTIONS)
    assert sorted(names_of(tracks)) == [["a"], ["b"], ["c"], ["d"]]
    for t in tracks:
        assert t.tick.tolist() == list(range(40))
        np.testing.assert_array_equal(t.measurements.t_ns, t_ns)
        assert t.category == "car"


@pytest.mark.matrix
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("apart_m", [1.5, 3.0])
def test_tracks_that_cross_keep_their_identities(apart_m: float, seed: int) -> None:
    # Both are at x = 30 at the same time, `apart_m` apart, one coming along x and one along y.
    ways = {"along": line(0, 0, 10, 0), "across": line(30 + apart_m, -30, 0, 10)}
    tracks = track(*record(ways, 60, seed=seed), **OPTIONS)
    assert sorted(names_of(tracks)) == [["across"], ["along"]]
    assert [len(t) for t in tracks] == [60, 60]


@pytest.mark.parametrize("rate_hz", [2, 5, 10, 20])
def test_a_motorway_is_followed_by_the_velocity_of_the_ego(rate_hz: int) -> None:
    """From a car at 32 m/s others, 0.9 s behind each other, and oncoming ones, which are in view for some ticks only."""
    t_ns = stamps(6 * rate_hz, 1 / rate_hz)
    ways = {f"with {k}": line(-60 + 30 * k, 3.5, 30 + k, 0) for k in range(5)}
    ways |= {f"towards {k}": line(100 + 70 * k, 14, -33, 0) for k in range(3)}
    rng, found = np.random.default_rng(0), []
    for k, now_ns in enumerate(t_ns):
        t_s = k / rate_hz
        here = [n for n, way in ways.items() if abs(way(t_s)[0] - 32 * t_s) < 80]
        found.append(seen(np.array([ways[n](t_s) for n in here]) + rng.normal(0, 0.1, (len(here), 2)), now_ns, here))
    tracks = track(found, t_ns, **OPTIONS, flow_mps=np.tile([32.0, 0.0], (len(t_ns), 1)))
    assert sorted(names_of(tracks)) == [[n] for n in sorted(ways)]
    assert sum(map(len, tracks)) == sum(map(len, found))


@pytest.mark.parametrize("age_s", [-0.09, 0.09])
def test_cars_close_behind_each_other_are_followed_where_a_sweep_sees_them_before_or_after_its_tick(
    age_s: float,
) -> None:
    """Two at 33 m/s, 7.9 m apart: at 5 Hz each comes near to where the one ahead was."""
    t_ns = stamps(20, 0.2)
    ways = {"first": line(-24, 4, 33, 0), "second": line(-31.9, 4, 33, 0)}
    found = [
        seen(np.array([way(0.2 * k + age_s) for way in ways.values()]), now_ns + round(age_s * 1e9), list(ways))
        for k, now_ns in enumerate(t_ns)
    ]
    tracks = track(found, t_ns, **OPTIONS, flow_mps=np.tile([32.0, 0.0], (len(t_ns), 1)))
    assert sorted(names_of(tracks)) == [["first"], ["second"]]


def test_a_missed_car_does_not_shift_the_row_behind_it() -> None:
    t_ns = stamps(5, 0.5)
    row = {f"car {k}": (6.5 * k, 4.6) for k in range(6)}
    found = []
    for k in range(5):
        here = [n for j, n in enumerate(row) if k != 1 or j != 0]  # the first is missed once,
        here = here if k >= 1 else here[:-1]  # when another one comes into view at the end
        found.append(seen(np.array([row[n] for n in here]), t_ns[k], here))
    for flow_mps in (0.0, 8.0, 13.0, 30.0):  # of an ego that passes the row
        flow = np.tile([flow_mps, 0.0], (len(t_ns), 1))
        assert sorted(names_of(track(found, t_ns, **OPTIONS, flow_mps=flow))) == [[n] for n in row]


@pytest.mark.parametrize("gap_ticks", [1, 3, 8, 11])
def test_short_gaps_are_bridged_on_the_way(gap_ticks: int) -> None:
    ways = {"a": line(0, 0, 10, 0), "b": line(0, 6, 10, 0)}
    tracks = track(*record(ways, 50, hidden={"a": (20, 20 + gap_ticks)}), **OPTIONS)
    assert sorted(names_of(tracks)) == [["a"], ["b"]]
    (a,) = [t for t in tracks if t.measurements.camera[0] == "a"]
    assert a.tick.tolist() == [k for k in range(50) if not 20 <= k < 20 + gap_ticks]


def test_an_occlusion_is_stitched_and_not_beyond_what_is_allowed() -> None:
    ways, hidden = {"a": line(0, 0, 1.4, 0), "b": line(0, 9, 1.4, 0)}, {"a": (30, 50)}
    found, t_ns = record(ways, 80, hidden=hidden, category="pedestrian")
    tracks = track(found, t_ns, **OPTIONS)
    assert sorted(names_of(tracks)) == [["a"], ["b"]]
    # The gap is 2.1 s from the last tick before to the first one after it.
    assert len(track(found, t_ns, **{**OPTIONS, "max_gap_s": 2.05})) == 3
    assert len(track(found, t_ns, **{**OPTIONS, "max_gap_s": 2.15})) == 2


def test_one_who_left_is_not_what_else_begins_near_in_a_crowd() -> None:
    """A single box 1.5 m beside the way of a pedestrian last seen 1.5 s ago is the same one where nothing else begins, not among many."""
    ways: dict[str, Way] = {"a": line(0, 0, 1.4, 0), "stray": lambda t: (1.4 * t, 1.5)}
    found, t_ns = record(ways, 80, hidden={"a": (30, 80)}, category="pedestrian")
    for k in [*range(45), *range(46, 80)]:
        found[k] = found[k].take(found[k].camera == "a")
    assert names_of(track(found, t_ns, **OPTIONS)) == [["a", "stray"]]
    rng = np.random.default_rng(0)
    for k in range(30, 80):
        xy = np.array([6.0, 0.0]) + rng.uniform(-10, 10, (3, 2))
        others = seen(xy[np.abs(xy[:, 1]) > 3.0], t_ns[k], "other", category="pedestrian")
        found[k] = Measurements.join([found[k], others])
    assert ["a"] in names_of(track(found, t_ns, **OPTIONS))


def test_one_who_comes_the_other_way_is_not_the_one_who_left_there() -> None:
    """The first box after a gap is where who left may be; the way that it takes from there tells that it is another."""
    ways: dict[str, Way] = {"a": line(0, 0, 3.5, 0), "b": line(25.2, 0.1, -3.5, 0)}
    found, t_ns = record(ways, 70, hidden={"a": (29, 70), "b": (0, 36)}, category="cyclist")
    assert names_of(track(found, t_ns, **OPTIONS, whole_boxes=True)) == [["a"], ["b"]]


@pytest.mark.parametrize(("later", "count"), [("cyclist", 1), ("pedestrian", 1), ("car", 2)])
def test_a_rider_who_comes_out_of_an_occlusion_may_be_taken_for_a_pedestrian(later: str, count: int) -> None:
    found, t_ns = record({"a": line(0, 0, 2, 0)}, 60, hidden={"a": (15, 28)}, category="cyclist")
    found[28:] = record({"a": line(0, 0, 2, 0)}, 60, category=later)[0][28:]
    assert len(track(found, t_ns, **OPTIONS)) == count


def test_what_comes_out_of_an_occlusion_elsewhere_is_somebody_else() -> None:
    def jumping(t: float) -> tuple[float, float]:
        return (8 * t, 0.0) if t < 3.5 else (8 * t, 12.0)

    def turned(t: float) -> tuple[float, float]:
        # Both ends meet in the middle of the gap, at 3.55 s, with speeds that are opposite.
        return (28.4 - 8 * abs(t - 3.55), 0.0)

    for way in (jumping, turned):
        tracks = track(*record({"a": way}, 80, hidden={"a": (30, 42)}), **OPTIONS)
        assert [len(t) for t in tracks] == [30, 38]


def test_two_that_pass_behind_the_same_truck_come_out_as_themselves() -> None:
    ways = {"fast": line(0, 0, 12, 0), "slow": line(10, 4, 6, 0)}
    tracks = track(*record(ways, 70, hidden={"fast": (25, 37), "slow": (25, 37)}), **OPTIONS)
    assert sorted(names_of(tracks)) == [["fast"], ["slow"]]
    assert [len(t) for t in tracks] == [58, 58]


def test_a_single_box_in_a_gap_stays_with_the_rider_on_both_sides_of_it() -> None:
    # Taken for a pedestrian it shows no motion, and none who walks would be so far on; what rides on after it does tell.
    found, t_ns = record({"rider": line(0, 0, 5, 0)}, 60, hidden={"rider": (20, 40)}, category="cyclist")
    found[29] = seen(np.array([[14.5, 0.0]]), t_ns[29], ["rider"], category="pedestrian")
    (one,) = track(found, t_ns, **OPTIONS | {"whole_boxes": True, "min_life_s": 0.0})
    assert one.category == "cyclist"
    assert one.tick.tolist() == [*range(20), 29, *range(40, 60)]
    # Beside the way it is somebody else.
    found[29] = seen(np.array([[14.5, 4.0]]), t_ns[29], ["other"], category="pedestrian")
    (one,) = track(found, t_ns, **OPTIONS | {"whole_boxes": True, "min_life_s": 0.0})
    assert one.tick.tolist() == [*range(20), *range(40, 60)]


def test_what_stands_is_the_same_however_long_it_was_hidden() -> None:
    ways = {"parked": line(20, 5, 0, 0), "passing": line(0, 0, 10, 0)}
    tracks = track(*record(ways, 120, hidden={"parked": (30, 90)}), **OPTIONS)
    assert sorted(names_of(tracks)) == [["parked"], ["passing"]]


def test_what_was_measured_before_and_after_its_tick_is_placed_where_it_was_then() -> None:
    # Two cameras at odds: every other measurement is 50 ms old and so 1 m behind, at 20 m/s.
    t_ns = stamps(40)
    age = np.where(np.arange(40) % 2 == 0, 0, -50_000_000)
    found = [
        seen(np.array([[20.0 * (k * PERIOD_S + age[k] / NS_PER_S), 0.0]]), t_ns[k] + age[k], "a") for k in range(40)
    ]
    tracker = ForwardTracker(birth_score=0.4, period_s=PERIOD_S)
    for m, now_ns in zip(found, t_ns.tolist()):
        tracker.step(m, now_ns)
    # State at the last tick: exact data of constant speed give the exact place for that tick, not for the old stamp.
    ((x, _, speed, _),) = tracker.tracks["mean"][:, 0]
    assert x == pytest.approx(20.0 * 3.9, abs=0.15)
    assert speed == pytest.approx(20.0, abs=0.3)


def test_a_short_track_whose_stamps_run_backward_is_not_its_own_continuation() -> None:
    # Two ticks share a sweep, and in the second one a camera sees the object 0.2 ms earlier; beside it is a track of all ticks.
    t_ns = stamps(10)
    found = [seen(np.array([[0.0, 0.0]]), t_ns[k], "always") for k in range(10)]
    for k, late_ns in ((4, 9_321_000), (5, 9_142_000)):
        found[k] = seen(
            np.array([[0.0, 0.0], [30.0, 0.0]]), np.array([t_ns[k], t_ns[4] + late_ns]), ["always", "twice"]
        )
    assert names_of(track(found, t_ns, **OPTIONS | {"min_life_s": 0.2})) == [["always"], ["twice"]]


def test_order_of_rows_time_and_map_offsets_change_nothing() -> None:
    ways = {"a": line(0, 0, 12, 0), "b": line(60, 3.5, -14, 0), "c": line(20, -8, 0, 0)}
    found, t_ns = record(ways, 40, hidden={"a": (15, 30)})
    far = [
        replace(m, center_m=np.add(m.center_m, [457_000.0, 5_428_000.0, 0.0]), t_ns=m.t_ns - START_NS).take(
            np.arange(len(m))[::-1]
        )
        for m in found
    ]
    here, there = track(found, t_ns, **OPTIONS), track(far, t_ns - START_NS, **OPTIONS)
    assert names_of(here) == names_of(there)
    assert [t.tick.tolist() for t in here] == [t.tick.tolist() for t in there]


def test_without_measurements_there_are_no_tracks() -> None:
    t_ns = stamps(5)
    assert track([Measurements.empty()] * 5, t_ns, **OPTIONS) == []
    assert track([], stamps(0), **OPTIONS) == []
    assert stitch(Measurements.empty(), [], max_gap_s=3.0) == []


def test_a_track_takes_what_is_likely_and_nothing_else() -> None:
    # What stood for 2 s is known to 0.4 m or so: 1.2 m aside for a moment is an outlier of it, 5 m aside is another one.
    t_ns = stamps(40)
    for aside_m, lives in ((1.2, [40]), (5.0, [20, 20])):
        later = 5.0 + aside_m * (np.arange(40) >= 20) if aside_m > 2 else 5.0 + aside_m * (np.arange(40) == 20)
        found = [seen(np.array([[5.0, y]]), t) for y, t in zip(later, t_ns)]
        assert [len(ticks) for ticks, _ in track_forward(found, t_ns, birth_score=0.4)] == lives


def test_weak_scores_continue_a_track_but_start_none() -> None:
    t_ns = stamps(20)
    place = np.array([[5.0, 5.0]])
    assert track([seen(place, t, score=0.39) for t in t_ns], t_ns, **OPTIONS) == []
    (one,) = track([seen(place, t, score=0.4 if k < 3 else 0.2) for k, t in enumerate(t_ns)], t_ns, **OPTIONS)
    assert len(one) == 20


def test_short_lives_are_false_alarms_except_in_a_log_as_short() -> None:
    found, t_ns = record({"a": line(0, 0, 0, 0)}, 20, hidden={"a": (2, 20)})
    assert track(found, t_ns, **OPTIONS) == []
    assert len(track(found, t_ns, **{**OPTIONS, "min_life_s": 0.2})) == 1
    assert len(track(found[:1], t_ns[:1], **OPTIONS)) == 1
    assert [min_hits(stamps(n), 0.3) for n in (1, 2, 3, 4, 10, 100)] == [1, 1, 2, 2, 3, 3]
    assert min_hits(stamps(100, 0.02), 0.3) == 15


def test_cars_and_pedestrians_are_never_one_and_riders_may_be() -> None:
    t_ns = stamps(20)
    place = np.array([[5.0, 5.0]])

    def changing(first: str, later: str) -> list[Track]:
        found = [seen(place, t, category=first if k < 10 else later) for k, t in enumerate(t_ns)]
        return track(found, t_ns, **OPTIONS)

    assert [t.category for t in changing("car", "pedestrian")] == ["car", "pedestrian"]
    assert [len(t) for t in changing("car", "truck")] == [20]  # one group
    assert [len(t) for t in changing("pedestrian", "cyclist")] == [20]


def test_the_category_is_that_of_most_of_the_score() -> None:
    rows = [
        seen(np.zeros((1, 2)), START_NS, category=c, score=s)
        for c, s in (("car", 0.3), ("car", 0.3), ("car", 0.3), ("truck", 0.95))
    ]
    assert decide_category(Measurements.join(rows)) == "truck"
    assert decide_category(Measurements.join(rows[:3])) == "car"
    assert (
        decide_category(Measurements.join([rows[3], seen(np.zeros((1, 2)), START_NS, category="bus", score=0.95)]))
        == "bus"
    )


def test_a_group_wins_before_a_category_does_and_images_tell_two_wheelers_apart() -> None:
    def voted(*rows: tuple[str, float, str]) -> str:
        parts = [
            replace(seen(np.zeros((1, 2)), START_NS, category=c, score=s), camera=np.array([camera]))
            for c, s, camera in rows
        ]
        return decide_category(Measurements.join(parts))

    rider = (("cyclist", 0.4, "front"), ("motorcycle", 0.4, "front"), ("pedestrian", 0.7, "front"))
    assert voted(*rider) == "cyclist"
    assert voted(*rider, ("pedestrian", 0.2, "front")) == "pedestrian"
    sweeps = (("cyclist", 0.9, ""), ("cyclist", 0.9, ""))
    assert voted(*sweeps) == "cyclist"
    assert voted(*sweeps, ("motorcycle", 0.3, "front")) == "motorcycle"
    assert voted(("car", 0.9, ""), ("car", 0.9, ""), ("truck", 0.3, "front")) == "car"


@pytest.mark.parametrize(
    ("speed_mps", "third", "category"),
    [(0.0, "pedestrian", "bicycle"), (1.5, "pedestrian", "cyclist"), (1.5, "motorcycle", "bicycle"), (1.5, "bicycle", "bicycle")],
)  # fmt: skip
def test_a_bicycle_that_moves_and_shows_a_rider_is_ridden(speed_mps: float, third: str, category: str) -> None:
    t_ns = stamps(30)
    rng = np.random.default_rng(2)
    xy = np.column_stack([speed_mps * (t_ns - t_ns[0]) / NS_PER_S, np.zeros(len(t_ns))]) + rng.normal(0, 0.3, (30, 2))
    xy[4] += 9.0
    rows = seen(xy, t_ns, category="bicycle")
    shown = np.where(np.arange(30) % 3 < 1, third, "bicycle")
    assert decide_category(replace(rows, category=shown)) == category


@pytest.mark.parametrize("period_s", [0.1, 0.5])
def test_a_rider_who_passes_parked_bicycles_keeps_the_track_and_they_stay(period_s: float) -> None:
    rng, t_ns = np.random.default_rng(4), stamps(round(6.0 / period_s), period_s)
    racks = np.column_stack([np.arange(4.0, 30.0, 3.0), np.full(9, 2.0)])
    found = []
    for t in t_ns:
        rider = np.array([[4.5 * (t - START_NS) / NS_PER_S, 0.0]])
        shown = rng.random(len(racks)) < 0.6
        xy = np.concatenate([rider, racks[shown]]) + rng.normal(0, 0.15, (1 + shown.sum(), 2))
        names = ["rider", *(f"rack{k}" for k in np.flatnonzero(shown))]
        found.append(seen(xy, t, names, ["cyclist"] + ["bicycle"] * int(shown.sum())))
    tracks = track(found, t_ns, **OPTIONS)
    assert [t.category for t in tracks if "rider" in t.measurements.camera] == ["cyclist"]
    rider = next(t for t in tracks if "rider" in t.measurements.camera)
    assert (rider.measurements.camera == "rider").mean() > 0.9
    parked = [t.measurements for t in tracks if t is not rider]
    assert max(np.ptp(m.center_m[:, 0]) for m in parked) < 4.0
    assert {c for t in tracks for c in [t.category] if t is not rider} == {"bicycle"}


@pytest.mark.parametrize(("away_m", "continued"), [(0.3, True), (1.0, False)])
def test_a_weak_detection_of_a_person_continues_a_track_only_near_its_prediction(
    away_m: float, continued: bool
) -> None:
    t_ns = stamps(12)
    found = [seen(np.array([[5.0, 0.0]]), t, category="pedestrian", score=0.8) for t in t_ns[:11]]
    found.append(seen(np.array([[5.0, away_m]]), t_ns[11], category="pedestrian", score=0.25))
    (only,) = track(found, t_ns, **OPTIONS)
    assert len(only) == 11 + continued


@pytest.mark.parametrize(
    ("speed_mps", "category"), [(1.4, "pedestrian"), (2.7, "pedestrian"), (3.4, "cyclist"), (6.0, "cyclist")]
)
@pytest.mark.parametrize("period_s", [0.05, 0.1, 0.25])
def test_a_pedestrian_faster_than_people_run_is_a_cyclist_at_any_rate(speed_mps, category, period_s) -> None:
    t_ns = stamps(round(3.0 / period_s), period_s)
    xy = np.column_stack([speed_mps * (t_ns - t_ns[0]) / NS_PER_S, np.zeros(len(t_ns))])
    rows = seen(xy, t_ns, category="pedestrian")
    assert decide_category(rows) == category
    assert decide_category(seen(xy, t_ns, category="car")) == "car"


@settings(max_examples=40, deadline=None)
@given(
    st.dictionaries(st.tuples(st.integers(0, 7), st.integers(0, 7)), st.integers(0, 50), max_size=14),
    st.sampled_from([NEVER, 25.0]),
)
def test_joins_of_groups_are_as_good_as_those_of_all_together(costs, alone):
    """As many joins as possible, and of those the cheapest: as over a table of all pairs; or those that cost less than none."""
    pairs = np.array(list(costs), dtype=np.intp).reshape(-1, 2)
    cost = np.array(list(costs.values()), dtype=float)
    chosen = choose_pairs(pairs[:, 0], pairs[:, 1], cost, alone)
    first, second = pairs[chosen].T
    table = np.full((8, 8), alone)
    table[pairs[:, 0], pairs[:, 1]] = np.minimum(cost, alone)
    assert len(set(first.tolist())) == len(set(second.tolist())) == len(first)
    assert table[first, second].sum() + alone * (8 - len(first)) == table[linear_sum_assignment(table)].sum()
