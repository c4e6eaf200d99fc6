"""Diagnosis against a measured attitude: nothing where nothing is hidden, what is hidden with its size, the command."""

import json
from dataclasses import replace

import attitude_motion
import hidden_effects
import jax
import numpy as np
import pytest
import scipy
from scipy.spatial.transform import Rotation

from jaximu import LocalGravity, Recording
from jaximu.calibration import calibrate_against_attitude, load_calibration
from jaximu.cli.app import main
from jaximu.data.attitude import EXCESS_NAMES
from jaximu.diagnosis import diagnose_against_attitude
from jaximu.diagnosis.experiment import Experiment, KnownEffect
from jaximu.estimation.fitting import effect_numbers
from jaximu.model.effects import CATALOGUE
from jaximu.model.effects.lever_arm import AccelLeverArm
from jaximu.model.effects.reference_filter import SetupReferenceFilter
from jaximu.model.effects.reference_rotation import SetupReferenceRotation
from jaximu.recordings import write_recording
from jaximu.recordings.attitude import Attitude
from jaximu.recordings.recording import Signal

GRAVITY = LocalGravity(attitude_motion.GRAVITY, 0.0)


def moved(seed=1, **changes):
    return attitude_motion.move(seed, **{"duration": 30.0, "tracked": 10.0} | changes)


def unit_of(made, rate=None) -> Recording:
    rate = made.rate if rate is None else rate
    return Recording(Signal(made.time, made.force, "m/s^2"), Signal(made.time, rate, "rad/s"))


def reference_of(made) -> Attitude:
    return Attitude(made.stamp - made.stamp[0], made.quaternion, made.velocity, start=float(made.stamp[0]))


def later(made, values, delay):
    """Columns as of other times, each later by its own delay (s)."""
    return np.stack([np.interp(made.time - late, made.time, each)
                     for late, each in zip(delay, values.T, strict=True)], axis=1)  # fmt: skip


@pytest.fixture(scope="module")
def calibrated():
    made = moved()
    calibration, measurement = calibrate_against_attitude(unit_of(made), reference_of(made), GRAVITY)
    setup = (each for each in calibration.imu.all_effects().values() if each.scope == "fixture")
    known = tuple(map(KnownEffect.of_setup, setup))
    excess = np.array([calibration.excess[name] for name in EXCESS_NAMES])
    start = jax.tree.map(np.asarray, calibration.imu.with_effects())
    return calibration, Experiment(measurement, start, known=known, excess=excess)


def test_what_is_not_known_of_the_reference_is_part_of_the_noise(calibrated):
    """The fit of the unit alone is that of unit, mounting, delay, filter and lever arm together."""
    calibration, experiment = calibrated
    state = experiment.fit(asking=())
    assert np.sum(state.evidence.residual**2) == pytest.approx(
        np.sum(np.asarray(calibration.fit.residual) ** 2), abs=1e-3
    )
    for found, known in zip(state.imu.triads().values(), calibration.imu.triads().values(), strict=True):
        np.testing.assert_allclose(found.gain, known.gain, atol=1e-6)
        np.testing.assert_allclose(found.bias, known.bias, atol=1e-6)
    copied = experiment.twin(state, None, 3)
    twin = copied.fit(asking=())
    # how the reference is mounted was found: the twin does not draw it anew, which would be degrees
    for own, simulated in zip(experiment.errors(state), copied.errors(twin), strict=True):
        assert 0.5 < np.sqrt(np.mean(np.square(simulated)) / np.mean(np.square(own))) < 2.0
    chi = np.sum(twin.evidence.residual**2) / twin.evidence.freedom
    assert chi == pytest.approx(1.0, abs=5 * np.sqrt(2 / twin.evidence.freedom))
    assert np.abs(np.asarray(twin.imu.gyroscope.gain) - np.asarray(state.imu.gyroscope.gain)).max() < 5e-3


def test_near_the_level_the_twin_is_as_wrong_as_the_recording():
    """A reference's tilt and the accelerometer's bias look alike there: what a fit leaves to the tilt is no error."""
    made = moved(2, swing=0.1)
    calibration, measurement = calibrate_against_attitude(unit_of(made), reference_of(made), GRAVITY)
    setup = (each for each in calibration.imu.all_effects().values() if each.scope == "fixture")
    known = tuple(map(KnownEffect.of_setup, setup))
    excess = np.array([calibration.excess[name] for name in EXCESS_NAMES])
    start = jax.tree.map(np.asarray, calibration.imu.with_effects())
    experiment = Experiment(measurement, start, known=known, excess=excess)
    state = experiment.fit(asking=())
    for seed in (1, 2, 3):
        copied = experiment.twin(state, None, seed)
        twin = copied.fit(asking=())
        for measured, simulated in zip(experiment.errors(state), copied.errors(twin), strict=True):
            assert 0.6 < np.sqrt(np.mean(np.square(simulated)) / np.mean(np.square(measured))) < 1.6


def test_reactions_are_the_changes_of_the_conditions(calibrated):
    """What an effect adds to every sample, against the conditions of a recording to which it was added.

    It changes over many samples, as effects do: reactions leave out what it does to coning and sculling.
    """
    calibration, experiment = calibrated
    # filter and lever arm make something of the rates themselves, which is of second order and none of an effect's
    lifted = calibration.imu.without(SetupReferenceFilter).without(AccelLeverArm)
    lifted = jax.tree.map(lambda leaf: np.asarray(leaf)[None], lifted)
    measurement = experiment.data
    about = measurement.about(lifted)
    random = np.random.default_rng(4)
    bare = calibration.imu.with_effects()

    def conditions(force, rate):
        recording = unit_of(moved())
        accelerometer = Signal(recording.accelerometer.time, recording.accelerometer.values + force, "m/s^2")
        changed = Recording(accelerometer, Signal(recording.gyroscope.time, recording.gyroscope.values + rate, "rad/s"))
        found = type(measurement)(changed, measurement.attitude, measurement.gravity).about(lifted)
        return np.asarray(jax.tree.map(lambda leaf: leaf[0], found.conditions)(bare))

    size = (len(moved().time), 3)
    zero = np.zeros(size)
    force, rate = (
        scale * scipy.ndimage.gaussian_filter1d(random.normal(size=size), 3, axis=0) for scale in (1e-3, 1e-4)
    )
    windows = len(about.details.duration) // measurement.group
    for pushed, turned in ((force, zero), (zero, rate)):
        wanted = conditions(pushed, turned) - conditions(zero, zero)
        added = {"accelerometer": pushed, "gyroscope": turned}
        felt = {
            name: (values @ np.linalg.inv(np.asarray(bare.triads()[name].gain)).T)[..., None]
            for name, values in added.items()
        }
        found = np.asarray(about.details.reactions.react(felt, windows))[:, 0]
        np.testing.assert_allclose(found, wanted, atol=5e-4 * np.abs(wanted).max())


def test_columns_are_the_derivatives_of_the_conditions(calibrated):
    """By every number of the mounting and of effects, against differences of the conditions as they are.

    Set-ups of other kinds, a field or a table, have no part in them.
    """
    calibration, experiment = calibrated
    mounted = calibration.imu.all_effects().values()
    effects = (
        CATALOGUE["accel.step"].make([0.01, 0.02, -0.01], onset=20.0),
        CATALOGUE["gyro.g_sensitivity"].make(1e-4 * np.arange(9.0)),
        CATALOGUE["setup.time_offset"].make([1e-3]),
        CATALOGUE["setup.magnetic_field"].make([20.0, 0.0, 40.0]),
        CATALOGUE["setup.table_rate_scale"].make([1e-3]),
        *mounted,
    )
    imu = jax.tree.map(np.asarray, calibration.imu.with_effects(*effects))
    names, _, sizes = effect_numbers(imu)
    about, bare = experiment.data.about_one(imu), calibration.imu.with_effects()

    def conditions(number, change):
        moved = replace(effect_of(number), coefficients=coefficients(number, change))
        others = [effect for effect in imu.all_effects().values() if effect.name != moved.name]
        return np.asarray(experiment.data.about_one(imu.with_effects(*others, moved)).conditions(bare))

    def effect_of(number):
        return imu.all_effects()[names[number].owner, names[number].effect]

    def coefficients(number, change):
        values = np.array(effect_of(number).coefficients)
        values[names[number].axes] += change
        return values

    tried = [k for k, name in enumerate(names) if name.part == "coefficients" and sizes[k] > 0]
    assert {names[k].owner for k in tried} >= {"accelerometer", "gyroscope", "setup"}
    for k in tried:
        step = 1e-3 * sizes[k]
        wanted = (conditions(k, step) - conditions(k, -step)) / (2 * step)
        np.testing.assert_allclose(about.columns[:, k], wanted, atol=2e-3 * np.abs(wanted).max(), err_msg=names[k])


def test_noise_of_the_attitude_reaches_rotations_and_forces_alike(calibrated):
    """The second factor of the covariance, against the conditions with a reference that stands wrong by known turns."""
    calibration, experiment = calibrated
    measurement, imu = experiment.data, calibration.imu.without(SetupReferenceFilter)
    lifted = jax.tree.map(lambda leaf: np.asarray(leaf)[None], imu)
    mounting = Rotation.from_rotvec(np.asarray(imu.coefficients(SetupReferenceRotation)))

    def wrong(stamps):
        return 1e-4 * np.stack([np.sin(3 * stamps), np.cos(5 * stamps), np.sin(7 * stamps + 1)], axis=1)

    attitude = measurement.attitude
    turned = attitude.rotation() * mounting * Rotation.from_rotvec(wrong(attitude.time)) * mounting.inv()
    shaken = replace(measurement, attitude=replace(attitude, quaternion=turned.as_quat(scalar_first=True)))
    before, after = measurement.about(lifted), shaken.about(lifted)
    conditions = (jax.tree.map(lambda leaf: leaf[0], each.conditions) for each in (before, after))
    plain, changed = (np.asarray(each(imu.with_effects())) for each in conditions)
    at = np.asarray(measurement.intervals.stamp)
    reach = jax.tree.map(lambda leaf: leaf[0], before.covariance.factors[1])
    wanted = np.asarray(reach.times(wrong(at).reshape(-1, 1) / 1e-3, len(plain)))[:, 0]
    turns = 3 * len(measurement.intervals.used)
    for part in (slice(turns), slice(turns, None)):
        np.testing.assert_allclose((changed - plain)[part], wanted[part], atol=2e-3 * np.abs(wanted[part]).max())


def test_g_sensitivity_is_found_with_its_size():
    made = moved(2, g_sensitivity=4e-4)
    found = diagnose_against_attitude(unit_of(made), reference_of(made), GRAVITY)
    assert found.verdict == "effects" and [each.name for each in found.effects] == ["gyro.g_sensitivity"]
    (effect,) = found.named
    off = (np.asarray(effect.effect.coefficients) - made.truth["g_sensitivity"].ravel()) / effect.sigma
    assert np.abs(off).max() < 4.5 and effect.gain.log_likelihood > 20


def test_an_effect_of_the_accelerometer_is_not_taken_for_noise():
    """Hidden at thrice the limit that is printed without it: noise is estimated with it, and grows by little."""
    made = moved()
    limit = diagnose_against_attitude(unit_of(made), reference_of(made), GRAVITY).detection_limits["accel.quadratic"][0]
    effect = hidden_effects.draw_effect(1, "accel.quadratic", hidden_effects.Protocol(1))
    made = moved(hidden=(replace(effect, scale=3 * limit / effect.size),))
    found = diagnose_against_attitude(unit_of(made), reference_of(made), GRAVITY)
    assert found.verdict == "effects" and [each.name for each in found.effects] == ["accel.quadratic"]
    assert found.detection_limits["accel.quadratic"][0] < 1.2 * limit


def test_a_gyroscope_whose_axes_are_late_is_not_the_references_delay():
    """What all axes have in common is the reference's delay; that one of them is late by 6 ms is the gyroscope's."""
    made = moved(3)
    found = diagnose_against_attitude(
        unit_of(made, later(made, made.rate, (6e-3, 0.0, 0.0))), reference_of(made), GRAVITY
    )
    (effect,) = found.named
    assert found.verdict == "effects" and effect.name == "gyro.lag"
    x, y, z = np.asarray(effect.effect.coefficients)
    assert x - (y + z) / 2 == pytest.approx(6e-3, abs=1e-3) and y - z == pytest.approx(0.0, abs=1e-3)


def test_a_gyroscope_stamped_late_is_found_and_is_not_the_references_delay():
    """Against the gyroscope's stamps, of 6 ms late, the reference is as much earlier; with the time offset in the model
    its delay is what it is against the accelerometer's."""
    late = hidden_effects.Hidden("setup.time_offset", np.array([6e-3]), {})
    made = moved(4, hidden=(late,))
    found = diagnose_against_attitude(unit_of(made), reference_of(made), GRAVITY)
    (effect,) = found.named
    assert found.verdict == "effects" and effect.name == "setup.time_offset"
    assert effect.triad == "gyroscope" and effect.largest > 0
    assert abs(effect.effect.coefficients[0] - 6e-3) < 3 * effect.sigma[0] < 1e-3
    without, beside = (each.reference["time_offset"] for each in (found.calibration, found.extended_calibration()))
    assert without["value"] == pytest.approx(made.truth["delay"] - 6e-3, abs=5e-4)
    assert abs(beside["value"] - made.truth["delay"]) < 3 * beside["sigma"] < 1e-3


def test_nothing_is_named_or_gained_while_a_mistake_stands():
    made = moved()
    kept = np.random.default_rng(3).random(len(made.time)) > 0.01
    time = made.time[: kept.sum()]
    lossy = Recording(Signal(time, made.force[kept], "m/s^2"), Signal(time, made.rate[kept], "rad/s"))
    diagnosis = diagnose_against_attitude(lossy, reference_of(made), GRAVITY)
    assert {finding.name for finding in diagnosis.preflight if finding.spoils} == {"data.lost_samples"}
    assert (diagnosis.verdict, diagnosis.effects, diagnosis.gain) == ("unexplained", (), None)
    (sentence,) = diagnosis.summary().verdict
    assert sentence.startswith("No effect can be named") and "--repair" in diagnosis.suggestion
    repaired, _ = calibrate_against_attitude(lossy, reference_of(made), GRAVITY, repair=True)
    assert repaired.rms["rotation"][1] < 0.8 * diagnosis.calibration.rms["rotation"][1]


def test_command(tmp_path, capsys):
    made = moved()
    log, reference = tmp_path / "log.parquet", tmp_path / "tracker.csv"
    write_recording(unit_of(made), log)
    columns = np.column_stack([made.stamp, made.quaternion, made.velocity])
    header = "time [s],qw,qx,qy,qz,vx [m/s],vy [m/s],vz [m/s]"
    np.savetxt(reference, columns, delimiter=",", fmt="%.9f", header=header, comments="")
    line = ["diagnose", str(log), "--reference", str(reference), "--gravity", f"{attitude_motion.GRAVITY}"]
    assert main([*line, "--json", "-o", str(tmp_path / "out")]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["verdict"] == "adequate" and not document["effects"]
    assert {"gyro.g_sensitivity", "gyro.lag", "setup.time_offset"} <= set(document["detection_limits"])
    assert "in any case" in document["not_observable"]["setup.reference_delay"]
    kept = load_calibration(tmp_path / "out" / "calibration.json")
    assert kept.method == "reference" and kept.reading is not None
    assert (tmp_path / "out" / "report.html").stat().st_size > 10000
    assert main([*line, "--heldout", str(log)]) == 2
    assert "omit --heldout" in capsys.readouterr().err
