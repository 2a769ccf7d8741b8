"""A road that changes its slope ahead of the ego: two planes where held-out places ask for them, one where they do not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from log2sim.geometry import apply_homography, rotation_from_rpy, transform
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography.estimate import EstimationOptions, fit_camera
from log2sim.perception.homography.fit import HomographyFit, ground_covariances
from log2sim.perception.homography.slope import fit_slope, slope_homography

K = np.array([[2050.0, 0.0, 960.0], [0.0, 2050.0, 640.0], [0.0, 0.0, 1.0]])
HEIGHT_M, PITCH_RAD = 2.1, np.radians(2.0)
AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
CAM_R_EGO = AXES @ rotation_from_rpy(0.0, PITCH_RAD, 0.0).T
YAW_RAD, TICKS = 0.7, 40  # the road runs in the map at this yaw


def seen(xyz: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of points (N, 3) of the ego frame."""
    q = (xyz - [0.0, 0.0, HEIGHT_M]) @ CAM_R_EGO.T @ K.T
    return np.asarray(q[:, :2] / q[:, 2:])


def pose(along_m: float) -> np.ndarray:
    turn = rotation_from_rpy(0.0, 0.0, YAW_RAD)
    return transform(turn, turn @ [along_m, 0.0, 0.0] + [100.0, -50.0, 0.0])


@dataclass
class Drive:
    """Feet of parked and of driving cars over a drive, in which the ego comes near the bend or passes it."""

    data: Correspondences
    poses: dict[int, np.ndarray]
    along_m: np.ndarray
    change: float
    bend_m: float  # where the road bends, along it

    def fit(self) -> HomographyFit:
        none = Correspondences.join([])
        fit, _ = fit_camera(self.data, none, EstimationOptions(), rng=np.random.default_rng(0))
        return fit_slope(fit, self.data, K, self.poses)

    def ground(self, tick: int, xy: np.ndarray) -> np.ndarray:
        """Points (N, 3) of the ground; once the ego is past the bend, it sees the other plane behind it alone."""
        from_bend = xy[:, 0] + self.along_m[tick] - self.bend_m
        beyond = np.maximum(from_bend, 0.0) if self.along_m[tick] < self.bend_m else np.maximum(-from_bend, 0.0)
        return np.column_stack([xy, self.change * beyond])

    def errors(self, fit: HomographyFit, tick: int, ranges_m: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Errors (N, 2) of ground points at these ranges, and their covariances."""
        xy = np.array([[x, y] for x in ranges_m for y in (-3.0, 3.0)])
        out, sure = [], []
        for uv, truth in zip(seen(self.ground(tick, xy)), xy):
            h, covariance = fit.at_tick(tick), fit.covariance_at(tick)
            assert h is not None
            assert covariance is not None
            beyond = None if fit.slope is None else slope_homography(fit.slope, h, K, self.poses[tick], uv)
            if beyond is not None:
                h, covariance = beyond[0], covariance + np.outer(beyond[1], beyond[1])
            out.append(apply_homography(h, uv[None])[0][0] - truth)
            sure.append(ground_covariances(h, covariance, uv[None])[0])
        return np.array(out), np.array(sure)


def drive(change: float, seed: int, *, step_m: float = 0.8, bend_m: float = 55.0, bias_m: float = 0.15) -> Drive:
    rng = np.random.default_rng([seed, 5])
    along = step_m * np.arange(TICKS)
    out = Drive(Correspondences.join([]), {k: pose(a) for k, a in enumerate(along)}, along, change, bend_m)
    parked = np.column_stack([rng.uniform(5, along[-1] + 70, 40), rng.choice([-5.0, 5.0], 40) + rng.normal(0, 0.5, 40)])
    off = bias_m * rng.normal(size=40)  # boxes of one car end too early or too late at all ticks
    parts = []
    for k in range(TICKS):
        ahead = parked - [along[k], 0.0]
        near = (ahead[:, 0] > 7) & (ahead[:, 0] < 60)
        driving = np.column_stack([rng.uniform(7, 60, 4), rng.uniform(-2, 2, 4)])
        xy = np.concatenate([ahead[near], driving])
        uv = seen(out.ground(k, xy + np.column_stack([np.append(off[near], np.zeros(4)), np.zeros(len(xy))])))
        uv += rng.normal(0, 1.5, uv.shape)
        uv[rng.random(len(uv)) < 0.2, 1] -= rng.uniform(20, 100)
        parts.append(Correspondences(uv, xy + rng.normal(0, 0.1, xy.shape), np.full(len(xy), k)))
    out.data = Correspondences.join(parts)
    return out


@pytest.mark.parametrize(
    ("change", "step_m", "bend_m"),
    [(0.04, 0.0, 30.0), (0.04, 0.8, 55.0), (0.04, 2.0, 55.0), (-0.02, 0.8, 55.0)],
    ids=["standing", "near", "past", "down"],
)
def test_what_is_beyond_a_bend_of_the_road_is_placed_where_it_is(change: float, step_m: float, bend_m: float) -> None:
    one, two = [], []
    for seed in range(2):
        world = drive(change, seed, step_m=step_m, bend_m=bend_m)
        fit = world.fit()
        assert fit.slope is not None
        assert fit.slope.change == pytest.approx(change, abs=0.003)
        assert fit.slope.line[:2] @ [100, -50] + fit.slope.line[2] == pytest.approx(-bend_m, abs=2.0)
        flat, _ = fit_camera(world.data, Correspondences.join([]), EstimationOptions(), rng=np.random.default_rng(0))
        for tick in (0, 10, 20):
            at_m = tuple(np.arange(35.0, 60.0, 6.0))
            two.append(np.hypot(*world.errors(fit, tick, at_m)[0].T).mean())
            one.append(np.hypot(*world.errors(flat, tick, at_m)[0].T).mean())
    assert np.median(two) < 0.25
    assert np.median(two) < 0.3 * np.median(one)


def test_a_road_of_one_plane_keeps_one() -> None:
    assert all(drive(0.0, seed, step_m=step).fit().slope is None for seed in range(3) for step in (0.0, 0.8))


def test_the_covariance_holds_on_both_sides_of_the_bend() -> None:
    nees = []
    for seed in range(4):
        world = drive(0.04, seed, bias_m=0.0)
        away, covariance = world.errors(world.fit(), 10, (10.0, 20.0, 30.0, 52.0, 58.0))
        nees.append((away * np.linalg.solve(covariance, away[:, :, None])[:, :, 0]).sum(axis=1) / 2)
    assert 0.4 < np.mean(nees) < 2.5
