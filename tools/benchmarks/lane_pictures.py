"""Lane lines found in single pictures, against their annotations.

    python tools/bench.py lane_pictures FOLDER

FOLDER holds `tusimple/image` with `tusimple/gt_binary_image`, `openlane/lane3d/annotations` with `openlane/lane2d/images`, and
folders of `log2sim synth --scene` in `simulated`; any may be missing. The cameras are not known and are estimated from each
picture, but OpenLane's are. Of a simulated log five pictures are taken, and the lines along the ego's way within 11 m and 80 m,
whether or not vehicles hide them. A pixel is right within 20 px of the other side's line, in pictures as they are annotated. The lateral error
of OpenLane's lines is that at the same distance ahead, where both have the line and the annotation is visible.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from kitti.boxes import EGO_R_CAM

from log2sim import open_log
from log2sim.datatypes import Scenario
from log2sim.geometry import Camera, apply, inverse, project
from log2sim.road.lane_picture import PictureMarkings, find_markings_in_picture

WITHIN_PX = 20
DRAWN_PX = 5
CURBS = (20, 21)  # left and right, of OpenLane's categories
MATCH_M = 1.5
# Of simulated logs: pictures of each, width of their masks, and lines that count: cosine to the ego's way.
PICTURES, WIDTH_PX = 5, 1280
AHEAD_M, ACROSS_M, MIN_COSINE = 80.0, 11.0, 0.85
SPANS_M = ((0.0, 40.0), (40.0, 80.0))
# Name, picture (H, W, 3), mask (H, W) of the true lines, camera where it is known, annotations.
Picture = tuple[str, np.ndarray, np.ndarray, Camera | None, dict]


def score_masks(found: np.ndarray, true: np.ndarray) -> tuple[float, float, float]:
    """Precision, recall and F1 of masks (H, W): shares of the pixels of each within `WITHIN_PX` of the other."""

    def share(of: np.ndarray, near: np.ndarray) -> float:
        if not of.any() or not near.any():
            return 0.0
        distance = cv2.distanceTransform((~near).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        return float(np.mean(distance[of] <= WITHIN_PX))

    precision, recall = share(found, true), share(true, found)
    return precision, recall, 2 * precision * recall / max(precision + recall, 1e-9)


def draw_lines(shape: tuple[int, ...], lines: list[np.ndarray]) -> np.ndarray:
    """Draw lines (N, 2) on a mask (H, W)."""
    mask = np.zeros(shape[:2], np.uint8)
    for uv in lines:
        # Pixels far outside the picture overflow what OpenCV draws.
        known = uv[np.isfinite(uv).all(axis=1) & (np.abs(uv) < 2**14).all(axis=1)]
        cv2.polylines(mask, [np.rint(known).astype(np.int32).reshape(-1, 1, 2)], False, 255, DRAWN_PX)
    return mask > 0


def tusimple(folder: Path) -> Iterator[Picture]:
    """Pictures with the mask of their lines; nothing is known of the camera."""
    for path in sorted((folder / "image").glob("*.jpg")):
        true = cv2.imread(str(folder / "gt_binary_image" / f"{path.stem}.png"), 0) > 0
        yield path.stem, cv2.imread(str(path)), true, None, {}


def openlane(folder: Path) -> Iterator[Picture]:
    """Pictures with the mask of their lines, their camera and their annotations."""
    for path in sorted((folder / "lane3d" / "annotations").rglob("*.json")):
        image = cv2.imread(str(folder / "lane2d" / "images" / f"{path.stem}.jpg"))
        document = json.loads(path.read_text(encoding="utf-8"))
        lines = [line for line in document["lane_lines"] if line["category"] not in CURBS]
        true = draw_lines(image.shape, [np.array(line["uv"]).T[np.argsort(line["uv"][1])] for line in lines])
        yield path.stem, image, true, openlane_camera(document, image.shape), document


def simulated(folder: Path) -> Iterator[Picture]:
    """Pictures of the first camera of simulated logs, with the mask of their lines 1280 pixels wide."""
    for path in sorted(folder.glob("*/truth.json")):
        log, features = open_log(path.parent), Scenario.load(path).map_features
        name, camera = next(iter(log.cameras.items()))
        lines = [resampled(m.points_m) for m in features.markings if m.is_lane_line] if features else []
        own, stamps = camera.mount_T_cam[:3, 3], log.streams[name].t_ns
        for k in np.linspace(0, len(stamps) - 1, PICTURES).astype(int).tolist():
            ego_T_map = inverse(log.ego.at(stamps[k])[0][0])
            masks = []
            for line in lines:
                points = apply(ego_T_map, line)
                along = np.gradient(points[:, :2], axis=0)
                chosen = np.abs(along[:, 0]) > MIN_COSINE * np.linalg.norm(along, axis=1)
                chosen &= (points[:, 0] > own[0] + 2) & (points[:, 0] < AHEAD_M) & (np.abs(points[:, 1]) < ACROSS_M)
                uv = project(camera, apply(inverse(camera.mount_T_cam), points))[0]
                masks.append(np.where(chosen[:, None], uv, np.nan) * WIDTH_PX / camera.width_px)
            image = log.streams[name].read(k)
            true = draw_lines((round(image.shape[0] * WIDTH_PX / camera.width_px), WIDTH_PX), masks)
            if true.any():
                yield f"{path.parent.name} {k}", image, true, None, {}


def resampled(points_m: np.ndarray) -> np.ndarray:
    """Points (N, 3) of a line at steps of half a meter."""
    s = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points_m, axis=0), axis=1))])
    at = np.arange(0, s[-1], 0.5) if s[-1] > 1 else s
    return np.column_stack([np.interp(at, s, column) for column in points_m.T])


def openlane_camera(document: dict, shape: tuple[int, ...]) -> Camera:
    """Make the camera of an annotation, whose extrinsic is the pose of the frame x forward, y left, z up; it looks along z."""
    pose = np.array(document["extrinsic"], np.float64)
    pose[:3, :3] = pose[:3, :3] @ EGO_R_CAM
    return Camera("picture", shape[1], shape[0], np.array(document["intrinsic"], np.float64), "ego", pose)


def lateral_errors(document: dict, camera: Camera, found: PictureMarkings) -> list[str]:
    """Median lateral errors of lines by how far ahead they are."""
    rows = []
    vehicle_T_forward = camera.mount_T_cam.copy()
    vehicle_T_forward[:3, :3] = camera.mount_T_cam[:3, :3] @ EGO_R_CAM.T
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
        error, span = [e for x, e in rows if low <= x < high], f"{low:.0f}-{high:.0f} m"
        out.append(f"lateral error {span}: {np.median(error):.2f} m" if error else f"{span}: none")
    return out


def main(folder: Path) -> None:
    """Print the scores of each picture, and the means of each data set."""
    for data_set in (tusimple, openlane, simulated):
        name, scores = data_set.__name__, []
        for stem, image, true, camera, document in data_set(folder / name):
            begin = time.perf_counter()
            found = find_markings_in_picture(image, camera)
            more = [f"{len(found.lane_lines)} lines, {time.perf_counter() - begin:.1f} s"]
            scale = true.shape[1] / image.shape[1]
            drawn = draw_lines(true.shape, [found.project(line.points_m) * scale for line in found.lane_lines])
            precision, recall, f1 = score_masks(drawn, true)
            more += lateral_errors(document, camera, found) if camera is not None else []
            print(f"{name} {stem}: precision {precision:.3f}, recall {recall:.3f}, F1 {f1:.3f}; {'; '.join(more)}")
            scores.append((precision, recall, f1))
        if scores:
            p, r, f = np.mean(scores, axis=0)
            print(f"{name}: means of {len(scores)} pictures: precision {p:.3f}, recall {r:.3f}, F1 {f:.3f}")
