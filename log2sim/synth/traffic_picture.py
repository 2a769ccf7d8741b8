"""Pictures of random traffic."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, Camera, rotation_from_rpy, transform
from log2sim.synth.backdrop import BAY_M, FLOOR_M, Backdrop
from log2sim.synth.ground import Ground, GroundPlan
from log2sim.synth.light import Lamp, Light, headlights
from log2sim.synth.paint import Paint, linear_bgr
from log2sim.synth.polytope_caster import MESH_OPENNESS
from log2sim.synth.polytopes import Material, meshes_of
from log2sim.synth.render import Body, SceneInstant, Values
from log2sim.synth.scene import Road as PaintedRoad
from log2sim.synth.shapes import Mesh
from log2sim.synth.terrain import Road
from log2sim.synth.traffic import TrafficObject, TrafficScene

Rgb = tuple[int, int, int]

# Colors of cars in traffic by share (Germany, newly registered, 2023, rounded).
CAR_COLORS: tuple[tuple[Rgb, float], ...] = (
    ((90, 94, 98), 0.2), ((28, 29, 31), 0.25), ((232, 233, 232), 0.22), ((168, 172, 176), 0.1), ((40, 66, 120), 0.1),
    ((160, 28, 30), 0.06), ((60, 84, 62), 0.03), ((200, 150, 40), 0.02), ((120, 96, 70), 0.02),
)  # fmt: skip
LOAD_COLORS: tuple[Rgb, ...] = ((226, 226, 222), (60, 92, 150), (170, 40, 36), (216, 180, 60), (120, 124, 128))
CLOTHES: tuple[Rgb, ...] = (
    (40, 42, 50), (52, 66, 104), (150, 40, 44), (70, 96, 70), (196, 190, 180), (110, 84, 60), (208, 140, 50), (90, 92, 96),
)  # fmt: skip
WALLS: tuple[Rgb, ...] = (
    (196, 182, 158), (176, 158, 146), (186, 186, 180), (188, 168, 140), (150, 120, 100), (208, 204, 196),
)  # fmt: skip
FIXED: dict[Material, Rgb] = {
    Material.GROUND: (120, 112, 96), Material.GLASS: (62, 68, 74), Material.DARK: (38, 38, 40),
    Material.METAL: (150, 154, 158), Material.MESH: (120, 126, 122), Material.WOOD: (104, 82, 62),
}  # fmt: skip
GLOSS = {Material.GLASS: 0.34, Material.PAINT: 0.14, Material.METAL: 0.12}
SKINS: tuple[Rgb, ...] = ((206, 162, 136), (170, 122, 92), (96, 66, 48))
HAIRS: tuple[Rgb, ...] = ((40, 32, 26), (88, 62, 38), (150, 120, 80), (120, 118, 116))
# Share of samples through which one sees what is behind.
OPENNESS = {Material.MESH: MESH_OPENNESS}
LAMP_WHITE, LAMP_RED, PLATE = (0.72, 0.76, 0.76), (0.02, 0.02, 0.42), (0.6, 0.6, 0.6)
VEHICLES = ("car", "truck", "bus")
PEOPLE = ("pedestrian", "cyclist", "motorcycle")


@dataclass(frozen=True, eq=False)
class Look:
    """Appearance of an object, by part."""

    item: TrafficObject
    material: NDArray[np.int64]  # (K,)
    color: NDArray[np.float32]  # (K, 3)
    gloss: NDArray[np.float32]  # (K,)
    trousers: NDArray[np.float32]  # (3,)
    skin: NDArray[np.float32]  # (3,)
    hair: NDArray[np.float32]  # (3,)

    def passes(self) -> NDArray[np.float32] | None:
        """Share of samples (K,) that each part lets through, None for a solid one."""
        open_parts = np.array([OPENNESS.get(Material(m), 0.0) for m in self.material], np.float32)
        return open_parts if open_parts.any() else None


def draw_look(item: TrafficObject, rng: np.random.Generator) -> Look:
    """Draw the colors of an object."""
    shares = np.array([share for _, share in CAR_COLORS])
    body = CAR_COLORS[rng.choice(len(CAR_COLORS), p=shares / np.sum(shares))][0]
    if item.category in ("truck", "bus"):
        body = LOAD_COLORS[rng.integers(len(LOAD_COLORS))]
    cloth, trousers, wall = (pool[rng.integers(len(pool))] for pool in (CLOTHES, CLOTHES[:4], WALLS))
    green = rng.uniform(0.75, 1.15) * np.array([0.035, 0.12, 0.055], np.float32)
    drawn = {Material.PAINT: body, Material.CLOTH: cloth, Material.WALL: wall, **FIXED}
    material = np.array([int(p.material) for p in item.parts])
    color = np.array([green if m == Material.LEAVES else linear_bgr(drawn[Material(m)]) for m in material], np.float32)
    gloss = np.array([GLOSS.get(Material(m), 0.0) for m in material], np.float32)
    skin, hair = SKINS[rng.integers(len(SKINS))], HAIRS[rng.integers(len(HAIRS))]
    person = (linear_bgr(rgb) for rgb in (trousers, skin, hair))
    return Look(item, material, color, gloss, *person)


def _paint(look: Look, part: NDArray[np.int64], points: Values, normals: Values) -> Paint:
    out = Paint(look.color[part], look.gloss[part], np.zeros((len(part), 3), np.float32))
    category, (length, width, height) = look.item.category, look.item.size_m
    z = points[:, 2] + np.float32(height / 2)
    material = look.material[part]
    if category in VEHICLES:
        # Paint lamps, plates and the sills of windows
        low = min(1.1, 0.62 * height)
        x, y = points[:, 0], np.abs(points[:, 1])
        end = material == Material.PAINT
        lamp = end & (y > 0.28 * width) & (z > 0.62 * low) & (z < 0.86 * low)
        for mask, color, glow in (
            (lamp & (normals[:, 0] > 0.5) & (x > 0.42 * length), LAMP_WHITE, 0.25),
            (lamp & (normals[:, 0] < -0.5) & (x < -0.42 * length), LAMP_RED, 0.25),
            (end & (np.abs(normals[:, 0]) > 0.5) & (y < 0.26) & (np.abs(z - 0.5 * low) < 0.06), PLATE, 0.0),
        ):
            out.albedo[mask] = color
            out.glow[mask] = glow * np.asarray(color, np.float32)
    elif category in PEOPLE:
        # Paint trousers, hands' height, face and hair by their heights
        cloth = material == Material.CLOTH
        share = z / np.float32(height)
        out.albedo[cloth & (share < 0.5)] = look.trousers
        head = cloth & (share > 0.855)
        out.albedo[head] = look.hair
        out.albedo[head & (normals[:, 0] > 0.2) & (share < 0.965)] = look.skin
        out.albedo[cloth & (share < 0.045) & (category == "pedestrian")] = (0.03, 0.03, 0.03)
    elif look.item.kind == "building":
        _front(out, material, points, z, normals)
    leaves = material == Material.LEAVES
    if leaves.any():
        # Light and dark patches.
        x, y, z = points[leaves].T
        patches = np.sin(7.1 * x + 3.3 * z) * np.sin(6.3 * y - 4.7 * z)
        fine = np.sin(23.0 * x + 17.0 * y) * np.sin(29.0 * z - 13.0 * y)
        out.albedo[leaves] *= np.asarray(1.0 + 0.28 * patches + 0.3 * fine, np.float32)[:, None]
    return out


def _front(out: Paint, material: NDArray[np.int64], points: Values, z: Values, normals: Values) -> None:
    """Paint floors of windows on a house."""
    wall = (material == Material.WALL) & (np.abs(normals[:, 2]) < 0.5)
    along = np.where(np.abs(normals[:, 1]) > 0.5, points[:, 0], points[:, 1])
    bay, floor = np.mod(along, BAY_M), np.mod(z - 0.9, FLOOR_M)
    pane = wall & (z > 3.2) & (bay > 0.8) & (bay < 1.95) & (floor > 0.3) & (floor < 1.8)
    frame = wall & (z > 3.2) & (bay > 0.7) & (bay < 2.05) & (floor > 0.2) & (floor < 1.9) & ~pane
    out.albedo[frame] = np.minimum(out.albedo[frame] * 1.3, 0.8)
    out.albedo[pane] = (0.1, 0.085, 0.075)
    out.gloss[pane] = 0.25
    out.albedo[wall & (z < 0.7)] *= np.float32(0.7)


ROAD_REACH_M, MAX_SAGITTA_M = 240.0, 0.02
SIDEWALK_M = 2.5
MIN_STREET_LAMP_M = 5.0
OWN_CAR = "own car"
GRAIN_SEED = 0  # one grain for all scenes, because it takes long to make


class TrafficPainter:
    """Makes the pictures' content of one random scene; shapes and colors are made once.

    `seed`: of colors.
    """

    def __init__(self, scene: TrafficScene, seed: int) -> None:
        painted = [painted_road(road, scene.surface.kerb_m > 0) for road in scene.roads]
        self.backdrop = Backdrop(Ground(GroundPlan(painted), GRAIN_SEED), scene.surface)
        self._seed = seed
        self._looks: dict[int, Look] = {}
        self._meshes: dict[int, Mesh] = {}

    def instant(
        self, scene: TrafficScene, light: Light, camera: Camera, map_T_cam: Array
    ) -> tuple[SceneInstant, NDArray[np.int64]]:
        """Take the scene at one time: what a camera may see, and the index of the object that each body is."""
        seen = [k for k, item in enumerate(scene.objects) if item.kind != OWN_CAR and _in_view(item, camera, map_T_cam)]
        new = [k for k in seen if k not in self._meshes]
        parts, heights = [scene.objects[k].parts for k in new], [scene.objects[k].size_m[2] / 2 for k in new]
        for k, own, mesh in zip(new, parts, meshes_of(parts, heights)):
            self._looks[k] = draw_look(scene.objects[k], np.random.default_rng([self._seed, 7, k]))
            self._meshes[k] = _rounded(mesh, np.array([p.material for p in own]))
        bodies = []
        for k in seen:
            item = scene.objects[k]
            center = item.position_m + np.array([0.0, 0.0, item.size_m[2] / 2])
            pose = transform(rotation_from_rpy(0.0, 0.0, item.yaw_rad), center)
            look = self._looks[k]
            bodies.append(Body(self._meshes[k], pose, item.size_m, partial(_paint, look), look.passes()))
        lamps = lamps_of(scene) if light.lamps > 0 else ()
        return SceneInstant(self.backdrop, bodies, light, lamps), np.array(seen, np.int64)


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
