"""Light of the sun, the sky and lamps on surfaces, a camera at one time, and the sky and the ground in its picture."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, Camera, apply, inverse
from log2sim.synth.ground import GROUND_M_PER_PX, LEVELS, TILE_PX, Ground
from log2sim.synth.paint import Paint
from log2sim.synth.scene import Environment, Road

Color = tuple[float, float, float]

HOUSES, ROAD = 0.22, 0.09  # light from them relative to the sky's on a surface, as seen in a mirror
WET_ALBEDO = 0.62  # of a wet road relative to a dry one


@dataclass(frozen=True)
class Light:
    """Light on a scene and what the air does to it; colors are linear BGR at the exposure of the camera.

    `sun_color`, `sky_color`: light on a white surface that faces the sun, and on one that sees the whole sky.
    """

    sun: Color  # unit direction towards the sun
    sun_color: Color
    sky_color: Color
    horizon: Color  # the sky at the horizon and overhead
    zenith: Color
    extinction_per_m: float = 1 / 500  # share of light that the air takes on a meter
    lamps: float = 0.0  # brightness of headlights, rear lights and street lights, relative to what surfaces emit by day
    wetness: float = 0.0  # from 0 for a dry road to 1 for a wet one
    rain_mm_h: float = 0.0
    noise: float = 1.0  # of the camera, relative to daylight
    exposure: float = 0.01  # relative to that of a night, at which lamps light the road well
    glare: bool = False  # whether wet ground mirrors the sun and lamps

    def on_ground(self) -> NDArray[np.float32]:
        """Light (3,) that level ground under the open sky gives back relative to its dry color."""
        dry = np.add(self.sky_color, np.multiply(self.sun_color, self.sun[2]))
        return np.asarray(dry * (1 - (1 - WET_ALBEDO) * self.wetness), np.float32)

    def hazy(self, color: NDArray[np.float32], depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Dim light (..., 3), in place, by the air over distances (...)."""
        passed = np.exp(depth_m * np.float32(-self.extinction_per_m))
        added = 1 - passed
        for channel, horizon in enumerate(self.horizon):
            color[..., channel] *= passed
            color[..., channel] += added * np.float32(horizon)
        return color


def _unit(x: float, y: float, z: float) -> Color:
    length = float(np.linalg.norm([x, y, z]))
    return x / length, y / length, z / length


_HIGH = _unit(-0.45, -0.5, 0.74)
NOON = Light(_HIGH, (0.80, 0.88, 0.95), (0.56, 0.50, 0.45), (0.78, 0.74, 0.70), (0.72, 0.48, 0.30))
# Colors follow the sun's temperature: 5500 K at noon, 6500 K under clouds, 3000 K when it sets; shadows are blue then.
OVERCAST = Light(
    _HIGH, (0.05, 0.05, 0.05), (0.78, 0.76, 0.74), (0.80, 0.79, 0.78), (0.66, 0.65, 0.64), extinction_per_m=1 / 400
)
DUSK = Light(
    _unit(-0.86, -0.42, 0.16), (0.16, 0.40, 0.85), (0.30, 0.22, 0.19), (0.42, 0.52, 0.70), (0.30, 0.18, 0.13),
    lamps=4.0, noise=2.0, exposure=0.2,
)  # fmt: skip
NIGHT = Light(
    _HIGH, (0.0, 0.0, 0.0), (0.030, 0.023, 0.019), (0.030, 0.024, 0.022), (0.012, 0.008, 0.006),
    lamps=10.0, noise=5.0, exposure=1.0,
)  # fmt: skip
LIGHTS = {"noon": NOON, "overcast": OVERCAST, "dusk": DUSK, "night": NIGHT}


def light_of(environment: Environment) -> Light:
    """Light of a scene's environment: fog and rain hide the sun and gray the sky, lamps are on.

    Rain takes light besides what clear air takes, fog so much more that the air does not count.
    """
    light, fog = LIGHTS[environment.light], environment.weather == "fog"
    if environment.weather != "clear":
        extinction = environment.extinction_per_m + (0.0 if fog else light.extinction_per_m)
        sky = np.add(light.sky_color, np.multiply(light.sun_color, 0.5 * light.sun[2]))
        gray = (sky + 2 * sky.mean()) / 3 * (1.0 if fog else 0.8)
        colors = np.multiply(light.sun_color, 0.06), gray, gray * 0.92, gray * (0.88 if fog else 0.7)
        names = ("sun_color", "sky_color", "horizon", "zenith")
        changed: dict[str, Any] = {name: tuple(color.tolist()) for name, color in zip(names, colors)}
        light = replace(
            light, **changed, extinction_per_m=extinction, lamps=max(light.lamps, 3.0), wetness=0.3 if fog else 1.0,
            rain_mm_h=0.0 if fog else environment.rain_mm_h, noise=light.noise * 1.3,
        )  # fmt: skip
    wetness = light.wetness if environment.wetness is None else environment.wetness
    return replace(light, wetness=wetness, glare=environment.glare)


def reflected(
    light: Light,
    surface: Paint,
    n: NDArray[np.float32],
    to_camera: NDArray[np.float32],
    height: NDArray[np.float32],
    lamplight: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Light (P, 3) from surfaces with unit normals (P, 3) towards a camera.

    `height` (P,) float32, m: above the road. `lamplight` (P, 3) float32: light of lamps on the surfaces.
    """
    # Channel by channel, because NumPy is slow where the last axis is short.
    sun_x, sun_y, sun_z = (np.float32(x) for x in light.sun)
    n_sun, n_camera = n[:, 0] * sun_x + n[:, 1] * sun_y + n[:, 2] * sun_z, np.einsum("pi,pi->p", n, to_camera)
    camera_sun = to_camera[:, 0] * sun_x + to_camera[:, 1] * sun_y + to_camera[:, 2] * sun_z
    openness = (0.62 + 0.38 * n[:, 2]) * np.clip(0.55 + 0.6 * height, 0.0, 1.0)
    sun, facing = np.clip(n_sun, 0, 1), np.clip(n_camera, 0, 1)
    gloss = surface.gloss * (0.35 + 0.65 * (1 - facing) ** 3)
    up = 2 * facing * n[:, 2] - to_camera[:, 2]
    blend = np.clip((up - 0.12) / 0.1, 0, 1)
    below = np.clip((-up - 0.02) / 0.08, 0, 1)
    # What mirrors show that look up by this sine: the sky (and how high), houses and the road.
    sky_share = (blend * (1 - below), np.clip(up * 1.6, 0, 1))
    house_share, road_share = (1 - blend) * (1 - below), below
    along = np.clip(2 * facing * n_sun - camera_sun, 0, 1)
    along4 = along * along * along * along
    along8 = along4 * along4
    along16 = along8 * along8
    glint = 2.0 * surface.gloss * (along16 * along16 * along16 * along8 * along4)  # to the power of 60
    surrounding = np.float32(np.mean(light.sky_color) / np.mean(NOON.sky_color))
    emission = np.float32(max(1.0, light.lamps))
    out = np.empty((len(n), 3), np.float32)
    for c in range(3):
        lit = openness * np.float32(light.sky_color[c]) + sun * np.float32(light.sun_color[c])
        slope = np.float32(light.zenith[c] - light.horizon[c])
        mirrored = (np.float32(light.horizon[c]) + slope * sky_share[1]) * sky_share[0]
        mirrored += (np.float32(HOUSES) * house_share + np.float32(ROAD) * road_share) * surrounding
        if lamplight is not None:
            lit += lamplight[:, c]
        sparkle = glint * np.float32(light.sun_color[c] / NOON.sun_color[c])
        out[:, c] = surface.albedo[:, c] * lit + surface.glow[:, c] * emission + gloss * mirrored + sparkle
    return out


CAMERA_NEAR_M = 0.2  # of the near plane


@dataclass(frozen=True, eq=False)
class RenderCamera:
    """A camera at one time."""

    K: Array  # (3, 3), px
    width_px: int
    height_px: int
    map_T_cam: Array  # (4, 4)

    @classmethod
    def of(cls, camera: Camera, map_T_cam: Array) -> RenderCamera:
        """Take a camera without its distortion."""
        return cls(camera.K, camera.width_px, camera.height_px, map_T_cam)

    def divided(self, columns: int, rows: int) -> RenderCamera:
        """Divide each pixel into several; whole numbers are pixel centers, before and after."""
        K = self.K * [[columns], [rows], [1]]
        K[:2, 2] += (columns - 1) / 2, (rows - 1) / 2
        return RenderCamera(K, self.width_px * columns, self.height_px * rows, self.map_T_cam)

    def rays(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Rays with depth 1 in the map, as sums of a part by column (W, 3) and a part by row (H, 3)."""
        u = (np.arange(self.width_px) - self.K[0, 2]) / self.K[0, 0]
        v = (np.arange(self.height_px) - self.K[1, 2]) / self.K[1, 1]
        R = self.map_T_cam[:3, :3]
        return np.outer(u, R[:, 0]).astype(np.float32), (np.outer(v, R[:, 1]) + R[:, 2]).astype(np.float32)

    def rise(self) -> NDArray[np.float32]:
        """Height gained by rays of depth 1: (H, W), or (H, 1) where all of a row rise alike."""
        by_column, by_row = self.rays()
        if np.ptp(by_column[:, 2]) < 1e-6:
            by_column = by_column[:1]
        return np.asarray(by_row[:, None, 2] + by_column[None, :, 2])

    def directions(self, u: NDArray[Any], v: NDArray[Any]) -> Array:
        """Rays (N, 3) of depth 1 in the map through points of the image."""
        rays = np.column_stack([(u - self.K[0, 2]) / self.K[0, 0], (v - self.K[1, 2]) / self.K[1, 1], np.ones(len(u))])
        return np.asarray(rays @ self.map_T_cam[:3, :3].T)

    def ground_depth(self, u: NDArray[Any], v: NDArray[Any]) -> Array:
        """Depth (N,) at which rays through points of the image meet z = 0, at most `FAR_M`."""
        fall = np.maximum(-self.directions(u, v)[:, 2], 1e-9)
        return np.asarray(np.minimum(self.map_T_cam[2, 3] / fall, FAR_M))

    def image_H_plane(self, origin: Array, first: Array, second: Array) -> Array:
        """Homography (3, 3) from coordinates along two directions (3,) in the map, from `origin` (3,) relative to the camera."""
        return np.asarray(self.K @ self.map_T_cam[:3, :3].T @ np.column_stack([first, second, origin]))

    def polygon(self, points_map: Array) -> NDArray[np.int32]:
        """Project a convex polygon (P, 3), clipped at the near plane, to sixteenths of a pixel (Q, 2); may be empty."""
        p = apply(inverse(self.map_T_cam), points_map)
        out = []
        for a, b in zip(p, np.roll(p, -1, axis=0)):
            if a[2] >= CAMERA_NEAR_M:
                out.append(a)
            if (a[2] >= CAMERA_NEAR_M) != (b[2] >= CAMERA_NEAR_M):
                out.append(a + (b - a) * (CAMERA_NEAR_M - a[2]) / (b[2] - a[2]))
        if len(out) < 3:
            return np.zeros((0, 2), np.int32)
        q = np.array(out)
        uv = q[:, :2] / q[:, 2:] * [self.K[0, 0], self.K[1, 1]] + self.K[:2, 2]
        return np.asarray(np.rint(np.clip(uv, -1e5, 1e5) * 16).astype(np.int32))


FAR_M = 2000.0
ROWS_PER_PX = 2  # rows of the ground that are averaged for a pixel, because it is seen at a grazing angle
MIN_FALL = 1e-3  # of a ray of depth 1 that meets the ground
GAMMA = 2.2
_LINEAR = ((np.arange(256) / 255.0) ** GAMMA).astype(np.float32)

Image = NDArray[np.float32]
Texture = NDArray[np.uint8]


def linear(image: Texture, light: NDArray[np.float32]) -> Image:
    """Light from surfaces of sRGB colors (H, W, 3) in light of a color (3,)."""
    out: Image = cv2.LUT(image, _LINEAR)  # type: ignore[assignment]
    out *= light
    return out


def draw_sky(view: RenderCamera, light: Light) -> tuple[Image, Image]:
    """Draw the sky: the image (H, W, 3) and its depth (H, W) in m."""
    up = view.rise()
    rise = np.clip(up / np.sqrt(1 + up * up) * 1.8, 0, 1)[..., None]
    horizon, zenith = np.array(light.horizon, np.float32), np.array(light.zenith, np.float32)
    color = np.empty((view.height_px, view.width_px, 3), np.float32)
    color[:] = horizon + (zenith - horizon) * rise
    return color, np.full(color.shape[:2], FAR_M, np.float32)


def draw_ground(view: RenderCamera, ground: Ground, light: Light, color: Image, depth: Image) -> None:
    """Draw the ground z = 0 below the horizon."""
    fall = -view.rise()
    rows = np.flatnonzero((fall > MIN_FALL).any(1))
    height = float(view.map_T_cam[2, 3])
    if len(rows) == 0 or height <= 0:
        return
    band = slice(int(rows[0]), int(rows[-1]) + 1)
    below = fall[band] > MIN_FALL
    away = np.divide(np.float32(height), fall[band], out=np.full(below.shape, FAR_M, np.float32), where=below)
    # Tiles of the ground are warped into rows of the image, for each row from the level whose resolution fits.
    fine, top = view.divided(1, ROWS_PER_PX), band.start * ROWS_PER_PX
    middle = fine.ground_depth(np.full(fine.height_px, fine.width_px / 2), np.arange(fine.height_px))
    part = middle[top : band.stop * ROWS_PER_PX]
    image = np.empty((len(part), fine.width_px, 3), np.uint8)
    for level, some in rows_by_level(part, ROWS_PER_PX * fine.map_T_cam[2, 3], fine.K[0, 0]):
        image[some] = _warped(fine, ground, level, slice(top + some.start, top + some.stop))
    small = cv2.resize(image, (fine.width_px, band.stop - band.start), interpolation=cv2.INTER_AREA)
    lit = linear(np.asarray(small, np.uint8), light.on_ground())
    away, below = (np.broadcast_to(x, lit.shape[:2]) for x in (np.minimum(away, FAR_M), below))
    if below.all():
        color[band], depth[band] = lit, away
    else:
        color[band][below], depth[band][below] = lit[below], away[below]


def rows_by_level(away_m: Array, height_m: float, focal_px: float) -> Iterator[tuple[int, slice]]:
    """Yield levels of tiles and the successive rows whose resolution they fit, by their depths (H,) and the camera's height."""
    slanted = np.sqrt(np.maximum(away_m / height_m, 1.0))
    footprint = away_m / focal_px * slanted
    level = np.clip(np.log2(np.maximum(footprint / GROUND_M_PER_PX, 1.0)), 0, LEVELS - 1).astype(int)
    edges = [0, *(np.flatnonzero(np.diff(level)) + 1).tolist(), len(level)]
    for first, last in pairwise(edges):
        yield int(level[first]), slice(first, last)


def _warped(fine: RenderCamera, ground: Ground, level: int, rows: slice) -> Texture:
    """Warp the tiles of one level into some rows."""
    step = GROUND_M_PER_PX * 2**level
    eye = fine.map_T_cam[:2, 3]
    corner_u = np.array([0, fine.width_px - 1, fine.width_px - 1, 0]) + np.array([-1, 1, 1, -1])
    corner_v = np.array([rows.start, rows.start, rows.stop, rows.stop]) + np.array([-1, -1, 1, 1])
    away = fine.ground_depth(corner_u, corner_v)[:, None]
    seen = (eye + fine.directions(corner_u, corner_v)[:, :2] * away) / (step * TILE_PX)
    low = np.floor(seen.min(0) - 0.02).astype(int)
    columns, rows_high = (np.floor(seen.max(0) + 0.02).astype(int) - low + 1).tolist()
    # Which of the tiles the convex outline of what is seen touches.
    fineness = 8
    mask = np.zeros((rows_high * fineness, columns * fineness), np.uint8)
    hull = cv2.convexHull(np.rint(((seen - low) * fineness - 0.5) * 16).astype(np.int32))
    cv2.fillConvexPoly(mask, hull, 1, cv2.LINE_8, 4)
    wider = np.asarray(cv2.dilate(mask, np.ones((3, 3), np.uint8)))
    touched = wider.reshape(rows_high, fineness, columns, fineness).any(axis=(1, 3))
    mosaic = ground.mosaic(level, (int(low[0]), int(low[1])), np.asarray(touched), (0, 0, 0))
    corner = low * TILE_PX * step + step / 2 - eye  # of the mosaic's first pixel, relative to the camera
    ground_H_mosaic = np.array([[step, 0, corner[0]], [0, step, corner[1]], [0, 0, 1]])
    shift = np.array([[1, 0, 0], [0, 1, -rows.start], [0, 0, 1.0]])
    homography = shift @ fine.image_H_plane(np.array([0, 0, -fine.map_T_cam[2, 3]]), *np.eye(3)[:2]) @ ground_H_mosaic
    size = (fine.width_px, rows.stop - rows.start)
    warped = cv2.warpPerspective(mosaic, homography, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(warped, np.uint8)


HEADLIGHT_COLOR: Color = (0.95, 0.95, 0.90)  # LED, 5000 K
STREET_COLOR: Color = (0.42, 0.72, 1.0)  # 2700 K
HEADLIGHT_POWER, HEADLIGHT_REACH_M = 1.1, 14.0
STREET_POWER, STREET_REACH_M = 0.9, 7.0
BEAM_HALF_WIDTH = 0.36  # tangent
CUTOFF_RISE, CUTOFF_SOFTNESS, ABOVE_CUTOFF = -0.01, 0.02, 0.12  # tangents of a low beam, and what is left above it
STREET_SPACING_M, STREET_HEIGHT_M = 30.0, 7.0
MAX_LAMPS, MAX_LAMP_DISTANCE_M = 14, 90.0
COARSENESS = 4  # of the grid on which the light of lamps on the static scene is computed
GLARE = 0.5


@dataclass(frozen=True, eq=False)
class Lamp:
    """A lamp at one time."""

    position_m: Array  # (3,), m
    forward: Array | None = None  # (2,): direction of a headlight; None for a street light, which shines downwards


def headlights(map_T_vehicle: Array, front_m: float, width_m: float) -> tuple[Lamp, ...]:
    """Lamps of a vehicle whose front is so far ahead of the origin of a pose on the ground."""
    R, origin = map_T_vehicle[:3, :3], map_T_vehicle[:3, 3]
    sides = (R @ np.array([front_m, side * 0.36 * width_m, 0.65]) for side in (-1, 1))
    return tuple(Lamp(origin + offset, R[:2, 0] / np.linalg.norm(R[:2, 0])) for offset in sides)


def street_lights(roads: Sequence[Road], around_m: Array) -> tuple[Lamp, ...]:
    """Lamps that hang over roads near a point (2,)."""
    lamps: list[Lamp] = []
    for road in roads:
        for a, b in pairwise(np.array(road.line)):
            length = float(np.linalg.norm(b - a))
            middle = float(np.dot(around_m - a, b - a)) / max(length, 1e-9)
            first = np.ceil((middle - MAX_LAMP_DISTANCE_M) / STREET_SPACING_M) * STREET_SPACING_M
            first = max(first, STREET_SPACING_M / 2)
            along = np.arange(first, min(length, middle + MAX_LAMP_DISTANCE_M), STREET_SPACING_M)
            lamps += [Lamp(np.append(a + (b - a) * s / length, STREET_HEIGHT_M)) for s in along]
    return tuple(lamps)


def nearest_lamps(view: RenderCamera, lamps: Sequence[Lamp]) -> tuple[Lamp, ...]:
    """Choose those that may light what a camera sees."""
    eye, axis = view.map_T_cam[:3, 3], view.map_T_cam[:3, 2]
    distance = {k: float(np.linalg.norm(lamp.position_m - eye)) for k, lamp in enumerate(lamps)}
    ahead = {k: float((lamp.position_m - eye) @ axis) for k, lamp in enumerate(lamps)}
    near = [k for k in distance if distance[k] < MAX_LAMP_DISTANCE_M and ahead[k] > -2 * STREET_REACH_M]
    return tuple(lamps[k] for k in sorted(near, key=lambda k: distance[k])[:MAX_LAMPS])


def lamplight(lamps: Sequence[Lamp], exposure: float, points: Image, normals: Image | None) -> Image:
    """Light (N, 3) on points (N, 3) in the map with normals (N, 3); None for surfaces that face all lamps."""
    out = np.zeros((len(points), 3), np.float32)
    for lamp in lamps:
        offset = points - lamp.position_m.astype(np.float32)
        square = np.einsum("ni,ni->n", offset, offset)
        reach = STREET_REACH_M if lamp.forward is None else HEADLIGHT_REACH_M
        power = STREET_POWER if lamp.forward is None else HEADLIGHT_POWER
        strength = np.float32(power * exposure) / (1 + square * np.float32(reach**-2))
        away = np.sqrt(np.maximum(square, np.float32(1e-6)))
        if lamp.forward is None:
            strength *= np.asarray(np.clip(-offset[:, 2] / away + 0.1, 0, 1), np.float32)
        else:  # a low beam: wide to the sides, cut off above the horizon
            fx, fy = lamp.forward.astype(np.float32)
            along = offset[:, 0] * fx + offset[:, 1] * fy
            aside = offset[:, 1] * fx - offset[:, 0] * fy
            ahead = np.maximum(along, np.float32(0.3))
            wide = np.exp(-((aside / ahead / np.float32(BEAM_HALF_WIDTH)) ** 2))
            rise = np.clip((CUTOFF_RISE - offset[:, 2] / ahead) / CUTOFF_SOFTNESS, -10, 10)
            low = ABOVE_CUTOFF + (1 - ABOVE_CUTOFF) / (1 + np.exp(-rise))
            strength *= np.where(along > 0.3, wide * low, 0).astype(np.float32)
        if normals is not None:
            toward = -np.einsum("ni,ni->n", offset, normals) / away
            strength *= np.clip(np.float32(0.15) + np.float32(0.85) * toward, 0, 1)
        for channel, value in enumerate(STREET_COLOR if lamp.forward is None else HEADLIGHT_COLOR):
            out[:, channel] += strength * np.float32(value)
    return out


def light_scenery(view: RenderCamera, lamps: Sequence[Lamp], light: Light, color: Image, depth: Image) -> None:
    """Add the light of lamps to a picture (H, W, 3) of the static scene, which the sky alone has lit so far."""
    if not lamps:
        return
    v = np.arange(COARSENESS // 2, view.height_px, COARSENESS)
    u = np.arange(COARSENESS // 2, view.width_px, COARSENESS)
    grid_u, grid_v = (x.ravel() for x in np.meshgrid(u, v))
    away = depth[grid_v, grid_u]
    points = view.directions(grid_u, grid_v) * away[:, None] + view.map_T_cam[:3, 3]
    added = lamplight(lamps, light.exposure, points.astype(np.float32), None)
    added[away >= FAR_M] = 0
    dry = np.add(light.sky_color, np.multiply(light.sun_color, light.sun[2])).astype(np.float32)
    factor = 1 + added / np.maximum(dry, np.float32(1e-4))
    whole = cv2.resize(factor.reshape(len(v), len(u), 3), depth.shape[::-1], interpolation=cv2.INTER_LINEAR)
    color *= np.where((depth < FAR_M)[..., None], whole, 1)


def glare(view: RenderCamera, lamps: Sequence[Lamp], light: Light, color: Image, depth: Image) -> None:
    """Draw the lamps themselves and let what is too bright shine over its surroundings, in place."""
    if light.lamps <= 0:
        return
    bright = np.zeros_like(color)
    for lamp in lamps:
        p = apply(inverse(view.map_T_cam), lamp.position_m[None])[0]
        if p[2] < 1.0:
            continue
        u, v = p[0] / p[2] * view.K[0, 0] + view.K[0, 2], p[1] / p[2] * view.K[1, 1] + view.K[1, 2]
        if not (0 <= u < view.width_px and 0 <= v < view.height_px) or depth[int(v), int(u)] < p[2] - 1.0:
            continue
        if lamp.forward is None:
            tint = tuple(0.6 * light.lamps * c for c in STREET_COLOR)
            radius = max(1, round(0.18 * view.K[0, 0] / p[2]))
        else:
            toward = float(np.dot(lamp.forward, (view.map_T_cam[:2, 3] - lamp.position_m[:2]) / p[2]))
            if toward < 0.2:
                continue
            tint = tuple(light.lamps * toward**2 * c for c in HEADLIGHT_COLOR)
            radius = max(1, round(0.09 * view.K[0, 0] / p[2]))
        passed = float(np.exp(-light.extinction_per_m * p[2]))
        cv2.circle(bright, (round(u), round(v)), radius, tuple(passed * c for c in tint), -1, cv2.LINE_AA)
    np.maximum(color, bright, out=color)
    small = cv2.resize(np.maximum(color - 0.9, 0), None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    if small.max() <= 0:
        return
    # Fog scatters light around a lamp more widely than a lens does.
    wide = 3.0 + 200 * light.extinction_per_m
    halo = 0.6 * cv2.GaussianBlur(small, (0, 0), 1.5) + 0.4 * cv2.GaussianBlur(small, (0, 0), wide)
    color += GLARE * cv2.resize(halo.astype(np.float32), depth.shape[::-1], interpolation=cv2.INTER_LINEAR)
