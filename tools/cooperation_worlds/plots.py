"""Top views of worlds: the clouds of both ends by color, true boxes, and what was found."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cooperation_worlds.runs import Found
from cooperation_worlds.world import ROAD_LIDAR, VEHICLE_LIDAR, Array, World
from log2sim.datatypes import Log
from log2sim.geometry import NS_PER_S, box_corners_bev
from log2sim.perception.lidar.cloud import sweep_to_map

COLORS = {VEHICLE_LIDAR: "tab:green", ROAD_LIDAR: "tab:blue"}
FOUND = {"vehicle": "tab:green", "road": "tab:blue", "points": "tab:red", "boxes": "tab:orange", "tracks": "tab:purple"}


def plot_world(world: World, log: Log, found: dict[str, Found], path: Path, times_s: tuple[float, ...]) -> None:
    """Draw a world at some times, side by side."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    moving = world.moving
    assert moving.ego_body is not None
    figure, axes = plt.subplots(1, len(times_s), figsize=(9 * len(times_s), 9), layout="constrained")
    for axis, t_s in zip(np.atleast_1d(axes), times_s):
        for name, color in COLORS.items():
            xyz = _cloud(log, name, world.scene.start_ns, t_s)
            axis.plot(xyz[:, 0], xyz[:, 1], ",", color=color, alpha=0.5)
        for actor in (*moving.actors, moving.ego_body):
            state = actor.at([t_s])
            corners = box_corners_bev(state.center_m[:, :2], *np.array(actor.spec.box_m)[:2, None], state.yaw_rad)[0]
            target = actor.spec.id == world.target
            axis.fill(*corners.T, fill=False, ec="black", lw=2.5 if target else 1.2, ls="-" if target else "--")
            axis.annotate(actor.spec.id, state.center_m[0, :2], fontsize=7)
        for way, result in found.items():
            _draw_found(axis, result, FOUND[way], t_s)
        road = world.scene.lidar[1].position_m
        axis.plot(road[0], road[1], "^", color="tab:blue", ms=10)
        middle = moving.ego_body.at([t_s]).center_m[0]
        axis.set(xlim=(middle[0] - 48, middle[0] + 48), ylim=(middle[1] - 48, middle[1] + 48), aspect="equal")
        axis.set_title(f"{world.test} seed {world.seed}, t = {t_s:.1f} s")
    figure.savefig(path, dpi=70)
    plt.close(figure)


def _cloud(log: Log, lidar: str, start_ns: int, t_s: float) -> Array:
    stream = log.streams[lidar]
    index = int(np.abs((stream.t_ns - start_ns) / NS_PER_S - t_s).argmin())
    placed = sweep_to_map(log, lidar, stream.read(index), compensate=True)
    return np.zeros((0, 3)) if placed is None else placed[0]


def _draw_found(axis: object, result: Found, color: str, t_s: float) -> None:
    agents = () if result.scenario is None else result.scenario.agents
    for agent in agents:
        state, there = result.at(agent, np.array([t_s]))
        if agent.id != "ego" and there[0]:
            size = np.array(agent.size_m)[:2, None]
            corners = box_corners_bev(state[:, :2], *size, state[:, 2])[0]
            axis.fill(*corners.T, fill=False, ec=color, lw=1.5)  # type: ignore[attr-defined]
