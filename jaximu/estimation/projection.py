"""The errors of a calibration's numbers, projected into the corrected output.

A unit of numbers θ that goes through u puts out y = respond(θ, u); a model of it, θ̂, corrects that to
recover(θ̂, y) = u + J (θ − θ̂), to first order. With the covariance C of θ̂ the corrected output has the covariance
J C Jᵀ (law of propagation, GUM 5.1.2): what mrcal calls the projection uncertainty of a camera's calibration, in the
units in which the calibration is used and at the input that matters.
"""

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Float, Int

from jaximu.ground.array_types import Array
from jaximu.ground.rotation import Vector
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus

__all__ = ["output_error", "sensitivity"]


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
