"""Tags of many scenarios as one table, kept in a Parquet file beside them."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from log2sim.datatypes import EGO, TAGS, Scenario
from log2sim.errors import LogError, MissingExtra, ScenarioError
from log2sim.files.documents import replaced
from log2sim.files.processes import default_jobs, map_in_processes

INDEX_FILE = "tags.parquet"
INDEX_VERSION = 3  # one more where tags are defined differently
KEY = b"log2sim.tags"

TEXTS = ("file", "scenario", "tag", "agent", "other", "lane")
NUMBERS = ("start_s", "t_s", "end_s", "probability")
ROLES = ("ego", "agent", "other")
ROLE_NUMBERS, ROLE_TEXTS = ("speed_mps", "acceleration_mps2", "confidence"), ("category",)
SCENARIO_FILE = "scenario.json"

Row = dict[str, Any]
Progress = Callable[[int, int], None]
MapFiles = Callable[[Callable[[str], "Indexed"], Sequence[str]], Iterable["Indexed"]]


@dataclass(frozen=True)
class Indexed:
    """Rows of a scenario file, or why it has none."""

    file: str
    rows: tuple[Row, ...] = ()
    problem: str = ""


@dataclass(frozen=True)
class Index:
    """Tags of scenarios."""

    folder: Path  # that `file` of each row is relative to
    # A row for each tag, with `TEXTS`, `NUMBERS`, quantities, and ROLE.FIELD for the states of agents at `t_s`.
    table: Any
    scenarios: int  # how many files were read
    problems: tuple[str, ...] = ()  # files that could not be, and why


def rows_of(scenario: Scenario, file: str) -> list[Row]:
    """Return a row for each tag of a scenario: those that it has, else those that are found in it."""
    from log2sim.scenarios.tagging import find_tags
    from log2sim.simulation.prediction.motion_table import TICK_S

    tags = find_tags(scenario) if scenario.tags is None else scenario.tags
    agents = {a.id: a for a in scenario.agents}
    rows = []
    for tag in tags:
        row: Row = {**tag.quantities, **vars(tag), "file": file, "scenario": scenario.name}
        del row["quantities"]
        for role, id in zip(ROLES, (EGO, tag.agent, tag.other)):
            agent = agents.get(id or "")
            if agent is None:
                continue
            states = agent.at([tag.t_s - TICK_S, tag.t_s, tag.t_s + TICK_S], margin_s=1e-3)
            before, now, after = states.speed_mps.tolist()
            ends = (before if np.isfinite(before) else now), (after if np.isfinite(after) else now)
            span_s = TICK_S * (np.isfinite(before) + np.isfinite(after))
            row[f"{role}.category"], row[f"{role}.confidence"] = agent.category, agent.confidence
            if np.isfinite(now):
                row[f"{role}.speed_mps"] = now
                row[f"{role}.acceleration_mps2"] = (ends[1] - ends[0]) / span_s if span_s else 0.0
        rows.append(row)
    return rows


def index_file(path: str) -> Indexed:
    """Read a scenario file and return its rows, or what is wrong with it."""
    try:
        return Indexed(path, tuple(rows_of(Scenario.load(path), path)))
    except LogError as problem:
        return Indexed(path, problem=str(problem))


def import_arrow() -> Any:
    """Return pyarrow; raise `MissingExtra` without it."""
    try:
        import pyarrow
    except ImportError:
        raise MissingExtra("log2sim find", "find") from None
    return pyarrow


def table_of_rows(rows: Sequence[Row]) -> Any:
    """Return the rows as a pyarrow table, ordered by tag, so that groups of rows of other tags are passed over."""
    pa = import_arrow()
    rows = sorted(rows, key=lambda r: (r["tag"], r["file"], r["t_s"]))
    roles = [f"{role}.{name}" for role in ROLES for name in (*ROLE_NUMBERS, *ROLE_TEXTS)]
    texts = {*TEXTS, *(f"{role}.{name}" for role in ROLES for name in ROLE_TEXTS)}
    quantities = sorted({key for row in rows for key in row} - {*TEXTS, *NUMBERS, *roles})
    fields = [(key, pa.string() if key in texts else pa.float64()) for key in (*TEXTS, *NUMBERS, *quantities, *roles)]
    return pa.table({key: pa.array([row.get(key) for row in rows], kind) for key, kind in fields})


def find_scenarios(folder: Path) -> Iterator[str]:
    """Yield the names below a folder of scenario files: of a batch those of its logs, elsewhere all JSON files that begin as one."""
    # Strings, since a path object for each of ten thousand files takes longer than a question.
    top = os.path.join(folder, "")
    logs = os.path.join(top, "logs")
    for root, folders, files in os.walk(logs if (folder / "batch.json").is_file() and os.path.isdir(logs) else top):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(files):
            file = os.path.join(root, name)
            if name == SCENARIO_FILE or (name.endswith(".json") and _begins_as_scenario(file)):
                yield file[len(top) :]


def _begins_as_scenario(path: str) -> bool:
    try:
        with open(path, "rb") as file:
            return b'"scenario_version"' in file.read(64)
    except OSError:
        return False


def open_index(
    path: Path,
    *,
    fresh: bool = False,
    jobs: int | None = None,
    map_files: MapFiles | None = None,
    progress: Progress | None = None,
) -> Index:
    """Open the index of a folder, after files that are new, changed or gone were brought up to date in it; of one file it is only made.

    Raises `ScenarioError` where there is no scenario. Raises `MissingExtra` without pyarrow.

    `path`: a scenario file, or a folder such as that of a batch. `fresh`: whether to read all files again. `jobs`: processes that tag,
    by default one for each core. `map_files`: applies a function to names of files elsewhere, such as on the workers of a cluster.
    """
    import_arrow()
    if path.is_file():
        return Index(path.parent, table_of_rows(rows_of(Scenario.load(path), path.name)), 1)
    found = {name: os.stat(os.path.join(path, name)) for name in find_scenarios(path)} if path.is_dir() else {}
    files = {name: [s.st_size, s.st_mtime_ns] for name, s in found.items()}
    if not files:
        raise ScenarioError(
            f"{path}: holds no scenario; expected a scenario.json, or a folder with some, such as that of log2sim batch"
        )
    known, old = ({}, None) if fresh else _read(path / INDEX_FILE)
    problems = dict(known.get("problems", {}))
    stamps = known.get("files", {})
    missing = [name for name, stamp in files.items() if stamps.get(name) != stamp]
    if not missing and set(stamps) == set(files) and old is not None:
        return Index(path, old, len(files), tuple(problems[name] for name in sorted(problems)))
    kept = [] if old is None else [r for r in old.to_pylist() if r["file"] in files and r["file"] not in missing]
    rows = [{k: v for k, v in row.items() if v is not None} for row in kept]
    problems = {name: text for name, text in problems.items() if name in files and name not in missing}
    run = map_files or (
        lambda work, names: map_in_processes(work, names, min(jobs or default_jobs(), max(len(names) // 8, 1)))
    )
    for k, done in enumerate(run(index_file, [str(path / name) for name in missing])):
        name = str(Path(done.file).relative_to(path))
        rows += [{**row, "file": name} for row in done.rows]
        if done.problem:
            problems[name] = done.problem
        if progress is not None:
            progress(k + 1, len(missing))
    table = table_of_rows(rows)
    about = {"version": INDEX_VERSION, "tags": sorted(TAGS), "files": files, "problems": problems}
    table_with_files = table.replace_schema_metadata({KEY: json.dumps(about).encode()})
    write_table(path / INDEX_FILE, table_with_files, row_group_size=20_000)
    return Index(path, table, len(files), tuple(problems[name] for name in sorted(problems)))


def _read(path: Path) -> tuple[dict[str, Any], Any]:
    """Read an index that this version wrote; nothing where there is none, or it cannot be used."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path) as file:  # `read_table` loads pandas
            table = file.read()
        about = json.loads(table.schema.metadata[KEY])
        same = about["version"] == INDEX_VERSION and about["tags"] == sorted(TAGS)
        return (about, table) if same and set(TEXTS) <= set(table.column_names) else ({}, None)
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError):
        return {}, None


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write rows of any columns, all the same, as a Parquet file."""
    write_table(path, import_arrow().Table.from_pylist(list(rows)))


def write_table(path: Path, table: Any, **options: Any) -> None:
    """Write an Arrow table as a Parquet file."""
    import pyarrow.parquet as pq

    with replaced(path) as temporary:
        pq.write_table(table, temporary, **options)
