"""One homography that most correspondences of a stream agree with, by RANSAC with local optimization; its health and acceptance."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.files.documents import rounded
from log2sim.geometry import CHI2_2DOF_99, Array, apply_homography, median
from log2sim.perception.homography.normalized import (
    Linearization,
    NormalizedCorrespondences,
    bounded_losses,
    linearize,
    nearest_poses,
    newton_step,
    noise_factors,
    normalize,
    pose_tangent,
    refine,
    scale_free_basis,
)

# No three of four points may be collinear: twice the area of their smallest triangle, for data of spread 1.
MIN_TRIANGLE_AREA = 1e-7
# Rows that hypotheses are scored on.
SCORED_ROWS = 120
# A homography through four noisy points misses the other points by more than the noise, so hypotheses are scored with
# standard deviations this much larger.
SAMPLE_SIGMA_SCALE = 2.0


def draw_samples(
    data: NormalizedCorrespondences, rng: np.random.Generator, count: int, *, across_ticks: bool
) -> NDArray[np.int64]:
    """Draw rows (4, count), each sample from one tick or, with `across_ticks`, from all; rows may repeat."""
    rows, chance = data.image.shape[1], rng.random((4, count))
    if across_ticks:
        return np.asarray((chance * rows).astype(np.int64))
    # Larger ticks hold more samples of four, so a tick is drawn in proportion to its size.
    which = data.tick[(rng.random(count) * rows).astype(np.int64)]
    return np.asarray(data.start[which] + (chance * data.count[which]).astype(np.int64))


def solve_samples(data: NormalizedCorrespondences, rows: NDArray[np.int64], max_hypotheses: int) -> Array:
    """Solve for homographies (K, 3, 3), ground to image, through four correspondences each (4, count).

    Samples with three collinear points and samples with a point behind the camera are left out. Of the rest the
    `max_hypotheses` samples of the largest spread are kept.

    Three points are a basis in which the fourth has coordinates that are areas of triangles, so the homography between
    two such bases needs no decomposition (Hartley & Zisserman, Multiple View Geometry, 2004, section 2.3).
    """
    points = np.concatenate([data.image, data.ground[:2]]).take(rows, axis=1).reshape(2, 2, *rows.shape)
    # Twice the signed areas (4, 2, count) of the triangles in the image and on the ground: in rows 0 to 2 the fourth point
    # replaces one of the first three; row 3 is the triangle of the first three.
    (ax, bx, cx), (ay, by, cy) = (points[:, :, 1:] - points[:, :, :1]).transpose(1, 2, 0, 3)
    areas = np.empty((4, *ax.shape))
    areas[3] = ax * by - ay * bx
    areas[2] = ax * cy - ay * cx
    areas[1] = by * cx - bx * cy
    areas[0] = areas[3] - areas[2] - areas[1]
    # The depths of the four points have one sign if the signs of the areas agree, or disagree, for all triangles.
    product = areas[:, 0] * areas[:, 1]
    lowest, highest = product.min(axis=0), product.max(axis=0)
    spread = np.maximum(lowest, -highest)
    usable = np.flatnonzero(spread > MIN_TRIANGLE_AREA**2)
    if len(usable) > max_hypotheses:
        usable = usable[np.argpartition(-spread[usable], max_hypotheses)[:max_hypotheses]]
    (u, v), ground = points[:, :, :3].take(usable, axis=3)
    in_image, on_ground = areas.take(usable, axis=2).transpose(1, 0, 2)
    depth = np.abs(in_image[:3] / on_ground[:3]) * np.sign(on_ground[3])
    columns, adjugate = np.concatenate([u * depth, v * depth, depth]).reshape(3, *u.shape), np.empty((3, *u.shape))
    (x1, x2), (y1, y2) = ground[:, [[1, 2, 0], [2, 0, 1]]]
    adjugate[0], adjugate[1], adjugate[2] = y1 - y2, x2 - x1, x1 * y2 - y1 * x2
    return np.asarray(columns.transpose(2, 0, 1) @ adjugate.transpose(2, 1, 0), dtype=np.float64)


# Rounds: samples of four to draw, how many of them are solved and scored, and the share of inliers below which the next one runs.
# Of 500 samples six are free of outliers where two thirds are outliers, of which about half are scored.
RansacSchedule = tuple[tuple[int, int, float], ...]
RANSAC_SCHEDULE: RansacSchedule = ((500, 64, 0.35), *[(500, 64, 0.3)] * 6)
RANSAC_SCHEDULE_OF_A_FRAME: RansacSchedule = ((120, 48, 0.5), (500, 96, 0.0))
# Local optimization of the best hypotheses, on some rows.
OPTIMIZED_HYPOTHESES = 2
OPTIMIZATION_ROWS = 160
# The pose nearest to a homography misses what the homography fits, most of all with few correspondences.
POSE_GATES = (100 * CHI2_2DOF_99, 16 * CHI2_2DOF_99, 4 * CHI2_2DOF_99, CHI2_2DOF_99)
NOISE_ROUNDS, FINAL_ROUNDS = 2, 2


@dataclass(frozen=True, eq=False)
class RobustFit:
    """A homography estimated from correspondences with outliers, in normalized units."""

    data: NormalizedCorrespondences  # all correspondences, with the noise as estimated
    linear: Linearization | None  # errors on them; None where no four correspondences determine a homography
    # (N, 3, 3): image homography of each correspondence's tick on top of `h`, see `pitch_roll`
    warps: Array | None = None
    effective_parameters: float = 0.0  # effective number of parameters of `warps`


def ransac(
    data: NormalizedCorrespondences,
    rng: np.random.Generator,
    *,
    image_K: Array | None = None,
    schedule: RansacSchedule = RANSAC_SCHEDULE,
    refined: bool = True,
) -> RobustFit:
    """Estimate the homography of least bounded loss from samples of single ticks and of all ticks.

    `image_K`: (3, 3): normalized intrinsics, for a pose of that camera. `refined`: over all inliers, which tell the noise.

    LO-RANSAC (Chum, Matas & Kittler, 2003) with the bounded loss of MSAC (Torr & Zisserman, 2000).
    """
    count, best_score = data.image.shape[1], np.inf
    best: Linearization | None = None
    sigmas = SAMPLE_SIGMA_SCALE * data.sigma_image, SAMPLE_SIGMA_SCALE * data.sigma_ground
    scored = data.products.take(rng.permutation(count)[:SCORED_ROWS], axis=1).astype(np.float32)
    part = data if count <= 2 * OPTIMIZATION_ROWS else data.take(rng.permutation(count)[:OPTIMIZATION_ROWS])
    for k, (samples, solved, min_inlier_share) in enumerate(schedule):
        # Ticks where the first round finds nothing may hold fewer than four inliers each.
        sources = (True,) if k else (False, True)
        rows = [draw_samples(data, rng, samples // len(sources), across_ticks=across) for across in sources]
        hypotheses = solve_samples(data, np.concatenate(rows, axis=1), solved)
        losses = bounded_losses(scored, *sigmas, hypotheses)
        if losses.min(initial=np.inf) < best_score:
            best_score, optimized = losses.min(), []
            for h in hypotheses[losses.argsort()[:OPTIMIZED_HYPOTHESES]]:
                linear = linearize(part, h)
                optimized.append(linearize(data, newton_step(linear, share=linear.bounded_weights)[0]))
            linear = min(optimized, key=lambda of: of.loss)
            if image_K is not None:
                h = nearest_poses(image_K, linear.h[None])[0]
                for gate in POSE_GATES:
                    linear = linearize(part, h)
                    h, _ = newton_step(linear, image_K, linear.squared < gate)
                linear = linearize(data, h)
            if linear.loss < (np.inf if best is None else best.loss):  # NaN where there is no such pose
                best = linear
        # The four rows of a sample agree by themselves.
        if best is not None and np.count_nonzero(best.inliers) - 4 > min_inlier_share * (count - 4):
            break
    if best is not None and refined:
        # The gate of the assumed noise may let outliers in, so the noise is estimated again behind that of the first estimate.
        for _ in range(NOISE_ROUNDS):
            h = newton_step(best, image_K)[0]
            data = data.scale_noise(*noise_factors(best, 8 if image_K is None else 6))
            best = linearize(data, h)
        best = refine(best, FINAL_ROUNDS, image_K)
    return RobustFit(data, best)


# Ratio of the eighth to the first singular value of the normalized DLT matrix: about 0.3 for points that spread over the
# view, 1e-17 for collinear points.
MIN_S8_S1 = 2e-3
# Six correspondences exceed the eight parameters by four equations; of fewer rows all four of a minimal sample.
MIN_INLIERS = 6
MIN_INLIER_SHARE = 0.2
# Largest predicted standard deviation on the ground, one spread of the inliers from their mean, as a share of the spread.
MAX_RELATIVE_SIGMA = 0.25
# Ground points at which it is predicted, in units of that spread.
PROBES = np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0], [1.0, 1.0, 1.0, 1.0]])


def homography_covariance(h: Array, back: Array, normal: Array, image_K: Array | None) -> Array | None:
    """Compute the covariance (9, 9) of the elements of `back`, the inverse of `h` (3, 3), row by row; ground to image and normalized units for `h`.

    `normal` (9, 9): normal matrix of the correspondences that it was fitted to. None where they do not determine it.
    """
    basis = scale_free_basis(h) if image_K is None else pose_tangent(image_K, h)
    normal = basis.T @ normal @ basis
    size = np.sqrt(np.maximum(normal.diagonal(), 1e-300))
    try:
        inverse = np.linalg.inv(normal / size[:, None] / size)
    except np.linalg.LinAlgError:
        return None
    if not np.abs(inverse).max() < 1e13:
        return None
    by_parameters = by_elements(back, back) @ (basis / size)
    return np.asarray(by_parameters @ inverse @ by_parameters.T)


def by_elements(left: NDArray[np.floating[Any]], right: NDArray[np.floating[Any]]) -> Array:
    """Build the matrix (9, 9) that takes the elements of `m`, row by row, to those of `left @ m @ right`, all (3, 3)."""
    return np.asarray((left[:, None, :, None] * right.T[None, :, None, :]).reshape(9, 9), dtype=np.float64)


def ground_covariances(ground_H_image: Array, covariance: Array, uv: Array) -> Array:
    """Compute the covariances (N, 2, 2) that a homography (3, 3) of covariance (9, 9) gives the ground positions of pixels (N, 2)."""
    pixel = np.ones((len(uv), 3))
    pixel[:, :2] = uv
    q, by_h = pixel @ ground_H_image.T, np.zeros((len(uv), 2, 9))
    pixel /= q[:, 2:]
    by_h[:, 0, 0:3] = by_h[:, 1, 3:6] = pixel
    by_h[:, :, 6:] = -(q[:, :2] / q[:, 2:])[:, :, None] * pixel[:, None]
    return np.asarray(by_h @ covariance @ by_h.swapaxes(1, 2))


# Ground points straight ahead, m, at which the jitter of a homography is measured.
JITTER_PROBES_M = np.array([[10.0, 0.0], [20.0, 0.0], [40.0, 0.0]])


@dataclass(frozen=True)
class PitchRoll:
    """Outcome of the decision, with the movement that was estimated."""

    per_tick: bool  # whether each tick has its own pitch and roll
    source: str  # correspondences that the angles were estimated from
    # `pitch_sigma_deg`, `roll_sigma_deg`: standard deviations of the angles over the ticks, degrees
    pitch_sigma_deg: float
    roll_sigma_deg: float
    # Median error of held-out correspondences in the image with one homography and with one a tick, px
    held_out_px: tuple[float, float]
    significance: float  # fall of the held-out loss in standard errors

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
class RoadSlope:
    """A second plane of the road, which begins at a line of the map on the other side than the ego."""

    line: Array  # (3,): of the map: `line @ (x, y, 1)` is the distance from it, m
    change: float  # by how much the road rises beyond the line against the plane before it, m a meter
    sigma: float  # its standard deviation
    # Median error of held-out correspondences in the image with one plane and with two, px
    held_out_px: tuple[float, float]
    significance: float  # fall of the held-out loss in standard errors

    def to_dict(self) -> dict[str, Any]:
        """Convert to a JSON document, as it is written in scenarios and reports."""
        before, after = self.held_out_px
        return {
            "line": [rounded(float(v), 4) for v in self.line],
            "change": rounded(self.change, 5),
            "sigma": rounded(self.sigma, 5),
            "held_out_px": {"one_plane": rounded(before, 3), "two_planes": rounded(after, 3)},
            "significance": rounded(self.significance, 2),
        }


@dataclass(frozen=True, eq=False)
class HomographyFit:
    """A homography from the image to the ground, and its health."""

    ok: bool  # whether it is accepted; False comes with a reason and NaN in `ground_H_image`
    reason: str  # why it is refused, "" otherwise
    # (3, 3): undistorted px to the ground (x forward, y left), m; the third row is a unit vector, positive below the horizon
    ground_H_image: Array
    inliers: NDArray[np.bool_]  # (N,): inliers of the final model
    error_m: float  # median distance of the inliers on the ground, m
    condition: float  # ratio s1/s8 of the singular values of the inliers' normalized design matrix
    # (T,): ticks that had correspondences, ascending
    ticks: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    # (T, 3, 3): one homography a tick, where the camera pitches or the method fits single frames; NaN where a tick has none
    per_tick: Array | None = None
    # Standard deviation of the homography on the ground, m, one spread of the inliers from their mean
    sigma_m: float = float("nan")
    # (9, 9): of the elements of `ground_H_image`, row by row, by the noise of the inliers; None where it is not known
    covariance: Array | None = None
    # (T, 2, 3, 3): by how much `per_tick` changes with one standard deviation of the pitch and of the roll of a tick
    tick_sigmas: Array | None = None
    # Whether each tick has its own pitch and roll, and by how much they vary; None where that was not tested
    pitch_roll: PitchRoll | None = None
    slope: RoadSlope | None = None  # a second plane of the road, where held-out errors ask for it

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

    def covariance_at(self, tick: int) -> Array | None:
        """Return the covariance (9, 9) of the elements of `at_tick`, with that of the tick's angles; None where it is not known."""
        if self.covariance is None or self.tick_sigmas is None:
            return self.covariance
        k = int(np.searchsorted(self.ticks, tick))
        if k >= len(self.ticks) or self.ticks[k] != tick:
            k = int(np.abs(self.tick_sigmas).sum(axis=(1, 2, 3)).argmax())
        by_angle = self.tick_sigmas[k].reshape(2, 9)
        return np.asarray(self.covariance + by_angle.T @ by_angle)

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
    """Accept or refuse a homography by the number and the geometry of its inliers, and convert it to px and m.

    Every two effective parameters of single ticks make an inlier without evidence, so as many more are required.
    """
    data, linear, rows = robust.data, robust.linear, robust.data.image.shape[1]
    if linear is None:
        return refused_fit("every sample of four is collinear or coincident", rows)
    inliers, absorbed = linear.inliers, robust.effective_parameters / 2
    count, minimum = int(np.count_nonzero(inliers)), 4 if rows < MIN_INLIERS else MIN_INLIERS
    needed = max(minimum, int(np.ceil(absorbed + MIN_INLIER_SHARE * (rows - absorbed))))
    if count < needed:
        return refused_fit(f"{count} of {rows} correspondences agree, at least {needed} are needed", rows)
    # Singular values, descending, of the DLT matrix of the inliers, normalized anew.
    rows_in = np.flatnonzero(inliers)
    image, ground = data.image.take(rows_in, axis=1), data.ground[:2].take(rows_in, axis=1)
    inlier_N_ground, (x, y) = normalize(ground)
    image_rows = np.concatenate([normalize(image)[1], np.ones((1, count))])
    products, gram = np.concatenate([image_rows, image_rows * x, image_rows * y]), np.zeros((9, 9))
    sums = products @ products.T
    gram[0:3, 0:3] = gram[3:6, 3:6] = sums[0:3, 0:3]
    gram[0:6, 6:9] = -sums[3:9, 0:3]
    gram[6:9, 0:6] = gram[0:6, 6:9].T
    gram[6:9, 6:9] = sums[3:6, 3:6] + sums[6:9, 6:9]
    s = np.sqrt(np.maximum(np.linalg.eigvalsh(gram)[::-1], 0.0))
    if image_K is None and s[7] < MIN_S8_S1 * s[0]:
        return refused_fit(f"the {count} correspondences that agree lie on a line or a point", rows)
    back = np.asarray(np.linalg.inv(linear.h), dtype=np.float64)
    covariance = homography_covariance(linear.h, back, linear.inlier_equations[0], image_K)
    # The standard deviation on the ground that it predicts one spread of the inliers from their mean, normalized units.
    spread, sigma = float(1.0 / inlier_N_ground[0, 0]), float("inf")
    if covariance is not None:
        q: Array = linear.h @ np.linalg.solve(inlier_N_ground, PROBES)
        q = q[:, q[2] > 0]
        variance = ground_covariances(back, covariance, (q[:2] / q[2]).T).trace(axis1=1, axis2=2)
        sigma = float(np.sqrt(variance.max())) if len(variance) else sigma
    scale = data.ground_N_m[0, 0]
    if not sigma < MAX_RELATIVE_SIGMA * spread:
        reason = (
            f"the {count} correspondences that agree do not determine a homography: it would be off by "
            f"{sigma / scale:.1f} m where they spread over {spread / scale:.1f} m"
        )
        return refused_fit(reason, rows)
    if robust.warps is not None:
        still = np.linalg.solve(robust.warps[inliers], np.vstack([image, np.ones(count)]).T[:, :, None])[:, :, 0].T
        image = still[:2] / still[2]
    q = back[:, :2] @ image + back[:, 2:]
    error_m = median(np.hypot(*(q[:2] / q[2] - ground))) / scale
    condition, m_N_ground = float(s[0] / s[7]) if s[7] > 0 else float("inf"), np.linalg.inv(data.ground_N_m)
    ground_H_image = m_N_ground @ back @ data.image_N_px
    size = np.linalg.norm(ground_H_image[2])
    if covariance is not None:
        to_px = by_elements(m_N_ground, data.image_N_px) / size
        covariance = to_px @ covariance @ to_px.T
    h, sigma_m = ground_H_image / size, float(sigma / scale)
    return HomographyFit(True, "", h, inliers, error_m, condition, sigma_m=sigma_m, covariance=covariance)
