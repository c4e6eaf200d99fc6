"""Two units on one rigid body: what the first, calibrated, tells of the other's motion, as `Stations`.

Over any interval the means of both bodies' rates are the same vector but for the fixed rotation between them, and the
means of both specific forces differ by the means of ω×(ω×r) + ω̇×r, linear in the lever arm r. So nothing is integrated,
and turns that are too quick to be followed by integration still count. NumPy, host side.
"""

from __future__ import annotations

import numpy as np

from jaximu.data.observe_stations import assembled
from jaximu.estimation.track import TRIADS
from jaximu.ground.array_types import FloatArray, IntArray
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.observations import Stations
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.reference import means_over

_MARGIN = 4
"""Samples of the first unit on either side of an interval, for the other's clock to move in."""


def shared_stations(
    recording: Recording,
    first: Recording,
    span: FloatArray,
    delay: float,
    density: tuple[FloatArray, FloatArray],
    gravity: float,
    still: bool = False,
) -> Stations:
    """Return what a unit put out over S intervals, beside what the first unit measured over them.

    **Arguments:** `recording`: the unit's, as logged; `first`: the other's, compensated, m/s² and rad/s; `span`: (S, 2)
    s, on the recording's clock; `delay`: s by which the first's stamps are late; `density`: white noise of both units
    together (3, 3) of each sensor, output² s; `still`: the intervals are rests, in which means tell all.

    **Returns:** padded stations.
    """
    accelerometer, gyroscope = (first.signals[name] for name in TRIADS)
    time, rate = gyroscope.time - delay, gyroscope.values
    force = accelerometer.at(gyroscope.time)
    count, length, weight = len(span), np.diff(span)[:, 0], None
    if still:
        means = (means_over(Signal(time, values, "1"), span) for values in (force, rate))
        force, rate = (mean[:, None].repeat(2, axis=1) for mean in means)
        stimulus = Stimulus(force, rate, angular_acceleration=0 * rate, time=span)
    else:
        index, held = _held(gyroscope.edges - delay, span, gyroscope.rate)
        weight = held / held.sum(axis=1, keepdims=True)
        turning = np.gradient(rate, time, axis=0)
        stimulus = Stimulus(force[index], rate[index], angular_acceleration=turning[index], time=time[index])
    means = [means_over(recording.signals[name], span) for name in TRIADS]
    covariances = [(np.diagonal(axes)[:, None] / length)[:, :, None] * np.eye(count) for axes in density]
    turn, everywhere = np.full(count, not still), np.ones(count, bool)
    return assembled(means, covariances, stimulus, span, turn, gravity, everywhere, weight=weight)


def _held(edges: FloatArray, span: FloatArray, rate: float) -> tuple[IntArray, FloatArray]:
    """Return which samples, that hold between edges, lie in each span, some beside it included, and how long each
    holds in it (S, Q), s.
    """
    begin = edges.searchsorted(span[:, 0], side="right") - 1 - _MARGIN
    nodes = int(np.ceil(np.diff(span).max() * rate - 1e-6)) + 2 * _MARGIN + 1
    index = begin.clip(0, len(edges) - 1 - nodes)[:, None] + np.arange(nodes)
    held = np.minimum(edges[index + 1], span[:, 1:]) - np.maximum(edges[index], span[:, :1])
    return index, np.maximum(held, 0.0)
