"""Curves through points of lines: the same wherever the map has its origin, and straight where points leave it open."""

from __future__ import annotations

import numpy as np
import pytest

from log2sim.road.strokes import fit_curve


@pytest.mark.parametrize("shift", [(50.0, 20.0), (-4000.0, 10000.0)])
def test_a_curve_through_two_dashes_far_apart_is_nearly_straight_wherever_it_lies(shift: tuple[float, float]) -> None:
    dashes = np.array([[0.0, 0.0], [1.5, 0.01], [30.0, 0.0], [31.5, 0.02]])
    at_origin = fit_curve(dashes).xy
    assert np.abs(at_origin[:, 1]).max() < 0.05
    assert np.allclose(fit_curve(dashes + np.array(shift)).xy - shift, at_origin, atol=1e-6)
