"""No damaged input crashes, hangs or changes a result without a word."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import pytest
from mutation.harness import BAD, GOOD, Harness

INPUTS = range(1, 48, 2)  # one or two of each kind


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks, and reads /proc")
def test_nothing_crashes_hangs_or_is_swallowed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some inputs of each kind; `tools/mutate.py --count N` runs more."""
    monkeypatch.chdir(tmp_path)
    harness = Harness(tmp_path.resolve(), 20)
    rows = [harness.run(index) for index in INPUTS]
    counts = Counter(row.verdict for row in rows)
    bad = [f"{r.verdict}: {r.index} {r.kind}: {r.damage}: {r.reason}" for r in rows if r.verdict in BAD]
    assert not bad, "\n".join(bad)
    assert min(counts[name] for name in GOOD) > 1
