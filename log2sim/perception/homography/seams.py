"""Seams between neighboring cameras of a rig: where they are, what both show of the ground there, and how far it lies apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, Camera, distort
from log2sim.perception.homography.registration import Gray, Offset, register_patches

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
    width_m : float
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
    place : SeamPlace
    tick : int
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


@dataclass(frozen=True, eq=False)
class SeamView:
    """A place at a tick, and what of it is hidden from either camera.

    Attributes
    ----------
    place : SeamPlace
    tick : int
    hidden : mapping of str to (R, C) bool
        Cells that do not show the ground, by camera.
    """

    place: SeamPlace
    tick: int
    hidden: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)


def measure_seam(
    view: SeamView, images: Mapping[str, NDArray[np.uint8]], cameras: Mapping[str, Camera],
    homographies: Mapping[str, Array],
) -> Seam | None:  # fmt: skip
    """Register what two cameras show of a place; None where that is not possible."""
    place, tick = view.place, view.tick
    xy, patches = place.cells(), []
    for name in (place.first, place.second):
        patch = draw_patch(images[name], cameras[name], homographies[name], xy)
        patches.append(np.where(view.hidden[name], np.nan, patch).astype(np.float32) if view.hidden else patch)
    found: Offset | None = register_patches(patches[0], patches[1], CELL_M)
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


def summarize_seams(seams: Sequence[Seam]) -> dict[str, float]:
    """Compute the median misalignment, m, of each pair of cameras, named first|second."""
    pairs: dict[str, list[float]] = {}
    for seam in seams:
        pairs.setdefault(f"{seam.place.first}|{seam.place.second}", []).append(seam.distance_m)
    return {pair: float(np.median(lengths)) for pair, lengths in pairs.items()}
