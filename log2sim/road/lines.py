"""Lines of paint: chains of pieces as smooth curves, parted into solid, dashed and stop lines."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import DisjointSet
from scipy.spatial import cKDTree

from log2sim.geometry import Array, median, runs_of, wrap_angle
from log2sim.road.curves import Curve, fit_curve
from log2sim.road.paint_network import LANE_LINES, LINES, PaintMaps
from log2sim.road.pieces import Pieces

TOUCH_M = 1.2  # worn paint, and points that end before the paint does
# The longest gaps of dashed lines are 12 m (Germany: 12 m at 6 m dashes; MUTCD: 30 ft = 9.1 m; UK: 7 m; Japan: 12 m).
MAX_GAP_M = 13.0
MAX_OVERLAP_M = 1.0
# Turns at junctions have radii of 6 m and more; over gaps of dashes, lanes have 30 m and more (RASt 06: 10 m at 20 km/h
# for the inner edge, but its lines are solid or short dashes).
MIN_RADIUS_M, MIN_RADIUS_OF_GAPS_M = 6.0, 25.0
POSITION_SIGMA_M = 0.05  # of the end of a piece across its direction
MAX_SIGMAS = 3.5
SHORT_END_M, MAX_END_TURN_RAD = 1.0, np.deg2rad(6)
BASE_M, LONG_BASE_M = 6.0, 15.0  # the direction of a chain's end is that of its last part


@dataclass(frozen=True, eq=False)
class Chain:
    """Pieces in their order along a line."""

    members: NDArray[np.int64]  # (K,): indices of pieces
    flipped: NDArray[np.bool_]  # (K,): whether a piece's own direction points backwards

    def corners(self, pieces: Pieces) -> Array:
        """List the ends of all pieces in order, (2 K, 2), m."""
        ends = pieces.ends(self.members)
        ends[self.flipped] = ends[self.flipped][:, ::-1]
        return ends.reshape(-1, 2)

    def reversed(self) -> Chain:
        """Return the chain from its other end."""
        return Chain(self.members[::-1], ~self.flipped[::-1])

    def __add__(self, other: Chain) -> Chain:
        """Return both, one after the other."""
        return Chain(np.concatenate([self.members, other.members]), np.concatenate([self.flipped, other.flipped]))


@dataclass(frozen=True, eq=False)
class _Ends:
    """Ends of chains: two each, first and last. Where it is, where it points to (outwards), and how sure."""

    xy: Array  # (2 C, 2)
    outward: Array  # (2 C,) rad
    outward_sigma: Array  # (2 C,) rad
    length_m: Array  # (2 C,)


def touching_chains(pieces: Pieces) -> list[Chain]:
    """Join pieces that touch or almost do."""
    single = [Chain(np.array([k]), np.array([False])) for k in range(len(pieces))]
    chains = []
    for chain in _join(pieces, single, TOUCH_M, MIN_RADIUS_M):
        # Short pieces at the ends that lie beside the line of the next piece are grain beyond the paint.
        first, last = 0, len(chain.members) - 1
        while last > first and _beside(pieces, chain.members[last], chain.members[last - 1]):
            last -= 1
        while last > first and _beside(pieces, chain.members[first], chain.members[first + 1]):
            first += 1
        chains.append(Chain(chain.members[first : last + 1], chain.flipped[first : last + 1]))
    return chains


def _beside(pieces: Pieces, end: int, inner: int) -> bool:
    if pieces.length_m[end] > min(SHORT_END_M, 0.7 * pieces.length_m[inner]):
        return False
    angle = pieces.direction[inner]
    offset = pieces.xy[end] - pieces.xy[inner]
    turn = abs((pieces.direction[end] - angle + np.pi / 2) % np.pi - np.pi / 2)
    across_m = abs(offset[1] * np.cos(angle) - offset[0] * np.sin(angle))
    return bool(across_m > 1.2 * POSITION_SIGMA_M or turn > MAX_END_TURN_RAD)


def dashed_chains(pieces: Pieces, chains: list[Chain]) -> list[Chain]:
    """Join chains across the gaps of dashed lines, short gaps first."""
    # Directions become surer the longer the chains, so the longest gaps are tried again.
    for gap_m in (4.0, MAX_GAP_M, MAX_GAP_M):
        chains = _join(pieces, chains, gap_m, MIN_RADIUS_OF_GAPS_M, LONG_BASE_M)
    return chains


def _join(
    pieces: Pieces, chains: list[Chain], max_gap_m: float, min_radius_m: float, base_m: float = BASE_M
) -> list[Chain]:
    """Join ends that continue each other best, each end with one other at most."""
    if len(chains) < 2:
        return chains
    ends = _ends_of(pieces, chains, base_m)
    first, second, cost = _candidates(ends, max_gap_m, min_radius_m)
    partner: dict[int, int] = {}
    joined = DisjointSet(range(len(chains)))
    for k in np.argsort(cost, kind="stable"):
        a, b = int(first[k]), int(second[k])
        # A ring stays open at one place, as a line has two ends.
        if a not in partner and b not in partner and joined.merge(a // 2, b // 2):
            partner[a], partner[b] = b, a
    # From every free end to the other one.
    done, out = set(), []
    for start in range(2 * len(chains)):
        if start // 2 in done or start in partner:
            continue
        end, whole = start, None
        while True:
            done.add(end // 2)
            chain = chains[end // 2] if end % 2 == 0 else chains[end // 2].reversed()
            whole = chain if whole is None else whole + chain
            far = end ^ 1
            if far not in partner:
                break
            end = partner[far]
        out.append(whole)
    return out


def _ends_of(pieces: Pieces, chains: list[Chain], base_m: float) -> _Ends:
    rows = []
    for chain in chains:
        corners = chain.corners(pieces)
        length = float(np.linalg.norm(corners[-1] - corners[0]))
        for ordered in (corners[::-1], corners):
            tip = ordered[-1]
            near = ordered[np.linalg.norm(ordered - tip, axis=1) <= base_m]
            angle, base = _direction(near if len(near) > 1 else ordered[-2:])
            rows.append([*tip, angle, POSITION_SIGMA_M * 2 / max(base, 0.3), length])
    t = np.array(rows)
    return _Ends(t[:, :2], t[:, 2], t[:, 3], t[:, 4])


def _direction(points: Array) -> tuple[float, float]:
    """Tangent at the last of some points, rad, and the length that they span; of an arc where there are enough."""
    base = float(np.linalg.norm(points[-1] - points[0]))
    chord = points[-1] - points[0]
    angle = float(np.arctan2(chord[1], chord[0]))
    if len(points) < 6 or base < 4.0:
        return angle, base
    c, s = np.cos(angle), np.sin(angle)
    local = points - points[-1]
    along, across = local[:, 0] * c + local[:, 1] * s, local[:, 1] * c - local[:, 0] * s
    slope = np.polyfit(along, across, 2)[1]
    return angle + float(np.arctan(slope)), base / 2


def _candidates(
    ends: _Ends, max_gap_m: float, min_radius_m: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """List pairs of ends that may continue each other, and what each costs."""
    pairs = cKDTree(ends.xy).query_pairs(max_gap_m + 0.5, output_type="ndarray")
    a, b = pairs[:, 0], pairs[:, 1]
    keep = a // 2 != b // 2
    a, b = a[keep], b[keep]
    out_a, in_b = ends.outward[a], ends.outward[b] + np.pi
    turn = wrap_angle(in_b - out_a)
    mean = out_a + turn / 2
    chord = ends.xy[b] - ends.xy[a]
    gap = chord[:, 0] * np.cos(mean) + chord[:, 1] * np.sin(mean)
    # An arc leaves and meets its chord at equal angles, so the chord has the mean of both directions.
    offset = np.abs(chord[:, 1] * np.cos(mean) - chord[:, 0] * np.sin(mean))
    span = np.maximum(gap, 0)
    sigma = np.sqrt(2 * POSITION_SIGMA_M**2 + (span**2 / 4) * (ends.outward_sigma[a] ** 2 + ends.outward_sigma[b] ** 2))
    turn_sigma = np.hypot(ends.outward_sigma[a], ends.outward_sigma[b])
    shorter = np.minimum(ends.length_m[a], ends.length_m[b])
    overlap = np.minimum(MAX_OVERLAP_M, shorter / 2)
    bend = span / min_radius_m + np.minimum(shorter, 2.0) / (2 * MIN_RADIUS_M)
    fits = (gap > -overlap) & (gap <= max_gap_m) & (offset <= np.minimum(MAX_SIGMAS * sigma, 0.15 + 0.05 * span))
    fits &= np.abs(turn) <= bend + 2 * turn_sigma
    fits &= np.abs(turn) < np.pi / 3
    # Across a long gap, both sides are dashes: something that is there.
    fits &= span <= 1.5 + 6 * shorter
    a, b = a[fits], b[fits]
    cost = np.abs(gap) / 2 + (offset / sigma) ** 2 + np.square(turn / (turn_sigma + bend))
    return a, b, cost[fits]


MIN_LINE_M = 1.0
# Contrast of yellowness: paint is 0.5 to 1.2 in daylight, gray and white are below 0.1.
MIN_YELLOW = 0.2
REPEAT_M = 0.18  # double lines are 0.2 m apart and more, from middle to middle
MIN_REFLECTED = 0.1  # logarithm: a tenth more than the road
STEP_M = 0.1
END_SHARE = 0.5  # a marking ends where its probability falls to half of what it usually is
SMOOTH_M = 0.5  # along which probabilities are averaged to find ends, and gaps are none: flakes are shorter
KIND_M = 10.0  # and to find kinds: a period of most dashed lines
# Roads that join are 5.5 m wide and lines end some meters before them; a worn dash or two leave less than that, or than three gaps.
JUNCTION_M, LONG_GAPS = 10.0, 3.0
MIN_BARE_M, MAX_BARE_M, MAX_BARE = 2.0, 6.0, 0.5  # of solid lines: where less is painted than bare, the line ends


@dataclass(frozen=True, eq=False)
class Paint:
    """What may be a marking or border."""

    kind: str  # of a marking or border
    xy: Array  # (P, 2), m: of a line its middle, from end to end; of others the outline
    width_m: float  # of an outline its lesser extent
    color: str | None  # None where no camera saw it
    sources: tuple[str, ...]  # the sensors that show a line, or saw most of what has an outline
    log_odds: float  # that it is a marking

    @property
    def length_m(self) -> float:
        """Length of a line from end to end."""
        return float(Curve(self.xy).s[-1])


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


def find_lines(maps: PaintMaps, pieces: Pieces, crosswalks: NDArray[np.bool_]) -> list[Paint]:
    """Make lines of pieces, also unlikely ones; they end at cells of `crosswalks` (R, C)."""
    out = []
    for chain in dashed_chains(pieces, touching_chains(pieces)):
        corners = chain.corners(pieces)
        if np.linalg.norm(np.diff(corners, axis=0), axis=1).sum() < MIN_LINE_M:
            continue
        own = pieces.take(chain.members)
        curve = fit_curve(corners)
        s = curve.s
        nearest = s[cKDTree(curve.xy).query(own.xy)[1]]
        painted = nearest[:, None] + own.length_m[:, None] * [-0.5, 0.5]
        for begin, end, kind in parts_of(maps, curve, painted, crosswalks):
            member = own.take((nearest > begin - 1.0) & (nearest < end + 1.0))
            if not len(member) or end - begin < MIN_LINE_M:
                continue
            xy = curve.at(np.concatenate([[begin], s[(s > begin + 0.1) & (s < end - 0.1)], [end]]))
            # Edges of bright ground are brighter than one side only: no sensor shows a line.
            if sources := sources_of(member):
                odds = maps.object_log_odds("lane_line" if kind in LANE_LINES else kind, member.along)
                out.append(Paint(kind, xy, median(member.width_m), color_of(member), sources, odds))
    return drop_repeats(out)


def parts_of(
    maps: PaintMaps, curve: Curve, painted: Array, crosswalks: NDArray[np.bool_]
) -> list[tuple[float, float, str]]:
    """Part a curve by the likeliest kind: begin and end, m, and kind of each part.

    `painted`: (K, 2): begin and end, m, of what stands out along it. `crosswalks`: (R, C): cells of crosswalks, where lines end.
    """
    length = float(curve.s[-1])
    s = np.arange(STEP_M / 2, max(length, STEP_M), STEP_M)
    xy = curve.at(s)
    each = np.stack([maps.at(layer, xy) for layer in maps.probability[: len(LINES)]])
    cell, inside = maps.raster.index_of(xy)
    observed, crossed = (inside & layer.ravel()[cell] for layer in (maps.seen, crosswalks))

    def size(length_m: float) -> tuple[int, int]:
        return 2 * round(length_m / STEP_M / 2) + 1, 1

    def mean(values: Array, within_m: float) -> Array:
        return np.asarray(cv2.blur(values, size(within_m), borderType=cv2.BORDER_CONSTANT), np.float64)

    line = mean(each.sum(axis=0, keepdims=True), SMOOTH_M)[0]
    # What has no gaps is not dashed.
    covered = (s >= painted[:, :1] - SMOOTH_M / 2) & (s <= painted[:, 1:] + SMOOTH_M / 2)
    bare: Array = np.asarray(~np.any(covered, axis=0), np.float64)
    each[LINES.index("dashed")] *= cv2.dilate(bare[None], np.ones(size(KIND_M)[::-1]))[0]
    usual = float(np.square(line).sum() / max(line.sum(), 1e-9))  # where there is paint: its mean, weighted by itself
    kind = np.where((line > END_SHARE * usual) & ~crossed, mean(each, KIND_M).argmax(axis=0), -1)
    runs = sorted((*run, LINES[k]) for k in range(len(LINES)) for run in runs_of(kind == k))
    gaps = [STEP_M * (b[0] - a[1]) for a, b in pairwise(runs) if a[2] == b[2] == "dashed"]
    longest_m = max(JUNCTION_M, LONG_GAPS * median(np.array(gaps))) if gaps else JUNCTION_M
    parts, painted_m = list[tuple[float, float, str]](), 0.0
    for first, last, of in runs:
        begin, end = float(s[first]) - STEP_M / 2, float(s[last - 1]) + STEP_M / 2
        before = parts[-1] if parts else (0.0, 0.0, "")
        between = (s > before[1]) & (s < begin)
        most_m = longest_m if of == "dashed" else max(MIN_BARE_M, min(MAX_BARE * painted_m, MAX_BARE_M))
        same = before[2] == of and not crossed[between].any()
        if same and (begin - before[1] <= most_m or np.mean(observed[between]) <= 0.5):
            parts[-1], painted_m = (before[0], end, of), painted_m + end - begin
        else:
            parts.append((begin, end, of))
            painted_m = end - begin
    return parts


def drop_repeats(lines: list[Paint]) -> list[Paint]:
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
