"""Names of colors: the terms that people use, and how sure they are of a color that is only roughly known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib import colors as mcolors

from log2sim.datatypes import COLOR_NAMES
from log2sim.datatypes.color_names import name_indices, name_of, name_probabilities, to_lab

channel = st.integers(0, 255)


@pytest.mark.parametrize(
    ("rgb", "name"),
    [
        ((0, 0, 0), "black"), ((255, 255, 255), "white"), ((119, 119, 119), "gray"), ((192, 192, 192), "silver"),
        ((255, 0, 0), "red"), ((0, 0, 255), "blue"), ((0, 128, 0), "green"), ((255, 255, 0), "yellow"),
        ((139, 69, 19), "brown"), ((255, 140, 0), "orange"), ((0, 0, 128), "blue"), ((128, 0, 0), "red"),
        ((255, 105, 180), "red"), ((240, 234, 214), "white"), ((28, 29, 31), "black"), ((60, 84, 62), "green"),
    ],
)  # fmt: skip
def test_basic_colors_have_their_names(rgb: tuple[int, int, int], name: str) -> None:
    assert name_of(rgb) == name


def test_the_names_agree_with_a_survey() -> None:
    """XKCD color survey, as matplotlib holds it: names that end with a basic term, such as 'pale olive green'."""
    said = {key: key.removeprefix("xkcd:").split()[-1].replace("grey", "gray") for key in mcolors.XKCD_COLORS}
    known = {key: name for key, name in said.items() if name in COLOR_NAMES}
    lab = to_lab([[255 * v for v in mcolors.to_rgb(mcolors.XKCD_COLORS[key])] for key in known])
    found = [COLOR_NAMES[k] for k in name_indices(lab)]
    assert len(known) > 400
    assert np.mean([a == b for a, b in zip(found, known.values())]) > 0.84


@given(channel, channel, channel)
@settings(max_examples=50, deadline=None)
def test_probabilities_sum_to_one_and_settle_on_the_name(r: int, g: int, b: int) -> None:
    lab = to_lab((r, g, b))[0]
    assert name_probabilities(lab, np.array([9.0, 6.0, 5.0])).sum() == pytest.approx(1.0)
    if len(set(name_indices(lab + np.array(np.meshgrid(*[[-0.1, 0.1]] * 3)).reshape(3, -1).T))) == 1:
        sure = name_probabilities(lab, np.full(3, 1e-3))
        assert COLOR_NAMES[int(np.argmax(sure))] == name_of((r, g, b))
        assert sure.max() == 1.0
