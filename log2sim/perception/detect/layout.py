"""What a model's output layout has to answer, and the pieces that several layouts share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import ConfigError
from log2sim.geometry import Array
from log2sim.perception.detect.classes import Classes
from log2sim.perception.detect.preparation import Preparation

Outputs = Mapping[str, NDArray[Any]]


class Candidates(NamedTuple):
    """Boxes (M, 4) u0, v0, u1, v1 in px of the model's input, scores (M,), categories (M,)."""

    box_input: Array
    score: Array
    category: NDArray[np.str_]


class Layout(Protocol):
    """One family of models. `size` is (width, height) of the input in px, `outputs` are arrays by name."""

    @property
    def name(self) -> str: ...

    @property
    def preparation(self) -> Preparation: ...

    @property
    def default_min_score(self) -> float: ...

    @property
    def default_classes(self) -> Classes: ...

    def matches(self, outputs: Outputs, size: tuple[int, int]) -> bool:
        """Whether outputs of a gray picture look like this layout."""
        ...

    def class_count(self, outputs: Outputs) -> int | None:
        """Number of classes; None where the output holds class ids."""
        ...

    def decode(self, outputs: Outputs, size: tuple[int, int], classes: Classes, min_score: float) -> Candidates: ...


def corners(center_and_size: Array) -> Array:
    """Boxes (M, 4) u0, v0, u1, v1 from center u, v, width, height."""
    center, half = center_and_size[:, :2], center_and_size[:, 2:4] / 2
    return np.concatenate([center - half, center + half], axis=1)


def only(outputs: Outputs) -> NDArray[Any]:
    """The largest output: some exports append intermediate ones or masks behind the one that counts."""
    return max(outputs.values(), key=lambda a: a.size)


def single(outputs: Outputs) -> tuple[int, int] | None:
    """Last two dimensions of the one output (1, a, b), None where there are more or others."""
    arrays = list(outputs.values())
    if len(arrays) != 1 or arrays[0].ndim != 3 or arrays[0].shape[0] != 1:
        return None
    return arrays[0].shape[1], arrays[0].shape[2]


def select(outputs: Outputs, name: str) -> NDArray[Any] | None:
    """An output by its name, without TensorFlow's ":0"."""
    return next((array for key, array in outputs.items() if key.split(":")[0] == name), None)


def required(outputs: Outputs, name: str) -> NDArray[Any]:
    """An output that the layout cannot do without."""
    array = select(outputs, name)
    if array is None:
        raise ConfigError(f"the model has no output '{name}'; it has {describe(outputs)}; choose another layout")
    return array


def describe(outputs: Outputs) -> str:
    """Names and shapes for messages."""
    return ", ".join(f"'{name}' {tuple(array.shape)}" for name, array in outputs.items())
