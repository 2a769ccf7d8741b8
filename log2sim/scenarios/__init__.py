"""Scenario engineering: tags, queries over many scenarios, logical scenarios and their variations."""

from __future__ import annotations

from log2sim.scenarios.index import open_index
from log2sim.scenarios.logical import Base, Logical, choose_base, concrete, fit, write_openscenario
from log2sim.scenarios.query import ask
from log2sim.scenarios.tagging import criticality_table, find_tags, tag, write_criticality

__all__ = [
    "Base", "Logical", "ask", "choose_base", "concrete", "criticality_table", "find_tags", "fit", "open_index", "tag",
    "write_criticality", "write_openscenario",
]  # fmt: skip
