"""Static agents: one pose for all ticks of a track that does not move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from log2sim.agents.box_votes import independent
from log2sim.agents.candidate import AgentCandidate, Timeline, candidate_of
from log2sim.agents.hypotheses import Part, main_place
from log2sim.agents.lidar_tracking import BoxState, match_standing
from log2sim.agents.size import TrackGeometry, static_geometry
from log2sim.agents.smooth.heading import UNKNOWN_YAW_RAD
from log2sim.agents.standing import robust_line
from log2sim.datatypes import GROUP_OF, MAX_SIZE_M, BoxEvidence, Measurements, Obstacles, Track, Waypoints
from log2sim.geometry import NS_PER_S, Array, wrap_angle
from log2sim.perception.box_fitting import rotate
from log2sim.tracking.motion import CENTER_SIGMA_M

# Standard deviations of a yaw known up to half a turn: of the box of one tick, and the least of any.
BOX_YAW_SIGMA_RAD, MIN_YAW_SIGMA_RAD = 0.1, 0.005
# What seems to stand is not faster than this, standard deviation, however short it was seen.
MAX_SPEED_SIGMA_MPS = 2.0


def static_candidates(
    parts: Sequence[Part], obstacles: Sequence[Obstacles | None], timeline: Timeline
) -> list[AgentCandidate]:
    """Make agents with one pose each, at the ticks of their tracks and wherever LiDAR points match their boxes.

    Their yaws are known up to half a turn.
    """
    geometries = [_geometry_of(part) for part in parts]
    boxes = [_box_of(part.track, geometry, timeline) for part, geometry in zip(parts, geometries)]
    matches = match_standing(obstacles, boxes, [part.track.tick for part in parts])
    return [
        _candidate(part.track, geometry, [m.tick for m in found], timeline)
        for part, geometry, found in zip(parts, geometries, matches)
    ]


def _box_of(track: Track, geometry: TrackGeometry, timeline: Timeline) -> BoxState:
    z = float(np.median(geometry.z_m))
    start_ns = int(timeline.t_ns[track.tick[0]])
    bottom_m = z - geometry.size_m[2] / 2
    return BoxState(start_ns, geometry.xy_m[0], np.zeros(2), _yaw_of(geometry), geometry.size_m, bottom_m)


def _yaw_of(geometry: TrackGeometry) -> float:
    return 0.0 if geometry.yaw_rad is None else float(np.nan_to_num(geometry.yaw_rad))


def _candidate(track: Track, geometry: TrackGeometry, matched: Sequence[int], timeline: Timeline) -> AgentCandidate:
    """Make an agent with one pose of a track that stands, whose box is matched at other ticks."""
    xy, z, yaw = geometry.xy_m[0], float(np.median(geometry.z_m)), _yaw_of(geometry)
    observed = np.union1d(track.tick, np.array(matched, dtype=np.int64))
    life = np.unique(observed[[0, -1]])
    n = len(life)
    sigma = float(np.sqrt(np.trace(np.median(geometry.covariance, axis=0)) / 2))
    waypoints = Waypoints(
        t_s=timeline.seconds(timeline.t_ns[life]),
        x_m=np.full(n, xy[0]),
        y_m=np.full(n, xy[1]),
        z_m=np.full(n, z),
        yaw_rad=np.full(n, yaw),
        speed_mps=np.zeros(n),
        observed=np.ones(n, dtype=bool),
        sigma_xy_m=np.full(n, sigma),
        sigma_yaw_rad=np.full(n, yaw_sigma(track.measurements, geometry)),
        sigma_speed_mps=np.full(n, standing_speed_sigma(track.measurements, CENTER_SIGMA_M[GROUP_OF[track.category]])),
    )
    share = len(observed) / (observed[-1] - observed[0] + 1)
    quality = {"lidar_only": len(matched), "observed_share": round(float(share), 3)}
    return candidate_of(track, geometry, waypoints, quality, static=True)


def _geometry_of(part: Part) -> TrackGeometry:
    """Estimate the geometry of a track that stands by the measurements that agree on its place.

    If all make it too large for one object, some show a part of a neighbor.
    """
    geometry = static_geometry(part.at_place or part.track)
    if part.at_place is None and _is_too_large(geometry, part.track.category):
        main = main_place(part.track)
        smaller = None if main is None else static_geometry(main)
        if smaller is not None and not _is_too_large(smaller, part.track.category):
            geometry = smaller
    n = len(part.track)
    return replace(
        geometry,
        xy_m=np.tile(geometry.xy_m[0], (n, 1)),
        covariance=np.tile(np.median(geometry.covariance, axis=0), (n, 1, 1)),
        z_m=np.full(n, np.median(geometry.z_m)),
    )


def _is_too_large(geometry: TrackGeometry, category: str) -> bool:
    return bool(np.any(geometry.size_m[:2] >= MAX_SIZE_M[category][:2]))


def standing_speed_sigma(m: Measurements, sigma_m: float) -> float:
    """Return the standard deviation in m/s of the speed of a track that stands: that of a line through its centers.

    `sigma_m` is what changing views add to the noise of a center.
    """
    variance: Array = np.linalg.eigvalsh(m.covariance)[:, -1].astype(np.float64) + sigma_m**2
    t = (m.t_ns - m.t_ns[0]) / NS_PER_S
    return min(robust_line(t, m.center_m[:, :2], variance)[2], MAX_SPEED_SIGMA_MPS)


def yaw_sigma(m: BoxEvidence, geometry: TrackGeometry) -> float:
    """Return the standard deviation in rad of the yaw of a track that stands, given that front and back are not swapped.

    Notes
    -----
    By the boxes of a 3D detector it is their scatter about the yaw, whose errors repeat from tick to tick; by points alone
    the distance of half of them from the sides of the box, seen over the length of the longest side.
    """
    if geometry.yaw_rad is None or not np.isfinite(geometry.yaw_rad):
        return UNKNOWN_YAW_RAD
    rows = np.flatnonzero(np.isfinite(m.box_yaw_rad))
    if len(rows):
        off = wrap_angle(2 * (m.box_yaw_rad[rows] - geometry.yaw_rad)) / 2
        scatter = max(float(np.sqrt(np.mean(off**2))), BOX_YAW_SIGMA_RAD / np.sqrt(len(rows)))
        sigma = scatter / np.sqrt(independent(len(rows)))
        return float(min(max(sigma, MIN_YAW_SIGMA_RAD), UNKNOWN_YAW_RAD))
    points = [cluster[:, :2] for cluster in m.cluster if len(cluster)]
    if not points:
        return UNKNOWN_YAW_RAD
    xy = rotate(np.concatenate(points) - geometry.xy_m[0], -geometry.yaw_rad)
    low, high = np.quantile(xy, 0.02, axis=0), np.quantile(xy, 0.98, axis=0)
    off_m = float(np.median(np.minimum(np.abs(xy - low), np.abs(xy - high)).min(axis=1)))
    sigma = np.arctan2(off_m, float((high - low).max()))
    return float(min(max(sigma, MIN_YAW_SIGMA_RAD), UNKNOWN_YAW_RAD))
