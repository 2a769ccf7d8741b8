"""Quadratic forms over a chain of states, their sum and its minimum by a banded Cholesky factorization in linear time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from log2sim.geometry import Array

# A chain of at most as many states is inverted as a dense matrix.
MAX_DENSE_STATES = 8


@dataclass(frozen=True, eq=False)
class Quadratic:
    """`value - 2 gradient.d + d.A.d` of a step d away from a reference state, A block-tridiagonal.

    Attributes
    ----------
    band : (K p, 2p) float64
        Columns of A from the diagonal down.
    gradient : (K, p, m) float64
        Negative half gradient at the reference, of m columns of unknowns that share A.
    value : float
        At the reference.
    """

    band: Array
    gradient: Array
    value: float

    @classmethod
    def of(cls, diagonal: Array, off: Array | None, gradient: Array, value: float) -> Quadratic:
        """Build a form from the blocks on (K, p, p) and above (K-1, p, p) A's diagonal, the latter None if zero."""
        return cls(to_band(diagonal, off), gradient, value)


@dataclass(frozen=True, eq=False)
class Minimum:
    """Minimum of a quadratic form.

    Attributes
    ----------
    step : (K, p, m) float64
        From the reference to the minimum.
    value : float
        At the minimum.
    log_determinant : float
        log(det A).
    form : Quadratic
    """

    step: Array
    value: float
    log_determinant: float
    form: Quadratic

    @cached_property
    def covariance(self) -> Array:
        """Diagonal blocks (K, p, p) of the inverse of A."""
        return selected_inverse(*from_band(self.form.band, self.step.shape[1]))[0]


def weighted_sum(terms: Iterable[tuple[float, Quadratic]]) -> Quadratic:
    """Sum weighted forms about the same reference."""
    (weight, first), *others = terms
    band, gradient, value = first.band * weight, first.gradient * weight, first.value * weight
    for weight, term in others:
        band += weight * term.band
        gradient += weight * term.gradient
        value += weight * term.value
    return Quadratic(band, gradient, value)


def minimize(form: Quadratic) -> Minimum:
    """Find the minimum by a banded Cholesky factorization, O(K p^3).

    Raises
    ------
    np.linalg.LinAlgError
        When A is not positive definite.
    """
    from scipy.linalg.lapack import dpbtrf, dpbtrs

    factor, failed = dpbtrf(form.band.T, lower=1)
    if failed:
        raise np.linalg.LinAlgError(f"the normal equations lose rank at unknown {failed} of {len(form.band)}")
    step, _ = dpbtrs(factor, form.gradient.reshape(-1, form.gradient.shape[2]), lower=1)
    step = step.reshape(form.gradient.shape)
    return Minimum(step, form.value - float(np.vdot(form.gradient, step)), 2.0 * float(np.log(factor[0]).sum()), form)


def to_band(diagonal: Array, off: Array | None) -> Array:
    """Store blocks as columns (K p, 2p) from the diagonal down: LAPACK's lower band storage, transposed.

    Every block column holds the diagonal block and the one below it; reading it with a stride that goes one further with
    every column skews it into the band.
    """
    count, size, _ = diagonal.shape
    slab = np.zeros((count, size, 3 * size - 1))
    slab[:, :, :size] = diagonal
    if off is not None:
        slab[:-1, :, size : 2 * size] = off
    return _band_view(slab).reshape(count * size, 2 * size)


def from_band(band: Array, size: int) -> tuple[Array, Array]:
    """Extract the blocks on (K, p, p) and above (K-1, p, p) the diagonal of a matrix in band storage."""
    count = len(band) // size
    slab = np.zeros((count, size, 3 * size - 1))
    _band_view(slab)[:] = band.reshape(count, size, 2 * size)
    half = slab[:, :, :size]
    diagonal = half + np.swapaxes(half, 1, 2)
    diagonal[:, range(size), range(size)] /= 2
    return diagonal, slab[:-1, :, size : 2 * size]


def _band_view(slab: Array) -> Array:
    """View (K, p, 2p) of a slab (K, p, 3p-1) that starts one item further in every next column."""
    count, size, _ = slab.shape
    block, column, item = slab.strides
    shape = (count, size, 2 * size)
    # As np.lib.stride_tricks.as_strided does, in a sixth of its time.
    return np.ndarray(shape, np.float64, slab.data, strides=(block, column + item, item))


def selected_inverse(diagonal: Array, off: Array) -> tuple[Array, Array]:
    """Blocks on (K, p, p) and above (K-1, p, p) the diagonal of the inverse of a block-tridiagonal matrix.

    Notes
    -----
    Cyclic reduction (Buzbee, Golub and Nielson, SIAM J. Numer. Anal. 7, 1970): every other state is eliminated at once, which leaves a chain of half the length. Its O(log K) rounds
    are each a few stacked products, where elimination along the chain would take K.
    """
    if len(diagonal) <= MAX_DENSE_STATES:
        return _dense_inverse(diagonal, off)
    even, odd = diagonal[::2], np.linalg.inv(diagonal[1::2])
    left, right = off[::2], off[1::2]  # even to odd, odd to even
    n, m = len(left), len(right)
    from_left, from_right = odd @ np.swapaxes(left, 1, 2), odd[:m] @ right
    reduced = even.copy()
    reduced[:n] -= left @ from_left
    reduced[1 : 1 + m] -= np.swapaxes(right, 1, 2) @ from_right
    inverse, neighbor = selected_inverse(reduced, -left[:m] @ from_right)
    to_left = -from_left @ inverse[:n]
    to_left[:m] -= from_right @ np.swapaxes(neighbor[:m], 1, 2)
    to_right = -from_left[:m] @ neighbor[:m] - from_right @ inverse[1 : 1 + m]
    odd -= to_left @ np.swapaxes(from_left, 1, 2)
    odd[:m] -= to_right @ np.swapaxes(from_right, 1, 2)
    on, above = np.empty_like(diagonal), np.empty_like(off)
    on[::2], on[1::2] = inverse, odd
    above[::2], above[1::2] = np.swapaxes(to_left, 1, 2), to_right
    return on, above


def _dense_inverse(diagonal: Array, off: Array) -> tuple[Array, Array]:
    count, size, _ = diagonal.shape
    dense = np.zeros((count, size, count, size))
    k = np.arange(count)
    dense[k, :, k] = diagonal
    dense[k[:-1], :, k[1:]] = off
    dense[k[1:], :, k[:-1]] = np.swapaxes(off, 1, 2)
    inverse = np.linalg.inv(dense.reshape(count * size, -1)).reshape(dense.shape).astype(np.float64, copy=False)
    return inverse[k, :, k], inverse[k[:-1], :, k[1:]]
