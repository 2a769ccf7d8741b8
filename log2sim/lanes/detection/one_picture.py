"""Markings in one picture: the ground is laid out flat, by a known camera or one that is estimated from the picture."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from log2sim.datatypes import Marking, RoadBorder
from log2sim.geometry import Array, Camera, apply, inverse, project
from log2sim.lanes.detection.markings import list_markings
from log2sim.lanes.detection.road_shape import LaneLine, find_shape, join_lines
from log2sim.lanes.detection.road_surface import keep_road
from log2sim.lanes.detection.vanishing import find_vanishing_point
from log2sim.mapping.ground_map import GroundMap
from log2sim.mapping.ground_view import GroundView, Image
from log2sim.mapping.mosaic import render_birdseye

CELL_M = 0.05
HALF_WIDTH_M, REACH_M = 18.0, 90.0
COARSEST_M = 3.0  # a dash is 3 m long; what is coarser along the road shows no line's begin, but where it runs
# Behind the windshield of cars cameras are 1.2 m to 1.6 m above the road; widths scale with it.
CAMERA_HEIGHT_M = 1.5
HORIZONTAL_FIELD_RAD = np.deg2rad(60)  # dashboard cameras: 50 to 70 deg; lengths along the road scale with its tangent
ROUNDS = 2
MIN_LINE_M, MIN_APART_M = 8.0, 2.0
# Rows that a line spans, as a share of the picture's height: less is too little to tell its course; more counts no more.
SHORT_LINE, LONG_LINE = 0.015, 0.1
NEAR_M, FAR_M = 2.0, 150.0  # to where lane lines are continued
# Of lines that do not count alone, but where others run beside them; dashes are 1 m and more.
MIN_CONFIDENCE, MIN_DASH_M = 0.15, 1.0
UPRIGHT_SLOPE, UPRIGHT_OFFSET_M = 0.06, 0.7
MAX_PITCH_STEP_RAD = np.deg2rad(3)


@dataclass(frozen=True, eq=False)
class PictureMarkings:
    """What one picture shows of the road.

    Attributes
    ----------
    markings : tuple of Marking
        In the frame of the ground below the camera: x forward, y left, z up.
    borders : tuple of RoadBorder
    lane_lines : tuple of LaneLine
        The lines of which lane markings are parts, from left to right.
    camera : Camera
        Its `mount_T_cam` is its pose in that frame.
    ground : GroundMap
        The ground as the picture shows it.
    notes : tuple of str
        What was not seen or is assumed.
    """

    markings: tuple[Marking, ...]
    borders: tuple[RoadBorder, ...]
    lane_lines: tuple[LaneLine, ...]
    camera: Camera
    ground: GroundMap
    notes: tuple[str, ...]

    def project(self, points_m: Array) -> Array:
        """Return pixels (N, 2) of points (N, 3) of the ground, NaN where they are not in front of the camera."""
        return project(self.camera, apply(inverse(self.camera.mount_T_cam), points_m))[0]


def find_markings_in_picture(
    image_bgr: Image, camera: Camera | None = None, *, height_m: float = CAMERA_HEIGHT_M
) -> PictureMarkings:
    """Find markings in one picture that looks along a road.

    Parameters
    ----------
    image_bgr : (H, W, 3) uint8
        Without lens distortion, unless a camera states it.
    camera : Camera, optional
        `mount_T_cam` is its pose above the ground z = 0 of its mount, x forward. Without it, the direction is that in which
        lines of the road meet, the field of view is assumed, and lengths along the road are no better than that.
    height_m : float, m
        Of the camera above the road, where there is no camera.

    Returns
    -------
    PictureMarkings
        Without markings where no lines meet.

    Notes
    -----
    Where the direction is estimated, markings are found again after the horizon is corrected so that lane lines stay at one
    distance from each other.
    """
    if camera is not None:
        return _find(image_bgr, camera)
    point = find_vanishing_point(image_bgr, rng=np.random.default_rng(0))
    if point is None:
        nowhere = _camera_towards(image_bgr, (image_bgr.shape[1] / 2, image_bgr.shape[0] / 2), height_m)
        note = "no markings seen: no lines meet, so the horizon of the road is unknown"
        return PictureMarkings((), (), (), nowhere, _lay_out(image_bgr, nowhere), (note,))
    found = _find(image_bgr, _camera_towards(image_bgr, point, height_m))
    for _ in range(ROUNDS):
        corrected = _make_parallel(found, image_bgr, height_m)
        if corrected is None:
            break
        again = _find(image_bgr, corrected)
        if _seen_rows(again) < _seen_rows(found):
            break
        found = again
    field = f"{np.rad2deg(HORIZONTAL_FIELD_RAD):.0f} deg"
    assumed = f"camera: {height_m:g} m above the road and a field of view of {field} are assumed"
    return replace(found, notes=(*found.notes, assumed))


def _find(image_bgr: Image, camera: Camera) -> PictureMarkings:
    """Find markings by a camera's pose, and leave out lines that do not follow the course of the road."""
    ground = _lay_out(image_bgr, camera)
    markings = list_markings(ground, min_confidence=MIN_CONFIDENCE, min_line_m=MIN_DASH_M, symbols=False)
    notes = ("markings by a camera only: light streaks are harder to tell from paint",)
    found = PictureMarkings(markings, (), (), camera, ground, notes)
    lines = [m for m in markings if m.is_lane_line and not _is_upright(m, camera)]
    weights = np.array([_visible(found, m) * m.confidence for m in lines]) / (LONG_LINE * camera.height_px)
    large = [k for k in range(len(lines)) if weights[k] >= SHORT_LINE / LONG_LINE]
    lines, weights = [lines[k] for k in large], weights[large]
    shape = find_shape(lines, weights)
    if shape is None:
        others = tuple(m for m in markings if not m.is_lane_line)
        return replace(found, markings=others, notes=(*notes, "no lane lines seen: none run beside each other"))
    kept = [lines[k] for k in shape[1]]
    x = camera.mount_T_cam[0, 3]
    joined = join_lines(kept, shape[0], x + NEAR_M, x + FAR_M)
    others = tuple(m for m in markings if not m.is_lane_line)
    return replace(found, markings=(*kept, *others), lane_lines=tuple(joined))


def _is_upright(marking: Marking, camera: Camera) -> bool:
    """Whether a line points to below the camera but not along the road, as upright things do that are laid out flat."""
    x, y = marking.points_m[:, 0] - camera.mount_T_cam[0, 3], marking.points_m[:, 1] - camera.mount_T_cam[1, 3]
    slope, offset = np.polyfit(x, y, 1)
    return bool(abs(slope) > UPRIGHT_SLOPE and abs(offset) < UPRIGHT_OFFSET_M)


def _seen_rows(found: PictureMarkings) -> float:
    """Sum the rows of the picture that lane lines span, by confidence."""
    return sum(_visible(found, m) * m.confidence for line in found.lane_lines for m in line.markings)


def _visible(found: PictureMarkings, marking: Marking) -> float:
    """Count the rows of the picture that a marking spans."""
    uv = found.project(marking.points_m)
    rows = uv[np.isfinite(uv[:, 1]), 1]
    return float(np.ptp(rows)) if len(rows) > 1 else 0.0


def _lay_out(image_bgr: Image, camera: Camera) -> GroundMap:
    """Lay the ground in front of a camera out flat."""
    view = GroundView.from_pose(image_bgr, camera, camera.mount_T_cam)
    x, y = camera.mount_T_cam[:2, 3]
    extent = (x, x + REACH_M, y - HALF_WIDTH_M, y + HALF_WIDTH_M)
    laid = render_birdseye([view], extent_m=extent, resolution_m=CELL_M, coarsest_m=COARSEST_M, frame="ego")
    unknown = np.full(laid.alpha.shape, np.nan, np.float32)
    ground = GroundMap(laid.image_bgr, laid.alpha, unknown, unknown, laid.resolution_m, laid.extent_m)
    return keep_road(ground, float(x), float(y))


def _camera_towards(image_bgr: Image, point: tuple[float, float], height_m: float) -> Camera:
    """Make the camera whose pixel `point` looks along the road, without roll."""
    height, width = image_bgr.shape[:2]
    focal = width / 2 / np.tan(HORIZONTAL_FIELD_RAD / 2)
    K = np.array([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1.0]])
    forward = np.linalg.solve(K, np.array([*point, 1.0]))
    forward /= np.linalg.norm(forward)
    up = np.array([0.0, -1.0, (point[1] - K[1, 2]) / focal])  # the horizon is a row
    up /= np.linalg.norm(up)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([forward, np.cross(up, forward), up])
    pose[2, 3] = height_m
    return Camera("picture", width, height, K, "ego", pose)


def _make_parallel(found: PictureMarkings, image_bgr: Image, height_m: float) -> Camera | None:
    """Correct the horizon so that lane lines keep their distances; None where there are no two, or nothing changes.

    Notes
    -----
    A row that is wrong by d pixels adds d / (f h) to 1 / x, with focal length f and height h, and leaves y / x as it is:
    the line y = a + b x becomes y = a + (b + a d / (f h)) x. So b grows by a line with a.
    """
    camera = found.camera
    rows = [row for m in found.markings if m.is_lane_line and (row := _offset_and_slope(m.points_m)) is not None]
    if len(rows) < 2:
        return None
    a, b, w = np.array(rows).T
    if np.ptp(a) < MIN_APART_M:
        return None
    rate, level = _robust_line(a, b, w)
    focal = camera.K[0, 0]
    forward = camera.K @ np.linalg.inv(camera.mount_T_cam[:3, :3]) @ np.array([1.0, level, 0.0])
    limit = MAX_PITCH_STEP_RAD * focal
    point = (
        float(forward[0] / forward[2]),
        float(forward[1] / forward[2] - np.clip(rate * focal * height_m, -limit, limit)),
    )
    return _camera_towards(image_bgr, point, height_m)


def _robust_line(x: Array, y: Array, weight: Array) -> tuple[float, float]:
    """Slope and intercept of the line through most of some points: weighted medians of pairs (Theil and Sen)."""
    i, j = np.triu_indices(len(x), 1)
    apart = np.abs(x[i] - x[j]) >= MIN_APART_M
    i, j = i[apart], j[apart]
    slope = _weighted_median((y[i] - y[j]) / (x[i] - x[j]), weight[i] * weight[j] * np.abs(x[i] - x[j]))
    return slope, _weighted_median(y - slope * x, weight)


def _weighted_median(values: Array, weight: Array) -> float:
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])


def _offset_and_slope(points: Array) -> tuple[float, float, float] | None:
    """Offset and slope of a line where it passes the camera, and its weight; None for one that is short or across."""
    x, y = points[:, 0], points[:, 1]
    span = float(np.ptp(x))
    if span < MIN_LINE_M or span < 3 * np.ptp(y):
        return None
    # A bend at least as long as the line reaches beyond it would be uncertain.
    degree = 2 if span > 25 and x.min() < 15 else 1
    fit = np.polyfit(x, y, degree)
    return float(fit[-1]), float(fit[-2]), span
