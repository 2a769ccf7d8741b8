"""Evidence for and against an agent: numbers that a judged candidate has, each with a reason for its sign."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from log2sim.agents.candidate import AgentCandidate, Timeline
from log2sim.agents.confirmation import image_confidence, sweep_confidence
from log2sim.datatypes import GROUP_OF, TYPICAL_SIZE_M
from log2sim.geometry import Array
from log2sim.perception.late_fusion import logit

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
        doubts=float(min(len({d.flag for d in agent.doubts}), MAX_DOUBTS)),
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
