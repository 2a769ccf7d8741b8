"""Write a log, or a part of it, as a folder of log2sim's own layout."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

from log2sim.cli import options as opt
from log2sim.errors import ConfigError


def convert(
    log: opt.LogPath,
    out: Annotated[Path, opt.write_to("DIR", "Folder to write.")],
    format: opt.Format = "auto",
    sequence: opt.SequenceName = None,
    start: opt.Start = None,
    stop: opt.Stop = None,
    cameras: opt.Cameras = None,
    labels: opt.LabelFile = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
) -> None:
    """Write any log, or a part of it, as a log folder of log2sim; images are copied as they are.

    Examples
    --------
    log2sim convert samples/crossing --start 1 --stop 3 --cameras front -o part/
    log2sim convert drive.bag --labels openlabel.json -o labeled/
    """
    from log2sim.cli.progress import progress
    from log2sim.files.documents import check_folder
    from log2sim.logs.excerpt import cut_log
    from log2sim.logs.native.writer import refuse_target, write_log
    from log2sim.logs.opening import open_log

    names = opt.camera_names(cameras)
    refuse_target(out, overwrite=overwrite)
    check_folder(out, overwrite=overwrite)
    if out.resolve() in (log.resolve(), *log.resolve().parents):
        raise ConfigError(f"{out}: holds the log that is converted; choose another folder")
    part = cut_log(
        open_log(log, format=format, sequence=sequence, labels=labels), cameras=names, start_s=start, stop_s=stop
    )
    opt.say_all("note", part.notes, quiet=quiet)
    problems: list[str] = []
    with progress(quiet=quiet) as report_progress:
        write_log(
            part,
            out,
            overwrite=overwrite,
            jpeg_quality=95,
            progress=partial(report_progress, "convert"),
            problems=problems,
        )
    opt.say_all("note: left out", problems, quiet=quiet)
    records = sum(len(stream.t_ns) for stream in part.streams.values()) - len(problems)
    size_mb = sum(file.stat().st_size for file in out.rglob("*") if file.is_file()) / 1e6
    opt.say(
        f"{out}: {opt.counted(records, 'record')} of {opt.counted(len(part.streams), 'sensor')}, {size_mb:.1f} MB",
        quiet=quiet,
    )
