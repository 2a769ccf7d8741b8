"""Random people, riders and what they push, made of convex polytopes; sizes by DIN 33402-2, children from the age of four."""

from __future__ import annotations

import numpy as np

from log2sim.synth.polytopes import Material, Polytope, Shape, box, ellipsoid, prism, wheel


def _torso(rng: np.random.Generator, height: float, *, base: float, lean: float, x: float = 0.0) -> list[Polytope]:
    """Make trunk, head and arms of somebody whose hips are at `base`; `lean` tilts the trunk forward by as much in m."""
    girth, depth = height * rng.uniform(0.11, 0.145), height * rng.uniform(0.065, 0.09)
    trunk = 0.3 * height
    top = base + trunk
    parts = [
        prism([(x - depth, base), (x + depth, base), (x + depth + lean, top), (x - depth + lean, top)], 2 * girth, Material.CLOTH, taper=-0.02),
        ellipsoid((0.085, 0.075, 0.115), (x + lean * 1.15 + 0.02, 0, top + 0.155 * height * 0.75), Material.CLOTH),
    ]  # fmt: skip
    for side in (1, -1):
        swing = rng.normal(0, 0.08) + lean * 0.5
        parts.append(
            ellipsoid(
                (0.055 + abs(swing) * 0.6, 0.05, trunk * 0.52),
                (x + swing, side * (girth + 0.04), top - trunk * 0.48),
                Material.CLOTH,
            )
        )
    return parts


def pedestrian(rng: np.random.Generator) -> Shape:
    """Draw a person who stands, walks or sits, some with a bag."""
    height = float(np.clip(rng.normal(1.7, 0.1), 1.45, 2.0)) if rng.random() < 0.85 else rng.uniform(1.0, 1.45)
    stride = rng.choice([0.0, 1.0], p=[0.4, 0.6]) * rng.uniform(0.08, 0.22) * height
    hips = 0.5 * height
    parts = _torso(rng, height, base=hips, lean=rng.uniform(0, 0.1))
    for side in (1, -1):
        x = side * stride
        ankle, hip = ((0.07, 0.1), 0.09) if stride < 0.05 else ((0.08, 0.12), 0.1)
        profile = [(x - ankle[0], 0.0), (x + ankle[1], 0.0), (hip, hips + 0.03), (-hip, hips + 0.03)]
        parts.append(prism(profile, 0.15, Material.CLOTH))
    if rng.random() < 0.25:
        parts.append(box((-0.32, -0.16, hips + 0.05), (-0.1, 0.16, hips + 0.27 * height), Material.CLOTH))
    length = float(np.clip(max(p.high[0] for p in parts) - min(p.low[0] for p in parts), 0.35, 1.1))
    width = float(max(p.high[1] for p in parts) - min(p.low[1] for p in parts))
    return (length, width, height), tuple(parts)


def _two_wheels(reach: float, radius: float, width: float) -> list[Polytope]:
    return [wheel(radius, width, s * reach, 0.0) for s in (1, -1)]


def cyclist(rng: np.random.Generator) -> Shape:
    """Draw a bicycle with its rider."""
    height = rng.normal(1.72, 0.1)
    length, radius = rng.uniform(1.6, 1.9), rng.uniform(0.31, 0.36)
    reach = length / 2 - radius
    seat = rng.uniform(0.85, 1.0)
    lean = rng.uniform(0.1, 0.4)
    parts = _two_wheels(reach, radius, 0.05)
    parts += [
        box((-reach * 0.5, -0.03, 0.45), (reach * 0.8, 0.03, 0.6), Material.METAL),
        box((reach * 0.6, -0.28, seat + 0.05), (reach * 0.75, 0.28, seat + 0.14), Material.METAL),
        prism([(-0.15, 0.3), (0.2, 0.3), (0.15, seat), (-0.3, seat)], 0.36, Material.CLOTH),
        *_torso(rng, height, base=seat, lean=lean, x=-0.2),
    ]
    if rng.random() < 0.2:
        parts.append(box((-reach - 0.25, -0.22, radius * 1.5), (-reach + 0.25, 0.22, radius * 2.4), Material.CLOTH))
    return (length, 0.65, float(max(p.high[2] for p in parts))), tuple(parts)


def motorcycle(rng: np.random.Generator) -> Shape:
    """Draw a motorcycle or scooter, mostly with a rider."""
    length, radius = rng.uniform(1.75, 2.3), rng.uniform(0.26, 0.33)
    reach, seat = length / 2 - radius, rng.uniform(0.7, 0.85)
    parts = _two_wheels(reach, radius, 0.14)
    parts += [
        box((-reach, -0.15, 0.3), (reach * 0.6, 0.15, seat - 0.05), Material.DARK),
        box((-reach * 0.9, -0.14, seat - 0.1), (0.1, 0.14, seat), Material.CLOTH),
        box((0.1, -0.16, seat - 0.15), (reach * 0.6, 0.16, seat + 0.15), Material.PAINT),
        box((reach * 0.6, -0.35, seat + 0.2), (reach * 0.72, 0.35, seat + 0.3), Material.METAL),
    ]
    if rng.random() < 0.4:
        parts.append(
            prism(
                [
                    (reach * 0.5, seat),
                    (reach * 0.9, seat - 0.1),
                    (reach * 0.65, seat + 0.5),
                    (reach * 0.55, seat + 0.5),
                ],
                0.35,
                Material.GLASS,
            )
        )
    if rng.random() < 0.65:
        parts += _torso(rng, rng.normal(1.74, 0.08), base=seat, lean=rng.uniform(0.0, 0.3), x=-0.25)
        parts.append(box((-0.3, -0.3, 0.35), (0.15, 0.3, seat + 0.08), Material.CLOTH))
    return (length, 0.75, float(max(p.high[2] for p in parts))), tuple(parts)


def bicycle(rng: np.random.Generator) -> Shape:
    """Draw a bicycle without a rider."""
    length, radius = rng.uniform(1.6, 1.85), rng.uniform(0.31, 0.36)
    reach = length / 2 - radius
    parts = _two_wheels(reach, radius, 0.05)
    parts += [
        box((-reach * 0.5, -0.03, 0.45), (reach * 0.8, 0.03, 0.6), Material.METAL),
        box((-0.35, -0.08, 0.85), (-0.1, 0.08, 0.93), Material.DARK),
        box((reach * 0.6, -0.28, 0.95), (reach * 0.75, 0.28, 1.03), Material.METAL),
    ]
    return (length, 0.6, 1.05), tuple(parts)


def stroller(rng: np.random.Generator) -> Shape:
    """Draw a stroller or a shopping cart."""
    height = rng.uniform(0.95, 1.1)
    parts = (
        box((-0.35, -0.25, 0.45), (0.35, 0.25, 0.75), Material.CLOTH),
        box((-0.35, -0.25, 0.7), (0.0, 0.25, height), Material.CLOTH),
        *(wheel(0.12, 0.05, sx * 0.32, sy * 0.24) for sx in (1, -1) for sy in (1, -1)),
    )
    return (0.9, 0.55, height), parts
