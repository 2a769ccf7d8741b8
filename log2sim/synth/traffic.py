"""Random traffic scenes around a LiDAR: roads, road users and clutter, cast into clouds.

A scene is drawn from a seed alone. Roads run at any angle, bend, cross each other and rise; traffic keeps right or left; cars
park along, across and at an angle; people, riders and what is no road user stand beside the road.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from log2sim.geometry import Array, Camera, rotation_from_rpy, transform, wrap_angle
from log2sim.synth import traffic_shapes as clutter
from log2sim.synth.polytope_caster import Returns, SensorState, Solid, cast_polytopes
from log2sim.synth.polytopes import Polytope
from log2sim.synth.returns import LIDAR_MODELS, LidarModel, ReturnModel, lidar_model
from log2sim.synth.scene import Environment
from log2sim.synth.terrain import Road, Surface
from log2sim.synth.traffic_shapes import draw_user, own_car

Mount = Literal["vehicle", "roadside"]


@dataclass(frozen=True, eq=False)
class TrafficObject:
    """A road user or a thing at time 0, the middle of the sweep."""

    category: str  # one of the road users' categories, "" for clutter
    position_m: Array  # (3,), m: middle of its floor, level frame under the sensor
    yaw_rad: float
    size_m: tuple[float, float, float]  # length, width, height, m
    parts: tuple[Polytope, ...]
    speed_mps: float = 0.0  # along the heading
    turn_radps: float = 0.0  # rate of the heading
    kind: str = ""  # what it is more exactly: child, tree, pole, building

    def pose_at(self, t_s: float) -> tuple[Array, float]:
        """Position (3,) of the middle of its floor and heading, on an arc, at a time relative to the middle of the sweep."""
        turn = self.turn_radps * t_s
        # sin(u)/u of half the turn makes the chord of the arc exact, also for no turn at all.
        chord = self.speed_mps * t_s * np.sinc(turn / 2 / np.pi)
        a = self.yaw_rad + turn / 2
        return self.position_m + chord * np.array([np.cos(a), np.sin(a), 0.0]), float(wrap_angle(self.yaw_rad + turn))


@dataclass(frozen=True, eq=False)
class TrafficScene:
    """Everything around a LiDAR; level frame: z up, origin on the ground below the sensor, x forward."""

    mount: Mount  # vehicle or roadside
    roads: tuple[Road, ...]
    surface: Surface
    objects: tuple[TrafficObject, ...]
    lidar: LidarModel
    sensor: SensorState
    returns: ReturnModel
    # (LidarModel, SensorState) or None: another LiDAR that sees the scene too
    second: tuple[LidarModel, SensorState] | None = None

    def cast(self, rng: np.random.Generator) -> Returns:
        """Cast the sweep whose middle is at time 0."""
        solids = []
        for o in self.objects:
            velocity = o.speed_mps * np.array([np.cos(o.yaw_rad), np.sin(o.yaw_rad)])
            # Tinted panes return nearly all.
            passes = float(rng.uniform(0.3, 0.9) if rng.random() < 0.75 else rng.uniform(0.0, 0.3))
            solids.append(Solid(o.parts, o.position_m, o.yaw_rad, velocity, glass_passes=passes))
        one = cast_polytopes(self.lidar, self.sensor, solids, self.surface, rng, self.returns)
        if self.second is None:
            return one
        two = cast_polytopes(*self.second, solids, self.surface, rng, self.returns)
        return Returns.join([one, two])


REACH_M = 60.0
OWN_CAR_M = (4.4, 1.8, 1.5)
# Medians and the standard deviation of logarithms of those who walk (Weidmann 1993: 1.34 m/s, less in groups, more of runners) and ride.
WALKING_MPS, RIDING_MPS, SPEED_SIGMA = 1.34, 4.5, 0.4
# Shares of what stands before a wall.
AT_WALLS = {
    "person": 0.15, "bicycle": 0.12, "motorcycle": 0.13, "stand": 0.2, "bin": 0.15, "pole": 0.1, "planter": 0.05, "corner": 0.07, "sign board": 0.03,
}  # fmt: skip
# Shares of what drives on a lane.
LANE_SHARES = {"car": 0.71, "truck": 0.08, "bus": 0.04, "motorcycle": 0.07, "cyclist": 0.1}


@dataclass(eq=False)
class _Layout:
    """Objects so far, with circles that cover what is taken."""

    surface: Surface
    roads: tuple[Road, ...]
    rng: np.random.Generator
    without: frozenset[str]
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
        self,
        category: str,
        xy: Array,
        yaw: float,
        *,
        speed: float = 0.0,
        turn: float = 0.0,
        margin: float = 0.4,
        kinds: str = "",
    ) -> bool:
        """Add a road user where its place is free, of the category's kinds or of others."""
        without = self.without | {"parked"} if speed else self.without
        kind, (size, parts) = draw_user(kinds or category, self.rng, without)
        circles = _covering(xy, yaw, size)
        if not self.is_free(circles, margin):
            return False
        self.take(circles)
        place = np.append(xy, self.surface.elevation(xy))
        self.objects.append(TrafficObject(category, place, yaw, size, parts, speed, turn, kind))
        return True

    def draw_speed(self, median: float) -> float:
        """Draw how fast somebody walks or rides, m/s."""
        return float(median * np.exp(SPEED_SIGMA * self.rng.spawn(1)[0].normal()))

    def one_of(self, shares: dict[str, float]) -> str:
        """Draw one of some kinds of small things that are not left out; "" where all are."""
        kinds = {kind: share for kind, share in shares.items() if kind not in self.without}
        total = sum(kinds.values())
        return str(self.rng.choice(list(kinds), p=[share / total for share in kinds.values()])) if kinds else ""

    def add_small(self, kind: str, xy: Array, yaw: float, spacing: float = 1.0) -> None:
        """Add a small thing where its place is free."""
        if kind:
            _, radius, draw = clutter.SMALL[kind]
            self.add_thing(kind, xy, yaw, draw(self.rng), spacing * radius)

    def add_thing(self, kind: str, xy: Array, yaw: float, parts: tuple[Polytope, ...], radius: float = 0.0) -> None:
        """Add clutter; with a radius only where its place is free."""
        if radius:
            circle = np.array([[*xy, radius]])
            if not self.is_free(circle):
                return
            self.take(circle)
        low, high = np.min([p.low for p in parts], axis=0), np.max([p.high for p in parts], axis=0)
        size = (float(high[0] - low[0]), float(high[1] - low[1]), float(high[2]))
        self.objects.append(TrafficObject("", np.append(xy, self.surface.elevation(xy)), yaw, size, parts, kind=kind))


def _covering(xy: Array, yaw: float, size: tuple[float, float, float]) -> Array:
    """Cover a box by circles (K, 3) along its length."""
    length, width, _ = size
    if length <= 1.5 * width:
        return np.array([[*xy, max(length, width) / 2]])
    along = np.linspace(-(length - width) / 2, (length - width) / 2, max(2, int(length / max(width, 0.8)) + 1))
    direction = np.array([np.cos(yaw), np.sin(yaw)])
    return np.column_stack([xy + along[:, None] * direction, np.full(len(along), width / 2)])


def draw_layout(
    mount: Mount,
    roads: tuple[Road, ...],
    surface: Surface,
    rng: np.random.Generator,
    forward: float,
    without: frozenset[str],
) -> list[TrafficObject]:
    """Draw the objects of a scene, without some kinds; a sensor's car heads `forward`."""
    out = _Layout(surface, roads, rng, without)
    # The place of the sensor's pole, or of its own car.
    out.take(np.array([[0.0, 0.0, 0.5]]) if mount == "roadside" else _covering(np.zeros(2), forward, OWN_CAR_M))
    if mount == "vehicle" and rng.random() < 0.5:
        _close(out, roads[0])
    for road in roads:
        _traffic(out, road)
    _parked(out, roads[0])
    if rng.random() < 0.3:
        _car_park(out, roads[0])
    for road in roads[: 1 + (rng.random() < 0.5)]:
        if rng.random() < 0.25:
            _market(out, road)
        _people(out, road)
        _roadside(out, road)
        _fronts(out, road)
    return out.objects


def _close(out: _Layout, road: Road) -> None:
    """Put vehicles beside the sensor's car, where one side is seen, and end-on before and behind it, and people and riders who pass it."""
    rng, own = out.rng, float(road.offset(np.zeros(1, np.float32), np.zeros(1, np.float32))[0])
    for beside in (True, False):
        for _ in range(rng.choice(3, p=[0.4, 0.4, 0.2] if beside else [0.1, 0.5, 0.4])):
            category = str(rng.choice(["truck", "bus", "car"], p=[0.5, 0.35, 0.15] if beside else [0.38, 0.32, 0.3]))
            if beside:
                s, d = rng.uniform(-9, 9), rng.choice([-1, 1]) * rng.uniform(2.5, 4.5)
            else:
                s, d = rng.choice([-1, 1], p=[0.3, 0.7]) * rng.uniform(8, 45), rng.normal(0, 1)
            xy, direction = road.at(float(s), own + float(d))
            yaw = direction + np.pi * rng.integers(2) + rng.normal(0, 0.03)
            out.add_user(category, xy, yaw, speed=float(rng.uniform(0, 12) * (rng.random() < 0.6)), margin=0.1)
    for _ in range(rng.poisson(1.5)):
        xy, direction = road.at(rng.uniform(-6, 8), own + rng.choice([-1, 1]) * rng.uniform(1.3, 3))
        category = str(rng.choice(["pedestrian", "cyclist", "motorcycle"], p=[0.5, 0.35, 0.15]))
        yaw = direction + np.pi * rng.integers(2) + rng.normal(0, 0.2)
        median = WALKING_MPS if category == "pedestrian" else RIDING_MPS
        speed = out.draw_speed(median) * float(rng.random() < 0.7)
        out.add_user(category, xy, yaw, speed=speed, margin=0.0)


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
                moves = rng.random() >= 0.15
                placed = out.add_user(category, xy, yaw, speed=speed * moves, turn=turn * moves)
                if placed and category == "car" and rng.random() < 0.04:
                    heading = np.array([np.cos(yaw), np.sin(yaw)])
                    back = (out.objects[-1].size_m[0] / 2 + rng.uniform(2.5, 4.5)) * heading
                    out.add_user("other", xy - back, yaw, speed=speed * moves, margin=0.0, kinds="trailer")
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
            s += rng.uniform(5.6, 7) if angle == 0 else rng.uniform(2.6, 3.4)


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
    """Put people and riders on the sidewalks, at the kerb and on crossings, alone, in rows and in groups."""
    rng, half = out.rng, road.half_width_m
    for _ in range(rng.poisson(rng.choice([2, 5, 12]))):
        side = rng.choice([-1, 1])
        xy, direction = road.at(rng.uniform(-40, 40), side * (half + rng.uniform(-1.5, 5)))
        across = rng.random() < 0.3
        yaw = direction + (np.pi / 2 if across else 0.0) + np.pi * rng.integers(2) + rng.normal(0, 0.3)
        out.add_user("pedestrian", xy, yaw, speed=out.draw_speed(WALKING_MPS) * float(rng.random() < 0.6), margin=0.02)
    for _ in range(rng.choice(3, p=[0.45, 0.35, 0.2])):
        middle, direction = road.at(rng.uniform(-30, 30), rng.choice([-1, 1]) * (half + rng.uniform(-3, 4)))
        spread = rng.uniform(0.4, 1.5)
        for _ in range(rng.integers(2, 9)):
            out.add_user("pedestrian", middle + rng.normal(0, spread, 2), rng.uniform(-np.pi, np.pi), margin=0.0)
        if rng.random() < 0.4:
            out.add_user("other", middle + rng.normal(0, 1.5, 2), direction, margin=0.05)
    if rng.random() < 0.2:
        # A queue, or those who cross together.
        start, direction = road.at(rng.uniform(-25, 25), rng.choice([-1, 1]) * (half + rng.uniform(-1, 3)))
        heading = direction + rng.choice([0.0, np.pi / 2]) + np.pi * rng.integers(2)
        step = rng.uniform(0.6, 1.2) * np.array([np.cos(heading), np.sin(heading)])
        for k in range(rng.integers(3, 10)):
            place, turned = start + k * step + rng.normal(0, 0.1, 2), heading + rng.normal(0, 0.3)
            out.add_user("pedestrian", place, turned, margin=0.0)
    for _ in range(rng.poisson(rng.choice([1, 4, 8]))):
        xy, direction = road.at(rng.uniform(-40, 40), rng.choice([-1, 1]) * (half + rng.uniform(-2.5, 2.5)))
        yaw = direction + np.pi * rng.integers(2) + rng.normal(0, 0.2)
        speed = out.draw_speed(RIDING_MPS) * float(rng.random() < 0.8)
        out.add_user(str(rng.choice(["cyclist", "motorcycle"], p=[0.65, 0.35])), xy, yaw, speed=speed, margin=0.1)
    for _ in range(rng.choice(3, p=[0.5, 0.3, 0.2])):
        xy, direction = road.at(rng.uniform(-25, 25), rng.choice([-1, 1]) * (half + rng.uniform(0.2, 4)))
        kind = str(rng.choice(["bicycle", "motorcycle"]))
        apart, most = (rng.uniform(0.6, 1.1), 9) if kind == "bicycle" else (rng.uniform(0.9, 2.0), 5)
        step = np.array([np.cos(direction), np.sin(direction)]) * apart
        for k in range(rng.integers(1, most)):
            kinds = "parked motorcycle" if kind == "motorcycle" else ""
            out.add_user(kind, xy + k * step, direction + np.pi / 2 + rng.normal(0, 0.1), margin=-0.3, kinds=kinds)


def _market(out: _Layout, road: Road) -> None:
    """Line a piece of the road with stalls or tables, people before, behind and at them; some stand on the carriageway."""
    rng, start = out.rng, out.rng.uniform(-35, 5)
    cafe = rng.random() < 0.35
    crowd = rng.uniform(0.3, 2.5)
    for side in (-1, 1) if rng.random() < 0.5 else (int(rng.choice([-1, 1])),):
        d, s = side * (road.half_width_m + rng.uniform(-1.5, 2.5)), start
        while s < start + rng.uniform(10, 40):
            xy, direction = road.at(s, d + rng.normal(0, 0.15))
            stands = {"table": 0.8, "parasol": 0.2} if cafe else {"stall": 0.8, "crates": 0.13, "clothes rail": 0.07}
            kind = out.one_of(stands)
            out.add_small(kind, xy, direction + np.pi * rng.integers(2) + rng.normal(0, 0.1), 0.6)
            for _ in range(rng.poisson(crowd)):
                away, angle = rng.uniform(0.7, 2.5), rng.uniform(-np.pi, np.pi)
                place = xy + away * np.array([np.cos(angle), np.sin(angle)])
                kinds = "seated" if cafe and rng.random() < 0.7 else ""
                out.add_user("pedestrian", place, angle + np.pi + rng.normal(0, 0.6), margin=0.0, kinds=kinds)
            s += rng.uniform(1.8, 3.2) if cafe else rng.uniform(2.5, 5)


def _roadside(out: _Layout, road: Road) -> None:
    """Scatter small clutter beside the road, some kinds in rows."""
    rng, half = out.rng, road.half_width_m
    shares = {kind: share for kind, (share, _, _) in clutter.SMALL.items()}
    for side in (-1, 1):
        if rng.random() < 0.6:
            kind = out.one_of({"tree": 0.3, "pole": 0.35, "bush": 0.2, "railing": 0.1, "planter": 0.05})
            step, d = rng.uniform(4, 15), half + rng.uniform(0.4, 3)
            for s in np.arange(-45 + rng.uniform(0, 6), 45, step):
                xy, direction = road.at(s + rng.normal(0, 0.5), side * d)
                if not out.on_road(xy):
                    out.add_small(kind, xy, direction)
        if rng.random() < 0.25:
            # Bollards keep cars off the sidewalk.
            start, step, d = rng.uniform(-30, 25), rng.uniform(0.9, 2.5), half + rng.uniform(0.2, 3)
            for k in range(rng.integers(3, 15)):
                xy, direction = road.at(start + k * step, side * d)
                if not out.on_road(xy):
                    out.add_small("bollard", xy, direction)
    for _ in range(rng.poisson(rng.choice([16, 26, 45]))):
        kind = out.one_of(shares)
        d = rng.choice([-1, 1]) * (half + abs(rng.normal(0, 6)) + 0.3)
        xy, direction = road.at(rng.uniform(-42, 42), d)
        if not out.on_road(xy) or kind == "cone":
            yaw = direction + (rng.normal(0, 0.1) if rng.random() < 0.5 else rng.uniform(-np.pi, np.pi))
            out.add_small(kind, xy, yaw)


def _fronts(out: _Layout, road: Road) -> None:
    """Line the road with houses, fences, hedges and open ground in pieces; people, parked two-wheelers and slim things stand before some."""
    rng = out.rng
    at_walls = rng.random() < 0.5
    for side in (-1, 1):
        edge = road.half_width_m + rng.uniform(2.5, 12)
        style, s = rng.random(), -55.0
        # In some rows every piece has its own distance from the road, its own direction, and may be as short as a car.
        uneven = rng.random() < 0.5
        while s < 55:
            length = rng.uniform(1.8, 9) if uneven and rng.random() < 0.6 else rng.uniform(4, 14)
            away = edge + (abs(rng.normal(0, 1.5)) if uneven else 0.0)
            xy, direction = road.at(s + length / 2, side * away)
            yaw = direction + (0.0 if side > 0 else np.pi)
            if uneven:
                yaw += rng.normal(0, 0.4) if rng.random() < 0.15 else rng.normal(0, 0.03)
            clear = out.is_free(_covering(xy, direction, (length, 2.0, 1.0)), 0.3)
            if clear and not out.on_road(xy):
                if style < 0.5 and rng.random() < 0.85:
                    entrances = rng.uniform(-0.45, 0.45, rng.choice(4, p=[0.5, 0.25, 0.15, 0.1])) * length
                    out.add_thing("building", xy, yaw, clutter.building(length, entrances.tolist(), rng))
                    for x in entrances[rng.random(len(entrances)) < 0.2]:
                        place = xy + rotation_from_rpy(0.0, 0.0, yaw)[:2, :2] @ [x, rng.uniform(-0.8, 0.2)]
                        out.add_user("pedestrian", place, yaw - np.pi / 2 + rng.normal(0, 1.0), margin=0.0)
                elif style < 0.85 and rng.random() < 0.75:
                    out.add_thing("fence", xy, yaw, clutter.fence(length, rng))
                for _ in range(rng.poisson(1.0) if at_walls else 0):
                    place, _ = road.at(s + rng.uniform(0, length), side * (away - rng.uniform(0.25, 1.2)))
                    kind = out.one_of(AT_WALLS)
                    if kind == "person":
                        out.add_user("pedestrian", place, rng.uniform(-np.pi, np.pi), margin=0.0)
                    elif kind in ("bicycle", "motorcycle"):
                        lean = yaw + np.pi * rng.integers(2) + rng.normal(0, 0.3)
                        lean += np.pi / 2 if rng.random() < 0.3 else 0.0
                        kinds = "parked motorcycle" if kind == "motorcycle" else ""
                        out.add_user(kind, place, lean, margin=-0.2, kinds=kinds)
                    else:
                        out.add_small(kind, place, yaw, 0.5)
            s += length + (rng.uniform(1, 9) if rng.random() < 0.4 else 0.0)


VEHICLE_LIDARS = ("hdl64e", "pandar64", "os1-64", "os1-128", "vlp32c", "hdl32e", "rslidar-m1", "vlp16")
SPARSE_SHARE = 0.25
VEHICLE_LIDAR_SHARES = (0.26, 0.28, 0.12, 0.08, 0.1, 0.09, 0.03, 0.04)


def draw_scene(
    mount: Mount,
    rng: np.random.Generator,
    *,
    lidar: LidarModel | None = None,
    weather: Environment | None = None,
    without: frozenset[str] = frozenset(),
) -> TrafficScene:
    """Draw a random scene.

    `mount`: "vehicle": the LiDAR is on a car's roof on the road; "roadside": on a pole beside it, tilted down to the
    road. `lidar`: by default one of the common sensors, with elevations and density that vary as between units.
    `weather`: by default clear, in one scene of ten rain or fog. `without`: kinds of `traffic_shapes` that are left out.
    """
    roads, sensor_forward = _draw_roads(mount, rng)
    steep = rng.random() < 0.4
    tilt = rng.normal(0, 0.03 if steep else 0.008, 2)
    bend = rng.normal(0, 4e-4 if steep else 5e-5, 3)
    amplitude, kx, ky = rng.uniform(0, 0.025, 3), rng.normal(0, 0.2, 3), rng.normal(0, 0.2, 3)
    waves = np.column_stack([amplitude, kx, ky, rng.uniform(0, 2 * np.pi, 3)])
    kerb = float(rng.choice([0.0, rng.uniform(0.02, 0.2), rng.normal(0, 0.2)], p=[0.3, 0.6, 0.1]))
    surface = Surface(np.append(tilt, bend), waves, roads, kerb)
    model = lidar or _draw_lidar(mount, rng)
    objects = draw_layout(mount, roads, surface, rng, sensor_forward, without)
    sensor = _draw_sensor(mount, model, surface, sensor_forward, rng)
    if mount == "vehicle" and sensor.position_m[2] > 1.5 and rng.random() < 0.7:
        parts = own_car(float(sensor.position_m[2]), rng)
        speed = float(np.hypot(*sensor.velocity_mps))
        objects.append(TrafficObject("", np.zeros(3), sensor_forward, OWN_CAR_M, parts, speed, kind="own car"))
    if weather is None:
        kind, weather = rng.random(), Environment()
        if kind < 0.05:
            weather = Environment(weather="fog", visibility_m=float(rng.uniform(60, 400)))
        elif kind < 0.1:
            weather = Environment(weather="rain", rain_mm_h=float(rng.uniform(2, 30)))
    noise = model.noise_m if lidar else float(rng.uniform(0.008, 0.03))
    # Up to one and a half times the errors by which posts spread in depth as in KITTI's sweeps.
    line_m, walk_m, edge_m = rng.uniform(0, (0.045, 0.03, 0.15)).tolist()
    lost, mixed = rng.uniform(0, (0.12, 0.006)).tolist()
    returns = ReturnModel(noise, lost, mixed, weather, line_m=line_m, walk_m=walk_m, edge_m=edge_m)
    two = mount == "vehicle" and not lidar and rng.random() < 0.2
    second = _draw_second(sensor, sensor_forward, rng) if two else None
    return TrafficScene(mount, roads, surface, tuple(objects), model, sensor, returns, second)


def _draw_roads(mount: Mount, rng: np.random.Generator) -> tuple[tuple[Road, ...], float]:
    """Draw the main road, which passes the sensor, and those that cross it."""
    half = float(rng.uniform(2.6, 5) if rng.random() < 0.6 else rng.uniform(5, 11))
    yaw = float(rng.uniform(-np.pi, np.pi))
    keeps_right = bool(rng.random() < 0.7)
    curvature = float(rng.choice([0.0, rng.normal(0, 0.004), rng.normal(0, 0.012)], p=[0.5, 0.3, 0.2]))
    lanes = max(1, round(2 * half / 3.3))
    side = rng.choice([-1, 1])
    if mount == "roadside":
        offset = side * (half + rng.uniform(0.4, 3.0))
        forward = float(rng.normal(0, 0.35))
    else:
        offset, forward = float(rng.uniform(-half + 1.2, half - 1.2)), 0.0
    # The origin is `offset` to the left of the line, so the line passes on its other side.
    normal = np.array([-np.sin(yaw), np.cos(yaw)])
    main = Road(-offset * normal, yaw, curvature, half, lanes, keeps_right, bool(rng.random() < 0.15))
    if mount == "roadside":
        # The sensor looks across the road, more or less.
        towards = np.arctan2(*(-offset * normal)[::-1])
        forward += float(towards) + float(rng.choice([0.0, rng.uniform(-1.2, 1.2)]))
    elif rng.random() < 0.9:
        forward = yaw + (0.0 if (offset < 0) == keeps_right else np.pi)
    roads = [main]
    for _ in range(rng.choice(3, p=[0.5, 0.38, 0.12])):
        at, _ = main.at(float(rng.uniform(-40, 40)), 0.0)
        cross_half = float(rng.uniform(2.5, 7))
        cross_yaw = yaw + float(rng.choice([-1, 1])) * float(rng.normal(np.pi / 2, 0.2))
        roads.append(Road(at, cross_yaw, 0.0, cross_half, max(1, round(2 * cross_half / 3.3)), keeps_right))
    return tuple(roads), forward


def _draw_lidar(mount: Mount, rng: np.random.Generator) -> LidarModel:
    if mount == "roadside":
        model = LIDAR_MODELS["rslidar16-roadside"]
        if rng.random() < 0.25:
            lines = int(rng.choice([32, 40, 64]))
            model = model.model_copy(update={"elevation_deg": tuple(np.linspace(-20, 12, lines).tolist())})
        return model.model_copy(update={"range_m": float(rng.choice([80.0, 120.0, 150.0]))})
    if rng.random() < SPARSE_SHARE:
        # Any other spinning or solid-state sensor, of few lines or at a high rate.
        lines = int(rng.choice([16, 24, 32, 40, 64]))
        view = float(rng.choice([180.0, rng.uniform(50, 140)], p=[0.75, 0.25]))
        elevation = np.linspace(rng.uniform(-30, -12), rng.uniform(2, 15), lines)
        step, reach = float(rng.uniform(0.2, 0.7)), float(rng.uniform(60, 150))
        field = {"elevation_deg": tuple(elevation.tolist()), "azimuth_deg": (-view, view), "azimuth_step_deg": step}
        return LidarModel.model_validate({**field, "range_m": reach})
    model = LIDAR_MODELS[str(rng.choice(VEHICLE_LIDARS, p=VEHICLE_LIDAR_SHARES))]
    elevation = np.array(model.elevation_deg) + rng.normal(0, 0.15)
    if rng.random() < 0.08:
        elevation = np.delete(elevation, rng.choice(len(elevation), len(elevation) // 3, replace=False))
    step = model.azimuth_step_deg * float(rng.choice([1.0, 1.2, 1.5], p=[0.6, 0.25, 0.15]))
    return model.model_copy(update={"elevation_deg": tuple(elevation.tolist()), "azimuth_step_deg": step})


def _draw_sensor(
    mount: Mount, model: LidarModel, surface: Surface, forward: float, rng: np.random.Generator
) -> SensorState:
    if mount == "roadside":
        height, pitch = model.height_m + rng.normal(0, 0.1), np.deg2rad(model.pitch_deg + rng.normal(0, 0.6))
        roll, velocity = np.deg2rad(rng.normal(0, 0.6)), np.zeros(2)
    else:
        # On cars, on robots and carts, on trucks.
        heights = [rng.uniform(1.55, 2.3), rng.uniform(0.7, 1.5), rng.uniform(2.3, 3.2)]
        height = float(rng.choice(heights, p=[0.86, 0.07, 0.07]))
        sx, sy = surface.slope(np.zeros(1, np.float32), np.zeros(1, np.float32))
        uphill = float(sx[0] * np.cos(forward) + sy[0] * np.sin(forward))
        leftward = float(-sx[0] * np.sin(forward) + sy[0] * np.cos(forward))
        # The car stands on the slope, so its sensor leans with it.
        pitch = -np.arctan(uphill) + np.deg2rad(rng.normal(0, 0.5))
        roll = np.arctan(leftward) + np.deg2rad(rng.normal(0, 0.5))
        speed = float(rng.choice([0.0, rng.uniform(0, 16), rng.uniform(16, 32)], p=[0.3, 0.55, 0.15]))
        velocity = speed * np.array([np.cos(forward), np.sin(forward)])
    rotation = rotation_from_rpy(roll, pitch, forward)
    return SensorState(rotation, np.array([0.0, 0.0, height]), velocity)


def _draw_second(sensor: SensorState, forward: float, rng: np.random.Generator) -> tuple[LidarModel, SensorState]:
    """Draw a second LiDAR: a solid-state one that looks forward, or one of a few lines at a corner."""
    if rng.random() < 0.6:
        model, yaw = LIDAR_MODELS[str(rng.choice(["pandargt", "rslidar-m1"]))], forward
    else:
        model, yaw = LIDAR_MODELS["vlp16"], float(rng.uniform(-np.pi, np.pi))
    offset = np.array([rng.uniform(-1.0, 0.6), rng.uniform(-0.8, 0.8), rng.uniform(-0.4, 0.1)])
    place = sensor.position_m + rotation_from_rpy(0.0, 0.0, forward) @ offset
    pitch = np.deg2rad(rng.normal(0, 1.0))
    return model, SensorState(rotation_from_rpy(0.0, pitch, yaw), place, sensor.velocity_mps)


# KITTI's camera 2, which sits 0.27 m ahead of the LiDAR and 0.08 m lower (Geiger et al., IJRR 2013).
KITTI_SIZE_PX, KITTI_FOCAL_PX, KITTI_CENTER_PX = (1242, 375), 721.5377, (609.5593, 172.854)
KITTI_OFFSET_M = (0.27, 0.0, -0.08)
# At the roadside: a wide view of the road below.
ROADSIDE_SIZE_PX, ROADSIDE_FOCAL_PX = (960, 600), 600.0
ROADSIDE_PITCH_DEG, ROADSIDE_OFFSET_M = 17.0, (0.0, 0.0, 0.5)
DEFAULT_LIDAR: dict[str, str] = {"vehicle": "hdl64e", "roadside": "rslidar16-roadside"}
LIGHT_SHARES = {"noon": 0.4, "overcast": 0.25, "dusk": 0.15, "night": 0.2}
WEATHER_SHARES = {"clear": 0.7, "rain": 0.15, "fog": 0.15}
VISIBILITY_M, RAIN_MM_H = (50.0, 300.0), (2.0, 40.0)  # between which they are drawn
FORWARD_R_CAM = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0.0]])


@dataclass(frozen=True, eq=False)
class Rig:
    """Camera and LiDAR at one time."""

    camera: Camera
    map_T_cam: Array  # (4, 4)
    map_T_lidar: Array  # (4, 4)
    map_T_level: Array  # (4, 4): at the camera, x right, y down along gravity, z forward; its own where it looks level
    lidar_height_m: float  # above the ground below it


def rig_of(scene: TrafficScene) -> Rig:
    """Place the camera of a scene at time 0: it looks where the LiDAR does, level on a vehicle, down at the roadside."""
    R, position = scene.sensor.rotation, scene.sensor.position_m
    yaw = float(np.arctan2(R[1, 0], R[0, 0]))
    offset = KITTI_OFFSET_M if scene.mount == "vehicle" else ROADSIDE_OFFSET_M
    pitch = 0.0 if scene.mount == "vehicle" else np.deg2rad(ROADSIDE_PITCH_DEG)
    eye = position + rotation_from_rpy(0.0, 0.0, yaw) @ np.array(offset)
    level = transform(rotation_from_rpy(0.0, 0.0, yaw) @ FORWARD_R_CAM, eye)
    map_T_cam = transform(rotation_from_rpy(0.0, pitch, yaw) @ FORWARD_R_CAM, eye)
    if scene.mount == "vehicle":
        (width, height), focal, (cx, cy) = KITTI_SIZE_PX, KITTI_FOCAL_PX, KITTI_CENTER_PX
    else:
        (width, height), focal = ROADSIDE_SIZE_PX, ROADSIDE_FOCAL_PX
        cx, cy = (width - 1) / 2, (height - 1) / 2
    K = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1]])
    camera = Camera("camera", width, height, K, "map", map_T_cam)
    return Rig(camera, map_T_cam, transform(R, position), level, float(position[2] - scene.surface.elevation(position)))


def sensor_named(name: str | None, mount: Mount) -> LidarModel | None:
    """Return the LiDAR of a name or TOML file; by default the usual one of the mount, for "random" None.

    Raises `ConfigError` for a name that is not known or a file that cannot be read.
    """
    if name == "random":
        return None
    return LIDAR_MODELS[DEFAULT_LIDAR[mount]] if name is None else lidar_model(name)


def draw_environment(rng: np.random.Generator, light: str | None, weather: str | None) -> Environment:
    """Draw light and weather; what is given stays, and does not change what else is drawn."""
    drawn_light = str(rng.choice(list(LIGHT_SHARES), p=list(LIGHT_SHARES.values())))
    drawn_weather = str(rng.choice(list(WEATHER_SHARES), p=list(WEATHER_SHARES.values())))
    visibility, rain = rng.uniform(*VISIBILITY_M), rng.uniform(*RAIN_MM_H)
    drawn = {"light": light or drawn_light, "weather": weather or drawn_weather}
    amounts = {"visibility_m": round(float(visibility), 1), "rain_mm_h": round(float(rain), 1)}
    return Environment.model_validate({**drawn, **amounts})
