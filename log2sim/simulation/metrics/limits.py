"""Limits that a replay may break: those of every strict replay, and those that the user gives by name."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from log2sim.errors import CheckFailed, ConfigError
from log2sim.registry import nearest
from log2sim.simulation.metrics.collisions import REPLAY
from log2sim.simulation.metrics.comfort import LIMITS as COMFORT
from log2sim.simulation.metrics.tracking_error import OFF_PATH_M
from log2sim.simulation.result import Replay

LOWER_LIMITS = ("min_ttc_s", "min_pet_s")
UPPER_LIMITS = (
    "cross_track_max_m", "cross_track_rms_m", "along_track_rms_m", "speed_rms_mps", "yaw_rms_rad", "off_path_share",
    *COMFORT,
)  # fmt: skip


def parse_limits(texts: Iterable[str]) -> dict[str, float]:
    """Parse limits by name from texts "name=value".

    Raises
    ------
    ConfigError
        When a name is not known or a value is no finite number.
    """
    limits: dict[str, float] = {}
    for text in texts:
        name, _, value = text.partition("=")
        name = name.strip()
        if name not in LOWER_LIMITS + UPPER_LIMITS:
            known = ", ".join(LOWER_LIMITS + UPPER_LIMITS)
            raise ConfigError(
                f"limit '{text}': no metric '{name}'{nearest(name, [*LOWER_LIMITS, *UPPER_LIMITS])}; known: {known}"
            )
        try:
            limits[name] = float(value)
        except ValueError:
            limits[name] = math.nan
        if not math.isfinite(limits[name]):
            raise ConfigError(f"limit '{text}': expected a number, such as {name}=1.0")
    return limits


def check_limits(replay: Replay, limits: Mapping[str, float]) -> list[str]:
    """Return which of the given limits are broken: by the ego if a policy drives it, else by any agent that moves."""
    driven = [a.id for a in replay.agents if a.driver == "policy"]
    by_agent = replay.metrics["by_agent"]
    broken = []
    for id in driven or by_agent:
        values = by_agent.get(id, {})
        for name, limit in limits.items():
            value = values[name] if name in values else (values.get("comfort") or {}).get(name)
            if value is not None and (value < limit if name in LOWER_LIMITS else value > limit):
                side = "at least" if name in LOWER_LIMITS else "at most"
                broken.append(f"agent '{id}': {name} {value:g}, limit {side} {limit:g}")
    return broken


def check_strict(replay: Replay, limits: Mapping[str, float] | None = None) -> list[str]:
    """Return what breaks a limit of `--strict`: collisions of the replay, large errors, infeasible scenarios.

    Comfort, time to collision and post-encroachment time count only when named in `limits`: what the drivers did in
    the scenario is no failure of a replay.
    """
    broken = [
        f"{' and '.join(e['agents'])} collide at {e['t_s']:.2f} s ({e['relative_speed_mps']:.1f} m/s); the scenario has no such collision"
        for e in replay.metrics["collisions"]
        if e["belongs_to"] == REPLAY
    ]
    for agent in replay.agents:
        if agent.driver in ("policy", "reactive"):
            continue
        worst = replay.metrics["by_agent"].get(agent.id, {}).get("cross_track_max_m", 0.0)
        if worst > OFF_PATH_M:
            broken.append(f"agent '{agent.id}': {worst:.2f} m off its path, limit {OFF_PATH_M:g} m")
        broken += [f"agent '{agent.id}': {flag}" for flag in agent.flags]
    return broken + check_limits(replay, limits or {})


def require_strict(replay: Replay, limits: Mapping[str, float] | None = None) -> None:
    """Raise `CheckFailed` with all broken limits."""
    broken = check_strict(replay, limits)
    if broken:
        raise CheckFailed("the replay breaks limits:\n  " + "\n  ".join(broken))
