"""Lines of paint: chains of pieces as smooth curves, parted into solid and dashed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import DisjointSet
from scipy.spatial import cKDTree

from log2sim.geometry import Array, median, wrap_angle
from log2sim.road.ground_map import GroundMap
from log2sim.road.paint import (
    Pieces,
    evidence_of_line,
    log_probabilities_of_shares,
    median_known,
    surer_log_odds,
)
from log2sim.road.paint_network import PaintMaps
from log2sim.road.ridges import Mask
from log2sim.road.strokes import Curve, Stretch, fit_curve, stretches_of, trace

TOUCH_M = 1.2  # worn paint, and ridges that end before the paint does
# The longest gaps of dashed lines are 12 m (Germany: 12 m at 6 m dashes; MUTCD: 30 ft = 9.1 m; UK: 7 m; Japan: 12 m).
MAX_GAP_M = 13.0
MAX_OVERLAP_M = 1.0
# Turns at junctions have radii of 6 m and more; over gaps of dashes, lanes have 30 m and more (RASt 06: 10 m at 20 km/h
# for the inner edge, but its lines are solid or short dashes).
MIN_RADIUS_M, MIN_RADIUS_OF_GAPS_M = 6.0, 25.0
POSITION_SIGMA_M = 0.05  # of the end of a piece across its direction
MAX_SIGMAS = 3.5
MAX_WIDTH_RATIO, MAX_CONTRAST_RATIO = 2.2, 3.5
SHORT_END_M, MAX_END_TURN_RAD = 1.0, np.deg2rad(6)
BASE_M, LONG_BASE_M = 6.0, 15.0  # the direction of a chain's end is that of its last part


@dataclass(frozen=True, eq=False)
class Chain:
    """Pieces in their order along a line."""

    members: NDArray[np.int64]  # (K,): indices of pieces
    flipped: NDArray[np.bool_]  # (K,): whether a piece's own direction points backwards

    def corners(self, pieces: Pieces) -> Array:
        """List the ends of all pieces in order, (2 K, 2), m."""
        ends = pieces.ends[self.members]
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
    """Ends of chains: two each, first and last. Where it is, where it points to (outwards), how sure, and its paint."""

    xy: Array  # (2 C, 2)
    outward: Array  # (2 C,) rad
    outward_sigma: Array  # (2 C,) rad
    width_m: Array  # (2 C,)
    contrast: Array  # (2 C,)
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
    known = dict[Chain, list[list[float]]]()
    for gap_m in (4.0, MAX_GAP_M, MAX_GAP_M):
        chains = _join(pieces, chains, gap_m, MIN_RADIUS_OF_GAPS_M, LONG_BASE_M, known)
    return chains


def _join(
    pieces: Pieces,
    chains: list[Chain],
    max_gap_m: float,
    min_radius_m: float,
    base_m: float = BASE_M,
    known: dict[Chain, list[list[float]]] | None = None,
) -> list[Chain]:
    """Join ends that continue each other best, each end with one other at most; `known` keeps the ends of chains that stay."""
    if len(chains) < 2:
        return chains
    ends = _ends_of(pieces, chains, base_m, {} if known is None else known)
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


def _ends_of(pieces: Pieces, chains: list[Chain], base_m: float, known: dict[Chain, list[list[float]]]) -> _Ends:
    contrasts = np.where(np.isfinite(pieces.color), pieces.color, np.nan_to_num(pieces.reflected))
    if all(len(chain.members) == 1 for chain in chains):
        return _ends_of_single(pieces, chains, contrasts)
    for chain in chains:
        if chain in known:
            continue
        corners, rows = chain.corners(pieces), list[list[float]]()
        length = float(np.linalg.norm(corners[-1] - corners[0]))
        width, contrast = median(pieces.width_m[chain.members]), median(contrasts[chain.members])
        for ordered in (corners[::-1], corners):
            tip = ordered[-1]
            near = ordered[np.linalg.norm(ordered - tip, axis=1) <= base_m]
            angle, base = _direction(near if len(near) > 1 else ordered[-2:])
            sigma = POSITION_SIGMA_M * 2 / max(base, 0.3)
            rows.append([*tip, angle, sigma, width, contrast, length])
        known[chain] = rows
    t = np.array([row for chain in chains for row in known[chain]])
    return _Ends(t[:, :2], t[:, 2], t[:, 3], t[:, 4], t[:, 5], t[:, 6])


def _ends_of_single(pieces: Pieces, chains: list[Chain], contrasts: Array) -> _Ends:
    """Return the ends of chains of one piece each, all at once."""
    member = np.array([chain.members[0] for chain in chains], dtype=np.int64)
    flipped = np.array([chain.flipped[0] for chain in chains], dtype=bool)
    ends = pieces.ends[member]
    ends[flipped] = ends[flipped][:, ::-1]
    chord = ends[:, 1] - ends[:, 0]
    length = np.hypot(chord[:, 0], chord[:, 1])
    # First the end at which the piece begins, from which it points backwards.
    outward = np.stack([np.arctan2(-chord[:, 1], -chord[:, 0]), np.arctan2(chord[:, 1], chord[:, 0])], axis=1)
    sigma = POSITION_SIGMA_M * 2 / np.maximum(length, 0.3)
    both = (np.repeat(values, 2) for values in (sigma, pieces.width_m[member], contrasts[member], length))
    return _Ends(ends.reshape(-1, 2), outward.ravel(), *both)


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
    fits &= _alike_chains(ends.width_m, a, b, MAX_WIDTH_RATIO) & _alike_chains(ends.contrast, a, b, MAX_CONTRAST_RATIO)
    # Across a long gap, both sides are dashes: something that is there.
    fits &= span <= 1.5 + 6 * shorter
    a, b = a[fits], b[fits]
    cost = np.abs(gap) / 2 + (offset / sigma) ** 2 + np.square(turn / (turn_sigma + bend))
    return a, b, cost[fits]


def _alike_chains(values: Array, a: NDArray[np.int64], b: NDArray[np.int64], ratio: float) -> NDArray[np.bool_]:
    return np.asarray(np.maximum(values[a], values[b]) <= ratio * np.minimum(values[a], values[b]))


MIN_LINE_M = 1.0
# Contrast of yellowness: paint is 0.5 to 1.2 in daylight, gray and white are below 0.1.
MIN_YELLOW = 0.2
REPEAT_M = 0.18  # double lines are 0.2 m apart and more, from middle to middle
# Lanes are 2 m wide at least; of lines that run beside each other there are two. More are sun through a fence, or a wall.
BESIDE_M, MAX_BESIDE = (0.45, 1.7), 1
BESIDE_PER_M = 4  # pairs of points 0.5 m apart, two for each: beside it along half of it or more
# Half of a lane 2.5 to 4.4 m wide: no lane line has neighbors so near on both sides, arrows have.
HALF_LANE_M = (1.25, 2.2)
MAX_CROSSINGS, MAX_CROSSINGS_PER_M = 3, 0.2  # a grid of more lines is a wall or paving
MAX_LOG_RATIO = np.log(2)  # of widths and contrasts of lines that look alike
MIN_REFLECTED = 0.1  # logarithm: a tenth more than the road
PARALLEL_RAD = np.deg2rad(15)


@dataclass(frozen=True, eq=False)
class PaintedLine:
    """A line of paint."""

    xy: Array  # (P, 2), m: middle, from end to end
    kind: str  # "solid", "dashed" or "stop_line"
    width_m: float
    pieces: Pieces  # what shows it
    dashes: int
    evidence: dict[str, float]  # that it is a marking, see `evidence_of_line`
    network: float  # log-odds that it is one, by the network

    @cached_property
    def log_odds(self) -> float:
        """Log-odds that it is a marking."""
        return surer_log_odds(self.pieces, self.kind, self.evidence, self.network)

    @property
    def length_m(self) -> float:
        """Length from end to end."""
        return float(np.linalg.norm(np.diff(self.xy, axis=0), axis=1).sum())


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


def find_lines(
    ground: GroundMap, maps: PaintMaps, pieces: Pieces, chains: list[Chain]
) -> tuple[list[PaintedLine], Array]:
    """Make lines of chains; also estimate the shares that paint returns, see `log_probabilities_of_shares`."""
    parts: list[tuple[Array, Stretch, Pieces, float]] = []  # with the length that is painted, m
    for chain in chains:
        corners = chain.corners(pieces)
        if np.linalg.norm(np.diff(corners, axis=0), axis=1).sum() < MIN_LINE_M:
            continue
        own = pieces.take(chain.members)
        curve = fit_curve(corners)
        traced, s = trace(ground, maps, curve, median(own.width_m)), curve.s
        nearest = s[cKDTree(curve.xy).query(own.xy)[1]]
        for stretch in stretches_of(traced.strokes()):
            begin, end = stretch.begin_m, min(stretch.end_m, float(s[-1]))
            member = own.take((nearest > begin - 1.0) & (nearest < stretch.end_m + 1.0))
            if not len(member) or end - begin < MIN_LINE_M:
                continue
            xy = curve.at(np.concatenate([[begin], s[(s > begin + 0.1) & (s < end - 0.1)], [end]]))
            parts.append((xy, stretch, member, traced.painted_m(begin, end)))
    shares = log_probabilities_of_shares((member, painted_m, stretch.dashes) for _, stretch, member, painted_m in parts)
    out = []
    for xy, stretch, member, painted_m in parts:
        evidence = evidence_of_line(member, painted_m, dashes=stretch.dashes, shares=shares)
        odds = maps.object_log_odds(stretch.kind, member.along)
        out.append(PaintedLine(xy, stretch.kind, median(member.width_m), member, stretch.dashes, evidence, odds))
    return _in_context(drop_repeats(out)), shares


def drop_repeats(lines: list[PaintedLine]) -> list[PaintedLine]:
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
    """Add to the evidence which lines form combs or grids, how much fainter they are than their neighbors, and which are in mid-lane."""
    if len(lines) < 2:
        return lines
    dense = [_dense(line.xy)[::5] for line in lines]
    owner = np.repeat(np.arange(len(lines)), [len(d) for d in dense])
    points = np.concatenate(dense)
    steps = [np.gradient(d, axis=0) if len(d) > 1 else np.tile([1.0, 0.0], (len(d), 1)) for d in dense]
    dx, dy = np.concatenate(steps).T
    heading = np.arctan2(dy, dx) % np.pi
    pairs = cKDTree(points).query_pairs(HALF_LANE_M[1], output_type="ndarray")
    a, b = np.concatenate([pairs, pairs[:, ::-1]]).T
    a, b = a[owner[a] != owner[b]], b[owner[a] != owner[b]]
    turn = np.abs((heading[a] - heading[b] + np.pi / 2) % np.pi - np.pi / 2)
    offset = points[b] - points[a]
    left = offset[:, 1] * np.cos(heading[a]) - offset[:, 0] * np.sin(heading[a])
    distance = np.linalg.norm(offset, axis=1)
    parallel = (turn < PARALLEL_RAD) & (np.abs(left) > BESIDE_M[0]) & (distance <= BESIDE_M[1])
    crossing = (turn > np.pi / 4) & (distance < 0.5)
    length, odds = (np.array([getattr(line, name) for line in lines]) for name in ("length_m", "log_odds"))
    half_lane = (turn < PARALLEL_RAD) & (np.abs(left) > HALF_LANE_M[0]) & (odds[owner[b]] > 0)
    sides = np.zeros((len(points), 2))
    sides[a[half_lane], (left[half_lane] > 0).astype(int)] = 1
    mid_lane = np.bincount(owner, sides.all(axis=1)) / np.bincount(owner)
    # Pairs of lines, not a table of all: a long log has thousands.
    i, j, count = _counted(owner[a[parallel]], owner[b[parallel]])
    beside = count > BESIDE_PER_M * length[i]
    i, j = i[beside], j[beside]
    crowded = np.bincount(i[_alike(lines, odds, i, j)], minlength=len(lines)) > MAX_BESIDE
    # Combs do not tell against what they cross, unless that is a comb, too.
    k, other, _ = _counted(owner[a[crossing]], owner[b[crossing]])
    told = _alike(lines, odds, k, other) & (~crowded[other] | (np.bincount(i, minlength=len(lines)) > 0)[k])
    crossings = np.bincount(k[told], minlength=len(lines))
    grid = (crossings > MAX_CROSSINGS) & (crossings > MAX_CROSSINGS_PER_M * length)
    # Paint of the same time is about as bright; a fainter line next to another is what is left of removed paint.
    fainter, likely = np.zeros(len(lines)), odds[j] > odds[i] - 1
    np.maximum.at(fainter, i[likely], _brighter(lines, i[likely], j[likely]))
    names, combs = ("crowded", "fainter", "mid_lane"), crowded + grid.astype(float)
    context = zip(combs.tolist(), fainter.tolist(), mid_lane.tolist())
    return [replace(line, evidence=line.evidence | dict(zip(names, own))) for line, own in zip(lines, context)]


def _counted(first: NDArray[np.intp], second: NDArray[np.intp]) -> tuple[NDArray[np.intp], ...]:
    """Return each pair of numbers (P,), (P,) once, and how often (P,) it is there."""
    most = int(second.max(initial=0)) + 1
    pair, count = np.unique(first * most + second, return_counts=True)
    return pair // most, pair % most, count


def _alike(lines: list[PaintedLine], odds: Array, one: NDArray[np.intp], other: NDArray[np.intp]) -> Mask:
    """Mask (P,) of pairs of lines that look alike, and the other as likely as the one: what combs and grids are made of."""
    width = np.array([line.width_m for line in lines])
    same = np.abs(np.log(width[one] / width[other])) <= MAX_LOG_RATIO
    same &= np.abs(_brighter(lines, one, other)) <= MAX_LOG_RATIO
    return np.asarray(same & (odds[other] > odds[one] - 2))


def _brighter(lines: list[PaintedLine], one: NDArray[np.intp], other: NDArray[np.intp]) -> Array:
    """Logarithm (P,) of the ratio of the contrasts of other lines to those of some.

    Of color where a camera saw both, else of LiDAR intensity; 0 where neither sensor saw both.
    """
    ratio = np.zeros(len(one))
    for name in ("reflected", "color"):
        contrast = np.array([median_known(getattr(line.pieces, name)) for line in lines])
        found = np.log(np.maximum(contrast[other], 1e-3) / np.maximum(contrast[one], 1e-3))
        ratio = np.where(np.isfinite(found), found, ratio)
    return ratio
