"""Replays a scenario: assigns drivers, moves all agents step by step, and evaluates the result."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EGO, Agent, Scenario, Trajectory
from log2sim.errors import ConfigError, PluginError, ScenarioError
from log2sim.files import plugins
from log2sim.files.plugins import nearest
from log2sim.geometry import Array
from log2sim.simulation.corridors import PathTable, scenario_times_of_distance
from log2sim.simulation.groups import (
    ONE,
    AgentGroup,
    PedestrianGroup,
    PolicyObserver,
    PolicyVehicle,
    RecordedTracks,
    StepClock,
    VehicleGroup,
    WindowRecording,
    merged_tracks,
)
from log2sim.simulation.metrics.all_metrics import SCENARIO_FOLLOWERS, TrackingErrors, agent_errors, replay_metrics
from log2sim.simulation.metrics.collisions import RECONSTRUCTION, SCENARIO
from log2sim.simulation.policy import SIGHT_M, Controls, Observation, Policy, query_policy, reset_policy
from log2sim.simulation.reactive import (
    FORESIGHTS,
    ReactiveGroup,
    ReactivePedestrianGroup,
    ReactiveVehicleGroup,
    Traffic,
)
from log2sim.simulation.reference import GRID_S, control_step, log_reference, point_reference, vehicle_reference_of
from log2sim.simulation.result import AgentReplay, Commands, Replay
from log2sim.simulation.vehicles.single_track import AUTO, ModelChoice, choose_model, slipping_reference, understeer
from log2sim.simulation.vehicles.vehicle import (
    STEER_LAG_S,
    WHEELED,
    VehicleControls,
    VehicleParameters,
    VehicleState,
    VehicleStep,
    parameters_for,
    rear_axle_offset,
)

if TYPE_CHECKING:
    from log2sim.simulation.carla.simulator import CarlaSimulator

WINDOW_S = 10.0  # reference tables are at hand for the agents that live within this time

Progress = Callable[[int, int], None]


class World:
    """All agents on one clock, moved one step at a time.

    Between two calls the world is at `step`, and agents whose lifetime begins there have been placed. `advance` moves it on,
    until `done`. With an external simulator in `host`, groups only compute controls, and its tick moves the agents.

    `statics`: agents that never move; they are in no group. `traffic`: decides the speeds of reactive agents, if there are
    some. `choices`: by id, the model that moves each vehicle and why. `sight_m`: range within which the ego's policy observes
    other agents.
    """

    def __init__(
        self,
        groups: Sequence[AgentGroup],
        clock: StepClock,
        statics: Sequence[Agent],
        traffic: Traffic | None,
        choices: Mapping[str, ModelChoice],
        sight_m: float,
    ) -> None:
        self.groups, self.clock, self.statics, self.traffic = tuple(groups), clock, tuple(statics), traffic
        self.choices = choices
        self.host: CarlaSimulator | None = None
        self.ego = next((g for g in groups if isinstance(g, PolicyVehicle)), None)
        self._observer = PolicyObserver(self.ego, self.groups, self.statics, sight_m) if self.ego is not None else None
        # Of each group, the agents by step that are put on their references: at the start of their lifetime and after a
        # discontinuity.
        self._arrivals: list[dict[int, NDArray[np.intp]]] = []
        for group in groups:
            placed: dict[int, list[int]] = defaultdict(list)
            for i in np.flatnonzero(group.last >= group.first).tolist():
                placed[int(group.first[i])].append(i)
                if group.follows_scenario_time:
                    # The table blends both sides of a discontinuity over one row, so the agent is placed again after that row.
                    jumps_s = group.references[i].trajectory.discontinuity_times()
                    for step in clock.first_step(np.concatenate([jumps_s, jumps_s + GRID_S])):
                        if group.first[i] < step <= group.last[i]:
                            placed[int(step)].append(i)
            self._arrivals.append({step: np.unique(index) for step, index in placed.items()})
        self._width = max(1, round(WINDOW_S / clock.dt_s))
        self.restart()

    def restart(self) -> None:
        """Go back to the first step and discard what was recorded."""
        self.step = 0
        self._busy: list[tuple[AgentGroup, dict[int, NDArray[np.intp]]]] = []
        self.records: list[WindowRecording] = []  # of all windows so far
        self._window: list[WindowRecording] = []
        if self.traffic is not None:
            self.traffic.restart()
        if self.ego is not None:
            self.ego.controls = Controls(0.0, 0.0)
        if self._observer is not None:
            self._observer.progress_m = 0.0
        self._arrive()

    @property
    def t_s(self) -> float:
        """Time of the present step, s."""
        return self.clock.time(self.step)

    @property
    def done(self) -> bool:
        """Whether the last step has been reached."""
        return self.step >= self.clock.steps - 1

    @property
    def ego_lives(self) -> bool:
        """Whether a policy can drive the ego at this step."""
        return self.ego is not None and bool(self.ego.first[0] <= self.step <= self.ego.last[0])

    def observe(self) -> Observation:
        """Return the observation for the ego's policy; `ValueError` when no policy drives."""
        if self._observer is None:
            raise ValueError("no policy drives an agent of this world")
        return self._observer(self.step, self.t_s, self.clock.dt_s)

    def steer(self, controls: Controls) -> None:
        """Set the ego's controls, which hold until they are set again."""
        if self.ego is None:
            raise ValueError("no policy drives an agent of this world")
        if not (math.isfinite(controls.accel_mps2) and math.isfinite(controls.steer_rad)):
            raise ValueError(f"{controls}, expected finite numbers")
        self.ego.controls = controls

    def advance(self) -> None:
        """Move all agents by one step."""
        if self.done:
            raise ValueError(f"the world is at its end, {self.t_s:g} s")
        if self.traffic is None:
            for group, _ in self._busy:
                group.advance(self.clock.dt_s)
        else:  # in parts of at most one control step, so that reactive agents respond within a long step
            held_s = control_step(self.clock.dt_s)
            for part in range(round(self.clock.dt_s / held_s)):
                t_s = self.t_s + part * held_s
                for group, _ in self._busy if part else ():
                    group.look_up(t_s)
                self.traffic.decide(t_s, held_s, self.ego.snapshot() if self.ego is not None else None)
                for group, _ in self._busy:
                    group.advance(held_s)
        if self.host is not None:
            self.host.tick(self.step)
        self.step += 1
        self._arrive()

    def _arrive(self) -> None:
        """Update the references of this step, place agents whose lifetime begins, and record states."""
        step, t_s = self.step, self.t_s
        if step % self._width == 0:
            end = min(step + self._width, self.clock.steps)
            for group in self.groups:
                group.open_window(step, end, t_s, self.clock.time(end))
            self._busy = [(g, a) for g, a in zip(self.groups, self._arrivals) if len(g.live)]
            self._window = [WindowRecording(group, step, end, self.clock.store_every) for group, _ in self._busy]
            self.records += self._window
        for group, placed in self._busy:
            group.look_up(t_s)
            if step in placed:
                group.place(placed[step], t_s)
        if step % self.clock.store_every == 0:
            for record in self._window:
                record.add()


def rollout(world: World, policy: Policy | None = None, progress: Progress | None = None) -> RecordedTracks:
    """Run a world to its end and return the recorded tracks."""
    report_every = max(1, round(WINDOW_S / world.clock.dt_s))
    while not world.done:
        if policy is not None and world.ego_lives:
            world.steer(query_policy(policy, world.observe()))
        world.advance()
        if progress is not None and (world.step % report_every == 0):
            progress(world.step, world.clock.steps)
    if progress is not None:
        progress(world.clock.steps, world.clock.steps)
    return merged_tracks(world.records)


def reactive_ids(agents: Sequence[Agent], wanted: str | Collection[str], *, drives_ego: bool) -> frozenset[str]:
    """Return the ids of the agents that react: all that can for "reactive", none for "scenario", or those named.

    Raises `ConfigError` when a name is not known, or is that of an agent that cannot react: static, seen once, or
    driven by a policy.
    """
    able = [a.id for a in agents if not a.static and len(a.waypoints) > 1 and not (drives_ego and a.id == EGO)]
    if isinstance(wanted, str):
        if wanted not in ("scenario", "log", "reactive"):  # log: the name of scenario in older programs
            raise ConfigError(f"agents '{wanted}': expected scenario or reactive")
        return frozenset(i for i in able if i != EGO) if wanted == "reactive" else frozenset()
    for name in wanted:
        if name in able:
            continue
        if any(a.id == name for a in agents):
            raise ConfigError(f"agent '{name}': cannot react, it is static, seen only once, or driven by the policy")
        raise ConfigError(f"agent '{name}': there is none of that id{nearest(name, able)}")
    return frozenset(wanted)


def agent_groups(
    assignment: Mapping[str, Sequence[Agent]], clock: StepClock, mode: str, model: str
) -> tuple[list[AgentGroup], dict[str, ModelChoice]]:
    """Build the groups that have agents, and choose by id the model that moves each vehicle; static agents are in no group."""
    groups: list[AgentGroup] = []
    choices: dict[str, ModelChoice] = {}

    def lifespans(agents: Sequence[Agent]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the first and last step (A,), (A,) of each agent; last < first when it lives between two steps only."""
        begin_s, end_s = (np.array([a.waypoints.t_s[k] for a in agents]) for k in (0, -1))
        return clock.first_step(begin_s), clock.last_step(end_s)

    controlled: list[tuple[str, type[VehicleGroup], type[PedestrianGroup]]] = [
        ("policy", PolicyVehicle, PedestrianGroup),
        ("reactive", ReactiveVehicleGroup, ReactivePedestrianGroup),
        ("pid", VehicleGroup, PedestrianGroup),
    ]
    for driver, kind, on_foot in controlled if mode == "pid" else controlled[:1]:
        wheeled = [a for a in assignment[driver] if a.category in WHEELED]
        references = {a.id: vehicle_reference_of(a, clock.dt_s) for a in wheeled}
        for a in wheeled:
            choices[a.id] = choose_model(a, references[a.id], parameters_for([a]), model, free=kind is PolicyVehicle)
        chosen = {choices[a.id].model for a in wheeled}
        for name in sorted(chosen, key=[*plugins.BUILT_IN["vehicle_model"], *sorted(chosen)].index):
            moved = [a for a in wheeled if choices[a.id].model == name]
            p = parameters_for(moved, published=name == "single-track")
            followed = [references[a.id] for a in moved]
            if name != "kinematic":
                p = replace(p, understeer_s2pm2=understeer(p))
                ahead_s = STEER_LAG_S + control_step(clock.dt_s) / 2
                ones = [p.take(slice(i, i + 1)) for i in range(len(moved))]
                followed = [slipping_reference(r, one, name, ahead_s) for r, one in zip(followed, ones)]
            groups.append(kind(moved, followed, *lifespans(moved), p, _vehicle_step(name)))
        walking = [a for a in assignment[driver] if a.category not in WHEELED]
        if walking:
            points = [point_reference(Trajectory.through(a.waypoints)) for a in walking]
            groups.append(on_foot(walking, points, *lifespans(walking)))
    placed: list[tuple[str, type[AgentGroup]]] = [("exact", AgentGroup), ("reactive", ReactiveGroup)]
    for driver, tape in placed if mode == "exact" else placed[:1]:
        agents = assignment[driver]
        if agents:
            rows = [log_reference(Trajectory.through(a.waypoints, rear_axle_offset(a))) for a in agents]
            groups.append(tape(agents, rows, *lifespans(agents)))
    return groups, choices


def _vehicle_step(model: str) -> VehicleStep:
    """Return the step of a vehicle model by its name.

    Raises `ConfigError` when there is no such model. Raises `PluginError` when one of another package cannot be used; its
    faults are told with the name of the package.
    """
    step: VehicleStep = plugins.load("vehicle_model", model)
    if plugins.is_built_in("vehicle_model", model):
        return step

    def checked(
        state: VehicleState, controls: VehicleControls, parameters: VehicleParameters, dt_s: float
    ) -> VehicleState:
        with plugins.blaming("vehicle_model", model):
            after = step(state, controls, parameters, dt_s)
        plugins.require_type("vehicle_model", model, after, VehicleState)
        for key in ("x_m", "y_m", "yaw_rad", "speed_mps"):
            column = np.asarray(getattr(after, key))
            if column.shape != state.x_m.shape or not np.isfinite(column).all():
                raise PluginError(
                    f"{plugins.plugin_label('vehicle_model', model)}: {key} is {column!s:.80}, expected {len(state.x_m)} finite "
                    "numbers, one for each vehicle"
                )
        return after

    return checked


STATE_DIGITS = 6  # decimals of stored states: a micrometer
COMMAND_DIGITS = 4  # decimals of commands and errors: a tenth of a millimeter


def replay_result(scenario: Scenario, world: World, tracks: RecordedTracks, mode: str, model: str) -> Replay:
    """Build the replay of a scenario from the recorded tracks of its world."""
    clock = world.clock
    source = {a.id: (g.driver, r.trajectory, r.flags) for g in world.groups for a, r in zip(g.agents, g.references)}
    agents: list[AgentReplay] = []
    stored: list[NDArray[np.intp]] = []
    errors: dict[str, TrackingErrors] = {}
    for agent in scenario.agents:
        if agent.id not in tracks:
            replayed, steps = _static_agent(agent, clock)
            agents.append(replayed)
            stored.append(steps)
            continue
        driver, trajectory, flags = source[agent.id]
        steps, (x, y, yaw, speed, steer, accel, pedal, wheel, gear) = tracks[agent.id]
        t_s: Array = clock.begin_s + steps.astype(np.float64) * clock.dt_s
        if driver == "exact":
            x, y, _, yaw, speed = trajectory.at(t_s)  # the reference tables are only good to half a millimeter
        log_t_s = t_s
        if driver == "reactive":
            log_t_s = scenario_times_of_distance(trajectory, t_s, x, y)
        elif driver == "policy":
            path = PathTable([trajectory])
            log_t_s = path.times(ONE, path.progress(0, x, y))
        if np.isnan(accel).any():
            accel = np.gradient(speed, t_s) if len(t_s) > 1 else np.zeros(len(t_s))
        z = trajectory.heights(log_t_s)  # the height of the road at this place
        x, y, z, yaw, speed, steer, accel = (np.round(c, STATE_DIGITS) for c in (x, y, z, yaw, speed, steer, accel))
        pedal, wheel = (np.round(c, COMMAND_DIGITS) for c in (pedal, wheel))
        commands = None if np.isnan(pedal).any() else Commands(pedal, wheel, np.where(gear < 0, -1, 1).astype(np.int8))
        unchosen = ModelChoice("point" if mode == "pid" and driver in ("pid", "reactive") else "none", "")
        choice = world.choices.get(agent.id, unchosen)
        moved = AgentReplay(
            agent.id, agent.category, agent.size_m, driver, choice.model, np.round(t_s, 9), x, y, z, yaw, speed, steer,
            accel, flags, choice.reason, commands,
        )  # fmt: skip
        e = errors[agent.id] = agent_errors(trajectory, moved, follows=driver in SCENARIO_FOLLOWERS)
        if driver != "exact":  # who is placed on its trajectory has none
            across, along = (np.round(c, COMMAND_DIGITS) for c in (e.across_m, e.along_m))
            moved = replace(moved, cross_track_m=across, along_track_m=along)
        agents.append(moved)
        stored.append(steps)
    trajectories = {k: trajectory for k, (_, trajectory, _) in source.items() if k in tracks}
    kind, store_dt_s = RECONSTRUCTION if scenario.is_reconstruction else SCENARIO, clock.dt_s * clock.store_every
    metrics = replay_metrics(agents, stored, trajectories, errors, clock, source_kind=kind)
    name, digest = scenario.name, scenario.digest
    return Replay(name, digest, mode, model, clock.dt_s, round(store_dt_s, 9), tuple(agents), metrics)


def _static_agent(agent: Agent, clock: StepClock) -> tuple[AgentReplay, NDArray[np.intp]]:
    """Build a static agent, or one that lived between two steps, and the stored steps at which it is present.

    A permanent agent is present all the time; one that lived between two stored steps has that one moment.
    """
    w = agent.waypoints
    end_s = clock.time(clock.steps - 1)
    begin_s, until_s = (clock.begin_s, end_s) if agent.is_permanent else (float(w.t_s[0]), float(w.t_s[-1]))
    t_s = np.array([begin_s, until_s] if agent.static and until_s > begin_s else [begin_s])
    first, last = clock.first_step(np.array([begin_s]))[0], clock.last_step(np.array([until_s]))[0]
    every = clock.store_every
    steps = np.arange(-(-first // every) * every, last + 1, every) if agent.static else np.zeros(0, dtype=np.intp)
    x, y, z, yaw = (np.full(len(t_s), round(float(c[0]), STATE_DIGITS)) for c in (w.x_m, w.y_m, w.z_m, w.yaw_rad))
    speed = np.full(len(t_s), 0.0 if agent.static else float(w.speed_mps[0]))
    zero = np.zeros(len(t_s))
    driver = "static" if agent.static else "exact"
    replayed = AgentReplay(agent.id, agent.category, agent.size_m, driver, "none", t_s, x, y, z, yaw, speed, zero, zero)
    return replayed, steps


SIMULATORS = ("own", "carla")
MODES = ("pid", "exact")
DT_RANGE_S = (0.0005, 1.0)
MAX_STEPS = 20_000_000


def external_simulator(name: str, address: str | None, port: int | None, map: str | None) -> CarlaSimulator | None:
    """Return the simulator of a name, with an address, port and world (town or OpenDRIVE file); None for the embedded one.

    Raises `ConfigError` for an unknown name, options that it does not use, or a missing file.
    """
    if name not in SIMULATORS:
        raise ConfigError(
            f"unknown simulator '{name}'{nearest(name, list(SIMULATORS))}; known: {', '.join(SIMULATORS)}"
        )
    if name == "own":
        if address is not None or port is not None or map is not None:
            raise ConfigError("--host, --port and --map are for --simulator carla; add it, or leave them out")
        return None
    from log2sim.simulation.carla.simulator import CarlaServer, CarlaSimulator

    opendrive = Path(map) if map is not None and map.endswith(".xodr") else None
    if opendrive is not None and not opendrive.is_file():
        raise ConfigError(f"--map: {opendrive}: no such file")
    own = CarlaServer()
    town = None if opendrive else map
    return CarlaSimulator(CarlaServer(address or own.host, port or own.port, town=town, opendrive=opendrive))


def replay(
    scenario: Scenario,
    *,
    mode: str = "pid",
    model: str = "auto",
    dt_s: float = 0.01,
    ego: Policy | None = None,
    agents: str | Collection[str] = "scenario",
    foresight: str = "path",
    sight_m: float = SIGHT_M,
    host: CarlaSimulator | None = None,
    quarantined: bool = False,
    progress: Progress | None = None,
) -> Replay:
    """Replay a scenario and compare the replay with it.

    Raises `ConfigError` when an argument is out of its range, or a policy is given for a scenario without an ego on
    wheels. Raises `ScenarioError` when an agent has no waypoints, or waypoints that are not finite or not in the order
    of time.

    Parameters
    ----------
    mode : {"pid", "exact"}
        "pid": agents follow their trajectories by control through a vehicle model; "exact": they are placed on them.
    model : {"auto", "kinematic", "dynamic", "single-track"} or the name of a plug-in
        How vehicles move: rolling without slip, on tires that slip and saturate, or by the published single-track model
        with linear tires. "auto" takes for each vehicle the simplest adequate one; `AgentReplay.model_reason` gives the reason.
    dt_s : float
        Simulation step in s, from 0.0005 to 1; controls are renewed at least every 0.1 s. States are stored about every
        0.05 s, or every step.
    ego : callable, optional
        `policy(observation) -> Controls` that drives the ego, from its first state in the scenario to the end of its
        lifetime. If it has `reset(scenario)`, that is called first.
    agents : {"scenario", "reactive"} or collection of str
        "scenario": the other agents follow their trajectories. "reactive": they keep to their paths and brake for
        agents that the scenario does not have there. A collection: only the agents with these ids react (the ego too,
        if it is among them).
    foresight : {"path", "motion"}
        What reactive agents expect of others: that they go where the scenario has them go, or that they go on as they
        have moved so far, see `log2sim.simulation.prediction`.
    sight_m : float
        Range within which the ego's policy observes other agents, center to center.
    host : CarlaSimulator, optional
        External simulator that moves the agents. It has its own vehicle models, so `model` is not used.
    quarantined : bool
        Whether agents whose confidence is too low, see `Agent.quarantined`, are there too.
    progress : callable, optional
        Called now and then with the number of steps done and of all steps.

    Notes
    -----
    Static agents and those observed only once have no controller. Tracking errors are averaged over the agents that
    follow the scenario; those of an ego with a policy are in `metrics["by_agent"]`. Cost: one step moves all agents
    that live within the present 10 s at once.
    """
    gone = {} if quarantined else {a.id: "quarantined" for a in scenario.agents if a.quarantined}
    scenario = scenario if quarantined else scenario.active
    if host is not None:
        model = "kinematic"  # its references hold no slip angles of a model, so they suit every simulator
    world = open_world(
        scenario, mode=mode, model=model, dt_s=dt_s, drives_ego=ego is not None, agents=agents, foresight=foresight,
        sight_m=sight_m,
    )  # fmt: skip
    if ego is not None:
        reset_policy(ego, scenario)
    if host is None:
        tracks = rollout(world, ego, progress)
    else:
        if dt_s > host.max_dt_s:
            raise ConfigError(f"dt: {dt_s} s, {host.name} takes at most {host.max_dt_s:g} s")
        host.open(world.groups, world.clock, world.statics)
        world.host, model = host, host.name
        world.choices = {k: ModelChoice(host.name, "the simulator's own") for k in world.choices}
        try:
            tracks = rollout(world, ego, progress)
        finally:
            host.close()
    return replace(replay_result(scenario, world, tracks, mode, model), left_out=gone)


def open_world(
    scenario: Scenario,
    *,
    mode: str = "pid",
    model: str = "auto",
    dt_s: float = 0.01,
    drives_ego: bool = True,
    agents: str | Collection[str] = "scenario",
    foresight: str = "path",
    sight_m: float = SIGHT_M,
) -> World:
    """Prepare a scenario for stepwise simulation; with `drives_ego` the caller sets the ego's controls. See `replay`.

    Examples
    --------
    >>> world = open_world(scenario)
    >>> while not world.done:
    ...     if world.ego_lives:
    ...         observation = world.observe()
    ...         world.steer(Controls(accel_mps2=1.0, steer_rad=0.0))
    ...     world.advance()
    """
    if mode not in MODES:
        raise ConfigError(f"mode '{mode}': expected one of {', '.join(MODES)}")
    if not DT_RANGE_S[0] <= dt_s <= DT_RANGE_S[1]:
        raise ConfigError(f"dt: {dt_s} s, expected {DT_RANGE_S[0]} to {DT_RANGE_S[1]} s")
    if foresight not in FORESIGHTS:
        raise ConfigError(f"foresight '{foresight}': expected one of {', '.join(FORESIGHTS)}")
    if not sight_m >= 0:
        raise ConfigError(f"sight: {sight_m} m, expected 0 or more")
    if model != AUTO and not plugins.is_built_in("vehicle_model", model):
        models = [AUTO, *plugins.names("vehicle_model")]
        if model not in models:
            raise ConfigError(f"unknown vehicle model '{model}'{nearest(model, models)}; known: {', '.join(models)}")
    if drives_ego and (scenario.ego is None or scenario.ego.category not in WHEELED):
        raise ConfigError(f"ego policy: scenario '{scenario.name}' has no agent '{EGO}' with wheels to drive")
    for agent in scenario.agents:
        problem = agent.waypoints.problem()
        if problem is not None:
            raise ScenarioError(f"agent '{agent.id}': {problem}")
    begin_s = min((float(a.waypoints.t_s[0]) for a in scenario.agents), default=0.0)
    end_s = max((float(a.waypoints.t_s[-1]) for a in scenario.agents), default=0.0)
    clock = StepClock.spanning(begin_s, end_s, dt_s)
    if clock.steps > MAX_STEPS:
        raise ScenarioError(
            f"waypoints span {end_s - begin_s:g} s, {clock.steps} steps of {dt_s} s; at most {MAX_STEPS} can be run"
        )
    reactive = reactive_ids(scenario.agents, agents, drives_ego=drives_ego)
    # Agents by driver; static ones never move.
    assigned: dict[str, list[Agent]] = {"policy": [], "reactive": [], "pid": [], "exact": [], "static": []}
    for agent in scenario.agents:
        if drives_ego and agent.id == EGO:
            assigned["policy"].append(agent)
        elif agent.static:
            assigned["static"].append(agent)
        elif agent.id in reactive:
            assigned["reactive"].append(agent)
        else:
            assigned[mode if len(agent.waypoints) > 1 else "exact"].append(agent)
    groups, choices = agent_groups(assigned, clock, mode, model)
    traffic, reacting = None, [g for g in groups if isinstance(g, ReactiveGroup)]
    if reacting:
        followed = {a.id: r.trajectory for g in groups for a, r in zip(g.agents, g.references)}
        for agent in assigned["static"]:  # the first pose throughout its lifetime
            w = agent.waypoints
            first = {k: np.full(len(w), getattr(w, k)[0]) for k in ("x_m", "y_m", "z_m", "yaw_rad")}
            followed[agent.id] = Trajectory.through(replace(w, **first, speed_mps=np.zeros(len(w))))
        driven = EGO if assigned["policy"] else None
        traffic = Traffic(scenario.agents, [followed[a.id] for a in scenario.agents], reactive, driven, foresight)
        for group in reacting:
            group.join(traffic, clock)
    return World(groups, clock, assigned["static"], traffic, choices, sight_m)
