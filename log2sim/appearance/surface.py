"""Which pixels show the paint of a vehicle: rays of a picture against the simple shape of its kind.

A vehicle is two blocks, a body and above it a cabin or load, in shares of its box: heights from 0 at the ground to 1, lengths
from -0.5 at the rear to 0.5 at the front. The shares are those of common vehicles (SAE J1100 side views): windows begin at
0.6 to 0.65 of a car's height, wheels reach up to 0.42 to 0.48 and lie 0.3 of the length from the middle.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

Bool = NDArray[np.bool_]


@dataclass(frozen=True)
class Block:
    """A block of a vehicle and the weights of its sides.

    Attributes
    ----------
    u : (float, float)
        From rear to front, in lengths.
    h : (float, float)
        From bottom to top, in heights.
    half : float
        Half of its width, in widths.
    band : (float, float)
        Heights between which its sides are painted, in heights.
    side, end, top : float
        How much a pixel there says about the paint, 0 for glass: panels more than ends with lights, plates and grilles, and these more
        than level faces, which mirror the sky.
    """

    u: tuple[float, float]
    h: tuple[float, float]
    half: float
    band: tuple[float, float]
    side: float
    end: float
    top: float


CAR = (
    Block((-0.5, 0.5), (0.12, 0.63), 0.5, (0.28, 0.6), 1.0, 0.6, 0.5),
    Block((-0.42, 0.2), (0.63, 1.0), 0.42, (0.0, 0.0), 0.0, 0.0, 0.4),
)
# The load of a truck is larger than its cab, which takes the front quarter to third, and its color is what one names. Where only
# the cab is seen, below its windshield, that is the color.
TRUCK = (
    Block((-0.5, 0.5), (0.1, 0.36), 0.48, (0.2, 0.34), 0.05, 0.05, 0.0),
    Block((-0.5, 0.15), (0.36, 1.0), 0.5, (0.44, 0.94), 1.0, 0.8, 0.5),
    Block((0.2, 0.5), (0.1, 0.8), 0.46, (0.2, 0.42), 0.1, 0.1, 0.0),
)
BUS = (
    Block((-0.5, 0.5), (0.1, 0.42), 0.5, (0.17, 0.4), 1.0, 0.6, 0.0),
    Block((-0.5, 0.5), (0.42, 1.0), 0.5, (0.83, 0.97), 0.7, 0.4, 0.5),
)
LOW_TRUCK_M = 2.3  # pickups and vans are lower, and shaped like cars
SHAPES: Mapping[str, tuple[Block, ...]] = {"car": CAR, "truck": TRUCK, "bus": BUS}
WHEEL_AT, WHEEL_REACH = 0.3, 0.115  # of the length; half of a wheel arch
WHEEL_TOP = 0.5  # of the height of a car
# Lights lie at the outer thirds of both ends, plates and badges in the middle, all within these heights of a car.
LAMP_FROM, LAMP_BAND, PLATE_TO = 0.27, (0.38, 0.62), 0.16
FLAT = 0.4  # cosine of the angle from which on a side is seen too flat: it mirrors much, and errors of the box shift it
EDGE_M = 0.06  # the outline of a box is less sure than its middle, and pixels there mix with what is behind


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays meet a vehicle.

    Attributes
    ----------
    distance : (N,) float64
        Along the rays, infinite where they miss it.
    weight : (N,) float64
        How much the place says about the paint.
    facing : (N,) float64
        Cosine of the angle between the ray and the surface's normal.
    """

    distance: Array
    weight: Array
    facing: Array


@dataclass(frozen=True, eq=False)
class Surface:
    """Pixels of a vehicle's surface.

    Attributes
    ----------
    pixels : (N, 3) float64
        Linear RGB.
    weight : (N,) float64
        How much each says about the paint.
    facing : (N,) float64
        Cosines of the angles at which it is seen.
    height_px : float
        Of the whole vehicle in the picture.
    """

    pixels: Array
    weight: Array
    facing: Array
    height_px: float


def hit_vehicle(category: str, size_m: Array, origin: Array, rays: Array) -> Hits:
    """Intersect rays with a vehicle.

    Parameters
    ----------
    category : {"car", "truck", "bus"}
    size_m : (3,), m
    origin : (3,), m
        Of the rays, in the frame of the box (origin at its center, x to the front).
    rays : (N, 3)
        Directions in that frame.
    """
    distance, weight, facing = np.full(len(rays), np.inf), np.zeros(len(rays)), np.ones(len(rays))
    cosines = np.abs(rays) / np.linalg.norm(rays, axis=1, keepdims=True)
    kind = "car" if category == "truck" and size_m[2] < LOW_TRUCK_M else category
    for block in SHAPES[kind]:
        low = np.array([block.u[0], -block.half, block.h[0] - 0.5]) * size_m
        high = np.array([block.u[1], block.half, block.h[1] - 0.5]) * size_m
        entry, axis = hit_block(low, high, origin, rays)
        nearer = entry < distance
        distance[nearer] = entry[nearer]
        points = origin + rays[nearer] * entry[nearer, None]
        weight[nearer] = _weights(block, kind, size_m, points, axis[nearer])
        facing[nearer] = cosines[nearer, axis[nearer]]
    return Hits(distance, weight * np.clip(facing / FLAT, 0.0, 1.0), facing)


def hit_block(low: Array, high: Array, origin: Array, rays: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return the distances (N,) at which rays enter a block, infinite for none, and the axes (N,) of the faces there.

    Notes
    -----
    Slabs (Kay and Kajiya 1986). A block around the origin of the rays is not entered.
    """
    # By axis: reductions over rows of three take many times as long.
    near, far = [], []
    with np.errstate(divide="ignore", invalid="ignore"):
        for k in range(3):
            a, b = (low[k] - origin[k]) / rays[:, k], (high[k] - origin[k]) / rays[:, k]
            near.append(np.fmin(a, b))
            far.append(np.fmax(a, b))
    entry, leave = np.maximum(np.maximum(near[0], near[1]), near[2]), np.minimum(np.minimum(far[0], far[1]), far[2])
    axis = np.where(near[0] == entry, 0, np.where(near[1] == entry, 1, 2))
    return np.where((entry <= leave) & (entry > 0), entry, np.inf), axis


def _weights(block: Block, category: str, size_m: Array, points: Array, axis: NDArray[np.intp]) -> Array:
    """Weigh points (N, 3) on the faces of a block by what is there."""
    u, y, h = points[:, 0] / size_m[0], points[:, 1] / size_m[1], points[:, 2] / size_m[2] + 0.5
    weight = np.array([block.end, block.side, block.top])[axis]
    upright = axis != 2
    weight[upright & ((h < block.band[0]) | (h > block.band[1]))] = 0.0
    low = h * size_m[2] < WHEEL_TOP * min(size_m[2], 2.0)
    wheel = (axis == 1) & low & (np.abs(np.abs(u) - WHEEL_AT) < WHEEL_REACH)
    weight[wheel] = 0.0
    if category == "car":
        lamp = (np.abs(y) > LAMP_FROM) | (np.abs(y) < PLATE_TO)
        weight[(axis == 0) & lamp & (h > LAMP_BAND[0]) & (h < LAMP_BAND[1])] *= 0.2
    inner = np.minimum(size_m / 2 - np.abs(points), np.inf)
    inner[np.arange(len(points)), axis] = np.inf
    weight[inner[:, :2].min(axis=1) < EDGE_M] = 0.0
    return np.asarray(weight)
