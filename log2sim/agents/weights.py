"""Weights of the evidence (`agents/evidence.py`), with and without a LiDAR, and of systematic errors.

Printed by `tools/fit.py confidence` on the logs of `tools/fit.py confidence_logs --logs 120 --seed 11`: 4488 candidates of 120 simulated logs.
`THERE` tells whether something is where a candidate is, `RIGHT` whether a candidate is right
where something is; `VARIANCES` weigh the terms of variances.
"""

THERE = {
    True: {
        "bias": 1.92,
        "sweep": 0.511,
        "weak_sweep": 0.583,
        "image": 0.194,
        "no_image": -0.476,
        "travel": 0.515,
        "few": -1.57,
        "scatter": -0.0919,
        "sigma": -0.448,
        "unlikely_size": -0.164,
        "odd_size": -0.281,
        "odd_height": -1.74,
        "other_category": -0.988,
        "impossible": -0.822,
        "through": -0.813,
        "through_gaps": -0.443,
        "continued": -2.56,
        "missing": -0.525,
        "moving": 0.604,
        "two_wheeler": -0.537,
        "pedestrian": -0.418,
    },
    False: {
        "bias": 2.33,
        "image": 0.101,
        "scatter": -0.308,
        "sigma": -0.833,
        "odd_height": -1.61,
        "other_category": -1.13,
        "moving": -0.958,
        "two_wheeler": -0.302,
    },
}
RIGHT = {
    True: {
        "bias": 1.59,
        "brief": -0.749,
        "scatter": -0.379,
        "sigma": -0.638,
        "unlikely_size": -0.701,
        "odd_size": -0.626,
        "heading": 0.398,
        "other_category": -1.76,
        "impossible": -1.15,
        "sigma_speed": -0.75,
        "through_gaps": -0.72,
        "continued": -0.811,
        "moving": -0.97,
        "two_wheeler": -0.192,
        "pedestrian": 0.243,
    },
    False: {
        "bias": 1.23,
        "brief": -1.29,
        "scatter": -0.244,
        "sigma": -0.42,
        "odd_height": -2.14,
        "heading": 0.21,
        "other_category": -2.04,
        "sigma_speed": -0.273,
        "moving": -1.22,
        "two_wheeler": 0.598,
        "pedestrian": 1.59,
    },
}
VARIANCES = {
    "sigma_xy_m": {
        "given": 2.48,
        "given_moving": 0.324,
        "hidden": 0.0126,
        "range": 0.00473,
        "wrong": 0.0377,
    },
    "sigma_yaw_rad": {
        "given": 0.322,
        "wrong": 0.295,
    },
    "sigma_speed_mps": {
        "given": 4.98,
        "standing": 4.9,
        "moving": 0.391,
    },
}
