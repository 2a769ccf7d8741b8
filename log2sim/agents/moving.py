"""Moving agents: one size, a smoothed trajectory, what motion and boxes say about the front, and doubts about the motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.candidate import REAR_AXLE_SHARE, AgentCandidate, Timeline, candidate_of, spans_of
from log2sim.agents.size import MAX_ROAD_WIDTH_M, WHOLE_SIDE_SIGMA_M, independent, independent_along, moving_geometry
from log2sim.agents.smooth.motion_model import SIGNIFICANT_SIGMAS, UNKNOWN_YAW_RAD, MotionModel
from log2sim.agents.smooth.smoother import SmoothedTrack, signed_speed, smooth_track
from log2sim.agents.static import BoxState, left_free, track_with_lidar
from log2sim.config import TrackConfig
from log2sim.datatypes import (
    GROUP_OF,
    MAX_SPEED_MPS,
    STANDSTILL_MPS,
    TYPICAL_SIZE_M,
    Boxes3D,
    BoxEvidence,
    Finding,
    Measurements,
    Obstacles,
    Track,
    Waypoints,
)
from log2sim.datatypes.categories import MAX_CURVATURE_1PM as ROAD_CURVATURE_1PM
from log2sim.datatypes.log_odds import MAX_PROBABILITY, log_odds_of, probability_of
from log2sim.geometry import CHI2_2DOF_999, NS_PER_S, Array, wrap_angle
from log2sim.perception.cooperative import yaw_sigma, yaw_terms
from log2sim.tracking.forward import CENTER_SIGMA_M
from log2sim.tracking.tracker import VELOCITY_WINDOW_S, track, velocities

# A box turned farther than this from the axis of the object says nothing about its front.
MIN_AXIS_COS = 0.7


def heading_log_odds(m: BoxEvidence, yaw_rad: Array | float) -> float:
    """Return the log-odds that the object of a track points along a yaw rather than backward; 0 without boxes.

    The sum of the log-odds of all ticks, scaled down to that of as many independent ones (`independent`).
    """
    rows = np.flatnonzero(np.isfinite(m.box_yaw_rad))
    along = np.cos(m.box_yaw_rad[rows] - np.broadcast_to(yaw_rad, len(m.t_ns))[rows])
    rows, along = rows[np.abs(along) >= MIN_AXIS_COS], along[np.abs(along) >= MIN_AXIS_COS]
    if len(rows) == 0:
        return 0.0
    p = np.clip(m.heading_score[rows], 0.5, MAX_PROBABILITY)
    votes = np.sign(along) * log_odds_of(p)
    return float(votes.mean()) * independent(len(rows))


# Log-odds that an object moves forward: of slow ones, one in five reverses, at 3 m/s one in a thousand.
FORWARD_LOG_ODDS, FORWARD_LOG_ODDS_PER_MPS, MAX_FORWARD_LOG_ODDS = 1.4, 2.0, 9.0
# More than boxes say against it (`MAX_PROBABILITY` in all sweeps), so that what drives fast points ahead. Of tracks that seem to drive one
# in fifty mixes up several objects, or stands (simulated logs with LiDAR).
MAX_COURSE_LOG_ODDS = 7.0
# Few detections of a vehicle may be of several that stand: of tracks of fewer than ten that move, one in ten points the wrong way, of longer
# ones, and of two-wheelers, one in a hundred. From 608 vehicles of 150 simulated logs; 0.25 and 0.5 fit nearly as well.
COURSE_LOG_ODDS_PER_DETECTION = 0.35
# A way shorter than so many standard deviations of its ends may be noise.
CERTAIN_SIGMAS = 4.0


def forward_log_odds(speed_mps: float) -> float:
    """Return the log-odds, in nats, that something that moves at a speed, at least 0, moves forward."""
    return FORWARD_LOG_ODDS + FORWARD_LOG_ODDS_PER_MPS * speed_mps


def course_log_odds(w: Waypoints, limit: float = MAX_COURSE_LOG_ODDS) -> float:
    """Return the log-odds that the front of a vehicle is where its yaw points, by the ways that it drives either way.

    `limit`: greatest log-odds of the way in one direction. The center of a standing vehicle seems to move while more and more of it
    comes into view, which its standard deviation holds.
    """
    step_s = np.gradient(w.t_s) if len(w.t_s) > 1 else np.zeros(1)
    certain_m = CERTAIN_SIGMAS * float(np.median(w.sigma_xy_m))
    odds = 0.0
    for sign in (1, -1):
        speed_mps = np.maximum(sign * w.speed_mps, 0.0)
        distance_m, time_s = float(speed_mps @ step_s), float(step_s[speed_mps > 0].sum())
        if time_s > 0:
            one_way = min(forward_log_odds(distance_m / time_s), limit)
            odds += sign * one_way * (1.0 if distance_m >= certain_m else distance_m / certain_m)
    return odds


def turn_to_courses(found: Sequence[Boxes3D], t_ns: NDArray[np.int64], config: TrackConfig) -> list[Boxes3D]:
    """Turn the boxes of T sweeps round whose objects move the other way, and give all that move the probability of their front.

    `found`: map frame. `t_ns`: (T,): stamps of the sweeps.

    Boxes are tracked. What a track moves around a sweep counts beside what the detector says of its box there; what stands, is
    in one sweep alone, or is laid across its course stays as it is.
    """
    rows = []
    for boxes in found:  # each placed at its center as exactly as centers of boxes are
        sigma = np.array([CENTER_SIGMA_M[GROUP_OF[str(c)]] for c in boxes.category])
        covariance, source = sigma[:, None, None] ** 2 * np.eye(2), np.full(len(boxes), "lidar", dtype="<U16")
        placed = Measurements.from_boxes(boxes, np.zeros(3))
        rows.append(replace(placed, center_m=boxes.center_m, covariance=covariance, source=source))
    yaw, score = [b.yaw_rad.copy() for b in found], [b.heading_score.copy() for b in found]
    birth_score, max_gap_s, min_life_s = config.birth_score, config.max_gap_s, config.min_life_s
    for one in track(rows, t_ns, birth_score=birth_score, max_gap_s=max_gap_s, min_life_s=min_life_s):
        m, group, velocity = one.measurements, GROUP_OF[one.category], velocities(one)
        speed, course = np.hypot(*velocity.T), np.arctan2(velocity[:, 1], velocity[:, 0])
        t_s = (m.t_ns - m.t_ns[0]) / NS_PER_S
        window_s = np.minimum(t_s + VELOCITY_WINDOW_S, t_s[-1]) - np.maximum(t_s - VELOCITY_WINDOW_S, 0.0)
        along = np.cos(m.box_yaw_rad - course)
        certain_m = CERTAIN_SIGMAS * CENTER_SIGMA_M[group]
        # People are about as wide as long, so that their boxes have no axis.
        moves = (speed * window_s >= certain_m) & ((np.abs(along) >= MIN_AXIS_COS) | (group == "pedestrian"))
        for k in np.flatnonzero(moves):
            tick = int(one.tick[k])
            row = int(np.argmin(np.abs(found[tick].center_m - m.box_center_m[k]).sum(axis=1)))
            own = float(log_odds_of(np.clip(m.heading_score[k], 0.5, MAX_PROBABILITY)))
            odds = own + np.sign(along[k]) * min(forward_log_odds(float(speed[k])), MAX_FORWARD_LOG_ODDS)
            score[tick][row] = probability_of(abs(odds))
            if odds < 0:
                yaw[tick][row] = wrap_angle(yaw[tick][row] + np.pi)
    return [replace(b, yaw_rad=y, heading_score=s) for b, y, s in zip(found, yaw, score)]


# Of slow vehicles one in five reverses, at 3 m/s one in a thousand (`forward_log_odds`); out of a driveway or
# to a better parking space it is some car lengths.
MAX_REVERSING_MPS, MAX_REVERSING_M = 3.0, 20.0
# A measurement is far from the trajectory beyond the 99.9 % quantile of chi-square with two degrees of freedom; one may be an
# outlier.
MIN_BESIDE = 2
# One measurement in twenty is an outlier; twice as many are more than that.
MIN_BESIDE_SHARE = 0.1
# Above this speed a vehicle goes along its length, but for the slip angle, up to 30 degrees where it turns at full lock.
MIN_COURSE_MPS, MAX_SLIP_RAD, MIN_ACROSS = 1.5, np.deg2rad(45.0), 3


def motion_doubts(category: str, w: Waypoints) -> tuple[Finding, ...]:
    """Doubt what moves faster than its category does, or reverses fast or far.

    `w`: one at every tick.
    """
    margin = 0.0 if w.sigma_speed_mps is None else SIGNIFICANT_SIGMAS * w.sigma_speed_mps
    spans = [("speed", rows) for rows in spans_of(np.abs(w.speed_mps) - margin > MAX_SPEED_MPS[category])]
    if GROUP_OF[category] in ("vehicle", "two_wheeler"):
        fast, wrong = -w.speed_mps - margin > MAX_REVERSING_MPS, np.zeros(len(w), dtype=bool)
        for rows in spans_of(w.speed_mps < 0):
            covered = float(np.hypot(np.diff(w.x_m[rows]), np.diff(w.y_m[rows])).sum())
            wrong[rows] = fast[rows].any() or covered > MAX_REVERSING_M
        spans += [("reversing", rows) for rows in spans_of(wrong)]
    return tuple(
        Finding(
            kind, start_s=float(w.t_s[k[0]]), end_s=float(w.t_s[k[-1]]), values={"most_mps": float(np.abs(w.speed_mps[k]).max())},
        )
        for kind, k in spans
    )  # fmt: skip


def sideways_doubts(m: BoxEvidence, t_s: Array, heading_rad: Array, speed_mps: Array) -> tuple[Finding, ...]:
    """Doubt a vehicle whose length was measured to lie across its way most of the time.

    `m`: n rows. `t_s`: (n,), s. `heading_rad`: (n,): of the trajectory at these times. `speed_mps`: (n,), m/s: there.
    """
    has_box = np.isfinite(m.box_yaw_rad)
    axis = np.where(has_box, m.box_yaw_rad, m.yaw_rad)
    certain = (has_box | ((m.high_m - m.low_m)[:, 0] > MAX_ROAD_WIDTH_M + WHOLE_SIDE_SIGMA_M)) & (
        np.abs(speed_mps) > MIN_COURSE_MPS
    )
    across = certain & (np.abs(wrap_angle(2 * (axis - heading_rad))) / 2 > MAX_SLIP_RAD)
    rows = np.flatnonzero(across)
    if len(rows) < MIN_ACROSS or len(rows) <= certain.sum() / 2:
        return ()
    return (Finding("sideways", start_s=float(t_s[rows[0]]), end_s=float(t_s[rows[-1]])),)


# Spectral density of the jerk, m2/s5, of groups for which it is not estimated.
JERK_DENSITY = {"pedestrian": 2.0}
# Tightest ways of groups: that of road vehicles; of a bicycle with a wheelbase of 1.05 m whose front wheel is turned by 30 degrees,
# tan(30 degrees) / 1.05 m; of others nothing is known.
MAX_CURVATURE_1PM = {"vehicle": ROAD_CURVATURE_1PM, "two_wheeler": 0.55, "pedestrian": np.inf, "other": np.inf}
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
# Within this time the axis of a vehicle turns by less than 45 degrees: at 0.7 rad/s, a turn of 7 m radius at 5 m/s, by 40.
TURN_S = 1.0
# Heights of the ground under a track are smoothed by a median over this many measurements on either side.
HEIGHT_MEDIAN_HALF = 4
# So many places tell enough.
MAX_PLACES = 200


def moving_candidate(
    track: Track, obstacles: Sequence[Obstacles | None], timeline: Timeline, *, smooth: bool
) -> AgentCandidate:
    """Make an agent with a waypoint at every tick from its first to its last observation.

    Smoothing the provisional positions gives headings; with these the evidence gives one size and, by laying the whole box
    against the observed ends, better positions. That is done twice, since provisional positions jump where the view
    changes and mislead the headings. LiDAR matches before, after and between the detections join the positions, and the
    final smoothing gives the trajectory.
    """
    # Frames that share a sweep measure the same points: one measurement a moment.
    first = np.r_[True, np.diff(track.measurements.t_ns) > SAME_MOMENT_S * NS_PER_S]
    unrecorded = np.union1d(track.unrecorded, track.tick[~first])
    track = replace(track, tick=track.tick[first], measurements=track.measurements.take(first), unrecorded=unrecorded)
    m, group = track.measurements, GROUP_OF[track.category]
    placed = replace(track, measurements=without_boxes_laid_across(m)) if group == "vehicle" else track
    t = timeline.seconds(m.t_ns)
    noise = FITTED_CENTER_SIGMA_M[group] ** 2 * np.eye(2)
    heading, heading_sigma = _first_heading(track)
    curvature = MAX_CURVATURE_1PM[group]
    motion = MotionModel(JERK_DENSITY.get(group), group == "pedestrian", heading, heading_sigma, curvature)
    xy, covariance = m.center_m[:, :2], placed.measurements.covariance
    for _ in range(PRELIMINARY_SMOOTHINGS):
        rough = smooth_track(t, xy, covariance=covariance + noise, at_s=t, motion=motion)
        headings = _headings(rough, group)
        axes = _body_axes(placed.measurements, headings, rough.sigma_yaw_rad, group)
        geometry = moving_geometry(placed, axes, rough.velocity_mps)
        xy, covariance = geometry.xy_m, geometry.covariance
    # The box is looked for before, after and in the gaps of its track.
    tick = track.tick.tolist()
    spans = [(0, range(tick[0] - 1, -1, -1)), (len(tick) - 1, range(tick[-1] + 1, len(timeline.t_ns)))]
    spans += [(k, range(a + 1, b)) for k, (a, b) in enumerate(pairwise(tick))]
    bottom_m = float(np.median(geometry.z_m)) - geometry.size_m[2] / 2
    matches = []
    for k, wanted in spans:
        place = rough.xy_m[k], rough.velocity_mps[k], float(headings[k])
        start = BoxState(int(m.t_ns[k]), *place, geometry.size_m, bottom_m)
        matches += track_with_lidar(obstacles, wanted, timeline.t_ns, start)
    # Measurements and matches together, one at a moment.
    positions_s = timeline.seconds(np.concatenate([m.t_ns, np.array([f.t_ns for f in matches], dtype=np.int64)]))
    xy = np.concatenate([xy, np.array([match.xy_m for match in matches]).reshape(-1, 2)])
    covariance = np.concatenate([covariance, np.array([f.covariance for f in matches]).reshape(-1, 2, 2)])
    ticks = np.concatenate([track.tick, np.array([match.tick for match in matches], dtype=np.int64)])
    rows = np.argsort(positions_s, kind="stable")
    rows = rows[np.r_[True, np.diff(positions_s[rows]) > SAME_MOMENT_S]]
    positions_s, xy, covariance = positions_s[rows], xy[rows], covariance[rows]
    life = np.arange(ticks.min(), ticks.max() + 1)
    at = timeline.seconds(timeline.t_ns[life])
    if not smooth:
        motion = replace(motion, jerk_density=UNSMOOTHED_JERK_DENSITY)
    path = smooth_track(positions_s, xy, covariance=covariance + noise, at_s=at, motion=motion)
    observed = np.isin(life, ticks)
    residual = path.residual_m[path.inlier]
    quality = {
        "lidar_only": len(matches),
        "observed_share": round(float(observed.mean()), 3),
        "smoothing_residual_rms_m": round(float(np.sqrt(np.nanmean(residual**2))), 4) if len(residual) else None,
    }
    padded = np.pad(geometry.z_m, HEIGHT_MEDIAN_HALF, mode="edge")
    level = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * HEIGHT_MEDIAN_HALF + 1), axis=1)
    yaw = _headings(path, group)
    speed = signed_speed(path.velocity_mps, yaw)
    waypoints = Waypoints(
        t_s=path.t_s,
        x_m=path.xy_m[:, 0],
        y_m=path.xy_m[:, 1],
        z_m=np.interp(at, t, level),
        yaw_rad=yaw,
        speed_mps=np.where(np.abs(speed) < STANDSTILL_MPS, 0.0, speed),
        observed=observed,
        sigma_xy_m=np.sqrt(np.trace(path.covariance, axis1=1, axis2=2) / 2),
        sigma_yaw_rad=path.sigma_yaw_rad,
        sigma_speed_mps=path.sigma_speed_mps,
    )
    sigma_m = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2 + CENTER_SIGMA_M[group] ** 2)
    doubts = list(path.broken)
    # Several measurements in a row that are far from the trajectory, where not used NaN.
    beside = np.nan_to_num(path.residual_m) > np.sqrt(CHI2_2DOF_999) * sigma_m
    for span in spans_of(beside) if beside.mean() >= MIN_BESIDE_SHARE else ():
        if len(span) >= MIN_BESIDE:
            start_s, end_s = positions_s[span[[0, -1]]].tolist()
            values = {"residual_m": float(path.residual_m[span].max())}
            doubts.append(Finding("jump", start_s=start_s, end_s=end_s, values=values))
    if group == "vehicle":
        near = np.clip(np.searchsorted(at, t), 0, len(at) - 1)
        doubts += sideways_doubts(m, t, waypoints.yaw_rad[near], waypoints.speed_mps[near])
    ordered = sorted(matches, key=lambda match: match.tick)
    free = left_free(obstacles, ordered, geometry.size_m, bottom_m)
    places = np.array([match.xy_m for match in ordered]).reshape(-1, 2)[free][:MAX_PLACES]
    candidate = candidate_of(track, geometry, waypoints, quality, static=False).doubted(doubts)
    return replace(candidate, followed=independent_along(places, TYPICAL_SIZE_M[track.category][0]))


def without_boxes_laid_across(m: Measurements) -> Measurements:
    """Return the measurements (n,) of a vehicle without the boxes that lie across most of those within `TURN_S`.

    Of a long vehicle that is cut off at the edge of the view a detector may take the side that is left for an end. The center that it gives is
    off by about half a length.
    """
    axis = np.nan_to_num(m.score * np.exp(2j * m.box_yaw_rad))  # each counts by its score, up to half turns
    total, window_ns = np.cumsum(np.append(0.0, axis)), round(TURN_S * NS_PER_S)
    end, begin = np.searchsorted(m.t_ns, m.t_ns + window_ns, "right"), np.searchsorted(m.t_ns, m.t_ns - window_ns)
    across = (axis * np.conj(total[end] - total[begin])).real < 0
    error_m = np.where(across, m.box_size_m[:, 0] / 2, 0.0)
    return replace(
        m,
        box_center_m=np.where(across[:, None], np.nan, m.box_center_m),
        box_size_m=np.where(across[:, None], np.nan, m.box_size_m),
        box_yaw_rad=np.where(across, np.nan, m.box_yaw_rad),
        covariance=m.covariance + error_m[:, None, None] ** 2 * np.eye(2),
    )


def _headings(path: SmoothedTrack, group: str) -> Array:
    """Return the heading (T,) of the body: the course of its center, less the slip angle of a turning center.

    The center of a vehicle that turns about a point level with its rear axle moves at atan(offset x curvature) to it.
    """
    if group not in REAR_AXLE_SHARE:
        return path.yaw_rad
    offset = REAR_AXLE_SHARE[group] * TYPICAL_SIZE_M["car" if group == "vehicle" else "cyclist"][0]
    return wrap_angle(path.yaw_rad - np.arcsin(np.clip(offset * path.curvature_1pm, -0.5, 0.5)))


def _body_axes(m: Measurements, heading_rad: Array, sigma_rad: Array, group: str) -> Array:
    """Average the headings (n,) of a path, which have standard deviations (n,), with the axes that the sides of the body show.

    A slow path is short beside the errors of its places. Laid along its direction, the ends of a long body are off sideways, which
    bends the path further.
    """
    if group not in REAR_AXLE_SHARE:
        return heading_rad
    range_m = np.hypot(*(m.center_m - m.sensor_m)[:, :2].T)
    sigma = yaw_sigma(np.full(len(m.t_ns), group), yaw_terms(m.points, range_m, m.score))
    off = wrap_angle(2 * (m.yaw_rad - heading_rad)) / 2
    shown = np.isfinite(m.box_yaw_rad) & (np.cos(off) >= MIN_AXIS_COS)
    return heading_rad + np.where(shown, off * sigma_rad**2 / (sigma_rad**2 + sigma**2), 0.0)


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
    yaw = float(wrap_angle(2 * yaws[0])) / 2  # up to half turns, as by boxes
    return (yaw if heading_log_odds(m, yaw) >= 0 else float(wrap_angle(yaw + np.pi))), BOX_YAW_SIGMA_RAD
