"""Turns integrated once and passes side by side: against the integration of every sample and the dense covariance."""

import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import simulated

from jaximu.calibration.hand_held import fit_hand_held
from jaximu.data import joint_conditions
from jaximu.data.carried import SampleBlocks, carry, compress, matmul, moved, rotate_samples, rotate_through, transpose
from jaximu.data.gravity_direction import turn_rotations
from jaximu.data.poses_covariance import condition_covariance, integrate_turns
from jaximu.estimation.problem import names_of
from jaximu.fleets import FleetUnit, fit_units
from jaximu.fleets.fit import parameter_set
from jaximu.fleets.lanes import _linearise, _seen, _triads, _whiten
from jaximu.ground.rotation import conjugate, logarithm, multiply
from jaximu.model.sensor import Imu

exact = jax.jit(turn_rotations)


@pytest.fixture(scope="module")
def case():
    return simulated(3)


def linear(imu: Imu):
    """A and c of the rate A y + c, by component."""
    inverse = np.linalg.inv(np.asarray(imu.gyroscope.gain))
    return [list(row) for row in inverse], list(-inverse @ np.asarray(imu.gyroscope.bias))


def by_sample(turns, share: float = 1.0) -> SampleBlocks:
    interval = np.asarray(turns.interval).T * share
    return compress([*(interval * np.asarray(turns.output)[..., i].T for i in range(3)), interval], 1)


@partial(jax.jit, static_argnums=1)
def blocks_of(single: SampleBlocks, size: int):
    return compress(single.moments, size)


@jax.jit
def rotated(inverse, offset, blocks):
    return jnp.stack(rotate_through(inverse, offset, blocks), axis=-1)


@partial(jax.jit, static_argnums=4)
def carried(inverse, offset, blocks, noise, size=1):
    return carry(inverse, offset, blocks, matmul(matmul(inverse, noise), transpose(inverse)), size)


first_order = jax.jit(moved)


def apart(first, second):
    """Largest angle (rad) between two rotations of the same turn."""
    return float(np.abs(np.asarray(logarithm(multiply(conjugate(first), second)))).max())


def changed(imu: Imu, size: float) -> Imu:
    random = np.random.default_rng(1)
    gain = imu.gyroscope.gain + size * random.standard_normal((3, 3))
    bias = imu.gyroscope.bias + size * random.standard_normal(3)
    return Imu(
        imu.accelerometer, type(imu.gyroscope)(jnp.asarray(gain), jnp.asarray(bias), (), "angular_rate", "rad/s")
    )


def test_rotation_and_noise_are_those_of_all_samples(case):
    turns = case.observations.turns
    noise = [list(row) for row in np.asarray(turns.noise)]
    found = carried(*linear(case.imu), by_sample(turns), noise)
    assert apart(np.stack(found.rotation, axis=-1), exact(case.imu, turns)) < 1e-12
    by_samples = jax.jit(rotate_samples)(*linear(case.imu), by_sample(turns).moments)
    assert apart(np.stack(by_samples, axis=-1), exact(case.imu, turns)) < 1e-12
    covariance = jax.jit(integrate_turns)(case.imu, case.observations.turns).noise
    np.testing.assert_allclose(np.moveaxis(np.array(found.covariance), -1, 0), covariance, rtol=1e-10, atol=1e-20)


def test_what_is_left_out_is_of_second_order(case):
    """A hundred times smaller a change leaves a ten-thousandth of the error."""
    turns = case.observations.turns
    inverse, offset = linear(case.imu)
    found = carried(inverse, offset, by_sample(turns), [list(row) for row in np.eye(3)])
    start = np.stack(found.rotation, axis=-1)
    errors = []
    for size in (1e-2, 1e-4):
        other = changed(case.imu, size)
        rotation, squared = (np.array(each) for each in first_order(found, *linear(other)))
        truth = exact(other, turns)
        errors.append(apart(rotation.T, truth))
        angle = np.linalg.norm(logarithm(multiply(conjugate(start), truth)), axis=-1)
        np.testing.assert_allclose(np.sqrt(squared), angle, rtol=0.1)
    assert 0 < errors[1] < 1e-6
    assert errors[0] / errors[1] == pytest.approx(1e4, rel=0.2)
    # without the derivatives it would be of the first order
    assert apart(start, exact(changed(case.imu, 1e-4), turns)) > 100 * errors[1]


@pytest.mark.parametrize(("size", "longest"), [(4, 0.4), (16, 0.1)])
def test_blocks_are_of_third_order_in_their_rotation(case, size, longest):
    """The same rates for half the time: blocks turn half as far, and leave an eighth."""
    errors = []
    for share in (longest, longest / 2):
        single = by_sample(case.observations.turns, share)
        found, every = (rotated(*linear(case.imu), each) for each in (blocks_of(single, size), single))
        errors.append(apart(found, every))
    assert errors[0] < 1e-5
    assert 6 < errors[0] / errors[1] < 10


def test_slopes_by_blocks_are_those_by_samples(case):
    """Of a gain, of a bias, and the noise; of second order in the blocks, which turn by up to half a radian and one."""
    turns = case.observations.turns
    noise = [list(row) for row in np.diag([1.0, 2.0, 4.0])]
    single = by_sample(turns)

    def parts(found):
        reach = np.array(found.reach)
        return reach[:, :, :3], reach[:, :, 3], np.array(found.covariance)

    truth = parts(carried(*linear(case.imu), single, noise))
    for size, bound in ((2, 1e-4), (4, 4e-4)):
        found = parts(carried(*linear(case.imu), blocks_of(single, size), noise, size))
        for ours, exactly in zip(found, truth, strict=True):
            assert np.abs(ours - exactly).max() < bound * np.abs(exactly).max()


def test_blocks_are_sums_over_pairs_of_their_samples(case):
    """By the sums' own definition, pair by pair."""
    single = by_sample(case.observations.turns)
    blocks = blocks_of(single, 8)
    u, t = np.stack(single.moments[:3], axis=-1)[8:16, 2], np.asarray(single.moments[3])[8:16, 2]
    pairs = [(i, j) for j in range(8) for i in range(j)]
    coning = sum(np.cross(u[i], u[j]) for i, j in pairs)
    first = sum(u[i] * t[j] - t[i] * u[j] for i, j in pairs)
    v, s = np.stack(single.moments[:3], axis=-1)[7:17, 2], np.asarray(single.moments[3])[7:17, 2]
    for k in range(1, 9):
        (m, n), (d, e) = ((7 * w[k] - w[k - 1] - w[k + 1] for w in (v, s)), (w[k + 1] - w[k - 1] for w in (v, s)))
        coning, first = coning + np.cross(m, d) / 60, first + (m * e - n * d) / 60
    np.testing.assert_allclose([each[1, 2] for each in blocks.coning], coning, rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose([each[1, 2] for each in blocks.first], first, rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose([each[1, 2] for each in blocks.moments], [*u.sum(axis=0), t.sum()], rtol=1e-12)


def test_linear_problem_is_that_of_the_dense_path(case):
    """Conditions, their Jacobian by automatic differentiation, and C⁻¹ of the dense covariance; with two turns out."""
    out = np.array([4, 9])
    turns = case.observations.turns
    mask = np.asarray(turns.mask).copy()
    mask[out] = False
    observations = case.observations.__class__(
        case.observations.poses, turns.__class__(turns.output, turns.interval, turns.noise, turns.basis, mask),
        case.observations.gravity,
    )  # fmt: skip
    like, parameters = parameter_set(True)
    z = parameters.vector(jax.tree.map(jnp.asarray, changed(case.imu, 1e-3)))
    excess = np.array([0.7, 0.4])

    @jax.jit
    def dense(z):
        conditions = joint_conditions(parameters.model(like, z), observations)
        jacobian = jax.jacfwd(lambda z: joint_conditions(parameters.model(like, z), observations))(z)
        covariance = condition_covariance(parameters.model(like, z), observations).dense()
        joint = len(conditions)
        return conditions, jacobian, covariance.total(jnp.array([*excess, 0.0]))[:joint, :joint]

    @jax.jit
    def by_lanes(z):
        batch = jax.tree.map(lambda leaf: jnp.stack([jnp.asarray(leaf)] * 2), observations)
        seen, at = _seen(batch), _triads(parameters, jnp.stack([z] * 2, axis=1))
        single = by_sample(turns)
        single = jax.tree.map(lambda each: jnp.stack([each] * 2, axis=-1), single)
        found = carry(at.inverse_g, at.offset_g, single, matmul(matmul(at.inverse_g, seen.noise),
                                                                transpose(at.inverse_g)))  # fmt: skip
        linear = _linearise(parameters, seen, at, found)

        def added(matrix, mask, factor):
            weight = mask / jnp.sum(mask, axis=0)
            return [[each + factor * jnp.sum(weight * each, axis=0) for each in row] for row in matrix]

        white = _whiten(linear, added(seen.covariance_a, seen.pose, excess[0]),
                        added(found.covariance, seen.turn, excess[1]), (seen.pose, seen.turn))  # fmt: skip
        return linear.rows, white

    conditions, jacobian, covariance = (np.asarray(each) for each in dense(z))
    rows, white = jax.tree.map(np.asarray, by_lanes(z))
    poses = len(rows)
    order = np.concatenate([[k, poses + 2 * k, poses + 2 * k + 1] for k in range(poses)])[:-2]
    ours = rows[..., 1].reshape(3 * poses, -1)[: len(order)]
    np.testing.assert_allclose(ours[:, -1], conditions[order], rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(ours[:, :-1], jacobian[order], rtol=1e-8, atol=3e-6)  # slopes leave coning out
    inverse = np.linalg.inv(covariance)[np.ix_(order, order)]
    solved = white.solved[..., 1].reshape(3 * poses, -1)[: len(order)]
    expected = inverse @ np.column_stack([jacobian[order], conditions[order]])
    np.testing.assert_allclose(solved, expected, rtol=1e-6, atol=1e-5 * np.abs(expected).max())
    for k in range(1, poses - 1):
        block = slice(3 * k, 3 * k + 3)
        size = np.abs(inverse[block, block]).max()
        own, last = (np.array([[each[k, 1] for each in row] for row in part]) for part in (white.own, white.last))
        np.testing.assert_allclose(own, inverse[block, block], atol=1e-9 * size)
        np.testing.assert_allclose(last, inverse[block, 3 * k - 3 : 3 * k], atol=1e-9 * size)


@pytest.mark.parametrize("gyroscope", [True, False])
def test_units_alone_and_together_are_as_the_exact_path_has_them(gyroscope):
    """Where the excess is the same (none), what differs is that the exact path's weights are of the pass before.

    What derivatives by blocks change is shown by Newton's step, in test_fleet.
    """
    cases = [simulated(seed) for seed in range(5)]
    method = "joint" if gyroscope else "accelerometer"
    nominal = jax.tree.map(np.asarray, Imu.nominal())
    units = [FleetUnit(jax.tree.map(np.asarray, case.observations), nominal, gyroscope) for case in cases]
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
        index = [names_of(nominal).index(name) for name in exactly.names]
        model = np.concatenate([np.ravel(np.asarray(leaf)[place]) for leaf in jax.tree.leaves(exactly.imu)])[index]
        close = np.abs(fitted.excess - exactly.excess[place]).max() < 1e-4
        alike += close
        off = np.abs(fitted.numbers[index] - model) / sigma
        assert off.max() < (0.01 if close else 0.1)
    assert alike


_ON_TWO_DEVICES = """
import sys, jax, numpy as np
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, sys.argv[1])
from synthetic import simulated
from jaximu.fleets import FleetUnit, fit_units
from jaximu.fleets.fit import _devices
from jaximu.model.sensor import Imu
nominal = jax.tree.map(np.asarray, Imu.nominal())
units = [FleetUnit(jax.tree.map(np.asarray, simulated(seed).observations), nominal, False) for seed in range(11)]
assert jax.local_device_count() == 2
assert len(_devices()) == int(sys.argv[3])
np.save(sys.argv[2], [fitted.numbers for fitted in fit_units(units)])
"""


@pytest.mark.parametrize(("threads", "used"), [(8, 2), (2, 1)])
def test_two_devices_give_the_same_units(tmp_path, threads, used):
    """With threads enough in XLA's pool; with few, where two would wait for ever, one does it all."""
    path = tmp_path / "numbers.npy"
    flags = os.environ["XLA_FLAGS"] + " --xla_force_host_platform_device_count=2"
    environment = {**os.environ, "XLA_FLAGS": flags, "NPROC": str(threads)}
    done = subprocess.run(
        [sys.executable, "-c", _ON_TWO_DEVICES, str(Path(__file__).parent), str(path), str(used)],
        env=environment, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    nominal = jax.tree.map(np.asarray, Imu.nominal())
    units = [FleetUnit(jax.tree.map(np.asarray, simulated(seed).observations), nominal, False) for seed in range(11)]
    here = [fitted.numbers for fitted in fit_units(units)]
    np.testing.assert_allclose(np.load(path), here, rtol=1e-9, atol=1e-12)
