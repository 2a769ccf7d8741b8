"""Load ground truth and replays, as several commands need them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from log2sim.cli.options import counted, say

if TYPE_CHECKING:
    from log2sim.datatypes import Log, Scenario
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


def load_truth(path: Path, scenario: Scenario, sequence: str | None) -> Scenario:
    """Load the ground truth of a scenario, for the cameras that it used; see `truth_at`."""
    used = [str(c["name"]) for c in scenario.cameras if c.get("used")]
    return truth_at(path, used if scenario.cameras else None, sequence, provenance=scenario.provenance)


def truth_at(
    path: Path, used: Iterable[str] | None, sequence: str | None, *, provenance: Mapping[str, Any] | None = None
) -> Scenario:
    """Load ground truth from a scenario file or a log: its `truth.json`, else its labels in view of the sensors used.

    Without any camera used, what the LiDARs show counts as visible; None stands for all cameras of the log. The labels are
    placed by the poses that `provenance` states, so that both are in the same map.
    """
    from log2sim.datatypes import Scenario as Truth
    from log2sim.logs.opening import is_log_file, open_log

    if not (path.is_dir() or is_log_file(path)):
        return Truth.load(path)
    if (path / "truth.json").is_file():
        return Truth.load(path / "truth.json")
    from log2sim.evaluation.metrics.truth import truth_from_log
    from log2sim.localization.choice import localize_like

    log: Log = localize_like(open_log(path, sequence=sequence), provenance or {})
    names = None if used is None else list(used)
    known = None if names is None else [name for name in names if name in log.cameras]
    return truth_from_log(log, cameras=None if names and not known else known)
