"""From a checkpoint to the file that ships: ONNX with its description, calibrated scores."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from fits.logistic import logistic_regression
from numpy.typing import NDArray
from torch import Tensor, nn

from log2sim.config import LidarConfig
from log2sim.datatypes import GROUP_OF, Boxes3D
from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.evaluation import calibration, operating_point, precision_recall
from log2sim.evaluation.detection.protocols import Criterion, Matches, match_detections
from log2sim.perception.detect3d.boxes import suppress
from log2sim.perception.detect3d.detectors import LidarDetector, NetworkDetector, open_network
from log2sim.perception.detect3d.network import METADATA_KEY
from training.clouds import Example
from training.network import GROUPS, IN_CHANNELS, BevNetwork, Widths, widths_of
from training.quantization import WEIGHT_BITS, quantize_kernels, quantized_network

CATEGORIES = {
    "vehicle": ["car", "truck", "bus"],
    "two_wheeler": ["motorcycle", "cyclist"],
    "pedestrian": ["pedestrian"],
}
# What a score is the probability of. Outlines of people are too small for an overlap to say much.
RIGHT = {
    "vehicle": Criterion("iou_bev", 0.5),
    "two_wheeler": Criterion("center_m", 1.0),
    "pedestrian": Criterion("center_m", 1.0),
}
MIN_SCORE = 0.1
# Of the largest value, by the bits of the kernels; 8 at the edges of lines, where probabilities are steep, 7 where one step less or more is handed on.
MAX_EXPORT_ERROR = {32: 1e-4, 16: 2e-3, 8: 0.2, WEIGHT_BITS: 0.1}
RIDGE = 1e-3  # a box, which keeps the weights of rare groups finite
RAW_CALIBRATION = [0.0, 1.0, 0.0, 0.0, 0.0]


def export_onnx(checkpoint: Path, path: Path, info: dict[str, Any]) -> None:
    """Write the averaged weights of a checkpoint as ONNX and check that both compute the same.

    It computes in integers, see `quantization`.
    """
    state = torch.load(checkpoint, weights_only=True)["mean"]
    widths = widths_of({name.removesuffix(".conv.weight"): value for name, value in state.items()})
    network = quantized_network(BevNetwork(widths))
    network.load_state_dict(state)
    steps = quantize_kernels(network)
    axes, generator = {0: "batch", 2: "x", 3: "y"}, torch.Generator().manual_seed(0)
    checked = {"grid": torch.rand((1, IN_CHANNELS, 192, 256), generator=generator)}
    export_checked(network, path, checked, ("maps",), {"grid": axes, "maps": axes}, bits=WEIGHT_BITS, bias_steps=steps)
    describe(path, info)


def export_checked(
    network: nn.Module,
    path: Path,
    inputs: dict[str, Tensor],
    outputs: Sequence[str],
    axes: dict[str, dict[int, str]],
    *,
    bits: int = 32,
    bias_steps: Mapping[str, NDArray[np.float32]] = {},
) -> None:
    """Write a network as ONNX, its kernels in 32, 16, 8 or 7 `bits`; `axes` may have any length.

    `bias_steps`: by name, what biases are whole multiples of that are stored as integers.

    Raises `RuntimeError` when it computes something else of the inputs, by more than that share of the greatest output.
    """
    import onnx
    import onnxruntime

    with warnings.catch_warnings():
        # The old exporter is to go one day; it needs no further package, and the check below holds for any.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network, tuple(inputs.values()), str(path), input_names=list(inputs), output_names=list(outputs),
            opset_version=17, dynamo=False, dynamic_axes=axes,
        )  # fmt: skip
    model = onnx.load(path)
    for weight in [
        value for value in model.graph.initializer if bits < 32 and (len(value.dims) > 1 or value.name in bias_steps)
    ]:
        values, short = onnx.numpy_helper.to_array(weight), f"{weight.name}_short"
        model.graph.initializer.remove(weight)
        if bits == 16:
            values = values.astype(np.float16)
            node = onnx.helper.make_node("Cast", [short], [weight.name], to=onnx.TensorProto.FLOAT)
        else:
            largest = np.abs(values).max(axis=tuple(range(1, values.ndim))).clip(1e-12)  # of each output
            step = bias_steps.get(weight.name, largest / np.float32(2 ** (bits - 1) - 1))
            whole = np.rint(values / step.reshape(-1, *(1,) * (values.ndim - 1)))
            values = whole.astype(np.int32 if weight.name in bias_steps else np.int8)
            model.graph.initializer.append(onnx.numpy_helper.from_array(step, f"{short}_step"))
            node = onnx.helper.make_node("DequantizeLinear", [short, f"{short}_step"], [weight.name], axis=0)
        model.graph.initializer.append(onnx.numpy_helper.from_array(values, short))
        model.graph.node.insert(0, node)
    onnx.save(model, path)
    with torch.no_grad():
        expected = network(*inputs.values())
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    found = session.run(list(outputs), {name: value.numpy() for name, value in inputs.items()})
    for one, other in zip(found, [expected] if isinstance(expected, Tensor) else expected, strict=True):
        error, size = float(np.abs(one - other.numpy()).max()), float(other.abs().max())
        if not error < MAX_EXPORT_ERROR[bits] * max(size, 1.0):
            raise RuntimeError(f"{path}: ONNX and torch differ by {error:.2g} of {size:.2g}")


def import_onnx(path: Path, grids: Tensor) -> BevNetwork:
    """Read a network back from the ONNX file that `export_onnx` wrote, so that its training can go on.

    Its weights stay quantized. Normalization was folded into the convolutions. It is put back with the moments of each layer on some grids (B, 12, H, W): the
    network computes what it did, and still trains on normalized layers.
    """
    import onnx

    graph = onnx.load(path).graph
    values = {v.name: onnx.numpy_helper.to_array(v) for v in graph.initializer}
    folded = {}
    for node in graph.node:
        if node.op_type == "Cast":  # networks in floats, as were exported before
            values[node.output[0]] = values[node.input[0]].astype(np.float32)
        elif node.op_type == "DequantizeLinear" and node.input[0] in values:
            whole, step = (values[name].astype(np.float32) for name in node.input[:2])
            values[node.output[0]] = whole * step.reshape(-1, *(1,) * (whole.ndim - 1))
        elif node.op_type == "Conv":
            name = node.input[1].removesuffix(".weight").removesuffix(".conv")
            if name.startswith("onnx::"):
                # Kernels in floats have no names; "/down4/down4.0/down4.0.2/Relu_output_0" is of the layer "down4.0".
                name = node.output[0].split("/")[-2].rsplit(".", 1)[0]
            folded[name] = [torch.from_numpy(values[k].copy()) for k in node.input[1:]]
    network = BevNetwork(widths_of({name: kernel for name, (kernel, _) in folded.items()})).eval()
    network.head.weight.data, network.head.bias.data = folded["head"]
    layers = {
        m: name for name, m in network.named_modules() if isinstance(m, nn.Sequential) and isinstance(m[0], nn.Conv2d)
    }

    def restore(layer: Any, inputs: tuple[Tensor, ...], _: Tensor) -> Tensor:
        conv, norm, relu = layer
        conv.weight.data, bias = folded[layers[layer]]
        product = conv(inputs[0])
        mean, variance = product.mean((0, 2, 3)), product.var((0, 2, 3), unbiased=False)
        norm.running_mean, norm.running_var = mean, variance
        norm.weight.data, norm.bias.data = (variance + norm.eps).sqrt(), mean + bias
        return relu(norm(product))

    hooks = [layer.register_forward_hook(restore) for layer in layers]
    with torch.no_grad():
        network(grids)
    for hook in hooks:
        hook.remove()
    return network


def widened(network: BevNetwork, widths: Widths) -> BevNetwork:
    """Make a wider network that computes the same: the channels that were there do not use the new ones at first (Chen et al., ICLR 2016)."""
    wide = BevNetwork(widths).eval()
    state = wide.state_dict()
    for name, value in network.state_dict().items():
        old = tuple(slice(size) for size in value.shape)
        if value.ndim == 4:
            state[name][old[0]] = 0
        state[name][old] = value
    wide.load_state_dict(state)
    return wide


def describe(path: Path, info: dict[str, Any], key: str = METADATA_KEY) -> None:
    """Write the description of a network into its file."""
    import onnx

    model = onnx.load(path)
    del model.metadata_props[:]
    entry = model.metadata_props.add()
    entry.key, entry.value = key, json.dumps(info)
    onnx.save(model, path)


def description(mount: str, cell_m: float, range_m: float) -> dict[str, Any]:
    """Make the description of a network whose scores are not calibrated yet."""
    return {
        "version": 1,
        "name": mount,
        "cell_m": cell_m,
        "stride": 2,
        "range_m": range_m,
        "groups": list(GROUPS),
        "categories": CATEGORIES,
        "calibration": dict.fromkeys(GROUPS, RAW_CALIBRATION),
        "min_score": dict.fromkeys(GROUPS, MIN_SCORE),
        "card": {},
    }


def calibrate(path: Path, examples: list[Example]) -> dict[str, list[float]]:
    """Fit the weights of the scores to what is right in scenes that were not trained on."""
    detector = open_network(path, LidarConfig(), name="raw")
    features: dict[str, list[np.ndarray]] = {g: [] for g in GROUPS}
    right: dict[str, list[np.ndarray]] = {g: [] for g in GROUPS}
    for example in examples:
        found, columns = _raw_boxes(detector, example)
        for group in GROUPS:
            own = found.category == group
            truth = group_of(example.truth, group)
            matches = match_detections(found.take(own), truth, RIGHT[group])
            counted = matches.right | matches.false
            features[group].append(columns[own][counted])
            right[group].append(matches.right[counted])
    weights = {}
    for group in GROUPS:
        x, y = np.concatenate(features[group]), np.concatenate(right[group])
        weights[group] = logistic_regression(x, y, RIDGE * max(len(y), 1), RAW_CALIBRATION).round(5).tolist()
    return weights


def group_of(boxes: SceneBoxes, group: str) -> SceneBoxes:
    return boxes.take(np.array([GROUP_OF.get(str(c)) == group for c in boxes.category], bool))


def _raw_boxes(detector: NetworkDetector, example: Example) -> tuple[SceneBoxes, np.ndarray]:
    """Return boxes with their groups as categories, not scored, and the features (M, 5) of their scores."""
    found = detector.candidates(example.cloud)
    boxes, points = found.boxes, found.inside.count
    rows = np.column_stack([boxes.center_m, boxes.size_m, boxes.yaw_rad])
    names = np.array(detector.network.info.groups)[boxes.group]
    # Boxes of two groups may have become of one.
    apart = suppress(boxes.rectangles, boxes.heat, boxes.group, across=False)
    some = np.sort(apart[points[apart] > 0])
    table = SceneBoxes.of(rows, names, 1 / (1 + np.exp(-boxes.heat)), points=points)
    return table.take(some), found.terms.T[some]


SCORE = 0.5
RANGES_M = ((0, 15), (15, 30), (30, 50))
POINTS = ((5, 10), (10, 20), (20, 50), (50, 10**9))


def found_boxes(boxes: Boxes3D) -> SceneBoxes:
    """Return detections as a table of one scene."""
    rows = np.column_stack([boxes.center_m, boxes.size_m, boxes.yaw_rad])
    return SceneBoxes.of(rows, boxes.category, boxes.score, points=boxes.points)


def report(detector: LidarDetector, examples: list[Example], *, range_m: float) -> dict[str, Any]:
    found = [found_boxes(detector.detect(e.cloud)) for e in examples]
    out: dict[str, Any] = {"scenes": len(examples), "score": SCORE, "max_range_m": range_m}
    totals = np.zeros(3)
    for group in GROUPS:
        f = SceneBoxes.join([group_of(boxes, group) for boxes in found])
        t = SceneBoxes.join([group_of(e.truth, group) for e in examples])
        f, t = f.take(f.range_m < range_m), t.ignoring(t.range_m >= range_m)
        matches = match_detections(f, t, RIGHT[group])
        point = operating_point(f, matches, SCORE)
        totals += [point["true_positives"], point["false_positives"], point["false_negatives"]]
        right = np.flatnonzero(matches.right & (f.score >= SCORE))
        off = np.abs((f.box[right, 6] - t.box[matches.truth[right], 6] + np.pi) % (2 * np.pi) - np.pi)
        hit = np.zeros(len(t), bool)
        hit[matches.truth[right]] = True
        counted = ~t.ignored
        out[group] = {
            "match": str(RIGHT[group]),
            "truths": matches.truths,
            "average_precision": precision_recall(f, matches).average(40),
            **{k: point[k] for k in ("precision", "recall", "f1")},
            "headings_flipped": float((off > np.pi / 2).mean()) if len(off) else None,
            "recall_by_range_m": {
                f"{a}-{b}": _share(hit[counted & (t.range_m >= a) & (t.range_m < b)]) for a, b in RANGES_M
            },
            "recall_by_points": {f"{a}+": _share(hit[counted & (t.points >= a) & (t.points < b)]) for a, b in POINTS},
            "calibration": _reliability(f, matches),
        }
    tp, fp, fn = totals
    precision = tp / (tp + fp) if tp + fp else None
    out["all"] = {"precision": precision, "recall": tp / max(tp + fn, 1), "f1": 2 * tp / max(2 * tp + fp + fn, 1)}
    return out


def _share(hit: np.ndarray) -> list[float | int]:
    """Return the share of true values and how many there are."""
    return [round(float(hit.mean()), 4) if len(hit) else 0.0, len(hit)]


def _reliability(found: SceneBoxes, matches: Matches) -> list[list[float | int]]:
    """Return mean score, share that is right, and count of the bins of the score that have boxes."""
    bins = calibration(found, matches)["bins"]
    return [[round(b["mean_score"], 4), round(b["precision"], 4), b["boxes"]] for b in bins if b["boxes"]]
