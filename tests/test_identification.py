"""The terms of the Allan variance come back from simulated noise with intervals that cover, and from measured noise."""

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.stats import binom

from jaximu.errors import InputError, NotPossibleError
from jaximu.noise import (
    BiasInstability,
    FirstOrderGaussMarkov,
    Noise,
    Quantisation,
    RandomWalk,
    RateRamp,
    White,
    identify,
)
from jaximu.noise.deviations import averaging_factors, deviation
from jaximu.noise.identification import TERMS, _basis, _covariance

SAMPLES, RATE = 1 << 15, 50.0
SCENES = {  # each term rules a decade of averaging times or more
    "NK": (White(0.01), RandomWalk(2e-3)),
    "NB": (White(0.002), BiasInstability(4e-3)),
    "NQ": (White(0.002), Quantisation(1.5e-3)),
    "NR": (White(0.01), RateRamp(1e-4)),
    "N": (White(0.01),),
}


def axes_of(processes, count, samples=SAMPLES, seed=0):
    units = -(-count // 3)
    noise = Noise(processes).sample(samples, RATE, seed=seed, shape=(units,))
    return noise.transpose(0, 2, 1).reshape(-1, samples)[:count]


@pytest.mark.parametrize("name", SCENES)
def test_terms_come_back_with_intervals_that_cover(name):
    """60 axes: a term that is there is found and inside its 95 % interval as often as its binomial bound allows."""
    count = 60
    found = identify(axes_of(SCENES[name], count), RATE)
    low = binom.ppf(1e-4, count, 0.93)  # selection may miss a term now and then: 93 % is the goal's lower end
    for process in SCENES[name]:
        true = float(np.asarray(getattr(process, process.letter)))
        terms = [each.terms[process.letter] for each in found]
        covered = sum(term is not None and term.low <= true <= term.high for term in terms)
        assert covered >= low, (process.letter, covered)
        values = np.array([term.value for term in terms if term is not None])
        assert abs(np.median(values) / true - 1) < 0.05
    for other in set(TERMS) - set(name):  # a term that is not there is seldom claimed
        assert sum(each.terms[other] is not None for each in found) <= 15
    misfit = np.mean([each.misfit[0] / each.misfit[1] for each in found])
    assert 0.7 < misfit < 1.3


def test_the_covariance_of_allan_variances_is_that_of_many_records():
    for processes in (SCENES["NK"], SCENES["NQ"]):
        records = axes_of(processes, 300, 4096, seed=5)
        factors = averaging_factors(1024)
        variances = deviation(records, RATE, "overlapping", factors, exponent=0).value ** 2
        terms = "".join(process.letter for process in processes)
        theta = np.array([float(np.asarray(getattr(p, p.letter))) ** 2 for p in processes])
        np.testing.assert_allclose(variances.mean(axis=0), _basis(factors.astype(float), RATE, terms) @ theta, rtol=0.2)
        stated = _covariance(theta, terms, factors, 4096, RATE)
        measured = np.cov(variances.T)
        spread = np.sqrt(np.diag(stated))
        # 300 records tell a standard deviation to 4 % and a correlation to 0.06; long averages lean on few differences
        np.testing.assert_allclose(np.sqrt(np.diag(measured)) / spread, 1.0, atol=0.25)
        np.testing.assert_allclose(measured / np.outer(spread, spread), stated / np.outer(spread, spread), atol=0.35)


def test_reading_the_walk_as_instability_misleads():
    """S4: with white noise and a walk there is no flat part; the walk K must come back, and B must not be claimed."""
    found = identify(axes_of(SCENES["NK"], 9), RATE)
    assert sum(each.terms["B"] is None and each.terms["K"] is not None for each in found) >= 7


def test_one_axis_or_several_and_units_of_the_result():
    signals = axes_of(SCENES["NK"], 2)
    alone, several = identify(signals[0], RATE, "NK"), identify(signals, RATE, "NK")
    assert alone.terms == several[0].terms
    assert set(alone.terms) == {"N", "K"}
    doubled = identify(2 * signals[0], RATE, "NK")
    assert doubled.terms["K"].value == pytest.approx(2 * alone.terms["K"].value, rel=1e-6)
    slower = identify(signals[0], RATE / 4, "NK")  # the same numbers at a quarter of the rate
    assert slower.terms["N"].value == pytest.approx(2 * alone.terms["N"].value, rel=1e-6)
    assert slower.terms["K"].value == pytest.approx(alone.terms["K"].value / 2, rel=1e-6)
    fitted = alone.allan_deviation(alone.deviation.tau)
    np.testing.assert_allclose(fitted, alone.deviation.value, rtol=0.4)


def test_a_gap_hardly_changes_what_is_found():
    signal = axes_of(SCENES["NK"], 1)[0].copy()
    whole = identify(signal, RATE, "NK").terms
    signal[5000:5040] = np.nan
    holed = identify(signal, RATE, "NK").terms
    assert holed["N"].value == pytest.approx(whole["N"].value, rel=0.01)
    assert holed["K"].low < whole["K"].value < holed["K"].high


def test_a_process_outside_the_terms_shows_as_misfit():
    bump = (White(1e-3), FirstOrderGaussMarkov.of(0.03, 0.5))
    misfit = [each.misfit[0] / each.misfit[1] for each in identify(axes_of(bump, 3), RATE)]
    assert min(misfit) > 3


def test_two_runs_of_a_measured_sensor_agree(data_folder):
    """ADIS16405, two recordings of 2.8 hours: the white noise of every axis agrees within 3 %."""
    found = []
    for run in ("run1", "run2"):
        table = pq.read_table(data_folder / "adis16405_static" / f"{run}.parquet")
        names = [name for name in table.column_names if name.startswith(("gyro", "accel"))]
        signals = np.stack([table.column(name).to_numpy() for name in names])[:, : 1 << 18]
        found.append([each.terms["N"].value for each in identify(signals, 100.0)])
    np.testing.assert_allclose(found[0], found[1], rtol=0.03)


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: identify(np.ones(100), 1.0), NotPossibleError, "too few to identify"),
        (lambda: identify(np.ones(1000), 1.0), NotPossibleError, "no noise to identify"),
        (lambda: identify(np.zeros((2, 3, 1000)), 1.0), InputError, "found shape"),
        (lambda: identify(np.zeros(1000), 1.0, "NX"), InputError, "terms must be some of"),
        (lambda: identify(np.zeros(1000), 1.0, "NN"), InputError, "terms must be some of"),
        (lambda: identify(np.random.default_rng(0).standard_normal(1000), 0.0), InputError, "rate"),
    ],
)
def test_what_makes_no_sense_is_refused(make, error, words):
    with pytest.raises(error, match=words):
        make()
