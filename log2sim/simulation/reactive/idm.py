"""The intelligent driver model (IDM), for agents that pass their trajectory at a rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from log2sim.datatypes import Agent
from log2sim.geometry import Array
from log2sim.simulation.vehicles.parameters import WHEELED
from log2sim.simulation.vehicles.vehicle import Columns

EXPONENT = 4.0
MIN_GAP_M = 0.1  # shorter gaps, and overlaps, count as this one
MIN_PACE_MPS = 0.5  # where it is slower, the rate responds as at this speed; it would have no bound at standstill
HOLD_MPS = 0.2  # a slower agent with a leader is held at standstill,
HOLD_DEMAND = (
    0.5  # until the leader's demand falls below this share of the free acceleration: 1.4 times the minimum gap
)

# Time gap in s, minimum gap in m, acceleration, comfortable and hardest braking in m/s2. On wheels: town traffic in
# Treiber and Kesting, "Traffic Flow Dynamics", 2013, chapter 11. On foot: an arm's length, and a stop within one step.
ON_WHEELS = (1.0, 2.0, 1.0, 1.5, 8.0)
ON_FOOT = (0.5, 0.7, 1.0, 1.5, 4.0)


@dataclass(frozen=True, eq=False)
class IdmParameters(Columns):
    """Parameters of the intelligent driver model, all (A,).

    Attributes
    ----------
    time_gap_s : (A,) float64
    gap_m : (A,) float64
        Minimum gap, kept at standstill.
    accel_mps2 : (A,) float64
        Free acceleration.
    comfort_mps2 : (A,) float64
        Comfortable braking.
    brake_mps2 : (A,) float64
        Hardest braking.
    """

    time_gap_s: Array
    gap_m: Array
    accel_mps2: Array
    comfort_mps2: Array
    brake_mps2: Array


def idm_parameters(agents: Sequence[Agent]) -> IdmParameters:
    """Return the parameters of agents by category."""
    rows = [ON_WHEELS if a.category in WHEELED else ON_FOOT for a in agents]
    return IdmParameters(*np.array(rows, dtype=np.float64).reshape(-1, 5).T)


def leader_demand(driver: IdmParameters, gap_m: Array, pace_mps: Array, leader_mps: Array) -> Array:
    """Return the share of the free acceleration that a leader takes: (s* / s)^2 of the model; 1 at the minimum gap at low speed.

    Notes
    -----
    Treiber, Hennecke and Helbing, "Congested traffic states in empirical observations and microscopic simulations", 2000.
    """
    closing = pace_mps * (pace_mps - leader_mps) / (2 * np.sqrt(driver.accel_mps2 * driver.comfort_mps2))
    desired = driver.gap_m + np.maximum(pace_mps * driver.time_gap_s + closing, 0.0)
    result: Array = (desired / np.maximum(gap_m, MIN_GAP_M)) ** 2
    return result


def rate_response(
    driver: IdmParameters, rate: Array, taken: Array, pace_mps: Array, log_accel_mps2: Array
) -> tuple[Array, Array]:
    """Return the rate and its slope in 1/s, (A,) each, of trajectories at `pace_mps` here, with demand `taken`.

    Notes
    -----
    The scenario's speed at a place is the model's desired speed, so the rate is its v / v0, and the model's
    acceleration is added to the scenario's. Braking that the scenario does anyway counts as a response to the leader.
    Without demand a rate of 1 stays 1: the agent follows the scenario.
    """
    logged = rate**2 * log_accel_mps2
    excess = np.maximum(driver.accel_mps2 * taken - np.maximum(-logged, 0.0), 0.0)
    accel = driver.accel_mps2 * (1 - rate**EXPONENT) - excess
    accel = np.maximum(accel, -driver.brake_mps2 - np.minimum(logged, 0.0))
    slope = accel / np.maximum(pace_mps, MIN_PACE_MPS)
    held = (rate * pace_mps < HOLD_MPS) & (taken > HOLD_DEMAND)
    return np.where(held, 0.0, rate), np.where(held, 0.0, slope)
