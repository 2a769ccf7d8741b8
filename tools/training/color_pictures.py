"""Pictures of vehicles with known paint, rendered under skies, lamps and studio lights, for training and for testing.

Colors are linear BGR; light is relative to what a camera exposes for. A world is a paint, the light from all directions and a camera;
a view of it is one picture of a vehicle of some shape from somewhere. Nothing of a photo goes into them.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import COLOR_NAMES
from log2sim.datatypes.color_names import name_indices
from log2sim.geometry import Array
from log2sim.road.colors import CONTEXT, SIDE_PX
from log2sim.synth.paint import paint
from log2sim.synth.raster import Samples, nearest_of
from log2sim.synth.scene import AgentSpec
from log2sim.synth.shapes import bus, car, truck

Values = NDArray[np.float32]

DRAWN_PX = 72  # side of a picture before the camera's resolution
SHAPES = ("car", "car", "car", "car", "car", "car", "car", "truck", "bus")
# Ranges of L*, chroma and hue, degrees, of the paints of each name; what `name_indices` calls otherwise is not drawn, but for brown: dark
# browns and taupes of vehicles have a chroma from 7 (brown and beige in Axalta's reports), where the names of colors say black or gray.
PAINTS = {
    "black": ((1, 22), (0, 5), (0, 360)), "white": ((86, 97), (0, 12), (0, 360)), "gray": ((25, 60), (0, 6), (0, 360)),
    "silver": ((60, 80), (0, 6), (0, 360)), "red": ((14, 85), (15, 85), (-45, 45)), "blue": ((8, 68), (13, 70), (190, 318)),
    "green": ((10, 90), (12, 95), (100, 190)), "yellow": ((55, 92), (42, 95), (74, 111)), "brown": ((7, 70), (7, 34), (18, 95)),
    "orange": ((42, 75), (45, 95), (45, 74)),
}  # fmt: skip
METALLIC = {"silver": 0.95, "gray": 0.7, "white": 0.25, "black": 0.5, "yellow": 0.2, "orange": 0.3}  # share; else 0.6
LIGHTS = ("sun", "sun", "overcast", "shade", "shade", "dusk", "night", "studio")
# Standard deviations of the logarithm: of white balance beside what follows from the light, about 4 degrees of angular error (gray world 6,
# learned ones 2, Barron and Tsai 2017), of exposure a photographic stop: it is for the sky as much as for the street, so that it is half a stop low
# in the mean.
WHITE_BALANCE_SIGMA, EXPOSURE_SIGMA, EXPOSURE_MEAN = 0.06, 0.7, -0.35
SUN_K = 5_500  # color temperature of daylight presets
VEILING_GLARE = 0.02  # mean, of the light of all directions
# Flakes lie nearly flat and send light back around the mirror direction, as exp(-(angle / 29 degrees)^2). With a lobe of 6.5, in relation to the
# paint at 45 degrees, a silver has an L* of 131, 112, 68, 47 and 47 at 15, 25, 45, 75 and 110 degrees and a flop index (DuPont) of 10; that of solid
# paints is 0, that of the strongest metallics about 15. Flakes send back at most 0.9 of the light in all.
FLAKE_LOBE_RAD, FLAKE_LOBES, MAX_FLAKE_ALBEDO = np.radians(29.0), (1.0, 7.0), 0.9
ROWS, COLUMNS = 48, 96  # of the light from all directions


# Linear sRGB to CIE XYZ relative to D65 white (IEC 61966-2-1).
XYZ_OF_RGB = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
WHITE_XYZ = XYZ_OF_RGB.sum(axis=1)
EPSILON, SLOPE = 216 / 24389, 24389 / 3132


def linear_of_lab(lab: Array) -> Array:
    """Return linear RGB (N, 3) of CIELAB (N, 3)."""
    y = (lab[:, 0] + 16) / 116
    f = np.stack([y + lab[:, 1] / 500, y, y - lab[:, 2] / 200], axis=1)
    xyz = np.where(f**3 > EPSILON, f**3, (f - 4 / 29) / SLOPE) * WHITE_XYZ
    return np.asarray(xyz @ np.linalg.inv(XYZ_OF_RGB).T)


@dataclass(frozen=True, eq=False)
class Shape:
    """What each pixel (H, W) of a picture shows of a vehicle and its surroundings."""

    normal: Values  # (H, W, 3)
    view: Values  # (H, W, 3): unit direction from the camera
    fixed: Values  # (H, W, 3): albedo without paint
    painted: Values  # (H, W): share of the paint
    gloss: Values  # (H, W)
    glow: Values  # (H, W, 3)
    height: Values  # (H, W): above the ground, in heights of the vehicle
    vehicle: NDArray[np.bool_]  # (H, W)
    away: Values  # (H, W), m: of the ground from the vehicle's outline, NaN where there is none


def draw_shape(rng: np.random.Generator) -> Shape:
    """Draw a vehicle from a random side into a box with its context."""
    category = str(rng.choice(SHAPES))
    if category == "car":
        size = (rng.uniform(3.4, 5.4), rng.uniform(1.6, 2.05), rng.uniform(1.3, 2.1))
        kind = str(rng.choice(["sedan", "hatch"]))
        mesh = car(size, kind)
    else:
        size = (rng.uniform(6, 12), rng.uniform(2.2, 2.6), rng.uniform(2.6, 3.8))
        kind, mesh = "", (truck if category == "truck" else bus)(size)
    yaw, distance = rng.uniform(0, 2 * np.pi), max(size) * rng.uniform(0.9, 6)
    height = rng.uniform(0.8, 2.6) if rng.random() < 0.85 else rng.uniform(3, 8)
    eye = np.array([distance * np.cos(yaw), distance * np.sin(yaw), height - size[2] / 2])
    ahead = -eye / np.linalg.norm(eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(ahead, right), ahead])
    vertices = (mesh.vertices_m - eye) @ axes.T
    tangent = vertices[:, :2] / np.maximum(vertices[:, 2:], 0.3)
    low, high = tangent.min(axis=0), tangent.max(axis=0)
    middle = (low + high) / 2 + rng.normal(0, 0.04, 2) * (high - low)
    half = (high - low) / 2 * CONTEXT * np.exp(rng.normal(0, 0.12, 2))
    K = np.diag([*(DRAWN_PX / 2 / half), 1.0])
    K[:2, 2] = DRAWN_PX / 2 - 0.5 - middle * K[[0, 1], [0, 1]]
    found = nearest_of(Samples.of(vertices, mesh.faces, K, DRAWN_PX, DRAWN_PX))
    u, v = (x.ravel() for x in np.meshgrid(np.arange(DRAWN_PX), np.arange(DRAWN_PX)))
    rays = np.column_stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(len(u))]) @ axes
    at = found.pixel(DRAWN_PX)
    points = eye + rays[at] * found.depth_m[:, None]
    normals = found.interpolated(mesh.normals, mesh.faces)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # Real panels are more curved than those of the mesh.
    wave = rng.normal(0, 2.5, (3, 3))
    normals += rng.uniform(0, 0.12) * np.sin(points @ wave + rng.uniform(0, 6, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    second = tuple(int(c) for c in rng.integers(20, 200, 3))
    look = AgentSpec.model_construct(category=category, size_m=size, shape=kind, second_color=second)
    bare, full = (
        paint(look.model_copy(update={"color": (c,) * 3}), mesh.part[found.face], points, normals) for c in (0, 255)
    )

    def image(values: Values, channels: int, rest: float = 0.0) -> Values:
        out = np.full((DRAWN_PX**2, channels), rest, np.float32)
        out[at] = values.reshape(len(at), channels)
        return out.reshape(DRAWN_PX, DRAWN_PX, channels)

    slope = np.where(rays[:, 2] < -1e-3, (-size[2] / 2 - eye[2]) / np.minimum(rays[:, 2], -1e-3), np.nan)
    ground = eye[:2] + rays[:, :2] * slope[:, None]
    outside = np.maximum(np.abs(ground) - np.array(size[:2]) / 2, 0)
    vehicle = image(np.ones(len(at)), 1)[..., 0] > 0
    unit = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
    return Shape(
        image(normals, 3), unit.reshape(DRAWN_PX, DRAWN_PX, 3), image(bare.albedo, 3),
        image((full.albedo - bare.albedo).mean(axis=1), 1)[..., 0], image(bare.gloss, 1)[..., 0], image(bare.glow, 3),
        image(points[:, 2] / size[2] + 0.5, 1)[..., 0], vehicle,
        np.hypot(*outside.T).astype(np.float32).reshape(DRAWN_PX, DRAWN_PX),
    )  # fmt: skip


def draw_paint(name: str, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw a paint (3,) of a name, CIELAB."""
    while True:
        (L, chroma, hue) = (rng.uniform(*span) for span in PAINTS[name])
        lab = np.array([L, chroma * np.cos(np.radians(hue)), chroma * np.sin(np.radians(hue))])
        linear = linear_of_lab(lab[None])[0]
        possible = linear.min() > -0.01 and linear.max() < 1
        if possible and (name == "brown" or COLOR_NAMES[int(name_indices(lab))] == name):
            return lab


def tint(kelvin: float) -> Values:
    """Return the color (3,) of a black body, its mean 1 (Kim et al. 2002, of the Planckian locus)."""
    t = 1e3 / kelvin
    x = np.polyval([-0.2661239, -0.2343589, 0.8776956, 0.17991] if kelvin <= 4000 else
                   [-3.0258469, 2.1070379, 0.2226347, 0.24039], t)  # fmt: skip
    y = np.polyval([-0.9549476, -1.37418593, 2.09137015, -0.16748867] if kelvin <= 4000 else
                   [3.081758, -5.8733867, 3.75112997, -0.37001483], x)  # fmt: skip
    X, Z = x / y, (1 - x - y) / y
    rgb = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.204, 1.057]]) @ [X, 1.0, Z]
    bgr = np.maximum(rgb[::-1], 0.02)
    return (bgr / bgr.mean()).astype(np.float32)


@dataclass(frozen=True, eq=False)
class World:
    """A paint, the light around it and a camera."""

    name: str
    lab: NDArray[np.float64]  # (3,): of the paint
    flakes: float  # what they send into the mirror direction, in relation to the paint at 45 degrees from it
    dirt: float
    light: str
    sky: Values  # (ROWS, COLUMNS, 3): light from all directions, from the nadir up
    sun: Values  # (3,): light on a surface that faces it
    toward_sun: Values  # (3,)
    lamp: Values  # (3,): light from where the camera is, such as the ego's headlights
    road: Values  # (3,): albedo
    wet: float
    backdrop: Values | None  # (3,): of a studio
    white: Values  # (3,): gains of the camera's white balance
    exposure: float  # logarithm
    metering: float  # share of the picture in what exposure is measured by
    haze: float
    contrast: float  # of the tone curve; below zero shadows are lifted
    saturation: float
    shoulder: bool


def _rows_up() -> tuple[Values, Values]:
    sine = np.sin((np.arange(ROWS) + 0.5) / ROWS * np.pi - np.pi / 2)
    azimuth = (np.arange(COLUMNS) + 0.5) / COLUMNS * 2 * np.pi
    return sine[:, None].astype(np.float32), azimuth[None].astype(np.float32)


def _noise(rng: np.random.Generator, shape: tuple[int, int], cells: int, sigma: float) -> Values:
    small = rng.normal(0, sigma, (max(2, cells), max(2, cells))).astype(np.float32)
    return cv2.resize(small, shape[::-1], interpolation=cv2.INTER_CUBIC)


def draw_world(rng: np.random.Generator, name: str | None = None, light: str | None = None) -> World:
    """Draw a world; each name is as frequent as the others."""
    name = str(rng.choice(COLOR_NAMES)) if name is None else name
    light = str(rng.choice(LIGHTS)) if light is None else light
    up, azimuth = _rows_up()
    sun, lamp, backdrop = np.zeros(3, np.float32), np.zeros(3, np.float32), None
    elevation, heading = np.radians(rng.uniform(8, 65)), rng.uniform(0, 2 * np.pi)
    toward = np.array([np.cos(heading) * np.cos(elevation), np.sin(heading) * np.cos(elevation), np.sin(elevation)])
    rise = np.clip(up, 0, 1)[..., None]
    if light == "overcast":
        # CIE standard overcast sky: three times as bright overhead as at the horizon.
        sky = (1 + 2 * rise) / 3 * tint(rng.uniform(5800, 7500))
    elif light == "night":
        sky = np.full((1, 1, 3), rng.uniform(0.005, 0.06)) * tint(rng.uniform(2300, 6000))
        lamp = rng.exponential(0.2) * tint(rng.uniform(2800, 6500))
    elif light == "studio":
        level = rng.choice([0.03, 0.3, 0.8])
        sky = np.full((1, 1, 3), level) * tint(rng.uniform(3000, 6500))
        backdrop = np.clip(rng.choice([0.0, 0.02, 0.3, 0.9, 1.0]) * tint(rng.uniform(5000, 7500)), 0, 1)
    else:
        zenith, horizon = tint(rng.uniform(9000, 20000)), tint(rng.uniform(5500, 7500))
        sky = (horizon * (1 - rise) + zenith * rise * rng.uniform(0.4, 0.8)) * (0.5 if light == "sun" else 0.9)
        if light != "shade":
            kelvin = rng.uniform(4500, 5800) if light == "sun" else rng.uniform(2500, 4000)
            sun = rng.uniform(1.2, 3.0) * tint(kelvin) * (1.0 if light == "sun" else 0.35)
        if light == "dusk":
            toward = np.array([np.cos(heading), np.sin(heading), 0.12])
            sky = sky * 0.5
            near = np.exp(3 * (np.cos(azimuth - heading) - 1))[..., None] * np.exp(-3 * rise)
            sky = sky + near * tint(rng.uniform(2300, 3500)) * 0.8
    sky = np.broadcast_to(sky, (ROWS, COLUMNS, 3)).astype(np.float32).copy()
    above = np.broadcast_to(up > 0, (ROWS, COLUMNS))
    if light in ("sun", "shade", "dusk", "overcast"):
        clouds = np.clip(_noise(rng, (ROWS, COLUMNS), 7, 0.8), 0, 1.2)[..., None] * rng.uniform(0, 1)
        sky[above] += (clouds * sky.mean())[above]
    if light in ("night", "studio"):
        for _ in range(rng.integers(1, 7)):
            row, column = rng.integers(ROWS // 2, ROWS), rng.integers(0, COLUMNS)
            tall, wide = rng.integers(1, 5, 2) if light == "night" else rng.integers(4, 28, 2)
            kelvin = rng.uniform(1900, 5000) if light == "night" else rng.uniform(3000, 6500)
            sky[row : row + tall, column : column + wide] = rng.uniform(2, 10) * tint(kelvin)
    up_light = max(float(sky[above].mean()), 1e-3)
    sunny = sun * max(toward[2], 0.0)
    on_ground = sky[above].mean(axis=0) + sunny
    road = (rng.choice([0.05, 0.09, 0.14, 0.25, 0.4]) * np.exp(rng.normal(0, 0.06, 3))).astype(np.float32)
    if rng.random() < 0.15:
        road = np.array([0.04, 0.12, 0.09], np.float32) * rng.uniform(0.6, 1.6)  # grass
    sky[~above] = road * on_ground
    # Houses, trees and vehicles up to some height in each direction, lit from above; in the shade they stand all around.
    tall = np.interp(
        azimuth[0], np.sort(rng.uniform(0, 2 * np.pi, 9)), rng.exponential(0.5 if light == "shade" else 0.22, 9)
    )
    if light != "studio":
        color = np.stack(
            [np.interp(azimuth[0], np.linspace(0, 2 * np.pi, 8), rng.uniform(0.02, 0.35, 8)) for _ in range(3)], -1
        )
        color = color.mean(axis=1, keepdims=True) * 0.7 + color * 0.3
        color *= np.where(rng.random() < 0.3, np.array([0.5, 1.0, 0.8]), 1.0)
        low = (up > 0) & (up < tall[None])
        sky[low] = np.broadcast_to(color[None] * on_ground * 0.6, sky.shape)[low]
    arriving = sky[above].mean(axis=0) + 0.5 * sunny + lamp
    illuminant = arriving / max(float(arriving.mean()), 1e-4)
    # Cameras correct the color of the light whole, in part or, fixed to that of the sun, not at all: streets in the shade are bluish then.
    strength = rng.uniform()
    white = illuminant**-strength * tint(SUN_K) ** (strength - 1)
    lab = draw_paint(name, rng)
    greatest = MAX_FLAKE_ALBEDO / (FLAKE_LOBE_RAD**2 * float(linear_of_lab(lab[None]).max()))
    flakes = min(rng.uniform(*FLAKE_LOBES), greatest) if rng.random() < METALLIC.get(name, 0.6) else 0.0
    return World(
        name, lab, flakes,
        rng.uniform(0.1, 0.5) if rng.random() < 0.2 else 0.0, light, sky, sun.astype(np.float32), toward.astype(np.float32),
        lamp.astype(np.float32) * max(up_light, 0.2), road, float(rng.random() < 0.2) * rng.uniform(0.3, 1), backdrop,
        (white * np.exp(rng.normal(0, WHITE_BALANCE_SIGMA, 3))).astype(np.float32), rng.normal(EXPOSURE_MEAN, EXPOSURE_SIGMA), rng.uniform(0, 1),
        rng.uniform(0.05, 0.5) if rng.random() < 0.12 else 0.0, rng.uniform(-0.3, 0.6), rng.uniform(0.8, 1.3), bool(rng.random() < 0.5),
    )  # fmt: skip


def _look_up(sky: Values, toward: Values) -> Values:
    row = np.clip((np.arcsin(np.clip(toward[..., 2], -1, 1)) / np.pi + 0.5) * ROWS, 0, ROWS - 1e-3)
    column = (np.arctan2(toward[..., 1], toward[..., 0]) / (2 * np.pi) % 1.0) * COLUMNS
    # One more column, so that the last goes over into the first.
    wide = np.concatenate([sky, sky[:, :1]], axis=1)
    return cv2.remap(
        wide, column.astype(np.float32), row.astype(np.float32) - 0.5, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )


def _harmonics(d: Values) -> Values:
    x, y, z = d[..., 0], d[..., 1], d[..., 2]
    one = np.ones_like(x)
    return np.stack([0.282095 * one, 0.488603 * y, 0.488603 * z, 0.488603 * x, 1.092548 * x * y, 1.092548 * y * z,
                     0.315392 * (3 * z * z - 1), 1.092548 * x * z, 0.546274 * (x * x - y * y)], -1)  # fmt: skip


def _directions() -> tuple[Values, Values]:
    up, azimuth = _rows_up()
    flat = np.sqrt(1 - up**2)
    d = np.stack(np.broadcast_arrays(flat * np.cos(azimuth), flat * np.sin(azimuth), up), -1).astype(np.float32)
    area = np.broadcast_to(flat, d.shape[:2]) * (np.pi / ROWS) * (2 * np.pi / COLUMNS)
    return _harmonics(d), area.astype(np.float32)


HARMONICS, AREA = _directions()
# Convolution with the cosine, over pi: a white surface in even light has its brightness (Ramamoorthi and Hanrahan 2001).
COSINE = np.array([1.0, *[2 / 3] * 3, *[1 / 4] * 5], np.float32)


def draw_view(world: World, shape: Shape, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Draw a picture (SIDE_PX, SIDE_PX, 3) of a vehicle of a world, BGR."""
    sky, n, view = world.sky, shape.normal, shape.view
    coefficients = np.einsum("rc,rck,rcb->kb", AREA, HARMONICS, sky) * COSINE[:, None]
    lit = np.maximum(_harmonics(n) @ coefficients, 0) * np.clip(0.45 + shape.height, 0, 1)[..., None]
    facing = np.clip(-(n * view).sum(-1), 0, 1)
    mirrored = view + 2 * facing[..., None] * n
    in_sun = np.clip(n @ world.toward_sun, 0, None) * float(rng.random() < 0.85)
    direct = in_sun[..., None] * world.sun + facing[..., None] * world.lamp
    base = np.maximum(linear_of_lab(world.lab[None])[0][::-1], 0.001).astype(np.float32)
    albedo = shape.fixed + shape.painted[..., None] * base
    body = shape.painted > 0.5
    if rng.random() < 0.12:  # a roof, stripe or sticker of another color
        first = rng.uniform(0, 0.9)
        at = body & (
            (shape.height > 0.7) if rng.random() < 0.5 else (np.abs(shape.height - first) < rng.uniform(0.02, 0.08))
        )
        albedo[at] = rng.choice([0.01, 0.6])
    if world.dirt:
        dirty = world.dirt * np.clip(1.2 - 1.3 * shape.height, 0, 1) * np.exp(_noise(rng, body.shape, 9, 0.5))
        albedo += np.clip(dirty, 0, 0.8)[..., None] * (np.array([0.11, 0.15, 0.18], np.float32) - albedo)
    color = albedo * (lit + direct)
    if world.flakes:
        sigma = FLAKE_LOBE_RAD / np.sqrt(2) / np.pi * ROWS
        soft = cv2.GaussianBlur(sky, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
        glint = np.exp(2 / FLAKE_LOBE_RAD**2 * ((mirrored * world.toward_sun).sum(-1) - 1)) * in_sun
        lobe = FLAKE_LOBE_RAD**2 * facing[..., None] * _look_up(soft, mirrored) + glint[..., None] * world.sun
        at_45 = np.exp(-((np.radians(45) / FLAKE_LOBE_RAD) ** 2))
        color += world.flakes * body[..., None] * (base * lobe - at_45 * color)
    coat = 0.045 + 0.955 * (1 - facing) ** 5
    clean = 1 - 0.8 * min(2 * world.dirt, 1)
    shine = np.where(shape.gloss > 0.05, coat * np.where(shape.gloss > 0.25, 1.3, 1.0), 0.0) * clean
    half_sun = np.clip((mirrored * world.toward_sun).sum(-1), 0, 1) ** 300 * 30
    color += shine[..., None] * (_look_up(sky, mirrored) + half_sun[..., None] * world.sun)
    color += shape.glow * rng.choice([0.0, 0.5, 3.0])
    around = _background(world, shape, rng)
    picture = np.where(shape.vehicle[..., None], color, around)
    mean_light = sky.mean(axis=(0, 1)) + world.sun * 0.1 + world.lamp * 0.1
    return _taken(picture, mean_light, world, rng)


def _background(world: World, shape: Shape, rng: np.random.Generator) -> Values:
    sides = shape.vehicle.shape
    if world.backdrop is not None:
        fall = np.linspace(rng.uniform(0.6, 1), rng.uniform(0.6, 1), sides[0])[:, None, None]
        level = max(float(world.sky.mean()), 0.1) * 2
        out = np.broadcast_to(world.backdrop * level * fall, (*sides, 3)).astype(np.float32)
    else:
        texture = sum(_noise(rng, sides, cells, 0.22) for cells in (5, 14, 40))
        out = _look_up(world.sky, shape.view) * np.exp(texture)[..., None]
        for _ in range(rng.integers(0, 5)):
            u, v = rng.integers(0, sides[1]), rng.integers(0, sides[0] * 2 // 3)
            tone = np.exp(rng.normal(-2, 0.9)) * np.exp(rng.normal(0, 0.25, 3))
            light = world.sky[ROWS // 2 :].mean(axis=(0, 1)) + 0.4 * world.sun
            out[v : v + rng.integers(3, 40), u : u + rng.integers(2, 30)] = (tone * light).astype(np.float32)
    ground = np.isfinite(shape.away) & ~shape.vehicle
    light = world.sky[ROWS // 2 :].mean(axis=(0, 1)) + world.sun * max(float(world.toward_sun[2]), 0) + world.lamp * 0.3
    shade = 1 - 0.85 * np.exp(-np.nan_to_num(shape.away, nan=9.0) / rng.uniform(0.1, 0.6))
    surface = world.road * (1 - 0.4 * world.wet) * light * np.exp(_noise(rng, sides, 20, 0.12))[..., None]
    if world.wet:
        up = shape.view * np.array([1, 1, -1], np.float32)
        flat = np.clip(1 + shape.view[..., 2], 0, 1) ** 5
        surface = surface + (world.wet * (0.02 + 0.5 * flat))[..., None] * _look_up(world.sky, up)
    near = ground & (np.nan_to_num(shape.away, nan=99.0) < rng.uniform(4, 60))
    if world.backdrop is not None:
        surface = out * rng.uniform(0.5, 1)
    return np.where(near[..., None], surface * shade[..., None], out).astype(np.float32)


def _taken(picture: Values, mean_light: Values, world: World, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Take a picture with the camera: what hides the vehicle, haze, exposure, curve, noise, resolution and JPEG."""
    side = len(picture)
    for _ in range(int(rng.random() < 0.3) * rng.integers(1, 3)):
        wide, tall = int(side * rng.uniform(0.05, 0.4)), int(side * rng.uniform(0.2, 1))
        u = int(rng.choice([0, side - wide])) if wide > side // 8 else int(rng.integers(0, side))
        v = int(rng.choice([0, side - tall]))
        color = np.exp(rng.normal(-2, 0.9)) * np.exp(rng.normal(0, 0.3, 3)) * 2 * mean_light
        picture[v : v + tall, u : u + wide] = color
    horizon = world.sky[ROWS // 2 : ROWS // 2 + 3].mean(axis=(0, 1))
    picture = picture + world.haze * (horizon - picture)
    # Light that a lens and a windshield scatter over the whole picture, of good lenses one to three percent (ISO 9358): it tints what is black.
    picture = picture + rng.exponential(VEILING_GLARE) * mean_light
    picture = picture * world.white
    seen = float(np.exp(np.log(np.maximum(picture.mean(axis=-1), 1e-4)).mean()))
    whole = max(float((mean_light * world.white).mean()) * 0.5, 1e-3)
    level = np.exp(world.metering * np.log(seen) + (1 - world.metering) * np.log(whole))
    # A night is dark in pictures: gain has a limit.
    gain = min(0.18 / level, 25.0) * np.exp(world.exposure + rng.normal(0, 0.1))
    x = np.clip(picture * gain, 0, 50)
    x = 1 - np.exp(-1.3 * x) if world.shoulder else np.minimum(x, 1)
    size = int(np.clip(np.exp(rng.uniform(np.log(14), np.log(1.6 * side))), 14, side))
    blur = rng.uniform(0, 1.2)
    x = cv2.GaussianBlur(x.astype(np.float32), (0, 0), blur) if blur > 0.3 else x
    x = cv2.resize(x.astype(np.float32), (size, size), interpolation=cv2.INTER_AREA)
    x = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
    x = x - world.contrast * np.sin(2 * np.pi * x) / (2 * np.pi)
    gray = x.mean(axis=-1, keepdims=True)
    x = gray + world.saturation * (x - gray)
    x = x + rng.normal(0, rng.choice([0.004, 0.01, 0.03 if world.light in ("night", "dusk") else 0.015]), x.shape)
    out = np.clip(np.round(x * 255), 0, 255).astype(np.uint8)
    if rng.random() < 0.8:
        data = cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(35, 97))])[1]
        out = cv2.imdecode(data, cv2.IMREAD_COLOR)
    if rng.random() < 0.25:  # the edge of the camera's picture cuts the context off
        cut = int(size * rng.uniform(0.03, 0.14))
        out = cv2.copyMakeBorder(out[:, cut:], 0, 0, cut, 0, cv2.BORDER_REPLICATE)
        if rng.random() < 0.5:
            out = out[:, ::-1]
    return np.asarray(cv2.resize(out, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_LINEAR), np.uint8)
