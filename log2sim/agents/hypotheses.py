"""What a track is: one object that is static or moves, starts or stops, or several, one after the other.

The center of a long vehicle wanders by meters while more or less of it is seen, and its mean velocity is small if it starts
late. Its ends, where they are observed, do neither.

The hypotheses are compared by the evidence of all measurements of the track over the whole log.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.size import Ends, ends_of
from log2sim.agents.smooth.fixed_interval import (
    OUTLIER_LOG,
    PLACE_SIGMA_M,
    REPEATED_SHARE,
    STANDING,
    MarginalLikelihood,
    MotionPriorSigmas,
    Positions,
    marginal_likelihood,
    noise_of,
)
from log2sim.datatypes import GROUP_OF, MIN_SIZE_M, TYPICAL_SIZE_M, Measurements, Track
from log2sim.geometry import NS_PER_S, Array, wrap_angle
from log2sim.perception import boxes
from log2sim.perception.boxes import UNIFORM_SIGMA, real_ends, rotate
from log2sim.perception.lidar.clusters import MIN_CLUSTER_POINTS
from log2sim.tracking.forward import ACCELERATION_MPS2, CENTER_SIGMA_M, CHI2_2DOF_99, FIRST_SPEED_MPS

# A mean velocity below this, or within its own uncertainty, is no motion. The drift is the velocity times the duration.
MAX_STATIC_SPEED_MPS = {"vehicle": 0.35, "two_wheeler": 0.3, "pedestrian": 0.2, "other": 0.35}
MAX_STATIC_DRIFT_M = {"vehicle": 1.2, "two_wheeler": 0.8, "pedestrian": 0.5, "other": 1.2}
SIGNIFICANT_SIGMAS, EXCLUDED_SIGMAS = 2.0, 3.0
SPREAD_QUANTILE = 0.9
# Error of an observed end: rounded corners, gaps between rays.
END_SIGMA_M = 0.25
# Tuning constant of Cauchy's weights with 95 % efficiency for normal errors (Holland & Welsch, 1977).
CAUCHY_SIGMAS = 2.385
REWEIGHTINGS = 5


def is_static(track: Track) -> bool:
    """Return whether a track never moves: its robust velocity and drift are within the errors that changing views cause.

    Notes
    -----
    While parts of a vehicle are hidden its center is uncertain, by meters for a long one. A vehicle whose center seems to
    move is static if its observed ends do not move and are accurate enough to exclude the motion of the center.
    """
    m, group = track.measurements, GROUP_OF[track.category]
    if len(m) < 3:
        return group == "vehicle"
    t = (m.t_ns - m.t_ns[0]) / NS_PER_S
    center = _motion_of_centers(t, m, CENTER_SIGMA_M[group])
    if _is_none(center, float(t[-1]), group):
        return True
    ends = _motion_of_ends(t, m) if group == "vehicle" else None
    if ends is None or not _is_none(ends, float(t[-1]), group):
        return False
    excess = float(np.hypot(*center.velocity) - np.hypot(*ends.velocity))
    return ends.sigma_mps < max(center.sigma_mps, excess / EXCLUDED_SIGMAS)


@dataclass(frozen=True, eq=False)
class _Motion:
    """Uniform motion fitted to the observations of a track.

    Attributes
    ----------
    velocity : (2,) float64
        In m/s, along any two axes.
    sigma_mps : float
        Its standard deviation.
    spread_m : float
        The `SPREAD_QUANTILE` of the distances from the mean position, less two standard deviations of each.
    """

    velocity: Array
    sigma_mps: float
    spread_m: float


def _is_none(motion: _Motion, span_s: float, group: str) -> bool:
    """Return whether a motion is too slow or too uncertain to count as one."""
    speed = float(np.hypot(*motion.velocity))
    drift = speed * span_s
    slow = (
        speed < max(MAX_STATIC_SPEED_MPS[group], SIGNIFICANT_SIGMAS * motion.sigma_mps) or drift < CENTER_SIGMA_M[group]
    )
    return bool(slow and drift < MAX_STATIC_DRIFT_M[group] and motion.spread_m < 1.5 * MAX_STATIC_DRIFT_M[group])


def _motion_of_centers(t: Array, m: Measurements, sigma_m: float) -> _Motion:
    """Fit the motion of box centers; `sigma_m` is the noise that changing views add."""
    xy = m.center_m[:, :2] - np.median(m.center_m[:, :2], axis=0)
    largest: Array = np.linalg.eigvalsh(m.covariance)[:, -1].astype(np.float64)
    center, velocity, sigma_mps = robust_line(t, xy, largest + sigma_m**2)
    # Within its covariance a center has not moved.
    spread = np.hypot(*(xy - center).T) - 2 * np.sqrt(largest)
    return _Motion(velocity, sigma_mps, float(np.quantile(spread, SPREAD_QUANTILE)))


def _motion_of_ends(t: Array, m: Measurements) -> _Motion | None:
    """Fit the motion of the observed ends; None unless both axes have one at most measurements."""
    rows = np.flatnonzero([len(c) > 0 for c in m.cluster])
    if len(rows) < 3:
        return None
    yaw, origin = float(m.yaw_rad[rows[np.argmax(m.points[rows])]]), m.center_m[rows[0], :2]
    both = [boxes.extents(m.cluster[k][:, :2] - origin, yaw) for k in rows.tolist()]
    ends = np.stack([np.stack(e, axis=1) for e in both])
    sensor = boxes.rotate(m.sensor_m[rows, :2] - origin, -yaw)
    real = real_ends(ends[..., 0], ends[..., 1], sensor, m.ends_visible[rows]) > 0
    # The end may lie between two points of the cluster.
    gap = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=1) / np.sqrt(m.points[rows])
    variance = END_SIGMA_M**2 + gap**2
    velocity, sigma, spread = np.zeros(2), np.zeros(2), np.zeros(2)
    for axis in range(2):
        if np.any(real[:, axis], axis=1).mean() <= 0.5:
            return None
        # A rigid object moves with both ends: if one is static, the other moves because more of the object becomes visible.
        slowest = np.inf
        for end in np.flatnonzero(real[:, axis].mean(axis=0) > 0.25):
            visible = np.flatnonzero(real[:, axis, end])
            mean, speed, sigma_mps = robust_line(t[rows[visible]], ends[visible, axis, end, None], variance[visible])
            if abs(speed[0]) < slowest:
                slowest = abs(float(speed[0]))
                velocity[axis], sigma[axis] = speed[0], sigma_mps
                excess_m = np.abs(ends[visible, axis, end] - mean[0]) - 2 * np.sqrt(variance[visible])
                spread[axis] = np.quantile(excess_m, SPREAD_QUANTILE)
    return _Motion(velocity, float(sigma.max()), float(spread.max()))


def robust_line(t: Array, xy: Array, variance: Array) -> tuple[Array, Array, float]:
    """Fit uniform motion to positions by weighted least squares that outliers move little.

    Parameters
    ----------
    t : (n,) float64, s
    xy : (n, d) float64, m
    variance : (n,) float64, m2
        Of a position in each direction.

    Returns
    -------
    center : (d,)
        The weighted mean of the positions.
    velocity : (d,)
        In m/s; zero where all times are the same.
    sigma_mps : float
        Standard deviation of the velocity in each direction, larger where positions scatter more than their variances say
        (Birge, 1932), infinite where all times are the same.

    Notes
    -----
    Iteratively reweighted by Cauchy's function of the residuals (Holland & Welsch, "Robust regression using iteratively
    reweighted least-squares", 1977).
    """
    weight, robust = 1.0 / variance, np.ones(len(t))
    for _ in range(REWEIGHTINGS):
        w = weight * robust
        mean_t, center = w @ t / w.sum(), w @ xy / w.sum()
        known = float(w @ (t - mean_t) ** 2)
        velocity = (w * (t - mean_t)) @ (xy - center) / known if known > 0 else np.zeros(xy.shape[1])
        residual = xy - center - (t - mean_t)[:, None] * velocity
        squared = weight * (residual**2).sum(axis=1)
        robust = 1.0 / (1.0 + squared / CAUCHY_SIGMAS**2)
    scatter = float(squared.mean()) / xy.shape[1]
    return center, velocity, (max(scatter, 1.0) / known) ** 0.5 if known > 0 else np.inf


# More measurements of a track are not looked at one by one; fewer of an end show no motion.
MAX_START_ROWS, MIN_START_ROWS = 60, 5
# Times at which a vehicle may start or stop; a shorter motion may be a neighbor that joins its points for some ticks.
TIMES, MIN_MOTION_S = 24, 1.0
# One vehicle in fifty that seems to stand starts or stops; it is said to if that is e^3 = 20 times as likely.
STARTS_LOG, MIN_START_LOG_ODDS = float(np.log(0.02)), 3.0


def starts_or_stops(track: Track) -> bool:
    """Return whether a vehicle stands and then sets off, or comes to rest and then stands.

    Notes
    -----
    Compared are the marginal likelihoods of ends that stay and of ends that move with a constant acceleration from or until
    an unknown time, both together since the object is rigid. Errors of an end repeat while the view stays the same. An end
    that moves because more of the object comes into view moves alone.
    """
    group = GROUP_OF[track.category]
    m = track.measurements
    rows = np.flatnonzero(np.isfinite(m.yaw_rad) & [len(c) >= MIN_CLUSTER_POINTS for c in m.cluster])
    if group != "vehicle" or len(rows) < MIN_START_ROWS:
        return False
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MAX_START_ROWS)).round().astype(np.intp))]
    yaw, yaw_sigma = _axis(m.yaw_rad[rows])
    turned_m = TYPICAL_SIZE_M[track.category][1] * yaw_sigma
    ends = ends_of(track, rows, np.full(len(rows), yaw), np.zeros((len(rows), 2)))
    origin = rotate(m.sensor_m[rows, :2] - m.center_m[rows[0], :2], -yaw)
    # Frames that share a sweep measure the same points at the same time.
    t = (m.t_ns[rows] - m.t_ns[rows[0]]) / NS_PER_S + 1e-4 * np.arange(len(rows))
    along, across = (_observed_ends(t, ends, origin, axis, turned_m) for axis in range(2))
    # A single end may be that of a neighbor that joins the points; ends that move across, too, are those of something else.
    return (
        len(along) == 2 and _log_odds(along, group) + STARTS_LOG > MIN_START_LOG_ODDS and _log_odds(across, group) <= 0
    )


def _axis(yaw_rad: Array) -> tuple[float, float]:
    """Return the length axis of most of the yaws (n,) of one vehicle, and their standard deviation up to quarter turns, in rad."""
    mean = float(np.angle(np.exp(4j * yaw_rad).sum())) / 4
    off = wrap_angle(4 * (yaw_rad - mean)) / 4
    is_across = np.abs(np.sin(yaw_rad - mean)) > np.abs(np.cos(yaw_rad - mean))
    return mean + (np.pi / 2 if is_across.mean() > 0.5 else 0.0), float(np.sqrt(np.mean(off**2)))


def _observed_ends(t: Array, ends: Ends, origin: Array, axis: int, sigma_m: float) -> list[Positions]:
    """Return the positions of the lower and the upper end along an axis where they are observed, without outliers."""
    variance = END_SIGMA_M**2 + sigma_m**2 + (UNIFORM_SIGMA * ends.gap_m) ** 2
    found = []
    for side, along in enumerate((ends.low, ends.high)):
        seen = np.flatnonzero(ends.real[:, axis, side] > 0)
        if len(seen) < MIN_START_ROWS:
            continue
        place = np.column_stack([(along + origin)[seen, axis], np.zeros(len(seen))])
        positions = Positions(t[seen], place, variance[seen, axis, side])
        # What no motion of a vehicle explains is an outlier of each hypothesis.
        motion = MotionPriorSigmas(FIRST_SPEED_MPS["vehicle"], ACCELERATION_MPS2["vehicle"])
        kept = positions.take(marginal_likelihood(positions, motion).inlier)
        if len(kept) >= MIN_START_ROWS:
            found.append(_scattering(kept))
    return found


def _scattering(p: Positions) -> Positions:
    """Enlarge the variances of positions that scatter more about those next to them than they say (Birge, 1932)."""
    share = np.diff(p.t_s)[:-1] / (p.t_s[2:] - p.t_s[:-2])
    off = p.xy_m[1:-1, 0] - p.xy_m[:-2, 0] * (1 - share) - p.xy_m[2:, 0] * share
    noise = noise_of(p)
    weights = np.zeros((len(off), len(p)))
    rows = np.arange(len(off))
    weights[rows, rows], weights[rows, rows + 1], weights[rows, rows + 2] = share - 1, 1.0, -share
    expected = np.einsum("ij,jk,ik->i", weights, noise, weights)
    return Positions(p.t_s, p.xy_m, p.variance * max(1.0, float(np.mean(off**2 / expected))))


def _log_odds(ends: list[Positions], group: str) -> float:
    """Return the logarithm of the likelihood of ends that start or stop over that of ends that stay.

    It is the least of all ends together and of each one: what moves at one end only grows.
    """
    if not ends:
        return -np.inf
    first, last = min(p.t_s[0] for p in ends), max(p.t_s[-1] for p in ends)
    times = np.linspace(first, last, TIMES)
    starts, stops = times <= last - MIN_MOTION_S, times >= first + MIN_MOTION_S
    count = int(starts.sum() + stops.sum())
    if count == 0:
        return -np.inf
    known, pulled = np.zeros((len(ends), count)), np.zeros((len(ends), count))
    for k, p in enumerate(ends):
        late = p.t_s[:, None] - times
        moved = np.concatenate([np.maximum(late[:, starts], 0.0), np.maximum(-late[:, stops], 0.0)], axis=1) ** 2 / 2
        weight = np.linalg.inv(noise_of(p) + PLACE_SIGMA_M**2)
        known[k] = ((weight @ moved) * moved).sum(axis=0)
        pulled[k] = moved.T @ weight @ (p.xy_m[:, 0] - np.median(p.xy_m[:, 0]))
    known, pulled = np.vstack([known, known.sum(axis=0)]), np.vstack([pulled, pulled.sum(axis=0)])
    # The acceleration is integrated out: a covariance of rank one joins that of ends that stay.
    variance = ACCELERATION_MPS2[group] ** 2
    each = 0.5 * (variance * pulled**2 / (1 + variance * known) - np.log1p(variance * known))
    return float(np.logaddexp.reduce(each.min(axis=0)) - np.log(count))


# More measurements of a track are not looked at one by one.
MAX_ROWS = 80
# Fewer measurements show no object, and fewer show no motion: two more than place, velocity and acceleration need.
MIN_ROWS, MIN_MOVING_ROWS = 3, 5
# Two positions are at one place within the 99 % quantile of chi-square with two degrees of freedom, in standard deviations of
# the errors that do not repeat.
PLACE_GATE = CHI2_2DOF_99 * 2 * (1 - REPEATED_SHARE)
# A track changes its object once in fifty tracks, and between two that it has shown already with one measurement in ten.
NEXT_OBJECT_LOG, CHANGE_LOG = float(np.log(0.02)), float(np.log(0.1))
# One object stays what it is unless several are e^3 = 20 times as likely.
MIN_LOG_ODDS = 3.0
# A track is split where that is best out of so many times.
MAX_SPLITS = 24


@dataclass(frozen=True, eq=False)
class Part:
    """Measurements of one object.

    Attributes
    ----------
    static : bool
        Whether it stands.
    at_place : Track, optional
        The measurements that agree on the place of an object that stands; those of the track without any that do not.
    """

    track: Track
    static: bool
    at_place: Track | None = None


def explain_track(track: Track) -> list[Part]:
    """Decide which objects a track shows, and which of them stand.

    Notes
    -----
    Compared are one object that moves as its kind does, several standing objects of which each measurement shows one, and two
    objects of which the second is seen after the first.
    """
    if is_static(track):
        return [Part(track, static=not starts_or_stops(track))]
    if len(track) <= MIN_ROWS:
        return [Part(track, static=False)]
    positions, rows = _positions(track)
    moving = marginal_likelihood(positions, _expected_motion(track))
    standing = _standing_parts(track, positions)
    if standing is not None and standing[1]:
        log, parts = standing
        # Parts none of which drifts stand unless a motion is likelier.
        at_places = [part.at_place or part.track for part in parts]
        margin = -MIN_LOG_ODDS if all(is_static(shown) for shown in at_places) else MIN_LOG_ODDS
        if log > moving.log + margin:
            return [Part(p.track, static=False) if starts_or_stops(p.track) else p for p in parts]
    if not moving.inlier.all():
        cut = _best_cut(positions, moving, _expected_motion(track))
        if cut is not None:
            first = rows[cut]
            parts = [p for part in (slice(first), slice(first, None)) for p in explain_track(_taken(track, part))]
            return [p for p in parts if p.static or len(p.track) >= MIN_MOVING_ROWS]
    return [Part(track, static=False)]


def main_place(track: Track) -> Track | None:
    """Return the measurements of a track at the place of most of them; None if there is no such place."""
    positions = _positions_of(track, np.arange(len(track)))
    places = _places(positions)
    rows = _labels(positions, places[:1], np.zeros(1, dtype=np.intp)) == 0 if len(places) else np.zeros(0, dtype=bool)
    return _taken(track, rows) if rows.sum() > len(track) / 2 else None


def _taken(track: Track, rows: slice | NDArray[np.bool_] | NDArray[np.intp]) -> Track:
    return replace(track, tick=track.tick[rows], measurements=track.measurements.take(rows))


def _expected_motion(track: Track) -> MotionPriorSigmas:
    group = GROUP_OF[track.category]
    return MotionPriorSigmas(FIRST_SPEED_MPS[group], ACCELERATION_MPS2[group])


def _positions(track: Track) -> tuple[Positions, NDArray[np.intp]]:
    """Return the positions of at most `MAX_ROWS` measurements, and the rows of these."""
    m = track.measurements
    rows = np.unique(np.linspace(0, len(m) - 1, min(len(m), MAX_ROWS)).round().astype(np.intp))
    return _positions_of(track, rows), rows


def _positions_of(track: Track, rows: NDArray[np.intp]) -> Positions:
    m = track.measurements
    t = (m.t_ns[rows] - m.t_ns[0]) / NS_PER_S
    variance: Array = np.trace(m.covariance[rows], axis1=1, axis2=2) / 2
    # Frames that share a sweep measure the same points at the same time.
    t = t + 1e-4 * np.arange(len(t))
    return Positions(t, m.center_m[rows, :2], variance + CENTER_SIGMA_M[GROUP_OF[track.category]] ** 2)


def _standing_parts(track: Track, few: Positions) -> tuple[float, list[Part]] | None:
    """Return the evidence of standing objects and the parts of these; None where there are none."""
    places = _places(few)
    if len(places) == 0:
        return None
    axis = track.measurements.yaw_rad[np.isfinite(track.measurements.yaw_rad)]
    objects = _objects_at(places, float(np.median(axis)) if len(axis) else 0.0, MIN_SIZE_M[track.category][:2])
    label, count = _labels(few, places, objects), int(objects.max()) + 1
    seen = label[label >= 0]
    log = OUTLIER_LOG * int((label < 0).sum()) + NEXT_OBJECT_LOG * (count - 1)
    log += CHANGE_LOG * int((np.diff(seen) != 0).sum())
    log += sum(marginal_likelihood(few.take(label == k), STANDING).log for k in range(count) if (label == k).any())
    return log, _parts_of(track, _labels(_positions_of(track, np.arange(len(track))), places, objects))


def _parts_of(track: Track, label: NDArray[np.intp]) -> list[Part]:
    """Make a part of each object, given which one each measurement (n,) shows, -1 for none.

    Objects are seen one after the other: what is shown in between by fewer measurements are other points of the same
    detections. Such measurements belong to the object that is seen next to them.
    """
    by_size = sorted(set(label[label >= 0].tolist()), key=lambda k: -int((label == k).sum()))
    kept: list[NDArray[np.intp]] = []
    for rows in (np.flatnonzero(label == k) for k in by_size):
        between = [np.mean((rows > other[0]) & (rows < other[-1])) for other in kept]
        if len(rows) >= MIN_ROWS and max(between, default=0.0) < 0.5:
            kept.append(rows)
    if not kept:
        return []
    row = np.arange(len(label))
    distance = np.array([np.abs(row[:, None] - rows).min(axis=1) for rows in kept])
    nearest = np.argmin(distance, axis=0)
    return [Part(_taken(track, nearest == k), True, _taken(track, rows)) for k, rows in enumerate(kept)]


def _places(p: Positions) -> Array:
    """Find the places (K, 2) at which most positions are, one after the other."""
    left, places = np.arange(len(p)), []
    while len(left) >= MIN_ROWS:
        q = p.take(left)
        squared = ((q.xy_m[:, None] - q.xy_m[None]) ** 2).sum(axis=2) / np.minimum(
            q.variance[:, None], q.variance[None]
        )
        near = squared[np.argmax((squared < PLACE_GATE).sum(axis=1))] < PLACE_GATE
        if near.sum() < MIN_ROWS:
            break
        places.append(np.median(q.xy_m[near], axis=0))
        left = left[~near]
    return np.array(places).reshape(-1, 2)


def _objects_at(places: Array, axis_rad: float, size_m: tuple[float, ...]) -> NDArray[np.intp]:
    """Return the index (K,) of the object at each place: places nearer than a length and a width are those of one."""
    c, s = np.cos(axis_rad), np.sin(axis_rad)
    index = np.arange(len(places))
    for k in range(1, len(places)):
        offsets = (places[:k] - places[k]) @ np.array([[c, -s], [s, c]])
        shared = np.flatnonzero(np.all(np.abs(offsets) < np.array(size_m), axis=1))
        if len(shared):
            index[k] = index[shared[0]]
    return np.unique(index, return_inverse=True)[1]


def _labels(p: Positions, places: Array, objects: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the index (n,) of the object at whose place each position is, -1 for none."""
    squared = ((p.xy_m[:, None] - places[None]) ** 2).sum(axis=2) / p.variance[:, None]
    nearest = np.argmin(squared, axis=1)
    return np.where(squared[np.arange(len(p)), nearest] < PLACE_GATE, objects[nearest], -1)


def _best_cut(p: Positions, whole: MarginalLikelihood, motion: MotionPriorSigmas) -> int | None:
    """Return the first row of the second of two objects, if two are likelier than one."""
    if len(p) < 2 * MIN_ROWS:
        return None
    cuts = np.unique(
        np.linspace(MIN_ROWS, len(p) - MIN_ROWS, min(len(p) - 2 * MIN_ROWS + 1, MAX_SPLITS)).astype(np.intp)
    )
    logs = [
        marginal_likelihood(p.take(slice(k)), motion).log + marginal_likelihood(p.take(slice(k, None)), motion).log
        for k in cuts
    ]
    best = int(np.argmax(logs))
    return int(cuts[best]) if logs[best] + NEXT_OBJECT_LOG > whole.log + MIN_LOG_ODDS else None
