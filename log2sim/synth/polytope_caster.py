"""A fast LiDAR for objects made of convex polytopes over a smooth terrain.

Every object is tested only against the rays of its angular window, nearest first, and what is wholly hidden not at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.files.arrays import Columns
from log2sim.geometry import Array, rotation_from_rpy, wrap_angle
from log2sim.synth.polytopes import Material, Polytope
from log2sim.synth.returns import REFLECTANCE, LidarModel, ReturnModel, backscattered, detected, disturbed, reflected
from log2sim.synth.terrain import Surface, meet

MIN_RANGE_M = 0.4
WINDOW_MARGIN_RAD = 0.012
LEAF_MEAN_PATH_M = 0.5
MESH_OPENNESS = 0.65  # share of rays that a wire mesh or a net lets through
LEAF_INCIDENCE = 0.7  # leaves face any way
MIN_DRIFT_MPS = 0.1  # slower motion moves nothing by the noise of a distance within a sweep


@dataclass(frozen=True, eq=False)
class Solid:
    """An object for the caster."""

    parts: tuple[Polytope, ...]
    position_m: Array  # (3,), m: middle of its floor at time 0
    yaw_rad: float
    velocity_mps: Array  # (2,), m/s
    glass_passes: float = 0.6  # share of rays that its windows let through


@dataclass(frozen=True, eq=False)
class SensorState:
    """Where a LiDAR is during a sweep."""

    rotation: Array  # (3, 3): from the sensor to the level frame
    position_m: Array  # (3,), m: at time 0, the middle of the sweep
    velocity_mps: Array  # (2,), m/s


@dataclass(eq=False)
class Rays:
    """The rays of a sweep, L lines by A firings, and what each meets first."""

    azimuth: Array  # (A,), in the sensor's frame, rad
    elevation: Array  # (L,), likewise
    direction: NDArray[np.float32]  # (L, A, 3): level frame
    column_s: NDArray[np.float32]  # (A,): times of the firings relative to the middle of the sweep
    range_m: NDArray[np.float32]  # (L, A): infinite without a hit
    hit: NDArray[np.int32]  # (L, A)
    material: NDArray[np.int8]  # (L, A)
    incidence: NDArray[np.float32]  # (L, A): cosine between ray and normal


@dataclass(frozen=True, eq=False)
class Windows:
    """Angles in the sensor's frame that may see each of S objects; azimuths around a middle one, less than half a turn each way."""

    near_m: Array
    azimuth: Array
    half: Array
    elevation: Array
    low: Array  # (S, 3): corners of the bounding box of each, in its frame
    high: Array


def windows_of(solids: Sequence[Solid], sensor: SensorState) -> Windows:
    """Find the window of every object from points on its bounding box."""
    low = np.array([np.min([p.low for p in solid.parts], axis=0) for solid in solids]).reshape(-1, 3)
    high = np.array([np.max([p.high for p in solid.parts], axis=0) for solid in solids]).reshape(-1, 3)
    position = np.array([solid.position_m for solid in solids]).reshape(-1, 3)
    rotation = rotation_from_rpy(0.0, 0.0, np.array([solid.yaw_rad for solid in solids]))
    local = np.einsum("sji,sj->si", rotation, sensor.position_m - position)
    near = np.linalg.norm(np.maximum(np.maximum(low - local, local - high), 0), axis=1)
    # So dense that the greatest elevation is not missed between them.
    steps = np.linspace(0, 1, 5)
    u, v, w = np.meshgrid(steps, steps, [0.0, 1.0], indexing="ij")
    grid = low[:, None] + np.column_stack([u.ravel(), v.ravel(), w.ravel()]) * (high - low)[:, None]
    points = (grid @ rotation.transpose(0, 2, 1) + (position - sensor.position_m)[:, None]) @ sensor.rotation
    azimuth, flat = np.arctan2(points[..., 1], points[..., 0]), np.hypot(points[..., 0], points[..., 1])
    elevation = np.arctan2(points[..., 2], flat)
    margin = WINDOW_MARGIN_RAD + 0.3 / np.maximum(near, 0.3) * np.linalg.norm((high - low)[:, :2], axis=1) / 16
    middle = np.arctan2(np.sin(azimuth).mean(axis=1), np.cos(azimuth).mean(axis=1))
    off = wrap_angle(azimuth - middle[:, None])
    half = np.column_stack([off.min(axis=1) - margin, off.max(axis=1) + margin])
    half[(near < 1.0) | (np.ptp(off, axis=1) > 5.5)] = -np.pi, np.pi
    rise = np.column_stack([elevation.min(axis=1) - margin, elevation.max(axis=1) + margin])
    return Windows(near, middle, half, rise, low, high)


def cast_solid(
    rays: Rays, solid: Solid, index: int, windows: Windows, sensor: SensorState, rng: np.random.Generator
) -> None:
    """Let one object stop the rays of its window that reach it; below, n rays meet P parts with K faces in all."""
    low, high = windows.elevation[index]
    rows = np.flatnonzero((rays.elevation >= low) & (rays.elevation <= high))
    # The window may lie across the sweep's seam.
    off = (rays.azimuth - windows.azimuth[index] + np.pi) % (2 * np.pi) - np.pi
    cols = np.flatnonzero((off >= windows.half[index, 0]) & (off <= windows.half[index, 1]))
    if not len(rows) or not len(cols):
        return
    # Rays that meet something nearer than the object's nearest point need no test.
    line, firing = np.nonzero(rays.range_m[np.ix_(rows, cols)] > windows.near_m[index])
    if not len(line):
        return
    line, firing = rows[line], cols[firing]
    c, s = np.cos(solid.yaw_rad), np.sin(solid.yaw_rad)
    to_object = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    direction = to_object.astype(np.float32) @ rays.direction[line, firing].T
    direction[direction == 0] = np.float32(1e-12)
    origin = (to_object @ (sensor.position_m - solid.position_m)).astype(np.float32)
    moved = to_object @ np.append(sensor.velocity_mps - solid.velocity_mps, 0.0)
    drift = moved.astype(np.float32) if np.abs(moved).max() > MIN_DRIFT_MPS else None
    start = origin[:, None] if drift is None else origin[:, None] + drift[:, None] * rays.column_s[firing]
    # Most rays of the window pass the bounding box; the parts need not be tested for them.
    with np.errstate(over="ignore"):
        ends = [(edge[index].astype(np.float32)[:, None] - start) / direction for edge in (windows.low, windows.high)]
    first, last = np.minimum(*ends).max(axis=0), np.maximum(*ends).min(axis=0)
    met = np.flatnonzero((first <= last) & (last > 0) & (first < rays.range_m[line, firing]))
    if not len(met):
        return
    line, firing, direction, parts = line[met], firing[met], direction[:, met], solid.parts
    normals, offsets = np.concatenate([p.normals for p in parts]), np.concatenate([p.offsets for p in parts])
    count = np.array([len(p.offsets) for p in parts])
    faces = [slice(end - n, end) for n, end in zip(count.tolist(), np.cumsum(count).tolist())]
    slope = normals @ direction  # (K, n)
    gap = (offsets - normals @ origin)[:, None]
    if drift is not None:
        gap = gap - (normals @ drift)[:, None] * rays.column_s[firing]
    slope[slope == 0] = np.float32(1e-12)
    crossing, entering = gap / slope, slope < 0
    latest = np.where(entering, crossing, np.float32(-np.inf))
    earliest = np.where(entering, np.float32(np.inf), crossing)
    enter, leave = np.empty((2, len(parts), len(line)), np.float32)  # infinite where a ray misses the part
    for k, own in enumerate(faces):
        latest[own].max(axis=0, out=enter[k])
        earliest[own].min(axis=0, out=leave[k])
    enter = np.where((enter < leave) & (enter > MIN_RANGE_M), enter, np.float32(np.inf))
    for k in np.flatnonzero(np.isfinite(enter).any(axis=1)).tolist():
        if parts[k].material in (Material.LEAVES, Material.GLASS, Material.MESH):
            # What is not solid lets rays through: leaves by a mean free path, windows and nets by a share.
            some = np.flatnonzero(np.isfinite(enter[k]))
            if parts[k].material == Material.LEAVES:
                depth = rng.exponential(LEAF_MEAN_PATH_M, len(some)).astype(np.float32)
                inside = depth < leave[k, some] - enter[k, some]
                enter[k, some] = np.where(inside, enter[k, some] + depth, np.float32(np.inf))
            else:
                share = solid.glass_passes if parts[k].material == Material.GLASS else MESH_OPENNESS
                enter[k, some[rng.random(len(some)) < share]] = np.inf
    part = enter.argmin(axis=0)
    t = enter[part, np.arange(len(part))]
    ray = np.flatnonzero(t < rays.range_m[line, firing])
    if not len(ray):
        return
    line, firing, part = line[ray], firing[ray], part[ray]
    rays.range_m[line, firing] = t[ray]
    rays.hit[line, firing] = index
    rays.material[line, firing] = np.array([p.material for p in parts], np.int8)[part]
    incidence = np.full(len(ray), np.float32(LEAF_INCIDENCE))
    for k in np.unique(part).tolist():
        if parts[k].material != Material.LEAVES:
            own = part == k
            # A ray enters by the face that it crosses last.
            face = latest[faces[k]][:, ray[own]].argmax(axis=0)
            incidence[own] = -slope[faces[k].start + face, ray[own]]
    rays.incidence[line, firing] = incidence


GROUND, NOTHING = -1, -2
MAX_GROUND_ERROR_M = 0.03  # departure of the ground's surface from the ray that Newton's method must reach


@dataclass(frozen=True, eq=False)
class Returns(Columns):
    """Points of a sweep, motion compensated."""

    xyz_m: NDArray[np.float32]  # (N, 3), m: level frame
    intensity: NDArray[np.float32]  # (N,): in [0, 1]
    t_s: NDArray[np.float32]  # (N,): relative to the middle of the sweep
    hit: NDArray[np.int32]  # (N,): index of the object, or GROUND
    line: NDArray[np.int32]  # (N,): line of the sensor


def _cast_ground(model: LidarModel, sensor: SensorState, surface: Surface) -> Rays:
    """Make the rays and intersect them with the ground."""
    azimuth, elevation = model.azimuths_rad(), model.elevations_rad()
    flat = np.cos(elevation)[:, None]
    up = np.broadcast_to(np.sin(elevation)[:, None], (len(elevation), len(azimuth)))
    directions = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up], -1)
    direction = (directions @ sensor.rotation.T).astype(np.float32)
    # The sweep turns clockwise: its share of the full turn is the share of its period.
    span = (model.azimuth_deg[1] - model.azimuth_deg[0]) / 360.0 / model.rate_hz
    column_s = ((np.arange(len(azimuth)) + 0.5) / len(azimuth) - 0.5) * span
    shape = direction.shape[:2]
    range_m, hit = np.full(shape, np.inf, np.float32), np.full(shape, NOTHING, np.int32)
    material, incidence = np.zeros(shape, np.int8), np.ones(shape, np.float32)
    out = Rays(azimuth, elevation, direction, column_s.astype(np.float32), range_m, hit, material, incidence)
    # A street rises by a fifth at most.
    line, col = np.nonzero(direction[..., 2] < 0.15)
    d = direction[line, col]
    drift = out.column_s[col, None] * np.append(sensor.velocity_mps, 0)
    start = (sensor.position_m + drift).astype(np.float32)
    height = start[:, 2] - surface.height(start[:, 0], start[:, 1])
    limit = np.float32(model.range_m)
    t = np.minimum(height / np.maximum(-d[:, 2], np.float32(0.02)), limit)
    t, error, rise = meet(surface, tuple(start.T), tuple(d.T), t, flattest=0.004, span=(0.0, 2.0 * model.range_m))
    facing = -rise
    ok = (np.abs(error) < MAX_GROUND_ERROR_M) & (t > MIN_RANGE_M) & (t < limit) & (facing > 0.005)
    x, y = start[:, 0] + t * d[:, 0], start[:, 1] + t * d[:, 1]
    t = t - surface.relief(x, y) / np.maximum(facing, np.float32(0.02))
    line, col = line[ok], col[ok]
    out.range_m[line, col], out.hit[line, col], out.incidence[line, col] = t[ok], GROUND, facing[ok]
    return out


def cast_polytopes(
    model: LidarModel,
    sensor: SensorState,
    solids: Sequence[Solid],
    surface: Surface,
    rng: np.random.Generator,
    returns: ReturnModel | None = None,
) -> Returns:
    """Cast a sweep.

    `rng`: draws reflectances, losses and noise. `returns`: by default the noise of the model and no more.
    """
    rays = _cast_ground(model, sensor, surface)
    windows = windows_of(solids, sensor)
    for index in np.argsort(windows.near_m, kind="stable").tolist():
        cast_solid(rays, solids[index], index, windows, sensor, rng)
    # What comes back of each ray.
    returns = returns or ReturnModel(model.noise_m, 0.0, 0.0)
    weather = returns.weather
    hit_range = np.where(rays.range_m < model.range_m, rays.range_m, np.float32(np.inf))
    early = backscattered(hit_range.ravel(), weather, rng).reshape(hit_range.shape)
    from_air = early < hit_range
    line, firing = np.nonzero(np.isfinite(hit_range) | from_air)
    t = np.where(from_air, early, hit_range)[line, firing].astype(np.float32)
    air = from_air[line, firing]
    hit = np.where(air, GROUND, rays.hit[line, firing]).astype(np.int32)
    material = rays.material[line, firing]
    low, high = np.array([REFLECTANCE[m] for m in Material], np.float32).T
    # One draw for each object and material, and a little for each ray.
    draw = rng.random((len(solids) + 2, len(Material)), dtype=np.float32)[hit + 2, material]
    speckle = np.exp(0.25 * rng.standard_normal(len(t), dtype=np.float32))
    reflectance = (low[material] + (high - low)[material] * draw) * speckle
    signal = reflected(t, reflectance, rays.incidence[line, firing], weather)
    kept = detected(signal, returns, rng) | air
    line, firing, t, hit, reflectance = line[kept], firing[kept], t[kept], hit[kept], reflectance[kept]
    intensity = np.clip(reflectance * rays.incidence[line, firing], 0.003, 1).astype(np.float32)
    ahead = np.minimum(hit_range, np.float32(model.range_m))
    gap = np.maximum(np.roll(ahead, 1, axis=1), np.roll(ahead, -1, axis=1)) - ahead
    t = disturbed(t, intensity, line, np.maximum(gap, 0)[line, firing], model, returns, rng)
    t_s = rays.column_s[firing]
    start = sensor.position_m.astype(np.float32) + t_s[:, None] * np.append(sensor.velocity_mps, 0).astype(np.float32)
    xyz = start + t[:, None] * rays.direction[line, firing]
    return Returns(xyz, intensity, t_s, hit, line.astype(np.int32))
