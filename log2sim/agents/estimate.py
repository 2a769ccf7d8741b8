"""Agents of all tracks, and the ego."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.candidate import AgentCandidate, Timeline
from log2sim.agents.evidence import may_suffice
from log2sim.agents.hypotheses import explain_track
from log2sim.agents.moving import moving_candidate
from log2sim.agents.smooth.smoother import signed_speed, smooth_track
from log2sim.agents.static import static_candidates
from log2sim.datatypes import (
    ENDS,
    STANDSTILL_DRIFT_M,
    STANDSTILL_MPS,
    Agent,
    Log,
    Measurements,
    Obstacles,
    Span,
    Track,
    Waypoints,
)
from log2sim.files.processes import map_in_processes
from log2sim.geometry import NS_PER_S, Array, PoseTrack, yaw_of
from log2sim.geometry.transforms import USUAL_SIGMA_M, USUAL_SIGMA_RAD
from log2sim.perception.sync import Schedule
from log2sim.tracking.forward import MAX_MISSES

# Processes are worth their start, some 30 ms, where each takes so many measurements.
ROWS_A_PROCESS = 500


def estimate_agents(
    tracks: Sequence[Track],
    obstacles: Sequence[Obstacles | None],
    timeline: Timeline,
    *,
    smooth: bool,
    clutter: float = 0.0,
    jobs: int = 1,
) -> list[AgentCandidate]:
    """Make a candidate of every object that the tracks show and that may suffice (`may_suffice`), moving ones first.

    `obstacles`: T clouds, None at ticks without LiDAR. `smooth`: whether trajectories are smoothed. `clutter`: from
    `evidence.clutter_nats`. `jobs`: processes that share the tracks; the result is the same for any number.
    """

    def estimate(numbers: Sequence[int]) -> list[tuple[int, AgentCandidate]]:
        """Make the candidates of some tracks, with the number of each one's track; its measurements stay in this process."""
        parts = [
            (k, p)
            for k in numbers
            for p in explain_track(tracks[k])
            if may_suffice(p.track, static=p.static, clutter=clutter)
        ]
        moving = [(k, moving_candidate(p.track, obstacles, timeline, smooth=smooth)) for k, p in parts if not p.static]
        standing = static_candidates([p for _, p in parts if p.static], obstacles, timeline)
        found = [*moving, *zip((k for k, p in parts if p.static), standing)]
        return [(k, replace(c, track=replace(c.track, measurements=Measurements.empty()))) for k, c in found]

    jobs = max(min(jobs, sum(map(len, tracks)) // ROWS_A_PROCESS), 1)
    shares = [range(k, len(tracks), jobs) for k in range(jobs)]
    found = list(chain.from_iterable(map_in_processes(estimate, shares, jobs)))
    candidates = []
    for k, candidate in sorted(found, key=lambda of: (of[1].agent.static, of[0])):
        rows = np.searchsorted(tracks[k].tick, candidate.track.tick)
        track = replace(candidate.track, measurements=tracks[k].measurements.take(rows))
        candidates.append(replace(candidate, track=track))
    return candidates


def ego_agent(log: Log, timeline: Timeline, source: str = "ego poses of the log") -> Agent | None:
    """Make the ego an agent with a waypoint at every tick; None for a log without poses at them.

    `source` says where the poses come from.
    """
    if log.ego is None:
        return None
    map_T_ego, valid = log.ego.at(timeline.t_ns)
    if not valid.any():
        return None
    vehicle = log.ego_vehicle
    center = log.ego_centers(map_T_ego[valid])
    t, yaw = timeline.seconds(timeline.t_ns[valid]), yaw_of(map_T_ego[valid])
    sigma_m = log.ego.sigmas_at(timeline.t_ns[valid])[:, 0]
    path = smooth_track(t, center[:, :2], sigma_m=sigma_m)
    # Poses that bridge a gap are off together, so that smoothing does not make them better.
    bridging_m2 = bridging_variances(log.ego, timeline.t_ns[valid])[:, 0]
    speed = signed_speed(path.velocity_mps, yaw)
    waypoints = Waypoints(
        t_s=t,
        x_m=path.xy_m[:, 0],
        y_m=path.xy_m[:, 1],
        z_m=center[:, 2],
        yaw_rad=yaw,
        speed_mps=np.where(np.abs(speed) < STANDSTILL_MPS, 0.0, speed),
        observed=np.ones(len(t), dtype=bool),
        sigma_xy_m=np.sqrt(np.trace(path.covariance, axis1=1, axis2=2) / 2 + bridging_m2),
    )
    moved = float(np.hypot(np.ptp(center[:, 0]), np.ptp(center[:, 1])))
    return Agent(
        "ego", "car", vehicle.size_m, waypoints, static=moved < STANDSTILL_DRIFT_M, rear_axle_offset_m=vehicle.rear_axle_offset_m,
        doubts=path.broken, quality={"source": source},
    )  # fmt: skip


def bridging_variances(poses: PoseTrack, t_ns: NDArray[np.int64]) -> Array:
    """Return the variances (N, 2) of positions, m2, and yaws, rad2, at stamps (N,), beyond those of measured poses."""
    sigmas = poses.sigmas_at(t_ns)
    known = zip((USUAL_SIGMA_M, USUAL_SIGMA_RAD), (poses.sigma_m, poses.sigma_yaw_rad), strict=True)
    measured = np.array([usual if sigma is None else float(sigma.min()) for usual, sigma in known])
    return np.asarray(np.maximum(sigmas**2 - measured**2, 0.0))


def with_pose_errors(agent: Agent, log: Log, timeline: Timeline) -> Agent:
    """Add to the standard deviations of an agent what the ego's poses are uncertain by where they bridge gaps.

    An agent is placed by the pose of its tick, from which it is as far away as it is seen. One that stands is placed by the best
    pose of its time.
    """
    w = agent.waypoints
    if log.ego is None or log.ego.sigma_m is None:
        return agent
    ticks = timeline.t0_ns + np.round(w.t_s * NS_PER_S).astype(np.int64)
    if agent.static:
        ticks = timeline.t_ns[(timeline.t_ns >= ticks[0]) & (timeline.t_ns <= ticks[-1])]
    variances = bridging_variances(log.ego, ticks)
    if not variances.any():
        return agent
    xy = np.stack([np.interp(timeline.seconds(ticks), w.t_s, column) for column in (w.x_m, w.y_m)], axis=1)
    away_m2 = np.sum((log.ego.at(ticks)[0][:, :2, 3] - xy) ** 2, axis=1)
    position, yaw = variances[:, 0] + away_m2 * variances[:, 1], variances[:, 1]
    if agent.static:
        position, yaw = (np.full(len(w), v.min()) for v in (position, yaw))
    return replace(agent, waypoints=replace(
        w,
        sigma_xy_m=None if w.sigma_xy_m is None else np.sqrt(w.sigma_xy_m**2 + position),
        sigma_yaw_rad=None if w.sigma_yaw_rad is None else np.sqrt(w.sigma_yaw_rad**2 + yaw),
    ))  # fmt: skip


def ego_path(log: Log, schedule: Schedule) -> Array:
    """Return x, y and heading (K, 3) of the ego at every tick, as evidence of the direction of traffic."""
    if log.ego is None:
        return np.zeros((0, 3))
    map_T_ego, valid = log.ego.at(schedule.t_ns)
    poses = map_T_ego[valid]
    return np.column_stack([poses[:, :2, 3], yaw_of(poses)])


def ego_velocity(log: Log, schedule: Schedule) -> Array:
    """Return the velocity (T, 2) of the ego in the map at every tick, m/s; 0 where it is not known."""
    if log.ego is None or len(schedule) < 2:
        return np.zeros((len(schedule), 2))
    map_T_ego, valid = log.ego.at(schedule.t_ns)
    xy = np.where(valid[:, None], map_T_ego[:, :2, 3], np.nan)
    t_s = (schedule.t_ns - schedule.t_ns[0]) / NS_PER_S
    return np.asarray(np.nan_to_num(np.gradient(xy, t_s, axis=0)), dtype=np.float64)


def with_observers(candidate: AgentCandidate, agent: Agent, timeline: Timeline) -> Agent:
    """Return an agent with the spans of time in which each end measured the candidate that it was made of."""
    spans: dict[str, tuple[Span, ...]] = {}
    for end, seen in zip(ENDS, candidate.track.measurements.seen_by.T):
        tick = candidate.track.tick[seen]
        # A span goes on over as many missing ticks as a track does.
        parts = np.split(tick, np.flatnonzero(np.diff(tick) > MAX_MISSES + 1) + 1) if len(tick) else []
        at_s = [timeline.seconds(timeline.t_ns[part[[0, -1]]]).tolist() for part in parts]
        spans |= {end: tuple((first, last) for first, last in at_s)} if at_s else {}
    return replace(agent, observed_by=spans)


# Largest deviation of an omitted waypoint from the line between its neighbors: x, y, z, yaw, speed.
TOLERANCE_M, TOLERANCE_RAD, TOLERANCE_MPS = 0.01, 0.002, 0.02
# Of a standard deviation, as a share: an error of a tenth changes no decision. With the tolerance of what it belongs to.
SIGMA_SHARE = 0.1
MAX_INTERVAL_S = 1.0


def simplify(agents: Sequence[Agent]) -> list[Agent]:
    """Leave out waypoints of straight motion at constant speed; `quality` counts those left out."""
    out = []
    for agent in agents:
        waypoints = simplify_waypoints(agent.waypoints)
        omitted = len(agent.waypoints) - len(waypoints)
        quality = {**agent.quality, "waypoints_left_out": omitted}
        out.append(replace(agent, waypoints=waypoints, quality=quality) if omitted else agent)
    return out


def simplify_waypoints(w: Waypoints) -> Waypoints:
    """Leave out the waypoints that linear interpolation restores, keeping intervals of at most `MAX_INTERVAL_S`.

    Where `observed` changes, both neighbors are kept; so are the first and the last one.

    Greedy: from each kept waypoint the farthest next one is searched with steps that double, then halve.
    """
    exact = np.full(len(w), 0.0)
    toleranced = [(w.x_m, exact + TOLERANCE_M), (w.y_m, exact + TOLERANCE_M), (w.z_m, exact + TOLERANCE_M)]
    toleranced += [(np.unwrap(w.yaw_rad), exact + TOLERANCE_RAD), (w.speed_mps, exact + TOLERANCE_MPS)]
    sigmas = (w.sigma_xy_m, TOLERANCE_M), (w.sigma_yaw_rad, TOLERANCE_RAD), (w.sigma_speed_mps, TOLERANCE_MPS)
    toleranced += [(s, tolerance + SIGMA_SHARE * s) for s, tolerance in sigmas if s is not None]
    columns, tolerances = (np.column_stack(c) for c in zip(*toleranced, (w.observed.astype(np.float64), exact)))
    kept, last = [0], len(w) - 1
    while kept[-1] < last:
        start = kept[-1]
        step, reach = 1, 1
        while step and start + reach < last:
            end = min(start + reach + step, last)
            between = slice(start + 1, end)
            share = (w.t_s[between] - w.t_s[start]) / (w.t_s[end] - w.t_s[start])
            line = columns[start] + share[:, None] * (columns[end] - columns[start])
            near = bool((np.abs(columns[between] - line) <= tolerances[between]).all())
            if near and w.observed[start] == w.observed[end] and w.t_s[end] - w.t_s[start] <= MAX_INTERVAL_S:
                reach, step = end - start, 2 * step
            else:
                step //= 2
        kept.append(start + reach)
    return w.take(np.array(kept, dtype=np.intp)) if len(kept) < len(w) else w
