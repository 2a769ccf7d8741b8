"""Image-to-ground homographies: how near they come to what the data allow, and what they refuse."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from log2sim.datatypes import GROUP_OF, MAX_SIZE_M, MIN_SIZE_M, TYPICAL_SIZE_M, Detections, Measurements
from log2sim.geometry import (
    Camera,
    apply,
    apply_homography,
    ground_homography,
    inverse,
    project,
    rotation_from_rpy,
    transform,
)
from log2sim.perception.homography.correspondences import Correspondences, foot_points
from log2sim.perception.homography.estimate import (
    FOOT_SIGMA_PX,
    METHODS,
    EstimationOptions,
    estimate_homography,
    fit_camera,
)
from log2sim.perception.homography.fit import HomographyFit
from log2sim.perception.homography.place import CONTACT, place_obstacle, spanned_height_m

K = np.array([[1000.0, 0.0, 640.0], [0.0, 1000.0, 360.0], [0.0, 0.0, 1.0]])
PROBES_M = np.array([[x, y] for x in (8.0, 15.0, 25.0, 40.0) for y in (-0.3 * x, 0.0, 0.3 * x)])
CAMERA_M = np.array([1.5, 0.2])
# The straw man believes sizes to a tenth only, so that its gate tells fewer outliers.
FROM_LIDAR = tuple(m for m in METHODS if m != "straw-man")


def make_camera(pitch_deg: float = 4.0, height_m: float = 1.6) -> tuple[Camera, np.ndarray]:
    """A camera that looks ahead and a little down, and its true `ground_H_image`."""
    p = np.radians(pitch_deg)
    rotation = np.array([[0, -np.sin(p), np.cos(p)], [-1, 0, 0], [0, -np.cos(p), -np.sin(p)]])
    ego_T_cam = np.eye(4)
    ego_T_cam[:3, :3], ego_T_cam[:3, 3] = rotation, [*CAMERA_M, height_m]
    camera = Camera("front", 1280, 720, K, "ego", ego_T_cam)
    return camera, ground_homography(camera, ego_T_cam)


def to_image(ground_H_image: np.ndarray, xy: np.ndarray) -> np.ndarray:
    q = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(ground_H_image).T
    return q[:, :2] / q[:, 2:]


@dataclass
class World:
    """Correspondences of a stream with known truth."""

    truth: np.ndarray
    uv: np.ndarray
    xy: np.ndarray
    tick: np.ndarray
    clean: np.ndarray
    K: np.ndarray = dataclasses.field(default_factory=lambda: K)

    def fit(self, method: str = "time-aware", seed: int = 0, **sigmas: float) -> HomographyFit:
        sigmas = {"sigma_px": 1.0, "sigma_m": 0.02, **sigmas}
        rng = np.random.default_rng(seed)
        options = EstimationOptions(method, self.K, **sigmas)  # type: ignore[arg-type]
        return estimate_homography(Correspondences(self.uv, self.xy, self.tick, self.xy), options, rng=rng)


def make_world(
    seed: int, ticks: int = 30, each: int = 6, noise_px: float = 1.0, noise_m: float = 0.02, outliers: float = 0.0
) -> World:
    rng = np.random.default_rng(seed)
    truth = make_camera()[1]
    count = ticks * each
    xy = np.column_stack([rng.uniform(7.0, 45.0, count), rng.uniform(-0.5, 0.5, count)])
    xy[:, 1] *= xy[:, 0]
    uv = to_image(truth, xy) + rng.normal(0.0, noise_px, (count, 2))
    xy = xy + rng.normal(0.0, noise_m, (count, 2))
    wrong = rng.permutation(count) < round(outliers * count)
    uv[wrong] = rng.uniform([0, 380], [1280, 720], (int(wrong.sum()), 2))
    return World(truth, uv, xy, np.repeat(np.arange(ticks), each), ~wrong)


def error_m(truth: np.ndarray, found: np.ndarray) -> float:
    """Root mean square error on the ground relative to the range, over the view."""
    uv = to_image(truth, PROBES_M)
    d = np.hypot(*(apply_homography(found, uv)[0] - PROBES_M).T) / np.hypot(*PROBES_M.T)
    return float(np.sqrt(np.mean(d**2)))


def pooled_limit(world: World) -> np.ndarray:
    """The most likely homography from all clean correspondences, told which they are: nothing does better on average."""

    def residuals(h: np.ndarray) -> np.ndarray:
        image_H_ground = np.append(h, 1.0).reshape(3, 3)
        q = np.column_stack([world.xy[world.clean], np.ones(world.clean.sum())]) @ image_H_ground.T
        return (q[:, :2] / q[:, 2:] - world.uv[world.clean]).ravel()

    start = np.linalg.inv(world.truth)
    start /= start[2, 2]
    solution = least_squares(residuals, start.ravel()[:8], x_scale=np.abs(start.ravel()[:8]) + 1e-9, method="lm")
    found = np.linalg.inv(np.append(solution.x, 1.0).reshape(3, 3))
    return found * np.sign(found[2] @ np.append(world.uv[world.clean][0], 1.0))


@pytest.mark.parametrize("method", METHODS)
def test_exact_data_give_the_exact_homography_as_opencv_finds_it(method: str) -> None:
    world = make_world(0, noise_px=0.0, noise_m=0.0, ticks=8, each=10)
    fit = world.fit(method)
    reference, _ = cv2.findHomography(world.uv, world.xy)
    uv = to_image(world.truth, PROBES_M)
    mapped, below = apply_homography(fit.ground_H_image, uv)
    assert fit.ok
    assert fit.reason == ""
    assert below.all()
    np.testing.assert_allclose(mapped, PROBES_M, atol=1e-6)
    expected = cv2.perspectiveTransform(uv[:, None], reference)[:, 0]
    np.testing.assert_allclose(mapped, expected, atol=1e-5)
    assert fit.inliers.all()
    assert fit.error_m < 1e-8


@pytest.mark.matrix
@pytest.mark.parametrize(
    ("outliers", "each", "above_limit"), [(0.0, 6, 1.4), (0.3, 6, 1.4), (0.3, 12, 1.2), (0.6, 12, 1.4)]
)
def test_time_aware_comes_near_to_what_all_frames_together_allow(
    outliers: float, each: int, above_limit: float
) -> None:
    limit, found, of_frame = [], [], []
    for seed in range(8):
        world = make_world(seed, each=each, outliers=outliers)
        fit = world.fit()
        assert fit.ok, fit.reason
        limit.append(error_m(world.truth, pooled_limit(world)))
        found.append(error_m(world.truth, fit.ground_H_image))
        if seed < 3:
            of_frame.append(error_m(world.truth, world.fit("min-frame").ground_H_image))
        assert (fit.inliers & ~world.clean).sum() <= 1
        assert (fit.inliers & world.clean).sum() >= 0.93 * world.clean.sum()
    rms = [np.sqrt(np.mean(np.square(e))) for e in (limit, found, of_frame)]
    assert rms[1] < above_limit * rms[0]
    assert rms[1] < 0.5 * rms[2]  # one frame has a thirtieth of the data


@pytest.mark.parametrize("method", METHODS)
def test_too_few_correspondences_are_refused(method: str) -> None:
    for count in range(4):
        world = make_world(0, ticks=1, each=max(count, 1))
        first = World(world.truth, *(a[:count] for a in (world.uv, world.xy, world.tick, world.clean)))
        fit = first.fit(method)
        assert not fit.ok
        assert f"{count} correspondences" in fit.reason
        assert np.isnan(fit.ground_H_image).all()
        assert fit.inliers.shape == (count,)
        assert np.isnan(fit.jitter_m)
        assert fit.condition == np.inf


@pytest.mark.parametrize("method", FROM_LIDAR)
def test_rows_that_are_not_finite_order_of_rows_and_names_of_ticks_do_not_matter(method: str) -> None:
    world = make_world(5, noise_px=0.0, noise_m=0.0, outliers=0.2, ticks=10, each=10)
    order = np.random.default_rng(0).permutation(100)
    uv, xy, clean = world.uv[order], world.xy[order], world.clean[order]
    uv[3], uv[17, 1], xy[40, 0], xy[77] = np.nan, np.inf, -np.inf, np.nan
    clean[[3, 17, 40, 77]] = False
    fit = World(world.truth, uv, xy, 1000 - 7 * world.tick[order], clean).fit(method)
    assert error_m(world.truth, fit.ground_H_image) < 1e-8
    np.testing.assert_array_equal(fit.inliers, clean)
    np.testing.assert_array_equal(fit.ticks, 1000 - 7 * np.arange(10)[::-1])


def test_noise_in_the_image_counts_for_more_far_away() -> None:
    # A gate of fixed size in meters would throw the far half away or let near outliers in.
    world = make_world(7, each=20, outliers=0.2)
    far = np.hypot(*world.xy.T) > 35.0
    fit = world.fit()
    mapped, _ = apply_homography(fit.ground_H_image, world.uv)
    distance = np.hypot(*(mapped - world.xy).T)
    assert fit.error_m == pytest.approx(np.median(distance[fit.inliers]), rel=1e-6)
    assert fit.inliers[far & world.clean].mean() > 0.9
    assert np.median(distance[far & world.clean]) > 8 * np.median(
        distance[(np.hypot(*world.xy.T) < 12.0) & world.clean]
    )


def test_condition_is_that_of_the_normalized_design_matrix() -> None:
    world = make_world(8, outliers=0.2)
    fit = world.fit()

    def normalized(p: np.ndarray) -> np.ndarray:
        d = p - p.mean(axis=0)
        return d / np.sqrt((d**2).sum(axis=1).mean() / 2)

    (u, v), (x, y) = normalized(world.uv[fit.inliers]).T, normalized(world.xy[fit.inliers]).T
    one, zero = np.ones_like(u), np.zeros_like(u)
    rows = [
        np.stack([u, v, one, zero, zero, zero, -x * u, -x * v, -x], axis=1),
        np.stack([zero, zero, zero, u, v, one, -y * u, -y * v, -y], axis=1),
    ]
    s = np.linalg.svd(np.concatenate(rows), compute_uv=False)
    assert fit.condition == pytest.approx(s[0] / s[7], rel=1e-6)


def test_frames_of_less_than_four_help_only_the_time_aware() -> None:
    world = make_world(10, ticks=60, each=3, noise_px=0.5)
    fit = world.fit(sigma_px=0.5)
    assert fit.ok
    assert error_m(world.truth, fit.ground_H_image) < 0.01
    for method in ("per-frame", "min-frame"):
        refused_fit = world.fit(method)
        assert not refused_fit.ok
        assert "no frame" in refused_fit.reason


def test_per_frame_keeps_one_homography_a_tick_and_nan_where_there_is_none() -> None:
    world = make_world(11, ticks=6, each=10, noise_px=0.0, noise_m=0.0)
    keep = ~((world.tick == 2) & (np.arange(60) % 10 >= 3))  # tick 2 keeps three
    fit = World(world.truth, world.uv[keep], world.xy[keep], world.tick[keep], world.clean[keep]).fit("per-frame")
    assert fit.per_tick is not None
    assert fit.ticks.tolist() == [0, 1, 2, 3, 4, 5]
    assert np.isnan(fit.per_tick).all(axis=(1, 2)).tolist() == [False, False, True, False, False, False]
    assert max(error_m(world.truth, fit.per_tick[k]) for k in (0, 1, 3, 4, 5)) < 1e-8
    for method in ("time-aware", "min-frame"):
        assert world.fit(method).per_tick is None


def test_a_fixed_camera_does_not_jitter() -> None:
    world = make_world(12, each=10)
    assert world.fit("time-aware").jitter_m == 0.0
    assert world.fit("min-frame").jitter_m == 0.0
    assert world.fit("per-frame").jitter_m > 0.05  # one pixel of noise a frame shows
    exact = make_world(12, each=10, noise_px=0.0, noise_m=0.0)
    assert exact.fit("per-frame").jitter_m < 1e-7


def test_jitter_of_a_nodding_camera_is_how_far_the_ground_moves() -> None:
    xy = make_world(13, ticks=1, each=12).xy
    nod = [make_camera(pitch_deg=4.0 + 0.1 * (-1) ** k)[1] for k in range(10)]
    world = World(
        nod[0],
        np.concatenate([to_image(h, xy) for h in nod]),
        np.tile(xy, (10, 1)),
        np.repeat(np.arange(10), 12),
        np.ones(1),
    )
    fit = world.fit("per-frame")
    # Pixels of the probes, seen through the two poses in turn; x at height 1.6 m under angles 0.2 degrees apart.
    middle = [
        np.hypot(*(apply_homography(nod[0], uv)[0] - apply_homography(nod[1], uv)[0]).T)
        for uv in [to_image(fit.ground_H_image, np.array([[10.0, 0.0], [20.0, 0.0], [40.0, 0.0]]))]
    ]
    assert fit.jitter_m == pytest.approx(np.median(middle), rel=1e-4)
    assert 0.4 < fit.jitter_m < 1.2  # 20 m ahead: (18.5^2 / 1.6 + 1.6) * 0.2 degrees = 0.75 m


def test_shapes_and_methods_that_do_not_fit_are_the_callers_mistake() -> None:
    five, tick = np.zeros((5, 2)), np.zeros(5, dtype=np.int64)
    with pytest.raises(ValueError, match=r"\(N, 2\)"):
        Correspondences(five, five[:4], tick)
    with pytest.raises(ValueError, match=r"\(N, 2\)"):
        Correspondences(five, five, tick[:4])
    with pytest.raises(ValueError, match="time-aware"):
        estimate_homography(Correspondences(five, five, tick), EstimationOptions("frame"), rng=np.random.default_rng(0))


def a_camera_with_lens() -> Camera:
    plain = make_camera()[0]
    return Camera("front", 1280, 720, K, "ego", plain.mount_T_cam, "brown", (-0.2, 0.05, 0.001, -0.0005))


def foot_pixel(camera: Camera, x: float, y: float) -> np.ndarray:
    uv, _ = project(camera, apply(inverse(camera.mount_T_cam), [[x, y, 0.0]]))
    return uv[0]


def box_of(camera: Camera, category: str, xy: np.ndarray, yaw_rad: float, size_m: np.ndarray) -> np.ndarray:
    """The box (4,) around the image of a cuboid whose body is 0.25 m above the ground and which touches that in its contact area."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    shares = np.array([[a, b] for a in (-0.5, 0.5) for b in (-0.5, 0.5)])
    outline, feet = (
        shares * size_m[:2] * share @ np.array([[c, s], [-s, c]]) + xy for share in (1.0, CONTACT[GROUP_OF[category]])
    )
    corners = [[*p, z] for z in (0.25, size_m[2]) for p in outline] + [[*p, 0.0] for p in feet]
    uv = project(camera, apply(inverse(camera.mount_T_cam), corners))[0]
    return np.concatenate([uv.min(axis=0), uv.max(axis=0)])


@pytest.mark.parametrize(
    ("category", "pitch_deg", "height_m"),
    [(c, 4.0, 1.6) for c in ("car", "bus", "cyclist", "pedestrian")]
    + [(c, 25.0, 6.0) for c in ("car", "cyclist", "pedestrian")],
)
@pytest.mark.parametrize(
    "seen", [(True, True, True, True), (False, True, True, True), (True, False, True, True)], ids=str
)
def test_obstacles_of_all_sizes_and_yaws_are_where_they_are_placed_within_what_is_told(
    category: str, pitch_deg: float, height_m: float, seen: tuple[bool, bool, bool, bool]
) -> None:
    rng = np.random.default_rng(1)
    camera, h = make_camera(pitch_deg, height_m)
    typical, smallest, largest = (np.array(t[category]) for t in (TYPICAL_SIZE_M, MIN_SIZE_M, MAX_SIZE_M))
    squared, errors = [], []
    while len(squared) < 150:
        size = np.clip(typical + typical * np.log(largest / smallest) / 4 * rng.normal(size=3), smallest, largest)
        reach, bearing = rng.uniform(12.0, 25.0), rng.uniform(-0.25, 0.25)
        xy = CAMERA_M + reach * np.array([np.cos(bearing), np.sin(bearing)])
        box = box_of(camera, category, xy, rng.uniform(0, 2 * np.pi), size) + rng.normal(0, FOOT_SIGMA_PX, 4)
        # What is cut off is anywhere inside.
        cut = rng.uniform(0.1, 0.5, 4) * np.tile(box[2:] - box[:2], 2) * [1, 1, -1, -1]
        placed = place_obstacle(
            h,
            camera,
            box + np.where(seen, 0.0, cut),
            category,
            camera.mount_T_cam,
            edge_sigma_px=np.where(seen, FOOT_SIGMA_PX, np.inf),
        )
        assert placed is not None
        errors.append(placed[0] - xy)
        squared.append(errors[-1] @ np.linalg.solve(placed[1], errors[-1]) / 2)
    assert 0.1 < np.mean(squared) < 1.4
    sigma = np.std(errors, axis=0)
    assert np.all(np.abs(np.mean(errors, axis=0)) < np.maximum(0.6 * sigma, 0.1))


def test_a_lens_does_not_move_an_obstacle() -> None:
    (plain, h), size = make_camera(), np.array(TYPICAL_SIZE_M["car"])
    lens, xy = a_camera_with_lens(), np.array([25.0, -6.0])
    placed = [place_obstacle(h, c, box_of(c, "car", xy, 0.5, size), "car", c.mount_T_cam) for c in (plain, lens)]
    assert placed[0] is not None
    assert placed[1] is not None
    # The corners of a box in a bent image are not those of the straight one.
    np.testing.assert_allclose(placed[0][0], placed[1][0], atol=0.1)


def test_edges_that_do_not_tell_a_distance_place_nothing() -> None:
    camera, h = make_camera()
    box = box_of(camera, "car", np.array([20.0, 2.0]), 0.3, np.array(TYPICAL_SIZE_M["car"]))
    for seen in ((True, True, True, False), (False, True, False, True)):
        assert (
            place_obstacle(
                h, camera, box, "car", camera.mount_T_cam, edge_sigma_px=np.where(seen, FOOT_SIGMA_PX, np.inf)
            )
            is None
        )


@pytest.mark.parametrize("scale", [0.8, 1.0, 1.3])
def test_a_post_spans_its_height_times_the_error_of_its_distance(scale: float) -> None:
    camera, h = make_camera()
    base_T_cam = camera.mount_T_cam.copy()
    foot = np.array([18.0, -4.0])
    bottom, top = (project(camera, apply(inverse(base_T_cam), [[*foot, z]]))[0][0] for z in (0.0, 1.7))
    box = np.array([bottom[0] - 9, top[1], bottom[0] + 9, bottom[1]])
    assert spanned_height_m(h, camera, box, base_T_cam) == pytest.approx(1.7, rel=0.01)
    # Another distance by the same ray: the homography of other ground.
    camera_xy = base_T_cam[:2, 3]
    farther = np.array([[scale, 0, (1 - scale) * camera_xy[0]], [0, scale, (1 - scale) * camera_xy[1]], [0, 0, 1.0]])
    assert spanned_height_m(farther @ h, camera, box, base_T_cam) == pytest.approx(1.7 * scale, rel=0.01)


def test_places_are_the_less_sure_the_farther_and_the_less_sure_the_homography_is() -> None:
    camera, h = make_camera()
    sigma = []
    for x, covariance in ((10.0, 0.0), (20.0, 0.0), (40.0, 0.0), (40.0, 1e-14)):
        box = box_of(camera, "pedestrian", np.add(CAMERA_M, [x, 0.0]), 0.0, np.array(TYPICAL_SIZE_M["pedestrian"]))
        placed = place_obstacle(h, camera, box, "pedestrian", camera.mount_T_cam, covariance * np.eye(9))
        assert placed is not None
        variance, axes = np.linalg.eigh(placed[1])
        assert abs(axes[0, 1]) > 0.999  # along the ray
        sigma.append(np.sqrt(variance[1]))
        # Flat ground seen from height h: a pixel is about (x^2 + h^2) / h / f deep; the height of the person helps.
        deep = np.hypot(FOOT_SIGMA_PX * (x**2 + 1.6**2) / 1.6 / 1000, 0.2)
        assert sigma[-1] < deep * 1.05 or covariance
    assert sigma == sorted(sigma)


def test_obstacles_at_the_horizon_and_far_away_are_not_located() -> None:
    camera, h = make_camera()

    def at(u: float, v: float) -> object:
        return place_obstacle(h, camera, np.array([u - 5, v - 10, u + 5, v]), "car", camera.mount_T_cam)

    assert at(640.0, 200.0) is None
    assert at(640.0, 291.0) is None  # a hand's breadth below the horizon, kilometers away
    assert at(*foot_pixel(camera, *np.add(CAMERA_M, [59.5, 0.0]))) is not None
    assert at(*foot_pixel(camera, *np.add(CAMERA_M, [60.5, 0.0]))) is None
    assert at(np.nan, 600.0) is None


def as_correspondences(world: World) -> Correspondences:
    return Correspondences(world.uv, world.xy, world.tick)


NOTHING = Correspondences.join([])


def test_a_camera_learns_from_obstacles_first() -> None:
    feet, ground = make_world(20, each=8, noise_px=2.0), make_world(21, each=40, noise_px=0.3)
    fit, source = fit_camera(
        as_correspondences(feet), as_correspondences(ground), EstimationOptions(), rng=np.random.default_rng(0)
    )
    assert source == "obstacles"
    assert len(fit.inliers) == len(feet.uv)
    assert error_m(feet.truth, fit.ground_H_image) < 0.01


@pytest.mark.parametrize("case", ["few", "collinear", "none"])
def test_ground_points_join_where_obstacles_do_not_suffice(case: str) -> None:
    lane, rng = make_world(1, ticks=10, each=8), np.random.default_rng(1)
    lane.xy = np.column_stack([lane.xy[:, 0], 0.1 * lane.xy[:, 0] + 1.0])
    lane.uv = to_image(lane.truth, lane.xy) + rng.normal(0, 1.0, lane.uv.shape)
    few = make_world(22, ticks=3, each=4)
    feet = {"few": as_correspondences(few), "collinear": as_correspondences(lane), "none": NOTHING}[case]
    ground = make_world(23, each=20, noise_px=0.5)
    fit, source = fit_camera(feet, as_correspondences(ground), EstimationOptions(), rng=np.random.default_rng(0))
    assert fit.ok
    assert source == "obstacles and ground points"
    assert len(fit.inliers) == len(feet.uv) + len(ground.uv)
    assert error_m(ground.truth, fit.ground_H_image) < 0.005


def measured(view: Camera, **changes: object) -> Measurements:
    """Cars whose near side stands across the ray, seen by `view` in a map that is the ego frame moved by (100, 50)."""
    feet = np.array([[12.0, 0.2], [20.0, 0.2], [30.0, 0.2], [40.0, 0.2]])
    uv = np.array([foot_pixel(view, *f) for f in feet])
    across = np.linspace(-0.9, 0.9, 60)
    cluster = tuple(np.column_stack([np.full(60, f[0] + 100), f[1] + across + 50, np.full(60, 0.7)]) for f in feet)
    box_px = np.column_stack([uv[:, 0] - 30, uv[:, 1] - 40, uv[:, 0] + 30, uv[:, 1]])
    detections = Detections(box_px, np.ones(4), np.full(4, "car"))
    sensor = np.array([101.5, 50.2, 1.6])
    rows = Measurements.unplaced(detections, t_ns=0, camera=view.name, sensor_m=sensor)
    columns: dict[str, object] = {
        "center_m": np.column_stack([feet[:, 0] + 102.2, feet[:, 1] + 50, np.full(4, 0.75)]),
        "bottom_m": np.zeros(4),
        "points": np.full(4, 60),
        "source": np.full(4, "lidar"),
        "cluster": cluster,
    }
    return replace(rows, **{**columns, **changes})  # type: ignore[arg-type]


EGO_T_MAP = transform(np.eye(3), [-100.0, -50.0, 0.0])


@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.0), (0.1, -0.05, 0.3)], ids=["level", "tilted"])
@pytest.mark.parametrize("camera", [make_camera()[0], a_camera_with_lens()], ids=["pinhole", "lens"])
def test_feet_of_measured_obstacles_lie_on_the_ground_below_them(camera: Camera, rpy: tuple[float, ...]) -> None:
    ego_T_map = transform(rotation_from_rpy(*rpy), [-100.0, -50.0, 0.0])
    feet = foot_points(camera, measured(camera), ego_T_map, tick=7)
    assert feet.tick.tolist() == [7] * 4
    below = np.array([[x, 0.2] for x in (12.0, 20.0, 30.0, 40.0)])
    expected = apply(ego_T_map, np.column_stack([np.add(below, [100.0, 50.0]), np.zeros(4)]))[:, :2]
    np.testing.assert_allclose(feet.xy_ego, expected, atol=1e-9)
    np.testing.assert_allclose(apply_homography(make_camera()[1], feet.uv)[0], below, atol=1e-4)


def test_only_whole_obstacles_with_enough_lidar_points_of_that_camera_give_feet() -> None:
    camera = make_camera()[0]
    good = measured(
        camera,
        truncated=np.array([True, False, False, False]),
        source=np.array(["lidar", "topdown", "lidar", "lidar"]),
        points=np.array([60, 60, 19, 20]),
    )
    assert foot_points(camera, good, EGO_T_MAP, 0).xy_ego[:, 0].tolist() == [pytest.approx(40.0)]
    elsewhere = measured(camera, camera=np.array(["rear", "rear", "front", "rear"]))
    assert foot_points(camera, elsewhere, EGO_T_MAP, 0).xy_ego[:, 0].tolist() == [pytest.approx(30.0)]
    assert foot_points(camera, Measurements.empty(), EGO_T_MAP, 0).uv.shape == (0, 2)


def test_four_points_almost_on_a_line_are_refused() -> None:
    truth = make_camera()[1]
    xy = np.array([[10.0, 1.0], [20.0, 1.001], [30.0, 0.999], [40.0, 1.001]])
    fit = World(truth, to_image(truth, xy), xy, np.zeros(4, dtype=int), np.ones(4, dtype=bool)).fit()
    assert "line" in fit.reason


@pytest.mark.parametrize(("count", "agree", "needed"), [(8, 5, 6), (100, 15, 20)])
def test_a_handful_that_agrees_among_many_that_do_not_is_refused(count: int, agree: int, needed: int) -> None:
    world, rng = make_world(30, ticks=1, each=count, noise_px=0.0, noise_m=0.0), np.random.default_rng(0)
    uv = np.concatenate([world.uv[:agree], rng.uniform([0, 400], [1280, 720], (count - agree, 2))])
    fit = World(world.truth, uv, world.xy, world.tick, world.clean).fit()
    assert not fit.ok
    assert fit.reason.endswith(f"at least {needed} are needed")


def test_feet_know_where_average_sizes_would_put_them() -> None:
    camera = make_camera()[0]
    good = measured(camera)
    ego_T_cam = camera.mount_T_cam
    feet_m = np.array([[12.0, 0.2], [20.0, 0.2], [30.0, 0.2], [40.0, 0.2]])
    depth = apply(inverse(ego_T_cam), np.column_stack([feet_m, np.zeros(4)]))[:, 2]
    box = good.box_px.copy()
    box[:, 1] = box[:, 3] - K[1, 1] * TYPICAL_SIZE_M["car"][2] / depth
    feet = foot_points(camera, measured(camera, box_px=box), EGO_T_MAP, 0)
    assert feet.xy_by_size is not None
    np.testing.assert_allclose(feet.xy_by_size, feet_m, atol=1e-6)
    box[:, 1] = box[:, 3] - 2 * K[1, 1] * TYPICAL_SIZE_M["car"][2] / depth  # twice as high is half as far
    near = foot_points(camera, measured(camera, box_px=box), EGO_T_MAP, 0).xy_by_size
    assert near is not None
    np.testing.assert_allclose(near - CAMERA_M, (feet_m - CAMERA_M) / 2, rtol=0.02, atol=0.05)


@pytest.mark.parametrize("method", FROM_LIDAR)
@settings(max_examples=6, deadline=None)
@given(
    yaw_rad=st.floats(-np.pi, np.pi),
    shift_m=st.tuples(st.floats(-5e6, 5e6), st.floats(-5e6, 5e6)),
    pixel_scale=st.floats(0.25, 4.0),
    shift_px=st.tuples(st.floats(-3000.0, 3000.0), st.floats(-900.0, 900.0)),
)
def test_a_rotated_and_shifted_ground_and_scaled_and_shifted_pixels_give_the_same_places(
    method: str, yaw_rad: float, shift_m: tuple[float, float], pixel_scale: float, shift_px: tuple[float, float]
) -> None:
    world = make_world(31, ticks=10, each=10, noise_px=0.0, noise_m=0.0, outliers=0.2)
    turn = rotation_from_rpy(0.0, 0.0, yaw_rad)[:2, :2]
    scaled_K = np.diag([pixel_scale, pixel_scale, 1.0]) @ K + np.column_stack([np.zeros((3, 2)), [*shift_px, 0.0]])
    uv, xy = world.uv * pixel_scale + shift_px, world.xy @ turn.T + shift_m
    fit = World(world.truth, uv, xy, world.tick, world.clean, scaled_K).fit(method, sigma_px=pixel_scale)
    probes = to_image(world.truth, PROBES_M) * pixel_scale + shift_px
    mapped, below = apply_homography(fit.ground_H_image, probes)
    assert below.all()
    np.testing.assert_allclose(mapped, PROBES_M @ turn.T + shift_m, atol=1e-4)
    np.testing.assert_array_equal(fit.inliers, world.clean)
