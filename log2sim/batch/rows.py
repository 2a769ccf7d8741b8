"""What a batch knows of one log: a row of its table."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from log2sim.batch.jobs import Job

MAX_ERROR_CHARS = 2000
"""Of a message in a table; `error.txt` has all of it."""

Count = Annotated[int | None, Field(ge=0)]
Amount = Annotated[float | None, Field(ge=0)]


class Row(BaseModel):
    """One log of a batch; figures are None where it failed.

    Attributes
    ----------
    name : str
        Of its folder.
    log : str
        Its path below the root, with the sequence where a folder holds several.
    format, sequence : str
    status : str
        "done" or "failed".
    error_kind : str
        Class of the error; empty without one.
    error : str
        Its message.
    attempts : int
        How often it was run, 2 after a repetition.
    ticks : int
    duration_s : float, s
    agents, static, doubtful : int
        Agents without the ego, those of them that stand all the time, and all that the scenario doubts.
    faults, unreadable : int
        Faults of sensors and poses, and records that could not be read.
    seconds, cpu_s : float, s
        Wall time and time of the processor, from opening the log to writing its files.
    peak_memory_mib : float, MiB
        Largest resident memory of the worker so far.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    name: str
    log: str
    format: str
    sequence: str
    status: Literal["done", "failed"]
    error_kind: str = ""
    error: str = ""
    attempts: Annotated[int, Field(ge=1)] = 1
    ticks: Count = None
    duration_s: Amount = None
    agents: Count = None
    static: Count = None
    doubtful: Count = None
    faults: Count = None
    unreadable: Count = None
    seconds: Amount = None
    cpu_s: Amount = None
    peak_memory_mib: Amount = None

    @property
    def is_done(self) -> bool:
        """Whether the log was reconstructed."""
        return self.status == "done"


def done_row(job: Job, report: dict[str, Any], spent: dict[str, Any]) -> Row:
    """Return the row of a log that was reconstructed, with what it took: `seconds`, `cpu_s` and `peak_memory_mib`."""
    agents = report["agents"]
    return Row(
        **_identity(job),
        status="done",
        ticks=report["ticks"],
        duration_s=round(report["duration_s"], 6),
        agents=agents["total"],
        static=agents["static"],
        doubtful=len(agents["doubtful"]),
        faults=len(report["faults"]),
        unreadable=sum(stream["count"] for stream in report["unreadable"].values()),
        **spent,
    )


def failed_row(job: Job, kind: str, message: str, spent: dict[str, Any] | None = None) -> Row:
    """Return the row of a log that failed."""
    text = message[:MAX_ERROR_CHARS].encode("utf-8", "backslashreplace").decode()
    return Row(**_identity(job), status="failed", error_kind=kind, error=text, **(spent or {}))


def _identity(job: Job) -> dict[str, Any]:
    texts = {key: getattr(job, key) for key in ("name", "log", "format", "sequence")}
    return {key: text.encode("utf-8", "backslashreplace").decode() for key, text in texts.items()} | {
        "attempts": job.attempts
    }
