"""How to draw a random road user of a category."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from log2sim.synth.polytopes import Shape
from log2sim.synth.traffic_people import bicycle, cyclist, motorcycle, pedestrian, stroller
from log2sim.synth.traffic_vehicles import bus, car, truck

ROAD_USERS: dict[str, Callable[[np.random.Generator], Shape]] = {
    "car": car,
    "truck": truck,
    "bus": bus,
    "motorcycle": motorcycle,
    "cyclist": cyclist,
    "bicycle": bicycle,
    "pedestrian": pedestrian,
    "other": stroller,
}
"""How to draw a road user of a category."""
