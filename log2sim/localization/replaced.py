"""A log with other poses of the ego, stamps or mounts: what was measured moves with them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Labels, Log, MapFrame, Stream, Sweep
from log2sim.errors import RecordError
from log2sim.geometry import Array, PoseTrack, apply, inverse, wrap_angle
from log2sim.localization.odometry import TransformAt, move_points


def replace_poses(log: Log, new: PoseTrack) -> Log:
    """Return a log with other poses of the ego; labels and sweeps in the map move with it at their own stamps.

    Sensors that are fixed in the map stay where they are. Labels and points at whose stamps one of the poses is not known are
    left out. Without old poses nothing but the ego is in the map, whose place on Earth then is not known.
    """
    old = log.ego

    def new_T_old(t_ns: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
        map_T_ego, known = new.at(t_ns)
        if old is None:
            return map_T_ego, np.zeros(len(t_ns), dtype=bool)
        before, was_known = old.at(t_ns)
        return map_T_ego @ inverse(before), known & was_known

    def moved(stream: Stream) -> Callable[[int], Sweep]:
        def read(i: int) -> Sweep:
            sweep: Sweep = stream.read(i)
            if sweep.frame != "map":
                return sweep
            times = np.full(len(sweep.xyz_m), sweep.stamp_ns, dtype=np.int64) if sweep.t_ns is None else sweep.t_ns
            xyz_m = move_points(sweep.xyz_m, times, new_T_old)
            if xyz_m is None:
                where = f"stream '{stream.name}', record {i}"
                raise RecordError(
                    f"{where}: no ego pose is known at its stamps, so its points have no place in the map"
                )
            return replace(sweep, xyz_m=xyz_m)

        return read

    streams = {
        name: Stream(name, lambda stream=stream: stream.t_ns, moved(stream), stream.encoded)  # type: ignore[misc]
        if name in log.lidars and log.lidars[name].mount == "ego"
        else stream
        for name, stream in log.streams.items()
    }
    labels = (lambda: log.labels) if old is None else (lambda: _moved_labels(log.labels, new_T_old))
    place = MapFrame() if old is None else log.map
    return replace(log, ego=new, map=place, streams=streams, labels=labels, notes=lambda: log.notes)


def _moved_labels(labels: Labels | None, new_T_old: TransformAt) -> Labels | None:
    """Move labels with the ego; those at whose stamps a pose is not known are left out."""
    if labels is None:
        return None
    poses, known = new_T_old(labels.t_ns)
    k = np.flatnonzero(known)
    heading = np.stack([np.cos(labels.yaw_rad[k]), np.sin(labels.yaw_rad[k]), np.zeros(len(k))], axis=1)
    turned = np.einsum("nij,nj->ni", poses[k, :3, :3], heading)
    moved = labels.take(k)
    yaw_rad = wrap_angle(np.arctan2(turned[:, 1], turned[:, 0]))
    return replace(moved, center_m=apply(poses[k], moved.center_m), yaw_rad=yaw_rad)


def shift_stream(stream: Stream, shift_ns: int, moved: Array | None = None) -> Stream:
    """Return a stream with the stamps of its records and their points moved, and points given in the map moved by a transform (4, 4)."""

    def read(i: int) -> Any:
        record = stream.read(i)
        if not isinstance(record, Sweep):
            return record
        return replace(
            record,
            stamp_ns=int(record.stamp_ns) + shift_ns,
            xyz_m=apply(moved, record.xyz_m) if moved is not None and record.frame == "map" else record.xyz_m,
            t_ns=None if record.t_ns is None else record.t_ns + shift_ns,
            compensated_ns=None if record.compensated_ns is None else int(record.compensated_ns) + shift_ns,
        )

    return Stream(stream.name, lambda: stream.t_ns + shift_ns, read, stream.encoded)
