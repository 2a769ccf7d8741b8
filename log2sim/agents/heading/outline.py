"""What the outline of a vehicle from the side says about its front: hood, windshield, cabin, trunk or bed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.heading.outline_weights import LOW, LOW_IN_PART, TALL, TALL_IN_PART
from log2sim.datatypes import Track, Waypoints
from log2sim.geometry import Array
from log2sim.perception.box_fitting import rotate, subsample, top_of

# Cells of the outline along the length and up.
LENGTH_CELLS, HEIGHT_CELLS = 12, 8
# Points from here on along the length, without a wider gap, belong to a vehicle whose box is too short, up to this share of it.
MAX_GAP_M, MAX_LONGER_SHARE = 0.25, 0.2
# Points over this share of the length show both ends, wherever the box is.
WHOLE_LENGTH_SHARE = 0.8
# Lower points may be ground, points farther beside the box are neighbors.
MIN_HEIGHT_M, BESIDE_M = 0.2, 0.2
# Fewer points show no outline.
MIN_POINTS = 12
# More measurements and points than the weights were fitted for would fill the outline with stray points.
MAX_MEASUREMENTS, MAX_POINTS_EACH = 8, 300
# Between the highest cars and the lowest trucks, buses and delivery vans.
TALL_M = 2.1
# Of outlines that are surer than this, one in fifty is wrong on random traffic whose boxes are those of tracks.
MAX_LOG_ODDS = 4.0
# Where less of the length shows, something hides the rest.
MIN_WHOLE_SHARE = 0.8
WEIGHTS = {(False, True): LOW, (False, False): LOW_IN_PART, (True, True): TALL, (True, False): TALL_IN_PART}


@dataclass(frozen=True, eq=False)
class Outline:
    """Which cells have points.

    Attributes
    ----------
    cells : (`LENGTH_CELLS`, `HEIGHT_CELLS`) bool
        From back to front and from the ground up.
    height_m : float
        Of the highest points.
    view : float
        Cosine of the angle from the yaw to the mean viewpoint.
    """

    cells: NDArray[np.bool_]
    height_m: float
    view: float

    @property
    def kind(self) -> tuple[bool, bool]:
        """Whether the vehicle is tall, and whether most of its length shows."""
        return self.height_m > TALL_M, bool(self.cells.any(axis=1).mean() >= MIN_WHOLE_SHARE)

    @property
    def features(self) -> Array:
        """What the weights apply to (`LENGTH_CELLS` / 2 x `HEIGHT_CELLS` + 1,), opposite for a vehicle turned round."""
        swapped = self.cells.astype(np.float64) - self.cells[::-1]
        return np.append(swapped[: LENGTH_CELLS // 2].ravel(), self.view)


def outline_log_odds(track: Track, waypoints: Waypoints, t_s: Array, size_m: tuple[float, float, float]) -> float:
    """Return the log-odds that a vehicle's front is where its yaw points, by its LiDAR points; 0 for too few.

    Parameters
    ----------
    track : Track
    waypoints : Waypoints
    t_s : (n,) float64, s
        Times of the n measurements of the track since the start.
    size_m : (3,) tuple of float, m

    Notes
    -----
    A logistic regression on which cells of the outline have points, less the same with front and back swapped, so the
    log-odds of a vehicle that is turned round are exactly the opposite. `tools/fit_outline.py` fits the weights to random
    vehicles seen by simulated LiDARs.
    """
    m = track.measurements
    rows = np.flatnonzero([len(cluster) > 0 for cluster in m.cluster])
    if len(rows) == 0:
        return 0.0
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), MAX_MEASUREMENTS)).round().astype(np.intp)]
    x, y = (np.interp(t_s[rows], waypoints.t_s, column) for column in (waypoints.x_m, waypoints.y_m))
    yaw = np.interp(t_s[rows], waypoints.t_s, np.unwrap(waypoints.yaw_rad))
    ground_m = np.where(np.isfinite(m.bottom_m[rows]), m.bottom_m[rows], np.median(m.bottom_m[rows]))
    points, views = [], []
    for k, row in enumerate(rows.tolist()):
        xyz = subsample(m.cluster[row][:, :3], MAX_POINTS_EACH) - [x[k], y[k], ground_m[k]]
        points.append(np.column_stack([rotate(xyz[:, :2], -yaw[k]), xyz[:, 2]]))
        views.append(rotate(m.sensor_m[row, :2] - [x[k], y[k]], -yaw[k]))
    outline = outline_of(np.concatenate(points), np.array(size_m), np.mean(views, axis=0))
    if outline is None:
        return 0.0
    odds = float(outline.features @ WEIGHTS[outline.kind]) / 100
    return min(max(odds, -MAX_LOG_ODDS), MAX_LOG_ODDS)


def outline_of(xyz: Array, size_m: Array, view_m: Array) -> Outline | None:
    """Make the outline of the points of a vehicle; None for fewer than `MIN_POINTS` in its box.

    Parameters
    ----------
    xyz : (N, 3) float64, m
        x along the length and y to the left from the center of the box, z from the ground.
    size_m : (3,) float64
        Length, width, height.
    view_m : (2,) float64, m
        Mean viewpoint, as the points.
    """
    length, width, height = size_m
    beside = (np.abs(xyz[:, 1]) < width / 2 + BESIDE_M) & (xyz[:, 2] > MIN_HEIGHT_M) & (xyz[:, 2] < height)
    x, up = xyz[beside, 0], xyz[beside, 2]
    back, front = -_end_of(-x, length), _end_of(x, length)
    inside = (x >= back) & (x <= front)
    if inside.sum() < MIN_POINTS:
        return None
    x, up = x[inside], up[inside]
    if np.ptp(x) >= WHOLE_LENGTH_SHARE * length:
        back, front = float(x.min()), float(x.max())
    top = top_of(up)
    cells = np.zeros((LENGTH_CELLS, HEIGHT_CELLS), dtype=bool)
    column = ((x - back) / (front - back) * LENGTH_CELLS).astype(np.intp)
    row = (up / top * HEIGHT_CELLS).astype(np.intp)
    cells[np.minimum(column, LENGTH_CELLS - 1), np.minimum(row, HEIGHT_CELLS - 1)] = True
    return Outline(cells, top, float(view_m[0] / max(float(np.hypot(*view_m)), 1.0)))


def _end_of(x: Array, length_m: float) -> float:
    """Return where a vehicle ends along an axis: at the end of its box, or of the points (n,) that go on from there."""
    end = length_m / 2
    beyond = np.sort(x[(x > end) & (x < end + MAX_LONGER_SHARE * length_m)])
    gaps = np.flatnonzero(np.diff(np.append(end, beyond)) > MAX_GAP_M)
    beyond = beyond[: gaps[0]] if len(gaps) else beyond
    return float(beyond[-1]) if len(beyond) else end
