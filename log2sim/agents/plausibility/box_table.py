"""Boxes of several agents at common times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent
from log2sim.geometry import Array


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
    def of(cls, agents: Sequence[Agent], t_s: Array, *, margin_s: float = 1e-6) -> BoxTable:
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
