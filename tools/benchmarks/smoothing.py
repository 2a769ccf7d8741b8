"""Noisy vehicle tracks with known truth: log2sim's smoother beside SciPy's splines and filters and filterpy.

Four maneuvers of 20 s at 10 Hz: a lane change at 15 m/s, a right-angle turn with slowing down, a stop, a slalom.
A tenth of the samples is missing; where asked 3 % are outliers of 5 to 20 sigma.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from benchmarks import smoothing_worlds
from benchmarks.table import markdown, optional, print_section
from log2sim.agents.smooth.smoother import smooth_track

Array = np.ndarray[Any, np.dtype[np.float64]]

STEP_S, COUNT, FINE = 0.1, 201, 10
MOVING_MPS = 1.0
SLOWEST_MPS = 0.5
MISSING = 0.1
NEAREST_SIGMAS, FARTHEST_SIGMAS = 5.0, 20.0


@dataclass(frozen=True, eq=False)
class Motion:
    """Positions (T, 2), velocities (T, 2), `yaw` (T,) and `curvature` (T,) at each tenth of a second."""

    xy: Array
    velocity: Array
    yaw: Array
    curvature: Array


def maneuver(name: str) -> Motion:
    """The truth, integrated from speed and yaw rate in steps of 10 ms."""
    t = np.arange((COUNT - 1) * FINE + 1) * STEP_S / FINE

    def rises(at_s: float, over_s: float) -> Array:
        return np.asarray(0.5 + 0.5 * np.tanh((t - at_s) / over_s))

    def pulse(at_s: float, over_s: float) -> Array:
        return np.asarray(np.exp(-(((t - at_s) / over_s) ** 2)))

    if name == "lane change":
        speed, turn = np.full_like(t, 15.0), 0.055 * (pulse(8.0, 0.9) - pulse(10.4, 0.9))
    elif name == "turn":
        speed = 12.0 - 7.0 * rises(5.0, 1.2) + 5.0 * rises(13.0, 1.5)
        turn = np.pi / 2 / (1.2 * np.sqrt(np.pi)) * pulse(9.0, 1.2)
    elif name == "stop and go":
        speed = 13.0 * (1.0 - rises(5.0, 1.3)) + 11.0 * rises(14.0, 1.6)
        speed = np.where(speed < 0.1, 0.0, speed)
        turn = 0.004 * speed * np.sin(0.5 * t)
    else:
        speed, turn = np.full_like(t, 10.0), 0.4 * np.sin(2 * np.pi * t / 5.0)
    yaw = 0.3 + summed(turn, t)
    velocity = speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
    xy = np.column_stack([summed(v, t) for v in velocity.T])
    curvature = np.where(speed > SLOWEST_MPS, turn / np.maximum(speed, SLOWEST_MPS), 0.0)
    return Motion(*(a[::FINE] for a in (xy, velocity, yaw, curvature)))


def summed(rate: Array, t: Array) -> Array:
    """Trapezoidal integral from zero."""
    return np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(t))])


ALL_S = np.arange(COUNT) * STEP_S
# Times (n,), positions (n, 2) and sigma to xy (T, 2), velocity (T, 2), yaw (T,), curvature (T,).
Result = tuple[Array, Array, Array, Array]
Smoother = Callable[[Array, Array, float], Result]


def of_derivatives(xy: Array, velocity: Array, acceleration: Array) -> Result:
    speed = np.hypot(*velocity.T)
    across = velocity[:, 0] * acceleration[:, 1] - velocity[:, 1] * acceleration[:, 0]
    return xy, velocity, np.arctan2(velocity[:, 1], velocity[:, 0]), across / np.maximum(speed, SLOWEST_MPS) ** 3


def log2sim(t: Array, xy: Array, sigma: float, *, told: bool = True) -> Result:
    found = smooth_track(t, xy, sigma_m=sigma if told else None, at_s=ALL_S)
    return found.xy_m, found.velocity_mps, found.yaw_rad, found.curvature_1pm


def smoothing_spline(t: Array, xy: Array, sigma: float, *, lam: float | None) -> Result:
    """SciPy's smoothing spline, by generalized cross-validation or with a fixed penalty."""
    from scipy.interpolate import make_smoothing_spline

    return of_splines([make_smoothing_spline(t, z, lam=lam and lam * np.sqrt(sigma / 0.3)) for z in xy.T])


def univariate_spline(t: Array, xy: Array, sigma: float) -> Result:
    from scipy.interpolate import UnivariateSpline

    return of_splines([UnivariateSpline(t, z, k=5, s=len(t) * sigma**2) for z in xy.T])


def of_splines(splines: list[Any]) -> Result:
    values = [np.column_stack([s.derivative(k)(ALL_S) if k else s(ALL_S) for s in splines]) for k in range(3)]
    return of_derivatives(*values)


def savgol(t: Array, xy: Array, _: float, *, window: int) -> Result:
    from scipy.signal import savgol_filter

    filled = np.column_stack([np.interp(ALL_S, t, z) for z in xy.T])
    return of_derivatives(*(savgol_filter(filled, window, 3, deriv=k, delta=STEP_S, axis=0) for k in range(3)))


def differences(t: Array, xy: Array, _: float) -> Result:
    filled = np.column_stack([np.interp(ALL_S, t, z) for z in xy.T])
    velocity = np.gradient(filled, STEP_S, axis=0)
    return of_derivatives(filled, velocity, np.gradient(velocity, STEP_S, axis=0))


def kalman(t: Array, xy: Array, sigma: float, *, density: float) -> Result:
    """filterpy's Kalman filter with Rauch-Tung-Striebel smoothing, constant velocity."""
    from filterpy.common import Q_discrete_white_noise
    from filterpy.kalman import KalmanFilter

    kf = KalmanFilter(dim_x=4, dim_z=2)
    kf.F = np.kron(np.eye(2), [[1.0, STEP_S], [0.0, 1.0]])
    kf.H = np.kron(np.eye(2), [[1.0, 0.0]])
    kf.Q = np.kron(np.eye(2), Q_discrete_white_noise(2, STEP_S, density**2))
    kf.R *= sigma**2
    kf.P = np.diag([sigma**2, 400.0] * 2)
    kf.x[[0, 2], 0] = xy[0]
    seen = dict(zip(np.rint(t / STEP_S).astype(int).tolist(), xy, strict=True))
    states, covariances = [], []
    for k in range(COUNT):
        kf.predict()
        kf.update(seen[k][:, None] if k in seen else None)
        states.append(kf.x.copy())
        covariances.append(kf.P.copy())
    x = kf.rts_smoother(np.array(states), np.array(covariances))[0][:, :, 0]
    velocity = x[:, [1, 3]]
    return of_derivatives(x[:, [0, 2]], velocity, np.gradient(velocity, STEP_S, axis=0))


def smoothers() -> dict[str, Smoother]:
    out: dict[str, Smoother] = {
        "log2sim": log2sim,
        "log2sim, noise not told": partial(log2sim, told=False),
        "raw, differences": differences,
        "SciPy make_smoothing_spline, GCV": partial(smoothing_spline, lam=None),
        "SciPy make_smoothing_spline, fixed penalty": partial(smoothing_spline, lam=0.1),
        "SciPy UnivariateSpline, s = n sigma^2": univariate_spline,
        "SciPy savgol_filter 15/3": partial(savgol, window=15),
        "SciPy savgol_filter 25/3": partial(savgol, window=25),
    }
    if optional("filterpy") is not None:
        out["filterpy Kalman + RTS, q = 1"] = partial(kalman, density=1.0)
        out["filterpy Kalman + RTS, q = 2"] = partial(kalman, density=2.0)
    return out


def errors(found: Result, truth: Motion) -> list[float]:
    """Root mean squares of position m, velocity m/s, and where it moves of yaw in degrees and curvature 1/m."""
    xy, velocity, yaw, curvature = found
    moving = np.hypot(*truth.velocity.T) > MOVING_MPS
    turned = (yaw - truth.yaw + np.pi) % (2 * np.pi) - np.pi
    off = [
        np.hypot(*(xy - truth.xy).T),
        np.hypot(*(velocity - truth.velocity).T),
        np.degrees(turned[moving]),
        (curvature - truth.curvature)[moving],
    ]
    return [float(np.sqrt(np.mean(np.square(e)))) for e in off]


def measure(sigma: float, outliers: float, seeds: int) -> dict[str, list[float]]:
    """Median errors and milliseconds of each smoother over maneuvers and seeds."""
    rows: dict[str, list[list[float]]] = {}
    for number, name in enumerate(("lane change", "turn", "stop and go", "slalom")):
        truth = maneuver(name)
        for seed in range(seeds):
            rng = np.random.default_rng([number, seed])
            keep = rng.random(COUNT) > MISSING
            keep[[0, -1]] = True
            xy = truth.xy + rng.normal(0.0, sigma, (COUNT, 2))
            wrong = rng.random(COUNT) < outliers
            far = rng.uniform(NEAREST_SIGMAS, FARTHEST_SIGMAS, (int(wrong.sum()), 1))
            xy[wrong] += sigma * far * rng.normal(size=(int(wrong.sum()), 2))
            for method, smooth in smoothers().items():
                begin = time.process_time()
                found = smooth(ALL_S[keep], xy[keep], sigma)
                seconds = time.process_time() - begin
                rows.setdefault(method, []).append([*errors(found, truth), seconds * 1e3])
    return {method: np.median(values, axis=0).tolist() for method, values in rows.items()}


def sections(*, quick: bool) -> tuple[str, str]:
    """Title and tables."""
    warnings.simplefilter("ignore")
    cases = {
        "0.1 m": (0.1, 0.0),
        "0.3 m": (0.3, 0.0),
        "0.6 m": (0.6, 0.0),
        "0.3 m, 3 % outliers": (0.3, 0.03),
    }
    found = {name: measure(*case, seeds=2 if quick else 8) for name, case in cases.items()}
    rows = []
    for method in found["0.3 m"]:
        cells = [" / ".join(f"{v:.{d}f}" for v, d in zip(found[c][method], (3, 3, 2, 4))) for c in cases]
        rows.append([method, f"{found['0.3 m'][method][4]:.2f}", *cells])
    told = (
        "Four maneuvers of 20 s at 10 Hz, a tenth of the samples missing. Root mean square errors over all 201 times, also"
        " the missing ones: position m / velocity m/s / yaw degrees / curvature 1/m, by the noise of the positions."
    )
    return (
        "Smoothing",
        f"{told}\n\n{markdown(['method', 'ms a track', *cases], rows)}\n\n{by_rate(seeds=2 if quick else 8)}",
    )


def by_rate(seeds: int) -> str:
    """Errors and verdicts about standing by rate of the observations."""
    rows = []
    for rate_hz in smoothing_worlds.RATES_HZ:
        cells = [f"{rate_hz} Hz"]
        for sigma_m in (0.1, 0.3):
            off, verdicts = [], []
            for name in smoothing_worlds.MANEUVERS:
                for truth, t_s, xy_m in smoothing_worlds.rate_worlds(name, rate_hz, sigma_m, seeds):
                    path = smooth_track(t_s, xy_m, sigma_m=sigma_m, at_s=truth.t_s)
                    estimate = path.xy_m, path.velocity_mps, path.yaw_rad, path.curvature_1pm
                    off.append(smoothing_worlds.errors_of(truth, *estimate))
            for truth, t_s, xy_m in smoothing_worlds.rate_worlds(smoothing_worlds.QUEUE, rate_hz, sigma_m, seeds):
                path = smooth_track(t_s, xy_m, sigma_m=sigma_m, at_s=truth.t_s)
                verdicts.append(smoothing_worlds.standing_verdicts(truth, path.velocity_mps))
            cells.append(" / ".join(f"{v:.{d}f}" for v, d in zip(np.median(off, axis=0), (3, 3, 2, 4))))
            cells += [f"{100 * share:.0f} %" for share in np.mean(verdicts, axis=0)]
        rows.append(cells)
    head = [
        "rate",
        *(f"{c}, {s} m" for s in (0.1, 0.3) for c in ("errors", "standing found", "moving taken for standing")),
    ]
    text = (
        "log2sim by rate of the observations, errors at 20 Hz between and at them. Standing: a queue that stands for 2, 3 and"
        " 5 s, rolls at 0.4 m/s and drives; shares of the time at which it stands, and at which it is faster than 0.2 m/s."
    )
    return f"{text}\n\n{markdown(head, rows)}"


def main(arguments: list[str] | None = None) -> None:
    """Run the command."""
    print_section("smoothing", sections, arguments)
