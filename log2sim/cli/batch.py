"""Reconstruct all logs below a folder."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from log2sim.cli import options as opt

if TYPE_CHECKING:
    from collections.abc import Sequence

    from log2sim.batch.folder import Row

MAX_NAMED = 5


def batch(
    root: Annotated[Path, typer.Argument(metavar="ROOT", help="Folder with logs of any formats below it.")],
    out: Annotated[Path, opt.write_to("DIR", "Folder for the results; the same command goes on there.")],
    jobs: Annotated[int | None, opt.option(
        "Worker processes on this machine.", "N", min=1, default="one for each core")] = None,
    scheduler: Annotated[str | None, opt.option(
        "Use the workers of this Dask scheduler, which see the same folders.", "tcp://HOST:PORT")] = None,
    format: opt.Format = "auto",
    detector: Annotated[str | None, opt.option(
        "Detector, see reconstruct.", "NAME|MODEL.onnx|labels|lidar:NAME")] = None,
    poses: opt.Poses = None,
    config: opt.ConfigFile = None,
    settings: opt.Settings = None,
    seed: Annotated[int | None, opt.option("Seed of all random numbers.")] = None,
    replay: Annotated[bool, opt.option(
        "Replay each scenario, too: replay.json, and its figures in the tables.", None, "--replay")] = False,
    no_cache: opt.NoCache = False,
    overwrite: Annotated[bool, opt.option(
        "Start over: first remove the results that DIR holds.", None, "--overwrite", "-f")] = False,
    quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Reconstruct all logs below a folder, several at once.

    Each log gets a folder in DIR/logs with scenario.json and report.json, with --replay also replay.json, or error.txt where it failed; table.html and
    table.parquet list them all. A log that fails by something else than its data is run once more at the end. A second call
    runs what is missing or failed. Exits with 7 when logs failed.

    Examples
    --------
    log2sim batch drives/ -o results/
    log2sim batch drives/ -o results/ --replay
    log2sim batch drives/ -o results/ --scheduler tcp://10.0.0.5:8786
    """
    from log2sim.batch import plan_batch, run_batch
    from log2sim.batch.run import connect
    from log2sim.cli.progress import progress
    from log2sim.errors import LogsFailed

    opt.require_own_workers(jobs, scheduler)
    chosen = opt.load_config(config, settings, detector=detector, poses=poses, seed=seed)
    planned = plan_batch(root, out, chosen, format=format, overwrite=overwrite, cache=not no_cache, replay=replay)
    found = f"{opt.counted(len(planned.jobs), 'log')} below {root}"
    opt.say(f"{found}, {len(planned.done)} of them done before" if planned.done else found, quiet=quiet)

    begun = time.perf_counter()
    with progress(quiet=quiet) as report_progress:
        rows = run_batch(planned, lambda: connect(jobs, scheduler), progress=partial(report_progress, "logs"))
    for line in _failure_lines(rows):
        opt.say(line, quiet=quiet)
    now = sum(row.is_done and row.name not in planned.done for row in rows)
    rate = f"; {now / (time.perf_counter() - begun) * 3600:,.0f} logs an hour" if now else ""
    opt.say(f"{out / 'table.html'}: {_summary(rows)}{rate}", quiet=quiet)
    failed = sum(not row.is_done for row in rows)
    if failed:
        raise LogsFailed(f"{failed} of {opt.counted(len(rows), 'log')} failed; {out / 'table.html'} says why")


def _summary(rows: Sequence[Row]) -> str:
    from log2sim.batch.folder import sum_up

    sums = sum_up(rows)
    off_m = [row.cross_track_max_m for row in rows if row.cross_track_max_m is not None]
    collisions = opt.counted(sum(row.new_collisions or 0 for row in rows), "new collision")
    replayed = f"; replayed at most {max(off_m):.3f} m off the paths, {collisions}" if off_m else ""
    return (
        f"{sums['done']:.0f} of {opt.counted(len(rows), 'log')} done, {sums['agents']:.0f} agents ({sums['static']:.0f} static, "
        f"{sums['doubtful']:.0f} doubtful) over {sums['duration_s']:.0f} s{replayed}"
    )


def _failure_lines(rows: Sequence[Row]) -> list[str]:
    """Say why the first logs failed."""
    failed = [row for row in rows if not row.is_done]
    lines = [f"failed: {row.log}: {row.error.splitlines()[0] if row.error else row.error_kind}" for row in failed]
    more = len(lines) - MAX_NAMED
    return [*lines[:MAX_NAMED], *([f"and {more} more"] if more > 0 else [])]
