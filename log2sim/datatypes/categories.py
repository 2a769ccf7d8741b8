"""What an agent can be: one table with the sizes and motions of each category, and where they are from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Size = tuple[float, float, float]


@dataclass(frozen=True)
class Category:
    """What is known of a category before anything was measured; sizes are length, width, height in m."""

    group: str  # of categories that detectors and labelers confuse, which are therefore associated with each other
    typical_size_m: Size  # of an object that was not observed from end to end
    min_size_m: Size  # a smaller object was hardly observed whole, a larger one than `max_size_m` is several objects
    max_size_m: Size
    max_speed_mps: float  # what is faster is hardly one
    max_length_per_height: float = float("inf")  # longest side as a share of the height
    # Least horizontal length that points show, where less than `min_size_m`: bodies are round, sparse rays miss their ends
    min_seen_m: float | None = None


# Typical sizes lie between the mean labels of KITTI and nuScenes, which are the anchors of PointPillars (Lang et al., CVPR
# 2019: car 3.9, 1.6, 1.56; pedestrian 0.8, 0.6, 1.73; cyclist 1.76, 0.6, 1.73) and CBGS (Zhu et al., 2019: car 4.63, 1.97,
# 1.74; truck 6.93, 2.51, 2.84; bus 10.5, 2.94, 3.47; motorcycle 2.11, 0.77, 1.47; bicycle 1.7, 0.6, 1.28; pedestrian 0.73,
# 0.67, 1.77). Limits:
# - car, vans included: Smart Fortwo 2.7 m, sports cars 1.2 m high; Mercedes Sprinter up to 6.0 x 2.0 x 2.8 m without mirrors.
# - truck, bus: Directive 96/53/EC, Annex I allows 18.75 m for road trains and articulated buses, 2.6 m of width, which
#   mirrors and loads exceed in the cloud, and 4.0 m of height. Britain's double-deckers have 4.4 m. North America's semi-
#   trailers have 22.4 m (AASHTO, "Green Book" 2018, design vehicle WB-67).
# - motorcycle: Regulation (EU) 168/2013, Annex II allows 4.0 x 2.0 x 2.5 m, of which two-wheelers use less.
# - cyclist, bicycle: DIN 79008 and the like; tandems and cargo bicycles have up to 2.6 m.
# - pedestrian: body depth and shoulder breadth of adults (DIN 33402-2) and the stride of a tall one; children from 1 m;
#   a stride and swinging arms make a person at most 0.8 times as long as tall (step lengths: Winter, "Biomechanics and Motor
#   Control of Human Movement"). A body seen from the side shows its depth, from 0.2 m; posts are thinner. A bicycle seen from
#   behind shows the shoulders or the handlebar, from 0.4 m, less the gap between rays at either end.
# - other: trailers, 12 m by the same directive; carts and animals.
# Speeds: cars 250 km/h, to which most makers limit them; trucks and buses 140 km/h, Texas' limit of 85 mph; motorcycles 300
# km/h, to which makers limit them; cyclists 72 km/h, about a track sprinter's best; a bicycle without a rider is pushed; people
# sprint at 6 to 8 m/s, trained ones faster (Weyand et al., J. Appl. Physiol. 89, 2000); trailers as trucks.
CATEGORY: Mapping[str, Category] = {
    "car": Category("vehicle", (4.4, 1.85, 1.6), (2.7, 1.35, 1.2), (6.0, 2.3, 2.8), 70.0),
    "truck": Category("vehicle", (7.0, 2.4, 2.9), (4.5, 1.7, 2.0), (22.4, 3.0, 4.3), 39.0),
    "bus": Category("vehicle", (11.5, 2.7, 3.2), (5.5, 1.9, 2.3), (18.75, 3.0, 4.4), 39.0),
    "motorcycle": Category("two_wheeler", (2.1, 0.8, 1.5), (1.3, 0.5, 0.9), (2.8, 1.3, 2.2), 83.0, min_seen_m=0.25),
    "cyclist": Category("two_wheeler", (1.75, 0.65, 1.75), (1.1, 0.4, 1.1), (2.6, 1.1, 2.3), 20.0, min_seen_m=0.25),
    "bicycle": Category("two_wheeler", (1.75, 0.6, 1.1), (1.1, 0.4, 0.7), (2.6, 1.1, 1.5), 3.0, min_seen_m=0.25),
    "pedestrian": Category(
        "pedestrian", (0.7, 0.7, 1.75), (0.4, 0.4, 1.0), (1.4, 1.2, 2.3), 8.0, max_length_per_height=0.8, min_seen_m=0.2
    ),
    "other": Category("other", (3.0, 1.8, 1.8), (0.5, 0.4, 0.4), (12.0, 3.0, 4.0), 39.0),
}

CATEGORIES = tuple(CATEGORY)
"""What an agent can be. A `cyclist` is a bicycle with its rider, a `bicycle` has none; vans are cars."""

GROUP_OF: Mapping[str, str] = {name: category.group for name, category in CATEGORY.items()}

GROUPS: Mapping[str, tuple[str, ...]] = {
    group: tuple(name for name in CATEGORIES if GROUP_OF[name] == group) for group in dict.fromkeys(GROUP_OF.values())
}
"""Categories that detectors and labelers confuse and that are therefore associated with each other."""


def groups_of(category: NDArray[np.str_]) -> NDArray[np.str_]:
    """Return the groups (M,) of categories (M,); what is no category, as a traffic light, stays as it is."""
    return np.array([GROUP_OF.get(name, name) for name in category.tolist()], dtype="<U16")


TYPICAL_SIZE_M: Mapping[str, Size] = {name: category.typical_size_m for name, category in CATEGORY.items()}
MIN_SIZE_M: Mapping[str, Size] = {name: category.min_size_m for name, category in CATEGORY.items()}
MAX_SPEED_MPS: Mapping[str, float] = {name: category.max_speed_mps for name, category in CATEGORY.items()}
MAX_SIZE_M: Mapping[str, Size] = {name: category.max_size_m for name, category in CATEGORY.items()}

# Groups of which a detector takes one for the other now and then: a rider for a pedestrian.
RELATED_GROUPS = (("pedestrian", "two_wheeler"), ("two_wheeler", "pedestrian"))
# Standard deviation of the speed where only the group is known. A bicycle stands, unless its rider was missed.
FIRST_SPEED_MPS = {"vehicle": 8.0, "two_wheeler": 4.0, "pedestrian": 1.5, "other": 3.0, "bicycle": 1.0}
# Beyond these a vehicle's motion is infeasible for Waymax (Gulino et al., 2023).
MAX_ACCELERATION_MPS2 = 10.4
MAX_CURVATURE_1PM = 0.3
# Tires on dry asphalt hold about 0.9 g laterally.
MAX_LATERAL_MPS2 = 8.8
