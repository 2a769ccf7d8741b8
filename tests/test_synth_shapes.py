"""Shapes of road users, the rasterizer and the ray caster, each against a second method."""

from __future__ import annotations

import numpy as np
import pytest

from log2sim.geometry import Array
from log2sim.synth import shapes
from log2sim.synth.paint import Appearance, paint
from log2sim.synth.raster import Samples, first_hit, nearest_of
from log2sim.synth.shapes import Mesh, block, ellipsoid

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


@pytest.mark.parametrize("category", SIZES)
def test_faces_look_outwards(category: str) -> None:
    mesh = shape(category)
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]] for k in range(3))
    # Divergence theorem: only faces that look outwards sum up to a positive volume.
    assert np.einsum("fi,fi->", a, np.cross(b, c)) / 6 > 0.02 * np.prod(SIZES[category])


@pytest.mark.parametrize("category", SIZES)
def test_every_part_has_a_color(category: str) -> None:
    mesh = shape(category)
    look = Appearance(category, SIZES[category], (200, 30, 30), "sedan")
    rng = np.random.default_rng(0)
    face = rng.integers(len(mesh.faces), size=20000)
    weight = rng.dirichlet([1, 1, 1], size=len(face))[:, :, None]
    points, normals = ((x[mesh.faces[face]] * weight).sum(1) for x in (mesh.vertices_m, mesh.normals))
    colors = paint(look, mesh.part[face], points, normals)
    assert colors.albedo.shape == (len(face), 3)
    assert np.all((colors.albedo >= 0) & (colors.albedo <= 1.3))
    assert len(np.unique(colors.albedo.round(2), axis=0)) > 3


def rays_at(points: Array, eye: Array) -> Array:
    d = points - eye
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_rays_meet_a_sphere_where_the_formula_says() -> None:
    rng = np.random.default_rng(0)
    ball = ellipsoid([0, 0, 0], [1, 1, 1], 0, count=80)
    eye = np.array([4.0, 1.0, 0.5])
    rays = rays_at(rng.uniform(-1.3, 1.3, (400, 3)), eye)
    b, c = rays @ eye, eye @ eye - 1.0
    inside = b**2 - c
    expected = np.where(inside > 0, -b - np.sqrt(np.maximum(inside, 0)), np.inf)
    found = first_hit(np.tile(eye, (400, 1)), rays, ball.vertices_m[ball.faces])
    clear = np.abs(inside) > 0.05  # the polyhedron's outline differs a little from the ball's
    assert np.array_equal(np.isfinite(found[clear]), np.isfinite(expected[clear]))
    both = clear & np.isfinite(expected)
    assert np.abs(found[both] - expected[both]).max() < 0.01
    assert both.sum() > 50


@pytest.mark.slow
def test_the_rasterizer_and_the_ray_caster_see_the_same_surface() -> None:
    mesh = shape("car")
    K = np.array([[300.0, 0, 100], [0, 300.0, 60], [0, 0, 1]])
    cam_R_agent = np.array([[-0.6, 0.8, 0], [0, 0, -1], [-0.8, -0.6, 0]])
    vertices = mesh.vertices_m @ cam_R_agent.T + [0.3, 0.2, 8.0]
    seen = nearest_of(Samples.of(vertices, mesh.faces, K, 200, 120))
    v, u = np.divmod(np.arange(200 * 120), 200)
    rays = np.column_stack([(u - 100) / 300, (v - 60) / 300, np.ones(len(u))])
    depth = first_hit(np.zeros_like(rays), rays, vertices[mesh.faces])
    raster = np.full(len(rays), np.inf)
    raster[seen.pixel(200)] = seen.depth_m
    same = np.isclose(raster, depth, rtol=1e-4) | (np.isinf(raster) & np.isinf(depth))
    assert same.mean() > 0.999  # a ray through an edge may fall to either side
    assert np.isfinite(raster).sum() > 3000
    points = seen.interpolated(vertices, mesh.faces) * seen.depth_m[:, None]
    assert np.allclose(points, rays[seen.pixel(200)] * seen.depth_m[:, None], atol=1e-3)


def test_what_lies_behind_or_too_near_is_not_rasterized() -> None:
    box = block([-1, -1, -1], [1, 1, 1], 0)
    K = np.array([[100.0, 0, 50], [0, 100.0, 50], [0, 0, 1]])
    behind, ahead = box.vertices_m - np.array([0, 0, 5]), box.vertices_m + np.array([0, 0, 5])
    assert len(nearest_of(Samples.of(behind, box.faces, K, 100, 100)).u) == 0
    assert len(nearest_of(Samples.of(ahead, box.faces, K, 100, 100)).u) == pytest.approx(50**2, rel=0.05)
