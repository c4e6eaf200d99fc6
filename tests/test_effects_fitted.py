"""Any effect of the catalogue is fitted with gain and bias, and the calibration says what its own model determines."""

from dataclasses import replace

import numpy as np
import pytest

from jaximu.calibration import calibrate
from jaximu.cli import main
from jaximu.diagnosis import diagnose
from jaximu.effects import CATALOGUE
from jaximu.errors import InputError, NotPossibleError
from jaximu.formats import write_recording
from jaximu.gravity import LocalGravity
from jaximu.protocols import Environment, HandHeld
from jaximu.simulation import consumer_noise, draw_imu, simulate

GRAVITY = LocalGravity(9.80665, 0.0)
HIDDEN = CATALOGUE["accel.asymmetry"].make([2e-3, -1.5e-3, 1e-3])


@pytest.fixture(scope="module")
def recording():
    """A warming unit whose accelerometer has another gain for positive than for negative input."""
    warming = Environment(temperature=[[0, 22], [120, 34], [220, 27]])
    return simulate(draw_imu(3).with_effects(HIDDEN), HandHeld(), consumer_noise(), seed=3, environment=warming)[0]


@pytest.fixture(scope="module")
def fitted(recording):
    return calibrate(recording, GRAVITY, effects=["accel.asymmetry"])


def test_the_effect_comes_back_within_its_sigma(fitted):
    (effect,) = fitted.imu.accelerometer.effects
    document = fitted.document()["accelerometer"]["effects"]["accel.asymmetry"]
    z = (np.asarray(effect.coefficients) - np.asarray(HIDDEN.coefficients)) / np.array(document["sigma"])
    assert np.abs(z).max() < 4


def test_the_calibration_is_that_of_its_own_model(recording, fitted):
    """Rank, excess and rms of the model with the effect, not of the one without it."""
    plain = calibrate(recording, GRAVITY)
    assert plain.excess["accelerometer"] > 20
    assert fitted.excess["accelerometer"] < 1
    assert fitted.rank == len(fitted.names) == 24 and all(weak.determined for weak in fitted.weak)
    assert fitted.rms["gravity_norm"][1] < 0.2 * plain.rms["gravity_norm"][1]


def test_a_diagnosis_extends_to_the_same_calibration(recording, fitted):
    found = diagnose(recording, GRAVITY)
    assert [effect.name for effect in found.effects] == ["accel.asymmetry"]
    extended = found.extended_calibration()
    assert extended.names == fitted.names and extended.rank == 24
    assert max(extended.excess.values()) < 1
    shift = np.abs(extended.fit.values - fitted.fit.values) / np.sqrt(np.diag(fitted.covariance))
    assert shift.max() < 1.0  # noise from a model of the poses' scatter, there, and from each pose's own, here


def test_what_the_recording_does_not_determine_is_refused_or_held(recording):
    """At one temperature nothing depends on it; what is known beforehand is fitted all the same."""
    kept = replace(recording, temperature=replace(recording.temperature, values=0 * recording.temperature.values + 25))
    with pytest.raises(NotPossibleError, match=r"accel\.temperature cannot be .* Record a change of temperature"):
        calibrate(kept, GRAVITY, effects=["accel.temperature"])
    with pytest.raises(NotPossibleError, match="error of a set-up"):
        calibrate(recording, GRAVITY, effects=["setup.table_tilt"])
    held = calibrate(recording, GRAVITY, effects=["gyro.earth_rotation"], effect_sigmas={"gyro.earth_rotation": 1e-6})
    document = held.document()["gyroscope"]["effects"]["gyro.earth_rotation"]
    assert np.abs(document["coefficients"]).max() < 3e-6 and np.max(document["sigma"]) < 1.01e-6


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"effects": ["accel.nothing"]}, InputError, "unknown effect 'accel.nothing'"),
        ({"effects": ["accel.cubic"], "method": "two-step"}, InputError, "jointly"),
        ({"effects": ["accel.cubic"], "effect_sigmas": {"gyro.lag": 1.0}}, InputError, "not fitted"),
        ({"effects": ["accel.cubic"], "effect_sigmas": {"accel.cubic": 0.0}}, InputError, "greater than zero"),
    ],
)
def test_bad_requests_are_sentences(recording, options, error, words):
    with pytest.raises(error, match=words):
        calibrate(recording, GRAVITY, **options)


def test_command(recording, tmp_path, capsys):
    write_recording(recording, tmp_path / "log.parquet")
    log = str(tmp_path / "log.parquet")
    assert main(["calibrate", log, "--effect", "accel.asymmetry", "--gravity", "9.80665+-0"]) == 0
    assert "accel.asymmetry: 0.00" in capsys.readouterr().out
    assert main(["calibrate", log, "--effect", "accel.asymmetry+-much"]) == 2
    assert "'much' is not a number" in capsys.readouterr().err
