"""A check without poses: false alarms, a moved bias, a gyroscope after power-on, another unit, and what is not told."""

import json
from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
import pytest
import scipy.stats

from jaximu import InputError, LocalGravity, NotPossibleError, calibrate
from jaximu.cli import main
from jaximu.diagnosis import check
from jaximu.model import Noise, White
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.recordings import write_recording
from jaximu.simulation import ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY, draw_imu, simulate
from jaximu.simulation.protocols import Course, HandHeld, Protocol, Static
from jaximu.simulation.protocols.course import attitude_of

GRAVITY = LocalGravity(9.80665, 0.0)
NOISE = NoiseModel(AxisNoise.of_white(ACCELEROMETER_DENSITY**2), AxisNoise.of_white(GYROSCOPE_DENSITY**2))
DRAWN = {"accelerometer": Noise((White(ACCELEROMETER_DENSITY),), "specific_force"),
         "gyroscope": Noise((White(GYROSCOPE_DENSITY),), "angular_rate")}  # fmt: skip
UNITS = 10


class Use(Protocol):
    """A rest, thirteen seconds of turning at will, and a rest."""

    kind = "use"

    def course(self, rng):
        course = Course(attitude_of(np.array([0.0, 0.0, 1.0])))
        course.rest(3.0)
        for _ in range(12):
            course.turn(0.6 * rng.standard_normal(3), 1.0, mark=False)
        course.to(attitude_of(rng.standard_normal(3) + [0.0, 0.0, 2.0]), 1.0)
        course.rest(3.0)
        return course


def unit(seed: int):
    return jax.tree.map(np.asarray, draw_imu(seed, 0.01))


def used(imu, seed: int):
    return simulate(imu, Use(), DRAWN, rate=50.0, seed=1000 + seed)[0]


def calibrated(seed: int):
    recording, _ = simulate(unit(seed), HandHeld(20, 3.0, 1.5), DRAWN, rate=50.0, seed=seed)
    return calibrate(recording, GRAVITY, static=NOISE)


def moved(seed: int, place, change):
    return eqx.tree_at(place, unit(seed), place(unit(seed)) + np.asarray(change))


@pytest.fixture(scope="module")
def calibrations():
    return {seed: calibrated(seed) for seed in range(20, 20 + UNITS)}


@pytest.fixture(scope="module")
def unmoved(calibrations):
    return {seed: check(each, used(unit(seed), seed), GRAVITY, static=NOISE) for seed, each in calibrations.items()}


def test_where_nothing_moved_alarms_are_as_rare_as_stated(unmoved):
    assert all(each.history is not None and each.experiment is None for each in unmoved.values())
    alarms = sum(each.verdict != "valid" for each in unmoved.values())
    assert alarms <= scipy.stats.binom.ppf(1 - 1e-3, UNITS, 0.05)
    total, freedom = (sum(getattr(each, name) for each in unmoved.values()) for name in ("chi_squared", "freedom"))
    low, high = scipy.stats.chi2.ppf([1e-3, 1 - 1e-3], freedom)
    assert low < total < high
    nis = np.mean([each.nis for each in unmoved.values()])
    assert 0.7 < nis < 1.2


def test_what_cannot_be_told_is_said(unmoved):
    found = unmoved[20]
    assert "still valid" in found.headline()
    assert any("not determined without poses" in note and "gyroscope scale x" in note for note in found.notes)
    told = {each.name for each in found.shifts if each.comparable}
    assert told == {f"gyroscope.bias[{axis}]" for axis in range(3)}  # each by itself
    document = json.loads(found.text())
    assert document["by"] == "filter in use" and document["nis"] == pytest.approx(found.nis)
    assert document["verdict"] == "valid" and len(document["not_comparable"]) == 18


@pytest.mark.parametrize("axis", [0, 2])
def test_a_bias_that_moved_is_named_and_measured(calibrations, axis):
    change = np.zeros(3)
    change[axis] = 0.1
    imu = moved(20, lambda imu: imu.accelerometer.bias, change)
    found = check(calibrations[20], used(imu, 20), GRAVITY, static=NOISE)
    assert found.verdict == "shifted" and found.p_value < 1e-6
    name = f"accelerometer.bias[{axis}]"
    assert name in {other for cause in found.causes for other in (cause.name, *cause.rivals)}
    assert found.causes[0].name == name
    value, sigma = found.alone[name]
    assert abs(value - 0.1) < 4 * sigma and sigma < 0.01
    assert f"accelerometer bias {'xyz'[axis]} moved by +" in found.headline()


def test_a_gyroscope_bias_of_another_power_on_is_allowed_and_told(calibrations):
    change = np.array([0.02, -0.01, 0.03])
    imu = moved(22, lambda imu: imu.gyroscope.bias, change)
    found = check(calibrations[22], used(imu, 22), GRAVITY, static=NOISE)
    assert found.verdict == "valid"
    shifts = {each.name: each for each in found.shifts}
    for axis in range(3):
        each = shifts[f"gyroscope.bias[{axis}]"]
        assert each.allowed and abs(each.difference - change[axis]) < 4 * each.sigma and each.sigma < 1e-3
    assert "re-zero it at rest" in found.bias_words()


def test_another_units_calibration_is_told(calibrations):
    for seed in (30, 31, 32):
        other = jax.tree.map(np.asarray, draw_imu(seed))  # units differ by some percent
        found = check(calibrations[20], used(other, seed), GRAVITY, static=NOISE)
        assert found.verdict in ("shifted", "unexplained") and found.p_value < 1e-6
        assert any("another unit" in text for text in (*found.notes, found.headline()))
    wide = moved(20, lambda imu: imu.accelerometer.gain, 0.1 * np.eye(3))
    with pytest.raises(InputError, match="is it the same unit"):
        check(calibrations[20], used(wide, 20), GRAVITY, static=NOISE)


def test_recordings_that_tell_nothing_are_refused(calibrations):
    still = simulate(unit(20), Static(20.0), DRAWN, rate=50.0, seed=1)[0]
    with pytest.raises(NotPossibleError, match="static pose"):
        check(calibrations[20], still, GRAVITY, static=NOISE)


def test_command(calibrations, tmp_path, capsys):
    calibrations[20].save(tmp_path / "calibration.json")
    write_recording(replace(used(unit(20), 20), attitude=None), tmp_path / "use.parquet")
    arguments = ["check", str(tmp_path / "calibration.json"), str(tmp_path / "use.parquet"), "--gravity", "9.80665"]
    assert main([*arguments, "-o", str(tmp_path / "out")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "updates" in printed and "Squared innovations of the filter" in printed
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "Squared innovations of the filter over time" in page and ">nan" not in page
    assert not (tmp_path / "out" / "check.png").exists()  # no parameter is told by itself, so none has a picture
