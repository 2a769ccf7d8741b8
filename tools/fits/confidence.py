"""Fit the weights of the evidence by which agents are judged, and those of their systematic errors, on simulated logs.

    python tools/fit.py confidence_logs FOLDER --logs 60 --seed 2
    python tools/fit.py confidence FOLDER ... > weights.py && mv weights.py log2sim/agents/
    python tools/fit.py confidence FOLDER ... --scales       # then, of the weights that are there, the line of `CONFIDENCE`

Goes on from the first passes that the former made, judges every candidate as `evaluate` does, also those that are dropped, and
prints the module. Tables go to stderr: each fifth of the logs is rated by weights that fit the others; and each kind of content
(mount, what is searched, rate) by weights that fit the other kinds.
"""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from fits.confidence_logs import Case
from log2sim import pipeline
from log2sim.agents import estimate
from log2sim.agents import judge as judging
from log2sim.agents.candidate import Timeline
from log2sim.agents.evidence import SIGNS, Table, gather
from log2sim.agents.judge import MIN_THERE, suffices, variance_terms
from log2sim.agents.weights import CONFIDENCE
from log2sim.datatypes import CATEGORIES, GROUP_OF
from log2sim.datatypes.log_odds import MAX_PROBABILITY, MIN_PROBABILITY, log_odds_of, probability_of
from log2sim.errors import NothingToReconstruct
from log2sim.evaluation.metrics.comparison import Selection
from log2sim.evaluation.metrics.correctness import reliability
from log2sim.evaluation.metrics.evaluator import compare_scenarios, evaluate
from log2sim.evaluation.metrics.verdicts import MAX_WRONG_SHARE, judge_against_truth
from log2sim.geometry import Array

Weights = dict[bool, dict[str, float]]

FOLDS = 5
# Standard deviation of the weights of evidence that is scaled to a standard deviation of 1, before anything is seen; weights that
# change log-odds by less than this in a standard deviation are left out.
PRIOR_SIGMA, MIN_EFFECT = 0.5, 0.05
# A weight of a variance is not below this, so that its logarithm exists. Of what smoothing says remains at least a quarter, half
# of the standard deviation: it alone knows gaps, ends and turns.
MIN_WEIGHT, MIN_GIVEN_WEIGHT, MAX_WEIGHT = 1e-7, 0.25, 25.0
# Columns that say nothing of whether something is there, and those that say nothing of whether it is right where it is.
ONLY_RIGHT, ONLY_THERE = ("heading", "sigma_speed", "brief"), ("travel", "image", "sweep", "weak_sweep", "few")  # fmt: skip


@dataclass(frozen=True, eq=False)
class Rated:
    """One judged candidate: its row of the table, shares of ticks, and squared errors with their terms, means over ticks."""

    log: str
    case: str
    hz: float
    lidar: bool
    category: str
    evidence: dict[str, float]
    ticks: int
    there: float
    right: float
    doubted: bool
    terms: dict[str, dict[str, float]]
    errors: dict[str, float]


def agents_of(case: Case, log: str) -> list[Rated]:
    """Reconstruct a case with all candidates kept, and judge them; none where nothing was detected."""
    gathered: list[tuple[Any, Table]] = []
    judged: list[Any] = []

    def keep_table(candidates: Sequence[Any], recording: Any) -> Table:
        gathered.append((list(candidates), gather(candidates, recording)))
        return gathered[-1][1] | {"confirmed": np.ones(len(candidates))}

    def keep_candidates(*arguments: Any, **options: Any) -> Any:
        judged.extend(judging.judge(*arguments, **options))
        return judged

    with (
        patch.object(judging, "MIN_THERE", {True: 0.0, False: 0.0}),
        patch.object(judging, "gather", keep_table),
        patch.object(pipeline, "judge", keep_candidates),
        patch.object(estimate, "may_suffice", lambda track, static, clutter: True),
    ):
        try:
            scenario = case.second().scenario
        except NothingToReconstruct:
            return []
    t_ns, lidar = case.run.schedule.t_ns, bool(case.run.log.lidars)
    timeline = Timeline(t_ns, int(t_ns[0]))
    compared, _, ego = compare_scenarios(scenario, case.truth, Selection(None, frozenset(CATEGORIES)))
    v, out, ((candidates, table),) = judge_against_truth(compared, ego), [], gathered
    tracks = [id(c.track) for c in candidates]
    for k, agent in enumerate(scenario.others):
        ticks = v.judged[k]
        if not ticks.any():
            continue
        candidate = next(c for c in judged if c.agent.id == agent.id)
        row = tracks.index(id(candidate.track))
        matched = ticks & (v.matched[k] >= 0)
        squared = {
            "sigma_xy_m": (v.error_m[k] ** 2).sum(axis=1) / 2,
            "sigma_yaw_rad": v.error_rad[k] ** 2,
            "sigma_speed_mps": v.error_mps[k] ** 2,
        }
        usable = {kind: e[matched & np.isfinite(e)] for kind, e in squared.items()}
        terms = variance_terms(candidates[row], 0.0, timeline)
        out.append(Rated(
            log, case.name, round(1e9 / float(np.median(np.diff(t_ns)))), lidar, agent.category,
            {name: float(column[row]) for name, column in table.items()}, int(ticks.sum()),
            float(1 - v.measures["invented"][k, ticks].mean()), float(1 - v.wrong[k, ticks].mean()), bool(agent.doubts),
            {kind: {name: float(t.mean()) for name, t in of.items()} for kind, of in terms.items()},
            {kind: float(e.mean()) for kind, e in usable.items() if len(e) and kind in terms},
        ))  # fmt: skip
    return out


def half_verdict(share: Array) -> Array:
    """Half the verdict on the agent, half the share of its right ticks: what reliability counts, of agents and of ticks."""
    return (share + (share >= 1 - MAX_WRONG_SHARE)) / 2


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


def fit_table(
    agents: Sequence[Rated], target: Callable[[Rated], float], weight: Callable[[Rated], float], out: Sequence[str]
) -> Weights:
    """Fit weights with and without a LiDAR of all columns but some; those without effect are left out, and the others fitted again."""
    tables = {}
    for lidar in sorted({a.lidar for a in agents}, reverse=True):
        own = [a for a in agents if a.lidar == lidar]
        names = [name for name in SIGNS if name not in out]
        for _ in range(2):
            x = np.array([[a.evidence[name] for name in names] for a in own])
            # An agent of many ticks counts more, since they do in the calibration of ticks, but less than they are.
            w = np.sqrt([a.ticks for a in own]) * [weight(a) for a in own]
            y = half_verdict(np.array([target(a) for a in own]))
            bias, found = fit_weights(x, y, w / w.mean(), [SIGNS[name] for name in names])
            tables[lidar] = {"bias": bias, **dict(zip(names, found.tolist()))}
            names = [n for n, effect in zip(names, np.abs(found) * x.std(axis=0)) if effect > MIN_EFFECT]
    return tables


def fit_there_and_right(agents: Sequence[Rated]) -> tuple[Weights, Weights]:
    """Fit the weights of whether something is there, and of whether an agent is right where something is."""
    there = fit_table(agents, lambda a: a.there, lambda a: 1.0, ONLY_RIGHT)
    right = fit_table(agents, lambda a: min(a.right / max(a.there, 1e-9), 1.0), lambda a: a.there, ONLY_THERE)
    return there, right


def probabilities(agents: Sequence[Rated], tables: tuple[Weights, Weights]) -> tuple[Array, Array]:
    """Rate agents (A,): the probabilities that they are there and that they are right."""
    there, state = (
        probability_of([sum(w * a.evidence.get(n, 1.0) for n, w in table[a.lidar].items()) for a in agents])
        for table in tables
    )
    return there, np.clip(there * state, MIN_PROBABILITY, MAX_PROBABILITY)


def terms_of(a: Rated, kind: str, confidence: float) -> dict[str, float]:
    """Return the means of the terms of a variance at a confidence."""
    wrong = (1 - confidence) ** 2
    return {n: v * (wrong if n in ("wrong", "standing", "moving") else 1.0) for n, v in a.terms[kind].items()}


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


def fit_all_variances(agents: Sequence[Rated], p: Array) -> dict[str, dict[str, float]]:
    """Fit the weights of the terms of variances by kind of error."""
    by_kind = {}
    for kind in ("sigma_xy_m", "sigma_yaw_rad", "sigma_speed_mps"):
        rows = [(terms_of(a, kind, float(c)), a.errors[kind]) for a, c in zip(agents, p) if kind in a.errors]
        names = list(rows[0][0])
        least = np.array([MIN_GIVEN_WEIGHT if name == "given" else MIN_WEIGHT for name in names])
        terms = np.array([list(terms.values()) for terms, _ in rows])
        found = fit_variances(terms, np.array([e for _, e in rows]) + 1e-8, least)
        by_kind[kind] = dict(zip(names, found.tolist()))
    return by_kind


def say(text: str) -> None:
    print(text, file=sys.stderr)


@dataclass(frozen=True)
class Judged:
    """An agent of a scenario, and whether it is right."""

    log: str
    kind: str  # mount, what is searched, rate
    group: str
    log_odds: float  # of its confidence before it is scaled
    right: bool


def judged_agents(case: Case, log: str) -> list[Judged]:
    """Reconstruct a case without scales of confidences, and judge its agents; none without a LiDAR or where nothing was detected."""
    if not case.run.log.lidars:
        return []
    with patch.object(judging, "CONFIDENCE", dict.fromkeys(CONFIDENCE, (0.0, 1.0))):
        try:
            scenario = case.second().scenario
        except NothingToReconstruct:
            return []
    hz = round(1e9 / float(np.median(np.diff(case.run.schedule.t_ns))))
    return [
        Judged(
            log, kind_of(case.name, hz), GROUP_OF[row["category"]], float(log_odds_of(row["confidence"])),
            row["wrong_ticks"] <= MAX_WRONG_SHARE * row["ticks"],
        )
        for row in evaluate(scenario, case.truth)["correctness"]["judged_agents"]
        if GROUP_OF[row["category"]] in CONFIDENCE
    ]  # fmt: skip


def kind_of(case: str, hz: float) -> str:
    """Name a kind of content: mount, what is searched, rate."""
    return f"{case.split('-')[0]}, {case.split('(')[-1].rstrip(')').split(',')[0]}, {hz:.0f} Hz"


def fit_scales(agents: Sequence[Judged]) -> dict[str, tuple[float, float]]:
    """Fit offset and slope of the log-odds of the agents of each group (Platt 1999)."""
    scales = {}
    for group in CONFIDENCE:
        own = [a for a in agents if a.group == group]
        x, right = np.array([[a.log_odds] for a in own]), np.array([a.right for a in own], dtype=np.float64)
        offset, (slope,) = fit_weights(x, right, np.ones(len(own)), [1])
        scales[group] = float(f"{offset:.3g}"), float(f"{slope:.3g}")
    return scales


def report_scales(agents: Sequence[Judged]) -> None:
    """Print calibration errors of agents whose scales fit other logs, and other kinds of content."""
    before = np.array([a.log_odds for a in agents])
    folds = np.unique([a.log for a in agents], return_inverse=True)[1] % FOLDS
    for title, of in (("other logs", folds), ("other kinds of content", np.array([a.kind for a in agents]))):
        after = before.copy()
        for value in np.unique(of):
            scales = fit_scales([a for a, part in zip(agents, of) if part != value])
            rows = np.flatnonzero(of == value)
            offset, slope = np.array([scales[agents[k].group] for k in rows]).T
            after[rows] = offset + slope * before[rows]
        for group in CONFIDENCE:
            rows = np.flatnonzero([a.group == group for a in agents])
            right = np.array([agents[k].right for k in rows])
            errors = [reliability(probability_of(odds[rows]), right) for odds in (before, after)]
            was, now = (f"{error['expected_calibration_error']:.3f}" for error in errors)
            chance = f"{errors[1]['error_by_chance']:.3f}"
            say(f"{title}, {group}: {len(rows)} agents, calibration error {was} -> {now} (by chance {chance})")


def say_rated(title: str, agents: Sequence[Rated], there: Array, p: Array) -> None:
    """Print what is kept, and of this reliability and what is doubted: by a probability below one half, or by a doubt."""
    kept = np.array(
        [suffices(p, confirmed=bool(a.evidence["confirmed"]), lidar=a.lidar) for a, p in zip(agents, there)], dtype=bool
    )
    ticks, exists = np.array([a.ticks for a in agents]), np.array([a.there for a in agents])
    recall = (ticks * exists)[kept].sum() / max((ticks * exists).sum(), 1)
    invented = (ticks * (1 - exists))[kept].sum() / max(ticks[kept].sum(), 1)
    of = [a for a, keep in zip(agents, kept) if keep]
    if not of:
        return say(f"{title}: none of {len(agents)} kept")
    right, p, ticks = np.array([a.right for a in of]), p[kept], ticks[kept]
    doubted = (p < 0.5) | [a.doubted for a in of]
    table = reliability(p, right >= 1 - MAX_WRONG_SHARE)
    wrong, good = ticks * (1 - right), ticks * right
    say(
        f"{title}: {len(of)} of {len(agents)} kept, {recall:.2f} of what is there, {invented:.3f} of these ticks invented, "
        f"{wrong.sum() / ticks.sum():.3f} wrong; doubted {wrong[doubted].sum() / max(wrong.sum(), 1):.2f} of wrong, "
        f"{good[doubted].sum() / max(good.sum(), 1):.3f} of right ticks; calibration error of agents "
        f"{table['expected_calibration_error']:.3f} (by chance {table['error_by_chance']:.3f})"
    )


def report(agents: Sequence[Rated]) -> None:
    """Print tables of agents rated by what fits other logs, and other kinds of content."""
    logs = np.unique([a.log for a in agents], return_inverse=True)[1] % FOLDS
    kinds = np.array([kind_of(a.case, a.hz) for a in agents])
    for title, group in (("other logs", logs), ("other kinds of content", kinds)):
        there, p, variance = np.zeros(len(agents)), np.zeros(len(agents)), {}
        for fold in np.unique(group):
            rows = np.flatnonzero(group == fold)
            rest = [a for a, g in zip(agents, group) if g != fold]
            tables = fit_there_and_right(rest)
            there[rows], p[rows] = probabilities([agents[k] for k in rows], tables)
            weights = fit_all_variances(rest, probabilities(rest, tables)[1])
            for kind, found in weights.items():
                for k in (k for k in rows if kind in agents[k].errors):
                    variance[k, kind] = sum(found[n] * v for n, v in terms_of(agents[k], kind, p[k]).items())
        sets: dict[str, NDArray[np.bool_]] = {"all": np.ones(len(agents), dtype=bool)}
        sets |= {"LiDAR": np.array([a.lidar for a in agents]), "no LiDAR": np.array([not a.lidar for a in agents])}
        for of in ("vehicle", "two_wheeler", "pedestrian"):
            sets[f"{of}, LiDAR"] = np.array([a.lidar and GROUP_OF[a.category] == of for a in agents])
        if title == "other kinds of content":
            sets |= {str(kind): kinds == kind for kind in np.unique(kinds)}
        for name, rows in sets.items():
            say_rated(f"{title}, {name}", [a for a, use in zip(agents, rows) if use], there[rows], p[rows])
        for kind in ("sigma_xy_m", "sigma_yaw_rad", "sigma_speed_mps"):
            ratio = [
                a.errors[kind] / variance[k, kind]
                for k, a in enumerate(agents)
                if kind in a.errors and there[k] >= MIN_THERE[a.lidar]
            ]
            say(f"{title}, {kind}: NEES {np.mean(ratio):.2f}, median {np.median(ratio):.2f}")


def module_text(command: str, agents: Sequence[Rated]) -> str:
    there, right = fit_there_and_right(agents)
    variances = fit_all_variances(agents, probabilities(agents, (there, right))[1])
    logs = len({a.log for a in agents})
    lines = [
        '"""Weights of the evidence (`agents/evidence.py`), with and without a LiDAR, and of systematic errors.',
        "",
        f"Printed by `{command}`: {len(agents)} candidates of {logs} simulated logs.",
        "`THERE` tells whether something is where a candidate is, `RIGHT` whether a candidate is right",
        "where something is; `VARIANCES` weigh the terms of variances.",
        '"""',
        "",
    ]
    for name, table in (("THERE", there), ("RIGHT", right), ("VARIANCES", variances)):
        lines.append(f"{name} = {{")
        for key, weights in table.items():
            rows = (f"        {n!r}: {float(f'{w:.3g}')}," for n, w in weights.items())
            lines += [f"    {key!r}: {{", *rows, "    },"]
        lines.append("}")
    lines.append(f"CONFIDENCE = {dict.fromkeys(CONFIDENCE, (0.0, 1.0))}")
    return "\n".join(lines).replace("'", '"')


def main(folders: list[Path], scales: bool = False) -> None:
    """Print the module that fits the logs of `confidence_logs` in some folders, or its scales of confidences alone."""
    paths = [path for folder in folders for path in sorted(folder.glob("*.pkl"))]
    if scales:
        judged = [
            a for path in paths for case in pickle.loads(path.read_bytes()) for a in judged_agents(case, path.stem)
        ]
        report_scales(judged)
        return print(f"CONFIDENCE = {fit_scales(judged)}".replace("'", '"'))
    agents: list[Rated] = []
    for path in paths:
        agents += [agent for case in pickle.loads(path.read_bytes()) for agent in agents_of(case, path.stem)]
        say(f"{path.stem}: {len(agents)} candidates")
    report(agents)
    seeds = ", ".join(sorted({path.stem.split("-")[0] for path in paths}))
    command = f"tools/fit.py confidence` on the logs of `tools/fit.py confidence_logs FOLDER --logs {len(paths)} --seed {seeds}"
    return print(module_text(command, agents))
