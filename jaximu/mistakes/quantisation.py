"""`data.quantisation`: steps coarser than the noise."""

from __future__ import annotations

from jaximu.mistakes.base import Finding, Samples, coarse_step
from jaximu.mistakes.held_at_rest import zeroed_at_rest
from jaximu.mistakes.resampled import held_at
from jaximu.quantities import size

__all__ = ["find"]


def find(samples: Samples) -> list[Finding]:
    """Return the axes whose steps are coarser than their noise."""
    if zeroed_at_rest(samples) is not None:
        return []
    found = []
    for name, sensor in samples.sensors.items():
        if held_at(sensor) is not None:
            continue
        quiet = samples.quiet_at(sensor)
        for axis, letter in enumerate("xyz"):
            step = coarse_step(sensor, axis, quiet)
            if step is None:
                continue
            shown = size(step * sensor.signal.nominal_scale[axis], sensor.signal.unit)
            found.append(Finding(
                "data.quantisation", (),
                f"{name} {letter}: its step of {shown} is coarser than its noise; averages "
                "over a pose gain little. Choose a smaller range, or log unrounded values.",
            ))  # fmt: skip
    return found
