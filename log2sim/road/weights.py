"""Weights of the evidence for markings and borders of roads, by kind and the sensors that saw it.

Printed by `tools/fit.py lines` on 240 maps of random roads and plain ground, `tools/fit.py line_maps`.
"""

WEIGHTS: dict[str, dict[str, float]] = {
    "line, camera and LiDAR": {"bias": -0.369, "length": 0.742, "contrast": 0.352, "reflects": 0.461, "outshone": -2.46, "varies": -3.08,
        "bright_beside": -2.28, "dull": -1.05, "crowded": -1.95, "fainter": -5.74, "wide": -5.43},
    "line, camera": {"bias": -2.46, "length": 1.1, "contrast": 0.234, "outshone": -2.24, "varies": -8.0, "bright_beside": -1.67, "dull":
        -1.58, "crowded": -0.648, "fainter": -3.89, "wide": -4.61},
    "line, LiDAR": {"bias": -0.652, "length": 0.47, "dashes": 0.136, "contrast": 1.13, "outshone": -0.46, "varies": -5.2, "bright_beside":
        -5.21, "unresolved": -1.56, "crowded": -1.19, "fainter": -4.05, "wide": -5.52},
    "line, few returns": {"bias": -2.93, "bright_beside": -3.34, "crowded": -0.848, "fainter": -1.08, "wide": -3.35},
    "crosswalk, camera": {"bias": -2.11, "length": 0.478, "dashes": 0.737, "contrast": 0.317, "reflects": 0.17, "bright_beside": -1.55,
        "dull": -1.78, "wide": 3.3},
    "crosswalk, LiDAR": {"bias": -4.38, "length": 0.115, "dashes": 0.685, "contrast": 0.229, "reflects": 0.358, "outshone": -0.412,
        "bright_beside": -1.83, "dull": -0.633, "unresolved": -4.84, "wide": 2.76},
    "stop_line, camera": {"bias": -8.01, "length": 3.19, "contrast": 2.06, "reflects": 0.709, "outshone": -1.4, "bright_beside": -1.1,
        "dull": -1.07, "crowded": -1.83, "fainter": -3.35, "no_lane_line": -1.58, "wide": 3.12},
    "stop_line, LiDAR": {"bias": -3.56, "length": 0.561, "reflects": 0.44, "outshone": -1.05, "varies": -4.34, "bright_beside": -0.68,
        "dull": -1.15, "unresolved": -4.07, "crowded": -1.2, "fainter": -1.17, "no_lane_line": -2.74, "wide": -0.23},
    "border, camera and LiDAR": {"bias": -2.36, "length": 1.15, "curb": 1.14},
    "border, camera": {"bias": -3.69},
    "border, LiDAR": {"bias": -3.73, "length": 1.11, "curb": 1.71},
    "other": {"bias": -6.2, "widens": 2.69, "clear": 3.62, "filled": -5.51, "slender": -0.606, "hidden": -8.0},
}  # fmt: skip
