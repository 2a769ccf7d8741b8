"""Write an interactive HTML page of a scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from log2sim.cli import options as opt


def view(
    scenario: opt.ScenarioPath,
    out: Annotated[Path, opt.write_to("FILE.html", "Page to write.")],
    log: opt.PageLog = None,
    max_mb: Annotated[float | None, opt.option(
        "Size of a page with --log, in millions of bytes; pictures and points are chosen to fit.", "MB",
        default="40")] = None,
    cameras: opt.Cameras = None,
    truth: opt.Truth = None,
    replay: Annotated[Path | None, opt.option("Replay to show as a layer.", "REPLAY")] = None,
    metrics: Annotated[Path | None, opt.option(
        "Metrics file of log2sim evaluate, to show beside the map.", "METRICS")] = None,
    predict: Annotated[float | None, opt.option(
        "Show where agents were expected to go for this long, in s.", "S")] = None,
    background: Annotated[Path | None, opt.option(
        "Log whose map of the ground is shown below, or a map of log2sim map.", "LOG|MAP.png",
        default="that of --log")] = None,
    sequence: opt.SequenceName = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Write an interactive HTML page of a scenario.

    Examples
    --------
    log2sim view s.json --log samples/crossing -o s.html
    log2sim view s.json --replay replay.json --truth samples/crossing -o s.html
    """
    from log2sim.cli.layers import load_background, load_placed_truth, load_replay, map_of, open_recorded, shows_ground
    from log2sim.cli.progress import progress
    from log2sim.datatypes import Scenario, count_agents
    from log2sim.errors import ConfigError
    from log2sim.files.documents import check_targets
    from log2sim.visualization.page.writer import write_page

    check_targets(out, overwrite=overwrite)
    for name, value in (("--max-mb", max_mb), ("--cameras", cameras)):
        if log is None and value is not None:
            raise ConfigError(f"{name}: is for the pictures of a log; add --log")
    if max_mb is not None and not 0 < max_mb <= 1000:
        raise ConfigError(f"--max-mb {max_mb:g}: expected a number above 0 and up to 1000")
    loaded = Scenario.load(scenario)
    layers: dict[str, Any] = {
        "replay": load_replay(replay, loaded, quiet=quiet) if replay is not None else None,
        "truth": load_placed_truth(truth, loaded, sequence) if truth is not None else None,
        "metrics": [] if metrics is None else [_metrics(metrics)],
    }
    with progress(quiet=quiet) as report_progress:
        if log is not None:
            report_progress("open", 0, 0)
            from log2sim.visualization.recording import DEFAULT_MAX_BYTES

            max_bytes = DEFAULT_MAX_BYTES if max_mb is None else round(max_mb * 1e6)
            layers["recorded"] = open_recorded(
                log, loaded, sequence, max_bytes, opt.camera_names(cameras), report_progress
            )
        if background is not None:
            layers["background"] = load_background(background, loaded, sequence, report_progress)
        elif log is not None and shows_ground(opened := layers["recorded"].log):
            layers["background"] = map_of(opened, loaded, report_progress)
        notes = write_page(loaded, out, **layers, predict_s=predict, overwrite=overwrite)
    for note in notes:
        opt.say(note, quiet=quiet)
    opt.say(f"{out}: {out.stat().st_size / 1e6:.1f} MB, {count_agents(a.id for a in loaded.agents)}", quiet=quiet)


def _metrics(path: Path) -> tuple[str, str]:
    """Return title and table of a metrics file.

    Raises `LogError` when it is none.
    """
    from log2sim.errors import LogError
    from log2sim.evaluation.metrics.table import format_table, format_verdict
    from log2sim.files.documents import read_json

    document = read_json(path, LogError)
    try:
        return f"Metrics against {document['truth']}", f"{format_verdict(document)}\n\n{format_table(document)}"
    except (KeyError, TypeError, AttributeError, ValueError):
        raise LogError(
            f"{path}: expected metrics of a scenario, as `log2sim evaluate SCENARIO --truth TRUTH --out FILE` writes them"
        ) from None
