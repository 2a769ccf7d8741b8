"""Calibrations that no sensor can have, by field: those that make a run useless, and those that are only doubtful."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from log2sim.datatypes import Log
from log2sim.geometry import Camera, Mount, fold_radius, undistort
from log2sim.geometry.transforms import Array

# In image widths: a field of view of 136 degrees without distortion, and lenses for photographs of the moon.
MIN_FOCAL_WIDTHS, MAX_FOCAL_WIDTHS = 0.2, 20.0
# From the image to the principal point, in widths and heights: a crop of a larger image seldom leaves it farther outside.
MAX_PRINCIPAL_POINT_SIZES = 0.5
# No lens without distortion sees farther off its axis; a pixel beyond shows nothing.
MAX_RAY_DEGREES = 80.0
# Longer than any road vehicle with its trailers.
MAX_MOUNT_DISTANCE_M = 100.0
# Corners of wide lenses lie outside of the circle that the lens draws, where nothing keeps a fitted polynomial from folding.
MAX_FOLD_DEGREES = 70.0
# Fits of rational models reach thousands; the roots of much larger ones are not finite.
MAX_DISTORTION = 1e6
MAX_FOLDED_SHARE, MAX_USABLE_FOLDED_SHARE = 0.01, 0.5
GRID = 32


@dataclass(frozen=True)
class CalibrationProblem:
    """A value of a calibration that no sensor, or hardly one, can have.

    Attributes
    ----------
    message : str
        Names the sensor, where its calibration is, the field and its value.
    is_impossible : bool
        Whether nothing that is measured with it can be right; else it is only doubtful.
    """

    message: str
    is_impossible: bool


def list_calibration_problems(log: Log) -> list[str]:
    """List what is wrong with the calibrations of a log, one line each."""
    return [problem.message for name in log.streams for problem in problems_of(log, name)]


def problems_of(log: Log, name: str) -> Iterator[CalibrationProblem]:
    """Check the calibration of a sensor of a log."""
    place = log.calibrations.get(name, log.name)
    camera = log.cameras.get(name)
    if camera is not None:
        where = f"{place}, camera '{name}'"
        yield from _focal_lengths(camera, where)
        yield from _principal_point(camera, where)
        yield from _distortion(camera, where)
        yield from _mount(camera.mount, camera.mount_T_cam, where)
    elif name in log.lidars:
        lidar = log.lidars[name]
        yield from _mount(lidar.mount, lidar.mount_T_lidar, f"{place}, LiDAR '{name}'")


def _focal_lengths(camera: Camera, where: str) -> Iterator[CalibrationProblem]:
    for field, value_px in (("fx", camera.K[0, 0]), ("fy", camera.K[1, 1])):
        widths = float(value_px) / camera.width_px
        if not MIN_FOCAL_WIDTHS <= widths <= MAX_FOCAL_WIDTHS:
            yield CalibrationProblem(
                f"{where}: its focal length {field} is {value_px:.6g} px, {widths:.3g} image widths; expected "
                f"{MIN_FOCAL_WIDTHS:g} to {MAX_FOCAL_WIDTHS:g}, so check its unit and the size of the images",
                True,
            )


def _principal_point(camera: Camera, where: str) -> Iterator[CalibrationProblem]:
    limit = np.tan(np.radians(MAX_RAY_DEGREES))
    for field, axis, size_px in (("cx", 0, camera.width_px), ("cy", 1, camera.height_px)):
        value_px = float(camera.K[axis, 2])
        outside_px = max(-value_px, value_px - size_px, 0.0)
        # Fails for a value that is not a number.
        if not outside_px <= MAX_PRINCIPAL_POINT_SIZES * size_px:
            yield CalibrationProblem(
                f"{where}: its principal point {field} is {value_px:.6g} px, {outside_px:.6g} px outside of images of "
                f"{camera.width_px}x{camera.height_px} px; check whether the images are cropped or scaled",
                bool(not outside_px <= limit * camera.K[axis, axis]),
            )


def _distortion(camera: Camera, where: str) -> Iterator[CalibrationProblem]:
    wrong = [value for value in camera.distortion if not abs(value) <= MAX_DISTORTION]
    if wrong:
        yield CalibrationProblem(
            f"{where}: its distortion has the coefficient {wrong[0]:.6g}, expected numbers up to {MAX_DISTORTION:g}",
            True,
        )
    if wrong or camera.rectified or not np.arctan(fold_radius(camera)) < np.radians(MAX_FOLD_DEGREES):
        return
    u, v = ((np.arange(GRID) + 0.5) * size / GRID for size in (camera.width_px, camera.height_px))
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    share = float(np.isnan(undistort(camera, pixels)).any(axis=1).mean())
    if share > MAX_FOLDED_SHARE:
        values = ", ".join(f"{value:.6g}" for value in camera.distortion)
        yield CalibrationProblem(
            f"{where}: its distortion ({camera.distortion_model}: {values}) folds the image at "
            f"{np.degrees(np.arctan(fold_radius(camera))):.0f} degrees off the axis: {100 * share:.0f} % of the pixels have no ray; "
            "check the order and signs of the coefficients",
            share > MAX_USABLE_FOLDED_SHARE,
        )


def _mount(mount: Mount, mount_T_sensor: Array, where: str) -> Iterator[CalibrationProblem]:
    distance_m = float(np.linalg.norm(mount_T_sensor[:3, 3]))
    if mount == "ego" and not distance_m <= MAX_MOUNT_DISTANCE_M:
        x, y, z = mount_T_sensor[:3, 3].tolist()
        yield CalibrationProblem(
            f"{where}: its mounting is {distance_m:.6g} m from the ego, at ({x:.6g}, {y:.6g}, {z:.6g}) m; expected at most "
            f"{MAX_MOUNT_DISTANCE_M:g} m, so check its unit and its frame",
            True,
        )
