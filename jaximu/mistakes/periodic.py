"""`data.periodic` and `data.bandwidth`: sharp lines at rest, and noise that a filter has taken away."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy

from jaximu.ground.array_types import BoolArray, FloatArray
from jaximu.ground.distributions import gamma_mean_sf
from jaximu.ground.quantities import size
from jaximu.mistakes.base import Samples, Sensor
from jaximu.mistakes.resampled import held_at, interpolated_at
from jaximu.recordings.alignment import of_each
from jaximu.recordings.finding import Finding
from jaximu.recordings.recording import runs_of

TITLES = {"data.periodic": "periodic disturbance", "data.bandwidth": "low-pass filter"}


def find(samples: Samples) -> Iterator[Finding]:
    """Return lines in the spectrum at rest, and a spectrum that falls off far below half the rate."""
    for sensor in samples.sensors.values():
        parts = _still_parts(samples, sensor)
        if parts is None or len(parts) < 6:
            continue
        spectrum = np.fft.rfft(parts.swapaxes(1, 2) * np.hanning(parts.shape[1]), axis=2)
        power = np.mean(spectrum.real**2 + spectrum.imag**2, axis=0).T
        yield from _lines(sensor, parts, power)
        yield from _bandwidth(samples, sensor, power, *parts.shape[:2])


def _lines(sensor: Sensor, parts: FloatArray, power: FloatArray) -> Iterator[Finding]:
    """Sharp lines in the spectrum (f, 3) of the quieter half of the recording."""
    if len(parts) < 12:
        return
    width = parts.shape[1]
    for axis, density in enumerate(power.T):
        noisy = np.median(density) > 1e-20 * np.mean(sensor.values[:, axis] ** 2)
        if sensor.coarse[axis] is not None or not noisy:
            continue  # rounding makes lines, too
        highest = density >= scipy.ndimage.maximum_filter1d(density, 2 * _LOBE + 1)  # else the flank of a hump
        ratios = np.where(highest, density / _beside(density), 0.0)
        peak = np.argmax(ratios)
        ratio = ratios[peak]
        # a bin's mean over k blocks is gamma with shape k (windowed blocks do not overlap)
        if ratio > 4 and gamma_mean_sf(ratio, len(parts)) * len(power) < 1e-6:
            frequency = peak * sensor.rate / width
            high = size(float(2 * np.sqrt(density[peak]) / np.sum(np.hanning(width))), sensor.unit, 2)
            yield Finding(
                "data.periodic",
                (),
                f"{sensor.name} {'xyz'[axis]}: a line near {frequency:.3g} Hz of about {high} at rest, "
                f"{ratio:.0f} times the noise around it: a motor, the mains, or an alias of one.",
            )


_LOBE = 2
"""Bins on either side that a line reaches into, Hann's window on the samples."""
_SIDE = 7


def _beside(power: FloatArray) -> FloatArray:
    """Return the power (n,) beside each bin, of the side that has more: bias drift and sway rise to low frequencies.

    A line stands out from both sides, at the upper end from one. Infinite at the lower end, which the trend took.
    """
    beside, whole = np.full(len(power), np.inf), np.zeros(0)
    if len(power) >= _SIDE:
        whole = np.median(np.lib.stride_tricks.sliding_window_view(power, _SIDE), axis=1)

    def usual(start: int, stop: int) -> float:
        if stop - start == _SIDE:
            return float(whole[start])
        return float(np.median(power[start:stop])) if stop > start else 0.0

    for index in range(2 * _LOBE + 2, len(power) - _LOBE):
        low, high = index - _LOBE, index + _LOBE + 1
        beside[index] = max(usual(max(_LOBE, low - _SIDE), low), usual(high, min(high + _SIDE, len(power))), 1e-300)
    return beside


_FALL = 0.12
"""Noise density near half the rate over that at low frequencies, below which a filter shows."""
_FALL_AT_REST = 0.35
"""The same of a unit at rest, whose spectrum is noise alone: one pole at 0.4 times half the rate leaves 0.31."""
_SURE = 10.0
"""Nats that a pole must explain of a spectrum at rest beyond what a power of frequency does."""
_ORDERS, _FAR_ABOVE = 7, 30.0
"""Poles that a filter has less than; times the density of rounding from which on a floor of the spectrum is noise."""
_WHITE = 20.0
"""Nats that such a floor must explain beyond what poles alone do, whose shape is not exactly that of any filter."""
_HARMLESS = 20.0
"""Hz from which on a filter does nothing to motion by hand; at rest it changes the noise at any corner."""
_SLOPE = -1.2
"""Slope of the logarithm of the density over that of frequency in the upper part: white noise has 0, one pole −2."""


def _bandwidth(samples: Samples, sensor: Sensor, power: FloatArray, count: int, width: int) -> Iterator[Finding]:
    """A spectrum (f, 3), of so many parts of so many samples, that falls off far below half the rate."""
    if held_at(sensor) is not None or interpolated_at(sensor) is not None:
        return
    if np.any(sensor.noise < 3 * sensor.step) and any(sensor.coarse):
        return
    if not samples.posed and not samples.rested:  # what looks quiet on a vehicle is vibration, which is no white noise
        return
    floor = sensor.step**2 / 12 * np.sum(np.hanning(width) ** 2)
    frequency = np.arange(len(power)) * sensor.rate / width
    half = sensor.rate / 2
    corners = []
    for axis, density in enumerate(power.T):
        low = np.max(scipy.ndimage.median_filter(density[2 : len(density) // 2], 5)[2:-2], initial=0.0)
        if not low > _FAR_ABOVE * max(floor[axis], 1e-30):
            continue
        upper = (frequency > 0.3 * half) & (frequency < 0.95 * half)
        top = np.median(density[frequency > 0.85 * half])
        if top > (_FALL_AT_REST if samples.rested else _FALL) * low:
            continue
        slope = np.polyfit(np.log(frequency[upper]), np.log(np.maximum(density[upper], floor[axis] + 1e-30)), 1)[0]
        below = np.flatnonzero(scipy.ndimage.median_filter(density, 3, mode="constant")[2:] < low / 2) + 2
        corner = float(frequency[below[0]]) if len(below) else half
        # a corner far below: what is left above may be flat again, by rounding or by an imperfect filter
        deep = top < 1e-3 * low and top < _FAR_ABOVE * floor[axis]
        if not samples.rested and _falls_to_white_noise(density, count, floor[axis]):
            continue
        falls = slope < _SLOPE or (samples.rested and _has_pole(density, count))
        if (falls or deep) and corner < (0.6 * half if samples.rested else min(0.45 * half, _HARMLESS)):
            corners.append(corner)
    if len(corners) < 3 or max(corners) > 2 * min(corners):  # a filter acts on all axes alike
        return
    corner = float(np.median(corners))
    spoils = corner < 4.0 and not samples.rested
    cure = "Turn slowly, or choose a wider filter."
    if samples.rested:
        cure = "What it took away is not known; a wider filter shows it."
    elif spoils:
        cure = "Turns are quicker than that: choose a filter of 20 Hz or more, and record again."
    yield Finding(
        "data.bandwidth",
        (),
        f"{sensor.name}: its noise at rest falls off above some {corner:.2g} Hz, far below the {half:.4g} Hz that "
        f"{sensor.rate:.4g} samples a second could show: a low-pass filter is on. {cure}",
        spoils=spoils,
        numbers={sensor.name: corner},
    )


def _has_pole(density: FloatArray, count: int) -> bool:
    """Whether one pole explains the mean (f,) of so many spectra better than a power of frequency, as drift has."""
    index = np.arange(_LOBE + 1, len(density) - 1)
    turn = np.sin(np.pi / 2 * index / (len(density) - 1)) ** 2

    def cost(shape: FloatArray) -> float:
        """Minus the log-likelihood (Whittle's) of a shape of the spectrum, nats."""
        return count * len(index) * float(np.mean(np.log(shape)) + np.log(np.mean(density[index] / shape)))

    poles = [cost(1 / (1 + turn / corner)) for corner in np.geomspace(turn[0], 1.0, 30)]
    return min(poles) + _SURE < min(cost(index**-power) for power in np.linspace(0.0, 3.0, 31))


def _falls_to_white_noise(density: FloatArray, count: int, rounding: float) -> bool:
    """Whether the mean (f,) of so many spectra falls to white noise far above rounding, as a hand's motion does.

    A filter takes the noise away with the motion: above its corner the density goes on falling, by some poles.
    """
    peak = int(np.argmax(scipy.ndimage.median_filter(density, 5)[_LOBE:-_LOBE])) + _LOBE
    index = np.arange(max(peak, _LOBE + 1), len(density) - 1)
    part, share = density[index], index / (len(density) - 1)
    steps = np.stack([share, np.sin(np.pi / 2 * share)]) ** 2  # of a filter ahead of the sampling, and of one behind it
    corners = np.geomspace(steps[1, 0], 1.0, 30)
    poles = 1 / (1 + steps[:, None] / corners[:, None])
    falls = np.concatenate([poles**order for order in range(1, _ORDERS)]).reshape(-1, 1, len(index))
    levels = np.concatenate([[0.0], np.geomspace(1e-8, 1.0, 33)])
    shapes = falls + levels[:, None]
    amplitude = np.mean(part / shapes, axis=2)
    cost = count * len(index) * (np.mean(np.log(shapes), axis=2) + np.log(amplitude))
    fall, level = np.unravel_index(np.argmin(cost), cost.shape)
    white = amplitude[fall, level] * levels[level]
    return bool(cost[:, 0].min() - cost[fall, level] > _WHITE and white > _FAR_ABOVE * rounding)


def _still_parts(samples: Samples, sensor: Sensor) -> FloatArray | None:
    """Return pieces (k, width, 3) of the rests, straight lines taken off: as long as leaves a dozen of them."""
    still = sensor.quiet & samples.quiet_at(sensor)
    runs = runs_of(still)
    for width in (256, 128, 64, 32):
        margin = width // 8
        starts = [row for a, b in runs for row in range(a + margin, b - width - margin + 1, width)]
        if len(starts) >= 24 or (width == 32 and len(starts) >= 6):
            starts = np.array(starts[:: max(1, len(starts) // 200)])
            return _detrended(sensor.values[starts[:, None] + np.arange(width)]) if _rest(samples, still) else None
    return None


_SHAKEN = {"accelerometer": 1.5, "gyroscope": 0.3}
"""m/s² and rad/s: rms of quiet stretches beyond which they are motion, a walk's quieter part, and no rest."""


def _rest(samples: Samples, still: BoolArray) -> bool:
    """Whether the quiet stretches of a recording are rest, and not merely quieter than the others."""
    for name, sensor in samples.sensors.items():
        if len(sensor) == len(still):
            runs = runs_of(still)
            runs = runs[runs[:, 1] - runs[:, 0] > 7]
            if not len(runs):
                continue
            if np.median(np.sum(of_each(np.var, sensor.values, runs), axis=1)) > _SHAKEN[name] ** 2:
                return False
    return True


def _detrended(parts: FloatArray) -> FloatArray:
    """Take a straight line off each part (k, n, 3)."""
    time = np.linspace(-1.0, 1.0, parts.shape[1])[:, None]
    centred = parts - parts.mean(axis=1, keepdims=True)
    return centred - time * (np.sum(time * centred, axis=1, keepdims=True) / np.sum(time**2))
