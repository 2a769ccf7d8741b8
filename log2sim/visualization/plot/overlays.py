"""What a picture shows besides the scenario."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from log2sim.datatypes import Scenario
from log2sim.visualization.plot.drawing import Background
from log2sim.visualization.plot.options import NO_OPTIONS, PlotOptions
from log2sim.visualization.plot.predicted import PredictedPaths
from log2sim.visualization.plot.selection import Span


@dataclass(frozen=True, eq=False)
class Overlays:
    """What a picture shows besides the scenario, and the options that concern how.

    Attributes
    ----------
    replay : log2sim.simulation.result.Replay or None
        Drawn over the scenario, with charts below the map.
    truth : Scenario or None
        In the time and map of the scenario.
    background : BirdsEyeView or None
        A picture of the ground, drawn below everything.
    predicted : PredictedPaths or None
    title : str or None
        None for the name of the scenario.
    span : Span or None
        Range of time that is shown; None for the whole scenario.
    options : PlotOptions
    """

    replay: Any = None
    truth: Scenario | None = None
    background: Background | None = None
    predicted: PredictedPaths | None = None
    title: str | None = None
    span: Span | None = None
    options: PlotOptions = NO_OPTIONS

    def span_of(self, scenario: Scenario) -> Span:
        """Return the range of time that is shown."""
        return self.span or Span(0.0, scenario.duration_s)


NO_OVERLAYS = Overlays()
