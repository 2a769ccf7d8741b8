"""Work that goes on in the background while its results are used, in the order in which it was given."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Out = TypeVar("Out")

BACKGROUND_THREADS = 2
# Results that are made ahead of the one in use, which bounds the memory.
AHEAD = 6


def work_ahead(work: Callable[[Item], Out], items: Iterable[Item], ahead: int = AHEAD) -> Iterator[Out]:
    """Yield what `work` makes of each item, in their order, made a few ahead by threads.

    Reading, decompressing and arithmetic on arrays leave the interpreter to others meanwhile.
    """
    waiting: deque[Future[Out]] = deque()
    pool = ThreadPoolExecutor(BACKGROUND_THREADS)
    try:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) > ahead:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        # Without waiting: an iterator that is left early may be closed by the garbage collector, in any thread, while that
        # thread holds a lock that ending threads need.
        pool.shutdown(wait=False, cancel_futures=True)
