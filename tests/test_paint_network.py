"""The network of markings: its inputs, its maps, and the crops that it is trained on."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from painted_ground import GRASS, Painter, line_of, outline_of

from log2sim.datatypes import MapFeatures, Marking, RoadBorder
from log2sim.road.ground_map import GroundMap
from log2sim.road.paint_network import MARGIN_CELLS, TILE_CELLS, find_crests, find_paint_maps, inputs_of


def two_lanes(length_m: float = 40.0, cell_m: float = 0.05) -> Painter:
    painter = Painter((0.0, length_m, -8.0, 8.0), cell_m)
    painter.lines([line_of(lambda x, y=y: y + 0 * x, 0, length_m) for y in (-3.5, 0.0, 3.5)], 0.15)
    return painter


def test_inputs_are_relative_to_what_is_around() -> None:
    ground = two_lanes().ground(grain=0.0, noise=0.0)
    layers = ground.color_bgr, ground.alpha, ground.intensity, ground.height_m
    values = inputs_of(*layers)
    assert values.shape == (12, 160, 400)
    # A map of one color has none, and a slope of the ground hardly any.
    plain = inputs_of(np.full_like(ground.color_bgr, 90), *layers[1:])
    assert np.abs(plain[:5]).max() < 1e-5
    tilted = inputs_of(
        *layers[:3],
        ground.height_m + 0.05 * ground.raster.xy_of(*np.indices(ground.alpha.shape))[..., 0].astype(np.float32),
    )
    assert np.abs(tilted[10, 20:-20, 20:-20] - values[10, 20:-20, 20:-20]).max() < 1e-3
    # Half the light changes values by what is added to them before the logarithm alone.
    darker = inputs_of((ground.color_bgr // 2).astype(np.uint8), *layers[1:])
    np.testing.assert_allclose(darker[:4], values[:4], atol=0.06)
    nothing = inputs_of(ground.color_bgr, 0 * ground.alpha, np.nan * ground.intensity, np.nan * ground.height_m)
    assert not nothing.any()


@pytest.mark.parametrize("cell_m", [0.025, 0.05, 0.1])
def test_lines_are_where_they_are_in_maps_of_any_cells(cell_m: float) -> None:
    ground = two_lanes(cell_m=cell_m).ground()
    maps = find_paint_maps(ground)
    assert maps.raster.resolution_m == pytest.approx(0.1)
    crests = find_crests(maps, maps.lane_line, 0.5)
    inside = (crests.xy_map[:, 0] > 3) & (crests.xy_map[:, 0] < 37)
    away = np.abs(crests.xy_map[inside, 1, None] - [-3.5, 0.0, 3.5])
    assert np.median(away.min(axis=1)) < 0.05
    assert (np.bincount(away.argmin(axis=1)) > 250).all()
    turn = (crests.direction[inside] + np.pi / 2) % np.pi - np.pi / 2
    assert np.median(np.abs(turn)) < 0.1


def test_tiles_do_not_show_and_what_nobody_saw_holds_nothing() -> None:
    length_m = 0.1 * (TILE_CELLS + 2 * MARGIN_CELLS)
    ground = two_lanes(length_m).ground()
    whole, seam = find_paint_maps(ground), TILE_CELLS
    first = int(2 * (seam - MARGIN_CELLS))
    part = find_paint_maps(_cut(ground, first))
    both = slice(seam, seam + MARGIN_CELLS), slice(MARGIN_CELLS, 2 * MARGIN_CELLS)
    assert np.abs(whole.lane_line[:, both[0]] - part.lane_line[:, both[1]]).max() < 0.1
    hidden = replace(ground, alpha=0 * ground.alpha, intensity=np.nan * ground.intensity)
    assert not find_paint_maps(hidden).probability.any()


def _cut(ground: GroundMap, first: int) -> GroundMap:
    """Leave out columns of a map."""
    x0, x1, y0, y1 = ground.extent_m
    layers = (layer[:, first:] for layer in (ground.color_bgr, ground.alpha, ground.height_m, ground.intensity))
    return GroundMap(*layers, ground.resolution_m, (x0 + first * ground.resolution_m, x1, y0, y1))


def test_crops_say_of_each_cell_what_is_painted_there_at_any_angle(monkeypatch: pytest.MonkeyPatch) -> None:
    from fits.line_maps import EVERYWHERE, RoadMap
    from training import map_crops

    for name in ("MORE_LINES", "MORE_SHAPES"):
        monkeypatch.setattr(map_crops, name, 0.0)

    painter = Painter((0.0, 60.0, -30.0, 30.0), base=GRASS)
    painter.lay(painter.cover([outline_of(line_of(lambda x: 0 * x, -1, 61), 12.0)]), (92, 91, 90))
    painter.lines([line_of(lambda x: 0.2 * (x - 30), 0, 60)], 0.3)
    xy = line_of(lambda x: 0.2 * (x - 30), 0, 60, 5.0)
    edges = tuple(RoadBorder(f"{y}", "edge", np.array([[0.0, y, 0.0], [60.0, y, 0.0]]), 1.0) for y in (-6.0, 6.0))
    true = MapFeatures((Marking("one", "solid", np.column_stack([xy, 0 * xy[:, 0]]), 0.3),), edges)
    road, rng = RoadMap(painter.ground(), true, EVERYWHERE), np.random.default_rng(3)
    crops = [crop for _ in range(12) if (crop := map_crops.draw_crop(road, rng)) is not None]
    shown, turned = 0, []
    for crop in crops:
        paint, there = crop.values[:4].astype(np.float32).mean(axis=0), crop.kind == 1
        seen = crop.values[5] > 0.5
        if (there & seen).sum() < 100:
            continue
        shown += 1
        near = (
            (cv2.dilate(there.astype(np.uint8), np.ones((9, 9))) > 0)
            & ~(cv2.dilate(there.astype(np.uint8), np.ones((5, 5))) > 0)
            & seen
        )
        assert np.median(paint[there & seen]) > np.median(paint[near]) + 0.1
        twice = np.arctan2(*crop.line[1::-1, there].astype(np.float64)) / 2
        # The direction that is told is that along which the labeled cells lie.
        rows, columns = np.nonzero(there)
        along = np.linalg.eigh(np.cov(columns, rows))[1][:, 1]
        turned.append(np.abs(np.cos(twice) * along[0] + np.sin(twice) * along[1]).mean())
        assert crop.line[2, there].astype(np.float64).mean() == pytest.approx(0.3, abs=1e-3)
    assert shown >= 5
    assert np.mean(turned) > 0.98


@pytest.mark.parametrize("what", ["MORE_SHAPES", "MORE_LINES", "MORE_ROADS"])
def test_what_is_added_to_plain_ground_is_labeled_where_it_is(monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    from fits.line_maps import EVERYWHERE, RoadMap
    from training import map_crops

    for name in ("MORE_SHAPES", "MORE_LINES", "MORE_ROADS"):
        monkeypatch.setattr(map_crops, name, float(name == what))
    drawn = []
    monkeypatch.setattr(map_crops, "_disturb", lambda layers, *_: drawn.append(layers) or layers)
    road = RoadMap(Painter((0.0, 60.0, -30.0, 30.0)).ground(grain=0.0, noise=0.0), MapFeatures(), EVERYWHERE)
    rng, labeled = np.random.default_rng(5), 0
    crops = [crop for _ in range(12) if (crop := map_crops.draw_crop(road, rng)) is not None]
    for crop, layers in zip(crops, drawn, strict=True):
        bright, seen = layers.log_color[..., 1], cv2.erode(layers.alpha, np.ones((9, 9), np.uint8)) > 0
        painted = (np.abs(bright - np.median(bright[seen])) > 0.08) & seen
        painted = painted.reshape(256, 2, 256, 2).any(axis=(1, 3))
        label = (crop.kind > 0) | (crop.border > 0)
        labeled += label.any()
        near = cv2.dilate(label.astype(np.uint8), np.ones((7, 7) if what != "MORE_ROADS" else (15, 15))) > 0
        if what == "MORE_ROADS":
            # Between its borders, and beyond them, the ground is of one brightness.
            _, parts = cv2.connectedComponents((~near & seen[::2, ::2]).astype(np.uint8))
            assert not crop.kind.any()
            assert all(np.std(bright[::2, ::2][parts == k]) < 0.03 for k in range(1, parts.max() + 1))
        else:
            assert not crop.border.any()
            assert not (painted & ~near).any()
    assert labeled >= 4
