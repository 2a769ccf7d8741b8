"""Find what the road users of a scenario do: tags with their probabilities."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from log2sim.cli import options as opt
from log2sim.cli.shared import format_rows


def tag(
    scenario: opt.ScenarioPath,
    out: Annotated[Path | None, opt.write_to("FILE", "Scenario file to write, with the tags in it.")] = None,
    criticality: Annotated[Path | None, opt.option(
        "Table of measures of criticality to write, for each vehicle and the one ahead of it at each tick.",
        "FILE.csv")] = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
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
    from log2sim.scenarios import criticality_table, tag, write_criticality

    check_targets(out, criticality, overwrite=overwrite)
    tagged = tag(Scenario.load(scenario))
    shown = [g for g in tagged.tags or () if verbose or g.tag != "in_lane"]
    head = ("tag", "agent", "other", "from s", "at s", "to s", "p", "")
    rows = [
        (g.tag, g.agent, g.other or g.lane or "", f"{g.start_s:.1f}", f"{g.t_s:.1f}", f"{g.end_s:.1f}", f"{g.probability:.2f}",
         ", ".join(f"{k} {v:.3g}" for k, v in g.quantities.items()))
        for g in shown
    ]  # fmt: skip
    for line in format_rows([head, *rows]):
        opt.say(line, quiet=quiet)
    counts = {name: sum(g.tag == name for g in shown) for name in TAGS}
    opt.say(", ".join(f"{n} {name}" for name, n in counts.items() if n) or "no tag", quiet=quiet)
    if out is not None:
        tagged.save(out)
    if criticality is not None:
        write_criticality(criticality, criticality_table(tagged))
    opt.report_written(out, criticality, quiet=quiet)
