"""The table of Zou et al. (2021) made again with stated matches: from simulated to simulated and to real sweeps.

Their precision, recall, F1 and "mAP" have no stated match, and the "mAP" is precision times recall. Here a vehicle is found
with an overlap above one half and a person or two-wheeler above 0.3, or any of them within 1 m of its center; average
precision stands beside. Scores are chosen on simulated scenes that are not reported.

python tools/bench.py zou2021 --work DIR --zou DIR/zou2021.onnx --log PandaSet=PATH --log KITTI=PATH \\
    --checkpoint vehicle=FILE.pt --checkpoint zou2021=FILE.pt --data SHARDS --write BENCHMARKS.md

Rows that are in the work folder are not made again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from entry import parser_of
from lidar_training.clouds import Example, draw_example
from lidar_training.export import export_onnx
from lidar_training.fitting import FitPlan, fit
from lidar_training.network import BevNetwork
from lidar_training.real_logs import LogSweep, read_sweeps, sample_of
from numpy.typing import NDArray
from zou2021.cluster_boxes import ClusterBoxDetector
from zou2021.network import Mixture, Zou2021Network, centers_loss, export_zou2021, shards_in, zou2021_loss
from zou2021.table_rows import CENTER, MATCHES, best_score, figures, judged

from benchmarks.table import markdown, replace_section
from log2sim.logs.opening import open_log
from log2sim.perception.detect3d.detectors import WEIGHTS, LidarDetector, NetworkDetector
from log2sim.perception.detect3d.network import Network, load_network

CHOICE_SEED, TEST_SEED = 3_000_000, 4_000_000
"""Scenes that training and calibration never draw."""
MIN_SCORE = 0.05
RANGE_M = 32.0
SHARES = (0.0, 0.2, 1.0)
FINE_RATE = 3e-4
VARIANTS = {"vehicle": ("centers", "votes"), "roadside": ("centers", "votes"), "zou2021": ("votes", "points")}
NAMES = {
    ("vehicle", "centers"): "`lidar:vehicle`, centers", ("vehicle", "votes"): "`lidar:vehicle`, votes",
    ("roadside", "centers"): "`lidar:roadside`, centers", ("roadside", "votes"): "`lidar:roadside`, votes",
    ("zou2021", "votes"): "the paper's network, votes, mean sizes",
    ("zou2021", "points"): "the paper's network, votes, box around the points",
}  # fmt: skip
MOUNT = {"vehicle": "vehicle", "roadside": "roadside", "zou2021": "roadside"}


@dataclass(frozen=True, eq=False)
class Table:
    """What is needed to make the rows.

    Attributes
    ----------
    work : Path
        Folder of the finished rows.
    networks : dict of str to Path
        ONNX files.
    checkpoints : dict of str to Path
        Of networks that are fine-tuned.
    logs : dict of str to Path
    data : list of Path
        Folders of simulated shards for the fine-tuning.
    scenes, every, steps : int
        Simulated scenes; every n-th sweep of a log; steps of fine-tuning.
    """

    work: Path
    networks: dict[str, Path]
    checkpoints: dict[str, Path]
    logs: dict[str, Path]
    data: list[Path]
    scenes: int
    every: int
    steps: int

    @cached_property
    def sweeps(self) -> dict[str, list[LogSweep]]:
        """Labeled sweeps of the logs."""
        return {name: read_sweeps(open_log(path), self.every) for name, path in self.logs.items()}

    def simulated(self, mount: str, seed: int) -> list[Example]:
        """Draw simulated scenes once."""
        key = (mount, seed)
        if key not in _drawn:
            _drawn[key] = [draw_example(mount, (seed, k)) for k in range(self.scenes)]
        return _drawn[key]

    def row(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Return a row, made now or before."""
        path = self.work / f"{name}.json"
        if not path.exists():
            path.write_text(json.dumps(make()))
            print(name, flush=True)
        return json.loads(path.read_text())

    def rows(self) -> Iterator[tuple[str, str, str, dict[str, Any]]]:
        """Yield training, detector, test and figures of all rows."""
        for kind, network in self.networks.items():
            yield from self._tests(kind, network, "simulated", [f"simulated, {MOUNT[kind]}", *self.logs])
        for kind in self.checkpoints:
            for share in SHARES:
                for other in self.logs if share else ("none",):
                    network = self.fine_tuned(kind, other, share)
                    source = f"simulated, then {self.steps} steps with {share:.0%} of {other}"
                    source = source if share else f"simulated, then {self.steps} steps more"
                    yield from self._tests(kind, network, source, [n for n in self.logs if n != other])

    def _tests(
        self, kind: str, path: Path, source: str, tests: list[str]
    ) -> Iterator[tuple[str, str, str, dict[str, Any]]]:
        slug = _slug(f"{kind} {source}")
        network = LastRun(load_network(path))
        detectors = {decode: detector_of(network, decode) for decode in VARIANTS[kind]}

        def choose() -> dict[str, Any]:
            result = judged(detectors, self.simulated(MOUNT[kind], CHOICE_SEED))
            return {decode: best_score(r) for decode, r in result.items()}

        score = self.row(f"score_{slug}", choose)
        for test in tests:

            def make(test: str = test) -> dict[str, Any]:
                scenes = self.sweeps[test] if test in self.logs else self.simulated(MOUNT[kind], TEST_SEED)
                return {
                    decode: {"score": score[decode], "scenes": len(scenes)}
                    | {name: figures(result, criteria, score[decode]) for name, criteria in MATCHES.items()}
                    for decode, result in judged(detectors, scenes).items()
                }

            row = self.row(f"{slug}__{_slug(test)}", make)
            for decode in VARIANTS[kind]:
                yield source, NAMES[kind, decode], test, row[decode]

    def fine_tuned(self, kind: str, other: str, share: float) -> Path:
        """Go on training a network for some steps, with a share of a log's sweeps in half of each batch."""
        path = self.work / f"{kind}-{other}-{share:.0%}.onnx".replace("%", "")
        if path.exists():
            return path
        real = [sample_of(s) for s in self.sweeps[other]] if share else []
        real = real[:: round(1 / share)] if share else []
        info = load_network(self.networks[kind]).info
        network = BevNetwork() if kind == "vehicle" else Zou2021Network(info.card["share"])
        network.load_state_dict(torch.load(self.checkpoints[kind], weights_only=True)["mean"])
        network = network.to(memory_format=torch.channels_last)
        loss = centers_loss(info.cell_m) if kind == "vehicle" else zou2021_loss
        mixture = Mixture(shards_in(self.data), real)
        mean = fit(
            network, lambda n, rng, _: loss(n, mixture.draw(rng), rng), FitPlan(self.steps, seed=5, peak_rate=FINE_RATE)
        )
        card = {"steps": self.steps, "log": other, "share": share}
        part = path.with_suffix(".part.onnx")
        if kind == "vehicle":
            torch.save({"mean": mean}, self.work / "fine.pt")
            export_onnx(self.work / "fine.pt", part, json.loads(info.model_dump_json()) | {"card": card})
        else:
            network.load_state_dict(mean)
            export_zou2021(network, part, card | {"share": info.card["share"]})
        return part.replace(path)


_drawn: dict[tuple[str, int], list[Example]] = {}  # scenes by mount and seed


def _slug(text: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in text)


class LastRun:
    """A network that remembers its last answer, for several decodings of one grid."""

    def __init__(self, network: Network) -> None:
        self.info, self._network = network.info, network
        self._grid, self._maps = np.zeros(0, np.float32), np.zeros(0, np.float32)

    def run(self, grid: NDArray[np.float32]) -> NDArray[np.float32]:
        """Compute the maps of a grid."""
        if not np.array_equal(grid, self._grid):
            self._grid, self._maps = grid, self._network.run(grid)
        return self._maps


def detector_of(network: Any, decode: str) -> LidarDetector:
    """Decode a network by centers, by votes, or by votes with a box around the points of each cluster."""
    if decode == "points":
        return ClusterBoxDetector(decode, network, RANGE_M, MIN_SCORE)
    return NetworkDetector(decode, network, decode, RANGE_M, MIN_SCORE)


def render(rows: Iterator[tuple[str, str, str, dict[str, Any]]]) -> str:
    """Make the table."""
    head = ["trained on", "detector", "tested on", "truths", "P / R / F1", "P x R", "AP40 vehicle / two-wheeler / person",
            "mean AP40", f"P / R / F1, {CENTER['vehicle']}", "P x R", "mean AP40", "score"]  # fmt: skip
    lines = []
    for source, name, test, figure in rows:
        cells = [source, name, f"{test} ({figure['scenes']})"]
        for match_name in MATCHES:
            f = figure[match_name]
            three = " / ".join(number(f[k]) for k in ("precision", "recall", "f1"))
            by_group = [" / ".join(number(v) for v in f["average_precision"].values())]
            cells += [str(f["truths"])] if match_name == "overlap" else []
            cells += [three, number(f["precision_times_recall"])]
            cells += by_group if match_name == "overlap" else []
            cells += [number(f["mean_average_precision"])]
        lines.append([*cells, f"{figure['score']:.2f}"])
    return markdown(head, lines)


def number(value: float | None) -> str:
    """Write a share without its zero; a dash where there is none."""
    return "-" if value is None else f"{value:.3f}".replace("0.", ".", 1) if value < 1 else f"{value:.2f}"


def pairs(values: list[str]) -> dict[str, Path]:
    """Read NAME=PATH."""
    return {name: Path(path) for name, path in (v.split("=", 1) for v in values)}


def main(arguments: list[str] | None = None) -> None:
    """Make the rows that are missing and write the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--work", type=Path, required=True, help="folder of finished rows and fine-tuned networks")
    parser.add_argument("--zou", type=Path, help="ONNX file of tools/train_lidar.py zou2021")
    parser.add_argument("--log", action="append", default=[], metavar="NAME=PATH", help="log with 3D labels")
    parser.add_argument("--checkpoint", action="append", default=[], metavar="vehicle|zou2021=FILE.pt")
    parser.add_argument("--data", type=Path, nargs="*", default=[], help="folders of simulated shards")
    parser.add_argument("--scenes", type=int, default=100)
    parser.add_argument("--every", type=int, default=3)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--write", type=Path, help="Markdown file whose section zou2021 is replaced")
    options = parser.parse_args(arguments)
    options.work.mkdir(parents=True, exist_ok=True)
    networks = {name: WEIGHTS / f"{name}.onnx" for name in ("vehicle", "roadside")}
    networks = {name: path for name, path in networks.items() if path.exists()}
    networks |= {"zou2021": options.zou} if options.zou else {}
    table = Table(
        options.work, networks, pairs(options.checkpoint), pairs(options.log), options.data, options.scenes,
        options.every, options.steps,
    )  # fmt: skip
    text = render(table.rows())
    print(text)
    if options.write:
        replace_section(options.write, "zou2021", text)
