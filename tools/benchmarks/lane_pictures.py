"""Markings found in single pictures of TuSimple and OpenLane, without a network, against their annotations.

    python tools/bench.py lane_pictures FOLDER

FOLDER holds `tusimple/image` with `tusimple/gt_binary_image`, and `openlane/lane3d/annotations` with
`openlane/lane2d/images`; either may be missing. TuSimple's cameras are not known and are estimated from each picture;
OpenLane's are. A pixel is right within 20 px of the other side's line, in pictures as they are annotated. The lateral error
of OpenLane's lines is that at the same distance ahead, where both have the line and the annotation is visible.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from log2sim.geometry import Camera, apply
from log2sim.road.lane_picture import PictureMarkings, find_markings_in_picture

WITHIN_PX = 20
DRAWN_PX = 5
# OpenLane's cameras look along z in their annotations' frame x forward, y left, z up.
FORWARD_R_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
CURBS = (20, 21)  # left and right, of OpenLane's categories
MATCH_M = 1.5
SPANS_M = ((0.0, 40.0), (40.0, 80.0))


@dataclass(frozen=True)
class Score:
    """Precision and recall of pixels."""

    precision: float
    recall: float

    @property
    def f1(self) -> float:
        total = self.precision + self.recall
        return 2 * self.precision * self.recall / total if total else 0.0


def score_masks(found: np.ndarray, true: np.ndarray) -> Score:
    """Compare masks (H, W): shares of the pixels of each within `WITHIN_PX` of the other."""

    def share(of: np.ndarray, near: np.ndarray) -> float:
        if not of.any() or not near.any():
            return 0.0
        distance = cv2.distanceTransform((~near).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        return float(np.mean(distance[of] <= WITHIN_PX))

    return Score(share(found, true), share(true, found))


def draw_lines(shape: tuple[int, ...], lines: list[np.ndarray]) -> np.ndarray:
    """Draw lines (N, 2) on a mask (H, W)."""
    mask = np.zeros(shape[:2], np.uint8)
    for uv in lines:
        # Pixels far outside the picture overflow what OpenCV draws.
        known = uv[np.isfinite(uv).all(axis=1) & (np.abs(uv) < 2**14).all(axis=1)]
        cv2.polylines(mask, [np.rint(known).astype(np.int32).reshape(-1, 1, 2)], False, 255, DRAWN_PX)
    return mask > 0


def score_tusimple(folder: Path) -> list[Score]:
    scores = []
    for path in sorted((folder / "image").glob("*.jpg")):
        image, true = cv2.imread(str(path)), cv2.imread(str(folder / "gt_binary_image" / f"{path.stem}.png"), 0) > 0
        start = time.perf_counter()
        found = find_markings_in_picture(image)
        seconds = time.perf_counter() - start
        score = score_masks(draw_lines(image.shape, [found.project(line.points_m) for line in found.lane_lines]), true)
        print(_row(f"tusimple {path.stem}", score, f"{len(found.lane_lines)} lines, {seconds:.1f} s"))
        scores.append(score)
    return scores


def score_openlane(folder: Path) -> list[Score]:
    scores = []
    for path in sorted((folder / "lane3d" / "annotations").rglob("*.json")):
        image = cv2.imread(str(folder / "lane2d" / "images" / f"{path.stem}.jpg"))
        document = json.loads(path.read_text(encoding="utf-8"))
        camera = openlane_camera(document, image.shape)
        start = time.perf_counter()
        found = find_markings_in_picture(image, camera)
        seconds = time.perf_counter() - start
        lines = [line for line in document["lane_lines"] if line["category"] not in CURBS]
        true = draw_lines(image.shape, [np.array(line["uv"]).T[np.argsort(line["uv"][1])] for line in lines])
        drawn = draw_lines(image.shape, [found.project(line.points_m) for line in found.lane_lines])
        score = score_masks(drawn, true)
        errors = "; ".join(lateral_errors(document, camera, found))
        print(_row(f"openlane {path.stem}", score, f"{len(found.lane_lines)} lines, {seconds:.1f} s; {errors}"))
        scores.append(score)
    return scores


def openlane_camera(document: dict, shape: tuple[int, ...]) -> Camera:
    """Make the camera of an annotation, whose extrinsic is the pose of the frame x forward, y left, z up."""
    pose = np.array(document["extrinsic"], np.float64)
    pose[:3, :3] = pose[:3, :3] @ FORWARD_R_CAM
    return Camera("picture", shape[1], shape[0], np.array(document["intrinsic"], np.float64), "ego", pose)


def lateral_errors(document: dict, camera: Camera, found: PictureMarkings) -> list[str]:
    """Median lateral errors of lines by how far ahead they are."""
    rows = []
    vehicle_T_forward = camera.mount_T_cam.copy()
    vehicle_T_forward[:3, :3] = camera.mount_T_cam[:3, :3] @ FORWARD_R_CAM.T
    for line in document["lane_lines"]:
        visible = np.array(line["visibility"]) > 0
        points = apply(vehicle_T_forward, np.array(line["xyz"], np.float64).T[visible])
        points = points[np.argsort(points[:, 0])]
        for own in found.lane_lines:
            for marking in own.markings:
                x, y = marking.points_m[np.argsort(marking.points_m[:, 0])][:, :2].T
                inside = (points[:, 0] >= x[0]) & (points[:, 0] <= x[-1])
                error = np.abs(points[inside, 1] - np.interp(points[inside, 0], x, y))
                if len(error) and np.median(error) < MATCH_M:
                    rows += list(zip(points[inside, 0], error))
    out = []
    for low, high in SPANS_M:
        error = [e for x, e in rows if low <= x < high]
        out.append(
            f"lateral error {low:.0f}-{high:.0f} m: {np.median(error):.2f} m"
            if error
            else f"{low:.0f}-{high:.0f} m: none"
        )
    return out


def _row(name: str, score: Score, more: str) -> str:
    return f"{name}: precision {score.precision:.3f}, recall {score.recall:.3f}, F1 {score.f1:.3f}; {more}"


def main(folder: Path) -> None:
    for name, scores in (
        ("tusimple", score_tusimple(folder / "tusimple")),
        ("openlane", score_openlane(folder / "openlane")),
    ):
        if scores:
            print(f"{name}: mean F1 {np.mean([s.f1 for s in scores]):.3f} of {len(scores)} pictures")
