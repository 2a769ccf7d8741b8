"""How a camera shows 3D boxes: height in the image, truncation, and the share in regions left without labels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.metrics.label_views import MAX_STAMP_LAG_NS
from log2sim.evaluation.metrics.visibility import image_shares
from log2sim.geometry import Array, inverse, project_boxes


@dataclass(frozen=True, eq=False)
class ImageViews:
    """M boxes in the images of one camera.

    Attributes
    ----------
    shown : (M,) bool
        Whether the image shows a part of the box.
    height_px : (M,) float64
        Height of the box in the image, clipped to it; 0 where it is not shown.
    truncation : (M,) float64
        Share of the outline outside the image; 1 where it is not shown.
    region_share : (M,) float64
        Greatest share of the image box in one region left without labels.
    """

    shown: NDArray[np.bool_]
    height_px: Array
    truncation: Array
    region_share: Array

    def take(self, rows: NDArray[np.bool_]) -> ImageViews:
        """Take the rows of a mask."""
        return ImageViews(self.shown[rows], self.height_px[rows], self.truncation[rows], self.region_share[rows])


def image_views(
    log: Log, camera: str, t_ns: NDArray[np.int64], boxes: SceneBoxes, *, truncation: bool = False
) -> ImageViews:
    """Project boxes into the images of a camera.

    Parameters
    ----------
    log : Log
    camera : str
    t_ns : (F,) int64
        Stamps of the scenes, absolute; the camera is taken where it was then.
    boxes : SceneBoxes
        Their scenes are indices into `t_ns`, the boxes are in the map frame.
    truncation : bool
        Whether to compute it, which takes a millisecond a box at the border of the image; 0 for all shown boxes otherwise.
    """
    count = len(boxes)
    shown, height, share = np.zeros(count, dtype=bool), np.zeros(count), np.zeros(count)
    outside = np.ones(count)
    poses, known = log.map_T_sensor(camera, t_ns)
    for scene in np.unique(boxes.scene):
        if not known[scene]:
            continue
        rows = np.flatnonzero(boxes.scene == scene)
        solid = boxes.box[rows, :3], boxes.box[rows, 3:6], boxes.box[rows, 6]
        seen = project_boxes(*solid, log.cameras[camera], inverse(poses[scene]))
        shown[rows] = seen.valid
        height[rows] = np.where(seen.valid, seen.box_px[:, 3] - seen.box_px[:, 1], 0)
        inside = image_shares(log.cameras[camera], inverse(poses[scene]), *solid) if truncation else 1.0
        outside[rows] = np.where(seen.valid, 1 - inside, 1.0)
        share[rows] = _region_share(seen.box_px, _regions(log, camera, int(t_ns[scene])))
    return ImageViews(shown, height, outside, np.where(shown, share, 0))


def _regions(log: Log, camera: str, t_ns: int) -> Array:
    """Select the regions (R, 4) without labels of the image nearest to a stamp."""
    regions = log.ignored_regions.get(camera)
    if regions is None or not len(regions.t_ns):
        return np.zeros((0, 4))
    lag = np.abs(regions.t_ns - t_ns)
    return regions.box_px[lag == lag.min()] if lag.min() <= MAX_STAMP_LAG_NS else np.zeros((0, 4))


def _region_share(box_px: Array, region_px: Array) -> Array:
    """Compute the greatest share (M,) of boxes (M, 4) that one of the regions (R, 4) covers."""
    if not len(region_px):
        return np.zeros(len(box_px))
    low = np.maximum(box_px[:, None, :2], region_px[None, :, :2])
    high = np.minimum(box_px[:, None, 2:], region_px[None, :, 2:])
    shared = np.clip(high - low, 0, None).prod(axis=2).max(axis=1)
    area = (box_px[:, 2:] - box_px[:, :2]).prod(axis=1)
    return np.asarray(np.divide(shared, area, out=np.zeros_like(area), where=area > 0))
