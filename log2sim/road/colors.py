"""Colors of vehicles from the pixels of their own surface, over the frames in which they are visible.

Notes
-----
Light on a surface changes how bright a color is, gloss adds the color of the sky (the dichromatic model of Shafer, 1985); in
CIELAB the first moves a color towards black at a constant hue, the second towards gray. So hues are compared by chroma
relative to lightness, a hue that a good part of the surface shares is the paint's, and what is gray is the paint only
where no hue is shared: tires, glass, chrome, and mirrored clouds are gray on cars of every color.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import COLOR_NAMES, AgentTable, Log, Scenario
from log2sim.datatypes.color_names import name_probabilities, to_rgb
from log2sim.geometry import (
    MIN_DEPTH_M,
    NS_PER_S,
    Array,
    Camera,
    inverse,
    line_time_s,
    project,
    undistort,
    weighted_quantile,
)
from log2sim.perception.lidar.projection import View, project_boxes_in_view, view_of
from log2sim.road.light import (
    MIRRORED_SIGMA,
    SHAPES,
    Light,
    Surface,
    estimate_light,
    hit_block,
    hit_vehicle,
    linear_values,
    mirrored_share,
    reflectances,
    veil_of,
)

# Linear sRGB to CIE XYZ relative to D65 white (IEC 61966-2-1).
XYZ_OF_RGB = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
WHITE_XYZ = XYZ_OF_RGB.sum(axis=1)
EPSILON, SLOPE = 216 / 24389, 24389 / 3132


def lab_of_linear(rgb: Array) -> Array:
    """Return CIELAB (N, 3) of linear RGB (N, 3), 1 for white; what is brighter has an L* above 100."""
    xyz = np.maximum(rgb @ XYZ_OF_RGB.T / WHITE_XYZ, 0.0)
    f = np.where(xyz > EPSILON, np.cbrt(xyz), xyz * SLOPE + 4 / 29)
    return np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1)


def linear_of_lab(lab: Array) -> Array:
    """Return linear RGB (N, 3) of CIELAB (N, 3)."""
    y = (lab[:, 0] + 16) / 116
    f = np.stack([y + lab[:, 1] / 500, y, y - lab[:, 2] / 200], axis=1)
    xyz = np.where(f**3 > EPSILON, f**3, (f - 4 / 29) / SLOPE) * WHITE_XYZ
    return np.asarray(xyz @ np.linalg.inv(XYZ_OF_RGB).T)


# Chroma as it would be at this lightness; darker pixels than the least are too noisy to be scaled up from.
REFERENCE_L, MIN_L, MAX_L = 55.0, 14.0, 115.0
# A pixel has a hue from this chroma at the reference: three sigmas of the color of the light (0.06 in the logarithm, see `light.py`).
MIN_CHROMA = 17.5
HUE_BINS, HUE_REACH_DEG = 72, 25.0
MIN_HUE_SHARE = 0.38
WHITEST_L = 94.0  # the whitest paints reflect 0.85
# Of the pixels of one hue those in bright, direct light mirror least of other things and are not clipped.
CHROMA_QUANTILE, LIGHTNESS_QUANTILE = 0.5, 0.6
LIGHTNESS_BANDWIDTH = 7.0
# Glass, tires, grilles and shade are dark on vehicles of every color, a third of what one sees; only where more is, it is the paint.
DARK_L, MIN_DARK_SHARE = 20.0, 0.45
DARKER_QUANTILE, LIGHT_L = 0.2, 60.0


@dataclass(frozen=True, eq=False)
class Paint:
    """Colors that a surface may have."""

    lab: Array  # (C, 3): CIELAB, the most probable first
    probability: Array  # (C,): they sum to 1

    @property
    def mean(self) -> Array:
        """Return the mean (3,) of the colors."""
        return np.asarray(self.probability @ self.lab)


def find_paint(lab: Array, weight: Array) -> Paint:
    """Find the color that most of a surface has from pixels (N, 3) in CIELAB with weights (N,), not all of them 0.

    Where it would reflect more light than the whitest paints, the light is brighter than was thought, and the color is scaled.
    """
    paint = _most_frequent(lab, weight)
    return Paint((paint * min(1.0, WHITEST_L / max(paint[0], 1.0)))[None], np.ones(1))


def _most_frequent(lab: Array, weight: Array) -> Array:
    weight = weight / weight.sum()
    L, chroma = np.clip(lab[:, 0], 0, MAX_L), np.hypot(lab[:, 1], lab[:, 2])
    relative = chroma * REFERENCE_L / np.maximum(L, MIN_L)
    hue = np.degrees(np.arctan2(lab[:, 2], lab[:, 1])) % 360
    colored = relative >= MIN_CHROMA
    votes = np.bincount((hue[colored] * HUE_BINS / 360).astype(int) % HUE_BINS, weight[colored], HUE_BINS)
    reach = round(HUE_REACH_DEG * HUE_BINS / 360)
    windows = np.sum([np.roll(votes, k) for k in range(-reach, reach + 1)], axis=0)
    best = int(np.argmax(windows))
    if windows[best] >= MIN_HUE_SHARE:
        center = (best + 0.5) * 360 / HUE_BINS
        rows = colored & (np.abs((hue - center + 180) % 360 - 180) <= HUE_REACH_DEG + 180 / HUE_BINS)
        return _colored_paint(lab[rows], relative[rows], weight[rows])
    rows = ~colored
    if not weight[rows].sum() > 0:
        rows = np.ones(len(lab), bool)
    light = rows & (L >= DARK_L)
    if weight[light].sum() > (1 - MIN_DARK_SHARE) * weight[rows].sum():
        rows = light
    level = _mode(L[rows], weight[rows])
    near = rows & (np.abs(L - level) <= LIGHTNESS_BANDWIDTH)
    tone = [weighted_quantile(lab[near, k], weight[near], 0.5) for k in (1, 2)]
    # The lower halves of doors mirror the dark road, which matters where the paint is dark itself.
    darker = weighted_quantile(L[rows], weight[rows], DARKER_QUANTILE)
    share = np.clip((level - DARK_L) / (LIGHT_L - DARK_L), 0.0, 1.0)
    return np.array([share * level + (1 - share) * min(darker, level), *tone])


def _colored_paint(lab: Array, relative: Array, weight: Array) -> Array:
    """Return the color of pixels of one hue."""
    level = weighted_quantile(lab[:, 0], weight, LIGHTNESS_QUANTILE)
    scale = level / np.maximum(lab[:, 0], MIN_L)
    strength = weighted_quantile(relative, weight, CHROMA_QUANTILE) * level / REFERENCE_L
    a, b = (weighted_quantile(lab[:, k] * scale, weight, 0.5) for k in (1, 2))
    return np.array([level, *(np.array([a, b]) / np.hypot(a, b) * strength)])


def _mode(values: Array, weight: Array) -> float:
    """Return the value around which weights are densest, by a triangular kernel."""
    steps = np.arange(0.0, MAX_L + 1)
    kernel = np.clip(1 - np.abs(steps[:, None] - values) / LIGHTNESS_BANDWIDTH, 0, None)
    level = steps[int(np.argmax(kernel @ weight))]
    near = np.abs(values - level) <= LIGHTNESS_BANDWIDTH
    return weighted_quantile(values[near], weight[near], 0.5)


# Half of the errors of light are common to all looks: the same road, the same camera.
ENOUGH_PIXELS = 150.0
MIN_SIGMA_LAB = np.array([3.0, 3.0, 2.0])
# Errors of a pixel's value: half of a step of 8 bits and the noise of a sensor, relative to full scale after the camera's curve.
PIXEL_NOISE = 4 / 255
# Lenses and interpolation mix a door of a small vehicle with what is around it, which differs from it by this reflectance.
MIXED, BLUR_PX, DOOR_HEIGHT = 0.15, 1.5, 0.3
ITERATIONS = 20


@dataclass(frozen=True, eq=False)
class Look:
    """What one picture says about a color."""

    lab: Array  # (3,): the most probable color
    sigma: Array  # (3,): standard deviations of its lightness, chroma, and across the chroma
    probability: Array  # (K,): of each of `COLOR_NAMES`
    weight: float

    @classmethod
    def of(cls, paint: Paint, light: Light, surface: Surface) -> Look:
        """Rate the paint of a surface by the light it was seen in."""
        sigma = np.array([_sigma_of(lab, light, surface) for lab in paint.lab])
        each = np.array([name_probabilities(lab, s) for lab, s in zip(paint.lab, sigma)])
        clear = float(surface.weight.sum() / (surface.weight.sum() + ENOUGH_PIXELS))
        # Haze and what is mirrored add light: of looks at dark paint the darkest, whose sigma is the least, is the best.
        return cls(paint.mean, paint.probability @ sigma, paint.probability @ each, clear / sigma[0, 0] ** 2)


def _sigma_of(lab: Array, light: Light, surface: Surface) -> Array:
    """Return the standard deviations (3,) of lightness, chroma, and across the chroma, of a color (3,)."""
    # L* + 16 and the differences of the cube roots grow with the cube root of light.
    root = (lab[0] + 16) / 116
    raw = float(np.median(surface.pixels.mean(axis=1))) ** (1 / 2.2)
    noise = PIXEL_NOISE / max(raw, PIXEL_NOISE)
    mirrored = float((mirrored_share(surface.facing)[:, None] * light.around / light.white).mean()) * MIRRORED_SIGMA
    mixed = MIXED * min(1.0, BLUR_PX / (DOOR_HEIGHT * surface.height_px))
    added = float(np.hypot(mirrored, mixed))
    lightness = 116 * (np.cbrt(root**3 + added) - np.cbrt(max(root**3 - added, 0.0))) / 2
    brightness = float(np.hypot(light.exposure_sigma, noise))
    tone = 500 / 3 * root * float(np.hypot(light.tone_sigma, noise))
    chroma = float(np.hypot(lab[1], lab[2])) * float(np.hypot(brightness / 3, added / (root**3 + added)))
    sigma = np.array([np.hypot(116 / 3 * root * brightness, lightness), np.hypot(tone, chroma), tone])
    return np.asarray(np.hypot(sigma, MIN_SIGMA_LAB))


def decide_color(looks: Sequence[Look]) -> dict[str, Any]:
    """Join looks and name the color, as `Agent.color` holds it."""
    lab, probability = decide_probabilities(looks)
    best = int(np.argmax(probability))
    return {
        "rgb": [int(v) for v in to_rgb(lab)[0]],
        "name": COLOR_NAMES[best],
        "confidence": round(float(probability[best]), 3),
        "lab": [round(float(v), 2) for v in lab],
        "frames": len(looks),
    }


def decide_probabilities(looks: Sequence[Look]) -> tuple[Array, Array]:
    """Join looks: the color (3,) in CIELAB and the probability (K,) of each of `COLOR_NAMES`.

    Notes
    -----
    Errors of the light are common to looks: more of them do not make the color surer, and looks that differ make it less sure.
    """
    if len(looks) == 1:
        return looks[0].lab, looks[0].probability
    weight = np.array([look.weight for look in looks])
    lab = np.array([look.lab for look in looks])
    middle = geometric_median(lab, weight)
    spread = np.average(np.linalg.norm(lab - middle, axis=1), weights=weight) / np.sqrt(len(looks))
    sigma = np.average([look.sigma for look in looks], axis=0, weights=weight)
    return middle, name_probabilities(middle, np.hypot(sigma, spread))


def geometric_median(points: Array, weight: Array) -> Array:
    """Return the point with the least weighted sum of distances to points (N, 3) (Weiszfeld 1937)."""
    middle = np.average(points, axis=0, weights=weight)
    for _ in range(ITERATIONS):
        distance = np.maximum(np.linalg.norm(points - middle, axis=1), 1e-6)
        middle = np.average(points, axis=0, weights=weight / distance)
    return np.asarray(middle)


# Pictures in turn differ little: light and direction change over meters, which takes about this long.
MIN_STEP_S = 0.5
MAX_VIEWS = 8  # of an agent; more do not change a median
MIN_HEIGHT_PX = 20.0  # doors are a third of the height: six lines of pixels


def choose_views(log: Log, scenario: Scenario, wanted: Sequence[str]) -> dict[str, dict[int, list[str]]]:
    """Choose frames in which to look at agents.

    `wanted`: ids of the agents.

    Returns dict of str to dict of int to list of str: by camera and index of the frame: ids of the agents to look at
    there.
    """
    agents = scenario.others
    rows = [k for k, agent in enumerate(agents) if agent.id in set(wanted)]
    scores: list[tuple[str, int, Array]] = []
    for name, camera in log.cameras.items():
        frames = _spaced(log.streams[name].t_ns) if name in log.streams else np.zeros(0, np.int64)
        t_ns = log.streams[name].t_ns[frames] if len(frames) else frames
        poses, known = log.map_T_sensor(name, t_ns) if len(frames) else (np.zeros((0, 4, 4)), np.zeros(0, bool))
        boxes = AgentTable.of(agents, (t_ns - scenario.t0_ns) / NS_PER_S, permanent=True)
        for k in np.flatnonzero(known):
            score = _clear_heights(camera, inverse(poses[k]), boxes.center_m[:, k], boxes.size_m)
            scores.append((name, int(frames[k]), score))
    return _best_views(scores, [(row, agents[row].id) for row in rows])


def _spaced(t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return indices of frames that are `MIN_STEP_S` apart or somewhat more."""
    if len(t_ns) == 0:
        return np.zeros(0, np.int64)
    slot = (t_ns - t_ns[0]) // round(MIN_STEP_S * NS_PER_S)
    return np.unique(slot, return_index=True)[1].astype(np.int64)


def _clear_heights(camera: Camera, cam_T_map: Array, center: Array, size: Array) -> Array:
    """Return the heights (A,), px, of agents in a picture, times the share of their widths that nothing nearer hides; 0 outside."""
    points = center @ cam_T_map[:3, :3].T + cam_T_map[:3, 3]
    with np.errstate(invalid="ignore"):
        ahead = points[:, 2] > MIN_DEPTH_M
    uv = np.full((len(points), 2), np.nan)
    uv[ahead] = project(camera, points[ahead])[0]
    out = np.zeros(len(points))
    with np.errstate(invalid="ignore"):
        inside = (uv > 0).all(axis=1) & (uv[:, 0] < camera.width_px) & (uv[:, 1] < camera.height_px)
    depth = points[:, 2]
    rows = np.flatnonzero(inside)
    half = camera.K[0, 0] * (size[rows, 0] + size[rows, 1]) / 4 / depth[rows]
    left, right = uv[rows, 0] - half, uv[rows, 0] + half
    for k, row in enumerate(rows):
        hidden = 0.0
        nearer = (depth[rows] < depth[row]) & (left < right[k]) & (right > left[k])
        for j in np.flatnonzero(nearer):
            hidden = max(hidden, (min(right[k], right[j]) - max(left[k], left[j])) / (right[k] - left[k]))
        out[row] = camera.K[1, 1] * size[row, 2] / depth[row] * (1 - hidden)
    return out


def _best_views(scores: list[tuple[str, int, Array]], wanted: list[tuple[int, str]]) -> dict[str, dict[int, list[str]]]:
    table = np.array([score for _, _, score in scores]).reshape(len(scores), -1)
    views: dict[str, dict[int, list[str]]] = {}
    for row, agent in wanted:
        order = np.argsort(-table[:, row], kind="stable")[:MAX_VIEWS] if len(table) else np.zeros(0, np.intp)
        for k in order.tolist():
            if table[k, row] >= MIN_HEIGHT_PX:
                name, index, _ = scores[k]
                views.setdefault(name, {}).setdefault(index, []).append(agent)
    return views


Image = NDArray[np.uint8]

MAX_SAMPLES = 48  # rays along each side of a vehicle's rectangle
SCENE_SAMPLES = 64  # along the longer side of the picture
MIN_PAINT_PIXELS = 12
MAX_GRAY_DIFFERENCE = 4  # between channels of a picture without color, by the errors of JPEG
# The road from here to there around a vehicle lies in the same light, outside of the shade under it.
GROUND_FROM_M, GROUND_TO_M, GROUND_STEPS = 0.7, 2.5, 4
GROUND_PER_SIDE = 12
# Angles from inverse cosines near 1 are off by less than this.
ROUNDING_RAD = 1e-6


class ColorSampler:
    """Looks at the vehicles of a scenario in chosen pictures and names their colors.

    A consumer of `log2sim.perception.frames.give_pictures`.

    `gray`: cameras whose pictures have no color.
    """

    def __init__(self, log: Log, scenario: Scenario) -> None:
        self._log, self._scenario = log, scenario
        self._vehicles = [a.id for a in scenario.others if a.category in SHAPES]
        self._views = choose_views(log, scenario, self._vehicles)
        self._boxes: dict[str, AgentTable] = {}
        self._looks: dict[str, list[Look]] = {}
        self.gray: set[str] = set()

    def frames(self) -> Mapping[str, NDArray[np.int64]]:
        """Return the indices of the frames that it wants, by camera."""
        return {name: np.array(sorted(frames), np.int64) for name, frames in self._views.items()}

    def add(self, camera: str, index: int, image_bgr: Image) -> None:
        """Look at the vehicles for which a frame was chosen."""
        stride = max(1, max(image_bgr.shape[:2]) // SCENE_SAMPLES)
        grid = image_bgr[stride // 2 :: stride, stride // 2 :: stride, ::-1]
        halves = [half.reshape(-1, 3) for half in np.array_split(grid, 2)]
        if np.ptp(grid.astype(np.int16), axis=-1).max(initial=0) <= MAX_GRAY_DIFFERENCE:
            self.gray.add(camera)
            return
        t_ns = int(self._log.streams[camera].t_ns[index])
        view = view_of(self._log, camera, t_ns)
        if view is None:
            return
        agents = self._views.get(camera, {}).get(index, ())
        if not agents:
            return
        boxes = self._boxes_in(camera)
        place = int(np.searchsorted(self.frames()[camera], index))
        scene = _Scene(view, boxes, place, image_bgr, *halves)
        for agent in agents:
            row = next(k for k, other in enumerate(boxes.agents) if other.id == agent)
            look = scene.observe_agent(row)
            if look is not None:
                self._looks.setdefault(agent, []).append(look)

    def _boxes_in(self, camera: str) -> AgentTable:
        """Return the boxes of all agents in the frames that it wants of a camera, made for all of them at once."""
        if camera not in self._boxes:
            t_ns = self._log.streams[camera].t_ns[self.frames()[camera]]
            t_s = (t_ns - self._scenario.t0_ns) / NS_PER_S
            self._boxes[camera] = AgentTable.of(self._scenario.others, t_s, permanent=True)
        return self._boxes[camera]

    def colors(self) -> dict[str, dict[str, Any]]:
        """Return the color of each vehicle that was seen, by id, as `Agent.color` holds it."""
        return {agent: decide_color(looks) for agent, looks in self._looks.items()}

    def notes(self) -> tuple[str, ...]:
        """Say which vehicles have no color, and why."""
        missing = [agent for agent in self._vehicles if agent not in self._looks]
        if not missing:
            return ()
        reason = "no picture shows enough of them"
        if self.gray:
            reason += f"; pictures of {', '.join(sorted(self.gray))} are gray"
        return (f"no color of {len(missing)} of {len(self._vehicles)} vehicles: {reason}",)


@dataclass(frozen=True, eq=False)
class _Scene:
    """A picture with the boxes of all agents at the times of several, of which it is the one at `place`."""

    view: View
    boxes: AgentTable
    place: int
    image: Image
    above: Image
    below: Image

    @property
    def _center_m(self) -> Array:
        return self.boxes.center_m[:, self.place]

    @cached_property
    def _linear_above(self) -> Array:
        return linear_values(self.above)

    @cached_property
    def _linear_below(self) -> Array:
        return linear_values(self.below)

    def observe_agent(self, row: int) -> Look | None:
        """Look at an agent; None where too little of its paint is seen."""
        center, yaw, size = self._center_m[row], self.boxes.yaw_rad[row, self.place], self.boxes.size_m[row]
        if not np.isfinite(center).all():
            return None
        found = project_boxes_in_view(self.view, center[None], size[None], yaw[None])
        if not found.valid[0]:
            return None
        map_T_cam = self._pose((found.box_px[:, :2] + found.box_px[:, 2:]) / 2)
        uv, rays = self._rays(map_T_cam, found.box_px[0])
        origin, turned = _to_box(map_T_cam[:3, 3], rays, center, yaw)
        hits = hit_vehicle(self.boxes.agents[row].category, size, origin, turned)
        clear = np.isfinite(hits.distance)
        distance = hits.distance[clear]
        clear[clear] = distance < self._others(map_T_cam[:3, 3], rays[clear], distance, but=row)
        weight = np.where(clear, hits.weight, 0.0)
        rows = np.flatnonzero(weight)
        if len(rows) < MIN_PAINT_PIXELS:
            return None
        height_px = float(found.box_px[0, 3] - found.box_px[0, 1])
        surface = Surface(self._pixels(uv[rows]), weight[rows], hits.facing[rows], height_px)
        light = estimate_light(self._linear_below, self._linear_above, self._road(row, map_T_cam))
        veil = veil_of(self._pixels(uv[clear]), light)
        paint = find_paint(lab_of_linear(reflectances(surface.pixels, light, surface.facing, veil)), surface.weight)
        return Look.of(paint, light, surface)

    def _pose(self, uv: Array) -> Array:
        """Return the pose of the camera when the line of a pixel (1, 2) was exposed."""
        if self.view.cam_T_map_at is None:
            return self.view.map_T_cam
        return np.asarray(inverse(self.view.cam_T_map_at(line_time_s(self.view.camera, uv))[0]))

    def _rays(self, map_T_cam: Array, box_px: Array) -> tuple[Array, Array]:
        """Return pixels (N, 2) spread over a rectangle and their rays (N, 3), map frame."""
        (u0, v0, u1, v1), steps = box_px, np.clip(box_px[2:] - box_px[:2], 2, MAX_SAMPLES).astype(int)
        u = np.floor(u0 + (np.arange(steps[0]) + 0.5) * (u1 - u0) / steps[0])
        v = np.floor(v0 + (np.arange(steps[1]) + 0.5) * (v1 - v0) / steps[1])
        uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        xy = undistort(self.view.camera, uv + 0.5)
        rays = np.column_stack([xy, np.ones(len(xy))]) @ map_T_cam[:3, :3].T
        seen = np.isfinite(rays).all(axis=1)
        return uv[seen], rays[seen]

    def _others(self, origin: Array, rays: Array, within: Array, but: int | None = None) -> Array:
        """Return the distances (N,), in lengths of the rays, at which rays meet an agent other than one.

        What they meet farther away than all of `within` (N,) may be left out.
        """
        nearest = np.full(len(rays), np.inf)
        for k in self._near(origin, rays, within):
            if k != but:
                half = self.boxes.size_m[k] / 2
                start, turned = _to_box(origin, rays, self._center_m[k], self.boxes.yaw_rad[k, self.place])
                np.minimum(nearest, hit_block(-half, half, start, turned)[0], out=nearest)
        return nearest

    def _near(self, origin: Array, rays: Array, within: Array) -> list[int]:
        """Return the rows of agents that rays (N, 3) may meet: those whose spheres reach into the cone around the rays."""
        if not len(rays):
            return []
        length = np.linalg.norm(rays, axis=1)
        directions = rays / length[:, None]
        axis = directions.mean(axis=0)
        axis /= np.linalg.norm(axis)
        cone = np.arccos(np.clip((directions @ axis).min(), -1, 1))
        toward = self._center_m - origin
        away = np.linalg.norm(toward, axis=1)
        reach = np.linalg.norm(self.boxes.size_m, axis=1) / 2
        with np.errstate(invalid="ignore", divide="ignore"):
            angle = np.arccos(np.clip(toward @ axis / away, -1, 1))
            sphere = np.where(away > reach, np.arcsin(np.clip(reach / away, -1, 1)), np.pi)
            near = (away - reach < (within * length).max()) & (angle <= cone + sphere + ROUNDING_RAD)
        return [int(k) for k in np.flatnonzero(near)]

    def _road(self, row: int, map_T_cam: Array) -> Array:
        """Return pixels (G, 3), linear RGB, of the road around an agent, where no agent hides it."""
        center, yaw, size = self._center_m[row], self.boxes.yaw_rad[row, self.place], self.boxes.size_m[row]
        points = center + _turned(_ring(size), yaw)
        cam_T_map = inverse(map_T_cam)
        uv, inside = project(self.view.camera, points @ cam_T_map[:3, :3].T + cam_T_map[:3, 3])
        points, uv = points[inside], uv[inside]
        if not len(points):
            return np.zeros((0, 3))
        rays = points - map_T_cam[:3, 3]
        hidden = self._others(map_T_cam[:3, 3], rays, np.ones(len(rays))) < 1
        return self._pixels(np.floor(uv[~hidden]))

    def _pixels(self, uv: Array) -> Array:
        """Return linear RGB (N, 3) of pixels (N, 2)."""
        height, width = self.image.shape[:2]
        u, v = np.clip(uv[:, 0], 0, width - 1).astype(int), np.clip(uv[:, 1], 0, height - 1).astype(int)
        return linear_values(self.image[v, u, ::-1])


def _ring(size: Array) -> Array:
    """Return points (G, 3) on the ground around a box, in its frame."""
    along = np.linspace(-1, 1, GROUND_PER_SIDE)
    one = np.ones(GROUND_PER_SIDE)
    square = np.concatenate([np.c_[along, one], np.c_[along, -one], np.c_[one, along], np.c_[-one, along]])
    out = [square * (size[:2] / 2 + away) for away in np.linspace(GROUND_FROM_M, GROUND_TO_M, GROUND_STEPS)]
    flat = np.concatenate(out)
    return np.column_stack([flat, np.full(len(flat), -size[2] / 2)])


def _turned(points: Array, yaw: float) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.column_stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1], points[:, 2]])


def _to_box(origin: Array, rays: Array, center: Array, yaw: float) -> tuple[Array, Array]:
    """Return the origin (3,) and directions (N, 3) of rays in the frame of a box."""
    return _turned((origin - center)[None], -yaw)[0], _turned(rays, -yaw)
