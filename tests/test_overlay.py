"""Pictures of one moment of a log: what is projected where, and what is said about what is missing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import names, run
from scipy.optimize import brentq
from worlds import camera_ahead, tiny_log

from log2sim.datatypes import Log
from log2sim.geometry import (
    Camera,
    RollingShutter,
    apply,
    box_corners,
    box_lines,
    inverse,
    points_in_box,
    project_moving,
)
from log2sim.visualization.overlay import draw_moment, labels_at, read_moment

SPEED_MPS, TURN_RADPS = 12.0, 0.4


@pytest.fixture(scope="module")
def log() -> Log:
    return tiny_log(noise_m=0.0)[0]


def texts(moment) -> str:
    figure = draw_moment(moment)
    return "\n".join([*(t.get_text() for t in figure.texts), *(ax.get_title(loc="left") for ax in figure.axes)])


@pytest.mark.parametrize("later_ns", [0, 17_000_000, 50_000_000, 91_000_000])
def test_labels_are_interpolated_to_a_stamp(log: Log, later_ns: int) -> None:
    stamps = np.unique(log.labels.t_ns)
    first, boxes = (labels_at(log.labels, int(stamps[4]) + shift) for shift in (0, later_ns))
    driven = boxes.center_m - first.center_m
    expected = {"car": [4.0, 0.0, 0.0], "parked": [0.0, 0.0, 0.0], "walker": [0.0, -1.4, 0.0]}
    for row, track in enumerate(sorted(expected)):
        assert driven[row] == pytest.approx(np.array(expected[track]) * later_ns / 1e9, abs=2e-3)


def test_points_on_a_car_are_drawn_in_its_wireframe(log: Log) -> None:
    moment = read_moment(log, at_s=0.5)
    shot = moment.shots[0]
    lidar = moment.sweeps[0].xyz
    boxes = moment.boxes
    for i in range(len(boxes.t_ns)):
        # Label and sweep are 30 ms apart from the image: the parked car is the one that proves the projection.
        if boxes.center_m[i, 1] > -3.5:
            continue
        on_it = lidar[points_in_box(lidar, boxes.center_m[i], boxes.size_m[i], float(boxes.yaw_rad[i]), 0.05)]
        assert len(on_it) > 20
        map_T_cam = log.map_T_sensor("front", shot.t_ns)[0][0]
        local = apply(inverse(map_T_cam), on_it)
        uv = local[:, :2] / local[:, 2:] * np.diag(shot.camera.K)[:2] + shot.camera.K[:2, 2]
        drawn = np.abs(shot.uv_px[:, None] - uv[None]).max(axis=-1).min(axis=0)
        assert drawn.max() < 1e-3
        edges = np.concatenate([lines.reshape(-1, 2) for lines, _ in shot.boxes])
        corner = apply(inverse(map_T_cam), box_corners(boxes.center_m[i], boxes.size_m[i], boxes.yaw_rad[i])[0])
        corner_px = corner[:, :2] / corner[:, 2:] * np.diag(shot.camera.K)[:2] + shot.camera.K[:2, 2]
        assert np.abs(edges[:, None] - corner_px[None]).max(axis=-1).min(axis=0).max() < 0.5
    assert shot.residuals_s["top"] == pytest.approx((moment.sweeps[0].middle_ns - shot.t_ns) / 1e9)
    assert "compensated" in texts(moment)


def moving_camera(direction: str):
    """A camera that drives ahead and turns while it is read, and its transform at a time."""
    camera = replace(camera_ahead(), rolling_shutter=RollingShutter(direction, 0.06))
    map_T_cam = camera.mount_T_cam

    def cam_T_map_at(t_s):
        out = []
        for t in np.atleast_1d(t_s):
            angle = TURN_RADPS * t
            turn = np.eye(4)
            turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
            turn[:3, 3] = [SPEED_MPS * t, 0.0, 0.0]
            out.append(inverse(turn @ map_T_cam))
        return np.array(out)

    return camera, cam_T_map_at


@pytest.mark.parametrize("direction", ["down", "up", "right", "left"])
def test_a_point_is_seen_by_the_line_that_is_exposed_when_it_is_there(direction: str) -> None:
    camera, cam_T_map_at = moving_camera(direction)
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(5, 40, 60), rng.uniform(-20, 20, 60), rng.uniform(-1, 6, 60)])

    def seen_at(point, t):
        local = apply(cam_T_map_at(t)[0], point[None])[0]
        return local[:2] / local[2] * np.diag(camera.K)[:2] + camera.K[:2, 2]

    uv, depth, valid = project_moving(camera, points, cam_T_map_at)
    assert 20 < valid.sum() < 60
    axis, length = (1, camera.height_px) if direction in ("down", "up") else (0, camera.width_px)
    sign = 1 if direction in ("down", "right") else -1
    moved = 0.0
    for point, found, far in zip(points[valid], uv[valid], depth[valid]):
        # The line that is read at t is the one at (t / readout + 1/2) of the side, from the top or left when sign is 1.
        t = brentq(lambda t, p=point: seen_at(p, t)[axis] - (0.5 + sign * t / 0.06) * length, -0.06, 0.06, xtol=1e-12)
        assert found == pytest.approx(seen_at(point, t), abs=0.05)
        assert far == pytest.approx(apply(cam_T_map_at(t)[0], point[None])[0, 2], abs=1e-3)
        moved = max(moved, np.abs(seen_at(point, t) - seen_at(point, 0.0)).max())
    assert moved > 5.0


def test_inspect_writes_the_picture_and_nothing_over_another(tiny_folder: Path, tmp_path: Path) -> None:
    picture = tmp_path / "o.png"
    ran = run("inspect", tiny_folder, "--overlay", picture, "--at", "0.3", "--cameras", "front")
    assert (ran.code, ran.out) == (0, f"{picture}: written\n")
    assert picture.read_bytes()[:4] == b"\x89PNG"
    assert run("inspect", tiny_folder, "--overlay", picture).code == 2
    assert run("inspect", tiny_folder, "--overlay", picture, "--overwrite").code == 0
    assert names(tmp_path) == ["o.png"]
    assert "no camera 'side'" in run("inspect", tiny_folder, "--overlay", tmp_path / "p.png", "--cameras", "side").line
    assert "--overlay" in run("inspect", tiny_folder, "--at", "1").line
    assert ".png" in run("inspect", tiny_folder, "--overlay", tmp_path / "p.txt").line


CAMERA = Camera("front", 640, 480, np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]]), "ego", np.eye(4))


def corners_cam(x0: float, x1: float) -> np.ndarray:
    """A box of 2 m x 2 m across that reaches from depth x0 to x1, in the order of `box_corners` seen by the camera."""
    across = [(-1, x1), (-1, x0), (1, x0), (1, x1)]
    return np.array([(u, v, z) for v in (1, -1) for u, z in across], dtype=float)


def test_corners_land_where_the_pinhole_puts_them() -> None:
    lines = box_lines(CAMERA, corners_cam(10.0, 20.0)).reshape(-1, 2)
    # 500 px * 1 m / 10 m = 50 px and half of it at 20 m.
    expected = {(320 + s * d, 240 + t * d) for d in (50, 25) for s in (-1, 1) for t in (-1, 1)}
    assert {tuple(np.round(p, 9)) for p in lines} == {(float(u), float(v)) for u, v in expected}


def test_a_box_beside_the_camera_is_cut_at_the_near_plane() -> None:
    lines = box_lines(CAMERA, corners_cam(-5.0, 10.0))
    assert np.isfinite(lines).all()
    assert len(lines) == 10  # four edges far ahead, four along, the crossed-out front
    assert len(box_lines(CAMERA, corners_cam(-9.0, -3.0))) == 0
