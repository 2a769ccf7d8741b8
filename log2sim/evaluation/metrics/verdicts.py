"""What is wrong with each reconstructed agent at each tick: not there, or there in another state than the truth's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from log2sim.evaluation.metrics.align import StateTable
from log2sim.evaluation.metrics.comparison import Comparison
from log2sim.evaluation.metrics.pairs import Index, Mask
from log2sim.evaluation.metrics.state_errors import StateErrors, state_errors
from log2sim.geometry import Array, rectangles_overlap

MAX_SPEED_ERROR_MPS = 1.0
"""Six standard deviations of a speed from labels with 5 cm of noise at 10 Hz, 0.16 m/s; see `truth.speed_along`."""

MAX_STANDING_MPS = 0.5
"""Slower is standing: three standard deviations of such a speed, and no more than a body sways."""

MIN_MOVING_MPS = 1.0
"""From here on an object surely moves, a slow walk already. Speeds between both limits count as neither."""

MAX_SIZE_ERROR_SHARE = 0.25
MIN_SIZE_ERROR_M = 0.3
"""A smaller error of a length or width is never wrong: stride and arms change the box of a person by as much."""

MEASURES = ("invented", "duplicate", "in_ego", "wrong_speed", "wrong_motion", "backwards", "wrong_size")
"""An agent is wrong at a tick when at least one of these is true of it."""

REPORTED = (*MEASURES, "wrong_class")


@dataclass(frozen=True, eq=False)
class Verdicts:
    """Verdicts on B reconstructed agents at T ticks.

    Attributes
    ----------
    judged : (B, T) bool
        Where the labels are complete or the agent matches one; no other mask is true elsewhere.
    undecided : (B, T) bool
        The other selected ticks.
    matched : (B, T) int64
        Index of the matched truth agent at judged ticks, -1 for none.
    taken_for : (B, T) int64
        Index of the truth agent that is there: the matched one, else the nearest of the same kind within its gate, else the
        nearest of another kind within its gate; -1 for none.
    measures : mapping of str to (B, T) bool
        By the names in `REPORTED`.
    error_m : (B, T, 2) float64, m
        Position error of matched agents; NaN elsewhere.
    error_rad : (B, T) float64
        Error of their heading up to half turns; NaN elsewhere and where heading does not count.
    error_mps : (B, T) float64, m/s
        Error of their speed; NaN elsewhere.
    """

    judged: Mask
    undecided: Mask
    matched: Index
    taken_for: Index
    measures: Mapping[str, Mask]
    error_m: Array
    error_rad: Array
    error_mps: Array

    @property
    def wrong(self) -> Mask:
        """Mark (B, T) the ticks at which at least one of `MEASURES` is true."""
        return np.asarray(np.any([self.measures[name] for name in MEASURES], axis=0))


def judge(c: Comparison, ego: StateTable | None) -> Verdicts:
    """Judge every selected tick of every reconstructed agent; `ego` has one row.

    Notes
    -----
    Agents are associated one to one with labeled objects of their kind (`GROUPS`), visible or hidden, as for recall and
    precision (`clear_mot.associate`): within 2 m, less than half a car's length, or a quarter of the true length where
    that is more.

    - `invented`: no labeled object of its kind is within the gate, matched or not.
    - `duplicate`: one is, but another agent matches it.
    - `in_ego`: its footprint overlaps that of the ego, and that of the labeled object that it matches does not.
    - `wrong_speed`: the speed is off by more than 1 m/s. Both are signed along the true heading, so an agent that is only
      turned round has none.
    - `wrong_motion`: stands (below 0.5 m/s) while the truth moves (from 1 m/s), moves while it stands, or both move (from
      0.5 m/s) with velocities more than 90 degrees apart.
    - `backwards`: headings are more than 90 degrees apart; of standing pedestrians and of category other never.
    - `wrong_size`: length or width is off by more than 25 % of the true one and by more than 0.3 m.
    - `wrong_class`: the labeled object there has another category. Not among `MEASURES`: within a kind, logs draw the
      borders differently (pickups, vans), and an agent at an object of another kind is `invented` already.

    An agent that matches nothing has no state errors. Ticks are undecided in ignore regions (`label_coverage`) unless
    the ego is there, and where the only labeled object within the gate is interpolated over a gap of its labels.
    """
    truth, other = c.truth, c.other
    matched = _partners(c)
    same = c.pairs.take(c.pairs.same_group)
    near, near_labeled = (_marked(c.false.shape, same.other[k], same.tick[k]) for k in (slice(None), _labeled_rows(c)))
    in_ego = _in_ego(truth, other, matched, ego)
    lone = c.selected & (matched < 0) & (in_ego | ~c.ignored)
    invented, duplicate = lone & ~near, lone & near_labeled
    known = c.selected & _of_matched(matched, truth.labeled)
    judged = known | invented | duplicate
    errors = state_errors(truth, other, c.match, truth.labeled)
    errors = errors.take(known[errors.other, errors.tick])
    measures = {"invented": invented, "duplicate": duplicate, "in_ego": in_ego & judged}
    measures |= {k: _at(errors, wrong, judged.shape) for k, wrong in _state_verdicts(truth, other, errors).items()}
    taken_for = np.where(judged, _nearest(c, matched), -1)
    measures["wrong_class"] = (taken_for >= 0) & (_category(truth, taken_for) != other.category[:, None])
    gap = other.xy_m[errors.other, errors.tick] - truth.xy_m[errors.truth, errors.tick]
    return Verdicts(
        judged,
        c.selected & ~judged,
        np.where(known, matched, -1),
        taken_for,
        measures,
        error_m=_spread(errors, gap, judged.shape),
        error_rad=_spread(errors, np.minimum(errors.yaw_rad, np.pi - errors.yaw_rad), judged.shape),
        error_mps=_spread(errors, errors.speed_mps, judged.shape),
    )


def _state_verdicts(truth: StateTable, other: StateTable, errors: StateErrors) -> dict[str, Mask]:
    """Judge the states of K matched agent-ticks."""
    i, j, t = errors.truth, errors.other, errors.tick
    true_mps, our_mps = truth.speed_mps[i, t], other.speed_mps[j, t]
    along = true_mps * our_mps * np.cos(other.yaw_rad[j, t] - truth.yaw_rad[i, t])
    stands, true_stands = np.abs(our_mps) < MAX_STANDING_MPS, np.abs(true_mps) < MAX_STANDING_MPS
    moves, true_moves = np.abs(our_mps) >= MIN_MOVING_MPS, np.abs(true_mps) >= MIN_MOVING_MPS
    off_m = np.abs(errors.size_m[:, :2])
    limit_m = np.maximum(MAX_SIZE_ERROR_SHARE * truth.size_m[i, :2], MIN_SIZE_ERROR_M)
    return {
        "wrong_speed": np.abs(errors.speed_mps) > MAX_SPEED_ERROR_MPS,
        "wrong_motion": (stands & true_moves) | (moves & true_stands) | (~stands & ~true_stands & (along < 0)),
        "backwards": np.nan_to_num(errors.yaw_rad) > np.pi / 2,
        "wrong_size": np.any(off_m > limit_m, axis=1),
    }


def _in_ego(truth: StateTable, other: StateTable, matched: Index, ego: StateTable | None) -> Mask:
    """Mark (B, T) the agents in the ego whose matched truth is not."""
    if ego is None:
        return np.zeros(matched.shape, dtype=bool)
    return _overlapping(other, ego) & ~_of_matched(matched, _overlapping(truth, ego))


def _overlapping(side: StateTable, ego: StateTable) -> Mask:
    """Mark (A, T) the agents whose footprint overlaps that of the ego."""
    away = ego.xy_m - side.xy_m
    reach_m = (np.hypot(side.size_m[:, 0], side.size_m[:, 1]) + np.hypot(ego.size_m[0, 0], ego.size_m[0, 1])) / 2
    near = np.hypot(away[..., 0], away[..., 1]) < reach_m[:, None]
    i, t = np.nonzero(near)
    ego_size_m = np.broadcast_to(ego.size_m, (len(i), 3))
    near[i, t] = rectangles_overlap(
        away[i, t, 0], away[i, t, 1], side.yaw_rad[i, t], ego.yaw_rad[0, t], side.size_m[i], ego_size_m
    )
    return np.asarray(near)


def _of_matched(matched: Index, of_truth: Mask) -> Mask:
    """Look up (B, T) what is marked (A, T) of the matched truth agents; False without a match."""
    mask = matched >= 0
    _, tick = np.nonzero(mask)
    mask[mask] = of_truth[matched[mask], tick]
    return mask


def _partners(c: Comparison) -> Index:
    """Return (B, T) the truth agent that matches each reconstructed agent, -1 for none."""
    i, t = np.nonzero(c.match >= 0)
    partner = np.full(c.false.shape, -1, dtype=np.int64)
    partner[c.match[i, t], t] = i
    return partner


def _labeled_rows(c: Comparison) -> Index:
    """Select of the pairs of one kind those whose truth is labeled at the tick."""
    same = c.pairs.take(c.pairs.same_group)
    return np.flatnonzero(c.truth.labeled[same.truth, same.tick])


def _nearest(c: Comparison, matched: Index) -> Index:
    """Return (B, T) the matched truth agent, else the nearest within the gate, those of the same kind first; -1 for none."""
    p = c.pairs
    place = p.other * matched.shape[1] + p.tick
    order = np.lexsort((p.distance_m, ~p.same_group, place))
    _, first = np.unique(place[order], return_index=True)
    rows = order[first]
    nearest = np.full(matched.shape, -1, dtype=np.int64)
    nearest[p.other[rows], p.tick[rows]] = p.truth[rows]
    return np.where(matched >= 0, matched, nearest)


def _category(truth: StateTable, index: Index) -> np.ndarray[tuple[int, ...], np.dtype[np.str_]]:
    """Look up the category of truth agents; entries of -1 get that of the first one, and must be masked."""
    return truth.category[np.maximum(index, 0)] if len(truth.category) else np.full(index.shape, "", dtype="<U16")


def _spread(errors: StateErrors, values: Array, shape: tuple[int, ...]) -> Array:
    """Return (B, T, ...) the values (K, ...) of matched agent-ticks; NaN elsewhere."""
    out = np.full((*shape, *values.shape[1:]), np.nan)
    out[errors.other, errors.tick] = values
    return out


def _at(errors: StateErrors, wrong: Mask, shape: tuple[int, ...]) -> Mask:
    return _marked(shape, errors.other[wrong], errors.tick[wrong])


def _marked(shape: tuple[int, ...], agent: Index, tick: Index) -> Mask:
    mask = np.zeros(shape, dtype=bool)
    mask[agent, tick] = True
    return mask
