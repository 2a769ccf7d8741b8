"""Weights of the evidence (`agents/evidence.py`), with and without a LiDAR, and of systematic errors.

Printed by `tools/fit.py confidence` on the logs of `tools/fit.py confidence_logs --seed 11`: 2081 candidates of 60 simulated logs.
They were fitted before the network of the vehicle was trained on; `weak_sweep` and `missing` are set, see `FIXED` there.
`THERE` tells whether something is where a candidate is, `RIGHT` whether a candidate is right where something is;
`VARIANCES` weigh the terms of variances.
"""

THERE = {
    True: {
        "bias": 2.66,
        "weak_sweep": 1.0,
        "missing": -1.0,
        "sweep": 0.276,
        "image": 0.219,
        "no_image": -0.193,
        "travel": 0.476,
        "few": -1.99,
        "scatter": -0.0771,
        "sigma": -0.58,
        "odd_size": -0.61,
        "odd_height": -0.985,
        "other_category": -0.634,
        "impossible": -0.577,
        "through": -2.56,
        "through_gaps": -0.852,
        "pointless": -1.06,
        "nearer": -1.9,
        "moving": 0.57,
        "two_wheeler": -0.687,
        "pedestrian": -0.347,
    },
    False: {
        "bias": 2.8,
        "image": 0.0763,
        "scatter": -0.232,
        "sigma": -1.06,
        "odd_height": -1.24,
        "other_category": -1.0,
        "impossible": -0.594,
        "moving": -1.13,
        "two_wheeler": -0.554,
        "pedestrian": -0.156,
    },
}
RIGHT = {
    True: {
        "bias": 1.59,
        "brief": -0.634,
        "range": -0.353,
        "scatter": -0.378,
        "sigma": -0.554,
        "unlikely_size": -0.702,
        "odd_size": -0.714,
        "odd_height": -0.952,
        "heading": 0.438,
        "other_category": -1.39,
        "impossible": -0.754,
        "sigma_speed": -0.715,
        "through": -1.3,
        "through_gaps": -3.33,
        "moving": -1.07,
        "two_wheeler": -0.243,
        "pedestrian": 0.309,
    },
    False: {
        "bias": 1.3,
        "brief": -1.29,
        "scatter": -0.17,
        "sigma": -0.462,
        "odd_height": -2.07,
        "heading": 0.145,
        "other_category": -2.39,
        "sigma_speed": -0.357,
        "moving": -0.838,
        "two_wheeler": 0.663,
        "pedestrian": 1.33,
    },
}
VARIANCES = {
    "sigma_xy_m": {
        "given": 2.01,
        "given_moving": 0.891,
        "hidden": 0.0137,
        "range": 0.00072,
        "wrong": 0.0509,
    },
    "sigma_yaw_rad": {
        "given": 0.498,
        "wrong": 0.353,
    },
    "sigma_speed_mps": {
        "given": 7.85,
        "standing": 6.68,
        "moving": 0.434,
    },
}
