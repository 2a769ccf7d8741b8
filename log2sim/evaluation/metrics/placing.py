"""A truth in the map of a scenario: shifted, reprojected, or fitted by the path of the ego."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from log2sim.datatypes import Agent, LabelView, Scenario
from log2sim.evaluation.metrics.pairs import GATE_M
from log2sim.export.placement import on_map
from log2sim.geometry import (
    NS_PER_S,
    Array,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_rpy,
    wrap_angle,
)

Move = Callable[[Array, Array], Array]
"""Takes states (N, 4), x, y, z in m and heading in rad, at times (N,), s of the truth, to those in the other map."""


def place_truth(truth: Scenario, scenario: Scenario) -> tuple[Scenario, dict[str, Any]]:
    """Bring a truth into the map of a scenario.

    Returns
    -------
    truth : Scenario
        Unchanged where both maps have the same projection; `Scenario.shift_to` does the rest.
    placement : dict
        "method", how both maps were brought together: "same_map", "projection" or "ego_path"; "ego_apart_m", the median
        distance of the egos in the end, None where not both are known.

    Raises
    ------
    ConfigError
        When positions have no coordinates in the projection of the scenario.

    Notes
    -----
    Two projections scale alike only to some tenths of a percent, 0.1 m at 50 m. What moves with time is therefore kept as it
    is around the true ego, and only the ego is reprojected. Where a georeference is missing and the egos are farther apart
    than matches may be, the truth is rotated about the vertical and shifted so that front and rear of the egos coincide best
    (least squares; Kabsch, 1976).
    """
    theirs, ours = truth.map, scenario.map
    if theirs.projection and ours.projection:
        if theirs.projection == ours.projection:
            return truth, _placement("same_map", _ego_apart_m(truth, scenario, truth.shift_to(scenario)))
        altitudes = theirs.altitude_m, ours.altitude_m
        rise_m = 0.0 if altitudes[0] is None or altitudes[1] is None else altitudes[0] - altitudes[1]
        target = on_map(theirs, ours.projection, ours.offset_m)

        def reproject(states: Array, _t_s: Array) -> Array:
            return np.asarray(target.forward(states) + np.array([0, 0, rise_m, 0]))

        method = "projection"
        far: Move = reproject
        near: Move = far if truth.ego is None else _around(truth.ego, far)
    else:
        apart_m = _ego_apart_m(truth, scenario, truth.shift_to(scenario))
        if apart_m is None or apart_m <= GATE_M:
            return truth, _placement("same_map", apart_m)
        method = "ego_path"
        near = far = _fit_egos(truth, scenario)
    moved = _moved(truth, near, far)
    moved = replace(moved, map=scenario.map)
    return moved, _placement(method, _ego_apart_m(moved, scenario, np.zeros(3)))


def describe_placement(placement: dict[str, Any]) -> str | None:
    """Say how both maps were brought together; None where they are the same."""
    if placement["method"] == "same_map":
        return None
    how = {
        "projection": "their maps have two projections: the truth was reprojected by latitude and longitude",
        "ego_path": "their maps are not the same, and no georeference joins them: the truth was put where the egos fit best",
    }[placement["method"]]
    apart_m = placement["ego_apart_m"]
    return how if apart_m is None else f"{how}; then the boxes of the egos are {apart_m:.2f} m apart (median)"


def _placement(method: str, ego_apart_m: float | None) -> dict[str, Any]:
    return {"method": method, "ego_apart_m": ego_apart_m}


def _common_egos(truth: Scenario, scenario: Scenario) -> tuple[Array, Array]:
    """Return states (K, 4) of the true ego and of the other at the times of the latter at which both are known."""
    if truth.ego is None or scenario.ego is None:
        return np.zeros((0, 4)), np.zeros((0, 4))
    t_s = scenario.ego.waypoints.t_s
    true = truth.ego.at(t_s + (scenario.t0_ns - truth.t0_ns) / NS_PER_S)
    ours = scenario.ego.at(t_s)
    both = true.valid & ours.valid
    return tuple(np.stack([s.x_m, s.y_m, s.z_m, s.yaw_rad], axis=1)[both] for s in (true, ours))  # type: ignore[return-value]


def _ego_apart_m(truth: Scenario, scenario: Scenario, shift_m: Array) -> float | None:
    true, ours = _common_egos(truth, scenario)
    gap = true[:, :2] + shift_m[:2] - ours[:, :2]
    return float(np.median(np.hypot(gap[:, 0], gap[:, 1]))) if len(gap) else None


def _fit_egos(truth: Scenario, scenario: Scenario) -> Move:
    """Return the rigid motion that puts the true ego on the other one, as well as one motion can."""
    true, ours = _common_egos(truth, scenario)
    half_m = truth.ego.size_m[0] / 2 if truth.ego is not None else 0.0
    # Both ends of the ego, so that a standing one has a heading, too.
    a, b = (
        np.concatenate(
            [s[:, :2] + end * np.stack([np.cos(s[:, 3]), np.sin(s[:, 3])], axis=1) for end in (-half_m, half_m)]
        )
        for s in (true, ours)
    )
    from_m, to_m = a.mean(axis=0), b.mean(axis=0)
    p, q = a - from_m, b - to_m
    turn = float(np.arctan2((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum(), (p * q).sum()))
    rise_m = float(np.mean(ours[:, 2] - true[:, 2]))

    def move(states: Array, _t_s: Array) -> Array:
        pivot, goal = np.array([*from_m, 0.0]), np.array([*to_m, rise_m])
        xyz = (states[:, :3] - pivot) @ rotation_from_rpy(0.0, 0.0, turn).T + goal
        return np.column_stack([xyz, states[:, 3] + turn])

    return move


def _around(ego: Agent, move: Move) -> Move:
    """Return a motion that keeps what is around the ego as it is, and moves the ego by `move`."""

    def moved(states: Array, t_s: Array) -> Array:
        s = ego.at(np.clip(t_s, ego.waypoints.t_s[0], ego.waypoints.t_s[-1]))
        before = np.stack([s.x_m, s.y_m, s.z_m, s.yaw_rad], axis=1)
        after = move(before, t_s)
        turn = after[:, 3] - before[:, 3]
        xyz = np.einsum("nij,nj->ni", rotation_from_rpy(0 * turn, 0 * turn, turn), states[:, :3] - before[:, :3])
        return np.column_stack([xyz + after[:, :3], states[:, 3] + turn])

    return moved


def _moved(truth: Scenario, near: Move, far: Move) -> Scenario:
    """Move agents and views by `near`, and what has no time by `far`."""

    def agent(a: Agent) -> Agent:
        w = a.waypoints
        x, y, z, yaw = near(np.stack([w.x_m, w.y_m, w.z_m, w.yaw_rad], axis=1), w.t_s).T
        return replace(a, waypoints=replace(w, x_m=x, y_m=y, z_m=z, yaw_rad=wrap_angle(yaw)))

    def view(v: LabelView) -> LabelView:
        states = near(np.column_stack([v.translation_m, np.zeros(len(v.t_s))]), v.t_s)
        turn = rotation_from_rpy(0 * states[:, 3], 0 * states[:, 3], states[:, 3])
        rotation = quaternion_from_rotation(turn @ rotation_from_quaternion(v.rotation_wxyz))
        return replace(v, translation_m=states[:, :3], rotation_wxyz=rotation)

    def points(xyz_m: Array) -> Array:
        return far(np.column_stack([xyz_m, np.zeros(len(xyz_m))]), np.zeros(len(xyz_m)))[:, :3]

    regions = truth.ignore_regions
    return replace(
        truth,
        agents=tuple(agent(a) for a in truth.agents),
        ignore_regions=None if regions is None else replace(regions, views=tuple(view(v) for v in regions.views)),
        map_features=None if truth.map_features is None else truth.map_features.moved(points),
        signals=tuple(replace(s, position_m=points(s.position_m[None])[0]) for s in truth.signals),
        # Cells along the axes of the truth's own map.
        provenance={key: value for key, value in truth.provenance.items() if key != "seen_ground"},
    )
