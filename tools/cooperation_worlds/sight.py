"""Exact lines of sight: the share of a road user that a LiDAR could see past the boxes of all others."""

from __future__ import annotations

import numpy as np

from cooperation_worlds.world import Array, World
from log2sim.geometry import rectangles_overlap, rotation_from_rpy
from log2sim.synth.actors import Actor
from log2sim.synth.raycast import mount_T_lidar, slab_distance

# Points on the target's axis and sides, at shares of its half length, half width and height.
ALONG, ACROSS, UP = (-0.8, 0.0, 0.8), (-0.8, 0.0, 0.8), (0.15, 0.4, 0.65, 0.9)


def visible_share(world: World, lidar: str, t_s: Array, target: str = "") -> Array:
    """Share (T,) of points in the target's box that lie within the range of a LiDAR and that no other box hides, at times (T,)."""
    moving, spec = world.moving, next(s for s in world.scene.lidar if s.name == lidar)
    seen = {actor.spec.id: actor for actor in moving.seen_from(spec.mount)}
    actor = seen.pop(target or world.target)
    stamps = world.scene.start_ns + np.rint(np.asarray(t_s) * 1e9).astype(np.int64)
    eye = (moving.map_T_mount(spec.mount, stamps) @ mount_T_lidar(spec))[:, :3, 3]
    shares = np.array([(x, y, z) for x in ALONG for y in ACROSS for z in UP])
    states, out = actor.at(t_s), np.zeros(len(t_s))
    boxes = [(np.array(other.spec.box_m), other.at(t_s)) for other in seen.values()]
    for k in range(len(t_s)):
        local = shares * np.array(actor.spec.box_m) * [0.5, 0.5, 1.0] - [0, 0, actor.spec.box_m[2] / 2]
        points = local @ rotation_from_rpy(0, 0, states.yaw_rad[k]).T + states.center_m[k]
        ray = points - eye[k]
        free = np.linalg.norm(ray, axis=1) < spec.range_m
        for size, at in boxes:
            back = rotation_from_rpy(0, 0, at.yaw_rad[k])
            origin = np.tile((eye[k] - at.center_m[k]) @ back, (len(ray), 1))
            free &= ~(slab_distance(size, origin, ray @ back) < 1.0)
        for back, middle, size in _standing(world):
            origin = np.tile((eye[k] - middle) @ back, (len(ray), 1))
            free &= ~(slab_distance(size, origin, ray @ back) < 1.0)
        out[k] = free.mean()
    return out


def _standing(world: World) -> list[tuple[Array, Array, Array]]:
    """List what stands for good: rotation, center and size of the box around each building, and each part of a thing."""
    out = []
    for house in world.scene.building:
        back = rotation_from_rpy(0, 0, np.deg2rad(house.yaw_deg))
        out.append((back, np.array([*house.center, house.size_m[2] / 2]), np.array(house.size_m)))
    for thing in world.things:
        back = rotation_from_rpy(0, 0, thing.yaw_rad)
        for part in thing.parts:
            middle = thing.position_m + back @ (part.low + part.high) / 2
            out.append((back, middle, np.asarray(part.high - part.low)))
    return out


def agents_touch(world: World, t_s: Array, gap_m: float) -> bool:
    """Return whether two road users, the ego among them, come nearer to each other than a gap at times (T,)."""
    states = [(actor.at(t_s), np.tile(np.array(actor.spec.box_m[:2]) + gap_m, (len(t_s), 1))) for actor in _all(world)]
    return any(
        rectangles_overlap(
            *(other.center_m - one.center_m)[:, :2].T, one.yaw_rad, other.yaw_rad, size, other_size
        ).any()
        for k, (one, size) in enumerate(states)
        for other, other_size in states[:k]
    )


def things_touch(world: World, t_s: Array, gap_m: float) -> bool:
    """Return whether a road user may come nearer to the middle of a thing than a gap: circles around the boxes decide."""
    places = np.array([thing.position_m[:2] for thing in world.things]).reshape(-1, 2)
    for actor in _all(world):
        away = np.linalg.norm(actor.at(t_s).center_m[:, None, :2] - places, axis=2)
        if (away < np.hypot(*actor.spec.box_m[:2]) / 2 + gap_m).any():
            return True
    return False


def _all(world: World) -> tuple[Actor, ...]:
    moving = world.moving
    assert moving.ego_body is not None
    return (*moving.actors, moving.ego_body)
