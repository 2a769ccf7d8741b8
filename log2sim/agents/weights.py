"""placeholder"""

THERE = {True: {"bias": 0.0}, False: {"bias": 0.0}}
RIGHT = {True: {"bias": 0.0}, False: {"bias": 0.0}}
VARIANCES = {
    "sigma_xy_m": {"given": 1.599, "given_moving": 1.009, "hidden": 0.003781, "range": 0.0001366, "wrong": 0.04673},
    "sigma_yaw_rad": {"given": 0.25, "wrong": 0.2422},
    "sigma_speed_mps": {"given": 4.335, "standing": 5.145, "moving": 0.3874},
}
