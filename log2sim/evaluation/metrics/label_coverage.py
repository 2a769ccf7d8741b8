"""Where labels are incomplete: reconstructed agents in ignore regions."""

from __future__ import annotations

import numpy as np

from log2sim.datatypes import IgnoreRegions, LabelView
from log2sim.evaluation.metrics.align import StateTable
from log2sim.evaluation.metrics.pairs import Index, Mask
from log2sim.evaluation.metrics.visibility import image_samples
from log2sim.geometry import NS_PER_S, Array, PoseTrack, inverse, nearest_index

MIN_REGION_SHARE = 0.5
MAX_FRAME_LAG_S = 0.15
"""A tick is compared with the nearest labeled frame of a camera within this time."""


def ignored_ticks(ignore_regions: IgnoreRegions, t_s: Array, agents: StateTable, candidates: Mask) -> Mask:
    """Mark (B, T) the boxes that no labeled camera shows in a labeled part of its image.

    Parameters
    ----------
    ignore_regions : IgnoreRegions
    t_s : (T,)
        Ticks, seconds of the truth.
    agents : StateTable
        B agents at these ticks, the truth's map frame.
    candidates : (B, T) bool
        The boxes to decide on; all others are False.

    Notes
    -----
    A camera shows a box in an ignore region when at least half of the visible outline lies in the union of the regions of
    the nearest frame. One camera that shows it in a labeled part suffices to keep it.
    """
    center_m = np.concatenate([agents.xy_m, agents.z_m[..., None]], axis=-1)
    labeled, hidden = np.zeros_like(candidates), np.zeros_like(candidates)
    for view in ignore_regions.views:
        frame, near, map_T_cam = _frames_at(view, t_s)
        for k in np.flatnonzero(candidates.any(0) & near):
            rows = np.flatnonzero(candidates[:, k])
            regions = view.region_px[view.region_frame == frame[k]]
            boxes = center_m[rows, k], agents.size_m[rows], agents.yaw_rad[rows, k]
            for row, uv in zip(rows, image_samples(view.camera, inverse(map_T_cam[k]), *boxes)):
                if len(uv):
                    share = _inside_any(uv, regions).mean()
                    (hidden if share >= MIN_REGION_SHARE else labeled)[row, k] = True
    outside = candidates & ~hidden & ~labeled if ignore_regions.outside_views else np.zeros_like(candidates)
    return (hidden & ~labeled) | outside


def _frames_at(view: LabelView, t_s: Array) -> tuple[Index, Mask, Array]:
    """Find the nearest frame (T,), whether it is within `MAX_FRAME_LAG_S`, and the camera poses (T, 4, 4) at instants (T,).

    Notes
    -----
    Poses are interpolated: at 30 m/s a car moves 1.5 m in half a frame at 10 Hz.
    """
    if len(view.t_s) == 0:
        return np.zeros(len(t_s), dtype=np.int64), np.zeros(len(t_s), dtype=bool), np.zeros((len(t_s), 4, 4))
    frame = nearest_index(view.t_s, t_s)
    near = np.abs(view.t_s[frame] - t_s) <= MAX_FRAME_LAG_S
    at_frames = view.map_T_cam
    track = PoseTrack(_to_ns(view.t_s), at_frames)
    poses, known = track.at(_to_ns(np.clip(t_s, view.t_s[0], view.t_s[-1])))
    return frame, near, np.where(known[:, None, None], poses, at_frames[frame])


def _to_ns(t_s: Array) -> Index:
    return np.round(t_s * NS_PER_S).astype(np.int64)


def _inside_any(uv: Array, regions: Array) -> Mask:
    """Mark (S,) the pixels (S, 2) that lie in any of the regions (R, 4)."""
    u, v = uv[:, None, 0], uv[:, None, 1]
    within = (u >= regions[:, 0]) & (u <= regions[:, 2]) & (v >= regions[:, 1]) & (v <= regions[:, 3])
    return np.asarray(within.any(axis=1))
