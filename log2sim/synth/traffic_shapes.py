"""Random vehicles and clutter made of convex polytopes; the kinds of road users.

Cars: from microcars (2.7 m) to pick-ups (6.1 m) and delivery vans (6.5 m); widths without mirrors. Trucks and buses up to
Directive 96/53/EC.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from log2sim.synth import traffic_people as people
from log2sim.synth.polytopes import Material, Polytope, Shape, block, box, column, ellipsoid, prism, tube, wheel
from log2sim.synth.traffic_people import Kinds, Rng, shifted

GROUND, PAINT, GLASS, DARK, CLOTH, WALL, LEAVES, METAL, MESH, WOOD = Material


@dataclass(frozen=True)
class _Body:
    """Proportions of a kind of car: sizes as mean and standard deviation in m, the rest as shares."""

    length: tuple[float, float]
    width: tuple[float, float]
    height: tuple[float, float]
    windscreen: tuple[float, float]
    rear: float
    rear_rake_m: float
    taper: float


# Share of the half length from the middle forward to the foot of the windscreen, and backward to the end of the roof.
_CARS = {
    "small": _Body((3.5, 0.2), (1.64, 0.05), (1.5, 0.06), (0.5, 0.68), 0.95, 0.3, 0.2),
    "hatch": _Body((4.15, 0.2), (1.77, 0.05), (1.47, 0.05), (0.4, 0.55), 0.95, 0.4, 0.22),
    "sedan": _Body((4.75, 0.22), (1.84, 0.05), (1.45, 0.04), (0.33, 0.48), 0.72, 0.65, 0.24),
    "wagon": _Body((4.75, 0.18), (1.83, 0.04), (1.49, 0.05), (0.35, 0.5), 0.95, 0.45, 0.22),
    "suv": _Body((4.6, 0.25), (1.88, 0.06), (1.7, 0.08), (0.35, 0.5), 0.96, 0.25, 0.18),
    "large suv": _Body((5.05, 0.2), (1.99, 0.05), (1.84, 0.07), (0.38, 0.52), 0.97, 0.15, 0.14),
    "van": _Body((4.9, 0.25), (1.92, 0.06), (1.95, 0.1), (0.6, 0.78), 0.98, 0.1, 0.1),
    "pickup": _Body((5.6, 0.25), (1.95, 0.06), (1.85, 0.07), (0.38, 0.5), 0.05, 0.15, 0.15),
}
_CAR_SHARES = {
    "small": 0.11, "hatch": 0.2, "sedan": 0.22, "wagon": 0.1, "suv": 0.17, "large suv": 0.08, "van": 0.05, "pickup": 0.07, "delivery": 0.14,
}  # fmt: skip


def car(rng: Rng) -> Shape:
    """Draw a car: a body, a cabin of glass under a solid roof, seats, wheels; one in eight is a delivery van."""
    shares = np.array(list(_CAR_SHARES.values()))
    kind = list(_CAR_SHARES)[rng.choice(len(shares), p=shares / shares.sum())]
    return _delivery_van(rng) if kind == "delivery" else _car(kind, rng)


def _car(kind: str, rng: Rng) -> Shape:
    body = _CARS[kind]
    length, width, height = (rng.normal(*body.length), rng.normal(*body.width), rng.normal(*body.height))
    half, sill = length / 2, rng.uniform(0.15, 0.3)
    belt = height * rng.uniform(0.56, 0.64)
    hood = belt - rng.uniform(0.02, 0.15) * (0.3 if kind == "van" else 1)
    nose = rng.uniform(0.12, 0.35)
    lower = prism(
        [
            (-half + 0.05, sill), (half - 0.12, sill), (half, sill + 0.2), (half, hood - 0.25), (half - nose, hood - 0.06),
            (half * 0.4, belt), (-half + 0.1, belt), (-half, belt - 0.15), (-half, sill + 0.2),
        ],
        width, PAINT, taper=0.02,
    )  # fmt: skip
    front, back = half * rng.uniform(*body.windscreen), half * body.rear
    rake = (height - belt) * rng.uniform(0.9, 1.7) * (0.6 if kind == "van" else 1.0)
    taper, roof = body.taper, height - 0.09
    cabin = [
        prism([(-back, belt - 0.02), (front, belt - 0.02), (front - rake, height - 0.02), (-back + body.rear_rake_m, height - 0.02)],
              width * 0.97, GLASS, taper=taper),
        prism([(-back + 0.85 * body.rear_rake_m, roof), (front - 0.88 * rake, roof), (front - rake, height), (-back + body.rear_rake_m, height)],
              width * 0.97 - 2 * taper * (roof - belt), PAINT, taper=taper),
    ]  # fmt: skip
    seats = box((-back * 0.5, -width * 0.38, belt - 0.1), (front - rake * 0.9, width * 0.38, belt + 0.22), CLOTH)
    pillar = min(back - body.rear_rake_m, half * 0.15)
    pillars = prism(
        [(-pillar - 0.06, belt), (-pillar + 0.06, belt), (-pillar + 0.06, height - 0.03), (-pillar - 0.06, height - 0.03)],
        width * 0.97, PAINT, taper=taper,
    )  # fmt: skip
    parts = [
        lower,
        *cabin,
        seats,
        pillars,
        *_wheels(half * 0.62, width, rng.uniform(0.29, 0.36)),
        box((-half * 0.7, -width * 0.38, 0.14), (half * 0.7, width * 0.38, sill + 0.02), DARK),
    ]
    if kind in ("van", "wagon", "large suv", "suv") and rng.random() < 0.35:
        parts.append(box((-back, -width * 0.36, belt), (-back + 0.25, width * 0.36, height - 0.1), DARK))
    if kind == "pickup":
        parts[0] = prism(
            [(-half * 0.05, sill), (half - 0.12, sill), (half, sill + 0.2), (half, hood - 0.2), (half - nose, hood), (half * 0.4, belt), (-half * 0.05, belt)],
            width, PAINT, taper=0.02,
        )  # fmt: skip
        # The open bed.
        low, high, w = sill + 0.1, belt - 0.08, width / 2
        parts += [
            box((-half, -w, low), (-half * 0.05, -w + 0.1, high), PAINT),
            box((-half, w - 0.1, low), (-half * 0.05, w, high), PAINT),
            box((-half, -w, low), (-half + 0.08, w, high), PAINT),
            box((-half, -w, low), (-half * 0.05, w, low + 0.25), DARK),
        ]
        if rng.random() < 0.25:
            parts.append(box((-half + 0.1, -w + 0.1, low), (-half * 0.2, w - 0.1, high + 0.2), CLOTH))
    return (length, width, height), tuple(parts)


def _wheels(x: float, width: float, radius: float) -> list[Polytope]:
    return [wheel(radius, 0.22, sx * x, sy * (width / 2 - 0.13)) for sx in (1, -1) for sy in (1, -1)]


def _delivery_van(rng: Rng) -> Shape:
    length, width, height = rng.uniform(5.0, 7.4), rng.uniform(1.9, 2.2), rng.uniform(2.1, 3.0)
    half, hood = length / 2, rng.uniform(1.1, 1.3)
    foot = half - rng.uniform(0.6, 1.0)
    top = foot - (height - hood) * rng.uniform(0.4, 0.6)
    lower = [(-half, 0.35), (half - 0.1, 0.3), (half, 0.5), (half, hood - 0.2), (foot, hood), (-half, hood)]
    body = prism(lower, width, PAINT)
    side = [(-half, hood), (foot - 0.9, hood), (top - 0.5, height), (-half + 0.05, height)]
    upper = prism(side, width * 0.99, PAINT, taper=0.04)
    front = [(foot - 1.0, hood), (foot, hood), (top, height), (top - 0.6, height)]
    screen = prism(front, width * 0.97, GLASS, taper=0.06)
    seats = box((foot - 1.2, -width * 0.4, hood - 0.1), (foot - 0.7, width * 0.4, hood + 0.45), CLOTH)
    return (length, width, height), (body, upper, screen, seats, *_wheels(half * 0.6, width, 0.34))


def truck(rng: Rng) -> Shape:
    """Draw a truck: box, flatbed, tipper, tanker, mixer or refuse truck."""
    length, width, height = rng.uniform(5.5, 11.0), rng.uniform(2.1, 2.55), rng.uniform(2.3, 3.9)
    cab, floor = rng.uniform(1.5, 2.2), rng.uniform(0.7, 1.1)
    parts = _cab(length / 2, cab, width * rng.uniform(0.88, 0.98), min(height * rng.uniform(0.75, 1.0), 3.3), rng)
    parts += _load(-length / 2, length / 2 - cab - 0.15, width, floor, height, rng)
    parts += [box((-length * 0.48, -width * 0.25, 0.45), (length * 0.45, width * 0.25, floor + 0.02), DARK)]
    if rng.random() < 0.3:
        # A tail lift, a hopper or a ladder at the back.
        back, w, low, high = -length / 2, width * 0.45, rng.uniform(0.3, 0.8), floor + rng.uniform(0.2, 1.4)
        parts.append(box((back - 0.05, -w, low), (back + 0.3, w, high), METAL))
    axles = (length * 0.36, -length * 0.28, *((-length * 0.4,) if length > 8 else ()))
    parts += [wheel(0.48, 0.3, x, s * (width / 2 - 0.2)) for x in axles for s in (1, -1)]
    return (length, width, float(max(p.high[2] for p in parts))), tuple(parts)


def tractor(rng: Rng) -> Shape:
    """Draw a tractor or a wheel loader: large wheels, a hood, a cab of glass."""
    length, width, height = rng.uniform(3.6, 5.5), rng.uniform(1.8, 2.5), rng.uniform(2.4, 3.2)
    half, w, rear = length / 2, width / 2, rng.uniform(0.65, 0.9)
    parts = [
        box((0.0, -0.4, 0.6), (half - 0.2, 0.4, 1.5), PAINT),
        box((-half + 0.3, -0.7, 0.9), (0.2, 0.7, 1.5), PAINT),
        prism([(-half + 0.5, 1.5), (0.1, 1.5), (-0.1, height - 0.1), (-half + 0.6, height - 0.1)], 1.5, GLASS, taper=0.05),
        box((-half + 0.5, -0.7, height - 0.1), (0.0, 0.7, height), PAINT),
        box((-half + 0.8, -0.3, 1.2), (-half + 1.3, 0.3, 2.1), CLOTH),
    ]  # fmt: skip
    parts += [wheel(rear, 0.45, -half + rear, s * (w - 0.23)) for s in (1, -1)]
    parts += [wheel(rear * rng.uniform(0.55, 1.0), 0.35, half - rear, s * (w - 0.25)) for s in (1, -1)]
    if rng.random() < 0.4:
        parts.append(box((half - 0.3, -w, 0.3), (half, w, 1.1), METAL))
    return (length, width, height), tuple(parts)


def excavator(rng: Rng) -> Shape:
    """Draw an excavator on tracks with its arm before it."""
    width, height, arm = rng.uniform(2.0, 2.8), rng.uniform(2.5, 3.1), rng.uniform(1.5, 3.5)
    back, w = -rng.uniform(1.5, 2.3), width / 2
    parts = [box((back, s * w - 0.25, 0.0), (-back, s * w + 0.25, 0.8), DARK) for s in (0.75, -0.75)]
    parts += [
        box((back - 0.2, -w, 1.0), (0.8, w, 1.9), PAINT),
        box((-0.4, 0.1, 1.9), (1.2, w, height), GLASS),
        prism([(0.8, 1.2), (1.2, 1.2), (arm + 1.0, height + 0.6), (arm + 0.4, height + 0.6)], 0.4, METAL),
        box((arm + 0.5, -0.2, 0.8), (arm + 1.0, 0.2, height + 0.5), METAL),
        box((arm + 0.3, -0.5, 0.1), (arm + 1.1, 0.5, 0.9), METAL),
    ]  # fmt: skip
    return _centered(width, parts)


def forklift(rng: Rng) -> Shape:
    """Draw a forklift."""
    parts = [
        box((-1.2, -0.55, 0.25), (0.6, 0.55, 1.0), PAINT),
        *(box((x - 0.04, y - 0.04, 1.0), (x + 0.04, y + 0.04, 2.1), METAL) for x in (-0.8, 0.5) for y in (-0.5, 0.5)),
        box((-0.85, -0.55, 2.1), (0.55, 0.55, 2.16), METAL),
        box((0.65, -0.4, 0.05), (0.8, 0.4, rng.uniform(2.0, 2.6)), MESH),
        box((0.8, -0.35, 0.08), (1.8, 0.35, 0.14), METAL),
        box((-0.4, -0.25, 1.0), (0.0, 0.25, 1.8), CLOTH),
    ]  # fmt: skip
    return _centered(1.2, parts)


def _centered(width: float, parts: list[Polytope]) -> Shape:
    """Move parts along x so that their middle is that of the object."""
    low, high = min(p.low[0] for p in parts), max(p.high[0] for p in parts)
    moved = tuple(shifted(p, -(low + high) / 2, 0.0) for p in parts)
    return (float(high - low), width, float(max(p.high[2] for p in parts))), moved


def small_trailer(rng: Rng) -> Shape:
    """Draw a trailer of a car: low sides, some with a cover or a boat."""
    length, w, top = rng.uniform(1.8, 4.5), rng.uniform(0.65, 1.1), rng.uniform(0.7, 1.1)
    half = length / 2
    parts = [
        box((-half, -w, 0.4), (half, w, 0.5), METAL),
        box((-half, -w, 0.5), (half, -w + 0.05, top), METAL),
        box((-half, w - 0.05, 0.5), (half, w, top), METAL),
        box((-half, -w, 0.5), (-half + 0.05, w, top), METAL),
        box((half, -0.05, 0.4), (half + 1.0, 0.05, 0.5), METAL),
        *(wheel(0.28, 0.16, 0.0, y) for y in (-w, w)),
    ]
    if rng.random() < 0.5:
        parts.append(box((-half, -w, top), (half, w, top + rng.uniform(0.2, 1.2)), CLOTH))
    return (length, 2 * w, float(max(p.high[2] for p in parts))), tuple(parts)


def caravan(rng: Rng) -> Shape:
    """Draw a caravan."""
    length, width, height = rng.uniform(4.5, 7.5), rng.uniform(2.0, 2.5), rng.uniform(2.4, 2.8)
    half = length / 2
    side = [(-half + 0.2, 0.4), (half - 0.5, 0.4), (half, 1.2), (half - 0.4, height), (-half, height)]
    return (length, width, height), (
        prism(side, width, PAINT),
        box((half - 0.5, -0.05, 0.4), (half + 0.9, 0.05, 0.5), METAL),
        *(wheel(0.33, 0.2, 0.0, s * (width / 2 - 0.1)) for s in (1, -1)),
    )


def _cab(front: float, cab: float, width: float, height: float, rng: Rng) -> list[Polytope]:
    """Make the cab of a truck that ends at `front`; some have a hood."""
    parts, screen = [], height * 0.5
    if rng.random() < 0.3:
        hood = min(1.3, cab * 0.5)
        parts.append(box((front - hood, -width * 0.42, 0.5), (front, width * 0.42, 1.45), PAINT))
        front, cab = front - hood, cab - hood * 0.3
    parts.append(box((front - cab, -width / 2, 0.4), (front, width / 2, screen), PAINT))
    parts.append(
        prism([(front - cab, screen), (front, screen), (front - 0.15, height - 0.12), (front - cab, height - 0.12)],
              width * 0.98, GLASS, taper=0.03)
    )  # fmt: skip
    parts.append(box((front - cab, -width * 0.48, screen), (front - cab + 0.5, width * 0.48, height), PAINT))
    parts.append(box((front - cab, -width * 0.48, height - 0.15), (front - 0.2, width * 0.48, height), PAINT))
    return parts


def _load(back: float, front: float, width: float, floor: float, height: float, rng: Rng) -> list[Polytope]:
    """Make what a truck or trailer carries between two x."""
    w, kind = width / 2, rng.random()
    if kind < 0.6:
        skirt = [box((back + 0.1, -w, rng.uniform(0.2, 0.6)), (front, w, floor), PAINT)] if rng.random() < 0.35 else []
        return [box((back, -w, floor), (front, w, height), PAINT), *skirt]
    bed = [box((back, -w, floor), (front, w, floor + 0.2), METAL)]
    if kind < 0.75:
        wall = rng.uniform(0.4, 1.4)
        return [
            *bed,
            box((back, -w, floor), (front, -w + 0.08, floor + wall), METAL),
            box((back, w - 0.08, floor), (front, w, floor + wall), METAL),
            box((back, -w, floor), (back + 0.08, w, floor + wall), METAL),
            box((front - 0.08, -w, floor), (front, w, floor + wall + 0.3), METAL),
        ]
    if kind < 0.87:
        return [*bed, tube(min(w, (height - floor) / 2), (back, front), floor + min(w, (height - floor) / 2))]
    load = rng.uniform(0.5, 1.0)
    end, top = back + (front - back) * load, floor + rng.uniform(0.6, 1.8)
    cargo = box((back + 0.3, -w * 0.9, floor + 0.2), (end, w * 0.9, top), WOOD)
    return [*bed, cargo, box((front - 0.08, -w, floor), (front, w, floor + 1.2), METAL)]


def semitrailer(rng: Rng) -> Shape:
    """Draw a tractor with its semitrailer."""
    length, width, height = rng.uniform(12.0, 20.0), rng.uniform(2.45, 2.6), rng.uniform(3.2, 4.0)
    half, cab, floor = length / 2, rng.uniform(1.9, 2.4), rng.uniform(1.0, 1.25)
    parts = _cab(half, cab, width * 0.97, rng.uniform(2.8, 3.6), rng)
    parts += _load(-half, half - cab - rng.uniform(0.5, 1.2), width, floor, height, rng)
    parts.append(box((-half + 1, -width * 0.2, 0.6), (half - 0.5, width * 0.2, floor + 0.02), DARK))
    axles = (half - 1.3, half - 4.2, -half + 1.4, -half + 2.7, -half + 4.0)
    parts += [wheel(0.5, 0.32, x, s * (width / 2 - 0.2)) for x in axles for s in (1, -1)]
    return (length, width, float(max(p.high[2] for p in parts))), tuple(parts)


def bus(rng: Rng) -> Shape:
    """Draw a bus or coach; the windows of some are covered."""
    length = rng.choice([rng.uniform(6.5, 9), rng.uniform(10.5, 13), 18.0], p=[0.2, 0.65, 0.15])
    width, height = rng.uniform(2.3, 2.6), rng.uniform(2.8, 3.5)
    half, w, belt = length / 2, width / 2, rng.uniform(1.0, 1.4)
    pane = PAINT if rng.random() < 0.3 else GLASS
    parts = [
        box((-half, -w, 0.3), (half, w, belt), PAINT),
        prism([(-half, belt), (half, belt), (half - 0.15, height - 0.3), (-half + 0.05, height - 0.3)], width * 0.99, pane, taper=0.01),
        box((-half + 0.05, -w * 0.98, height - 0.32), (half - 0.15, w * 0.98, height), PAINT),
        box((-half + 0.05, -w * 0.97, belt), (-half + 0.4, w * 0.97, height - 0.3), PAINT),
        box((-half + 0.6, -w * 0.8, belt - 0.2), (half - 1.5, w * 0.8, belt + 0.35), CLOTH),
    ]  # fmt: skip
    posts = np.arange(-half + 1.8, half - 1, 3.0)
    parts += [block(x, 0.0, 0.08, w * 0.99, (belt, height - 0.3), PAINT) for x in posts]
    parts += [wheel(0.48, 0.3, x, s * (w - 0.18)) for x in (half * 0.6, -half * 0.55) for s in (1, -1)]
    return (length, width, height), tuple(parts)


Parts = tuple[Polytope, ...]


def tree(rng: Rng) -> Parts:
    """Draw a tree: a trunk and a crown of several volumes of leaves; some have low branches."""
    radius, crown = rng.uniform(0.08, 0.35), rng.uniform(1.0, 2.8)
    low = rng.uniform(0.8, 3.5)
    parts = [column(radius, (0.0, low + crown), WOOD)]
    for _ in range(rng.integers(1, 4)):
        r = crown * rng.uniform(0.6, 1.0)
        radii = r, r, r * rng.uniform(0.7, 1.3)
        parts.append(ellipsoid(radii, (*rng.normal(0, 0.3 * crown, 2), low + crown), LEAVES))
    return tuple(parts)


def bush(rng: Rng) -> Parts:
    """Draw a bush of one to three volumes of leaves."""
    r, h = rng.uniform(0.25, 1.6), rng.uniform(0.4, 2.2)
    parts = []
    for _ in range(rng.integers(1, 4)):
        radii = r * rng.uniform(0.6, 1), r * rng.uniform(0.6, 1), h / 2
        parts.append(ellipsoid(radii, (*rng.normal(0, 0.4 * r, 2), h * 0.4), LEAVES))
    return tuple(parts)


def grass(rng: Rng) -> Parts:
    """Draw a tuft of tall grass."""
    r, h = rng.uniform(0.4, 2.0), rng.uniform(0.1, 0.45)
    return (ellipsoid((r, r * rng.uniform(0.5, 1), h), (0, 0, 0), LEAVES),)


def bollard(rng: Rng) -> Parts:
    """Draw a bollard, some with a head or foot that is wider."""
    radius, height = rng.uniform(0.04, 0.18), rng.uniform(0.4, 1.3)
    parts = [column(radius, (0, height), METAL)]
    if rng.random() < 0.4:
        z = rng.choice([0.0, height - 0.25])
        parts.append(column(radius * rng.uniform(1.2, 2.0), (z, z + rng.uniform(0.08, 0.25)), METAL))
    return tuple(parts)


def pole(rng: Rng) -> Parts:
    """Draw a post: a bollard, a lamp or a sign with its plate, at heights of people and above."""
    kind = rng.random()
    if kind < 0.25:
        return bollard(rng)
    height, radius = rng.uniform(1.6, 8.0), rng.uniform(0.03, 0.16)
    parts = [column(radius, (0, height), METAL)]
    if kind < 0.6:
        # A plate; low ones stand on islands.
        plate, z = rng.uniform(0.25, 0.6), rng.uniform(0.5, max(1.3, min(height, 3.0)))
        if rng.random() < 0.5:
            parts.append(box((-0.03, -plate / 2, z), (0.03, plate / 2, z + plate), METAL))
        else:
            parts.append(ellipsoid((0.03, plate / 2, plate / 2), (0, 0, z + plate / 2), METAL))
    elif kind < 0.8:
        parts.append(box((-0.2, -0.2, 0), (0.2, 0.2, rng.uniform(0.5, 1.4)), METAL))
    if height > 5 and rng.random() < 0.5:
        parts.append(box((0, -0.1, height - 0.2), (rng.uniform(0.8, 2.5), 0.1, height), METAL))
    return tuple(parts)


def bin_(rng: Rng) -> Parts:
    """Draw a bin, a crate, a cabinet or a small container."""
    length, w, h = rng.uniform(0.3, 1.5), rng.uniform(0.3, 1.1), rng.uniform(0.5, 1.8)
    parts = [box((-length / 2, -w / 2, 0.05), (length / 2, w / 2, h), PAINT)]
    if rng.random() < 0.4:
        parts.append(box((-length / 2, -w / 2, h), (length * 0.1, w / 2, h + 0.12), DARK))
    return tuple(parts)


def container(rng: Rng) -> Parts:
    """Draw something as large as a vehicle that is none: a container, a stall, a hut, a heap."""
    length, w, h = rng.uniform(2.0, 7.0), rng.uniform(1.4, 3.0), rng.uniform(1.0, 3.2)
    if rng.random() < 0.25:
        return (ellipsoid((length / 2, w / 2, h / 2), (0, 0, 0.1), GROUND),)
    parts = [box((-length / 2, -w / 2, 0), (length / 2, w / 2, h), WALL)]
    if rng.random() < 0.4:
        parts.append(box((-length / 2 - 0.4, -w / 2 - 0.4, h), (length / 2 + 0.4, w / 2 + 0.4, h + 0.15), WALL))
    return tuple(parts)


def bench(rng: Rng) -> Parts:
    """Draw a bench, a table or a bicycle rack."""
    length = rng.uniform(1.2, 2.2)
    parts = [box((-length / 2, -0.25, 0.4), (length / 2, 0.25, 0.48), WOOD)]
    parts += [box((x - 0.04, -0.2, 0), (x + 0.04, 0.2, 0.45), METAL) for x in (-length * 0.4, length * 0.4)]
    if rng.random() < 0.6:
        parts.append(box((-length / 2, 0.2, 0.5), (length / 2, 0.27, 0.95), WOOD))
    return tuple(parts)


def shelter(rng: Rng) -> Parts:
    """Draw a bus shelter: glass walls under a roof."""
    length, d, h = rng.uniform(2.5, 5.0), rng.uniform(1.2, 1.8), rng.uniform(2.2, 2.6)
    return (
        box((-length / 2, d / 2 - 0.05, 0.1), (length / 2, d / 2, h), GLASS),
        box((-length / 2, -d / 2, 0.1), (-length / 2 + 0.05, d / 2, h), GLASS),
        box((-length / 2, -d / 2, h), (length / 2, d / 2, h + 0.12), METAL),
        *(column(0.05, (0, h), METAL, at=(x, y)) for x in (-length / 2, length / 2) for y in (-d / 2, d / 2)),
    )


def cone(rng: Rng) -> Parts:
    """Draw a traffic cone or a barrier board."""
    if rng.random() < 0.5:
        return (column(0.14, (0, rng.uniform(0.4, 0.8)), PAINT),)
    w = rng.uniform(0.8, 2.0)
    feet = tuple(box((-0.2, y - 0.04, 0), (0.2, y + 0.04, 0.9), METAL) for y in (-w * 0.4, w * 0.4))
    return (box((-0.03, -w / 2, 0.6), (0.03, w / 2, 0.95), METAL), *feet)


def fence(length: float, rng: Rng) -> Parts:
    """Draw a piece of fence, wall, hedge or guard rail along x."""
    kind, half = rng.random(), length / 2
    # Walls and hedges are also as high as trucks and buses.
    height = rng.uniform(0.7, 2.2) if rng.random() < 0.5 else rng.uniform(1.8, 4.0)
    if kind < 0.3:
        t, core = rng.uniform(0.3, 0.8), (0.2, height * 0.8)
        return block(0.0, 0.0, half, t, (0.05, height), LEAVES), block(0.0, 0.0, half, t * 0.4, core, LEAVES)
    if kind < 0.6:
        wall = box((-half, -rng.uniform(0.08, 0.25), 0), (half, 0.1, height), WALL)
        if rng.random() < 0.6:
            return (wall,)
        # Climbing plants, shrubs and heaps before it.
        tops = height * rng.uniform(0.2, 1.1, rng.integers(1, 6))
        parts = [wall]
        for x, top in zip(rng.uniform(-half, half, len(tops)), tops):
            radii = rng.uniform(0.3, 1.2), rng.uniform(0.1, 0.6), top / 2
            parts.append(ellipsoid(radii, (x, -rng.uniform(0.1, 0.5), top / 2), LEAVES))
        return tuple(parts)
    if kind < 0.72:
        return (
            box((-half, -0.04, 0.5), (half, 0.04, 0.8), METAL),
            *(box((x - 0.05, -0.08, 0), (x + 0.05, 0.0, 0.75), METAL) for x in np.arange(-half + 0.5, half, 2.0)),
        )
    posts = [column(0.04, (0, height), METAL, at=(x, 0.0)) for x in np.arange(-half, half + 0.1, 2.5)]
    if rng.random() < 0.3:
        # A gate between pillars, one with a letterbox or a bell.
        wide, thick = min(rng.uniform(0.9, 4.0), length) / 2, rng.uniform(0.04, 0.25)
        posts += [block(x, 0.0, thick, thick, (0, height + rng.uniform(-0.2, 0.3)), WALL) for x in (-wide, wide)]
        along, across, top = rng.uniform(0.1, 0.25), rng.uniform(0.05, 0.2), rng.uniform(1.0, 1.6)
        posts.append(block(wide, -thick, along, across, (0.7, top), METAL))
    return (box((-half, -0.02, 0.1), (half, 0.02, height), MESH), *posts)


def building(length: float, entrances: Sequence[float], rng: Rng) -> Parts:
    """Draw a house front along x that faces -y, with windows, bays, pilasters or downpipes, and recesses about the x of entrances."""
    # Garages and sheds are as high as trucks and buses.
    half, height, depth = length / 2, rng.uniform(3.5, 16.0) if rng.random() < 0.75 else rng.uniform(2.0, 3.8), 6.0
    recess = rng.uniform(0.15, 0.8) if rng.random() < 0.7 else rng.uniform(0.8, 2.5)
    parts, edge = [box((-half, recess, 0), (half, depth, height), WALL)], -half
    for x in sorted(entrances):
        wide = rng.uniform(0.4, 0.7) if rng.random() < 0.6 else rng.uniform(0.6, 1.6)
        low, high, top = max(x - wide, edge), min(x + wide, half), min(rng.uniform(1.9, 3.2), height - 0.1)
        if high - low > 0.5:
            parts += [box((edge, 0, 0), (low, recess, height), WALL), box((low, 0, top), (high, recess, height), WALL)]
            parts += _entrance(low, high, recess, top, rng)
            edge = high
    parts.append(box((edge, 0, 0), (half, recess, height), WALL))
    # Wings, bays and porches, as wide and as far out as a side or a rear of a vehicle.
    for x in rng.uniform(-half, half, rng.choice(4, p=[0.5, 0.25, 0.15, 0.1])):
        wide, tall = min(rng.uniform(0.8, 6.0), length) / 2, rng.uniform(1.8, 4.0) if rng.random() < 0.5 else height
        parts.append(box((x - wide, -rng.uniform(0.3, 2.5), 0), (x + wide, 0.1, tall), WALL))
    if not entrances:
        places = np.arange(-half + 1.5, half - 1, 3.2)[:2]
        parts += [box((x - 0.6, -0.02, 1.0), (x + 0.6, 0.1, 2.3), GLASS) for x in places]
        if rng.random() < 0.5:
            x = rng.uniform(-half * 0.6, half * 0.6)
            parts.append(box((x - 0.8, -rng.uniform(0.2, 1.2), 0), (x + 0.8, 0.1, rng.uniform(1.0, 3.2)), WALL))
    if rng.random() < 0.3:
        parts.append(box((-half, -1.5, 2.8), (half, 0.1, 3.0), WALL))
    if rng.random() < 0.4:
        width, out = rng.uniform(0.08, 0.6), rng.uniform(0.06, 0.4)
        for x in rng.uniform(-half, half, rng.integers(1, 5)):
            parts.append(box((x - width / 2, -out, 0), (x + width / 2, 0.1, height), WALL))
    return tuple(parts)


def _entrance(low: float, high: float, recess: float, top: float, rng: Rng) -> list[Polytope]:
    """Draw what fills an opening of a front: steps and a leaf that is ajar, or a window with goods and mannequins behind it."""
    middle, half = (low + high) / 2, (high - low) / 2
    parts: list[Polytope] = []
    if rng.random() < 0.55:
        steps = range(rng.integers(0, 4))
        parts += [box((low - 0.1, -0.3 * (k + 1), 0), (high + 0.1, recess, 0.5 - 0.16 * k), WALL) for k in steps]
        if rng.random() < 0.4:
            at = rng.uniform(0.0, recess)
            parts.append(box((low, at, 0), (middle if rng.random() < 0.5 else high, at + 0.05, top), WOOD))
    else:
        sill = rng.uniform(0.05, 0.9)
        parts += [box((low, 0, 0), (high, recess, sill), WALL), box((low, 0.02, sill), (high, 0.06, top), GLASS)]
    for x in rng.uniform(middle - 0.8 * half, middle + 0.8 * half, rng.integers(0, 4)):
        radius, tall, y = rng.uniform(0.05, 0.3), rng.uniform(0.3, 1.9), rng.uniform(0.3, 1.0) * recess
        parts.append(column(radius, (0.0, tall), WOOD, at=(x, y)))
        if rng.random() < 0.3:
            parts.append(ellipsoid((0.1, 0.1, 0.13), (x, y, tall + 0.15), WOOD))
    return parts


def own_car(height: float, rng: Rng) -> Parts:
    """Draw what a LiDAR at a height sees of the car under it: roof, hood and trunk, which hide the ground close by."""
    roof = height - rng.uniform(0.1, 0.4)
    hood = roof - rng.uniform(0.4, 0.7)
    back = rng.uniform(-1.6, -0.8)
    return (
        box((back, -0.65, 0.3), (rng.uniform(0.3, 0.9), 0.65, roof), PAINT),
        box((back - 0.8, -0.9, 0.2), (rng.uniform(1.8, 2.6), 0.9, hood), PAINT),
    )


def stand(rng: Rng) -> Parts:
    """Draw something slim of a person's height that is none: a meter, a pump, a pillar, a wrapped tree."""
    height, width = rng.uniform(0.7, 2.2), rng.uniform(0.15, 0.5)
    if rng.random() < 0.4:
        parts = [column(width / 2, (0.0, height), METAL)]
    else:
        parts = [box((-width / 2, -width * 0.35, 0), (width / 2, width * 0.35, height), METAL)]
    if rng.random() < 0.4:
        top = rng.uniform(0.2, 0.5)
        parts.append(box((-top / 2, -top / 2, height), (top / 2, top / 2, height + top), METAL))
    return tuple(parts)


def hydrant(rng: Rng) -> Parts:
    """Draw a hydrant."""
    height = rng.uniform(0.6, 1.0)
    arms = box((-0.08, -0.2, height * 0.6), (0.08, 0.2, height * 0.75), METAL)
    return (column(0.12, (0.0, height - 0.1), METAL), ellipsoid((0.12, 0.12, 0.1), (0, 0, height - 0.1), METAL), arms)


def planter(rng: Rng) -> Parts:
    """Draw a plant in a tub."""
    w, h, top = rng.uniform(0.2, 0.6), rng.uniform(0.3, 0.7), rng.uniform(0.2, 0.7)
    leaves = ellipsoid((w * rng.uniform(0.7, 1.3), w * rng.uniform(0.7, 1.3), top), (0, 0, h + top * 0.7), LEAVES)
    return (box((-w, -w * rng.uniform(0.5, 1.0), 0.0), (w, w, h), WALL), leaves)


def railing(rng: Rng) -> Parts:
    """Draw a railing or crowd barrier: bars between posts, or hoops to lean bicycles on."""
    length, height = rng.uniform(1.0, 5.0), rng.uniform(0.8, 1.2)
    places, heights = np.arange(-length / 2, length / 2 + 0.1, rng.uniform(0.7, 1.5)), rng.integers(1, 4)
    posts = (block(x, 0.0, 0.03, 0.03, (0, height), METAL) for x in places)
    bars = (block(0.0, 0.0, length / 2, 0.02, (z - 0.03, z + 0.03), METAL) for z in np.linspace(height, 0.3, heights))
    return (*posts, *bars)


def corner(rng: Rng) -> Parts:
    """Draw the end or corner of a wall, a gate post, a step or a stair's cheek."""
    a, b, t, h = rng.uniform(0.3, 3.0), rng.uniform(0.0, 2.0), rng.uniform(0.12, 0.5), rng.uniform(0.5, 2.6)
    return (box((0, 0, 0), (a, t, h), WALL), box((0, 0, 0), (t, t + b, h * rng.uniform(0.6, 1.0)), WALL))


def sign_board(rng: Rng) -> Parts:
    """Draw a board that stands on the ground: an A-board, a menu, a flag on a stand."""
    w, h, foot = rng.uniform(0.25, 0.5), rng.uniform(0.8, 1.9), rng.uniform(0.1, 0.35)
    return (prism([(-foot, 0.0), (foot, 0.0), (0.03, h), (-0.03, h)], 2 * w, WOOD),)


def letterbox(rng: Rng) -> Parts:
    """Draw a letter box or fuse box on a foot."""
    w, d, low, high = rng.uniform(0.2, 0.4), rng.uniform(0.15, 0.3), rng.uniform(0.4, 0.9), rng.uniform(1.1, 1.7)
    return (box((-d, -w, low), (d, w, high), METAL), column(0.06, (0.0, low), METAL))


def crates(rng: Rng) -> Parts:
    """Draw stacked crates, sacks or parcels."""
    parts: list[Polytope] = []
    for _ in range(rng.integers(1, 5)):
        x, y, w, z = *rng.normal(0, 0.4, 2), rng.uniform(0.15, 0.4), rng.uniform(0.0, 0.6)
        parts.append(block(x, y, w, w * 0.8, (z if parts else 0.0, z + rng.uniform(0.2, 0.8)), WOOD))
    return tuple(parts)


def stall(rng: Rng) -> Parts:
    """Draw a market stall: a table with goods, mostly under a canopy on posts, some with a back or sides of cloth."""
    half, d, h = rng.uniform(0.9, 2.0), rng.uniform(0.4, 0.9), rng.uniform(0.7, 0.95)
    parts = [box((-half, -d, h - 0.08), (half, d, h), WOOD)]
    if rng.random() < 0.6:
        parts.append(box((-half, -d, 0.0), (half, -d + 0.03, h), CLOTH))
    else:
        parts += [block(x, y, 0.03, 0.03, (0.0, h), METAL) for x in (-half * 0.9, half * 0.9) for y in (-d, d)]
    for _ in range(rng.integers(1, 6)):
        x, y, w = rng.uniform(-half, half), rng.uniform(-d, d) * 0.6, rng.uniform(0.1, 0.4)
        parts.append(block(x, y, w, 0.2, (h, h + rng.uniform(0.05, 0.6)), WOOD))
    if rng.random() < 0.8:
        top, over = rng.uniform(1.9, 2.5), d + rng.uniform(0.1, 0.9)
        parts += [column(0.025, (0.0, top), METAL, at=(x, y)) for x in (-half, half) for y in (-over, over)]
        canopy = [(-half - 0.2, top), (half + 0.2, top), (half, top + 0.4), (-half, top + 0.4)]
        parts.append(prism(canopy, 2 * over, CLOTH, taper=rng.uniform(0.0, 1.5)))
        if rng.random() < 0.3:
            parts.append(box((-half, over - 0.03, 0.0), (half, over, top), CLOTH))
    return tuple(parts)


def clothes_rail(rng: Rng) -> Parts:
    """Draw a rail on which clothes hang."""
    half, top = rng.uniform(0.5, 1.0), rng.uniform(1.3, 1.8)
    feet = (block(x, 0.0, 0.02, 0.25, (0.0, 0.05), METAL) for x in (-half, half))
    posts = (column(0.02, (0.0, top), METAL, at=(x, 0.0)) for x in (-half, half))
    hem, end = rng.uniform(0.4, 0.8), half * rng.uniform(0.3, 0.95)
    return (*feet, *posts, box((-half * 0.95, -0.22, hem), (end, 0.22, top - 0.05), CLOTH))


def parasol(rng: Rng) -> Parts:
    """Draw an open or a closed parasol with its foot."""
    top = rng.uniform(2.0, 2.8)
    if rng.random() < 0.3:
        return (column(0.12, (0.9, top), CLOTH), column(0.025, (0.0, top), METAL))
    r = rng.uniform(0.9, 1.8)
    shade, foot = ellipsoid((r, r, 0.25), (0, 0, top), CLOTH), column(0.25, (0.0, 0.12), WALL)
    return shade, column(0.025, (0.0, top), METAL), foot


def table(rng: Rng) -> Parts:
    """Draw a table, some with empty chairs."""
    r, h = rng.uniform(0.3, 0.7), rng.uniform(0.7, 1.1)
    parts = [box((-r, -r, h - 0.05), (r, r, h), WOOD), column(0.06, (0.0, h), METAL)]
    for k in range(rng.integers(0, 4)):
        x, y = np.array([np.cos(k * np.pi / 2), np.sin(k * np.pi / 2)]) * (r + 0.3)
        parts.append(block(x, y, 0.2, 0.2, (0.4, 0.45), WOOD))
        parts.append(block(x * 1.25, y * 1.25, 0.15, 0.15, (0.0, 0.9), MESH))
    return tuple(parts)


SMALL: dict[str, tuple[float, float, Callable[[Rng], Parts]]] = {
    "tree": (0.15, 0.4, tree), "bush": (0.16, 0.9, bush), "grass": (0.1, 0.3, grass), "pole": (0.17, 0.2, pole),
    "stand": (0.08, 0.3, stand), "bin": (0.09, 0.8, bin_), "container": (0.04, 3.5, container),
    "bench": (0.04, 1.0, bench), "shelter": (0.015, 2.5, shelter), "cone": (0.04, 0.5, cone), "hydrant": (0.02, 0.2, hydrant),
    "planter": (0.04, 0.5, planter), "railing": (0.03, 1.0, railing), "corner": (0.03, 1.0, corner), "sign board": (0.02, 0.4, sign_board),
    "letterbox": (0.02, 0.3, letterbox), "crates": (0.03, 0.7, crates), "stall": (0.02, 1.8, stall), "clothes rail": (0.01, 0.9, clothes_rail),
    "parasol": (0.01, 0.3, parasol), "table": (0.02, 0.8, table), "bollard": (0.02, 0.2, bollard),
}  # fmt: skip
"""By kind: share, radius in m that is to be free around it, and how to draw it."""


KINDS: dict[str, Kinds] = {
    "car": {"car": (1.0, car)},
    "truck": {"truck": (0.58, truck), "semitrailer": (0.32, semitrailer), "tractor": (0.05, tractor), "forklift": (0.02, forklift), "excavator": (0.03, excavator)},
    "bus": {"bus": (1.0, bus)}, "motorcycle": people.MOTORCYCLES, "cyclist": people.CYCLISTS,
    "bicycle": {"bicycle": (1.0, people.bicycle)}, "pedestrian": people.PEOPLE, "other": people.OTHERS,
    "seated": {"seated": (1.0, people.seated)}, "parked motorcycle": {"parked": (1.0, people.parked_motorcycle)},
    "trailer": {"small trailer": (0.6, small_trailer), "caravan": (0.4, caravan)},
}  # fmt: skip
"""Kinds of each category of road users, and of people at tables and of what cars pull."""


def draw_user(category: str, rng: Rng, without: Collection[str] = ()) -> tuple[str, Shape]:
    """Draw the kind and the shape of a road user of a category, of other kinds than some."""
    kinds = {kind: entry for kind, entry in KINDS[category].items() if kind not in without} or KINDS[category]
    shares = np.array([share for share, _ in kinds.values()])
    kind = list(kinds)[rng.choice(len(kinds), p=shares / shares.sum())]
    return kind, kinds[kind][1](rng)
