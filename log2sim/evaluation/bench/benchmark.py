"""Error against run time: the pipeline over methods and settings, on one log and with shared work."""

from __future__ import annotations

from dataclasses import dataclass

from log2sim.config import Config
from log2sim.datatypes import Log, Scenario
from log2sim.evaluation.bench.panels import Panel, make_panels
from log2sim.evaluation.bench.runs import Bed, Progress, make_bed
from log2sim.evaluation.bench.scores import EVERYTHING, Scope
from log2sim.evaluation.bench.settings import make_grid

__all__ = ["Benchmark", "Panel", "Scope", "bench"]


@dataclass(frozen=True, eq=False)
class Benchmark:
    """The panels of a log, and what all runs had in common."""

    bed: Bed
    panels: tuple[Panel, ...]
    notes: tuple[str, ...]


def bench(
    log: Log,
    config: Config | None = None,
    *,
    truth: Scenario | None = None,
    scope: Scope = EVERYTHING,
    detectors: tuple[str, ...] = (),
    progress: Progress | None = None,
) -> Benchmark:
    """Run a log with the present settings and with every alternative of one stage at a time.

    Parameters
    ----------
    log : Log
        From `open_log`.
    config : Config, optional
        The present settings; the defaults without.
    truth : Scenario, optional
        Without it the figures are those that need none.
    scope : Scope
        What of a scenario is compared with the truth.
    detectors : tuple of str
        Detectors to compare with that of `config`.
    progress : callable, optional
        Called as `progress(what, done, total)`.

    Raises
    ------
    LogError, ConfigError, MissingExtra
        For logs and settings that cannot work.
    """
    tell = progress or (lambda what, done, total: None)
    grid = make_grid(log, config or Config(), detectors)
    bed = make_bed(log, grid, truth, tell, scope)
    panels = make_panels(bed, tell)
    return Benchmark(bed, tuple(panels), tuple(_notes(bed, panels)))


def _notes(bed: Bed, panels: list[Panel]) -> list[str]:
    notes = []
    if bed.truth is None:
        notes.append(
            "no truth: jitter, gaps, residuals of the homography and consistency with LiDAR are all that is measured"
        )
    if len(bed.grid.detect) == 1:
        notes.append(
            f"detector '{bed.grid.detect[0].config.detect.name}' has no setting of tiles or input size to compare"
        )
    if all(p.stage != "homography" for p in panels):
        notes.append("too few obstacles with LiDAR points within 60 m to judge homographies by")
    return notes
