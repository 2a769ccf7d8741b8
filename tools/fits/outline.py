"""Fit the weights of `log2sim/agents/heading.py` to random vehicles that simulated LiDARs pass.

    python tools/fit.py outline --vehicles 4000 --test 500

Each vehicle stands in a row, beside others or alone, is seen one to eight times by a LiDAR that passes, and its box is wrong
by what boxes of tracks are wrong by. A minute for a thousand vehicles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fits.logistic import logistic_regression
from log2sim.agents.heading import HEIGHT_CELLS, Outline, outline_of
from log2sim.datatypes.log_odds import probability_of
from log2sim.geometry import rotation_from_rpy
from log2sim.perception.boxes import rotate, subsample
from log2sim.synth.polytope_caster import SensorState, Solid, cast_polytopes
from log2sim.synth.returns import LIDAR_MODELS, ReturnModel
from log2sim.synth.terrain import Surface
from log2sim.synth.traffic import VEHICLE_LIDAR_SHARES, VEHICLE_LIDARS
from log2sim.synth.traffic_shapes import draw_user

# By whether the vehicle is tall, and whether most of its length shows.
NAMES = {(False, True): "LOW", (False, False): "LOW_IN_PART", (True, True): "TALL", (True, False): "TALL_IN_PART"}
FLAT = Surface(np.zeros(5), np.zeros((0, 4)), (), 0.0)
SHARES = {"car": 0.82, "truck": 0.11, "bus": 0.07}
MAX_POINTS_EACH, MAX_RANGE_M, BOXES = 300, 60.0, 2
# Standard deviations of the boxes of tracks: length and width as shares, center, yaw, height of the ground.
LENGTH_SHARE, WIDTH_SHARE, CENTER_M, YAW_RAD, GROUND_M = 0.07, 0.05, (0.12, 0.08), 0.025, 0.06
# Share of which one end is hidden, and of which the lower part is.
HIDDEN_SHARE = 0.25
# Ridge of the regression: as if each weight had been seen to be zero with this precision.
RIDGE = 30.0


@dataclass(frozen=True, eq=False)
class Seen:
    """Points (N, 3) of a vehicle from the middle of its floor, its size (3,), and the mean viewpoint (2,), m."""

    xyz: np.ndarray
    size_m: np.ndarray
    view_m: np.ndarray


def draw(rng: np.random.Generator) -> Seen | None:
    """Draw a vehicle at the origin that points along x, and cast it."""
    size, parts = draw_user(str(rng.choice(list(SHARES), p=list(SHARES.values()))), rng)[1]
    solids = [solid(parts, 0.0, 0.0, 0.0, rng), *neighbors(size, rng)]
    model = LIDAR_MODELS[str(rng.choice(VEHICLE_LIDARS, p=VEHICLE_LIDAR_SHARES))]
    step = model.azimuth_step_deg * float(rng.choice([1.0, 1.2, 1.5]))
    returns = ReturnModel(float(rng.uniform(0.008, 0.03)), float(rng.uniform(0, 0.12)), float(rng.uniform(0, 0.006)))
    height = float(rng.uniform(1.55, 2.3))
    clouds, views = [], []
    for xy in passed(size, rng):
        reach = float(np.hypot(*xy))
        if not size[0] / 2 + 1.2 <= reach <= MAX_RANGE_M:
            continue
        half = min(float(np.rad2deg(np.arctan2(np.hypot(*size[:2]) / 2 + 0.6, max(reach - size[0] / 2, 2.0)))), 85.0)
        narrow = model.model_copy(update={"azimuth_deg": (-half, half), "azimuth_step_deg": max(step, half / 350)})
        rotation = rotation_from_rpy(*rng.normal(0, 0.006, 2), float(np.arctan2(*-xy[::-1])))
        sensor = SensorState(rotation, np.append(xy, height), np.zeros(2))
        cast = cast_polytopes(narrow, sensor, solids, FLAT, rng, returns)
        near = (np.abs(cast.xyz_m[:, :2]) < np.array(size[:2]) / 2 + [0.4, 0.3]).all(axis=1) & (cast.hit >= 0)
        # Clusters have some of the points of what stands beside the vehicle.
        xyz = cast.xyz_m[near & ((cast.hit == 0) | (rng.random(len(near)) < 0.4))]
        if len(xyz) >= 3:
            clouds.append(subsample(xyz.astype(np.float64), MAX_POINTS_EACH))
            views.append(xy)
    return Seen(np.concatenate(clouds), np.array(size), np.mean(views, axis=0)) if clouds else None


def solid(parts, x: float, y: float, yaw: float, rng: np.random.Generator) -> Solid:
    return Solid(parts, np.array([x, y, 0.0]), yaw, np.zeros(2), glass_passes=float(rng.uniform(0.3, 0.9)))


def neighbors(size, rng: np.random.Generator) -> list[Solid]:
    """Draw cars before and behind, on both sides, or none."""
    place, found = rng.random(), []
    for end in (-1, 1):
        if place < 0.6 and rng.random() < 0.7:
            along = end * (size[0] / 2 + 2.3 + rng.uniform(0.6, 2.5)) if place < 0.4 else rng.normal(0, 0.3)
            beside = rng.normal(0, 0.15) if place < 0.4 else end * (size[1] / 2 + 0.9 + rng.uniform(0.5, 1.2))
            found.append(solid(draw_user("car", rng)[1][1], along, beside, np.pi * rng.integers(2), rng))
    return found


def passed(size, rng: np.random.Generator) -> np.ndarray:
    """Draw the viewpoints (K, 2) of a sensor on a straight path: mostly along the vehicle, some across it."""
    kind, half_turn = rng.random(), np.pi * rng.integers(2)
    course = (
        half_turn + rng.normal(0, 0.08) if kind < 0.6
        else half_turn + np.pi / 2 + rng.normal(0, 0.15) if kind < 0.8
        else rng.uniform(-np.pi, np.pi)
    )  # fmt: skip
    beside = rng.choice([-1, 1]) * (2.4 + size[1] / 2 + rng.exponential(6.0))
    along = rng.uniform(-45, 45) + np.linspace(
        0, rng.choice([0.0, rng.uniform(2, 40)], p=[0.3, 0.7]), rng.choice([1, 2, 4, 8])
    )
    return rotate(np.column_stack([along, np.full(len(along), beside)]), course)


def measured(seen: Seen, rng: np.random.Generator) -> Outline | None:
    """Return the outline of a vehicle in a box that is wrong by chance; parts are hidden, and some have few points."""
    scale = np.exp(rng.normal(0, [LENGTH_SHARE, WIDTH_SHARE]))
    shift = rng.normal(0, CENTER_M)
    if abs(seen.view_m[0]) > seen.size_m[0] / 2:  # the end that is seen is in its place
        shift[0] += np.sign(seen.view_m[0]) * seen.size_m[0] / 2 * (1 - scale[0])
    yaw, z = rng.normal(0, YAW_RAD), seen.xyz[:, 2] + rng.normal(0, GROUND_M)
    box = np.append(seen.size_m[:2] * scale, max(float(np.quantile(z, 0.995)), 0.8))
    kept = rng.random(len(z)) < rng.choice([1.0, rng.uniform(0.1, 1)])
    if rng.random() < HIDDEN_SHARE:
        edge = rng.uniform(-0.4, 0.4) * seen.size_m[0]
        kept &= (seen.xyz[:, 0] > edge) if rng.random() < 0.5 else (seen.xyz[:, 0] < edge)
    if rng.random() < HIDDEN_SHARE:
        kept &= z > rng.uniform(0.3, 0.8) * box[2]
    xyz = np.column_stack([rotate(seen.xyz[:, :2] - shift, -yaw), z])[kept]
    return outline_of(xyz, box, rotate(seen.view_m - shift, -yaw))


def report(name: str, odds: np.ndarray) -> None:
    """Print the share that is right by the probability that the log-odds state."""
    stated = probability_of(np.abs(odds))
    print(f"{name}: {np.mean(odds > 0):.3f} of {len(odds)} right")
    for low, high in ((0.5, 0.7), (0.7, 0.9), (0.9, 0.97), (0.97, 1.01)):
        of = (stated >= low) & (stated < high)
        if of.any():
            right = np.mean(odds[of] > 0)
            print(
                f"  stated {low:.2f}-{min(high, 1.0):.2f}: mean {stated[of].mean():.3f}, right {right:.3f} of {of.sum()}"
            )


def main(vehicles: int = 4000, test: int = 500) -> None:
    found: dict[tuple[bool, bool], list[np.ndarray]] = {kind: [] for kind in NAMES}
    tests: list[Outline] = []
    for seed in range(vehicles + test):
        rng = np.random.default_rng([1, seed])
        seen = draw(rng)
        if seen is None:
            continue
        for _ in range(BOXES):
            outline = measured(seen, rng)
            if outline is not None and seed < vehicles:
                found[outline.kind].append(outline.features)
            elif outline is not None:
                tests.append(outline)
    # All rows are right: their features are those of the true direction less those of the other.
    weights = {kind: logistic_regression(np.array(rows), 1.0, RIDGE) for kind, rows in found.items()}
    for kind, name in NAMES.items():
        report(name, np.array([o.features @ weights[kind] for o in tests if o.kind == kind]))
    for kind, name in NAMES.items():
        numbers = np.round(100 * weights[kind]).astype(int)
        rows = [", ".join(map(str, row)) for row in numbers[:-1].reshape(-1, HEIGHT_CELLS)]
        print(f"{name} = (\n" + "".join(f"    {row},\n" for row in rows) + f"    {numbers[-1]},\n)  # fmt: skip")
