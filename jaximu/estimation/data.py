"""What recordings say about a unit: the abstract `Data` that `fit` takes, and what a kind of data makes of itself.

A kind of data stands in one class. For a fit it says what its conditions are, their covariance and how they react to
effects. For a diagnosis it says besides what its recordings span, what the unit went through, and which shapes without
a cause its conditions would show.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaximu.estimation.covariance import Chain, Covariance
from jaximu.estimation.problem import Name, without_equipment_or_effects
from jaximu.estimation.rows import Rows, Sizes
from jaximu.estimation.track import Track
from jaximu.estimation.uncertainty import station_advice
from jaximu.ground import stored
from jaximu.ground.array_types import Array, BoolArray, FloatArray, IntArray
from jaximu.ground.tracing import array_module, first, lifted
from jaximu.model.effects.base import Effect, Extent, Place, inner_owners
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.sensor import Imu
from jaximu.recordings.finding import Finding
from jaximu.recordings.recording import Recording, one_after_another

_GRID = 16
"""Inner parameters of an effect are asked for in multiples of so many."""


class Conditions(eqx.Module):
    """What a measurement says about a unit once samples are no longer needed.

    `magnitude`: what is known and uncertain, gravity (m/s²) or the strength of the field (µT).
    """

    @abstractmethod
    def __call__(self, imu: Imu) -> Float[Array, " n"]:
        """Return the conditions, which would be zero without noise at the true unit; zero for padding."""

    def at_magnitude(self, magnitude: Float[Array, ""]) -> Self:
        """Return the same with another magnitude."""
        return replace(self, magnitude=magnitude)


@dataclass(frozen=True)
class About:
    """A measurement evaluated about units, the leading axis of every array.

    columns (N, n, q): derivatives of the conditions by the effects' numbers, in their own units. details: what the
    measurement itself needs again. unknown (n, k): what known effects may do beyond what is known of them, at one
    standard deviation; the covariance has it.
    """

    conditions: Conditions
    covariance: Covariance | Chain
    columns: FloatArray
    details: Any = None
    unknown: FloatArray | None = None


@dataclass(frozen=True)
class Observed:
    """The observations or samples (o,) along which shapes without a cause are looked for.

    react: returns how the conditions (n, q) react to a shape of a triad's output, (o, k) alike for each axis or
    (o, 3, k) of each axis by itself. share (o,): of the recording that has gone by. recording (o,): of which of
    several each is. up (o, 3): the specific force's
    direction, None where orientation is not compared. still (o,): observations at rest, None for samples in motion.
    number (o,): of each observation, and alone: those that may be off by themselves. duration: s, within which a bias
    may swing to and fro; None where that is not looked for. attitude (o, 9): the level frame's axes, where they are
    carried from one observation to the next. curves (o, k): smooth functions of temperature.
    """

    react: Callable[[str, FloatArray], FloatArray]
    share: FloatArray
    recording: IntArray | None = None
    up: FloatArray | None = None
    still: BoolArray | None = None
    number: IntArray | None = None
    alone: IntArray | None = None
    duration: float | None = None
    attitude: FloatArray | None = None
    curves: FloatArray | None = None


@dataclass(frozen=True)
class OutputMeans:
    """The mean outputs that conditions are made of, and how the conditions react to them.

    start, stop (o,): s, on the clock of the recording (o,) that each is of. reactions: by triad, of the conditions
    (n, o, 3) to the outputs of each axis. scale (3,): by triad, output units per SI. noise: white, as the scatter
    within the means shows it.
    """

    start: FloatArray
    stop: FloatArray
    recording: IntArray
    reactions: Mapping[str, FloatArray]
    scale: Mapping[str, FloatArray]
    noise: NoiseModel

    @classmethod
    def of(
        cls,
        start: FloatArray,
        stop: FloatArray,
        recording: IntArray,
        reactions: Mapping[str, FloatArray],
        scale: Mapping[str, FloatArray],
        variance: Mapping[str, FloatArray],
    ) -> OutputMeans:
        """Return mean outputs of measured `variance` (o, 3), by triad, in output units squared; NaN where unused."""
        noise = NoiseModel(AxisNoise.of_white(0.0))
        for triad in reactions:
            density = np.nanmean(variance[triad] * (stop - start)[:, None], axis=0)
            noise = replace(noise, **{triad: AxisNoise.of_white(density / np.square(scale[triad]))})
        return cls(start, stop, recording, reactions, scale, noise)


class Handling(NamedTuple):
    """Variances (n,) of all conditions, padding included, by poses that tilt and by turns that are undersampled.

    tilting: rate (P,), rad/s, by which each pose tilts, noise taken off; noise: its standard deviation (P,). missed:
    (T,), rad, half of what even and odd samples of a turn differ by, noise taken off; turned (T,): what white noise
    turns each by.
    """

    moving: FloatArray
    sampling: FloatArray
    tilting: FloatArray
    noise: FloatArray
    missed: FloatArray
    turned: FloatArray


class Data(ABC):
    """What recordings say about a unit, or about units along a leading axis.

    effects_inside: the conditions evaluate effects themselves; else `about` gives their columns. coarse: the excess to
    begin with. owners: whose effects can show. by_hand: hands moved the unit. sampled: the noise of samples makes the
    covariance, see `with_noise`; else the data state it, and a fit estimates what goes beyond. no_fixture: why effects
    of a set-up cannot show, empty where they can. advice: says what to record where numbers stay open. gravity: m/s²,
    () or of units (N,).
    """

    gravity: Float[Array, " ..."]

    effects_inside: ClassVar[bool] = False
    excess_names: tuple[str, ...] = ()
    coarse: tuple[float, ...] = ()
    owners: ClassVar[tuple[str, ...]] = ("accelerometer", "gyroscope", "setup")
    by_hand: ClassVar[bool] = False
    sampled: ClassVar[bool] = False
    no_fixture: ClassVar[str] = ""
    advice: ClassVar[Callable[..., str]] = staticmethod(station_advice)

    @abstractmethod
    def about(self, imu: Imu) -> About:
        """Return what is measured about units, the leading axis of every array of `imu`."""

    def rows(self, imu: Imu) -> Rows:
        """Return what each condition is; factors to SI and covariates are by a unit close to this one."""
        raise NotImplementedError

    def free(self, name: Name) -> bool:
        """Return whether a number is free: all but those of the accelerometer's gain that fix the frame."""
        return without_equipment_or_effects(name)

    def take(self, lanes: IntArray) -> Data:
        """Return the measurement of some of the units; of a single one, itself."""
        return self

    def reactions(self, details: Any) -> tuple[str, Callable[..., Float[Array, " n"]], Sequence[Any]]:
        """Return how the conditions react to effects: a key, a function, and the parts whose reactions add up.

        The function takes an effect, the unit without effects and a part, and is traced; the key tells kinds of
        measurement apart. The conditions feel an effect with the opposite sign.
        """
        raise NotImplementedError

    def own_columns(self, imu: Imu, details: Any, rows: int) -> FloatArray:
        """Return the derivatives (rows, q) of the conditions by the numbers of the unit's effects, in their own units.

        `details`: of the measurement about the unit.
        """
        key, react, parts = self.reactions(details)
        numerics = array_module(imu, details)
        effects, columns = imu.all_effects(), [numerics.zeros((rows, 0))]
        for effect in effects.values():
            kind, recording = type(effect).acting(), type(effect).recording
            if self.no_fixture and effect.scope == "fixture":
                columns.append(numerics.zeros((rows, effect.size + len(effect.inner))))
                continue

            def derivatives(imu, part, numbers, kind=kind):
                return derivatives_by_numbers(kind, lambda varied: react(varied, imu, part), numbers)

            inner = [numerics.asarray(getattr(effect, name), float)[None] for name in effect.inner]
            numbers = numerics.concatenate([numerics.asarray(effect.coefficients, float), *inner])
            acting = parts[recording - 1 : recording] if recording else parts
            parted = [
                stored.call(derivatives, f"{key} {kind.name}", imu.with_effects(), part, numbers) for part in acting
            ]
            columns.append(-sum(parted[1:], start=parted[0]))
        return free_columns(effects, numerics.concatenate(columns, axis=1))

    def dormant_columns(
        self, imu: Imu, details: Any, grids: Mapping[type[Effect], Sequence[Mapping[str, float]]]
    ) -> dict[type[Effect], FloatArray]:
        """Return the reactions (G, n, q) by the coefficients of effects at zero, each at G inner parameters.

        Of an effect in one recording alone, of the part of that number; the data have a part for each recording then.
        One program for all effects: loading one from the cache takes as long as running it ten times. A diagnosis runs
        it four times and more, which pays for compiling it in full.
        """
        if not grids:
            return {}
        key, react, parts = self.reactions(details)
        longest: dict[str, int] = {}
        for kind, grid in grids.items():
            longest[kind.acting().name] = max(longest.get(kind.acting().name, 0), len(grid))

        def derivatives(kinds, imu, part, *inner):
            def at(kind, values):
                def of(coefficients):
                    return react(kind(coefficients, **dict(zip(kind.inner, values, strict=True))), imu, part)

                return _slope(kind, of, jnp.zeros(kind.size))

            return tuple(
                at(kind, grid[0])[None] if len(grid) == 1 else jax.lax.map(partial(at, kind), grid)
                for kind, grid in zip(kinds, inner, strict=True)
            )

        columns: dict[type[Effect], FloatArray] = {}
        for number, part in enumerate(parts, 1):
            acting = [kind for kind in grids if kind.recording in (0, number)]
            kinds, inner = [kind.acting() for kind in acting], []
            for kind, whole in zip(acting, kinds, strict=True):
                grid, count = grids[kind], longest[whole.name]
                values = np.array([[point[name] for name in kind.inner] for point in grid]).reshape(
                    len(grid), len(kind.inner)
                )
                count += -count % _GRID if count > _GRID else 0  # few lengths, and so few programs
                inner.append(np.concatenate([values, np.repeat(values[-1:], count - len(values), axis=0)]))
            words = " ".join([key, "dormant", *(kind.name for kind in kinds)])
            slopes = stored.call(partial(derivatives, kinds), words, imu, part, *inner, quick=False)
            for kind, slope in zip(acting, slopes, strict=True):
                columns[kind] = columns.get(kind, 0.0) + slope[: len(grids[kind])]
        return columns

    # --- what a diagnosis needs to know ---------------------------------------------------------------------------

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """What was recorded."""
        return ()

    def spans(self) -> list[FloatArray]:
        """Return start and stop (k, 2), s, of the observations of each recording, in the order of time."""
        raise NotImplementedError

    def rests(self) -> list[FloatArray]:
        """Return the spans (k, 2), s, of each recording in which the unit lay still."""
        return self.spans()

    def counts(self) -> dict[str, int]:
        """Return how many observations there are of each kind, as a document has them."""
        return {}

    def rate_at_rest(self) -> FloatArray | None:
        """Return the gyroscope's mean output (3,) at rest, where it rested."""
        return None

    def rotations(self, imu: Imu) -> FloatArray:
        """Return how the rotation vector of each turn (t, 3, 3, 4), rad, reacts to K⁻¹ and −K⁻¹b of the gyroscope."""
        return np.zeros((0, 3, 3, 4))

    def white_noise(self, excess: Mapping[str, float]) -> NoiseModel:
        """Return the white noise of samples that a fit's excess, by name, shows; none where there are no samples."""
        return NoiseModel(AxisNoise.of_white(0.0), AxisNoise.of_white(0.0))

    def with_noise(self, noise: NoiseModel) -> Self:
        """Return the data with the covariance that a noise of their samples makes, where samples make it."""
        return self

    def extent(self, recording: int = 0) -> Extent:
        """Return what a recording spans, by its number, or all of them (0): effects may begin between observations."""
        chosen = slice(recording - 1, recording) if recording else slice(None)
        spans = self.spans()[chosen]
        starts = one_after_another(self.recordings)
        temperatures = [log.temperature.values for log in self.recordings[chosen] if log.temperature is not None]
        return Extent(
            max(float(part[-1, 1] - part[0, 0]) for part in spans),
            tuple(float(time) for part in spans for time in (part[:-1, 1] + part[1:, 0]) / 2),
            max((float(np.ptp(values)) for values in temperatures), default=0.0),
            max((start + part[-1, 1] for start, part in zip(starts, self.spans(), strict=False)), default=0.0),
        )

    def tracks(self, details: Any) -> list[dict[str, Track]]:
        """Return what the unit went through, part by part, at the samples of each triad."""
        return details.tracks

    def hidden(self) -> Mapping[str, str]:
        """Return effects, by name, that this recording cannot show, and why."""
        return {}

    def parts(self, real: Rows, count: int, interleaved: bool = False) -> list[IntArray]:
        """Return the observations that are left out in turn, as [`jaximu.estimation.rows.Rows.parts`][] has them.

        `real`: the rows that are no padding.
        """
        return real.parts(count, interleaved)

    def observed(self, imu: Imu, details: Any) -> Observed:
        """Return the observations along which shapes without a cause are looked for."""
        raise NotImplementedError

    def allowed(self, count: int) -> FloatArray:
        """Return what may lie off beforehand, as good as free: columns (count, k) at one standard deviation."""
        return np.zeros((count, 0))

    def rms(self, imu: Imu, details: Any, conditions: FloatArray) -> Sizes:
        """Return the rms of each kind of residual of all conditions (n,), with its unit, as a calibration has it."""
        rows = self.rows(imu)
        return rows.real().rms(conditions[rows.used])

    def without(self, observation: int) -> Self:
        """Return the data with an observation, and what touches it, left out."""
        raise NotImplementedError

    def twin(self, imu: Imu, details: Any, conditions: FloatArray, noise: NoiseModel, seed: int) -> Self | None:
        """Return the data that a unit without effects would give along the same motion, noise included.

        `conditions` (n,): of that unit in these data. None where the noise is known of the conditions alone.
        """
        return None

    def drifts(self, noise: NoiseModel, details: Any, within: bool) -> tuple[dict[str, AxisNoise], FloatArray | None]:
        """Return drifts of the biases by name, at a size of one, and the covariance (k, n, n) that each adds.

        `within`: false where `noise` knows the drift in a recording; what changes between several counts in any case.
        """
        return {}, None

    def output_means(self, details: Any) -> OutputMeans | None:
        """Return the mean outputs that the conditions are made of; None where they are not made of such."""
        return None

    def handling(self, imu: Imu, details: Any, noise: NoiseModel) -> Handling | None:
        """Return what hands add to the conditions, where hands moved the unit."""
        return None

    def moved_by_hand(self, imu: Imu, handling: Handling, undersampling: float) -> list[Finding]:
        """Return what is wrong with how hands moved the unit; `undersampling`: share of what samples miss."""
        return []

    def sway(self, imu: Imu, noise: NoiseModel) -> list[Finding]:
        """Return whether hands turn the unit while it should be at rest, which looks like noise."""
        return []

    def averaged(self) -> Self | None:
        """Return the data with the gyroscope's samples, taken for rates of instants, turned into means.

        None where no means over turns are compared.
        """
        return None

    def change_by_averaging(self, details: Any) -> FloatArray:
        """Return how the conditions (n,) change by that."""
        raise NotImplementedError


class OfOneUnit(Data):
    """What recordings say about one unit: the leading axis of `about` has length one."""

    @abstractmethod
    def about_one(self, imu: Imu) -> About:
        """Return what is measured about a unit; no array has a leading axis."""

    def about(self, imu: Imu) -> About:
        """Return what is measured about the one unit along the leading axis."""
        about = self.about_one(first(imu))
        return replace(
            about, **lifted({name: getattr(about, name) for name in ("conditions", "covariance", "columns")})
        )


def _slope(kind: type[Effect], of: Callable[[Array], Array], numbers: Array) -> Array:
    """Return the derivatives (n, p) of a reaction by an effect's numbers."""
    if not kind.probes:
        return jax.jacfwd(of)(numbers)
    # the derivative vanishes nearly everywhere: the change over a quarter of what there is, or the least probe
    step = jnp.maximum(jnp.abs(numbers) / 4, kind.probes[0])
    return jax.vmap(lambda e, h: (of(numbers + h * e) - of(numbers - h * e)) / (2 * h), out_axes=1)(
        jnp.eye(len(numbers)), step
    )


def free_columns(effects: Mapping[Place, Effect], columns: Float[Array, "... q"]) -> Float[Array, "... p"]:
    """Return the derivatives by the numbers that are free, effect by effect, of those by all numbers of each.

    An inner parameter that effects share is one number: what it does to each of them adds up.
    """
    owners = inner_owners(effects)
    numbers = [
        (at, owners[at] if name in effect.inner else at, name)
        for at, effect in effects.items()
        for name in (*range(effect.size), *effect.inner)
    ]
    free = [(owner, name) for at, owner, name in numbers if owner == at]
    if len(free) == len(numbers):
        return columns
    return columns @ np.array([[(owner, name) == one for one in free] for _, owner, name in numbers], float)


def derivatives_by_numbers(kind: type[Effect], reaction: Callable[[Effect], Array], numbers: Array) -> Array:
    """Return the derivatives (n, q + i) of a reaction by an effect's coefficients and inner parameters."""

    def of(numbers):
        return reaction(kind(numbers[: kind.size], **dict(zip(kind.inner, numbers[kind.size :], strict=True))))

    return _slope(kind, of, numbers)
