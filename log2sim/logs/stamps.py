"""Order of the stamps of a stream."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Unix times beyond this do not fit into int64 nanoseconds.
MAX_TIME_S = 9_000_000_000


def strictly_increasing(t_ns: NDArray[np.int64], what: str) -> tuple[NDArray[np.intp], list[str]]:
    """Select and sort rows so that their stamps strictly increase.

    Parameters
    ----------
    t_ns : (N,) int64
    what : str
        Names the records in notes.

    Returns
    -------
    rows : (M,) int
        Sorted by stamp; of several rows with one stamp the first.
    notes : list of str
        Remarks on unsorted and repeated stamps.
    """
    order = np.argsort(t_ns, kind="stable")
    notes = []
    late = np.flatnonzero(t_ns[1:] < np.maximum.accumulate(t_ns)[:-1]) + 1
    if len(late):
        notes.append(f"{what}: {len(late)} of {len(t_ns)} records out of order, first at stamp {t_ns[late[0]]}; sorted")
    repeated = np.flatnonzero(np.diff(t_ns[order]) == 0) + 1
    if len(repeated):
        first = t_ns[order[repeated[0]]]
        notes.append(f"{what}: {len(repeated)} of {len(t_ns)} records repeat a stamp, first at stamp {first}; dropped")
    return np.delete(order, repeated), notes
