"""Damaged files of every format: a recording or one sentence, never a traceback, a hang, or numbers that are none."""

import datetime
from pathlib import Path

import pytest
import sample_logs
from damage import WITHIN, Edit, attempt, originals, remade
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

NAMES = [*sample_logs.FORMATS, "bag folder"]
EXTREMES = [
    b"\x00" * 8,
    b"\xff" * 8,
    b"\x7f" * 4,
    b"\xff\xff\xff\x7f",
    b"\x00\x00\x00\x80",
    b"\x01",
    b"nan",
    b"1e999",
    b"\n",
]

places = st.floats(0.0, 1.0)
damages = st.lists(
    st.one_of(
        st.tuples(st.just("set"), places, st.binary(min_size=1, max_size=8) | st.sampled_from(EXTREMES)),
        st.tuples(st.just("insert"), places, st.binary(min_size=1, max_size=16) | st.sampled_from(EXTREMES)),
        st.tuples(st.just("cut"), places, places),
        st.tuples(st.just("repeat"), places, places),
        st.tuples(st.just("end"), places, st.just(b"")),
    ),
    min_size=1,
    max_size=4,
)


def edits_of(changes, size: int) -> list[Edit]:
    """Half of the changes at the first 512 bytes, where the headers are."""
    edits: list[Edit] = []
    for kind, where, what in changes:
        at = int(where * 2 * 512) if where < 0.5 else int((where - 0.5) * 2 * size)
        edits.append((kind, at, what if isinstance(what, bytes) else int(what * 200)))
    return edits


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, tuple[Path, bytes]]:
    """The file to damage and its bytes, by format."""
    found = originals(tmp_path_factory.mktemp("originals"))
    return {name: (path, path.read_bytes()) for name, path in found.items()}


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=40, deadline=datetime.timedelta(seconds=10), suppress_health_check=list(HealthCheck))
@given(changes=damages, within=st.booleans())
def test_damage_ends_in_a_sentence(files, name, changes, within):
    path, data = files[name]
    attempt(path, remade(name, data, edits_of(changes, len(data)), within and name in WITHIN))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=3000, deadline=datetime.timedelta(seconds=10), suppress_health_check=list(HealthCheck))
@given(changes=damages, within=st.booleans())
def test_much_damage_ends_in_a_sentence(files, name, changes, within):
    path, data = files[name]
    attempt(path, remade(name, data, edits_of(changes, len(data)), within and name in WITHIN))


CORPUS: list[tuple[str, bool, list[Edit]]] = [
    # SciPy's reader of MAT 5 files crashes on these
    ("mat", True, [("flip", 124, 2)]),
    ("mat", True, [("cut", 2593, 27), ("repeat", 132, 57), ("flip", 48, 4)]),
    ("broad", False, [("repeat", 67, 113), ("set", 328, b"\xf4K")]),
    ("broad", False, [("repeat", 3003, 54), ("set", 181, b"{7)\xc4")]),
    ("mat plain", False, [("insert", 5085, b"\x7f" * 8)]),
    ("mat plain", True, [("insert", 853, b"\0\0\0\x80")]),
]
"""What broke once: format, whether within what is compressed, and the damage."""


@pytest.mark.parametrize(("name", "within", "edits"), CORPUS)
def test_what_broke_once(files, name, within, edits):
    path, data = files[name]
    assert attempt(path, remade(name, data, edits, within)) != ""


@pytest.mark.parametrize("name", NAMES)
def test_every_length_that_a_file_is_cut_to(files, name):
    path, data = files[name]
    for end in sorted({*range(1, 40), *range(40, len(data), max(len(data) // 40, 1))}):
        attempt(path, data[:end])
