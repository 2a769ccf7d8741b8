"""Triangle meshes of road users: vehicles, pedestrians and cyclists.

A mesh lives in the agent frame: x forward, y left, z up, origin at the center of its box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.geometry import Array


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh."""

    vertices_m: Array  # (V, 3), m
    normals: Array  # (V, 3): outward unit normals of the vertices
    faces: NDArray[np.int64]  # (F, 3): indices of vertices, counter-clockwise from outside
    part: NDArray[np.int64]  # (F,): material of each face

    def fitted(self, size_m: ArrayLike, low: Array | None = None, high: Array | None = None) -> Mesh:
        """Scale and shift each axis so that the extents `low`..`high` (default: its own) become a centered box."""
        size = np.asarray(size_m, dtype=np.float64)
        low = self.vertices_m.min(0) if low is None else low
        high = self.vertices_m.max(0) if high is None else high
        scale = size / (high - low)
        normals = self.normals / scale
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return Mesh((self.vertices_m - (low + high) / 2) * scale, normals, self.faces, self.part)


def cross_products(a: Array, b: Array) -> Array:
    """Cross products (..., 3), several times faster for small arrays than NumPy's."""
    x = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    y = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    return np.stack([x, y, a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]], -1)


def merged(meshes: Sequence[Mesh]) -> Mesh:
    """Concatenate meshes."""
    offsets = np.cumsum([0, *(len(m.vertices_m) for m in meshes)])
    columns = ((m.vertices_m, m.normals, m.faces + o, m.part) for m, o in zip(meshes, offsets))
    return Mesh(*map(np.concatenate, zip(*columns)))


def surface(vertices: Array, faces: NDArray[np.int64], part: int) -> Mesh:
    """Make a smooth mesh: vertex normals are area-weighted means of the face normals."""
    cross = cross_products(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    solid = np.linalg.norm(cross, axis=1) > 1e-12
    faces, cross = faces[solid], cross[solid]
    corners = faces.T.ravel()
    normals: Array = np.stack([np.bincount(corners, np.tile(c, 3), len(vertices)) for c in cross.T], 1).astype(float)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 0, normals / np.where(length > 0, length, 1.0), [0.0, 0.0, 1.0])
    return Mesh(vertices, normals, faces, np.full(len(faces), part))


def loft(rings: Array, part: int, *, caps: bool = True) -> Mesh:
    """Skin over closed rings (S, K, 3), each counter-clockwise when seen from the far end, with flat ends."""
    s, k = rings.shape[:2]
    i, j = np.meshgrid(np.arange(s - 1), np.arange(k), indexing="ij")
    a, b = (i * k + j).ravel(), (i * k + (j + 1) % k).ravel()
    faces = np.concatenate([np.stack([a, b, b + k], 1), np.stack([a, b + k, a + k], 1)])
    skin = surface(rings.reshape(-1, 3), faces, part)
    if not caps:
        return skin
    return merged([skin, _fan(rings[0][::-1], part), _fan(rings[-1], part)])


def _fan(ring: Array, part: int) -> Mesh:
    vertices = np.concatenate([ring, ring.mean(0, keepdims=True)])
    k = np.arange(len(ring))
    return surface(vertices, np.stack([k, (k + 1) % len(ring), np.full(len(ring), len(ring))], 1), part)


def limb(points: ArrayLike, radii: Sequence[float], part: int, *, count: int = 10) -> Mesh:
    """Make a round-ended tube along points (P, 3) with a radius at each."""
    p = np.asarray(points, dtype=np.float64)
    tangent = np.gradient(p, axis=0) if len(p) > 2 else np.repeat(p[1:] - p[:1], 2, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    angle = np.arange(count) * 2 * np.pi / count
    rings = []
    axis = p[-1] - p[0]
    side = np.array([0.0, 1.0, 0.0]) if abs(axis[1]) < 0.9 * np.linalg.norm(axis) else np.array([1.0, 0.0, 0.0])
    u = cross_products(side, axis)
    u /= np.linalg.norm(u)
    ends = ((0, -1, ((1.0, 0.05), (0.8, 0.6))), (-1, 1, ((0.8, 0.6), (1.0, 0.05))))
    caps = [
        [(p[k] + s * tangent[k] * radii[k] * h, radii[k] * c, tangent[k]) for h, c in steps] for k, s, steps in ends
    ]
    stations = [*caps[0], *((p[i], radii[i], tangent[i]) for i in range(len(p))), *caps[1]]
    for center, radius, axis in stations:
        across = u - axis * np.dot(u, axis)
        across /= np.linalg.norm(across)
        over = cross_products(axis, across)
        rings.append(center + radius * (np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * over))
    return loft(np.array(rings), part, caps=False)


def ellipsoid(center: ArrayLike, radii: ArrayLike, part: int, *, count: int = 14) -> Mesh:
    """Make an ellipsoid with axes along x, y, z."""
    height = np.linspace(-np.pi / 2, np.pi / 2, count // 2 + 2)
    angle = np.arange(count) * 2 * np.pi / count
    c, r = np.asarray(center, dtype=np.float64), np.asarray(radii, dtype=np.float64)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], 1)
    rings = [c + r * (ring * max(np.cos(h), 1e-3) + np.array([0, 0, np.sin(h)])) for h in height]
    return loft(np.array(rings), part, caps=False)


def block(low: ArrayLike, high: ArrayLike, part: int, *, bevel_m: float = 0.0) -> Mesh:
    """Make an upright box with flat sides; `bevel_m` chamfers the upright edges and the upper rim."""
    (x0, y0, z0), (x1, y1, z1) = np.asarray(low, float), np.asarray(high, float)
    if bevel_m <= 0:
        ring = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        sides = [_quad(ring[i], ring[(i + 1) % 4], z0, z1, part) for i in range(4)]
        bottom = np.column_stack([ring, np.full(4, z0)])
        top = np.column_stack([ring, np.full(4, z1)])
        return merged([*sides, _fan(bottom[::-1], part), _fan(top, part)])
    b = bevel_m
    right = [(x0 + b, y0), (x1 - b, y0), (x1, y0 + b), (x1, y1 - b)]
    ring = np.array([*right, (x1 - b, y1), (x0 + b, y1), (x0, y1 - b), (x0, y0 + b)])
    center = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
    inner = center + (ring - center) * (1 - b / np.array([(x1 - x0) / 2, (y1 - y0) / 2]))
    sides = [_quad(ring[i], ring[(i + 1) % 8], z0, z1 - b, part) for i in range(8)]
    rim = loft(np.stack([np.column_stack([ring, np.full(8, z1 - b)]), np.column_stack([inner, np.full(8, z1)])]), part)
    return merged([*sides, rim, _fan(np.column_stack([ring, np.full(8, z0)])[::-1], part)])


def _quad(a: Array, b: Array, z0: float, z1: float, part: int) -> Mesh:
    vertices = np.array([[*a, z0], [*b, z0], [*b, z1], [*a, z1]])
    return surface(vertices, np.array([[0, 1, 2], [0, 2, 3]]), part)


def disc_wheel(center: ArrayLike, radius_m: float, width_m: float, part: int) -> Mesh:
    """Make a wheel with its axle along y."""
    count = 20
    x, y, z = np.asarray(center, dtype=np.float64)
    angle = -np.arange(count) * 2 * np.pi / count
    rings = []
    for side, scale in ((-0.5, 0.93), (-0.38, 1.0), (0.38, 1.0), (0.5, 0.93)):
        reach = radius_m * scale
        ring = [x + reach * np.cos(angle), np.full(count, y + side * width_m), z + reach * np.sin(angle)]
        rings.append(np.stack(ring, 1))
    return loft(np.array(rings), part)


def hoop(center: ArrayLike, radius_m: float, part: int) -> Mesh:
    """Make a thin tire around an axle along y."""
    count, thickness_m, c = 28, 0.026, np.asarray(center, dtype=np.float64)
    angle = -np.arange(count) * 2 * np.pi / count
    out = np.stack([np.cos(angle), np.zeros(count), np.sin(angle)], 1)
    rings = [
        c + out * (radius_m - thickness_m + thickness_m * np.cos(t)) + np.array([0, thickness_m * np.sin(t), 0])
        for t in np.arange(7) * np.pi / 3
    ]
    return loft(np.array(rings), part, caps=False)


class Material(IntEnum):
    """Material of a face; `paint` assigns its colors."""

    CAR_BODY, WHEEL, CAB, CARGO, CHASSIS, BUS_BODY = range(6)
    SKIN, SHIRT, TROUSERS, SHOE, HAIR = range(6, 11)
    FRAME, TIRE, MIRROR = range(11, 14)


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
    at = np.unique(np.concatenate([line[:, 0], np.linspace(-0.47, 0.47, 26)]))
    rings = []
    for u, top in zip(at, np.interp(at, line[:, 0], line[:, 1])):  # in fractions of length, width and height
        end = abs(2 * u)
        half = 0.5 * (1 - 0.16 * end**5 - 0.05 * end**12)
        low = 0.16 + 0.05 * max(0.0, end - 0.8) * 5
        shoulder = min(BELT, top - 0.035)
        roof_half = half * (0.93 - 0.62 * max(0.0, top - shoulder - 0.03))
        lean, rise = 0.93 * half - roof_half, top - shoulder
        side = [
            (0.0, low), (0.8 * half, low), (0.95 * half, low + 0.06), (0.99 * half, min(0.36, shoulder - 0.06)),
            (half, min(0.5, shoulder - 0.04)), (0.985 * half, shoulder - 0.02), (0.95 * half, shoulder),
            (0.93 * half - 0.33 * lean, shoulder + rise * 0.33), (0.93 * half - 0.66 * lean, shoulder + rise * 0.66),
            (roof_half, top - rise * 0.12), (roof_half - 0.035, top - rise * 0.03), (0.5 * roof_half, top),
            (0.0, top + 0.004),
        ]  # fmt: skip
        # Both ends lie in the middle; the one at the top is drawn once, from the right.
        rings.append([(u, y, z) for y, z in side[:-1] + [(-y, z) for y, z in side[:0:-1]]])
    skin = loft(np.array(rings) * [length, width, height], Material.CAR_BODY)
    low, high = [-0.42 * length, -0.36 * width, 0.14 * height], [0.42 * length, 0.36 * width, 0.3 * height]
    floor = block(low, high, Material.CHASSIS)
    hubs = [[s * WHEEL_AT * length, side * (width / 2 - 0.115), WHEEL_RADIUS_M] for s in (-1, 1) for side in (-1, 1)]
    wheels = [disc_wheel(hub, WHEEL_RADIUS_M, 0.22, Material.WHEEL) for hub in hubs]
    mirrors, x, z = [], 0.165 * length, 0.63 * height
    for near, far in ((-width * 0.5, -width * 0.44), (width * 0.44, width * 0.5)):
        mirrors.append(block([x, near, z], [x + 0.12, far, z + 0.13], Material.MIRROR, bevel_m=0.03))
    return merged([skin, floor, *wheels, *mirrors]).fitted(size_m)


def _mirrored(x: float, side: list[tuple[float, float]]) -> list[tuple[float, float, float]]:
    """Ring at x of the outline (y, z) of a left side, up it and down the right one: counter-clockwise from the front."""
    return [(x, y, z) for y, z in side + [(-y, z) for y, z in side[-2:0:-1]]]


def truck_axles(category: str, length_m: float) -> tuple[float, ...]:
    """Axle positions in m along a truck or bus."""
    if category == "bus":
        return -0.26 * length_m, 0.27 * length_m
    front, rear = length_m / 2, -length_m / 2
    return (front - 0.95, rear + 1.1) if length_m < 8 else (front - 0.95, rear + 2.4, rear + 1.2)


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
    hubs = [[x, side * (half - 0.17), radius] for x in truck_axles("truck", length) for side in (-1, 1)]
    parts += [disc_wheel(hub, radius, 0.3, Material.WHEEL) for hub in hubs]
    return merged(parts).fitted(size_m)


def _cab(rear: float, front: float, half: float, low: float, high: float) -> Mesh:
    x = np.array([rear, rear + 0.08, front - 0.45, front - 0.2, front - 0.06, front])
    top = np.array([high - 0.06, high, high, high - 0.08, 0.62 * high, 0.5 * high])
    squeeze = np.array([0.98, 1.0, 1.0, 0.99, 0.98, 0.96])
    rings = []
    for xi, ti, wi in zip(x, top, squeeze):
        h = half * wi
        side = [(0.0, low), (0.96 * h, low), (h, low + 0.08), (h, ti - 0.12), (0.97 * h, ti - 0.04), (0.88 * h, ti)]
        rings.append(_mirrored(xi, [*side, (0.0, ti)]))
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
        side = [(0.0, 0.28), (0.97 * h, 0.28), (h, 0.4), (h, ti - 0.3), (0.97 * h, ti - 0.1), (0.88 * h, ti), (0.0, ti)]
        rings.append(_mirrored(xi, side))
    radius = 0.48
    hubs = [[x, side * (half - 0.165), radius] for x in truck_axles("bus", length) for side in (-1, 1)]
    wheels = [disc_wheel(hub, radius, 0.3, Material.WHEEL) for hub in hubs]
    return merged([loft(np.array(rings), Material.BUS_BODY), *wheels]).fitted(size_m)


# ruff: noqa: RUF005  (`+` adds to points here, it does not join lists)


STRIDE_M = 1.5  # two steps of a walking adult
PEDAL_M = 5.2  # distance that a bicycle covers per turn of the pedals
PHASES = 24
THIGH_M, SHIN_M = 0.44, 0.43
# Height as a fraction from hips to neck, half the width and half the depth in m.
TORSO = (
    (0.0, 0.13, 0.10), (0.08, 0.165, 0.115), (0.3, 0.15, 0.10), (0.55, 0.175, 0.115), (0.78, 0.195, 0.115),
    (0.9, 0.185, 0.10), (0.965, 0.13, 0.08), (1.0, 0.06, 0.06),
)  # fmt: skip


@lru_cache(maxsize=512)
def pedestrian(size_m: tuple[float, float, float], phase: int, standing: bool) -> Mesh:
    """Shape a person on foot at step `phase` of `PHASES`; the box holds the whole gait, whose ends legs reach twice a stride."""
    low, high = _gait_extent(standing)
    return _step(phase, standing).fitted(size_m, low, high)


@lru_cache(maxsize=2 * PHASES)
def _step(phase: int, standing: bool) -> Mesh:
    mesh = _walker(2 * np.pi * phase / PHASES, standing)
    return Mesh(mesh.vertices_m - [0, 0, mesh.vertices_m[:, 2].min()], mesh.normals, mesh.faces, mesh.part)


@lru_cache(maxsize=2)
def _gait_extent(standing: bool) -> tuple[Array, Array]:
    poses = [_step(k, standing).vertices_m for k in range(PHASES)]
    return np.min([p.min(0) for p in poses], axis=0), np.max([p.max(0) for p in poses], axis=0)


def _walker(phase: float, standing: bool) -> Mesh:
    swing = 0.0 if standing else 1.0
    hip_z, shoulder_z = 0.93, 1.43
    parts: list[Mesh] = []
    for side, shift in ((1, 0.0), (-1, np.pi)):
        s = np.sin(phase + shift) * swing
        lift = max(0.0, np.cos(phase + shift)) * swing
        thigh = 0.42 * s + 0.25 * lift
        shin = thigh - 0.10 - 0.75 * lift - 0.18 * max(0.0, -s)
        hip = np.array([0.0, side * 0.095, hip_z])
        knee = hip + 0.44 * np.array([np.sin(thigh), 0, -np.cos(thigh)])
        ankle = knee + 0.42 * np.array([np.sin(shin), 0, -np.cos(shin)])
        toe = ankle + 0.19 * np.array([np.cos(shin + 0.05), 0.0, np.sin(shin + 0.05) - 0.12])
        leg = [hip, (hip + knee) / 2, knee, (knee * 0.6 + ankle * 0.4), ankle]
        parts.append(limb(leg, [0.095, 0.085, 0.062, 0.058, 0.045], Material.TROUSERS))
        parts.append(limb([ankle + [-0.04, 0, -0.03], toe], [0.05, 0.04], Material.SHOE))
        arm = -0.45 * s
        shoulder = np.array([0.0, side * 0.195, shoulder_z])
        elbow = shoulder + 0.29 * np.array([np.sin(arm - 0.06), side * 0.13, -np.cos(arm)])
        wrist = elbow + 0.25 * np.array([np.sin(arm + 0.32), -side * 0.02, -np.cos(arm + 0.32)])
        sleeve = [shoulder, (shoulder + elbow) / 2, elbow, wrist]
        parts.append(limb(sleeve, [0.062, 0.055, 0.047, 0.038], Material.SHIRT))
        parts.append(ellipsoid(wrist + [0.015, 0, -0.05], [0.035, 0.025, 0.06], Material.SKIN, count=8))
    parts.append(_torso(0.02, 0.86, shoulder_z + 0.08))
    parts += _head(np.array([0.03, 0.0, 1.68]))
    return merged(parts)


def _torso(lean: float, low: float, high: float) -> Mesh:
    """Hips to neck as one skin of oval rings; `lean` is the forward shift a meter of height."""
    angle = np.arange(16) * 2 * np.pi / 16
    rings = []
    for f, half_width, half_depth in TORSO:
        z = low + f * (high - low)
        ring = [half_depth * np.cos(angle) + lean * (z - low), half_width * np.sin(angle), np.full(16, z)]
        rings.append(np.stack(ring, 1))
    return loft(np.array(rings), Material.SHIRT)


def _head(center: Array) -> list[Mesh]:
    return [
        limb([center + [-0.03, 0, -0.2], center + [-0.01, 0, -0.08]], [0.055, 0.055], Material.SKIN),
        ellipsoid(center, [0.098, 0.077, 0.12], Material.SKIN),
        ellipsoid(center + [-0.022, 0, 0.025], [0.098, 0.083, 0.112], Material.HAIR),
    ]


@lru_cache(maxsize=256)
def cyclist(size_m: tuple[float, float, float], phase: int) -> Mesh:
    """Shape a bicycle with its rider at `phase` of `PHASES` of a turn of the pedals."""
    return _rider(phase).fitted(size_m)


@lru_cache(maxsize=PHASES)
def _rider(step: int) -> Mesh:
    phase = 2 * np.pi * step / PHASES
    radius = 0.34
    rear, front = np.array([-0.53, 0.0, radius]), np.array([0.53, 0.0, radius])
    crank, seat, head = np.array([-0.08, 0.0, 0.28]), np.array([-0.26, 0.0, 0.92]), np.array([0.38, 0.0, 0.88])
    parts = [hoop(c, radius, Material.TIRE) for c in (rear, front)]
    for hub in (rear, front):
        for k in range(8):
            a = k * np.pi / 8 + phase
            rim = 0.31 * np.array([np.cos(a), 0, np.sin(a)])
            parts.append(limb([hub - rim, hub + rim], [0.005, 0.005], Material.MIRROR, count=4))
        parts.append(limb([hub + [0, -0.04, 0], hub + [0, 0.04, 0]], [0.025, 0.025], Material.TIRE, count=6))
    tubes = ((seat, crank), (crank, head), (seat + [0.02, 0, -0.08], head), (crank, rear), (seat + [0.03, 0, -0.12], rear),
             (head + [0.0, 0, 0.1], front))  # fmt: skip
    parts += [limb([a, b], [0.024, 0.024], Material.FRAME, count=8) for a, b in tubes]
    bar = head + [0.02, 0, 0.13]
    parts.append(limb([bar + [0, -0.27, 0], bar + [0, 0.27, 0]], [0.016, 0.016], Material.TIRE, count=6))
    parts.append(limb([seat + [-0.13, 0, 0.03], seat + [0.12, 0, 0.03]], [0.06, 0.03], Material.TIRE, count=8))
    hip_z = 1.0
    for side, shift in ((1, 0.0), (-1, np.pi)):
        pedal = crank + [0.17 * np.cos(phase + shift), side * 0.11, -0.17 * np.sin(phase + shift)]
        arm = [crank + [0, side * 0.07, 0], pedal + [0, -side * 0.02, 0]]
        parts.append(limb(arm, [0.014, 0.014], Material.MIRROR, count=6))
        hip, ankle = np.array([-0.22, side * 0.09, hip_z]), pedal + [-0.06, 0, 0.1]
        # The knee bends forward between hip and ankle.
        reach = ankle - hip
        distance = min(float(np.linalg.norm(reach)), 0.999 * (THIGH_M + SHIN_M))
        along = (THIGH_M**2 - SHIN_M**2 + distance**2) / (2 * distance)
        off = np.sqrt(max(THIGH_M**2 - along**2, 0.0))
        axis = reach / np.linalg.norm(reach)
        forward = np.array([-axis[2], 0.0, axis[0]])
        knee = np.asarray(hip + axis * along + off * forward / np.linalg.norm(forward))
        leg = [hip, (hip + knee) / 2, knee, (knee * 0.6 + ankle * 0.4), ankle]
        parts.append(limb(leg, [0.10, 0.09, 0.065, 0.06, 0.045], Material.TROUSERS))
        parts.append(limb([ankle + [-0.03, 0, -0.04], pedal + [0.1, 0, 0.03]], [0.048, 0.038], Material.SHOE))
        shoulder = np.array([0.13, side * 0.19, 1.45])
        hand = bar + [0.01, side * 0.23, 0.03]
        elbow = (shoulder + hand) / 2 + [-0.05, side * 0.05, -0.06]
        parts.append(limb([shoulder, elbow, hand], [0.062, 0.05, 0.04], Material.SHIRT))
        parts.append(ellipsoid(hand, [0.05, 0.045, 0.035], Material.SKIN, count=8))
    parts.append(_torso(0.62, 0.95, 1.52))
    torso = parts[-1]
    parts[-1] = Mesh(torso.vertices_m - [0.22, 0, 0], torso.normals, torso.faces, torso.part)
    parts += _head(np.array([0.25, 0.0, 1.68]))
    return merged(parts)
