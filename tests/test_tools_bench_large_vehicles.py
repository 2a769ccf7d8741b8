"""Long vehicles close by are found where they are: scenes of the benchmark of large vehicles, from exact boxes."""

from __future__ import annotations

from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

TOOLS = Path(__file__).resolve().parents[1] / "tools"


@pytest.fixture(autouse=True)
def _tools_on_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(TOOLS))


@pytest.mark.slow
def test_a_minibus_at_the_curb_neither_slides_nor_turns_nor_grows() -> None:
    from benchmarks.large_vehicles import measured

    (found,) = next(measured(["minibus"], ["curb"], "labels", 0))
    assert found.recall == 1.0
    assert found.position_m is not None
    assert found.position_m < 0.3
    assert found.yaw_deg is not None
    assert found.yaw_deg < 3.0
    assert found.speed_mps == 0.0
    assert found.length_m is not None
    assert abs(found.length_m) < 0.5
    assert found.width_m is not None
    assert abs(found.width_m) < 0.3
