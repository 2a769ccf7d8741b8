"""Whose a collision is: the replay's, or that of the scenario, which may be a reconstruction."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from export_worlds import straight, world

from log2sim.datatypes import Agent, Scenario
from log2sim.errors import CheckFailed
from log2sim.simulation import Controls, Observation
from log2sim.simulation.metrics.all_metrics import require_strict, summarize
from log2sim.simulation.result import Replay
from log2sim.simulation.runner import replay

RECONSTRUCTED = {"history": ["reconstruct"], "detector": "labels"}


def standing(name: str, x_m: float, y_m: float) -> Agent:
    return replace(straight(name, start=(x_m, y_m), speed=0.0, t_s=np.array([0.0, 3.0])), static=True)


def scene(**provenance: Any) -> Scenario:
    """An ego that passes a wall, and a car that drives through a parked one 20 m aside."""
    agents = (
        straight("ego"),
        standing("wall", 30.0, 0.0),
        straight("car", start=(0.0, 20.0)),
        standing("parked", 9.0, 20.0),
    )
    return replace(world(*agents), provenance=provenance)


def accelerate(observation: Observation) -> Controls:
    """Drive into the wall."""
    return Controls(accel_mps2=8.0, steer_rad=0.0)


def owners(result: Replay) -> list[tuple[tuple[str, ...], str]]:
    return [(tuple(e["agents"]), e["belongs_to"]) for e in result.metrics["collisions"]]


@pytest.mark.parametrize(("provenance", "kind"), [(RECONSTRUCTED, "reconstruction"), ({}, "scenario")])
def test_overlaps_of_its_own_boxes_are_the_scenarios_and_new_ones_the_replays(provenance: Any, kind: str) -> None:
    result = replay(scene(**provenance), ego=accelerate, dt_s=0.02)
    assert owners(result) == [(("car", "parked"), kind), (("ego", "wall"), "replay")]
    assert result.metrics["new_collisions"] == 1
    lines = summarize(result).splitlines()
    assert any(line.startswith(f"2 collisions, 1 of the replay and 1 of the {kind} itself · ") for line in lines)
    assert lines[-2].startswith("  ego and wall collide at")
    assert lines[-2].endswith("m/s)")
    assert lines[-1].startswith("  car and parked collide at")
    assert lines[-1].endswith(f", in the {kind} itself")
    with pytest.raises(CheckFailed, match=r"ego and wall collide at .* the scenario has no such collision") as failed:
        require_strict(result)
    assert "parked" not in str(failed.value)


def test_older_files_that_only_say_in_log_are_read_and_written() -> None:
    """They lack the owner and call the contact of a pair that touches in the scenario "log"."""
    result = replay(scene(**RECONSTRUCTED), ego=accelerate, dt_s=0.02)
    assert {c["contact"] for c in result.metrics["conflicts"]} == {"new", "scenario"}
    document = result.to_dict()
    metrics = document["metrics"]
    for event in [*metrics["collisions"], *(e for m in metrics["by_agent"].values() for e in m["collisions"])]:
        event.pop("belongs_to", None)
    for conflict in metrics["conflicts"]:
        conflict["contact"] = conflict["contact"].replace("scenario", "log")
    read = Replay.from_dict(document)
    assert owners(read) == [(("car", "parked"), "scenario"), (("ego", "wall"), "replay")]
    assert read.metrics["by_agent"]["ego"]["collisions"][0]["belongs_to"] == "replay"
    assert {c["contact"] for c in read.metrics["conflicts"]} == {"new", "scenario"}
    assert Replay.from_dict(read.to_dict()).metrics == read.metrics
