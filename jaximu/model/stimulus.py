"""What a sensor goes through, at sample rate: what effects read, and what the sensor model answers to."""

import equinox as eqx
from jaxtyping import Float

from jaximu.ground.array_types import Array
from jaximu.ground.differences import slopes
from jaximu.ground.errors import InputError

__all__ = ["REFERENCE_TEMPERATURE", "Stimulus", "rate_of_change"]

REFERENCE_TEMPERATURE = 25.0
"""°C at which gain and bias are stated, unless a triad says otherwise."""

_DERIVATIVES = {"angular_acceleration": "angular_rate", "temperature_rate": "temperature"}


class Stimulus(eqx.Module):
    """What the sensor truly went through, at sample rate; quantities that are not known or not needed are None.

    All arrays share their leading axes `...`, of which the last is the path (samples in time, or poses); a single
    instant has none. specific_force (..., 3) m/s², angular_rate (..., 3) rad/s, angular_acceleration (..., 3) rad/s²,
    temperature (...) °C, temperature_rate (...) °C/s, time (...) s on the recording's clock, attitude (..., 4) unit
    quaternion, body to level frame (x east or any fixed heading, z up), vibration_power (...) (m/s²)², the mean square
    of the vibration's acceleration, all directions together, magnetic_field (..., 3) µT, current (...) A, that flows in
    or beside the unit. Vectors are in the body frame. temperature_reference (°C) and time_reference (s) are what
    effects count from; `memory` is what effects with a memory carry over from the path before this one, by name.
    """

    specific_force: Float[Array, "... 3"] | None = None
    angular_rate: Float[Array, "... 3"] | None = None
    angular_acceleration: Float[Array, "... 3"] | None = None
    temperature: Float[Array, " ..."] | None = None
    temperature_rate: Float[Array, " ..."] | None = None
    time: Float[Array, " ..."] | None = None
    attitude: Float[Array, "... 4"] | None = None
    vibration_power: Float[Array, " ..."] | None = None
    magnetic_field: Float[Array, "... 3"] | None = None
    current: Float[Array, " ..."] | None = None
    memory: dict[str, Float[Array, "... _"]] | None = None
    temperature_reference: float = eqx.field(static=True, default=REFERENCE_TEMPERATURE)
    time_reference: float = eqx.field(static=True, default=0.0)

    def need(self, field: str, name: str) -> Array:
        """Return a field for the effect called `name`.

        Rates of change that are not known are taken by central differences along the path. Raises `InputError` for a
        field that is neither there nor to be had.
        """
        value = getattr(self, field)
        source = _DERIVATIVES.get(field)
        if value is None and source and getattr(self, source) is not None and self.time is not None and self.time.ndim:
            value = rate_of_change(getattr(self, source), self.time)
        if value is None:
            raise InputError(f"the effect {name} needs the {field.replace('_', ' ')}, which this recording lacks.")
        return value

    def warmth(self, name: str) -> Float[Array, " ..."]:
        """Return T − T_ref (K) for the effect called `name`."""
        return self.need("temperature", name) - self.temperature_reference

    def elapsed(self, name: str) -> Float[Array, " ..."]:
        """Return t − t_ref (s) for the effect called `name`."""
        return self.need("time", name) - self.time_reference


def rate_of_change(values, time):
    """Return rates of change along the path of vectors (..., n, 3) or scalars (..., n); `time` (..., n) in s."""
    return slopes(values, time) if values.ndim > time.ndim else slopes(values[..., None], time)[..., 0]
