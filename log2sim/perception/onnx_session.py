"""Sessions of ONNX Runtime: on the CPU, and without telemetry."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def open_session(path: Path, options: Any) -> Any:
    """Load a model into a session on the CPU.

    Builds of ONNX Runtime for Windows report events to Microsoft unless that is turned off, which is done here.

    Parameters
    ----------
    path : Path
    options : onnxruntime.SessionOptions

    Returns
    -------
    onnxruntime.InferenceSession
    """
    import onnxruntime

    onnxruntime.disable_telemetry_events()
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
