"""Replays a scenario: assigns drivers, runs the simulation and evaluates the result."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from log2sim.datatypes import EGO, Agent, Scenario
from log2sim.errors import ConfigError, ScenarioError
from log2sim.registry import is_built_in, names, nearest
from log2sim.simulation.drivers import agent_groups, assign_drivers, reactive_ids, reactive_traffic
from log2sim.simulation.policy import SIGHT_M, Policy, reset_policy
from log2sim.simulation.reactive.foresight import FORESIGHTS
from log2sim.simulation.recording import RecordedTracks
from log2sim.simulation.replay_result import replay_result
from log2sim.simulation.result import Replay
from log2sim.simulation.rollout import Progress, World, rollout
from log2sim.simulation.simulators import ExternalSimulator
from log2sim.simulation.step_clock import StepClock
from log2sim.simulation.vehicles.model_choice import AUTO, ModelChoice
from log2sim.simulation.vehicles.parameters import WHEELED

MODES = ("pid", "exact")
DT_RANGE_S = (0.0005, 1.0)
MAX_STEPS = 20_000_000


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

    Parameters
    ----------
    scenario : Scenario
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
        have moved so far, see `log2sim.prediction`.
    sight_m : float
        Range within which the ego's policy observes other agents, center to center.
    host : Host, optional
        External simulator that moves the agents, such as `log2sim.simulation.carla.simulator.CarlaSimulator`. It has its own
        vehicle models, so `model` is not used.
    quarantined : bool
        Whether agents whose confidence is too low, see `Agent.quarantined`, are there too.
    progress : callable, optional
        Called now and then with the number of steps done and of all steps.

    Raises
    ------
    ConfigError
        When an argument is out of its range, or a policy is given for a scenario without an ego on wheels.
    ScenarioError
        When an agent has no waypoints, or waypoints that are not finite or not in the order of time.

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
        result = replay_result(scenario, world.groups, tracks, world.clock, world.choices, mode, model)
        return replace(result, left_out=gone)
    tracks = _rollout_externally(world, host, ego, progress)
    choices = {k: ModelChoice(host.name, "the simulator's own") for k in world.choices}
    result = replay_result(scenario, world.groups, tracks, world.clock, choices, mode, host.name)
    return replace(result, left_out=gone)


def _rollout_externally(
    world: World, host: ExternalSimulator, ego: Policy | None, progress: Progress | None
) -> RecordedTracks:
    """Let an external simulator run a world to its end; the simulator is restored in any case."""
    if world.clock.dt_s > host.max_dt_s:
        raise ConfigError(f"dt: {world.clock.dt_s} s, {host.name} takes at most {host.max_dt_s:g} s")
    host.open(world.groups, world.clock, world.statics)
    world.host = host
    try:
        return rollout(world, ego, progress)
    finally:
        host.close()


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
    clock = _clock(scenario.agents, dt_s)
    reactive = reactive_ids(scenario.agents, agents, drives_ego=drives_ego)
    assigned = assign_drivers(scenario.agents, mode, drives_ego=drives_ego, reactive=reactive)
    groups, choices = agent_groups(assigned, clock, mode, model)
    traffic = reactive_traffic(scenario.agents, groups, clock, foresight)
    return World(groups, clock, assigned["static"], traffic, choices, sight_m)


def _clock(agents: Sequence[Agent], dt_s: float) -> StepClock:
    begin_s = min((float(a.waypoints.t_s[0]) for a in agents), default=0.0)
    end_s = max((float(a.waypoints.t_s[-1]) for a in agents), default=0.0)
    clock = StepClock.spanning(begin_s, end_s, dt_s)
    if clock.steps > MAX_STEPS:
        raise ScenarioError(
            f"waypoints span {end_s - begin_s:g} s, {clock.steps} steps of {dt_s} s; at most {MAX_STEPS} can be run"
        )
    return clock
