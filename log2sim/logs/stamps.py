"""Order of the stamps of a stream."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import NS_PER_S

# Unix times beyond this do not fit into int64 nanoseconds.
MAX_TIME_S = 9_000_000_000
# The longest scenario that its schema allows; the frames of KITTI's objects, put 100 s apart, last three quarters of it.
MAX_DISTANCE_NS = 10**15

# Sweeps last a tenth of a second; a time farther from the stamp of its sweep is damage, or of another clock.
MAX_POINT_OFFSET_NS = NS_PER_S


def checked_offset_ns(t_ns: NDArray[np.number], stamp_ns: int = 0) -> NDArray[np.int64]:
    """Compute the times of points relative to the stamp of their sweep.

    Parameters
    ----------
    t_ns : (N,) whole or floating-point numbers
        Finite.
    stamp_ns : int
        What they count from; 0 for times that are relative to the stamp already.

    Returns
    -------
    (N,) int64

    Raises
    ------
    ValueError
        For any beyond `MAX_POINT_OFFSET_NS`.
    """
    # As integers of Python, which do not overflow.
    ends = [int(t) - stamp_ns for t in (t_ns.min(), t_ns.max())] if len(t_ns) else []
    for end in ends:
        if abs(end) > MAX_POINT_OFFSET_NS:
            raise ValueError(
                f"the time of a point is {end / NS_PER_S:.6g} s off the stamp of its sweep, expected at most "
                f"{MAX_POINT_OFFSET_NS / NS_PER_S:g} s"
            )
    return t_ns.astype(np.int64) - stamp_ns


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
