"""Draw random traffic scenes: roads, ground, sensor, weather, and what the layout puts beside them."""

from __future__ import annotations

import numpy as np

from log2sim.geometry import rotation_from_rpy
from log2sim.synth.lidar_models import LIDAR_MODELS, LidarModel
from log2sim.synth.polytope_hits import SensorState
from log2sim.synth.returns import ReturnModel, Weather
from log2sim.synth.traffic import Mount, Road, Surface, TrafficObject, TrafficScene
from log2sim.synth.traffic_clutter import own_car
from log2sim.synth.traffic_layout import draw_layout

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
    roads, sensor_forward = _draw_roads(mount, rng)
    surface = _draw_surface(roads, rng)
    model = lidar or _draw_lidar(mount, rng)
    objects = draw_layout(mount, roads, surface, rng)
    sensor = _draw_sensor(mount, model, surface, sensor_forward, rng)
    if mount == "vehicle" and rng.random() < 0.7:
        parts = own_car(float(sensor.position_m[2]), rng)
        speed = float(np.hypot(*sensor.velocity_mps))
        objects.append(TrafficObject("", np.zeros(3), sensor_forward, (4.4, 1.8, 1.5), parts, speed, kind="own car"))
    weather = weather or _draw_weather(rng)
    returns = ReturnModel(
        noise_m=model.noise_m if lidar else float(rng.uniform(0.008, 0.03)),
        dropout=float(rng.uniform(0.0, 0.12)),
        mixed=float(rng.uniform(0, 0.006)),
        weather=weather,
    )
    second = (
        _draw_second(sensor, sensor_forward, rng) if mount == "vehicle" and not lidar and rng.random() < 0.2 else None
    )
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


def _draw_weather(rng: np.random.Generator) -> Weather:
    kind = rng.random()
    if kind < 0.05:
        return Weather("fog", visibility_m=float(rng.uniform(60, 400)))
    if kind < 0.1:
        return Weather("rain", rain_mm_h=float(rng.uniform(2, 30)))
    return Weather()
