"""Static agents: one pose for all ticks of a track that does not move, and tracking by LiDAR alone where nothing was detected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.candidate import AgentCandidate, Timeline, candidate_of
from log2sim.agents.hypotheses import Part, main_place
from log2sim.agents.rays import Ending, classify_rays
from log2sim.agents.size import TrackGeometry, independent, static_geometry
from log2sim.agents.smooth.motion_model import UNKNOWN_YAW_RAD
from log2sim.datatypes import GROUP_OF, MAX_SIZE_M, BoxEvidence, Measurements, Obstacles, Rays, Waypoints
from log2sim.geometry import NS_PER_S, Array, wrap_angle
from log2sim.perception.boxes import (
    FACING_END,
    SENSOR_SIGMA_M,
    SIDE_END,
    UNIFORM_SIGMA,
    complete_box,
    correct_yaws,
    extents_of_clusters,
    facing_ends,
    oriented_covariance,
    rotate,
)
from log2sim.perception.lidar.cloud import OBSTACLE_REACH_M
from log2sim.tracking.forward import CENTER_SIGMA_M

MIN_POINTS = 8
# Points up to this far outside the predicted box count as its own; a shell of this width around them is compared with it.
MARGIN_M = 0.5
SHELL_M = 1.0
# With more points in the shell, relative to those in the box, the box is a part of a larger structure.
MAX_SHELL_RATIO = 0.6
# Largest distance of a match from its prediction along each side, and as a share of it: the box of a detector may be off so far.
MAX_SHIFT_M, MAX_SHIFT_SHARE = 0.8, 0.1
MAX_MISSES = 2
# A match is rejected when a larger share of the box's length or width is unobserved: its position along that axis is
# undetermined.
MAX_HIDDEN_SHARE = 0.7
# A ray that goes on behind a side by this passed it.
SIDE_DEPTH_M = 0.3
# An end is where a ray passes within this distance of the last point.
MAX_GAP_M = 1.5
# Quantiles of the heights of points between which a side is: below a truck and above a hood rays pass.
LEVELS = 0.25, 0.75
# What ends on both sides and is shorter than this share of the box is something else.
MIN_SIZE_SHARE = 0.5
# Gains of the constant-velocity filter.
POSITION_GAIN, VELOCITY_GAIN = 0.6, 0.15


@dataclass(frozen=True, eq=False)
class LidarMatch:
    """A tracked box found in the LiDAR points of a tick."""

    tick: int
    t_ns: int  # mean time of its points
    xy_m: Array  # (2,): center, map frame
    covariance: Array  # (2, 2): of the center, m2
    yaw_rad: float  # direction of its sides; the predicted one where its points do not show it
    points: int


@dataclass(frozen=True, eq=False)
class BoxState:
    """A box of known size and its motion at one time, in the map frame."""

    t_ns: int
    xy_m: Array  # (2,): center
    velocity_mps: Array  # (2,): zero for a static box, which is expected at the same position at every tick
    yaw_rad: float
    size_m: Array  # (3,): length, width, height
    bottom_m: float  # height of its bottom face


def track_with_lidar(
    obstacles: Sequence[Obstacles | None], ticks: Sequence[int], t_ns: NDArray[np.int64], start: BoxState
) -> list[LidarMatch]:
    """Match a box at the given ticks, one after the other, from a known state.

    A moving box is predicted with constant velocity, corrected at every match, and lost after `MAX_MISSES` ticks without a
    match in a row.

    `obstacles`: T clouds, None at ticks without LiDAR. `ticks`: forward or backward in time from the state. `t_ns`: (T,):
    stamps of all ticks.
    """
    matches: list[LidarMatch] = []
    state, misses, is_static = start, 0, not start.velocity_mps.any()
    for tick in ticks:
        cloud = obstacles[tick]
        stamp_ns = int(t_ns[tick]) if cloud is None else cloud.stamp_ns
        predicted = state.xy_m + state.velocity_mps * ((stamp_ns - state.t_ns) / NS_PER_S)
        reached = cloud is not None and float(np.hypot(*(predicted - cloud.origin[:2]))) <= reach_of(state.size_m)
        match = match_boxes(cloud, tick, [replace(state, xy_m=predicted)])[0] if cloud is not None and reached else None
        if match is None:
            misses += 1
            if misses >= MAX_MISSES and not is_static:
                break
            continue
        misses = 0
        matches.append(match)
        if is_static:
            continue
        # The state at the time of the match, corrected toward it.
        dt_s = (match.t_ns - state.t_ns) / NS_PER_S
        expected = state.xy_m + state.velocity_mps * dt_s
        innovation, velocity = match.xy_m - expected, state.velocity_mps
        if abs(dt_s) > 1e-3:
            velocity = velocity + VELOCITY_GAIN * innovation / dt_s
        position = expected + POSITION_GAIN * innovation
        state = replace(state, t_ns=match.t_ns, xy_m=position, velocity_mps=velocity, yaw_rad=match.yaw_rad)
    return matches


def match_standing(
    obstacles: Sequence[Obstacles | None], boxes: Sequence[BoxState], known: Sequence[NDArray[np.int64]]
) -> list[list[LidarMatch]]:
    """Match boxes that stand at all ticks but those at which each is `known`; returns the matches of each.

    Every cloud is looked at once, and only for the boxes that its points reach: a long log has many of both.
    """
    matches: list[list[LidarMatch]] = [[] for _ in boxes]
    if not boxes:
        return matches
    place = np.array([box.xy_m for box in boxes])
    reach = np.array([reach_of(box.size_m) for box in boxes])
    measured = [set(ticks.tolist()) for ticks in known]
    for tick, cloud in enumerate(obstacles):
        if cloud is None:
            continue
        near = np.flatnonzero(np.hypot(*(place - cloud.origin[:2]).T) <= reach).tolist()
        near = [k for k in near if tick not in measured[k]]
        for k, match in zip(near, match_boxes(cloud, tick, [boxes[k] for k in near])):
            if match is not None:
                matches[k].append(match)
    return matches


def reach_of(size_m: Array) -> float:
    """Return how far from the origin of a cloud, m, a box may be to have points of it near."""
    return OBSTACLE_REACH_M + _reach_around(size_m)


def _reach_around(size_m: Array) -> float:
    """Return how far from the center of a box, m, points are looked at."""
    return float(np.hypot(*size_m[:2])) / 2 + MARGIN_M + SHELL_M


def match_boxes(cloud: Obstacles, tick: int, boxes: Sequence[BoxState]) -> list[LidarMatch | None]:
    """Match predicted boxes, at the stamp of a cloud, against its points; None for those whose position they do not determine.

    Of a vehicle beside the sensor only a flank is seen, and of a long one not even all of that. It has the place across
    from the flank, and the place along from an end behind which rays go on. A wall has no such ends.
    """
    matches: list[LidarMatch | None] = [None] * len(boxes)
    found = [cloud.near(box.xy_m, _reach_around(box.size_m)) for box in boxes]
    near, of = (
        np.concatenate([*found, np.zeros(0, dtype=np.intp)]),
        np.repeat(np.arange(len(boxes)), [len(i) for i in found]),
    )
    if len(near) < MIN_POINTS:
        return matches
    names = "size_m", "xy_m", "velocity_mps", "yaw_rad", "bottom_m"
    size, place, velocity, yaw, bottom = (np.array([getattr(box, name) for box in boxes]) for name in names)
    z = cloud.xyz[near, 2] + (cloud.origin[2] - bottom).astype(np.float32)[of]
    tall = np.flatnonzero((z > 0.15) & (z < size[of, 2] + 0.4))
    near, of, z = near[tall], of[tall], z[tall]
    size, late_s = size[:, :2], cloud.t_s[near].astype(np.float64)
    local = rotate(cloud.xyz[near, :2] + (cloud.origin[:2] - place)[of] - late_s[:, None] * velocity[of], -yaw[of])
    outside_m = np.maximum(*(np.abs(local) - size[of] / 2).T)
    inside, around = outside_m <= MARGIN_M, outside_m <= MARGIN_M + SHELL_M
    count, in_shell = (np.bincount(of[mask], minlength=len(boxes)) for mask in (inside, around & ~inside))
    usable = (count >= MIN_POINTS) & (in_shell <= MAX_SHELL_RATIO * count)
    rows, kept = np.flatnonzero(usable), np.flatnonzero(inside & usable[of])
    if not len(rows):
        return matches
    local, count = local[kept], count[rows]
    # The pose of what stands is known from all ticks.
    turn_rad, moves = np.zeros(len(rows)), velocity[rows].any(axis=1)
    if moves.any():
        turn_rad[moves] = correct_yaws(local[np.repeat(moves, count)], count[moves], turn_rad[moves])
    low, high = extents_of_clusters(local, count, turn_rad)
    start = np.cumsum(count) - count
    points = [slice(a, a + n) for a, n in zip(start.tolist(), count.tolist())]
    mean_s = np.add.reduceat(late_s[kept], start) / count
    size, place, velocity, yaw = size[rows], place[rows], velocity[rows], yaw[rows] + turn_rad
    good: NDArray[np.bool_] = np.all(high - low <= size + np.maximum(0.6, MAX_SHIFT_SHARE * size), axis=1)
    seen_from = np.array([cloud.sensor_of(near[kept[part]])[:2] for part in points], dtype=np.float64)
    real = facing_ends(low, high, rotate(seen_from + cloud.origin[:2] - place, -yaw))
    gap_m = np.zeros(real.shape)
    hidden = size - (high - low) > MAX_HIDDEN_SHARE * np.maximum(size, 1.0)
    rays = dict[int, tuple[Array, Array]]()
    if cloud.free is None:
        good &= ~hidden.any(axis=1)
    else:
        for n in np.flatnonzero(good & (hidden | ~real.any(axis=2)).any(axis=1)).tolist():
            rays[n] = _rays_to(replace(boxes[rows[n]], yaw_rad=float(yaw[n])), cloud.origin, cloud.free)
            levels = np.quantile(z[kept[points[n]]], LEVELS)
            real[n], gap_m[n] = _ends_by_rays(*rays[n], levels, low[n], high[n], real[n])
            smaller = real[n].all(axis=1) & (high[n] - low[n] + gap_m[n].sum(axis=1) < MIN_SIZE_SHARE * size[n])
            good[n] = not (smaller.any() or (hidden[n].any() and not real[n].any(axis=1).all()))
    center, sigma = complete_box(low, high, size, real, gap_m=gap_m)
    good &= (np.abs(center) <= np.maximum(MAX_SHIFT_M, MAX_SHIFT_SHARE * size)).all(axis=1)
    sigma = np.hypot(sigma, UNIFORM_SIGMA * np.where(real.all(axis=2), gap_m.min(axis=2), gap_m.max(axis=2)))
    covariance = oriented_covariance(np.hypot(sigma, 2 * SENSOR_SIGMA_M), yaw)
    xy_m = rotate(center, yaw) + place + mean_s[:, None] * velocity
    for n in np.flatnonzero(good).tolist():
        k = int(rows[n])
        if n not in rays or not _passes(*rays[n], center[n], boxes[k].size_m):
            t_ns = cloud.stamp_ns + round(float(mean_s[n]) * NS_PER_S)
            matches[k] = LidarMatch(tick, t_ns, xy_m[n], covariance[n], float(yaw[n]), int(count[n]))
    return matches


def left_free(
    obstacles: Sequence[Obstacles | None], matches: Sequence[LidarMatch], size_m: Array, bottom_m: float
) -> NDArray[np.bool_]:
    """Mark the matches (n,), in rising time, whose place rays pass when the box is more than its length from there.

    What a moving object was taken for does so; clutter along which a box drifts stays where it is.
    """
    places = np.array([match.xy_m for match in matches]).reshape(-1, 2)
    marked = np.zeros(len(matches), dtype=bool)
    for k, match in enumerate(matches):
        away = np.flatnonzero(np.hypot(*(places - match.xy_m).T) > size_m[0])
        # The last moment before it came, the first one after it went.
        for other in (*away[away < k][-1:].tolist(), *away[away > k][:1].tolist()):
            cloud = obstacles[matches[other].tick]
            if cloud is not None and cloud.free is not None and not marked[k]:
                box = BoxState(match.t_ns, match.xy_m, np.zeros(2), match.yaw_rad, size_m, bottom_m)
                marked[k] = _passes(*_rays_to(box, cloud.origin, cloud.free), np.zeros(2), size_m)
    return marked


def _rays_to(box: BoxState, origin: Array, rays: Rays) -> tuple[Array, Array]:
    """Return where rays that pass near a box start and end (K, 3) along its axes, relative to the middle of its bottom then."""
    position, velocity = rays.position[:, :2].astype(np.float64), rays.velocity_mps[:, :2]
    # Box and LiDAR move past each other while the rays are sent.
    drift_m = np.hypot(*(velocity - box.velocity_mps).T).max() * np.abs(rays.t_s).max()
    reach_m = np.hypot(*box.size_m[:2]) / 2 + 2 * drift_m + MAX_GAP_M + MAX_SHIFT_SHARE * box.size_m.max() + MAX_SHIFT_M
    to_x, to_y = (rays.of_lidar(to) for to in (box.xy_m - origin[:2] - position).T.astype(np.float32))
    x, y, away = rays.level
    near = np.flatnonzero(np.abs(to_x * y - to_y * x) <= np.float32(reach_m) * away)
    end, sensor, t_s = rays.end[near], rays.sensor[near], rays.t_s[near, None]
    place = np.append(box.xy_m, box.bottom_m) - origin + t_s * np.append(box.velocity_mps, 0.0)
    start, end = rays.position[sensor] + rays.velocity_mps[sensor] * t_s - place, end - place
    start[:, :2], end[:, :2] = rotate(start[:, :2], -box.yaw_rad), rotate(end[:, :2], -box.yaw_rad)
    return start, end


def _ends_by_rays(
    start: Array, end: Array, levels_m: Array, low: Array, high: Array, real: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Array]:
    """Find the ends next to which rays (K, 3) pass the sides that face the sensor, between two levels (2,).

    Returns `real`: (2, 2): kinds of the ends of the points, with those that face the sensor, `real`; `gap_m`: (2, 2): how far
    beyond the points the first ray passes.
    """
    ends, gap_m = real.copy(), np.zeros((2, 2))
    for across, side in np.argwhere(real == FACING_END).tolist():
        along, face, inward = 1 - across, (low, high)[side][across], (1.0, -1.0)[side]
        before, behind = inward * (face - start[:, across]), inward * (end[:, across] - face)
        passing = np.flatnonzero((before > 0) & (behind > SIDE_DEPTH_M))
        share = (before / (before + behind))[passing, None]
        at = start[passing] + share * (end - start)[passing]
        at = at[(at[:, 2] > levels_m[0]) & (at[:, 2] < levels_m[1]), along]
        for k, beyond in enumerate((low[along] - at, at - high[along])):
            gap = float(beyond[beyond > 0].min(initial=np.inf))
            if gap < MAX_GAP_M and not ends[along, k]:
                ends[along, k], gap_m[along, k] = SIDE_END, gap
    return ends, gap_m


def _passes(start: Array, end: Array, center: Array, size: Array) -> bool:
    """Return whether most of several rays toward the solid part of a box of a size (3,) at a center (2,) go on behind it."""
    first = start - np.append(center, size[2] / 2)
    ending = classify_rays(first, end - start, np.zeros(len(first)), np.tile(size, (len(first), 1)))
    passed, met = (ending == Ending.THROUGH).sum(), (ending <= Ending.THROUGH).sum()
    return bool(met >= MIN_POINTS and 2 * passed > met)


# Standard deviations of a yaw known up to half a turn: of the box of one tick, and the least of any.
BOX_YAW_SIGMA_RAD, MIN_YAW_SIGMA_RAD = 0.1, 0.005
# What seems to stand is not faster than this, standard deviation, however short it was seen.
MAX_SPEED_SIGMA_MPS = 2.0


def static_candidates(
    parts: Sequence[Part], obstacles: Sequence[Obstacles | None], timeline: Timeline
) -> list[AgentCandidate]:
    """Make agents with one pose each, at the ticks of their tracks and wherever LiDAR points match their boxes.

    Their yaws are known up to half a turn.
    """
    geometries, boxes = [], []
    for part in parts:
        geometry = static_geometry(part.at_place or part.track)
        # If all measurements make it too large for one object, some show a part of a neighbor.
        largest = MAX_SIZE_M[part.track.category][:2]
        if part.at_place is None and np.any(geometry.size_m[:2] >= largest):
            main = main_place(part.track)
            smaller = geometry if main is None else static_geometry(main)
            geometry = geometry if np.any(smaller.size_m[:2] >= largest) else smaller
        n = len(part.track)
        xy_m, covariance = np.tile(geometry.xy_m[0], (n, 1)), np.median(geometry.covariance, axis=0)
        z_m = np.full(n, np.median(geometry.z_m))
        geometry = replace(geometry, xy_m=xy_m, covariance=np.tile(covariance, (n, 1, 1)), z_m=z_m)
        geometries.append(geometry)
        yaw_rad = 0.0 if geometry.yaw_rad is None else float(np.nan_to_num(geometry.yaw_rad))
        bottom_m = float(geometry.z_m[0]) - geometry.size_m[2] / 2
        start_ns = int(timeline.t_ns[part.track.tick[0]])
        boxes.append(BoxState(start_ns, geometry.xy_m[0], np.zeros(2), yaw_rad, geometry.size_m, bottom_m))
    matches = match_standing(obstacles, boxes, [part.track.tick for part in parts])
    candidates = []
    for part, geometry, box, found in zip(parts, geometries, boxes, matches):
        track, m = part.track, part.track.measurements
        observed = np.union1d(track.tick, np.array([match.tick for match in found], dtype=np.int64))
        life = np.unique(observed[[0, -1]])
        n = len(life)
        waypoints = Waypoints(
            t_s=timeline.seconds(timeline.t_ns[life]),
            x_m=np.full(n, box.xy_m[0]),
            y_m=np.full(n, box.xy_m[1]),
            z_m=np.full(n, geometry.z_m[0]),
            yaw_rad=np.full(n, box.yaw_rad),
            speed_mps=np.zeros(n),
            observed=np.ones(n, dtype=bool),
            sigma_xy_m=np.full(n, np.sqrt(np.trace(geometry.covariance[0]) / 2)),
            sigma_yaw_rad=np.full(n, yaw_sigma(m, geometry)),
            sigma_speed_mps=np.full(n, standing_speed_sigma(m, CENTER_SIGMA_M[GROUP_OF[track.category]])),
        )
        share = len(observed) / (observed[-1] - observed[0] + 1)
        quality = {"lidar_only": len(found), "observed_share": round(float(share), 3)}
        candidates.append(candidate_of(track, geometry, waypoints, quality, static=True))
    return candidates


def standing_speed_sigma(m: Measurements, sigma_m: float) -> float:
    """Return the standard deviation in m/s of the speed of a track that stands: that of a line through its centers.

    It is larger where they scatter more than their variances say (Birge, 1932), by the median, which outliers move little.
    `sigma_m` is what changing views add to the noise of a center.
    """
    weight: Array = 1.0 / (np.linalg.eigvalsh(m.covariance)[:, -1].astype(np.float64) + sigma_m**2)
    t, xy = (m.t_ns - m.t_ns[0]) / NS_PER_S, m.center_m[:, :2]
    late, off = t - np.average(t, weights=weight), xy - np.median(xy, axis=0)
    known = float(weight @ late**2)
    if known == 0:
        return MAX_SPEED_SIGMA_MPS
    squared = weight * ((off - np.outer(late, weight * late @ off / known)) ** 2).sum(axis=1)
    scatter = float(np.median(squared)) / np.log(4.0)  # median of chi-square with two degrees of freedom
    return min(float(np.sqrt(max(scatter, 1.0) / known)), MAX_SPEED_SIGMA_MPS)


def yaw_sigma(m: BoxEvidence, geometry: TrackGeometry) -> float:
    """Return the standard deviation in rad of the yaw of a track that stands, given that front and back are not swapped.

    By the boxes of a 3D detector it is their scatter about the yaw, whose errors repeat from tick to tick; by points alone
    the distance of half of them from the sides of the box, seen over the length of the longest side.
    """
    if geometry.yaw_rad is None or not np.isfinite(geometry.yaw_rad):
        return UNKNOWN_YAW_RAD
    rows = np.flatnonzero(np.isfinite(m.box_yaw_rad))
    if len(rows):
        off = wrap_angle(2 * (m.box_yaw_rad[rows] - geometry.yaw_rad)) / 2
        scatter = max(float(np.sqrt(np.mean(off**2))), BOX_YAW_SIGMA_RAD / np.sqrt(len(rows)))
        sigma = scatter / np.sqrt(independent(len(rows)))
        return float(min(max(sigma, MIN_YAW_SIGMA_RAD), UNKNOWN_YAW_RAD))
    points = [cluster[:, :2] for cluster in m.cluster if len(cluster)]
    if not points:
        return UNKNOWN_YAW_RAD
    xy = rotate(np.concatenate(points) - geometry.xy_m[0], -geometry.yaw_rad)
    low, high = np.quantile(xy, 0.02, axis=0), np.quantile(xy, 0.98, axis=0)
    off_m = float(np.median(np.minimum(np.abs(xy - low), np.abs(xy - high)).min(axis=1)))
    sigma = np.arctan2(off_m, float((high - low).max()))
    return float(min(max(sigma, MIN_YAW_SIGMA_RAD), UNKNOWN_YAW_RAD))
