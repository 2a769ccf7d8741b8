#!/usr/bin/env python3
"""Replay a scenario in CARLA: `python replay_carla.py [--mode exact|pid] [--opendrive | --map TOWN]`.

Needs a running CARLA 0.9.x server and its Python client (`pip install carla`), nothing else. The data file holds the
trajectories in CARLA's frame: x forward, y to the RIGHT, z up, meters, yaw in degrees clockwise seen from above.

exact  every agent is placed on its trajectory at every tick; physics off, so nothing drifts. CARLA then reports
       no velocity of vehicles; with --physics it does, and the pose is still set at every tick.
pid    vehicles follow their trajectories by throttle, brake and steering; walkers walk, all others are placed.
"""

from __future__ import annotations

import argparse
import bisect
import json
import math
import stat
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

VERSION = 2
NO_CLIENT = 5  # exit code
BoxPose = tuple[float, float, float, float]  # box center x, y, its lowest face z, yaw in rad
MARGIN_S = 1e-6
ANSWER_S = 10.0  # a running server reports its version at once, while loading a world takes long
STANDSTILL_MPS = 0.05  # slower motion is jitter of CARLA's physics
SPAWN_HEIGHTS_M = (0.3, 2.0, 5.0, 10.0, 20.0, 40.0)  # the place where an agent appears may be occupied
ROAD_WITHIN_M = 30.0
FALLEN_M = 5.0
KMH_PER_MPS = 3.6
SHOWN_DEG = 0.2
SUBSTEP_S, SUBSTEPS = 0.01, 10  # of CARLA's physics within a tick
SIZE_DIFFERS_M = 0.1
MAX_TEXT_BYTES = 512 * 1024 * 1024  # as of a scenario


class ReplayError(Exception):
    """An error that ends the replay; `code` is the exit code."""

    def __init__(self, text: str, code: int = 2) -> None:
        super().__init__(text)
        self.code = code


class SampledTrajectory:
    """Columns over time, interpolated linearly; the ends are held."""

    def __init__(self, columns: dict[str, list[float]]) -> None:
        self.columns, self.t_s = columns, columns["t_s"]

    def at(self, t_s: float, *names: str) -> tuple[float, ...]:
        """Interpolate the named columns at a time."""
        k = min(max(bisect.bisect_right(self.t_s, t_s) - 1, 0), len(self.t_s) - 1)
        after = min(k + 1, len(self.t_s) - 1)
        span = self.t_s[after] - self.t_s[k]
        share = min(max((t_s - self.t_s[k]) / span, 0.0), 1.0) if span > 0 else 0.0
        return tuple(c[k] + share * (c[after] - c[k]) for c in (self.columns[n] for n in names))

    def place(self, t_s: float) -> BoxPose:
        """Return the pose of the box at a time."""
        x, y, z, yaw_deg = self.at(t_s, "x_m", "y_m", "z_m", "yaw_deg")
        return x, y, z, math.radians(yaw_deg)


class CarlaActor:
    """A CARLA actor that represents an agent.

    Its origin need not be the center of its box, and its axles need not be where the agent's are.
    """

    def __init__(self, carla: ModuleType, agent: dict[str, Any], handle: Any, spawned_at: Any) -> None:
        self.carla, self.agent, self.handle = carla, agent, handle
        box = handle.bounding_box
        self.size_m = (2 * box.extent.x, 2 * box.extent.y, 2 * box.extent.z)
        self._box_x, self._box_y, self._bottom = box.location.x, box.location.y, box.location.z - box.extent.z
        self.is_walker = handle.type_id.startswith("walker.")
        self.is_vehicle = handle.type_id.startswith("vehicle.")
        self._measured = not self.is_vehicle
        if self.is_vehicle:
            physics, wheels = handle.get_physics_control(), carla.VehicleWheelLocation
            self.max_steer_rad = math.radians(max([w.max_steer_angle for w in physics.wheels], default=0.0) or 70.0)
            curve = sorted((p.x, p.y) for p in physics.steering_curve) or [(0.0, 1.0)]
            self._steering = SampledTrajectory({"t_s": [p[0] for p in curve], "share": [p[1] for p in curve]})
            self._front = (wheels.FL_Wheel, wheels.FR_Wheel) if len(physics.wheels) > 2 else (wheels.Front_Wheel,)
            self._shown_deg = 0.0
            self.wheelbase_m, self.axle_m = 0.6 * self.size_m[0], 0.3 * self.size_m[0]
            self._measure(physics, spawned_at)

    def _measure(self, physics: Any, at: Any) -> None:
        """Take wheelbase and rear axle from the wheels, once the server reports their positions."""
        forward = at.get_forward_vector()
        places: dict[bool, list[float]] = {True: [], False: []}
        for wheel in physics.wheels:  # their positions are world coordinates in centimeters
            x, y = wheel.position.x / 100 - at.location.x, wheel.position.y / 100 - at.location.y
            places[wheel.max_steer_angle > 0].append(x * forward.x + y * forward.y)
        if places[True] and places[False]:
            front, rear = (sum(p) / len(p) for p in (places[True], places[False]))
            self._measured = 0.4 * self.size_m[0] < front - rear < 0.9 * self.size_m[0]
            if self._measured:
                self.wheelbase_m, self.axle_m = front - rear, self._box_x - rear

    def transform(self, x: float, y: float, z: float, yaw: float) -> Any:
        """Return the actor's transform for which its box is centered at x, y and stands at z."""
        cos, sin = math.cos(yaw), math.sin(yaw)
        at_x, at_y = x - self._box_x * cos + self._box_y * sin, y - self._box_x * sin - self._box_y * cos
        place = self.carla.Location(x=at_x, y=at_y, z=z - self._bottom)
        return self.carla.Transform(place, self.carla.Rotation(pitch=0.0, yaw=wrapped_deg(yaw), roll=0.0))

    def pose(self) -> tuple[float, float, float, float, float]:
        """Return box center x, y, lowest face z, yaw in rad and speed along it, after the last tick."""
        transform, velocity = self.handle.get_transform(), self.handle.get_velocity()
        if not self._measured:
            self._measure(self.handle.get_physics_control(), transform)
            self._measured = True
        at, yaw = transform.location, math.radians(transform.rotation.yaw)
        cos, sin = math.cos(yaw), math.sin(yaw)
        x, y = at.x + self._box_x * cos - self._box_y * sin, at.y + self._box_x * sin + self._box_y * cos
        speed = velocity.x * cos + velocity.y * sin
        return x, y, at.z + self._bottom, yaw, speed if abs(speed) >= STANDSTILL_MPS else 0.0

    def show_steering(self, curvature: float) -> None:
        """Turn the front wheels visually, which CARLA allows while physics is off."""
        angle_deg = math.degrees(math.atan(self.wheelbase_m * curvature))
        if abs(angle_deg - self._shown_deg) > SHOWN_DEG:  # every call is one to the server
            self._shown_deg = angle_deg
            for wheel in self._front:
                self.handle.set_wheel_steer_direction(wheel, angle_deg)

    def control(self, pedal_mps2: float, curvature: float, speed: float, reverse: bool) -> Any:
        """Convert pedal and curvature to CARLA's inputs.

        Assumes that full throttle and full brake give the accelerations in the data, and inputs in between in
        proportion; the controller compensates for the difference. Steering is a share of full lock, which CARLA reduces
        with speed.
        """
        (share,) = self._steering.at(abs(speed) * KMH_PER_MPS, "share")
        steer = math.atan(self.wheelbase_m * curvature) / (self.max_steer_rad * max(share, 0.1))
        rolls_back = reverse if speed == 0 else speed < 0
        return self.carla.VehicleControl(
            throttle=clamp(pedal_mps2 / self.agent["max_throttle_mps2"], 0.0, 1.0),
            brake=clamp(-pedal_mps2 / self.agent["max_brake_mps2"], 0.0, 1.0),
            steer=clamp(steer, -1.0, 1.0),
            reverse=bool(rolls_back),
        )


class VehicleController:
    """PID with feed-forward for one vehicle, the scalar form of `log2sim.simulation.reference`; gains come with the data."""

    def __init__(
        self, gains: SimpleNamespace, max_throttle_mps2: float, max_brake_mps2: float, max_curvature_1pm: float
    ) -> None:
        self.gains = gains
        self.max_throttle, self.max_brake, self.max_curvature = max_throttle_mps2, max_brake_mps2, max_curvature_1pm
        self.along_integral = self.across_integral = self.along_rate = self.across_slope = 0.0

    def step(
        self, wanted: Sequence[float], at: tuple[float, float, float], speed: float, dt_s: float
    ) -> tuple[float, float, bool]:
        """Compute pedal in m/s2, curvature in 1/m and reverse, for a rear axle `at` x, y, yaw.

        `wanted` holds x, y, yaw, speed, acceleration, curvature, gear and standstill of the reference.
        """
        g = self.gains
        x, y, yaw, wanted_speed, accel, curvature, wanted_gear, stands = wanted
        dx, dy = x - at[0], y - at[1]
        along = clamp(math.cos(yaw) * dx + math.sin(yaw) * dy, -g.max_along_m, g.max_along_m)
        across = math.cos(yaw) * dy - math.sin(yaw) * dx + curvature * along**2 / 2
        slope = math.sin(yaw - curvature * along - at[2])
        blend = -math.expm1(-dt_s / g.derivative_filter_s)
        self.along_rate += blend * (wanted_speed - speed - self.along_rate)
        self.across_slope += blend * (slope - self.across_slope)
        gear = wanted_gear if speed == 0 else math.copysign(1.0, speed)
        push = accel + along / g.along_s**2 + 2 * g.damping * self.along_rate / g.along_s + self.along_integral
        pedal = clamp(push * gear, -self.max_brake, self.max_throttle)
        if stands > 0.5 and abs(speed) < g.hold_below_mps and along * wanted_gear < g.hold_within_m:
            pedal, self.along_integral = -g.hold_brake_mps2, 0.0  # the brake holds while the reference stands
        # Anti-windup: no integration while the actuator is at its limit, or the vehicle far behind.
        elif abs(along) < g.max_along_m and (pedal == push * gear or along * push <= 0):
            grown = self.along_integral + along * dt_s / (g.along_s**2 * g.integral_s)
            self.along_integral = clamp(grown, -g.integral_limit_mps2, g.integral_limit_mps2)
        length = max(abs(speed) * g.across_s, g.across_min_m)
        damped = 2 * g.damping * gear * self.across_slope / length
        turn = curvature + across / length**2 + damped + self.across_integral
        grip = g.max_lateral_accel_mps2 / max(speed**2, g.max_lateral_accel_mps2 / self.max_curvature)
        limited = clamp(turn, -grip, grip)
        if speed != 0 and (limited == turn or across * turn <= 0):
            self.across_integral += across * dt_s / (length**2 * g.integral_s)
        self.across_integral = clamp(self.across_integral, -g.integral_share * grip, g.integral_share * grip)
        return pedal, limited, wanted_gear < 0


class CarlaSession:
    """A CARLA world in synchronous mode and the actors in it; on exit they are removed and the settings restored."""

    def __init__(self, carla: ModuleType, client: Any, world: Any, dt_s: float) -> None:
        self.carla, self.client, self.world, self.dt_s = carla, client, world, dt_s
        self.library = world.get_blueprint_library()
        self.actors: dict[str, CarlaActor] = {}
        self.notes: list[str] = []

    def __enter__(self) -> CarlaSession:
        """Switch the world to synchronous mode."""
        self._before = self.world.get_settings()
        settings = self.world.get_settings()
        settings.synchronous_mode, settings.fixed_delta_seconds = True, self.dt_s
        settings.substepping, settings.max_substep_delta_time, settings.max_substeps = True, SUBSTEP_S, SUBSTEPS
        self.world.apply_settings(settings)
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the actors and restore the settings."""
        try:
            left = [self.carla.command.DestroyActor(a.handle.id) for a in self.actors.values()]
            self.actors.clear()
            self.client.apply_batch_sync(left, False)
        finally:
            self.world.apply_settings(self._before)

    def spawn(self, agent: dict[str, Any], place: BoxPose, physics: bool) -> CarlaActor:
        """Spawn the nearest asset that this server has above the place of an agent, in its color if possible.

        A command puts it on its place before the next tick.
        """
        names = [asset["blueprint"] for asset in agent["assets"]]
        found = [
            (library[0], a["size_m"]) for a in agent["assets"] if len(library := self.library.filter(a["blueprint"]))
        ]
        if not found:
            raise ReplayError(
                f"agent '{agent['id']}': this server has none of {', '.join(names)}; the data are for CARLA 0.9.16", 4
            )
        blueprint, size_m = found[0]
        settings = {"role_name": "hero" if agent["id"] == "ego" else agent["id"], "is_invincible": "true"}
        if agent["color"] is not None:
            settings["color"] = ",".join(str(c) for c in agent["color"])
        for name, value in settings.items():
            if blueprint.has_attribute(name):
                blueprint.set_attribute(name, value)
        x, y, z, yaw = place
        for height in SPAWN_HEIGHTS_M:
            turn = self.carla.Rotation(yaw=wrapped_deg(yaw))
            above = self.carla.Transform(self.carla.Location(x, y, z + height), turn)
            handle = self.world.try_spawn_actor(blueprint, above)
            if handle is not None:
                break
        else:
            raise ReplayError(f"agent '{agent['id']}': CARLA could not spawn {blueprint.id} at {x:.1f}, {y:.1f}", 4)
        actor = self.actors[agent["id"]] = CarlaActor(self.carla, agent, handle, above)
        if max(abs(a - b) for a, b in zip(actor.size_m, size_m)) > SIZE_DIFFERS_M:
            length, width, height = actor.size_m
            self.notes.append(
                f"note: agent '{agent['id']}': {blueprint.id} is {length:.2f} x {width:.2f} x {height:.2f} m on this server"
            )
        if not physics:
            self.send([self.carla.command.SetSimulatePhysics(handle.id, False)])
        return actor

    def remove(self, name: str) -> None:
        """Remove the actor of an agent."""
        self.send([self.carla.command.DestroyActor(self.actors.pop(name).handle.id)])

    def send(self, commands: list[Any]) -> None:
        """Execute commands before the next tick, in one call."""
        for answer in self.client.apply_batch_sync(commands, False) if commands else ():
            if answer.error:
                raise ReplayError(f"CARLA refused a command: {answer.error}", 4)

    def watch(self, place: BoxPose) -> None:
        """Put the spectator behind and above a place."""
        x, y, z, yaw = place
        at = self.carla.Location(x - 9.0 * math.cos(yaw), y - 9.0 * math.sin(yaw), z + 5.0)
        turn = self.carla.Rotation(pitch=-20.0, yaw=wrapped_deg(yaw))
        self.world.get_spectator().set_transform(self.carla.Transform(at, turn))


class ScenarioPlayer:
    """Moves the agents of a scenario tick by tick."""

    def __init__(self, session: CarlaSession, data: dict[str, Any], mode: str, *, physics: bool, ground: str) -> None:
        self.session, self.carla, self.pid, self.physics = session, session.carla, mode == "pid", physics
        self.agents: list[dict[str, Any]] = data["agents"]
        self.logged = {a["id"]: SampledTrajectory(a["exact"]) for a in self.agents}
        self.feasible = {a["id"]: SampledTrajectory(a["pid"]) for a in self.agents if a["pid"] is not None}
        self.controllers: dict[str, VehicleController] = {}
        self.drift_m: dict[str, list[float]] = {}
        self.gains = SimpleNamespace(**data.get("controller", {}))
        self._map = session.world.get_map() if ground == "map" else None

    def commands(self, t_s: float) -> list[Any]:
        """Return the commands for the tick that ends at a time of the scenario; agents appear and disappear."""
        commands: list[Any] = []
        for agent in self.agents:
            if agent["begin_s"] - MARGIN_S <= t_s <= agent["end_s"] + MARGIN_S:
                drives = self.pid and agent["drive"] is not None
                commands += self._drive(agent, t_s) if drives else self._place(agent, t_s)
            elif agent["id"] in self.session.actors:
                self.session.remove(agent["id"])
        return commands

    def _place(self, agent: dict[str, Any], t_s: float) -> Iterator[Any]:
        """Yield the commands that put an agent on its trajectory, with its velocity.

        Walkers, and vehicles with physics, move during the tick, so they start where their velocity leads to the place.
        """
        actor, rolls = self.session.actors.get(agent["id"]), self.physics and agent["drive"] == "vehicle"
        if actor is not None and agent["static"]:
            return
        x, y, z, yaw = self.grounded(agent, self.logged[agent["id"]].place(t_s))
        vx, vy = self._velocity(agent, t_s)
        if rolls or agent["drive"] == "walker":
            x, y = x - vx * self.session.dt_s, y - vy * self.session.dt_s
        actor = actor or self.session.spawn(agent, (x, y, z, yaw), rolls)
        yield self.carla.command.ApplyTransform(actor.handle.id, actor.transform(x, y, z, yaw))
        if actor.is_walker:
            yield self.walk(actor, vx, vy, yaw)
        elif actor.is_vehicle:
            yield self.carla.command.ApplyTargetVelocity(actor.handle.id, self.carla.Vector3D(vx, vy, 0.0))
            (curvature,) = self.logged[agent["id"]].at(t_s, "curvature_1pm")
            if rolls:
                control = actor.control(0.0, curvature, math.hypot(vx, vy), False)
                yield self.carla.command.ApplyVehicleControl(actor.handle.id, control)
            else:
                actor.show_steering(curvature)

    def _drive(self, agent: dict[str, Any], t_s: float) -> Iterator[Any]:
        """Yield the commands that let an agent drive or walk along its trajectory.

        Where it appears, and at a discontinuity of its trajectory, it is placed first.
        """
        name, now_s = agent["id"], t_s - self.session.dt_s
        actor, trajectory = self.session.actors.get(name), self.feasible.get(name, self.logged[name])
        vx, vy = self._velocity(agent, t_s)
        if actor is None or self._jumps(agent, now_s):
            x, y, z, yaw = self.grounded(agent, trajectory.place(t_s), falls=True)
            speed = math.hypot(vx, vy)
            if name in self.feasible:  # velocities from positions would start a standing vehicle with a jerk
                speed, stands = trajectory.at(t_s, "speed_mps", "stands")
                speed = 0.0 if stands > 0.5 else speed
                vx, vy = speed * math.cos(yaw), speed * math.sin(yaw)
            start = (x - vx * self.session.dt_s, y - vy * self.session.dt_s, z, yaw)
            actor = actor or self.session.spawn(agent, start, True)
            if actor.is_vehicle:
                limit = math.tan(min(actor.max_steer_rad, 1.4)) / actor.wheelbase_m
                most = agent["max_throttle_mps2"], agent["max_brake_mps2"], limit
                self.controllers[name] = VehicleController(self.gains, *most)
            yield self.carla.command.ApplyTransform(actor.handle.id, actor.transform(*start))
            yield self.carla.command.ApplyTargetVelocity(actor.handle.id, self.carla.Vector3D(vx, vy, 0.0))
            now_s = t_s  # the error is zero at the end of this tick
        else:
            x, y, z, yaw, speed = actor.pose()  # where physics has moved the agent
            logged = self.logged[name].place(now_s)
            self.require_ground(agent, z, logged)
            self.drift_m.setdefault(name, []).append(math.hypot(x - logged[0], y - logged[1]))
        if actor.is_walker:
            logged_x, logged_y, *_ = self.logged[name].place(now_s)
            catch_up = (logged_x - x) / self.gains.point_s, (logged_y - y) / self.gains.point_s
            yield self.walk(actor, vx + catch_up[0], vy + catch_up[1], yaw)
        else:  # the reference of the rear axle, with acceleration and curvature ahead by the lags of the actuators
            wanted_x, wanted_y, _, wanted_yaw = trajectory.place(now_s)
            axle = point_behind(wanted_x, wanted_y, wanted_yaw, actor.axle_m)
            wanted_speed, gear, stands = trajectory.at(now_s, "speed_mps", "gear", "stands")
            held_s = self.session.dt_s / 2
            (accel,) = trajectory.at(now_s + self.gains.pedal_lag_s + held_s, "accel_mps2")
            (bend,) = trajectory.at(now_s + self.gains.steer_lag_s + held_s, "curvature_1pm")
            wanted = (*axle, wanted_yaw, wanted_speed, accel, bend, gear, stands)
            at = (*point_behind(x, y, yaw, actor.axle_m), yaw)
            pedal, curvature, reverse = self.controllers[name].step(wanted, at, speed, self.session.dt_s)
            control = actor.control(pedal, curvature, speed, reverse)
            yield self.carla.command.ApplyVehicleControl(actor.handle.id, control)

    def walk(self, actor: CarlaActor, vx: float, vy: float, yaw: float) -> Any:
        """Return the command that lets a walker walk with a velocity, or stand with a heading."""
        speed = math.hypot(vx, vy)
        way = (vx / speed, vy / speed) if speed > STANDSTILL_MPS else (math.cos(yaw), math.sin(yaw))
        pace = speed if speed > STANDSTILL_MPS else 0.0
        control = self.carla.WalkerControl(self.carla.Vector3D(*way, 0.0), pace, False)
        return self.carla.command.ApplyWalkerControl(actor.handle.id, control)

    def _velocity(self, agent: dict[str, Any], t_s: float) -> tuple[float, float]:
        """Return the velocity of the tick that ends at a time; at the start and after a discontinuity, of the next one."""
        dt_s, trajectory = self.session.dt_s, self.logged[agent["id"]]
        begin_s = t_s - dt_s
        if begin_s < agent["begin_s"] - MARGIN_S or self._jumps(agent, begin_s):
            begin_s = t_s
        if begin_s + dt_s > agent["end_s"] + MARGIN_S or self._jumps(agent, begin_s):
            return 0.0, 0.0
        (x, y, *_), (next_x, next_y, *_) = trajectory.place(begin_s), trajectory.place(begin_s + dt_s)
        return (next_x - x) / dt_s, (next_y - y) / dt_s

    def _jumps(self, agent: dict[str, Any], t_s: float) -> bool:
        """Whether its trajectory has a discontinuity within the tick that begins at a time."""
        end_s = t_s + self.session.dt_s
        return any(t_s + MARGIN_S < jump_s <= end_s + MARGIN_S for jump_s in agent["discontinuities_s"])

    def grounded(self, agent: dict[str, Any], place: BoxPose, *, falls: bool = False) -> BoxPose:
        """Return the place at the height of the nearest road; without a road near, as it is, or an error if it `falls` then."""
        if self._map is None:
            return place
        x, y, z, yaw = place
        road = self._map.get_waypoint(self.carla.Location(x, y, z), True, self.carla.LaneType.Any)
        if road is not None:
            at = road.transform.location
            if math.hypot(at.x - x, at.y - y) <= ROAD_WITHIN_M:
                return x, y, at.z, yaw
        if falls:
            raise ReplayError(
                f"agent '{agent['id']}': no road within {ROAD_WITHIN_M:g} m of its place at {x:.1f}, {y:.1f}; give the map "
                "of its place (--map, --opendrive), or --ground log"
            )
        return place

    def require_ground(self, agent: dict[str, Any], z: float, place: BoxPose) -> None:
        """Raise `ReplayError` for an agent whose lowest face is far below its place."""
        below_m = self.grounded(agent, place)[2] - z
        if below_m > FALLEN_M:
            raise ReplayError(
                f"agent '{agent['id']}' fell {below_m:.0f} m: there is no road below it; give the map of its "
                "place (--map, --opendrive), or --mode exact",
                4,
            )


def point_behind(x: float, y: float, yaw: float, distance_m: float) -> tuple[float, float]:
    """Return the point that is `distance_m` behind a place."""
    return x - distance_m * math.cos(yaw), y - distance_m * math.sin(yaw)


def clamp(value: float, low: float, high: float) -> float:
    """Clip a value to limits."""
    return min(max(value, low), high)


def wrapped_deg(yaw_rad: float) -> float:
    """Convert to degrees in [-180, 180)."""
    return (math.degrees(yaw_rad) + 180.0) % 360.0 - 180.0


def load_client() -> ModuleType:
    """Import CARLA's Python client."""
    try:
        import carla
    except ImportError as error:
        raise ReplayError(f"CARLA's Python client is needed: pip install carla ({error})", NO_CLIENT) from None
    return carla  # type: ignore[no-any-return]


def connect(carla: ModuleType, host: str, port: int, timeout_s: float) -> Any:
    """Connect to a server and check that it answers."""
    client = carla.Client(host, port)
    patience_s = min(timeout_s, ANSWER_S)
    client.set_timeout(patience_s)
    try:
        client.get_server_version()
    except RuntimeError as error:
        raise ReplayError(
            f"no CARLA server answers at {host}:{port} within {patience_s:g} s ({error}); start one (CarlaUE4.sh), or give its "
            "--host and --port",
            3,
        ) from None
    client.set_timeout(timeout_s)
    return client


def open_world(carla: ModuleType, client: Any, town: str | None, opendrive: Path | None) -> Any:
    """Load a town or a world from an OpenDRIVE file, or return the present world."""
    try:
        if town is not None:
            return client.load_world(town)
        if opendrive is not None:
            # No walls beside the road: agents also move off it.
            parameters = carla.OpendriveGenerationParameters(2.0, 500.0, 0.0, 1.0, True, True)
            return client.generate_opendrive_world(read_text(opendrive), parameters)
    except RuntimeError as error:
        raise ReplayError(f"CARLA could not load {town or opendrive}: {error}", 4) from None
    except (OSError, UnicodeDecodeError) as error:
        raise ReplayError(f"{opendrive}: cannot be read: {error}", 3) from None
    return client.get_world()


def read_text(path: Path) -> str:
    """Read a text; `OSError` for what is no regular file, since a pipe or a device may never end, and for more than the limit."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError("is no regular file")
    with path.open("rb") as file:
        data = file.read(MAX_TEXT_BYTES + 1)
    if len(data) > MAX_TEXT_BYTES:
        raise OSError(f"has more than {MAX_TEXT_BYTES} bytes")
    return data.decode("utf-8")


def load_data(path: Path) -> dict[str, Any]:
    """Read the data file and check its format."""
    try:
        data = json.loads(read_text(path))
    except (OSError, ValueError) as error:
        raise ReplayError(f"{path}: cannot be read: {error}", 3) from None
    if not isinstance(data, dict) or data.get("format") != "log2sim-carla" or data.get("version") != VERSION:
        raise ReplayError(f"{path}: not the data of this script (format 'log2sim-carla', version {VERSION})", 3)
    return data


def play(player: ScenarioPlayer, data: dict[str, Any], *, follow: str, pace: float) -> None:
    """Run all ticks from the first time to the last."""
    agents, dt_s = data["agents"], player.session.dt_s
    begin_s, end_s = min(a["begin_s"] for a in agents), max(a["end_s"] for a in agents)
    watched = next((a for a in agents if a["id"] == follow), None)
    for k in range(math.floor((end_s - begin_s) / dt_s + MARGIN_S) + 1):
        started = time.monotonic()
        t_s = begin_s + k * dt_s
        player.session.send(player.commands(t_s))
        player.session.world.tick()
        if watched is not None and watched["begin_s"] <= t_s <= watched["end_s"]:
            player.session.watch(player.logged[follow].place(t_s))
        if pace > 0:
            time.sleep(max(dt_s / pace - (time.monotonic() - started), 0.0))


def print_now(text: str) -> None:
    """Print lines at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def arguments(words: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--map", metavar="TOWN", help="load this town first")
    road, add = Path(__file__).with_name("road.xodr"), parser.add_argument
    where.add_argument(
        "--opendrive", type=Path, nargs="?", const=road, metavar="FILE.xodr",
        help="make a world of this road network first (default: the one exported)",
    )  # fmt: skip
    add("--mode", choices=("exact", "pid"), help="as in the scenario, or driven along it (default: as exported)")
    add("--host", default="127.0.0.1")
    add("--port", type=int, default=2000)
    patience = "how long the server may take, e.g. to load a world"
    add("--timeout", type=float, default=60.0, metavar="S", help=patience)
    add("--dt", type=float, default=0.05, metavar="S", help="length of a tick, at most 0.1")
    add("--physics", action="store_true", help="with exact: leave physics on, so that velocities are seen")
    heights = "heights from the scenario (log; exact) or the nearest road (map; pid)"
    add("--ground", choices=("log", "map"), help=heights)
    add("--follow", default="ego", metavar="ID", help="agent that the spectator follows, or 'none'")
    add("--pace", type=float, default=1.0, help="1 is real time, 0 as fast as the server can")
    add("--table", action="store_true", help="print the table of assets and end")
    add("--data", type=Path, default=Path(__file__).with_name("scenario_carla.json"), metavar="FILE")
    parsed = parser.parse_args(words)
    if not 0 < parsed.dt <= 0.1:
        parser.error(
            f"--dt: {parsed.dt:g} s, expected more than 0 and at most 0.1, which is as far as CARLA's physics goes"
        )
    return parsed


def run(words: Sequence[str] | None = None) -> None:
    """Execute the command line."""
    args = arguments(words)
    data = load_data(args.data)
    # The asset of each agent, and by how much it is longer, wider and higher.
    width = max(len(a["id"]) for a in data["agents"])
    print_now(f"{'agent':{width}}  {'length width height m':>21}  {'error of the asset m':>21}  asset")
    for a in data["agents"]:
        asset, size = a["assets"][0], " ".join(f"{v:6.2f}" for v in a["size_m"])
        error = " ".join(f"{v:+6.2f}" for v in asset["error_m"])
        print_now(f"{a['id']:{width}}  {size:>21}  {error:>21}  {asset['blueprint']}")
    if args.table:
        return
    mode = args.mode or data["mode"]
    carla = load_client()
    client = connect(carla, args.host, args.port, args.timeout)
    world = open_world(carla, client, args.map, args.opendrive)
    with CarlaSession(carla, client, world, args.dt) as session:
        ground = args.ground or ("map" if mode == "pid" else "log")
        player = ScenarioPlayer(session, data, mode, physics=args.physics, ground=ground)
        play(player, data, follow=args.follow, pace=args.pace)
    server, own = client.get_server_version(), client.get_client_version()
    if server != own:
        print_now(f"note: the server is CARLA {server}, this client {own}; install carla=={server} if something fails")
    for note in session.notes:
        print_now(note)
    for name, values in player.drift_m.items():
        rms = math.sqrt(sum(v * v for v in values) / len(values))
        print_now(f"{name}: {rms:.2f} m rms, {max(values):.2f} m at most from the scenario")


def main(words: Sequence[str] | None = None) -> int:
    """Run, and report an error in one line."""
    try:
        run(words)
    except ReplayError as error:
        sys.stderr.write(f"replay_carla: {error}\n")
        return error.code
    except RuntimeError as error:  # what the client raises when the server is gone
        sys.stderr.write(f"replay_carla: {error}\n")
        return 3
    except KeyboardInterrupt:
        sys.stderr.write("replay_carla: stopped; the agents are removed and the settings restored\n")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
