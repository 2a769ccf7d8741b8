"""What reactive agents expect of others: that they keep to their paths in the scenario, or to their motion so far."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent
from log2sim.geometry import Array, wrap_angle
from log2sim.prediction.motion_table import TICK_S, tabulate
from log2sim.prediction.smoothing import displacement, smooth_motion
from log2sim.simulation.reactive.path_table import PathTable, Pose
from log2sim.simulation.reactive.prediction import (
    Prediction,
    predict_along_path,
    predict_by_log,
    predict_policy_vehicle,
)
from log2sim.simulation.reactive.swept_corridor import HORIZON_S

FORESIGHTS = ("path", "motion")
"""`path`: others go where the scenario has them go. `motion`: they go on as they have moved so far, as who sees them for the
first time expects."""

DRIVEN_TURN_S = 0.3
"""Time constant of the turn rate of a vehicle that a policy drives: short, since simulated headings have no noise."""

Index = NDArray[np.intp]


class Foresight(Protocol):
    """Predictions (P, H) at the times of `HORIZON_S`."""

    def expect(self, agent: Index, t_s: Array, rate: Array) -> Prediction:
        """Predict agents (P,) that pass their trajectories at rates (P,), from where these are at times (P,)."""

    def expect_driven(self, agent: int, t_s: float, pose: Pose) -> Prediction:
        """Predict an agent that a policy drives, from where it is among all poses; (1, H)."""

    def expect_driven_in_scenario(self, agent: int, t_s: Array) -> Prediction:
        """Predict that agent by the same rules from where the scenario has it at times (P,)."""


class PathForesight:
    """Others go where the scenario has them go."""

    def __init__(self, paths: PathTable) -> None:
        self._paths = paths

    def expect(self, agent: Index, t_s: Array, rate: Array) -> Prediction:
        """See `Foresight`."""
        return predict_by_log(self._paths, agent, t_s, rate)

    def expect_driven(self, agent: int, t_s: float, pose: Pose) -> Prediction:
        """See `Foresight`."""
        x, y, yaw, speed = (float(c[agent]) for c in (pose.x_m, pose.y_m, pose.yaw_rad, pose.speed_mps))
        return predict_policy_vehicle(self._paths, agent, x, y, yaw, speed)

    def expect_driven_in_scenario(self, agent: int, t_s: Array) -> Prediction:
        """See `Foresight`."""
        pose = self._paths.at(np.full(len(t_s), agent), t_s)
        return predict_along_path(self._paths, agent, pose.distance_m, np.abs(pose.speed_mps))


class MotionForesight:
    """Others go on at the speed and turn rate that they had so far, smoothed as `log2sim.prediction` does."""

    def __init__(self, paths: PathTable, agents: Sequence[Agent]) -> None:
        self._paths = paths
        begin_s, end_s = float(paths.begin_s.min()), float(paths.end_s.max())
        self._begin_s = begin_s
        ticks = np.arange(int((end_s - begin_s) / TICK_S) + 1, dtype=np.float64)
        table = tabulate(agents, begin_s + TICK_S * ticks, TICK_S)
        smooth = smooth_motion(table)
        self._velocity = np.where(table.present, smooth.velocity_mps, 0.0)
        self._turn_radps = np.where(table.present, smooth.turn_radps, 0.0)
        self._seen: tuple[float, float] | None = None
        self._driven_radps = 0.0

    def expect(self, agent: Index, t_s: Array, rate: Array) -> Prediction:
        """See `Foresight`."""
        pose = self._paths.at(agent, t_s)
        since = (t_s - self._begin_s) / TICK_S + 1e-6
        tick = np.clip(since.astype(np.intp), 0, self._turn_radps.shape[1] - 1)
        turn = self._turn_radps[agent, tick]
        turned = np.exp(1j * turn * np.clip(since - tick, 0.0, 1.0) * TICK_S)
        return _go_on(pose, np.asarray(self._velocity[agent, tick] * turned * rate), turn * rate)

    def expect_driven(self, agent: int, t_s: float, pose: Pose) -> Prediction:
        """See `Foresight`."""
        one = Pose(*(np.asarray(c)[agent : agent + 1] for c in pose))
        yaw = float(one.yaw_rad[0])
        if self._seen is None or not t_s > self._seen[0]:  # it begins, or begins again
            self._driven_radps = 0.0
        else:
            step_s = t_s - self._seen[0]
            rate = float(wrap_angle(yaw - self._seen[1])) / step_s
            self._driven_radps += (rate - self._driven_radps) * -np.expm1(-step_s / DRIVEN_TURN_S)
        self._seen = t_s, yaw
        return _go_on(one, one.speed_mps * np.exp(1j * one.yaw_rad), np.array([self._driven_radps]))

    def expect_driven_in_scenario(self, agent: int, t_s: Array) -> Prediction:
        """See `Foresight`."""
        return self.expect(np.full(len(t_s), agent), t_s, np.ones(len(t_s)))


def _go_on(pose: Pose, velocity: NDArray[np.complex128], turn_radps: Array) -> Prediction:
    """Go on from poses (P,) with velocities (P,) that turn at rates (P,)."""
    way = displacement(velocity[:, None], turn_radps[:, None], HORIZON_S)
    yaw = pose.yaw_rad[:, None] + turn_radps[:, None] * HORIZON_S
    speed = np.copysign(np.abs(velocity), pose.speed_mps)[:, None]
    return pose.x_m[:, None] + way.real, pose.y_m[:, None] + way.imag, yaw, np.broadcast_to(speed, yaw.shape)
