"""Switch off every rule, option and constant of the method, one at a time, and measure what becomes of the results.

    python tools/ablate.py LOG|SCENE.toml ... --out FILE.jsonl [--stages tracking,agents] [--idle] [--workers 8] [--detector labels]
    python tools/ablate.py --out FILE.jsonl           # tables of what was measured so far

Constants are numbers, or tables of numbers, that modules assign to names in capitals, and numeric settings: each is taken at the
value that switches it off (0, infinite for an upper limit). Options are the other choices of settings.
Rules are functions that are replaced by their neutral result: one that returns what it gets (`Track -> Track`) hands it on, one
that answers yes or no always says no, and always yes, one that may find nothing (`X | None`) finds nothing, and one that returns a list an
empty one. Each variation runs in a process of its own; stages before the one that it belongs to are computed once. The noise of a figure
in a log is what it does with other seeds and starts of the log. Rows are appended to the file as they come; what is there already is
not measured again.
"""

from __future__ import annotations

import ast
import dataclasses
import hashlib
import importlib
import inspect
import json
import math
import multiprocessing
import pkgutil
import re
import signal
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Annotated, Any, Literal, get_args, get_origin
from unittest.mock import patch

import numpy as np
import typer
from benchmarks.table import markdown
from entry import run

from log2sim import pipeline
from log2sim.config import Config, Section
from log2sim.datatypes import Log, Scenario
from log2sim.errors import ConfigError
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.evaluation.metrics.truth import truth_from_log
from log2sim.logs.opening import open_log
from log2sim.synth.scene import load_scene
from log2sim.synth.synthesis import synthesize

# Stages in their order: their functions in `log2sim.pipeline`, then the modules and the settings that first matter in them.
STAGES = {
    "localization": (("localize", "check_calibration", "register_road"), "localization", "poses calibration cooperation"),
    "perception": (("observe",), "perception datatypes", "cameras sync detect lidar measure"),
    "homography": (("fit_homographies", "place_by_homography"), "perception.homography perception.homography_stage", "topdown seed"),
    "fusion": (("fuse",), "perception.fusion", ""),
    "tracking": (("track", "mark_unrecorded"), "tracking", "track"),
    "agents": (("estimate.estimate_agents", "decide_headings"), "agents", "smooth"),
    "judgement": (("judge",), "agents.judge agents.evidence agents.rays agents.weights", ""),
    "road": (("describe",), "road", "map appearance"),
}  # fmt: skip
# Figures with the change that counts as one step, and whether more is better.
FIGURES = {
    "recall": (0.01, True), "precision": (0.01, True), "hota": (0.01, True), "position_median_m": (0.01, False),
    "position_rmse_m": (0.02, False), "yaw_median_deg": (0.2, False), "yaw_flipped": (0.01, False),
    "speed_rmse_mps": (0.05, False), "size_median_m": (0.01, False), "invented": (0.01, False),
    "duplicate": (0.01, False), "wrong_speed": (0.01, False), "backwards": (0.01, False), "wrong_size": (0.01, False),
    "wrong": (0.01, False), "wrong_doubted": (0.05, True), "right_doubted": (0.02, False), "ece": (0.02, False),
    "nees": (0.1, False), "line_recall": (0.02, True), "line_precision": (0.02, True), "lane_recall": (0.02, True),
    "lane_precision": (0.02, True), "color_right": (0.05, True),
}  # fmt: skip
NOISE_SIGMAS, SEEDS = 2.0, 3  # further runs of each log measure its noise
FAILURE = -100.0
UPPER_LIMIT = re.compile(r"(^|_)(MAX|LIMIT|GATE|LONGEST|LARGEST|FARTHEST|UNTIL)(_|$)")
# Types that are handed on by arithmetic and not by rules.
PLAIN = re.compile(r"^(Array|Mask|float|int|str|NDArray.*|np\..*|Any|None|bytes|Path)$")

Figures = dict[str, float | None]


@dataclass(frozen=True, eq=False)
class Variation:
    """A change of the method: `value` takes the place of a constant, function or setting; settings have no module."""

    stage: str
    module: str
    name: str
    change: str
    value: Any
    before: Any = None
    column: str = ""

    @property
    def label(self) -> str:
        """Short name for tables."""
        return ".".join(p for p in (self.module.removeprefix("log2sim."), self.name, self.column) if p)


@dataclass(frozen=True, eq=False)
class Case:
    """A log with its truth, and what each function of the pipeline returned in it."""

    name: str
    log: Log
    truth: Scenario
    recorded: dict[str, list[Any]] = field(default_factory=dict)


# Tasks hold what cannot be sent to a process; forked ones find them here.
WORK: list[Any] = []


def main(
    logs: Annotated[list[str] | None, typer.Argument(metavar="LOG|SCENE.toml")] = None, out: Path = Path("ablation.jsonl"),
    stages: str = ",".join(STAGES), idle: bool = False, workers: int | None = None, detector: str = "labels",
) -> None:  # fmt: skip
    """Measure what is missing in the file, with `idle` only of what changes nothing beyond noise so far, and print its tables."""
    rows = rows_of(out)
    if logs:
        config = Config.load(detect={"name": detector})
        matter, done = matters(rows) if idle else set(), {(r["case"], r["label"], r["change"]) for r in rows}
        chosen = [v for v in variations(config) if v.stage in stages.split(",") and v.label not in matter]
        seeds = [Variation("localization", "", "seed", str(k), k) for k in range(SEEDS + 1)]
        cases = [recorded(case_of(name, detector), config) for name in logs]
        tasks = [(c, v) for v in (*seeds, *chosen) for c in cases if (c.name, v.label, v.change) not in done]
        print(f"{len(chosen)} variations, {len(cases)} logs, {len(tasks)} runs", file=sys.stderr, flush=True)
        WORK[:] = [config, Imports(method_modules()), tasks]
        with (
            multiprocessing.get_context("fork").Pool(workers, maxtasksperchild=1) as pool,
            out.open("a", encoding="utf-8") as file,
        ):
            for index, figures, outcome in pool.imap_unordered(run_one, range(len(tasks))):
                case, v = tasks[index]
                row = {"case": case.name, "label": v.label, "change": v.change, "stage": v.stage}
                rows.append({**row, "value": short(v.before), "figures": figures, "outcome": outcome})
                print(json.dumps(rows[-1]), file=file, flush=True)
    print(tables(rows))


def rows_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []


def run_one(index: int) -> tuple[int, Figures, str]:
    """Run one task in a forked process; its outcome is a digest of the scenario or why there is none."""
    config, graph, tasks = WORK
    case, variation = tasks[index]

    def out_of_time(*_: Any) -> None:
        raise TimeoutError("runs for more than 300 s")

    signal.signal(signal.SIGALRM, out_of_time)
    signal.alarm(300)
    try:
        if variation.name == "seed":
            # The same log from another tick on, with other random numbers: differences that say nothing of the method.
            k = variation.value
            config = config.changed(seed=k, **({"start_s": 0.15 * k} if k else {}))
        elif variation.module:
            graph.put(variation.module, variation.name, variation.value)
        else:
            section, _, key = variation.name.partition(".")
            config = config.changed(**{section: {key: variation.value}})
        return index, *figures_of(case, config, variation.stage)
    except (ConfigError, TimeoutError) as problem:
        return index, {}, f"refused: {problem}"
    except Exception as problem:
        return index, {}, f"fails: {type(problem).__name__}: {problem}"
    finally:
        signal.alarm(0)


# Logs, and the pipeline with stages that are not computed again.


def case_of(path: str, detector: str) -> Case:
    """A log by its folder, or a scene by its file, made in memory."""
    name = Path(path).stem + ("" if detector == "labels" else f" {detector}")
    if not path.endswith(".toml"):
        log = open_log(Path(path))
        return Case(name, log, truth_from_log(log))
    log, truth = synthesize(load_scene(path))
    sweeps = {n: [log.streams[n].read(i) for i in range(len(log.streams[n].t_ns))] for n in log.lidars}
    kept = {n: replace(s, read=sweeps[n].__getitem__) if n in sweeps else s for n, s in log.streams.items()}
    return Case(name, replace(log, streams=kept), truth)


def place_of(name: str) -> tuple[Any, str]:
    """Where the pipeline finds a function: itself or a module in it, and the name there."""
    module, _, function = name.rpartition(".")
    return getattr(pipeline, module) if module else pipeline, function


def recorded(case: Case, config: Config) -> Case:
    """The case with what the stages return in it."""

    def recording(name: str, usual: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        case.recorded.setdefault(name, []).append(out := usual(*arguments, **named))
        return out

    with ExitStack() as patches:
        for name in (name for functions, _, _ in STAGES.values() for name in functions):
            place = place_of(name)
            patches.enter_context(patch.object(*place, partial(recording, name, getattr(*place))))
        pipeline.reconstruct(case.log, config, cache=False)
    return case


def figures_of(case: Case, config: Config, stage: str) -> tuple[Figures, str]:
    """What a reconstruction is worth that computes anew from a stage on, and a digest of it.

    The road is computed only for the stages before the homography and for its own.
    """
    names = list(STAGES)
    given = [n for s in names[: names.index(stage)] for n in STAGES[s][0]]
    for name in given:
        results = iter(case.recorded[name])
        setattr(*place_of(name), lambda *_, results=results, **__: next(results))
    with_road = stage in ("localization", "perception", "road")
    if not with_road:
        _, decisions, figures = case.recorded["describe"][0]
        pipeline.describe = lambda scenario, *_, **__: (scenario, decisions, figures)
    scenario = pipeline.reconstruct(case.log, config, cache=False).scenario
    document = scenario.to_dict()
    agents = [{k: v for k, v in agent.items() if k != "color"} for agent in document["agents"]]
    digest = hashlib.sha256(json.dumps(agents).encode()).hexdigest()[:12]
    if with_road:
        road = {k: v for k, v in document.items() if k not in ("provenance", "stages")}
        digest += hashlib.sha256(json.dumps(road).encode()).hexdigest()[:12]
    return selected(evaluate(scenario, case.truth)), digest


def selected(found: dict[str, Any]) -> Figures:
    """The figures of `FIGURES` in an evaluation."""
    c, road, nees = found["correctness"], found["map_features"] or {}, found["correctness"]["sigma"]["nees"]
    named = (("line", road.get("lane_lines", {})), ("lane", road.get("lanes", {})))
    lines = {f"{name}_{key}": figures.get(key) for name, figures in named for key in ("recall", "precision")}
    values = {
        **found, **{k: c[k]["share"] for k in ("invented", "duplicate", "wrong_speed", "backwards", "wrong_size", "wrong")},
        "wrong_doubted": c["doubted"]["wrong_ticks"], "right_doubted": c["doubted"]["right_ticks"],
        "ece": c["calibration"]["agents"]["expected_calibration_error"], "nees": abs(math.log(nees)) if nees else None,
        **lines, "color_right": (found["colors"] or {}).get("accuracy"),
    }  # fmt: skip
    return {key: values.get(key) for key in FIGURES}


# What there is to vary.


def method_modules() -> list[ModuleType]:
    """All modules that belong to a stage."""
    rooms = sorted({"log2sim." + p.split(".")[0] for _, places, _ in STAGES.values() for p in places.split()})
    modules = []
    for room in rooms:
        root = importlib.import_module(room)
        modules.append(root)
        modules += [importlib.import_module(i.name) for i in pkgutil.walk_packages(root.__path__, room + ".")]
    return modules


def stage_of(module: str) -> str:
    """Stage of a module, by its longest beginning among `STAGES`."""
    places = {place: stage for stage, (_, rooms, _) in STAGES.items() for place in rooms.split()}
    return places[max((p for p in places if f"{module}.".startswith(f"log2sim.{p}.")), key=len)]


def variations(config: Config) -> Iterator[Variation]:
    for module in method_modules():
        stage = stage_of(module.__name__)
        yield from map(switched_off, constants_in(module, stage))
        yield from rules_in(module, stage)
    yield from settings(config)


def constants_in(module: ModuleType, stage: str) -> Iterator[Variation]:
    """Numbers and tables of numbers that a module assigns to names in capitals; what is derived without a literal is none."""
    for node in ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8")).body:
        if not isinstance(node, (ast.Assign, ast.AnnAssign)) or node.value is None:
            continue
        if not any(isinstance(n, ast.Constant) and isinstance(n.value, (int, float)) for n in ast.walk(node.value)):
            continue
        for name in (n for n in names_of(node) if n.isupper() and not n.startswith("_")):
            value = getattr(module, name)
            rows = list(value.values()) if isinstance(value, Mapping) else [value]
            made = Variation(stage, module.__name__, name, "", value, value)
            if rows and all(dataclasses.is_dataclass(r) for r in rows):
                for column in (f.name for f in dataclasses.fields(rows[0]) if f.init):
                    numbers = [getattr(r, column) for r in rows]
                    if any(True for _ in numbers_in(numbers)):
                        yield replace(made, column=column, before=numbers)
            elif any(True for _ in numbers_in(value)):
                yield made


def names_of(node: ast.Assign | ast.AnnAssign) -> list[str]:
    """Names that a statement assigns."""
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    return [n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)]


def numbers_in(value: Any) -> Iterator[float]:
    """All numbers in a number, an array or a table."""
    if isinstance(value, np.ndarray):
        yield from map(float, value.ravel() if value.dtype.kind in "fi" else ())
    elif isinstance(value, (Mapping, tuple, list)):
        for one in value.values() if isinstance(value, Mapping) else value:
            yield from numbers_in(one)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield float(value)


def switched_off(constant: Variation) -> Variation:
    """A constant that takes no effect."""
    upper = UPPER_LIMIT.search((constant.column or constant.name).upper())

    def number(v: float) -> float:
        return type(v)((10**6 if isinstance(v, int) else math.inf) if upper else 0)

    return replace(constant, change="off", value=mapped(constant.value, number, constant.column))


def mapped(value: Any, number: Callable[[float], float], column: str = "") -> Any:
    """A value with every number in it, or in one column of its records, replaced."""
    if isinstance(value, Mapping):
        return type(value)({k: mapped(v, number, column) for k, v in value.items()})  # type: ignore[call-arg]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [f.name for f in dataclasses.fields(value) if f.init and column in ("", f.name)]
        return replace(value, **{n: mapped(getattr(value, n), number) for n in names})
    if isinstance(value, (tuple, list)):
        parts = [mapped(v, number) for v in value]
        return type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
    if isinstance(value, np.ndarray) and value.dtype.kind in "fi":
        return np.array([number(v) for v in value.ravel().tolist()], dtype=value.dtype).reshape(value.shape)
    return number(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else value


def rules_in(module: ModuleType, stage: str) -> Iterator[Variation]:
    """Functions of a module with a neutral result that their signature tells."""
    for name, function in vars(module).items():
        if not isinstance(function, FunctionType) or function.__module__ != module.__name__:
            continue
        same_type = partial(re.sub, r"^(Sequence|Iterable|list)\[", "list[")  # all kinds of sequences are alike
        annotations = [str(p.annotation) for p in inspect.signature(function).parameters.values()]
        returns = str(function.__annotations__.get("return", ""))
        made = Variation(stage, module.__name__, name, "", None, "function")
        changes: dict[str, Callable[..., Any]] = {}
        if returns == "bool":
            changes = {"off": lambda *_, **__: False, "always": lambda *_, **__: True}
        elif returns.endswith("| None"):
            changes = {"off": lambda *_, **__: None}
        elif annotations and same_type(annotations[0]) == same_type(returns) and not PLAIN.match(returns):
            changes = {"off": (lambda x, *_, **__: list(x)) if returns.startswith("list") else (lambda x, *_, **__: x)}
        elif returns.startswith("list"):
            changes = {"off": lambda *_, **__: []}
        yield from (replace(made, change=change, value=value) for change, value in changes.items())


def settings(config: Config) -> Iterator[Variation]:
    """Other choices of options, and numbers switched off."""
    stages = {section: stage for stage, (_, _, sections) in STAGES.items() for section in sections.split()}
    for section, model in config:
        for key, info in type(model).model_fields.items() if isinstance(model, Section) else ():
            value = getattr(model, key)
            made = Variation(stages[section], "", f"{section}.{key}", "", value, value)
            if isinstance(value, bool):
                yield replace(made, change=str(not value), value=not value)
            elif get_origin(info.annotation) is Literal:
                yield from (replace(made, change=c, value=c) for c in get_args(info.annotation) if c != value)
            elif isinstance(value, (int, float)) and value:
                yield switched_off(made)


class Imports:
    """Where the names of modules end up: in other modules, in what is derived from them, and in defaults of functions."""

    def __init__(self, modules: Iterable[ModuleType]) -> None:
        self._trees = {m: ast.parse(Path(str(m.__file__)).read_text(encoding="utf-8")).body for m in modules}
        self._trees[pipeline] = ast.parse(inspect.getsource(pipeline)).body
        self._imported: dict[tuple[str, str], list[tuple[ModuleType, str]]] = defaultdict(list)
        for module, body in self._trees.items():
            for node in (n for n in body if isinstance(n, ast.ImportFrom)):
                for alias in node.names:
                    self._imported[node.module or "", alias.name].append((module, alias.asname or alias.name))

    def places(self, module: str, name: str) -> list[tuple[ModuleType, str]]:
        """The name where it is defined and under which names other modules import it."""
        found = [(sys.modules[module], name)]
        for place, alias in found:
            found += [p for p in self._imported[place.__name__, alias] if p not in found]
        return found

    def put(self, module: str, name: str, value: Any) -> None:
        """Give a name another value, in all modules that import it and in all that is derived from it."""
        changed, waiting = set(), [(module, name, value)]
        while waiting:
            module, name, value = waiting.pop(0)
            for place, alias in self.places(module, name):
                if (place, alias) in changed:
                    continue
                changed.add((place, alias))
                setattr(place, alias, value)
                for node in self._trees.get(place, ()):
                    waiting += self._derived(place, node, alias)
        for place in self._trees:
            for cached in (v for v in vars(place).values() if hasattr(v, "cache_clear")):
                cached.cache_clear()

    def _derived(self, place: ModuleType, node: ast.stmt, alias: str) -> list[tuple[str, str, Any]]:
        """Constants that a statement derives from a name, made anew; defaults of functions are set."""
        if isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value is not None and mentions(node.value, alias):
            scope: dict[str, Any] = {}
            exec(compile(ast.Module([node], []), str(place.__file__), "exec", dont_inherit=True), vars(place), scope)
            return [(place.__name__, n, scope[n]) for n in names_of(node) if n in scope and n != alias]
        for inner in ast.walk(node) if isinstance(node, (ast.FunctionDef, ast.ClassDef)) else ():
            if not isinstance(inner, ast.FunctionDef):
                continue
            positional, keyword = inner.args.defaults, inner.args.kw_defaults
            defaults = [*positional, *(d for d in keyword if d is not None)]
            if any(mentions(d, alias) for d in defaults):
                owner = vars(place)[node.name]
                function = inspect.unwrap(owner if inner is node else getattr(owner, inner.name))
                new = [eval(compile(ast.Expression(d), "default", "eval"), vars(place)) for d in defaults]
                function.__defaults__ = tuple(new[: len(inner.args.defaults)]) or None
                keys = [a.arg for a, d in zip(inner.args.kwonlyargs, inner.args.kw_defaults) if d is not None]
                function.__kwdefaults__ = dict(zip(keys, new[len(inner.args.defaults) :])) or None
        return []


def mentions(node: ast.AST, name: str) -> bool:
    """Whether code names something."""
    return any(isinstance(n, ast.Name) and n.id == name for n in ast.walk(node))


# What was measured.


def tables(rows: Sequence[dict[str, Any]]) -> str:
    """One table a stage, the rows of what matters most first, and what changes nothing."""
    usual, noise = usual_and_noise(rows)
    by_label: dict[tuple[str, str], dict[str, dict[str, Any]]] = defaultdict(lambda: defaultdict(dict))
    for row in rows:
        if row["label"] != "seed":
            by_label[row["stage"], row["label"]][row["change"]][row["case"]] = row
    out = []
    for stage in STAGES:
        lines, idle = [], []
        for (_, label), changes in ((k, c) for k, c in by_label.items() if k[0] == stage):
            one = next(iter(next(iter(changes.values())).values()))
            told = {change: effect(cases, usual, noise) for change, cases in changes.items()}
            score = min(s for s, _ in told.values())
            if all(text == "same" for _, text in told.values()):
                idle.append(label)
                continue
            off = told.pop("off", (0.0, ""))[1]
            others = "; ".join(f"{change}: {text}" for change, (_, text) in told.items())
            lines.append((score, [label, one["value"], off, others]))
        if lines or idle:
            table = markdown(["name", "value", "off", "other"], [row for _, row in sorted(lines)])
            out.append(f"## {stage}\n\n{table}\n\nThe same scenarios without: {', '.join(idle) or 'none'}.")
    return "\n\n".join(out)


def matters(rows: Sequence[dict[str, Any]]) -> set[str]:
    """Names of what changes a figure beyond noise."""
    usual, noise = usual_and_noise(rows)
    return {r["label"] for r in rows if r["label"] != "seed" and effect({r["case"]: r}, usual, noise)[0] != 0.0}


def usual_and_noise(rows: Sequence[dict[str, Any]]) -> tuple[dict[str, dict[str, Any]], dict[str, dict[str, float]]]:
    """By log the row of the method as it is, and how much each figure differs by seed, at least half a step."""
    by_case: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        if row["label"] == "seed":
            by_case[row["case"]].append(row)
    usual = {case: next(r for r in seeds if r["change"] == "0") for case, seeds in by_case.items()}
    noise = {}
    for case, seeds in by_case.items():
        values = {k: [r["figures"][k] for r in seeds if r["figures"].get(k) is not None] for k in FIGURES}
        spread = {k: float(np.std(v, ddof=1)) if len(v) > 1 else 0.0 for k, v in values.items()}
        noise[case] = {k: max(step / 2, spread[k]) for k, (step, _) in FIGURES.items()}
    return usual, noise


def effect(cases: dict[str, Any], usual: dict[str, Any], noise: dict[str, Any]) -> tuple[float, str]:
    """Steps that all logs lose or win beyond noise, and a word: same, equal, worse or better with the largest figure."""
    gains, same = [(0.0, "")], True
    for case, row in cases.items():
        if case not in usual:
            continue
        if row["outcome"].startswith("refused"):
            return 0.0, "refused"
        if row["outcome"].startswith("fails"):
            return FAILURE, "worse (fails)"
        same &= usual[case]["outcome"].startswith(row["outcome"])
        for key, (step, more) in FIGURES.items():
            now, before = row["figures"].get(key), usual[case]["figures"].get(key)
            if (now is None) != (before is None):
                now, before = now or 0.0, before or 0.0
            if now is None or abs(now - before) <= NOISE_SIGMAS * noise[case][key]:
                continue
            gains.append(((now - before) * (1 if more else -1) / step, f"{key} {now - before:+.2g}, {case}"))
    if len(gains) == 1:
        return 0.0, "same" if same else "equal"
    score = sum(gain for gain, _ in gains)
    return score, f"worse ({min(gains)[1]})" if score < 0 else f"better ({max(gains)[1]})"


def short(value: Any) -> str:
    """A number, or the least and the largest of a table."""
    numbers = list(numbers_in(value))
    texts = [f"{v:.3g}" for v in (min(numbers), max(numbers))] if numbers else [str(value)]
    return " to ".join(dict.fromkeys(texts))


if __name__ == "__main__":
    run(main, __doc__)
