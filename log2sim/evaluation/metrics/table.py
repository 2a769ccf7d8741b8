"""Metrics as text for the terminal."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from log2sim.evaluation.metrics.comparison import MIN_HIT_POINTS, REASONS
from log2sim.evaluation.metrics.evaluator import describe_placement
from log2sim.evaluation.metrics.verdicts import MEASURES
from log2sim.evaluation.road import cell, map_lines, road_verdict, whole_percent

CORRECTNESS_COLUMNS = (
    ("invented", "invented"), ("duplicate", "duplicate"), ("in_ego", "in ego"), ("wrong_speed", "speed"), ("wrong_motion", "motion"),
    ("backwards", "backwards"), ("wrong_size", "size"), ("wrong", "wrong"), ("wrong_class", "class"),
)  # fmt: skip
_FAULTS = {key: f"wrong {name}" if key == f"wrong_{name}" else name for key, name in CORRECTNESS_COLUMNS}
NEES = {"sigma": "NEES", "sigma_yaw": "yaw", "sigma_speed": "speed"}
MAX_WORST = 6  # agents that are named; the document has all


def wrong_parts(found: Mapping[str, Any]) -> list[str]:
    """Say which share of the agents' ticks is wrong, by what, and how much of it the scenario doubts."""
    share = found["wrong"]["share"]
    parts = [f"{found[key]['share']:.1%} {_FAULTS[key]}".replace("%", " %") for key in MEASURES if found[key]["ticks"]]
    agents = _noun(found["wrong"]["agents"], "agent")
    text = f"{share:.1%} of {found['ticks']} agent-ticks, {agents} of {found['agents']}".replace("%", " %")
    wrong, right = (whole_percent(found["doubted"][key]) for key in ("wrong_ticks", "right_ticks"))
    if parts:
        return [f"{text}: {', '.join(parts)}", f"{wrong} of it doubted, {right} of the right"]
    return [text, f"{right} of the right doubted"] if found["doubted"]["right_ticks"] else [text]


def correctness_lines(found: Mapping[str, Any]) -> list[str]:
    """Format the part `correctness` of a result of `evaluate` as tables; no line where nothing was judged."""
    if not found["ticks"]:
        return []
    lines = [("all", found)]
    lines += list(found["by_kind"].items()) if len(found["by_kind"]) > 1 else []
    lines += [(f"{name} m", figures) for name, figures in (found["by_range"] or {}).items()]
    cells = [["", "agents", "ticks", *(title for _, title in CORRECTNESS_COLUMNS), "doubted", "right", *NEES.values()]]
    for name, figures in lines:
        if figures["ticks"]:
            parts = [figures[key] for key, _ in CORRECTNESS_COLUMNS]
            shares = [f"{100 * p['share']:.1f} ({p['agents']})" if p["ticks"] else "-" for p in parts]
            doubted = [cell(figures["doubted"][key], 0, 100) for key in ("wrong_ticks", "right_ticks")]
            nees = [cell(figures[key]["nees"], 1) for key in NEES]
            cells.append([name, str(figures["agents"]), str(figures["ticks"]), *shares, *doubted, *nees])
    # Which categories are taken for which, most agents first.
    of_agents, of_ticks = found["confusion"]["agents"], found["confusion"]["ticks"]
    pairs = [(true, ours) for ours, row in of_ticks.items() for true in row if true not in (ours, "nothing")]
    counts = {(true, ours): (of_agents.get(ours, {}).get(true, 0), of_ticks[ours][true]) for true, ours in pairs}
    taken = [
        f"{true} as {ours} ({_noun(counts[true, ours][0], 'agent')}, {_noun(counts[true, ours][1], 'tick')})"
        for true, ours in sorted(pairs, key=lambda pair: (*(-n for n in counts[pair]), pair))
    ]
    confused = f"class: {', '.join(taken)}" if taken else ""
    # For each tenth of confidence how many ticks and agents are right.
    ticks, agents = found["calibration"]["ticks"], found["calibration"]["agents"]
    calibration = [
        f"confidence: expected calibration error {ticks['expected_calibration_error']:.3f} of ticks, "
        f"{agents['expected_calibration_error']:.3f} of agents (by chance {agents['error_by_chance']:.3f})",
        *(
            f"  {a['low']:.1f}-{a['high']:.1f}: {cell(a['right'], 3)} of {a['count']} ticks right, "
            f"{cell(b['right'], 3)} of {_noun(b['count'], 'agent')}"
            for a, b in zip(ticks["bins"], agents["bins"], strict=True)
            if a["count"]
        ),
    ]
    return [
        "", "wrong in % of the reconstructed agents' ticks (agents); doubted in % of the wrong and right ones;",
        "NEES: squared errors of position, yaw and speed over sigma, 1 is right", *columns_text(cells),
        *textwrap.wrap(confused, 100, subsequent_indent="  "), "", *calibration,
        "", *worst_agents(found["judged_agents"], MAX_WORST),
    ]  # fmt: skip


def worst_agents(agents: Sequence[Mapping[str, Any]], count: int, *, brief: bool = False) -> list[str]:
    """Name the agents with the most wrong ticks, those first that the scenario does not doubt."""
    wrong = [row for row in agents if row["wrong_ticks"]]
    worst = sorted(wrong, key=lambda row: (row["doubted"], -row["wrong_ticks"], row["id"]))[:count]
    lines = []
    for row in worst:
        faults = {_FAULTS[key]: row[f"{key}_ticks"] for key in MEASURES if row[f"{key}_ticks"]}
        if brief:
            share = f"{row['wrong_ticks']} of {row['ticks']} ticks{', doubted' * row['doubted']}"
            lines.append(f"{row['id']} {', '.join(faults)} ({share})")
        else:
            what = ", ".join(f"{fault} in {ticks}" for fault, ticks in faults.items())
            doubt = f"doubted ({', '.join(row['doubts'])})" if row["doubted"] else "not doubted"
            of = f"of {_noun(row['ticks'], 'tick')}, confidence {row['confidence']:.2f}, {doubt}"
            lines.append(f"{row['id']}: {what} {of}")
    return [*lines, *([f"and {len(wrong) - len(worst)} more with wrong ticks"] if len(wrong) > len(worst) else [])]


def _noun(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count != 1)}"


MAX_COLUMNS = 100
MAX_NAMED = 3  # agents that a line of the verdict names; the tables have more, the document all
MAX_NAME = 16  # characters of the id of a labeled object; some logs use 36
COLUMNS = (
    ("recall", "recall %", 1), ("precision", "precis. %", 1), ("position_rmse_m", "rms m", 2), ("position_median_m", "med m", 2),
    ("yaw_median_deg", "yaw deg", 1), ("speed_rmse_mps", "m/s", 2), ("size_median_m", "size m", 2), ("id_switches", "id sw", 0),
    ("mota", "MOTA", 3), ("hota", "HOTA", 3),
)  # fmt: skip


def format_verdict(result: Mapping[str, Any]) -> str:
    """Say what counted, what was found and how well, and what is wrong, in lines of at most 100 characters."""
    placement = describe_placement(result["placement"]) if "placement" in result else None
    lines = [] if placement is None else [("map", placement)]
    if result.get("quarantined"):
        lines.append(("left out", f"quarantined: {', '.join(result['quarantined'])}"))
    if "coverage" in result:
        lines.append(("counted", counted_text(result["coverage"], f" of {result['counts']['truth_agents']} agents")))
    lines.append(("recall", recall_text(result)))
    # The true agents that are missed longest: of the ticks with enough LiDAR points, else of those that count.
    rows = []
    for row in result["agents"]:
        of, matched = (row["ticks"], row["matched"]) if row.get("hit") is None else (row["hit"], row["hit_matched"])
        if of > matched:
            name = row["id"] if len(row["id"]) <= MAX_NAME else f"{row['id'][: MAX_NAME - 2]}.."
            rows.append((matched - of, f"{row['category']} '{name}' in {of - matched} of {of} ticks"))
    more = [f"and {len(rows) - MAX_NAMED} more"] if len(rows) > MAX_NAMED else []
    if rows:
        lines.append(("missed", "; ".join([*(text for _, text in sorted(rows)[:MAX_NAMED]), *more])))
    counts, found = result["counts"], result["correctness"]
    total = counts["matched_ticks"] + counts["false_ticks"]
    ignored = f", {counts['ignored_ticks']} where the labels cannot tell" if counts["ignored_ticks"] else ""
    lines.append(("precision", f"{percent(result['precision'])} of {total} reconstructed agent-ticks{ignored}"))
    if result["position_rmse_m"] is not None:
        lines.append(("errors", error_text(result)))
    if found["ticks"]:
        lines.append(("wrong", "; ".join(wrong_parts(found))))
    if worst := worst_agents(found["judged_agents"], MAX_NAMED, brief=True):
        lines.append(("worst", "; ".join(worst)))
    return verdict_text([*lines, *road_verdict(result)])


def counted_text(coverage: Mapping[str, Any], agents: str = "") -> str:
    """Say how much of what is labeled counts, and why the rest does not."""
    why = [f"{count} {REASONS[name]}" for name, count in coverage["why_not"].items() if count]
    reasons = f"; not: {', '.join(why)}" if why else ""
    share = percent(coverage["counted"] / coverage["labeled"]) if coverage["labeled"] else "-"
    return f"{coverage['counted']} of {coverage['labeled']} labeled agent-ticks ({share}){agents}{reasons}"


def recall_text(result: Mapping[str, Any]) -> str:
    """Give both recalls: of what counts, and of what the LiDARs hit."""
    text = f"{percent(result['recall'])} of what counts"
    hit = result.get("coverage") or {"hit": None}
    if hit["hit"] is None:
        return text
    return f"{text}; {percent(hit['hit_recall'])} of all {hit['hit']} with {MIN_HIT_POINTS} LiDAR points or more"


def error_text(result: Mapping[str, Any]) -> str:
    """Give the errors of position, yaw, speed and size."""
    parts = [f"position {result['position_median_m']:.2f} m (median; RMS {result['position_rmse_m']:.2f})"]
    for key, name, digits, unit in (
        ("yaw_median_deg", "yaw", 1, "deg"), ("speed_rmse_mps", "speed", 2, "m/s"), ("size_median_m", "size", 2, "m"),
    ):  # fmt: skip
        parts += [f"{name} {result[key]:.{digits}f} {unit}"] if result[key] is not None else []
    ego = result.get("ego")
    own = "" if ego is None or ego["position_rmse_m"] is None else f"; ego {ego['position_rmse_m']:.2f} m"
    return f"{', '.join(parts)}{own}"


def verdict_text(lines: Iterable[tuple[str, str]]) -> str:
    """Put names in front of texts, and break these at 100 characters."""
    found = list(lines)
    room = max((len(name) for name, _ in found), default=0) + 2
    out: list[str] = []
    for name, text in found:
        kept, first, rest = text.replace(" %", "\N{NO-BREAK SPACE}%"), name.ljust(room), " " * room
        out += textwrap.wrap(kept, MAX_COLUMNS, initial_indent=first, subsequent_indent=rest, break_on_hyphens=False)
    return "\n".join(out).replace("\N{NO-BREAK SPACE}", " ")


def format_table(result: Mapping[str, Any]) -> str:
    """Format all tables of a result of `evaluate`: what counts, errors, what is wrong, and the road; '-' for None."""
    lines = [("all", result)]
    lines += [(f"{name} m", figures) for name, figures in (result["by_range"] or {}).items()]
    lines += list(result["by_category"].items())
    blocks = []
    if "coverage" in result:
        titles = [name.replace("_", " ") for name in REASONS]
        cells = [["", "labeled", "counted", *titles, f"{MIN_HIT_POINTS} points", "recall %"]]
        for name, figures in lines:
            part = figures["coverage"]
            if part["labeled"]:
                hit = [cell(part["hit"], 0), cell(part["hit_recall"], 1, 100)]
                why_not = [str(count or "-") for count in part["why_not"].values()]
                cells.append([name, str(part["labeled"]), str(part["counted"]), *why_not, *hit])
        blocks += columns_text(cells)

    def values(figures: Mapping[str, Any]) -> list[str]:
        return figure_cells({**figures, "id_switches": figures.get("id_switches") or None})

    cells = [["", "agents", *(title for _, title, _ in COLUMNS)]]
    for name, figures in lines:
        if figures is result or any(figures["counts"].values()):
            cells.append([name, str(figures["counts"]["truth_agents"]), *values(figures)])
    if result["ego"] is not None:
        cells.append(["ego", "", *values(result["ego"])])
    blocks += ["", *columns_text(cells)] if blocks else columns_text(cells)
    return "\n".join([*blocks, *correctness_lines(result["correctness"]), *map_lines(result)])


def figure_cells(figures: Mapping[str, Any]) -> list[str]:
    """Format the figures of a row of `COLUMNS`; '-' for None, nothing for those that it has not."""
    scale = {"recall": 100, "precision": 100}
    return [cell(figures[key], n, scale.get(key, 1)) if key in figures else "" for key, _, n in COLUMNS]


def columns_text(cells: Sequence[Sequence[str]], heads: int = 1) -> list[str]:
    """Format rows, the first of titles, within a number of characters.

    Columns of dashes alone are left out. What does not fit goes into a further table below, which repeats the
    first `heads` columns; these are aligned to the left.
    """
    if len(cells) < 2:
        return []
    used = [k for k in range(len(cells[0])) if k < heads or any(row[k] not in ("", "-") for row in cells[1:])]
    widths = {k: max(len(row[k]) for row in cells) for k in used}
    # A name may be of any length; it takes half of a line at most.
    for k in range(heads):
        widths[k] = min(widths[k], MAX_COLUMNS // (2 * heads))
    first = used[:heads]
    rest, blocks = used[heads:], list[list[int]]()
    while rest or not blocks:
        block, width = list(first), sum(widths[k] + 2 for k in first) - 2
        while rest and (width + 2 + widths[rest[0]] <= MAX_COLUMNS or len(block) == heads):
            width += 2 + widths[rest[0]]
            block.append(rest.pop(0))
        blocks.append(block)
    lines: list[str] = []
    for block in blocks:
        lines += [""] if lines else []
        for row in cells:
            texts = [row[k].rjust(widths[k]) for k in block]
            for k in range(heads):
                texts[k] = (row[k] if len(row[k]) <= widths[k] else f"..{row[k][2 - widths[k] :]}").ljust(widths[k])
            lines.append("  ".join(texts).rstrip())
    return lines


def percent(share: float | None) -> str:
    """Format a share; only what is all or nothing has no decimals."""
    if share is None:
        return "-"
    return f"{100 * share:.0f} %" if share in (0, 1) else f"{min(max(100 * share, 0.1), 99.9):.1f} %"
