"""Drives the ego as in the scenario, though later after it has braked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from log2sim.datatypes import STANDSTILL_MPS, Agent
from log2sim.simulation.follower import ControllerMemory, follow_vehicles
from log2sim.simulation.policy import Controls, EgoState, Observation
from log2sim.simulation.reference import Reference, vehicle_reference_of
from log2sim.simulation.vehicles.parameters import parameters_for
from log2sim.simulation.vehicles.vehicle import VehicleState

MAX_THROTTLE_MPS2 = 3.0
"""Of a car that pulls away: twice what the intelligent driver model takes for comfortable in towns."""

CATCH_UP_S = 0.2
"""After it has braked, the ego catches up with so much and no more."""


class LateDriver:
    """Follows the ego's trajectory by the controller of `pid`, by the scenario's time less a delay.

    Parameters
    ----------
    ego : Agent
        On wheels.
    """

    def __init__(self, ego: Agent) -> None:
        self._ego, self._parameters = ego, parameters_for([ego])
        self._reference: Reference | None = None
        self._memory = ControllerMemory.fresh(1)
        self._delay_s, self._braked = 0.0, False

    def drive(self, seen: Observation) -> Controls:
        """Return what follows the scenario."""
        if self._braked and abs(self._row(seen)[3, 0]) > STANDSTILL_MPS:
            self._delay_s = max(self._delay_s, seen.t_s - self._place_s(seen) - CATCH_UP_S)
        commands = self._follow(seen)
        return replace(commands, accel_mps2=min(commands.accel_mps2, MAX_THROTTLE_MPS2)) if self._braked else commands

    def brake(self, seen: Observation, brake_mps2: float) -> Controls:
        """Return what stops the ego on its path; it goes on from there."""
        self._delay_s, self._braked = seen.t_s - self._place_s(seen), True
        self._memory = ControllerMemory.fresh(1)
        return replace(self._follow(seen), accel_mps2=-brake_mps2)

    def _follow(self, seen: Observation) -> Controls:
        p = replace(self._parameters, understeer_s2pm2=np.array([seen.ego.understeer_s2pm2]))
        commands, self._memory = follow_vehicles(self._row(seen), self._state(seen.ego), self._memory, p, seen.dt_s)
        return Controls(float(commands.pedal_mps2[0]), float(commands.steer_rad[0]), bool(commands.reverse[0]))

    def _row(self, seen: Observation) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        """Return the reference (C, 1) of the present."""
        if self._reference is None:
            self._reference = vehicle_reference_of(self._ego, seen.dt_s)
        return self._reference.exact(np.array([seen.t_s - self._delay_s])).T

    def _state(self, ego: EgoState) -> VehicleState:
        """Return the rear axle, relative to the origin of the reference."""
        assert self._reference is not None
        x0, y0 = self._reference.trajectory.origin_m
        x = ego.x_m - ego.rear_axle_offset_m * np.cos(ego.yaw_rad) - x0
        y = ego.y_m - ego.rear_axle_offset_m * np.sin(ego.yaw_rad) - y0
        columns = (x, y, ego.yaw_rad, ego.speed_mps, ego.steer_rad, 0.0, 0.0, 0.0)
        return VehicleState(*(np.array([c]) for c in columns))

    def _place_s(self, seen: Observation) -> float:
        """Return when the scenario was at this place; its end beyond."""
        at_s = float(seen.path.t_s[0])
        return at_s if np.isfinite(at_s) else float(self._ego.waypoints.t_s[-1])
