"""Reference motion of an agent at any time, made from its waypoints.

Waypoints are box centers at the log's rate. What a vehicle has to follow is the motion of its rear axle, with a speed,
an acceleration and a curvature that it can drive; so the pose goes exactly through the waypoints, and the feed-forward
columns (speed, acceleration, curvature) are smoothed over `SMOOTHING_S`, forward and backward alike, without delay.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, wrap_angle
from log2sim.scenario import Agent

GRID_S = 0.02
"""Spacing of the tables; between their rows a linear course errs by at most a h^2 / 8 = 0.5 mm at 10 m/s2."""

SMOOTHING_S = 0.12
"""Standard deviation of the Gaussian over feed-forward columns: one waypoint of a 10 Hz log."""

STANDSTILL_MPS = 0.08
MIN_RUN_M = 0.3  # shorter forward or backward runs are noise of a standing agent
TREND_S = 0.5  # window for what the log's speed and yaw have against its positions
DRIFT_PRIOR_MPS = 1.5  # 0.1 m/s of noise in the smoothed course against drifts of 4 degrees
MAX_DRIFT = 0.4
FAST_MPS = 1.5
CURVATURE_MIN_SPEED_MPS = 0.2  # RMS speed in the window, below which the yaw says nothing about the path
MAX_ACCEL_MPS2 = 10.4  # feasibility limits of Waymax (Gulino et al., 2023)
MAX_CURVATURE_1PM = 0.3
JUMP_M = 2.0
JUMP_SPEED_MPS = 15.0


@dataclass(frozen=True, eq=False)
class Path:
    """Course of an agent's reference point (rear axle, or center for points) through its waypoints.

    `t_s` (T,), `x_m`, `y_m` (T,) in m relative to `origin_m`, `yaw_rad` (T,) unwrapped, `speed_mps` (T,), tangents
    `velocity_x_mps`, `velocity_y_mps` (T,), `jump` (T - 1,) True where the log leaps and is not followed.
    """

    t_s: Array
    x_m: Array
    y_m: Array
    z_m: Array
    yaw_rad: Array
    speed_mps: Array
    velocity_x_mps: Array
    velocity_y_mps: Array
    jump: NDArray[np.bool_]
    origin_m: tuple[float, float]
    offset_m: float

    def at(self, t_s: Array) -> tuple[Array, Array, Array, Array]:
        """x, y relative to the origin, yaw (unwrapped) and logged speed at times (N,), held outside the life.

        Between waypoints the position is a cubic with their velocities (Hermite). Before a leap it goes straight on.
        """
        t = np.clip(t_s, self.t_s[0], self.t_s[-1])
        yaw, speed = np.interp(t, self.t_s, self.yaw_rad), np.interp(t, self.t_s, self.speed_mps)
        if len(self.t_s) == 1:
            return np.full(len(t), self.x_m[0]), np.full(len(t), self.y_m[0]), yaw, speed
        i = np.clip(np.searchsorted(self.t_s, t, side="right") - 1, 0, len(self.t_s) - 2)
        span = self.t_s[i + 1] - self.t_s[i]
        x = _hermite(self.x_m, self.velocity_x_mps, i, t - self.t_s[i], span, self.jump)
        y = _hermite(self.y_m, self.velocity_y_mps, i, t - self.t_s[i], span, self.jump)
        return x, y, np.where(self.jump[i] & (t < self.t_s[i + 1]), self.yaw_rad[i], yaw), speed

    def centers(self, t_s: Array) -> tuple[Array, Array, Array, Array]:
        """Box center x, y in the map, yaw in [-pi, pi) and logged speed at times (N,)."""
        x, y, yaw, speed = self.at(t_s)
        x = x + self.offset_m * np.cos(yaw) + self.origin_m[0]
        y = y + self.offset_m * np.sin(yaw) + self.origin_m[1]
        return x, y, wrap_angle(yaw), speed

    def jump_times(self) -> Array:
        """Times (J,) at which the log stands elsewhere than it could have driven to."""
        return self.t_s[1:][self.jump]


def path_of(agent: Agent, rear_axle_offset_m: float) -> Path:
    """The path of the reference point `rear_axle_offset_m` behind the box center of an agent."""
    w = agent.waypoints
    origin_m = (float(w.x_m[0]), float(w.y_m[0]))
    yaw = np.unwrap(w.yaw_rad)
    x = (w.x_m - origin_m[0]) - rear_axle_offset_m * np.cos(yaw)
    y = (w.y_m - origin_m[1]) - rear_axle_offset_m * np.sin(yaw)
    vx, vy = w.speed_mps * np.cos(yaw), w.speed_mps * np.sin(yaw)
    jump = np.zeros(max(len(w) - 1, 0), dtype=bool)
    if len(w) > 1:
        span = np.diff(w.t_s)
        miss = np.hypot(np.diff(x) - (vx[1:] + vx[:-1]) / 2 * span, np.diff(y) - (vy[1:] + vy[:-1]) / 2 * span)
        jump = (miss > JUMP_M) & (miss > JUMP_SPEED_MPS * span)
        vx, vy = _tangents(w.t_s, x, y, vx, vy, jump)
    return Path(w.t_s, x, y, w.z_m, yaw, w.speed_mps, vx, vy, jump, origin_m, rear_axle_offset_m)


def _tangents(t_s: Array, x: Array, y: Array, vx: Array, vy: Array, jump: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Velocities (T,) at the waypoints: the logged ones, or difference quotients where these say something else.

    Sideways steps of a pedestrian and a box labeled back to front would otherwise bend the course into loops.
    """
    dx, dy = np.gradient(x, t_s), np.gradient(y, t_s)
    beside_jump = np.concatenate([jump, [False]]) | np.concatenate([[False], jump])
    differs = np.hypot(vx - dx, vy - dy) > 0.5 + 0.3 * np.hypot(dx, dy)
    replace = differs & ~beside_jump
    return np.where(replace, dx, vx), np.where(replace, dy, vy)


def _hermite(value: Array, slope: Array, i: NDArray[np.intp], t: Array, span: Array, jump: NDArray[np.bool_]) -> Array:
    """Cubic through value[i], value[i + 1] with their slopes; a straight line from value[i] before a leap."""
    f = t / span
    rise = value[i + 1] - value[i]
    cubic = value[i] + f * (
        span * slope[i]
        + f * (3 * rise - span * (2 * slope[i] + slope[i + 1]) + f * (span * (slope[i] + slope[i + 1]) - 2 * rise))
    )
    return np.where(jump[i] & (f < 1), value[i] + t * slope[i], cubic)


@dataclass(frozen=True, eq=False)
class Reference:
    """An agent's table: row k of `columns` (K, C) holds for the time (first_row + k) * GRID_S; see the two functions."""

    path: Path
    first_row: int
    columns: Array
    flags: tuple[str, ...] = ()


VEHICLE_COLUMNS = ("x", "y", "yaw", "speed", "accel_ahead", "curvature_ahead", "gear", "stands")
POINT_COLUMNS = ("x", "y", "yaw", "velocity_x", "velocity_y", "accel_x", "accel_y", "stands")


def vehicle_reference(
    path: Path, *, accel_ahead_s: float, curvature_ahead_s: float, max_curvature_1pm: float = MAX_CURVATURE_1PM
) -> Reference:
    """The table of a vehicle. Columns "..._ahead" are those of a later time, which makes up for the actuators' lag.

    Beyond `max_curvature_1pm` the reference is flagged, not changed.
    """
    first, t = _grid(path)
    x, y, yaw, logged_speed = path.at(t)
    speed = _smooth(logged_speed)
    if len(t) > 2:
        ahead, aside = _body_velocity(x, y, yaw)
        speed = speed + _smooth(ahead - logged_speed, TREND_S, odd=False)
        course = yaw + _drift(speed, aside)
    else:
        course = yaw
    accel = np.gradient(speed, GRID_S) if len(t) > 1 else np.zeros(1)
    curvature = _curvature(yaw, speed)
    gear, stands = _gear(speed), np.abs(speed) < STANDSTILL_MPS
    columns = np.stack(
        [
            x, y, course, speed,
            np.interp(t + accel_ahead_s, t, accel),
            np.interp(t + curvature_ahead_s, t, curvature),
            gear, stands.astype(np.float64),
        ],
        axis=1,
    )  # fmt: skip
    return Reference(path, first, columns, _flags(path, t, accel, curvature, max_curvature_1pm))


def point_reference(path: Path) -> Reference:
    """The table of a point: velocity and acceleration of the smoothed course, on map axes."""
    first, t = _grid(path)
    x, y, yaw, logged_speed = path.at(t)
    if len(t) > 1:
        vx, vy = _smooth(np.gradient(x, GRID_S)), _smooth(np.gradient(y, GRID_S))
        ax, ay = np.gradient(vx, GRID_S), np.gradient(vy, GRID_S)
    else:
        vx, vy, ax, ay = logged_speed * np.cos(yaw), logged_speed * np.sin(yaw), np.zeros(1), np.zeros(1)
    stands = (np.hypot(vx, vy) < STANDSTILL_MPS).astype(np.float64)
    flags = tuple(f"the log leaps at {at:.2f} s" for at in path.jump_times())
    return Reference(path, first, np.stack([x, y, yaw, vx, vy, ax, ay, stands], axis=1), flags)


def tape_reference(path: Path, flags: tuple[str, ...] = ()) -> Reference:
    """The table of an agent that is where the log has it: x, y, yaw, logged speed."""
    first, t = _grid(path)
    return Reference(path, first, np.stack(path.at(t), axis=1), flags)


def _grid(path: Path) -> tuple[int, Array]:
    """First row and the times of all rows that cover the life of a path."""
    first = int(np.floor(path.t_s[0] / GRID_S))
    last = int(np.ceil(path.t_s[-1] / GRID_S))
    return first, np.arange(first, last + 1) * GRID_S


def _smooth(values: Array, sigma_s: float = SMOOTHING_S, *, odd: bool = True) -> Array:
    """Gaussian smoothing; the ends are mirrored in a point, so that a straight course stays as it is, or in the axis."""
    if len(values) < 3:
        return values
    reach = min(int(np.ceil(3 * sigma_s / GRID_S)), len(values) - 1)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * GRID_S / sigma_s) ** 2)
    padded = np.pad(values, reach, mode="reflect", reflect_type="odd" if odd else "even")
    return np.convolve(padded, kernel / kernel.sum(), mode="valid")


def _slope(rise: Array, run: Array, min_run: float, sigma_s: float) -> Array:
    """Least-squares slope of `rise` over `run` through zero in a Gaussian window, (K,).

    Rows that hardly move thereby count for nothing. Where the RMS of `run` is below `min_run`, the neighbors' slope is
    interpolated; 0 if there are none.
    """
    square = _smooth(run**2, sigma_s, odd=False)
    known = square > min_run**2
    if not known.any():
        return np.zeros(len(run))
    rows = np.arange(len(run))
    return np.interp(rows, rows[known], _smooth(rise * run, sigma_s, odd=False)[known] / square[known])


def _body_velocity(x: Array, y: Array, yaw: Array) -> tuple[Array, Array]:
    """Velocity of the course along and across the heading, (K,), (K,)."""
    vx, vy = np.gradient(x, GRID_S), np.gradient(y, GRID_S)
    return vx * np.cos(yaw) + vy * np.sin(yaw), vy * np.cos(yaw) - vx * np.sin(yaw)


def _drift(speed: Array, aside: Array) -> Array:
    """Angle (K,) from the heading to the course. A wheel has none: it is the log's yaw or its rear axle that is a bit off.

    A follower that held such a heading would run beside the path, by twice its distance constant times the angle. The
    least-squares angle has a prior of zero, so that jitter of a slow vehicle does not pass for drift.
    """
    slope = _smooth(aside * speed, TREND_S, odd=False) / (_smooth(speed**2, TREND_S, odd=False) + DRIFT_PRIOR_MPS**2)
    return np.arctan(np.clip(slope, -MAX_DRIFT, MAX_DRIFT))


def _curvature(yaw: Array, speed: Array) -> Array:
    """Signed curvature in 1/m: yaw rate over speed, over a longer window where the vehicle is slow and noise in yaw large."""
    if len(yaw) < 3:
        return np.zeros(len(yaw))
    rate = np.gradient(yaw, GRID_S)
    fast = _smooth(speed**2, odd=False) > FAST_MPS**2
    return np.where(
        fast,
        _slope(rate, speed, FAST_MPS, SMOOTHING_S),
        _slope(rate, speed, CURVATURE_MIN_SPEED_MPS, TREND_S),
    )


def _gear(speed: Array) -> Array:
    """+1 or -1 for every row: the direction of the current motion, or of the next one while standing."""
    direction = np.where(np.abs(speed) < STANDSTILL_MPS, 0, np.sign(speed)).astype(int)
    edges = np.flatnonzero(np.diff(direction)) + 1
    runs = np.split(np.arange(len(speed)), edges)
    moving = [r for r in runs if direction[r[0]] != 0 and abs(speed[r].sum()) * GRID_S >= MIN_RUN_M]
    gear = np.ones(len(speed))
    if not moving:
        return gear
    begin = 0
    for run in moving:
        gear[begin : run[-1] + 1] = direction[run[0]]
        begin = run[-1] + 1
    gear[begin:] = direction[moving[-1][0]]
    return gear


def _flags(path: Path, t: Array, accel: Array, curvature: Array, max_curvature_1pm: float) -> tuple[str, ...]:
    """What no vehicle could drive: leaps, and feed-forward beyond the limits of acceleration and curvature."""
    flags = [f"the log leaps at {at:.2f} s" for at in path.jump_times()]
    for name, values, limit, unit in (
        ("acceleration", accel, MAX_ACCEL_MPS2, "m/s2"),
        ("curvature", curvature, max_curvature_1pm, "1/m"),
    ):
        worst = int(np.argmax(np.abs(values)))
        if abs(values[worst]) > limit:
            flags.append(f"{name} of {values[worst]:.2f} {unit} at {t[worst]:.2f} s, limit {limit:g}")
    return tuple(flags)
