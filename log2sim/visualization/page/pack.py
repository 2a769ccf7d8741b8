"""What the page is given: agents as short columns of integers, in the colors of the pictures."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.datatypes import GROUP_OF, Scenario
from log2sim.errors import ConfigError
from log2sim.visualization.plot.roles import Role, assign, moves

# Columns are stored as whole numbers of 0.1 ms, mm, 0.1 mrad and mm/s.
SCALES = {"t_s": 1e4, "x_m": 1e3, "y_m": 1e3, "yaw_rad": 1e4, "speed_mps": 1e3}
MOST_ROWS = 3_000_000
"""Waypoints of all layers together; a page of so many has about 50 MB."""


def pack(scenario: Scenario, truth: Scenario | None = None, replay: Any = None) -> dict[str, Any]:
    """The document of a page: name, span of time and one layer each for the log, the truth and the replay.

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
            _entry(a, a.waypoints, standing=not moves(a), static=a.static) for a in truth.aligned_to(scenario).agents
        ]
    if replay is not None:
        stand = {a.id: a.driver == "static" for a in replay.agents}
        layers["replay"] = [_entry(a, a, standing=stand[a.id], static=stand[a.id]) for a in replay.agents if len(a.t_s)]
    entries = [e for layer in layers.values() for e in layer]
    rows = sum(len(e["t_s"]) for e in entries)
    if rows > MOST_ROWS:
        raise ConfigError(
            f"{rows} waypoints are more than the {MOST_ROWS} that a page can hold; take fewer agents, "
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
    """Collisions of a replay in order of time."""
    keys = ("t_s", "until_s", "agents", "in_log")
    return [{k: event[k] for k in keys} for event in replay.metrics.get("collisions", ())]


def _log(scenario: Scenario) -> Iterator[dict[str, Any]]:
    """Entries of the scenario's agents in the order of the pictures' legend: movers with their colors, then what stands."""
    cast = assign(scenario)
    for role in cast.movers:
        yield {**_entry(role.agent, role.agent.waypoints, standing=False, static=False), **_colors(role)}
    for agent in cast.standing:
        yield _entry(agent, agent.waypoints, standing=True, static=agent.static)


def _colors(role: Role) -> dict[str, Any]:
    return {"ego": True} if role.is_ego else {"color": role.color, "leading": role.leading}


def _entry(agent: Any, columns: Any, *, standing: bool, static: bool) -> dict[str, Any]:
    """An agent of any layer, `columns` being its waypoints or the rows of a replay; `standing` ones are drawn quietly."""
    entry = {
        "id": agent.id,
        "category": agent.category,
        "group": GROUP_OF[agent.category],
        "size_m": [round(float(v), 3) for v in agent.size_m[:2]],
        "standing": standing,
        "always": static and len(columns.t_s) == 1,  # one pose for good
        **{k: shortened(getattr(columns, k), scale) for k, scale in SCALES.items() if k != "yaw_rad"},
        "yaw_rad": shortened(np.unwrap(columns.yaw_rad), SCALES["yaw_rad"]),
    }
    observed = getattr(columns, "observed", None)
    return entry if observed is None else {**entry, "filled": _filled(observed)}


def shortened(values: ArrayLike, scale: float) -> list[int]:
    """Second differences of a column (T,) in whole units of 1 / `scale`; summed up twice they give it back exactly."""
    whole = np.rint(np.asarray(values, dtype=np.float64) * scale).astype(np.int64)
    return np.diff(whole, n=2, prepend=[0, 0]).tolist()


def _filled(observed: NDArray[np.bool_]) -> list[int]:
    """First and last waypoint of each stretch between waypoints that were not both observed, one after the other."""
    gap = ~(observed[:-1] & observed[1:])
    return np.flatnonzero(np.diff(gap.astype(np.int8), prepend=0, append=0)).tolist()


def _span(entry: dict[str, Any]) -> tuple[float, float]:
    t_s = np.cumsum(np.cumsum(entry["t_s"])) / SCALES["t_s"]
    return float(t_s[0]), float(t_s[-1])


def _origin(scenario: Scenario) -> str | None:
    """Where on Earth the map's origin lies, for people."""
    m = scenario.map
    known = m.latitude_deg is not None and m.longitude_deg is not None
    return f"{m.latitude_deg:.5f}°, {m.longitude_deg:.5f}°" if known else None
