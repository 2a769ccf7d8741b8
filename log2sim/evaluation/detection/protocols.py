"""What counts: the classes and matches of each protocol, and KITTI's difficulties."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import CATEGORIES
from log2sim.evaluation.detection.image_views import ImageViews
from log2sim.evaluation.detection.matching import Criterion

MIN_POINTS = 5
"""True boxes with fewer points are ignored, outside KITTI's difficulties: they show no extent (Waymo's level 1 asks for more
than 5)."""


@dataclass(frozen=True)
class ObjectClass:
    """A class of a protocol.

    Attributes
    ----------
    name : str
    categories : tuple of str
        Categories that make it up; they match freely among each other.
    criteria : tuple of Criterion
        The first one decides in tables.
    ignored_kinds : tuple of str
        The log's own words of true boxes of these categories that are ignored.
    """

    name: str
    categories: tuple[str, ...]
    criteria: tuple[Criterion, ...]
    ignored_kinds: tuple[str, ...] = ()


@dataclass(frozen=True)
class Protocol:
    """A way to evaluate.

    Attributes
    ----------
    name : str
    classes : tuple of ObjectClass
    of_camera : bool
        Whether only boxes count that the reference camera shows, by KITTI's difficulties.
    """

    name: str
    classes: tuple[ObjectClass, ...]
    of_camera: bool = False


@dataclass(frozen=True)
class Difficulty:
    """Limits of a true box; found boxes below the height are ignored.

    Attributes
    ----------
    name : str
    min_height_px : float
    max_occlusion : int
    max_truncation : float
    """

    name: str
    min_height_px: float
    max_occlusion: int
    max_truncation: float

    def ignores_truth(self, views: ImageViews, occlusion: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Mark (L,) the true boxes that are harder than this."""
        low = views.height_px <= self.min_height_px
        return np.asarray(low | (occlusion > self.max_occlusion) | (views.truncation > self.max_truncation))

    def ignores_found(self, views: ImageViews) -> NDArray[np.bool_]:
        """Mark (M,) the found boxes that are too small to be judged."""
        return np.asarray(views.height_px < self.min_height_px)


# Geiger, Lenz, Urtasun (CVPR 2012), and the development kit of the object benchmark.
DIFFICULTIES = (Difficulty("easy", 40, 0, 0.15), Difficulty("moderate", 25, 1, 0.3), Difficulty("hard", 25, 2, 0.5))


def _ious(*limits: float) -> tuple[Criterion, ...]:
    return tuple(Criterion(measure, limit) for limit in limits for measure in ("iou_3d", "iou_bev"))


CENTERS = tuple(Criterion("center_m", limit) for limit in (1.0, 0.5, 2.0, 4.0))
"""nuScenes' distances; the table uses 1 m, about the IoU of 0.5 of a car shifted along its length."""

VEHICLES, PEOPLE, RIDERS = ("car", "truck", "bus"), ("pedestrian",), ("motorcycle", "cyclist")

PROTOCOLS: Mapping[str, Protocol] = {
    "kitti": Protocol(
        "kitti",
        (
            ObjectClass("car", ("car",), _ious(0.7, 0.5), ("Van",)),
            ObjectClass("pedestrian", PEOPLE, _ious(0.5, 0.25), ("Person_sitting", "Person")),
            ObjectClass("cyclist", ("cyclist",), _ious(0.5, 0.25)),
        ),
        of_camera=True,
    ),
    # Yu et al. (CVPR 2022), whose class "Car" is all vehicles and whose "Cyclist" includes motorcycles; and 0.3, which suits
    # small things that are seen from the roadside as well.
    "dair": Protocol(
        "dair",
        (
            ObjectClass("vehicle", VEHICLES, _ious(0.5)),
            ObjectClass("pedestrian", PEOPLE, _ious(0.25, 0.3)),
            ObjectClass("two_wheeler", RIDERS, _ious(0.25, 0.3)),
        ),
    ),
    "center": Protocol(
        "center",
        (
            ObjectClass("vehicle", VEHICLES, CENTERS),
            ObjectClass("pedestrian", PEOPLE, CENTERS),
            ObjectClass("two_wheeler", RIDERS, CENTERS),
            *(ObjectClass(name, (name,), CENTERS) for name in CATEGORIES if name in VEHICLES + RIDERS),
        ),
    ),
}
