"""Damaged files of every format: a recording or one sentence, never a traceback, a hang, or numbers that are none."""

import datetime
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import sample_logs
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jaximu.errors import InputError, JaximuError
from jaximu.formats import ReadOptions, read_recording, write_recording
from jaximu.recording import Recording, Signal

# A bag that is a folder is damaged in its metadata.
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


def damaged(data: bytes, changes) -> bytes:
    for kind, where, what in changes:
        # half of the changes at the first 512 bytes, where the headers are
        at = int(where * 2 * 512) if where < 0.5 else int((where - 0.5) * 2 * len(data))
        if kind == "set":
            data = data[:at] + what + data[at + len(what) :]
        elif kind == "insert":
            data = data[:at] + what + data[at:]
        elif kind == "end":
            data = data[: max(at, 1)]
        else:
            to = at + int(what * 200)
            data = data[:at] + data[to:] if kind == "cut" else data[:to] + data[at:]
    return data


@pytest.fixture(scope="module")
def originals(tmp_path_factory) -> dict[str, tuple[Path, bytes]]:
    """The file to damage and its bytes, by format; small ones, so that a change matters."""
    folder = tmp_path_factory.mktemp("originals")
    rows, sample_logs.ROWS = sample_logs.ROWS, 60
    try:
        found = {name: write(folder / name.replace(" ", "_")) for name, write in sample_logs.FORMATS.items()}
        bag = sample_logs.write_bag(folder / "bag", sample_logs.imu_messages(2), storage="mcap")
    finally:
        sample_logs.ROWS = rows
    return {name: (path, path.read_bytes()) for name, path in found.items()} | {
        "bag folder": (bag / "metadata.yaml", (bag / "metadata.yaml").read_bytes())
    }


def attempt(path: Path, data: bytes) -> None:
    """Read the damaged file: what comes is a sound recording, or one sentence naming the file or an option."""
    path.write_bytes(data)
    opened = path.parent if path.name == "metadata.yaml" else path
    try:
        recording = read_recording(opened, options=ReadOptions(check=False))
    except JaximuError as error:
        text = str(error)
        assert text and "\n" not in text and (path.name in text or opened.name in text or "--" in text)
        return
    for signal in recording.signals.values():
        assert np.isfinite(signal.values).all() and np.isfinite(signal.time).all()
        assert (np.diff(signal.time) > 0).all()


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=40, deadline=datetime.timedelta(seconds=10), suppress_health_check=list(HealthCheck))
@given(changes=damages)
def test_damage_ends_in_a_sentence(originals, name, changes):
    path, data = originals[name]
    attempt(path, damaged(data, changes))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=3000, deadline=datetime.timedelta(seconds=10), suppress_health_check=list(HealthCheck))
@given(changes=damages)
def test_much_damage_ends_in_a_sentence(originals, name, changes):
    path, data = originals[name]
    attempt(path, damaged(data, changes))


@pytest.mark.parametrize("name", NAMES)
def test_every_length_that_a_file_is_cut_to(originals, name):
    path, data = originals[name]
    for end in sorted({*range(1, 40), *range(40, len(data), max(len(data) // 40, 1))}):
        attempt(path, data[:end])


@pytest.mark.parametrize("suffix", [".npz", ".parquet"])
def test_a_small_file_that_unpacks_to_a_giant(tmp_path, monkeypatch, suffix):
    """Refused by the sizes it states, before the memory is taken."""
    path = tmp_path / f"log{suffix}"
    time = np.arange(100_000) * 0.01
    write_recording(Recording(Signal(time, np.tile([0.0, 0.1, 9.8], (len(time), 1)), "m/s^2")), path)
    if suffix == ".parquet":
        pq.write_table(pa.table({f"accel_{axis} [m/s^2]": pa.array(np.zeros(10**6)) for axis in "xyz"}), path)
    monkeypatch.setattr("jaximu.formats.table.UNPACKED", 1 << 20)
    monkeypatch.setattr("jaximu.formats.table.RATIO", 2)
    with pytest.raises(InputError, match="as no recording does"):
        read_recording(path, options=ReadOptions(check=False))
