"""How a reference is mounted: against SciPy, against the effects that say it, and there and back."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaximu.model.mounting import MOUNTING_EFFECTS, Mounting
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus

START = {
    "rotation": [0.3, -0.2, 0.5],
    "delay": 0.04,
    "tilt": [0.02, -0.01],
    "filter_variance": 4e-4,
    "lever_arm": [0.1, 0.2, -0.3],
    "clock_scale": 2e-3,
    "field": [20.0, 1.0, -44.0],
}


@pytest.fixture
def unit():
    return Imu.nominal().with_effects(*Mounting.effects(**START))


def test_a_mounting_has_what_the_effects_of_a_unit_say(unit):
    mounting = Mounting.of(unit)
    for name, value in START.items():
        np.testing.assert_array_equal(getattr(mounting, name), value)
    numbers = jnp.hstack(mounting)
    assert len(numbers) == sum(kind.size for kind in MOUNTING_EFFECTS)
    for there, back in zip(mounting, Mounting.from_numbers(numbers), strict=True):
        np.testing.assert_array_equal(there, back)
    assert not np.any(jnp.hstack(Mounting.of(Imu.nominal())))


def test_stamps_are_put_on_the_logs_clock_and_back(unit):
    """At each time of the log the effects look the reference up where `on_reference` says."""
    mounting, times = Mounting.of(unit), np.linspace(0.0, 10.0, 101)
    np.testing.assert_allclose(mounting.on_log(mounting.on_reference(times)), times, atol=1e-12)
    assert float(mounting.on_log(1.04)) == pytest.approx(1.002)
    late = Imu.nominal().with_effects(*Mounting.effects(delay=0.04, clock_scale=2e-3))
    looked_up = late.acted(Stimulus(temperature=times, time=times), "angular_rate").temperature
    np.testing.assert_allclose(looked_up[:-2], mounting.on_reference(times)[:-2], atol=1e-9)


def test_attitudes_turn_as_scipy_and_the_effects_turn_them(unit):
    mounting = Mounting.of(unit)
    attitudes = Rotation.random(5, random_state=3)
    reported = attitudes.as_quat(scalar_first=True)
    expected = Rotation.from_rotvec([0.02, -0.01, 0.0]) * attitudes * Rotation.from_rotvec(START["rotation"])
    turned = np.asarray(mounting.unit_attitude(reported))
    np.testing.assert_allclose(Rotation.from_quat(turned, scalar_first=True).as_matrix(), expected.as_matrix())
    np.testing.assert_allclose(mounting.reported(turned), reported, atol=1e-12)
    still = np.zeros((5, 3))
    path = Stimulus(still, still, attitude=reported, time=np.arange(5.0))
    askew = Imu.nominal().with_effects(*Mounting.effects(rotation=START["rotation"], tilt=START["tilt"]))
    np.testing.assert_allclose(askew.acted(path, "specific_force").attitude, turned, atol=1e-12)
