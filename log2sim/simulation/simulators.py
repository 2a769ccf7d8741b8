"""What a replay needs of a simulator, and the embedded one.

A simulator moves all agents at once by stateless steps. Vehicle models are plug-ins of the kind `vehicle_model`; to add a
simulator, implement the two methods of `Simulator`, or `ExternalSimulator` for one that runs in another process, such
as a game engine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from log2sim.datatypes import Agent
from log2sim.errors import PluginError
from log2sim.files import plugins
from log2sim.simulation.vehicles.vehicle import (
    PointControls,
    PointState,
    VehicleControls,
    VehicleParameters,
    VehicleState,
    step_point,
)


class Simulator(Protocol):
    """Moves agents by `dt_s` with constant controls; no argument is changed."""

    def step_vehicles(
        self, state: VehicleState, controls: VehicleControls, parameters: VehicleParameters, dt_s: float
    ) -> VehicleState:
        """Return the state of the vehicles after the step."""
        ...

    def step_points(self, state: PointState, controls: PointControls, dt_s: float) -> PointState:
        """Return the state of the points (pedestrians and everything without wheels) after the step."""
        ...


class ExternalSimulator(Protocol):
    """A simulator in another process, with one clock for all agents: a step of the replay is one tick of it.

    `open` takes the groups over: from then on their simulators only record the controls. `tick` is called when all
    groups have set their controls; it moves all agents and writes the new states back into the groups.
    """

    @property
    def name(self) -> str:
        """Name of the simulator in results."""
        ...

    @property
    def max_dt_s(self) -> float:
        """Longest step in s that it can take."""
        ...

    def open(self, groups: Sequence[Any], clock: Any, statics: Sequence[Agent]) -> None:
        """Start with groups (`log2sim.simulation.groups`), a clock, and agents that never move."""
        ...

    def tick(self, step: int) -> None:
        """Move all agents from a step to the next."""
        ...

    def close(self) -> None:
        """Restore the simulator as it was before `open`."""
        ...


VehicleStep = Callable[[VehicleState, VehicleControls, VehicleParameters, float], VehicleState]


class EmbeddedSimulator:
    """Vehicles by one of the models of this package, and point masses."""

    def __init__(self, step: VehicleStep) -> None:
        self._step = step

    def step_vehicles(
        self, state: VehicleState, controls: VehicleControls, parameters: VehicleParameters, dt_s: float
    ) -> VehicleState:
        """Move vehicles by the chosen model."""
        return self._step(state, controls, parameters, dt_s)

    def step_points(self, state: PointState, controls: PointControls, dt_s: float) -> PointState:
        """Move point masses."""
        return step_point(state, controls, dt_s)


def load_step(model: str) -> VehicleStep:
    """Return the step of a vehicle model by its name.

    Raises `ConfigError` when there is no such model. Raises `PluginError` when one of another package cannot be used.
    """
    step: VehicleStep = plugins.load("vehicle_model", model)
    return step if plugins.is_built_in("vehicle_model", model) else _checked(step, model)


def _checked(step: VehicleStep, model: str) -> VehicleStep:
    """Return a step of another package whose faults are told with the name of the package."""

    def checked(
        state: VehicleState, controls: VehicleControls, parameters: VehicleParameters, dt_s: float
    ) -> VehicleState:
        with plugins.blaming("vehicle_model", model):
            after = step(state, controls, parameters, dt_s)
        plugins.require_type("vehicle_model", model, after, VehicleState)
        for key in ("x_m", "y_m", "yaw_rad", "speed_mps"):
            column = np.asarray(getattr(after, key))
            if column.shape != state.x_m.shape or not np.isfinite(column).all():
                raise PluginError(
                    f"{plugins.plugin_label('vehicle_model', model)}: {key} is {column!s:.80}, expected {len(state.x_m)} finite "
                    "numbers, one for each vehicle"
                )
        return after

    return checked
