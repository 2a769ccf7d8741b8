"""Markings and road borders found in a map of the ground, without a network."""

from __future__ import annotations

import numpy as np

from log2sim.datatypes import Marking, RoadBorder
from log2sim.lanes.detection.areas import PaintedArea, find_crosswalks, part_stop_lines, part_symbols
from log2sim.lanes.detection.borders import find_borders
from log2sim.lanes.detection.chains import dashed_chains, touching_chains
from log2sim.lanes.detection.curves import thin
from log2sim.lanes.detection.evidence import probability
from log2sim.lanes.detection.heights import at_height
from log2sim.lanes.detection.lines import PaintedLine, color_of, find_lines, sources_of
from log2sim.lanes.detection.pieces import find_pieces
from log2sim.lanes.detection.ridges import find_ridges
from log2sim.mapping.ground_map import GroundMap

MIN_CONFIDENCE = 0.5  # what is rather not there than there is left out
MIN_LINE_M = 2.0  # shorter plain strokes tell no lane


def find_markings(ground: GroundMap) -> tuple[tuple[Marking, ...], tuple[RoadBorder, ...], tuple[str, ...]]:
    """Find markings and road borders in a map of the ground.

    Parameters
    ----------
    ground : GroundMap
        Color, LiDAR intensity and height; each may be missing in part or altogether.

    Returns
    -------
    markings : tuple of Marking
        Sure ones first.
    borders : tuple of RoadBorder
    notes : tuple of str
        What was not found, and why.

    Notes
    -----
    Ridges of color and LiDAR intensity (`ridges`) become straight pieces with profiles (`pieces`), chains of pieces
    (`chains`) and smooth curves (`curves`). What lies along a curve tells solid from dashed lines (`strokes`), parallel
    bars are crosswalks, and wide strokes across lanes are stop lines (`areas`). Each is rated by both sensors
    (`evidence`). The cost grows with the area that was seen.
    """
    markings = list_markings(ground, min_confidence=MIN_CONFIDENCE, min_line_m=MIN_LINE_M)
    notes = _notes(ground, markings)
    if not np.any(ground.alpha) and not np.isfinite(ground.intensity).any():
        return (), (), notes
    borders, more = find_borders(ground, markings)
    return markings, borders, (*notes, *more)


def list_markings(
    ground: GroundMap, *, min_confidence: float, min_line_m: float, symbols: bool = True
) -> tuple[Marking, ...]:
    """List markings, sure ones first, from a confidence and, for plain strokes, a length on; `symbols` tells arrows apart."""
    pieces = find_pieces(ground, find_ridges(ground))
    areas, chains = find_crosswalks(ground, pieces, touching_chains(pieces))
    lines = find_lines(ground, pieces, dashed_chains(pieces, chains))
    stops, lines = part_stop_lines(lines)
    if symbols:
        small, lines = part_symbols(ground, lines)
        areas += small
    found = [_marking_of_area(ground, area) for area in areas]
    found += [_marking_of_line(ground, line, "stop_line") for line in stops]
    long = [line for line in lines if line.kind == "dashed" or line.length_m >= min_line_m]
    found += [_marking_of_line(ground, line, line.kind) for line in long]
    markings = sorted((m for m in found if m.confidence >= min_confidence), key=lambda m: -m.confidence)
    return tuple(_named(marking, f"marking-{k + 1}") for k, marking in enumerate(markings))


def _marking_of_line(ground: GroundMap, line: PaintedLine, kind: str) -> Marking:
    points = at_height(ground, thin(line.xy))
    return Marking("", kind, points, line.width_m, line.color, probability(line.log_odds), line.sources)


def _marking_of_area(ground: GroundMap, area: PaintedArea) -> Marking:
    points = at_height(ground, area.outline)
    shown_by = (color_of(area.pieces), probability(area.log_odds), sources_of(area.pieces))
    return Marking("", area.kind, points, area.width_m, *shown_by)


def _named(marking: Marking, name: str) -> Marking:
    return Marking(
        name, *(getattr(marking, k) for k in ("kind", "points_m", "width_m", "color", "confidence", "sources"))
    )


def _notes(ground: GroundMap, markings: tuple[Marking, ...]) -> tuple[str, ...]:
    notes = []
    by_camera, by_lidar = bool(np.any(ground.alpha)), bool(np.isfinite(ground.intensity).any())
    if not by_camera and not by_lidar:
        return ("no markings seen: no sensor saw the ground",)
    if not by_camera:
        notes.append("markings by LiDAR intensity only: no camera saw the ground; their colors are unknown")
    if not by_lidar:
        notes.append(
            "markings by cameras only: no LiDAR intensity of the ground; light streaks are harder to tell from paint"
        )
    if not markings:
        notes.append("no markings seen: no paint stands out from the ground")
    return tuple(notes)
