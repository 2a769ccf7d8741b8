"""Which poses a run uses: those of the log, or others that are estimated from its sensors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.config import Config
from log2sim.datatypes import Finding, Log
from log2sim.errors import ConfigError, LogError
from log2sim.files.documents import rounded
from log2sim.geometry import NS_PER_S, Array, PoseTrack, inverse, nearest_index, period_of
from log2sim.localization.camera_motion import CameraPath, follow_camera, motion_camera
from log2sim.localization.given_poses import Stretch, check_poses
from log2sim.localization.odometry import (
    Odometry,
    densest_lidar,
    is_installed,
    lidars_on_ego,
    read_ego_sweep,
    run_odometry,
)
from log2sim.localization.pose_refinement import refine_poses
from log2sim.localization.replaced import replace_poses
from log2sim.localization.verdict import (
    bridge_by_lidar,
    compare_with_given,
    fit_to_given,
    level_on_ground,
    unsure_share,
)

# What a scenario says about the ego by the source of its poses.
ORIGINS = {"given": "ego poses of the log", "lidar": "LiDAR odometry", "camera": "camera motion"}


@dataclass(frozen=True, eq=False)
class PoseChoice:
    """Where the poses of a run come from, and why."""

    requested: str  # as the settings say
    # {"given", "lidar", "camera", "none"}: "none": no sensor is on an ego whose pose would have to be known
    source: str
    reason: str  # for people
    # How far given poses are off against each other by the surroundings, beyond what odometry leaves: "neighbors",
    # "apart"; empty where nothing was compared
    excess_m: Mapping[str, float | None] = field(default_factory=dict)
    # RMS distance between upright surfaces of pairs of sweeps by the poses "given" and "lidar"
    scatter_m: Mapping[str, Mapping[str, float | None]] = field(default_factory=dict)
    # Figures of the odometry, JSON values; empty where none was run
    estimate: Mapping[str, Any] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()  # what is doubtful about estimated poses
    # (int, int): first and last stamp of what poses were estimated from; None for the whole log
    during_ns: tuple[int, int] | None = None
    stretches: tuple[Stretch, ...] = ()  # in which given poses were repaired or are not known
    checked: bool = True  # whether given poses were checked, and repaired where that was needed
    # Poses by which the ground is drawn, where given ones drift by less than agents are misplaced anyway
    for_map: PoseTrack | None = None

    @property
    def origin(self) -> str:
        """Name what the ego's path comes from."""
        return ORIGINS.get(self.source, "none")

    def to_dict(self) -> dict[str, Any]:
        """Return the entry `poses` of `schemas/report-1.json`."""
        return {
            "requested": self.requested,
            "source": self.source,
            "reason": self.reason,
            "scatter_m": {name: dict(values) for name, values in self.scatter_m.items()},
            "excess_m": dict(self.excess_m),
            "estimate": dict(self.estimate),
            "notes": [finding.sentence for finding in self.findings],
        }

    def to_provenance(self) -> dict[str, Any]:
        """Return what `localize_like` needs to find the same poses again."""
        during = {} if self.during_ns is None else {"during_ns": list(self.during_ns)}
        unchecked = {} if self.checked else {"check": False}
        return {"source": self.source, **during, **unchecked}


GIVEN = PoseChoice("given", "given", "the log's own poses")


def odometry_figures(found: Odometry) -> dict[str, Any]:
    """Collect the figures of an odometry for the report."""
    return {
        "lidar": found.lidar,
        "sweeps": found.sweeps,
        "poses": len(found.t_ns),
        "predicted": int(found.predicted.sum()),
        "degenerate": int(found.degenerate.sum()),
        "problems": found.problems,
        "path_m": rounded(found.path_m, 3),
        "overlap_median": _median(found.overlap),
        "residual_median": _median(found.residual),
        "constraint_median": _median(found.constraint),
    }


def camera_figures(found: CameraPath) -> dict[str, Any]:
    """Collect the figures of camera motion for the report."""
    steps = np.diff(found.start_T_ego[:, :3, 3], axis=0)
    return {
        "camera": found.camera,
        "frames": found.frames,
        "poses": len(found.t_ns),
        "predicted": int(found.predicted.sum()),
        "path_m": rounded(float(np.linalg.norm(steps, axis=1).sum()), 3),
        "points_on_road_median": found.on_road,
    }


def _median(values: Array) -> float | None:
    """Return the median of what is known, rounded."""
    known = values[np.isfinite(values)]
    return rounded(float(np.median(known)), 4) if len(known) else None


# Without given poses odometry is still taken where up to this share of its poses is poorly held or predicted.
MAX_UNSURE_SHARE_ALONE = 0.5
LIDAR_FAULTS = ("time_offset", "lidar_rotation", "lidar_translation")
# Sweeps this long before and after the time that is used are registered too.
MARGIN_S = 1.0

Progress = Callable[[str, int, int], None]


def localize(log: Log, config: Config, *, progress: Progress | None = None) -> tuple[Log, PoseChoice]:
    """Return the log with the poses that the settings ask for, and where they come from.

    Raises `ConfigError` for poses from a sensor that the log does not have, `LogError` for a log without poses whose sensors do not
    show how the ego moves, `MissingExtra` for LiDAR odometry without its library.
    """
    progress = progress or (lambda *_: None)
    return _localize(_Request(log, config.poses.source, during_ns(log, config), progress, check=config.poses.check))


def localize_like(log: Log, provenance: Mapping[str, Any]) -> Log:
    """Return a log with the poses that something was made with, as its provenance states them under "poses", else its own."""
    entry = provenance.get("poses")
    entry = entry if isinstance(entry, Mapping) else {}
    source, during = entry.get("source"), entry.get("during_ns")
    if not isinstance(source, str) or source not in ORIGINS:
        return log
    window = None
    if isinstance(during, Sequence) and len(during) == 2 and all(type(t) is int for t in during):
        window = (int(during[0]), int(during[1]))
    check = entry.get("check") is not False
    return _localize(_Request(log, source, window, lambda *_: None, check=check))[0]


@dataclass(frozen=True, eq=False)
class _Request:
    """What to localize, how, from which part, and whether poses of the log are checked first."""

    log: Log
    requested: str
    during_ns: tuple[int, int] | None
    progress: Progress
    check: bool = True

    def answer(self, source: str, reason: str, **found: Any) -> PoseChoice:
        """Return the choice of a source."""
        return PoseChoice(self.requested, source, reason, during_ns=self.during_ns, **found)


def _localize(request: _Request) -> tuple[Log, PoseChoice]:
    """Check the poses of the log, then choose between them and others."""
    if request.log.ego is None or not request.check:
        log, choice = _choose(request)
        return log, replace(choice, checked=request.check)
    given = request.log.ego
    checked = bridge_by_lidar(request.log, check_poses(given), partial(request.progress, "odometry"))
    if checked.track is given:
        mended = request.log
    elif checked.moved:
        # What was measured in gaps moves with the poses around them.
        mended = replace_poses(request.log.changed(ego=replace(given, max_gap_s=np.inf)), checked.track)
    else:
        mended = request.log.changed(ego=checked.track)
    log, choice = _choose(replace(request, log=mended))
    return log, replace(choice, stretches=checked.stretches) if checked.stretches else choice


def refine_for_map(log: Log, choice: PoseChoice, faults: Sequence[Finding] = ()) -> PoseChoice:
    """Return a choice with the poses by which sweeps lie on each other, where those of the log can be refined.

    The ground is drawn by them. Agents keep the given poses: by refined ones their positions were nearer to the labels on a KITTI
    drive, but their sizes and speeds worse, and most simulated drives were worse throughout. `faults`: of a LiDAR's clock and
    mount, by which its sweeps show a wrong motion; then nothing is refined.
    """
    wrong = any(fault.treatment == "kept" and fault.kind in LIDAR_FAULTS for fault in faults)
    if choice.source != "given" or not choice.checked or wrong:
        return choice
    return replace(choice, for_map=refine_poses(log, choice.during_ns))


def _choose(request: _Request) -> tuple[Log, PoseChoice]:
    log, requested = request.log, request.requested
    mounts = _mounts(log)
    if log.ego is None and "ego" not in mounts:
        return log, PoseChoice(requested, "none", "all sensors are fixed in the map")
    if log.ego is not None and requested == "given":
        return log, replace(GIVEN, during_ns=request.during_ns)
    if log.ego is None and "map" in mounts:
        reason = "the log has no poses that relate the ego's sensors to those fixed in the map"
        return log, PoseChoice(requested, "none", reason)
    if requested == "camera" or (log.ego is None and requested != "lidar" and not lidars_on_ego(log)):
        return _by_camera(request)
    return _by_lidar(request)


def _mounts(log: Log) -> set[str]:
    """Return what the sensors of a log are fixed to."""
    return {c.mount for c in log.cameras.values()} | {lidar.mount for lidar in log.lidars.values()}


def _by_camera(request: _Request) -> tuple[Log, PoseChoice]:
    """Estimate poses by the motion of a camera."""
    log = request.log
    progress = partial(request.progress, "camera motion")
    found = follow_camera(log, motion_camera(log), during_ns=request.during_ns, progress=progress)
    track, frame = _in_map(log, PoseTrack(found.t_ns, found.start_T_ego, _max_gap_s(found.t_ns)))
    estimate = {**camera_figures(found), **_difference(track, log.ego), "frame": frame}
    findings = (Finding("planar_motion", "ego"), *_predicted("camera motion", found.predicted))
    reason = "the log has no poses and no LiDAR on the ego" + _unplaced(log)
    reason = "as requested" if request.requested == "camera" else reason
    return replace_poses(log, track), request.answer("camera", reason, estimate=estimate, findings=findings)


def _by_lidar(request: _Request) -> tuple[Log, PoseChoice]:
    """Estimate poses by LiDAR odometry; where the log has poses and may keep them, decide which are better."""
    log, requested = request.log, request.requested
    may_keep = log.ego is not None and requested == "auto"
    if may_keep and not is_installed():
        reason = "not compared with LiDAR odometry, whose extra 'odometry' is not installed"
        return log, PoseChoice(requested, "given", reason)
    lidar = densest_lidar(log)
    if lidar is None:
        if may_keep:
            return log, PoseChoice(requested, "given", "the log has no LiDAR on the ego to compare them with")
        raise ConfigError(
            f"--poses {requested}: {log.name} has no LiDAR on the ego that can be read; choose given or camera"
        )
    stamps = log.streams[lidar].t_ns
    if log.ego is None and len(stamps) == 1:
        # The ego's frame at the only sweep is the map.
        track, frame = _in_map(log, PoseTrack(stamps, np.eye(4)[None]), lidar)
        reason = "the log has no poses and a single sweep, whose frame is the map"
        estimate: dict[str, Any] = {"lidar": lidar, "sweeps": 1, "poses": 1, "frame": frame}
        return replace_poses(log, track), request.answer("lidar", reason, estimate=estimate)
    try:
        found = run_odometry(log, lidar, during_ns=request.during_ns, progress=partial(request.progress, "odometry"))
    except LogError as problem:
        if not may_keep:
            raise
        return log, PoseChoice(requested, "given", f"nothing to compare them with: {problem}")
    track, frame = _in_map(log, PoseTrack(found.t_ns, found.odom_T_ego, _max_gap_s(found.t_ns)), lidar)
    estimate = {**odometry_figures(found), **_difference(track, log.ego), "frame": frame}
    if may_keep:
        verdict = compare_with_given(log, found, track)
        choice = request.answer(
            "given" if verdict.keep else "lidar", verdict.reason, excess_m=verdict.excess_m, scatter_m=verdict.scatter_m,
            estimate=estimate, findings=_doubts(log, found),
        )  # fmt: skip
        return (log if verdict.keep else replace_poses(log, track)), choice
    unsure = unsure_share(found)
    if log.ego is None and unsure > MAX_UNSURE_SHARE_ALONE:
        raise LogError(
            f"{log.name}: the log has no ego poses, and LiDAR odometry cannot tell how the ego moves: {unsure:.0%} of the "
            "sweeps show too little that holds it, as in a tunnel or on an empty road; give poses"
        )
    reason = "as requested" if requested == "lidar" else "the log has no poses" + _unplaced(log)
    return replace_poses(log, track), request.answer("lidar", reason, estimate=estimate, findings=_doubts(log, found))


def during_ns(log: Log, config: Config) -> tuple[int, int] | None:
    """Return the first and last stamp for which poses are needed; None for all."""
    if config.start_s is None and config.stop_s is None:
        return None
    stamps = [s.t_ns for s in log.streams.values() if len(s.t_ns)]
    first, last = min(int(t[0]) for t in stamps), max(int(t[-1]) for t in stamps)
    begin = first if config.start_s is None else first + round((config.start_s - MARGIN_S) * NS_PER_S)
    # Sensors may begin at different times; seconds count from the first tick of the reference, which is not chosen yet.
    latest = max(int(t[0]) for t in stamps)
    end = last if config.stop_s is None else latest + round((config.stop_s + MARGIN_S) * NS_PER_S)
    return begin, end


def _max_gap_s(t_ns: NDArray[np.int64]) -> float:
    """Return the gap over which estimated poses are interpolated, s: one missing record more than usual."""
    return max(1.0, 2.5 * period_of(t_ns))


def _in_map(log: Log, estimated: PoseTrack, lidar: str | None = None) -> tuple[PoseTrack, str]:
    """Place an estimated path in the map of the log, or on the ground under its first sweep, and say which."""
    map_T_start = None if log.ego is None else fit_to_given(estimated, log.ego)
    frame = "fitted to the given poses"
    if map_T_start is None:
        sweep = None
        if lidar is not None:
            nearest = int(nearest_index(log.streams[lidar].t_ns, int(estimated.t_ns[0]))[0])
            sweep = read_ego_sweep(log, lidar, nearest)
        level = None if sweep is None else level_on_ground(sweep.xyz_m, log.ground_z_ego_m)
        frame = "the ego's at the first pose" + ("" if level is None else ", level on the ground")
        map_T_start = np.eye(4) if level is None else level
    return replace(estimated, map_T_ego=map_T_start @ estimated.map_T_ego), frame


def _unplaced(log: Log) -> str:
    """Say that without poses the map of a log is not where the log places it on Earth; nothing where it names no place."""
    return "" if log.map.projection is None else "; the map begins at the ego, not where the log places it on Earth"


def _difference(track: PoseTrack, given: PoseTrack | None) -> dict[str, Any]:
    """Compute how far the positions of estimated poses are from given ones; nothing where there are none."""
    map_T_ego, known = (track.map_T_ego, np.zeros(1, dtype=bool)) if given is None else given.at(track.t_ns)
    if not known.any():
        return {}
    off = inverse(map_T_ego[known]) @ track.map_T_ego[known]
    return {"given_difference_rms_m": rounded(float(np.sqrt(np.mean(np.sum(off[:, :3, 3] ** 2, axis=1)))), 4)}


def _doubts(log: Log, found: Odometry) -> tuple[Finding, ...]:
    """List what is doubtful about the poses of an odometry that replace those of a log."""
    findings = [Finding("moved_ego", "ego")] if log.ego is not None and "map" in _mounts(log) else []
    if found.degenerate.any():
        counts = {"count": float(found.degenerate.sum()), "total": float(len(found.t_ns))}
        findings.append(Finding("degenerate_sweeps", "ego", values=counts))
    findings += _predicted("LiDAR odometry", found.predicted)
    if found.problems:
        reasons = ", ".join(f"{reason} ({count})" for reason, count in found.problems.items())
        findings.append(Finding("sweeps_without_pose", "ego", other=reasons))
    return tuple(findings)


def _predicted(source: str, predicted: NDArray[np.bool_]) -> list[Finding]:
    """Count the poses (N,) that were predicted where nothing was measured, if any."""
    counts = {"count": float(predicted.sum()), "total": float(len(predicted))}
    return [Finding("predicted_poses", "ego", values=counts, other=source)] if predicted.any() else []
