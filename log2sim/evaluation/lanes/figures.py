"""All figures of map features, and their lines in the table of `evaluate`."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any

from log2sim.datatypes import MapFeatures, Scenario
from log2sim.evaluation.lanes.area import WITHIN_M, Area
from log2sim.evaluation.lanes.centers import lane_figures, path_figures
from log2sim.evaluation.lanes.lines import line_figures
from log2sim.evaluation.lanes.shapes import shape_figures


def map_figures(scenario: Scenario, truth: Scenario) -> dict[str, Any] | None:
    """Compare the map features of a scenario with those of its truth, wherever its map lies; None without either.

    Raises
    ------
    ScenarioError
        When a line is too long, or the truth says in a way that cannot be read which ground sensors saw.
    """
    if scenario.map_features is None or truth.map_features is None:
        return None
    moved = truth.aligned_to(scenario)
    ours, theirs = scenario.map_features, moved.map_features or MapFeatures()
    area = Area.of(scenario, moved, truth.shift_to(scenario))
    return {
        "within_m": WITHIN_M if area.near is not None else None,
        "where_seen": area.seen is not None,
        "lane_lines": line_figures(_lines(ours), _lines(theirs), area),
        "borders": line_figures(ours.borders, theirs.borders, area),
        **shape_figures(ours.markings, theirs.markings, area),
        "lanes": {**lane_figures(ours.lanes, theirs.lanes, area), **path_figures(ours.lanes, moved, area)},
    }


def _lines(features: MapFeatures) -> list[Any]:
    return [marking for marking in features.markings if marking.is_lane_line]


def road_verdict(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Say in a line each how well the road, colors and traffic lights are found; nothing where there are none."""
    out = []
    figures = result.get("map_features")
    if figures is not None:
        named = (("lane lines", figures["lane_lines"]), ("borders", figures["borders"]), ("lanes", figures["lanes"]))
        parts = [
            f"{name} {_percent(f['recall'])} found" + f", {_percent(f['precision'])} right" * bool(f["found_m"])
            for name, f in named
            if f["true_m"]
        ]
        shapes = [f"{_count(figures[key])} {name}" for key, name in _SHAPES if _any(figures[key])]
        out += [("road", "; ".join([*parts, *shapes]))] if parts or shapes else []
    colors, signals = result.get("colors"), result.get("signals")
    if colors is not None and colors["vehicles"]:
        out.append(
            (
                "colors",
                f"{colors['right']} of {colors['named']} right, {colors['with_color']} of {colors['vehicles']} vehicles have one",
            )
        )
    if signals is not None:
        right = f", state right {_percent(signals['state_right'])} of the time" if signals["found"] else ""
        out.append(("signals", f"{signals['found']} of {signals['true']} found, {signals['false']} false{right}"))
    return out


def map_lines(result: Mapping[str, Any]) -> list[str]:
    """Format the figures of map features, colors and traffic lights in detail; nothing where there are none."""
    lines = list[str]()
    for line in _detailed_lines(result):
        lines += textwrap.wrap(line, 100, subsequent_indent=" " * 12)
    return ["", *lines] if lines else []


def _detailed_lines(result: Mapping[str, Any]) -> list[str]:
    out = []
    figures = result.get("map_features")
    if figures is not None:
        out.append(f"lane lines: {_line_text(figures['lane_lines'])}")
        kinds = figures["lane_lines"]["kind_accuracy"]
        if kinds is not None:
            out[-1] += f", kind right {_percent(kinds)}"
        out.append(f"borders:    {_line_text(figures['borders'])}")
        counted = [f"{_count(figures[key])} {name}" for key, name in _SHAPES if _any(figures[key])]
        if counted:
            out.append(f"markings:   {', '.join(counted)}")
        lanes = figures["lanes"]
        out.append(
            f"lanes:      precision {_figure(lanes['precision'])}, recall {_figure(lanes['recall'])}, center off by "
            f"{_meters(lanes['center_median_m'])} (median), {_percent(lanes['inside'])} of true paths inside"
        )
    colors = result.get("colors")
    if colors is not None:
        out.append(
            f"colors:     {colors['right']} of {colors['named']} names right, {colors['with_color']} of "
            f"{colors['vehicles']} vehicles have one, CIEDE2000 {_figure(colors['ciede2000_median'], 1)} (median)"
        )
    signals = result.get("signals")
    if signals is not None:
        out.append(
            f"signals:    {signals['found']} of {signals['true']} found, {signals['false']} false, off by "
            f"{_meters(signals['position_median_m'])} (median), state right {_percent(signals['state_right'])} of the time"
        )
    return out


_SHAPES = (("stop_lines", "stop lines"), ("crosswalks", "crosswalks"), ("others", "other markings"))


def _any(counts: Mapping[str, int]) -> bool:
    return bool(counts["true"] or counts["false"])


def _count(counts: Mapping[str, int]) -> str:
    false = f" (+{counts['false']} false)" if counts["false"] else ""
    return f"{counts['found']} of {counts['true']}{false}"


def _line_text(figures: Mapping[str, Any]) -> str:
    return (
        f"precision {_figure(figures['precision'])}, recall {_figure(figures['recall'])} "
        f"({_figure(figures['recall_20_m'])} within 20 m), off by {_meters(figures['lateral_median_m'])} (median) {_meters(figures['lateral_p95_m'])} (p95), "
        f"{_figure(figures['false_m_per_100_m'], 1)} m false per 100 m"
    )


def _figure(value: float | None, digits: int = 2) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _meters(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f} m"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f} %"
