"""Settings of runs that are about agents alone: no map of the ground, no colors, no traffic lights, which takes less time."""

from __future__ import annotations

from typing import Any

AGENTS_ONLY = ("--set", "map.lanes=false", "--set", "appearance.colors=false", "--set", "appearance.signals=false")
AGENTS_ALONE: dict[str, Any] = {"map": {"lanes": False}, "appearance": {"colors": False, "signals": False}}
# In a second of sparse points a car may be too unsure to be replayed.
ALL_KEPT: dict[str, Any] = {"track": {"quarantine_confidence": 0.0}}
