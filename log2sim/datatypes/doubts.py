"""Doubts: what speaks against an agent as it was reconstructed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

MIN_TRUSTED_CONFIDENCE = 0.5
"""Agents below it are doubtful: by their confidence they are more likely wrong than right."""

FLAGS = {
    "acceleration": "accelerates or brakes harder than vehicles can",
    "lateral_acceleration": "accelerates sideways harder than tires hold",
    "curvature": "turns on a smaller circle than vehicles can",
    "jerk": "changes its acceleration faster than brakes can",
    "speed": "is faster than anything of its category",
    "reversing": "drives backward fast or far",
    "sideways": "slides across its length",
    "jump": "its measurements are far from its trajectory",
    "passes_through": "is in the place of another agent",
    "in_ego": "touches the ego",
    "empty": "LiDAR rays pass through its place",
    "hardly_observed": "the LiDAR or the cameras look toward it and hardly ever show it",
    "unlikely_size": "has a size that no road vehicle has",
    "heading_ambiguous": "front and back may be swapped",
}
"""The flags that a reconstruction gives, and what each means."""


@dataclass(frozen=True)
class Doubt:
    """One reason to doubt an agent.

    Attributes
    ----------
    flag : str
        Short name of the reason; those of a reconstruction are in `FLAGS`.
    reason : str
        In words for people, such as "passes through car-22 at 1.2 s".
    start_s, end_s : float or None, s
        When it holds; None for the whole life of the agent.
    """

    flag: str
    reason: str
    start_s: float | None = None
    end_s: float | None = None

    def holds(self, t_s: Array) -> NDArray[np.bool_]:
        """Return whether it holds at times (T,)."""
        start = -np.inf if self.start_s is None else self.start_s
        end = np.inf if self.end_s is None else self.end_s
        return np.asarray((t_s >= start) & (t_s <= end))

    def retimed(self, change: Callable[[float], float]) -> Doubt:
        """Return the doubt of a trajectory whose times are put elsewhere by `change`, s to s."""
        start_s, end_s = (None if t_s is None else change(t_s) for t_s in (self.start_s, self.end_s))
        return replace(self, start_s=start_s, end_s=end_s)

    def to_dict(self) -> dict[str, Any]:
        """Return the entry in a document of `schemas/scenario-1.json`."""
        return {"flag": self.flag, "reason": self.reason, "start_s": self.start_s, "end_s": self.end_s}

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Doubt:
        """Read an entry that keeps the schema."""
        return cls(entry["flag"], entry["reason"], entry.get("start_s"), entry.get("end_s"))
