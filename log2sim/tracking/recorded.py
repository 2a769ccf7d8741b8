"""At which ticks the sensors that measured a track recorded nothing, or were not searched."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Track

SWEEPS = ""
"""Represents the LiDARs among the cameras, as in the column `camera` of measurements."""


def mark_unrecorded(tracks: Sequence[Track], recorded: Mapping[str, NDArray[np.bool_]]) -> list[Track]:
    """Return tracks that know at which ticks none of the sensors that measured them recorded, and how often pictures were searched.

    Parameters
    ----------
    tracks : sequence of Track
    recorded : mapping of str to (T,) bool
        Whether a camera, or `SWEEPS` any LiDAR, recorded something usable at each tick.
    """
    return [
        replace(track, unrecorded=_unrecorded(track, recorded), searched=_searched(track, recorded)) for track in tracks
    ]


def _searched(track: Track, recorded: Mapping[str, NDArray[np.bool_]]) -> float:
    """Return at which share of its ticks any camera that measured a track was searched; 1 without a camera."""
    cameras = {str(camera) for camera in track.measurements.camera} - {SWEEPS}
    seen = [recorded[name] for name in cameras if name in recorded]
    return float(np.any(seen, axis=0)[track.tick].mean()) if seen else 1.0


def _unrecorded(track: Track, recorded: Mapping[str, NDArray[np.bool_]]) -> NDArray[np.int64]:
    m = track.measurements
    sensors = {str(camera) for camera in m.camera} - {SWEEPS}
    if np.isfinite(m.box_yaw_rad).any():
        sensors.add(SWEEPS)
    seen = [recorded[name] for name in sensors if name in recorded]
    if not seen:
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(~np.any(seen, axis=0))
