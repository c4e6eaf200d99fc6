"""The catalogue: every effect says what it is, and is what it says."""

import inspect
import re

import jax.numpy as jnp
import numpy as np
import pytest
from test_sensor import SHAPES, stimulus

from jaximu.effects import CATALOGUE, AccelQuadratic, Effect, GyroQuadratic
from jaximu.sensor import Stimulus

EVERY = pytest.mark.parametrize("kind", CATALOGUE.values(), ids=CATALOGUE)


@EVERY
def test_metadata_is_complete(kind):
    assert issubclass(kind, Effect)
    assert CATALOGUE[kind.name] is kind
    assert re.fullmatch(r"(accel|gyro|setup)\.[a-z_]+", kind.name)
    for text in (kind.formula, kind.unit, kind.excited_by, kind.source, inspect.getdoc(kind)):
        assert isinstance(text, str)
        assert text.strip()
    assert kind.scope in ("device", "session", "fixture")
    assert kind.size > 0
    assert 0 < kind.typical < np.inf
    assert isinstance(kind.look_alikes, tuple)
    assert kind.name not in kind.look_alikes
    assert all(re.fullmatch(r"(accel|gyro|setup)\.[a-z_]+", other) for other in kind.look_alikes)
    assert kind.unit.startswith("output")


@EVERY
def test_dormant_effect_is_absent(kind):
    effect = kind.dormant()
    assert effect.coefficients.shape == (kind.size,)
    np.testing.assert_array_equal(effect.term(stimulus((4,))), np.zeros((4, 3)))


@EVERY
@pytest.mark.parametrize("shape", SHAPES)
def test_term_is_linear_in_its_coefficients_and_takes_any_batch(kind, shape):
    true = stimulus(shape)
    a, b = (jnp.asarray(np.random.default_rng(seed).standard_normal(kind.size)) for seed in (0, 1))
    term = kind(a).term(true)
    assert term.shape == (*shape, 3)
    np.testing.assert_allclose(kind(a + 2 * b).term(true), term + 2 * kind(b).term(true), rtol=1e-12, atol=1e-12)


def test_quadratic_is_even_in_its_input_and_acts_axis_by_axis():
    for kind, field in ((AccelQuadratic, "specific_force"), (GyroQuadratic, "angular_rate")):
        effect = kind(jnp.array([1e-3, -2e-3, 3e-3]))
        value = jnp.array([2.0, -3.0, 4.0])
        np.testing.assert_allclose(effect.term(Stimulus(**{field: value})), [4e-3, -18e-3, 48e-3], rtol=1e-14)
        np.testing.assert_array_equal(effect.term(Stimulus(**{field: value})), effect.term(Stimulus(**{field: -value})))
        np.testing.assert_array_equal(effect.term(Stimulus(**{field: jnp.zeros(3)})), np.zeros(3))
