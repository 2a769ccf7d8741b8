"""Weights of the evidence (`agents/evidence.py`), with and without a LiDAR, and of systematic errors.

Printed by `tools/fit.py confidence`. Those with a LiDAR are of 6362 candidates of 150 simulated logs (`tools/fit.py confidence_logs FOLDER --logs 80
--seed 13`, `--logs 70 --seed 14`), whose sweeps both stages of the LiDAR detectors had searched; those without of `--logs 110 --seed 12`, after obstacles
were placed by all edges of their boxes; those of variances of `--logs 120 --seed 11`.
`THERE` tells whether something is where a candidate is, `RIGHT` whether a candidate is right
where something is; `VARIANCES` weigh the terms of variances.
"""

THERE = {
    True: {
        "bias": 2.76,
        "sweep": 0.537,
        "weak_sweep": 0.628,
        "image": 0.171,
        "no_image": -0.592,
        "travel": 0.121,
        "few": -4.31,
        "scatter": -0.163,
        "sigma": -0.343,
        "unlikely_size": -0.487,
        "odd_size": -0.397,
        "odd_height": -2.76,
        "other_category": -1.27,
        "through": -1.66,
        "through_gaps": -0.489,
        "continued": -1.63,
        "remains": -1.02,
        "thin": -0.298,
        "missing": -0.295,
        "moving": 0.823,
        "two_wheeler": -0.213,
        "pedestrian": -0.628,
    },
    False: {
        "bias": 1.95,
        "image": 0.312,
        "scatter": -0.533,
        "sigma": -0.718,
        "odd_height": -1.86,
        "other_category": -2.12,
        "moving": -0.818,
        "two_wheeler": 0.145,
        "pedestrian": 0.499,
    },
}

RIGHT = {
    True: {
        "bias": 1.27,
        "brief": -0.443,
        "scatter": -0.389,
        "sigma": -0.705,
        "unlikely_size": -0.64,
        "odd_size": -0.504,
        "odd_height": -1.76,
        "heading": 0.602,
        "other_category": -0.356,
        "impossible": -0.574,
        "sigma_speed": -0.952,
        "through": -0.927,
        "through_gaps": -0.942,
        "continued": -0.613,
        "remains": -0.946,
        "moving": -1.56,
        "two_wheeler": -0.246,
        "pedestrian": 1.46,
    },
    False: {
        "bias": 0.337,
        "brief": -0.736,
        "scatter": -0.181,
        "sigma": -0.0638,
        "odd_height": -1.9,
        "heading": 0.148,
        "other_category": -1.59,
        "sigma_speed": -0.608,
        "moving": -0.205,
        "pedestrian": 1.94,
    },
}

VARIANCES = {
    "sigma_xy_m": {"given": 3.38, "given_moving": 0.776, "hidden": 0.000732, "range": 0.00563, "wrong": 0.0427},
    "sigma_yaw_rad": {"given": 0.25, "wrong": 0.244},
    "sigma_speed_mps": {"given": 10.1, "standing": 1.57, "moving": 0.27},
}
