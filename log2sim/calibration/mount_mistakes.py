"""Mounts that cannot be a camera's own: those of other cameras, inverted ones, those of images that are turned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from log2sim.calibration.corrections import turn_mount
from log2sim.calibration.edge_alignment import REACH_RAD, EdgeView, YawEstimate, estimate_yaw, score_angles
from log2sim.calibration.image_flow import agrees, find_exchanged, follow_pairs
from log2sim.datatypes import Log
from log2sim.geometry import Array, Camera, inverse, rotation_from_rpy, transform

# What may be left of the yaw with the mount of another camera.
MAX_LEFT_RAD = np.deg2rad(1.5)
# A camera that is turned far is looked at again from there, so that the whole range of angles lies around it.
MAX_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class MountCheck:
    """What the mounts of a log are checked with, and what came of it.

    Attributes
    ----------
    log : Log
    lidar : str
        "" without one to check against.
    views : mapping of str to list of EdgeView
        By camera, of those beside the LiDAR.
    yaws : mapping of str to YawEstimate or None
        By camera, with its own mount; None where it is not known.
    """

    log: Log
    lidar: str
    views: Mapping[str, list[EdgeView]]
    yaws: Mapping[str, YawEstimate | None]


@dataclass(frozen=True, eq=False)
class Mistake:
    """A mount that fits the images of a camera where its own does not.

    Attributes
    ----------
    kind : str
        Of the fault.
    words : str
        What is wrong, with a place for the LiDAR.
    mount_T_cam : (4, 4) float64
        What fits.
    other : str
        The camera whose mount it is; "" for none.
    certain : bool
        Whether the run rather goes on without the camera.
    """

    kind: str
    words: str
    mount_T_cam: Array
    other: str = ""
    certain: bool = True


def estimate_mount_yaw(camera: Camera, views: list[EdgeView]) -> YawEstimate | None:
    """Estimate the yaw that the mount of a camera lacks."""
    turned_rad = 0.0
    for _ in range(MAX_ROUNDS):
        turned = replace(camera, mount_T_cam=turn_by(camera.mount_T_cam, turned_rad))
        found = estimate_yaw([score_angles(turned, view) for view in views])
        if found is None:
            return None
        turned_rad += found.yaw_rad
        if abs(found.yaw_rad) < REACH_RAD / 2:
            return replace(found, yaw_rad=turned_rad)
    return None


def find_mistakes(check: MountCheck, during_ns: tuple[int, int] | None) -> dict[str, Mistake]:
    """Find the cameras of which the own mount does not fit while another one does, within some time."""
    by_edges = _find_by_edges(check)
    found = by_edges | _list_exchanged(check, by_edges)
    return found | _find_by_flow(
        check, [n for n, yaw in check.yaws.items() if yaw is None and n not in found], during_ns
    )


def _find_by_edges(check: MountCheck) -> dict[str, Mistake]:
    """Find the cameras whose images edges fit with another mount: the one with the clearest edges."""
    mistakes = {}
    for name, yaw in check.yaws.items():
        camera, best = check.log.cameras[name], 0.0
        for mistake in _list_mistakes(check, name) if yaw is None and check.views.get(name) else ():
            found = estimate_mount_yaw(replace(camera, mount_T_cam=mistake.mount_T_cam), check.views[name])
            if found is not None and abs(found.yaw_rad) < MAX_LEFT_RAD and found.gain > best:
                mistakes[name], best = mistake, found.gain
    return mistakes


def _list_exchanged(check: MountCheck, mistakes: Mapping[str, Mistake]) -> dict[str, Mistake]:
    """List the cameras whose mount is another one's, though their own images do not show it: they get what that one had."""
    return {
        mistake.other: Mistake(
            "swapped_cameras",
            f"its mount is that of {name}, whose images fit edges of {{}} with it and not with their own",
            check.log.cameras[name].mount_T_cam,
            name,
        )
        for name, mistake in mistakes.items()
        if mistake.other and mistake.other not in mistakes
    }


def _list_mistakes(check: MountCheck, name: str) -> list[Mistake]:
    """List the mounts that a camera may have instead of its own: those of others that do not fit them either, and likely slips."""
    cameras, own = check.log.cameras, check.log.cameras[name].mount_T_cam
    others = [other for other, yaw in check.yaws.items() if other != name and yaw is None]
    fits = "edges of {} fit its images with"
    listed = [
        Mistake(
            "swapped_cameras",
            f"sees {other}'s points: {fits} the mount of {other} and not with its own",
            cameras[other].mount_T_cam,
            other,
        )
        for other in others
    ]
    inverted = f"its mount in the calibration is inverted: {fits} the inverse and not as it is"
    listed.append(Mistake("wrong_mount", inverted, inverse(own)))
    for degrees in (90, 180, 270):
        about_axis = transform(rotation_from_rpy(0.0, 0.0, np.deg2rad(degrees)), np.zeros(3))
        words = f"its images are turned by {degrees} degrees: {fits} its mount turned about the optical axis and not as it is"
        listed.append(Mistake("wrong_mount", words, own @ about_axis))
    return listed


def _find_by_flow(check: MountCheck, names: Sequence[str], during_ns: tuple[int, int] | None) -> dict[str, Mistake]:
    """Find cameras with each other's mounts among those that show no edges, by how points move in their images.

    Only where some camera agrees with the motion of the ego, so that the poses are not those that are turned around.
    """
    if len(names) < 2:
        return {}
    log = check.log
    pairs = {name: follow_pairs(log, name, during_ns) for name in names}
    known = any(yaw is not None for yaw in check.yaws.values())
    if not known and not any(agrees(log.cameras[name], pairs[name]) for name in names):
        return {}
    return {
        name: Mistake(
            "swapped_cameras",
            f"sees {other}'s points: they move in its images as with the mount of {other} and against its own",
            log.cameras[other].mount_T_cam,
            other,
            False,
        )
        for name, other in find_exchanged(log.cameras, pairs).items()
    }


def turn_by(mount_T_cam: Array, yaw_rad: float) -> Array:
    """Turn a mount (4, 4) about the upright axis through the camera."""
    return turn_mount(mount_T_cam, np.array([0.0, 0.0, yaw_rad]))
