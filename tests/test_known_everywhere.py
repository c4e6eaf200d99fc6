"""What is wrong with a recording is known to every verb: at rest, on a table, in a fleet, to `info`."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from jaximu.calibration import calibrate_turntable, load_calibration
from jaximu.cli import main
from jaximu.diagnosis import check, diagnose_turntable
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.mistakes import inspect, prepare
from jaximu.model import BiasRepeatability, Noise, White
from jaximu.noise.analysis import analyse_noise
from jaximu.noise.at_rest import fit_noise
from jaximu.recordings import write_recording
from jaximu.recordings.readers import read_recording
from jaximu.recordings.recording import Recording
from jaximu.report.allan import kalibr_text
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld, Positions, RateTable, Static

WHITE = {"accelerometer": 2e-3, "gyroscope": 1e-4}
NOISE = {
    "accelerometer": Noise((White(WHITE["accelerometer"]), BiasRepeatability(0.05)), "specific_force"),
    "gyroscope": Noise((White(WHITE["gyroscope"]), BiasRepeatability(1e-3)), "angular_rate"),
}
RATE = 50.0


@pytest.fixture(scope="module")
def rest():
    """Four minutes at rest, white noise alone."""
    return simulate(draw_imu(1), Static(240.0), NOISE, rate=RATE, seed=1)[0]


def changed(recording: Recording, change) -> Recording:
    """The recording with the values of both triads changed: change(time, values, noise of a sample)."""
    parts = {}
    for name, density in WHITE.items():
        signal = getattr(recording, name)
        parts[name] = replace(signal, values=change(signal.time, signal.values.copy(), density * np.sqrt(RATE)))
    return replace(recording, **parts)


def knocked(time, values, noise):
    rows = (time > 100.0) & (time < 103.0)
    values[rows] += 40 * noise * np.random.default_rng(1).normal(size=(rows.sum(), 3))
    return values


def zero_row(time, values, noise):
    values[0] = 0.0
    return values


def halved_row(time, values, noise):
    values[5000] /= 2
    return values


def held(time, values, noise):
    return values[np.arange(len(values)) // 4 * 4]


def low_pass(time, values, noise):
    smooth = values.copy()
    for _ in range(2):
        for row in range(1, len(smooth)):
            smooth[row] = smooth[row - 1] + 0.3 * (smooth[row] - smooth[row - 1])
    return smooth[np.minimum(np.arange(len(smooth)) + 50, len(smooth) - 1)]


@pytest.mark.parametrize(
    ("change", "name", "words"),
    [(knocked, "data.knock", "was knocked"), (zero_row, "data.zeros", "read zero on all axes"),
     (halved_row, "data.spikes", "outlier"), (held, "data.resampled", "holds each sample"),
     (low_pass, "data.bandwidth", "low-pass filter")],
)  # fmt: skip
def test_noise_is_that_of_the_sensor_whatever_else_is_in_a_recording_at_rest(rest, change, name, words):
    recording = changed(rest, change)
    assert name in {finding.name for finding in inspect(recording)}
    found = analyse_noise(recording)
    assert any(words in note for note in found.notes)
    factor = 2.0 if change is held else 1.0  # of four samples one is left, as dense as it was made
    for triad, density in WHITE.items():
        for axis in found.axes[triad]:
            white = axis.terms["N"]
            assert white is not None
            assert abs(white.value - factor * density) < white.high - white.low  # four standard deviations
    if change is not low_pass:  # whose noise is not white
        for triad, density in WHITE.items():
            white = np.sqrt(getattr(fit_noise(recording), triad).white)
            assert white == pytest.approx(factor * density, rel=0.1)


def test_a_recording_at_rest_without_a_mistake_has_none(rest):
    assert inspect(rest) == []


def test_knocks_are_what_noise_and_drift_do_not_do(rest):
    """A walk, a step of the bias, a periodic disturbance and a filter's correlated noise are no knocks."""
    random = np.random.default_rng(2)

    def walk(time, values, noise):
        return values + 0.1 * noise * np.cumsum(random.normal(size=values.shape), axis=0)

    def step(time, values, noise):
        return values + np.where(time > 120.0, 5 * noise, 0.0)[:, None]

    def hum(time, values, noise):
        return values + 3 * noise * np.sin(2 * np.pi * 9.3 * time)[:, None]

    def averaged(time, values, noise):
        return np.stack([np.convolve(axis, np.ones(16) / 16, "same") for axis in values.T], axis=1)[16:-16]

    for change in (walk, step, hum):
        assert "data.knock" not in {finding.name for finding in inspect(changed(rest, change))}
    parts = {name: replace(getattr(rest, name), time=getattr(rest, name).time[16:-16],
                           values=averaged(None, getattr(rest, name).values, None)) for name in WHITE}  # fmt: skip
    assert "data.knock" not in {finding.name for finding in inspect(replace(rest, **parts))}


def test_a_turn_between_long_rests_is_no_knock():
    recording, _ = simulate(draw_imu(1), HandHeld(3, 60.0), NOISE, rate=RATE, seed=3)
    assert inspect(recording) == []
    level = replace(
        recording, accelerometer=replace(recording.accelerometer, time=np.zeros(0), values=np.zeros((0, 3)))
    )
    assert "data.knock" not in {finding.name for finding in inspect(level)}


@pytest.mark.parametrize("size", [1.5, 2.0])
def test_of_a_gyroscope_with_a_dead_band_no_noise_is_stated(rest, size):
    rate = rest.gyroscope.values - rest.gyroscope.values.mean(axis=0)
    limit = size * rate.std()
    recording = replace(rest, gyroscope=replace(rest.gyroscope, values=np.where(np.abs(rate) < limit, 0.0, rate)))
    found = analyse_noise(recording)
    assert set(found.axes) == {"accelerometer"}
    assert any("zeroes it at rest (a dead band)" in note for note in found.notes)
    assert found.unusable == {"gyroscope"} and "\ngyroscope_" not in kalibr_text(found)
    assert not found.summary().next
    with pytest.raises(InputError, match="dead band"):
        fit_noise(recording)
    silent = rest.gyroscope.values.copy()
    silent[np.random.default_rng(4).random(len(silent)) < 0.25] = 0.0
    rows = replace(rest, gyroscope=replace(rest.gyroscope, values=silent))
    assert "data.auto_zero" not in {finding.name for finding in inspect(rows)}  # a transfer that fails, beside a bias
    coarse = replace(rest, gyroscope=replace(rest.gyroscope, values=np.round(rate / limit) * limit))
    assert "data.auto_zero" not in {finding.name for finding in inspect(coarse)}  # steps are no dead band


def test_values_in_g_at_rest_are_refused_as_they_are_by_hand(rest, tmp_path, capsys):
    force = rest.accelerometer.values / 9.80665
    write_recording(replace(rest, accelerometer=replace(rest.accelerometer, values=force)), tmp_path / "rest.csv")
    log, _ = simulate(draw_imu(1), HandHeld(12, 1.5), NOISE, rate=RATE, seed=2)
    write_recording(log, tmp_path / "log.csv")
    for arguments in (["allan", "rest.csv"], ["calibrate", "log.csv", "--static", "rest.csv"]):
        given = [str(tmp_path / each) if each.endswith(".csv") else each for each in arguments]
        assert main(given) == 2
        assert "look like g" in capsys.readouterr().err


@pytest.fixture(scope="module")
def table():
    """A table's recording, its schedule, its unit, and a limit that its quick turns exceed."""
    unit = draw_imu(4)
    log, truth = simulate(unit, RateTable(rates=(60.0, 120.0)), consumer_noise(), rate=100.0, seed=4)
    return log, truth.schedule, unit, np.radians(90.0)


def test_turns_that_clip_on_a_table_are_left_out_and_said(table):
    log, schedule, unit, limit = table
    clipped = replace(log, gyroscope=replace(log.gyroscope, values=np.clip(log.gyroscope.values, -limit, limit)))
    whole, found = (calibrate_turntable(each, schedule) for each in (log, clipped))
    assert any("its range is too small for this motion" in note for note in found.notes)
    assert found.data["turns"] < whole.data["turns"]
    off = (np.asarray(found.imu.gyroscope.gain) - np.asarray(unit.gyroscope.gain)) / found.sigma("gyroscope")[0]
    assert np.abs(off).max() < 5


def test_an_accelerometer_that_clips_on_a_table_is_not_the_gyroscopes_fault():
    log, truth = simulate(draw_imu(4), Positions(26, 6.0, 2.0), consumer_noise(), rate=50.0, seed=4)
    force = np.clip(log.accelerometer.values, -9.0, 9.0)
    clipped = replace(log, accelerometer=replace(log.accelerometer, values=force))
    found = diagnose_turntable(clipped, truth.schedule)
    assert "data.clipping" in [finding.name for finding in found.preflight]
    assert not [each for each in found.named if each.effect.name.startswith("gyro.")]


def test_a_table_of_which_clipping_leaves_nothing_says_so(table):
    log, schedule, _, limit = table
    clipped = replace(log, gyroscope=replace(log.gyroscope, values=np.clip(log.gyroscope.values, -limit, limit)))
    with pytest.raises(NotPossibleError, match="samples stop at"):
        calibrate_turntable(clipped, schedule[4:9])  # quick turns about one axis


def test_an_overflow_lies_beyond_all_that_did_not(rest):
    """A row that is half of its neighbours jumps there and back, but by no range of an integer."""
    assert "data.wrap" not in {finding.name for finding in inspect(changed(rest, halved_row))}


@pytest.fixture(scope="module")
def by_hand(tmp_path_factory):
    """A folder with a log by hand, its copy, one cut off by a power loss, and one stamped in bursts."""
    folder = tmp_path_factory.mktemp("logs")
    log, _ = simulate(draw_imu(5), HandHeld(12, 1.5), consumer_noise(), rate=100.0, seed=5)
    write_recording(log, folder / "a.csv")
    shutil.copy(folder / "a.csv", folder / "b.csv")
    text = (folder / "a.csv").read_bytes()
    (folder / "c.csv").write_bytes(text[: int(0.95 * len(text))] + bytes(7))
    time = np.repeat(log.accelerometer.time[1::2], 2)[: len(log.accelerometer)]
    time = time + 1e-6 * (np.arange(len(time)) % 2)
    late = {name: replace(signal, time=time, values=signal.values[: len(time)]) for name, signal in log.signals.items()}
    write_recording(replace(log, **late), folder / "d.csv")
    return folder


def test_a_fleet_says_that_a_file_is_there_twice_and_reads_one_that_ends_in_zeros(by_hand, tmp_path, capsys):
    import pyarrow.parquet as pq

    assert main(["fleet", str(by_hand), "-o", str(tmp_path / "t.parquet"), "--workers", "1"]) == 0
    assert "The same bytes as" in capsys.readouterr().out  # how it goes on is broken by the folder's name
    assert "one recording under two names" in (tmp_path / "t.html").read_text(encoding="utf-8")
    rows = {row["device"]: row for row in pq.read_table(tmp_path / "t.parquet").to_pylist()}
    assert {name: row["status"] for name, row in rows.items()} == {"a": "ok", "b": "bad input", "c": "ok", "d": "ok"}
    assert any("ends in zero bytes" in note for note in rows["c"]["notes"])
    assert any("come in bursts" in note for note in rows["d"]["notes"])


def test_info_shows_a_log_as_it_is_used(by_hand, capsys):
    assert main(["info", str(by_hand / "d.csv"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["signals"]["gyroscope"]["rate"] == pytest.approx(100.0, rel=1e-3)
    assert "calibrate" in {each["verb"] for each in document["uses"]}


def test_a_calibration_is_not_checked_on_the_recording_that_it_was_fitted_to(by_hand, tmp_path, capsys):
    log = str(by_hand / "a.csv")
    assert main(["calibrate", log, "-o", str(tmp_path)]) == 0
    capsys.readouterr()
    assert main(["check", str(tmp_path / "calibration.json"), log]) == 1
    assert "that this calibration was fitted to" in capsys.readouterr().err
    with pytest.raises(NotPossibleError, match="was fitted to"):
        check(load_calibration(tmp_path / "calibration.json"), read_recording(by_hand / "b.csv"))


def test_a_dead_band_by_hand_is_named_and_no_time_is_lost(by_hand):
    log = read_recording(by_hand / "a.csv")
    rate = log.gyroscope.values - np.median(log.gyroscope.values, axis=0)
    dead = replace(log.gyroscope, values=np.where(np.abs(rate) < np.radians(0.5), 0.0, rate))
    ready = prepare(replace(log, gyroscope=dead))
    assert [finding.name for finding in ready.findings] == ["data.auto_zero"]
    assert ready.spoiling
