"""The part of a scenario that a picture shows, and how."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import MARGIN_S, Scenario
from log2sim.errors import ConfigError
from log2sim.files.plugins import nearest

STILL, MOVING = (".png", ".svg", ".pdf"), (".gif", ".mp4", ".webm")
IN_PIXELS = (".png", *MOVING)  # kinds of pictures that have pixels
# A .gif of more frames is large; films at the rate of the logs would jerk, and states between waypoints are known.
FPS = {".gif": 10.0, ".mp4": 25.0, ".webm": 25.0}
MIN_FPS = 1.0
# A .gif states the time of a frame in hundredths of a second, and browsers slow down those of one hundredth.
MAX_FPS = {".gif": 50.0, ".mp4": 120.0, ".webm": 120.0}
# What lasts longer is shown faster than real time unless the speed is given, and the picture says so.
MAX_REAL_TIME_S = {".gif": 30.0, ".mp4": 60.0, ".webm": 60.0}
MIN_SIDE_PX, MAX_SIDE_PX = 240, 7680
MAX_SPEED = 1000.0
MIN_EXTENT_M = 1.0


@dataclass(frozen=True)
class PlotOptions:
    """What a picture shows and how; None stands for a choice that fits the scenario."""

    size_px: tuple[int, int] | None = None  # (width, height) of pictures that have pixels
    fps: float | None = None  # frames of a film a second
    speed: float | None = None  # how many times faster than real time a film plays
    # start_s, stop_s: range of the scenario's time.
    start_s: float | None = None
    stop_s: float | None = None
    # (x0, y0, x1, y1) or None, m two opposite corners of the part of the map, map frame. A picture of other
    # proportions shows more of the map.
    extent_m: tuple[float, float, float, float] | None = None
    agents: tuple[str, ...] | None = None  # ids of the agents that are shown; None for all
    label_static: bool = False  # whether static agents have labels too; those that are doubtful always have

    def require_fits(self, suffix: str, name: str) -> None:
        """Raise `ConfigError` when a file with this suffix and name has no such options, or a value is out of its limits."""
        moving = suffix in MOVING
        for option, value in (("fps", self.fps), ("speed", self.speed)):
            if value is not None and not moving:
                raise ConfigError(f"{option}: {name} is a still picture; choose a name that ends in {_listed(MOVING)}")
        if self.fps is not None and not MIN_FPS <= self.fps <= MAX_FPS[suffix]:
            raise ConfigError(
                f"fps: {self.fps:g}, expected {MIN_FPS:g} to {MAX_FPS[suffix]:g} frames a second in a {suffix}"
            )
        if self.speed is not None and not 1 / MAX_SPEED <= self.speed <= MAX_SPEED:
            raise ConfigError(f"speed: {self.speed:g}, expected {1 / MAX_SPEED:g} to {MAX_SPEED:g} times real time")
        if self.size_px is not None:
            width, height = self.size_px
            if suffix not in IN_PIXELS:
                raise ConfigError(f"size: {name} has no pixels; choose a name that ends in {_listed(IN_PIXELS)}")
            if not (MIN_SIDE_PX <= width <= MAX_SIDE_PX and MIN_SIDE_PX <= height <= MAX_SIDE_PX):
                raise ConfigError(f"size: {width}x{height}, expected sides of {MIN_SIDE_PX} to {MAX_SIDE_PX} px")
            if suffix in (".mp4", ".webm") and (width % 2 or height % 2):
                raise ConfigError(f"size: {width}x{height}, expected even sides, which films have")
        if self.extent_m is not None:
            x0, y0, x1, y1 = self.extent_m
            if not (abs(x1 - x0) >= MIN_EXTENT_M and abs(y1 - y0) >= MIN_EXTENT_M):
                shown = ",".join(f"{v:g}" for v in self.extent_m)
                raise ConfigError(
                    f"extent: {shown}, expected two corners X0,Y0,X1,Y1 at least {MIN_EXTENT_M:g} m apart in x and y"
                )


NO_OPTIONS = PlotOptions()


def parse_size(text: str | None) -> tuple[int, int] | None:
    """Read a size such as "1280x720"; None stays None.

    Raises `ConfigError` for anything but two whole numbers with an x between them.
    """
    if text is None:
        return None
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isascii() and part.isdigit() and len(part) < 6 for part in parts):
        raise ConfigError(f"size: '{text}', expected width and height in pixels such as 1280x720")
    return int(parts[0]), int(parts[1])


def parse_extent(text: str | None) -> tuple[float, float, float, float] | None:
    """Read two corners such as "-20,-10,60,40"; None stays None.

    Raises `ConfigError` for anything but four finite numbers.
    """
    if text is None:
        return None
    try:
        x0, y0, x1, y1 = (float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"extent: '{text}', expected two corners X0,Y0,X1,Y1 in m such as -20,-10,60,40") from None
    if not all(abs(v) < 1e9 for v in (x0, y0, x1, y1)):
        raise ConfigError(f"extent: '{text}', expected finite numbers of meters")
    return x0, y0, x1, y1


def parse_ids(text: str | None) -> tuple[str, ...] | None:
    """Read ids separated by commas; None stays None.

    Raises `ConfigError` when it names nobody.
    """
    if text is None:
        return None
    ids = tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))
    if not ids:
        raise ConfigError("agents: names nobody; give ids separated by commas, or leave it out to show all")
    return ids


def _listed(suffixes: tuple[str, ...]) -> str:
    return ", ".join(suffixes[:-1]) + f" or {suffixes[-1]}"


@dataclass(frozen=True)
class TimeRange:
    """A range of a scenario's time."""

    start_s: float
    stop_s: float

    @property
    def duration_s(self) -> float:
        """Return how long it is."""
        return self.stop_s - self.start_s

    def holds(self, t_s: Any) -> NDArray[np.bool_]:
        """Mark the times within."""
        t = np.asarray(t_s, dtype=np.float64)
        return (t >= self.start_s - MARGIN_S) & (t <= self.stop_s + MARGIN_S)


def choose_span(scenario: Scenario, options: PlotOptions) -> TimeRange:
    """Return the range of time that the options ask for.

    Raises `ConfigError` when it is empty or none of it is in the scenario.
    """
    start = 0.0 if options.start_s is None else options.start_s
    stop = scenario.duration_s if options.stop_s is None else min(options.stop_s, scenario.duration_s)
    if not (0.0 <= start < stop or (options.start_s is None and options.stop_s is None)):
        asked = "end" if options.stop_s is None else f"{options.stop_s:g}"
        raise ConfigError(
            f"start, stop: {start:g} to {asked} s, expected a range within the scenario, 0 to {scenario.duration_s:g} s"
        )
    return TimeRange(start, stop)


def select_shown(scenario: Scenario, replay: Any, options: PlotOptions) -> tuple[Scenario, Any]:
    """Return the scenario and its replay with the agents that the options name alone.

    Raises `ConfigError` for an id that no agent has.
    """
    if options.agents is None:
        return scenario, replay
    known = [agent.id for agent in scenario.agents]
    for id in options.agents:
        if id not in known:
            raise ConfigError(f"agents: '{id}' is no agent of {scenario.name or 'the scenario'}{nearest(id, known)}")
    scenario = replace(scenario, agents=tuple(a for a in scenario.agents if a.id in options.agents))
    if replay is None:
        return scenario, None
    collisions = [e for e in replay.metrics.get("collisions", ()) if set(e["agents"]) <= set(options.agents)]
    warned = None if replay.warnings is None else replay.warnings.events
    warned = warned and [e for e in warned if {e.driver, e.agent} <= set(options.agents)]
    agents = [a for a in replay.agents if a.id in options.agents]
    return scenario, _with(replay, agents, collisions, warned)


def _with(replay: Any, agents: list[Any], collisions: list[Any], warned: Any) -> Any:
    """Return a replay with these agents, collisions and warnings."""
    warnings = replay.warnings and replace(replay.warnings, events=tuple(warned))
    metrics = {**replay.metrics, "collisions": collisions}
    return replace(replay, agents=tuple(agents), metrics=metrics, warnings=warnings)


def cut_scenario(scenario: Scenario, span: TimeRange) -> Scenario:
    """Return a scenario with what is within a range of its time; times stay, and agents that are not there go."""
    if span.start_s <= 0.0 and span.stop_s >= scenario.duration_s:
        return scenario
    agents = []
    for agent in scenario.agents:
        w = agent.waypoints
        first, last = max(span.start_s, float(w.t_s[0])), min(span.stop_s, float(w.t_s[-1]))
        if agent.is_permanent:
            agents.append(agent)
        elif first <= last:  # its waypoints within the range, and interpolated ones at the ends
            inside = w.t_s[(w.t_s > first + MARGIN_S) & (w.t_s < last - MARGIN_S)]
            t_s = np.concatenate([[first], inside, [last] if last > first else []])
            taken = w.take(np.searchsorted((w.t_s[1:] + w.t_s[:-1]) / 2, t_s))  # the nearest ones
            states = agent.at(t_s)
            exact = {name: getattr(states, name) for name in ("x_m", "y_m", "z_m", "yaw_rad", "speed_mps")}
            agents.append(replace(agent, waypoints=replace(taken, t_s=t_s, **exact)))
    return replace(scenario, agents=tuple(agents), duration_s=span.stop_s)


def cut_replay(replay: Any, span: TimeRange, scenario: Scenario) -> Any:
    """Return a replay with what is within a range of the scenario's time."""
    if replay is None or (span.start_s <= 0.0 and span.stop_s >= scenario.duration_s):
        return replay
    agents = []
    for agent in replay.agents:
        keep, t_s = span.holds(agent.t_s), agent.t_s
        if keep.any():
            commands = agent.commands
            if commands is not None:
                commands = replace(commands, **{name: getattr(commands, name)[keep] for name in commands.COLUMNS})
            columns = {name: getattr(agent, name) for name in (*agent.COLUMNS, *agent.ERRORS)}
            kept = {name: None if column is None else column[keep] for name, column in columns.items()}
            agents.append(replace(agent, commands=commands, **kept))
        elif len(t_s) and t_s[0] < span.start_s and t_s[-1] > span.stop_s:  # what stands has a state at each end
            agents.append(agent)
    there = {agent.id for agent in agents}
    events = [e for e in replay.metrics.get("collisions", ()) if span.holds(e["t_s"]) and set(e["agents"]) <= there]
    warned = () if replay.warnings is None else (w for w in replay.warnings.events if w.warned is not None)
    in_time = [w for w in warned if span.holds(w.warned.t_s) and {w.driver, w.agent} <= there]
    return _with(replay, agents, events, in_time)
