"""Mounts of cameras, checked against a LiDAR beside them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from log2sim.calibration.corrections import turn_mount
from log2sim.calibration.edge_alignment import REACH_RAD, EdgeView, YawEstimate, estimate_yaw, score_angles
from log2sim.calibration.edge_views import EdgeViews, choose_moments, is_near
from log2sim.config import Config
from log2sim.datatypes import Fault, Log, Treatment
from log2sim.geometry import Array, Camera, inverse, rotation_from_rpy, transform
from log2sim.localization.choice import during_ns
from log2sim.localization.ego_sweeps import densest_lidar
from log2sim.plan import LABELS
from log2sim.sensors import Sensors

# At 30 m this is 0.3 m, half the width of a pedestrian: LiDAR points leave the image boxes of their objects.
MIN_TOLD_RAD = 0.01
MIN_SIGMAS = 4.0
# What may be left of the yaw with the mount of another camera.
MAX_LEFT_RAD = np.deg2rad(1.5)
# A camera that is turned far is looked at again from there, so that the whole range of angles lies around it.
MAX_ROUNDS = 3
FIX = "--fix-calibration"
DONE: Mapping[Treatment, str] = {
    "corrected": "corrected",
    "left_out": f"the camera is not used, unless {FIX} corrects it",
    "kept": f"not corrected, which {FIX} does",
}
NOT_SEEN = "the mount is not corrected: the edges that {} sees do not show whether it is turned"

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class _Check:
    """What the mounts of a log are checked with, and what came of it.

    Attributes
    ----------
    log : Log
    lidar : str
    views : mapping of str to list of EdgeView
        By camera.
    yaws : mapping of str to YawEstimate or None
        By camera, with its own mount.
    """

    log: Log
    lidar: str
    views: Mapping[str, list[EdgeView]]
    yaws: Mapping[str, YawEstimate | None]


@dataclass(frozen=True, eq=False)
class _Mistake:
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
    """

    kind: str
    words: str
    mount_T_cam: Array
    other: str = ""


def check_cameras(
    log: Log, config: Config, sensors: Sensors, *, of_lidars: tuple[Fault, ...] = (), progress: Progress
) -> tuple[Log, tuple[Fault, ...]]:
    """Return the log, corrected where the settings ask for it, and what is wrong with its cameras.

    Parameters
    ----------
    log : Log
        With the poses and the LiDARs that the run uses.
    config : Config
        `calibration.fix_mounts`: whether mounts are corrected.
    sensors : Sensors
        Those that the run uses; others are not checked.
    of_lidars : tuple of Fault
        Of clocks and mounts of LiDARs. Cameras are not checked against a LiDAR with one that is not corrected.
    progress : callable
        Called as `progress(stage, done, total)`.

    Notes
    -----
    Nothing is said of a camera with which no LiDAR is mounted, that shows no edges, or of which several angles fit alike;
    and no image is read where boxes come from the log. Where all cameras are turned alike, it is the LiDAR that is turned.
    """
    if config.detect.in_images in ("", LABELS):
        return log, ()
    lidar = densest_lidar(sensors.restrict(log))
    if lidar is None or any(fault.sensor == lidar and _is_wrong(fault) for fault in of_lidars):
        return log, ()
    check = _look(log, lidar, config, sensors, progress)
    fix = config.calibration.fix_mounts
    mistakes = _find_mistakes(check)
    mounts = {name: mistake.mount_T_cam for name, mistake in mistakes.items()}
    treatment = _treat_mistakes(mounts, config, sensors)
    faults = [_fault_of_mistake(name, lidar, mistake, treatment) for name, mistake in mistakes.items()]
    off = {name: yaw for name, yaw in check.yaws.items() if yaw is not None and is_off(yaw)}
    if turns_together(check.yaws):
        faults.append(_fault_of_lidar(lidar, off, fix=fix))
    else:
        faults += [_fault_of_yaw(name, check, yaw, fix=fix) for name, yaw in off.items()]
    mounts |= {name: _turned(log.cameras[name].mount_T_cam, yaw.yaw_rad) for name, yaw in off.items()}
    unknown = [name for name, yaw in check.yaws.items() if fix and yaw is None and name not in mistakes]
    faults += [Fault("unknown_rotation", name, NOT_SEEN.format(lidar), "kept") for name in unknown]
    return (with_mounts(log, mounts) if fix and mounts else log), tuple(faults)


def _is_wrong(fault: Fault) -> bool:
    """Return whether a LiDAR is used as it is though its clock or mount is off."""
    return fault.treatment == "kept" and fault.kind in ("time_offset", "lidar_rotation")


def _treat_mistakes(names: Collection[str], config: Config, sensors: Sensors) -> Treatment:
    """Decide what is done about cameras with wrong mounts; they are left out where the run can go on without them."""
    if config.calibration.fix_mounts:
        return "corrected"
    remain = set(sensors.cameras) - set(names)
    return "left_out" if remain and config.sync.reference not in names else "kept"


def is_off(yaw: YawEstimate) -> bool:
    """Return whether a camera is turned significantly, and by so much that it matters."""
    return abs(yaw.yaw_rad) > max(MIN_TOLD_RAD, MIN_SIGMAS * yaw.sigma_rad)


def turns_together(yaws: Mapping[str, YawEstimate | None]) -> bool:
    """Return whether several cameras are turned against the LiDAR, all by the same angle, so that it may be the LiDAR's."""
    known = [yaw for yaw in yaws.values() if yaw is not None]
    angles, sigmas = np.array([y.yaw_rad for y in known]), np.array([y.sigma_rad for y in known])
    if len(known) < 2 or not all(is_off(yaw) for yaw in known):
        return False
    mean = float(np.average(angles, weights=1 / sigmas**2))
    return bool(np.all(np.abs(angles - mean) < MIN_SIGMAS * sigmas))


def with_mounts(log: Log, mounts: Mapping[str, Array]) -> Log:
    """Return a log whose cameras have other mounts (4, 4), by name."""
    moved = {name: replace(log.cameras[name], mount_T_cam=mount_T_cam) for name, mount_T_cam in mounts.items()}
    return log.changed(cameras={**log.cameras, **moved})


def _look(log: Log, lidar: str, config: Config, sensors: Sensors, progress: Progress) -> _Check:
    """Look at frames of the cameras beside a LiDAR and at its sweeps, over the log."""
    names = [name for name in sensors.cameras if is_near(log, name, lidar)]
    if not names:
        return _Check(log, lidar, {}, {})
    reference = log.reference_camera if log.reference_camera in names else names[0]
    moments = choose_moments(log, lidar, reference, during_ns(log, config))
    seen = EdgeViews(log, moments, lambda done, total: progress("check cameras", done, total))
    views = {name: seen.of_camera(name) for name in names}
    return _Check(log, lidar, views, {name: _yaw_of(log.cameras[name], views[name]) for name in names})


def _yaw_of(camera: Camera, views: list[EdgeView]) -> YawEstimate | None:
    """Estimate the yaw that the mount of a camera lacks."""
    turned_rad = 0.0
    for _ in range(MAX_ROUNDS):
        turned = replace(camera, mount_T_cam=_turned(camera.mount_T_cam, turned_rad))
        found = estimate_yaw([score_angles(turned, view) for view in views])
        if found is None:
            return None
        turned_rad += found.yaw_rad
        if abs(found.yaw_rad) < REACH_RAD / 2:
            return replace(found, yaw_rad=turned_rad)
    return None


def _find_mistakes(check: _Check) -> dict[str, _Mistake]:
    """Find the cameras of which the own mount does not fit while another one does: the one with the clearest edges."""
    mistakes = {}
    for name, yaw in check.yaws.items():
        camera, best = check.log.cameras[name], 0.0
        for mistake in _list_mistakes(check, name) if yaw is None else ():
            found = _yaw_of(replace(camera, mount_T_cam=mistake.mount_T_cam), check.views[name])
            if found is not None and abs(found.yaw_rad) < MAX_LEFT_RAD and found.gain > best:
                mistakes[name], best = mistake, found.gain
    return mistakes | _list_exchanged(check, mistakes)


def _list_exchanged(check: _Check, mistakes: Mapping[str, _Mistake]) -> dict[str, _Mistake]:
    """List the cameras whose mount is another one's, though their own images do not show it: they get what that one had."""
    return {
        mistake.other: _Mistake(
            "swapped_cameras",
            f"its mount is that of {name}, whose images fit edges of {{}} with it and not with the mount of {name}",
            check.log.cameras[name].mount_T_cam,
            name,
        )
        for name, mistake in mistakes.items()
        if mistake.other and mistake.other not in mistakes
    }


def _list_mistakes(check: _Check, name: str) -> list[_Mistake]:
    """List the mounts that a camera may have instead of its own: those of others that do not fit them either, and likely slips."""
    cameras, own = check.log.cameras, check.log.cameras[name].mount_T_cam
    others = [other for other, yaw in check.yaws.items() if other != name and yaw is None]
    fits = "edges of {} fit its images with"
    listed = [
        _Mistake(
            "swapped_cameras",
            f"sees {other}'s points: {fits} the mount of {other} and not with its own",
            cameras[other].mount_T_cam,
            other,
        )
        for other in others
    ]
    inverted = f"its mount in the calibration is inverted: {fits} the inverse and not as it is"
    listed.append(_Mistake("wrong_mount", inverted, inverse(own)))
    for degrees in (90, 180, 270):
        about_axis = transform(rotation_from_rpy(0.0, 0.0, np.deg2rad(degrees)), np.zeros(3))
        words = f"its images are turned by {degrees} degrees: {fits} its mount turned about the optical axis and not as it is"
        listed.append(_Mistake("wrong_mount", words, own @ about_axis))
    return listed


def _fault_of_mistake(name: str, lidar: str, mistake: _Mistake, treatment: Treatment) -> Fault:
    return Fault(mistake.kind, name, f"{mistake.words.format(lidar)}; {DONE[treatment]}", treatment)


def _fault_of_yaw(name: str, check: _Check, yaw: YawEstimate, *, fix: bool) -> Fault:
    treatment: Treatment = "corrected" if fix else "kept"
    alone = sum(other is not None for other in check.yaws.values()) == 1
    message = (
        f"its mount in the calibration is turned by {_words(yaw)} against edges that {check.lidar} sees too"
        f"{f', or the mount of {check.lidar} is' if alone else ''}; {DONE[treatment]}"
    )
    return Fault("camera_rotation", name, message, treatment, values=_values(yaw))


def _fault_of_lidar(lidar: str, yaws: Mapping[str, YawEstimate], *, fix: bool) -> Fault:
    """Describe the mount of a LiDAR, with which that of no camera agrees; corrected are those of the cameras."""
    weights = np.array([1 / yaw.sigma_rad**2 for yaw in yaws.values()])
    mean = YawEstimate(
        -float(np.average([yaw.yaw_rad for yaw in yaws.values()], weights=weights)),
        max(yaw.sigma_rad for yaw in yaws.values()),
        min(yaw.gain for yaw in yaws.values()),
        sum(yaw.edges for yaw in yaws.values()),
    )
    done = "the cameras are turned to fit it" if fix else f"not corrected; {FIX} turns the cameras to fit it"
    message = (
        f"its mount in the calibration is turned by {_words(mean)} against edges that {', '.join(yaws)} see too, all of them "
        f"alike; {done}"
    )
    return Fault("lidar_rotation", lidar, message, "corrected" if fix else "kept", values=_values(mean))


def _turned(mount_T_cam: Array, yaw_rad: float) -> Array:
    return turn_mount(mount_T_cam, np.array([0.0, 0.0, yaw_rad]))


def _words(yaw: YawEstimate) -> str:
    values = _values(yaw)
    return f"yaw {values['yaw_deg']:+.2f} degrees (sigma {values['yaw_sigma_deg']:.2f})"


def _values(yaw: YawEstimate) -> dict[str, float]:
    """Return the yaw of the mount in the calibration against the truth, which is minus that which it lacks."""
    off, sigma = np.rad2deg([-yaw.yaw_rad, yaw.sigma_rad])
    return {"yaw_deg": float(off), "yaw_sigma_deg": float(sigma)}
