"""Weights of the evidence for markings and borders of roads, by kind and the sensors that saw it.

Printed by `tools/fit.py lines` on 400 maps of random roads and plain ground, `tools/fit.py line_maps`.
"""

WEIGHTS: dict[str, dict[str, float]] = {
    "line, camera and LiDAR": {"bias": -0.136, "length": 0.576, "contrast": 0.436, "reflects": 0.404, "outshone": -3.41, "bright_beside":
        -1.75, "dull": -0.676, "crowded": -3.24, "fainter": -6.13, "mid_lane": -3.2, "wide": -7.45},
    "line, camera": {"bias": -1.96, "length": 0.76, "contrast": 0.838, "outshone": -3.88, "varies": -8.0, "bright_beside": -2.04, "dull":
        -1.66, "crowded": -1.45, "fainter": -4.71, "mid_lane": -3.02, "wide": -8.0},
    "line, LiDAR": {"bias": -1.23, "length": 0.597, "dashes": 0.155, "contrast": 1.0, "outshone": -0.357, "bright_beside": -6.68,
        "unresolved": -0.956, "crowded": -1.92, "fainter": -4.92, "mid_lane": -2.16, "wide": -4.51},
    "line, few returns": {"bias": -3.18, "varies": -8.0, "bright_beside": -3.57, "crowded": -1.27, "fainter": -1.38, "mid_lane": -2.42,
        "wide": -2.96},
    "crosswalk, camera": {"bias": -2.4, "length": 0.474, "dashes": 0.98, "contrast": 0.835, "reflects": 0.121, "bright_beside": -1.9,
        "dull": -2.51, "wide": 3.16},
    "crosswalk, LiDAR": {"bias": -5.64, "length": 0.192, "dashes": 0.892, "contrast": 0.641, "reflects": 0.405, "outshone": -1.17,
        "bright_beside": -0.261, "dull": -1.25, "unresolved": -5.23, "wide": 4.93},
    "stop_line, camera": {"bias": -7.93, "length": 3.15, "contrast": 2.17, "reflects": 0.467, "outshone": -1.67, "bright_beside": -1.19,
        "dull": -1.46, "crowded": -2.3, "fainter": -3.86, "mid_lane": -1.95, "no_lane_line": -2.43, "wide": 4.11},
    "stop_line, LiDAR": {"bias": -3.51, "length": 0.31, "reflects": 0.55, "outshone": -1.66, "bright_beside": -0.628, "dull": -0.234,
        "unresolved": -4.21, "crowded": -1.76, "fainter": -1.79, "mid_lane": -1.9, "no_lane_line": -2.78},
    "border, camera and LiDAR": {"bias": -1.92, "length": 0.944, "curb": 1.19},
    "border, camera": {"bias": -3.0},
    "border, LiDAR": {"bias": -3.57, "length": 0.806, "curb": 2.33},
    "other": {"bias": -7.46, "mid_lane": 3.35, "widens": 3.73, "clear": 3.09, "filled": -3.12, "slender": -0.654, "hidden": -5.29},
}  # fmt: skip
