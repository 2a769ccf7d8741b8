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
PER_MAP, PER_PICTURE, PER_PLAIN = 6, 3, 12  # crops
NEAR_MARKING, NEAR_M, TRIALS = 0.7, 7.0, 40  # share of the crops around a marking or border, and how far from it
LINE_CELLS, BORDER_CELLS, SUBPIXEL_BITS = 3, 3, 4  # least widths that are drawn
OFF_ROAD_CELLS = 25  # from all markings and borders
MORE_LINES, MORE_SHAPES = 0.5, 0.35  # shares of the crops that get one more line, and another marking
MORE_ROADS = 0.6  # share of the crops of plain ground that get a road of another surface
ALONG = 0.7  # share of those lines that run beside the road's own
FREE_CELLS = 4  # how far these are from other markings
SHAPE_TRIALS, CANVAS_CELLS = 5, 128  # places that are tried for another marking, and the side of its drawing


@dataclass(frozen=True, eq=False)
class Labels:
    """What the network should answer; H x W cells."""

    kind: NDArray[np.uint8]  # (H, W): 0 for no marking, else 1 + its place in `KINDS`
    border: NDArray[np.uint8]  # (H, W): 1 along borders of roads
    line: NDArray[np.floating]  # (3, H, W): of lines, cosine and sine of twice the direction, and width in m

    @classmethod
    def empty(cls) -> Labels:
        """Labels of a crop without markings and borders."""
        shape = (FINE_CELLS // 2,) * 2
        return cls(np.zeros(shape, np.uint8), np.zeros(shape, np.uint8), np.zeros((3, *shape), np.float32))

    @property
    def free(self) -> NDArray[np.bool_]:
        """Where (H, W) there is room for another marking."""
        away = cv2.distanceTransform((self.kind == 0).astype(np.uint8), cv2.DIST_L2, 3)
        return np.asarray(away > FREE_CELLS)


@dataclass(frozen=True, eq=False)
class Crop(Labels):
    """Labels, and the input of the network."""

    values: NDArray[np.float16]  # (12, H, W)


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

    labels = _draw_labels(road, to_crop, wide)
    no_paint, edge = labels.kind == 0, labels.border > 0
    off_road = cv2.distanceTransform((no_paint & ~edge).astype(np.uint8), cv2.DIST_L2, 3) > OFF_ROAD_CELLS
    off_road, curb = (np.kron(mask.astype(np.uint8), np.ones((2, 2), np.uint8)) for mask in (off_road, edge & no_paint))
    curb = cv2.erode(curb, np.ones((int(rng.integers(1, 5)),) * 2, np.uint8))
    layers = _Layers(np.log(color.astype(np.float32) + 4), alpha, intensity, height)
    lanes = [m.points_m for m in road.true.markings if m.is_lane_line] + [edge.points_m for edge in road.true.borders]
    elsewhere = (off_road > 0) & bool(lanes)  # plain ground may be painted on anywhere
    road_course = None
    if not lanes and rng.random() < MORE_ROADS:
        road_course = _draw_course(rng)
        layers = _lay_road(layers, road_course, labels, rng)
    if rng.random() < MORE_LINES:
        # Beside those of the road, across it, or anywhere on plain ground, as on wide squares that show no border.
        course = _draw_course(rng) if road_course is None else road_course
        if lanes and rng.random() < ALONG:
            course = to_crop(lanes[rng.integers(len(lanes))])
        for _ in range(1 if lanes else int(rng.integers(1, 5))):
            layers = _paint_line(layers, course, labels, elsewhere, rng)
    if rng.random() < MORE_SHAPES:
        course = to_crop(lanes[rng.integers(len(lanes))]) if lanes else _draw_course(rng)
        layers = _paint_shape(layers, course, labels, elsewhere, rng)
    disturbed = _disturb(layers, off_road > 0, curb > 0, rng)
    color = np.clip(np.exp(disturbed.log_color) - 4, 0, 255).astype(np.uint8)
    values = inputs_of(color, disturbed.alpha, disturbed.intensity, disturbed.height_m)
    return Crop(labels.kind, labels.border, labels.line.astype(np.float16), values.astype(np.float16))


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


def _draw_labels(road: RoadMap, to_crop: Callable[[Array], Array], wide: float) -> Labels:
    """Draw kinds, borders, and direction and width of lines in the cells of a crop; `wide`: factor of widths."""
    labels = Labels.empty()
    areas = [m for m in road.true.markings if m.kind in ("crosswalk", "other")]
    for marking in areas:
        outline = np.rint(to_crop(marking.points_m) * (1 << SUBPIXEL_BITS)).astype(np.int32)
        cv2.fillPoly(labels.kind, [outline], 1 + KINDS.index(marking.kind), cv2.LINE_8, SUBPIXEL_BITS)
    for marking in (m for m in road.true.markings if m.kind not in ("crosswalk", "other")):
        _draw_line(labels, to_crop(marking.points_m), marking.kind, marking.width_m * wide)
    for edge in road.true.borders:
        _draw(labels.border, to_crop(edge.points_m), 1, BORDER_CELLS)
    return labels


def _draw(image: NDArray[Any], points: Array, value: float, width: int) -> None:
    """Draw a polyline (N, 2) of a width in cells."""
    corners = np.rint(points * (1 << SUBPIXEL_BITS)).astype(np.int32)
    cv2.polylines(image, [corners], False, value, width, cv2.LINE_8, SUBPIXEL_BITS)


def _draw_line(labels: Labels, points: Array, kind: str, width_m: float) -> None:
    """Draw the kind of a line (N, 2), its direction and its width."""
    width = max(LINE_CELLS, round(width_m / CELL_M) | 1)
    _draw(labels.kind, points, 1 + KINDS.index(kind), width)
    near = (np.abs(points - len(labels.kind) / 2) < len(labels.kind)).all(axis=1)
    for begin, end in (pair for pair, drawn in zip(pairwise(points), near) if drawn):
        twice = 2 * np.arctan2(end[1] - begin[1], end[0] - begin[0])
        for layer, of_line in zip(labels.line, (np.cos(twice), np.sin(twice), width_m)):
            _draw(layer, np.stack([begin, end]), float(of_line), width)


def _draw_course(rng: np.random.Generator) -> Array:
    """Draw an arc (N, 2) through a crop, in coarse cells."""
    along = np.linspace(-FINE_CELLS, FINE_CELLS, 60)
    radius_m = _log_uniform(rng, 6, 1000)  # of guiding lines in junctions, and of roads
    across = CELL_M / radius_m * along**2 / 2
    angle = rng.uniform(0, np.pi)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return np.asarray(rng.uniform(0.2, 0.8, 2) * FINE_CELLS / 2 + np.stack([along, across], axis=1) @ turn)


def _lay_road(layers: _Layers, course: Array, labels: Labels, rng: np.random.Generator) -> _Layers:
    """Lay a road of another surface along a course (N, 2), in coarse cells, with or without curbs, and label its borders."""
    half_m = rng.uniform(2.0, 8.0)
    free = np.full(layers.alpha.shape, 255, np.uint8)
    _draw(free, course * 2 + 0.5, 0, 1)
    away_m = cv2.distanceTransform(free, cv2.DIST_L2, 5) * FINE_M
    soft = (half_m - away_m) / rng.uniform(0.05, 0.4)  # how sharp its edge is
    road = soft.clip(-1, 1).astype(np.float32) / 2 + 0.5
    tint = np.array([0.0, 1.0, 1.0]) * rng.normal(0, 0.08)  # yellower or bluer
    color = layers.log_color + road[..., None] * (rng.normal(0, 0.35) + tint).astype(np.float32)
    intensity = layers.intensity * np.exp(road * np.float32(rng.normal(0, 0.5)))
    height = layers.height_m - road * np.float32(rng.uniform(0.03, 0.2) if rng.random() < 0.5 else 0.0)
    edge = cv2.findContours((away_m < half_m).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    drawn = np.zeros(layers.alpha.shape, np.uint8)
    cv2.drawContours(drawn, edge, -1, 1, 2 * BORDER_CELLS)
    # The end of the crop is none of the road.
    drawn[:4], drawn[-4:], drawn[:, :4], drawn[:, -4:] = 0, 0, 0, 0
    labels.border[cv2.resize(drawn, labels.border.shape[::-1], interpolation=cv2.INTER_AREA) > 0] = 1
    return _Layers(color, layers.alpha, intensity, height)


def _paint_line(
    layers: _Layers, course: Array, labels: Labels, off_road: NDArray[np.bool_], rng: np.random.Generator
) -> _Layers:
    """Paint one more line beside a course (N, 2), in coarse cells: solid, of dashes of any length and width, or of dots.

    It is labeled where there is no marking yet.
    """
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(course, axis=0), axis=1))])
    dense = np.stack([np.interp(np.arange(0, s[-1], 2.0), s, course[:, k]) for k in range(2)], axis=1)
    if len(dense) < 4:
        return layers
    step = np.gradient(dense, axis=0)
    normal = step[:, ::-1] * [-1, 1] / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)
    dense = dense + normal * rng.choice([-1, 1]) * rng.uniform(0.8, 4.0) / CELL_M
    width_m, way = _log_uniform(rng, 0.1, 0.5), rng.integers(5)  # solid, dashes three times, dots
    dash_m = np.inf if way == 0 else rng.uniform(0.1, 0.25) if way == 4 else _log_uniform(rng, 0.3, 8)
    gap_m = 0.0 if way == 0 else _log_uniform(rng, 0.5, 3) * (1 if way == 4 else dash_m)
    along_m = np.arange(len(dense)) * 2 * CELL_M + rng.uniform(0, 10)
    free = labels.free
    fine_free = cv2.resize(free.astype(np.uint8), layers.alpha.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    paint = np.zeros(layers.alpha.shape, np.uint8)
    # Finer than the cells, so that dots and short dashes keep their lengths.
    fine = np.arange(0, along_m[-1] - along_m[0], 0.05)
    fine_xy = np.stack([np.interp(fine, along_m - along_m[0], dense[:, k]) for k in range(2)], axis=1) * 2 + 0.5
    on = np.isinf(dash_m) | ((fine + along_m[0]) % (dash_m + gap_m) < dash_m)
    for begin, end in runs_of(on):
        _draw(paint, fine_xy[begin:end], 255, max(1, round(width_m / FINE_M)))
    layers = _add_paint(layers, paint.astype(np.float32) / 255, fine_free & ~off_road, rng)
    new = Labels.empty()
    _draw_line(new, dense, "solid" if way == 0 else "dashed", width_m)
    there = (new.kind > 0) & free & ~off_road[::2, ::2]
    labels.kind[there], labels.line[:, there] = new.kind[there], new.line[:, there]
    return layers


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _add_paint(
    layers: _Layers, paint: NDArray[np.float32], where: NDArray[np.bool_], rng: np.random.Generator
) -> _Layers:
    """Add paint, by the share of each cell that it covers, of any contrast, blurred a little."""
    share = cv2.GaussianBlur(paint, (0, 0), rng.uniform(0.3, 1.2)) * where
    color = layers.log_color + share[..., None] * np.float32(rng.uniform(0.15, 0.9))
    intensity = layers.intensity * (1 + share * np.float32(np.exp(rng.uniform(0.2, 1.4)) - 1))
    return _Layers(color, layers.alpha, intensity, layers.height_m)


def _paint_shape(
    layers: _Layers, course: Array, labels: Labels, off_road: NDArray[np.bool_], rng: np.random.Generator
) -> _Layers:
    """Paint a symbol, a crosswalk or a stop line beside a course (N, 2), in coarse cells, where there is room, and label it."""
    name, paint, covered, (long_m, wide_m) = _draw_shape(rng)
    half = FINE_CELLS / 4
    inside = np.flatnonzero((np.abs(course[:-1] - half) < half).all(axis=1))
    free = labels.free & ~off_road[::2, ::2]
    for k in rng.choice(inside, SHAPE_TRIALS) if len(inside) else ():
        heading = course[k + 1] - course[k]
        heading = heading / max(float(np.linalg.norm(heading)), 1e-9)
        left = np.array([-heading[1], heading[0]])
        away_m = rng.choice([-1, 1]) * rng.uniform(0.5, 4.0)
        at = course[k] + (rng.uniform(0, 1) * heading + away_m * left) / CELL_M
        # Columns of the canvas go along the road.
        axes = np.stack([heading * long_m, left * wide_m], axis=1) / CANVAS_CELLS / FINE_M
        matrix = np.column_stack([axes, 2 * at + 0.5 - axes @ np.full(2, CANVAS_CELLS / 2)])
        area, new = (
            cv2.warpAffine(layer, matrix, layers.alpha.shape[::-1]) / np.float32(255) for layer in (covered, paint)
        )
        label = cv2.resize(area, free.shape[::-1], interpolation=cv2.INTER_AREA) > 0.4
        if label.any() and free[label].all():
            labels.kind[label] = 1 + KINDS.index(name)
            if name == "stop_line":
                twice = 2 * np.arctan2(left[1], left[0])
                labels.line[:, label] = np.array([[np.cos(twice)], [np.sin(twice)], [long_m]])
            return _add_paint(layers, new, np.ones(new.shape, dtype=bool), rng)
    return layers


def _draw_shape(rng: np.random.Generator) -> tuple[str, NDArray[np.uint8], NDArray[np.uint8], tuple[float, float]]:
    """Draw a marking: its kind, canvases of its paint and of what it covers, whose columns go along the road, its length and width, m."""
    n = CANVAS_CELLS
    paint = np.zeros((n, n), np.uint8)
    way = rng.integers(6)
    if way == 0:  # bars of a crosswalk, at times between two lines
        count = int(rng.integers(3, 15))
        share = rng.uniform(0.35, 0.65)
        paint[(np.arange(n) / n * (count - 1 + share)) % 1 < share] = 255
        if rng.random() < 0.2:
            paint[:, [0, 1, 2, 3, -4, -3, -2, -1]] = 255
        step_m = rng.uniform(0.6, 1.4)
        return "crosswalk", paint, np.full_like(paint, 255), (rng.uniform(1.5, 6), (count - 1 + share) * step_m)
    if way == 1:  # a stop line, or one of blocks or triangles, to give way
        covered = np.full_like(paint, 255)
        length_m, width_m = rng.uniform(2, 12), rng.uniform(0.2, 0.8)
        phase = (np.arange(n) / n * max(3, round(length_m / rng.uniform(0.6, 1.2)))) % 1
        shape = rng.integers(4)
        if shape == 0:
            paint[phase < rng.uniform(0.4, 0.7)] = 255
        elif shape == 1:
            paint[np.abs(phase - 0.5)[:, None] < np.arange(n) / n / 2] = 255
        else:
            paint[:] = 255
        return "stop_line", paint, covered, (width_m, length_m)
    if way == 2:  # a bicycle
        for column, row in ((28, 40), (28, 88)):
            cv2.circle(paint, (column, row), 20, 255, 5)
        frame = np.array(
            [[28, 40], [60, 52], [58, 78], [28, 62], [60, 52], [78, 50], [58, 78], [28, 88], [58, 78], [80, 84]]
        )
        cv2.polylines(paint, [frame], False, 255, 5)
        size = rng.uniform(1.2, 4), rng.uniform(0.8, 2)
    elif way == 3:  # an arrow, at times with a head to one side, too
        tip = int(rng.integers(50, 100))
        cv2.line(paint, (0, 64), (tip, 64), 255, int(rng.integers(8, 20)))
        cv2.fillPoly(paint, [np.array([[tip, 64 - 30], [127, 64], [tip, 64 + 30]])], 255)
        if rng.random() < 0.5:
            cv2.polylines(paint, [np.array([[40, 64], [70, 100]])], False, 255, 10)
            cv2.fillPoly(paint, [np.array([[55, 105], [90, 92], [85, 127]])], 255)
        size = rng.uniform(1.5, 7.5), rng.uniform(0.6, 2)
    else:  # letters and digits, read in the direction of travel
        text = "".join(rng.choice(list("ABCDEFGHKLMNOPRSTUX0123456789"), int(rng.integers(1, 5))))
        font = int(rng.choice([cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX]))
        (wide, high), _ = cv2.getTextSize(text, font, 2.0, 6)
        upright = np.zeros((high + 12, wide + 12), np.uint8)
        cv2.putText(upright, text, (6, high + 6), font, 2.0, 255, int(rng.integers(4, 10)))
        paint = cv2.rotate(cv2.resize(upright, (n, n), interpolation=cv2.INTER_AREA), cv2.ROTATE_90_CLOCKWISE)
        size = rng.uniform(1, 4), min(0.7 * len(text), 2.5) * rng.uniform(0.6, 1.2)
    return "other", paint, paint, size


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
        if chance(0.3):
            color += _light(shape, rng)[..., None]
        if chance(0.25):  # repaired places and covers
            color += _plates(shape, rng)[..., None]
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
        if chance(0.4):
            intensity = intensity * np.exp(_rings(shape, rng))
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
    for _ in range(int(rng.integers(1, 3)) if chance(0.2) else 0):  # where what a sensor saw ends
        outside, which = _outside(shape, rng), rng.integers(3)
        if which != 0:
            intensity, height = np.where(outside, np.nan, intensity), np.where(outside, np.nan, height)
        if which != 1:
            alpha = np.where(outside, 0, alpha).astype(np.uint8)
    if chance(0.15):
        height = np.full_like(height, np.nan)
    return _Layers(color, alpha, intensity.astype(np.float32), height.astype(np.float32))


def _rings(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.float32]:
    """Draw rings of sweeps (H, W), as logarithms: lasers differ in what they return, and a map shows where each sweep's points lie."""
    out = np.zeros(shape, np.float32)
    radii = rng.uniform(3, 30) / FINE_M * np.cumprod(1 + rng.uniform(0.005, 0.15, int(rng.integers(2, 25))))
    gains = rng.normal(0, rng.uniform(0.1, 0.5), len(radii))
    angle, step_m = rng.uniform(0, 2 * np.pi), _log_uniform(rng, 0.1, 2.0)
    steps = np.arange(int(rng.integers(1, 40)))[:, None] * np.array([np.cos(angle), np.sin(angle)]) * step_m / FINE_M
    for x, y in (rng.uniform(-0.5, 1.5, 2) * shape[0] + steps).round().astype(int).tolist():
        for radius, gain in zip(radii.round().astype(int).tolist(), gains.tolist()):
            cv2.circle(out, (x, y), radius, gain, 2)
    return out


def _plates(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.float32]:
    """Draw repaired places with straight edges, and covers of shafts, as logarithms (H, W): brighter or darker than the road."""
    out = np.zeros(shape, np.float32)
    for _ in range(int(rng.integers(1, 5))):
        at, change = rng.uniform(0, shape[0], 2), rng.uniform(-0.4, 0.4)
        if rng.random() < 0.4:
            radius = int(rng.integers(4, 10))
            cv2.circle(out, at.astype(int).tolist(), radius, change, int(rng.choice([-1, 2, 3])))
        else:
            size = _log_uniform(rng, 0.5, 4) / FINE_M, _log_uniform(rng, 0.5, 20) / FINE_M
            corners = cv2.boxPoints((at.tolist(), size, rng.uniform(0, 180)))
            cv2.fillPoly(out, [corners.round().astype(np.int32)], change)
    return out


def _outside(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.bool_]:
    """Draw a mask of what is beyond the reach of a sensor, a circle or beam with a ragged end, or within what is too near."""
    rows, columns = np.indices(shape).astype(np.float32)
    center, radius = rng.uniform(-1, 2, 2) * shape[0], rng.uniform(3, 40) / FINE_M
    distance = np.hypot(rows - center[0], columns - center[1])
    ragged = cv2.resize(rng.normal(size=(32, 32)).astype(np.float32), shape[::-1]) * rng.uniform(0, 10)
    beyond = distance + ragged > radius
    # About as much of the crop is left as is taken away, or more.
    return np.asarray(beyond if beyond.mean() < 0.6 else ~beyond)


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
    out = np.zeros(shape, np.float32)
    for _ in range(int(rng.integers(1, 5))):  # of lamps one behind the other
        off = rng.normal(0, 60, 2)
        streak = np.square((across - off[0]) / rng.uniform(3, 12)) + np.square((along - off[1]) / rng.uniform(40, 250))
        out += np.float32(rng.uniform(0.2, 1)) * np.exp(-streak)
    return out


def _stroke_kernel(cells: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Make a kernel that averages along one direction."""
    kernel, angle, middle = np.zeros((cells, cells), np.float32), rng.uniform(0, np.pi), (cells - 1) / 2
    reach = np.array([np.cos(angle), np.sin(angle)]) * middle
    ends = [tuple(np.rint(middle + side * reach).astype(int).tolist()) for side in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], 1.0)
    return kernel / kernel.sum()
