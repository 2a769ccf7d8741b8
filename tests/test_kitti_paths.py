"""Paths of tracks: the smoother against the full least-squares problem, gaps and ends; what whole boxes tell of motion."""

from __future__ import annotations

import numpy as np
from kitti.tracks import smooth_paths
from test_track import seen, stamps

from log2sim.datatypes import Measurements, Track
from log2sim.geometry import NS_PER_S
from log2sim.tracking.forward import ACCELERATION_MPS2, first_velocity, measurement_noise, predict


def a_track(ticks: list[int], t_ns: np.ndarray, seed: int = 0, category: str = "car", sigma_m: float = 0.3) -> Track:
    rng = np.random.default_rng(seed)
    xy = np.column_stack([0.9 * np.array(ticks), -0.2 * np.array(ticks)]) + rng.normal(0, sigma_m, (len(ticks), 2))
    rows = [seen(p[None], t_ns[k], category=category, sigma_m=sigma_m) for k, p in zip(ticks, xy)]
    return Track(category, np.array(ticks), Measurements.join(rows))


def least_squares(t: Track, t_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States (n, 4) and covariances (n, 4, 4) from one dense normal matrix over all ticks of the track's life."""
    group = np.array(["vehicle"])
    ticks = np.arange(t.tick[0], t.tick[-1] + 1)
    n = len(ticks)
    information, rhs = np.zeros((4 * n, 4 * n)), np.zeros(4 * n)
    r = measurement_noise(t.measurements.covariance, np.repeat(group, len(t)), whole_boxes=True)
    for k, tick in enumerate(t.tick):
        at = 4 * (tick - ticks[0])
        information[at : at + 2, at : at + 2] += np.linalg.inv(r[k])
        rhs[at : at + 2] += np.linalg.solve(r[k], t.measurements.center_m[k, :2])
    speed = first_velocity(t.measurements.yaw_rad[:1], group)[0]
    information[2:4, 2:4] += np.linalg.inv(speed)
    for k in range(n - 1):
        dt = (t_ns[ticks[k + 1]] - t_ns[ticks[k]]) / NS_PER_S
        noise = predict(np.zeros((1, 4)), np.zeros((1, 4, 4)), dt, np.array([ACCELERATION_MPS2["vehicle"]]))[1][0]
        step = np.eye(4)
        step[0, 2] = step[1, 3] = dt
        link = np.hstack([-step, np.eye(4)])
        information[4 * k : 4 * k + 8, 4 * k : 4 * k + 8] += link.T @ np.linalg.inv(noise) @ link
    covariance = np.linalg.inv(information)
    blocks = np.stack([covariance[4 * k : 4 * k + 4, 4 * k : 4 * k + 4] for k in range(n)])
    return np.linalg.solve(information, rhs).reshape(n, 4), blocks


def test_smoothed_paths_solve_the_whole_least_squares_problem() -> None:
    t_ns = stamps(30)
    t_ns[12:] += 40_000_000  # ticks need not be even
    tracks = [
        a_track([0, 1, 2, 6, 7, 11, 12, 13], t_ns, 1),
        a_track([5, 6], t_ns, 2),
        a_track(list(range(20, 30)), t_ns, 3),
        a_track([8], t_ns),
    ]
    paths = smooth_paths(tracks, t_ns, np.zeros(4, np.int64))
    assert paths.tick.tolist() == [*range(14), 5, 6, *range(20, 30), 8]
    for k, t in enumerate(tracks):
        of = paths.track == k
        mean, covariance = least_squares(t, t_ns)
        np.testing.assert_allclose(paths.mean[of], mean, atol=1e-7)
        np.testing.assert_allclose(paths.covariance[of], covariance, atol=1e-7)
        assert paths.tick[of][paths.row[of] >= 0].tolist() == t.tick.tolist()
        assert paths.row[of][paths.row[of] >= 0].tolist() == list(range(len(t)))
