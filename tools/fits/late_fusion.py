"""Fit the weights with which late fusion scores an object found in an image and in a sweep, on synthetic scenes.

    python tools/fit.py late_fusion --images ssd-mobilenet-v2 --sweeps lidar:vehicle --seed 1 samples/scenes/*.toml

Every scene is made with the seed and its truth; a pair of an image box and a projected box of the sweep is right where an
agent of that group is at its place. The weights are the most likely ones of a logistic function, with those of independent
evidence as prior, and are printed as `log2sim/perception/lidar/measure.py` holds them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from fits.logistic import logistic_regression
from log2sim.config import Config
from log2sim.datatypes import GROUP_OF, Boxes3D, Measurements, Scenario
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception.lidar import measure
from log2sim.perception.lidar.measure import PAIR_WEIGHTS, Pairs, PairWeights, logit, match_boxes
from log2sim.perception.lidar.projection import View
from log2sim.pipeline import observe_log, start
from log2sim.synth.scene import load_scene
from log2sim.synth.synthesis import synthesize

# A box is right when its center is this near to an agent's.
MAX_OFFSET_M = {"vehicle": 1.5, "two_wheeler": 1.0, "pedestrian": 0.7, "other": 1.0}
# Standard deviation of the weights around those of independent evidence, before any pair is seen.
PRIOR_SIGMA = np.array([1.0, 0.5, 0.5, 2.0])


def pairs_of(scene: Path, images: str, sweeps: str, seed: int) -> tuple[Array, NDArray[np.bool_]]:
    """Features (P, 4) of all pairs in a scene, and whether they are right (P,)."""
    log, truth = synthesize(load_scene(scene), seed=seed)
    found: list[tuple[Boxes3D, Measurements, Pairs]] = []

    def match(boxes: Boxes3D, images: Measurements, frame: NDArray[np.intp], views: Sequence[View]) -> Pairs:
        found.append((boxes, images, match_boxes(boxes, images, frame, views)))
        return found[-1][2]

    with patch.object(measure, "match_boxes", match):
        # In this process: what others match is not seen here.
        observe_log(start(log, Config.load(settings=[f"detect.name={images}+{sweeps}"]), jobs=1))
    parts = [_features(*of_tick, truth) for of_tick in found]
    return np.concatenate([x for x, _ in parts]), np.concatenate([y for _, y in parts])


def _features(boxes: Boxes3D, images: Measurements, pairs: Pairs, truth: Scenario) -> tuple[Array, NDArray[np.bool_]]:
    scores = logit(images.score[pairs.image]), logit(boxes.score[pairs.box])
    x = np.column_stack([np.ones(len(pairs.box)), *scores, pairs.iou])
    right = np.zeros(len(x), dtype=bool)
    for n, row in enumerate(pairs.box):
        group = GROUP_OF[str(boxes.category[row])]
        at_s = np.array([(int(boxes.t_ns[row]) - truth.t0_ns) / NS_PER_S])
        for agent in truth.others:
            state = agent.at(at_s)
            (away_m,) = np.hypot(state.x_m - boxes.center_m[row, 0], state.y_m - boxes.center_m[row, 1])
            right[n] |= bool(state.valid[0] and away_m < MAX_OFFSET_M[group] and GROUP_OF[agent.category] == group)
    return x, right


def main(scenes: list[Path], images: str = "ssd-mobilenet-v2", sweeps: str = "lidar:vehicle", seed: int = 1) -> None:
    """Print the weights for a detector in images and one in sweeps."""
    x, right = (np.concatenate(part) for part in zip(*(pairs_of(scene, images, sweeps, seed) for scene in scenes)))
    before = np.array(list(vars(PAIR_WEIGHTS).values()))
    weights = logistic_regression(x, right, PRIOR_SIGMA**-2, before)
    print(f"{len(x)} pairs, {int(right.sum())} right; seed {seed}")
    for name, w in (("independent", before), ("fitted", weights)):
        loss = np.logaddexp(0.0, np.where(right, -1.0, 1.0) * (x @ w)).sum()
        print(f"{name:12s} loss a pair {loss / max(len(x), 1):.4f}")
    print(PairWeights(*(round(float(w), 2) for w in weights)))
