"""Learned effect: a small neural network of temperature and its rate on each axis, where no simpler term will do."""

from dataclasses import replace
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaximu.ground.array_types import Array
from jaximu.ground.rotation import Numbers, Vector
from jaximu.model.effects.base import Effect, Inner, Scalar, pair
from jaximu.model.effects.learned import ZERO_CELSIUS

UNITS = 4
WEIGHTS = 4 * UNITS
"""Numbers of an axis: each unit's share of the output, its weights of T and of Ṫ, and its constant."""


def network(weights: Float[Array, "... 16"], x: Numbers, r: Numbers) -> Numbers:
    """Return the outputs of networks with one hidden layer of tanh units, without a constant, at inputs x and r."""
    out, of_x, of_r, constant = jnp.split(weights, 4, axis=-1)
    return jnp.sum(out * jnp.tanh(of_x * x[..., None] + of_r * r[..., None] + constant), axis=-1)


class _LearnedNetwork(Effect):
    """A smooth function of temperature and its rate together on each axis, without a cause, zero at T_ref at rest.

    Coefficients, axis by axis: the output's weights v in output units, then for the units' inputs those a of x, those b
    of r and the constants c, which have no unit. x runs from −1 to 1 between two temperatures, r is the rate over a
    largest one; beyond these the function stays as it is at their bounds.
    """

    low: Scalar
    high: Scalar
    reach: Scalar

    cause = False
    formula = "Σ_k v_ik tanh(a_ik x + b_ik r + c_ik), less that at T_ref and dT/dt = 0"
    unit = "output"
    size = 3 * WEIGHTS
    scope = "device"
    needs = ("temperature", "temperature_rate")
    excited_by = "ramps of temperature of several rates, up and down"
    source = "one hidden layer of tanh units; regularised as MacKay, Neural Computation 4, 1992, 415–472"
    inner = MappingProxyType(
        {
            "low": Inner("K", 283.15, 200.0, 300.0, "absolute temperature below which the function stays as it is"),
            "high": Inner("K", 313.15, 280.0, 420.0, "absolute temperature above which the function stays as it is"),
            "reach": Inner(
                "K/s", 0.05, 1e-6, 10.0, "rate of temperature, of either sign, from which it stays as it is"
            ),
        }
    )

    def value(self, temperature: Scalar, rate: Scalar) -> Vector:
        """Return the networks' outputs (..., 3) at absolute temperatures, K, and rates, K/s."""
        # the range is where the data was, and not for a fit to move
        low, high, largest = jax.lax.stop_gradient((self.low, self.high, self.reach))
        x = jnp.clip((2 * jnp.asarray(temperature) - low - high) / (high - low), -1.0, 1.0)
        r = jnp.clip(jnp.asarray(rate) / largest, -1.0, 1.0)
        return network(self.coefficients.reshape(3, WEIGHTS), x[..., None], r[..., None])

    def typical_sizes(self, scale):
        sizes = super().typical_sizes(scale)
        of_output = np.arange(self.size) % WEIGHTS < UNITS
        return replace(sizes, coefficients=np.where(of_output, sizes.coefficients, 1.0))

    def term(self, stimulus):
        temperature, rate = self.needed(stimulus)
        return self.value(temperature + ZERO_CELSIUS, rate) - self.value(
            stimulus.temperature_reference + ZERO_CELSIUS, 0.0
        )


EFFECTS = AccelLearnedNetwork, GyroLearnedNetwork = pair(
    _LearnedNetwork, "learned_network", (1e-3, 1e-4), "learned_temperature", "temperature_times_rate", "thermal_lag"
)
