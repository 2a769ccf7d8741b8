"""Evidence for and against candidates over the whole log: one table, a column for each reason.

What the weights of `agents/weights.py` make of a column is a log-likelihood ratio in nats; `agents/judge.py` adds them up.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.candidate import AgentCandidate, Timeline
from log2sim.agents.rays import count_rays
from log2sim.agents.size import independent
from log2sim.agents.weights import THERE
from log2sim.datatypes import GROUP_OF, MAX_SIZE_M, MIN_SIZE_M, TYPICAL_SIZE_M, AgentTable, Obstacles, Track
from log2sim.datatypes.log_odds import MAX_PROBABILITY, MIN_PROBABILITY, log_odds_of
from log2sim.geometry import NS_PER_S, Array, median
from log2sim.perception.boxes import LIMIT_SIGMAS, rotate
from log2sim.perception.lidar.measure import logit


@dataclass(frozen=True, eq=False)
class Recording:
    """What the LiDARs of a log recorded at the ticks of a run."""

    lidar: bool  # whether it has any
    clouds: Sequence[Obstacles | None]  # (T,): None at ticks without LiDAR
    timeline: Timeline

    @property
    def t_s(self) -> Array:
        """Times (T,) of the ticks since the start."""
        return self.timeline.seconds(self.timeline.t_ns)


SIGNS = {
    "sweep": 1, "weak_sweep": 1, "image": 1, "travel": 1, "few": -1, "brief": -1, "scatter": -1, "sigma": -1, "unlikely_size": -1,
    "odd_size": -1, "odd_height": -1, "heading": 1, "other_category": -1, "impossible": -1, "sigma_speed": -1, "through": -1,
    "through_gaps": -1, "continued": -1, "remains": -1, "thin": -1, "moving": 0, "two_wheeler": 0, "pedestrian": 0,
}  # fmt: skip
"""Columns of the table, and whether a candidate with more of one is rather right (1) or wrong (-1); 0 where either may be.

- sweep, weak_sweep, image: log-odds of its detections in LiDAR sweeps, and of the points that its box met elsewhere, where positive and
  where negative; and of its detections in images, for what is in sweeps where positive: detectors miss the same object in image after
  image. 0 without any.
- travel: logarithm of the way of what moves beyond the drift of poses, in units of its length, plus 1: what is mistaken for a road user
  stays where it is, or, of few points, where it is before the sensor.
- few, brief: 1 by the number of its measurements, and by its duration in units of 1 s, plus 1.
- scatter: logarithm of the median squared distance of its measurements from the trajectory in standard deviations, plus 1.
- sigma: logarithm of the standard deviation of its position, in units of 0.1 m.
- unlikely_size: 1 where the observed size is none of its category.
- odd_size: by how many standard deviations of the category length and width differ from the typical ones.
- odd_height: root mean square logarithm of the height that its image boxes span where a homography places it, in units of the
  typical one: at the wrong distance, or on other ground than was thought, it is too high or too low. 0 with few.
- heading: log-odds that the front is the front; 0 where nothing was decided.
- other_category: share of its measurements of another category.
- impossible: 1 where its motion is doubted.
- sigma_speed: logarithm of the standard deviation of the speed of what moves, in units of 0.3 m/s.
- through, through_gaps: logarithm of the rays toward its solid part over those that end in it, of vehicles and of what has gaps, as
  people and bicycles have: all others go on behind it; 0 with few.
- continued: mean over the sides and the top of a vehicle of the density of points just beyond over that just inside: walls, hedges and
  fences go on there, vehicles end.
- remains: mean share of the points of what moves that are also where it is not yet or no more: what stays is no mover.
- thin: logarithm of the typical width of a person over the widest extent of its points, where positive: poles are thinner.
- moving, two_wheeler, pedestrian: 1 for one that moves, and for those of these groups.
"""

# Table of C candidates: each column (C,), by name. Beside those of `SIGNS` it has `bias`, all 1, `confirmed`, 1
# where the detections alone make it likely, and `pointless`, 1 where LiDAR rays go toward it and none of its detections has a point.
Table = dict[str, Array]


def gather(candidates: Sequence[AgentCandidate], recording: Recording) -> Table:
    """Gather the evidence for and against each of C candidates."""
    if not candidates:
        return {name: np.zeros(0) for name in ("bias", "confirmed", "pointless", *SIGNS)}
    most = MAX_CELLS // max(len(recording.clouds), 1) or 1
    # Those that are there at the same time together, so that each cloud is looked at by few shares of a long log.
    order = sorted(range(len(candidates)), key=lambda k: float(candidates[k].agent.waypoints.t_s[0]))
    parts = []
    for k in range(0, len(order), most):
        share = [candidates[i] for i in order[k : k + most]]
        rows = [_own_columns(c, recording.timeline) for c in share]
        own = {name: np.array([row[name] for row in rows]) for name in rows[0]}
        parts.append(own | _sensed_columns(share, recording))
    table = {name: np.concatenate([part[name] for part in parts])[np.argsort(order)] for name in parts[0]}
    return table | {"bias": np.ones(len(candidates))}


# Evidence of a predicted box that fits the points of a new place, in nats: it does at four of five ticks of a vehicle, and at one
# of ten of clutter. A box of one size that is moved on by its velocity alone seldom does by chance.
MATCH_NATS, MAX_LOG_ODDS = float(np.log(0.8 / 0.1)), float(log_odds_of(MAX_PROBABILITY))


# Beyond these, more evidence adds nothing: logarithms, standard deviations of sizes, twice or half the typical height, log-odds.
LIMITS: dict[str, tuple[float, float]] = {
    "sigma": (np.log(0.1), np.log(50.0)), "scatter": (0.0, np.log(31.0)), "odd_size": (0.0, 3.0),
    "odd_height": (0.0, np.log(2.0)), "heading": (-MAX_LOG_ODDS, MAX_LOG_ODDS), "sigma_speed": (np.log(0.07), np.log(17.0)),
}  # fmt: skip


def _own_columns(candidate: AgentCandidate, timeline: Timeline) -> dict[str, float]:
    """Return the columns of one candidate that need nothing but itself."""
    track, agent, m, w = candidate.track, candidate.agent, candidate.track.measurements, candidate.agent.waypoints
    in_sweep, in_image = np.isfinite(m.box_yaw_rad), m.camera != ""
    in_image |= ~in_sweep
    group, moving = GROUP_OF[agent.category], not agent.static
    way_m = float(np.hypot(np.ptp(w.x_m), np.ptp(w.y_m))) if moving else 0.0
    # So few points do not show whether they stay behind (`remaining`): what moves as the sensor does may be its artifact, such as rings
    # on a wall along the road.
    if np.median(m.points) < MIN_SIDE_POINTS:
        way_m = min(way_m, float(np.hypot(*np.ptp((m.center_m - m.sensor_m)[:, :2], axis=0))))
    way_m = max(way_m - DRIFT_MPS * float(w.t_s[-1] - w.t_s[0]), 0.0)
    sweep = sweep_log_odds(track) if in_sweep.any() else 0.0
    if group == "vehicle" and in_sweep.any():
        sweep = min(sweep + MATCH_NATS * candidate.followed, MAX_LOG_ODDS)
    moved = sweep + float(np.log1p(way_m / DRIFT_M)) if in_sweep.any() else 0.0
    # The place of a standing agent is fitted to its measurements, so their residuals are no test of it; and the measured centers of
    # a long moving vehicle lag behind its points.
    geometry, at = candidate.geometry, timeline.seconds(m.t_ns)
    xy, covariance = (geometry.xy_m, geometry.covariance) if moving else (m.center_m[:, :2], m.covariance)
    off = xy - np.stack([np.interp(at, w.t_s, w.x_m), np.interp(at, w.t_s, w.y_m)], axis=1)
    scatter = float(np.median(np.einsum("na,nab,nb->n", off, np.linalg.pinv(covariance), off)))
    smallest, typical, largest = (np.array(t[agent.category]) for t in (MIN_SIZE_M, TYPICAL_SIZE_M, MAX_SIZE_M))
    odd = (np.log(np.array(agent.size_m) / typical) * LIMIT_SIGMAS / np.log(largest / smallest))[:2]
    placed = (m.source == "topdown") & np.isfinite(m.height_px_m)
    placed = placed & ~m.truncated if (placed & ~m.truncated).any() else placed
    high = np.log(m.height_px_m[placed] / typical[2] + 1e-3).clip(-LIMITS["odd_height"][1], LIMITS["odd_height"][1])
    widest = (m.high_m - m.low_m).max(axis=1)[m.points >= MIN_WIDE_POINTS]
    widest = widest[np.isfinite(widest)]
    thin = float(np.log(typical[1] / (np.median(widest) + EXTENT_ERROR_M))) if len(widest) else 0.0
    # By images alone, people and what has an unlikely size need more than others.
    ordinary = geometry.is_likely and group != "pedestrian"
    shown = image_confidence(track)
    sure = shown >= (MIN_IMAGE_CONFIDENCE if ordinary else MIN_SURE_IMAGE_CONFIDENCE)
    by_images = float(logit(np.array(shown))) if in_image.any() else 0.0
    speed_sigma = w.sigma_speed_mps if moving else None
    columns: dict[str, float] = {
        "sweep": max(sweep, 0.0),
        "weak_sweep": min(sweep, 0.0),
        "image": max(by_images, 0.0) if in_sweep.any() else by_images,
        "travel": float(np.log1p(way_m / agent.size_m[0])),
        "few": 1.0 / len(m),
        "brief": 1.0 / (1.0 + float(w.t_s[-1] - w.t_s[0])),
        "scatter": np.log1p(scatter),
        "sigma": np.log(np.median(w.sigma_xy_m) / 0.1 + 1e-3),
        "unlikely_size": float(not geometry.is_likely),
        "odd_size": float(np.hypot(*odd)),
        "odd_height": float(np.sqrt(np.mean(high**2))) if placed.mean() >= MIN_PLACED_SHARE else 0.0,
        "thin": max(thin, 0.0) if group == "pedestrian" else 0.0,
        "heading": float(
            log_odds_of(np.clip(agent.quality.get("heading_confidence", 0.5), MIN_PROBABILITY, MAX_PROBABILITY))
        ),
        "other_category": float((m.category != agent.category).mean()),
        "impossible": float(any(d.kind != "heading_ambiguous" for d in agent.doubts)),
        "sigma_speed": 0.0 if speed_sigma is None else np.log(np.median(speed_sigma) / 0.3 + 1e-3),
        "moving": float(moving),
        "confirmed": float(moved >= MIN_SWEEP_LOG_ODDS or sure),
        "two_wheeler": float(group == "two_wheeler"),
        "pedestrian": float(group == "pedestrian"),
    }
    return columns | {name: float(np.clip(columns[name], low, high)) for name, (low, high) in LIMITS.items()}


# A smaller share of measurements that a homography placed are boxes of something else; 0.1 to 0.4 give the same (64 simulated logs).
MIN_PLACED_SHARE = 0.2
# Fewer points may lie on one side of a person; by so much extents of points err, m.
MIN_WIDE_POINTS, EXTENT_ERROR_M = 5, 0.05


# Confidence by images that suffices. A track whose size is unlikely for its category needs more, as do people, whom poles, bushes
# and signs look like. Boxes in sweeps suffice where an object is twice as likely as none; what moves on is not what stays, which
# seems to move by `DRIFT_M` as other sides come into view, and with poses that drift, those of GNSS without corrections by `DRIFT_MPS`
# at most (KITTI's by 0.2 to 0.5 m/s); people walk at 0.8 m/s and more. On 35 simulated logs 0.2, 0.35 and 0.5 m/s give the same.
MIN_IMAGE_CONFIDENCE, MIN_SURE_IMAGE_CONFIDENCE, MIN_SWEEP_LOG_ODDS, DRIFT_M = 0.3, 0.6, float(np.log(2.0)), 2.0
DRIFT_MPS = 0.5


# What is less likely there is dropped. Without a LiDAR, what is not there is mostly placed wrong, which is for doubts. A tentative track,
# whose detections alone do not make it likely, rests on all other evidence: to invent such an agent is as bad as to miss four.
MIN_THERE, MIN_TENTATIVE_THERE = {True: 0.5, False: 0.25}, 0.8
# Points show a person or rider who moves on a way of so many times that of the detections at most.
MOST_FOLLOWED = 3.0
# Tentative tracks of simulated logs that are objects, for each confirmed one and as a share of all tentative ones (136 logs). Half and twice as
# many for each change recall / precision of agents on 70 of them from .501 / .951 to .496 / .953 and .505 / .947.
TENTATIVE_PER_CONFIRMED, TENTATIVE_SHARE = 0.43, 0.46
# What the way and the rays of an object add to its log-odds at most: of all but one in a hundred in simulated logs.
MOST_ADDED = 0.6


def is_confirmed(track: Track) -> bool:
    """Return whether a track is likely an object by its detections alone: twice as likely as not, in sweeps, or by images."""
    if image_confidence(track) >= MIN_IMAGE_CONFIDENCE:
        return True
    return bool(np.isfinite(track.measurements.box_yaw_rad).any()) and sweep_log_odds(track) >= MIN_SWEEP_LOG_ODDS


def clutter_nats(tracks: Sequence[Track]) -> float:
    """Return by how much tentative tracks are less likely objects in this log than in those that the weights were fitted on.

    Streets with hedges, fences and trees give many times as many tentative tracks for each confirmed one, but objects are detected as well as
    elsewhere, so that the excess is clutter. A prior that changes adds the difference of its log-odds to those of a classifier
    (Saerens, Latinne, Decaestecker, Neural Computation 14, 2002).
    """
    confirmed = sum(map(is_confirmed, tracks))
    share = (TENTATIVE_PER_CONFIRMED * confirmed + 1) / (len(tracks) - confirmed + 1 / TENTATIVE_SHARE)
    return float(log_odds_of(TENTATIVE_SHARE) - log_odds_of(min(share, TENTATIVE_SHARE)))


def may_suffice(track: Track, *, static: bool, clutter: float = 0.0) -> bool:
    """Return whether the evidence of a track may suffice once its way is estimated: most clutter is not worth the smoothing.

    `clutter`: from `clutter_nats`.
    """
    m, group = track.measurements, GROUP_OF[track.category]
    if is_confirmed(track) or (group == "vehicle" and not static):
        return True
    if not np.isfinite(m.box_yaw_rad).any():
        return False
    odds, way_m = sweep_log_odds(track), 0.0
    if not static:
        way_m = MOST_FOLLOWED * float(np.hypot(*np.ptp(m.center_m[:, :2], axis=0)))
    if odds + np.log1p(way_m / DRIFT_M) >= MIN_SWEEP_LOG_ODDS:
        return True
    travel = np.log1p(way_m / TYPICAL_SIZE_M[track.category][0])
    columns = {"bias": 1.0, "sweep": max(odds, 0.0), "weak_sweep": min(odds, 0.0), "few": 1 / len(m), "travel": travel}
    columns |= {"moving": float(not static), group: 1.0}
    most = sum(weight * columns.get(name, 0.0) for name, weight in THERE[True].items()) + MOST_ADDED
    return bool(most - clutter >= log_odds_of(MIN_TENTATIVE_THERE))


# Number of the best detections whose mean score is the confidence. Independent detections would multiply; those of a video
# are not independent, so the confidence saturates.
CONFIDENCE_DETECTIONS = 5
HIDDEN_S = 1.0
# Stamps of cameras and sweeps jitter; ticks are not nearer to each other than this.
MIN_PERIOD_S = 0.01


def image_confidence(track: Track) -> float:
    """Return the share of its searched ticks at which a track is detected in images, times the mean of the best scores there.

    Where tiles take turns, the ticks within which all are searched count as one.
    """
    m = track.measurements
    in_image = np.isnan(m.box_yaw_rad) | (m.camera != "")
    search = track.tick // track.ticks_per_search
    share = len(np.unique(search[in_image])) / len(np.unique(search))
    rate = detection_rate(m.t_ns, track.tick, track.unrecorded) * min(share / track.searched, 1.0)
    return float(rate * np.sort(m.score[in_image])[-CONFIDENCE_DETECTIONS:].mean()) if in_image.any() else 0.0


def sweep_log_odds(track: Track) -> float:
    """Return the log-odds that a track is an object, from its boxes in LiDAR sweeps, of which it has some.

    The scores are calibrated probabilities, so their log-odds add up, scaled down to those of as many independent ticks. A
    long false track has a few high scores by chance, which is why not the best alone count.
    """
    m = track.measurements
    in_sweep = np.isfinite(m.box_yaw_rad)
    odds = float(logit(m.score[in_sweep]).mean()) * independent(int(in_sweep.sum()))
    rate = detection_rate(m.t_ns, track.tick, track.unrecorded)
    return float(logit(np.array(rate / (1 + np.exp(-odds)))))


def detection_rate(t_ns: NDArray[np.int64], tick: NDArray[np.int64], unrecorded: NDArray[np.int64]) -> float:
    """Return the share of ticks with a detection between the first and the last of ticks (n,), which have stamps (n,).

    A gap longer than `HIDDEN_S` counts as an occlusion: half of `HIDDEN_S` of it enters the detection rate, at least one tick
    without a detection. Ticks (U,) at which nothing was recorded do not count.
    """
    # Both ends may measure an object at one tick.
    tick, first = np.unique(tick, return_index=True)
    ticks = np.diff(tick)
    if len(ticks) == 0:
        return 1.0
    # Not the time between detections: something that is detected at every fifth tick has a rate of a fifth.
    period_s = max(median(np.diff(t_ns[first]) / NS_PER_S / ticks), MIN_PERIOD_S)
    recorded = ticks - (np.searchsorted(unrecorded, tick[1:]) - np.searchsorted(unrecorded, tick[:-1], side="right"))
    hidden_ticks = max(HIDDEN_S / 2 / period_s, 2.0)
    return len(tick) / (1 + float(np.where(recorded * period_s > HIDDEN_S, hidden_ticks, recorded).sum()))


# Agents times ticks that are looked at together; each takes about a hundred bytes.
MAX_CELLS = 400_000
# Rays toward a place before it is said that the LiDAR looks there, and at a tick before they say anything.
MIN_LOOKING_RAYS, MIN_TICK_RAYS = 30, 8
# One ray of thirty ends in anything by chance.
MAX_THROUGH_NATS = float(np.log(30.0))
# Rays of fewer ticks may all have gone through a window or past a corner.
MIN_SEEN_TICKS = 3


def _sensed_columns(candidates: Sequence[AgentCandidate], recording: Recording) -> Table:
    """Return the columns of rays and points, of candidates of which there are not too many."""
    agents = [c.agent for c in candidates]
    inside, through, before = count_rays(agents, recording.clouds, recording.timeline)
    met = inside + through
    # Elsewhere only the border of what hides it shows.
    seen = (met > 0) & (met >= before)
    sums = [np.where(seen, rays, 0).sum(axis=1) for rays in (met, through)]
    known = (sums[0] >= MIN_LOOKING_RAYS) & (seen.sum(axis=1) >= MIN_SEEN_TICKS)
    boxes = AgentTable.of(agents, recording.t_s)
    of = [c.track.measurements for c in candidates]
    looking = (met + before).sum(axis=1) >= MIN_LOOKING_RAYS
    through_nats = np.where(known, np.log((sums[0] + 1) / (sums[0] - sums[1] + 1)), 0.0).clip(max=MAX_THROUGH_NATS)
    solid = np.array([GROUP_OF[agent.category] == "vehicle" for agent in agents])
    return {
        "through": np.where(solid, through_nats, 0.0),
        "through_gaps": np.where(solid, 0.0, through_nats),
        "continued": continued(boxes, recording.clouds) * solid,
        "remains": remaining(boxes, recording.clouds),
        "pointless": np.array([look and not (m.points > 0).any() for look, m in zip(looking, of)], dtype=np.float64),
    }  # fmt: skip


# Points so near a side of a box, m, are compared with those as far beyond it, but for the error of a side; so high above its floor,
# where curbs and low plants end. Of fewer points no density is known. So many ticks of each agent suffice.
SIDE_M, SIDE_ERROR_M, ABOVE_FLOOR_M, MIN_SIDE_POINTS, SIDE_TICKS = 0.5, 0.1, 0.4, 5, 8


def continued(boxes: AgentTable, clouds: Sequence[Obstacles | None]) -> Array:
    """Return the densities of points just beyond the sides and tops of boxes over those just inside (A,), means of at most 1 each.

    Only where the points inside are, which is where rays arrive: beyond a side of a vehicle whose end they show is nothing.
    """
    inside, beyond = np.zeros((len(boxes.present), 5)), np.zeros((len(boxes.present), 5))
    visits = [(tick, k) for k, ticks in enumerate(_recorded(boxes, clouds)) for tick in _some(ticks, SIDE_TICKS)]
    for cloud, tick, k in _with_clouds(visits, clouds):
        half, points = boxes.size_m[k] / 2, _points_at(boxes, k, tick, cloud, SIDE_M)
        local = np.vstack([rotate(points[:, :2], -boxes.yaw_rad[k, tick]).T, points[:, 2]])
        within = np.abs(local) < (half + SIDE_ERROR_M / 2)[:, None]
        for side, (axis, sign) in enumerate(((0, 1), (0, -1), (1, 1), (1, -1), (2, 1))):
            depth, across = sign * local[axis] - half[axis], [a for a in range(3) if a != axis]
            own = (
                (depth > SIDE_ERROR_M / 2 - SIDE_M)
                & (depth <= SIDE_ERROR_M / 2)
                & within[across[0]]
                & within[across[1]]
            )
            count = np.count_nonzero(own)
            if count < MIN_SIDE_POINTS:
                continue
            level = np.ones(len(points), dtype=bool)
            for column in local[across]:
                ordered = np.sort(column[own])
                low, high = ordered[count // 10], ordered[-1 - count // 10]  # but for stray points
                level &= (column > low - SIDE_ERROR_M) & (column < high + SIDE_ERROR_M)
            inside[k, side] += np.count_nonzero(own & level)
            beyond[k, side] += np.count_nonzero((depth > SIDE_ERROR_M) & (depth <= SIDE_ERROR_M + SIDE_M) & level)
    share = np.minimum(beyond / np.maximum(inside, 1), 1)
    return np.asarray(share.sum(axis=1) / np.maximum((inside > 0).sum(axis=1), 1))


# An agent that moved so far, m, left its place by more than the errors of boxes. So many ticks of each agent suffice.
MOVED_M, MOVED_TICKS = 1.5, 4


def remaining(boxes: AgentTable, clouds: Sequence[Obstacles | None]) -> Array:
    """Return the mean shares (A,) of the points of agents that are there also when these have left, or have not come yet.

    Compared are pairs of ticks between which an agent moves by `MOVED_M`, in the part of its box at one that is outside of its box at
    the other, by as many points as a surface shows at the other distance. 0 for what stands.
    """
    pairs = []
    for k, ticks in enumerate(_recorded(boxes, clouds)):
        way = boxes.center_m[k, ticks, :2]
        for first in _some(np.arange(len(ticks)), MOVED_TICKS):
            moved = np.flatnonzero(np.hypot(*(way[first:] - way[first]).T) >= MOVED_M)
            for last in moved[:1].tolist():
                pair = int(ticks[first]), int(ticks[first + last])
                pairs += [(k, *pair), (k, *pair[::-1])]
    points, spread_m2 = np.zeros((len(pairs), 2)), np.ones((len(pairs), 2))
    visits = [(pair[1 + at], 2 * n + at) for n, pair in enumerate(pairs) for at in range(2)]
    for cloud, _, visit in _with_clouds(visits, clouds):
        n, at = divmod(visit, 2)
        k, place, other = pairs[n]
        center, half = boxes.center_m[k], boxes.size_m[k, :2] / 2
        near = _points_at(boxes, k, place, cloud, SIDE_ERROR_M)
        xy = near[near[:, 2] <= boxes.size_m[k, 2] / 2 + SIDE_ERROR_M, :2]
        own = rotate(xy, -boxes.yaw_rad[k, place])
        elsewhere = rotate(xy + (center[place] - center[other])[:2], -boxes.yaw_rad[k, other])
        vacated = (np.abs(own) <= half + SIDE_ERROR_M).all(axis=1) & (np.abs(elsewhere) > half + SIDE_M / 2).any(axis=1)
        points[n, at] = vacated.sum()
        spread_m2[n, at] = np.sum((center[place] - cloud.origin - cloud.sensor)[:2] ** 2)
    known = points[:, 0] >= MIN_SIDE_POINTS
    share = np.minimum(points[:, 1] * spread_m2[:, 1] / np.maximum(points[:, 0] * spread_m2[:, 0], 1e-9), 1.0)[known]
    agent = np.array([k for k, *_ in pairs], dtype=np.intp)[known]
    count = np.bincount(agent, minlength=len(boxes.present))
    return np.asarray(np.bincount(agent, share, len(count)) / np.maximum(count, 1))


def _recorded(boxes: AgentTable, clouds: Sequence[Obstacles | None]) -> list[NDArray[np.intp]]:
    """Return for each of A agents the ticks at which it is there and a LiDAR recorded."""
    recorded = np.array([cloud is not None for cloud in clouds], dtype=bool)
    return [np.flatnonzero(present & recorded) for present in boxes.present]


def _some(ticks: NDArray[np.intp], most: int) -> list[int]:
    """Return at most so many ticks, evenly spaced."""
    return [int(tick) for tick in ticks[:: -(-len(ticks) // most) or 1]]


def _with_clouds(
    visits: list[tuple[int, int]], clouds: Sequence[Obstacles | None]
) -> Iterator[tuple[Obstacles, int, int]]:
    """Yield visits, a tick and a number each, in the order of their ticks with the cloud of the tick, which is read once."""
    for tick, same in groupby(sorted(visits), itemgetter(0)):
        cloud = clouds[tick]
        assert cloud is not None
        for _, number in same:
            yield cloud, tick, number


def _points_at(boxes: AgentTable, k: int, tick: int, cloud: Obstacles, margin_m: float) -> Array:
    """Return the points (n, 3) of a cloud around an agent's place at a tick, from its center, without those near its floor."""
    center, half_m = boxes.center_m[k, tick], boxes.size_m[k] / 2
    near = cloud.xyz[cloud.near(center[:2], float(np.hypot(*half_m[:2])) + margin_m)] - (center - cloud.origin)
    return np.asarray(near[near[:, 2] > ABOVE_FLOOR_M - half_m[2]], dtype=np.float64)
