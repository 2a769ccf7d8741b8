"""Result of estimating a camera's homography, with its health."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.documents import rounded
from log2sim.geometry import Array, apply_homography
from log2sim.perception.homography.normalized import CHI2_2DOF_99
from log2sim.perception.homography.ransac import RobustFit
from log2sim.perception.homography.validation import validate_fit

# Ground points straight ahead, m, at which the jitter of a homography is measured.
JITTER_PROBES_M = np.array([[10.0, 0.0], [20.0, 0.0], [40.0, 0.0]])


@dataclass(frozen=True)
class PitchRoll:
    """Outcome of the decision, with the movement that was estimated.

    Attributes
    ----------
    per_tick : bool
        Whether each tick has its own pitch and roll.
    source : str
        Correspondences that the angles were estimated from.
    pitch_sigma_deg, roll_sigma_deg : float
        Standard deviations of the angles over the ticks, degrees.
    held_out_px : (float, float)
        Median error of held-out correspondences in the image with one homography and with one a tick, px.
    significance : float
        Fall of the held-out loss in standard errors.
    """

    per_tick: bool
    source: str
    pitch_sigma_deg: float
    roll_sigma_deg: float
    held_out_px: tuple[float, float]
    significance: float

    def to_dict(self) -> dict[str, Any]:
        """Convert to a JSON document, as it is written in scenarios and reports."""
        before, after = self.held_out_px
        return {
            "per_tick": self.per_tick,
            "source": self.source,
            "pitch_sigma_deg": rounded(self.pitch_sigma_deg, 4),
            "roll_sigma_deg": rounded(self.roll_sigma_deg, 4),
            "held_out_px": {"fixed": rounded(before, 3), "per_tick": rounded(after, 3)},
            "significance": rounded(self.significance, 2),
        }


@dataclass(frozen=True, eq=False)
class HomographyFit:
    """A homography from the image to the ground, and its health.

    Attributes
    ----------
    ok : bool
        Whether it is accepted; False comes with a reason and NaN in `ground_H_image`.
    reason : str
        Why it is refused, "" otherwise.
    ground_H_image : (3, 3) float64
        Undistorted pixels to ground positions (x forward, y left), m; the third row is a unit vector, positive below the
        horizon.
    inliers : (N,) bool
        Inliers of the final model.
    error_m : float
        Median distance of the inliers on the ground, m.
    condition : float
        Ratio s1/s8 of the singular values of the inliers' normalized design matrix.
    ticks : (T,) int64
        Ticks that had correspondences, ascending.
    per_tick : (T, 3, 3) float64 or None
        One homography a tick, where the camera pitches or the method fits single frames; NaN where a tick has none.
    sigma_m : float
        Standard deviation of the homography on the ground, m, one spread of the inliers from their mean.
    pitch_roll : PitchRoll or None
        Whether each tick has its own pitch and roll, and by how much they vary; None where that was not tested.
    """

    ok: bool
    reason: str
    ground_H_image: Array
    inliers: NDArray[np.bool_]
    error_m: float
    condition: float
    ticks: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    per_tick: Array | None = None
    sigma_m: float = float("nan")
    pitch_roll: PitchRoll | None = None

    def at_tick(self, tick: int) -> Array | None:
        """Return the homography (3, 3) of a tick; None where a method of single frames has none for it."""
        if not self.ok:
            return None
        if self.per_tick is None:
            return self.ground_H_image
        k = int(np.searchsorted(self.ticks, tick))
        if k < len(self.ticks) and self.ticks[k] == tick:
            return np.asarray(self.per_tick[k]) if np.isfinite(self.per_tick[k]).all() else None
        return None if self.pitch_roll is None else self.ground_H_image

    @property
    def jitter_m(self) -> float:
        """Median distance, m, by which points 10, 20 and 40 m ahead move from tick to tick; 0 for one homography.

        NaN when nothing was fitted.
        """
        if not self.ok:
            return float("nan")
        if self.per_tick is None:
            return 0.0
        known = self.per_tick[np.isfinite(self.per_tick).all(axis=(1, 2))]
        image_H_ground = np.linalg.inv(self.ground_H_image)
        image = JITTER_PROBES_M @ image_H_ground[:, :2].T + image_H_ground[:, 2]
        uv = image[:, :2] / image[:, 2:]
        ground = np.array([apply_homography(h, uv)[0] for h in known])
        if len(ground) < 2:
            return float("nan")
        moved = np.hypot(*np.moveaxis(np.diff(ground, axis=0), -1, 0))
        return float(np.median(moved[np.isfinite(moved)])) if np.isfinite(moved).any() else float("nan")


def refused_fit(reason: str, count: int, ticks: NDArray[Any] | None = None) -> HomographyFit:
    """Make the fit of `count` correspondences that was refused for a reason."""
    ticks = np.zeros(0, dtype=np.int64) if ticks is None else ticks
    none = np.full((3, 3), np.nan)
    return HomographyFit(False, reason, none, np.zeros(count, dtype=bool), float("nan"), float("inf"), ticks)


def validated_fit(robust: RobustFit, image_K: Array | None = None) -> HomographyFit:
    """Validate a homography and convert it to px and m."""
    data, count = robust.data, robust.data.image.shape[1]
    if robust.h is None or robust.linear is None:
        return refused_fit("every sample of four is collinear or coincident", count)
    health = validate_fit(data, robust.h, robust.linear, image_K, robust.effective_parameters)
    if not health.ok:
        return refused_fit(health.reason, count)
    inliers = robust.linear.squared[0] < CHI2_2DOF_99
    ground_H_image = data.to_ground_H_image(robust.h)
    image = np.vstack([data.image, np.ones((1, count))])
    if robust.warps is not None:
        image = np.linalg.solve(robust.warps, image.T[:, :, None])[:, :, 0].T
    back = np.linalg.inv(robust.h) @ image
    error = np.hypot(*(back[:2] / back[2] - data.ground[:2])[:, inliers]) / data.ground_N_m[0, 0]
    return HomographyFit(
        True, "", ground_H_image, inliers, float(np.median(error)), health.condition, sigma_m=health.sigma_m
    )
