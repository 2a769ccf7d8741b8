"""What a replay needs of a simulator, and the embedded one.

A simulator moves all agents at once by stateless steps. To add a vehicle model, add a line to `STEPS`; to add a
simulator, implement the two methods of `Simulator`, or `ExternalSimulator` for one that runs in another process, such
as a game engine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from log2sim.datatypes import Agent
from log2sim.simulation.vehicles.dynamic import step_dynamic
from log2sim.simulation.vehicles.single_track import step_single_track
from log2sim.simulation.vehicles.vehicle import (
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


STEPS: dict[str, VehicleStep] = {"kinematic": step_bicycle, "dynamic": step_dynamic, "single-track": step_single_track}
