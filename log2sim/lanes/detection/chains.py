"""Pieces joined end to end to chains, as roads bend: first what touches, then dashes across the gaps between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from log2sim.geometry import Array
from log2sim.lanes.detection.profiles import Pieces

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
    """Pieces in their order along a line.

    Attributes
    ----------
    members : (K,) int
        Indices of pieces.
    flipped : (K,) bool
        Whether a piece's own direction points backwards.
    """

    members: NDArray[np.int64]
    flipped: NDArray[np.bool_]

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
    return [_trimmed(pieces, chain) for chain in _join(pieces, single, TOUCH_M, MIN_RADIUS_M)]


def _trimmed(pieces: Pieces, chain: Chain) -> Chain:
    """Leave out short pieces at the ends that lie beside the line of the next piece: grain beyond the paint."""
    first, last = 0, len(chain.members) - 1
    while last > first and _beside(pieces, chain.members[last], chain.members[last - 1]):
        last -= 1
    while last > first and _beside(pieces, chain.members[first], chain.members[first + 1]):
        first += 1
    return Chain(chain.members[first : last + 1], chain.flipped[first : last + 1])


def _beside(pieces: Pieces, end: int, inner: int) -> bool:
    if pieces.length_m[end] > min(SHORT_END_M, 0.7 * pieces.length_m[inner]):
        return False
    angle = pieces.direction[inner]
    offset = pieces.xy[end] - pieces.xy[inner]
    turn = abs((pieces.direction[end] - angle + np.pi / 2) % np.pi - np.pi / 2)
    return bool(
        abs(offset[1] * np.cos(angle) - offset[0] * np.sin(angle)) > 1.2 * POSITION_SIGMA_M or turn > MAX_END_TURN_RAD
    )


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
    root = list(range(len(chains)))

    def find(k: int) -> int:
        while root[k] != k:
            root[k] = root[root[k]]
            k = root[k]
        return k

    for k in np.argsort(cost, kind="stable"):
        a, b = int(first[k]), int(second[k])
        # A ring stays open at one place, as a line has two ends.
        if a not in partner and b not in partner and find(a // 2) != find(b // 2):
            partner[a], partner[b] = b, a
            root[find(a // 2)] = find(b // 2)
    return _assemble(chains, partner)


def _assemble(chains: list[Chain], partner: dict[int, int]) -> list[Chain]:
    """Walk from every free end to the other one."""
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
    contrasts = contrast_of(pieces)
    if all(len(chain.members) == 1 for chain in chains):
        return _ends_of_single(pieces, chains, contrasts)
    rows = []
    for chain in chains:
        corners = chain.corners(pieces)
        length = float(np.linalg.norm(corners[-1] - corners[0]))
        width = float(np.median(pieces.width_m[chain.members]))
        contrast = float(np.median(contrasts[chain.members]))
        for ordered in (corners[::-1], corners):
            tip = ordered[-1]
            near = ordered[np.linalg.norm(ordered - tip, axis=1) <= base_m]
            angle, base = _direction(near if len(near) > 1 else ordered[-2:])
            sigma = POSITION_SIGMA_M * 2 / max(base, 0.3)
            rows.append([*tip, angle, sigma, width, contrast, length])
    t = np.array(rows)
    return _Ends(t[:, :2], t[:, 2], t[:, 3], t[:, 4], t[:, 5], t[:, 6])


def _ends_of_single(pieces: Pieces, chains: list[Chain], contrasts: Array) -> _Ends:
    """Return the ends of chains of one piece each, all at once."""
    member = np.array([chain.members[0] for chain in chains], dtype=np.int64)
    flipped = np.array([chain.flipped[0] for chain in chains], dtype=bool)
    ends = pieces.ends(member)
    ends[flipped] = ends[flipped][:, ::-1]
    chord = ends[:, 1] - ends[:, 0]
    length = np.hypot(chord[:, 0], chord[:, 1])
    # First the end at which the piece begins, from which it points backwards.
    outward = np.stack([np.arctan2(-chord[:, 1], -chord[:, 0]), np.arctan2(chord[:, 1], chord[:, 0])], axis=1)
    sigma, width, contrast, length = (
        np.repeat(values, 2)
        for values in (
            POSITION_SIGMA_M * 2 / np.maximum(length, 0.3), pieces.width_m[member], contrasts[member], length
        )
    )  # fmt: skip
    return _Ends(ends.reshape(-1, 2), outward.ravel(), sigma, width, contrast, length)


def contrast_of(pieces: Pieces) -> Array:
    """Contrast (N,) by camera, or by LiDAR where no camera saw the piece."""
    return np.where(np.isfinite(pieces.color), pieces.color, np.nan_to_num(pieces.reflected))


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
    turn = _wrapped(in_b - out_a)
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
    fits &= _alike(ends.width_m, a, b, MAX_WIDTH_RATIO) & _alike(ends.contrast, a, b, MAX_CONTRAST_RATIO)
    # Across a long gap, both sides are dashes: something that is there.
    fits &= span <= 1.5 + 6 * shorter
    a, b = a[fits], b[fits]
    cost = np.abs(gap) / 2 + (offset / sigma) ** 2 + np.square(turn / (turn_sigma + bend))
    return a, b, cost[fits]


def _alike(values: Array, a: NDArray[np.int64], b: NDArray[np.int64], ratio: float) -> NDArray[np.bool_]:
    return np.asarray(np.maximum(values[a], values[b]) <= ratio * np.minimum(values[a], values[b]))


def _wrapped(angle: Array) -> Array:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)
