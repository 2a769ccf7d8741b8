"""No damaged input crashes, hangs or changes a result without a word."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))
from mutation import running
from mutation.supervising import Harness, indices, run_many

INPUTS = 48


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks, and reads /proc")
def test_nothing_crashes_hangs_or_is_swallowed(tmp_path: Path) -> None:
    """Some inputs of each kind; `tools/mutate.py --count N` runs more."""
    rows = list(run_many(Harness(tmp_path.resolve()), 20, list(indices(INPUTS))))
    counts = Counter(row.verdict for row in rows)
    bad = [f"{r.verdict}: {r.replay} {r.kind}: {r.damage}: {r.reason}" for r in rows if r.verdict in running.BAD]
    assert not bad, "\n".join(bad)
    assert sum(counts.values()) == INPUTS
    assert min(counts[name] for name in running.GOOD) > 1
