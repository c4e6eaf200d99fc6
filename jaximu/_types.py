"""The array type of signatures: JAX arrays where JAX computes, NumPy arrays on the host; both are checked in tests."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing import Any as Array
else:
    import jax
    import numpy as np

    Array = jax.Array | np.ndarray

__all__ = ["Array"]
