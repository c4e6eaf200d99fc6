"""Compiled functions kept between runs, for a command line that starts often and computes little.

Tracing, lowering and compiling a fit takes far longer than running it. What was compiled lies in a folder of the user's
under two names: what it was asked for, with the library's source, and what it was lowered to, so that what an edit of
the library leaves as it was is traced anew and not compiled anew. Off unless a folder is set, which the command line
does: importing the library neither reads nor writes files.
"""

import hashlib
import os
import sys
import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

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
    """A digest of the library's source and of what it is compiled with and for: any change makes a new entry."""
    digest = hashlib.sha256(repr(_machine()).encode())
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


@cache
def _machine() -> tuple:
    """What compiles, and for what."""
    import jax

    device = jax.local_devices()[0]
    versions = jax.__version__, version("jaxlib"), device.client.platform_version
    return *versions, device.device_kind, _processor(), os.environ.get("XLA_FLAGS", "")


def _processor() -> list[str]:
    """What a processor can do, where it says so: code made on another may need more than it has."""
    information = Path("/proc/cpuinfo")
    lines = information.read_text(encoding="utf-8").splitlines() if information.exists() else []
    return sorted({line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part"))})


_QUICK: dict[str, bool | int | str] = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 0}
"""Options with which XLA compiles for a CPU in a quarter of the time, to programs that are slower where they are
large."""


def call(function: Callable, description: str, *arguments, quick: bool = True):
    """Return the leaves of `function(*arguments)`, from what was compiled before if it is kept.

    **Arguments:** `description` must tell apart all functions that differ in more than the structure, shapes and types
    of their arguments. `quick`: compile in little time, for what runs a few times.
    """
    import jax
    import numpy as np

    leaves, structure = jax.tree.flatten(arguments)
    leaves = [np.asarray(leaf) for leaf in leaves]

    def program(*leaves):
        return tuple(jax.tree.leaves(function(*jax.tree.unflatten(structure, leaves))))

    shapes = ";".join(f"{leaf.shape}{leaf.dtype.str}" for leaf in leaves)
    options = _QUICK if quick and jax.default_backend() == "cpu" else None
    parts = _code(), description, str(structure), shapes, str(options)
    key = hashlib.sha256("|".join(parts).encode()).hexdigest()[:40]
    if key not in _loaded:
        _loaded[key] = _stored(key, jax.jit(program, compiler_options=options), leaves, options)
    return _loaded[key](*leaves)


def _stored(key: str, function: Any, leaves: list, options: Mapping | None) -> Callable:
    """Return a jitted function, of one device, compiled for leaves like these, and keep it."""
    import jax

    if _folder is None:
        return function
    place = _folder / f"{_code()[:_DIGEST]}-{key}.name"
    try:
        return _load(_folder / place.read_text(encoding="utf-8"), len(leaves))
    except Exception:
        pass  # not there, damaged, or of another version: it is only a cache, so make it anew
    _tell()
    given = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves]
    lowered = function.lower(*given)
    about = repr((_machine(), options, given, lowered.as_text()))  # the text leaves out arguments that are not used
    path = _folder / f"{hashlib.sha256(about.encode()).hexdigest()[:40]}.program"  # whatever the source was
    try:
        found = _load(path, len(leaves))
    except Exception:
        found = _compiled(lowered)
        with suppress(Exception):  # a kind of device whose programs cannot be kept
            _keep(path, _dump(found))
    _keep(place, path.name.encode())
    return found


def _compiled(lowered: Any) -> Any:
    """Compile without JAX's own cache: what comes out of that cannot be kept again."""
    import jax

    least = "jax_persistent_cache_min_compile_time_secs"
    usual = getattr(jax.config, least)
    jax.config.update(least, float("inf"))
    try:
        return lowered.compile()
    finally:
        jax.config.update(least, usual)


def _keep(path: Path, content: bytes) -> None:
    from jaximu.formats.atomic import atomic_write

    try:
        with atomic_write(path) as temporary:
            temporary.write_bytes(content)
        os.chmod(path, 0o600)
    except (InputError, OSError):
        pass  # a read-only cache folder costs time, nothing else


def _dump(compiled: Any) -> bytes:
    """Return a compiled function from leaves to leaves: a digest, how many leaves come out, the program."""
    from jax.experimental.serialize_executable import serialize

    program, _, returned = serialize(compiled)
    content = zlib.compress(returned.num_leaves.to_bytes(4, "big") + program, 1)
    return _digest(content) + content


def _load(path: Path, count: int) -> Callable:
    """Return the compiled function of so many leaves that a file keeps; raise whatever it may where it does not."""
    import jax
    from jax.experimental.serialize_executable import deserialize_and_load

    content = path.read_bytes()
    digest, content = content[:_DIGEST], content[_DIGEST:]
    if digest != _digest(content):
        raise ValueError
    content = zlib.decompress(content)
    _prepare_linear_algebra()
    given = jax.tree.structure(((0,) * count, {}))
    returned = jax.tree.structure((0,) * int.from_bytes(content[:4], "big"))
    return deserialize_and_load(content[4:], given, returned, execution_devices=jax.local_devices()[:1])


@cache
def _prepare_linear_algebra() -> None:
    """Have JAX find the functions of LAPACK, which it does where a program that needs one is lowered."""
    import jax

    jax.jit(jax.numpy.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), float))


def _digest(content: bytes) -> bytes:
    """Stands before the content: what a crash or a full disk cut off or changed is not run."""
    return hashlib.sha256(content).hexdigest()[:_DIGEST].encode()


def _tell() -> None:
    """Announce the first compilation, once."""
    global _at_first
    if _at_first and _folder and os.access(_folder, os.W_OK) and not any(_folder.glob(f"{_code()[:_DIGEST]}-*.name")):
        _at_first()
    _at_first = None
