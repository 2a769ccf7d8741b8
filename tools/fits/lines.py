"""Fit the weights of the evidence by which markings and borders of roads are judged, on maps of random roads.

    python tools/fit.py line_maps FOLDER --maps 320 --plain 80
    python tools/fit.py lines FOLDER ... > weights.py && mv weights.py log2sim/road/

Judges every line, row of bars, symbol and edge that is found in the maps, also the unlikely ones, by how much of it is true, and prints the
module. Tables go to stderr: each fifth of the maps is rated by weights that fit the others, beside those that are there.
"""

from __future__ import annotations

import json
import multiprocessing
import pickle
import sys
import textwrap
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from scipy.spatial import cKDTree
from shapely.geometry.base import BaseGeometry

from fits.confidence import fit_weights
from fits.line_maps import RoadMap
from log2sim.datatypes import Marking
from log2sim.evaluation.road import MIN_ARROW_OVERLAP
from log2sim.geometry import Array
from log2sim.road.borders import find_edges
from log2sim.road.markings import MIN_CONFIDENCE, MIN_LINE_M, find_paint, markings_of
from log2sim.road.paint import table_of, weighted_sum
from log2sim.road.paint_network import find_paint_maps
from log2sim.road.strokes import Curve
from log2sim.road.weights import WEIGHTS

FOLDS = 5
NEAR_M, STEP_M = 0.25, 0.1
MIN_EFFECT = 0.05  # of a standard deviation of the evidence, in log-odds: what has less is left out
MAX_WEIGHT = 8.0  # log-odds: what no simulated marking is like, a real one may be
# How many missed markings a false one is worth. Textures in pictures and rings of LiDARs on rough ground differ more than simulated ones do, so
# lines and borders that one sensor alone shows have to be as likely as two to one, lines of a LiDAR alone as four to one. An arrow that is
# missed is taken for a lane line, several meters long; of a dash that is taken for one little is lost.
COSTS = {
    "line, camera": 2.0, "line, LiDAR": 4.0, "line, few returns": 4.0, "border, camera": 2.0, "border, LiDAR": 2.0, "other": 0.25,
}  # fmt: skip
# What the evidence can say, at most, by what it means: for paint, against it.
SIGNS = {
    "length": 1, "dashes": 1, "contrast": 1, "reflects": 1, "outshone": -1, "varies": -1, "bright_beside": -1, "dull": -1, "unresolved": -1,
    "crowded": -1, "fainter": -1, "mid_lane": 0, "no_lane_line": -1, "wide": 0, "widens": 0, "clear": 1, "filled": 0, "slender": 0, "hidden": -1,
    "curb": 1,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Judged:
    """What may be a marking or a border: where, the table of its weights, its evidence, the share of it that is one, and its length, m."""

    road_map: str
    table: str
    evidence: dict[str, float]
    right: float
    length_m: float


def judged_of(path: Path) -> list[Judged]:
    """Find what may be markings and borders in a map, and judge it by the truth."""
    road: RoadMap = pickle.loads(path.read_bytes())
    areas, lines = find_paint(road.ground, find_paint_maps(road.ground))
    lanes = _Paint([m for m in road.true.markings if m.is_lane_line])
    stops, bars = (_Paint([m for m in road.true.markings if m.kind == kind]) for kind in ("stop_line", "crosswalk"))
    out = []
    for line in lines:
        paint = stops if line.kind == "stop_line" else lanes
        table = table_of(line.pieces, line.kind)
        out.append(Judged(path.name, table, line.evidence, paint.share(_dense(line.xy)), line.length_m))
    symbols = [_polygon(m.points_m[:, :2]) for m in road.true.markings if m.kind == "other"]
    for area in areas:
        right = bars.share(area.pieces.xy)
        if area.kind == "other":
            outline = _polygon(area.outline)
            shared = [outline.intersection(true).area / outline.union(true).area for true in symbols]
            right = float(max(shared, default=0.0) >= MIN_ARROW_OVERLAP)
        out.append(Judged(path.name, table_of(area.pieces, area.kind), area.evidence, right, 1.0))
    markings = markings_of(road.ground, areas, lines, MIN_CONFIDENCE, MIN_LINE_M)
    if any(m.is_lane_line for m in markings):
        borders = _Paint(road.true.borders)
        for edge in find_edges(road.ground, markings):
            length = float(Curve(edge.xy).s[-1])
            out.append(Judged(path.name, edge.table, edge.evidence, borders.share(_dense(edge.xy)), length))
    return out


def _polygon(outline: Array) -> BaseGeometry:
    return shapely.make_valid(shapely.Polygon(outline))


class _Paint:
    """Where some markings are."""

    def __init__(self, true: list[Marking]) -> None:
        outlines = [m for m in true if m.kind == "crosswalk"]
        self._inside = shapely.union_all([shapely.Polygon(m.points_m[:, :2]).buffer(NEAR_M) for m in outlines])
        along = [_dense(m.points_m[:, :2]) for m in true if m not in outlines]
        self._lines = cKDTree(np.concatenate(along)) if along else None

    def share(self, xy: Array) -> float:
        """Return the share of points (N, 2) on paint."""
        on = shapely.contains_xy(self._inside, *xy.T)
        if self._lines is not None:
            on |= self._lines.query(xy)[0] < NEAR_M
        return float(on.mean())


def _dense(xy: Array) -> Array:
    curve = Curve(xy)
    return curve.at(np.arange(0, curve.s[-1] + STEP_M / 2, STEP_M))


def fit_table(rows: list[Judged], cost: float = 1.0) -> dict[str, float]:
    """Fit the weights of one table; evidence without effect is left out, and the others are fitted again.

    `cost`: how many missed markings a false one is worth: even confidence is where both cost the same.
    """
    names = [name for name in SIGNS if any(row.evidence.get(name) for row in rows)]
    right = np.array([row.right for row in rows])
    weight = np.sqrt([row.length_m for row in rows])
    for _ in range(2):
        x = np.array([[row.evidence.get(name, 0.0) for name in names] for row in rows])
        bias, found = fit_weights(x, right, weight / weight.mean(), [SIGNS[name] for name in names])
        found = np.clip(found, -MAX_WEIGHT, MAX_WEIGHT)
        table = {"bias": bias - np.log(cost), **dict(zip(names, found.tolist()))}
        names = [n for n, effect in zip(names, np.abs(found) * x.std(axis=0)) if effect > MIN_EFFECT]
    return {name: float(f"{weight:.3g}") for name, weight in table.items()}


def say(table: str, rows: list[Judged], title: str, odds: Array) -> None:
    """Print log loss, and which share of the length that is kept is paint, and of the paint is kept."""
    right, length = np.array([row.right for row in rows]), np.array([row.length_m for row in rows])
    loss = np.average(np.logaddexp(0, odds) - right * odds, weights=np.sqrt(length))
    kept, paint = odds > 0, right * length
    shares = paint[kept].sum() / max(length[kept].sum(), 1e-9), paint[kept].sum() / max(paint.sum(), 1e-9)
    print(
        f"{table}, {title}: {len(rows)}, log loss {loss:.3f}, precision {shares[0]:.3f}, recall {shares[1]:.3f}",
        file=sys.stderr,
    )


def main(folders: list[Path], jobs: int = 2) -> None:
    """Fit, report and print."""
    paths = sorted(path for folder in folders for path in folder.glob("*.pkl"))
    if not paths:
        raise SystemExit(f"{', '.join(map(str, folders))}: no maps; `tools/fit.py line_maps` makes them")
    with multiprocessing.get_context("fork").Pool(jobs) as pool:
        judged = [row for rows in pool.imap(judged_of, paths) for row in rows]
    print(
        f'"""Weights of the evidence for markings and borders of roads, by kind and the sensors that saw it.\n\nPrinted by `tools/fit.py lines` on {len(paths)} maps of random roads and plain ground, `tools/fit.py line_maps`.\n"""\n'
    )
    print("WEIGHTS: dict[str, dict[str, float]] = {")
    for table in WEIGHTS:
        rows, cost = [row for row in judged if row.table == table], COSTS.get(table, 1.0)
        folds, odds = np.unique([row.road_map for row in rows], return_inverse=True)[1] % FOLDS, np.zeros(len(rows))
        for fold in range(FOLDS):
            weights = fit_table([row for row, k in zip(rows, folds) if k != fold], cost)
            odds[folds == fold] = [weighted_sum(row.evidence, weights) for row, k in zip(rows, folds) if k == fold]
        say(
            table,
            rows,
            "weights that are there",
            np.array([weighted_sum(row.evidence, WEIGHTS[table]) for row in rows]),
        )
        say(table, rows, "fitted to other maps", odds)
        text = f"{json.dumps(table)}: {json.dumps(fit_table(rows, cost))},"
        print(textwrap.fill(text, 140, initial_indent=4 * " ", subsequent_indent=8 * " "))
    print("}  # fmt: skip")
