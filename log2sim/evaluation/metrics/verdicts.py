"""What is wrong with each reconstructed agent at each tick, by the rules of a metrics file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUPS, MIN_TRUSTED_CONFIDENCE, Scenario
from log2sim.evaluation.metrics import comparison
from log2sim.evaluation.metrics.comparison import Comparison, Index, Mask, StateTable
from log2sim.files.arrays import Columns
from log2sim.geometry import Array, rectangles_overlap, wrap_angle

MIN_WALKING_MPS = 0.5  # the heading of a slower pedestrian does not count


@dataclass(frozen=True, eq=False)
class StateErrors(Columns):
    """Errors of K matched agent-ticks."""

    # truth, tick, other: (K,) indices of the truth agent, the tick and the reconstructed agent.
    truth: Index
    tick: Index
    other: Index
    position_m: Array  # (K,) 2D distance of box centers
    yaw_rad: Array  # (K,) absolute, in [0, pi]; NaN where yaw does not count
    speed_mps: Array  # (K,) signed
    size_m: Array  # (K, 3) signed errors of length, width, height


def state_errors(truth: StateTable, other: StateTable, match: NDArray[np.int64], counted: Mask) -> StateErrors:
    """Compare matched states at the counted ticks.

    Yaw counts for vehicles, two-wheelers and pedestrians of at least 0.5 m/s. The speed of a box turned by more than 90
    degrees is taken along the truth's heading, so that a flipped box is an error of yaw only.
    """
    i, t = np.nonzero(counted & (match >= 0))
    j = match[i, t]
    gap = other.xy_m[j, t] - truth.xy_m[i, t]
    yaw = np.abs(wrap_angle(other.yaw_rad[j, t] - truth.yaw_rad[i, t]))
    sign = np.where(yaw > np.pi / 2, -1.0, 1.0)
    walking = (truth.group[i] != "pedestrian") | (np.abs(truth.speed_mps[i, t]) >= MIN_WALKING_MPS)
    headed = walking & (truth.group[i] != "other")
    speed_mps = sign * other.speed_mps[j, t] - truth.speed_mps[i, t]
    position_m, size_m = np.hypot(gap[:, 0], gap[:, 1]), other.size_m[j] - truth.size_m[i]
    return StateErrors(i, t, j, position_m, np.where(headed, yaw, np.nan), speed_mps, size_m)


def summarize_verdicts(errors: StateErrors) -> dict[str, float | None]:
    """Summarize all rows; a figure without rows is None.

    Sizes are constant per agent, so their medians run over truth agents, each with its mean over matched ticks;
    `size_median_m` is the median of the mean absolute error over length, width and height. `ade_m` is the mean over
    truth agents of their mean distance.
    """
    headed = errors.yaw_rad[np.isfinite(errors.yaw_rad)]
    values = np.column_stack([np.abs(errors.size_m), errors.position_m])
    names, index, count = np.unique(errors.truth, return_inverse=True, return_counts=True)
    total = np.zeros((len(names), values.shape[1]))
    np.add.at(total, index, values)
    by_agent = total / count[:, None]
    return {
        "position_rmse_m": root_mean_square(errors.position_m), "position_median_m": median(errors.position_m),
        "ade_m": float(by_agent[:, 3].mean()) if len(by_agent) else None, "yaw_median_deg": median(np.degrees(headed)),
        "yaw_flipped": float(np.mean(headed > np.pi / 2)) if len(headed) else None,
        "speed_rmse_mps": root_mean_square(errors.speed_mps), "size_median_m": median(by_agent[:, :3].mean(axis=1)),
        "length_median_m": median(by_agent[:, 0]), "width_median_m": median(by_agent[:, 1]),
        "height_median_m": median(by_agent[:, 2]),
    }  # fmt: skip


def root_mean_square(values: Array) -> float | None:
    """Compute the root mean square of values (K,); None without any."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def median(values: Array) -> float | None:
    """Compute the median of values (K,); None without any."""
    return float(np.median(values)) if len(values) else None


# Six standard deviations of a speed from labels with 5 cm of noise at 10 Hz, 0.16 m/s; see `truth.speed_along`.
MAX_SPEED_ERROR_MPS = 1.0
MAX_STANDING_MPS = 0.5  # slower is standing: three standard deviations of such a speed, and no more than a body sways
# From here on an object surely moves, a slow walk already. Speeds between both limits count as neither.
MIN_MOVING_MPS = 1.0
MAX_SIZE_ERROR_SHARE = 0.25
# A smaller error of a length or width is never wrong: stride and arms change the box of a person by as much.
MIN_SIZE_ERROR_M = 0.3
# An agent is wrong at a tick when at least one of these is true of it.
MEASURES = ("invented", "duplicate", "in_ego", "wrong_speed", "wrong_motion", "backwards", "wrong_size")
REPORTED = (*MEASURES, "wrong_class")
# An agent is wrong when more of its ticks are. Trackers are scored alike: "mostly tracked" is 80 % of a life (Wu and
# Nevatia, CVPR 2006; Li, Huang, Nevatia, CVPR 2009).
MAX_WRONG_SHARE = 0.2


@dataclass(frozen=True, eq=False)
class Verdicts:
    """Verdicts on B reconstructed agents at T ticks."""

    judged: Mask  # (B, T) where the labels are complete or the agent matches one; no other mask is true elsewhere
    undecided: Mask  # (B, T) the other selected ticks
    matched: Index  # (B, T) index of the matched truth agent at judged ticks, -1 for none
    # (B, T) index of the matched truth agent, else the nearest within the gate, those of the same kind first; -1 for none
    taken_for: Index
    measures: Mapping[str, Mask]  # (B, T) by the names in `REPORTED`
    error_m: Array  # (B, T, 2) position error of matched agents; NaN elsewhere
    error_rad: Array  # (B, T) error of their heading up to half turns; NaN elsewhere and where heading does not count
    error_mps: Array  # (B, T) error of their speed; NaN elsewhere

    @property
    def wrong(self) -> Mask:
        """Mark (B, T) the ticks at which at least one of `MEASURES` is true."""
        return np.asarray(np.any([self.measures[name] for name in MEASURES], axis=0))


def judge_against_truth(c: Comparison, ego: StateTable | None) -> Verdicts:
    """Judge every selected tick of every reconstructed agent; `ego` has one row.

    Agents are associated one to one with labeled objects of their kind (`GROUPS`), visible or hidden, as for recall and
    precision (`associate`); `correctness_rules` says when each measure is true. An agent that matches nothing has no state
    errors. `wrong_class` is not among `MEASURES`: within a kind, logs draw the borders differently (pickups, vans), and an
    agent at an object of another kind is `invented` already. Ticks are undecided in ignore regions unless the ego is there, and
    where the only labeled object within the gate is interpolated over a gap of its labels.
    """
    truth, other = c.truth, c.other
    i, t = np.nonzero(c.match >= 0)
    matched: Index = np.full(c.false.shape, -1, dtype=np.int64)
    matched[c.match[i, t], t] = i
    same = c.pairs.take(c.pairs.same_group)
    labeled = same.take(truth.labeled[same.truth, same.tick])
    near, near_labeled = (_marked(c.false.shape, pairs.other, pairs.tick) for pairs in (same, labeled))
    in_ego = np.zeros(matched.shape, dtype=bool)
    if ego is not None:  # where the truth that an agent matches is not
        in_ego = _overlapping(other, ego) & ~_marks_of_matched(matched, _overlapping(truth, ego))
    lone = c.selected & (matched < 0) & (in_ego | ~c.ignored)
    invented, duplicate = lone & ~near, lone & near_labeled
    known = c.selected & _marks_of_matched(matched, truth.labeled)
    judged = known | invented | duplicate
    errors = state_errors(truth, other, c.match, truth.labeled)
    errors = errors.take(known[errors.other, errors.tick])
    measures = {"invented": invented, "duplicate": duplicate, "in_ego": in_ego & judged}
    # The states of the K matched agent-ticks.
    i, j, t = errors.truth, errors.other, errors.tick
    true_mps, our_mps = truth.speed_mps[i, t], other.speed_mps[j, t]
    along = true_mps * our_mps * np.cos(other.yaw_rad[j, t] - truth.yaw_rad[i, t])
    stands, true_stands = np.abs(our_mps) < MAX_STANDING_MPS, np.abs(true_mps) < MAX_STANDING_MPS
    moves, true_moves = np.abs(our_mps) >= MIN_MOVING_MPS, np.abs(true_mps) >= MIN_MOVING_MPS
    limit_m = np.maximum(MAX_SIZE_ERROR_SHARE * truth.size_m[i, :2], MIN_SIZE_ERROR_M)
    states = {
        "wrong_speed": np.abs(errors.speed_mps) > MAX_SPEED_ERROR_MPS,
        "wrong_motion": (stands & true_moves) | (moves & true_stands) | (~stands & ~true_stands & (along < 0)),
        "backwards": np.nan_to_num(errors.yaw_rad) > np.pi / 2,
        "wrong_size": np.any(np.abs(errors.size_m[:, :2]) > limit_m, axis=1),
    }
    for name, wrong in states.items():
        measures[name] = _marked(judged.shape, errors.other[wrong], errors.tick[wrong])
    p = c.pairs
    place = p.other * matched.shape[1] + p.tick
    order = np.lexsort((p.distance_m, ~p.same_group, place))
    _, first = np.unique(place[order], return_index=True)
    rows = order[first]
    nearest = np.full(matched.shape, -1, dtype=np.int64)
    nearest[p.other[rows], p.tick[rows]] = p.truth[rows]
    taken_for = np.where(judged, np.where(matched >= 0, matched, nearest), -1)
    true_category = np.append(truth.category, "")[taken_for]  # "" for none
    measures["wrong_class"] = (taken_for >= 0) & (true_category != other.category[:, None])
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


def _marks_of_matched(matched: Index, of_truth: Mask) -> Mask:
    """Look up (B, T) what is marked (A, T) of the matched truth agents; False without a match."""
    mask = matched >= 0
    _, tick = np.nonzero(mask)
    mask[mask] = of_truth[matched[mask], tick]
    return mask


def _spread(errors: StateErrors, values: Array, shape: tuple[int, ...]) -> Array:
    """Return (B, T, ...) the values (K, ...) of matched agent-ticks; NaN elsewhere."""
    out = np.full((*shape, *values.shape[1:]), np.nan)
    out[errors.other, errors.tick] = values
    return out


def _marked(shape: tuple[int, ...], agent: Index, tick: Index) -> Mask:
    mask = np.zeros(shape, dtype=bool)
    mask[agent, tick] = True
    return mask


IGNORED_RULE = (
    "an unmatched reconstructed agent is neither right nor false at the ticks at which the labels may be incomplete there: "
    f"every labeled camera that shows it (a frame within {comparison.MAX_FRAME_LAG_S:g} s) has at least {comparison.MIN_REGION_SHARE:g} of its "
    "outline inside the image in regions left without labels, or no labeled camera shows any of it and only what these "
    "cameras see was labeled, or its category was never labeled"
)


def matching_rules() -> dict[str, Any]:
    """Describe how agents are matched."""
    return {
        "gate_m": comparison.GATE_M,
        "gate_per_length": comparison.GATE_PER_LENGTH,
        "groups": {name: list(members) for name, members in GROUPS.items()},
        "rule": "one to one per tick by 2D distance of box centers within max(gate_m, gate_per_length x true length); "
        "last match kept while within the gate, then most pairs with least total distance; "
        "categories of one group match freely, across groups a match is neither found nor false",
        "similarity": "HOTA: 1 - distance / gate, mean over thresholds 0.05 to 0.95",
        "yaw": f"vehicles, two-wheelers and pedestrians of at least {MIN_WALKING_MPS:g} m/s; flipped: more than 90 degrees",
        "speed": "signed along the heading; along the true heading where the box is flipped",
        "size": "median over truth agents of the mean absolute error of length, width and height",
    }


def counting_rules(truth: Scenario) -> dict[str, Any]:
    """Describe what is counted."""
    return {
        "min_s": comparison.MIN_COUNTED_S,
        "max_truth_gap_s": comparison.MAX_TRUTH_GAP_S,
        "rule": "a truth agent counts at the ticks at which it is visible, within range and selected, "
        "when these make up at least min_s; a reconstructed agent is false at the ticks at which no labeled object, "
        "visible or not, counted or not, matches it, but for the ignored ones",
        "hit": f"within range, selected and at least {comparison.MIN_HIT_POINTS} points of all LiDARs in the box, visible or not",
        "ignored": IGNORED_RULE if truth.ignore_regions is not None else "none; the truth states that it is complete",
        "visible": truth.provenance.get("visible", "as the truth file states; all where it states nothing"),
    }


def correctness_rules() -> dict[str, Any]:
    """Describe what is wrong with an agent, and when a scenario doubts one; see `verdicts.judge_against_truth`."""
    return {
        "judged": "ticks of a reconstructed agent at which it matches a labeled object, or matches none and the labels "
        "are complete there; shares are of these ticks, ranges those of the reconstructed agent",
        "invented": "no labeled object of its kind, matched or not, within the gate of the matching",
        "duplicate": "such an object is within the gate, but another agent matches it",
        "in_ego": "its footprint overlaps the ego's, and that of the labeled object that it matches does not; judged also "
        "where the labels may be incomplete",
        "wrong_speed": f"matched, and the speed along the true heading is off by more than {MAX_SPEED_ERROR_MPS:g} m/s",
        "wrong_motion": f"matched, and stands (below {MAX_STANDING_MPS:g} m/s) while the truth moves (from "
        f"{MIN_MOVING_MPS:g} m/s), moves while it stands, or both move (from {MAX_STANDING_MPS:g} m/s) more than 90 "
        "degrees apart",
        "backwards": "matched, and the heading is off by more than 90 degrees; standing pedestrians and category other "
        "have none",
        "wrong_size": f"matched, and the length or width is off by more than {MAX_SIZE_ERROR_SHARE:.0%} of the true one "
        f"and by more than {MIN_SIZE_ERROR_M:g} m",
        "wrong_class": "the matched object, or the nearest within the gate, has another category; no reason to be wrong",
        "wrong": f"at a tick, any of {', '.join(MEASURES)}; of agents, and likewise for each measure, more than "
        f"{MAX_WRONG_SHARE:.0%} of the ticks",
        "doubted": f"the scenario doubts the agent at the tick, or gives it a confidence below "
        f"{MIN_TRUSTED_CONFIDENCE:g}; of agents, at any tick",
        "sigma": "nees: mean of squared position errors of matched ticks over two times the squared sigma, 1 expected; "
        "median, 0.69 expected; within_95: share inside of the 95 % circle, 0.95 expected",
        "sigma_yaw": "likewise of yaw, up to half turns; median, 0.45 expected",
        "sigma_speed": "likewise of speed; median, 0.45 expected",
    }
