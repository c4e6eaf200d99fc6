"""The Fisher information that a design of poses and turns holds about a unit, a differentiable function of the design.

Measured are outputs y, each with a covariance C. What a unit with parameters θ would put out follows from the forward
model, `Imu.respond`, so any effect whose stimulus a pose or a turn tells can be among the parameters. On a table the
motion is known and the information is JᵀC⁻¹J with J = ∂y/∂θ. In the hand it is not: there the conditions c(θ₀, y) of
`jaximu.data.poses` hold instead, whatever the motion was. They vanish along y(θ) for θ₀ = θ, so ∂c/∂θ₀ = −∂c/∂y ∂y/∂θ,
and the conditions' covariance (`jaximu.data.poses_covariance`) takes the place of C. On a robot the conditions are
those of `jaximu.data.attitude`, against the attitude it reports. Nothing of the physics is written here.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from jaxtyping import Float

from jaximu.data.attitude import INTERVALS, WINDOW, Intervals, evaluated, shared_ends
from jaximu.data.poses import condense
from jaximu.data.poses_covariance import condition_covariance
from jaximu.estimation.problem import Name, Parameters
from jaximu.ground.array_types import Array, FloatArray
from jaximu.ground.gravity import LocalGravity
from jaximu.ground.rotation import IDENTITY, UP, conjugate, exponential, logarithm, multiply, rotation_matrix
from jaximu.ground.stored import compiled
from jaximu.ground.vectors import root_or_zero
from jaximu.model.mounting import Mounting
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.observations import Observations, Poses, Turns
from jaximu.simulation.protocols.motion import smooth_course

STIMULI = ("specific_force", "angular_rate", "attitude")
"""What a design tells of the stimulus: effects that need no more can be among the parameters."""
SAMPLES = 12
"""Equal parts that a turn is followed in; for a linear model any number gives the same information."""
RAMP = 0.2
"""Share of a robot's turn in which its rate rises, and again falls."""
COARSE = 32
"""Intervals that a robot's motion is cut into while a design is sought."""
_SPLIT, _BESIDE = 2, 1
"""Samples to an interval of a robot's motion, and samples on either side of it that its conditions look at."""
_FREE = 1e3
"""Typical sizes within which the mounting on a robot is known beforehand: as good as not at all."""


class Accuracy(eqx.Module):
    """How well one rest and one turn are measured, in output units.

    excess: variance beyond the noise, in multiples of it, of mean accelerometer outputs, turns, mean gyroscope outputs
    (see `jaximu.data.poses_covariance`). turn: duration of a turn (s). rest: of a rest (s); attitude: of a robot's
    reported attitude, one sigma of each axis (rad).
    """

    accelerometer: Float[Array, "3 3"]  # covariance of the mean output over a rest
    gyroscope: Float[Array, "3 3"]
    density: Float[Array, "3 3"]  # of the gyroscope's noise, two-sided, output unit² · s
    excess: Float[Array, " 3"]
    turn: Float[Array, ""]
    rest: Float[Array, ""] | float = 1.0
    attitude: Float[Array, ""] | float = 0.0


class Design(eqx.Module):
    """P attitudes at rest (body to level frame, z up), and M turns of a table.

    A turn of a table goes about the vertical at a constant `rate` (rad/s) from the attitude `axis`, so that its axis is
    the body's upward direction there. In the hand and on a robot there are none of these: turn k leads from attitude k
    to the next.
    """

    attitude: Float[Array, "P 4"]
    axis: Float[Array, "M 4"]
    rate: Float[Array, " M"]


def up_vectors(attitude: Float[Array, "... 4"]) -> Float[Array, "... 3"]:
    """Return the body's upward direction in attitudes (body to level frame)."""
    return rotation_matrix(attitude)[..., 2, :]


@compiled
def turn_vectors(attitude: Float[Array, "P 4"]) -> Float[Array, "P-1 3"]:
    """Return the body rotation vectors (rad) from each attitude to the next.

    Neighbouring quaternions of one sign turn by less than 180°, of opposite signs the longer way, so that the vector
    moves smoothly with the attitudes through 180°.
    """
    step = multiply(conjugate(attitude[:-1]), attitude[1:])
    half = step + IDENTITY
    return 2 * logarithm(half / jnp.sqrt(jnp.sum(half**2, axis=-1, keepdims=True)))


def _plain(imu: Imu) -> Imu:
    """The unit without effects; with a perfect gyroscope where there is none, which no condition then looks at."""
    gyroscope = Imu.nominal().gyroscope if imu.gyroscope is None else imu.gyroscope
    assert gyroscope is not None
    return Imu(replace(imu.accelerometer, effects=()), replace(gyroscope, effects=()))


def _observed(imu: Imu, attitude, accuracy: Accuracy, gravity) -> Observations:
    """What a unit would put out, without noise, held in attitudes and turned from each to the next."""
    count = len(attitude)
    vectors = turn_vectors(attitude)
    steps = len(vectors), SAMPLES
    middle = (jnp.arange(SAMPLES) + 0.5) / SAMPLES
    during = multiply(
        jnp.broadcast_to(attitude[:-1, None], (*steps, 4)), exponential(middle[:, None] * vectors[:, None])
    )
    at_rest = Stimulus(gravity * up_vectors(attitude), jnp.zeros((count, 3)), attitude=attitude)
    rates = jnp.broadcast_to(vectors[:, None] / accuracy.turn, (*steps, 3))
    moving = Stimulus(gravity * up_vectors(during), rates, attitude=during)
    accelerometer, gyroscope = imu.respond(at_rest)
    _, turning = imu.respond(moving)

    def same(covariance):
        return jnp.broadcast_to(covariance, (count, 3, 3))

    constant = jnp.zeros(count)
    poses = Poses(
        accelerometer,
        same(accuracy.accelerometer),
        jnp.zeros((count, 3)) if gyroscope is None else gyroscope,
        same(accuracy.gyroscope),
        constant,
        constant,
        constant,
        jnp.ones(count, bool),
    )
    turns = Turns(
        jnp.zeros((*steps, 3)) if turning is None else turning,
        jnp.full(steps, 1.0) * accuracy.turn / SAMPLES,
        accuracy.density,
        rotation_matrix(attitude)[1:, :2],  # two body directions that are level in the later pose
        jnp.ones(len(vectors), bool),
    )
    return Observations(poses, turns, jnp.asarray(gravity))


def _information(covariance, jacobian):
    """JᵀC⁻¹J (p, p), summed over leading axes."""
    whitened = solve_triangular(jnp.linalg.cholesky(covariance), jacobian, lower=True).reshape(-1, jacobian.shape[-1])
    return whitened.T @ whitened


def root_of(covariance: FloatArray) -> FloatArray:
    """Return a root R (..., n, n), R Rᵀ = C, of covariances or of information; what rounding makes negative is zero."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors * root_or_zero(values)[..., None, :]


def gravity_sensitivity(imu: Imu, names: Sequence[Name], gravity: LocalGravity) -> FloatArray:
    """Return what one sigma of gravity does to parameters (p,): the accelerometer's gain is in proportion to 1/g."""
    gain = np.asarray(imu.accelerometer.gain) * gravity.sigma / gravity.value
    return np.array([-gain[name.axes] if name.startswith("accelerometer.gain") else 0.0 for name in names])


def hand_held_information(
    imu: Imu, parameters: Parameters, design: Design, accuracy: Accuracy, gravity: Float[Array, ""]
) -> Float[Array, "p p"]:
    """Return the information about parameters in typical sizes, from attitudes held and turned between by hand.

    **Arguments:**

    - `imu`: the unit, with any effects dormant; `parameters` says which of its numbers are free, and their sizes.
    - `design`: at least two attitudes; what it says of a table is not looked at.
    - `gravity`: m/s².
    """
    unit = _plain(imu)
    conditions = design.attitude.shape[0] if imu.gyroscope is None else None  # then only the norms

    def found(z):
        observed = _observed(parameters.model(imu, z), design.attitude, accuracy, gravity)
        return condense(unit, observed)[0](unit)[:conditions]

    jacobian = jax.jacfwd(found)(jnp.zeros(len(parameters.names)))
    observed = _observed(unit, design.attitude, accuracy, gravity)
    covariance = condition_covariance(unit, observed).dense().total(accuracy.excess)[:conditions, :conditions]
    return _information(covariance, jacobian)


def table_information(
    imu: Imu, parameters: Parameters, design: Design, accuracy: Accuracy, gravity: Float[Array, ""]
) -> Float[Array, "p p"]:
    """Return the information about parameters in typical sizes, from known poses and turns of a table.

    A pose gives the mean outputs of both triads, a turn the gyroscope's mean output; arguments as in
    [`hand_held_information`]. The table itself is taken as perfect.
    """
    turns = len(design.rate), SAMPLES
    course = design.rate[:, None] * accuracy.turn * (jnp.arange(SAMPLES) + 0.5) / SAMPLES
    during = multiply(exponential(course[..., None] * UP), jnp.broadcast_to(design.axis[:, None], (*turns, 4)))
    up = up_vectors(design.attitude)
    axis = jnp.broadcast_to(up_vectors(design.axis)[:, None], (*turns, 3))
    at_rest = Stimulus(gravity * up, jnp.zeros_like(up), attitude=design.attitude)
    moving = Stimulus(gravity * axis, design.rate[:, None, None] * axis, attitude=during)

    def outputs(z):
        unit = parameters.model(imu, z)
        means = unit.respond(at_rest)
        return means if unit.gyroscope is None else (*means, jnp.mean(unit.respond(moving)[1], axis=1))  # pyright: ignore[reportArgumentType]

    covariances = (
        (1 + accuracy.excess[0]) * accuracy.accelerometer,
        (1 + accuracy.excess[2]) * accuracy.gyroscope,
        accuracy.density / accuracy.turn + accuracy.excess[2] * accuracy.gyroscope,
    )
    zero = jnp.zeros(len(parameters.names))
    information = jnp.zeros((len(zero), len(zero)))
    for jacobian, covariance in zip(jax.jacfwd(outputs)(zero), covariances, strict=False):
        if jacobian is not None:
            information += _information(jnp.broadcast_to(covariance, (len(jacobian), 3, 3)), jacobian)
    return information


def _course(design: Design, accuracy: Accuracy) -> tuple[Callable[[Array], Array], Array]:
    """Return attitudes (..., 4) of a robot's motion, rests and turns in between, by time; and how long it takes (s)."""
    vectors = turn_vectors(design.attitude)
    count, rest, turn = len(design.attitude), accuracy.rest, accuracy.turn
    still = jnp.concatenate([vectors, jnp.zeros((1, 3))])

    def at(time):
        leg = jnp.clip(jnp.floor(time / (rest + turn)).astype(int), 0, count - 1)
        done = smooth_course(jnp.clip((time - leg * (rest + turn) - rest) / turn, 0.0, 1.0), RAMP)
        return multiply(design.attitude[leg], exponential(done[..., None] * still[leg]))

    return at, count * rest + (count - 1) * turn


def _reported(imu: Imu, design: Design, accuracy: Accuracy, gravity, count: int) -> Intervals:
    """What a unit would put out on a robot, without noise, and the attitude the robot reports `count` + 1 times."""
    at, whole = _course(design, accuracy)
    samples = _SPLIT * count + 1
    step = whole / samples
    edges = step * jnp.arange(samples + 1)
    stood = at(edges)
    middle = at(edges[:-1] + step / 2)
    rate = logarithm(multiply(conjugate(stood[:-1]), stood[1:])) / step
    force, turning = imu.respond(Stimulus(gravity * up_vectors(middle), rate, attitude=middle))
    assert turning is not None
    slope = jnp.gradient(turning, axis=0) / step
    stamp = edges[:-1:_SPLIT] + step / 2
    return Intervals(
        turning,
        slope,
        jnp.gradient(slope, axis=0) / step,
        force,
        edges[:-1],
        edges[1:],
        stamp,
        at(stamp),
        jnp.zeros((count, 3)),
        jnp.ones(count, bool),
        jnp.asarray(gravity),
    )


def robot_information(
    imu: Imu,
    parameters: Parameters,
    design: Design,
    accuracy: Accuracy,
    gravity: Float[Array, ""],
    count: int = INTERVALS,
    duration: float = 60.0,
) -> Float[Array, "p p"]:
    """Return the information about parameters in typical sizes, from a robot's rests and the turns between them.

    The attitude is reported throughout, with white errors from stamp to stamp; how the unit is mounted on the robot,
    how late and smoothed its report is, and how its vertical is tilted are unknown besides. Conditions and their
    covariance are those of a calibration against a measured attitude.

    **Arguments:**

    - `imu`, `parameters`, `gravity` as for [`hand_held_information`]; `design`: at least two attitudes.
    - `count`: intervals that the motion is cut into. `duration`: s, of the motion, by which windows are chosen.
    """
    unit = _plain(imu)
    group = max(1, round(WINDOW * count / duration))
    count = count // group * group  # of whole windows
    samples = jnp.clip(
        _SPLIT * jnp.arange(count)[:, None] + jnp.arange(-_BESIDE, _SPLIT + 1 + _BESIDE), 0, _SPLIT * count
    )
    effects = Mounting.effects(rotation=0.0, delay=0.0, tilt=0.0, filter_variance=0.0, clock_scale=0.0)
    sizes, effects_of = ravel_pytree([effect.typical_sizes(1.0) for effect in effects])
    known = len(parameters.names)

    def found(z):
        reported = _reported(parameters.model(imu, z[:known]), design, accuracy, gravity, count)
        mounting = Mounting.of(unit.with_effects(*effects_of(sizes * z[known:])))
        conditions, spread, length, leaning, _ = evaluated(unit, mounting, reported, samples, accuracy.density, group)
        return conditions(unit), (spread, length, leaning, conditions.target)

    size = known + len(sizes)
    jacobian, (spread, length, leaning, target) = jax.jacfwd(found, has_aux=True)(jnp.zeros(size))
    rotation, force = jnp.split(jnp.arange(len(jacobian)).reshape(-1, 3), [count])
    ends = shared_ends(rotation_matrix(target).swapaxes(1, 2), leaning, count // group)
    inverse = unit.accelerometer.inverse()[:, :3]
    density = (1 + accuracy.excess[0]) * jnp.trace(inverse @ accuracy.accelerometer @ inverse.T) / 3 * accuracy.rest
    felt = (density / length.reshape(-1, group).sum(axis=1))[:, None, None] * jnp.eye(3)
    noise = accuracy.attitude**2 * ends.component(len(jacobian))
    for rows, white in ((rotation, (1 + accuracy.excess[1]) * spread), (force, felt)):
        noise = noise.at[rows[:, :, None], rows[:, None, :]].add(white)
    whole = _information(noise, jacobian)
    beside = whole[known:, known:] + jnp.eye(size - known) / _FREE**2
    return whole[:known, :known] - whole[:known, known:] @ jnp.linalg.solve(beside, whole[known:, :known])
