"""What is wrong with the agents, as text for the terminal."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
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
_FAULTS = dict(COLUMNS) | {k: f"wrong {n}" for k, n in COLUMNS if k in ("wrong_speed", "wrong_motion", "wrong_size")}
NEES = {"sigma": "NEES", "sigma_yaw": "yaw", "sigma_speed": "speed"}
MAX_WORST = 6
"""Agents that are named; the document has all."""


def wrong_parts(found: Mapping[str, Any]) -> list[str]:
    """Say which share of the agents' ticks is wrong, by what, and how much of it the scenario doubts."""
    share = found["wrong"]["share"]
    parts = [f"{found[key]['share']:.1%} {_FAULTS[key]}".replace("%", " %") for key in MEASURES if found[key]["ticks"]]
    text = (
        f"{share:.1%} of {found['ticks']} agent-ticks, {_noun(found['wrong']['agents'], 'agent')} of {found['agents']}"
    )
    doubted = found["doubted"]
    lines = [text.replace("%", " %") + (f": {', '.join(parts)}" if parts else "")]
    if parts:
        lines.append(f"{_share(doubted['wrong_ticks'])} of it doubted, {_share(doubted['right_ticks'])} of the right")
    elif doubted["right_ticks"]:
        lines.append(f"{_share(doubted['right_ticks'])} of the right doubted")
    return lines


def correctness_lines(
    found: Mapping[str, Any], columns_text: Callable[[Sequence[Sequence[str]]], list[str]]
) -> list[str]:
    """Format the part `correctness` of a result of `evaluate` as tables; no line where nothing was judged."""
    if not found["ticks"]:
        return []
    return [
        "",
        "wrong in % of the reconstructed agents' ticks (agents); doubted in % of the wrong and right ones;",
        "NEES: squared errors of position, yaw and speed over sigma, 1 is right",
        *columns_text(_cells(found)),
        *textwrap.wrap(_confused_line(found["confusion"]), 100, subsequent_indent="  "),
        "",
        *_calibration_lines(found),
        "",
        *worst_agents(found["judged_agents"], MAX_WORST),
    ]


def _cells(found: Mapping[str, Any]) -> list[list[str]]:
    lines = [("all", found)]
    lines += list(found["by_kind"].items()) if len(found["by_kind"]) > 1 else []
    lines += [(f"{name} m", figures) for name, figures in (found["by_range"] or {}).items()]
    cells = [["", "agents", "ticks", *(title for _, title in COLUMNS), *("doubted", "right"), *NEES.values()]]
    for name, figures in lines:
        if figures["ticks"]:
            parts = [figures[key] for key, _ in COLUMNS]
            shares = [f"{100 * p['share']:.1f} ({p['agents']})" if p["ticks"] else "-" for p in parts]
            doubted = [_number(_times_100(figures["doubted"][key]), 0) for key in ("wrong_ticks", "right_ticks")]
            nees = [_number(figures[key]["nees"], 1) for key in NEES]
            cells.append([name, str(figures["agents"]), str(figures["ticks"]), *shares, *doubted, *nees])
    return cells


def _confused_line(confusion: Mapping[str, Any]) -> str:
    """Say which categories are taken for which, most agents first; "" without any."""
    agents, ticks = confusion["agents"], confusion["ticks"]
    pairs = [(true, ours) for ours, row in ticks.items() for true in row if true not in (ours, "nothing")]
    counts = {(true, ours): (agents.get(ours, {}).get(true, 0), ticks[ours][true]) for true, ours in pairs}
    parts = [
        f"{true} as {ours} ({_noun(counts[true, ours][0], 'agent')}, {_noun(counts[true, ours][1], 'tick')})"
        for true, ours in sorted(pairs, key=lambda pair: (*(-n for n in counts[pair]), pair))
    ]
    return f"class: {', '.join(parts)}" if parts else ""


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


def worst_agents(agents: Sequence[Mapping[str, Any]], count: int, *, brief: bool = False) -> list[str]:
    """Name the agents with the most wrong ticks, those first that the scenario does not doubt."""
    wrong = [row for row in agents if row["wrong_ticks"]]
    worst = sorted(wrong, key=lambda row: (row["doubted"], -row["wrong_ticks"], row["id"]))[:count]
    more = len(wrong) - len(worst)
    return [
        *(_brief(row) if brief else _sentence(row) for row in worst),
        *([f"and {more} more with wrong ticks"] if more else []),
    ]


def _brief(row: Mapping[str, Any]) -> str:
    faults = [_FAULTS[key] for key in MEASURES if row[f"{key}_ticks"]]
    return (
        f"{row['id']} {', '.join(faults)} ({row['wrong_ticks']} of {row['ticks']} ticks{', doubted' * row['doubted']})"
    )


def _sentence(row: Mapping[str, Any]) -> str:
    faults = [f"{_FAULTS[key]} in {row[f'{key}_ticks']}" for key in MEASURES if row[f"{key}_ticks"]]
    doubt = f"doubted ({', '.join(row['doubts'])})" if row["doubted"] else "not doubted"
    return f"{row['id']}: {', '.join(faults)} of {_noun(row['ticks'], 'tick')}, confidence {row['confidence']:.2f}, {doubt}"


def _noun(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count != 1)}"


def _times_100(value: float | None) -> float | None:
    return None if value is None else 100 * value


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f} %"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
