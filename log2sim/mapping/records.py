"""Which pictures and sweeps a map is made of, and where it lies: by how far the ego went, so that the cost stays bounded."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Scenario
from log2sim.errors import LogError
from log2sim.geometry import NS_PER_S, Array
from log2sim.mapping.raster import Extent
from log2sim.perception.lidar.cloud import cloud_origin

# A camera 1.5 m above the road resolves it to 5 cm with 1000 px of focal length up to 9 m away: every place is seen so at least
# three times from pictures 2 m apart.
PICTURE_STEP_M = 2.0
# Rings of a sweep are 0.1 to 1 m apart on the ground: small steps of the ego fill the gaps between them.
SWEEP_STEP_M = 0.1
# So many points for each meter of the way are a return a centimeter on rings of 60 m, on 30 rings: more make no finer map. Of a
# sweep of 120,000 points one is taken each 0.6 m, as at 6 m/s anyway.
POINTS_A_METER = 200_000
# What stands still, the same sensor shows again; several records of it average the noise and let moving shadows pass.
STANDING_RECORDS = 7
MAX_PICTURES, MAX_SWEEPS = 400, 160
# Of this long only few ground pixels and points are finer than lane markings.
MARGIN_M = 40.0
# A roadside sensor 6 m above the road has a pixel of 0.5 m length at this distance, with 1500 px of focal length.
ROADSIDE_MARGIN_M = 70.0


def choose_records(
    log: Log, scenario: Scenario, steps_m: Mapping[str, float], most: int
) -> dict[str, NDArray[np.int64]]:
    """Choose the records of sensors by name: where the ego is a step, m, farther on, at most `most` of all sensors together."""
    steps_m = {name: step_m for name, step_m in steps_m.items() if name in log.streams}
    most = max(most // max(len(steps_m), 1), STANDING_RECORDS)
    return {name: _choose(log, scenario, name, step_m, most) for name, step_m in steps_m.items()}


def sweep_step_m(points: int) -> float:
    """Return how far the ego goes, m, between sweeps of a number of points that are taken."""
    return max(SWEEP_STEP_M, points / POINTS_A_METER)


def _choose(log: Log, scenario: Scenario, name: str, step_m: float, most: int) -> NDArray[np.int64]:
    t_ns = log.streams[name].t_ns
    end_ns = scenario.t0_ns + round(scenario.duration_s * NS_PER_S)
    pose, known = log.map_T_sensor(name, t_ns)
    usable = np.flatnonzero(known & (t_ns >= scenario.t0_ns) & (t_ns <= end_ns))
    if not len(usable):
        return usable.astype(np.int64)
    place = pose[usable, :3, 3]
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))])
    # Noise of the poses of a sensor at rest is no way; it must come away from where it was last taken.
    step = max(step_m, gone[-1] / most)
    chosen, last = [0], 0
    for k in range(1, len(usable)):
        if np.linalg.norm(place[k] - place[last]) >= step:
            chosen.append(k)
            last = k
    if len(chosen) < STANDING_RECORDS:
        chosen = np.unique(np.linspace(0, len(usable) - 1, STANDING_RECORDS).round().astype(int)).tolist()
    return usable[chosen[:most]].astype(np.int64)


def path_of(log: Log, scenario: Scenario) -> Array:
    """Places (K, 3), m, on the ground that the ego passed, about every half meter; none without known poses."""
    if log.ego is None:
        return np.zeros((0, 3))
    end_ns = scenario.t0_ns + round(scenario.duration_s * NS_PER_S)
    t_ns = log.ego.t_ns[(log.ego.t_ns >= scenario.t0_ns) & (log.ego.t_ns <= end_ns)]
    t_ns = t_ns if len(t_ns) else np.array([scenario.t0_ns], dtype=np.int64)
    map_T_ego, known = log.ego.at(t_ns)
    ground = map_T_ego[known] @ np.array([0.0, 0.0, log.ground_z_ego_m, 1.0])
    if not len(ground):
        return np.zeros((0, 3))
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ground[:, :3], axis=0), axis=1))])
    at = np.linspace(0, gone[-1], max(int(gone[-1] / 0.5), 1) + 1)
    return np.column_stack([np.interp(at, gone, ground[:, k]) for k in range(3)])


def roadside_places(log: Log, scenario: Scenario) -> Array:
    """Places (K, 3), m, of the sensors that are fixed in the map, on the ground."""
    names = [name for name, camera in log.cameras.items() if camera.mount == "map"]
    names += [name for name, lidar in log.lidars.items() if lidar.mount == "map"]
    poses = [log.map_T_sensor(name, scenario.t0_ns)[0][0, :3, 3] for name in names]
    ground_z = cloud_origin(log, scenario.t0_ns)[1] if log.ego is None else None
    return np.array([[x, y, z if ground_z is None else ground_z] for x, y, z in poses]).reshape(-1, 3)


def extent_of(path: Array, roadside: Array) -> Extent:
    """Return the extent of a map, m, around places (K, 3) of the ego and of roadside sensors.

    Raises
    ------
    LogError
        Where there are neither, as in a log without poses.
    """
    low, high = [], []
    for places, margin in ((path, MARGIN_M), (roadside, ROADSIDE_MARGIN_M)):
        if len(places):
            low.append(places[:, :2].min(axis=0) - margin)
            high.append(places[:, :2].max(axis=0) + margin)
    if not low:
        raise LogError("no pose of any sensor is known, so pictures and sweeps have no place in a map of the ground")
    (x0, y0), (x1, y1) = np.min(low, axis=0), np.max(high, axis=0)
    # Whole meters, so that maps of one log lie on the same cells whichever part of it they show.
    return float(np.floor(x0)), float(np.ceil(x1)), float(np.floor(y0)), float(np.ceil(y1))
