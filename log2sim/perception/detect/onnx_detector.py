"""Detector of road users from an ONNX model, run on the whole image and on tiles of it."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from itertools import chain
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Detections, Frame
from log2sim.errors import ConfigError
from log2sim.perception.detect.classes import TRAFFIC_LIGHT, Classes, choose_classes, groups_of
from log2sim.perception.detect.layout import Layout, Outputs, describe_outputs
from log2sim.perception.detect.layouts import LAYOUTS, named_layout
from log2sim.perception.detect.onnx_model import OnnxModel, load_model
from log2sim.perception.detect.preprocessing import Placement
from log2sim.perception.detect.riders import join_riders
from log2sim.perception.detect.suppression import suppress
from log2sim.perception.detect.tiling import Tile, merge, plan_tiles

# Smaller boxes are rounding of the decoder.
MIN_BOX_PX = 2.0
# People and two-wheelers cover few pixels, of which a cast shadow or a turn takes a score from 0.8 to 0.2. From half of the least
# score on about half of their boxes are right; they continue tracks that stronger ones began.
# Traffic lights are small, too; they stand still, so that several weak boxes confirm each other.
WEAK_GROUPS, WEAK_SHARE = ("pedestrian", "two_wheeler", TRAFFIC_LIGHT), 0.5
# Side of the gray image by whose outputs a layout is recognized.
PROBE_PX = 320


@dataclass(frozen=True, eq=False)
class OnnxDetector:
    """Detector from a model, its output layout and settings.

    Attributes
    ----------
    name : str
    model : OnnxModel
    layout : Layout
    classes : Classes
    min_score : float
        Lowest score of a box.
    min_weak_score : float
        The same of people, two-wheelers and traffic lights: weaker boxes continue their tracks, and a weak bicycle under a person tells a rider.
    max_overlap : float
        IoU above which two boxes of one group are duplicates.
    tiles : int or "auto"
    default_min_score : float
        Lowest score where none is set.
    together : int
        Tiles in one run of a model of one size that takes any number of inputs; 1 for all others.
    """

    name: str
    model: OnnxModel
    layout: Layout
    classes: Classes
    min_score: float
    min_weak_score: float
    max_overlap: float
    tiles: Literal["auto"] | int
    default_min_score: float
    together: int = 1

    @property
    def cache_key(self) -> str | None:
        """All that the boxes depend on besides the picture; None where the weights are not all in the model's file."""
        import onnxruntime

        digest = self.model.digest()
        settings = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("name", "model", "together")}
        return None if digest is None else f"{digest} onnxruntime {onnxruntime.__version__} {settings!r}"

    def detect(self, frame: Frame) -> Detections:
        """Detect road users in one frame, best score first."""
        return self.detect_images([frame.image()])[0]

    def detect_many(self, frames: Sequence[Frame]) -> list[Detections]:
        """Detect road users in each of several frames, see `detect_images`."""
        return self.detect_images([frame.image() for frame in frames])

    def detect_images(self, images: Sequence[NDArray[np.uint8]]) -> list[Detections]:
        """Detect road users and traffic lights in each of several images (H, W, 3) uint8 BGR.

        Tiles are searched side by side, each by one thread: threads that share a tile wait for each other.
        """
        tiles = [self._tiles_of(image) for image in images]
        jobs = [(image, tile) for image, planned in zip(images, tiles) for tile in planned]
        together = max(1, min(self.together, -(-len(jobs) // self.model.threads)))
        runs = [jobs[i : i + together] for i in range(0, len(jobs), together)]
        with ThreadPoolExecutor(self.model.threads) as pool:
            found = chain.from_iterable(pool.map(self._detect_tiles, runs))
            return [
                self._merged([(tile, next(found)) for tile in planned], image) for image, planned in zip(images, tiles)
            ]

    def _tiles_of(self, image: NDArray[np.uint8]) -> list[Tile]:
        height, width = image.shape[:2]
        input_px = self.model.spec.width_px or self.layout.preprocessing.default_px
        return plan_tiles(width, height, self.tiles, input_px)

    def _merged(self, found: list[tuple[Tile, Detections]], image: NDArray[np.uint8]) -> Detections:
        """Merge what was found in the tiles of an image, and separate the traffic lights from the road users."""
        height, width = image.shape[:2]
        merged = merge(found, width, height, self.max_overlap)
        light = merged.category == TRAFFIC_LIGHT
        users = join_riders(merged.take(~light), sure_score=self.min_score)
        return replace(users, traffic_lights=np.column_stack([merged.box_px[light], merged.score[light]]))

    def _detect_tiles(self, jobs: Sequence[tuple[NDArray[np.uint8], Tile]]) -> list[Detections]:
        """Detect in tiles of images by one run of the model, each without duplicates."""
        inputs = [self.layout.preprocessing(tile.cut(image), self.model.spec) for image, tile in jobs]
        if len(inputs) == 1:
            outputs = [self.model.run(inputs[0][0])]
        else:
            joined = self.model.run(np.concatenate([tensor for tensor, _ in inputs]))
            outputs = [{name: array[k : k + 1] for name, array in joined.items()} for k in range(len(inputs))]
        return [
            suppress(self._boxes_of(of_tile, tile, placement), self.max_overlap)
            for of_tile, (_, tile), (_, placement) in zip(outputs, jobs, inputs, strict=True)
        ]

    def _boxes_of(self, outputs: Outputs, tile: Tile, placement: Placement) -> Detections:
        """Decode the outputs of one tile; boxes in px of the whole image, clipped to the tile."""
        found = self.layout.decode(outputs, placement.input_px, self.classes, min(self.min_score, self.min_weak_score))
        box = placement.to_image(found.box_input)
        finite = np.isfinite(box).all(axis=1) & np.isfinite(found.score)
        low, high = np.zeros(2), np.array([tile.u1 - tile.u0, tile.v1 - tile.v0], dtype=np.float64)
        box = np.clip(box, np.tile(low, 2), np.tile(high, 2))
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
    chosen = named_layout(layout_name) if layout_name is not None else None
    model = load_model(path)
    layout, outputs = recognize_layout(model, chosen)
    try:
        count = layout.class_count(outputs)
        classes = choose_classes(model.metadata.get("names"), count, layout.default_classes, str(path))
        layout.decode(outputs, probe_size(model, layout), classes, 0.5)
    except (IndexError, ValueError, TypeError) as error:
        raise ConfigError(
            f"{path}: outputs {describe_outputs(outputs)} do not fit the layout '{layout.name}' ({error})"
        ) from None
    if input_px is not None:
        layout = with_input_size(layout, model, input_px)
    score = layout.default_min_score if min_score is None else min_score
    weak = WEAK_SHARE * score if min_score is None else score
    return OnnxDetector(
        name or path.name, model, layout, classes, score, weak, max_overlap, tiles, layout.default_min_score
    )


def recognize_layout(model: OnnxModel, chosen: Layout | None) -> tuple[Layout, Outputs]:
    """Recognize the layout of a model by its outputs for a gray image; returns both.

    Notes
    -----
    The declared shapes are not enough: many exports leave them open, and decoded boxes look like undecoded ones.
    """
    tried: dict[tuple[int, ...], Outputs] = {}
    outputs: Outputs = {}
    failure: ConfigError | None = None
    for layout in [chosen] if chosen is not None else LAYOUTS.values():
        probe, placement = layout.preprocessing(np.full((PROBE_PX, PROBE_PX, 3), 114, np.uint8), model.spec)
        if probe.shape not in tried:
            try:
                tried[probe.shape] = model.run(probe)
            except ConfigError as error:  # many models of any size want multiples of 32, which not every layout gives
                failure = failure or error
                tried[probe.shape] = {}
        if not tried[probe.shape]:
            continue
        outputs = tried[probe.shape]
        if chosen is not None or layout.matches(outputs, placement.input_px):
            return layout, outputs
    if failure is not None and not outputs:
        raise failure
    raise ConfigError(
        f"{model.path}: outputs {describe_outputs(outputs)} are of no layout that is recognized by itself; "
        f"name one with layout=: {', '.join(LAYOUTS)}"
    )


def with_input_size(layout: Layout, model: OnnxModel, input_px: int) -> Layout:
    """Return the layout with another side of the input, which the model is tried on."""
    if model.spec.width_px is not None or model.spec.height_px is not None:
        raise ConfigError(
            f"{model.path}: input_px {input_px}: the model takes {model.spec.width_px} x {model.spec.height_px} px and "
            "nothing else; leave input_px out"
        )
    changed: Any = replace(cast(Any, layout), preprocessing=replace(layout.preprocessing, default_px=input_px))
    model.run(changed.preprocessing(np.full((PROBE_PX, PROBE_PX, 3), 114, np.uint8), model.spec)[0])
    return cast(Layout, changed)


def probe_size(model: OnnxModel, layout: Layout) -> tuple[int, int]:
    """Return the size (width, height) in px of the input that the gray image was resized to."""
    side = layout.preprocessing.default_px or PROBE_PX
    return model.spec.width_px or side, model.spec.height_px or side
