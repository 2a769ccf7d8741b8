"""Mounts of cameras, checked against a LiDAR and the motion of the ego.

An error of some degrees, or of the poses, hardly shows in the direction of the motion; the mount of another camera does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.config import Config
from log2sim.datatypes import Finding, Log, Treatment
from log2sim.geometry import NS_PER_S, Array, Camera, inverse, rotation_from_rpy, transform, undistort
from log2sim.localization.camera_motion import LEVELS, SPACING_PX, WINDOW_PX, follow_points
from log2sim.localization.choice import Progress, during_ns
from log2sim.localization.clocks import check_lidars, turn_mount
from log2sim.localization.edges import (
    MIN_WIDTH_PX,
    REACH_RAD,
    EdgeView,
    EdgeViews,
    YawEstimate,
    choose_moments,
    estimate_yaw,
    is_near,
    score_angles,
)
from log2sim.localization.odometry import densest_lidar, is_during
from log2sim.perception.records import RecordSource
from log2sim.plan import LABELS, Sensors

MAX_PAIRS, MIN_PAIRS = 6, 3
# The ego moves so far between two frames: errors of its poses are small against it, and a post is not taken for the next one.
MIN_APART_M, MAX_APART_M, MAX_APART_S = 0.5, 1.5, 1.0
MAX_CORNERS, CORNER_QUALITY = 300, 0.01
# Slower motions are of what is far away or moves along, or of errors of the rotation.
MIN_FLOW_RAD, MIN_MOVING = 0.01, 20
# With the own mount the cosine is 0.99 or more. Vehicles that overtake move against it, but not in all cameras.
MIN_AGREEMENT, MAX_DISAGREEMENT = 0.9, 0.3


@dataclass(frozen=True, eq=False)
class FlowPair:
    """Points followed from one frame to another."""

    first: Array  # `first`, `second`: (N, 3): rays of unit length, cam frame
    second: Array
    second_T_first: Array  # (4, 4): the motion of the ego: from its frame at the first frame to that at the second


def follow_pairs(log: Log, name: str, during_ns: tuple[int, int] | None) -> list[FlowPair]:
    """Follow points in pairs of frames of a camera on the ego, spread over the log; none where the ego stands."""
    camera, t_ns, ego, records = log.cameras[name], log.streams[name].t_ns, log.ego, RecordSource(log)
    if ego is None or camera.mount != "ego":
        return []
    pairs = []
    for first, second in _choose_pairs(log, t_ns, during_ns):
        images = [records.picture(name, row, MIN_WIDTH_PX, gray=True) for row in (first, second)]
        if images[0] is None or images[1] is None:
            continue
        rays = _follow(camera, images[0], images[1])
        poses, _ = ego.at(t_ns[[first, second]])
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
    """Find cameras in whose images points move against their own mounts, but as the mount of the other says in both: it, by camera."""
    own = {name: flow_agreement(cameras[name], pairs[name]) for name in pairs}
    against = [name for name, cosine in own.items() if cosine is not None and cosine < MAX_DISAGREEMENT]
    fits: dict[str, set[str]] = {}
    for name in against:
        mounts = {other: replace(cameras[name], mount_T_cam=cameras[other].mount_T_cam) for other in against}
        agreed = {other: flow_agreement(camera, pairs[name]) for other, camera in mounts.items() if other != name}
        fits[name] = {other for other, cosine in agreed.items() if cosine is not None and cosine > MIN_AGREEMENT}
    both = {name: [other for other in fits[name] if name in fits[other]] for name in against}
    return {name: others[0] for name, others in both.items() if len(others) == 1}


def _choose_pairs(log: Log, t_ns: NDArray[np.int64], during_ns: tuple[int, int] | None) -> list[tuple[int, int]]:
    """Choose up to `MAX_PAIRS` pairs of rows between which the ego moves by about `MIN_APART_M`."""
    assert log.ego is not None
    poses, known = log.ego.at(t_ns)
    rows = np.flatnonzero(known & is_during(t_ns, during_ns))
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
    corners = cv2.goodFeaturesToTrack(first, MAX_CORNERS, CORNER_QUALITY, SPACING_PX)
    followed = follow_points(first, second, corners, window_px=WINDOW_PX, levels=LEVELS)
    scale = first.shape[1] / camera.width_px
    xy = [undistort(camera, (px + 0.5) / scale - 0.5) for px in followed]
    usable = np.isfinite(xy[0]).all(axis=1) & np.isfinite(xy[1]).all(axis=1)
    rays = [np.column_stack([side[usable], np.ones(int(usable.sum()))]) for side in xy]
    unit = [ray / np.linalg.norm(ray, axis=1)[:, None] for ray in rays]
    return unit[0], unit[1]


# What may be left of the yaw with the mount of another camera.
MAX_LEFT_RAD = np.deg2rad(1.5)
# A camera that is turned far is looked at again from there, so that the whole range of angles lies around it.
MAX_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class MountCheck:
    """What the mounts of a log are checked with, and what came of it."""

    log: Log
    views: Mapping[str, list[EdgeView]]  # by camera, of those beside the LiDAR
    yaws: Mapping[str, YawEstimate | None]  # by camera, with its own mount; None where it is not known


@dataclass(frozen=True, eq=False)
class Mistake:
    """A mount that fits the images of a camera where its own does not."""

    fault: Finding  # whose `other` is the camera whose mount it is; "" for none
    mount_T_cam: Array  # (4, 4): what fits
    certain: bool = True  # whether the run rather goes on without the camera


def estimate_mount_yaw(camera: Camera, views: list[EdgeView]) -> YawEstimate | None:
    """Estimate the yaw that the mount of a camera lacks."""
    turned_rad = 0.0
    for _ in range(MAX_ROUNDS):
        turned = replace(camera, mount_T_cam=turn_by(camera.mount_T_cam, turned_rad))
        found = estimate_yaw([score_angles(turned, view) for view in views])
        if found is None:
            return None
        turned_rad += found.yaw_rad
        if abs(found.yaw_rad) < REACH_RAD / 2:
            return replace(found, yaw_rad=turned_rad)
    return None


def find_mistakes(check: MountCheck, during_ns: tuple[int, int] | None) -> dict[str, Mistake]:
    """Find the cameras of which the own mount does not fit while another one does, within some time."""
    by_edges = _find_by_edges(check)
    found = dict(by_edges)
    for name, mistake in by_edges.items():
        # A camera whose mount is another one's, though its own images do not show it, gets what that one had.
        other = mistake.fault.other
        if other and other not in by_edges:
            fault = Finding("swapped_cameras", other, other=name, case="exchanged")
            found[other] = Mistake(fault, check.log.cameras[name].mount_T_cam)
    unseen = [name for name, yaw in check.yaws.items() if yaw is None and name not in found]
    return found | _find_by_flow(check, unseen, during_ns)


def _find_by_edges(check: MountCheck) -> dict[str, Mistake]:
    """Find the cameras whose images edges fit with another mount: the one with the clearest edges."""
    mistakes = {}
    for name, yaw in check.yaws.items():
        camera, best = check.log.cameras[name], 0.0
        for mistake in _list_mistakes(check, name) if yaw is None and check.views.get(name) else ():
            found = estimate_mount_yaw(replace(camera, mount_T_cam=mistake.mount_T_cam), check.views[name])
            if found is not None and abs(found.yaw_rad) < MAX_LEFT_RAD and found.gain > best:
                mistakes[name], best = mistake, found.gain
    return mistakes


def _list_mistakes(check: MountCheck, name: str) -> list[Mistake]:
    """List the mounts that a camera may have instead of its own: those of others that do not fit them either, and likely slips."""
    cameras, own = check.log.cameras, check.log.cameras[name].mount_T_cam
    others = [other for other, yaw in check.yaws.items() if other != name and yaw is None]
    listed = [
        Mistake(Finding("swapped_cameras", name, other=other, case="edges"), cameras[other].mount_T_cam)
        for other in others
    ]
    listed.append(Mistake(Finding("wrong_mount", name, case="inverted"), inverse(own)))
    for degrees in (90, 180, 270):
        about_axis = transform(rotation_from_rpy(0.0, 0.0, np.deg2rad(degrees)), np.zeros(3))
        turned = Finding("wrong_mount", name, values={"turn_deg": float(degrees)}, case="turned")
        listed.append(Mistake(turned, own @ about_axis))
    return listed


def _find_by_flow(check: MountCheck, names: Sequence[str], during_ns: tuple[int, int] | None) -> dict[str, Mistake]:
    """Find cameras with each other's mounts among those that show no edges, by how points move in their images.

    Only where some camera agrees with the motion of the ego, so that the poses are not those that are turned around.
    """
    if len(names) < 2:
        return {}
    log = check.log
    pairs = {name: follow_pairs(log, name, during_ns) for name in names}
    known = any(yaw is not None for yaw in check.yaws.values())
    if not known and not any((flow_agreement(log.cameras[name], pairs[name]) or 0.0) > MIN_AGREEMENT for name in names):
        return {}
    return {
        name: Mistake(
            Finding("swapped_cameras", name, other=other, case="flow"), log.cameras[other].mount_T_cam, certain=False
        )
        for name, other in find_exchanged(log.cameras, pairs).items()
    }


def turn_by(mount_T_cam: Array, yaw_rad: float) -> Array:
    """Turn a mount (4, 4) about the upright axis through the camera."""
    return turn_mount(mount_T_cam, np.array([0.0, 0.0, yaw_rad]))


# At 30 m this is 0.3 m, half the width of a pedestrian: LiDAR points leave the image boxes of their objects.
MIN_TOLD_RAD = 0.01
MIN_SIGMAS = 4.0
# Up to half of that, a camera is sound whatever more frames say.
SOUND_RAD = MIN_TOLD_RAD / 2


def check_cameras(
    log: Log,
    config: Config,
    sensors: Sensors,
    *,
    of_lidars: tuple[Finding, ...] = (),
    progress: Progress,
) -> tuple[Log, tuple[Finding, ...]]:
    """Return the log, corrected where the settings ask for it, and what is wrong with the cameras that the run uses.

    Against a LiDAR that `of_lidars` finds wrong and the run does not correct they are not checked. No yaw is estimated of a camera
    with which no LiDAR is mounted, that shows no edges, or of which several angles fit alike; and no image is read where boxes come
    from the log. Where all cameras are turned alike, it is the LiDAR that is.
    """
    if config.detect.in_images in ("", LABELS):
        return log, ()
    lidar = densest_lidar(sensors.restrict(log)) or ""
    doubtful = {f.subject for f in of_lidars if f.treatment == "kept" and f.kind in ("time_offset", "lidar_rotation")}
    lidar = "" if lidar in doubtful else lidar
    check = _look(log, lidar, config, sensors, progress)
    fix = config.calibration.fix_mounts
    treatment: Treatment = "corrected" if fix else "kept"
    mistakes = find_mistakes(check, during_ns(log, config))
    mounts = {name: mistake.mount_T_cam for name, mistake in mistakes.items()}
    # Cameras with wrong mounts are left out where the run can go on without them.
    certain = {name for name, mistake in mistakes.items() if mistake.certain}
    goes_on = bool(set(sensors.cameras) - certain) and config.sync.reference not in certain
    left_out: set[str] = certain if goes_on and not fix else set()
    faults = [
        replace(mistake.fault, treatment="left_out" if name in left_out else treatment)
        for name, mistake in mistakes.items()
    ]
    off = {name: yaw for name, yaw in check.yaws.items() if yaw is not None and is_off(yaw)}
    if turns_together(check.yaws):
        # The mount of the LiDAR is told, with which that of no camera agrees; corrected are those of the cameras.
        angle, sigma = np.array([(yaw.yaw_rad, yaw.sigma_rad) for yaw in off.values()]).T
        values = {
            "yaw_deg": float(np.rad2deg(np.average(angle, weights=1 / sigma**2))),
            "yaw_sigma_deg": float(np.rad2deg(sigma.max())),
        }
        faults.append(Finding("lidar_rotation", lidar, treatment, values=values, other=", ".join(off), case="edges"))
    else:
        case = "either" if sum(yaw is not None for yaw in check.yaws.values()) == 1 else "camera"
        faults += [
            Finding(
                "camera_rotation", name, treatment, other=lidar, case=case,
                # Of the mount in the calibration against the truth: minus the yaw that it lacks.
                values={"yaw_deg": float(np.rad2deg(-yaw.yaw_rad)), "yaw_sigma_deg": float(np.rad2deg(yaw.sigma_rad))},
            )
            for name, yaw in off.items()
        ]  # fmt: skip
    mounts |= {name: turn_by(log.cameras[name].mount_T_cam, yaw.yaw_rad) for name, yaw in off.items()}
    unknown = [name for name, yaw in check.yaws.items() if fix and lidar and yaw is None and name not in mistakes]
    faults += [Finding("unknown_rotation", name, other=lidar, case="edges") for name in unknown]
    if fix and mounts:
        moved = {name: replace(log.cameras[name], mount_T_cam=mount_T_cam) for name, mount_T_cam in mounts.items()}
        log = log.changed(cameras={**log.cameras, **moved})
    return log, tuple(faults)


def is_off(yaw: YawEstimate) -> bool:
    """Return whether a camera is turned significantly, and by so much that it matters."""
    return abs(yaw.yaw_rad) > max(MIN_TOLD_RAD, MIN_SIGMAS * yaw.sigma_rad)


def turns_together(yaws: Mapping[str, YawEstimate | None]) -> bool:
    """Return whether several cameras are turned against the LiDAR, all by the same angle, so that it may be the LiDAR's."""
    known = [yaw for yaw in yaws.values() if yaw is not None]
    angles, sigmas = np.array([y.yaw_rad for y in known]), np.array([y.sigma_rad for y in known])
    if len(known) < 2 or not all(is_off(yaw) for yaw in known):
        return False
    mean = float(np.average(angles, weights=1 / sigmas**2))
    return bool(np.all(np.abs(angles - mean) < MIN_SIGMAS * sigmas))


def _look(log: Log, lidar: str, config: Config, sensors: Sensors, progress: Progress) -> MountCheck:
    """Look at frames of the cameras beside a LiDAR and at its sweeps, over the log."""
    unknown = dict.fromkeys(sensors.cameras)
    names = [name for name in sensors.cameras if lidar and is_near(log, name, lidar)]
    if not names:
        return MountCheck(log, {}, unknown)
    reference = log.reference_camera if log.reference_camera in names else names[0]
    moments = choose_moments(log, lidar, reference, during_ns(log, config))
    seen = EdgeViews(log, moments, lambda done, total: progress("check cameras", done, total))
    views, yaws = {}, {}
    for name in names:
        # By every second moment, and by all where those do not show that a camera is sound.
        for every in (2, 1):
            views[name] = seen.of_camera(name, every=every)
            yaws[name] = found = estimate_mount_yaw(log.cameras[name], views[name])
            if found is not None and abs(found.yaw_rad) < SOUND_RAD:
                break
    progress("check cameras", len(moments.sweeps), len(moments.sweeps))
    return MountCheck(log, views, unknown | yaws)


def check_calibration(
    log: Log, config: Config, sensors: Sensors, *, progress: Progress
) -> tuple[Log, tuple[Finding, ...]]:
    """Estimate offsets of clocks and rotations of mounts: the log with the corrections that the settings ask for, and the faults."""
    if not config.calibration.check:
        return log, ()
    log, of_lidars = check_lidars(log, config, sensors, progress=progress)
    log, of_cameras = check_cameras(log, config, sensors, of_lidars=of_lidars, progress=progress)
    return log, (*of_lidars, *of_cameras)
