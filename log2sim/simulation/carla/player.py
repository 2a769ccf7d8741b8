#!/usr/bin/env python3
"""Replay a driving log in CARLA: `python replay_carla.py [--mode exact|pid] [--opendrive | --map TOWN]`.

Needs a running CARLA 0.9.x server and its Python client (`pip install carla`), nothing else. Who drives where stands in the
data file, in CARLA's frame: x forward, y to the RIGHT, z up, meters, yaw in degrees clockwise seen from above.

exact  every agent is where the log has it at every tick; physics off, so nothing drifts. CARLA then reports no velocity
       of vehicles; with --physics it does, and the pose is set at every tick all the same.
pid    vehicles drive along the log by throttle, brake and steering; walkers walk, all others are placed.
"""

from __future__ import annotations

import argparse
import bisect
import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

VERSION = 1
NO_CLIENT = 5  # exit code
BoxPose = tuple[float, float, float, float]  # box center x, y, its lowest face z, yaw in rad
MARGIN_S = 1e-6
ANSWER_S = 10.0  # a server that is there says its version at once, while a world takes long to load
STANDSTILL_MPS = 0.05  # physics never rests entirely
SPAWN_HEIGHTS_M = (0.3, 2.0, 5.0, 10.0, 20.0, 40.0)  # something may stand where an agent appears
ROAD_WITHIN_M = 30.0
FALLEN_M = 5.0
KMH_PER_MPS = 3.6
SHOWN_DEG = 0.2
SUBSTEP_S, SUBSTEPS = 0.01, 10  # of CARLA's physics within a tick
SIZE_DIFFERS_M = 0.1

# The controller of log2sim's own simulator: time constants in s, lengths in m.
ALONG_S, ACROSS_S, ACROSS_MIN_M, INTEGRAL_S, FILTER_S, DAMPING = 0.6, 0.6, 1.5, 4.0, 0.05, 1.0
HOLD_WITHIN_M, HOLD_BRAKE_MPS2, GRIP_MPS2, MAX_ALONG_M = 0.1, 2.0, 9.0, 3.0
INTEGRAL_MPS2, INTEGRAL_SHARE = 1.0, 0.2  # limits of the integrals, the latter as a share of the curvature with grip
AHEAD_S = 0.1  # how far feed-forward runs ahead: the lag of pedals and steering
WALKER_S = 0.3


class ReplayError(Exception):
    """What keeps a replay from running; `code` is the exit code."""

    def __init__(self, text: str, code: int = 2) -> None:
        super().__init__(text)
        self.code = code


class SampledTrajectory:
    """Columns over time, linear in between, held before the first time and after the last."""

    def __init__(self, columns: dict[str, list[float]]) -> None:
        self.columns, self.t_s = columns, columns["t_s"]

    def at(self, t_s: float, *names: str) -> tuple[float, ...]:
        """The named columns at a time."""
        k = min(max(bisect.bisect_right(self.t_s, t_s) - 1, 0), len(self.t_s) - 1)
        after = min(k + 1, len(self.t_s) - 1)
        span = self.t_s[after] - self.t_s[k]
        share = min(max((t_s - self.t_s[k]) / span, 0.0), 1.0) if span > 0 else 0.0
        return tuple(c[k] + share * (c[after] - c[k]) for c in (self.columns[n] for n in names))

    def place(self, t_s: float) -> BoxPose:
        """Where the box is."""
        x, y, z, yaw_deg = self.at(t_s, "x_m", "y_m", "z_m", "yaw_deg")
        return x, y, z, math.radians(yaw_deg)


class CarlaActor:
    """A CARLA actor that stands for an agent. Its origin need not be where its box is, and no asset has the agent's axles."""

    def __init__(self, carla: ModuleType, agent: dict[str, Any], actor: Any, spawned: Any) -> None:
        self.carla, self.agent, self.actor = carla, agent, actor
        box = actor.bounding_box
        self.size_m = (2 * box.extent.x, 2 * box.extent.y, 2 * box.extent.z)
        self._box_x, self._box_y, self._bottom = box.location.x, box.location.y, box.location.z - box.extent.z
        self.is_walker = actor.type_id.startswith("walker.")
        self.is_vehicle = actor.type_id.startswith("vehicle.")
        self._measured = not self.is_vehicle
        if self.is_vehicle:
            physics, wheels = actor.get_physics_control(), carla.VehicleWheelLocation
            self.max_steer_rad = math.radians(max([w.max_steer_angle for w in physics.wheels], default=0.0) or 70.0)
            curve = sorted((p.x, p.y) for p in physics.steering_curve) or [(0.0, 1.0)]
            self._steering = SampledTrajectory({"t_s": [p[0] for p in curve], "share": [p[1] for p in curve]})
            self._front = (wheels.FL_Wheel, wheels.FR_Wheel) if len(physics.wheels) > 2 else (wheels.Front_Wheel,)
            self._shown_deg = 0.0
            self.wheelbase_m, self.axle_m = 0.6 * self.size_m[0], 0.3 * self.size_m[0]
            self._measure(physics, spawned)

    def _measure(self, physics: Any, at: Any) -> None:
        """Wheelbase and the way from rear axle to box center, once the server knows where the wheels are."""
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
        """Where the actor has to be for its box to be centered at x, y, and to stand at z."""
        cos, sin = math.cos(yaw), math.sin(yaw)
        return self.carla.Transform(
            self.carla.Location(
                x=x - self._box_x * cos + self._box_y * sin,
                y=y - self._box_x * sin - self._box_y * cos,
                z=z - self._bottom,
            ),
            self.carla.Rotation(pitch=0.0, yaw=wrapped_deg(yaw), roll=0.0),
        )

    def pose(self) -> tuple[float, float, float, float, float]:
        """Box center x, y, lowest face z, yaw in rad and speed along it, after the last tick."""
        transform, velocity = self.actor.get_transform(), self.actor.get_velocity()
        if not self._measured:
            self._measure(self.actor.get_physics_control(), transform)
            self._measured = True
        at, yaw = transform.location, math.radians(transform.rotation.yaw)
        cos, sin = math.cos(yaw), math.sin(yaw)
        x, y = at.x + self._box_x * cos - self._box_y * sin, at.y + self._box_x * sin + self._box_y * cos
        speed = velocity.x * cos + velocity.y * sin
        return x, y, at.z + self._bottom, yaw, speed if abs(speed) >= STANDSTILL_MPS else 0.0

    def steer_angle(self, curvature: float) -> float:
        """Angle of the front wheels in rad that drives a curvature."""
        return math.atan(self.wheelbase_m * curvature)

    def show_steering(self, curvature: float) -> None:
        """Turn the looks of the front wheels, which CARLA allows while physics is off."""
        angle_deg = math.degrees(self.steer_angle(curvature))
        if abs(angle_deg - self._shown_deg) > SHOWN_DEG:  # every call is one to the server
            self._shown_deg = angle_deg
            for wheel in self._front:
                self.actor.set_wheel_steer_direction(wheel, angle_deg)

    def control(self, pedal_mps2: float, curvature: float, speed: float, reverse: bool) -> Any:
        """Pedal and curvature as CARLA's inputs.

        Assumes that full throttle and full brake give the accelerations in the data, and all in between in proportion; the
        controller makes up for what they do not. Steering is a share of full lock, of which CARLA leaves less at speed.
        """
        (share,) = self._steering.at(abs(speed) * KMH_PER_MPS, "share")
        steer = self.steer_angle(curvature) / (self.max_steer_rad * max(share, 0.1))
        rolls_back = reverse if speed == 0 else speed < 0
        return self.carla.VehicleControl(
            throttle=clamp(pedal_mps2 / self.agent["max_throttle_mps2"], 0.0, 1.0),
            brake=clamp(-pedal_mps2 / self.agent["max_brake_mps2"], 0.0, 1.0),
            steer=clamp(steer, -1.0, 1.0),
            reverse=bool(rolls_back),
        )


class VehicleController:
    """PID with feed-forward for one vehicle: pedal from the error along the path, curvature from the error across it."""

    def __init__(self, max_throttle_mps2: float, max_brake_mps2: float, max_curvature_1pm: float) -> None:
        self.max_throttle, self.max_brake, self.max_curvature = max_throttle_mps2, max_brake_mps2, max_curvature_1pm
        self.along_integral = self.across_integral = self.along_rate = self.across_slope = 0.0

    @classmethod
    def of(cls, body: CarlaActor) -> VehicleController:
        """A fresh one for an actor."""
        limit = math.tan(min(body.max_steer_rad, 1.4)) / body.wheelbase_m
        return cls(body.agent["max_throttle_mps2"], body.agent["max_brake_mps2"], limit)

    def step(
        self, wanted: Sequence[float], at: tuple[float, float, float], speed: float, dt_s: float
    ) -> tuple[float, float, bool]:
        """Pedal in m/s2, curvature in 1/m and reverse, for a rear axle `at` x, y, yaw.

        `wanted` is x, y, yaw, speed, acceleration, curvature, gear and stands of the course.
        """
        x, y, yaw, course_speed, accel, curvature, course_gear, stands = wanted
        dx, dy = x - at[0], y - at[1]
        along = clamp(math.cos(yaw) * dx + math.sin(yaw) * dy, -MAX_ALONG_M, MAX_ALONG_M)
        across = math.cos(yaw) * dy - math.sin(yaw) * dx + curvature * along**2 / 2
        slope = math.sin(yaw - curvature * along - at[2])
        blend = -math.expm1(-dt_s / FILTER_S)
        self.along_rate += blend * (course_speed - speed - self.along_rate)
        self.across_slope += blend * (slope - self.across_slope)
        gear = course_gear if speed == 0 else math.copysign(1.0, speed)
        held = stands > 0.5 and abs(speed) < STANDSTILL_MPS and along * course_gear < HOLD_WITHIN_M
        pedal = self._pedal(along, accel, gear, held, dt_s)
        return pedal, self._curvature(across, gear * self.across_slope, curvature, speed, dt_s), course_gear < 0

    def _pedal(self, along: float, accel: float, gear: float, held: bool, dt_s: float) -> float:
        """Pedal in m/s2: PID on the error along the path; the brake is held while the course stands."""
        wanted = accel + along / ALONG_S**2 + 2 * DAMPING * self.along_rate / ALONG_S + self.along_integral
        limited = clamp(wanted * gear, -self.max_brake, self.max_throttle)
        if held:
            self.along_integral = 0.0
            return -HOLD_BRAKE_MPS2
        # At its limit an actuator learns nothing from more error, nor does a vehicle that is far behind.
        if abs(along) < MAX_ALONG_M and (limited == wanted * gear or along * wanted <= 0):
            grown = self.along_integral + along * dt_s / (ALONG_S**2 * INTEGRAL_S)
            self.along_integral = clamp(grown, -INTEGRAL_MPS2, INTEGRAL_MPS2)
        return limited

    def _curvature(self, across: float, slope: float, curvature: float, speed: float, dt_s: float) -> float:
        """Curvature in 1/m: PID on the error across the path, within lock and grip."""
        length = max(abs(speed) * ACROSS_S, ACROSS_MIN_M)
        wanted = curvature + across / length**2 + 2 * DAMPING * slope / length + self.across_integral
        grip = GRIP_MPS2 / max(speed**2, GRIP_MPS2 / self.max_curvature)
        limited = clamp(wanted, -grip, grip)
        if speed != 0 and (limited == wanted or across * wanted <= 0):
            self.across_integral += across * dt_s / (length**2 * INTEGRAL_S)
        self.across_integral = clamp(self.across_integral, -INTEGRAL_SHARE * grip, INTEGRAL_SHARE * grip)
        return limited


class CarlaSession:
    """A CARLA world in synchronous mode, and the actors in it; leaving it removes them and restores the settings."""

    def __init__(self, carla: ModuleType, client: Any, world: Any, dt_s: float) -> None:
        self.carla, self.client, self.world, self.dt_s = carla, client, world, dt_s
        self.library = world.get_blueprint_library()
        self.bodies: dict[str, CarlaActor] = {}
        self.notes: list[str] = []

    def __enter__(self) -> CarlaSession:
        self._before = self.world.get_settings()
        settings = self.world.get_settings()
        settings.synchronous_mode, settings.fixed_delta_seconds = True, self.dt_s
        settings.substepping, settings.max_substep_delta_time, settings.max_substeps = True, SUBSTEP_S, SUBSTEPS
        self.world.apply_settings(settings)
        return self

    def __exit__(self, *_: object) -> None:
        try:
            left = [self.carla.command.DestroyActor(b.actor.id) for b in self.bodies.values()]
            self.bodies.clear()
            self.client.apply_batch_sync(left, False)
        finally:
            self.world.apply_settings(self._before)

    def spawn(self, agent: dict[str, Any], place: BoxPose, physics: bool) -> CarlaActor:
        """Make the actor of an agent, above its place; it is put there by a command before the next tick."""
        blueprint, size_m = self._blueprint(agent)
        x, y, z, yaw = place
        for height in SPAWN_HEIGHTS_M:
            above = self.carla.Transform(
                self.carla.Location(x, y, z + height), self.carla.Rotation(yaw=wrapped_deg(yaw))
            )
            actor = self.world.try_spawn_actor(blueprint, above)
            if actor is not None:
                break
        else:
            raise ReplayError(f"agent '{agent['id']}': CARLA could not spawn {blueprint.id} at {x:.1f}, {y:.1f}", 4)
        body = self.bodies[agent["id"]] = CarlaActor(self.carla, agent, actor, above)
        if max(abs(a - b) for a, b in zip(body.size_m, size_m)) > SIZE_DIFFERS_M:
            length, width, height = body.size_m
            self.notes.append(
                f"note: agent '{agent['id']}': {blueprint.id} is {length:.2f} x {width:.2f} x {height:.2f} m on this server"
            )
        if not physics:
            self.send([self.carla.command.SetSimulatePhysics(actor.id, False)])
        return body

    def _blueprint(self, agent: dict[str, Any]) -> tuple[Any, Sequence[float]]:
        """The nearest asset that this server has, in the agent's color where it can be painted, and its size as exported."""
        for asset in agent["assets"]:
            found = self.library.filter(asset["blueprint"])
            if len(found):
                blueprint, size_m = found[0], asset["size_m"]
                break
        else:
            names = ", ".join(a["blueprint"] for a in agent["assets"])
            raise ReplayError(
                f"agent '{agent['id']}': this server has none of {names}; the data are for CARLA 0.9.16", 4
            )
        settings = {"role_name": "hero" if agent["id"] == "ego" else agent["id"], "is_invincible": "true"}
        if agent["color"] is not None:
            settings["color"] = ",".join(str(c) for c in agent["color"])
        for name, value in settings.items():
            if blueprint.has_attribute(name):
                blueprint.set_attribute(name, value)
        return blueprint, size_m

    def remove(self, name: str) -> None:
        """Take an agent's actor out of the world."""
        self.send([self.carla.command.DestroyActor(self.bodies.pop(name).actor.id)])

    def send(self, commands: list[Any]) -> None:
        """Carry out commands before the next tick, all in one call."""
        for answer in self.client.apply_batch_sync(commands, False) if commands else ():
            if answer.error:
                raise ReplayError(f"CARLA refused a command: {answer.error}", 4)

    def watch(self, place: BoxPose) -> None:
        """Put the spectator behind and above a place."""
        x, y, z, yaw = place
        at = self.carla.Location(x - 9.0 * math.cos(yaw), y - 9.0 * math.sin(yaw), z + 5.0)
        self.world.get_spectator().set_transform(
            self.carla.Transform(at, self.carla.Rotation(pitch=-20.0, yaw=wrapped_deg(yaw)))
        )


class ScenarioPlayer:
    """Moves the agents of a scenario, tick by tick."""

    def __init__(self, stage: CarlaSession, data: dict[str, Any], mode: str, *, physics: bool, ground: str) -> None:
        self.stage, self.carla, self.pid, self.physics = stage, stage.carla, mode == "pid", physics
        self.agents: list[dict[str, Any]] = data["agents"]
        self.logged = {a["id"]: SampledTrajectory(a["exact"]) for a in self.agents}
        self.courses = {a["id"]: SampledTrajectory(a["pid"]) for a in self.agents if a["pid"] is not None}
        self.followers: dict[str, VehicleController] = {}
        self.drift_m: dict[str, list[float]] = {}
        self._map = stage.world.get_map() if ground == "map" else None

    def commands(self, t_s: float) -> list[Any]:
        """What makes the next tick end with the world at a time of the log; agents come and go."""
        commands: list[Any] = []
        for agent in self.agents:
            if agent["begin_s"] - MARGIN_S <= t_s <= agent["end_s"] + MARGIN_S:
                drives = self.pid and agent["drive"] is not None
                commands += self._drive(agent, t_s) if drives else self._place(agent, t_s)
            elif agent["id"] in self.stage.bodies:
                self.stage.remove(agent["id"])
        return commands

    def _place(self, agent: dict[str, Any], t_s: float) -> Iterator[Any]:
        """Commands that put an agent where the log has it, with its velocity.

        What moves during the tick, walkers and vehicles with physics, starts from where its velocity leads to the place.
        """
        body, rolls = self.stage.bodies.get(agent["id"]), self.physics and agent["drive"] == "vehicle"
        if body is not None and agent["static"]:
            return
        x, y, z, yaw = self.grounded(agent, self.logged[agent["id"]].place(t_s))
        vx, vy = self._velocity(agent, t_s)
        if rolls or agent["drive"] == "walker":
            x, y = x - vx * self.stage.dt_s, y - vy * self.stage.dt_s
        body = body or self.stage.spawn(agent, (x, y, z, yaw), rolls)
        yield self.carla.command.ApplyTransform(body.actor.id, body.transform(x, y, z, yaw))
        if body.is_walker:
            yield self.walk(body, vx, vy, yaw)
        elif body.is_vehicle:
            yield self.carla.command.ApplyTargetVelocity(body.actor.id, self.carla.Vector3D(vx, vy, 0.0))
            (curvature,) = self.logged[agent["id"]].at(t_s, "curvature_1pm")
            if rolls:
                control = body.control(0.0, curvature, math.hypot(vx, vy), False)
                yield self.carla.command.ApplyVehicleControl(body.actor.id, control)
            else:
                body.show_steering(curvature)

    def _drive(self, agent: dict[str, Any], t_s: float) -> Iterator[Any]:
        """Commands that let an agent drive or walk along the log; where it appears or the log leaps it is placed first."""
        name, now_s = agent["id"], t_s - self.stage.dt_s
        body, course = self.stage.bodies.get(name), self.courses.get(name, self.logged[name])
        vx, vy = self._velocity(agent, t_s)
        if body is None or self._leaps(agent, now_s):
            x, y, z, yaw = self.grounded(agent, course.place(t_s), falls=True)
            speed = math.hypot(vx, vy)
            if name in self.courses:  # differences of positions would let a standing vehicle start with a jerk
                speed, stands = course.at(t_s, "speed_mps", "stands")
                speed = 0.0 if stands > 0.5 else speed
                vx, vy = speed * math.cos(yaw), speed * math.sin(yaw)
            start = (x - vx * self.stage.dt_s, y - vy * self.stage.dt_s, z, yaw)
            body = body or self.stage.spawn(agent, start, True)
            if body.is_vehicle:
                self.followers[name] = VehicleController.of(body)
            yield self.carla.command.ApplyTransform(body.actor.id, body.transform(*start))
            yield self.carla.command.ApplyTargetVelocity(body.actor.id, self.carla.Vector3D(vx, vy, 0.0))
            now_s = t_s  # the error is none at the end of this tick, so neither is it now
        else:
            x, y, yaw, speed = self._found(agent, body, now_s)
        if body.is_walker:
            logged_x, logged_y, *_ = self.logged[name].place(now_s)
            yield self.walk(body, vx + (logged_x - x) / WALKER_S, vy + (logged_y - y) / WALKER_S, yaw)
        else:
            wanted, axle = self._wanted(course, body.axle_m, now_s), point_behind(x, y, yaw, body.axle_m)
            pedal, curvature, reverse = self.followers[name].step(wanted, (*axle, yaw), speed, self.stage.dt_s)
            control = body.control(pedal, curvature, speed, reverse)
            yield self.carla.command.ApplyVehicleControl(body.actor.id, control)

    def _found(self, agent: dict[str, Any], body: CarlaActor, t_s: float) -> BoxPose:
        """Where physics has brought an agent: box center x, y, yaw and speed."""
        x, y, z, yaw, speed = body.pose()
        logged = self.logged[agent["id"]].place(t_s)
        self.require_ground(agent, z, logged)
        self.drift_m.setdefault(agent["id"], []).append(math.hypot(x - logged[0], y - logged[1]))
        return x, y, yaw, speed

    def _wanted(self, course: SampledTrajectory, axle_m: float, t_s: float) -> tuple[float, ...]:
        """The course of the rear axle at a time, with acceleration and curvature of the moment that inputs are for."""
        x, y, _, yaw = course.place(t_s)
        speed, gear, stands = course.at(t_s, "speed_mps", "gear", "stands")
        accel, curvature = course.at(t_s + AHEAD_S + self.stage.dt_s / 2, "accel_mps2", "curvature_1pm")
        return (*point_behind(x, y, yaw, axle_m), yaw, speed, accel, curvature, gear, stands)

    def walk(self, body: CarlaActor, vx: float, vy: float, yaw: float) -> Any:
        """The command that lets a walker go with a velocity, or stand looking ahead."""
        speed = math.hypot(vx, vy)
        way = (vx / speed, vy / speed) if speed > STANDSTILL_MPS else (math.cos(yaw), math.sin(yaw))
        control = self.carla.WalkerControl(
            self.carla.Vector3D(*way, 0.0), speed if speed > STANDSTILL_MPS else 0.0, False
        )
        return self.carla.command.ApplyWalkerControl(body.actor.id, control)

    def _velocity(self, agent: dict[str, Any], t_s: float) -> tuple[float, float]:
        """Velocity of the log within the tick that ends at a time, at the begin of a life and after a leap of the next one."""
        dt_s, course = self.stage.dt_s, self.logged[agent["id"]]
        begin_s = t_s - dt_s
        if begin_s < agent["begin_s"] - MARGIN_S or self._leaps(agent, begin_s):
            begin_s = t_s
        if begin_s + dt_s > agent["end_s"] + MARGIN_S or self._leaps(agent, begin_s):
            return 0.0, 0.0
        (x, y, *_), (next_x, next_y, *_) = course.place(begin_s), course.place(begin_s + dt_s)
        return (next_x - x) / dt_s, (next_y - y) / dt_s

    def _leaps(self, agent: dict[str, Any], t_s: float) -> bool:
        """Whether the log leaps within the tick that begins at a time."""
        return any(t_s + MARGIN_S < leap_s <= t_s + self.stage.dt_s + MARGIN_S for leap_s in agent["leaps_s"])

    def grounded(self, agent: dict[str, Any], place: BoxPose, *, falls: bool = False) -> BoxPose:
        """The place at the height of the nearest road; as logged where there is none near, unless the agent `falls` then."""
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
                f"agent '{agent['id']}': no road within {ROAD_WITHIN_M:g} m of its place at {x:.1f}, {y:.1f}; give the map that "
                "the log was driven on (--map, --opendrive), or --ground log"
            )
        return place

    def require_ground(self, agent: dict[str, Any], z: float, place: BoxPose) -> None:
        """Raise `ReplayError` for an agent whose lowest face is far below its place."""
        below_m = self.grounded(agent, place)[2] - z
        if below_m > FALLEN_M:
            raise ReplayError(
                f"agent '{agent['id']}' fell {below_m:.0f} m: there is no road below it; give the map that the log was driven "
                "on (--map, --opendrive), or --mode exact",
                4,
            )


def point_behind(x: float, y: float, yaw: float, way_m: float) -> tuple[float, float]:
    """The point so far behind a place."""
    return x - way_m * math.cos(yaw), y - way_m * math.sin(yaw)


def clamp(value: float, low: float, high: float) -> float:
    """The value within limits."""
    return min(max(value, low), high)


def wrapped_deg(yaw_rad: float) -> float:
    """Degrees in [-180, 180)."""
    return (math.degrees(yaw_rad) + 180.0) % 360.0 - 180.0


def load_client() -> ModuleType:
    """CARLA's Python client."""
    try:
        import carla
    except ImportError as error:
        raise ReplayError(f"CARLA's Python client is needed: pip install carla ({error})", NO_CLIENT) from None
    return carla


def connect(carla: ModuleType, host: str, port: int, timeout_s: float) -> Any:
    """A client of a server that answers."""
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


def version_note(client: Any) -> list[str]:
    """What to know when server and client are of different versions."""
    server, own = client.get_server_version(), client.get_client_version()
    if server == own:
        return []
    return [f"note: the server is CARLA {server}, this client {own}; install carla=={server} if something fails"]


def open_world(carla: ModuleType, client: Any, town: str | None, opendrive: Path | None) -> Any:
    """The world to play in: a town, one made from an OpenDRIVE file, or what the server shows now."""
    try:
        if town is not None:
            return client.load_world(town)
        if opendrive is not None:
            # No walls beside the road: agents also move off it.
            parameters = carla.OpendriveGenerationParameters(2.0, 500.0, 0.0, 1.0, True, True)
            return client.generate_opendrive_world(opendrive.read_text(encoding="utf-8"), parameters)
    except RuntimeError as error:
        raise ReplayError(f"CARLA could not load {town or opendrive}: {error}", 4) from None
    except (OSError, UnicodeDecodeError) as error:
        raise ReplayError(f"{opendrive}: cannot be read: {error}", 3) from None
    return client.get_world()


def load_data(path: Path) -> dict[str, Any]:
    """The data file, after a look at what it says it is."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ReplayError(f"{path}: cannot be read: {error}", 3) from None
    if not isinstance(data, dict) or data.get("format") != "log2sim-carla" or data.get("version") != VERSION:
        raise ReplayError(f"{path}: not the data of this script (format 'log2sim-carla', version {VERSION})", 3)
    return data


def size_table(data: dict[str, Any]) -> str:
    """Which asset stands for which agent, and by how much it is longer, wider and higher."""
    width = max(len(a["id"]) for a in data["agents"])
    lines = [f"{'agent':{width}}  {'length width height m':>21}  {'error of the asset m':>21}  asset"]
    for a in data["agents"]:
        own, asset = a["size_m"], a["assets"][0]
        size, error = " ".join(f"{v:6.2f}" for v in own), " ".join(f"{v:+6.2f}" for v in asset["error_m"])
        lines.append(f"{a['id']:{width}}  {size:>21}  {error:>21}  {asset['blueprint']}")
    return "\n".join(lines)


def drift_table(drift_m: dict[str, list[float]]) -> str:
    """How far driven agents were from the log."""
    lines = []
    for name, values in drift_m.items():
        rms = math.sqrt(sum(v * v for v in values) / len(values))
        lines.append(f"{name}: {rms:.2f} m rms, {max(values):.2f} m at most from the log")
    return "\n".join(lines)


def play(player: ScenarioPlayer, data: dict[str, Any], *, follow: str, pace: float) -> None:
    """All ticks from the first moment to the last."""
    agents, dt_s = data["agents"], player.stage.dt_s
    begin_s, end_s = min(a["begin_s"] for a in agents), max(a["end_s"] for a in agents)
    watched = next((a for a in agents if a["id"] == follow), None)
    for k in range(math.floor((end_s - begin_s) / dt_s + MARGIN_S) + 1):
        started = time.monotonic()
        t_s = begin_s + k * dt_s
        player.stage.send(player.commands(t_s))
        player.stage.world.tick()
        if watched is not None and watched["begin_s"] <= t_s <= watched["end_s"]:
            player.stage.watch(player.logged[follow].place(t_s))
        if pace > 0:
            time.sleep(max(dt_s / pace - (time.monotonic() - started), 0.0))


def print_now(text: str) -> None:
    """Print lines for the user, at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def arguments(words: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--map", metavar="TOWN", help="load this town first")
    road = Path(__file__).with_name("road.xodr")
    where.add_argument(
        "--opendrive",
        type=Path,
        nargs="?",
        const=road,
        metavar="FILE.xodr",
        help="make a world of this road network first (default: the one exported)",
    )
    parser.add_argument(
        "--mode", choices=("exact", "pid"), help="as logged, or driven along the log (default: as exported)"
    )
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=2000)
    parser.add_argument(
        "--timeout", type=float, default=60.0, metavar="S", help="how long the server may take, e.g. to load a world"
    )
    parser.add_argument("--dt", type=float, default=0.05, metavar="S", help="length of a tick, at most 0.1")
    parser.add_argument(
        "--physics", action="store_true", help="with exact: leave physics on, so that velocities are seen"
    )
    parser.add_argument(
        "--ground", choices=("log", "map"), help="heights from the log (exact) or the nearest road (pid)"
    )
    parser.add_argument("--follow", default="ego", metavar="ID", help="agent that the spectator follows, or 'none'")
    parser.add_argument("--pace", type=float, default=1.0, help="1 is real time, 0 as fast as the server can")
    parser.add_argument("--table", action="store_true", help="print the table of assets and end")
    parser.add_argument("--data", type=Path, default=Path(__file__).with_name("scenario_carla.json"), metavar="FILE")
    parsed = parser.parse_args(words)
    if not 0 < parsed.dt <= 0.1:
        parser.error(
            f"--dt: {parsed.dt:g} s, expected more than 0 and at most 0.1, which is as far as CARLA's physics goes"
        )
    return parsed


def run(words: Sequence[str] | None = None) -> None:
    """Do what the command line says."""
    args = arguments(words)
    data = load_data(args.data)
    print_now(size_table(data))
    if args.table:
        return
    mode = args.mode or data["mode"]
    carla = load_client()
    client = connect(carla, args.host, args.port, args.timeout)
    world = open_world(carla, client, args.map, args.opendrive)
    with CarlaSession(carla, client, world, args.dt) as stage:
        ground = args.ground or ("map" if mode == "pid" else "log")
        player = ScenarioPlayer(stage, data, mode, physics=args.physics, ground=ground)
        play(player, data, follow=args.follow, pace=args.pace)
    for note in version_note(client) + stage.notes:
        print_now(note)
    if player.drift_m:
        print_now(drift_table(player.drift_m))


def main(words: Sequence[str] | None = None) -> int:
    """Run, and say in one line what went wrong."""
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
