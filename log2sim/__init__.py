"""Reconstruct driving logs (cameras, LiDAR, GNSS/IMU) as scenarios that a simulator can run."""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

from log2sim.files.version import __version__

# Builds of ONNX Runtime collect events in the home folder from their import on, unless this is set before.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

if TYPE_CHECKING:
    from log2sim.batch.run import reconstruct_all
    from log2sim.cli.doctor import examine as examine_installation
    from log2sim.config import Config
    from log2sim.datatypes.scenario import Scenario
    from log2sim.edit.apply import edit as edit_scenario
    from log2sim.edit.corrections import correct as correct_scenario
    from log2sim.errors import Log2SimError
    from log2sim.evaluation.bench.benchmark import bench
    from log2sim.evaluation.detection.detect_log import detect_log
    from log2sim.evaluation.metrics.evaluator import evaluate
    from log2sim.export.exporters import export as export_scenario
    from log2sim.export.openscenario.read import load as import_scenario
    from log2sim.logs.excerpt import summarize as summarize_log
    from log2sim.logs.native.writer import write_log
    from log2sim.logs.opening import open_log, validate_log
    from log2sim.pipeline import reconstruct
    from log2sim.resim.simulate import resimulate
    from log2sim.road.builder import map_ground
    from log2sim.scenarios.failure import search as search_failures
    from log2sim.scenarios.logical import fit as fit_logical
    from log2sim.scenarios.query import ask as find_situations
    from log2sim.scenarios.tagging import tag as tag_scenario
    from log2sim.simulation.prediction.prediction import predict_scenario
    from log2sim.simulation.runner import replay
    from log2sim.synth.synthesis import write_synthetic
    from log2sim.visualization.page.writer import write_page as view
    from log2sim.visualization.plot.scene import plot
    from log2sim.visualization.progress import show_progress

_PLACES = {
    "Config": "log2sim.config:Config",
    "Log2SimError": "log2sim.errors:Log2SimError",
    "Scenario": "log2sim.datatypes.scenario:Scenario",
    "bench": "log2sim.evaluation.bench.benchmark:bench",
    "detect_log": "log2sim.evaluation.detection.detect_log:detect_log",
    "correct_scenario": "log2sim.edit.corrections:correct",
    "edit_scenario": "log2sim.edit.apply:edit",
    "evaluate": "log2sim.evaluation.metrics.evaluator:evaluate",
    "examine_installation": "log2sim.cli.doctor:examine",
    "export_scenario": "log2sim.export.exporters:export",
    "import_scenario": "log2sim.export.openscenario.read:load",
    "find_situations": "log2sim.scenarios.query:ask",
    "fit_logical": "log2sim.scenarios.logical:fit",
    "map_ground": "log2sim.road.builder:map_ground",
    "open_log": "log2sim.logs.opening:open_log",
    "plot": "log2sim.visualization.plot.scene:plot",
    "predict_scenario": "log2sim.simulation.prediction.prediction:predict_scenario",
    "reconstruct": "log2sim.pipeline:reconstruct",
    "reconstruct_all": "log2sim.batch.run:reconstruct_all",
    "replay": "log2sim.simulation.runner:replay",
    "resimulate": "log2sim.resim.simulate:resimulate",
    "search_failures": "log2sim.scenarios.failure:search",
    "show_progress": "log2sim.visualization.progress:show_progress",
    "summarize_log": "log2sim.logs.excerpt:summarize",
    "tag_scenario": "log2sim.scenarios.tagging:tag",
    "validate_log": "log2sim.logs.opening:validate_log",
    "view": "log2sim.visualization.page.writer:write_page",
    "write_log": "log2sim.logs.native.writer:write_log",
    "write_synthetic": "log2sim.synth.synthesis:write_synthetic",
}
"""The functions of commands whose names are folders of the package have longer names."""

__all__ = [
    "Config", "Log2SimError", "Scenario", "__version__", "bench", "correct_scenario", "detect_log", "edit_scenario", "evaluate", "examine_installation",
    "export_scenario", "find_situations", "fit_logical", "import_scenario", "map_ground", "open_log", "plot", "predict_scenario", "reconstruct", "reconstruct_all",
    "replay", "resimulate", "search_failures", "show_progress", "summarize_log", "tag_scenario", "validate_log", "view", "write_log", "write_synthetic",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that `import log2sim` stays fast."""
    if name not in _PLACES:
        raise AttributeError(f"module 'log2sim' has no attribute '{name}'")
    module, _, attribute = _PLACES[name].partition(":")
    value = globals()[name] = getattr(importlib.import_module(module), attribute)
    return value


def __dir__() -> list[str]:
    """List the public names, imported or not."""
    return sorted({*globals(), *__all__})
