"""Detector of road users from an ONNX model, run on the whole image and on tiles."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Detections, Frame, Turn, groups_of
from log2sim.errors import ConfigError
from log2sim.files.inputs import read_file
from log2sim.geometry import Array, box_iou
from log2sim.perception.detect.layouts import (
    LAYOUTS,
    LETTERBOX_GRAY,
    TRAFFIC_LIGHT,
    Classes,
    InputSpec,
    Layout,
    Outputs,
    Placement,
    cell_count,
    choose_classes,
    describe_outputs,
    single_output_shape,
)
from log2sim.perception.detect3d.network import first_line, open_session

MAX_FILE_BYTES = 2 * 1024**3
MAX_INPUT_SIDE_PX = 8192
# How the name of another file begins in a protocol buffer: field 1, 8 bytes, "location" (onnx.proto, TensorProto.external_data).
EXTERNAL_DATA = b"\n\x08location"
DTYPES: Mapping[str, type] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
}


@dataclass(frozen=True, eq=False)
class OnnxModel:
    """Loaded model; `run` may be called from several threads."""

    path: Path
    spec: InputSpec
    metadata: Mapping[str, str]  # custom metadata of the file, such as class names
    session: Any  # runs in the thread that calls it

    def digest(self) -> str | None:
        """Return the SHA-256 of the file; None for one whose weights are in other files."""
        content = read_file(self.path, MAX_FILE_BYTES, ConfigError)
        return None if EXTERNAL_DATA in content else hashlib.sha256(content).hexdigest()

    def run(self, tensor: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Run the model on one input; returns all outputs by name."""
        names = [output.name for output in self.session.get_outputs()]
        try:
            return dict(zip(names, self.session.run(names, {self.spec.name: tensor}), strict=True))
        except Exception as error:  # ONNX Runtime has many exceptions and no base of its own
            raise ConfigError(f"{self.path}: the model fails on an image {tensor.shape}: {first_line(error)}") from None


def load_model(path: Path) -> OnnxModel:
    """Load an ONNX file.

    Raises `ConfigError`: a missing, oversized or broken file, or a model whose inputs are not one image.
    """
    session = open_session(path, MAX_FILE_BYTES, "model")
    inputs = session.get_inputs()
    listed = ", ".join(f"'{i.name}' {i.type} {i.shape}" for i in inputs)
    if len(inputs) != 1 or len(inputs[0].shape) != 4 or inputs[0].type not in DTYPES:
        raise ConfigError(f"{path}: inputs {listed}; expected one image (1, 3, H, W) or (1, H, W, 3), float or uint8")
    batch, *rest = (d if isinstance(d, int) and d > 0 else None for d in inputs[0].shape)
    channels_last = rest[2] == 3 and rest[0] != 3
    height, width = rest[:2] if channels_last else rest[1:]
    if batch not in (None, 1) or (not channels_last and rest[0] != 3):
        raise ConfigError(f"{path}: input {listed}; expected one image of 3 channels at a time")
    if max(height or 1, width or 1) > MAX_INPUT_SIDE_PX:
        raise ConfigError(f"{path}: input {listed}; expected sides of at most {MAX_INPUT_SIDE_PX} px")
    spec = InputSpec(inputs[0].name, height, width, channels_last, np.dtype(DTYPES[inputs[0].type]))
    return OnnxModel(path, spec, dict(session.get_modelmeta().custom_metadata_map), session)


# Of more boxes the weakest are cut, since suppression takes time quadratic in their number.
MAX_CANDIDATES = 2000


def strongest_first(detections: Detections) -> Detections:
    """Sort by descending score, ties by box and category, so that the order of the input does not matter."""
    box = detections.box_px
    keys = (detections.category, box[:, 3], box[:, 2], box[:, 1], box[:, 0], -detections.score)
    return detections.take(np.lexsort(keys))


def suppress(detections: Detections, max_overlap: float) -> Detections:
    """Keep the strongest of boxes that overlap by more than `max_overlap` (IoU) within one group of categories.

    Greedy suppression across the classes of a group: a van that a model detects as car and truck becomes one box, while
    a person in front of a car is kept. O(M^2) time.
    """
    ordered = strongest_first(detections).take(slice(MAX_CANDIDATES))
    box, group, keep = ordered.box_px, groups_of(ordered.category), np.ones(len(ordered), dtype=bool)
    for i in range(len(box)):
        if keep[i]:
            later = np.flatnonzero(keep[i + 1 :] & (group[i + 1 :] == group[i])) + i + 1
            keep[later] = box_iou(box[i], box[later])[0] <= max_overlap
    return ordered.take(keep)


# Overlap of neighboring tiles as a share of a tile's width; wider objects are detected in the whole image.
OVERLAP = 0.35
# Margin at a tile's border as a share of its width: about how exactly models place the edge of a cut object.
BORDER = 0.025
# Pixels of a tile for each pixel of the input: with more, far cars are missed, with less, time is lost.
MAX_DOWNSCALING = 1.6
MAX_AUTO_TILES = 5


@dataclass(frozen=True)
class Tile:
    """Part of an image: columns u0..u1 and rows v0..v1 in px, ends excluded."""

    u0: int
    v0: int
    u1: int
    v1: int


def plan_tiles(width_px: int, height_px: int, tiles: Literal["auto"] | int, input_px: int | None) -> list[Tile]:
    """Plan the whole image and one row of tiles from left to right, vertically centered, no higher than wide.

    `tiles`: 1: only the whole image; N: also N tiles; "auto": so many that none is downscaled by more than `MAX_DOWNSCALING`.
    `input_px`: width of the model's input, None where it takes any size.

    The sky and the road right in front of the car are seen in the whole image only: no far objects are there.
    """
    whole = Tile(0, 0, width_px, height_px)
    count = 1 if tiles == "auto" else tiles
    if tiles == "auto" and input_px is not None and width_px > MAX_DOWNSCALING * input_px:
        count = min(math.ceil((width_px / (MAX_DOWNSCALING * input_px) - OVERLAP) / (1 - OVERLAP)), MAX_AUTO_TILES)
    if count < 2:
        return [whole]
    tile_width = math.ceil(width_px / (count - (count - 1) * OVERLAP))
    tile_height = min(height_px, tile_width)
    v0 = (height_px - tile_height) // 2
    starts = np.rint(np.linspace(0, width_px - tile_width, count)).astype(int).tolist()
    return [whole, *(Tile(u, v0, u + tile_width, v0 + tile_height) for u in starts)]


def tiles_of_turn(planned: list[Tile], turn: Turn) -> list[Tile]:
    """Return the whole image, every second tile of its row, and those whose middle is nearest to a watched box."""
    whole, row = planned[0], planned[1:]
    if len(row) < 2:
        return planned
    middle = np.array([(tile.u0 + tile.u1) / 2 for tile in row])
    chosen = (np.arange(len(row)) + turn.number) % 2 == 0
    u = (turn.watched_px[:, 0] + turn.watched_px[:, 2]) / 2
    chosen[np.abs(u[:, None] - middle).argmin(axis=1)] = True
    return [whole, *(tile for tile, kept in zip(row, chosen) if kept)]


def merge(found: list[tuple[Tile, Detections]], width_px: int, height_px: int, max_overlap: float) -> Detections:
    """Merge the boxes of all tiles, in px of the whole image, into one set.

    A box cut by an inner border is dropped: tiles overlap, and objects larger than the overlap are detected in the whole
    image. A half box would give a wrong object, a missing box only a missing observation of a track.
    """
    if not found:
        return Detections.empty()
    kept = []
    for tile, boxes in found:
        u0, v0, u1, v1 = boxes.box_px.T
        margin = BORDER * (tile.u1 - tile.u0)
        cut = ((tile.u0 > 0) & (u0 < tile.u0 + margin)) | ((tile.u1 < width_px) & (u1 > tile.u1 - margin))
        cut |= ((tile.v0 > 0) & (v0 < tile.v0 + margin)) | ((tile.v1 < height_px) & (v1 > tile.v1 - margin))
        kept.append(boxes.take(~cut))
    joined = (np.concatenate([getattr(d, name) for d in kept]) for name in ("box_px", "score", "category"))
    return suppress(Detections(*joined), max_overlap)


# Shares of the narrower width that rider and two-wheeler have in common.
MIN_HORIZONTAL_SHARE = 0.5
# Difference of the lower edges, in heights of the two-wheeler: feet are between its axles and the ground.
MAX_FEET_OFFSET = 0.5
# Share of a box's area inside a joined box beyond which it is the same two-wheeler or person once more.
MAX_INSIDE_SHARE = 0.8
# How far a rider rises above the two-wheeler, in heights of it.
MIN_RISE = 0.1
RIDDEN = {"bicycle": "cyclist", "motorcycle": "motorcycle", "cyclist": "cyclist"}


def join_riders(detections: Detections, *, sure_score: float = 0.0) -> Detections:
    """Replace each two-wheeler and the person on it by one box around both; a bicycle without a person stays one.

    `sure_score`: a two-wheeler of a lower score inside the person's box is a bag or clothes, and is not joined.

    A person rides if its box ends near the two-wheeler's lower edge, rises above it, and shares most of the narrower
    width of both. A person who pushes a bicycle is often joined too: one image does not tell the two cases apart, and
    both move as one. Pairs are chosen greedily, each box in one pair. Boxes inside a pair are dropped, since models often
    detect a wheel or a torso as another bicycle or person.
    """
    person = np.flatnonzero(detections.category == "pedestrian")
    wheeler = np.flatnonzero(np.isin(detections.category, list(RIDDEN)))
    if not len(person) or not len(wheeler):
        return detections
    # The width (P, W) in [0, 1] that pairs share; 0 for those that do not fit.
    a, b = detections.box_px[person, None], detections.box_px[None, wheeler]
    shared = np.minimum(a[..., 2], b[..., 2]) - np.maximum(a[..., 0], b[..., 0])
    narrow = np.minimum(a[..., 2] - a[..., 0], b[..., 2] - b[..., 0])
    share = np.divide(shared, narrow, out=np.zeros_like(shared), where=narrow > 0)
    height = b[..., 3] - b[..., 1]
    rises_above = a[..., 1] < b[..., 1] - MIN_RISE * height
    # Of a person nearer or farther than the two-wheeler the lower edge is elsewhere.
    same_depth = np.abs(a[..., 3] - b[..., 3]) < MAX_FEET_OFFSET * height
    fit = np.where((share >= MIN_HORIZONTAL_SHARE) & rises_above & same_depth, np.clip(share, 0, 1), 0.0)
    for weak in np.flatnonzero(detections.score[wheeler] < sure_score).tolist():
        px = detections.box_px[wheeler[weak]]
        fit[[inside_share(px[None], p)[0] > MAX_INSIDE_SHARE for p in detections.box_px[person]], weak] = 0
    box, score = detections.box_px.copy(), detections.score.copy()
    category, kept = detections.category.copy(), np.ones(len(detections), dtype=bool)
    while fit.max() > 0:
        p, w = np.unravel_index(int(np.argmax(fit)), fit.shape)
        i, j = person[p], wheeler[w]
        box[j] = np.concatenate([np.minimum(box[i, :2], box[j, :2]), np.maximum(box[i, 2:], box[j, 2:])])
        score[j], category[j] = max(score[i], score[j]), RIDDEN[str(category[j])]
        fit[:, w] = 0
        kept[i] = False
        again = inside_share(box, box[j]) > MAX_INSIDE_SHARE
        again[j] = False
        kept &= ~(again & np.isin(category, ["bicycle", "motorcycle", "pedestrian"]))
        fit[~kept[person], :], fit[:, ~kept[wheeler]] = 0, 0
    return strongest_first(Detections(box, score, category).take(kept))


def inside_share(box_px: Array, outer_px: Array) -> Array:
    """Compute the share (M,) in [0, 1] of the area of boxes (M, 4) inside one other (4,); 0 for empty ones."""
    shared = np.minimum(box_px[:, 2:], outer_px[2:]) - np.maximum(box_px[:, :2], outer_px[:2])
    area = np.prod(box_px[:, 2:] - box_px[:, :2], axis=1)
    return np.asarray(np.divide(np.clip(shared, 0, None).prod(axis=1), area, out=np.zeros(len(area)), where=area > 0))


# Smaller boxes are rounding of the decoder.
MIN_BOX_PX = 2.0
# People and two-wheelers cover few pixels, of which a cast shadow or a turn takes a score from 0.8 to 0.2. From half of the least
# score on about half of their boxes are right; they continue tracks that stronger ones began.
# Traffic lights are small, too; they stand still, so that several weak boxes confirm each other.
WEAK_GROUPS, WEAK_SHARE = ("pedestrian", "two_wheeler", TRAFFIC_LIGHT), 0.5
# The gray image, and its side, by whose outputs a layout is recognized.
PROBE_PX = 320
PROBE = np.full((PROBE_PX, PROBE_PX, 3), LETTERBOX_GRAY, np.uint8)


@dataclass(frozen=True, eq=False)
class OnnxDetector:
    """Detector from a model, its output layout and settings."""

    name: str
    model: OnnxModel
    layout: Layout
    classes: Classes
    min_score: float  # lowest score of a box
    # The same of `WEAK_GROUPS`: weaker boxes continue their tracks, and a weak bicycle under a person tells a rider
    min_weak_score: float
    max_overlap: float  # IoU above which two boxes of one group are duplicates
    tiles: Literal["auto"] | int
    default_min_score: float  # lowest score where none is set
    together: int = 1  # tiles in one run of a model of one size that takes any number of inputs; 1 for all others

    @property
    def cache_key(self) -> str | None:
        """All that the boxes depend on besides the picture; None where the weights are not all in the model's file."""
        import onnxruntime

        digest = self.model.digest()
        settings = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("name", "model", "together")}
        return None if digest is None else f"{digest} onnxruntime {onnxruntime.__version__} {settings!r}"

    def tiles_of(self, width_px: int, height_px: int) -> list[Tile]:
        """Return the tiles of an image that are searched, the whole image first."""
        input_px = self.model.spec.width_px or self.layout.preprocessing.default_px
        return plan_tiles(width_px, height_px, self.tiles, input_px)

    def detect(self, frame: Frame) -> Detections:
        """Detect road users in one frame, best score first."""
        return self.detect_many([frame])[0]

    def detect_many(self, frames: Sequence[Frame]) -> list[Detections]:
        """Detect road users and traffic lights in each of several frames."""
        images = [frame.image() for frame in frames]
        tiles = [self.tiles_of(image.shape[1], image.shape[0]) for image in images]
        tiles = [planned if f.turn is None else tiles_of_turn(planned, f.turn) for planned, f in zip(tiles, frames)]
        jobs, found = [(image, tile) for image, planned in zip(images, tiles) for tile in planned], list[Detections]()
        for first in range(0, len(jobs), self.together):
            run = jobs[first : first + self.together]
            inputs = [
                self.layout.preprocessing(image[tile.v0 : tile.v1, tile.u0 : tile.u1], self.model.spec)
                for image, tile in run
            ]
            joined = self.model.run(np.concatenate([tensor for tensor, _ in inputs]) if len(run) > 1 else inputs[0][0])
            for k, ((_, tile), (_, placement)) in enumerate(zip(run, inputs)):
                of_tile = joined if len(run) == 1 else {name: array[k : k + 1] for name, array in joined.items()}
                found.append(suppress(self._boxes_of(of_tile, tile, placement), self.max_overlap))
        out, rest = [], iter(found)
        for image, planned in zip(images, tiles):
            merged = merge([(tile, next(rest)) for tile in planned], image.shape[1], image.shape[0], self.max_overlap)
            light = merged.category == TRAFFIC_LIGHT
            users = join_riders(merged.take(~light), sure_score=self.min_score)
            lights = np.column_stack([merged.box_px[light], merged.score[light]])
            out.append(replace(users, traffic_lights=lights))
        return out

    def _boxes_of(self, outputs: Outputs, tile: Tile, placement: Placement) -> Detections:
        """Decode the outputs of one tile; boxes in px of the whole image, clipped to the tile."""
        found = self.layout.decode(outputs, placement.input_px, self.classes, min(self.min_score, self.min_weak_score))
        box = placement.to_image(found.box_input)
        finite = np.isfinite(box).all(axis=1) & np.isfinite(found.score)
        box = np.clip(box, 0.0, np.tile([tile.u1 - tile.u0, tile.v1 - tile.v0], 2).astype(np.float64))
        kept = finite & np.all(box[:, 2:] - box[:, :2] >= MIN_BOX_PX, axis=1)
        weak = np.isin(groups_of(found.category), WEAK_GROUPS)
        kept &= found.score >= np.where(weak, self.min_weak_score, self.min_score)
        origin = np.array([tile.u0, tile.v0, tile.u0, tile.v0], dtype=np.float64)
        score = np.clip(found.score[kept], 0.0, 1.0)
        return Detections(box[kept] + origin, score, found.category[kept].astype("<U16"))


def open_onnx(
    path: Path,
    *,
    min_score: float | None,
    max_overlap: float,
    tiles: Literal["auto"] | int,
    layout_name: str | None = None,
    input_px: int | None = None,
    name: str | None = None,
) -> OnnxDetector:
    """Load a model, recognize its layout and classes by a gray image, and make a detector of it."""
    if layout_name is not None and layout_name not in LAYOUTS:
        raise ConfigError(f"unknown layout '{layout_name}'; known: {', '.join(LAYOUTS)}")
    model = load_model(path)
    # Declared shapes are not enough: many exports leave them open, and decoded boxes look like undecoded ones.
    tried: dict[tuple[int, ...], Outputs] = {}
    outputs: Outputs = {}
    failure: ConfigError | None = None
    for layout in LAYOUTS.values() if layout_name is None else [LAYOUTS[layout_name]]:
        probe, placement = layout.preprocessing(PROBE, model.spec)
        if probe.shape not in tried:
            try:
                tried[probe.shape] = model.run(probe)
            except ConfigError as error:  # many models of any size want multiples of 32, which not every layout gives
                tried[probe.shape], failure = {}, failure or error
        outputs = tried[probe.shape] or outputs
        shape, cells = single_output_shape(outputs), cell_count(placement.input_px)
        if tried[probe.shape] and (layout_name is not None or layout.matches(outputs, shape, cells)):
            break
    else:
        if failure is not None and not outputs:
            raise failure
        raise ConfigError(
            f"{path}: outputs {describe_outputs(outputs)} are of no layout that is recognized by itself; name one with "
            f"layout=: {', '.join(LAYOUTS)}"
        )
    spec, side = model.spec, layout.preprocessing.default_px or PROBE_PX
    try:
        count = layout.class_count(outputs)
        classes = choose_classes(model.metadata.get("names"), count, layout.default_classes, str(path))
        layout.decode(outputs, (spec.width_px or side, spec.height_px or side), classes, 0.5)
    except (IndexError, ValueError, TypeError) as error:
        raise ConfigError(
            f"{path}: outputs {describe_outputs(outputs)} do not fit the layout '{layout.name}' ({error})"
        ) from None
    if input_px is not None:
        if spec.width_px is not None or spec.height_px is not None:
            raise ConfigError(
                f"{path}: input_px {input_px}: the model takes {spec.width_px} x {spec.height_px} px and nothing else; leave "
                "input_px out"
            )
        layout = replace(layout, preprocessing=replace(layout.preprocessing, default_px=input_px))
        model.run(layout.preprocessing(PROBE, spec)[0])
    score = layout.default_min_score if min_score is None else min_score
    weak = WEAK_SHARE * score if min_score is None else score
    return OnnxDetector(
        name or path.name, model, layout, classes, score, weak, max_overlap, tiles, layout.default_min_score
    )
