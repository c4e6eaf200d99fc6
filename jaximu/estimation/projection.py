"""The errors of a calibration's numbers, projected into the corrected output.

A unit of numbers θ that goes through u puts out y = respond(θ, u); a model of it, θ̂, corrects that to
recover(θ̂, y) = u + J (θ − θ̂), to first order. With the covariance C of θ̂ the corrected output has the covariance
J C Jᵀ (law of propagation, GUM 5.1.2): what mrcal calls the projection uncertainty of a camera's calibration, in the
units in which the calibration is used and at the input that matters.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float, Int

from jaximu.estimation.problem import Name, flatten, names_of, typical_sizes
from jaximu.estimation.uncertainty import UNDETERMINED
from jaximu.ground import stored
from jaximu.ground.array_types import Array, FloatArray
from jaximu.ground.rotation import Vector
from jaximu.ground.vectors import root_or_zero, variances_of
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus


@dataclass(frozen=True)
class OutputUncertainty:
    """How uncertain a triad's corrected output is, in the body frame, in SI.

    covariance: (..., 3, 3). In directions that the data do not determine it is that of the data sheet's tolerance.
    expected: (..., 3) how far the output of a typical unit is off by the same numbers before any calibration.
    """

    covariance: FloatArray
    expected: FloatArray

    @property
    def sigma(self) -> FloatArray:
        """The standard deviation of each axis (..., 3); infinite where the data say no more than the data sheet."""
        sigma = root_or_zero(variances_of(self.covariance))  # exact data leave rounding beside zero
        return np.where(sigma > UNDETERMINED * self.expected, np.inf, sigma)

    @property
    def largest(self) -> FloatArray:
        """The standard deviation (...) along the direction in which it is largest; infinite if any axis is."""
        values = root_or_zero(np.linalg.eigvalsh(self.covariance)[..., -1])
        return np.where(np.isinf(self.sigma).any(axis=-1), np.inf, values)


def output_error(model: Imu, unit: Imu, stimulus: Stimulus) -> dict[str, Vector]:
    """Return how far a unit's output, corrected by a model of it, is off the truth, by triad (..., 3), SI.

    Of the triads whose input the stimulus holds. Effects of a session and of the set-up are left out, as `compensate`
    leaves them alone; effects see the true input of the other triad.

    Raises `InputError` for an effect that needs what the stimulus lacks.
    """
    triads = model.transferable().triads()
    return {
        name: triads[name].recover(triad.respond(stimulus), stimulus) - true
        for name, triad in unit.transferable().triads().items()
        if (true := getattr(stimulus, triad.quantity)) is not None
    }


def sensitivity(model: Imu, places: Int[Array, " p"], stimulus: Stimulus) -> dict[str, Float[Array, "... 3 p"]]:
    """Return J, by triad: how the corrected output moves (SI) with errors of some of the model's numbers.

    **Arguments:** `places`: of these p numbers in the order of `names_of`; `stimulus`: as of `output_error`.
    """
    numbers, restore = ravel_pytree(model)

    def error(change: Float[Array, " p"]) -> dict[str, Vector]:
        return output_error(model, restore(numbers.at[places].add(change)), stimulus)

    return jax.jacfwd(error)(jnp.zeros(len(places)))


def output_uncertainty(
    imu: Imu, names: Sequence[Name], covariance: FloatArray, stimulus: Stimulus
) -> dict[str, OutputUncertainty]:
    """Return how uncertain the corrected output is, by triad, where some of a unit's numbers have this covariance.

    Raises `InputError` as `output_error` does.
    """
    order = names_of(imu)
    places = np.array([order.index(name) for name in names], int)
    sizes = flatten(typical_sizes(imu))[places]
    return {
        name: OutputUncertainty(
            slope @ covariance @ np.swapaxes(slope, -1, -2), np.sqrt(np.sum((slope * sizes) ** 2, axis=-1))
        )
        for name, slope in stored.call(sensitivity, "sensitivity", imu, places, stimulus).items()
    }
