"""Where the poses of a run come from, and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from log2sim.datatypes import Fault

ORIGINS = {"given": "ego poses of the log", "lidar": "LiDAR odometry", "camera": "camera motion"}
"""What a scenario says about the ego by the source of its poses."""


@dataclass(frozen=True, eq=False)
class PoseChoice:
    """Where the poses of a run come from, and why.

    Attributes
    ----------
    requested : str
        As the settings say.
    source : {"given", "lidar", "camera", "none"}
        "none": no sensor is on an ego whose pose would have to be known.
    reason : str
        For people.
    excess_m : mapping of str to float
        How far given poses are off against each other by the surroundings, beyond what odometry leaves: "neighbors",
        "apart"; empty where nothing was compared.
    scatter_m : mapping of str to mapping of str to float
        RMS distance between upright surfaces of pairs of sweeps by the poses "given" and "lidar".
    estimate : mapping of str to Any
        Figures of the odometry, JSON values; empty where none was run.
    notes : tuple of str
        What is doubtful about estimated poses.
    during_ns : (int, int), optional
        First and last stamp of what poses were estimated from; None for the whole log.
    faults : tuple of Fault
        Faults of given poses.
    checked : bool
        Whether given poses were checked, and repaired where that was needed.
    """

    requested: str
    source: str
    reason: str
    excess_m: Mapping[str, float | None] = field(default_factory=dict)
    scatter_m: Mapping[str, Mapping[str, float | None]] = field(default_factory=dict)
    estimate: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    during_ns: tuple[int, int] | None = None
    faults: tuple[Fault, ...] = ()
    checked: bool = True

    @property
    def origin(self) -> str:
        """Name what the ego's path comes from."""
        return ORIGINS.get(self.source, "none")

    def to_dict(self) -> dict[str, Any]:
        """Return the entry `poses` of `schemas/report-1.json`."""
        return {
            "requested": self.requested,
            "source": self.source,
            "reason": self.reason,
            "scatter_m": {name: dict(values) for name, values in self.scatter_m.items()},
            "excess_m": dict(self.excess_m),
            "estimate": dict(self.estimate),
            "notes": list(self.notes),
        }

    def to_provenance(self) -> dict[str, Any]:
        """Return what `localize_like` needs to find the same poses again."""
        during = {} if self.during_ns is None else {"during_ns": list(self.during_ns)}
        return {"source": self.source, **during, **({} if self.checked else {"check": False})}


GIVEN = PoseChoice("given", "given", "the log's own poses")
