"""Agent candidates: agents made of tracks, whether they are confirmed, and what the LiDAR shows of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.size import TrackGeometry, independent, independent_along
from log2sim.datatypes import GROUP_OF, TYPICAL_SIZE_M, Agent, Finding, Track, Waypoints
from log2sim.datatypes.log_odds import probability_of
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception.lidar.measure import logit


def spans_of(mask: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Return the rows of each run of True in a mask (T,), in their order."""
    rows = np.flatnonzero(mask)
    return np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(rows) else []


@dataclass(frozen=True)
class Support:
    """Rays toward the solid part of an agent over its life, and the surfaces that its points are on.

    Attributes
    ----------
    inside, through, before : int
        Rays that end at the agent, that go on behind it, and that end before it; the first two at `seen_ticks`.
    seen_ticks : int
        Ticks at which most rays toward it do not end before it.
    in_structure : float
        Share of the searched ticks at which nearly all of its points are part of something longer than any of its kind.
    beside_structure : float
        Likewise, of most of its points.
    unreached : bool
        Whether it is pointless, most rays toward it do not end in it, and the cameras that detect it are where the LiDARs are.
    pointless : bool
        Whether the LiDAR looks toward it and none of its detections has a point.
    shown_ticks : int
        Ticks at which it is not hidden and a searched camera shows it well.
    detected_ticks : int
        Those of them at which it was detected, in an image or a sweep.
    image_ticks : int
        Those of them at which it was detected in an image.
    image_height_share : float, optional
        Height that its image boxes span at its distance over the height of its points, the median; None with few of both.
    """

    inside: int = 0
    through: int = 0
    before: int = 0
    seen_ticks: int = 0
    in_structure: float = 0.0
    beside_structure: float = 0.0
    unreached: bool = False
    pointless: bool = False
    shown_ticks: int = 0
    detected_ticks: int = 0
    image_ticks: int = 0
    image_height_share: float | None = None

    @property
    def through_share(self) -> float | None:
        """Share of the rays that met its place and went through; None without any."""
        met = self.inside + self.through
        return self.through / met if met else None


# Limits of `image_confidence`. A track whose size is unlikely for its category needs more, as do people, whom poles, bushes and
# signs look like: on the logs of `tools/fit.py confidence_logs --seed 3` those below 0.6 are right at 0.30 of their ticks, above at
# 0.95; vehicles and two-wheelers below at 0.85.
MIN_TRACK_CONFIDENCE = 0.3
MIN_SURE_TRACK_CONFIDENCE = 0.6
# Limit of `sweep_confidence`, which is a probability: an invented vehicle in the way costs a simulation twice what a missing
# one does.
MIN_SWEEP_CONFIDENCE = 2 / 3
# Number of the best detections whose mean score is the confidence. Independent detections would multiply; those of a video
# are not independent, so the confidence saturates.
CONFIDENCE_DETECTIONS = 5
# Detections of people and two-wheelers with a lower score continue a track and say nothing for it: about half are clutter.
WEAK_GROUPS, MIN_COUNTED_SCORE = ("pedestrian", "two_wheeler"), 0.3
HIDDEN_S = 1.0
# Evidence of a predicted box that fits the points of a new place, in nats: it does at four of five ticks of a vehicle, and at one
# of ten of clutter.
MATCH_NATS = float(np.log(0.8 / 0.1))
# Over so many ticks, half a second of usual logs, errors of positions average to less than the length of a person.
SMOOTHED_TICKS = 5
# Stamps of cameras and sweeps jitter; ticks are not nearer to each other than this.
MIN_PERIOD_S = 0.01


def is_confirmed(track: Track, *, typical: bool, followed: float = 0.0) -> bool:
    """Return whether the detections of a track in images or those in LiDAR sweeps suffice.

    Parameters
    ----------
    typical : bool
        Whether the size is likely for the category; an unlikely size needs a higher confidence.
    followed : float
        From `followed_confidence`.
    """
    ordinary = typical and GROUP_OF[track.category] != "pedestrian"
    least = MIN_TRACK_CONFIDENCE if ordinary else MIN_SURE_TRACK_CONFIDENCE
    if image_confidence(track) >= least:
        return True
    return max(sweep_confidence(track), moving_confidence(track), followed) >= MIN_SWEEP_CONFIDENCE


def image_confidence(track: Track) -> float:
    """Return the share of its searched ticks at which a track is detected in images, times the mean of the best scores there."""
    m = track.measurements
    weak = (m.score < MIN_COUNTED_SCORE) & (GROUP_OF[track.category] in WEAK_GROUPS)
    counted = np.flatnonzero(~(weak & np.isnan(m.box_yaw_rad)))
    in_image = counted[((np.isnan(m.box_yaw_rad) | (m.camera != "")) & ~weak)[counted]]
    if not len(in_image):
        return 0.0
    # A tick with a weak detection is none with an occlusion.
    between = slice(counted[0], counted[-1] + 1)
    rate = detection_rate(m.t_ns[between], track.tick[between], track.unrecorded) * len(counted) / len(m.t_ns[between])
    return rate * min(len(in_image) / len(counted) / track.searched, 1.0) * float(_strongest(m.score[in_image]).mean())


def sweep_confidence(track: Track) -> float:
    """Return the probability that a track is an object, from its boxes in LiDAR sweeps; 0 without any.

    Notes
    -----
    The scores are calibrated probabilities, so their log-odds add up, scaled down to those of as many independent ticks. A
    long false track has a few high scores by chance, which is why not the best alone count.
    """
    m = track.measurements
    in_sweep = np.isfinite(m.box_yaw_rad)
    if not in_sweep.any():
        return 0.0
    log_odds = float(logit(m.score[in_sweep]).mean()) * independent(int(in_sweep.sum()))
    return detection_rate(m.t_ns, track.tick, track.unrecorded) * float(probability_of(log_odds))


def moving_confidence(track: Track) -> float:
    """Return the probability that a track is an object, from its boxes in LiDAR sweeps and how far it moves; 0 without boxes.

    Notes
    -----
    Ticks count as `independent_along` has it. Errors of the positions are no motion: the places are means over `SMOOTHED_TICKS`.
    """
    m = track.measurements
    in_sweep = np.flatnonzero(np.isfinite(m.box_yaw_rad) & np.isfinite(m.center_m[:, 0]))
    if len(in_sweep) < SMOOTHED_TICKS:
        return 0.0
    window = np.full(SMOOTHED_TICKS, 1.0 / SMOOTHED_TICKS)
    places = np.stack([np.convolve(m.center_m[in_sweep, axis], window, mode="valid") for axis in range(2)], axis=1)
    looks = independent_along(places, TYPICAL_SIZE_M[track.category][0])
    log_odds = float(logit(m.score[in_sweep]).mean()) * looks
    return detection_rate(m.t_ns, track.tick, track.unrecorded) * float(probability_of(log_odds))


def followed_confidence(track: Track, xy_m: Array) -> float:
    """Return the probability that a track is a vehicle, from its boxes in LiDAR sweeps and the points that its box met elsewhere.

    Parameters
    ----------
    xy_m : (n, 2) float64
        Places in rising time that were free when the box was not there, and where points fit it without a detection.

    Notes
    -----
    A box of one size that is moved on by its velocity alone seldom fits the points of such places by chance.
    """
    m = track.measurements
    in_sweep = np.flatnonzero(np.isfinite(m.box_yaw_rad) & np.isfinite(m.center_m[:, 0]))
    if not len(in_sweep) or len(xy_m) < SMOOTHED_TICKS or GROUP_OF[track.category] != "vehicle":
        return 0.0
    length_m = TYPICAL_SIZE_M[track.category][0]
    detected = float(logit(m.score[in_sweep]).mean()) * independent_along(m.center_m[in_sweep, :2], length_m)
    return float(probability_of(detected + MATCH_NATS * independent_along(xy_m, length_m)))


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
    period_s = max(float(np.median(np.diff(t_ns[first]) / NS_PER_S / ticks)), MIN_PERIOD_S)
    recorded = ticks - (np.searchsorted(unrecorded, tick[1:]) - np.searchsorted(unrecorded, tick[:-1], side="right"))
    hidden_ticks = max(HIDDEN_S / 2 / period_s, 2.0)
    return len(tick) / (1 + float(np.where(recorded * period_s > HIDDEN_S, hidden_ticks, recorded).sum()))


def _strongest(score: Array) -> Array:
    return np.sort(score)[-CONFIDENCE_DETECTIONS:]


# Distance from the rear axle to the box center as a share of the length: BMW 320i of CommonRoad's vehicle models, rounded.
REAR_AXLE_SHARE = {"vehicle": 0.28, "two_wheeler": 0.3}


@dataclass(frozen=True, eq=False)
class Timeline:
    """The ticks of a run.

    Attributes
    ----------
    t_ns : (T,) int64
    t0_ns : int
        Start of the scenario.
    """

    t_ns: NDArray[np.int64]
    t0_ns: int

    def seconds(self, t_ns: NDArray[np.int64]) -> Array:
        """Convert stamps to seconds since the start."""
        return np.asarray((t_ns - self.t0_ns) / NS_PER_S, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class AgentCandidate:
    """An agent made of one track, with what it is made of.

    Attributes
    ----------
    evidence : float
        Sum of the scores of its detections; in nats, with all other evidence, once it is weighed.
    confirmed : bool
        Whether the confidence of the track suffices.
    track : Track
        Whose measurements, one at each of its ticks, the agent is made of.
    geometry : TrackGeometry
        Size of the track, and positions at its measurements.
    support : Support, optional
        What the points of the LiDAR say about it, once it is weighed.
    """

    agent: Agent
    evidence: float
    confirmed: bool
    track: Track
    geometry: TrackGeometry
    support: Support | None = None

    def doubted(self, doubts: Sequence[Finding]) -> Self:
        """Return the candidate with more doubts of its agent."""
        return replace(self, agent=replace(self.agent, doubts=(*self.agent.doubts, *doubts))) if doubts else self


def candidate_of(
    track: Track,
    geometry: TrackGeometry,
    waypoints: Waypoints,
    quality: dict[str, Any],
    *,
    static: bool,
    followed: float = 0.0,
) -> AgentCandidate:
    """Make a candidate of a track, its geometry, waypoints and `followed_confidence`; `quality` is added to that of the track."""
    m = track.measurements
    length, width, height = (float(v) for v in geometry.size_m)
    agent = Agent(
        id="",
        category=track.category,
        size_m=(length, width, height),
        waypoints=waypoints,
        static=static,
        rear_axle_offset_m=round(REAR_AXLE_SHARE.get(GROUP_OF[track.category], 0.0) * length, 3),
        quality=_quality_of(track) | quality,
    )
    return AgentCandidate(
        agent, float(m.score.sum()), is_confirmed(track, typical=geometry.is_likely, followed=followed), track, geometry
    )


def _quality_of(track: Track) -> dict[str, Any]:
    m = track.measurements
    return {
        "detections": len(m),
        "without_lidar": int((m.source != "lidar").sum()),
        "points_median": float(np.median(m.points)),
        "score_max": round(float(m.score.max()), 4),
    }


def name_agents(candidates: Sequence[AgentCandidate]) -> list[AgentCandidate]:
    """Sort candidates by their first time and name their agents by category and number, such as "car-1"."""
    ordered = sorted(candidates, key=lambda c: (float(c.agent.waypoints.t_s[0]), float(c.agent.waypoints.x_m[0])))
    count: dict[str, int] = {}
    named = []
    for candidate in ordered:
        category = candidate.agent.category
        count[category] = count.get(category, 0) + 1
        named.append(replace(candidate, agent=replace(candidate.agent, id=f"{category}-{count[category]}")))
    return named
