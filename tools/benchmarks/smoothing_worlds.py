"""Maneuvers with known truth for measuring smoothers: what a vehicle's rear axle does, seen through noise, gaps and outliers.

`worlds` yields seeded cases, `errors_of` compares an estimate with the truth; tests and the benchmark share both.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
PERIOD_S, FRAMES, SUBSTEPS = 0.1, 201, 20
MANEUVERS = ("lane change", "turn", "stop and go", "slalom")
# Stop and go in a queue: standing for 2, 3 and 5 s, rolling at 0.4 m/s, driving in between.
QUEUE = "queue"
RATES_HZ = (2, 4, 10, 20)
MISSING_SHARE = 0.1
MOVING_MPS = 1.0
STANDING_MPS, SURELY_MOVING_MPS = 0.05, 0.2


@dataclass(frozen=True, eq=False)
class Truth:
    """Columns (T,): stamps, position (T, 2) in m, velocity (T, 2), speed, yaw and curvature (0 where it stands)."""

    t_s: Array
    xy_m: Array
    velocity_mps: Array
    speed_mps: Array
    yaw_rad: Array
    curvature_1pm: Array


@dataclass(frozen=True, eq=False)
class World:
    """One case: positions `xy_m` (T, 2) with noise of `sigma_m`, of which those that are `valid` (T,) were seen."""

    maneuver: str
    seed: int
    sigma_m: float
    truth: Truth
    xy_m: Array
    valid: NDArray[np.bool_]


def truth_of(maneuver: str, period_s: float = PERIOD_S) -> Truth:
    """Truth of a maneuver: speed and yaw rate in closed form, integrated at a twentieth of the period."""
    frames = round((FRAMES - 1) * PERIOD_S / period_s) + 1
    t = np.arange((frames - 1) * SUBSTEPS + 1, dtype=np.float64) * (period_s / SUBSTEPS)
    speed, yaw_rate = _controls(maneuver, t)
    yaw = 0.4 + _integral(yaw_rate, t)
    velocity = speed[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    xy = np.stack([_integral(velocity[:, 0], t), _integral(velocity[:, 1], t)], axis=1)
    curvature = np.divide(yaw_rate, speed, out=np.zeros_like(t), where=speed > MOVING_MPS / 2)
    every = slice(None, None, SUBSTEPS)
    return Truth(t[every], xy[every], velocity[every], speed[every], yaw[every], curvature[every])


def _controls(maneuver: str, t: Array) -> tuple[Array, Array]:
    """Speed in m/s and yaw rate in rad/s at times (n,)."""

    def rise(middle_s: float, width_s: float) -> Array:
        return 0.5 + 0.5 * np.tanh((t - middle_s) / width_s)

    def bump(middle_s: float, width_s: float) -> Array:
        return np.exp(-(((t - middle_s) / width_s) ** 2))

    if maneuver == "lane change":
        return np.full_like(t, 15.0), 0.055 * (bump(8.5, 0.9) - bump(10.9, 0.9))
    if maneuver == "turn":
        # The area under the bump is a right angle.
        return 12.0 - 7.0 * rise(5.2, 1.2) + 5.0 * rise(13.2, 1.5), np.pi / 2 * bump(9.2, 1.2) / (1.2 * np.sqrt(np.pi))
    if maneuver == "stop and go":
        speed = 13.0 * (1.0 - rise(5.2, 1.3)) + 11.0 * rise(14.2, 1.6)
        speed = np.where(speed < 0.02, 0.0, speed)
        return speed, 0.004 * speed * np.sin(0.5 * t)
    if maneuver == "slalom":
        return np.full_like(t, 10.0), 0.4 * np.sin(2 * np.pi * t / 5.0)
    if maneuver == QUEUE:
        times = [0.0, 2.0, 4.0, 5.5, 7.0, 10.0, 11.5, 12.0, 15.0, 16.0, 18.0, 20.0]
        speeds = [0.0, 0.0, 3.0, 3.0, 0.0, 0.0, 0.4, 0.4, 0.4, 0.0, 0.0, 0.0]
        return np.interp(t, times, speeds), np.zeros_like(t)
    raise ValueError(f"unknown maneuver {maneuver!r}; known: {', '.join(MANEUVERS)}")


def _integral(values: Array, t: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2 * np.diff(t))])


def worlds(sigma_m: float, outlier_share: float = 0.0, seeds: int = 6) -> Iterator[World]:
    """Every maneuver with every seed; outliers are off by a Gaussian of 5 to 20 sigma."""
    for maneuver in MANEUVERS:
        truth = truth_of(maneuver)
        for seed in range(seeds):
            rng = np.random.default_rng([seed, MANEUVERS.index(maneuver)])
            valid = rng.random(FRAMES) >= MISSING_SHARE
            valid[[0, -1]] = True
            xy = truth.xy_m + rng.normal(0.0, sigma_m, (FRAMES, 2))
            wrong = rng.random(FRAMES) < outlier_share
            xy[wrong] += rng.normal(0.0, sigma_m, (int(wrong.sum()), 2)) * rng.uniform(5.0, 20.0, (int(wrong.sum()), 1))
            yield World(maneuver, seed, sigma_m, truth, xy, valid)


def errors_of(truth: Truth, xy_m: Array, velocity_mps: Array, yaw_rad: Array, curvature_1pm: Array) -> Array:
    """RMS errors (4,): position in m, velocity in m/s, yaw in degrees and curvature in 1/m, the latter two where it moves."""
    moving = truth.speed_mps > MOVING_MPS
    turned = np.degrees((yaw_rad - truth.yaw_rad + np.pi) % (2 * np.pi) - np.pi)

    def rms(values: Array) -> float:
        return float(np.sqrt(np.mean(values**2)))

    return np.array(
        [
            rms(np.hypot(*(xy_m - truth.xy_m).T)),
            rms(np.hypot(*(velocity_mps - truth.velocity_mps).T)),
            rms(turned[moving]),
            rms((curvature_1pm - truth.curvature_1pm)[moving]),
        ]
    )


def spline_estimate(world: World, strength: float | None) -> tuple[Array, Array, Array, Array]:
    """Position, velocity, yaw and curvature by SciPy's smoothing spline; its strength None for generalized cross-validation."""
    from scipy.interpolate import make_smoothing_spline

    t, seen = world.truth.t_s, world.valid
    axes = [make_smoothing_spline(t[seen], world.xy_m[seen, k], lam=strength) for k in (0, 1)]
    xy, velocity, acceleration = (
        np.stack([np.asarray(s.derivative(order)(t) if order else s(t)) for s in axes], axis=1) for order in range(3)
    )
    return xy, velocity, *course_of(velocity, acceleration)


def course_of(velocity_mps: Array, acceleration_mps2: Array) -> tuple[Array, Array]:
    """Yaw and curvature (T,) of a way with velocities and accelerations (T, 2)."""
    speed = np.maximum(np.hypot(*velocity_mps.T), MOVING_MPS / 2)
    turning = velocity_mps[:, 0] * acceleration_mps2[:, 1] - velocity_mps[:, 1] * acceleration_mps2[:, 0]
    return np.arctan2(velocity_mps[:, 1], velocity_mps[:, 0]), turning / speed**3


def best_spline_errors(world: World) -> Array:
    """Errors (4,) of the spline whose strength suits this track's truth best: the limit of the family, found by cheating."""
    # The strengths lie as far below and above the usual ones as the noise does.
    tried = [errors_of(world.truth, *spline_estimate(world, k)) for k in np.logspace(-4.0, 2.5, 27)]
    return min(tried, key=lambda errors: float(errors[0]))


def rate_worlds(maneuver: str, rate_hz: int, sigma_m: float, seeds: int = 6) -> Iterator[tuple[Truth, Array, Array]]:
    """The truth at 20 Hz, and times (n,) and noisy positions (n, 2) at another rate that divides it, by seed."""
    truth = truth_of(maneuver, 1.0 / RATES_HZ[-1])
    rows = np.arange(0, len(truth.t_s), RATES_HZ[-1] // rate_hz)
    for seed in range(seeds):
        rng = np.random.default_rng([seed, rate_hz])
        kept = rows[(rng.random(len(rows)) >= MISSING_SHARE) | (rows == 0) | (rows == rows[-1])]
        yield truth, truth.t_s[kept], truth.xy_m[kept] + rng.normal(0.0, sigma_m, (len(kept), 2))


def standing_verdicts(truth: Truth, velocity_mps: Array) -> tuple[float, float]:
    """Shares of the times at which it stands, and at which it moves by more than 0.2 m/s, that are taken for standing."""
    called = np.hypot(*velocity_mps.T) < STANDING_MPS
    return float(called[truth.speed_mps == 0].mean()), float(called[truth.speed_mps > SURELY_MOVING_MPS].mean())
