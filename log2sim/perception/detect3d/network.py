"""A network on the grid of a cloud: an ONNX file with its description, run on one thread.

The file holds one input "grid" and one output "maps", and describes itself in its metadata under the key `METADATA_KEY`
by a JSON document, see `NetworkInfo`. `log2sim/README.md` lists the channels for those who bring their own network.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from log2sim.datatypes import GROUPS
from log2sim.errors import ConfigError
from log2sim.input_files import require_readable
from log2sim.model_errors import first_problem
from log2sim.perception.detect3d.grid import CHANNELS, MIN_SIZE_CELLS
from log2sim.perception.onnx_session import open_session

METADATA_KEY = "log2sim.lidar"
VERSION = 1
METADATA_LIMIT_CHARS = 1_000_000
# Networks that are quick enough on a CPU have a few million parameters.
MAX_FILE_BYTES = 256 * 1024**2
# A grid of 1024 x 1024 cells takes 50 MB, and a network of 0.4 GMAC for 256 x 256 cells a sixth of a second.
MAX_SIDE_CELLS = 1024
CALIBRATION_TERMS = 5


class NetworkInfo(BaseModel):
    """What the metadata of a network's file say about it.

    Attributes
    ----------
    version : int
    name : str
    cell_m : float
        Side of a cell of the grid, m.
    stride : int
        Cells of the grid along a cell of the maps.
    range_m : float
        Largest distance from the sensor along x and along y, m.
    groups : tuple of str
        Groups of categories in the order of the channels of heat.
    categories : dict of str to tuple of str
        Categories of each group in the order of the channels of categories.
    calibration : dict of str to tuple of float
        For each group the weights of 1, logit of the heat, logit of the quality, log(1 + points) and range in units of
        10 m, whose sum is the logit of the score.
    min_score : dict of str to float
        Lowest score of a box of each group.
    card : dict
        How the network was trained and how good it is; free.
    """

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    version: int
    name: str
    cell_m: float = Field(ge=0.05, le=2.0)
    stride: int = Field(ge=1, le=16)
    range_m: float = Field(gt=0.0, le=1000.0)
    groups: tuple[str, ...] = Field(min_length=1)
    categories: dict[str, tuple[str, ...]]
    calibration: dict[str, tuple[float, ...]]
    min_score: dict[str, float]
    card: dict[str, Any] = {}

    @model_validator(mode="after")
    def _check(self) -> NetworkInfo:
        """Check what types and limits do not say."""
        if self.version != VERSION:
            raise ValueError(f"'version' is {self.version}, expected {VERSION}")
        for group in self.groups:
            if group not in GROUPS or self.groups.count(group) > 1:
                raise ValueError(f"'groups' has '{group}' twice or unknown; expected some of {', '.join(GROUPS)}")
            known, named = GROUPS[group], self.categories.get(group, ())
            if not named or not set(named) <= set(known) or len(set(named)) < len(named):
                raise ValueError(f"'categories.{group}' is {list(named)}, expected some of {', '.join(known)}")
            if len(self.calibration.get(group, ())) != CALIBRATION_TERMS:
                raise ValueError(f"'calibration.{group}' is missing or has not {CALIBRATION_TERMS} numbers")
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
    """Places of the outputs among the channels of the maps, in their order.

    Attributes
    ----------
    heat : slice
        Logit of a center of each group.
    category : dict of str to slice
        Logits of the categories of groups that have more than one.
    box : slice
        Center x, y from the middle of the cell, z above the ground, m; logarithms of length, width, height in m.
    axis : slice
        Sine and cosine of twice the yaw.
    direction : slice
        Sine and cosine of the yaw by least squares: shorter than 1 where front and back are not told apart.
    quality : int
        Logit of the expected IoU in the ground plane.
    segment : slice
        Logits of background and of each group.
    vote : slice
        Center x, y of the cell's object from the middle of the cell, m.
    count : int
        Number of channels.
    """

    heat: slice
    category: dict[str, slice]
    box: slice
    axis: slice
    direction: slice
    quality: int
    segment: slice
    vote: slice
    count: int

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
    """Loaded network; `run` may be called from several threads.

    Attributes
    ----------
    path : Path
    info : NetworkInfo
    session : onnxruntime.InferenceSession
    """

    path: Path
    info: NetworkInfo
    session: Any

    def run(self, grid: NDArray[np.float32]) -> NDArray[np.float32]:
        """Compute the maps (C, H / stride, W / stride) of a grid (12, H, W).

        Raises
        ------
        ConfigError
            When the network fails, or its maps have another shape.
        """
        try:
            (maps,) = self.session.run(["maps"], {"grid": grid[None]})
        except Exception as error:  # ONNX Runtime has many exceptions and no base of its own
            raise ConfigError(f"{self.path}: the network fails on a grid {grid.shape}: {brief(error)}") from None
        stride, count = self.info.stride, self.info.channels.count
        expected = (1, count, grid.shape[1] // stride, grid.shape[2] // stride)
        if maps.shape != expected or maps.dtype != np.float32:
            raise ConfigError(
                f"{self.path}: output 'maps' is {maps.dtype} {maps.shape} for a grid {grid.shape}; expected float32 "
                f"{expected} by the groups, categories and stride in '{METADATA_KEY}'"
            )
        result: NDArray[np.float32] = maps[0]
        return result


def load_network(path: Path) -> Network:
    """Load a network, check its description and try it on an empty grid.

    Raises
    ------
    ConfigError
        A missing, oversized or broken file, an ONNX file of another kind, or metadata that are missing or wrong.
    """
    import onnxruntime

    require_readable(path, MAX_FILE_BYTES, ConfigError, "an ONNX network for clouds")
    options = onnxruntime.SessionOptions()
    # Networks this small gain nothing from a second thread, which the stages beside need.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = open_session(path, options)
    except Exception as error:  # as in `Network.run`
        raise ConfigError(f"{path}: not a network that ONNX Runtime can load: {brief(error)}") from None
    check_names(session, path)
    network = Network(path, read_info(session.get_modelmeta().custom_metadata_map, path), session)
    network.run(np.zeros((CHANNELS, MIN_SIZE_CELLS, MIN_SIZE_CELLS), np.float32))
    return network


def check_names(session: Any, path: Path) -> None:
    """Raise `ConfigError` unless the network takes a grid and gives maps."""
    inputs = [(i.name, i.type, i.shape) for i in session.get_inputs()]
    outputs = [o.name for o in session.get_outputs()]
    fits = len(inputs) == 1 and inputs[0][:2] == ("grid", "tensor(float)") and len(inputs[0][2]) == 4
    if fits and "maps" in outputs:
        channels, *sides = inputs[0][2][1:]
        if channels != CHANNELS and isinstance(channels, int):
            raise ConfigError(f"{path}: input 'grid' has {channels} channels; expected {CHANNELS}")
        if any(isinstance(side, int) for side in sides):
            raise ConfigError(f"{path}: input 'grid' is {inputs[0][2]}; export it with free height and width")
        return
    listed = ", ".join(f"'{name}' {kind} {shape}" for name, kind, shape in inputs)
    raise ConfigError(
        f"{path}: inputs {listed}, outputs {', '.join(outputs)}: not a network for clouds; expected one input 'grid' "
        f"(1, {CHANNELS}, H, W) float and an output 'maps'"
    )


def read_info(metadata: dict[str, str], path: Path) -> NetworkInfo:
    """Read the description of a network from the metadata of its file."""
    text = metadata.get(METADATA_KEY)
    if text is None:
        raise ConfigError(
            f"{path}: its metadata have no entry '{METADATA_KEY}', a JSON document with cell_m, stride, range_m, groups, "
            "categories, calibration and min_score"
        )
    where = f"{path}: metadata '{METADATA_KEY}'"
    if len(text) > METADATA_LIMIT_CHARS:
        raise ConfigError(f"{where}: {len(text)} characters; expected at most {METADATA_LIMIT_CHARS}")
    try:
        return NetworkInfo.model_validate_json(text)
    except ValidationError as error:
        raise ConfigError(f"{where}: {first_problem(error, NetworkInfo)}") from None


def brief(error: Exception) -> str:
    """Return the first line of a message, shortened."""
    lines = str(error).strip().splitlines()
    return lines[0][:300] if lines else type(error).__name__
