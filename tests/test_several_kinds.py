"""Recordings of several kinds in one fit: each tells what the others do not, and truth stays within the intervals."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from test_reference import GRAVITY, moved, reference_of, unit_of

import jaximu
from jaximu.calibration import calibrate_against_attitude
from jaximu.data import RecordedStations
from jaximu.data.observe_stations import scheme_stations
from jaximu.data.stations import KnownStations
from jaximu.model.effects import CATALOGUE
from jaximu.model.sensor import Imu, Triad
from jaximu.report.html import write_report
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import Environment, HandHeld, Positions

UNITS = 6
EXACT = jaximu.LocalGravity(9.80665, 0.0)


def errors(calibration, truth) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of all numbers of gain and bias (24,), and their standard deviations; zero where not fitted."""
    off, sigmas = [], []
    for triad, model in calibration.triads().items():
        gain, bias = calibration.sigma(triad)
        true = truth.triads()[triad]
        off += [np.where(gain > 0, model.gain - true.gain, 0.0).ravel(), model.bias - true.bias]
        sigmas += [gain.ravel(), bias]
    return np.concatenate(off), np.concatenate(sigmas)


def scores(calibration, truth) -> np.ndarray:
    """Return the errors of the fitted numbers over their standard deviations."""
    off, sigma = errors(calibration, truth)
    return off[sigma > 0] / sigma[sigma > 0]


@pytest.fixture(scope="module")
def by_hand_and_on_a_table():
    """Return for each unit its truth, and what is found by hand, on a table, and of both together."""
    found = []
    for seed in range(UNITS):
        truth = jax.tree.map(np.asarray, draw_imu(seed))
        log = simulate(truth, HandHeld(14, 2.0), consumer_noise(), rate=50.0, seed=seed)[0]
        turned, schedule = simulate(truth, Positions(12, 4.0, 2.0), consumer_noise(), rate=50.0, seed=50 + seed)
        table = RecordedStations.of(turned, schedule.schedule, EXACT)
        found.append((truth, *(jaximu.calibrate(given, EXACT) for given in (log, table, [log, table]))))
    return found


def test_poses_and_a_table_in_one_fit(by_hand_and_on_a_table):
    """The table fixes the frame, poses by hand sharpen the gains: no number is known less than by either alone."""
    whole, shares = [], []
    for truth, by_hand, table, both in by_hand_and_on_a_table:
        whole.append(scores(both, truth))
        sigma, of_table = errors(both, truth)[1], errors(table, truth)[1]
        assert np.all(sigma > 0) and both.rank == 24
        shares.append(sigma / of_table)
        assert {"gravity_norm", "specific_force"} <= set(both.rms)
        assert {file for file in both.rms} >= set(by_hand.rms)
    whole = np.concatenate(whole)
    assert np.abs(whole).max() < 4.5 and 0.8 < np.sqrt(np.mean(whole**2)) < 1.25
    assert np.max(shares) < 1.05 and np.median(shares) < 0.9


def test_data_alone_are_calibrated_and_wrong_ones_refused(tmp_path):
    log = simulate(draw_imu(0), HandHeld(14, 2.0), consumer_noise(), rate=50.0, seed=0)[0]
    data = jaximu.observe(log, EXACT)
    found, fitted = jaximu.calibrate(data, EXACT), jaximu.fit(Imu.nominal(), data)
    np.testing.assert_allclose(found.imu.accelerometer.gain, fitted.imu.accelerometer.gain, rtol=1e-12)
    assert found.method == "joint" and found.rank == 21
    with pytest.raises(jaximu.InputError, match=r"gravity of 9.80665 m/s² and 9.81"):
        jaximu.calibrate(data, 9.81)
    with pytest.raises(jaximu.InputError, match="several units"):
        jaximu.calibrate(jaximu.stack([data, data]), EXACT)
    with pytest.raises(jaximu.InputError, match="fitted jointly: leave the method 'two-step' out"):
        jaximu.calibrate([log, data], EXACT, method="two-step")
    with pytest.raises(jaximu.InputError, match="expected a recording"):
        jaximu.calibrate([data, "log.csv"], EXACT)
    with pytest.raises(jaximu.InputError, match="a start is for data of several kinds"):
        jaximu.calibrate(log, EXACT, start=Imu.nominal())
    with_field = replace(Imu.nominal(), magnetometer=Triad(np.eye(3), np.zeros(3), (), "magnetic_field", "uT"))
    with pytest.raises(jaximu.InputError, match="has a magnetometer"):
        jaximu.calibrate(data, EXACT, start=with_field)
    with pytest.raises(jaximu.InputError, match="without gyroscope"):
        jaximu.calibrate([jaximu.Recording(log.accelerometer), data], EXACT)
    with pytest.raises(jaximu.InputError, match="KnownStations cannot be fitted"):
        jaximu.calibrate(KnownStations(scheme_stations(Positions(6))), EXACT)
    half = replace(log, accelerometer=replace(log.accelerometer, values=log.accelerometer.values / 9.80665, unit="g"))
    table = RecordedStations(log, scheme_stations(Positions(6)))
    with pytest.raises(jaximu.InputError, match="different units or scales"):
        jaximu.calibrate([half, table], EXACT)
    two = jaximu.calibrate([log, data], EXACT)
    assert "Rate at rest 2" in str(two.summary())
    assert "Rate at rest 2" in write_report(two, tmp_path).read_text(encoding="utf-8")
    few = jaximu.observe(simulate(draw_imu(0), HandHeld(2, 2.0), consumer_noise(), rate=50.0, seed=0)[0], EXACT)
    with pytest.raises(jaximu.NotPossibleError, match="these data together leave"):
        jaximu.calibrate(few, EXACT)


def test_poses_and_optics_in_one_fit():
    """A short motion before cameras and a few poses by hand."""
    made = moved()
    triads = [
        Triad(np.array(made.truth[f"gain_{k}"]), np.array(made.truth[f"bias_{k}"]), (), quantity, unit)
        for k, quantity, unit in (("a", "specific_force", "m/s^2"), ("g", "angular_rate", "rad/s"))
    ]
    truth = Imu(*triads)
    place = Environment(gravity=GRAVITY.value)
    log = simulate(truth, HandHeld(14, 2.0), consumer_noise(), rate=50.0, seed=7, environment=place)[0]
    optics, measured = calibrate_against_attitude(unit_of(made), reference_of(made), GRAVITY)
    alone = jaximu.calibrate(log, GRAVITY)
    both = jaximu.calibrate([log, measured], GRAVITY, start=optics.imu)
    assert np.abs(scores(both, truth)).max() < 4.5 and 0.5 < np.sqrt(np.mean(scores(both, truth) ** 2)) < 1.6
    sigmas = [errors(each, truth)[1] for each in (both, optics, alone)]
    used = sigmas[0] > 0
    gain = sigmas[0][used] / np.minimum(sigmas[1], sigmas[2])[used]
    assert gain.max() < 1.05 and np.median(gain) < 0.9
    assert {effect.name for effect in both.imu.setup} == {effect.name for effect in optics.imu.setup}


def test_a_table_s_data_are_diagnosed_and_checked():
    """As recordings are: an effect is named, an older calibration holds or not, other axes are refused."""
    quadratic = CATALOGUE["accel.quadratic"](np.array([4e-4, -3e-4, 3e-4]))
    truth = jax.tree.map(np.asarray, draw_imu(3))

    def table(unit, seed):
        turned, schedule = simulate(unit, Positions(24, 4.0, 2.0), consumer_noise(), rate=50.0, seed=seed)
        return RecordedStations.of(turned, schedule.schedule, EXACT)

    known = jaximu.calibrate(table(truth, 1), EXACT)
    assert jaximu.check(known, table(truth, 2), EXACT).verdict == "valid"
    flawed = table(truth.with_effects(quadratic), 3)
    lacking = jaximu.check(known, flawed, EXACT)
    assert lacking.verdict == "effect" and lacking.data["poses"] == 24
    assert "accel.quadratic" in {name for cause in lacking.causes for name in (cause.name, *cause.rivals)}
    found = jaximu.diagnose(flawed, EXACT, candidates=["accel.quadratic", "gyro.quadratic"])
    assert [named.name for named in found.named] == ["accel.quadratic"]
    gyroscope = replace(truth.gyroscope, gain=truth.gyroscope.gain * np.array([[1.003], [1.0], [1.0]]))
    moved = jaximu.check(known, table(replace(truth, gyroscope=gyroscope), 4), EXACT)
    assert moved.verdict == "shifted" and [str(shift.parameter) for shift in moved.moved] == ["gyroscope.gain[0,0]"]
    log = simulate(truth, HandHeld(14, 2.0), consumer_noise(), rate=50.0, seed=5)[0]
    with pytest.raises(jaximu.InputError, match=r"gravity of 9.80665 m/s² and 9.81"):
        jaximu.check(known, flawed, 9.81)
    with pytest.raises(jaximu.InputError, match="data that hold their recordings"):
        jaximu.check(known, jaximu.observe(log, EXACT), EXACT)
    with pytest.raises(jaximu.NotPossibleError, match="Check a calibration that was made in the set-up"):
        jaximu.check(jaximu.calibrate(log, EXACT), flawed, EXACT)
