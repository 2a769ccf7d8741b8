"""LiDAR sweeps: rays from a moving sensor against moving road users, buildings and the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Sweep
from log2sim.geometry import NS_PER_S, Array, apply, cross_slab, inverse, rotation_from_rpy, transform
from log2sim.synth.actors import EGO_COLOR, MovingScene
from log2sim.synth.paint import AIR_REFLECTANCE, GroundReflectance, body_reflectance, intensity_of, spot_m
from log2sim.synth.raster import first_hit
from log2sim.synth.render import triangles_of
from log2sim.synth.returns import ReturnModel, backscattered, detected, reflected
from log2sim.synth.scene import LidarSpec, Scene

GROUND, BUILDING, EGO, AIR = -1, -2, -3, -4
MESH_MARGIN_M = 1e-6  # rounding of a mesh that fills its box
MIN_RANGE_M = 0.5
BUILDING_REFLECTANCE = 0.35  # of plaster and brick at 905 nm
USUAL_REFLECTANCE = np.float32(0.3)  # of what a mesh stands for, where weather decides what comes back
MIN_GRAZING_SINE = 0.02  # of the angle to the ground below which no return comes back


@dataclass(frozen=True, eq=False)
class LabeledSweep:
    """A sweep and what each of its points lies on."""

    sweep: Sweep
    hit: NDArray[np.int64]  # (N,): index of the actor, GROUND, BUILDING, EGO or AIR


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
    return np.asarray(scene.start_ns + np.rint(t * NS_PER_S).astype(np.int64))


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


def cast_sweep(
    spec: LidarSpec,
    moving: MovingScene,
    stamp_ns: int,
    rng: np.random.Generator,
    ground: GroundReflectance | None = None,
) -> LabeledSweep:
    """Cast the rays of one sweep; its stamp is its end, and every point is in the lidar frame at its own time.

    Returns have intensities where the reflectance of the ground is given.
    """
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
        c, s = np.cos(np.deg2rad(building.yaw_deg)), np.sin(np.deg2rad(building.yaw_deg))
        rotation = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
        size = np.array(building.size_m)
        nearer = slab_distance(size, (origin - [*building.center, size[2] / 2]) @ rotation.T, ray @ rotation.T)
        closer = nearer < distance
        distance[closer], hit[closer] = nearer[closer], BUILDING
    for triangles in triangles_of(scene):
        corners = triangles.reshape(-1, 3)
        middle = (corners.min(0) + corners.max(0)) / 2
        rows = _near(middle, float(np.linalg.norm(corners - middle, axis=1).max()), origin, ray)
        nearer = first_hit(origin[rows], ray[rows], triangles)
        closer = nearer < distance[rows]
        distance[rows[closer]], hit[rows[closer]] = nearer[closer], BUILDING
    for index, actor in enumerate(moving.seen_from(spec.mount)):  # each ray meets it at its own time
        t_s, box = (moments - scene.start_ns) / NS_PER_S, np.array(actor.spec.box_m)
        states = actor.at(t_s)
        rows = _near(states.center_m[column], float(np.linalg.norm(box)) / 2, origin, ray)
        if len(rows) == 0:
            continue
        mesh = actor.mesh(float(t_s[column[rows]].mean()))
        agent_T_map = inverse(states.map_T_agent())[column[rows]]
        o = apply(agent_T_map, origin[rows])
        d = np.einsum("nij,nj->ni", agent_T_map[:, :3, :3], ray[rows])
        meets = np.isfinite(slab_distance(box + 2 * MESH_MARGIN_M, o, d, from_inside=True))
        rows, nearer = rows[meets], first_hit(o[meets], d[meets], mesh.vertices_m[mesh.faces])
        closer = nearer < distance[rows]
        distance[rows[closer]], hit[rows[closer]] = nearer[closer], index if index < len(moving.actors) else EGO
    # Drawn for every ray, so that a change of the scene moves no other ray's noise.
    noise, lost = rng.normal(0.0, 1.0, len(ray)) * spec.noise_m, rng.random(len(ray)) < spec.dropout
    distance[distance > spec.range_m] = np.inf
    weather = scene.environment
    if weather.weather != "clear":  # some returns are lost to rain and fog, and others come back from the air
        air = backscattered(distance.astype(np.float32), weather, rng)
        solid = np.flatnonzero(np.isfinite(distance))
        usual = np.ones(len(solid), np.float32)
        signal = reflected(distance[solid].astype(np.float32), usual * USUAL_REFLECTANCE, usual, weather)
        distance[solid[~detected(signal, ReturnModel(dropout=0.0), rng)]] = np.inf
        early = np.isfinite(air)
        distance[early], hit[early] = air[early], AIR
    keep = np.isfinite(distance) & (distance > MIN_RANGE_M) & ~lost
    xyz = directions[keep] * (distance + noise)[keep, None]
    if spec.resolution_m > 0:
        xyz = np.rint(xyz / spec.resolution_m) * spec.resolution_m
    intensity = None
    if ground is not None:
        # What is no ground is taken to face the sensor. `GROUND`, `BUILDING`, `EGO` and `AIR` count from the end.
        bodies = [body_reflectance(agent.color) for agent in scene.agent]
        by_hit = [*bodies, AIR_REFLECTANCE, body_reflectance(EGO_COLOR), BUILDING_REFLECTANCE, 0.0]
        reflectance = np.array(by_hit, np.float32)[hit[keep]]
        incidence = np.ones(len(reflectance), np.float32)
        met, on = hit[keep] == GROUND, np.flatnonzero(keep)[hit[keep] == GROUND]
        xy = origin[on, :2] + ray[on, :2] * distance[on, None]
        reflectance[met], incidence[met] = ground.at(xy, spot_m(distance[on], -ray[on, 2])), -ray[on, 2]
        intensity = intensity_of(reflectance, incidence, rng)
    # Column after column in memory, which packs a quarter smaller.
    points = np.asfortranarray(xyz, dtype=np.float32)
    return LabeledSweep(Sweep(stamp_ns, points, "lidar", t_ns[keep], intensity=intensity), hit[keep])


def slab_distance(size_m: Array, origin: Array, ray: Array, *, from_inside: bool = False) -> Array:
    """Distance (N,) at which rays (N, 3) enter a box of size (3,) around the zero point, inf where they miss it.

    Rays that start inside miss it too, unless `from_inside`: then the distance is negative.
    """
    sides = [cross_slab(origin[..., k], ray[:, k], -size_m[k] / 2, size_m[k] / 2) for k in range(3)]
    enter, leave = np.fmax.reduce([near for near, _ in sides]), np.fmin.reduce([far for _, far in sides])
    ahead = leave > 0 if from_inside else enter > 0
    return np.where((enter <= leave) & ahead, enter, np.inf)


def _near(middle: Array, radius: float, origin: Array, ray: Array) -> NDArray[np.intp]:
    """Rays that pass through a sphere around a middle (3,), or one (N, 3) for each ray."""
    to = middle - origin
    along = np.einsum("ni,ni->n", to, ray)
    off = np.einsum("ni,ni->n", to, to) - along**2
    return np.flatnonzero((off < radius**2) & (along > -radius))
