"""Boxes of several agents at common times."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent
from log2sim.geometry import Array

# Of a long log, so that the memory does not grow with agents times ticks.
TICKS_AT_A_TIME = 256
# Stamps of ticks and waypoints are the same up to rounding.
SAME_S = 1e-6


@dataclass(frozen=True, eq=False)
class BoxTable:
    """Boxes of A agents at T times, map frame; NaN where an agent is absent.

    Attributes
    ----------
    present : (A, T) bool
    center_m : (A, T, 3) float64
    velocity_mps : (A, T, 2) float64
    yaw_rad : (A, T) float64
    size_m : (A, 3) float64
    """

    present: NDArray[np.bool_]
    center_m: Array
    velocity_mps: Array
    yaw_rad: Array
    size_m: Array

    @classmethod
    def of(cls, agents: Sequence[Agent], t_s: Array, *, margin_s: float = SAME_S) -> BoxTable:
        """Evaluate agents at times (T,); up to `margin_s` before and after its life an agent moves on as it starts and ends."""
        at = [agent.at(t_s, margin_s=margin_s) for agent in agents]
        x, y, z, yaw, speed = (
            np.array([getattr(s, key) for s in at]).reshape(len(at), len(t_s))
            for key in ("x_m", "y_m", "z_m", "yaw_rad", "speed_mps")
        )
        velocity = np.stack([speed * np.cos(yaw), speed * np.sin(yaw)], axis=-1)
        life = np.array([[a.waypoints.t_s[0], a.waypoints.t_s[-1]] for a in agents]).reshape(len(at), 2, 1)
        outside_s = t_s - np.clip(t_s, life[:, 0], life[:, 1])
        return cls(
            present=np.array([s.valid for s in at], dtype=bool).reshape(len(at), len(t_s)),
            center_m=np.stack([x, y, z], axis=-1) + np.insert(velocity, 2, 0.0, axis=2) * outside_s[..., None],
            velocity_mps=velocity,
            yaw_rad=yaw,
            size_m=np.array([agent.size_m for agent in agents], dtype=np.float64).reshape(len(at), 3),
        )

    @classmethod
    def in_turn(cls, agents: Sequence[Agent], t_s: Array) -> Iterator[tuple[NDArray[np.intp], int, BoxTable]]:
        """Evaluate agents at times (T,), rising, some at a time: the agents that are there, the first time, and their boxes."""
        life = np.array([[a.waypoints.t_s[0], a.waypoints.t_s[-1]] for a in agents]).reshape(-1, 2)
        for first in range(0, len(t_s), TICKS_AT_A_TIME):
            some = t_s[first : first + TICKS_AT_A_TIME]
            rows = np.flatnonzero((life[:, 0] <= some[-1] + SAME_S) & (life[:, 1] >= some[0] - SAME_S))
            table = cls.of([agents[k] for k in rows.tolist()], some, margin_s=SAME_S)
            there = np.flatnonzero(table.present.any(axis=1))
            yield rows[there], first, table.take(there)

    def take(self, rows: NDArray[np.intp]) -> BoxTable:
        """Return the boxes of some of the agents."""
        return BoxTable(*(getattr(self, field.name)[rows] for field in fields(self)))
