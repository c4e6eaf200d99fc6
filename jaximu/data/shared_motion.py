"""Two units on one rigid body: what the first, calibrated, tells of the other's motion, as `Stations`.

Over any interval the means of both bodies' rates are the same vector but for the fixed rotation between them, and the
means of both specific forces differ by the means of ω×(ω×r) + ω̇×r, linear in the lever arm r. So nothing is integrated,
and turns that are too quick to be followed by integration still count. NumPy, host side.
"""

from __future__ import annotations

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.observations import Stations
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.reference import Integral

__all__ = ["shared_stations"]

_MARGIN = 4
"""Samples of the first unit on either side of an interval, for the other's clock to move in."""
_BUCKET = 32


def shared_stations(
    recording: Recording, first: Recording, span: FloatArray, delay: float, density: tuple[FloatArray, FloatArray],
    gravity: float, still: bool = False,
) -> Stations:  # fmt: skip
    """Return what a unit put out over S intervals, beside what the first unit measured over them.

    **Arguments:** `recording`: the unit's, as logged; `first`: the other's, compensated, m/s² and rad/s; `span`: (S, 2)
    s, on the recording's clock; `delay`: s by which the first's stamps are late; `density`: white noise of both units
    together (3, 3) of each sensor, output² s; `still`: the intervals are rests, in which means tell all.

    **Returns:** stations padded to a multiple of 32.
    """
    gyroscope = first.gyroscope
    assert gyroscope is not None and recording.gyroscope is not None
    time = gyroscope.time - delay
    accelerometer, rate = first.accelerometer, gyroscope.values
    force = np.stack([np.interp(gyroscope.time, accelerometer.time, axis) for axis in accelerometer.values.T], axis=1)
    turning = np.gradient(rate, time, axis=0)
    count, size = len(span), -(-len(span) // _BUCKET) * _BUCKET
    used = np.arange(size) < count
    span = np.concatenate([span, np.repeat(span[:1], size - count, axis=0)])
    start, stop = span.T
    if still:
        signals = [Integral(Signal(time, values, "1"), values) for values in (force, rate)]
        means = [np.repeat((each.over(start, stop) / np.diff(span))[:, None], 2, axis=1) for each in signals]
        stimulus = Stimulus(specific_force=means[0], angular_rate=means[1], angular_acceleration=0 * means[1],
                            time=span, temperature=None)  # fmt: skip
        weight = np.full(span.shape, 0.5)
    else:
        edges = np.concatenate([[2 * time[0] - time[1]], time, [2 * time[-1] - time[-2]]])
        edges = (edges[1:] + edges[:-1]) / 2
        begin = np.searchsorted(edges, start, side="right") - 1 - _MARGIN
        nodes = int(np.ceil(np.max(stop - start) * gyroscope.rate - 1e-6)) + 2 * _MARGIN + 1
        place = np.clip(begin, 0, len(time) - nodes)[:, None] + np.arange(nodes)
        held = np.minimum(edges[place + 1], stop[:, None]) - np.maximum(edges[place], start[:, None])
        held = np.maximum(held, 0.0)
        weight = held / held.sum(axis=1, keepdims=True)
        stimulus = Stimulus(specific_force=force[place], angular_rate=rate[place], angular_acceleration=turning[place],
                            time=time[place])  # fmt: skip
    length = np.diff(span)
    outputs = [Integral(each, each.values).over(start, stop) / length
               for each in (recording.accelerometer, recording.gyroscope)]  # fmt: skip
    covariances = [np.where(used, np.diagonal(each)[:, None] / length[:, 0], 1.0)[:, :, None] * np.eye(size)
                   for each in density]  # fmt: skip
    return Stations(outputs[0], outputs[1], covariances[0], covariances[1], stimulus, weight, start, stop,
                    np.full(size, not still), used, used, np.asarray(gravity))  # pyright: ignore # fmt: skip
