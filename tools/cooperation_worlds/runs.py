"""What each end makes of a log alone, and both together at each level of fusion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cooperation_worlds.world import Array
from log2sim.config import Config
from log2sim.datatypes import GROUP_OF, Agent, Boxes3D, Log, Scenario
from log2sim.errors import NothingToReconstruct
from log2sim.evaluation.detection.detect_log import detect_log
from log2sim.geometry import NS_PER_S
from log2sim.pipeline import reconstruct, start

# Ways of perceiving: an end alone, or both at a level of fusion.
NAMES = {"vehicle": "vehicle alone", "road": "road alone", "points": "both, points", "boxes": "both, boxes"}
ALONE = ("vehicle", "road")
# Both LiDARs stand level, so both are searched by the network for such ones, as the ends are where their boxes are joined.
DETECTOR = "lidar:vehicle"
ROUNDED_S = 0.06  # a tick is there until its neighbors are


@dataclass(frozen=True, eq=False)
class Found:
    """What one way of perceiving made of a log."""

    scenario: Scenario | None  # none where nothing was found
    begin_s: float = 0.0  # when it begins, after the begin of the log's scene: at the middle of its first sweep

    def at(self, agent: Agent, t_s: Array) -> tuple[Array, NDArray[np.bool_]]:
        """x, y, yaw (T, 3) of an agent at times of the scene, and at which of them it was there; between waypoints straight."""
        w, t = agent.waypoints, np.asarray(t_s) - self.begin_s
        there = (t >= w.t_s[0] - ROUNDED_S) & (t <= w.t_s[-1] + ROUNDED_S)
        yaw = np.interp(t, w.t_s, np.unwrap(w.yaw_rad))
        return np.column_stack([np.interp(t, w.t_s, w.x_m), np.interp(t, w.t_s, w.y_m), yaw]), there


def settings(way: str, *, register: bool, **more: Any) -> Config:
    """Settings of a way: an end alone, or a level of fusion."""
    ends, fusion = (way, "points") if way in ALONE else ("both", way)
    cooperation = {"ends": ends, "fusion": fusion, "register_road": register}
    return Config.load(None, (), cooperation=cooperation, detect={"name": DETECTOR}, **more)


def prepared(log: Log, *, register: bool) -> Log:
    """Return a log as a run with both ends uses it: with the road's end registered, so that it is registered once for all levels."""
    return start(log, settings("points", register=True)).log if register else log


def perceive(log: Log, way: str, start_ns: int) -> Found:
    """Reconstruct the scenario of a log in one way; `start_ns` is when its scene begins."""
    try:
        scenario = reconstruct(log, settings(way, register=False)).scenario
    except NothingToReconstruct:
        return Found(None)
    return Found(scenario, (scenario.t0_ns - start_ns) / NS_PER_S)


def detect(log: Log, way: str, *, min_score: float = 0.05) -> tuple[NDArray[np.int64], tuple[Boxes3D, ...]]:
    """Detect boxes in the sweeps of a log in one way: stamps of the sweeps, and the boxes of each.

    The networks' scores are calibrated probabilities; those below `min_score` are left out.
    """
    config = settings(way, register=False, lidar={"min_score": min_score})
    found = detect_log(log, config).found
    return found.t_ns, found.boxes


def agents_near(scenario: Scenario | None, category: str) -> list[Agent]:
    """Agents of the group of a category, without the ego."""
    agents = () if scenario is None else scenario.agents
    return [a for a in agents if a.id != "ego" and GROUP_OF[a.category] == GROUP_OF[category]]
