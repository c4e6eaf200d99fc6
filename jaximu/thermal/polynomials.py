"""Polynomials of bias over temperature for many units at once."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from jaximu.errors import InputError

__all__ = ["fit_polynomials"]

FloatArray = NDArray[np.float64]
_CACHED = 1 << 16
"""Numbers that stay in a core's cache."""


def fit_polynomials(
    kelvin: Float[np.ndarray, "u n"],
    bias: Float[np.ndarray, "u a n"],
    degree: int = 3,
    weight: Float[np.ndarray, "u n"] | None = None,
    reference: float = 25.0,
) -> tuple[Float[np.ndarray, "u a k"], Float[np.ndarray, "u a k"]]:
    """Fit polynomials of T − reference (°C) to the biases of u units in one call.

    **Arguments:** `weight`: of each block, one over its variance up to a factor; zero for padding.

    **Returns:** coefficients (u, a, degree + 1), constant first, and their standard deviations from the scatter that is
    left, blocks taken as independent. Raises `InputError` where a unit has not more blocks than coefficients.

    Powers of each unit's temperature scaled to ±1 are near enough to orthogonal for normal equations (seven digits are
    left at degree eight); one product of matrices makes their sums.
    """
    kelvin, bias = np.asarray(kelvin, float), np.asarray(bias, float)
    units, axes, count = bias.shape
    terms = degree + 1
    if weight is None:
        used, few = count, count <= terms
        low, high = kelvin.min(axis=1), kelvin.max(axis=1)
    else:
        inside = weight > 0
        used = inside.sum(axis=1)
        few = np.any(used <= terms)
        low, high = kelvin.min(axis=1, where=inside, initial=np.inf), kelvin.max(axis=1, where=inside, initial=-np.inf)
    if few:
        raise InputError(f"some unit has too few blocks for a polynomial of degree {degree}.")
    middle, half = (low + high) / 2, (high - low) / 2
    first = bias[:, :, :1]  # a common offset would cost digits
    sums, squares = np.empty((units, terms, terms + axes)), np.empty((units, axes))
    some = max(1, _CACHED // ((terms + axes) * count))
    whole = np.empty((some, terms + axes, count))
    for begin in range(0, units, some):  # as many at once as stay in the cache
        part = slice(begin, min(begin + some, units))
        rows = whole[: part.stop - begin]
        rows[:, 0] = 1.0
        if degree:
            np.subtract(kelvin[part], middle[part, None], out=rows[:, 1])
            rows[:, 1] *= 1 / half[part, None]
        for k in range(2, terms):
            np.multiply(rows[:, 1], rows[:, k - 1], out=rows[:, k])
        np.subtract(bias[part], first[part], out=rows[:, terms:])
        if weight is not None:
            rows *= np.sqrt(weight[part])[:, None]
        np.matmul(rows[:, :terms], rows.transpose(0, 2, 1), out=sums[part])
        np.einsum("uan,uan->ua", rows[:, terms:], rows[:, terms:], out=squares[part])
    gram, product = sums[:, :, :terms], sums[:, :, terms:]
    inverse = np.linalg.inv(gram)
    solved = inverse @ product  # (u, k, a)
    left = squares - np.sum(product * solved, axis=1)
    solved[:, 0] += first[:, :, 0]
    variance = np.maximum(left, 0.0) / np.reshape(used - terms, (-1, 1))
    powers = _powers(degree, (reference - middle) / half, half)
    spread = np.sum(powers * (inverse @ powers), axis=1)
    sigma = np.sqrt(variance[:, :, None] * np.maximum(spread, 0.0)[:, None])
    return solved.transpose(0, 2, 1) @ powers, sigma


def _powers(degree: int, shift: FloatArray, half: FloatArray) -> FloatArray:
    """Return each power of (T − middle) / half as powers of T − reference, (u, power, power)."""
    found = np.zeros((len(shift), degree + 1, degree + 1))
    found[:, 0, 0] = 1.0
    for k in range(1, degree + 1):  # the one before times shift + d / half
        before = found[:, k - 1]
        found[:, k] = shift[:, None] * before
        found[:, k, 1:] += before[:, :-1] / half[:, None]
    return found
