"""What segmentation distils from a recording: fixed-shape arrays with masks and covariances, plain PyTrees.

Shapes: P poses and P − 1 turns, turn k leading from pose k to pose k + 1, S samples a turn; or, with equipment, S
stations of Q nodes. All are padded to buckets so that recordings of other lengths reuse compiled code; masks tell what
is real. Outputs stay in the triads' output units, as the logger wrote them.
"""

import equinox as eqx
from jaxtyping import Bool, Float, Int

from jaximu.ground.array_types import Array
from jaximu.model.stimulus import Stimulus

POWER_ON = {"gyroscope": 0.05, "accelerometer": 0.05}
"""What a bias may differ by from one power-on to the next (one sigma), rad/s and m/s²: as good as free."""


class Poses(eqx.Module):
    """Intervals at rest: mean outputs, the covariance of these means, and when and how warm they were."""

    accelerometer_mean: Float[Array, "P 3"]
    accelerometer_covariance: Float[Array, "P 3 3"]
    gyroscope_mean: Float[Array, "P 3"]
    gyroscope_covariance: Float[Array, "P 3 3"]
    start: Float[Array, " P"]  # s, on the recording's clock
    stop: Float[Array, " P"]
    temperature: Float[Array, " P"]  # °C; the reference temperature where none was recorded
    mask: Bool[Array, " P"]


class Turns(eqx.Module):
    """Gyroscope output between neighbouring poses; sample k holds over `interval[k]` seconds, zero for padding."""

    output: Float[Array, "T S 3"]
    interval: Float[Array, "T S"]
    noise: Float[Array, "3 3"]  # power spectral density of the gyroscope's output noise, two-sided, output unit² · s
    basis: Float[Array, "T 2 3"]  # two rows spanning (to the nominal unit) the plane across gravity in the later pose
    mask: Bool[Array, " T"]


class SlowNoise(eqx.Module):
    """Covariances, by axis, of what a noise model knows of the mean outputs: slow bias ties intervals to each other.

    The gyroscope's intervals are the P poses and then B parts of each of the T turns, in order; of a part only the bias
    that stays correlated over it is meant, white noise is in `Turns.noise`. Output units squared.
    """

    accelerometer: Float[Array, "3 P P"]
    gyroscope: Float[Array, "3 G G"]
    part: Int[Array, "T S"]  # which of its turn's B parts a sample belongs to


class Observations(eqx.Module):
    """Poses and turns of one unit, and the local gravity (m/s²) they are compared with.

    `slow` is None where the noise is known from the poses' own scatter only: then intervals are independent.
    """

    poses: Poses
    turns: Turns
    gravity: Float[Array, "..."]
    slow: SlowNoise | None = None


class Stations(eqx.Module):
    """Intervals of which the set-up says what the unit went through: poses on a level table, and turns.

    `stimulus` has leading axes (S, Q): what the set-up says at Q nodes of a station, whose `weight` adds up to one, so
    that a mean output is the weighted mean of the model's. Covariances are of the mean outputs, by axis, in output
    units squared: white noise on the diagonal, slow bias ties stations together. What is not used (the accelerometer in
    turns, padding) has a covariance of one and counts for nothing.
    """

    accelerometer_mean: Float[Array, "S 3"]
    gyroscope_mean: Float[Array, "S 3"]
    accelerometer_covariance: Float[Array, "3 S S"]
    gyroscope_covariance: Float[Array, "3 S S"]
    stimulus: Stimulus
    weight: Float[Array, "S Q"]
    start: Float[Array, " S"]  # s, on the recording's clock
    stop: Float[Array, " S"]
    turn: Bool[Array, " S"]  # a turn, else a pose
    accelerometer_used: Bool[Array, " S"]
    gyroscope_used: Bool[Array, " S"]
    gravity: Float[Array, ""]  # m/s², as the set-up says; specific force is in proportion to it
    recording: Int[Array, " S"]  # the number of the one that it is of
