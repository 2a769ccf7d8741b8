"""Where on the ground found and true map features are compared."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from log2sim.datatypes import Scenario
from log2sim.errors import ScenarioError
from log2sim.geometry import Array

WITHIN_M, CLOSE_M = 40.0, 20.0  # of the ego's path
STEP_M = 0.1  # between points at which lines are compared
MAX_SAMPLES = 2_000_000
MAX_CELLS = 10_000_000
PATH_TOLERANCE_M = 0.05  # to which the ego's path is simplified before its surroundings are taken


@dataclass(frozen=True, eq=False)
class Area:
    """Where map features count.

    Attributes
    ----------
    near : polygon or None
        Surroundings of the ego's path; None without an ego, where all counts.
    close : polygon or None
        Its nearer part.
    seen : polygon or None
        Ground that a sensor saw; None where the truth does not tell.
    path_m : float
        Length of the ego's path, m; 0 without an ego.
    """

    near: BaseGeometry | None
    close: BaseGeometry | None
    seen: BaseGeometry | None
    path_m: float

    @classmethod
    def of(cls, scenario: Scenario, truth: Scenario, shift_m: Array) -> Area:
        """Take it from a truth that was moved into the scenario's map by `shift_m` (3,).

        Raises
        ------
        ScenarioError
            When the truth names cells in a way that cannot be read.
        """
        ego = truth.ego or scenario.ego
        seen = seen_ground(truth, shift_m)
        if ego is None:
            return cls(None, None, seen, 0.0)
        w = ego.waypoints
        path = shapely.LineString(np.column_stack([w.x_m, w.y_m])) if len(w) > 1 else shapely.Point(w.x_m[0], w.y_m[0])
        near, close = (path.simplify(PATH_TOLERANCE_M).buffer(reach) for reach in (WITHIN_M, CLOSE_M))
        shapely.prepare([near, close])
        return cls(near, close, seen, float(path.length))

    def counts(self, xy_m: Array) -> NDArray[np.bool_]:
        """Whether what is found at points (N, 2) counts: near the path."""
        return _within(self.near, xy_m)

    def expects(self, xy_m: Array) -> NDArray[np.bool_]:
        """Whether what is true at points (N, 2) should be found: near the path, where a sensor saw the ground."""
        return _within(self.near, xy_m) & _within(self.seen, xy_m)

    def is_close(self, xy_m: Array) -> NDArray[np.bool_]:
        """Whether points (N, 2) lie in the nearer part."""
        return _within(self.close, xy_m)


def _within(area: BaseGeometry | None, xy_m: Array) -> NDArray[np.bool_]:
    if area is None:
        return np.ones(len(xy_m), dtype=bool)
    return np.asarray(shapely.contains_xy(area, xy_m[:, 0], xy_m[:, 1]), dtype=bool)


def seen_ground(truth: Scenario, shift_m: Array) -> BaseGeometry | None:
    """Return the ground that sensors saw, as the provenance of a synthetic truth lists it, moved by `shift_m`; None without."""
    stated = truth.provenance.get("seen_ground")
    if stated is None:
        return None
    try:
        cell_m, runs = float(stated["cell_m"]), np.array(stated["runs"], dtype=np.float64).reshape(-1, 3)
    except (TypeError, ValueError, KeyError) as error:
        raise ScenarioError(f"provenance.seen_ground: {error!r}, expected cell_m and runs of three numbers") from None
    if not (np.isfinite(runs).all() and 0 < cell_m < 100 and len(runs) <= MAX_CELLS and (runs[:, 2] > 0).all()):
        raise ScenarioError("provenance.seen_ground: expected positive numbers of cells of at most 100 m")
    low = runs[:, :2] * cell_m + shift_m[:2]
    boxes = shapely.box(low[:, 0], low[:, 1], low[:, 0] + runs[:, 2] * cell_m, low[:, 1] + cell_m)
    seen = shapely.union_all(boxes)
    shapely.prepare(seen)
    return seen


def sampled(points_m: Array) -> tuple[Array, Array, float]:
    """Sample a line (N, 2 or 3) at steps of at most `STEP_M`.

    Returns
    -------
    xy : (S, 2) float64, m
    heading : (S,) float64, rad
    length_m : float, m
        That each sample stands for.

    Raises
    ------
    ScenarioError
        When it is too long to be a line on a road.
    """
    xy = np.asarray(points_m, dtype=np.float64)[:, :2]
    steps = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    s = np.concatenate([[0.0], np.cumsum(steps)])
    if s[-1] == 0:
        return np.zeros((0, 2)), np.zeros(0), 0.0
    if s[-1] > MAX_SAMPLES * STEP_M:
        raise ScenarioError(f"a line of {s[-1]:g} m is too long to be compared")
    count = int(np.ceil(s[-1] / STEP_M))
    at = (np.arange(count) + 0.5) * s[-1] / count
    piece = np.clip(np.searchsorted(s, at, side="right") - 1, 0, len(steps) - 1)
    along = np.diff(xy, axis=0)[piece]
    middle = xy[piece] + along * ((at - s[piece]) / np.where(steps[piece] > 0, steps[piece], 1.0))[:, None]
    return middle, np.arctan2(along[:, 1], along[:, 0]), float(s[-1] / count)
