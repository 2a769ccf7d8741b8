"""Summary of a replay in a few lines of text."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from log2sim.datatypes import EGO
from log2sim.simulation.metrics.all_metrics import SCENARIO_FOLLOWERS
from log2sim.simulation.metrics.collisions import REPLAY
from log2sim.simulation.metrics.conflicts import most_critical
from log2sim.simulation.result import Replay
from log2sim.simulation.warnings.sentences import describe_warnings

MAX_LISTED = 5


def summarize(replay: Replay, *, limit: int | None = MAX_LISTED) -> str:
    """Summarize errors, conflicts and models in a line each, and list the first collisions, those of the replay first.

    Where a policy drives the ego, how it fared comes first, and the times are those of the ego. An error that no agent has is
    shown as a dash. Of each list the first `limit` are named, or all without one.
    """
    m = replay.metrics
    driven = any(a.driver == "policy" for a in replay.agents)
    near = [e for e in m["conflicts"] if e["ego"] or not driven]
    whose = " of the ego" if driven else ""
    lines = [
        *(_ego_lines(m) if "ego" in m else ()),
        _error_line(replay),
        f"{_collision_counts(m['collisions'])} · least time to collision{whose} {_critical_time(near, 'min_ttc')} · post-encroachment time {_critical_time(near, 'pet')}",
    ]
    lines += _model_lines(replay, limit)
    events = sorted(m["collisions"], key=lambda e: (e["belongs_to"] != REPLAY, e["t_s"]))
    lines += _first([f"  {_collision_line(e)}" for e in events], limit)
    lines += _left_out_lines(replay, limit)
    if replay.warnings is not None:
        lines.append(describe_warnings(replay.warnings))
    return "\n".join(lines)


def _first(lines: list[str], limit: int | None) -> list[str]:
    """Return the first lines, and one that counts the others."""
    rest = 0 if limit is None else len(lines) - limit
    return [*lines[:limit], f"  and {rest} more"] if rest > 0 else lines


def _ego_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Say how the ego fared: progress, smallest gap, hardest brake, collisions."""
    ego, events = metrics["ego"], [e for e in metrics["collisions"] if EGO in e["agents"]]
    gap, brake, path_m = ego["min_gap"], ego["max_brake"], ego["path_m"]
    share = f" ({ego['progress_m'] / path_m:.0%})" if path_m > 0 else ""
    hits = [f"{_other_of(e)} at {e['t_s']:.2f} s ({e['relative_speed_mps']:.1f} m/s)" for e in events]
    return [
        f"ego: progress {ego['progress_m']:.1f} of {path_m:.1f} m along its path{share}",
        "  smallest gap " + ("-" if gap is None else f"{gap['m']:.2f} m to {gap['agent']} at {gap['t_s']:.2f} s"),
        "  hardest brake " + ("-" if brake is None else f"{brake['mps2']:.1f} m/s2 at {brake['t_s']:.2f} s"),
        f"  collisions {'none' if not hits else 'with ' + ', '.join(hits)}",
    ]


def _other_of(event: Mapping[str, Any]) -> str:
    """Return the id of the agent that the ego collides with."""
    return str(next(id for id in event["agents"] if id != EGO))


def _collision_counts(events: Sequence[Mapping[str, Any]]) -> str:
    """Count collisions by whose they are: "3 collisions, 1 of the replay and 2 of the reconstruction itself"."""
    total, whose = _counted(len(events), "collision"), Counter(e["belongs_to"] for e in events)
    parts = [f"{whose[REPLAY]} of the replay", *(f"{n} of the {k} itself" for k, n in whose.items() if k != REPLAY)]
    return f"{total}, {' and '.join(parts)}" if events else total


def _error_line(replay: Replay) -> str:
    """Cross-track errors of agents on the path of the scenario, and the other errors of those that also keep its times."""
    m, drivers = replay.metrics, {a.driver for a in replay.agents}
    on_time = bool(drivers & {*SCENARIO_FOLLOWERS})
    across, along, speed = "-", "-", "-"
    if on_time or "reactive" in drivers:
        across = f"{m['cross_track_rms_m']:.3f} m rms, {m['cross_track_max_m']:.3f} m max"
    if on_time:
        along, speed = f"{m['along_track_rms_m']:.3f} m rms", f"{m['speed_rms_mps']:.3f} m/s rms"
    return f"cross-track {across} · along-track {along} · speed {speed}"


def _model_lines(replay: Replay, limit: int | None) -> list[str]:
    """Count the agents of each model, and give the reason for the first of those with the dynamic model by choice."""
    counts = Counter(a.model for a in replay.agents if a.model != "none")
    if not counts:
        return []
    chosen = [a for a in replay.agents if a.model == "dynamic" and replay.model == "auto"]
    found = _first([f"  {a.id} dynamic: {a.model_reason}" for a in chosen], limit)
    return ["models: " + ", ".join(f"{count} {model}" for model, count in counts.most_common()), *found]


def _left_out_lines(replay: Replay, limit: int | None) -> list[str]:
    """Say which agents of the scenario were left out, and why; the ego is none of them."""
    if not replay.left_out:
        return []
    count, named = len(replay.left_out), [f"{k} ({why})" for k, why in replay.left_out.items()]
    total = count + sum(agent.id != EGO for agent in replay.agents)
    rest = 0 if limit is None else count - limit
    more = f" and {rest} more" if rest > 0 else ""
    return [f"{count} of {total} agents left out: {', '.join(named[:limit])}{more}"]


def _collision_line(event: Mapping[str, Any]) -> str:
    known = "" if event["belongs_to"] == REPLAY else f", in the {event['belongs_to']} itself"
    return f"{' and '.join(event['agents'])} collide at {event['t_s']:.2f} s ({event['relative_speed_mps']:.1f} m/s){known}"


def _critical_time(near: Sequence[Mapping[str, Any]], key: str) -> str:
    found = most_critical(near, key)
    if found is None:
        return "-"
    return f"{found['s']:.2f} s ({' and '.join(found['agents'])} at {found['t_s']:.2f} s)"


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"
