"""Smooth terms of a covariate: splines as they should be, found where nothing explains a misfit, and used like any."""

import json
from dataclasses import replace

import hidden_effects as hidden
import jax
import numpy as np
import pytest
from scipy.interpolate import BSpline

from jaximu import LocalGravity, read_recording
from jaximu.calibration import compensate, load_calibration
from jaximu.cli.app import main
from jaximu.cli.diagnose import give_diagnosis
from jaximu.cli.options import Results
from jaximu.diagnosis import diagnose
from jaximu.diagnosis.learned import learn, promising
from jaximu.model.effects import CATALOGUE
from jaximu.model.effects.learned import SHAPES, SPLINES, Learned, splines
from jaximu.model.sensor import Triad
from jaximu.model.stimulus import Stimulus
from jaximu.noise.at_rest import fit_noise

GRAVITY = LocalGravity(hidden.GRAVITY, 0.0)
CURVES = [kind for kind in CATALOGUE.values() if issubclass(kind, Learned)]


def bump(world, inner):
    """A phase change in the package: bias between two temperatures only. The catalogue has powers of temperature."""
    return np.exp(-0.5 * ((world.temperature - inner["at"]) / inner["width"]) ** 2)


BUMP = hidden.Kind(
    "accel", hidden.follow(bump), 3e-3, hidden.EACH, "m/s²", {"at": (24.0, 26.0), "width": (0.9, 1.1)},
    needs_temperature=True, single=True, suite="outside",
)  # fmt: skip


@pytest.fixture(scope="module")
def bumped(tmp_path_factory):
    """A recording with a hidden bump over temperature, diagnosed with another one held out; its case."""
    patch = pytest.MonkeyPatch()
    patch.setitem(hidden.KINDS, "outside.bump", BUMP)
    case = hidden.draw_case(7, ("outside.bump",), temperature=True, static_minutes=30).with_size(4.0)
    files = case.write(tmp_path_factory.mktemp("bump"))
    recordings = {part: read_recording(path) for part, path in files.items()}
    noise = fit_noise(recordings["static"])
    yield case, recordings, diagnose(recordings["fit"], GRAVITY, static=noise, heldout=recordings["heldout"])
    patch.undo()


def test_splines_are_those_of_scipy():
    share = np.linspace(0, 1, 57)
    knots = np.arange(-3, SPLINES + 1) / (SPLINES - 3)
    exact = BSpline.design_matrix(np.minimum(share, 1 - 1e-12), knots, 3).toarray()
    np.testing.assert_allclose(splines(share), exact, atol=1e-10)
    # constant and straight line exactly, the others free of both, in order of roughness
    np.testing.assert_allclose(exact @ SHAPES[:, :2], np.stack([np.ones(57), 2 * share - 1], axis=1), atol=1e-10)
    np.testing.assert_allclose(SHAPES[:, :2].T @ SHAPES[:, 2:], 0.0, atol=1e-12)
    assert np.all(np.diff(np.sum(np.diff(SHAPES[:, 2:], 2, axis=0) ** 2, axis=0)) > 0)


@pytest.mark.parametrize("kind", CURVES, ids=lambda kind: kind.name)
def test_a_curve_is_smooth_inside_and_constant_outside(kind):
    """Each axis follows its own cubic spline of the covariate; a kink inside would show in the third differences."""
    low, high = kind.dormant().interval()
    effect = kind.make(kind.typical * np.random.default_rng(3).standard_normal(kind.size))
    x = np.linspace(low - 0.5 * (high - low), high + 0.5 * (high - low), 401)
    field = kind.needs[0]
    covariate = x - 273.15 if field == "temperature" else x
    value = np.tile(covariate[:, None], 3) if field in ("specific_force", "angular_rate") else covariate
    found = np.asarray(effect.term(Stimulus(**{field: value})))
    assert found.shape == (401, 3)
    inside = (x >= low) & (x <= high)
    assert np.ptp(found[inside], axis=0).min() > 0
    for ends, place in ((x < low, inside.argmax()), (x > high, 400 - inside[::-1].argmax())):
        np.testing.assert_allclose(found[ends], np.tile(found[place], (int(ends.sum()), 1)), rtol=1e-9)
    knots = low + (high - low) * np.arange(-3, SPLINES + 1) / (SPLINES - 3)
    weights = SHAPES[:, kind.first :] @ np.asarray(effect.coefficients).reshape(3, -1).T
    exact = BSpline(knots, weights, 3)(x[inside])
    np.testing.assert_allclose(found[inside], exact, atol=1e-9 * kind.typical * SPLINES)
    # learned over what was there, and a fit does not move it
    spanned = kind.dormant(**kind.spanning(low, high))
    np.testing.assert_allclose(spanned.interval(), (low, high), rtol=1e-12)
    for name in kind.inner:
        slope = jax.jacfwd(lambda v, name=name: kind(effect.coefficients, **(
            {n: getattr(effect, n) for n in kind.inner} | {name: v})).term(Stimulus(**{field: value})))  # fmt: skip
        assert not np.any(np.asarray(slope(float(getattr(effect, name)))))


def test_a_bump_over_temperature_is_unexplained_and_learned(bumped):
    case, _, found = bumped
    assert found.verdict == "unexplained"
    learned = found.learned
    assert learned is not None
    assert learned.effect.name == "accel.learned_temperature"
    assert (learned.covariate, learned.triad) == ("temperature", "accelerometer")
    assert learned.gain.data == "another recording"
    assert learned.gain.log_likelihood > 50
    assert "The accelerometer's misfit depends on temperature." in found.summary().verdict
    assert "accel.learned_temperature" in found.suggestion
    # the curve against the truth, constants off: nine tenths within its 95 % band, which is not all there is
    truth = np.outer(bump(_At(learned.x - 273.15), case.hidden[0].inner), case.hidden[0].coefficients)
    error = learned.y - truth
    error -= np.average(error, axis=0, weights=1 / np.mean(learned.half_width, axis=1) ** 2)
    assert np.mean(np.abs(error) < learned.half_width) > 0.9
    axis = int(np.argmax(np.abs(case.hidden[0].coefficients)))
    size = np.abs(case.hidden[0].coefficients[axis])
    assert 0.6 * size < np.ptp(learned.y[:, axis]) < 1.3 * size
    assert learned.half_width[:, axis].max() < size


class _At:
    def __init__(self, temperature):
        self.temperature = temperature


def test_the_extended_calibration_is_kept_and_corrects_another_recording(bumped, tmp_path):
    case, recordings, found = bumped
    give_diagnosis(found, Results(tmp_path))
    document = json.loads((tmp_path / "diagnosis.json").read_text(encoding="utf-8"))
    assert document["learned"]["name"] == "accel.learned_temperature"
    assert document["learned"]["improvement"]["heldout_loglik"] > 50
    assert len(document["learned"]["curve"]["x"]) == len(document["learned"]["curve"]["y"]) > 50
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "What the misfit depends on" in page
    assert (tmp_path / "learned.png").stat().st_size > 5000
    kept = load_calibration(tmp_path / "calibration.json")
    (effect,) = kept.imu.accelerometer.effects
    assert effect.name == "accel.learned_temperature"
    # it is fitted once more, with the excess of the noise
    shift = np.asarray(effect.coefficients) - np.asarray(found.extended.effects[0].coefficients)
    spread = np.sqrt(np.diag(found.extended.covariance))[found.extended.places("accel.learned_temperature")]
    assert np.abs(shift / spread).max() < 0.1
    assert effect.interval() == found.extended.effects[0].interval()
    assert kept.diagnosis is not None
    assert kept.diagnosis["learned"] == "accel.learned_temperature"
    # against the truth of the held-out recording, at rest
    world, errors = case.world("heldout"), []
    true = world.force.reshape(case.protocol.samples, -1, 3).mean(axis=1)
    for calibration in (found.calibration, kept):
        done = compensate(calibration, recordings["heldout"]).accelerometer.values
        rests = [np.mean((done - true)[a:b], axis=0) for a, b in world.rests]
        errors.append(np.sqrt(np.mean(np.square(rests))))
    assert errors[1] < 0.6 * errors[0]


def test_curves_are_simulated_from_a_specification(tmp_path):
    spec = (
        '[protocol]\nkind = "hand-held"\nposes = 3\n[environment]\ntemperature = [[0, 10], [16, 40]]\n'
        '[effects."accel.learned_temperature"]\ncoefficients = {}\nlow = 280\nhigh = 320\n'
    )
    values = []
    for size in (0, 0.1):
        (tmp_path / "spec.toml").write_text(spec.format(size))
        assert main(["simulate", str(tmp_path / "spec.toml"), "-o", str(tmp_path / f"{size}.parquet")]) == 0
        values.append(read_recording(tmp_path / f"{size}.parquet"))
    added = values[1].accelerometer.values - values[0].accelerometer.values
    effect = CATALOGUE["accel.learned_temperature"].make(0.1, low=280.0, high=320.0)
    recorded = values[0].temperature
    warm = np.interp(values[0].accelerometer.time, recorded.time, recorded.values[:, 0])
    expected = np.asarray(effect.term(Stimulus(temperature=warm)))
    np.testing.assert_allclose(added, expected, atol=2e-4)
    assert np.ptp(expected) > 0.05


def test_a_curve_is_undone_by_recover():
    effect = CATALOGUE["gyro.learned_rate"].make(1e-3 * np.random.default_rng(5).standard_normal(24))
    triad = Triad(np.eye(3), np.zeros(3), (effect,), "angular_rate", "rad/s")
    rate = np.random.default_rng(6).uniform(-6, 6, (50, 3))
    output = triad.respond(Stimulus(angular_rate=rate))
    assert np.abs(output - rate).max() > 1e-3
    np.testing.assert_allclose(triad.recover(output), rate, atol=1e-12)


def test_a_bias_that_drifts_along_a_hump_is_named(tmp_path):
    """Neither ramp, warm-up nor step: a curve over time beside which nothing stands out is drift, and a cause."""
    case = hidden.draw_case(12, (), temperature=False, static_minutes=30)
    files = case.write(tmp_path, ("fit", "static"))
    recording = read_recording(files["fit"])
    gyroscope = recording.gyroscope
    share = np.linspace(0.0, 1.0, len(gyroscope))
    hump = np.exp(-(((share - 0.55) / 0.15) ** 2))
    amount = np.array([0.0, 2e-3, -1e-3]) * gyroscope.nominal_scale
    drifting = replace(recording, gyroscope=replace(gyroscope, values=gyroscope.values + hump[:, None] * amount))
    found = diagnose(drifting, GRAVITY, static=read_recording(files["static"]))
    assert (found.verdict, [cause.name for cause in found.named]) == ("effects", ["gyro.learned_time"])
    (drift,) = found.drifts
    assert found.gain.log_likelihood > 10 and found.learned is None
    # it is never used beyond the recording, and was predicted between poses; stretches stand beside that
    assert found.gain.data == "every 8th pose left out in turn"
    assert found.gain.smaller([drift.effect]) and found.gain.otherwise.data == "8 parts left out in turn"
    assert "bias drift along a curve" in found.summary().verdict[0]
    truth = np.interp(drift.x, gyroscope.time - gyroscope.time[0], hump) * 2e-3
    curve = drift.y[:, 1]
    assert np.corrcoef(curve, truth)[0, 1] > 0.95
    assert np.mean(np.abs(curve - truth - np.mean(curve - truth)) < drift.half_width[:, 1]) > 0.9


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """The diagnosis of a recording with nothing hidden."""
    case = hidden.draw_case(12, (), temperature=True, static_minutes=30)
    files = case.write(tmp_path_factory.mktemp("clean"), ("fit", "static"))
    return diagnose(read_recording(files["fit"]), GRAVITY, static=read_recording(files["static"]))


def test_nothing_hidden_nothing_learned(clean):
    assert clean.verdict == "adequate"
    assert clean.learned is None
    assert clean.document()["learned"] is None
    # nor would it be, were it asked
    candidate = promising(clean.experiment, clean.base)
    assert candidate is None or learn(clean.experiment, candidate) is None
