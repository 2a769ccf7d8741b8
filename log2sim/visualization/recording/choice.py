"""Which records of a log a page takes: those within the scenario, at a rate that its budget allows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Scenario
from log2sim.errors import ConfigError, LogError
from log2sim.geometry import NS_PER_S, Camera, nearest_index, period_of

MARGIN_S = 0.05
"""Records this far outside the scenario are taken too: half a tick of most logs."""

BACK_RAD = np.radians(150.0)
"""Cameras that are turned farther from the front than this look back."""


def choose_cameras(log: Log, scenario: Scenario, asked: tuple[str, ...] = ()) -> tuple[str, ...]:
    """Return the cameras to show, from left to right: those asked for, else those that the scenario was made with, else all.

    Raises
    ------
    ConfigError
        For a camera that the log does not have.
    """
    unknown = [name for name in asked if name not in log.cameras]
    if unknown:
        there = ", ".join(log.cameras) or "none"
        raise ConfigError(f"--cameras: no camera '{unknown[0]}'; the log has: {there}")
    used = tuple(str(c["name"]) for c in scenario.cameras if c.get("used") and c["name"] in log.cameras)
    return tuple(sorted(asked or used or log.cameras, key=lambda name: _place(log.cameras[name])))


def _place(camera: Camera) -> tuple[int, float]:
    """Sort cameras of a vehicle from left to right, then those that look back, then those at the road."""
    x, y = camera.mount_T_cam[:2, 2]
    azimuth = float(np.arctan2(y, x))
    if camera.mount != "ego":
        return 2, 0.0
    return (1 if abs(azimuth) > BACK_RAD else 0), -azimuth


def require_overlap(log: Log, scenario: Scenario) -> None:
    """Require that a log has records during a scenario.

    Raises
    ------
    LogError
        When it has none.
    """
    spans = [(int(s.t_ns[0]), int(s.t_ns[-1])) for s in log.streams.values() if len(s.t_ns)]
    if spans and not any(len(records_within(stream.t_ns, scenario)) for stream in log.streams.values()):
        first, last = min(span[0] for span in spans), max(span[1] for span in spans)
        end_ns = scenario.t0_ns + round(scenario.duration_s * NS_PER_S)
        raise LogError(
            f"{log.name}: its records are from stamp {first} to {last} ns, the scenario '{scenario.name}' from {scenario.t0_ns} "
            f"to {end_ns} ns; choose the log that the scenario was made of"
        )


def records_within(t_ns: NDArray[np.int64], scenario: Scenario) -> NDArray[np.int64]:
    """Return the indices of the records with stamps (F,) during a scenario."""
    margin_ns = round(MARGIN_S * NS_PER_S)
    end_ns = scenario.t0_ns + round(scenario.duration_s * NS_PER_S)
    return np.flatnonzero((t_ns >= scenario.t0_ns - margin_ns) & (t_ns <= end_ns + margin_ns)).astype(np.int64)


def take_at_rate(t_ns: NDArray[np.int64], index: NDArray[np.int64], rate_hz: float, start_ns: int) -> NDArray[np.int64]:
    """Return those of the records `index` (n,) of stamps (F,) that are nearest to the beats of a rate; all of slower sensors.

    Beats count from `start_ns`, so that the cameras of a rig show the same moments.
    """
    if len(index) < 2 or period_of(t_ns[index]) * rate_hz > 0.75:
        return index
    stamps, step_ns = t_ns[index], round(NS_PER_S / rate_hz)
    beats = np.arange(start_ns, stamps[-1] + step_ns // 2, step_ns, dtype=np.int64)
    return index[np.unique(nearest_index(stamps, beats))]


def take_evenly(count: int, most: int) -> NDArray[np.int64]:
    """Return at most `most` of the numbers 0 to `count` - 1, evenly spaced, with the first and the last."""
    if count <= most:
        return np.arange(count, dtype=np.int64)
    return np.unique(np.rint(np.linspace(0, count - 1, max(most, 1))).astype(np.int64))
