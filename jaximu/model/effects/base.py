"""The interface of an effect: one term of the forward model, written once and used four ways."""

from __future__ import annotations

import inspect
import secrets
import sys
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaximu.ground import stored
from jaximu.ground.array_types import Array
from jaximu.ground.document import Json
from jaximu.ground.errors import InputError
from jaximu.ground.rotation import Numbers, Vector
from jaximu.ground.units import SENSORS
from jaximu.model.stimulus import Stimulus

Place = TypeVar("Place", bound=Hashable)
Scalar = Numbers | float
"""An inner parameter."""

_TRIADS = {
    "accel": {"input": "specific_force", "u": "f", "SI": "m/s^2", "motions": "many orientations"},
    "gyro": {"input": "angular_rate", "u": "ω", "SI": "rad/s", "motions": "turns about all axes"},
}
"""What a declaration for both triads has in braces."""


class Extent(NamedTuple):
    """What a recording spans: on it the grids stand on which a diagnosis seeks inner parameters."""

    duration: float  # s
    boundaries: tuple[float, ...]  # s, between neighbouring observations
    temperature_range: float  # K
    session: float = 0.0  # s, from the first to the last of recordings that follow each other

    def span(self, unit: str) -> float:
        """Return the whole of it in s or in K."""
        return {"s": self.duration, "K": self.temperature_range}[unit]


class Inner(NamedTuple):
    """A number inside an effect, such as a time constant: a fit searches it between `low` and `high`.

    beginning: it says when the effect begins; no derivative tells it, so it is asked on a grid and then held.
    shares: of a recording's whole extent in this unit, the values at which a diagnosis asks for the effect.
    """

    unit: str
    typical: float
    low: float
    high: float
    meaning: str
    beginning: bool = False
    shares: tuple[float, ...] = ()


class Effect(eqx.Module):
    """One term of the forward model: absent when its coefficients are zero.

    A subclass states itself in class attributes, implements `term`, and declares each inner parameter as a field of
    the same name. Coefficients of an output effect are in output units per the stated SI quantity, so that they read
    alike for outputs in SI and in counts; those of an input effect are in SI.
    """

    coefficients: Float[Array, "... q"]

    name: ClassVar[str]  # catalogue name, "accel.…", "gyro.…", "mag.…" or "setup.…"
    owner: ClassVar[str]  # "accelerometer", "gyroscope", "magnetometer" or "setup", as the name says
    plain: ClassVar[str]  # the name without that, alike for both triads
    common_name: ClassVar[str] = ""  # what an engineer calls it, without the sensor; as `name` has it where left out
    english: ClassVar[str]  # the same with the sensor: "accelerometer bias over temperature"
    title: ClassVar[str]  # the same with the catalogue name after it: as tables, headlines and figures have it
    formula: ClassVar[str]
    unit: ClassVar[str]  # of a coefficient; "output" stands for the triad's output unit
    size: ClassVar[int] = 3  # number of coefficients q: one an axis, if not stated
    scope: ClassVar[str]  # "device" (belongs to the unit), "session" (to this recording) or "fixture" (to the set-up)
    recording: ClassVar[int] = 0  # of several, the number of the only one in which it acts; 0: it acts in all of them
    carries_on: ClassVar[bool] = False  # its time may go on from one recording to the next that follows it
    throughout_all: ClassVar[bool] = False  # it does, as the effect called "NAME@all"
    needs: ClassVar[tuple[str, ...]]  # fields of the stimulus
    excited_by: ClassVar[str]
    look_alikes: ClassVar[tuple[str, ...]] = ()
    source: ClassVar[str]
    typical: ClassVar[float]  # a plausible size of a coefficient of an SI output, to scale it in a fit
    plausible: ClassVar[float] = 100.0  # typical sizes that it may have where data do not say: as good as free
    possible: ClassVar[float] = float("inf")  # the most that nature lets the coefficients' root sum of squares be, SI
    stated_by: ClassVar[str] = ""  # the option that states it, so that it is taken off
    known: ClassVar[float] = 0.0  # of a set-up: how well (1σ) a coefficient is known beforehand; 0: not at all
    inner: ClassVar[Mapping[str, Inner]] = MappingProxyType({})
    shares: ClassVar[str] = ""  # the plain name of another effect whose inner parameters it has, where that is there
    refers_to: ClassVar[str] = "output"  # "input": what the axes sense, before the gain; "output": what they put out
    invertible: ClassVar[bool] = True  # False: what it took away cannot be put back, and `recover` leaves it
    memory: ClassVar[int] = 0  # how many numbers it carries over the end of a path
    recovery: ClassVar[str] = "exactly"  # how far compensation can undo it
    probes: ClassVar[tuple[float, ...]] = ()  # coefficients to test it at, where its derivative at zero vanishes
    cause: ClassVar[bool] = True  # False: it describes a misfit and does not explain it, and no diagnosis names it

    def __init_subclass__(cls, **kwargs):
        super().__init_subclass__(**kwargs)
        if "name" in cls.__dict__:
            prefix, _, rest = cls.name.partition(".")
            cls.plain = rest.partition("@")[0]
            cls.owner = SENSORS.get(prefix, prefix)
            common = cls.common_name or cls.plain.replace("_", " ")
            within = f" in recording {cls.recording}" if cls.recording else ""
            within = " over all recordings" if cls.throughout_all else within
            cls.english = (common if prefix == "setup" else f"{cls.owner} {common}") + within
            cls.title = f"{cls.english} ({cls.name})"
            if not cls.built_in():
                stored.tell_apart((cls.name, cls.__name__), _source(cls))

    @classmethod
    def built_in(cls) -> bool:
        """Return whether the effect is jaximu's own."""
        return cls.__module__.startswith("jaximu.")

    @classmethod
    def within(cls, recording: int) -> Any:
        """Return the effect that acts in one of several recordings alone, called "NAME@2" in the second.

        In 0, all of them, it is the one of the catalogue again.
        """
        whole = next(kind for kind in cls.__mro__ if kind.__dict__.get("name") == cls.name.partition("@")[0])
        return _within(whole, recording) if recording else whole

    @classmethod
    def throughout(cls) -> Any:
        """Return the effect whose time goes on over recordings that follow each other, called "NAME@all"."""
        return _throughout(cls.within(0))

    @classmethod
    def acting(cls) -> Any:
        """Return the class that computes it: of an effect in one recording, the whole effect."""
        return cls.within(0) if cls.recording else cls

    def in_recording(self, number: int) -> Effect:
        """Return the effect as a recording of this number has it: with coefficients of zero where it does not act."""
        kind = type(self)
        if not kind.recording:
            return self
        acts = float(kind.recording == number)
        return kind.acting()(acts * self.coefficients, **{name: getattr(self, name) for name in kind.inner})

    @classmethod
    def import_path(cls) -> str:
        """Return where the class is found, as "module:Class"."""
        return f"{cls.__module__}:{cls.within(0).__qualname__}"

    @classmethod
    def make(cls, coefficients: Float[Array, " q"] | Sequence[float] | float, **inner) -> Effect:
        """Return the effect with coefficients (a number stands for all) and inner parameters (typical if left out).

        Raises `InputError` for an inner parameter it has not, or another number of coefficients.
        """
        unknown = sorted(set(inner) - set(cls.inner))
        if unknown:
            known = f"its inner parameters are {', '.join(cls.inner)}" if cls.inner else "it has none"
            raise InputError(f"{cls.name} has no inner parameter {unknown[0]!r}; {known}.")
        numbers = jnp.asarray(coefficients, float)
        if numbers.shape not in ((), (cls.size,)):
            raise InputError(f"{cls.name} has {cls.size} coefficients, found an array of shape {numbers.shape}.")
        return cls(jnp.broadcast_to(numbers, (cls.size,)), **cls._typical_inner() | inner)

    @classmethod
    def _typical_inner(cls) -> dict[str, float]:
        return {name: parameter.typical for name, parameter in cls.inner.items()}

    @classmethod
    def dormant(cls, **inner: float) -> Effect:
        """Return the effect with all coefficients zero."""
        return cls.make(0.0, **inner)

    @classmethod
    def curved(cls) -> str:
        """Return the input that alone, instant by instant, makes the effect; empty for an effect of anything else."""
        return cls.needs[0] if cls.needs in (("specific_force",), ("angular_rate",)) else ""

    @classmethod
    def grid(cls, extent: Extent) -> tuple[dict[str, float], ...]:
        """Return the inner parameters at which a recording of this extent is asked for the effect."""
        for name, parameter in cls.inner.items():
            if parameter.shares:
                whole = extent.span(parameter.unit)
                return tuple({name: whole * share} for share in parameter.shares)
        return ({},)

    @classmethod
    def beginning(cls) -> str:
        """Return the name of the inner parameter that says when the effect begins; empty where it has always been."""
        return next((name for name, parameter in cls.inner.items() if parameter.beginning), "")

    def since(self) -> float | None:
        """Return when the effect begins, s, or None where it has always been."""
        name = self.beginning()
        return float(getattr(self, name)) if name else None

    @classmethod
    def coefficient_unit(cls, output_unit: str) -> str:
        """Return the unit of a coefficient of a triad with this output unit."""
        plain = output_unit if cls.unit == "output" or "/" not in output_unit else f"({output_unit})"
        return cls.unit.replace("output", plain)

    def document(self, output_unit: str) -> Json:
        """Return the effect of a triad with this output unit as JSON documents have it."""
        return {
            "coefficients": np.asarray(self.coefficients).tolist(),
            "inner": {
                name: {"value": float(getattr(self, name)), "unit": parameter.unit}
                for name, parameter in self.inner.items()
            },
            "unit": self.coefficient_unit(output_unit),
            "scope": self.scope,
            **({"recording": self.recording} if self.recording else {}),
            **({} if self.built_in() else {"class": self.import_path()}),
        }

    def typical_sizes(self, scale: float | Array) -> Effect:
        """Return plausible deviations of every number of this effect, for a triad of so many output units per SI."""
        size = self.typical * (scale if self.unit.startswith("output") else 1.0)
        return type(self)(np.ones(self.size) * size, **jax.tree.map(float, self._typical_inner()))

    def needed(self, stimulus: Stimulus) -> list[Array]:
        """Return the fields of a stimulus that the effect needs, in their order. Raises `InputError` as `need` does."""
        return [stimulus.need(field, self.name) for field in self.needs]

    def term(self, stimulus: Stimulus) -> Vector:
        """Return the term (..., 3), in output units or SI as `refers_to` says, of stimuli with any leading axes."""
        raise NotImplementedError

    def remember(self, stimulus: Stimulus) -> Float[Array, "... _"]:
        """Return what the effect carries over the end of a path, if it has a memory.

        In `Stimulus.memory` NaN says that there was nothing before.
        """
        raise NotImplementedError


def inner_owners(effects: Mapping[Place, Effect]) -> dict[Place, Place]:
    """Return of each effect the place of that whose inner parameters it has: its own, or of the one it `shares`."""
    places = {(effect.owner, effect.plain): key for key, effect in effects.items()}
    return {key: places.get((effect.owner, effect.shares), key) for key, effect in effects.items()}


@cache
def _within(whole: Any, recording: int) -> Any:
    stated = {"name": f"{whole.name}@{recording}", "recording": recording, "__module__": whole.__module__}
    return type(whole)(f"{whole.__name__}In{recording}", (whole,), stated)


@cache
def _throughout(whole: Any) -> Any:
    def term(self, stimulus):
        return whole.term(self, replace(stimulus, time=stimulus.need("session_time", self.name)))

    def grid(cls, extent):
        return whole.grid(extent._replace(duration=extent.session))

    stated = {"name": f"{whole.name}@all", "throughout_all": True, "__module__": whole.__module__}
    changed = {"term": term, "grid": classmethod(grid)}
    return type(whole)(f"{whole.__name__}Throughout", (whole,), stated | changed)


class BiasEffect(Effect):
    """A bias on each axis in proportion to one number, such as the temperature."""

    scope = "device"

    def factor(self, stimulus: Stimulus) -> Numbers:
        """Return the number (...) that each axis's coefficient multiplies: what the effect needs first, as a rule."""
        return stimulus.need(self.needs[0], self.name)

    def term(self, stimulus):
        return self.coefficients * self.factor(stimulus)[..., None]


class InputEffect(Effect):
    """An error that depends on what the triad senses, the last thing that it needs."""

    scope = "device"
    needs = ("{input}",)

    def input(self, stimulus: Stimulus) -> Vector:
        """Return what the triad senses."""
        return stimulus.need(self.needs[-1], self.name)


class ScaleEffect(BiasEffect, InputEffect):
    """A scale factor of each axis that changes in proportion to one number, such as the temperature."""

    def term(self, stimulus):
        return super().term(stimulus) * self.input(stimulus)


class SetupEffect(Effect):
    """An error of the set-up: the sensor goes through something else than the set-up (or the reference) says."""

    scope = "fixture"
    recovery = "not undone: it belongs to the set-up"

    def act(self, stimulus: Stimulus, quantity: str) -> Stimulus:
        """Return what the triad that senses `quantity` truly goes through where the set-up says `stimulus`."""
        raise NotImplementedError

    def reach(self, duration: float) -> float:
        """Return how many seconds of the path before and after an instant the effect looks at."""
        return 0.0


def _source(effect: type[Effect]) -> str:
    """Return the text of the module that defines an effect; where it has none, what is like no other definition."""
    try:
        return inspect.getsource(sys.modules[effect.__module__])
    except (KeyError, TypeError, OSError):
        return secrets.token_hex()


Kind = TypeVar("Kind", bound=Effect)


def on_triad(shape: type[Kind], name: str, typical: float, look_alikes: Sequence[str], **changes: Any) -> type[Kind]:
    """Return a class of the catalogue, "accel.…" or "gyro.…", that is `shape` on this triad.

    It is called as it is named, AccelBiasRamp for "accel.bias_ramp": under that the shape's module must keep it. What
    differs between the triads the shape has in braces: {input}, {u}, {SI} and {motions}.

    **Arguments:** `typical`: as of an effect; `look_alikes`: names on the same triad, without it; `changes`: other
    attributes of the class that differ from the shape's.
    """
    triad = name.partition(".")[0]
    words = _TRIADS.get(triad, {})
    stated = {text: getattr(shape, text, "").format(**words) for text in ("formula", "unit", "excited_by")} | {
        "name": name,
        "typical": typical,
        "needs": tuple(field.format(**words) for field in shape.needs),
        "look_alikes": tuple(f"{triad}.{alike}" for alike in look_alikes),
        "__module__": shape.__module__,
        "__doc__": shape.__doc__,
    }
    return type(shape)(name.replace(".", "_").title().replace("_", ""), (shape,), stated | changes)


def pair(
    shape: type[Kind], name: str, typical: tuple[float, float], *look_alikes: str, **changes: tuple[Any, Any]
) -> tuple[type[Kind], type[Kind]]:
    """Return an effect on both triads of one declaration; typical, changes: of the accelerometer's and the gyroscope's.

    `changes`: attributes of the class that the triads have each for itself, such as `excited_by`; `alike`: look-alikes.
    """

    def on(triad: str, index: int) -> type[Kind]:
        differing = {attribute: values[index] for attribute, values in changes.items()}
        return on_triad(shape, f"{triad}.{name}", typical[index], differing.pop("alike", look_alikes), **differing)

    return on("accel", 0), on("gyro", 1)
