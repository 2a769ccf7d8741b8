"""Agents of simulated logs with missed and false detections: what is found, what is wrong, and how well confidences are calibrated.

    python tools/fit.py confidence_logs FOLDER --logs 20 --seed 17
    python tools/bench.py agents FOLDER ... [--without agents.judge.resolve_conflicts ...]

Goes on from the first passes in the folders; logs count in which sweeps are searched and anything is reconstructed. `--without` switches
rules and constants off, by the names that `tools/ablate.py` gives them; what answers yes or no answers no.
"""

from __future__ import annotations

import multiprocessing
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from ablate import Imports, method_modules, variations
from fits.confidence_logs import Case

from benchmarks.table import markdown
from log2sim.agents.weights import CONFIDENCE
from log2sim.config import Config
from log2sim.datatypes import GROUP_OF
from log2sim.errors import NothingToReconstruct
from log2sim.evaluation.metrics.correctness import reliability
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.evaluation.metrics.verdicts import MAX_WRONG_SHARE

SEARCHED = {True: "images and sweeps", False: "sweeps"}
LOG_HEAD = ["searched", "logs", "recall", "precision", "HOTA", "wrong ticks"]
AGENT_HEAD = ["agents", "count", "calibration error", "wrong ticks doubted", "right ticks doubted", "ticks backwards"]


def measured(path: Path) -> list[tuple[bool, dict[str, Any]]]:
    """Reconstruct the cases of a log in which sweeps are searched: whether images are, too, and the evaluation."""
    cases: list[Case] = pickle.loads(path.read_bytes())
    out = []
    for case in cases:
        names = case.run.config.detect
        if not case.run.log.lidars or not names.in_sweeps:
            continue
        try:
            alone = replace(case, run=replace(case.run, jobs=1))
            out.append((bool(names.in_images), evaluate(alone.second().scenario, case.truth)))
        except NothingToReconstruct:
            continue
    return out


def switch_off(names: list[str]) -> None:
    """Switch rules and constants off in this process and in those that it forks; ends it at a name that there is not."""
    known = {v.label: v for v in variations(Config()) if v.module and v.change != "always"}
    imports = Imports(method_modules())
    for name in names:
        if name not in known:
            raise SystemExit(f"--without {name}: no rule or constant has this name")
        imports.put(known[name].module, known[name].name, known[name].value)


def tables(found: list[tuple[bool, dict[str, Any]]]) -> str:
    """Tables of logs by what is searched, and of agents by group."""
    rows = []
    for images, name in SEARCHED.items():
        own = [result for of, result in found if of == images]
        count = {key: sum(m["counts"][key] for m in own) for key in ("truth_ticks", "matched_ticks", "false_ticks")}
        hota = sum(m["counts"]["truth_ticks"] * (m["hota"] or 0.0) for m in own)
        wrong = sum(m["correctness"]["wrong"]["ticks"] for m in own)
        shares = (
            (count["matched_ticks"], count["truth_ticks"]),
            (count["matched_ticks"], count["matched_ticks"] + count["false_ticks"]),
            (hota, count["truth_ticks"]),
            (wrong, sum(m["correctness"]["ticks"] for m in own)),
        )
        rows.append([name, str(len(own)), *(f"{part / max(whole, 1):.3f}" for part, whole in shares)])
    of_agents = []
    for group in CONFIDENCE:
        agents = [a for _, m in found for a in m["correctness"]["judged_agents"] if GROUP_OF[a["category"]] == group]
        if not agents:
            continue
        columns = ("ticks", "wrong_ticks", "confidence", "doubted", "backwards_ticks")
        ticks, wrong, confidence, doubted, backwards = (np.array([a[key] for a in agents]) for key in columns)
        error = reliability(confidence, wrong <= MAX_WRONG_SHARE * ticks)["expected_calibration_error"]
        of_doubted = [(of * doubted).sum() / max(of.sum(), 1) for of in (wrong, ticks - wrong)]
        shares = error, *of_doubted, backwards.sum() / ticks.sum()
        of_agents.append([group, str(len(agents)), *(f"{v:.3f}" for v in shares)])
    return f"{markdown(LOG_HEAD, rows)}\n\n{markdown(AGENT_HEAD, of_agents)}"


def main(folders: list[Path], without: list[str] = [], jobs: int = 2) -> None:
    paths = sorted(path for folder in folders for path in folder.glob("*.pkl"))
    if not paths:
        raise SystemExit(f"{', '.join(map(str, folders))}: no first passes; `tools/fit.py confidence_logs` makes them")
    switch_off(without)
    with multiprocessing.get_context("fork").Pool(jobs) as pool:
        print(tables([row for rows in pool.imap_unordered(measured, paths) for row in rows]))
