"""Residuals vanish at the truth, and the joint one is maximum likelihood: proven against all attitudes kept free."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from synthetic import GRAVITY, POSES, recording, simulated
from whitened_by_hand import gravity_direction, static_gyroscope, turn_rotations

from jaximu.data import forces_and_angles
from jaximu.data.gravity_norm import gravity_norm
from jaximu.data.poses import condense
from jaximu.data.poses_covariance import condition_covariance
from jaximu.estimation.covariance import inverse_cholesky
from jaximu.estimation.problem import Parameters, Problem, without_equipment
from jaximu.estimation.solver import solve
from jaximu.ground.rotation import logarithm, multiply
from jaximu.recordings.segmentation import observed_poses, segment

conditions_of = jax.jit(lambda imu, data: condense(imu, data)[0](imu)[: 3 * len(data.poses.mask) - 2])
direction_of, norm_of, rest_of = jax.jit(gravity_direction), jax.jit(gravity_norm), jax.jit(static_gyroscope)
rotations_of = jax.jit(turn_rotations, static_argnums=2)


def angle_errors(imu, data, method="exponential"):
    return forces_and_angles(imu, data, method)[1]


@pytest.fixture(scope="module", params=[12, 9])
def exact(request):
    return simulated(1, poses=request.param, noise=0.0)


def test_all_conditions_hold_at_the_truth(exact):
    data, imu = exact.observations, exact.imu
    ones = jnp.ones(POSES)
    np.testing.assert_allclose(norm_of(imu, data, ones), 0.0, atol=1e-12)
    identity = jnp.broadcast_to(jnp.eye(2), (POSES - 1, 2, 2))
    np.testing.assert_allclose(direction_of(imu, data, None, identity), 0.0, atol=1e-12)
    up = jnp.asarray(np.vstack([exact.up, np.tile([0, 0, 1.0], (POSES - len(exact.up), 1))]))
    np.testing.assert_allclose(direction_of(imu, data, up, identity), 0.0, atol=1e-12)
    rest = jnp.broadcast_to(jnp.eye(3), (POSES, 3, 3))
    np.testing.assert_allclose(rest_of(imu, data, rest), 0.0, atol=1e-12)
    conditions = conditions_of(imu, data)
    np.testing.assert_allclose(conditions, 0.0, atol=1e-12)
    np.testing.assert_allclose(angle_errors(imu, data), 0.0, atol=1e-7)  # arcsin of a chord near zero
    relative = exact.attitudes[:-1].inv() * exact.attitudes[1:]
    rotations = np.asarray(rotations_of(imu, data.turns))[: len(exact.up) - 1]
    assert (Rotation.from_quat(np.roll(rotations, -1, axis=-1)).inv() * relative).magnitude().max() < 1e-12


def test_residuals_have_the_stated_units_and_ignore_padding():
    """A gain one part in a thousand too small: the norm is 1e-3 g off, in m/s²; padding stays exactly zero."""
    case = simulated(2, poses=9, noise=0.0)
    data = case.observations
    gain = case.imu.accelerometer.gain
    wrong = jax.tree.map(lambda leaf: leaf * (1 - 1e-3) if leaf is gain else leaf, case.imu)
    norm = np.asarray(norm_of(wrong, data, jnp.ones(POSES)))
    np.testing.assert_allclose(norm[:9], -1e-3 * GRAVITY, rtol=2e-3)
    np.testing.assert_array_equal(norm[9:], 0.0)
    conditions = np.asarray(conditions_of(wrong, data))
    np.testing.assert_array_equal(conditions[9:POSES], 0.0)
    np.testing.assert_array_equal(conditions[POSES + 16 :], 0.0)
    # a gyroscope whose bias is 0.01 rad/s off turns 0.0144 rad astray in 1.44 s, less along gravity
    bias = case.imu.gyroscope.bias
    drifting = jax.tree.map(lambda leaf: leaf + 0.01 if leaf is bias else leaf, case.imu)
    angles = np.asarray(angle_errors(drifting, data))
    assert np.all(angles[:8] < 0.0144 * np.sqrt(3) * 1.05)
    assert np.median(angles[:8]) > 0.005
    np.testing.assert_array_equal(angles[8:], 0.0)


def test_runge_kutta_and_exponential_agree_for_fine_sampling():
    def apart(imu, turns):
        exponential, rk4 = (rotations_of(imu, turns, method) for method in ("exponential", "rk4"))
        return np.linalg.norm(logarithm(multiply(exponential * jnp.array([1.0, -1, -1, -1]), rk4)), axis=-1)

    case = simulated(3, noise=0.0)
    coarse = apart(case.imu, case.observations.turns)  # 33 samples a second
    log, rests = recording(3, rates=(100.0, 500.0), density=(0.0, 0.0), poses=6)
    data = observed_poses(segment(log), GRAVITY)
    fine = apart(case.imu, data.turns)
    assert int(data.turns.mask.sum()) == len(rests) - 1
    assert 1e-7 < coarse.max() < 1e-4
    assert fine.max() < 1e-9
    np.testing.assert_allclose(angle_errors(case.imu, data, "rk4"), 0.0, atol=1e-6)


# --- the joint problem against all attitudes free -------------------------------------------------------------------


def joint_residual(imu, data):
    observations, weights, rest = data
    return jnp.concatenate([weights @ conditions_of(imu, observations), static_gyroscope(imu, observations, rest)])


@jax.jit
def eliminated(imu, parameters, observations):
    """The library's problem: attitudes eliminated, weights at the truth."""
    whole = condition_covariance(imu, observations).dense().total(jnp.zeros(3))
    joint = len(whole) - 3 * len(observations.poses.mask)  # norms and turns
    weights = inverse_cholesky(whole[:joint, :joint])
    rest = inverse_cholesky(observations.poses.gyroscope_covariance)
    problem = Problem(imu, parameters, (observations, weights, rest), joint_residual, tolerance=1e6)
    return solve(problem, jnp.zeros(len(parameters.names)))


LOWER = np.tril_indices(3)


def unpack(x):
    gain = np.zeros((3, 3))
    gain[LOWER] = x[:6]
    return gain, x[6:9], x[9:18].reshape(3, 3), x[18:21]


def integrate(gain, bias, output, intervals):
    """Rotation of one turn, and how the rate of each sample turns the last frame over its time, by SciPy.

    A rate that is off while a frame turns by θ turns it by the mean of exp(−sθ) over s from 0 to 1.
    """
    angles = (output - bias) @ np.linalg.inv(gain).T * intervals[:, None]
    beside = np.vstack([np.zeros(3), angles, np.zeros(3)])
    total, running = Rotation.identity(), []
    for vector in angles + np.cross(7 * angles - beside[:-2] - beside[2:], beside[2:] - beside[:-2]) / 120:
        total = total * Rotation.from_rotvec(vector)
        shares = -(np.arange(50) + 0.5)[:, None] / 50
        running.append((total, Rotation.from_rotvec(shares * vector).as_matrix().mean(axis=0)))
    return total, [(total.inv() * after).as_matrix() @ within for after, within in running]


def all_attitudes_free(case):
    """Minimise the likelihood over the parameters and every attitude (the first one's heading fixed).

    Residuals: accelerometer means, gyroscope means, and the logarithm of each turn's rotation against the attitudes.
    """
    data = jax.tree.map(np.asarray, case.observations)
    count = len(case.up)
    truth = case.imu
    x0 = np.concatenate([
        np.asarray(truth.accelerometer.gain)[LOWER], truth.accelerometer.bias,
        np.asarray(truth.gyroscope.gain).ravel(), truth.gyroscope.bias,
    ])  # fmt: skip
    across = np.linalg.svd(case.up[:1])[2][1:]  # two body rotations of the first pose that tilt it
    poses, turns = data.poses, data.turns
    white_a = np.linalg.inv(np.linalg.cholesky(poses.accelerometer_covariance))
    white_g = np.linalg.inv(np.linalg.cholesky(poses.gyroscope_covariance))
    used = turns.interval[0] > 0
    gain_g, bias_g = unpack(x0)[2:]
    inverse = np.linalg.inv(gain_g)
    white_t = []
    for k in range(count - 1):
        spread = np.zeros((3, 3))
        _, turning = integrate(gain_g, bias_g, turns.output[k, used], turns.interval[k, used])
        for lever, interval in zip(turning, turns.interval[k, used], strict=True):
            spread += lever @ inverse @ turns.noise @ inverse.T @ lever.T * interval
        white_t.append(np.linalg.inv(np.linalg.cholesky(spread)))

    def residual(x):
        gain_a, bias_a, gain_g, bias_g = unpack(x)
        tilt = np.vstack([x[21:23] @ across, x[23:].reshape(-1, 3)])
        attitudes = case.attitudes * Rotation.from_rotvec(tilt)
        force = attitudes.inv().apply([0, 0, GRAVITY])
        parts = []
        for k in range(count):
            parts.append(white_a[k] @ (poses.accelerometer_mean[k] - gain_a @ force[k] - bias_a))
            parts.append(white_g[k] @ (poses.gyroscope_mean[k] - bias_g))
        for k in range(count - 1):
            total, _ = integrate(gain_g, bias_g, turns.output[k, used], turns.interval[k, used])
            between = attitudes[k].inv() * attitudes[k + 1]
            parts.append(white_t[k] @ (between.inv() * total).as_rotvec())
        return np.concatenate(parts)

    start = np.concatenate([x0, np.zeros(3 * count - 1)])
    scale = np.concatenate([np.full(21, 1e-3), np.full(3 * count - 1, 1e-3)])
    found = least_squares(
        residual, start, method="trf", x_scale=scale, xtol=1e-14, ftol=1e-14, gtol=1e-10, jac="3-point"
    )
    return found


@pytest.mark.parametrize(("seed", "poses"), [(11, 10), (12, 9)])
def test_eliminating_the_attitudes_keeps_the_maximum_of_the_likelihood(seed, poses):
    """The second order in the noise apart, which for usual noise is below a thousandth of a sigma."""
    case = simulated(
        seed, poses=poses, used_samples=12, interval=0.12,
        accelerometer_sigma=1e-3, gyroscope_sigma=1e-4, gyroscope_density=1e-7,
    )  # fmt: skip
    parameters = Parameters.select(case.imu, without_equipment)
    ours = eliminated(case.imu, parameters, case.observations)
    assert bool(ours.converged)
    model = jax.tree.map(np.asarray, parameters.model(case.imu, ours.z))
    mine = np.concatenate([
        model.accelerometer.gain[LOWER], model.accelerometer.bias, model.gyroscope.gain.ravel(), model.gyroscope.bias
    ])  # fmt: skip
    theirs = all_attitudes_free(case)
    covariance = np.linalg.inv(theirs.jac.T @ theirs.jac)[:21, :21]
    sigma = np.sqrt(np.diag(covariance))
    assert np.abs((mine - theirs.x[:21]) / sigma).max() < 1e-3
    assert float(ours.cost) == pytest.approx(theirs.cost, rel=1e-4)
    # and the covariance claimed for the parameters is that of the large problem
    claimed = np.linalg.inv(np.asarray(ours.jacobian).T @ np.asarray(ours.jacobian))
    claimed = claimed * np.outer(parameters.size, parameters.size)
    values = np.linalg.eigvals(np.linalg.solve(covariance, claimed)).real
    np.testing.assert_allclose(values, 1.0, atol=5e-3)
