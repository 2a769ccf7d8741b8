"""Maps too large to be drawn at once: their parts show what the whole one shows."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from ground_worlds import World, empty_scenario, world_log
from hypothesis import given, settings
from hypothesis import strategies as st
from painted_ground import Painter
from test_lane_markings import compare, road

from log2sim.config import MapConfig
from log2sim.datatypes import Log, MapFeatures, Marking, Scenario
from log2sim.geometry import Array, PoseTrack
from log2sim.road import map_parts
from log2sim.road.builder import GroundMapBuilder
from log2sim.road.ground_map import GroundMap
from log2sim.road.map_parts import OVERLAP_M, Part, join_parts, parts_of
from log2sim.road.markings import find_markings


def cut_out(ground: GroundMap, part: Part) -> GroundMap:
    xy = ground.raster.xy_of(*np.mgrid[: ground.alpha.shape[0], : ground.alpha.shape[1]])
    x0, x1, y0, y1 = part.area_m
    return ground.around((xy[..., 0] > x0) & (xy[..., 0] < x1) & (xy[..., 1] > y0) & (xy[..., 1] < y1))


def test_lines_of_a_road_in_three_parts_are_as_whole_as_in_one() -> None:
    painter = Painter((0.0, 110.0, -10.0, 38.0))
    truth, edges = road(painter), (0.0, 35.0, 72.0, 110.0)
    ground = painter.ground(lidar=False)
    parts = [
        Part((max(a - OVERLAP_M, 0), min(b + OVERLAP_M, 110), -10, 38), (a, b, -10, 38)) for a, b in pairwise(edges)
    ]
    found = [MapFeatures(*find_markings(cut_out(ground, part))[:2]) for part in parts]
    joined, whole = join_parts(parts, found), find_markings(ground)[0]
    precision, recall, error = compare(joined.markings, truth)
    assert min(precision, recall) > 0.97
    assert error < 0.03
    assert {m.kind for m in joined.markings} == {m.kind for m in whole}
    assert len(joined.markings) <= len(whole) + 1  # a dash alone at the end of a part may be left out
    assert len({m.id for m in joined.markings}) == len(joined.markings)


def line(points_m: Array, kind: str = "solid", confidence: float = 0.9) -> Marking:
    return Marking(
        "any", kind, np.column_stack([points_m, np.zeros(len(points_m))]), 0.15, None, confidence, ("lidar",)
    )


CORES = [(40.0 * k, 40.0 * (k + 1), -20.0, 20.0) for k in range(4)]


@given(
    bend=st.floats(-0.003, 0.003), slope=st.floats(-0.1, 0.1), apart=st.floats(0.3, 4.0),
    flips=st.lists(st.booleans(), min_size=8, max_size=8), seed=st.integers(0, 99),
)  # fmt: skip
@settings(max_examples=40, deadline=None)
def test_stretches_of_a_line_are_joined_in_order_and_those_of_another_kind_or_beside_are_not(
    bend: float, slope: float, apart: float, flips: list[bool], seed: int
) -> None:
    rng, x = np.random.default_rng(seed), np.arange(-5.0, 166.0)
    found = []
    for k, (x0, x1, *_) in enumerate(CORES):
        own = x[(x > x0 - OVERLAP_M) & (x < x1 + OVERLAP_M)]
        lines = []
        for n, shift in enumerate((0.0, apart)):
            y = bend * (own - 80) ** 2 + slope * own + shift + rng.uniform(-0.05, 0.05)
            points = np.column_stack([own, y])
            kind = "dashed" if n == 1 and k == 3 else "solid"
            lines.append(line(points[::-1] if flips[2 * k + n] else points, kind, 0.8 + 0.05 * n))
        found.append(MapFeatures(tuple(lines)))
    parts = [Part(core, core) for core in CORES]
    joined = join_parts(parts, found).markings
    ends = sorted((m.kind, *sorted(np.round(m.points_m[[0, -1], 0]).tolist())) for m in joined)
    if all(abs(m.points_m[:, 1]).max() < 20 for m in joined):
        assert ends == [("dashed", 120.0, 160.0), ("solid", 0.0, 120.0), ("solid", 0.0, 160.0)]
    for m in joined:
        step = np.diff(m.points_m[:, 0])
        assert (step > 0).all() or (step < 0).all()
        off = m.points_m[:, 1] - bend * (m.points_m[:, 0] - 80) ** 2 - slope * m.points_m[:, 0]
        assert np.ptp(off) < 0.2


def drive(path: Array) -> tuple[Log, Scenario]:
    log = world_log(World())
    poses = np.tile(np.eye(4), (len(path), 1, 1))
    poses[:, :2, 3] = path
    log = replace(log, ego=PoseTrack(np.arange(len(path), dtype=np.int64) * 10**8, poses))
    return log, replace(empty_scenario(log), t0_ns=0, duration_s=len(path) / 10)


@pytest.mark.parametrize("cell_m", [0.05, 0.1])
def test_parts_hold_all_that_is_near_the_path_once_and_are_small(cell_m: float) -> None:
    rng = np.random.default_rng(3)
    path = np.cumsum(np.cumsum(rng.normal(0, 0.1, (900, 2)), axis=0).clip(-1.5, 1.5), axis=0)
    parts = parts_of(*drive(path), cell_m)
    (whole,) = parts_of(*drive(path), 10.0)
    assert whole.area_m == whole.core_m
    assert len(parts) > 3
    around = (path[:, None] + rng.uniform(-20, 20, (900, 20, 2))).reshape(-1, 2)
    x, y, count = *around.T, np.zeros(len(around), int)
    for part in parts:
        (x0, x1, y0, y1), (a0, a1, b0, b1) = part.core_m, part.area_m
        core = (x >= x0) & (x < x1) & (y >= y0) & (y < y1)
        assert ((x >= a0) & (x <= a1) & (y >= b0) & (y <= b1))[core].all()
        count += core
        assert (a1 - a0) * (b1 - b0) <= (map_parts.PART_CELLS * cell_m) ** 2
    assert (count == 1).all()


def test_a_part_is_drawn_as_it_is_in_the_whole_map() -> None:
    log = world_log(World(lidars=2))
    scenario, cells = empty_scenario(log), MapConfig(cell_m=0.1)
    whole = GroundMapBuilder(log, scenario, cells).build()
    part = GroundMapBuilder(log, scenario, cells, area_m=(2.0, 12.0, -8.0, 8.0)).build()
    rows, columns = (np.rint(at).astype(int) for at in whole.raster.cells_of(part.raster.xy_of(0, 0)))
    same = np.s_[rows[0] : rows[0] + part.alpha.shape[0], columns[0] : columns[0] + part.alpha.shape[1]]
    both = np.isfinite(part.height_m) & np.isfinite(whole.height_m[same])
    assert both.sum() > 10_000
    assert np.quantile(np.abs(part.height_m - whole.height_m[same])[both], 0.95) < 0.02
