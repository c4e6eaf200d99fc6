"""What to record next: causes that one recording ties together, and the recording that tells them apart."""

import itertools

import numpy as np
import pytest
import scipy.stats

from jaximu.diagnosis import diagnose
from jaximu.diagnosis.diagnosis import Option
from jaximu.model import NoiseModel
from jaximu.model.effects import CATALOGUE
from jaximu.noise.at_rest import fit_noise
from jaximu.planning import separation
from jaximu.planning.separation import advised
from jaximu.simulation import simulate
from jaximu.simulation.draw import consumer_noise, draw_imu
from jaximu.simulation.protocols import Environment, HandHeld, Static

UNIT = draw_imu(3)
WARMING = CATALOGUE["accel.temperature"].make([2e-3, -1e-3, 1e-3])
TWINS = {"accel.temperature", "accel.bias_ramp"}
POSES = 24


@pytest.fixture(scope="module")
def noise() -> NoiseModel:
    return fit_noise(simulate(UNIT, Static(900.0), consumer_noise(), seed=9)[0])


@pytest.fixture(scope="module")
def tied(noise):
    """A monotone warm-up at a constant rate: temperature and time are one direction."""
    environment = Environment(temperature=[[0.0, 20.0], [140.0, 24.0]])
    unit = UNIT.with_effects(WARMING)
    recording, _ = simulate(unit, HandHeld(POSES), consumer_noise(), seed=3, environment=environment)
    return diagnose(recording, static=noise)


def test_a_cycle_of_temperature_tells_temperature_from_time(tied, noise, monkeypatch):
    monkeypatch.setattr(separation, "_POSES", POSES)
    candidates = separation._candidates
    monkeypatch.setattr(separation, "_candidates", lambda *given: itertools.islice(candidates(*given), 1))
    (cause,) = tied.effects
    assert {cause.name, *cause.rivals} >= TWINS
    advice = advised(tied)
    found = advice.options
    (other,) = TWINS - {cause.name}
    assert all(each.powers[other] > 0.9 and each.before[other] < 0.1 for each in found)
    assert "up and down" in advice.suggestion and other in advice.suggestion
    assert advice.document()["next"][0]["power"][other] > 0.9
    # and so it is: the suggested recording, made with the unit that has the effect, no longer ties it to time
    length = POSES * 5.5
    environment = Environment(temperature=[[0.0, 22.0], [length / 2, 42.0], [length, 22.0]])
    unit = UNIT.with_effects(WARMING)
    recording, _ = simulate(unit, HandHeld(POSES), consumer_noise(), seed=5, environment=environment)
    (named,) = diagnose(recording, static=noise).effects
    assert "accel.temperature" in {named.name, *named.rivals} and "accel.bias_ramp" not in {named.name, *named.rivals}


@pytest.mark.parametrize(("power", "heeded"), [(0.994, False), (0.2, False), (1.0, True)])
def test_a_recording_that_shows_no_more_than_this_one_is_not_advised(tied, monkeypatch, power, heeded):
    """Measured: "That would show it with 100 % probability; this recording, with 100 %"."""

    def made(diagnosis, cause):
        return (
            Option("record 40 poses by hand", dict.fromkeys(cause.rivals, power), dict.fromkeys(cause.rivals, 0.99)),
        )

    monkeypatch.setattr(separation, "options", made)
    advice = advised(tied)
    assert (advice.suggestion != tied.suggestion) == heeded
    assert len(advice.options) == 1


def test_the_power_is_that_of_the_score_test(tied):
    """Against draws of the linear problem: cause in the data, rival in the model."""
    experiment, imu = tied.experiment, tied.base.imu
    effects = [CATALOGUE["accel.quadratic"].make(3e-5), CATALOGUE["accel.asymmetry"].make(3e-4)]
    power = separation._powers(experiment, imu, effects)["accel.asymmetry"]
    linear, used = experiment.linearise(imu), experiment.used
    white = np.linalg.inv(np.linalg.cholesky(linear.covariance[np.ix_(used, used)]))
    slope = white @ linear.slope[used]
    columns = [
        white @ experiment.dormant_columns(imu, linear.details, {type(e): [{}]})[type(e)][0][used] for e in effects
    ]
    rng, rates = np.random.default_rng(1), []
    for cause, rival in ((0, 1), (1, 0)):
        taken = np.linalg.qr(np.concatenate([slope, columns[rival]], axis=1))[0]
        asked = columns[cause] - taken @ (taken.T @ columns[cause])
        asked = np.linalg.qr(asked)[0]
        signal = columns[cause] @ np.asarray(effects[cause].coefficients)
        drawn = signal + rng.standard_normal((4000, len(signal)))
        drawn = drawn - drawn @ taken @ taken.T
        rates.append(np.mean(np.sum((drawn @ asked) ** 2, axis=1) > scipy.stats.chi2.isf(0.01, 3)))
    assert power == pytest.approx(min(rates), abs=4 * np.sqrt(0.25 / 4000))
    assert 0.05 < power < 0.999  # else the comparison says little


def test_an_effect_that_the_recording_cannot_show_has_no_power(tied):
    vibration = CATALOGUE["accel.vibration_rectification"].make(1.0)
    assert separation._powers(tied.experiment, tied.base.imu, [vibration]) == {vibration.name: 0.0}
