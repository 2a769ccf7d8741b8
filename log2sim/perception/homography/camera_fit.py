"""Choice of the correspondences that a camera's homography is fitted to: obstacles first, then LiDAR ground points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography.estimate import EstimationOptions, estimate_homography
from log2sim.perception.homography.fit import HomographyFit, refused_fit

# A detector's box ends this far from the true foot point (standard deviation).
FOOT_SIGMA_PX = 4.0
# Pixels of LiDAR ground points, off by calibration and timing, and heights of the road's crown and of curbs.
GROUND_SIGMA_PX = 1.0
GROUND_SIGMA_M = 0.1
# Fewer foot points, or worse conditioned ones, are joined by LiDAR ground points.
MIN_FEET = 80
MAX_FEET_CONDITION = 30.0


def fit_camera(
    feet: Correspondences, ground: Correspondences, options: EstimationOptions, *, rng: np.random.Generator
) -> tuple[HomographyFit, str]:
    """Fit the homography of one camera.

    Foot points of obstacles are taken alone if they suffice. Where they are too few or do not determine the homography
    (cars of one lane are collinear), LiDAR ground points join them. "straw-man" has no LiDAR and so the obstacles alone.

    Parameters
    ----------
    feet, ground : Correspondences
        Of obstacles and of LiDAR ground points.
    options : EstimationOptions
        Its standard deviations are replaced by those of these correspondences.
    rng : numpy.random.Generator

    Returns
    -------
    fit : HomographyFit
    source : str
        What it was fitted to, "none" where nothing was.
    """
    of_feet = replace(options, sigma_px=FOOT_SIGMA_PX)
    if options.method == "straw-man":
        if feet.xy_by_size is None:
            feet = replace(feet, xy_by_size=np.full((len(feet), 2), np.nan))
        fit = estimate_homography(feet, replace(of_feet, K=None), rng=rng)
        return fit, "obstacles of average size" if fit.ok else "none"
    if len(feet) >= MIN_FEET:
        fit = estimate_homography(feet, replace(of_feet, sigma_m=2 * GROUND_SIGMA_M), rng=rng)
        if fit.ok and fit.condition < MAX_FEET_CONDITION:
            return fit, "obstacles"
    both = Correspondences.join([feet, ground])
    if len(both) < 4:
        return refused_fit(f"{len(both)} correspondences in the whole log, at least 4 are needed", len(both)), "none"
    of_ground = replace(options, sigma_px=GROUND_SIGMA_PX, sigma_m=GROUND_SIGMA_M)
    return estimate_homography(both, of_ground, rng=rng), "obstacles and ground points"
