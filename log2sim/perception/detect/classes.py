"""Mapping from the classes of a model to categories of road users and to traffic lights; other classes are dropped."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, GROUPS
from log2sim.errors import ConfigError
from log2sim.geometry import Array

# A train is no road user that a vehicle model could replay, and detectors see one in many a facade.
CATEGORY_OF_NAME: Mapping[str, str] = {
    "car": "car", "van": "car", "pickup": "car", "suv": "car", "vehicle": "car",
    "truck": "truck", "lorry": "truck", "bus": "bus",
    "motorcycle": "motorcycle", "motorbike": "motorcycle", "motorcyclist": "motorcycle", "motor": "motorcycle",
    "bicycle": "bicycle", "bike": "bicycle", "cyclist": "cyclist", "bicyclist": "cyclist", "rider": "cyclist",
    "person": "pedestrian", "pedestrian": "pedestrian", "people": "pedestrian",
    "traffic light": "traffic_light", "traffic_light": "traffic_light", "traffic signal": "traffic_light",
}  # fmt: skip

TRAFFIC_LIGHT = "traffic_light"
"""No road user, but what traffic goes by: a group of its own."""

NAMES_LIMIT_CHARS = 1_000_000


@dataclass(frozen=True)
class Classes:
    """Category of each class index of a model; indices that are left out are no road users."""

    category_of: Mapping[int, str]

    def best(self, class_scores: Array, min_score: float) -> tuple[NDArray[np.intp], Array, NDArray[np.str_]]:
        """Choose categories from scores (N, C): at most one a row and group, so that a rider does not hide the bicycle.

        Parameters
        ----------
        class_scores : (N, C) float
        min_score : float
            Rows whose best score of a group is lower are left out.

        Returns
        -------
        row : (M,) int
        score : (M,) float64
        category : (M,) str
        """
        rows, scores, categories = [], [], []
        # Few rows of thousands reach the score.
        likely = np.unique(np.flatnonzero(np.ravel(class_scores >= min_score)) // max(class_scores.shape[1], 1))
        of_likely = class_scores[likely]
        for members in (*GROUPS.values(), (TRAFFIC_LIGHT,)):
            columns = [i for i, name in self.category_of.items() if name in members and i < class_scores.shape[1]]
            if not columns:
                continue
            part = of_likely[:, columns]
            best = np.argmax(part, axis=1)
            top = part[np.arange(len(part)), best]
            row = np.flatnonzero(top >= min_score)
            rows.append(likely[row])
            scores.append(top[row].astype(np.float64))
            categories.append(np.array([self.category_of[i] for i in columns], dtype="<U16")[best[row]])
        if not rows:
            return np.zeros(0, np.intp), np.zeros(0), np.zeros(0, "<U16")
        return np.concatenate(rows), np.concatenate(scores), np.concatenate(categories)

    def categories_of(self, class_id: NDArray[np.number]) -> NDArray[np.str_]:
        """Return the categories (N,) of class indices (N,), "" where the class is no road user."""
        # Some exporters write ids as floats; NaN has no category.
        return np.array([self.category_of.get(i, "") for i in np.asarray(class_id, float).tolist()], dtype="<U16")


COCO_80 = Classes({0: "pedestrian", 1: "bicycle", 2: "car", 3: "motorcycle", 5: "bus", 7: "truck", 9: TRAFFIC_LIGHT})
COCO_91 = Classes({1: "pedestrian", 2: "bicycle", 3: "car", 4: "motorcycle", 6: "bus", 8: "truck", 10: TRAFFIC_LIGHT})
COCO_90 = Classes({i - 1: category for i, category in COCO_91.category_of.items()})
BY_COUNT: Mapping[int, Classes] = {80: COCO_80, 90: COCO_90, 91: COCO_91}


def choose_classes(names: str | None, count: int | None, default: Classes, where: str) -> Classes:
    """Find out the classes of a model: by the names in its metadata, else by their number.

    Parameters
    ----------
    names
        The entry `names` of the ONNX metadata: a Python literal, list or dict by index, as Ultralytics writes it.
    count
        Number of classes in the output, None where the output holds class ids; then `default` holds.
    where
        The file, for messages.
    """
    if names is not None:
        return classes_from_names(names, where)
    if count is None:
        return default
    if count not in BY_COUNT:
        raise ConfigError(
            f"{where}: {count} classes without names; expected 80, 90 or 91 (COCO), or the entry 'names' in the "
            "model's metadata, such as {0: 'car', 1: 'pedestrian'}"
        )
    return BY_COUNT[count]


def classes_from_names(names: str, where: str) -> Classes:
    """Read a literal list or dict of class names; nothing in it is executed."""
    try:
        if len(names) > NAMES_LIMIT_CHARS:
            raise ValueError(f"{len(names)} characters")
        value = ast.literal_eval(names)
        items = value.items() if isinstance(value, dict) else enumerate(value)
        by_index = {int(i): str(name).strip().lower() for i, name in items}
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError) as error:
        raise ConfigError(f"{where}: metadata 'names' is no list or dict of class names: {error}") from None
    known = {i: CATEGORY_OF_NAME[name] for i, name in by_index.items() if name in CATEGORY_OF_NAME}
    if not set(known.values()) - {TRAFFIC_LIGHT}:
        listed = ", ".join(list(by_index.values())[:8])
        names_known = ", ".join(CATEGORY_OF_NAME)
        raise ConfigError(f"{where}: none of its classes is a road user ({listed}); known: {names_known}")
    return Classes(known)


def groups_of(category: NDArray[np.str_]) -> NDArray[np.str_]:
    """Return the groups (M,) of categories (M,)."""
    return np.array([GROUP_OF.get(name, name) for name in category.tolist()], dtype="<U16")
