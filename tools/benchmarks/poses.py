"""Compare the ego poses of a log with LiDAR odometry, or with camera motion.

    OPENBLAS_NUM_THREADS=1 python tools/bench.py poses LOG [--sequence NAME] [--source lidar|camera] [--every] [--out FILE.json]

- ATE: RMS distance of the estimated positions to the given ones, after the best rigid alignment of the positions; beside it
  the same as placed in the map, without it. What is wrong in the given poses counts as well.
- RPE: RMS difference of the motions from each sweep to the next, in m and degrees.
- Parked cars: RMS distance of the centers of a labeled vehicle that stands, from their mean, over its labels. Labels that a data
  set made once for a parked object in its own map scatter by nothing with its own poses, which then says nothing.
- Surfaces: the measure by which `--poses auto` decides, for sweeps in succession and two seconds apart.
- ms: CPU time of the odometry for a sweep, reading it included.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from entry import parser_of
from numpy.typing import NDArray

from log2sim import Config, open_log
from log2sim.datatypes import GROUP_OF, Labels, Log
from log2sim.errors import Log2SimError
from log2sim.geometry import Array, PoseTrack, inverse
from log2sim.localization.choice import PoseChoice, localize
from log2sim.localization.odometry import densest_lidar
from log2sim.localization.verdict import compare_poses

MIN_LABELS, MIN_SEEN_S = 10, 1.0
# A vehicle stands where a line through its positions is slower than this by one of the poses.
MAX_STANDING_MPS = 0.3
MADE_ONCE_M = 1e-3


def rigid(source: Array, target: Array) -> tuple[Array, Array]:
    """Rotation (3, 3) and translation (3,) that lay points (N, 3) on others best (Kabsch)."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    u, _, vt = np.linalg.svd(b.T @ a)
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return rotation, target.mean(axis=0) - rotation @ source.mean(axis=0)


def path_errors(estimated: PoseTrack, given: PoseTrack) -> dict[str, float]:
    """ATE, RPE and lengths of the paths at the stamps of the estimated poses."""
    at, known = given.at(estimated.t_ns)
    ours, theirs = estimated.map_T_ego[known], at[known]
    xyz, reference = ours[:, :3, 3], theirs[:, :3, 3]
    rotation, shift = rigid(xyz, reference)
    off = inverse(inverse(theirs[:-1]) @ theirs[1:]) @ (inverse(ours[:-1]) @ ours[1:])
    angle = np.arccos(np.clip((np.trace(off[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))

    def rms(values: Array) -> float:
        return float(np.sqrt(np.mean(np.sum(values**2, axis=-1))))

    return {
        "poses": int(known.sum()),
        "path_m": float(np.linalg.norm(np.diff(xyz, axis=0), axis=1).sum()),
        "given_path_m": float(np.linalg.norm(np.diff(reference, axis=0), axis=1).sum()),
        "ate_m": rms(xyz @ rotation.T + shift - reference),
        "as_placed_m": rms(xyz - reference),
        "rpe_m": rms(off[:, :3, 3]),
        "rpe_deg": float(np.rad2deg(np.sqrt(np.mean(angle**2)))),
    }


def standing_vehicles(sources: dict[str, Labels]) -> dict[str, dict[str, float]]:
    """Scatter in m by pose source of each labeled vehicle that stands, by track."""
    stamps = [set(zip(labels.track_id.tolist(), labels.t_ns.tolist())) for labels in sources.values()]
    common, out = set.intersection(*stamps), {}
    first = next(iter(sources.values()))
    vehicles = {t for t, c in zip(first.track_id.tolist(), first.category.tolist()) if GROUP_OF.get(c) == "vehicle"}
    for track in sorted(vehicles):
        tables = {}
        for name, labels in sources.items():
            rows = [
                k for k in np.flatnonzero(labels.track_id == track).tolist() if (track, int(labels.t_ns[k])) in common
            ]
            tables[name] = (labels.t_ns[rows] * 1e-9, labels.center_m[rows, :2])
        t_s, _ = next(iter(tables.values()))
        if len(t_s) < MIN_LABELS or np.ptp(t_s) < MIN_SEEN_S:
            continue
        if min(drift_mps(*table) for table in tables.values()) < MAX_STANDING_MPS:
            out[track] = {
                name: float(np.sqrt(np.mean(np.sum((xy - xy.mean(axis=0)) ** 2, axis=1))))
                for name, (_, xy) in tables.items()
            }
    return out


def drift_mps(t_s: Array, xy_m: Array) -> float:
    """Speed of the line through positions (T, 2)."""
    since = t_s - t_s.mean()
    return float(np.hypot(*(since @ (xy_m - xy_m.mean(axis=0)) / (since @ since))))


def estimate(log: Log, source: str) -> tuple[Log, PoseChoice, float]:
    """The log with estimated poses, the figures of the estimate, and the CPU seconds it took."""
    begin = time.process_time()
    localized, choice = localize(log, Config.load(poses={"source": source}))
    return localized, choice, time.process_time() - begin


def surfaces(log: Log, tracks: dict[str, PoseTrack]) -> dict[str, dict[str, float]]:
    """RMS distances of upright surfaces by pose source; empty without a LiDAR on the ego."""
    lidar = densest_lidar(log)
    if lidar is None:
        return {}
    found = compare_poses(log, lidar, tracks, sweep_stamps(tracks))
    return {name: {"neighbors_m": rms(s.neighbors_m), "apart_m": rms(s.apart_m)} for name, s in found.items()}


def sweep_stamps(tracks: dict[str, PoseTrack]) -> NDArray[np.int64]:
    """Stamps of the estimated poses, which are those of sweeps."""
    return list(tracks.values())[-1].t_ns


def rms(values: Array) -> float:
    """Root of the mean square of what is known."""
    return float(np.sqrt(np.nanmean(values**2)))


def run(path: Path, sequence: str | None, source: str) -> dict[str, Any]:
    """All figures of a log."""
    log = open_log(path, sequence=sequence)
    for t_ns in (s.t_ns for s in log.streams.values()):
        len(t_ns)  # stamps that are read late are no part of the odometry
    localized, choice, spent_s = estimate(log, source)
    assert localized.ego is not None
    result: dict[str, Any] = {
        "log": log.name,
        "source": choice.source,
        "estimate": dict(choice.estimate),
        "notes": [str(finding) for finding in choice.findings],
    }
    result["ms"] = spent_s * 1e3 / max(choice.estimate.get("sweeps", choice.estimate.get("frames", 1)), 1)
    if log.ego is None:
        return result
    tracks = {"given": log.ego, choice.source: localized.ego}
    result["errors"] = path_errors(localized.ego, log.ego)
    result["surfaces"] = surfaces(log, tracks)
    if log.labels is not None:
        result["parked"] = standing_vehicles({"given": log.labels, choice.source: localized.labels})
    result["auto"] = localize(log, Config.load(poses={"source": "auto"}))[1].to_dict()
    return result


def print_result(result: dict[str, Any], *, every: bool) -> None:
    """Print the figures as tables."""
    source, found = result["source"], result["estimate"]
    print(f"{result['log']}: {found.get('poses')} poses by {source}, {result['ms']:.0f} ms each")
    for note in result["notes"]:
        print(f"note: {note}")
    if "errors" not in result:
        return
    e = result["errors"]
    print(f"path {e['path_m']:.2f} m, given {e['given_path_m']:.2f} m")
    print(f"against the given poses: ATE {e['ate_m']:.3f} m (as placed {e['as_placed_m']:.3f} m), "
          f"RPE {e['rpe_m']:.3f} m, {e['rpe_deg']:.3f} degrees")  # fmt: skip
    print(f"{'':34}{'given':>9}{source:>9}")
    for key, label in (("neighbors_m", "surfaces, successive sweeps, m"), ("apart_m", "surfaces, sweeps 2 s apart, m")):
        if result["surfaces"]:
            print(f"{label:34}{result['surfaces']['given'][key]:9.3f}{result['surfaces'][source][key]:9.3f}")
    parked = result.get("parked", {})
    if parked:
        label, columns = (
            f"{len(parked)} parked, median scatter, m",
            [[row[n] for row in parked.values()] for n in ("given", source)],
        )
        print(f"{label:34}{np.median(columns[0]):9.3f}{np.median(columns[1]):9.3f}")
        made_once = sum(row["given"] < MADE_ONCE_M for row in parked.values())
        if made_once:
            print(f"  {made_once} of them were labeled once in the map of the given poses, where they cannot scatter")
    for track, row in parked.items() if every else ():
        print(f"  {track:32}{row['given']:9.3f}{row[source]:9.3f}")
    print(f"auto takes {result['auto']['source']}: {result['auto']['reason']}")


def main(arguments: list[str] | None = None) -> int:
    """Run from the command line."""
    parser = parser_of(__doc__)
    parser.add_argument("log", type=Path)
    parser.add_argument("--sequence")
    parser.add_argument("--source", choices=("lidar", "camera"), default="lidar")
    parser.add_argument("--every", action="store_true", help="list every parked vehicle")
    parser.add_argument("--out", type=Path, help="figures as JSON")
    options = parser.parse_args(arguments)
    try:
        result = run(options.log, options.sequence, options.source)
    except Log2SimError as error:
        print(f"bench_poses: {error}", file=sys.stderr)
        return error.exit_code
    print_result(result, every=options.every)
    if options.out is not None:
        options.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return 0
