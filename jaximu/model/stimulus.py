"""What a sensor goes through, at sample rate: what effects read, and what the sensor model answers to."""

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
from jaxtyping import Float

from jaximu.ground.array_types import Array
from jaximu.ground.differences import slopes
from jaximu.ground.errors import InputError
from jaximu.ground.rotation import Numbers, Quaternion, Vector

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
    or beside the unit, session_time (...) s since the first of recordings that follow each other began. Vectors are in
    the body frame. temperature_reference (°C) and time_reference (s) are what effects count from; `memory` is what
    effects with a memory carry over from the path before this one, by name.
    """

    specific_force: Vector | None = None
    angular_rate: Vector | None = None
    angular_acceleration: Vector | None = None
    temperature: Numbers | None = None
    temperature_rate: Numbers | None = None
    time: Numbers | None = None
    attitude: Quaternion | None = None
    vibration_power: Numbers | None = None
    magnetic_field: Vector | None = None
    current: Numbers | None = None
    session_time: Numbers | None = None
    memory: dict[str, Float[Array, "... _"]] | None = None
    temperature_reference: float = eqx.field(static=True, default=REFERENCE_TEMPERATURE)
    time_reference: float = eqx.field(static=True, default=0.0)

    def changed(self, change: Callable[[Array], Array], *fields: str) -> "Stimulus":
        """Return the stimulus with some fields changed by a function, where they are known."""
        values = {field: getattr(self, field) for field in fields}
        return replace(self, **{field: change(value) for field, value in values.items() if value is not None})

    def beside_motion(self) -> "Stimulus":
        """Return what a model that corrects the output knows: temperature and the like, not the true force and rate."""
        return replace(self, specific_force=None, angular_rate=None, angular_acceleration=None)

    def on_a_path(self) -> bool:
        """Return whether there are stamps along a path, not one instant."""
        return self.time is not None and self.time.ndim > 0

    def need(self, field: str, name: str) -> Array:
        """Return a field for the effect called `name`.

        Rates of change that are not known are taken by central differences along the path. Raises `InputError` for a
        field that is neither there nor to be had.
        """
        value = getattr(self, field)
        source = getattr(self, _DERIVATIVES.get(field, field))
        if value is None and source is not None and self.on_a_path():
            value = rate_of_change(source, self.time)
        if value is None:
            raise InputError(f"the effect {name} needs the {field.replace('_', ' ')}, which this recording lacks.")
        return value

    def warmth(self, name: str) -> Numbers:
        """Return T − T_ref (K) for the effect called `name`."""
        return self.need("temperature", name) - self.temperature_reference

    def elapsed(self, name: str) -> Numbers:
        """Return t − t_ref (s) for the effect called `name`."""
        return self.need("time", name) - self.time_reference


def rate_of_change(values, time):
    """Return rates of change along the path of vectors (..., n, 3) or scalars (..., n); `time` (..., n) in s."""
    return slopes(values, time) if values.ndim > time.ndim else slopes(values[..., None], time)[..., 0]
