"""Solutions without iteration of the linear turntable model y = K u + b (S8, S9), for one unit or any batch of units.

They agree with each other and with Levenberg–Marquardt to rounding on exact data; on noisy data they are what least
squares with equal weights gives. All take leading batch axes and may be jitted.
"""

import jax.numpy as jnp
from jaxtyping import ArrayLike, Float

from jaximu.ground.array_types import Array
from jaximu.ground.rotation import Matrix, Vector, Vectors

Number = Float[ArrayLike, "..."]


def six_position(up: Matrix, down: Matrix, gravity: Number) -> tuple[Matrix, Vector]:
    """Return the accelerometer's gain and bias from each axis up and down (S8a).

    K_:i = (y_up,i − y_down,i) / (2 g), b the mean of the three (y_up,i + y_down,i) / 2.

    **Arguments:** `up`, `down`: mean outputs, row i with axis i up (down); `gravity`: m/s².
    """
    gain = (up - down).mT / (2 * jnp.asarray(gravity)[..., None, None])
    return gain, jnp.mean(up + down, axis=-2) / 2


def turn_pairs(
    anticlockwise: Matrix,
    clockwise: Matrix,
    angle: Number,
    durations: Float[Array, "... 3 2"] | None = None,
    bias: Vector | None = None,
) -> Matrix:
    """Return the gyroscope's gain from a turn each way about each axis (S9): K_:i = (Θ⁺ − Θ⁻) / (2 θ).

    **Arguments:**

    - `anticlockwise`, `clockwise`: output integrated over the turn (output unit · s), row i about axis i.
    - `angle`: rad, of every turn, positive.
    - `durations`, `bias`: s, of both turns of each axis, and the output at rest; left out where both last equally long,
      because then the bias cancels.
    """
    difference = anticlockwise - clockwise
    if durations is not None and bias is not None:
        difference = difference - (durations[..., 0] - durations[..., 1])[..., None] * bias[..., None, :]
    return difference.mT / (2 * jnp.asarray(angle)[..., None, None])


def linear_least_squares(
    inputs: Vectors, outputs: Vectors, weights: Float[Array, "... S"] | None = None
) -> tuple[Matrix, Vector]:
    """Return gain and bias of a triad, twelve numbers, from known inputs by QR (S8b): Y = (U 1) (K b)ᵀ.

    The factorisation is Gram and Schmidt's in the modified form, carried on through the right-hand sides, which makes
    it as stable as Householder's (Björck, Numerical Methods for Least Squares Problems, 1996, sec. 2.4); four columns
    written out take a third of the time of batched LAPACK calls. Not finite where the inputs do not determine them.

    **Arguments:** `inputs`: mean specific force or angular rate at S stations, SI; `outputs`: mean outputs; `weights`:
    one over each station's standard deviation, equal if left out.
    """
    columns = [inputs[..., axis] for axis in range(3)] + [jnp.ones_like(inputs[..., 0])]
    columns += [outputs[..., axis] for axis in range(3)]
    if weights is not None:
        columns = [weights * column for column in columns]
    upper: list[list[Array]] = []
    for pivot in range(4):
        length = jnp.sqrt(jnp.sum(columns[pivot] ** 2, axis=-1))
        unit = columns[pivot] / length[..., None]
        row = [jnp.sum(unit * column, axis=-1) for column in columns[pivot + 1 :]]
        columns = columns[: pivot + 1] + [
            column - unit * along[..., None] for column, along in zip(columns[pivot + 1 :], row, strict=True)
        ]
        upper.append([length, *row])
    solution: list[list[Array]] = []
    for pivot in reversed(range(4)):
        diagonal, *rest = upper[pivot]
        others, right = rest[: 3 - pivot], rest[3 - pivot :]
        known = [
            sum((a * x[axis] for a, x in zip(others, solution, strict=True)), start=jnp.zeros_like(diagonal))
            for axis in range(3)
        ]
        solution.insert(0, [(y - taken) / diagonal for y, taken in zip(right, known, strict=True)])
    gain = jnp.stack([jnp.stack(column, axis=-1) for column in solution[:3]], axis=-1)
    return gain, jnp.stack(solution[3], axis=-1)


def ferraris(
    up: Matrix,
    down: Matrix,
    rest_up: Matrix,
    rest_down: Matrix,
    turned: Matrix,
    turned_force: Matrix,
    durations: Vector,
    angles: Vector,
    gravity: Number,
    rest: Vector | None = None,
) -> dict[str, Float[Array, "..."]]:
    """Return gains and biases by the procedure of Ferraris, Grimaldi and Parvis (Sensors and Materials 7, 1995).

    The accelerometer's bias of axis i comes from the pair of axis i alone; the gyroscope's sensitivity to force,
    `cross`, from its output up and down, and it is taken off the turns.

    **Arguments:**

    - `up`, `down`: mean accelerometer output, row i with axis i up (down); `rest_up`, `rest_down`: the gyroscope's.
    - `turned`: gyroscope output integrated over the turn about axis i; `turned_force`: the accelerometer's; `durations`
      (s) and `angles` (rad) of the turns.
    - `gravity`: m/s². `rest`: the gyroscope's bias, its mean output over all samples at rest (as imucal takes it); the
      mean of `rest_up` and `rest_down` if left out.

    **Returns:** `accelerometer_gain`, `accelerometer_bias`, `gyroscope_gain`, `gyroscope_bias`, and `cross` (3, 3), the
    gyroscope's output per m/s².
    """
    twice = 2 * jnp.asarray(gravity)[..., None, None]
    gain, bias = (up - down).mT / twice, jnp.diagonal(up + down, axis1=-2, axis2=-1) / 2
    cross = (rest_up - rest_down).mT / twice
    still = jnp.mean(rest_up + rest_down, axis=-2) / 2 if rest is None else rest
    moved = turned_force.mT - bias[..., :, None] * durations[..., None, :]
    force = jnp.linalg.solve(gain, moved)  # integrated, m/s
    turning = turned.mT - cross @ force - still[..., :, None] * durations[..., None, :]
    return {
        "accelerometer_gain": gain,
        "accelerometer_bias": bias,
        "gyroscope_gain": turning / angles[..., None, :],
        "gyroscope_bias": still,
        "cross": cross,
    }


def remove_curvature(inputs: Vectors, outputs: Vectors, order: int = 2) -> tuple[Vectors, Float[Array, "... 3 C"]]:
    """Return outputs without the curvature of each axis in its own input, and the coefficients of u², u³ … (S7).

    "Linearise first": each axis's output is fitted by a polynomial in its own input alone, and all above the straight
    line is taken off; a linear fit follows. Where stations come in opposite pairs (six, twelve, twenty-four positions)
    the other axes' inputs are orthogonal to an axis's own powers, and gain and bias come out as those of a joint fit.
    In other poses misalignment is taken for curvature: fit jointly there (`fit_turntable` with `accel.quadratic`,
    `accel.cubic` … free), which also gives intervals. Not finite where an axis's inputs are all of one size (eight
    positions): there nothing tells curvature from bias.

    **Arguments:** `inputs`: mean inputs of the stations, SI; `outputs`: mean outputs; `order`: 2 or 3.
    """
    scale = jnp.max(abs(inputs), axis=-2, keepdims=True)
    powers = jnp.stack([(inputs / scale) ** power for power in range(order + 1)], axis=-1)  # (..., S, 3, order + 1)
    basis, upper = jnp.linalg.qr(jnp.swapaxes(powers, -3, -2))
    right = jnp.sum(basis * outputs.mT[..., None], axis=-2)
    curved = jnp.linalg.solve(upper, right[..., None])[..., 0][..., 2:]
    curvature = jnp.sum(powers[..., 2:] * curved[..., None, :, :], axis=-1)
    return outputs - curvature, curved / scale[..., 0, :, None] ** jnp.arange(2, order + 1)
