"""Rigid transforms, rotations, angles, stamps in nanoseconds and poses over time; names and frames as in `log2sim.geometry`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.files.documents import short_repr

NS_PER_S = 1_000_000_000


def period_of(t_ns: NDArray[np.int64]) -> float:
    """Return the median period of stamps (T,), s; 0 for a single one."""
    return float(np.median(np.diff(t_ns))) / NS_PER_S if len(t_ns) > 1 else 0.0


def nearest_index(stamps: NDArray[Any], t: ArrayLike) -> NDArray[np.int64]:
    """Find the nearest stamp to each time.

    `stamps` (F,) ns or s: in ascending order, at least one. `t` scalar or (T,): in the unit of `stamps`. Returns (T,) int64:
    index into `stamps`; of two equally near ones the earlier.
    """
    t = np.atleast_1d(np.asarray(t))
    after = np.minimum(np.searchsorted(stamps, t), len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    earlier = np.abs(stamps[before] - t) <= np.abs(stamps[after] - t)
    return np.where(earlier, before, after).astype(np.int64, copy=False)


Array = NDArray[np.float64]

FLOAT32_MILLIMETER_M = 8192.0
"""From here on neighboring float32 values are 1 mm apart."""

USUAL_SIGMA_M, USUAL_SIGMA_RAD = 0.02, 0.002
"""Standard deviations of position, m, and yaw, rad, of poses of GNSS/INS with RTK or LiDAR odometry."""

OFFSET_STEP_M = 1000.0


def whole_kilometers(points: Array) -> Array:
    """Choose the offset (D,), m, in whole kilometers, that leaves points (N, D) small enough for float32 to keep 1 mm.

    It is 0 on axes on which all points are already.
    """
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    offset = np.round(middle / OFFSET_STEP_M) * OFFSET_STEP_M
    return np.where(np.abs(points).max(axis=0) > FLOAT32_MILLIMETER_M, offset, 0.0)


def shift_poses(map_T_x: Array, offset_m: Array) -> Array:
    """Take an offset (3,), m, off the positions of transforms (..., 4, 4)."""
    shifted = map_T_x.copy()
    shifted[..., :3, 3] -= offset_m
    return shifted


def nearest_rotation(matrix: Array) -> Array:
    """Compute the rotation (3, 3) that is nearest to a matrix (3, 3), by the Frobenius norm.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991, lemma.
    """
    u, _, vt = np.linalg.svd(matrix)
    handedness = np.sign(np.linalg.det(u @ vt))
    return np.asarray((u * [1.0, 1.0, handedness]) @ vt)


def wrap_angle(angle_rad: ArrayLike) -> Array:
    """Wrap angles to [-pi, pi).

    Rounding can carry `mod` to its modulus, which would return +pi; that value is folded back.
    """
    wrapped = np.mod(np.asarray(angle_rad, dtype=np.float64) + np.pi, 2 * np.pi) - np.pi
    return np.asarray(np.where(wrapped >= np.pi, -np.pi, wrapped))


def cos_sin(angle_rad: Array) -> tuple[Array, Array]:
    """Compute cosine and sine (N,), (N,) of angles (N,), to the last bits.

    By the tangent of the half angle, which numpy vectorizes in double precision where it does not vectorize the other
    two: a quarter to two thirds of their time. At odd multiples of pi the tangent is large but finite.
    """
    tangent = np.tan(angle_rad / 2)
    both = 2 / (1 + tangent * tangent)
    return both - 1, both * tangent


def rotation_from_quaternion(q_wxyz: ArrayLike) -> Array:
    """Turn scalar-first unit quaternions (..., 4) into rotation matrices (..., 3, 3)."""
    q = np.asarray(q_wxyz, dtype=np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    xx, yy, zz, xy, xz, yz, wx, wy, wz = x * x, y * y, z * z, x * y, x * z, y * z, w * x, w * y, w * z
    out = np.empty((*q.shape[:-1], 3, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = 1 - 2 * (yy + zz), 2 * (xy - wz), 2 * (xz + wy)
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = 2 * (xy + wz), 1 - 2 * (xx + zz), 2 * (yz - wx)
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = 2 * (xz - wy), 2 * (yz + wx), 1 - 2 * (xx + yy)
    return out


def quaternion_from_rotation(rotation: ArrayLike) -> Array:
    """Turn rotation matrices (..., 3, 3) into scalar-first unit quaternions (..., 4) with w >= 0.

    Takes the largest of the four squared components as pivot (Shepperd, 1978), so no division is ill-conditioned.
    """
    r = np.asarray(rotation, dtype=np.float64)
    d = np.diagonal(r, axis1=-2, axis2=-1)
    trace = d.sum(-1)
    squared = np.stack([1 + trace, 1 + 2 * d[..., 0] - trace, 1 + 2 * d[..., 1] - trace, 1 + 2 * d[..., 2] - trace], -1)
    sums = {
        (0, 1): r[..., 2, 1] - r[..., 1, 2], (0, 2): r[..., 0, 2] - r[..., 2, 0], (0, 3): r[..., 1, 0] - r[..., 0, 1],
        (1, 2): r[..., 0, 1] + r[..., 1, 0], (1, 3): r[..., 0, 2] + r[..., 2, 0], (2, 3): r[..., 1, 2] + r[..., 2, 1],
    }  # fmt: skip
    pivot = np.argmax(squared, axis=-1)
    candidates = np.empty((*r.shape[:-2], 4, 4))
    for i in range(4):
        for j in range(4):
            candidates[..., i, j] = squared[..., i] if i == j else sums[min(i, j), max(i, j)]
    q = np.take_along_axis(candidates, pivot[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., :1] < 0, -q, q))


def rotation_from_rpy(roll_rad: ArrayLike, pitch_rad: ArrayLike, yaw_rad: ArrayLike) -> Array:
    """Compute rotation matrices (..., 3, 3) of intrinsic Z-Y-X angles: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    roll, pitch, yaw = np.broadcast_arrays(*(np.asarray(a, dtype=np.float64) for a in (roll_rad, pitch_rad, yaw_rad)))
    cr, sr, cp, sp, cy, sy = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def yaw_of(rotation: ArrayLike) -> Array:
    """Extract the yaw (...), rad, in [-pi, pi), of rotation matrices or transforms (..., 3|4, 3|4)."""
    r = np.asarray(rotation, dtype=np.float64)
    return wrap_angle(np.arctan2(r[..., 1, 0], r[..., 0, 0]))


def transform(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Assemble 4x4 transforms from rotations (..., 3, 3) and translations (..., 3)."""
    r, t = np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64)
    out = np.zeros((*np.broadcast_shapes(r.shape[:-2], t.shape[:-1]), 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = r, t, 1.0
    return out


def inverse(dst_T_src: Array) -> Array:
    """Invert rigid transforms (..., 4, 4)."""
    rt = np.swapaxes(dst_T_src[..., :3, :3], -1, -2)
    return transform(rt, -(rt @ dst_T_src[..., :3, 3:])[..., 0])


def apply(dst_T_src: Array, points: ArrayLike) -> Array:
    """Transform points (N, 3) by one transform (4, 4), or each by its own (N, 4, 4)."""
    p = np.asarray(points, dtype=np.float64)
    if dst_T_src.ndim == 2:
        return p @ dst_T_src[:3, :3].T + dst_T_src[:3, 3]
    return np.asarray(np.einsum("nij,nj->ni", dst_T_src[:, :3, :3], p) + dst_T_src[:, :3, 3])


def slerp(q0: Array, q1: Array, fraction: Array) -> Array:
    """Interpolate unit quaternions (N, 4) along the shorter arc; `fraction` (N,) may leave [0, 1] to extrapolate."""
    dot = np.sum(q0 * q1, axis=-1)
    q1 = np.where(dot[:, None] < 0, -q1, q1)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    small = angle < 1e-6  # sin(a f) / sin(a) = f up to 1e-13
    sine = np.where(small, 1.0, np.sin(angle))
    w0 = np.where(small, 1 - fraction, np.sin((1 - fraction) * angle) / sine)
    w1 = np.where(small, fraction, np.sin(fraction * angle) / sine)
    q = w0[:, None] * q0 + w1[:, None] * q1
    return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))


# Poses of some logs are 1 ns apart; beyond the ends of a track motion is taken from poses at least this far apart, if there are.
MIN_EXTRAPOLATION_BASE_NS = 10_000_000


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """Poses of the ego over time.

    `t_ns` (P,): strictly increasing absolute stamps. `map_T_ego` (P, 4, 4). `max_gap_s`, s: poses are not interpolated
    between stamps farther apart than this. `extrapolate_s`, s: poses are extrapolated up to this far outside the track.
    `sigma_m`, `sigma_yaw_rad` (P,): standard deviations of the position along each axis, m, and the yaw, rad; None if unknown.
    """

    __repr__ = short_repr

    t_ns: NDArray[np.int64]
    map_T_ego: Array
    max_gap_s: float = 1.0
    extrapolate_s: float = 0.2
    sigma_m: Array | None = None
    sigma_yaw_rad: Array | None = None

    def __post_init__(self) -> None:
        """Check that stamps increase and that there is one pose for each."""
        if len(self.t_ns) == 0 or len(self.t_ns) != len(self.map_T_ego):
            raise ValueError("a pose track needs one pose per stamp and at least one of them")
        if np.any(np.diff(self.t_ns) <= 0):
            raise ValueError("stamps of a pose track must be strictly increasing")
        if any(s is not None and len(s) != len(self.t_ns) for s in (self.sigma_m, self.sigma_yaw_rad)):
            raise ValueError("a pose track with standard deviations needs one per stamp")

    @cached_property
    def _quaternions(self) -> Array:
        return quaternion_from_rotation(self.map_T_ego[:, :3, :3])

    def at(self, t_ns: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Interpolate the pose at stamps (N,) int64 ns: rotation by slerp, translation linearly.

        Returns `map_T_ego` (N, 4, 4) and `valid` (N,): not in gaps over `max_gap_s` or over `extrapolate_s` outside the track.
        """
        t = np.atleast_1d(np.asarray(t_ns, dtype=np.int64))
        if len(self.t_ns) == 1:
            near = np.abs(t - self.t_ns[0]) <= round(self.extrapolate_s * NS_PER_S)
            return np.repeat(self.map_T_ego, len(t), axis=0), near
        i, k = self._neighbors(t)
        span = (self.t_ns[k] - self.t_ns[i]).astype(np.float64)
        fraction = (t - self.t_ns[i]).astype(np.float64) / span
        q = self._quaternions
        position = self.map_T_ego[:, :3, 3]
        rotation = rotation_from_quaternion(slerp(q[i], q[k], fraction))
        poses = transform(rotation, position[i] + fraction[:, None] * (position[k] - position[i]))
        margin = round(self.extrapolate_s * NS_PER_S)
        inside = (t >= self.t_ns[0] - margin) & (t <= self.t_ns[-1] + margin)
        recorded = (t == self.t_ns[i]) | (t == self.t_ns[k])
        return poses, inside & ((span <= self.max_gap_s * NS_PER_S) | recorded)

    def sigmas_at(self, t_ns: ArrayLike) -> Array:
        """Interpolate the standard deviations (N, 2) of position, m, and yaw, rad, at stamps (N,) int64 ns; usual ones where they are not known."""
        t_s = (np.atleast_1d(np.asarray(t_ns, dtype=np.int64)) - self.t_ns[0]) / NS_PER_S
        known_s = (self.t_ns - self.t_ns[0]) / NS_PER_S
        out = np.tile((USUAL_SIGMA_M, USUAL_SIGMA_RAD), (len(t_s), 1))
        for k, sigma in enumerate((self.sigma_m, self.sigma_yaw_rad)):
            if sigma is not None:
                out[:, k] = np.interp(t_s, known_s, sigma)
        return out

    def _neighbors(self, t_ns: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows (N,) before and after stamps; outside the track its end and a row some time away, never two at nearly one time."""
        last = len(self.t_ns) - 1
        after = np.clip(np.searchsorted(self.t_ns, t_ns, side="right"), 1, last)
        start, end = t_ns < self.t_ns[0], t_ns > self.t_ns[-1]
        if not (start.any() or end.any()):
            return after - 1, after
        second = min(int(np.searchsorted(self.t_ns, self.t_ns[0] + MIN_EXTRAPOLATION_BASE_NS)), last)
        early_ns = self.t_ns[-1] - MIN_EXTRAPOLATION_BASE_NS
        second_last = max(int(np.searchsorted(self.t_ns, early_ns, side="right")) - 1, 0)
        return np.where(end, second_last, after - 1), np.where(start, second, after)
