"""Known poses and turns, asked for what model and set-up lack: errors of the set-up are candidates, too."""

from __future__ import annotations

from collections.abc import Sequence

from jaximu.calibration import Calibration
from jaximu.calibration.turntable import calibrate_table_ready
from jaximu.data.recorded_stations import RecordedStations
from jaximu.diagnosis.diagnosis import Diagnosis, Examination, examine, same_device
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.gravity import STANDARD, Gravity, LocalGravity, as_gravity
from jaximu.mistakes import Prepared, prepare, prepared
from jaximu.model.noise_model import NoiseModel
from jaximu.noise.at_rest import noise_of
from jaximu.recordings.entry import ScheduleEntry
from jaximu.recordings.recording import Recording
from jaximu.recordings.reference import entries_of_columns


def diagnose_turntable(
    recording: Recording,
    reference: Sequence[ScheduleEntry] | None = None,
    gravity: Gravity = STANDARD,
    *,
    static: Recording | NoiseModel | None = None,
    heldout: tuple[Recording, Sequence[ScheduleEntry] | None] | None = None,
    level: float = 0.05,
    repair: bool = False,
) -> Diagnosis:
    """Calibrate a unit at known poses and turns, ask for everything that model and set-up lack, measure the gain.

    **Arguments:** as for [`jaximu.calibration.calibrate_turntable`][] and [`jaximu.diagnosis.diagnose`]; `heldout`:
    another recording of the unit with its reference.

    No effect is named while a mistake in the recording stands that could imitate it. Raises what these two raise.
    """
    with prepared([recording], repair) as (ready,):
        return _of_ready(ready, reference, as_gravity(gravity), noise_of(static), heldout, level, repair)


def _of_ready(
    ready: Prepared,
    reference: Sequence[ScheduleEntry] | None,
    gravity: LocalGravity,
    noise: NoiseModel | None,
    heldout: tuple[Recording, Sequence[ScheduleEntry] | None] | None,
    level: float,
    repair: bool,
) -> Diagnosis:
    """Diagnose a recording that was looked over."""
    if ready.recording.gyroscope is None or (heldout is not None and heldout[0].gyroscope is None):
        raise NotPossibleError("a diagnosis needs accelerometer and gyroscope.")
    calibration, data = _on_table(ready, reference, gravity)
    notes, held = calibration.notes, None
    if heldout is not None:
        other, held = _on_table(prepare(heldout[0], repair), heldout[1], gravity)
        notes = (*notes, *same_device(calibration, other))
    return examine(Examination.of(calibration, data, noise, held, findings=ready.findings, notes=notes, level=level))


def _on_table(
    ready: Prepared, reference: Sequence[ScheduleEntry] | None, gravity: LocalGravity
) -> tuple[Calibration, RecordedStations]:
    """Return the calibration at known poses and turns, and what it was fitted to."""
    entries = entries_of_columns(ready.recording) if reference is None else reference
    calibration = calibrate_table_ready([ready], [entries], gravity)
    assert calibration.stations is not None
    return calibration, RecordedStations(ready.recording, calibration.stations, entries)
