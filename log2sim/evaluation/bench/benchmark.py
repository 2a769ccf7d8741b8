"""Error against run time of the pipeline over methods and settings, on one log and with shared work."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from log2sim.config import Config
from log2sim.datatypes import Log, Scenario
from log2sim.errors import MissingExtra
from log2sim.evaluation.bench.ends import ends_settings, make_context_of_ends, whole_points
from log2sim.evaluation.bench.panels import Panel, make_ends_panel, make_panels
from log2sim.evaluation.bench.runs import BenchContext, Progress, make_context
from log2sim.evaluation.bench.scores import EVERYTHING, Scope
from log2sim.evaluation.bench.settings import default_settings, make_grid

__all__ = ["Benchmark", "Panel", "Scope", "bench"]


@dataclass(frozen=True, eq=False)
class Benchmark:
    """The result of a benchmark.

    Attributes
    ----------
    context : BenchContext
        What all runs had in common.
    panels : tuple of Panel
        One for each stage.
    notes : tuple of str
        What could not be measured, and why.
    """

    context: BenchContext
    panels: tuple[Panel, ...]
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        """Return the log and the stages in one line."""
        return f"<Benchmark of {self.context.log.name!r:.80}: {', '.join(p.stage for p in self.panels)}>"

    def to_dataframe(self) -> Any:
        """Return a pandas DataFrame with one row for each stage and setting: time, error and the figures of the stage.

        Raises
        ------
        MissingExtra
            When pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError:
            raise MissingExtra("to_dataframe", "dataframe") from None
        rows = [
            {
                "stage": panel.stage, "setting": point.setting, "present": point.present, "on_front": on_front,
                "ms_per_tick": point.ms_per_tick, "error": point.error, "unit": panel.unit, **point.figures,
            }
            for panel in self.panels
            for point, on_front in zip(panel.points, panel.on_front, strict=True)
        ]  # fmt: skip
        return pd.DataFrame(rows)


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

    Methods for images are compared with a detector in images alone. Where `reconstruct` searches sweeps, too, its default
    is one more whole run, and what the others are measured against.

    Of a log with LiDARs on the vehicle and at the road, the ends alone and all levels of their fusion are compared, too.

    Parameters
    ----------
    log : Log
        From `open_log`.
    config : Config, optional
        The present settings; the defaults without.
    truth : Scenario, optional
        Without it only figures that need no truth are computed.
    scope : Scope
        Which objects are compared with the truth.
    detectors : tuple of str
        Detectors to compare with that of `config`.
    progress : callable, optional
        Called as `progress(what, done, total)`.

    Raises
    ------
    LogError, ConfigError, MissingExtra
        For a log that cannot be read or has neither a camera nor LiDARs at both ends, invalid settings, or a detector whose
        package is missing.
    """
    report = progress or (lambda what, done, total: None)
    config = config or Config()
    ends = ends_settings(log, config)
    if log.cameras:
        grid = make_grid(log, config, detectors)
        context = make_context(log, grid, truth, report, scope)
        default = default_settings(log, config)
        panels = make_panels(context, report, whole_points(log, default, truth, scope, report))
        notes = _notes(context, panels)
    else:
        context = make_context_of_ends(log, ends, truth, scope)
        panels, notes = [], ["the log has no camera: only vehicle, road, and both are compared"]
    if ends:
        panels.append(make_ends_panel(whole_points(log, ends, truth, scope, report), truth))
    return Benchmark(context, tuple(panels), tuple(notes))


def _notes(context: BenchContext, panels: list[Panel]) -> list[str]:
    notes = []
    if context.truth is None:
        notes.append(
            "no truth: jitter, gaps, residuals of the homography and consistency with LiDAR are all that is measured"
        )
    if len(context.grid.detect) == 1:
        notes.append(
            f"detector '{context.grid.detect[0].config.detect.name}' has no setting of tiles or input size to compare"
        )
    if all(p.stage != "homography" for p in panels):
        notes.append("too few obstacles with LiDAR points within 60 m to judge homographies by")
    return notes
