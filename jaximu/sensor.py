"""The sensor model: `Stimulus` in, output out (`respond`), and back (`recover`).

Forward, truth to output: y = K u + b + Σ effects(stimulus). u is the specific force (m/s²) or the angular rate (rad/s)
in the body frame, y the output in `output_unit` (an SI unit or counts), K the 3×3 gain in output units per SI unit, b
the bias in output units.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaximu._types import Array
from jaximu.rotation import apply_matrix, inverse_matrix

if TYPE_CHECKING:
    from jaximu.effects.base import Effect

__all__ = ["Imu", "Stimulus", "Triad"]


class Stimulus(eqx.Module):
    """What the sensor truly went through, at sample rate; quantities that are not known or not needed are None.

    All arrays share their leading axes `...` (samples, poses, a batch): specific_force (..., 3) m/s², angular_rate
    (..., 3) rad/s, angular_acceleration (..., 3) rad/s², temperature (...) °C, temperature_rate (...) °C/s, time
    (...) s. Vectors are in the body frame.
    """

    specific_force: Float[Array, "... 3"] | None = None
    angular_rate: Float[Array, "... 3"] | None = None
    angular_acceleration: Float[Array, "... 3"] | None = None
    temperature: Float[Array, ...] | None = None
    temperature_rate: Float[Array, ...] | None = None
    time: Float[Array, ...] | None = None


class Triad(eqx.Module):
    """Three sensor axes: gain K (3, 3), bias b (3,), and the effects beyond them.

    `quantity` names the stimulus field it senses, `specific_force` or `angular_rate`.
    """

    gain: Float[Array, "3 3"]
    bias: Float[Array, 3]
    effects: tuple[Effect, ...] = ()
    quantity: str = eqx.field(static=True, default="specific_force")
    output_unit: str = eqx.field(static=True, default="m/s^2")
    iterations: int = eqx.field(static=True, default=16)

    def respond(self, stimulus: Stimulus) -> Float[Array, "... 3"]:
        """Return the noise-free output (..., 3) in `output_unit`."""
        linear = apply_matrix(self.gain, getattr(stimulus, self.quantity)) + self.bias
        return linear + self._effects(stimulus)

    def recover(self, output: Float[Array, "... 3"], stimulus: Stimulus | None = None) -> Float[Array, "... 3"]:
        """Return the input (..., 3) in SI that gives `output`: the exact inverse of `respond`.

        Without effects this is K⁻¹(y − b). With effects it is the fixed point of u = K⁻¹(y − b − Σ effects(u)), run for
        `iterations` rounds: each shrinks the error by the effects' slope against the gain, so slopes of 10 % leave
        1e-16 after sixteen, and 20 % 1e-11. `stimulus` gives what else the effects depend on (temperature, the other
        triad's input …).
        """
        inverse = inverse_matrix(self.gain)
        centred = output - self.bias
        value = apply_matrix(inverse, centred)
        if self.effects:
            context = Stimulus() if stimulus is None else stimulus
            for _ in range(self.iterations):
                value = apply_matrix(inverse, centred - self._effects(self._with_input(context, value)))
        return value

    def _effects(self, stimulus: Stimulus) -> Float[Array, "... 3"] | float:
        return sum((effect.term(stimulus) for effect in self.effects), start=0.0)

    def _with_input(self, stimulus: Stimulus, value: Float[Array, "... 3"]) -> Stimulus:
        return eqx.tree_at(lambda s: getattr(s, self.quantity), stimulus, value, is_leaf=lambda leaf: leaf is None)


class Imu(eqx.Module):
    """An accelerometer triad and, unless None, a gyroscope triad in the same body frame."""

    accelerometer: Triad
    gyroscope: Triad | None

    @classmethod
    def nominal(cls, accelerometer_scale=(1.0,) * 3, accelerometer_offset=(0.0,) * 3, accelerometer_unit="m/s^2",
                gyroscope_scale=(1.0,) * 3, gyroscope_offset=(0.0,) * 3, gyroscope_unit="rad/s") -> Imu:  # fmt: skip
        """Return the unit as its data sheet describes it: diagonal gains, the given offsets, no effects."""

        def triad(scale, offset, quantity, unit):
            gain = np.diag(np.asarray(scale, float))  # on the host: eager JAX operations each cost a compilation
            return Triad(gain, np.asarray(offset, float), quantity=quantity, output_unit=unit)

        return cls(
            triad(accelerometer_scale, accelerometer_offset, "specific_force", accelerometer_unit),
            triad(gyroscope_scale, gyroscope_offset, "angular_rate", gyroscope_unit),
        )

    def respond(self, stimulus: Stimulus) -> tuple[Float[Array, "... 3"], Float[Array, "... 3"] | None]:
        """Return the outputs of both triads."""
        gyroscope = None if self.gyroscope is None else self.gyroscope.respond(stimulus)
        return self.accelerometer.respond(stimulus), gyroscope
