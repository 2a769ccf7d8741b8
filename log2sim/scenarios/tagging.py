"""All tags of a scenario, and its measures of criticality over time."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np

from log2sim.datatypes import Scenario, Tag
from log2sim.files.documents import replaced
from log2sim.geometry import Array
from log2sim.scenarios import criticality as c
from log2sim.scenarios.interactions import lane_measures, pair_tags
from log2sim.scenarios.maneuvers import single_tags
from log2sim.scenarios.traffic import Traffic, rate

MIN_PROBABILITY = 0.1
"""Less probable tags are left out."""


def find_tags(scenario: Scenario) -> tuple[Tag, ...]:
    """Find what the road users of a scenario do, in the order of time.

    Agents that are quarantined are left out. Cost: for each vehicle that moves, the agents within 100 m at each tick of 0.1 s.
    """
    traffic = Traffic(scenario.active)
    if not traffic.ids:
        return ()
    found = [tag for tag in (*single_tags(traffic), *pair_tags(traffic)) if tag.probability >= MIN_PROBABILITY]
    return tuple(sorted(found, key=lambda g: (g.start_s, g.tag, g.agent, g.other or "")))


def tag(scenario: Scenario) -> Scenario:
    """Return a scenario with its tags, in place of those that it had."""
    return replace(scenario, tags=find_tags(scenario))


def criticality_table(scenario: Scenario) -> dict[str, Array]:
    """Measure how critical it is for each vehicle and the one ahead of it in its lane, at each tick of 0.1 s.

    Returns `agent`, `other`, `t_s` and measures of `log2sim.scenarios.criticality`, in SI units; what has no value is infinite.
    """
    traffic = Traffic(scenario.active)
    ids = np.array(traffic.ids, dtype=object)
    names = ("agent", "other", "t_s", "gap_m", "relative_speed_mps", "ttc_s", "time_headway_s", "drac_mps2",
             "mdrac_mps2", "braking_required_mps2", "btn", "stn")  # fmt: skip
    parts = []
    for r in range(len(ids)):
        b = traffic.beside(r)
        if b is None:
            continue
        n = np.flatnonzero(b.leader >= 0)
        o = b.leader[n]
        usual = lane_measures(traffic, b, r, o, n)
        gap, closing = usual["gap_m"], -usual["relative_speed_mps"]
        accel = traffic.accel_mps2[o, n] * np.cos(b.turn_rad[o, n])
        width = (traffic.table.size_m[r, 1] + traffic.table.size_m[o, 1]) / 2
        parts.append((
            np.full(len(n), ids[r], dtype=object), ids[o], traffic.table.t_s[n], *usual.values(), c.modified_deceleration(gap, closing),
            c.braking_required(gap, closing, accel), c.brake_threat_number(gap, closing, accel),
            c.steer_threat_number(usual["ttc_s"], b.aside_m[o, n], rate(b.aside_m)[o, n], width),
        ))  # fmt: skip
    return {name: np.concatenate([p[k] for p in parts]) if parts else np.zeros(0) for k, name in enumerate(names)}


def write_criticality(path: Path, table: dict[str, Array]) -> None:
    """Write the measures as CSV; infinite ones are empty."""
    with replaced(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(table)
        for row in zip(*table.values()):
            numbers = (f"{v:.6g}" if np.isfinite(v) else "" for v in row[2:])
            writer.writerow([*row[:2], *numbers])
