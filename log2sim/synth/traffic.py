"""Random traffic scenes around a LiDAR: roads, road users and clutter, cast in a tenth of a second.

A scene is drawn from a seed alone. Roads run at any angle, bend, cross each other and rise; traffic keeps right or left; cars
park along, across and at an angle; people, riders and what is no road user stand beside the road.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, rotation_from_rpy, wrap_angle
from log2sim.synth.lidar_models import LIDAR_MODELS, LidarModel
from log2sim.synth.polytope_caster import Returns, SensorState, Solid, cast_polytopes
from log2sim.synth.polytopes import Polytope
from log2sim.synth.returns import ReturnModel, Weather

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
    """

    mount: Mount
    roads: tuple[Road, ...]
    surface: Surface
    objects: tuple[TrafficObject, ...]
    lidar: LidarModel
    sensor: SensorState
    returns: ReturnModel

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
        return cast_polytopes(self.lidar, self.sensor, solids, self.surface, rng, self.returns)


VEHICLE_LIDARS = ("hdl64e", "pandar64", "os1-64", "os1-128", "vlp32c", "hdl32e", "rslidar-m1")
VEHICLE_LIDAR_SHARES = (0.28, 0.3, 0.12, 0.08, 0.1, 0.09, 0.03)


def draw_scene(
    mount: Mount, rng: np.random.Generator, *, lidar: LidarModel | None = None, weather: Weather | None = None
) -> TrafficScene:
    """Draw a random scene.

    Parameters
    ----------
    mount : str
        "vehicle": the LiDAR is on a car's roof on the road; "roadside": on a pole beside it, tilted down to the road.
    rng : Generator
    lidar : LidarModel, optional
        By default one of the common sensors, with elevations and density that vary as between units.
    weather : Weather, optional
        By default clear, in one scene of ten rain or fog.
    """
    from log2sim.synth.traffic_layout import draw_layout

    roads, sensor_forward = _draw_roads(mount, rng)
    surface = _draw_surface(roads, rng)
    model = lidar or _draw_lidar(mount, rng)
    objects = draw_layout(mount, roads, surface, rng)
    sensor = _draw_sensor(mount, model, surface, sensor_forward, rng)
    weather = weather or _draw_weather(rng)
    returns = ReturnModel(
        noise_m=model.noise_m if lidar else float(rng.uniform(0.008, 0.03)),
        dropout=float(rng.uniform(0.0, 0.12)),
        mixed=float(rng.uniform(0, 0.006)),
        weather=weather,
    )
    return TrafficScene(mount, roads, surface, tuple(objects), model, sensor, returns)


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


def _draw_surface(roads: tuple[Road, ...], rng: np.random.Generator) -> Surface:
    steep = rng.random() < 0.4
    tilt = rng.normal(0, 0.03 if steep else 0.008, 2)
    bend = rng.normal(0, 4e-4 if steep else 5e-5, 3)
    waves = np.column_stack(
        [rng.uniform(0, 0.025, 3), rng.normal(0, 0.2, 3), rng.normal(0, 0.2, 3), rng.uniform(0, 2 * np.pi, 3)]
    )
    kerb = float(rng.choice([0.0, rng.uniform(0.02, 0.2), rng.normal(0, 0.2)], p=[0.3, 0.6, 0.1]))
    return Surface(np.append(tilt, bend), waves, roads, kerb)


def _draw_lidar(mount: Mount, rng: np.random.Generator) -> LidarModel:
    if mount == "roadside":
        model = LIDAR_MODELS["rslidar16-roadside"]
        if rng.random() < 0.25:
            lines = int(rng.choice([32, 40, 64]))
            model = model.model_copy(update={"elevation_deg": tuple(np.linspace(-20, 12, lines).tolist())})
        return model.model_copy(update={"range_m": float(rng.choice([80.0, 120.0, 150.0]))})
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
        height = float(rng.uniform(1.55, 2.3))
        sx, sy = surface.slope(np.zeros(1, np.float32), np.zeros(1, np.float32))
        uphill = float(sx[0] * np.cos(forward) + sy[0] * np.sin(forward))
        leftward = float(-sx[0] * np.sin(forward) + sy[0] * np.cos(forward))
        # The car stands on the slope, so its sensor leans with it.
        pitch, roll = (
            -np.arctan(uphill) + np.deg2rad(rng.normal(0, 0.5)),
            np.arctan(leftward) + np.deg2rad(rng.normal(0, 0.5)),
        )
        speed = float(rng.choice([0.0, rng.uniform(0, 16), rng.uniform(16, 32)], p=[0.3, 0.55, 0.15]))
        velocity = speed * np.array([np.cos(forward), np.sin(forward)])
    rotation = rotation_from_rpy(roll, pitch, forward)
    return SensorState(rotation, np.array([0.0, 0.0, height]), velocity)


def _draw_weather(rng: np.random.Generator) -> Weather:
    kind = rng.random()
    if kind < 0.05:
        return Weather("fog", visibility_m=float(rng.uniform(60, 400)))
    if kind < 0.1:
        return Weather("rain", rain_mm_h=float(rng.uniform(2, 30)))
    return Weather()


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
