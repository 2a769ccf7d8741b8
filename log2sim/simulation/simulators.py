"""Simulators: the vehicle models of this package and of plug-ins, which move agents by stateless steps, and those in other processes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from log2sim.datatypes import Agent
from log2sim.errors import PluginError
from log2sim.files import plugins
from log2sim.simulation.vehicles.vehicle import VehicleControls, VehicleParameters, VehicleState

VehicleStep = Callable[[VehicleState, VehicleControls, VehicleParameters, float], VehicleState]
"""Moves vehicles for so many s with constant controls; no argument is changed."""


class ExternalSimulator(Protocol):
    """A simulator in another process, with one clock for all agents: a step of the replay is one tick of it.

    `open` takes the groups over: from then on they only decide their controls. `tick` is called when all groups have; it moves
    all agents and writes the new states back into the groups.
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


def load_step(model: str) -> VehicleStep:
    """Return the step of a vehicle model by its name.

    Raises `ConfigError` when there is no such model. Raises `PluginError` when one of another package cannot be used; its
    faults are told with the name of the package.
    """
    step: VehicleStep = plugins.load("vehicle_model", model)
    if plugins.is_built_in("vehicle_model", model):
        return step

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
