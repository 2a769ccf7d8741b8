"""The intelligent-driver model, for agents that go through their log at a rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from log2sim.datatypes import Agent
from log2sim.geometry import Array
from log2sim.simulation.vehicles.parameters import WHEELED
from log2sim.simulation.vehicles.vehicle import Columns

EXPONENT = 4.0
MIN_GAP_M = 0.1  # shorter gaps, and overlaps, are as bad as this one
MIN_PACE_MPS = (
    0.5  # where the log is slower, the rate answers as if it went this fast, or it had no bounds at standstill
)
HOLD_MPS = 0.2  # who is slower and has somebody in front stands,
HOLD_DEMAND = 0.5  # until that takes less than this share of the free acceleration: at 1.4 times the gap of standstill

# Time gap in s, gap at standstill in m, acceleration, comfortable braking and hardest braking in m/s2. On wheels: town
# traffic in Treiber and Kesting, "Traffic Flow Dynamics", 2013, chapter 11. On foot: an arm's length, and a stop in a step.
ON_WHEELS = (1.0, 2.0, 1.0, 1.5, 8.0)
ON_FOOT = (0.5, 0.7, 1.0, 1.5, 4.0)


@dataclass(frozen=True, eq=False)
class IdmParameters(Columns):
    """Parameters of the intelligent-driver model, all (A,)."""

    time_gap_s: Array
    gap_m: Array
    accel_mps2: Array
    comfort_mps2: Array
    brake_mps2: Array


def idm_parameters(agents: Sequence[Agent]) -> IdmParameters:
    """Parameters of agents by their kind."""
    rows = [ON_WHEELS if a.category in WHEELED else ON_FOOT for a in agents]
    return IdmParameters(*np.array(rows, dtype=np.float64).reshape(-1, 5).T)


def leader_demand(driver: IdmParameters, gap_m: Array, pace_mps: Array, leader_mps: Array) -> Array:
    """How much a leader takes of the free acceleration: (s* / s)^2 of the model; 1 is the gap that is kept at low speed.

    Notes
    -----
    Treiber, Hennecke and Helbing, "Congested traffic states in empirical observations and microscopic simulations", 2000.
    """
    closing = pace_mps * (pace_mps - leader_mps) / (2 * np.sqrt(driver.accel_mps2 * driver.comfort_mps2))
    desired = driver.gap_m + np.maximum(pace_mps * driver.time_gap_s + closing, 0.0)
    return (desired / np.maximum(gap_m, MIN_GAP_M)) ** 2


def rate_response(
    driver: IdmParameters, rate: Array, taken: Array, pace_mps: Array, log_accel_mps2: Array
) -> tuple[Array, Array]:
    """Rate and its slope in 1/s, all (A,), of agents whose log goes at `pace_mps` here, with `taken` of all leaders.

    Notes
    -----
    The log's speed at the place is the model's desired speed, so the rate is its v / v0, and the model's acceleration comes
    on top of the log's. Braking that the log does anyway counts as an answer to the leader. With nothing taken, a rate of 1
    stays 1: the log.
    """
    logged = rate**2 * log_accel_mps2
    excess = np.maximum(driver.accel_mps2 * taken - np.maximum(-logged, 0.0), 0.0)
    accel = driver.accel_mps2 * (1 - rate**EXPONENT) - excess
    accel = np.maximum(accel, -driver.brake_mps2 - np.minimum(logged, 0.0))
    slope = accel / np.maximum(pace_mps, MIN_PACE_MPS)
    held = (rate * pace_mps < HOLD_MPS) & (taken > HOLD_DEMAND)
    return np.where(held, 0.0, rate), np.where(held, 0.0, slope)
