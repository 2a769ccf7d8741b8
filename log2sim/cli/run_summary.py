"""What `log2sim reconstruct` says when it is done: what was found, what to doubt, what was missing, where to look next."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from log2sim.cli.options import counted

if TYPE_CHECKING:
    from log2sim.datatypes import Scenario
    from log2sim.pipeline import Result

LOOKED_FOR = (
    "image decoding",
    "detection in LiDAR sweeps",
    "markings and lanes",
    "colors of vehicles",
    "traffic lights",
)
"""Stages without which something is missing in a scenario; the others save time."""


def summarize(result: Result, next_line: str, out: Path, *, verbose: bool = False) -> list[str]:
    """Summarize a run for people; with `verbose` everything is listed, also which stages were left out."""
    from log2sim.cli.tables import format_rows
    from log2sim.datatypes import say_agents, say_categories

    scenario, seconds = result.scenario, result.report["seconds"]
    ids = say_agents(agent.id for agent in scenario.agents)
    speed = f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    rows = [
        ("agents", say_categories(scenario.others) or "none"),
        *(("doubtful", line) for line in doubt_lines(scenario, verbose=verbose) or ["none"]),
        ("road", ", ".join(described(scenario)) or "no lanes, markings or traffic lights"),
        *(("missing", line) for line in missing_lines(scenario)),
        *(("used", line) for line in (stage_lines(scenario) if verbose else ())),
    ]
    names = [name if k == 0 or rows[k - 1][0] != name else "" for k, (name, _) in enumerate(rows)]
    table = format_rows([(name, text) for name, (_, text) in zip(names, rows)], indent=2)
    made = ", ".join([f"made in {speed}", *known_pictures(result.report)])
    # Never broken into lines: it is there to be copied.
    return [
        f"{out}: {ids} over {scenario.duration_s:.1f} s, {made}",
        *table,
        f"  {'next':<{len('doubtful')}}  {next_line}",
    ]


def known_pictures(report: dict[str, Any]) -> list[str]:
    """Say how many pictures were not searched, since an earlier run had done it."""
    cache = report["detection_cache"]
    found = 0 if cache is None else cache["found"]
    return [f"{counted(found, 'picture')} known from earlier runs"] if found else []


def cache_notes(report: dict[str, Any]) -> list[str]:
    """Say why detections were not kept, where they should have been."""
    cache = report["detection_cache"]
    return [f"detections are not kept for later runs: {cache['problem']}"] if cache and cache["problem"] else []


def described(scenario: Scenario) -> list[str]:
    """Count what was found beside the agents; nothing of what was not found or not looked for."""
    features = scenario.map_features
    counts = [] if features is None else [(len(features.lanes), "lane"), (len(features.markings), "marking")]
    counts.append((len(scenario.signals), "traffic light"))
    return [counted(count, name) for count, name in counts if count]


def doubt_lines(scenario: Scenario, *, verbose: bool = False) -> list[str]:
    """Say how many agents are doubtful and why the first ones are, or all; no line without any."""
    from log2sim.datatypes import list_doubtful, why_doubtful
    from log2sim.datatypes.doubtful import MAX_LISTED

    ego, others = scenario.ego, [agent for agent in scenario.others if agent.is_doubtful]
    lines = [f"the ego: {why_doubtful(ego)}"] if ego is not None and ego.is_doubtful else []
    if not others:
        return lines
    named = list_doubtful(others, None if verbose else MAX_LISTED)
    gone = [agent for agent in others if agent.quarantined]
    quarantined = f"not in replays and exports: {', '.join(a.id for a in gone)} (quarantined)"
    return [
        *lines,
        f"{len(others)} of {counted(len(scenario.others), 'agent')}: {named}",
        *([quarantined] if gone else []),
    ]


def missing_lines(scenario: Scenario) -> list[str]:
    """Say what a scenario lacks and why: what was not looked for, by reason, and what of the road was not found."""
    left_out: dict[str, list[str]] = {}
    for stage in scenario.stages:
        if stage["stage"] in LOOKED_FOR and not stage["kept"]:
            left_out.setdefault(str(stage["reason"]), []).append(str(stage["stage"]))
    features = scenario.map_features
    notes = () if features is None else features.notes
    return [*(f"{', '.join(stages)}: {reason}" for reason, stages in left_out.items()), *notes]


def stage_lines(scenario: Scenario) -> list[str]:
    """Say of every stage whether it was run, and why."""
    return [f"{'with' if stage['kept'] else 'no'} {stage['stage']}: {stage['reason']}" for stage in scenario.stages]


def look_line(log: Path, sequence: str | None, out: Path) -> str:
    """Return the command that shows the scenario with the pictures and the ground of its log."""
    chosen = [] if sequence is None else ["--sequence", sequence]
    page = str(out.with_suffix(".html"))
    return shlex.join(["log2sim", "view", str(out), "--log", str(log), *chosen, "-o", page])


def pose_notes(poses: dict[str, Any]) -> list[str]:
    """Say which poses were used and why, and what is doubtful about them; nothing of the log's own where no others were asked for."""
    if poses["source"] == poses["requested"] == "given" or poses["source"] == "none":
        return []
    return [f"poses: {poses['source']} ({poses['reason']})", *(f"note: {note}" for note in poses["notes"])]


def fault_lines(faults: Sequence[dict[str, Any]]) -> list[str]:
    """Say what is wrong with the sensors and poses of a log, a line for each fault."""
    return [f"note: {fault['sensor']}: {fault['message']}" for fault in faults]


def unused_records(report: dict[str, Any]) -> list[str]:
    """List what a run could not use of a log, a line for each stream."""
    unreadable = report["unreadable"].items()
    without_pose = report["without_pose"].items()
    return [
        *(f"{name}: {u['count']} records could not be read, first: {u['first']}" for name, u in unreadable),
        *(
            f"{name}: {count} frames skipped, since no ego pose is known at their stamps"
            for name, count in without_pose
        ),
    ]
