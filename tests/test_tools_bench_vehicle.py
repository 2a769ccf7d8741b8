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


@pytest.mark.parametrize("model", ["single-track", "kinematic"])
@pytest.mark.parametrize("index", range(4))
def test_steps_of_20_ms_are_within_a_centimeter_one_by_one_and_known_ahead(model: str, index: int) -> None:
    from benchmarks.vehicle import CASES, kinematic_rates, known_ahead, single_track_rates, solved, stepped

    case = CASES[index]
    rates = kinematic_rates(case) if model == "kinematic" else single_track_rates(case, 0.0)
    exact = solved(rates, case, model, "LSODA", 1e-9)
    each = stepped(case, model, 0.02, 1)
    assert np.hypot(*(each - exact).T).max() < 0.01
    assert np.ptp(exact[:, 1]) > 0.1
    np.testing.assert_allclose(known_ahead(case, model, 0.02), each, atol=1e-9)
    np.testing.assert_allclose(stepped(case, model, 0.02, 3), each, atol=1e-12)


def test_speed_is_compared_at_the_same_error() -> None:
    from benchmarks.vehicle import Row, faster

    peer = [Row("m", "c", "LSODA", str(e), e, ms) for e, ms in ((1e-2, 1.0), (1e-4, 4.0))]
    assert faster(peer, Row("m", "c", "ours", "", 1e-3, 0.5), "LSODA") == pytest.approx(4.0)
    assert faster(peer, Row("m", "c", "ours", "", 1e-5, 0.5), "LSODA") is None
    assert faster(peer, Row("m", "c", "ours", "", None, 0.5), "LSODA") is None
