"""A stand-in for CARLA's server that speaks the client's own types, so that a wrong type or unit raises.

Vehicles are kinematic bicycles in CARLA's left-handed frame that answer to throttle, brake and steering with a lag; what
does not move by physics stands where it was put. Like a real server it moves only at ticks, and shows an actor at the origin
until the first one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import carla

STEERING_CURVE = [(0.0, 1.0), (20.0, 0.9), (60.0, 0.8), (120.0, 0.7)]  # km/h
ACCEL_MPS2, BRAKE_MPS2, DRAG_1PM, LAG_S = 5.0, 9.0, 0.002, 0.1
ROAD_Z_M = 0.0


@dataclass
class Blueprint:
    """A blueprint of the library; only vehicles can be painted."""

    id: str
    settings: dict[str, str] = field(default_factory=dict)

    def has_attribute(self, name: str) -> bool:
        vehicle, walker = self.id.startswith("vehicle."), self.id.startswith("walker.")
        return name == "role_name" or (name == "color" and vehicle) or (name == "is_invincible" and walker)

    def set_attribute(self, name: str, value: str) -> None:
        assert self.has_attribute(name), name
        assert isinstance(value, str)
        self.settings[name] = value


class Library:
    """Blueprints by id, as `size_m` of the server."""

    def __init__(self, sizes: dict[str, tuple[float, float, float]]) -> None:
        self.sizes = sizes

    def filter(self, pattern: str) -> list[Blueprint]:
        return [Blueprint(pattern)] if pattern in self.sizes else []


class Actor:
    """An actor on the server: `pose` x, y, z of its origin and yaw in rad, `velocity` x, y."""

    def __init__(self, identity: int, blueprint: Blueprint, size_m: tuple[float, float, float], at: Any) -> None:
        self.id, self.type_id, self.attributes = identity, blueprint.id, dict(blueprint.settings)
        half = carla.Vector3D(*(v / 2 for v in size_m))
        # As on real servers: the origin of a vehicle is near the middle of its lowest face, that of a walker at its middle.
        self.is_walker, self.is_vehicle = self.type_id.startswith("walker."), self.type_id.startswith("vehicle.")
        center = carla.Location(0.0, 0.0, 0.0) if self.is_walker else carla.Location(0.05, 0.0, half.z)
        self.bounding_box = carla.BoundingBox(center, half)
        self.rear_x, self.wheelbase = -0.29 * size_m[0], 0.6 * size_m[0]
        self.physics, self.ticked = not self.type_id.startswith("static."), False
        self.velocity, self.control, self.accel, self.steer = (0.0, 0.0), carla.VehicleControl(), 0.0, 0.0
        self.walk, self.shown_steer_deg = carla.WalkerControl(), {}
        self.put(at)

    def put(self, transform: Any) -> None:
        assert isinstance(transform, carla.Transform)
        at, r = transform.location, transform.rotation
        assert r.pitch == r.roll == 0
        self.pose = (at.x, at.y, at.z, math.radians(r.yaw))

    def get_transform(self) -> Any:
        x, y, z, yaw = self.pose if self.ticked else (0.0, 0.0, 0.0, 0.0)
        return carla.Transform(carla.Location(x, y, z), carla.Rotation(yaw=(math.degrees(yaw) + 180) % 360 - 180))

    def get_velocity(self) -> Any:
        """No velocity without physics, as on a real server."""
        return carla.Vector3D(*(self.velocity if self.physics else (0.0, 0.0)), 0.0)

    def get_physics_control(self) -> Any:
        assert self.is_vehicle
        x, y, _, yaw = self.pose
        wheels = []
        known = 100.0 if self.ticked else 0.0  # centimeters; not before the first tick
        for along, lock in ((self.rear_x + self.wheelbase, 70.0), (self.rear_x, 0.0)):
            for side in (-0.8, 0.8):
                at = (
                    x + along * math.cos(yaw) - side * math.sin(yaw),
                    y + along * math.sin(yaw) + side * math.cos(yaw),
                )
                wheels.append(
                    carla.WheelPhysicsControl(
                        max_steer_angle=lock, position=carla.Vector3D(known * at[0], known * at[1], 30.0)
                    )
                )
        return carla.VehiclePhysicsControl(wheels=wheels, steering_curve=[carla.Vector2D(*p) for p in STEERING_CURVE])

    def set_wheel_steer_direction(self, wheel: Any, angle_deg: float) -> None:
        assert isinstance(wheel, carla.VehicleWheelLocation)
        assert not self.physics, "CARLA turns the looks of wheels only while physics is off"
        self.shown_steer_deg[wheel] = angle_deg

    def center(self) -> tuple[float, float, float, float]:
        """Center x, y of the box, its lowest face, and yaw."""
        x, y, z, yaw = self.pose
        b = self.bounding_box
        return (
            x + b.location.x * math.cos(yaw), y + b.location.x * math.sin(yaw), z + b.location.z - b.extent.z, yaw
        )  # fmt: skip

    def advance(self, dt_s: float) -> None:
        self.ticked = True
        if self.is_walker:
            d, speed = self.walk.direction, self.walk.speed
            self.velocity = (d.x * speed, d.y * speed)
            x, y, z, yaw = self.pose
            self.pose = (x + d.x * speed * dt_s, y + d.y * speed * dt_s, z, math.atan2(d.y, d.x) if speed > 0 else yaw)
        elif self.is_vehicle and self.physics:
            steps = max(1, round(dt_s / 0.005))
            for _ in range(steps):
                self._drive(dt_s / steps)

    def _drive(self, h: float) -> None:
        """A kinematic bicycle: y to the right and yaw clockwise, so steering to the right is positive."""
        x, y, z, yaw = self.pose
        speed = self.velocity[0] * math.cos(yaw) + self.velocity[1] * math.sin(yaw)
        c, gear = self.control, -1.0 if self.control.reverse else 1.0
        blend = -math.expm1(-h / LAG_S)
        self.accel += blend * (gear * c.throttle * ACCEL_MPS2 - self.accel)
        self.steer += blend * (c.steer - self.steer)
        friction = h * (c.brake * BRAKE_MPS2 + DRAG_1PM * speed**2)
        speed += self.accel * h
        speed = math.copysign(max(abs(speed) - friction, 0.0), speed)
        angle = self.steer * share(abs(speed) * 3.6) * math.radians(70.0)
        rear = self.rear_x
        ax, ay = x + rear * math.cos(yaw), y + rear * math.sin(yaw)
        ax, ay = ax + speed * h * math.cos(yaw), ay + speed * h * math.sin(yaw)
        yaw += speed * h * math.tan(angle) / self.wheelbase
        self.pose = (ax - rear * math.cos(yaw), ay - rear * math.sin(yaw), max(z - 2.0 * h, ROAD_Z_M), yaw)
        self.velocity = (speed * math.cos(yaw), speed * math.sin(yaw))


def share(speed_kmh: float) -> float:
    """What is left of full lock at a speed."""
    for (a, fa), (b, fb) in pairwise(STEERING_CURVE):
        if speed_kmh <= b:
            return fa + (fb - fa) * (speed_kmh - a) / (b - a)
    return STEERING_CURVE[-1][1]


class World:
    """A world whose ground is flat at `ROAD_Z_M`; `seen` holds every tick the poses of all actors by role name."""

    def __init__(self, sizes: dict[str, tuple[float, float, float]], road: Any) -> None:
        self.library, self.road, self.actors = Library(sizes), road, {}
        self.settings, self.applied = carla.WorldSettings(), []
        self.ticks, self.next_id, self.blocked_below_m, self.stop_at = 0, 1, 0.0, -1
        self.seen: list[dict[str, tuple[float, ...]]] = []
        self.spectator = SimpleNamespace(at=None)
        self.spectator.set_transform = lambda t: setattr(self.spectator, "at", t)

    def get_settings(self) -> Any:
        s = self.settings
        return carla.WorldSettings(
            synchronous_mode=s.synchronous_mode, fixed_delta_seconds=s.fixed_delta_seconds or 0.0
        )

    def apply_settings(self, settings: Any) -> int:
        assert isinstance(settings, carla.WorldSettings)
        self.settings = settings
        self.applied.append((settings.synchronous_mode, settings.fixed_delta_seconds))
        return self.ticks

    def get_blueprint_library(self) -> Library:
        return self.library

    def get_map(self) -> Any:
        return self.road

    def get_spectator(self) -> Any:
        return self.spectator

    def try_spawn_actor(self, blueprint: Blueprint, transform: Any) -> Actor | None:
        assert isinstance(transform, carla.Transform)
        if transform.location.z < self.blocked_below_m:
            return None
        actor = Actor(self.next_id, blueprint, self.library.sizes[blueprint.id], transform)
        self.actors[self.next_id] = actor
        self.next_id += 1
        return actor

    def tick(self) -> int:
        assert self.settings.synchronous_mode
        self.ticks += 1
        if self.ticks == self.stop_at:
            raise KeyboardInterrupt
        for actor in self.actors.values():
            actor.advance(self.settings.fixed_delta_seconds)
        self.seen.append({a.attributes["role_name"]: a.center() for a in self.actors.values()})
        return self.ticks


class Client:
    """The client's side of a server with one world; `orders` is what it was told, as (tick, role name, command)."""

    def __init__(self, sizes: dict[str, tuple[float, float, float]], road: Any = None) -> None:
        self.world, self.orders, self.loaded, self.timeout_s = World(sizes, road), [], [], 0.0

    def __call__(self, host: str, port: int) -> Client:
        """Stands for the class `carla.Client`."""
        self.address = (host, port)
        return self

    def set_timeout(self, seconds: float) -> None:
        self.timeout_s = seconds

    def get_server_version(self) -> str:
        return "0.9.16"

    get_client_version = get_server_version

    def get_world(self) -> World:
        return self.world

    def load_world(self, town: str) -> World:
        self.loaded.append(town)
        return self.world

    def generate_opendrive_world(self, text: str, parameters: Any) -> World:
        assert isinstance(parameters, carla.OpendriveGenerationParameters)
        self.loaded.append(text)
        self.world.road = carla.Map("made", text)
        return self.world

    def apply_batch_sync(self, commands: list[Any], do_tick: bool) -> list[Any]:
        assert do_tick is False
        return [SimpleNamespace(error=self._obey(c)) for c in commands]

    def _obey(self, command: Any) -> str:
        actor = self.world.actors.get(command.actor_id)
        if actor is None:
            return f"unable to find actor {command.actor_id}"
        kind = type(command).__name__
        self.orders.append((self.world.ticks, actor.attributes["role_name"], command))
        if kind == "DestroyActor":
            del self.world.actors[command.actor_id]
        elif kind == "ApplyTransform":
            actor.put(command.transform)
        elif kind == "ApplyTargetVelocity":
            actor.velocity = (command.velocity.x, command.velocity.y)
        elif kind == "SetSimulatePhysics":
            actor.physics = command.enabled
        elif kind == "ApplyVehicleControl":
            assert actor.is_vehicle
            assert 0 <= command.control.throttle <= 1
            assert 0 <= command.control.brake <= 1
            assert -1 <= command.control.steer <= 1
            actor.control = command.control
        elif kind == "ApplyWalkerControl":
            assert actor.is_walker
            assert command.control.speed >= 0
            actor.walk = command.control
        else:
            raise AssertionError(kind)
        return ""
