"""Warnings as records, as `replay.json` holds them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Self

from log2sim.datatypes import EGO


@dataclass(frozen=True)
class Moment:
    """The ego and another agent at one time.

    Attributes
    ----------
    t_s : float, s
    distance_m : float
        Between the boxes.
    ego_speed_mps : float
    stopping_m : float
        Way of the ego until it stands, with the reaction.
    """

    t_s: float
    distance_m: float
    ego_speed_mps: float
    stopping_m: float


@dataclass(frozen=True)
class CollisionWarning:
    """What is known of an agent on a collision course with the ego, or with another vehicle that is warned in its place.

    Attributes
    ----------
    agent, category : str
    known : Moment or None
        When it is first known; None where it never is.
    known_by : mapping of str to float
        When each end alone knows it first, s; only where both have observed somebody.
    warned : Moment or None
        When it is first warned of; None for a collision that was not predicted.
    probability : float
        Of the collision, at that time.
    ttc_s : float or None, s
        Time to the collision then.
    way_m : float or None, m
        Of the ego until then, at its speed.
    needed_mps2 : float or None, m/s2
        Deceleration with which the ego stands before that place; None where it is too late.
    braking_suffices : bool
        Whether the ego can stand before that place.
    spans_s : tuple of (float, float), s
        While it is warned of.
    collision_s : float or None, s
        When the ego touches it in the replay.
    driver : str
        Who is warned: the ego, or a vehicle of a scenario without one.
    """

    agent: str
    category: str
    known: Moment | None
    known_by: Mapping[str, float] = field(default_factory=dict)
    warned: Moment | None = None
    probability: float = 0.0
    ttc_s: float | None = None
    way_m: float | None = None
    needed_mps2: float | None = None
    braking_suffices: bool = False
    spans_s: tuple[tuple[float, float], ...] = ()
    collision_s: float | None = None
    driver: str = EGO

    @property
    def begin_s(self) -> float:
        """Return when it is first warned of, or the collision."""
        return min([a for a, _ in self.spans_s] + ([] if self.collision_s is None else [self.collision_s]))

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Self:
        """Build a warning from its entry in a document."""
        moments = {k: Moment(**entry[k]) if entry[k] else None for k in ("known", "warned")}
        spans = tuple((float(a), float(b)) for a, b in entry["spans_s"])
        return cls(**{**entry, **moments, "spans_s": spans})


@dataclass(frozen=True)
class Warnings:
    """All warnings of a replay, in order of time.

    Attributes
    ----------
    ends : str
        Whose observations count: "vehicle", "road" or "both".
    tells_ends : bool
        Whether the scenario says which end observed its agents; else what it observed counts.
    horizon_s, min_probability, early_probability, margin_s, reaction_s, brake_mps2 : float
        As in `WarningSettings`.
    agents, known_agents : int
        Agents without the ego, and how many of them the ends get to know.
    driven_s : float, s
        For how long the ego moved, or all together who are warned in its place.
    events : tuple of CollisionWarning
    """

    ends: str
    tells_ends: bool
    horizon_s: float
    min_probability: float
    early_probability: float
    margin_s: float
    reaction_s: float
    brake_mps2: float
    agents: int
    known_agents: int
    driven_s: float
    events: tuple[CollisionWarning, ...] = ()

    def of(self, agent: str) -> CollisionWarning | None:
        """Return the warning of an agent; None without."""
        return next((w for w in self.events if w.agent == agent), None)

    def to_dict(self) -> dict[str, Any]:
        """Return the entry `warnings` of `schemas/replay-1.json`."""
        plain = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "events"}
        events = [
            {**asdict(w), "known_by": dict(w.known_by), "spans_s": [list(s) for s in w.spans_s]} for w in self.events
        ]
        return {**plain, "events": events}

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> Self:
        """Build warnings from an entry that keeps the schema."""
        return cls(**{**document, "events": tuple(CollisionWarning.from_dict(e) for e in document["events"])})
