"""All metrics of a replay: tracking errors, collisions, conflicts, comfort, limits, and a summary in text."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EGO, STANDSTILL_MPS, Trajectory
from log2sim.datatypes.agent import MAX_LISTED
from log2sim.errors import CheckFailed, ConfigError
from log2sim.files.plugins import nearest
from log2sim.geometry import Array, fit_windows, wrap_angle
from log2sim.simulation.corridors import PathTable
from log2sim.simulation.groups import StepClock
from log2sim.simulation.metrics.collisions import REPLAY, BoxTracks, collisions
from log2sim.simulation.metrics.conflicts import conflicts, most_critical
from log2sim.simulation.metrics.realism import signed_distance
from log2sim.simulation.result import AgentReplay, Replay
from log2sim.simulation.vehicles.vehicle import WHEELED
from log2sim.simulation.warnings import describe_warnings

SEARCH_S = 1.0
SEARCH_STEP_S = 0.05

# Cross-track error beyond which an agent is off its path: a 1.9 m wide car in a 3.5 m lane has 0.8 m on each side.
OFF_PATH_M = 0.5


@dataclass(frozen=True, eq=False)
class TrackingErrors:
    """Distance of an agent from the scenario at its rows (S,); left, ahead, faster and counter-clockwise are positive."""

    across_m: Array
    along_m: Array
    speed_mps: Array
    yaw_rad: Array


def agent_errors(trajectory: Trajectory, agent: AgentReplay, *, follows: bool) -> TrackingErrors:
    """Compute the errors of an agent; one that is not on time may be far along its path and still on it."""
    near_s = agent.t_s
    if not follows:  # the times at which the scenario is nearest
        from scipy.spatial import cKDTree

        t = np.arange(trajectory.t_s[0], trajectory.t_s[-1] + SEARCH_STEP_S / 2, SEARCH_STEP_S)
        tree = cKDTree(np.stack(trajectory.relative(t)[:2], axis=1))
        near_s = t[tree.query(np.stack([agent.x_m, agent.y_m], axis=1) - trajectory.origin_m)[1]]
    across, along = tracking_errors(trajectory, agent.t_s, agent.x_m, agent.y_m, near_s)
    log = trajectory.at(agent.t_s)
    return TrackingErrors(across, along, agent.speed_mps - log.speed_mps, wrap_angle(agent.yaw_rad - log.yaw_rad))


def tracking_errors(
    trajectory: Trajectory, t_s: Array, x_m: Array, y_m: Array, near_s: Array | None = None
) -> tuple[Array, Array]:
    """Return the errors across and along the path of the scenario, (S,) each in m, left and ahead positive.

    Along: from the scenario's box center at the same time, in the direction of its heading. Across: distance from the
    nearest point of the path of the scenario's box centers within `SEARCH_S` of the same time, or of the times `near_s`
    (S,), so a delay in a curve is no error across. Where the nearest point is an end of that path, or the scenario
    stands, the component along its direction counts as along.
    """
    log_x, log_y, _, log_yaw, _ = trajectory.at(t_s)
    along = (x_m - log_x) * np.cos(log_yaw) + (y_m - log_y) * np.sin(log_yaw)
    begin_s, end_s = trajectory.t_s[0] - SEARCH_S, trajectory.t_s[-1] + SEARCH_S
    px, py, _, yaw, _ = trajectory.at(np.arange(begin_s, end_s + SEARCH_STEP_S, SEARCH_STEP_S))
    ux, uy = np.diff(px), np.diff(py)
    square = ux**2 + uy**2
    moves = square > (STANDSTILL_MPS * SEARCH_STEP_S) ** 2
    # Segments near each row (S, K): on each the share of it at which it is nearest.
    reach = round(SEARCH_S / SEARCH_STEP_S)
    middle = np.rint(((t_s if near_s is None else near_s) - begin_s) / SEARCH_STEP_S).astype(np.intp)
    near = np.clip(middle[:, None] + np.arange(-reach, reach), 0, len(square) - 1)
    dx, dy, sx, sy = x_m[:, None] - px.take(near), y_m[:, None] - py.take(near), ux.take(near), uy.take(near)
    slope = np.divide(1.0, square, out=np.zeros_like(square), where=moves)
    share = np.clip((dx * sx + dy * sy) * slope.take(near), 0.0, 1.0)
    best = np.argmin((dx - share * sx) ** 2 + (dy - share * sy) ** 2, axis=1)
    row = np.arange(len(t_s))
    k, dx, dy = near[row, best], dx[row, best], dy[row, best]
    length = np.sqrt(np.where(moves, square, 1.0))
    cos, sin = np.where(moves, ux / length, np.cos(yaw[:-1])), np.where(moves, uy / length, np.sin(yaw[:-1]))
    # For a vehicle in reverse, left of its heading is right of its direction of travel.
    left = np.where(cos * np.cos(yaw[:-1]) + sin * np.sin(yaw[:-1]) < 0, -1.0, 1.0)
    return left[k] * (dy * cos[k] - dx * sin[k]), along


def _mean(values: Mapping[str, float], samples: Mapping[str, int]) -> float:
    """Return the mean of the values weighted by their samples; 0 without any."""
    total = sum(samples.values())
    return sum(count * values[k] for k, count in samples.items()) / total if total else 0.0


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


# Lengths of the fits. Shorter ones show the steps of the controller and the noise of the scenario.
ACCEL_WINDOW_S, JERK_WINDOW_S = 0.75, 1.5

# Fewest rows of a window: a cubic with one degree of freedom left. With sparse rows the windows are longer.
MIN_ROWS = 5

# Comfort limits of nuPlan's planning benchmark (Karnchanachari et al., 2024), derived from human drivers.
LIMITS = {
    "lon_accel_max_mps2": 2.40, "lon_decel_max_mps2": 4.05, "lat_accel_max_mps2": 4.89, "lon_jerk_max_mps3": 4.13,
    "jerk_max_mps3": 8.37, "yaw_rate_max_radps": 0.95, "yaw_accel_max_radps2": 1.93,
}  # fmt: skip


def comfort(t_s: Array, x_m: Array, y_m: Array, yaw_rad: Array) -> dict[str, float | bool] | None:
    """Compute greatest and RMS acceleration, jerk and yaw rates, and whether all are within `LIMITS`.

    `t_s`, `x_m`, `y_m`, `yaw_rad` (S,), s, m and rad: evenly spaced box centers without discontinuities. Returns none
    for fewer than five rows.

    Derivatives of cubics fitted to the positions in a sliding window (Savitzky and Golay, 1964): longitudinal along the
    heading, lateral across it, both of the box center. Changes faster than the window are damped.
    """
    if len(t_s) < MIN_ROWS:
        return None
    spacing_s = round((t_s[-1] - t_s[0]) / (len(t_s) - 1), 9)  # as times are stored, and the same for all agents
    ax, ay = (_derivative(c, 2, ACCEL_WINDOW_S, spacing_s) for c in (x_m, y_m))
    jx, jy = (_derivative(c, 3, JERK_WINDOW_S, spacing_s) for c in (x_m, y_m))
    yaw = np.unwrap(yaw_rad)
    yaw_rate, yaw_accel = (_derivative(yaw, order, ACCEL_WINDOW_S, spacing_s) for order in (1, 2))
    cos, sin = np.cos(yaw), np.sin(yaw)
    lon_accel, lat_accel, lon_jerk = ax * cos + ay * sin, ay * cos - ax * sin, jx * cos + jy * sin
    out = {
        "lon_accel_max_mps2": max(float(lon_accel.max()), 0.0), "lon_decel_max_mps2": max(float(-lon_accel.min()), 0.0),
        "lon_accel_rms_mps2": _rms(lon_accel), "lat_accel_max_mps2": float(np.abs(lat_accel).max()),
        "lat_accel_rms_mps2": _rms(lat_accel), "lon_jerk_max_mps3": float(np.abs(lon_jerk).max()),
        "lon_jerk_rms_mps3": _rms(lon_jerk), "jerk_max_mps3": float(np.hypot(jx, jy).max()),
        "yaw_rate_max_radps": float(np.abs(yaw_rate).max()), "yaw_accel_max_radps2": float(np.abs(yaw_accel).max()),
    }  # fmt: skip
    rounded: dict[str, float | bool] = {k: round(v, 4) for k, v in out.items()}
    rounded["comfortable"] = all(out[k] <= limit for k, limit in LIMITS.items())
    return rounded


def _derivative(values: Array, order: int, window_s: float, spacing_s: float) -> Array:
    """Return the derivative (S,) of cubics fitted to a window around each row; near an end, of the window at the end."""
    longest = len(values) - (len(values) + 1) % 2
    half = min(max(round(window_s / spacing_s / 2), MIN_ROWS // 2), longest // 2)
    # Far map offsets would cost digits.
    return np.asarray(fit_windows(values - values[0], 2 * half + 1, 3, order, spacing_s))


MAX_PAIRS = 100_000  # pairs of boxes whose distance is computed at once, which bounds memory
MIN_SPEED_MPS = 0.05  # below this a vehicle stands, and what its acceleration is then is no braking


def ego_figures(
    agents: Sequence[AgentReplay], index: int, boxes: BoxTracks, t_s: Array, path: Trajectory
) -> dict[str, Any]:
    """Compute the figures of the ego in `metrics.ego` of `schemas/replay-1.json`.

    `index`: the ego among the agents. `boxes`: of all agents. `t_s` (S,), s: times of the rows of `boxes`. `path`: of the
    ego in the scenario.
    """
    ego = agents[index]
    table = PathTable([path])
    gone_m = table.progress(0, ego.x_m, ego.y_m)
    length_m = float(table.at(np.zeros(1, dtype=np.intp), np.array([path.t_s[-1]])).distance_m[0])
    steps_m = np.hypot(np.diff(ego.x_m), np.diff(ego.y_m))
    # What the actuators do between two states shows in the speed at its end, so the larger of both speeds says if it moves.
    speed, before = np.abs(ego.speed_mps), np.r_[ego.speed_mps[:1], ego.speed_mps[:-1]]
    moves = np.maximum(speed, np.abs(before)) > MIN_SPEED_MPS
    gear = np.sign(np.where(speed > MIN_SPEED_MPS, ego.speed_mps, before))
    brake = np.where(moves, -ego.accel_mps2 * gear, 0.0).round(3)
    k, hardest = int(np.argmax(brake)) if len(brake) else 0, None
    if len(brake) and brake[k] > 0:
        hardest = {"mps2": float(brake[k]), "t_s": round(float(ego.t_s[k]), 6)}
    # Rows and agents among which the nearest box is, whatever the directions of the boxes; those at different heights, as
    # on a bridge, are not compared.
    far, height = boxes.radius_m + boxes.radius_m[index], (boxes.size_m[:, 2] + boxes.size_m[index, 2]) / 2
    nearest, found, count = np.inf, [np.zeros((2, 0), dtype=np.intp)], max(1, MAX_PAIRS // len(boxes.size_m))
    for begin in range(0, len(boxes.x_m), count):
        part = slice(begin, begin + count)
        dx, dy, dz = (c[part] - c[part, index][:, None] for c in (boxes.x_m, boxes.y_m, boxes.z_m))
        distance = np.where(np.abs(dz) < height, np.hypot(dx, dy), np.inf)  # NaN where one of them is absent: not level
        distance[:, index] = np.inf
        nearest = min(nearest, float(distance.min(initial=np.inf)))
        row, agent = np.nonzero(np.isfinite(distance) & (distance - far <= nearest))
        found.append(np.stack([row + begin, agent]))
    rows, others = np.concatenate(found, axis=1)
    gaps = [np.zeros(0)]
    for begin in range(0, len(rows), MAX_PAIRS):
        r, a = rows[begin : begin + MAX_PAIRS], others[begin : begin + MAX_PAIRS]
        away = boxes.x_m[r, a] - boxes.x_m[r, index] + 1j * (boxes.y_m[r, a] - boxes.y_m[r, index])
        size, yaws = np.broadcast_to(boxes.size_m[index], (len(r), 3)), (boxes.yaw_rad[r, index], boxes.yaw_rad[r, a])
        gaps.append(np.maximum(signed_distance(away, *yaws, size, boxes.size_m[a]), 0.0))
    gap, smallest = np.concatenate(gaps), None
    if len(gap):
        k = int(np.argmin(gap))
        smallest = {"m": round(float(gap[k]), 3), "t_s": round(float(t_s[rows[k]]), 6), "agent": agents[others[k]].id}
    return {
        "driven_m": round(float(steps_m.sum()), 3), "progress_m": round(float(gone_m[-1]) if len(gone_m) else 0.0, 3),
        "path_m": round(length_m, 3), "min_gap": smallest, "max_brake": hardest,
    }  # fmt: skip


LOWER_LIMITS = ("min_ttc_s", "min_pet_s")
UPPER_LIMITS = (
    "cross_track_max_m", "cross_track_rms_m", "along_track_rms_m", "speed_rms_mps", "yaw_rms_rad", "off_path_share",
    *LIMITS,
)  # fmt: skip


def parse_limits(texts: Iterable[str], known: Sequence[str] = LOWER_LIMITS + UPPER_LIMITS) -> dict[str, float]:
    """Parse limits by name from texts "name=value".

    Raises `ConfigError` when a name is not known or a value is no finite number.
    """
    limits: dict[str, float] = {}
    for text in texts:
        name, _, value = text.partition("=")
        name = name.strip()
        if name not in known:
            raise ConfigError(
                f"limit '{text}': no metric '{name}'{nearest(name, list(known))}; known: {', '.join(known)}"
            )
        try:
            limits[name] = float(value)
        except ValueError:
            limits[name] = math.nan
        if not math.isfinite(limits[name]):
            raise ConfigError(f"limit '{text}': expected a number, such as {name}=1.0")
    return limits


def check_limits(replay: Replay, limits: Mapping[str, float]) -> list[str]:
    """Return which of the given limits are broken: by the ego if a policy drives it, else by any agent that moves."""
    driven = [a.id for a in replay.agents if a.driver == "policy"]
    by_agent = replay.metrics["by_agent"]
    broken = []
    for id in driven or by_agent:
        values = by_agent.get(id, {})
        for name, limit in limits.items():
            value = values[name] if name in values else (values.get("comfort") or {}).get(name)
            if value is not None and (value < limit if name in LOWER_LIMITS else value > limit):
                side = "at least" if name in LOWER_LIMITS else "at most"
                broken.append(f"agent '{id}': {name} {value:g}, limit {side} {limit:g}")
    return broken


def check_strict(replay: Replay, limits: Mapping[str, float] | None = None) -> list[str]:
    """Return what breaks a limit of `--strict`: collisions of the replay, large errors, infeasible scenarios.

    Comfort, time to collision and post-encroachment time count only when named in `limits`: what the drivers did in
    the scenario is no failure of a replay.
    """
    broken = [
        f"{' and '.join(e['agents'])} collide at {e['t_s']:.2f} s ({e['relative_speed_mps']:.1f} m/s); the scenario has no such collision"
        for e in replay.metrics["collisions"]
        if e["belongs_to"] == REPLAY
    ]
    for agent in replay.agents:
        if agent.driver in ("policy", "reactive"):
            continue
        worst = replay.metrics["by_agent"].get(agent.id, {}).get("cross_track_max_m", 0.0)
        if worst > OFF_PATH_M:
            broken.append(f"agent '{agent.id}': {worst:.2f} m off its path, limit {OFF_PATH_M:g} m")
        broken += [f"agent '{agent.id}': {flag}" for flag in agent.flags]
    return broken + check_limits(replay, limits or {})


def require_strict(replay: Replay, limits: Mapping[str, float] | None = None) -> None:
    """Raise `CheckFailed` with all broken limits."""
    broken = check_strict(replay, limits)
    if broken:
        raise CheckFailed("the replay breaks limits:\n  " + "\n  ".join(broken))


SCENARIO_FOLLOWERS = ("pid", "exact")  # drivers that follow the scenario in place and time


def replay_metrics(
    agents: Sequence[AgentReplay],
    stored: Sequence[NDArray[np.intp]],
    trajectories: Mapping[str, Trajectory],
    errors: Mapping[str, TrackingErrors],
    clock: StepClock,
    *,
    source_kind: str,
) -> dict[str, Any]:
    """Compute the metrics of `schemas/replay-1.json`, by agent and overall.

    `stored`: the steps of each agent's rows; of a static agent all stored steps at which it is present. `trajectories`,
    `errors`: trajectories of the agents that move in the scenario, and how far they are from them. `source_kind`: whose
    the collisions are that the boxes of the scenario have themselves.
    """
    ids = [a.id for a in agents]
    replayed, source = (_box_tracks(agents, stored, paths, clock) for paths in ({}, trajectories))
    moves = np.array([a.driver != "static" for a in agents], dtype=bool)
    rows = np.arange(len(replayed.x_m), dtype=np.float64)
    t_s = clock.begin_s + rows * (clock.store_every * clock.dt_s)
    events = collisions(replayed, source, moves, t_s, ids, source_kind=source_kind)
    near = conflicts(replayed, moves, t_s, ids, events)
    events_of, near_of = _by_agent(events), _by_agent(near)
    by_agent: dict[str, dict[str, Any]] = {}
    for a in (a for a in agents if a.id in errors):
        e = errors[a.id]
        across = np.abs(e.across_m)
        # Not of pedestrians, nor where the scenario has a discontinuity.
        felt = a.category in WHEELED and not len(trajectories[a.id].discontinuity_times())
        by_agent[a.id] = {
            "cross_track_rms_m": round(_rms(e.across_m), 6), "cross_track_max_m": round(float(np.max(across)), 6),
            "along_track_rms_m": round(_rms(e.along_m), 6), "speed_rms_mps": round(_rms(e.speed_mps), 6),
            "yaw_rms_rad": round(_rms(e.yaw_rad), 6), "off_path_share": round(float(np.mean(across > OFF_PATH_M)), 6),
            "min_ttc_s": (most_critical(near_of[a.id], "min_ttc") or {}).get("s"),
            "min_pet_s": (most_critical(near_of[a.id], "pet") or {}).get("s"),
            "comfort": comfort(a.t_s, a.x_m, a.y_m, a.yaw_rad) if felt else None, "collisions": events_of[a.id],
        }  # fmt: skip
    on_time = {a.id: len(a) for a in agents if a.driver == "pid"}
    on_way = on_time | {a.id: len(a) for a in agents if a.driver == "reactive"}
    driven = next((k for k, agent in enumerate(agents) if agent.driver == "policy"), None)
    ego = {}
    if driven is not None:
        ego["ego"] = ego_figures(agents, driven, replayed, t_s, trajectories[ids[driven]])
    # Errors averaged over all followers, every stored sample counting alike; 0 without followers.
    out: dict[str, Any] = {}
    for key, samples in (
        ("cross_track_rms_m", on_way), ("along_track_rms_m", on_time), ("speed_rms_mps", on_time), ("yaw_rms_rad", on_time),
    ):  # fmt: skip
        out[key] = round(float(np.sqrt(_mean({k: e[key] ** 2 for k, e in by_agent.items()}, samples))), 6)
    out["cross_track_max_m"] = max((m["cross_track_max_m"] for k, m in by_agent.items() if k in on_way), default=0.0)
    out["off_path_share"] = round(_mean({k: e["off_path_share"] for k, e in by_agent.items()}, on_way), 6)
    out["followers"] = len(on_time)
    return {
        **out, **ego, "collisions": events, "new_collisions": sum(e["belongs_to"] == REPLAY for e in events),
        "min_ttc": most_critical(near, "min_ttc"), "min_pet": most_critical(near, "pet"), "conflicts": near,
        "by_agent": by_agent,
    }  # fmt: skip


def _by_agent(records: Iterable[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Group records by the id of each of their agents."""
    found: dict[str, list[Any]] = defaultdict(list)
    for record in records:
        for id in record["agents"]:
            found[id].append(record)
    return found


def _box_tracks(
    agents: Sequence[AgentReplay],
    stored: Sequence[NDArray[np.intp]],
    trajectories: Mapping[str, Trajectory],
    clock: StepClock,
) -> BoxTracks:
    """Return boxes at all stored steps, of the replay or, for agents with a trajectory given, of the scenario."""
    shape = ((clock.steps - 1) // clock.store_every + 1, len(agents))
    columns = np.full((5, *shape), np.nan)
    for k, (agent, steps) in enumerate(zip(agents, stored)):
        rows = steps // clock.store_every
        if agent.id in trajectories:
            columns[:, rows, k] = np.stack(trajectories[agent.id].at(agent.t_s))
        elif len(rows) == len(agent):
            columns[:, rows, k] = agent.x_m, agent.y_m, agent.z_m, agent.yaw_rad, agent.speed_mps
        elif len(rows):  # one pose for all rows
            pose = [agent.x_m[0], agent.y_m[0], agent.z_m[0], agent.yaw_rad[0], agent.speed_mps[0]]
            columns[:, rows, k] = np.array(pose)[:, None]
    size = np.array([a.size_m for a in agents], dtype=np.float64).reshape(-1, 3)
    x, y, z, yaw, speed = columns
    return BoxTracks(x, y, z, yaw, speed, size)


def summarize(replay: Replay, *, limit: int | None = MAX_LISTED) -> str:
    """Summarize errors, conflicts and models in a line each, and list the first collisions, those of the replay first.

    Where a policy drives the ego, how it fared comes first, and the times are those of the ego. An error that no agent has is
    shown as a dash. Of each list the first `limit` are named, or all without one.
    """
    m = replay.metrics
    events = sorted(m["collisions"], key=lambda e: (e["belongs_to"] != REPLAY, e["t_s"]))
    drivers = {a.driver for a in replay.agents}
    lines = []
    if "ego" in m:
        ego, gap, brake = m["ego"], m["ego"]["min_gap"], m["ego"]["max_brake"]
        share = ""
        if ego["path_m"] > 0:
            beyond = ego["progress_m"] > ego["path_m"]
            share = ", and straight on beyond its end" if beyond else f" ({ego['progress_m'] / ego['path_m']:.0%})"
        own_events = [(next(id for id in e["agents"] if id != EGO), e) for e in m["collisions"] if EGO in e["agents"]]
        hits = [f"{id} at {e['t_s']:.2f} s ({e['relative_speed_mps']:.1f} m/s)" for id, e in own_events]
        lines = [
            f"ego: progress {ego['progress_m']:.1f} of {ego['path_m']:.1f} m along its path{share}",
            "  smallest gap " + ("-" if gap is None else f"{gap['m']:.2f} m to {gap['agent']} at {gap['t_s']:.2f} s"),
            "  hardest brake " + ("-" if brake is None else f"{brake['mps2']:.1f} m/s2 at {brake['t_s']:.2f} s"),
            f"  collisions {'none' if not hits else 'with ' + ', '.join(hits)}",
        ]
    on_time, across, along, speed = bool(drivers & {*SCENARIO_FOLLOWERS}), "-", "-", "-"
    if on_time or "reactive" in drivers:
        across = f"{m['cross_track_rms_m']:.3f} m rms, {m['cross_track_max_m']:.3f} m max"
    if on_time:
        along, speed = f"{m['along_track_rms_m']:.3f} m rms", f"{m['speed_rms_mps']:.3f} m/s rms"
    lines.append(f"cross-track {across} · along-track {along} · speed {speed}")
    counts = f"{len(events)} collision{'' if len(events) == 1 else 's'}"
    if events:
        owners = Counter(e["belongs_to"] for e in m["collisions"])
        own = [f"{n} of the {k} itself" for k, n in owners.items() if k != REPLAY]
        counts += f", {' and '.join([f'{owners[REPLAY]} of the replay', *own])}"
    whose = " of the ego" if "policy" in drivers else ""
    times = []
    for key in ("min_ttc", "pet"):
        found = most_critical([e for e in m["conflicts"] if e["ego"] or not whose], key)
        times.append(
            "-" if found is None else f"{found['s']:.2f} s ({' and '.join(found['agents'])} at {found['t_s']:.2f} s)"
        )
    lines.append(f"{counts} · least time to collision{whose} {times[0]} · post-encroachment time {times[1]}")
    models = Counter(a.model for a in replay.agents if a.model != "none")
    if models:
        lines.append("models: " + ", ".join(f"{count} {model}" for model, count in models.most_common()))
        chosen = [a for a in replay.agents if a.model == "dynamic" and replay.model == "auto"]
        lines += _first([f"  {a.id} dynamic: {a.model_reason}" for a in chosen], limit)
    shown = []
    for e in events:
        known = "" if e["belongs_to"] == REPLAY else f", in the {e['belongs_to']} itself"
        pair, speed_mps = " and ".join(e["agents"]), e["relative_speed_mps"]
        shown.append(f"  {pair} collide at {e['t_s']:.2f} s ({speed_mps:.1f} m/s){known}")
    lines += _first(shown, limit)
    if replay.left_out:
        count, named = len(replay.left_out), [f"{k} ({why})" for k, why in replay.left_out.items()]
        more = f" and {count - limit} more" if limit is not None and count > limit else ""
        total = count + sum(agent.id != EGO for agent in replay.agents)
        lines.append(f"{count} of {total} agents left out: {', '.join(named[:limit])}{more}")
    if replay.warnings is not None:
        lines.append(describe_warnings(replay.warnings))
    return "\n".join(lines)


def _first(lines: list[str], limit: int | None) -> list[str]:
    """Return the first lines, and one that counts the others."""
    rest = 0 if limit is None else len(lines) - limit
    return [*lines[:limit], f"  and {rest} more"] if rest > 0 else lines
