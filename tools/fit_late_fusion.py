"""Fit the weights with which late fusion scores an object found in an image and in a sweep, on synthetic scenes.

    python tools/fit_late_fusion.py --images ssd-mobilenet-v2 --sweeps lidar:vehicle --seed 1 samples/scenes/*.toml

Every scene is made with the seed and its truth; a pair of an image box and a projected box of the sweep is right where an
agent of that group is at its place. The weights are the most likely ones of a logistic function, with those of independent
evidence as prior, and are printed as `log2sim/perception/fusion.py` holds them.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from log2sim.config import Config
from log2sim.datatypes import GROUP_OF, Measurements, Scenario
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception import observe_tick
from log2sim.perception.fusion import PAIR_WEIGHTS, ImageMatches, PairWeights, logit
from log2sim.perception.lidar.projection import View
from log2sim.pipeline import observe_log, start
from log2sim.synth.scene import load_scene
from log2sim.synth.synthesis import synthesize

# A box is right when its center is this near to an agent's.
MAX_OFFSET_M = {"vehicle": 1.5, "two_wheeler": 1.0, "pedestrian": 0.7, "other": 1.0}
# Standard deviation of the weights around those of independent evidence, before any pair is seen.
PRIOR_SIGMA = np.array([1.0, 0.5, 0.5, 2.0, 0.3])


def pairs_of(scene: Path, images: str, sweeps: str, seed: int) -> tuple[Array, NDArray[np.bool_]]:
    """Features (P, 5) of all pairs in a scene, and whether they are right (P,)."""
    log, truth = synthesize(load_scene(scene), seed=seed)
    found: list[tuple[Measurements, ImageMatches]] = []
    original = observe_tick.match_boxes

    def match(boxes: Measurements, rows: Measurements, view: View) -> ImageMatches:
        matches = original(boxes, rows, view)
        found.append((boxes, matches))
        return matches

    observe_tick.match_boxes = match
    try:
        observe_log(start(log, Config.load(settings=[f"detect.name={images}+{sweeps}"])))
    finally:
        observe_tick.match_boxes = original
    parts = [_features(boxes, matches, truth) for boxes, matches in found]
    return np.concatenate([x for x, _ in parts]), np.concatenate([y for _, y in parts])


def _features(boxes: Measurements, matches: ImageMatches, truth: Scenario) -> tuple[Array, NDArray[np.bool_]]:
    k = np.flatnonzero(matches.partner >= 0)
    range_m = np.hypot(*(boxes.center_m[k] - boxes.sensor_m[k])[:, :2].T)
    image = matches.rows.score[matches.partner[k]]
    x = np.column_stack([np.ones(len(k)), logit(image), logit(boxes.score[k]), matches.iou[k], range_m / 10.0])
    right = np.zeros(len(k), dtype=bool)
    for n, row in enumerate(k):
        group = GROUP_OF[str(boxes.category[row])]
        at_s = np.array([(int(boxes.t_ns[row]) - truth.t0_ns) / NS_PER_S])
        for agent in truth.others:
            state = agent.at(at_s)
            near = (
                np.hypot(state.x_m - boxes.center_m[row, 0], state.y_m - boxes.center_m[row, 1]) < MAX_OFFSET_M[group]
            )
            right[n] |= bool(state.valid[0] and near[0] and GROUP_OF[agent.category] == group)
    return x, right


def fit(x: Array, right: NDArray[np.bool_]) -> Array:
    """Find the most likely weights (5,) for features (P, 5) of pairs that are right or wrong (P,)."""
    from scipy.optimize import minimize

    prior = np.array(list(vars(PAIR_WEIGHTS).values()))

    def loss(w: Array) -> float:
        return float(loss_of(x, right, w) + (((w - prior) / PRIOR_SIGMA) ** 2).sum() / 2)

    return np.asarray(minimize(loss, prior, method="BFGS").x)


def loss_of(x: Array, right: NDArray[np.bool_], w: Array) -> float:
    """Negative log-likelihood of weights (5,)."""
    return float(np.logaddexp(0.0, np.where(right, -1.0, 1.0) * (x @ w)).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description="Fit the weights of late fusion on synthetic scenes.")
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--images", default="ssd-mobilenet-v2", help="detector in images")
    parser.add_argument("--sweeps", default="lidar:vehicle", help="detector in sweeps")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    parts = [pairs_of(scene, options.images, options.sweeps, options.seed) for scene in options.scenes]
    x, right = np.concatenate([a for a, _ in parts]), np.concatenate([b for _, b in parts])
    before, weights = np.array(list(vars(PAIR_WEIGHTS).values())), fit(x, right)
    print(f"{len(x)} pairs, {int(right.sum())} right; seed {options.seed}")
    for name, w in (("independent", before), ("fitted", weights)):
        print(f"{name:12s} loss a pair {loss_of(x, right, w) / max(len(x), 1):.4f}")
    print(PairWeights(*(round(float(w), 2) for w in weights)))


if __name__ == "__main__":
    main()
