"""Seams of a log: what neighboring cameras show of the same ground at some ticks, and mounts that make them agree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.geometry import Array, inverse
from log2sim.perception.first_pass import Observations, base_pose
from log2sim.perception.frames import RecordReader
from log2sim.perception.homography.rig import rotation_of
from log2sim.perception.homography.rig_seams import fit_mounts, with_mounts
from log2sim.perception.homography.seams import Seam, SeamView, find_seams, measure_seam, misalignment_m
from log2sim.perception.homography_stage import CameraHomography
from log2sim.perception.record_checks.thumbnails import shrink
from log2sim.perception.seam_cover import Standing, ground_points, standing_at
from log2sim.perception.sync import Schedule

# Distances from the rig at which cameras are compared; the middle one is the distance at which misalignment is reported.
DISTANCES_M = (9.0, 15.0)
REPORT_M = 15.0
# Ticks of which pictures are read to align mounts, and others to measure what is left.
TICKS = 6
# Rounds of measuring and turning: the offset varies over a patch by its share of the distance, so each leaves a fifth of it.
ALIGNING_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class SeamSurvey:
    """Seams between the cameras of a log at some ticks.

    Attributes
    ----------
    seams : tuple of Seam
    places : int
        How many patches two cameras see.
    covered : int
        How many of them show an object, or no ground.
    """

    seams: tuple[Seam, ...] = ()
    places: int = 0
    covered: int = 0

    @property
    def median_m(self) -> float | None:
        """Median length of the offsets, m; None where no patch could be registered."""
        return float(np.median([s.distance_m for s in self.seams])) if self.seams else None


@dataclass(frozen=True, eq=False)
class SeamPictures:
    """Gray pictures of all cameras at some ticks, and what stands on the ground there.

    Attributes
    ----------
    log : Log
    schedule : Schedule
    observed : Observations
    images : mapping of (str, int) to (H, W) uint8
        By camera and tick.
    """

    log: Log
    schedule: Schedule
    observed: Observations
    images: Mapping[tuple[str, int], NDArray[np.uint8]] = field(default_factory=dict)

    @classmethod
    def read(
        cls, log: Log, schedule: Schedule, observed: Observations, reader: RecordReader, ticks: Sequence[int]
    ) -> SeamPictures:
        """Read the pictures of some ticks; black, frozen and unreadable ones are left out."""
        images = {}
        for tick in ticks:
            for camera, index in schedule.frames.items():
                image = reader.get(camera, int(index[tick])) if index[tick] >= 0 else None
                t_ns = int(log.streams[camera].t_ns[index[tick]])
                if image is not None and reader.watch.cameras[camera].judge(t_ns, shrink(image)) == "live":
                    images[camera, tick] = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        return cls(log, schedule, observed, images)

    def survey(
        self, homographies: Mapping[str, CameraHomography], distances_m: Sequence[float] = (REPORT_M,)
    ) -> SeamSurvey:
        """Compare neighboring cameras by the homographies of the road."""
        seams, places, covered = [], 0, 0
        for tick in sorted({tick for _, tick in self.images}):
            seen = {name: g for name, g in homographies.items() if (name, tick) in self.images}
            roads = roads_at(self.log, self.schedule, seen, tick)
            if len(roads) < 2:
                continue
            cameras = {name: self.log.cameras[name] for name in roads}
            images = {name: self.images[name, tick] for name in roads}
            middle = np.mean([self._standing[tick].cameras[name][:2] for name in roads], axis=0)
            for place in (p for d in distances_m for p in find_seams(cameras, roads, middle, d)):
                places += 1
                rig = homographies[place.first].rig
                z = None if rig is None else rig.road_z_m(np.array(place.center_m), tick)
                hidden = self._standing[tick].hidden(place, cameras, roads, z)
                if hidden is None:
                    covered += 1
                    continue
                seam = measure_seam(SeamView(place, tick, hidden), images, cameras, roads)
                if seam is not None:
                    seams.append(seam)
        return SeamSurvey(tuple(seams), places, covered)

    @cached_property
    def _standing(self) -> dict[int, Standing]:
        """What stands on the ground at each tick."""
        points = ground_points(self.log, self.schedule, self.observed)
        return {
            tick: standing_at(self.log, self.schedule, self.observed, points, tick)
            for tick in sorted({tick for _, tick in self.images})
        }

    def misalignments_m(self, seams: Sequence[Seam], homographies: Mapping[str, CameraHomography]) -> Array:
        """Compute how far apart (N,) other homographies put what the cameras show at seams; NaN where a camera has none."""
        roads = {t: roads_at(self.log, self.schedule, homographies, t) for t in {seam.tick for seam in seams}}
        known = [{s.place.first, s.place.second} <= set(roads[s.tick]) for s in seams]
        return np.array([misalignment_m(s, roads[s.tick]) if k else np.nan for s, k in zip(seams, known)])


def roads_at(log: Log, schedule: Schedule, homographies: Mapping[str, CameraHomography], tick: int) -> dict[str, Array]:
    """Compute the homographies (3, 3) of the road of cameras with a frame at a tick, in the ground frame at its stamp."""
    out, base = {}, base_pose(log, int(schedule.t_ns[tick]))
    for name, ground in homographies.items():
        index = int(schedule.frames[name][tick])
        h = ground.road_at_tick(tick) if index >= 0 else None
        if h is not None:
            # The ego moves between the stamps of two cameras.
            moved = inverse(base) @ base_pose(log, int(log.streams[name].t_ns[index]))
            level = np.array([[*moved[0, :2], moved[0, 3]], [*moved[1, :2], moved[1, 3]], [0.0, 0.0, 1.0]])
            out[name] = level @ h
    return out


def turn_mounts(log: Log, homographies: Mapping[str, CameraHomography]) -> Log:
    """Return the log with the mounts of its cameras turned as their homographies ask for."""
    cameras = dict(log.cameras)
    for name, ground in homographies.items():
        if ground.rig is not None and ground.rig.state is not None:
            turn = np.eye(4)
            turn[:3, :3] = rotation_of(ground.rig.state.mount[name]).T
            cameras[name] = replace(cameras[name], mount_T_cam=cameras[name].mount_T_cam @ turn)
    return log.changed(cameras=cameras)


def ticks_of(schedule: Schedule, count: int = TICKS, *, held_out: bool = False) -> list[int]:
    """Choose ticks evenly over a log; `held_out` ones lie between the others."""
    steps = np.arange(count) + (0.75 if held_out else 0.25)
    return sorted({int(t) for t in np.floor(steps / count * len(schedule))})


def align_seams(
    pictures: SeamPictures, homographies: Mapping[str, CameraHomography]
) -> tuple[dict[str, CameraHomography], SeamSurvey]:
    """Turn the cameras of each rig so that their pictures of the road agree; returns the homographies and what was compared.

    Cameras that were fitted apart stay as they are. What is not observed stays at the calibration.
    """
    out, survey = dict(homographies), SeamSurvey()
    for _ in range(ALIGNING_ROUNDS):
        survey = pictures.survey(out, DISTANCES_M)
        for rig in {id(g.rig): g.rig for g in out.values() if g.rig is not None}.values():
            mounts = fit_mounts(rig, survey.seams)
            turned = with_mounts(rig, mounts)
            for name, ground in out.items():
                if ground.rig is rig:
                    out[name] = replace(ground, rig=turned)
    return out, survey
