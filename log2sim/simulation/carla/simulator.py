"""CARLA as the external simulator of a replay: vehicles move by its physics, under the controllers of the embedded replay.

States are read back from CARLA after every tick, and controls are sent in the form of its vehicles and walkers.
Conversions of frames, pedals and steering are those of `player`, which is also the script that an export writes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from log2sim.datatypes import Agent
from log2sim.errors import ConfigError, MissingExtra
from log2sim.geometry import Array, whole_kilometers
from log2sim.simulation.carla import player
from log2sim.simulation.carla.data import carla_agents
from log2sim.simulation.groups import AgentGroup, PedestrianGroup, StepClock, VehicleGroup
from log2sim.simulation.vehicles.vehicle import PointState, step_point


@dataclass(frozen=True)
class CarlaServer:
    """Address of a CARLA server, and the world that it loads first, if any."""

    host: str = "127.0.0.1"
    port: int = 2000
    timeout_s: float = 60.0
    town: str | None = None
    opendrive: Path | None = None  # an OpenDRIVE file


class CarlaSimulator:
    """The groups of a replay in a CARLA world; which from then on only decide their controls; a step of the replay is one tick."""

    name = "carla"
    max_dt_s = 0.1  # as far as CARLA's physics goes with its substeps

    def __init__(self, server: CarlaServer | None = None) -> None:
        self.server = server or CarlaServer()

    def open(self, groups: Sequence[AgentGroup], clock: StepClock, statics: Sequence[Agent]) -> None:
        """Connect, and take the groups over.

        Raises `MissingExtra`: without CARLA's client. Raises `ConfigError` when no server answers, or it cannot load
        the world.
        """
        self.clock = clock
        all_agents = [a for g in groups for a in g.agents] + list(statics)
        log_groups = [g for g in groups if not isinstance(g, (VehicleGroup, PedestrianGroup))]
        replayed = [a for g in log_groups if g.follows_scenario_time for a in g.agents] + list(statics)
        xy: Array = np.concatenate([np.column_stack([a.waypoints.x_m, a.waypoints.y_m]) for a in all_agents])
        x, y = whole_kilometers(xy)
        self.offset_m = float(x), float(y)
        shifted = []
        for a in all_agents:
            w = replace(a.waypoints, x_m=a.waypoints.x_m - self.offset_m[0], y_m=a.waypoints.y_m - self.offset_m[1])
            shifted.append(replace(a, waypoints=w))
        data = {d["id"]: d for d in carla_agents(shifted)}
        self._data, self._trajectories = data, {k: player.SampledTrajectory(d["exact"]) for k, d in data.items()}
        self._read: dict[str, tuple[float, float]] = {}
        with _translated_errors():
            carla = player.load_client()
            client = player.connect(carla, self.server.host, self.server.port, self.server.timeout_s)
            world = player.open_world(carla, client, self.server.town, self.server.opendrive)
            self.carla, self.session = carla, player.CarlaSession(carla, client, world, clock.dt_s)
            ground = "log" if self.server.town is None and self.server.opendrive is None else "map"
            shown = {"agents": [data[a.id] for a in replayed]}
            self._player = player.ScenarioPlayer(self.session, shown, "exact", physics=False, ground=ground)
        self._vehicle_groups = [g for g in groups if isinstance(g, VehicleGroup)]
        self._pedestrian_groups = [g for g in groups if isinstance(g, PedestrianGroup)]
        self._delayed = [g for g in log_groups if not g.follows_scenario_time]
        # A tick moves all groups at once.
        for vehicles in self._vehicle_groups:
            vehicles.move = lambda state, *_: state
        for points in self._pedestrian_groups:
            setattr(points, "move", lambda state, *_: state)  # noqa: B010
        with _translated_errors():
            self.session.__enter__()

    def tick(self, step: int) -> None:
        """Move all groups from a step to the next."""
        with _translated_errors():
            commands = self._player.commands(self.clock.time(step + 1))
            vehicles = [group for group in self._vehicle_groups if len(group.live)]
            pedestrians = [points for points in self._pedestrian_groups if len(points.live)]
            for group in vehicles:
                for slot in self._present(group, step):
                    commands += self._drive(group, slot, step)
            for points in pedestrians:
                commands += self._walk(points, step)
            for delayed in self._delayed:
                commands += self._show(delayed, step)
            self.session.send(commands)
            self.session.world.tick()
            for group in vehicles:
                self._read_vehicles(group, step)
            for points in pedestrians:
                self._read_points(points, step)
            ego = self._trajectories.get("ego")
            if ego is not None:
                self.session.watch(ego.place(self.clock.time(step + 1)))

    def close(self) -> None:
        """Remove the actors and restore the settings."""
        self.session.__exit__()

    def _present(self, group: AgentGroup, step: int) -> list[int]:
        """Return the slots of the agents to be moved; those whose lifetime is over are removed from CARLA."""
        slots = []
        for slot, i in enumerate(group.live):
            if group.first[i] <= step < group.last[i]:
                slots.append(slot)
            elif group.agents[i].id in self.session.actors:
                self.session.remove(group.agents[i].id)
        return slots

    def _drive(self, group: VehicleGroup, slot: int, step: int) -> Iterator[Any]:
        """Yield the commands for one vehicle: its inputs, after its pose unless its state came from CARLA."""
        state, i, command = group.state, group.live[slot], self.carla.command
        name, speed = group.agents[i].id, float(state.speed_mps[slot])
        yaw, offset_m = -float(state.yaw_rad[slot]), float(group.offset_m[i])
        actor = self.session.actors.get(name)
        if actor is None or self._read.get(name) != (state.x_m[slot], state.y_m[slot]):
            x, y = self._to_carla(group, slot, float(state.x_m[slot]), float(state.y_m[slot]))
            center = (x + offset_m * math.cos(yaw), y + offset_m * math.sin(yaw), yaw)
            actor, placed = self._placed(group, slot, step, center, physics=True, falls=True)
            velocity = self.carla.Vector3D(speed * math.cos(yaw), speed * math.sin(yaw), 0.0)
            yield placed
            yield command.ApplyTargetVelocity(actor.handle.id, velocity)
        controls = group.commands
        curvature = -math.tan(controls.steer_rad[slot]) / float(group.living.wheelbase_m[slot])
        inputs = actor.control(float(controls.pedal_mps2[slot]), curvature, speed, bool(controls.reverse[slot]))
        yield command.ApplyVehicleControl(actor.handle.id, inputs)

    def _walk(self, group: PedestrianGroup, step: int) -> Iterator[Any]:
        """Yield the commands for points: walkers walk to where the point model leads, objects are placed there."""
        goal, dt_s = step_point(group.state, group.commands, self.clock.dt_s), self.clock.dt_s
        for slot in self._present(group, step):
            name, state = group.agents[group.live[slot]].id, group.state
            yaw = -float(group.row[2][slot])
            x, y = self._to_carla(group, slot, float(state.x_m[slot]), float(state.y_m[slot]))
            goal_x, goal_y = self._to_carla(group, slot, float(goal.x_m[slot]), float(goal.y_m[slot]))
            actor, walks = self.session.actors.get(name), self._data[name]["drive"] == "walker"
            if actor is None or not walks or self._read.get(name) != (state.x_m[slot], state.y_m[slot]):
                at = (x, y, yaw) if walks else (goal_x, goal_y, yaw)
                actor, placed = self._placed(group, slot, step, at, physics=walks)
                yield placed
            if walks:
                yield self._player.walk(actor, (goal_x - x) / dt_s, (goal_y - y) / dt_s, yaw)

    def _show(self, group: AgentGroup, step: int) -> Iterator[Any]:
        """Yield the commands that put delayed agents on their path."""
        now, dt_s = group.snapshot(), self.clock.dt_s
        for slot in self._present(group, step):
            name, yaw, speed = group.agents[group.live[slot]].id, -float(now.yaw_rad[slot]), float(now.speed_mps[slot])
            x, y = float(now.x_m[slot]) - self.offset_m[0], -float(now.y_m[slot]) + self.offset_m[1]
            vx, vy = speed * math.cos(yaw), speed * math.sin(yaw)
            walks = self._data[name]["drive"] == "walker"
            at = (x, y, yaw) if walks else (x + vx * dt_s, y + vy * dt_s, yaw)
            actor, placed = self._placed(group, slot, step, at, physics=False)
            yield placed
            if walks:
                yield self._player.walk(actor, vx, vy, yaw)

    def _read_vehicles(self, group: VehicleGroup, step: int) -> None:
        """Read the states of vehicles from CARLA; actuator states, which it does not report, are the commands."""
        state, controls = group.state, group.commands
        x, y, yaw, speed, pedal = (
            c.copy() for c in (state.x_m, state.y_m, state.yaw_rad, state.speed_mps, state.pedal_mps2)
        )
        for slot in self._present(group, step):
            i = group.live[slot]
            name, o = group.agents[i].id, float(group.offset_m[i])
            at_x, at_y, at_z, at_yaw, now = self.session.actors[name].pose()
            self._player.require_ground(self._data[name], at_z, self._trajectories[name].place(self.clock.time(step)))
            at = self._from_carla(group, slot, at_x - o * math.cos(at_yaw), at_y - o * math.sin(at_yaw))
            x[slot], y[slot] = self._read[name] = at
            yaw[slot] = -at_yaw
            pedal[slot] = (now - speed[slot]) / self.clock.dt_s * (-1.0 if now < 0 else 1.0)
            speed[slot] = now
        measured = {"x_m": x, "y_m": y, "yaw_rad": yaw, "speed_mps": speed, "pedal_mps2": pedal}
        group.state = replace(state, **measured, steer_rad=controls.steer_rad)

    def _read_points(self, group: PedestrianGroup, step: int) -> None:
        """Read the states of points from CARLA."""
        state, dt_s = group.state, self.clock.dt_s
        x, y = state.x_m.copy(), state.y_m.copy()
        for slot in self._present(group, step):
            name = group.agents[group.live[slot]].id
            x[slot], y[slot] = self._read[name] = self._from_carla(group, slot, *self.session.actors[name].pose()[:2])
        group.state = PointState(x, y, (x - state.x_m) / dt_s, (y - state.y_m) / dt_s)

    def _placed(
        self,
        group: AgentGroup,
        slot: int,
        step: int,
        at: tuple[float, float, float],
        *,
        physics: bool,
        falls: bool = False,
    ) -> tuple[player.CarlaActor, Any]:
        """Return an agent's actor, spawned if need be, and the command that puts it at x, y, yaw and the scenario's height."""
        name, (x, y, yaw) = group.agents[group.live[slot]].id, at
        z = self._trajectories[name].place(float(group.log_times(self.clock.time(step))[slot]))[2]
        place = self._player.grounded(self._data[name], (x, y, z, yaw), falls=falls)
        actor = self.session.actors.get(name) or self.session.spawn(self._data[name], place, physics)
        return actor, self.carla.command.ApplyTransform(actor.handle.id, actor.transform(*place))

    def _to_carla(self, group: AgentGroup, slot: int, x: float, y: float) -> tuple[float, float]:
        """Convert a position of a group's state, relative to the agent's first waypoint, to CARLA's frame."""
        i = group.live[slot]
        return x + group.origin_x_m[i] - self.offset_m[0], -(y + group.origin_y_m[i] - self.offset_m[1])

    def _from_carla(self, group: AgentGroup, slot: int, x: float, y: float) -> tuple[float, float]:
        """Convert a position in CARLA's frame to that of a group's state."""
        i = group.live[slot]
        return x + self.offset_m[0] - group.origin_x_m[i], -y + self.offset_m[1] - group.origin_y_m[i]


@contextmanager
def _translated_errors() -> Iterator[None]:
    """Raise errors of the player and of CARLA's client as those of this package."""
    try:
        yield
    except player.ReplayError as error:
        if error.code == player.NO_CLIENT:
            raise MissingExtra("a replay in CARLA", "carla") from None
        raise ConfigError(f"CARLA: {error}") from None
    except RuntimeError as error:  # what the client raises when the server is gone
        raise ConfigError(f"CARLA: {error}") from None
