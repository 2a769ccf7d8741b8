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
