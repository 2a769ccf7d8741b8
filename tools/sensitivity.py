"""Vary every threshold of the method, one at a time, and measure what becomes of the results.

Thresholds are the numbers that modules of perception, tracking and agents assign to names in capitals, tables by category
as one, and the numeric settings; they are found by walking the modules. Each is taken 0.7 and 1.3 times, in a process of
its own that imports the method anew, so that what is derived from it follows. Detections are the labels of the log. What
comes before the stage of a threshold is computed once.

Usage: python tools/sensitivity.py --logs samples/crossing samples/scenes/*.toml [LOG ...] [--only PATTERN] [--jobs N]
       [--write BENCHMARKS.md] [--out FILE.json]. A scene may end in @HZ: that rate, by leaving out records.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bench_table import markdown
from thresholds import Threshold, import_varied, in_processes, thresholds_in

from log2sim.config import Config
from log2sim.datatypes import Log, Scenario, Stream
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.evaluation.metrics.truth import truth_from_log
from log2sim.logs.opening import open_log
from log2sim.synth.scene import load_scene
from log2sim.synth.synthesis import synthesize

METHOD = ("log2sim.datatypes.categories", "log2sim.perception", "log2sim.tracking", "log2sim.agents")
# Labels take the place of detectors, and images that of nothing.
WITHOUT = ("log2sim.perception.detect",)
SECOND_PASS = re.compile(r"log2sim\.(tracking|agents|perception\.homography(_stage|\.(?!correspondences)))")
# The logs in memory are made of these; all else is imported anew for each variation.
KEPT = re.compile(r"log2sim\.(errors|geometry|logs|synth|config|documents|evaluation|datatypes\.(?!categories$))")
FACTORS = (0.7, 1.3)
# A change by which a figure counts 1 when thresholds are ordered.
RESOLUTION = {
    "recall": 0.01, "precision": 0.01, "position_median_m": 0.01, "yaw_median_deg": 0.2, "yaw_flipped": 0.01,
    "size_median_m": 0.01,
}  # fmt: skip
FAILURE = 100.0
RANGE_M = 40.0
BEGIN, END = "<!-- bench sensitivity -->", "<!-- end sensitivity -->"

Figures = dict[str, float]


@dataclass(frozen=True, eq=False)
class Case:
    """A log and its truth; `observations` are what the first pass of the pipeline found in it with all thresholds as they are."""

    name: str
    log: Log
    truth: Scenario
    config: Config
    observations: Any = None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--logs", nargs="+", required=True, help="log folders and scene files")
    parser.add_argument("--only", default="", help="regular expression of thresholds' names")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument(
        "--stop", type=float, default=None, help="seconds of each log that are used, but of those at a rate"
    )
    parser.add_argument("--write", type=Path, help="Markdown file whose section between the markers is replaced")
    parser.add_argument("--out", type=Path, help="JSON file for all figures")
    options = parser.parse_args(arguments)
    cases = [with_observations(case_of(name, options.stop)) for name in options.logs]
    usual = {case.name: figures_of(case, case.config) for case in cases}
    found = [*thresholds_in(METHOD, WITHOUT), *settings_of(Config())]
    chosen = [t for t in found if re.search(options.only, t.label)]
    print(f"{len(chosen)} thresholds, {len(cases)} logs", flush=True)
    results: dict[str, dict[str, dict[str, Figures]]] = {}
    tasks = [(cases, t, factor) for t in chosen for factor in FACTORS]
    begin = time.monotonic()
    for k, varied in enumerate(in_processes(_varied, tasks, options.jobs)):
        threshold, factor = tasks[k][1:]
        results.setdefault(threshold.label, {})[f"{factor:g}"] = varied
        score = influence(usual, {f"{factor:g}": varied})
        print(f"{time.monotonic() - begin:6.0f} s  {threshold.label} x {factor:g}: {score:.1f}", flush=True)
        if options.out:
            options.out.write_text(json.dumps({"usual": usual, "varied": results}, indent=1), encoding="utf-8")
    text = report(usual, chosen, results)
    print(text)
    if options.write:
        write_between_markers(options.write, text)
    return 0


def case_of(name: str, stop_s: float | None = None) -> Case:
    """A recorded log by its folder, or a scene by its file, made in memory; `FILE@HZ` leaves out records down to a rate."""
    path, _, rate = name.partition("@")
    config = Config.load(None, ["detect.name=labels"], stop_s=None if rate else stop_s)
    if not path.endswith(".toml"):
        log = open_log(Path(path))
        return Case(Path(path).name, log, truth_from_log(log), config)
    scene = load_scene(path)
    log, truth = synthesize(scene)
    sweeps = {n: [log.streams[n].read(i) for i in range(len(log.streams[n].t_ns))] for n in log.lidars}
    kept = {n: replace(s, read=sweeps[n].__getitem__) if n in sweeps else s for n, s in log.streams.items()}
    step = round(scene.camera[0].rate_hz / float(rate)) if rate else 1
    streams = {n: every_nth(s, step) for n, s in kept.items()}
    return Case(Path(path).stem + (f" {rate} Hz" if rate else ""), replace(log, streams=streams), truth, config)


def every_nth(stream: Stream, step: int) -> Stream:
    """Every so-many-th record of a stream."""
    return replace(stream, t_ns=stream.t_ns[::step], read=lambda i: stream.read(i * step))


def with_observations(case: Case) -> Case:
    """The case with what the first pass finds, caught on its way through the pipeline."""
    import log2sim.pipeline as pipeline

    caught = []
    observe = pipeline.observe
    pipeline.observe = lambda *a, **k: caught.append(observe(*a, **k)) or caught[0]
    try:
        pipeline.reconstruct(case.log, case.config)
    finally:
        pipeline.observe = observe
    return replace(case, observations=caught[0])


def figures_of(case: Case, config: Config, *, again: bool = False) -> Figures:
    """What a reconstruction is worth; `again` also runs the first pass."""
    import log2sim.pipeline as pipeline

    observe = pipeline.observe
    if not again:
        pipeline.observe = lambda *a, **k: case.observations
    try:
        result = evaluate(pipeline.reconstruct(case.log, config).scenario, case.truth, max_range_m=RANGE_M)
    finally:
        pipeline.observe = observe
    return {key: result[key] for key in RESOLUTION}


def settings_of(config: Config) -> list[Threshold]:
    """Numeric settings of all stages but detection."""
    sections = {k: v for k, v in config.to_dict().items() if isinstance(v, dict) and k != "detect"}
    numbers = [(f"{s}.{k}", v) for s, values in sections.items() for k, v in values.items()]
    return [Threshold("", k, v) for k, v in numbers if isinstance(v, (int, float)) and not isinstance(v, bool) and v]


def _varied(task: tuple[Sequence[Case], Threshold, float]) -> dict[str, Figures]:
    """Figures by case with one threshold scaled; empty for a case in which the method failed."""
    cases, threshold, factor = task
    changed: list[str] = []
    if threshold.module:
        import_varied(threshold, factor, kept=lambda name: bool(KEPT.match(name)))
    else:
        value = type(threshold.value)(threshold.value * factor)
        changed = [f"{threshold.name}={value}"]
    out = {}
    for case in cases:
        try:
            config = Config.load(None, ["detect.name=labels", *changed], stop_s=case.config.stop_s)
            out[case.name] = figures_of(case, config, again=not SECOND_PASS.match(threshold.module))
        except Exception as problem:
            print(f"{threshold.label} x {factor:g}, {case.name}: {type(problem).__name__}: {problem}", file=sys.stderr)
            out[case.name] = {}
    return out


def change(usual: Figures, varied: Figures) -> float:
    """Sum of the changes of all figures, each in its resolution; `FAILURE` where the method failed."""
    if not varied:
        return FAILURE
    return sum(abs((varied[k] or 0.0) - (usual[k] or 0.0)) / r for k, r in RESOLUTION.items())


def influence(usual: dict[str, Figures], varied: dict[str, dict[str, Figures]]) -> float:
    """Largest change over factors and logs."""
    return max(change(usual[name], figures) for by_case in varied.values() for name, figures in by_case.items())


def report(usual: dict[str, Figures], thresholds: Sequence[Threshold], results: dict[str, Any]) -> str:
    """Markdown: the usual figures, a row for each threshold by falling influence, and those without any."""
    scores = {t: influence(usual, results[t.label]) for t in thresholds}
    ordered = sorted(thresholds, key=lambda t: -scores[t])
    head = ["threshold", "unit", "value", "influence", *usual]
    rows = [
        [t.label, t.unit, short(t.value), f"{scores[t]:.1f}", *(_worst(usual[n], results[t.label], n) for n in usual)]
        for t in ordered
        if scores[t] > 0
    ]
    idle = ", ".join(t.label for t in ordered if scores[t] == 0)
    figures = [[k, *("-" if f[k] is None else f"{f[k]:.3g}" for f in usual.values())] for k in RESOLUTION]
    return "\n\n".join([
        markdown(["figure", *usual], figures),
        markdown(head, rows),
        f"Without any influence on these logs ({sum(s == 0 for s in scores.values())} of {len(scores)}): {idle or 'none'}.",
    ])  # fmt: skip


def _worst(usual: Figures, results: dict[str, dict[str, Figures]], name: str) -> str:
    """What the factor that changes a log more does to its figures, in the order of `RESOLUTION`; empty for nothing."""
    factor, varied = max(results.items(), key=lambda item: change(usual, item[1][name]))
    if not varied[name]:
        return f"x{factor}: fails"
    moves = [(varied[name][k] or 0.0) - (usual[k] or 0.0) for k in RESOLUTION]
    return f"x{factor}: " + " ".join(f"{m:+.2g}" if m else "0" for m in moves) if any(moves) else ""


def short(value: Any) -> str:
    """A number, or the least and the largest of a table."""
    numbers = list(_numbers(value))
    texts = [f"{v:.3g}" for v in (min(numbers), max(numbers))]
    return texts[0] if len(numbers) == 1 or texts[0] == texts[1] else " to ".join(texts)


def _numbers(value: Any) -> Any:
    if isinstance(value, (int, float)):
        yield float(value)
    elif not isinstance(value, str):
        for one in value.values() if hasattr(value, "values") else value:
            yield from _numbers(one)


def write_between_markers(path: Path, text: str) -> None:
    """Replace what stands between the markers of a Markdown file."""
    before, _, rest = path.read_text(encoding="utf-8").partition(BEGIN)
    _, _, after = rest.partition(END)
    intro = rest.partition("| figure |")[0]
    path.write_text(f"{before}{BEGIN}{intro}{text}\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
