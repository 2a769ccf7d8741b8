"""Probabilities of markings and borders of roads in each cell of a map of the ground, by a network.

The network was trained on maps and pictures of simulated roads alone (`tools/train.py markings`); the card beside its file tells seed,
data, steps and figures.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from log2sim.errors import ConfigError
from log2sim.files.arrays import Columns
from log2sim.geometry import Array
from log2sim.perception.detect3d.network import open_session
from log2sim.road.ground_map import GroundMap, Raster
from log2sim.road.samples import Layer, Mask, coarse_means, high_pass, log_color, log_intensity
from log2sim.road.surface import USUAL

FILE = Path(__file__).with_name("weights") / "markings.onnx"
METADATA_KEY = "log2sim.markings"
MAX_BYTES = 4 * 1024**2
FINE_M, CELL_M = 0.05, 0.1  # cells that the network is given and answers for; lines are 0.1 m wide at least
LANE_LINES = ("solid", "dashed")
LINES = (*LANE_LINES, "stop_line")
KINDS = (*LINES, "crosswalk", "other")  # after what is no marking
BORDER, WIDTH = 1 + len(KINDS), 4 + len(KINDS)  # of what it answers; between them the direction of lines
CHANNELS, OUTPUTS = 12, WIDTH + 1
SIZE_MULTIPLE = 8  # it halves the map three times
TILE_CELLS, MARGIN_CELLS = 512, 96  # what is farther away than the margin hardly changes anything
AROUND_M, HEIGHT_AROUND_M = 3.0, 1.5  # means within which are subtracted
MAX_PAINT, MAX_INTENSITY, MAX_HEIGHT_M = 1.5, 2.0, 0.3
MIN_PROBABILITY = 0.5  # of points on lines: that are rather there than not
MAX_LOG_ODDS = 6.0
SMOOTH_CELLS = 0.7  # half of the least width of lines


@dataclass(frozen=True, eq=False)
class PaintMaps:
    """What the network says of R x C cells of `CELL_M`; 0 where no sensor saw the ground."""

    probability: NDArray[np.float32]  # (5, R, C): of the kinds of markings
    border: Layer  # (R, C): probability of the border of a road
    width_m: Layer  # (R, C): of lines
    seen: Mask  # (R, C): whether a sensor saw the ground
    raster: Raster
    objects: Mapping[str, tuple[float, float]]  # see `MarkingsNetwork`

    @cached_property
    def lane_line(self) -> Layer:
        """Probability (R, C) of lane lines of either kind."""
        return np.asarray(self.probability[: len(LANE_LINES)].sum(axis=0))

    @cached_property
    def line(self) -> Layer:
        """Probability (R, C) of lines of any kind."""
        return np.asarray(self.probability[: len(LINES)].sum(axis=0))

    def at(self, layer: Layer, xy: Array) -> Array:
        """Sample a layer at points (N, 2), m; 0 outside the map."""
        rows, columns = self.raster.cells_of(xy)
        return np.asarray(map_coordinates(layer, [rows, columns], order=1), np.float64)

    def object_log_odds(self, name: str, xy: Array) -> float:
        """Log-odds that a whole "lane_line", "border" or other kind of marking is at points (N, 2), m.

        The calibrated mean of the log-odds of its cells.
        """
        layer = {"lane_line": self.lane_line, "border": self.border} | dict(zip(KINDS, self.probability))
        p = self.at(layer[name], xy)
        offset, slope = self.objects.get(name, (0.0, 1.0))
        odds = np.log(np.maximum(p, 1e-9) / np.maximum(1 - p, 1e-9)).clip(-MAX_LOG_ODDS, MAX_LOG_ODDS)
        return float(offset + slope * odds.mean())


@dataclass(frozen=True, eq=False)
class MarkingsNetwork:
    """Loaded network."""

    session: Any  # onnxruntime.InferenceSession
    objects: Mapping[str, tuple[float, float]]  # by kind: offset and slope of the mean log-odds of its cells


def open_markings_network(path: Path) -> MarkingsNetwork:
    """Load a network; `ConfigError` where the file is none."""
    session = open_session(path, MAX_BYTES, "network of markings")
    try:
        info = json.loads(session.get_modelmeta().custom_metadata_map[METADATA_KEY])
        objects = {kind: (float(offset), float(slope)) for kind, (offset, slope) in info["objects"].items()}
    except (KeyError, ValueError, TypeError) as error:
        raise ConfigError(f"{path}: no network of markings: {error!r}") from None
    return MarkingsNetwork(session, objects)


@lru_cache(maxsize=1)
def shipped_network() -> MarkingsNetwork:
    """Load the network that comes with log2sim, once."""
    return open_markings_network(FILE)


def inputs_of(
    color_bgr: NDArray[np.uint8], alpha: NDArray[np.uint8], intensity: Layer, height_m: Layer
) -> NDArray[np.float32]:
    """Make the input (12, R, C) of the network from layers (2 R, 2 C) of a map in cells of `FINE_M`.

    Color that stands out as paint does, in each of four cells; yellowness; how much of it a camera saw, and how well; LiDAR intensity
    against what is around and against the road; where it is known; height against what is around, and where that is known.
    """
    out = np.zeros((CHANNELS, alpha.shape[0] // 2, alpha.shape[1] // 2), np.float32)
    seen, hit, known = alpha > 0, np.isfinite(intensity), np.isfinite(height_m)
    around = round(AROUND_M / CELL_M)
    if seen.any():
        bright, yellow = log_color(color_bgr)
        paint = high_pass(bright + yellow, seen.astype(np.float32), 2 * around).clip(-MAX_PAINT, MAX_PAINT)
        out[:4] = [paint[i::2, j::2] for i, j in np.ndindex(2, 2)]
        mean, share = coarse_means(yellow, seen, 2)
        well = cv2.resize(alpha.astype(np.float32) / 255, share.shape[::-1], interpolation=cv2.INTER_AREA)
        out[4], out[5], out[6] = high_pass(mean, share, around), share, well
    if hit.any():
        mean, share = coarse_means(log_intensity(np.nan_to_num(intensity)), hit, 2)
        there = (share > 0).astype(np.float32)
        out[7] = high_pass(mean, there, around).clip(-MAX_INTENSITY, MAX_INTENSITY) / 1.5
        out[8], out[9] = there * (mean - log_intensity(np.array(USUAL))) / 2, there
    if known.any():
        mean, share = coarse_means(height_m, known, 2)
        there = (share > 0).astype(np.float32)
        out[10] = high_pass(mean, there, round(HEIGHT_AROUND_M / CELL_M)).clip(-MAX_HEIGHT_M, MAX_HEIGHT_M) * 5
        out[11] = there
    return out


def find_paint_maps(ground: GroundMap, network: MarkingsNetwork | None = None) -> PaintMaps:
    """Compute the probabilities of markings and borders in a map.

    Maps of finer cells are thinned out, each cell of coarser ones is repeated, so that the network is given cells of about `FINE_M`.
    """
    network = network or shipped_network()
    step, repeat = max(1, round(FINE_M / ground.resolution_m)), 1 if ground.resolution_m < CELL_M / np.sqrt(2) else 2
    rows, columns = (max(1, n * repeat // step // 2) for n in ground.alpha.shape)
    cell_m = 2 * ground.resolution_m * step / repeat
    x0, _, _, y1 = ground.extent_m
    raster = Raster((x0, x0 + columns * cell_m, y1 - rows * cell_m, y1), cell_m, (rows, columns))
    out, seen = np.zeros((OUTPUTS, rows, columns), np.float32), np.zeros((rows, columns), dtype=bool)
    for r, c in np.ndindex(-(-rows // TILE_CELLS), -(-columns // TILE_CELLS)):
        core = [slice(k * TILE_CELLS, min((k + 1) * TILE_CELLS, n)) for k, n in ((r, rows), (c, columns))]
        begin = [max(part.start - MARGIN_CELLS, 0) for part in core]
        fine = [
            np.arange(2 * k, 2 * min(part.stop + MARGIN_CELLS, n)) for k, part, n in zip(begin, core, (rows, columns))
        ]
        cells = np.ix_(*(np.minimum(k * step // repeat, n - 1) for k, n in zip(fine, ground.alpha.shape)))
        alpha, intensity = ground.alpha[cells], ground.intensity[cells]
        if not (alpha.any() or np.isfinite(intensity).any()):
            continue
        values = inputs_of(ground.color_bgr[cells], alpha, intensity, ground.height_m[cells])
        padded = np.pad(values, [(0, 0), *((0, -n % SIZE_MULTIPLE) for n in values.shape[1:])])
        (found,) = network.session.run(["paint"], {"map": padded[None]})
        inner = tuple(slice(part.start - k, part.stop - k) for part, k in zip(core, begin))
        seen[core[0], core[1]] = ((values[5] > 0) | (values[9] > 0))[inner]
        out[:, core[0], core[1]] = found[0][:, *inner] * seen[core[0], core[1]]
    return PaintMaps(out[1:BORDER], out[BORDER], out[WIDTH], seen, raster, network.objects)


@dataclass(frozen=True, eq=False)
class LinePoints(Columns):
    """Points in the middle of lines, one for each cell along them."""

    xy_map: Array  # (N, 2), m
    direction: Array  # (N,): rad in [0, pi), map frame
    probability: Array  # (N,)


def find_crests(maps: PaintMaps, layer: Layer, least: float = MIN_PROBABILITY) -> LinePoints:
    """Find points in the middle of lines of a probability (R, C), with directions across which it bends most."""
    soft = np.asarray(cv2.GaussianBlur(layer, (0, 0), SMOOTH_CELLS), np.float32)
    xx, yy, xy = (cv2.Sobel(soft, cv2.CV_32F, i, j, ksize=5) for i, j in ((2, 0), (0, 2), (1, 1)))
    rows, columns = np.nonzero(soft > least)
    # Across the line, counted clockwise from the columns, the second derivative is most negative.
    angle = (np.arctan2(2 * xy[rows, columns], xx[rows, columns] - yy[rows, columns]) / 2).astype(np.float64)
    dx, dy = np.sin(angle), -np.cos(angle)
    here, sides = soft[rows, columns].astype(np.float64), [
        map_coordinates(soft, [rows + k * dy, columns + k * dx], order=1, mode="nearest").astype(np.float64)
        for k in (-2, -1, 1, 2)
    ]  # fmt: skip
    crest = here >= np.max(sides, axis=0)
    # A parabola through the middle and its neighbors.
    lower, upper, here = sides[1][crest], sides[2][crest], here[crest]
    bend = 2 * here - lower - upper
    shift = np.divide(upper - lower, 2 * bend, out=np.zeros_like(bend), where=bend > 0).clip(-0.5, 0.5)
    xy_map = maps.raster.xy_of(rows[crest] + shift * dy[crest], columns[crest] + shift * dx[crest])
    return LinePoints(xy_map, (-angle[crest]) % np.pi, here)
