"""Markings are found in maps of the ground on which they are painted, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from painted_ground import ASPHALT, GRASS, WHITE, Painter, dashes_of, line_of, outline_of
from scipy.spatial import cKDTree

from log2sim.geometry import Array, Camera, apply, ground_homography, inverse, project
from log2sim.road.lane_course import RoadShape, find_lane_lines
from log2sim.road.lane_picture import find_markings_in_picture
from log2sim.road.markings import find_markings
from log2sim.road.paint import (
    Pieces,
    by_lidar,
    evidence_of_line,
    log_probabilities_of_shares,
    no_pieces,
    table_of,
    weighted_sum,
)
from log2sim.road.strokes import stretches_of
from log2sim.road.weights import WEIGHTS

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


def test_crosswalk_stop_line_and_arrow_are_told_from_lane_lines() -> None:
    painter = Painter(EXTENT)
    painter.lines([line_of(lambda x: 3.5 + 0 * x, 0, 30), line_of(lambda x: 0 * x, 0, 30)])
    painter.lines([np.array([[31.0, 0.2], [31.0, 3.3]])], 0.5)
    painter.lines([np.array([[34.0, y], [38.0, y]]) for y in np.arange(-7, 8)], 0.5)
    arrow = np.array([[10, -5.1], [13, -5.1], [13, -5.4], [14, -5.0], [13, -4.6], [13, -4.9], [10, -4.9]])
    painter.lay(painter.cover([arrow]), WHITE, reflects=1.0)
    markings = {m.kind: m for m in find_markings(painter.ground())[0]}
    assert set(markings) == {"solid", "stop_line", "crosswalk", "other"}
    stop, crosswalk, other = markings["stop_line"], markings["crosswalk"], markings["other"]
    assert np.allclose(stop.points_m[:, 0], 31, atol=0.1)
    assert abs(np.ptp(stop.points_m[:, 1]) - 3.1) < 0.5
    area = cv2.contourArea(crosswalk.points_m[:, :2].astype(np.float32))
    assert abs(crosswalk.width_m - 4) < 0.5
    assert abs(area - 4 * 14.5) < 6
    assert abs(cv2.contourArea(other.points_m[:, :2].astype(np.float32)) - 1.0) < 0.25


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


def log_odds_of_line(pieces: Pieces, painted_m: float, *, dashes: int, bars: bool = False) -> float:
    return weighted_sum(
        evidence_of_line(pieces, painted_m, dashes=dashes, bars=bars),
        WEIGHTS[table_of(pieces, "crosswalk" if bars else "line")],
    )


def test_rings_that_return_what_the_road_does_are_no_paint() -> None:
    """Without a camera: rings between darker ones stand out as much as paint beside the road."""
    each = {"reflected": 0.9, "reflected_sigma": 0.05, "width_m": 0.55, "color": np.nan, "beside_road": 0.0}
    rings, paint = (
        no_pieces(6, **{name: np.full(6, value) for name, value in (each | own).items()})
        for own in ({"above_road": 0.0, "resolved": 0.3}, {"above_road": 0.9, "resolved": 1.0})
    )
    assert log_odds_of_line(rings, 14.0, dashes=12, bars=True) < 0 < log_odds_of_line(paint, 14.0, dashes=12, bars=True)


@pytest.mark.parametrize("change", [None, wet_glare], ids=["wet", "glare"])
def test_wet_paint_returns_little_and_glare_nothing(change) -> None:
    painter = Painter(EXTENT)
    truth = road(painter)
    if change:
        change(painter)
    precision, recall, _ = compare(find_markings(painter.ground(reflects=0.015, noise=0.01))[0], truth)
    assert precision >= 0.95
    assert recall >= 0.8


def test_how_much_paint_returns_is_weighed_where_few_lines_leave_it_open() -> None:
    """Lines that return as wet paint does make each other likelier one by one; bright seams of a dry road do not."""
    seen = {"color": 0.4, "reflected_sigma": 0.01, "width_m": 0.12, "outshines": 0.4}

    def line(reflected: float) -> Pieces:
        return no_pieces(6, **{k: np.full(6, v) for k, v in (seen | {"reflected": reflected, "resolved": 1.0}).items()})

    wet, dry = line(0.1), line(0.8)
    shares = [log_probabilities_of_shares([(wet, 12.0, 1)] * k + [(line(0.0), 12.0, 1)]) for k in range(5)]
    odds = [by_lidar(wet, of) for of in shares]
    assert odds == sorted(odds)
    assert by_lidar(wet) < 0 < odds[0] < odds[-1]
    np.testing.assert_allclose([np.exp(of).sum() for of in shares], 1.0)
    # Between what it is on a dry road and with the share that fits it best, as long as that is open.
    alone = [by_lidar(wet, np.where(np.arange(len(shares[0])) == k, 0.0, -np.inf)) for k in range(len(shares[0]))]
    assert alone[-1] < odds[0] < max(alone)
    on_dry = log_probabilities_of_shares([(dry, 12.0, 1)] * 3 + [(line(0.0), 12.0, 1)])
    assert by_lidar(line(0.0), on_dry) == pytest.approx(by_lidar(line(0.0)), abs=1e-3)


def test_lidar_says_nothing_of_paint_that_its_points_miss() -> None:
    seen = {"color": 0.4, "reflected": 0.0, "reflected_sigma": 0.05, "width_m": 0.12, "outshines": 0.4}
    seen |= {"beside_road": 0.0, "above_road": 0.0}

    def odds(**more: float) -> float:
        return log_odds_of_line(no_pieces(6, **{k: np.full(6, v) for k, v in (seen | more).items()}), 12.0, dashes=1)

    missed = no_pieces(6, **{k: np.full(6, v) for k, v in (seen | {"resolved": 0.0}).items()})
    assert by_lidar(missed) == pytest.approx(0.0, abs=1e-9)
    assert odds(resolved=0.0) > odds(resolved=0.5) > odds(resolved=1.0)


def test_to_a_lidar_alone_narrow_lines_beside_a_road_are_paint_and_rings_on_grass_are_not() -> None:
    each = {"reflected": 0.6, "reflected_sigma": 0.05, "width_m": 0.15, "color": np.nan, "above_road": 0.6}

    def odds(**more: float) -> float:
        pieces = no_pieces(
            8, **{name: np.full(8, value) for name, value in (each | {"beside_road": 0.0} | more).items()}
        )
        return log_odds_of_line(pieces, 24.0, dashes=8)

    assert odds() > 0 > max(odds(beside_road=0.4), odds(width_m=0.5))


@pytest.mark.parametrize("lidar", [True, False])
def test_a_fainter_line_beside_another_is_what_is_left_of_it(lidar: bool) -> None:
    """Removed paint beside the new one; two that are as bright as each other are the lines of a path for bicycles."""

    def found(shade: int, reflects: float) -> list[float]:
        painter = Painter(EXTENT)
        painter.lines([line_of(lambda x: 0 * x, 0, 50)])
        beside = painter.cover([outline_of(line_of(lambda x: 0 * x + 1.2, 0, 50), 0.14)])
        painter.lay(beside, (shade,) * 3, reflects=reflects)
        markings = find_markings(painter.ground(lidar=lidar))[0]
        return sorted(round(float(m.points_m[:, 1].mean()), 1) for m in markings)

    assert found(WHITE[0], 1.0) == [0.0, 1.2]
    assert found(ASPHALT[0] + 20, 0.15) == [0.0]


def test_two_solid_lines_before_and_behind_a_junction_are_no_dashes() -> None:
    assert [s.kind for s in stretches_of(np.array([[0.0, 5.0], [15.6, 20.0]]))] == ["solid", "solid"]
    assert [s.kind for s in stretches_of(np.array([[0.0, 3.0], [9.0, 12.0]]))] == ["dashed"]


def test_dashes_that_a_camera_sees_blurred_are_no_symbols() -> None:
    painter = Painter(EXTENT)
    painter.lines([np.array([[x, 0.0], [x + 3.0, 0.0]]) for x in (3.0, 9.0, 15.0)], 0.15)
    ground = painter.ground(lidar=False)
    blurred = cv2.GaussianBlur(ground.color_bgr, (0, 0), sigmaX=10.0, sigmaY=2.0)
    assert [m.kind for m in find_markings(replace(ground, color_bgr=blurred))[0]] == ["dashed"]


@pytest.mark.parametrize("half_m", [1.3, 1.75, 2.6, 3.5])
def test_what_lies_in_the_middle_of_a_lane_is_no_lane_line(half_m: float) -> None:
    """Strokes between two lines, within a lane as arrows whose heads do not show, or between two lanes."""
    painter = Painter(EXTENT)
    painter.lines([line_of(lambda x, y=y: 0 * x + y, 0, 50) for y in (-half_m, half_m)])
    painter.lines([np.array([[x, 0.0], [x + 4.0, 0.0]]) for x in (5.0, 17.0, 29.0)], 0.2)
    lines = [m for m in find_markings(painter.ground())[0] if m.is_lane_line]
    assert sorted(m.kind for m in lines) == ["dashed"] * (half_m > 2) + ["solid"] * 2


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


@pytest.mark.parametrize(("curb_m", "inset_m"), [(0.0, None), (0.12, None), (0.0, 0.65), (0.0, 0.2)])
def test_borders_are_where_the_road_ends(curb_m: float, inset_m: float | None) -> None:
    """`inset_m`: of lines along the sides, which are paint on the road and none of its ends."""
    painter = Painter(EXTENT, base=GRASS)
    carriageway = painter.cover([outline_of(line_of(bend, -1, 51), 8.0)])
    painter.lay(carriageway, ASPHALT)
    painter.height += curb_m * (carriageway < 0.5)
    painter.paint -= 0.2 * (carriageway < 0.5)
    painter.lines([line_of(bend, 0, 50)])
    if inset_m is not None:
        sides = [line_of(lambda x, s=s: bend(x) + s * (4 - inset_m), 0, 50) for s in (-1, 1)]
        painter.lines(sides, width_m=0.3 if inset_m > 0.5 else 0.15)
    _, borders, notes = find_markings(painter.ground())
    truth = [line_of(lambda x, s=side: bend(x) + s * 4 * np.sqrt(1 + (0.004 * x) ** 2), 0, 50) for side in (-1, 1)]
    assert {b.kind for b in borders} == {"curb" if curb_m else "edge"}
    found = np.concatenate([dense(border.points_m[:, :2]) for border in borders])
    off = cKDTree(np.concatenate([dense(line) for line in truth])).query(found)[0]
    assert off.max() < 0.4
    assert np.median(off) < 0.15
    assert np.mean(cKDTree(found).query(np.concatenate([dense(line) for line in truth]))[0] < 0.4) > 0.7
    assert not any("no borders" in note for note in notes)


def dashes(dash_m: float, gap_m: float, *spans: tuple[float, float]) -> np.ndarray:
    """Strokes of a dashed line that is painted within spans alone."""
    begin = np.arange(0.0, 200.0, dash_m + gap_m)
    return np.array([(b, b + dash_m) for b in begin if any(low <= b and b + dash_m <= high for low, high in spans)])


@pytest.mark.parametrize(("dash_m", "gap_m"), [(3.0, 3.0), (1.5, 4.5), (6.0, 12.0), (3.0, 9.0)])
def test_dashed_lines_end_at_a_junction_and_not_at_their_own_gaps(dash_m: float, gap_m: float) -> None:
    (whole,) = stretches_of(dashes(dash_m, gap_m, (0.0, 120.0)))
    assert whole.kind == "dashed"
    far = max(14.0, 4 * gap_m)
    parts = stretches_of(dashes(dash_m, gap_m, (0.0, 70.0), (70.0 + far, 200.0)))
    assert len(parts) == 2
    assert all(part.kind == "dashed" for part in parts)
    assert parts[0].end_m <= 70.0
    assert parts[1].begin_m >= 70.0 + far
    one_worn_away = np.delete(dashes(dash_m, gap_m, (0.0, 120.0)), 3, axis=0)
    if 2 * gap_m + dash_m < 10.0 or 2 * gap_m + dash_m <= 3 * gap_m:
        assert len(stretches_of(one_worn_away)) == 1


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
