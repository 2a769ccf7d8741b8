"""Figures of detected boxes as a table for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from log2sim.evaluation.detection.matching import Criterion

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
    widths = [max(len(row[k]) for row in cells) for k in range(len(cells[0]))]
    lines = ["  ".join(_aligned(row, widths)).rstrip() for row in cells]
    scores = [_score_note(name, result["classes"][name]["calibration"]) for name in shown]
    return "\n".join([*lines, *filter(None, scores), _scope(result)])


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


def _aligned(row: list[str], widths: list[int]) -> list[str]:
    return [c.ljust(w) if k < 3 else c.rjust(w) for k, (c, w) in enumerate(zip(row, widths, strict=True))]


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
