"""The array types of signatures: JAX arrays where JAX computes, NumPy arrays on the host; both are checked in tests."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from typing import Any as Array

    from jax import Array as Computed

__all__ = ["Array", "BoolArray", "Computed", "FloatArray", "IntArray"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def __getattr__(name: str) -> Any:
    """Return `Array`, and `Computed` that an editor knows, for which JAX is imported, to the modules that ask."""
    if name not in ("Array", "Computed"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import jax

    return jax.Array | np.ndarray
