"""`data.quantisation`: steps coarser than the noise."""

from __future__ import annotations

from collections.abc import Iterator

from jaximu.ground.quantities import size
from jaximu.mistakes.base import Samples, coarse_step
from jaximu.mistakes.held_at_rest import zeroed_at_rest
from jaximu.mistakes.resampled import held_at
from jaximu.recordings.finding import Finding

TITLES = {"data.quantisation": "coarse steps"}


def find(samples: Samples) -> Iterator[Finding]:
    """Return the axes whose steps are coarser than their noise."""
    if zeroed_at_rest(samples) is not None:
        return
    for name, sensor in samples.sensors.items():
        if held_at(sensor) is not None:
            continue
        steps = {axis: coarse_step(sensor, axis, samples.quiet_at(sensor)) for axis in range(3)}
        coarse = {axis: step for axis, step in steps.items() if step is not None}
        if coarse:
            scale, unit = sensor.signal.nominal_scale, sensor.signal.unit
            sizes = [size(step * scale[axis], unit) for axis, step in coarse.items()]
            yield Finding(
                "data.quantisation",
                (),
                f"{name} {', '.join('xyz'[axis] for axis in coarse)}: its step of "
                f"{' or '.join(dict.fromkeys(sizes))} is coarser than its noise; averages over a pose gain "
                "little. Choose a smaller range, or log unrounded "
                "values.",
            )
