"""Closed forms of simulated sweeps: rays on discs, bodies, the ground below, people who are seen again, memory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from worlds import waypoints

from log2sim.datatypes import Agent, Scenario
from log2sim.geometry import NS_PER_S, rotation_from_rpy
from log2sim.resim.caster import Meetings, first_hits, grid_of, meetings
from log2sim.resim.rays import Shots, rays_in_map
from log2sim.resim.sightings import Sighting, choose_sighting, sighting, thinned, with_sightings
from log2sim.resim.surfels import SurfelGrid, Surfels, Tiles, joined, smallest_axis
from log2sim.resim.world import body_of, ground_below

CAR = Agent("car", "car", (4.4, 1.8, 1.5), waypoints([0.0]), static=True)


def shots_toward(direction: np.ndarray) -> Shots:
    unit = (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)
    nothing = np.full(len(unit), np.nan, np.float32)
    return Shots(unit, np.zeros(len(unit), np.int64), nothing, nothing)


def disc_surfels(center: np.ndarray, normal: np.ndarray, radius: float) -> Surfels:
    one = np.ones(len(center), np.float32)
    return Surfels(center.astype(np.float32), normal.astype(np.float32), radius * one, one, one, one)


def cast(shots: Shots, surfels: Surfels, seed: int = 0) -> np.ndarray:
    rays = rays_in_map(shots, np.eye(4)[None], np.zeros(len(shots.t_ns), np.intp))
    met = meetings(rays, grid_of(rays), surfels)
    return first_hits(met, surfels.material, len(shots.t_ns), np.random.default_rng(seed)).range_m


def test_a_plane_of_discs_is_met_where_the_plane_is() -> None:
    grid = np.stack(np.meshgrid(np.arange(-20, 20, 0.25), np.arange(-20, 20, 0.25)), -1).reshape(-1, 2)
    normal = np.array([0.1, -0.2, 1.0]) / np.linalg.norm([0.1, -0.2, 1.0])
    height = -1.8 - (grid @ normal[:2]) / normal[2]
    plane = disc_surfels(np.column_stack([grid, height]), np.tile(normal, (len(grid), 1)), 0.25)
    rng = np.random.default_rng(1)
    # All around, the seam at the back included.
    azimuth, elevation = rng.uniform(-np.pi, np.pi, 3000), rng.uniform(-0.9, -0.35, 3000)
    ray = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], 1)
    expected = -1.8 * normal[2] / (ray @ normal)
    near = (expected > 0) & (expected < 15)
    np.testing.assert_allclose(cast(shots_toward(ray[near]), plane)[:], expected[near], rtol=1e-4)


def test_rays_that_start_apart_meet_a_plane_as_those_that_start_where_others_do() -> None:
    """Of an ego that turns: LiDARs that spin, and one that looks everywhere all the time."""
    grid = np.stack(np.meshgrid(np.arange(-13, 16, 0.25), np.arange(-13, 13, 0.25)), -1).reshape(-1, 2)
    plane = disc_surfels(np.column_stack([grid, -1.8 + 0 * grid[:, 0]]), np.tile([0.0, 0, 1], (len(grid), 1)), 0.25)
    wall = np.stack(np.meshgrid(np.arange(-10, 10, 0.1), np.arange(-1.8, 2, 0.1)), -1).reshape(-1, 2)
    wall = np.column_stack([0 * wall[:, 0] + 8, wall])  # across the way, so that every start counts
    plane = joined([plane, disc_surfels(wall, np.tile([-1.0, 0, 0], (len(wall), 1)), 0.1)])
    truck = np.stack(np.meshgrid(np.arange(-10, 13, 0.06), np.arange(-1.8, 2, 0.06)), -1).reshape(-1, 2)
    truck = np.column_stack(
        [truck[:, 0], 0 * truck[:, 0] - 2.4, truck[:, 1]]
    )  # so near that the ego passes it within a sweep
    both = joined([plane, disc_surfels(truck, np.tile([0.0, 1, 0], (len(truck), 1)), 0.05)])
    rng = np.random.default_rng(2)
    azimuth, elevation = rng.uniform(-np.pi, np.pi, 3000), rng.uniform(-0.6, 0.1, 3000)
    ray = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], 1)
    spinning = (azimuth + np.pi) / (2 * np.pi) * 0.1
    for speed_mps, t_s, surfaces, beside_m, tolerance_m in (
        (15, spinning, both, -2.4, 0.01),
        (30, spinning, both, -2.4, 1e-4),
        (30, rng.uniform(0, 0.1, 3000), plane, -np.inf, 1e-4),
    ):
        moment = (t_s / 0.0002).astype(int)
        poses = np.tile(np.eye(4), (501, 1, 1))
        yaw, x = 0.3 * np.arange(501) * 0.0002, speed_mps * np.arange(501) * 0.0002
        poses[:, :3, :3], poses[:, 0, 3] = rotation_from_rpy(0.0, 0.0, yaw), x
        shots = replace(shots_toward(ray), t_ns=(t_s * NS_PER_S).astype(np.int64))
        rays = rays_in_map(shots, poses, moment)
        shifted = replace(surfaces, center_m=surfaces.center_m - rays.shift_m.astype(np.float32))
        found = first_hits(meetings(rays, grid_of(rays), shifted), surfaces.material, len(ray), rng).range_m
        world = np.einsum("nij,nj->ni", poses[moment, :3, :3], ray)
        with np.errstate(divide="ignore"):
            ways = -1.8 / world[:, 2], (8 - x[moment]) / world[:, 0], beside_m / world[:, 1]
        expected = np.min([np.where(way > 0, way, np.inf) for way in ways], axis=0)
        there = expected < 12
        there &= np.abs(azimuth) < np.deg2rad(178)  # what the first and the last rays see has two places
        assert there.sum() > 1000
        off = np.abs(found[there] - expected[there])
        assert np.isfinite(off).mean() > 0.98
        assert np.quantile(off, 0.97) < tolerance_m


def test_rays_meet_the_discs_that_they_meet_one_by_one() -> None:
    """Discs from 2 cm to 1.5 m, from one ray to hundreds wide, some without a plane, in double precision and one by one."""
    rng = np.random.default_rng(3)
    center, normal = rng.normal(size=(2, 300, 3))
    center *= rng.uniform(2.5, 30, (300, 1)) / np.linalg.norm(center, axis=1, keepdims=True)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal[:50] = 0
    discs = disc_surfels(center, normal, 1.0)
    discs = replace(discs, radius_m=np.exp(rng.uniform(np.log(0.02), np.log(1.5), 300)).astype(np.float32))
    azimuth, elevation = np.meshgrid(np.arange(-180, 180, 0.3), np.arange(-60, 60, 2.0))
    a, e = np.deg2rad(azimuth.ravel()), np.deg2rad(elevation.ravel())
    shots = shots_toward(np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], 1))
    rays = rays_in_map(shots, np.eye(4)[None], np.zeros(len(shots.t_ns), np.intp))
    met = Meetings.join(meetings(rays, grid_of(rays), discs))
    axis = np.where(normal.any(axis=1)[:, None], normal, center / np.linalg.norm(center, axis=1, keepdims=True))
    slope = shots.direction.astype(np.float64) @ axis.T
    range_m = (axis * center).sum(axis=1) / slope
    off = np.linalg.norm(range_m[..., None] * shots.direction[:, None].astype(np.float64) - center, axis=2)
    inside = off / discs.radius_m
    expected = (inside < 0.99) & (range_m > 0.5) & (np.abs(slope) > 0.021)
    found = np.zeros_like(expected)
    found[met.ray, met.surfel] = True
    assert len(met) == found.sum()  # each pair once
    assert expected[:, discs.radius_m > 1].sum(axis=0).max() > 300
    assert found[expected].mean() > 0.999
    assert inside[met.ray, met.surfel].max() < 1.01
    np.testing.assert_allclose(met.range_m, range_m[met.ray, met.surfel], rtol=1e-4)


def test_the_nearer_of_two_discs_stops_a_ray_and_one_of_a_fence_its_share() -> None:
    wall, near = np.array([[10.0, 0, 0]]), np.array([[4.0, 0, 0]])
    axis = np.tile([-1.0, 0, 0], (2, 1))
    both = disc_surfels(np.vstack([wall, near]), axis, 0.5)
    rays = shots_toward(np.column_stack([np.ones(4000), np.linspace(-0.01, 0.01, 4000), np.zeros(4000)]))
    assert np.allclose(cast(rays, both), 4, atol=1e-2)
    fence = replace(both, share=np.array([1, 0.3], np.float32))
    ended = cast(rays, fence)
    assert np.isclose((ended < 5).mean(), 0.3, atol=0.03)
    assert np.allclose(ended[ended > 5], 10, atol=1e-2)


def test_smallest_axes_are_those_of_an_eigenvalue_solver() -> None:
    a = np.random.default_rng(0).normal(size=(200, 3, 3))
    a = a @ a.transpose(0, 2, 1)
    values, axis = smallest_axis(*(a[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))))
    expected, vectors = np.linalg.eigh(a)
    np.testing.assert_allclose(values.T, expected, atol=1e-9)
    np.testing.assert_allclose(np.abs(np.einsum("in,ni->n", axis, vectors[:, :, 0])), 1, atol=1e-6)


def test_a_body_fills_its_box() -> None:
    for category, size in (
        ("car", (4.5, 1.8, 1.5)),
        ("truck", (8, 2.4, 3)),
        ("bus", (12, 2.5, 3)),
        ("pedestrian", (0.6, 0.6, 1.7)),
        ("cyclist", (1.8, 0.6, 1.7)),
    ):
        agent = replace(CAR, category=category, size_m=size)
        np.testing.assert_allclose(np.ptp(body_of(agent).center_m, axis=0), size, atol=0.25)


def test_the_ground_goes_on_below_what_stands() -> None:
    grid = np.stack(np.meshgrid(np.arange(-6, 6, 0.1), np.arange(-6, 6, 0.1)), -1).reshape(-1, 2)
    grid = grid[(np.abs(grid) > [2.2, 0.9]).any(axis=1)]
    slope = np.column_stack([grid, 0.05 * grid[:, 0] - 0.03 * grid[:, 1]])
    normal = np.array([-0.05, 0.03, 1]) / np.linalg.norm([-0.05, 0.03, 1])
    car = replace(CAR, waypoints=waypoints([0.0], 100.0, 50.0, 7.75))
    below = ground_below(
        car, Tiles(disc_surfels(slope, np.tile(normal, (len(slope), 1)), 0.1)), np.array([100.0, 50, 7])
    )
    assert np.ptp(below.center_m[:, :2], axis=0) == pytest.approx([4.2, 1.6], abs=0.3)
    np.testing.assert_allclose(below.center_m @ normal, 0, atol=1e-5)
    np.testing.assert_allclose(below.normal @ normal, 1, atol=1e-5)


@pytest.mark.parametrize("below", [1, 3])
def test_legs_stay_apart_and_what_was_hidden_is_a_body(below: int) -> None:
    """Two legs of 0.1 m, 0.3 m apart, 10 m ahead: their picture is sampled again by rays between those that saw them.

    Below the horizon lines may be three times as far apart.
    """
    half = np.array([0.3, 0.3, 0.9])
    step = np.deg2rad(0.2)
    lines = np.append(np.arange(-33, 0, below), np.arange(31))

    def fan(shift: float) -> np.ndarray:
        a, e = np.meshgrid((np.arange(-20, 21) + shift) * step, (lines + shift * np.gradient(lines)) * step)
        return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1).reshape(-1, 3)

    def on_legs(at: np.ndarray) -> np.ndarray:
        """Whether points on the plane of the legs are on them."""
        return (np.abs(np.abs(at[:, 1]) - 0.15) < 0.05) & (np.abs(at[:, 2]) < 0.9)

    ray = fan(0.0)
    at = ray * (10 / ray[:, :1])
    ends = on_legs(at)
    away = np.where(ends, 10 / ray[:, 0], 30).astype(np.float32)
    away[at[:, 2] < -0.5] = 5.0  # a wall before the feet
    ends &= at[:, 2] >= -0.5
    lost = ends & (np.abs(at[:, 2] - 0.3) < 0.06)  # a dark stripe of three rays
    away[lost], ends[lost] = np.nan, False
    seen = sighting(
        0.0, np.array([-10.0, 0, 0]), ray, range_m=away, on=ends, intensity=np.ones(len(ray), np.float32), half_m=half,
        step_rad=step, line_rad=np.append(lines, 31) * step,
    )  # fmt: skip
    assert seen is not None
    person = Agent("person", "pedestrian", tuple(2 * half), waypoints([0.0], 10.0), static=True)
    now = Scenario("legs", 0, 1.0, (person,))
    shots = shots_toward(fan(0.37))
    rays = rays_in_map(shots, np.eye(4)[None], np.zeros(len(shots.t_ns), np.intp))
    body = disc_surfels(np.array([[10.0, 0, -0.7], [10, 0, 0.5]]), np.tile([-1.0, 0, 0], (2, 1)), 0.15)
    met, material = with_sightings(
        meetings(rays, grid_of(rays), body),
        body.material,
        first=np.array([0, 0, 2]),
        ids=[person.id],
        rays=rays,
        scenario=now,
        sightings={person.id: [seen]},
    )
    hits = first_hits(met, material, len(shots.t_ns), np.random.default_rng(0))
    ended = hits.range_m
    at = shots.direction * (10 / shots.direction[:, :1])
    high = (at[:, 2] > -0.48) & (np.abs(at[:, 2] - 0.3) > 0.1)
    legs = on_legs(at)
    stripe = (np.abs(np.abs(at[:, 1]) - 0.15) < 0.02) & (np.abs(at[:, 2] - 0.3) < 0.07)
    assert (hits.returned[stripe] == 0).sum() >= 3
    assert not (hits.returned[stripe] > 0).any()
    assert (hits.returned[np.isfinite(ended) & high] == 1).all()
    assert (np.isfinite(ended) & high).sum() == pytest.approx((legs & high).sum(), rel=0.1)
    # Not further from a leg than half the gap between rays, 3.5 cm, and not on the disc between the legs.
    wide = np.abs(np.abs(at[:, 1]) - 0.15)
    assert np.all(wide[np.isfinite(ended) & high] < 0.09)
    np.testing.assert_allclose(ended[np.isfinite(ended)], np.linalg.norm(at, axis=1)[np.isfinite(ended)], atol=0.02)
    assert np.isfinite(ended[(np.abs(at[:, 1]) < 0.05) & (np.abs(at[:, 2] + 0.7) < 0.1)]).all()


def test_sightings_that_stay_are_those_that_differ() -> None:
    """A person is seen from one place for long and from all around in a moment; the other one once."""
    side = np.append(np.zeros(192), np.linspace(0, 2 * np.pi, 18, endpoint=False))
    many = [
        Sighting(
            0.1 * k, np.array([10 * np.cos(a), 10 * np.sin(a), 0]), np.zeros((20, 3), np.float32),
            np.ones(20, np.int8), np.ones(20, np.float32), 0.003, np.zeros(10),
        )
        for k, a in enumerate(side)
    ]  # fmt: skip
    of = {"often": list(many), "once": many[:1]}
    size = sum(s.size for some in of.values() for s in some)
    assert thinned(of, size) == 0
    assert thinned(of, size // 2) == len(many) - len(of["often"]) > 0
    assert sum(s.size for some in of.values() for s in some) <= size / 4
    assert of["once"] == many[:1]
    # Each side is still seen, and so is the whole time.
    for a in side:
        assert choose_sighting(of["often"], 0.0, 10 * np.array([np.cos(a), np.sin(a), 0])) is not None
    assert np.diff([s.t_s for s in of["often"]]).max() < 3.0


def test_a_surface_that_is_seen_for_long_takes_no_more_memory() -> None:
    grid, rng, held = SurfelGrid(), np.random.default_rng(0), []
    for _ in range(200):
        points = rng.uniform(-1, 1, (1000, 3)) * [2, 1, 0]
        grid.add(
            points, np.tile(np.float32([0, 0, 1]), (1000, 1)), np.full(1000, 0.1, np.float32), np.ones(1000, np.float32)
        )
        held.append(len(grid._key) + sum(len(key) for key, _ in grid._pending))
    assert max(held) < 30_000  # of 200 times 600
    assert grid.surfels().center_m[:, 2] == pytest.approx(0)
