"""The color of a vehicle in one picture, cut out of synthetic scenes with known paints."""

from __future__ import annotations

import numpy as np
import pytest
from test_appearance_colors import PAINTS, street

from log2sim.datatypes import COLOR_NAMES, AgentTable
from log2sim.datatypes.color_names import name_indices, name_of
from log2sim.geometry import NS_PER_S, inverse, project_boxes
from log2sim.road.color_picture import cells_of, color_of_picture, cut_out, explain_paint, paint_model, where_paint_is
from log2sim.road.colors import choose_views


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a", "b", "d"])
def test_a_crop_of_a_scene_gets_the_name_of_its_paint(name: str) -> None:
    log, truth = street()
    ((camera, frames),) = choose_views(log, truth, [name]).items()
    index = min(frames)
    t_ns = int(log.streams[camera].t_ns[index])
    boxes = AgentTable.of([a for a in truth.others if a.id == name], np.array([(t_ns - truth.t0_ns) / NS_PER_S]))
    cam_T_map = inverse(log.map_T_sensor(camera, t_ns)[0][0])
    box_px = project_boxes(
        boxes.center_m[:, 0], boxes.size_m, boxes.yaw_rad[:, 0], log.cameras[camera], cam_T_map
    ).box_px[0]
    found = color_of_picture(log.streams[camera].read(index), box_px)
    assert found is not None
    best = {COLOR_NAMES[k] for k in np.argsort(-found.probability)[:2]}
    assert name_of(PAINTS[name]) in best
    assert found.probability.sum() == pytest.approx(1.0)


def test_the_vehicle_is_cut_out_of_a_plain_background() -> None:
    image = np.full((120, 160, 3), 200, np.uint8)
    image[30:100, 30:130] = (40, 30, 160)
    vehicle = cut_out(image, np.array([20, 20, 140, 110]))
    assert vehicle[40:90, 40:120].mean() > 0.95
    assert not vehicle[:20].any()
    found = color_of_picture(image, [20, 20, 140, 110])
    assert found is not None
    assert found.color["name"] == "red"


def test_a_box_that_is_too_small_has_no_color() -> None:
    assert color_of_picture(np.zeros((50, 50, 3), np.uint8), [10, 10, 14, 14]) is None


def test_paint_is_expected_in_the_lower_middle_of_a_box() -> None:
    paint, presence = where_paint_is()
    assert paint.shape == presence.shape
    assert paint[14, 12] > 2 * max(paint[2].max(), paint[-1].max())
    assert presence[14, 12] > 0.95 > presence[0, 0]


@pytest.mark.parametrize("k", [0, 200, 500, 900])
def test_pixels_that_are_drawn_of_a_paint_are_explained_by_it(k: int) -> None:
    model = paint_model()
    share = np.exp(model.log_cells[k])
    centers = np.stack(np.meshgrid(np.linspace(3, 105, 18), *[np.sinh(np.linspace(-1, 1, 17) * 16 / 17 * np.arcsinh(12.5)) * 8] * 2,
                                   indexing="ij"), -1).reshape(-1, 3)  # fmt: skip
    assert np.array_equal(cells_of(centers), np.arange(len(centers)))
    probability = model.explain(centers, share / share.sum())
    assert np.linalg.norm(model.lab[int(np.argmax(probability))] - model.lab[k]) < 16


def test_half_dark_half_red_pixels_are_red_paint() -> None:
    lab = np.concatenate([np.tile([40.0, 55, 35], (60, 1)), np.tile([5.0, 0, 0], (40, 1))])
    paint = explain_paint(lab, np.ones(100))
    assert COLOR_NAMES[int(name_indices(paint.lab[:1])[0])] == "red"
