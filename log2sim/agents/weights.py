"""Weights of the evidence (`agents/evidence.py`), with and without a LiDAR, and of systematic errors.

Printed by `tools/fit.py confidence` on the logs of `tools/fit.py confidence_logs FOLDER --logs 120 --seed 11`: 4615 candidates of 120
simulated logs; those without a LiDAR on those of `--logs 110 --seed 12`, after obstacles were placed by all edges of their boxes.
What is `RIGHT` with a LiDAR is of 150 logs, `--logs 80 --seed 13` and `--logs 70 --seed 14`, whose sweeps both stages of the LiDAR detectors had
searched; what is `THERE` on these, too, gives up logs of a single tick. Two reasons that no log misses were taken out since.
`THERE` tells whether something is where a candidate is, `RIGHT` whether a candidate is right
where something is; `VARIANCES` weigh the terms of variances. `CONFIDENCE`, offset and slope of the log-odds of agents by group where
there is a LiDAR, makes them those of being right: `tools/fit.py confidence FOLDER --scales` on 150 logs of seeds 21 and 22; in
the order of vehicles, two-wheelers, people.
"""

THERE = {
    True: {
        "bias": 2.42,
        "sweep": 0.446,
        "weak_sweep": 0.637,
        "image": 0.167,
        "travel": 0.4,
        "few": -2.44,
        "scatter": -0.142,
        "sigma": -0.555,
        "odd_size": -0.346,
        "odd_height": -1.15,
        "other_category": -0.506,
        "through": -2.04,
        "through_gaps": -0.526,
        "continued": -2.47,
        "remains": -0.833,
        "thin": -0.727,
        "moving": 0.391,
        "two_wheeler": -0.784,
        "pedestrian": -0.817,
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

CONFIDENCE = {"vehicle": (-0.164, 1.08), "two_wheeler": (-0.208, 1.23), "pedestrian": (0.163, 1.24)}
