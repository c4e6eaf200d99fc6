"""Rotations: axioms and edge samples, the exact composition and its derivative, integration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaximu.ground import rotation as r

AXIS = np.array([2.0, -1.0, 2.0]) / 3.0
# identity, far below and on both sides of each switch to a series, ordinary, near and at half a turn
ANGLES = (0.0, 1e-12, 1e-7, 0.99e-4, 1.01e-4, 0.0099, 0.0101, 0.5, 2.0, np.pi - 1e-7, np.pi)
VECTORS = np.array([angle * AXIS for angle in ANGLES])
SHAPES = ((), (1,), (3, 1, 2))

exponential, logarithm, multiply = jax.jit(r.exponential), jax.jit(r.logarithm), jax.jit(r.multiply)


def whole_rotation(vectors):
    return r.running_rotations(vectors)[..., -1, :]


compose, running_rotations = jax.jit(whole_rotation), jax.jit(r.running_rotations)
compose_jacobian = jax.jit(jax.jacfwd(whole_rotation))
integrate = jax.jit(r.integrate_rates, static_argnums=2)


def reference(vectors) -> np.ndarray:
    """SciPy's quaternion, scalar first."""
    quaternions = Rotation.from_rotvec(np.array(vectors).reshape(-1, 3)).as_quat()
    return np.roll(quaternions, 1, axis=-1).reshape((*np.shape(vectors)[:-1], 4))


def vectors(shape, samples, seed=0, size=0.4):
    return jnp.asarray(size * np.random.default_rng(seed).standard_normal((*shape, samples, 3)))


def naive(rotation_vectors):
    q = jnp.zeros((*rotation_vectors.shape[:-2], 4)).at[..., 0].set(1.0)
    for k in range(rotation_vectors.shape[-2]):
        q = r.multiply(q, r.exponential(rotation_vectors[..., k, :]))
    return q


def same_rotation(a, b, tolerance=1e-14):
    sign = np.sign(np.sum(np.asarray(a) * np.asarray(b), axis=-1, keepdims=True))
    np.testing.assert_allclose(a, sign * b, rtol=0, atol=tolerance)


def test_exponential_and_logarithm():
    q = exponential(VECTORS)
    same_rotation(q, reference(VECTORS))
    np.testing.assert_allclose(np.linalg.norm(q, axis=-1), 1.0, atol=1e-15)
    back = np.array(logarithm(q))
    back[-1] *= np.sign(back[-1] @ VECTORS[-1])  # half a turn: either way round
    np.testing.assert_allclose(back, VECTORS, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(logarithm(-q)[:-1], back[:-1], rtol=1e-12, atol=1e-15)  # q and −q are one rotation


@pytest.mark.parametrize("shape", SHAPES)
def test_group_axioms(shape):
    a, b, c = (exponential(vectors(shape, 1, seed)[..., 0, :]) for seed in range(3))
    v = jnp.asarray(np.random.default_rng(4).standard_normal((*shape, 3)))
    identity = jnp.zeros((*shape, 4)).at[..., 0].set(1.0)
    np.testing.assert_allclose(multiply(multiply(a, b), c), multiply(a, multiply(b, c)), atol=1e-15)
    np.testing.assert_allclose(multiply(a, identity), a, atol=1e-15)
    np.testing.assert_allclose(multiply(a, r.conjugate(a)), identity, atol=1e-15)
    np.testing.assert_allclose(r.rotate(multiply(a, b), v), r.rotate(a, r.rotate(b, v)), atol=1e-14)
    matrix = r.rotation_matrix(a)
    assert matrix.shape == (*shape, 3, 3)
    np.testing.assert_allclose(np.einsum("...ij,...j->...i", matrix, v), r.rotate(a, v), atol=1e-14)
    np.testing.assert_allclose(r.rotation_matrix(multiply(a, b)), matrix @ r.rotation_matrix(b), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(matrix), 1.0, atol=1e-14)


@pytest.mark.parametrize("shape", SHAPES)
def test_small_matrices(shape):
    random = np.random.default_rng(0)
    matrix, vector = random.standard_normal((*shape, 3, 3)), random.standard_normal((*shape, 3))
    np.testing.assert_allclose(
        r.apply_matrix(jnp.asarray(matrix), jnp.asarray(vector)), (matrix @ vector[..., None])[..., 0], atol=1e-14
    )
    np.testing.assert_allclose(r.inverse_matrix(jnp.asarray(matrix)), np.linalg.inv(matrix), rtol=1e-10, atol=1e-12)


def test_right_jacobian_is_the_derivative_of_the_exponential():
    def moved(v, change):
        return r.logarithm(r.multiply(r.conjugate(r.exponential(v)), r.exponential(v + change)))

    derivative = jax.jit(jax.vmap(jax.jacfwd(moved, argnums=1), in_axes=(0, None)))(jnp.asarray(VECTORS), jnp.zeros(3))
    np.testing.assert_allclose(r.right_jacobian(jnp.asarray(VECTORS)), derivative, rtol=0, atol=1e-11)


def test_derivatives_are_finite_and_right_at_the_edges():
    there_and_back = jax.jit(jax.vmap(jax.jacfwd(lambda v: r.logarithm(r.exponential(v)))))(jnp.asarray(VECTORS[:-1]))
    np.testing.assert_allclose(there_and_back, np.broadcast_to(np.eye(3), there_and_back.shape), atol=1e-6)
    first = jax.jacfwd(r.exponential)(jnp.zeros(3))
    np.testing.assert_allclose(first, np.vstack([np.zeros(3), np.eye(3) / 2]), atol=1e-15)
    second = jax.jit(jax.hessian(lambda v: r.exponential(v)[0]))(jnp.zeros(3))
    np.testing.assert_allclose(second, -np.eye(3) / 4, atol=1e-15)


@pytest.mark.parametrize(("shape", "samples"), [((), 50), ((), 1), ((), 2), ((), 7), ((1,), 7), ((3, 1, 2), 7)])
def test_compose_is_the_product(shape, samples):
    steps = vectors(shape, samples)
    expected = reference(steps)
    q = expected[..., 0, :]
    for k in range(1, samples):
        q = multiply(q, expected[..., k, :])
    result = compose(steps)
    assert result.shape == (*shape, 4)
    np.testing.assert_allclose(result, q, atol=1e-14)  # the sign too: it is a product of exponentials
    running = running_rotations(steps)
    assert running.shape == (*shape, samples, 4)
    np.testing.assert_allclose(running[..., -1, :], q, atol=1e-14)
    np.testing.assert_allclose(running[..., 0, :], expected[..., 0, :], atol=1e-14)


def test_padding_changes_nothing():
    steps = vectors((2,), 20)
    padded = jnp.concatenate([steps, jnp.zeros((2, 13, 3))], axis=1)
    np.testing.assert_allclose(compose(padded), compose(steps), atol=1e-14)
    tangent = compose_jacobian(padded)[..., :20, :]
    np.testing.assert_allclose(tangent, compose_jacobian(steps), atol=1e-14)
    rates, interval = steps / 0.01, jnp.full((2, 20), 0.01)
    wide, padded_interval = padded / 0.01, jnp.concatenate([interval, jnp.zeros((2, 13))], axis=1)
    for method in ("exponential", "rk4"):
        np.testing.assert_allclose(
            integrate(wide, padded_interval, method), integrate(rates, interval, method), atol=1e-14
        )


@pytest.fixture(scope="module")
def other_jacobians():
    return jax.jit(jax.jacfwd(naive)), jax.jit(jax.jacrev(whole_rotation))


@pytest.mark.parametrize("size", [0.0, 1e-7, 0.01, 0.5])
def test_derivative_of_compose(size, other_jacobians):
    steps = vectors((), 5, size=size)
    forward = compose_jacobian(steps)
    for jacobian in other_jacobians:  # traced through the product, and in reverse
        np.testing.assert_allclose(jacobian(steps), forward, atol=1e-13)
    step = 1e-5
    for k, axis in ((0, 0), (2, 1), (4, 2)):
        change = jnp.zeros_like(steps).at[k, axis].set(step)
        central = (compose(steps + change) - compose(steps - change)) / (2 * step)
        np.testing.assert_allclose(forward[:, k, axis], central, atol=1e-9)


def test_second_derivative_of_compose():
    """Along the directions that a gain stretches: what a Newton step or a curvature test asks for."""
    steps, direction = vectors((), 4), vectors((), 4, seed=1)

    def along(function):
        def value(t):
            return function(steps * (1 + t[0]) + t[1] * direction)

        return jax.jit(jax.jacfwd(jax.jacfwd(value)))(jnp.zeros(2))

    np.testing.assert_allclose(along(whole_rotation), along(naive), atol=1e-12)


def wobbling(time):
    """Attitude q(t) = exp(a(t)) exp(b(t)) about two axes, and its exact body rate."""
    a, b = 0.9 * np.sin(1.3 * time), 0.7 * np.sin(2.1 * time + 0.3)
    a_dot, b_dot = 0.9 * 1.3 * np.cos(1.3 * time), 0.7 * 2.1 * np.cos(2.1 * time + 0.3)
    first, second = np.outer(a, [1.0, 0, 0]), np.outer(b, [0, 0.6, 0.8])
    carried = Rotation.from_rotvec(second).inv().apply(np.outer(a_dot, [1.0, 0, 0]))
    return Rotation.from_rotvec(first) * Rotation.from_rotvec(second), carried + np.outer(b_dot, [0, 0.6, 0.8])


@pytest.mark.parametrize("method", ["exponential", "rk4"])
def test_integration_converges_to_the_true_attitude(method):
    errors = []
    for samples in (100, 200):
        interval = 2.0 / samples
        rate = wobbling((np.arange(samples) + 0.5) * interval)[1]
        q = np.asarray(integrate(jnp.asarray(rate), jnp.full(samples, interval), method))
        ends = wobbling(np.array([0.0, 2.0]))[0]
        errors.append((ends[0].inv() * ends[1] * Rotation.from_quat(np.roll(q, -1)).inv()).magnitude())
    order = np.log2(np.array(errors[:-1]) / errors[1:])
    # samples are taken as held, or joined by straight lines: second order in the sample interval either way
    np.testing.assert_allclose(order, 2.0, atol=0.1)
    assert errors[-1] < 4e-4


def two_axes(time):
    """A turn from rest to rest in 1.6 s whose axis moves: attitude exp(s a) exp(w b), and its exact body rate."""
    x = time / 1.6
    a, b = np.array([1.2, -0.9, 1.3]), np.array([-0.3, 0.5, 0.2])
    done, speed = x**3 * (10 - 15 * x + 6 * x**2), 30 * x**2 * (1 - x) ** 2 / 1.6
    aside, lean = 64 * (x * (1 - x)) ** 3, 192 * (x * (1 - x)) ** 2 * (1 - 2 * x) / 1.6
    second = Rotation.from_rotvec(np.outer(aside, b))
    return Rotation.from_rotvec(np.outer(done, a)) * second, second.inv().apply(np.outer(speed, a)) + np.outer(lean, b)


@pytest.mark.parametrize("sampled", [r.MEAN_RATES, r.POINT_RATES])
def test_coning_within_a_sample(sampled):
    """Of means over each sample (by quadrature) and of points: fourth order, where rates held are of the second."""
    nodes, weights = np.polynomial.legendre.leggauss(10)
    held, coned = [], []
    for samples in (40, 80, 160):  # 25, 50 and 100 Hz
        interval = 1.6 / samples
        middle = (np.arange(samples) + 0.5) * interval
        inside = (middle[:, None] + nodes * interval / 2).ravel()
        mean = np.einsum("n,snc->sc", weights / 2, two_axes(inside)[1].reshape(samples, 10, 3))
        rate = mean if sampled is r.MEAN_RATES else two_axes(middle)[1]
        true = two_axes(np.array([0.0, 1.6]))[0]
        for errors, turned in (
            (held, rate * interval), (coned, r.rotation_vectors(rate, np.full(samples, interval), sampled))
        ):  # fmt: skip
            q = Rotation.from_quat(np.asarray(compose(jnp.asarray(turned))), scalar_first=True)
            errors.append(((true[0].inv() * true[1]).inv() * q).magnitude())
    np.testing.assert_allclose(np.log2(np.array(held[:-1]) / held[1:]), 2.0, atol=0.1)
    assert np.all(np.log2(np.array(coned[:-1]) / coned[1:]) > 3.7)
    assert coned[0] < held[0] / 40
    # what rates held lack is h²/12 ∫ω × ω' dt of means, half of it of points: known beforehand, in the last frame
    time = np.linspace(0, 1.6, 20001)
    attitude, rate = two_axes(time)
    lost = attitude[-1].inv().apply(attitude.apply(np.cross(rate, np.gradient(rate, time, axis=0)))).sum(axis=0)
    share = 12 if sampled is r.MEAN_RATES else 24
    assert held[2] == pytest.approx(np.linalg.norm(lost) * time[1] * 0.01**2 / share, rel=0.02)


def test_coning_of_a_cone():
    """ω = (cos θk, sin θk) drifts by half of θ − sin θ a sample beyond its means; nothing is added about one axis."""
    for angle in (0.05, 0.2, 0.6):
        k = np.arange(9)
        amplitude = 2e-3 * np.sin(angle / 2)
        vectors = amplitude * np.stack([np.cos(angle * k), np.sin(angle * k), 0 * k], axis=1)
        added = np.asarray(r.rotation_vectors(vectors, np.ones(9))) - vectors
        drift = 1e-6 * (angle - np.sin(angle)) / 2
        np.testing.assert_allclose(added[1:-1, 2], drift, rtol=2e-2 * angle**2 + 1e-3 * angle)
    straight = np.outer(np.sin(np.arange(9.0)), AXIS)
    np.testing.assert_allclose(r.rotation_vectors(straight, np.ones(9)), straight, atol=1e-16)


def test_runge_kutta_is_of_fourth_order_where_the_rate_is_constant():
    errors = []
    for samples in (20, 40):
        rates = jnp.broadcast_to(jnp.asarray(2.5 * AXIS), (samples, 3))
        q = integrate(rates, jnp.full(samples, 1.0 / samples), "rk4")
        errors.append(float(jnp.linalg.norm(r.logarithm(r.multiply(r.conjugate(exponential(2.5 * AXIS)), q)))))
    np.testing.assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 4.0, atol=0.1)


def test_unknown_method():
    with pytest.raises(ValueError, match="'exponential' or 'rk4'"):
        r.integrate_rates(jnp.zeros((2, 3)), jnp.ones(2), "euler")
