"""What the replay asks of a simulator, and the embedded one.

A simulator moves all agents at once by stateless steps. Another vehicle model is made usable by a line in `STEPS`, another
simulator (a game engine) by giving it the two functions of `Simulator`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from log2sim.errors import ConfigError
from log2sim.registry import nearest
from log2sim.replay.single_track import step_single_track
from log2sim.replay.sliding import step_dynamic
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


Step = Callable[[VehicleState, VehicleControls, VehicleParameters, float], VehicleState]


class EmbeddedSimulator:
    """Vehicles by one of the models of this package, and point masses."""

    def __init__(self, step: Step) -> None:
        self._step = step

    def step_vehicles(
        self, state: VehicleState, controls: VehicleControls, parameters: VehicleParameters, dt_s: float
    ) -> VehicleState:
        return self._step(state, controls, parameters, dt_s)

    def step_points(self, state: PointState, controls: PointControls, dt_s: float) -> PointState:
        return step_point(state, controls, dt_s)


STEPS: dict[str, Step] = {"kinematic": step_bicycle, "dynamic": step_dynamic, "single-track": step_single_track}


def simulator_named(model: str) -> Simulator:
    """The simulator for `model`; `ConfigError` when there is none of that name."""
    if model not in STEPS:
        raise ConfigError(f"unknown vehicle model '{model}'{nearest(model, list(STEPS))}; known: {', '.join(STEPS)}")
    return EmbeddedSimulator(STEPS[model])
