"""Seams between cameras: registered patches, offsets of known mount errors, and mounts that make them vanish."""

from __future__ import annotations

import numpy as np
import pytest

from log2sim.geometry import Array, Camera, ground_homography, rotation_from_rpy, transform
from log2sim.perception.seams import (
    find_seams,
    register_patches,
)

EGO_R_CAM = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
WAVES = np.random.default_rng(0)
# Cosines of wavelengths from 1 to 9 m in all directions.
NUMBERS = np.concatenate([scale * WAVES.normal(size=(5, 2)) for scale in (0.7, 1.5, 3.0, 6.0)])
PHASES = WAVES.uniform(0, 2 * np.pi, len(NUMBERS))
MIDDLE = np.array([1.6, 0.2])


def brightness(xy: Array) -> Array:
    """Of the ground at positions (N, 2)."""
    return 120 + 14 * np.cos(xy @ NUMBERS.T + PHASES).sum(axis=1)


def make_camera(name: str, yaw_deg: float, at: tuple[float, float, float], **lens: object) -> Camera:
    K = np.array([[480.0, 0, 384], [0, 480.0, 216], [0, 0, 1]])
    turn = rotation_from_rpy(0.0, np.radians(6.0), np.radians(yaw_deg))
    return Camera(name, 768, 432, K, "ego", transform(turn @ EGO_R_CAM, np.array(at)), **lens)  # type: ignore[arg-type]


CAMERAS = {"a": make_camera("a", 0.0, (1.7, 0.0, 1.6)), "b": make_camera("b", 60.0, (1.5, 0.4, 1.6))}
ROADS = {name: ground_homography(c, c.mount_T_cam) for name, c in CAMERAS.items()}


@pytest.mark.parametrize("offset_m", [(0.0, 0.0), (0.31, -0.17), (-1.02, 0.44)])
def test_a_shifted_patch_is_found_to_a_third_of_a_cell(offset_m: tuple[float, float]) -> None:
    cell = 0.04
    x, y = np.meshgrid(np.arange(0, 6, cell), np.arange(0, 4, cell), indexing="ij")
    rng = np.random.default_rng(1)

    def patch(shift: tuple[float, float], gain: float) -> np.ndarray:
        seen = brightness(np.column_stack([(x - shift[0]).ravel(), (y - shift[1]).ravel()])).reshape(x.shape)
        return (gain * seen + rng.normal(0, 2, x.shape)).astype(np.float32)

    found = register_patches(patch((0.0, 0.0), 1.0), patch(offset_m, 0.7), cell)
    assert found is not None
    np.testing.assert_allclose(found.offset_m, offset_m, atol=0.013)
    assert found.correlation > 0.9
    assert np.sqrt(np.diag(found.covariance)).max() < 0.015


def test_seams_lie_where_two_cameras_see_the_ground() -> None:
    places = find_seams(CAMERAS, ROADS, MIDDLE, 15.0)
    assert [(p.first, p.second) for p in places] == [("a", "b")]
    assert np.hypot(*(places[0].center_m - MIDDLE)) == pytest.approx(15.0)
    assert 20 < np.degrees(places[0].azimuth_rad) < 40
    apart = {"a": CAMERAS["a"], "b": make_camera("b", 180.0, (0.0, 0.0, 1.6))}
    roads = {name: ground_homography(c, c.mount_T_cam) for name, c in apart.items()}
    assert find_seams(apart, roads, MIDDLE, 15.0) == []
