"""Seams between neighboring cameras of a rig, and mounts that make them vanish."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.geometry import NS_PER_S, Array, Camera, apply, distort, inverse
from log2sim.perception.first_pass import Observations
from log2sim.perception.homography.rig import Rig, RigRows, cam_of_ground, heights_of, rotation_of
from log2sim.perception.homography.rig_fit import MOUNT_SIGMA_RAD, RigFit
from log2sim.perception.homography_stage import CameraHomography
from log2sim.perception.observe_tick import base_pose
from log2sim.perception.records import RecordSource
from log2sim.perception.sync import Schedule

# Structure coarser than this is shading, m. Structure finer than this is smoothed: a pixel of a camera of 1000 px focal length,
# 1.6 m above the road, covers 0.14 m along the line of sight 15 m away, and cameras of other focal lengths show it less sharp.
SHADING_M, BLUR_M = 0.5, 0.12
# Patches that lie farther apart than this are not compared.
MAX_OFFSET_M = 1.5
# Correlation of the registered patches. At its best offset, ground of other kinds of texture (waves, edges, noise) than that of
# the first patch has less than 0.7 in 99 of 100 cases, the same ground has more than 0.9 in 19 of 20.
MIN_CORRELATION = 0.8
# A second place at which patches fit nearly as well makes the first one ambiguous, as along an edge or a crosswalk.
MAX_SECOND_SHARE, SECOND_PEAK_M = 0.9, 0.3
ROUNDS = 8
# Share of the cells that have to be seen in both patches.
MIN_COMMON_SHARE = 0.5
# Errors of neighboring cells are correlated over the blur, so a patch says less than its number of cells, by this factor.
CORRELATION_FACTOR = 4 * np.pi

Gray = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Offset:
    """How far the picture of a second patch lies from that of a first.

    Attributes
    ----------
    offset_m : (2,) float64
        Along the rows and along the columns of the patches, m.
    covariance : (2, 2) float64
        m2.
    correlation : float
        Of the patches after the offset is undone.
    """

    offset_m: Array
    covariance: Array
    correlation: float


def register_patches(first: Gray, second: Gray, cell_m: float) -> Offset | None:
    """Find the offset of the picture in a second patch (R, C) from that in a first; NaN marks cells that are not seen.

    None where too little is seen in both, where patches do not resemble each other, or do so at several offsets.

    Notes
    -----
    Cross-correlation of band-passed patches finds the offset to a cell, Gauss-Newton on their difference (Lucas & Kanade, 1981)
    refines it. The spectrum is not whitened as in phase correlation: far from a camera it holds no fine structure.
    """
    seen = np.isfinite(first) & np.isfinite(second)
    if seen.mean() < MIN_COMMON_SHARE:
        return None
    a, b = (_band_pass(patch, cell_m) for patch in (first, second))
    window = _window(seen, cell_m)
    start = _coarse_offset(a * window, b * window, cell_m)
    return None if start is None else _refine(a, b, window, start, cell_m)


def _band_pass(patch: Gray, cell_m: float) -> Gray:
    known = np.isfinite(patch).astype(np.float32)
    filled = np.where(known > 0, patch, 0.0).astype(np.float32)

    def smooth(sigma_m: float) -> Gray:
        sigma = max(sigma_m / cell_m, 0.3)
        weight = cv2.GaussianBlur(known, (0, 0), sigma, borderType=cv2.BORDER_ISOLATED)
        return np.asarray(
            cv2.GaussianBlur(filled, (0, 0), sigma, borderType=cv2.BORDER_ISOLATED) / np.maximum(weight, 1e-3)
        )

    return np.asarray(smooth(BLUR_M) - smooth(SHADING_M), dtype=np.float32)


def _window(seen: NDArray[np.bool_], cell_m: float) -> Gray:
    """Weigh cells by their distance from the border of what is seen in both patches."""
    padded = cv2.copyMakeBorder(seen.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    inside = cv2.distanceTransform(padded, cv2.DIST_L2, 3)[1:-1, 1:-1] * cell_m
    return np.asarray(np.clip(inside / SHADING_M, 0.0, 1.0), dtype=np.float32)


def _coarse_offset(a: Gray, b: Gray, cell_m: float) -> Array | None:
    """Find the offset (2,), cells, of the largest cross-correlation; None where it is not the only one."""
    rows, columns = (cv2.getOptimalDFTSize(2 * n) for n in a.shape)
    spectrum = np.fft.rfft2(b, (rows, columns)) * np.conj(np.fft.rfft2(a, (rows, columns)))
    surface = np.fft.irfft2(spectrum, (rows, columns))
    reach = [min(int(MAX_OFFSET_M / cell_m), n // 2) for n in a.shape]
    near = np.roll(surface, reach, axis=(0, 1))[: 2 * reach[0] + 1, : 2 * reach[1] + 1]
    row, column = np.unravel_index(int(np.argmax(near)), near.shape)
    peak = near[row, column]
    apart = int(SECOND_PEAK_M / cell_m)
    others = near.copy()
    others[max(row - apart, 0) : row + apart + 1, max(column - apart, 0) : column + apart + 1] = -np.inf
    if not peak > 0 or others.max() > MAX_SECOND_SHARE * peak:
        return None
    return np.array([row - reach[0], column - reach[1]], dtype=np.float64)


def _refine(a: Gray, b: Gray, window: Gray, start: Array, cell_m: float) -> Offset | None:
    offset, gain = start.copy(), 1.0
    normal, variance, correlation = np.zeros((2, 2)), np.inf, 0.0
    for _ in range(ROUNDS):
        shift = np.array([[1, 0, offset[1]], [0, 1, offset[0]]], dtype=np.float32)
        size = (a.shape[1], a.shape[0])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        moved = cv2.warpAffine(b, shift, size, flags=flags)
        weight = cv2.warpAffine(window, shift, size, flags=flags) * window
        if weight.sum() < MIN_COMMON_SHARE * window.sum():
            return None
        total = float(weight.sum())
        am, bm = (x - float((weight * x).sum()) / total for x in (a, moved))
        energy = float((weight * am * am).sum()), float((weight * bm * bm).sum())
        if min(energy) <= 0:
            return None
        correlation = float((weight * am * bm).sum()) / np.sqrt(energy[0] * energy[1])
        gain = np.sqrt(energy[0] / energy[1])
        gradient = np.stack(np.gradient(gain * bm))
        difference = am - gain * bm
        normal = np.einsum("irc,jrc,rc->ij", gradient, gradient, weight)
        if np.linalg.cond(normal) > 1e4:
            return None
        step = np.linalg.solve(normal, np.einsum("irc,rc,rc->i", gradient, difference, weight))
        variance = float((weight * difference**2).sum()) / total
        offset += step
        if np.abs(step).max() < 1e-3:
            break
    if correlation < MIN_CORRELATION or np.abs(offset - start).max() > SECOND_PEAK_M / cell_m:
        return None
    cells = CORRELATION_FACTOR * (BLUR_M / cell_m) ** 2
    covariance = variance * max(cells, 1.0) * np.linalg.inv(normal) * cell_m**2
    return Offset(offset * cell_m, np.asarray(covariance, dtype=np.float64), correlation)


CELL_M = 0.04
# A patch is so long along the line of sight, and at most so wide; narrower ones hold too little.
LENGTH_M, MAX_WIDTH_M, MIN_WIDTH_M = 6.0, 4.0, 0.8
# Azimuths at which overlap is looked for.
AZIMUTHS = np.deg2rad(np.arange(-180.0, 180.0, 0.5))
# Pixels at the border of an image, blurred by undistortion and vignetting, are not used.
BORDER_PX = 8


@dataclass(frozen=True)
class SeamPlace:
    """A patch of the ground that two cameras see.

    Attributes
    ----------
    first, second : str
        The cameras.
    center_m : (float, float)
        In the ground frame.
    azimuth_rad : float
        Direction of its rows, away from the rig's middle.
    """

    first: str
    second: str
    center_m: tuple[float, float]
    azimuth_rad: float
    width_m: float

    def cells(self) -> Array:
        """Return the ground positions (R, C, 2) of the cells, m; rows run outward, columns to the left."""
        along = np.arange(-LENGTH_M / 2, LENGTH_M / 2, CELL_M) + CELL_M / 2
        aside = np.arange(-self.width_m / 2, self.width_m / 2, CELL_M) + CELL_M / 2
        axes = self.axes
        return np.asarray(self.center_m + along[:, None, None] * axes[0] + aside[None, :, None] * axes[1])

    @property
    def axes(self) -> Array:
        """Unit vectors (2, 2) of the rows' and the columns' directions in the ground frame."""
        c, s = np.cos(self.azimuth_rad), np.sin(self.azimuth_rad)
        return np.array([[c, s], [-s, c]])


def find_seams(
    cameras: Mapping[str, Camera], homographies: Mapping[str, Array], middle: Array, distance_m: float
) -> list[SeamPlace]:
    """Find, for each pair of cameras, the middle of what both see at a distance from the rig's `middle` (2,), m.

    `homographies` (3, 3) map undistorted pixels to the ground, by camera.
    """
    names = list(homographies)
    ring = middle + distance_m * np.column_stack([np.cos(AZIMUTHS), np.sin(AZIMUTHS)])
    inside = {name: _sees(cameras[name], homographies[name], ring) for name in names}
    out = []
    for i, first in enumerate(names):
        for second in names[i + 1 :]:
            for run in _runs(inside[first] & inside[second]):
                width = min(distance_m * len(run) * float(AZIMUTHS[1] - AZIMUTHS[0]), MAX_WIDTH_M)
                if width < MIN_WIDTH_M:
                    continue
                azimuth = float(AZIMUTHS[run[len(run) // 2]])
                center = middle + distance_m * np.array([np.cos(azimuth), np.sin(azimuth)])
                out.append(SeamPlace(first, second, (float(center[0]), float(center[1])), azimuth, width))
    return out


def _runs(mask: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Find the longest runs of a mask (A,) around the circle."""
    if not mask.any():
        return []
    start = int(np.argmin(mask))  # a place that is not in a run, so that none is cut
    index = (np.arange(len(mask)) + start) % len(mask)
    edges = np.flatnonzero(np.diff(mask[index].astype(np.int8), prepend=0, append=0))
    return [index[a:b] for a, b in zip(edges[::2], edges[1::2])]


def pixels_of(camera: Camera, ground_H_image: Array, xy: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Project ground positions (..., 2) into the image as it was recorded: pixels (..., 2), and whether they are inside."""
    q = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1) @ np.linalg.inv(ground_H_image).T
    front = q[..., 2] > 0
    uv = q[..., :2] / np.where(front, q[..., 2], 1.0)[..., None]
    near = front & (np.abs(uv) < 4 * camera.width_px).all(axis=-1)
    rays = (np.where(near[..., None], uv, 0.0).reshape(-1, 2) - camera.K[:2, 2]) @ np.linalg.inv(camera.K[:2, :2]).T
    uv = (distort(camera, rays) @ camera.K[:2, :2].T + camera.K[:2, 2]).reshape(uv.shape)
    inside = near & (uv >= BORDER_PX).all(axis=-1)
    inside &= (uv[..., 0] < camera.width_px - BORDER_PX) & (uv[..., 1] < camera.height_px - BORDER_PX)
    return uv, inside


def _sees(camera: Camera, ground_H_image: Array, xy: Array) -> NDArray[np.bool_]:
    return pixels_of(camera, ground_H_image, xy)[1]


def draw_patch(image: NDArray[np.uint8], camera: Camera, ground_H_image: Array, xy: Array) -> Gray:
    """Draw the ground at positions (R, C, 2) from a picture: (R, C), gray, NaN where the camera does not see it."""
    uv, inside = pixels_of(camera, ground_H_image, xy)
    u, v = (uv[..., k].astype(np.float32) for k in range(2))
    drawn = cv2.remap(image, u, v, cv2.INTER_LINEAR)
    gray = drawn if drawn.ndim == 2 else cv2.cvtColor(drawn, cv2.COLOR_BGR2GRAY)
    return np.where(inside, gray, np.nan).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Seam:
    """How far two cameras' pictures of the ground lie apart at a place.

    Attributes
    ----------
    offset_m : (2,) float64
        From the picture of the first camera to that of the second, ground frame, m.
    covariance : (2, 2) float64
    pixels : (2, 2) float64
        Undistorted pixels of the two cameras that show one point of the ground, that at the middle of the place.
    """

    place: SeamPlace
    tick: int
    offset_m: Array
    covariance: Array
    pixels: Array

    @property
    def distance_m(self) -> float:
        """Length of the offset."""
        return float(np.hypot(*self.offset_m))


def measure_seam(
    place: SeamPlace,
    tick: int,
    hidden: Mapping[str, NDArray[np.bool_]],
    images: Mapping[str, NDArray[np.uint8]],
    cameras: Mapping[str, Camera],
    homographies: Mapping[str, Array],
) -> Seam | None:
    """Register what two cameras show of a place but where it is hidden (R, C) from either; None where that is not possible."""
    xy, patches = place.cells(), []
    for name in (place.first, place.second):
        patch = draw_patch(images[name], cameras[name], homographies[name], xy)
        patches.append(np.where(hidden[name], np.nan, patch).astype(np.float32))
    found = register_patches(patches[0], patches[1], CELL_M)
    if found is None:
        return None
    axes = place.axes
    offset = found.offset_m @ axes
    shown = np.array([place.center_m, place.center_m + offset])
    image_H_ground = np.linalg.inv([homographies[place.first], homographies[place.second]])
    q = np.einsum("kij,kj->ki", image_H_ground, np.column_stack([shown, np.ones(2)]))
    return Seam(place, tick, offset, axes.T @ found.covariance @ axes, q[:, :2] / q[:, 2:])


def misalignment_m(seam: Seam, homographies: Mapping[str, Array]) -> float:
    """Compute how far apart other homographies put what both cameras show, m; infinite where it is above a horizon."""
    h = np.array([homographies[seam.place.first], homographies[seam.place.second]])
    q = np.einsum("kij,kj->ki", h, np.column_stack([seam.pixels, np.ones(2)]))
    if not (q[:, 2] > 0).all():
        return float("inf")
    xy = q[:, :2] / q[:, 2:]
    return float(np.hypot(*(xy[1] - xy[0])))


# The road is not a plane: cameras half a meter apart and 1.6 m high show 0.05 m of height 0.015 m apart. Together with what the
# road of one tick has in common with that of the next, this bounds what a seam says.
SEAM_SIGMA_M = 0.02
# Rounds of weighing seams by their errors, with the weights of a Cauchy distribution.
MOUNT_ROUNDS = 10


def fit_mounts(rig: RigFit, seams: Sequence[Seam]) -> dict[str, Array]:
    """Find rotations (3,), rad, of the mounts by camera that make seams vanish; those of the state where none tells.

    Notes
    -----
    Linear least squares with a normal prior of the mounts about the calibration, iteratively reweighted. Seams tell rotations
    against each other, the prior distributes them.
    """
    assert rig.state is not None
    names = list(rig.rig.cameras)
    value = np.concatenate([rig.state.mount[name] for name in names])
    rows, errors, whiten = [], [], []
    for seam in seams:
        if seam.place.first in names and seam.place.second in names:
            row = np.zeros((2, 3 * len(names)))
            for sign, name in ((-1.0, seam.place.first), (1.0, seam.place.second)):
                k = 3 * names.index(name)
                row[:, k : k + 3] = sign * moved_by_turn(rig, name, np.array(seam.place.center_m))
            rows.append(row)
            errors.append(seam.offset_m)
            whiten.append(np.linalg.inv(np.linalg.cholesky(seam.covariance + SEAM_SIGMA_M**2 * np.eye(2))))
    if not rows:
        return dict(rig.state.mount)
    slope, error = np.array(rows), np.array(errors)
    slope, error = np.array(whiten) @ slope, (np.array(whiten) @ error[:, :, None])[:, :, 0]
    step, prior = np.zeros(len(value)), np.full(len(value), MOUNT_SIGMA_RAD**-2.0)
    for _ in range(MOUNT_ROUNDS):
        left = error + slope @ step
        weight = 1.0 / (1.0 + (left**2).sum(axis=1) / 2)
        weighted = slope * weight[:, None, None]
        normal = np.einsum("nip,niq->pq", weighted, slope) + np.diag(prior)
        step = -np.linalg.solve(normal, np.einsum("nip,ni->p", weighted, error) + prior * value)
    return {name: value[3 * k : 3 * k + 3] + step[3 * k : 3 * k + 3] for k, name in enumerate(names)}


def moved_by_turn(rig: RigFit, name: str, xy: Array) -> Array:
    """Compute the derivatives (2, 3) of the ground position of a pixel that shows `xy` (2,) by a turn of its camera."""
    assert rig.state is not None
    turn = rotation_of(rig.state.mount[name])
    matrix = cam_of_ground(rig.rig.cameras[name], rig.state.plane, turn)
    point = matrix @ [*(xy - rig.rig.origin_m[:2]), 1.0]
    by_point = np.array([[1.0, 0.0, -point[0] / point[2]], [0.0, 1.0, -point[1] / point[2]]])
    return np.asarray(-np.linalg.solve(by_point @ matrix[:, :2], by_point @ np.cross(np.eye(3), point).T))


def with_mounts(rig: RigFit, mounts: Mapping[str, Array]) -> RigFit:
    """Return a fit with other mounts; obstacles are placed as before, since what their feet ask for is known without them."""
    assert rig.state is not None
    feet = {name: rig.state.feet[name] + rig.state.mount[name] - mounts[name] for name in mounts}
    return replace(rig, state=replace(rig.state, mount=mounts, feet=feet))


# Ground points within this distance of a patch, so much time before and after, show that it lies on the ground.
NEAR_M, NEAR_S, MIN_GROUND_POINTS = 3.0, 2.0, 3
# Ground farther than this from the plane of the road is shown elsewhere by cameras in other places: half a usual curb of 0.15 m
# tells a sidewalk from the crown of a road.
MAX_STEP_M = 0.075
# LiDAR points above the ground stand for what is within this distance: one is kept of each voxel, and between the rings of a
# LiDAR with 32 lines lies 0.3 m on an object 15 m away.
POINT_REACH_M = 0.3
# Of the height of a camera: points above it hide no ground from it.
MAX_HEIGHT_SHARE = 0.95


@dataclass(frozen=True, eq=False)
class Standing:
    """What is known of the ground around the cameras at a tick, in the ground frame of the tick.

    Attributes
    ----------
    cameras : mapping of str to (3,) float64
        Positions over the ground, m.
    boxes_px : mapping of str to (M, 4) float64
        Of detected objects.
    points : (P, 3) float64 or None
        LiDAR points above the ground, heights over the ground; None without LiDAR.
    ground : (G, 3) float64
        LiDAR points on the ground within seconds.
    """

    cameras: Mapping[str, Array]
    boxes_px: Mapping[str, Array]
    points: Array | None
    ground: Array

    def hidden(
        self, place: SeamPlace, cameras: Mapping[str, Camera], roads: Mapping[str, Array], road_z_m: float | None = None
    ) -> dict[str, NDArray[np.bool_]] | None:
        """Mark the cells (R, C) of a place at which a camera sees something else than the ground; None where it is no road.

        `road_z_m` is the height of the road there, in the ground frame; without it any ground is taken for road.
        """
        if self.points is not None and not self._is_road(place, road_z_m):
            return None
        xy = place.cells()
        out = {}
        for name in (place.first, place.second):
            hidden = self._hidden_by_points(place, name, xy.shape[:2])
            if len(self.boxes_px[name]):
                uv, _ = pixels_of(cameras[name], roads[name], xy)
                low, high = uv.min(axis=(0, 1)), uv.max(axis=(0, 1))
                for box in self.boxes_px[name]:
                    if (box[:2] < high).all() and (box[2:] > low).all():
                        hidden |= ((uv >= box[:2]) & (uv <= box[2:])).all(axis=-1)
            out[name] = hidden
        return out

    def _is_road(self, place: SeamPlace, road_z_m: float | None) -> bool:
        near = self.ground[np.hypot(*(self.ground[:, :2] - place.center_m).T) < NEAR_M]
        if len(near) < MIN_GROUND_POINTS:
            return False
        return road_z_m is None or abs(float(np.median(near[:, 2])) - road_z_m) < MAX_STEP_M

    def _hidden_by_points(self, place: SeamPlace, name: str, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        marked = np.zeros(shape, dtype=np.uint8)
        xy = self._covered_xy[name]
        reach = np.hypot(LENGTH_M, place.width_m) / 2
        near = xy[(np.abs(xy - place.center_m) < reach).all(axis=1)]
        local = (near - place.center_m) @ place.axes.T + [LENGTH_M / 2, place.width_m / 2]
        index = np.floor(local / CELL_M).astype(np.int64)
        inside = ((index >= 0) & (index < shape)).all(axis=1)
        marked[index[inside, 0], index[inside, 1]] = 1
        side = 2 * int(POINT_REACH_M / CELL_M) + 1
        return np.asarray(cv2.dilate(marked, np.ones((side, side), np.uint8)) > 0)

    @cached_property
    def _covered_xy(self) -> dict[str, Array]:
        """Ground (N, 2) on which the points stand, and that which they hide from a camera, by camera."""
        out = {}
        for name, (x, y, height) in self.cameras.items():
            points = np.zeros((0, 3)) if self.points is None else self.points
            lower = points[points[:, 2] < MAX_HEIGHT_SHARE * height]
            at = np.array([x, y])
            behind = at + (lower[:, :2] - at) * (height / (height - lower[:, 2]))[:, None]
            out[name] = np.concatenate([lower[:, :2], behind])
        return out


def ground_points(log: Log, schedule: Schedule, observed: Observations) -> tuple[NDArray[np.int64], Array]:
    """Collect the LiDAR's ground points of all cameras and ticks: stamps (G,) of their ticks, and positions (G, 3), map frame.

    Their heights are those at which the rays of the cameras pass over them.
    """
    stamps, places = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3))]
    for camera, parts in observed.ground.items():
        rig = Rig.of({camera: log.cameras[camera]}, 0.0)
        for rows in (RigRows.of(rig, {camera: part}, 1.0, 0.1) for part in parts if len(part)):
            if len(rows):
                tick = int(rows.tick[0])
                pose = base_pose(log, int(log.streams[camera].t_ns[schedule.frames[camera][tick]]))
                xyz = np.column_stack([rows.xy + rig.origin_m[:2], heights_of(rig, rows)[0]])
                places.append(apply(pose, xyz))
                stamps.append(np.full(len(rows), schedule.t_ns[tick]))
    return np.concatenate(stamps), np.concatenate(places)


def standing_at(
    log: Log, schedule: Schedule, observed: Observations, ground: tuple[NDArray[np.int64], Array], tick: int
) -> Standing:
    """Collect what is known of a tick; `ground` comes from `ground_points`."""
    t_ns = int(schedule.t_ns[tick])
    base_T_map = inverse(base_pose(log, t_ns))
    cameras = {}
    for name, index in schedule.frames.items():
        pose, known = log.map_T_sensor(name, log.streams[name].t_ns[max(int(index[tick]), 0)])
        if index[tick] >= 0 and known[0]:
            cameras[name] = (base_T_map @ pose[0])[:3, 3] - [0.0, 0.0, log.ground_z_ego_m]
    m = observed.measurements[tick]
    points = None
    obstacles = observed.obstacles[tick] if tick < len(observed.obstacles) else None
    if obstacles is not None:
        points = apply(base_T_map, obstacles.xyz.astype(np.float64) + obstacles.origin)
        points[:, 2] -= log.ground_z_ego_m
    near = np.abs(ground[0] - t_ns) < NEAR_S * NS_PER_S
    boxes_px = {name: m.box_px[m.camera == name] for name in schedule.frames}
    return Standing(cameras, boxes_px, points, apply(base_T_map, ground[1][near]))


# Distances from the rig at which cameras are compared; the middle one is the distance at which misalignment is reported.
DISTANCES_M = (9.0, 15.0)
REPORT_M = 15.0
# Ticks of which pictures are read to align mounts, and others to measure what is left.
TICKS = 6
# Rounds of measuring and turning: the offset varies over a patch by its share of the distance, so each leaves a fifth of it.
ALIGNING_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class SeamSurvey:
    """Seams between the cameras of a log at some ticks.

    Attributes
    ----------
    places : int
        How many patches two cameras see.
    covered : int
        How many of them show an object, or no ground.
    """

    seams: tuple[Seam, ...] = ()
    places: int = 0
    covered: int = 0

    @property
    def median_m(self) -> float | None:
        """Median length of the offsets, m; None where no patch could be registered."""
        return float(np.median([s.distance_m for s in self.seams])) if self.seams else None


@dataclass(frozen=True, eq=False)
class SeamPictures:
    """Gray pictures of all cameras at some ticks, and what stands on the ground there.

    Attributes
    ----------
    images : mapping of (str, int) to (H, W) uint8
        By camera and tick.
    """

    log: Log
    schedule: Schedule
    observed: Observations
    images: Mapping[tuple[str, int], NDArray[np.uint8]] = field(default_factory=dict)

    @classmethod
    def read(
        cls, log: Log, schedule: Schedule, observed: Observations, reader: RecordSource, ticks: Sequence[int]
    ) -> SeamPictures:
        """Read the pictures of some ticks; black, frozen and unreadable ones are left out."""
        images = {}
        for tick in ticks:
            for camera, index in schedule.frames.items():
                image = reader.get(camera, int(index[tick])) if index[tick] >= 0 else None
                t_ns = int(log.streams[camera].t_ns[index[tick]])
                if image is not None and reader.watch.is_live(camera, t_ns, image):
                    images[camera, tick] = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        return cls(log, schedule, observed, images)

    def survey(
        self, homographies: Mapping[str, CameraHomography], distances_m: Sequence[float] = (REPORT_M,)
    ) -> SeamSurvey:
        """Compare neighboring cameras by the homographies of the road."""
        seams, places, covered = [], 0, 0
        for tick in sorted({tick for _, tick in self.images}):
            seen = {name: g for name, g in homographies.items() if (name, tick) in self.images}
            roads = roads_at(self.log, self.schedule, seen, tick)
            if len(roads) < 2:
                continue
            cameras = {name: self.log.cameras[name] for name in roads}
            images = {name: self.images[name, tick] for name in roads}
            middle = np.mean([self._standing[tick].cameras[name][:2] for name in roads], axis=0)
            for place in (p for d in distances_m for p in find_seams(cameras, roads, middle, d)):
                places += 1
                rig = homographies[place.first].rig
                z = None if rig is None else rig.road_z_m(np.array(place.center_m), tick)
                hidden = self._standing[tick].hidden(place, cameras, roads, z)
                if hidden is None:
                    covered += 1
                    continue
                seam = measure_seam(place, tick, hidden, images, cameras, roads)
                if seam is not None:
                    seams.append(seam)
        return SeamSurvey(tuple(seams), places, covered)

    @cached_property
    def _standing(self) -> dict[int, Standing]:
        """What stands on the ground at each tick."""
        points = ground_points(self.log, self.schedule, self.observed)
        return {
            tick: standing_at(self.log, self.schedule, self.observed, points, tick)
            for tick in sorted({tick for _, tick in self.images})
        }

    def misalignments_m(self, seams: Sequence[Seam], homographies: Mapping[str, CameraHomography]) -> Array:
        """Compute how far apart (N,) other homographies put what the cameras show at seams; NaN where a camera has none."""
        roads = {t: roads_at(self.log, self.schedule, homographies, t) for t in {seam.tick for seam in seams}}
        known = [{s.place.first, s.place.second} <= set(roads[s.tick]) for s in seams]
        return np.array([misalignment_m(s, roads[s.tick]) if k else np.nan for s, k in zip(seams, known)])


def roads_at(log: Log, schedule: Schedule, homographies: Mapping[str, CameraHomography], tick: int) -> dict[str, Array]:
    """Compute the homographies (3, 3) of the road of cameras with a frame at a tick, in the ground frame at its stamp."""
    out, base = {}, base_pose(log, int(schedule.t_ns[tick]))
    for name, ground in homographies.items():
        index = int(schedule.frames[name][tick])
        h = ground.road_at_tick(tick) if index >= 0 else None
        if h is not None:
            # The ego moves between the stamps of two cameras.
            moved = inverse(base) @ base_pose(log, int(log.streams[name].t_ns[index]))
            level = np.array([[*moved[0, :2], moved[0, 3]], [*moved[1, :2], moved[1, 3]], [0.0, 0.0, 1.0]])
            out[name] = level @ h
    return out


def ticks_of(schedule: Schedule, count: int = TICKS, *, held_out: bool = False) -> list[int]:
    """Choose ticks evenly over a log; `held_out` ones lie between the others."""
    steps = np.arange(count) + (0.75 if held_out else 0.25)
    return sorted({int(t) for t in np.floor(steps / count * len(schedule))})


def align_seams(
    pictures: SeamPictures, homographies: Mapping[str, CameraHomography]
) -> tuple[dict[str, CameraHomography], SeamSurvey]:
    """Turn the cameras of each rig so that their pictures of the road agree; returns the homographies and what was compared.

    Cameras that were fitted apart stay as they are. What is not observed stays at the calibration.
    """
    out, survey = dict(homographies), SeamSurvey()
    for _ in range(ALIGNING_ROUNDS):
        survey = pictures.survey(out, DISTANCES_M)
        for rig in {id(g.rig): g.rig for g in out.values() if g.rig is not None}.values():
            mounts = fit_mounts(rig, survey.seams)
            turned = with_mounts(rig, mounts)
            for name, ground in out.items():
                if ground.rig is rig:
                    out[name] = replace(ground, rig=turned)
    return out, survey
