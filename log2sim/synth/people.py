"""Shapes of pedestrians and cyclists, which move their limbs as they go."""

# ruff: noqa: RUF005  (`+` adds to points here, it does not join lists)

from __future__ import annotations

from functools import lru_cache

import numpy as np

from log2sim.geometry import Array
from log2sim.synth.shapes import Mesh, ellipsoid, hoop, limb, loft, merged
from log2sim.synth.vehicles import Material

STRIDE_M = 1.5  # two steps of a walking adult
PEDAL_M = 5.2  # distance that a bicycle covers per turn of the pedals
PHASES = 24
# Height as a fraction from hips to neck, half the width and half the depth in m.
TORSO = (
    (0.0, 0.13, 0.10),
    (0.08, 0.165, 0.115),
    (0.3, 0.15, 0.10),
    (0.55, 0.175, 0.115),
    (0.78, 0.195, 0.115),
    (0.9, 0.185, 0.10),
    (0.965, 0.13, 0.08),
    (1.0, 0.06, 0.06),
)


@lru_cache(maxsize=512)
def pedestrian(size_m: tuple[float, float, float], phase: int, standing: bool) -> Mesh:
    """Shape a person on foot at step `phase` of `PHASES`; the box holds the whole gait, whose ends legs reach twice a stride."""
    low, high = _gait_extent(standing)
    return _step(phase, standing).fitted(size_m, low, high)


@lru_cache(maxsize=2 * PHASES)
def _step(phase: int, standing: bool) -> Mesh:
    return _grounded(_walker(2 * np.pi * phase / PHASES, standing))


@lru_cache(maxsize=2)
def _gait_extent(standing: bool) -> tuple[Array, Array]:
    poses = [_step(k, standing).vertices_m for k in range(PHASES)]
    return np.min([p.min(0) for p in poses], axis=0), np.max([p.max(0) for p in poses], axis=0)


def _grounded(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices_m - [0, 0, mesh.vertices_m[:, 2].min()], mesh.normals, mesh.faces, mesh.part)


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
        parts.append(
            limb(
                [hip, (hip + knee) / 2, knee, (knee * 0.6 + ankle * 0.4), ankle],
                [0.095, 0.085, 0.062, 0.058, 0.045],
                Material.TROUSERS,
            )
        )
        parts.append(limb([ankle + [-0.04, 0, -0.03], toe], [0.05, 0.04], Material.SHOE))
        arm = -0.45 * s
        shoulder = np.array([0.0, side * 0.195, shoulder_z])
        elbow = shoulder + 0.29 * np.array([np.sin(arm - 0.06), side * 0.13, -np.cos(arm)])
        wrist = elbow + 0.25 * np.array([np.sin(arm + 0.32), -side * 0.02, -np.cos(arm + 0.32)])
        parts.append(
            limb([shoulder, (shoulder + elbow) / 2, elbow, wrist], [0.062, 0.055, 0.047, 0.038], Material.SHIRT)
        )
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
    parts = [hoop(c, radius, 0.026, Material.TIRE) for c in (rear, front)]
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
        parts.append(
            limb([crank + [0, side * 0.07, 0], pedal + [0, -side * 0.02, 0]], [0.014, 0.014], Material.MIRROR, count=6)
        )
        hip, ankle = np.array([-0.22, side * 0.09, hip_z]), pedal + [-0.06, 0, 0.1]
        knee = _knee(hip, ankle, 0.44, 0.43)
        parts.append(
            limb(
                [hip, (hip + knee) / 2, knee, (knee * 0.6 + ankle * 0.4), ankle],
                [0.10, 0.09, 0.065, 0.06, 0.045],
                Material.TROUSERS,
            )
        )
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


def _knee(hip: Array, ankle: Array, thigh_m: float, shin_m: float) -> Array:
    """Position of a knee that bends forward between hip and ankle."""
    reach = ankle - hip
    distance = min(float(np.linalg.norm(reach)), 0.999 * (thigh_m + shin_m))
    along = (thigh_m**2 - shin_m**2 + distance**2) / (2 * distance)
    off = np.sqrt(max(thigh_m**2 - along**2, 0.0))
    axis = reach / np.linalg.norm(reach)
    forward = np.array([-axis[2], 0.0, axis[0]])
    return np.asarray(hip + axis * along + off * forward / np.linalg.norm(forward))
