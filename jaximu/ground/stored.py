"""Compiled functions kept between runs, for a command line that starts often and computes little.

Tracing, lowering and compiling a fit takes far longer than running it. A compiled program lies in a folder of the user
under two names: its question with the library's source, and its lowered text, so that an edit of the library which
leaves a program unchanged traces it again but does not compile it again. A kept program is trusted once it has run: one
that cannot be loaded or run is dropped and compiled again. JAX's own cache has no part in it, because it checks no
contents: it would run what a flipped bit made of a program. Off unless a folder is set, which the command line does:
importing the library neither reads nor writes files.
"""

import functools
import hashlib
import os
import pickle
import sys
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar, cast

from jaximu.ground.errors import FilePath, InputError
from jaximu.ground.tracing import is_traced

_folder: Path | None = None
_at_first: Callable[[], None] | None = None
_loaded: dict[str, Callable] = {}
_elsewhere: dict[str, str] = {}  # names of what is defined outside the library, with a digest of its source
_DIGEST = 16  # characters
F = TypeVar("F", bound=Callable)
Result = TypeVar("Result")


def cache(folder: FilePath | None, at_first: Callable[[], None] | None = None) -> None:
    """Keep compiled programs in a folder, so that the next process need not compile them; None stops it.

    Of a folder that only you can write to: what lies there is run. `at_first` is called once, before a function is
    traced where the folder holds none of this version.
    """
    global _folder, _at_first
    if folder is not None:
        Path(folder).mkdir(parents=True, exist_ok=True)
    _folder, _at_first = None if folder is None else Path(folder), at_first


def prepare_process(folder: Path | None, at_first: Callable[[], None] | None = None) -> None:
    """Make a process of one's own ready to compute: double precision, compiled code kept in a folder (`cache`)."""
    cache(folder, at_first)
    if "jax" in sys.modules:
        sys.modules["jax"].config.update("jax_enable_x64", True)
    else:  # which takes half a second to load, and may not be needed
        os.environ["JAX_ENABLE_X64"] = "True"


def folder() -> Path | None:
    """Return where traced functions are kept, for processes that are to share them; None if nowhere."""
    return _folder


def tell_apart(names: Iterable[str], source: str) -> None:
    """Compile anew what is called by one of these names, in a description or a structure, once its source changes."""
    _elsewhere.update(dict.fromkeys(names, hashlib.sha256(source.encode("utf-8", "backslashreplace")).hexdigest()))


def forget() -> None:
    """Let go of the functions that this process holds; `jax.clear_caches` then frees their machine code."""
    _loaded.clear()


@functools.cache
def _code() -> str:
    """A digest of the library's source and of what it is compiled with and for: any change makes a new entry."""
    digest = hashlib.sha256(repr(_machine()).encode())
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


@functools.cache
def _machine() -> tuple:
    """What compiles, and for what."""
    from importlib.metadata import version  # a sixth of the time that help takes

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


@functools.cache
def _options(quick: bool) -> dict[str, bool | int | str]:
    """The compile options that this XLA knows; it refuses a program over one that it does not know."""
    import jax

    known = {}
    for name, value in _QUICK.items() if quick and jax.default_backend() == "cpu" else ():
        with suppress(jax.errors.JaxRuntimeError):
            jax.jit(lambda: 0, compiler_options={name: value}).lower().compile()
            known[name] = value
    return known


def compiled(function: F, quick: bool = False) -> F:
    """Decorate a function of arrays in any structure: compiled for their shapes, kept, and inlined under a trace.

    `quick`: as of `call`.
    """
    description = f"{function.__module__}.{function.__qualname__}"

    @wraps(function)
    def run(*arguments):
        return _called(function, description, *arguments, quick=quick)

    return cast(F, run)


def call(function: Callable[..., Result], description: str, *arguments, quick: bool = True) -> Result:
    """Return `function(*arguments)` with NumPy arrays, from what was compiled before if it is kept; traced arguments
    are computed with as they are, within the program that is being traced.

    **Arguments:** `description` must tell apart all functions that differ in more than the structure, shapes and types
    of their arguments. `quick`: compile in little time, for what runs a few times.
    """
    import jax
    import numpy as np

    results = _called(function, description, *arguments, quick=quick)
    return results if is_traced(arguments) else jax.tree.map(np.asarray, results)


def _called(function: Callable, description: str, *arguments, quick: bool = True) -> Any:
    import jax
    import numpy as np

    if is_traced(arguments):
        return function(*arguments)
    leaves, structure = jax.tree.flatten(arguments)
    leaves = [np.asarray(leaf) for leaf in leaves]
    shapes = ";".join(f"{leaf.shape}{leaf.dtype.str}" for leaf in leaves)
    named = description, str(structure)
    outside = [digest for name, digest in sorted(_elsewhere.items()) if any(name in words for words in named)]
    parts = _code(), *named, shapes, str(quick), *outside
    key = hashlib.sha256("|".join(parts).encode()).hexdigest()[:40]
    if key in _loaded:
        return _loaded[key](*leaves)

    def program(*leaves):
        return function(*jax.tree.unflatten(structure, leaves))

    _loaded[key], results = _first_run(key, program, leaves, quick)
    return results


def _first_run(key: str, function: Callable, leaves: list, quick: bool) -> tuple[Callable, Any]:
    """Return the compiled function, of one device, for leaves like these, and its results for them; keep it."""
    import jax

    def kept(path: Path) -> tuple[Callable, Any]:
        program = _load(path, len(leaves))
        return program, jax.block_until_ready(program(*leaves))

    if _folder is None:
        jitted = jax.jit(function, compiler_options=_options(quick))
        return jitted, jitted(*leaves)
    name = _folder / f"{_code()[:_DIGEST]}-{key}.name"
    with suppress(Exception):  # missing, damaged, of another version, or one that does not run here
        return kept(_folder / name.read_text(encoding="utf-8"))
    with _alone(name.with_suffix(".lock")) as waited:
        if waited:
            with suppress(Exception):  # another process has compiled it meanwhile
                return kept(_folder / name.read_text(encoding="utf-8"))
        return _keep_first_run(name, kept, function, leaves, quick)


def _keep_first_run(
    name: Path, kept: Callable[[Path], tuple[Callable, Any]], function: Callable, leaves: list, quick: bool
) -> tuple[Callable, Any]:
    """Trace a function and compile it, where no kept program has its text; keep it under its name in the folder."""
    import jax

    _tell()
    options = _options(quick)
    shapes = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves]
    lowered = jax.jit(function, compiler_options=options).lower(*shapes)
    # The text leaves out arguments that are not used, and the structure of the results.
    about = repr((_machine(), options, shapes, str(lowered.out_tree), lowered.as_text()))
    path = name.with_name(f"{hashlib.sha256(about.encode()).hexdigest()[:40]}.program")  # whatever the source was
    try:
        program, results = kept(path)
    except Exception:
        program = _compiled(lowered)
        results = program(*leaves)
        with suppress(Exception):  # a kind of device whose programs cannot be kept
            _keep(path, _dump(program))
    _keep(name, path.name.encode())
    return program, results


@contextmanager
def _alone(path: Path) -> Iterator[bool]:
    """Let one process at a time work on what a file locks, and give whether another one did until now.

    A process that dies lets go of it. Where files cannot be locked (a read-only folder, Windows) nobody waits.
    """
    with ExitStack() as stack:
        waited = False
        with suppress(ImportError, OSError):
            import fcntl

            file = stack.enter_context(path.open("wb"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                waited = True
                fcntl.flock(file, fcntl.LOCK_EX)
            stack.callback(path.unlink, missing_ok=True)
        yield waited


def compiling() -> int:
    """Return how many programs processes that share the folder are compiling now."""
    count = 0
    with suppress(ImportError):
        import fcntl

        for path in _folder.glob("*.lock") if _folder else ():
            try:
                with path.open("rb") as file:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                count += 1
            except OSError:  # it is done
                pass
            else:
                path.unlink(missing_ok=True)  # left by a process that died
    return count


def _compiled(lowered: Any) -> Any:
    """Compile without JAX's own cache, which its user may have switched on: what comes out of it cannot be kept."""
    import jax
    from jax.experimental.compilation_cache.compilation_cache import reset_cache

    used = jax.config.jax_enable_compilation_cache  # pyright: ignore[reportAttributeAccessIssue]
    try:
        jax.config.update("jax_enable_compilation_cache", False)
        reset_cache()  # which reads the setting only once
        return lowered.compile()
    finally:
        jax.config.update("jax_enable_compilation_cache", used)
        reset_cache()


def _keep(path: Path, content: bytes) -> None:
    from jaximu.ground.atomic import atomic_write

    try:
        with atomic_write(path) as temporary:
            temporary.write_bytes(content)
        os.chmod(path, 0o600)
    except (InputError, OSError):
        pass  # a read-only cache folder costs time, nothing else


def _dump(compiled: Any) -> bytes:
    """Return a compiled function of leaves as a digest, the structure of its results and the program."""
    import jax
    from jax.experimental.serialize_executable import serialize

    program, _, returned = serialize(compiled)
    content = zlib.compress(pickle.dumps((jax.tree.unflatten(returned, range(returned.num_leaves)), program)), 1)
    return _digest(content) + content


def _load(path: Path, count: int) -> Callable:
    """Return the compiled function of so many leaves that a file keeps; raise whatever it may where it does not."""
    import jax
    from jax.experimental.serialize_executable import deserialize_and_load

    content = path.read_bytes()
    digest, content = content[:_DIGEST], content[_DIGEST:]
    if digest != _digest(content):
        raise ValueError
    results, program = pickle.loads(zlib.decompress(content))
    _prepare_linear_algebra()
    structures = jax.tree.structure(((0,) * count, {})), jax.tree.structure(results)
    return deserialize_and_load(program, *structures, execution_devices=jax.local_devices()[:1])


@functools.cache
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
