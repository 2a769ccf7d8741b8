"""Mounts of cameras, checked against a LiDAR beside them and the motion of the ego."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from log2sim.calibration.edge_alignment import EdgeView, YawEstimate
from log2sim.calibration.edge_views import EdgeViews, choose_moments, is_near
from log2sim.calibration.mount_mistakes import Mistake, MountCheck, estimate_mount_yaw, find_mistakes, turn_by
from log2sim.config import Config
from log2sim.datatypes import Fault, Log, Treatment
from log2sim.geometry import Array, Camera
from log2sim.localization.choice import during_ns
from log2sim.localization.ego_sweeps import densest_lidar
from log2sim.plan import LABELS
from log2sim.sensors import Sensors

# At 30 m this is 0.3 m, half the width of a pedestrian: LiDAR points leave the image boxes of their objects.
MIN_TOLD_RAD = 0.01
MIN_SIGMAS = 4.0
# Up to half of that, a camera is sound whatever more frames say.
SOUND_RAD = MIN_TOLD_RAD / 2
FIX = "--fix-calibration"
DONE: Mapping[Treatment, str] = {
    "corrected": "corrected",
    "left_out": f"the camera is not used, unless {FIX} corrects it",
    "kept": f"not corrected, which {FIX} does",
}
NOT_SEEN = "the mount is not corrected: the edges that {} sees do not show whether it is turned"

Progress = Callable[[str, int, int], None]


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
    No yaw is estimated of a camera with which no LiDAR is mounted, that shows no edges, or of which several angles fit
    alike; and no image is read where boxes come from the log. Where all cameras are turned alike, it is the LiDAR that is.
    """
    if config.detect.in_images in ("", LABELS):
        return log, ()
    lidar = densest_lidar(sensors.restrict(log)) or ""
    if any(fault.sensor == lidar and _is_wrong(fault) for fault in of_lidars):
        lidar = ""
    check = _look(log, lidar, config, sensors, progress)
    fix = config.calibration.fix_mounts
    mistakes = find_mistakes(check, during_ns(log, config))
    mounts = {name: mistake.mount_T_cam for name, mistake in mistakes.items()}
    treatments = _treat_mistakes(mistakes, config, sensors)
    faults = [_fault_of_mistake(name, lidar, mistake, treatments[name]) for name, mistake in mistakes.items()]
    off = {name: yaw for name, yaw in check.yaws.items() if yaw is not None and is_off(yaw)}
    if turns_together(check.yaws):
        faults.append(_fault_of_lidar(lidar, off, fix=fix))
    else:
        faults += [_fault_of_yaw(name, check, yaw, fix=fix) for name, yaw in off.items()]
    mounts |= {name: turn_by(log.cameras[name].mount_T_cam, yaw.yaw_rad) for name, yaw in off.items()}
    unknown = [name for name, yaw in check.yaws.items() if fix and lidar and yaw is None and name not in mistakes]
    faults += [Fault("unknown_rotation", name, NOT_SEEN.format(lidar), "kept") for name in unknown]
    return (with_mounts(log, mounts) if fix and mounts else log), tuple(faults)


def _is_wrong(fault: Fault) -> bool:
    """Return whether a LiDAR is used as it is though its clock or mount is off."""
    return fault.treatment == "kept" and fault.kind in ("time_offset", "lidar_rotation")


def _treat_mistakes(mistakes: Mapping[str, Mistake], config: Config, sensors: Sensors) -> dict[str, Treatment]:
    """Decide what is done about cameras with wrong mounts; they are left out where the run can go on without them."""
    certain = {name for name, mistake in mistakes.items() if mistake.certain}
    dispensable = bool(set(sensors.cameras) - certain) and config.sync.reference not in certain
    if config.calibration.fix_mounts:
        return dict.fromkeys(mistakes, "corrected")
    return {name: "left_out" if dispensable and name in certain else "kept" for name in mistakes}


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


def _look(log: Log, lidar: str, config: Config, sensors: Sensors, progress: Progress) -> MountCheck:
    """Look at frames of the cameras beside a LiDAR and at its sweeps, over the log."""
    unknown = dict.fromkeys(sensors.cameras)
    names = [name for name in sensors.cameras if lidar and is_near(log, name, lidar)]
    if not names:
        return MountCheck(log, lidar, {}, unknown)
    reference = log.reference_camera if log.reference_camera in names else names[0]
    moments = choose_moments(log, lidar, reference, during_ns(log, config))
    seen = EdgeViews(log, moments, lambda done, total: progress("check cameras", done, total))
    looks = {name: _look_through(log.cameras[name], seen) for name in names}
    progress("check cameras", len(moments.sweeps), len(moments.sweeps))
    views = {name: views for name, (views, _) in looks.items()}
    return MountCheck(log, lidar, views, unknown | {name: yaw for name, (_, yaw) in looks.items()})


def _look_through(camera: Camera, seen: EdgeViews) -> tuple[list[EdgeView], YawEstimate | None]:
    """Return views of a camera and its yaw: by every second moment, and by all where those do not show that it is sound."""
    few = seen.of_camera(camera.name, every=2)
    yaw = estimate_mount_yaw(camera, few)
    if yaw is not None and abs(yaw.yaw_rad) < SOUND_RAD:
        return few, yaw
    views = seen.of_camera(camera.name)
    return views, estimate_mount_yaw(camera, views)


def _fault_of_mistake(name: str, lidar: str, mistake: Mistake, treatment: Treatment) -> Fault:
    return Fault(mistake.kind, name, f"{mistake.words.format(lidar)}; {DONE[treatment]}", treatment)


def _fault_of_yaw(name: str, check: MountCheck, yaw: YawEstimate, *, fix: bool) -> Fault:
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


def _words(yaw: YawEstimate) -> str:
    values = _values(yaw)
    return f"yaw {values['yaw_deg']:+.2f} degrees (sigma {values['yaw_sigma_deg']:.2f})"


def _values(yaw: YawEstimate) -> dict[str, float]:
    """Return the yaw of the mount in the calibration against the truth, which is minus that which it lacks."""
    off, sigma = np.rad2deg([-yaw.yaw_rad, yaw.sigma_rad])
    return {"yaw_deg": float(off), "yaw_sigma_deg": float(sigma)}
