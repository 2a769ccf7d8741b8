"""Fit the weights by which agents are rated, and those of their systematic errors, on synthetic logs.

    python tools/fit.py confidence_logs --logs 60 --seed 2 --out FOLDER
    python tools/fit.py confidence FOLDER > log2sim/agents/confidence.py

Goes on from the first passes that the former made, judges the agents as `evaluate` does, and prints the module. Tables of
logs that were held out go to stderr: each fifth of the logs is rated by weights that fit the others.
"""

from __future__ import annotations

import pickle
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from entry import parser_of
from numpy.typing import NDArray

from fits.confidence_logs import Case
from log2sim import pipeline
from log2sim.agents.candidate import AgentCandidate, Timeline
from log2sim.agents.confidence import (
    MAX_CONFIDENCE,
    MIN_CONFIDENCE,
    SIGNS,
    Evidence,
    evidence_of,
    position_terms,
    seen_share,
    speed_terms,
    yaw_at_measurements,
    yaw_terms,
)
from log2sim.datatypes import CATEGORIES, Agent
from log2sim.datatypes.log_odds import probability_of
from log2sim.evaluation.metrics.comparison import Selection
from log2sim.evaluation.metrics.correctness import MAX_WRONG_SHARE, reliability
from log2sim.evaluation.metrics.evaluator import compare_scenarios
from log2sim.evaluation.metrics.verdicts import judge_against_truth
from log2sim.geometry import Array

Table = dict[str, float]

FOLDS = 5
# Standard deviation of the weights of evidence that is scaled to a standard deviation of 1, before anything is seen.
PRIOR_SIGMA = 0.5
# A weight of a variance is not below this, so that its logarithm exists. Of what smoothing says remains at least a quarter, half
# of the standard deviation: it alone knows gaps, ends and turns.
MIN_WEIGHT, MIN_GIVEN_WEIGHT, MAX_WEIGHT = 1e-7, 0.25, 25.0
RANGES_M = ((0, 15), (15, 30), (30, 50), (50, np.inf))


@dataclass(frozen=True, eq=False)
class Rated:
    """One judged agent: evidence, share of right ticks, and squared errors with their terms, means over matched ticks."""

    log: str
    case: str
    lidar: bool
    id: str
    evidence: Evidence
    ticks: int
    right: float
    before: float
    doubted: bool
    range_m: float
    candidate: Agent
    seen: Array
    errors: dict[str, float]


def agents_of(case: Case) -> list[Rated]:
    """Reconstruct a case and judge its agents."""
    kept: list[AgentCandidate] = []
    original = pipeline.rate_agents

    def keep(candidates: Sequence[AgentCandidate], timeline: Timeline, *, lidar: bool) -> list[AgentCandidate]:
        kept.extend(candidates)
        return list(candidates)

    pipeline.rate_agents = keep
    try:
        scenario = case.second().scenario
    finally:
        pipeline.rate_agents = original
    t_ns, lidar = case.run.schedule.t_ns, bool(case.run.log.lidars)
    timeline = Timeline(t_ns, int(t_ns[0]))
    compared, _, ego = compare_scenarios(scenario, case.truth, Selection(None, frozenset(CATEGORIES)))
    v, out = judge_against_truth(compared, ego), []
    for k, agent in enumerate(scenario.others):
        ticks = v.judged[k]
        if not ticks.any():
            continue
        candidate = next(c for c in kept if c.agent.id == agent.id)
        matched = ticks & (v.matched[k] >= 0)
        squared = {
            "position": (v.error_m[k] ** 2).sum(axis=1) / 2,
            "yaw": v.error_rad[k] ** 2,
            "speed": v.error_mps[k] ** 2,
        }
        errors = {
            n: float(np.mean(e[matched & np.isfinite(e)]))
            for n, e in squared.items()
            if (matched & np.isfinite(e)).any()
        }
        evidence = evidence_of(candidate, timeline)
        seen = seen_share(candidate, yaw_at_measurements(candidate, timeline))
        doubted = bool(agent.doubts)
        range_m = float(np.median(compared.other.range_m[k, ticks]))
        out.append(
            Rated(
                case.name.split(" ")[0],
                case.name,
                lidar,
                agent.id,
                evidence,
                int(ticks.sum()),
                float(1 - v.wrong[k, ticks].mean()),
                agent.confidence,
                doubted,
                range_m,
                candidate.agent,
                seen,
                errors,
            )
        )
    return out


def matrix_of(agents: Sequence[Rated], names: Sequence[str] = tuple(SIGNS)) -> Array:
    return np.array([[getattr(a.evidence, name) for name in names] for a in agents])


def targets_of(agents: Sequence[Rated]) -> Array:
    """Half the verdict on the agent, half the share of its right ticks: what reliability counts, of agents and of ticks."""
    right = np.array([a.right for a in agents])
    return (right + (right >= 1 - MAX_WRONG_SHARE)) / 2


def fit_weights(x: Array, right: Array, weight: Array, signs: Sequence[int]) -> tuple[float, Array]:
    """Find the most likely bias and weights (F,) of evidence (A, F) for agents that are right to some share (A,)."""
    from scipy.optimize import minimize

    mean, scale = x.mean(axis=0), x.std(axis=0)
    scale[scale < 1e-9] = np.inf
    z = (x - mean) / scale

    def loss(w: Array) -> tuple[float, Array]:
        odds = w[0] + z @ w[1:]
        value = weight @ (np.logaddexp(0.0, odds) - right * odds) + (w[1:] ** 2).sum() / (2 * PRIOR_SIGMA**2)
        slope = weight * (probability_of(odds) - right)
        return float(value), np.append(slope.sum(), z.T @ slope + w[1:] / PRIOR_SIGMA**2)

    limits: list[tuple[float | None, float | None]] = [(None, None)]
    limits += [{1: (0.0, None), -1: (None, 0.0), 0: (None, None)}[sign] for sign in signs]
    w = minimize(loss, np.zeros(x.shape[1] + 1), jac=True, method="L-BFGS-B", bounds=limits).x
    return float(w[0] - (w[1:] / scale) @ mean), w[1:] / scale


def probabilities(agents: Sequence[Rated], tables: Mapping[bool, Table]) -> Array:
    """Rate agents (A,) by the tables of weights with and without a LiDAR."""
    rows = [(list(tables[a.lidar].items()), {"bias": 1.0, **asdict(a.evidence)}) for a in agents]
    odds = np.array([sum(weight * values[name] for name, weight in table) for table, values in rows])
    return np.clip(probability_of(odds), MIN_CONFIDENCE, MAX_CONFIDENCE)


def fit_variances(terms: Array, squared: Array, least: Array) -> Array:
    """Find the most likely weights (F,), at least so large, of terms (A, F) of variances for squared errors (A,), Gaussian."""
    from scipy.optimize import minimize

    scale = squared.mean() / np.maximum(terms.mean(axis=0), 1e-9) / terms.shape[1]

    def loss(log_weights: Array) -> tuple[float, Array]:
        w = np.exp(log_weights) * scale
        variance = terms @ w
        slope = ((1 - squared / variance) / variance)[:, None] * terms * w
        return float((np.log(variance) + squared / variance).mean()), slope.mean(axis=0)

    low, high = np.log(least / scale), np.log(MAX_WEIGHT / scale)
    start = np.clip(np.zeros(len(scale)), low, high)
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=list(zip(low, high)))
    return np.exp(found.x) * scale


def terms_of(kind: str, a: Rated, confidence: float) -> dict[str, float]:
    w, size = a.candidate.waypoints, a.candidate.size_m
    terms = {
        "position": lambda: position_terms(w, size, a.seen, a.evidence, confidence),
        "yaw": lambda: yaw_terms(w, confidence),
        "speed": lambda: speed_terms(w, a.evidence, confidence),
    }[kind]()
    return {name: float(values.mean()) for name, values in terms.items()}


def has_sigma(kind: str, a: Rated) -> bool:
    w = a.candidate.waypoints
    known = {"position": w.sigma_xy_m, "yaw": w.sigma_yaw_rad, "speed": w.sigma_speed_mps}[kind]
    return kind in a.errors and known is not None


def held_out(agents: Sequence[Rated]) -> tuple[Array, dict[str, tuple[Array, Array]]]:
    """Rate each agent by weights that fit other logs: probabilities (A,), and by kind the rows and variances."""
    logs = np.unique([a.log for a in agents], return_inverse=True)[1]
    p, variances = np.zeros(len(agents)), {kind: ([], []) for kind in ("position", "yaw", "speed")}
    for fold in range(FOLDS):
        rest = [a for a, log in zip(agents, logs) if log % FOLDS != fold]
        rows = np.flatnonzero(logs % FOLDS == fold)
        tables, by_kind = fit_all(rest)
        p[rows] = probabilities([agents[k] for k in rows], tables)
        for kind, found in by_kind.items():
            for k in rows:
                if has_sigma(kind, agents[k]):
                    terms = terms_of(kind, agents[k], p[k])
                    variances[kind][0].append(k)
                    variances[kind][1].append(sum(found[name] * value for name, value in terms.items()))
    return p, {kind: (np.array(rows, dtype=int), np.array(v)) for kind, (rows, v) in variances.items()}


def fit_all(agents: Sequence[Rated]) -> tuple[dict[bool, Table], dict[str, Table]]:
    """Fit the weights of evidence with and without a LiDAR, and by kind of error those of the terms of its variance."""
    tables = {}
    for lidar in {a.lidar for a in agents}:
        own = [a for a in agents if a.lidar == lidar]
        x = matrix_of(own)
        names = [name for name, used in zip(SIGNS, np.ptp(x, axis=0) > 0) if used]
        # An agent of many ticks counts more, since they do in the calibration of ticks, but less than they are.
        ticks = np.sqrt([a.ticks for a in own])
        signs = [SIGNS[name] for name in names]
        bias, weights = fit_weights(matrix_of(own, names), targets_of(own), ticks / ticks.mean(), signs)
        tables[lidar] = {**dict(zip(names, weights.tolist())), "bias": bias}
    p = probabilities(agents, tables)
    by_kind = {}
    for kind in ("position", "yaw", "speed"):
        rows = [(a, float(c)) for a, c in zip(agents, p) if has_sigma(kind, a)]
        if not rows:
            continue
        names = list(terms_of(kind, *rows[0]))
        terms = np.array([list(terms_of(kind, a, c).values()) for a, c in rows])
        least = np.array([MIN_GIVEN_WEIGHT if name == "given" else MIN_WEIGHT for name in names])
        found = fit_variances(terms, np.array([a.errors[kind] for a, _ in rows]) + 1e-8, least)
        by_kind[kind] = dict(zip(names, found.tolist()))
    return tables, by_kind


def say(text: str) -> None:
    print(text, file=sys.stderr)


def say_confidence(title: str, p: Array, agents: Sequence[Rated]) -> None:
    """Print reliability and what is doubted: by a probability below one half, or by a doubt."""
    if not agents:
        return
    ticks, right = np.array([a.ticks for a in agents]), np.array([a.right for a in agents])
    doubted = (p < 0.5) | np.array([a.doubted for a in agents])
    of_agents = reliability(p, right >= 1 - MAX_WRONG_SHARE)
    tick_rows = np.repeat(np.arange(len(p)), ticks)
    rights = np.concatenate([np.arange(n) < round(r * n) for n, r in zip(ticks, right)])
    of_ticks = reliability(p[tick_rows], rights)
    wrong, good = ticks * (1 - right), ticks * right
    say(
        f"{title}: {len(agents)} agents, {wrong.sum() / ticks.sum():.3f} of {ticks.sum()} ticks wrong; expected calibration error "
        f"{of_ticks['expected_calibration_error']:.3f} of ticks, {of_agents['expected_calibration_error']:.3f} of agents; doubted "
        f"{wrong[doubted].sum() / max(wrong.sum(), 1):.2f} of wrong, {good[doubted].sum() / max(good.sum(), 1):.3f} of right ticks"
    )
    say("   " + " ".join(f"{b['low']:.1f}: {b['right']:.2f} ({b['count']})" for b in of_agents["bins"] if b["count"]))


def say_sigma(kind: str, rows: NDArray[Any], variance: Array, agents: Sequence[Rated]) -> None:
    """Print squared errors over variances by range, before and after."""
    if not len(rows):
        return
    chosen = [agents[k] for k in rows]
    squared = np.array([a.errors[kind] for a in chosen])
    before = np.array([max(terms_of(kind, a, 1.0)["given"], 1e-9) for a in chosen])
    ranges, ticks = np.array([a.range_m for a in chosen]), np.array([a.ticks for a in chosen])
    for low, high in ((0, np.inf), *RANGES_M):
        k = (ranges >= low) & (ranges < high)
        if k.any():
            was, now = (np.average(squared[k] / v[k], weights=ticks[k]) for v in (before, variance))
            middle = [float(np.median(squared[k] / v[k])) for v in (before, variance)]
            say(
                f"   {kind} {low:g}-{high:g} m, {k.sum()} agents: NEES {was:.2f} -> {now:.2f}, median {middle[0]:.2f} -> {middle[1]:.2f}"
            )


def module_text(command: str, agents: Sequence[Rated]) -> str:
    counts = [sum(a.lidar == lidar for a in agents) for lidar in (True, False)]
    found, by_kind = fit_all(agents)
    lines = [
        '"""Weights of the evidence (`evidence.Evidence`) and of systematic errors (`systematic`).',
        "",
        f"Printed by `{command}`: {counts[0]} agents with a LiDAR and",
        f"{counts[1]} without, of {len({a.log for a in agents})} synthetic logs.",
        '"""',
        "",
        "from __future__ import annotations",
        "",
    ]
    tables = {"WITH_LIDAR": found.get(True, {}), "WITHOUT_LIDAR": found.get(False, {})}
    tables |= {f"{kind.upper()}_VARIANCE": by_kind.get(kind, {}) for kind in ("position", "yaw", "speed")}
    for name, table in tables.items():
        lines += [f"{name} = {{", *(f'    "{key}": {float(f"{value:.4g}")},' for key, value in table.items()), "}"]
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    parser = parser_of(__doc__)
    parser.add_argument("folder", type=Path, help="of confidence_logs.py")
    options = parser.parse_args(arguments)
    agents: list[Rated] = []
    for path in sorted(options.folder.glob("*.pkl")):
        for case in pickle.loads(path.read_bytes()):
            found = [replace(agent, log=path.stem) for agent in agents_of(case)]
            agents += found
            say(f"{case.name}: {len(found)} agents")
    report(agents)
    seeds = ", ".join(sorted({path.stem.split("-")[0] for path in options.folder.glob("*.pkl")}))
    command = f"tools/fit.py confidence` on the logs of `tools/fit.py confidence_logs --seed {seeds}"
    print(module_text(command, agents))


def report(agents: Sequence[Rated]) -> None:
    """Print tables of agents rated by what fits other logs."""
    p, variances = held_out(agents)
    say_confidence("before", np.array([a.before for a in agents]), agents)
    say_confidence("held out", p, agents)
    kinds = {
        "sweeps": lambda a: a.evidence.sweep != 0,
        "images and points": lambda a: a.evidence.sweep == 0 and a.evidence.blind < 0.5,
        "images": lambda a: a.evidence.blind >= 0.5 and a.lidar,
        "no LiDAR": lambda a: not a.lidar,
    }
    for title, chosen in kinds.items():
        rows = [k for k, a in enumerate(agents) if chosen(a)]
        say_confidence(f"held out, {title}", p[rows], [agents[k] for k in rows])
    for kind, (rows, variance) in variances.items():
        say_sigma(kind, rows, variance, agents)
