"""Search where a policy fails in variations of a situation, and estimate how probable that is."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from log2sim.cli import options as opt

if TYPE_CHECKING:
    from log2sim.geometry import Array
    from log2sim.scenarios.failure import Outcome


def test_(
    policy: Annotated[str, typer.Argument(metavar="POLICY", help="Policy for the ego, as replay --ego takes it.")],
    path: opt.ScenarioFolder,
    condition: opt.Condition,
    out: Annotated[Path, opt.write_to("DIR", "Folder for the report and the worst runs.")],
    runs: Annotated[int, opt.option("Runs in all.", "N", min=40, max=100_000)] = 400,
    limit: Annotated[list[str] | None, opt.option(
        "A failure, too: min_ttc_s, min_pet_s, min_gap_m below, max_brake_mps2 above.", "NAME=VALUE")] = None,
    agents: Annotated[str, opt.choose("--agents", "scenario|reactive", "Behavior of the other agent.")] = "scenario",
    latency: Annotated[str, opt.option(
        "How late the policy sees others, s: the mean, or mean and standard deviation.", "MEAN[:SIGMA]")] = "0",
    noise: Annotated[float, opt.option(
        "Standard deviation of where it sees them, m, on each axis.", "M", min=0.0, max=10.0)] = 0.0,
    worst: Annotated[int, opt.option("Worst runs to write, with pages that play them.", "N", min=0, max=100)] = 3,
    seed: Annotated[int, opt.option("Seed of all draws.", min=0)] = 0,
    jobs: Annotated[int | None, opt.option("Processes.", "N", min=1, default="one for each core")] = None,
    overwrite: opt.OverwriteFolder = False,
    quiet: opt.Quiet = False,
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
    from functools import partial

    import numpy as np

    from log2sim.cli.progress import progress
    from log2sim.datatypes import Scenario
    from log2sim.errors import ConfigError
    from log2sim.files.documents import refuse_folder, write_json
    from log2sim.files.outputs import replaced_folder
    from log2sim.files.processes import default_jobs, map_in_processes
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
    from log2sim.scenarios.index import open_index, write_rows
    from log2sim.scenarios.logical import Base, choose_base, fit
    from log2sim.scenarios.query import ask
    from log2sim.simulation.metrics.all_metrics import parse_limits
    from log2sim.simulation.policy import load_policy
    from log2sim.simulation.sensing import DelayedPolicy, parse_sensing
    from log2sim.visualization.page.writer import write_page

    refuse_folder(out, overwrite=overwrite, holding="test.json", kind="folder of a test")
    limits, driver = parse_limits(limit or (), list(LIMITS)), load_policy(policy)
    sensing = parse_sensing(latency, noise)
    if sensing:
        driver = DelayedPolicy(driver, sensing)
    index = open_index(path)
    rows = ask(index, condition).rows
    logical = fit(rows)
    chosen = choose_base(logical, rows)
    base = with_ego(Base.of(Scenario.load(index.folder / chosen["file"]), chosen))
    outcomes: list[Outcome] = []
    values: list[Array] = []
    work = partial(judge_run, base, logical, driver, limits, agents)
    with progress(quiet=quiet) as report_progress:

        def margins(scores: Array) -> Array:
            drawn = logical.from_scores(scores)
            values.extend(drawn)
            for outcome in map_in_processes(work, list(drawn), jobs or default_jobs()):
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
    opt.say(
        f"{opt.counted(failures, 'failure')} in {opt.counted(len(outcomes), 'run')}; probability of failure {say_estimate(found.estimate)}",
        quiet=quiet,
    )
    errors = sum(bool(o.problem) for o in outcomes)
    if errors:
        opt.say(f"the policy raised in {opt.counted(errors, 'run')}; the report has the traceback", quiet=quiet)
    opt.say(f"{out / 'report.html'}: written", quiet=quiet)
