"""Ignore regions of a log, as truth files hold them."""

from __future__ import annotations

import numpy as np

from log2sim.datatypes import IgnoreRegions, LabelView, Log
from log2sim.errors import LogError
from log2sim.geometry import NS_PER_S, nearest_index, quaternion_from_rotation
from log2sim.registry import nearest

MAX_STAMP_LAG_NS = 50_000_000
"""A region belongs to the frame nearest to its stamp within this time."""


def ignore_regions_of(log: Log, t0_ns: int) -> IgnoreRegions | None:
    """Collect the ignore regions of a log; None when its labels are complete.

    Parameters
    ----------
    log : Log
        Its labels may be limited to the views of some cameras and to some categories, and it may have ignored regions.
    t0_ns : int
        Start of the truth.

    Raises
    ------
    LogError
        When labels refer to a camera that the log does not have.
    """
    only = None if log.labels is None else log.labels.cameras
    never = () if log.labels is None else log.labels.never_labeled
    if only is None and not log.ignored_regions and not never:
        return None
    names = list(log.ignored_regions) if only is None else list(only)
    for name in names:
        if name not in log.cameras:
            raise LogError(
                f"{log.name}: its labels are of camera '{name}'{nearest(name, list(log.cameras))}, which it does not "
                f"have; there are: {', '.join(log.cameras)}"
            )
    views = tuple(_label_view(log, name, t0_ns) for name in names)
    return IgnoreRegions(views, outside_views=only is not None, categories=never)


def _label_view(log: Log, name: str, t0_ns: int) -> LabelView:
    t_ns = np.unique(log.streams[name].t_ns) if name in log.streams else np.zeros(0, dtype=np.int64)
    poses, known = log.map_T_sensor(name, t_ns)
    t_ns, poses = t_ns[known], poses[known]
    frame, box = np.zeros(0, dtype=np.int64), np.zeros((0, 4))
    regions = log.ignored_regions.get(name)
    if regions is not None and len(t_ns):
        frame = nearest_index(t_ns, regions.t_ns)
        near = np.abs(t_ns[frame] - regions.t_ns) <= MAX_STAMP_LAG_NS
        frame, box = frame[near], regions.box_px[near]
    rotation = quaternion_from_rotation(poses[:, :3, :3])
    return LabelView(log.cameras[name], (t_ns - t0_ns) / NS_PER_S, poses[:, :3, 3], rotation, frame, box)
