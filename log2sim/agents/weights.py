"""Weights of the evidence (`agents/evidence.py`), with and without a LiDAR, and of systematic errors.

Printed by `tools/fit.py confidence` on the logs of `tools/fit.py confidence_logs --seed 11`: 2081 candidates of 60 simulated logs.
`THERE` tells whether something is where a candidate is, which holds for `SHARES` of those; `RIGHT` whether a candidate is right
where something is; `VARIANCES` weigh the terms of variances.
"""

THERE = {
    True: {
        "bias": 2.18,
        "sweep": 0.458,
        "image": 0.292,
        "no_image": -0.313,
        "travel": 0.424,
        "few": -1.83,
        "scatter": -0.118,
        "sigma": -0.424,
        "odd_size": -0.603,
        "odd_height": -0.768,
        "other_category": -0.675,
        "impossible": -0.636,
        "through": -2.39,
        "through_gaps": -0.622,
        "pointless": -0.98,
        "nearer": -1.75,
        "moving": 0.606,
        "two_wheeler": -0.593,
        "pedestrian": -0.397,
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
        "given": 2.07,
        "given_moving": 0.931,
        "hidden": 0.0134,
        "range": 0.000421,
        "wrong": 0.0496,
    },
    "sigma_yaw_rad": {
        "given": 0.436,
        "wrong": 0.353,
    },
    "sigma_speed_mps": {
        "given": 9.54,
        "standing": 5.95,
        "moving": 0.407,
    },
}
SHARES = {True: 0.761, False: 0.503}
