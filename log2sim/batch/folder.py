"""The folder of a batch, a row for each of its logs, and the tables of all."""

from __future__ import annotations

import base64
import glob
import html
import re
import secrets
import shutil
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from hashlib import sha256
from importlib import resources
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from log2sim.batch.discovery import FoundLog
from log2sim.config import Config
from log2sim.datatypes import Scenario
from log2sim.datatypes.agent import MAX_LISTED
from log2sim.errors import ConfigError, LogError
from log2sim.files.documents import first_problem, read_json, replaced, write_json
from log2sim.files.outputs import claim, is_left_over, is_temporary, remove, replaced_folder
from log2sim.files.version import __version__
from log2sim.scenarios.index import write_table

MAX_NAME_CHARS = 80  # of a folder; file systems take 255 bytes, and temporary names are longer
HASH_DIGITS = 8
_SAFE = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]*")
_UNSAFE_CHARS = re.compile(r"[^A-Za-z0-9._-]+")


@dataclass(frozen=True)
class Job:
    """One run of one log."""

    out: str  # folder of the batch, absolute
    token: str  # of the batch; a folder of that name without it is another one
    name: str  # of the folder for the log
    log: str  # `FoundLog.id`
    path: str  # what `open_log` takes, absolute
    format: str
    sequence: str
    cache: bool = True  # whether detections in pictures are kept, and taken from earlier runs
    attempts: int = 1  # 1 at the first run


def make_jobs(logs: Sequence[FoundLog], out: Path, token: str, *, cache: bool = True) -> list[Job]:
    """Return a job for each log, with a name for its folder that no other has and that any file system takes."""

    def plain(text: str) -> str:
        if len(text) <= MAX_NAME_CHARS and _SAFE.fullmatch(text):
            return text
        return _UNSAFE_CHARS.sub("_", text).strip("._-")[-MAX_NAME_CHARS:] or "log"

    # Some file systems do not tell upper from lower case.
    count = Counter(plain(log.id).lower() for log in logs)
    jobs = []
    for log in logs:
        name = plain(log.id)
        if name != log.id or count[name.lower()] > 1:
            name += f"-{sha256(f'{log.format}:{log.id}'.encode('utf-8', 'surrogateescape')).hexdigest()[:HASH_DIGITS]}"
        place = str(log.path.absolute())
        jobs.append(Job(str(out.absolute()), token, name, log.id, place, log.format, log.sequence, cache))
    return jobs


MAX_ERROR_CHARS = 2000  # of a message in a table; `error.txt` has all of it
Count = Annotated[int | None, Field(ge=0)]
Amount = Annotated[float | None, Field(ge=0)]


class Row(BaseModel):
    """One log of a batch; figures are None where it failed."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    name: str  # of its folder
    log: str  # its path below the root, with the sequence where a folder holds several
    format: str
    sequence: str
    status: Literal["done", "failed"]  # "done" or "failed"
    error_kind: str = ""  # class of the error; empty without one
    error: str = ""  # its message
    attempts: Annotated[int, Field(ge=1)] = 1  # how often it was run, 2 after a repetition
    ticks: Count = None
    duration_s: Amount = None
    # Agents without the ego, those of them that stand all the time, and all that the scenario doubts.
    agents: Count = None
    static: Count = None
    doubtful: Count = None
    # Faults of sensors and poses, and records that could not be read.
    faults: Count = None
    unreadable: Count = None
    # Wall time and time of the processor, from opening the log to writing its files.
    seconds: Amount = None
    cpu_s: Amount = None
    peak_memory_mib: Amount = None  # MiB, largest resident memory of the worker so far
    # Of the replay: time of the processor, greatest distance of an agent from its path, collisions that the scenario lacks.
    replay_s: Amount = None
    cross_track_max_m: Amount = None
    new_collisions: Count = None

    @property
    def is_done(self) -> bool:
        """Whether the log was reconstructed."""
        return self.status == "done"


IDENTITY = ("name", "log", "format", "sequence")


def done_row(job: Job, scenario: Scenario, figures: dict[str, Any]) -> Row:
    """Return the row of a log that is done: what its scenario holds, and other figures."""
    return Row(
        **_identity(job), status="done", duration_s=round(scenario.duration_s, 6), agents=len(scenario.others),
        static=sum(a.static for a in scenario.others), doubtful=len(scenario.doubtful), **figures,
    )  # fmt: skip


def failed_row(job: Job, kind: str, message: str, spent: dict[str, Any] | None = None) -> Row:
    """Return the row of a log that failed."""
    text = message[:MAX_ERROR_CHARS].encode("utf-8", "backslashreplace").decode()
    return Row(**_identity(job), status="failed", error_kind=kind, error=text, **(spent or {}))


def _identity(job: Job) -> dict[str, Any]:
    texts = {key: getattr(job, key).encode("utf-8", "backslashreplace").decode() for key in IDENTITY}
    return {**texts, "attempts": job.attempts}


SUMMED = ("ticks", "duration_s", "agents", "static", "doubtful", "faults", "unreadable", "seconds", "cpu_s")


def write_parquet(path: Path, rows: Sequence[Row]) -> None:
    """Write the rows, one for each log, with the columns of `Row`."""
    import pyarrow as pa

    def kind_of(annotation: Any) -> pa.DataType:
        parts = get_args(annotation) if isinstance(annotation, UnionType) else (annotation,)  # it may be absent
        return pa.int64() if int in parts else pa.float64() if float in parts else pa.string()

    fields = [(name, kind_of(field.annotation)) for name, field in Row.model_fields.items()]
    values = {name: [getattr(row, name) for row in rows] for name, _ in fields}
    write_table(path, pa.table(values, schema=pa.schema(fields)))


def sum_up(rows: Sequence[Row]) -> dict[str, float]:
    """Return the count of logs that are done and that failed, and the sums of the figures of those that are done."""
    done = [row for row in rows if row.is_done]
    sums = {name: sum(getattr(row, name) or 0 for row in done) for name in SUMMED}
    return {"done": len(done), "failed": len(rows) - len(done), **sums}


SETTINGS_FILE = "batch.json"
LOGS = "logs"
REPORT_FILE, ROW_FILE, ERROR_FILE = "report.json", "row.json", "error.txt"
REPLAY_FILE = "replay.json"
TOKEN_BYTES = 8


class BatchSettings(BaseModel):
    """What all logs of a batch share, as `batch.json` holds it."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    batch_version: int = 1
    token: str  # random, so that workers on other machines can tell whether they see the same folder
    log2sim_version: str
    root: str  # folder that is searched for logs, absolute
    format: str  # format that is looked for, or "auto"
    follow_links: bool
    config: dict[str, Any]  # settings of the reconstruction
    replay: bool = False  # whether each scenario is replayed

    @classmethod
    def create(
        cls, root: Path, format: str, follow_links: bool, config: Config, *, replay: bool = False
    ) -> BatchSettings:
        """Return the settings of a new batch."""
        return cls(
            replay=replay, token=secrets.token_hex(TOKEN_BYTES), log2sim_version=__version__, root=str(root.resolve()),
            format=format, follow_links=follow_links, config=config.to_dict(),
        )  # fmt: skip

    def differences(self, other: BatchSettings) -> list[str]:
        """List the settings in which two batches differ, as "name: ours, theirs"."""
        mine, theirs = (_flat(s.model_dump(exclude={"token", "batch_version"})) for s in (self, other))
        names = [name for name in {**mine, **theirs} if mine.get(name) != theirs.get(name)]
        return [f"{name}: {mine.get(name)!r}, before {theirs.get(name)!r}" for name in names]


@dataclass(frozen=True)
class BatchFolder:
    """A folder of a batch."""

    path: Path
    settings: BatchSettings

    @classmethod
    def load(cls, path: Path) -> BatchFolder:
        """Open the folder of an earlier run.

        Raises `LogError` when it is none.
        """
        document = read_json(path / SETTINGS_FILE)
        try:
            return cls(path, BatchSettings.model_validate(document))
        except ValidationError as problem:
            raise LogError(f"{path / SETTINGS_FILE}: {first_problem(problem, BatchSettings)}") from None

    @classmethod
    def start(cls, path: Path, wanted: BatchSettings, *, overwrite: bool) -> BatchFolder:
        """Go on with the batch in a folder, or begin one.

        Raises `ConfigError` when the folder holds something else or a batch of other settings, or another run uses it.
        """
        claim(path / SETTINGS_FILE, overwrite=False)
        if is_batch(path):
            earlier = cls.load(path)
            changed = wanted.differences(earlier.settings)
            if changed and not overwrite:
                more = f" and {len(changed) - MAX_LISTED} more" if len(changed) > MAX_LISTED else ""
                raise ConfigError(
                    f"{path}: holds a batch of other settings ({'; '.join(changed[:MAX_LISTED])}{more}); choose another "
                    "folder, the same settings to go on, or --overwrite to start over"
                )
            if not overwrite:
                return earlier
            shutil.rmtree(path / LOGS, ignore_errors=True)
        elif path.exists() and any(entry.name != f".{SETTINGS_FILE}.lock" for entry in path.iterdir()):
            raise ConfigError(f"{path}: holds something else than a batch; give an empty or a new folder")
        write_json(path / SETTINGS_FILE, wanted.model_dump())
        return cls(path, wanted)

    def log_folder(self, name: str) -> Path:
        """Return the folder for a log."""
        return self.path / LOGS / name

    def read_row(self, name: str) -> Row | None:
        """Read what an earlier run noted about a log; None where there is nothing that can be used."""
        file = self.log_folder(name) / ROW_FILE
        if not file.is_file():
            return None
        try:
            row = Row.model_validate(read_json(file))
        except (LogError, ValidationError):
            return None
        return row if row.name == name else None

    def write_failure(self, row: Row, text: str) -> None:
        """Write the folder of a log that failed, in place of what an earlier run left there."""
        with replaced_folder(self.log_folder(row.name), overwrite=True) as unfinished:
            (unfinished / ERROR_FILE).write_text(text.rstrip() + "\n", encoding="utf-8", errors="backslashreplace")
            write_json(unfinished / ROW_FILE, row.model_dump())

    def take_unfinished(self, name: str) -> bool:
        """Remove what a worker that died left of the folder of a log; return whether there was something."""
        left = [path for path in (self.path / LOGS).glob(f".{glob.escape(name)}.*") if is_temporary(path)]
        for path in left:
            remove(path)
        return bool(left)

    def remove_left_over(self) -> None:
        """Remove what processes of this machine that are gone left of folders of logs."""
        for path in (self.path / LOGS).glob(".*"):
            if is_left_over(path):
                remove(path)


def is_batch(path: Path) -> bool:
    """Return whether a folder is that of a batch."""
    return (path / SETTINGS_FILE).is_file()


def _flat(document: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the values of nested documents under names such as "track.max_gap_s"."""
    flat: dict[str, Any] = {}
    for key, value in document.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


MAX_ROWS = 5000  # of each table, which browsers lay out in a second; the Parquet file has all
# Field of the row, title, and format of a number.
COLUMNS = (
    ("log", "log", ""), ("format", "format", ""), ("ticks", "ticks", "d"), ("duration_s", "duration s", ".1f"), ("agents", "agents", "d"),
    ("static", "static", "d"), ("doubtful", "doubtful", "d"), ("faults", "faults", "d"), ("unreadable", "unreadable", "d"),
    ("cross_track_max_m", "off path m", ".3f"), ("new_collisions", "collisions", "d"), ("seconds", "seconds", ".2f"),
    ("cpu_s", "CPU s", ".2f"), ("peak_memory_mib", "peak MiB", ".0f"), ("attempts", "attempts", "d"),
)  # fmt: skip


def write_batch_page(path: Path, rows: Sequence[Row], settings: BatchSettings, *, total: int) -> None:
    """Write the page of a batch: sums, what failed and why, and the figures of each log.

    `total`: logs of the batch; those without a row were not run yet.
    """
    with replaced(path) as temporary:
        temporary.write_text(html_of(rows, settings, total), encoding="utf-8")


def html_of(rows: Sequence[Row], settings: BatchSettings, total: int) -> str:
    """Assemble the page; its content security policy allows its own script and style by their hashes and nothing else."""
    style, script, page = (
        resources.files("log2sim.batch").joinpath(name).read_text(encoding="utf-8")
        for name in ("page.css", "page.js", "page.html")
    )
    hashes = [f"sha256-{base64.b64encode(sha256(text.encode()).digest()).decode()}" for text in (style, script)]
    failed, done = ([row for row in rows if row.is_done == wanted] for wanted in (False, True))
    parts = {
        "policy": f"default-src 'none'; script-src '{hashes[1]}'; style-src '{hashes[0]}'; img-src data:; "
        "base-uri 'none'; form-action 'none'",
        "style": style,
        "script": script,
        "root": html.escape(settings.root),
        "version": html.escape(settings.log2sim_version),
        "summary": "".join(_figures(rows, total)),
        "failures": _failures(failed),
        "logs": _logs(done),
    }
    # One pass: inserted text is not searched again, so no name of a log can be taken for a placeholder.
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], page)


def _figures(rows: Sequence[Row], total: int) -> Iterable[str]:
    """Yield the sums as entries of a list of descriptions."""
    sums = sum_up(rows)
    figures = {
        "logs": f"{total:,}",
        "done": f"{sums['done']:,.0f}",
        "failed": f"{sums['failed']:,.0f}",
        "not run yet": f"{total - len(rows):,}" if total > len(rows) else "",
        "agents": f"{sums['agents']:,.0f} ({sums['static']:,.0f} static, {sums['doubtful']:,.0f} doubtful)",
        "recorded": f"{sums['duration_s'] / 3600:,.2f} h, {sums['ticks']:,.0f} ticks",
        "CPU time": f"{sums['cpu_s'] / 3600:,.2f} h",
    }
    for name, value in figures.items():
        if value:
            mark = ' class="alert"' if name == "failed" and sums["failed"] else ""
            yield f"<div{mark}><dt>{name}</dt><dd>{value}</dd></div>"


def _failures(rows: Sequence[Row]) -> str:
    """Return the section of the logs that failed, with a count of each kind of error; empty without any."""
    if not rows:
        return ""
    counts = Counter(row.error_kind for row in rows)
    kinds = ", ".join(f"{count} {html.escape(kind)}" for kind, count in counts.most_common())
    lines = [
        f"<tr><td>{_linked(row)}</td><td>{html.escape(row.format)}</td><td>{html.escape(row.error_kind)}</td>"
        f"<td class=error>{html.escape(row.error)}</td><td class=n>{row.attempts}</td></tr>"
        for row in rows[:MAX_ROWS]
    ]
    head = "".join(f"<th>{title}</th>" for title in ("log", "format", "error", "message", "attempts"))
    return _section("Failed", f"{len(rows):,}: {kinds}", head, lines, len(rows))


def _logs(rows: Sequence[Row]) -> str:
    """Return the section of the logs that are done."""
    head = "".join(f"<th{' class=n' if form else ''}>{title}</th>" for _, title, form in COLUMNS)
    lines = [f"<tr>{''.join(_cell(row, name, form) for name, _, form in COLUMNS)}</tr>" for row in rows[:MAX_ROWS]]
    return _section("Logs", f"{len(rows):,} done", head, lines, len(rows)) if rows else ""


def _section(title: str, note: str, head: str, lines: Sequence[str], count: int) -> str:
    left_out = f"<p>The first {MAX_ROWS:,} of {count:,}; table.parquet has all.</p>" if count > MAX_ROWS else ""
    body = "\n".join(lines)
    return (
        f"<section><h2>{title} <small>{note}</small></h2>{left_out}<div class=scroll><table><thead><tr>{head}</tr></thead>"
        f"<tbody>\n{body}\n</tbody></table></div></section>"
    )


def _cell(row: Row, name: str, form: str) -> str:
    value = getattr(row, name)
    if name == "log":
        return f"<td>{_linked(row)}</td>"
    if not form:
        return f"<td>{html.escape(value)}</td>"
    return f'<td class=n data-v="{value}">{value:{form}}</td>' if value is not None else "<td class=n>-</td>"


def _linked(row: Row) -> str:
    """Return the name of a log as a link to its folder beside the page."""
    return f'<a href="logs/{html.escape(row.name)}/">{html.escape(row.log)}</a>'
