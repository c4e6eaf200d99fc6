"""Rows of vectors, and covariances: their lengths, products, standard deviations and parts."""

import numpy as np

from jaximu.ground.array_types import FloatArray


def lengths_of(vectors) -> FloatArray:
    """Return the lengths (…,) of vectors (…, m)."""
    return np.linalg.norm(vectors, axis=-1)


def column_lengths(matrix) -> FloatArray:
    """Return the lengths (n,) of the columns of a matrix (m, n)."""
    return np.linalg.norm(matrix, axis=0)


def dot_rows(one, other) -> FloatArray:
    """Return the scalar products (n,) of vectors (n, m) with others."""
    return np.sum(one * other, axis=1)


def variances_of(covariance) -> FloatArray:
    """Return the variances (…, n) of covariances (…, n, n)."""
    return np.diagonal(covariance, axis1=-2, axis2=-1)


def sigmas_of(covariance) -> FloatArray:
    """Return the standard deviations (…, n) of covariances (…, n, n)."""
    return np.sqrt(variances_of(covariance))


def submatrix(matrix, places) -> FloatArray:
    """Return the rows and columns of a matrix (n, n) at places (k,): (k, k)."""
    return matrix[np.ix_(places, places)]


def root_or_zero(values):
    """Return the square roots of numbers that rounding may have made negative: of these, zero."""
    return np.sqrt(np.maximum(values, 0.0))


def means_by_group(group, values, count=0) -> FloatArray:
    """Return the means (groups, m) of values (n, m) over the group of each, `count` or more; else zero."""
    sums = np.column_stack([np.bincount(group, column, count) for column in values.T])
    return sums / np.maximum(np.bincount(group, minlength=count), 1)[:, None]
