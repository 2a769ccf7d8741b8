"""Signals: traffic lights with their states over time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.errors import ScenarioError
from log2sim.geometry import Array
from log2sim.numerals import short_repr

SIGNAL_STATES = ("red", "red_yellow", "yellow", "green", "off", "unknown")
"""States of a traffic light; off: no lamp is lit; unknown: no camera shows it."""


@dataclass(frozen=True, eq=False)
class Signal:
    """A signal head of a traffic light.

    Attributes
    ----------
    id : str
    position_m : (3,) float64, m
        Middle of its housing, map frame.
    heading_rad : float or None
        Direction that its lamps face, None where unknown.
    t_s : (T,) float64, s
        Strictly increasing times at which its state changes; the last state lasts to the end of the scenario.
    state : (T,) str
        Of `SIGNAL_STATES`, from each time on.
    sigma_m : float, m
        Standard deviation of the position along the axis on which it is largest.
    confidence : float
        Probability that it is a traffic light, there, in [0, 1].
    cameras : tuple of str
        That saw it.
    """

    __repr__ = short_repr

    id: str
    position_m: Array
    heading_rad: float | None
    t_s: Array
    state: NDArray[np.str_]
    sigma_m: float = 0.0
    confidence: float = 1.0
    cameras: tuple[str, ...] = ()

    def at(self, t_s: ArrayLike) -> NDArray[np.str_]:
        """Return its states (T,) at times (T,); unknown before its first time."""
        k = np.searchsorted(self.t_s, np.atleast_1d(np.asarray(t_s, dtype=np.float64)), side="right") - 1
        return np.asarray(np.where(k >= 0, self.state[np.maximum(k, 0)], "unknown"))

    def to_dict(self) -> dict[str, Any]:
        """Return the entry in a document of `schemas/scenario-1.json`."""
        return {
            "id": self.id,
            "position_m": self.position_m.tolist(),
            "heading_rad": None if self.heading_rad is None else float(self.heading_rad),
            "t_s": self.t_s.tolist(),
            "state": [str(state) for state in self.state],
            "sigma_m": float(self.sigma_m),
            "confidence": float(self.confidence),
            "cameras": list(self.cameras),
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Signal:
        """Read an entry that keeps the schema.

        Raises
        ------
        ScenarioError
            When it has not one state for each time, or its times do not increase.
        """
        t_s, state = np.array(entry["t_s"], dtype=np.float64), np.array(entry["state"], dtype=str)
        if len(t_s) != len(state):
            raise ScenarioError(f"signal '{entry['id']}': {len(t_s)} times, {len(state)} states; expected equal")
        if np.any(np.diff(t_s) <= 0):
            raise ScenarioError(f"signal '{entry['id']}': t_s does not increase")
        return cls(
            entry["id"],
            np.array(entry["position_m"], dtype=np.float64),
            entry["heading_rad"],
            t_s,
            state,
            float(entry["sigma_m"]),
            float(entry["confidence"]),
            tuple(entry["cameras"]),
        )
