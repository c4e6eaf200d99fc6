"""Turns integrated once: against the integration of every sample, and its order of convergence."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import simulated

from jaximu.calibration.fit import fit_hand_held
from jaximu.fleet import Unit, fit_units
from jaximu.residuals.carried import carry, carry_blocks, compress
from jaximu.residuals.gravity_direction import turn_rotations
from jaximu.rotation import conjugate, logarithm, multiply
from jaximu.sensor import Imu
from jaximu.whitening import _turn_covariance

carry, exact = jax.jit(carry), jax.jit(turn_rotations)


@pytest.fixture(scope="module")
def case():
    return simulated(3)


def apart(first, second):
    """Largest angle (rad) between two rotations of the same turn."""
    return float(np.abs(np.asarray(logarithm(multiply(conjugate(first), second)))).max())


def moved(imu: Imu, size: float) -> Imu:
    random = np.random.default_rng(1)
    gain = imu.gyroscope.gain + size * random.standard_normal((3, 3))
    bias = imu.gyroscope.bias + size * random.standard_normal(3)
    return Imu(
        imu.accelerometer, type(imu.gyroscope)(jnp.asarray(gain), jnp.asarray(bias), (), "angular_rate", "rad/s")
    )


def test_rotation_and_noise_are_those_of_all_samples(case):
    turns = case.observations.turns
    found = carry(case.imu.gyroscope, turns)
    assert apart(found.rotation, exact(case.imu, turns)) < 1e-12
    _, covariance = jax.jit(_turn_covariance)(case.imu, case.observations)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-10, atol=1e-20)


def test_what_is_left_out_is_of_second_order(case):
    """A hundred times smaller a change leaves a ten-thousandth of the error."""
    turns = case.observations.turns
    found = carry(case.imu.gyroscope, turns)
    errors = []
    for size in (1e-2, 1e-4):
        other = moved(case.imu, size)
        errors.append(apart(found.rotations(other.gyroscope), exact(other, turns)))
    assert 0 < errors[1] < 1e-6
    assert errors[0] / errors[1] == pytest.approx(1e4, rel=0.2)
    # without the derivatives it would be of the first order
    assert apart(found.rotation, exact(moved(case.imu, 1e-4), turns)) > 100 * errors[1]


def test_blocks_are_of_third_order_in_their_rotation(case):
    """The same rates for half the time: blocks turn half as far, and leave an eighth."""
    errors = []
    for share in (1.0, 0.5):
        turns = replace(case.observations.turns, interval=case.observations.turns.interval * share)
        found = jax.jit(carry_blocks)(case.imu.gyroscope, turns, jax.jit(compress)(turns))
        errors.append(apart(found.rotation, exact(case.imu, turns)))
    assert errors[0] < 1e-4
    assert 6 < errors[0] / errors[1] < 10


@pytest.mark.parametrize("gyroscope", [True, False])
def test_units_alone_and_together_are_as_the_exact_path_has_them(gyroscope):
    """Where the excess is the same (none), what differs is that the exact path's weights are of the pass before.

    That pre-integration itself changes nothing is shown by Newton's step, in test_fleet.
    """
    cases = [simulated(seed) for seed in range(5)]
    method = "joint" if gyroscope else "accelerometer"
    nominal = jax.tree.map(np.asarray, Imu.nominal())
    units = [Unit(jax.tree.map(np.asarray, case.observations), nominal, gyroscope) for case in cases]
    together = fit_units(units)
    exactly = fit_hand_held(
        jax.tree.map(lambda leaf: np.stack([leaf] * 5), nominal),
        jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *[c.observations for c in cases]),
        method,
    )
    alike = 0
    for place, fitted in enumerate(together):
        assert fitted.converged
        (alone,) = fit_units([units[place]])
        np.testing.assert_allclose(alone.numbers, fitted.numbers, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(alone.covariance, fitted.covariance, rtol=1e-9, atol=1e-18)
        sigma = np.sqrt(np.diagonal(fitted.covariance))
        index = list(exactly.parameters.index)
        model = np.concatenate([np.ravel(np.asarray(leaf)[place]) for leaf in jax.tree.leaves(exactly.model)])[index]
        close = np.abs(fitted.excess - exactly.excess[place]).max() < 1e-4
        alike += close
        off = np.abs(fitted.numbers[index] - model) / sigma
        assert off.max() < (0.01 if close else 0.1)
    assert alike
