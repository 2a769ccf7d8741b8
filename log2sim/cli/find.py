"""Find situations in many scenarios by a condition on their tags."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from log2sim.cli import options as opt
from log2sim.cli.shared import format_rows

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from log2sim.scenarios.index import Index, Row

    MapFiles = Callable[[Callable[[str], Any], Sequence[str]], Iterator[Any]]

MAX_LISTED = 40


def find(
    path: Annotated[Path, typer.Argument(
        metavar="FOLDER", help="Folder with scenarios, such as that of batch, or one scenario.json.")],
    condition: Annotated[str, typer.Argument(
        metavar="CONDITION",
        help="Such as 'cut_in and ttc_s < 2 and ego.speed_mps > 10'; without one, all tags are counted.")] = "",
    out: Annotated[Path | None, opt.write_to("FILE.html", "Page of the hits to write, with pictures.")] = None,
    table: Annotated[Path | None, opt.option("Parquet file of the hits to write.", "FILE.parquet")] = None,
    open_: Annotated[int | None, opt.option(
        "Open the moment of this hit in the page of log2sim view.", "N", "--open", min=1)] = None,
    probability: opt.LeastProbability = 0.3,
    fields: Annotated[bool, opt.option("List the fields of these scenarios' tags.", None, "--fields")] = False,
    fresh: Annotated[bool, opt.option(
        "Read all scenarios again, not only those that are new or changed.", None, "--fresh")] = False,
    jobs: Annotated[int | None, opt.option("Processes that tag.", "N", min=1, default="one for each core")] = None,
    scheduler: Annotated[str | None, opt.option(
        "Tag on the workers of this Dask scheduler, which see the same folders.", "tcp://HOST:PORT")] = None,
    as_json: opt.AsJson = False,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Find situations in many scenarios by a condition on their tags.

    FOLDER/tags.parquet keeps the tags. A condition has tags, fields, numbers and texts with and, or, not, < <= > >= == !=, in and
    arithmetic; ego, agent and other have speed_mps, acceleration_mps2, confidence and category. A second tag is true where it shares
    a road user and a time with the first: 'cut_in and hard_braking.deceleration_mps2 > 5'.

    Tags: in_lane, lane_change, turning, u_turn, starting, stopping, standing, standing_at_light, standing_at_crosswalk, hard_braking,
    following, approaching, cut_in, cut_out, merging, overtaking, crossing_path, turning_across, oncoming_in_lane, stepping_out, near_miss.

    Examples
    --------
    log2sim find results/ "cut_in and ttc_s < 2 and ego.speed_mps > 10" -o hits.html
    """
    from log2sim.cli.progress import progress
    from log2sim.errors import ConfigError
    from log2sim.files.documents import check_targets
    from log2sim.scenarios.hits import say_hit, say_quantities, write_hits
    from log2sim.scenarios.index import open_index, write_table
    from log2sim.scenarios.query import ask

    check_targets(out, table, overwrite=overwrite)
    quiet = quiet or as_json
    opt.require_own_workers(jobs, scheduler)
    with progress(quiet=quiet) as report_progress:
        index = open_index(
            path, fresh=fresh, jobs=jobs, map_files=_on_workers(scheduler) if scheduler else None,
            progress=lambda done, total: report_progress("scenarios", done, total),
        )  # fmt: skip
    opt.say_all("left out", index.problems, quiet=quiet)
    if fields or not condition:
        for line in format_rows(_overview(index, fields=fields)):
            opt.say(line)
        return
    found = ask(index, condition, min_probability=probability)
    if as_json:
        import json

        opt.say(json.dumps(list(found.rows), ensure_ascii=False))
    for k, row in enumerate(found.rows[:MAX_LISTED]):
        opt.say(f"{k + 1:>4}  {row['file']}: {say_hit(row).partition(':')[0]}, {say_quantities(row)}", quiet=quiet)
    more = len(found.rows) - MAX_LISTED
    if more > 0:
        opt.say(f"and {more} more; --out and --table have all", quiet=quiet)
    opt.say(f"{opt.counted(len(found.rows), 'hit')} in {opt.counted(index.scenarios, 'scenario')}", quiet=quiet)
    for line in found.closest:
        opt.say(line, quiet=quiet)
    if out is not None:
        write_hits(out, index, condition, found.rows)
    if table is not None:
        write_table(table, found.rows)
    opt.report_written(out, table, quiet=quiet)
    if open_ is not None:
        if open_ > len(found.rows):
            raise ConfigError(f"--open {open_}: there are {opt.counted(len(found.rows), 'hit')}")
        opt.say(_opened(index, found.rows[open_ - 1], open_, out), quiet=quiet)


def _on_workers(scheduler: str) -> MapFiles:
    """Return a function that maps over files on the workers of a scheduler."""
    from log2sim.batch.run import workers_of

    def run(work: Callable[[str], Any], names: Sequence[str]) -> Iterator[Any]:
        with workers_of(scheduler) as workers:
            yield from map_on_workers(workers.client, work, names)

    return run


def map_on_workers(client: Any, work: Callable[[str], Any], names: Sequence[str]) -> Iterator[Any]:
    """Yield what a function makes of files on the workers of a client, in any order; each result is freed once it was taken."""
    from distributed import as_completed

    for future in as_completed(client.map(work, [str(Path(n).resolve()) for n in names], pure=False)):
        yield future.result()


def _overview(index: Index, *, fields: bool) -> list[tuple[str, str, str]]:
    """Count tags, or list fields with their ranges."""
    import pyarrow.compute as pc

    from log2sim.datatypes import TAGS

    if not fields:
        counts = {entry["values"]: entry["counts"] for entry in pc.value_counts(index.table["tag"]).to_pylist()}
        return [("tag", "count", ""), *((name, str(counts[name]), TAGS[name]) for name in TAGS if name in counts)]
    rows = [("field", "known", "from to")]
    for name in index.table.column_names:
        column = index.table[name]
        known = len(column) - column.null_count
        span = pc.min_max(column).as_py() if known and str(column.type) == "double" else None
        rows.append((name, str(known), f"{span['min']:.4g} {span['max']:.4g}" if span else ""))
    return rows


def _opened(index: Index, row: Row, number: int, out: Path | None) -> str:
    """Write the page of a hit's scenario, open it in a browser at the moment, and return its address."""
    import tempfile
    import webbrowser
    from urllib.parse import quote

    from log2sim.datatypes import Scenario
    from log2sim.visualization.page.writer import write_page

    page = (
        out.with_name(f"{out.stem}-{number}.html")
        if out is not None
        else Path(tempfile.mkdtemp(prefix="log2sim-find-")) / f"hit-{number}.html"
    )
    write_page(Scenario.load(index.folder / row["file"]), page, overwrite=True)
    address = f"{page.resolve().as_uri()}#t={row['t_s']:.2f}&agent={quote(row['agent'])}"
    webbrowser.open(address)
    return address
