"""What the terminal says about doubtful agents, and the list of the flags that say why."""

from __future__ import annotations

import ast
from dataclasses import replace

from export_worlds import straight, world
from test_layers import ROOT

from log2sim.agents.smooth.motion_model import PHRASES
from log2sim.cli.reconstruct import doubt_lines
from log2sim.datatypes import FLAGS, Agent, Doubt

PASSES = Doubt("passes_through", "passes through car-22 at 1.2 s", 1.0, 1.4)


def agent(name: str, *doubts: Doubt, confidence: float = 0.9) -> Agent:
    return replace(straight(name), doubts=doubts, confidence=confidence)


def test_the_agents_are_counted_and_named_with_their_reasons() -> None:
    (line,) = doubt_lines(world(agent("ego"), agent("car-19", confidence=0.2), agent("car-18", PASSES), agent("car-1")))
    assert line == "2 of 3 agents: car-18 (passes through car-22 at 1.2 s), car-19 (confidence 0.20)"


def test_every_flag_that_is_given_is_listed_and_every_listed_one_is_given() -> None:
    given = set(PHRASES)
    for file in (ROOT / "log2sim" / "agents").rglob("*.py"):
        for call in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if (
                isinstance(call, ast.Call)
                and isinstance(call.func, ast.Name)
                and call.func.id.lower().strip("_s") == "doubt"
            ):
                texts = [a.value for a in call.args if isinstance(a, ast.Constant) and isinstance(a.value, str)]
                given |= {text for text in texts if text.isidentifier()}
    assert given == set(FLAGS)
