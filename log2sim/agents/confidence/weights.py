"""Weights of the evidence (`evidence.Evidence`) and of systematic errors (`systematic`).

Printed by `tools/fit_confidence.py` on the logs of `tools/confidence_logs.py`: `WITHOUT_LIDAR` with `--seed 3` and `--seed 4`, 1066
agents of 120 synthetic logs; all else with `--seed 3`, 1369 agents of 70.
"""

from __future__ import annotations

WITH_LIDAR = {
    "image": 0.1081,
    "sweep": 0.08424,
    "few": -0.8772,
    "brief": -0.6452,
    "blind": -1.067,
    "range": 0.0,
    "scatter": -0.4745,
    "sigma": -0.3635,
    "unlikely_size": -0.6148,
    "odd_size": -0.5564,
    "hidden": -1.793,
    "heading": 0.1882,
    "other_category": -1.156,
    "doubts": -0.6274,
    "moving": -0.7639,
    "two_wheeler": -0.4416,
    "pedestrian": -0.2002,
    "other": -2.952,
    "bias": 2.424,
}
WITHOUT_LIDAR = {
    "image": 0.1793,
    "few": -0.6211,
    "brief": -0.8314,
    "range": -0.05646,
    "scatter": -0.1955,
    "sigma": -0.6134,
    "odd_height": -2.69,
    "heading": 0.0,
    "other_category": -2.325,
    "doubts": -0.2805,
    "moving": -1.314,
    "two_wheeler": 0.07761,
    "pedestrian": 0.5601,
    "other": -2.914,
    "bias": 0.8547,
}
POSITION_VARIANCE = {
    "given": 1.599,
    "given_moving": 1.009,
    "hidden": 0.003781,
    "range": 0.0001366,
    "wrong": 0.04673,
}
YAW_VARIANCE = {
    "given": 0.25,
    "wrong": 0.2422,
}
SPEED_VARIANCE = {
    "given": 4.335,
    "standing": 5.145,
    "moving": 0.3874,
}
