"""What the replay asks of a simulator, and the embedded one.

A simulator moves all agents at once by stateless steps. Another one (a game engine, a tire model) is made usable by giving
it these two functions and a line in `SIMULATORS`.
"""

from __future__ import annotations

from typing import Protocol

from log2sim.errors import ConfigError
from log2sim.registry import nearest
from log2sim.replay.vehicle import (
    PointControls,
    PointState,
    VehicleControls,
    VehicleParameters,
    VehicleState,
    step_bicycle,
    step_point,
)


class Simulator(Protocol):
    """Moves agents by `dt_s` with constant controls; no argument is changed."""

    def step_vehicles(
        self, state: VehicleState, controls: VehicleControls, parameters: VehicleParameters, dt_s: float
    ) -> VehicleState:
        """The state of the vehicles after the step."""
        ...

    def step_points(self, state: PointState, controls: PointControls, dt_s: float) -> PointState:
        """The state of the points (pedestrians and whatever has no wheels) after the step."""
        ...


class KinematicSimulator:
    """The embedded default: kinematic bicycles with actuators, and point masses."""

    def step_vehicles(
        self, state: VehicleState, controls: VehicleControls, parameters: VehicleParameters, dt_s: float
    ) -> VehicleState:
        return step_bicycle(state, controls, parameters, dt_s)

    def step_points(self, state: PointState, controls: PointControls, dt_s: float) -> PointState:
        return step_point(state, controls, dt_s)


SIMULATORS: dict[str, type[Simulator]] = {"kinematic": KinematicSimulator}


def simulator_named(model: str) -> Simulator:
    """The simulator for `model`; `ConfigError` when there is none of that name."""
    if model not in SIMULATORS:
        known = ", ".join(SIMULATORS)
        raise ConfigError(f"unknown vehicle model '{model}'{nearest(model, list(SIMULATORS))}; known: {known}")
    return SIMULATORS[model]()
