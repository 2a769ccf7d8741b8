"""Random people and riders made of convex polytopes: all sizes and postures, alone and with what they push, carry or ride.

Each kind of a category has a share and a way to draw it, so that training can leave out some, which are new to its report.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from log2sim.synth.polytopes import Material, Polytope, Shape, block, box, column, ellipsoid, prism, wheel

Rng = np.random.Generator
Kinds = dict[str, tuple[float, Callable[[Rng], Shape]]]
GROUND, PAINT, GLASS, DARK, CLOTH, WALL, LEAVES, METAL, MESH, WOOD = Material


def _torso(
    rng: Rng, height: float, *, base: float, lean: float, x: float = 0.0, reach: float | None = None
) -> list[Polytope]:
    """Make trunk, head and arms of somebody whose hips are at `base`.

    `lean` tilts the trunk forward by as much, and arms that hold something reach forward by `reach`, m.
    """
    girth, depth = height * rng.uniform(0.1, 0.15), height * rng.uniform(0.06, 0.095)
    # Who leans far is lower: trunks do not grow.
    trunk = float(np.sqrt(max((0.3 * height) ** 2 - lean**2, (0.12 * height) ** 2)))
    top = base + trunk
    head = 0.045 * height + 0.03
    parts = [
        prism([(x - depth, base), (x + depth, base), (x + depth + lean, top), (x - depth + lean, top)], 2 * girth, CLOTH, taper=-0.02),
        ellipsoid((head * 0.8, head * 0.7, head), (x + lean * 1.15 + 0.02, 0, top + 0.115 * height), CLOTH),
    ]  # fmt: skip
    for side in (1, -1):
        if reach is None:
            swing = rng.normal(0, 0.08) + lean * 0.5
            radii = (0.055 + abs(swing) * 0.6, 0.05, trunk * 0.52)
            parts.append(ellipsoid(radii, (x + swing, side * (girth + 0.04), top - trunk * 0.48), CLOTH))
        else:
            low, y = top - trunk * rng.uniform(0.3, 0.6), side * (girth + 0.02)
            ends = sorted((x + lean, x + lean + reach))
            parts.append(box((ends[0], y - 0.05, low), (ends[1], y + 0.05, low + 0.12), CLOTH))
    return parts


def _legs(rng: Rng, hips: float, stride: float, spread: float = 0.0) -> list[Polytope]:
    """Make two legs that stand at +-stride along and +-spread across; without a spread they are one silhouette."""
    parts = []
    for side in (1, -1):
        x, wide = side * stride, rng.uniform(0.13, 0.17) * min(1.0, hips / 0.8)
        leg = prism([(x - 0.08, 0.0), (x + 0.12, 0.0), (0.1, hips + 0.03), (-0.1, hips + 0.03)], wide, CLOTH)
        parts.append(shifted(leg, 0.0, side * spread))
    return parts


def shifted(part: Polytope, x: float, y: float) -> Polytope:
    """Move a part along the ground, m."""
    move = np.array([x, y, 0.0])
    offsets = part.offsets + part.normals @ move.astype(np.float32)
    return Polytope(part.normals, offsets.astype(np.float32), part.low + move, part.high + move, part.material)


def _person(parts: list[Polytope], things: list[Polytope] | None = None) -> Shape:
    """Box people in without what they push or hold, which is in their middle's frame too."""
    low, high = np.min([p.low for p in parts], axis=0), np.max([p.high for p in parts], axis=0)
    (x, y), (length, width, _) = (low[:2] + high[:2]) / 2, np.maximum(high - low, [0.35, 0.3, 0.0])
    return (float(length), float(width), float(high[2])), tuple(shifted(p, -x, -y) for p in parts + (things or []))


def _height(rng: Rng) -> float:
    return float(np.clip(rng.normal(1.7, 0.1), 1.45, 2.0))


def _upright(rng: Rng, height: float, *, reach: float | None = None, lean: float | None = None) -> list[Polytope]:
    stride = rng.choice([0.0, rng.uniform(0.06, 0.22)], p=[0.4, 0.6]) * height
    hips = rng.uniform(0.47, 0.53) * height
    lean = float(rng.uniform(0, 0.1) if lean is None else lean)
    return _torso(rng, height, base=hips, lean=lean, reach=reach) + _legs(rng, hips, stride, rng.choice([0.0, 0.09]))


def walking(rng: Rng) -> Shape:
    """Draw somebody who stands or walks, some with hands in front."""
    height = _height(rng)
    return _person(_upright(rng, height, reach=rng.uniform(0.15, 0.4) if rng.random() < 0.25 else None))


def child(rng: Rng) -> Shape:
    """Draw a child of one year to twelve."""
    height = float(rng.uniform(0.75, 1.45))
    return _person(_upright(rng, height))


def coat(rng: Rng) -> Shape:
    """Draw somebody in a coat or skirt that hides the legs."""
    height = _height(rng)
    hips, hem, flare = 0.5 * height, rng.uniform(0.05, 0.5), rng.uniform(0.12, 0.28)
    skirt = prism([(-flare, hem), (flare, hem), (0.14, hips + 0.05), (-0.14, hips + 0.05)], 2 * flare, CLOTH, taper=0.1)
    return _person([*_torso(rng, height, base=hips, lean=0.03), skirt, column(0.1, (0.0, hem + 0.05), CLOTH)])


def bent(rng: Rng) -> Shape:
    """Draw somebody who bends down, squats or kneels."""
    height, low = _height(rng), rng.random() < 0.5
    hips = height * (rng.uniform(0.16, 0.3) if low else rng.uniform(0.46, 0.52))
    lean = height * (rng.uniform(0.02, 0.2) if low else rng.uniform(0.18, 0.29))
    parts = _torso(rng, height, base=hips, lean=lean, reach=rng.uniform(0.1, 0.4))
    if low:
        parts.append(box((-0.2, -0.2, 0.0), (rng.uniform(0.2, 0.45), 0.2, hips + 0.05), CLOTH))
    else:
        parts += _legs(rng, hips, 0.0, 0.1)
    return _person(parts)


def seated(rng: Rng) -> Shape:
    """Draw somebody who sits: on a chair, a bench, a wall or the ground."""
    height = _height(rng)
    seats = [rng.uniform(0.02, 0.1), rng.uniform(0.38, 0.5), rng.uniform(0.5, 0.75)]
    seat, knee = float(rng.choice(seats, p=[0.1, 0.75, 0.15])), rng.uniform(0.4, 0.52)
    lean = rng.uniform(-0.08, 0.25)
    parts = _torso(rng, height, base=seat, lean=lean, x=-0.15, reach=_perhaps(rng, 0.15, 0.4))
    parts += [
        box((-0.2, -0.19, seat), (knee - 0.1, 0.19, seat + 0.16), CLOTH),
        box((knee - 0.22, -0.17, 0.0), (knee - 0.06, 0.17, seat + 0.14), CLOTH),
    ]
    things = []
    if seat > 0.3 and rng.random() < 0.7:
        things = [box((-0.36, -0.24, seat - 0.06), (0.12, 0.24, seat), WOOD)]
        things += [box((x, y - 0.02, 0), (x + 0.04, y + 0.02, seat), METAL) for x in (-0.34, 0.08) for y in (-0.2, 0.2)]
        if rng.random() < 0.7:
            things.append(box((-0.38, -0.23, seat), (-0.33, 0.23, seat + rng.uniform(0.35, 0.5)), WOOD))
    return _person(parts, things)


def laden(rng: Rng) -> Shape:
    """Draw somebody with a backpack, a shoulder bag, shopping bags or a box in front of the chest."""
    height = _height(rng)
    hips, kind = 0.5 * height, rng.integers(4)
    parts = _upright(rng, height, reach=0.4 if kind == 3 else None)
    if kind == 0:
        parts.append(box((-0.38, -0.18, hips + 0.05), (-0.08, 0.18, hips + 0.3 * height), CLOTH))
    elif kind == 1:
        y = rng.choice([-1, 1]) * rng.uniform(0.26, 0.34)
        parts.append(box((-0.22, y - 0.09, hips - 0.15), (0.22, y + 0.09, hips + 0.25), CLOTH))
    elif kind == 2:
        sides = ((-0.33,), (0.33,), (-0.33, 0.33))[rng.integers(3)]
        parts += [box((-0.17, y - 0.08, 0.15), (0.17, y + 0.08, 0.6), CLOTH) for y in sides]
    else:
        front, top = rng.uniform(0.4, 0.6), hips + rng.uniform(0.25, 0.5)
        parts.append(box((0.12, -0.25, hips + 0.05), (front, 0.25, top), WOOD))
    return _person(parts)


def suitcase(rng: Rng) -> Shape:
    """Draw somebody who pulls a suitcase or a trolley."""
    height, back, y = _height(rng), rng.uniform(0.5, 0.8), rng.choice([-0.25, 0.25])
    case = [box((-back - 0.2, y - 0.2, 0.05), (-back + 0.1, y + 0.2, rng.uniform(0.5, 0.8)), CLOTH)]
    case.append(box((-back, y - 0.02, 0.5), (-back + 0.05, y + 0.02, 1.0), METAL))
    return _person(_upright(rng, height), case)


def cart(rng: Rng) -> Shape:
    """Draw somebody who pushes a shopping cart, a hand cart with goods or a wheelbarrow."""
    height, start = _height(rng), rng.uniform(0.4, 0.6)
    end, w, low = start + rng.uniform(0.6, 1.5), rng.uniform(0.24, 0.45), rng.uniform(0.2, 0.5)
    top = low + rng.uniform(0.3, 1.0)
    mesh = MESH if rng.random() < 0.4 else WOOD
    things = [box((start, -w, low), (end, w, top), mesh), box((start - 0.1, -w, 0.9), (start, w, 0.96), METAL)]
    radius = rng.uniform(0.07, low * 0.8)
    things += [wheel(radius, 0.05, x, y) for x in (start + 0.15, end - 0.15) for y in (-w, w)]
    return _person(_upright(rng, height, reach=start, lean=rng.uniform(0.05, 0.3)), things)


def pram(rng: Rng) -> Shape:
    """Draw somebody who pushes a pram."""
    height, start = _height(rng), rng.uniform(0.45, 0.6)
    hood, radius = rng.uniform(0.9, 1.1), rng.uniform(0.1, 0.2)
    things = [
        box((start, -0.24, 0.45), (start + 0.75, 0.24, 0.7), CLOTH),
        box((start + 0.4, -0.24, 0.65), (start + 0.75, 0.24, hood), CLOTH),
        box((start - 0.1, -0.25, 0.95), (start, 0.25, 1.0), METAL),
        *(wheel(radius, 0.05, x, y) for x in (start + 0.1, start + 0.65) for y in (-0.26, 0.26)),
    ]
    return _person(_upright(rng, height, reach=start), things)


def dog(rng: Rng) -> Shape:
    """Draw somebody with a dog on a leash."""
    height, x, y = _height(rng), rng.uniform(-0.6, 1.2), rng.choice([-1, 1]) * rng.uniform(0.4, 0.9)
    tall = rng.uniform(0.25, 0.7)
    length, wide, front = tall * rng.uniform(0.6, 0.8), tall * 0.12, tall * 0.35
    things = [block(x, y, length, tall * 0.18, (tall * 0.5, tall), CLOTH)]
    things += [block(x + s * length * 0.85, y, 0.04, tall * 0.15, (0.0, tall * 0.6), CLOTH) for s in (1, -1)]
    things.append(box((x + length, y - wide, tall * 0.8), (x + length + front, y + wide, tall * 1.15), CLOTH))
    return _person(_upright(rng, height), things)


def wheelchair(rng: Rng) -> Shape:
    """Draw somebody in a wheelchair."""
    size, parts = seated(rng)
    things = [wheel(0.3, 0.05, -0.05, s * 0.32) for s in (1, -1)] + [wheel(0.09, 0.04, 0.35, s * 0.25) for s in (1, -1)]
    return (size[0], max(size[1], 0.66), size[2]), (*parts, *things)


def umbrella(rng: Rng) -> Shape:
    """Draw somebody under an umbrella."""
    height, radius = _height(rng), rng.uniform(0.45, 0.65)
    shade = ellipsoid((radius, radius, 0.15), (0.1, 0.1, height + 0.2), CLOTH)
    return _person(_upright(rng, height), [shade, column(0.015, (1.1, height + 0.2), METAL, at=(0.15, 0.1))])


def _bicycle(rng: Rng, length: float, radius: float) -> list[Polytope]:
    """Make a bicycle of thin wheels, a frame of some bars, a saddle and a handlebar."""
    reach, seat = length / 2 - radius, rng.uniform(0.8, 1.0) * min(1.0, length / 1.6)
    bar = seat + rng.uniform(0.0, 0.2)
    parts = [wheel(radius, 0.05, s * reach, 0.0) for s in (1, -1)]
    parts += [
        prism([(-0.1, 0.25), (0.0, 0.25), (reach * 0.75, seat - 0.2), (reach * 0.7, seat - 0.12)], 0.04, METAL),
        box((-0.25, -0.02, seat - 0.2), (reach * 0.7, 0.02, seat - 0.15), METAL),
        prism([(-0.05, 0.25), (0.0, 0.25), (-0.15, seat), (-0.25, seat)], 0.04, METAL),
        box((-0.35, -0.08, seat - 0.04), (-0.1, 0.08, seat + 0.04), DARK),
        box((reach * 0.62, -0.28, bar), (reach * 0.74, 0.28, bar + 0.07), METAL),
    ]
    if rng.random() < 0.3:
        parts.append(block(-reach, 0.0, 0.2, 0.17, (radius * 2, radius * 2 + rng.uniform(0.05, 0.35)), CLOTH))
    if rng.random() < 0.25:
        parts.append(box((reach * 0.75, -0.2, seat - 0.1), (reach * 0.75 + 0.3, 0.2, seat + 0.15), MESH))
    return parts


def pushed_bicycle(rng: Rng) -> Shape:
    """Draw somebody who walks beside a bicycle."""
    height, y = _height(rng), rng.choice([-1, 1]) * rng.uniform(0.35, 0.5)
    parts = _bicycle(rng, rng.uniform(1.6, 1.85), rng.uniform(0.31, 0.36))
    things = [shifted(p, rng.uniform(0.0, 0.3), y) for p in parts]
    return _person(_upright(rng, height, reach=rng.uniform(0.2, 0.4)), things)


def _rider(rng: Rng, height: float, seat: float, lean: float, foot: float) -> list[Polytope]:
    """Make a rider with two legs down to `foot`, or one silhouette of both."""
    parts = _torso(rng, height, base=seat, lean=lean, x=-0.2, reach=_perhaps(rng, 0.25, 0.5))
    if rng.random() < 0.4:
        wide = rng.uniform(0.3, 0.5)
        return [*parts, prism([(-0.15, foot), (0.2, foot), (0.2, seat), (-0.3, seat + 0.05)], wide, CLOTH)]
    for side, kick in ((1, rng.uniform(-0.1, 0.15)), (-1, rng.uniform(-0.1, 0.15))):
        knee = [(-0.28, seat - 0.05), (0.15 + kick, seat - 0.2), (0.2 + kick, seat - 0.05), (-0.1, seat + 0.1)]
        shin = [(kick / 2, foot), (0.15 + kick / 2, foot), (0.22 + kick, seat - 0.08), (0.08 + kick, seat - 0.08)]
        parts.append(shifted(prism(knee, 0.15, CLOTH), 0.0, side * 0.11))
        parts.append(shifted(prism(shin, 0.12, CLOTH), 0.0, side * 0.12))
    return parts


def _perhaps(rng: Rng, low: float, high: float) -> float | None:
    """Draw how far arms reach; None half of the time."""
    return rng.uniform(low, high) if rng.random() < 0.5 else None


def _ridden(length: float, width: float, parts: list[Polytope]) -> Shape:
    return (length, width, float(max(p.high[2] for p in parts))), tuple(parts)


def city_cyclist(rng: Rng, *, scale: float = 1.0, lean: tuple[float, float] = (0.0, 0.25)) -> Shape:
    """Draw a bicycle with its rider."""
    length, radius = rng.uniform(1.6, 1.9) * scale, rng.uniform(0.31, 0.36) * scale
    height, seat = rng.normal(1.72, 0.1) * scale, rng.uniform(0.85, 1.0) * scale
    parts = _bicycle(rng, length, radius)
    parts += _rider(rng, height, seat, rng.uniform(*lean) * scale, rng.uniform(0.1, 0.35) * scale)
    if rng.random() < 0.25:
        parts.append(box((-0.5, -0.18, seat + 0.1), (-0.25, 0.18, seat + 0.5), CLOTH))
    return _ridden(length, 0.65, parts)


def cargo_cyclist(rng: Rng) -> Shape:
    """Draw a cargo bicycle: a box before its rider, between the wheels or on two front wheels."""
    length, radius = rng.uniform(2.2, 2.7), 0.3
    reach, w = length / 2 - radius, rng.uniform(0.25, 0.42)
    parts = [shifted(p, -length / 2 + 0.7, 0.0) for p in _rider(rng, rng.normal(1.72, 0.1), 0.9, 0.05, 0.2)]
    parts.append(wheel(radius, 0.05, -reach, 0.0))
    parts += [wheel(0.25, 0.05, reach, y) for y in ((-w, w) if rng.random() < 0.5 else (0.0,))]
    parts.append(box((0.0, -w, 0.25), (reach, w, rng.uniform(0.7, 1.1)), WOOD))
    parts.append(box((-reach, -0.03, 0.35), (0.0, 0.03, 0.5), METAL))
    return _ridden(length, 2 * w, parts)


def child_trailer(rng: Rng) -> Shape:
    """Draw a cyclist who pulls a trailer; the box is the bicycle's."""
    (length, width, height), parts = city_cyclist(rng)
    back = -length / 2 - rng.uniform(0.1, 0.3)
    things = [prism([(back - 1.0, 0.25), (back, 0.25), (back - 0.2, 0.9), (back - 0.9, 0.95)], 0.7, CLOTH)]
    return (length, width, height), (*parts, *things, *(wheel(0.25, 0.05, back - 0.6, y) for y in (-0.4, 0.4)))


def _motorcycle(rng: Rng, *, scooter: bool) -> tuple[float, float, list[Polytope]]:
    """Make length, height of the seat and parts of a motorcycle or scooter without a rider."""
    lengths, radii = ((1.7, 1.95), (0.2, 0.27)) if scooter else ((1.9, 2.3), (0.27, 0.33))
    length, radius = rng.uniform(*lengths), rng.uniform(*radii)
    reach, seat = length / 2 - radius, rng.uniform(0.7, 0.85)
    parts = [wheel(radius, 0.14, s * reach, 0.0) for s in (1, -1)]
    parts += [
        box((-reach * 0.95, -0.14, seat - 0.1), (0.1, 0.14, seat), CLOTH),
        box((reach * 0.55, -0.35, seat + 0.2), (reach * 0.7, 0.35, seat + 0.3), METAL),
    ]
    if scooter:
        apron = [(reach * 0.55, 0.2), (reach * 0.85, 0.35), (reach * 0.7, seat + 0.2), (reach * 0.55, seat + 0.2)]
        parts += [
            box((-reach, -0.18, 0.25), (-0.05, 0.18, seat - 0.05), PAINT),
            box((-0.1, -0.16, 0.18), (reach * 0.6, 0.16, 0.26), DARK),
            prism(apron, 0.4, PAINT),
        ]
    else:
        parts += [
            box((-reach, -0.15, 0.3), (reach * 0.6, 0.15, seat - 0.05), DARK),
            box((0.1, -0.16, seat - 0.15), (reach * 0.6, 0.16, seat + 0.15), PAINT),
        ]
    if rng.random() < 0.4:
        top = seat + 0.5
        screen = [(reach * 0.5, seat), (reach * 0.9, seat - 0.1), (reach * 0.65, top), (reach * 0.55, top)]
        parts.append(prism(screen, 0.35, GLASS))
    return length, seat, parts


def motorcyclist(rng: Rng, *, scooter: bool = False, pillion: bool = False, boxed: bool = False) -> Shape:
    """Draw a motorcycle or scooter with its rider."""
    length, seat, parts = _motorcycle(rng, scooter=scooter)
    parts += _rider(rng, rng.normal(1.74, 0.08), seat, rng.uniform(0.0, 0.3), 0.3)
    if pillion:
        parts += [shifted(p, -0.38, 0.0) for p in _rider(rng, rng.normal(1.68, 0.1), seat + 0.05, 0.05, 0.3)]
    if boxed:
        parts.append(box((-length / 2 - 0.1, -0.25, seat + 0.05), (-length / 2 + 0.4, 0.25, seat + 0.55), PAINT))
    return _ridden(length, 0.75, parts)


def parked_motorcycle(rng: Rng) -> Shape:
    """Draw a motorcycle or scooter without a rider, some under a cover."""
    length, seat, parts = _motorcycle(rng, scooter=bool(rng.random() < 0.5))
    if rng.random() < 0.1:
        cover = [(-length / 2, 0.1), (length / 2, 0.1), (length * 0.3, seat + 0.3), (-length * 0.4, seat)]
        parts = [prism(cover, 0.6, CLOTH, taper=0.15)]
    return _ridden(length, 0.75, parts)


def bicycle(rng: Rng) -> Shape:
    """Draw a bicycle without a rider."""
    length = rng.uniform(1.4, 1.85)
    return _ridden(length, 0.6, _bicycle(rng, length, rng.uniform(0.19, 0.2) * length))


def kick_scooter(rng: Rng) -> Shape:
    """Draw a kick scooter without a rider."""
    board = box((-0.5, -0.08, 0.08), (0.45, 0.08, 0.14), DARK)
    post, bar = box((0.4, -0.02, 0.1), (0.46, 0.02, 1.1), METAL), box((0.38, -0.22, 1.05), (0.46, 0.22, 1.12), METAL)
    return (1.1, 0.45, 1.15), (board, post, bar, wheel(0.1, 0.05, 0.45, 0.0))


def stroller(rng: Rng) -> Shape:
    """Draw a stroller or a shopping cart that nobody holds."""
    height = rng.uniform(0.95, 1.1)
    parts = (box((-0.35, -0.25, 0.45), (0.35, 0.25, 0.75), CLOTH), box((-0.35, -0.25, 0.7), (0.0, 0.25, height), CLOTH))
    wheels = (wheel(0.12, 0.05, sx * 0.32, sy * 0.24) for sx in (1, -1) for sy in (1, -1))
    return (0.9, 0.55, height), (*parts, *wheels)


def animal(rng: Rng) -> Shape:
    """Draw a dog without its owner."""
    tall = rng.uniform(0.3, 0.75)
    length = tall * rng.uniform(0.6, 0.8)
    legs = (block(s * length * 0.85, 0.0, 0.04, tall * 0.15, (0.0, tall * 0.6), CLOTH) for s in (1, -1))
    return (2 * length, tall * 0.4, tall), (block(0.0, 0.0, length, tall * 0.18, (tall * 0.5, tall), CLOTH), *legs)


PEOPLE: Kinds = {
    "walking": (0.42, walking), "child": (0.12, child), "coat": (0.08, coat), "bent": (0.06, bent), "seated": (0.08, seated),
    "laden": (0.08, laden), "cart": (0.025, cart), "pushed bicycle": (0.02, pushed_bicycle), "dog": (0.01, dog),
    "suitcase": (0.02, suitcase), "pram": (0.02, pram), "wheelchair": (0.01, wheelchair), "umbrella": (0.01, umbrella),
}  # fmt: skip
CYCLISTS: Kinds = {
    "upright": (0.55, city_cyclist), "racing": (0.2, partial(city_cyclist, lean=(0.2, 0.42))),
    "child on a bicycle": (0.12, partial(city_cyclist, scale=0.72)), "child trailer": (0.06, child_trailer),
    "cargo bicycle": (0.07, cargo_cyclist),
}  # fmt: skip
MOTORCYCLES: Kinds = {
    "motorcycle": (0.3, motorcyclist), "scooter": (0.3, partial(motorcyclist, scooter=True)), "parked": (0.28, parked_motorcycle),
    "pillion": (0.06, partial(motorcyclist, pillion=True)), "top box": (0.06, partial(motorcyclist, scooter=True, boxed=True)),
}  # fmt: skip
OTHERS: Kinds = {"stroller": (0.5, stroller), "animal": (0.25, animal), "kick scooter": (0.25, kick_scooter)}
