"""Known poses and turns, asked for what model and set-up lack: errors of the set-up are candidates, too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import jax
import numpy as np

from jaximu.calibration.turntable import calibrate_table_ready
from jaximu.data.drift import with_usual_drift
from jaximu.data.observe_stations import observe_stations
from jaximu.data.recorded_stations import RecordedStations
from jaximu.diagnosis.diagnosis import Diagnosis, Examination, examine, same_device, without_effects
from jaximu.diagnosis.experiment import Experiment
from jaximu.diagnosis.noise import own_noise
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.gravity import STANDARD, Gravity, LocalGravity, as_gravity
from jaximu.mistakes import Prepared, prepare, prepared
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu
from jaximu.noise.at_rest import noise_of
from jaximu.recordings.recording import Recording
from jaximu.recordings.reference import Entry, entries_of_columns
from jaximu.recordings.segmentation import Segmentation

__all__ = ["diagnose_turntable"]


def diagnose_turntable(
    recording: Recording,
    reference: Sequence[Entry] | None = None,
    gravity: Gravity = STANDARD,
    *,
    static: Recording | NoiseModel | None = None,
    heldout: tuple[Recording, Sequence[Entry] | None] | None = None,
    level: float = 0.05,
    repair: bool = False,
) -> Diagnosis:
    """Calibrate a unit at known poses and turns, ask for everything that model and set-up lack, measure the gain.

    **Arguments:** as for [`jaximu.calibration.calibrate_turntable`][] and [`jaximu.diagnosis.diagnose`]; `heldout`:
    another recording of the unit with its reference.

    No effect is named while a mistake in the recording stands that could imitate it. Raises what these two raise.
    """
    with prepared([recording], repair) as (ready,):
        diagnosis = _of_ready(ready, reference, as_gravity(gravity), noise_of(static), heldout, level, repair)
    return without_effects(diagnosis, ready.spoiling) if ready.spoiling else diagnosis


def _of_ready(
    ready: Prepared,
    reference: Sequence[Entry] | None,
    gravity: LocalGravity,
    noise: NoiseModel | None,
    heldout: tuple[Recording, Sequence[Entry] | None] | None,
    level: float,
    repair: bool,
) -> Diagnosis:
    """Diagnose a recording that was looked over."""
    recording = ready.recording
    if recording.gyroscope is None or (heldout is not None and heldout[0].gyroscope is None):
        raise NotPossibleError("a diagnosis needs accelerometer and gyroscope.")

    def made(part: Recording, entries: Sequence[Entry], imu: Imu, known: NoiseModel) -> Experiment:
        stations, _ = observe_stations(part, entries, gravity.value, known)
        return Experiment(RecordedStations(part, stations), jax.tree.map(np.asarray, imu))

    entries = entries_of_columns(recording) if reference is None else reference
    calibration = calibrate_table_ready([ready], [entries], gravity)
    notes = list(calibration.notes)
    held = None
    if heldout is not None:
        other = prepare(heldout[0], repair)
        stated = entries_of_columns(other.recording) if heldout[1] is None else heldout[1]
        notes += same_device(calibration, calibrate_table_ready([other], [stated], gravity))
        held = partial(made, other.recording, stated, calibration.imu)
    remade = partial(made, recording, entries, calibration.imu)
    if noise is not None:
        return examine(
            Examination(
                calibration, noise, remade, held, ready.findings, tuple(notes), level, naming=not ready.spoiling
            )
        )
    assert calibration.stations is not None
    (spans,) = RecordedStations(recording, calibration.stations).rests()
    own = own_noise(replace(calibration, segmentations=(Segmentation(recording, spans, 1.0, (), ()),)))
    plain = remade(own)
    usual = with_usual_drift(own, plain.shortest(), plain.extent().duration)
    notes += usual.notes
    return examine(
        Examination(
            calibration,
            usual,
            remade,
            held,
            ready.findings,
            tuple(notes),
            level,
            trusted=True,
            naming=not ready.spoiling,
        )
    )
