"""Weights of the evidence (`agents/evidence.py`), with and without a LiDAR, and of systematic errors.

Printed by `tools/fit.py confidence` on the logs of `tools/fit.py confidence_logs --logs 120 --seed 11`: 4487 candidates of 120 simulated logs.
`THERE` tells whether something is where a candidate is, `RIGHT` whether a candidate is right
where something is; `VARIANCES` weigh the terms of variances.
"""

THERE = {
    True: {
        "bias": 1.95,
        "sweep": 0.506,
        "weak_sweep": 0.6,
        "image": 0.203,
        "no_image": -0.47,
        "travel": 0.526,
        "few": -1.61,
        "scatter": -0.0859,
        "sigma": -0.443,
        "unlikely_size": -0.167,
        "odd_size": -0.266,
        "odd_height": -1.87,
        "other_category": -1.07,
        "impossible": -0.709,
        "through": -1.85,
        "through_gaps": -0.812,
        "continued": -2.46,
        "missing": -0.506,
        "moving": 0.597,
        "two_wheeler": -0.539,
        "pedestrian": -0.443,
    },
    False: {
        "bias": 2.32,
        "image": 0.1,
        "scatter": -0.311,
        "sigma": -0.825,
        "odd_height": -1.66,
        "other_category": -1.12,
        "moving": -0.965,
        "two_wheeler": -0.293,
    },
}
RIGHT = {
    True: {
        "bias": 1.6,
        "brief": -0.8,
        "scatter": -0.367,
        "sigma": -0.648,
        "unlikely_size": -0.657,
        "odd_size": -0.629,
        "heading": 0.403,
        "other_category": -1.86,
        "impossible": -1.26,
        "sigma_speed": -0.761,
        "through": -0.929,
        "through_gaps": -1.49,
        "continued": -0.819,
        "moving": -0.973,
        "two_wheeler": -0.151,
        "pedestrian": 0.273,
    },
    False: {
        "bias": 1.24,
        "brief": -1.3,
        "scatter": -0.243,
        "sigma": -0.419,
        "odd_height": -2.16,
        "heading": 0.214,
        "other_category": -2.07,
        "sigma_speed": -0.272,
        "moving": -1.22,
        "two_wheeler": 0.591,
        "pedestrian": 1.6,
    },
}
VARIANCES = {
    "sigma_xy_m": {
        "given": 2.46,
        "given_moving": 0.295,
        "hidden": 0.0128,
        "range": 0.00466,
        "wrong": 0.038,
    },
    "sigma_yaw_rad": {
        "given": 0.319,
        "wrong": 0.299,
    },
    "sigma_speed_mps": {
        "given": 5.09,
        "standing": 4.7,
        "moving": 0.381,
    },
}
