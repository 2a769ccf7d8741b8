"""Errors of position, yaw, speed and size over matched agents."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.evaluation.metrics.align import StateTable
from log2sim.evaluation.metrics.pairs import Index, Mask
from log2sim.geometry import Array, wrap_angle

MIN_WALKING_MPS = 0.5
"""The heading of a slower pedestrian does not count."""


@dataclass(frozen=True, eq=False)
class StateErrors:
    """Errors of K matched agent-ticks.

    Attributes
    ----------
    truth, tick, other : (K,) int64
        Indices of the truth agent, the tick and the reconstructed agent.
    position_m : (K,) float64
        2D distance of box centers.
    yaw_rad : (K,) float64
        Absolute, in [0, pi]; NaN where yaw does not count.
    speed_mps : (K,) float64
        Signed.
    size_m : (K, 3) float64
        Signed errors of length, width, height.
    """

    truth: Index
    tick: Index
    other: Index
    position_m: Array
    yaw_rad: Array
    speed_mps: Array
    size_m: Array

    def take(self, index: Mask) -> StateErrors:
        """Return the rows at `index`."""
        return StateErrors(
            self.truth[index],
            self.tick[index],
            self.other[index],
            self.position_m[index],
            self.yaw_rad[index],
            self.speed_mps[index],
            self.size_m[index],
        )


def state_errors(truth: StateTable, other: StateTable, match: NDArray[np.int64], counted: Mask) -> StateErrors:
    """Compare matched states at the counted ticks.

    Notes
    -----
    Yaw counts for vehicles, two-wheelers and pedestrians of at least 0.5 m/s. The speed of a box turned by more than 90
    degrees is taken along the truth's heading, so that a flipped box is an error of yaw only.
    """
    i, t = np.nonzero(counted & (match >= 0))
    j = match[i, t]
    gap = other.xy_m[j, t] - truth.xy_m[i, t]
    yaw = np.abs(wrap_angle(other.yaw_rad[j, t] - truth.yaw_rad[i, t]))
    sign = np.where(yaw > np.pi / 2, -1.0, 1.0)
    walking = (truth.group[i] != "pedestrian") | (np.abs(truth.speed_mps[i, t]) >= MIN_WALKING_MPS)
    headed = walking & (truth.group[i] != "other")
    return StateErrors(
        truth=i,
        tick=t,
        other=j,
        position_m=np.hypot(gap[:, 0], gap[:, 1]),
        yaw_rad=np.where(headed, yaw, np.nan),
        speed_mps=sign * other.speed_mps[j, t] - truth.speed_mps[i, t],
        size_m=other.size_m[j] - truth.size_m[i],
    )


def summarize(errors: StateErrors) -> dict[str, float | None]:
    """Summarize all rows; a figure without rows is None.

    Notes
    -----
    Sizes are constant per agent, so their medians run over truth agents, each with its mean over matched ticks;
    `size_median_m` is the median of the mean absolute error over length, width and height. `ade_m` is the mean over
    truth agents of their mean distance.
    """
    headed = errors.yaw_rad[np.isfinite(errors.yaw_rad)]
    by_agent = agent_means(errors.truth, np.column_stack([np.abs(errors.size_m), errors.position_m]))
    return {
        "position_rmse_m": root_mean_square(errors.position_m),
        "position_median_m": median(errors.position_m),
        "ade_m": float(by_agent[:, 3].mean()) if len(by_agent) else None,
        "yaw_median_deg": median(np.degrees(headed)),
        "yaw_flipped": float(np.mean(headed > np.pi / 2)) if len(headed) else None,
        "speed_rmse_mps": root_mean_square(errors.speed_mps),
        "size_median_m": median(by_agent[:, :3].mean(axis=1)),
        "length_median_m": median(by_agent[:, 0]),
        "width_median_m": median(by_agent[:, 1]),
        "height_median_m": median(by_agent[:, 2]),
    }


def agent_means(agent: Index, values: Array) -> Array:
    """Average values (K, V) over the rows of each agent that occurs in `agent` (K,): (A', V)."""
    names, index, count = np.unique(agent, return_inverse=True, return_counts=True)
    total = np.zeros((len(names), values.shape[1]))
    np.add.at(total, index, values)
    return total / count[:, None]


def root_mean_square(values: Array) -> float | None:
    """Compute the root mean square of values (K,); None without any."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def median(values: Array) -> float | None:
    """Compute the median of values (K,); None without any."""
    return float(np.median(values)) if len(values) else None
