"""Maneuvers with known truth for measuring smoothers: what a vehicle's rear axle does, seen through noise, gaps and outliers.

`worlds` yields seeded cases, `errors_of` compares an estimate with the truth; tests and the benchmark share both.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import UnivariateSpline, make_smoothing_spline
from scipy.signal import savgol_filter

from benchmarks.table import markdown, optional, print_section
from log2sim.agents.smooth.smoother import smooth_track

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
    """One case: positions `xy_m` (T, 2) with noise, of which those that are `valid` (T,) were seen."""

    maneuver: str
    seed: int
    truth: Truth
    xy_m: Array
    valid: NDArray[np.bool_]


def truth_of(maneuver: str, period_s: float = PERIOD_S) -> Truth:
    """Truth of a maneuver: speed and yaw rate in closed form, integrated at a twentieth of the period."""
    frames = round((FRAMES - 1) * PERIOD_S / period_s) + 1
    t = np.arange((frames - 1) * SUBSTEPS + 1, dtype=np.float64) * (period_s / SUBSTEPS)
    speed, yaw_rate = _controls(maneuver, t)
    yaw = 0.4 + cumulative_trapezoid(yaw_rate, t, initial=0.0)
    velocity = speed[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    xy = cumulative_trapezoid(velocity, t, axis=0, initial=0.0)
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


def worlds(sigma_m: float, outlier_share: float, seeds: int) -> Iterator[World]:
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
            yield World(maneuver, seed, truth, xy, valid)


def errors_of(truth: Truth, xy_m: Array, velocity_mps: Array, yaw_rad: Array, curvature_1pm: Array) -> Array:
    """RMS errors (4,): position in m, velocity in m/s, yaw in degrees and curvature in 1/m, the latter two where it moves."""
    moving = truth.speed_mps > MOVING_MPS
    turned = np.degrees((yaw_rad - truth.yaw_rad + np.pi) % (2 * np.pi) - np.pi)

    def rms(values: Array) -> float:
        return float(np.sqrt(np.mean(values**2)))

    bent = (curvature_1pm - truth.curvature_1pm)[moving]
    off = [np.hypot(*(ours - true).T) for ours, true in ((xy_m, truth.xy_m), (velocity_mps, truth.velocity_mps))]
    return np.array([rms(off[0]), rms(off[1]), rms(turned[moving]), rms(bent)])


def rate_worlds(maneuver: str, rate_hz: int, sigma_m: float, seeds: int) -> Iterator[tuple[Truth, Array, Array]]:
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


ALL_S = np.arange(FRAMES) * PERIOD_S
# Times (n,), positions (n, 2) and sigma to xy (T, 2), velocity (T, 2), yaw (T,), curvature (T,).
Result = tuple[Array, Array, Array, Array]
Smoother = Callable[[Array, Array, float], Result]


def of_derivatives(xy: Array, velocity: Array, acceleration: Array) -> Result:
    speed = np.maximum(np.hypot(*velocity.T), MOVING_MPS / 2)
    across = velocity[:, 0] * acceleration[:, 1] - velocity[:, 1] * acceleration[:, 0]
    return xy, velocity, np.arctan2(velocity[:, 1], velocity[:, 0]), across / speed**3


def log2sim(t: Array, xy: Array, sigma: float, at_s: Array = ALL_S) -> Result:
    found = smooth_track(t, xy, sigma_m=sigma, at_s=at_s)
    return found.xy_m, found.velocity_mps, found.yaw_rad, found.curvature_1pm


def spline(t: Array, xy: Array, sigma: float, *, fit: Callable[[Array, Array, float], Any]) -> Result:
    splines = [fit(t, z, sigma) for z in xy.T]
    values = [np.column_stack([s.derivative(k)(ALL_S) if k else s(ALL_S) for s in splines]) for k in range(3)]
    return of_derivatives(*values)


def filtered(t: Array, xy: Array, _: float, *, window: int) -> Result:
    """SciPy's Savitzky-Golay filter of cubics, or with a window of 0 differences."""
    filled = np.column_stack([np.interp(ALL_S, t, z) for z in xy.T])
    if window:
        return of_derivatives(*(savgol_filter(filled, window, 3, deriv=k, delta=PERIOD_S, axis=0) for k in range(3)))
    velocity = np.gradient(filled, PERIOD_S, axis=0)
    return of_derivatives(filled, velocity, np.gradient(velocity, PERIOD_S, axis=0))


def kalman(t: Array, xy: Array, sigma: float, *, density: float) -> Result:
    """filterpy's Kalman filter with Rauch-Tung-Striebel smoothing, constant velocity."""
    from filterpy.common import Q_discrete_white_noise
    from filterpy.kalman import KalmanFilter

    kf = KalmanFilter(dim_x=4, dim_z=2)
    kf.F = np.kron(np.eye(2), [[1.0, PERIOD_S], [0.0, 1.0]])
    kf.H = np.kron(np.eye(2), [[1.0, 0.0]])
    kf.Q = np.kron(np.eye(2), Q_discrete_white_noise(2, PERIOD_S, density**2))
    kf.R *= sigma**2
    kf.P = np.diag([sigma**2, 400.0] * 2)
    kf.x[[0, 2], 0] = xy[0]
    seen = dict(zip(np.rint(t / PERIOD_S).astype(int).tolist(), xy, strict=True))
    states, covariances = [], []
    for k in range(FRAMES):
        kf.predict()
        kf.update(seen[k][:, None] if k in seen else None)
        states.append(kf.x.copy())
        covariances.append(kf.P.copy())
    x = kf.rts_smoother(np.array(states), np.array(covariances))[0][:, :, 0]
    velocity = x[:, [1, 3]]
    return of_derivatives(x[:, [0, 2]], velocity, np.gradient(velocity, PERIOD_S, axis=0))


def smoothers() -> dict[str, Smoother]:
    gcv = partial(spline, fit=lambda t, z, _: make_smoothing_spline(t, z))
    fixed = partial(spline, fit=lambda t, z, sigma: make_smoothing_spline(t, z, lam=0.1 * np.sqrt(sigma / 0.3)))
    by_sigma = partial(spline, fit=lambda t, z, sigma: UnivariateSpline(t, z, k=5, s=len(t) * sigma**2))
    out: dict[str, Smoother] = {
        "log2sim": log2sim,
        "raw, differences": partial(filtered, window=0),
        "SciPy make_smoothing_spline, GCV": gcv,
        "SciPy make_smoothing_spline, fixed penalty": fixed,
        "SciPy UnivariateSpline, s = n sigma^2": by_sigma,
        **{f"SciPy savgol_filter {window}/3": partial(filtered, window=window) for window in (15, 25)},
    }
    if optional("filterpy") is not None:
        out["filterpy Kalman + RTS, q = 1"] = partial(kalman, density=1.0)
        out["filterpy Kalman + RTS, q = 2"] = partial(kalman, density=2.0)
    return out


def measure(sigma: float, outliers: float, seeds: int) -> dict[str, list[float]]:
    """Median errors and milliseconds of each smoother over maneuvers and seeds."""
    rows: dict[str, list[list[float]]] = {}
    for world in worlds(sigma, outliers, seeds):
        for method, smooth in smoothers().items():
            begin = time.process_time()
            found = smooth(ALL_S[world.valid], world.xy_m[world.valid], sigma)
            milliseconds = 1e3 * (time.process_time() - begin)
            rows.setdefault(method, []).append([*errors_of(world.truth, *found), milliseconds])
    return {method: np.median(values, axis=0).tolist() for method, values in rows.items()}


def tables() -> str:
    warnings.simplefilter("ignore")
    cases = {"0.1 m": (0.1, 0.0), "0.3 m": (0.3, 0.0), "0.6 m": (0.6, 0.0), "0.3 m, 3 % outliers": (0.3, 0.03)}
    found = {name: measure(*case, seeds=8) for name, case in cases.items()}
    rows = [
        [method, f"{found['0.3 m'][method][4]:.2f}", *(errors_text(found[c][method]) for c in cases)]
        for method in found["0.3 m"]
    ]
    text = (
        "Four maneuvers of 20 s at 10 Hz, a tenth of the samples missing. Root mean square errors over all 201 times, also"
        " the missing ones: position m / velocity m/s / yaw degrees / curvature 1/m, by the noise of the positions."
    )
    by_noise = markdown(["method", "ms a track", *cases], rows)
    return f"{text}\n\n{by_noise}\n\n{by_rate(seeds=8)}\n\n{by_bound(seeds=30)}"


def errors_text(errors: Any) -> str:
    """Errors as `errors_of` tells them, with as many digits as they need."""
    return " / ".join(f"{v:.{d}f}" for v, d in zip(errors, (3, 3, 2, 4)))


def by_rate(seeds: int) -> str:
    """Errors and verdicts about standing by rate of the observations."""
    rows = []
    for rate_hz in RATES_HZ:
        cells = [f"{rate_hz} Hz"]
        for sigma_m in (0.1, 0.3):
            off, verdicts = [], []
            for name in MANEUVERS:
                for truth, t_s, xy_m in rate_worlds(name, rate_hz, sigma_m, seeds):
                    off.append(errors_of(truth, *log2sim(t_s, xy_m, sigma_m, truth.t_s)))
            for truth, t_s, xy_m in rate_worlds(QUEUE, rate_hz, sigma_m, seeds):
                _, velocity_mps, _, _ = log2sim(t_s, xy_m, sigma_m, truth.t_s)
                verdicts.append(standing_verdicts(truth, velocity_mps))
            cells.append(errors_text(np.median(off, axis=0)))
            cells += [f"{100 * share:.0f} %" for share in np.mean(verdicts, axis=0)]
        rows.append(cells)
    figures = ("errors", "standing found", "moving taken for standing")
    head = ["rate", *(f"{c}, {s} m" for s in (0.1, 0.3) for c in figures)]
    text = (
        "log2sim by rate of the observations, errors at 20 Hz between and at them. Standing: a queue that stands for 2, 3 and"
        " 5 s, rolls at 0.4 m/s and drives; shares of the time at which it stands, and at which it is faster than 0.2 m/s."
    )
    return f"{text}\n\n{markdown(head, rows)}"


def white_jerk(density: float) -> tuple[Array, Array]:
    """Transition (3, 3) of position, velocity and acceleration along an axis, and covariance of what white jerk adds to them.

    The square root of the jerk's spectral density is in m/s^2.5.
    """
    t = PERIOD_S
    transition = np.array([[1, t, t**2 / 2], [0, 1, t], [0, 0, 1]])
    return transition, density**2 * np.array(
        [[t**5 / 20, t**4 / 8, t**3 / 6], [t**4 / 8, t**3 / 3, t**2 / 2], [t**3 / 6, t**2 / 2, t]]
    )


# Of position m, velocity m/s and acceleration m/s^2 along an axis at the start of a drawn motion, and its mean along x.
START_SIGMAS, START_MPS = (10.0, 2.0, 0.5), 12.0
DENSITIES = (0.1, 0.3, 1.0, 2.0)


def smooth_told(
    densities: Array, yaw_rad: Array, xy: Array, valid: NDArray[np.bool_], sigma_m: float
) -> tuple[Array, Array]:
    """Positions (B, T, 2) of the Rauch-Tung-Striebel smoother that is told jerk densities (B, T-1, 2) along and across the way, and variances (B, T).

    The variances, of both axes together, are the posterior Cramer-Rao bound (Tichavsky, Muravchik & Nehorai, 1998) of all motions
    with such jerk about this way, which is linear. Positions (B, T, 2) count where they are `valid` (B, T).
    """
    step, unit = (np.kron(block, np.eye(2)) for block in white_jerk(1.0))
    turn = np.moveaxis(np.array([[np.cos(yaw_rad), -np.sin(yaw_rad)], [np.sin(yaw_rad), np.cos(yaw_rad)]]), 2, 0)
    by_axis = np.einsum("tij,btj,tkj->btik", turn[1:], densities, turn[1:])
    mean = np.concatenate([xy[:, 0], np.zeros((len(xy), 4))], axis=1)
    mean[:, 2:4] = START_MPS * turn[0, :, 0]
    covariance = np.tile(np.kron(np.diag(np.square(START_SIGMAS)), np.eye(2)), (len(xy), 1, 1))
    filtered, predicted = [], []
    for k in range(len(yaw_rad)):
        if k:
            mean, covariance = mean @ step.T, step @ covariance @ step.T + unit * np.tile(by_axis[:, k - 1], (1, 3, 3))
        predicted.append((mean, covariance))
        precision = np.linalg.inv(covariance[:, :2, :2] + sigma_m**2 * np.eye(2))
        gain = covariance[:, :, :2] @ precision * valid[:, k, None, None]
        mean = mean + np.einsum("bij,bj->bi", gain, xy[:, k] - mean[:, :2])
        covariance = covariance - gain @ covariance[:, :2]
        filtered.append((mean, covariance))
    smoothed = [(mean, covariance)]
    for (m, c), (ahead, spread) in zip(filtered[-2::-1], predicted[:0:-1], strict=True):
        gain = c @ step.T @ np.linalg.inv(spread)
        mean = m + np.einsum("bij,bj->bi", gain, mean - ahead)
        covariance = c + gain @ (covariance - spread) @ np.swapaxes(gain, 1, 2)
        smoothed.append((mean, covariance))
    means, covariances = (np.stack(columns[::-1], axis=1) for columns in zip(*smoothed))
    return means[..., :2], covariances[..., 0, 0] + covariances[..., 1, 1]


def cramer_rao_m(density: float, sigma_m: float) -> float:
    """Least root mean square position error of any estimator of motions with white jerk that knows its density and the noise."""
    densities, valid = np.full((1, FRAMES - 1, 2), density**2), np.ones((1, FRAMES), bool)
    variance = smooth_told(densities, np.zeros(FRAMES), np.zeros((1, FRAMES, 2)), valid, sigma_m)[1]
    return float(np.sqrt(variance.mean()))


def maneuver_bounds(maneuver: str, sigma_m: float, seeds: int) -> tuple[float, float, float]:
    """Root mean square position errors in m on a maneuver: of log2sim, and the bounds with constant jerk densities and with those that follow it.

    Of the motions with white jerk those that have the maneuver's: the densities with which the smoother that is told them errs least on
    the maneuver itself, constant along and across, or in proportion to the mean of the squared true jerk within some second.
    """
    cases = [world for world in worlds(sigma_m, 0.0, seeds) if world.maneuver == maneuver]
    truth = cases[0].truth
    velocity = truth.velocity_mps
    jerk = np.gradient(np.gradient(velocity, PERIOD_S, axis=0), PERIOD_S, axis=0)[1:]
    cos, sin = np.cos(truth.yaw_rad[1:]), np.sin(truth.yaw_rad[1:])
    squared = np.column_stack([jerk[:, 0] * cos + jerk[:, 1] * sin, jerk[:, 1] * cos - jerk[:, 0] * sin]) ** 2
    nearby = np.exp(-0.5 * ((ALL_S[1:, None] - ALL_S[None, 1:]) / 0.5) ** 2)
    following = nearby @ squared / nearby.sum(axis=1, keepdims=True)
    each = 10.0 ** np.arange(-4, 2.5, 0.5)
    constant = np.stack(np.meshgrid(each, each), axis=-1).reshape(-1, 1, 2) * np.ones((1, FRAMES - 1, 1))
    families = constant, np.geomspace(0.1, 3.0, 7)[:, None, None] * following + 1e-4
    xy, valid = np.array([w.xy_m for w in cases]), np.array([w.valid for w in cases])
    bounds = []
    for family in families:
        rows, n = np.repeat(np.arange(len(cases)), len(family)), len(family)
        densities = np.tile(family, (len(cases), 1, 1))
        found, variance = smooth_told(densities, truth.yaw_rad, xy[rows], valid[rows], sigma_m)
        off = ((found - truth.xy_m) ** 2).sum(axis=2).mean(axis=1).reshape(-1, n).mean(axis=0)
        bounds.append(float(np.sqrt(variance.mean(axis=1).reshape(-1, n).mean(axis=0)[np.argmin(off)])))
    ours = [log2sim(ALL_S[w.valid], w.xy_m[w.valid], sigma_m)[0] - truth.xy_m for w in cases]
    return float(np.sqrt(np.mean(np.square(ours).sum(axis=2)))), bounds[0], bounds[1]


def drawn_error_m(density: float, sigma_m: float, seeds: int) -> float:
    """Root mean square position error of log2sim on motions with white jerk."""
    step, added = white_jerk(density)
    factor, squares = np.linalg.cholesky(added), []
    for seed in range(seeds):
        rng = np.random.default_rng([seed, int(10 * density)])
        state = np.array(START_SIGMAS)[:, None] * rng.normal(size=(3, 2)) + [[0, 0], [START_MPS, 0], [0, 0]]
        xy = [state[0]]
        for _ in range(FRAMES - 1):
            state = step @ state + factor @ rng.normal(size=(3, 2))
            xy.append(state[0])
        truth = np.array(xy)
        found = log2sim(ALL_S, truth + rng.normal(0, sigma_m, truth.shape), sigma_m)[0]
        squares.append(np.mean(np.sum((found - truth) ** 2, axis=1)))
    return float(np.sqrt(np.mean(squares)))


def by_bound(seeds: int) -> str:
    """Position errors on drawn motions beside the least that is possible."""
    rows = []
    for density in DENSITIES:
        cells = [f"{density:g}"]
        for sigma_m in (0.1, 0.3):
            error_m, bound_m = drawn_error_m(density, sigma_m, seeds), cramer_rao_m(density, sigma_m)
            cells += [f"{error_m:.3f}", f"{bound_m:.3f}", f"{error_m / bound_m:.2f}"]
        rows.append(cells)
    text = (
        "log2sim beside the posterior Cramer-Rao bound, which no estimator passes on average, not even one that knows the statistics of"
        f" the motion: {seeds} drawn motions of white jerk at 10 Hz, around 12 m/s; root mean square position errors in m."
    )
    head = ["jerk, m/s^2.5", *(f"{c}, {s} m" for s in (0.1, 0.3) for c in ("error", "bound", "ratio"))]
    drawn = f"{text}\n\n{markdown(head, rows)}"
    rows = []
    for maneuver in MANEUVERS:
        rows.append([maneuver])
        for sigma_m in (0.1, 0.3, 0.6):
            error_m, constant_m, following_m = maneuver_bounds(maneuver, sigma_m, max(2, seeds // 4))
            rows[-1] += [f"{error_m:.3f}", f"{error_m / constant_m:.2f} / {error_m / following_m:.2f}"]
    text = (
        "The maneuvers of the first table, and errors in proportion to the bounds of motions with as much white jerk along and across"
        " the way: told how much there is in all / at every time."
    )
    head = ["maneuver", *(f"{c}, {s} m" for s in (0.1, 0.3, 0.6) for c in ("error", "ratios"))]
    return f"{drawn}\n\n{text}\n\n{markdown(head, rows)}"


def main(write: Path | None = None) -> None:
    """Print the tables; `write` puts them between their markers in a file."""
    print_section("smoothing", tables, write)
