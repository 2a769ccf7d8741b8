"""Correspondences between the image and the ground, and the baselines that the time-aware homography is compared with.

"per-frame" runs one RANSAC for each frame, "min-frame" keeps of all frames' homographies the one of least error over all
frames, and "straw-man" is "per-frame" with ground positions from average sizes instead of a LiDAR. "per-frame-skimage" is
"per-frame" by the RANSAC of scikit-image.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import TYPICAL_SIZE_M, Measurements
from log2sim.files.arrays import Columns
from log2sim.geometry import CHI2_2DOF_99, Array, Camera, undistort
from log2sim.perception.boxes import quantile_of_sorted
from log2sim.perception.homography.fit import HomographyFit, RobustFit, refused_fit, validated_fit
from log2sim.perception.homography.normalized import NormalizedCorrespondences, bounded_losses, linearize

# Heights of cars differ by about a tenth (standard deviation), and so does a range derived from them.
SIZE_SIGMA_SHARE = 0.1
# Trials of scikit-image's RANSAC for a frame, and the probability of an outlier-free sample at which it stops.
SKIMAGE_TRIALS, SKIMAGE_STOP_PROBABILITY = 1000, 0.999
# Ratio of the eighth to the first singular value of the design matrix below which a sample is collinear.
MIN_SAMPLE_S8_S1 = 1e-6

FrameEstimator = Callable[[NormalizedCorrespondences], RobustFit]


def fit_frames(data: NormalizedCorrespondences, estimate: FrameEstimator, *, keep_all: bool) -> HomographyFit:
    """Fit one homography a frame, then choose the one of least error over all frames.

    `estimate` fits the correspondences of one frame; `keep_all` also returns the single frames' fits as `per_tick`.
    """
    per_tick = np.full((len(data.start), 3, 3), np.nan)
    hypotheses: list[Array] = []
    for k, (start, count) in enumerate(zip(data.start, data.count)):
        if count < 4:
            continue
        robust = estimate(data.take(slice(start, start + count)))
        fit = validated_fit(robust)
        if fit.ok and robust.linear is not None:
            per_tick[k] = fit.ground_H_image
            hypotheses.append(robust.linear.h)
    if not hypotheses:
        return refused_fit("no frame has correspondences that determine a homography", data.image.shape[1])
    losses = bounded_losses(data.products, data.sigma_image, data.sigma_ground, np.array(hypotheses))
    fit = validated_fit(RobustFit(data, linearize(data, hypotheses[int(losses.argmin())])))
    return replace(fit, per_tick=per_tick if keep_all and fit.ok else None)


class HomographyModel:
    """Homography from normalized ground to image, as `skimage.measure.ransac` asks for it: `estimate` and `residuals`."""

    h: Array  # (3, 3)

    @classmethod
    def from_estimate(cls, ground: Array, image: Array) -> HomographyModel | None:
        """Fit a model to points (N, 2), (N, 2); None where they do not determine one."""
        model = cls()
        return model if model.estimate(ground, image) else None

    def estimate(self, ground: Array, image: Array) -> bool:
        """Fit by the direct linear transform to points (N, 2), (N, 2); False where they do not determine one."""
        (x, y), (u, v) = ground.T, image.T
        one, zero = np.ones_like(x), np.zeros_like(x)
        of_u = np.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], axis=1)
        rows = np.concatenate([of_u, np.stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v], axis=1)])
        # The gram matrix costs the same for any number of points, where a full SVD of the rows costs its square.
        values, vectors = np.linalg.eigh(rows.T @ rows)
        self.h = vectors[:, 0].reshape(3, 3)
        depth = ground @ self.h[2, :2] + self.h[2, 2]
        self.h = self.h * np.sign(np.median(depth))
        return bool(values[1] > MIN_SAMPLE_S8_S1**2 * values[-1])

    def residuals(self, ground: Array, image: Array) -> NDArray[np.float64]:
        """Compute the distances (N,) in the image; infinite behind the camera."""
        q = ground @ self.h[:, :2].T + self.h[:, 2]
        front = q[:, 2] > 0
        projected = q[:, :2] / np.where(front, q[:, 2], 1.0)[:, None]
        return np.where(front, np.hypot(*(projected - image).T), np.inf)


def ransac_skimage(data: NormalizedCorrespondences, rng: np.random.Generator, trials: int | None) -> RobustFit:
    """Fit the correspondences of one frame by `skimage.measure.ransac` with at most so many trials."""
    from skimage.measure import ransac

    # A frame that determines no model is an expected result here, for which scikit-image warns.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        model, _ = ransac(
            (data.ground[:2].T, data.image.T),
            HomographyModel,
            min_samples=4,
            residual_threshold=float(np.sqrt(CHI2_2DOF_99)) * data.sigma_image,
            max_trials=trials or SKIMAGE_TRIALS,
            stop_probability=SKIMAGE_STOP_PROBABILITY,
            rng=rng,
        )
    if not isinstance(model, HomographyModel):
        return RobustFit(data, None)
    return RobustFit(data, linearize(data, model.h / np.linalg.norm(model.h)))


# Fewer LiDAR points leave the nearest side of an obstacle undetermined.
MIN_FOOT_POINTS = 20
# Quantile of the points' distances that is taken for the nearest side, robust to stray points.
NEAREST_SIDE_QUANTILE = 0.05


@dataclass(frozen=True, eq=False)
class Correspondences(Columns):
    """Pixels of one camera and the ground positions that they show.

    Raises `ValueError` for arrays of other shapes.
    """

    uv: Array  # (N, 2): pixels, free of lens distortion
    xy_ego: Array  # (N, 2): ground positions, m, in a frame that moves with the camera: x forward, y left
    tick: NDArray[np.int64]  # (N,): tick of each correspondence
    # (N, 2): where average sizes put them without a LiDAR, NaN where there is no object; for the baseline "straw-man"
    xy_by_size: Array | None = None

    def __post_init__(self) -> None:
        """Check the shapes."""
        uv, xy, tick = self.uv.shape, self.xy_ego.shape, self.tick.shape
        if uv != xy or len(uv) != 2 or uv[1] != 2 or tick != uv[:1]:
            raise ValueError(f"uv and xy_ego must be (N, 2) and tick (N,), got {uv}, {xy}, {tick}")

    @classmethod
    def join(cls, parts: Sequence[Correspondences]) -> Correspondences:
        """Concatenate several sets; an empty sequence gives an empty set."""
        if not parts:
            return cls(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, dtype=np.int64))
        sized = [np.full((len(p.uv), 2), np.nan) if p.xy_by_size is None else p.xy_by_size for p in parts]
        uv, xy, tick = (np.concatenate([getattr(p, k) for p in parts]) for k in ("uv", "xy_ego", "tick"))
        return cls(uv, xy, tick, np.concatenate(sized))


def undistorted_pixels(camera: Camera, uv: Array) -> Array:
    """Convert pixels (N, 2) to those of a lens without distortion."""
    return undistort(camera, uv) @ camera.K[:2, :2].T + camera.K[:2, 2]


def feet_of_boxes(box_px: Array) -> Array:
    """Return the middles of the lower edges (N, 2) of boxes (N, 4), px."""
    return np.column_stack([(box_px[:, 0] + box_px[:, 2]) / 2, box_px[:, 3]])


def foot_points(camera: Camera, measured: Measurements, ego_T_map: Array, tick: int) -> Correspondences:
    """Find where obstacles touch the ground.

    `ego_T_map`: (4, 4), or of each row (M, 4, 4): at the time at which its foot is seen.

    In the image it is the middle of the box's lower edge, on the ground the point below the nearest side of their LiDAR
    points. Truncated boxes and obstacles with few points are left out.
    """
    kept = measured.kept_points > 0
    good = (measured.source == "lidar") & ~measured.truncated & (measured.points >= MIN_FOOT_POINTS) & kept
    rows = np.flatnonzero(good & (measured.camera == camera.name))
    xy = []
    for k in rows.tolist():
        sensor, cluster = measured.sensor_m[k, :2], measured.cluster[k][:, :2]
        direction = measured.center_m[k, :2] - sensor
        direction /= np.hypot(*direction)
        nearest = quantile_of_sorted(np.sort((cluster - sensor) @ direction), NEAREST_SIDE_QUANTILE)
        foot = np.append(sensor + direction * nearest, measured.bottom_m[k])
        pose = ego_T_map if ego_T_map.ndim == 2 else ego_T_map[k]
        xy.append((pose[:3, :3] @ foot + pose[:3, 3])[:2])
    if not rows.size:
        return Correspondences.join([])
    boxes = measured.box_px[rows]
    feet = undistorted_pixels(camera, feet_of_boxes(boxes))
    # Where their heights in the image and average heights put them; NaN for boxes without height.
    height_m = np.array([TYPICAL_SIZE_M[str(c)][2] for c in measured.category[rows]])
    height_px = boxes[:, 3] - boxes[:, 1]
    ego_T_cam = camera.mount_T_cam if camera.mount == "ego" else ego_T_map.reshape(-1, 4, 4)[0] @ camera.mount_T_cam
    depth = camera.K[1, 1] * height_m / np.where(height_px > 0, height_px, np.nan)
    rays = np.column_stack([(feet - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]], np.ones(len(feet))])
    by_size = np.asarray((rays * depth[:, None]) @ ego_T_cam[:2, :3].T + ego_T_cam[:2, 3])
    return Correspondences(feet, np.array(xy), np.full(len(rows), tick, dtype=np.int64), by_size)
