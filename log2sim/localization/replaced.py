"""A log with other poses of the ego: what the ego measured moves with them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Labels, Log, Stream, Sweep
from log2sim.errors import RecordError
from log2sim.geometry import Array, PoseTrack, apply, inverse, wrap_angle
from log2sim.localization.odometry import move_points


@dataclass(frozen=True, eq=False)
class Replacement:
    """Poses of the ego that replace others.

    Attributes
    ----------
    old : PoseTrack or None
        None where the log has no poses; then nothing but the ego is in its map.
    """

    old: PoseTrack | None
    new: PoseTrack

    def new_T_old(self, t_ns: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
        """Compute where the map of the old poses lies in that of the new ones, for what the ego measured at stamps (N,).

        Returns
        -------
        new_T_old : (N, 4, 4) float64
        known : (N,) bool
            Whether both poses are known.
        """
        new, known = self.new.at(t_ns)
        if self.old is None:
            return new, np.zeros(len(t_ns), dtype=bool)
        old, was_known = self.old.at(t_ns)
        return new @ inverse(old), known & was_known


def replace_poses(log: Log, new: PoseTrack) -> Log:
    """Return a log with other poses of the ego; labels and sweeps in the map move with it at their own stamps.

    Sensors that are fixed in the map stay where they are. Labels and points at whose stamps one of the poses is not known are
    left out.
    """
    change = Replacement(log.ego, new)
    streams = {
        name: _moved_stream(stream, change) if name in log.lidars and log.lidars[name].mount == "ego" else stream
        for name, stream in log.streams.items()
    }
    return replace(
        log, ego=new, streams=streams, labels=lambda: moved_labels(log.labels, change), notes=lambda: log.notes
    )


def moved_labels(labels: Labels | None, change: Replacement) -> Labels | None:
    """Move labels with the ego; those at whose stamps a pose is not known are left out."""
    if labels is None or change.old is None:
        return labels
    new_T_old, known = change.new_T_old(labels.t_ns)
    k = np.flatnonzero(known)
    heading = np.stack([np.cos(labels.yaw_rad[k]), np.sin(labels.yaw_rad[k]), np.zeros(len(k))], axis=1)
    turned = np.einsum("nij,nj->ni", new_T_old[k, :3, :3], heading)

    def rows(column: NDArray[Any] | None) -> Any:
        return None if column is None else column[k]

    return Labels(
        labels.t_ns[k],
        labels.track_id[k],
        labels.category[k],
        apply(new_T_old[k], labels.center_m[k]),
        labels.size_m[k],
        wrap_angle(np.arctan2(turned[:, 1], turned[:, 0])),
        rows(labels.visible),
        labels.cameras,
        rows(labels.kind),
        rows(labels.occlusion),
        labels.labeled_ns,
        labels.never_labeled,
    )


def _moved_stream(stream: Stream, change: Replacement) -> Stream:
    def read(i: int) -> Sweep:
        sweep: Sweep = stream.read(i)
        return sweep if sweep.frame != "map" else _moved_sweep(sweep, change, f"stream '{stream.name}', record {i}")

    return Stream(stream.name, lambda: stream.t_ns, read, stream.encoded)


def _moved_sweep(sweep: Sweep, change: Replacement, where: str) -> Sweep:
    times = np.full(len(sweep.xyz_m), sweep.stamp_ns, dtype=np.int64) if sweep.t_ns is None else sweep.t_ns
    moved = move_points(sweep.xyz_m, times, change.new_T_old)
    if moved is None:
        raise RecordError(f"{where}: no ego pose is known at its stamps, so its points have no place in the map")
    return replace(sweep, xyz_m=moved)
