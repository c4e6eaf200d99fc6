"""The sensor model: forward, exactly back, under every transformation; every effect asleep and awake."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import GRAVITY, unit

from jaximu.effects import CATALOGUE
from jaximu.sensor import Imu, Stimulus, Triad

SHAPES = ((), (1,), (3, 1, 2))
QUANTITY = {"accel": "specific_force", "gyro": "angular_rate"}
respond, recover = eqx.filter_jit(Triad.respond), eqx.filter_jit(Triad.recover)


def stimulus(shape, seed=0) -> Stimulus:
    """Any direction of gravity, rates up to some 250 °/s."""
    random = np.random.default_rng(seed)
    force = random.standard_normal((*shape, 3))
    force *= GRAVITY / np.linalg.norm(force, axis=-1, keepdims=True)
    rate = np.clip(2 * random.standard_normal((*shape, 3)), -4.5, 4.5)
    return Stimulus(
        jnp.asarray(force), jnp.asarray(rate), jnp.asarray(random.standard_normal((*shape, 3))),
        jnp.asarray(25 + 10 * random.standard_normal(shape)), jnp.asarray(0.02 * random.standard_normal(shape)),
        jnp.asarray(100 * random.uniform(size=shape)),
    )  # fmt: skip


def triad_with(names, size=0.0, sign=1.0) -> Triad:
    """A triad with effects whose coefficients are `size` times typical, of mixed signs."""
    imu = unit(5)
    triad = imu.accelerometer if names[0].startswith("accel") else imu.gyroscope
    effects = []
    for name in names:
        kind = CATALOGUE[name]
        signs = sign * (-1.0) ** np.arange(kind.size)
        effects.append(kind(jnp.asarray(size * kind.typical * signs)))
    return eqx.tree_at(lambda t: t.effects, triad, tuple(effects))


def sensed(triad, true):
    return getattr(true, triad.quantity)


def test_linear_model_by_hand():
    triad = Triad(jnp.array([[2.0, 0, 0], [0.1, 3, 0], [0, 0, 4]]), jnp.array([1.0, 0, -1]))
    output = respond(triad, Stimulus(jnp.array([1.0, 2, 3])))
    np.testing.assert_allclose(output, [3.0, 6.1, 11.0], atol=1e-15)
    np.testing.assert_allclose(recover(triad, output), [1.0, 2, 3], atol=1e-15)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("quantity", ["accelerometer", "gyroscope"])
def test_round_trip_without_effects(quantity, shape):
    triad, true = getattr(unit(3), quantity), stimulus(shape)
    output = respond(triad, true)
    assert output.shape == (*shape, 3)
    np.testing.assert_allclose(recover(triad, output), sensed(triad, true), rtol=0, atol=1e-14)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", CATALOGUE)
def test_round_trip_with_effects_ten_times_their_usual_size(name, shape):
    for sign in (1.0, -1.0):
        triad, true = triad_with([name], 10.0, sign), stimulus(shape)
        output = respond(triad, true)
        linear = eqx.tree_at(lambda t: t.effects, triad, ())
        assert np.abs(output - respond(linear, true)).max() > 1e-3
        np.testing.assert_allclose(recover(triad, output, true), sensed(triad, true), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", CATALOGUE)
def test_the_recovered_input_does_not_use_the_true_one(name):
    """`recover` may be given the rest of the stimulus; what it solves for must come from the output alone."""
    triad, true = triad_with([name], 1.0), stimulus((4,))
    other = eqx.tree_at(lambda s: sensed(triad, s), true, jnp.full((4, 3), 1e3))
    output = respond(triad, true)
    np.testing.assert_allclose(recover(triad, output, other), recover(triad, output, true), atol=1e-12)


@pytest.mark.parametrize("prefix", QUANTITY)
def test_all_effects_of_a_triad_together_under_every_transformation(prefix):
    names = [name for name in CATALOGUE if name.startswith(prefix)]
    triad, true = triad_with(names, 1.0), stimulus((5,))
    output = respond(triad, true)
    np.testing.assert_allclose(recover(triad, output, true), sensed(triad, true), atol=1e-11)

    by_vmap = jax.jit(jax.vmap(lambda y, u: triad.recover(y, u)))(output, true)
    np.testing.assert_allclose(by_vmap, recover(triad, output, true), atol=1e-14)

    def value(output, true):
        return triad.recover(output, true)

    def forward(sensed_value, true):
        return triad.respond(eqx.tree_at(lambda s: getattr(s, triad.quantity), true, sensed_value))

    inverse = jax.jit(jax.vmap(jax.jacfwd(value)))(output, true)
    slope = jax.jit(jax.vmap(jax.jacfwd(forward)))(sensed(triad, true), true)
    np.testing.assert_allclose(inverse @ slope, np.broadcast_to(np.eye(3), (5, 3, 3)), atol=1e-9)
    reverse = jax.jit(jax.vmap(jax.jacrev(value)))(output, true)
    np.testing.assert_allclose(reverse, inverse, atol=1e-12)


@pytest.mark.parametrize("name", CATALOGUE)
def test_derivative_by_a_dormant_effect(name):
    """What a score test asks for: the slope by coefficients that are zero, forward and through the inverse."""
    triad, true = triad_with([name]), stimulus((4,))
    output = respond(triad, true)
    np.testing.assert_array_equal(output, respond(eqx.tree_at(lambda t: t.effects, triad, ()), true))

    def at(coefficients, function, *arguments):
        awake = eqx.tree_at(lambda t: t.effects[0].coefficients, triad, coefficients)
        return function(awake, *arguments)

    zero = jnp.zeros(CATALOGUE[name].size)
    step = 1e-4 * CATALOGUE[name].typical
    for function, *arguments in ((Triad.respond, true), (Triad.recover, output, true)):
        run = jax.jit(lambda c, f=function, a=tuple(arguments): at(c, f, *a))
        slope = jax.jit(jax.jacfwd(run))(zero)
        central = np.stack([(run(zero + d) - run(zero - d)) / (2 * step) for d in step * np.eye(len(zero))], axis=-1)
        assert np.abs(slope).max() > 0
        np.testing.assert_allclose(slope, central, rtol=1e-6, atol=1e-7 * np.abs(slope).max())


def test_imu():
    imu, true = unit(1), stimulus((2,))
    force, rate = imu.respond(true)
    np.testing.assert_allclose(force, respond(imu.accelerometer, true), atol=1e-14)
    np.testing.assert_allclose(rate, respond(imu.gyroscope, true), atol=1e-14)
    alone = Imu(imu.accelerometer, None)
    assert alone.respond(true)[1] is None
    counts = Imu.nominal((2000.0,) * 3, (10.0, 0, -10), "count", (50.0,) * 3, (0.0,) * 3, "count")
    force, rate = counts.respond(true)
    np.testing.assert_allclose(force, 2000 * np.asarray(true.specific_force) + [10, 0, -10], rtol=1e-14)
    np.testing.assert_allclose(rate, 50 * np.asarray(true.angular_rate), rtol=1e-14)
    assert counts.accelerometer.output_unit == counts.gyroscope.output_unit == "count"
