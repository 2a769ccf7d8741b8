"""The rules of matching and counting as text, for the reader of a metrics file."""

from __future__ import annotations

from typing import Any

from log2sim.datatypes import GROUPS, Scenario
from log2sim.evaluation.metrics.align import MAX_TRUTH_GAP_S
from log2sim.evaluation.metrics.comparison import MIN_HIT_POINTS
from log2sim.evaluation.metrics.label_coverage import MAX_FRAME_LAG_S, MIN_REGION_SHARE
from log2sim.evaluation.metrics.pairs import GATE_M, GATE_PER_LENGTH
from log2sim.evaluation.metrics.state_errors import MIN_WALKING_MPS
from log2sim.evaluation.metrics.verdicts import (
    MAX_SIZE_ERROR_SHARE,
    MAX_SPEED_ERROR_MPS,
    MAX_STANDING_MPS,
    MEASURES,
    MIN_MOVING_MPS,
    MIN_SIZE_ERROR_M,
)

IGNORED_RULE = (
    "an unmatched reconstructed agent is neither right nor false at the ticks at which the labels may be incomplete there: "
    f"every labeled camera that shows it (a frame within {MAX_FRAME_LAG_S:g} s) has at least {MIN_REGION_SHARE:g} of its "
    "outline inside the image in regions left without labels, or no labeled camera shows any of it and only what these "
    "cameras see was labeled, or its category was never labeled"
)


def matching_rules() -> dict[str, Any]:
    """Describe how agents are matched."""
    return {
        "gate_m": GATE_M,
        "gate_per_length": GATE_PER_LENGTH,
        "groups": {name: list(members) for name, members in GROUPS.items()},
        "rule": "one to one per tick by 2D distance of box centers within max(gate_m, gate_per_length x true length); "
        "last match kept while within the gate, then most pairs with least total distance; "
        "categories of one group match freely, across groups a match is neither found nor false",
        "similarity": "HOTA: 1 - distance / gate, mean over thresholds 0.05 to 0.95",
        "yaw": f"vehicles, two-wheelers and pedestrians of at least {MIN_WALKING_MPS:g} m/s; flipped: more than 90 degrees",
        "speed": "signed along the heading; along the true heading where the box is flipped",
        "size": "median over truth agents of the mean absolute error of length, width and height",
    }


def counting_rules(truth: Scenario, min_s: float) -> dict[str, Any]:
    """Describe what is counted; `min_s` is the shortest counted time of a truth agent, s."""
    return {
        "min_s": min_s,
        "max_truth_gap_s": MAX_TRUTH_GAP_S,
        "rule": "a truth agent counts at the ticks at which it is visible, within range and selected, "
        "when these make up at least min_s; a reconstructed agent is false at the ticks at which no labeled object, "
        "visible or not, counted or not, matches it, but for the ignored ones",
        "hit": f"within range, selected and at least {MIN_HIT_POINTS} points of all LiDARs in the box, visible or not",
        "ignored": IGNORED_RULE if truth.ignore_regions is not None else "none; the truth states that it is complete",
        "visible": truth.provenance.get("visible", "as the truth file states; all where it states nothing"),
    }


def correctness_rules(max_wrong_share: float, min_confidence: float) -> dict[str, Any]:
    """Describe what is wrong with an agent, and when a scenario doubts one; see `verdicts.judge`."""
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
        f"{max_wrong_share:.0%} of the ticks",
        "doubted": f"the scenario doubts the agent at the tick, or gives it a confidence below {min_confidence:g}; of agents, at any tick",
        "sigma": "nees: mean of squared position errors of matched ticks over two times the squared sigma, 1 expected; "
        "median, 0.69 expected; within_95: share inside of the 95 % circle, 0.95 expected",
        "sigma_yaw": "likewise of yaw, up to half turns; median, 0.45 expected",
        "sigma_speed": "likewise of speed; median, 0.45 expected",
    }
