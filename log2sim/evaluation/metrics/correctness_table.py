"""What is wrong with the agents, as text for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from log2sim.evaluation.metrics.verdicts import MEASURES

COLUMNS = (
    ("invented", "invented"),
    ("duplicate", "duplicate"),
    ("in_ego", "in ego"),
    ("wrong_speed", "speed"),
    ("wrong_motion", "motion"),
    ("backwards", "backwards"),
    ("wrong_size", "size"),
    ("wrong", "wrong"),
    ("wrong_class", "class"),
)
NEES = {"sigma": "NEES: position", "sigma_yaw": "yaw", "sigma_speed": "speed"}
MAX_WORST = 6
"""Agents that are named; the document has all."""


def correctness_lines(found: Mapping[str, Any]) -> list[str]:
    """Format the part `correctness` of a result of `evaluate`; no line where nothing was judged."""
    if not found["ticks"]:
        return []
    title = "wrong of the reconstructed agents' ticks (agents), doubted of these ticks, and squared errors over sigma (NEES, 1 is right):"
    confused = _confused_line(found["confusion"])
    return [
        "",
        title,
        *_table(found),
        *confused,
        "",
        *_calibration_lines(found),
        "",
        *_worst_lines(found["judged_agents"]),
    ]


def _table(found: Mapping[str, Any]) -> list[str]:
    lines = [("all", found)]
    lines += list(found["by_kind"].items()) if len(found["by_kind"]) > 1 else []
    lines += [(f"{name} m", figures) for name, figures in (found["by_range"] or {}).items()]
    titles = [title for _, title in COLUMNS]
    cells = [["", "agents", "ticks", *titles, "doubted: wrong", "right", *NEES.values()]]
    for name, figures in lines:
        if figures["ticks"]:
            shares = [f"{figures[key]['share']:.3f} ({figures[key]['agents']})" for key, _ in COLUMNS]
            doubted = [_number(figures["doubted"][key], 3) for key in ("wrong_ticks", "right_ticks")]
            counts = [str(figures["agents"]), str(figures["ticks"])]
            nees = [_number(figures[key]["nees"], 1) for key in NEES]
            cells.append([name, *counts, *shares, *doubted, *nees])
    widths = [max(len(row[k]) for row in cells) for k in range(len(cells[0]))]
    rows = [[row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:]))] for row in cells]
    return ["  ".join(row).rstrip() for row in rows]


def _confused_line(confusion: Mapping[str, Any]) -> list[str]:
    """Say which categories are taken for which, most agents first; no line without any."""
    agents, ticks = confusion["agents"], confusion["ticks"]
    pairs = [(true, ours) for ours, row in ticks.items() for true in row if true not in (ours, "nothing")]
    counts = {(true, ours): (agents.get(ours, {}).get(true, 0), ticks[ours][true]) for true, ours in pairs}
    parts = [
        f"{true} as {ours} ({_noun(counts[true, ours][0], 'agent')}, {_noun(counts[true, ours][1], 'tick')})"
        for true, ours in sorted(pairs, key=lambda pair: (*(-n for n in counts[pair]), pair))
    ]
    return [f"class: {', '.join(parts)}"] if parts else []


def _calibration_lines(found: Mapping[str, Any]) -> list[str]:
    """Say for each tenth of confidence how many ticks and agents are right."""
    ticks, agents = found["calibration"]["ticks"], found["calibration"]["agents"]
    errors = [
        f"{table['expected_calibration_error']:.3f} of {noun}" for noun, table in (("ticks", ticks), ("agents", agents))
    ]
    lines = [f"confidence: expected calibration error {', '.join(errors)}"]
    for a, b in zip(ticks["bins"], agents["bins"], strict=True):
        if a["count"]:
            lines.append(
                f"  {a['low']:.1f}-{a['high']:.1f}: {_number(a['right'], 3)} of {a['count']} ticks right, "
                f"{_number(b['right'], 3)} of {_noun(b['count'], 'agent')}"
            )
    return lines


def _worst_lines(agents: list[Mapping[str, Any]]) -> list[str]:
    """Name the agents with the most wrong ticks, those first that the scenario does not doubt."""
    wrong = [row for row in agents if row["wrong_ticks"]]
    worst = sorted(wrong, key=lambda row: (row["doubted"], -row["wrong_ticks"], row["id"]))[:MAX_WORST]
    lines = [_sentence(row) for row in worst]
    more = len(wrong) - len(worst)
    return [*lines, *([f"and {more} more with wrong ticks"] if more else [])]


def _sentence(row: Mapping[str, Any]) -> str:
    named = {key: title for key, title in COLUMNS if key in MEASURES}
    named |= {key: f"wrong {named[key]}" for key in ("wrong_speed", "wrong_motion", "wrong_size")}
    faults = [f"{named[key]} in {row[f'{key}_ticks']}" for key in MEASURES if row[f"{key}_ticks"]]
    doubt = f"doubted ({', '.join(row['doubts'])})" if row["doubted"] else "not doubted"
    return f"{row['id']}: {', '.join(faults)} of {_noun(row['ticks'], 'tick')}, confidence {row['confidence']:.2f}, {doubt}"


def _noun(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count != 1)}"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
