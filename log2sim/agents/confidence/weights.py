"""Weights of the evidence (`evidence.Evidence`) and of systematic errors (`systematic`).

Printed by `tools/fit_confidence.py`: 1580 agents of 80 synthetic logs of `tools/confidence_logs.py`, seeds 1 and 2.
"""

from __future__ import annotations

BIAS = 1.957
WEIGHTS = {
    "image": 0.2426,
    "sweep": 0.1268,
    "no_sweep": 0.0,
    "missed": -0.08345,
    "few": -0.2498,
    "brief": -0.4947,
    "blind": -0.4624,
    "range": 0.0,
    "scatter": -0.4777,
    "sigma": -0.5318,
    "unlikely_size": -0.7077,
    "odd_size": -0.4824,
    "hidden": -1.832,
    "heading": 0.2915,
    "other_category": -1.225,
    "truncated": -0.4953,
    "doubts": -0.3806,
    "moving": -0.7759,
    "two_wheeler": -0.5521,
    "pedestrian": 1.112,
    "other": -4.232,
}
POSITION_VARIANCE = {
    "given": 0.5224,
    "given_moving": 1.958,
    "hidden": 0.006583,
    "outline": 0.001018,
    "range": 0.001676,
    "wrong": 0.04114,
}
YAW_VARIANCE = {
    "given": 0.25,
    "wrong": 0.2872,
}
SPEED_VARIANCE = {
    "given": 1.197,
    "change": 0.008805,
    "standing": 1.579,
    "moving": 0.2264,
}
