"""Hand derivations agree with automatic differentiation, and a wrong one is caught by name."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaximu.estimation.jacobian_check import (
    GRAVITY_DIRECTION_NAMES,
    GRAVITY_NORM_NAMES,
    check_jacobian,
    first_order_inverse_error,
    gravity_direction_hand,
    gravity_norm_hand,
    hand_jacobian_gravity_direction,
    hand_jacobian_gravity_norm,
)

GRAVITY = 9.81
hand_norm, hand_direction = jax.jit(hand_jacobian_gravity_norm), jax.jit(hand_jacobian_gravity_direction)


def norm_case(seed):
    random = np.random.default_rng(seed)
    theta = np.concatenate([random.uniform(-0.05, 0.05, 3), random.uniform(0.8, 1.2, 3), random.uniform(-1, 1, 3)])
    outputs = random.standard_normal((12, 3))
    outputs *= GRAVITY / np.linalg.norm(outputs, axis=1, keepdims=True)
    return jnp.asarray(theta), jnp.asarray(outputs), GRAVITY


def direction_case(seed, turns=4, samples=40):
    random = np.random.default_rng(seed)
    gain = np.eye(3) * random.uniform(0.9, 1.1, 3) + random.uniform(-0.05, 0.05, (3, 3))
    theta = np.concatenate([gain.ravel(), random.uniform(-0.1, 0.1, 3)])
    outputs = random.uniform(-3, 3, (turns, 1, 3)) + random.standard_normal((turns, samples, 3))
    intervals = random.uniform(0.008, 0.012, (turns, samples))
    intervals[1, 25:] = 0.0  # padding
    intervals[2] *= 12  # half a radian a sample: far from any small-angle form
    ends = random.standard_normal((2, turns, 3))
    ends /= np.linalg.norm(ends, axis=-1, keepdims=True)
    return tuple(jnp.asarray(part) for part in (theta, outputs, intervals, *ends))


def check_norm(seed, jacobian=hand_norm):
    theta, *data = norm_case(seed)
    return check_jacobian(
        lambda x: gravity_norm_hand(x, *data), lambda x: jacobian(x, *data), theta, GRAVITY_NORM_NAMES
    )


@pytest.mark.parametrize("seed", range(3))
def test_gravity_norm_agrees(seed):
    result = check_norm(seed)
    assert result.ok, str(result)
    assert result.worst_relative < 1e-13


@pytest.mark.parametrize("seed", range(3))
def test_gravity_direction_agrees(seed):
    theta, *data = direction_case(seed)
    result = check_jacobian(
        lambda x: gravity_direction_hand(x, *data),
        lambda x: hand_direction(x, *data),
        theta,
        GRAVITY_DIRECTION_NAMES,
    )
    assert result.ok, str(result)
    assert result.worst_relative < 1e-12


def test_gravity_direction_of_a_sensor_that_reads_its_bias():
    theta, outputs, *rest = direction_case(0)
    outputs = jnp.broadcast_to(theta[9:], outputs.shape)
    data = (outputs, *rest)
    result = check_jacobian(lambda x: gravity_direction_hand(x, *data), lambda x: hand_direction(x, *data), theta)
    assert result.ok, str(result)


def test_the_forms_that_circulate_are_caught_by_name():
    def slip(theta, outputs, gravity):
        # S_z in the last block where S'_z is meant
        right = hand_norm(theta, outputs, gravity)
        return right.at[:, 8].multiply(theta[5] ** -2)

    result = check_norm(0, slip)
    assert not result.ok
    assert result.name == "b_z"
    assert [name for name, _, relative in result.table if relative > result.rtol] == ["b_z"]
    text = str(result)
    assert "DISAGREE" in text
    assert "b_z" in text
    assert text.count("<") == 1


def test_the_worst_row_is_named():
    theta, *data = norm_case(1)

    def wrong(x):
        return hand_norm(x, *data).at[7, 2].add(1e-3)

    result = check_jacobian(lambda x: gravity_norm_hand(x, *data), wrong, theta, GRAVITY_NORM_NAMES)
    assert (result.row, result.name) == (7, "M_zy")
    assert result.worst_absolute == pytest.approx(1e-3)


def test_a_jacobian_that_is_not_finite_never_passes():
    theta, *data = norm_case(1)

    def broken(x):
        return hand_norm(x, *data).at[3, 4].set(jnp.nan)

    result = check_jacobian(lambda x: gravity_norm_hand(x, *data), broken, theta)
    assert not result.ok
    assert (result.row, result.name) == (3, "x[4]")


def test_shapes_and_names_are_checked():
    x = jnp.ones(2)
    with pytest.raises(ValueError, match=r"shape \(2, 3\)"):
        check_jacobian(lambda x: x**2, lambda _: jnp.zeros((2, 3)), x)
    with pytest.raises(ValueError, match="names"):
        check_jacobian(lambda x: x**2, lambda x: jnp.diag(2 * x), x, names=("a",))
    with pytest.raises(ValueError, match="vector"):
        check_jacobian(lambda x: x @ x, lambda x: 2 * x, x)
    zero_column = check_jacobian(lambda x: jnp.stack([x[0], x[0]]), lambda _: jnp.array([[1.0, 0], [1.0, 0]]), x)
    assert zero_column.ok
    assert zero_column.worst_relative == 0.0


def test_size_of_the_first_order_inverse():
    """89 µg, and 0.018 °/s at 200 °/s, for misalignments within 0.01; 25 times that for 0.05."""
    random = np.random.default_rng(0)
    scale = np.array([0.9, 1.1, 250.0])

    def mean(size, magnitude):
        draws = size * random.uniform(-1, 1, (300, 3, 3)) * (1 - np.eye(3))
        return np.mean([first_order_inverse_error(np.diag(scale) @ (np.eye(3) + m), magnitude) for m in draws])

    assert mean(1e-2, 1e6) == pytest.approx(89, rel=0.05)  # µg at 1 g
    assert mean(1e-2, 200.0) == pytest.approx(0.018, rel=0.06)
    assert mean(5e-2, 1e6) == pytest.approx(25 * 89, rel=0.05)
    assert first_order_inverse_error(np.diag(scale), 9.8) < 1e-12
