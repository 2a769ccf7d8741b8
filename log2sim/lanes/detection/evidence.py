"""How likely it is that ridges in a line are paint: each sensor, and each property, by its likelihood ratio."""

from __future__ import annotations

import numpy as np

from log2sim.geometry import Array
from log2sim.lanes.detection.profiles import Pieces

# Log-odds before anything but one ridge of a meter is known: on gravel, one in 20 is followed by paint.
PRIOR = -3.0
PER_METER = 0.8  # of paint in line, which texture seldom continues
MAX_BY_LENGTH = 5.5
PER_METER_MORE, MAX_BY_MORE = 0.03, 1.5  # of longer lines
DASHES = 1.5  # three or more dashes of one length at one distance
# Sun between two shadows and wet glare are ridges to a camera, too: more than that it alone does not say.
MAX_BY_CAMERA = 3.0
UNEVEN = -1.5  # a step beside which a little stands out
NOT_BRIGHTEST, MIN_OUTSHINING = -2.5, 0.4  # no brighter than much of the ground around; share of its contrast
# Glare fades to its sides; paint ends. Lines of 0.3 m or less look alike to a camera.
FADING, FADING_FROM_M, FADING_WIDTH_M = -5.0, 0.1, 0.3
FADING_SHARE = 0.25  # of the width; 0.39 of a Gaussian's
WIDTH_VARIES = -2.0
WIDTH_UNUSUAL = -4.0
# Contrast of logarithms of LiDAR intensity of paint and of other ridges: mean, sigma.
PAINT_REFLECTS, OTHER_REFLECTS = (0.8, 0.35), (0.0, 0.12)
# Dashes along lanes are up to 0.3 m wide (VwV-StVO: broad lines of 0.25 m and 0.3 m).
MAX_DASH_WIDTH_M, WIDE_DASHES = 0.4, -2.0
MAX_BY_LIDAR, MAX_BY_LIDAR_ALONE = 6.0, 3.0
ALONE_PRIOR, ALONE_PER_METER, ALONE_AT_MOST = -6.0, 0.4, -1.0
MIN_REFLECTING = 2  # pieces
MIN_WIDTH_M, MAX_WIDTH_M = 0.06, 0.7


def log_odds_of_line(pieces: Pieces, painted_m: float, *, dashes: int, alone: bool = True) -> float:
    """Log-odds that pieces in a line are a marking; `alone` unless others like it are beside it, as bars of crosswalks."""
    odds = PRIOR + min(PER_METER * painted_m, MAX_BY_LENGTH) + min(PER_METER_MORE * painted_m, MAX_BY_MORE)
    odds += DASHES * min(max(dashes - 2, 0), 2) / 2
    by_camera = _median_known(pieces.color)
    if np.isfinite(by_camera):
        odds += _by_shape(pieces, alone=alone)
    odds += _by_width(pieces)
    if alone and dashes > 1 and np.median(pieces.width_m) > MAX_DASH_WIDTH_M:
        odds += WIDE_DASHES
    odds = min(odds, MAX_BY_CAMERA)
    lidar = by_lidar(pieces)
    if np.isfinite(by_camera):
        return odds + lidar
    # Intensities vary more than colors on grass and gravel: where no camera saw it, more of the line must be seen.
    return min(ALONE_PRIOR + ALONE_PER_METER * painted_m, ALONE_AT_MOST) + min(lidar, MAX_BY_LIDAR_ALONE)


def _by_shape(pieces: Pieces, *, alone: bool) -> float:
    contrast = np.maximum(pieces.color, 1e-3)
    odds = 0.0
    uneven = _median_known(pieces.uneven / contrast)
    odds += UNEVEN * float(np.clip((uneven - 0.5) / 0.5, 0, 1))
    bright = pieces.outshines[np.isfinite(pieces.outshines)]
    if len(bright) and alone:
        share = float(np.mean(bright > MIN_OUTSHINING * contrast[np.isfinite(pieces.outshines)]))
        odds += NOT_BRIGHTEST * float(np.clip((0.5 - share) / 0.4, 0, 1))
    width, edge = float(np.median(pieces.width_m)), _median_known(pieces.edge_m)
    if width > FADING_WIDTH_M and edge > max(FADING_FROM_M, FADING_SHARE * width):
        odds += FADING
    typical = _median_known(pieces.color)
    return odds + float(np.clip(np.log(max(typical, 1e-3) / 0.2), -2.0, 1.0))


def _by_width(pieces: Pieces) -> float:
    middle = float(np.median(pieces.width_m))
    odds = 0.0 if MIN_WIDTH_M <= middle <= MAX_WIDTH_M else WIDTH_UNUSUAL
    if len(pieces) >= 3:
        varies = float(np.median(np.abs(pieces.width_m - middle))) / middle
        odds += WIDTH_VARIES * float(np.clip((varies - 0.2) / 0.3, 0, 1))
    return odds


def by_lidar(pieces: Pieces) -> float:
    """Log-odds by LiDAR intensity: 0 where it saw too little."""
    known = np.isfinite(pieces.reflected) & np.isfinite(pieces.reflected_sigma)
    if np.count_nonzero(known) < MIN_REFLECTING:
        return 0.0
    values = pieces.reflected[known]
    mean = float(np.median(values))
    error = float(np.median(pieces.reflected_sigma[known]) / np.sqrt(len(values)))

    def log_density(of: tuple[float, float]) -> float:
        sigma = float(np.hypot(of[1], error))
        return -0.5 * ((mean - of[0]) / sigma) ** 2 - float(np.log(sigma))

    return float(np.clip(log_density(PAINT_REFLECTS) - log_density(OTHER_REFLECTS), -MAX_BY_LIDAR, MAX_BY_LIDAR))


def probability(log_odds: float) -> float:
    """Probability of log-odds."""
    return float(1 / (1 + np.exp(-log_odds)))


def _median_known(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")
