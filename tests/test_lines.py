"""Spectral lines that are followed through time: simulated chirps of known course, noise, and a measured board."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy
from simulated_board import board

from jaximu import ReadOptions, diagnose, read_recording
from jaximu.calibration.recipe import calibrate
from jaximu.diagnosis.attribution import attributed_lines
from jaximu.diagnosis.lines import MOVING_LINE, MovingLine, coincident, line_findings, moving_lines
from jaximu.noise.lines import SpectralLine, follow, swing, windows_at_rest
from jaximu.report.html import write_report

RATE, DURATION = 50.0, 200.0
TIME = np.arange(int(RATE * DURATION)) / RATE
RESTS = np.stack([np.arange(0, 190.0, 10), np.arange(8.4, 198.4, 10)], axis=1)
FIRST, WIDTH = windows_at_rest(TIME, RESTS, RATE)
CENTRES = TIME[FIRST] + (WIDTH - 1) / 2 / RATE


def noise(seed, flicker=0.0):
    """White noise of variance one, and flicker noise."""
    random = np.random.default_rng([seed, 77])
    frequency = np.maximum(np.fft.rfftfreq(2 * len(TIME), 1 / RATE), 1 / (2 * DURATION))
    shaped = np.fft.rfft(random.standard_normal(2 * len(TIME))) * flicker / np.sqrt(frequency)
    return random.standard_normal(len(TIME)) + np.fft.irfft(shaped)[: len(TIME)]


def course(start, stop):
    return start + (stop - start) / DURATION * TIME


def chirp(frequency, power):
    """A line of so many times the power of white noise in an ordinate."""
    size = np.sqrt(power * 4 * 0.375 / (WIDTH * 0.25))
    return size, size * np.cos(2 * np.pi * np.cumsum(frequency) / RATE)


def followed(values):
    return follow(values[FIRST[:, None] + np.arange(WIDTH)][:, :, None], CENTRES, RATE)


def recorded(frequency):
    return np.abs((frequency + RATE / 2) % RATE - RATE / 2)


@pytest.mark.parametrize("power", [8.0, 40.0, 1000.0])
@pytest.mark.parametrize(("start", "stop"), [(5.0, 7.0), (-3.0, 4.0), (22.0, 28.0), (14.0, 9.0)])
def test_a_chirp_is_followed_where_it_folds_as_well(start, stop, power):
    frequency = course(start, stop)
    size, wave = chirp(frequency, power)
    (line,) = [line for line in followed(noise(3, 0.3) + wave) if line.moves]
    truth = recorded(np.interp(line.times, TIME, frequency))
    assert np.mean(line.visible) > 0.7
    assert np.max(np.abs(line.recorded - truth)[line.visible]) < 2 * line.resolution
    assert 0.8 < line.size / size < 1.2
    for share, at in ((0.0, 0.0), (0.5, RATE / 2)):
        expected = [np.interp(at, frequency, TIME)] if start < at < stop else []
        assert line.folds(share) == pytest.approx(expected, abs=10)
    assert line.slow == (start < 0)


@pytest.mark.parametrize("power", [8.0, 1000.0])
def test_a_constant_line_does_not_move(power):
    lines = followed(noise(4, 0.3) + chirp(course(9.3, 9.3), power)[1])
    assert len(lines) == 1 and not lines[0].moves
    assert np.all(np.abs(lines[0].frequency - 9.3) < 2 * lines[0].resolution)


def test_two_lines_that_cross_are_two():
    first, second = course(4.0, 9.0), course(16.0, 14.0)
    lines = followed(noise(5) + chirp(first, 60)[1] + chirp(second, 30)[1] + chirp(course(6.5, 6.5), 30)[1])
    moving = sorted((line for line in lines if line.moves), key=lambda line: np.median(line.frequency))
    assert len(moving) == 2 and len(lines) == 3
    for line, truth in zip(moving, (first, second), strict=True):
        off = np.abs(line.frequency - np.interp(line.times, TIME, truth))[line.visible]
        assert np.max(off) < 2 * line.resolution


@pytest.mark.parametrize("flicker", [0.0, 0.5, 3.0])
def test_noise_has_no_line_that_moves(flicker):
    """A line in noise has a probability of 1e-6 an axis; with none in so many, below 1e-3 an axis at odds of 1 in 7."""
    axes = 24
    moving = sum(any(line.moves for line in followed(noise(seed, flicker))) for seed in range(axes))
    assert moving == 0  # of 24 axes with probability 1e-6 each one may be: 2.4e-5
    assert scipy.stats.beta.ppf(0.95, moving + 1, axes - moving) < 0.12


def test_rounding_and_dead_axes_have_no_line():
    assert not followed(np.zeros(len(TIME)))
    assert not follow(np.zeros((3, 64, 3)), np.arange(3.0), RATE)
    assert len(windows_at_rest(TIME, np.zeros((0, 2)), RATE)[0]) == 0
    gap = np.where(TIME > 100.5, TIME + 1.0, TIME)
    assert len(windows_at_rest(gap, RESTS, RATE)[0]) < len(FIRST)


def test_what_a_line_adds_to_means_at_rest_is_taken_off_as_far_as_it_is_known():
    frequency = course(-1.5, 1.5)
    size, wave = chirp(frequency, 300)
    values = noise(6) + wave
    (line,) = [line for line in followed(values) if line.moves]
    truth, estimate, sigma = [], [], []
    for start, stop in np.searchsorted(TIME, RESTS):
        mean, variance = swing(values[start:stop], TIME[start:stop], line)
        truth.append(wave[start:stop].mean())
        estimate.append(mean)
        sigma.append(np.sqrt(variance + 1 / (stop - start)))
    truth, estimate = np.array(truth), np.array(estimate)
    assert np.std(truth - estimate) < 0.5 * np.std(truth)
    assert max(sigma) < size and np.argmax(sigma) in (8, 9, 10)


@pytest.fixture(scope="module")
def recording():
    """Twenty rests of 20 s, and a line of the gyroscope that crosses zero frequency."""
    silent = board(1, 1, 1, {}, [], poses=20, rest=20.0, walk=2e-6)[0]
    signal = silent.gyroscope
    values, drift = signal.values.copy(), 2.0 / signal.time[-1]
    values[:, 1] += 3e-3 * signal.nominal_scale[1] * np.cos(2 * np.pi * (drift * signal.time**2 / 2 - signal.time))
    return replace(silent, gyroscope=replace(signal, values=values))


def test_a_line_through_zero_is_named_and_no_drift(recording, tmp_path):
    diagnosis = diagnose(recording)
    (line,) = diagnosis.lines
    assert line.axis == "gyroscope y" and line.line.size == pytest.approx(3e-3, rel=0.2)
    assert not any(effect.name.startswith("gyro.") for effect in diagnosis.effects)
    (finding,) = [entry for entry in diagnosis.document()["preflight"] if entry["name"] == MOVING_LINE]
    assert "crosses zero frequency at t = 2" in finding["text"] and "taken off" in finding["text"]
    assert json.loads(diagnosis.text())["preflight"]
    text = write_report(diagnosis, tmp_path).read_text(encoding="utf-8")
    assert "Lines that move" in text and (tmp_path / "lines.png").is_file()


def measured(folder, name):
    options = ReadOptions(accel_scale="2048 count/g", gyro_scale="16.4 count/(deg/s)")
    return calibrate(read_recording(folder / f"mimu4444/{name}.parquet", options=options)).segmentations


def test_lines_of_a_measured_board(data_folder):
    """Read off spectrograms: y drifts from 4 Hz to zero towards the end, z from 13 to 14.5 Hz."""
    parts = measured(data_folder, "unit1_session1")
    lines = {line.axis: line for line in moving_lines(parts)}
    assert set(lines) == {"gyroscope y", "gyroscope z"}
    (zero,) = lines["gyroscope y"].line.folds(0.0)
    assert 330 < zero < 420
    shown = lines["gyroscope z"].line.recorded
    assert shown[0] == pytest.approx(12.9, abs=0.3) and shown[-1] == pytest.approx(14.5, abs=0.3)
    assert "crosses zero frequency" in line_findings([lines["gyroscope y"]], parts)[0].text
    second = [replace(line, recording=1) for line in lines.values()]  # of two recordings that are diagnosed together
    texts = [finding.text for finding in line_findings([*lines.values(), *second], [parts[0], parts[0]])]
    assert len(texts) == 4 and all(text.startswith("In unit1_session1.parquet: gyroscope ") for text in texts)


@pytest.mark.parametrize(
    ("frequency", "words"),
    [
        ([18.9, 18.5, 18.88], "wanders between 18.5 and 18.9 Hz"),
        ([0.8, -0.4, -0.85], "wanders between 0.0 and 0.9 Hz, crosses zero frequency at t = "),
        ([12.80, 13.5, 14.52], "moves from 12.8 to 14.5 Hz"),
    ],
)
def test_a_line_that_comes_back_does_not_move_from_a_frequency_to_itself(frequency, words):
    times = np.linspace(0.0, 100.0, 41)
    course = np.interp(times, [0, 50, 100], frequency)
    line = SpectralLine(2, times, course, np.ones(41, bool), 1e-3, 60.0, 0.1, 90.0, 0.0)
    assert words in MovingLine(0, "gyroscope", line).words


def test_a_quiet_unit_of_the_board_has_no_line_that_moves(data_folder):
    assert not moving_lines(measured(data_folder, "unit6_session1"))


def part(unit, session, *courses):
    """A recording's lines, of which attribution asks no more; each from one frequency to another."""
    times = np.linspace(0.0, 100.0, 20)
    return SimpleNamespace(
        unit=unit,
        session=session,
        place=f"unit {unit} in session {session}",
        lines=tuple(
            MovingLine(
                0,
                "gyroscope",
                SpectralLine(2, times, np.linspace(*ends, 20), np.ones(20, bool), 1e-3, 60.0, 0.1, 90.0, 0.0),
            )
            for ends in courses
        ),
    )


def test_lines_go_to_the_unit_to_the_session_or_to_neither():
    parts = [part(unit, session) for unit in "1234" for session in "123"]
    for session, shift in zip("123", (0.0, 0.3, -0.2), strict=True):
        parts.append(part("5", session, (12.0 + shift, 13.0 + shift)))
    parts += [part(unit, "4", (20.0, 24.0 + 0.05 * int(unit))) for unit in "1234"]
    parts.append(part("6", "1", (3.0, 5.0)))
    (own, common), apart = attributed_lines(parts, 0.05)
    assert (own.belongs_to, own.units, own.sessions) == ("unit", ("5",), ("1", "2", "3"))
    assert (common.belongs_to, common.units, common.sessions) == ("session", ("1", "2", "3", "4"), ("4",))
    assert own.p_value < 0.05 and sorted(own.values["5"]) == pytest.approx([12.3, 12.5, 12.8]) and own.unit == "Hz"
    assert apart == {MOVING_LINE: ["unit 6 in session 1"]}


def test_lines_anywhere_coincide_by_chance_as_often_as_stated():
    random, wrong, trials = np.random.default_rng(54), 0, 400
    for _ in range(trials):
        group, p_value = coincident(list("112344"), random.uniform(0, 30, (6, 1)), 30.0)
        wrong += p_value < 0.05
        assert len(group) != 1
    assert scipy.stats.binom.sf(wrong - 1, trials, 0.05) > 1e-3


def test_a_hand_that_sways_in_some_poses_is_no_line_that_moves(data_folder):
    options = ReadOptions(columns="accel [m/s^2],gyro [rad/s]", rate=100)
    for unit in range(3):
        recording = read_recording(data_folder / f"mikoff_mpu9150/imu{unit}.log", options=options)
        assert not moving_lines(calibrate(recording).segmentations)
