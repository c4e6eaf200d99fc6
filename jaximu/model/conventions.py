"""A triad's gain and bias in the conventions of other tools and papers, converted exactly both ways.

The library's own convention is forward, y = K u + b: `u` is the true specific force (m/s²) or angular rate (rad/s) in
the body frame, `y` the output, `gain` K (..., 3, 3) in output units per SI unit, `bias` b (..., 3) in output units.
Row i of K belongs to output i: K[..., 0, 1] is what x reports of an input along y. A view is made by
`from_gain(gain, bias)` and turned back by `to_gain()`; leading axes are batch axes; `equation` is what its numbers
mean, ready to print.

A gain that a view cannot express (singular, a zero diagonal, left-handed where a rotation is split off) raises
`InputError`. The check needs values: inside `jax.jit` or `jax.vmap` it is left out, and such a gain gives inf, NaN or
an improper rotation.

Between conventions with different body frames no single entry of K can be compared: u_old = R u_new turns K into K R.
What every frame agrees on is K Kᵀ, so the norms of K's rows and the angles between them.
"""

from collections.abc import Callable
from typing import ClassVar, NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaximu.ground.errors import InputError
from jaximu.ground.rotation import Matrix, Vector, inverse_matrix

_PPM = 1e6
_SINGULAR = 1e-9
"""Smallest singular value or diagonal of a matrix whose rows are scaled to unit length, and a rotation's departure."""


class ScaleMisalignment(eqx.Module):
    """The library's own factors of the gain: scale first, then dimensionless misalignment.

    y = S (I + M) u + b, S = diag(scale), M with a zero diagonal, so K = S(I+M).

    scale: (..., 3) output units per SI unit. misalignment: (..., 3, 3) dimensionless, small angles in rad.
    bias: (..., 3) output units.
    """

    scale: Vector
    misalignment: Matrix
    bias: Vector
    equation: ClassVar[str] = "y = S (I + M) u + b"

    @classmethod
    def from_gain(cls, gain: Matrix, bias: Vector) -> "ScaleMisalignment":
        """Split K = S(I+M). Raises InputError if a diagonal entry of K is zero."""
        _refuse_zero_diagonal(gain, "gain")
        scale = _diagonal(gain)
        return cls(scale, _off_diagonal(gain) / scale[..., :, None], jnp.asarray(bias))

    def to_gain(self) -> tuple[Matrix, Vector]:
        """Return (K, b)."""
        return _diag(self.scale) + jnp.asarray(self.scale)[..., :, None] * self.misalignment, self.bias


class SimplifiedScaleMisalignment(eqx.Module):
    """The shortened textbook form, whose M is not the M of `ScaleMisalignment` but S times it.

    y = (S + M) u + b, S = diag(scale), M with a zero diagonal.

    scale: (..., 3) and misalignment: (..., 3, 3), both in output units per SI unit. bias: (..., 3) output units.
    """

    scale: Vector
    misalignment: Matrix
    bias: Vector
    equation: ClassVar[str] = "y = (S + M) u + b"

    @classmethod
    def from_gain(cls, gain: Matrix, bias: Vector) -> "SimplifiedScaleMisalignment":
        """Split K = S + M."""
        return cls(_diagonal(gain), _off_diagonal(gain), jnp.asarray(bias))

    def to_gain(self) -> tuple[Matrix, Vector]:
        """Return (K, b)."""
        return _diag(self.scale) + self.misalignment, self.bias


class PartsPerMillion(eqx.Module):
    """Scale-factor error and cross-coupling as in the dividing-head paper, CSNC 2011: K = I + SF + N.

    y = (I + SF + N) u + b, SF = diag(scale_error)·1e-6, N = coupling·1e-6 with a zero diagonal. Meant for an output in
    SI units, where both are small.

    scale_error: (..., 3) ppm. coupling: (..., 3, 3) ppm. bias: (..., 3) output units.
    """

    scale_error: Vector
    coupling: Matrix
    bias: Vector
    equation: ClassVar[str] = "y = (I + 1e-6 SF + 1e-6 N) u + b"

    @classmethod
    def from_gain(cls, gain: Matrix, bias: Vector) -> "PartsPerMillion":
        """Split K = I + SF + N."""
        return cls(_PPM * (_diagonal(gain) - 1.0), _PPM * _off_diagonal(gain), jnp.asarray(bias))

    def to_gain(self) -> tuple[Matrix, Vector]:
        """Return (K, b)."""
        return _diag(1.0 + jnp.asarray(self.scale_error) / _PPM) + jnp.asarray(self.coupling) / _PPM, self.bias


Form = TypeVar("Form", bound="_Inverse")


class _Inverse(eqx.Module):
    misalignment: Matrix
    scale: Vector
    bias: Vector
    adds_bias: ClassVar[bool]

    @classmethod
    def from_gain(cls: type[Form], gain: Matrix, bias: Vector) -> Form:
        """Split K⁻¹ = T K'. Raises InputError if K is singular or K⁻¹ has a zero on its diagonal."""
        _refuse_singular(gain, "gain")
        inverse = inverse_matrix(jnp.asarray(gain))
        _refuse_zero_diagonal(inverse, "inverse of the gain")
        scale = _diagonal(inverse)
        return cls(inverse / scale[..., None, :], scale, cls._turned(bias))

    def to_gain(self) -> tuple[Matrix, Vector]:
        """Return (K, b). Raises InputError if T K' is singular."""
        inverse = jnp.asarray(self.misalignment) * jnp.asarray(self.scale)[..., None, :]
        _refuse_singular(inverse, "matrix T K'")
        return inverse_matrix(inverse), self._turned(self.bias)

    @classmethod
    def _turned(cls, bias: Vector) -> Vector:
        return -jnp.asarray(bias) if cls.adds_bias else jnp.asarray(bias)


class Tedaldi(_Inverse):
    """The inverse form of Tedaldi, Pretto and Menegatti, ICRA 2014, which *adds* its bias to the output.

    u = T K' (y + b'), T with a unit diagonal, K' = diag(scale), so K' = diag(K⁻¹), T = K⁻¹ K'⁻¹ and b' = −b.
    K' is S⁻¹ only for a triangular gain.

    misalignment: (..., 3, 3) T, dimensionless. scale: (..., 3) SI units per output unit. bias: (..., 3) output units.
    The paper's accelerometer has an upper-triangular T: take the gains through `upper_triangular_frame` first.
    """

    equation: ClassVar[str] = "u = T K' (y + b')"
    adds_bias = True


class ImuTk(_Inverse):
    """The inverse form as the program imu_tk writes it, which *subtracts* its bias, unlike the paper it implements.

    u = T K' (y − b''), T and K' as in `Tedaldi`, b'' = b.

    misalignment: (..., 3, 3) T, the matrix as printed, dimensionless. scale: (..., 3) SI units per output unit.
    bias: (..., 3) output units. The program's accelerometer has an upper-triangular T, so its body frame is that of
    `upper_triangular_frame`, not the library's.
    """

    equation: ClassVar[str] = "u = T K' (y - b'')"
    adds_bias = False


class ReciprocalScale(eqx.Module):
    """Reciprocal scale factors with the forward misalignment, the parameters of the hand-derived Jacobian.

    u = (I + M)⁻¹ S' (y − b), S' = diag(reciprocal_scale) = S⁻¹, M of `ScaleMisalignment`. The inverse of I + M is
    exact; what replacing it by I − M costs, `first_order_inverse` shows.

    reciprocal_scale: (..., 3) SI units per output unit. misalignment: (..., 3, 3) dimensionless, zero diagonal.
    bias: (..., 3) output units.
    """

    reciprocal_scale: Vector
    misalignment: Matrix
    bias: Vector
    equation: ClassVar[str] = "u = (I + M)^-1 S' (y - b)"

    @classmethod
    def from_gain(cls, gain: Matrix, bias: Vector) -> "ReciprocalScale":
        """Split K = S'⁻¹(I+M). Raises InputError if a diagonal entry of K is zero."""
        forward = ScaleMisalignment.from_gain(gain, bias)
        return cls(1.0 / jnp.asarray(forward.scale), forward.misalignment, forward.bias)

    def to_gain(self) -> tuple[Matrix, Vector]:
        """Return (K, b)."""
        return ScaleMisalignment(1.0 / jnp.asarray(self.reciprocal_scale), self.misalignment, self.bias).to_gain()


class Kalibr(eqx.Module):
    """Both triads in kalibr's convention (Rehder, Nikolic, Schneider, Hinzmann and Siegwart, ICRA 2016).

    y_a = M_a f + b_a, y_g = M_g C ω + A C f + b_g, with M_a and M_g lower-triangular (positive diagonals) and C a
    rotation, which kalibr applies to the specific force too. Here f and ω are in kalibr's body frame,
    v_kalibr = `body_rotation` v. It is the identity when the accelerometer's gain is lower-triangular already, and is
    kept so that the way back is exact; kalibr's file format has no place for it.

    accel_matrix, gyro_matrix: (..., 3, 3) output units per SI unit. gyro_rotation: (..., 3, 3) C.
    g_sensitivity: (..., 3, 3) A in gyroscope output units per m/s²: zero for the plain model, which has no such term.
    accel_bias, gyro_bias: (..., 3) output units. body_rotation: (..., 3, 3).
    """

    accel_matrix: Matrix
    accel_bias: Vector
    gyro_matrix: Matrix
    gyro_rotation: Matrix
    g_sensitivity: Matrix
    gyro_bias: Vector
    body_rotation: Matrix
    equation: ClassVar[str] = "y_a = M_a f + b_a;  y_g = M_g C w + A C f + b_g"

    @classmethod
    def from_gains(
        cls,
        gain_accel: Matrix,
        bias_accel: Vector,
        gain_gyro: Matrix,
        bias_gyro: Vector,
        g_sensitivity: Matrix | None = None,
    ) -> "Kalibr":
        """Split K_a = M_a Q and K_g Qᵀ = M_g C; a g-sensitivity G, y_g = K_g ω + G f + b_g, gives A = G Qᵀ Cᵀ.

        Raises InputError if a gain is singular or left-handed.
        """
        accel_matrix, gain, rotation = lower_triangular_frame(gain_accel, gain_gyro)
        _refuse_improper(gain_gyro, "gyroscope gain")
        gyro_matrix, gyro_rotation = _lower_times_rotation(gain)
        return cls(
            accel_matrix=accel_matrix,
            accel_bias=jnp.asarray(bias_accel),
            gyro_matrix=gyro_matrix,
            gyro_rotation=gyro_rotation,
            g_sensitivity=(
                jnp.zeros_like(gyro_matrix) if g_sensitivity is None else g_sensitivity @ rotation @ gyro_rotation.mT
            ),
            gyro_bias=jnp.asarray(bias_gyro),
            body_rotation=rotation.mT,
        )

    def to_gains(self) -> tuple[Matrix, Vector, Matrix, Vector]:
        """Return (K_a, b_a, K_g, b_g) in the frame that `from_gains` was given.

        Raises InputError if A is not zero: y = K u + b cannot hold a g-sensitivity; `to_g_sensitivity` returns it.
        """
        if not isinstance(self.g_sensitivity, Tracer) and np.asarray(self.g_sensitivity).any():
            raise InputError("A gain and a bias cannot hold a g-sensitivity (A is not zero): give it as an effect.")
        gain_accel = self.accel_matrix @ self.body_rotation
        gain_gyro = self.gyro_matrix @ self.gyro_rotation @ self.body_rotation
        return gain_accel, self.accel_bias, gain_gyro, self.gyro_bias

    def to_g_sensitivity(self) -> Matrix:
        """Return G = A C Q of y_g = K_g ω + G f + b_g, in the frame that `from_gains` was given."""
        return self.g_sensitivity @ self.gyro_rotation @ self.body_rotation


class FrameChange(NamedTuple):
    """Two gains in a new body frame, and the rotation there: u_old = rotation u_new, K_new = K_old rotation."""

    gain_accel: Matrix
    gain_gyro: Matrix
    rotation: Matrix


def rotate_body_frame(gain_accel: Matrix, gain_gyro: Matrix, rotation: Matrix) -> FrameChange:
    """Express both gains in a new body frame with u_old = rotation u_new: K_a R and K_g R. Biases do not change.

    gain_accel, gain_gyro, rotation: (..., 3, 3). Raises InputError if `rotation` is not a rotation matrix.
    """
    if not isinstance(rotation, Tracer):
        values = np.asarray(rotation)
        departure = np.abs(values @ values.swapaxes(-1, -2) - np.eye(3)).max(initial=0.0)
        if not departure <= _SINGULAR or (np.linalg.det(values) < 0).any():
            raise InputError("The rotation of the body frame must be orthonormal with determinant +1.")
    return FrameChange(jnp.matmul(gain_accel, rotation), jnp.matmul(gain_gyro, rotation), jnp.asarray(rotation))


def lower_triangular_frame(gain_accel: Matrix, gain_gyro: Matrix) -> FrameChange:
    """Move both gains to the body frame in which the accelerometer's is lower-triangular with a positive diagonal.

    That frame, the turntable-free fit's, has X_b along the accelerometer's sensitive X axis (K's first row) and Y_b in
    the plane of its sensitive X and Y axes.
    Raises InputError if the accelerometer's gain is singular or left-handed (no rotation makes that diagonal positive).
    """
    _refuse_improper(gain_accel, "accelerometer gain")
    triangular, rotation = _lower_times_rotation(gain_accel)
    return FrameChange(triangular, gain_gyro @ rotation.mT, rotation.mT)


def upper_triangular_frame(gain_accel: Matrix, gain_gyro: Matrix) -> FrameChange:
    """Move both gains to the body frame in which the accelerometer's is upper-triangular with a positive diagonal.

    It is imu_tk's frame: an upper-triangular T is the inverse of an upper-triangular gain. Z_b lies along the sensitive
    Z axis (K's last row), Y_b in the plane of the sensitive Y and Z axes.
    Raises InputError as `lower_triangular_frame` does.
    """
    _refuse_improper(gain_accel, "accelerometer gain")
    triangular, rotation = _lower_times_rotation(jnp.flip(jnp.asarray(gain_accel), (-2, -1)))
    back = jnp.flip(rotation, (-2, -1)).mT
    return FrameChange(jnp.flip(triangular, (-2, -1)), gain_gyro @ back, back)


def first_order_inverse(gain: Matrix) -> Matrix:
    """Return (I − M) S⁻¹, the *approximate* inverse of K = S(I+M) that hand derivations use; wrong by (I+M)⁻¹ M² S⁻¹.

    It exists to show the size of that error (misalignments of 0.02 rad: some 4e-4) and to cross-check a hand-derived
    Jacobian. Nothing else in the library uses it: corrections use the exact inverse.

    gain: (..., 3, 3) output units per SI unit. Returns (..., 3, 3) SI units per output unit.
    Raises InputError if a diagonal entry of K is zero.
    """
    _refuse_zero_diagonal(gain, "gain")
    scale = _diagonal(gain)
    identity = jnp.eye(3, dtype=scale.dtype)
    return (identity - _off_diagonal(gain) / scale[..., :, None]) / scale[..., None, :]


def _lower_times_rotation(gain: Matrix) -> tuple[Matrix, Matrix]:
    """Factor K = L Q, L lower-triangular with a positive diagonal, Q orthogonal."""
    orthogonal, upper = jnp.linalg.qr(jnp.asarray(gain).mT)
    sign = jnp.where(_diagonal(upper) < 0, -1.0, 1.0)
    return jnp.tril((upper * sign[..., :, None]).mT), (orthogonal * sign[..., None, :]).mT


def _diagonal(matrix: Matrix) -> Vector:
    return jnp.diagonal(jnp.asarray(matrix), axis1=-2, axis2=-1)


def _off_diagonal(matrix: Matrix) -> Matrix:
    return jnp.where(jnp.eye(3, dtype=bool), 0.0, jnp.asarray(matrix))


def _diag(vector: Vector) -> Matrix:
    vector = jnp.asarray(vector)
    return vector[..., :, None] * jnp.eye(3, dtype=vector.dtype)


def _refuse(matrix: Matrix, wrong: Callable[[np.ndarray], np.ndarray], message: str) -> None:
    """Raise InputError where the matrix is wrong, its rows scaled to unit length (zero rows stay); not in a trace."""
    if isinstance(matrix, Tracer):
        return
    values = np.asarray(matrix, float)
    if not np.isfinite(values).all():
        raise InputError("A gain or bias in another convention must be finite, but it holds inf or NaN.")
    norm = np.linalg.norm(values, axis=-1, keepdims=True)
    if np.any(wrong(values / np.where(norm > 0, norm, 1.0))):
        raise InputError(message)


def _refuse_singular(matrix: Matrix, name: str) -> None:
    _refuse(
        matrix,
        lambda rows: np.linalg.svd(rows, compute_uv=False)[..., -1] < _SINGULAR,
        f"The {name} is singular: its three axes do not span space, so it cannot be inverted.",
    )


def _refuse_zero_diagonal(matrix: Matrix, name: str) -> None:
    _refuse(
        matrix,
        lambda rows: np.abs(np.diagonal(rows, axis1=-2, axis2=-1)) < _SINGULAR,
        f"The {name} has a zero on its diagonal: are the sensor's axes permuted? Map them first.",
    )


def _refuse_improper(matrix: Matrix, name: str) -> None:
    _refuse_singular(matrix, name)
    _refuse(
        matrix,
        lambda rows: np.linalg.det(rows) < 0,
        f"The {name} is left-handed (negative determinant): flip or map an axis first.",
    )
