"""What flows between the stages: sensors, streams, logs, detections.

Everything is a frozen record of columns. Arrays are never changed once a record holds them. Letters in shapes: N points,
M boxes, L labels, A agents, T ticks, F frames of a stream.
"""

from __future__ import annotations

from collections.abc import Mapping

CATEGORIES = ("car", "truck", "bus", "motorcycle", "cyclist", "bicycle", "pedestrian", "other")
"""What an agent can be. A `cyclist` is a bicycle with its rider, a `bicycle` has none; vans are cars."""

GROUPS: Mapping[str, tuple[str, ...]] = {
    "vehicle": ("car", "truck", "bus"),
    "two_wheeler": ("motorcycle", "cyclist", "bicycle"),
    "pedestrian": ("pedestrian",),
    "other": ("other",),
}
"""Categories that detectors and labelers confuse and that are therefore associated with each other."""

GROUP_OF: Mapping[str, str] = {category: group for group, members in GROUPS.items() for category in members}

# Mean length, width, height in m of KITTI's and PandaSet's labels, rounded; used where nothing was measured.
TYPICAL_SIZE_M: Mapping[str, tuple[float, float, float]] = {
    "car": (4.4, 1.85, 1.6),
    "truck": (7.0, 2.4, 2.9),
    "bus": (11.5, 2.7, 3.2),
    "motorcycle": (2.1, 0.8, 1.5),
    "cyclist": (1.75, 0.65, 1.75),
    "bicycle": (1.75, 0.6, 1.1),
    "pedestrian": (0.7, 0.7, 1.75),
    "other": (3.0, 1.8, 1.8),
}
