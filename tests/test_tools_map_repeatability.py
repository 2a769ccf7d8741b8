"""The measure of how well maps repeat, on worlds whose pictures are shifted by a known distance."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from ground_worlds import World, empty_scenario, world_log

from log2sim.config import MapConfig
from log2sim.road.builder import map_ground
from log2sim.road.ground_map import GroundMap

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))
from benchmarks import map_repeatability as tool

pytestmark = pytest.mark.slow


def mapped(world: World) -> GroundMap:
    log = world_log(world)
    return map_ground(log, empty_scenario(log), MapConfig(cell_m=0.05))


@pytest.fixture(scope="module")
def plain() -> GroundMap:
    return mapped(World())


@pytest.mark.parametrize("shift_m", [0.0, 0.03, 0.1])
def test_an_injected_offset_is_found(plain: GroundMap, shift_m: float) -> None:
    # Pictures from farther left, taken as if from the middle, show everything farther right.
    offsets = tool.measure_offsets(plain, mapped(World(camera_shift_m=shift_m, seed=9)))
    assert offsets is not None
    assert len(offsets.xy) >= 10
    np.testing.assert_allclose(np.median(offsets.vector_m, axis=0), [0.0, -shift_m], atol=0.006)
    assert np.percentile(np.abs(offsets.offset_m - shift_m), 95) < 0.015


def test_intensities_of_independent_noise_lie_on_each_other(plain: GroundMap) -> None:
    offsets = tool.measure_offsets(plain, mapped(World(seed=9)), "intensity")
    assert offsets is not None
    assert len(offsets.xy) >= 10
    assert np.median(offsets.offset_m) < 0.02


def test_heights_of_independent_noise_agree(plain: GroundMap) -> None:
    off = tool.height_differences(plain, mapped(World(seed=9)))
    assert len(off) > 50_000
    assert abs(float(off.mean())) < 0.003
    assert float(np.percentile(np.abs(off), 95)) < 0.05


def test_parts_of_a_log_share_no_record() -> None:
    log = world_log()
    for _, a, b in tool.parts_of(log):
        for name in a.streams:
            assert not set(a.streams[name].t_ns.tolist()) & set(b.streams[name].t_ns.tolist())
        assert np.array_equal(
            a.streams["c0"].read(1),
            log.streams["c0"].read(int(np.searchsorted(log.streams["c0"].t_ns, a.streams["c0"].t_ns[1]))),
        )


def test_ground_without_texture_tells_nothing() -> None:
    nothing = np.zeros((300, 300), np.float32)
    flat = GroundMap(
        np.full((300, 300, 3), 90, np.uint8),
        np.full((300, 300), 255, np.uint8),
        nothing,
        nothing,
        0.05,
        (0.0, 15.0, 0.0, 15.0),
    )
    offsets = tool.measure_offsets(flat, flat)
    assert offsets is not None
    assert len(offsets.xy) == offsets.unlike == 0
