"""Calibration: whether confidences are the share of right agents, and sigmas the size of the errors."""

from __future__ import annotations

from typing import Any

import numpy as np

from log2sim.evaluation.metrics.pairs import Mask
from log2sim.geometry import Array

BINS = 10
CHI2_95 = {1: 3.841, 2: 5.991}
"""95 % quantiles of the chi-square distribution by degrees of freedom: 1.96^2, and -2 ln 0.05."""


def reliability(confidence: Array, right: Mask) -> dict[str, Any]:
    """Compare confidences (N,) in [0, 1] with what is right (N,).

    Returns
    -------
    dict
        "count", "expected_calibration_error" (None without any), and "bins" of equal width from 0 to 1 with "low", "high",
        "count", "mean_confidence" and "right" (None in empty bins).

    Notes
    -----
    Expected calibration error (Naeini, Cooper, Hauskrecht, AAAI 2015; Guo et al., ICML 2017): the mean over all of the
    difference between the mean confidence and the share of right ones in their bin. What lies outside 0 to 1 is in the
    outermost bins. Bins of few have an error by chance alone: sqrt(p (1 - p) / count) for a share p.
    """
    of_bin = np.clip((confidence * BINS).astype(np.int64), 0, BINS - 1)
    count = np.bincount(of_bin, minlength=BINS)
    sums, rights = (np.bincount(of_bin, weights=v, minlength=BINS) for v in (confidence, right))
    bins = [
        {
            "low": k / BINS,
            "high": (k + 1) / BINS,
            "count": int(count[k]),
            "mean_confidence": float(sums[k] / count[k]) if count[k] else None,
            "right": float(rights[k] / count[k]) if count[k] else None,
        }
        for k in range(BINS)
    ]
    error = float(np.abs(sums - rights).sum() / len(right)) if len(right) else None
    return {"count": len(right), "expected_calibration_error": error, "bins": bins}


def normalized_errors(error: Array, sigma: Array) -> dict[str, Any]:
    """Compare errors (N, D) with their standard deviations (N,), which hold for each of the D = 1 or 2 axes.

    Rows with an error of NaN are left out.

    Returns
    -------
    dict
        "count"; "without_sigma", those with a sigma of 0 or NaN, left out of all else; "nees", the mean of e^T P^-1 e / D
        with P = sigma^2 I, 1 where sigmas are right, above where they are too small; "median", 0.69 = ln 2 for D = 2 and
        0.45 for D = 1 where errors are Gaussian too; "within_95", the share inside of the 95 % circle or interval.

    Notes
    -----
    Normalized estimation error squared (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and
    Navigation", 2001, section 5.4.2). A few gross errors dominate the mean, the other two describe the rest. The noise of
    the labels is part of the errors. Errors of positions end at the gate of the matching.
    """
    there = np.isfinite(error).all(axis=1)
    known, axes = there & (sigma > 0), error.shape[1]
    squared = (error[known] ** 2).sum(axis=1) / sigma[known] ** 2
    return {
        "count": int(known.sum()),
        "without_sigma": int((there & ~known).sum()),
        "nees": float(squared.mean() / axes) if known.any() else None,
        "median": float(np.median(squared) / axes) if known.any() else None,
        "within_95": float((squared <= CHI2_95[axes]).mean()) if known.any() else None,
    }
