"""Makes the pictures of the cookbook with log2sim's own commands, from synthetic logs alone.

    python tools/cookbook_pictures.py WORK [--only NAME]

WORK is a folder for logs and scenarios; what is there is not made again (all of it takes some ten minutes of two cores). Pictures become JPEGs of at most
42 kB in samples/pictures/. The pages in a browser need a Chromium with its driver.
"""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
from entry import run

ROOT = Path(__file__).resolve().parents[1]
TARGET = ROOT / "samples/pictures"
WIDTH_PX, MAX_BYTES = 800, 42_000
SCENES = ("motorway", "roadside")
SIZE = "--size 900x600"
FRAME = 22  # of a film
# By name: commands of log2sim, in which {work}, {sample} and {out} are the folder, the sample's scenario and the picture.
COMMANDS: dict[str, tuple[str, ...]] = {
    "accuracy": ("evaluate {sample} --truth samples/crossing --plot {out}",),
    "detectors": (
        "detect samples/crossing --detector lidar:vehicle --out {work}/boxes.json",
        "evaluate {work}/boxes.json --truth samples/crossing --protocol kitti --plot {out}",
    ),
    "doubts": ("plot {work}/motorway.json --start 2 --stop 4 --extent 60,-15,135,20 --size 900x480 --out {out}",),
    "evaluation": (f"plot {{sample}} --truth samples/crossing {SIZE} --out {{out}}",),
    "exports": ("plot {work}/motorway.json --extent 60,-15,130,20 --size 900x480 --out {out}",),
    "faults": ("inspect {work}/yawed --overlay {out}",),
    "logs": ("inspect samples/crossing --overlay {out}",),
    "python": (f"plot {{sample}} --predict 2 --start 1 --stop 3 {SIZE} --out {{out}}",),
    "replay": (
        "edit {sample} --lateral car-2=3 --out {work}/blocked.json",
        "replay {work}/blocked.json --ego samples/egos.py:BrakeLate --out {work}/late.json",
        "plot {work}/blocked.json --replay {work}/late.json --size 900x640 --out {out}",
    ),
    "road": (
        "plot {work}/motorway.json --background {work}/motorway --extent 60,-15,130,20 --size 900x480 --out {out}",
    ),
    "roadside": (f"plot {{work}}/roadside.json {SIZE} --out {{out}}",),
    # A frame of the film.
    "sensors": (
        "edit {sample} --remove bus-1 --out {work}/without_bus.json",
        "resimulate {sample} --log samples/crossing --replay {work}/without_bus.json --sensors lidar_top,front --out {work}/simulated "
        "--film {work}/sensors.webm",
    ),
    "situations": (
        "plot {work}/motorway.json --agents ego,car-1,car-2 --start 1.7 --stop 5.1 --extent 50,-16,195,8 --size 900x420 --out {out}",
    ),
    "synthetic": ("inspect {work}/roadside --overlay {out}",),
}


def log2sim(line: str) -> None:
    """Run a command in the checkout."""
    command = [sys.executable, "-m", "log2sim", *line.split(), "--quiet", "--overwrite"]
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)


def prepare(work: Path) -> Path:
    """Render and reconstruct what the pictures show; return the sample's scenario."""
    for name in SCENES:
        if not (work / name).is_dir():
            log2sim(f"synth samples/scenes/{name}.toml --out {work / name}")
    for name, log in (("sample", ROOT / "samples/crossing"), *((name, work / name) for name in SCENES)):
        if not (work / f"{name}.json").exists():
            log2sim(f"reconstruct {log} --out {work / f'{name}.json'}")
    if not (work / "yawed").is_dir():
        from extremes.logs import sample, yawed_lidar

        from log2sim.logs.native.writer import write_log

        write_log(yawed_lidar(sample()[0], 3.0), work / "yawed")
    return work / "sample.json"


def screenshots(work: Path, sample: Path, names: set[str]) -> None:
    """Photograph the page of `view`, the studio and the table of `batch`."""
    from browser import Browser, browsing

    from log2sim import Scenario, open_log
    from log2sim.visualization.recording import Recorded
    from log2sim.visualization.studio import Studio

    def photograph(browser: Browser, name: str, address: str, *steps: str) -> None:
        browser.open(address, size=(1100, 720))
        time.sleep(1)
        for step in steps:
            browser.run(step)
            time.sleep(1)
        (work / f"{name}.png").write_bytes(browser.picture())

    with browsing(work / "profile") as browser:
        if "pictures" in names:
            log2sim(f"view {sample} --log samples/crossing --max-mb 8 --out {work}/view.html")
            photograph(browser, "pictures", (work / "view.html").as_uri(), "log2sim.time = 2; log2sim.choose('car-1')")
        if "corrections" in names:
            (work / "none.json").unlink(missing_ok=True)
            recorded = Recorded(open_log(ROOT / "samples/crossing"), 8_000_000)
            studio = Studio(Scenario.load(sample), work / "none.json", recorded=recorded)
            threading.Thread(target=studio.serve, daemon=True).start()
            front = "[...document.querySelectorAll('#cameras button')].find((b) => b.textContent === 'front').click()"
            chosen = f"log2sim.time = 1; {front}; log2sim.choose('cyclist-1')"
            move = "document.getElementById('studio-move').click()"
            photograph(browser, "corrections", studio.address, chosen, move)
            studio.close()
        if "batch" in names:
            if not (work / "batch").is_dir():
                log2sim(
                    f"synth --traffic vehicle --no-pictures --scenes 4 --duration 3 --layout log2sim --seed 1 --out {work}/clouds"
                )
                log2sim(f"batch {work}/clouds --out {work}/batch")
            name = "document.querySelector('h1').textContent = 'Batch of clouds'"  # no path of a machine
            photograph(browser, "batch", (work / "batch/table.html").as_uri(), name)


def main(work: Path, only: list[str] = []) -> None:
    """Make the pictures of these names, or all."""
    work, chosen = work.resolve(), set(only or (*COMMANDS, "pictures", "corrections", "batch"))
    work.mkdir(parents=True, exist_ok=True)
    sample = prepare(work)
    for name in chosen & COMMANDS.keys():
        for command in COMMANDS[name]:
            log2sim(command.format(work=work, sample=sample, out=work / f"{name}.png"))
    if chosen - COMMANDS.keys():
        screenshots(work, sample, chosen - COMMANDS.keys())
    TARGET.mkdir(exist_ok=True)
    for name in sorted(chosen):
        if (work / f"{name}.webm").exists():
            film = cv2.VideoCapture(str(work / f"{name}.webm"))
            film.set(cv2.CAP_PROP_POS_FRAMES, FRAME)
            cv2.imwrite(str(work / f"{name}.png"), film.read()[1])
        image = cv2.imread(str(work / f"{name}.png"))
        shrink = min(WIDTH_PX / image.shape[1], 1.0)
        image = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        for quality in range(88, 20, -4):
            data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1])[1]
            if len(data) <= MAX_BYTES:
                break
        (TARGET / f"{name}.jpg").write_bytes(data.tobytes())
        print(f"{name}.jpg: {len(data) / 1000:.0f} kB, quality {quality}")


if __name__ == "__main__":
    run(main, __doc__)
