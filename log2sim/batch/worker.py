"""What a worker does with a log: reconstruct it and write its folder, so that only a row goes back."""

from __future__ import annotations

import socket
import time
import traceback
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2

from log2sim.batch.folder import REPORT_FILE, ROW_FILE, SCENARIO_FILE, BatchFolder, BatchSettings, is_batch
from log2sim.batch.jobs import Job
from log2sim.batch.rows import done_row, failed_row
from log2sim.config import Config
from log2sim.documents import write_json
from log2sim.errors import ConfigError, Log2SimError
from log2sim.links import following_links
from log2sim.logs.opening import open_log
from log2sim.output_folders import replaced_folder
from log2sim.pipeline import reconstruct
from log2sim.stage_clock import peak_memory_mib
from log2sim.threads import usable_threads
from log2sim.version import __version__


def run_job(job: Job) -> tuple[dict[str, Any], bool]:
    """Reconstruct a log and write its folder.

    Returns
    -------
    row : dict
        Of `log2sim.batch.rows.Row`.
    may_repeat : bool
        Whether another run may succeed: the log failed by something else than what is wrong with it or with the settings.

    Raises
    ------
    ConfigError
        When the folder of the batch is not visible here, or belongs to another version of log2sim.
    """
    folder, config = _batch_of(job.out, job.token)
    target, spent = folder.log_folder(job.name), _stopwatch()
    try:
        with following_links(folder.settings.follow_links), replaced_folder(target, overwrite=True) as unfinished:
            log = open_log(job.path, format=job.format, sequence=job.sequence)
            result = reconstruct(log, config, cache=job.cache)
            result.scenario.save(unfinished / SCENARIO_FILE)
            write_json(unfinished / REPORT_FILE, result.report)
            row = done_row(job, result.report, spent())
            write_json(unfinished / ROW_FILE, row.model_dump())
        return row.model_dump(), False
    except Log2SimError as error:
        row, may_repeat, text = failed_row(job, type(error).__name__, str(error), spent()), False, str(error)
    except Exception as error:  # whatever it is, the other logs go on
        row = failed_row(job, type(error).__name__, f"internal error: {type(error).__name__}: {error}", spent())
        may_repeat, text = True, traceback.format_exc()
    folder.write_failure(row, text)
    return row.model_dump(), may_repeat


@lru_cache(maxsize=1)
def _batch_of(out: str, token: str) -> tuple[BatchFolder, Config]:
    """Return the batch in a folder and its settings, once the process is set up for it."""
    where = f"worker on {socket.gethostname()}"
    if not is_batch(Path(out)):
        raise ConfigError(f"{where}: does not see {out}; workers need the same folders under the same names")
    folder = BatchFolder.load(Path(out))
    if folder.settings.token != token:
        raise ConfigError(f"{where}: {out} holds another batch there; workers need the same folders")
    _require_version(folder.settings, where)
    cv2.setNumThreads(usable_threads())
    return folder, Config.load(**folder.settings.config)


def _require_version(settings: BatchSettings, where: str) -> None:
    if settings.log2sim_version != __version__:
        raise ConfigError(f"{where}: has log2sim {__version__}, the batch was begun with {settings.log2sim_version}")


def _stopwatch() -> Callable[[], dict[str, float]]:
    """Return a function that says what was spent since."""
    wall, used = time.perf_counter(), time.process_time()

    def spent() -> dict[str, float]:
        return {
            "seconds": round(time.perf_counter() - wall, 4),
            "cpu_s": round(time.process_time() - used, 4),
            "peak_memory_mib": round(peak_memory_mib(), 1),
        }

    return spent
