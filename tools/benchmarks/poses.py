"""Compare the ego poses of a log with LiDAR odometry, or with camera motion.

    OPENBLAS_NUM_THREADS=1 python tools/bench.py poses LOG --source lidar|camera

- ATE: RMS distance of the estimated positions to the given ones, after the best rigid alignment of the positions; beside it
  the same as placed in the map, without it. What is wrong in the given poses counts as well.
- RPE: RMS difference of the motions from each sweep to the next, in m and degrees.
- Parked cars: RMS distance of the centers of a labeled vehicle that stands, from their mean, over its labels. Labels that were made
  once for a parked object in the map of the given poses scatter by nothing with these, which then says nothing.
- Surfaces: the measure by which `--poses auto` decides, for sweeps in succession and two seconds apart.
- ms: CPU time of the odometry for a sweep, reading it included.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.table import markdown
from log2sim import Config, open_log
from log2sim.datatypes import GROUP_OF, Labels
from log2sim.geometry import Array, PoseTrack, inverse, nearest_rotation
from log2sim.localization.choice import localize
from log2sim.localization.odometry import densest_lidar
from log2sim.localization.verdict import compare_poses

MIN_LABELS, MIN_SEEN_S = 10, 1.0
# A vehicle stands where a line through its positions is slower than this by one of the poses.
MAX_STANDING_MPS = 0.3


def path_errors(estimated: PoseTrack, given: PoseTrack) -> str:
    """ATE and RPE at the stamps of the estimated poses, in words."""
    at, known = given.at(estimated.t_ns)
    ours, theirs = estimated.map_T_ego[known], at[known]
    xyz, reference = ours[:, :3, 3], theirs[:, :3, 3]
    # Points are laid on others best by the method of Kabsch.
    rotation = nearest_rotation((reference - reference.mean(axis=0)).T @ (xyz - xyz.mean(axis=0)))
    laid = (xyz - xyz.mean(axis=0)) @ rotation.T + reference.mean(axis=0)
    off = inverse(inverse(theirs[:-1]) @ theirs[1:]) @ (inverse(ours[:-1]) @ ours[1:])
    angle = np.arccos(np.clip((np.trace(off[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
    apart = (laid - reference, xyz - reference, off[:, :3, 3])
    ate, placed, rpe = (rms(np.linalg.norm(v, axis=1)) for v in apart)
    path_m = float(np.linalg.norm(np.diff(xyz, axis=0), axis=1).sum())
    return f"path {path_m:.2f} m, ATE {ate:.3f} m (as placed {placed:.3f} m), RPE {rpe:.3f} m, {np.rad2deg(rms(angle)):.3f} degrees"


def standing_vehicles(sources: Sequence[Labels]) -> list[list[float]]:
    """Scatter in m by pose source of each labeled vehicle that stands."""
    stamps = [set(zip(labels.track_id.tolist(), labels.t_ns.tolist())) for labels in sources]
    common, out = set.intersection(*stamps), []
    named = zip(sources[0].track_id.tolist(), sources[0].category.tolist())
    for track in sorted({t for t, c in named if GROUP_OF.get(c) == "vehicle"}):
        scatter, drift_mps, t_s = [], [], np.zeros(0)
        for labels in sources:
            rows = [k for k in np.flatnonzero(labels.track_id == track) if (track, int(labels.t_ns[k])) in common]
            t_s, xy = labels.t_ns[rows] * 1e-9, labels.center_m[rows, :2]
            if len(rows) >= MIN_LABELS and np.ptp(t_s) >= MIN_SEEN_S:
                since, off = t_s - t_s.mean(), xy - xy.mean(axis=0)
                drift_mps.append(float(np.hypot(*(since @ off / (since @ since)))))
                scatter.append(float(np.sqrt(np.mean(np.sum(off**2, axis=1)))))
        if scatter and min(drift_mps) < MAX_STANDING_MPS:
            out.append(scatter)
    return out


def rms(values: Array) -> float:
    """Root of the mean square of what is known."""
    return float(np.sqrt(np.nanmean(values**2)))


def main(path: Path, source: str = "lidar") -> None:
    """Print the figures of a log, with poses from the LiDAR or a camera."""
    log = open_log(path)
    for stream in log.streams.values():
        len(stream.t_ns)  # stamps that are read late are no part of the odometry
    begin = time.process_time()
    localized, choice = localize(log, Config.load(poses={"source": source}))
    count = max(choice.estimate.get("sweeps", choice.estimate.get("frames", 1)), 1)
    ms = (time.process_time() - begin) * 1e3 / count
    print(f"{log.name}: {choice.estimate.get('poses')} poses by {choice.source}, {ms:.0f} ms each")
    print("".join(f"note: {finding}\n" for finding in choice.findings), end="")
    if log.ego is None or localized.ego is None:
        return
    print(path_errors(localized.ego, log.ego))
    rows, lidar = [], densest_lidar(log)
    if lidar is not None:
        both = {"given": log.ego, choice.source: localized.ego}
        found = compare_poses(log, lidar, both, localized.ego.t_ns)
        for name, of in (("in succession", "neighbors_m"), ("2 s apart", "apart_m")):
            rows.append([f"surfaces, sweeps {name}, m", *(f"{rms(getattr(s, of)):.3f}" for s in found.values())])
    labels = [labels for labels in (log.labels, localized.labels) if labels is not None]
    if parked := standing_vehicles(labels) if len(labels) == 2 else []:
        rows.append([f"{len(parked)} parked, median scatter, m", *(f"{v:.3f}" for v in np.median(parked, axis=0))])
    print(markdown(["", "given", choice.source], rows))
    auto = localize(log, Config.load(poses={"source": "auto"}))[1].to_dict()
    print(f"auto takes {auto['source']}: {auto['reason']}")
