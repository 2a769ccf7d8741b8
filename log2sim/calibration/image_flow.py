"""Whether points move in the images of a camera as its mount and the motion of the ego say.

An error of some degrees, or of the poses, hardly shows in the direction of the motion; the mount of another camera does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.calibration.gray_images import read_gray
from log2sim.datatypes import Log
from log2sim.geometry import NS_PER_S, Array, Camera, inverse, undistort
from log2sim.localization.road_view import FollowSettings, follow_points

MAX_PAIRS, MIN_PAIRS = 6, 3
# The ego moves so far between two frames: errors of its poses are small against it, and a post is not taken for the next one.
MIN_APART_M, MAX_APART_M, MAX_APART_S = 0.5, 1.5, 1.0
MAX_CORNERS, CORNER_QUALITY, SPACING_PX, WINDOW_PX, LEVELS = 300, 0.01, 9, 21, 4
# Slower motions are of what is far away or moves along, or of errors of the rotation.
MIN_FLOW_RAD, MIN_MOVING = 0.01, 20
# With the own mount the cosine is 0.99 or more. Vehicles that overtake move against it, but not in all cameras.
MIN_AGREEMENT, MAX_DISAGREEMENT = 0.9, 0.3


@dataclass(frozen=True, eq=False)
class FlowPair:
    """Points followed from one frame to another.

    Attributes
    ----------
    first, second : (N, 3) float64
        Rays of unit length, cam frame.
    second_T_first : (4, 4) float64
        The motion of the ego: from its frame at the first frame to that at the second.
    """

    first: Array
    second: Array
    second_T_first: Array


def follow_pairs(log: Log, name: str, during_ns: tuple[int, int] | None) -> list[FlowPair]:
    """Follow points in pairs of frames of a camera on the ego, spread over the log; none where the ego stands."""
    camera, stream, ego = log.cameras[name], log.streams[name], log.ego
    if ego is None or camera.mount != "ego":
        return []
    pairs = []
    for first, second in _choose_pairs(log, stream.t_ns, during_ns):
        images = [read_gray(stream, row, camera) for row in (first, second)]
        if images[0] is None or images[1] is None:
            continue
        rays = _follow(camera, images[0], images[1])
        poses, _ = ego.at(stream.t_ns[[first, second]])
        pairs.append(FlowPair(rays[0], rays[1], inverse(poses[1]) @ poses[0]))
    return pairs


def flow_agreement(camera: Camera, pairs: Sequence[FlowPair]) -> float | None:
    """Compute how well points move as they should: median cosine of the angle to the direction in which what stands moves.

    Over the pairs with enough points that move; None with too few such pairs.
    """
    mount_R_cam, position = camera.mount_T_cam[:3, :3], camera.mount_T_cam[:3, 3]
    medians = []
    for pair in pairs:
        turn, shift = pair.second_T_first[:3, :3], pair.second_T_first[:3, 3]
        # In the axes of the ego, the points move by this against the camera.
        moved = turn @ position + shift - position
        before, after = pair.first @ (turn @ mount_R_cam).T, pair.second @ mount_R_cam.T
        flow, expected = after - before, moved - (before @ moved)[:, None] * before
        size, expected_size = np.linalg.norm(flow, axis=1), np.linalg.norm(expected, axis=1)
        moves = (size > MIN_FLOW_RAD) & (expected_size > 0)
        if moves.sum() >= MIN_MOVING:
            cosine = (flow[moves] * expected[moves]).sum(axis=1) / (size[moves] * expected_size[moves])
            medians.append(float(np.median(cosine)))
    return float(np.median(medians)) if len(medians) >= MIN_PAIRS else None


def find_exchanged(cameras: Mapping[str, Camera], pairs: Mapping[str, Sequence[FlowPair]]) -> dict[str, str]:
    """Find cameras in whose images points move against their own mounts, but as the mount of the other says in both.

    Parameters
    ----------
    cameras : mapping of str to Camera
    pairs : mapping of str to sequence of FlowPair
        By camera, of those that may be exchanged.

    Returns
    -------
    dict of str to str
        The other camera, by camera.
    """
    own = {name: flow_agreement(cameras[name], pairs[name]) for name in pairs}
    against = [name for name, cosine in own.items() if cosine is not None and cosine < MAX_DISAGREEMENT]
    fits: dict[str, set[str]] = {}
    for name in against:
        mounts = {other: replace(cameras[name], mount_T_cam=cameras[other].mount_T_cam) for other in against}
        agreed = {other: flow_agreement(camera, pairs[name]) for other, camera in mounts.items() if other != name}
        fits[name] = {other for other, cosine in agreed.items() if cosine is not None and cosine > MIN_AGREEMENT}
    both = {name: [other for other in fits[name] if name in fits[other]] for name in against}
    return {name: others[0] for name, others in both.items() if len(others) == 1}


def agrees(camera: Camera, pairs: Sequence[FlowPair]) -> bool:
    """Return whether points move in the images of a camera as its mount says."""
    cosine = flow_agreement(camera, pairs)
    return cosine is not None and cosine > MIN_AGREEMENT


def _choose_pairs(log: Log, t_ns: NDArray[np.int64], during_ns: tuple[int, int] | None) -> list[tuple[int, int]]:
    """Choose up to `MAX_PAIRS` pairs of rows between which the ego moves by about `MIN_APART_M`."""
    assert log.ego is not None
    poses, known = log.ego.at(t_ns) if len(t_ns) else (np.zeros((0, 4, 4)), np.zeros(0, dtype=bool))
    if during_ns is not None:
        known &= (t_ns >= during_ns[0]) & (t_ns <= during_ns[1])
    rows = np.flatnonzero(known)
    if len(rows) < 2:
        return []
    place = poses[rows, :3, 3]
    path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))])
    later = np.searchsorted(path_m, path_m + MIN_APART_M)
    first = np.flatnonzero(later < len(rows))
    second = later[first]
    apart_s = (t_ns[rows[second]] - t_ns[rows[first]]) / NS_PER_S
    near = (path_m[second] - path_m[first] < MAX_APART_M) & (apart_s < MAX_APART_S)
    first, second = first[near], second[near]
    if not len(first):
        return []
    chosen = np.unique(np.floor((np.arange(MAX_PAIRS) + 0.5) / MAX_PAIRS * len(first)).astype(np.int64))
    return [(int(rows[first[k]]), int(rows[second[k]])) for k in chosen]


def _follow(camera: Camera, first: NDArray[np.uint8], second: NDArray[np.uint8]) -> tuple[Array, Array]:
    """Follow corners from one image to another: rays (N, 3), (N, 3) of unit length."""
    import cv2

    corners = cv2.goodFeaturesToTrack(first, MAX_CORNERS, CORNER_QUALITY, SPACING_PX)
    followed = follow_points(first, second, corners, FollowSettings(WINDOW_PX, LEVELS))
    scale = first.shape[1] / camera.width_px
    xy = [undistort(camera, (px + 0.5) / scale - 0.5) for px in followed]
    usable = np.isfinite(xy[0]).all(axis=1) & np.isfinite(xy[1]).all(axis=1)
    rays = [np.column_stack([side[usable], np.ones(int(usable.sum()))]) for side in xy]
    unit = [ray / np.linalg.norm(ray, axis=1)[:, None] for ray in rays]
    return unit[0], unit[1]
