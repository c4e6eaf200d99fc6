"""Traced functions kept between runs, for a command line that starts often and computes little.

Tracing and lowering a fit takes longer than running it. `jax.export` keeps the lowered function in a folder of the
user's; JAX's own compilation cache then keeps the machine code. Off unless a folder is set, which the command line
does: importing the library neither reads nor writes files.
"""

import hashlib
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path

import jax
import numpy as np
from jax import export

from jaximu.errors import InputError
from jaximu.formats.atomic import atomic_write

__all__ = ["call", "folder", "use_folder"]

_folder: Path | None = None
_loaded: dict[str, Callable] = {}


def use_folder(folder: Path | None) -> None:
    """Keep traced functions in a folder that only the user can write to (what lies there is run); None stops it."""
    global _folder
    _folder = folder


def folder() -> Path | None:
    """Return where traced functions are kept, for processes that are to share them; None if nowhere."""
    return _folder


def forget() -> None:
    """Let go of the functions that this process holds; `jax.clear_caches` then frees their machine code."""
    _loaded.clear()


@cache
def _code() -> str:
    """A digest of the library's source and of JAX's version: any change makes a new entry."""
    digest = hashlib.sha256(jax.__version__.encode())
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


_QUICK: dict[str, bool | int | str] = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 0}
"""Options with which XLA compiles for a CPU in a quarter of the time, to programs that are slower where they are
large."""


def call(function: Callable, description: str, *arguments, quick: bool = True):
    """Return the leaves of `function(*arguments)`, from a stored trace if there is one.

    **Arguments:** `description` must tell apart all functions that differ in more than the structure, shapes and types
    of their arguments. `quick`: compile in little time, for what runs a few times.
    """
    leaves, structure = jax.tree.flatten(arguments)
    leaves = [np.asarray(leaf) for leaf in leaves]

    def flat(*leaves):
        return tuple(jax.tree.leaves(function(*jax.tree.unflatten(structure, leaves))))

    shapes = ";".join(f"{leaf.shape}{leaf.dtype.str}" for leaf in leaves)
    platform = jax.default_backend()
    key = hashlib.sha256("|".join((_code(), description, str(structure), shapes, platform)).encode()).hexdigest()[:40]
    if key not in _loaded:
        options = _QUICK if quick and platform == "cpu" else None
        _loaded[key] = jax.jit(_stored(key, flat, leaves), compiler_options=options)
    return _loaded[key](*leaves)


def _stored(key: str, flat: Callable, leaves: list) -> Callable:
    if _folder is None:
        return flat
    path = _folder / f"{key}.export"
    try:
        return export.deserialize(bytearray(path.read_bytes())).call
    except Exception:
        # Not there, or damaged by a crash or a full disk: it is only a cache, so make it anew.
        pass
    exported = export.export(jax.jit(flat))(*(jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves))
    try:
        with atomic_write(path) as temporary:
            temporary.write_bytes(exported.serialize())
        os.chmod(path, 0o600)
    except (InputError, OSError):
        pass  # a read-only cache folder costs time, nothing else
    return exported.call
