"""Predict where the agents of a scenario will be within seconds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from log2sim.cli import options as opt


def predict(
    scenario: opt.ScenarioPath,
    horizon: Annotated[float, opt.option("Longest prediction in s, from 0.1 to 10.", "S")] = 3.0,
    method: Annotated[
        str | None, opt.option("Only these methods: velocity, turn, smoothed, path.", "A,B", default="all")
    ] = None,
    out: Annotated[Path | None, opt.write_to("FILE", "Figures file to write.")] = None,
    positions: Annotated[
        bool, opt.option("With --out: write every predicted position with its sigma, too.", None, "--positions")
    ] = False,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
) -> None:
    """Predict each agent at each tick from its past, and estimate how far off that is.

    Examples
    --------
    log2sim predict s.json --horizon 2 -o prediction.json
    """
    from log2sim.datatypes import Scenario
    from log2sim.errors import ConfigError
    from log2sim.files.documents import check_targets, write_json
    from log2sim.prediction.displacement import format_figures, prediction_document
    from log2sim.prediction.prediction import METHODS, predict_scenario

    check_targets(out, overwrite=overwrite)
    if positions and out is None:
        raise ConfigError("--positions: there is no file to write them to; name one with --out")
    methods = tuple(METHODS) if method is None else tuple(dict.fromkeys(m.strip() for m in method.split(",")))
    loaded = Scenario.load(scenario).active
    document = prediction_document(loaded, predict_scenario(loaded, horizon, methods=methods), with_positions=positions)
    if out is not None:
        write_json(out, document)
    opt.say(format_figures(document), quiet=quiet)
    if loaded.is_reconstruction:
        opt.say("note: the states were smoothed over the whole log and depend a little on what came next", quiet=quiet)
    opt.report_written(out, quiet=quiet)
