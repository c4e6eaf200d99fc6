"""What segmentation distils from a recording: fixed-shape arrays with masks and covariances, plain PyTrees.

Shapes: P poses and P − 1 turns, turn k leading from pose k to pose k + 1, S samples a turn. All are padded to buckets
so that recordings of other lengths reuse compiled code; masks tell what is real. Outputs stay in the triads' output
units, as the logger wrote them.
"""

import equinox as eqx
from jaxtyping import Bool, Float

from jaximu._types import Array

__all__ = ["Observations", "Poses", "Turns"]


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


class Observations(eqx.Module):
    """Poses and turns of one unit, and the local gravity (m/s²) they are compared with."""

    poses: Poses
    turns: Turns
    gravity: Float[Array, ""]
