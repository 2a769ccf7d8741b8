"""What part of the map a picture shows, and steps that people can count: scale, time marks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from log2sim.geometry import Array
from log2sim.visualization.plot.roles import Cast, path

LEAST_SIDE_M = 20.0
MARGIN_M = 4.0
REACH_M = 60.0
"""Movers closer than this to the ego's path are in view whatever the rest does."""

CROWD = 12
"""More movers than this are a crowd: fewer marks, and the view keeps to where most are."""

STANDING_REACH_M = 25.0
"""Around an ego, standing agents closer than this are in view."""


@dataclass(frozen=True)
class View:
    """The window of the map, m, map frame, and how many meters a point (1/72 inch) of paper holds."""

    x0: float
    x1: float
    y0: float
    y1: float
    m_per_pt: float = 0.1

    @property
    def width_m(self) -> float:
        return self.x1 - self.x0

    @property
    def height_m(self) -> float:
        return self.y1 - self.y0

    def fitted(self, width_pt: float, height_pt: float) -> View:
        """The view widened about its center so that it fills a sheet of that size at equal aspect."""
        m_per_pt = max(self.width_m / width_pt, self.height_m / height_pt)
        cx, cy, w, h = (
            (self.x0 + self.x1) / 2,
            (self.y0 + self.y1) / 2,
            width_pt * m_per_pt / 2,
            height_pt * m_per_pt / 2,
        )
        return View(cx - w, cx + w, cy - h, cy + h, m_per_pt)

    def holds(self, xy_m: Array, margin_m: float = 0.0) -> np.ndarray:
        """Mask (N,) of points (N, 2) inside."""
        x, y = xy_m[:, 0], xy_m[:, 1]
        inside_x = (x >= self.x0 - margin_m) & (x <= self.x1 + margin_m)
        return inside_x & (y >= self.y0 - margin_m) & (y <= self.y1 + margin_m)


def choose_view(cast: Cast) -> View:
    """The smallest window that holds the ego's path, all movers but far outliers, and some of what stands about them.

    Notes
    -----
    Of movers, points farther from the core than `REACH_M` and than three times the upper quartile of all movers'
    distances (in a crowd: twice the median) are left outside. The core is the ego's path or, without an ego, the median
    of all movers.
    """
    movers = [path(role.agent) for role in cast.movers]
    standing = np.concatenate([path(a)[:1] for a in cast.standing]) if cast.standing else np.zeros((0, 2))
    if not movers:
        points = standing if len(standing) else np.zeros((1, 2))
        core = np.median(points, axis=0)[None]
        return _around(_near(points, core, _limit(points, core)))
    few = [p[np.linspace(0, len(p) - 1, min(len(p), 24)).round().astype(int)] for p in movers]
    ego = cast.movers[0].is_ego
    core = few[0] if ego else np.median(np.concatenate(few), axis=0)[None]
    everything = np.concatenate(movers)
    kept = _near(everything, core, _limit(np.concatenate(few), core, crowd=len(movers) > CROWD))
    if ego:
        kept = np.concatenate([kept, _near(standing, core, STANDING_REACH_M)])
    return _around(kept)


def nice_step(target: float, steps: tuple[float, ...] = (1.0, 2.0, 5.0)) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above `target` > 0."""
    power = 10.0 ** np.floor(np.log10(target))
    return float(max((s * power for s in steps if s * power <= target * (1 + 1e-9)), default=power))


def time_step_s(duration_s: float, movers: int, speed_mps: float, m_per_pt: float) -> float:
    """Seconds between time marks: about eight a track, fewer in a crowd, at least 9 pt apart at a typical speed."""
    apart = 9 * m_per_pt / max(speed_mps, 0.5)
    least = max(duration_s / (8 if movers <= CROWD else 6), apart)
    return next((s for s in (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0) if s >= least), 600.0)


def _limit(points: Array, core: Array, *, crowd: bool = False) -> float:
    distance = _distance(points, core)
    return max(REACH_M, 2 * float(np.median(distance)) if crowd else 3 * float(np.percentile(distance, 75)))


def _near(points: Array, core: Array, limit_m: float) -> Array:
    return points[_distance(points, core) <= limit_m]


def _distance(points: Array, core: Array) -> Array:
    """Distance (N,) to the nearest point of the core."""
    nearest = np.full(len(points), np.inf)
    for c in core:
        np.minimum(nearest, np.hypot(points[:, 0] - c[0], points[:, 1] - c[1]), out=nearest)
    return nearest


def _around(points: Array) -> View:
    low, high = points.min(axis=0), points.max(axis=0)
    half = np.maximum((high - low) * 0.54 + MARGIN_M, LEAST_SIDE_M / 2)
    cx, cy = (low + high) / 2
    return View(cx - half[0], cx + half[0], cy - half[1], cy + half[1])
