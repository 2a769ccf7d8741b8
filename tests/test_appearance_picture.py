"""The color of a vehicle in one picture, cut out of synthetic scenes with known paints."""

from __future__ import annotations

import numpy as np
import pytest

from log2sim.road.color_picture import cells_of, color_of_picture, paint_model


def test_a_vehicle_before_a_plain_background_has_its_own_color() -> None:
    image = np.full((120, 160, 3), 200, np.uint8)
    image[30:100, 30:130] = (40, 30, 160)
    found = color_of_picture(image, [20, 20, 140, 110])
    assert found is not None
    assert found.color["name"] == "red"


@pytest.mark.parametrize("k", [0, 200, 500, 900])
def test_pixels_that_are_drawn_of_a_paint_are_explained_by_it(k: int) -> None:
    model = paint_model()
    share = np.exp(model.log_cells[k])
    centers = np.stack(np.meshgrid(np.linspace(3, 105, 18), *[np.sinh(np.linspace(-1, 1, 17) * 16 / 17 * np.arcsinh(12.5)) * 8] * 2,
                                   indexing="ij"), -1).reshape(-1, 3)  # fmt: skip
    assert np.array_equal(cells_of(centers), np.arange(len(centers)))
    probability = model.explain(centers, share / share.sum())
    assert np.linalg.norm(model.lab[int(np.argmax(probability))] - model.lab[k]) < 16
