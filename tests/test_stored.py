"""Compiled programs that are kept between runs: found again, made anew where they are gone, never mistaken."""

import os
import pickle
import subprocess
import sys
import time
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaximu.cli import main
from jaximu.ground import stored
from jaximu.model.sensor import Triad


@pytest.fixture
def folder(tmp_path):
    """A folder of its own for what is compiled here."""
    before = stored.folder()
    stored.cache(tmp_path)
    yield tmp_path
    stored.cache(before)


def factor(matrix, beside):
    """The Cholesky factor, by LAPACK; what stands beside it is not used."""
    return jnp.linalg.cholesky(matrix)


def again(*arguments):
    """Call as a new process would: nothing in memory."""
    stored.forget()
    return stored.call(factor, "factor", *arguments)


def times(folder, kind):
    """When each file of a kind was written."""
    return {path.name: path.stat().st_mtime_ns for path in folder.glob(f"*.{kind}")}


MATRIX = np.array([[4.0, 2.0], [2.0, 5.0]])
ROOT = np.array([[2.0, 0.0], [1.0, 2.0]])


def test_a_program_is_compiled_once(folder):
    np.testing.assert_allclose(again(MATRIX, np.zeros(3)), ROOT)
    written = times(folder, "program") | times(folder, "name")
    assert len(written) == 2
    np.testing.assert_allclose(again(MATRIX, np.zeros(3)), ROOT)
    assert times(folder, "program") | times(folder, "name") == written


_WORKER = """
import sys, time
from pathlib import Path
import numpy as np
from jaximu.ground import stored

folder, name = Path(sys.argv[1]), sys.argv[2]
compiled = stored._compiled

def counted(lowered):
    (folder / f"compiled by {name}").touch()
    time.sleep(1.0)
    return compiled(lowered)

stored._compiled = counted
stored.prepare_process(folder)
(folder / f"ready {name}").touch()
while len(list(folder.glob("ready *"))) < 2:
    time.sleep(0.01)
print(stored.call(abs, "absolute", np.array([-2.0, 3.0])))
"""


def test_two_processes_never_compile_the_same_program(folder):
    workers = [subprocess.Popen([sys.executable, "-c", _WORKER, str(folder), name], stdout=subprocess.PIPE, text=True)
               for name in "ab"]  # fmt: skip
    most = 0
    while any(worker.poll() is None for worker in workers):
        most = max(most, stored.compiling())
        time.sleep(0.05)
    assert [worker.communicate()[0].split() for worker in workers] == [["[2.", "3.]"]] * 2
    assert len(list(folder.glob("compiled by *"))) == 1 and most == 1
    assert stored.compiling() == 0 and not list(folder.glob("*.lock"))


def test_the_lock_of_a_process_that_died_holds_nobody_up(folder):
    (folder / "left.lock").touch()
    assert stored.compiling() == 0 and not list(folder.glob("*.lock"))


def test_an_edit_elsewhere_compiles_nothing(folder):
    """Another source has other names and the same programs."""
    again(MATRIX, np.zeros(3))
    written = times(folder, "program")
    for path in folder.glob("*.name"):
        path.unlink()
    np.testing.assert_allclose(again(MATRIX, np.zeros(3)), ROOT)
    assert times(folder, "program") == written and len(times(folder, "name")) == 1


def test_an_edit_in_any_room_makes_other_names(folder, tmp_path, monkeypatch):
    """What a program is called holds all of the library's source: else an edited effect would run as it was."""
    effect = tmp_path / "library" / "model" / "effect.py"
    effect.parent.mkdir(parents=True)
    monkeypatch.setattr(stored, "__file__", str(effect.parents[1] / "ground" / "stored.py"))
    for count, text in enumerate(("term = 1", "term = 1", "term = 2")):
        effect.write_text(text, encoding="utf-8")
        stored._code.cache_clear()
        again(MATRIX, np.zeros(3))
        assert len(times(folder, "name")) == (1 if count < 2 else 2)
    stored._code.cache_clear()


def test_what_is_made_anew_can_be_kept_anew(folder):
    """JAX's own cache has no part in it: a program that comes out of that cannot be written again."""
    for _ in range(3):
        np.testing.assert_allclose(again(MATRIX, np.zeros(3)), ROOT)
        np.testing.assert_allclose(again(MATRIX, np.zeros(3)), ROOT)
        for path in folder.iterdir():
            path.unlink()


def test_arguments_that_are_not_used_tell_programs_apart(folder):
    """What is lowered does not show them, and a program takes no others than it was made for."""
    for size in (3, 5, 3):
        np.testing.assert_allclose(again(MATRIX, np.zeros(size)), ROOT)
    assert len(times(folder, "program")) == 2


def flipped(content):
    half = len(content) // 2
    return content[:half] + bytes([content[half] ^ 1]) + content[half + 1 :]


def of_another_version(content):
    """With a right digest before what this version does not understand."""
    return signed(len(content).to_bytes(4, "big") + content)


def of_another_function(content):
    """With a right digest before what is no program."""
    return signed(zlib.compress(pickle.dumps(((0,), b"program"))))


def signed(content):
    return stored._digest(content) + content


DAMAGE = {
    "cut": lambda content: content[: len(content) // 2],
    "a bit flipped": flipped,
    "empty": lambda content: b"",
    "another version": of_another_version,
    "another function": of_another_function,
}


@pytest.mark.parametrize("kind", ["program", "name"])
@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_file_is_made_anew(folder, damage, kind):
    again(MATRIX, np.zeros(3))
    (path,) = folder.glob(f"*.{kind}")
    damaged = damage(path.read_bytes())
    path.write_bytes(damaged)
    np.testing.assert_allclose(again(MATRIX, np.zeros(3)), ROOT)
    assert path.read_bytes() != damaged
    written = times(folder, kind)
    np.testing.assert_allclose(again(MATRIX, np.zeros(3)), ROOT)
    assert times(folder, kind) == written


def test_a_program_that_loads_and_does_not_run_is_made_anew(folder, monkeypatch):
    again(MATRIX, np.zeros(3))
    (path,) = folder.glob("*.program")
    path.unlink()  # to see that it is written

    def load(path, count):
        def fail(*leaves):
            raise jax.errors.JaxRuntimeError("NOT_FOUND: Function fusion not found")

        return fail

    with monkeypatch.context() as patched:
        patched.setattr(stored, "_load", load)
        np.testing.assert_allclose(again(MATRIX, np.zeros(3)), ROOT)
    assert path.exists()


def test_jax_own_cache_has_no_part_in_it(folder):
    """What JAX's cache gives back cannot be kept: it loads, and does not run."""

    def fused(values):
        return jnp.sum(jnp.sin(values) ** 2 + jnp.cumsum(values))

    def result():
        stored.forget()
        jax.clear_caches()
        return float(stored.call(fused, "fused", np.arange(40.0), quick=False))

    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(folder))
    try:
        stored.cache(None)
        right = result()
        assert list(folder.glob("*-cache"))  # JAX's own has it now
        stored.cache(folder)
        assert result() == right
        written = times(folder, "program")
        assert [result(), result()] == [right] * 2 and times(folder, "program") == written
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_options_that_this_xla_does_not_know_are_left_out(folder, monkeypatch):
    monkeypatch.setattr(stored, "_QUICK", {"xla_of_another_century": True, "xla_backend_optimization_level": 0})
    stored._options.cache_clear()
    try:
        assert stored._options(True) == {"xla_backend_optimization_level": 0}
        np.testing.assert_allclose(again(MATRIX, np.zeros(3)), ROOT)
    finally:
        stored._options.cache_clear()


PROGRAM = """
import os, signal, sys
import numpy as np
from pathlib import Path
from jaximu.ground import stored

stored.prepare_process(Path(sys.argv[1]))
if sys.argv[2:] == ["killed"]:
    os.replace = lambda *paths: os.kill(os.getpid(), signal.SIGKILL)
values = np.arange(4.0)
assert float(stored.call(lambda x: (2 * x).sum(), "sum", values)) == 12.0
"""


def begun(folder, *how):
    return subprocess.Popen([sys.executable, "-c", PROGRAM, str(folder), *how], env=os.environ)


def test_two_processes_at_once_and_one_killed_half_way(folder):
    killed = begun(folder, "killed")
    assert killed.wait() < 0 and not list(folder.glob("[!.]*.program"))
    both = begun(folder), begun(folder)
    assert [process.wait() for process in both] == [0, 0]
    assert len(list(folder.glob("[!.]*.program"))) == 1
    assert begun(folder).wait() == 0


def test_a_verb_ends_well_whatever_the_folder_holds(folder, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    specification = tmp_path / "spec.toml"
    specification.write_text(
        'rate = 20\n[protocol]\nkind = "hand-held"\nposes = 3\npose_duration = 1.0\nturn_duration = 1.0\n'
    )

    def simulated(number):
        stored.forget()
        assert main(["simulate", str(specification), "-o", str(tmp_path / f"{number}.csv")]) == 0
        return (tmp_path / f"{number}.csv").read_bytes()

    right = simulated("right")
    paths = [*(tmp_path / "jaximu").glob("*.program"), *(tmp_path / "jaximu").glob("*.name")]
    assert paths
    for number, damage in enumerate(DAMAGE.values()):
        for path in paths:
            path.write_bytes(damage(path.read_bytes()))
        assert simulated(number) == right


@stored.compiled
def moved(triad, by):
    return Triad(triad.gain, triad.bias + by)


def test_a_decorated_function_returns_what_it_returns(folder):
    """From the store with arrays, inlined under a trace."""
    triad = Triad(np.eye(3), np.zeros(3))
    for _ in range(2):
        stored.forget()
        result = moved(triad, np.ones(3))
        assert isinstance(result, Triad)
        np.testing.assert_array_equal(result.bias, np.ones(3))
    assert len(times(folder, "program")) == 1
    slope = jax.jit(jax.jacfwd(lambda by: moved(triad, by).bias))(jnp.ones(3))
    np.testing.assert_array_equal(slope, np.eye(3))
