"""Scenario engineering: tags, queries over many scenarios, logical scenarios and their variations."""

from __future__ import annotations

from log2sim.scenarios.index import open_index
from log2sim.scenarios.query import ask
from log2sim.scenarios.tagging import criticality_table, find_tags, tag, write_criticality

__all__ = ["ask", "criticality_table", "find_tags", "open_index", "tag", "write_criticality"]
