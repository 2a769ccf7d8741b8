"""Homographies of the cameras of a rig, fitted together: exact worlds, mount errors, pitch, outliers, and what is refused."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from log2sim.config import TopdownConfig
from log2sim.datatypes import Log, Measurements, Stream
from log2sim.geometry import Camera, PoseTrack, apply, apply_homography, inverse, project, rotation_from_rpy, transform
from log2sim.perception.first_pass import Observations
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography.rig import Rig, RigFit, fit_rig, rotation_of
from log2sim.perception.homography_stage import fit_homographies
from log2sim.plan import HomographyScope, Plan

EGO_R_CAM = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
K = np.array([[800.0, 0, 640], [0, 800.0, 360], [0, 0, 1]])
YAWS_DEG = {"front": 0.0, "left": 80.0, "right": -80.0, "rear": 180.0}
T0_NS = 1_700_000_000_000_000_000


def make_camera(name: str, yaw_deg: float, at: tuple[float, float, float], mount: str = "ego") -> Camera:
    turn = rotation_from_rpy(0.0, np.radians(6.0), np.radians(yaw_deg))
    return Camera(name, 1280, 720, K, mount, transform(turn @ EGO_R_CAM, np.array(at)))  # type: ignore[arg-type]


def turned(camera: Camera, degrees: tuple[float, float, float]) -> Camera:
    """The camera as it really stands, turned about its own axes against what the calibration says."""
    turn = transform(rotation_of(np.radians(degrees)), np.zeros(3))
    return replace(camera, mount_T_cam=camera.mount_T_cam @ inverse(turn))


@dataclass
class World:
    """What a rig sees of ground with a tilt, at each tick another one, through cameras whose mounts may be off."""

    cameras: dict[str, Camera]
    true: dict[str, Camera]
    feet: dict[str, Correspondences]
    ground: dict[str, Correspondences]

    def fit(self, seed: int = 0) -> RigFit:
        return fit_rig(Rig.of(self.cameras, 0.0), self.feet, self.ground, rng=np.random.default_rng(seed))

    def error_m(self, h: dict[str, np.ndarray], plane: np.ndarray, at_m: float = 15.0) -> float:
        """Largest error of points ahead of the cameras."""
        worst = 0.0
        for name, camera in self.true.items():
            axis = camera.mount_T_cam[:2, 2] / np.hypot(*camera.mount_T_cam[:2, 2])
            xy = camera.mount_T_cam[:2, 3] + at_m * axis + np.array([[0.0, 0.0], [1.0, 2.0], [-2.0, -1.0]])
            points = np.column_stack([xy, xy @ plane[:2] + plane[2]])
            uv, _ = project(camera, apply(inverse(camera.mount_T_cam), points))
            worst = max(worst, float(np.hypot(*(apply_homography(h[name], uv)[0] - xy).T).max()))
        return worst


PLANE = np.array([0.02, -0.01, 0.1])


def make_world(
    *, mounts: dict[str, tuple[float, float, float]] | None = None, noise_px: float = 0.0, outliers: float = 0.0,
    ticks: int = 20, tilt: float = 0.0, each: int = 6, seed: int = 0,
) -> World:  # fmt: skip
    rng = np.random.default_rng(seed)
    cameras = {n: make_camera(n, y, (1.0 + 0.5 * k, 0.3 * k, 1.6)) for k, (n, y) in enumerate(YAWS_DEG.items())}
    true = {n: turned(c, (mounts or {}).get(n, (0.0, 0.0, 0.0))) for n, c in cameras.items()}
    slopes = PLANE + np.column_stack([tilt * rng.normal(size=(ticks, 2)), np.zeros(ticks)])
    feet, ground = {}, {}
    for name, camera in cameras.items():
        for found, seen, count in ((feet, true[name], each), (ground, camera, 4 * each)):
            axis = camera.mount_T_cam[:2, 2] / np.hypot(*camera.mount_T_cam[:2, 2])
            tick = np.repeat(np.arange(ticks), count)
            ahead, aside = rng.uniform(6, 40, len(tick)), rng.uniform(-0.4, 0.4, len(tick))
            xy = camera.mount_T_cam[:2, 3] + ahead[:, None] * (axis + aside[:, None] * np.array([-axis[1], axis[0]]))
            z = (slopes[tick, :2] * xy).sum(axis=1) + slopes[tick, 2]
            uv, _ = project(seen, apply(inverse(seen.mount_T_cam), np.column_stack([xy, z])))
            uv += noise_px * rng.normal(size=uv.shape) * (found is feet)
            wrong = rng.random(len(uv)) < outliers
            uv[wrong] -= np.column_stack([np.zeros(wrong.sum()), rng.uniform(30, 150, wrong.sum())])
            kept = np.isfinite(uv).all(axis=1)
            found[name] = Correspondences(uv[kept], xy[kept], tick[kept])
    return World(cameras, true, feet, ground)


def test_exact_data_give_the_plane_and_the_homographies() -> None:
    world = make_world()
    fit = world.fit()
    assert fit.reason == ""
    assert fit.state is not None
    plane = [*PLANE[:2], fit.rig.origin_m[:2] @ PLANE[:2] + PLANE[2]]  # in the rig frame
    np.testing.assert_allclose(fit.state.plane, plane, atol=1e-9)
    assert world.error_m({n: f.ground_H_image for n, f in fit.fits.items()}, PLANE) < 1e-3
    assert all(f.ok and f.inliers.all() and f.error_m < 1e-3 for f in fit.fits.values())


@pytest.mark.parametrize("outliers", [0.0, 0.4])
def test_feet_with_noise_and_outliers_place_obstacles(outliers: float) -> None:
    world = make_world(noise_px=2.0, outliers=outliers, each=12)
    fit = world.fit()
    assert world.error_m({n: f.ground_H_image for n, f in fit.fits.items()}, PLANE) < 0.4
    for name, f in fit.fits.items():
        assert f.ok
        assert 0.01 < f.sigma_m < 0.5, name


def test_predicted_errors_are_those_over_many_worlds() -> None:
    errors, sigmas = [], []
    for seed in range(12):
        world, rng = make_world(noise_px=4.0, seed=seed, ticks=10, each=8), np.random.default_rng(seed)
        world.feet = {
            n: replace(c, xy_ego=c.xy_ego + rng.normal(0, 0.2, c.xy_ego.shape)) for n, c in world.feet.items()
        }
        fit = world.fit()
        for name, camera in world.cameras.items():
            axis = camera.mount_T_cam[:2, 2] / np.hypot(*camera.mount_T_cam[:2, 2])
            at = camera.mount_T_cam[:2, 3] + 20.0 * axis
            point = np.array([*at, at @ PLANE[:2] + PLANE[2]])
            uv, _ = project(camera, apply(inverse(camera.mount_T_cam), point[None]))
            errors.append(apply_homography(fit.fits[name].ground_H_image, uv)[0][0] @ axis - at @ axis)
            sigmas.append(fit.fits[name].sigma_m)
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) / np.mean(sigmas) < 1.5


def test_a_mount_that_is_off_is_found_by_the_feet_and_leaves_the_others_alone() -> None:
    world = make_world(mounts={"left": (0.0, 1.5, 0.0)}, noise_px=1.0, each=12)
    fit = world.fit()
    assert fit.state is not None
    turns = {n: np.degrees(v) for n, v in fit.state.feet.items()}
    np.testing.assert_allclose(turns["left"], [0.0, 1.5, 0.0], atol=0.15)
    assert max(np.abs(turns[n]).max() for n in ("front", "right", "rear")) < 0.15
    assert world.error_m({n: f.ground_H_image for n, f in fit.fits.items()}, PLANE) < 0.3


def log_of(cameras: dict[str, Camera], *, ego: bool = True) -> Log:
    t = T0_NS + np.arange(3) * 100_000_000
    track = PoseTrack(t, np.repeat(np.eye(4)[None], 3, axis=0)) if ego else None
    return Log("log", "test", cameras, {}, {n: Stream(n, t, lambda i: None) for n in cameras}, track)


def test_the_stage_fits_together_what_it_can_and_says_why_the_rest_is_apart() -> None:
    world = make_world(noise_px=1.0, each=12)
    low = make_camera("low", 0.0, (1.0, 0.0, 0.1))
    cameras = {**world.cameras, "low": low}
    seen = Observations(measurements=[Measurements.empty()] * 20)
    seen.feet = {n: [c] for n, c in world.feet.items()}
    seen.ground = {n: [c] for n, c in world.ground.items()}
    plan = Plan(tuple(cameras), (), HomographyScope.ALL_CAMERAS)
    rng = np.random.default_rng(0)
    fits = fit_homographies(log_of(cameras), seen, plan, TopdownConfig(rig="together"), rng=rng)
    assert list(fits) == list(cameras)
    assert all(fits[n].rig is not None and fits[n].source == "obstacles and ground of 4 cameras" for n in world.cameras)
    assert fits["low"].rig is None
    assert "(apart: its mount does not say how high" in fits["low"].source
    apart = fit_homographies(log_of(cameras), seen, plan, TopdownConfig(), rng=rng)
    assert all(g.rig is None and "apart" not in g.source for g in apart.values())
