"""What each condition of a measurement is: what it compares, what it touches, when, and in which unit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from jaximu.ground.array_types import BoolArray, FloatArray, IntArray
from jaximu.ground.distributions import rms

Sizes = dict[str, tuple[float, str]]
"""Of errors, by name: a size and its unit."""

TIME, TEMPERATURE = "time [s]", "temperature [°C]"
"""The covariate that all conditions have, and the one that those with a thermometer have."""

Fold = tuple[IntArray, BoolArray]
"""The conditions (m,), by place, that are left out together, and which of them (m,) are predicted."""


class ResidualKind(NamedTuple):
    """A kind of condition: its name, in words, the unit its rms is told in, how many components make one vector.

    `factor` turns the condition's SI into that unit; `centred`: a common offset is taken off before the rms.
    """

    name: str
    words: str
    unit: str
    components: int
    factor: float = 1.0
    centred: bool = False


def by_axis(name: str, unit: str, vectors: FloatArray) -> dict[str, FloatArray]:
    """Return the axes of vectors (n, 3) as covariates, by name with unit."""
    return {f"{name} {axis} [{unit}]": column for axis, column in zip("xyz", vectors.T, strict=True)}


@dataclass(frozen=True)
class Rows:
    """What each of n conditions is; observations are poses, stations, windows or blocks, in the order of time.

    kinds: what conditions there are; kind (n,): which of them. first, last (n,): the observations that a condition
    touches. to_si (n,): factor from its unit to SI. used (n,): false for padding. covariates: what its error may depend
    on, (n,) by name with unit, NaN where it has none; TIME is always there. spans (o, 2): start and stop of the
    observations, s; observation: what one is called.
    """

    kinds: tuple[ResidualKind, ...]
    kind: IntArray
    first: IntArray
    last: IntArray
    to_si: FloatArray
    used: BoolArray
    covariates: dict[str, FloatArray]
    spans: FloatArray
    observation: str = "pose"

    def __len__(self) -> int:
        return len(self.kind)

    def real(self) -> Rows:
        """Return the rows that are no padding."""
        arrays = {name: getattr(self, name)[self.used] for name in ("kind", "first", "last", "to_si", "used")}
        return replace(self, **arrays, covariates={name: x[self.used] for name, x in self.covariates.items()})

    def of_kind(self, name: str) -> BoolArray:
        """Return which rows (n,) are of the kind of that name."""
        return np.equal(self.kind, [kind.name for kind in self.kinds].index(name))

    def touching(self, observations: Sequence[int] | IntArray) -> BoolArray:
        """Return which rows (n,) touch one of the observations."""
        return np.isin(self.first, observations) | np.isin(self.last, observations)

    def parts(self, count: int, interleaved: bool = False) -> list[IntArray]:
        """Return the observations in so many parts to be left out in turn: in the order of time, or dealt out."""
        observations = np.arange(int(self.last.max()) + 1)
        return [observations[k::count] for k in range(count)] if interleaved else np.array_split(observations, count)

    def folds(self, parts: Sequence[IntArray]) -> list[Fold]:
        """Return what is left out with each part, and predicted with it: what touches it, and what begins in it."""
        rows = [np.flatnonzero(self.touching(part)) for part in parts]
        return [(out, np.isin(self.first[out], part)) for out, part in zip(rows, parts, strict=True) if len(out)]

    def dependences(self, index: int) -> dict[str, FloatArray]:
        """Return the covariates (v,) of the vectors of a kind: its time, and those that are known and change."""
        first = np.flatnonzero(self.kind == index)[:: self.kinds[index].components]
        values = {name: whole[first] for name, whole in self.covariates.items()}
        return {name: x for name, x in values.items() if name == TIME or np.ptp(x) > 0.1}

    def describe(self, observation: int) -> str:
        """Name an observation by its time."""
        start, stop = self.spans[observation]
        return f"the {self.observation} from {start:.1f} to {stop:.1f} s"

    def errors(self, conditions: FloatArray) -> list[FloatArray]:
        """Return the errors (v,) of each kind, in its unit: lengths of its vectors, or scalars with a sign."""
        errors = []
        for index, kind in enumerate(self.kinds):
            vectors = (conditions * self.to_si)[self.kind == index].reshape(-1, kind.components)
            vectors = vectors - vectors.mean(axis=0) if kind.centred and len(vectors) else vectors
            errors.append(kind.factor * (vectors[:, 0] if kind.components == 1 else np.linalg.norm(vectors, axis=1)))
        return errors

    def rms(self, conditions: FloatArray) -> Sizes:
        """Return the rms of the errors of each kind that is there, with its unit."""
        return {
            kind.name: (float(rms(errors)), kind.unit)
            for kind, errors in zip(self.kinds, self.errors(conditions), strict=True)
            if len(errors)
        }
