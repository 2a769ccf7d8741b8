"""Shapes of road users, the rasterizer and the ray caster, each against a second method."""

from __future__ import annotations

import numpy as np
import pytest

from log2sim.synth import shapes
from log2sim.synth.shapes import Mesh

SIZES = {"car": (4.4, 1.8, 1.5), "truck": (7.2, 2.4, 3.0), "bus": (11.0, 2.5, 3.1), "cyclist": (1.76, 0.6, 1.76)}


def shape(category: str) -> Mesh:
    make = {
        "car": lambda size: shapes.car(size, "sedan"),
        "truck": shapes.truck,
        "bus": shapes.bus,
        "cyclist": lambda size: shapes.cyclist(size, 5),
    }
    return make[category](SIZES[category])


@pytest.mark.parametrize("category", SIZES)
def test_the_shape_touches_its_box_on_all_sides(category: str) -> None:
    vertices = shape(category).vertices_m
    assert np.allclose(vertices.max(0), np.array(SIZES[category]) / 2, atol=1e-9)
    assert np.allclose(vertices.min(0), -np.array(SIZES[category]) / 2, atol=1e-9)


def test_a_walker_touches_its_box_over_a_stride_and_always_the_ground() -> None:
    size = (0.72, 0.58, 1.7)
    poses = [shapes.pedestrian(size, k, False).vertices_m for k in range(shapes.PHASES)]
    assert np.allclose(np.max([p.max(0) for p in poses], axis=0), np.array(size) / 2, atol=1e-9)
    assert np.allclose([p[:, 2].min() for p in poses], -size[2] / 2, atol=1e-9)
