"""Files of other makers: read right, answered with a line that reads them right, or asked about; never a wrong line."""

import dataclasses
import json
import re

import numpy as np
import pytest
from dialects import DEG, Dialect, G, attempt, random_table, simulate, text, wrong_line, xyz
from makers import ALL
from rich.console import Console

from jaximu.cli import main
from jaximu.ground.errors import InputError
from jaximu.ground.page import Table
from jaximu.recordings.alignment import turns_backwards
from jaximu.recordings.columns.habits import stated_rate
from jaximu.recordings.columns.names import canonical
from jaximu.recordings.readers import ReadOptions, advise_reading, read_recording
from jaximu.recordings.readers.reader import read_table
from jaximu.report.export.catalogue import writer
from jaximu.report.terminal import show

AS_IS = ReadOptions(check=False)


@pytest.mark.parametrize("name", ALL)
def test_dialect(name, tmp_path):
    outcome = attempt(ALL[name], tmp_path / "logs")
    assert outcome.kind in ALL[name].must, outcome.said


def test_most_dialects_are_read_or_answered(tmp_path):
    """The goal: of 130 and more, those that can be read without being told something are."""
    readable = [name for name, each in ALL.items() if not {"asked", "unanswerable"} & {*each.must}]
    assert len(ALL) >= 130 and len(readable) > 0.75 * len(ALL)


def test_random_tables_get_no_wrong_line(tmp_path):
    """Any order, any units, with or without names: a line is right once its blanks are filled in, whoever wrote it."""
    wrong = [said for seed in range(50) if (said := wrong_line(random_table(seed), tmp_path))]
    assert wrong == []


HABITS = {  # names with a place for the unit
    "brackets": ("time [{}]", "acc_{} [{}]", "gyr_{} [{}]"),
    "round brackets": ("Timestamp ({})", "Accel{} ({})", "Gyro{} ({})"),
    "within the name": ("Time ({}) Run 1", "Acceleration {} ({}) Run 1", "Angular velocity {} ({}) Run 1"),
    "one word": ("t [{}]", "a{} [{}]", "w{} [{}]"),
    "segments": ("t ({})", "Foot LT {} ({})", "Foot LT turns {} ({})"),
}
FORCES, RATES = {"m/s^2": 1.0, "g": 1 / G, "mG": 1e3 / G}, {"rad/s": 1.0, "deg/s": DEG, "rpm": 30 / np.pi}
TIMES = {"s": 1.0, "ms": 1e3, "us": 1e6}
GRID = [(force, "deg/s", "ms") for force in FORCES] + [("g", rate, "s") for rate in RATES]


def stated(folder, habit, units, true) -> Dialect:
    """A recording in some units whose names state others, or the same."""
    (force, rate, time), log = true, simulate("poses")
    names = [habit[0].format(units[2]), *(habit[k].format(axis, units[k - 1]) for k in (1, 2) for axis in "XYZ")]
    columns = [log.time * TIMES[time], log.force * FORCES[force], log.rate * RATES[rate]]
    return Dialect("", lambda folder, _: text(folder, names, columns), log, frozenset({"accel", "gyro"}))


@pytest.mark.parametrize("units", GRID)
@pytest.mark.parametrize("habit", HABITS)
def test_stated_units_in_any_habit_of_names(tmp_path, habit, units):
    outcome = attempt(stated(tmp_path, HABITS[habit], units, units), tmp_path / "logs")
    assert outcome.kind in ("read", "line"), outcome.said


@pytest.mark.parametrize(
    ("units", "true"),
    [
        (("m/s^2", "deg/s", "ms"), ("g", "deg/s", "ms")),
        (("g", "deg/s", "ms"), ("m/s^2", "deg/s", "ms")),
        (("g", "deg/s", "ms"), ("g", "rad/s", "ms")),
        (("g", "rad/s", "ms"), ("g", "deg/s", "ms")),
        (("g", "rad/s", "ms"), ("g", "rad/s", "s")),
        (("g", "rad/s", "s"), ("g", "rad/s", "ms")),
    ],
)
def test_a_stated_unit_that_the_values_contradict_is_refused_with_a_line(tmp_path, units, true):
    """Neither does the name overrule the values silently, nor the values the name."""
    dialect = stated(tmp_path, HABITS["brackets"], units, true)
    outcome = attempt(dialect, tmp_path / "logs")
    assert outcome.kind == "line", outcome.said
    with pytest.raises(InputError, match=re.escape(outcome.said.partition('"')[2].partition('"')[0])):
        read_recording(dialect.write(tmp_path, dialect.log))


def test_a_temperature_without_a_unit_is_said_to_be_a_guess(tmp_path):
    log = simulate("poses")
    advice = advise_reading(text(tmp_path, ["t", *xyz("acc_{} [g]"), "temp"], [log.time, log.force / G, log.heat + 50]))
    assert advice is not None and "temperature [degC]" in (advice.columns or "")
    assert any("'temp' states no unit" in reason for reason in advice.reasons)


@pytest.mark.parametrize(
    ("name", "written"),
    [
        *((name, lambda celsius: 32 + 1.8 * celsius)
          for name in ("temp_f", "TemperatureF", "Temp degF", "temp_fahrenheit", "Temp [°F]")),
        *((name, lambda celsius: celsius + 273.15) for name in ("temp_K", "Temp kelvin")),
        *((name, lambda celsius: 100 * celsius) for name in ("temp_c_x100", "Temp [0.01 degC]")),
        *((name, lambda celsius: 1000 * celsius) for name in ("Temp_mC", "temp [mC]", "temp [m°C]")),
        ("temp_c_x10", lambda celsius: 10 * celsius),
        ("temp_c", lambda celsius: celsius),
    ],
)  # fmt: skip
def test_the_unit_of_a_temperature_in_its_name(tmp_path, name, written):
    log = simulate("poses")
    celsius = np.linspace(20.0, 30.0, len(log.time))
    names = ["time [s]", *xyz("acc_{} [g]"), name]
    recording = read_recording(text(tmp_path, names, [log.time, log.force / G, written(celsius)]), options=AS_IS)
    np.testing.assert_allclose(recording.temperature.values[:, 0], celsius, atol=1e-3)


@pytest.mark.parametrize(
    ("celsius", "factor", "offset", "unit"),
    [(20.0, 1.0, 273.15, "K"), (-40.0, 1.0, 273.15, "K"), (20.0, 1.8, 32.0, "degC"), (55.0, 1.0, 0.0, "degC"),
     (15.0, 1.0, 0.0, "degC"), (20.0, 10.0, 0.0, "count")],
)  # fmt: skip
def test_a_temperature_without_a_unit_by_its_numbers(tmp_path, celsius, factor, offset, unit):
    """Those that suit °C and °F are asked about; whole numbers of 200 and more may be tenths."""
    log = simulate("poses")
    heat = factor * (celsius + np.linspace(0, 10, len(log.time))) + offset
    heat = np.round(heat) if unit == "count" else heat
    path = text(tmp_path, ["t", *xyz("acc_{} [g]"), "temp"], [log.time, log.force / G, heat])
    advice = advise_reading(path)
    assert advice.columns == f"time [s],accel [g],temperature [{unit}]"
    asked_about = any("write degF in its place if not" in question.text for question in advice.questions)
    assert asked_about is (unit == "degC" and celsius != 15.0)


@pytest.mark.parametrize("order", [[0, 1, 2], [1, 0, 2], [1, 2, 0], [2, 1, 0]])
def test_where_columns_stand_proves_nothing(tmp_path, order):
    """Time, forces and rates in any order, without names: the values say which is which."""
    log = simulate("poses")
    parts = [[log.time], [log.force / G], [np.degrees(log.rate)]]
    path = text(tmp_path, None, [each for place in order for each in parts[place]])
    advice = advise_reading(path)
    assert advice is not None and not advice.questions
    recording = read_recording(path, options=dataclasses.replace(AS_IS, columns=advice.columns))
    np.testing.assert_allclose(recording.accelerometer.values, log.force, atol=1e-4)
    assert recording.gyroscope is not None
    np.testing.assert_allclose(recording.gyroscope.values, log.rate, atol=1e-4)


def test_names_beat_places_and_physics_beats_neither(tmp_path):
    log = simulate("poses")
    names = ["t", *xyz("Gyr_noise_{}"), *xyz("Acc_noise_{}")]
    advice = advise_reading(text(tmp_path, names, [log.time, log.rate, log.force]))
    assert advice is not None and advice.columns == "time [s],gyro [rad/s],accel [m/s^2]"


def test_a_low_g_accelerometer_is_preferred_to_a_high_g_one(tmp_path):
    log = simulate("poses")
    names = ["Time(s)", *xyz("HighG_{}(g)"), *xyz("LowG_{}(g)"), *xyz("Gyro_{}(dps)")]
    path = text(tmp_path, names, [log.time, np.round(log.force / G, 1), log.force / G, np.degrees(log.rate)])
    advice = advise_reading(path)
    assert advice is not None and advice.columns == "time [s],_,_,_,accel [g],gyro [dps]"


def test_a_guess_shows_rows_and_reasons(tmp_path, capsys):
    log = simulate("poses")
    path = text(tmp_path, ["t", *xyz("acc_{}"), *xyz("gyr_{}")], [log.time, log.force, np.degrees(log.rate)])
    assert main(["info", str(path), "--json"]) == 0
    guess = json.loads(capsys.readouterr().out)["guess"]
    assert guess["line"] == '--columns "time [s],accel [m/s^2],gyro [deg/s]"'
    assert len(guess["rows"]) == 4 and float(guess["rows"][1][1]) == pytest.approx(log.force[0, 0], abs=1e-5)
    assert any("turn gravity as the accelerometer shows" in reason for reason in guess["reasons"])
    assert guess["questions"] == []
    with pytest.raises(InputError, match=r'gyro \[deg/s\]".*turn gravity'):
        read_recording(path)


def test_sensors_in_rows_keep_the_file_s_order(tmp_path):
    """A line to paste names columns by their place, so that the next process must see them in the same order."""
    tags = ["Magnetometer", "Gyroscope", "Accelerometer"]
    rows = [f"{0.01 * at:.2f},{tag},{at % 7},{at % 5},{at % 3}" for at in range(60) for tag in tags]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["t [s],sensor,x,y,z", *rows]) + "\n")
    names = [name for name in read_table(path).names or () if name.endswith("_x")]
    assert names == ["mag_x", "gyro_x", "accel_x"]


def test_what_is_uncertain_is_asked_and_shown(tmp_path, capsys):
    log = simulate("rest")
    path = text(tmp_path, ["t", *xyz("acc_{}"), *xyz("gyr_{}")], [log.time, log.force, log.rate])
    assert main(["info", str(path)]) == 2
    message = capsys.readouterr().err
    assert "gyro [?]" in message and "deg/s or rad/s?" in message
    assert len(re.findall(r"^ +\d", message, re.MULTILINE)) == 3
    with pytest.raises(InputError, match="for you to fill in"):
        read_recording(path, options=dataclasses.replace(AS_IS, columns="time [s],accel [m/s^2],gyro [?]"))


def test_a_mistaken_rate_is_not_asserted(tmp_path):
    """Steps of 505 140: 1.98 Hz in microseconds or 1980 Hz in nanoseconds; at rest nothing says which."""
    log = simulate("rest")
    stamps = np.arange(len(log.time)) * 505_140
    advice = advise_reading(text(tmp_path, ["timestamp", *xyz("acc_{}")], [stamps, log.force]))
    assert advice is not None and advice.columns == "time [?],accel [m/s^2]"
    (question,) = advice.questions
    assert "1.98 Hz in us, 1980 Hz in ns" in question.text
    assert (question.option, question.blank, question.default) == ("columns", "time [?]", "us")


def test_the_file_beside_it_is_named(tmp_path):
    path = ALL["phyphox, Gyroscope.csv alone"].write(tmp_path, simulate("poses"))
    with pytest.raises(InputError, match=r"Accelerometer\.csv --gyro-log Gyroscope\.csv"):
        read_recording(path)
    both = read_recording(tmp_path / "Accelerometer.csv", path)
    assert both.gyroscope is not None


def test_apple_s_sign_is_told(tmp_path):
    recording = read_recording(ALL["SensorLog for iOS"].write(tmp_path, simulate("poses")))
    assert any("-f" in note and "--axes" in note for note in recording.notes)


@pytest.mark.parametrize("suffix", [".xlsx", ".zip"])
def test_archives_are_named(tmp_path, suffix):
    import zipfile

    path = tmp_path / f"log{suffix}"
    with zipfile.ZipFile(path, "w") as archive:
        for name in ["xl/workbook.xml"] if suffix == ".xlsx" else ["monday.csv", "tuesday.csv"]:
            archive.writestr(name, "x")
    with pytest.raises(InputError, match="save its sheet as CSV" if suffix == ".xlsx" else "Unpack it"):
        read_recording(path)


def test_increments_are_divided_by_the_interval(tmp_path):
    log = simulate("poses")
    path = text(tmp_path, ["t [s]", *xyz("a{} [m/s]"), *xyz("g{} [deg]")],
                [log.time, log.force / 100, np.degrees(log.rate) / 100], digits=9)  # fmt: skip
    recording = read_recording(path, options=AS_IS)
    np.testing.assert_allclose(recording.accelerometer.values, log.force, atol=1e-5)
    assert recording.gyroscope is not None and recording.gyroscope.unit == "rad/s"
    np.testing.assert_allclose(recording.gyroscope.values, log.rate, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "title"),
    [
        ("x_rotation", "gyro_x"),
        ("accelerometerAccelerationX(G)", "accel_x"),
        ("gyroRotationZ(rad/s)", "gyro_z"),
        ("motionUserAccelerationX(G)", None),
        ("Linear Acceleration x (m/s^2)", None),
        ("X (m/s^2)", "accel_x"),
        ("Y (rad/s)", "gyro_y"),
        ("Z (µT)", "mag_z"),
        ("xacc", "accel_x"),
        ("AcX", "accel_x"),
        ("GyZ", "gyro_z"),
        ("angVel_y", "gyro_y"),
        ("velocity_x", None),
        ("gyro_bias_x", None),
        ("acc_std_y", None),
        ("delta_angle_x", None),
        ("T(°)", "temperature"),
        ("LowG_X (g)", None),
        ("SampleTimeFine", "time"),
        ("accelerometerTimestamp_sinceReboot(s)", "time"),
        ("Counter", None),
        ("PacketCounter", None),
    ],
)
def test_habits(name, title):
    assert canonical(name) == title


@pytest.mark.parametrize(
    ("line", "rate"),
    [
        ("Fs,100", 100),
        ("// Sample rate: 50.0Hz", 50),
        ("// Update Rate: 100.0Hz", 100),
        ("Measurement Frequency,85.7 Hz", 85.7),
        ("ActiGraph ActiLife v6.13 at 30 Hz", 30),
        ("Sampling Rate (Hz);204.8", 204.8),
        ("sampling frequency = 1 kHz", 1000),
        ("Sample interval: 10 ms", 100),
        ("Sample rate: 50 Hz\nOutput rate: 100 Hz", None),
        ("Firmware rate limiter on", None),
        ("Fs,0", None),
    ],
)
def test_rates_in_a_preamble(line, rate):
    assert stated_rate(line) == (None if rate is None else pytest.approx(rate))


# --- what info claims


def walk(tmp_path, sense: float = 1.0):
    log = simulate("walk")
    names = ["t [s]", *xyz("a{} [m/s^2]"), *xyz("w{} [rad/s]")]
    return text(tmp_path, names, [log.time, log.force, sense * log.rate])


def findings(path, capsys) -> dict:
    assert main(["info", str(path), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_walk_is_neither_rest_nor_mirrored(tmp_path, capsys):
    told = " ".join(findings(walk(tmp_path), capsys)["findings"])
    assert "at rest" not in told and "mirrored" not in told


@pytest.mark.parametrize("kind", ["poses", "walk"])
def test_a_mirrored_gyroscope_is_told_by_likelihood(kind):
    log = simulate(kind, rows=8000)
    for sense in (1.0, -1.0):
        assert turns_backwards(log.time, log.force, log.time, sense * log.rate) == (sense < 0)


def test_a_few_bumps_leave_a_log_at_rest(tmp_path, capsys):
    rows = 200_000
    random = np.random.default_rng(3)
    values = random.normal([0.1, 0.2, 9.8, 0.0, 0.0, 0.0], [0.02] * 3 + [0.002] * 3, (rows, 6))
    for at in (30_000, 90_000):
        values[at : at + 30, :3] += random.normal(0, 2.0, (30, 3))
    names = ["t [s]", *xyz("a{} [m/s^2]"), *xyz("w{} [rad/s]")]
    path = text(tmp_path, names, [np.arange(rows) / 100, values], digits=4)
    uses = {each["verb"]: each["why"] for each in findings(path, capsys)["uses"]}
    assert "at rest for 2000 s but for" in uses["allan"]


def test_a_long_rest_is_offered_once_it_is_cut_out(tmp_path, capsys):
    rows = 100_000
    random = np.random.default_rng(4)
    values = random.normal([0.1, 0.2, 9.8], 0.02, (rows, 3))
    values[:20_000] += random.normal(0, 1.0, (20_000, 3))
    path = text(tmp_path, ["t [s]", *xyz("a{} [m/s^2]")], [np.arange(rows) / 100, values], digits=4)
    uses = {each["verb"]: each["why"] for each in findings(path, capsys)["uses"]}
    assert re.match(r"once cut to the 79[789] s at rest from 20[012] s on", uses["allan"])


# --- tables on a narrow terminal


@pytest.mark.parametrize("width", [40, 80, 200])
def test_tables_never_cut_numbers_nor_swallow_units(width, capsys):
    row = ("gain [m/s^2]", *["7.078123e-05 ± 1.2e-06"] * 4)
    table = Table(("parameter [unit]", "x", "y", "z", "mean"), [row], "Caption [deg/s]")
    show(table, Console(width=width, highlight=False, markup=False))
    shown = capsys.readouterr().out
    assert shown.count("7.078123e-05") == 4 and shown.count("1.2e-06") == 4 and "…" not in shown
    assert max(map(len, shown.splitlines())) <= width
    assert "[m/s^2]" in shown and "[unit]" in shown and "[deg/s]" in shown


@pytest.mark.parametrize(
    ("typed", "module"),
    [("c", "c_header"), ("c_header", "c_header"), ("imu-tk", "imu_tk"), ("imutk", "imu_tk"), ("ros", "ros_yaml")],
)
def test_formats_by_the_names_that_people_type(typed, module):
    assert writer(typed).__name__.endswith(module)
