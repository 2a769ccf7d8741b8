"""Make maps of random roads with their true markings, on which `train.py markings` fits.

    python tools/fit.py line_maps FOLDER --maps 270 --plain 60

Each road is straight or bent, a street or one side of a motorway, with traffic on either side, lines of any usual width, kind, color and
wear, removed ones, crosswalks, stop lines, arrows, houses, shadows, sidewalks or grass beside it, in any light and weather; it is rendered,
and reconstructed by its labels, with one to three cameras and a LiDAR of 16 to 64 lines, or without one of both. Others are
of plain ground, whose texture is coarser than that of rendered grounds. Files that exist are left as they are.
"""

from __future__ import annotations

import pickle
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import shapely

from log2sim import Config, open_log, reconstruct
from log2sim.datatypes import MapFeatures, Scenario
from log2sim.errors import Log2SimError
from log2sim.evaluation.road import Area
from log2sim.geometry import Array
from log2sim.road.builder import map_ground
from log2sim.road.ground_map import GroundMap
from log2sim.synth.scene import Scene
from log2sim.synth.synthesis import write_synthetic

MAPS_OF_SEED = 100_000
STREET_M, MOTORWAY_M, STEP_M = 200.0, 300.0, 12.0  # to where roads lead both ways, and from point to point
WITHOUT_CAMERA, WITHOUT_LIDAR, UNMARKED = 0.2, 0.2, 0.15  # shares of maps, of roads
APART_M, ARROW_APART_M = 14.0, 8.0  # vehicles from each other at first, arrows from what is across the road
EVERYWHERE = Area(None, None, None, 0.0)


@dataclass(frozen=True, eq=False)
class RoadMap:
    """A map, what is on the road in truth, and where that counts."""

    ground: GroundMap
    true: MapFeatures
    area: Area


@dataclass(frozen=True)
class _Course:
    """A circle, or a line along x: places by the way along it and the distance to the left."""

    curvature_pm: float

    def at(self, along_m: float, left_m: float) -> list[float]:
        """Place x, y, m."""
        turn, radius_m = self.curvature_pm * along_m, 1 / self.curvature_pm
        return [float((radius_m - left_m) * np.sin(turn)), float(radius_m - (radius_m - left_m) * np.cos(turn))]

    def driven(self, begin_m: float, end_m: float, left_m: float, speed_mps: float) -> list[list[float]]:
        """Waypoints from one place to another."""
        return [[*self.at(float(along), left_m), speed_mps] for along in np.linspace(begin_m, end_m, 9)]


def draw_scene(seed: int) -> Scene:
    """Draw a road, and what is on and beside it."""
    rng = np.random.default_rng([seed, 77])

    def draw(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    def one_of(*values: Any) -> Any:
        return values[rng.integers(len(values))]

    def chance(share: float) -> bool:
        return bool(rng.random() < share)

    def wear() -> float:
        return float(one_of(0.0, 0.0, draw(0.05, 0.6)))

    left_hand, motorway = chance(0.35), chance(0.25)
    speed, duration = (draw(22, 34), 4.0) if motorway else (draw(5, 18), 5.0)
    one_way = motorway or chance(0.15)
    lanes = one_of(2, 2, 3, 4) if one_way else one_of(2, 2, 2, 4, 4)
    lane_m = draw(3.3, 3.8) if motorway else draw(2.7, 3.7)
    # Beside the outer lines there is a hard shoulder, or cars park there; lanes of a road are as wide as each other with that.
    beside_m = draw(1.8, 3.5) if lanes == 2 and chance(0.4) else 0.0
    inset_m = beside_m or (draw(0.15, 1.2) if motorway else draw(0.15, 0.35))
    width = lanes * lane_m + (2 * inset_m if motorway or beside_m else 0.2)
    bend_pm = 0.0012 if motorway else 0.008
    course = _Course(one_of(1e-8, draw(-bend_pm, bend_pm), draw(-bend_pm, bend_pm)))  # the first is as good as straight
    reach = MOTORWAY_M if motorway else STREET_M
    near_side = 1 if left_hand else -1
    centers = [-lanes * lane_m / 2 + (k + 0.5) * lane_m for k in range(lanes)]  # of lanes, to the left of the middle
    along = [d for d in centers if one_way or d * near_side > 0]
    own, walk_m = one_of(*along), 0.0 if motorway or chance(0.35) else draw(1.2, 4)
    road: dict[str, Any] = {
        "line": [course.at(float(s), 0.0) for s in np.arange(-reach, reach, STEP_M)],
        "width_m": width, "lanes": lanes, "worn": wear(), "sidewalk_m": walk_m, "side_inset_m": max(inset_m, 0.12),
        "marking": one_of("dashed", "dashed", "dashed", "solid", "none"),
        "side_marking": one_of("solid", "solid", "solid", "dashed", "none"),
        "side_line_m": draw(0.1, 0.3) if motorway else draw(0.1, 0.16),
        "color": one_of(*["white"] * 6, "yellow"),
    }  # fmt: skip
    if one_way:
        road["lanes_back"] = 0
    else:
        road["center_marking"] = one_of("dashed", "dashed", "solid", "double", "none")
        road["center_color"] = one_of("white", "white", "white", "yellow")
    if chance(0.6):
        dash = draw(1.5, 6.5)
        road["dash_m"] = [dash, dash * draw(1, 3)]
    if chance(0.25):
        road["old_m"] = [draw(-width / 3, width / 3) for _ in range(int(rng.integers(1, 3)))]
    scene: dict[str, Any] = {
        "name": f"road-{seed}", "duration_s": duration, "traffic": "left" if left_hand else "right", "road": [road],
        "ego": {"waypoints": course.driven(-0.55 * speed * duration, 0.6 * speed * duration, own, speed)},
    }  # fmt: skip
    zebras, stops = list[tuple[float, float]](), list[tuple[float, int]]()  # with widths, with the direction driven in
    crossing_at = np.inf
    if not motorway and chance(0.45):
        crossing_at = at = draw(15, 40)
        across_m = draw(6, 10)
        crossing = {"line": [course.at(at, 60), course.at(at, -60)], "width_m": across_m}
        scene["road"].append(crossing | {"sidewalk_m": walk_m, "side_inset_m": 0.2})
        for way in (1, -1):
            edge = at - way * (across_m / 2 + walk_m + draw(0.5, 3))
            walk = draw(2.5, 5) if chance(0.4) else 0.0
            if walk:
                zebras.append((edge - way * walk / 2, walk))
            if chance(0.7) and (way > 0 or not one_way):
                stops.append((edge - way * (walk + draw(0.8, 2)), way))
    elif not motorway and chance(0.6):
        at, walk, way = draw(5, 35), draw(2.5, 5), one_of(1, -1)
        zebras = [(at, walk)]
        if chance(0.4) and (way > 0 or not one_way):
            stops = [(at - way * (walk / 2 + draw(0.8, 2)), way)]
    scene["zebra"] = [
        {"line": [course.at(at, -width / 2), course.at(at, width / 2)], "width_m": walk, "worn": wear()}
        for at, walk in zebras
    ]
    across = [-(width / 2 - 0.2) if one_way else 0.1, width / 2 - 0.2]  # of the lanes that lead to a stop line
    scene["stop_line"] = [
        {"line": [course.at(at, way * near_side * left) for left in across], "width_m": draw(0.3, 0.6), "worn": wear()}
        for at, way in stops
    ]
    if chance(0.6):
        crossed = [at for at, _ in zebras + stops] + [crossing_at]
        kinds = [
            (one_of(*centers), one_of("straight", "left", "right"), draw(3, 7)) for _ in range(int(rng.integers(1, 6)))
        ]
        places = rng.uniform(-30, 40, len(kinds))
        if chance(0.5):
            # One behind the other, as before junctions.
            kinds, places = kinds[:1] * len(kinds), draw(-30, -10) + draw(8, 25) * np.arange(len(kinds))
        for s, (lane, shape, length) in zip(places.tolist(), kinds):
            turn = np.degrees(course.curvature_pm * s) + (0 if lane in along else 180)
            # Bent arrows reach half their length to the side, and are within their lane.
            length = length if shape == "straight" else min(length, lane_m - 0.6)
            arrow = {"position": course.at(s, lane), "yaw_deg": float(turn), "shape": shape, "length_m": length}
            if all(abs(s - at) > ARROW_APART_M for at in crossed):
                scene.setdefault("arrow", []).append(arrow | {"worn": wear()})
    beside = width / 2 + walk_m
    if not motorway and chance(0.6):
        scene["building"] = [
            {
                "center": course.at(s, side * (beside + draw(6, 12))), "yaw_deg": float(np.degrees(course.curvature_pm * s)),
                "size_m": [draw(12, 40), 8.0, draw(4, 15)], "color": rng.integers(60, 220, 3).tolist(), "shadow": chance(0.6),
            }
            for side in (-1, 1)
            for s in rng.uniform(-60, 70, 2).tolist()
        ]  # fmt: skip
    if chance(0.5):
        places = [course.at(draw(-30, 40), draw(-beside, beside)) for _ in range(int(rng.integers(1, 5)))]
        scene["shadow"] = [{"outline": _shadow(np.array(xy), rng)} for xy in places]
    agents: list[dict[str, Any]] = []
    for k in range(int(rng.integers(0, 6))):
        lane, at = one_of(*centers), draw(-60, 70)
        way = 1 if lane in along else -1
        v = speed * (draw(0.8, 1.15) if lane != own else 1.0)
        path = course.driven(at, at + way * 1.2 * v * duration, lane, v)
        others = [other["waypoints"][0] for other in agents] + [course.at(-0.55 * speed * duration, own)]
        if all(np.hypot(path[0][0] - xy[0], path[0][1] - xy[1]) > APART_M for xy in others):
            category, color = one_of("car", "car", "car", "truck"), rng.integers(20, 235, 3).tolist()
            agents.append({"id": f"agent-{k}", "category": category, "color": color, "waypoints": path})
    # The detector of labels needs one.
    scene["agent"] = agents or [{"id": "parked", "category": "car", "pose": [*course.at(60.0, beside + 3), 0.0]}]
    height, large = draw(1.4, 1.9), chance(0.5)
    views = [("front", 0.0, draw(60, 90), [1100, 620] if large else [800, 450])]
    if chance(0.7):
        views += [("left", 75.0, 90.0, [640, 360]), ("right", -75.0, 90.0, [640, 360])]
    scene["camera"] = [
        {
            "name": name, "position_m": [1.5, 0.3 * float(np.sign(yaw)), height], "yaw_deg": yaw, "pitch_deg": draw(-6, -2),
            "fov_deg": fov, "size_px": size, "offset_s": 0.05,
        }
        for name, yaw, fov, size in views
    ]  # fmt: skip
    lidar = {
        "name": "roof", "position_m": [1.2, 0.0, draw(1.7, 2.2)], "channels": one_of(16, 32, 40, 64), "range_m": 90.0,
        "elevation_deg": [draw(-26, -16), draw(2, 8)], "azimuth_deg": [-140.0, 140.0], "azimuth_step_deg": draw(0.2, 0.6), "offset_s": 0.08,
    }  # fmt: skip
    sensors = rng.random()
    scene["camera"] = [] if sensors < WITHOUT_CAMERA else scene["camera"]
    scene["lidar"] = [] if sensors > 1 - WITHOUT_LIDAR else [lidar]
    wet = chance(0.3)
    scene["environment"] = {
        "light": one_of("noon", "noon", "overcast", "dusk", "night"), "weather": one_of("rain", "fog", "clear") if wet else "clear",
        "visibility_m": draw(50, 300), "rain_mm_h": draw(3, 25), "glare": wet and chance(0.5),
    }  # fmt: skip
    if wet and chance(0.4):
        scene["environment"]["wetness"] = draw(0.2, 1)
    # By a stream of its own, so that a road is the same with its markings and without.
    if np.random.default_rng([seed, 79]).random() < UNMARKED:
        for kind in ("zebra", "stop_line", "arrow"):
            scene.pop(kind, None)
        for one in scene["road"]:
            one |= {"marking": "none", "side_marking": "none", "center_marking": "none", "old_m": []}
    return Scene.model_validate(scene)


def _shadow(xy: Array, rng: np.random.Generator) -> list[list[float]]:
    """Draw the outline of a shadow around a place (2,): of a crown, or as long and thin as that of a post."""
    turn, (c, s) = rng.uniform(0, np.pi), (np.cos, np.sin)
    if rng.random() < 0.35:
        points = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * [rng.uniform(1.5, 4.5), rng.uniform(0.05, 0.2)]
    else:
        angle = rng.uniform(0, 2 * np.pi, 8)
        points = rng.uniform(0.6, 4) * np.column_stack([c(angle), 0.7 * s(angle)])
    points = xy + points @ np.array([[c(turn), s(turn)], [-s(turn), c(turn)]])
    return [[float(x), float(y)] for x, y in shapely.MultiPoint(points).convex_hull.exterior.coords[:-1]]


BLUR_M = 0.05  # of a curb in the map: a cell
PLAIN_M, CELL_M = (60.0, 30.0), 0.05
# Colors, BGR, of asphalt, gravel, grass, earth and sand; brightness varies by up to this share from grain to grain.
PLAIN_BGR = ((92, 91, 90), (120, 124, 130), (60, 110, 80), (60, 80, 105), (120, 150, 175))
MAX_GRAIN, MAX_GRAIN_CELLS = 0.35, 3.0


def plain_map(seed: int) -> RoadMap:
    """Make a map of ground of one kind, with the returns of a LiDAR or without."""
    rng = np.random.default_rng([seed, 78])
    shape = (round(PLAIN_M[1] / CELL_M), round(PLAIN_M[0] / CELL_M))

    def texture(cells: float) -> Array:
        noise = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), cells)
        return np.asarray(noise / noise.std())

    grain = rng.uniform(0.02, MAX_GRAIN)
    shade = 1 + grain * texture(rng.uniform(0.5, MAX_GRAIN_CELLS)) + grain / 2 * texture(2 * MAX_GRAIN_CELLS)
    image = shade[..., None] * PLAIN_BGR[rng.integers(len(PLAIN_BGR))] + rng.normal(0, 1.5, (*shape, 3))
    returns = rng.uniform(0.08, 0.4) * np.exp(rng.uniform(0.1, 0.5) * texture(rng.uniform(0.5, 2)))
    returns[rng.random(shape) > rng.uniform(0.1, 1)] = np.nan
    intensity = np.full(shape, np.nan) if rng.random() < WITHOUT_LIDAR else returns
    layers = np.clip(image, 0, 255).astype(np.uint8), np.full(shape, 255, np.uint8), np.zeros(shape, np.float32)
    extent = (0.0, PLAIN_M[0], 0.0, PLAIN_M[1])
    return RoadMap(GroundMap(*layers, intensity.astype(np.float32), CELL_M, extent), MapFeatures(), EVERYWHERE)


def raise_roadsides(ground: GroundMap, scene: Scene, shift_m: Array, rng: np.random.Generator) -> GroundMap:
    """Raise what is beside the roads, as rendered ground is flat: sidewalks by a curb, grass up or down by less.

    `shift_m`: (2,): from the scene to the map.
    """
    step_m = rng.uniform(0.06, 0.2) if scene.road[0].sidewalk_m else rng.uniform(-0.1, 0.1)
    beside = np.ones(ground.alpha.shape, np.float32)
    for road in scene.road:
        outline = shapely.LineString(road.line).buffer(road.width_m / 2, cap_style="flat")
        rows, columns = ground.raster.cells_of(shapely.get_coordinates(outline.exterior) + shift_m)
        cv2.fillPoly(beside, [np.rint(np.column_stack([columns, rows])).astype(np.int32)], 0.0)
    raised = ground.height_m + np.float32(step_m) * cv2.GaussianBlur(beside, (0, 0), BLUR_M / ground.resolution_m)
    return replace(ground, height_m=raised)


def make_map(seed: int) -> RoadMap:
    """Render a road, reconstruct it by its labels and map the ground."""
    with tempfile.TemporaryDirectory() as folder:
        scene = draw_scene(seed)
        write_synthetic(scene, Path(folder) / "log", seed=seed)
        log = open_log(Path(folder) / "log")
        detector = "labels" if log.cameras else "lidar:labels"
        scenario = reconstruct(log, Config.load(detect={"name": detector}), jobs=1, cache=False).scenario
        truth = Scenario.load(Path(folder) / "log" / "truth.json")
        moved = truth.aligned_to(scenario)
        shift_m = truth.shift_to(scenario)
        ground = raise_roadsides(map_ground(log, scenario), scene, shift_m[:2], np.random.default_rng([seed, 80]))
        return RoadMap(ground, moved.map_features or MapFeatures(), Area.of(scenario, moved, shift_m))


def main(folder: Path, maps: int = 320, plain: int = 80, first: int = 0, seed: int = 0) -> None:
    """Make so many maps of roads, from the first index on, and of plain ground."""
    folder.mkdir(parents=True, exist_ok=True)
    wanted = [(f"{seed}-{index:04d}", index, make_map) for index in range(first, first + maps)]
    wanted += [(f"{seed}-plain-{index:04d}", index, plain_map) for index in range(first, first + plain)]
    for name, index, made in wanted:
        path = folder / f"{name}.pkl"
        if path.exists():
            continue
        try:
            content = pickle.dumps(made(MAPS_OF_SEED * seed + index), protocol=5)
        except Log2SimError as error:  # a road that the scene file's limits rule out
            print(f"{path.name} left out: {error}", flush=True)
            continue
        part = path.with_suffix(".part")
        part.write_bytes(content)
        part.replace(path)
        print(path.name, flush=True)
