"""Whether the covariance of a homography holds: NEES of ground positions near (6-20 m) and far (30-60 m), honest is 1.

The streams are those of `bench.py homography`. Of a camera that pitches and rolls by 0.1 degree it is that of each tick, with its angles.
"""

from __future__ import annotations

import numpy as np

from benchmarks.homography import TICKS, Array, Case, K, camera, make_stream, mapped, probes
from benchmarks.table import markdown
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography.estimate import EstimationOptions, estimate_homography
from log2sim.perception.homography.fit import ground_covariances

RANGES_M = (6.0, 10.0, 20.0, 30.0, 45.0, 60.0)


def main(seeds: int = 40, moving_seeds: int = 15) -> None:
    """Print the table; `seeds` streams of a fixed camera, `moving_seeds` of one that moves."""
    rows = []
    for cars in (10, 3):
        for outliers, nod_deg in ((0.0, 0.0), (0.3, 0.0), (0.6, 0.0), (0.3, 0.1)):
            row = [f"{2 * cars}", f"{outliers:.0%}", "moves" if nod_deg else "fixed"]
            for method in ("time-aware", "calibrated"):
                for noise_px in (0.5, 2.0):
                    case = Case(noise_px, outliers, cars, nod_deg)
                    found = [nees(case, seed, method) for seed in range(moving_seeds if nod_deg else seeds)]
                    row.append(" / ".join(f"{v:.2f}" for v in np.nanmean(found, axis=0)))
            rows.append(row)
    methods = [f"{m}, {n} px" for m in ("time-aware", "calibrated") for n in ("0.5", "2")]
    print(markdown(["correspondences a frame", "outliers", "camera", *methods], rows))


def nees(case: Case, seed: int, method: str) -> Array:
    """NEES near and far (2,) of one stream; NaN where the fit is refused."""
    stream = make_stream(case, seed)
    options = EstimationOptions(method, K=K, pitch_roll=case.nod_deg > 0)
    data = Correspondences(stream.uv, stream.xy, stream.tick, stream.by_size)
    fit = estimate_homography(data, options, rng=np.random.default_rng(0))
    ground, out = probes(RANGES_M), []
    uv, near = mapped(camera(), ground), ground[:, 0] < 25
    for tick in range(TICKS if case.nod_deg else 1):
        h, covariance = fit.at_tick(tick), fit.covariance_at(tick)
        if h is None or covariance is None:
            continue
        away = mapped(h, uv) - mapped(np.linalg.inv(stream.image_H_ground[tick]), uv)
        each = np.linalg.solve(ground_covariances(h, covariance, uv), away[:, :, None])[:, :, 0]
        squared = (away * each).sum(axis=1) / 2
        out.append([squared[near].mean(), squared[~near].mean()])
    return np.asarray(np.mean(out, axis=0) if out else np.full(2, np.nan))
