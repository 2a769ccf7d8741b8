"""Labels of a log: 3D boxes, image boxes and image regions without labels; L is the number of rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.numerals import short_repr


@dataclass(frozen=True, eq=False)
class Labels:
    """Labeled 3D boxes of a log in the map frame, one row a box and stamp.

    Attributes
    ----------
    t_ns : (L,) int64
        Absolute stamps.
    track_id : (L,) str
    category : (L,) str
    center_m : (L, 3) float64, m
        Box centers.
    size_m : (L, 3) float64, m
        Length, width, height.
    yaw_rad : (L,) float64
    visible : (L,) bool or None
        As the log states it; None where it states nothing and visibility is computed.
    cameras : tuple of str or None
        The cameras in whose images alone objects were labeled; None when they were labeled all around.
    kind : (L,) str or None
        The log's own word for the category, such as "Van"; None where the log has none of its own.
    occlusion : (L,) int64 or None
        0 fully visible, 1 partly occluded, 2 largely occluded, 3 unknown, as the log states it.
    labeled_ns : (F,) int64 or None
        Increasing stamps of all that was labeled, also where nothing was there; None where the log does not state it.
    never_labeled : tuple of str
        Categories that got no 3D boxes by the log's rules, such as bicycles without riders in KITTI.
    """

    __repr__ = short_repr

    t_ns: NDArray[np.int64]
    track_id: NDArray[np.str_]
    category: NDArray[np.str_]
    center_m: Array
    size_m: Array
    yaw_rad: Array
    visible: NDArray[np.bool_] | None = None
    cameras: tuple[str, ...] | None = None
    kind: NDArray[np.str_] | None = None
    occlusion: NDArray[np.int64] | None = None
    labeled_ns: NDArray[np.int64] | None = None
    never_labeled: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ImageLabels:
    """Labeled 2D boxes of one camera.

    Attributes
    ----------
    t_ns : (L,) int64
        Absolute stamp of the frame.
    box_px : (L, 4) float64, px
        u0, v0, u1, v1.
    category : (L,) str
    """

    __repr__ = short_repr

    t_ns: NDArray[np.int64]
    box_px: Array
    category: NDArray[np.str_]


@dataclass(frozen=True, eq=False)
class ImageRegions:
    """Parts of the images of one camera in which objects were left without labels.

    Attributes
    ----------
    t_ns : (L,) int64
        Absolute stamp of the frame.
    box_px : (L, 4) float64, px
        u0, v0, u1, v1.
    """

    __repr__ = short_repr

    t_ns: NDArray[np.int64]
    box_px: Array
