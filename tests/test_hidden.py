"""What a cause at its detection limit would do: against recordings in which it is hidden, of the same noise."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

import jaximu
from jaximu.cli import main
from jaximu.diagnosis.diagnosis import recorded_by_hand
from jaximu.diagnosis.experiment import Experiment
from jaximu.diagnosis.hidden import _weakest, hidden_causes, shift_by
from jaximu.model.effects import CATALOGUE
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld

GRAVITY = jaximu.LocalGravity(9.80665, 0.0)
WHITE = {name: noise.processes[0].size for name, noise in consumer_noise().items()}
NOISE = NoiseModel(*(AxisNoise.of_white(WHITE[name] ** 2) for name in ("accelerometer", "gyroscope")))


def recording(*effects):
    return simulate(draw_imu(3).with_effects(*effects), HandHeld(24, 2.0, 1.0), consumer_noise(), rate=50.0, seed=4)[0]


@pytest.fixture(scope="module")
def sound():
    return fitted(recording())


LIMITS = """
[limits]
"gyroscope.bias" = "3 deg/s"
[nominal]
"""


def fitted(made):
    """Gain and bias alone, fitted to what was recorded with the noise that it has."""
    calibration = jaximu.calibrate(made, GRAVITY, static=NOISE)
    return Experiment(recorded_by_hand(calibration).with_noise(NOISE), calibration.imu).fit()


@pytest.mark.parametrize("name", ["accel.quadratic", "gyro.g_sensitivity"])
def test_a_hidden_cause_shifts_the_fit_as_was_said(sound, name):
    limit, _ = sound.limits[name]
    size = CATALOGUE[name].dormant().size
    coefficients = np.random.default_rng(1).standard_normal(size)
    coefficients *= limit / np.linalg.norm(coefficients)
    hidden = fitted(recording(CATALOGUE[name](coefficients)))
    (block,) = (block for block in sound.evidence.blocks if block.name == name)
    predicted = shift_by(sound, block) @ coefficients
    numbers = [
        [np.asarray(getattr(state.imu.triads()[number.owner], number.part))[number.axes] for number in state.names]
        for state in (sound, hidden)
    ]
    moved = np.subtract(*reversed(numbers))[sound.fitted]
    sigmas = np.sqrt(np.diag(sound.covariance))[sound.fitted]
    np.testing.assert_allclose(moved / sigmas, predicted / sigmas, atol=0.15 * np.max(np.abs(predicted / sigmas)))


def test_the_worst_comes_first_and_each_number_is_named(sound):
    causes = hidden_causes(sound)
    assert [cause.name for cause in causes] != sorted(sound.limits)
    worst = [cause.worst[1] for cause in causes]
    assert worst == sorted(worst, reverse=True) and worst[0] > 0.5
    assert {cause.name for cause in causes} == set(sound.limits)
    names = {str(name) for name in sound.names}
    assert all(set(cause.shift) <= names for cause in causes)


def test_intervals_that_allow_for_it_hold(sound):
    """Of a unit that hides a cubic of the size of its limit in each sensor: some of the plain intervals are far off."""
    shifts = [cause.shift for cause in hidden_causes(sound)]
    sizes = {name: sound.limits[name][0] / np.sqrt(3) for name in ("accel.cubic", "gyro.cubic")}
    made = recording(*(CATALOGUE[name](size * np.ones(3)) for name, size in sizes.items()))
    plain = jaximu.calibrate(made, GRAVITY, static=NOISE)
    truth = draw_imu(3).triads()
    errors = [
        np.asarray(getattr(plain.triads()[name.owner], name.part) - getattr(truth[name.owner], name.part))[name.axes]
        for name in plain.names
    ]
    over, wider = (
        np.abs(errors) / np.sqrt(np.diagonal(each.covariance)) for each in (plain, plain.allowing_for(shifts))
    )
    assert over.max() > 3 and wider.max() < 3


def test_accept_allows_for_what_the_recording_cannot_see(sound, tmp_path, capsys):
    calibration = jaximu.calibrate(recording(), GRAVITY, static=NOISE)
    file, limits, diagnosis = (str(tmp_path / name) for name in ("calibration.json", "limits.toml", "diagnosis.json"))
    calibration.save(file)
    (tmp_path / "limits.toml").write_text(LIMITS, encoding="utf-8")
    document = {"schema": "jaximu.diagnosis/1", "data": calibration.data}
    document["hidden"] = [{"shift": cause.shift | {"gyroscope.bias[1]": 1e6}} for cause in hidden_causes(sound)]
    (tmp_path / "diagnosis.json").write_text(json.dumps(document), encoding="utf-8")
    assert main(["accept", file, "--limits", limits]) == 0
    assert main(["accept", file, "--limits", limits, "--diagnosis", diagnosis]) == 4
    assert "each as large as its detection limit" in " ".join(capsys.readouterr().out.split())
    other = document | {"data": calibration.data | {"files": [{"file": "other.csv"}]}}
    (tmp_path / "diagnosis.json").write_text(json.dumps(other), encoding="utf-8")
    assert main(["accept", file, "--limits", limits, "--diagnosis", diagnosis]) == 2
    assert "is the diagnosis of other.csv" in " ".join(capsys.readouterr().err.split())
    del document["hidden"]
    (tmp_path / "diagnosis.json").write_text(json.dumps(document), encoding="utf-8")
    assert main(["accept", file, "--limits", limits, "--diagnosis", diagnosis]) == 2


def test_of_combinations_that_nothing_shows_the_first_is_named():
    """Which one a factorisation came upon first was chance: pages differed from machine to machine."""
    block, random = SimpleNamespace(name="effect", sizes=np.ones(3)), np.random.default_rng(1)
    for rounding in 1e-17 * random.standard_normal((20, 3, 3)):
        information = np.diag([0.0, 1.0, 0.0]) + rounding + rounding.T
        evidence = SimpleNamespace(blocks=[block], information=lambda _, shown=information: shown)
        weights, limit = _weakest(evidence, "effect", 1.0)
        assert limit == np.inf
        np.testing.assert_allclose(weights, [1.0, 0.0, 0.0], atol=1e-9)
