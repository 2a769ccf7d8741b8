"""Weights of the evidence (`agents/evidence.py`), with and without a LiDAR, and of systematic errors.

Printed by `tools/fit.py confidence` on the logs of `tools/fit.py confidence_logs --logs 120 --seed 11`: 4489 candidates of 120 simulated logs.
`THERE` tells whether something is where a candidate is, `RIGHT` whether a candidate is right
where something is; `VARIANCES` weigh the terms of variances.
"""

THERE = {
    True: {
        "bias": 1.94,
        "sweep": 0.51,
        "weak_sweep": 0.592,
        "image": 0.195,
        "no_image": -0.476,
        "travel": 0.509,
        "few": -1.66,
        "scatter": -0.0883,
        "sigma": -0.427,
        "unlikely_size": -0.17,
        "odd_size": -0.274,
        "odd_height": -1.83,
        "other_category": -1.04,
        "impossible": -0.831,
        "through": -0.847,
        "through_gaps": -0.442,
        "continued": -2.43,
        "missing": -0.514,
        "moving": 0.646,
        "two_wheeler": -0.562,
        "pedestrian": -0.436,
    },
    False: {
        "bias": 2.33,
        "image": 0.101,
        "scatter": -0.309,
        "sigma": -0.834,
        "odd_height": -1.6,
        "other_category": -1.13,
        "moving": -0.958,
        "two_wheeler": -0.3,
    },
}
RIGHT = {
    True: {
        "bias": 1.57,
        "brief": -0.76,
        "scatter": -0.375,
        "sigma": -0.635,
        "unlikely_size": -0.709,
        "odd_size": -0.614,
        "heading": 0.403,
        "other_category": -1.85,
        "impossible": -1.11,
        "sigma_speed": -0.739,
        "through_gaps": -0.723,
        "continued": -0.859,
        "moving": -0.966,
        "two_wheeler": -0.207,
        "pedestrian": 0.261,
    },
    False: {
        "bias": 1.24,
        "brief": -1.29,
        "scatter": -0.242,
        "sigma": -0.42,
        "odd_height": -2.15,
        "heading": 0.21,
        "other_category": -2.04,
        "sigma_speed": -0.274,
        "moving": -1.22,
        "two_wheeler": 0.597,
        "pedestrian": 1.59,
    },
}
VARIANCES = {
    "sigma_xy_m": {
        "given": 2.46,
        "given_moving": 0.333,
        "hidden": 0.0125,
        "range": 0.00475,
        "wrong": 0.038,
    },
    "sigma_yaw_rad": {
        "given": 0.327,
        "wrong": 0.295,
    },
    "sigma_speed_mps": {
        "given": 4.97,
        "standing": 4.96,
        "moving": 0.393,
    },
}
