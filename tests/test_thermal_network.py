"""The neural network of temperature and its rate: what it is, where it pays, and where it does not."""

import json
from dataclasses import replace

import numpy as np
import pytest
from commands import result_of

from jaximu import calibration
from jaximu.calibration import calibrate_thermal, compensate, load_calibration
from jaximu.model.effects import CATALOGUE
from jaximu.model.stimulus import Stimulus
from jaximu.recordings import write_recording
from jaximu.simulation import simulate
from jaximu.simulation.draw import consumer_noise, draw_imu
from jaximu.simulation.protocols import SoakAndRamp

UNIT = draw_imu(3)
RATES = (1.0, 2.0, 4.0)
MIX = np.array([[0.3, -1.5, 1.0], [-0.5, 1.0, -0.5], [0.2, 0.8, 0.7]])
SIZES = {"accelerometer": 1e-3, "gyroscope": 1e-4}


def bias_of(kelvin, rate):
    """Two slopes with a knee at 25 °C, and a sensitivity to the rate that sets in above 30 °C; (n, 3), by hand."""
    knee = 3 * np.logaddexp(0, (kelvin - 25) / 3)
    quick = 600 * rate / (1 + np.exp(-(kelvin - 30) / 4))
    return np.stack([kelvin, knee, quick], axis=1) @ MIX.T


def felt(recording, time):
    """Temperature and its rate, taken over a minute."""
    assert recording.temperature is not None
    kelvin = np.interp(time, recording.temperature.time, recording.temperature.values[:, 0])
    return kelvin, np.gradient(np.convolve(np.pad(kelvin, 15, "edge"), np.ones(31) / 31, "valid"), time)


def chamber(rates, seed, bent=True, effects=()):
    protocol = SoakAndRamp(low=0.0, high=50.0, rates=rates, soak_duration=300.0)
    recording, _ = simulate(UNIT.with_effects(*effects), protocol, consumer_noise(), rate=0.5, seed=seed)
    if not bent:
        return recording
    changed = {}
    for name, size in SIZES.items():
        signal = getattr(recording, name)
        added = size * bias_of(*felt(recording, signal.time))
        changed[name] = replace(signal, values=signal.values + added)
    return replace(recording, **changed)


@pytest.fixture(scope="module")
def commanded(tmp_path_factory):
    """The command on a bent chamber: its folder, what was fitted in it and what it printed."""
    folder = tmp_path_factory.mktemp("network")
    write_recording(chamber(RATES, 4), folder / "log.parquet")
    line = ["thermal", str(folder / "log.parquet"), "--block", "40", "-o", str(folder / "out"), "--json", "--to", "px4"]
    return folder, *result_of(line, calibration, "calibrate_thermal")


@pytest.fixture(scope="module")
def bent(commanded):
    return commanded[1]


def test_the_effect_is_a_network_of_tanh():
    rng = np.random.default_rng(1)
    weights = rng.normal(size=(3, 4, 4))
    kind = CATALOGUE["gyro.learned_network"]
    effect = kind.make(weights.ravel(), low=263.15, high=323.15, reach=0.1)
    kelvin, rate = np.array([-20.0, 0.0, 25.0, 70.0]), np.array([0.0, 0.05, 0.0, -0.3])

    def of(axis, x, r):
        v, a, b, c = weights[axis]
        return sum(v[k] * np.tanh(a[k] * x + b[k] * r + c[k]) for k in range(4))

    x, r = np.array([-1.0, -2 / 3, 1 / 6, 1.0]), np.array([0.0, 0.5, 0.0, -1.0])  # held at the bounds of the range
    wanted = [[of(axis, *each) - of(axis, 1 / 6, 0.0) for axis in range(3)] for each in zip(x, r, strict=True)]
    found = effect.term(Stimulus(temperature=kelvin, temperature_rate=rate))
    np.testing.assert_allclose(found, wanted, rtol=1e-12)


def test_it_is_chosen_where_nothing_else_holds_and_predicts_ramps_left_out(bent):
    for fit in bent.fits.values():
        assert fit.candidate.family == "network"
        assert set(fit.candidate.names) == {"temperature", "learned_network"}
        held = {each.family: float(np.linalg.norm(each.held.rms)) for each in fit.candidates}
        assert held["network"] < 0.15 * held["cubic"] and held["network"] < 0.5 * held["spline"]
        assert any("whose 95 % band" in note for note in bent.notes)
        assert 10 < fit.candidate.parameters < 51  # the prior leaves fewer than its 48 weights and three slopes


def test_another_recording_at_another_rate_is_compensated(bent, tmp_path):
    """A ramp at 3 K/min was in no fit: what is left of it, by the file, against a cubic's."""
    other = chamber((3.0,), 9)
    bent.calibration.save(tmp_path / "calibration.json")
    loaded = load_calibration(tmp_path / "calibration.json")
    left = compensate(loaded, other)
    for name, size in SIZES.items():
        signal = getattr(other, name)
        kelvin, rate = felt(other, signal.time)
        added = size * bias_of(kelvin, rate)
        removed = signal.values - getattr(left, name).values
        error = np.std(_means(removed - added), axis=0)
        cubic = [np.std(_means(y - np.polyval(np.polyfit(kelvin, y, 3), kelvin))) for y in added.T]
        assert np.linalg.norm(error) < 0.25 * np.linalg.norm(cubic)


def _means(values):
    return np.stack([part.mean(axis=0) for part in np.array_split(values, 60)])


def test_the_steady_bias_is_near_what_was_put_in(bent):
    """It was never steady in the fit; the band is that of a network, which the truth is not, and covers less."""
    kelvin = np.linspace(bent.blocks.range[0], bent.blocks.range[1], 60)
    wanted = bias_of(kelvin, np.zeros(60)) - bias_of(np.array([25.0]), np.zeros(1))
    for name, size in SIZES.items():
        value, sigma = bent.bias(name, kelvin)
        assert np.max(np.abs(value - size * wanted)) < 0.03 * size * np.ptp(wanted)
        assert np.mean(np.abs(value - size * wanted) < 1.96 * sigma) > 0.5


def test_the_band_holds_a_network_that_was_put_in():
    """Two tanh an axis: a knee in temperature, and a rate that counts when warm."""
    weights = np.zeros((3, 4, 4))  # of the output, of x, of r, constants
    weights[:, 0, :2] = [[3.0, 1.5], [-2.0, 2.5], [1.0, -3.0]]
    weights[:, 1, :2], weights[:, 2, :2], weights[:, 3, :2] = [3.0, 1.0], [0.0, 3.0], [-0.5, 0.5]
    covered = []
    effects = []
    for prefix, size in (("accel", 1e-3), ("gyro", 1e-4)):
        own = weights.copy()
        own[:, 0] *= size
        effects.append(CATALOGUE[f"{prefix}.learned_network"].make(own.ravel(), low=273.15, high=323.15, reach=0.07))
    kelvin = np.linspace(2.0, 48.0, 40)
    for seed in range(8, 11):  # of one draw the points of a curve are off together
        found = calibrate_thermal(chamber(RATES, seed, False, effects), block=40.0)
        for effect, (name, fit) in zip(effects, found.fits.items(), strict=True):
            assert fit.candidate.family == "network"
            for rate in (0.0, 0.03):
                stimulus = Stimulus(temperature=kelvin, temperature_rate=np.full(40, rate))
                value, sigma = found.bias(name, kelvin, rate)
                covered.append(np.abs(value - np.asarray(effect.term(stimulus))) < 1.96 * np.maximum(sigma, 1e-12))
    assert 0.85 < np.mean(covered) < 1.0


def test_it_is_not_chosen_where_a_quadratic_is_true():
    effects = [CATALOGUE[f"{prefix}.temperature{power}"].make(np.array(c) * size)
               for prefix, size in (("accel", 1.0), ("gyro", 0.1))
               for power, c in (("", [1e-3, -2e-3, 1.5e-3]), ("_squared", [1e-5, 2e-5, -1e-5]))]  # fmt: skip
    found = calibrate_thermal(chamber(RATES, 5, False, effects), block=40.0)
    for fit in found.fits.values():
        assert set(fit.candidate.names) == {"temperature", "temperature_squared"}
        assert not any(each.family == "network" for each in fit.candidates)  # nothing is left that it could follow
    asked = calibrate_thermal(chamber(RATES, 5, False, effects), block=40.0, families=("polynomial", "network"))
    for fit in asked.fits.values():
        assert set(fit.candidate.names) == {"temperature", "temperature_squared"}
        network = next(each for each in fit.candidates if each.family == "network")
        assert network.held.rms == pytest.approx(fit.candidate.held.rms, rel=0.3)  # it fits, and is not worth it


def test_the_command_writes_the_network_that_was_fitted(commanded):
    folder, bent, printed = commanded
    document = json.loads(printed)
    assert document["gyroscope"]["model"] == "network"
    for prefix, name in (("accel", "accelerometer"), ("gyro", "gyroscope")):
        effects = document["calibration"][name]["effects"]
        assert set(effects) == {f"{prefix}.{each}" for each in bent.fits[name].candidate.names}
        for effect in bent.fits[name].effects:
            np.testing.assert_array_equal(effects[effect.name]["coefficients"], effect.coefficients)
    entry = document["calibration"]["gyroscope"]["effects"]["gyro.learned_network"]
    assert len(entry["coefficients"]) == 48 and len(entry["sigma"]) == 48
    assert "learned_network" in (folder / "out" / "px4.params").read_text()
