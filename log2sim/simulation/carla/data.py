"""A scenario as CARLA's script reads it, with the asset nearest to each agent.

The sizes are those that a CARLA 0.9.16 server reports for spawned actors (length, width, height, rounded to
centimeters), as published in tools/carla/snapshots/blueprints_0.9.16.json of the Scenic project. CARLA's boxes include
mirrors, riders and sometimes more: the bus is 3.9 m wide. Police cars, taxis and ambulances are left out, since a
scenario's category car does not tell them apart.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from log2sim.datatypes import Agent, Trajectory
from log2sim.errors import ScenarioError
from log2sim.geometry import Array
from log2sim.simulation.reference import GAINS, vehicle_limits, vehicle_reference
from log2sim.simulation.vehicles.vehicle import PEDAL_LAG_S, STEER_LAG_S, WHEELED, parameters_for, rear_axle_offset

Size = tuple[float, float, float]


CARS: Mapping[str, Size] = {
    "vehicle.audi.a2": (3.71, 1.79, 1.55), "vehicle.audi.etron": (4.86, 2.03, 1.65),
    "vehicle.audi.tt": (4.18, 1.99, 1.39), "vehicle.bmw.grandtourer": (4.61, 2.24, 1.67),
    "vehicle.chevrolet.impala": (5.36, 2.03, 1.41), "vehicle.citroen.c3": (3.99, 1.85, 1.62),
    "vehicle.dodge.charger_2020": (5.01, 1.88, 1.53), "vehicle.ford.mustang": (4.72, 1.89, 1.30),
    "vehicle.jeep.wrangler_rubicon": (3.87, 1.91, 1.88), "vehicle.lincoln.mkz_2017": (4.90, 2.13, 1.51),
    "vehicle.lincoln.mkz_2020": (4.89, 1.84, 1.49), "vehicle.mercedes.coupe": (5.03, 2.15, 1.65),
    "vehicle.mercedes.coupe_2020": (4.67, 1.81, 1.44), "vehicle.micro.microlino": (2.21, 1.48, 1.38),
    "vehicle.mini.cooper_s": (3.81, 1.97, 1.48), "vehicle.mini.cooper_s_2021": (4.55, 2.10, 1.77),
    "vehicle.nissan.micra": (3.63, 1.85, 1.50), "vehicle.nissan.patrol": (4.60, 1.93, 1.85),
    "vehicle.nissan.patrol_2021": (5.57, 2.15, 2.05), "vehicle.seat.leon": (4.19, 1.82, 1.47),
    "vehicle.tesla.model3": (4.79, 2.16, 1.49), "vehicle.toyota.prius": (4.51, 2.01, 1.52),
}  # fmt: skip
VANS: Mapping[str, Size] = {
    "vehicle.mercedes.sprinter": (5.92, 1.99, 2.56), "vehicle.volkswagen.t2": (4.48, 2.07, 2.04),
    "vehicle.volkswagen.t2_2021": (4.44, 1.77, 1.99),
}  # fmt: skip
TRUCKS: Mapping[str, Size] = {
    "vehicle.carlamotors.carlacola": (5.20, 2.63, 2.47), "vehicle.carlamotors.european_hgv": (7.94, 2.89, 3.46),
    "vehicle.carlamotors.firetruck": (8.47, 2.89, 3.83), "vehicle.tesla.cybertruck": (6.27, 2.39, 2.10),
}  # fmt: skip
BUSES: Mapping[str, Size] = {"vehicle.mitsubishi.fusorosa": (10.27, 3.94, 4.25)}
MOTORCYCLES: Mapping[str, Size] = {
    "vehicle.harley-davidson.low_rider": (2.35, 0.77, 1.65), "vehicle.kawasaki.ninja": (2.04, 0.80, 1.52),
    "vehicle.vespa.zx125": (1.82, 0.87, 1.59), "vehicle.yamaha.yzf": (2.19, 0.87, 1.53),
}  # fmt: skip
BICYCLES: Mapping[str, Size] = {
    "vehicle.bh.crossbike": (1.51, 0.87, 1.61), "vehicle.diamondback.century": (1.66, 0.58, 1.62),
    "vehicle.gazelle.omafiets": (1.84, 0.66, 1.78),
}  # fmt: skip

# The box of a walker is its capsule; adults, older and younger children have one size each.
_CHILDREN = {
    **dict.fromkeys((9, 10, 11, 48, 49), (0.50, 0.50, 1.10)),
    **dict.fromkeys((12, 13, 14), (0.38, 0.38, 1.30)),
}
WALKERS: Mapping[str, Size] = {f"walker.pedestrian.{k:04}": _CHILDREN.get(k, (0.38, 0.38, 1.86)) for k in range(1, 53)}
PROPS: Mapping[str, Size] = {
    "static.prop.barrel": (0.46, 0.47, 0.81), "static.prop.busstop": (3.88, 1.89, 2.74),
    "static.prop.clothcontainer": (1.24, 1.89, 1.81), "static.prop.constructioncone": (0.34, 0.34, 0.59),
    "static.prop.container": (1.93, 1.01, 1.71), "static.prop.glasscontainer": (1.95, 2.01, 1.79),
    "static.prop.kiosk_01": (1.63, 1.65, 3.25), "static.prop.plantpot04": (4.97, 0.74, 0.12),
    "static.prop.shoppingcart": (0.67, 1.21, 1.08), "static.prop.streetbarrier": (1.21, 0.37, 1.07),
    "static.prop.trafficcone01": (0.88, 0.88, 1.13), "static.prop.trafficwarning": (2.37, 2.87, 3.57),
    "static.prop.trashbag": (0.38, 0.43, 0.70), "static.prop.trashcan03": (0.63, 0.55, 0.93),
    "static.prop.vendingmachine": (0.87, 1.10, 2.11),
}  # fmt: skip

BY_CATEGORY: Mapping[str, Mapping[str, Size]] = {
    "car": {**CARS, **VANS},
    "truck": {**TRUCKS, "vehicle.mercedes.sprinter": VANS["vehicle.mercedes.sprinter"]},
    "bus": {**BUSES, "vehicle.mercedes.sprinter": VANS["vehicle.mercedes.sprinter"]},
    "motorcycle": MOTORCYCLES,
    "cyclist": BICYCLES,
    "bicycle": BICYCLES,  # CARLA has none without a rider
    "pedestrian": WALKERS,
    "other": PROPS,
}


def nearest_assets(agent: Agent, *, turn: int = 0) -> list[dict[str, Any]]:
    """Return the three assets of an agent's category nearest in size (Euclidean over the three lengths), nearest first.

    Each has "blueprint", "size_m", its length, width and height, and "error_m", that size less the agent's. Among
    blueprints of one size, such as CARLA's adults, the `turn`-th comes first, so that not all look the same.
    """
    offers: dict[Size, list[str]] = {}
    for blueprint, size_m in BY_CATEGORY[agent.category].items():
        offers.setdefault(size_m, []).append(blueprint)
    assets = []
    for size_m in sorted(offers, key=lambda s: math.dist(s, agent.size_m)):
        same, error_m = offers[size_m], tuple(round(a - b, 3) for a, b in zip(size_m, agent.size_m))
        turned = [same[(turn + k) % len(same)] for k in range(len(same))]
        assets += [{"blueprint": blueprint, "size_m": size_m, "error_m": error_m} for blueprint in turned]
    return assets[:3]


SAMPLE_S = 0.05  # spacing of the samples; linear interpolation errs by at most a h^2 / 8 = 3 mm at 10 m/s2
MAX_SAMPLED_BYTES = 1536 * 1024 * 1024
# Of the numbers of a sample in the lists that are written, as objects of Python; 1.5 GiB hold 46 hours of one agent.
BYTES_PER_SAMPLE = 480

DISCONTINUITY_S = 1e-6  # spacing of the two samples at a discontinuity of the scenario


def controller_data() -> dict[str, float]:
    """Return the gains of the vehicle controller and the lags of its actuators, as `player` reads them."""
    return {**asdict(GAINS), "pedal_lag_s": PEDAL_LAG_S, "steer_lag_s": STEER_LAG_S}


def carla_agents(agents: Sequence[Agent]) -> list[dict[str, Any]]:
    """Describe agents as `player` reads them. Their positions should be near the origin: CARLA computes in float32.

    Raises `ScenarioError` when their samples would take more than `MAX_SAMPLED_BYTES`, before anything is allocated for
    them.
    """
    lasts_s = [0.0 if a.static else float(a.waypoints.t_s[-1] - a.waypoints.t_s[0]) for a in agents]
    size_bytes = sum(lasts_s) / SAMPLE_S * BYTES_PER_SAMPLE
    if size_bytes > MAX_SAMPLED_BYTES:
        k = int(np.argmax(lasts_s))
        raise ScenarioError(
            f"agents last {sum(lasts_s):g} s together, '{agents[k].id}' {lasts_s[k]:g} s: their samples every {SAMPLE_S:g} s take "
            f"{size_bytes / 2**30:.3g} GiB, at most {MAX_SAMPLED_BYTES / 2**30:g} GiB can be written; cut the scenario into parts"
        )
    begin_s = min(float(a.waypoints.t_s[0]) for a in agents)
    end_s = max(float(a.waypoints.t_s[-1]) for a in agents)
    counts: Counter[str] = Counter()
    described = []
    for agent in agents:
        described.append(_agent(agent, counts[agent.category], (begin_s, end_s)))
        counts[agent.category] += 1
    return described


def _agent(agent: Agent, turn: int, span_s: tuple[float, float]) -> dict[str, Any]:
    """Describe one agent; a permanent one is present for all of `span_s`, as in log2sim's own simulator."""
    w, wheeled = agent.waypoints, agent.category in WHEELED
    moves = not agent.static and len(w) > 1
    life_s = span_s if agent.is_permanent else (float(w.t_s[0]), float(w.t_s[-1]))
    trajectory = Trajectory.through(agent.waypoints, rear_axle_offset(agent))
    exact, pid = _trajectories(agent, trajectory, drives=moves and wheeled)
    limits = parameters_for([agent]) if wheeled else None
    return {
        "id": agent.id, "category": agent.category, "size_m": [round(v, 3) for v in agent.size_m],
        "color": None if agent.color is None else list(agent.color["rgb"]), "static": agent.static,
        "doubts": [doubt.to_dict() for doubt in agent.doubts], "assets": nearest_assets(agent, turn=turn),
        "begin_s": life_s[0], "end_s": life_s[1],
        "discontinuities_s": [float(t) for t in trajectory.discontinuity_times()],
        "drive": None if not moves else "vehicle" if wheeled else "walker" if agent.category == "pedestrian" else None,
        "max_throttle_mps2": None if limits is None else float(limits.max_throttle_mps2[0]),
        "max_brake_mps2": None if limits is None else float(limits.max_brake_mps2[0]), "exact": exact, "pid": pid,
    }  # fmt: skip


def _trajectories(
    agent: Agent, trajectory: Trajectory, *, drives: bool
) -> tuple[dict[str, list[float]], dict[str, list[float]] | None]:
    """Return columns of the trajectory and, for a vehicle that drives, of the feasible one; both of the box center."""
    t_s = trajectory.t_s[:1]
    if not agent.static:  # regular samples, every waypoint, and one just before a discontinuity
        regular = np.arange(trajectory.t_s[0], trajectory.t_s[-1], SAMPLE_S)
        k = np.searchsorted(trajectory.t_s, regular, side="right")
        after = trajectory.t_s[np.minimum(k, len(trajectory.t_s) - 1)]
        gap_s = np.minimum(regular - trajectory.t_s[k - 1], after - regular)
        before_jumps = trajectory.discontinuity_times() - DISCONTINUITY_S
        t_s = np.sort(np.concatenate([regular[gap_s > 10 * DISCONTINUITY_S], trajectory.t_s, before_jumps]))
    x, y, yaw, _ = trajectory.relative(t_s)
    z = trajectory.heights(t_s) - agent.size_m[2] / 2
    origin_x, origin_y = trajectory.origin_m
    exact = _left_handed(t_s, x + origin_x, y + origin_y, z, yaw)
    if not drives:
        return {**exact, "curvature_1pm": [0.0] * len(t_s)}, None
    limits = vehicle_limits(agent)
    reference = vehicle_reference(trajectory, limits, accel_ahead_s=0.0, curvature_ahead_s=0.0)
    rear_x, rear_y, rear_yaw, speed, accel, curvature, gear, stands = reference.exact(t_s).T
    center_x, center_y = rear_x + limits.offset_m * np.cos(rear_yaw), rear_y + limits.offset_m * np.sin(rear_yaw)
    bend = {"curvature_1pm": _rounded(-curvature)}
    pid = {
        **_left_handed(t_s, center_x + origin_x, center_y + origin_y, z, rear_yaw), **bend,
        "speed_mps": _rounded(speed), "accel_mps2": _rounded(accel), "gear": _rounded(gear), "stands": _rounded(stands),
    }  # fmt: skip
    return {**exact, **bend}, pid


def _left_handed(t_s: Array, x: Array, y: Array, z: Array, yaw: Array) -> dict[str, list[float]]:
    """Convert columns to CARLA's left-handed frame."""
    return {
        "t_s": _rounded(t_s, 7), "x_m": _rounded(x), "y_m": _rounded(-y), "z_m": _rounded(z),
        "yaw_deg": _rounded(-np.degrees(yaw)),
    }  # fmt: skip


def _rounded(values: ArrayLike, digits: int = 4) -> list[float]:
    """Round for the file: a tenth of a millimeter, or of a thousandth of a degree."""
    return [float(v) for v in np.round(np.asarray(values, dtype=np.float64), digits) + 0.0]
