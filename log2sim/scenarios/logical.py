"""Logical scenarios: the parameters of a situation with the distribution of all that were found, and concrete scenarios of it.

Terms as in Menzel, Bagschik and Maurer, "Scenarios for Development, Test and Validation of Automated Vehicles" (IV 2018): a logical
scenario has ranges and distributions of parameters, a concrete one their values.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from log2sim.datatypes import Agent, Scenario, Waypoints
from log2sim.edit.apply import find_problems
from log2sim.errors import ConfigError
from log2sim.export.exporters import Options, export
from log2sim.export.xml_text import element, number, read, unique_names, write
from log2sim.files.plugins import nearest
from log2sim.geometry import Array
from log2sim.scenarios.index import Row
from log2sim.scenarios.tagging import find_tags
from log2sim.scenarios.traffic import Traffic
from log2sim.simulation.prediction.motion_table import TICK_S

MIN_HITS = 5  # of which a distribution is fitted
# A concrete scenario shows a situation with a second before and after it, at least and at most so long before and after its moment.
BEFORE_S, AFTER_S = (3.0, 6.0), (4.0, 8.0)
PAD_S = 20.0  # for which agents are continued before and after, so that a slower or later one is there throughout
GRID = 1024  # points of a marginal distribution
SAMPLERS = ("sobol", "lhs", "random")


class Timing(NamedTuple):
    """How a quantity of a tag depends on when its agent comes: larger, it comes `sign` times the difference later."""

    quantity: str
    sign: float
    role: str = ""  # whose speed divides a distance: who passes the agent's place meanwhile, or the agent itself


TIMING: Mapping[str, Timing | None] = {
    "cut_in": Timing("gap_m", -1.0, "other"), "cut_out": Timing("gap_m", -1.0, "other"),
    "merging": Timing("gap_m", -1.0, "other"), "following": Timing("gap_m", 1.0, "agent"),
    "approaching": Timing("gap_m", 1.0, "agent"), "crossing_path": Timing("pet_s", -1.0),
    "stepping_out": Timing("ttc_s", -1.0), "overtaking": None, "lane_change": None, "hard_braking": None,
    "turning": None,
}  # fmt: skip
"""Tags that can be varied, and what besides the speeds of both agents is."""


@dataclass(frozen=True, eq=False)
class Logical:
    """Parameters of a logical scenario with their joint distribution: a Gaussian copula over kernel densities."""

    names: tuple[str, ...]  # of D parameters, with units
    values: Array  # (N, D): that were found

    @cached_property
    def _logarithmic(self) -> Array:
        """Whether a parameter is positive throughout (D,), so that its logarithm is distributed."""
        return np.asarray((self.values > 0).all(axis=0))

    def _inner(self, x: Array) -> Array:
        return np.where(self._logarithmic, np.log(np.where(self._logarithmic, x, 1.0)), x)

    @cached_property
    def _kernels(self) -> tuple[Array, Array]:
        """Centers (N, D) and widths (D,) by Scott's rule."""
        inner = self._inner(self.values)
        spread = inner.std(axis=0, ddof=1)
        return inner, np.maximum(spread * len(inner) ** -0.2, 1e-6 * np.maximum(np.abs(inner).max(axis=0), 1.0))

    @cached_property
    def _grids(self) -> tuple[Array, Array]:
        """Values (G, D) and their cumulative probabilities."""
        from scipy.special import ndtr

        centers, width = self._kernels
        at = np.linspace(centers.min(axis=0) - 5 * width, centers.max(axis=0) + 5 * width, GRID)
        p = [ndtr((at[:, None, k] - centers[:, k]) / width[k]).mean(axis=1) for k in range(len(self.names))]
        return at, np.stack(p, axis=1)

    def cdf(self, x: Array) -> Array:
        """Return the cumulative probabilities (M, D) of each parameter alone."""
        at, p = self._grids
        inner = self._inner(x)
        return np.stack([np.interp(inner[:, k], at[:, k], p[:, k]) for k in range(len(self.names))], axis=1)

    def quantile(self, p: Array) -> Array:
        """Return the values (M, D) with cumulative probabilities (M, D)."""
        at, known = self._grids
        inner = np.stack([np.interp(p[:, k], known[:, k], at[:, k]) for k in range(len(self.names))], axis=1)
        return np.where(self._logarithmic, np.exp(np.where(self._logarithmic, inner, 0.0)), inner)

    @cached_property
    def correlation(self) -> Array:
        """Correlation (D, D) of the normal scores, as if one more hit had shown none."""
        scores = _normal(self.cdf(self.values))
        scores -= scores.mean(axis=0)
        spread = np.sqrt((scores**2).mean(axis=0))
        # One value for all goes with nothing.
        scores = np.divide(scores, spread, out=np.zeros_like(scores), where=spread > 1e-6)
        found = scores.T @ scores
        np.fill_diagonal(found, len(scores))
        return np.asarray((found + np.eye(len(self.names))) / (len(scores) + 1))

    def from_scores(self, z: Array) -> Array:
        """Return the parameters (M, D) of independent standard normal scores (M, D)."""
        from scipy.special import ndtr

        return self.quantile(ndtr(z @ np.linalg.cholesky(self.correlation).T))

    def sample(self, count: int, sampler: str = "sobol", seed: int = 0) -> Array:
        """Draw parameters (M, D); `sampler` is one of `SAMPLERS`."""
        from scipy.stats import qmc

        if sampler not in SAMPLERS:
            raise ConfigError(
                f"--sampler {sampler}{nearest(sampler, list(SAMPLERS))}: expected one of {', '.join(SAMPLERS)}"
            )
        dimensions, rng = len(self.names), np.random.default_rng(seed)
        if sampler == "sobol":
            # A power of two is balanced; the first of them are nearly.
            u = qmc.Sobol(dimensions, rng=rng).random_base2(max(int(np.ceil(np.log2(max(count, 1)))), 0))[:count]
        else:
            shape = (count, dimensions)
            u = qmc.LatinHypercube(dimensions, rng=rng).random(count) if sampler == "lhs" else rng.random(shape)
        return self.from_scores(_normal(u))

    def to_dict(self) -> dict[str, Any]:
        """Describe the distribution: quantiles of each parameter, and the correlation of their normal scores."""
        levels = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
        table = self.quantile(np.repeat(np.array(levels)[:, None], len(self.names), axis=1))
        parameters = {
            name: {
                "least": float(self.values[:, k].min()), "greatest": float(self.values[:, k].max()),
                "quantiles": {f"{level:g}": float(v) for level, v in zip(levels, table[:, k])},
            }
            for k, name in enumerate(self.names)
        }  # fmt: skip
        return {"hits": len(self.values), "parameters": parameters, "correlation": self.correlation.tolist()}


def _normal(u: Array) -> Array:
    from scipy.special import ndtri

    return np.asarray(ndtri(np.clip(u, 1e-9, 1 - 1e-9)))


def fit(rows: Sequence[Row]) -> Logical:
    """Fit the distribution of the parameters of a situation over the hits of `ask`, all of one tag.

    Raises `ConfigError` for several tags, one that cannot be varied, or fewer than `MIN_HITS` hits with all parameters.
    """
    tags = sorted({row["tag"] for row in rows})
    if len(tags) != 1 or tags[0] not in TIMING:
        raise ConfigError(f"vary: found {', '.join(tags) or 'nothing'}; expected hits of one of {', '.join(TIMING)}")
    timing = TIMING[tags[0]]
    names = [
        "agent.speed_mps",
        *(["other.speed_mps"] if "other" in rows[0] else []),
        *([timing.quantity] if timing else []),
    ]
    values = np.array([[row.get(name, np.nan) for name in names] for row in rows], dtype=np.float64)
    values = values[np.isfinite(values).all(axis=1) & (values[:, 0] > 0.5)]
    if len(values) < MIN_HITS:
        raise ConfigError(
            f"vary: {len(values)} hits have {', '.join(names)}; a distribution needs {MIN_HITS} or more, so ask for less"
        )
    return Logical(tuple(names), values)


@dataclass(frozen=True, eq=False)
class Base:
    """A concrete situation that others are made of: its agents, continued beyond, in times of its own."""

    scenario: Scenario  # with these agents alone, from `-PAD_S` to `PAD_S` after `duration_s`
    moment_s: Mapping[str, float]  # when each agent is where the parameters are of
    row: Row  # the hit

    @classmethod
    def of(cls, scenario: Scenario, row: Row) -> Base:
        """Cut a hit out of its scenario.

        Raises `ConfigError` where its agents are not in the scenario.
        """
        ids = [id for id in (row["agent"], row.get("other")) if id is not None]
        begin_s = row["t_s"] - float(np.clip(row["t_s"] - row["start_s"] + 1.0, *BEFORE_S))
        end_s = row["t_s"] + float(np.clip(row["end_s"] - row["t_s"] + 1.0, *AFTER_S))
        traffic = Traffic(scenario)
        if not set(ids) <= set(traffic.ids):
            raise ConfigError(f"{row['file']}: has no agents {', '.join(ids)}; index it again with --fresh")
        agents = tuple(_continued(traffic, traffic.ids.index(id), begin_s, end_s) for id in ids)
        signals = tuple(replace(signal, t_s=signal.t_s - begin_s) for signal in scenario.signals)
        cut = replace(
            scenario, agents=agents, duration_s=end_s - begin_s, tags=None, signals=signals, cameras=(), sensors=()
        )
        moments = {row["agent"]: row["t_s"] - begin_s}
        if "other" in row:
            # Who crosses second does so at the end.
            moments[row["other"]] = (row["end_s"] if row["tag"] == "crossing_path" else row["t_s"]) - begin_s
        return cls(cut, moments, row)

    def timings(self, logical: Logical, values: Array) -> dict[str, tuple[float, float]]:
        """Return scale and offset, s, of each agent's times by which parameters (D,) come about: t becomes scale t + offset."""
        wanted = dict(zip(logical.names, values.tolist()))
        out = {}
        for role in ("agent", "other"):
            if self.row.get(role) is None:
                continue
            faster = wanted[f"{role}.speed_mps"] / self.row[f"{role}.speed_mps"]
            moment_s, later_s = self.moment_s[self.row[role]], 0.0
            timing = TIMING[self.row["tag"]]
            if role == "agent" and timing is not None:
                later_s = timing.sign * (wanted[timing.quantity] - self.row[timing.quantity])
                later_s /= wanted[f"{timing.role}.speed_mps"] if timing.role else 1.0
            out[self.row[role]] = (1.0 / faster, moment_s * (1.0 - 1.0 / faster) + later_s)
        return out

    def varied(self, timings: Mapping[str, tuple[float, float]], name: str) -> Scenario:
        """Return the concrete scenario: each agent on its path, at other times."""
        agents = []
        for agent in self.scenario.agents:
            scale, offset_s = timings.get(agent.id, (1.0, 0.0))
            w = agent.waypoints
            changed = replace(w, t_s=scale * w.t_s + offset_s, speed_mps=w.speed_mps / scale)
            agents.append(_window(replace(agent, waypoints=changed), self.scenario.duration_s))
        return replace(self.scenario, name=name, agents=tuple(agents))


def choose_base(logical: Logical, rows: Sequence[Row]) -> Row:
    """Return the hit whose parameters are the most usual: nearest to the medians of all."""
    known = [
        row
        for row in rows
        if all(name in row for name in logical.names) and row.get("other.speed_mps", 1.0) > 0.5 < row["agent.speed_mps"]
    ]
    if not known:
        raise ConfigError("vary: in every hit an agent stands, whose speed cannot be changed")
    scores = _normal(logical.cdf(np.array([[row[name] for name in logical.names] for row in known])))
    return known[int(np.argmin((scores**2).sum(axis=1)))]


def concrete(base: Base, logical: Logical, values: Array) -> Iterator[tuple[Scenario, tuple[str, ...]]]:
    """Yield the concrete scenarios of parameters (M, D), each with what speaks against it.

    No vehicle can drive so, agents collide, or it is another situation than that of the base.
    """
    source = base.varied({}, base.scenario.name)
    for k, row in enumerate(values):
        made = base.varied(base.timings(logical, row), f"{base.scenario.name}, variation {k + 1}")
        problems = find_problems(source, made, made.agents)
        wanted = (base.row["tag"], base.row["agent"], base.row.get("other"))
        same = any((g.tag, g.agent, g.other) == wanted for g in find_tags(made))
        yield made, (*problems, *([] if same else [f"is no {base.row['tag']} any more"]))


def _continued(traffic: Traffic, k: int, begin_s: float, end_s: float) -> Agent:
    """Return an agent whose waypoints go on along its path, at the speeds of its ends, in times since `begin_s`."""
    agent, found = traffic.table.agents[k], traffic.path(k)
    if found is None:
        raise ConfigError(f"vary: agent '{agent.id}' stands, so that its motion cannot be changed")
    first, last = round((begin_s - PAD_S) / TICK_S), round((end_s + PAD_S) / TICK_S)
    t: Array = np.arange(first, last + 1, dtype=np.float64) * TICK_S
    there = np.flatnonzero(np.isfinite(found.station_m))
    first_s, last_s = traffic.table.t_s[there[[0, -1]]]
    state = agent.trajectory.at(np.clip(t, first_s, last_s))
    x, y, yaw, speed = state.x_m.copy(), state.y_m.copy(), state.yaw_rad.copy(), state.speed_mps.copy()
    for outside, n, edge_s in ((t < first_s, there[0], first_s), (t > last_s, there[-1], last_s)):
        s = found.station_m[n] + (t[outside] - edge_s) * traffic.speed_mps[k, n]
        points = found.line.at(s)
        # The path is smoothed; where it begins, the agent is beside it.
        off = traffic.table.position_m[k, n] - complex(*found.line.at(np.array([found.station_m[n]]))[0, :2])
        x[outside], y[outside] = points[:, 0] + off.real, points[:, 1] + off.imag
        yaw[outside], speed[outside] = found.line.heading_at(s), traffic.speed_mps[k, n]
    w = Waypoints(t - begin_s, x, y, state.z_m, yaw, speed, np.ones(len(t), dtype=bool), np.zeros(len(t)))
    return replace(agent, waypoints=w, static=False, observed_by={}, doubts=())


def _window(agent: Agent, duration_s: float) -> Agent:
    """Return an agent from 0 to a time."""
    t = np.linspace(0.0, duration_s, max(round(duration_s / TICK_S), 1) + 1)
    state = agent.trajectory.at(t)
    w = Waypoints(t, *state[:3], state.yaw_rad, state.speed_mps, np.ones(len(t), dtype=bool), np.zeros(len(t)))
    return replace(agent, waypoints=w)


def write_openscenario(base: Base, timings: Sequence[Mapping[str, tuple[float, float]]], folder: Path) -> None:
    """Write OpenSCENARIO 1.2: the base with declared parameters, and a `ParameterValueDistribution` of all variations beside it.

    The parameters are scale and offset of the times of each agent's trajectory; those of the base are 1 and 0.
    """
    export(base.scenario, "openscenario", folder, Options(revision="1.2"))
    file = folder / "scenario.xosc"
    root = read(file)
    declarations = root.find("ParameterDeclarations")
    names = dict(zip((a.id for a in base.scenario.agents), unique_names(a.id for a in base.scenario.agents)))
    parameters = {id: (f"scale_{k}", f"offset_{k}") for k, id in enumerate(names)}
    for id, pair in parameters.items():
        for name, value in zip(pair, ("1", "0")):
            element("ParameterDeclaration", declarations, name=name, parameterType="double", value=value)
        for event in root.iter("Event"):
            timing = event.find(".//Timing") if event.get("name") == f"{names[id]} follows" else None
            if timing is not None:
                timing.set("scale", f"${pair[0]}")
                timing.set("offset", f"${pair[1]}")
    write(root, file)
    header = root.find("FileHeader")
    distribution = element("OpenSCENARIO")
    element("FileHeader", distribution, **dict(header.attrib if header is not None else {}))
    values = element("ParameterValueDistribution", distribution)
    element("ScenarioFile", values, filepath=file.name)
    several = element("DeterministicMultiParameterDistribution", element("Deterministic", values))
    sets = element("ValueSetDistribution", several)
    for timing_of in timings:
        chosen = element("ParameterValueSet", sets)
        for id, pair in parameters.items():
            for name, given in zip(pair, timing_of[id]):
                element("ParameterAssignment", chosen, parameterRef=name, value=number(given, 9))
    write(distribution, folder / "variations.xosc")
