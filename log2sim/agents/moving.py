"""Moving agents: size once, LiDAR matches at ticks without a detection, and a smoothed trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.candidate import REAR_AXLE_SHARE, AgentCandidate, Timeline, candidate_of
from log2sim.agents.confirmation import followed_confidence
from log2sim.agents.heading.box_headings import heading_log_odds
from log2sim.agents.heading.course import forward_log_odds
from log2sim.agents.lidar_tracking import BoxState, LidarMatch, left_free, track_with_lidar
from log2sim.agents.motion_doubts import jump_doubts, motion_doubts, sideways_doubts
from log2sim.agents.size import TrackGeometry, moving_geometry
from log2sim.agents.smooth import feasibility
from log2sim.agents.smooth.feasibility import limit_doubts
from log2sim.agents.smooth.heading import UNKNOWN_YAW_RAD
from log2sim.agents.smooth.motion_model import MotionModel
from log2sim.agents.smooth.smoother import SmoothedTrack, signed_speed, smooth_track
from log2sim.datatypes import GROUP_OF, STANDSTILL_MPS, TYPICAL_SIZE_M, Obstacles, Track, Waypoints
from log2sim.geometry import NS_PER_S, Array, wrap_angle
from log2sim.perception.box_fitting import align_to
from log2sim.tracking.motion import CENTER_SIGMA_M

# Spectral density of the jerk, m2/s5, of groups for which it is not estimated.
JERK_DENSITY = {"pedestrian": 2.0}
# Tightest ways of groups: that of road vehicles; of a bicycle with a wheelbase of 1.05 m whose front wheel is turned by 30 degrees,
# tan(30 degrees) / 1.05 m; of others nothing is known.
MAX_CURVATURE_1PM = {
    "vehicle": feasibility.MAX_CURVATURE_1PM,
    "two_wheeler": 0.55,
    "pedestrian": np.inf,
    "other": np.inf,
}
# Without smoothing: so large that the trajectory follows the positions.
UNSMOOTHED_JERK_DENSITY = 1e4
# Standard deviation of box centers beyond their covariance: points are no exact outlines.
FITTED_CENTER_SIGMA_M = {"vehicle": 0.12, "two_wheeler": 0.1, "pedestrian": 0.08, "other": 0.15}
# Rounds of smoothing, size and positions before the LiDAR is searched.
PRELIMINARY_SMOOTHINGS = 2
# A shorter displacement does not give a course.
MIN_COURSE_DISTANCE_M = 0.3
# A displacement shorter than this may be noise.
CERTAIN_COURSE_M = 1.0
# Standard deviation of the yaw of a single measurement.
BOX_YAW_SIGMA_RAD = 0.2
SAME_MOMENT_S = 1e-3
# A yaw of points that is farther from the course is that of their width.
MAX_YAW_OFF_RAD = np.pi / 4
# Heights of the ground under a track are smoothed by a median over this many measurements on either side.
HEIGHT_MEDIAN_HALF = 4


@dataclass(frozen=True, eq=False)
class _Positions:
    """Positions of an object in rising time.

    Attributes
    ----------
    t_s : (n,) float64
    xy_m : (n, 2) float64
    covariance : (n, 2, 2) float64
    tick : (n,) int64
    """

    t_s: Array
    xy_m: Array
    covariance: Array
    tick: NDArray[np.int64]


def moving_candidate(
    track: Track, obstacles: Sequence[Obstacles | None], timeline: Timeline, *, smooth: bool
) -> AgentCandidate:
    """Make an agent with a waypoint at every tick from its first to its last observation.

    Notes
    -----
    Smoothing the provisional positions gives headings; with these the evidence gives one size and, by laying the whole box
    against the observed ends, better positions. That is done twice, since provisional positions jump where the view
    changes and mislead the headings. LiDAR matches before, after and between the detections join the positions, and the
    final smoothing gives the trajectory.
    """
    track = _one_at_a_moment(track)
    m, group = track.measurements, GROUP_OF[track.category]
    t = timeline.seconds(m.t_ns)
    noise = FITTED_CENTER_SIGMA_M[group] ** 2 * np.eye(2)
    heading, heading_sigma = _first_heading(track)
    curvature = MAX_CURVATURE_1PM[group]
    motion = MotionModel(JERK_DENSITY.get(group), group == "pedestrian", heading, heading_sigma, curvature)
    xy, covariance = m.center_m[:, :2], m.covariance
    for _ in range(PRELIMINARY_SMOOTHINGS):
        rough = smooth_track(t, xy, covariance=covariance + noise, at_s=t, motion=motion)
        headings = _headings(rough, group)
        geometry = moving_geometry(track, headings, rough.velocity_mps)
        xy, covariance = geometry.xy_m, geometry.covariance
    matches = _lidar_matches(track, rough, headings, geometry, obstacles, timeline)
    positions = _all_positions(track, geometry, matches, timeline)
    life = np.arange(positions.tick.min(), positions.tick.max() + 1)
    at = timeline.seconds(timeline.t_ns[life])
    if not smooth:
        motion = replace(motion, jerk_density=UNSMOOTHED_JERK_DENSITY)
    path = smooth_track(positions.t_s, positions.xy_m, covariance=positions.covariance + noise, at_s=at, motion=motion)
    observed = np.isin(life, positions.tick)
    residual = path.residual_m[path.inlier]
    quality = {
        "lidar_only": len(matches),
        "observed_share": round(float(observed.mean()), 3),
        "smoothing_residual_rms_m": round(float(np.sqrt(np.nanmean(residual**2))), 4) if len(residual) else None,
    }
    z = np.interp(at, t, _running_median(geometry.z_m))
    waypoints = _waypoints(path, _headings(path, group), z, observed)
    sigma_m = np.sqrt(np.trace(positions.covariance, axis1=1, axis2=2) / 2 + CENTER_SIGMA_M[group] ** 2)
    doubts = limit_doubts(path.broken) + motion_doubts(track.category, waypoints)
    doubts += jump_doubts(positions.t_s, path.residual_m, sigma_m)
    if group == "vehicle":
        near = np.clip(np.searchsorted(at, t), 0, len(at) - 1)
        doubts += sideways_doubts(m, t, waypoints.yaw_rad[near], waypoints.speed_mps[near])
    ordered = sorted(matches, key=lambda match: match.tick)
    free = left_free(obstacles, ordered, geometry.size_m, float(np.median(geometry.z_m)) - geometry.size_m[2] / 2)
    followed = followed_confidence(track, np.array([match.xy_m for match in ordered]).reshape(-1, 2)[free])
    return candidate_of(track, geometry, waypoints, quality, static=False, followed=followed).doubted(doubts)


def _one_at_a_moment(track: Track) -> Track:
    """Drop measurements at the time of the previous one: frames that share a sweep measure the same points."""
    first = np.r_[True, np.diff(track.measurements.t_ns) > SAME_MOMENT_S * NS_PER_S]
    unrecorded = np.union1d(track.unrecorded, track.tick[~first])
    return replace(track, tick=track.tick[first], measurements=track.measurements.take(first), unrecorded=unrecorded)


def _headings(path: SmoothedTrack, group: str) -> Array:
    """Return the heading (T,) of the body: the course of its center, less the slip angle of a turning center.

    The center of a vehicle that turns about a point level with its rear axle moves at atan(offset x curvature) to it.
    """
    if group not in REAR_AXLE_SHARE:
        return path.yaw_rad
    offset = REAR_AXLE_SHARE[group] * TYPICAL_SIZE_M["car" if group == "vehicle" else "cyclist"][0]
    return wrap_angle(path.yaw_rad - np.arcsin(np.clip(offset * path.curvature_1pm, -0.5, 0.5)))


def _first_heading(track: Track) -> tuple[float | None, float]:
    """Return the course from the first to the last quarter of a track, or the yaw of its first box if that is short.

    Where the boxes of a 3D detector say that a slow object moves backward, it is the opposite of the course. The second value
    is its standard deviation in rad, given that front and back are not swapped.
    """
    m, count = track.measurements, max(len(track) // 4, 1)
    displacement = np.median(m.center_m[-count:, :2], axis=0) - np.median(m.center_m[:count, :2], axis=0)
    moved_m = float(np.hypot(*displacement))
    if moved_m >= MIN_COURSE_DISTANCE_M:
        course = float(np.arctan2(displacement[1], displacement[0]))
        speed_mps = moved_m / max(float(m.t_ns[-1] - m.t_ns[0]) / NS_PER_S, 1e-3)
        forward = forward_log_odds(speed_mps) * min(moved_m / CERTAIN_COURSE_M, 1.0) + heading_log_odds(m, course)
        sigma = float(np.arctan2(CENTER_SIGMA_M[GROUP_OF[track.category]], moved_m))
        return (course if forward >= 0 else float(wrap_angle(course + np.pi))), sigma
    yaws = m.yaw_rad[np.isfinite(m.yaw_rad)]
    if len(yaws) == 0:
        return None, UNKNOWN_YAW_RAD
    yaw = align_to(float(yaws[0]), 0.0, np.pi)
    return (yaw if heading_log_odds(m, yaw) >= 0 else float(wrap_angle(yaw + np.pi))), BOX_YAW_SIGMA_RAD


def _lidar_matches(
    track: Track,
    path: SmoothedTrack,
    headings: Array,
    geometry: TrackGeometry,
    obstacles: Sequence[Obstacles | None],
    timeline: Timeline,
) -> list[LidarMatch]:
    """Match the box before, after and in the gaps of its track."""
    tick, total = track.tick.tolist(), len(timeline.t_ns)
    spans = [(0, range(tick[0] - 1, -1, -1)), (len(tick) - 1, range(tick[-1] + 1, total))]
    spans += [(k, range(a + 1, b)) for k, (a, b) in enumerate(pairwise(tick))]
    bottom_m = float(np.median(geometry.z_m)) - geometry.size_m[2] / 2
    matches = []
    yaw_rad = headings.copy()
    if GROUP_OF[track.category] == "vehicle":
        # At the end of a track the sides of a box tell its direction better than its course does.
        off = np.nan_to_num(wrap_angle(2 * (track.measurements.yaw_rad - headings)) / 2)
        yaw_rad += np.where(np.abs(off) < MAX_YAW_OFF_RAD, off, 0.0)
    for k, wanted in spans:
        start = BoxState(
            int(track.measurements.t_ns[k]), path.xy_m[k], path.velocity_mps[k], float(yaw_rad[k]),
            geometry.size_m, bottom_m,
        )  # fmt: skip
        matches += track_with_lidar(obstacles, wanted, timeline.t_ns, start)
    return matches


def _all_positions(
    track: Track, geometry: TrackGeometry, matches: Sequence[LidarMatch], timeline: Timeline
) -> _Positions:
    """Merge the positions of measurements and LiDAR matches, one at a moment."""
    t_ns = np.concatenate([track.measurements.t_ns, np.array([m.t_ns for m in matches], dtype=np.int64)])
    t_s = timeline.seconds(t_ns)
    xy = np.concatenate([geometry.xy_m, np.array([m.xy_m for m in matches]).reshape(-1, 2)])
    covariance = np.concatenate([geometry.covariance, np.array([m.covariance for m in matches]).reshape(-1, 2, 2)])
    tick = np.concatenate([track.tick, np.array([m.tick for m in matches], dtype=np.int64)])
    rows = np.argsort(t_s, kind="stable")
    rows = rows[np.r_[True, np.diff(t_s[rows]) > SAME_MOMENT_S]]
    return _Positions(t_s[rows], xy[rows], covariance[rows], tick)


def _waypoints(path: SmoothedTrack, yaw: Array, z_m: Array, observed: NDArray[np.bool_]) -> Waypoints:
    speed = signed_speed(path.velocity_mps, yaw)
    return Waypoints(
        t_s=path.t_s,
        x_m=path.xy_m[:, 0],
        y_m=path.xy_m[:, 1],
        z_m=z_m,
        yaw_rad=yaw,
        speed_mps=np.where(np.abs(speed) < STANDSTILL_MPS, 0.0, speed),
        observed=observed,
        sigma_xy_m=np.sqrt(np.trace(path.covariance, axis1=1, axis2=2) / 2),
        sigma_yaw_rad=path.sigma_yaw_rad,
        sigma_speed_mps=path.sigma_speed_mps,
    )


def _running_median(values: Array) -> Array:
    padded = np.pad(values, HEIGHT_MEDIAN_HALF, mode="edge")
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * HEIGHT_MEDIAN_HALF + 1), axis=1)
