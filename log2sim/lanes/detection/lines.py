"""Lines of paint: chains of pieces as smooth curves, parted into solid and dashed ones, with what they look like."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from log2sim.geometry import Array
from log2sim.lanes.detection.chains import Chain
from log2sim.lanes.detection.curves import Curve, fit_curve
from log2sim.lanes.detection.evidence import log_odds_of_line
from log2sim.lanes.detection.layers import Mask
from log2sim.lanes.detection.profiles import Pieces
from log2sim.lanes.detection.strokes import Stretch, Trace, stretches_of, trace
from log2sim.mapping.ground_map import GroundMap

MIN_LINE_M = 1.0
# Contrast of yellowness: paint is 0.5 to 1.2 in daylight, gray and white are below 0.1.
MIN_YELLOW = 0.2
REPEAT_M = 0.18  # double lines are 0.2 m apart and more, from middle to middle
# Lanes are 2 m wide at least; of lines that run beside each other there are two. More are sun through a fence, or a wall.
BESIDE_M, MAX_BESIDE, CROWDED = (0.45, 1.7), 1, -5.0
BESIDE_PER_M = 4  # pairs of points 0.5 m apart, two for each: beside it along half of it or more
MAX_CROSSINGS, MAX_CROSSINGS_PER_M = 3, 0.2  # a grid of more lines is a wall or paving
# Paint of the same time is about as bright; a weaker line so near another is what is left of removed paint.
REMNANT_SHARE, REMNANT = 0.65, -6.0
MIN_REFLECTED = 0.1  # logarithm: a tenth more than the road
PARALLEL_RAD = np.deg2rad(15)


@dataclass(frozen=True, eq=False)
class PaintedLine:
    """A line of paint.

    Attributes
    ----------
    xy : (P, 2) float64, m
        Middle, from end to end.
    kind : str
        "solid" or "dashed".
    width_m : float
    pieces : Pieces
        What shows it.
    painted_m : float
        Length with paint.
    dashes : int
    log_odds : float
        That it is a marking.
    """

    xy: Array
    kind: str
    width_m: float
    pieces: Pieces
    painted_m: float
    dashes: int
    log_odds: float

    @property
    def length_m(self) -> float:
        """Length from end to end."""
        return float(np.linalg.norm(np.diff(self.xy, axis=0), axis=1).sum())

    @property
    def color(self) -> str | None:
        """White or yellow; None where no camera saw it."""
        return color_of(self.pieces)

    @property
    def sources(self) -> tuple[str, ...]:
        """Sensors that show it."""
        return sources_of(self.pieces)


def color_of(pieces: Pieces) -> str | None:
    """Tell white from yellow; None where no camera saw the pieces."""
    yellow = pieces.yellow[np.isfinite(pieces.yellow)]
    if not len(yellow):
        return None
    return "yellow" if float(np.median(yellow)) > MIN_YELLOW else "white"


def sources_of(pieces: Pieces) -> tuple[str, ...]:
    """Name the sensors in which pieces stand out."""
    camera = bool(np.mean(np.nan_to_num(pieces.color) > 2 * np.nan_to_num(pieces.color_sigma)) > 0.5)
    seen = np.isfinite(pieces.reflected)
    lidar = bool(np.count_nonzero(seen) > 1)
    if lidar:
        error = float(np.median(pieces.reflected_sigma[seen])) / float(np.sqrt(np.count_nonzero(seen)))
        lidar = float(np.median(pieces.reflected[seen])) > max(3 * error, MIN_REFLECTED)
    return tuple(name for name, shows in (("camera", camera), ("lidar", lidar)) if shows)


def find_lines(ground: GroundMap, pieces: Pieces, chains: list[Chain]) -> list[PaintedLine]:
    """Make lines of chains."""
    out: list[PaintedLine] = []
    for chain in chains:
        corners = chain.corners(pieces)
        if np.linalg.norm(np.diff(corners, axis=0), axis=1).sum() < MIN_LINE_M:
            continue
        own = pieces.take(chain.members)
        curve = fit_curve(corners)
        width = float(np.median(own.width_m))
        traced = trace(ground, curve, width)
        for stretch in stretches_of(traced.strokes()):
            line = _line_of(curve, own, stretch, traced)
            if line is not None:
                out.append(line)
    return _in_context(without_repeats(out))


def _line_of(curve: Curve, pieces: Pieces, stretch: Stretch, traced: Trace) -> PaintedLine | None:
    s = curve.s
    nearest = s[cKDTree(curve.xy).query(pieces.xy)[1]]
    member = (nearest > stretch.begin_m - 1.0) & (nearest < stretch.end_m + 1.0)
    end = min(stretch.end_m, float(s[-1]))
    if not member.any() or end - stretch.begin_m < MIN_LINE_M:
        return None
    inner = s[(s > stretch.begin_m + 0.1) & (s < end - 0.1)]
    xy = curve.at(np.concatenate([[stretch.begin_m], inner, [end]]))
    own = pieces.take(member)
    painted_m = traced.painted_m(stretch.begin_m, end)
    odds = log_odds_of_line(own, painted_m, dashes=stretch.dashes)
    return PaintedLine(xy, stretch.kind, float(np.median(own.width_m)), own, painted_m, stretch.dashes, odds)


def without_repeats(lines: list[PaintedLine]) -> list[PaintedLine]:
    """Leave out lines that lie on stronger ones."""
    order = sorted(lines, key=lambda one: (-one.log_odds, -one.length_m))
    dense = [_dense(line.xy) for line in order]
    if not dense:
        return []
    owner = np.repeat(np.arange(len(dense)), [len(points) for points in dense])
    tree = cKDTree(np.concatenate(dense))
    kept = np.zeros(len(dense), dtype=bool)
    for k, points in enumerate(dense):
        near = tree.query_ball_point(points, np.nextafter(REPEAT_M, 0), return_sorted=False)
        count = np.array([len(found) for found in near])
        # Which of the points of this line are near one of a stronger line that was kept.
        covered = np.bincount(
            np.repeat(np.arange(len(points)), count), kept[owner[np.concatenate(near).astype(np.intp)]]
        )
        kept[k] = np.mean(covered > 0) <= 0.5
    return [line for line, keep in zip(order, kept) if keep]


def _dense(xy: Array) -> Array:
    curve = Curve(xy)
    return curve.at(np.arange(0, curve.s[-1] + 0.05, 0.1))


def _in_context(lines: list[PaintedLine]) -> list[PaintedLine]:
    """Lower the log-odds of lines that form combs or grids, or run beside much brighter ones."""
    if len(lines) < 2:
        return lines
    dense = [_dense(line.xy)[::5] for line in lines]
    owner = np.repeat(np.arange(len(lines)), [len(d) for d in dense])
    points = np.concatenate(dense)
    heading = np.concatenate([_headings(d) for d in dense])
    pairs = cKDTree(points).query_pairs(BESIDE_M[1], output_type="ndarray")
    a, b = np.concatenate([pairs, pairs[:, ::-1]]).T
    a, b = a[owner[a] != owner[b]], b[owner[a] != owner[b]]
    turn = np.abs((heading[a] - heading[b] + np.pi / 2) % np.pi - np.pi / 2)
    offset = points[b] - points[a]
    distance = np.abs(offset[:, 1] * np.cos(heading[a]) - offset[:, 0] * np.sin(heading[a]))
    parallel = (turn < PARALLEL_RAD) & (distance > BESIDE_M[0])
    crossing = (turn > np.pi / 4) & (np.linalg.norm(offset, axis=1) < 0.5)
    length, odds = (np.array([getattr(line, name) for line in lines]) for name in ("length_m", "log_odds"))
    contrast = np.array([float(np.median(np.nan_to_num(line.pieces.color))) for line in lines])
    # Pairs of lines, not a table of all: a long log has thousands.
    i, j, count = _counted(owner[a[parallel]], owner[b[parallel]])
    beside = count > BESIDE_PER_M * length[i]
    i, j = i[beside], j[beside]
    crowded = np.bincount(i[_alike(lines, contrast, i, j)], minlength=len(lines)) > MAX_BESIDE
    added = np.where(crowded, CROWDED, 0.0)
    # Combs do not tell against what they cross, unless that is a comb, too.
    k, other, _ = _counted(owner[a[crossing]], owner[b[crossing]])
    told = _alike(lines, contrast, k, other) & (~crowded[other] | (np.bincount(i, minlength=len(lines)) > 0)[k])
    crossings = np.bincount(k[told], minlength=len(lines))
    added += np.where((crossings > MAX_CROSSINGS) & (crossings > MAX_CROSSINGS_PER_M * length), CROWDED, 0.0)
    brighter = odds[j] > odds[i] - 1
    brightest = np.full(len(lines), -np.inf)
    np.maximum.at(brightest, i[brighter], contrast[j[brighter]])
    added += np.where(np.isfinite(brightest) & (contrast < REMNANT_SHARE * brightest), REMNANT, 0.0)
    return [replace(line, log_odds=line.log_odds + more) for line, more in zip(lines, added.tolist())]


def _counted(first: NDArray[np.intp], second: NDArray[np.intp]) -> tuple[NDArray[np.intp], ...]:
    """Return each pair of numbers (P,), (P,) once, and how often (P,) it is there."""
    most = int(second.max(initial=0)) + 1
    pair, count = np.unique(first * most + second, return_counts=True)
    return pair // most, pair % most, count


def _alike(lines: list[PaintedLine], contrast: Array, one: NDArray[np.intp], other: NDArray[np.intp]) -> Mask:
    """Mask (P,) of pairs of lines that look alike, and the other as likely as the one: what combs and grids are made of."""
    width, odds = np.array([line.width_m for line in lines]), np.array([line.log_odds for line in lines])
    same = np.maximum(width[one], width[other]) <= 2 * np.minimum(width[one], width[other])
    same &= np.maximum(contrast[one], contrast[other]) <= 2 * np.minimum(contrast[one], contrast[other])
    return np.asarray(same & (odds[other] > odds[one] - 2))


def _headings(points: Array) -> Array:
    if len(points) < 2:
        return np.zeros(len(points))
    d = np.gradient(points, axis=0)
    return np.asarray(np.arctan2(d[:, 1], d[:, 0]) % np.pi)
