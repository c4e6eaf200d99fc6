"""The array types of signatures: JAX arrays where JAX computes, NumPy arrays on the host; both are checked in tests."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from typing import Any as Array

__all__ = ["Array", "FloatArray"]

FloatArray = NDArray[np.float64]


def __getattr__(name: str) -> Any:
    """Return `Array`, for which JAX is imported, to the modules that ask for it."""
    if name != "Array":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import jax

    return jax.Array | np.ndarray
