"""Fixed-interval smoothing of planar positions: outliers, noise and maneuvers estimated, then one banded solve."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from log2sim.agents.smooth.heading import course_is_known, unwrapped, yaw_of_motion
from log2sim.agents.smooth.jerk_density import FIRM, OPEN, Belief, floor, separate_densities, shared_density
from log2sim.agents.smooth.likelihood import Readings, carry, carrying, decided, hold, tolerant
from log2sim.agents.smooth.motion_prior import Chain, Observations, nearest_index
from log2sim.agents.smooth.quadratic import Minimum, Quadratic, minimize, total
from log2sim.agents.smooth.zero_velocity import standing_tolerance
from log2sim.geometry import Array

__all__ = ["Manner", "Observations", "Smoothed", "smooth_interval"]

# Jerk density in m2/s5 that lets every maneuver through while outliers are looked for.
PERMISSIVE_JERK_DENSITY = 4.0
TOLERANT_ROUNDS, DECIDING_ROUNDS = 4, 4
SETTLED = 0.05
# Noise and maneuvers are looked for on knots this far apart: in between the acceleration is taken as constant, which at the
# jerk of an emergency brake costs a millimeter.
SEARCH_STEP_S = 0.39
LEAST_KNOTS = 4
# No outlier hides where every residual is within this of the first, least-squares solution.
CLEAN_SIGMAS = 3.5
# What stands neither moves nor gathers speed beyond these; what rolls slips sideways by less than this share of its speed,
# since the heading that it holds is known to some degrees only.
STANDING_HZ = 10.0
SLIP_MPS, SLIP_SHARE = 0.03, 0.15


@dataclass(frozen=True)
class Manner:
    """How an object moves: `jerk_density` in m2/s5 or None to estimate it, `sideways` True where it may go any way,
    `heading_rad` where its motion does not tell, `scaled` True where the noise is known up to a factor only, `wary` True
    where observations err by some sigmas more often than Gaussian ones, and by the same amount again and again.
    """

    jerk_density: float | None = None
    sideways: bool = False
    heading_rad: float | None = None
    scaled: bool = False
    wary: bool = False

    @property
    def steers(self) -> bool:
        """Whether how it maneuvers along and across its way is to be estimated separately."""
        return self.jerk_density is None and not self.sideways

    @property
    def belief(self) -> Belief:
        """What is believed about its jerk."""
        return FIRM if self.wary else OPEN

    def weights(self, squared: Array) -> Array:
        """How much observations (n,) count, from their squared distances in sigmas."""
        return tolerant(squared) if self.wary else decided(squared)


@dataclass(frozen=True, eq=False)
class _Rough:
    state: Array
    weight: Array
    density: float
    variance_factor: float


@dataclass(frozen=True, eq=False)
class Smoothed:
    """`state` (T, 3, 2): position, velocity, acceleration at the asked times, `covariance` (T, 6, 6) of it, `yaw_rad` (T,);
    `distance` (n,) in m and `weight` (n,) in [0, 1] of the observations; `density` in m2/s5 along and across the way.
    """

    state: Array
    covariance: Array
    yaw_rad: Array
    distance: Array
    weight: Array
    density: tuple[float, float]


@dataclass(frozen=True, eq=False)
class _Problem:
    """Everything as quadratic forms about `state` (K, 3, 2), the first rough solution."""

    chain: Chain
    readings: Readings
    state: Array
    weight: Array
    information: Array
    jerk: tuple[Quadratic, Quadratic]
    density: tuple[float, float]

    def solve(self, held: Quadratic | None = None) -> tuple[Minimum, Array]:
        """The minimum and the state (K, 3, 2) there."""
        terms = [(1.0, self.evidence), *((1.0 / d, j) for d, j in zip(self.density, self.jerk))]
        least = minimize(total(terms if held is None else [*terms, (1.0, held)]))
        return least, self.state + least.step.reshape(self.state.shape)

    @cached_property
    def evidence(self) -> Quadratic:
        return self.readings.together(self.state, self.information * self.weight[:, None, None])


def smooth_interval(observed: Observations, asked_s: Array, manner: Manner) -> Smoothed:
    """Most probable trajectory given the positions, under white jerk along and across the way.

    Notes
    -----
    For given densities the estimate is that of a Kalman filter with a Rauch-Tung-Striebel smoother for the
    constant-acceleration model, found in one go; the densities maximize the marginal likelihood. Cost O(n).
    """
    chain = Chain.over(np.concatenate([observed.t_s, asked_s]))
    problem, least, state = _settle(_pose(chain, Readings.of(observed, chain), manner), manner)
    covariance = least.covariance()
    held = _held(problem, state, covariance, manner)
    if held is not None:
        least, state = problem.solve(held)
        covariance = least.covariance()
    distance = np.hypot(*problem.readings.residual(state).T)
    state, covariance = _read_off(chain, asked_s, state, covariance)
    known = course_is_known(state[:, 1], covariance[:, 2:4, 2:4], sideways=manner.sideways, wary=manner.wary)
    yaw = yaw_of_motion(state[:, 0], state[:, 1], hint_rad=manner.heading_rad, sideways=manner.sideways, known=known)
    return Smoothed(state, covariance, yaw, distance, problem.weight, problem.density)


def _pose(chain: Chain, readings: Readings, manner: Manner) -> _Problem:
    """Find outliers, noise and densities on a chain of fewer knots, then pose the problem on all of them."""
    observed = readings.observed
    few = Chain.over(observed.t_s, SEARCH_STEP_S)
    read = Readings.of(observed, few)
    rough = _rough(few, read, manner)
    information = np.asarray(np.linalg.inv(observed.r * rough.variance_factor), dtype=np.float64)
    yaw = unwrapped(yaw_of_motion(rough.state[:, 0], rough.state[:, 1], hint_rad=manner.heading_rad))
    density = (rough.density, rough.density)
    if manner.steers and len(few) >= LEAST_KNOTS:
        search = _about(few, read, rough.state, rough.weight, information, yaw)
        density = separate_densities(few, search.jerk, search.evidence, rough.density, manner.belief)
    course: Array = np.interp(chain.knots_s, few.knots_s, yaw)
    problem = _about(chain, readings, carry(few, rough.state, chain.knots_s), rough.weight, information, course)
    lowest = floor(chain)
    return replace(problem, density=(max(density[0], lowest), max(density[1], lowest)))


def _rough(chain: Chain, readings: Readings, manner: Manner) -> _Rough:
    """Outliers, noise and one density for both axes, taken apart, which makes the search cheap."""
    variance = np.trace(readings.observed.r, axis1=1, axis2=2) / 2
    density = max(PERMISSIVE_JERK_DENSITY if manner.jerk_density is None else manner.jerk_density, floor(chain))
    state, weight = _without_outliers(chain, readings, variance, density, manner)
    if manner.jerk_density is not None and not manner.scaled:
        return _Rough(state, weight, density, 1.0)
    fixed = readings.apart(state, weight / variance)
    density, factor = shared_density(
        chain,
        state,
        fixed,
        float(weight.sum()),
        scaled=manner.scaled,
        belief=manner.belief,
        rounds=1 if manner.steers else 2,
    )
    density = density if manner.jerk_density is None else manner.jerk_density
    state = state + minimize(total([(1.0, fixed), (factor / density, chain.jerk(state))])).step
    squared = (readings.residual(state) ** 2).sum(axis=1) / (variance * factor)
    return _Rough(state, manner.weights(squared), density, factor)


def _about(chain: Chain, readings: Readings, state: Array, weight: Array, information: Array, yaw: Array) -> _Problem:
    """The problem as forms about a state (K, 3, 2) with unwrapped headings (K,) that tell along from across."""
    course = (yaw[1:] + yaw[:-1]) / 2
    along = np.stack([np.cos(course), np.sin(course)], axis=-1)
    return _Problem(chain, readings, state, weight, information, chain.jerk_by_direction(state, along), (1.0, 1.0))


def _settle(problem: _Problem, manner: Manner) -> tuple[_Problem, Minimum, Array]:
    """Settle which observations are wrong: the problem with their weights, its minimum and the state (K, 3, 2) there."""
    for _ in range(DECIDING_ROUNDS):
        least, state = problem.solve()
        residual = problem.readings.residual(state)
        squared = np.einsum("na,nab,nb->n", residual, problem.information, residual)
        weight = manner.weights(squared)
        if np.abs(weight - problem.weight).max() < SETTLED:
            return problem, least, state
        problem = replace(problem, weight=weight)
    return problem, *problem.solve()


def _without_outliers(
    chain: Chain, readings: Readings, variance: Array, density: float, manner: Manner
) -> tuple[Array, Array]:
    """State (K, 3, 2) and weights (n,) with both axes alike and a given density."""
    start = np.zeros((len(chain), 3, 2))
    jerk = chain.jerk(start)
    weight = np.ones(len(variance))
    for k in range(TOLERANT_ROUNDS + 1):
        evidence = readings.apart(start, weight / variance)
        state = minimize(total([(1.0, evidence), (1.0 / density, jerk)])).step
        squared = (readings.residual(state) ** 2).sum(axis=1) / variance
        if squared.max() < CLEAN_SIGMAS**2:
            break
        weight = tolerant(squared) if k < TOLERANT_ROUNDS else manner.weights(squared)
    return state, manner.weights(squared)


def _held(problem: _Problem, state: Array, covariance: Array, manner: Manner) -> Quadratic | None:
    """What stands does not move, and what rolls slowly goes where it points: None where neither is the case."""
    velocity = state[:, 1]
    tolerance = standing_tolerance(problem.chain.knots_s, problem.readings, problem.weight, state, covariance)
    still = np.isfinite(tolerance)
    known = course_is_known(velocity, covariance[:, 2:4, 2:4], sideways=manner.sideways, wary=manner.wary) & ~still
    slow = ~known & ~still
    if manner.sideways or not (known.any() or manner.heading_rad is not None):
        slow[:] = False
    if not (still.any() or slow.any()):
        return None
    yaw = yaw_of_motion(state[:, 0], velocity, hint_rad=manner.heading_rad, sideways=manner.sideways, known=known)
    across = np.stack([-np.sin(yaw), np.cos(yaw)], axis=-1)
    slip = SLIP_MPS + SLIP_SHARE * np.hypot(*velocity.T)
    about_velocity = (slow / slip**2)[:, None, None] * across[:, :, None] * across[:, None, :]
    about_velocity = about_velocity + (tolerance**-2)[:, None, None] * np.eye(2)
    about_acceleration = ((tolerance * STANDING_HZ) ** -2)[:, None, None] * np.eye(2)
    return hold(problem.state, about_velocity, about_acceleration)


def _read_off(chain: Chain, asked_s: Array, state: Array, covariance: Array) -> tuple[Array, Array]:
    """States (T, 3, 2) and covariances (T, 6, 6) at asked times, each carried over from the nearest knot."""
    place = nearest_index(chain.knots_s, asked_s)
    if np.array_equal(chain.knots_s[place], asked_s):
        return state[place], covariance[place]
    both = np.einsum("tij,ab->tiajb", carrying(asked_s - chain.knots_s[place]), np.eye(2)).reshape(-1, 6, 6)
    return carry(chain, state, asked_s), both @ covariance[place] @ np.swapaxes(both, 1, 2)
