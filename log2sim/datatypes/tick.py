"""Sweeps, and ticks: what all sensors of a log recorded at one moment, read when it is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes.deferred import Deferred
from log2sim.geometry import Array
from log2sim.numerals import short_repr


@dataclass(frozen=True, eq=False)
class Sweep:
    """One LiDAR sweep.

    Attributes
    ----------
    stamp_ns : int
        Absolute time of the sweep.
    xyz_m : (N, 3) float32 or float64, m
        Finite points in `frame`.
    frame : {"lidar", "map"}
        "lidar": the sensor's frame; "map": already motion-compensated.
    t_ns : (N,) int64 or None
        Absolute stamps at which the points were measured; None when the log has none.
    compensated_ns : int or None
        For the frame "lidar": the stamp of the sensor's pose to which all points are compensated already; None where each
        point is in the sensor's frame at its own time.
    intensity : (N,) float32 or None
        How strong each return is, on the scale of its LiDAR; NaN where the log does not tell. None where the log has none.
    """

    __repr__ = short_repr

    stamp_ns: int
    xyz_m: NDArray[np.floating[Any]]
    frame: Literal["lidar", "map"] = "lidar"
    t_ns: NDArray[np.int64] | None = None
    compensated_ns: int | None = None
    intensity: NDArray[np.float32] | None = None


@dataclass(frozen=True, eq=False)
class Tick:
    """One synchronized moment of a log.

    Attributes
    ----------
    t_ns : int
        Absolute stamp.
    t_s : float, s
        Since the first tick of the log.
    images : mapping of str to (H, W, 3) uint8 BGR
        By camera, without cameras that have no frame near the tick. A frame is decoded when it is asked for, and
        `RecordError` says which one cannot be read.
    sweeps : mapping of str to Sweep
        By LiDAR, likewise.
    image_ns : mapping of str to int
        Absolute stamps of the frames.
    map_T_ego : (4, 4) float64 or None
        Pose of the ego; None where it is not known.
    points : (N, 3) float64, m, map frame
        Of all sweeps, each point where the sensor was at its own time. Made when they are first asked for.
    """

    t_ns: int
    t_s: float
    images: Mapping[str, NDArray[np.uint8]]
    sweeps: Mapping[str, Sweep]
    image_ns: Mapping[str, int]
    map_T_ego: Array | None
    points: Deferred[Array] = Deferred()

    def __repr__(self) -> str:
        """Return the time and the sensors, nothing of which is read."""
        return f"<Tick at {self.t_s:.3f} s: {', '.join([*self.images, *self.sweeps]) or 'no record'}>"
