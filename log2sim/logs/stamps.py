"""Order of the stamps of a stream."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import NS_PER_S

# Unix times beyond this do not fit into int64 nanoseconds.
MAX_TIME_S = 9_000_000_000
# The longest scenario that its schema allows; the frames of KITTI's objects, put 100 s apart, last three quarters of it.
MAX_DISTANCE_NS = 10**15


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
        Sorted by stamp; of several rows with one stamp the first. Rows are left out whose stamps are farther than `MAX_DISTANCE_NS`
        from the middle one: a single stamp of 0 would make a log of decades.
    notes : list of str
        Remarks on wrong, unsorted and repeated stamps.
    """
    order = np.argsort(t_ns, kind="stable")
    notes = []
    # As floats: differences of int64 may overflow.
    distance_ns = np.abs(t_ns.astype(np.float64) - float(t_ns[order[len(order) // 2]])) if len(order) else np.zeros(0)
    far = distance_ns > MAX_DISTANCE_NS
    if far.any():
        notes.append(
            f"{what}: {int(far.sum())} of {len(t_ns)} records have stamps more than {MAX_DISTANCE_NS // NS_PER_S} s off the others, "
            f"first {t_ns[far][0]}; left out"
        )
        rows, others = strictly_increasing(t_ns[~far], what)
        return np.flatnonzero(~far)[rows], notes + others
    late = np.flatnonzero(t_ns[1:] < np.maximum.accumulate(t_ns)[:-1]) + 1
    if len(late):
        notes.append(f"{what}: {len(late)} of {len(t_ns)} records out of order, first at stamp {t_ns[late[0]]}; sorted")
    repeated = np.flatnonzero(np.diff(t_ns[order]) == 0) + 1
    if len(repeated):
        first = t_ns[order[repeated[0]]]
        notes.append(f"{what}: {len(repeated)} of {len(t_ns)} records repeat a stamp, first at stamp {first}; dropped")
    return np.delete(order, repeated), notes
