"""Measures of criticality of two road users, over any shapes of arrays.

Names and definitions as in Westhofen et al., "Criticality Metrics for Automated Driving: A Review and Suitability Analysis of the
State of the Art", Archives of Computational Methods in Engineering 30, 2023. What has no value, such as the time to collision of
who moves apart, is infinite.
"""

from __future__ import annotations

import numpy as np

from log2sim.geometry import Array

BRAKES_MPS2 = 8.0
"""Deceleration and lateral acceleration of a dry road that are available, less than what its grip of 0.9 g allows."""

REACTION_S = 1.0
"""From when a driver sees a conflict until the brakes work: the value of MDRAC's authors."""


def _ratio(over: Array, under: Array) -> Array:
    """Divide where the denominator is positive; infinite elsewhere."""
    over, under = np.broadcast_arrays(np.asarray(over, dtype=np.float64), np.asarray(under, dtype=np.float64))
    return np.asarray(np.divide(over, under, out=np.full(over.shape, np.inf), where=under > 0))


def time_to_collision(gap_m: Array, closing_mps: Array) -> Array:
    """Compute TTC, s, along a lane (Hayward 1972): gap by closing speed; 0 for those in touch, infinite for those that part."""
    return np.where(gap_m > 0, _ratio(np.maximum(gap_m, 0.0), closing_mps), np.where(np.isnan(gap_m), np.nan, 0.0))


def time_headway(ahead_m: Array, speed_mps: Array) -> Array:
    """Compute the time headway, s, of a follower (HCM 2016): until its front is where the one ahead has its rear, at its speed."""
    return _ratio(np.maximum(ahead_m, 0.0), speed_mps)


def deceleration_to_avoid(gap_m: Array, closing_mps: Array) -> Array:
    """Compute DRAC, m/s2 (Cooper and Ferguson 1976): with which who follows just gets as slow as the one ahead; 0 for who is slower."""
    closing = np.maximum(closing_mps, 0.0)
    return np.where(closing > 0, _ratio(closing**2, 2.0 * np.maximum(gap_m, 0.0)), 0.0)


def modified_deceleration(gap_m: Array, closing_mps: Array) -> Array:
    """Compute MDRAC, m/s2 (Fu and Sayed 2021): closing speed / (2 (TTC - reaction)); infinite when the reaction takes longer than the TTC."""
    closing = np.maximum(closing_mps, 0.0)
    left_s = time_to_collision(gap_m, closing_mps) - REACTION_S
    return np.where(closing > 0, _ratio(closing, 2.0 * left_s), 0.0)


def braking_required(gap_m: Array, closing_mps: Array, accel_ahead_mps2: Array) -> Array:
    """Compute the deceleration, m/s2, that avoids a collision with one ahead that keeps its acceleration (Karlsson et al. 2014).

    It is DRAC less that acceleration, as long as the one ahead does not stand by then; never negative.
    """
    return np.maximum(deceleration_to_avoid(gap_m, closing_mps) - np.where(closing_mps > 0, accel_ahead_mps2, 0.0), 0.0)


def brake_threat_number(gap_m: Array, closing_mps: Array, accel_ahead_mps2: Array) -> Array:
    """Compute BTN (Brannstrom et al. 2008): deceleration required by the one available; from 1 on braking alone does not help."""
    return braking_required(gap_m, closing_mps, accel_ahead_mps2) / BRAKES_MPS2


def steer_threat_number(ttc_s: Array, aside_m: Array, lateral_mps: Array, width_m: Array) -> Array:
    """Compute STN (Brannstrom et al. 2008): lateral acceleration to pass on the nearer side by the one available; 0 without a collision.

    `aside_m`: how far to the left the one ahead is, and `lateral_mps` how fast it moves there, relative to who steers; `width_m` is
    the mean width of both. Where both are beside each other by then, nothing is required.
    """
    clear = np.isfinite(ttc_s) & (ttc_s > 0)
    t = np.where(clear, ttc_s, 1.0)
    then = aside_m + lateral_mps * t
    need = np.maximum(width_m - np.abs(then), 0.0)
    return np.where(clear, 2.0 * need / t**2 / BRAKES_MPS2, np.where(ttc_s == 0, np.inf, 0.0))


def encroachment_time(speed_mps: Array, way_m: Array) -> Array:
    """Compute ET, s (Allen, Shin and Cooper 1978): for how long a road user is within a conflict area that it leaves after `way_m`."""
    return _ratio(way_m, speed_mps)
