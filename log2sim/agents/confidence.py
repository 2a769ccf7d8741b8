"""How far an agent can be trusted: the probability that it is right, and its standard deviations.

Printed by `tools/fit.py confidence` on the logs of `tools/fit.py confidence_logs`: `WITHOUT_LIDAR` with `--seed 3` and `--seed 4`, 1066
agents of 120 synthetic logs; all else with `--seed 3`, 1369 agents of 70.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from log2sim.agents.candidate import AgentCandidate, Timeline, image_confidence, sweep_confidence
from log2sim.datatypes import GROUP_OF, TYPICAL_SIZE_M, Waypoints
from log2sim.datatypes.log_odds import probability_of
from log2sim.geometry import Array
from log2sim.perception.lidar.measure import logit

WITH_LIDAR = {
    "image": 0.1081,
    "sweep": 0.08424,
    "few": -0.8772,
    "brief": -0.6452,
    "blind": -1.067,
    "range": 0.0,
    "scatter": -0.4745,
    "sigma": -0.3635,
    "unlikely_size": -0.6148,
    "odd_size": -0.5564,
    "hidden": -1.793,
    "heading": 0.1882,
    "other_category": -1.156,
    "doubts": -0.6274,
    "moving": -0.7639,
    "two_wheeler": -0.4416,
    "pedestrian": -0.2002,
    "other": -2.952,
    "bias": 2.424,
}
WITHOUT_LIDAR = {
    "image": 0.1793,
    "few": -0.6211,
    "brief": -0.8314,
    "range": -0.05646,
    "scatter": -0.1955,
    "sigma": -0.6134,
    "odd_height": -2.69,
    "heading": 0.0,
    "other_category": -2.325,
    "doubts": -0.2805,
    "moving": -1.314,
    "two_wheeler": 0.07761,
    "pedestrian": 0.5601,
    "other": -2.914,
    "bias": 0.8547,
}
POSITION_VARIANCE = {
    "given": 1.599,
    "given_moving": 1.009,
    "hidden": 0.003781,
    "range": 0.0001366,
    "wrong": 0.04673,
}
YAW_VARIANCE = {
    "given": 0.25,
    "wrong": 0.2422,
}
SPEED_VARIANCE = {
    "given": 4.335,
    "standing": 5.145,
    "moving": 0.3874,
}


# Of the extents seen at all ticks, this quantile counts as seen at some time: stray points lengthen a few.
SEEN_QUANTILE = 0.85
# Standard deviation of the lengths and widths within a category, as a share: of cars it is a tenth, of trucks more.
SIZE_SPREAD = 0.15
MAX_SIZE_SIGMAS = 3.0
# Probabilities nearer to 1 are not believed.
MAX_HEADING_CONFIDENCE = 0.99
# Beyond these, more evidence adds nothing.
MAX_SCATTER, MAX_RANGE_M, MAX_DOUBTS = 30.0, 100.0, 2
# Twice or half the typical height.
MAX_ODD_HEIGHT = float(np.log(2.0))
MIN_RANGE_M, MIN_SIGMA_M, MAX_SIGMA_M = 2.0, 0.01, 5.0


@dataclass(frozen=True)
class Evidence:
    """Evidence for and against a candidate; `SIGNS` says which is which.

    Attributes
    ----------
    image : float
        Log-odds of its confidence by images, where no sweep shows it; 0 elsewhere.
    sweep : float
        Log-odds of its confidence by boxes in LiDAR sweeps; 0 without.
    few : float
        1 by the number of its measurements.
    brief : float
        1 by its duration, in units of 1 s, plus 1: motion shows over time.
    blind : float
        Share of its measurements without LiDAR.
    range : float
        Logarithm of the median distance, in units of 20 m.
    scatter : float
        Logarithm of the median squared distance of its measurements from the trajectory in standard deviations.
    sigma : float
        Logarithm of the standard deviation of its position, in units of 0.1 m.
    unlikely_size : float
        1 when the observed size is none of its category.
    odd_size : float
        By how many standard deviations of the category length and width differ from the typical ones.
    odd_height : float
        Root mean square logarithm of the height that its image boxes span where a homography places it, in units of the
        typical one: at the wrong distance, or on other ground than was thought, it is too high or too low. 0 without any.
    hidden : float
        Share of its length that was never seen at one time.
    heading : float
        Log-odds that the front is the front; 0 where nothing was decided.
    other_category : float
        Share of its measurements of another category.
    doubts : float
        Number of its doubts.
    moving, two_wheeler, pedestrian, other : float
        1 for one that moves, and for those of these groups.
    """

    image: float
    sweep: float
    few: float
    brief: float
    blind: float
    range: float
    scatter: float
    sigma: float
    unlikely_size: float
    odd_size: float
    odd_height: float
    hidden: float
    heading: float
    other_category: float
    doubts: float
    moving: float
    two_wheeler: float
    pedestrian: float
    other: float


# Whether an agent with more of it is rather right (1) or wrong (-1); 0 where either may be.
SIGNS = {
    "image": 1, "sweep": 1, "few": -1, "brief": -1, "blind": -1, "range": -1,
    "scatter": -1, "sigma": -1, "unlikely_size": -1, "odd_size": -1, "odd_height": -1, "hidden": -1, "heading": 1,
    "other_category": -1, "doubts": -1, "moving": 0, "two_wheeler": 0, "pedestrian": 0, "other": 0,
}  # fmt: skip


def evidence_of(candidate: AgentCandidate, timeline: Timeline) -> Evidence:
    """Collect the evidence for and against a candidate."""
    track, agent, m = candidate.track, candidate.agent, candidate.track.measurements
    in_sweep = np.isfinite(m.box_yaw_rad)
    group, yaw = GROUP_OF[agent.category], yaw_at_measurements(candidate, timeline)
    size = np.log(np.array(agent.size_m[:2]) / TYPICAL_SIZE_M[agent.category][:2]) / SIZE_SPREAD
    heading = float(agent.quality.get("heading_confidence", 0.5))
    range_m = np.median(np.hypot(*(m.center_m - m.sensor_m)[:, :2].T))
    w = agent.waypoints
    return Evidence(
        image=0.0 if in_sweep.any() else float(logit(np.array(image_confidence(track)))),
        sweep=float(logit(np.array(sweep_confidence(track)))) if in_sweep.any() else 0.0,
        few=1.0 / len(m),
        brief=1.0 / (1.0 + float(w.t_s[-1] - w.t_s[0])),
        blind=float((m.source != "lidar").mean()),
        range=float(np.log(np.clip(range_m, MIN_RANGE_M, MAX_RANGE_M) / 20.0)),
        scatter=_scatter(candidate, timeline),
        sigma=float(np.log(np.clip(np.median(w.sigma_xy_m), MIN_SIGMA_M, MAX_SIGMA_M) / 0.1)),
        unlikely_size=float(not candidate.geometry.is_likely),
        odd_size=float(min(np.hypot(*size), MAX_SIZE_SIGMAS)),
        odd_height=_odd_height(candidate),
        hidden=1.0 - float(seen_share(candidate, yaw)[0]),
        heading=float(logit(np.clip(heading, 1 - MAX_HEADING_CONFIDENCE, MAX_HEADING_CONFIDENCE))),
        other_category=float((m.category != agent.category).mean()),
        doubts=float(min(len({d.kind for d in agent.doubts}), MAX_DOUBTS)),
        moving=float(not agent.static),
        two_wheeler=float(group == "two_wheeler"),
        pedestrian=float(group == "pedestrian"),
        other=float(group == "other"),
    )


def yaw_at_measurements(candidate: AgentCandidate, timeline: Timeline) -> Array:
    """Return the heading (n,) of the trajectory at the measurements, rad."""
    w = candidate.agent.waypoints
    return np.interp(timeline.seconds(candidate.track.measurements.t_ns), w.t_s, np.unwrap(w.yaw_rad))


def _scatter(candidate: AgentCandidate, timeline: Timeline) -> float:
    """Return log(1 + median of the squared distances of measurements from the trajectory in standard deviations)."""
    m, at = candidate.track.measurements, timeline.seconds(candidate.track.measurements.t_ns)
    w, geometry = candidate.agent.waypoints, candidate.geometry
    # The place of a standing agent is fitted to its measurements, so their residuals are no test of it; and the measured
    # centers of a long moving vehicle lag behind its points.
    centers = (m.center_m[:, :2], m.covariance) if candidate.agent.static else (geometry.xy_m, geometry.covariance)
    off = centers[0] - np.stack([np.interp(at, w.t_s, w.x_m), np.interp(at, w.t_s, w.y_m)], axis=1)
    squared = np.einsum("na,nab,nb->n", off, np.linalg.pinv(centers[1]), off)
    return float(np.log1p(min(np.median(squared), MAX_SCATTER)))


def _odd_height(candidate: AgentCandidate) -> float:
    """Return the root mean square logarithm of the heights of image boxes over the typical one, of whole boxes if there are any."""
    m = candidate.track.measurements
    placed = (m.source == "topdown") & np.isfinite(m.height_px_m)
    rows = placed & ~m.truncated if (placed & ~m.truncated).any() else placed
    if not rows.any():
        return 0.0
    share = m.height_px_m[rows] / TYPICAL_SIZE_M[candidate.agent.category][2]
    return float(np.sqrt(np.mean(np.log(np.clip(share, np.exp(-MAX_ODD_HEIGHT), np.exp(MAX_ODD_HEIGHT))) ** 2)))


def seen_share(candidate: AgentCandidate, yaw_rad: Array) -> Array:
    """Return the shares (2,) of length and width that points spanned at one time; 0 without points.

    `yaw_rad` (n,) is the heading at the measurements.
    """
    m = candidate.track.measurements
    extent = m.high_m - m.low_m
    rows = np.isfinite(extent).all(axis=1) & np.isfinite(m.yaw_rad)
    if not rows.any():
        return np.zeros(2)
    across = np.abs(np.cos(m.yaw_rad - yaw_rad)) < np.sqrt(0.5)
    extent = np.where(across[:, None], extent[:, ::-1], extent)[rows]
    seen = np.quantile(extent, SEEN_QUANTILE, axis=0) / np.array(candidate.agent.size_m[:2])
    return np.asarray(np.clip(seen, 0.0, 1.0))


Terms = Mapping[str, Array]


def with_systematic_errors(
    candidate: AgentCandidate, evidence: Evidence, confidence: float, timeline: Timeline
) -> Waypoints:
    """Return the waypoints of a candidate with larger standard deviations.

    Notes
    -----
    A variance is a sum of terms, each a reason for an error, times weights that fit synthetic logs
    (`tools/fit.py confidence`). Smoothing and fits take the errors of ticks as independent; but a box that is laid against the
    wrong end, or has a wrong length, is off by as much at every tick.
    """
    w, size_m = candidate.agent.waypoints, candidate.agent.size_m
    share = seen_share(candidate, yaw_at_measurements(candidate, timeline))
    position = sigma_of(position_terms(w, size_m, share, evidence, confidence), POSITION_VARIANCE)
    yaw = None if w.sigma_yaw_rad is None else sigma_of(yaw_terms(w, confidence), YAW_VARIANCE)
    speed = None if w.sigma_speed_mps is None else sigma_of(speed_terms(w, evidence, confidence), SPEED_VARIANCE)
    return replace(w, sigma_xy_m=position, sigma_yaw_rad=yaw, sigma_speed_mps=speed)


def sigma_of(terms: Terms, weights: Mapping[str, float]) -> Array:
    """Return the standard deviations (T,) whose squares are the weighted sums of terms (T,)."""
    return np.asarray(np.sqrt(np.sum([weights[name] * values for name, values in terms.items()], axis=0)))


def position_terms(
    w: Waypoints, size_m: tuple[float, float, float], seen: Array, evidence: Evidence, confidence: float
) -> dict[str, Array]:
    """Return the reasons for errors of position at the waypoints (T,), m2 but for their weights.

    - given: what smoothing or the fit says;
    - given_moving: errors of neighboring ticks are alike, and smoothing averages them;
    - hidden: a box is laid against one end, and the part of its length that was never seen is on either side of the points;
    - range: the spacing of rays and errors of the pose grow with the distance;
    - wrong: an agent that is probably wrong is farther off, mostly by up to half its length.
    """
    ones = np.ones(len(w))
    length = size_m[0]
    range_m = 20.0 * np.exp(evidence.range)
    return {
        "given": w.sigma_xy_m**2,
        "given_moving": evidence.moving * w.sigma_xy_m**2,
        "hidden": ((1 - seen[0]) * length) ** 2 * ones,
        "range": (range_m / 10.0) ** 2 * ones,
        "wrong": _wrong_weight(confidence) * length**2 * ones,
    }


def yaw_terms(w: Waypoints, confidence: float) -> dict[str, Array]:
    """Return the reasons for errors of yaw at the waypoints (T,), rad2 but for their weights.

    - given: what smoothing or the fit says;
    - wrong: the axis of an agent that is probably wrong may be off by any angle.
    """
    given = np.zeros(len(w)) if w.sigma_yaw_rad is None else w.sigma_yaw_rad
    ones = np.ones(len(w))
    return {
        "given": given**2,
        "wrong": _wrong_weight(confidence) * ones,
    }


def speed_terms(w: Waypoints, evidence: Evidence, confidence: float) -> dict[str, Array]:
    """Return the reasons for errors of speed at the waypoints (T,), m2/s2 but for their weights.

    - given: what smoothing says;
    - standing: a standing agent that is probably wrong may move;
    - moving: a moving agent that is probably wrong may stand, or move at another speed.
    """
    given = np.zeros(len(w)) if w.sigma_speed_mps is None else w.sigma_speed_mps
    ones = np.ones(len(w))
    return {
        "given": given**2,
        "standing": (1 - evidence.moving) * _wrong_weight(confidence) * ones,
        "moving": evidence.moving * _wrong_weight(confidence) * (1.0 + np.abs(w.speed_mps)) ** 2,
    }


def _wrong_weight(confidence: float) -> float:
    """Return the weight of the errors of a wrong agent: the more probably an agent is wrong, the larger its errors are, too."""
    return (1 - confidence) ** 2


# Never 0 or 1: an agent may be right or wrong for a reason that no evidence shows.
MIN_CONFIDENCE, MAX_CONFIDENCE = 0.01, 0.99


def rate_agents(candidates: Sequence[AgentCandidate], timeline: Timeline, *, lidar: bool) -> list[AgentCandidate]:
    """Give judged candidates the probability that they are right as confidence, and systematic errors in their sigmas.

    `lidar` states whether a LiDAR was there to observe them.
    """
    return [_rated(candidate, timeline, lidar=lidar) for candidate in candidates]


def confidence_of(evidence: Evidence, *, lidar: bool) -> float:
    """Return the probability that an agent with this evidence is right.

    Notes
    -----
    Where there is a LiDAR, an agent without points is rather wrong; without one, nothing has points, and what the images
    say of the distance counts instead. Each case has weights of its own.

    Right is what `evaluate` finds right: at no more than a fifth of its ticks invented, a duplicate, in the ego, or with a
    wrong speed, motion, direction or size. Logistic regression; each weight has the sign of its reason
    (`evidence.SIGNS`).
    """
    values = {"bias": 1.0, **asdict(evidence)}
    log_odds = sum(weight * values[name] for name, weight in (WITH_LIDAR if lidar else WITHOUT_LIDAR).items())
    return float(np.clip(probability_of(log_odds), MIN_CONFIDENCE, MAX_CONFIDENCE))


def _rated(candidate: AgentCandidate, timeline: Timeline, *, lidar: bool) -> AgentCandidate:
    evidence = evidence_of(candidate, timeline)
    confidence = confidence_of(evidence, lidar=lidar)
    waypoints = with_systematic_errors(candidate, evidence, confidence, timeline)
    return replace(candidate, agent=replace(candidate.agent, confidence=confidence, waypoints=waypoints))
