"""Shapes of cars, trucks and buses."""

from __future__ import annotations

from enum import IntEnum
from functools import lru_cache

import numpy as np

from log2sim.geometry import Array
from log2sim.synth.shapes import Mesh, block, disc_wheel, loft, merged


class Material(IntEnum):
    """Material of a face; `paint` assigns its colors."""

    CAR_BODY = 0
    WHEEL = 1
    CAB = 2
    CARGO = 3
    CHASSIS = 4
    BUS_BODY = 5
    SKIN = 6
    SHIRT = 7
    TROUSERS = 8
    SHOE = 9
    HAIR = 10
    FRAME = 11
    TIRE = 12
    MIRROR = 13
    BARK = 14
    LEAVES = 15


# Side view of a sedan and a hatchback: position along the length and height of the top as fractions, rear to front.
SEDAN = ((-0.5, 0.5), (-0.494, 0.62), (-0.47, 0.685), (-0.36, 0.72), (-0.335, 0.735), (-0.17, 0.955), (-0.08, 1.0), (0.03, 0.985),
         (0.08, 0.95), (0.225, 0.685), (0.25, 0.665), (0.40, 0.60), (0.46, 0.55), (0.488, 0.47), (0.5, 0.38))  # fmt: skip
HATCH = ((-0.5, 0.42), (-0.495, 0.6), (-0.485, 0.68), (-0.42, 0.92), (-0.39, 0.965), (-0.2, 1.0), (-0.02, 0.985), (0.05, 0.95),
         (0.215, 0.69), (0.25, 0.665), (0.40, 0.61), (0.46, 0.56), (0.488, 0.47), (0.5, 0.38))  # fmt: skip
WHEEL_AT = 0.3  # axles lie this fraction of the length off the middle
WHEEL_RADIUS_M = 0.33
BELT = 0.64  # height of the window line as a fraction


def roof_line(kind: str) -> Array:
    """Side view (P, 2) of a car: fraction of the length, fraction of the height."""
    return np.array(SEDAN if kind == "sedan" else HATCH)


@lru_cache(maxsize=64)
def car(size_m: tuple[float, float, float], kind: str) -> Mesh:
    """Shape a car: one skin from nose to tail and four wheels."""
    length, width, height = size_m
    line = roof_line(kind)
    u = np.unique(np.concatenate([line[:, 0], np.linspace(-0.47, 0.47, 26)]))
    top = np.interp(u, line[:, 0], line[:, 1])
    rings = np.array([_car_section(ui, ti) for ui, ti in zip(u, top)]) * [length, width, height]
    skin = loft(rings, Material.CAR_BODY)
    floor = block(
        [-0.42 * length, -0.36 * width, 0.14 * height], [0.42 * length, 0.36 * width, 0.3 * height], Material.CHASSIS
    )
    wheels = [
        disc_wheel(
            [s * WHEEL_AT * length, side * (width / 2 - 0.115), WHEEL_RADIUS_M], WHEEL_RADIUS_M, 0.22, Material.WHEEL
        )
        for s in (-1, 1)
        for side in (-1, 1)
    ]
    mirrors = [block(*_mirror(length, width, height, side), Material.MIRROR, bevel_m=0.03) for side in (-1, 1)]
    return merged([skin, floor, *wheels, *mirrors]).fitted(size_m)


def _mirror(length: float, width: float, height: float, side: int) -> tuple[list[float], list[float]]:
    inner, outer = side * width * 0.44, side * width * 0.5
    return (
        [0.165 * length, min(inner, outer), 0.63 * height],
        [0.165 * length + 0.12, max(inner, outer), 0.63 * height + 0.13],
    )


def _car_section(u: float, top: float) -> Array:
    """Ring (K, 3) at fraction `u` of the length, in fractions of length, width and height."""
    end = abs(2 * u)
    half = 0.5 * (1 - 0.16 * end**5 - 0.05 * end**12)
    low = 0.16 + 0.05 * max(0.0, end - 0.8) * 5
    shoulder = min(BELT, top - 0.035)
    roof_half = half * (0.93 - 0.62 * max(0.0, top - shoulder - 0.03))
    side = [
        (0.0, low),
        (0.8 * half, low),
        (0.95 * half, low + 0.06),
        (0.99 * half, min(0.36, shoulder - 0.06)),
        (half, min(0.5, shoulder - 0.04)),
        (0.985 * half, shoulder - 0.02),
        (0.95 * half, shoulder),
        (0.93 * half - 0.33 * (0.93 * half - roof_half), shoulder + (top - shoulder) * 0.33),
        (0.93 * half - 0.66 * (0.93 * half - roof_half), shoulder + (top - shoulder) * 0.66),
        (roof_half, top - (top - shoulder) * 0.12),
        (roof_half - 0.035, top - (top - shoulder) * 0.03),
        (0.5 * roof_half, top),
        (0.0, top + 0.004),
    ]
    # Seen from the front the ring runs counter-clockwise: up the left side (+y), down the right.
    left = side[:-1]
    right = [(-y, z) for y, z in side[:0:-1]]
    return np.array([(u, y, z) for y, z in left + right])


@lru_cache(maxsize=32)
def truck(size_m: tuple[float, float, float]) -> Mesh:
    """Shape a box truck: cab in front, cargo box behind, three axles."""
    length, width, height = size_m
    cab = min(2.1, 0.32 * length)
    front, rear = length / 2, -length / 2
    half = width / 2
    parts = [
        _cab(front - cab, front, 0.92 * half, 0.34, 0.8 * height),
        block([rear, -half, 0.36 * height], [front - cab - 0.15, half, height], Material.CARGO, bevel_m=0.05),
        block([rear + 0.1, -0.3 * width, 0.5], [front - 0.4, 0.3 * width, 0.36 * height + 0.02], Material.CHASSIS),
    ]
    radius = 0.48
    axles = (front - 0.95, rear + 1.1) if length < 8 else (front - 0.95, rear + 2.4, rear + 1.2)
    parts += [
        disc_wheel([x, side * (half - 0.17), radius], radius, 0.3, Material.WHEEL) for x in axles for side in (-1, 1)
    ]
    return merged(parts).fitted(size_m)


def _cab(rear: float, front: float, half: float, low: float, high: float) -> Mesh:
    x = np.array([rear, rear + 0.08, front - 0.45, front - 0.2, front - 0.06, front])
    top = np.array([high - 0.06, high, high, high - 0.08, 0.62 * high, 0.5 * high])
    squeeze = np.array([0.98, 1.0, 1.0, 0.99, 0.98, 0.96])
    rings = []
    for xi, ti, wi in zip(x, top, squeeze):
        h = half * wi
        left = [
            (0.0, low),
            (0.96 * h, low),
            (h, low + 0.08),
            (h, ti - 0.12),
            (0.97 * h, ti - 0.04),
            (0.88 * h, ti),
            (0.0, ti),
        ]
        right = [(-y, z) for y, z in left[-2:0:-1]]
        rings.append([(xi, y, z) for y, z in left + right])
    return loft(np.array(rings), Material.CAB)


@lru_cache(maxsize=32)
def bus(size_m: tuple[float, float, float]) -> Mesh:
    """Shape a city bus: a long box with rounded edges and two axles."""
    length, width, height = size_m
    half = width / 2
    x = np.array([-0.5, -0.492, -0.48, 0.46, 0.485, 0.5]) * length
    squeeze = np.array([0.93, 0.985, 1.0, 1.0, 0.985, 0.93])
    top = np.array([0.95, 0.985, 1.0, 1.0, 0.985, 0.94]) * height
    rings = []
    for xi, wi, ti in zip(x, squeeze, top):
        h = half * wi
        left = [(0.0, 0.28), (0.97 * h, 0.28), (h, 0.4), (h, ti - 0.3), (0.97 * h, ti - 0.1), (0.88 * h, ti), (0.0, ti)]
        right = [(-y, z) for y, z in left[-2:0:-1]]
        rings.append([(xi, y, z) for y, z in left + right])
    radius = 0.48
    wheels = [
        disc_wheel([s * length, side * (half - 0.165), radius], radius, 0.3, Material.WHEEL)
        for s in (-0.26, 0.27)
        for side in (-1, 1)
    ]
    return merged([loft(np.array(rings), Material.BUS_BODY), *wheels]).fitted(size_m)
