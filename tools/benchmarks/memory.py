"""Peak memory of a reconstruction, and what it finds of the road, against the length of its log, which is driven several times in a row.

    python tools/bench.py memory LOG --times 4 --times 30
    python tools/bench.py memory LOG --times 4 --times 30 --world

Each length runs in a process of its own, and so does the world of simulated sensors (`--world`). The table has the peak by stage and what a tick more adds to it.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.table import markdown
from log2sim.datatypes import ImageLabels, Labels, Log, Stream, Sweep
from log2sim.geometry import Array, PoseTrack

RUN = """
import json, sys
from log2sim import Config, open_log, reconstruct
from benchmarks.memory import loop_log
from log2sim.evaluation.road import sampled
path, times, saved = json.loads(sys.argv[1])
result = reconstruct(loop_log(open_log(path), times), Config.load(detect={"name": "lidar:vehicle"}))
result.scenario.save(saved)
road = result.scenario.map_features
lines = {"lane lines": [m for m in road.markings if m.is_lane_line], "borders": road.borders}
road = {name: sum(len(xy) * step_m for xy, _, step_m in (sampled(m.points_m) for m in some)) / times for name, some in lines.items()}
print(json.dumps({"ticks": result.report["ticks"], "stages": result.report["stages"], "agents": len(result.scenario.agents), "road": road}))
"""
WORLD = """
import json, resource, sys
from log2sim import Scenario, open_log
from benchmarks.memory import loop_log
from log2sim.resim.world import build_world
path, times, saved = json.loads(sys.argv[1])
log = loop_log(open_log(path), times)
build_world(log, Scenario.load(saved), list(log.lidars))
print(json.dumps(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024))
"""


def measure(path: str, times: int, world: bool) -> dict[str, Any]:
    """Reconstruct a log that is driven several times in a row; returns ticks, agents and the report's stages."""
    with tempfile.TemporaryDirectory() as folder:
        job = [path, times, str(Path(folder) / "scenario.json")]
        found: dict[str, Any] = _run(RUN, job)
        if world:
            found["stages"].append({"stage": "world", "peak_memory_mib": _run(WORLD, job)})
    return found


def _run(code: str, job: list[Any]) -> Any:
    command = [sys.executable, "-c", code, json.dumps(job)]
    ran = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[1])
    if ran.returncode:
        raise SystemExit(ran.stderr)
    return json.loads(ran.stdout.splitlines()[-1])


def main(log: Path, times: list[int] = [1, 4, 16], world: bool = False) -> None:
    runs = [measure(str(log.resolve()), count, world) for count in times]
    peaks = [{stage["stage"]: float(stage["peak_memory_mib"]) for stage in run["stages"]} for run in runs]
    names = dict.fromkeys(name for of_run in peaks for name in of_run)
    rows = [[name, *(f"{of_run[name]:.0f} MiB" if name in of_run else "-" for of_run in peaks)] for name in names]
    rows.append(["agents", *(str(run["agents"]) for run in runs)])
    rows += [[f"{name} a turn", *(f"{run['road'][name]:.0f} m" for run in runs)] for name in runs[0]["road"]]
    more = [
        (max(p.values()) - max(peaks[0].values())) / (r["ticks"] - runs[0]["ticks"])
        for r, p in zip(runs[1:], peaks[1:])
    ]
    rows.append(["each tick more", "-", *(f"{1024 * mib:.1f} KiB" for mib in more)])
    print(markdown(["peak at the end of", *(f"{run['ticks']} ticks" for run in runs)], rows))


def loop_log(log: Log, times: int) -> Log:
    """Return a log in which the recording of an ego is followed by copies of itself, moved on by its way.

    The world moves with the ego: agents, labels and sweeps of each turn are new ones at new places, as on a long drive.

    Raises `ValueError` for a log without an ego, or with sensors at the road.
    """
    if log.ego is None or any(s.mount == "map" for s in (*log.cameras.values(), *log.lidars.values())):
        raise ValueError("only the sensors of an ego can drive on")
    ego = log.ego
    first_ns, last_ns = int(ego.t_ns[0]), int(ego.t_ns[-1])
    steps = [np.linalg.matrix_power(_way(ego), k) for k in range(times)]
    late_ns = [k * (last_ns - first_ns) for k in range(times)]
    streams = {name: _looped(stream, first_ns, last_ns, late_ns, steps) for name, stream in log.streams.items()}
    poses = PoseTrack(
        np.concatenate([ego.t_ns[:-1] + late for late in late_ns]),
        np.concatenate([step @ ego.map_T_ego[:-1] for step in steps]),
        ego.max_gap_s,
        ego.extrapolate_s,
    )
    return log.changed(
        name=f"{log.name} x {times}",
        streams=streams,
        ego=poses,
        labels=None if log.labels is None else _labels(log.labels, late_ns, steps),
        image_labels={name: _image_labels(found, late_ns) for name, found in log.image_labels.items()},
        ignored_regions={},
        digest=f"{log.digest} x {times}",
    )


def _way(ego: PoseTrack) -> Array:
    """The transform (4, 4) of the map that takes the first pose to the last: a turn about the vertical and a shift."""
    first, last = ego.map_T_ego[0], ego.map_T_ego[-1]
    turn = np.arctan2(last[1, 0], last[0, 0]) - np.arctan2(first[1, 0], first[0, 0])
    out = np.eye(4)
    out[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    out[:3, 3] = last[:3, 3] - out[:3, :3] @ first[:3, 3]
    return out


def _looped(stream: Stream, first_ns: int, last_ns: int, late_ns: list[int], steps: list[Array]) -> Stream:
    kept = np.flatnonzero((stream.t_ns >= first_ns) & (stream.t_ns < last_ns))

    def read(index: int) -> Any:
        turn, row = divmod(index, len(kept))
        record = stream.read(int(kept[row]))
        return _moved(record, late_ns[turn], steps[turn]) if isinstance(record, Sweep) else record

    return Stream(stream.name, np.concatenate([stream.t_ns[kept] + late for late in late_ns]), read)


def _moved(sweep: Sweep, late_ns: int, step: Array) -> Sweep:
    xyz = sweep.xyz_m if sweep.frame == "lidar" else sweep.xyz_m @ step[:3, :3].T + step[:3, 3]
    return replace(
        sweep,
        stamp_ns=sweep.stamp_ns + late_ns,
        xyz_m=xyz,
        t_ns=None if sweep.t_ns is None else sweep.t_ns + late_ns,
        compensated_ns=None if sweep.compensated_ns is None else sweep.compensated_ns + late_ns,
    )


def _labels(labels: Labels, late_ns: list[int], steps: list[Array]) -> Labels:
    times, count = len(late_ns), len(labels.t_ns)
    labeled_ns = labels.labeled_ns
    return replace(
        labels.take(np.tile(np.arange(count), times)),
        t_ns=np.concatenate([labels.t_ns + late for late in late_ns]),
        track_id=np.concatenate([np.char.add(labels.track_id.astype(str), f"/{k}") for k in range(times)]),
        center_m=np.concatenate([labels.center_m @ step[:3, :3].T + step[:3, 3] for step in steps]),
        yaw_rad=np.concatenate([labels.yaw_rad + np.arctan2(step[1, 0], step[0, 0]) for step in steps]),
        labeled_ns=None if labeled_ns is None else np.unique(np.add.outer(late_ns, labeled_ns)),
    )


def _image_labels(labels: ImageLabels, late_ns: list[int]) -> ImageLabels:
    rows = np.tile(np.arange(len(labels.t_ns)), len(late_ns))
    t_ns = np.concatenate([labels.t_ns + late for late in late_ns])
    return ImageLabels(t_ns, labels.box_px[rows], labels.category[rows])
