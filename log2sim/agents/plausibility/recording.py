"""What candidates are judged by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from log2sim.agents.candidate import Timeline
from log2sim.datatypes import Log, Obstacles
from log2sim.geometry import Array
from log2sim.perception.sync import Schedule


@dataclass(frozen=True, eq=False)
class Recording:
    """What the sensors of a log recorded at the ticks of a run.

    Attributes
    ----------
    log : Log
    schedule : Schedule
        Its cameras are those that were searched.
    clouds : T Obstacles, None at ticks without LiDAR
    timeline : Timeline
    """

    log: Log
    schedule: Schedule
    clouds: Sequence[Obstacles | None]
    timeline: Timeline

    @property
    def t_s(self) -> Array:
        """Times (T,) of the ticks since the start."""
        return self.timeline.seconds(self.timeline.t_ns)
