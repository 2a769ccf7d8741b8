"""The network that names the color of a vehicle in pictures of it.

It was trained on rendered vehicles alone (`tools/train_colors.py`); its file describes itself under `METADATA_KEY`, the card beside it
tells seed, data, steps and figures.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import COLOR_NAMES
from log2sim.errors import ConfigError
from log2sim.geometry import Array
from log2sim.perception.detect3d.network import open_session

Image = NDArray[np.uint8]

FILE = Path(__file__).with_name("weights") / "colors.onnx"
METADATA_KEY = "log2sim.colors"
MAX_BYTES = 1024**2
SIDE_PX = 48  # of the picture that the network sees
# Sides of what it sees relative to those of the vehicle's box: the road and what is beside tell the light.
CONTEXT = 1.3
LAB_SCALE = 30.0  # units of CIELAB of its outputs


@dataclass(frozen=True, eq=False)
class ColorNetwork:
    """Loaded network."""

    session: Any  # onnxruntime.InferenceSession
    scale: float  # of the logits of one picture, by which their softmax is calibrated
    power: float  # of the number of pictures of one vehicle, by which the sum of their logits is divided: their errors are alike

    def raw(self, crops: Sequence[Image]) -> Array:
        """Return logits of the names and the color in CIELAB by `LAB_SCALE`, (N, 13), of crops (48, 48, 3), BGR."""
        pictures = np.stack(crops)[..., ::-1].transpose(0, 3, 1, 2).astype(np.float32) / 255
        return np.asarray(self.session.run(["names"], {"picture": np.ascontiguousarray(pictures)})[0], np.float64)

    def decide(self, raw: Array) -> tuple[Array, Array]:
        """Join outputs (N, 13) for crops of one vehicle: its color (3,) in CIELAB, and the probability (K,) of each of `COLOR_NAMES`."""
        names = len(COLOR_NAMES)
        logits = self.scale * raw[:, :names].sum(axis=0) / len(raw) ** self.power
        share = np.exp(logits - logits.max())
        return np.median(raw[:, names:], axis=0) * LAB_SCALE, share / share.sum()

    def probabilities(self, crops: Sequence[Image]) -> Array:
        """Return how probable each of `COLOR_NAMES` (K,) is for a vehicle in crops."""
        return self.decide(self.raw(crops))[1]


def open_color_network(path: Path) -> ColorNetwork:
    """Load a network; `ConfigError` where the file is none."""
    session = open_session(path, MAX_BYTES, "network of colors")
    try:
        info = json.loads(session.get_modelmeta().custom_metadata_map[METADATA_KEY])
        return ColorNetwork(session, float(info["scale"]), float(info["power"]))
    except (KeyError, ValueError, TypeError) as error:
        raise ConfigError(f"{path}: no network of colors: {error!r}") from None


@lru_cache(maxsize=1)
def shipped_network() -> ColorNetwork:
    """Load the network that comes with log2sim, once."""
    return open_color_network(FILE)


def crop(image_bgr: Image, box_px: Array) -> Image:
    """Cut a vehicle's box (4,), u0, v0, u1, v1, with its context out of a picture; edges go on beyond the picture's."""
    middle, half = (box_px[:2] + box_px[2:]) / 2, (box_px[2:] - box_px[:2]) / 2 * CONTEXT
    (u0, v0), (u1, v1) = np.floor(middle - half).astype(int), np.ceil(middle + half).astype(int)
    height, width = image_bgr.shape[:2]
    inner = image_bgr[max(v0, 0) : max(v1, 0), max(u0, 0) : max(u1, 0)]
    edges = max(-v0, 0), max(v1 - height, 0), max(-u0, 0), max(u1 - width, 0)
    if any(edges):
        inner = np.asarray(cv2.copyMakeBorder(inner, *edges, cv2.BORDER_REPLICATE), np.uint8)
    shrinks = min(inner.shape[:2]) > SIDE_PX
    return np.asarray(
        cv2.resize(inner, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR), np.uint8
    )
