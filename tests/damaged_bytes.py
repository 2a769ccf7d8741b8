"""Strategies for files that somebody damaged, and what a parser may do with them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

quick = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


@st.composite
def damaged(draw: st.DrawFn, sound: bytes) -> bytes:
    """A sound file with some bytes replaced, removed or inserted, or something else altogether."""
    data = bytearray(sound)
    for _ in range(draw(st.integers(0, 4))):
        begin = draw(st.integers(0, len(data)))
        end = min(len(data), begin + draw(st.integers(0, 8)))
        data[begin:end] = draw(st.binary(max_size=8))
    return draw(st.sampled_from([bytes(data), bytes(data), bytes(data[: len(data) // 2])]) | st.binary(max_size=200))


def result_or_refusal(parse: Callable[[], Any], error: type[Exception], where: str) -> Any:
    """What a parser returns; None for an error of one line that says where, while any other error passes on."""
    try:
        return parse()
    except error as problem:
        if where not in str(problem) or "\n" in str(problem):
            raise AssertionError(f"'{problem}' does not say {where} in one line") from problem
        return None
