"""Run all logs of a batch on the workers of a cluster."""

from __future__ import annotations

import logging
import secrets
import socket
import time
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import cv2

from log2sim.batch.discovery import SCENARIO, find_logs
from log2sim.batch.folder import (
    REPLAY_FILE,
    REPORT_FILE,
    ROW_FILE,
    BatchFolder,
    BatchSettings,
    Job,
    Row,
    done_row,
    failed_row,
    is_batch,
    make_jobs,
    write_batch_page,
    write_parquet,
)
from log2sim.config import Config
from log2sim.datatypes import Scenario
from log2sim.errors import ConfigError, Log2SimError
from log2sim.files.cluster import client_of, import_dask
from log2sim.files.documents import write_json
from log2sim.files.inputs import following_links, follows_links
from log2sim.files.outputs import replaced_folder
from log2sim.files.stages import peak_memory_mib, thread_limits, usable_threads
from log2sim.files.version import __version__
from log2sim.logs.opening import open_log
from log2sim.perception.run_detectors import check_detectors
from log2sim.pipeline import reconstruct
from log2sim.scenarios.index import SCENARIO_FILE
from log2sim.simulation.runner import replay

if TYPE_CHECKING:
    from distributed import Client, Future


@lru_cache(maxsize=1)
def _batch_of(out: str, token: str) -> tuple[BatchFolder, Config]:
    """Return the batch in a folder and its settings, once the process is set up for it."""
    where = f"worker on {socket.gethostname()}"
    if not is_batch(Path(out)):
        raise ConfigError(f"{where}: does not see {out}; workers need the same folders under the same names")
    folder = BatchFolder.load(Path(out))
    if folder.settings.token != token:
        raise ConfigError(f"{where}: {out} holds another batch there; workers need the same folders")
    if folder.settings.log2sim_version != __version__:
        begun = folder.settings.log2sim_version
        raise ConfigError(f"{where}: has log2sim {__version__}, the batch was begun with {begun}")
    cv2.setNumThreads(usable_threads())
    return folder, Config.load(**folder.settings.config)


# Of the local cluster. Its processes take pickles from each other, which can do anything, so they ask for
# certificates, too: other users of the machine do not get in.
HOST = "127.0.0.1"
START_TIMEOUT_S = 120
SETTINGS: dict[str, Any] = {
    # A log whose worker dies is repeated at the end, on a new process; no log that merely waited there is blamed.
    "distributed.scheduler.allowed-failures": 0,
    "distributed.scheduler.worker-saturation": 1.0,
    # Workers hold no data that could be spilled, and one that waits for memory to be freed would wait forever.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    # Each worker's parent notices when it dies; one that is merely slow on a busy machine goes on.
    "distributed.scheduler.worker-ttl": None,
    "distributed.comm.timeouts.connect": "120s",
    "distributed.comm.timeouts.tcp": "120s",
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "500ms",
    "distributed.admin.system-monitor.interval": "10s",
    # No pages: their servers would show what is run to whoever is on this machine.
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
}


@dataclass(frozen=True)
class Workers:
    """Workers that a batch may use."""

    client: Client
    are_ours: bool  # whether they were started for this round of the batch, so that none ran a log in an earlier one

    def others_than(self, address: str) -> list[str]:
        """Return the addresses of all workers but one."""
        return [a for a in self.client.scheduler_info(n_workers=-1)["workers"] if a != address]


@contextmanager
def connect(jobs: int | None = None, scheduler: str | None = None) -> Iterator[Workers]:
    """Use so many worker processes on this machine, one for each core by default, or the workers of a scheduler."""
    if scheduler is None:
        with local_workers(jobs or usable_threads()) as workers:
            yield workers
    else:
        with client_of(scheduler) as client:
            yield Workers(client, are_ours=False)


@contextmanager
def local_workers(count: int) -> Iterator[Workers]:
    """Start so many worker processes on this machine, each with its share of the cores and of the memory; stop them at the end.

    Raises `MissingExtra` without Dask.
    """
    distributed, dask = import_dask()
    from distributed.system import MEMORY_LIMIT

    environment = {**thread_limits(max(1, usable_threads() // count)), "DASK_LOGGING__DISTRIBUTED": "critical"}
    with (
        TemporaryDirectory(prefix="log2sim-") as scratch,  # where Dask leaves its lock files
        dask.config.set(SETTINGS | {"temporary-directory": scratch}),
        distributed.LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            host=HOST,
            protocol="tls://",
            security=distributed.Security.temporary(),
            dashboard_address=None,
            worker_dashboard_address=None,
            memory_limit=MEMORY_LIMIT // count,
            silence_logs=logging.CRITICAL,
            env=environment,
            scheduler_kwargs={"dashboard": False, "dashboard_address": f"{HOST}:0"},
        ) as cluster,
        distributed.Client(cluster, timeout=START_TIMEOUT_S) as client,
    ):
        from log2sim.batch.preparation import Preparation

        client.register_plugin(Preparation())
        yield Workers(client, are_ours=True)
        # Dask cannot stop a worker that it is just starting in place of one that died.
        with suppress(TimeoutError):
            client.wait_for_workers(count, timeout=START_TIMEOUT_S)


Progress = Callable[[int, int], None]
Connect = Callable[[], AbstractContextManager[Workers]]

# Jobs that the scheduler knows at once: enough for 1,000 workers, and little memory for any number of logs.
MAX_SUBMITTED = 4000
MAX_ATTEMPTS = 2
KEY_BYTES = 8
# Of repetitions at the end; more than two come of logs that waited behind one that killed their worker.
MAX_ROUNDS = 6
TABLE_FILE, PAGE_FILE = "table.parquet", "table.html"


@dataclass(frozen=True)
class Batch:
    """Logs to be reconstructed, and what earlier runs did of them."""

    folder: BatchFolder
    jobs: tuple[Job, ...]  # one for each log
    done: Mapping[str, Row]  # by the name of the log's folder

    @cached_property
    def missing(self) -> list[Job]:
        """Jobs that were not done yet, those that failed among them."""
        return [job for job in self.jobs if job.name not in self.done]


@dataclass(frozen=True)
class Finished:
    """A job that ended."""

    job: Job
    row: Row
    repetition: Job | None = None  # to be run at the end
    worker: str = ""  # address of the worker that is not to run that; empty where none is to be avoided


def plan_batch(
    root: Path,
    out: Path,
    config: Config,
    *,
    format: str = "auto",
    overwrite: bool = False,
    cache: bool = True,
    replay: bool = False,
) -> Batch:
    """Find the logs below a folder, and begin their batch in another or go on with it.

    `config`: settings of all runs. `format`: format of the logs, "auto", or "scenario" for scenario files, which are only replayed.
    `overwrite`: whether to start over, without the results of earlier runs. `cache`: whether detections in pictures are taken from the caches of the workers, and kept there.
    `replay`: whether each scenario is replayed, too. Raises `LogError` where there is no log, and `ConfigError` for an output
    folder that holds the logs, something else, or a batch of other settings, and for detectors that could search no log, and
    `MissingExtra` where a detector, or the batch itself, needs what is not installed.
    """
    import_dask()
    check_detectors(config)
    if out.resolve() in (root.resolve(), *root.resolve().parents):
        raise ConfigError(f"{out}: holds the logs; choose another folder for the results")
    logs = find_logs(root, format=format, leave_out=out)
    wanted = BatchSettings.create(root, format, follows_links(), config, replay=replay or format == SCENARIO)
    folder = BatchFolder.start(out, wanted, overwrite=overwrite)
    jobs = make_jobs(logs, out, folder.settings.token, cache=cache)
    rows = {job.name: folder.read_row(job.name) for job in jobs}
    return Batch(folder, tuple(jobs), {name: row for name, row in rows.items() if row is not None and row.is_done})


def run_batch(batch: Batch, connect: Connect, *, progress: Progress = lambda done, total: None) -> list[Row]:
    """Run the logs of a batch that are missing, and write its tables, however it ends.

    `connect`: returns a context manager of workers. It is called if there is something to do, and again for what is repeated, so
    that workers that are started for it are fresh ones. `progress`: called as `progress(done, total)`. Returns the rows of all
    logs, those of earlier runs among them.
    """
    rows, finished = dict(batch.done), len(batch.done)
    try:
        if batch.missing:
            progress(finished, len(batch.jobs))
            with closing(run_jobs(connect, batch.missing, batch.folder)) as endings:
                for ended in endings:
                    rows[ended.job.name] = ended.row
                    finished += ended.repetition is None
                    progress(finished, len(batch.jobs))
    finally:
        batch.folder.remove_left_over()
        listed = [rows[job.name] for job in batch.jobs if job.name in rows]
        write_parquet(batch.folder.path / TABLE_FILE, listed)
        write_batch_page(batch.folder.path / PAGE_FILE, listed, batch.folder.settings, total=len(batch.jobs))
    return listed


def reconstruct_all(
    root: Path | str,
    out: Path | str,
    config: Config | None = None,
    *,
    format: str = "auto",
    jobs: int | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
    cache: bool = True,
    replay: bool = False,
    progress: Progress | None = None,
) -> list[Row]:
    """Reconstruct all logs below a folder, several at once, or go on with that; see `plan_batch` and `run_batch`.

    `root`, `out`: folder with logs, or for the format "scenario" with scenarios, and folder for the results. `jobs`: worker
    processes on this machine, one for each core by default. `scheduler`: address of a Dask scheduler, whose workers are used instead. Returns the rows of all logs; those that
    failed say why.

    Worker processes import the script that calls this, which needs `if __name__ == "__main__":` around the call.
    """
    planned = plan_batch(
        Path(root), Path(out), config or Config(), format=format, overwrite=overwrite, cache=cache, replay=replay
    )
    return run_batch(planned, lambda: connect(jobs, scheduler), progress=progress or (lambda done, total: None))


def run_jobs(connect: Connect, jobs: Iterable[Job], folder: BatchFolder) -> Generator[Finished, None, None]:
    """Run jobs and yield each as it ends; those that may succeed a second time are repeated at the end, on fresh workers."""
    avoided: dict[str, str] = {}
    for last in (*[False] * (MAX_ROUNDS - 1), True):
        again = []
        with connect() as workers:
            for ended in _run_once(workers, jobs, folder, avoided):
                if ended.repetition is not None and last:
                    folder.write_failure(ended.row, ended.row.error)
                    yield replace(ended, repetition=None)
                    continue
                yield ended
                again += [] if ended.repetition is None else [ended]
        if not again:
            return
        jobs = [ended.repetition for ended in again if ended.repetition is not None]
        avoided = {ended.job.name: ended.worker for ended in again if ended.worker}


def _run_once(
    workers: Workers, jobs: Iterable[Job], folder: BatchFolder, avoided: Mapping[str, str]
) -> Iterator[Finished]:
    """Run jobs, each on another worker than the one that is to be avoided if there is another."""
    from distributed import as_completed

    waiting, running = iter(jobs), dict[str, Job]()
    futures = as_completed([])

    def submit(count: int) -> None:
        for job in islice(waiting, count):
            others = workers.others_than(avoided[job.name]) if job.name in avoided else []
            preferred = {"workers": others, "allow_other_workers": True} if others else {}
            # A key of its own for each run: Dask returns the result that it has under a known one.
            key = f"log2sim-{job.token}-{job.name}-{secrets.token_hex(KEY_BYTES)}"
            future = workers.client.submit(_run_on_worker, job, key=key, pure=False, **preferred)
            running[future.key] = job
            futures.add(future)

    submit(MAX_SUBMITTED)
    for future in futures:
        yield _ended(workers, future, running.pop(future.key), folder)
        submit(1)


def _run_on_worker(job: Job) -> tuple[dict[str, Any], bool]:
    """Reconstruct a log, or load a scenario, and replay it where that is wanted; write its folder.

    Returns the row of the log, and whether another run may succeed: it failed by something else than what is wrong with it
    or with the settings. Raises `ConfigError` where the folder of the batch is not visible, or of another version.
    """
    folder, config = _batch_of(job.out, job.token)
    target, wall, used = folder.log_folder(job.name), time.perf_counter(), time.process_time()

    def spent() -> dict[str, float]:
        seconds, cpu_s = time.perf_counter() - wall, time.process_time() - used
        return {"seconds": round(seconds, 4), "cpu_s": round(cpu_s, 4), "peak_memory_mib": round(peak_memory_mib(), 1)}

    try:
        with following_links(folder.settings.follow_links), replaced_folder(target, overwrite=True) as unfinished:
            figures: dict[str, Any] = {}
            if job.format == SCENARIO:
                scenario = Scenario.load(job.path)
            else:
                log = open_log(job.path, format=job.format, sequence=job.sequence)
                result = reconstruct(log, config, cache=job.cache, jobs=1)
                scenario, report = result.scenario, result.report
                scenario.save(unfinished / SCENARIO_FILE)
                write_json(unfinished / REPORT_FILE, report)
                faults = len(report["faults"])
                unreadable = sum(stream["count"] for stream in report["unreadable"].values())
                figures = {"ticks": report["ticks"], "faults": faults, "unreadable": unreadable, **spent()}
            if folder.settings.replay:
                begun = time.process_time()
                replayed = replay(scenario)
                replayed.save(unfinished / REPLAY_FILE)
                figures |= {key: replayed.metrics[key] for key in ("cross_track_max_m", "new_collisions")}
                figures["replay_s"] = round(time.process_time() - begun, 4)
            row = done_row(job, scenario, spent() | figures)
            write_json(unfinished / ROW_FILE, row.model_dump())
        return row.model_dump(), False
    except Log2SimError as error:
        row, may_repeat, text = failed_row(job, type(error).__name__, str(error), spent()), False, str(error)
    except Exception as error:  # whatever it is, the other logs go on
        row = failed_row(job, type(error).__name__, f"internal error: {type(error).__name__}: {error}", spent())
        may_repeat, text = True, traceback.format_exc()
    folder.write_failure(row, text)
    return row.model_dump(), may_repeat


def _ended(workers: Workers, future: Future, job: Job, folder: BatchFolder) -> Finished:
    """Return what came of a job, also where its worker could not say."""
    from distributed import KilledWorker

    repetition = replace(job, attempts=job.attempts + 1) if job.attempts < MAX_ATTEMPTS else None
    if future.status == "finished":
        document, may_repeat = future.result()
        row = Row.model_validate(document)
        if not may_repeat or repetition is None:
            return Finished(job, row)
        holders = [] if workers.are_ours else workers.client.who_has([future])[future.key]
        return Finished(job, row, repetition, next(iter(holders), ""))
    if future.cancelled():
        raise ConfigError("the Dask scheduler is gone; the same command goes on where this one was")
    error = future.exception()
    if isinstance(error, KilledWorker):
        # Return what came of a job whose worker died: after its work, before it, or by it
        written = folder.read_row(job.name)
        if written is not None and written.is_done:
            return Finished(job, written)
        row = failed_row(job, "WorkerDied", "the worker process died: it was killed, crashed or needed too much memory")
        if not folder.take_unfinished(job.name):
            return Finished(job, row, job)  # it waited behind another
        if repetition is None:
            folder.write_failure(row, row.error)
        return Finished(job, row, repetition)
    row = failed_row(job, type(error).__name__, str(error))
    if isinstance(error, Log2SimError) or repetition is None:
        folder.write_failure(row, row.error)
        return Finished(job, row)
    return Finished(job, row, repetition)
