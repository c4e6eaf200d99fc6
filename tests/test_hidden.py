"""What a cause at its detection limit would do: against recordings in which it is hidden, of the same noise."""

import numpy as np
import pytest

import jaximu
from jaximu.diagnosis.hidden import hidden_causes, shift_by
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
    return jaximu.diagnose(recording(), GRAVITY, static=NOISE)


@pytest.mark.parametrize("name", ["accel.quadratic", "gyro.g_sensitivity"])
def test_a_hidden_cause_shifts_the_fit_as_was_said(sound, name):
    limit, _ = sound.detection_limits[name]
    size = CATALOGUE[name].dormant().size
    coefficients = np.random.default_rng(1).standard_normal(size)
    coefficients *= limit / np.linalg.norm(coefficients)
    hidden = jaximu.diagnose(recording(CATALOGUE[name](coefficients)), GRAVITY, static=NOISE)
    (block,) = (block for block in sound.base.evidence.blocks if block.name == name)
    predicted = shift_by(sound.base, block) @ coefficients
    numbers = [
        [np.asarray(getattr(state.imu.triads()[number.owner], number.part))[number.axes] for number in state.names]
        for state in (sound.base, hidden.base)
    ]
    moved = np.subtract(*reversed(numbers))[sound.base.fitted]
    sigmas = np.sqrt(np.diag(sound.base.covariance))[sound.base.fitted]
    np.testing.assert_allclose(moved / sigmas, predicted / sigmas, atol=0.15 * np.max(np.abs(predicted / sigmas)))


def test_the_worst_comes_first_and_each_number_is_named(sound):
    causes = hidden_causes(sound.base)
    assert [cause.name for cause in causes] != sorted(sound.detection_limits)
    worst = [cause.worst[1] for cause in causes]
    assert worst == sorted(worst, reverse=True) and worst[0] > 0.5
    assert {cause.name for cause in causes} == set(sound.detection_limits)
    names = {str(name) for name in sound.base.names}
    assert all(set(cause.shift) <= names for cause in causes)
