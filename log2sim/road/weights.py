"""Weights of the evidence for markings and borders of roads, by kind and the sensors that saw it.

Printed by `tools/fit.py lines` on 400 maps of random roads and plain ground, `tools/fit.py line_maps`.
"""

WEIGHTS: dict[str, dict[str, float]] = {
    "line, camera and LiDAR": {"bias": -0.13, "length": 0.569, "contrast": 0.447, "reflects": 0.411, "outshone": -3.44, "bright_beside":
        -1.76, "dull": -0.681, "crowded": -3.28, "fainter": -5.21, "mid_lane": -3.01, "wide": -7.25},
    "line, camera": {"bias": -2.0, "length": 0.769, "contrast": 0.857, "outshone": -3.89, "varies": -8.0, "bright_beside": -2.03, "dull":
        -1.65, "crowded": -1.53, "fainter": -4.25, "mid_lane": -2.53, "wide": -8.0},
    "line, LiDAR": {"bias": -1.22, "length": 0.593, "dashes": 0.159, "contrast": 1.01, "outshone": -0.321, "bright_beside": -6.69,
        "unresolved": -1.03, "crowded": -2.09, "fainter": -4.31, "mid_lane": -5.81, "wide": -4.49},
    "line, few returns": {"bias": -3.22, "varies": -8.0, "bright_beside": -3.59, "crowded": -1.5, "fainter": -0.606, "mid_lane": -4.31,
        "wide": -2.94},
    "crosswalk, camera": {"bias": -3.94, "length": 0.721, "dashes": 1.23, "contrast": 0.929, "reflects": 0.135, "bright_beside": -1.5,
        "dull": -1.93, "wide": 3.32},
    "crosswalk, LiDAR": {"bias": -5.55, "length": 0.181, "dashes": 0.884, "contrast": 0.721, "reflects": 0.358, "outshone": -1.09,
        "bright_beside": -0.271, "dull": -1.13, "unresolved": -4.97, "wide": 4.85},
    "stop_line, camera": {"bias": -7.95, "length": 3.15, "contrast": 2.18, "reflects": 0.468, "outshone": -1.68, "bright_beside": -1.2,
        "dull": -1.46, "crowded": -2.35, "fainter": -3.64, "no_lane_line": -2.43, "wide": 4.1},
    "stop_line, LiDAR": {"bias": -3.5, "length": 0.291, "reflects": 0.553, "outshone": -1.64, "bright_beside": -0.632, "dull": -0.264,
        "unresolved": -4.24, "crowded": -1.9, "fainter": -1.08, "no_lane_line": -2.8},
    "border, camera and LiDAR": {"bias": -1.95, "length": 0.949, "curb": 1.2},
    "border, camera": {"bias": -3.0},
    "border, LiDAR": {"bias": -3.58, "length": 0.811, "curb": 2.32},
    "other": {"bias": -7.21, "mid_lane": 3.84, "widens": 3.68, "clear": 3.09, "filled": -3.24, "slender": -0.771, "hidden": -5.43},
}  # fmt: skip
