"""Compiled programs that are kept between runs: found again, made anew where they are gone, never mistaken."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaximu import stored


@pytest.fixture
def folder(tmp_path):
    """A folder of its own for what is compiled here."""
    before = stored.folder()
    stored.use_folder(tmp_path)
    yield tmp_path
    stored.use_folder(before)


def factor(matrix, beside):
    """The Cholesky factor, by LAPACK; what stands beside it is not used."""
    return jnp.linalg.cholesky(matrix)


def again(*arguments):
    """Call as a new process would: nothing in memory."""
    stored.forget()
    return np.asarray(stored.call(factor, "factor", *arguments)[0])


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


def test_an_edit_elsewhere_compiles_nothing(folder):
    """Another source has other names and the same programs."""
    again(MATRIX, np.zeros(3))
    written = times(folder, "program")
    for path in folder.glob("*.name"):
        path.unlink()
    np.testing.assert_allclose(again(MATRIX, np.zeros(3)), ROOT)
    assert times(folder, "program") == written and len(times(folder, "name")) == 1


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


@pytest.mark.parametrize("damage", ["cut", "changed", "empty"])
def test_a_damaged_program_is_made_anew(folder, damage):
    again(MATRIX, np.zeros(3))
    (path,) = folder.glob("*.program")
    content = path.read_bytes()
    half = len(content) // 2
    damaged = {
        "cut": content[:half],
        "changed": content[:half] + bytes([content[half] ^ 255]) + content[half + 1 :],
        "empty": b"",
    }[damage]
    path.write_bytes(damaged)
    np.testing.assert_allclose(again(MATRIX, np.zeros(3)), ROOT)
    assert path.read_bytes() != damaged
    written = times(folder, "program")
    np.testing.assert_allclose(again(MATRIX, np.zeros(3)), ROOT)
    assert times(folder, "program") == written
