"""Log-odds and probabilities are inverse to each other, and large log-odds do not overflow."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from log2sim.datatypes.log_odds import log_odds_of, probability_of


@given(st.floats(1e-6, 1 - 1e-6))
def test_one_undoes_the_other_and_a_complement_has_the_opposite_sign(p: float) -> None:
    assert probability_of(log_odds_of(p)) == pytest.approx(p, rel=1e-9)
    assert log_odds_of(1 - p) == pytest.approx(-log_odds_of(p), abs=1e-9)
