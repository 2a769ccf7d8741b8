"""Vehicles that set off or come to rest within a track that mostly stands, seen from an ego that passes, at 2 to 20 Hz."""

from __future__ import annotations

import numpy as np
import pytest
from worlds import measured_row, scan, standing

from log2sim.agents.hypotheses import explain_track
from log2sim.datatypes import Measurements, Track

SIZES = {"bus": (12.0, 2.55, 3.1), "car": (4.4, 1.85, 1.5)}
RATES_HZ = [2.0, 5.0, 10.0, 20.0]
SPAN_S = 6.0
WAYS = {
    "stands": lambda t: 0.0 * t,
    "starts": lambda t: 0.2 * np.maximum(t - 2.5, 0.0) ** 2,
    "stops": lambda t: -0.2 * np.maximum(3.5 - t, 0.0) ** 2,
}


def seen_in_passing(category: str, way: str, rate_hz: float, seed: int = 0, ego_mps: float = 3.0) -> Track:
    """A vehicle ahead on the left of an ego that comes closer; of one tick, the points of its nearer half only."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, SPAN_S, 1 / rate_hz) + rng.uniform(0, 0.02)
    rows = []
    broken = int(rng.integers(2, len(t) - 2))
    for k, (at, x) in enumerate(zip(t, WAYS[way](t))):
        sensor = np.array([ego_mps * at, 0.0, 1.9])
        solid = standing(14.0 + x - sensor[0], 4.5, 2.0, SIZES[category])
        xyz, owner = scan([solid], azimuth_deg=(-180, 180), steps=(720, 10), noise_m=0.03, seed=seed + k)
        cluster = xyz[(owner == 0) & (xyz[:, 2] > 0.2)] + [*sensor[:2], 0.0]
        if k == broken:
            cluster = cluster[cluster[:, 0] < np.median(cluster[:, 0])]
        rows.append(measured_row(cluster, sensor, category, ends_visible=(True, True), t_ns=round(1e9 * at)))
    return Track(category, np.arange(len(rows)), Measurements.join(rows))


@pytest.mark.matrix
@pytest.mark.parametrize("rate_hz", RATES_HZ)
@pytest.mark.parametrize("category", SIZES)
@pytest.mark.parametrize("way", WAYS)
def test_what_starts_or_stops_moves_and_what_stands_does_not(category, way, rate_hz):
    track = seen_in_passing(category, way, rate_hz, seed=int(rate_hz))
    assert [part.static for part in explain_track(track)] == [way == "stands"]


def test_what_is_seen_of_one_end_only_may_grow():
    track = seen_in_passing("bus", "starts", 5.0)
    m = track.measurements
    far = tuple(c[c[:, 0] > 18.0] for c in m.cluster)
    grown = tuple(np.concatenate([near[near[:, 0] <= 18.0], end]) for near, end in zip(m.cluster[:1] * len(far), far))
    object.__setattr__(m, "cluster", grown)
    assert explain_track(track)[0].static
