"""Protocol of a model's output layout, and functions that several layouts share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import ConfigError
from log2sim.geometry import Array
from log2sim.perception.detect.classes import Classes
from log2sim.perception.detect.preprocessing import Preprocessing

Outputs = Mapping[str, NDArray[Any]]


class Candidates(NamedTuple):
    """Decoded boxes before suppression.

    Attributes
    ----------
    box_input : (M, 4) float64
        u0, v0, u1, v1 in px of the model's input.
    score : (M,) float64
    category : (M,) str
    """

    box_input: Array
    score: Array
    category: NDArray[np.str_]


class Layout(Protocol):
    """Output layout of one family of models; `size` is (width, height) of the input in px."""

    @property
    def name(self) -> str:
        """Name by which a user chooses it."""
        ...

    @property
    def preprocessing(self) -> Preprocessing:
        """Preprocessing that the models were trained with."""
        ...

    @property
    def default_min_score(self) -> float:
        """Score in [0, 1] below which boxes are more often wrong than useful."""
        ...

    @property
    def default_classes(self) -> Classes:
        """Classes of a model whose output holds class ids without names."""
        ...

    def matches(self, outputs: Outputs, size: tuple[int, int]) -> bool:
        """Return whether outputs of a gray image have this layout."""
        ...

    def class_count(self, outputs: Outputs) -> int | None:
        """Return the number of classes; None where the output holds class ids."""
        ...

    def decode(self, outputs: Outputs, size: tuple[int, int], classes: Classes, min_score: float) -> Candidates:
        """Decode the boxes of score `min_score` and higher."""
        ...


def corners_from_centers(center_and_size: Array) -> Array:
    """Convert boxes (M, 4) from center u, v, width, height to u0, v0, u1, v1."""
    center, half = center_and_size[:, :2], center_and_size[:, 2:4] / 2
    return np.concatenate([center - half, center + half], axis=1)


def largest_output(outputs: Outputs) -> NDArray[Any]:
    """Return the largest output; some exports append intermediate outputs or masks to the detections."""
    return max(outputs.values(), key=lambda a: a.size)


def single_output_shape(outputs: Outputs) -> tuple[int, int] | None:
    """Return the last two dimensions of a single output (1, a, b); None for other or more outputs."""
    arrays = list(outputs.values())
    if len(arrays) != 1 or arrays[0].ndim != 3 or arrays[0].shape[0] != 1:
        return None
    return arrays[0].shape[1], arrays[0].shape[2]


def find_output(outputs: Outputs, name: str) -> NDArray[Any] | None:
    """Find an output by its name without TensorFlow's ":0"; None if there is none."""
    return next((array for key, array in outputs.items() if key.split(":")[0] == name), None)


def required_output(outputs: Outputs, name: str) -> NDArray[Any]:
    """Return an output by its name, or raise `ConfigError`."""
    array = find_output(outputs, name)
    if array is None:
        raise ConfigError(
            f"the model has no output '{name}'; it has {describe_outputs(outputs)}; choose another layout"
        )
    return array


def describe_outputs(outputs: Outputs) -> str:
    """Format names and shapes of outputs for messages."""
    return ", ".join(f"'{name}' {tuple(array.shape)}" for name, array in outputs.items())
