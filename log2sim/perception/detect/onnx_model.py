"""One ONNX model on the CPU through ONNX Runtime: loading, input description, running."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import ConfigError
from log2sim.input_files import read_file, require_readable
from log2sim.perception.detect.preprocessing import InputSpec
from log2sim.perception.onnx_session import open_session
from log2sim.threads import usable_threads

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
    """Loaded model; `run` may be called from several threads.

    Attributes
    ----------
    path : Path
    spec : InputSpec
    metadata : mapping of str to str
        Custom metadata of the file, such as class names.
    session : onnxruntime.InferenceSession
        Runs in the thread that calls it.
    threads : int
        That may run it side by side.
    """

    path: Path
    spec: InputSpec
    metadata: Mapping[str, str]
    session: Any
    threads: int

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


def load_model(path: Path, *, threads: int | None = None) -> OnnxModel:
    """Load an ONNX file.

    Parameters
    ----------
    threads
        That may run it side by side, None for as many as `log2sim.threads.usable_threads` says.

    Raises
    ------
    ConfigError
        A missing, oversized or broken file, or a model whose inputs are not one image.
    """
    import onnxruntime

    check_file(path)
    options = onnxruntime.SessionOptions()
    # Threads that share a run wait for each other; runs side by side do not.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        session = open_session(path, options)
    except Exception as error:  # as above
        raise ConfigError(f"{path}: not a model that ONNX Runtime can load: {first_line(error)}") from None
    metadata = dict(session.get_modelmeta().custom_metadata_map)
    return OnnxModel(path, input_spec(session.get_inputs(), path), metadata, session, threads or usable_threads())


def check_file(path: Path) -> None:
    """Raise `ConfigError` for a file that cannot be a model, before it is read."""
    require_readable(path, MAX_FILE_BYTES, ConfigError, "an ONNX model")


def input_spec(inputs: list[Any], path: Path) -> InputSpec:
    """Describe the model's single image input."""
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
    return InputSpec(inputs[0].name, height, width, channels_last, np.dtype(DTYPES[inputs[0].type]))


def first_line(error: Exception) -> str:
    """Return the first line of a message, shortened."""
    lines = str(error).strip().splitlines()
    return lines[0][:300] if lines else type(error).__name__
