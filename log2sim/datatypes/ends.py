"""Ends of a cooperative log: sensors on the vehicle and sensors at the road (Chen, "Vehicle-Road Cooperation")."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes.log import Lidar
from log2sim.geometry import Camera

VEHICLE, ROAD = "vehicle", "road"
ENDS = (VEHICLE, ROAD)
"""The ends in the order of the columns of `seen_by`."""

Span = tuple[float, float]
"""First and last time, s."""


def end_of(sensor: Camera | Lidar) -> str:
    """Return the end that a sensor belongs to: the vehicle's if it is mounted on the ego, else the road's."""
    return VEHICLE if sensor.mount == "ego" else ROAD


def seen_from(end: str, count: int) -> NDArray[np.bool_]:
    """Return (count, 2) for rows that one end alone saw; no end for an empty name."""
    return np.tile([end == name for name in ENDS], (count, 1))


def retime_spans(
    observed_by: Mapping[str, tuple[Span, ...]], change: Callable[[float], float], *, begin_s: float = -np.inf
) -> dict[str, tuple[Span, ...]]:
    """Put the spans of each end elsewhere in time by `change`, s to s; what ends before `begin_s` is left out."""
    moved = {end: [(change(first), change(last)) for first, last in spans] for end, spans in observed_by.items()}
    return {
        end: tuple((max(first, begin_s), last) for first, last in spans if last >= begin_s)
        for end, spans in moved.items()
    }
