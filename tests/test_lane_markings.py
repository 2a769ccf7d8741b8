"""Markings are found in maps of the ground on which they are painted, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from painted_ground import ASPHALT, GRASS, WHITE, Painter, dashes_of, line_of, outline_of
from scipy.spatial import cKDTree

from log2sim.geometry import Array, Camera, apply, ground_homography, inverse, project
from log2sim.road.curves import Curve
from log2sim.road.ground_map import Raster
from log2sim.road.lane_course import RoadShape, find_lane_lines
from log2sim.road.lane_picture import find_markings_in_picture
from log2sim.road.lines import parts_of
from log2sim.road.markings import find_markings
from log2sim.road.paint_network import KINDS, PaintMaps

GRAVEL = (120, 125, 130)
EXTENT = (0.0, 50.0, -10.0, 14.0)


def bend(x: Array) -> Array:
    return 0.002 * x**2


def road(painter: Painter, **options) -> list[Array]:
    """Paint two solid lines with two dashed ones between them; return their middles."""
    truth = []
    for offset, solid in ((-5.25, True), (-1.75, False), (1.75, False), (5.25, True)):
        line = line_of(lambda x, o=offset: bend(x) + o, *painter.extent_m[:2])
        painter.lines([line] if solid else dashes_of(line, 3.0, 6.0, 1.5), **({"width_m": 0.12} | options))
        truth.append(line)
    return truth


def dense(xy: Array, step_m: float = 0.1) -> Array:
    s = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    return np.stack([np.interp(np.arange(0, s[-1], step_m), s, xy[:, k]) for k in range(2)], 1)


def compare(markings, truth: list[Array]) -> tuple[float, float, float]:
    """Precision and recall of lane lines at 0.3 m, and the median error."""
    found = np.concatenate([dense(m.points_m[:, :2]) for m in markings if m.is_lane_line])
    true = np.concatenate([dense(line, 0.01) for line in truth])
    error, miss = cKDTree(true).query(found)[0], cKDTree(found).query(true)[0]
    return float(np.mean(error < 0.3)), float(np.mean(miss < 0.3)), float(np.median(error))


def shadows(painter: Painter) -> None:
    rng = np.random.default_rng(5)
    bands = []
    for _ in range(6):
        angle, middle = rng.uniform(0, np.pi), rng.uniform((0, -10), (50, 14))
        reach = np.array([np.cos(angle), np.sin(angle)]) * rng.uniform(5, 20)
        bands.append(outline_of(np.array([middle - reach, middle + reach]), rng.uniform(0.5, 8)))
    shade = cv2.GaussianBlur(painter.cover(bands), (0, 0), 1.5)[..., None]
    painter.color *= 1 - shade * 0.55 * np.array([0.92, 1, 1.03], np.float32)


def sun_through_a_fence(painter: Painter) -> None:
    bars = [outline_of(np.array([[10 + 0.55 * k, -8], [14 + 0.55 * k, 8]]), 0.3) for k in range(30)]
    painter.color *= 1 - cv2.GaussianBlur(painter.cover(bars), (0, 0), 1.0)[..., None] * 0.5


def wet_glare(painter: Painter) -> None:
    x, y = painter.xy
    for k in range(4):
        middle = 15 + 10 * k
        across, along = (y - 2 + k * 1.5 - 0.05 * (x - middle)) / 0.35, (x - middle) / 8
        painter.color += (90 * np.exp(-(across**2) - along**2))[..., None]


def night(painter: Painter) -> None:
    x, y = painter.xy
    light = 0.06 + 0.5 * np.exp(-(((x - 10) / 14) ** 2) - (y / 7) ** 2)
    painter.color *= (light + 0.25 * np.exp(-(((x - 42) / 6) ** 2) - ((y + 6) / 6) ** 2))[..., None]


def paving(painter: Painter) -> None:
    painter.color[:] = (150, 155, 158)
    x, y = painter.xy
    painter.color *= np.where((x % 1 < 0.04) | (y % 1 < 0.04), 0.86, 1)[..., None]


SENSORS = [True, pytest.param(False, marks=pytest.mark.slow)]  # with LiDAR or without


@pytest.mark.matrix
@pytest.mark.parametrize("lidar", SENSORS)
@pytest.mark.parametrize(
    "change", [None, shadows, sun_through_a_fence, wet_glare, night], ids=lambda c: c.__name__ if c else "day"
)
def test_lane_lines_are_found_where_they_are(change, lidar: bool) -> None:
    painter = Painter(EXTENT)
    truth = road(painter)
    if change:
        change(painter)
    markings, _, _ = find_markings(painter.ground(lidar=lidar))
    precision, recall, error = compare(markings, truth)
    # To cameras alone the ends of streaks of light look like dashes.
    assert precision >= (0.95 if lidar or change is not wet_glare else 0.8)
    assert recall >= 0.8
    assert error <= 0.02
    if change is None:
        assert sorted(m.kind for m in markings) == ["dashed", "dashed", "solid", "solid"]
        assert {m.color for m in markings} == {"white"}
        assert {m.sources for m in markings} == {("camera", "lidar") if lidar else ("camera",)}
        assert all(abs(m.width_m - 0.12) < 0.06 for m in markings)


@pytest.mark.matrix
@pytest.mark.parametrize("lidar", SENSORS)
@pytest.mark.parametrize("change", [shadows, sun_through_a_fence, wet_glare, paving], ids=lambda c: c.__name__)
def test_nothing_is_found_where_nothing_is_painted(change, lidar: bool) -> None:
    if change is wet_glare and not lidar:
        pytest.skip("cameras alone take some streaks of light for lines; the notes of the map say so")
    painter = Painter(EXTENT)
    change(painter)
    markings, _, notes = find_markings(painter.ground(lidar=lidar))
    assert markings == ()
    assert any("no markings seen" in note for note in notes)


@pytest.mark.parametrize(("base", "grain"), [(ASPHALT, 0.05), (GRAVEL, 0.25), (GRASS, 0.3)])
def test_textures_are_no_paint(base, grain: float) -> None:
    assert find_markings(Painter(EXTENT, base=base).ground(grain=grain, lidar=False))[0] == ()


def test_a_map_of_nothing_says_so() -> None:
    ground = Painter((0.0, 5.0, 0.0, 5.0)).ground(lidar=False)
    markings, borders, notes = find_markings(replace(ground, alpha=ground.alpha * 0))
    assert (markings, borders) == ((), ())
    assert notes == ("no markings seen: no sensor saw the ground",)


def test_crosswalk_and_stop_line_are_told_from_lane_lines() -> None:
    painter = Painter(EXTENT)
    painter.lines([line_of(lambda x: 3.5 + 0 * x, 0, 30), line_of(lambda x: 0 * x, 0, 30)])
    painter.lines([np.array([[31.0, 0.2], [31.0, 3.3]])], 0.5)
    painter.lines([np.array([[34.0, y], [38.0, y]]) for y in np.arange(-7, 8)], 0.5)
    markings = {m.kind: m for m in find_markings(painter.ground())[0]}
    assert set(markings) == {"solid", "stop_line", "crosswalk"}
    stop, crosswalk = markings["stop_line"], markings["crosswalk"]
    assert np.allclose(stop.points_m[:, 0], 31, atol=0.1)
    assert abs(np.ptp(stop.points_m[:, 1]) - 3.1) < 0.5
    area = cv2.contourArea(crosswalk.points_m[:, :2].astype(np.float32))
    assert abs(crosswalk.width_m - 4) < 0.5
    assert abs(area - 4 * 14.5) < 6


@pytest.mark.parametrize(("paint", "color"), [(WHITE, "white"), ((90, 190, 210), "yellow")])
def test_the_color_of_a_crosswalk_is_told_in_yellow_light_too(paint: tuple[int, int, int], color: str) -> None:
    painter = Painter(EXTENT)
    painter.lines([np.array([[34.0, y], [38.0, y]]) for y in np.arange(-7, 8)], 0.5, paint)
    painter.color *= np.array([0.7, 0.95, 1.0])
    (crosswalk,) = (m for m in find_markings(painter.ground())[0] if m.kind == "crosswalk")
    assert crosswalk.color == color


@pytest.mark.parametrize(("gap_m", "crosswalks"), [(2.0, 1), (4.0, 1), (8.0, 2)])
def test_parts_of_a_crosswalk_less_than_a_lane_apart_are_one(gap_m: float, crosswalks: int) -> None:
    painter = Painter(EXTENT)
    away = gap_m / 2 + np.arange(5)
    painter.lines([np.array([[34.0, 2 + y], [38.0, 2 + y]]) for y in (*-away, *away)], 0.5)
    found = [m.points_m[:, 1] for m in find_markings(painter.ground())[0]]
    assert len(found) == crosswalks
    assert np.ptp(np.concatenate(found)) == pytest.approx(gap_m + 8.5, abs=0.3)


def test_what_a_shadow_leaves_of_a_bar_is_no_dash_of_the_line_behind_the_crosswalk() -> None:
    painter = Painter(EXTENT)
    painter.lines([np.array([[34.0, y], [38.0, y]]) for y in (*range(-7, 0), *range(1, 8))], 0.5)
    painter.lines([np.array([[36.3, -0.15], [38.0, -0.1]])], 0.25)
    painter.lines(dashes_of(line_of(lambda x: 0 * x, 41, 58), 3.0, 3.0))
    markings = {m.kind: m for m in find_markings(painter.ground())[0]}
    assert set(markings) == {"dashed", "crosswalk"}
    assert markings["dashed"].points_m[:, 0].min() == pytest.approx(41, abs=0.3)


@pytest.mark.parametrize("change", [None, wet_glare], ids=["wet", "glare"])
def test_wet_paint_returns_little_and_glare_nothing(change) -> None:
    painter = Painter(EXTENT)
    truth = road(painter)
    if change:
        change(painter)
    precision, recall, _ = compare(find_markings(painter.ground(reflects=0.015, noise=0.01))[0], truth)
    assert precision >= 0.95
    assert recall >= 0.8


@pytest.mark.parametrize("lidar", [True, False])
def test_a_fainter_line_beside_another_is_what_is_left_of_it(lidar: bool) -> None:
    """Removed paint beside the new one; two that are as bright as each other are the lines of a path for bicycles."""

    def found(shade: int, reflects: float) -> list[float]:
        painter = Painter(EXTENT)
        painter.lines([line_of(lambda x: 0 * x, 0, 50)])
        beside = painter.cover([outline_of(line_of(lambda x: 0 * x + 1.2, 0, 50), 0.14)])
        painter.lay(beside, (shade,) * 3, reflects=reflects)
        markings = find_markings(painter.ground(lidar=lidar))[0]
        return sorted({abs(round(float(m.points_m[:, 1].mean()), 1)) for m in markings})

    assert found(WHITE[0], 1.0) == [0.0, 1.2]
    assert found(ASPHALT[0] + 20, 0.15) == [0.0]


def test_dashes_that_a_camera_sees_blurred_are_no_symbols() -> None:
    painter = Painter(EXTENT)
    painter.lines([np.array([[x, 0.0], [x + 3.0, 0.0]]) for x in (3.0, 9.0, 15.0)], 0.15)
    ground = painter.ground(lidar=False)
    blurred = cv2.GaussianBlur(ground.color_bgr, (0, 0), sigmaX=10.0, sigmaY=2.0)
    assert [m.kind for m in find_markings(replace(ground, color_bgr=blurred))[0]] == ["dashed"]


def test_markings_turn_with_the_map() -> None:
    painter = Painter((0.0, 30.0, -15.0, 15.0))
    painter.lines([line_of(lambda x: 0.3 * x - 2, 0, 30)])
    ground = painter.ground()
    turned = replace(
        ground,
        **{
            k: np.ascontiguousarray(np.rot90(getattr(ground, k)))
            for k in ("color_bgr", "alpha", "height_m", "intensity")
        },
        extent_m=(-15.0, 15.0, 0.0, 30.0),
    )
    (before,), (after,) = find_markings(ground)[0], find_markings(turned)[0]
    quarter = before.points_m[:, :2] @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    assert cKDTree(dense(after.points_m[:, :2])).query(dense(quarter))[0].max() < 0.08


def test_a_line_beside_a_bright_sidewalk_is_found_by_what_the_lidar_sees() -> None:
    painter = Painter(EXTENT)
    painter.lay(painter.cover([outline_of(line_of(lambda x: 6.1 + 0 * x, -1, 51), 4.0)]), (165, 165, 165))
    truth = [line_of(lambda x: 3.95 + 0 * x, 0, 50), line_of(lambda x: 0 * x, 0, 50)]
    painter.lines(truth, 0.15, (170, 170, 170), worn=0.3)
    precision, recall, _ = compare(find_markings(painter.ground())[0], truth)
    assert min(precision, recall) > 0.9


def test_borders_are_where_the_road_ends() -> None:
    painter = Painter(EXTENT, base=GRASS)
    carriageway = painter.cover([outline_of(line_of(bend, -1, 51), 8.0)])
    painter.lay(carriageway, ASPHALT)
    painter.height += 0.12 * (carriageway < 0.5)
    painter.paint -= 0.2 * (carriageway < 0.5)
    painter.lines([line_of(bend, 0, 50)])
    _, borders, notes = find_markings(painter.ground())
    truth = [line_of(lambda x, s=side: bend(x) + s * 4 * np.sqrt(1 + (0.004 * x) ** 2), 0, 50) for side in (-1, 1)]
    assert {b.kind for b in borders} == {"curb"}
    found = np.concatenate([dense(border.points_m[:, :2]) for border in borders])
    off = cKDTree(np.concatenate([dense(line) for line in truth])).query(found)[0]
    assert off.max() < 0.4
    assert np.median(off) < 0.15
    assert np.mean(cKDTree(found).query(np.concatenate([dense(line) for line in truth]))[0] < 0.4) > 0.7
    assert not any("no borders" in note for note in notes)


def maps_along(*strokes: tuple[float, float, str], hidden: tuple[float, float] = (0.0, 0.0)) -> PaintMaps:
    """Maps of a line along x: `strokes` have their begin, end and kind, `hidden` is what no sensor saw."""
    raster = Raster.covering((0.0, 200.0, -1.0, 1.0), 0.1)
    x, y = np.moveaxis(raster.xy_of(*np.indices(raster.shape)), -1, 0)
    probability = np.full((len(KINDS), *raster.shape), 0.01, np.float32)
    for begin, end, kind in strokes:
        probability[KINDS.index(kind)][(x >= begin) & (x <= end) & (np.abs(y) < 0.2)] = 0.9
    seen = (x < hidden[0]) | (x > hidden[1])
    nothing = np.zeros(raster.shape, np.float32)
    return PaintMaps(probability * seen, nothing, nothing, seen, raster, {})


def parts_along(
    *strokes: tuple[float, float, str], hidden: tuple[float, float] = (0.0, 0.0), crosswalk: tuple[float, float] = (0.0, 0.0)
):  # fmt: skip
    curve = Curve(np.column_stack([np.linspace(0, 199, 400), np.zeros(400)]))
    maps = maps_along(*strokes, hidden=hidden)
    x = maps.raster.xy_of(*np.indices(maps.raster.shape))[..., 0]
    crossed = (x > crosswalk[0]) & (x < crosswalk[1])
    return parts_of(maps, curve, np.array([stroke[:2] for stroke in strokes]), crossed)


def dashes(dash_m: float, gap_m: float, *spans: tuple[float, float]) -> list[tuple[float, float, str]]:
    """Dashes that are painted within spans alone."""
    begin = np.arange(0.0, 198.0, dash_m + gap_m)
    inside = [b for b in begin if any(low <= b and b + dash_m <= high for low, high in spans)]
    return [(b, b + dash_m, "dashed") for b in inside]


@pytest.mark.parametrize(
    "strokes",
    [
        [(0.0, 120.0, "solid")],
        [(0.0, 58.0, "solid"), (63.0, 120.0, "solid")],
        [(k, k + 3.0, "dashed") for k in range(0, 120, 6)],
    ],
)
def test_lines_end_at_a_crosswalk_and_go_on_behind(strokes: list[tuple[float, float, str]]) -> None:
    before, behind = parts_along(*strokes, crosswalk=(58.0, 63.0))
    assert before[0] == pytest.approx(0.0, abs=0.3)
    assert 56.7 < before[1] < 58.1
    assert 62.9 < behind[0] < 66.3
    assert behind[1] == pytest.approx(strokes[-1][1], abs=0.3)
    assert {before[2], behind[2]} == {strokes[0][2]}


@pytest.mark.parametrize(("dash_m", "gap_m"), [(3.0, 3.0), (1.5, 4.5), (6.0, 12.0), (3.0, 9.0)])
def test_dashed_lines_end_at_a_junction_and_not_at_their_own_gaps(dash_m: float, gap_m: float) -> None:
    ((begin, end, kind),) = parts_along(*dashes(dash_m, gap_m, (0.0, 120.0)))
    assert (begin, kind) == (pytest.approx(0, abs=0.3), "dashed")
    assert end == pytest.approx(max(e for _, e, _ in dashes(dash_m, gap_m, (0.0, 120.0))), abs=0.3)
    far = max(14.0, 4 * gap_m)
    parts = parts_along(*dashes(dash_m, gap_m, (0.0, 70.0), (70.0 + far, 200.0)))
    assert [kind for _, _, kind in parts] == ["dashed", "dashed"]
    assert parts[0][1] <= 70.3
    assert parts[1][0] >= 69.7 + far
    if 2 * gap_m + dash_m < 10.0 or 2 * gap_m + dash_m <= 3 * gap_m:
        worn = dashes(dash_m, gap_m, (0.0, 120.0))
        del worn[3]
        assert len(parts_along(*worn)) == 1


def test_lines_end_at_a_junction_unless_it_is_hidden_and_where_their_kind_changes() -> None:
    before, behind = (40.0, 60.0, "solid"), (70.0, 90.0, "solid")
    assert len(parts_along(before, behind)) == 2
    ((begin, end, kind),) = parts_along(before, behind, hidden=(60.5, 69.5))
    assert (begin, end, kind) == (pytest.approx(40, abs=0.3), pytest.approx(90, abs=0.3), "solid")
    parts = parts_along((0.0, 60.0, "solid"), *((60.0 + b, 60.0 + e, k) for b, e, k in dashes(3.0, 3.0, (3.0, 100.0))))
    assert [kind for _, _, kind in parts] == ["solid", "dashed"]
    assert parts[0][1] == pytest.approx(60, abs=3)


OFFSETS = (-5.25, -1.75, 1.75, 5.25)


def straight(offset_m: float) -> Array:
    return line_of(lambda x: offset_m + 0 * x, 0, 70)


def picture(*, base=ASPHALT, beyond=(), last: dict | None = None) -> tuple[np.ndarray, Camera]:
    """Photograph a straight road from 1.5 m above it, 3 deg downwards.

    `beyond`: offset, width and color of what else runs along it, below the lines. `last`: how the leftmost line is painted.
    """
    painter = Painter((0.0, 70.0, -12.0, 12.0), base=base)
    for offset, width, color in beyond:
        painter.lay(painter.cover([outline_of(straight(offset), width)]), color)
    for k, offset in enumerate(OFFSETS):
        pieces = [straight(offset)] if k in (0, 3) else dashes_of(straight(offset), 3, 6)
        painter.lines(pieces, **(last if last and k == 3 else {}))
    ground = painter.ground(lidar=False)
    pitch = np.deg2rad(3.0)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0, -np.sin(pitch), np.cos(pitch)], [-1, 0, 0], [0, -np.cos(pitch), -np.sin(pitch)]])
    pose[2, 3] = 1.5
    focal = 640 / np.tan(np.deg2rad(30))
    K = np.array([[focal, 0, 639.5], [0, focal, 359.5], [0, 0, 1]])
    camera = Camera("front", 1280, 720, K, "ego", pose)
    cell_H_ground = np.array([[20, 0, -0.5], [0, -20, 12 * 20 - 0.5], [0, 0, 1]])
    cell_H_image = cell_H_ground @ ground_homography(camera, pose)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    image = cv2.warpPerspective(
        ground.color_bgr,
        cell_H_image,
        (1280, 720),
        flags=flags,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(200, 190, 180),
    )
    return image, camera


def test_a_known_camera_measures_lines_where_they_are() -> None:
    image, camera = picture()
    found = find_markings_in_picture(image, camera)
    assert np.allclose([line.offset_m for line in found.lane_lines], sorted(OFFSETS, reverse=True), atol=0.1)


def test_an_unknown_camera_is_estimated_from_where_lines_meet() -> None:
    image, camera = picture()
    found = find_markings_in_picture(image)
    for line, offset in zip(found.lane_lines, sorted(OFFSETS, reverse=True), strict=True):
        truth = np.column_stack([straight(offset), np.zeros(281)])[32:]
        u, v = project(camera, apply(inverse(camera.mount_T_cam), truth))[0].T
        own = found.project(line.points_m)
        own = own[np.isfinite(own).all(axis=1)]
        visible = (u > 0) & (u < 1280)
        assert np.abs(np.interp(v[visible], own[::-1, 1], own[::-1, 0]) - u[visible]).max() < 15


CONCRETE, YELLOW, STEEL, SEAM = (150, 152, 154), (90, 112, 125), (190, 190, 190), (125, 126, 126)


@pytest.mark.parametrize(
    "options",
    [
        # Darker than the concrete on its right, and beyond it a dark shoulder.
        {"base": CONCRETE, "beyond": [(8.7, 6.7, ASPHALT)], "last": {"color": YELLOW}},
        {"last": {"worn": 0.85}},
        {"last": {"color": SEAM}},
    ],
    ids=["yellow between concrete and asphalt", "worn", "faint"],
)
def test_lines_of_little_contrast_are_detected_along_the_course(options) -> None:
    image, camera = picture(**options)
    found = find_markings_in_picture(image, camera)
    assert [line.offset_m for line in found.lane_lines] == pytest.approx(sorted(OFFSETS, reverse=True), abs=0.1)


def test_rails_off_the_road_and_seams_within_lanes_are_no_lane_lines() -> None:
    beyond = [(3.5, 0.12, SEAM)]
    for side in (-1, 1):
        beyond += [(8.9 * side, 6.4, GRASS), (7.4 * side, 0.15, STEEL)]
    image, camera = picture(beyond=beyond)
    found = find_markings_in_picture(image, camera)
    assert [line.offset_m for line in found.lane_lines] == pytest.approx(sorted(OFFSETS, reverse=True), abs=0.1)


def test_a_road_without_markings_has_no_lane_lines() -> None:
    painter = Painter((0.0, 70.0, -12.0, 12.0))
    shape, camera = RoadShape(0.0, 0.0), picture()[1]
    ground = painter.ground(lidar=False)
    assert find_lane_lines(ground, ground, camera, shape, [], 100.0) == []
