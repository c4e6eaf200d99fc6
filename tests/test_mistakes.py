"""Everyday mistakes, put into recordings by a generator that shares nothing with the checks, are named with their rows.

How often, by kind, on simulated and measured recordings: benchmarks/results/mistakes.md.
"""

import json
import re
import time
from dataclasses import replace
from functools import lru_cache

import hidden_effects as hidden
import mistakes_generator as generator
import numpy as np
import pytest
import scipy

from jaximu import InputError, LocalGravity, ReadOptions, calibrate, read_recording
from jaximu.calibration.nominal import nominal_imu
from jaximu.calibration.recipe import Choices, calibrate_ready, carried_error
from jaximu.cli.app import main
from jaximu.diagnosis import diagnose
from jaximu.mistakes import inspect, lost_samples, prepare
from jaximu.mistakes.base import Samples
from jaximu.recordings.recording import Recording, Signal

GRAVITY = LocalGravity(hidden.GRAVITY, 1e-6)
RATES = 100.0, 50.0, 200.0


@lru_cache(maxsize=32)
def unit(seed: int, rate: float = 100.0, poses: int = 24, grade: float = 1.0, quantise: bool = True):
    """A clean recording by the outside simulator, and the truth; noise in multiples of consumer grade."""
    white, flicker = hidden.WHITE, hidden.FLICKER
    hidden.WHITE, hidden.FLICKER = ({key: grade * value for key, value in table.items()} for table in (white, flicker))
    try:
        case = hidden.draw_case(seed, (), poses=poses, rate=rate, turn_duration=2.0, quantise=quantise)
        made = case.fit
    finally:
        hidden.WHITE, hidden.FLICKER = white, flicker
    return recording_of(made), case.truth


def recording_of(made) -> Recording:
    return Recording(Signal(made.time, made.accel, "m/s^2"), Signal(made.time, made.gyro, "rad/s"))


def planted(name: str, seed: int, rate: float = 100.0) -> generator.Planted:
    log = generator.Log.of(unit(seed, rate)[0], unit(seed + 500, rate)[0])
    return generator.MISTAKES[name](log, np.random.default_rng([seed, 11]))


def names(found):
    return {finding.name for finding in found}


# --- named, with rows


@pytest.mark.parametrize("name", generator.MISTAKES)
def test_a_mistake_is_named(name):
    for seed, rate in enumerate(RATES):
        case = planted(name, seed, rate)
        found = inspect(case.log.to_recording())
        assert names(found) & set(case.names), (seed, [finding.text for finding in found])
        for finding in found:
            assert finding.text.endswith(".")
            assert finding.document()["name"] == finding.name


@pytest.mark.parametrize(("seed", "two_axes"), [(70008, False), (70054, False), (80017, True), (80043, True)])
def test_a_turn_of_two_samples_is_no_spike(tmp_path, seed, two_axes):
    case = hidden.draw_case(seed, (), rate=25.0, two_axes=two_axes)
    recording = read_recording(case.write(tmp_path, ("fit",))["fit"])
    assert "data.spikes" not in names(inspect(recording))
    log, random = generator.Log.of(recording), np.random.default_rng(seed)
    gyro, places = log.gyro.copy(), generator.chosen(random, log.moving(), 12, 25)
    gyro[places, random.integers(3, size=12)] += random.choice([-1, 1], 12) * random.uniform(2.0, 6.0, 12)
    (found,) = [each for each in inspect(replace(log, gyro=gyro).to_recording()) if each.name == "data.spikes"]
    assert len(found.without["gyroscope"]) >= 9  # of twelve


@pytest.mark.parametrize(
    "name", ["zero_rows", "spikes", "wrap_around", "clipped", "pasted_twice", "stuck_axis", "hung"]
)
def test_rows_are_those_that_were_changed(name):
    for seed, rate in enumerate(RATES):
        case = planted(name, seed, rate)
        ready = prepare(case.log.to_recording())
        rows = [row for finding in ready.findings if finding.name in case.names for row in finding.rows]
        assert rows
        changed = set(case.rows + 1)
        for row in rows:  # a stuck axis may hold its value a row longer, a paste can go on by chance
            assert {row - 1, row, row + 1} & changed, (seed, row)
        assert any(len(each) for each in ready.left_out.values())


@pytest.mark.parametrize("triad", ["accel", "gyro"])
def test_rows_that_are_left_out_are_no_motion_to_start_from(triad):
    """A fit that starts where turns across the gap lead does not converge: seen in two of ten."""
    log = generator.Log.of(unit(5, 200.0)[0])
    values, start, stop = getattr(log, triad).copy(), log.count // 2, log.count // 2 + round(8.0 / log.period)
    values[start:stop, 2] = values[start - 1, 2]
    ready = prepare(replace(log, **{triad: values}).to_recording())
    gyroscope = nominal_imu(ready.recording).gyroscope
    assert gyroscope is not None
    np.testing.assert_allclose(gyroscope.gain, np.eye(3), atol=0.1)


@pytest.mark.parametrize("name", ["sway", "tremor"])
def test_a_hand_that_moves_is_not_taken_for_a_filter(name):
    """Sway falls off above 3 Hz and tremor above 9 Hz, to white noise; what a filter passes has none."""
    for seed in range(3):
        log, random = generator.Log.of(unit(seed)[0]), np.random.default_rng([seed, 12])
        low, high = {"sway": (0.5, 3.0), "tremor": (7.0, 11.0)}[name]
        shaking = scipy.signal.sosfilt(
            scipy.signal.butter(2, (low, high), "bandpass", fs=1 / log.period, output="sos"),
            random.standard_normal((log.count, 3)),
            axis=0,
        )
        hand = replace(log, gyro=log.gyro + 0.02 * shaking / shaking.std()).to_recording()
        assert "data.bandwidth" not in names(inspect(hand)), (seed, [finding.text for finding in inspect(hand)])
        filtered = generator.filtered(generator.Log.of(hand), 5.0, 2).to_recording()
        assert "data.bandwidth" in names(inspect(filtered))


def test_lost_samples_are_counted_with_their_rows():
    case = planted("lost_1_percent", 4)
    (finding,) = [each for each in inspect(case.log.to_recording()) if each.name == "data.lost_samples"]
    assert finding.repair == "--repair"
    assert finding.spoils
    for row in finding.rows:
        assert np.min(np.abs(case.rows + 1 - row)) <= 1


@pytest.mark.parametrize("delay", [-6e-3, -3.5e-3, 7e-3])
def test_a_constant_lag_between_the_sensors_is_no_lost_sample(data_folder, delay):
    """Motion that is not smooth makes steps of any size: a few near one sample are none that was lost."""
    path = data_folder / "broad/02_undisturbed_slow_rotation_B.mat"
    recording = read_recording(path, options=ReadOptions(check=False))
    gyroscope = recording.gyroscope
    assert gyroscope is not None
    late = replace(gyroscope, values=gyroscope.at(gyroscope.time - delay))
    samples = Samples(replace(recording, gyroscope=late), dict.fromkeys(recording.signals, np.arange(len(late))))
    assert not lost_samples.find(samples)


def test_a_repair_that_fits_worse_is_not_advised():
    recording = planted("lost_1_percent", 4).log.to_recording()

    def length(tried):
        return float(np.ptp(tried.gyroscope.time))

    for repair in (False, True):
        ready = prepare(recording, repair, misfit=length)  # repaired, it is longer
        assert not ready.findings and len(ready.recording.gyroscope) == len(recording.gyroscope)
        assert length(ready.recording) == length(recording)
    choices = Choices(GRAVITY)
    (finding,) = prepare(recording, misfit=lambda tried: carried_error(tried, choices)).findings
    assert finding.name == "data.lost_samples"


@pytest.mark.parametrize("name", generator.FILES)
def test_files_whose_stamps_do_not_rise(name, tmp_path):
    clean = unit(2, poses=15)[0]
    case = generator.FILES[name](generator.Log.of(clean), np.random.default_rng(5))
    found = read_recording(case.log.write(tmp_path / "log.csv"))
    assert names(inspect(found)) & set(case.names)
    if "data.bursts" not in case.names:  # what is left is the recording as it was
        assert found.gyroscope is not None and clean.gyroscope is not None
        np.testing.assert_allclose(found.gyroscope.values, clean.gyroscope.values, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.gyroscope.time, clean.gyroscope.time, rtol=0, atol=1e-9)


def test_two_recordings_in_one_file_are_refused_with_the_row(tmp_path):
    one, two = (generator.Log.of(unit(seed, poses=15)[0]) for seed in (2, 3))
    both = replace(one, **{key: np.concatenate([getattr(one, key), getattr(two, key)])
                           for key in ("time", "accel", "gyro")})  # fmt: skip
    with pytest.raises(InputError, match=f"row {one.count + 2}: the clock goes back .* two recordings in one file"):
        read_recording(both.write(tmp_path / "log.csv"))


@pytest.mark.parametrize("share", [0.25, 0.45, 0.8])
@pytest.mark.parametrize(("triad", "factor"), [("gyro", 57.29578), ("gyro", 1 / 57.29578), ("accel", 1 / 9.80665)])
def test_a_unit_that_changes_within_the_file_is_refused_with_its_time(triad, factor, share, tmp_path):
    log = generator.Log.of(unit(2, poses=15)[0])
    values, row = getattr(log, triad).copy(), int(share * log.count)
    values[row:] *= factor
    with pytest.raises(InputError, match=f"from about .* s on, {triad}_x.* the unit changes within the file") as error:
        read_recording(replace(log, **{triad: values}).write(tmp_path / "log.csv"))
    told = float(str(error.value).split("about ")[1].split(" s")[0])
    assert abs(told - log.time[row]) < 0.11 * log.time[-1]


@pytest.mark.parametrize(("factor", "said"), [(1e3, "unit of the time column"), (1e-3, "unit of the time column")])
def test_stamps_in_another_unit_are_refused(factor, said, tmp_path):
    log = generator.Log.of(unit(2, poses=15)[0])
    with pytest.raises(InputError, match=said):
        read_recording(replace(log, time=factor * log.time).write(tmp_path / "log.csv"))


def test_linear_acceleration_is_refused_by_its_name(tmp_path):
    case = planted("gravity_free", 1)
    with pytest.raises(InputError, match="gravity was taken out"):
        read_recording(case.log.write(tmp_path / "log.csv"))


# --- nothing is invented


@pytest.mark.parametrize(("rate", "grade"), [(25.0, 1.0), (50.0, 0.1), (100.0, 1.0), (100.0, 0.01), (200.0, 3.0),
                                             (400.0, 0.3)])  # fmt: skip
def test_clean_recordings_have_no_mistakes(rate, grade):
    for seed in range(4):
        recording, _ = unit(seed, rate, 16, grade, grade >= 1)
        assert not inspect(recording), (seed, [finding.text for finding in inspect(recording)])


def measured(folder):
    """Recordings by hand whose sensors and loggers did what they should, up to clipping and knocks.

    Of the array's eight units in four sessions every third; all are in benchmarks/results/real_diagnosis.md.
    """
    mimu = ReadOptions(accel_scale="2048 count/g", gyro_scale="16.4 count/(deg/s)", check=False)
    for path in sorted((folder / "mimu4444").glob("*.parquet"))[::3]:
        yield path, mimu
    for path in sorted((folder / "mikoff_mpu9150").glob("*.log")):
        yield path, ReadOptions(columns="accel [m/s^2],gyro [rad/s]", rate=100)
    yield (
        folder / "tomisuarez_mpu6050/example_data_calibration.csv",
        ReadOptions(
            columns="accel [count],gyro [count]", rate=100, accel_scale="16384 count/g", gyro_scale="131 count/(deg/s)"
        ),
    )
    yield folder / "broad/02_undisturbed_slow_rotation_B.mat", ReadOptions(check=False)
    for name in ("MH03", "V102"):
        yield folder / f"euroc/{name}.imu.txt", ReadOptions(check=False)


@pytest.mark.parametrize("mistake", ["dead_axis", "twelve_bits", "pasted_twice", "zeroed_at_rest"])
def test_mistakes_in_turns_that_are_too_quick_for_their_rate(data_folder, mistake):
    """Neither a jump from sample to sample nor coarse steps at rest pass for another mistake."""
    options = ReadOptions(accel_scale="2048 count/g", gyro_scale="16.4 count/(deg/s)", check=False)
    rivals = {"data.dead_axis", "data.quantisation", "data.duplicate", "data.auto_zero"}
    for place, name in enumerate(("unit3_session2", "unit5_session3", "unit7_session4"), start=6):
        log = generator.Log.of(read_recording(data_folder / f"mimu4444/{name}.parquet", options=options))
        case = generator.MISTAKES[mistake](log, np.random.default_rng([place, 41]))
        assert names(inspect(case.log.to_recording())) & rivals == set(case.names), name


def test_an_axis_that_is_level_while_the_others_turn_is_not_dead():
    """The norm at rest changes by the biases of the others alone; with poses all around, what stays is dead."""
    recording = unit(1)[0]
    bias, angle = np.array([0.0, 1.3, -1.2]), np.repeat(np.linspace(0.0, 6.0, 25), 100)
    random = np.random.default_rng(2)
    around = 9.8 * np.stack([0 * angle, np.sin(angle), np.cos(angle)], axis=1)
    inside = np.repeat(random.uniform(0.2, 1.0, 25), 100)[:, None] * around
    for force, expected in ((around, set()), (inside, {"data.dead_axis"})):
        force = force + bias + 5e-3 * random.normal(size=force.shape)
        time = np.arange(len(force)) / 50.0
        log = replace(recording, accelerometer=Signal(time, force, "m/s^2"), gyroscope=None, temperature=None)
        assert names(inspect(log)) & {"data.dead_axis"} == expected


def test_measured_recordings_are_not_spoiled(data_folder):
    for path, options in measured(data_folder):
        spoiling = prepare(read_recording(path, options=options)).spoiling
        assert not spoiling, (path.name, [finding.text for finding in spoiling])


def test_bursts_of_a_measured_log_are_put_on_a_clock(data_folder):
    path = data_folder / "mpu6050_hmc5883l/full_sphere.parquet"
    ready = prepare(read_recording(path, options=ReadOptions(check=False)))
    assert "data.bursts" in names(ready.findings)
    interval = np.diff(ready.recording.accelerometer.time)
    assert np.median(interval) == pytest.approx(0.0101, rel=0.01)
    assert np.median(np.abs(interval / np.median(interval) - 1)) < 1e-6


@pytest.mark.parametrize("rate", RATES)
def test_stamps_of_a_logger_that_polls_are_evened_out(rate):
    case, clean = planted("polled", 3, rate), unit(3, rate)[0]
    ready = prepare(case.log.to_recording())
    (finding,) = ready.findings
    assert finding.name == "data.jitter" and "as a logger polls" in finding.text
    for name, signal in ready.signals.items():
        assert case.log.to_recording().signals[name].rate == pytest.approx(rate, rel=1e-4)
        late = signal.time - clean.signals[name].time
        assert np.ptp(late) < 0.05 / rate and 0 < late.mean() < 1 / rate


@pytest.mark.parametrize("every", [2, 5])
@pytest.mark.parametrize("order", [1, -1])
def test_a_rate_that_changes_is_no_jitter(every, order):
    """From a third of the log on, or up to it, every second or fifth sample alone is there."""
    log = generator.Log.of(unit(3)[0])
    count, third = len(log.time), len(log.time) // 3
    kept = np.concatenate([np.arange(third), np.arange(third, count, every)])
    kept = kept if order == 1 else count - 1 - kept[::-1]
    (finding, *others) = inspect(log.rows(kept).to_recording())
    assert finding.name == "data.rate_change" and not finding.spoils
    assert names(others) <= {"data.rate_change", "data.spikes"}


def test_a_single_late_stamp_is_no_gap():
    log = generator.Log.of(unit(3)[0])
    time = log.time.copy()
    time[5000] += 0.9 * log.period
    assert not inspect(replace(log, time=time).to_recording())


def test_gaps_of_a_polled_log_stay_gaps():
    log = planted("polled", 3).log
    kept = np.delete(np.arange(log.count), np.r_[3000:3400, 7000:7003, 9000])
    ready = prepare(log.rows(kept).to_recording())
    (gaps, *_) = [finding for finding in ready.findings if finding.name == "data.gap"]
    assert "3 gaps, 404 samples missing" in gaps.text
    missing = np.diff(ready.recording.accelerometer.time) / log.period - 1
    np.testing.assert_allclose(missing[[2999, 6599, 9000 - 404]], [400, 3, 1], atol=0.01)
    assert np.sum(missing > 0.5) == 3


def test_samples_that_were_taken_at_jittering_stamps_keep_them():
    log = generator.Log.of(unit(3)[0])
    time = log.time + np.clip(np.random.default_rng(3).normal(0, 0.2, log.count), -0.45, 0.45) * log.period
    taken = {name: scipy.interpolate.CubicSpline(log.time, getattr(log, name))(time) for name in ("accel", "gyro")}
    ready = prepare(replace(log, time=time, **taken).to_recording())
    assert names(ready.findings) == {"data.jitter"}
    np.testing.assert_array_equal(ready.recording.accelerometer.time, time)


# --- left out and repaired


def test_bridging_three_samples_costs_less_than_the_noise():
    for seed, rate in enumerate(RATES):
        case = planted("spikes", seed, rate)
        clean = generator.Log.of(unit(seed, rate)[0])
        fixed = prepare(case.log.to_recording()).recording.gyroscope
        assert fixed is not None and len(fixed) == clean.count
        error = np.linalg.norm(fixed.values - clean.gyro, axis=1) * clean.period
        assert error.max() < 2e-4  # rad; the noise of a turn is 1e-4


@pytest.mark.parametrize(
    "name",
    ["zero_rows", "spikes", "wrap_around", "lost_1_percent", "bursts", "jitter", "polled", "high_passed", "held"],
)
def test_parameters_are_right_once_repaired(name):
    """Gains; biases drift, and a filter that takes the mean takes the bias. A clean unit's are off by as much."""
    for seed in (0, 2):
        case, (clean, truth) = planted(name, seed), unit(seed)
        whole, found = calibrate(clean, GRAVITY), calibrate(case.log.to_recording(), GRAVITY, repair=True)
        for triad, gain in (("accelerometer", truth.accel_gain), ("gyroscope", truth.gyro_gain)):
            sigma = np.maximum(found.sigma(triad)[0], 1e-12)
            off = np.abs(np.asarray(found.triads()[triad].gain) - gain) / sigma
            usual = np.abs(np.asarray(whole.triads()[triad].gain) - gain) / np.maximum(whole.sigma(triad)[0], 1e-12)
            assert np.max(off) < max(3.5, np.max(usual) + 1), (seed, triad, off)


def test_values_change_with_repair_alone():
    case = planted("wrap_around", 0)
    recording = case.log.to_recording()
    left, fixed = prepare(recording), prepare(recording, repair=True)
    assert left.recording.gyroscope is not None and fixed.recording.gyroscope is not None
    assert set(left.recording.gyroscope.values.ravel()) <= set(case.log.gyro.ravel())
    assert len(fixed.recording.gyroscope) == case.log.count
    (finding,) = [each for each in fixed.findings if each.name == "data.wrap"]
    assert finding.text.endswith("This was repaired.")


def test_what_is_refused_says_why():
    for name, said in (("normalised", "directions, not forces"), ("copied_axis", "one of the two was not recorded")):
        with pytest.raises(InputError, match=said):
            calibrate(planted(name, 2).log.to_recording(), GRAVITY)


# --- in a diagnosis


@pytest.mark.parametrize("triad", ["accelerometer", "gyroscope"])
def test_a_sensor_that_never_changes_is_refused_by_name(triad):
    recording = unit(1)[0]
    signal = getattr(recording, triad)
    dead = replace(recording, **{triad: replace(signal, values=np.full_like(signal.values, 0.5))})
    with pytest.raises(InputError, match=rf"{triad}: every row reads 0\.5, 0\.5, 0\.5"):
        calibrate(dead, GRAVITY)


def test_a_gyroscope_that_reads_zero_at_rest_is_named():
    recording = unit(1)[0]
    signal = recording.gyroscope
    assert signal is not None
    silent = np.where(np.abs(signal.values) < 0.05, 0.0, signal.values)
    found = diagnose(replace(recording, gyroscope=replace(signal, values=silent)), GRAVITY)
    assert "data.auto_zero" in {each.name for each in found.preflight} and not found.effects
    assert "zeroes it at rest" in found.summary().verdict[0]


def test_no_effect_is_named_while_a_mistake_stands():
    recording = planted("lost_5_percent", 1).log.to_recording()
    standing = diagnose(recording, GRAVITY)
    assert standing.verdict == "unexplained"
    assert not standing.effects
    assert "--repair" in standing.suggestion
    assert "No effect can be named" in standing.summary().verdict[0]


@pytest.mark.parametrize("name", ["zero_rows", "wrap_around", "jitter", "polled"])
def test_a_mistake_that_is_gone_leaves_the_verdict_adequate(name):
    case = planted(name, 0)
    found = diagnose(case.log.to_recording(), GRAVITY, repair=True)
    assert found.verdict == "adequate", found.summary().verdict[0]
    assert names(found.preflight) & set(case.names)


def test_command_with_repair(tmp_path, capsys):
    log = planted("wrap_around", 0).log.write(tmp_path / "log.csv")
    assert main(["calibrate", str(log), "--repair", "--json"]) == 0
    notes = json.loads(capsys.readouterr().out)["fit"]["notes"]
    assert any("This was repaired" in note for note in notes)
    assert main(["info", str(log), "--json"]) == 0
    assert "--repair adds the range back" in capsys.readouterr().out


# --- what the fit shows


def of_the_fit(recording: Recording):
    """The calibration of a recording without what its samples alone show, and what its fit says of them."""
    return calibrate_ready([recording], Choices(GRAVITY))


def by_hand(folder, unit_number: int) -> generator.Log:
    options = ReadOptions(columns="accel [m/s^2],gyro [rad/s]", rate=100)
    return generator.Log.of(read_recording(folder / f"mikoff_mpu9150/imu{unit_number}.log", options=options))


def without(log: generator.Log, start: float, seconds: float) -> generator.Log:
    """The log without the samples of a stretch, stamped as if none were missing."""
    return generator.renumbered(log, np.flatnonzero((log.time < start) | (log.time >= start + seconds)))


def middle_of_a_turn(log: generator.Log) -> float:
    """Somewhere in the middle of the recording where it turns quickly."""
    rate = np.linalg.norm(log.gyro, axis=1)
    part = slice(log.count // 3, 2 * log.count // 3)
    return float(log.time[part][np.argmax(rate[part])])


def told_turn(text: str) -> tuple[float, float, float, float]:
    """First and last time of the turn, the time that is missing, and where."""
    number = r"([\d.]+)"
    found = re.search(rf"between {number} and {number} s .* about {number} s were missing at {number} s", text)
    assert found is not None, text
    first, last, missing, place = map(float, found.groups())
    return first, last, missing, place


@pytest.mark.parametrize("seconds", [0.1, 0.3])
def test_the_fit_tells_a_lost_stretch_with_its_turn_and_time(seconds):
    log = generator.Log.of(unit(3)[0])
    place = middle_of_a_turn(log)
    found, told = of_the_fit(without(log, place, seconds).to_recording())
    (lost,) = told
    assert lost.name == "data.lost_samples" and not lost.spoils
    first, last, missing, at = told_turn(lost.text)
    assert first < place < last + seconds and at == pytest.approx(place, abs=0.03)
    assert missing == pytest.approx(seconds, rel=0.4)  # from the rates at its ends alone
    assert found.observations is not None and int(np.sum(found.observations.turns.mask)) == 22  # of 23
    whole = of_the_fit(log.to_recording())[0]
    for triad in ("accelerometer", "gyroscope"):
        off = np.asarray(found.triads()[triad].gain) - np.asarray(whole.triads()[triad].gain)
        assert np.max(np.abs(off)) < 3e-4


def test_a_lost_stretch_of_a_measured_turn_is_told_and_left_out(data_folder):
    log = by_hand(data_folder, 0)
    place = 98.6
    recording = without(log, place, 0.2).to_recording()
    assert "data.lost_samples" not in names(inspect(recording))  # hands shake: the samples alone do not show it
    found = calibrate(recording, GRAVITY)
    (text,) = (note for note in found.notes if "lost" in note)
    first, last, missing, at = told_turn(text)
    assert first < place < last + 0.2 and at == pytest.approx(place, abs=0.05)
    assert 0.1 < missing < 0.4
    whole = calibrate(log.to_recording(), GRAVITY)
    assert found.rms["gravity_direction"][1] < 1.2 * whole.rms["gravity_direction"][1]


def test_samples_lost_everywhere_show_in_how_turns_scatter():
    case = planted("lost_1_percent", 4)
    (lost,) = of_the_fit(case.log.to_recording())[1]
    assert lost.name == "data.lost_samples" and lost.spoils
    share = re.search(r"about ([\d.]+) % of the samples", lost.text)
    assert share is not None and 0.3 < float(share.group(1)) < 2.5


def test_samples_lost_everywhere_in_a_measured_recording_leave_it_unexplained(data_folder):
    log = by_hand(data_folder, 2)
    kept = np.random.default_rng(1).random(log.count) >= 0.03
    found = diagnose(generator.renumbered(log, np.flatnonzero(kept)).to_recording(), GRAVITY)
    assert found.verdict == "unexplained" and not found.effects
    assert "samples were lost" in found.summary().verdict[0]
    assert "data.lost_samples" in names(found.preflight)


@pytest.mark.parametrize("hidden_effect", [None, "gyro.asymmetry", "everyday.gyro_scale_jump", "gyro.g_sensitivity"])
def test_what_lost_nothing_is_not_said_to(hidden_effect):
    names_of = () if hidden_effect is None else (hidden_effect,)
    for seed in (0, 1):
        case = hidden.draw_case(700 + seed, names_of, poses=24)
        assert not of_the_fit(recording_of((case.with_size(10.0) if names_of else case).fit))[1]


def test_measured_recordings_that_lost_nothing_are_not_said_to(data_folder):
    for path, options in [*measured(data_folder)][1:-3:6]:
        told = of_the_fit(prepare(read_recording(path, options=options)).recording)[1]
        assert not names(told) & {"data.lost_samples", "data.saturation", "data.clipping"}, path


def test_a_range_that_two_axes_share_is_told_by_a_few_samples(data_folder):
    log = by_hand(data_folder, 0)
    peak = np.sort(np.abs(log.gyro).max(axis=0))[1]  # of the second axis
    clipped = replace(log, gyro=np.clip(log.gyro, -0.95 * peak, 0.95 * peak))
    (text,) = [finding.text for finding in inspect(clipped.to_recording()) if finding.name == "data.clipping"]
    assert re.match(r"gyroscope [xyz], [xyz]: ", text) and f"{np.degrees(0.95 * peak):.4g}" in text


def test_a_soft_limit_shows_in_the_turns(data_folder):
    log = by_hand(data_folder, 2)
    limit = 0.5 * np.max(np.abs(log.gyro))
    bent = replace(log, gyro=limit * np.tanh(log.gyro / limit)).to_recording()
    assert "data.saturation" not in names(inspect(bent))
    (told,) = of_the_fit(prepare(bent).recording)[1]
    assert told.name == "data.saturation" and told.spoils and told.rivals == ("gyro.cubic",)
    said = re.search(r"limit of about ([\d.]+) °/s", told.text)
    assert said is not None and float(said.group(1)) == pytest.approx(np.degrees(limit), rel=0.1)


# --- several at once


PAIRS = [("zero_rows", "wrap_around"), ("spikes", "clipped"), ("zero_rows", "lost_1_percent"), ("spikes", "bursts"),
         ("gap", "hum"), ("zero_rows", "normalised"), ("spikes", "low_passed")]  # fmt: skip


@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_two_mistakes_are_both_named(first, second):
    """The second is made first: rows that are no measurement come in at the end."""
    case = planted(second, 3)
    both = generator.MISTAKES[first](case.log, np.random.default_rng(9))
    found = names(inspect(both.log.to_recording()))
    assert found & set(case.names)
    assert found & set(both.names)


def test_three_mistakes_and_a_log_that_is_all_wrong_end_soon():
    case = planted("clipped", 1)
    for name in ("spikes", "zero_rows"):
        case = generator.MISTAKES[name](case.log, np.random.default_rng(3))
    assert {"data.clipping", "data.spikes", "data.zeros"} <= names(inspect(case.log.to_recording()))
    began = time.process_time()
    random = np.random.default_rng(0)
    stamps = np.sort(random.uniform(0, 200, 20000))
    noise = Recording(Signal(stamps, 30 * random.standard_cauchy((20000, 3)), "m/s^2"),
                      Signal(stamps, random.standard_cauchy((20000, 3)), "rad/s"))  # fmt: skip
    inspect(noise)
    assert time.process_time() - began < 10


def test_a_recording_of_fifty_thousand_rows_takes_little_time():
    recording, _ = unit(1, 200.0, 46)
    inspect(recording)
    assert len(recording.accelerometer) > 50_000
    times = []
    for _ in range(3):
        began = time.process_time()
        inspect(recording)
        times.append(time.process_time() - began)
    assert min(times) < 1.0  # 0.3 on a machine that does nothing else
    print(f"{min(times):.2f} s")
