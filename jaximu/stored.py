"""Traced functions kept between runs, for a command line that starts often and computes little.

Tracing and lowering a fit takes longer than running it. `jax.export` keeps the lowered function in a folder of the
user's; JAX's own compilation cache then keeps the machine code. Off unless a folder is set, which the command line
does: importing the library neither reads nor writes files.
"""

import hashlib
import os
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

from jaximu.errors import InputError

__all__ = ["call", "folder", "forget", "prepare_process", "use_folder"]

_folder: Path | None = None
_at_first: Callable[[], None] | None = None
_loaded: dict[str, Callable] = {}
_DIGEST = 16  # characters


def use_folder(folder: Path | None, at_first: Callable[[], None] | None = None) -> None:
    """Keep traced functions in a folder that only the user can write to (what lies there is run); None stops it.

    `at_first` is called once, before a function is traced where the folder holds none of this version.
    """
    global _folder, _at_first
    _folder, _at_first = folder, at_first


def prepare_process(folder: Path | None, at_first: Callable[[], None] | None = None) -> None:
    """Make a process of one's own ready to compute: double precision, compiled code kept in a folder (`use_folder`)."""
    use_folder(folder, at_first)
    settings: dict[str, object] = {"jax_enable_x64": True}
    if folder is not None:
        settings["jax_compilation_cache_dir"] = str(folder)
        settings["jax_persistent_cache_min_compile_time_secs"] = 0.0
        settings["jax_persistent_cache_min_entry_size_bytes"] = -1
    for name, value in settings.items():
        if "jax" in sys.modules:
            sys.modules["jax"].config.update(name, value)
        else:  # which takes half a second to load, and may not be needed
            os.environ[name.upper()] = str(value)


def folder() -> Path | None:
    """Return where traced functions are kept, for processes that are to share them; None if nowhere."""
    return _folder


def forget() -> None:
    """Let go of the functions that this process holds; `jax.clear_caches` then frees their machine code."""
    _loaded.clear()


@cache
def _code() -> str:
    """A digest of the library's source and of JAX's version: any change makes a new entry."""
    import jax

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
    import jax
    import numpy as np

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
    import jax
    from jax import export

    from jaximu.formats.atomic import atomic_write

    if _folder is None:
        return flat
    path = _folder / f"{_code()[:_DIGEST]}-{key}.export"
    try:
        content = path.read_bytes()
        if content[:_DIGEST] == _digest(content[_DIGEST:]):
            return export.deserialize(bytearray(content[_DIGEST:])).call
    except Exception:
        pass  # not there, or of another version: it is only a cache, so make it anew
    _tell()
    exported = export.export(jax.jit(flat))(*(jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves))
    content = bytes(exported.serialize())
    try:
        with atomic_write(path) as temporary:
            temporary.write_bytes(_digest(content) + content)
        os.chmod(path, 0o600)
    except (InputError, OSError):
        pass  # a read-only cache folder costs time, nothing else
    return exported.call


def _digest(content: bytes) -> bytes:
    """Stands before the content: what a crash or a full disk cut off or changed is not run."""
    return hashlib.sha256(content).hexdigest()[:_DIGEST].encode()


def _tell() -> None:
    """Announce the first compilation, once."""
    global _at_first
    if _at_first and _folder and os.access(_folder, os.W_OK) and not any(_folder.glob(f"{_code()[:_DIGEST]}-*.export")):
        _at_first()
    _at_first = None
