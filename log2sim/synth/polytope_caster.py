"""A fast LiDAR for objects made of convex polytopes over a smooth terrain.

Every object is tested only against the rays of its angular window, nearest objects first, and what is wholly hidden is
not tested at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from log2sim.synth.lidar_models import LidarModel
from log2sim.synth.polytope_hits import MIN_RANGE_M, Rays, SensorState, Solid, cast_solid, windows_of
from log2sim.synth.polytopes import Material
from log2sim.synth.returns import REFLECTANCE, ReturnModel, backscattered, detected, disturbed, reflected

GROUND, NOTHING = -1, -2
NEWTON_STEPS = 3
# Departure of the ground's surface from the ray that Newton's method must reach.
MAX_GROUND_ERROR_M = 0.03


class Terrain(Protocol):
    """Height of the ground."""

    def height(self, x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return heights (N,) at positions, m."""
        ...

    def slope(self, x: NDArray[np.float32], y: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return derivatives (N,), (N,) of the height along x and y."""
        ...

    def relief(self, x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what is too small for `height`, such as kerbs (N,), m."""
        ...


@dataclass(frozen=True, eq=False)
class Returns:
    """Points of a sweep, motion compensated.

    Attributes
    ----------
    xyz_m : (N, 3) float32, m
        Level frame.
    intensity : (N,) float32
        In [0, 1].
    t_s : (N,) float32
        Relative to the middle of the sweep.
    hit : (N,) int32
        Index of the object, or GROUND.
    line : (N,) int32
        Line of the sensor.
    """

    xyz_m: NDArray[np.float32]
    intensity: NDArray[np.float32]
    t_s: NDArray[np.float32]
    hit: NDArray[np.int32]
    line: NDArray[np.int32]


def cast_polytopes(
    model: LidarModel,
    sensor: SensorState,
    solids: Sequence[Solid],
    terrain: Terrain,
    rng: np.random.Generator,
    returns: ReturnModel | None = None,
) -> Returns:
    """Cast a sweep.

    Parameters
    ----------
    model : LidarModel
    sensor : SensorState
    solids : sequence of Solid
    terrain : Terrain
    rng : Generator
        Draws reflectances, losses and noise.
    returns : ReturnModel, optional
        By default the noise of the model and no more.
    """
    rays = _cast_ground(model, sensor, terrain)
    windows = windows_of(solids, sensor)
    for index in np.argsort(windows.near_m, kind="stable").tolist():
        cast_solid(rays, solids[index], index, windows, sensor, rng)
    return _returned(rays, sensor, len(solids), rng, returns or ReturnModel(model.noise_m, 0.0, 0.0), model.range_m)


def _cast_ground(model: LidarModel, sensor: SensorState, terrain: Terrain) -> Rays:
    """Make the rays and intersect them with the terrain by Newton's method."""
    azimuth, elevation = model.azimuths_rad(), model.elevations_rad()
    flat = np.cos(elevation)[:, None]
    directions = np.stack(
        [
            flat * np.cos(azimuth),
            flat * np.sin(azimuth),
            np.broadcast_to(np.sin(elevation)[:, None], (len(elevation), len(azimuth))),
        ],
        -1,
    )
    direction = (directions @ sensor.rotation.T).astype(np.float32)
    # The sweep turns clockwise: its share of the full turn is the share of its period.
    span = (model.azimuth_deg[1] - model.azimuth_deg[0]) / 360.0 / model.rate_hz
    column_s = ((np.arange(len(azimuth)) + 0.5) / len(azimuth) - 0.5) * span
    shape = direction.shape[:2]
    out = Rays(
        azimuth,
        elevation,
        direction,
        column_s.astype(np.float32),
        np.full(shape, np.inf, np.float32),
        np.full(shape, NOTHING, np.int32),
        np.zeros(shape, np.int8),
        np.ones(shape, np.float32),
    )
    # A street rises by a fifth at most.
    line, col = np.nonzero(direction[..., 2] < 0.15)
    d = direction[line, col]
    drift = out.column_s[col, None] * np.append(sensor.velocity_mps, 0)
    start = (sensor.position_m + drift).astype(np.float32)
    height = start[:, 2] - terrain.height(start[:, 0], start[:, 1])
    limit = np.float32(model.range_m)
    t = np.minimum(height / np.maximum(-d[:, 2], np.float32(0.02)), limit)
    error = np.zeros_like(t)
    for _ in range(NEWTON_STEPS):
        x, y = start[:, 0] + t * d[:, 0], start[:, 1] + t * d[:, 1]
        error = start[:, 2] + t * d[:, 2] - terrain.height(x, y)
        sx, sy = terrain.slope(x, y)
        t = np.clip(t - error / np.minimum(d[:, 2] - sx * d[:, 0] - sy * d[:, 1], np.float32(-0.004)), 0, 2 * limit)
    x, y = start[:, 0] + t * d[:, 0], start[:, 1] + t * d[:, 1]
    error = start[:, 2] + t * d[:, 2] - terrain.height(x, y)
    ok = (np.abs(error) < MAX_GROUND_ERROR_M) & (t > MIN_RANGE_M) & (t < limit)
    sx, sy = terrain.slope(x, y)
    facing = -(d[:, 2] - sx * d[:, 0] - sy * d[:, 1])
    ok &= facing > 0.005
    t = t - terrain.relief(x, y) / np.maximum(facing, np.float32(0.02))
    line, col = line[ok], col[ok]
    out.range_m[line, col], out.hit[line, col], out.incidence[line, col] = t[ok], GROUND, facing[ok]
    return out


def _returned(
    rays: Rays, sensor: SensorState, count: int, rng: np.random.Generator, model: ReturnModel, range_m: float
) -> Returns:
    """Draw what comes back of each ray."""
    hit_range = np.where(rays.range_m < range_m, rays.range_m, np.float32(np.inf))
    early = backscattered(hit_range.ravel(), model.weather, rng).reshape(hit_range.shape)
    from_air = early < hit_range
    line, firing = np.nonzero(np.isfinite(hit_range) | from_air)
    t = np.where(from_air, early, hit_range)[line, firing].astype(np.float32)
    air = from_air[line, firing]
    hit = np.where(air, GROUND, rays.hit[line, firing]).astype(np.int32)
    material = rays.material[line, firing]
    low, high = np.array([REFLECTANCE[m] for m in Material], np.float32).T
    # One draw for each object and material, and a little for each ray.
    draw = rng.random((count + 2, len(Material)), dtype=np.float32)[hit + 2, material]
    speckle = np.exp(0.25 * rng.standard_normal(len(t), dtype=np.float32))
    reflectance = (low[material] + (high - low)[material] * draw) * speckle
    signal = reflected(t, reflectance, rays.incidence[line, firing], model.weather)
    kept = detected(signal, model, rng) | air
    line, firing, t, hit, reflectance = line[kept], firing[kept], t[kept], hit[kept], reflectance[kept]
    intensity = np.clip(reflectance * rays.incidence[line, firing], 0.003, 1)
    t = disturbed(t, model, rng)
    t_s = rays.column_s[firing]
    start = sensor.position_m.astype(np.float32) + t_s[:, None] * np.append(sensor.velocity_mps, 0).astype(np.float32)
    xyz = start + t[:, None] * rays.direction[line, firing]
    return Returns(xyz, intensity.astype(np.float32), t_s, hit, line.astype(np.int32))
