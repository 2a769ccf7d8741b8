"""Misalignment of the pictures of neighboring cameras on the road, by homographies."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from log2sim.datatypes import Log
from log2sim.perception.first_pass import Observations
from log2sim.perception.frames import RecordReader
from log2sim.perception.homography_stage import CameraHomography
from log2sim.perception.seam_stage import TICKS, SeamPictures, align_seams, ticks_of
from log2sim.perception.sync import Schedule


@dataclass(frozen=True, eq=False)
class SeamBench:
    """Pictures to align mounts by, and others to measure by.

    Attributes
    ----------
    aligning, measuring : SeamPictures
    reading_s : float, s
        Time of reading the pictures to align by.
    """

    aligning: SeamPictures
    measuring: SeamPictures
    reading_s: float

    @classmethod
    def of(cls, log: Log, schedule: Schedule, observed: Observations) -> SeamBench:
        """Read the pictures of a log with several cameras; none of a log with one."""
        reader, several = RecordReader(log), len(schedule.frames) > 1
        begin = time.perf_counter()
        aligning = SeamPictures.read(log, schedule, observed, reader, ticks_of(schedule) if several else [])
        reading_s = time.perf_counter() - begin
        ticks = ticks_of(schedule, 2 * TICKS, held_out=True) if several else []
        return cls(aligning, SeamPictures.read(log, schedule, observed, reader, ticks), reading_s)

    def figures(self, homographies: Mapping[str, CameraHomography]) -> dict[str, Any]:
        """Compute the median misalignment, m, 15 m from the cameras, as fitted and with mounts aligned; None where none is seen."""
        if len(homographies) < 2:
            return {}
        found = self.measuring.survey(homographies)
        out: dict[str, Any] = {
            "seam_m": found.misalignment_m,
            "seams": len(found.seams),
            "seam_places": found.places,
            "seam_places_covered": found.covered,
        }
        if all(h.rig is None for h in homographies.values()):
            return out
        begin = time.perf_counter()
        aligned, _ = align_seams(self.aligning, homographies)
        spent_s = time.perf_counter() - begin + self.reading_s
        left = self.measuring.survey(aligned)
        return out | {"seam_aligned_m": left.misalignment_m, "seams_aligned": len(left.seams), "aligning_s": spent_s}
