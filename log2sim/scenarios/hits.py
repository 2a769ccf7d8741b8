"""The page of what `log2sim find` found: a picture from above and the figures of each hit."""

from __future__ import annotations

import base64
import hashlib
import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from log2sim.datatypes import TAGS, Scenario
from log2sim.errors import LogError
from log2sim.files.documents import replaced
from log2sim.geometry import Array, box_corners_bev
from log2sim.scenarios.index import NUMBERS, ROLES, TEXTS, Index, Row

MAX_PICTURES = 200
WINDOW_M = (90.0, 45.0)  # that a picture shows, along and across the heading of the agent that counts
TRAIL_S = 3.0

PAGE_STYLE = """
:root { --paper: #FFFFFF; --ink: #1B2330; --muted: #667080; --grid: #E4E8ED; color-scheme: light dark; }
@media (prefers-color-scheme: dark) { :root { --paper: #171C24; --ink: #E9EDF3; --muted: #97A2B2; --grid: #2A323D; } }
body { padding: 16px 20px 40px; background: var(--paper); color: var(--ink); font: 13px/1.45 "DejaVu Sans", Verdana, system-ui, sans-serif; }
h1 { font-size: 17px; }
"""

STYLE = """
* { box-sizing: border-box; margin: 0; } code { overflow-wrap: anywhere; } p, small { color: var(--muted); }
main { display: grid; grid-template-columns: repeat(auto-fill, minmax(300px, 1fr)); gap: 16px; margin-top: 16px; }
article { border: 1px solid var(--grid); border-radius: 8px; padding: 10px; overflow-wrap: anywhere; }
svg { width: 100%; background: var(--grid); border-radius: 4px; display: block; margin-bottom: 6px; }
svg polyline { fill: none; stroke: var(--muted); stroke-width: .25; stroke-opacity: .6; }
svg polygon { fill: var(--muted); fill-opacity: .55; }
svg .agent { fill: #C62828; fill-opacity: 1; stroke: #C62828; } svg .other { fill: #1565C0; fill-opacity: 1; stroke: #1565C0; }
svg polyline.agent, svg polyline.other { fill: none; stroke-width: .5; stroke-opacity: .9; }
"""


def write_hits(path: Path, index: Index, condition: str, rows: Sequence[Row]) -> None:
    """Write a page of hits; the first `MAX_PICTURES` have pictures."""
    loaded: dict[str, Scenario | None] = {}
    cards = []
    for k, row in enumerate(rows[:MAX_PICTURES]):
        if row["file"] not in loaded:
            try:
                loaded = {row["file"]: Scenario.load(index.folder / row["file"])}  # one at a time is held
            except LogError:
                loaded = {row["file"]: None}
        scenario = loaded[row["file"]]
        picture = thumbnail(scenario, row) if scenario is not None else ""
        cards.append(
            f"<article>{picture}<b>{k + 1}. {html.escape(say_hit(row))}</b><br><small>{html.escape(row['file'])}</small><br>{html.escape(say_quantities(row))}</article>"
        )
    more = f" The first {MAX_PICTURES} are shown." if len(rows) > MAX_PICTURES else ""
    about = f"<code>{html.escape(condition)}</code>.{more} Red: the agent; blue: the other; lines: {TRAIL_S:g} s before and after."
    head = f"<h1>{len(rows)} found in {index.scenarios} scenarios</h1><p>{about}</p>"
    with replaced(path) as temporary:
        temporary.write_text(page(condition, STYLE, f"{head}<main>{''.join(cards)}</main>"), encoding="utf-8")


def page(title: str, style: str, body: str) -> str:
    """Return a page that runs nothing and loads nothing, in the colors of all pages."""
    style = PAGE_STYLE + style
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    policy = f"default-src 'none'; style-src 'sha256-{digest}'; base-uri 'none'; form-action 'none'"
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{policy}">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><title>{html.escape(title)}</title>'
        f"<style>{style}</style></head><body>{body}</body></html>\n"
    )


def say_hit(row: Row) -> str:
    """Say a hit in a sentence, such as "cut_in of car-3, ego at 4.2 s: changes into the lane of the other, ahead of it"."""
    other = f", {row['other']}" if row.get("other") else ""
    return f"{row['tag']} of {row['agent']}{other} at {row['t_s']:.1f} s: {TAGS.get(row['tag'], '')}"


def say_quantities(row: Row) -> str:
    """List the quantities of a hit."""
    own = [k for k in row if k not in (*TEXTS, *NUMBERS) and "." not in k]
    speeds = [f"{role}.speed_mps" for role in ROLES if f"{role}.speed_mps" in row]
    return ", ".join(f"{k} {row[k]:.3g}" for k in ("probability", *own, *speeds))


def thumbnail(scenario: Scenario, row: Row) -> str:
    """Draw the moment of a hit from above as SVG, the agent that counts heading to the right."""
    t_s = row["t_s"]
    states = {a.id: (a, a.at([t_s], margin_s=np.inf if a.is_permanent else 0.1)) for a in scenario.agents}
    shown = [states[id] for id in (row["agent"], row.get("other")) if id in states and states[id][1].valid[0]]
    if not shown:
        return ""
    center = np.mean([[s.x_m[0], s.y_m[0]] for _, s in shown], axis=0)
    turn = float(shown[-1][1].yaw_rad[0])
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])

    def points(xy_m: Array) -> str:
        local = (xy_m[:, :2] - center) @ rotation.T
        return " ".join(f"{x:.2f},{-y:.2f}" for x, y in local)

    def near(xy_m: Array) -> bool:
        return bool(np.abs(xy_m[:, :2] - center).max(axis=1).min() < sum(WINDOW_M))

    features = scenario.map_features
    drawn: tuple[Any, ...] = (*features.markings, *features.borders, *features.lanes) if features is not None else ()
    lines = [f'<polyline points="{points(item.points_m)}"/>' for item in drawn if near(item.points_m)]
    roles = {row["agent"]: "agent", row.get("other"): "other"}
    for agent, now in states.values():
        role = roles.get(agent.id)
        mark = f' class="{role}"' if role else ""
        if role:
            w = agent.waypoints
            part = np.abs(w.t_s - t_s) <= TRAIL_S
            if part.sum() > 1:
                lines.append(f'<polyline{mark} points="{points(np.column_stack([w.x_m[part], w.y_m[part]]))}"/>')
        if now.valid[0]:
            corners = box_corners_bev([[now.x_m[0], now.y_m[0]]], agent.size_m[0], agent.size_m[1], now.yaw_rad[0])[0]
            if near(corners):
                lines.append(f'<polygon{mark} points="{points(corners)}"/>')
    width, height = WINDOW_M
    return f'<svg viewBox="{-width / 2} {-height / 2} {width} {height}" role="img">{"".join(lines)}</svg>'
