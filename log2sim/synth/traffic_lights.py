"""Traffic lights: housings with three lamps on poles, which switch by a program."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Signal
from log2sim.geometry import Array, rotation_from_rpy, transform, wrap_angle
from log2sim.synth.bodies import Body, Values
from log2sim.synth.scene import Scene
from log2sim.synth.scene_places import TrafficLight
from log2sim.synth.shapes import Mesh, block, merged, surface
from log2sim.synth.surfaces import Paint, linear_bgr

# Three lenses of 200 mm in a housing, as EN 12368 has them.
DEPTH_M, WIDTH_M, HEIGHT_M = 0.25, 0.34, 0.96
LENS_RADIUS_M, LENS_SPACING_M, LENS_AHEAD_M = 0.1, 0.3, 0.006
POLE_M = 0.12
CORNERS = 20  # of a lens
HOUSING, POLE, RED, YELLOW, GREEN = range(5)
LAMPS = (RED, YELLOW, GREEN)
LIT = {"red": (RED,), "red_yellow": (RED, YELLOW), "yellow": (YELLOW,), "green": (GREEN,), "off": ()}
COLORS = {RED: (255, 40, 28), YELLOW: (255, 190, 30), GREEN: (40, 235, 150)}
DARK_LENS, GLOW = 0.06, 1.4  # of the color of a lamp: what a dark lens reflects, what a lit one emits by day
HOUSING_RGB, POLE_RGB = (34, 36, 36), (122, 126, 128)


def signals_of(scene: Scene) -> tuple[Signal, ...]:
    """Return the true states of all traffic lights over a scene."""
    return tuple(_signal(light, scene.duration_s) for light in scene.traffic_light)


def _signal(light: TrafficLight, duration_s: float) -> Signal:
    length = np.array([seconds for _, seconds in light.program])
    t, k = light.start_s, 0
    times: list[float] = []
    states: list[str] = []
    while t < duration_s:
        state, ends = light.program[k][0], t + float(length[k])
        if ends > 0 and (not states or states[-1] != state):
            times.append(max(t, 0.0))
            states.append(state)
        t, k = ends, (k + 1) % len(light.program)
    heading = float(wrap_angle(np.deg2rad(light.yaw_deg)))
    return Signal(light.id, np.array(light.position), heading, np.array(times), np.array(states))


def bodies_at(scene: Scene, t_s: float) -> list[Body]:
    """Traffic lights as they look at a time in s since the start."""
    out = []
    for light, signal in zip(scene.traffic_light, signals_of(scene)):
        mesh, pose = _mesh(light), _pose(light)
        size = (DEPTH_M, WIDTH_M, 2 * light.position[2])  # so that its ground is that of the scene
        out.append(Body(mesh, pose, size, partial(_paint, str(signal.at(t_s)[0]))))
    return out


def triangles_of(scene: Scene) -> tuple[Array, ...]:
    """Triangles (F, 3, 3) in the map of each traffic light, as a LiDAR meets them."""
    out = []
    for light in scene.traffic_light:
        mesh, pose = _mesh(light), _pose(light)
        vertices = mesh.vertices_m @ pose[:3, :3].T + pose[:3, 3]
        out.append(vertices[mesh.faces])
    return tuple(out)


def _pose(light: TrafficLight) -> Array:
    return transform(rotation_from_rpy(0.0, 0.0, np.deg2rad(light.yaw_deg)), np.array(light.position))


def _mesh(light: TrafficLight) -> Mesh:
    """Shape a traffic light around the middle of its housing, which faces +x."""
    low, high = [-DEPTH_M / 2, -WIDTH_M / 2, -HEIGHT_M / 2], [DEPTH_M / 2, WIDTH_M / 2, HEIGHT_M / 2]
    parts = [block(low, high, HOUSING), *(_lens(1 - k, part) for k, part in enumerate(LAMPS))]
    if light.pole:
        behind = -DEPTH_M / 2 - POLE_M
        low, high = [behind, -POLE_M / 2, -light.position[2]], [-DEPTH_M / 2, POLE_M / 2, HEIGHT_M / 2]
        parts.append(block(low, high, POLE))
    return merged(parts)


def _lens(row: int, part: int) -> Mesh:
    angle = np.arange(CORNERS) * 2 * np.pi / CORNERS
    x = DEPTH_M / 2 + LENS_AHEAD_M
    ring = np.stack([np.full(CORNERS, x), np.cos(angle), np.sin(angle)], 1) * [1, LENS_RADIUS_M, LENS_RADIUS_M]
    vertices = np.concatenate([ring, [[x, 0.0, 0.0]]]) + np.array([0, 0, row * LENS_SPACING_M])
    k = np.arange(CORNERS)
    return surface(vertices, np.stack([k, (k + 1) % CORNERS, np.full(CORNERS, CORNERS)], 1), part)


def _paint(state: str, part: NDArray[np.int64], p: Values, n: Values) -> Paint:
    out = Paint(np.empty((len(p), 3), np.float32), np.full(len(p), 0.1, np.float32), np.zeros((len(p), 3), np.float32))
    out.albedo[:] = linear_bgr(HOUSING_RGB)
    out.albedo[part == POLE] = linear_bgr(POLE_RGB)
    for lamp in LAMPS:
        color = linear_bgr(COLORS[lamp])
        out.albedo[part == lamp] = DARK_LENS * color
        if lamp in LIT[state]:
            out.glow[part == lamp] = GLOW * color
    return out
