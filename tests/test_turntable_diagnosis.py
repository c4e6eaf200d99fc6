"""Diagnosis with equipment: what is hidden in the unit or in the set-up is found, and what is blind is said to be."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scipy.stats

from jaximu.calibration import load_calibration
from jaximu.cli.app import main
from jaximu.data.observe_stations import observe_stations
from jaximu.data.recorded_stations import RecordedStations, station_of
from jaximu.diagnosis.experiment import Experiment
from jaximu.diagnosis.improvement import cross_validated
from jaximu.diagnosis.turntable import diagnose_turntable
from jaximu.ground.errors import NotPossibleError
from jaximu.model import NoiseModel
from jaximu.model.effects import CATALOGUE
from jaximu.noise.at_rest import fit_noise
from jaximu.recordings import write_recording
from jaximu.simulation import simulate
from jaximu.simulation.draw import consumer_noise, draw_imu
from jaximu.simulation.protocols import Environment, Positions, Static

UNIT = draw_imu(3)
BLIND = {"setup.table_axis", "setup.table_rate_scale", "setup.gravity", "setup.clock_scale"}
HIDDEN = {
    "accel.quadratic": [2e-5, -3e-5, 2e-5],
    "gyro.g_sensitivity": [2e-5, 0.0, -1e-5, 0.0, 1.5e-5, 0.0, 1e-5, 0.0, 2e-5],
    "setup.table_tilt": [1e-3, -5e-4],
}


@pytest.fixture(scope="module")
def noise() -> NoiseModel:
    return fit_noise(simulate(UNIT, Static(900.0), consumer_noise(), rate=50.0, seed=9)[0])


def recorded(*effects, latitude=None):
    environment = Environment(latitude=latitude)
    return simulate(
        UNIT.with_effects(*effects),
        Positions(26, 6.0, 2.0),
        consumer_noise(),
        rate=50.0,
        seed=4,
        environment=environment,
    )


@pytest.fixture(scope="module")
def clean(noise):
    recording, truth = recorded()
    return diagnose_turntable(recording, truth.schedule, static=noise)


def test_nothing_hidden_is_adequate_and_blind_effects_are_named(clean):
    assert clean.verdict == "adequate" and not clean.effects
    assert set(clean.not_observable) >= BLIND
    assert "setup.table_tilt" in clean.detection_limits and "accel.quadratic" in clean.detection_limits


@pytest.fixture(scope="module")
def hidden(noise):
    """What is found where one effect is hidden, by its name; each is diagnosed once."""

    @cache
    def found(name):
        recording, truth = recorded(CATALOGUE[name].make(HIDDEN[name]))
        return diagnose_turntable(recording, truth.schedule, static=noise)

    return found


@pytest.mark.parametrize("name", HIDDEN)
def test_a_hidden_effect_is_found_with_its_size(hidden, name):
    found = hidden(name)
    assert found.verdict == "effects"
    names = {found.effects[0].name, *found.effects[0].rivals}
    assert len(found.effects) == 1 and name in names
    if found.effects[0].name == name:
        error = (np.asarray(found.effects[0].effect.coefficients) - HIDDEN[name]) / found.effects[0].sigma
        assert np.sum(error**2) < 30  # χ² of nine at most: exceeded once in two thousand
    assert found.gain is not None and found.gain.log_likelihood > 0
    kept = found.extended_calibration()
    effects = [each for triad in kept.triads().values() for each in triad.effects] + list(kept.imu.setup)
    assert [each.name for each in effects] == [found.effects[0].name] and found.effects[0].name in kept.text()
    # what it says of its fit is that of the model with the effect
    assert kept.method == "turntable" and kept.rank == len(kept.names) == 24 + len(effects[0].coefficients)
    assert max(kept.excess.values()) < 0.5
    assert all(after <= 1.01 * before for before, after, _ in kept.rms.values())


def test_an_extended_calibration_comes_back_from_its_file(hidden, tmp_path):
    kept = hidden("setup.table_tilt").extended_calibration()
    kept.save(tmp_path / "calibration.json")
    read = load_calibration(tmp_path / "calibration.json")
    (effect,), (saved,) = read.imu.setup, kept.imu.setup
    assert effect.name == saved.name == "setup.table_tilt"
    np.testing.assert_array_equal(effect.coefficients, saved.coefficients)
    assert read.names == kept.names


def test_the_rotation_of_the_earth_is_found(noise):
    recording, truth = recorded(latitude=50.0)
    found = diagnose_turntable(recording, truth.schedule, static=noise)
    (named,) = found.effects
    assert "gyro.earth_rotation" in {named.name, *named.rivals}
    if named.name == "gyro.earth_rotation":
        assert np.linalg.norm(named.effect.coefficients) == pytest.approx(7.292e-5, abs=4 * np.linalg.norm(named.sigma))


def test_its_twin_has_no_misfit(clean):
    twin = clean.experiment.twin(clean.base, clean.noise, 1)
    scores = twin.fit().evidence.scores()
    assert scores.outside[2] > 1e-4
    # the errors of the twin are noise: as large as those of the recording
    ours, theirs = (each.real.rms(each.fit().conditions) for each in (clean.experiment, twin))
    for kind, (value, _) in ours.items():
        assert theirs[kind][0] == pytest.approx(value, rel=0.5)


def test_a_sample_belongs_to_the_station_it_lies_in():
    recording, truth = recorded()
    stations, _ = observe_stations(recording, truth.schedule, 9.80665)
    time = recording.accelerometer.time
    place = station_of(time, stations)
    for k, each in enumerate(truth.schedule):
        assert (place[(time >= each.start) & (time < each.stop)] == k).all()


def test_five_poses_predict_what_they_determine(noise):
    """Four poses do not determine gain and bias: what they leave open is not predicted, and does not count."""
    recording, truth = recorded()
    stations, _ = observe_stations(recording, truth.schedule, 9.80665, noise)
    force = np.asarray(stations.stimulus.specific_force)[:, 0] / 9.80665
    wanted = [(0, 0, 1), (1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0)]
    pose = np.asarray(stations.accelerometer_used) & np.any(
        [np.linalg.norm(force - w, axis=1) < 0.1 for w in wanted], 0
    )
    assert pose.sum() == 5
    data = RecordedStations(recording, replace(stations, accelerometer_used=pose))
    experiment = Experiment(data, truth.imu)
    gain = cross_validated(experiment, experiment.fit())
    assert gain.after.count < experiment.used.sum()
    assert 1e-3 < scipy.stats.chi2.sf(gain.after.chi_squared, gain.after.count) < 0.999


def test_a_model_with_as_many_parameters_as_conditions_confirms_nothing(data_folder, capsys):
    """imucal's session: six positions set by hand, a degree off; any two effects of the accelerometer fit them."""
    path = str(data_folder / "imucal" / "annotated_session.csv")
    given = ["--columns", "_,_,accel [count],gyro [count]", "--rate", "204.8", "--gyro-scale", "16.4 count/(deg/s)"]
    assert main(["diagnose", path, "--reference", path, *given, "--gravity", "9.81", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "unexplained"
    assert any("as many parameters as there are conditions" in note for note in found["notes"])


def test_command(noise, tmp_path, capsys):
    recording, truth = recorded(CATALOGUE["setup.table_tilt"].make(HIDDEN["setup.table_tilt"]))
    log, schedule = tmp_path / "log.parquet", tmp_path / "schedule.csv"
    write_recording(replace(recording, attitude=None), log)
    truth.save_schedule(schedule)
    given = ["diagnose", str(log), "--reference", str(schedule), "--gravity", "9.80665"]
    assert main([*given, "-o", str(tmp_path / "out")]) == 0
    assert "setup.table_tilt" in capsys.readouterr().out
    assert load_calibration(tmp_path / "out" / "calibration.json").imu.setup[0].name == "setup.table_tilt"
    for more, said in (
        ([str(log)], "goes with one LOG"),
        (["--heldout", str(log)], "go together"),
    ):
        assert main([*given[:2], *more, *given[2:]] if more == [str(log)] else [*given, *more]) == 2
        assert said in capsys.readouterr().err
    assert main(["diagnose", str(log), "--heldout-reference", str(schedule)]) == 2


def test_without_a_gyroscope_nothing_can_be_asked():
    recording, truth = recorded()
    with pytest.raises(NotPossibleError, match="accelerometer and gyroscope"):
        diagnose_turntable(replace(recording, gyroscope=None), truth.schedule)
