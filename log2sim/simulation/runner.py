"""Replays a scenario: assigns drivers, runs the simulation and evaluates the result."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EGO, Agent, Scenario, Trajectory
from log2sim.errors import ConfigError, ScenarioError
from log2sim.files import plugins
from log2sim.files.plugins import is_built_in, names, nearest
from log2sim.geometry import Array
from log2sim.simulation.corridors import scenario_times_of_distance, scenario_times_of_positions
from log2sim.simulation.follower import control_step
from log2sim.simulation.groups import (
    AgentGroup,
    LogReplayGroup,
    PedestrianGroup,
    PolicyVehicle,
    RecordedTracks,
    StepClock,
    VehicleGroup,
)
from log2sim.simulation.metrics.all_metrics import SCENARIO_FOLLOWERS, TrackingErrors, agent_errors, replay_metrics
from log2sim.simulation.metrics.collisions import RECONSTRUCTION, SCENARIO
from log2sim.simulation.policy import SIGHT_M, Policy, reset_policy
from log2sim.simulation.reactive import (
    FORESIGHTS,
    ReactiveGroup,
    ReactiveLogReplayGroup,
    ReactivePedestrianGroup,
    ReactiveVehicleGroup,
    Traffic,
)
from log2sim.simulation.reference import log_reference, point_reference, vehicle_reference_of
from log2sim.simulation.result import AgentReplay, Commands, Replay
from log2sim.simulation.rollout import Progress, World, rollout
from log2sim.simulation.simulators import ExternalSimulator, load_step
from log2sim.simulation.vehicles.model_choice import AUTO, ModelChoice, choose_model, slipping_reference, understeer
from log2sim.simulation.vehicles.parameters import STEER_LAG_S, WHEELED, parameters_for, rear_axle_offset

# Agents by driver: "policy", "reactive", "pid", "exact", or "static" for those that never move.
DriverAssignment = dict[str, list[Agent]]


def assign_drivers(
    agents: Sequence[Agent], mode: str, *, drives_ego: bool, reactive: Collection[str] = ()
) -> DriverAssignment:
    """Assign a driver to each agent; `reactive` holds the ids of agents that react, see `reactive_ids`."""
    assignment: DriverAssignment = {"policy": [], "reactive": [], "pid": [], "exact": [], "static": []}
    for agent in agents:
        if drives_ego and agent.id == EGO:
            assignment["policy"].append(agent)
        elif agent.static:
            assignment["static"].append(agent)
        elif agent.id in reactive:
            assignment["reactive"].append(agent)
        else:
            assignment[mode if len(agent.waypoints) > 1 else "exact"].append(agent)
    return assignment


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
    assignment: Mapping[str, Sequence[Agent]], clock: StepClock, mode: str = "pid", model: str = "auto"
) -> tuple[list[AgentGroup], dict[str, ModelChoice]]:
    """Build the groups that have agents, and choose by id the model that moves each vehicle; static agents are in no group."""
    groups: list[AgentGroup] = []
    choices: dict[str, ModelChoice] = {}
    controlled: list[tuple[str, type[VehicleGroup], type[PedestrianGroup]]] = [
        ("policy", PolicyVehicle, PedestrianGroup)
    ]
    if mode == "pid":
        controlled += [
            ("reactive", ReactiveVehicleGroup, ReactivePedestrianGroup),
            ("pid", VehicleGroup, PedestrianGroup),
        ]
    for driver, kind, on_foot in controlled:
        wheeled = [a for a in assignment[driver] if a.category in WHEELED]
        groups += _vehicle_groups(wheeled, kind, clock, model, choices)
        walking = [a for a in assignment[driver] if a.category not in WHEELED]
        if walking:
            references = [point_reference(Trajectory.through(a.waypoints)) for a in walking]
            groups.append(on_foot(walking, references, *_lifespans(walking, clock)))
    for driver, tape in (
        ("exact", LogReplayGroup),
        *([("reactive", ReactiveLogReplayGroup)] if mode == "exact" else []),
    ):
        agents = list(assignment[driver])
        if agents:
            references = [log_reference(Trajectory.through(a.waypoints, rear_axle_offset(a))) for a in agents]
            groups.append(tape(agents, references, *_lifespans(agents, clock)))
    return groups, choices


def _vehicle_groups(
    agents: Sequence[Agent], kind: type[VehicleGroup], clock: StepClock, model: str, choices: dict[str, ModelChoice]
) -> list[AgentGroup]:
    """Build one group of vehicles for each model in use; the choice for each vehicle is added to `choices`."""
    groups: list[AgentGroup] = []
    references = {a.id: vehicle_reference_of(a, clock.dt_s) for a in agents}
    for a in agents:
        choices[a.id] = choose_model(a, references[a.id], parameters_for([a]), model, free=kind is PolicyVehicle)
    chosen = {choices[a.id].model for a in agents}
    for name in sorted(chosen, key=[*plugins.BUILT_IN["vehicle_model"], *sorted(chosen)].index):
        moved = [a for a in agents if choices[a.id].model == name]
        p = parameters_for(moved, published=name == "single-track")
        followed = [references[a.id] for a in moved]
        if name != "kinematic":
            p = replace(p, understeer_s2pm2=understeer(p))
            ahead_s = STEER_LAG_S + control_step(clock.dt_s) / 2
            ones = [p.take(slice(i, i + 1)) for i in range(len(moved))]
            followed = [slipping_reference(r, one, name, ahead_s) for r, one in zip(followed, ones)]
        groups.append(kind(moved, followed, *_lifespans(moved, clock), p, load_step(name)))
    return groups


def reactive_traffic(
    agents: Sequence[Agent], groups: Sequence[AgentGroup], clock: StepClock, foresight: str
) -> Traffic | None:
    """Build the traffic model of the reactive groups and connect them with it; None when no agent reacts."""
    reacting = [g for g in groups if isinstance(g, ReactiveGroup)]
    if not reacting:
        return None
    trajectories = {a.id: r.trajectory for g in groups for a, r in zip(g.agents, g.references)}
    driven = next((g.agents[0].id for g in groups if isinstance(g, PolicyVehicle)), None)
    reactive = {a.id for g in reacting for a in g.agents}
    followed = [trajectories.get(a.id) or _static_trajectory(a) for a in agents]
    traffic = Traffic(agents, followed, reactive, driven, foresight)
    for group in reacting:
        group.join(traffic, clock)
    return traffic


def _static_trajectory(agent: Agent) -> Trajectory:
    """Return the trajectory of a static agent: its first pose throughout its lifetime."""
    w = agent.waypoints
    first = {k: np.full(len(w), getattr(w, k)[0]) for k in ("x_m", "y_m", "z_m", "yaw_rad")}
    return Trajectory.through(replace(w, **first, speed_mps=np.zeros(len(w))))


def _lifespans(agents: Sequence[Agent], clock: StepClock) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first and last step (A,), (A,) of each agent; last < first when an agent lives between two steps only."""
    begin = np.array([a.waypoints.t_s[0] for a in agents])
    end = np.array([a.waypoints.t_s[-1] for a in agents])
    return clock.first_step(begin), clock.last_step(end)


STATE_DIGITS = 6  # decimals of stored states: a micrometer
COMMAND_DIGITS = 4  # decimals of commands and errors: a tenth of a millimeter


def replay_result(
    scenario: Scenario,
    groups: Sequence[AgentGroup],
    tracks: RecordedTracks,
    clock: StepClock,
    choices: Mapping[str, ModelChoice],
    mode: str,
    model: str,
) -> Replay:
    """Build the replay of a scenario from the recorded tracks."""
    source = {a.id: (g.driver, r.trajectory, r.flags) for g in groups for a, r in zip(g.agents, g.references)}
    agents: list[AgentReplay] = []
    stored: list[NDArray[np.intp]] = []
    errors: dict[str, TrackingErrors] = {}
    point_drivers = ("pid", "reactive") if mode == "pid" else ()
    for agent in scenario.agents:
        if agent.id not in tracks:
            replayed, steps = _static_agent(agent, clock)
        else:
            driver, trajectory, flags = source[agent.id]
            steps, states = tracks[agent.id]
            t_s: Array = clock.begin_s + steps.astype(np.float64) * clock.dt_s
            choice = choices.get(
                agent.id, ModelChoice("point", "") if driver in point_drivers else ModelChoice("none", "")
            )
            moved = _moving_agent(agent, driver, choice, trajectory, flags, t_s, states)
            errors[agent.id] = agent_errors(trajectory, moved, follows=driver in SCENARIO_FOLLOWERS)
            replayed = moved
            if driver != "exact":  # who is placed on its trajectory has none
                e = errors[agent.id]
                across, along = (np.round(c, COMMAND_DIGITS) for c in (e.across_m, e.along_m))
                replayed = replace(moved, cross_track_m=across, along_track_m=along)
        agents.append(replayed)
        stored.append(steps)
    trajectories = {k: trajectory for k, (_, trajectory, _) in source.items() if k in tracks}
    kind, store_dt_s = RECONSTRUCTION if scenario.is_reconstruction else SCENARIO, clock.dt_s * clock.store_every
    metrics = replay_metrics(agents, stored, trajectories, errors, clock, source_kind=kind)
    name, digest = scenario.name, scenario.digest
    return Replay(name, digest, mode, model, clock.dt_s, round(store_dt_s, 9), tuple(agents), metrics)


def _moving_agent(
    agent: Agent,
    driver: str,
    choice: ModelChoice,
    trajectory: Trajectory,
    flags: tuple[str, ...],
    t_s: Array,
    states: Array,
) -> AgentReplay:
    x, y, yaw, speed, steer, accel, pedal, wheel, gear = states
    if driver == "exact":
        x, y, _, yaw, speed = trajectory.at(t_s)  # the reference tables are only good to half a millimeter
    log_t_s = t_s
    if driver == "reactive":
        log_t_s = scenario_times_of_distance(trajectory, t_s, x, y)
    elif driver == "policy":
        log_t_s = scenario_times_of_positions(trajectory, x, y)
    if np.isnan(accel).any():
        accel = np.gradient(speed, t_s) if len(t_s) > 1 else np.zeros(len(t_s))
    z = trajectory.heights(log_t_s)  # the height of the road at this place
    x, y, z, yaw, speed, steer, accel = (np.round(c, STATE_DIGITS) for c in (x, y, z, yaw, speed, steer, accel))
    t_s = np.round(t_s, 9)
    commands = Commands(
        np.round(pedal, COMMAND_DIGITS), np.round(wheel, COMMAND_DIGITS), np.where(gear < 0, -1, 1).astype(np.int8)
    )
    return AgentReplay(
        agent.id, agent.category, agent.size_m, driver, choice.model, t_s, x, y, z, yaw, speed, steer, accel, flags,
        choice.reason, None if np.isnan(pedal).any() else commands,
    )  # fmt: skip


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


def external_simulator(name: str, address: str | None, port: int | None, map: str | None) -> ExternalSimulator | None:
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
    host: ExternalSimulator | None = None,
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
    host : Host, optional
        External simulator that moves the agents, such as `log2sim.simulation.carla.simulator.CarlaSimulator`. It has its own
        vehicle models, so `model` is not used.
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
    choices = world.choices
    if host is None:
        tracks = rollout(world, ego, progress)
    else:
        if dt_s > host.max_dt_s:
            raise ConfigError(f"dt: {dt_s} s, {host.name} takes at most {host.max_dt_s:g} s")
        host.open(world.groups, world.clock, world.statics)
        world.host, model = host, host.name
        choices = {k: ModelChoice(host.name, "the simulator's own") for k in choices}
        try:
            tracks = rollout(world, ego, progress)
        finally:
            host.close()
    result = replay_result(scenario, world.groups, tracks, world.clock, choices, mode, model)
    return replace(result, left_out=gone)


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
    if model != AUTO and not is_built_in("vehicle_model", model):
        models = [AUTO, *names("vehicle_model")]
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
    assigned = assign_drivers(scenario.agents, mode, drives_ego=drives_ego, reactive=reactive)
    groups, choices = agent_groups(assigned, clock, mode, model)
    traffic = reactive_traffic(scenario.agents, groups, clock, foresight)
    return World(groups, clock, assigned["static"], traffic, choices, sight_m)
