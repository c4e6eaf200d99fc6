"""A time course that gyroscopes of several units have in common: the session's fault, and no unit's.

It is the first principal component of the units' rates at rest, less what follows orientation. It is compared with what
drift as large and as slow in each unit, but independent, has in common by chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaximu.diagnosis.drift import DRAWS
from jaximu.diagnosis.evidence import FEWEST_DIMENSIONS
from jaximu.estimation.leave_out import off, orthonormal
from jaximu.ground.array_types import FloatArray
from jaximu.ground.differences import interpolated
from jaximu.ground.distributions import rms
from jaximu.ground.document import Json, entries
from jaximu.ground.errors import NotPossibleError

COMMON_DRIFT = "session.common_drift"


@dataclass(frozen=True)
class RestingRates:
    """What the gyroscope of a unit reads at rest in a session.

    times (o,): middles of the rests, s. up (o, 3): direction of specific force. rates (1 + draws, o, 3): as measured,
    and as noise draws them, rad/s.
    """

    unit: str
    session: str
    times: FloatArray
    up: FloatArray
    rates: FloatArray

    @classmethod
    def of_means(
        cls, unit: str, session: str, times: FloatArray, up: FloatArray, means: FloatArray, random: np.random.Generator
    ) -> RestingRates:
        """Return rates whose draws are white noise of any size: a common drift asks for what is as slow as measured."""
        return cls(
            unit, session, times, up, np.concatenate([means[None], random.standard_normal((DRAWS, *means.shape))])
        )

    def drift(self, times: FloatArray) -> FloatArray:
        """Return the rates (1 + draws, t, 3) at other times, less their means and what follows orientation."""
        basis = _orientation(self.up)
        values = self.rates - np.einsum("or,pr,kpi->koi", basis, basis, self.rates)
        values = np.einsum("to,koi->kti", interpolated(self.times, np.eye(len(self.times)), times), values)
        return values - values.mean(axis=1, keepdims=True)


@dataclass(frozen=True)
class CommonDrift:
    """A time course that the rates at rest of all units of a session have in common, beside what follows orientation.

    times (o,): s, on the clock of the recordings. curve (o,): rad/s, in a usual axis; what orientation could imitate of
    it is as smooth as can be. share: of the variance of all axes. common: the same, each axis in units of its standard
    deviation. chance: the median of that where drift is independent, as large and as slow in each axis as it is there.
    p_value: that it then has as much in common. loadings: by unit, what its axes (3,) do in multiples of the curve.
    axes (k, o): the drift of each axis that has a part in it, in multiples of its part, rad/s.
    """

    session: str
    times: FloatArray
    curve: FloatArray
    share: float
    common: float
    chance: float
    p_value: float
    loadings: dict[str, FloatArray]
    axes: FloatArray

    @classmethod
    def of(cls, units: Sequence[RestingRates], random: np.random.Generator) -> CommonDrift:
        """Return what units of a session have most in common in time, whether by chance or not.

        Raises `NotPossibleError` where they share no time.
        """
        times = _common_times(units)
        rates = np.concatenate([unit.drift(times) for unit in units], axis=2)
        up = interpolated(units[0].times, units[0].up, times)
        if len(rates) > 1:
            rates[1:] = _as_slow(rates, times, up, random)
        courses, shares = _principal(rates)
        loadings = courses[0] @ rates[0]
        usual = rms(loadings) * (np.sign(courses[0][0]) or 1.0)
        pace = 1 / np.sqrt(np.diff(times))
        steep = np.linalg.lstsq(pace[:, None] * np.diff(up, axis=0), pace * np.diff(courses[0]), rcond=None)[0]
        curve = usual * (courses[0] - up @ steep)
        return cls(
            units[0].session,
            times,
            curve - curve.mean(),
            float(np.sum(loadings**2) / np.sum(rates[0] ** 2)),
            float(shares[0]),
            float(np.median(shares[1:])) if len(rates) > 1 else 0.0,
            float(np.mean(shares >= shares[0])),
            {one.unit: row / usual for one, row in zip(units, loadings.reshape(-1, 3), strict=True)},
            usual * (rates[0] / loadings).T[np.abs(loadings) > abs(usual) / 2] - usual * (up @ steep),
        )

    @property
    def size(self) -> float:
        """By how much the rate of a usual axis changes, rad/s."""
        return float(np.ptp(self.curve))

    def document(self) -> Json:
        """Return it as `diagnosis.json` and the document of a fleet have it."""
        return {
            **entries(self, "session", "times", "share", "common", "p_value"),
            "rate": self.curve.tolist(),
            "common_by_chance": self.chance,
            "loadings": {unit: row.tolist() for unit, row in self.loadings.items()},
        }


def _common_times(units: Sequence[RestingRates]) -> FloatArray:
    """Return the middles of the rests (o,) of the recording with the fewest, where all recordings go on."""
    first = max(unit.times[0] for unit in units)
    last = min(unit.times[-1] for unit in units)
    shortest = min((unit.times for unit in units), key=len)
    times = shortest[(shortest >= first) & (shortest <= last)]
    if len(times) < FEWEST_DIMENSIONS:
        raise NotPossibleError(
            f"session {units[0].session}: its recordings have {len(times)} rests at the same time by their clocks; a "
            "time course that units have in common needs one clock for all units of a session."
        )
    return times


def _orientation(up: FloatArray) -> FloatArray:
    """Return orthonormal columns (o, r) of what follows orientation, a constant included."""
    return orthonormal(np.concatenate([np.ones((len(up), 1)), up], axis=1))


def _as_slow(rates: FloatArray, times: FloatArray, up: FloatArray, random: np.random.Generator) -> FloatArray:
    """Return the draws among rates (1 + draws, o, k), independent random walks added, as slow as the measured axes.

    Drift that a recording shows is pulled towards what is usual; draws that are too quick have too little in common.
    As slow: their autocorrelation from rest to rest is that of the measured axes, a standard error added.
    """
    steps = np.sqrt(np.diff(times, prepend=2 * times[0] - times[1]))[:, None]
    walks = np.cumsum(steps * random.standard_normal(rates[1:].shape), axis=1)
    walks = off(_orientation(up), walks)
    scaled, walks = (values / np.maximum(np.std(values, axis=1, keepdims=True), 1e-300) for values in (rates, walks))
    measured, drawn, walking = (
        np.mean(values[:, 1:] * values[:, :-1], axis=1) for values in (scaled[:1], scaled[1:], walks)
    )
    wanted = np.mean(measured) + np.std(measured) / np.sqrt(measured.size)
    slow, quick = np.mean(walking) - wanted, wanted - np.mean(drawn)
    return scaled[1:] + np.sqrt(max(quick, 0.0) / max(slow, 1e-3)) * walks


def _principal(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the first principal component (..., t), of length one, of axes (..., t, k), and its share of variance."""
    scaled = values / np.maximum(np.std(values, axis=-2, keepdims=True), 1e-300)
    u, s, _ = np.linalg.svd(scaled, full_matrices=False)
    return u[..., :, 0], s[..., 0] ** 2 / np.sum(s**2, axis=-1)
