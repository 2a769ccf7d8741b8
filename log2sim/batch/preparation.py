"""What each new worker process of a local cluster does first."""

from __future__ import annotations

import signal

from distributed import Worker, WorkerPlugin


class Preparation(WorkerPlugin):  # type: ignore[misc]
    """Imports what logs need before the first one comes, and leaves Ctrl-C to the process that started the workers.

    A terminal sends Ctrl-C to all processes of a command.
    """

    name = "log2sim-batch"

    def setup(self, worker: Worker) -> None:
        """Prepare a worker; called in its main thread."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        import log2sim.pipeline  # noqa: F401
