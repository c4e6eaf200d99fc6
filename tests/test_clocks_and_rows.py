"""What a log's stamps and rows say: counters that pass their end, units that write in turn, single bad values."""

import re
import tracemalloc

import numpy as np
import pytest

from jaximu.calibration import calibrate
from jaximu.cli import main
from jaximu.ground.errors import InputError
from jaximu.mistakes import inspect
from jaximu.mistakes.timing import steady_clock
from jaximu.noise.analysis import evenly_sampled
from jaximu.recordings.readers import ReadOptions, advise_reading, read_recording
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.segmentation import segment
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld

NAMES = [f"{sensor}_{axis} [{unit}]" for sensor, unit in (("accel", "m/s^2"), ("gyro", "rad/s")) for axis in "xyz"]
AS_IS = ReadOptions(check=False)


@pytest.fixture(scope="module")
def recording():
    return simulate(draw_imu(6), HandHeld(12, 1.5), consumer_noise(), rate=100.0, seed=6)[0]


def values_of(recording) -> np.ndarray:
    return np.hstack([recording.accelerometer.values, recording.gyroscope.values])


def write(path, time, values, name="time [s]", extra=None):
    columns = {name: time} | (extra or {}) | dict(zip(NAMES, values.T, strict=True))
    cells = [map(str, np.asarray(column).tolist()) for column in columns.values()]
    rows = [",".join(row) for row in zip(*cells, strict=True)]
    path.write_text("\n".join([",".join(columns), *rows]) + "\n")
    return path


CLOCKS = {
    "milliseconds in 16 bits": ("ms", 2**16, 1e3, 65_000),
    "microseconds in 32 bits": ("time [us]", 2**32, 1e6, 2**32 - 5_000_000),
    "microseconds in 16 bits": ("time [us]", 2**16, 1e6, 0),
    "microseconds in 24 bits": ("time [us]", 2**24, 1e6, 0),
    "a time of day past midnight": ("time [s]", 86400.0, 1.0, 86395.0),
    "a week of GPS that ends": ("time [s]", 604800.0, 1.0, 604790.0),
}


@pytest.mark.parametrize("kind", CLOCKS)
def test_a_clock_that_begins_anew_goes_on(recording, tmp_path, kind):
    name, full, per_second, start = CLOCKS[kind]
    time = recording.accelerometer.time
    stamps = np.round((start + time * per_second) % full, 6)
    stamps = stamps.astype(np.int64) if per_second > 1 else stamps
    found = read_recording(write(tmp_path / "log.csv", stamps, values_of(recording), name))
    np.testing.assert_allclose(
        found.accelerometer.time, time - time[0], atol=1.1 / per_second if per_second > 1 else 1e-5
    )
    assert any("its time goes on from there" in note for note in found.notes)
    assert not {"data.order", "data.gap"} & {finding.name for finding in inspect(found)}


@pytest.mark.parametrize("name", ["time [s]", "time [us]"])
def test_a_clock_that_was_set_forward_by_years_goes_on(recording, tmp_path, name):
    """A clock that nobody set begins in 1970, until a receiver of GPS or the network sets it."""
    time = recording.accelerometer.time
    per_second = 1e6 if "us" in name else 1.0
    stamps = (time + np.where(np.arange(len(time)) > 1234, 1.7e9, 0.0)) * per_second
    stamps = stamps.round().astype(np.int64) if per_second > 1 else stamps
    one = read_recording(write(tmp_path / "log.csv", stamps, values_of(recording), name))
    np.testing.assert_allclose(one.accelerometer.time, time - time[0], atol=2e-6)
    assert any("set forward by 1.7e+09 s in 1 place (row 1237)" in note for note in one.notes)


def test_a_pause_of_weeks_costs_no_memory(recording, tmp_path):
    """A scan by parts of a second would hold a hundred million windows, and an even grid as many samples."""
    time = recording.accelerometer.time
    middle = len(time) // 2
    stamps = np.where(np.arange(len(time)) > middle, time + 5e6, time)
    path = write(tmp_path / "log.csv", stamps, values_of(recording))
    tracemalloc.start()
    assert main(["info", str(path)]) == 0
    assert len(segment(read_recording(path)).intervals) >= 12
    even = evenly_sampled(read_recording(path).gyroscope)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2e8 and even.paused and even.values.shape[1] == middle + 1 and even.start == 0


def test_a_clock_that_was_set_back_does_not_go_on(recording, tmp_path):
    """No counter ends after 31.4 s: rows from there on are of another recording, or out of order."""
    time = recording.accelerometer.time.copy()
    time[3000:] -= 31.4
    with pytest.raises(InputError, match="two recordings in one file"):
        read_recording(write(tmp_path / "log.csv", time, values_of(recording)))


def clock_times(seconds, day="", digits=2):
    """Texts of seconds of a day."""
    whole = np.round(np.asarray(seconds) % 86400 * 10**digits).astype(np.int64)
    parts = [whole // 10**digits // each % (60 if each < 3600 else 24) for each in (3600, 60, 1)]
    return [f"{day}{h:02d}:{m:02d}:{s:02d}.{rest:0{digits}d}" for h, m, s, rest in zip(*parts, whole % 10**digits,
                                                                                    strict=True)]  # fmt: skip


SET_BACK = {
    "summer time ends": (3600, 2.999),
    "by half an hour": (1800, 1.999),
    "twelve hours": (43200, 12.999),
    "a zone is set": (5.5 * 3600, 12.3),
}


@pytest.mark.parametrize("kind", SET_BACK)
@pytest.mark.parametrize("day", ["2024-10-27 ", "27.10.2024 ", ""])
def test_a_time_of_day_that_is_set_back_goes_on(recording, tmp_path, kind, day):
    back, start = SET_BACK[kind]
    time = recording.accelerometer.time
    stamps = np.where(time > 20.0, -back, 0.0) + time + start * 3600
    found = read_recording(write(tmp_path / "log.csv", clock_times(stamps, day), values_of(recording), "time"))
    np.testing.assert_allclose(found.gyroscope.time, time - time[0], atol=1e-6)
    assert any(f"is set back by {back:.10g} s in 1 place" in note for note in found.notes)
    assert not {"data.order", "data.gap", "data.time_scale"} & {finding.name for finding in inspect(found)}


def test_a_time_of_day_that_is_set_back_by_anything_else_does_not_go_on(recording, tmp_path):
    time = recording.accelerometer.time
    stamps = np.where(time > 30.0, -31.4, 0.0) + time + 40000
    with pytest.raises(InputError, match="two recordings in one file"):
        read_recording(write(tmp_path / "log.csv", clock_times(stamps), values_of(recording), "time"))


@pytest.mark.parametrize("start", [12.999, 23.998, 9.51])
@pytest.mark.parametrize("name", ["utc_time", "time", "time [s]"])
def test_hours_minutes_and_seconds_as_one_number(recording, tmp_path, start, name):
    """As NMEA has them: 125959.98 is followed by 130000.00, and 235959.99 by 000000.00."""
    time = recording.accelerometer.time
    stamps = [text.replace(":", "") for text in clock_times(time + start * 3600)]
    path = write(tmp_path / "log.csv", stamps, values_of(recording), name)
    for stated in (None, "time [s],accel [m/s^2],gyro [rad/s]"):
        found = read_recording(path, options=ReadOptions(columns=stated))
        np.testing.assert_allclose(found.gyroscope.time, time - time[0], atol=1e-6)
        assert any("are hours, minutes and seconds" in note for note in found.notes)


def test_hours_minutes_and_seconds_with_what_is_left_of_them(recording, tmp_path):
    time = recording.accelerometer.time
    stamps, rest = zip(*(text.replace(":", "").split(".") for text in clock_times(time + 46780, digits=3)), strict=True)
    path = write(tmp_path / "log.csv", stamps, values_of(recording), "UTC", {"ms": rest})
    np.testing.assert_allclose(read_recording(path).gyroscope.time, time - time[0], atol=1e-6)


def test_seconds_are_no_time_of_day(recording, tmp_path):
    time = recording.accelerometer.time
    for begun_at in (0.0, 30.0, 1200.0, 99990.0):
        found = read_recording(write(tmp_path / "log.csv", time + begun_at, values_of(recording)))
        np.testing.assert_allclose(found.gyroscope.time, time - time[0], atol=1e-6)


def test_a_pause_is_no_wrong_unit(recording, tmp_path):
    time = recording.accelerometer.time.copy()
    time[len(time) // 2 :] += 1e5
    names = {
        finding.name for finding in inspect(read_recording(write(tmp_path / "log.csv", time, values_of(recording))))
    }
    assert "data.gap" in names and "data.time_scale" not in names


def places(count, off, seed=1):
    """Rows each of which lies up to so many places from its own."""
    return np.argsort(np.arange(count) + np.random.default_rng(seed).uniform(0, off + 1, count))


@pytest.mark.parametrize("off", [1, 3, 6, 30])
@pytest.mark.parametrize("name", ["time [s]", "time"])
def test_rows_that_lie_in_no_order_are_sorted(recording, tmp_path, off, name):
    """Packets that overtake each other, some of them lost: the sorted stamps are those of one clock."""
    time, values = recording.accelerometer.time, values_of(recording)
    kept = np.sort(np.random.default_rng(2).permutation(len(time))[: int(0.97 * len(time))])
    order = places(len(kept), off)
    path = write(tmp_path / "log.csv", time[kept][order], values[kept][order], name)
    advice = advise_reading(path)
    assert advice.columns in (None, "time [s],accel [m/s^2],gyro [rad/s]") and advice.rate is None
    found = read_recording(path, options=ReadOptions(columns=advice.columns, check=False))
    np.testing.assert_allclose(found.accelerometer.time, time[kept] - time[kept[0]], atol=1e-9)
    np.testing.assert_allclose(values_of(found), values[kept], atol=1e-9)
    assert any("The rows are out of order" in note for note in found.notes)


def test_two_recordings_are_no_rows_in_no_order(recording, tmp_path):
    """Half a sample apart their sorted stamps are even, and the rows of each are in order."""
    time, values = recording.accelerometer.time, values_of(recording)
    both = np.concatenate([time, time + 0.005])
    with pytest.raises(InputError, match="two recordings in one file"):
        read_recording(write(tmp_path / "log.csv", both, np.vstack([values, values])))


def own_clock(recording):
    """The accelerometer's stamps and values at full rate, and the gyroscope's of every other sample, 3 ms later."""
    accel, gyro = recording.accelerometer, recording.gyroscope
    return accel.time, accel.values, gyro.time[::2] + 0.003, gyro.values[::2]


def side_by_side(path, names, arrays):
    """A table of arrays of different lengths, with empty cells where one has no more."""
    columns = [column for array in arrays for column in np.atleast_2d(array.T)]
    rows = max(map(len, columns))
    cells = [[*map(str, column), *[""] * (rows - len(column))] for column in columns]
    path.write_text("\n".join(",".join(row) for row in [names, *zip(*cells, strict=True)]) + "\n")
    return path


TWO_CLOCKS = {
    "named after the sensors": ("accTimestamp [s]", "gyroTimestamp [s]", ""),
    "before each sensor's columns": ("time [s]", "time [s]", ""),
    "counted": ("t1", "t2", "time [s],accel [m/s^2],gyro_time [s],gyro [rad/s]"),
}


@pytest.mark.parametrize("kind", TWO_CLOCKS)
def test_a_gyroscope_with_a_clock_of_its_own_in_one_table(recording, tmp_path, kind):
    first, second, stated = TWO_CLOCKS[kind]
    arrays = own_clock(recording)
    names = [first, *NAMES[:3], second, *NAMES[3:]] if not stated else [first, *"abc", second, *"def"]
    path = side_by_side(tmp_path / "log.csv", names, arrays)
    found = read_recording(path, options=ReadOptions(columns=stated or None, check=False))
    for signal, time, values in ((found.accelerometer, *arrays[:2]), (found.gyroscope, *arrays[2:])):
        np.testing.assert_allclose(signal.time, time, atol=1e-9)
        np.testing.assert_allclose(signal.values, values)
    assert any("separate time stamps" in note for note in found.notes)


def test_a_guess_names_the_clock_of_the_gyroscope(recording, tmp_path):
    path = side_by_side(tmp_path / "log.csv", [*"t ax ay az gyr_t gx gy gz".split()], own_clock(recording))
    advice = advise_reading(path)
    assert advice.columns == "time [s],accel [m/s^2],gyro_time [s],gyro [rad/s]"


@pytest.mark.parametrize("more", [1, 3])
def test_arrays_of_sensors_with_clocks_of_their_own(recording, tmp_path, more):
    """Of the sensor that has fewer samples, and of the one that has more; `more`: of the gyroscope's to each."""
    time, force, late, rate = own_clock(recording)
    late, rate = np.repeat(late, more) + 0.001 * np.tile(np.arange(more), len(late)), np.repeat(rate, more, axis=0)
    arrays = {"t_acc [s]": time, "acc [m/s^2]": force, "t_gyro [s]": late, "gyro [rad/s]": rate}
    np.savez(tmp_path / "log.npz", **arrays)
    found = read_recording(tmp_path / "log.npz", options=AS_IS)
    np.testing.assert_allclose(found.gyroscope.time, late)
    np.testing.assert_allclose(found.gyroscope.values, rate)
    np.testing.assert_allclose(found.accelerometer.time, time)
    arrays["t_gyro [s]"] = late + 1e6  # of another clock
    np.savez(tmp_path / "log.npz", **arrays)
    found = read_recording(tmp_path / "log.npz", options=AS_IS)
    assert found.gyroscope is None
    assert any("not used: 'gyro' has" in note for note in found.notes)


@pytest.mark.parametrize("name", ["PacketCounter", "seq", "frame_index"])
@pytest.mark.parametrize("bits", [8, 16, 40])
def test_a_counter_shows_what_is_missing_where_no_column_is_the_time(recording, tmp_path, name, bits):
    count = len(recording.accelerometer)
    kept = np.delete(np.arange(count), np.r_[1000:1003, 2500, 3000:3040])
    numbers = (kept + 200) % 2**bits
    path = write(tmp_path / "log.csv", numbers, values_of(recording)[kept], name)
    found = read_recording(path, options=ReadOptions(rate=100.0, check=False))
    np.testing.assert_allclose(found.gyroscope.time, kept / 100.0)
    assert any("by which 44 rows are missing" in note for note in found.notes)
    assert not any("not used" in note for note in found.notes)
    whole = read_recording(  # one that leaves nothing out says nothing
        write(tmp_path / "log.csv", np.arange(count), values_of(recording), name), options=ReadOptions(rate=100.0)
    )
    assert not any("are missing" in note for note in whole.notes)
    sections = np.roll(np.arange(count), count // 3)  # put together in another order
    path = write(tmp_path / "log.csv", sections, values_of(recording), name)
    found = read_recording(path, options=ReadOptions(rate=100.0, check=False))
    np.testing.assert_allclose(found.gyroscope.time, np.arange(count) / 100.0)


def test_stamps_of_another_clock_are_not_those_of_the_samples_beside_them(recording, tmp_path):
    accel, gyro = recording.accelerometer, recording.gyroscope
    names = ["time [s]", *NAMES[:3], "gyroTimestamp [s]", *NAMES[3:]]
    arrays = [accel.time, accel.values, accel.time + 1e6, gyro.values]
    found = read_recording(side_by_side(tmp_path / "log.csv", names, arrays), options=AS_IS)
    np.testing.assert_allclose(found.gyroscope.time, accel.time, atol=1e-9)


@pytest.mark.parametrize("name", ["I", "instance", "imu_id", "index"])
def test_a_column_that_counts_units(recording, tmp_path, capsys, name):
    """As an autopilot has it; the lines that info proposes choose the unit, and a counter of rows is no unit's."""
    time, values = recording.accelerometer.time, values_of(recording)
    both = np.stack([values, values * 1.02 + 0.01], axis=1).reshape(-1, 6)
    path = write(tmp_path / "log.csv", np.repeat(time, 2), both, extra={name: np.tile([3, 4], len(time))})
    assert main(["info", str(path)]) != 0
    assert f"by column '{name}': choose one of them, 3, 4" in capsys.readouterr().err
    names = ",".join(column.partition(" ")[0] for column in path.read_text().splitlines()[0].split(","))
    path.write_text("\n".join([names, *path.read_text().splitlines()[1:]]) + "\n")
    assert main(["info", str(path), "--device", "4"]) == 0
    proposed = [line for line in capsys.readouterr().out.splitlines() if "jaximu calibrate" in line]
    assert proposed and all("--device 4" in line for line in proposed)
    counted = write(tmp_path / "counted.csv", time, values, extra={"index": np.arange(len(time)) % 10})
    assert len(read_recording(counted).accelerometer) == len(time)


@pytest.mark.parametrize("ids", [("0", "1"), ("left", "right")])
@pytest.mark.parametrize("late", [0.0, 0.001, 0.005])
def test_units_that_write_in_turn_are_not_mixed(recording, tmp_path, ids, late):
    time = recording.accelerometer.time
    values, other = values_of(recording), values_of(recording) * 1.02 + 0.01
    both = np.stack([values, other], axis=1).reshape(-1, 6)
    stamps = np.stack([time, time + late], axis=1).ravel()
    path = write(tmp_path / "log.csv", stamps, both, extra={"id": np.tile(ids, len(time))})
    with pytest.raises(InputError, match=f"of 2 units.* choose one of them, {ids[0]}, {ids[1]}"):
        read_recording(path)
    for device, its in zip(ids, (values, other), strict=True):
        found = read_recording(path, options=ReadOptions(device=device, check=False))
        np.testing.assert_allclose(values_of(found), its)
        assert found.gyroscope.rate == pytest.approx(100.0, rel=1e-3)
    with pytest.raises(InputError, match="column 'id' holds"):
        read_recording(path, options=ReadOptions(device="7"))


def test_a_column_that_says_something_else_makes_no_units(recording, tmp_path, capsys):
    """A counter, a label for parts of the recording, one unit's number in every row."""
    time, values = recording.accelerometer.time, values_of(recording)
    count = len(time)
    for extra in ({"id": np.arange(count)}, {"device": np.full(count, 7)}, {"source": np.arange(count) // (count // 3)},
                  {"flag": np.arange(count) % 2}):  # fmt: skip
        path = write(tmp_path / "log.csv", time, values, extra=extra)
        assert len(read_recording(path).accelerometer) == count
    assert main(["calibrate", str(path), "--device", "1"]) == 2
    assert "no column says which of several units" in capsys.readouterr().err


def test_rows_of_several_sensors_are_no_units(recording, tmp_path):
    """Rows that say which sensor they are of, whose columns no header names, ask for the columns and not for a unit."""
    force, rate = recording.accelerometer, recording.gyroscope
    rows = [f"{t:.3f},{name},{','.join(f'{x:.5f}' for x in value)}"
            for t, a, g in zip(force.time, force.values, rate.values, strict=True)
            for name, value in (("one", a), ("two", g))]  # fmt: skip
    (tmp_path / "log.csv").write_text("\n".join(["time [s],sensor,v0,v1,v2", *rows]))
    with pytest.raises(InputError) as refused:
        read_recording(tmp_path / "log.csv")
    assert "write in turn" not in str(refused.value)


@pytest.mark.parametrize("bad", ["inf", "-Infinity", "1e300", "nan", ""])
def test_a_bad_value_costs_its_row(recording, tmp_path, bad):
    path = write(tmp_path / "log.csv", recording.accelerometer.time, values_of(recording))
    lines = path.read_text().splitlines()
    cells = lines[2000].split(",")
    cells[5] = bad
    path.write_text("\n".join([*lines[:2000], ",".join(cells), *lines[2001:]]) + "\n")
    found = read_recording(path)
    assert len(found.gyroscope) == len(recording.gyroscope) - 1
    assert len(found.accelerometer) == len(recording.accelerometer)
    assert any(re.search("gyroscope: 1 of .* rows hold no whole sample", note) for note in found.notes)
    whole, less = calibrate(recording), calibrate(found)
    off = (np.asarray(less.imu.gyroscope.gain) - np.asarray(whole.imu.gyroscope.gain)) / less.sigma("gyroscope")[0]
    assert np.abs(off).max() < 0.5


def test_many_bad_values_are_refused_with_the_row(recording, tmp_path):
    values = values_of(recording)
    values[100:300, 4] = np.inf
    with pytest.raises(InputError, match=r"row 102: column 'gyro_y .* is infinite"):
        read_recording(write(tmp_path / "log.csv", recording.accelerometer.time, values))


@pytest.mark.parametrize(("mark", "long"), [(-9999, 1), (9999.99, 30), (-999, 3)])
def test_a_number_that_stands_for_a_missing_reading_is_none(recording, tmp_path, mark, long):
    """Whether a row is missing at a time or many; a knock that ends at the range is a reading."""
    time, values = recording.accelerometer.time, values_of(recording)
    rows = (np.arange(100, len(time) - 100, 150)[:, None] + np.arange(long)).ravel()
    values[rows] = mark
    found = read_recording(write(tmp_path / "log.csv", time, values))
    assert len(found.accelerometer) == len(found.gyroscope) == len(time) - len(rows)
    assert any(f"{len(rows)} rows hold {mark:.6g} in 6 columns" in note for note in found.notes)
    values = values_of(recording)
    values[rows, :3] = np.clip(40 * values[rows, :3], -156.9, 156.9)
    found = read_recording(write(tmp_path / "log.csv", time, values))
    assert len(found.accelerometer) == len(time) and not any("missing reading" in note for note in found.notes)


@pytest.mark.parametrize("tick", [0.005125, 0.007, 0.001])
def test_a_rate_is_samples_over_time(recording, tmp_path, tick):
    """A logger that polls writes the stamps of its own loop, whose usual interval is not the sensor's."""
    time = np.ceil(recording.accelerometer.time / tick) * tick
    found = read_recording(write(tmp_path / "log.csv", time, values_of(recording)))
    assert found.gyroscope.rate == pytest.approx(100.0, rel=2e-3)
    gone = np.delete(np.arange(len(time)), np.arange(500, 3000, 50))
    found = read_recording(write(tmp_path / "log.csv", time[gone], values_of(recording)[gone]))
    assert found.gyroscope.rate == pytest.approx(100.0, rel=4e-3)


def test_stamps_that_repeat_are_a_steady_clocks(recording, tmp_path):
    time = recording.accelerometer.time.copy()
    time[3:-2:4] = time[2:-3:4]
    found = read_recording(write(tmp_path / "log.csv", time, values_of(recording)))
    np.testing.assert_allclose(found.gyroscope.time, recording.gyroscope.time, atol=2e-3)
    assert any("stamps repeat the one before" in note for note in found.notes)


@pytest.mark.parametrize(
    ("seconds", "rest", "per_second"),
    [
        ("sec", "ms", 1000),
        ("Unix Time", "Microseconds", 10**6),
        ("tv_sec", "tv_usec", 10**6),
        ("stamp.secs", "stamp.nsecs", 10**9),
        ("Time [s]", "fraction [us]", 10**6),
        ("Time", "ms", 1000),
    ],
)
@pytest.mark.parametrize("stated", [False, True])
def test_seconds_and_what_is_left_of_them_are_one_time(recording, tmp_path, seconds, rest, per_second, stated):
    """By their names, or as one falls where the other rises; also where --columns names the seconds as the time."""
    time = recording.accelerometer.time
    whole = np.round(time * per_second).astype(np.int64)
    parts = {rest: whole % per_second}
    stamps = (whole // per_second + 1_700_000_000).tolist()
    if seconds == "Time":
        stamps = [f"13:{at // 60 % 60:02d}:{at % 60:02d}" for at in stamps]
    path = write(tmp_path / "log.csv", stamps, values_of(recording), seconds, parts)
    columns = f"time [{'ns' if seconds == 'Time' else 's'}],_,accel [m/s^2],gyro [rad/s]" if stated else None
    read = read_recording(path, options=ReadOptions(columns=columns))
    np.testing.assert_allclose(read.gyroscope.time, time - time[0], atol=1.1 / per_second)
    assert any(f"time is '{seconds}" in note and f"and '{rest}" in note for note in read.notes)
    assert not any("not used" in note for note in read.notes)


@pytest.mark.parametrize(("name", "per_second"), [("dt [ms]", 1e3), ("delta_us", 1e6), ("deltaT [s]", 1.0),
                                                  ("sample interval (ms)", 1e3), ("delta_usec", 1e6)])  # fmt: skip
def test_intervals_since_the_row_before_are_summed(recording, tmp_path, name, per_second):
    time, values = recording.accelerometer.time, values_of(recording)
    kept = np.delete(np.arange(len(time)), np.arange(700, 720))
    late = time[kept] + np.random.default_rng(0).uniform(0, 1e-3, len(kept))
    steps = np.round(np.diff(late, prepend=late[0] - 0.01) * per_second, 9)
    path = write(tmp_path / "log.csv", steps, values[kept], name)
    for columns in (None, f"time [{'us' if per_second == 1e6 else 'ms'}],accel [m/s^2],gyro [rad/s]"):
        read = read_recording(path, options=ReadOptions(columns=columns))
        np.testing.assert_allclose(read.gyroscope.time, late - late[0], atol=1e-5)
        assert any("the time is their sum" in note for note in read.notes)
    read = read_recording(write(path, steps, values[kept], name, {"stamp [s]": late}))  # beside stamps it is nothing
    np.testing.assert_allclose(read.gyroscope.time, late - late[0], atol=1e-5)


@pytest.mark.parametrize("name", ["delta", "dt", "delta_x [ms]"])
def test_other_differences_are_no_intervals(recording, tmp_path, name):
    steps = np.full(len(recording.accelerometer), 0.01)
    with pytest.raises(InputError, match="no time column"):
        read_recording(write(tmp_path / "log.csv", steps, values_of(recording), name))


def test_milliseconds_alone_are_the_time_and_of_a_second_they_are_none(recording, tmp_path):
    time, values = recording.accelerometer.time, values_of(recording)
    read = read_recording(write(tmp_path / "log.csv", np.round(time * 1e3).astype(int), values, "ms"))
    np.testing.assert_allclose(read.gyroscope.time, time - time[0], atol=1e-3)
    minutes = {"sec": np.floor(time).astype(int) // 3}  # rises where the other falls, and not everywhere
    with pytest.raises(InputError, match=r"no time column|goes back"):
        read_recording(write(tmp_path / "log.csv", np.round(time % 1 * 1e3).astype(int), values, "ms", minutes))


@pytest.mark.parametrize("cell", ["{:.3f} sec", "{:.3f}s", "{:.3f} s"])
def test_cells_may_state_their_unit(recording, tmp_path, cell):
    time = recording.accelerometer.time
    stamps = [cell.format(stamp) for stamp in time]
    read = read_recording(write(tmp_path / "log.csv", stamps, values_of(recording), "time"))
    np.testing.assert_allclose(read.gyroscope.time, time - time[0], atol=1e-3)


def test_gravity_stated_in_three_digits_counts_by_them(recording, tmp_path, capsys):
    path = write(tmp_path / "log.csv", recording.accelerometer.time, values_of(recording))
    assert main(["calibrate", str(path), "--gravity", "9.81"]) == 0
    assert "9.81000 ± 0.0057 m/s²" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(("line", "words"), [("help", "calibrate"), ("help allan", "--json"), ("version", "0.1")])
def test_help_and_version_are_commands(capsys, line, words):
    assert main(line.split()) == 0
    assert words in capsys.readouterr().out


def test_a_folder_is_answered_with_what_lies_in_it(recording, tmp_path, capsys):
    for name in ("log.csv", "more.csv"):
        write(tmp_path / name, recording.accelerometer.time, values_of(recording))
    assert main(["info", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "it holds log.csv, more.csv" in said and f"jaximu fleet {tmp_path}" in said
    assert main(["help", "calibrat"]) == 2
    assert "did you mean calibrate" in capsys.readouterr().err


@pytest.mark.parametrize("delay", [None, 0.0, 0.02])
def test_the_rate_of_stamps_in_bursts_is_known_as_well_as_stated(delay):
    """Stamps cut to whole seconds, and packets of ten that come as late as chance has it."""
    off = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        rate = 100 * (1 + 1e-3 * rng.standard_normal())
        taken = rng.uniform() + np.arange(int(rng.uniform(50, 120) * rate)) / rate
        packet = np.arange(len(taken)) // 10
        arrival = taken[(10 * packet + 9).clip(max=len(taken) - 1)] + rng.exponential(delay or 0.0, len(taken))[packet]
        time = np.floor(taken) if delay is None else np.maximum.accumulate(arrival)
        gyroscope = steady_clock(Recording(None, Signal(time, np.zeros((len(time), 3)), "rad/s"))).gyroscope
        slope = np.ptp(gyroscope.time) / (len(time) - 1)
        off.append((slope * rate - 1) / gyroscope.clock_sigma)
    assert np.sqrt(np.mean(np.square(off))) < 1.5
