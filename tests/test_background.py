"""Work in the background: its order, and iterators that are left before their end."""

from __future__ import annotations

import threading

import pytest

from log2sim.perception.frames import AHEAD, work_ahead

PATIENCE_S = 20.0


def test_no_more_is_made_ahead_than_asked_for() -> None:
    begun: list[int] = []
    results = work_ahead(begun.append, range(100), ahead=3)
    next(results)
    assert len(begun) <= 5
    results.close()


def test_an_error_comes_with_the_item_that_caused_it() -> None:
    results = work_ahead(lambda n: 6 // n, [3, 2, 0, 1])
    assert [next(results), next(results)] == [2, 3]
    with pytest.raises(ZeroDivisionError):
        next(results)


def test_closing_an_iterator_does_not_wait_for_its_work() -> None:
    """The garbage collector may close it under a lock that the working threads need to end."""
    started, held, closed = threading.Event(), threading.Event(), threading.Event()

    def work(n: int) -> int:
        if n:
            started.set()
            held.wait(PATIENCE_S)
        return n

    results = work_ahead(work, range(2 * AHEAD), ahead=1)
    assert next(results) == 0
    assert started.wait(PATIENCE_S)

    def close() -> None:
        results.close()
        closed.set()

    closing = threading.Thread(target=close, daemon=True)
    closing.start()
    in_time = closed.wait(PATIENCE_S / 4)
    held.set()
    closing.join()
    assert in_time
