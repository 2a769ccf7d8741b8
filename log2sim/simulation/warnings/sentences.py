"""Warnings in plain sentences."""

from __future__ import annotations

from log2sim.simulation.warnings.warning import CollisionWarning, Warnings

MAX_LISTED = 5

_ENDS = {"vehicle": "the vehicle's sensors", "road": "the road's sensors", "both": "the sensors of vehicle and road"}


def describe_warnings(warnings: Warnings) -> str:
    """Say how many warnings there are, and describe the first ones."""
    warned = [w for w in warnings.events if w.warned is not None]
    whose = (
        _ENDS[warnings.ends] if warnings.tells_ends else "all sensors, which the scenario does not tell apart by end"
    )
    count = f"{len(warned) or 'no'} warning{'s' * (len(warned) != 1)}"
    lines = [f"{count} in {warnings.driven_s:.1f} s of driving, by {whose}"]
    lines += [f"  {describe_warning(w, warnings)}" for w in warnings.events[:MAX_LISTED]]
    if len(warnings.events) > MAX_LISTED:
        lines.append(f"  and {len(warnings.events) - MAX_LISTED} more")
    return "\n".join(lines)


def describe_warning(warning: CollisionWarning, warnings: Warnings) -> str:
    """Describe a warning: when, how soon and how far off the collision is, whether braking suffices, and since when it is known."""
    parts = [_warned(warning, warnings), _known(warning)]
    if warning.collision_s is not None:
        parts.append(f"They collide at {warning.collision_s:.2f} s.")
    return " ".join(parts)


def _warned(warning: CollisionWarning, warnings: Warnings) -> str:
    at = warning.warned
    if at is None or warning.ttc_s is None or warning.way_m is None:
        return f"{warning.agent}: no warning."
    needs = "" if warning.needed_mps2 is None else f", for which {warning.needed_mps2:.1f} m/s2 would be needed"
    verdict = f"braking suffices{needs}" if warning.braking_suffices else f"braking does not suffice{needs}"
    return (
        f"{warning.agent}: warning at {at.t_s:.2f} s, collision in {warning.ttc_s:.2f} s with probability "
        f"{warning.probability:.2f}, {at.distance_m:.1f} m apart. At {at.ego_speed_mps * 3.6:.0f} km/h the ego gets there in "
        f"{warning.way_m:.1f} m and stands after {at.stopping_m:.1f} m ({warnings.reaction_s:g} s, then "
        f"{warnings.brake_mps2:g} m/s2): {verdict}."
    )


def _known(warning: CollisionWarning) -> str:
    ends = ", ".join(
        f"by the {end} alone at {t_s:.2f} s" for end, t_s in sorted(warning.known_by.items(), key=lambda e: e[1])
    )
    if warning.known is None:
        return f"Never known by them{f'; {ends}' if ends else ''}."
    return f"Known since {warning.known.t_s:.2f} s, {warning.known.distance_m:.1f} m away{f'; {ends}' if ends else ''}."
