"""Compare all scenarios of a batch with the ground truth, and sum that up."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import sqrt
from pathlib import Path
from statistics import median
from typing import Any

from log2sim.batch.discovery import FoundLog, find_logs
from log2sim.batch.folder import LOGS, BatchFolder
from log2sim.datatypes import Scenario
from log2sim.errors import Log2SimError, LogError
from log2sim.evaluation.metrics import table
from log2sim.evaluation.metrics.comparison import mota
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.files.documents import rounded
from log2sim.scenarios.index import SCENARIO_FILE

Figures = dict[str, Any]
LoadTruth = Callable[[FoundLog, Scenario], Scenario]

VERSION = 1
POOLED_BY_SQUARE = ("position_rmse_m", "speed_rmse_mps")
OF_A_LOG = tuple(key for key, _, _ in table.COLUMNS)
MEDIANS = ("recall", "precision", "position_median_m", "yaw_median_deg", "size_median_m", "hota")
DIGITS = 4


def evaluate_batch(
    folder: BatchFolder,
    truth: Path,
    load_truth: LoadTruth,
    *,
    max_range_m: float | None = None,
    categories: Sequence[str] | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Figures:
    """Measure each scenario of a batch against the truth of its log.

    `truth`: folder in which the logs have the same places as in the batch's own. `load_truth`: returns the truth of a log for
    a scenario. `max_range_m`, `categories`: what is compared, as for one scenario. `progress`: called as `progress(done, total)`.
    Returns the document of `schemas/batch-metrics-1.json`. Raises `LogError` when no log below `truth` is one of the batch.
    """
    names = sorted(path.parent.name for path in (folder.path / LOGS).glob(f"*/{SCENARIO_FILE}"))
    rows = [row for name in names if (row := folder.read_row(name)) is not None and row.is_done]
    places = {(log.format, log.id): log for log in find_logs(truth, format=folder.settings.format)}
    known = [(row, places[row.format, row.log]) for row in rows if (row.format, row.log) in places]
    if not known:
        raise LogError(f"{truth}: none of the {len(rows)} logs that are done in {folder.path} is below it")
    entries = []
    for k, (row, place) in enumerate(known):
        entry: Figures = {"log": row.log, "name": row.name}
        try:
            scenario = Scenario.load(folder.log_folder(row.name) / SCENARIO_FILE)
            found = evaluate(scenario, load_truth(place, scenario), max_range_m=max_range_m, categories=categories)
            judged, kept = found["correctness"], {name: found[name] for name in (*OF_A_LOG, "counts", "coverage")}
            entries.append(entry | kept | {"judged_ticks": judged["ticks"], "wrong_ticks": judged["wrong"]["ticks"]})
        except Log2SimError as error:
            entries.append(entry | {"error": str(error)})
        progress(k + 1, len(known))
    return {
        "batch_metrics_version": VERSION, "max_range_m": max_range_m,
        "categories": None if categories is None else sorted(categories), "without_truth": len(rows) - len(known),
        "total": pool([entry for entry in entries if "error" not in entry]), "logs": entries,
    }  # fmt: skip


def pool(entries: Sequence[Figures]) -> Figures:
    """Sum up the figures of logs.

    `entries`: as in `logs` of the document, without those that could not be compared. Counts are summed, and
    shares and MOTA follow from the sums; squared errors are averaged over all matched ticks. Medians and HOTA of logs
    cannot be pooled, so `median_of_logs` holds their median over the logs.
    """
    counts = {name: sum(e["counts"][name] for e in entries) for name in (entries[0]["counts"] if entries else ())}
    matched, false = counts.get("matched_ticks", 0), counts.get("false_ticks", 0)
    truth, switches = counts.get("truth_ticks", 0), sum(e["id_switches"] for e in entries)
    known = {name: [e for e in entries if e[name] is not None] for name in (*POOLED_BY_SQUARE, *MEDIANS)}
    squares = {}
    for name in POOLED_BY_SQUARE:
        ticks = [e["counts"]["matched_ticks"] for e in known[name]]
        total = sum(count * e[name] ** 2 for count, e in zip(ticks, known[name]))
        squares[name] = rounded(sqrt(total / sum(ticks)), DIGITS) if sum(ticks) else None
    covered = [e["coverage"] for e in entries if "coverage" in e]
    coverage: Figures = {}
    if covered:
        # What LiDARs hit is that of the logs with points.
        hits = [c for c in covered if c["hit"] is not None]
        hit, hit_matched = (sum(c[key] for c in hits) if hits else None for key in ("hit", "hit_matched"))
        coverage = {
            **{key: sum(c[key] for c in covered) for key in ("labeled", "counted")},
            "why_not": {name: sum(c["why_not"][name] for c in covered) for name in covered[0]["why_not"]},
            "hit": hit,
            "hit_matched": hit_matched,
            "hit_recall": None if hit_matched is None else _share(hit_matched, hit or 0),
        }
    return {
        "logs": len(entries),
        "recall": _share(matched, truth),
        "precision": _share(matched, matched + false),
        **squares,
        "id_switches": switches,
        "mota": mota(truth, truth - matched, false, switches) if truth else None,
        "wrong_share": _share(sum(e["wrong_ticks"] for e in entries), sum(e["judged_ticks"] for e in entries)),
        **({"coverage": coverage} if coverage else {}),
        "counts": counts,
        "median_of_logs": {
            name: rounded(median(e[name] for e in known[name]), DIGITS) if known[name] else None for name in MEDIANS
        },
    }


def _share(part: int, whole: int) -> float | None:
    return rounded(part / whole, DIGITS) if whole else None


def format_batch_verdict(document: Figures) -> str:
    """Say what counted, was found and is wrong in all logs together, and name the logs with the lowest recall."""
    total, compared = document["total"], [e for e in document["logs"] if "error" not in e]
    lines = [("logs", f"{total['logs']} compared")] if total["logs"] else []
    if "coverage" in total:
        lines += [("counted", table.counted_text(total["coverage"])), ("recall", table.recall_text(total))]
    counts = total["counts"]
    if counts:
        ticks = counts["matched_ticks"] + counts["false_ticks"]
        lines.append(("precision", f"{table.percent(total['precision'])} of {ticks} reconstructed agent-ticks"))
    if total["position_rmse_m"] is not None:
        figures = {**dict.fromkeys(OF_A_LOG), **total["median_of_logs"], **{k: total[k] for k in POOLED_BY_SQUARE}}
        lines.append(("errors", table.error_text(figures)))
    if total["wrong_share"] is not None:
        lines.append(("wrong", f"{table.percent(total['wrong_share'])} of the reconstructed agents' ticks"))
    low = sorted((e["recall"], e["log"]) for e in compared if e["recall"] is not None and e["recall"] < 1)
    if low and len(compared) > 1:
        named = [f"{log} recall {table.percent(recall)}" for recall, log in low[: table.MAX_NAMED]]
        lines.append(("lowest", "; ".join(named)))
    missing = document["without_truth"]
    notes = [f"{missing} logs are not below the folder with the truth"] if missing else []
    notes += [f"{entry['log']}: {entry['error']}" for entry in document["logs"] if "error" in entry]
    return table.verdict_text([*lines, *(("note:", note) for note in notes)])


MAX_LOGS = 20  # that are printed; the document has all


def format_batch_table(document: Figures) -> str:
    """Format the figures: a line for each of `MAX_LOGS` logs, the worst recall first, and one for all."""
    rows = sorted(
        (entry for entry in document["logs"] if "error" not in entry),
        key=lambda e: (1.0 if e["recall"] is None else e["recall"], e["log"]),
    )
    total = document["total"]
    whole = {**dict.fromkeys(OF_A_LOG), **total["median_of_logs"], **{k: total[k] for k in OF_A_LOG if k in total}}
    lines = [("all", {**whole, "counts": total["counts"]}), *((entry["log"], entry) for entry in rows[:MAX_LOGS])]
    cells = [["", "agents", *(title for _, title, _ in table.COLUMNS)]]
    cells += [[name, str(f["counts"].get("truth_agents", 0)), *table.figure_cells(f)] for name, f in lines]
    notes = [f"and {len(rows) - MAX_LOGS} more logs with higher recall"] if len(rows) > MAX_LOGS else []
    return "\n".join([*table.columns_text(cells), *notes, "medians and HOTA of all are medians over the logs"])
