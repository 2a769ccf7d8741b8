"""Seams of a log: what neighboring cameras show of the same ground at some ticks, and mounts that make them agree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Obstacles
from log2sim.geometry import Array, apply, inverse
from log2sim.perception.first_pass import Observations, base_pose
from log2sim.perception.frames import RecordReader
from log2sim.perception.homography.rig import rotation_of
from log2sim.perception.homography.rig_seams import fit_mounts, with_mounts
from log2sim.perception.homography.seams import LENGTH_M, Seam, SeamPlace, find_seams, measure_seam, pixels_of
from log2sim.perception.homography_stage import CameraHomography
from log2sim.perception.record_checks.thumbnails import shrink
from log2sim.perception.sync import Schedule

# Distances from the rig at which cameras are compared; the middle one is the distance at which misalignment is reported.
DISTANCES_M = (9.0, 15.0)
REPORT_M = 15.0
# Ticks of which pictures are read to align mounts, and others to measure what is left.
TICKS = 6
# Ground within this distance of a patch, and so much time before and after, shows that it lies on the ground.
NEAR_M, NEAR_S, MIN_GROUND_POINTS = 3.0, 2.0, 3
# More LiDAR points that hide or cover a patch are an object on it.
MAX_HIDING_POINTS = 4
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
    def misalignment_m(self) -> float | None:
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
            places_xy = np.array([self._place(name, tick) for name in roads])
            images = {name: self.images[name, tick] for name in roads}
            for distance in distances_m:
                for place in find_seams(cameras, roads, places_xy.mean(axis=0), distance):
                    places += 1
                    if not self._shows_ground(place, tick, roads):
                        covered += 1
                        continue
                    seam = measure_seam(place, tick, images, cameras, roads)
                    if seam is not None:
                        seams.append(seam)
        return SeamSurvey(tuple(seams), places, covered)

    def _stamp(self, camera: str, tick: int) -> int:
        return int(self.log.streams[camera].t_ns[self.schedule.frames[camera][tick]])

    def _base(self, tick: int) -> Array:
        """Pose (4, 4) of the ground frame that all pictures of a tick are compared in."""
        return base_pose(self.log, int(self.schedule.t_ns[tick]))

    def _place(self, camera: str, tick: int) -> Array:
        """Position (2,) of a camera in that frame."""
        pose = self.log.map_T_sensor(camera, self._stamp(camera, tick))[0][0]
        return np.asarray((inverse(self._base(tick)) @ pose)[:2, 3])

    def _shows_ground(self, place: SeamPlace, tick: int, roads: Mapping[str, Array]) -> bool:
        """Return whether LiDAR ground lies at a place, and nothing stands on it or before it."""
        xy = place.cells()
        for name in (place.first, place.second):
            uv, inside = pixels_of(self.log.cameras[name], roads[name], xy)
            if inside.any() and self._overlaps_box(name, tick, uv[inside]):
                return False
        obstacles = self.observed.obstacles[tick] if tick < len(self.observed.obstacles) else None
        if obstacles is None:
            return True
        return self._has_ground(place, tick) and not self._is_hidden(place, tick, obstacles)

    def _overlaps_box(self, camera: str, tick: int, uv: Array) -> bool:
        m = self.observed.measurements[tick]
        low, high = uv.min(axis=0), uv.max(axis=0)
        box = m.box_px[m.camera == camera]
        return bool(((box[:, :2] < high) & (box[:, 2:] > low)).all(axis=1).any())

    def _has_ground(self, place: SeamPlace, tick: int) -> bool:
        near_ns, count = int(NEAR_S * 1e9), 0
        base_T_map = inverse(self._base(tick))
        for name in (place.first, place.second):
            for rows in self.observed.ground.get(name, []):
                if (
                    len(rows) == 0
                    or abs(int(self.schedule.t_ns[rows.tick[0]]) - int(self.schedule.t_ns[tick])) > near_ns
                ):
                    continue
                there = base_T_map @ base_pose(self.log, self._stamp(name, int(rows.tick[0])))
                xy = rows.xy_ego @ there[:2, :2].T + there[:2, 3]
                count += int((np.hypot(*(xy - place.center_m).T) < NEAR_M).sum())
        return count >= MIN_GROUND_POINTS

    def _is_hidden(self, place: SeamPlace, tick: int, obstacles: Obstacles) -> bool:
        """Return whether LiDAR points above the ground lie in the picture where the place is, seen from a camera."""
        points = apply(inverse(self._base(tick)), obstacles.xyz.astype(np.float64) + obstacles.origin)
        points[:, 2] -= self.log.ground_z_ego_m
        for name in (place.first, place.second):
            pose = inverse(self._base(tick)) @ self.log.map_T_sensor(name, self._stamp(name, tick))[0][0]
            height = pose[2, 3] - self.log.ground_z_ego_m
            lower = points[(points[:, 2] < 0.95 * height)]
            # A point stands on the ground below it, and hides that on the line from the camera through it.
            hidden = pose[:2, 3] + (lower[:, :2] - pose[:2, 3]) * (height / (height - lower[:, 2]))[:, None]
            for xy in (lower[:, :2], hidden):
                local = (xy - place.center_m) @ place.axes.T
                if ((np.abs(local) < [LENGTH_M / 2, place.width_m / 2]).all(axis=1)).sum() > MAX_HIDING_POINTS:
                    return True
        return False


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
