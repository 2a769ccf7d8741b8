"""What part of the map a picture shows, and round steps of scale and time marks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from log2sim.geometry import Array
from log2sim.visualization.plot.roles import AgentRoles, centers_xy

MIN_SIDE_M = 20.0
MARGIN_M = 4.0
REACH_M = 60.0
"""Movers closer than this to the ego's trajectory are always in view."""

MAX_UNCROWDED_MOVERS = 12
"""With more movers there are fewer time marks, and the view keeps to where most of them are."""

STATIONARY_REACH_M = 25.0
"""Stationary agents closer than this to the ego's trajectory are in view."""


@dataclass(frozen=True)
class Viewport:
    """A rectangle of the map.

    Attributes
    ----------
    x0, x1, y0, y1 : float, m
        Map frame.
    m_per_pt : float
        Meters for each point (1/72 inch) of the figure.
    """

    x0: float
    x1: float
    y0: float
    y1: float
    m_per_pt: float = 0.1

    @property
    def width_m(self) -> float:
        """Return the extent along x."""
        return self.x1 - self.x0

    @property
    def height_m(self) -> float:
        """Return the extent along y."""
        return self.y1 - self.y0

    def fitted(self, width_pt: float, height_pt: float) -> Viewport:
        """Widen the view about its center so that it fills axes of this size at equal aspect."""
        m_per_pt = max(self.width_m / width_pt, self.height_m / height_pt)
        cx, cy, w, h = (
            (self.x0 + self.x1) / 2,
            (self.y0 + self.y1) / 2,
            width_pt * m_per_pt / 2,
            height_pt * m_per_pt / 2,
        )
        return Viewport(cx - w, cx + w, cy - h, cy + h, m_per_pt)

    def contains(self, xy_m: Array, margin_m: float = 0.0) -> np.ndarray:
        """Mark (N,) the points (N, 2) inside."""
        x, y = xy_m[:, 0], xy_m[:, 1]
        inside_x = (x >= self.x0 - margin_m) & (x <= self.x1 + margin_m)
        return inside_x & (y >= self.y0 - margin_m) & (y <= self.y1 + margin_m)


def choose_viewport(roles: AgentRoles) -> Viewport:
    """Choose the smallest view of the ego's trajectory, all movers but far outliers, and stationary agents near them.

    Notes
    -----
    Points of movers are outliers when they are farther from the core than `REACH_M` and than three times the upper quartile
    of all movers' distances, or twice the median of many movers. The core is the ego's trajectory or, without an ego, the
    median of all movers.
    """
    movers = [centers_xy(role.agent) for role in roles.movers]
    stationary = np.concatenate([centers_xy(a)[:1] for a in roles.stationary]) if roles.stationary else np.zeros((0, 2))
    if not movers:
        points = stationary if len(stationary) else np.zeros((1, 2))
        core = np.median(points, axis=0)[None]
        return _around(_near(points, core, _limit(points, core)))
    few = [p[np.linspace(0, len(p) - 1, min(len(p), 24)).round().astype(int)] for p in movers]
    ego = roles.movers[0].is_ego
    core = few[0] if ego else np.median(np.concatenate(few), axis=0)[None]
    everything = np.concatenate(movers)
    kept = _near(everything, core, _limit(np.concatenate(few), core, crowd=len(movers) > MAX_UNCROWDED_MOVERS))
    if ego:
        kept = np.concatenate([kept, _near(stationary, core, STATIONARY_REACH_M)])
    return _around(kept)


def nice_step(target: float, steps: tuple[float, ...] = (1.0, 2.0, 5.0)) -> float:
    """Find the largest of 1, 2, 5 times a power of ten that is not above `target` > 0."""
    power = 10.0 ** np.floor(np.log10(target))
    return float(max((s * power for s in steps if s * power <= target * (1 + 1e-9)), default=power))


def time_step_s(duration_s: float, movers: int, speed_mps: float, m_per_pt: float) -> float:
    """Choose the seconds between time marks: about eight a track, six with many movers, at least 9 pt apart."""
    apart = 9 * m_per_pt / max(speed_mps, 0.5)
    min_step_s = max(duration_s / (8 if movers <= MAX_UNCROWDED_MOVERS else 6), apart)
    return next((s for s in (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0) if s >= min_step_s), 600.0)


def _limit(points: Array, core: Array, *, crowd: bool = False) -> float:
    distance = _distance(points, core)
    return max(REACH_M, 2 * float(np.median(distance)) if crowd else 3 * float(np.percentile(distance, 75)))


def _near(points: Array, core: Array, limit_m: float) -> Array:
    return points[_distance(points, core) <= limit_m]


def _distance(points: Array, core: Array) -> Array:
    """Compute the distance (N,) to the nearest point of the core."""
    nearest = np.full(len(points), np.inf)
    for c in core:
        np.minimum(nearest, np.hypot(points[:, 0] - c[0], points[:, 1] - c[1]), out=nearest)
    return nearest


def _around(points: Array) -> Viewport:
    low, high = points.min(axis=0), points.max(axis=0)
    half = np.maximum((high - low) * 0.54 + MARGIN_M, MIN_SIDE_M / 2)
    cx, cy = (low + high) / 2
    return Viewport(cx - half[0], cx + half[0], cy - half[1], cy + half[1])
