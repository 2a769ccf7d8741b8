"""Weights of the evidence (`evidence.Evidence`) and of systematic errors (`systematic`).

Printed by `X`: 1165 agents of 0 synthetic logs.
"""

from __future__ import annotations

BIAS = 1.124
WEIGHTS = {
    "image": 0.0,
    "sweep": 0.2808,
    "both": 0.0,
    "no_sweep": -0.4961,
    "missed": -0.2833,
    "few": 0.0,
    "brief": 0.0,
    "unobserved": 0.0,
    "points": 0.213,
    "blind": -0.1469,
    "range": 0.0,
    "scatter": -0.4992,
    "sigma": -0.5096,
    "speed_sigma": 0.0,
    "yaw_sigma": 0.0,
    "unlikely_size": -0.6786,
    "odd_size": -0.3544,
    "hidden": -1.121,
    "heading": 0.0,
    "askew": -1.181,
    "hardly_moved": -0.6077,
    "other_category": -0.3363,
    "truncated": -0.142,
    "doubts": -0.481,
    "moving": -0.06374,
    "two_wheeler": -0.3022,
    "pedestrian": 0.9643,
    "other": -3.417,
}
POSITION_VARIANCE = {
    "given": 0.7673,
    "given_moving": 2.647,
    "hidden": 0.008762,
    "length": 1e-07,
    "outline": 1e-07,
    "range": 0.0002402,
    "wrong": 0.0324,
}
YAW_VARIANCE = {
    "given": 0.3981,
    "ends": 1e-07,
    "outline": 1e-07,
    "person": 1e-07,
    "wrong": 0.2554,
}
SPEED_VARIANCE = {
    "given": 2.124,
    "change": 4.32e-05,
    "standing": 0.6553,
    "moving": 0.6175,
}
