"""Weights of the evidence (`agents/evidence.py`), with and without a LiDAR, and of systematic errors.

Printed by `tools/fit.py confidence` on the logs of `tools/fit.py confidence_logs --seed 11`: 2199 candidates of 60 simulated logs.
`THERE` tells whether something is where a candidate is, `RIGHT` whether a candidate is right
where something is; `VARIANCES` weigh the terms of variances.
"""

THERE = {
    True: {
        "bias": 2.19,
        "weak_sweep": 1.0,
        "sweep": 0.361,
        "image": 0.141,
        "no_image": -0.232,
        "travel": 0.556,
        "few": -0.706,
        "scatter": -0.143,
        "sigma": -0.556,
        "odd_size": -0.42,
        "other_category": -0.907,
        "impossible": -0.672,
        "through": -1.66,
        "through_gaps": -0.811,
        "pointless": -1.18,
        "nearer": -1.69,
        "missing": -0.569,
        "moving": 0.234,
        "two_wheeler": -0.348,
        "pedestrian": -0.359,
    },
    False: {
        "bias": 2.84,
        "image": 0.0717,
        "scatter": -0.217,
        "sigma": -1.07,
        "odd_height": -1.28,
        "other_category": -1.02,
        "impossible": -0.601,
        "moving": -1.15,
        "two_wheeler": -0.572,
        "pedestrian": -0.18,
    },
}
RIGHT = {
    True: {
        "bias": 1.59,
        "brief": -0.554,
        "range": -0.181,
        "scatter": -0.372,
        "sigma": -0.504,
        "unlikely_size": -0.79,
        "odd_size": -0.679,
        "heading": 0.363,
        "other_category": -2.12,
        "sigma_speed": -0.862,
        "through": -0.477,
        "through_gaps": -2.67,
        "moving": -0.814,
        "two_wheeler": -0.19,
        "pedestrian": 0.263,
    },
    False: {
        "bias": 1.31,
        "brief": -1.25,
        "scatter": -0.178,
        "sigma": -0.476,
        "odd_height": -2.08,
        "heading": 0.141,
        "other_category": -2.23,
        "sigma_speed": -0.353,
        "moving": -0.839,
        "two_wheeler": 0.667,
        "pedestrian": 1.32,
    },
}
VARIANCES = {
    "sigma_xy_m": {
        "given": 2.28,
        "given_moving": 1.04,
        "hidden": 0.0036,
        "range": 0.00749,
        "wrong": 0.042,
    },
    "sigma_yaw_rad": {
        "given": 0.593,
        "wrong": 0.299,
    },
    "sigma_speed_mps": {
        "given": 1.92,
        "standing": 5.79,
        "moving": 0.533,
    },
}
