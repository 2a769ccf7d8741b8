"""Export of scenarios to the formats of other simulators and viewers."""

from __future__ import annotations

from log2sim.export.exporters import Exporter, Options, export, formats

__all__ = ["Exporter", "Options", "export", "formats"]
