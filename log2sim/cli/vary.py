"""Make a situation that was found in many scenarios a logical scenario, and concrete scenarios of it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from log2sim.cli import options as opt
from log2sim.cli.shared import format_rows


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
    quiet: opt.Quiet = False,
) -> None:
    """Vary a situation: fit the distribution of its parameters over all that are found, and draw concrete scenarios.

    The most usual hit is the base: its agents keep their paths and drive them faster or slower, earlier or later. DIR/logical.json has the
    distribution, DIR/variations.parquet a row for each draw with what speaks against it, DIR/N/scenario.json the concrete scenarios.

    Examples
    --------
    log2sim vary results/ "cut_in and other == 'ego'" -o variations/ --count 256 --openscenario
    """
    from log2sim.datatypes import Scenario
    from log2sim.files.documents import refuse_folder, write_json
    from log2sim.files.outputs import replaced_folder
    from log2sim.scenarios.index import open_index, write_rows
    from log2sim.scenarios.logical import Base, choose_base, concrete, fit, write_openscenario
    from log2sim.scenarios.query import ask

    refuse_folder(out, overwrite=overwrite, holding="logical.json", kind="folder of variations")
    index = open_index(path)
    rows = ask(index, condition, min_probability=probability).rows
    logical = fit(rows)
    chosen = choose_base(logical, rows)
    base = Base.of(Scenario.load(index.folder / chosen["file"]), chosen)
    values = logical.sample(count, sampler, seed)
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
        about = {
            "tag": chosen["tag"],
            "condition": condition,
            "base": {k: chosen[k] for k in ("file", "agent", "t_s")},
            "seed": seed,
        }
        write_json(folder / "logical.json", {**about, "sampler": sampler, **logical.to_dict()})
        if openscenario:
            write_openscenario(base, [base.timings(logical, values[k]) for k in kept], folder / "openscenario")
    described = logical.to_dict()["parameters"]
    head = ("parameter", "found from", "to", "5 %", "median", "95 %")
    shown = [
        (
            name,
            f"{p['least']:.4g}",
            f"{p['greatest']:.4g}",
            *(f"{p['quantiles'][q]:.4g}" for q in ("0.05", "0.5", "0.95")),
        )
        for name, p in described.items()
    ]
    for line in format_rows([head, *shown]):
        opt.say(line, quiet=quiet)
    opt.say(
        f"{out}: {opt.counted(len(kept), 'concrete scenario')} of {count}, by {opt.counted(len(logical.values), 'hit')}; base {chosen['agent']} "
        f"in {chosen['file']} at {chosen['t_s']:.1f} s",
        quiet=quiet,
    )
    refused = [row["problem"] for row in table if row["problem"]]
    if refused:
        opt.say(
            f"{len(refused)} cannot be driven, collide or are no {chosen['tag']}, such as: {refused[0]}", quiet=quiet
        )
