"""Double precision: required, checked where computing begins, never switched on behind the user's back."""

import jax

from jaximu.ground.errors import InputError


def require_float64() -> None:
    """Raise `InputError` unless JAX computes in double precision."""
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise InputError(
            "jaximu needs double precision: call jax.config.update('jax_enable_x64', True) before any other use "
            "of JAX, or set the environment variable JAX_ENABLE_X64=1."
        )
