"""A map of the ground of a whole log: sweeps give its height and intensity, pictures its color."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property, partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.config import MapConfig
from log2sim.datatypes import Log, Scenario
from log2sim.geometry import NS_PER_S, Array
from log2sim.localization.pose_refinement import refine_poses
from log2sim.localization.replaced import replace_poses
from log2sim.perception.frames import read_pictures, work_ahead
from log2sim.perception.records import RecordSource
from log2sim.road.ground_map import Extent, GroundMap, Raster, coarsened_cell_m
from log2sim.road.map_parts import OVERLAP_M, ROADSIDE_MARGIN_M, is_within, path_of, roadside_of, whole_map
from log2sim.road.pictures import ColorRaster, Image, View, find_hidden, median_picture, sample_nearest, warp_onto
from log2sim.road.road_users import MASK_SHRINK, RoadUsers, covered, draw_footprints, draw_outlines
from log2sim.road.surface import (
    MAX_POINTS,
    GroundPoints,
    Surface,
    estimate_surface,
    map_intensity,
    take_sweep,
    upsample,
)

# A camera 1.5 m above the road resolves it to 5 cm with 1000 px of focal length up to 9 m away: every place is seen so at least
# three times from pictures 2 m apart.
PICTURE_STEP_M = 2.0
# Rings of a sweep are 0.1 to 1 m apart on the ground: small steps of the ego fill the gaps between them.
SWEEP_STEP_M = 0.1
# So many points for each meter of the way are a return a centimeter on rings of 60 m, on 30 rings: more make no finer map. Of a
# sweep of 120,000 points one is taken each 0.6 m, as at 6 m/s anyway.
POINTS_A_METER = 200_000
# What stands still, the same sensor shows again; several records of it average the noise and let moving shadows pass.
STANDING_RECORDS = 7
MAX_PICTURES, MAX_SWEEPS = 400, 160


def choose_records(
    log: Log, scenario: Scenario, area_m: Extent, steps_m: Mapping[str, float], most: int
) -> dict[str, NDArray[np.int64]]:
    """Choose the records of sensors by name: where the ego is a step, m, farther on, at most `most` of all sensors together.

    Those of sensors that are too far from an area to see much of it are left out.
    """
    steps_m = {name: step_m for name, step_m in steps_m.items() if name in log.streams}
    most = max(most // max(len(steps_m), 1), STANDING_RECORDS)
    found = {}
    for name, step_m in steps_m.items():
        t_ns, end_ns = log.streams[name].t_ns, scenario.t0_ns + round(scenario.duration_s * NS_PER_S)
        pose, known = log.map_T_sensor(name, t_ns)
        sensor = log.cameras[name] if name in log.cameras else log.lidars[name]
        known &= is_within(pose[:, :2, 3], area_m, ROADSIDE_MARGIN_M if sensor.mount == "map" else OVERLAP_M)
        usable = np.flatnonzero(known & (t_ns >= scenario.t0_ns) & (t_ns <= end_ns))
        place, chosen = pose[usable, :3, 3], [0]
        gone = np.cumsum(np.append(0.0, np.linalg.norm(np.diff(place, axis=0), axis=1)))
        # Noise of the poses of a sensor at rest is no way; it must come away from where it was last taken.
        step = max(step_m, gone[-1] / most)
        for k in range(1, len(usable)):
            if np.linalg.norm(place[k] - place[chosen[-1]]) >= step:
                chosen.append(k)
        if len(chosen) < STANDING_RECORDS:
            chosen = np.unique(np.linspace(0, len(usable) - 1, STANDING_RECORDS).round().astype(int)).tolist()
        found[name] = usable[chosen[:most]].astype(np.int64) if len(usable) else usable.astype(np.int64)
    return found


# Cells of heights along the edge of a cell of colors: curbs are 10 cm wide, and ten points lie on such a cell in a usual log.
HEIGHT_CELL_M = 0.1
# Half the width of a car: where the middle of the ego went, there is road this far to both sides.
ROAD_HALF_WIDTH_M = 1.0
# A sweep shows what hid the ground in a picture if both were taken within this time.
MAX_APART_S = 0.15
# LiDARs on roofs do not see the ground nearer than this around the vehicle.
BLIND_M = 6.0
# Rings of a LiDAR are up to this far apart on ground that its pictures still show finely.
MAX_AWAY_M = 2.0
# Of a LiDAR, to see how many points it gives.
PROBED_SWEEPS = 3
Progress = Callable[[int, int], None]


class GroundMapBuilder:
    """Make a map of the ground from pictures and sweeps.

    `log`: with refined poses, see `refine_poses`. `scenario`: its agents hide the ground: moving ones where they are at
    the time of a record, standing ones always. `records`: of this log; reads both and counts what cannot be read.
    `area_m`: what is mapped, in whole meters; all that the log shows if None.

    `notes`: what could not be mapped, and why.

    Raises `LogError` when no pose is known.
    """

    def __init__(
        self,
        log: Log,
        scenario: Scenario,
        settings: MapConfig,
        records: RecordSource | None = None,
        progress: Progress | None = None,
        *,
        area_m: Extent | None = None,
    ) -> None:
        self._log, self._scenario = log, scenario
        self._records, self._progress = records or RecordSource(log), progress or (lambda done, total: None)
        self._path = path_of(log, scenario)
        extent = area_m or whole_map(log, scenario)
        cell_m = coarsened_cell_m(extent, settings.cell_m)
        self.notes: list[str] = []
        if cell_m > settings.cell_m:
            size = f"{extent[1] - extent[0]:.0f} x {extent[3] - extent[2]:.0f} m"
            self.notes.append(f"the map covers {size}: cells of {cell_m:g} m instead of {settings.cell_m:g} m")
        self.raster = Raster.covering(extent, cell_m)
        self._coarse = self.raster.coarser(max(round(HEIGHT_CELL_M / self.raster.resolution_m), 1))
        self._anchors = self._path if len(self._path) else roadside_of(log, scenario)
        near = self._anchors[is_within(self._anchors, extent, ROADSIDE_MARGIN_M)]
        self._z0_m = float(np.median(near[:, 2] if len(near) else self._anchors[:, 2]))
        steps = {name: self._sweep_step_m(name) for name in log.lidars}
        self._sweeps = choose_records(log, scenario, extent, steps, MAX_SWEEPS)
        # Cameras that the scenario was made with; all of the log where it names none.
        used = [str(c["name"]) for c in scenario.cameras if c.get("used") and c["name"] in log.cameras]
        self._frames = choose_records(
            log, scenario, extent, dict.fromkeys(used or log.cameras, PICTURE_STEP_M), MAX_PICTURES
        )
        stamps = [log.streams[name].t_ns[i] for name, i in (*self._sweeps.items(), *self._frames.items())]
        self._users = RoadUsers(log, scenario, np.concatenate([*stamps, np.zeros(0, np.int64)]))
        self._standing: dict[str, tuple[View, list[tuple[Image, NDArray[np.uint8]]]]] = {}
        self._colors = ColorRaster(self.raster) if any(len(i) for i in self._frames.values()) else None

    def inputs(self) -> list[Any]:
        """Return what the map depends on besides the log: its cells, which records it takes, what is known of them, and road users."""
        known = [self._records.watch.known(name) for name in (*self._log.cameras, *self._log.lidars)]
        places = [self.raster.resolution_m, self.raster.extent_m, self._anchors, self._z0_m, self.notes]
        return [*places, self._frames, self._sweeps, known, *self._users.inputs()]

    def lay_pictures(self, progress: Progress = lambda done, total: None) -> None:
        """Lay the pictures on the ground, each where the surface that the sweeps show appears in it."""
        if self._colors is None:
            return
        for camera, index, image in read_pictures(self._records, self._frames, progress):
            t_ns = int(self._log.streams[camera].t_ns[index])
            map_T_cam, valid = self._log.map_T_sensor(camera, t_ns)
            if not valid[0]:
                continue
            view = View(self._log.cameras[camera], map_T_cam[0], t_ns, self._log)
            users = draw_outlines(self._users.at(t_ns), view.camera, view.map_T_cam)
            if view.camera.mount == "map":  # the median of all of them is laid
                self._standing.setdefault(camera, (view, []))[1].append((image, users))
            else:
                self._lay(self._colors, view, image, users)

    def _lay(self, colors: ColorRaster, view: View, image: Image, users: NDArray[np.uint8]) -> None:
        """Lay a picture on the ground but where its mask shows road users, or where something stands before the ground."""
        warp = warp_onto(view, self._laid, self._z0_m, self.raster)
        if warp is None:
            return
        kept = sample_nearest(users, warp, MASK_SHRINK, np.uint8(0)) == 0
        kept &= self._likely_ground.ravel().take(warp.cell) > 0
        if view.camera.mount == "ego":
            kept &= ~covered([self._users.ego_at(view.t_ns)], self.raster, warp.cell)
            # What stood above the ground in sweeps nearby in time.
            hiding = [
                points for t_ns, points in self._swept[1].items() if abs(t_ns - view.t_ns) <= MAX_APART_S * NS_PER_S
            ]
            if hiding:
                kept &= ~find_hidden(view, warp, np.concatenate(hiding))
        colors.add(view.camera.name, image, warp.take(kept))

    def build(self) -> GroundMap:
        """Return the map of all that was added, as far as anything is known; once, since what it is made of is let go."""
        shape = self.raster.shape
        if self._colors is None:
            self.notes.append("no color: there is no picture with a known pose")
            color, alpha = np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.uint8)
        else:
            for view, pictures in self._standing.values():
                self._lay(self._colors, view, *median_picture(*zip(*pictures)))
            self._standing.clear()
            color, alpha = self._colors.image()
            self._colors = None
        standing = draw_footprints([self._users.standing()], self.raster) > 0
        alpha[standing], color[standing] = 0, 0
        surface, factor = self._surface, round(self._surface.raster.resolution_m / self.raster.resolution_m)
        height = upsample(surface.z_m, factor, shape) + np.float32(self._z0_m)
        known = np.repeat(np.repeat(surface.known, factor, axis=0), factor, axis=1)[: shape[0], : shape[1]]
        height[~known] = np.nan
        intensity = map_intensity(self._swept[0], surface, self.raster, self._road(surface.raster))
        for name in ("_swept", "_surface", "_laid", "_likely_ground"):
            self.__dict__.pop(name, None)
        for layer in (height, intensity):
            layer[standing] = np.nan
        place = self.raster.resolution_m, self.raster.extent_m
        whole = GroundMap(color, alpha, height, intensity, *place, tuple(self.notes))
        return whole.around(whole.known)

    def _sweep_step_m(self, lidar: str) -> float:
        """Return how far apart sweeps are taken, m, by how many points the first that can be read has."""
        t_ns = self._log.streams[lidar].t_ns if lidar in self._log.streams else np.zeros(0, np.int64)
        for index in np.flatnonzero(t_ns >= self._scenario.t0_ns)[:PROBED_SWEEPS].tolist():
            sweep = self._records.get(lidar, index)
            if sweep is not None:
                return max(SWEEP_STEP_M, len(sweep.xyz_m) / POINTS_A_METER)
        return SWEEP_STEP_M

    @cached_property
    def _swept(self) -> tuple[GroundPoints, dict[int, Array]]:
        """Read the sweeps: points near the ground and, by stamp, points (H, 3), m, map frame, of what stands above it."""
        chosen = [(name, int(i)) for name, indices in self._sweeps.items() for i in indices]
        stamps = {(name, i): int(self._log.streams[name].t_ns[i]) for name, i in chosen}
        chosen.sort(key=stamps.__getitem__)
        most = MAX_POINTS // max(len(chosen), 1)

        def take(key: tuple[str, int]) -> tuple[GroundPoints, Array] | None:
            name, sweep, t_ns = key[0], self._records.get(*key), stamps[key]
            if sweep is None or self._records.watch.lidars[name].repeated.get(t_ns, False):
                return None
            users, hides = [self._users.at(t_ns), self._users.ego_at(t_ns)], self._colors is not None
            return take_sweep(self._log, name, sweep, self._coarse, users, most=most, z0_m=self._z0_m, hides=hides)

        parts: list[GroundPoints] = []
        hiding: dict[int, Array] = {}
        for done, (key, taken) in enumerate(zip(chosen, work_ahead(take, chosen))):
            if taken is not None:
                parts.append(taken[0])
                hiding[stamps[key]] = np.concatenate([hiding.get(stamps[key], np.zeros((0, 3))), taken[1]])
            self._progress(done + 1, len(chosen))
        points = GroundPoints.join(parts)
        if not len(points.z):
            flat = "no height and no intensity: there is no sweep with ground; pictures are laid on flat ground"
            self.notes.append(flat)
        elif not np.isfinite(points.intensity).any():
            self.notes.append("no intensity: the sweeps of this log have none")
        return points, hiding

    @cached_property
    def _surface(self) -> Surface:
        return estimate_surface(self._swept[0], self._coarse, self._anchors, self._z0_m)

    @cached_property
    def _laid(self) -> Surface:
        """The surface on which pictures are laid."""
        return self._surface.smoothed()

    @cached_property
    def _likely_ground(self) -> NDArray[np.uint8]:
        """Mask (R, C), 1 where there may be ground: everywhere without sweeps, else near what they show or the ego passed.

        Behind that stand houses, which pictures would smear over the map.
        """
        surface = self._surface
        if not surface.known.any():
            return np.ones(self.raster.shape, dtype=np.uint8)
        blind = self._road(surface.raster, BLIND_M)
        away = cv2.distanceTransform((~surface.known & ~blind).astype(np.uint8), cv2.DIST_L2, 3)
        near = (away * surface.raster.resolution_m <= MAX_AWAY_M).astype(np.uint8)
        factor = round(surface.raster.resolution_m / self.raster.resolution_m)
        rows, columns = self.raster.shape
        return np.ascontiguousarray(np.repeat(np.repeat(near, factor, axis=0), factor, axis=1)[:rows, :columns])

    def _road(self, raster: Raster, half_width_m: float = ROAD_HALF_WIDTH_M) -> NDArray[np.bool_]:
        """Mask (R, C) of the cells that the ego drove over, or past at a distance."""
        mask = np.zeros(raster.shape, dtype=np.uint8)
        if len(self._path):
            rows, columns = raster.cells_of(self._path[:, :2])
            line = np.rint(np.stack([columns, rows], axis=1)).astype(np.int32)
            cv2.polylines(mask, [line], False, 1, max(round(2 * half_width_m / raster.resolution_m), 1))
        return mask > 0


def map_ground(
    log: Log,
    scenario: Scenario,
    settings: MapConfig | None = None,
    records: RecordSource | None = None,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
    *,
    refine: bool = True,
) -> GroundMap:
    """Map the ground of a log.

    `scenario`: its agents are left out of the map; its span of time is what is mapped. `records`: counts the records that cannot be
    read. `progress`: called as `progress(stage, done, total)`. `refine`: whether the poses are refined first, see `refine_poses`.

    Raises `LogError` when no pose is known, or no record that is wanted can be read.
    """
    records, settings = records or RecordSource(log), settings or MapConfig()
    if refine:
        end_ns = scenario.t0_ns + round(scenario.duration_s * NS_PER_S)
        refined = refine_poses(log, (scenario.t0_ns, end_ns))
        log = log if refined is None else replace_poses(log, refined)
    records = records.of(log)
    builder = GroundMapBuilder(log, scenario, settings, records, partial(progress, "map: sweeps"))
    builder.lay_pictures(partial(progress, "map: pictures"))
    records.require_some()
    return builder.build()
