"""Precision and recall of tags in worlds whose maneuvers are known in closed form.

    python tools/bench.py tags [--worlds 48] [--noise 0.2] [--write FOLDER] [--pair RECONSTRUCTION.json=LOG/truth.json] [--motorway SEED]

`--write` writes the random traffic as scenarios, for `log2sim find` and `vary`. `--pair` compares the tags of what was reconstructed of a
rendered scene with those of its truth: the same tag within 1.5 s whose agents are within 3 m of each other. `--motorway` renders
the random traffic of a seed around a car with a LiDAR and reconstructs it first, by `lidar:vehicle`. "where seen" are those whose
agents a sensor shows at some time between begin and end, "seen then" at the very moment; a scene file (`=SCENE.toml`) knows nothing of that.
"""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks import tag_worlds
from benchmarks.table import markdown
from benchmarks.tag_worlds import World, scripted, variants
from log2sim import Config, open_log, reconstruct
from log2sim.datatypes import AgentTable, Scenario, Tag
from log2sim.scenarios.tagging import find_tags
from log2sim.scenarios.traffic import UNSEEN_S
from log2sim.synth.scene import load_scene
from log2sim.synth.synthesis import synthesize, write_synthetic

LEAST, EDGE_S = 0.3, 0.2
WITHIN_S = 1.5  # of a tag's moment and the true one's
# What has a begin and an end of its own, and what lasts for as long as it is so.
MANEUVERS = ("lane_change", "cut_in", "cut_out", "merging", "overtaking", "turning", "u_turn", "stopping", "starting")
LASTING = ("following", "approaching", "standing", "standing_at_light", "standing_at_crosswalk", "oncoming_in_lane")


def score(worlds: Sequence[World], found: Sequence[Sequence[Tag]]) -> dict[str, tuple[int, int, int, float, list[str]]]:
    """Count true, invented and missed tags of each kind, with the mean error of their moments, s, and what was wrong."""
    counts: dict[str, list] = defaultdict(lambda: [0, 0, 0, [], []])
    for world, tags in zip(worlds, found):
        left = list(world.events)
        for tag in (g for g in tags if g.tag in world.tags and g.probability >= 0.5):
            alike = [e for e in left if (e.tag, e.agent) == (tag.tag, tag.agent) and e.other in (tag.other, None)]
            fits = [e for e in alike if abs(e.t_s - tag.t_s) <= WITHIN_S]
            row = counts[tag.tag]
            if fits:
                best = min(fits, key=lambda e: (not e.sure, abs(e.t_s - tag.t_s)))
                left.remove(best)
                if best.sure:
                    row[0] += 1
                    row[3].append(abs(best.t_s - tag.t_s))
            else:
                row[1] += 1
                row[4].append(f"invented {world.scenario.name}: {describe(tag)}")
        for event in left:
            if event.sure:
                counts[event.tag][2] += 1
                counts[event.tag][4].append(f"missed {world.scenario.name}: {event}")
    return {k: (v[0], v[1], v[2], float(np.mean(v[3])) if v[3] else 0.0, v[4]) for k, v in counts.items()}


def f1(true: int, invented: int, missed: int) -> float:
    """Harmonic mean of precision and recall."""
    return 2 * true / max(2 * true + invented + missed, 1)


def describe(tag: Tag) -> str:
    """Say a tag in a line."""
    span = f"{tag.start_s}-{tag.t_s}-{tag.end_s}"
    return f"{tag.tag} {tag.agent} {tag.other} {span} p {tag.probability} {dict(tag.quantities)}"


def compare(made: Scenario, truth: Scenario) -> dict[str, list[list[tuple[int, str]]]]:
    """List the tags that a reconstruction shares with its truth, has alone, and lacks with why, by kind.

    With each comes whether sensors show the agents of the true one at its moment (2), at another time of it (1), or not (0).
    Maneuvers that begin or end within `EDGE_S` of either end of the reconstruction, or beyond, count neither way, found or not; of what
    lasts only its moment has to be within.
    """
    truth = truth.aligned_to(made)
    agents = [{a.id: a for a in s.agents} for s in (made, truth)]
    last_s = min(made.duration_s, max(float(a.waypoints.t_s[-1]) for a in made.agents))
    ours, theirs = ([g for g in find_tags(s) if g.tag != "in_lane"] for s in (made, truth))

    def apart_m(one: str | None, two: str | None, times: Sequence[float]) -> float:
        """Median distance of an agent from a true one over times at which both are there, or nearly."""
        if one is None or two is None:
            return 0.0 if one is two else np.inf
        own = [of[id] for of, id in zip(agents, (one, two))]
        a, b = (AgentTable.of([agent], np.unique(times), margin_s=UNSEEN_S).center_m[0] for agent in own)
        away = np.hypot(*(a - b)[:, :2].T)
        return float(np.median(away[np.isfinite(away)])) if np.isfinite(away).any() else np.inf

    def same(g: Tag, e: Tag) -> bool:
        times = (g.start_s, g.t_s, g.end_s, e.t_s)
        shared = (g.start_s <= e.end_s and g.end_s >= e.start_s) or abs(g.t_s - e.t_s) <= WITHIN_S
        pairs = ((g.agent, e.agent), (g.other, e.other))
        return g.tag == e.tag and shared and all(apart_m(*pair, times) < 3.0 for pair in pairs)

    def shown(e: Tag) -> int:
        ways = [agents[1][id].waypoints for id in (e.agent, e.other) if id]
        known = [w for w in ways if w.visible is not None]
        during = [w.visible[(w.t_s >= e.start_s - EDGE_S) & (w.t_s <= e.end_s + EDGE_S)].any() for w in known]
        then = [w.visible[np.abs(w.t_s - e.t_s).argmin()] for w in known]
        return int(all(during)) + int(all(during) and all(then))

    def reason(e: Tag) -> str:
        if shown(e) < 2:
            return ("not seen", "not seen then")[shown(e)]
        doubted = [g for g in ours if same(g, e)]
        if doubted:
            sure = [agents[0][id].confidence for id in (doubted[0].agent, doubted[0].other) if id]
            return f"found with {doubted[0].probability}, confidences {sure}"
        times = (e.start_s, e.t_s, e.end_s)
        away = {id: [apart_m(k, id, times) for k in agents[0]] for id in (e.agent, e.other) if id}
        gone = [id for id, of_id in away.items() if min(of_id, default=np.inf) >= 3.0]
        return f"not reconstructed: {', '.join(gone)}" if gone else "other motion"

    def is_cut(g: Tag) -> bool:
        first, last = g.start_s if g.tag in MANEUVERS else g.t_s, g.t_s if g.tag in LASTING else g.end_s
        return min(first, last_s - last, last_s - g.t_s) < EDGE_S

    out: dict[str, list[list[tuple[int, str]]]] = defaultdict(lambda: [[], [], []])
    left = list(theirs)
    for g in (g for g in ours if g.probability >= LEAST):
        found = next((e for e in left if same(g, e)), None)
        if found:
            left.remove(found)
        if not is_cut(found or g):
            out[g.tag][0 if found else 1].append((shown(found) if found else 2, describe(g)))
    for e in left:
        if e.probability >= LEAST and not is_cut(e):
            out[e.tag][2].append((shown(e), f"{describe(e)}: {reason(e)}"))
    return out


def main(worlds: int = 48, noise: float = 0.0, write: Path | None = None, pair: list[str] = [], motorway: list[int] = [],
         wrong: bool = False) -> None:  # fmt: skip
    """Print a table of random worlds and of a quarter as many of each scripted scene, whose places have noise, m; `wrong` lists what was wrong."""
    drawn = [*variants(worlds, noise), *scripted(worlds // 4, noise)]
    for k, world in enumerate(drawn if write is not None else ()):
        world.scenario.save(write / f"{k:04}" / "scenario.json")
    sums: dict[str, list[list[tuple[int, str]]]] = defaultdict(lambda: [[], [], []])
    pairs = []
    for made, of in (map(Path, text.split("=", 1)) for text in pair):
        truth = Scenario.load(of) if of.suffix == ".json" else synthesize(load_scene(of), observe=False)[1]
        pairs.append((made.name, Scenario.load(made), truth))
    with tempfile.TemporaryDirectory() as temporary:
        for seed in motorway:
            log = (write or Path(temporary)) / f"motorway_{seed}"
            if not log.exists():
                write_synthetic(tag_worlds.motorway(seed), log, seed=seed)
            found = reconstruct(open_log(log), Config.load(detect={"name": "lidar:vehicle"})).scenario
            pairs.append((f"motorway {seed}", found, Scenario.load(log / "truth.json")))
    for name, made, truth in pairs:
        for tag, lists in compare(made, truth).items():
            sums[tag] = [[*a, *((seen, f"{name}: {line}") for seen, line in b)] for a, b in zip(sums[tag], lists)]
    rows, lines = [], []
    for tag, parts in sorted(sums.items()):
        for least, where in enumerate(("reconstructed", "where seen", "where seen then")):
            counts = [sum(seen >= least for seen, _ in part) for part in parts]
            rows.append([f"{tag}, {where}", *map(str, counts), *shares(*counts), ""])
        lines += [f"{word} {t}" for word, part in zip(("alone", "missed"), parts[1:]) for _, t in part]
    begin = time.process_time()
    found = [find_tags(w.scenario) for w in drawn]
    spent = time.process_time() - begin
    for tag, (true, invented, missed, error_s, words) in sorted(score(drawn, found).items()):
        rows.append([tag, str(true), str(invented), str(missed), *shares(true, invented, missed), f"{error_s:.2f}"])
        lines += words
    print(markdown(["tag", "true", "invented", "missed", "precision", "recall", "F1", "error s"], rows))
    print("\n".join(lines) if wrong else "")
    print(f"{len(drawn)} scenarios in {spent:.1f} s of processor time, {len(drawn) / max(spent, 1e-9):.1f} a second")


def shares(true: int, invented: int, missed: int) -> list[str]:
    """Precision, recall and their harmonic mean."""
    parts = true / max(true + invented, 1), true / max(true + missed, 1), f1(true, invented, missed)
    return [f"{part:.3f}" for part in parts]
