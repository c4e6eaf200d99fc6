"""The covariance of the conditions is what Monte Carlo finds, and a planted excess is found again."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import POSES, simulated

from jaximu.residuals import joint_conditions
from jaximu.whitening import (
    condition_covariance,
    inverse_cholesky,
    pose_weights,
    static_covariances,
    turn_weights,
    update_excess,
)

covariance_of = jax.jit(condition_covariance)
NONE = jnp.zeros(3)


@partial(jax.jit, static_argnums=1)
def draw(key, draws, imu, data, accelerometer, turns):
    factor = jnp.sqrt(accelerometer) * jnp.linalg.cholesky(data.poses.accelerometer_covariance)
    density = jnp.sqrt(turns) * jnp.linalg.cholesky(data.turns.noise)
    used = data.turns.interval > 0
    over = jnp.where(used, 1 / jnp.sqrt(jnp.where(used, data.turns.interval, 1.0)), 0.0)

    def one(key):
        first, second = jax.random.split(key)
        mean = jnp.einsum("pij,pj->pi", factor, jax.random.normal(first, (POSES, 3)))
        white = over[..., None] * (jax.random.normal(second, data.turns.output.shape) @ density.T)
        noisy = eqx.tree_at(
            lambda d: (d.poses.accelerometer_mean, d.turns.output),
            data,
            (data.poses.accelerometer_mean + mean, data.turns.output + white),
        )
        return joint_conditions(imu, noisy)

    return jax.lax.map(one, jax.random.split(key, draws), batch_size=100)


def drawn(case, draws, seed, accelerometer=1.0, turns=1.0):
    """The conditions at the truth under noise drawn from the stated covariances, times the given variances."""
    return np.asarray(draw(jax.random.key(seed), draws, case.imu, case.observations, accelerometer, turns))


@pytest.fixture(scope="module")
def case():
    return simulated(21, poses=10, noise=0.0)


def test_covariance_of_the_conditions(case):
    draws = 6000
    covariance = covariance_of(case.imu, case.observations)
    used = np.asarray(covariance.used) > 0
    assert used.sum() == 10 + 2 * 9
    values = drawn(case, draws, 0)
    np.testing.assert_array_equal(values[:, ~used], 0.0)
    claimed = np.asarray(covariance.total(NONE))[np.ix_(used, used)]
    empirical = np.cov(values[:, used].T)
    # whitened by the claimed covariance the empirical one is a Wishart matrix around the identity: its eigenvalues lie
    # within (1 ± sqrt(n / draws))², its relative Frobenius distance is sqrt((n + 1) / draws)
    weights = np.asarray(inverse_cholesky(jnp.asarray(claimed)))
    white = weights @ empirical @ weights.T
    edge = np.sqrt(len(white) / draws)
    eigenvalues = np.linalg.eigvalsh(white)
    assert eigenvalues[0] > (1 - edge) ** 2 - 0.02
    assert eigenvalues[-1] < (1 + edge) ** 2 + 0.02
    assert np.linalg.norm(white - np.eye(len(white))) / np.sqrt(len(white)) < 1.2 * np.sqrt((len(white) + 1) / draws)
    # neighbours that share a pose are truly correlated: leaving that out would not pass
    blind = np.diag(np.diag(claimed))
    weights = np.asarray(inverse_cholesky(jnp.asarray(blind)))
    assert np.linalg.eigvalsh(weights @ empirical @ weights.T)[-1] > 1.3
    # to first order the mean is zero: a mean of second order only
    assert np.abs(values[:, used].mean(axis=0) / np.sqrt(np.diag(claimed))).max() < 5 / np.sqrt(draws)


def test_parts_of_the_covariance(case):
    data = case.observations
    covariance = covariance_of(case.imu, data)
    total = covariance.total(jnp.array([0.5, 2.0, 0.0]))
    expected = (
        covariance.measured + 0.5 * covariance.accelerometer + 2 * covariance.turns + jnp.diag(1 - covariance.used)
    )
    np.testing.assert_array_equal(total, expected)
    for part in (covariance.measured, covariance.accelerometer, covariance.turns):
        np.testing.assert_allclose(part, part.T, atol=1e-20)
        np.testing.assert_array_equal(part * (1 - covariance.used), 0.0)
    np.testing.assert_array_equal(covariance.turns[:POSES], 0.0)  # turns do not enter norms
    # an excess is the mean measured covariance in every real pose
    measured, unit = static_covariances(data)
    np.testing.assert_array_equal(measured, data.poses.gyroscope_covariance)
    np.testing.assert_allclose(unit, np.broadcast_to(np.mean(measured[:10], axis=0), unit.shape), rtol=1e-12)


def test_two_step_weights_are_the_diagonal_blocks(case):
    covariance = covariance_of(case.imu, case.observations)
    excess = jnp.array([0.3, 0.7, 0.0])
    total = np.asarray(covariance.total(excess))
    np.testing.assert_allclose(pose_weights(covariance, POSES, excess) ** 2 * np.diag(total)[:POSES], 1.0, rtol=1e-12)
    weights = np.asarray(turn_weights(covariance, POSES, excess))
    for k, weight in enumerate(weights):
        rows = slice(POSES + 2 * k, POSES + 2 * k + 2)
        np.testing.assert_allclose(weight @ total[rows, rows] @ weight.T, np.eye(2), atol=1e-10)


def test_excess_is_found_again(case):
    """Noise of three times the stated variance in the poses and five times in the turns: excess 2 and 4."""
    covariance = covariance_of(case.imu, case.observations)
    # as if parameters had been fitted: any Jacobian will do, residuals are projected off it
    jacobian = jnp.asarray(np.random.default_rng(0).standard_normal((len(covariance.used), 10)))
    jacobian = jacobian * covariance.used[:, None]
    basis = jnp.linalg.qr(jacobian)[0]

    @jax.jit
    @jax.vmap
    def iterate(conditions, excess):
        weights = inverse_cholesky(covariance.total(jnp.append(excess, 0.0)))
        residual = weights @ conditions
        residual = residual - basis @ (basis.T @ residual)
        parts = tuple(weights @ part @ weights.T for part in (covariance.accelerometer, covariance.turns))
        return update_excess(residual, jacobian, parts, excess)

    def found(values, rounds=8):
        excess = jnp.ones((len(values), 2))
        for _ in range(rounds):
            excess = iterate(jnp.asarray(values), excess)
        return np.asarray(excess)

    noisy = found(drawn(case, 100, 1, accelerometer=3.0, turns=5.0))
    assert np.all(noisy >= 0)
    spread = noisy.std(axis=0) / np.sqrt(len(noisy))
    np.testing.assert_array_less(np.abs(noisy.mean(axis=0) - [2.0, 4.0]), 3.5 * spread + [0.1, 0.2])
    honest = found(drawn(case, 100, 2))
    assert np.median(honest, axis=0).max() < 0.3


def test_a_part_without_rows_stays_as_it_is():
    excess = update_excess(jnp.ones(6), jnp.eye(6)[:, :2], (jnp.eye(6), jnp.zeros((6, 6))), jnp.array([1.0, 7.0]))
    assert excess[1] == 7.0
    assert np.isfinite(excess[0])
