"""Figures of detected boxes as a table for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from log2sim.evaluation.detection.matching import Criterion
from log2sim.evaluation.metrics.table import columns_text, percent, verdict_text

AVERAGES = {
    "kitti": (("ap_r40", "AP R40"), ("ap_r11", "AP R11"), ("ap_r40_published", "publ. R40")),
    "dair": (("ap_r40", "AP R40"), ("ap_r11", "AP R11")),
    "center": (("ap_nuscenes", "AP nuSc"), ("ap_r40", "AP R40")),
}
AT_SCORE = (
    ("precision", "precis."),
    ("recall", "recall"),
    ("f1", "F1"),
    ("precision_times_recall", "P x R"),
    ("heading_over_90_deg", "> 90 deg"),
)


def format_verdict(result: Mapping[str, Any]) -> str:
    """Say for each class how many boxes were found, how many of the found are right, and the average precision."""
    key, title = AVERAGES[result["protocol"]][0]
    lines, shown = [], list[Any]()
    for name, figures in result["classes"].items():
        row = next((row for row in _rows(figures) if row["objects"] == "all"), None)
        if row is None or figures in shown:
            continue
        shown.append(figures)
        limit = Criterion(**row["match"])
        if not row["truths"]:
            lines.append((name, f"none labeled, {row['false_positives']} found ({limit})"))
            continue
        text = f"{percent(row['recall'])} of {row['truths']} found, {percent(row['precision'])} of the found right"
        average = "" if row[key] is None else f", {title} {row[key]:.3f}"
        turned = row["heading_over_90_deg"]
        backwards = f", {percent(turned)} backwards" if turned else ""
        lines.append((name, f"{text}{average}{backwards} ({limit})"))
    return verdict_text([*lines, ("scope", _scope(result))])


def format_table(result: Mapping[str, Any]) -> str:
    """Format a result of `evaluate_boxes`; '-' for None.

    Left out are classes without a true and a found box, categories that are all of their group, rows without true boxes,
    and the looser limits of difficulties; the document has them.
    """
    columns = (*AVERAGES[result["protocol"]], *AT_SCORE)
    cells = [["class", "objects", "match", "truths", *(title for _, title in columns)]]
    shown: dict[str, list[Mapping[str, Any]]] = {}
    for name, figures in result["classes"].items():
        rows = _rows(figures)
        if rows and rows not in shown.values():
            shown[name] = rows
    for name, rows in shown.items():
        for row in rows:
            values = [_cell(row[key]) for key, _ in columns]
            cells.append([name, row["objects"], str(Criterion(**row["match"])), str(row["truths"]), *values])
    if len(shown) > 1:
        for row in result["overall"]:
            if row["truths"]:
                values = [_cell(row.get(key)) for key, _ in columns]
                cells.append(["all classes", row["objects"], "each its first", str(row["truths"]), *values])
    lines = columns_text(cells, heads=3)
    scores = [_score_note(name, result["classes"][name]["calibration"]) for name in shown]
    return "\n".join([*lines, *filter(None, scores)])


def _rows(figures: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Select the rows of a class."""
    limit = figures["calibration"]["match"]["limit"]
    everything = [row for row in figures["figures"] if row["objects"] == "all"]
    parts = [row for row in figures["figures"] if row["objects"] != "all" and row["match"]["limit"] == limit]
    parts += [*figures["by_range"], *(figures["by_points"] or [])]
    if not any(row["truths"] for row in (*everything, *parts)):
        # Only false boxes, which one match tells as well as all.
        return [row for row in everything[:1] if row["false_positives"]]
    return [*everything, *(row for row in parts if row["truths"])]


def _score_note(name: str, scores: Mapping[str, Any]) -> str:
    error = scores["expected_calibration_error"]
    if error is None:
        return ""
    where = f"{scores['boxes']} boxes, {Criterion(**scores['match'])}"
    return f"{name}: expected calibration error of the scores {error:.3f} ({where})"


def _scope(result: Mapping[str, Any]) -> str:
    sweeps, skipped = result["sweeps"], result["sweeps_without_labels"]
    parts = [
        f"{sweeps} labeled sweep{'s' * (sweeps != 1)}" + (f" ({skipped} without labels left out)" if skipped else "")
    ]
    if result["reference_camera"] is not None:
        parts.append(f"boxes that {result['reference_camera']} shows")
        if not result["occlusion_known"]:
            parts.append("difficulties without occlusion, which the labels do not state")
    if result["max_range_m"] is not None:
        parts.append(f"up to {result['max_range_m']:g} m")
    return f"{'; '.join(parts)}; precision, recall and what follows at scores from {result['min_score']:g}"


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
