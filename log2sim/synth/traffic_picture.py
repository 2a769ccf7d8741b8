"""Pictures of random traffic: the same polytopes that the LiDAR meets, on the same terrain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, Camera, rotation_from_rpy, transform
from log2sim.synth.backdrop import Wall
from log2sim.synth.bodies import Body
from log2sim.synth.ground import Ground
from log2sim.synth.lamps import Lamp, headlights
from log2sim.synth.light import Light
from log2sim.synth.markings import GroundPlan
from log2sim.synth.polytope_caster import Terrain
from log2sim.synth.polytope_mesh import meshes_of
from log2sim.synth.polytopes import Material
from log2sim.synth.render import SceneInstant
from log2sim.synth.scene_places import Road as PaintedRoad
from log2sim.synth.shapes import Mesh
from log2sim.synth.traffic import Road, TrafficObject, TrafficScene
from log2sim.synth.traffic_colors import VEHICLES, Look, look_of

ROAD_REACH_M, MAX_SAGITTA_M = 240.0, 0.02
SIDEWALK_M = 2.5
MIN_STREET_LAMP_M = 5.0
OWN_CAR = "own car"
GRAIN_SEED = 0  # one grain for all scenes, because it takes long to make


@dataclass(frozen=True, eq=False)
class TrafficBackdrop:
    """The ground of a random scene.

    Attributes
    ----------
    ground : Ground
    terrain : Terrain
    buildings, shadows : tuple
        None; houses are bodies.
    """

    ground: Ground
    terrain: Terrain | None
    buildings: tuple[tuple[Wall, ...], ...] = ()
    shadows: tuple[Array, ...] = ()


class TrafficPainter:
    """Makes the pictures' content of one random scene; shapes and colors are made once.

    Parameters
    ----------
    scene : TrafficScene
    seed : int
        Of colors.
    """

    def __init__(self, scene: TrafficScene, seed: int) -> None:
        painted = [painted_road(road, scene.surface.kerb_m > 0) for road in scene.roads]
        self.backdrop = TrafficBackdrop(Ground(GroundPlan(painted), GRAIN_SEED), scene.surface)
        self._seed = seed
        self._looks: dict[int, Look] = {}
        self._meshes: dict[int, Mesh] = {}

    def instant(
        self, scene: TrafficScene, light: Light, camera: Camera, map_T_cam: Array
    ) -> tuple[SceneInstant, NDArray[np.int64]]:
        """Take the scene at one time: what a camera may see, and the index of the object that each body is."""
        seen = [k for k, item in enumerate(scene.objects) if item.kind != OWN_CAR and _in_view(item, camera, map_T_cam)]
        self._make([k for k in seen if k not in self._meshes], scene)
        bodies = [_body(scene.objects[k], self._meshes[k], self._looks[k]) for k in seen]
        lamps = lamps_of(scene) if light.lamps > 0 else ()
        return SceneInstant(self.backdrop, bodies, light, lamps), np.array(seen, np.int64)

    def _make(self, rows: list[int], scene: TrafficScene) -> None:
        objects = [scene.objects[k] for k in rows]
        for k, item, mesh in zip(
            rows, objects, meshes_of([o.parts for o in objects], [o.size_m[2] / 2 for o in objects])
        ):
            self._looks[k] = look_of(item, np.random.default_rng([self._seed, 7, k]))
            self._meshes[k] = _rounded(mesh, np.array([p.material for p in item.parts]))


def painted_road(road: Road, kerbs: bool) -> PaintedRoad:
    """Turn an arc into the polyline that is painted on the ground."""
    bend = abs(road.curvature_per_m)
    # Less than half a turn, so that the road does not meet itself.
    reach = min(ROAD_REACH_M, 0.45 * np.pi / max(bend, 1e-9))
    # A chord of length s departs from its arc by s^2 / 8 times the curvature.
    step = np.sqrt(8 * MAX_SAGITTA_M / max(bend, 1e-9))
    s = np.linspace(-reach, reach, int(np.ceil(2 * reach / step)) + 1)
    line = tuple((float(p[0]), float(p[1])) for p in (road.at(float(v), 0.0)[0] for v in s))
    sidewalk = SIDEWALK_M if kerbs else 0.0
    return PaintedRoad(line=line, width_m=2 * road.half_width_m, lanes=road.lanes, sidewalk_m=sidewalk)


def lamps_of(scene: TrafficScene) -> tuple[Lamp, ...]:
    """Headlights of what drives, the sensor's own car among it, and lamps on high posts."""
    lamps: list[Lamp] = []
    for item in scene.objects:
        if item.category in VEHICLES and item.speed_mps > 0:
            pose = transform(rotation_from_rpy(0.0, 0.0, item.yaw_rad), item.position_m)
            lamps += headlights(pose, item.size_m[0] / 2, item.size_m[1])
        elif item.kind == "pole" and item.size_m[2] > MIN_STREET_LAMP_M:
            lamps.append(Lamp(item.position_m + np.array([0.0, 0.0, item.size_m[2]])))
    if scene.mount == "vehicle":
        R, position = scene.sensor.rotation, scene.sensor.position_m
        ground = np.append(position[:2], scene.surface.elevation(position))
        pose = transform(rotation_from_rpy(0.0, 0.0, float(np.arctan2(R[1, 0], R[0, 0]))), ground)
        lamps += headlights(pose, 2.0, 1.8)
    return tuple(lamps)


def _in_view(item: TrafficObject, camera: Camera, map_T_cam: Array) -> bool:
    center = item.position_m + np.array([0.0, 0.0, item.size_m[2] / 2])
    p = map_T_cam[:3, :3].T @ (center - map_T_cam[:3, 3])
    # Parts of clutter, such as crowns of trees, may lie off the middle.
    low, high = (np.array([getattr(part, end) for part in item.parts]) for end in ("low", "high"))
    radius = float(np.linalg.norm(np.maximum(np.abs(low), np.abs(high)).max(0)))
    half = np.arctan(np.hypot(camera.width_px, camera.height_px) / 2 / camera.K[0, 0])
    distance = float(np.linalg.norm(p))
    if distance < radius + 1.0:
        return True
    return bool(np.arccos(np.clip(p[2] / distance, -1, 1)) < half + np.arcsin(min(1.0, radius / distance)))


def _body(item: TrafficObject, mesh: Mesh, look: Look) -> Body:
    center = item.position_m + np.array([0.0, 0.0, item.size_m[2] / 2])
    pose = transform(rotation_from_rpy(0.0, 0.0, item.yaw_rad), center)
    return Body(mesh, pose, item.size_m, look.painter(), passes=look.passes())


def _rounded(mesh: Mesh, material: NDArray[np.int64]) -> Mesh:
    """Let crowns of leaves look round: normals away from the middle of their part."""
    normals = mesh.normals.copy()
    corner_part = np.repeat(mesh.part, 3)
    for part in np.flatnonzero(material == Material.LEAVES):
        rows = np.flatnonzero(corner_part == part)
        if len(rows):
            off = mesh.vertices_m[rows] - mesh.vertices_m[rows].mean(0)
            normals[rows] = off / np.maximum(np.linalg.norm(off, axis=1, keepdims=True), 1e-9)
    return Mesh(mesh.vertices_m, normals, mesh.faces, mesh.part)
