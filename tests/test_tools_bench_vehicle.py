"""The benchmark of vehicle models: its equations are the published ones, and log2sim is within a centimeter at 20 ms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.slow

TOOLS = Path(__file__).resolve().parents[1] / "tools"


@pytest.fixture(autouse=True)
def _tools_on_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(TOOLS))


def test_the_equations_given_to_all_are_the_published_ones() -> None:
    pytest.importorskip("vehiclemodels", reason="needs commonroad-vehicle-models, the published model")
    from benchmarks.vehicle import SWITCH_MPS, Case, single_track_rates
    from vehiclemodels.parameters_vehicle2 import parameters_vehicle2
    from vehiclemodels.vehicle_dynamics_st import vehicle_dynamics_st

    rng, theirs = np.random.default_rng(4), parameters_vehicle2()
    for speed in (0.0, 0.05, 0.2, 3.0, 30.0):
        inputs = rng.uniform(-0.3, 0.3), rng.uniform(-5.0, 2.0)
        state = [*rng.normal(0, 0.1, 3), speed, *rng.normal(0, 0.1, 3)]
        ours = single_track_rates(Case("", 0.0, 0.0, 1.0, lambda t, exp, u=inputs: u), SWITCH_MPS)(0.0, state)
        # Below the switch what moves is compared: their slip follows the steering by a formula of its own there.
        count = 5 if speed < SWITCH_MPS else 7
        expected = vehicle_dynamics_st(state, list(inputs), theirs)
        np.testing.assert_allclose(ours[:count], expected[:count], rtol=1e-9, atol=1e-12)
