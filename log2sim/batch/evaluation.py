"""Compare all scenarios of a batch with the ground truth, and sum that up."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import sqrt
from pathlib import Path
from statistics import median
from typing import Any

from log2sim.batch.discovery import FoundLog, find_logs
from log2sim.batch.folder import LOGS, SCENARIO_FILE, BatchFolder
from log2sim.datatypes import Scenario
from log2sim.documents import rounded
from log2sim.errors import Log2SimError, LogError
from log2sim.evaluation.metrics.clear_mot import mota
from log2sim.evaluation.metrics.evaluator import evaluate

Figures = dict[str, Any]
LoadTruth = Callable[[FoundLog, Scenario], Scenario]

VERSION = 1
POOLED_BY_SQUARE = ("position_rmse_m", "speed_rmse_mps")
OF_A_LOG = (
    "recall", "precision", "position_rmse_m", "position_median_m", "yaw_median_deg", "speed_rmse_mps", "size_median_m", "id_switches",
    "mota", "hota",
)  # fmt: skip
MEDIANS = ("recall", "precision", "position_median_m", "yaw_median_deg", "size_median_m", "hota")
DIGITS = 4


@dataclass(frozen=True)
class Scope:
    """What is compared, as for one scenario.

    Attributes
    ----------
    max_range_m : float, m, optional
    categories : sequence of str, optional
    """

    max_range_m: float | None = None
    categories: Sequence[str] | None = None


def evaluate_batch(
    folder: BatchFolder,
    truth: Path,
    load_truth: LoadTruth,
    scope: Scope,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Figures:
    """Measure each scenario of a batch against the truth of its log.

    Parameters
    ----------
    folder : BatchFolder
    truth : Path
        Folder in which the logs have the same places as in the batch's own.
    load_truth : callable
        Returns the truth of a log for a scenario.
    scope : Scope
    progress : callable
        Called as `progress(done, total)`.

    Returns
    -------
    dict
        The document of `schemas/batch-metrics-1.json`.

    Raises
    ------
    LogError
        When no log below `truth` is one of the batch.
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
            found = evaluate(
                scenario, load_truth(place, scenario), max_range_m=scope.max_range_m, categories=scope.categories
            )
            entries.append(entry | _figures(found))
        except Log2SimError as error:
            entries.append(entry | {"error": str(error)})
        progress(k + 1, len(known))
    return {
        "batch_metrics_version": VERSION,
        "max_range_m": scope.max_range_m,
        "categories": None if scope.categories is None else sorted(scope.categories),
        "without_truth": len(rows) - len(known),
        "total": pool([entry for entry in entries if "error" not in entry]),
        "logs": entries,
    }


def _figures(found: Figures) -> Figures:
    """Return what is kept of the metrics of one scenario."""
    judged = found["correctness"]
    return {
        **{name: found[name] for name in OF_A_LOG},
        "counts": found["counts"],
        "judged_ticks": judged["ticks"],
        "wrong_ticks": judged["wrong"]["ticks"],
    }


def pool(entries: Sequence[Figures]) -> Figures:
    """Sum up the figures of logs.

    Parameters
    ----------
    entries : sequence of dict
        As in `logs` of the document, without those that could not be compared.

    Returns
    -------
    dict
        Counts are summed, and shares and MOTA follow from the sums; squared errors are averaged over all matched ticks. Medians and HOTA
        of logs cannot be pooled, so `median_of_logs` holds their median over the logs.
    """
    counts = {name: sum(e["counts"][name] for e in entries) for name in (entries[0]["counts"] if entries else ())}
    matched, false = counts.get("matched_ticks", 0), counts.get("false_ticks", 0)
    truth, switches = counts.get("truth_ticks", 0), sum(e["id_switches"] for e in entries)
    judged, wrong = (sum(e[name] for e in entries) for name in ("judged_ticks", "wrong_ticks"))
    return {
        "logs": len(entries),
        "recall": _share(matched, truth),
        "precision": _share(matched, matched + false),
        **{name: _pooled_root(entries, name) for name in POOLED_BY_SQUARE},
        "id_switches": switches,
        "mota": mota(truth, truth - matched, false, switches) if truth else None,
        "wrong_share": _share(wrong, judged),
        "counts": counts,
        "median_of_logs": {name: _median(entries, name) for name in MEDIANS},
    }


def _share(part: int, whole: int) -> float | None:
    return rounded(part / whole, DIGITS) if whole else None


def _pooled_root(entries: Sequence[Figures], name: str) -> float | None:
    """Return the root mean square over the matched ticks of all logs of a figure that is one for each."""
    known = [(e["counts"]["matched_ticks"], e[name]) for e in entries if e[name] is not None]
    ticks = sum(count for count, _ in known)
    return rounded(sqrt(sum(count * value**2 for count, value in known) / ticks), DIGITS) if ticks else None


def _median(entries: Sequence[Figures], name: str) -> float | None:
    known = [e[name] for e in entries if e[name] is not None]
    return rounded(median(known), DIGITS) if known else None


def format_batch_table(document: Figures, *, max_rows: int) -> str:
    """Format the figures: a line for each log up to a number of them, the worst recall first, and one for all."""
    rows = sorted(
        (entry for entry in document["logs"] if "error" not in entry),
        key=lambda e: (1.0 if e["recall"] is None else e["recall"], e["log"]),
    )
    total = document["total"]
    whole = {**dict.fromkeys(OF_A_LOG), **total["median_of_logs"], **{k: total[k] for k in OF_A_LOG if k in total}}
    lines = [("all", {**whole, "counts": total["counts"]}), *((entry["log"], entry) for entry in rows[:max_rows])]
    cells = [["", "agents", *_TITLES], *(_cells(name, figures) for name, figures in lines)]
    widths = [max(len(row[k]) for row in cells) for k in range(len(cells[0]))]
    text = ["  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:]))]) for row in cells]
    return "\n".join([*(line.rstrip() for line in text), *_notes(document, len(rows) - max_rows)])


_TITLES = (
    "recall",
    "precis.",
    "pos rmse m",
    "pos med m",
    "yaw med deg",
    "speed rmse m/s",
    "size med m",
    "id sw",
    "MOTA",
    "HOTA",
)
_DECIMALS = (3, 3, 2, 2, 1, 2, 2, 0, 3, 3)


def _cells(name: str, figures: Figures) -> list[str]:
    values = [figures[key] for key in OF_A_LOG]
    numbers = ["-" if value is None else f"{value:.{digits}f}" for value, digits in zip(values, _DECIMALS)]
    return [name, str(figures["counts"].get("truth_agents", 0)), *numbers]


def _notes(document: Figures, hidden: int) -> Iterator[str]:
    """Yield what the table does not show."""
    total = document["total"]
    if hidden > 0:
        yield f"and {hidden} more logs with higher recall"
    if total["wrong_share"] is not None:
        yield f"wrong: {100 * total['wrong_share']:.1f} % of the reconstructed agents' ticks"
    yield "medians and HOTA of all are medians over the logs"
    if document["without_truth"]:
        yield f"note: {document['without_truth']} logs are not below the folder with the truth"
    for entry in document["logs"]:
        if "error" in entry:
            yield f"note: {entry['log']}: {entry['error']}"
