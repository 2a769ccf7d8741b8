"""Colors of vehicles against their true ones."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from log2sim.datatypes import COLOR_NAMES, GROUP_OF, Agent


def color_figures(true: Sequence[Agent], found: Mapping[str, Agent]) -> dict[str, Any] | None:
    """Compare the colors of vehicles that were found with the true ones.

    Parameters
    ----------
    true : sequence of Agent
    found : mapping
        The agent that each true one is matched with most often, by the true one's id.

    Returns
    -------
    dict or None
        `accuracy` is the share of right names among vehicles with a color whose true color has a name of the fixed list;
        `ciede2000_median` the difference of the RGB values (Sharma et al., 2005; about 2 is just noticeable). None where the
        truth has no colors.
    """
    colored = [a for a in true if a.color is not None and GROUP_OF.get(a.category) == "vehicle"]
    if not colored:
        return None
    confused: Counter[str] = Counter()
    distance, named, right, with_color = [], 0, 0, 0
    matched = [(agent.color, found[agent.id].color) for agent in colored if agent.id in found]
    for true_color, color in matched:
        if color is None or true_color is None:
            continue
        with_color += 1
        distance.append(_difference(color["rgb"], true_color["rgb"]))
        if true_color["name"] in COLOR_NAMES:
            named += 1
            right += color["name"] == true_color["name"]
            if color["name"] != true_color["name"]:
                confused[f"{true_color['name']} as {color['name']}"] += 1
    return {
        "vehicles": len(matched),
        "with_color": with_color,
        "named": named,
        "right": right,
        "accuracy": right / named if named else None,
        "ciede2000_median": float(np.median(distance)) if distance else None,
        "confused": dict(sorted(confused.items())),
    }


def _difference(a: Any, b: Any) -> float:
    from skimage.color import deltaE_ciede2000, rgb2lab

    first, second = (rgb2lab(np.array(rgb, dtype=np.float64)[None, None] / 255) for rgb in (a, b))
    return float(deltaE_ciede2000(first, second)[0, 0])
