"""Several causes at once, causes that an option states, and combinations that hardly show: on simulated recordings."""

import numpy as np
import pytest

import jaximu
from jaximu.diagnosis.diagnosis import extended
from jaximu.model.effects import CATALOGUE
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld

EXACT = jaximu.LocalGravity(9.80665, 0.0)
SIGNS = np.array([1.0, -1.0, 1.0])
SENSITIVITY = CATALOGUE["gyro.g_sensitivity"](3e-4 * np.array([1.0, -0.4, 0.3, 0.2, -1.0, 0.4, -0.3, 0.5, 1.0]))
CURVED = CATALOGUE["accel.quadratic"](8e-5 * SIGNS)
EARTH = CATALOGUE["gyro.earth_rotation"](7.292115e-5 * np.array([0.3, 0.4, 0.866]))
"""At 60° north, in some heading."""


def recorded(*effects, seed=1, poses=40):
    unit = draw_imu(5).with_effects(*effects)
    return simulate(unit, HandHeld(poses, 4.0, 1.5, 2.0), consumer_noise(), rate=50.0, seed=seed)[0]


def names(diagnosis):
    return {effect.name for effect in diagnosis.effects}


@pytest.mark.parametrize(
    "third", [CATALOGUE["gyro.quadratic"](6e-4 * SIGNS), CATALOGUE["gyro.bias_ramp"](3e-6 * SIGNS)]
)
def test_three_strong_causes_are_named_together(third):
    """What the other two leave was taken for drift and unsteady hands, which hid the third."""
    found = jaximu.diagnose(recorded(SENSITIVITY, CURVED, third), EXACT)
    assert found.verdict == "effects" and names(found) == {SENSITIVITY.name, CURVED.name, third.name}


def test_a_strong_cause_is_named_where_something_weak_remains():
    """A curve of the other triad, by the same input, was taken for a sign that the cause is a guess."""
    strong = CATALOGUE[SENSITIVITY.name](1.5 * SENSITIVITY.coefficients)
    weak = CATALOGUE["accel.quadratic"](2.5e-5 * SIGNS)
    for seed in (1, 2, 3):
        found = jaximu.diagnose(recorded(strong, weak, seed=seed, poses=24), EXACT)
        assert SENSITIVITY.name in names(found)


def test_a_fit_that_leaves_much_has_intervals_for_its_biases(tmp_path):
    """The biases' reaction to the conditions lacked the fit's excess: variances came out negative, sigmas NaN."""
    found = jaximu.diagnose(recorded(SENSITIVITY, poses=24), EXACT)
    without = extended(found.calibration, found.experiment, found.base, found.noise)
    assert max(without.excess.values()) > 100
    for triad in ("accelerometer", "gyroscope"):
        during, after = without.bias_sigma_recording[triad], without.sigma(triad)[1]
        assert np.all(during > 0) and np.all(after > 0.5 * during)
    without.save(tmp_path / "calibration.json")


def test_the_earth_is_asked_for_its_latitude_and_then_taken_off():
    known = jaximu.LocalGravity(9.80665, 0.0, 60.0)
    first, second = recorded(EARTH), recorded(EARTH, seed=2)
    found = jaximu.diagnose(first, EXACT)
    assert "State --latitude" in found.suggestion and "g-sensitivity" in found.suggestion
    both = jaximu.diagnose([first, second], EXACT)
    assert names(both) == {"gyro.earth_rotation@1", "gyro.earth_rotation@2"}
    assert "State --latitude" in both.suggestion
    calibration = jaximu.calibrate(first, known)
    assert jaximu.check(calibration, second, EXACT).verdict == "session"
    assert jaximu.check(calibration, second, known).verdict == "valid"


def test_the_gain_of_ramps_in_two_recordings_is_no_power_on_offset():
    """The rate at rest that was left out kept the bias of its power-on, which the other rests tell."""
    ramps = [CATALOGUE["gyro.bias_ramp"](size * SIGNS) for size in (2e-5, -3e-5)]
    recordings = [recorded(ramp, seed=seed) for seed, ramp in enumerate(ramps)]
    gyroscope = recordings[1].gyroscope
    other = gyroscope.values + np.array([3e-3, -2e-3, 1e-3])
    moved = recordings[1].__class__(
        recordings[1].accelerometer, gyroscope.__class__(gyroscope.time, other, gyroscope.unit)
    )
    found = jaximu.diagnose([recordings[0], moved], EXACT)
    assert names(found) == {"gyro.bias_ramp@1", "gyro.bias_ramp@2"}
    before, after = found.gain.before.rms, found.gain.after.rms
    for kind in ("gravity_direction", "static_gyroscope"):
        assert after[kind][0] < 0.5 * before[kind][0]


def test_a_lag_of_all_axes_alike_is_said_to_hardly_show():
    late = CATALOGUE["gyro.lag"](np.full(3, 0.02))
    found = jaximu.diagnose(recorded(late), EXACT)
    (lag,) = (cause for cause in found.hidden if cause.name == "gyro.lag")
    weights, limit = lag.weakest
    np.testing.assert_allclose(weights, np.full(3, 3**-0.5), atol=0.1)
    assert found.verdict == "adequate" and lag.combination == "on all axes alike" and limit > 0.02 > 10 * lag.limit
    assert "on all axes alike, seen from" in " ".join(str(found.summary()).split())
    document = next(entry for entry in found.document()["hidden"] if entry["name"] == "gyro.lag")
    assert document["weakest"]["limit"] == limit


def test_a_step_is_no_guess_because_the_bias_drifts_besides():
    """Effects of nothing but time have no input in common with a curve over time."""
    made = recorded(CATALOGUE["accel.step"](0.02 * SIGNS, onset=70.0))
    force = made.accelerometer
    drift = 0.006 * np.sin(5 * np.pi * force.time / force.time[-1])[:, None] * np.array([1.0, 0.3, -0.6])
    drifting = made.__class__(force.__class__(force.time, force.values + drift, force.unit), made.gyroscope)
    assert names(jaximu.diagnose(drifting, EXACT)) == {"accel.step", "accel.learned_time"}
