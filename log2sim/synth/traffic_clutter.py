"""Random things beside the road that are no road users: vegetation, poles, signs, fences, bins, walls, buildings."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from log2sim.synth.polytopes import Material, Polytope, box, column, ellipsoid

Parts = tuple[Polytope, ...]


def tree(rng: np.random.Generator) -> Parts:
    """Draw a tree: a trunk and a crown of several volumes of leaves; some have low branches."""
    radius, crown = rng.uniform(0.08, 0.35), rng.uniform(1.0, 2.8)
    low = rng.uniform(0.8, 3.5)
    parts = [column(radius, (0.0, low + crown), Material.WOOD)]
    for _ in range(rng.integers(1, 4)):
        r = crown * rng.uniform(0.6, 1.0)
        parts.append(
            ellipsoid((r, r, r * rng.uniform(0.7, 1.3)), (*rng.normal(0, 0.3 * crown, 2), low + crown), Material.LEAVES)
        )
    return tuple(parts)


def bush(rng: np.random.Generator) -> Parts:
    """Draw a bush of one to three volumes of leaves."""
    r, h = rng.uniform(0.25, 1.6), rng.uniform(0.4, 2.2)
    return tuple(
        ellipsoid(
            (r * rng.uniform(0.6, 1), r * rng.uniform(0.6, 1), h / 2),
            (*rng.normal(0, 0.4 * r, 2), h * 0.4),
            Material.LEAVES,
        )
        for _ in range(rng.integers(1, 4))
    )


def grass(rng: np.random.Generator) -> Parts:
    """Draw a tuft of tall grass."""
    r, h = rng.uniform(0.4, 2.0), rng.uniform(0.1, 0.45)
    return (ellipsoid((r, r * rng.uniform(0.5, 1), h), (0, 0, 0), Material.LEAVES),)


def pole(rng: np.random.Generator) -> Parts:
    """Draw a post: a bollard, a lamp or a sign with its plate, at heights of people and above."""
    kind = rng.random()
    if kind < 0.25:
        return (column(rng.uniform(0.05, 0.18), (0, rng.uniform(0.5, 1.3)), Material.METAL),)
    height, radius = rng.uniform(1.6, 8.0), rng.uniform(0.03, 0.16)
    parts = [column(radius, (0, height), Material.METAL)]
    if kind < 0.6:
        plate, z = rng.uniform(0.25, 0.6), rng.uniform(1.2, max(1.3, min(height, 3.0)))
        parts.append(box((-0.03, -plate / 2, z), (0.03, plate / 2, z + plate), Material.METAL))
    elif kind < 0.8:
        parts.append(box((-0.2, -0.2, 0), (0.2, 0.2, rng.uniform(0.5, 1.4)), Material.METAL))
    if height > 5 and rng.random() < 0.5:
        parts.append(box((0, -0.1, height - 0.2), (rng.uniform(0.8, 2.5), 0.1, height), Material.METAL))
    return tuple(parts)


def bin_(rng: np.random.Generator) -> Parts:
    """Draw a bin, a crate, a cabinet or a small container."""
    length, w, h = rng.uniform(0.3, 1.5), rng.uniform(0.3, 1.1), rng.uniform(0.5, 1.8)
    parts = [box((-length / 2, -w / 2, 0.05), (length / 2, w / 2, h), Material.PAINT)]
    if rng.random() < 0.4:
        parts.append(box((-length / 2, -w / 2, h), (length * 0.1, w / 2, h + 0.12), Material.DARK))
    return tuple(parts)


def container(rng: np.random.Generator) -> Parts:
    """Draw something as large as a vehicle that is none: a container, a stall, a hut, a heap."""
    length, w, h = rng.uniform(2.0, 7.0), rng.uniform(1.4, 3.0), rng.uniform(1.0, 3.2)
    if rng.random() < 0.25:
        return (ellipsoid((length / 2, w / 2, h / 2), (0, 0, 0.1), Material.GROUND),)
    parts = [box((-length / 2, -w / 2, 0), (length / 2, w / 2, h), Material.WALL)]
    if rng.random() < 0.4:
        parts.append(
            box((-length / 2 - 0.4, -w / 2 - 0.4, h), (length / 2 + 0.4, w / 2 + 0.4, h + 0.15), Material.WALL)
        )
    return tuple(parts)


def bench(rng: np.random.Generator) -> Parts:
    """Draw a bench, a table or a bicycle rack."""
    length = rng.uniform(1.2, 2.2)
    parts = [box((-length / 2, -0.25, 0.4), (length / 2, 0.25, 0.48), Material.WOOD)]
    parts += [box((x - 0.04, -0.2, 0), (x + 0.04, 0.2, 0.45), Material.METAL) for x in (-length * 0.4, length * 0.4)]
    if rng.random() < 0.6:
        parts.append(box((-length / 2, 0.2, 0.5), (length / 2, 0.27, 0.95), Material.WOOD))
    return tuple(parts)


def shelter(rng: np.random.Generator) -> Parts:
    """Draw a bus shelter: glass walls under a roof."""
    length, d, h = rng.uniform(2.5, 5.0), rng.uniform(1.2, 1.8), rng.uniform(2.2, 2.6)
    return (
        box((-length / 2, d / 2 - 0.05, 0.1), (length / 2, d / 2, h), Material.GLASS),
        box((-length / 2, -d / 2, 0.1), (-length / 2 + 0.05, d / 2, h), Material.GLASS),
        box((-length / 2, -d / 2, h), (length / 2, d / 2, h + 0.12), Material.METAL),
        *(column(0.05, (0, h), Material.METAL, at=(x, y)) for x in (-length / 2, length / 2) for y in (-d / 2, d / 2)),
    )


def cone(rng: np.random.Generator) -> Parts:
    """Draw a traffic cone or a barrier board."""
    if rng.random() < 0.5:
        return (column(0.14, (0, rng.uniform(0.4, 0.8)), Material.PAINT),)
    w = rng.uniform(0.8, 2.0)
    feet = tuple(box((-0.2, y - 0.04, 0), (0.2, y + 0.04, 0.9), Material.METAL) for y in (-w * 0.4, w * 0.4))
    return (box((-0.03, -w / 2, 0.6), (0.03, w / 2, 0.95), Material.METAL), *feet)


def fence(length: float, rng: np.random.Generator) -> Parts:
    """Draw a piece of fence, wall, hedge or guard rail along x."""
    kind, half = rng.random(), length / 2
    height = rng.uniform(0.7, 2.2)
    if kind < 0.3:
        t = rng.uniform(0.3, 0.8)
        return (
            box((-half, -t, 0.05), (half, t, height), Material.LEAVES),
            box((-half, -t * 0.4, 0.2), (half, t * 0.4, height * 0.8), Material.LEAVES),
        )
    if kind < 0.5:
        return (box((-half, -rng.uniform(0.08, 0.25), 0), (half, 0.1, height * 0.8), Material.WALL),)
    if kind < 0.65:
        return (
            box((-half, -0.04, 0.5), (half, 0.04, 0.8), Material.METAL),
            *(
                box((x - 0.05, -0.08, 0), (x + 0.05, 0.0, 0.75), Material.METAL)
                for x in np.arange(-half + 0.5, half, 2.0)
            ),
        )
    posts = tuple(column(0.04, (0, height), Material.METAL, at=(x, 0.0)) for x in np.arange(-half, half + 0.1, 2.5))
    return (box((-half, -0.02, 0.1), (half, 0.02, height), Material.MESH), *posts)


def building(length: float, rng: np.random.Generator) -> Parts:
    """Draw a house front along x that faces -y, with windows, a bay or an entrance."""
    half, height, depth = length / 2, rng.uniform(3.5, 16.0), 6.0
    parts = [box((-half, 0, 0), (half, depth, height), Material.WALL)]
    if rng.random() < 0.5:
        x = rng.uniform(-half * 0.6, half * 0.6)
        parts.append(box((x - 0.8, -rng.uniform(0.2, 1.2), 0), (x + 0.8, 0.1, rng.uniform(1.0, 3.2)), Material.WALL))
    parts += [
        box((x - 0.6, -0.02, 1.0), (x + 0.6, 0.1, 2.3), Material.GLASS) for x in np.arange(-half + 1.5, half - 1, 3.2)
    ][:2]
    if rng.random() < 0.3:
        parts.append(box((-half, -1.5, 2.8), (half, 0.1, 3.0), Material.WALL))
    return tuple(parts)


def own_car(height: float, rng: np.random.Generator) -> Parts:
    """Draw what a LiDAR at a height sees of the car under it: roof, hood and trunk, which hide the ground close by."""
    roof = height - rng.uniform(0.1, 0.4)
    hood = roof - rng.uniform(0.4, 0.7)
    back = rng.uniform(-1.6, -0.8)
    return (
        box((back, -0.65, 0.3), (rng.uniform(0.3, 0.9), 0.65, roof), Material.PAINT),
        box((back - 0.8, -0.9, 0.2), (rng.uniform(1.8, 2.6), 0.9, hood), Material.PAINT),
    )


def stand(rng: np.random.Generator) -> Parts:
    """Draw something slim of a person's height that is none: a meter, a pump, a pillar, a wrapped tree, a hydrant."""
    height, width = rng.uniform(0.7, 2.2), rng.uniform(0.15, 0.5)
    parts = [box((-width / 2, -width * 0.35, 0), (width / 2, width * 0.35, height), Material.METAL)]
    if rng.random() < 0.4:
        top = rng.uniform(0.2, 0.5)
        parts.append(box((-top / 2, -top / 2, height), (top / 2, top / 2, height + top), Material.METAL))
    return tuple(parts)


SMALL: dict[str, tuple[float, float, Callable[[np.random.Generator], Parts]]] = {
    "tree": (0.18, 0.4, tree),
    "bush": (0.2, 0.9, bush),
    "grass": (0.14, 0.3, grass),
    "pole": (0.2, 0.2, pole),
    "stand": (0.08, 0.3, stand),
    "bin": (0.1, 0.8, bin_),
    "container": (0.05, 3.5, container),
    "bench": (0.05, 1.0, bench),
    "shelter": (0.02, 2.5, shelter),
    "cone": (0.04, 0.5, cone),
}
"""By kind: share, radius in m that is to be free around it, and how to draw it."""
