"""Light in a picture, and which of its pixels show the paint of a vehicle.

Values of pixels are linear RGB in [0, 1]. Dividing them by the `white` of a `Light` gives reflectances, for a surface that is
lit as the doors of a vehicle are.

Notes
-----
Each cue is a normal distribution of the logarithm of what a white surface looks like, by channel; they are multiplied. The
cues are independent of the vehicle's own color, which would otherwise be taken for the light's.

A vehicle is two blocks, a body and above it a cabin or load, in shares of its box: heights from 0 at the ground to 1, lengths
from -0.5 at the rear to 0.5 at the front. The shares are those of common vehicles (SAE J1100 side views): windows begin at
0.6 to 0.65 of a car's height, wheels reach up to 0.42 to 0.48 and lie 0.3 of the length from the middle.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, cross_slab

# The camera's own white balance and exposure: white surfaces in the scene's main light look white, up to the errors of
# automatic white balance (about 5 degrees of angular error, Barnard et al. 2002) and one photographic stop.
CAMERA_WHITE, CAMERA_TONE_SIGMA, CAMERA_EXPOSURE_SIGMA = 0.6, 0.08, 0.5
# All surfaces of a scene together are gray (Buchsbaum 1980). What lies below the horizon in traffic, asphalt, concrete, grass and
# vehicles, reflects somewhat less than the gray card of photographers (0.18); scenes differ by about this much. In colors, the rule is
# 6 to 7 degrees off (median of the benchmark of Gehler et al. 2008).
GRAY_WORLD, GRAY_WORLD_SIGMA, GRAY_WORLD_TONE_SIGMA = 0.15, 0.5, 0.2
# Reflectance of asphalt: 0.04 to 0.06 new, 0.09 to 0.18 when worn (Li, Harvey et al. 2013); concrete has 0.2 to 0.35.
ASPHALT, ASPHALT_SIGMA, ASPHALT_TONE_SIGMA = 0.12, 0.40, 0.09
# Markings, curbs and paving around a vehicle are brighter than the asphalt.
ROAD_QUANTILE = 0.3
# Light on upright surfaces relative to that on level ground: 0.4 of it under clouds (CIE overcast sky) and some from the road, in
# the sun from 0.3 in the shade to 1 where it faces a sun at 45 degrees.
DOOR_SHARE, DOOR_SIGMA = 0.55, 0.4
# A clear coat of refractive index 1.5 to 1.6 mirrors 4 to 5 percent of what is around it, more at flat angles (Schlick 1994).
FRESNEL = 0.05
# At very flat angles a door mirrors what stands beside it rather than the sky: no more than at this cosine.
LEAST_FACING = 0.5
# What a vehicle mirrors is as bright as the upper half of the picture, up to this share.
MIRRORED_SIGMA = 0.5
# Reflectance of the darkest parts of a vehicle (tire rubber 0.03, half shaded), which share of it they are at least, and the most
# that haze adds where a vehicle is still near enough.
DARKEST, DARK_QUANTILE, MAX_VEIL = 0.02, 0.02, 0.15
# Clipped pixels say only that the surface is at least as bright.
CLIPPED, DARK = 0.96, 0.003
MIN_PIXELS = 30
# Of the light from a surface; what it mirrors varies too much to take nearly all of it for a reflection.
LEAST_DIFFUSE = 0.1


@dataclass(frozen=True, eq=False)
class Light:
    """Light on a vehicle."""

    white: Array  # (3,): what a white, diffuse, upright surface would look like, linear RGB
    # (3,): what doors and hoods mirror: the mean of what rises above the middle of the picture, sky and facades
    around: Array
    # `exposure_sigma`, `tone_sigma`: standard deviations of the logarithm of its brightness, and of the ratios of its
    # channels
    exposure_sigma: float
    tone_sigma: float


def linear_values(rgb: NDArray[np.uint8]) -> Array:
    """Return linear values in [0, 1] of sRGB values (..., 3) from 0 to 255 (IEC 61966-2-1)."""
    return _TABLE[rgb]


_VALUES = np.arange(256) / 255
_TABLE = np.where(_VALUES <= 0.04045, _VALUES / 12.92, ((_VALUES + 0.055) / 1.055) ** 2.4)


def reflectances(pixels: Array, light: Light, facing: Array, veil: Array) -> Array:
    """Return the diffuse reflectances (N, 3) of glossy surfaces: without what they mirror, and without haze.

    `pixels`: (N, 3): linear RGB. `facing`: (N,): cosines of the angles at which they are seen. `veil`: (3,): light that
    haze and the lens add, see `veil_of`.
    """
    # The darkest parts of a vehicle mirror something too: the veil contains a part of what the paint mirrors.
    added = np.maximum(mirrored_share(facing)[:, None] * light.around, veil)
    return np.asarray(np.maximum(pixels - added, LEAST_DIFFUSE * pixels) / light.white)


def veil_of(pixels: Array, light: Light) -> Array:
    """Estimate the light (3,) that haze and the lens add, from all pixels (N, 3) of a vehicle, linear RGB.

    Notes
    -----
    Tires, wheel houses and the shade below reflect nearly nothing; what they look like is the veil (dark-object subtraction,
    Chavez 1988).
    """
    if not len(pixels):
        return np.zeros(3)
    dark = np.quantile(pixels, DARK_QUANTILE, axis=0)
    return np.asarray(np.clip(dark - DARKEST * light.white, 0.0, MAX_VEIL * light.white))


def mirrored_share(facing: Array) -> Array:
    """Return the share of light that a clear coat mirrors at cosines (N,) of the angle of incidence."""
    return np.asarray(FRESNEL + (1 - FRESNEL) * (1 - np.maximum(facing, LEAST_FACING)) ** 5)


def estimate_light(below: Array, above: Array, ground: Array) -> Light:
    """Estimate the light from pixels of the surroundings, linear RGB.

    `below, above`: (N, 3): of the lower and the upper half of the picture. `ground`: (G, 3): of the road around the
    vehicle; may be empty.
    """
    tones, levels = [(np.zeros(3), CAMERA_TONE_SIGMA)], [(np.log(CAMERA_WHITE), CAMERA_EXPOSURE_SIGMA)]
    usable = below[_is_usable(below)]
    if len(usable) >= MIN_PIXELS:
        log_mean = np.log(usable).mean(axis=0)
        tones.append((log_mean - log_mean.mean(), GRAY_WORLD_TONE_SIGMA))
        levels.append((log_mean.mean() + np.log(DOOR_SHARE / GRAY_WORLD), GRAY_WORLD_SIGMA))
    usable = ground[_is_usable(ground)]
    if len(usable) >= MIN_PIXELS:
        road = np.log(np.quantile(usable, ROAD_QUANTILE, axis=0))
        tones.append((road - road.mean(), ASPHALT_TONE_SIGMA))
        levels.append((road.mean() + np.log(DOOR_SHARE / ASPHALT), np.hypot(ASPHALT_SIGMA, DOOR_SIGMA)))
    level, exposure_sigma = _join(*(np.array(column) for column in zip(*levels)))
    # A wet road mirrors the sky, a lamp lights it alone: the cue between the two others is not led astray by one.
    level = np.median([value for value, _ in levels])
    tone, tone_sigma = _join(*(np.array(column) for column in zip(*tones)))
    around = above.mean(axis=0) if len(above) else np.exp(level + tone) * GRAY_WORLD
    return Light(np.exp(level + tone), np.asarray(around, float), exposure_sigma, tone_sigma)


def _is_usable(pixels: Array) -> NDArray[np.bool_]:
    return np.asarray((pixels.max(axis=1) < CLIPPED) & (pixels.min(axis=1) > DARK))


def _join(values: Array, sigma: Array) -> tuple[Array, float]:
    """Return the product (...) of normal distributions (K, ...) and its sigma, larger where they contradict each other.

    Notes
    -----
    The sigma is scaled by the Birge ratio (1932), the root of chi-squared by its degrees of freedom, where that is above 1.
    """
    weight = sigma**-2.0
    mean = np.average(values, axis=0, weights=weight)
    sigma_mean = float(weight.sum() ** -0.5)
    if len(values) == 1:
        return mean, sigma_mean
    off = (values - mean) ** 2
    chi_squared = float((off.reshape(len(values), -1).mean(axis=1) * weight).sum()) / (len(values) - 1)
    return mean, sigma_mean * max(1.0, chi_squared**0.5)


@dataclass(frozen=True)
class Block:
    """A block of a vehicle and the weights of its sides."""

    u: tuple[float, float]  # (float, float): from rear to front, in lengths
    h: tuple[float, float]  # (float, float): from bottom to top, in heights
    half: float  # half of its width, in widths
    band: tuple[float, float]  # (float, float): heights between which its sides are painted, in heights
    # `side`, `end`, `top`: how much a pixel there says about the paint, 0 for glass: panels more than ends with lights,
    # plates and grilles, and these more than level faces, which mirror the sky
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
    """Where rays meet a vehicle."""

    distance: Array  # (N,): along the rays, infinite where they miss it
    weight: Array  # (N,): how much the place says about the paint
    facing: Array  # (N,): cosine of the angle between the ray and the surface's normal


@dataclass(frozen=True, eq=False)
class Surface:
    """Pixels of a vehicle's surface."""

    pixels: Array  # (N, 3): linear RGB
    weight: Array  # (N,): how much each says about the paint
    facing: Array  # (N,): cosines of the angles at which it is seen
    height_px: float  # of the whole vehicle in the picture


def hit_vehicle(category: str, size_m: Array, origin: Array, rays: Array) -> Hits:
    """Intersect rays with a vehicle.

    `category`: {"car", "truck", "bus"}. `size_m`: (3,). `origin`: (3,), m: of the rays, in the frame of the box (origin
    at its center, x to the front). `rays`: (N, 3): directions in that frame.
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

    A block around the origin of the rays is not entered.
    """
    # By axis: reductions over rows of three take many times as long.
    near, far = zip(*(cross_slab(origin[k], rays[:, k], low[k], high[k]) for k in range(3)))
    entry, leave = np.fmax(np.fmax(near[0], near[1]), near[2]), np.fmin(np.fmin(far[0], far[1]), far[2])
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
