"""Fixed-interval smoothing of planar positions: outliers and jerk densities estimated, standstill recognized.

All unknowns (place, velocity, accelerations, errors that repeat) are Gaussian and integrated out, so that hypotheses with more
of them are compared fairly (MacKay, Information Theory, Inference, and Learning Algorithms, 2003, chapter 28). Positions that
fit no such motion are outliers at a fixed cost.

A test in the position domain, of the kind that inertial navigation calls zero-velocity detector (Skog, Handel, Nilsson and
Rantakokko, IEEE Trans. Biomed. Eng. 57, 2010): drift and scatter of a span are compared with what its noise allows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, reduce

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.candidate import spans_of
from log2sim.agents.smooth.motion_model import MotionModel, Smoothed, course_is_known, unwrap, yaw_of_motion, yaw_sigma
from log2sim.agents.smooth.quadratic import (
    STRONG_PRIOR,
    WEAK_PRIOR,
    DensityEstimator,
    MeasurementModel,
    Minimum,
    MotionPrior,
    NoisyPositions,
    Quadratic,
    geman_mcclure_weights,
    inlier_probability,
    min_density,
    minimize,
    propagate,
    transition,
    weighted_sum,
    zero_motion,
)
from log2sim.files.arrays import Columns
from log2sim.geometry import CHI2_2DOF_99, Array, nearest_index, runs_of

# A place is known before to some car lengths: the gates of the tracker reach as far.
PLACE_SIGMA_M = 5.0
# Errors of a center repeat while the view stays the same, for some half a second of passing traffic; the rest of the variance
# changes from tick to tick.
VIEW_S, REPEATED_SHARE = 0.5, 0.9
# Stated standard deviations are wrong by a factor of two, for a whole track and along each axis apart: boxes of partly hidden
# objects by more, image boxes of a camera that stands by less.
NOISE_SCALES = 2.0 ** np.arange(-2, 3)
NOISE_SCALE_LOG = -0.5 * np.log2(NOISE_SCALES) ** 2 - np.logaddexp.reduce(-0.5 * np.log2(NOISE_SCALES) ** 2)
# One position in twenty shows something else, anywhere within a gate of 3 m.
OUTLIER_LOG = float(np.log(0.05 / (np.pi * 3.0**2)))
# Outliers are removed in so many rounds at most, each those that are worse than as many on either side: since errors repeat, an
# outlier makes its neighbors unlikely too.
MAX_ROUNDS, NEIGHBORS = 12, 3


@dataclass(frozen=True, eq=False)
class Positions(Columns):
    """Positions of a track."""

    t_s: Array  # (n,), s: in rising order
    xy_m: Array  # (n, 2), m: along any two axes
    variance: Array  # (n, 2), m2: of a position along each of them, changing views included


@dataclass(frozen=True)
class MotionPriorSigmas:
    """How far an object is expected to move."""

    speed_mps: float = 0.0  # standard deviation of each component of the velocity; 0 for one that stands
    acceleration_mps2: float = 0.0  # standard deviation of its change in 1 s


STANDING = MotionPriorSigmas()


def marginal_likelihood(positions: Positions, motion: MotionPriorSigmas) -> tuple[float, NDArray[np.bool_]]:
    """Compute the logarithm of the marginal likelihood of one object that moves as expected, or stands, and which positions (n,) are inliers.

    The velocity is a Wiener process about the middle of the track. The scale of the noise is unknown along each axis, and is
    integrated out over `NOISE_SCALES`: with stated noise alone, a walk is an error that drifts where the statement is too large,
    and errors are a motion where it is too small. O(n^3).
    """
    inlier = np.ones(len(positions), dtype=bool)
    best = -np.inf, inlier
    for _ in range(MAX_ROUNDS):
        log, each = _likelihoods(positions.take(inlier), motion)
        log += OUTLIER_LOG * int((~inlier).sum())
        if log > best[0]:
            best = log, inlier
        padded = np.full(len(each) + 2 * NEIGHBORS, np.inf)
        padded[NEIGHBORS : NEIGHBORS + len(each)] = each
        lowest = reduce(np.minimum, [padded[k : k + len(each)] for k in range(2 * NEIGHBORS + 1)])
        worst = np.flatnonzero((each < OUTLIER_LOG) & (each == lowest))
        if len(worst) == 0 or inlier.sum() <= 2:
            break
        inlier = inlier.copy()
        inlier[np.flatnonzero(inlier)[worst]] = False
    return best


def _likelihoods(p: Positions, motion: MotionPriorSigmas) -> tuple[float, Array]:
    """Return the log-likelihood of all positions, and that of each given all others (n,)."""
    s = p.t_s - (p.t_s[0] + p.t_s[-1]) / 2
    away = np.abs(s)
    middle = np.median(p.xy_m, axis=0) if motion.speed_mps == 0 else p.xy_m[np.argmin(away)]
    z = (p.xy_m - middle).T
    k = PLACE_SIGMA_M**2 + motion.speed_mps**2 * np.outer(s, s)
    if motion.acceleration_mps2:
        near = np.minimum(away[:, None], away) * (np.sign(s)[:, None] == np.sign(s))
        far = np.maximum(away[:, None], away)
        k += motion.acceleration_mps2**2 * near**2 * (far / 2 - near / 6)
    # Axes, scales, n, n.
    covariance = k + NOISE_SCALES[:, None, None] ** 2 * noise_of(p)[:, None]
    weighted = np.linalg.solve(covariance, z[:, None, :, None])[..., 0]
    determinant = 2 * np.log(np.diagonal(np.linalg.cholesky(covariance), axis1=2, axis2=3)).sum(axis=2)
    squared = (weighted * z[:, None]).sum(axis=2)
    logs = NOISE_SCALE_LOG - 0.5 * (squared + determinant + len(p) * np.log(2 * np.pi))
    best = np.arange(2), logs.argmax(axis=1)
    variance = 1.0 / np.diagonal(np.linalg.inv(covariance[best]), axis1=1, axis2=2)
    each = -0.5 * (np.log(2 * np.pi * variance) + variance * weighted[best] ** 2).sum(axis=0)
    return float(np.logaddexp.reduce(logs, axis=1).sum()), each


def noise_of(p: Positions) -> Array:
    """Return the covariances (2, n, n), m2, of the errors along both axes: a part repeats while the view stays the same, one does not."""
    sigma = np.sqrt(p.variance.T)
    repeated = REPEATED_SHARE * np.exp(-np.abs(p.t_s[:, None] - p.t_s) / VIEW_S)
    return np.asarray(sigma[:, :, None] * sigma[:, None] * (repeated + (1 - REPEATED_SHARE) * np.eye(len(p))))


# A longer way backward is one.
MAX_ROLL_M = 2.0
# Standard deviation of the velocity of what is held, and rounds in which its neighbors may have to be held too.
HELD_SIGMA_MPS, MAX_HOLDING_ROUNDS = 0.02, 4


# Candidates are spans in which the smoothed speed stays below this, plus as many of its standard deviations.
CANDIDATE_MPS, CANDIDATE_SIGMAS = 0.4, 2.0
MIN_SPAN_S, MIN_OBSERVATIONS = 0.8, 4
# A drift is motion when it is this significant and faster than the outline of a standing object seems to move.
DRIFT_SIGMAS, MIN_DRIFT_MPS = 3.0, 0.05
SCATTER_SIGMAS = 3.0
MIN_WEIGHT = 0.25
# Standard deviation of the velocity at a standstill, and near the edges of a span, where it decays within the time that follows.
STANDSTILL_SIGMA_MPS = 0.005
EDGE_MPS, EDGE_S = 1.0, 0.4
# The first and the last quarter of a span are off its middle when it is this significant and this far.
END_SIGMAS, MIN_END_STEP_M = 2.5, 0.03


def zero_velocity_sigma(
    knots_s: Array, measurement: MeasurementModel, weight: Array, state: Array, covariance: Array
) -> Array:
    """Detect standstill: standard deviation (K,) of the velocity in m/s around zero, infinite where the object moves.

    `knots_s`: (K,), s. `weight`: (n,): weights of the observations. `state`: (K, 3, 2): smoothed state without this constraint.
    `covariance`: (K, 6, 6).
    """
    speed = np.hypot(*state[:, 1].T)
    sigma = np.sqrt(np.trace(covariance[:, 2:4, 2:4], axis1=1, axis2=2) / 2)
    slow = speed < CANDIDATE_MPS + CANDIDATE_SIGMAS * sigma
    out = np.full(len(knots_s), np.inf)
    for first, end in runs_of(slow):
        inside = np.flatnonzero((measurement.knot >= first) & (measurement.knot < end) & (weight > MIN_WEIGHT))
        span = _trim_to_standstill(measurement, inside, speed[measurement.knot])
        if len(span):
            # A candidate that reaches the track's end stands until then.
            begin = first if first == 0 and span[0] == inside[0] else measurement.knot[span[0]]
            last = end - 1 if end == len(knots_s) and span[-1] == inside[-1] else measurement.knot[span[-1]]
            since = np.inf if begin == 0 else knots_s[begin : last + 1] - knots_s[begin]
            until = np.inf if last == len(knots_s) - 1 else knots_s[last] - knots_s[begin : last + 1]
            out[begin : last + 1] = STANDSTILL_SIGMA_MPS + EDGE_MPS * np.exp(-np.minimum(since, until) / EDGE_S)
    return out


def _trim_to_standstill(measurement: MeasurementModel, rows: NDArray[np.intp], speed: Array) -> NDArray[np.intp]:
    """Cut off the end that differs more until the remaining rows (m,) stand; none are left where they never do."""
    t, xy = measurement.observed.t_s, measurement.observed.xy
    information = 2.0 / np.trace(measurement.observed.r, axis1=1, axis2=2)
    begin, end = (rows[0], rows[-1]) if len(rows) else (0, 0)
    while len(rows) >= MIN_OBSERVATIONS and t[rows[-1]] - t[rows[0]] >= MIN_SPAN_S:
        first, last = _end_discrepancies(t[rows], xy[rows], information[rows])
        if max(first, last) < 1.0:
            # Where one end was cut off, the observations next to it are in doubt; one is enough where it covers the edge.
            step_s = (t[rows[-1]] - t[rows[0]]) / (len(rows) - 1)
            margin = max(len(rows) // 10, 1 if step_s > EDGE_S else 2)
            return rows[margin * (rows[0] > begin) : len(rows) - margin * (rows[-1] < end)]
        cut = max(len(rows) // 10, 1)
        if first == last:
            first, last = speed[rows[0]], speed[rows[-1]]
        rows = rows[cut:] if first > last else rows[:-cut]
    return rows[:0]


def _end_discrepancies(t: Array, xy: Array, information: Array) -> tuple[float, float]:
    """Distance of the first and the last quarter of positions from the middle half, relative to what noise allows.

    Both are the same where the positions drift or scatter too far as a whole.
    """
    weight = information / information.sum()
    time = t - weight @ t
    from_mean = xy - weight @ xy
    known = float(information @ time**2)
    drift = (information * time) @ from_mean / known
    scatter = float(information @ ((from_mean - time[:, None] * drift) ** 2).sum(axis=1))
    freedom = 2 * len(t) - 4
    # Where the positions scatter less than their covariances say, smaller steps are significant.
    noise_scale = min(1.0, np.sqrt(scatter / freedom))
    whole = max(
        scatter / (freedom + SCATTER_SIGMAS * np.sqrt(2 * freedom)),
        float(np.hypot(*drift)) / max(DRIFT_SIGMAS * noise_scale / np.sqrt(known), MIN_DRIFT_MPS),
    )
    if whole >= 1.0:
        return whole, whole
    quarter = max(len(t) // 4, 1 if len(t) < 6 else 2)
    parts = slice(quarter), slice(quarter, -quarter), slice(-quarter, None)
    sums = [float(information[part].sum()) for part in parts]
    means = [information[part] @ xy[part] / s for part, s in zip(parts, sums)]
    first, last = (
        float(np.hypot(*(means[k] - means[1])))
        / max(END_SIGMAS * noise_scale * np.sqrt(1 / sums[1] + 1 / sums[k]), MIN_END_STEP_M)
        for k in (0, 2)
    )
    return first, last


# Jerk density in m2/s5 that follows every maneuver while outliers are searched.
PERMISSIVE_JERK_DENSITY = 4.0
MAX_ROBUST_ROUNDS, MAX_REWEIGHTING_ROUNDS = 4, 4
# Reweighting ends when no weight changes by more.
MAX_WEIGHT_CHANGE = 0.05
# Minimum distance of knots while densities are estimated: in between the acceleration is taken as constant, which
# at the jerk of an emergency brake costs a millimeter.
SEARCH_STEP_S = 0.39
MIN_KNOTS = 4
# With every residual of the first least-squares solution below this there is no outlier.
MAX_CLEAN_SIGMAS = 3.5
# Ratio of the standard deviations of acceleration and velocity at a standstill.
STANDSTILL_HZ = 10.0
# Lateral velocity of a slow vehicle, standard deviation: constant and as a share of its speed, since the heading that it
# holds is known to some degrees only.
SLIP_MPS, SLIP_SHARE = 0.03, 0.15
# Standard deviation of the acceleration in traffic, along or across, and the time for which it lasts.
USUAL_ACCELERATION_MPS2, ACCELERATION_S = 2.0, 1.0


@dataclass(frozen=True, eq=False)
class _Problem:
    """All terms as quadratic forms about `state` (K, 3, 2)."""

    prior: MotionPrior
    measurement: MeasurementModel
    state: Array  # (K, 3, 2): reference of the forms
    weight: Array  # (n,)
    information: Array  # (n, 2, 2): inverse covariances of the observations
    jerk: tuple[Quadratic, Quadratic]  # squared jerk along and across the path
    density: tuple[float, float]  # jerk densities in m2/s5 along and across the path

    def solve(self, constraints: Quadratic | None = None) -> tuple[Minimum, Array]:
        """Return the minimum and the state (K, 3, 2) there."""
        terms = [(1.0, self.likelihood), *((1.0 / d, j) for d, j in zip(self.density, self.jerk))]
        if self.measurement.observed.correlated and len(self.prior) > 1:
            # One acceleration in `ACCELERATION_S`: errors that repeat do not pass for braking at the ends of a track.
            share = np.gradient(self.prior.knots_s) / ACCELERATION_S
            information = (share / USUAL_ACCELERATION_MPS2**2)[:, None, None] * np.eye(2)
            terms.append((1.0, zero_motion(self.state, np.zeros_like(information), information)))
        least = minimize(weighted_sum(terms if constraints is None else [*terms, (1.0, constraints)]))
        return least, self.state + least.step.reshape(self.state.shape)

    def misfit(self, state: Array) -> float:
        """Weighted squared residuals of a state (K, 3, 2), in sigmas."""
        residual = self.measurement.residual(state)
        return float(self.weight @ np.einsum("na,nab,nb->n", residual, self.information, residual))

    @cached_property
    def likelihood(self) -> Quadratic:
        """Weighted squared residuals."""
        return self.measurement.coupled_axes(self.state, self.information * self.weight[:, None, None])


def smooth_interval(observed: NoisyPositions, asked_s: Array, motion: MotionModel) -> Smoothed:
    """Estimate the most probable trajectory given the positions, under white jerk along and across the path.

    `asked_s`: (T,), s: times of the result.

    For given densities the estimate equals that of a Kalman filter with the smoother of Rauch, Tung and Striebel (AIAA
    Journal 3, 1965) for the constant-acceleration model, found in one banded solve. Jerk densities
    maximize the marginal likelihood; outliers are reweighted iteratively; standstill and the nonholonomic
    constraint of slow vehicles are pseudo-measurements. Cost O(n).
    """
    prior = MotionPrior.over(np.concatenate([observed.t_s, asked_s]))
    problem = _problem(prior, MeasurementModel.of(observed, prior), motion)
    least, state = problem.solve()
    for _ in range(MAX_REWEIGHTING_ROUNDS):
        residual = problem.measurement.residual(state)
        weight = _weights(observed, np.einsum("na,nab,nb->n", residual, problem.information, residual))
        if np.abs(weight - problem.weight).max() < MAX_WEIGHT_CHANGE:
            break
        problem = replace(problem, weight=weight)
        least, state = problem.solve()
    constraints = _constraints(problem, state, least.covariance, motion)
    if constraints is not None:
        least, state = problem.solve(constraints)
    if not motion.holonomic:
        least, state = _without_rolling_back(problem, least, state, constraints, motion)
    residual_m = np.hypot(*problem.measurement.residual(state).T)
    # At the asked times, each propagated from the nearest knot.
    knot, covariance = nearest_index(prior.knots_s, asked_s), least.covariance
    if np.array_equal(prior.knots_s[knot], asked_s):
        state, covariance = state[knot], covariance[knot]
    else:
        both = np.einsum("tij,ab->tiajb", transition(asked_s - prior.knots_s[knot]), np.eye(2)).reshape(-1, 6, 6)
        state, covariance = propagate(prior, state, asked_s), both @ covariance[knot] @ np.swapaxes(both, 1, 2)
    known = _known_courses(state, covariance, motion, correlated=observed.correlated)
    yaw = yaw_of_motion(state[:, 0], state[:, 1], hint_rad=motion.heading_rad, holonomic=motion.holonomic, known=known)
    sigma = yaw_sigma(state[:, 0], state[:, 1], covariance[:, 2:4, 2:4], known, hint_sigma_rad=motion.heading_sigma_rad)
    return Smoothed(state, covariance, yaw, sigma, residual_m, problem.weight, problem.density)


def _without_rolling_back(
    problem: _Problem, least: Minimum, state: Array, constraints: Quadratic | None, motion: MotionModel
) -> tuple[Minimum, Array]:
    """Hold the vehicle where it seems to move a short way backward and standing explains the positions within the 99 % quantile."""
    observed = problem.measurement.observed
    # Errors that repeat for `VIEW_S` count once.
    repeated = observed.correlated and len(observed.t_s) >= 2
    max_misfit = CHI2_2DOF_99 * (max(1.0, VIEW_S / float(np.median(np.diff(observed.t_s)))) if repeated else 1.0)
    for _ in range(MAX_HOLDING_ROUNDS):
        before = least
        known = _known_courses(state, least.covariance, motion, correlated=observed.correlated)
        if motion.heading_rad is None and not known.any():
            break
        yaw = yaw_of_motion(state[:, 0], state[:, 1], hint_rad=motion.heading_rad, known=known)
        forward = state[:, 1, 0] * np.cos(yaw) + state[:, 1, 1] * np.sin(yaw)
        for run in spans_of(forward < -2 * HELD_SIGMA_MPS):
            if np.hypot(*np.diff(state[run, 0], axis=0).T).sum() >= MAX_ROLL_M:
                continue
            information = np.zeros((len(state), 2, 2))
            information[run] = np.eye(2) / HELD_SIGMA_MPS**2
            hold = zero_motion(problem.state, information, np.zeros_like(information))
            both = hold if constraints is None else weighted_sum([(1.0, constraints), (1.0, hold)])
            stands, its_state = problem.solve(both)
            if problem.misfit(its_state) - problem.misfit(state) < max_misfit:
                constraints, least, state = both, stands, its_state
        if least is before:
            break
    return least, state


def _weights(observed: NoisyPositions, squared: Array) -> Array:
    """Weights (n,) of observations from their squared residuals in sigmas."""
    return geman_mcclure_weights(squared) if observed.correlated else inlier_probability(squared)


def _problem(prior: MotionPrior, measurement: MeasurementModel, motion: MotionModel) -> _Problem:
    """Find outliers and densities with fewer knots, then pose the problem on all of them."""
    observed = measurement.observed
    few = MotionPrior.over(observed.t_s, SEARCH_STEP_S)
    coarse = MeasurementModel.of(observed, few)
    fit, weight, isotropic = _robust_fit(few, coarse, motion)
    information = np.asarray(np.linalg.inv(observed.r), dtype=np.float64)
    yaw = unwrap(yaw_of_motion(fit[:, 0], fit[:, 1], hint_rad=motion.heading_rad))
    density = (isotropic, isotropic)
    if motion.density_by_direction and len(few) >= MIN_KNOTS:
        forms = few.jerk_by_direction(fit, _directions(yaw))
        search = _Problem(few, coarse, fit, weight, information, forms, density)
        density = _estimator(observed, motion).by_direction(few, search.jerk, search.likelihood, isotropic)
    course: Array = np.interp(prior.knots_s, few.knots_s, yaw)
    state = propagate(few, fit, prior.knots_s)
    lowest = min_density(prior)
    densities = max(density[0], lowest), max(density[1], lowest)
    forms = prior.jerk_by_direction(state, _directions(course))
    return _Problem(prior, measurement, state, weight, information, forms, densities)


def _directions(yaw: Array) -> Array:
    """Directions (K-1, 2), unit vectors, along the path between knots with unwrapped headings (K,)."""
    course = (yaw[1:] + yaw[:-1]) / 2
    return np.stack([np.cos(course), np.sin(course)], axis=-1)


def _estimator(observed: NoisyPositions, motion: MotionModel) -> DensityEstimator:
    prior = STRONG_PRIOR if observed.correlated else WEAK_PRIOR
    return DensityEstimator(prior, rounds=1 if motion.density_by_direction else 2)


def _robust_fit(prior: MotionPrior, measurement: MeasurementModel, motion: MotionModel) -> tuple[Array, Array, float]:
    """Find outliers and one density with both axes treated alike, which makes the search cheap.

    Returns the state (K, 3, 2), weights (n,) and jerk density in m2/s5.
    """
    observed = measurement.observed
    variance = np.trace(observed.r, axis1=1, axis2=2) / 2
    density = PERMISSIVE_JERK_DENSITY if motion.jerk_density is None else motion.jerk_density
    density = max(density, min_density(prior))
    start = np.zeros((len(prior), 3, 2))
    jerk, weight = prior.jerk(start), np.ones(len(variance))
    for _ in range(MAX_ROBUST_ROUNDS + 1):
        likelihood = measurement.independent_axes(start, weight / variance)
        state = minimize(weighted_sum([(1.0, likelihood), (1.0 / density, jerk)])).step
        squared = (measurement.residual(state) ** 2).sum(axis=1) / variance
        if squared.max() < MAX_CLEAN_SIGMAS**2:
            break
        weight = geman_mcclure_weights(squared)
    weight = _weights(observed, squared)
    if motion.jerk_density is not None:
        return state, weight, density
    likelihood = measurement.independent_axes(state, weight / variance)
    density = _estimator(observed, motion).isotropic(prior, state, likelihood)
    state = state + minimize(weighted_sum([(1.0, likelihood), (1.0 / density, prior.jerk(state))])).step
    squared = (measurement.residual(state) ** 2).sum(axis=1) / variance
    return state, _weights(observed, squared), density


def _constraints(problem: _Problem, state: Array, covariance: Array, motion: MotionModel) -> Quadratic | None:
    """Pseudo-measurements of zero velocity where it stands and of little side slip where it rolls slowly.

    None where it does neither.
    """
    velocity = state[:, 1]
    sigma = zero_velocity_sigma(problem.prior.knots_s, problem.measurement, problem.weight, state, covariance)
    still = np.isfinite(sigma)
    known = ~still & _known_courses(state, covariance, motion, correlated=problem.measurement.observed.correlated)
    slow = ~known & ~still
    if motion.holonomic or not (known.any() or motion.heading_rad is not None):
        slow[:] = False
    if not (still.any() or slow.any()):
        return None
    yaw = yaw_of_motion(state[:, 0], velocity, hint_rad=motion.heading_rad, holonomic=motion.holonomic, known=known)
    across = np.stack([-np.sin(yaw), np.cos(yaw)], axis=-1)
    slip = SLIP_MPS + SLIP_SHARE * np.hypot(*velocity.T)
    about_velocity = (slow / slip**2)[:, None, None] * across[:, :, None] * across[:, None, :]
    about_velocity = about_velocity + (sigma**-2)[:, None, None] * np.eye(2)
    about_acceleration = ((sigma * STANDSTILL_HZ) ** -2)[:, None, None] * np.eye(2)
    return zero_motion(problem.state, about_velocity, about_acceleration)


def _known_courses(state: Array, covariance: Array, motion: MotionModel, *, correlated: bool) -> NDArray[np.bool_]:
    """Where (K,) the velocity of a state (K, 3, 2) with covariances (K, 6, 6) gives the heading."""
    return course_is_known(
        state[:, 0],
        state[:, 1],
        covariance[:, 2:4, 2:4],
        holonomic=motion.holonomic,
        correlated=correlated,
        max_curvature_1pm=motion.max_curvature_1pm,
    )
