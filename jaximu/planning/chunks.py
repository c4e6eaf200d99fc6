"""Many rows by a function that is compiled for a fixed number of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaximu.ground.tracing import part_of


def in_chunks(function: Callable[..., Any], size: int, *trees: Any) -> Any:
    """Return a function of `size` rows for all rows of its arguments' arrays, in NumPy.

    The last chunk is filled up with the last row, so that one shape is compiled.
    """
    count = len(jax.tree.leaves(trees)[0])
    results = []
    for start in range(0, count, size):
        result = function(*part_of(trees, np.minimum(np.arange(start, start + size), count - 1)))
        results.append(part_of(result, slice(count - start)))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *results)
