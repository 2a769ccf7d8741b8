"""What sensors recorded during a scenario, within a size: pictures with the boxes of agents, and LiDAR points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from log2sim.datatypes import Log, Scenario
from log2sim.perception.frames import RecordReader
from log2sim.visualization.recording.choice import choose_cameras
from log2sim.visualization.recording.pictures import picture_document
from log2sim.visualization.recording.points import point_document

POINT_SHARE = 0.3
"""Of the budget, for points, where there are pictures too; what they leave is for the pictures."""


def _silent(stage: str, done: int, total: int) -> None:
    """Report nothing."""


DEFAULT_MAX_BYTES = 40_000_000
"""Of a page with pictures: mail and chat programs take so much, and a phone still opens it."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """What to take of a log, and how much of it.

    Attributes
    ----------
    log : Log
        With the poses that the scenario was made with.
    max_bytes : int
        Of the whole page.
    cameras : tuple of str
        Whose pictures to take; those that the scenario was made with where it is empty.
    progress : callable
        Called as `progress(stage, done, total)` while records are read.
    """

    log: Log
    max_bytes: int = DEFAULT_MAX_BYTES
    cameras: tuple[str, ...] = ()
    progress: Callable[[str, int, int], None] = _silent


def recording_document(scenario: Scenario, recorded: Recorded, budget_bytes: int) -> dict[str, Any]:
    """Return the pictures and points of a log for a page, within a budget.

    Returns
    -------
    dict
        "pictures" and "points", see `picture_document` and `point_document`, None where there are none, and "notes": what
        was chosen, in sentences.

    Raises
    ------
    ConfigError
        For an unknown camera, or when the budget is too small for a single moment.
    LogError
        When none of the records asked for can be read.
    """
    log, report = recorded.log, recorded.progress
    reader = RecordReader(log)
    cameras = choose_cameras(log, scenario, recorded.cameras)
    share = POINT_SHARE if cameras else 1.0
    points = point_document(
        log, scenario, int(share * budget_bytes), reader, lambda done, total: report("page: sweeps", done, total)
    )
    left = budget_bytes - (0 if points is None else points["bytes"])
    pictures = None
    if cameras:
        pictures = picture_document(
            log, scenario, cameras, left, reader, lambda done, total: report("page: pictures", done, total)
        )
    reader.require_some()
    if pictures is not None and not pictures["cameras"]:
        pictures = None
    return {"pictures": pictures, "points": points, "notes": [_tell_pictures(pictures), _tell_points(points)]}


def _tell_pictures(pictures: dict[str, Any] | None) -> str:
    if pictures is None:
        return "no pictures: the log has none during the scenario"
    count, cameras = sum(len(c["t_s"]) for c in pictures["cameras"]), len(pictures["cameras"])
    noun = f"{count} picture{'s' * (count != 1)} of {cameras} camera{'s' * (cameras != 1)}"
    rate = f"up to {pictures['rate_hz']:g} a second"
    return f"{noun}, {pictures['width_px']} px wide, {rate}: {pictures['bytes'] / 1e6:.1f} MB"


def _tell_points(points: dict[str, Any] | None) -> str:
    if points is None:
        return "no LiDAR points: the log has none during the scenario"
    count = len(points["t_s"])
    noun = f"LiDAR points of {count} sweep{'s' * (count != 1)}"
    rate = f"up to {points['rate_hz']:g} a second"
    return f"{noun}, one in {points['cell_m']:g} m, {rate}: {points['bytes'] / 1e6:.1f} MB"
