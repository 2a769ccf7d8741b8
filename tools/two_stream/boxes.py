"""Boxes of the two-stream network through ONNX Runtime, and average precision of detectors on pairs."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lidar_training.export import MAX_EXPORT_ERROR

from log2sim.datatypes import GROUP_OF
from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.evaluation import average_precision
from log2sim.evaluation.detection.protocols import MIN_POINTS, Criterion
from log2sim.perception.detect3d.boxes import Rectangles, suppress
from log2sim.perception.detect3d.detectors import LidarDetector
from two_stream.inputs import CLASSES, IMAGE_PX, SHAPE, decode, inputs_of
from two_stream.network import BEV_CHANNELS, IMAGE_CHANNELS, TwoStream
from two_stream.pairs import Pair

INPUTS = ("bev", "image", "bev_boxes", "image_boxes")
MIN_SCORE = 0.05
MAX_CANDIDATES = 500
MAX_RANGE_M = 40.0
CRITERIA = {
    "car": (Criterion("iou_bev", 0.7), Criterion("iou_3d", 0.7), Criterion("iou_bev", 0.5), Criterion("iou_3d", 0.5)),
    "pedestrian": (Criterion("iou_bev", 0.5), Criterion("iou_3d", 0.5), Criterion("center_m", 1.0)),
}

Search = Callable[[Pair], SceneBoxes]


def export_two_stream(network: TwoStream, path: Path) -> None:
    """Write the network as ONNX and check that both compute the same.

    Raises
    ------
    RuntimeError
        When they differ by more than `MAX_EXPORT_ERROR`.
    """
    import onnxruntime

    network.eval()
    rng = np.random.default_rng(0)
    low, side = rng.uniform(-1, 0.5, (2, 40, 2)), rng.uniform(0.05, 0.5, (2, 40, 2))
    boxes = np.concatenate([low, low + side], axis=2).astype(np.float32)
    arrays = (
        rng.random((1, BEV_CHANNELS, *SHAPE), dtype=np.float32), rng.random((1, IMAGE_CHANNELS, *IMAGE_PX), dtype=np.float32),
        boxes[0], boxes[1],
    )  # fmt: skip
    tensors = tuple(torch.from_numpy(a) for a in arrays)
    with warnings.catch_warnings():
        # The exporter that needs no further package announces its end.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network, (*tensors[:2], tensors[2][:9], tensors[3][:9]), str(path), input_names=list(INPUTS),
            output_names=["logits", "codes"], opset_version=17, dynamo=False,
            dynamic_axes={name: {0: "anchors"} for name in ("bev_boxes", "image_boxes", "logits", "codes")},
        )  # fmt: skip
    with torch.no_grad():
        expected = [t.numpy() for t in network(*tensors)]
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    found = session.run(["logits", "codes"], dict(zip(INPUTS, arrays, strict=True)))
    error = max(float((np.abs(a - b) / np.maximum(np.abs(b), 1)).max()) for a, b in zip(found, expected, strict=True))
    if not error < MAX_EXPORT_ERROR:
        raise RuntimeError(f"{path}: ONNX and torch differ by {error:.2g}, more than {MAX_EXPORT_ERROR:g}")


@dataclass(frozen=True, eq=False)
class TwoStreamDetector:
    """Detector on pairs from the exported network."""

    session: Any

    @classmethod
    def open(cls, path: Path) -> TwoStreamDetector:
        """Load the network for one thread."""
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        return cls(onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"]))

    def __call__(self, pair: Pair) -> SceneBoxes:
        """Detect road users in a pair, in the frame of its cloud."""
        seen = inputs_of(pair)
        if not len(seen.kind):
            return SceneBoxes.of(np.zeros((0, 7)))
        arrays = (seen.bev[None], seen.image[None], seen.bev_boxes, seen.image_boxes)
        logits, codes = self.session.run(["logits", "codes"], dict(zip(INPUTS, arrays, strict=True)))
        rows = np.arange(len(seen.kind))
        score = 1 / (1 + np.exp(-logits[rows, seen.kind].astype(np.float64)))
        best = np.argsort(-score)[:MAX_CANDIDATES]
        best = best[score[best] >= MIN_SCORE]
        boxes = decode(codes[best, seen.kind[best]], seen.anchors[best])
        flat = Rectangles(boxes[:, :2], boxes[:, 3:5], boxes[:, 6])
        kept = suppress(flat, score[best], seen.kind[best]) if len(best) else np.zeros(0, np.intp)
        boxes, best = boxes[kept], best[kept]
        boxes[:, 2] += boxes[:, :2] @ pair.ground[:2] + pair.ground[2]
        return SceneBoxes.of(boxes, np.array(CLASSES)[seen.kind[best]], score[best])


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
            found.append(boxes.ignoring(~pair.labeled(boxes.box[:, :3])) if len(boxes) else boxes)
        row: dict[str, Any] = {"ms": (time.process_time() - begun) / max(len(pairs), 1) * 1e3}
        for kind, criteria in CRITERIA.items():
            f = SceneBoxes.join([b.take((b.category == kind) & (b.range_m < MAX_RANGE_M)) for b in found])
            t = SceneBoxes.join([truth_of(pair, kind) for pair in pairs])
            row[kind] = {str(c): average_precision(f, t, c) for c in criteria} | {"truths": int((~t.ignored).sum())}
        out[name] = row
    return out


def truth_of(pair: Pair, kind: str) -> SceneBoxes:
    """Take the true boxes of a class; other vehicles, far ones and such with few points need not be found."""
    t = pair.truth
    group = GROUP_OF[kind]
    t = t.take(np.array([GROUP_OF.get(c) == group for c in t.category.tolist()], bool))
    assert t.points is not None
    away = np.hypot(t.box[:, 0], t.box[:, 1])
    return t.ignoring((t.category != kind) | (t.points < MIN_POINTS) | (away >= MAX_RANGE_M))
