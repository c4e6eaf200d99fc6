"""Two ways to keep compiled programs between runs: the library's own store, and `jax.export` with JAX's own cache.

`python benchmarks/kept_programs.py`, once with each Python that is to be compared. The second way stands in this script
alone: the library keeps the first, because they take the same time and JAX's cache checks no contents and does not
write whole files.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from common import Table, arguments, finish

VERBS = ("calibrate", "diagnose")
WAYS = {"own store": "run_own", "jax.export and JAX's cache": "run_exported"}


def run_own(line):
    """Run the command line as it is."""
    from jaximu.cli import main

    return main(line)


def run_exported(line):
    """Run the command line with traces kept by `jax.export` and programs by JAX's own cache."""
    folder = Path(os.environ["XDG_CACHE_HOME"]) / "exported"
    folder.mkdir(parents=True, exist_ok=True)
    os.environ |= {"JAX_COMPILATION_CACHE_DIR": str(folder), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
                   "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1"}  # fmt: skip
    from jaximu.cli import main
    from jaximu.ground import stored

    def first_run(key, function, leaves, quick):
        import jax
        import jax.export

        path = folder / f"{stored._code()[:16]}-{key}.exported"
        options = stored._options(quick)
        if path.exists():
            exported = jax.export.deserialize(bytearray(path.read_bytes()))
        else:
            shapes = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves]

            def flat(*leaves):  # every caller here takes leaves
                return tuple(jax.tree.leaves(function(*leaves)))

            exported = jax.export.export(jax.jit(flat))(*shapes)
            path.write_bytes(exported.serialize())
        program = jax.jit(exported.call, compiler_options=options)
        return program, program(*leaves)

    stored._first_run = first_run
    return main(line)


def measured(way, verb, log, cache):
    """Wall and processor seconds of a command in a process of its own."""
    environment = os.environ | {"XDG_CACHE_HOME": str(cache), "OPENBLAS_NUM_THREADS": "1", "JAX_PLATFORMS": "cpu"}
    before, began = os.times(), time.perf_counter()
    subprocess.run([sys.executable, __file__, way, verb, str(log), "--json"], env=environment, check=True,
                   capture_output=True)  # fmt: skip
    wall, after = time.perf_counter() - began, os.times()
    return wall, after.children_user + after.children_system - before.children_user - before.children_system


def size(folder):
    """Megabytes of what is kept."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


def compare():
    """Measure both, in turn, and keep the table."""
    from start import write_log

    options = arguments(__doc__)
    table = Table("Compiled programs kept by the library's own store, and by jax.export with JAX's cache",
                  ["way", "verb", "first run: wall, processor [s]", "later runs: wall, processor [s]", "kept [MB]"],
                  "Later runs: the least of several, in turn with those of the other way.")  # fmt: skip
    figures = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = folder / "log.parquet"
        write_log(log)
        first = {(way, verb): measured(way, verb, log, folder / way) for way in WAYS.values() for verb in VERBS}
        later = {key: [] for key in first}
        for _ in range(1 if options.small else 5):
            for way, verb in first:
                later[way, verb].append(measured(way, verb, log, folder / way))
        for words, way in WAYS.items():
            for verb in VERBS:
                least = [min(seconds) for seconds in zip(*later[way, verb], strict=True)]
                kept = size(folder / way)
                pair = "{:.2f}, {:.2f}".format
                table.add(words, verb, pair(*first[way, verb]), pair(*least), f"{kept:.2f}")
                figures[f"{words}: {verb}"] = {"first": first[way, verb], "later": least, "megabytes": kept}
    version = "".join(map(str, sys.version_info[:2]))
    finish(f"kept_programs_{version}", [table], figures, keep=not options.small, script="kept_programs")


if __name__ == "__main__":
    if sys.argv[1:2] and sys.argv[1] in WAYS.values():
        raise SystemExit(globals()[sys.argv[1]](sys.argv[2:]))
    compare()
