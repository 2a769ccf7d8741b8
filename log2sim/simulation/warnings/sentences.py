"""Warnings in plain sentences."""

from __future__ import annotations

from log2sim.datatypes import EGO
from log2sim.simulation.warnings.warning import CollisionWarning, Warnings

MAX_LISTED = 5

_ENDS = {"vehicle": "the vehicle's sensors", "road": "the road's sensors", "both": "the sensors of vehicle and road"}


def describe_warnings(warnings: Warnings) -> str:
    """Say how many warnings there are, and describe the first ones."""
    whose = (
        _ENDS[warnings.ends] if warnings.tells_ends else "all sensors, which the scenario does not distinguish by end"
    )
    others = "agents" if any(w.driver != EGO for w in warnings.events) else "other agents"
    lines = [
        f"{count_warnings(warnings)} in {warnings.driven_s:.1f} s of driving, by {whose}: they know {warnings.known_agents} of {warnings.agents} {others}"
    ]
    lines += [f"  {describe_warning(w, warnings)}" for w in warnings.events[:MAX_LISTED]]
    if len(warnings.events) > MAX_LISTED:
        lines.append(f"  and {len(warnings.events) - MAX_LISTED} more")
    return "\n".join(lines)


def count_warnings(warnings: Warnings) -> str:
    """Say how many warnings there are, and how many collisions nothing was predicted of."""
    warned = sum(w.warned is not None for w in warnings.events)
    missed = len(warnings.events) - warned
    text = f"{warned or 'no'} warning{'s' * (warned != 1)}"
    return text if not missed else f"{text} and {missed} collision{'s' * (missed != 1)} without"


def describe_warning(warning: CollisionWarning, warnings: Warnings) -> str:
    """Describe a warning: when, how soon and how far off the collision is, whether braking suffices, and since when it is known."""
    parts = [describe_briefly(warning) + ".", _braking(warning, warnings), _known(warning)]
    if warning.warned is not None and warning.collision_s is not None:
        parts.append(f"They collide at {warning.collision_s:.2f} s.")
    return " ".join(part for part in parts if part)


def describe_briefly(warning: CollisionWarning) -> str:
    """Say who is warned of, when, and how soon and how far off the collision is."""
    at = warning.warned
    if at is None or warning.ttc_s is None:
        return f"{_pair(warning)}: no warning before the collision at {warning.begin_s:.2f} s"
    return (
        f"{_pair(warning)}: warning at {at.t_s:.2f} s, collision in {warning.ttc_s:.2f} s with probability "
        f"{warning.probability:.2f}, {at.distance_m:.1f} m apart"
    )


def _pair(warning: CollisionWarning) -> str:
    return warning.agent if warning.driver == EGO else f"{warning.driver} and {warning.agent}"


def _braking(warning: CollisionWarning, warnings: Warnings) -> str:
    at = warning.warned
    if at is None or warning.way_m is None:
        return ""
    verdict = "braking suffices" if warning.braking_suffices else "braking comes too late"
    needed = "" if warning.needed_mps2 is None else f", {warning.needed_mps2:.1f} m/s2 would be needed"
    driver = "The ego" if warning.driver == EGO else warning.driver
    return (
        f"{driver} drives {at.ego_speed_mps * 3.6:.0f} km/h, {warning.way_m:.1f} m from the collision, and stands after "
        f"{at.stopping_m:.1f} m ({warnings.reaction_s:g} s to react, then {warnings.brake_mps2:g} m/s2): {verdict}{needed}."
    )


def _known(warning: CollisionWarning) -> str:
    """Say since when the agent is known, and to which end alone."""
    in_order = sorted(warning.known_by.items(), key=lambda e: e[1])
    ends = "; ".join(f"to the {end} alone from {t_s:.2f} s" for end, t_s in in_order)
    since = (
        "Never known"
        if warning.known is None
        else f"Known since {warning.known.t_s:.2f} s, {warning.known.distance_m:.1f} m away"
    )
    return f"{since} ({ends})." if ends else f"{since}."
