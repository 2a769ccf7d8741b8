"""Write a log, or a part of it, as a folder of log2sim's own layout."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

from log2sim.cli.options import (
    Cameras,
    Format,
    LabelFile,
    LogPath,
    Overwrite,
    Quiet,
    SequenceName,
    Start,
    Stop,
    camera_names,
    counted,
    say,
    write_to,
)
from log2sim.errors import ConfigError


def convert(
    log: LogPath,
    out: Annotated[Path, write_to("DIR", "Folder to write.")],
    format: Format = "auto",
    sequence: SequenceName = None,
    start: Start = None,
    stop: Stop = None,
    cameras: Cameras = None,
    labels: LabelFile = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
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

    names = camera_names(cameras)
    refuse_target(out, overwrite=overwrite)
    check_folder(out, overwrite=overwrite)
    if out.resolve() in (log.resolve(), *log.resolve().parents):
        raise ConfigError(f"{out}: holds the log that is converted; choose another folder")
    part = cut_log(
        open_log(log, format=format, sequence=sequence, labels=labels), cameras=names, start_s=start, stop_s=stop
    )
    for note in part.notes:
        say(f"note: {note}", quiet=quiet)
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
    for problem in problems:
        say(f"note: left out: {problem}", quiet=quiet)
    records = sum(len(stream.t_ns) for stream in part.streams.values()) - len(problems)
    size_mb = sum(file.stat().st_size for file in out.rglob("*") if file.is_file()) / 1e6
    say(f"{out}: {counted(records, 'record')} of {counted(len(part.streams), 'sensor')}, {size_mb:.1f} MB", quiet=quiet)
