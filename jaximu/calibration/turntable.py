"""Calibration with equipment: known poses and turns, all 24 numbers of gain and bias, and nuisance effects (S8, S9)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import scipy

from jaximu.calibration.bias_drift import knowing_drift
from jaximu.calibration.calibration import Calibration, concluded, effect_named, notes_of, provenance
from jaximu.calibration.nominal import as_stated
from jaximu.calibration.refusals import require_determined
from jaximu.data.observe_stations import observe_stations
from jaximu.data.poses import EXCESS_NAMES
from jaximu.data.recorded_stations import station_means
from jaximu.data.stations import KnownStations, station_covariance, station_rms
from jaximu.estimation.fitting import Fit, fit
from jaximu.estimation.problem import TOLERANCE, Loss, Name, Parameters
from jaximu.estimation.uncertainty import UNDETERMINED, station_advice
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import STANDARD, Gravity, LocalGravity, as_gravity
from jaximu.ground.precision import require_float64
from jaximu.ground.quantities import counted
from jaximu.ground.rotation import unit_vectors
from jaximu.ground.tracing import on_host
from jaximu.mistakes import Prepared, prepared
from jaximu.model.effects import Effect
from jaximu.model.effects.earth_rotation import GyroEarthRotation
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu
from jaximu.noise.at_rest import noise_of
from jaximu.recordings.entry import ScheduleEntry
from jaximu.recordings.observations import Stations
from jaximu.recordings.recording import Recording, recordings_of, same_outputs
from jaximu.recordings.reference import entries_of_columns
from jaximu.simulation.protocols import earth_rate

_TURNED, _ARRANGED = 0.3, 45.0
"""Degrees of a common rotation from which on it is said, and up to which it is no other arrangement of the axes."""
_RECORD = (
    "Rest for a second or more in at least six orientations, each axis up and down, and turn about each axis between "
    "rests."
)


def fit_turntable(start: Imu, stations: Stations, free: Sequence[str] = (), loss: Loss = "linear") -> Fit:
    """Fit gains and biases to known poses and turns; one unit, or a batch with one leading axis on every array.

    The body frame is the fixture's, so all nine entries of each gain are free. Passes alternate the fit with the excess
    variance of accelerometer poses, turns and gyroscope poses (restricted likelihood). Each pass starts where the one
    before ended and holds to it as loosely as the first holds to the data sheet, so that in the end what the data
    determine owes nothing to the data sheet, and what they do not stays there.

    **Arguments:**

    - `start`: the unit as its data sheet has it, with the effects to be fitted (their coefficients zero, as a rule) and
      those that are known (held fixed).
    - `free`: names of the effects of `start` that are fitted.
    - `loss`: `"linear"`, `"huber"` or `"cauchy"`.

    **Returns:** a `Fit` with the same leading axes. Look at `converged` and `finite`; nothing is raised.
    """
    on_table, force = free_on_table(start, free), bool(stations.accelerometer_used.any())

    def seen(name: Name) -> bool:
        return on_table(name) and (force or name.owner != "accelerometer" or name.effect is not None)

    return fit(start, KnownStations(stations), seen, loss=loss, follow=True)


def free_on_table(imu: Imu, free: Sequence[str] = ()) -> Callable[[Name], bool]:
    """Return which numbers of a unit are free: gains, biases, and those of the effects named in `free`."""
    effects = imu.all_effects()
    return lambda name: name.effect is None or effects[name.key].name in free


def calibrate_turntable(
    recordings: Recording | Sequence[Recording],
    references: Sequence[ScheduleEntry] | Sequence[Sequence[ScheduleEntry]] | None = None,
    gravity: Gravity = STANDARD,
    *,
    static: Recording | NoiseModel | None = None,
    effects: Sequence[str | Effect] = (),
    latitude: float | None = None,
    loss: Loss = "linear",
    repair: bool = False,
) -> Calibration:
    """Calibrate a unit from recordings of known poses and turns: rate table, dividing head, six positions.

    **Arguments:**

    - `recordings`: one or several recordings of the same unit; a gyroscope alone will do.
    - `references`: what the set-up says: the entries of a schedule for each recording (a single recording's may stand
      alone); None to take them from reference columns.
    - `gravity`: local gravity; its uncertainty goes into the accelerometer's scales.
    - `static`: a recording of the unit at rest, or the `NoiseModel` fitted to one.
    - `effects`: effects to fit beside gain and bias, by name or with a start: errors of the set-up
      (`"setup.table_tilt"`), nonlinearities (`"accel.quadratic"`), `"gyro.earth_rotation"`.
    - `repair`: change what is wrong with the samples where that can be put right. Poses and turns of which samples are
      no measurement are left out.
    - `latitude`: degrees; the Earth's rotation is then known and held. Headings must be stated and count from where
      `attitude_of(up, 0)` stands with x east and y north.

    Raises `InputError` where the reference does not match, `NotPossibleError` where the fit does not converge, an
    effect cannot be told, or of every triad more than half is left open. What else the scheme leaves open stays as the
    data sheet has it, and is in `Calibration.weak`.
    """
    require_float64()
    gravity = as_gravity(gravity)
    recordings = recordings_of(recordings)
    mixed = same_outputs(recordings, alone=True)
    if references is None:
        entries = [entries_of_columns(recording) for recording in recordings]
    else:
        alone = len(references) > 0 and not isinstance(references[0], Sequence)
        entries = [references] if alone else list(references)
    if len(entries) != len(recordings):
        raise InputError(f"{len(recordings)} recordings need as many references, found {len(entries)}.")
    noise = noise_of(static)
    with prepared(recordings, repair) as ready:
        calibration = calibrate_table_ready(ready, entries, gravity, noise, effects, latitude, loss)  # pyright: ignore[reportArgumentType]
    return replace(calibration, notes=(*mixed, *calibration.notes))


def calibrate_table_ready(
    ready: Sequence[Prepared],
    references: Sequence[Sequence[ScheduleEntry]],
    gravity: LocalGravity,
    noise: NoiseModel | None = None,
    effects: Sequence[str | Effect] = (),
    latitude: float | None = None,
    loss: Loss = "linear",
) -> Calibration:
    """Calibrate as `calibrate_turntable` does, from recordings that [`jaximu.mistakes.prepare`][] has been over."""
    recordings = [one.recording for one in ready]
    stations, remarks = observe_stations(recordings, references, gravity.value, noise)
    nominal = as_stated(recordings[0])
    if recordings[0].gyroscope is None:
        nominal = Imu(nominal.accelerometer, None)
    chosen = list(map(effect_named, effects))
    if latitude is not None:
        _require_headings(recordings, references)
        known = GyroEarthRotation.make(earth_rate(np.radians(latitude)))
        chosen = [*(effect for effect in chosen if effect.name != known.name), known]
    free = tuple(effect.name for effect in chosen if latitude is None or not isinstance(effect, GyroEarthRotation))
    for effect in chosen:
        if "attitude" in effect.needs and stations.stimulus.attitude is None:
            raise NotPossibleError(
                f"{effect.name} needs to know how the unit was turned about the vertical in every pose: state headings "
                "in the reference, or all turns between the poses."
            )
    start = on_host(nominal.with_effects(*chosen))
    fitted = fit_turntable(start, stations, free, loss)
    where = ", ".join(recording.name for recording in recordings)
    used = stations.accelerometer_used | stations.gyroscope_used
    poses, turns = (int((used & (stations.turn == kind)).sum()) for kind in (False, True))
    shown = f"the reference has {counted(poses, 'pose')} and {counted(turns, 'turn')} that can be used, which"
    require_determined(fitted, where, shown, _RECORD)
    fitted = _at_rest_where_open(fitted, start)
    notes = (
        *(note for recording in recordings for note in recording.remarks),
        *notes_of(*ready, noise),
        *remarks,
    )
    calibration = concluded(
        fitted,
        gravity=gravity,
        method="turntable",
        loss=loss,
        advice=station_advice,
        notes=notes,
        excess_names=EXCESS_NAMES if nominal.gyroscope is not None else EXCESS_NAMES[:1],
        rms=[station_rms(imu, stations) for imu in (start, fitted.imu)],
        data=provenance(recordings) | {"poses": poses, "turns": turns},
        stations=stations,
        nominal=nominal,
        reading=recordings[0].reading,
        absent=() if "accelerometer" in recordings[0].signals else ("accelerometer",),
    )
    calibration = replace(calibration, notes=(*calibration.notes, *_turned_as_a_whole(calibration)))
    if loss != "linear":
        return calibration
    return knowing_drift(calibration, station_covariance(stations), station_means(stations, recordings), noise)


def _turned_as_a_whole(calibration: Calibration) -> list[str]:
    """Say by how much the axes of a triad that was determined stand turned in the fixture, all alike.

    The gain's polar factor (Higham, SIAM J. Sci. Stat. Comput. 7, 1986) is the rotation that comes closest to it.
    """
    open_gains = {name.partition(".")[0] for name in calibration.open_numbers if ".gain[" in name}
    notes = []
    for sensor in sorted({name.owner for name in calibration.names if name.part == "gain"} - open_gains):
        rotation, _ = scipy.linalg.polar(unit_vectors(calibration.triads()[sensor].gain))
        vector = scipy.spatial.transform.Rotation.from_matrix(rotation).as_rotvec(degrees=True)
        if _TURNED < np.linalg.norm(vector) < _ARRANGED:
            about = ", ".join(f"{axis} {angle:+.2g}°" for axis, angle in zip("xyz", vector, strict=True))
            notes.append(
                f"the {sensor}'s axes are turned as a whole by {np.linalg.norm(vector):.2g}° in the fixture ({about}): "
                "the unit, or its board, is mounted so. That is part of the misalignments."
            )
    return notes


def _at_rest_where_open(fitted: Fit, start: Imu) -> Fit:
    """Return the fit with what the data leave open where the data sheet has it: noise had moved it about."""
    parameters = Parameters.select(start, lambda name: name in fitted.names)
    values = np.asarray(parameters.reference)[list(parameters.index)]
    moved = (fitted.values - values) / fitted.sizes
    _, known, right = np.linalg.svd(np.asarray(fitted.jacobian), full_matrices=True)
    known = np.pad(known, (0, len(right) - len(known)))
    free = right[1 / np.hypot(known, 1 / TOLERANCE) > UNDETERMINED]
    if not len(free):
        return fitted
    back = moved - free.T @ (free @ moved)
    model = on_host(parameters.model(start, jnp.asarray(back)))
    return replace(fitted, imu=model, values=values + fitted.sizes * back)


def _require_headings(recordings: Sequence[Recording], references: Sequence[Sequence[ScheduleEntry]]) -> None:
    for recording, entries in zip(recordings, references, strict=True):
        if recording.attitude is None and any(e.kind == "pose" and e.heading is None for e in entries):
            raise NotPossibleError(
                f"{recording.name}: to take off the Earth's rotation at a known latitude every pose must state its "
                "heading; leave the latitude out and fit gyro.earth_rotation instead."
            )
