"""A triad at rest over temperature: mean outputs over blocks of time less their level and what effects add to them.

The unit lies still in each rest, in a pose that nothing tells exactly: only what changes within a rest is evidence, and
of the levels of the rests their mean, which is the bias of the unit that is fitted (for an accelerometer with what
gravity adds to it). Noise is known up to an excess of each axis, which widens all of it.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaximu.estimation.covariance import Covariance
from jaximu.estimation.data import About, Conditions, OfOneUnit, derivatives_by_numbers, free_columns
from jaximu.estimation.track import Track
from jaximu.ground import stored
from jaximu.ground.array_types import Array, FloatArray, IntArray
from jaximu.ground.rotation import Number
from jaximu.model.effects import CATALOGUE, Effect
from jaximu.model.sensor import Imu

_ROWS = 256
"""Blocks are padded to a multiple of so many: few shapes to compile."""


class _WhiteOutputs(Conditions):
    """White combinations of mean outputs without what effects add, less those of the bias.

    magnitude: of nothing, as at rest gravity is a part of the levels.
    """

    output: Float[Array, " n"]
    bias: Float[Array, "n 3"]
    magnitude: Number
    gyroscope: Int[Array, ""]

    def __call__(self, imu: Imu) -> Float[Array, " n"]:
        """Return the combinations, axis after axis."""
        bias = jnp.where(self.gyroscope == 1, imu.triad("gyroscope").bias, imu.accelerometer.bias)
        return self.output - self.bias @ bias


class RestOverTemperature(OfOneUnit):
    """Mean outputs (n, 3) of one triad over blocks at rest, in output units.

    **Arguments:** `weights` (3, n, n): by axis, whiten the outputs' noise. `level` (n,): the rest of each block.
    `tracks`: of each recording. Effects are those that temperature and force have on the triad's output.
    """

    coarse = (0.0, 0.0, 0.0)

    def __init__(self, triad: str, output: FloatArray, weights: FloatArray, level: IntArray, tracks: Sequence[Track]):
        self.triad, self.output, self.paths = triad, output, tracks
        member = np.eye(int(level.max()) + 1)[level]
        apart = member[:, 1:] - member[:, :1]  # levels that add up to nothing: their mean is the bias
        self.weights = weights
        if apart.shape[1]:  # combinations that no level moves
            whole = np.linalg.qr(weights @ apart, mode="complete")[0]
            self.weights = whole[:, :, apart.shape[1] :].mT @ weights
        self._length = padded_count(self.weights.shape[1])  # of an axis
        used = np.zeros((3, self._length))
        used[:, : self.weights.shape[1]] = 1.0
        factors = tuple((used * axis[:, None]).ravel() for axis in np.eye(3))
        group = np.arange(3).repeat(self._length)
        self.covariance = Covariance(np.ones(3 * self._length), factors, used.ravel(), group)
        self.bias = self._white(np.tile(np.eye(3), (len(output), 1, 1)))

    def about_one(self, imu: Imu) -> About:
        """Return the outputs without what the effects of the unit add to them."""
        added, slopes = mean_terms(tuple(imu.all_effects().values()), self.paths, len(self.output))
        output = self._white((self.output - added)[:, :, None])[:, 0]
        conditions = _WhiteOutputs(output, self.bias, np.float64(0.0), np.int64(self.triad == "gyroscope"))
        return About(conditions, self.covariance, self._white(-slopes))

    def _white(self, values: FloatArray) -> FloatArray:
        """Return (3 rows, q) of values (n, 3, q) by block and axis."""
        white = np.zeros((3, self._length, values.shape[2]))
        white[:, : self.weights.shape[1]] = self.weights @ values.transpose(1, 0, 2)
        return white.reshape(3 * self._length, -1)


def mean_terms(effects: Sequence[Effect], tracks: Sequence[Track], count: int) -> tuple[FloatArray, FloatArray]:
    """Return what a triad's effects add to means over blocks (n, 3), and its derivatives (n, 3, q) by their numbers.

    In output units; numbers are in the order of `effect_numbers`.
    """
    added, slopes = np.zeros((count, 3)), [np.zeros((count, 3, 0))]
    for effect in effects:
        numbers = np.concatenate([effect.coefficients, [float(getattr(effect, name)) for name in effect.inner]])
        value, slope = over_blocks(effect.plain, numbers[None], tracks, count, slopes=True)
        added += value[0]
        slopes.append(slope[0])
    return added, free_columns(dict(enumerate(effects)), np.concatenate(slopes, axis=2))


def over_blocks(
    plain: str, numbers: FloatArray, tracks: Sequence[Track], count: int, slopes: bool = False
) -> list[FloatArray]:
    """Return what an effect adds to means over blocks (G, n, 3) at numbers (G, q + i), coefficients and inner ones.

    **Arguments:** `plain`: the effect's name, alike for both triads. `slopes`: the derivatives (G, n, 3, q + i), too.
    """
    kind, rows = CATALOGUE[f"accel.{plain}"], padded_count(count)  # its term is the gyroscope's: half as many programs

    def means(track, numbers):
        def of(varied):
            return track.means(varied.term(track.stimulus), rows)

        def at(numbers):
            inner = dict(zip(kind.inner, numbers[kind.size :], strict=True))
            value = of(kind(numbers[: kind.size], **inner))
            return (value, derivatives_by_numbers(kind, of, numbers)) if slopes else (value,)

        return jax.lax.map(at, numbers)

    parts = [stored.call(means, f"rest {kind.name} {rows} {slopes}", track, numbers) for track in tracks]
    return [np.sum(values, axis=0)[:, :count] for values in zip(*parts, strict=True)]


def padded_count(count: int) -> int:
    """Return a number of blocks, and a few more that are none: few numbers, few programs."""
    return -(-count // _ROWS) * _ROWS
