"""Tables of single agents: matched, false and ignored."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from log2sim.evaluation.metrics.align import StateTable
from log2sim.evaluation.metrics.comparison import Comparison, coverage
from log2sim.evaluation.metrics.pairs import Mask
from log2sim.evaluation.metrics.state_errors import median, root_mean_square, state_errors

DIGITS = 6


def agent_rows(c: Comparison) -> list[dict[str, Any]]:
    """Make one row per counted truth agent: its matches and errors; size errors are signed."""
    truth, other, counted, switched = c.truth, c.other, c.counted, c.switched
    errors = state_errors(truth, other, c.match, counted)
    rows, rows_of = [], np.broadcast_to(np.arange(len(truth.ids))[:, None], counted.shape)
    for i in np.flatnonzero(counted.any(1)):
        mine, covered = errors.take(errors.truth == i), coverage(c, rows_of == i)
        ids, ticks = np.unique(mine.other, return_counts=True)
        size = mine.size_m.mean(axis=0) if len(mine.other) else np.full(3, np.nan)
        headed = mine.yaw_rad[np.isfinite(mine.yaw_rad)]
        rows.append(
            {
                "id": truth.ids[i],
                "category": str(truth.category[i]),
                "ticks": int(counted[i].sum()),
                "matched": len(mine.other),
                **{key: covered[key] for key in ("labeled", "hit", "hit_matched")},
                "matched_ids": {other.ids[j]: int(n) for j, n in zip(ids, ticks)},
                "id_switches": int(switched[i].sum()),
                "mean_range_m": float(truth.range_m[i, counted[i]].mean()),
                "position_rmse_m": root_mean_square(mine.position_m),
                "yaw_median_deg": median(np.degrees(headed)),
                "speed_rmse_mps": root_mean_square(mine.speed_mps),
                "length_error_m": float(size[0]),
                "width_error_m": float(size[1]),
                "height_error_m": float(size[2]),
            }
        )
    return rows


def false_rows(other: StateTable, false: Mask, hit: Mask) -> list[dict[str, Any]]:
    """Make one row per reconstructed agent that is false at some tick."""
    return [
        {
            "id": other.ids[j],
            "category": str(other.category[j]),
            "false_ticks": int(false[j].sum()),
            "matched_ticks": int(hit[j].sum()),
            "ticks": int(other.present[j].sum()),
            "mean_range_m": float(other.range_m[j, false[j]].mean()),
        }
        for j in np.flatnonzero(false.any(1))
    ]


def ignored_rows(other: StateTable, ignored: Mask) -> list[dict[str, Any]]:
    """Make one row per reconstructed agent that is ignored at some tick."""
    return [
        {
            "id": other.ids[j],
            "category": str(other.category[j]),
            "ignored_ticks": int(ignored[j].sum()),
            "ticks": int(other.present[j].sum()),
            "mean_range_m": float(other.range_m[j, ignored[j]].mean()),
        }
        for j in np.flatnonzero(ignored.any(1))
    ]


def rounded_tree(value: Any) -> Any:
    """Round all floats of a document to six decimals; a value that is not finite becomes None."""
    if isinstance(value, dict):
        return {k: rounded_tree(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [rounded_tree(v) for v in value]
    if isinstance(value, float):
        return round(value, DIGITS) if math.isfinite(value) else None
    return value
