"""Weights of the evidence (`agents/evidence.py`), with and without a LiDAR, and of systematic errors.

Printed by `tools/fit.py confidence` on the logs of `tools/fit.py confidence_logs --seed 11`: 2081 candidates of 60 simulated logs.
`THERE` tells whether something is where a candidate is, which holds for `SHARES` of those; `RIGHT` whether a candidate is right
where something is; `VARIANCES` weigh the terms of variances.
"""

THERE = {
    True: {
        "bias": 2.15,
        "sweep": 0.448,
        "image": 0.266,
        "no_image": -0.279,
        "travel": 0.381,
        "few": -1.87,
        "scatter": -0.147,
        "sigma": -0.379,
        "odd_size": -0.468,
        "odd_height": -0.871,
        "other_category": -0.633,
        "impossible": -0.705,
        "through": -2.31,
        "through_gaps": -0.585,
        "pointless": -1.08,
        "nearer": -1.73,
        "moving": 0.615,
        "two_wheeler": -0.48,
        "pedestrian": -0.138,
    },
    False: {
        "bias": 2.8,
        "image": 0.0768,
        "scatter": -0.232,
        "sigma": -1.06,
        "odd_height": -1.25,
        "other_category": -0.997,
        "moving": -1.15,
        "two_wheeler": -0.552,
        "pedestrian": -0.154,
    },
}
RIGHT = {
    True: {
        "bias": 1.52,
        "brief": -0.634,
        "range": -0.332,
        "scatter": -0.404,
        "sigma": -0.567,
        "unlikely_size": -0.835,
        "odd_size": -0.445,
        "heading": 0.439,
        "other_category": -1.53,
        "impossible": -1.16,
        "sigma_speed": -0.735,
        "through": -1.28,
        "through_gaps": -3.36,
        "moving": -1.1,
        "two_wheeler": -0.169,
        "pedestrian": 0.487,
    },
    False: {
        "bias": 1.29,
        "brief": -1.31,
        "scatter": -0.17,
        "sigma": -0.458,
        "odd_height": -2.08,
        "heading": 0.145,
        "other_category": -2.38,
        "sigma_speed": -0.348,
        "moving": -0.833,
        "two_wheeler": 0.659,
        "pedestrian": 1.33,
    },
}
VARIANCES = {
    "sigma_xy_m": {
        "given": 2.09,
        "given_moving": 1.02,
        "hidden": 0.0131,
        "range": 0.000441,
        "wrong": 0.0476,
    },
    "sigma_yaw_rad": {
        "given": 0.444,
        "wrong": 0.359,
    },
    "sigma_speed_mps": {
        "given": 9.26,
        "standing": 5.92,
        "moving": 0.405,
    },
}
SHARES = {True: 0.759, False: 0.503}
