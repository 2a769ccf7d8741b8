"""Names the colors of vehicles in photos that lie in folders named by color, and counts how often the names agree.

    python tools/bench.py vehicle_colors FOLDER
    python tools/bench.py vehicle_colors      # rendered streets with two cars of each color, in all light and weather, boxes known

Labels that are not among the names of `log2sim.datatypes.COLOR_NAMES` are merged with the next one: silver and gray are one,
pink is red. The vehicle is taken to fill the photo but for its context. Nothing is learned from the photos.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from skimage.color import deltaE_ciede2000

from benchmarks.table import markdown
from log2sim.datatypes import COLOR_NAMES, Log, Scenario
from log2sim.datatypes.color_names import to_lab
from log2sim.files.inputs import read_bytes
from log2sim.road.colors import CONTEXT, ColorSampler, crop, shipped_network
from log2sim.synth.scene import scene_from_table
from log2sim.synth.synthesis import synthesize

SUFFIXES = (".jpg", ".jpeg", ".png")
MERGED = {"silver": "gray", "grey": "gray", "pink": "red", "magenta": "red", "purple": "blue", "cyan": "blue", "beige": "brown",
          "tan": "brown", "gold": "yellow"}  # fmt: skip
MAX_BYTES = 20 * 1024**2
HEADER = ["light and weather", "name right", "mean confidence", "CIEDE2000", "confused"]
SKIES = (
    ("noon", "clear"), ("overcast", "clear"), ("dusk", "clear"), ("night", "clear"), ("noon", "rain"), ("overcast", "rain"), ("noon", "fog"),
)  # fmt: skip
STREET = {
    "black": ((28, 29, 31), (14, 14, 16)), "white": ((232, 233, 232), (240, 238, 230)), "gray": ((90, 94, 98), (110, 108, 108)),
    "silver": ((180, 183, 186), (165, 168, 170)), "red": ((160, 28, 30), (120, 18, 30)), "blue": ((40, 66, 140), (24, 40, 84)),
    "green": ((30, 90, 50), (70, 120, 70)), "yellow": ((226, 190, 30), (235, 205, 60)), "brown": ((92, 62, 40), (70, 48, 36)),
    "orange": ((225, 105, 25), (215, 120, 40)),
}  # fmt: skip


def main(folder: Annotated[Path | None, typer.Argument()] = None) -> int:
    """Print which names are right of photos in a folder, or in rendered streets."""
    if folder is None:
        print(markdown(HEADER, [street_row(*sky) for sky in SKIES]))
        return 0
    confusion: Counter[tuple[str, str]] = Counter()
    second, begin = 0, time.perf_counter()
    for label, path in photos(folder):
        image = cv2.imdecode(np.frombuffer(read_bytes(path, MAX_BYTES), np.uint8), cv2.IMREAD_COLOR)
        order = ["none", "none"] if image is None else ranked(image)
        confusion[label, order[0]] += 1
        second += label in order[:2]
    if not (count := confusion.total()):
        print(f"{folder}: no photos in folders named by color", file=sys.stderr)
        return 1
    names = sorted({name for pair in confusion for name in pair}, key=(*COLOR_NAMES, "none").index)
    rows = [[label, *(str(confusion[label, n] or ".") for n in names)] for label in names]
    print(markdown(["label", *(f"as {n}" for n in names)], rows))
    first = sum(n for (label, name), n in confusion.items() if label == name)
    ms = 1000 * (time.perf_counter() - begin) / count
    print(f"{count} photos, top 1 {first / count:.3f}, top 2 {second / count:.3f}, {ms:.0f} ms each")
    return 0


def street_row(light: str, weather: str) -> list[str]:
    """Name the cars of two streets in some light and weather, and count which names are right."""
    found, away, confused = [], [], Counter[str]()
    for k in range(2):
        log, truth = street(light, weather, k)
        sampler = ColorSampler(log, truth)
        for camera, indices in sampler.frames().items():
            for index in indices.tolist():
                sampler.add(camera, index, log.streams[camera].read(index))
        for name, color in sampler.colors().items():
            found.append((color["name"] == name, color["confidence"]))
            away.append(float(deltaE_ciede2000(color["lab"], to_lab(STREET[name][k])[0])))
            if color["name"] != name:
                confused[f"{name} as {color['name']}"] += 1
    right, sure = np.mean(found, axis=0)
    said = ", ".join(f"{pair} ({n})" for pair, n in confused.most_common()) or "-"
    sky = light if weather == "clear" else f"{light}, {weather}"
    return [sky, f"{right * len(found):.0f} of {len(found)}", f"{sure:.2f}", f"{np.median(away):.1f}", said]


def street(light: str, weather: str, k: int) -> tuple[Log, Scenario]:
    """Make a street with a parked car of each color, in an order of its own, which a camera drives along."""
    names = np.random.default_rng(k).permutation(list(STREET)).tolist()
    cars = [
        {"id": name, "category": "car", "color": list(STREET[name][k]), "pose": [9.0 * i, -5.2 if i % 2 else 5.2, 0.0]}
        for i, name in enumerate(names)
    ]
    strength = {"fog": {"visibility_m": 100}, "rain": {"rain_mm_h": 5}}.get(weather, {})
    environment = {"light": light, "weather": weather} | strength
    camera = {"name": "front", "position_m": [1.6, 0, 1.5], "fov_deg": 75, "size_px": [640, 400], "rate_hz": 2}
    table = {
        "name": "street", "duration_s": 8.0, "environment": environment, "agent": cars, "camera": [camera],
        "road": [{"line": [[-60, 0], [160, 0]], "width_m": 13.0}], "ego": {"waypoints": [[-14, 0, 9], [100, 0, 9]]},
    }  # fmt: skip
    return synthesize(scene_from_table(table), observe=False)


def photos(folder: Path) -> Iterator[tuple[str, Path]]:
    """Yield the merged label and the path of each photo."""
    for inner in sorted(path for path in folder.iterdir() if path.is_dir()):
        label = MERGED.get(inner.name.lower(), inner.name.lower())
        if label in COLOR_NAMES:
            yield from ((label, path) for path in sorted(inner.iterdir()) if path.suffix.lower() in SUFFIXES)


def ranked(image: NDArray[np.uint8]) -> list[str]:
    """Return the merged names by their probability for the vehicle in a photo."""
    size, total, network = np.array(image.shape[1::-1], float), Counter[str](), shipped_network()
    box = np.concatenate([size * (1 - 1 / CONTEXT) / 2, size * (1 + 1 / CONTEXT) / 2])
    for name, share in zip(COLOR_NAMES, network.decide(network.raw([crop(image, box)]))[1]):
        total[MERGED.get(name, name)] += float(share)
    return [name for name, _ in total.most_common()]
