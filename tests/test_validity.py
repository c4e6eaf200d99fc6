"""Is an old calibration still valid: the statistics' laws, what moved and by how much, what a session explains."""

import json
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest
import scipy.stats
import synthetic

from jaximu import InputError, LocalGravity, NotPossibleError, Recording, calibrate
from jaximu.cli.app import main
from jaximu.diagnosis import check
from jaximu.diagnosis.comparison import Fresh, Old, Question, Widened
from jaximu.diagnosis.experiment import Experiment
from jaximu.estimation.data import About, Conditions
from jaximu.estimation.fitting import effect_numbers
from jaximu.estimation.problem import Parameters, without_equipment
from jaximu.estimation.uncertainty import label
from jaximu.ground.gravity import STANDARD
from jaximu.model.effects import CATALOGUE
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.sensor import Imu
from jaximu.recordings import write_recording
from jaximu.recordings.recording import Signal
from jaximu.report.html import write_report

GRAVITY = LocalGravity(synthetic.GRAVITY, 0.0)
NOISE = NoiseModel(AxisNoise.of_white(np.full(3, 2e-6)), AxisNoise.of_white(np.full(3, 1e-8)))
POSES = 24
UNIT = jax.tree.map(np.asarray, synthetic.unit(3))


def moved(place, change) -> Imu:
    """The unit with one of its arrays changed."""
    return eqx.tree_at(place, UNIT, np.asarray(place(UNIT)) + change)


def recorded(seed: int, imu: Imu = UNIT, poses: int = POSES) -> Recording:
    return synthetic.recording(seed, poses=poses, imu=imu)[0]


def element(i: int, j: int, size: float) -> np.ndarray:
    change = np.zeros((3, 3))
    change[i, j] = size
    return change


@pytest.fixture(scope="module")
def calibration():
    return calibrate(recorded(1), GRAVITY, static=NOISE)


@pytest.fixture(scope="module")
def unmoved(calibration):
    return check(calibration, recorded(5), GRAVITY, static=NOISE)


# --- the statistics' laws -------------------------------------------------------------------------------------------


class LinearConditions(Conditions):
    """Conditions (n,) that are linear in a unit's free numbers: what they are at `parameters`, and their columns."""

    drawn: np.ndarray
    columns: np.ndarray
    parameters: Parameters
    magnitude: Any

    def __call__(self, imu):
        moved = self.parameters.size * self.parameters.vector(imu)
        return self.drawn + self.columns @ moved

    def at_magnitude(self, magnitude):
        return eqx.tree_at(lambda each: each.magnitude, self, magnitude)


class Drawn(Experiment):
    """A recording whose conditions are linear and drawn; their covariance is one for all units."""

    beside: About
    linear: tuple[np.ndarray, Parameters]
    drawn: np.ndarray

    @classmethod
    def of(cls, real: Experiment, imu: Imu) -> "Drawn":
        """Linearise a recording at a unit."""
        found = cls(real.data, real.start)
        found.beside = real.about(jax.tree.map(lambda leaf: np.asarray(leaf)[None], imu))
        columns = np.zeros((len(real.used), len(real.predict(imu)[3])))
        columns[real.used] = real.predict(imu)[1]
        found.linear = columns, Parameters.select(imu, without_equipment)
        return found

    def about(self, imu):
        """Return the drawn conditions, whatever the unit."""
        drawn = np.zeros(len(self.used))
        drawn[self.used] = self.drawn
        conditions = LinearConditions(drawn, *self.linear, self.data.observations.gravity)
        return replace(self.beside, conditions=jax.tree.map(lambda leaf: np.asarray(leaf)[None], conditions))


@pytest.mark.parametrize("common", [True, False], ids=["gravity in common", "gravity independent"])
def test_laws_where_nothing_moved(calibration, unmoved, common):
    """Draws of both recordings' errors in the linear problem: χ², the parameters' χ² and every z follow their laws."""
    sigma = 0.015
    gain = np.tril(np.asarray(calibration.imu.accelerometer.gain))
    reach = np.array([
        gain[n.axes] / GRAVITY.value if (n.owner, n.part) == ("accelerometer", "gain") else 0.0
        for n in calibration.names
    ])  # fmt: skip
    known = replace(
        calibration,
        covariance=calibration.covariance + sigma**2 * reach[:, None] * reach,
        gravity=LocalGravity(GRAVITY.value, sigma),
    )
    local = LocalGravity(GRAVITY.value + (0.0 if common else 1e-9), sigma)
    old = Old.of(known, local)
    real = unmoved.experiment
    _, columns, covariance, names = real.predict(old.imu)
    assert calibration.names == names == old.names
    linear = Drawn.of(real, old.imu)
    random = np.random.default_rng(1)
    errors = np.linalg.cholesky(calibration.covariance)
    noise = np.linalg.cholesky(covariance)
    told, together, z = [], [], []
    for _ in range(300):
        wrong = errors @ random.standard_normal(len(names)) - reach * sigma * random.standard_normal()
        if common:  # conditions and old gains take gravity for the same wrong value: that has no effect
            wrong = errors @ random.standard_normal(len(names))
        drawn = noise @ random.standard_normal(len(noise)) + columns @ wrong
        if not common:
            drawn = drawn + columns @ reach * sigma * random.standard_normal()
        drawn = drawn + columns[:, old.allowed] @ (0.02 * random.standard_normal(3))  # another power-on
        linear.drawn = drawn
        scatter = np.ones(3)
        question = Question.ask(old, Widened(linear, scatter).predict(old.imu))
        square = question.evidence.residual @ question.evidence.residual
        told.append(scipy.stats.chi2.sf(square, question.evidence.freedom))
        fresh = Fresh.fit(old, linear, scatter)
        tested = np.setdiff1d(np.arange(len(names)), old.allowed)
        spread = fresh.covariance_of_difference[np.ix_(tested, tested)]
        difference = fresh.difference[tested]
        together.append(scipy.stats.chi2.sf(difference @ np.linalg.solve(spread, difference), len(tested)))
        z.append(difference / np.sqrt(np.diag(spread)))
    for each in (told, together):
        assert scipy.stats.kstest(each, "uniform").pvalue > 1e-3
    scatter_of_z = np.sum(np.square(z), axis=0)
    low, high = scipy.stats.chi2.ppf([1e-4 / 18, 1 - 1e-4 / 18], 300)
    assert ((low < scatter_of_z) & (scatter_of_z < high)).all()


def test_what_gravity_added_is_taken_off(calibration):
    """The file's covariance with an uncertain gravity, less gravity's part, is the one with gravity known."""
    loose = calibrate(recorded(1), LocalGravity(GRAVITY.value, 0.015), static=NOISE)
    known = Old.of(calibration, GRAVITY)
    freed = Old.of(loose, LocalGravity(GRAVITY.value, 0.015))
    sigma = np.sqrt(np.diag(known.covariance))
    assert np.abs((freed.covariance - known.covariance) / np.outer(sigma, sigma)).max() < 0.2
    assert (np.sqrt(np.diag(loose.covariance)) / sigma).max() > 5


def test_numbers_of_effects_are_found_again_where_others_are_left_out(calibration):
    """A session's effect before the unit's own shifts their places: values and variances stay with their numbers."""
    added = [CATALOGUE["accel.bias_ramp"].make(1e-4), CATALOGUE["accel.thermal_lag"].make(2e-3, time_constant=90.0),
             CATALOGUE["gyro.g_sensitivity"].make(np.arange(9) * 1e-4)]  # fmt: skip
    imu = jax.tree.map(np.asarray, calibration.imu.with_effects(*added))
    names, values, _ = effect_numbers(imu)
    own, known = np.arange(1.0, 1 + len(names)), len(calibration.names)
    covariance = np.diag(np.concatenate([np.diag(calibration.covariance), own]))
    old = Old.of(
        replace(calibration, imu=imu, names=(*calibration.names, *names), covariance=covariance), calibration.gravity
    )
    kept = np.array([(name.owner, name.effect) != ("accelerometer", 0) for name in names])
    lag = [f"accel.thermal_lag[{k}]" for k in range(CATALOGUE["accel.thermal_lag"].size)]
    shown = [label(name, old.imu) for name in old.names]
    assert shown[:known] == list(calibration.names)
    assert shown[known:] == [*lag, "accel.thermal_lag.time_constant", *(f"gyro.g_sensitivity[{k}]" for k in range(9))]
    np.testing.assert_array_equal(old.values[known:], values[kept])
    np.testing.assert_allclose(np.diag(old.covariance)[known:], own[kept], rtol=1e-9)
    assert old.units[known + len(lag)] == "s"
    assert set(old.places("accelerometer", "gain", "bias")) <= set(range(known))


# --- nothing moved --------------------------------------------------------------------------------------------------


def test_same_unit_is_valid(unmoved):
    assert unmoved.verdict == "valid"
    assert unmoved.p_value > 0.01
    assert not unmoved.moved
    assert not unmoved.causes
    assert "still valid" in unmoved.headline()
    assert set(unmoved.output_errors) == {"accelerometer", "gyroscope", "turns"}
    for each in unmoved.output_errors.values():
        assert each.value < 4 * each.sigma
    json.loads(unmoved.text())


def test_gyroscope_bias_of_another_power_on_is_allowed(calibration, unmoved):
    other = moved(lambda imu: imu.gyroscope.bias, [0.02, -0.03, 0.01])
    found = check(calibration, recorded(5, other), GRAVITY, static=NOISE)
    assert found.verdict == "valid"
    shifts = {each.name: each for each in found.shifts}
    for axis, change in enumerate((0.02, -0.03, 0.01)):
        each = shifts[f"gyroscope.bias[{axis}]"]
        assert each.allowed
        assert not each.moved
        assert abs(each.difference - change) < 4 * each.sigma
    assert f"{np.degrees(np.sqrt(0.0014)):.2g} °/s" in found.bias_words()


# --- something moved ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "place", "index"),
    [
        ("gyroscope.gain[1,1]", lambda imu: imu.gyroscope.gain, (1, 1)),
        ("accelerometer.gain[2,0]", lambda imu: imu.accelerometer.gain, (2, 0)),
        ("accelerometer.bias[0]", lambda imu: imu.accelerometer.bias, (0,)),
    ],
)
def test_a_shift_of_ten_sigma_is_found_named_and_measured(calibration, unmoved, name, place, index):
    sigma = next(each.sigma for each in unmoved.shifts if each.name == name)
    change = np.zeros((3,) * len(index))
    change[index] = 10 * sigma
    found = check(calibration, recorded(5, moved(place, change)), GRAVITY, static=NOISE)
    assert found.verdict == "shifted"
    assert found.p_value < 1e-6
    assert [each.name for each in found.causes] == [name]
    first = found.moved[0]
    assert first.name == name
    assert found.causes[0].sentence == f"{first.words} moved"
    assert next(each.words for each in found.moved if each.name == name) in found.headline()
    assert abs(first.difference - 10 * sigma) < 4 * first.sigma
    inside = 9.80665 if name.startswith("accelerometer.gain") else 1.0
    row = np.linalg.norm(np.asarray(getattr(UNIT, name.split(".")[0]).gain)[index[0]])
    assert first.in_si == pytest.approx(first.difference * inside / row, rel=0.01)
    assert found.difference[2] < 1e-6
    assert len(found.moved) <= 2


def test_what_moved_together_is_named_together(calibration, tmp_path):
    change = 2e-3 * np.random.default_rng(3).normal(size=(3, 3))
    found = check(calibration, recorded(5, moved(lambda imu: imu.gyroscope.gain, change)), GRAVITY, static=NOISE)
    assert [each.sentence for each in found.causes] == ["the gyroscope's gains moved"]
    page = write_report(found, tmp_path).read_text(encoding="utf-8")
    assert "the gyroscope&#39;s gains moved" in page and "largest error of the gyroscope" in page


def test_the_output_error_is_that_of_the_outputs(calibration):
    """Against the unit's own outputs: gains off by a percent put them off by a percent of what is sensed."""
    found = check(
        calibration,
        recorded(5, moved(lambda imu: imu.gyroscope.gain, element(1, 1, 0.01))),
        GRAVITY,
        static=NOISE,
    )
    signal = recorded(5).gyroscope
    assert signal is not None
    rate = (signal.values - np.asarray(UNIT.gyroscope.bias)) @ np.linalg.inv(np.asarray(UNIT.gyroscope.gain)).T
    each = found.output_errors["gyroscope"]
    assert each.value == pytest.approx(0.01 * np.abs(rate[:, 1]).max(), rel=0.05)
    turned = np.degrees(0.01 * 2 * np.pi)  # no turn is longer than half a circle and two radians about another axis
    assert 0.2 < found.output_errors["turns"].value < turned


def test_a_session_effect_is_named_instead(calibration):
    recording = recorded(5)
    signal = recording.accelerometer
    ramp = np.outer(signal.time, [2e-4, -1e-4, 1e-4])
    found = check(
        calibration,
        replace(recording, accelerometer=replace(signal, values=signal.values + ramp)),
        GRAVITY,
        static=NOISE,
    )
    assert found.verdict == "session"
    assert {"accel.bias_ramp"} <= {name for cause in found.causes for name in (cause.name, *cause.rivals)}
    assert "still holds" in found.headline()
    assert not [each for each in found.moved if each.name.startswith("gyroscope")]


def test_another_gravity_is_a_rival_of_the_scales():
    """Gravity is stated alike, loosely, and all scales of the accelerometer moved as if it were another."""
    loose = calibrate(recorded(1), STANDARD, static=NOISE)
    other = eqx.tree_at(lambda imu: imu.accelerometer.gain, UNIT, 1.001 * np.asarray(UNIT.accelerometer.gain))
    found = check(loose, recorded(5, other), STANDARD, static=NOISE)
    (cause,) = found.causes
    assert cause.name == "setup.gravity"
    assert found.verdict == "session"
    assert cause.coefficients[0] == pytest.approx(0.001 * 9.80665, rel=0.2)
    scales = [each for each in found.shifts if each.name.startswith("accelerometer.gain")]
    assert all(each.comparable and not each.moved for each in scales)
    known = check(
        loose, recorded(5, other), GRAVITY, static=NOISE
    )  # gravity known now: the old scales may be off by as much
    assert known.verdict == "valid"


# --- what users do wrong --------------------------------------------------------------------------------------------


def test_few_poses_give_a_prediction_and_say_what_is_not_compared(calibration):
    found = check(calibration, recorded(5, poses=3), GRAVITY, static=NOISE)
    assert found.verdict == "valid"
    assert found.freedom > 5
    assert found.output_errors == {}
    document = json.loads(found.text())
    assert document["not_comparable"]
    assert any("not compared" in note for note in found.notes)
    off = check(
        calibration,
        recorded(5, moved(lambda imu: imu.accelerometer.bias, [0.2, 0.0, 0.0]), poses=3),
        GRAVITY, static=NOISE,
    )  # fmt: skip
    assert off.verdict == "shifted"
    assert off.p_value < 1e-6
    told = {each.name for each in off.shifts if each.comparable}
    named = {each.name for cause in off.causes for each in cause.parameters}
    assert not off.causes or named & told  # what was not compared is not said to have moved


def test_a_mistake_in_the_recording_is_said_and_no_verdict_made_of_it(calibration):
    recording = recorded(5)
    gyroscope = recording.gyroscope
    silent = np.where(np.abs(gyroscope.values) < 0.05, 0.0, gyroscope.values)
    zeroed = replace(recording, gyroscope=replace(gyroscope, values=silent))
    with pytest.raises(NotPossibleError, match=r"exactly zero, .* this recording cannot show whether"):
        check(calibration, zeroed, GRAVITY)


def test_bad_inputs_are_sentences(calibration):
    recording = recorded(5)
    with pytest.raises(InputError, match="has no gyroscope"):
        check(calibration, replace(recording, gyroscope=None), GRAVITY)
    alone = replace(calibration, imu=Imu(calibration.imu.accelerometer, None))
    with pytest.raises(InputError, match="Calibrate both"):
        check(alone, recording, GRAVITY)
    signal = recording.accelerometer
    in_g = replace(recording, accelerometer=Signal(signal.time, signal.values / 9.80665, "g"))
    with pytest.raises(InputError, match="calibrated in m/s"):
        check(calibration, in_g, GRAVITY)
    with pytest.raises(InputError, match="same unit"):
        check(calibration, recorded(5, moved(lambda imu: imu.gyroscope.gain, element(0, 0, 0.08))), GRAVITY)
    swapped = replace(recording, accelerometer=replace(signal, values=signal.values[:, [1, 0, 2]]))
    with pytest.raises(InputError, match="axes"):
        check(calibration, swapped, GRAVITY)
    with pytest.raises(NotPossibleError, match="static pose"):
        check(calibration, recorded(5, poses=1), GRAVITY)
    with pytest.raises(InputError, match="no recording"):
        check(calibration, [], GRAVITY)


def test_other_temperatures_are_said(calibration, unmoved):
    recording = recorded(5)
    time = recording.accelerometer.time
    warm = replace(recording, temperature=Signal(time, np.full((len(time), 1), 40.0), "degC"))
    cold = replace(calibration, data={**calibration.data, "temperature": 22.0})
    (note,) = [note for note in check(cold, warm, GRAVITY, static=NOISE).notes if "°C" in note]
    assert "22.0 °C" in note
    assert "40.0 °C" in note
    assert not [note for note in unmoved.notes if "°C" in note]


def test_command(calibration, tmp_path, capsys):
    calibration.save(tmp_path / "calibration.json")
    log = tmp_path / "log.parquet"
    write_recording(recorded(5, moved(lambda imu: imu.accelerometer.bias, [0.03, 0.0, 0.0])), log)
    known = ["--gravity", f"{synthetic.GRAVITY}"]
    arguments = ["check", str(tmp_path / "calibration.json"), str(log), *known]
    assert main([*arguments, "--json", "-o", str(tmp_path / "out")]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "jaximu.check/1"
    assert document["verdict"] == "shifted"
    assert document == json.loads((tmp_path / "out" / "check.json").read_text(encoding="utf-8"))
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "accelerometer bias x" in page
    assert "nan" not in page.lower().split("base64")[0]
    assert (tmp_path / "out" / "check.png").stat().st_size > 10000
    assert main([*arguments, "--fail-on", "invalid"]) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "no longer valid: accelerometer bias x moved by +" in said and "mm/s²" in said
    write_recording(recorded(5), log)
    assert main(arguments) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "CALIBRATION" not in said and "jaximu compensate /" in said and "/calibration.json /" in said
    damaged = tmp_path / "damaged.json"
    damaged.write_text((tmp_path / "calibration.json").read_text(encoding="utf-8")[:500], encoding="utf-8")
    assert main(["check", str(damaged), str(log), *known]) == 2
    assert "damaged.json is not a calibration" in capsys.readouterr().err
