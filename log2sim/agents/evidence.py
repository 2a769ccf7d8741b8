"""Evidence for and against candidates over the whole log: rays, views, structure, sizes.

Of the rays toward an agent those that end before it say nothing, those that end in it support it, and those that go on
behind it contradict it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.candidate import AgentCandidate, Support, Timeline
from log2sim.agents.size import MAX_ROAD_WIDTH_M, WHOLE_SIDE_SIGMA_M
from log2sim.datatypes import GROUP_OF, MAX_SIZE_M, Agent, AgentTable, Finding, Log, Measurements, Obstacles, Rays
from log2sim.geometry import NS_PER_S, Array, Camera, apply, cross_slab, inverse, project
from log2sim.perception.boxes import rotate
from log2sim.perception.sync import Schedule


@dataclass(frozen=True, eq=False)
class Recording:
    """What the sensors of a log recorded at the ticks of a run.

    Attributes
    ----------
    schedule : Schedule
        Its cameras are those that were searched.
    clouds : T Obstacles, None at ticks without LiDAR
    """

    log: Log
    schedule: Schedule
    clouds: Sequence[Obstacles | None]
    timeline: Timeline

    @property
    def t_s(self) -> Array:
        """Times (T,) of the ticks since the start."""
        return self.timeline.seconds(self.timeline.t_ns)


# Rounding.
SAME_M = 0.005


def doubt_size(agent: Agent) -> list[Finding]:
    """Doubt a vehicle that is wider than any on the road, by more than the error of an observed side, or as long as sizes go.

    Sizes are limited to those of the category: a vehicle at the greatest length was observed to be longer.
    """
    length_m, width_m, _ = agent.size_m
    if GROUP_OF[agent.category] != "vehicle":
        return []
    if width_m > MAX_ROAD_WIDTH_M + WHOLE_SIDE_SIGMA_M:
        return [Finding("unlikely_size", case="width", values={"width_m": width_m, "limit_m": MAX_ROAD_WIDTH_M})]
    longest_m = MAX_SIZE_M[agent.category][0]
    if length_m >= longest_m - SAME_M:
        return [Finding("unlikely_size", case="length", values={"limit_m": longest_m}, other=agent.category)]
    return []


# Smaller objects are "small" in COCO (Lin et al., ECCV 2014), where detectors find less than half of them.
MIN_HEIGHT_PX = 32.0
# Share of the width of an image at either side in which an object is cut off.
BORDER_SHARE = 0.05
# From a camera farther from the LiDAR other things hide an object than from the LiDAR.
MAX_BASELINE_M = 3.0


def shown_in_images(boxes: AgentTable, recording: Recording) -> NDArray[np.bool_]:
    """Mark (A, T) where a searched camera next to the LiDAR has an agent well inside its image, large enough to be detected."""
    shown = np.zeros(boxes.present.shape, dtype=bool)
    log, schedule = recording.log, recording.schedule
    for name, frames in schedule.frames.items():
        camera, ticks = log.cameras[name], np.flatnonzero((frames >= 0) & boxes.present.any(axis=0))
        poses, known = log.map_T_sensor(name, log.streams[name].t_ns[frames[ticks]])
        for tick, map_T_cam in zip(ticks[known].tolist(), poses[known]):
            cloud, rows = recording.clouds[tick], np.flatnonzero(boxes.present[:, tick])
            if cloud is None or np.linalg.norm(map_T_cam[:3, 3] - cloud.origin - cloud.sensor) > MAX_BASELINE_M:
                continue
            shown[rows, tick] |= _shown(camera, map_T_cam, boxes.center_m[rows, tick], boxes.size_m[rows, 2])
    return shown


def _shown(camera: Camera, map_T_cam: Array, center_m: Array, height_m: Array) -> NDArray[np.bool_]:
    """Mark the boxes (M,) with these centers (M, 3) and heights (M,) that an image shows."""
    in_cam = apply(inverse(map_T_cam), center_m)
    uv, inside = project(camera, in_cam)
    border = BORDER_SHARE * camera.width_px
    inside &= np.abs(np.nan_to_num(uv[:, 0]) - camera.width_px / 2) < camera.width_px / 2 - border
    return np.asarray(inside & (camera.K[1, 1] * height_m >= MIN_HEIGHT_PX * in_cam[:, 2]))


# A ray is toward an agent where it runs through so much of its box, or through this share of its width if that is less: rays
# that cut a corner may miss the rounded body.
MIN_CHORD_M, MIN_CHORD_SHARE = 0.5, 0.4
# Boxes are taken smaller on each side by their error, at most by this share of their size. A ray that ends within twice that
# distance of the smaller box, or above or below it, ends at it.
INSET_M, MAX_INSET_SHARE = 0.3, 0.25
MARGIN_M = 2 * INSET_M
# Rays of a near agent are thousands; so many in its azimuths, of all heights, suffice for a share.
MAX_RAYS = 400
SCATTER = 7919  # a prime, larger than any step
# A cloud belongs to an agent's first and last tick though its stamp may lie outside of the agent's life.
MAX_LAG_S = 0.1

Floats = NDArray[np.floating[Any]]


class Layer(NamedTuple):
    """A layer of a box, as shares of its height."""

    low: float
    high: float


SOLID = Layer(0.25, 0.55)
"""The part of a vehicle that no ray passes: above the gap below its floor and below its windows."""
WHOLE = Layer(0.1, 1.0)
"""All of a box that is above the errors of the ground."""


class Ending(IntEnum):
    """Where a ray ends."""

    INSIDE = 0
    THROUGH = 1
    BEFORE = 2
    ELSEWHERE = 3


def count_rays(agents: Sequence[Agent], clouds: Sequence[Obstacles | None], timeline: Timeline) -> NDArray[np.int64]:
    """Count the rays toward the solid part and the whole of A agents in T clouds by their ending, (2, 3, A, T).

    They end at the agent, go on behind it, or end before it. They are 0 at ticks without a cloud or outside of an agent's life.

    Notes
    -----
    Boxes are those of the stamp of a cloud, moved to the time of each ray by their velocity. Takes about 3 ms for a tick
    of 70 agents and 30 000 rays.
    """
    counts = np.zeros((2, 3, len(agents), len(clouds)), dtype=np.int64)
    if agents:
        stamps = [timeline.t_ns[k] if cloud is None else cloud.stamp_ns for k, cloud in enumerate(clouds)]
        t_s = (np.array(stamps, dtype=np.int64) - timeline.t0_ns) / NS_PER_S
        boxes = AgentTable.of(agents, t_s, margin_s=MAX_LAG_S)
        for tick in np.flatnonzero(boxes.present.any(axis=0)).tolist():
            cloud = clouds[tick]
            if cloud is not None and cloud.free is not None and len(cloud.free):
                counts[..., tick] = count_at(boxes, tick, cloud.origin, cloud.free)
    return counts


def count_at(boxes: AgentTable, tick: int, origin: Array, rays: Rays) -> NDArray[np.int64]:
    """Count the rays of one tick toward the solid part and the whole by their ending (2, 3, A)."""
    agent = np.flatnonzero(boxes.present[:, tick])
    center, velocity, size = (
        boxes.center_m[agent, tick] - origin,
        boxes.heading_velocity_mps[agent, tick],
        boxes.size_m[agent],
    )
    counts = np.zeros((2, 3, len(boxes.present)), dtype=np.int64)
    start = rays.start
    to = rays.end - start
    last_s = float(np.abs(rays.t_s).max())
    for sensor in range(len(rays.position)):
        own = np.flatnonzero(rays.sensor == sensor)
        drift = np.hypot(*(velocity - rays.velocity_mps[sensor, :2]).T) * last_s
        box, ray = _near_rays(center - rays.position[sensor], size, drift, to[own])
        ray = own[ray]
        relative = start[ray] - center[box]
        relative[:, :2] -= velocity[box] * rays.t_s[ray, None]
        yaw, sizes = boxes.yaw_rad[agent[box], tick], size[box]
        for k, endings in enumerate(classify_rays(relative, to[ray], yaw, sizes, (SOLID, WHOLE))):
            for ending in (Ending.INSIDE, Ending.THROUGH, Ending.BEFORE):
                counts[k, ending] += np.bincount(agent[box[endings == ending]], minlength=counts.shape[2])
    return counts


def _near_rays(
    to_center: Array, size_m: Array, drift_m: Array, to: Floats
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pair M boxes with those of K rays that may meet them, at most `MAX_RAYS` in the azimuths of each.

    Parameters
    ----------
    to_center : (M, 3) float64, m
        From the sensor to the boxes.
    size_m : (M, 3) float64
    drift_m : (M,) float64
        How far sensor and box move past each other during the sweep.
    to : (K, 3) float64, m
        From the sensor to the ends of the rays.

    Returns
    -------
    box, ray : (n,) intp
        Indices of both. None for a box around the sensor.
    """
    if len(to) == 0:
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    azimuth = np.arctan2(to[:, 1], to[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):  # an upright ray has no slope and meets no box
        slope = to[:, 2] / np.hypot(to[:, 0], to[:, 1])
    order = np.argsort(azimuth)
    turns = np.concatenate([azimuth[order] - 2 * np.pi, azimuth[order], azimuth[order] + 2 * np.pi])
    distance, reach = np.hypot(to_center[:, 0], to_center[:, 1]), np.hypot(size_m[:, 0], size_m[:, 1]) / 2 + drift_m
    middle = np.arctan2(to_center[:, 1], to_center[:, 0])
    half = np.where(distance > reach, np.arcsin(np.minimum(reach / np.maximum(distance, reach), 1.0)), 0.0)
    first, last = np.searchsorted(turns, middle - half), np.searchsorted(turns, middle + half)
    step = np.maximum(-(-(last - first) // MAX_RAYS), 1)
    count = (last - first) // step
    box = np.repeat(np.arange(len(count)), count)
    rank = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    # One of every `step` rays, not always the same laser of the LiDAR.
    ray = order[(first[box] + rank * step[box] + rank * SCATTER % step[box]) % len(order)]
    z = to_center[:, 2:] + size_m[:, 2:] * (np.array(WHOLE) - 0.5)
    near, far = np.maximum(distance - reach, MIN_CHORD_M)[:, None], (distance + reach)[:, None]
    slopes = np.hstack([z / near, z / far])
    level = (slope[ray] >= slopes.min(axis=1)[box]) & (slope[ray] <= slopes.max(axis=1)[box])
    return box[level], ray[level]


def classify_rays(
    start: Floats, to: Floats, yaw_rad: Array, size_m: Array, layers: Sequence[Layer] = (SOLID,)
) -> list[NDArray[np.int64]]:
    """Tell for each of n rays and each layer of its box where the ray ends, as `Ending` (n,) for every layer.

    Parameters
    ----------
    start : (n, 3) float64, m
        Relative to the center of the box.
    to : (n, 3) float64, m
        From the start to the end.
    yaw_rad : (n,) float64
        Of the box.
    size_m : (n, 3) float64
    """
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    # One array for each axis: numpy takes several times as long for short last axes.
    origin = c * start[:, 0] + s * start[:, 1], c * start[:, 1] - s * start[:, 0], np.asarray(start[:, 2], np.float64)
    along = c * to[:, 0] + s * to[:, 1], c * to[:, 1] - s * to[:, 0], np.asarray(to[:, 2], np.float64)
    half = [side / 2 - np.minimum(INSET_M, MAX_INSET_SHARE * side) for side in (size_m[:, 0], size_m[:, 1])]
    sides = [cross_slab(origin[k], along[k], -half[k], half[k]) for k in range(2)]
    wider = [cross_slab(origin[k], along[k], -half[k] - MARGIN_M, half[k] + MARGIN_M) for k in range(2)]
    arrive = np.fmax(wider[0][0], wider[1][0])
    length = np.sqrt(along[0] ** 2 + along[1] ** 2 + along[2] ** 2)
    least_m = np.minimum(MIN_CHORD_M, MIN_CHORD_SHARE * size_m[:, 1])
    endings = []
    for layer in layers:
        rising = cross_slab(origin[2], along[2], (layer.low - 0.5) * size_m[:, 2], (layer.high - 0.5) * size_m[:, 2])
        enter = np.fmax(np.fmax(sides[0][0], sides[1][0]), rising[0])
        leave = np.fmin(np.fmin(sides[0][1], sides[1][1]), rising[1])
        inside = ((leave - enter) * length >= least_m) & (enter > 0)
        ending = np.where(inside, int(Ending.INSIDE), int(Ending.ELSEWHERE))
        ending[inside & (arrive > 1)] = Ending.BEFORE
        ending[inside & ~(arrive > 1) & ((1 - leave) * length > MARGIN_M)] = Ending.THROUGH
        endings.append(ending)
    return endings


# Points up to this far outside a box may be its own: error of a box.
STRUCTURE_MARGIN_M = 0.3
# Thickness to either side of what counts as one surface. Walls are flatter; what else the points of a vehicle show, its
# second side, its roof and its windows, recedes by more.
SURFACE_M = 0.2
# Shares of the points in a box that are nearly all, and most, of them.
MIN_SURFACE_SHARE, MIN_MOST_SHARE = 0.85, 0.5
# Surfaces are followed along cells of this length over at most so many empty ones: 0.5 m is less than the distance of parked
# vehicles with their two rounded corners.
CELL_M, MAX_EMPTY_CELLS = 0.25, 2
# A surface that is longer than the longest vehicle of its category by this is no side of one.
EXCESS_M = 0.5
# Fewer points, or points in fewer cells (1 m of a side), show no surface.
MIN_POINTS, MIN_CELLS = 12, 4
# Points below may be curbs.
BOTTOM_M = 0.3
# The points in each cell of a surface that are nearest to the sensor, without the strays.
FRONT_QUANTILE = 0.8
# Ticks that are searched for each agent, evenly spread over its life: standing structure looks much the same at all of them.
SEARCHED_TICKS = 3


@dataclass(frozen=True, eq=False)
class Surface:
    """The surface that the points in a box are on.

    Attributes
    ----------
    share : float
        Of the points in the box that are on it.
    length_m : float
        Of the surface, without a gap, in the box and beyond.
    """

    share: float
    length_m: float


def structure_shares(
    agents: Sequence[Agent], clouds: Sequence[Obstacles | None], timeline: Timeline
) -> tuple[Array, Array]:
    """Return shares (A,), (A,) of the searched ticks at which nearly all and most points of a vehicle are on a longer surface.

    A few ticks, evenly spread over the life of an agent, are searched: standing structure shows the same at all of them.
    """
    shares = np.zeros((2, len(agents)))
    stamp_of = {k: cloud.stamp_ns for k, cloud in enumerate(clouds) if cloud is not None}
    ticks = np.array(list(stamp_of), dtype=np.intp)
    rows = [i for i, agent in enumerate(agents) if GROUP_OF[agent.category] == "vehicle"]
    if len(ticks) == 0 or not rows:
        return shares[0], shares[1]
    stamps = np.array(list(stamp_of.values()), dtype=np.int64)
    boxes = AgentTable.of([agents[i] for i in rows], (stamps - timeline.t0_ns) / NS_PER_S, margin_s=MAX_LAG_S)
    for row, i in enumerate(rows):
        alive = np.flatnonzero(boxes.present[row])
        searched = alive[np.unique(np.linspace(0, len(alive) - 1, min(len(alive), SEARCHED_TICKS)).astype(np.intp))]
        longest_m = MAX_SIZE_M[agents[i].category][0] + EXCESS_M
        found = [_surface_at(boxes, row, int(k), clouds[ticks[k]], longest_m) for k in searched]
        longer = [s.share for s in found if s is not None and s.length_m > longest_m]
        for k, least in enumerate((MIN_SURFACE_SHARE, MIN_MOST_SHARE)):
            shares[k, i] = sum(share >= least for share in longer) / max(len(searched), 1)
    return shares[0], shares[1]


def _surface_at(boxes: AgentTable, row: int, column: int, cloud: Obstacles | None, reach_m: float) -> Surface | None:
    """Follow the surface of one agent in one cloud up to `reach_m` from its center."""
    if cloud is None:
        return None
    center, size, yaw = boxes.center_m[row, column] - cloud.origin, boxes.size_m[row], float(boxes.yaw_rad[row, column])
    near = cloud.near(boxes.center_m[row, column, :2], reach_m)
    near = near[cloud.xyz[near, 2] > center[2] - size[2] / 2 + BOTTOM_M]
    local = rotate(cloud.xyz[near, :2].astype(np.float64) - center[:2], -yaw)
    sensor = rotate(cloud.sensor_of(near)[:2].astype(np.float64) - center[:2], -yaw)
    return find_surface(local, size[:2], sensor)


def find_surface(local: Array, size_m: Array, sensor: Array) -> Surface | None:
    """Find the surface that most points in a box are on, along its length or its width.

    Parameters
    ----------
    local : (N, 2) float64, m
        Points in and around the box, in its axes, relative to its center.
    size_m : (2,) float64
        Length and width.
    sensor : (2,) float64, m
        Likewise.

    Returns
    -------
    Surface or None
        None with too few points in the box.
    """
    inside: NDArray[np.bool_] = np.all(np.abs(local) <= size_m / 2 + STRUCTURE_MARGIN_M, axis=1)
    if inside.sum() < MIN_POINTS:
        return None
    found = [
        _along(local[:, axis], local[:, 1 - axis] * (1 if sensor[1 - axis] >= 0 else -1), inside) for axis in (0, 1)
    ]
    return max((s for s in found if s is not None), key=lambda s: s.share, default=None)


def _along(u: Array, v: Array, inside: NDArray[np.bool_]) -> Surface | None:
    """Follow the surface of the points `inside` along u; v grows toward the sensor."""
    cell = np.floor(u / CELL_M).astype(np.int64)
    order = np.flatnonzero(inside)[np.lexsort((v[inside], cell[inside]))]
    cells, first, count = np.unique(cell[order], return_index=True, return_counts=True)
    if len(cells) < MIN_CELLS:
        return None
    front = v[order[first + (FRONT_QUANTILE * (count - 1)).astype(np.intp)]]
    at = (cells + 0.5) * CELL_M
    i, j = np.triu_indices(len(at), 1)
    slope = np.median((front[j] - front[i]) / (at[j] - at[i]))  # Theil (1950)
    on = np.abs(v - slope * u - np.median(front - slope * at)) <= SURFACE_M
    own = np.sort(cell[on & inside])
    if len(own) < MIN_POINTS:
        return None
    occupied = np.unique(cell[on])
    gap = np.flatnonzero(np.diff(occupied) > MAX_EMPTY_CELLS + 1)
    middle = int(np.searchsorted(occupied, own[len(own) // 2]))
    start = int(gap[gap < middle].max(initial=-1)) + 1
    end = int(gap[gap >= middle].min(initial=len(occupied) - 1))
    return Surface(float(on[inside].mean()), float((occupied[end] - occupied[start] + 1) * CELL_M))


# A detection is never surer than this: 3 nats.
MAX_SCORE = 0.95
# Fewer rays at a tick say nothing.
MIN_TICK_RAYS = 8
# Nats of the rays of a tick: all of them end in what is there; more are not believed, since rays of one tick err alike.
RAY_NATS = 2.0
# Nats of a tick of a motion that no road user has.
MOTION_NATS = 1.0
# Agents times ticks that are looked at together; each takes about a hundred bytes.
MAX_CELLS = 400_000
# Rays toward a place before it is said that the LiDAR looks there.
MIN_LOOKING_RAYS = 30
# Fewer image boxes with points may each be wrong.
MIN_HEIGHTS = 3


def weigh(candidates: Sequence[AgentCandidate], recording: Recording) -> list[AgentCandidate]:
    """Return the candidates with what the LiDAR and the cameras say about them, and with all evidence for them.

    Notes
    -----
    Evidence is a sum over ticks of nats for the agent against nothing: of each detection by its score, of the rays by the
    share that goes through, and less for a motion that breaks the limits of road users.
    """
    weighed = list(candidates)
    order = sorted(range(len(candidates)), key=lambda k: float(candidates[k].agent.waypoints.t_s[0]))
    most = max(MAX_CELLS // max(len(recording.clouds), 1), 1)
    for first in range(0, len(order), most):
        rows = order[first : first + most]
        for k, candidate in zip(rows, _weigh_together([candidates[k] for k in rows], recording)):
            weighed[k] = candidate
    return weighed


def _weigh_together(candidates: Sequence[AgentCandidate], recording: Recording) -> list[AgentCandidate]:
    """Weigh candidates of which there are not too many."""
    agents, clouds, timeline = [c.agent for c in candidates], recording.clouds, recording.timeline
    solid, (inside, through, before) = count_rays(agents, clouds, timeline)
    in_structure, beside = structure_shares(agents, clouds, timeline)
    met = inside + through
    shown = shown_in_images(AgentTable.of(agents, recording.t_s), recording) & (met >= before) & (met >= MIN_TICK_RAYS)
    weighed = []
    for k, candidate in enumerate(candidates):
        rays = int(before[k].sum() + met[k].sum())
        pointless = bool(rays >= MIN_LOOKING_RAYS and not (candidate.track.measurements.points > 0).any())
        # Where points of it went to something beside it, rays still end in it.
        unreached = pointless and inside[k].sum() <= rays / 2
        support = replace(
            _support(*solid[:, k]),
            in_structure=float(in_structure[k]),
            beside_structure=float(beside[k]),
            pointless=pointless,
            unreached=bool(unreached and _same_view(candidate, clouds)),
            shown_ticks=int(shown[k].sum()),
            detected_ticks=int(shown[k, candidate.track.tick].sum()),
            image_ticks=int(shown[k, candidate.track.tick[candidate.track.measurements.camera != ""]].sum()),
            image_height_share=image_height_share(candidate.track.measurements),
        )
        weighed.append(replace(candidate, support=support, evidence=_nats(candidate, *solid[:2, k])))
    return weighed


def _support(inside: NDArray[np.int64], through: NDArray[np.int64], before: NDArray[np.int64]) -> Support:
    """Sum the rays of one agent over ticks (T,), without those at which only the border of what hides it shows."""
    met = inside + through
    seen = (met > 0) & (met >= before)
    return Support(int(inside[seen].sum()), int(through[seen].sum()), int(before.sum()), int(seen.sum()))


def image_height_share(m: Measurements) -> float | None:
    """Return the median height of the image boxes of a track at its distance over that of its points; None with few of both."""
    rows = ~m.truncated & (m.points > 0) & (m.top_m > m.bottom_m) & np.isfinite(m.height_px_m)
    return float(np.median(m.height_px_m[rows] / (m.top_m - m.bottom_m)[rows])) if rows.sum() >= MIN_HEIGHTS else None


def _same_view(candidate: AgentCandidate, clouds: Sequence[Obstacles | None]) -> bool:
    """Return whether the cameras that detect a candidate are where the LiDARs are."""
    track = candidate.track
    for tick, sensor in zip(track.tick.tolist(), track.measurements.sensor_m):
        cloud = clouds[tick]
        if cloud is not None:
            return bool(np.linalg.norm(sensor - cloud.origin - cloud.sensor) <= MAX_BASELINE_M)
    return False


def _nats(candidate: AgentCandidate, inside: NDArray[np.int64], through: NDArray[np.int64]) -> float:
    """Sum the evidence for one candidate, given its rays (T,)."""
    detections = -np.log1p(-MAX_SCORE * candidate.track.measurements.score).sum()
    met = inside + through
    decided = met >= MIN_TICK_RAYS
    rays: Array = RAY_NATS * (1 - 2 * through[decided] / met[decided])
    impossible = MOTION_NATS * len(candidate.agent.waypoints) if candidate.agent.doubts else 0.0
    return float(detections + rays.sum() - impossible)
