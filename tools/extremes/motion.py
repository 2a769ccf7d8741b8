"""Extremes of motion: times, speeds and headings in smoothing, poses and tracking."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from extremes.table import FAR_M, Outcome, case
from log2sim.agents.smooth.smoother import MotionModel, SmoothedTrack, signed_speed, smooth_track
from log2sim.datatypes import Detections, Measurements
from log2sim.geometry import NS_PER_S, Array, PoseTrack, rotation_from_rpy, transform, wrap_angle, yaw_of
from log2sim.tracking.tracker import track


def smoothed_error_m(result: SmoothedTrack, truth: Array) -> float:
    return float(np.hypot(*(result.xy_m - truth).T).max())


def smoothing(t: Array, truth: Array, sigma_m: float, motion: MotionModel | None = None) -> SmoothedTrack:
    noise = np.random.default_rng(5).normal(0.0, sigma_m, truth.shape)
    return smooth_track(t, truth + noise, sigma_m=sigma_m, motion=motion)


def straight(t: Array, speed_mps: float) -> Array:
    return np.column_stack([speed_mps * t, np.zeros(len(t))])


def judged(result: SmoothedTrack, truth: Array, within_m: float, found: str = "") -> Outcome:
    finite = all(np.isfinite(getattr(result, k)).all() for k in ("xy_m", "velocity_mps", "yaw_rad", "covariance"))
    error = smoothed_error_m(result, truth)
    return Outcome(
        bool(finite and error <= within_m), found or ("finite, near" if finite else "not finite"), None, error
    )


@case("smoothing: stamps 1 us apart", "finite and within 3 sigma")
def microsecond() -> Outcome:
    t = np.sort(np.r_[np.arange(50) * 0.1, np.arange(10, 40) * 0.1 + 1e-6])
    return judged(smoothing(t, straight(t, 10.0), 0.1), straight(t, 10.0), 0.3)


@case("smoothing: a gap of 10 s", "finite, near before and after, covariance says that it is a guess")
def gap() -> Outcome:
    t = np.r_[np.arange(30) * 0.1, 13.0 + np.arange(30) * 0.1]
    at = np.arange(0.0, 16.0, 0.1)
    noisy = straight(t, 10.0) + np.random.default_rng(5).normal(0.0, 0.1, (60, 2))
    result = smooth_track(t, noisy, sigma_m=0.1, at_s=at)
    sigma = np.sqrt(np.trace(result.covariance, axis1=1, axis2=2))
    away = np.hypot(*(result.xy_m - straight(at, 10.0)).T)
    seen = (at < 2.95) | (at > 12.95)
    ok = away[seen].max() < 0.3 and sigma[~seen].max() > 10 * sigma[seen].max() and (away <= 4 * sigma + 0.05).all()
    return Outcome(
        bool(ok),
        f"sigma {sigma[~seen].max():.2g} m in the gap, {sigma[seen].max():.2g} m outside",
        None,
        float(away[seen].max()),
    )


@case("smoothing: steps of 1 ms", "finite and within 3 sigma")
def milliseconds() -> Outcome:
    t = np.arange(1000) * 1e-3
    return judged(smoothing(t, straight(t, 10.0), 0.1), straight(t, 10.0), 0.3)


@case("smoothing: steps of 1 s", "finite and within 3 sigma")
def seconds() -> Outcome:
    t = np.arange(40.0)
    return judged(smoothing(t, straight(t, 10.0), 0.1), straight(t, 10.0), 0.3)


@case("smoothing: 60 m/s", "finite and within 3 sigma, speed within 1 m/s")
def fast() -> Outcome:
    t = np.arange(80) * 0.1
    result = smoothing(t, straight(t, 60.0), 0.1)
    outcome = judged(result, straight(t, 60.0), 0.3)
    off = float(np.abs(np.hypot(*result.velocity_mps.T)[5:-5] - 60.0).max())
    return Outcome(outcome.ok and off < 1.0, f"speed off by {off:.2g} m/s", None, outcome.error)


@case("smoothing: standstill", "stays within 3 sigma and its heading turns by less than a degree")
def standstill() -> Outcome:
    t = np.arange(80) * 0.1
    result = smoothing(t, np.zeros((80, 2)), 0.1, motion=MotionModel(heading_rad=0.7))
    turned = float(np.rad2deg(np.abs(wrap_angle(result.yaw_rad - 0.7)).max()))
    outcome = judged(result, np.zeros((80, 2)), 0.3)
    return Outcome(outcome.ok and turned < 1.0, f"turns {turned:.2g} degrees", None, outcome.error)


@case("smoothing: reversing", "heading kept, speed negative")
def reversing() -> Outcome:
    t = np.arange(80) * 0.1
    truth = np.column_stack([np.where(t < 4.0, 3.0 * t, 12.0 - 3.0 * (t - 4.0)), np.zeros(80)])
    result = smoothing(t, truth, 0.05)
    away = float(np.rad2deg(np.abs(wrap_angle(result.yaw_rad)).max()))
    speed = signed_speed(result.velocity_mps, result.yaw_rad)
    ok = away < 15.0 and speed[:30].min() > 2.0 and speed[-30:].max() < -2.0
    return Outcome(bool(ok), f"speed {speed[-1]:.2g} m/s", None, away, "degrees")


@case("smoothing: yaw across +-pi", "runs on, in [-pi, pi), within 3 degrees")
def half_turn() -> Outcome:
    t = np.arange(120) * 0.1
    angle = 0.4 * t
    truth = 20.0 * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
    result = smoothing(t, truth, 0.05)
    off = float(np.rad2deg(np.abs(wrap_angle(result.yaw_rad - angle))[3:-3].max()))
    inside = (result.yaw_rad >= -np.pi).all() and (result.yaw_rad < np.pi).all()
    return Outcome(bool(off < 3.0 and inside and angle[-1] > np.pi), "follows the turn", None, off, "degrees")


@case("smoothing: at UTM coordinates of 5e6 m", "as at the origin to 1e-6 m")
def smoothing_far() -> Outcome:
    t = np.arange(80) * 0.1
    xy = np.round(straight(t, 10.0) + np.random.default_rng(6).normal(0.0, 0.1, (80, 2)), 3)
    near, far = (smooth_track(t, xy + shift, sigma_m=0.1) for shift in (np.zeros(2), FAR_M))
    error = float(np.abs(far.xy_m - FAR_M - near.xy_m).max())
    return Outcome(error <= 1e-6, "the same", None, error)


@case("poses: yaw across +-pi", "interpolated along the shorter arc")
def pose_half_turn() -> Outcome:
    yaw = np.deg2rad([179.0, -179.0])
    poses = PoseTrack(np.array([0, 100_000_000]), transform(rotation_from_rpy(0.0, 0.0, yaw), np.zeros((2, 3))))
    error = float(np.rad2deg(abs(wrap_angle(yaw_of(poses.at([50_000_000])[0])[0] - np.pi))))
    return Outcome(error < 1e-9, "half way at 180 degrees", None, error, "degrees")


@case("poses: a gap of 10 s", "not bridged")
def pose_gap() -> Outcome:
    t_ns = np.r_[np.arange(5), 100 + np.arange(5)] * 100_000_000
    poses = PoseTrack(t_ns, np.tile(np.eye(4), (10, 1, 1)))
    known = poses.at([200_000_000, 5_000_000_000, 10_200_000_000])[1]
    return Outcome(known.tolist() == [True, False, True], "unknown in the gap" if not known[1] else "bridged")


# --- tracking


def measured(xy: Array, t_ns: int) -> Measurements:
    """Cars measured at places (M, 2), each with its number in the name of its camera, which tracking does not read."""
    n = len(xy)
    detections = Detections(np.zeros((n, 4)), np.full(n, 0.9), np.full(n, "car"))
    rows = Measurements.unplaced(detections, t_ns=t_ns, camera="", sensor_m=np.zeros(3))
    return replace(
        rows, camera=np.arange(n).astype("<U16"), center_m=np.column_stack([xy, np.zeros(n)]), yaw_rad=np.zeros(n),
        covariance=np.tile(0.01 * np.eye(2), (n, 1, 1)), points=np.full(n, 50), source=np.full(n, "lidar"),
    )  # fmt: skip


def tracks_of(start: Array, velocity: Array, ticks_ns: Array) -> Outcome:
    """One track for each car (M, 2), with all its measurements."""
    ticks = np.asarray(ticks_ns, dtype=np.int64)
    rng = np.random.default_rng(7)
    found = [
        measured(start + velocity * ((t - ticks[0]) / NS_PER_S) + rng.normal(0, 0.05, start.shape), int(t))
        for t in ticks
    ]
    tracks = track(found, ticks, birth_score=0.4, max_gap_s=3.0, min_life_s=0.3)
    whole = sum(len(t) == len(ticks) and len(set(t.measurements.camera.tolist())) == 1 for t in tracks)
    lost = len(start) - whole
    return Outcome(
        len(tracks) == len(start) == whole,
        f"{len(tracks)} tracks, {whole} of them whole",
        None,
        float(lost),
        "cars lost",
    )


@case("tracking: 500 agents", "500 tracks, no identity lost")
def crowd() -> Outcome:
    x, y = np.meshgrid(np.arange(25) * 9.0, np.arange(20) * 6.0)
    start = np.column_stack([x.ravel(), y.ravel()])
    velocity = np.column_stack([np.where(np.arange(500) % 2, 8.0, -8.0), np.zeros(500)])
    velocity[:, 0] = np.where((y.ravel() / 6.0) % 2 == 0, 8.0, -8.0)
    return tracks_of(start, velocity, np.arange(8) * 100_000_000)


@case("tracking: stamps of 1.7e18 ns", "no identity lost")
def late_stamps() -> Outcome:
    return tracks_of(
        np.array([[0.0, 0.0], [0.0, 4.0]]),
        np.array([[10.0, 0.0], [-10.0, 0.0]]),
        1_700_000_000_000_000_000 + np.arange(20) * 100_000_000,
    )


@case("tracking: negative stamps, and zero among them", "no identity lost")
def negative_stamps() -> Outcome:
    return tracks_of(
        np.array([[0.0, 0.0], [0.0, 4.0]]), np.array([[10.0, 0.0], [-10.0, 0.0]]), (np.arange(20) - 10) * 100_000_000
    )


@case("tracking: one frame", "a track for each")
def one_frame_tracks() -> Outcome:
    return tracks_of(np.array([[0.0, 0.0], [0.0, 8.0]]), np.zeros((2, 2)), np.array([0]))


@case("tracking: a gap of 10 s", "a moving car is not bridged over it")
def tracking_gap() -> Outcome:
    ticks = np.r_[np.arange(20), 120 + np.arange(20)] * 100_000_000
    found = [measured(np.array([[10.0 * t / NS_PER_S, 0.0]]), int(t)) for t in ticks]
    tracks = track(found, ticks, birth_score=0.4, max_gap_s=3.0, min_life_s=0.3)
    return Outcome(len(tracks) == 2, f"{len(tracks)} tracks")


@case("tracking: empty frames", "no track, no error")
def empty_tracks() -> Outcome:
    ticks = np.arange(10) * 100_000_000
    tracks = track([Measurements.empty()] * 10, ticks, birth_score=0.4, max_gap_s=3.0, min_life_s=0.3)
    return Outcome(tracks == [], f"{len(tracks)} tracks")
