"""The environment of the tests, their workers and the commands they start: set before JAX is imported."""

import atexit
import gc
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

# Compiling is much of what the tests take; without any optimising (level 0) what runs takes longer than that saves.
# A program in one part is compiled in nine tenths of the time on two busy cores, and has a third fewer memory maps.
_QUICK = (
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_backend_optimization_level=1",
    "--xla_cpu_parallel_codegen_split_count=1",
)
_LARGEST = 2 * 2**30  # bytes of compiled code kept between runs


def environment() -> dict[str, str]:
    """Return the variables; a worker or a command finds those of the process that started it, and keeps them."""
    folder = os.environ.get("JAXIMU_TESTS_CACHE")
    flags = os.environ.get("XLA_FLAGS", "")
    if folder is None:  # else the process that started this one has found out both
        folder = str(_kept_folder())
        flags = f"{_known_flags(Path(folder))} {flags}".strip()  # the last one counts: a user's own
    return {
        "JAX_PLATFORMS": os.environ.get("JAX_PLATFORMS", "cpu"),
        "MPLBACKEND": "Agg",
        "XLA_FLAGS": flags,
        # Two workers fill two cores: threads of NumPy's beside them wait for one another, and wait busily.
        "OPENBLAS_NUM_THREADS": os.environ.get("OPENBLAS_NUM_THREADS", "1"),
        "JAXIMU_TESTS_CACHE": folder,
        # A user's own cache is neither used nor filled: the command line keeps its code in this folder's `jaximu`.
        "XDG_CACHE_HOME": folder,
        # JAX would look through a bounded cache at every entry that it adds (a quarter of a second each, of thousands):
        # `_prune` bounds it instead, once. Small programs are most of what is compiled.
        "JAX_COMPILATION_CACHE_MAX_SIZE": "-1",
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }


def _known_flags(folder: Path) -> str:
    """Those of the flags that this XLA knows: it ends the process over one that it does not know. Asked once."""
    answer = folder / "xla_flags"
    if not answer.is_file():
        begin = [sys.executable, "-c", "import jax; jax.devices()"]
        known = [
            flag
            for flag in _QUICK
            if not subprocess.run(begin, env=os.environ | {"XLA_FLAGS": flag}, capture_output=True).returncode
        ]
        answer.write_text(" ".join(known), encoding="utf-8")
    return answer.read_text(encoding="utf-8")


def _kept_folder() -> Path:
    """The folder of compiled code, shared by the workers and by the commands they start, and kept between runs.

    JAX names each entry by the program, the compiler and its options, `jaximu.ground.stored` by the library's source;
    what processor the code was made for stands in the folder's name. Only the user can write to it, as what lies there
    is run; where that cannot be had it lasts for one session. What a process was killed over is read in vain and
    compiled anew, which costs time and nothing else.
    """
    information = Path("/proc/cpuinfo")
    lines = information.read_text(encoding="utf-8").splitlines() if information.exists() else []
    processor = {line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part"))}
    key = repr((sorted(processor), platform.machine(), platform.processor(), version("jaxlib"), version("jax")))
    try:
        base = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "jaximu-tests"
        folder = base / hashlib.sha256(key.encode()).hexdigest()[:16]
        for each in (base, folder):
            each.mkdir(parents=True, exist_ok=True, mode=0o700)
            if hasattr(os, "getuid") and (each.stat().st_uid != os.getuid() or each.stat().st_mode & 0o077):
                raise OSError
        with tempfile.TemporaryFile(dir=folder):
            pass
        _prune(folder)
    except (OSError, RuntimeError):
        folder = Path(tempfile.mkdtemp(prefix="jaximu-tests-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def few_memory_maps() -> None:
    """Let go of compiled code, which lies in memory maps, before the 65530 that Linux gives a process run out."""
    maps = Path("/proc/self/maps")
    if not maps.exists() or maps.read_bytes().count(b"\n") <= 40_000:
        return
    import jax  # after `environment`

    from jaximu.ground import stored

    stored.forget()
    jax.clear_caches()
    gc.collect()


def _prune(folder: Path) -> None:
    """Remove traces of a source that is no more, and what was compiled longest ago beyond two gigabytes."""
    entries, kept = [], 0
    for path in folder.rglob("*"):
        with suppress(FileNotFoundError):  # another session's
            if path.is_file():
                entries.append((path.stat().st_mtime, path.stat().st_size, path))
    for changed, size, path in sorted(entries, reverse=True):
        kept += size
        if kept > _LARGEST or (path.suffix == ".name" and time.time() - changed > 3 * 86400):
            path.unlink(missing_ok=True)
