"""Tags: what road users of a scenario do, when, and how probable it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

TAGS: Mapping[str, str] = {
    "in_lane": "is in a lane of the map",
    "lane_change": "changes to a lane beside it",
    "turning": "turns by at least 60 degrees, to the left where angle_rad is positive",
    "u_turn": "turns back",
    "starting": "starts from standstill",
    "stopping": "brakes to standstill",
    "standing": "stands; it moves at another time",
    "standing_at_light": "stands before a traffic light that is red or yellow",
    "standing_at_crosswalk": "stands before a crosswalk",
    "hard_braking": "brakes harder than is comfortable",
    "following": "drives behind the other in its lane, about as fast",
    "approaching": "comes nearer to the other, which is ahead in its lane",
    "cut_in": "changes into the lane of the other, ahead of it",
    "cut_out": "leaves the lane of the other, which it was ahead of",
    "merging": "turns into the lane of the other, ahead of it, from another road",
    "overtaking": "passes the other, which moves in the same direction",
    "crossing_path": "crosses the path of the other",
    "turning_across": "turns across the path of the other, which is oncoming",
    "oncoming_in_lane": "comes toward the other in its lane",
    "stepping_out": "walks into the path of the other from where something hid it",
    "near_miss": "comes so near to the other that little is missing to a collision",
}
"""What a tag says of its agent, and of the other where there is one."""


@dataclass(frozen=True)
class Tag:
    """What an agent does during a time."""

    tag: str  # one of `TAGS`
    agent: str  # id of who does it
    start_s: float
    t_s: float  # the moment that `quantities` are of
    end_s: float
    probability: float  # that it is so, by the standard deviations and the confidence of the agents, in [0, 1]
    other: str | None = None  # id of the agent that it is done to
    lane: str | None = None  # the lane that the agent is in then, or changes to
    quantities: Mapping[str, float] = field(
        default_factory=dict
    )  # what defines it, in SI units, which the names end with
