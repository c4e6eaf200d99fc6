"""Pre-integration: the rotation ΔR, velocity Δv and displacement Δp that samples of a unit add up to.

Of samples k with rate ω_k and specific force f_k (Lupton and Sukkarieh, IEEE Transactions on Robotics 28, 2012;
Forster et al., the same 33, 2017):

    ΔR = Π Exp(θ_k),   Δv = Σ R_{k−1} J_l(θ_k) ν_k,   Δp = Σ R_{k−1} (J_l(θ_k) ν_k w_k − θ_k × ν_k h/12),

θ_k the sample's rotation vector with coning, ν_k its velocity increment with sculling (`increments`), R_{k−1} the
rotation up to there, h the sample's length and w_k the time from its middle to the end. ΔR is a quaternion from the
last body frame to the first; Δv (m/s) and Δp (m) are in the first. Gravity, the Earth's rotation and the velocity at
the start are not in them: an estimator adds them, R_j = R_i ΔR, v_j = v_i + g T + R_i Δv and
p_j = p_i + v_i T + ½ g T² + R_i Δp.

Errors are nine numbers: the rotation vector in the last body frame (rad), then those of Δv and Δp.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from jaximu.ground.array_types import Array
from jaximu.ground.differences import value_and_jacobian
from jaximu.ground.errors import InputError
from jaximu.ground.precision import require_float64
from jaximu.ground.rotation import (
    Matrix,
    Numbers,
    Quaternion,
    Vector,
    Vectors,
    apply_matrix,
    conjugate,
    exponential,
    multiply,
    right_jacobian,
    rotation_matrix,
    rotation_vectors,
    running_rotations,
    transport,
)
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus


def increments(rates: Vectors, forces: Vectors, intervals: Float[Array, "... S"]) -> tuple[Vectors, Vectors]:
    """Return each sample's rotation vector θ (rad) with coning, and its ∫f dt (m/s) with sculling, ν.

    Rotation and velocity together are a rigid motion whose twist is the dual number ω + ε f (ε² = 0), so what holds of
    rotation vectors holds of θ + ε ν: sculling is the derivative of coning along f (Roscoe, Journal of Guidance,
    Control, and Dynamics 24, 2001), and the velocity gained, in the frame at the sample's start, is J_l(θ) ν.

    **Arguments:** `rates` (rad/s) and `forces` (m/s²), means over `intervals` (s; zero for padding, which follows).
    """
    return jax.jvp(lambda rate: rotation_vectors(rate, intervals), (rates,), (forces,))


class Turned(NamedTuple):
    """What rates add up to, and how frames react to them.

    running: the rotation after each sample, to the first frame. sweep: how the rate of each sample turns all frames
    after it (s), in the first frame. A rotation vector θ_k off by δ turns the frame after it by J_r(θ_k) δ; how a
    change of the rates changes coning is left out, h²/12 of what the change itself changes by a second.
    """

    running: Float[Array, "... S 4"]
    sweep: Float[Array, "... S 3 3"]

    @property
    def rotation(self) -> Quaternion:
        """From the last body frame to the first."""
        return self.running[..., -1, :]

    @property
    def reaction(self) -> Float[Array, "... S 3 3"]:
        """How the rate of each sample turns the last frame (s), in that frame."""
        return self.back[..., None, :, :] @ self.sweep

    @property
    def back(self) -> Matrix:
        """The matrix that takes vectors of the first frame to the last."""
        return rotation_matrix(conjugate(self.rotation))


def turned_by_rates(rates: Vectors, intervals: Float[Array, "... S"]) -> Turned:
    """Return the rotations of rates (rad/s) that hold over `intervals` (s; zero for padding)."""
    vectors = rotation_vectors(rates, intervals)
    running = running_rotations(vectors)
    return Turned(running, transport(running, vectors) * intervals[..., None, None])


def linear_slope(reaction: Float[Array, "... S k 3"], output: Vectors) -> Float[Array, "... k 3 4"]:
    """Return how sums react to (A | c), of samples A y + c, by their reaction to each sample and its output y."""
    with_one = jnp.concatenate([output, jnp.ones_like(output[..., :1])], axis=-1)
    sums = _flat(reaction).mT @ with_one
    return sums.reshape(*sums.shape[:-2], *reaction.shape[-2:], 4)


def _flat(reaction):
    """Return the entries of each sample's matrix in a row: one product of matrices sums over all samples."""
    return reaction.reshape(*reaction.shape[:-2], reaction.shape[-2] * reaction.shape[-1])


def white_covariance(
    reaction: Float[Array, "... S k n"], density: Float[Array, "n n"], intervals: Float[Array, "... S"]
) -> Float[Array, "... k k"]:
    """Return the covariance of sums whose samples have white noise of a density (two-sided, unit² s)."""
    entries, shape = _flat(reaction), reaction.shape[-2:]
    squares = (entries / jnp.where(intervals > 0, intervals, 1.0)[..., None]).mT @ entries
    return jnp.einsum("...ijkl,jl->...ik", squares.reshape(*squares.shape[:-2], *shape, *shape), density)


class Preintegrated(NamedTuple):
    """ΔR (4,), Δv (3,), Δp (3,) over `duration` (s), and how their nine errors react to what made them.

    reaction: (S, 9, 6) to a change of each sample's rate (rad/s) and force (m/s²). parameters: (9, m) to every number
    of the unit, in the order of `jaximu.estimation.problem.flatten`; with a calibration's covariance C of the numbers
    that it fitted, `parameters[:, places] @ C @ parameters[:, places].T` is its part of the increments' covariance.
    """

    rotation: Quaternion
    velocity: Vector
    displacement: Vector
    duration: Numbers
    reaction: Float[Array, "... S 9 6"]
    parameters: Float[Array, "... 9 m"] | None = None

    def moved(self, change: Float[Array, "... m"]) -> Preintegrated:
        """Return ΔR, Δv and Δp of a unit whose numbers differ by so much, to first order; leading axes broadcast."""
        assert self.parameters is not None
        error = jnp.einsum("...im,...m->...i", self.parameters, change)
        return Preintegrated(
            multiply(self.rotation, exponential(error[..., :3])),
            self.velocity + error[..., 3:6],
            self.displacement + error[..., 6:],
            self.duration,
            self.reaction,
        )


def preintegrate_samples(rates: Vectors, forces: Vectors, intervals: Float[Array, "... S"]) -> Preintegrated:
    """Return the increments of rates (rad/s) and specific forces (m/s²) that hold over `intervals` (s)."""
    vectors, gained = increments(rates, forces, intervals)
    left_jacobian = right_jacobian(vectors).mT
    whole = turned_by_rates(rates, intervals)
    start = jnp.zeros_like(whole.running[..., :1, :]).at[..., 0].set(1.0)
    before = rotation_matrix(jnp.concatenate([start, whole.running[..., :-1, :]], axis=-2))
    left = (intervals[..., ::-1].cumsum(axis=-1)[..., ::-1] - intervals / 2)[..., None]
    by_force = before @ left_jacobian * intervals[..., None, None]
    parts = apply_matrix(before @ left_jacobian, gained)
    bent = apply_matrix(before, jnp.cross(vectors, gained)) * intervals[..., None] / 12
    rows = [jnp.concatenate([whole.reaction, jnp.zeros_like(whole.sweep)], axis=-1)]
    for moved, weight in ((parts, jnp.ones_like(left)), (parts * left, left)):
        later = moved[..., ::-1, :].cumsum(axis=-2)[..., ::-1, :] - moved / 2  # half of its own sample's, too
        swung = -jnp.cross(later[..., :, None], whole.sweep, axis=-2)
        rows.append(jnp.concatenate([swung, by_force * weight[..., None]], axis=-1))
    return Preintegrated(
        whole.rotation,
        parts.sum(axis=-2),
        (parts * left - bent).sum(axis=-2),
        intervals.sum(axis=-1),
        jnp.concatenate(rows, axis=-2),
    )


def preintegrate(
    imu: Imu,
    accelerometer: Vectors,
    gyroscope: Vectors,
    intervals: Float[Array, " S"],
    stimulus: Stimulus | None = None,
) -> Preintegrated:
    """Return the increments of a unit's outputs, and their derivatives by every number of the unit.

    Forward-mode: the corrected rates and forces are differentiated by gain, bias and effects, and carried to the end by
    the samples' reaction.

    **Arguments:** outputs (in the unit's output units) on the same stamps, sample k over `intervals[k]` (s);
    `stimulus`: what else the effects depend on (temperature, time …). Raises `InputError` for a unit without gyroscope.
    """
    require_float64()
    if imu.gyroscope is None:
        raise InputError("pre-integration needs a gyroscope, which this unit lacks.")
    numbers, restore = ravel_pytree(imu)

    def recovered(numbers):
        force, rate = restore(numbers).recover(accelerometer, gyroscope, stimulus)
        return jnp.hstack([rate, force])

    samples, slopes = value_and_jacobian(recovered, numbers)
    whole = preintegrate_samples(*jnp.hsplit(samples, 2), intervals=intervals)
    return whole._replace(parameters=jnp.einsum("sij,sjm->im", whole.reaction, slopes))
