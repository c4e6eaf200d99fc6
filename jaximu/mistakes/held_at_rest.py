"""`data.auto_zero`: a driver that sets the gyroscope to zero at rest, or takes its running mean off."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jaximu.ground.array_types import BoolArray
from jaximu.ground.quantities import size
from jaximu.mistakes.base import Samples, Sensor, with_signal
from jaximu.recordings.alignment import of_each
from jaximu.recordings.finding import Finding
from jaximu.recordings.recording import Recording

TITLES = {"data.auto_zero": "automatic zero at rest"}

_COARSE = np.radians(0.2)
"""Step, rad/s, that noise and bias of a gyroscope at rest need not reach."""
_FEWEST = 5
"""Rests after turns, that show a running mean."""


def zeroed_at_rest(samples: Samples) -> float | None:
    """Return the share of the gyroscope's samples at rest that are exactly zero, where its driver sets them so."""
    sensor = samples.gyroscope
    if sensor is None:
        return None
    if sensor.dead_band is not None:
        return sensor.dead_band[0]
    if samples.accelerometer is None:
        return None
    rest = samples.quiet_at(sensor)
    zero = (sensor.signal.values == 0.0).all(axis=1)
    if rest.sum() < 50 or rest.mean() > 0.98 or zero.sum() < 50:
        return None
    share = zero[rest].mean()
    if share < 0.5 or zero[~rest].mean() > 0.5 * share:
        return None
    # coarse steps round a small bias to zero as well: what moves comes in the same steps, or they are larger than noise
    moving = np.abs(sensor.curvature[~rest])
    if np.any(np.median(moving, axis=0) < 1.5 * sensor.step) or np.min(sensor.step) > _COARSE:
        return None
    return share


def find(samples: Samples) -> Iterator[Finding]:
    """Return a gyroscope that is set to zero, held, or drawn to zero at rest."""
    sensor = samples.gyroscope
    if sensor is None:
        return
    zero = sensor.signal.values == 0.0
    if sensor.dead_band is not None:
        share, least = sensor.dead_band
        text = (
            f"gyroscope: {100 * share:.0f} % of an axis's samples are exactly zero, and none of the others is "
            f"smaller than {size(least, 'rad/s', 2)}: its driver zeroes it at rest (a dead band), so neither its "
            "bias nor its noise is known. Switch the dead band off and record again."
        )
        yield _finding(sensor, zero.any(axis=1), text, "gyroscope" if samples.rested else "")
        return
    if samples.accelerometer is None:
        return
    share = zeroed_at_rest(samples)
    if share is not None:
        text = (
            f"gyroscope: {100 * share:.0f} % of its samples at rest are exactly zero, but it moves freely in turns: "
            "its driver zeroes it at rest, so its bias in turns is unknown. Switch the automatic zero off and record "
            "again."
        )
        yield _finding(sensor, zero.all(axis=1), text)
        return
    rest = samples.quiet_at(sensor)
    held = _held(samples, sensor, rest)
    if held is not None:
        text = (
            f"gyroscope: its noise at rest is {100 * held:.2g} % of that in motion: its driver holds it at rest, so "
            "its bias in turns is unknown. Switch the automatic zero off and record again."
        )
        yield _finding(sensor, rest, text)
        return
    yield from _high_passed(samples, sensor)


def _finding(sensor: Sensor, concerned: BoolArray, text: str, refuses: str = "") -> Finding:
    return Finding("data.auto_zero", sensor.rows([np.argmax(concerned)]), text, spoils=True, refuses=refuses)


def _held(samples: Samples, sensor: Sensor, rest: BoolArray) -> float | None:
    """Return the noise at rest as a share of that in motion, where it is hardly any."""
    if rest.sum() < 100 or (~rest).sum() < 100 or any(sensor.coarse):
        return None
    still = samples.accelerometer
    if still is None or np.min(still.noise) < 1e-6 or sensor.even.mean() < 0.9:  # a simulation without noise, or bursts
        return None
    at_rest, moving = (np.median(np.abs(sensor.curvature[which]), axis=0) for which in (rest, ~rest))
    # in fast turns at a low rate the motion itself is not smooth: what differs a thousandfold is no motion
    ratio = np.max(at_rest / np.maximum(moving, 1e-300))
    return ratio if ratio < 1e-3 and np.all(moving > 1e-5) and np.all(at_rest < 1e-7) else None


def _high_passed(samples: Samples, sensor: Sensor) -> Iterator[Finding]:
    """A running mean that is taken off: at rest the output is then −(angle turned so far)/τ, whatever the motion was.

    A filter y = ω − m with m' = y/τ has m = m₀ + ∫y dt/τ, so that adding ∫y dt/τ undoes it.
    """
    rests = samples.rests
    if len(rests) < _FEWEST:
        return
    angle = np.cumsum(sensor.values * sensor.period, axis=0)
    middle = rests.mean(axis=1)
    spans = np.concatenate([np.stack([rests[:, 0] + 0.1, middle], 1), np.stack([middle, rests[:, 1] - 0.1], 1)])
    edges = np.clip(np.searchsorted(sensor.time, spans), 0, len(sensor) - 1)
    edges = edges[edges[:, 1] - edges[:, 0] > 5]
    if len(edges) < 2 * _FEWEST:
        return
    rate, turned = (of_each(np.mean, values, edges) for values in (sensor.values, angle))
    rate, turned = rate - rate.mean(axis=0), turned - turned.mean(axis=0)
    power = np.sum(turned**2)
    if not power > 0:
        return
    slope = np.sum(rate * turned) / power
    unexplained = np.sum((rate - slope * turned) ** 2)
    slopes = np.sum(rate * turned, axis=0) / np.maximum(np.sum(turned**2, axis=0), 1e-300)
    # one time constant for all axes, and nearly all of what the means do at rest
    if not -10.0 < slope < -1e-3 or unexplained > 0.1 * np.sum(rate**2) or np.any(np.abs(slopes / slope - 1) > 0.35):
        return

    def apply(recording: Recording) -> Recording:
        signal = recording.signals["gyroscope"]
        # as the usual recursion y_k = a (y_{k−1} + ω_k − ω_{k−1}) has it, a = τ/(τ + Δt)
        mean = np.cumsum(signal.si() * np.median(np.diff(signal.time)), axis=0)
        return with_signal(recording, "gyroscope", values=signal.values - slope * mean * signal.nominal_scale)

    yield Finding(
        "data.auto_zero",
        sensor.rows(edges[:1, 0]),
        f"gyroscope: at rest it reads minus the angle turned so far over {-1 / slope:.3g} s, on all axes: a "
        "high-pass filter takes its running mean off. --repair adds the mean back; better switch the automatic "
        "zero off and record again.",
        repair="--repair",
        spoils=True,
        apply=apply,
    )
