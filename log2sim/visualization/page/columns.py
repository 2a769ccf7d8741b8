"""Columns of a page: whole numbers that a browser sums up again."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

# Columns are stored as whole numbers of 0.1 ms, mm, 0.1 mrad and mm/s; standard deviations of cm, mrad and cm/s; predictions of
# cm and mrad.
SCALES = {
    "t_s": 1e4, "x_m": 1e3, "y_m": 1e3, "yaw_rad": 1e4, "speed_mps": 1e3, "vx_mps": 1e3, "vy_mps": 1e3,
    "sigma_xy_m": 1e2, "sigma_yaw_rad": 1e3, "sigma_speed_mps": 1e2,
    "dx_m": 1e2, "dy_m": 1e2, "course_rad": 1e3, "along_m": 1e2, "across_m": 1e2,
}  # fmt: skip


def second_differences(values: ArrayLike, scale: float) -> list[int]:
    """Compute second differences (T,) of a column in whole units of 1 / `scale`; two cumulative sums restore it exactly."""
    whole = np.rint(np.asarray(values, dtype=np.float64) * scale).astype(np.int64)
    return list(np.diff(whole, n=2, prepend=[0, 0]).tolist())
