"""The solver: where it stops, what one bad lane does to the others, and how its solution moves with the data."""

import json
import pickle

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import pytest
from synthetic import simulated

from jaximu.data.gravity_norm import gravity_norm
from jaximu.estimation.levenberg_marquardt import LevenbergMarquardt
from jaximu.estimation.problem import LOSSES, Parameters, Problem, flatten, names_of, without_equipment
from jaximu.estimation.solver import Failure, solve
from jaximu.model.effects import CATALOGUE
from jaximu.model.sensor import Imu

NOMINAL = Imu.nominal()


PARAMETERS = Parameters.select(NOMINAL, lambda name: without_equipment(name) and name.owner == "accelerometer")
ZERO = jnp.zeros(9)


def norm_residual(imu, data):
    observations, weights = data
    return gravity_norm(imu, observations, weights)


def problem_of(observations, loss="linear") -> Problem:
    weights = jnp.where(observations.poses.mask, 1e3, 0.0)
    return Problem(NOMINAL, PARAMETERS, (observations, weights), norm_residual, loss)


@jax.jit
def run_from(start, observations, limit):
    return jax.vmap(lambda z, one: solve(problem_of(one), z, limit))(start, observations)


def run(observations, limit):
    """Solve eight units from the data sheet's values: one compiled function for all tests."""
    return run_from(jnp.zeros((8, 9)), observations, jnp.asarray(limit))


def stack(cases):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *cases)


@pytest.fixture(scope="module")
def fleet():
    return stack([simulated(seed).observations for seed in range(8)])


@pytest.fixture(scope="module")
def solved(fleet):
    return run(fleet, 256)


def test_solution_is_a_minimum(fleet, solved):
    assert np.all(solved.converged)
    assert np.all(solved.finite)
    assert np.max(solved.steps) <= 12
    gradient = np.einsum("nij,ni->nj", solved.jacobian, solved.residual) + np.asarray(solved.z) / 25.0
    curvature = np.sqrt(np.einsum("nij,nij->nj", solved.jacobian, solved.jacobian))
    assert np.abs(gradient / curvature).max() < 1e-4  # of a standard deviation
    cost = 0.5 * np.sum(solved.residual**2, axis=1) + 0.5 * np.sum(solved.z**2, axis=1) / 25.0
    np.testing.assert_allclose(solved.cost, cost, rtol=1e-12)
    assert jax.tree.map(lambda leaf: leaf[0], solved).failure() is Failure.NONE


def test_agrees_with_the_original_solver(fleet, solved):
    """optimistix's own Levenberg–Marquardt with QR: the stop rule changes when, not where."""
    problem = problem_of(jax.tree.map(lambda leaf: leaf[2], fleet))
    solver = optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9)
    stock = eqx.filter_jit(optx.least_squares)(
        lambda z, _: problem.objective(z), solver, ZERO, max_steps=256, throw=False
    )
    np.testing.assert_allclose(stock.value, solved.z[2], atol=1e-8)


def test_few_steps_at_the_optimum(fleet, solved):
    """Where rounding decides whether a step is progress, the original rejects for some twenty steps."""
    again = run_from(solved.z, fleet, jnp.asarray(256))
    assert np.max(again.steps) <= 4
    assert np.all(again.converged)
    np.testing.assert_allclose(again.z, solved.z, atol=1e-8)


@jax.custom_jvp
def misled(x):
    return x


@misled.defjvp
def _misled_jvp(primals, tangents):
    """The derivative has the wrong sign within ±1: there every step is uphill and is rejected."""
    (x,), (dot,) = primals, tangents
    return x, jnp.where(jnp.abs(x) < 1, -dot, dot)


def test_heavy_damping_is_no_convergence():
    """Rejected again and again, steps shrink below any tolerance: that must not pass as an optimum."""
    solver = LevenbergMarquardt(rtol=1e-9, atol=1e-9, linear_solver=lx.Normal(lx.Cholesky()))
    found = optx.least_squares(
        lambda x, _: misled(x), solver, jnp.array([3.0]), options={"limit": jnp.asarray(60)}, max_steps=256, throw=False
    )
    assert int(found.stats["num_steps"]) == 60  # the limit, not the stop rule
    assert abs(float(found.value[0])) < 1.0


def test_limit_is_no_convergence(fleet):
    early = run(fleet, 2)
    assert not np.any(early.converged)
    assert np.all(early.finite)
    assert np.all(early.steps == 2)
    assert jax.tree.map(lambda leaf: leaf[0], early).failure() is Failure.MAX_STEPS


def test_a_bad_lane_leaves_the_others_alone(fleet, solved):
    """One lane NaN, one with an outlier of a thousand g: both are seen, six are as before."""
    mean = np.array(fleet.poses.accelerometer_mean)
    mean[3, 5] = np.nan
    mean[6, 2] *= 1e3
    spoilt = run(eqx.tree_at(lambda f: f.poses.accelerometer_mean, fleet, mean), 256)
    assert not spoilt.finite[3]
    assert not spoilt.converged[3]
    assert jax.tree.map(lambda leaf: leaf[3], spoilt).failure() is Failure.NONFINITE
    assert spoilt.cost[6] > 1e3 * solved.cost[6]
    for lane in (0, 1, 2, 4, 5, 7):
        assert spoilt.converged[lane]
        np.testing.assert_allclose(spoilt.z[lane], solved.z[lane], atol=1e-10)


def test_solution_moves_with_the_data_as_finite_differences_say(fleet):
    """Implicit differentiation, forward and reverse: by gravity, and by a measured mean."""
    data = jax.tree.map(lambda leaf: leaf[1], fleet)

    def solution(change):
        mean = data.poses.accelerometer_mean.at[4, 1].add(change[1])
        changed = eqx.tree_at(lambda d: (d.gravity, d.poses.accelerometer_mean), data, (data.gravity + change[0], mean))
        return solve(problem_of(changed), ZERO).z

    at = jax.jit(solution)
    step = 1e-4
    central = np.stack([(at(d) - at(-d)) / (2 * step) for d in step * np.eye(2)], axis=1)
    assert np.all(np.abs(central).max(axis=0) > 0.01)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(derivative(solution))(jnp.zeros(2)), central, rtol=1e-5, atol=1e-5)


def test_losses_are_the_roots_of_their_definitions():
    residual = jnp.linspace(-30, 30, 241)
    size = np.abs(np.asarray(residual))
    rho = {
        "linear": size**2 / 2,
        "huber": np.where(size <= 1.345, size**2 / 2, 1.345 * size - 1.345**2 / 2),
        "cauchy": 2.385**2 / 2 * np.log1p((size / 2.385) ** 2),
    }
    assert set(rho) == set(LOSSES)
    for name, loss in LOSSES.items():
        np.testing.assert_allclose(loss(residual) ** 2 / 2, rho[name], rtol=1e-10, atol=1e-12)
        np.testing.assert_array_equal(np.sign(loss(residual)), np.sign(residual))
        slope = jax.vmap(jax.grad(loss))(jnp.array([0.0, 1e-9, -1e-5, 1.345, -50.0]))
        assert np.all(np.isfinite(slope))
        np.testing.assert_allclose(slope[:3], 1.0, atol=1e-6)


def test_parameters_and_model():
    case = simulated(4)
    z = PARAMETERS.vector(case.imu)
    model = PARAMETERS.model(NOMINAL, z)
    np.testing.assert_allclose(model.accelerometer.gain, case.imu.accelerometer.gain, atol=1e-14)
    np.testing.assert_allclose(model.accelerometer.bias, case.imu.accelerometer.bias, atol=1e-14)
    np.testing.assert_array_equal(model.gyroscope.gain, np.eye(3))  # not free: stays
    assert PARAMETERS.names[:3] == ("accelerometer.gain[0,0]", "accelerometer.gain[1,0]", "accelerometer.gain[1,1]")


def test_names_say_what_a_number_is():
    """They are strings as the calibration file has them, and survive a copy."""
    imu = NOMINAL.with_effects(CATALOGUE["gyro.thermal_lag"].dormant(), CATALOGUE["setup.table_tilt"].dormant())
    names = names_of(imu)
    assert len(names) == len(set(names)) == len(flatten(imu))
    assert names[1] == "accelerometer.gain[0,1]" and names[1].axes == (0, 1) and names[1].effect is None
    inner = names[names.index("gyroscope.effects[0].time_constant")]
    assert (inner.owner, inner.part, inner.axes, inner.effect) == ("gyroscope", "time_constant", (), 0)
    assert "setup[0].coefficients[1]" in names
    for name in (names[1], inner):
        twin = pickle.loads(pickle.dumps(name))
        assert twin == name and twin.part == name.part and json.dumps([name]) == f'["{name}"]'
