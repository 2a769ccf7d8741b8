"""Where things are in a random traffic scene: lanes, parked rows, sidewalks, and what stands beside the road."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from log2sim.geometry import Array
from log2sim.synth import traffic_clutter as clutter
from log2sim.synth.polytopes import Polytope
from log2sim.synth.traffic import Mount, Road, Surface, TrafficObject
from log2sim.synth.traffic_shapes import ROAD_USERS

REACH_M = 60.0
WALKING_MPS, RIDING_MPS = 1.4, 5.0
# Shares of what drives on a lane.
LANE_SHARES = {"car": 0.78, "truck": 0.09, "bus": 0.04, "motorcycle": 0.04, "cyclist": 0.05}


@dataclass(eq=False)
class _Layout:
    """Objects so far, with circles that cover what is taken."""

    surface: Surface
    roads: tuple[Road, ...]
    rng: np.random.Generator
    objects: list[TrafficObject] = field(default_factory=list)
    circles: Array = field(default_factory=lambda: np.zeros((0, 3)))

    def is_free(self, circles: Array, margin: float = 0.0) -> bool:
        """Decide whether circles (K, 3: x, y, radius) meet none that is taken."""
        dx, dy = (circles[:, None, axis] - self.circles[:, axis] for axis in range(2))
        reach = circles[:, None, 2] + self.circles[:, 2] + margin
        return not bool(((dx * dx + dy * dy <= reach * reach) & (reach > 0)).any())

    def take(self, circles: Array) -> None:
        """Mark circles (K, 3) as taken."""
        self.circles = np.concatenate([self.circles, circles])

    def on_road(self, xy: Array) -> bool:
        """Decide whether a position is on a carriageway."""
        x, y = xy[:1].astype(np.float32), xy[1:].astype(np.float32)
        return any(abs(float(road.offset(x, y)[0])) < road.half_width_m for road in self.roads)

    def add_user(
        self, category: str, xy: Array, yaw: float, *, speed: float = 0.0, turn: float = 0.0, margin: float = 0.4
    ) -> bool:
        """Add a road user where its place is free."""
        size, parts = ROAD_USERS[category](self.rng)
        circles = _covering(xy, yaw, size)
        if not self.is_free(circles, margin):
            return False
        self.take(circles)
        self.objects.append(
            TrafficObject(category, np.append(xy, self.surface.elevation(xy)), yaw, size, parts, speed, turn)
        )
        return True

    def add_thing(self, kind: str, xy: Array, yaw: float, parts: tuple[Polytope, ...], radius: float = 0.0) -> bool:
        """Add clutter; with a radius only where its place is free."""
        circle = np.array([[*xy, radius]])
        if radius and not self.is_free(circle):
            return False
        if radius:
            self.take(circle)
        low, high = np.min([p.low for p in parts], axis=0), np.max([p.high for p in parts], axis=0)
        size = (float(high[0] - low[0]), float(high[1] - low[1]), float(high[2]))
        self.objects.append(TrafficObject("", np.append(xy, self.surface.elevation(xy)), yaw, size, parts, kind=kind))
        return True


def _covering(xy: Array, yaw: float, size: tuple[float, float, float]) -> Array:
    """Cover a box by circles (K, 3) along its length."""
    length, width, _ = size
    if length <= 1.5 * width:
        return np.array([[*xy, max(length, width) / 2]])
    along = np.linspace(-(length - width) / 2, (length - width) / 2, max(2, int(length / max(width, 0.8)) + 1))
    direction = np.array([np.cos(yaw), np.sin(yaw)])
    return np.column_stack([xy + along[:, None] * direction, np.full(len(along), width / 2)])


def draw_layout(
    mount: Mount, roads: tuple[Road, ...], surface: Surface, rng: np.random.Generator
) -> list[TrafficObject]:
    """Draw the objects of a scene."""
    out = _Layout(surface, roads, rng)
    # The place of the sensor's own car, or of its pole.
    out.take(np.array([[0.0, 0.0, 0.5 if mount == "roadside" else 2.4]]))
    for road in roads:
        _traffic(out, road)
    _parked(out, roads[0])
    if rng.random() < 0.3:
        _car_park(out, roads[0])
    for road in roads[: 1 + (rng.random() < 0.5)]:
        _people(out, road)
        _roadside(out, road)
        _fronts(out, road)
    return out.objects


def _traffic(out: _Layout, road: Road) -> None:
    """Fill the lanes: free flow, or a queue that stands."""
    rng = out.rng
    density, queue = rng.uniform(0.1, 0.85), rng.random() < 0.25
    kinds, shares = list(LANE_SHARES), np.array(list(LANE_SHARES.values()))
    for lane in range(road.lanes):
        d = -road.half_width_m + (lane + 0.5) * 2 * road.half_width_m / road.lanes
        # To the right of the line one drives along it where traffic keeps right.
        along = road.one_way or (d < 0) == road.keeps_right
        speed = 0.0 if queue else float(rng.uniform(2, 18))
        s = -REACH_M + rng.uniform(0, 15)
        while s < REACH_M:
            if rng.random() < density:
                xy, direction = road.at(s, d + rng.normal(0, 0.25))
                yaw = direction + (0.0 if along else np.pi) + rng.normal(0, 0.04)
                turn = speed * road.curvature_per_m * (1 if along else -1)
                if rng.random() < 0.07:
                    yaw += rng.uniform(-0.7, 0.7)
                category = str(rng.choice(kinds, p=shares / shares.sum()))
                standing = rng.random() < 0.15
                out.add_user(category, xy, yaw, speed=0.0 if standing else speed, turn=0.0 if standing else turn)
            s += rng.uniform(5.5, 8) if queue else rng.uniform(6, 20)


def _parked(out: _Layout, road: Road) -> None:
    """Park rows along, across or at an angle beside the carriageway."""
    rng = out.rng
    for side in (-1, 1):
        if rng.random() > 0.45:
            continue
        angle = float(rng.choice([0.0, 0.0, np.pi / 2, np.pi / 3, np.pi / 4]))
        d = road.half_width_m + (rng.uniform(0.85, 1.3) if angle == 0 else rng.uniform(2.3, 3.2))
        fill, s = rng.uniform(0.3, 0.95), -REACH_M * rng.uniform(0.3, 1.0)
        end = REACH_M * rng.uniform(0.3, 1.0)
        while s < end:
            if rng.random() < fill:
                category = str(rng.choice(["car", "truck", "motorcycle"], p=[0.94, 0.035, 0.025]))
                xy, direction = road.at(s, side * d)
                yaw = direction + side * angle + (np.pi if rng.random() < 0.5 else 0.0) + rng.normal(0, 0.03)
                out.add_user(category, xy, yaw, margin=0.1)
            s += (rng.uniform(5.6, 7) if angle == 0 else rng.uniform(2.6, 3.4)) / max(0.7, np.cos(0.0))


def _car_park(out: _Layout, road: Road) -> None:
    """Fill a car park of several rows beside the road."""
    rng = out.rng
    side, start = rng.choice([-1, 1]), rng.uniform(-35, 15)
    rows, places, fill = rng.integers(1, 4), rng.integers(4, 12), rng.uniform(0.3, 1.0)
    angle = float(rng.choice([np.pi / 2, np.pi / 2, 0.0]))
    pitch, aisle = (2.7, 8.0) if angle else (5.8, 6.0)
    for row in range(rows):
        for place in range(places):
            if rng.random() < fill:
                xy, direction = road.at(start + place * pitch, side * (road.half_width_m + 6 + row * aisle))
                if out.on_road(xy):
                    continue
                yaw = direction + angle + np.pi * rng.integers(2) + rng.normal(0, 0.04)
                out.add_user("car" if rng.random() < 0.96 else "truck", xy, yaw, margin=0.1)


def _people(out: _Layout, road: Road) -> None:
    """Put people and riders on the sidewalks, at the kerb and on crossings, alone and in groups."""
    rng, half = out.rng, road.half_width_m
    for _ in range(rng.poisson(4)):
        side = rng.choice([-1, 1])
        xy, direction = road.at(rng.uniform(-35, 35), side * (half + rng.uniform(-1.5, 5)))
        across = rng.random() < 0.3
        yaw = direction + (np.pi / 2 if across else 0.0) + np.pi * rng.integers(2) + rng.normal(0, 0.3)
        out.add_user("pedestrian", xy, yaw, speed=WALKING_MPS * float(rng.random() < 0.6), margin=0.05)
    for _ in range(rng.choice(3, p=[0.55, 0.3, 0.15])):
        middle, direction = road.at(rng.uniform(-30, 30), rng.choice([-1, 1]) * (half + rng.uniform(-3, 4)))
        for _ in range(rng.integers(2, 6)):
            out.add_user("pedestrian", middle + rng.normal(0, 1.0, 2), rng.uniform(-np.pi, np.pi), margin=0.02)
        if rng.random() < 0.3:
            out.add_user("other", middle + rng.normal(0, 1.5, 2), direction, margin=0.05)
    for _ in range(rng.poisson(2.5)):
        xy, direction = road.at(rng.uniform(-35, 35), rng.choice([-1, 1]) * (half + rng.uniform(-1.8, 2.5)))
        yaw = direction + np.pi * rng.integers(2) + rng.normal(0, 0.2)
        out.add_user(
            str(rng.choice(["cyclist", "motorcycle"], p=[0.7, 0.3])),
            xy,
            yaw,
            speed=RIDING_MPS * float(rng.random() < 0.8),
        )
    if rng.random() < 0.3:
        xy, direction = road.at(rng.uniform(-25, 25), rng.choice([-1, 1]) * (half + rng.uniform(0.5, 4)))
        step = np.array([np.cos(direction), np.sin(direction)]) * rng.uniform(0.6, 1.1)
        kind = str(rng.choice(["bicycle", "motorcycle"]))
        for k in range(rng.integers(2, 8)):
            out.add_user(kind, xy + k * step, direction + np.pi / 2 + rng.normal(0, 0.1), margin=-0.3)


def _roadside(out: _Layout, road: Road) -> None:
    """Scatter small clutter beside the road, some kinds in rows."""
    rng, half = out.rng, road.half_width_m
    kinds, shares = list(clutter.SMALL), np.array([v[0] for v in clutter.SMALL.values()])
    for side in (-1, 1):
        if rng.random() < 0.6:
            kind = str(rng.choice(["tree", "pole", "bush"]))
            _, radius, draw = clutter.SMALL[kind]
            step, d = rng.uniform(4, 15), half + rng.uniform(0.4, 3)
            for s in np.arange(-45 + rng.uniform(0, 6), 45, step):
                xy, direction = road.at(s + rng.normal(0, 0.5), side * d)
                if not out.on_road(xy):
                    out.add_thing(kind, xy, direction, draw(rng), radius)
    for _ in range(rng.poisson(rng.choice([16, 26, 45]))):
        kind = str(rng.choice(kinds, p=shares / shares.sum()))
        _, radius, draw = clutter.SMALL[kind]
        d = rng.choice([-1, 1]) * (half + abs(rng.normal(0, 6)) + 0.3)
        xy, direction = road.at(rng.uniform(-42, 42), d)
        if not out.on_road(xy) or kind == "cone":
            yaw = direction + (rng.normal(0, 0.1) if rng.random() < 0.5 else rng.uniform(-np.pi, np.pi))
            out.add_thing(kind, xy, yaw, draw(rng), radius)


def _fronts(out: _Layout, road: Road) -> None:
    """Line the road with houses, fences, hedges and open ground in pieces."""
    rng = out.rng
    for side in (-1, 1):
        edge = road.half_width_m + rng.uniform(2.5, 12)
        style, s = rng.random(), -55.0
        while s < 55:
            length = rng.uniform(4, 14)
            xy, direction = road.at(s + length / 2, side * edge)
            yaw = direction + (0.0 if side > 0 else np.pi)
            clear = out.is_free(_covering(xy, direction, (length, 2.0, 1.0)), 0.3)
            if clear and not out.on_road(xy):
                if style < 0.5 and rng.random() < 0.85:
                    out.add_thing("building", xy, yaw, clutter.building(length, rng))
                elif style < 0.85 and rng.random() < 0.75:
                    out.add_thing("fence", xy, yaw, clutter.fence(length, rng))
            s += length + (rng.uniform(1, 9) if rng.random() < 0.4 else 0.0)
