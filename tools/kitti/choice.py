"""Which boxes of tracks are told on the KITTI tracking benchmark, and with which score."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from kitti.boxes import Boxes
from kitti.confidence import FULL_HITS, Described
from kitti.rows import Mask, neighbors
from kitti.scene import is_small
from log2sim.geometry import Array

# Log-odds that a box of a car lies on a labeled one, of detected and of predicted boxes, with all frames at hand and with those
# so far: logistic regression by tools/fit.py kitti on sequences 0000, 0002, 0004, 0005, 0007, 0009 and 0011, all of the part on
# which the benchmark's validation does not run.
SEEN = {"constant": -8.89, "score": 0.2, "near_score": 1.0, "near_share": 3.25, "hidden": -3.67, "height": -4.68}
PREDICTED = {"constant": -5.5, "near_score": 0.67, "near_share": 3.59}
SEEN_ONLINE = {
    "constant": -7.45,
    "score": 0.49,
    "near_score": 0.7,
    "near_share": 2.18,
    "hidden": -1.7,
    "height": -4.12,
}
PREDICTED_ONLINE = {"constant": -5.33, "near_score": 0.98, "near_share": 1.93}
# A box is told where it is more likely labeled than not; a detected one is left out only where that is unlikely.
MIN_PREDICTED, MIN_SEEN = 0.5, 0.2
# A track of which less than half is likely labeled stands or falls as a whole, by its score.
WEAK_TRACK = 0.5
# Boxes so small that the benchmark does not count them as errors are carried on for so many frames.
SMALL_FRAMES = 20
# There are too few labeled people to learn from. Tracks of at least this confidence are filled where they are missed for at
# most so many frames, online for two.
FILLED_CONFIDENCE, FILLED_FRAMES, FILLED_FRAMES_ONLINE = 2.0, 15, 2


def choose(described: Described, *, online: bool) -> Boxes:
    """The boxes that are told, by frame; their score is how much their track is believed, up to their frame if online."""
    car = described.boxes.category == "Car"
    keep, score = _people(described, online=online)
    keep_car, score_car = _cars(described, online=online)
    keep = np.where(car, keep_car, keep)
    told = Boxes(**{**vars(described.boxes), "score": np.where(car, score_car, score)}).take(keep)
    return told.take(np.lexsort([told.track_id, told.frame]))


def _cars(d: Described, *, online: bool) -> tuple[Mask, Array]:
    small = is_small(d.boxes)
    # What cannot be an error says nothing against its track.
    seen = np.where(small, 1.0, labeled_probability(d.features, SEEN_ONLINE if online else SEEN))
    predicted = labeled_probability(d.features, PREDICTED_ONLINE if online else PREDICTED)
    soon = d.distance <= SMALL_FRAMES
    likely = ~d.doubled & (small & soon | (predicted >= MIN_PREDICTED))
    if online:
        # What is only predicted is believed as much as the last detection.
        before, _ = neighbors(d.seen, d.boxes.track_id)
        return np.where(d.seen, seen >= MIN_SEEN, likely), seen[before]
    weak = _mean_of_track(d, seen, d.seen) < WEAK_TRACK
    keep = np.where(d.seen, weak | (seen >= MIN_SEEN), likely)
    return keep, _mean_of_track(d, seen, d.seen & keep & ~small)


def _people(d: Described, *, online: bool) -> tuple[Mask, Array]:
    few = d.distance <= FILLED_FRAMES_ONLINE if online else (d.gap > 0) & (d.gap <= FILLED_FRAMES)
    filled = ~d.doubled & (d.confidence >= FILLED_CONFIDENCE) & few
    keep = d.seen | filled
    if not online:
        return keep, d.confidence
    # The evaluation takes the mean over the track: what is seen now counts beside all that was seen.
    before, _ = neighbors(d.seen, d.boxes.track_id)
    now = d.features["score"] + np.log(np.clip(d.hits, 1, FULL_HITS))
    return keep, (now[before] + d.confidence) / 2


def labeled_probability(features: Mapping[str, Array], weights: Mapping[str, float]) -> Array:
    """Probability (N,) of a logistic model; `weights` are those of its features and the `constant`."""
    log_odds = weights["constant"] + sum(w * features[name] for name, w in weights.items() if name != "constant")
    return np.asarray(1 / (1 + np.exp(-log_odds)))


def _mean_of_track(d: Described, values: Array, counted: Mask) -> Array:
    """Mean (N,) over the counted rows of a track, 1 without any."""
    track = d.boxes.track_id
    count = np.bincount(track, weights=counted, minlength=1)
    total = np.bincount(track, weights=values * counted, minlength=1)
    return np.divide(total, count, out=np.ones(len(count)), where=count > 0)[track]
