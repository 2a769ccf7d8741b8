"""Colors of road users, and how strongly surfaces send a LiDAR's light back.

Colors are linear BGR in [0, 1].

Glass beads in paint send light back to where it comes from, so at 905 nm markings return two to four times as much as
asphalt; on flat lines a film of water ends that (Burghardt et al., Visibility of flat line and structured road markings for
machine vision, Case Studies in Construction Materials 18, 2023).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.synth.ground import GROUND_M_PER_PX, TILE_PX, Ground, Surface
from log2sim.synth.returns import BEAM_RAD
from log2sim.synth.scene import AgentSpec
from log2sim.synth.shapes import BELT, WHEEL_AT, WHEEL_RADIUS_M, Material, roof_line, truck_axles

Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Paint:
    """Optical properties of P surface points, colors in linear BGR."""

    albedo: NDArray[np.float32]  # (P, 3)
    gloss: NDArray[np.float32]  # (P,): share of the surroundings that is mirrored
    glow: NDArray[np.float32]  # (P, 3): emitted light


def linear_bgr(rgb: tuple[int, int, int]) -> NDArray[np.float32]:
    """Linear BGR of an sRGB color."""
    return ((np.array(rgb[::-1], dtype=np.float32) / 255) ** np.float32(2.2)).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Patch:
    """Points of one material on an actor, to be painted."""

    spec: AgentSpec
    out: Paint  # of all points of the actor
    rows: Index  # (Q,) int64: rows of this patch in `out`
    p: Array  # (Q, 3), m: points in the agent frame
    z: Array  # (Q,), m: heights above the ground
    n: Array  # (Q, 3): normals
    part: Material
    seed: int  # varies the folds of clothes

    def set(self, mask: NDArray[np.bool_], albedo: Any, gloss: float = 0.0, glow: float = 0.0) -> None:
        """Paint the points of a mask (Q,)."""
        index = self.rows[mask]
        self.out.albedo[index] = albedo
        self.out.gloss[index] = gloss
        self.out.glow[index] = glow * np.asarray(albedo, np.float32)

    def fill(self, albedo: Any, gloss: float = 0.0) -> None:
        """Paint all points."""
        self.set(np.ones(len(self.rows), bool), albedo, gloss)


GLASS = (0.055, 0.05, 0.045)
RUBBER = (0.028, 0.027, 0.026)


def paint(spec: AgentSpec, part: NDArray[np.int64], points: Array, normals: Array, *, seed: int = 0) -> Paint:
    """Paint points (P, 3), m, agent frame (box center), with normals (P, 3) and materials (P,); `seed` varies the folds of clothes."""
    count = len(part)
    out = Paint(np.zeros((count, 3), np.float32), np.zeros(count, np.float32), np.zeros((count, 3), np.float32))
    z = points[:, 2] + spec.box_m[2] / 2
    for value in np.unique(part):
        rows = np.flatnonzero(part == value)
        patch = Patch(spec, out, rows, points[rows], z[rows], normals[rows], Material(value), seed)
        _PAINTERS.get(Material(value), _plain)(patch)
    return out


def _car(patch: Patch) -> None:
    spec, p, z, n = patch.spec, patch.p, patch.z, patch.n
    length, width, height = spec.box_m
    x, y = p[:, 0], p[:, 1]
    u, h = x / length, z / height
    line = roof_line(spec.shape)
    top = np.interp(u, line[:, 0], line[:, 1])
    patch.fill(linear_bgr(spec.color), 0.16)
    side = np.abs(n[:, 1]) > 0.55
    # Seams of the doors, a dark sill and the handles.
    at_seam = np.min(np.abs(x[:, None] - length * np.array([0.165, -0.03, -0.235])), 1) < 0.008
    patch.set(side & (h > 0.24) & (h < BELT) & at_seam, linear_bgr(spec.color) * 0.25)
    at_handle = np.min(np.abs(x[:, None] - length * np.array([0.0, -0.2])), 1) < 0.07
    patch.set(side & (np.abs(h - 0.565) < 0.012) & at_handle, linear_bgr(spec.color) * 0.5, 0.1)
    patch.set(h < 0.225, (0.05, 0.05, 0.05))
    fender = np.min(np.hypot(x[:, None] - length * np.array([WHEEL_AT, -WHEEL_AT]), z[:, None] - WHEEL_RADIUS_M), 1)
    patch.set((fender < WHEEL_RADIUS_M + 0.055) & (np.abs(y) > 0.3 * width), (0.008, 0.008, 0.008))
    # Windows: the sides with three pillars, the windshield and the rear window with a frame.
    glass_side = side & (h > BELT + 0.035) & (h < top - 0.075) & (h < 0.93) & (u > -0.40)
    leaning = x[:, None] + 0.12 * (z[:, None] - height * 0.8)
    pillar = np.min(np.abs(leaning - length * np.array([-0.03, -0.245])), 1) < 0.035
    patch.set(glass_side & ~pillar, GLASS, 0.34)
    frame = 0.43 * width - 0.10 * np.clip((h - BELT) / 0.36, 0, 1) * width
    ahead = (n[:, 0] > 0.25) & (h > 0.685) & (h < 0.955) & (np.abs(y) < frame)
    behind = (n[:, 0] < -0.2) & (h > 0.72) & (h < 0.94) & (np.abs(y) < frame * 0.97)
    patch.set(ahead | behind, GLASS, 0.36)
    front = (u > 0.44) & (n[:, 0] > 0.2)
    lamp = front & (np.abs(y) > 0.27 * width) & (h > 0.415 + 0.06 * (np.abs(y) / width - 0.27)) & (h < 0.515)
    patch.set(lamp, (0.75, 0.78, 0.78), 0.3, 0.25)
    patch.set(lamp & (np.abs(np.abs(y) - 0.36 * width) < 0.035) & (np.abs(h - 0.465) < 0.025), (0.2, 0.2, 0.2), 0.3)
    grille = front & (np.abs(y) < 0.23 * width) & (h > 0.37) & (h < 0.47)
    patch.set(grille, np.where((np.floor(h[grille] * 70) % 2)[:, None] > 0, 0.02, 0.09).astype(np.float32), 0.05)
    patch.set(front & (np.abs(y) < 0.05) & (np.abs(h - 0.42) < 0.03), (0.6, 0.6, 0.6), 0.3)
    patch.set(front & (np.abs(y) < 0.36 * width) & (h > 0.235) & (h < 0.305), (0.02, 0.02, 0.02))
    patch.set(front & (np.abs(y) < 0.26) & (h > 0.30) & (h < 0.37), (0.75, 0.75, 0.75))
    letters = (np.abs(y) < 0.21) & (np.floor(y * 22) % 2 > 0)
    patch.set(front & letters & (np.abs(h - 0.335) < 0.018), (0.05, 0.05, 0.05))
    rear = (u < -0.45) & (n[:, 0] < -0.2)
    lamp = (u < -0.445) & (np.abs(y) > 0.30 * width) & (h > 0.5) & (h < 0.61)
    patch.set(lamp, (0.02, 0.02, 0.45), 0.15, 0.25)
    patch.set(lamp & (np.abs(h - 0.535) < 0.012), (0.6, 0.6, 0.7), 0.2)
    patch.set(rear & (h > 0.635) & (h < 0.645), (0.02, 0.02, 0.02))
    patch.set(rear & (np.abs(y) < 0.26) & (h > 0.44) & (h < 0.515), (0.75, 0.75, 0.75))
    patch.set(rear & letters & (np.abs(h - 0.477) < 0.018), (0.05, 0.05, 0.05))
    patch.set(rear & (h > 0.225) & (h < 0.3), (0.03, 0.03, 0.03))


def _wheel(patch: Patch) -> None:
    spec, p, z, n = patch.spec, patch.p, patch.z, patch.n
    length = spec.box_m[0]
    big = spec.category in ("truck", "bus")
    radius = 0.48 if big else WHEEL_RADIUS_M
    axles = truck_axles(spec.category, length) if big else (WHEEL_AT * length, -WHEEL_AT * length)
    d = p[:, 0][:, None] - np.array(axles)
    dx = np.take_along_axis(d, np.abs(d).argmin(1)[:, None], 1)[:, 0]
    dz = z - radius
    r, angle = np.hypot(dx, dz) / radius, np.arctan2(dz, dx)
    patch.fill(RUBBER)
    face = np.abs(n[:, 1]) > 0.8
    rim = face & (r < 0.7)
    patch.set(rim, (0.42, 0.42, 0.42), 0.15)
    if big:
        patch.set(face & (r < 0.62) & (r > 0.28), (0.12, 0.12, 0.12))
        patch.set(face & (np.abs(r - 0.4) < 0.05) & (np.cos(8 * angle) > 0.5), (0.4, 0.4, 0.4))
        return
    patch.set(rim & (r < 0.63) & (r > 0.2) & (np.cos(5 * angle) < 0.15), (0.03, 0.03, 0.03))
    patch.set(face & (r < 0.09), (0.1, 0.1, 0.1))


def _cab(patch: Patch) -> None:
    spec, p, z, n = patch.spec, patch.p, patch.z, patch.n
    length, width, height = spec.box_m
    top, front = 0.8 * height, length / 2
    y, x = p[:, 1], p[:, 0]
    patch.fill(linear_bgr(spec.second_color), 0.12)
    patch.set((n[:, 0] > 0.3) & (z > 0.53 * top) & (z < 0.93 * top) & (np.abs(y) < 0.42 * width), GLASS, 0.36)
    window = (np.abs(n[:, 1]) > 0.6) & (z > 0.55 * top) & (z < 0.9 * top) & (x > front - 1.35) & (x < front - 0.28)
    patch.set(window, GLASS, 0.34)
    nose = n[:, 0] > 0.5
    grille = (np.abs(y) < 0.34 * width) & (z > 0.27 * top) & (z < 0.47 * top) & (np.floor(z * 14) % 2 > 0)
    patch.set(nose & grille, (0.03, 0.03, 0.03))
    patch.set(nose & (z < 0.25 * top), (0.06, 0.06, 0.06))
    patch.set(nose & (np.abs(y) > 0.32 * width) & (z > 0.25 * top) & (z < 0.33 * top), (0.8, 0.8, 0.8), 0.2, 0.3)
    patch.set(nose & (np.abs(y) < 0.26) & (z > 0.16 * top) & (z < 0.21 * top), (0.75, 0.75, 0.75))
    fender = np.hypot(x - (front - 0.95), z - 0.48)
    patch.set((fender < 0.56) & (np.abs(n[:, 1]) > 0.5), (0.01, 0.01, 0.01))


def _cargo(patch: Patch) -> None:
    spec, p, z, n = patch.spec, patch.p, patch.z, patch.n
    length, width, height = spec.box_m
    patch.fill(linear_bgr(spec.color), 0.03)
    side, rear = np.abs(n[:, 1]) > 0.7, n[:, 0] < -0.7
    patch.set((side | rear) & ((z > height - 0.12) | (z < 0.36 * height + 0.12)), (0.3, 0.3, 0.3))
    patch.set(side & (np.abs(np.mod(p[:, 0], 0.6) - 0.3) < 0.012), linear_bgr(spec.color) * 0.7)
    patch.set(rear & (np.abs(p[:, 1]) < 0.015), (0.05, 0.05, 0.05))
    patch.set(rear & (np.abs(np.abs(p[:, 1]) - 0.25) < 0.02) & (z > 0.5 * height), (0.35, 0.35, 0.35))
    patch.set(rear & (z < 0.36 * height + 0.12) & (np.abs(p[:, 1]) > 0.36 * width), (0.02, 0.02, 0.5), 0.1, 0.25)
    patch.set(side & (np.abs(z - 0.66 * height) < 0.14 * height) & (np.abs(p[:, 0] + 0.15 * length) < 0.22 * length),
         linear_bgr(spec.second_color), 0.03)  # fmt: skip


def _bus(patch: Patch) -> None:
    spec, p, z, n = patch.spec, patch.p, patch.z, patch.n
    length, width, height = spec.box_m
    x, y = p[:, 0], p[:, 1]
    patch.fill(linear_bgr(spec.color), 0.12)
    side, front, rear = np.abs(n[:, 1]) > 0.55, n[:, 0] > 0.5, n[:, 0] < -0.5
    patch.set(z < 0.5, (0.06, 0.06, 0.06))
    row = side & (z > 0.43 * height) & (z < 0.80 * height) & (np.abs(x) < 0.475 * length)
    patch.set(row & (np.mod(x + 0.5 * length, 1.45) > 0.09), GLASS, 0.34)
    patch.set(side & (np.abs(z - 0.37 * height) < 0.05), linear_bgr(spec.second_color), 0.1)
    at_door = np.min(np.abs(x[:, None] - length * np.array([0.42, 0.02])), 1) < 0.6
    doors = side & (n[:, 1] < 0) & (z > 0.42) & (z < 0.8 * height) & at_door
    patch.set(doors, GLASS, 0.3)
    patch.set(doors & (np.mod(x - 0.42 * length + 0.6, 0.6) < 0.05), linear_bgr(spec.color) * 0.6)
    patch.set(front & (z > 0.36 * height) & (z < 0.80 * height) & (np.abs(y) < 0.45 * width), GLASS, 0.36)
    display = front & (z > 0.84 * height) & (z < 0.93 * height) & (np.abs(y) < 0.3 * width)
    patch.set(display, (0.02, 0.12, 0.2), 0.0, 0.8)
    patch.set(rear & (z > 0.52 * height) & (z < 0.82 * height) & (np.abs(y) < 0.4 * width), GLASS, 0.34)
    patch.set(front & (np.abs(y) > 0.32 * width) & (z > 0.7) & (z < 0.95), (0.8, 0.8, 0.8), 0.2, 0.3)
    patch.set(rear & (np.abs(y) > 0.38 * width) & (z > 0.7) & (z < 1.2), (0.02, 0.02, 0.5), 0.1, 0.25)
    patch.set((front | rear) & (np.abs(y) < 0.26) & (z > 0.5) & (z < 0.62), (0.75, 0.75, 0.75))
    fender = np.min(np.hypot(x[:, None] - np.array(truck_axles("bus", length)), z[:, None] - 0.48), 1)
    patch.set(side & (fender < 0.57), (0.01, 0.01, 0.01))


def _cloth(patch: Patch) -> None:
    spec, p, z, n = patch.spec, patch.p, patch.z, patch.n
    color = linear_bgr(spec.color if patch.part == Material.SHIRT else spec.second_color)
    # Folds: waves that follow the body, fixed to it, so that they move along.
    fold = np.sin(23 * z + 9 * p[:, 1] + patch.seed) * np.sin(17 * p[:, 1] - 11 * z + 5 * p[:, 0])
    shade = 1.0 + 0.13 * fold
    patch.out.albedo[patch.rows] = color * shade[:, None]
    if patch.part == Material.SHIRT:
        front = (n[:, 0] > 0.4) & (np.abs(p[:, 1]) < 0.012)
        patch.set(front, color * 0.4)


def _plain(patch: Patch) -> None:
    spec = patch.spec
    body = linear_bgr(spec.color)
    albedo, gloss = {
        Material.SKIN: (linear_bgr(spec.skin), 0.02),
        Material.HAIR: (linear_bgr(spec.hair), 0.03),
        Material.SHOE: (np.array((0.03, 0.03, 0.035)), 0.05),
        Material.FRAME: (body[::-1] * 0.6 + 0.02, 0.15),
        Material.TIRE: (np.array(RUBBER), 0.02),
        Material.MIRROR: (body if spec.category == "car" else np.array((0.35, 0.35, 0.35)), 0.12),
    }.get(patch.part, (np.array((0.02, 0.02, 0.02)), 0.0))
    patch.fill(albedo, gloss)


_PAINTERS = {
    Material.CAR_BODY: _car, Material.WHEEL: _wheel, Material.CAB: _cab, Material.CARGO: _cargo, Material.BUS_BODY: _bus,
    Material.SHIRT: _cloth, Material.TROUSERS: _cloth,
}  # fmt: skip


FULL_SCALE = 255.0  # intensities are whole numbers up to it, as most LiDARs have them
REFLECTANCE: Surface = {"meadow": 0.4, "sidewalk": 0.28, "curb": 0.32, "asphalt": 0.16, "paint": 0.48}
BODY_REFLECTANCE = (0.06, 0.75)  # paint that is bright to the eye is bright at 905 nm, dark paint mostly dark
AIR_REFLECTANCE = 0.02
WET_SHARE, WET_BEADS = 0.5, 0.1  # of a wet road's return, and of what beads add to it
SPECKLE = 0.15  # standard deviation of a return relative to its mean
INCIDENCE_POWER = 0.7  # of rough surfaces, as in `log2sim.synth.returns`
MAX_LEVEL = 4


class GroundReflectance:
    """Reflectance of the painted ground where beams meet it; wetness from 0 to 1."""

    def __init__(self, ground: Ground, wetness: float = 0.0) -> None:
        self._ground = ground
        self._tiles: dict[tuple[int, int, int], NDArray[np.uint8]] = {}
        asphalt = REFLECTANCE["asphalt"]
        beads = (REFLECTANCE["paint"] - asphalt) * (1 - (1 - WET_BEADS) * wetness)
        dry = {**REFLECTANCE, "paint": asphalt + beads}
        self._values = {name: float(value * (1 - (1 - WET_SHARE) * wetness)) for name, value in dry.items()}

    def at(self, xy_m: NDArray[np.float64], spot_m: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the mean reflectance (N,) over spots of some widths (N,) around points (N, 2) in the map."""
        out = np.empty(len(xy_m), np.float32)
        if len(xy_m) == 0:
            return out
        level = np.clip(np.rint(np.log2(np.maximum(spot_m / GROUND_M_PER_PX, 1.0))), 0, MAX_LEVEL).astype(np.int64)
        pixel = np.floor(xy_m / (GROUND_M_PER_PX * 2.0**level)[:, None]).astype(np.int64)
        keys, group = np.unique(np.column_stack([level, pixel // TILE_PX]), axis=0, return_inverse=True)
        order = np.argsort(group, kind="stable")
        column, row = (pixel % TILE_PX).T
        for key, rows in zip(keys.tolist(), np.split(order, np.flatnonzero(np.diff(group[order])) + 1)):
            where = (key[0], key[1], key[2])
            if where not in self._tiles:
                shade = self._ground.shade(*where, self._values)
                self._tiles[where] = np.asarray(np.rint(shade * FULL_SCALE), np.uint8)
            out[rows] = self._tiles[where][row[rows], column[rows]]
        return out / np.float32(FULL_SCALE)


def spot_m(range_m: NDArray[np.float64], incidence: NDArray[np.float64]) -> NDArray[np.float64]:
    """Width (N,) in m of the spot of a beam, the mean of those along and across it; `incidence` is the cosine at the surface."""
    return np.asarray(BEAM_RAD * range_m / np.sqrt(np.maximum(incidence, 0.01)))


def body_reflectance(color: tuple[int, int, int]) -> float:
    """Return the reflectance of a body of an sRGB color."""
    low, high = BODY_REFLECTANCE
    return float(low + (high - low) * linear_bgr(color).mean())


def intensity_of(
    reflectance: NDArray[np.float32], incidence: NDArray[np.float32], rng: np.random.Generator
) -> NDArray[np.float32]:
    """Intensities (N,) of returns, corrected for range as sensors do, with speckle."""
    speckle = 1 + SPECKLE * rng.standard_normal(len(reflectance), dtype=np.float32)
    strength = reflectance * np.maximum(incidence, np.float32(0.02)) ** np.float32(INCIDENCE_POWER) * speckle
    return np.asarray(np.clip(np.rint(strength * np.float32(FULL_SCALE)), 1, FULL_SCALE), np.float32)
