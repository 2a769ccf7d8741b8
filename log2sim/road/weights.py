"""Weights of the evidence for markings and borders of roads, by kind and the sensors that saw it.

Printed by `tools/fit.py lines` on 200 maps of random roads and plain ground, `tools/fit.py line_maps`.
"""

WEIGHTS: dict[str, dict[str, float]] = {
    "line, camera and LiDAR": {"bias": 0.305, "length": 0.484, "contrast": 0.667, "reflects": 0.381, "outshone": -2.36, "varies": -2.99,
        "bright_beside": -2.6, "dull": -0.902, "crowded": -2.29, "fainter": -5.5, "wide": -4.54},
    "line, camera": {"bias": -1.96, "length": 0.921, "contrast": 0.461, "outshone": -2.26, "varies": -8.0, "bright_beside": -1.98, "dull":
        -1.55, "crowded": -0.881, "fainter": -3.82, "wide": -3.35},
    "line, LiDAR": {"bias": -0.652, "length": 0.47, "dashes": 0.136, "contrast": 1.13, "outshone": -0.46, "varies": -5.2, "bright_beside":
        -5.21, "unresolved": -1.56, "crowded": -1.19, "fainter": -4.05, "wide": -5.52},
    "line, few returns": {"bias": -2.93, "bright_beside": -3.35, "crowded": -0.85, "fainter": -1.06, "wide": -3.35},
    "crosswalk, camera": {"bias": -1.4, "length": 0.269, "dashes": 0.639, "contrast": 0.693, "reflects": 0.12, "bright_beside": -1.85,
        "dull": -3.07, "wide": 3.6},
    "crosswalk, LiDAR": {"bias": -4.38, "length": 0.115, "dashes": 0.685, "contrast": 0.23, "reflects": 0.358, "outshone": -0.412,
        "bright_beside": -1.83, "dull": -0.633, "unresolved": -4.84, "wide": 2.76},
    "stop_line, camera": {"bias": -6.42, "length": 2.72, "contrast": 1.51, "reflects": 0.607, "outshone": -1.08, "bright_beside": -1.39,
        "dull": -1.63, "crowded": -0.769, "fainter": -2.02, "no_lane_line": -1.61, "wide": 3.15},
    "stop_line, LiDAR": {"bias": -3.56, "length": 0.561, "reflects": 0.44, "outshone": -1.05, "varies": -4.34, "bright_beside": -0.68,
        "dull": -1.15, "unresolved": -4.07, "crowded": -1.2, "fainter": -1.17, "no_lane_line": -2.74, "wide": -0.23},
    "border, camera and LiDAR": {"bias": -2.56, "length": 1.21, "curb": 1.23},
    "border, camera": {"bias": -3.72},
    "border, LiDAR": {"bias": -3.49, "length": 0.921, "curb": 1.88},
    "other": {"bias": -5.12, "widens": 2.51, "clear": 3.16, "filled": -5.13, "slender": -0.624, "hidden": -8.0},
}  # fmt: skip
