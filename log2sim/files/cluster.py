"""The workers of a Dask scheduler that somebody started."""

from __future__ import annotations

import logging
import pickle
import socket
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeVar

from log2sim.errors import ConfigError, Log2SimError, MissingExtra
from log2sim.files.inputs import follows_links
from log2sim.files.version import __version__

if TYPE_CHECKING:
    from distributed import Client

Task = TypeVar("Task")
Out = TypeVar("Out")

PROTOCOLS = ("tcp://", "tls://")
CONNECT_TIMEOUT_S = 20
# Tasks submitted at once for each worker: one runs and the others wait there, so that no worker is idle while an earlier result is late.
AHEAD = 4


def import_dask(what: str = "log2sim batch") -> tuple[Any, Any]:
    """Return `distributed` and `dask`; raise `MissingExtra`, which says what needs them, where a package of the extra is missing."""
    try:
        import cryptography  # noqa: F401  (for the certificates of a local cluster)
        import dask
        import distributed
        import pyarrow  # noqa: F401  (for the tables of a batch)
    except ImportError:
        raise MissingExtra(what, "cluster") from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    return distributed, dask


@contextmanager
def client_of(address: str) -> Iterator[Client]:
    """Connect to a scheduler.

    Raises `MissingExtra` without Dask. Raises `ConfigError` when the address is none, or nobody answers there.
    """
    if not address.startswith(PROTOCOLS):
        raise ConfigError(f"--scheduler {address}: expected {' or '.join(PROTOCOLS)}HOST:PORT")
    distributed, _ = import_dask("--scheduler")
    try:
        client = distributed.Client(address, timeout=CONNECT_TIMEOUT_S)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"--scheduler {address}: no Dask scheduler answers: {str(error).splitlines()[0]}; start one with dask scheduler"
        ) from None
    with client:
        yield client


def count_workers(client: Client) -> int:
    """Return how many workers a scheduler has now; at least one is waited for. `ConfigError` when none comes."""
    try:
        client.wait_for_workers(1, timeout=CONNECT_TIMEOUT_S)
    except TimeoutError:
        raise ConfigError(
            f"--scheduler {client.scheduler.address}: has no workers; start some with dask worker"
        ) from None
    return len(client.scheduler_info(n_workers=-1)["workers"])


def map_on_workers(
    client: Client, work: Callable[..., Out], tasks: Iterable[Task], *shared: Any
) -> Generator[Out, None, None]:
    """Yield what a function makes of tasks on the workers of a client, in their order; each result is freed once it was taken.

    `tasks`: each is asked for when a worker will soon have nothing to do, so that it may depend on the results so far.
    `shared`: further arguments of the function, which are sent to each worker once. Raises `Log2SimError` when a worker dies of a
    task, or the scheduler is gone, and whatever `work` raises.
    """
    from distributed import CancelledError, KilledWorker

    most, sent = AHEAD * count_workers(client), [client.scatter(value, broadcast=True, hash=False) for value in shared]
    running = deque[Any]()
    try:
        for task in tasks:
            running.append(client.submit(work, *sent, task, pure=False))
            if len(running) == most:
                yield running.popleft().result()
        while running:
            yield running.popleft().result()
    except KilledWorker as error:
        raise Log2SimError(f"workers of the cluster ended while they did a part of this run: {error}") from None
    except CancelledError:
        raise Log2SimError("the Dask scheduler is gone, or has no worker left that has what this run sent") from None
    finally:
        for future in running:
            future.release()


@dataclass(frozen=True)
class Sent:
    """Something that all tasks of a run need, pickled with the functions in it, which name no module; for `map_on_workers`."""

    content: bytes
    follow_links: bool  # whether links of logs may leave the log's folders
    version: str = __version__

    @classmethod
    def of(cls, value: Any) -> Sent:
        """Pickle something."""
        import cloudpickle

        return cls(cloudpickle.dumps(value), follows_links())

    def received(self) -> Any:
        """Return it; it is read once in each process. `ConfigError` where log2sim is of another version, or files are missing."""
        where = f"worker on {socket.gethostname()}"
        if self.version != __version__:
            raise ConfigError(f"{where}: has log2sim {__version__}, and this is {self.version}")
        try:
            return _read(self.content)
        except (Log2SimError, OSError) as error:
            raise ConfigError(f"{where}: {error}; workers need the same folders under the same names") from None


@lru_cache(maxsize=1)
def _read(content: bytes) -> Any:
    return pickle.loads(content)
