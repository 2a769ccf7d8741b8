"""A network on the bird's-eye-view grid of a cloud, in the level frame.

Only geometry is used, no intensity, so that a network carries over to sensors that it was not trained on. Height slices
follow AVOD (Ku et al., IROS 2018) and MSFP (Lin et al. 2021, section 3), logarithmic counts PIXOR's and MV3D's density.

The file holds one input "grid" and one output "maps", and describes itself in its metadata under the key `METADATA_KEY`
by a JSON document, see `NetworkInfo`. `log2sim/README.md` lists the channels for those who bring their own network.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from log2sim.datatypes import GROUPS
from log2sim.errors import ConfigError
from log2sim.files.documents import first_problem
from log2sim.files.inputs import read_file, require_readable
from log2sim.geometry import Array
from log2sim.perception.detect3d.box_points import PointsOfBoxes
from log2sim.perception.lidar.cloud import Cloud


def open_session(path: Path, max_bytes: int, kind: str) -> Any:
    """Load an ONNX file of a kind into an `onnxruntime.InferenceSession` on one core of the CPU.

    Raises `ConfigError` for a missing, oversized or broken file.
    """
    import onnxruntime

    require_readable(path, max_bytes, ConfigError, f"an ONNX {kind}")
    onnxruntime.disable_telemetry_events()
    options = onnxruntime.SessionOptions()
    # Threads that share a run wait for each other; runs side by side, and the stages beside, do not.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime has many exceptions and no base of its own
        raise ConfigError(f"{path}: not a {kind} that ONNX Runtime can load: {first_line(error)}") from None


def digest_of(path: Path) -> str:
    """Return a digest of the content of a network's file, with the version of what runs it."""
    import onnxruntime

    content = read_file(path, MAX_FILE_BYTES, ConfigError)
    return f"{hashlib.sha256(content).hexdigest()} onnxruntime {onnxruntime.__version__}"


def first_line(error: Exception) -> str:
    """Return the first line of a message, shortened."""
    lines = str(error).strip().splitlines()
    return lines[0][:300] if lines else type(error).__name__


CHANNELS = 12
MIN_HEIGHT_M, MAX_HEIGHT_M = -0.5, 4.5
# Slices end at a bumper, a hood, a waist, a car's roof or a person's shoulders, a person's head, and above all but trucks.
SLICE_EDGES_M = (MIN_HEIGHT_M, 0.3, 0.7, 1.2, 1.8, 2.5, MAX_HEIGHT_M)
# The network halves the grid four times.
SIZE_MULTIPLE = 16
MIN_SIZE_CELLS = 64


def grid_window(
    xy: NDArray[np.float32], *, cell_m: float, range_m: float, center: Array
) -> tuple[Array, tuple[int, int]]:
    """Choose the part of the plane that a grid covers: the bounding box of the points (N, 2) in a square of `range_m` around a center.

    Returns its lower corner (2,), m, a multiple of the cell from the center less the range, and its cells along x and y,
    multiples of `SIZE_MULTIPLE`.
    """
    limit = int(np.ceil(2 * range_m / (cell_m * SIZE_MULTIPLE))) * SIZE_MULTIPLE
    corner = np.asarray(center, np.float64) - limit * cell_m / 2
    low, high = np.zeros(2), np.zeros(2)
    for axis in range(2):
        # Rows in range along both axes would need another pass; along one each, the window is at most larger.
        values = xy[:, axis]
        values = values[(values >= corner[axis]) & (values < corner[axis] + limit * cell_m)]
        if not len(values):
            return corner, (min(MIN_SIZE_CELLS, limit), min(MIN_SIZE_CELLS, limit))
        low[axis], high[axis] = values.min(), values.max()
    first, last = (np.clip(np.floor((v - corner) / cell_m), 0, limit - 1) for v in (low, high))
    needed = last - first + 1
    count = np.maximum(np.ceil(needed / SIZE_MULTIPLE) * SIZE_MULTIPLE, min(MIN_SIZE_CELLS, limit))
    # Even, so that the cells of the maps, twice as large, lie alike in every window.
    start = np.clip(first - (count - needed) // 2, 0, limit - count) // 2 * 2
    return corner + start * cell_m, (int(count[0]), int(count[1]))


def rasterize(xyz: NDArray[np.float32], *, cell_m: float, low: Array, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Make the grid of a cloud, H cells along x and W along y from a lower corner `low` (2,), m.

    `xyz`: (N, 3) float32, m, z above the ground; points outside the grid, of other heights or not finite are left out.

    Returns (12, H, W) float32: greatest, mean and least height, each half; logarithm of the count; logarithms of the counts in
    six slices of height; mean offsets from the middle of the cell along x and y, in cells. All zero in an empty cell.
    """
    h, w = shape
    scale, (x0, y0) = np.float32(1 / cell_m), np.asarray(low, np.float32)
    x, y, z = (xyz[:, 0] - x0) * scale, (xyz[:, 1] - y0) * scale, xyz[:, 2]
    inside = np.flatnonzero(
        (x >= 0) & (x < h) & (y >= 0) & (y < w) & (z > np.float32(MIN_HEIGHT_M)) & (z < np.float32(MAX_HEIGHT_M))
    )
    out = np.zeros((CHANNELS, h * w), np.float32)
    if len(inside) == 0:
        return out.reshape(CHANNELS, h, w)
    if len(inside) < len(x):
        x, y, z = x.take(inside), y.take(inside), z.take(inside)
    i, j = x.astype(np.intp), y.astype(np.intp)
    cell = i * w + j
    count = np.bincount(cell, minlength=h * w)
    used = np.flatnonzero(count > 0)
    logarithm = np.log1p(np.arange(count.max() + 1, dtype=np.float32))
    # One column for each cell with points, which are a tenth of all.
    number = np.empty(h * w, np.intp)
    number[used] = np.arange(len(used))
    column, points = number.take(cell), count.take(used)
    values = np.empty((CHANNELS, len(used)), np.float32)
    # In double precision NumPy takes a twentieth of the time.
    highest, lowest, exact = np.full(len(used), -np.inf), np.full(len(used), np.inf), z.astype(np.float64)
    np.maximum.at(highest, column, exact)
    np.minimum.at(lowest, column, exact)
    values[0], values[2] = highest, lowest
    for channel, of_points in ((1, exact), (10, x - i.astype(np.float32)), (11, y - j.astype(np.float32))):
        values[channel] = np.bincount(column, of_points, minlength=len(used)) / points
    values[:3] /= 2
    values[3] = logarithm.take(points) / 3
    values[10:12] -= np.float32(0.5)
    # Which slice, in bytes that are added up in a tenth of the time.
    level = sum(((z > edge).view(np.uint8) for edge in np.array(SLICE_EDGES_M[1:-1], np.float32)), np.uint8(0))
    column += np.multiply(level, len(used), dtype=np.intp)
    values[4:10] = logarithm.take(np.bincount(column, minlength=6 * len(used))).reshape(6, -1) / 2
    out[:, used] = values
    return out.reshape(CHANNELS, h, w)


# A sweep has 0.3 million points at most; what is beyond a few of them is thinned out, which bounds time and memory.
MAX_POINTS = 1_000_000
# The ground under a box is a plane. Where points reach less than this to all sides it is taken as level.
PLANE_REACH_M = 0.05
MAX_SLOPE = 0.4
PLANE_POINTS = 64


def level_points(cloud: Cloud, range_m: float) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Take the points of a cloud within range of a sensor of it along x and along y.

    Returns `xyz`: (n, 3) float32, m, relative to the cloud's origin, z the height above the ground within the limits of the grid;
    `index`: (n,): of the points in the cloud.
    """
    return _cropped(cloud, viewpoints_xy(cloud), range_m)


def stack_points(cloud: Cloud, earlier: Sequence[Cloud], range_m: float) -> NDArray[np.float32]:
    """Merge the points of earlier clouds that are in range of a cloud's sensors: (n, 3) as from `level_points`.

    Clouds are in map axes already, so that only their origins differ. Each keeps its height above its own ground.
    """
    parts = [np.zeros((0, 3), np.float32)]
    for old in earlier:
        shift = (old.origin - cloud.origin)[:2]
        xyz = _cropped(old, viewpoints_xy(cloud) - shift, range_m)[0]
        xyz[:, :2] += shift.astype(np.float32)
        parts.append(xyz)
    return np.concatenate(parts)


def viewpoints_xy(cloud: Cloud) -> Array:
    """Return the places (V, 2) of the sensors relative to the origin, m, one a viewpoint; the origin where it is not known."""
    xy = np.array([view.sensor[:2] for view in cloud.views], dtype=np.float64)
    return np.where(np.isfinite(xy).all(axis=1, keepdims=True), xy, 0.0)


def _cropped(cloud: Cloud, centers: Array, range_m: float) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Take the points within range of any of the centers (V, 2)."""
    (x, y, _), height = cloud.columns, cloud.height
    near = np.zeros(len(x), dtype=bool)
    for center in centers:
        low, high = (center - range_m).astype(np.float32), (center + range_m).astype(np.float32)
        # False for NaN.
        near |= (x >= low[0]) & (x < high[0]) & (y >= low[1]) & (y < high[1])
    index = np.flatnonzero(near & (height > MIN_HEIGHT_M) & (height < MAX_HEIGHT_M))
    if len(index) > MAX_POINTS:
        index = index[:: -(-len(index) // MAX_POINTS)]
    # Values of one coordinate side by side, as all that follows goes through them.
    return np.stack([x[index], y[index], height[index]]).T, index


def ground_under(xy: Array, inside: PointsOfBoxes, cloud: Cloud) -> Array:
    """Estimate the height (M,) of the ground under centers (M, 2), m, by a plane through that under the points of each box.

    All are relative to the cloud's origin. Each box has a point of the cloud.

    A car is seen from one side: on a slope of 10 % the ground under its points is 0.1 to 0.2 m off that under its center.
    """
    inside = inside.sample(PLANE_POINTS)
    box, point = inside.box, inside.point
    x, y = (cloud.xyz[:, axis].take(point) - xy[:, axis].take(box) for axis in range(2))
    z = (cloud.xyz[:, 2].take(point) - cloud.height.take(point)).astype(np.float64)
    count = inside.count

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(box, values, minlength=len(count)) / count)

    mx, my, mz = mean(x), mean(y), mean(z)
    dx, dy, dz = x - mx[box], y - my[box], z - mz[box]
    xx, yy = (mean(d * d) + PLANE_REACH_M**2 for d in (dx, dy))
    xy_, xz, yz = mean(dx * dy), mean(dx * dz), mean(dy * dz)
    determinant = xx * yy - xy_ * xy_
    slope_x = np.clip((yy * xz - xy_ * yz) / determinant, -MAX_SLOPE, MAX_SLOPE)
    slope_y = np.clip((xx * yz - xy_ * xz) / determinant, -MAX_SLOPE, MAX_SLOPE)
    return np.asarray(mz - slope_x * mx - slope_y * my)


METADATA_KEY = "log2sim.lidar"
VERSION = 1
METADATA_LIMIT_CHARS = 1_000_000
# Networks that are quick enough on a CPU have a few million parameters.
MAX_FILE_BYTES = 256 * 1024**2
# A grid of 1024 x 1024 cells takes 50 MB, and a network of 0.4 GMAC for 256 x 256 cells a sixth of a second.
MAX_SIDE_CELLS = 1024
CALIBRATION_TERMS = 5


class ScoreInfo(BaseModel):
    """What the metadata of a network's file say about the scores of its boxes."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    version: int
    groups: tuple[str, ...] = Field(min_length=1)  # of categories, in the order of the channels of heat
    # By group: weights of 1, logits of heat and quality, log(1 + points) and range / 10 m; the sum is the logit of the score
    calibration: dict[str, tuple[float, ...]]
    card: dict[str, Any] = {}  # how the network was trained and how good it is; free

    @model_validator(mode="after")
    def _check_scores(self) -> Self:
        """Check what types do not say."""
        if self.version != VERSION:
            raise ValueError(f"'version' is {self.version}, expected {VERSION}")
        for group in self.groups:
            if group not in GROUPS or self.groups.count(group) > 1:
                raise ValueError(f"'groups' has '{group}' twice or unknown; expected some of {', '.join(GROUPS)}")
            if len(self.calibration.get(group, ())) != CALIBRATION_TERMS:
                raise ValueError(f"'calibration.{group}' is missing or has not {CALIBRATION_TERMS} numbers")
        return self


class NetworkInfo(ScoreInfo):
    """What the metadata of a network's file say about it."""

    name: str
    cell_m: float = Field(ge=0.05, le=2.0)  # side of a cell of the grid, m
    stride: int = Field(ge=1, le=16)  # cells of the grid along a cell of the maps
    range_m: float = Field(gt=0.0, le=1000.0)  # largest distance from the sensor along x and along y, m
    categories: dict[str, tuple[str, ...]]  # of each group, in the order of the channels of categories
    min_score: dict[str, float]  # lowest score of a box of each group

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Check what types and limits do not say."""
        for group in self.groups:
            known, named = GROUPS[group], self.categories.get(group, ())
            if not named or not set(named) <= set(known) or len(set(named)) < len(named):
                raise ValueError(f"'categories.{group}' is {list(named)}, expected some of {', '.join(known)}")
            if not 0 <= self.min_score.get(group, -1.0) <= 1:
                raise ValueError(f"'min_score.{group}' is missing or no number from 0 to 1")
        if self.range_m > self.max_range_m:
            raise ValueError(f"'range_m' is {self.range_m:g}, expected at most {MAX_SIDE_CELLS // 2} cells of 'cell_m'")
        return self

    @property
    def max_range_m(self) -> float:
        """Range, m, at which the grid has its greatest size."""
        return MAX_SIDE_CELLS // 2 * self.cell_m

    @property
    def channels(self) -> Channels:
        """Places of the outputs among the channels of the maps."""
        return Channels.of(self)


@dataclass(frozen=True)
class Channels:
    """Places of the outputs among the channels of the maps, in their order."""

    heat: slice  # logit of a center of each group
    category: dict[str, slice]  # logits of the categories of groups that have more than one
    box: slice  # center x, y from the middle of the cell, z above the ground, m; logarithms of length, width, height in m
    axis: slice  # sine and cosine of twice the yaw
    direction: slice  # those of the yaw by least squares: shorter than 1 where front and back are not told apart
    quality: int  # logit of the expected IoU in the ground plane
    segment: slice  # logits of background and of each group
    vote: slice  # center x, y of the cell's object from the middle of the cell, m
    count: int  # of channels

    @classmethod
    def of(cls, info: NetworkInfo) -> Channels:
        """Lay out the channels for the groups and categories of a network."""
        start = 0

        def take(n: int) -> slice:
            nonlocal start
            start += n
            return slice(start - n, start)

        heat = take(len(info.groups))
        several = [group for group in info.groups if len(info.categories[group]) > 1]
        category = {group: take(len(info.categories[group])) for group in several}
        box, axis, direction, quality = take(6), take(2), take(2), take(1).start
        segment, vote = take(1 + len(info.groups)), take(2)
        return cls(heat, category, box, axis, direction, quality, segment, vote, start)


@dataclass(frozen=True, eq=False)
class Network:
    """Loaded network; `run` may be called from several threads."""

    path: Path
    info: NetworkInfo
    session: Any  # onnxruntime.InferenceSession

    def run(self, grid: NDArray[np.float32]) -> NDArray[np.float32]:
        """Compute the maps (C, H / stride, W / stride) of a grid (12, H, W); `ConfigError` when it fails or they have another shape."""
        try:
            (maps,) = self.session.run(["maps"], {"grid": grid[None]})
        except Exception as error:  # as above
            raise ConfigError(f"{self.path}: the network fails on a grid {grid.shape}: {first_line(error)}") from None
        stride, count = self.info.stride, self.info.channels.count
        expected = (1, count, grid.shape[1] // stride, grid.shape[2] // stride)
        if maps.shape != expected or maps.dtype != np.float32:
            raise ConfigError(
                f"{self.path}: output 'maps' is {maps.dtype} {maps.shape} for a grid {grid.shape}; expected float32 "
                f"{expected} by the groups, categories and stride in '{METADATA_KEY}'"
            )
        return np.asarray(maps[0])


def load_network(path: Path) -> Network:
    """Load a network, check its description and try it on an empty grid.

    Raises `ConfigError`: a missing, oversized or broken file, an ONNX file of another kind, or metadata that are missing or wrong.
    """
    session = open_session(path, MAX_FILE_BYTES, "network for clouds")
    inputs = [(i.name, i.type, i.shape) for i in session.get_inputs()]
    outputs = [o.name for o in session.get_outputs()]
    fits = len(inputs) == 1 and inputs[0][:2] == ("grid", "tensor(float)") and len(inputs[0][2]) == 4
    if not fits or "maps" not in outputs:
        listed = ", ".join(f"'{name}' {kind} {shape}" for name, kind, shape in inputs)
        raise ConfigError(
            f"{path}: inputs {listed}, outputs {', '.join(outputs)}: not a network for clouds; expected one input 'grid' "
            f"(1, {CHANNELS}, H, W) float and an output 'maps'"
        )
    channels, *sides = inputs[0][2][1:]
    if channels != CHANNELS and isinstance(channels, int):
        raise ConfigError(f"{path}: input 'grid' has {channels} channels; expected {CHANNELS}")
    if any(isinstance(side, int) for side in sides):
        raise ConfigError(f"{path}: input 'grid' is {inputs[0][2]}; export it with free height and width")
    text, where = session.get_modelmeta().custom_metadata_map.get(METADATA_KEY), f"{path}: metadata '{METADATA_KEY}'"
    if text is None:
        raise ConfigError(
            f"{path}: its metadata have no entry '{METADATA_KEY}', a JSON document with cell_m, stride, range_m, groups, "
            "categories, calibration and min_score"
        )
    if len(text) > METADATA_LIMIT_CHARS:
        raise ConfigError(f"{where}: {len(text)} characters; expected at most {METADATA_LIMIT_CHARS}")
    try:
        network = Network(path, NetworkInfo.model_validate_json(text), session)
    except ValidationError as error:
        raise ConfigError(f"{where}: {first_problem(error, NetworkInfo)}") from None
    network.run(np.zeros((CHANNELS, MIN_SIZE_CELLS, MIN_SIZE_CELLS), np.float32))
    return network
