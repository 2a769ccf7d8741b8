"""Weights of the evidence (`agents/evidence.py`), with and without a LiDAR, and of systematic errors.

Printed by `tools/fit.py confidence` on the logs of `tools/fit.py confidence_logs FOLDER --logs 120 --seed 11`: 4501 candidates of 120 simulated logs.
`THERE` tells whether something is where a candidate is, `RIGHT` whether a candidate is right
where something is; `VARIANCES` weigh the terms of variances.
"""

THERE = {
    True: {
        "bias": 2.0,
        "sweep": 0.499,
        "weak_sweep": 0.521,
        "image": 0.204,
        "no_image": -0.461,
        "travel": 0.55,
        "few": -1.51,
        "scatter": -0.128,
        "sigma": -0.43,
        "unlikely_size": -0.176,
        "odd_size": -0.312,
        "odd_height": -1.95,
        "other_category": -1.06,
        "impossible": -0.832,
        "through": -0.765,
        "through_gaps": -0.365,
        "continued": -2.16,
        "remains": -0.855,
        "thin": -1.51,
        "missing": -0.613,
        "moving": 0.705,
        "two_wheeler": -0.576,
        "pedestrian": -0.179,
    },
    False: {
        "bias": 2.33,
        "image": 0.101,
        "scatter": -0.31,
        "sigma": -0.834,
        "odd_height": -1.6,
        "other_category": -1.13,
        "moving": -0.959,
        "two_wheeler": -0.3,
    },
}
RIGHT = {
    True: {
        "bias": 1.57,
        "brief": -0.816,
        "scatter": -0.367,
        "sigma": -0.642,
        "unlikely_size": -0.725,
        "odd_size": -0.609,
        "heading": 0.399,
        "other_category": -1.78,
        "impossible": -1.13,
        "sigma_speed": -0.685,
        "through_gaps": -0.71,
        "continued": -0.644,
        "remains": -0.585,
        "moving": -0.888,
        "two_wheeler": -0.208,
        "pedestrian": 0.251,
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
        "given": 2.56,
        "given_moving": 0.186,
        "hidden": 0.0127,
        "range": 0.00476,
        "wrong": 0.0401,
    },
    "sigma_yaw_rad": {
        "given": 0.316,
        "wrong": 0.298,
    },
    "sigma_speed_mps": {
        "given": 4.89,
        "standing": 5.09,
        "moving": 0.394,
    },
}
