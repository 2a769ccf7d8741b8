"""How often the ego is warned in ordinary traffic, where nobody collides: warnings per minute of driving.

    python tools/bench.py warnings SCENARIO.json|SCENE.toml|LOG|KITTI_TRACKING ... [--seeds 2] [--ends both]

Logs are taken by their labels, and so are the sequences of the KITTI tracking benchmark with `ego_motion`. The second opinion is that of the replay's conflict metrics, which know where everybody goes: the
least time to collision at constant velocity of the ego and the agent, and the least post-encroachment time. A warning without
either below the limits is counted as false.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from entry import parser_of

from benchmarks.labeled_drives import kitti_tracking, labeled_log
from log2sim.datatypes import EGO, Scenario
from log2sim.simulation.runner import replay
from log2sim.simulation.warnings import warn

# A driver who has to react within 1.5 s, or passes within 1 s of another, is in a conflict (Hyden 1987; Allen et al. 1978).
CONFLICT_TTC_S, CONFLICT_PET_S = 1.5, 1.0

# Warnings by the time to collision alone, as the simplest systems give them.
PLAIN_TTC_S = 2.5


def main(arguments: list[str] | None = None) -> None:
    """Print a line for each scenario and warning."""
    parser = parser_of(__doc__)
    parser.add_argument("paths", nargs="+", type=Path)
    parser.add_argument("--seeds", type=int, default=1, help="of random scenes")
    parser.add_argument("--ends", default="both")
    asked = parser.parse_args(arguments)
    driven_s, counts, plain = 0.0, [0, 0], 0
    for name, scenario in (found for path in asked.paths for found in scenarios(path, asked.seeds)):
        if scenario.ego is None:
            print(f"{name:40} no ego")
            continue
        result = replay(scenario, mode="exact", dt_s=0.05)
        found = warn(scenario, result, ends=asked.ends)
        warned = [w for w in found.events if w.warned is not None]
        driven_s += found.driven_s
        plain += sum(
            e["ego"] and (e["min_ttc_s"] or PLAIN_TTC_S + 1) <= PLAIN_TTC_S for e in result.metrics["conflicts"]
        )
        print(f"{name:40} {found.driven_s:6.1f} s driven, {len(warned)} warnings")
        for w in warned:
            ttc_s, pet_s = near_misses(result, w.agent)
            true = w.collision_s is not None or ttc_s <= CONFLICT_TTC_S or pet_s <= CONFLICT_PET_S
            counts[true] += 1
            print(
                f"  {w.agent:24} {w.category:10} at {w.warned.t_s:6.1f} s for "
                f"{sum(b - a for a, b in w.spans_s) + 0.1:4.1f} s, p {w.probability:.2f}, ttc {w.ttc_s:4.2f} s, "
                f"gap {w.warned.distance_m:5.1f} m, ego {w.warned.ego_speed_mps:4.1f} m/s; least ttc {ttc_s:5.2f} s, "
                f"pet {pet_s:5.2f} s, {'conflict' if true else 'false'}"
            )
    minutes = driven_s / 60
    print(f"agents within {PLAIN_TTC_S:g} s of the ego at constant velocity: {plain}, {plain / minutes:.2f} a minute")
    print(
        f"{driven_s:.0f} s driven: {sum(counts)} warnings, {sum(counts) / minutes:.2f} a minute; "
        f"{counts[0]} of them false, {counts[0] / minutes:.2f} a minute"
    )


def scenarios(path: Path, seeds: int) -> Iterator[tuple[str, Scenario]]:
    """Yield the scenarios that a path stands for."""
    if path.suffix == ".json":
        yield path.parent.name + "/" + path.name, Scenario.load(path)
    elif path.suffix == ".toml":
        from log2sim.synth.scene import load_scene
        from log2sim.synth.synthesis import synthesize

        for seed in range(seeds):
            yield f"{path.stem}, seed {seed}", synthesize(load_scene(path), seed=seed, observe=False)[1]
    elif (path / "label_02").is_dir() and (path / "ego_motion").is_dir():
        yield from kitti_tracking(path)
    else:
        yield path.name, labeled_log(path)


def near_misses(result: object, agent: str) -> tuple[float, float]:
    """Least time to collision and post-encroachment time of the ego and an agent, s; infinite without."""
    for entry in result.metrics["conflicts"]:
        if {EGO, agent} == set(entry["agents"]):
            return tuple(float("inf") if entry[k] is None else entry[k] for k in ("min_ttc_s", "pet_s"))
    return float("inf"), float("inf")
