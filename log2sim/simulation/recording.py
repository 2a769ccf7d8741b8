"""Records the states of agent groups, one window of time after the other, and joins the windows into tracks."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.simulation.groups import AgentGroup, Snapshot

RecordedTracks = dict[str, tuple[NDArray[np.intp], Array]]
"""By agent id: the stored steps (S,) and the columns (C, S) of `Snapshot` at these steps."""

COLUMNS = tuple(f.name for f in fields(Snapshot))


class WindowRecording:
    """Snapshots of a group at every `every`-th step of a window [begin, end), in one array (S, C, A)."""

    def __init__(self, group: AgentGroup, begin: int, end: int, every: int) -> None:
        self.group, self.live = group, group.live
        self.steps = np.arange(-(-begin // every) * every, end, every)
        self.rows = np.empty((len(self.steps), len(COLUMNS), len(group.live)))
        self.count = 0

    def add(self) -> None:
        """Store the present state of the group."""
        snapshot = self.group.snapshot()
        for column, name in zip(self.rows[self.count], COLUMNS):
            column[:] = getattr(snapshot, name)
        self.count += 1

    def lives(self) -> Iterable[tuple[str, NDArray[np.intp], Array]]:
        """Yield what was stored by agent, cut to its lifetime: id, steps (S,) and columns (C, S)."""
        group, steps = self.group, self.steps[: self.count]
        begin = np.searchsorted(steps, group.first[self.live])
        end = np.searchsorted(steps, group.last[self.live], side="right")
        for slot, i in enumerate(self.live):
            alive = slice(begin[slot], end[slot])
            if begin[slot] < end[slot]:
                yield group.agents[i].id, steps[alive], self.rows[alive, :, slot].T


def merged_tracks(records: Iterable[WindowRecording]) -> RecordedTracks:
    """Join the recordings of each agent in order of time."""
    parts: dict[str, list[tuple[NDArray[np.intp], Array]]] = {}
    for record in records:
        for agent, steps, columns in record.lives():
            parts.setdefault(agent, []).append((steps, columns))
    return {k: (np.concatenate([s for s, _ in v]), np.concatenate([c for _, c in v], axis=1)) for k, v in parts.items()}
