"""How smoothly the page of `log2sim view` plays: frames in a headless Chromium, without a graphics processor.

python tools/bench.py view [--agents N ...] [--seconds S] [--play S] [--out FILE.json]

Agents on rings that change their speed, ten waypoints a second, all in sight with their trails. The page plays in real time;
told are the time from frame to frame, the time that the page's script takes for one, the page's size and how long it loads.
"""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from entry import parser_of

from benchmarks.table import markdown
from log2sim.datatypes import TYPICAL_SIZE_M, Agent, Scenario, Waypoints
from log2sim.simulation.runner import replay
from log2sim.visualization.page.writer import write_page

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
from browser import CHROMIUM, DRIVER, Browser, browsing

COUNTS = (50, 200, 500)
STEP_S = 0.1
CATEGORIES = ("car", "car", "truck", "cyclist", "pedestrian", "bus")
WINDOW_PX = (1280, 800)

WATCH = """const [seconds, done] = arguments, stamps = [], costs = [], ask = window.requestAnimationFrame.bind(window);
    window.requestAnimationFrame = (f) => ask((now) => {
        const begin = performance.now();
        f(now);
        costs.push(performance.now() - begin);
        stamps.push(now);
    });
    log2sim.play();
    setTimeout(() => { log2sim.pause(); done([stamps, costs]); }, seconds * 1000);"""


@dataclass(frozen=True)
class Case:
    """So many agents, with or without the layers of truth and replay."""

    agents: int
    layers: bool

    @property
    def name(self) -> str:
        return f"{self.agents}{' with truth and replay' if self.layers else ''}"


def main(arguments: list[str] | None = None) -> int:
    """Measure, print the table and write the rows."""
    parser = parser_of(__doc__)
    parser.add_argument("--agents", nargs="*", type=int, default=COUNTS, help="numbers of agents")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the scenario")
    parser.add_argument("--play", type=float, default=10.0, help="seconds that are played")
    parser.add_argument("--out", type=Path, help="also write the rows here")
    options = parser.parse_args(arguments)
    if CHROMIUM is None or DRIVER is None:
        sys.exit("needs Chromium and its driver (Debian: chromium, chromium-driver)")
    cases = [Case(n, layers=False) for n in options.agents] + [Case(options.agents[-1], layers=True)]
    with tempfile.TemporaryDirectory() as folder, browsing(Path(folder) / "profile") as browser:
        rows = [measure(browser, case, Path(folder), options.seconds, options.play) for case in cases]
    print(table(rows))
    if options.out:
        options.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return 0


def measure(browser: Browser, case: Case, folder: Path, seconds: float, play_s: float) -> dict[str, Any]:
    """Frames of one page."""
    scenario, page = rings(case.agents, seconds), folder / "page.html"
    layers = {"truth": scenario, "replay": replay(scenario, mode="exact", dt_s=0.1)} if case.layers else {}
    write_page(scenario, page, overwrite=True, **layers)
    browser.open(page.as_uri(), size=WINDOW_PX)
    loaded_ms = browser.run("return performance.getEntriesByType('navigation')[0].domComplete")
    stamps, costs = browser.run_async(WATCH, play_s)
    between = np.diff(stamps)
    return {
        "agents": case.name,
        "page_mb": page.stat().st_size / 1e6,
        "load_ms": loaded_ms,
        **{f"frame_{k}_ms": v for k, v in _spread(between).items()},
        **{f"script_{k}_ms": v for k, v in _spread(np.array(costs)).items()},
    }


def rings(count: int, seconds: float) -> Scenario:
    """Agents on rings of 15 to 220 m, the first one the ego; each unobserved for a fifth of the time."""
    rng, t = np.random.default_rng(0), np.arange(0.0, seconds + STEP_S / 2, STEP_S)
    agents = []
    for k in range(count):
        radius, speed = rng.uniform(15, 220), rng.uniform(3, 16)
        angle = rng.uniform(0, 2 * np.pi) + speed / radius * t + 0.3 * np.sin(0.2 * t + k)
        x, y = rng.uniform(-60, 60, 2)[:, None] + radius * np.stack([np.cos(angle), np.sin(angle)])
        yaw = np.mod(angle + 1.5 * np.pi, 2 * np.pi) - np.pi
        category = CATEGORIES[k % len(CATEGORIES)]
        waypoints = Waypoints(
            t_s=t, x_m=x, y_m=y, z_m=np.zeros(len(t)), yaw_rad=yaw, speed_mps=radius * np.gradient(angle, t),
            observed=np.floor(t / 7 + k) % 5 != 0, sigma_xy_m=np.full(len(t), 0.1),
        )  # fmt: skip
        agents.append(Agent("ego" if k == 0 else f"{category}-{k}", category, TYPICAL_SIZE_M[category], waypoints))
    return Scenario(name=f"{count} agents", t0_ns=0, duration_s=seconds, agents=tuple(agents))


def table(rows: list[dict[str, Any]]) -> str:
    """Medians and 95 % of frames as Markdown."""
    head = ["agents", "page MB", "load ms", "frame median / 95 % / longest ms", "script median / 95 % / longest ms"]
    return markdown(
        head,
        [
            [r["agents"], f"{r['page_mb']:.1f}", f"{r['load_ms']:.0f}", *(
                " / ".join(f"{r[f'{what}_{k}_ms']:.1f}" for k in ("median", "p95", "longest")) for what in ("frame", "script")
            )]
            for r in rows
        ],
    )  # fmt: skip


def _spread(values: np.ndarray) -> dict[str, float]:
    return {"median": float(np.median(values)), "p95": float(np.percentile(values, 95)), "longest": float(values.max())}
