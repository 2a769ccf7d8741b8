"""Labels that no object can have: they are left out and reported."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Labels, Log
from log2sim.logs.pose_checks import MAX_POSITION_M

# As a scenario may state; a freight train is not longer.
MAX_SIZE_M = 1000.0
_ROWS = ("t_ns", "track_id", "category", "center_m", "size_m", "yaw_rad", "visible", "kind", "occlusion")


def find_possible(labels: Labels) -> NDArray[np.bool_]:
    """Mark (L,) the boxes of finite numbers that have a size and are on Earth."""
    sized = ((labels.size_m > 0) & (labels.size_m <= MAX_SIZE_M)).all(axis=1)
    return np.asarray(sized & (np.abs(labels.center_m) <= MAX_POSITION_M).all(axis=1) & np.isfinite(labels.yaw_rad))


def without_impossible_labels(log: Log) -> Log:
    """Return the log without labels that no object can have, and with a note of how many there were; labels stay unread until they are asked for."""

    @cache
    def checked() -> tuple[Labels | None, int]:
        labels = log.labels
        if labels is None:
            return None, 0
        possible = find_possible(labels)
        if possible.all():
            return labels, 0
        rows: dict[str, Any] = {name: getattr(labels, name) for name in _ROWS}
        kept: dict[str, Any] = {name: None if column is None else column[possible] for name, column in rows.items()}
        return replace(labels, **kept), int((~possible).sum())

    def notes() -> tuple[str, ...]:
        count = checked()[1]
        if not count:
            return log.notes
        words = f"{count} label{'s' * (count != 1)} left out: no object is so large or so far away, or it has no size"
        return *log.notes, words

    return log.changed(labels=lambda: checked()[0], notes=notes)
