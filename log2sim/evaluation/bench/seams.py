"""Misalignment of the pictures of neighboring cameras on the road, by homographies."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from log2sim.datatypes import Log
from log2sim.perception.first_pass import Observations
from log2sim.perception.frames import RecordReader
from log2sim.perception.homography_stage import CameraHomography
from log2sim.perception.seam_stage import TICKS, SeamPictures, SeamSurvey, align_seams, ticks_of
from log2sim.perception.sync import Schedule


@dataclass(frozen=True, eq=False)
class SeamBench:
    """Pictures to align mounts by, and registered seams of other ticks to measure homographies by.

    Attributes
    ----------
    aligning, measuring : SeamPictures
    survey : SeamSurvey
        Which pixels of two cameras show one point of the road 15 m away, registered once for all homographies.
    reading_s : float, s
        Time of reading the pictures to align by.
    """

    aligning: SeamPictures
    measuring: SeamPictures
    survey: SeamSurvey
    reading_s: float

    @classmethod
    def of(
        cls, log: Log, schedule: Schedule, observed: Observations, homographies: Mapping[str, CameraHomography]
    ) -> SeamBench:
        """Read the pictures of a log with several cameras, and register them by homographies of cameras fitted together."""
        reader, several = RecordReader(log), any(h.rig is not None for h in homographies.values())
        begin = time.perf_counter()
        aligning = SeamPictures.read(log, schedule, observed, reader, ticks_of(schedule) if several else [])
        reading_s = time.perf_counter() - begin
        ticks = ticks_of(schedule, 2 * TICKS, held_out=True) if several else []
        measuring = SeamPictures.read(log, schedule, observed, reader, ticks)
        aligned, _ = align_seams(aligning, homographies)
        return cls(aligning, measuring, measuring.survey(aligned), reading_s)

    def figures(self, homographies: Mapping[str, CameraHomography]) -> dict[str, Any]:
        """Compute the median misalignment, m, 15 m from the cameras, as fitted and with mounts aligned; None where none is seen."""
        if len(homographies) < 2 or not self.survey.places:
            return {}
        out: dict[str, Any] = {
            "seam_m": self._median_m(homographies),
            "seams": len(self.survey.seams),
            "seam_places": self.survey.places,
            "seam_places_covered": self.survey.covered,
        }
        if all(h.rig is None for h in homographies.values()):
            return out
        begin = time.perf_counter()
        aligned, _ = align_seams(self.aligning, homographies)
        spent_s = time.perf_counter() - begin + self.reading_s
        return out | {"seam_aligned_m": self._median_m(aligned), "aligning_s": spent_s}

    def _median_m(self, homographies: Mapping[str, CameraHomography]) -> float | None:
        found = self.measuring.misalignments_m(self.survey.seams, homographies)
        known = found[~np.isnan(found)]
        return float(np.median(known)) if len(known) else None
