"""Any effect of the catalogue is fitted with gain and bias, and the calibration says what its own model determines."""

import re
from dataclasses import replace

import numpy as np
import pytest

from jaximu.calibration import calibrate, load_calibration
from jaximu.cli import main
from jaximu.diagnosis import diagnose
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import LocalGravity, wgs84_gravity
from jaximu.model.effects import CATALOGUE
from jaximu.model.effects.earth_rotation import EARTH_RATE
from jaximu.recordings import write_recording
from jaximu.recordings.segmentation import segment
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import Environment, HandHeld

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
    with pytest.raises(NotPossibleError, match=r"\(accel\.temperature\) cannot be .* Record a change of temperature"):
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
    assert re.search(r"accel\.asymmetry.* \d", capsys.readouterr().out)
    assert main(["calibrate", log, "--effect", "accel.asymmetry+-much"]) == 2
    assert "'much' is not a number" in capsys.readouterr().err


@pytest.fixture(scope="module")
def on_earth():
    """Forty poses at 48° north with a quiet gyroscope, and the unit."""
    unit, environment = draw_imu(8), Environment(latitude=48.0)
    return simulate(unit, HandHeld(poses=40), consumer_noise(), seed=8, environment=environment)[0], unit


def test_a_latitude_puts_the_earths_rotation_into_the_model(on_earth, tmp_path):
    """Its vertical part is known, its heading found; the gyroscope's bias is right with it."""
    recording, unit = on_earth
    found = calibrate(recording, wgs84_gravity(48.0))
    (earth,) = found.imu.gyroscope.effects
    assert earth.name == "gyro.earth_rotation"
    east, north, up = np.asarray(earth.coefficients)
    assert up == pytest.approx(EARTH_RATE * np.sin(np.radians(48.0)), rel=0.01)
    assert np.hypot(east, north) == pytest.approx(EARTH_RATE * np.cos(np.radians(48.0)), rel=0.5)
    bias, sigma = np.asarray(found.imu.gyroscope.bias), found.sigma("gyroscope")[1]
    assert np.abs((bias - np.asarray(unit.gyroscope.bias)) / sigma).max() < 4
    assert not any("earth_rotation" in weak.text for weak in found.weak)
    found.save(tmp_path / "calibration.json")
    assert load_calibration(tmp_path / "calibration.json").gravity.latitude == 48.0


def test_the_earths_rotation_is_no_finding_where_the_latitude_is_known(on_earth):
    recording, _ = on_earth
    known, unknown = (diagnose(recording, gravity)
                      for gravity in (wgs84_gravity(48.0), replace(wgs84_gravity(48.0), latitude=None)))  # fmt: skip
    assert known.verdict == "adequate"
    assert known.document()["not_observable"]["gyro.earth_rotation"] == "it is known, and taken off"
    assert [each.name for each in unknown.effects] == ["gyro.earth_rotation"]


def test_several_recordings_have_headings_of_their_own(on_earth, tmp_path):
    """Each has the Earth's rotation in a level of its own; where a turn is lost the vertical part, which needs none."""
    recording, _ = on_earth
    force = recording.accelerometer
    later = replace(recording, accelerometer=replace(force, values=force.values + 1e-9))  # the same twice is refused
    found = calibrate([recording, later], wgs84_gravity(48.0))
    found.save(tmp_path / "calibration.json")
    north, vertical = EARTH_RATE * np.cos(np.radians(48.0)), EARTH_RATE * np.sin(np.radians(48.0))
    for calibration in (found, load_calibration(tmp_path / "calibration.json")):
        one, other = calibration.imu.all_effects().values()
        assert (one.name, other.name) == ("gyro.earth_rotation@1", "gyro.earth_rotation@2")
        for earth in map(np.asarray, (one.coefficients, other.coefficients)):
            assert earth[2] == pytest.approx(vertical, abs=5e-3 * EARTH_RATE)
            assert np.hypot(*earth[:2]) == pytest.approx(north, rel=0.5)
    rate, intervals = recording.gyroscope, segment(recording).intervals
    kept = np.abs(rate.time - (intervals[5, 1] + intervals[6, 0]) / 2) > 0.3
    broken = replace(recording, gyroscope=replace(rate, time=rate.time[kept], values=rate.values[kept]))
    one, other = calibrate([recording, broken], wgs84_gravity(48.0)).imu.all_effects().values()
    assert np.hypot(*np.asarray(one.coefficients)[:2]) > north / 2
    assert np.asarray(other.coefficients) == pytest.approx([0.0, 0.0, vertical], abs=5e-3 * EARTH_RATE)
