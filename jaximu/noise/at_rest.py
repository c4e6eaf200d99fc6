"""The noise of a recording at rest as a `NoiseModel`: what is missing, periodic or still is left out or refused."""

from collections.abc import Iterator, Sequence

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.quantities import listed
from jaximu.mistakes import Prepared, prepared
from jaximu.model.noise_model import AxisNoise, NoiseModel, fit_bank
from jaximu.noise.analysis import at_rest
from jaximu.noise.cleaning import BRIDGED, filled, periodic_lines, without_steps
from jaximu.recordings.recording import Recording, recordings_of, runs_of
from jaximu.recordings.segmentation import Segmentation, rest_statistics

_OF_ITS_OWN = {"data.periodic", "data.gap"}
"""Findings that the fit makes itself, with numbers."""
_NOISIER, _HAND = 3.0, 30.0
"""Times the noise in the rests of a log that no recording at rest has, and times a hand at most adds to it."""
_FEWEST = 1000
"""Samples below which a spectrum cannot tell white noise from slow bias."""


def noise_of(static: Recording | NoiseModel | None) -> NoiseModel | None:
    """Return the noise of a recording at rest, or the one stated. Raises `InputError` for anything else."""
    if static is None or isinstance(static, NoiseModel):
        return static
    return fit_noise(*recordings_of(static))


def fit_noise(recording: Recording) -> NoiseModel:
    """Fit a recording of the unit at rest, a quarter of an hour or more.

    A few samples missing in a row are bridged; of a recording with longer gaps the longest whole part is used.
    Raises `NotPossibleError` where it is too short, moves or has no noise, `InputError` for uneven stamps.
    """
    with prepared([recording], gravity=False) as (ready,):
        return _of_ready(ready)


def white_in_rests(segmentation: Segmentation) -> dict[str, FloatArray]:
    """Return the white noise in the rests of a recording, by triad a density N² (3,), SI² · s."""
    signals = {name: segmentation.recording.signals.get(name) for name in ("accelerometer", "gyroscope")}
    return {
        name: np.diagonal(rest_statistics(signal, segmentation.intervals)[0]) / signal.nominal_scale**2
        for name, signal in signals.items()
        if signal is not None
    }


def unlike_rests(noise: NoiseModel, segmentations: Sequence[Segmentation]) -> Iterator[str]:
    """Say of a noise model that it is not of the sensors whose rests are shown: far noisier, or far too quiet."""
    shown = [white_in_rests(part) for part in segmentations]
    for name in shown[0]:
        signals = [part.recording.signals[name] for part in segmentations]
        rounded = max(signal.rounding_variance / signal.rate for signal in signals)
        known = getattr(noise, name)
        density = 0.0 if known is None else float(known.white.mean())
        ratio = np.sqrt(density / (np.mean([part[name] for part in shown]) + rounded))
        if density > 0 and not 1 / _HAND < ratio < _NOISIER:
            yield (
                f"{name}: the noise that is stated, or shown by the recording at rest, is {ratio:.2g} times what the "
                "rests of this log show: a wrong unit of its columns, another device, or a table that shook. The "
                "uncertainties follow it; leave it out, or correct it."
            )


def _of_ready(ready: Prepared) -> NoiseModel:
    recording = ready.recording
    axes = dict[str, AxisNoise]()
    notes = [finding.text for finding in ready.findings if finding.name not in _OF_ITS_OWN]
    for name in ("accelerometer", "gyroscope"):
        if getattr(recording, name) is None:
            continue
        what = f"{recording.name}: the {name}"
        values, rate = at_rest(recording, name)
        values = np.stack([filled(axis, BRIDGED) for axis in values])
        first, last = max(runs_of(np.asarray(np.isfinite(values).all(axis=0))), key=np.ptp)
        whole = values[:, first:last]
        if (samples := last - first) < values.shape[1]:
            notes.append(
                f"{what} has gaps: its noise is that of the longest part without, {samples / rate:.0f} of "
                f"{values.shape[1] / rate:.0f} s."
            )
        if samples < _FEWEST:
            raise NotPossibleError(
                f"{what} has {samples} samples at rest without a gap, too few to model its noise: record "
                "the unit at rest for half an hour or more."
            )
        if not (np.ptp(whole, axis=1) > 0).all():
            raise NotPossibleError(f"{what} has an axis that never changes: there is no noise to model.")
        for axis in whole:
            axis[:], steps = without_steps(axis, rate)
            if steps:
                times = listed([f"{step.time:.4g} s" for step in steps])
                notes.append(f"{what} has steps of its level in the recording at rest, after {times}: taken out.")
            lines, _, periodic = periodic_lines(axis, rate)
            if periodic is not None:
                axis -= periodic
                heard = ", ".join(f"{line.frequency:.4g} Hz" for line in lines)
                notes.append(f"{what} is periodic at {heard} in the recording at rest; that is no noise, and left out.")
        axes[name] = fit_bank(whole, rate)
    return NoiseModel(axes["accelerometer"], axes.get("gyroscope"), tuple(notes))
