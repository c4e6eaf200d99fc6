"""The catalogue of effects: one line a file, each file listing its effects in `EFFECTS`; and effects of one's own."""

import inspect
from contextlib import suppress
from importlib import import_module
from typing import Any, TypeVar

from jaximu.ground.errors import InputError
from jaximu.ground.units import SENSORS
from jaximu.model.effects.base import Effect

_FILES = (
    "quadratic",
    "cubic",
    "asymmetry",
    "cross_coupling",
    "size_effect",
    "lever_arm",
    "temperature",
    "temperature_rate",
    "thermal_lag",
    "thermal_hysteresis",
    "scale_temperature",
    "misalignment_temperature",
    "bias_ramp",
    "warm_up",
    "step",
    "scale_ramp",
    "scale_step",
    "vibration_rectification",
    "g_sensitivity",
    "lag",
    "dead_band",
    "earth_rotation",
    "time_offset",
    "reference_delay",
    "reference_filter",
    "reference_rotation",
    "clock_scale",
    "table_tilt",
    "table_axis",
    "table_rate_scale",
    "local_gravity",
    "current",
    "field_disturbance",
    "magnetic_field",
    "learned",
    "network",
)


class Catalogue(dict[str, type[Effect]]):
    """Effects by name; of a session also as "NAME@2", in the second of several recordings alone, or "NAME@all"."""

    def __missing__(self, name: object) -> type[Effect]:
        """Return an effect in one recording, or over all that follow each other."""
        whole, _, number = str(name).partition("@")
        kind = self.get(whole)
        if kind is not None and kind.carries_on and number == "all":
            return kind.throughout()
        if kind is None or kind.scope != "session" or not number.lstrip("0").isdecimal():
            raise KeyError(name)
        return kind.within(int(number))

    def __contains__(self, name: object) -> bool:
        """Return whether there is such an effect, in all recordings or in one."""
        with suppress(KeyError):
            return bool(self[str(name)])
        return False


CATALOGUE = Catalogue(
    (effect.name, effect) for file in _FILES for effect in import_module(f"jaximu.model.effects.{file}").EFFECTS
)
"""Every effect by name."""

_STATED = ("formula", "unit", "scope", "needs", "excited_by", "source", "typical")
Kind = TypeVar("Kind")


def register(kind: Kind) -> Kind:
    """Add an effect of your own to the catalogue, and return it, so that it may stand above the class as a decorator.

    From then on this process simulates it, tests for it, fits it, explains it, and reads it from files; so do the
    processes of a fleet that it starts, which import it: for them it must lie in a module. A class of the same module
    and name replaces the one that was registered before, as when a cell of a notebook runs again.

    Raises `InputError` for what is no effect, states less than an effect must, or has a name that is taken.
    """
    effect: Any = kind
    if not (inspect.isclass(effect) and issubclass(effect, Effect)):
        raise InputError(f"expected a class derived from jaximu.Effect, found {effect!r}.")
    if "name" not in effect.__dict__:
        raise InputError(f"{effect.__name__} states no name, such as 'gyro.quartic'.")
    if effect.name.partition(".")[0] not in (*SENSORS, "setup"):
        known = ", ".join(f"{prefix}." for prefix in (*SENSORS, "setup"))
        raise InputError(f"{effect.__name__}: the name {effect.name!r} must begin with one of {known}")
    lacking = [attribute for attribute in _STATED if not hasattr(effect, attribute)]
    if lacking or effect.term is Effect.term:
        raise InputError(f"{effect.__name__} does not state its {', '.join(lacking) or 'term'}.")
    namesake = CATALOGUE.get(effect.name)
    if namesake is not None and namesake.import_path() != effect.import_path():
        raise InputError(
            f"the catalogue has an effect {effect.name!r} already, {namesake.import_path()}: give {effect.__name__} "
            "another name."
        )
    CATALOGUE[effect.name] = effect
    return kind


def registered() -> tuple[type[Effect], ...]:
    """Return the effects that were added to the catalogue."""
    return tuple(effect for effect in CATALOGUE.values() if not effect.built_in())
