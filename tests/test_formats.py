"""Reading and writing: every format, columns by name and by option, raw counts, two files, measured recordings."""

import hashlib
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from jaximu.ground.atomic import atomic_write
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import LocalGravity
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.recordings import write_recording
from jaximu.recordings.columns.names import canonical, parse_columns
from jaximu.recordings.columns.nominal import parse_offset, parse_scale
from jaximu.recordings.readers import ReadOptions, read_frame, read_recording
from jaximu.recordings.recording import Recording, Signal

SUFFIXES = [".csv", ".tsv", ".txt", ".parquet", ".npz", ".mat"]
AS_IS = ReadOptions(check=False)
NAMES = [*(f"accel_{axis} [m/s^2]" for axis in "xyz"), *(f"gyro_{axis} [rad/s]" for axis in "xyz")]


def samples(rows: int = 8, seed: int = 0) -> np.ndarray:
    """(rows, 6) still readings with noise, z up."""
    return np.random.default_rng(seed).normal([0.1, 0.2, 9.8, 0.0, 0.01, -0.01], 0.01, (rows, 6))


def save(path: Path, values: np.ndarray, header: str = "", delimiter: str = ",", fmt: str = "%.17g") -> Path:
    np.savetxt(path, values, fmt, delimiter, header=header, comments="")
    return path


def with_time(values: np.ndarray, step: float = 0.01) -> np.ndarray:
    return np.column_stack([np.arange(len(values)) * step, values])


# --- round trips

finite = st.floats(-1e6, 1e6, allow_subnormal=False).filter(lambda value: "999" not in f"{value:.10g}")
"""Numbers such as 999999 stand for a missing reading where several axes have them at once."""


@st.composite
def recordings(draw) -> Recording:
    """Recordings whose sensors may have stamps of their own, with any optional columns."""
    start = draw(st.sampled_from([0.0, 12.5, 1.7e9 + 0.25]))

    def signal(axes: int, unit: str, own: bool) -> Signal:
        rows = draw(st.integers(6, 12))
        steps = draw(hnp.arrays(np.int64, rows if own else 9, elements=st.integers(1, 1000)))
        values = draw(hnp.arrays(np.float64, (len(steps), axes), elements=finite))
        values[0], values[1] = 0.0, 1.0  # no axis is constant
        time = (np.cumsum(steps) - steps[0]) * 1e-3 if own else np.arange(9) * 1e-2
        return Signal(time.astype(np.float64), values, unit)

    own = draw(st.booleans())
    accelerometer = signal(3, "m/s^2", own)
    return Recording(
        accelerometer,
        signal(3, draw(st.sampled_from(["rad/s", "count"])), own) if draw(st.booleans()) else None,
        temperature=signal(1, "degC", own) if draw(st.booleans()) else None,
        magnetometer=signal(3, "uT", own) if draw(st.booleans()) else None,
        table_angle=signal(1, "rad", own) if draw(st.booleans()) else None,
        attitude=signal(4, "1", own) if draw(st.booleans()) else None,
        start=start,
    )


@pytest.mark.parametrize("suffix", SUFFIXES)
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(recording=recordings())
def test_what_is_written_is_read_back(tmp_path, suffix, recording):
    path = tmp_path / f"log{suffix}"
    write_recording(recording, path)
    raw = recording.gyroscope is not None and recording.gyroscope.unit == "count"
    back = read_recording(path, options=replace(AS_IS, gyro_scale="1" if raw else None))
    assert back.start == recording.start
    assert back.signals.keys() == recording.signals.keys()
    for name, signal in recording.signals.items():
        np.testing.assert_array_equal(back.signals[name].values, signal.values)
        np.testing.assert_allclose(back.signals[name].time, signal.time, rtol=0, atol=2e-9)
        assert back.signals[name].unit == signal.unit
    assert [each.name for each in tmp_path.iterdir()] == [path.name]


def test_the_source_is_told(tmp_path):
    path = save(tmp_path / "log.csv", with_time(samples()), ",".join(["time [s]", *NAMES]))
    (source,) = read_recording(path).sources
    assert (source.path, source.rows) == (str(path), 8)
    assert source.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


# --- text


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
@pytest.mark.parametrize("delimiter", [",", ";", "\t", " ", "   ", ", "])
def test_delimiters_preamble_and_comments(tmp_path, delimiter, ending):
    values = samples()
    lines = ["logger,7", "gain,2", "# made at rest", delimiter.join(NAMES)]
    for row in values:
        lines += [delimiter.join(f"{each:.17g}" for each in row), "# a remark"]
    path = tmp_path / "log.dat"
    path.write_bytes("".join(line + ending for line in lines).encode())
    recording = read_recording(path, options=ReadOptions(rate=50.0))
    assert recording.gyroscope is not None
    np.testing.assert_array_equal(np.hstack([recording.accelerometer.values, recording.gyroscope.values]), values)
    assert recording.accelerometer.rate == pytest.approx(50.0)
    assert recording.notes == ("no time column: stamps from --rate, 50 Hz.",)


def test_quoted_latin_and_marked_headers(tmp_path):
    header = ",".join(f'"{name}"' for name in NAMES).replace("m/s^2", "m/s²").replace("rad/s", "°/s")
    body = "\n".join(",".join(f"{each:.6g}" for each in row) for row in samples())
    for encoding in ("utf-8-sig", "latin-1"):
        path = tmp_path / "log.csv"
        path.write_text(f"{header}\n{body}\n", encoding=encoding)
        recording = read_recording(path, options=ReadOptions(rate=1.0))
        assert recording.gyroscope is not None
        assert np.degrees(recording.gyroscope.values[0, 2]) == pytest.approx(samples()[0, 5], rel=1e-5)


def test_a_commented_header_is_read(tmp_path):
    path = tmp_path / "log.txt"
    np.savetxt(path, with_time(samples()), header=" ".join(["time [ms]", *NAMES]))
    assert read_recording(path).accelerometer.rate == pytest.approx(1e5)


def test_types_that_change_late_in_a_long_file(tmp_path):
    """A column that looks whole, or empty, in the first block of the file."""
    rows = 40_000
    lines = [f"{at},0,{at % 7},10,{'' if at < rows - 5 else 21.5}" for at in range(rows)]
    lines[-2] = f"{rows - 2},0.5,0.25,9.75,21.5"
    path = tmp_path / "log.csv"
    path.write_text("time [ms],accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2],temp [degC]\n" + "\n".join(lines))
    recording = read_recording(path)
    assert recording.accelerometer.values[-2].tolist() == [0.5, 0.25, 9.75]
    assert recording.temperature is not None
    assert len(recording.temperature) == 5
    assert recording.notes == (f"temperature: {rows - 5} of {rows} rows hold no whole sample of it.",)


def test_dates_state_their_own_unit(tmp_path):
    path = tmp_path / "log.csv"
    rows = [f"2024-01-01T00:00:{at:02d}Z,0.{at},0.{at},9.{at}" for at in range(5)]
    path.write_text("timestamp," + ",".join(NAMES[:3]) + "\n" + "\n".join(rows))
    recording = read_recording(path)
    assert recording.accelerometer.rate == pytest.approx(1.0)
    assert recording.start == 1704067200.0


# --- other formats


def test_format_is_found_by_content(tmp_path):
    recording = Recording(Signal(np.arange(8) / 10, samples()[:, :3], "m/s^2"))
    for suffix in SUFFIXES:
        write_recording(recording, tmp_path / f"log{suffix}")
        (tmp_path / f"log{suffix}").rename(tmp_path / "log.bin")
        np.testing.assert_allclose(read_recording(tmp_path / "log.bin").accelerometer.values, samples()[:, :3])


def test_parquet_types(tmp_path):
    """Unsigned counters, single precision, nulls and time-stamp types."""
    stamps = pa.array(1_700_000_000_000_000_000 + np.arange(4) * 10_000_000, pa.timestamp("ns"))
    columns = {f"accel_{axis} [g]": pa.array([0.25, 0.5, None, 0.75], pa.float32()) for axis in "xyz"}
    gyro = {f"gyro_{axis} [count]": pa.array([1, 2, 3, 4], pa.uint16()) for axis in "xyz"}
    pq.write_table(pa.table({"time": stamps, **columns, **gyro}), tmp_path / "log.parquet")
    recording = read_recording(tmp_path / "log.parquet", options=replace(AS_IS, gyro_scale=100, gyro_offset=0))
    np.testing.assert_allclose(recording.accelerometer.time, [0.0, 0.01, 0.03], atol=1e-12)
    assert recording.accelerometer.values[0, 0] == 0.25 * STANDARD_GRAVITY
    assert recording.gyroscope is not None
    assert recording.gyroscope.si()[3, 0] == 0.04
    assert recording.start == 1.7e9


@pytest.mark.parametrize("rows", [3, 300])
def test_lists_of_three_are_vectors(tmp_path, rows):
    """As data frames export arrays; lists of texts are none."""
    values = np.arange(6.0 * rows).reshape(-1, 2, 3) % 17
    vectors = {"acc [g]": values[:, 0].tolist(), "gyr [rad/s]": values[:, 1].tolist(), "tags": [["a", "b", "c"]] * rows}
    table = pa.table({"time [s]": np.arange(rows) / 100, **vectors})
    pq.write_table(table, tmp_path / "log.parquet")
    for recording in (read_recording(tmp_path / "log.parquet", options=AS_IS), read_frame(table, AS_IS)):
        np.testing.assert_allclose(recording.accelerometer.values, values[:, 0] * STANDARD_GRAVITY)
        assert recording.gyroscope is not None
        np.testing.assert_allclose(recording.gyroscope.values, values[:, 1])


def test_npz_triads_and_rate(tmp_path):
    values = samples()
    np.savez(
        tmp_path / "log.npz",
        **{"acc [g]": values[:, :3] / 9.8, "gyr [dps]": values[:, 3:].T, "fs": 200.0, "name": "unit 7"},
    )
    recording = read_recording(tmp_path / "log.npz")
    assert recording.accelerometer.rate == pytest.approx(200.0)
    assert recording.gyroscope is not None
    np.testing.assert_allclose(recording.gyroscope.values, np.radians(values[:, 3:]))


def test_an_array_of_another_length_is_not_left_out_in_silence(tmp_path):
    values = samples()
    np.savez(tmp_path / "log.npz", **{"acc [g]": values[:, :3] / 9.8, "gyr [dps]": values[::2, 3:], "fs": 200.0})
    notes = read_recording(tmp_path / "log.npz").notes
    assert any(f"'gyr' has {len(values[::2])} rows where others have {len(values)}" in note for note in notes)


def test_mat_struct_and_units(tmp_path):
    values = samples()
    log = {"imu": {"acc": values[:, :3], "gyr": values[:, 3:]}, "t": np.arange(8.0)[None, :] * 10, "other": np.eye(3)}
    scipy.io.savemat(tmp_path / "log.mat", log)
    recording = read_recording(
        tmp_path / "log.mat", options=ReadOptions(columns="accel [m/s^2],gyro [rad/s],time [ms]")
    )
    np.testing.assert_array_equal(recording.accelerometer.values, values[:, :3])
    assert recording.accelerometer.rate == pytest.approx(100.0)


def test_hdf5_as_matlab_writes_it(tmp_path):
    """Version 7.3: arrays transposed, text as character codes, a group for a struct, 512 bytes before the HDF5."""
    values = samples()
    with h5py.File(tmp_path / "log.mat", "w", userblock_size=512) as file:
        file["acc"] = values[:, :3].T
        file["imu/gyr"] = values[:, 3:].T
        file["imu/gyr"].attrs["unit"] = "rad/s"
        file["fs"] = [[100.0]]
        for name, unit in {"acc": "m/s^2"}.items():
            text = file.create_dataset(f"units/{name}", data=np.array([[ord(sign)] for sign in unit], np.uint16))
            text.attrs["MATLAB_class"] = np.bytes_("char")
    with (tmp_path / "log.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(512))
    recording = read_recording(tmp_path / "log.mat")
    assert recording.gyroscope is not None
    np.testing.assert_array_equal(np.hstack([recording.accelerometer.values, recording.gyroscope.values]), values)


# --- columns


@pytest.mark.parametrize(
    ("name", "title"),
    [
        ("ax", "accel_x"),
        ("acc_x", "accel_x"),
        ("Acc X", "accel_x"),
        ("imu.acc.x", "accel_x"),
        ("imu0_acc_x", "accel_x"),
        ("accelerometer_z", "accel_z"),
        ("gx", "gyro_x"),
        ("imu_gyr_y", "gyro_y"),
        ("angular_velocity.x", "gyro_x"),
        ("mag_x", "mag_x"),
        ("timestamp", "time"),
        ("t", "time"),
        ("imu.temperature", "temperature"),
        ("attitude_w", "attitude_w"),
        ("linear_acceleration_x", None),
        ("status", None),
        ("quat_w", None),
        ("", None),
    ],
)
def test_aliases(name, title):
    assert canonical(name) == title


def test_columns_option():
    columns = parse_columns("time [us], _, accel [g],-,skip,gyro_x [dps]")
    assert [each.name for each in columns] == ["time", None, "accel_x", "accel_y", "accel_z", None, None, "gyro_x"]
    assert [each.unit for each in columns[:3]] == ["us", None, "g"]
    with pytest.raises(InputError, match="'acel_x' is not known"):
        parse_columns("time [s],acel_x [g]")


def test_columns_replace_the_header_and_others_are_noted(tmp_path):
    header = "n,ax,ay,az,state"
    path = save(tmp_path / "log.csv", np.column_stack([np.arange(8), samples()[:, :3] / 9.8, np.ones(8)]), header)
    recording = read_recording(path, options=ReadOptions(columns="_,accel [g],_", rate=10.0))
    np.testing.assert_allclose(recording.accelerometer.values, samples()[:, :3] / 9.8 * STANDARD_GRAVITY)
    path.write_text(path.read_text().replace(header, "n,ax [g],ay [g],az [g],state"))
    assert "columns not used: 'n', 'state'." in read_recording(path, options=ReadOptions(rate=10.0)).notes


def test_nanosecond_stamps_keep_their_resolution(tmp_path):
    stamps = 1_700_000_000_123_456_789 + np.arange(8, dtype=np.int64) * 1001
    rows = [f"{stamp},{x},{y},{z}" for stamp, (x, y, z) in zip(stamps, samples()[:, :3], strict=True)]
    path = tmp_path / "log.csv"
    path.write_text("time [ns],ax [m/s^2],ay [m/s^2],az [m/s^2]\n" + "\n".join(rows))
    np.testing.assert_allclose(read_recording(path).accelerometer.time, np.arange(8) * 1001e-9, rtol=1e-12)


def test_sensors_with_rows_of_their_own(tmp_path):
    """A phone's log: each row holds a sample of one sensor; missing values written as nothing or as NaN."""
    path = tmp_path / "log.csv"
    rows = [
        f"{at},0.{at},0.1{at},9.8{at},,," if at % 2 else f"{at},NaN,,nan,0.{at},0.1{at},0.2{at}" for at in range(10)
    ]
    path.write_text(",".join(["time [ms]", *NAMES]) + "\n" + "\n".join(rows) + "\n")
    recording = read_recording(path)
    assert recording.gyroscope is not None
    np.testing.assert_allclose(recording.accelerometer.time, np.arange(1, 10, 2) * 1e-3)
    np.testing.assert_allclose(recording.gyroscope.time, np.arange(0, 10, 2) * 1e-3)
    assert any("separate time stamps" in note for note in recording.notes)


def test_axes_are_applied_at_reading(tmp_path):
    path = save(tmp_path / "log.csv", with_time(samples() * [1, 1, -1, 1, 1, 1]), ",".join(["time [s]", *NAMES]))
    recording = read_recording(path, options=ReadOptions(axes="FRD"))
    np.testing.assert_allclose(recording.accelerometer.values, samples()[:, :3] * [1, -1, 1])


# --- raw counts


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("16384 count/g", 16384 / 9.80665),
        ("16384 LSB/g", 16384 / 9.80665),
        ("0.061 mg/count", 1 / (0.061e-3 * 9.80665)),
        ("415", 415.0),
        (415, 415.0),
        ("0.0025", 400.0),
        ("1/415", 415.0),
        ("415 count/(m/s^2)", 415.0),
        ("1 mg/LSB", 1e3 / 9.80665),
    ],
)
def test_scales_of_an_accelerometer(text, expected):
    np.testing.assert_allclose(parse_scale(text, "acceleration", "--accel-scale"), [expected])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1/6258", [6258.0]),
        ("6258 count/(rad/s)", [6258.0]),
        ("131 count/(deg/s)", [131 * 180 / np.pi]),
        ("131 count/deg/s", [131 * 180 / np.pi]),
        ("8.75 mdps/count", [180e3 / 8.75 / np.pi]),
        ("4778,4758, 4766", [4778.0, 4758.0, 4766.0]),
        ([4778, 4758, 4766], [4778.0, 4758.0, 4766.0]),
    ],
)
def test_scales_of_a_gyroscope(text, expected):
    np.testing.assert_allclose(parse_scale(text, "angular rate", "--gyro-scale"), expected)


@pytest.mark.parametrize(
    "text", ["", "abc", "1,2", "0", "1/0", "16384 count/deg", "5 furlong", "5 count/parsec", "1//2"]
)
def test_bad_scales(text):
    with pytest.raises(InputError, match="accel_scale"):
        parse_scale(text, "acceleration", "--accel-scale")


def test_offsets():
    np.testing.assert_array_equal(parse_offset("-32768", "--accel-offset"), [-32768.0])
    np.testing.assert_array_equal(parse_offset("1,0,3", "--accel-offset"), [1.0, 0.0, 3.0])
    with pytest.raises(InputError, match="accel_offset"):
        parse_offset("3 g", "--accel-offset")


def raw_poses(directions: np.ndarray, scale: float = 415.0, noise: float = 2.0) -> np.ndarray:
    """(rows, 3) whole counts at 100 Hz: still poses of 3 s around offset 32768 ± 300, a shaken second between them."""
    generator = np.random.default_rng(3)
    still = np.repeat(directions / np.linalg.norm(directions, axis=1)[:, None], 400, axis=0) * 9.80665
    shaken = np.tile(np.arange(400) >= 300, len(directions))
    still[shaken] += generator.normal(0.0, 2.0, (shaken.sum(), 3))
    offset = np.array([33068.0, 32768.0, 32468.0])
    return np.round(still * scale + offset + generator.normal(0.0, noise, still.shape))


AROUND = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [1, 1, 1], [-1, 1, -1.0]])


def test_accelerometer_scale_is_found_from_gravity(tmp_path):
    path = save(tmp_path / "log.csv", raw_poses(AROUND), "ax [count],ay [count],az [count]", fmt="%d")
    recording = read_recording(path, options=ReadOptions(rate=100.0))
    np.testing.assert_allclose(recording.accelerometer.nominal_scale, 415.0, rtol=1e-3)
    np.testing.assert_allclose(recording.accelerometer.nominal_offset, [33068, 32768, 32468], atol=2.0)
    assert any(note.startswith("accelerometer scale found from gravity: 41") for note in recording.notes)
    heavy = read_recording(path, options=ReadOptions(rate=100.0, gravity=LocalGravity(9.83)))
    assert heavy.accelerometer.nominal_scale[0] == pytest.approx(
        recording.accelerometer.nominal_scale[0] * 9.80665 / 9.83
    )


@pytest.mark.parametrize(
    "directions", [AROUND[4:5], AROUND[:4], np.array([[0.1, 0, 1], [0, 0.1, 1], [-0.1, 0, 1], [0, -0.1, 1], [0, 0, 1]])]
)
def test_directions_that_do_not_tell_the_offset(tmp_path, directions):
    path = save(tmp_path / "log.csv", raw_poses(directions), "ax [count],ay [count],az [count]", fmt="%d")
    with pytest.raises(NotPossibleError, match=r"log\.csv.*accel_scale.* and .*accel_offset.*more poses"):
        read_recording(path, options=ReadOptions(rate=100.0))
    recording = read_recording(path, options=ReadOptions(rate=100.0, accel_offset="33068,32768,32468"))
    np.testing.assert_allclose(recording.accelerometer.nominal_scale, 415.0, rtol=2e-3)


def test_gyroscope_offset_is_that_of_the_quietest_second(tmp_path):
    generator = np.random.default_rng(5)
    gyro = np.round(generator.normal(0.0, np.repeat([200.0, 2.0, 100.0], 200)[:, None], (600, 3)) + [50, -70, 10])
    force = np.tile(samples(), (75, 1))[:, :3] + generator.normal(0.0, 0.1, (600, 3))
    values = np.column_stack([force, gyro])
    header = ",".join([*NAMES[:3], "gx [count]", "gy [count]", "gz [count]"])
    recording = read_recording(
        save(tmp_path / "log.csv", values, header), options=ReadOptions(rate=100.0, gyro_scale="131 count/dps")
    )
    assert recording.gyroscope is not None
    np.testing.assert_allclose(recording.gyroscope.nominal_offset, [50, -70, 10], atol=1.0)


# --- two files


def two_files(folder: Path, accel_header: str = "", gyro_header: str = "", later: float = 0.5) -> tuple[Path, Path]:
    values = with_time(samples(200))
    gyro = values[:, [0, 4, 5, 6]] * [2, 1, 1, 1] + [later, 0, 0, 0]
    return save(folder / "a.csv", values[:, :4], accel_header), save(folder / "g.csv", gyro, gyro_header)


@pytest.mark.parametrize(
    ("columns", "gyro_columns"),
    [
        ("time [s],accel [m/s^2],gyro [rad/s]", None),
        ("time [s],accel [m/s^2]", "time [s],gyro [rad/s]"),
    ],
)
def test_two_files_without_names(tmp_path, columns, gyro_columns):
    accel, gyro = two_files(tmp_path)
    recording = read_recording(accel, gyro, ReadOptions(columns=columns, gyro_columns=gyro_columns))
    assert recording.gyroscope is not None
    assert recording.gyroscope.time[0] == pytest.approx(0.5)
    assert recording.gyroscope.rate == pytest.approx(50.0)
    assert recording.accelerometer.rate == pytest.approx(100.0)
    assert [source.path for source in recording.sources] == [str(accel), str(gyro)]
    assert any("separate time stamps" in note for note in recording.notes)


def test_two_files_with_names(tmp_path):
    accel, gyro = two_files(
        tmp_path, "t [s],ax [m/s^2],ay [m/s^2],az [m/s^2]", "t [s],gx [rad/s],gy [rad/s],gz [rad/s]", -0.25
    )
    recording = read_recording(accel, gyro)
    assert recording.accelerometer.time[0] == pytest.approx(0.25)
    assert recording.start == -0.25


def test_one_list_of_counts_serves_both_files(tmp_path):
    counts = np.round(with_time(samples(200)) * [100, 100, 100, 100, 1e5, 1e5, 1e5])
    accel, gyro = (
        save(tmp_path / "a.txt", counts[:, :4], delimiter=" "),
        save(tmp_path / "g.txt", counts[:, [0, 4, 5, 6]]),
    )
    options = ReadOptions(columns="time [ms],accel [count]", accel_scale=100, gyro_scale="1e5")
    recording = read_recording(accel, gyro, options)
    assert recording.gyroscope is not None
    np.testing.assert_allclose(recording.gyroscope.nominal_scale, 1e5)
    assert not any("separate time stamps" in note for note in recording.notes)


# --- writing


def test_atomic_write_is_all_or_nothing(tmp_path):
    target = tmp_path / "out.json"
    target.write_text("old")
    with pytest.raises(RuntimeError), atomic_write(target) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert target.read_text() == "old"
    with atomic_write(target) as temporary:
        assert temporary.suffix == ".json"
        temporary.write_text("new")
    assert target.read_text() == "new"
    assert [each.name for each in tmp_path.iterdir()] == ["out.json"]


# --- measured recordings


@pytest.mark.parametrize("offset", [None, "32768"])
def test_xsens_scale_from_gravity(data_folder, offset):
    folder = data_folder / "imu_tk_xsens"
    options = ReadOptions(
        columns="time [s],accel [count]", gyro_scale="1/6258", accel_offset=offset, gravity=LocalGravity(9.81744, 0.0)
    )
    recording = read_recording(folder / "xsens_acc.mat", folder / "xsens_gyro.mat", options, require_gyroscope=True)
    np.testing.assert_allclose(recording.accelerometer.nominal_scale, 413.7, rtol=5e-3)
    assert len(recording.accelerometer) == 51175
    assert recording.accelerometer.rate == pytest.approx(100.0, rel=1e-3)


def test_tomisuarez_scale_from_gravity(data_folder):
    path = data_folder / "tomisuarez_mpu6050" / "example_data_calibration.csv"
    options = ReadOptions(columns="accel [count],gyro [count]", rate=100, gyro_scale="131 count/(deg/s)")
    recording = read_recording(path, options=options)
    np.testing.assert_allclose(recording.accelerometer.nominal_scale, 16384 / 9.80665, rtol=0.02)
    assert len(recording.accelerometer) == 10245


@pytest.mark.parametrize("unit", [0, 1, 2])
def test_mikoff(data_folder, unit):
    path = data_folder / "mikoff_mpu9150" / f"imu{unit}.log"
    recording = read_recording(path, options=ReadOptions(columns="accel [m/s^2],gyro [rad/s]", rate=100))
    assert recording.sources[0].rows == len(recording.accelerometer) > 15_000
    assert recording.notes == ("no time column: stamps from --rate, 100 Hz.",)
    with pytest.raises(InputError, match="stated as deg/s"):
        read_recording(path, options=ReadOptions(columns="accel [m/s^2],gyro [deg/s]", rate=100))


def test_other_measured_files(data_folder):
    folder = data_folder
    cooling = read_recording(
        folder / "tofupilot_cooling" / "cooling_leg.tsv",
        options=ReadOptions(columns="time [us],gyro [rad/s],accel [m/s^2],_,temperature [degC]"),
    )
    assert cooling.temperature is not None
    assert (cooling.temperature.values.min(), cooling.temperature.values.max()) == pytest.approx((-17.6, 52.1), abs=0.1)
    optical = read_recording(
        folder / "broad" / "02_undisturbed_slow_rotation_B.mat",
        options=ReadOptions(columns="gyro [rad/s],accel [m/s^2],mag [uT],attitude,_,_,_,_"),
    )
    assert optical.accelerometer.rate == pytest.approx(285.714, rel=1e-5)
    ferraris = read_recording(
        folder / "imucal" / "example_ferraris_session.csv",
        options=ReadOptions(columns="_,gyro [deg/s],accel [m/s^2]", rate=102.4),
    )
    assert ferraris.gyroscope is not None
    static = read_recording(folder / "adis16405_static" / "run1.parquet")
    assert len(static.accelerometer) == 1_000_000
    assert static.notes == ()
