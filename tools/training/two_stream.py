"""Train the two-stream network of Lin et al. (2021) on simulated pictures and clouds, and compare it with lidar:vehicle.

    pip install 'log2sim[train]'
    log2sim synth --traffic vehicle --layout kitti --scenes 300 --out PAIRS
    python tools/train.py two_stream PAIRS OUT --steps 1500 --test KITTI=DRIVE --write BENCHMARKS.md

A pair is a picture and a cloud of one moment with the road users in both; x of the cloud points where the camera looks.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from benchmarks.table import markdown, replace_section
from numpy.typing import NDArray
from torch import Tensor, nn

from log2sim.config import LidarConfig
from log2sim.datatypes import GROUP_OF, Log
from log2sim.errors import RecordError
from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.evaluation import precision_recall
from log2sim.evaluation.detection.protocols import MIN_POINTS, Criterion, match_detections
from log2sim.geometry import (
    Array,
    box_corners,
    box_iou,
    inverse,
    nearest_index,
    rotation_from_rpy,
    transform,
    wrap_angle,
)
from log2sim.logs.opening import open_log
from log2sim.perception.detect3d.boxes import suppress
from log2sim.perception.detect3d.detectors import WEIGHTS, LidarDetector, open_network
from log2sim.perception.detect3d.network import open_session
from log2sim.perception.lidar.cloud import Cloud
from training.export import export_checked, group_of
from training.fitting import FitPlan, fit
from training.network import conv
from training.real_logs import LogSweep, LogView, ground_under, labeled_by, read_sweeps

MIN_DEPTH_M = 1.0
MIN_GROUND_POINTS = 10


@dataclass(frozen=True, eq=False)
class Pair:
    """A picture and a cloud; x of the cloud points where the camera looks, its origin is that of the log's cloud."""

    image: NDArray[np.uint8]  # (H, W, 3)
    cloud: Cloud
    pixel_T_cloud: Array  # (3, 4): projection of positions in the cloud's frame to homogeneous pixels
    ground: Array  # (3,): a, b, c of the plane z = a x + b y + c of the ground
    boxes: Array  # (M, 7): x, y, height of the center above the ground, length, width, height, heading
    truth: SceneBoxes  # the same, with z in the cloud's frame
    views: tuple[LogView, ...]  # the cameras in whose images road users were labeled, for the cloud's frame

    def in_picture_only(self) -> Pair:
        """Leave out the points beside the picture, which the network does not see, to save memory."""
        kept = np.flatnonzero(in_image(self.cloud.xyz, self.pixel_T_cloud, self.image.shape[:2]))
        c = self.cloud
        cloud = Cloud(c.stamp_ns, c.origin, c.xyz[kept], c.t_s[kept], c.sensor, c.ground[kept], c.height[kept])
        return replace(self, cloud=cloud)


def in_image(xyz: NDArray[np.floating], projection: Array, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Mark the points (N, 3) that a picture (height, width) shows."""
    p = np.asarray(xyz, np.float64) @ projection[:, :3].T + projection[:, 3]
    ahead = p[:, 2] > MIN_DEPTH_M
    uv = p[:, :2] / np.where(ahead, p[:, 2], 1.0)[:, None]
    return ahead & (uv >= 0).all(axis=1) & (uv < [shape[1], shape[0]]).all(axis=1)


def pairs_of(log: Log, camera: str, sweeps: list[LogSweep]) -> Iterator[Pair]:
    """Make the pairs of a log's sweeps with the nearest pictures of one camera, which must have no lens distortion."""
    stream = log.streams[camera]
    for sweep in sweeps:
        k = int(nearest_index(stream.t_ns, np.array([sweep.cloud.stamp_ns]))[0])
        pose, known = log.map_T_sensor(camera, int(stream.t_ns[k]))
        if not known[0]:
            continue
        try:
            image = stream.read(k)
        except RecordError:  # a broken picture, or one of another size than the calibration's
            continue
        yield pair_of(sweep, image, log.cameras[camera].K, pose[0])


def pair_of(sweep: LogSweep, image: NDArray[np.uint8], K: Array, map_T_cam: Array) -> Pair:
    """Turn a sweep so that x points where the camera looks."""
    old, truth = sweep.cloud, sweep.truth
    yaw = float(np.arctan2(map_T_cam[1, 2], map_T_cam[0, 2]))
    turn = rotation_from_rpy(0.0, 0.0, yaw)
    cloud = Cloud(
        old.stamp_ns, np.zeros(3), (old.xyz @ turn).astype(np.float32), old.t_s,
        (old.sensor @ turn).astype(np.float32), old.ground, old.height,
    )  # fmt: skip
    map_T_cloud = transform(turn, old.origin)
    rows = truth.box.copy()
    rows[:, :3] = rows[:, :3] @ turn
    rows[:, 6] = wrap_angle(rows[:, 6] - yaw)
    turned = SceneBoxes.of(rows, truth.category, points=truth.points, range_m=truth.range_m, ignored=truth.ignored)
    boxes = rows.copy()
    boxes[:, 2] -= ground_under(cloud, rows[:, :3])
    projection = K @ (inverse(map_T_cam) @ map_T_cloud)[:3]
    views = tuple(replace(v, cam_T_cloud=v.cam_T_cloud @ transform(turn, np.zeros(3))) for v in sweep.views)
    return Pair(image, cloud, projection, ground_plane(cloud), boxes, turned, views)


def ground_plane(cloud: Cloud) -> Array:
    """Fit a plane (3,) to the points on the ground ahead; that below the sensor where there are too few."""
    on = np.flatnonzero(cloud.ground & (cloud.xyz[:, 0] > 0))
    if len(on) < MIN_GROUND_POINTS:
        below = np.median(cloud.xyz[:, 2] - cloud.height) if len(cloud.xyz) else 0.0
        return np.array([0.0, 0.0, float(below)])
    xyz = cloud.xyz[on].astype(np.float64)
    design = np.column_stack([xyz[:, :2], np.ones(len(xyz))])
    return np.linalg.lstsq(design, xyz[:, 2], rcond=None)[0]


X_M, Y_M = (0.0, 70.0), (-40.0, 40.0)
CELL_M = 0.2
SHAPE = (350, 400)
SLICES_M = np.linspace(-0.2, 2.3, 6)
DENSITY_POINTS = 16
IMAGE_PX = (176, 600)
CLASSES = ("car", "pedestrian")
# Length, width, height, and headings of the anchors of each class; the means of the simulated road users.
ANCHOR_SIZES_M = {"car": (4.5, 1.85, 1.6), "pedestrian": (0.7, 0.65, 1.72)}
ANCHOR_YAWS = {"car": (0.0, np.pi / 2), "pedestrian": (0.0,)}
ANCHOR_STEP_M = 0.6
MIN_IMAGE_SIDE_PX = 2.0
# Overlap of rectangles along the axes, as AVOD's; people are too small for the step of the anchors, so for them it is distance.
POSITIVE_IOU, NEGATIVE_IOU = 0.5, 0.35
POSITIVE_M, NEGATIVE_M = 0.45, 0.8
MIN_POINTS_INSIDE = 4
DENSE, POSITIVE, NEGATIVE, UNJUDGED = 5, 1, 0, -1


@dataclass(frozen=True, eq=False)
class Inputs:
    """What the network sees of a pair, and what it is to answer.

    Boxes of anchors in the inputs are first and last coordinate of each axis (rows, columns), in [-1, 1] over map or picture.
    """

    bev: NDArray[np.float32]  # (6, 350, 400): greatest height in each of five slices as a share of all, and density
    image: NDArray[np.float32]  # (3, 176, 600), in [-1, 1]
    anchors: NDArray[np.float32]  # (N, 7): x, y, z of the center above the ground, length, width, height, heading
    kind: NDArray[np.int64]  # (N,): index into CLASSES
    bev_boxes: NDArray[np.float32]  # (N, 4)
    image_boxes: NDArray[np.float32]  # (N, 4)
    label: NDArray[np.int64]  # (N,): 1 object, 0 none, -1 not judged
    goal: NDArray[np.float32]  # (N, 7): offsets from the anchor of positive ones


def inputs_of(pair: Pair, *, mirrored: bool = False) -> Inputs:
    """Prepare a pair; mirrored from left to right if asked for."""
    boxes, projection, image = pair.boxes.copy(), pair.pixel_T_cloud.copy(), pair.image
    xyz = np.column_stack([pair.cloud.xyz[:, :2], pair.cloud.height])
    seen = in_image(pair.cloud.xyz, projection, image.shape[:2])
    ground = pair.ground
    if mirrored:
        xyz[:, 1] *= -1
        boxes[:, [1, 6]] *= -1
        flip = np.array([[-1.0, 0, image.shape[1] - 1], [0, 1, 0], [0, 0, 1]])
        projection = flip @ projection @ np.diag([1.0, -1, 1, 1])
        image, ground = image[:, ::-1], ground * [1, -1, 1]
    bev = bev_maps(xyz[seen])
    anchors, kind = all_anchors()
    kept = np.flatnonzero(points_in(bev[DENSE], anchors))
    image_boxes, visible = image_boxes_of(anchors[kept], ground, projection, image.shape[:2])
    kept, image_boxes = kept[visible], image_boxes[visible]
    anchors, kind = anchors[kept], kind[kept]
    label, goal = targets_of(anchors, kind, boxes, pair)
    span, low = np.array([np.ptp(X_M), np.ptp(Y_M)] * 2), np.array([X_M[0], Y_M[0]] * 2)
    bev_boxes = ((rectangles(anchors) - low) / span * 2 - 1).astype(np.float32)
    return Inputs(bev, small_image(image), anchors, kind, bev_boxes, image_boxes, label, goal)


def bev_maps(xyz: NDArray[np.floating]) -> NDArray[np.float32]:
    """Make the maps of points (N, 3) whose z is the height above the ground."""
    place = ((xyz[:, :2] - [X_M[0], Y_M[0]]) / CELL_M).astype(np.intp)
    layer = np.searchsorted(SLICES_M, xyz[:, 2], side="right") - 1
    inside = (place >= 0).all(axis=1) & (place < SHAPE).all(axis=1) & (layer >= 0) & (layer < len(SLICES_M) - 1)
    place, layer, z = place[inside], layer[inside], xyz[inside, 2]
    flat = place[:, 0] * SHAPE[1] + place[:, 1]
    out = np.zeros((6, SHAPE[0] * SHAPE[1]), np.float32)
    heights = out[:DENSE].reshape(-1)
    np.maximum.at(heights, layer * out.shape[1] + flat, ((z - SLICES_M[0]) / np.ptp(SLICES_M)).astype(np.float32))
    count = np.bincount(flat, minlength=out.shape[1])
    out[DENSE] = np.minimum(1.0, np.log1p(count) / np.log(DENSITY_POINTS))
    return out.reshape(6, *SHAPE)


def small_image(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Scale a picture to `IMAGE_PX`, channels first, in [-1, 1]."""
    import cv2

    small = cv2.resize(np.ascontiguousarray(image), IMAGE_PX[::-1], interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(small.transpose(2, 0, 1)).astype(np.float32) / 127.5 - 1


@cache
def all_anchors() -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Lay out all anchors (N, 7) and their classes (N,)."""
    x, y = (np.arange(low + ANCHOR_STEP_M / 2, high, ANCHOR_STEP_M) for low, high in (X_M, Y_M))
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    parts, kinds = [], []
    for kind, name in enumerate(CLASSES):
        for yaw in ANCHOR_YAWS[name]:
            size = ANCHOR_SIZES_M[name]
            rest = np.tile([size[2] / 2, *size, yaw], (len(xy), 1))
            parts.append(np.column_stack([xy, rest]))
            kinds.append(np.full(len(xy), kind))
    return np.concatenate(parts).astype(np.float32), np.concatenate(kinds)


def rectangles(boxes: NDArray[np.floating]) -> NDArray[np.floating]:
    """Rectangles (N, 4) along the axes, x0, y0, x1, y1, of boxes (N, 7) turned to the nearest axis."""
    across = np.abs(np.sin(boxes[:, 6])) > np.sqrt(0.5)
    half = np.where(across[:, None], boxes[:, [4, 3]], boxes[:, [3, 4]]) / 2
    return np.concatenate([boxes[:, :2] - half, boxes[:, :2] + half], axis=1)


def points_in(density: NDArray[np.float32], anchors: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Mark the anchors (N,) above which there are points."""
    total = np.pad(np.cumsum(np.cumsum(density > 0, axis=0), axis=1), ((1, 0), (1, 0)))
    place = (rectangles(anchors) - [X_M[0], Y_M[0], X_M[0], Y_M[0]]) / CELL_M
    i0, j0 = (np.clip(np.floor(place[:, k]), 0, SHAPE[k]).astype(int) for k in (0, 1))
    i1, j1 = (np.clip(np.ceil(place[:, k + 2]), 0, SHAPE[k]).astype(int) for k in (0, 1))
    return np.asarray(total[i1, j1] - total[i0, j1] - total[i1, j0] + total[i0, j0] > 0)


def image_boxes_of(
    anchors: NDArray[np.float32], ground: Array, projection: Array, shape: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Places (N, 4) of anchors in the picture, clipped to it, and whether it shows them (N,)."""
    corners = box_corners(anchors[:, :3], anchors[:, 3:6], anchors[:, 6])
    corners[..., 2] += corners[..., :2] @ ground[:2] + ground[2]
    p = corners @ projection[:, :3].T + projection[:, 3]
    ahead = (p[..., 2] > MIN_DEPTH_M).all(axis=1)
    uv = p[..., :2] / np.where(p[..., 2:] > MIN_DEPTH_M, p[..., 2:], 1.0)
    limit = np.array([shape[1], shape[0]], float)
    low, high = np.clip(uv.min(axis=1), 0, limit), np.clip(uv.max(axis=1), 0, limit)
    shown = ahead & ((high - low) >= MIN_IMAGE_SIDE_PX).all(axis=1)
    # Rows first, as in the maps.
    box = np.stack([low[:, 1], low[:, 0], high[:, 1], high[:, 0]], axis=1) / limit[[1, 0, 1, 0]] * 2 - 1
    return box.astype(np.float32), shown


def targets_of(
    anchors: NDArray[np.float32], kind: NDArray[np.int64], boxes: Array, pair: Pair
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Assign true boxes to anchors: labels (N,) and goals (N, 7)."""
    label, goal = np.full(len(anchors), NEGATIVE), np.zeros((len(anchors), 7), np.float32)
    category, points = pair.truth.category, pair.truth.points
    assert points is not None
    known = np.isin(category, CLASSES) & (points >= MIN_POINTS_INSIDE) & ~pair.truth.ignored
    # What overlaps a box that nobody has to find is not judged.
    label[(box_iou(rectangles(anchors), rectangles(boxes[~known])) > 0).any(axis=1)] = UNJUDGED
    for k, name in enumerate(CLASSES):
        own, true = np.flatnonzero(kind == k), boxes[known & (category == name)]
        if not len(own) or not len(true):
            continue
        if name == "pedestrian":
            fit = -np.hypot(*(anchors[own, None, :2] - true[None, :, :2]).transpose(2, 0, 1))
            positive, negative = -POSITIVE_M, -NEGATIVE_M
        else:
            fit = box_iou(rectangles(anchors[own]), rectangles(true))
            positive, negative = POSITIVE_IOU, NEGATIVE_IOU
            # An anchor across the object has to turn too far.
            turn = np.abs(wrap_angle(2 * (anchors[own, None, 6] - true[None, :, 6]))) / 2
            fit = np.where(turn <= np.pi / 4 + 1e-6, fit, 0.0)
        best = fit.argmax(axis=1)
        value = fit[np.arange(len(own)), best]
        label[own[(value > negative) & (value < positive)]] = UNJUDGED
        # Each object has the anchor that fits it best.
        forced = fit.argmax(axis=0)[fit.max(axis=0) > negative]
        best[forced] = np.flatnonzero(fit.max(axis=0) > negative)
        found = np.union1d(np.flatnonzero(value >= positive), forced)
        label[own[found]] = POSITIVE
        goal[own[found]] = encode(true[best[found]], anchors[own[found]])
    return label, goal


def encode(boxes: Array, anchors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Offsets (N, 7) of boxes from anchors: by the diagonal of the anchor's base, logarithms, and the turn.

    The paper's d_a is not defined; it is SECOND's, the diagonal (Yan et al., Sensors 2018). Front and back are not told
    apart: the turn is that of the axis.
    """
    diagonal = np.hypot(anchors[:, 3], anchors[:, 4])[:, None]
    turn = wrap_angle(2 * (boxes[:, 6] - anchors[:, 6])) / 2
    shift, log_size = (boxes[:, :3] - anchors[:, :3]) / diagonal, np.log(boxes[:, 3:6] / anchors[:, 3:6])
    return np.column_stack([shift, log_size, turn]).astype(np.float32)


def decode(goal: NDArray[np.floating], anchors: NDArray[np.float32]) -> Array:
    """Boxes (N, 7) from offsets, the inverse of `encode` but for front and back."""
    diagonal = np.hypot(anchors[:, 3], anchors[:, 4])[:, None].astype(np.float64)
    size = anchors[:, 3:6] * np.exp(np.clip(goal[:, 3:6], -1.5, 1.5))
    return np.column_stack([anchors[:, :3] + goal[:, :3] * diagonal, size, anchors[:, 6] + goal[:, 6]])


BLOCKS = ((8, 2), (16, 2), (32, 3), (64, 3))
CROP = 3
HIDDEN = 128
BEV_CHANNELS, IMAGE_CHANNELS, BOX_CODE = 6, 3, 7
ALPHA, GAMMA = 0.25, 2.0
# Probability of an object before training (Lin et al., ICCV 2017).
PRIOR_LOGIT = -4.6
MAX_ANCHORS = 6000


class Stream(nn.Module):
    """Encoder and decoder of one input, to its own resolution."""

    def __init__(self, channels: int, blocks: tuple[tuple[int, int], ...]) -> None:
        super().__init__()
        down, width = [], channels
        for outputs, count in blocks:
            down.append(nn.Sequential(*[conv(width if k == 0 else outputs, outputs) for k in range(count)]))
            width = outputs
        self.down = nn.ModuleList(down)
        ups, merges = [], []
        for lower, upper in zip(blocks[::-1], blocks[-2::-1], strict=False):
            ups.append(nn.ConvTranspose2d(lower[0], upper[0], 2, 2))
            merges.append(conv(2 * upper[0], upper[0]))
        self.ups, self.merges = nn.ModuleList(ups), nn.ModuleList(merges)
        # The paper's 1 x 1 convolution before the crops.
        self.squeeze = nn.Conv2d(blocks[0][0], blocks[0][0], 1)

    def forward(self, x: Tensor) -> Tensor:
        """Map (1, C, H, W) to features (1, D, H, W)."""
        levels = []
        for k, block in enumerate(self.down):
            x = block(x if k == 0 else F.max_pool2d(x, 2))
            levels.append(x)
        for up, merge, level in zip(self.ups, self.merges, levels[-2::-1], strict=True):
            x = up(x)
            # Odd sides lose a row on the way down.
            x = F.pad(x, (0, level.shape[3] - x.shape[3], 0, level.shape[2] - x.shape[2]))
            x = merge(torch.cat([x, level], dim=1))
        return self.squeeze(x)


class TwoStream(nn.Module):
    """Both streams and the layer on the fused crops."""

    def __init__(self, blocks: tuple[tuple[int, int], ...] = BLOCKS) -> None:
        super().__init__()
        self.bev, self.image = Stream(BEV_CHANNELS, blocks), Stream(IMAGE_CHANNELS, blocks)
        self.fuse = nn.Sequential(nn.Linear(blocks[0][0] * CROP * CROP, HIDDEN), nn.ReLU(inplace=True))
        self.score = nn.Linear(HIDDEN, len(CLASSES))
        self.box = nn.Linear(HIDDEN, BOX_CODE * len(CLASSES))
        with torch.no_grad():
            self.score.bias.fill_(PRIOR_LOGIT)

    def forward(self, bev: Tensor, image: Tensor, bev_boxes: Tensor, image_boxes: Tensor) -> tuple[Tensor, Tensor]:
        """Return logits (N, K) and box codes (N, K, 7) of anchors, K classes; inputs as in `Inputs`, each with a batch of one."""
        fused = (crops(self.bev(bev), bev_boxes) + crops(self.image(image), image_boxes)) / 2
        hidden = self.fuse(fused)
        return self.score(hidden), self.box(hidden).view(-1, len(CLASSES), BOX_CODE)


def crops(features: Tensor, boxes: Tensor) -> Tensor:
    """Sample features (1, D, H, W) bilinearly at 3 x 3 places of each box (N, 4): (N, D * 9)."""
    share = (torch.arange(CROP, dtype=boxes.dtype) + 0.5) / CROP
    rows = boxes[:, 0:1] + (boxes[:, 2:3] - boxes[:, 0:1]) * share
    columns = boxes[:, 1:2] + (boxes[:, 3:4] - boxes[:, 1:2]) * share
    rows, columns = rows[:, :, None] + 0 * columns[:, None, :], columns[:, None, :] + 0 * rows[:, :, None]
    grid = torch.stack([columns, rows], dim=-1).reshape(1, -1, CROP * CROP, 2)
    sampled = F.grid_sample(features, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    return sampled[0].permute(1, 0, 2).flatten(1)


Batch = tuple[Tensor, ...]


def batch_of(inputs: Inputs, rng: np.random.Generator | None = None) -> Batch:
    """Map, picture, boxes in both, kinds, labels and goals as tensors, of all anchors, or all positive and some others."""
    rows = np.arange(len(inputs.kind))
    if rng is not None and len(rows) > MAX_ANCHORS:
        positive, others = np.flatnonzero(inputs.label == POSITIVE), np.flatnonzero(inputs.label == NEGATIVE)
        count = min(len(others), max(MAX_ANCHORS - len(positive), 0))
        rows = np.concatenate([positive, rng.choice(others, count, replace=False)])
    columns = (inputs.bev_boxes, inputs.image_boxes, inputs.kind, inputs.label, inputs.goal)
    return tuple(map(torch.from_numpy, (inputs.bev[None], inputs.image[None], *(c[rows] for c in columns))))


def loss_of_anchors(network: nn.Module, batch: Batch) -> tuple[Tensor, dict[str, float]]:
    """Focal loss of the scores and Smooth L1 of the boxes, not weighted against each other.

    The paper divides the focal loss by the number of boxes, which makes it vanish beside the other where nearly all anchors
    are empty; both are divided by the number of positive ones, as RetinaNet does (Lin et al., ICCV 2017). Its alpha counts
    for objects, 1 - alpha for the rest, as there.
    """
    *inputs, kind, label, goal = batch
    logits, codes = (values[torch.arange(len(kind)), kind] for values in network(*inputs))
    positive, judged = (label == POSITIVE).float(), (label >= NEGATIVE).float()
    count = positive.sum().clamp(min=1)
    own = torch.where(label == POSITIVE, logits, -logits)
    weight = torch.where(label == POSITIVE, ALPHA, 1 - ALPHA)
    focal = -weight * torch.sigmoid(-own) ** GAMMA * F.logsigmoid(own)
    parts = {
        "class": (focal * judged).sum() / count,
        "box": (F.smooth_l1_loss(codes, goal, reduction="none").sum(dim=1) * positive).sum() / count,
    }
    return parts["class"] + parts["box"], {name: float(value.detach()) for name, value in parts.items()}


INPUTS = ("bev", "image", "bev_boxes", "image_boxes")
MIN_SCORE, MAX_BYTES = 0.05, 100_000_000
MAX_CANDIDATES = 500
MAX_RANGE_M = 40.0
CRITERIA = {
    "car": (Criterion("iou_bev", 0.7), Criterion("iou_3d", 0.7), Criterion("iou_bev", 0.5), Criterion("iou_3d", 0.5)),
    "pedestrian": (Criterion("iou_bev", 0.5), Criterion("iou_3d", 0.5), Criterion("center_m", 1.0)),
}

Search = Callable[[Pair], SceneBoxes]


def export_two_stream(network: TwoStream, path: Path) -> None:
    """Write the network as ONNX and check that both compute the same."""
    rng = np.random.default_rng(0)
    low, side = rng.uniform(-1, 0.5, (2, 40, 2)), rng.uniform(0.05, 0.5, (2, 40, 2))
    boxes = np.concatenate([low, low + side], axis=2)
    arrays = rng.random((1, BEV_CHANNELS, *SHAPE)), rng.random((1, IMAGE_CHANNELS, *IMAGE_PX)), boxes[0], boxes[1]
    tensors = {name: torch.from_numpy(a.astype(np.float32)) for name, a in zip(INPUTS, arrays, strict=True)}
    axes = {name: {0: "anchors"} for name in ("bev_boxes", "image_boxes", "logits", "codes")}
    export_checked(network.eval(), path, tensors, ("logits", "codes"), axes)


def search_by_network(path: Path) -> Search:
    """Search pairs by an exported network, in the frames of their clouds, with one thread."""
    session = open_session(path, MAX_BYTES, "network")

    def search(pair: Pair) -> SceneBoxes:
        seen = inputs_of(pair)
        if not len(seen.kind):
            return SceneBoxes.of(np.zeros((0, 7)))
        arrays = (seen.bev[None], seen.image[None], seen.bev_boxes, seen.image_boxes)
        logits, codes = session.run(["logits", "codes"], dict(zip(INPUTS, arrays, strict=True)))
        rows = np.arange(len(seen.kind))
        score = 1 / (1 + np.exp(-logits[rows, seen.kind].astype(np.float64)))
        best = np.argsort(-score)[:MAX_CANDIDATES]
        best = best[score[best] >= MIN_SCORE]
        boxes = decode(codes[best, seen.kind[best]], seen.anchors[best])
        kept = suppress(boxes[:, [0, 1, 3, 4, 6]], score[best], seen.kind[best]) if len(best) else np.zeros(0, np.intp)
        boxes, best = boxes[kept], best[kept]
        boxes[:, 2] += boxes[:, :2] @ pair.ground[:2] + pair.ground[2]
        return SceneBoxes.of(boxes, np.array(CLASSES)[seen.kind[best]], score[best])

    return search


def search_by_lidar(detector: LidarDetector) -> Search:
    """Search the clouds of pairs alone; all vehicles count as cars."""

    def search(pair: Pair) -> SceneBoxes:
        found = detector.detect(pair.cloud)
        names = [{"vehicle": "car"}.get(GROUP_OF[c], c) for c in found.category.tolist()]
        rows = np.column_stack([found.center_m - pair.cloud.origin, found.size_m, found.yaw_rad])
        return SceneBoxes.of(rows, np.array(names, dtype="<U16"), found.score)

    return search


def compare(searches: dict[str, Search], pairs: Sequence[Pair]) -> dict[str, dict[str, Any]]:
    """Compute average precision (R40) by detector, class and criterion, numbers of truths, and CPU time a pair."""
    out: dict[str, dict[str, Any]] = {}
    for name, search in searches.items():
        found, begun = [], time.process_time()
        for pair in pairs:
            boxes = search(pair)
            found.append(boxes.ignoring(~labeled_by(pair.views, boxes.box[:, :3])) if len(boxes) else boxes)
        row: dict[str, Any] = {"ms": (time.process_time() - begun) / max(len(pairs), 1) * 1e3}
        for kind, criteria in CRITERIA.items():
            f = SceneBoxes.join([b.take((b.category == kind) & (b.range_m < MAX_RANGE_M)) for b in found])
            t = SceneBoxes.join([truth_of(pair, kind) for pair in pairs])
            ap = {str(c): precision_recall(f, match_detections(f, t, c)).average() for c in criteria}
            row[kind] = ap | {"truths": int((~t.ignored).sum())}
        out[name] = row
    return out


def truth_of(pair: Pair, kind: str) -> SceneBoxes:
    """Take the true boxes of a class; other vehicles, far ones and such with few points need not be found."""
    t = group_of(pair.truth, GROUP_OF[kind])
    assert t.points is not None
    away = np.hypot(t.box[:, 0], t.box[:, 1])
    return t.ignoring((t.category != kind) | (t.points < MIN_POINTS) | (away >= MAX_RANGE_M))


TEST_SHARE = 0.15
EVERY = 3  # of the sweeps of other logs
PEAK_RATE = 2e-3


def read_pairs(path: Path, every: int = 1) -> list[Pair]:
    """Read the pairs of a log, with the camera in whose pictures it is labeled."""
    log = open_log(path)
    only = None if log.labels is None else log.labels.cameras
    camera = next(iter(only)) if only else (log.reference_camera or next(iter(log.cameras)))
    return list(pairs_of(log, camera, read_sweeps(log, every)))


def train(pairs: list[Pair], out: Path, *, steps: int, seed: int) -> Path:
    """Train, or go on from the checkpoint in `out`, and export the averaged weights; returns the ONNX file."""
    torch.manual_seed(seed)
    network = TwoStream().to(memory_format=torch.channels_last)

    def step(n: torch.nn.Module, rng: np.random.Generator, _: int) -> Any:
        pair = pairs[int(rng.integers(len(pairs)))]
        return loss_of_anchors(n, batch_of(inputs_of(pair, mirrored=bool(rng.random() < 0.5)), rng))

    network.load_state_dict(fit(network, step, FitPlan(steps, seed, PEAK_RATE, out / "checkpoint.pt")))
    export_two_stream(network, out / "two_stream.onnx")
    return out / "two_stream.onnx"


def main(
    data: Path, out: Path, steps: int = 1500, seed: int = 1, test: list[str] = [], write: Path | None = None
) -> None:
    """Train on a folder in KITTI's object layout and compare on pairs that are left out, and on other logs, NAME=PATH each."""
    out.mkdir(parents=True, exist_ok=True)
    pairs = read_pairs(data)
    held = max(1, round(len(pairs) * TEST_SHARE))
    path = train([p.in_picture_only() for p in pairs[:-held]], out, steps=steps, seed=seed)
    others = (t.split("=", 1) for t in test)
    tests = {"simulated": pairs[-held:]} | {name: read_pairs(Path(log), EVERY) for name, log in others}
    lidar = open_network(WEIGHTS / "vehicle.onnx", LidarConfig(min_score=MIN_SCORE), name="lidar:vehicle")
    searches = {"two-stream": search_by_network(path), "`lidar:vehicle`": search_by_lidar(lidar)}
    columns, rows = [(kind, str(c)) for kind, criteria in CRITERIA.items() for c in criteria], []
    for name, frames in tests.items():
        for detector, row in compare(searches, frames).items():
            cells = ["-" if row[kind][c] is None else f"{row[kind][c]:.3f}" for kind, c in columns]
            truths = " / ".join(str(row[kind]["truths"]) for kind in CRITERIA)
            rows.append([f"{name} ({len(frames)})", detector, *cells, truths, f"{row['ms']:.0f}"])
    text = markdown(["tested on", "detector", *(f"{kind}, {c}" for kind, c in columns), "truths", "CPU ms"], rows)
    print(text)
    if write:
        replace_section(write, "two-stream", text)
