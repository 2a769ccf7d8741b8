"""Random traffic scenes around a LiDAR: roads, road users and clutter, cast in a tenth of a second.

A scene is drawn from a seed alone. Roads run at any angle, bend, cross each other and rise; traffic keeps right or left; cars
park along, across and at an angle; people, riders and what is no road user stand beside the road.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, wrap_angle
from log2sim.synth.lidar_models import LidarModel
from log2sim.synth.polytope_caster import Returns, cast_polytopes
from log2sim.synth.polytope_hits import SensorState, Solid
from log2sim.synth.polytopes import Polytope
from log2sim.synth.returns import ReturnModel

Mount = Literal["vehicle", "roadside"]


@dataclass(frozen=True, eq=False)
class Road:
    """A road of constant curvature with its reference line in the middle.

    Attributes
    ----------
    origin_m : (2,) float64, m
        Point of the line at s = 0.
    yaw_rad : float
        Direction of the line there.
    curvature_per_m : float
    half_width_m : float
        Half of the carriageway, m.
    lanes : int
        In all.
    keeps_right : bool
    one_way : bool
    """

    origin_m: Array
    yaw_rad: float
    curvature_per_m: float
    half_width_m: float
    lanes: int
    keeps_right: bool = True
    one_way: bool = False

    def at(self, s: float, d: float) -> tuple[Array, float]:
        """Position (2,) and direction of the line at s along it and d to its left, m."""
        k, a = self.curvature_per_m, self.yaw_rad
        turn = a + k * s
        if abs(k) < 1e-6:
            along = np.array([np.cos(a), np.sin(a)]) * s
        else:
            along = np.array([np.sin(turn) - np.sin(a), np.cos(a) - np.cos(turn)]) / k
        return self.origin_m + along + d * np.array([-np.sin(turn), np.cos(turn)]), float(turn)

    def offset(self, x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float32]:
        """Distance (N,) to the left of the line, m."""
        k = self.curvature_per_m
        normal = np.array([-np.sin(self.yaw_rad), np.cos(self.yaw_rad)])
        dx, dy = x - np.float32(self.origin_m[0]), y - np.float32(self.origin_m[1])
        if abs(k) < 1e-6:
            return np.asarray(dx * np.float32(normal[0]) + dy * np.float32(normal[1]))
        center = normal / k
        radius = np.hypot(dx - np.float32(center[0]), dy - np.float32(center[1]))
        return np.asarray((np.float32(abs(1 / k)) - radius) * np.float32(np.sign(k)))


@dataclass(frozen=True, eq=False)
class Surface:
    """Ground: a tilted and bent plane with waves, and kerbs beside the roads.

    Attributes
    ----------
    coefficients : (5,) float64
        Of x, y, x^2, x y, y^2.
    waves : (K, 4) float64
        Amplitude in m, wave numbers along x and y in rad/m, phase.
    roads : tuple of Road
    kerb_m : float
        Height of the ground beside the roads.
    """

    coefficients: Array
    waves: Array
    roads: tuple[Road, ...]
    kerb_m: float

    def height(self, x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return heights (N,) without kerbs, m."""
        a, b, c, d, e = self.coefficients.astype(np.float32)
        return np.asarray(x * (a + c * x + d * y) + y * (b + e * y))

    def elevation(self, position: Array) -> float:
        """Return the height with waves and kerbs at one position (2,) or (3,), m."""
        x, y = position[:1].astype(np.float32), position[1:2].astype(np.float32)
        return float(self.height(x, y)[0] + self.relief(x, y)[0])

    def slope(self, x: NDArray[np.float32], y: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return derivatives (N,), (N,) of the height."""
        a, b, c, d, e = self.coefficients.astype(np.float32)
        return np.asarray(a + 2 * c * x + d * y), np.asarray(b + 2 * e * y + d * x)

    def relief(self, x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return waves and kerbs (N,), m."""
        beside = np.ones(len(x), bool)
        for road in self.roads:
            beside &= np.abs(road.offset(x, y)) > road.half_width_m
        out = np.float32(self.kerb_m) * beside.astype(np.float32)
        for amplitude, kx, ky, phase in self.waves.astype(np.float32):
            out += amplitude * np.sin(kx * x + ky * y + phase)
        return np.asarray(out)


@dataclass(frozen=True, eq=False)
class TrafficObject:
    """A road user or a thing at time 0, the middle of the sweep.

    Attributes
    ----------
    category : str
        One of the road users' categories, "" for clutter.
    position_m : (3,) float64, m
        Middle of its floor, level frame under the sensor.
    yaw_rad : float
    size_m : (float, float, float)
        Length, width, height, m.
    parts : tuple of Polytope
    speed_mps : float
        Along the heading.
    turn_radps : float
        Rate of the heading.
    kind : str
        What clutter is: tree, pole, building ...
    """

    category: str
    position_m: Array
    yaw_rad: float
    size_m: tuple[float, float, float]
    parts: tuple[Polytope, ...]
    speed_mps: float = 0.0
    turn_radps: float = 0.0
    kind: str = ""

    def pose_at(self, t_s: float) -> tuple[Array, float]:
        """Position (3,) of the middle of its floor and heading, on an arc, at a time relative to the middle of the sweep."""
        turn = self.turn_radps * t_s
        # sin(u)/u of half the turn makes the chord of the arc exact, also for no turn at all.
        chord = self.speed_mps * t_s * np.sinc(turn / 2 / np.pi)
        a = self.yaw_rad + turn / 2
        return self.position_m + chord * np.array([np.cos(a), np.sin(a), 0.0]), float(wrap_angle(self.yaw_rad + turn))


@dataclass(frozen=True, eq=False)
class TrafficScene:
    """Everything around a LiDAR; level frame: z up, origin on the ground below the sensor, x forward.

    Attributes
    ----------
    mount : str
        vehicle or roadside.
    roads : tuple of Road
    surface : Surface
    objects : tuple of TrafficObject
    lidar : LidarModel
    sensor : SensorState
    returns : ReturnModel
    second : (LidarModel, SensorState) or None
        Another LiDAR that sees the scene too.
    """

    mount: Mount
    roads: tuple[Road, ...]
    surface: Surface
    objects: tuple[TrafficObject, ...]
    lidar: LidarModel
    sensor: SensorState
    returns: ReturnModel
    second: tuple[LidarModel, SensorState] | None = None

    def at(self, t_s: float) -> TrafficScene:
        """Return the scene at another time; the sensor stays in the origin's frame and moves with its velocity."""
        moved = []
        for item in self.objects:
            position, yaw = item.pose_at(t_s)
            position[2] = self.surface.elevation(position)
            moved.append(replace(item, position_m=position, yaw_rad=yaw) if item.speed_mps else item)
        start = self.sensor.position_m + np.append(self.sensor.velocity_mps, 0.0) * t_s
        return replace(self, objects=tuple(moved), sensor=replace(self.sensor, position_m=start))

    def cast(self, rng: np.random.Generator) -> Returns:
        """Cast the sweep whose middle is at time 0."""
        solids = [
            Solid(
                o.parts,
                o.position_m,
                o.yaw_rad,
                o.speed_mps * np.array([np.cos(o.yaw_rad), np.sin(o.yaw_rad)]),
                glass_passes=float(rng.uniform(0.3, 0.9)),
            )
            for o in self.objects
        ]
        one = cast_polytopes(self.lidar, self.sensor, solids, self.surface, rng, self.returns)
        if self.second is None:
            return one
        two = cast_polytopes(*self.second, solids, self.surface, rng, self.returns)
        return Returns(**{k: np.concatenate([v, getattr(two, k)]) for k, v in vars(one).items()})


@dataclass(frozen=True, eq=False)
class LabeledCloud:
    """A cloud and the road users in it, as a network is trained on.

    Attributes
    ----------
    xyz_m : (N, 3) float32, m
        Level frame.
    hit : (N,) int32
        Index of the object, -1 for the ground.
    category : (M,) str
        Of the road users.
    boxes : (M, 7) float64
        x, y, z of the center, length, width, height in m, heading in rad, at the mean time of the user's points.
    points : (M,) int64
        Number of points on each.
    scene : TrafficScene
    """

    xyz_m: NDArray[np.float32]
    hit: NDArray[np.int32]
    category: NDArray[np.str_]
    boxes: Array
    points: NDArray[np.int64]
    scene: TrafficScene = field(repr=False)


def labeled_cloud(scene: TrafficScene, rng: np.random.Generator) -> LabeledCloud:
    """Cast a scene and label its road users."""
    cloud = scene.cast(rng)
    users = [k for k, o in enumerate(scene.objects) if o.category]
    count = np.bincount(cloud.hit[cloud.hit >= 0], minlength=len(scene.objects))
    total_s = np.bincount(cloud.hit[cloud.hit >= 0], cloud.t_s[cloud.hit >= 0], minlength=len(scene.objects))
    boxes = np.zeros((len(users), 7))
    for row, k in enumerate(users):
        item = scene.objects[k]
        position, yaw = item.pose_at(float(total_s[k] / max(count[k], 1)))
        boxes[row] = *position[:2], position[2] + item.size_m[2] / 2, *item.size_m, yaw
    category = np.array([scene.objects[k].category for k in users], dtype="<U16")
    return LabeledCloud(cloud.xyz_m, cloud.hit, category, boxes, count[users], scene)
