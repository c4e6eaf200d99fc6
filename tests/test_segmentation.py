"""Poses and turns found in recordings, slow rotation told from rest, and failures that say why."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
from scipy.stats import binom
from simulated_person import GRAVITY as PERSON_GRAVITY
from simulated_person import Person
from synthetic import GRAVITY, POSES, recording, simulated, spread_directions, unit

from jaximu import calibrate
from jaximu.data import forces_and_angles
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.gravity import LocalGravity
from jaximu.ground.tracing import padded_size
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.model import Noise, White
from jaximu.recordings.readers import ReadOptions, read_recording
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.segmentation import SegmentationOptions, observed_poses, rest_statistics, segment
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld, RateTable
from jaximu.simulation.protocols.positions import directions

HORIZONTAL, VERTICAL = np.array([1.0, 0.5, 0.0]), np.array([0.0, 0.0, 1.0])


def check_found(log, rests, most=0.3):
    """Each true rest is found once, within it or nearly so, and little of it is lost."""
    found = segment(log).intervals
    assert len(found) == len(rests)
    np.testing.assert_array_less(rests[:, 0] - 0.1, found[:, 0])
    np.testing.assert_array_less(found[:, 1], rests[:, 1] + 0.1)
    assert np.abs(found - rests).max() < most
    return found


def inside(found, start, stop):
    """Seconds of the found intervals that lie between start and stop."""
    return float(np.clip(np.minimum(found[:, 1], stop) - np.maximum(found[:, 0], start), 0, None).sum())


@pytest.mark.parametrize("seed", range(3))
def test_finds_all_rests(seed):
    log, rests = recording(seed)
    check_found(log, rests)


@pytest.mark.parametrize(
    ("rates", "jitter"), [((100.0, 100.0), 0.0), ((50.0, 200.0), 0.0), ((104.0, 417.0), 0.4), ((25.0, 20.0), 0.2)]
)
def test_rates_and_stamps_may_differ(rates, jitter):
    log, rests = recording(4, rates=rates, jitter=jitter, rest=3.0, turn=2.0)
    check_found(log, rests, 0.3 if min(rates) > 40 else 0.6)
    data = observed_poses(segment(log), GRAVITY)
    assert int(data.poses.mask.sum()) == POSES
    assert int(data.turns.mask.sum()) == POSES - 1
    assert data.turns.output.shape[0] == data.poses.mask.shape[0] - 1
    # a turn's samples last as long as what lies between the poses
    between = np.asarray(data.poses.start[1:POSES] - data.poses.stop[: POSES - 1])
    np.testing.assert_allclose(np.asarray(data.turns.interval).sum(axis=1)[: POSES - 1], between, atol=2 / rates[1])


def test_observations_are_what_the_unit_felt():
    """Means, and turns carried by the true unit, agree with the truth within the stated noise."""
    log, rests = recording(6, poses=9)
    data = observed_poses(segment(log), GRAVITY)
    imu, up = unit(6), spread_directions(9, 6)
    truth = GRAVITY * up @ np.asarray(imu.accelerometer.gain).T + np.asarray(imu.accelerometer.bias)
    error = np.asarray(data.poses.accelerometer_mean)[:9] - truth
    white = np.linalg.solve(np.linalg.cholesky(np.asarray(data.poses.accelerometer_covariance)[:9]), error[..., None])
    assert 0.6 < np.mean(white**2) < 1.6
    rest = np.asarray(data.poses.gyroscope_mean)[:9] - np.asarray(imu.gyroscope.bias)
    white = np.linalg.solve(np.linalg.cholesky(np.asarray(data.poses.gyroscope_covariance)[:9]), rest[..., None])
    assert 0.6 < np.mean(white**2) < 1.6
    assert np.max(forces_and_angles(imu, data)[1]) < np.radians(0.1)
    np.testing.assert_array_equal(
        data.poses.accelerometer_mean[9:], np.tile([0, 0, GRAVITY], (len(data.poses.mask) - 9, 1))
    )
    np.testing.assert_allclose(np.linalg.norm(data.turns.basis, axis=-1), 1.0, atol=1e-12)
    across = np.einsum("tai,ti->ta", np.asarray(data.turns.basis)[:8], data.poses.accelerometer_mean[1:9])
    np.testing.assert_allclose(across, 0.0, atol=1e-10)
    assert rests.shape == (9, 2)


def test_covariance_of_the_mean_is_that_of_white_noise():
    log, _ = recording(7, rest=8.0, density=(4e-6, 2e-8))
    data = observed_poses(segment(log), GRAVITY)
    duration = np.asarray(data.poses.stop - data.poses.start)[:POSES]
    for covariance, density in (
        (data.poses.accelerometer_covariance, 4e-6),
        (data.poses.gyroscope_covariance, 2e-8),
    ):
        scaled = np.asarray(covariance)[:POSES] * duration[:, None, None] / density
        np.testing.assert_allclose(scaled, np.broadcast_to(np.eye(3), scaled.shape), atol=0.3)  # some 360 blocks
    np.testing.assert_allclose(np.asarray(data.turns.noise) / 2e-8, np.eye(3), atol=0.3)


@pytest.mark.parametrize("axis", [HORIZONTAL, VERTICAL], ids=["horizontal", "vertical"])
@pytest.mark.parametrize("degrees", [0.5, 1.0, 3.0])
def test_slow_rotation_is_not_rest(degrees, axis):
    """Smooth and slow: its variance is that of rest, only its mean rate and the drift of gravity tell."""
    slow = tuple((k, np.radians(degrees), axis, 1.0) for k in (3, 7))
    log, rests = recording(8, slow=slow, rest=2.5)
    found = segment(log).intervals
    for k in range(POSES):
        seconds = inside(found, rests[k, 0], rests[k, 0] + 2.5)
        assert seconds < 0.3 if k in (3, 7) else seconds > 1.9


@pytest.mark.parametrize(("degrees", "after"), [(0.15, 4), (0.15, 9), (1.0, 5), (1.0, 10)])
def test_a_step_of_the_gyroscope_is_no_slow_rotation(degrees, after):
    """It reads another rate in a minority of the rests, and gravity does not turn: all rests are kept."""
    log, rests = recording(8, rest=3.0)
    step = np.radians([degrees, 0.3 * degrees, 0.0]) * (log.gyroscope.time > rests[after, 1] + 0.5)[:, None]
    found = segment(replace(log, gyroscope=replace(log.gyroscope, values=log.gyroscope.values + step))).intervals
    assert len(found) == len(rests)
    assert np.abs(found - rests).max() < 0.3


@pytest.mark.parametrize("sway", [0.0, 0.003])
def test_the_means_of_a_swaying_unit_are_as_well_known_as_stated(sway):
    """Along gravity and across it: a tilt of 3 mrad moves the force by 30 mm/s² across gravity, 0.04 mm/s² along it."""
    log, _ = recording(6, poses=40, rest=4.0)
    random, time = np.random.default_rng(1), log.accelerometer.time
    frequency, phase = random.uniform(0.5, 1.5, (6, 3)), random.uniform(0, 2 * np.pi, (6, 3))
    tilt = sway / np.sqrt(3) * np.sin(2 * np.pi * frequency * time[:, None, None] + phase).sum(axis=1)
    values = log.accelerometer.values + np.cross(log.accelerometer.values, tilt)
    swaying = replace(log, accelerometer=replace(log.accelerometer, values=values))
    data = observed_poses(replace(segment(log), recording=swaying), GRAVITY)
    poses, imu, up = data.poses, unit(6), spread_directions(40, 6)
    truth = GRAVITY * up @ np.asarray(imu.accelerometer.gain).T + np.asarray(imu.accelerometer.bias)
    error, covariance = poses.accelerometer_mean[:40] - truth, poses.accelerometer_covariance[:40]
    along = np.einsum("pi,pi->p", up, error) / np.sqrt(np.einsum("pi,pij,pj->p", up, covariance, up))
    assert 0.6 < np.sqrt(np.mean(along**2)) < 1.5
    across = np.linalg.norm(error, axis=1) ** 2 / np.trace(covariance, axis1=1, axis2=2)
    assert 0.2 < np.sqrt(np.mean(across)) < 1.5


@pytest.mark.parametrize("axis", [HORIZONTAL, VERTICAL], ids=["horizontal", "vertical"])
@pytest.mark.parametrize("degrees", [0.5, 1.0, 3.0])
def test_slow_rotation_that_runs_into_rest(degrees, axis):
    """A unit that lies and then creeps, with no stir between: only the part at rest counts."""
    slow = tuple((k, np.radians(degrees), axis, 0.5) for k in (3, 7))
    log, rests = recording(9, slow=slow, rest=5.0)
    found = segment(log).intervals
    for k in (3, 7):
        assert inside(found, rests[k, 1], rests[k, 0] + 5.0) < 0.3
        assert inside(found, *rests[k]) > 1.5
    assert len(found) == POSES


def test_one_pose_is_not_enough():
    log, _ = recording(10, poses=1, rest=20.0)
    with pytest.raises(NotPossibleError, match="1 static pose found") as raised:
        segment(log)
    text = str(raised.value)
    assert "one orientation throughout" in text and "jaximu allan" in text and "nine orientations" in text


def test_never_still():
    time = np.arange(3000) / 100.0
    random = np.random.default_rng(0)
    rate = 1.5 * np.stack([np.sin(3.1 * time), np.cos(2.3 * time), np.sin(1.7 * time)], 1)
    force = GRAVITY * np.stack([np.sin(time), np.cos(time) * 0.6, np.cos(time) * 0.8], 1)
    log = Recording(
        Signal(time, force + 0.3 * random.standard_normal(force.shape) * (1 + np.sin(5 * time))[:, None], "m/s^2"),
        Signal(time, rate + 0.01 * random.standard_normal(rate.shape), "rad/s"),
    )
    with pytest.raises(NotPossibleError, match="0 static poses found"):
        segment(log)


def test_too_short():
    log, _ = recording(10, poses=1, rest=0.3)
    with pytest.raises(NotPossibleError, match="too short"):
        segment(log)


LOW_NOISE = {
    "accelerometer": Noise((White(1e-3),), "specific_force"),
    "gyroscope": Noise((White(8.7e-5),), "angular_rate"),
}


def calibrated_behind(name, numerator, denominator, seeds):
    """Errors in sigmas of the gains' diagonals (n, 2, 3) where a filter acted on a sensor's samples."""
    off = []
    for seed in range(seeds):
        unit = draw_imu(seed)
        log, _ = simulate(unit, HandHeld(18, 3.0), LOW_NOISE, rate=100.0, seed=seed)
        signal = log.signals[name]
        late = scipy.signal.lfilter(numerator, denominator, signal.values - signal.values[0], axis=0) + signal.values[0]
        one = calibrate(replace(log, **{name: replace(signal, values=late)}), LocalGravity(STANDARD_GRAVITY, 0.0))
        gains = [
            (np.diagonal(found.gain), np.diagonal(unit.triad(sensor).gain), np.diagonal(one.sigma(sensor)[0]))
            for sensor, found in one.triads().items()
        ]
        off.append([(value - true) / sigma for value, true, sigma in gains])
    return np.array(off)


def test_what_a_lag_holds_back_belongs_to_the_turn():
    """What dies away after a turn passes as still before it is gone: all scales were 1.3 sigmas too small."""
    share = np.exp(-0.01 / 0.2)
    off = calibrated_behind("gyroscope", [1 - share], [1, -share], 5)[:, 1]
    assert off.mean() > -0.85 and np.sqrt(np.mean(off**2)) < 1.6


def test_an_accelerometer_that_is_averaged_does_not_lead_the_gyroscope_astray():
    off = calibrated_behind("accelerometer", np.full(50, 0.02), [1.0], 2)
    assert np.sqrt(np.mean(off**2)) < 1.6


@pytest.mark.parametrize("noise", [0.03, 0.1, 0.3, 1.0])
def test_the_mean_of_coarse_steps_is_no_better_than_its_interval(noise):
    """Where noise is a part of the step, a rest may lie within one, or flip between two at any share of the time."""
    step, off = np.radians(1.0), []
    intervals = 4.0 * np.arange(20)[:, None] + [0.05, 2.9]
    time = np.arange(20 * 400) / 100
    turning = (time % 4.0 > 3.0)[:, None] * 0.5
    for seed in range(40):
        rng = np.random.default_rng(seed)
        bias = rng.uniform(-0.05, 0.05, 3)
        values = bias + (noise * step + turning) * rng.standard_normal((len(time), 3))
        signal = Signal(time, np.round(values / step) * step, "rad/s")
        _, mean, covariance = rest_statistics(signal, intervals, turning=True)
        weight = 1 / np.diagonal(covariance, axis1=1, axis2=2)
        off.append(((mean * weight).sum(axis=0) / weight.sum(axis=0) - bias) * np.sqrt(weight.sum(axis=0)))
    inside = int((np.abs(off) < 1.96).sum())
    assert inside >= binom.ppf(1e-4, 120, 0.95) and np.max(np.abs(off)) < 4.5


@pytest.mark.parametrize("quantum", [(0.04, 0.002), (0.15, 0.01)])
def test_quantised_output(quantum):
    """Steps of many times the noise: the output at rest is constant, its variance zero in most windows."""
    log, rests = recording(11, quantum=quantum, density=(1e-6, 1e-9))
    check_found(log, rests, 0.4)
    data = observed_poses(segment(log), GRAVITY)
    for covariance in (data.poses.accelerometer_covariance, data.poses.gyroscope_covariance):
        values = np.linalg.eigvalsh(np.asarray(covariance))
        assert np.all(values > 0)
        assert np.all(np.isfinite(values))


def test_output_without_noise():
    log, rests = recording(12, density=(0.0, 0.0))
    check_found(log, rests)


def gap(signal: Signal, start: float, stop: float) -> Signal:
    kept = (signal.time < start) | (signal.time > stop)
    return replace(signal, time=signal.time[kept], values=signal.values[kept])


def test_gaps():
    """A hole in a rest splits or shortens it; one in a turn costs the turn, not the poses."""
    log, rests = recording(13, rest=3.0)
    hole_in_turn = (rests[4, 1] + 0.4, rests[5, 0] - 0.4)
    hole_in_rest = (rests[8, 0] + 0.2, rests[8, 0] + 1.0)
    broken = replace(
        log,
        gyroscope=gap(gap(log.gyroscope, *hole_in_turn), *hole_in_rest),
        accelerometer=gap(log.accelerometer, *hole_in_rest),
    )
    result = segment(broken)
    assert inside(result.intervals, *hole_in_rest) < 0.1
    for k in range(POSES):
        assert inside(result.intervals, *rests[k]) > (1.4 if k == 8 else 2.6)
    data = observed_poses(result, GRAVITY)
    used = int(data.poses.mask.sum())
    assert used == POSES
    mask = np.asarray(data.turns.mask)[: used - 1]
    assert mask.tolist().count(False) in (1, 2)
    assert not mask[4]
    np.testing.assert_array_equal(data.turns.interval[4], 0.0)


def test_bursts_with_nothing_between_say_so():
    time = np.concatenate([k + np.arange(5) * 1e-3 for k in range(60)])
    values = np.random.default_rng(0).standard_normal((len(time), 3))
    log = Recording(Signal(time, values + [0, 0, GRAVITY], "m/s^2"), Signal(time, values, "rad/s"))
    with pytest.raises(NotPossibleError, match="gaps"):
        segment(log)


def test_without_a_gyroscope():
    log, rests = recording(14)
    alone = replace(log, gyroscope=None)
    found = segment(alone).intervals
    assert len(found) == len(rests)
    data = observed_poses(segment(alone), GRAVITY)
    assert not np.any(data.turns.mask)
    assert int(data.poses.mask.sum()) == POSES


def test_several_recordings_of_one_unit():
    """No turn leads from one recording to the next, and a bias that changed between power-ons is taken out."""
    first, _ = recording(15, poses=6)
    second, _ = recording(16, poses=7, imu=unit(15))
    moved = replace(second, gyroscope=replace(second.gyroscope, values=second.gyroscope.values + [0.01, -0.02, 0.005]))
    data = observed_poses([segment(first), segment(moved)], GRAVITY)
    assert int(data.poses.mask.sum()) == 13
    turns = np.asarray(data.turns.mask)
    assert turns[:12].tolist() == [True] * 5 + [False] + [True] * 6
    np.testing.assert_allclose(data.poses.gyroscope_mean[:13], np.tile(unit(15).gyroscope.bias, (13, 1)), atol=5e-4)
    assert np.max(forces_and_angles(unit(15), data)[1]) < np.radians(0.1)


def test_options():
    log, rests = recording(17, rest=1.2)
    assert len(segment(log, SegmentationOptions(minimum_duration=0.6)).intervals) == len(rests)
    with pytest.raises(NotPossibleError):
        segment(log, SegmentationOptions(minimum_duration=2.0))
    fixed = segment(log, SegmentationOptions(threshold=6.0, minimum_duration=0.6))
    assert fixed.threshold == 6.0
    assert len(fixed.tried) == 1
    assert fixed.table() == f"{len(rests)} at 6x"
    wide = observed_poses(segment(log, SegmentationOptions(minimum_duration=0.6)), GRAVITY, bucket=(32, 256))
    assert wide.turns.output.shape == (31, 256, 3)


def test_axes_are_padded_to_few_sizes():
    sizes = np.arange(1, 5000)
    padded = np.array([padded_size(int(size)) for size in sizes])
    assert np.all(padded >= sizes) and np.all(padded[7:] <= 1.5 * sizes[7:])
    assert np.all(np.diff(padded) >= 0) and len(np.unique(padded)) <= 32
    assert np.all(np.unique(padded[63:]) % 32 == 0)  # what is computed 32 together leaves no remainder


def test_shapes_are_bucketed():
    shapes = set()
    for poses in (9, 10, 11, 12):
        log, _ = recording(18, poses=poses)
        shapes.add(observed_poses(segment(log), GRAVITY).turns.output.shape)
    assert len(shapes) == 1
    assert simulated(18).observations.turns.output.shape[0] == POSES - 1


def test_measured_recording(data_folder):
    """imu_tk's Xsens recording: 37 or more poses held by hand; imu_tk finds some 40 at its best threshold."""
    folder, options = data_folder / "imu_tk_xsens", ReadOptions(
        columns="time [s],accel [count],gyro [count]", accel_offset="32768", gyro_scale="6258 count/(rad/s)",
        gravity=LocalGravity(9.81744, 0.0),
    )  # fmt: skip
    log = read_recording(folder / "xsens_acc.mat", folder / "xsens_gyro.mat", options)
    result = segment(log)
    assert 37 <= len(result.intervals) <= 42
    assert len(result.tried) > 5
    durations = np.diff(result.intervals, axis=1)
    assert durations.min() > 0.8
    time, force = log.accelerometer.time, log.accelerometer.si()
    for start, stop in result.intervals:
        assert np.linalg.norm(force[(time >= start) & (time < stop)].std(axis=0)) < 0.1


def test_the_same_orientation_again_and_again():
    """A rate table comes to rest many times with the same axis up: found, though it shows few orientations."""
    recording, truth = simulate(draw_imu(1), RateTable((40.0, 90.0), 1.0, 3.0), consumer_noise(), seed=1)
    found = segment(recording)
    assert len(found.intervals) == len(truth.intervals) == 15
    np.testing.assert_allclose(found.intervals, truth.intervals, atol=0.6)


def test_a_trembling_hand_widens_no_interval_and_hides_no_motion():
    """Trembling averages out over a pose, and what a turn's first moments hide in it is not lost to the gain.

    Numbers are of 27 elements of the gyroscope's gain; errors of 1.6 of the stated are what one sees where poses reach
    into turns, and intervals 25 times as wide as a steady hand's where trembling passes for white noise.
    """
    errors, stated = [], []
    for seed, tremble in ((100, 0.1), (101, 0.1), (110, 0.1), (100, 0.0)):
        person = Person(seed, careless=0.0, tremble=tremble)
        for up, _ in directions(24):
            person.pose(up)
        found = calibrate(person.recording(), LocalGravity(PERSON_GRAVITY, 0.0))
        stated.append(found.sigma("gyroscope")[0])
        errors.append((np.asarray(found.imu.gyroscope.gain) - person.gains[1]) / stated[-1])
    assert np.sqrt(np.mean(np.square(errors[:3]))) < 1.35
    assert np.median(stated[:3]) < 6 * np.median(stated[3])


@pytest.mark.parametrize("band", [(0.6, 3.0), (6.0, 12.0)])
def test_a_hand_that_sways_is_not_white_noise(band):
    """Its angle stays within bounds: stated variances of mean rates are those of draws, and turns have the white."""
    rng, rate, seconds, white, size = np.random.default_rng(3), 100.0, 4.0, 1e-4, 1e-3
    count = int(300 * (seconds + 1) * rate)
    shape = scipy.signal.butter(2, band, "bandpass", fs=rate, output="sos")
    angle = scipy.signal.sosfilt(shape, rng.standard_normal((count, 3)), axis=0)
    angle *= size / np.std(angle)
    values = np.diff(angle, axis=0, prepend=angle[:1]) * rate + white * np.sqrt(rate) * rng.standard_normal((count, 3))
    signal = Signal(np.arange(count) / rate, values, "rad/s")
    start = np.arange(300) * (seconds + 1)
    density, means, covariance = rest_statistics(signal, np.stack([start, start + seconds], axis=1), turning=True)
    ratio = np.mean(means**2, axis=0) / np.diagonal(covariance, axis1=1, axis2=2).mean(axis=0)
    np.testing.assert_allclose(ratio, 1.0, atol=0.35)
    assert np.all(np.diagonal(density) < 0.5 * (np.mean(means**2, axis=0) * seconds))
