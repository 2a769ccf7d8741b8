"""What the replay asks of a simulator, and the embedded one.

A simulator moves all agents at once by stateless steps. Another vehicle model is made usable by a line in `STEPS`, another
simulator by giving it the two functions of `Simulator`, and one that runs elsewhere (a game engine) as a `ExternalSimulator`.
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
        """The state of the vehicles after the step."""
        ...

    def step_points(self, state: PointState, controls: PointControls, dt_s: float) -> PointState:
        """The state of the points (pedestrians and whatever has no wheels) after the step."""
        ...


class ExternalSimulator(Protocol):
    """A simulator outside this process, which has one clock for all agents: a step of the replay is one tick of it.

    `open` seats the groups: their simulators from then on take controls down and leave states as they are. `tick`, called
    when all groups have given their controls, moves everybody and sets the groups' states to what came of it.
    """

    @property
    def name(self) -> str: ...

    @property
    def max_dt_s(self) -> float: ...

    def open(self, groups: Sequence[Any], clock: Any, statics: Sequence[Agent]) -> None:
        """Begin with groups (`log2sim.simulation.groups`), a clock, and agents that stand for good."""
        ...

    def tick(self, step: int) -> None:
        """Move from a step to the next."""
        ...

    def close(self) -> None:
        """Leave the simulator as it was found."""
        ...


VehicleStep = Callable[[VehicleState, VehicleControls, VehicleParameters, float], VehicleState]


class EmbeddedSimulator:
    """Vehicles by one of the models of this package, and point masses."""

    def __init__(self, step: VehicleStep) -> None:
        self._step = step

    def step_vehicles(
        self, state: VehicleState, controls: VehicleControls, parameters: VehicleParameters, dt_s: float
    ) -> VehicleState:
        return self._step(state, controls, parameters, dt_s)

    def step_points(self, state: PointState, controls: PointControls, dt_s: float) -> PointState:
        return step_point(state, controls, dt_s)


STEPS: dict[str, VehicleStep] = {"kinematic": step_bicycle, "dynamic": step_dynamic, "single-track": step_single_track}
