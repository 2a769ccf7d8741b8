"""LiDAR sweeps: rays from a moving sensor against moving road users, buildings and the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Sweep
from log2sim.geometry import NS_PER_S, Array, inverse, rotation_from_rpy, transform
from log2sim.synth.actors import Actor, MovingScene
from log2sim.synth.light import weather_of
from log2sim.synth.returns import ReturnModel, Weather, backscattered, detected, reflected
from log2sim.synth.scene import LidarSpec, Scene
from log2sim.synth.scene_places import Building
from log2sim.synth.shapes import cross_products

GROUND, BUILDING, EGO, AIR = -1, -2, -3, -4
MAX_PAIRS_PER_BATCH = 400_000
MIN_TRIANGLES_PER_GROUP, MAX_GROUPS = 16, 32  # measured on the meshes of road users
SPHERE_MARGIN_M = 1e-5
MESH_MARGIN_M = 1e-6  # rounding of a mesh that fills its box
MIN_RANGE_M = 0.5
USUAL_REFLECTANCE = np.float32(0.3)  # of what a mesh stands for, where weather decides what comes back
MIN_GRAZING_SINE = 0.02  # of the angle to the ground below which no return comes back


@dataclass(frozen=True, eq=False)
class LabeledSweep:
    """A sweep and what each of its points lies on.

    Attributes
    ----------
    sweep : Sweep
    hit : (N,) int64
        Index of the actor, GROUND, BUILDING, EGO or AIR.
    """

    sweep: Sweep
    hit: NDArray[np.int64]


def mount_T_lidar(spec: LidarSpec) -> Array:
    """Pose of the LiDAR on its mount."""
    roll, pitch, yaw = np.deg2rad([spec.roll_deg, -spec.pitch_deg, spec.yaw_deg])
    return transform(rotation_from_rpy(roll, pitch, yaw), np.array(spec.position_m))


def sweep_stamps(spec: LidarSpec, scene: Scene) -> NDArray[np.int64]:
    """Stamps (F,) of the ends of the sweeps, absolute ns; every sweep lies wholly within the log."""
    period = 1.0 / spec.rate_hz
    first = int(np.ceil((period * _share(spec) - spec.offset_s) * spec.rate_hz - 1e-9))
    last = int(np.floor((scene.duration_s - spec.offset_s) * spec.rate_hz + 1e-9))
    t = np.arange(first, last + 1) * period + spec.offset_s
    stamps: NDArray[np.int64] = scene.start_ns + np.rint(t * NS_PER_S).astype(np.int64)
    return stamps


def _share(spec: LidarSpec) -> float:
    return min(1.0, (spec.azimuth_deg[1] - spec.azimuth_deg[0]) / 360.0)


def ray_pattern(spec: LidarSpec) -> tuple[Array, Array]:
    """Directions (N, 3) in the lidar frame and times (N,) in s before the end of the sweep, column after column."""
    low, high = spec.azimuth_deg
    columns = max(1, round((high - low) / spec.azimuth_step_deg))
    azimuth = np.deg2rad(high - (np.arange(columns) + 0.5) * (high - low) / columns)
    even = np.linspace(spec.elevation_deg[0], spec.elevation_deg[1], spec.channels)
    elevation = np.deg2rad(np.array(spec.channels_deg) if spec.channels_deg else even)
    ago = _share(spec) / spec.rate_hz * (1 - (np.arange(columns) + 1) / columns)
    a, e = np.repeat(azimuth, len(elevation)), np.tile(elevation, columns)
    directions = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], 1)
    return directions, np.repeat(ago, len(elevation))


def cast_sweep(spec: LidarSpec, moving: MovingScene, stamp_ns: int, rng: np.random.Generator) -> LabeledSweep:
    """Cast the rays of one sweep; its stamp is its end, and every point is in the lidar frame at its own time."""
    scene = moving.scene
    directions, ago_s = ray_pattern(spec)
    t_ns = stamp_ns - np.rint(ago_s * NS_PER_S).astype(np.int64)
    moments, column = np.unique(t_ns, return_inverse=True)
    map_T_lidar = moving.map_T_mount(spec.mount, moments) @ mount_T_lidar(spec)
    origin = map_T_lidar[column, :3, 3]
    ray = np.einsum("nij,nj->ni", map_T_lidar[column, :3, :3], directions)
    distance = np.full(len(ray), np.inf)
    hit = np.full(len(ray), GROUND)
    down = -ray[:, 2] > MIN_GRAZING_SINE
    distance[down] = origin[down, 2] / -ray[down, 2]
    for building in scene.building:
        nearer = _box_distance(building, origin, ray)
        closer = nearer < distance
        distance[closer], hit[closer] = nearer[closer], BUILDING
    t_s = (moments - scene.start_ns) / NS_PER_S
    for index, actor in enumerate(moving.seen_from(spec.mount)):
        rows, nearer = _actor_distance(actor, t_s, column, origin, ray)
        closer = nearer < distance[rows]
        distance[rows[closer]], hit[rows[closer]] = nearer[closer], index if index < len(moving.actors) else EGO
    # Drawn for every ray, so that a change of the scene moves no other ray's noise.
    noise, lost = rng.normal(0.0, 1.0, len(ray)) * spec.noise_m, rng.random(len(ray)) < spec.dropout
    distance[distance > spec.range_m] = np.inf
    _through_air(distance, hit, weather_of(scene.environment), rng)
    keep = np.isfinite(distance) & (distance > MIN_RANGE_M) & ~lost
    xyz = directions[keep] * (distance + noise)[keep, None]
    if spec.resolution_m > 0:
        xyz = np.rint(xyz / spec.resolution_m) * spec.resolution_m
    # Column after column in memory, which packs a quarter smaller.
    return LabeledSweep(Sweep(stamp_ns, np.asfortranarray(xyz, dtype=np.float32), "lidar", t_ns[keep]), hit[keep])


def _through_air(distance: Array, hit: NDArray[np.int64], weather: Weather, rng: np.random.Generator) -> None:
    """Lose returns (N,) to rain and fog and let others come back from the air, in place; nothing in clear weather."""
    if weather.kind == "clear":
        return
    air = backscattered(distance.astype(np.float32), weather, rng)
    solid = np.isfinite(distance)
    usual = np.ones(int(solid.sum()), np.float32)
    signal = reflected(distance[solid].astype(np.float32), usual * USUAL_REFLECTANCE, usual, weather)
    distance[np.flatnonzero(solid)[~detected(signal, ReturnModel(dropout=0.0), rng)]] = np.inf
    early = np.isfinite(air)
    distance[early], hit[early] = air[early], AIR


def _box_distance(building: Building, origin: Array, ray: Array) -> Array:
    """Distance (N,) at which rays enter a building, inf where they miss it (slab method)."""
    c, s = np.cos(np.deg2rad(building.yaw_deg)), np.sin(np.deg2rad(building.yaw_deg))
    rotation = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
    size = np.array(building.size_m)
    return slab_distance(size, (origin - [*building.center, size[2] / 2]) @ rotation.T, ray @ rotation.T)


def slab_distance(size_m: Array, origin: Array, ray: Array, *, from_inside: bool = False) -> Array:
    """Distance (N,) at which rays (N, 3) enter a box of size (3,) around the zero point, inf where they miss it.

    Rays that start inside miss it too, unless `from_inside`: then the distance is negative.

    Notes
    -----
    Slab method of Kay & Kajiya, "Ray Tracing Complex Scenes" (SIGGRAPH 1986).
    """
    parallel = ray == 0
    d = np.where(parallel, 1.0, ray)
    a, b = (-size_m / 2 - origin) / d, (size_m / 2 - origin) / d
    outside = parallel & (np.abs(origin) > size_m / 2)
    enter = np.where(parallel, -np.inf, np.minimum(a, b)).max(1)
    leave = np.where(parallel, np.inf, np.maximum(a, b)).min(1)
    ahead = leave > 0 if from_inside else enter > 0
    return np.where((enter <= leave) & ahead & ~outside.any(1), enter, np.inf)


def _actor_distance(
    actor: Actor, t_s: Array, column: NDArray[np.int64], origin: Array, ray: Array
) -> tuple[NDArray[np.int64], Array]:
    """Rays that meet the actor's box at their own time, and their distances to its shape."""
    states = actor.at(t_s)
    to = states.center_m[column] - origin
    along = np.einsum("ni,ni->n", to, ray)
    off = np.einsum("ni,ni->n", to, to) - along**2
    radius = np.linalg.norm(actor.spec.box_m) / 2
    rows = np.flatnonzero((off < radius**2) & (along > -radius))
    if len(rows) == 0:
        return rows, np.zeros(0)
    mesh = actor.mesh(float(t_s[column[rows]].mean()))
    agent_T_map = inverse(states.map_T_agent())[column[rows]]
    o = np.einsum("nij,nj->ni", agent_T_map[:, :3, :3], origin[rows]) + agent_T_map[:, :3, 3]
    d = np.einsum("nij,nj->ni", agent_T_map[:, :3, :3], ray[rows])
    meets = np.isfinite(slab_distance(np.array(actor.spec.box_m) + 2 * MESH_MARGIN_M, o, d, from_inside=True))
    return rows[meets], first_hit(o[meets], d[meets], mesh.vertices_m[mesh.faces])


def first_hit(origin: Array, ray: Array, triangles: Array) -> Array:
    """Distance (N,) along rays (N, 3) to the nearest of triangles (F, 3 vertices, 3), inf where there is none.

    Notes
    -----
    Moeller and Trumbore, Fast, Minimum Storage Ray/Triangle Intersection (1997); both sides of a triangle count. Triangles that
    lie together share a sphere around them, and only rays that meet the sphere are tested against them, in batches of
    bounded size.
    """
    out = np.full(len(ray), np.inf)
    if len(ray) == 0 or len(triangles) == 0:
        return out
    groups = _groups_of(triangles)
    ordered = triangles[np.concatenate(groups)]
    ends = np.cumsum([len(rows) for rows in groups])
    planes, (centers, radii) = _Planes.of(ordered), _spheres_around(ordered, ends)
    moment, along_origin = cross_products(origin, ray), np.einsum("ni,ni->n", origin, ray)
    square_origin = np.einsum("ni,ni->n", origin, origin)
    for center, radius, rows, end in zip(centers, radii, groups, ends.tolist()):
        along = ray @ center - along_origin
        square = square_origin - 2 * (origin @ center) + center @ center
        near = np.flatnonzero((square - along**2 <= radius**2) & (along >= -radius))
        own = planes.part(end - len(rows), end)
        step = max(1, MAX_PAIRS_PER_BATCH // len(rows))
        for k in range(0, len(near), step):
            some = near[k : k + step]
            out[some] = np.minimum(out[some], own.nearest_hit(origin[some], ray[some], moment[some]))
    return out


def _groups_of(triangles: Array) -> list[NDArray[np.intp]]:
    """Divide triangles (F, 3, 3) at medians into groups that lie together: the indices of each."""
    middle, groups = triangles.mean(1), [np.arange(len(triangles))]
    while len(groups[0]) > MIN_TRIANGLES_PER_GROUP and len(groups) < MAX_GROUPS:
        halves = []
        for rows in groups:
            axis = int(np.ptp(middle[rows], axis=0).argmax())
            order = rows[np.argsort(middle[rows, axis], kind="stable")]
            halves += [order[: len(order) // 2], order[len(order) // 2 :]]
        groups = halves
    return groups


def _spheres_around(triangles: Array, ends: NDArray[np.int64]) -> tuple[Array, Array]:
    """Centers (G, 3) and radii (G,) of spheres around groups of triangles (F, 3, 3) that end at `ends` (G,)."""
    starts = np.concatenate([[0], ends[:-1]])
    low, high = np.minimum.reduceat(triangles.min(1), starts), np.maximum.reduceat(triangles.max(1), starts)
    # Larger by more than the rounding of the distances between rays and centers.
    return (low + high) / 2, np.linalg.norm(high - low, axis=1) / 2 + SPHERE_MARGIN_M


@dataclass(frozen=True, eq=False)
class _Planes:
    """Triangles as what products with rays need.

    Attributes
    ----------
    normal : (F, 3) float64
        Product of the edges, not of unit length.
    offset : (F,) float64
        Of the planes along their normals.
    edges : (2, F, 3) float64
        Second and first edge, for both coordinates within a triangle.
    moments : (2, F, 3) float64
        Products of these edges with the first vertex.
    """

    normal: Array
    offset: Array
    edges: Array
    moments: Array

    @classmethod
    def of(cls, triangles: Array) -> _Planes:
        """Compute the planes of triangles (F, 3, 3)."""
        a = triangles[:, 0]
        e1, e2 = triangles[:, 1] - a, triangles[:, 2] - a
        normal = cross_products(e1, e2)
        edges = np.stack([e2, e1])
        return cls(normal, np.einsum("fi,fi->f", a, normal), edges, cross_products(a[None], edges))

    def part(self, start: int, end: int) -> _Planes:
        """Take some of them."""
        rows = slice(start, end)
        return _Planes(self.normal[rows], self.offset[rows], self.edges[:, rows], self.moments[:, rows])

    def nearest_hit(self, o: Array, d: Array, moment: Array) -> Array:
        """Distance (N,) along rays to the nearest triangle, each tested against each; inf without one."""
        determinant = -(d @ self.normal.T)
        # (o - a) . (d x e) from the moments o x d of the rays and a x e of the edges.
        u = moment @ self.edges[0].T + d @ self.moments[0].T
        v = -(moment @ self.edges[1].T + d @ self.moments[1].T)
        t = o @ self.normal.T - self.offset
        solid = np.abs(determinant) > 1e-12
        scale = np.divide(1.0, determinant, out=np.zeros_like(determinant), where=solid)
        u, v, t = u * scale, v * scale, t * scale
        inside = solid & (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t > 0)
        return np.asarray(np.where(inside, t, np.inf).min(1, initial=np.inf))
