"""The clouds of a log, sweep by sweep, made as the first pass of a reconstruction makes them."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Boxes3D
from log2sim.perception.background import BACKGROUND_THREADS
from log2sim.perception.detect3d.detectors import LidarDetector
from log2sim.perception.frames import RecordReader
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.prefetch import CloudOptions, CloudPrefetcher
from log2sim.perception.sync import sweep_middle_ns
from log2sim.pipeline import Run


@dataclass(frozen=True, eq=False)
class SearchedCloud:
    """A cloud and what a detector found in it.

    Attributes
    ----------
    tick : int
    cloud : Cloud or None
        None where the sweep cannot be read or has no pose.
    boxes : Boxes3D
        Empty without a detector.
    """

    tick: int
    cloud: Cloud | None
    boxes: Boxes3D


def clouds(run: Run, records: RecordReader, detector: LidarDetector | None) -> Iterator[SearchedCloud]:
    """Yield the clouds of all ticks of a run without cameras; the next ones are made and searched in the background."""
    options = CloudOptions(run.config.measure.max_range_m, detector, run.config.lidar.sweeps)
    with ThreadPoolExecutor(BACKGROUND_THREADS) as pool:
        coming = CloudPrefetcher(run.log, run.schedule, run.plan, records, pool, options)
        for tick in range(len(run.schedule)):
            coming.prefetch(tick)
            cloud = coming.cloud(tick, 0)
            yield SearchedCloud(tick, cloud, Boxes3D.empty() if detector is None else coming.boxes(tick))


def stamps_of(run: Run) -> NDArray[np.int64]:
    """Return the stamps (T,) of the sweeps that make the ticks of a run without cameras."""
    return run.schedule.t_ns - middle_ns(run)


def middle_ns(run: Run) -> int:
    """Return the time from the stamp of a sweep to its middle, ns."""
    return sweep_middle_ns(run.log.streams[run.schedule.reference])


def only_ticks(run: Run, ticks: NDArray[np.int64]) -> Run:
    """Return a run with the ticks at an index (K,)."""
    s = run.schedule
    return replace(
        run,
        schedule=replace(
            s,
            t_ns=s.t_ns[ticks],
            frames={name: index[ticks] for name, index in s.frames.items()},
            sweeps={name: index[:, ticks] for name, index in s.sweeps.items()},
            residuals_s={name: residual[ticks] for name, residual in s.residuals_s.items()},
        ),
    )
