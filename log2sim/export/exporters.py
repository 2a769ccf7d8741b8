"""Exporters: each format is a plug-in that writes into an empty folder."""

from __future__ import annotations

import errno
import re
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import MARGIN_S, Agent, Log, MapFrame, Scenario
from log2sim.errors import ConfigError, ScenarioError
from log2sim.export.checks import require_exportable
from log2sim.files import plugins
from log2sim.files.documents import check_folder, refuse_existing
from log2sim.files.outputs import expect_new, place_all, temporary_beside, unfinished_folder, written_meanwhile
from log2sim.geometry import Array, whole_kilometers, wrap_angle

EXTERNAL = "external"  # as the ego of an export: another program drives it, from its place and speed in the scenario


@dataclass(frozen=True)
class ExportPlacement:
    """Converts x, y, z, heading between a scenario and an export.

    Positions of the scenario plus `offset_m` are coordinates of `projection`. With a `target` they are projected into
    it, else they stay on their axes; then `origin_m` is subtracted.
    """

    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    projection: str | None = None  # PROJ string, as the next one
    target: str | None = None

    def forward(self, states: Array) -> Array:
        """Convert states (N, 4) x, y, z, heading from the scenario to the export."""
        if self.target is not None:
            states = self._projected(states + np.array([*self.offset_m, 0.0]), self.projection, self.target)
        return np.asarray(states - np.array([*self.origin_m, 0.0]))

    def back(self, states: Array) -> Array:
        """Convert states (N, 4) from the export to the scenario."""
        states = states + np.array([*self.origin_m, 0.0])
        if self.target is None:
            return states
        return np.asarray(self._projected(states, self.target, self.projection) - np.array([*self.offset_m, 0.0]))

    @staticmethod
    def _projected(states: Array, source: str | None, target: str | None) -> Array:
        """Project states; a heading turns by as much as a step of 1 m along it."""
        transformer = _transformer(str(source), str(target))
        x, y, z, heading = states.T
        east, north = transformer.transform(x, y)
        ahead = transformer.transform(x + np.cos(heading), y + np.sin(heading))
        turned = wrap_angle(np.arctan2(ahead[1] - north, ahead[0] - east) - heading)
        out = np.column_stack([east, north, z, heading + turned])
        if not np.isfinite(out).all():
            raise ConfigError(
                f"positions of the scenario have no coordinates in '{target}'; is this the map of the same place?"
            )
        return out


def near_origin(scenario: Scenario) -> ExportPlacement:
    """Subtract whole kilometers, none while all agents are near the map's origin, so that float32 keeps half a millimeter."""
    xyz = np.concatenate([np.stack([w.x_m, w.y_m, w.z_m], 1) for w in (a.waypoints for a in scenario.agents)])
    x, y, z = whole_kilometers(xyz)
    return ExportPlacement((float(x), float(y), float(z)))


def on_map(frame: MapFrame, projection: str | None, offset_m: tuple[float, float, float]) -> ExportPlacement:
    """Place positions on a map, whose projected coordinates are its own plus its offset.

    Where either side lacks a projection, the scenario's axes are taken to be those of the map.
    """
    if frame.projection is None or not projection:
        return ExportPlacement()
    if _proj_parameters(frame.projection) == _proj_parameters(projection):
        x, y, z = (float(m - s) for m, s in zip(offset_m, frame.offset_m))
        return ExportPlacement((x, y, z))
    return ExportPlacement(offset_m, frame.offset_m, frame.projection, projection)


def project_points(frame: MapFrame, points_m: Array) -> tuple[Array, Array]:
    """Return longitude and latitude (N,), degrees, of points (N, 3) of a map; around its origin, or 0, 0, where it has no projection."""
    if frame.projection is not None:
        source, offset = frame.projection, np.array(frame.offset_m)
    else:
        source = f"+proj=tmerc +lat_0={frame.latitude_deg or 0} +lon_0={frame.longitude_deg or 0} +ellps=WGS84"
        offset = np.zeros(3)
    x, y = (points_m + offset)[:, :2].T
    longitude, latitude = _transformer(source, "+proj=longlat +ellps=WGS84").transform(x, y)
    return np.asarray(longitude), np.asarray(latitude)


def geo_reference(projection: str) -> str:
    """Return a PROJ string with the same coordinates in the words that esmini reads, too; others stay as they are.

    esmini requires lat_0 and lon_0, and knows neither R, south, no_defs nor type. UTM is the transverse Mercator projection
    about the middle of its zone, a sphere of radius R has both axes R, and PROJ takes 0 for an origin that is not given.
    """
    words = dict(w.partition("=")[::2] for w in projection.split() if w.split("=")[0] not in ("+no_defs", "+type"))
    if words.get("+proj") == "utm" and words.get("+zone", "").isdecimal():
        middle_deg, false_northing = 6 * int(words.pop("+zone")) - 183, 10_000_000 if "+south" in words else 0
        words.pop("+south", None)
        words |= {"+proj": "tmerc", "+lat_0": "0", "+lon_0": str(middle_deg), "+k": "0.9996", "+x_0": "500000"}
        words["+y_0"] = str(false_northing)
    if "+R" in words:
        words["+a"] = words["+b"] = words.pop("+R")
    if "+proj" in words:
        words = {"+lat_0": "0", "+lon_0": "0"} | words
    return " ".join(f"{name}={value}" if value else name for name, value in words.items())


def _proj_parameters(projection: str) -> list[str]:
    """Return the parameters of a PROJ string in order, without those for heights and file names."""
    words = geo_reference(projection).split()
    return sorted(w for w in words if not w.startswith(("+geoidgrids", "+nadgrids", "+vunits")))


def _transformer(source: str, target: str) -> Any:
    from pyproj import CRS, Transformer
    from pyproj.exceptions import ProjError

    systems = []
    for text in (source, target):
        words = _proj_parameters(text)
        if not any(w.startswith("+proj=") for w in words):
            raise ConfigError(f"'{text[:100]}' is no PROJ string, expected one such as +proj=utm +zone=32")
        try:
            systems.append(CRS.from_proj4(" ".join(words)))
        except ProjError as error:
            raise ConfigError(f"'{text[:100]}' is no projection: {error}") from None
    return Transformer.from_crs(systems[0], systems[1], always_xy=True)


# Half the span of difference quotients: half a step of most logs, so adjacent waypoints decide them.
DERIVATIVE_S = 0.05
MAX_STEPS = 100_000  # 2.8 hours at 10 Hz
# Memory of a table of all agents: at 2.8 hours 160 of them.
MAX_SAMPLED_BYTES = 1536 * 1024 * 1024
BYTES_PER_STATE = 96


@dataclass(frozen=True, eq=False)
class SampledMotion:
    """States of one agent at requested times (T,), zero where `valid` is False."""

    valid: NDArray[np.bool_]  # (T,)
    position_m: Array  # (T, 3) box center
    yaw_rad: Array  # (T,), in [-pi, pi)
    # velocity_mps, acceleration_mps2: (T, 2) of the box center, on the axes of the positions.
    velocity_mps: Array
    acceleration_mps2: Array


def sample_motion(agent: Agent, t_s: Array, margin_s: float = MARGIN_S) -> SampledMotion:
    """Sample an agent at times (T,); times within `margin_s` outside its lifetime take the nearest end.

    The speed of waypoints is along the heading. Where an agent turns, its box center also moves laterally, by yaw rate
    times its distance from the rear axle; without that term velocities contradict the positions.
    """
    w = agent.waypoints
    at = agent.at(t_s, margin_s=margin_s)
    inside = np.clip(t_s, w.t_s[0], w.t_s[-1])
    before, after = np.maximum(inside - DERIVATIVE_S, w.t_s[0]), np.minimum(inside + DERIVATIVE_S, w.t_s[-1])
    change = _velocity(agent, after) - _velocity(agent, before)
    columns = {
        "position_m": np.stack([at.x_m, at.y_m, at.z_m], axis=-1),
        "yaw_rad": at.yaw_rad,
        "velocity_mps": _velocity(agent, inside),
        "acceleration_mps2": _rates(change, after - before),
    }
    zeroed = {k: np.where(at.valid if v.ndim == 1 else at.valid[:, None], v, 0.0) for k, v in columns.items()}
    return SampledMotion(valid=at.valid, **zeroed)


def _velocity(agent: Agent, t_s: Array) -> Array:
    """Return the velocity (T, 2) of the box center at times (T,) within the agent's lifetime."""
    w = agent.waypoints
    yaw = np.unwrap(w.yaw_rad)
    before, after = np.maximum(t_s - DERIVATIVE_S, w.t_s[0]), np.minimum(t_s + DERIVATIVE_S, w.t_s[-1])
    turned = np.interp(after, w.t_s, yaw) - np.interp(before, w.t_s, yaw)
    heading, speed = np.interp(t_s, w.t_s, yaw), np.interp(t_s, w.t_s, w.speed_mps)
    sideways = _rates(turned[:, None], after - before)[:, 0] * agent.rear_axle_offset_m
    c, s = np.cos(heading), np.sin(heading)
    return np.stack([speed * c - sideways * s, speed * s + sideways * c], axis=-1)


def _rates(change: Array, span_s: Array) -> Array:
    """Return rates (T, k) of changes (T, k); zero for an agent with a single waypoint."""
    rates: Array = np.zeros_like(change)
    np.divide(change, span_s[:, None], out=rates, where=span_s[:, None] > 0)
    return rates


def sample_steps(agent: Agent, t_s: Array, step_s: float, at_least: int = 1) -> SampledMotion:
    """Sample an agent at equal steps (T,) of `step_s`.

    An agent that lives between two steps, or less than a step after the last, takes the `at_least` nearest steps, so
    that no agent is lost.
    """
    sampled = sample_motion(agent, t_s)
    if sampled.valid.sum() >= at_least:
        return sampled
    past_s = agent.waypoints.t_s[0] - t_s[-1]
    after = past_s + (at_least - 1) * step_s if 0 < past_s < step_s else 0.0
    return sample_motion(agent, t_s, margin_s=max(at_least * step_s / 2, after + MARGIN_S))


def step_times(start_s: float, stop_s: float, step_s: float, agents: int = 1) -> Array:
    """Return times (T,) from `start_s` in equal steps up to `stop_s`, at least one, at which a number of agents are sampled.

    Raises `ScenarioError` for more than `MAX_STEPS`, or states of all agents of more than `MAX_SAMPLED_BYTES`, before
    anything is allocated.
    """
    steps = (stop_s - start_s) / step_s + 1e-6
    if steps > MAX_STEPS:
        raise ScenarioError(
            f"waypoints span {stop_s - start_s:g} s, at most {MAX_STEPS * step_s:g} s can be exported in steps of "
            f"{step_s:g} s; cut the scenario into parts"
        )
    if (sampled := agents * steps * BYTES_PER_STATE) > MAX_SAMPLED_BYTES:
        raise ScenarioError(
            f"{agents} agents over {stop_s - start_s:g} s: their samples take {sampled / 2**30:.3g} GiB, at most "
            f"{MAX_SAMPLED_BYTES / 2**30:g} GiB can be exported; cut the scenario into parts"
        )
    return start_s + step_s * np.arange(int(steps) + 1, dtype=np.float64)


def file_name(text: str) -> str:
    """Return a file name for any text: letters, digits, dot, dash and underscore, never empty or hidden."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", text).lstrip(".")[:100] or "scenario"


@dataclass(frozen=True)
class Options:
    """Options of an export; None leaves the choice to the format, which lists the options that it takes."""

    revision: str | None = None  # of the format's standard
    map: Path | None = None  # A road network to use in place of an inferred one
    mode: str | None = None  # "exact" or "pid", for scripts that move agents
    log: Log | None = None  # the opened log, for formats that also hold its images and points
    ego: str | None = None  # `EXTERNAL`, for an ego without a trajectory


class Exporter(Protocol):
    """A format that scenarios can be written in."""

    @property
    def options(self) -> tuple[str, ...]:
        """Names of the fields of `Options` that the format takes."""
        ...

    @property
    def loses(self) -> str:
        """What of a scenario the format cannot hold."""
        ...

    def write(self, scenario: Scenario, folder: Path, options: Options) -> None:
        """Write files into an empty folder that exists.

        Raises `ConfigError` when the value of an option cannot be used. Raises `MissingExtra` when what the format
        needs is not installed. Raises `ScenarioError` when the format cannot hold the scenario at all; names the agent
        and the reason.
        """
        ...


def formats() -> list[str]:
    """Return the names of all formats, built-in ones first."""
    return plugins.names("export")


def export(
    scenario: Scenario,
    to: str,
    out: Path | str,
    options: Options | None = None,
    *,
    quarantined: bool = False,
    overwrite: bool = False,
) -> tuple[Path, ...]:
    """Write a scenario in the format `to` into the folder `out`, all files or none; return them in order of name.

    Agents whose confidence is too low (`Agent.quarantined`) are left out unless `quarantined` says otherwise.

    Raises `ConfigError` for an unknown format, an option that it does not understand, or files that exist and may not
    be replaced. Raises `ScenarioError` when the scenario breaks what players of the formats rely on; see
    `log2sim.export.checks`.
    """
    exporter: Exporter = plugins.load("export", to)
    chosen = options or Options()
    for field in fields(Options):
        if getattr(chosen, field.name) is not None and field.name not in exporter.options:
            known = ", ".join(f"--{name}" for name in exporter.options) or "none"
            raise ConfigError(f"--{field.name}: format '{to}' has no such option; it has {known}")
    scenario = scenario if quarantined else scenario.active
    require_exportable(scenario)
    folder = Path(out)
    check_folder(folder, overwrite=overwrite)
    # In the folder itself if it exists, since it may be on another file system than its parent.
    parent = folder if folder.is_dir() else folder.parent
    with unfinished_folder(temporary_beside(parent / folder.name), folder) as temporary:
        with plugins.blaming("export", to):
            exporter.write(scenario, temporary, chosen)
        # All files are moved, after checking that all may be written.
        names = sorted(p.relative_to(temporary) for p in temporary.rglob("*") if p.is_file())
        targets = tuple(folder / name for name in names)
        for target in targets:
            refuse_existing(target, overwrite=overwrite)
            if target.is_dir():
                raise ConfigError(f"{target}: is a folder, where a file would be written; choose another folder")
        if not folder.exists():
            try:
                temporary.rename(folder)  # all files at once
            except OSError as error:
                if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                    raise written_meanwhile(folder) from None
                raise
            return targets
        if not overwrite:
            expect_new(targets)
        place_all([(temporary / name, folder / name) for name in names])
        return targets


def make_ego(scenario: Scenario, agent: str) -> Scenario:
    """Call one of the agents "ego", as scenarios of roadside sensors need it for formats with an ego.

    Raises `ConfigError` when the scenario has another ego or no such agent.
    """
    ids = [a.id for a in scenario.agents]
    if agent not in ids:
        known = ", ".join(ids) or "none"
        raise ConfigError(f"--ego: no agent '{agent}'{plugins.nearest(agent, ids)}; the scenario has {known}")
    if scenario.ego is not None and agent != "ego":
        raise ConfigError(f"--ego {agent}: scenario '{scenario.name}' has an ego already; leave the option out")
    return replace(scenario, agents=tuple(replace(a, id="ego") if a.id == agent else a for a in scenario.agents))


def filter_doubtful(scenario: Scenario, choice: str) -> Scenario:
    """Return a scenario with its doubtful agents but the quarantined ("keep"), without ("drop"), or with all of them ("all").

    Raises `ConfigError` for another choice.
    """
    choices = {"keep": scenario.active, "drop": scenario.drop_doubtful(), "all": scenario}
    if choice not in choices:
        raise ConfigError(f"--doubtful: '{choice}', expected {', '.join(choices)}")
    return choices[choice]
