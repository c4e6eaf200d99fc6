"""The fit of a unit as scipy solves it: the whitened two-step problem with the weights already computed.

Residual and Jacobian in NumPy as fast as we could make them: analytic Jacobians, the product of exponential maps by
blocks, its prefixes kept from residual to Jacobian. Coning within a sample is left out, to scipy's advantage.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

from jaximu.data.gravity_norm import recover_specific_force
from jaximu.data.poses_covariance import condition_covariance
from jaximu.estimation.covariance import inverse_cholesky
from jaximu.estimation.problem import TOLERANCE
from jaximu.ground.rotation import unit_vectors

LOWER = np.tril_indices(3)


class Accelerometer:
    """Whitened norm residuals of P rests and their Jacobian, in NumPy; nine parameters, scaled to order one."""

    def __init__(self, mean, weight, gravity):
        self.mean, self.weight, self.gravity = mean, weight, gravity

    def split(self, z):
        gain = np.eye(3)
        gain[LOWER] += 0.1 * z[:6]
        return np.linalg.inv(gain), z[6:]

    def residual(self, z):
        inverse, bias = self.split(z)
        force = (self.mean - bias) @ inverse.T
        data = self.weight * (self.gravity**2 - np.einsum("pi,pi->p", force, force)) / (2 * self.gravity)
        return np.concatenate([data, z / TOLERANCE])

    def jacobian(self, z):
        inverse, bias = self.split(z)
        force = (self.mean - bias) @ inverse.T
        # d|f|²/2 = −(K⁻ᵀ f)·(dK f + db)
        back = (self.weight / self.gravity)[:, None] * (force @ inverse)
        data = np.concatenate([0.1 * back[:, LOWER[0]] * force[:, LOWER[1]], back], axis=1)
        return np.concatenate([data, np.eye(9) / TOLERANCE])


def multiply(p, q):
    pw, px, py, pz = p
    qw, qx, qy, qz = q
    return np.array([
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    ])  # fmt: skip


def matrix(q):
    w, x, y, z = q
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


class Gyroscope:
    """Whitened direction residuals of T turns and means at rest, and their Jacobian, in NumPy; twelve parameters.

    Arrays are laid out components first and samples × turns last. `prefixes` multiplies side by side: by doubling
    within blocks ("tree"), or block by block.
    """

    def __init__(self, output, interval, basis, weight, directions, rest, rest_weight):
        samples = output.shape[1]
        self.blocks = next(b for b in range(round(samples**0.5), 0, -1) if samples % b == 0)
        self.output = np.ascontiguousarray(np.transpose(output, (2, 1, 0)))  # component, sample, turn
        self.interval = np.ascontiguousarray(interval.T)
        self.rows = weight @ basis  # (T, 2, 3)
        self.before, self.after = directions[:-1], directions[1:]
        self.constant = np.einsum("tai,ti->ta", self.rows, self.after)
        # Means at rest: the bias alone. Their sum of squares is one of three rows and a constant, which is kept apart.
        stacked, target = rest_weight.reshape(-1, 3), np.einsum("pij,pj->pi", rest_weight, rest).ravel()
        q, self.rest_factor = np.linalg.qr(stacked)
        self.rest_target = q.T @ target
        self.rest_cost = 0.5 * (target @ target - self.rest_target @ self.rest_target)
        self.kept = None

    def split(self, z):
        return np.linalg.inv(np.eye(3) + 0.1 * z[:9].reshape(3, 3)), 0.1 * z[9:]

    def prefixes(self, parts):
        _, samples, turns = parts.shape
        length = samples // self.blocks
        blocks = parts.reshape(4, self.blocks, length, turns)
        within = np.empty_like(blocks)
        within[:, :, 0] = now = blocks[:, :, 0]
        for k in range(1, length):
            within[:, :, k] = now = multiply(now, blocks[:, :, k])
        before = np.zeros((4, self.blocks, turns))
        before[0, 0] = 1.0
        for k in range(1, self.blocks):
            before[:, k] = multiply(before[:, k - 1], within[:, k - 1, -1])
        return multiply(before[:, :, None], within).reshape(4, samples, turns)

    def run(self, z):
        """Everything that residual and Jacobian share at z."""
        if self.kept is None or not np.array_equal(self.kept[0], z):
            inverse, bias = self.split(z)
            shape = self.output.shape
            vectors = (inverse @ (self.output.reshape(3, -1) - bias[:, None])).reshape(shape) * self.interval
            squared = np.einsum("ist,ist->st", vectors, vectors)
            angle = np.sqrt(np.maximum(squared, 1e-16))
            cosine, sine = np.cos(angle / 2), np.sin(angle / 2) / angle
            running = self.prefixes(np.concatenate([cosine[None], sine * vectors]))
            final = matrix(running[:, -1])  # (3, 3, T)
            carried = np.einsum("jit,tj->ti", final, self.before)
            self.kept = z.copy(), inverse, vectors, squared, cosine, sine, running, final, carried
        return self.kept

    def residual(self, z):
        *_, carried = self.run(z)
        turned = self.constant - np.einsum("tai,ti->ta", self.rows, carried)
        return np.concatenate([turned.ravel(), self.rest_target - self.rest_factor @ (0.1 * z[9:]), z / TOLERANCE])

    def jacobian(self, z):
        _, inverse, vectors, squared, cosine, sine, running, final, carried = self.run(z)
        first = 2 * sine**2
        second = (1 - 2 * sine * cosine) / np.maximum(squared, 1e-12)
        # R J_r v for the three unit vectors v, J_r = I − first [θ]× + second [θ]×²
        x, y, w = vectors
        jr = np.array([
            [1 - second * (y * y + w * w), first * w + second * x * y, -first * y + second * x * w],
            [-first * w + second * x * y, 1 - second * (x * x + w * w), first * x + second * y * w],
            [first * y + second * x * w, -first * x + second * y * w, 1 - second * (x * x + y * y)],
        ])  # fmt: skip
        rotation = matrix(running)
        transport = np.array([[sum(rotation[i, k] * jr[k, j] for k in range(3)) for j in range(3)] for i in range(3)])
        samples, turns = self.interval.shape
        stacked = transport.reshape(9, samples, turns).transpose(2, 0, 1)  # (T, 9, S)
        factors = np.concatenate([vectors, self.interval[None]]).transpose(2, 1, 0)  # (T, S, 4)
        moments = (stacked @ factors).reshape(turns, 3, 3, 4)  # Σ R J_r (θ, dt)
        moments = np.einsum("tijk,jl->tilk", moments, -inverse)  # dθ = −K⁻¹ (dK θ + db dt)
        moments = np.einsum("jit,tjlk->tilk", final, moments)  # brought to the last frame
        # a rotation δ of the last frame moves the carried direction u by u × δ
        lever = -np.cross(self.rows, carried[:, None])  # −rows·(u × δ) = −(rows × u)·δ
        by = 0.1 * np.einsum("tai,tilk->talk", lever, moments).reshape(2 * turns, 3, 4)
        data = np.concatenate([by[:, :, :3].reshape(-1, 9), by[:, :, 3]], axis=1)
        rest = np.concatenate([np.zeros((3, 9)), -0.1 * self.rest_factor], axis=1)
        return np.concatenate([data, rest, np.eye(12) / TOLERANCE])


def scipy_fit(accelerometer, gyroscope):
    """Both triads by scipy; returns parameters and cost."""
    options = {"method": "lm", "xtol": 1e-9, "ftol": 1e-9, "gtol": 1e-9, "x_scale": 1.0}
    a = least_squares(accelerometer.residual, np.zeros(9), accelerometer.jacobian, **options)
    g = least_squares(gyroscope.residual, np.zeros(12), gyroscope.jacobian, **options)
    return a, g


@jax.jit
def two_step_weights(model, observations, excess):
    """What the two-step problems hold fixed: weights of norms, turns and means at rest, and directions of gravity."""
    total = condition_covariance(model, observations).dense().total(excess)
    poses, turns = len(observations.poses.mask), len(observations.turns.mask)

    def weights(first, count, size):
        rows = first + jnp.arange(count * size).reshape(count, size)
        return inverse_cholesky(total[rows[:, :, None], rows[:, None, :]])

    directions = unit_vectors(recover_specific_force(model, observations.poses))
    norm, turned = weights(0, poses, 1)[:, 0, 0], weights(poses, turns, 2)
    return norm, turned, weights(poses + 2 * turns, poses, 3), directions


def numpy_problems(observations, weights):
    """The same for scipy: both triads of one unit, without padding."""
    observations, (norm, turned, rest, directions) = jax.tree.map(np.asarray, (observations, weights))
    poses, turns = observations.poses.mask, observations.turns.mask
    samples = 8 * -(-int((observations.turns.interval > 0).sum(axis=1).max()) // 8)  # whole blocks
    accelerometer = Accelerometer(
        observations.poses.accelerometer_mean[poses], norm[poses], float(observations.gravity)
    )
    gyroscope = Gyroscope(
        observations.turns.output[turns][:, :samples], observations.turns.interval[turns][:, :samples],
        observations.turns.basis[turns], turned[turns], directions[: int(turns.sum()) + 1],
        observations.poses.gyroscope_mean[poses], rest[poses],
    )  # fmt: skip
    return accelerometer, gyroscope


def check_jacobians(*problems) -> None:
    """The analytic Jacobians against central differences: scipy must not be slowed by a wrong one."""
    for problem in problems:
        size = 9 if isinstance(problem, Accelerometer) else 12
        z = 0.05 * np.sin(np.arange(size) + 1.0)
        steps = 1e-6 * np.eye(size)
        numeric = np.stack([(problem.residual(z + s) - problem.residual(z - s)) / 2e-6 for s in steps], axis=1)
        exact = problem.jacobian(z)
        assert np.abs(numeric - exact).max() < 1e-6 * np.abs(exact).max()
