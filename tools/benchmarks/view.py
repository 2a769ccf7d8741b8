"""How smoothly the page of `log2sim view` plays: frames in a headless Chromium, without a graphics processor.

    python tools/bench.py view --play 6

Agents on rings that change their speed, ten waypoints a second, all in sight with their trails. The page plays in real time;
told are the time from frame to frame, the time that the page's script takes for one, the page's size and how long it loads.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.table import markdown
from log2sim.datatypes import TYPICAL_SIZE_M, Agent, Scenario, Waypoints
from log2sim.simulation.runner import replay
from log2sim.visualization.page.writer import write_page

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
from browser import CHROMIUM, DRIVER, Browser, browsing

COUNTS, SECONDS, STEP_S = (50, 200, 500), 60.0, 0.1
CATEGORIES = ("car", "car", "truck", "cyclist", "pedestrian", "bus")
HEAD = ["agents", "page MB", "load ms", "frame median / 95 % / longest ms", "script median / 95 % / longest ms"]
WATCH = """const [seconds, done] = arguments, stamps = [], costs = [], ask = window.requestAnimationFrame.bind(window);
    window.requestAnimationFrame = (f) => ask((now) => {
        const begin = performance.now();
        f(now);
        costs.push(performance.now() - begin);
        stamps.push(now);
    });
    log2sim.play();
    setTimeout(() => { log2sim.pause(); done([stamps, costs]); }, seconds * 1000);"""


def main(play: float = 10.0) -> None:
    """Measure the page for `play` seconds each and print the table."""
    if CHROMIUM is None or DRIVER is None:
        sys.exit("needs Chromium and its driver (Debian: chromium, chromium-driver)")
    with tempfile.TemporaryDirectory() as folder, browsing(Path(folder) / "profile") as browser:
        rows = [row(browser, n, Path(folder) / "page.html", play) for n in COUNTS]
        rows.append(row(browser, COUNTS[-1], Path(folder) / "page.html", play, layers=True))
    print(markdown(HEAD, rows))


def row(browser: Browser, count: int, page: Path, play_s: float, *, layers: bool = False) -> list[str]:
    """Frames of the page of so many agents, with or without the layers of truth and replay."""
    scenario = rings(count, SECONDS)
    more = {"truth": scenario, "replay": replay(scenario, mode="exact", dt_s=0.1)} if layers else {}
    write_page(scenario, page, overwrite=True, **more)
    browser.open(page.as_uri(), size=(1280, 800))
    loaded_ms = browser.run("return performance.getEntriesByType('navigation')[0].domComplete")
    stamps, costs = browser.run_async(WATCH, play_s)
    spreads = [np.percentile(values, [50, 95, 100]) for values in (np.diff(stamps), costs)]
    name = f"{count} with truth and replay" if layers else str(count)
    figures = [" / ".join(f"{v:.1f}" for v in spread) for spread in spreads]
    return [name, f"{page.stat().st_size / 1e6:.1f}", f"{loaded_ms:.0f}", *figures]


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
