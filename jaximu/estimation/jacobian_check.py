"""Hand-derived Jacobians against automatic differentiation: two worked derivations, and a check for your own.

The derivations are those of the turntable-free method (Tedaldi, Pretto and Menegatti, ICRA 2014): the gravity norm of
the accelerometer, and the gravity direction carried by the gyroscope. They are written as on paper, matrices and plain
recursion, and share no code with the library's own derivatives.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaximu.ground.rotation import conjugate, rotate, running_rotations
from jaximu.model.conventions import first_order_inverse

GRAVITY_NORM_NAMES = ("M_yx", "M_zx", "M_zy", "S'_x", "S'_y", "S'_z", "b_x", "b_y", "b_z")
GRAVITY_DIRECTION_NAMES = (*(f"C_{row}{column}" for row in "xyz" for column in "xyz"), "b_x", "b_y", "b_z")


@dataclass(frozen=True)
class JacobianCheck:
    """How a hand-derived Jacobian compares with automatic differentiation.

    ok: the largest relative difference is within `rtol`. worst_absolute: largest difference of two entries.
    worst_relative: largest difference over the largest entry of its column. row, name: where the latter is.
    table: for each parameter its name, largest absolute and largest relative difference.
    """

    ok: bool
    worst_absolute: float
    worst_relative: float
    row: int
    name: str
    table: tuple[tuple[str, float, float], ...]
    rtol: float

    def __str__(self) -> str:
        verdict = "agree" if self.ok else "DISAGREE"
        where = "" if self.ok else f"in row {self.row}, parameter {self.name} "  # of rounding errors it means nothing
        head = (
            f"Hand-derived and automatic Jacobian {verdict}: largest relative difference {self.worst_relative:.1e} "
            f"{where}(allowed {self.rtol:.0e}); "
            f"largest absolute difference {self.worst_absolute:.1e}."
        )
        width = max(9, *(len(name) for name, _, _ in self.table))
        lines = [head, f"{'parameter':<{width}}  absolute  relative"]
        for name, absolute, relative in self.table:
            mark = "" if relative <= self.rtol else "  <"  # not "> rtol": a NaN is marked too
            lines.append(f"{name:<{width}}  {absolute:8.1e}  {relative:8.1e}{mark}")
        return "\n".join(lines)


def check_jacobian(
    residual: Callable[[Array], Array],
    hand_jacobian: Callable[[Array], ArrayLike],
    x: Float[ArrayLike, " p"],
    names: tuple[str, ...] | list[str] | None = None,
    rtol: float = 1e-10,
) -> JacobianCheck:
    """Compare a hand-derived Jacobian with automatic differentiation at `x`.

    **Arguments:**

    - `residual`: function of the parameter vector (p,) to residuals (n,), written in JAX.
    - `hand_jacobian`: function of the same vector to the Jacobian (n, p) derived by hand.
    - `names`: of the parameters; numbers if left out.
    - `rtol`: largest difference allowed, as a share of the largest entry of the column (one parameter's effects have
      one unit; entries that are zero by cancellation would make a share of themselves meaningless).
    """
    x = jnp.asarray(x)
    names = tuple(f"x[{k}]" for k in range(len(x))) if names is None else tuple(names)
    automatic = np.asarray(jax.jit(jax.jacfwd(residual))(x))
    hand = np.asarray(hand_jacobian(x))
    if automatic.ndim != 2 or not automatic.size:
        raise ValueError(f"the residual must be a vector that is not empty; its Jacobian has shape {automatic.shape}")
    if hand.shape != automatic.shape:
        raise ValueError(f"the hand-derived Jacobian has shape {hand.shape}, the residual needs {automatic.shape}")
    if len(names) != len(x):
        raise ValueError(f"{len(names)} names for {len(x)} parameters")
    absolute = np.abs(hand - automatic)
    absolute = np.where(np.isnan(absolute), np.inf, absolute)
    largest = np.maximum(np.abs(automatic), np.abs(hand)).max(axis=0)
    with np.errstate(invalid="ignore"):  # inf / inf: an entry that is not finite
        relative = np.where(absolute > 0, absolute / np.where(largest > 0, largest, 1.0), 0.0)
    relative = np.where(np.isnan(relative), np.inf, relative)
    row, column = np.unravel_index(np.argmax(relative), relative.shape)
    table = tuple(
        (name, float(a), float(r)) for name, a, r in zip(names, absolute.max(axis=0), relative.max(axis=0), strict=True)
    )
    worst = float(relative[row, column])
    return JacobianCheck(worst <= rtol, float(absolute.max()), worst, int(row), names[column], table, rtol)


def _unpack(theta):
    myx, mzx, mzy = theta[:3]
    return jnp.array([[1.0, 0.0, 0.0], [-myx, 1.0, 0.0], [-mzx, -mzy, 1.0]]), theta[3:6], theta[6:9]


def gravity_norm_hand(
    theta: Float[Array, "9"], outputs: Float[Array, "P 3"], gravity: Float[ArrayLike, ""]
) -> Float[Array, " P"]:
    """Return r = g0² − |f̂|² of each pose's mean output, f̂ = (I − M) S' (y − b), in (m/s²)².

    θ is `GRAVITY_NORM_NAMES`: M strictly lower triangular, S' the reciprocal scales. I − M is the paper's stand-in for
    (I + M)⁻¹; `first_order_inverse_error` tells what it costs.
    """
    inverse, scale, bias = _unpack(theta)
    force = (scale * (outputs - bias)) @ inverse.T
    return jnp.asarray(gravity) ** 2 - jnp.sum(force**2, axis=-1)


def hand_jacobian_gravity_norm(
    theta: Float[Array, "9"], outputs: Float[Array, "P 3"], gravity: Float[ArrayLike, ""]
) -> Float[Array, "P 9"]:
    """Return ∂r/∂θ of `gravity_norm_hand`, derived by hand.

    With d = y − b and e_i the unit vectors, ∂r/∂f̂ = −2 f̂ᵀ and

        ∂f̂/∂M_ij = −e_i S'_j d_j,   ∂f̂/∂S'_i = (I − M) e_i d_i,   ∂f̂/∂b_i = −(I − M) e_i S'_i.

    (The derivation that circulates has S_z in its last block where S'_z is meant.) Gravity does not appear.
    """
    del gravity
    inverse, scale, bias = _unpack(theta)
    centred = outputs - bias
    force = (scale * centred) @ inverse.T
    columns = [-2 * force[:, i] * (-scale[j] * centred[:, j]) for i, j in ((1, 0), (2, 0), (2, 1))]
    columns += [-2 * (force @ inverse[:, i]) * centred[:, i] for i in range(3)]
    columns += [-2 * (force @ inverse[:, i]) * -scale[i] for i in range(3)]
    return jnp.stack(columns, axis=-1)


def gravity_direction_hand(
    theta: Float[Array, "12"],
    outputs: Float[Array, "T S 3"],
    intervals: Float[Array, "T S"],
    before: Float[Array, "T 3"],
    after: Float[Array, "T 3"],
) -> Float[Array, " 3*T"]:
    """Return r = u_{k+1} − R(b_{k+1} ← b_k) u_k of each turn, three components after another.

    θ is `GRAVITY_DIRECTION_NAMES`: the inverse gain C = K⁻¹, row by row, and the bias; ω = C (y − b).
    `before` and `after` are the unit vectors u of gravity at a turn's ends, `outputs` its samples, each held over its
    interval (s), without coning. The product is the library's own, so its derivative is checked along.
    """
    rates = (outputs - theta[9:]) @ theta[:9].reshape(3, 3).T
    turned = running_rotations(rates * intervals[..., None])[..., -1, :]
    return (after - rotate(conjugate(turned), before)).reshape(-1)


def _skew(v):
    return jnp.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def hand_jacobian_gravity_direction(
    theta: Float[Array, "12"],
    outputs: Float[Array, "T S 3"],
    intervals: Float[Array, "T S"],
    before: Float[Array, "T 3"],
    after: Float[Array, "T 3"],
) -> Float[Array, "3*T 12"]:
    """Return ∂r/∂θ of `gravity_direction_hand` by the error-state recursion of strapdown navigation.

    Write the attitude after k samples, from the body to the first frame, as P_k, and its error as a rotation φ_k of the
    body: P_k exp(φ_k). One sample turns by θ_k = ω_k Δt_k, and exp(θ + δθ) = exp(θ) exp(J_r(θ) δθ), so

        P_{k+1} = P_k exp(θ_k),
        φ_{k+1} = exp(θ_k)ᵀ φ_k + J_r(θ_k) Δt_k δω_k,    φ_0 = 0,    δω_k = δC (y_k − b) − C δb.

    At the end r = u_{k+1} − Pᵀ u_k, and (P exp(φ))ᵀ u = Pᵀ u − φ × Pᵀ u, so δr = φ × Pᵀ u_k = −(Pᵀ u_k) × φ.
    φ is carried for all twelve parameters at once, as a matrix (3, 12).
    """
    del after
    inverse, bias = theta[:9].reshape(3, 3), theta[9:]

    def advance(state, sample):
        attitude, error = state
        output, interval = sample
        turned = inverse @ (output - bias) * interval
        angle = jnp.linalg.norm(turned)
        # Over one where nothing turned (padding, a sensor at rest): there [θ]× is zero, whatever its factor.
        safe = jnp.where(angle > 0, angle, 1.0)
        axis = _skew(turned / safe)
        versine = 2 * jnp.sin(angle / 2) ** 2  # 1 − cos θ without its cancellation
        rotation = jnp.eye(3) + jnp.sin(angle) * axis + versine * axis @ axis
        right = jnp.eye(3) - versine / safe * axis + (1 - jnp.sin(angle) / safe) * axis @ axis
        # δω = δC (y − b) − C δb: row i of C acts on component i alone
        by_gain = jnp.kron(jnp.eye(3), output - bias)
        rate_change = jnp.concatenate([by_gain, -inverse], axis=1)
        return (attitude @ rotation, rotation.T @ error + right @ rate_change * interval), None

    def one_turn(outputs, intervals, before):
        start = (jnp.eye(3), jnp.zeros((3, 12)))
        (attitude, error), _ = jax.lax.scan(advance, start, (outputs, intervals))
        return -_skew(attitude.T @ before) @ error

    return jax.vmap(one_turn)(outputs, intervals, before).reshape(-1, 12)


def first_order_inverse_error(gain: Float[ArrayLike, "3 3"], magnitude: float) -> float:
    """Return the largest error, over all directions of an input of `magnitude`, when I − M replaces (I + M)⁻¹.

    With K = S(I + M) the approximate correction (I − M) S⁻¹ K u = u − M² u is wrong by M² u, at most the spectral norm
    of M² times the magnitude; the error has the magnitude's unit (m/s², rad/s). All six misalignments drawn evenly from
    ±0.01 cost on average 89 µg at 1 g and 0.018 °/s at 200 °/s, ±0.05 25 times that: several times the noise of a
    calibration's means, so the library inverts exactly.
    """
    gain = jnp.asarray(gain)
    return float(np.linalg.norm(np.asarray(first_order_inverse(gain) @ gain) - np.eye(3), 2) * magnitude)
