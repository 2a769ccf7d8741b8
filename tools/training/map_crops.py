"""Crops of maps and pictures of random roads with what is painted in each cell, disturbed as real ones are."""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from fits.line_maps import EVERYWHERE, RoadMap, draw_scene
from numpy.typing import NDArray

from log2sim import open_log
from log2sim.datatypes import MapFeatures, Scenario
from log2sim.geometry import Array, apply, inverse, runs_of
from log2sim.road.lane_picture import lay_out
from log2sim.road.paint_network import CELL_M, FINE_M, KINDS, inputs_of
from log2sim.synth.scene import Scene
from log2sim.synth.synthesis import write_synthetic

FINE_CELLS = 512  # of a crop, 25.6 m
PICTURES_OF_SEED = 900_000  # seeds of roads that no map shows
PER_MAP, PER_PICTURE, PER_PLAIN = 6, 3, 6  # crops
NEAR_MARKING, NEAR_M, TRIALS = 0.7, 7.0, 40  # share of the crops around a marking or border, and how far from it
LINE_CELLS, BORDER_CELLS, SUBPIXEL_BITS = 3, 3, 4  # least widths that are drawn
OFF_ROAD_CELLS = 25  # from all markings and borders
MORE_LINES, FREE_CELLS = 0.5, 4  # share of the crops that get one more line, and how far from other markings it is


@dataclass(frozen=True, eq=False)
class Crop:
    """Input of the network and what it should answer; H x W cells."""

    values: NDArray[np.float16]  # (12, H, W)
    kind: NDArray[np.uint8]  # (H, W): 0 for no marking, else 1 + its place in `KINDS`
    border: NDArray[np.uint8]  # (H, W): 1 along borders of roads
    line: NDArray[np.float16]  # (3, H, W): of lines, cosine and sine of twice the direction, and width in m


@dataclass(frozen=True, eq=False)
class _Layers:
    """Layers (2 H, 2 W) of a crop, which the disturbances change."""

    log_color: NDArray[np.float32]  # (2 H, 2 W, 3)
    alpha: NDArray[np.uint8]
    intensity: NDArray[np.float32]
    height_m: NDArray[np.float32]


def picture_map(seed: int) -> RoadMap:
    """Lay out flat what one picture of a random road shows, in the frame of the ground below the camera."""
    rng = np.random.default_rng([seed, 5])
    scene = draw_scene(PICTURES_OF_SEED + seed).model_dump(exclude_defaults=True)
    scene["lidar"], scene["camera"] = [], [{
        "name": "front", "position_m": [1.5, 0.0, rng.uniform(1.2, 2.0)], "yaw_deg": rng.uniform(-4, 4), "pitch_deg": rng.uniform(-7, -1),
        "fov_deg": rng.uniform(45, 90), "size_px": [1280, 720] if rng.random() < 0.5 else [960, 540], "offset_s": 0.05,
    }]  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        # A few frames; the first are as good as any.
        write_synthetic(
            Scene.model_validate(scene).model_copy(update={"duration_s": 0.4}), Path(folder) / "log", seed=seed
        )
        log, truth = open_log(Path(folder) / "log"), Scenario.load(Path(folder) / "log" / "truth.json")
        camera, stream = log.cameras["front"], log.streams["front"]
        middle = len(stream.t_ns) // 2
        ground = lay_out(stream.read(middle), camera)
        pose = log.map_T_sensor("front", stream.t_ns[middle : middle + 1])[0][0]
        ground_T_map = camera.mount_T_cam @ inverse(pose)
        there = truth.map_features or MapFeatures()
        moved = (
            tuple(replace(one, points_m=apply(ground_T_map, one.points_m)) for one in each)
            for each in (there.markings, there.borders)
        )
        return RoadMap(ground, MapFeatures(*moved), EVERYWHERE)


def iterate_crops(paths: list[Path], seed: int) -> Iterator[Crop]:
    """Yield disturbed crops of maps and pictures, again and again, in another order each time."""
    rng = np.random.default_rng(seed)
    while True:
        for path in rng.permutation(np.array(paths, dtype=object)):
            road, picture = pickle.loads(path.read_bytes()), "picture" in path.name
            for _ in range(PER_PICTURE if picture else PER_PLAIN if "plain" in path.name else PER_MAP):
                crop = draw_crop(road, rng, picture=picture)
                if crop is not None:
                    yield crop


def draw_crop(road: RoadMap, rng: np.random.Generator, *, picture: bool = False) -> Crop | None:
    """Draw a crop at any angle, mirrored or not; None where no place is found that a sensor saw.

    `picture`: lengths and widths err, as where the camera is estimated from the picture.
    """
    ground, center = road.ground, _draw_place(road, rng)
    if center is None:
        return None
    angle, flip = rng.uniform(0, 2 * np.pi), 1 if rng.random() < 0.5 else -1
    c, s, wide = np.cos(angle), np.sin(angle), 1.0
    fine_A_crop = np.array([[c * flip, -s], [s * flip, c]])  # columns and rows of the map for those of the crop
    if picture:
        wide, long = np.exp(rng.normal(0, 0.12)), np.exp(rng.normal(0, 0.25))
        fine_A_crop = np.diag([1 / (wide * long), 1 / wide]) @ fine_A_crop
    row, column = ground.raster.cells_of(center[None])
    middle = np.full(2, (FINE_CELLS - 1) / 2)
    matrix = np.column_stack([fine_A_crop, np.array([column[0], row[0]]) - fine_A_crop @ middle])
    nearest, between = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP, cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    layers = [
        cv2.warpAffine(layer, matrix, (FINE_CELLS, FINE_CELLS), flags=how, borderValue=outside)
        for layer, how, outside in (
            (ground.color_bgr, between, (0, 0, 0)), (ground.alpha, nearest, 0), (ground.intensity, nearest, np.nan), (ground.height_m, nearest, np.nan),
        )
    ]  # fmt: skip
    color, alpha, intensity, height = layers
    # Cells at the edge of what was seen are mixed with black.
    alpha[cv2.erode((alpha > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) == 0] = 0

    def to_crop(points_m: Array) -> Array:
        """Columns and rows (N, 2) of points in the coarse cells of the crop."""
        fine = np.stack(ground.raster.cells_of(points_m[:, :2])[::-1], axis=1)
        return np.asarray(((fine - matrix[:, 2]) @ np.linalg.inv(fine_A_crop).T - 0.5) / 2)

    kind, border, line = _draw_labels(road, to_crop, wide)
    off_road = cv2.distanceTransform(((kind == 0) & (border == 0)).astype(np.uint8), cv2.DIST_L2, 3) > OFF_ROAD_CELLS
    off_road, curb = (
        np.kron(mask.astype(np.uint8), np.ones((2, 2), np.uint8)) for mask in (off_road, (border > 0) & (kind == 0))
    )
    curb = cv2.erode(curb, np.ones((int(rng.integers(1, 5)),) * 2, np.uint8))
    layers = _Layers(np.log(color.astype(np.float32) + 4), alpha, intensity, height)
    lanes = [m.points_m for m in road.true.markings if m.is_lane_line] + [edge.points_m for edge in road.true.borders]
    if rng.random() < MORE_LINES:
        # Beside those of the road, or anywhere on plain ground, as on wide squares that show no border.
        course = to_crop(lanes[rng.integers(len(lanes))]) if lanes else _draw_course(rng)
        where = (off_road > 0) & bool(lanes)
        for _ in range(1 if lanes else int(rng.integers(1, 5))):
            layers = _paint_line(layers, course, kind, line, where, rng)
    disturbed = _disturb(layers, off_road > 0, curb > 0, rng)
    color = np.clip(np.exp(disturbed.log_color) - 4, 0, 255).astype(np.uint8)
    values = inputs_of(color, disturbed.alpha, disturbed.intensity, disturbed.height_m)
    return Crop(values.astype(np.float16), kind, border, line.astype(np.float16))


def _draw_place(road: RoadMap, rng: np.random.Generator) -> Array | None:
    """Draw a point (2,), m, that a sensor saw, most often near a marking or border."""
    ground = road.ground
    lines = [one.points_m[:, :2] for one in (*road.true.markings, *road.true.borders)]
    x0, x1, y0, y1 = ground.extent_m
    for _ in range(TRIALS):
        xy = rng.uniform((x0, y0), (x1, y1))
        if lines and rng.random() < NEAR_MARKING:
            line = lines[rng.integers(len(lines))]
            k, share = rng.integers(len(line) - 1), rng.random()
            xy = line[k] * (1 - share) + line[k + 1] * share + rng.uniform(-NEAR_M, NEAR_M, 2)
        (cell,), (inside,) = ground.raster.index_of(xy[None])
        if inside and (ground.alpha.flat[cell] > 0 or np.isfinite(ground.intensity.flat[cell])):
            return np.asarray(xy)
    return None


def _draw_labels(
    road: RoadMap, to_crop: Callable[[Array], Array], wide: float
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float32]]:
    """Draw kinds, borders, and direction and width of lines in the cells of a crop; `wide`: factor of widths."""
    side = FINE_CELLS // 2
    kind, border, line = (
        np.zeros((side, side), np.uint8),
        np.zeros((side, side), np.uint8),
        np.zeros((3, side, side), np.float32),
    )
    areas = [m for m in road.true.markings if m.kind in ("crosswalk", "other")]
    for marking in areas:
        outline = np.rint(to_crop(marking.points_m) * (1 << SUBPIXEL_BITS)).astype(np.int32)
        cv2.fillPoly(kind, [outline], 1 + KINDS.index(marking.kind), cv2.LINE_8, SUBPIXEL_BITS)
    for marking in (m for m in road.true.markings if m.kind not in ("crosswalk", "other")):
        _draw_line(kind, line, to_crop(marking.points_m), 1 + KINDS.index(marking.kind), marking.width_m * wide)
    for edge in road.true.borders:
        _draw(border, to_crop(edge.points_m), 1, BORDER_CELLS)
    return kind, border, line


def _draw(image: NDArray[Any], points: Array, value: float, width: int) -> None:
    """Draw a polyline (N, 2) of a width in cells."""
    corners = np.rint(points * (1 << SUBPIXEL_BITS)).astype(np.int32)
    cv2.polylines(image, [corners], False, value, width, cv2.LINE_8, SUBPIXEL_BITS)


def _draw_line(kind: NDArray[np.uint8], line: NDArray[np.float32], points: Array, value: int, width_m: float) -> None:
    """Draw the kind of a line (N, 2), its direction and its width."""
    width = max(LINE_CELLS, round(width_m / CELL_M) | 1)
    _draw(kind, points, value, width)
    for begin, end in pairwise(points):
        twice = 2 * np.arctan2(end[1] - begin[1], end[0] - begin[0])
        for layer, of_line in zip(line, (np.cos(twice), np.sin(twice), width_m)):
            _draw(layer, np.stack([begin, end]), float(of_line), width)


def _draw_course(rng: np.random.Generator) -> Array:
    """Draw an arc (N, 2) through a crop, in coarse cells."""
    along = np.linspace(-FINE_CELLS, FINE_CELLS, 60)
    across = rng.normal(0, 1e-3) * along**2 / 2
    angle = rng.uniform(0, np.pi)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return np.asarray(rng.uniform(0.2, 0.8, 2) * FINE_CELLS / 2 + np.stack([along, across], axis=1) @ turn)


def _paint_line(
    layers: _Layers,
    course: Array,
    kind: NDArray[np.uint8],
    line: NDArray[np.float32],
    off_road: NDArray[np.bool_],
    rng: np.random.Generator,
) -> _Layers:
    """Paint one more line beside a course (N, 2), in coarse cells: solid, of dashes of any length and width, or of dots.

    Labels are drawn into `kind` and `line`, where there is no marking yet.
    """
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(course, axis=0), axis=1))])
    dense = np.stack([np.interp(np.arange(0, s[-1], 2.0), s, course[:, k]) for k in range(2)], axis=1)
    if len(dense) < 4:
        return layers
    step = np.gradient(dense, axis=0)
    normal = step[:, ::-1] * [-1, 1] / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)
    dense = dense + normal * rng.choice([-1, 1]) * rng.uniform(0.8, 4.0) / CELL_M
    width_m, way = rng.uniform(0.1, 0.5), rng.integers(4)  # solid, dashes twice, dots
    dash_m, gap_m = [
        (np.inf, 0.0),
        *[(rng.uniform(0.4, 6), rng.uniform(0.4, 9))] * 2,
        (rng.uniform(0.1, 0.25), rng.uniform(0.5, 1.5)),
    ][way]
    along_m = np.arange(len(dense)) * 2 * CELL_M + rng.uniform(0, 10)
    free = cv2.distanceTransform((kind == 0).astype(np.uint8), cv2.DIST_L2, 3) > FREE_CELLS
    fine_free = cv2.resize(free.astype(np.uint8), layers.alpha.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    paint = np.zeros(layers.alpha.shape, np.uint8)
    # Finer than the cells, so that dots and short dashes keep their lengths.
    fine = np.arange(0, along_m[-1] - along_m[0], 0.05)
    fine_xy = np.stack([np.interp(fine, along_m - along_m[0], dense[:, k]) for k in range(2)], axis=1) * 2 + 0.5
    on = np.isinf(dash_m) | ((fine + along_m[0]) % (dash_m + gap_m) < dash_m)
    for begin, end in runs_of(on):
        _draw(paint, fine_xy[begin:end], 255, max(1, round(width_m / FINE_M)))
    share = cv2.GaussianBlur(paint.astype(np.float32) / 255, (0, 0), rng.uniform(0.3, 1.2)) * (fine_free & ~off_road)
    color = layers.log_color + share[..., None] * np.float32(rng.uniform(0.15, 0.9))
    intensity = layers.intensity * (1 + share * np.float32(np.exp(rng.uniform(0.2, 1.4)) - 1))
    new_kind, new_line = np.zeros_like(kind), np.zeros_like(line)
    _draw_line(new_kind, new_line, dense, 1 + KINDS.index("solid" if way == 0 else "dashed"), width_m)
    there = (new_kind > 0) & free & ~off_road[::2, ::2]
    kind[there], line[:, there] = new_kind[there], new_line[:, there]
    return _Layers(color, layers.alpha, intensity, layers.height_m)


def _disturb(
    layers: _Layers, off_road: NDArray[np.bool_], curb: NDArray[np.bool_], rng: np.random.Generator
) -> _Layers:
    """Disturb a crop by what maps of recorded logs show: exposures, patches, cracks, grain, blur, bright curbs, holes, other LiDARs, roughness."""
    color, alpha, intensity, height = layers.log_color, layers.alpha, layers.intensity, layers.height_m
    by_camera, by_lidar, shape = bool(alpha.any()), bool(np.isfinite(intensity).any()), alpha.shape

    def chance(share: float) -> bool:
        return bool(rng.random() < share)

    if by_camera:
        color = color + np.float32(rng.uniform(-0.7, 0.5)) + rng.normal(0, 0.06, 3).astype(np.float32)
        color = (color - color.mean()) * np.float32(np.exp(rng.normal(0, 0.25))) + color.mean()
        for _ in range(int(rng.integers(1, 3)) if chance(0.4) else 0):  # pictures of two exposures meet
            color[_half_plane(shape, rng)] += np.float32(rng.normal(0, 0.15))
        if chance(0.3):
            color[_blobs(shape, rng.uniform(30, 120), rng.uniform(0.05, 0.4), rng)] += np.float32(rng.normal(0, 0.15))
        for _ in range(int(rng.integers(1, 5)) if chance(0.35) else 0):  # cracks and joints
            color[_strokes(shape, 1, 3, 40.0, 0.15, rng)] -= np.float32(rng.uniform(0.1, 0.7))
        if chance(0.25):
            color[curb] += np.float32(rng.uniform(-0.3, 0.6))
        if chance(0.2):
            color[_strokes(shape, 8, 6, rng.uniform(5, 50), 0.4, rng) & off_road] += np.float32(rng.uniform(-0.5, 0.9))
        if chance(0.2):
            color += _light(shape, rng)[..., None]
        if chance(0.4):
            grain = cv2.GaussianBlur(rng.normal(size=shape).astype(np.float32), (0, 0), rng.uniform(0.5, 2.5))
            color += (grain * np.float32(rng.uniform(0.02, 0.15)) / grain.std())[..., None]
        if chance(0.35):
            color = cv2.GaussianBlur(color, (0, 0), rng.uniform(0.5, 2.5))
        elif chance(0.25):  # along the view, as far from the camera
            color = cv2.filter2D(color, -1, _stroke_kernel(int(rng.integers(3, 40)), rng))
        color = color + rng.normal(0, rng.uniform(0, 0.05), color.shape).astype(np.float32)
        if chance(0.3):
            alpha = np.where(_blobs(shape, rng.uniform(20, 100), rng.uniform(0.03, 0.4), rng), 0, alpha).astype(
                np.uint8
            )
    if by_lidar:
        # Other LiDARs compress strong returns or not; 0.2 is what roads return.
        intensity = (
            0.2
            * (np.maximum(intensity, 1e-4) / 0.2) ** np.float32(np.exp(rng.normal(0, 0.3)))
            * np.float32(np.exp(rng.normal(0, 0.25)))
        )
        if chance(0.25):
            intensity = np.where(curb, intensity * np.float32(np.exp(rng.uniform(-0.3, 1))), intensity)
        if chance(0.4):
            strokes = _strokes(shape, 8, 6, rng.uniform(5, 50), 0.4, rng) & off_road
            intensity = np.where(strokes, intensity * np.float32(np.exp(rng.uniform(0.2, 1.5))), intensity)
            rough = cv2.resize(rng.normal(size=(shape[0] // 8, shape[1] // 8)).astype(np.float32), shape[::-1])
            rough *= (_blobs(shape, 100, rng.uniform(0.2, 0.9), rng) & off_road) * np.float32(rng.uniform(0.02, 0.25))
            height = height + rough
        intensity = np.clip(intensity, 0, 1)
        if chance(0.5):
            intensity = intensity * np.exp(rng.normal(0, rng.uniform(0, 0.3), shape)).astype(np.float32)
        if chance(0.3):
            intensity = np.where(rng.random(shape) < rng.uniform(0.1, 0.8), intensity, np.nan)
        if chance(0.3):
            intensity = np.where(_blobs(shape, rng.uniform(20, 100), rng.uniform(0.05, 0.5), rng), np.nan, intensity)
        if by_camera and chance(0.4):  # a mount that errs by up to 0.15 m
            intensity = np.roll(intensity, rng.integers(-3, 4, 2), (0, 1))
        height = height + rng.normal(0, rng.uniform(0, 0.02), shape).astype(np.float32)
    if by_camera and by_lidar and chance(0.2):
        if chance(0.5):
            intensity = np.full_like(intensity, np.nan)
        else:
            alpha = np.zeros_like(alpha)
    if chance(0.15):
        height = np.full_like(height, np.nan)
    return _Layers(color, alpha, intensity.astype(np.float32), height.astype(np.float32))


def _half_plane(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.bool_]:
    """Draw a mask of one side of a line."""
    rows, columns = np.indices(shape)
    angle = rng.uniform(0, 2 * np.pi)
    away = (columns - shape[1] / 2) * np.cos(angle) + (rows - shape[0] / 2) * np.sin(angle)
    return np.asarray(away > rng.uniform(-0.5, 0.5) * shape[0])


def _blobs(shape: tuple[int, ...], cells: float, share: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Draw a mask of round patches of about so many cells, which covers a share of all."""
    size = [max(2, int(n / cells)) for n in shape]
    noise = cv2.resize(rng.normal(size=size).astype(np.float32), shape[::-1], interpolation=cv2.INTER_CUBIC)
    return np.asarray(noise > np.quantile(noise[::8, ::8], 1 - share))


def _strokes(
    shape: tuple[int, ...], most: int, width: int, step: float, wander: float, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Draw a mask of up to `most` winding strokes, up to `width` cells wide, of steps that wander by a share of their length: crooked, as no line is."""
    mask = np.zeros(shape, np.uint8)
    for _ in range(int(rng.integers(1, most + 1))):
        angle = rng.uniform(0, np.pi)
        steps = rng.normal(0, wander * step, (10, 2)) + step * np.array([np.cos(angle), np.sin(angle)])
        points = rng.uniform(0, shape[0], 2) + np.cumsum(steps, axis=0)
        cv2.polylines(mask, [np.rint(points).astype(np.int32)], False, 1, int(rng.integers(1, width + 1)))
    return mask > 0


def _light(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.float32]:
    """Draw what light does, as logarithms (H, W): sun through a fence, lamps at night, or glare on a wet road."""
    rows, columns = np.indices(shape).astype(np.float32)
    angle = rng.uniform(0, np.pi)
    across = (columns - rng.uniform(0, shape[1])) * np.cos(angle) + (rows - rng.uniform(0, shape[0])) * np.sin(angle)
    along = (rows - rng.uniform(0, shape[0])) * np.cos(angle) - (columns - rng.uniform(0, shape[1])) * np.sin(angle)
    way = rng.integers(3)
    if way == 0:
        bars = (across % rng.uniform(6, 20) < rng.uniform(2, 8)).astype(np.float32)
        return np.asarray(-rng.uniform(0.2, 0.8) * cv2.GaussianBlur(bars, (0, 0), rng.uniform(0.5, 2)), np.float32)
    if way == 1:
        return np.asarray(
            rng.uniform(0.5, 2) * (np.exp(-np.hypot(across, along) / rng.uniform(60, 250)) - 0.5), np.float32
        )
    streak = np.exp(-np.square(across / rng.uniform(3, 12)) - np.square(along / rng.uniform(40, 250)))
    return np.asarray(rng.uniform(0.2, 1) * streak, np.float32)


def _stroke_kernel(cells: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Make a kernel that averages along one direction."""
    kernel, angle, middle = np.zeros((cells, cells), np.float32), rng.uniform(0, np.pi), (cells - 1) / 2
    reach = np.array([np.cos(angle), np.sin(angle)]) * middle
    ends = [tuple(np.rint(middle + side * reach).astype(int).tolist()) for side in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], 1.0)
    return kernel / kernel.sum()
