"""Situations in scenarios: tagged, found, varied, and policies tested in them."""

from __future__ import annotations

from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from log2sim.cli import options as opt
from log2sim.cli.progress import progress
from log2sim.errors import ConfigError
from log2sim.files.outputs import replaced_folder

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from log2sim.geometry import Array
    from log2sim.scenarios.failure import Outcome
    from log2sim.scenarios.index import Index
    from log2sim.scenarios.logical import Base, Logical


def tag(
    scenario: opt.ScenarioPath,
    out: Annotated[Path | None, opt.write_to("FILE", "Scenario file to write, with the tags in it.")] = None,
    criticality: Annotated[Path | None, opt.option(
        "Table of measures of criticality to write, for each vehicle and the one ahead of it at each tick.",
        "FILE.csv")] = None,
    overwrite: opt.Overwrite = False,
    verbose: opt.Verbose = False,
) -> None:  # fmt: skip
    """Find lane changes, cut-ins, overtaking, near misses and more, of the ego and of all others.

    Each tag has a probability, out of the standard deviations and the confidence of the agents, and quantities in SI units. Lanes that
    were driven in are listed with --verbose.

    Examples
    --------
    log2sim tag s.json -o tagged.json
    """
    from log2sim.datatypes import TAGS, Scenario
    from log2sim.files.documents import check_targets
    from log2sim.scenarios.tagging import criticality_table, tag, write_criticality

    check_targets(out, criticality, overwrite=overwrite)
    tagged = tag(Scenario.load(scenario))
    shown = [g for g in tagged.tags or () if verbose or g.tag != "in_lane"]
    head = ("tag", "agent", "other", "from s", "at s", "to s", "p", "")
    rows = [
        (g.tag, g.agent, g.other or g.lane or "", f"{g.start_s:.1f}", f"{g.t_s:.1f}", f"{g.end_s:.1f}", f"{g.probability:.2f}",
         ", ".join(f"{k} {v:.3g}" for k, v in g.quantities.items()))
        for g in shown
    ]  # fmt: skip
    opt.tell("\n".join(opt.format_rows([head, *rows])))
    counts = {name: sum(g.tag == name for g in shown) for name in TAGS}
    opt.tell(", ".join(f"{n} {name}" for name, n in counts.items() if n) or "no tag")
    if out is not None:
        tagged.save(out)
    if criticality is not None:
        write_criticality(criticality, criticality_table(tagged))
    opt.report_written(out, criticality)


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
    from log2sim.files.documents import check_targets
    from log2sim.scenarios.hits import say_hit, say_quantities, write_hits
    from log2sim.scenarios.index import open_index, table_of_rows, write_table
    from log2sim.scenarios.query import ask

    check_targets(out, table, overwrite=overwrite)
    if as_json:
        opt.is_quiet.set(True)
    opt.require_own_workers(jobs, scheduler)
    with progress() as report_progress, _runs(jobs, scheduler) as run:
        index = open_index(
            path, fresh=fresh, jobs=jobs,
            map_files=None if scheduler is None else lambda work, names: run(work, [str(Path(n).resolve()) for n in names]),
            progress=lambda done, total: report_progress("scenarios", done, total),
        )  # fmt: skip
    opt.say_all("left out", index.problems)
    if fields or not condition:
        opt.say("\n".join(opt.format_rows(_overview(index, fields=fields))))
        return
    found = ask(index, condition, min_probability=probability)
    if as_json:
        import json

        opt.say(json.dumps(list(found.rows), ensure_ascii=False))
    for k, row in enumerate(found.rows[:MAX_LISTED]):
        opt.tell(f"{k + 1:>4}  {row['file']}: {say_hit(row).partition(':')[0]}, {say_quantities(row)}")
    more = len(found.rows) - MAX_LISTED
    if more > 0:
        opt.tell(f"and {more} more; --out and --table have all")
    opt.tell(f"{opt.counted(len(found.rows), 'hit')} in {opt.counted(index.scenarios, 'scenario')}")
    for line in found.closest:
        opt.tell(line)
    if out is not None:
        write_hits(out, index, condition, found.rows)
    if table is not None:
        write_table(table, table_of_rows(found.rows))
    opt.report_written(out, table)
    if open_ is not None:
        if open_ > len(found.rows):
            raise ConfigError(f"--open {open_}: there are {opt.counted(len(found.rows), 'hit')}")
        import tempfile
        import webbrowser
        from urllib.parse import quote

        from log2sim.datatypes import Scenario
        from log2sim.visualization.page.writer import write_page

        hit = found.rows[open_ - 1]
        page = (
            out.with_name(f"{out.stem}-{open_}.html")
            if out is not None
            else Path(tempfile.mkdtemp(prefix="log2sim-find-")) / f"hit-{open_}.html"
        )
        write_page(Scenario.load(index.folder / hit["file"]), page, overwrite=True)
        address = f"{page.resolve().as_uri()}#t={hit['t_s']:.2f}&agent={quote(hit['agent'])}"
        webbrowser.open(address)
        opt.tell(address)


@contextmanager
def _runs(
    jobs: int | None, scheduler: str | None
) -> Iterator[Callable[[Callable[[Any], Any], Sequence[Any]], Iterator[Any]]]:
    """Yield a function that maps over tasks in their order, on processes or on the workers of a scheduler."""
    from log2sim.files.processes import default_jobs, map_in_processes

    if scheduler is None:
        yield lambda work, tasks: map_in_processes(work, tasks, jobs or default_jobs())
        return
    from log2sim.files.cluster import client_of, map_on_workers

    with client_of(scheduler) as client:
        yield partial(map_on_workers, client)


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


def _situation(path: Path, condition: str, probability: float = 0.3) -> tuple[Logical, Base]:
    """Return the distribution of a situation's parameters over all its hits, and the hit nearest to their medians.

    Raises `ConfigError` that says what was closest where there is no hit.
    """
    from log2sim.datatypes import Scenario
    from log2sim.scenarios.index import open_index
    from log2sim.scenarios.logical import TIMING, Base, choose_base, fit
    from log2sim.scenarios.query import ask

    index = open_index(path)
    found = ask(index, condition, min_probability=probability)
    if not found.rows:
        said = ("condition: nothing fulfils it", *found.closest, f"what can be varied is {', '.join(TIMING)}")
        raise ConfigError("; ".join(said))
    logical = fit(found.rows)
    chosen = choose_base(logical, found.rows)
    return logical, Base.of(Scenario.load(index.folder / chosen["file"]), chosen)


def vary(
    path: opt.ScenarioFolder,
    condition: opt.Condition,
    out: Annotated[Path, opt.write_to("DIR", "Folder for the concrete scenarios, their table and the distribution.")],
    count: Annotated[int, opt.option("Concrete scenarios to draw.", "N", min=1, max=100_000)] = 64,
    sampler: Annotated[str, opt.choose("--sampler", "sobol|lhs|random", "How parameters are drawn.")] = "sobol",
    seed: Annotated[int, opt.option("Seed of the draw.", min=0)] = 0,
    probability: opt.LeastProbability = 0.3,
    keep: Annotated[bool, opt.option("Write those, too, that something speaks against.", None, "--keep")] = False,
    openscenario: Annotated[
        bool, opt.option("Write OpenSCENARIO 1.2 with parameters and their values, too.", None, "--openscenario")
    ] = False,
    overwrite: opt.OverwriteFolder = False,
) -> None:
    """Vary a situation: fit the distribution of its parameters over all that are found, and draw concrete scenarios.

    The most usual hit is the base: its agents keep their paths and drive them faster or slower, earlier or later. DIR/logical.json has the
    distribution, DIR/variations.parquet a row for each draw with what speaks against it, DIR/N/scenario.json the concrete scenarios.

    Examples
    --------
    log2sim vary results/ "cut_in and other == 'ego'" -o variations/ --count 256 --openscenario
    """
    from log2sim.files.documents import refuse_folder, write_json
    from log2sim.scenarios.index import write_rows
    from log2sim.scenarios.logical import concrete, write_openscenario

    refuse_folder(out, overwrite=overwrite, holding="logical.json", kind="folder of variations")
    logical, base = _situation(path, condition, probability)
    chosen, values = base.row, logical.sample(count, sampler, seed)
    table, kept = [], []
    with replaced_folder(out, overwrite=overwrite) as folder:
        for k, (made, problems) in enumerate(concrete(base, logical, values)):
            written = keep or not problems
            if written:
                made.save(folder / f"{k + 1:05}" / "scenario.json")
                kept.append(k)
            file = f"{k + 1:05}/scenario.json" if written else None
            table.append({"file": file, **dict(zip(logical.names, values[k].tolist())), "problem": "; ".join(problems)})
        write_rows(folder / "variations.parquet", table)
        place = {k: chosen[k] for k in ("file", "agent", "t_s")}
        about = {"tag": chosen["tag"], "condition": condition, "base": place, "seed": seed, "sampler": sampler}
        write_json(folder / "logical.json", {**about, **logical.to_dict()})
        if openscenario:
            write_openscenario(base, [base.timings(logical, values[k]) for k in kept], folder / "openscenario")
    shown = [("parameter", "found from", "to", "5 %", "median", "95 %")]
    for name, p in logical.to_dict()["parameters"].items():
        figures = (p["least"], p["greatest"], *(p["quantiles"][q] for q in ("0.05", "0.5", "0.95")))
        shown.append((name, *(f"{figure:.4g}" for figure in figures)))
    opt.tell("\n".join(opt.format_rows(shown)))
    opt.tell(
        f"{out}: {opt.counted(len(kept), 'concrete scenario')} of {count}, by {opt.counted(len(logical.values), 'hit')}; base {chosen['agent']} "
        f"in {chosen['file']} at {chosen['t_s']:.1f} s"
    )
    refused = [row["problem"] for row in table if row["problem"]]
    if refused:
        opt.tell(f"{len(refused)} cannot be driven, collide or are no {chosen['tag']}, such as: {refused[0]}")


def test_(
    policy: Annotated[str, typer.Argument(metavar="POLICY", help="Policy for the ego, as replay --ego takes it.")],
    path: opt.ScenarioFolder,
    condition: opt.Condition,
    out: Annotated[Path, opt.write_to("DIR", "Folder for the report and the worst runs.")],
    runs: Annotated[int, opt.option("Runs in all.", "N", min=40, max=100_000)] = 400,
    limit: Annotated[list[str] | None, opt.option(
        "A failure, too: min_ttc_s, min_pet_s, min_gap_m below; max_brake_mps2, max_jerk_mps3, max_lateral_mps2 (comfort), "
        "max_speed_mps, max_off_path_m, max_red_s (rules; of a light that was red for longer) above.", "NAME=VALUE")] = None,
    agents: Annotated[str, opt.choose("--agents", "scenario|reactive", "Behavior of the other agent.")] = "scenario",
    latency: Annotated[str, opt.option(
        "How late the policy sees others, s: the mean, or mean and standard deviation.", "MEAN[:SIGMA]")] = "0",
    noise: Annotated[float, opt.option(
        "Standard deviation of where it sees them, m, on each axis.", "M", min=0.0, max=10.0)] = 0.0,
    worst: Annotated[int, opt.option("Worst runs to write, with pages that play them.", "N", min=0, max=100)] = 3,
    seed: Annotated[int, opt.option("Seed of all draws.", min=0)] = 0,
    jobs: Annotated[int | None, opt.option("Processes.", "N", min=1, default="one for each core")] = None,
    scheduler: Annotated[str | None, opt.option(
        "Drive on the workers of this Dask scheduler, which see the same folders.", "tcp://HOST:PORT")] = None,
    overwrite: opt.OverwriteFolder = False,
) -> None:  # fmt: skip
    """Test a policy in variations of a situation: where it fails, how critical, how likely.

    The situation is varied as by vary; runs are drawn ever nearer to where the policy fails, and the probability of failure over the
    distribution of all hits is estimated with its interval of 95 %. A policy that raises fails, and the report has its traceback.

    Examples
    --------
    log2sim test samples/egos.py:BrakeLate results/ "cut_in" -o test/ --limit min_ttc_s=0.5
    log2sim test samples/egos.py:BrakeLate results/ "cut_in" -o late/ --latency 0.3:0.05 --noise 0.2
    """
    from dataclasses import asdict

    import numpy as np

    from log2sim.files.documents import refuse_folder, write_json
    from log2sim.scenarios.failure import (
        LIMITS,
        describe,
        drive,
        judge_run,
        report_page,
        say_estimate,
        search,
        with_ego,
    )
    from log2sim.scenarios.index import write_rows
    from log2sim.simulation.metrics.all_metrics import parse_limits
    from log2sim.simulation.policy import load_policy
    from log2sim.simulation.sensing import NamedPolicy, parse_sensing
    from log2sim.visualization.page.writer import write_page

    refuse_folder(out, overwrite=overwrite, holding="test.json", kind="folder of a test")
    opt.require_own_workers(jobs, scheduler)
    limits, sensing = parse_limits(limit or (), list(LIMITS)), parse_sensing(latency, noise)
    load_policy(policy)  # so that a wrong name is said at once
    source, _, name = policy.rpartition(":")
    driver = NamedPolicy(f"{Path(source).resolve()}:{name}" if source.endswith(".py") else policy, sensing)
    logical, situation = _situation(path, condition)
    base = with_ego(situation)
    outcomes: list[Outcome] = []
    values: list[Array] = []
    work = partial(judge_run, base, logical, driver, limits, agents)
    with progress() as report_progress, _runs(jobs, scheduler) as run:

        def margins(scores: Array) -> Array:
            drawn = logical.from_scores(scores)
            values.extend(drawn)
            for outcome in run(work, list(drawn)):
                outcomes.append(outcome)
                report_progress("runs", len(outcomes), runs)
            return np.array([o.margin for o in outcomes[-len(drawn) :]])

        found = search(margins, len(logical.names), runs, np.random.default_rng(seed))
    if all(o.problem for o in outcomes):
        raise ConfigError(f"policy '{policy}': raises in every run: {outcomes[0].problem.strip().splitlines()[-1]}")
    table = np.array(values)
    with replaced_folder(out, overwrite=overwrite) as folder:
        links = {}
        for k in [k for k in np.argsort(found.margins).tolist() if not outcomes[k].problem][:worst]:
            made, done = drive(base, logical, driver, agents, table[k])
            name = f"run-{k + 1:05}"
            made.save(folder / name / "scenario.json")
            done.save(folder / name / "replay.json")
            write_page(made, folder / name / "view.html", replay=done)
            links[k] = f"{name}/view.html"
        title = f"{policy} in variations of {condition}"
        (folder / "report.html").write_text(
            report_page(title, logical, table, outcomes, found.estimate, links), encoding="utf-8"
        )
        write_json(
            folder / "test.json", {**describe(policy, condition, logical, found, outcomes), "sensing": asdict(sensing)}
        )
        figures = sorted({key for o in outcomes for key in o.values})
        write_rows(
            folder / "runs.parquet",
            [
                {**dict(zip(logical.names, table[k].tolist())), "margin": float(o.margin), **{f: o.values.get(f) for f in figures}, "problem": o.problem}
                for k, o in enumerate(outcomes)
            ],
        )  # fmt: skip
    failures = int((found.margins <= 0).sum())
    opt.tell(
        f"{opt.counted(failures, 'failure')} in {opt.counted(len(outcomes), 'run')}; probability of failure {say_estimate(found.estimate)}"
    )
    errors = sum(bool(o.problem) for o in outcomes)
    if errors:
        opt.tell(f"the policy raised in {opt.counted(errors, 'run')}; the report has the traceback")
    opt.tell(f"{out / 'report.html'}: written")
