"""Corrections by hand: a file of them, applied to a scenario as evidence.

A correction names its agent by where it is at a time, so that it holds when the log is reconstructed again with other settings
or by a later version. One that no longer finds its agent is told.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from log2sim.datatypes import EGO, TYPICAL_SIZE_M, Agent, MapFeatures, Marking, RoadBorder, Scenario, Waypoints
from log2sim.datatypes.agent import STANDSTILL_MPS, hermite, hermite_slope
from log2sim.datatypes.scenario import BORDER_KINDS
from log2sim.edit.edits import STEP_S, ground_at, insert_steps, new_id, resampled
from log2sim.errors import ConfigError, ScenarioError
from log2sim.files.documents import check, read_json
from log2sim.geometry import NS_PER_S, Array, wrap_angle

# How far a stored point may be from its agent in a later run: errors of the place and of the click, less than half the gap between parked cars.
MAX_AWAY_M = 1.0
# A later run may begin or end a track by some ticks.
MAX_OUTSIDE_S = 1.0
# No camera or LiDAR shows an object beyond this.
MAX_BEYOND_M = 1000.0
# Errors of a trajectory are alike for about this long, as long as the same side of the object is seen.
CORRELATION_S = 2.0
# Some pixels of a map in which a car fills a tenth of the screen.
POSE_SIGMA_M, POSE_SIGMA_RAD = 0.05, 0.02
# Where a scenario does not state how sure a heading is; of a box in a LiDAR sweep.
YAW_SIGMA_RAD = 0.05
# White acceleration of a road user between two parts of its track, m/s2 over 1 s, as of everyday braking.
BRIDGE_ACCELERATION = 1.5
PAINT_WIDTH_M = 0.15
# What each kind of correction settles.
SETTLED = {
    "flip": {"heading_ambiguous", "reversing"}, "size": {"unlikely_size"}, "category": {"unlikely_size", "speed"},
    "split": {"jump"}, "merge": {"jump", "passes_through"},
    "move": {"jump", "empty", "in_ego", "passes_through", "sideways"},
}  # fmt: skip
SINGLE = ("category", "size", "color", "flip")


@dataclass(frozen=True, eq=False)
class Corrected:
    """The corrected scenario, and a line for each correction that did not find what it is about."""

    scenario: Scenario
    unmatched: tuple[str, ...]


def load_corrections(path: Path | str) -> dict[str, Any]:
    """Read a file of corrections.

    Raises `ScenarioError` when it is no JSON, of another version, or a correction lacks what its kind needs.
    """
    document = read_json(path, ScenarioError)
    try:
        check(document, "corrections-1", ScenarioError)
    except ScenarioError as error:
        raise ScenarioError(f"{path}: {error}") from None
    return dict(document)


def correct(scenario: Scenario, corrections: Mapping[str, Any]) -> Corrected:
    """Apply corrections in the order of the file.

    Raises `ConfigError` when two corrections contradict each other, or one cannot be: a split outside of an agent's life.
    Raises `ScenarioError` when they are of another log: its name differs, and none of them finds what it is about.

    `corrections`: a document of `schemas/corrections-1.json`, as `load_corrections` returns it. Returns the scenario, with the
    corrections that were applied and the digest of its source appended to `provenance["corrections"]`.
    """
    draft = _Draft(scenario, corrections.get("map_offset_m"))
    unmatched, applied = [], []
    for number, entry in enumerate(corrections["corrections"], 1):
        missing = draft.apply(number, entry)
        if missing:
            unmatched.append(f"correction {number} ({entry['kind']}): {missing}")
        else:
            applied.append(dict(entry))
    name = corrections.get("log", scenario.name)
    if unmatched and not applied and name != scenario.name:
        raise ScenarioError(
            f"the corrections are of log '{name}', the scenario is of '{scenario.name}': none of them finds what it is about; {unmatched[0]}"
        )
    history = [*scenario.provenance.get("corrections", []), {"source_digest": scenario.digest, "corrections": applied}]
    return Corrected(draft.result(history), tuple(unmatched))


class _Draft:
    """A scenario while it is corrected: agents by id, features of the map, and the values that corrections gave to each agent."""

    def __init__(self, scenario: Scenario, offset_m: Sequence[float] | None) -> None:
        self.scenario = scenario
        self.agents = {a.id: a for a in scenario.agents}
        self.deleted: dict[str, Agent] = {}
        self.features = scenario.map_features or MapFeatures()
        self.given: dict[tuple[str, str], tuple[int, Any]] = {}
        # By id: an agent as its last move left it, as it was before its moves, and their poses.
        self.moves: dict[str, tuple[Agent | None, Agent, list[dict[str, float]]]] = {}
        self.shift = np.zeros(3) if offset_m is None else np.array(offset_m) - np.array(scenario.map.offset_m)

    def result(self, history: list[Any]) -> Scenario:
        provenance = {**self.scenario.provenance, "corrections": history}
        features = self.features if self.features or self.scenario.map_features is not None else None
        known, end_s = {a.id for a in self.scenario.agents}, self.scenario.duration_s
        agents = tuple(
            # An added agent that was put at one place stands there all the time.
            replace(a, waypoints=replace(a.waypoints.take(np.zeros(2, dtype=np.intp)), t_s=np.array([0.0, end_s])))
            if a.is_permanent and a.id not in known and end_s > 0
            else a
            for a in self.agents.values()
        )
        end_s = max((float(a.waypoints.t_s[-1]) for a in agents), default=0.0)
        duration_s = max(self.scenario.duration_s, end_s)
        return replace(
            self.scenario, agents=agents, map_features=features, provenance=provenance, duration_s=duration_s, tags=None
        )

    def apply(self, number: int, entry: Mapping[str, Any]) -> str:
        """Apply one correction; return what it did not find, "" where it is done."""
        kind = entry["kind"]
        if outside := self._outside(entry):
            return outside
        if kind == "draw":
            points = np.array(entry["points_m"], dtype=np.float64) + self.shift
            name = new_id("drawn", {item.id for item in self._items})
            if entry["feature"] in BORDER_KINDS:
                border = RoadBorder(name, entry["feature"], points)
                self.features = replace(self.features, borders=(*self.features.borders, border))
            else:
                marking = Marking(name, entry["feature"], points, float(entry.get("width_m", PAINT_WIDTH_M)))
                self.features = replace(self.features, markings=(*self.features.markings, marking))
            return ""
        if kind == "erase":
            return self._erase(np.array(entry["at"]) + self.shift)
        if kind == "add":
            # On the ground that the agents nearest to its poses stand on where these have no height.
            category, poses = entry["category"], self._poses(entry)
            size = entry.get("size_m") or TYPICAL_SIZE_M[category]
            x, y = (np.array([p[k] for p in poses]) for k in ("x_m", "y_m"))
            ground = ground_at(self.agents.values(), x, y) if self.agents else np.zeros(len(poses))
            poses = [{"z_m": z + size[2] / 2, **p} for p, z in zip(poses, ground)]
            name = new_id(category, {*self.agents, *self.deleted})
            self.agents[name] = added(category, size, poses, name)
            return ""
        agent_id = self._find(number, entry["agent"])
        if agent_id is None:
            return f"no agent within {MAX_AWAY_M:g} m of {self._place(entry['agent'])}"
        agent = self.agents[agent_id]
        if kind in SINGLE:
            value = {k: entry.get(k) for k in ("category", "size_m", "rgb", "name")}
            earlier = self.given.setdefault((agent_id, kind), (number, value))
            if earlier[1] != value:
                raise ConfigError(
                    f"corrections {earlier[0]} and {number} contradict each other: two values of '{kind}' for {agent_id}"
                )
        if kind == "delete":
            self.deleted[agent_id] = self.agents.pop(agent_id)
        elif kind == "merge":
            other_id = self._find(number, entry["other"])
            if other_id is None or other_id == agent_id:
                what = "that is the same agent" if other_id else "no agent"
                return f"{what} within {MAX_AWAY_M:g} m of {self._place(entry['other'])}"
            self.agents[agent_id] = settled(merge_agents(agent, self.agents.pop(other_id)), kind)
        elif kind == "split":
            w, t_s = agent.waypoints, self._time_s(entry["t_ns"])
            if not w.t_s[0] < t_s <= w.t_s[-1]:
                raise ConfigError(f"split: {agent.id} has no waypoints on both sides of {t_s:.2f} s")
            self.agents[agent_id] = settled(replace(agent, waypoints=w.take(w.t_s < t_s)), kind)
            name = new_id(agent.category, {*self.agents, *self.deleted})
            self.agents[name] = settled(replace(agent, id=name, waypoints=w.take(w.t_s >= t_s)), kind)
        elif kind == "confirm":
            self.agents[agent_id] = replace(agent, confidence=1.0, doubts=(), quarantined=False)
        elif kind == "move":
            # Moves one after the other are measurements of one trajectory, as if they were one.
            last, before, known = self.moves.get(agent_id, (None, agent, []))
            before, known = (before, known) if last is agent else (agent, [])
            poses = list({p["t_s"]: p for p in (*known, *self._poses(entry))}.values())
            poses.sort(key=lambda p: p["t_s"])
            self.agents[agent_id] = settled(moved(before, poses, float(entry.get("over_s", CORRELATION_S))), kind)
            self.moves[agent_id] = self.agents[agent_id], before, poses
        else:
            w = agent.waypoints
            if kind == "category":
                agent = replace(agent, category=entry["category"])
            elif kind == "size":
                length, width, height = map(float, entry["size_m"])
                raised = replace(w, z_m=w.z_m + (height - agent.size_m[2]) / 2)  # the wheels stay on the ground
                agent = replace(agent, size_m=(length, width, height), waypoints=raised)
            elif kind == "flip":
                turned = replace(w, yaw_rad=wrap_angle(w.yaw_rad + np.pi), speed_mps=-w.speed_mps)
                agent = replace(agent, waypoints=turned)
            else:
                color = {"rgb": list(entry["rgb"]), "name": entry["name"], "confidence": 1.0}
                agent = replace(agent, color=color)
            self.agents[agent_id] = settled(agent, kind)
        return ""

    def _outside(self, entry: Mapping[str, Any]) -> str:
        """Say which place or time of a correction is outside of the map or the scenario; "" where none is."""
        poses = self._poses(entry) if "poses" in entry else []
        late_s = max((max(-p["t_s"], p["t_s"] - self.scenario.duration_s) for p in poses), default=0.0)
        if late_s > MAX_OUTSIDE_S:
            return f"a pose is {late_s:.1f} s before the beginning or after the end of the scenario"
        points = [
            *(np.array(p[:2]) + self.shift[:2] for p in entry.get("points_m", ())),
            *([p["x_m"], p["y_m"]] for p in poses),
        ]
        known = [np.stack([a.waypoints.x_m, a.waypoints.y_m], axis=1) for a in self.agents.values()]
        if not points or not known:
            return ""
        low, high = (f(np.concatenate(known), axis=0) for f in (np.min, np.max))
        away_m = float(np.max([np.maximum(low - points, points - high)]))
        return f"its path lies outside of the map, {away_m:.0f} m from all agents" if away_m > MAX_BEYOND_M else ""

    def _find(self, number: int, at: Mapping[str, Any]) -> str | None:
        """Return the id of the agent whose box is nearest to a place at a time; None where none is near enough."""
        t_s, x, y = self._time_s(at["t_ns"]), at["x_m"] + self.shift[0], at["y_m"] + self.shift[1]
        found = nearest_agent([a for a in self.agents.values() if a.id != EGO], t_s, x, y)
        if found is None:
            gone = nearest_agent(list(self.deleted.values()), t_s, x, y)
            if gone is not None:
                raise ConfigError(
                    f"correction {number} changes {gone}, which an earlier correction deletes; drop one of the two"
                )
        return found

    def _place(self, at: Mapping[str, Any]) -> str:
        return f"({at['x_m']:.1f}, {at['y_m']:.1f}) m at {self._time_s(at['t_ns']):.2f} s"

    def _time_s(self, t_ns: int) -> float:
        return (t_ns - self.scenario.t0_ns) / NS_PER_S

    def _poses(self, entry: Mapping[str, Any]) -> list[dict[str, float]]:
        """Return key poses in time and map of the scenario, in the order of time."""
        shift = dict(zip(("x_m", "y_m", "z_m"), self.shift))
        poses = [
            {"t_s": self._time_s(p["t_ns"]), **{k: p[k] + shift.get(k, 0.0) for k in p if k != "t_ns"}}
            for p in entry["poses"]
        ]
        return list({p["t_s"]: p for p in sorted(poses, key=lambda p: p["t_s"])}.values())

    @property
    def _items(self) -> list[Marking | RoadBorder]:
        return [*self.features.markings, *self.features.borders]

    def _erase(self, at: Array) -> str:
        import shapely

        items = self._items
        far = [shapely.LineString(item.points_m[:, :2]).distance(shapely.Point(at[:2])) for item in items]
        if not far or min(far) > MAX_AWAY_M:
            return f"no marking or border within {MAX_AWAY_M:g} m of ({at[0]:.1f}, {at[1]:.1f}) m"
        gone = items[int(np.argmin(far))].id
        markings = tuple(m for m in self.features.markings if m.id != gone)
        borders = tuple(b for b in self.features.borders if b.id != gone)
        lanes = []
        for lane in self.features.lanes:
            left, right = (None if name == gone else name for name in (lane.left, lane.right))
            lanes.append(replace(lane, left=left, right=right))
        self.features = replace(self.features, markings=markings, borders=borders, lanes=tuple(lanes))
        return ""


def nearest_agent(agents: Sequence[Agent], t_s: float, x_m: float, y_m: float) -> str | None:
    """Return the id of the agent whose box at a time is nearest to a place, of several the one whose center is; None beyond `MAX_AWAY_M`."""
    best: tuple[float, float, str] | None = None
    for agent in agents:
        w = agent.waypoints
        if not agent.is_permanent and not w.t_s[0] - MAX_OUTSIDE_S <= t_s <= w.t_s[-1] + MAX_OUTSIDE_S:
            continue
        s = agent.trajectory.at(np.array([t_s]))
        dx, dy, yaw = x_m - s.x_m[0], y_m - s.y_m[0], s.yaw_rad[0]
        along, across = abs(dx * np.cos(yaw) + dy * np.sin(yaw)), abs(dy * np.cos(yaw) - dx * np.sin(yaw))
        outside = np.hypot(max(along - agent.size_m[0] / 2, 0.0), max(across - agent.size_m[1] / 2, 0.0))
        if outside <= MAX_AWAY_M and (best is None or (outside, np.hypot(dx, dy)) < best[:2]):
            best = float(outside), float(np.hypot(dx, dy)), agent.id
    return None if best is None else best[2]


def settled(agent: Agent, kind: str) -> Agent:
    """Return the agent without the doubts that a kind of correction settles."""
    return replace(agent, doubts=tuple(d for d in agent.doubts if d.kind not in SETTLED.get(kind, ())))


def moved(agent: Agent, poses: Sequence[Mapping[str, float]], over_s: float = CORRELATION_S) -> Agent:
    """Return the agent with key poses as further measurements of its trajectory.

    The error of the trajectory is a Gaussian process with the stated sigmas and a Matern covariance (smoothness 3/2) of
    correlation time `over_s`; of a static agent it is the same at all times. A single pose of sigma s moves the place at its
    time by the Kalman gain sigma^2 / (sigma^2 + s^2) of its distance (Rasmussen and Williams, "Gaussian Processes for Machine
    Learning", 2006, section 2.2), and less before and after. Where the poses contradict the stated sigmas, there is a
    further error, equally large at all times, which grows until the distance is as expected. A static agent that they put at
    different places moves through them; the track of a moving one goes on to poses before its begin and after its end.
    """
    if not agent.static:
        agent, poses = _extended(agent, poses)
        if not poses:
            return agent
    key_s = np.array([p["t_s"] for p in poses])
    w = agent.waypoints
    apart_m = np.ptp([[p["x_m"], p["y_m"]] for p in poses], axis=0).max()
    if agent.static and apart_m > 3 * POSE_SIGMA_M:
        path = [{"z_m": float(w.z_m[0]), **p} for p in poses]
        for at, t_s, step in ((0, float(w.t_s[0]), 1), (-1, float(w.t_s[-1]), -1)):
            if (key_s[at] - t_s) * step > 1e-6:  # straight on to the end of its life
                f = (t_s - key_s[at]) / (key_s[at + step] - key_s[at])
                x, y = (path[at][k] + f * (path[at + step][k] - path[at][k]) for k in ("x_m", "y_m"))
                far = POSE_SIGMA_M + float(np.hypot(x - path[at]["x_m"], y - path[at]["y_m"]))
                end = {"t_s": t_s, "x_m": x, "y_m": y, "z_m": path[at]["z_m"], "sigma_m": far}
                path.insert(0 if at == 0 else len(path), end)
                key_s = np.array([p["t_s"] for p in path])
        through = added(agent.category, agent.size_m, path, agent.id)
        return replace(agent, static=False, waypoints=through.waypoints)
    if not agent.static:
        inside = key_s[(key_s > w.t_s[0]) & (key_s < w.t_s[-1])]
        steps = np.unique(np.concatenate([insert_steps(w, float(w.t_s[0]), float(w.t_s[-1])), inside]))
        w = resampled(agent, steps[np.concatenate([[True], np.diff(steps) > 1e-6])])

    def correlation(a: Array, b: Array) -> Array:
        apart = np.zeros((len(a), len(b))) if agent.static else np.sqrt(3) * np.abs(a[:, None] - b) / over_s
        return np.asarray((1 + apart) * np.exp(-apart))

    def posterior(sigma: Array, offset: Array, noise: Array, at: Array) -> tuple[Array, Array]:
        """Return the mean offsets (T, axes) and the standard deviations (T,) after offsets (K, axes) at times `at` (K,)."""
        at_key = np.interp(at, w.t_s, sigma)
        prior, more = at_key[:, None] * at_key, 0.0
        for _ in range(50):
            covariance = (prior + more) * correlation(at, at) + np.diag(noise**2)
            squared = float(np.sum(offset * np.linalg.solve(covariance, offset))) / offset.size
            if squared <= 1.01:
                break
            stated = float(np.mean(at_key**2))
            more = (stated + more) * squared - stated
        cross = (sigma[:, None] * at_key + more) * correlation(w.t_s, at)
        inverse = np.linalg.inv(covariance)
        left = sigma**2 + more - np.einsum("tk,kl,tl->t", cross, inverse, cross)
        return cross @ inverse @ offset, np.sqrt(np.maximum(left, 1e-6**2))

    here = agent.trajectory.at(key_s)
    offset = np.array([[p["x_m"], p["y_m"]] for p in poses]) - np.stack([here.x_m, here.y_m], axis=1)
    noise = np.array([p.get("sigma_m", POSE_SIGMA_M) for p in poses])
    shift, sigma_xy = posterior(np.maximum(w.sigma_xy_m, 1e-3), offset, noise, key_s)
    turn, sigma_yaw = np.zeros(len(w)), np.full(len(w), YAW_SIGMA_RAD) if w.sigma_yaw_rad is None else w.sigma_yaw_rad
    turned = [k for k, p in enumerate(poses) if "yaw_rad" in p]
    if turned:
        angle = wrap_angle(np.array([poses[k]["yaw_rad"] for k in turned]) - here.yaw_rad[turned])[:, None]
        noise = np.array([poses[k].get("sigma_rad", POSE_SIGMA_RAD) for k in turned])
        mean, sigma_yaw = posterior(np.maximum(sigma_yaw, 1e-4), angle, noise, key_s[turned])
        turn = mean[:, 0]
    yaw, speed = w.yaw_rad, w.speed_mps
    if not agent.static and len(w) > 1:
        velocity = np.stack([speed * np.cos(yaw), speed * np.sin(yaw)], axis=1)
        after = velocity + np.gradient(shift, w.t_s, axis=0)
        moves = (np.abs(speed) > STANDSTILL_MPS) & (np.hypot(*after.T) > STANDSTILL_MPS)
        swing = wrap_angle(np.arctan2(after[:, 1], after[:, 0]) - np.arctan2(velocity[:, 1], velocity[:, 0]))
        if not turned:  # the heading follows the way
            turn = np.where(moves, swing, 0.0)
        speed = np.where(moves, np.sign(speed) * np.hypot(*after.T), speed)
    waypoints = replace(
        w, x_m=w.x_m + shift[:, 0], y_m=w.y_m + shift[:, 1], yaw_rad=wrap_angle(yaw + turn), speed_mps=speed, sigma_xy_m=sigma_xy,
        sigma_yaw_rad=sigma_yaw, visible=None, lidar_points=None,
    )  # fmt: skip
    return replace(agent, waypoints=waypoints)


def _extended(agent: Agent, poses: Sequence[Mapping[str, float]]) -> tuple[Agent, list[Mapping[str, float]]]:
    """Return the agent as it goes on through the poses outside of its life, and the other poses."""
    w = agent.waypoints
    early = [p for p in poses if p["t_s"] < w.t_s[0] - 1e-6]
    late = [p for p in poses if p["t_s"] > w.t_s[-1] + 1e-6]
    for at, outside in ((0, early), (-1, late)):
        if outside:
            end = {k: float(getattr(w, k)[at]) for k in ("t_s", "x_m", "y_m", "z_m")}
            velocity = float(w.speed_mps[at]) * np.array([np.cos(w.yaw_rad[at]), np.sin(w.yaw_rad[at]), 0.0])
            path = sorted([end, *({"z_m": end["z_m"], **p} for p in outside)], key=lambda p: p["t_s"])
            ends = ((2, np.zeros(3)), (1, velocity)) if at == 0 else ((1, velocity), (2, np.zeros(3)))
            more = added(agent.category, agent.size_m, path, agent.id, ends).waypoints
            more = more.take(more.t_s < end["t_s"] if at == 0 else more.t_s > end["t_s"])
            parts = [p.columns() for p in ((w, more) if at else (more, w))]
            w = Waypoints(**{k: np.concatenate([part[k] for part in parts]) for k in parts[0] if k in parts[1]})
    return replace(agent, waypoints=w), [p for p in poses if p not in early and p not in late]


def merge_agents(agent: Agent, other: Agent) -> Agent:
    """Return one agent of two tracks of the same object, under the id of the first.

    Where both have states the mean by their variances stands. A gap is bridged by the cubic through the places and velocities
    at its ends, the mean of a motion of white acceleration, whose variance is a^2 s^3 (T - s)^3 / (3 T^3) at time s of T.
    """
    longer = max((agent, other), key=lambda a: (int(a.waypoints.observed.sum()), np.ptp(a.waypoints.t_s)))
    static = agent.static and other.static
    if static:
        waypoints = _mean_of_static(agent.waypoints, other.waypoints)
    else:
        stepped = []  # with steps of a tenth of a second, so that the two can be averaged
        for a in (agent, other):
            t_s = insert_steps(a.waypoints, float(a.waypoints.t_s[0]), float(a.waypoints.t_s[-1]))
            stepped.append(replace(a, waypoints=resampled(a, t_s)) if len(t_s) > 1 else a)
        waypoints = _joined(*sorted(stepped, key=lambda a: float(a.waypoints.t_s[0])))
    doubts = tuple(dict.fromkeys(d for a in (agent, other) for d in a.doubts))
    sides = {**agent.observed_by, **other.observed_by}
    seen = {side: (*agent.observed_by.get(side, ()), *other.observed_by.get(side, ())) for side in sides}
    return replace(
        longer, id=agent.id, waypoints=waypoints, static=static, doubts=doubts, confidence=max(agent.confidence, other.confidence),
        quarantined=agent.quarantined and other.quarantined, color=longer.color or agent.color or other.color,
        observed_by={side: tuple(sorted(spans)) for side, spans in seen.items()},
    )  # fmt: skip


def _mean_of_static(a: Waypoints, b: Waypoints) -> Waypoints:
    """Return one place that never changes, over the times of both."""
    weight = np.array([1 / max(float(w.sigma_xy_m.min()), 1e-3) ** 2 for w in (a, b)])
    precision = weight[0] + weight[1]
    weight = weight / weight.sum()
    turn = float(wrap_angle(b.yaw_rad[:1] - a.yaw_rad[0])[0])
    long = a if len(a) > 1 or len(b) == 1 else b
    t_s = np.unique(np.concatenate([a.t_s, b.t_s])) if len(a) > 1 and len(b) > 1 else long.t_s
    place = {k: np.full(len(t_s), weight @ [getattr(w, k)[0] for w in (a, b)]) for k in ("x_m", "y_m", "z_m")}
    known = [np.interp(t_s, w.t_s, w.observed.astype(np.float64), left=0.0, right=0.0) > 0.5 for w in (a, b)]
    sigma = np.full(len(t_s), 1 / np.sqrt(precision))
    yaw = np.full(len(t_s), float(wrap_angle(a.yaw_rad[:1] + weight[1] * turn)[0]))
    return Waypoints(
        t_s=t_s, **place, yaw_rad=yaw, speed_mps=np.zeros(len(t_s)), observed=known[0] | known[1], sigma_xy_m=sigma
    )


def _joined(first: Agent, last: Agent) -> Waypoints:
    """Return the states of two tracks in the order of time: averaged where both are, bridged where none is."""
    a, b = first.waypoints, last.waypoints
    if a.t_s[-1] >= b.t_s[0]:
        t_s = np.unique(np.concatenate([a.t_s, b.t_s]))
        t_s = t_s[np.concatenate([[True], np.diff(t_s) > 1e-6])]
        weights, states = [], []
        for agent, w in ((first, a), (last, b)):
            there = (t_s >= w.t_s[0] - 1e-9) & (t_s <= w.t_s[-1] + 1e-9)
            weights.append(np.where(there, 1 / np.maximum(np.interp(t_s, w.t_s, w.sigma_xy_m), 1e-3) ** 2, 0.0))
            states.append(agent.trajectory.at(t_s))
        total = weights[0] + weights[1]
        share = weights[1] / total
        columns = ("x_m", "y_m", "z_m", "speed_mps")
        mean = {k: (1 - share) * getattr(states[0], k) + share * getattr(states[1], k) for k in columns}
        yaw = wrap_angle(states[0].yaw_rad + share * wrap_angle(states[1].yaw_rad - states[0].yaw_rad))
        known = [np.interp(t_s, w.t_s, w.observed.astype(np.float64), left=0.0, right=0.0) > 0.5 for w in (a, b)]
        return Waypoints(t_s=t_s, **mean, yaw_rad=yaw, observed=known[0] | known[1], sigma_xy_m=1 / np.sqrt(total))
    length_s = float(b.t_s[0] - a.t_s[-1])
    s = np.linspace(0.0, length_s, max(int(np.ceil(length_s / STEP_S)), 1) + 1)[1:-1]
    f, span = s / length_s, np.full(len(s), length_s)

    def ends(column: str) -> Array:
        return np.array([getattr(a, column)[-1], getattr(b, column)[0]])

    (yaw0, yaw1), speed, at = ends("yaw_rad"), ends("speed_mps"), np.zeros(len(s), dtype=np.intp)
    place: dict[str, Any] = {}
    rate: dict[str, Array] = {}
    for k, slope in (("x_m", speed * np.cos(ends("yaw_rad"))), ("y_m", speed * np.sin(ends("yaw_rad")))):
        place[k], rate[k] = hermite(ends(k), slope, at, s, span), hermite_slope(ends(k), slope, at, s, span)
    pace = np.hypot(rate["x_m"], rate["y_m"])
    turned = yaw0 + f * wrap_angle(np.array([yaw1 - yaw0]))[0]
    sign = 1.0 if speed.sum() >= 0 else -1.0
    course = np.arctan2(sign * rate["y_m"], sign * rate["x_m"])
    moves = pace > STANDSTILL_MPS
    z0, z1 = ends("z_m")
    sigma0, sigma1 = ends("sigma_xy_m")
    bridge = BRIDGE_ACCELERATION**2 * s**3 * (span - s) ** 3 / (3 * span**3)
    middle = Waypoints(
        t_s=a.t_s[-1] + s, **place, z_m=z0 + f * (z1 - z0), yaw_rad=wrap_angle(np.where(moves, course, turned)),
        speed_mps=sign * pace, observed=np.zeros(len(s), dtype=bool), sigma_xy_m=np.sqrt((sigma0 + f * (sigma1 - sigma0)) ** 2 + bridge),
    )  # fmt: skip
    common = set(a.columns()) & set(middle.columns()) & set(b.columns())
    return Waypoints(**{k: np.concatenate([w.columns()[k] for w in (a, middle, b)]) for k in common})


def added(
    category: str, size_m: Sequence[float], poses: Sequence[Mapping[str, float]], name: str, ends: Any = "natural"
) -> Agent:
    """Return an agent that passes key poses on the path of least acceleration, static where there is one pose or all are one place.

    `ends`: boundary conditions, as `scipy.interpolate.CubicSpline` has them; with them the agent moves.
    """
    from scipy.interpolate import CubicSpline

    length, width, height = map(float, size_m)
    key_s = np.array([p["t_s"] for p in poses])
    at = np.array([[p["x_m"], p["y_m"], p["z_m"]] for p in poses])
    sigma = np.array([p.get("sigma_m", POSE_SIGMA_M) for p in poses])
    given = np.array([p.get("yaw_rad", np.nan) for p in poses])
    static = ends == "natural" and bool(np.ptp(at[:, :2], axis=0).max() <= POSE_SIGMA_M)
    if static:
        one = np.ones(1)
        yaw = given[np.isfinite(given)][:1] if np.isfinite(given).any() else 0 * one
        waypoints = Waypoints(key_s[:1], at[:1, 0], at[:1, 1], at[:1, 2], wrap_angle(yaw), 0 * one, one < 0, sigma[:1])
        return Agent(name, category, (length, width, height), waypoints, static=True)
    t_s = np.unique(np.concatenate([np.arange(key_s[0], key_s[-1], STEP_S), key_s]))
    t_s = t_s[np.concatenate([[True], np.diff(t_s) > 1e-6])]
    spline = CubicSpline(key_s, at, bc_type=ends)
    xyz, rate = spline(t_s), spline(t_s, 1)
    pace = np.hypot(rate[:, 0], rate[:, 1])
    course = np.unwrap(np.arctan2(rate[:, 1], rate[:, 0]))
    # Where it stands it keeps the heading with which it came; one that creeps all the time has that of its way.
    moves = pace >= min(STANDSTILL_MPS, pace.max() / 2)
    course = np.interp(t_s, t_s[moves], course[moves])
    observed, sigma_m = np.zeros(len(t_s), dtype=bool), np.interp(t_s, key_s, sigma)
    x, y, z = xyz.T
    waypoints = Waypoints(t_s, x, y, z, wrap_angle(course), pace, observed, sigma_m)
    return Agent(name, category, (length, width, height), waypoints)
