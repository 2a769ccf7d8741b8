"""Boxes of many agents at common times, as columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes.agent import MARGIN_S, Agent
from log2sim.datatypes.categories import GROUP_OF
from log2sim.files.documents import short_repr
from log2sim.geometry import Array


@dataclass(frozen=True, eq=False)
class AgentTable:
    """Boxes of A agents at T times, map frame; NaN where an agent is absent."""

    __repr__ = short_repr

    agents: tuple[Agent, ...]
    t_s: Array  # (T,), s
    center_m: Array  # (A, T, 3), m
    yaw_rad: Array  # (A, T), in [-pi, pi)
    speed_mps: Array  # (A, T), m/s: along the heading, negative when reversing

    @classmethod
    def of(cls, agents: Sequence[Agent], t_s: Array, *, margin_s: float = MARGIN_S, permanent: bool = False) -> Self:
        """Evaluate agents at times (T,); those with `is_permanent` are there at all of them where `permanent` says so.

        Up to `margin_s` before and after its life an agent moves on as it starts and ends.
        """
        columns = np.full((5, len(agents), len(t_s)), np.nan)
        for k, agent in enumerate(agents):
            states = agent.at(t_s, margin_s=np.inf if permanent and agent.is_permanent else margin_s)
            outside_s = t_s - np.clip(t_s, *agent.waypoints.t_s[[0, -1]])
            dx, dy = (states.speed_mps * turn(states.yaw_rad) * outside_s for turn in (np.cos, np.sin))
            columns[:, k] = states.x_m + dx, states.y_m + dy, states.z_m, states.yaw_rad, states.speed_mps
        return cls(tuple(agents), t_s, np.moveaxis(columns[:3], 0, -1).copy(), *columns[3:])

    def take(self, rows: NDArray[np.generic]) -> AgentTable:
        """Return some of the agents."""
        return AgentTable(
            tuple(self.agents[k] for k in np.arange(len(self.agents))[rows].tolist()), self.t_s,
            self.center_m[rows], self.yaw_rad[rows], self.speed_mps[rows],
        )  # fmt: skip

    @cached_property
    def present(self) -> NDArray[np.bool_]:
        """Whether an agent is there (A, T)."""
        return np.isfinite(self.yaw_rad)

    @cached_property
    def size_m(self) -> Array:
        """Length, width, height (A, 3)."""
        return np.array([agent.size_m for agent in self.agents], dtype=np.float64).reshape(-1, 3)

    @cached_property
    def category(self) -> NDArray[np.str_]:
        """Category (A,) of each agent."""
        return np.array([agent.category for agent in self.agents], dtype="<U16")

    @cached_property
    def group(self) -> NDArray[np.str_]:
        """Group (A,) of these categories."""
        return np.array([GROUP_OF.get(agent.category, "other") for agent in self.agents], dtype="<U16")

    @property
    def xy_m(self) -> Array:
        """Place (A, T, 2) of the center on the ground."""
        return self.center_m[..., :2]

    @cached_property
    def heading_velocity_mps(self) -> Array:
        """Velocity (A, T, 2) along the heading."""
        return np.stack([self.speed_mps * np.cos(self.yaw_rad), self.speed_mps * np.sin(self.yaw_rad)], axis=-1)

    def rectangles(self, row: NDArray[np.intp] | int, time: NDArray[np.intp] | slice) -> Array:
        """Return footprints (n, 5) at rows and times (n,): x, y, length, width, yaw, as `rectangle_overlap` takes them."""
        xy, yaw = self.xy_m[row, time], self.yaw_rad[row, time]
        return np.column_stack([xy, np.broadcast_to(self.size_m[row, :2], xy.shape), yaw])
