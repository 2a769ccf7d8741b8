"""Fixed-interval smoothing of planar positions: outliers, noise and jerk densities estimated, then one banded solve."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.smooth.heading import course_is_known, unwrap, yaw_of_motion, yaw_sigma
from log2sim.agents.smooth.jerk_density import STRONG_PRIOR, WEAK_PRIOR, DensityEstimator, min_density
from log2sim.agents.smooth.likelihood import (
    MeasurementModel,
    geman_mcclure_weights,
    inlier_probability,
    propagate,
    transition,
    zero_motion,
)
from log2sim.agents.smooth.motion_model import MotionModel, Smoothed
from log2sim.agents.smooth.motion_prior import MotionPrior, NoisyPositions, nearest_index
from log2sim.agents.smooth.quadratic import Minimum, Quadratic, minimize, weighted_sum
from log2sim.agents.smooth.rolling_back import MAX_HOLDING_ROUNDS, backward_runs, held_at, max_misfit
from log2sim.agents.smooth.zero_velocity import zero_velocity_sigma
from log2sim.geometry import Array

__all__ = ["smooth_interval"]

# Jerk density in m2/s5 that follows every maneuver while outliers are searched.
PERMISSIVE_JERK_DENSITY = 4.0
MAX_ROBUST_ROUNDS, MAX_REWEIGHTING_ROUNDS = 4, 4
# Reweighting ends when no weight changes by more.
MAX_WEIGHT_CHANGE = 0.05
# Minimum distance of knots while noise and densities are estimated: in between the acceleration is taken as constant, which
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
class _RobustFit:
    """State (K, 3, 2), weights (n,), jerk density in m2/s5 and factor on the noise's variance, both axes alike."""

    state: Array
    weight: Array
    density: float
    variance_factor: float


@dataclass(frozen=True, eq=False)
class _Problem:
    """All terms as quadratic forms about `state` (K, 3, 2).

    Attributes
    ----------
    prior : MotionPrior
    measurement : MeasurementModel
    state : (K, 3, 2) float64
        Reference of the forms.
    weight : (n,) float64
    information : (n, 2, 2) float64
        Inverse covariances of the observations.
    jerk : (Quadratic, Quadratic)
        Squared jerk along and across the path.
    density : (float, float)
        Jerk densities in m2/s5 along and across the path.
    """

    prior: MotionPrior
    measurement: MeasurementModel
    state: Array
    weight: Array
    information: Array
    jerk: tuple[Quadratic, Quadratic]
    density: tuple[float, float]

    def solve(self, constraints: Quadratic | None = None) -> tuple[Minimum, Array]:
        """Return the minimum and the state (K, 3, 2) there."""
        terms = [(1.0, self.likelihood), *((1.0 / d, j) for d, j in zip(self.density, self.jerk))]
        if self.measurement.observed.correlated and len(self.prior) > 1:
            terms.append((1.0, self.usual_acceleration))
        least = minimize(weighted_sum(terms if constraints is None else [*terms, (1.0, constraints)]))
        return least, self.state + least.step.reshape(self.state.shape)

    def misfit(self, state: Array) -> float:
        """Weighted squared residuals of a state (K, 3, 2), in sigmas."""
        residual = self.measurement.residual(state)
        return float(self.weight @ np.einsum("na,nab,nb->n", residual, self.information, residual))

    @cached_property
    def usual_acceleration(self) -> Quadratic:
        """Squared accelerations, one in `ACCELERATION_S`: errors that repeat do not pass for braking at the ends of a track."""
        share = np.gradient(self.prior.knots_s) / ACCELERATION_S
        information = (share / USUAL_ACCELERATION_MPS2**2)[:, None, None] * np.eye(2)
        return zero_motion(self.state, np.zeros_like(information), information)

    @cached_property
    def likelihood(self) -> Quadratic:
        """Weighted squared residuals."""
        return self.measurement.coupled_axes(self.state, self.information * self.weight[:, None, None])


def smooth_interval(observed: NoisyPositions, asked_s: Array, motion: MotionModel) -> Smoothed:
    """Estimate the most probable trajectory given the positions, under white jerk along and across the path.

    Parameters
    ----------
    observed : NoisyPositions
    asked_s : (T,) float64, s
        Times of the result.
    motion : MotionModel

    Notes
    -----
    For given densities the estimate equals that of a Kalman filter with the smoother of Rauch, Tung and Striebel (AIAA
    Journal 3, 1965) for the constant-acceleration model, found in one banded solve. Jerk densities and the scale of the
    noise maximize the marginal likelihood; outliers are reweighted iteratively; standstill and the nonholonomic
    constraint of slow vehicles are pseudo-measurements. Cost O(n).
    """
    prior = MotionPrior.over(np.concatenate([observed.t_s, asked_s]))
    problem, least, state = _reweight(_problem(prior, MeasurementModel.of(observed, prior), motion))
    covariance = least.covariance
    constraints = _constraints(problem, state, covariance, motion)
    if constraints is not None:
        least, state = problem.solve(constraints)
        covariance = least.covariance
    if not motion.holonomic:
        least, state = _without_rolling_back(problem, least, state, constraints, motion)
        covariance = least.covariance
    residual = np.hypot(*problem.measurement.residual(state).T)
    state, covariance = _at_times(prior, asked_s, state, covariance)
    known = _known_courses(state, covariance, motion, correlated=observed.correlated)
    yaw = yaw_of_motion(state[:, 0], state[:, 1], hint_rad=motion.heading_rad, holonomic=motion.holonomic, known=known)
    sigma = yaw_sigma(state[:, 0], state[:, 1], covariance[:, 2:4, 2:4], known, hint_sigma_rad=motion.heading_sigma_rad)
    return Smoothed(state, covariance, yaw, sigma, residual, problem.weight, problem.density)


def _without_rolling_back(
    problem: _Problem, least: Minimum, state: Array, constraints: Quadratic | None, motion: MotionModel
) -> tuple[Minimum, Array]:
    """Hold the vehicle where it seems to move backward and standing explains the positions as well."""
    observed = problem.measurement.observed
    for _ in range(MAX_HOLDING_ROUNDS):
        before = least
        covariance = least.covariance
        known = _known_courses(state, covariance, motion, correlated=observed.correlated)
        for run in backward_runs(state, known, motion.heading_rad):
            hold = held_at(problem.state, run)
            both = hold if constraints is None else weighted_sum([(1.0, constraints), (1.0, hold)])
            stands, its_state = problem.solve(both)
            if problem.misfit(its_state) - problem.misfit(state) < max_misfit(observed):
                constraints, least, state = both, stands, its_state
        if least is before:
            break
    return least, state


def _weights(observed: NoisyPositions, squared: Array) -> Array:
    """Weights (n,) of observations from their squared residuals in sigmas."""
    return geman_mcclure_weights(squared) if observed.correlated else inlier_probability(squared)


def _problem(prior: MotionPrior, measurement: MeasurementModel, motion: MotionModel) -> _Problem:
    """Find outliers, noise and densities with fewer knots, then pose the problem on all of them."""
    observed = measurement.observed
    few = MotionPrior.over(observed.t_s, SEARCH_STEP_S)
    coarse = MeasurementModel.of(observed, few)
    fit = _robust_fit(few, coarse, motion)
    information = np.asarray(np.linalg.inv(observed.r * fit.variance_factor), dtype=np.float64)
    yaw = unwrap(yaw_of_motion(fit.state[:, 0], fit.state[:, 1], hint_rad=motion.heading_rad))
    density = (fit.density, fit.density)
    if motion.density_by_direction and len(few) >= MIN_KNOTS:
        forms = few.jerk_by_direction(fit.state, _directions(yaw))
        search = _Problem(few, coarse, fit.state, fit.weight, information, forms, density)
        density = _estimator(observed, motion).by_direction(few, search.jerk, search.likelihood, fit.density)
    course: Array = np.interp(prior.knots_s, few.knots_s, yaw)
    state = propagate(few, fit.state, prior.knots_s)
    lowest = min_density(prior)
    densities = max(density[0], lowest), max(density[1], lowest)
    forms = prior.jerk_by_direction(state, _directions(course))
    return _Problem(prior, measurement, state, fit.weight, information, forms, densities)


def _directions(yaw: Array) -> Array:
    """Directions (K-1, 2), unit vectors, along the path between knots with unwrapped headings (K,)."""
    course = (yaw[1:] + yaw[:-1]) / 2
    return np.stack([np.cos(course), np.sin(course)], axis=-1)


def _estimator(observed: NoisyPositions, motion: MotionModel) -> DensityEstimator:
    prior = STRONG_PRIOR if observed.correlated else WEAK_PRIOR
    return DensityEstimator(prior, observed.unknown_scale, rounds=1 if motion.density_by_direction else 2)


def _robust_fit(prior: MotionPrior, measurement: MeasurementModel, motion: MotionModel) -> _RobustFit:
    """Find outliers, noise and one density with both axes treated alike, which makes the search cheap."""
    observed = measurement.observed
    variance = np.trace(observed.r, axis1=1, axis2=2) / 2
    density = PERMISSIVE_JERK_DENSITY if motion.jerk_density is None else motion.jerk_density
    density = max(density, min_density(prior))
    state, weight = _without_outliers(prior, measurement, variance, density)
    if motion.jerk_density is not None and not observed.unknown_scale:
        return _RobustFit(state, weight, density, 1.0)
    likelihood = measurement.independent_axes(state, weight / variance)
    density, factor = _estimator(observed, motion).isotropic(prior, state, likelihood, float(weight.sum()))
    density = density if motion.jerk_density is None else motion.jerk_density
    state = state + minimize(weighted_sum([(1.0, likelihood), (factor / density, prior.jerk(state))])).step
    squared = (measurement.residual(state) ** 2).sum(axis=1) / (variance * factor)
    return _RobustFit(state, _weights(observed, squared), density, factor)


def _without_outliers(
    prior: MotionPrior, measurement: MeasurementModel, variance: Array, density: float
) -> tuple[Array, Array]:
    """State (K, 3, 2) and weights (n,) by iteratively reweighted least squares, both axes alike, with a given density."""
    start = np.zeros((len(prior), 3, 2))
    jerk = prior.jerk(start)
    weight = np.ones(len(variance))
    for k in range(MAX_ROBUST_ROUNDS + 1):
        likelihood = measurement.independent_axes(start, weight / variance)
        state = minimize(weighted_sum([(1.0, likelihood), (1.0 / density, jerk)])).step
        squared = (measurement.residual(state) ** 2).sum(axis=1) / variance
        if squared.max() < MAX_CLEAN_SIGMAS**2:
            break
        last = k == MAX_ROBUST_ROUNDS
        weight = _weights(measurement.observed, squared) if last else geman_mcclure_weights(squared)
    return state, _weights(measurement.observed, squared)


def _reweight(problem: _Problem) -> tuple[_Problem, Minimum, Array]:
    """Reweight the observations until the weights settle: the problem, its minimum and the state (K, 3, 2) there."""
    for _ in range(MAX_REWEIGHTING_ROUNDS):
        least, state = problem.solve()
        residual = problem.measurement.residual(state)
        squared = np.einsum("na,nab,nb->n", residual, problem.information, residual)
        weight = _weights(problem.measurement.observed, squared)
        if np.abs(weight - problem.weight).max() < MAX_WEIGHT_CHANGE:
            return problem, least, state
        problem = replace(problem, weight=weight)
    return problem, *problem.solve()


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


def _at_times(prior: MotionPrior, asked_s: Array, state: Array, covariance: Array) -> tuple[Array, Array]:
    """States (T, 3, 2) and covariances (T, 6, 6) at asked times, each propagated from the nearest knot."""
    knot = nearest_index(prior.knots_s, asked_s)
    if np.array_equal(prior.knots_s[knot], asked_s):
        return state[knot], covariance[knot]
    both = np.einsum("tij,ab->tiajb", transition(asked_s - prior.knots_s[knot]), np.eye(2)).reshape(-1, 6, 6)
    return propagate(prior, state, asked_s), both @ covariance[knot] @ np.swapaxes(both, 1, 2)
