"""tools/profile_ticks.py: its figures."""

from __future__ import annotations

import sys
from pathlib import Path

from log2sim.datatypes import Log

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))
import profile_ticks
from profile_ticks import Measured, Times


def test_figures_are_medians_a_tick_and_ratios_to_the_floor_of_one_thread() -> None:
    def run(cpu_s: float) -> Measured:
        stages = {"poses": Times(0.1, 0.1 * cpu_s), "detect": Times(1.0, 0.5 * cpu_s), "lanes": Times(0.1, 0.2 * cpu_s)}
        return Measured(Times(cpu_s / 2, cpu_s), 10, 40.0, stages)

    log = Log("some", "test", {}, {}, {})
    found = profile_ticks.figures(
        log, "labels", [run(1.0), run(9.0), run(2.0)], {1: [Times(0.5, 0.5)], 2: [Times(0.3, 0.6)]}
    )
    assert (found["cpu_ms"], found["wall_ms"], found["ticks_per_second"]) == (200.0, 100.0, 10.0)
    assert found["detector_cpu_ms"] == 100.0
    assert (found["cpu_over_floor"], found["without_detector_over_floor"]) == (4.0, 2.0)
    assert found["stages_ms"]["detect"] == {"wall": 100.0, "cpu": 100.0}
    # Of 2 s, half go to ticks, a fifth to 40 m of way, the rest to the log as a whole.
    assert (found["cpu_of_log_s"], found["cpu_of_tick_ms"], found["cpu_of_100_m_s"]) == (0.6, 100.0, 1.0)
    text = profile_ticks.show([found])
    assert "| some | `labels` | 10 | 10.00 | 100 | 200 | 0.60 | 100 | 1.0 | 100 | 50 | 30 | 4.00 | 2.00 |" in text
