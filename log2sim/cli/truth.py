"""Load replays, as several commands need them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from log2sim.cli.options import counted, say

if TYPE_CHECKING:
    from log2sim.datatypes import Scenario
    from log2sim.simulation.result import Replay


def load_replay(path: Path, scenario: Scenario, *, quiet: bool = False) -> Replay:
    """Load a replay to show with a scenario; warn when it belongs to another scenario."""
    from log2sim.datatypes import EGO
    from log2sim.simulation.result import Replay as Replayed

    loaded = Replayed.load(path)
    known = {a.id for a in scenario.agents}
    others = [a.id for a in loaded.agents if a.id != EGO]
    unknown = [id for id in others if id not in known]
    if loaded.scenario != scenario.name:
        say(f"warning: {path} replays '{loaded.scenario}', not '{scenario.name}'; the two may not match", quiet=quiet)
    elif unknown:
        count = f"{len(unknown)} of its {counted(len(others), 'agent')} {'is' if len(unknown) == 1 else 'are'}"
        say(f"warning: {path} replays another version of '{scenario.name}': {count} not in it", quiet=quiet)
    return loaded
