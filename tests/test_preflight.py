"""Defects planted in simulated recordings are found by name, axis and row; clean recordings give no finding."""

import numpy as np
import pytest
import scipy

from jaximu.ground.quantities import size
from jaximu.mistakes import inspect
from jaximu.mistakes.clipping import stops
from jaximu.recordings.recording import Recording, Signal
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.artefacts import Clipping, Dropped, Gap, Jitter, Periodic, QuantisedOutput, Repeated, StuckAxis
from jaximu.simulation.protocols import HandHeld, RateTable

G = 9.80665


def recording(seed=1, artefacts=(), poses=20, noise=True, rate=100.0):
    given = consumer_noise() if noise else None
    return simulate(draw_imu(seed), HandHeld(poses=poses), given, seed=seed, artefacts=artefacts, rate=rate)[0]


def names(found):
    return sorted({finding.name for finding in found})


def only(found, name):
    """The findings, all of which must have this name."""
    assert names(found) == [name], [finding.text for finding in found]
    return found


def still(force, rate):
    time = np.arange(len(force)) / 100
    return Recording(Signal(time, force, "m/s^2"), Signal(time, rate, "rad/s"))


# --- nothing planted -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "steps",
    [
        (None, None),
        (2 * G / 2**15, np.radians(250) / 2**15),
        (4 * G / 2**15, np.radians(500) / 2**15),
        (16 * G / 2**15, np.radians(2000) / 2**15),
    ],
)
def test_clean_recordings_give_no_finding(steps):
    for seed in range(6):
        found = inspect(recording(seed, [QuantisedOutput(*steps)], poses=12 + 2 * seed, rate=(100.0, 200.0)[seed % 2]))
        assert not found, (seed, [finding.text for finding in found])


def test_a_table_that_holds_its_highest_rate_is_not_clipped():
    table, _ = simulate(draw_imu(2), RateTable(), consumer_noise(), seed=2)
    assert not inspect(table)


def test_a_smooth_turn_without_noise_is_not_clipped():
    assert not [finding for finding in inspect(recording(noise=False)) if finding.name == "data.clipping"]


@pytest.mark.parametrize("share", [0.5, 1.0, 3.0])
def test_differences_of_a_rounded_angle_at_rest_are_not_clipped(share):
    """Few levels, the outer ones reached by all axes alike: they are the rarest."""
    random = np.random.default_rng(3)
    force = [0.0, 0.0, G] + 0.02 * random.standard_normal((20_000, 3))
    drift = np.arange(20_001)[:, None] * np.array([0.02, 0.3, -0.4])
    angle = np.round(np.cumsum(share * random.standard_normal((20_001, 3)) / 10, axis=0) + drift)
    assert "data.clipping" not in names(inspect(still(force, 0.01 * np.diff(angle, axis=0))))


# --- planted ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_gap(seed):
    found = only(inspect(recording(seed, [Gap(20.0, 22.0)])), "data.gap")
    assert [finding.text.split(":")[0] for finding in found] == ["accelerometer", "gyroscope"]
    for finding in found:
        assert finding.rows == (2001,)  # the first after the gap, counted from 1
        assert "200 samples" in finding.text


def test_rows_of_several_gaps_are_counted_in_the_rows_that_are_left():
    (found, _) = inspect(recording(1, [Gap(20.0, 22.0), Gap(30.0, 30.05), Gap(40.0, 43.0)]))
    assert found.rows == (2001, 2801, 3796)
    assert "505 samples" in found.text


def test_jitter():
    (found,) = only(inspect(recording(2, [Jitter(0.002)])), "data.jitter")  # once for both: they share their stamps
    assert "taken at even times" in found.text
    assert not inspect(recording(2, [Jitter(0.0001)]))


@pytest.mark.parametrize("axis", ["accel_x", "gyro_y", "gyro_z"])
def test_an_axis_stuck_for_a_while(axis):
    (finding,) = only(inspect(recording(3, [StuckAxis(axis, 20.0, 30.0)])), "data.stuck_axis")
    sensor = {"accel": "accelerometer", "gyro": "gyroscope"}[axis[:-2]]
    assert finding.text.startswith(f"{sensor} {axis[-1]}:")
    assert len(finding.rows) == 1
    assert abs(finding.rows[0] - 2001) <= 1


@pytest.mark.parametrize("start", [30.0, 0.0])
def test_an_axis_stuck_to_the_end(start):
    """It repeats its value for most of the recording, which must not pass for a coarse step."""
    found = inspect(recording(1, [StuckAxis("gyro_y", start)]))
    (finding,) = only(found, "data.stuck_axis")
    assert abs(finding.rows[0] - (100 * start + 1)) <= 1


@pytest.mark.parametrize("seed", range(3))
def test_clipping_of_the_gyroscope(seed):
    limit = 2.0
    clipped = recording(seed, [Clipping(gyroscope=limit)])
    (finding,) = [each for each in inspect(clipped) if "clipping" in each.name]
    axes, first, rows = [], [], []
    for axis, values in zip("xyz", clipped.gyroscope.values.T, strict=True):
        for sign in (1, -1):
            at = np.flatnonzero(values == sign * limit)
            runs = np.split(at, np.flatnonzero(np.diff(at) > 1) + 1)
            long = [int(run[0]) + 1 for run in runs if len(run) >= 3]
            if long:
                axes, first, rows = [*axes, axis], first + long, [*rows, at]
    assert finding.text.startswith(f"gyroscope {', '.join(dict.fromkeys(axes))}: {sum(map(len, rows))} samples")
    assert finding.rows == tuple(sorted(first)[:5])
    np.testing.assert_array_equal(finding.without["gyroscope"], np.unique(np.concatenate(rows)))


def test_clipping_is_seen_where_coarse_steps_hold_values_at_rest():
    random = np.random.default_rng(5)
    swing = 260 * np.sin(np.arange(4000) / 8.0)
    values = np.round(np.concatenate([1.2 * random.standard_normal(4000), swing]))
    cut = np.clip(values, -250, 250)
    assert len(stops(cut, 250.0)) > 50 and len(stops(cut, -250.0)) > 50
    assert not len(stops(values, values.max())) and not len(stops(values[:4000], values[:4000].max()))


@pytest.mark.parametrize("limit", [2.0, 0.5])
def test_clipping_is_not_said_to_be_a_stuck_axis_as_well(limit):
    """Nor where all axes are at their limits for a while."""
    found = names(inspect(recording(1, [Clipping(gyroscope=limit)])))
    assert "data.clipping" in found and "data.stuck_axis" not in found


def test_an_accelerometer_clipped_at_rest():
    """A range below one g clips whole poses: the value stands out by its repeats, not by its distance."""
    found = inspect(recording(1, [Clipping(accelerometer=9.6)]))
    (finding,) = only(found, "data.clipping")
    assert finding.text.startswith("accelerometer ") and "z" in finding.text.partition(":")[0]


@pytest.mark.parametrize("bits", [10, 12])
def test_coarse_steps_are_named_and_nothing_else(bits):
    step = 16 * G / 2 ** (bits - 1), np.radians(2000) / 2 ** (bits - 1)
    found = only(inspect(recording(1, [QuantisedOutput(*step)])), "data.quantisation")
    assert "accelerometer x, y, z" in {finding.text.split(":")[0] for finding in found}
    for finding in found:
        expected = size(step[0], "m/s^2") if finding.text.startswith("accelerometer") else size(step[1], "rad/s")
        assert f"step of {expected}" in finding.text


@pytest.mark.parametrize("share", [0.002, 0.01, 0.05])
def test_lost_samples_are_counted(share):
    """`Dropped` is reported as `data.gap`; what is lost one by one counts too."""
    whole, kept = recording(1), recording(1, [Dropped(share)])
    lost = len(whole.accelerometer) - len(kept.accelerometer)
    found = only(inspect(kept), "data.gap")
    said = [int(finding.text.split(" samples missing")[0].split()[-1]) for finding in found]
    assert len(said) == 2
    for each in said:
        assert abs(each - lost) <= 1  # the very ends cannot be seen


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_repeated_samples(share):
    """A logger quicker than the sensor repeats rows as a whole: `data.stuck_axis`, as the artefact says."""
    assert names(inspect(recording(1, [Repeated(share)]))) == ["data.stuck_axis"]


@pytest.mark.parametrize(
    ("axis", "amplitude", "frequency"), [("accel_z", 0.02, 17.3), ("gyro_x", 0.002, 31.0), ("gyro_y", 0.001, 48.0)]
)
def test_periodic(axis, amplitude, frequency):
    for seed in range(3):
        found = inspect(recording(seed, [Periodic(axis, amplitude, frequency)]))
        (finding,) = only(found, "data.periodic")
        assert finding.text.startswith({"a": "accelerometer ", "g": "gyroscope "}[axis[0]] + axis[-1])
        assert abs(float(finding.text.split("near ")[1].split()[0]) - frequency) < 0.4  # a bin of 256 samples
        shown = amplitude * (1e3 if axis.startswith("accel") else np.degrees(1.0))  # mm/s², °/s
        assert float(finding.text.split("about ")[1].split()[0]) == pytest.approx(shown, rel=0.25)


def test_a_hump_of_the_spectrum_is_no_line():
    """Rotors shake a frame over some hertz: the flank of that was called a line where its other side was not seen."""
    for seed in range(10):
        random = np.random.default_rng(seed)
        force, white, shaken = (random.standard_normal((3000, 3)) for _ in range(3))
        band = scipy.signal.butter(3, [3.5 / 32, 6.2 / 32], "bandpass", output="sos")
        hump = scipy.signal.sosfilt(band, shaken, axis=0)
        found = inspect(still([0, 0, 9.81] + 1e-2 * force, 3e-4 * white + 1e-3 * hump))
        assert not names(found)


# --- made by hand ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [2, 3, 15, 16, 17, 300])
def test_short_recordings(count):
    random = np.random.default_rng(count)
    assert not inspect(still(random.standard_normal((count, 3)), random.standard_normal((count, 3))))


@pytest.mark.parametrize("level", [0.0, 1.0, -9.8])
def test_constant_signals(level):
    """No axis moves: both sensors are silent, no axis is stuck against the others, and there is no line."""
    flat = np.full((8000, 3), level)
    found = inspect(still(flat, flat))
    assert [each.refuses for each in found] == ["accelerometer", "gyroscope"]
    assert all("every row reads" in each.text for each in found)


def test_one_constant_axis():
    random = np.random.default_rng(0)
    force = random.standard_normal((8000, 3))
    force[:, 2] = 0.0
    (finding,) = only(inspect(still(force, random.standard_normal((8000, 3)))), "data.stuck_axis")
    assert finding.text.startswith("accelerometer z")
    assert finding.rows == (1,)


@pytest.mark.parametrize("size", [1e-30, 1e30])
def test_huge_and_tiny_values(size):
    random = np.random.default_rng(0)
    assert not inspect(still(size * random.standard_normal((8000, 3)), random.standard_normal((8000, 3))))


def test_a_recording_without_a_gyroscope():
    random = np.random.default_rng(0)
    time = np.arange(8000) / 100
    assert not inspect(Recording(Signal(time, random.standard_normal((8000, 3)), "m/s^2")))


def test_findings_as_the_document_has_them():
    (finding, _) = inspect(recording(1, [Gap(20.0, 22.0)]))
    assert finding.document() == {"name": "data.gap", "rows": [2001], "text": finding.text}
