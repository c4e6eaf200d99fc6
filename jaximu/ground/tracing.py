"""One text for arrays on the host and for arrays that are being traced."""

import sys
from typing import Any

__all__ = ["array_module", "is_traced"]


def is_traced(*trees: Any) -> bool:
    """Return whether JAX is tracing any array of these."""
    if "jax" not in sys.modules:
        return False
    import jax
    from jax.core import Tracer

    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def array_module(*trees: Any) -> Any:
    """Return `jax.numpy` where any array of these is being traced, else NumPy: eager JAX compiles every operation."""
    import jax.numpy
    import numpy

    return jax.numpy if is_traced(*trees) else numpy
