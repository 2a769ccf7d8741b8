"""Poses and clocks of roadside units, disturbed in worlds with exact truth, are found, told and corrected; nothing else is."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from benchmarks.registration import disturbed, draw_world, errors_of, misplaced
from cooperation_worlds import blind_area, curve, hidden_traffic, overlap
from cooperation_worlds.blind_area import FIRST_SIGHT_S, ROAD_SIGHT_S
from cooperation_worlds.hidden_traffic import HiddenTraffic, sweeps
from cooperation_worlds.world import ROAD_LIDAR, VEHICLE_LIDAR, World, cast

from log2sim.config import Config
from log2sim.datatypes import Boxes3D, Lidar, Log, Stream, Sweep
from log2sim.geometry import NS_PER_S, Array, Camera, PoseTrack, apply, inverse, transform
from log2sim.localization.roadside import (
    Estimate,
    Findings,
    RoadRegistration,
    Sight,
    Unit,
    add_drift,
    correct_unit,
    covariance_of_poses,
    estimate_error,
    register_road,
    units_of,
)
from log2sim.localization.roadside_fit import (
    CommonObjects,
    Evidence,
    Matched,
    MatchedStructure,
    ObjectTrack,
    RoadView,
    VehicleView,
    compare_visibility,
    surfaces_of,
    track_of,
    upright_points,
    view_from_road,
)
from log2sim.localization.surfaces import exp_of, log_of
from log2sim.plan import choose_detector, select_sensors
from log2sim.synth.traffic_data import START_NS

POLE = "pole0"


@pytest.fixture(scope="module")
def street() -> Log:
    """A street with buildings, moving traffic, and a LiDAR of 32 lines on a pole."""
    return draw_world("street", 5, "level32", duration_s=2.0, step_deg=1.2)


def register(log: Log, **asked: object) -> RoadRegistration:
    config = choose_detector(log, Config().changed(cooperation=asked) if asked else Config())
    return register_road(log, config, select_sensors(log, config), progress=lambda *_: None)


def test_a_pole_that_is_moved_turned_and_late_is_put_right(street: Log) -> None:
    bad = disturbed(street, POLE, 0.5, 2.0, 0.2, np.random.default_rng(0))
    found = register(bad)
    away_m, turned_deg, late_s = errors_of(found.log, street, POLE)
    assert away_m < 0.1
    assert turned_deg < 0.3
    # In 2 s pairs of boxes that move are few: the clock is known to some 10 or 50 ms by how many both ends find, or said not to be.
    sigma_s = found.faults[1].values["delay_sigma_s"]
    assert abs(late_s) < 2 * sigma_s < 0.15
    kinds = [fault.kind for fault in found.faults]
    assert kinds[:2] == ["road_pose", "road_clock"]
    assert kinds[2:] in ([], ["unknown_road_clock"])
    assert found.figures[0]["treatment"] == "corrected"


@pytest.mark.slow
def test_a_pose_that_contradicts_what_the_vehicle_sees_is_left_out(street: Log) -> None:
    found = register(misplaced(street, POLE, 8.0, 90.0))
    assert [(fault.kind, fault.subject, fault.treatment) for fault in found.faults] == [
        ("wrong_road_pose", POLE, "left_out")
    ]


UNIT = Unit(("pole",), (), np.zeros(3))
ERROR = np.array([0.3, -0.35, 0.2, 0.01, -0.02, 0.025])


def still(points: Array) -> RoadView:
    return RoadView(points, np.ones(len(points)))


# --- common objects


def drive(start: tuple[float, float], velocity: tuple[float, float], t_s: Array, group: int = 0) -> ObjectTrack:
    place, one = np.array(start) + t_s[:, None] * np.array(velocity), np.ones(len(t_s))
    box = [-3 * one, 2.2 * one, 0.9 * one, *(0.1 * one for _ in range(4)), np.arctan2(velocity[1], velocity[0]) * one]
    return track_of(np.column_stack([group * one, t_s, place, *box, 0.02 * one]))


def seen_by_road(track: ObjectTrack, error: Array, delay_s: float) -> ObjectTrack:
    """The track as a road end with an error of its pose and late stamps gives it."""
    wrong, box = inverse(exp_of(error)), track.box.copy()
    box[:, :3] = apply(wrong, box[:, :3])
    box[:, 9] -= error[5]
    velocity = track.velocity_mps @ wrong[:2, :2].T
    return ObjectTrack(track.t_s + delay_s, box, velocity, track.group)


@pytest.mark.parametrize("delay_s", [0.0, 0.1, 0.3])
def test_traffic_alone_shows_the_pose_in_the_plane_and_the_delay(delay_s: float) -> None:
    t_s = np.arange(0.0, 4.0, 0.2)
    cars = [
        drive((-20, 3), (10, 0), t_s),
        drive((25, -3), (-12, 0), t_s),
        drive((8, -15), (0, 5), t_s),
        drive((-5, 8), (1.2, -0.4), t_s, 1),
    ]
    error = ERROR * np.array([1, 1, 0, 0, 0, 1])
    objects = CommonObjects.of(cars, [seen_by_road(car, error, delay_s) for car in cars])
    found = estimate_error(Sight(None, still(np.zeros((0, 3))), None, None, objects))
    assert found.values[6] == pytest.approx(delay_s, abs=0.01)
    assert found.values[[0, 1]] == pytest.approx(error[:2], abs=0.04)
    assert np.degrees(found.values[5] - error[5]) == pytest.approx(0.0, abs=0.1)


def test_what_all_boxes_of_a_track_have_in_common_turns_no_pole_and_what_stands_tells_no_time() -> None:
    t_s = np.arange(0.0, 4.0, 0.2)
    car = drive((-20, 3), (10, 0), t_s)

    def found(seen: ObjectTrack, *road: ObjectTrack) -> tuple[Array, Array]:
        out = estimate_error(
            Sight(None, still(np.zeros((0, 3))), None, None, CommonObjects.of([seen, *road[1:]], road))
        )
        return out.values, np.sqrt(np.diag(out.covariance))

    # All boxes lie 0.1 m to one side.
    aside, turned = replace(car, box=car.box.copy()), seen_by_road(car, np.array([0, 0, 0, 0, 0, 0.02]), 0.0)
    aside.box[:, 1] += 0.1
    values, sigma = found(car, aside)
    assert abs(values[5]) < 0.001
    assert 0.03 < sigma[1] < 0.15
    # Over a way of 38 m they show a turn that is less than the 1.6 degrees of a single box.
    values, sigma = found(car, turned)
    assert values[5] == pytest.approx(0.02, abs=0.002)
    assert sigma[5] < np.radians(0.3)
    # Boxes of what waits jump this way and that, which is no velocity.
    jumping, other = (
        replace(drive((-9, y), (0, 0), t_s), velocity_mps=np.tile([v, 0.0], (len(t_s), 1)))
        for y, v in ((12, 0.8), (-9, -0.8))
    )
    assert found(jumping, jumping, other)[1][6] == pytest.approx(0.3, abs=0.01)


def test_a_side_that_both_ends_see_places_a_box_whose_length_one_of_them_guesses() -> None:
    t_s = np.arange(0.0, 2.0, 0.2)
    car, waits = drive((10, 4), (8, 0), t_s), drive((-9, 12), (0, 0), t_s)
    guessed = [replace(track, box=track.box.copy()) for track in (car, waits)]
    for track in guessed:
        # The rear is seen; the front is taken for 1.2 m too far, and known to be a guess.
        track.box[:, 0] += 0.6
        track.box[:, 3] += 0.6
        track.box[:, 6] = 1.5
    found = estimate_error(Sight(None, still(np.zeros((0, 3))), None, None, CommonObjects.of([car, waits], guessed)))
    assert np.abs(found.values[[0, 1, 5]]).max() < 0.03


# --- structure


def walls(step_m: float) -> tuple[Array, Array]:
    """Points on the ground and two walls around a pole 4 m high at the origin, and a sensor that sees them."""
    span = np.arange(-15, 15, step_m)
    x, y = (a.ravel() for a in np.meshgrid(span, span))
    ground = np.stack([x, y, np.full_like(x, -4.0)], axis=1)
    u, v = (a.ravel() for a in np.meshgrid(span, np.arange(-4, 2, step_m)))
    across, along = np.stack([np.full_like(u, 16.0), u, v], axis=1), np.stack([u, np.full_like(u, 17.0), v], axis=1)
    return np.concatenate([ground, across, along]), np.array([[0.0, -2.0, -2.0]])


def view_of(points: Array, sensors: Array) -> VehicleView:
    return VehicleView(points, sensors, np.zeros(1, np.int64), np.zeros(len(points), np.int64))


def test_walls_and_ground_show_the_whole_pose() -> None:
    rng = np.random.default_rng(0)
    points, sensors = walls(0.3)
    surfaces = surfaces_of(view_of(points + rng.normal(0, 0.01, points.shape), sensors), points)
    road = apply(inverse(exp_of(ERROR)), walls(0.7)[0] + 0.13)
    road = road + rng.normal(0, 0.01, road.shape)
    found = estimate_error(Sight(None, still(road), surfaces, None, CommonObjects(())))
    assert np.linalg.norm(found.values[3:6] - ERROR[3:]) < np.radians(0.1)
    # All points of the road were moved by 0.13 m along each axis, too.
    assert found.values[:3] == pytest.approx(ERROR[:3] - 0.13, abs=0.03)
    findings = Findings(UNIT, found, (None, None))
    assert findings.moved
    assert findings.verified


def test_the_ground_alone_shows_height_and_tilt_and_no_more() -> None:
    points, sensors = walls(0.3)
    ground = points[points[:, 2] == -4.0]
    rough = ground + np.random.default_rng(0).normal(0, 0.02, ground.shape)
    surfaces = surfaces_of(view_of(rough, sensors), ground)
    found = estimate_error(
        Sight(None, still(apply(inverse(exp_of(ERROR)), ground[::5])), surfaces, None, CommonObjects(()))
    )
    sigma = np.sqrt(np.diag(found.covariance))
    assert found.values[[2, 3, 4]] == pytest.approx(ERROR[[2, 3, 4]], abs=0.03)
    assert (sigma[:2] > 0.49).all()
    assert np.abs(found.values[[0, 1, 5]]).max() < 0.05
    findings = Findings(UNIT, found, (None, None))
    assert not findings.verified
    assert findings.applied[[2, 3, 4]] == pytest.approx(ERROR[[2, 3, 4]], abs=0.03)
    assert not findings.applied[[0, 1, 5, 6]].any()
    assert [fault.kind for fault in findings.faults()] == ["road_pose", "unknown_road_pose", "unknown_road_clock"]


def test_drift_of_the_poses_of_the_ego_adds_to_the_sigma() -> None:
    points, sensors = walls(0.4)
    sweep = np.arange(len(points)) % 3
    drifting = points + np.array([[-0.15, 0.0, 0.0], [0.0, 0.0, 0.0], [0.15, 0.0, 0.0]])[sweep]
    sigmas = []
    for seen in (points, drifting):
        view = VehicleView(seen, np.repeat(sensors, 3, axis=0), np.arange(3), sweep)
        sight = Sight(view, still(points[::7]), surfaces_of(view, points), None, CommonObjects(()))
        found = estimate_error(sight)
        sigmas.append(np.sqrt((add_drift(sight, found).covariance - found.covariance)[0, 0]))
    assert sigmas[0] < 0.01
    assert 0.03 < sigmas[1] < 0.1


def test_errors_of_the_poses_of_the_ego_move_a_pole_by_its_distance() -> None:
    still_m = np.array([[20.0, 0.0, -1.0]])
    at_s = np.arange(0.0, 4.01, 0.2)
    view = VehicleView(np.zeros((1, 3)), still_m, np.round(at_s * NS_PER_S).astype(np.int64), np.zeros(1, np.int64))
    sigmas = {"sigma_m": np.full(2, 0.03), "sigma_yaw_rad": np.full(2, 0.002)}
    poses = PoseTrack(np.arange(2), np.repeat(np.eye(4)[None], 2, axis=0), **sigmas)
    rng = np.random.default_rng(0)
    # Means of errors that last for 2 s, over 4 s.
    noise = np.linalg.cholesky(np.exp(-np.abs(at_s[:, None] - at_s) / 2.0)).mean(axis=0)
    off = np.einsum("k,nkj->nj", noise, rng.normal(size=(4000, len(at_s), 6))) * np.repeat([0.03, 0.002], 3)
    # The pole at the origin, as seen from an ego that believes itself to be elsewhere.
    at = transform(np.eye(3), still_m[0])
    moved = np.array([log_of(at @ exp_of(twist) @ inverse(at)) for twist in off])
    assert np.sqrt(np.diag(covariance_of_poses(poses, view))[:6]) == pytest.approx(moved.std(axis=0), rel=0.1)
    # Of one moment, all of the error is left.
    alone = covariance_of_poses(poses, replace(view, t_ns=view.t_ns[:1]))
    assert np.sqrt(np.diag(alone)[[0, 5]]) == pytest.approx([0.03, 0.002], rel=0.01)


# --- free space


def test_what_the_vehicle_saw_through_contradicts_a_pose() -> None:
    points, sensors = walls(0.25)
    upright = points[points[:, 2] > -3.0]
    healthy = compare_visibility(view_of(points, sensors), upright_points(points))
    assert healthy.contradicting < 0.05
    assert healthy.seen > 0.8 * len(upright)
    nearer = apply(transform(np.eye(3), np.array([-8.0, -8.0, 0.0])), upright_points(points))
    assert compare_visibility(view_of(points, sensors), nearer).contradicting > 0.8


# --- units


def sweep_log(frame: str = "lidar") -> Log:
    lidars = {
        name: Lidar(name, "map", transform(np.eye(3), np.array([x, 0.0, 4.0])))
        for name, x in (("pole", 0.0), ("beside", 1.0), ("far", 40.0))
    }
    camera = Camera(
        "eye", 640, 480, np.eye(3), mount="map", mount_T_cam=transform(np.eye(3), np.array([0.5, 0.0, 4.0]))
    )
    t_ns = np.array([10**9, 2 * 10**9])
    xyz = np.random.default_rng(0).uniform(-5, 5, (50, 3))

    def read(i: int) -> Sweep:
        return Sweep(int(t_ns[i]), xyz, frame, np.full(50, t_ns[i]))  # type: ignore[arg-type]

    streams = {name: Stream(name, t_ns, read) for name in lidars} | {"eye": Stream("eye", t_ns, lambda i: i)}
    return Log("log", "test", {"eye": camera}, lidars, streams)


@pytest.mark.parametrize("frame", ["lidar", "map"])
def test_a_unit_is_corrected_with_its_cameras_and_its_clock(frame: str) -> None:
    log = sweep_log(frame)
    unit = units_of(log, list(log.lidars))[0]
    right = correct_unit(log, unit, exp_of(ERROR), 0.25)
    at = unit.site_m
    expected = apply(exp_of(ERROR), log.lidars["pole"].mount_T_lidar[None, :3, 3] - at)[0] + at
    assert right.lidars["pole"].mount_T_lidar[:3, 3] == pytest.approx(expected)
    assert right.lidars["far"] is log.lidars["far"]
    apart = inverse(log.lidars["pole"].mount_T_lidar) @ log.cameras["eye"].mount_T_cam
    assert inverse(right.lidars["pole"].mount_T_lidar) @ right.cameras["eye"].mount_T_cam == pytest.approx(apart)
    assert right.streams["eye"].t_ns.tolist() == (log.streams["eye"].t_ns - 250_000_000).tolist()
    assert right.streams["eye"].read(1) == 1
    before, after = log.streams["pole"].read(0), right.streams["pole"].read(0)
    assert after.t_ns.tolist() == (before.t_ns - 250_000_000).tolist()
    moved = apply(exp_of(ERROR), before.xyz_m - at) + at
    assert after.xyz_m == pytest.approx(before.xyz_m if frame == "lidar" else moved)


def test_what_passes_is_not_what_stands() -> None:
    rng = np.random.default_rng(0)
    wall = np.stack([np.full(400, 10.0), rng.uniform(-5, 5, 400), rng.uniform(-3, 1, 400)], axis=1)
    t_ns = (np.arange(20) * 1e8).astype(np.int64)

    def read(i: int) -> Sweep:
        car = np.array([5.0, -8.0 + 0.8 * i, -2.0]) + rng.uniform(-0.2, 0.2, (50, 3))
        return Sweep(int(t_ns[i]), np.concatenate([wall, car]))

    log = Log("log", "test", {}, {"pole": Lidar("pole", "map", np.eye(4))}, {"pole": Stream("pole", t_ns, read)})
    seen = view_from_road(log, ["pole"], np.zeros(3)).xyz_m
    assert (np.abs(seen[:, 0] - 10.0) < 0.01).all()


# --- what is told


def estimate(values: Array, sigma: Array) -> Estimate:
    return Estimate(values, np.diag(sigma**2), (None, None), (None, None))


FINE = np.array([0.02, 0.02, 0.03, 0.003, 0.003, 0.001, 0.01])


def fitting(found: Estimate) -> Estimate:
    """The estimate with structure that fits better with it, and a car that both ends see drive."""
    nothing = Evidence(np.zeros((7, 7)), np.zeros(7))
    structure = MatchedStructure(nothing, 900, 200, 0.3), MatchedStructure(nothing, 900, 850, 0.01)
    return replace(found, structure=structure, objects=(None, Matched(nothing, 1, 1, 10.0, 0.1)))


def test_an_error_is_told_if_it_is_certain_and_matters() -> None:
    large, small = np.array([0.3, 0.2, 0, 0, 0, 0.01, 0.0]), np.array([0.05, 0.05, 0.0, 0.0, 0.0, 0.002, 0.0])
    certain = Findings(UNIT, fitting(estimate(large, FINE)), (None, None))
    assert [fault.kind for fault in certain.faults()] == ["road_pose"]
    assert certain.applied == pytest.approx(large)
    # What could be off by more than matters is told to be so, with its sigma.
    for values, sigma, told in (
        (small, FINE / 5, []),
        (small, FINE * [3, 3, 1, 1, 1, 1, 1], ["unknown_road_pose"]),  # within 0.1 m in four of five cases
        (small, 8 * FINE, ["unknown_road_pose", "unknown_road_clock"]),
        (large, 8 * FINE, ["unknown_road_pose", "unknown_road_clock"]),
    ):
        findings = Findings(UNIT, fitting(estimate(values, sigma)), (None, None))
        assert [fault.kind for fault in findings.faults()] == told
        assert not findings.applied.any()


def test_a_clock_is_told_to_be_unknown_where_nothing_that_both_ends_see_moves() -> None:
    moving = fitting(estimate(np.zeros(7), FINE / 5))
    stands = replace(moving, objects=(None, replace(moving.objects[1], moving=0)))  # type: ignore[type-var]
    told = {k: Findings(UNIT, found, (None, None)).faults() for k, found in enumerate((moving, stands))}
    assert [[fault.kind for fault in faults] for faults in told.values()] == [[], ["unknown_road_clock"]]
    assert "a sigma of 2 ms" in told[1][0].sentence
    # 19 ms that are not certain stay, and are as likely to matter as not; and 15 ms of sigma are too many.
    for late_s, sigma_s in ((0.019, 0.008), (0.0, 0.015)):
        found = estimate(np.array([0, 0, 0, 0, 0, 0, late_s]), np.array([*FINE[:6] / 5, sigma_s]))
        assert [fault.kind for fault in Findings(UNIT, fitting(found), (None, None)).faults()] == ["unknown_road_clock"]


DRAW = {"range": curve.draw, "blind_area": blind_area.draw, "overlap": overlap.draw}
SEEDS = (1, 5)  # the first one drawn for 5 shows the walker too early


@cache
def drawn(test: str, seed: int) -> World:
    """Draw a world once for all tests."""
    return DRAW[test](seed)


def points_on_target(world: World, lidar: str, t_s: float) -> int:
    """Count the returns of the target in a sweep that ends at a time; what no ray reaches is hidden."""
    spec = next(s for s in world.scene.lidar if s.name == lidar)
    stamp = world.scene.start_ns + round(t_s * 1e9)
    returns, _ = cast(world, world.moving, spec, stamp, np.random.default_rng(0))
    index = [a.id for a in world.scene.agent].index(world.target)
    return int((returns.hit == index).sum())


@pytest.mark.slow
@pytest.mark.matrix
@pytest.mark.parametrize("seed", SEEDS)
def test_the_walker_hides_from_the_vehicle_and_not_from_the_pole(seed: int) -> None:
    world = drawn("blind_area", seed)
    # A sweep ends a period after it begins.
    before = np.arange(FIRST_SIGHT_S[1] + 0.1, ROAD_SIGHT_S, 0.6)
    alone = [points_on_target(world, VEHICLE_LIDAR, world.contact_s - b) for b in before]
    road = [points_on_target(world, ROAD_LIDAR, world.contact_s - b) for b in before]
    assert max(alone) <= 5
    assert min(road) >= 8
    assert points_on_target(world, VEHICLE_LIDAR, world.contact_s) > 20


@pytest.mark.slow
def test_true_boxes_of_random_traffic_score_1_and_those_of_the_vehicle_alone_less() -> None:
    traffic = hidden_traffic.drawn(3, 0)
    stamps = traffic.log.streams[VEHICLE_LIDAR].t_ns
    boxes = [true_boxes(traffic, int(stamp) - 30_000_000) for stamp in stamps]
    everything = sweeps(traffic, stamps, boxes)
    hidden = np.concatenate([s["vehicle"][2] for s in everything])
    counted = ~np.concatenate([s["vehicle"][1].ignored for s in everything])
    figures = hidden_traffic.figures(
        {"all": everything, "nothing": sweeps(traffic, stamps, [Boxes3D.empty()] * len(stamps))}
    )
    assert figures["ap"]["vehicle"] == {"all": 1.0, "nothing": 0.0}
    assert (hidden & counted).sum() < counted.sum()


def true_boxes(traffic: HiddenTraffic, t_ns: int) -> Boxes3D:
    """Make what a perfect detector finds at a time, as it moved until then."""
    users = [o for o in traffic.run.at((t_ns - START_NS) / 1e9).objects if o.category]
    size = np.array([o.size_m for o in users])
    center = np.array([o.position_m for o in users]) + size * [0, 0, 0.5]
    some, yaw = np.ones(len(users)), np.array([o.yaw_rad for o in users])
    category = np.array([o.category for o in users], dtype="<U16")
    return Boxes3D(np.full(len(users), t_ns), center, size, yaw, some, category, some, some.astype(np.int64))
