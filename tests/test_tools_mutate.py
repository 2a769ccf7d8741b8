"""The mutation harness tells each class of outcome apart, repeats what it did, and finds nothing in the package."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))
from mutation import running
from mutation.damage import Damage, Mutation
from mutation.running import Outcome
from mutation.supervising import Harness, indices, run_many

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks, and reads /proc")
INPUTS, KILLS = 64, 10
GOOD = Outcome("reconstruct", 0, "", frozenset(), "other")


def cut_in_half(rng: np.random.Generator, file: Path, place: object) -> Damage:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    return Damage("cut in half", True)


@pytest.fixture(scope="module")
def harness(tmp_path_factory: pytest.TempPathFactory) -> Harness:
    return Harness(tmp_path_factory.mktemp("mutate").resolve(), ["scenario"], (Mutation(cut_in_half),))


@pytest.mark.slow
def test_nothing_crashes_hangs_or_is_swallowed(tmp_path: Path) -> None:
    """Some inputs of each kind; `tools/mutate.py --count N` runs more."""
    harness = Harness(tmp_path.resolve())
    rows = list(run_many(harness, 20, list(indices(INPUTS))))
    counts = Counter(row.verdict for row in rows)
    bad = [
        f"{row.verdict}: {row.replay} {row.kind}: {row.damage}: {row.reason}"
        for row in rows
        if row.verdict in running.BAD
    ]
    assert not bad, "\n".join(bad)
    assert sum(counts.values()) == INPUTS
    assert min(counts[name] for name in running.GOOD) > 1
