"""Workers of a batch: processes on this machine, or those of a Dask scheduler."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from log2sim.errors import ConfigError, MissingExtra
from log2sim.threads import thread_limits, usable_threads

if TYPE_CHECKING:
    from distributed import Client

HOST = "127.0.0.1"
"""Of the local cluster. Its processes take pickles from each other, which can do anything, so they ask for certificates, too: other users of the
machine do not get in."""
PROTOCOLS = ("tcp://", "tls://")
CONNECT_TIMEOUT_S = 20
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
    """Workers that a batch may use.

    Attributes
    ----------
    client : distributed.Client
    are_ours : bool
        Whether they were started for this round of the batch, so that none ran a log in an earlier one.
    """

    client: Client
    are_ours: bool

    def others_than(self, address: str) -> list[str]:
        """Return the addresses of all workers but one."""
        return [a for a in self.client.scheduler_info(n_workers=-1)["workers"] if a != address]


def connect(jobs: int | None = None, scheduler: str | None = None) -> AbstractContextManager[Workers]:
    """Return so many worker processes on this machine, one for each core by default, or the workers of a scheduler."""
    return local_workers(jobs or usable_threads()) if scheduler is None else workers_of(scheduler)


@contextmanager
def local_workers(count: int) -> Iterator[Workers]:
    """Start so many worker processes on this machine, each with its share of the cores and of the memory; stop them at the end.

    Raises
    ------
    MissingExtra
        Without Dask.
    """
    distributed, dask = import_dask()
    from distributed.system import MEMORY_LIMIT

    environment = {**thread_limits(max(1, usable_threads() // count)), "DASK_LOGGING__DISTRIBUTED": "critical"}
    with (
        dask.config.set(SETTINGS),
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


@contextmanager
def workers_of(address: str) -> Iterator[Workers]:
    """Use the workers of a scheduler that somebody started.

    Raises
    ------
    MissingExtra
        Without Dask.
    ConfigError
        When the address is none, or nobody answers there.
    """
    if not address.startswith(PROTOCOLS):
        raise ConfigError(f"--scheduler {address}: expected {' or '.join(PROTOCOLS)}HOST:PORT")
    distributed, _ = import_dask()
    try:
        client = distributed.Client(address, timeout=CONNECT_TIMEOUT_S)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"--scheduler {address}: no Dask scheduler answers: {str(error).splitlines()[0]}; start one with dask scheduler"
        ) from None
    with client:
        yield Workers(client, are_ours=False)


def import_dask() -> tuple[Any, Any]:
    """Return `distributed` and `dask`; raise `MissingExtra` where one of the packages that a batch needs is missing."""
    try:
        import cryptography  # noqa: F401  (for the certificates of a local cluster)
        import dask
        import distributed
        import pyarrow  # noqa: F401  (for the tables at the end)
    except ImportError:
        raise MissingExtra("log2sim batch", "cluster") from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    return distributed, dask
