"""Colors of vehicles from the pixels of their own surface, over the frames in which it is seen best."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.appearance.lab import lab_of_linear
from log2sim.appearance.light import estimate_light, linear_values, reflectances, veil_of
from log2sim.appearance.paint import find_paint
from log2sim.appearance.surface import SHAPES, Surface, hit_block, hit_vehicle
from log2sim.appearance.verdict import Look, decide_color
from log2sim.appearance.views import Boxes, boxes_at, choose_views, frames_of
from log2sim.datatypes import Log, Scenario
from log2sim.geometry import NS_PER_S, Array, inverse, line_time_s, project, undistort
from log2sim.perception.lidar.projection import View, project_boxes_in_view, view_of

Image = NDArray[np.uint8]

MAX_SAMPLES = 48  # rays along each side of a vehicle's rectangle
SCENE_SAMPLES = 64  # along the longer side of the picture
MIN_PAINT_PIXELS = 12
MAX_GRAY_DIFFERENCE = 4  # between channels of a picture without color, by the errors of JPEG
# The road from here to there around a vehicle lies in the same light, outside of the shade under it.
GROUND_FROM_M, GROUND_TO_M, GROUND_STEPS = 0.7, 2.5, 4
GROUND_PER_SIDE = 12
# Angles from inverse cosines near 1 are off by less than this.
ROUNDING_RAD = 1e-6


class ColorSampler:
    """Looks at the vehicles of a scenario in chosen pictures and names their colors.

    A consumer of `log2sim.perception.picture_pass.look_again`.

    Attributes
    ----------
    gray : set of str
        Cameras whose pictures have no color.
    """

    def __init__(self, log: Log, scenario: Scenario) -> None:
        self._log, self._scenario = log, scenario
        self._vehicles = [a.id for a in scenario.others if a.category in SHAPES]
        self._views = choose_views(log, scenario, self._vehicles)
        self._boxes: dict[str, dict[int, Boxes]] = {}
        self._looks: dict[str, list[Look]] = {}
        self.gray: set[str] = set()

    def frames(self) -> Mapping[str, NDArray[np.int64]]:
        """Return the indices of the frames that it wants, by camera."""
        return frames_of(self._views)

    def add(self, camera: str, index: int, image_bgr: Image) -> None:
        """Look at the vehicles for which a frame was chosen."""
        stride = max(1, max(image_bgr.shape[:2]) // SCENE_SAMPLES)
        grid = image_bgr[stride // 2 :: stride, stride // 2 :: stride, ::-1]
        halves = [half.reshape(-1, 3) for half in np.array_split(grid, 2)]
        if np.ptp(grid.astype(np.int16), axis=-1).max(initial=0) <= MAX_GRAY_DIFFERENCE:
            self.gray.add(camera)
            return
        t_ns = int(self._log.streams[camera].t_ns[index])
        view = view_of(self._log, camera, t_ns)
        if view is None:
            return
        agents = self._views.get(camera, {}).get(index, ())
        if not agents:
            return
        boxes = self._boxes_in(camera)[index]
        scene = _Scene(view, boxes, image_bgr, *halves)
        for agent in agents:
            row = next(k for k, other in enumerate(boxes.agents) if other.id == agent)
            look = scene.look_at(row)
            if look is not None:
                self._looks.setdefault(agent, []).append(look)

    def _boxes_in(self, camera: str) -> dict[int, Boxes]:
        """Return the boxes of all agents in the frames that it wants of a camera, made for all of them at once."""
        if camera not in self._boxes:
            frames = self.frames()[camera]
            t_s = (self._log.streams[camera].t_ns[frames] - self._scenario.t0_ns) / NS_PER_S
            boxes = boxes_at(self._scenario.others, t_s)
            self._boxes[camera] = {index: boxes.at(k) for k, index in enumerate(frames.tolist())}
        return self._boxes[camera]

    def colors(self) -> dict[str, dict[str, Any]]:
        """Return the color of each vehicle that was seen, by id, as `Agent.color` holds it."""
        return {agent: decide_color(looks) for agent, looks in self._looks.items()}

    def notes(self) -> tuple[str, ...]:
        """Say which vehicles have no color, and why."""
        missing = [agent for agent in self._vehicles if agent not in self._looks]
        if not missing:
            return ()
        reason = "no picture shows enough of them"
        if self.gray:
            reason += f"; pictures of {', '.join(sorted(self.gray))} are gray"
        return (f"no color of {len(missing)} of {len(self._vehicles)} vehicles: {reason}",)


@dataclass(frozen=True, eq=False)
class _Scene:
    """A picture with the boxes of all agents at its time."""

    view: View
    boxes: Boxes
    image: Image
    above: Image
    below: Image

    @cached_property
    def _linear_above(self) -> Array:
        return linear_values(self.above)

    @cached_property
    def _linear_below(self) -> Array:
        return linear_values(self.below)

    def look_at(self, row: int) -> Look | None:
        """Look at an agent; None where too little of its paint is seen."""
        center, yaw, size = self.boxes.center[row, 0], self.boxes.yaw[row, 0], self.boxes.size[row]
        if not np.isfinite(center).all():
            return None
        found = project_boxes_in_view(self.view, center[None], size[None], yaw[None])
        if not found.valid[0]:
            return None
        map_T_cam = self._pose((found.box_px[:, :2] + found.box_px[:, 2:]) / 2)
        uv, rays = self._rays(map_T_cam, found.box_px[0])
        origin, turned = _to_box(map_T_cam[:3, 3], rays, center, yaw)
        hits = hit_vehicle(self.boxes.agents[row].category, size, origin, turned)
        clear = np.isfinite(hits.distance)
        distance = hits.distance[clear]
        clear[clear] = distance < self._others(map_T_cam[:3, 3], rays[clear], distance, but=row)
        weight = np.where(clear, hits.weight, 0.0)
        rows = np.flatnonzero(weight)
        if len(rows) < MIN_PAINT_PIXELS:
            return None
        height_px = float(found.box_px[0, 3] - found.box_px[0, 1])
        surface = Surface(self._pixels(uv[rows]), weight[rows], hits.facing[rows], height_px)
        light = estimate_light(self._linear_below, self._linear_above, self._road(row, map_T_cam))
        veil = veil_of(self._pixels(uv[clear]), light)
        paint = find_paint(lab_of_linear(reflectances(surface.pixels, light, surface.facing, veil)), surface.weight)
        return Look.of(paint, light, surface)

    def _pose(self, uv: Array) -> Array:
        """Return the pose of the camera when the line of a pixel (1, 2) was exposed."""
        if self.view.cam_T_map_at is None:
            return self.view.map_T_cam
        return np.asarray(inverse(self.view.cam_T_map_at(line_time_s(self.view.camera, uv))[0]))

    def _rays(self, map_T_cam: Array, box_px: Array) -> tuple[Array, Array]:
        """Return pixels (N, 2) spread over a rectangle and their rays (N, 3), map frame."""
        (u0, v0, u1, v1), steps = box_px, np.clip(box_px[2:] - box_px[:2], 2, MAX_SAMPLES).astype(int)
        u = np.floor(u0 + (np.arange(steps[0]) + 0.5) * (u1 - u0) / steps[0])
        v = np.floor(v0 + (np.arange(steps[1]) + 0.5) * (v1 - v0) / steps[1])
        uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        xy = undistort(self.view.camera, uv + 0.5)
        rays = np.column_stack([xy, np.ones(len(xy))]) @ map_T_cam[:3, :3].T
        seen = np.isfinite(rays).all(axis=1)
        return uv[seen], rays[seen]

    def _others(self, origin: Array, rays: Array, within: Array, but: int | None = None) -> Array:
        """Return the distances (N,), in lengths of the rays, at which rays meet an agent other than one.

        What they meet farther away than all of `within` (N,) may be left out.
        """
        nearest = np.full(len(rays), np.inf)
        for k in self._near(origin, rays, within):
            if k != but:
                half = self.boxes.size[k] / 2
                start, turned = _to_box(origin, rays, self.boxes.center[k, 0], self.boxes.yaw[k, 0])
                np.minimum(nearest, hit_block(-half, half, start, turned)[0], out=nearest)
        return nearest

    def _near(self, origin: Array, rays: Array, within: Array) -> list[int]:
        """Return the rows of agents that rays (N, 3) may meet: those whose spheres reach into the cone around the rays."""
        if not len(rays):
            return []
        length = np.linalg.norm(rays, axis=1)
        directions = rays / length[:, None]
        axis = directions.mean(axis=0)
        axis /= np.linalg.norm(axis)
        cone = np.arccos(np.clip((directions @ axis).min(), -1, 1))
        toward = self.boxes.center[:, 0] - origin
        away = np.linalg.norm(toward, axis=1)
        reach = np.linalg.norm(self.boxes.size, axis=1) / 2
        with np.errstate(invalid="ignore", divide="ignore"):
            angle = np.arccos(np.clip(toward @ axis / away, -1, 1))
            sphere = np.where(away > reach, np.arcsin(np.clip(reach / away, -1, 1)), np.pi)
            near = (away - reach < (within * length).max()) & (angle <= cone + sphere + ROUNDING_RAD)
        return [int(k) for k in np.flatnonzero(near)]

    def _road(self, row: int, map_T_cam: Array) -> Array:
        """Return pixels (G, 3), linear RGB, of the road around an agent, where no agent hides it."""
        center, yaw, size = self.boxes.center[row, 0], self.boxes.yaw[row, 0], self.boxes.size[row]
        points = center + _turned(_ring(size), yaw)
        cam_T_map = inverse(map_T_cam)
        uv, inside = project(self.view.camera, points @ cam_T_map[:3, :3].T + cam_T_map[:3, 3])
        points, uv = points[inside], uv[inside]
        if not len(points):
            return np.zeros((0, 3))
        rays = points - map_T_cam[:3, 3]
        hidden = self._others(map_T_cam[:3, 3], rays, np.ones(len(rays))) < 1
        return self._pixels(np.floor(uv[~hidden]))

    def _pixels(self, uv: Array) -> Array:
        """Return linear RGB (N, 3) of pixels (N, 2)."""
        height, width = self.image.shape[:2]
        u, v = np.clip(uv[:, 0], 0, width - 1).astype(int), np.clip(uv[:, 1], 0, height - 1).astype(int)
        return linear_values(self.image[v, u, ::-1])


def _ring(size: Array) -> Array:
    """Return points (G, 3) on the ground around a box, in its frame."""
    along = np.linspace(-1, 1, GROUND_PER_SIDE)
    one = np.ones(GROUND_PER_SIDE)
    square = np.concatenate([np.c_[along, one], np.c_[along, -one], np.c_[one, along], np.c_[-one, along]])
    out = [square * (size[:2] / 2 + away) for away in np.linspace(GROUND_FROM_M, GROUND_TO_M, GROUND_STEPS)]
    flat = np.concatenate(out)
    return np.column_stack([flat, np.full(len(flat), -size[2] / 2)])


def _turned(points: Array, yaw: float) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.column_stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1], points[:, 2]])


def _to_box(origin: Array, rays: Array, center: Array, yaw: float) -> tuple[Array, Array]:
    """Return the origin (3,) and directions (N, 3) of rays in the frame of a box."""
    return _turned((origin - center)[None], -yaw)[0], _turned(rays, -yaw)
