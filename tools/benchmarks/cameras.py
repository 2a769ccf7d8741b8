"""What cameras alone are worth: logs and scenes without their LiDARs, reconstructed with the image detector and compared with the truth.

python tools/bench.py cameras LOG|SCENE.toml ...
"""

from __future__ import annotations

from benchmarks.table import markdown
from log2sim import Config, open_log, reconstruct
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.evaluation.metrics.truth import truth_from_log
from log2sim.synth.scene import load_scene
from log2sim.synth.synthesis import synthesize

FIGURES = ("recall", "precision", "hota", "position_median_m", "position_rmse_m", "yaw_median_deg")
SHARES = ("invented", "wrong_speed", "backwards", "wrong")


def main(logs: list[str]) -> None:
    rows = []
    for path in logs:
        log, truth = synthesize(load_scene(path)) if path.endswith(".toml") else (open_log(path), None)
        truth = truth or truth_from_log(log)
        streams = {name: stream for name, stream in log.streams.items() if name not in log.lidars}
        found = evaluate(reconstruct(log.changed(lidars={}, streams=streams), Config()).scenario, truth)
        right = found["correctness"]
        values = [found[key] for key in FIGURES] + [right[key]["share"] for key in SHARES]
        values += [right["doubted"][key] for key in ("wrong_ticks", "right_ticks")]
        rows.append([log.name, *("-" if v is None else f"{v:.2f}" for v in values)])
    print(markdown(["log", *FIGURES, *SHARES, "wrong doubted", "right doubted"], rows))
