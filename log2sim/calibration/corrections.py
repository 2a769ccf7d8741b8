"""Corrections of clocks and mounts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from log2sim.calibration.twists import exp_of
from log2sim.datatypes import Stream, Sweep
from log2sim.geometry import Array


def shift_stream(stream: Stream, shift_ns: int) -> Stream:
    """Return the stream of a LiDAR with all stamps moved, those of its points too."""

    def read(i: int) -> Sweep:
        sweep: Sweep = stream.read(i)
        return replace(
            sweep,
            stamp_ns=int(sweep.stamp_ns) + shift_ns,
            t_ns=None if sweep.t_ns is None else sweep.t_ns + shift_ns,
            compensated_ns=None if sweep.compensated_ns is None else int(sweep.compensated_ns) + shift_ns,
        )

    return Stream(stream.name, lambda: stream.t_ns + shift_ns, read)


def turn_mount(mount_T_sensor: Array, turn: Array) -> Array:
    """Rotate a mount (4, 4) about the sensor by a rotation vector (3,), rad, in the frame that it is mounted in."""
    out = mount_T_sensor.copy()
    out[:3, :3] = exp_of(np.concatenate([np.zeros(3), turn]))[:3, :3] @ mount_T_sensor[:3, :3]
    return out
