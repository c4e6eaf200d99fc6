"""The array types of signatures: JAX arrays where JAX computes, NumPy arrays on the host; both are checked in tests."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from typing import Any as Array
else:
    import jax

    Array = jax.Array | np.ndarray

__all__ = ["Array", "FloatArray"]

FloatArray = NDArray[np.float64]
