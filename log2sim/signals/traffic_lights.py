"""Traffic lights of a log: where they are and which lamps shine when, from the boxes that the first pass kept."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from log2sim.datatypes import Log, Scenario, Signal
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception.light_boxes import LightBox
from log2sim.signals.lamps import STATES, lamp_evidence
from log2sim.signals.placing import Housing, place_lights
from log2sim.signals.states import changes_of, most_probable_states

# Fewer boxes are as likely of something else that is red or green: single false boxes do not repeat in one place.
MIN_BOXES = 3
# Middles of housings above the road: pedestrians' signals begin at 2.1 m, those above lanes at 5 to 7 m.
HEIGHT_M, HEIGHT_MARGIN_M = (1.9, 9.0), 0.2
# Where the distance is less sure than this, no place is stated.
MAX_SIGMA_M = 8.0
# What is likelier wrong than right is not stated.
MIN_CONFIDENCE = 0.5
# Of pictures with a lit lamp.
MIN_LIT_SHARE = 0.4
# From so many boxes on, a light is as sure as their scores; half as sure from a third of it.
SURE_BOXES = 6.0


def find_signals(log: Log, scenario: Scenario, boxes: Sequence[LightBox]) -> tuple[tuple[Signal, ...], str]:
    """Find the traffic lights among boxes of frames.

    Returns
    -------
    signals : tuple of Signal
        Ordered by when they are first seen.
    seen : str
        How many there are, and how many places of boxes were left out, in words.
    """
    if not boxes:
        return (), "no traffic light seen"
    signals: list[Signal] = []
    housings = sorted(place_lights(log, boxes), key=lambda housing: min(box.t_ns for box in housing.boxes))
    for housing in housings:
        signal = _signal(f"signal_{len(signals) + 1}", housing, scenario) if _is_plausible(log, housing) else None
        signals += [] if signal is None else [signal]
    text = f"{len(signals)} traffic light{'' if len(signals) == 1 else 's'}"
    if left_out := len(housings) - len(signals):
        text += f"; {left_out} places left out: seen too rarely, placed too roughly, not where signals hang, no lamp lit, or too unsure"
    return tuple(signals), text


def _is_plausible(log: Log, housing: Housing) -> bool:
    """Return whether a housing was seen often enough, is placed well enough, and hangs where signals do."""
    if len(housing.boxes) < MIN_BOXES or housing.sigma_m > MAX_SIGMA_M:
        return False
    height = housing.position[2] - ground_height(log, housing)
    margin = HEIGHT_MARGIN_M + float(np.sqrt(housing.covariance[2, 2]))
    return bool(HEIGHT_M[0] - margin <= height <= HEIGHT_M[1] + margin)


def ground_height(log: Log, housing: Housing) -> float:
    """Return the height of the road, m, map frame, where the vehicle was nearest to a housing; of a log without ego 0."""
    if log.ego is None:
        return 0.0
    poses = log.ego.at(np.array([box.t_ns for box in housing.boxes]))[0]
    away = np.linalg.norm(poses[:, :2, 3] - housing.position[:2], axis=1)
    return float(poses[int(np.nanargmin(away)), 2, 3]) + log.ground_z_ego_m


def _signal(name: str, housing: Housing, scenario: Scenario) -> Signal | None:
    """Return the signal of a housing; None where lamps are lit in too few of its pictures, or too unsure."""
    order = sorted(range(len(housing.boxes)), key=lambda k: (housing.boxes[k].t_ns, housing.boxes[k].camera))
    boxes = [housing.boxes[k] for k in order]
    t_s = np.array([(box.t_ns - scenario.t0_ns) / NS_PER_S for box in boxes])
    evidence = np.array([lamp_evidence(box.crop) for box in boxes])
    course, probability = most_probable_states(t_s, evidence)
    lit = evidence.argmax(axis=1) != STATES.index("off")
    # Dark from everywhere is more often a housing's back, or a tree, than a signal that is off.
    times, states = changes_of(t_s, course)
    if lit.mean() < MIN_LIT_SHARE or set(states) <= {"off", "unknown"}:
        return None
    heading = _heading([housing.eyes[k] for k, shines in zip(order, lit) if shines], housing.position)
    score = float(np.mean([box.score for box in boxes]))
    repeated = 1 - (1 - score) ** (len(boxes) / SURE_BOXES * 2)
    confidence = repeated * float(probability.mean())
    if confidence < MIN_CONFIDENCE:
        return None
    return Signal(
        id=name,
        position_m=housing.position,
        heading_rad=heading,
        t_s=times,
        state=np.array(states),
        sigma_m=housing.sigma_m,
        confidence=round(confidence, 3),
        cameras=tuple(sorted({box.camera for box in boxes})),
    )


def _heading(eyes: list[Array], position: Array) -> float | None:
    """Return the mean direction from which lamps were seen lit; None where they were not."""
    if not eyes:
        return None
    away = np.array(eyes)[:, :2] - position[:2]
    unit = away / np.linalg.norm(away, axis=1, keepdims=True)
    mean = unit.mean(axis=0)
    return float(np.arctan2(mean[1], mean[0]))
