"""Weights of the evidence (`agents/evidence.py`), with and without a LiDAR, and of systematic errors.

Printed by `tools/fit.py confidence` on the logs of `tools/fit.py confidence_logs FOLDER --logs 120 --seed 11`: 4557 candidates of 120 simulated logs.
`THERE` tells whether something is where a candidate is, `RIGHT` whether a candidate is right
where something is; `VARIANCES` weigh the terms of variances.
"""

THERE = {
    True: {
        "bias": 2.09,
        "sweep": 0.467,
        "weak_sweep": 0.542,
        "image": 0.249,
        "no_image": -0.218,
        "travel": 0.417,
        "few": -2.57,
        "scatter": -0.077,
        "sigma": -0.506,
        "unlikely_size": -0.162,
        "odd_size": -0.47,
        "odd_height": -1.48,
        "impossible": -0.714,
        "through": -1.74,
        "through_gaps": -0.182,
        "continued": -1.47,
        "remains": -0.884,
        "thin": -1.11,
        "missing": -0.284,
        "moving": 0.603,
        "two_wheeler": -0.58,
        "pedestrian": -0.557,
    },
    False: {
        "bias": 2.17,
        "image": 0.176,
        "scatter": -0.553,
        "sigma": -0.815,
        "odd_height": -1.3,
        "other_category": -1.12,
        "impossible": -1.63,
        "moving": -1.03,
    },
}
RIGHT = {
    True: {
        "bias": 1.48,
        "brief": -0.625,
        "scatter": -0.407,
        "sigma": -0.8,
        "unlikely_size": -0.764,
        "odd_size": -0.681,
        "odd_height": -1.55,
        "heading": 0.434,
        "impossible": -1.12,
        "sigma_speed": -0.495,
        "through": -0.97,
        "through_gaps": -0.274,
        "continued": -0.837,
        "remains": -0.655,
        "moving": -1.13,
        "two_wheeler": -0.893,
        "pedestrian": 0.283,
    },
    False: {
        "bias": -0.00431,
        "scatter": -0.121,
        "odd_height": -1.59,
        "heading": 0.205,
        "other_category": -2.95,
        "impossible": -1.87,
        "sigma_speed": -0.582,
        "moving": -0.902,
        "two_wheeler": 0.701,
        "pedestrian": 1.84,
    },
}
VARIANCES = {
    "sigma_xy_m": {
        "given": 3.63,
        "given_moving": 2.75e-05,
        "hidden": 0.00404,
        "range": 0.00503,
        "wrong": 0.0398,
    },
    "sigma_yaw_rad": {
        "given": 0.441,
        "wrong": 0.236,
    },
    "sigma_speed_mps": {
        "given": 12.6,
        "standing": 2.21,
        "moving": 1.24,
    },
}
