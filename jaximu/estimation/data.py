"""What recordings say about a unit: the abstract `Data` that `fit` takes, and what a kind of data makes of itself."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from jaximu.estimation.covariance import Chain, Covariance
from jaximu.estimation.problem import Name, without_equipment_or_effects
from jaximu.estimation.rows import Rows
from jaximu.ground import stored
from jaximu.ground.array_types import Array, FloatArray
from jaximu.ground.tracing import array_module
from jaximu.model.effects.base import Effect
from jaximu.model.sensor import Imu

__all__ = ["About", "Conditions", "Data", "derivatives_by_numbers"]

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
        return eqx.tree_at(lambda each: each.magnitude, self, magnitude)  # pyright: ignore[reportAttributeAccessIssue]


@dataclass(frozen=True)
class About:
    """A measurement evaluated about units, the leading axis of every array.

    columns (N, n, q): derivatives of the conditions by the effects' numbers, in their own units. details: what the
    measurement itself needs again.
    """

    conditions: Conditions
    covariance: Covariance | Chain
    columns: FloatArray
    details: Any = None


class Data(ABC):
    """What recordings say about a unit, or about units along a leading axis.

    effects_inside: the conditions evaluate effects themselves; else `about` gives their columns. coarse: the excess to
    begin with.
    """

    effects_inside: ClassVar[bool] = False
    excess_names: ClassVar[tuple[str, ...]] = ()
    coarse: ClassVar[tuple[float, ...]] = ()

    @abstractmethod
    def about(self, imu: Imu) -> About:
        """Return what is measured about units, the leading axis of every array of `imu`."""

    def rows(self, imu: Imu) -> Rows:
        """Return what each condition is; factors to SI and covariates are by a unit close to this one."""
        raise NotImplementedError

    def free(self, name: Name) -> bool:
        """Return whether a number is free: all but those of the accelerometer's gain that fix the frame."""
        return without_equipment_or_effects(name)

    def take(self, lanes: NDArray[np.int64]) -> Data:
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
        found = [np.zeros((rows, 0))]
        for effect in imu.all_effects().values():
            kind = type(effect)

            def derivatives(imu, part, numbers, kind=kind):
                return derivatives_by_numbers(kind, lambda varied: react(varied, imu, part), numbers)

            inner = [float(getattr(effect, name)) for name in effect.inner]
            numbers = np.concatenate([np.asarray(effect.coefficients), inner])
            own = [stored.call(derivatives, f"{key} {kind.name}", imu.with_effects(), part, numbers) for part in parts]
            found += [-sum(own[1:], start=own[0])]
        return array_module(found).concatenate(found, axis=1)

    def dormant_columns(
        self, imu: Imu, details: Any, asked: Mapping[type[Effect], Sequence[Mapping[str, float]]]
    ) -> dict[type[Effect], FloatArray]:
        """Return the reactions (G, n, q) by the coefficients of effects at zero, each at G inner parameters.

        One program for all effects: loading one from the cache takes as long as running it ten times. A diagnosis runs
        it four times and more, which pays for compiling it in full.
        """
        if not asked:
            return {}
        key, react, parts = self.reactions(details)
        kinds, inner = list(asked), []
        for kind, grid in asked.items():
            given = np.array([[each[name] for name in kind.inner] for each in grid]).reshape(len(grid), len(kind.inner))
            missing = -len(given) % _GRID if len(given) > _GRID else 0  # few lengths, and so few programs
            inner.append(np.concatenate([given, np.repeat(given[-1:], missing, axis=0)]))

        def derivatives(imu, part, *inner):
            def at(kind, values):
                def of(coefficients):
                    return react(kind(coefficients, **dict(zip(kind.inner, values, strict=True))), imu, part)

                return _slope(kind, of, jnp.zeros(kind.size))

            return tuple(
                at(kind, grid[0])[None] if len(grid) == 1 else jax.lax.map(partial(at, kind), grid)
                for kind, grid in zip(kinds, inner, strict=True)
            )

        names = ",".join(kind.name for kind in kinds)
        key = f"{key} dormant {names}"
        found = [stored.call(derivatives, key, imu, part, *inner, quick=False) for part in parts]
        sums = [np.sum(own, axis=0) for own in zip(*found, strict=True)]
        return {kind: each[: len(asked[kind])] for kind, each in zip(kinds, sums, strict=True)}


def _slope(kind: type[Effect], of: Callable[[Array], Array], numbers: Array) -> Array:
    """Return the derivatives (n, p) of a reaction by an effect's numbers."""
    if not kind.probes:
        return jax.jacfwd(of)(numbers)
    # the derivative vanishes nearly everywhere: the change over a quarter of what there is, or the least probe
    reach = jnp.maximum(jnp.abs(numbers) / 4, kind.probes[0])
    return jax.vmap(lambda e, h: (of(numbers + h * e) - of(numbers - h * e)) / (2 * h), out_axes=1)(
        jnp.eye(len(numbers)), reach
    )


def derivatives_by_numbers(kind: type[Effect], reaction: Callable[[Effect], Array], numbers: Array) -> Array:
    """Return the derivatives (n, q + i) of a reaction by an effect's coefficients and inner parameters."""

    def of(numbers):
        return reaction(kind(numbers[: kind.size], **dict(zip(kind.inner, numbers[kind.size :], strict=True))))

    return _slope(kind, of, numbers)
