"""In which frames the color of each vehicle can be seen: near, large, inside the picture, and not behind others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, Log, Scenario
from log2sim.geometry import MIN_DEPTH_M, NS_PER_S, Array, Camera, inverse, project

# Pictures in turn differ little: light and direction change over meters, which takes about this long.
MIN_STEP_S = 0.5
MAX_VIEWS = 8  # of an agent; more do not change a median
MIN_HEIGHT_PX = 20.0  # doors are a third of the height: six lines of pixels


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes of agents at several times.

    Attributes
    ----------
    agents : sequence of Agent
    center : (A, F, 3) float64, m, map frame
        NaN while an agent is not there.
    yaw : (A, F) float64
    size : (A, 3) float64, m
    """

    agents: Sequence[Agent]
    center: Array
    yaw: Array
    size: Array

    def at(self, k: int) -> Boxes:
        """Return the boxes at one of the times."""
        return Boxes(self.agents, self.center[:, k : k + 1], self.yaw[:, k : k + 1], self.size)


def boxes_at(agents: Sequence[Agent], t_s: Array) -> Boxes:
    """Return the boxes of agents at times (F,), s, of the scenario."""
    center, yaw = np.full((len(agents), len(t_s), 3), np.nan), np.full((len(agents), len(t_s)), np.nan)
    for k, agent in enumerate(agents):
        w = agent.waypoints
        if agent.is_permanent:
            center[k], yaw[k] = [w.x_m[0], w.y_m[0], w.z_m[0]], w.yaw_rad[0]
        else:
            states = agent.at(t_s)
            center[k] = np.stack([states.x_m, states.y_m, states.z_m], axis=-1)
            yaw[k] = states.yaw_rad
    return Boxes(agents, center, yaw, np.array([a.size_m for a in agents], float).reshape(-1, 3))


def choose_views(log: Log, scenario: Scenario, wanted: Sequence[str]) -> dict[str, dict[int, list[str]]]:
    """Choose frames in which to look at agents.

    Parameters
    ----------
    wanted : sequence of str
        Ids of the agents.

    Returns
    -------
    dict of str to dict of int to list of str
        By camera and index of the frame: ids of the agents to look at there.
    """
    agents = scenario.others
    rows = [k for k, agent in enumerate(agents) if agent.id in set(wanted)]
    scores: list[tuple[str, int, Array]] = []
    for name, camera in log.cameras.items():
        frames = _spaced(log.streams[name].t_ns) if name in log.streams else np.zeros(0, np.int64)
        t_ns = log.streams[name].t_ns[frames] if len(frames) else frames
        poses, known = log.map_T_sensor(name, t_ns) if len(frames) else (np.zeros((0, 4, 4)), np.zeros(0, bool))
        boxes = boxes_at(agents, (t_ns - scenario.t0_ns) / NS_PER_S)
        for k in np.flatnonzero(known):
            score = _clear_heights(camera, inverse(poses[k]), boxes.center[:, k], boxes.size)
            scores.append((name, int(frames[k]), score))
    return _best_views(scores, [(row, agents[row].id) for row in rows])


def _spaced(t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return indices of frames that are `MIN_STEP_S` apart or somewhat more."""
    if len(t_ns) == 0:
        return np.zeros(0, np.int64)
    slot = (t_ns - t_ns[0]) // round(MIN_STEP_S * NS_PER_S)
    return np.unique(slot, return_index=True)[1].astype(np.int64)


def _clear_heights(camera: Camera, cam_T_map: Array, center: Array, size: Array) -> Array:
    """Return the heights (A,), px, of agents in a picture, times the share of their widths that nothing nearer hides; 0 outside."""
    points = center @ cam_T_map[:3, :3].T + cam_T_map[:3, 3]
    with np.errstate(invalid="ignore"):
        ahead = points[:, 2] > MIN_DEPTH_M
    uv = np.full((len(points), 2), np.nan)
    uv[ahead] = project(camera, points[ahead])[0]
    out = np.zeros(len(points))
    with np.errstate(invalid="ignore"):
        inside = (uv > 0).all(axis=1) & (uv[:, 0] < camera.width_px) & (uv[:, 1] < camera.height_px)
    depth = points[:, 2]
    rows = np.flatnonzero(inside)
    half = camera.K[0, 0] * (size[rows, 0] + size[rows, 1]) / 4 / depth[rows]
    left, right = uv[rows, 0] - half, uv[rows, 0] + half
    for k, row in enumerate(rows):
        hidden = 0.0
        nearer = (depth[rows] < depth[row]) & (left < right[k]) & (right > left[k])
        for j in np.flatnonzero(nearer):
            hidden = max(hidden, (min(right[k], right[j]) - max(left[k], left[j])) / (right[k] - left[k]))
        out[row] = camera.K[1, 1] * size[row, 2] / depth[row] * (1 - hidden)
    return out


def _best_views(scores: list[tuple[str, int, Array]], wanted: list[tuple[int, str]]) -> dict[str, dict[int, list[str]]]:
    table = np.array([score for _, _, score in scores]).reshape(len(scores), -1)
    views: dict[str, dict[int, list[str]]] = {}
    for row, agent in wanted:
        order = np.argsort(-table[:, row], kind="stable")[:MAX_VIEWS] if len(table) else np.zeros(0, np.intp)
        for k in order.tolist():
            if table[k, row] >= MIN_HEIGHT_PX:
                name, index, _ = scores[k]
                views.setdefault(name, {}).setdefault(index, []).append(agent)
    return views


def frames_of(views: Mapping[str, Mapping[int, Sequence[str]]]) -> dict[str, NDArray[np.int64]]:
    """Return the indices of the frames of views by camera, in order."""
    return {name: np.array(sorted(frames), np.int64) for name, frames in views.items()}
