"""The document of a page: agents as short columns of integers, in the colors of the pictures."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.datatypes import GROUP_OF, Agent, Scenario, Trajectory
from log2sim.errors import ConfigError
from log2sim.visualization.plot.roles import AgentRole, assign_roles, is_moving

# Columns are stored as whole numbers of 0.1 ms, mm, 0.1 mrad and mm/s.
SCALES = {"t_s": 1e4, "x_m": 1e3, "y_m": 1e3, "yaw_rad": 1e4, "speed_mps": 1e3, "vx_mps": 1e3, "vy_mps": 1e3}
WAYPOINT_COLUMNS = ("t_s", "x_m", "y_m", "speed_mps")
MAX_ROWS = 3_000_000
"""Waypoints of all layers together; a page with this many has about 50 MB."""


def page_document(scenario: Scenario, truth: Scenario | None = None, replay: Any = None) -> dict[str, Any]:
    """Assemble the document of a page: name, span of time and one layer each for the log, the truth and the replay.

    Raises
    ------
    ConfigError
        When there are more waypoints than a browser can be expected to hold.
    ScenarioError
        When the truth's map has another projection.
    """
    layers = {"log": list(_log(scenario))}
    if truth is not None:
        layers["truth"] = [
            _entry(a, a.waypoints, stationary=not is_moving(a), static=a.static)
            for a in truth.aligned_to(scenario).agents
        ]
    if replay is not None:
        static = {a.id: a.driver == "static" for a in replay.agents}
        layers["replay"] = [
            _entry(a, a, stationary=static[a.id], static=static[a.id]) for a in replay.agents if len(a.t_s)
        ]
    entries = [e for layer in layers.values() for e in layer]
    rows = sum(len(e["t_s"]) for e in entries)
    if rows > MAX_ROWS:
        raise ConfigError(
            f"{rows} waypoints are more than the {MAX_ROWS} that a page can hold; take fewer agents, "
            f"such as with `log2sim edit --only`"
        )
    spans = [_span(e) for name in ("log", "replay") for e in layers.get(name, ())]
    return {
        "name": scenario.name,
        "begin_s": min([0.0, *(first for first, _ in spans)]),
        "end_s": max([scenario.duration_s, *(last for _, last in spans)]),
        "origin": _origin(scenario),
        "layers": layers,
        "events": [] if replay is None else _events(replay),
    }


def _events(replay: Any) -> list[dict[str, Any]]:
    """List the collisions of a replay in order of time."""
    keys = ("t_s", "until_s", "agents", "in_log")
    return [{k: event[k] for k in keys} for event in replay.metrics.get("collisions", ())]


def _log(scenario: Scenario) -> Iterator[dict[str, Any]]:
    """Yield the scenario's agents in the order of the pictures' legend: movers with their colors, then stationary ones."""
    roles = assign_roles(scenario)
    for role in roles.movers:
        yield {**_entry(role.agent, role.agent.waypoints, stationary=False, static=False), **_colors(role)}
    for agent in roles.stationary:
        yield _entry(agent, agent.waypoints, stationary=True, static=agent.static)


def _colors(role: AgentRole) -> dict[str, Any]:
    return {"ego": True} if role.is_ego else {"color": role.color, "leading": role.leading}


def _entry(agent: Any, columns: Any, *, stationary: bool, static: bool) -> dict[str, Any]:
    """Make the entry of an agent of any layer.

    `columns` are its waypoints or the rows of a replay; `stationary` ones are drawn in muted colors.
    """
    entry = {
        "id": agent.id,
        "category": agent.category,
        "group": GROUP_OF[agent.category],
        "size_m": [round(float(v), 3) for v in agent.size_m[:2]],
        "stationary": stationary,
        "permanent": static and len(columns.t_s) == 1,  # one pose during the whole scenario
        **{k: second_differences(getattr(columns, k), scale) for k, scale in SCALES.items() if k in WAYPOINT_COLUMNS},
        "yaw_rad": second_differences(np.unwrap(columns.yaw_rad), SCALES["yaw_rad"]),
    }
    if not isinstance(agent, Agent):
        return entry
    return {**entry, **_tangents(agent.trajectory), "filled": _filled(columns.observed)}


def _tangents(trajectory: Trajectory) -> dict[str, list[int]]:
    """Return the velocities of the spline at the waypoints and the indices of steps over which the log jumps."""
    return {
        "vx_mps": second_differences(trajectory.velocity_x_mps, SCALES["vx_mps"]),
        "vy_mps": second_differences(trajectory.velocity_y_mps, SCALES["vy_mps"]),
        "jumps": np.flatnonzero(trajectory.discontinuous).tolist(),
    }


def second_differences(values: ArrayLike, scale: float) -> list[int]:
    """Compute second differences (T,) of a column in whole units of 1 / `scale`; two cumulative sums restore it exactly."""
    whole = np.rint(np.asarray(values, dtype=np.float64) * scale).astype(np.int64)
    return list(np.diff(whole, n=2, prepend=[0, 0]).tolist())


def _filled(observed: NDArray[np.bool_]) -> list[int]:
    """List the first and last waypoint of each run of segments that are not observed at both ends, one after the other."""
    gap = ~(observed[:-1] & observed[1:])
    return np.flatnonzero(np.diff(gap.astype(np.int8), prepend=0, append=0)).tolist()


def _span(entry: dict[str, Any]) -> tuple[float, float]:
    t_s = np.cumsum(np.cumsum(entry["t_s"])) / SCALES["t_s"]
    return float(t_s[0]), float(t_s[-1])


def _origin(scenario: Scenario) -> str | None:
    """Format latitude and longitude of the map's origin; None when unknown."""
    m = scenario.map
    known = m.latitude_deg is not None and m.longitude_deg is not None
    return f"{m.latitude_deg:.5f}°, {m.longitude_deg:.5f}°" if known else None
