"""Surfels of a body that no sensor has seen: of the category and size of an agent, with the shapes of `synth`."""

from __future__ import annotations

import numpy as np

from log2sim.datatypes import Agent
from log2sim.resim.surfels import Surfels
from log2sim.synth import shapes

DISC_M = 0.08  # radius of the discs of a body


def body_of(agent: Agent) -> Surfels:
    """Return a body in the agent's frame, its discs as far apart as they are wide."""
    size = (float(agent.size_m[0]), float(agent.size_m[1]), float(agent.size_m[2]))
    makers = {
        "car": lambda: shapes.car(size, "hatch"),
        "truck": lambda: shapes.truck(size),
        "bus": lambda: shapes.bus(size),
        "pedestrian": lambda: shapes.pedestrian(size, 0, bool(agent.static)),
    }
    mesh = makers.get(agent.category, lambda: shapes.cyclist(size, 0))()
    mesh = mesh.fitted(size)
    corner = mesh.vertices_m[mesh.faces]
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(cross, axis=1) / 2
    solid = area > 1e-8
    corner, normal, area = corner[solid], cross[solid] / (2 * area[solid, None]), area[solid]
    # As many points on a triangle as its area takes, spread by a low-discrepancy sequence of the whole body.
    total = np.cumsum(area) / DISC_M**2
    count = np.diff(np.floor(total), prepend=0).astype(np.int64)
    face = np.repeat(np.arange(len(corner)), count)
    n = np.arange(len(face)) + 1
    u, v = (n * 0.7548776662466927) % 1, (n * 0.5698402909980532) % 1  # Roberts' R2
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    a, b, c = corner[face].transpose(1, 0, 2)
    one = np.ones(len(face), np.float32)
    points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    return Surfels(points.astype(np.float32), normal[face].astype(np.float32), one * DISC_M, one, one, one)
