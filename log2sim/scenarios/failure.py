"""Where a policy fails in a logical scenario, searched by the cross-entropy method, and how probable that is."""

from __future__ import annotations

import html
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from log2sim.datatypes import EGO, GROUP_OF, Scenario
from log2sim.errors import ConfigError
from log2sim.geometry import Array, runs_of
from log2sim.scenarios.hits import page
from log2sim.scenarios.logical import Base, Logical
from log2sim.simulation.driver_paths import LIGHT_M, stop_stations
from log2sim.simulation.policy import Policy
from log2sim.simulation.result import AgentReplay, Replay
from log2sim.simulation.runner import replay

STEP_S = 0.05
ELITE = 0.2  # share of the runs nearest to a failure that the next are drawn around
DEFENSIVE = 0.2  # share of the last runs that are drawn from the fitted distribution itself, which bounds the weights
ROUNDS = 4
LEVEL_Z = 1.959964  # 95 %

Margins = Callable[[Array], Array]


class Estimate(NamedTuple):
    """A probability of failure with its interval of 95 %."""

    probability: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Search:
    """Runs of a search: independent standard normal scores (R, D), their margins (R,), negative for failures, and the estimate."""

    scores: Array
    margins: Array
    estimate: Estimate


def search(margins: Margins, dimensions: int, runs: int, rng: np.random.Generator) -> Search:
    """Search for failures, and estimate how probable they are when scores are standard normal.

    `margins`: returns how far (M,) runs with scores (M, D) are from a failure, negative for failures. `runs`: in all; half of them
    search, the others estimate.

    Cross-entropy method (Rubinstein and Kroese, "The Cross-Entropy Method", 2004; for driving O'Kelly et al., NeurIPS 2018): the
    mean of the normal distribution that runs are drawn from moves to those nearest to a failure, weighed by likelihood ratios, until a
    fifth of them fail. The estimate is by importance sampling from a mixture of that and the given distribution, which bounds weights by
    1 / `DEFENSIVE` (Hesterberg 1995); its interval is that of the mean of weights. Without any failure the interval's end is that of
    the rule of three. Failures in several places that are far from each other need more runs.
    """
    mean = np.zeros(dimensions)
    each = max(runs // (2 * ROUNDS), 10)
    all_z, all_m = [], []
    for _ in range(runs // 2 // each):
        z = mean + rng.standard_normal((each, dimensions))
        m = margins(z)
        all_z.append(z)
        all_m.append(m)
        level = max(float(np.quantile(m, ELITE)), 0.0)
        elite = z[m <= level]
        # Given against drawn: the ratio of the normal densities around 0 and around the mean.
        logarithm = (mean @ mean) / 2 - elite @ mean
        weight = np.exp(logarithm - logarithm.max())
        mean = weight @ elite / weight.sum()
        if level <= 0.0 and len(all_m) > 1:
            break
    last = runs - sum(map(len, all_m))
    given = rng.random(last) < DEFENSIVE
    z = rng.standard_normal((last, dimensions)) + np.where(given[:, None], 0.0, mean)
    m = margins(z)
    drawn = DEFENSIVE + (1.0 - DEFENSIVE) * np.exp(z @ mean - (mean @ mean) / 2)
    weight = np.where(m <= 0, 1.0 / drawn, 0.0)
    p = float(weight.mean())
    half = LEVEL_Z * float(weight.std(ddof=1)) / np.sqrt(last)
    high = p + half if p > 0 else 3.0 / DEFENSIVE / last
    estimate = Estimate(min(p, 1.0), max(p - half, 0.0), min(high, 1.0))
    return Search(np.concatenate([*all_z, z]), np.concatenate([*all_m, m]), estimate)


LIMITS: Mapping[str, tuple[str, float]] = {
    "min_ttc_s": ("least time to collision of the ego", 1.0),
    "min_pet_s": ("least post-encroachment time of the ego", 1.0),
    "min_gap_m": ("least distance of the ego from others", 1.0),
    "max_brake_mps2": ("hardest braking of the ego", -1.0),
    "max_jerk_mps3": ("greatest jerk of the ego", -1.0),
    "max_lateral_mps2": ("greatest lateral acceleration of the ego", -1.0),
    "max_speed_mps": ("greatest speed of the ego", -1.0),
    "max_off_path_m": ("farthest distance of the ego from the path that it drove in the log", -1.0),
    "max_red_s": ("for how long a light was red when the ego passed its stop line, negative before it is red", -1.0),
}
"""What else than a collision may be a failure, of safety, comfort or rules: below a limit, or, with -1, above it."""


WAY_STEP_M = 0.5


def red_light_s(ego: AgentReplay, scenario: Scenario) -> float:
    """Return for how long a light was red, s, when the front of the ego passed where one stops at it; of several the longest.

    Negative where it turned red that much later, and minus infinity where the ego passes none that turns red.
    """
    front = ego.x_m + 1j * ego.y_m + ego.size_m[0] / 2 * np.exp(1j * ego.yaw_rad)
    way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(front)))])
    if not scenario.signals or way[-1] < WAY_STEP_M:
        return -np.inf
    # Beyond where it got it goes straight on, so that the place to stop at a light is not where it stopped.
    s: Array = np.arange(0.0, way[-1] + 2 * LIGHT_M, WAY_STEP_M)
    beyond = np.maximum(s - way[-1], 0.0) * np.exp(1j * ego.yaw_rad[-1])
    points = np.interp(s, way, front.real) + 1j * np.interp(s, way, front.imag) + beyond
    direction = np.exp(1j * np.interp(s, way, np.unwrap(ego.yaw_rad)))
    stations = stop_stations(points[None], direction[None], WAY_STEP_M, scenario.map_features, scenario.signals)[:, 0]
    longest = -np.inf
    for signal, station in zip(scenario.signals, stations.tolist()):
        if not station <= way[-1]:  # NaN, too
            continue
        t_s = ego.t_s[int(np.argmax(way >= station))]
        for begin, end in runs_of(np.isin(signal.state, ("red", "red_yellow"))):
            if end == len(signal.t_s) or signal.t_s[end] > t_s:  # the red that is, or else the next
                longest = max(longest, float(t_s - signal.t_s[begin]))
    return longest


class Outcome(NamedTuple):
    """What came of a run."""

    margin: float  # how far it was from a failure, negative for failures
    values: dict[str, float]  # figures of the ego
    problem: str = ""  # why the policy could not drive


def drive(base: Base, logical: Logical, policy: Policy, agents: str, values: Array) -> tuple[Scenario, Replay]:
    """Run a policy in the concrete scenario of parameters (D,)."""
    made = base.varied(base.timings(logical, values), base.scenario.name)
    return made, replay(made, mode="exact", dt_s=STEP_S, ego=policy, agents=agents)


def judge_run(
    base: Base, logical: Logical, policy: Policy, limits: Mapping[str, float], agents: str, values: Array
) -> Outcome:
    """Run a policy and say how far it was from a failure: a collision, a figure beyond its limit, or an error of its own.

    The margin is the least gap, m, and after a collision less the speed of the impact; figures count by how far they are within limits.
    """
    try:
        _, done = drive(base, logical, policy, agents, values)
    except Exception:  # whatever a policy raises is a failure of it, and the other runs go on
        return Outcome(-1e3, {}, traceback.format_exc(limit=-8))
    ego, own = done.metrics["ego"], done.metrics["by_agent"].get(EGO, {})
    hits = [e for e in done.metrics["collisions"] if EGO in e["agents"]]
    gap, brake = ego["min_gap"], ego["max_brake"]
    comfort, driven = own.get("comfort") or {}, next(a for a in done.agents if a.id == EGO)
    figures = {
        "min_gap_m": np.inf if gap is None else float(gap["m"]),
        "max_brake_mps2": 0.0 if brake is None else float(brake["mps2"]),
        "max_jerk_mps3": float(comfort.get("jerk_max_mps3", 0.0)),
        "max_lateral_mps2": float(comfort.get("lat_accel_max_mps2", 0.0)),
        "max_speed_mps": float(driven.speed_mps.max()),
        "max_off_path_m": float(own.get("cross_track_max_m", 0.0)),
        "max_red_s": red_light_s(driven, base.scenario),
        **{name: np.inf if own.get(name) is None else float(own[name]) for name in ("min_ttc_s", "min_pet_s")},
    }
    margin = figures["min_gap_m"]
    if hits:
        margin = -max(float(e["relative_speed_mps"]) for e in hits) - 1e-3
    for name, limit in limits.items():
        margin = min(margin, LIMITS[name][1] * (figures[name] - limit))
    figures = {name: value for name, value in figures.items() if np.isfinite(value)}
    return Outcome(min(margin, 1e3), {**figures, **({"impact_mps": -margin} if hits else {})})


def with_ego(base: Base) -> Base:
    """Return a base whose ego is one of both agents: the one it is, else the other, whose path counts."""
    if any(a.id == EGO for a in base.scenario.agents):
        return base
    driver = base.row.get("other", base.row["agent"])
    category = next(a.category for a in base.scenario.agents if a.id == driver)
    if GROUP_OF[category] != "vehicle":
        raise ConfigError(
            f"the situation that is varied is of '{driver}', a {category}, which no policy drives; narrow the condition to vehicles"
        )
    agents = tuple(replace(a, id=EGO) if a.id == driver else a for a in base.scenario.agents)
    moments = {EGO if id == driver else id: t_s for id, t_s in base.moment_s.items()}
    row = {**base.row, **{role: EGO for role in ("agent", "other") if base.row.get(role) == driver}}
    return Base(replace(base.scenario, agents=agents), moments, row)


STYLE = """
h2 { font-size: 14px; } small { color: var(--muted); } pre { overflow-x: auto; }
td, th { padding: 3px 12px 3px 0; text-align: right; border-bottom: 1px solid var(--grid); }
svg { width: 320px; margin: 8px; background: var(--grid); border-radius: 4px; }
svg path { fill: none; stroke: var(--ink); }
circle { fill: #1565C0; fill-opacity: .5; } circle.failed { fill: #C62828; fill-opacity: 1; } text { fill: var(--ink); font-size: 9px; }
"""


TABLE_ROWS = 30  # runs nearest to a failure that are listed, with those that have a page of their own


def report_page(
    title: str,
    logical: Logical,
    values: Array,
    outcomes: Sequence[Outcome],
    estimate: Estimate,
    links: Mapping[int, str],
) -> str:
    """Return the page of a test: the probability, the parameters with failures in red, and the worst runs; `links` by run."""
    failed = np.array([o.margin <= 0 for o in outcomes])
    plots = [_scatter(logical.names, values, failed, i, j) for i in range(len(logical.names)) for j in range(i)]
    by_margin = sorted(range(len(outcomes)), key=lambda k: outcomes[k].margin)
    worst = [k for place, k in enumerate(by_margin) if place < TABLE_ROWS or k in links]
    keys = sorted({key for k in worst for key in outcomes[k].values})
    head = "".join(f"<th>{html.escape(name)}</th>" for name in ("run", "margin", *logical.names, *keys))
    rows = []
    for k in worst:
        run = f'<a href="{html.escape(links[k])}">{k + 1}</a>' if k in links else str(k + 1)
        cells = [
            f"{outcomes[k].margin:.3g}",
            *(f"{v:.4g}" for v in values[k]),
            *(f"{outcomes[k].values[key]:.3g}" if key in outcomes[k].values else "" for key in keys),
        ]
        rows.append(f"<tr><td>{run}</td>{''.join(f'<td>{c}</td>' for c in cells)}</tr>")
    problems = sorted({o.problem for o in outcomes if o.problem})
    said = "".join(f"<pre>{html.escape(text)}</pre>" for text in problems[:3])
    return page(
        title,
        STYLE,
        f"<h1>{html.escape(title)}</h1><p>Probability of failure {say_estimate(estimate)}; {failed.sum()} of {len(outcomes)} runs failed, "
        f"most of which were drawn where it fails.</p>{''.join(plots)}<h2>Nearest to a failure</h2><table><tr>{head}</tr>{''.join(rows)}</table>{said}",
    )


def say_estimate(estimate: Estimate) -> str:
    """Say a probability with its interval."""
    return f"{estimate.probability:.3g} (95 %: {estimate.low:.2g} to {estimate.high:.2g})"


def _scatter(names: Sequence[str], values: Array, failed: Array, i: int, j: int) -> str:
    """Draw two parameters of all runs."""
    x, y = values[:, j], values[:, i]
    (x0, x1), (y0, y1) = ((v.min(), max(v.max(), v.min() + 1e-9)) for v in (x, y))
    dots = "".join(
        f'<circle{" class=failed" if bad else ""} cx="{20 + 270 * (a - x0) / (x1 - x0):.1f}" cy="{190 - 170 * (b - y0) / (y1 - y0):.1f}" r="2"/>'
        for a, b, bad in zip(x.tolist(), y.tolist(), failed.tolist())
    )
    axes = "".join(
        f'<g transform="{place}"><text>{low:.3g}</text><text x="{end / 2}" text-anchor="middle">{html.escape(name)}</text>'
        f'<text x="{end}" text-anchor="end">{high:.3g}</text></g>'
        for place, end, name, low, high in (
            ("translate(20 207)", 270, names[j], x0, x1),
            ("translate(13 190) rotate(-90)", 170, names[i], y0, y1),
        )
    )
    return f'<svg viewBox="0 0 310 215" role="img"><path d="M17 15V194H295"/>{dots}{axes}</svg>'


def describe(
    policy: str, condition: str, logical: Logical, found: Search, outcomes: Sequence[Outcome]
) -> dict[str, Any]:
    """Return the document of a test."""
    return {
        "policy": policy, "condition": condition, "runs": len(outcomes), "failures": int((found.margins <= 0).sum()),
        "errors": sum(bool(o.problem) for o in outcomes), "probability": found.estimate._asdict(), **logical.to_dict(),
    }  # fmt: skip
