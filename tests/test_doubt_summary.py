"""What the terminal says about doubtful agents."""

from __future__ import annotations

import pytest

from log2sim.cli.reconstruct import MAX_NAMED_DOUBTS, doubt_lines
from log2sim.datatypes import Doubt

PASSES = Doubt("passes_through", "passes through car-22 at 1.2 s", 1.0, 1.4).to_dict()


def test_nothing_is_said_without_a_doubt() -> None:
    assert doubt_lines({"total": 46, "doubtful": {}}) == []


def test_the_agents_are_counted_and_named_with_their_reasons() -> None:
    counts = {"total": 46, "doubtful": {"car-18": [PASSES], "car-19": []}}
    (line,) = doubt_lines(counts)
    assert line == "2 of 46 agents are doubtful: car-18 (passes through car-22 at 1.2 s), car-19 (low confidence)"


@pytest.mark.parametrize("extra", [0, 3])
def test_the_list_is_limited(extra: int) -> None:
    names = [f"car-{k}" for k in range(MAX_NAMED_DOUBTS + extra)]
    (line,) = doubt_lines({"total": 46, "doubtful": {name: [PASSES] for name in names}})
    assert line.startswith(f"{len(names)} of 46 agents are doubtful: car-0 (")
    assert line.count("passes through") == MAX_NAMED_DOUBTS
    assert line.endswith(f", and {extra} more" if extra else ")")


def test_the_ego_is_no_agent_among_others() -> None:
    lines = doubt_lines({"total": 2, "doubtful": {"ego": [PASSES], "car-1": [PASSES]}})
    assert lines[0].startswith("the ego is doubtful: ")
    assert lines[1].startswith("1 of 2 agents is doubtful: car-1 ")
