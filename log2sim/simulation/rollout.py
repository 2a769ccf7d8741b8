"""The loop of a replay: agents appear when their lifetime begins, are driven step by step, and are removed at its end."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent
from log2sim.simulation.follower import control_step
from log2sim.simulation.groups import (
    AgentGroup,
    PolicyObserver,
    PolicyVehicle,
    RecordedTracks,
    StepClock,
    WindowRecording,
    merged_tracks,
)
from log2sim.simulation.policy import SIGHT_M, Controls, Observation, Policy, query_policy
from log2sim.simulation.reactive import Traffic
from log2sim.simulation.reference import GRID_S
from log2sim.simulation.simulators import ExternalSimulator
from log2sim.simulation.vehicles.model_choice import ModelChoice

WINDOW_S = 10.0  # reference tables are at hand for the agents that live within this time

Progress = Callable[[int, int], None]


class World:
    """All agents on one clock, moved one step at a time.

    Between two calls the world is at `step`, and agents whose lifetime begins there have been placed. `advance` moves it on,
    until `done`. With an external simulator in `host`, groups only compute controls, and its tick moves the agents.

    `statics`: agents that never move; they are in no group. `traffic`, optional: decides the speeds of reactive agents.
    `choices`, optional: by id, the model that moves each vehicle and why. `sight_m`: range within which the ego's policy
    observes other agents.
    """

    def __init__(
        self,
        groups: Sequence[AgentGroup],
        clock: StepClock,
        statics: Sequence[Agent] = (),
        traffic: Traffic | None = None,
        choices: Mapping[str, ModelChoice] | None = None,
        sight_m: float = SIGHT_M,
    ) -> None:
        self.groups, self.clock, self.statics, self.traffic = tuple(groups), clock, tuple(statics), traffic
        self.choices = dict(choices or {})
        self.host: ExternalSimulator | None = None
        self.ego = next((g for g in groups if isinstance(g, PolicyVehicle)), None)
        self._observer = PolicyObserver(self.ego, self.groups, self.statics, sight_m) if self.ego is not None else None
        self._arrivals = [_placements(group, clock) for group in groups]
        self._width = max(1, round(WINDOW_S / clock.dt_s))
        self.restart()

    def restart(self) -> None:
        """Go back to the first step and discard what was recorded."""
        self.step = 0
        self._busy: list[tuple[AgentGroup, dict[int, NDArray[np.intp]]]] = []
        self._records: list[WindowRecording] = []
        self._window: list[WindowRecording] = []
        if self.traffic is not None:
            self.traffic.restart()
        if self.ego is not None:
            self.ego.controls = Controls(0.0, 0.0)
        if self._observer is not None:
            self._observer.restart()
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
        else:
            self._react(self.traffic)
        if self.host is not None:
            self.host.tick(self.step)
        self.step += 1
        self._arrive()

    def tracks(self) -> RecordedTracks:
        """Return what has been recorded so far."""
        return merged_tracks(self._records)

    def _react(self, traffic: Traffic) -> None:
        """Move all agents by one step, in parts of at most one control step, so that reactive agents respond within a long step."""
        held_s = control_step(self.clock.dt_s)
        for part in range(round(self.clock.dt_s / held_s)):
            t_s = self.t_s + part * held_s
            for group, _ in self._busy if part else ():
                group.look_up(t_s)
            traffic.decide(t_s, held_s, self.ego.snapshot() if self.ego is not None else None)
            for group, _ in self._busy:
                group.advance(held_s)

    def _arrive(self) -> None:
        """Update the references of this step, place agents whose lifetime begins, and record states."""
        step, t_s = self.step, self.t_s
        if step % self._width == 0:
            self._open_window()
        for group, placed in self._busy:
            group.look_up(t_s)
            if step in placed:
                group.place(placed[step], t_s)
        if step % self.clock.store_every == 0:
            for record in self._window:
                record.add()

    def _open_window(self) -> None:
        end = min(self.step + self._width, self.clock.steps)
        for group in self.groups:
            group.open_window(self.step, end, self.t_s, self.clock.time(end))
        self._busy = [(g, a) for g, a in zip(self.groups, self._arrivals) if len(g.live)]
        self._window = [WindowRecording(group, self.step, end, self.clock.store_every) for group, _ in self._busy]
        self._records += self._window


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
    return world.tracks()


def _placements(group: AgentGroup, clock: StepClock) -> dict[int, NDArray[np.intp]]:
    """By step, list the agents that are put on their references: at the start of their lifetime and after a discontinuity."""
    placed: dict[int, list[int]] = defaultdict(list)
    for i, reference in enumerate(group.references):
        if group.last[i] < group.first[i]:
            continue
        placed[int(group.first[i])].append(i)
        if group.follows_scenario_time:
            # The table blends both sides of a discontinuity over one row, so the agent is placed again after that row.
            jumps_s = reference.trajectory.discontinuity_times()
            for step in clock.first_step(np.concatenate([jumps_s, jumps_s + GRID_S])):
                if group.first[i] < step <= group.last[i]:
                    placed[int(step)].append(i)
    return {step: np.unique(index) for step, index in placed.items()}
