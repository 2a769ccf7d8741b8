"""What a scenario says beyond its agents' motion: lanes, colors of vehicles, traffic lights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from log2sim.config import Config
from log2sim.datatypes import Log, Scenario
from log2sim.perception.first_pass import Observations
from log2sim.plan import Plan
from log2sim.stage_clock import StageClock


@dataclass(frozen=True, eq=False)
class Recorded:
    """The recording that a scenario was made from, as its stages share it.

    Attributes
    ----------
    log : Log
    config : Config
    plan : Plan
    observations : Observations
    clock : StageClock
    report_progress : callable
        Called as `report_progress(stage, done, total)`.
    """

    log: Log
    config: Config
    plan: Plan
    observations: Observations
    clock: StageClock
    report_progress: Callable[[str, int, int], None]


def describe(scenario: Scenario, recorded: Recorded) -> Scenario:
    """Return the scenario with what the plan keeps of lanes, colors and traffic lights."""
    return scenario
