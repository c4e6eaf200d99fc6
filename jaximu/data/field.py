"""The magnetic field, the same at all times: strength, angle to gravity, direction carried by the gyroscope.

A recording is cut into windows, each with the field's turning in it taken off by the gyroscope, so that the mean over a
window is linear in (A | c) of the magnetometer's inverse h = A y + c. Of every window the strength is known; from one
to the next the gyroscope carries the field's direction (Troni and Whitcomb 2013 in integrated form, so that nothing is
differentiated); against the measured up the field has one angle, the dip, which nobody needs to know, but may.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from jaximu.data.preintegration import turned_by_rates
from jaximu.estimation.covariance import BlockFactor, Covariance
from jaximu.estimation.data import About, Conditions, OfOneUnit
from jaximu.estimation.rows import TIME, ResidualKind, Rows
from jaximu.estimation.track import Track, added
from jaximu.ground import stored
from jaximu.ground.array_types import Array, BoolArray, FloatArray, IntArray
from jaximu.ground.distributions import rms, robust_sigma
from jaximu.ground.rotation import (
    IDENTITY,
    Number,
    Vector,
    exponential,
    inverse_matrix,
    rotate,
    rotations_of,
    unit_vectors,
)
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.ground.vectors import dot_rows, lengths_of
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.recording import Recording, Signal

EXCESS_NAMES = ("magnetometer", "carried field", "angle to gravity")
RESIDUALS = (
    ResidualKind("field_strength", "strength of the field", "uT", 1),
    ResidualKind("carried_field", "field carried over a turn", "uT", 2),
    ResidualKind("dip", "sine of the field's dip", "1", 1),
)
_UNITS = (0.1, 1e-3, 1e-2)
"""Standard deviation of each component at an excess of one: µT, rad (and a hundredth of the angle turned), rad."""
_TURN_SHARE = 0.01
_LEVEL = 1e2
"""Standard deviation of the sine of a dip that is not known."""
_MOST, _MOST_ALONE = 160, 480
"""Windows of a recording, with a gyroscope and without."""
_MEAN, _MEAN_ALONE = 0.5, 0.06
"""Seconds at the most over which a window is averaged, with a gyroscope and without."""
_SMOOTHED = 0.2  # s
_CALM = 0.1
"""Share of gravity by which the specific force may be off where it stands for the vertical."""
_STEADY = 0.02
"""rad of the field's path that a second at rest counts for, when windows are placed along it."""


class FieldConditions(Conditions):
    """Conditions of n windows: strength (µT), direction carried to the next window (µT), angle to gravity (a sine).

    slope: of the window's field in its own body frame by (A | c). carried: rotation from the next window's frame to
    this one's, and swept: how it turns with the rate (s); origin: the gyroscope's bias with which it was carried, which
    is estimated along. basis: two directions across the field. up: the measured specific force's direction. The masks
    say of which windows each condition is used. magnitude: the strength of the field, µT; sine: of its dip, zero where
    that is not known. alone: nothing but the strength is known, and the other conditions are not there.
    """

    slope: Float[Array, "n 3 3 4"]
    carried: Float[Array, "n 3 3"]
    swept: Float[Array, "n 3 3"]
    origin: Vector
    basis: Float[Array, "n 2 3"]
    up: Float[Array, "n 3"]
    window: Bool[Array, " n"]
    turn: Bool[Array, " n"]
    level: Bool[Array, " n"]
    magnitude: Number
    sine: Number
    alone: bool = eqx.field(static=True, default=False)

    def field(self, imu: Imu) -> Float[Array, "n 3"]:
        """Return the field (µT) of each window in its own body frame."""
        return jnp.einsum("nijk,jk->ni", self.slope, imu.triad("magnetometer").inverse())

    def __call__(self, imu: Imu) -> Float[Array, " 4*n"]:
        """Return the errors of the strength, of both components across the field, and of the sine of its dip."""
        return self.of(imu, self.field(imu))

    def of(self, imu: Imu, field: Float[Array, "n 3"]) -> Float[Array, " 4*n"]:
        """Return the same errors of any field (µT) of the windows."""
        length = jnp.sqrt((field**2).sum(axis=-1) + 1e-24)
        norm = jnp.where(self.window, length - self.magnitude, 0.0)
        if self.alone:
            return norm
        carried = jnp.einsum("nij,nj->ni", self.carried, jnp.roll(field, -1, axis=0))
        if imu.gyroscope is not None:
            rate = inverse_matrix(imu.gyroscope.gain) @ (self.origin - imu.gyroscope.bias)
            carried = rotate(exponential(self.swept @ rate), carried)
        across = jnp.where(self.turn[:, None], jnp.einsum("nci,ni->nc", self.basis, carried - field), 0.0)
        dip = jnp.where(self.level, (self.up * field).sum(axis=-1) / length + self.sine, 0.0)
        return jnp.concatenate([norm, across.ravel(), dip])


class FieldSamples(eqx.Module):
    """The samples of n windows, S of each, along which effects act.

    output (n, S, 3): as measured; turned (n, S, 3, 3): from the frame at a sample to the window's. track: what the unit
    went through but for the field, which its output tells; of no window where a window has fewer samples than others.
    """

    output: Float[Array, "n S 3"]
    turned: Float[Array, "n S 3 3"]
    track: Track

    @partial(stored.compiled, quick=True)
    def added(self, imu: Imu) -> Float[Array, "n S 3"]:
        """Return what the effects of a unit's magnetometer add to its output (output units)."""
        field = imu.triad("magnetometer").recover(self.output, self.track.stimulus)
        stimulus = replace(self.track.stimulus, magnetic_field=field)
        return added(imu, {"magnetometer": replace(self.track, stimulus=stimulus)})["magnetometer"]

    @partial(stored.compiled, quick=True)
    def mean_added(self, imu: Imu) -> Float[Array, "n 3 3 3"]:
        """Return its means over the windows, each sample's brought to its window's frame: by frame and output."""
        brought = self.turned[..., None] * self.added(imu)[..., None, None, :]
        return self.track.means(brought.reshape(*self.output.shape[:2], -1), len(self.output)).reshape(-1, 3, 3, 3)

    @classmethod
    def joined(cls, parts: Sequence[FieldSamples]) -> FieldSamples:
        """Return the samples of several recordings as one; what one of them lacks is unknown of all."""
        counts, size = [len(part.output) for part in parts], max(part.output.shape[1] for part in parts)
        total, first = sum(counts), np.cumsum([0, *counts])

        def together(leaves):
            grown = [np.pad(leaf, [(0, 0), (0, size - leaf.shape[1]), *[(0, 0)] * (leaf.ndim - 2)]) for leaf in leaves]
            return np.concatenate(grown)

        renumberings = [np.append(start + np.arange(count), total) for start, count in zip(first, counts, strict=False)]
        tracks = [part.track.renumbered(numbers) for part, numbers in zip(parts, renumberings, strict=True)]
        observation = together([track.observation - total for track in tracks]) + total  # padding is of none
        stimuli = [vars(track.stimulus) for track in tracks]
        inputs: dict[str, Any] = {
            name: together([stimulus[name] for stimulus in stimuli])
            for name in ("time", "temperature", "current", "angular_rate")
            if all(stimulus[name] is not None for stimulus in stimuli)
        }
        output, turned = (together([vars(part)[name] for part in parts]) for name in ("output", "turned"))
        return cls(output, turned, Track(Stimulus(**inputs), observation))


@dataclass(frozen=True)
class FieldWindows:
    """What was recorded, in n windows, the last axis of a slope for (A | c).

    output (n, 3): mean output in each; slope (n, 3, 3, 4), carried, swept (n, 3, 3) and up (n, 3) as in
    `FieldConditions`;
    off (n,): how far the specific force is from gravity, over gravity; angle (n,): rad turned to the next window;
    time (n, 2): s; count (n,): samples. used, turn, level (n,): which of them tell strength, turn and dip. noise: of a
    sample, output units. origin (3,): the gyroscope's bias, output units, that was taken off its rates. samples: of all
    windows, along which effects act.
    vertical (12, 12): covariance of what is wrong of the specific force f, (B f + b g) with (B row by row | b), which
    bends the measured up of all windows together.
    """

    output: FloatArray
    slope: FloatArray
    carried: FloatArray
    swept: FloatArray
    up: FloatArray
    off: FloatArray
    angle: FloatArray
    time: FloatArray
    count: FloatArray
    used: BoolArray
    turn: BoolArray
    level: BoolArray
    noise: float
    origin: FloatArray
    samples: FieldSamples
    vertical: FloatArray

    def __len__(self) -> int:
        return len(self.output)

    @property
    def alone(self) -> bool:
        """Whether there is no other sensor to compare with."""
        return not (self.turn.any() or self.level.any())

    def placed(self, strength: NDArray[Any], turn: NDArray[Any], dip: NDArray[Any]) -> NDArray[Any]:
        """Return numbers (n,) of strengths, turns and dips in the order of the conditions, of which a turn has two."""
        return strength if self.alone else np.concatenate([strength, turn.repeat(2), dip])

    def field(self, imu: Imu) -> FloatArray:
        """Return the field (n, 3), µT, that a unit's magnetometer makes of each window, in its body frame there."""
        return np.einsum("nijk,jk->ni", self.along(imu).slope, imu.triad("magnetometer").inverse())

    def added(self, imu: Imu) -> FloatArray:
        """Return what the effects of a unit's magnetometer add to each sample's output (n, S, 3), output units."""
        affected = imu.triad("magnetometer").effects
        return np.asarray(self.samples.added(imu)) if affected else np.zeros_like(self.samples.output)

    def along(self, imu: Imu) -> FieldWindows:
        """Return the same with what a unit's effects add taken off the samples."""
        if not imu.triad("magnetometer").effects:
            return self
        slope = np.array(self.slope)
        slope[..., :3] -= np.asarray(self.samples.mean_added(imu))
        return replace(self, slope=slope)

    @property
    def calm(self) -> BoolArray:
        """Which windows (n,) have a specific force that stands for the vertical."""
        return self.level & (self.off < _CALM)

    def bent(self, field: FloatArray) -> FloatArray:
        """Return how the sine (n,) of the angle from up to a field (n, 3) reacts to what `vertical` is of, (n, 12)."""
        along = unit_vectors(field)
        across = along - (along * self.up).sum(axis=1, keepdims=True) * self.up
        return np.hstack([np.einsum("ni,nj->nij", across, self.up).reshape(len(self), 9), across])

    def without(self, left_out: BoolArray) -> FieldWindows:
        """Return the same with some windows left out (n,)."""
        used = self.used & ~left_out
        following = np.append(used[1:], False)
        return replace(self, used=used, turn=self.turn & used & following, level=self.level & used)

    @classmethod
    def joined(cls, parts: Sequence[FieldWindows]) -> FieldWindows:
        """Return windows of several recordings of one unit as one."""
        names = ("output", "slope", "carried", "swept", "up", "off", "angle", "time", "count", "used", "turn", "level")
        together = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        noise = rms([part.noise for part in parts])
        samples = FieldSamples.joined([part.samples for part in parts])
        return cls(**together, noise=noise, origin=parts[0].origin, samples=samples, vertical=parts[0].vertical)


def white_noise(signal: Signal) -> float:
    """Return the standard deviation of a sample (output units) that differences of neighbours tell, and rounding."""
    third = np.diff(signal.values, n=3, axis=0)
    spread = robust_sigma(third - np.median(third, axis=0), axis=0) / np.sqrt(20.0)
    levels = [np.unique(axis[:20000]).tolist() for axis in signal.values.T]
    rounding = [min(np.diff(values).tolist(), default=0.0) / np.sqrt(12.0) for values in levels]
    return rms(np.maximum(spread, rounding))


def windows_of(
    signal: Signal, motion: Recording | None, origin: FloatArray, vertical: FloatArray | None = None
) -> FieldWindows:
    """Cut a magnetometer's samples (any unit) into windows, spread along the field's path over the sphere.

    `motion`: the same unit's specific force (m/s²) and, if known, angular rate (rad/s), corrected, on the same clock;
    `origin`: the gyroscope's bias (3,), output units, with which it was; `vertical`: as in `FieldWindows`, None for 0.
    """
    gyroscope = None if motion is None else motion.gyroscope
    time, values = signal.time, signal.values
    inside = np.ones(len(time), bool)
    for other in () if motion is None else (motion.accelerometer, gyroscope):
        if other is not None:
            inside &= (time >= other.time[0]) & (time <= other.time[-1])
    time, values = time[inside], values[inside]
    most, longest = (_MOST_ALONE, _MEAN_ALONE) if gyroscope is None else (_MOST, _MEAN)
    edges = _edges(time, values, signal.rate, most)
    stops = np.minimum(edges[1:], edges[:-1] + max(1, signal.samples(longest)))
    count = stops - edges[:-1]
    index = np.minimum(edges[:-1, None] + np.arange(count.max()), stops[:, None] - 1)
    weight = (np.arange(count.max()) < count[:, None]) / count[:, None]
    centre = (time[edges[:-1]] + time[stops - 1]) / 2
    turned, carried, swept, angle = _frames(gyroscope, centre, time[index])
    with_one = np.concatenate([values[index], np.ones((*index.shape, 1))], axis=2)
    slope = np.einsum("ns,nsij,nsk->nijk", weight, turned, with_one)
    up, off = np.zeros((len(centre), 3)), np.ones(len(centre))
    if motion is not None:
        mean = np.einsum("ns,nsij,nsj->ni", weight, turned, motion.accelerometer.at(time[index]))
        length = lengths_of(mean)
        up, off = mean / length[:, None], abs(length / STANDARD_GRAVITY - 1)
    known = {} if motion is None else motion.signals
    known = {name: part.at(time[index]) for name, part in known.items()}
    warm, flow = (known[name][..., 0] if name in known else None for name in ("temperature", "current"))
    stimulus = Stimulus(time=time[index], temperature=warm, current=flow, angular_rate=known.get("gyroscope"))
    window = np.where(weight > 0, np.arange(len(count))[:, None], len(count))
    samples = FieldSamples(values[index], turned, Track(stimulus, window))
    everywhere = np.ones(len(centre), bool)
    following = np.append(everywhere[1:], False)
    return FieldWindows(
        (weight[:, :, None] * values[index]).sum(axis=1),
        slope,
        carried,
        swept,
        up,
        off,
        angle,
        np.column_stack([time[edges[:-1]], time[edges[1:] - 1]]),
        count.astype(float),
        everywhere,
        following if gyroscope is not None else ~everywhere,
        everywhere if motion is not None else ~everywhere,
        white_noise(signal),
        origin,
        samples,
        np.zeros((12, 12)) if vertical is None else vertical,
    )


def _frames(
    gyroscope: Signal | None, centre: FloatArray, times: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return how windows stand, by the gyroscope: none of them turns without one.

    Rotations (n, S, 3, 3) from the samples' frames at `times` to the windows' at their `centre`, then (n, 3, 3) from
    the next window's to each one's, how that turns with the rate (s), and by how much it turns (n,), rad.
    """
    count = len(centre)
    turned, carried = (np.array(np.broadcast_to(np.eye(3), (*size, 3, 3))) for size in (times.shape, (count,)))
    swept, angle = np.zeros((count, 3, 3)), np.zeros(count)
    if gyroscope is not None:
        attitude, turned_until = _carried(gyroscope)
        middle = attitude(centre)
        back = middle.inv()
        frames = attitude(times.ravel()).as_matrix().reshape(turned.shape)
        turned = np.einsum("nij,nsjk->nsik", back.as_matrix(), frames)
        step = back[:-1] * middle[1:]
        carried[:-1], angle[:-1] = step.as_matrix(), step.magnitude()
        swept[:-1] = back[:-1].as_matrix() @ np.diff(turned_until(centre), axis=0)
    return turned, carried, swept, angle


def _edges(time: FloatArray, values: FloatArray, rate: float, most: int) -> IntArray:
    """Samples at which windows begin and end: equal lengths of the field's path, rests counting a little."""
    smooth = np.asarray(scipy.ndimage.uniform_filter1d(values, max(1, round(_SMOOTHED * rate)), axis=0))
    centred = smooth - (smooth.max(axis=0) + smooth.min(axis=0)) / 2
    every = max(1, round(_SMOOTHED * rate))
    path = lengths_of(np.diff(centred[::every], axis=0)) / np.median(lengths_of(centred))
    path = np.cumulative_sum(path + _STEADY * np.diff(time[::every]), include_initial=True)
    count = min(most, max(8, len(time) // every))
    edges = np.interp(np.linspace(0, path[-1], count + 1), path, np.arange(len(path)) * every)
    return np.unique(np.append(edges[:-1].astype(np.int64), len(time) - 1))


def _carried(gyroscope: Signal):
    """Return, of times, attitudes (SciPy rotations) and how far (n, 3, 3), s, rates off by a constant have turned them.

    Both against the frame in which the recording began.
    """
    edges, count = gyroscope.edges, len(gyroscope)
    padding = (0, (1 << count.bit_length()) - count)  # few shapes are compiled
    rates, held = np.pad(gyroscope.values, (padding, (0, 0))), np.pad(np.diff(edges), padding)
    running, sweep = (leaf[:count] for leaf in stored.call(turned_by_rates, "carried attitude", rates, held))
    frames = rotations_of(np.vstack([IDENTITY, running]))
    swept = np.cumulative_sum(sweep.reshape(-1, 9), axis=0, include_initial=True)
    reached = scipy.interpolate.make_interp_spline(edges, swept, k=1)
    return scipy.spatial.transform.Slerp(edges, frames), lambda times: reached(times).reshape(-1, 3, 3)


class _At(eqx.Module):
    """Where the effects' reactions are taken: the conditions there, and the samples."""

    conditions: FieldConditions
    samples: FieldSamples


@dataclass(frozen=True)
class MagneticField(OfOneUnit):
    """A unit's magnetometer in a field of the same strength (µT) and direction at all times.

    dip: of the field below the level, and its standard deviation, rad; None where it is not known.
    """

    windows: FieldWindows
    strength: float
    dip: tuple[float, float] | None = None

    excess_names = EXCESS_NAMES
    coarse = (1.0, 1.0, 1.0)

    def rows(self, imu: Imu) -> Rows:
        """Return what each condition is: strengths, two components of turns, dips; a turn leads to the next window."""
        windows, count = self.windows, len(self.windows)
        window = np.arange(count)
        middle = windows.time.mean(axis=1)
        kind = windows.placed(*np.arange(3).repeat(count).reshape(3, count))
        return Rows(
            kinds=RESIDUALS,
            kind=kind,
            first=windows.placed(window, window, window),
            last=windows.placed(window, (window + 1) % count, window),
            to_si=np.ones(len(kind)),
            used=windows.placed(windows.used, windows.turn, windows.level),
            covariates={TIME: windows.placed(middle, middle, middle)},
            spans=windows.time,
            observation="window",
        )

    def about_one(self, imu: Imu) -> About:
        """Return the conditions about the unit and their covariance."""
        windows, bare = self.windows.along(imu), imu.with_effects()
        field = windows.field(bare)
        basis = _across(field)
        conditions = FieldConditions(
            windows.slope,
            windows.carried,
            windows.swept,
            windows.origin,
            basis,
            windows.up,
            windows.used,
            windows.turn,
            windows.level,
            np.float64(self.strength),
            np.float64(0.0 if self.dip is None else np.sin(self.dip[0])),
            windows.alone,
        )
        covariance, details = self._covariance(bare, field, basis), _At(conditions, windows.samples)
        return About(conditions, covariance, self.own_columns(imu, details, len(covariance.used)), details)

    def reactions(self, details: _At):
        """Return how the conditions react to an effect of the magnetometer: its mean over each window, as a field."""

        def of(effect, imu, at):
            mean = at.samples.mean_added(imu.with_effects(effect))
            moved = jnp.einsum("nijk,jk->ni", mean, inverse_matrix(imu.magnetometer.gain))
            field = at.conditions.field(imu)
            return jax.jvp(lambda field: at.conditions.of(imu, field), (field,), (moved,))[1]

        return f"field {'alone' if self.windows.alone else 'carried'}", of, [details]

    def _common(self) -> float:
        """Standard deviation of the sine of the dip, an error that all windows share."""
        if self.dip is None:
            return _LEVEL
        dip, sigma = self.dip
        return float(np.hypot(np.cos(dip) * sigma, sigma**2 / np.sqrt(2)))  # the second where the field is vertical

    def _covariance(self, imu: Imu, field: FloatArray, basis: FloatArray) -> Covariance:
        """White noise that is known, and components: errors of a window, of a turn, of the measured up."""
        windows, n = self.windows, len(self.windows)
        length = lengths_of(field)
        along = field / length[:, None]
        window = np.arange(n)
        # what a window's field reaches: its norm, the turns after and before it, its angle to the vertical
        turns, before = n + 2 * window[:, None] + np.arange(2), (window - 1) % n
        places = np.hstack([window[:, None], turns, turns[before], 3 * n + window[:, None]])
        carried = (basis @ windows.carried)[before]
        level = (windows.up - dot_rows(windows.up, along)[:, None] * along) / length[:, None]
        values = np.hstack([along[:, None], -basis, carried, level[:, None]])
        rows = self.rows(imu)
        used, group = rows.used.astype(float), rows.kind
        kinds = slice(1 if windows.alone else None)
        places = places[:, kinds]
        values = values[:, kinds] * used[places][..., None]
        inverse = np.linalg.inv(imu.triad("magnetometer").gain)
        shaken = BlockFactor(places, values * (windows.noise / np.sqrt(windows.count))[:, None, None] @ inverse)
        turned = _UNITS[1] * (1 + _TURN_SHARE / _UNITS[1] * windows.angle) * length
        sizes = windows.placed(np.full(n, _UNITS[0]), turned, _UNITS[2] + windows.off) * used
        level = np.where(group == 2, used, 0.0)
        roots = [np.where(group == k, sizes, 0.0) for k in range(3)]  # independent: the roots alone
        factors = roots if windows.alone else [BlockFactor(places, _UNITS[0] * values), *roots[1:]]
        measured = shaken.component(len(used)) + self._common() ** 2 * np.outer(level, level) + np.diag(1e-9 * used)
        if not windows.alone:
            bent = windows.bent(field) * windows.level[:, None]
            # what the hand and the accelerometer's errors do to its length, they do across it, where nothing shows it
            shaken_up = robust_sigma(windows.off) * lengths_of(bent[:, 9:])
            measured[3 * n :, 3 * n :] += bent @ windows.vertical @ bent.T + np.diag(shaken_up**2)
        return Covariance(measured, tuple(factors), used, group)


def _across(field: FloatArray) -> FloatArray:
    """Two unit vectors (n, 2, 3) across each vector and each other."""
    along = unit_vectors(field)
    first = unit_vectors(np.cross(along, np.eye(3)[abs(along).argmin(axis=1)]))
    return np.stack([first, np.cross(along, first)], axis=1)
