"""From jobs to rows: a recording read and segmented, a batch of them fitted, each one's row of the table."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from jaximu.calibration import nominal_imu, require_carried, require_spanning
from jaximu.calibration.arrangement import unusual_gains
from jaximu.calibration.recipe import Choices, carried_error
from jaximu.data.poses import EXCESS_NAMES
from jaximu.estimation.fitting import Fit
from jaximu.estimation.problem import flatten, names_of, without_equipment
from jaximu.estimation.solver import Failure
from jaximu.estimation.uncertainty import gains_open, open_numbers, weak_directions
from jaximu.fleets.field import FieldUnit, field_row, field_unit
from jaximu.fleets.fit import FleetUnit, fit_units
from jaximu.fleets.jobs import Job, Settings, options_text
from jaximu.ground.array_types import FloatArray
from jaximu.ground.document import Json
from jaximu.ground.errors import FilePath, InputError, JaximuError, NotPossibleError
from jaximu.ground.quantities import listed
from jaximu.ground.units import SENSORS
from jaximu.ground.vectors import lengths_of
from jaximu.mistakes import prepared
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu
from jaximu.noise.at_rest import fit_noise
from jaximu.recordings.observations import Poses
from jaximu.recordings.readers import ReadOptions, read_recording
from jaximu.recordings.recording import Recording
from jaximu.recordings.segmentation import observed_poses, segment

PARAMETERS = names_of(Imu.nominal())
"""Names of the 24 numbers of a row, in the order of its column `covariance`."""
COLUMN_PLACES = {
    "accel_gain": slice(0, 9),
    "accel_bias": slice(9, 12),
    "gyro_gain": slice(12, 21),
    "gyro_bias": slice(21, 24),
}
"""Which of `PARAMETERS` a column of the table holds."""
_TRIANGLE = np.tril_indices(len(PARAMETERS))
_OPEN = (
    "the recording does not determine all of {}: numbers whose sigma is empty say nothing. Column weak says what to "
    "record."
)
_EPOCH = 946684800.0  # s; the year 2000: a logger's start before it is no date


def _numbers(size: int) -> pa.DataType:
    return pa.list_(pa.float64(), size)


def _of_triads(*triads: str) -> list[pa.Field]:
    return [
        pa.field(f"{triad}_{part}{end}", _numbers(size))
        for triad in triads
        for part, size in (("gain", 9), ("bias", 3))
        for end in ("", "_sigma")
    ]


_UNITS = {"accel_rms": "m/s^2", "gyro_rms": "deg"}
_OF_JOB = ("device", "file", "date", "lot", "static", "station", "unit", "session")
_TEXT = ("device", "file", "status", "message", "verdict", "effects")
SCHEMA = pa.schema(
    [
        *(pa.field(name, pa.list_(pa.string()) if name == "effects" else pa.string()) for name in _TEXT),
        *_of_triads("accel", "gyro"),
        *(pa.field(name, pa.float64(), metadata={"unit": unit}) for name, unit in _UNITS.items()),
        *(pa.field(name, pa.string()) for name in ("date", "lot", "static", "station", "accel_unit", "gyro_unit")),
        *(pa.field(f"{triad}_nominal", _numbers(6)) for triad in ("accel", "gyro")),
        pa.field("covariance", _numbers(len(_TRIANGLE[0]))),
        pa.field("excess", _numbers(3)),
        *(pa.field(name, pa.int32()) for name in ("poses", "turns", "rank")),
        pa.field("temperature", pa.float64(), metadata={"unit": "degC"}),
        *(pa.field(name, pa.list_(pa.string())) for name in ("weak", "notes")),
        *_of_triads("mag"),
        *(pa.field(f"mag_{name}", pa.float64(), metadata={"unit": "uT"}) for name in ("rms", "field", "field_sigma")),
        *(pa.field(f"mag_{name}", pa.string()) for name in ("unit", "message")),
        *(pa.field(name, pa.string()) for name in ("unit", "session", "options")),
        *(
            pa.field(f"rest_{name}", pa.list_(pa.float64()), metadata={"unit": unit})
            for name, unit in {"time": "s", "up": "", "rate": "rad/s"}.items()
        ),
    ],
    metadata={
        "jaximu": "jaximu.fleet/1",
        "equation": "y = gain·u + bias (+ effects); gains row-major, in output units per SI unit, biases in output "
        "units; sigmas with gravity's uncertainty, null where the recording does not determine a number, covariance "
        "(lower triangle, row by row, of gain and bias of the "
        "accelerometer, then of the gyroscope) without; nominal: three scales, three offsets; "
        "a magnetometer's gain (output units per µT, lower triangle) is in its own axes, which `jaximu magnetometer` "
        "finds against the accelerometer's; rest_time, rest_up, rest_rate: where a session is stated, when the unit "
        "rested, the direction of specific force and the gyroscope's rate then, three numbers each",
    },
)
"""Columns of the table. The first ones are the fixed surface; what does not apply is null."""


def require_table(path: FilePath, needed: Sequence[str]) -> None:
    """Raise `InputError` where a file is no table of `jaximu fleet` with these columns."""
    name = os.fspath(path)
    try:
        known = pq.read_schema(path).names
    except (OSError, pa.ArrowException) as error:
        raise InputError(f"{name}: is not a fleet's table ({str(error).splitlines()[0]}).") from error
    if missing := [column for column in needed if column not in known]:
        raise InputError(f"{name}: is not a fleet's table: the column {missing[0]} is missing.")


def free_places(gyroscope: bool) -> list[int]:
    """Return which of `PARAMETERS` are free by hand, with a gyroscope or without."""
    return [
        index
        for index, name in enumerate(PARAMETERS)
        if without_equipment(name) and (gyroscope or name.owner == "accelerometer")
    ]


def covariances(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariances (n, 24, 24) of the rows whose column `covariance` this is, (n, 300)."""
    lower = np.zeros((len(triangles), len(PARAMETERS), len(PARAMETERS)))
    lower[:, *_TRIANGLE] = triangles
    return lower + np.swapaxes(np.tril(lower, -1), 1, 2)


@dataclass(frozen=True)
class ReadJob:
    """A job whose recording is read and segmented; `row` has what is known already, `unit` is None where it failed.

    field: the same of its magnetometer, None where there is none.
    """

    row: Json
    unit: FleetUnit | None
    field: FieldUnit | None = None


def row_begun(job: Job) -> Json:
    """Return a job's row before anything is known of it but the job."""
    return dict.fromkeys(SCHEMA.names) | {name: getattr(job, name) or None for name in _OF_JOB}


def read_job(job: Job, settings: Settings) -> ReadJob:
    """Read, segment and, where it is asked for, diagnose one recording. Never raises: a failure is the job's row."""
    row = row_begun(job) | {"options": options_text((dict(settings.options) | dict(job.options)).items()) or None}
    try:
        if job.copy_of:
            raise InputError(f"{job.file}: the same bytes as {job.copy_of}: one recording under two names, used once.")
        options, gyro_log = settings.reading(job)
        recording = read_recording(job.file, gyro_log, options)
        noise = noise_at_rest(job.static, options) if job.static else None
        choices = Choices(settings.gravity, noise, settings.segmentation)
        with prepared([recording], misfit=partial(carried_error, choices=choices)) as (ready,):
            segmentation = segment(ready.recording, settings.segmentation)
            observations = observed_poses(segmentation, settings.gravity.value, noise=noise)
            unit = FleetUnit(
                observations, nominal_imu(ready.recording, observations), ready.recording.gyroscope is not None
            )
    except Exception as error:
        return ReadJob(row | _failure(error), None)
    of_noise = () if noise is None else noise.notes
    row |= _facts(ready.recording, unit, (*recording.notes, *ready.notes, *of_noise, *segmentation.notes))
    if job.date:
        row["date"] = job.date
    if settings.diagnose:
        row |= _diagnosed(recording, settings, noise)
    field = None
    if recording.magnetometer is not None:
        try:
            field = field_unit(recording.magnetometer, segmentation, settings.field, job.file)
        except Exception as error:
            row["mag_message"] = _sentence(error)
    return ReadJob(row, unit, field)


@lru_cache(maxsize=4)
def noise_at_rest(path: str, options: ReadOptions) -> NoiseModel:
    """Fit a recording at rest; the last ones are kept, for a fleet that shares one."""
    return fit_noise(read_recording(path, None, options))


def _facts(recording: Recording, unit: FleetUnit, notes: Sequence[str]) -> Json:
    poses = unit.observations.poses
    turns = unit.observations.turns
    row: Json = {
        "poses": int(np.sum(poses.mask)),
        "turns": int(np.sum(turns.mask)) if unit.gyroscope else None,
        "notes": list(dict.fromkeys(notes)),
    }
    if recording.start >= _EPOCH:
        row["date"] = str(np.datetime64(int(recording.start), "s"))
    if recording.temperature is not None:
        row["temperature"] = float(np.mean(np.asarray(poses.temperature)[np.asarray(poses.mask)]))
    for name, signal in (("accel", recording.accelerometer), ("gyro", recording.gyroscope)):
        if signal is not None:
            row[f"{name}_unit"] = signal.unit
            row[f"{name}_nominal"] = [*signal.nominal_scale.tolist(), *signal.nominal_offset.tolist()]
    return row


def _diagnosed(recording: Recording, settings: Settings, noise: NoiseModel | None) -> Json:
    from jaximu.diagnosis import diagnose  # it is not cheap to import, and most runs ask for no diagnosis

    try:
        diagnosis = diagnose(recording, settings.gravity, static=noise, segmentation=settings.segmentation)
    except Exception as error:
        return {"message": f"not diagnosed: {_sentence(error)}"}
    return {"verdict": diagnosis.verdict, "effects": [effect.name for effect in diagnosis.effects]}


def _failure(error: Exception) -> Json:
    if isinstance(error, NotPossibleError):
        status = "not possible"
    else:
        status = "bad input" if isinstance(error, (InputError, OSError)) else "failed"
    return {"status": status, "message": _sentence(error), "verdict": None, "effects": None}


def _sentence(error: Exception) -> str:
    if isinstance(error, JaximuError):
        return str(error.args[0])  # worded for the command line, whichever process computes the row
    return f"this should not happen ({type(error).__name__}: {error})".splitlines()[0][:500]


def finish(prepared: Sequence[ReadJob], settings: Settings) -> list[Json]:
    """Fit what was prepared, in one batch, and return its rows in the same order."""
    units = [job.unit for job in prepared if job.unit is not None]
    fits = iter(fit_units([*units, *(job.field.unit for job in prepared if job.field is not None)]))
    rows = [job.row if job.unit is None else _row(job, *next(fits), settings) for job in prepared]
    return [
        row if job.field is None else row | _field(job.field, *next(fits), row["file"])
        for row, job in zip(rows, prepared, strict=True)
    ]


def rows_of(jobs: Sequence[Job], settings: Settings) -> list[Json]:
    """Return the rows of jobs: what every engine computes, wherever it does."""
    return finish([read_job(job, settings) for job in jobs], settings)


def _row(prepared: ReadJob, fit: Fit, rms: FloatArray, settings: Settings) -> Json:
    row = prepared.row
    unit = prepared.unit
    assert unit is not None
    try:
        _require(fit, row["poses"], row["file"], "accelerometer")
        rank, weak = weak_directions(fit.jacobian, fit.names, fit.sizes, unit.nominal)
        if not gains_open(weak):
            require_carried(float(rms[1]), row["file"])
    except NotPossibleError as error:
        return row | _failure(error)
    scales = {
        triad: np.array(row[f"{name}_nominal"][:3]) for name, triad in SENSORS.items() if row.get(f"{name}_nominal")
    }
    unusual = unusual_gains(fit.imu, weak, scales) if scales else []
    for finding in unusual:
        if finding.apply is not None:  # in wrong axes the unit is none of the population
            return row | _failure(NotPossibleError(f"{row['file']}: {finding.text.partition(';')[0]}."))
    kinds = len(EXCESS_NAMES) if unit.gyroscope else 1
    whole = np.zeros((len(PARAMETERS), len(PARAMETERS)))
    places = [PARAMETERS.index(name) for name in fit.names]
    whole[np.ix_(places, places)] = fit.covariance
    sigma = np.zeros(len(PARAMETERS))
    sigma[places] = fit.sigmas(settings.gravity.sigma)
    row = row | {
        "status": "ok",
        "accel_rms": float(rms[0]),
        "covariance": whole[_TRIANGLE],
        "excess": [*np.asarray(fit.excess[:kinds]).tolist(), *[None] * (3 - kinds)],
        "rank": rank,
        "weak": [direction.text for direction in weak],
        "notes": list(dict.fromkeys([*(row["notes"] or ()), *(finding.text for finding in unusual)])),
    }
    if row["turns"]:
        row["gyro_rms"] = float(rms[1])
    if unit.gyroscope and row["session"]:
        row |= _at_rest(unit.observations.poses, fit.imu)
    left = [name in open_numbers(weak) for name in PARAMETERS]
    values = flatten(fit.imu)
    known = np.ma.masked_array(sigma, left).tolist()
    for name, part in list(COLUMN_PLACES.items())[: 2 + 2 * unit.gyroscope]:
        row[name], row[f"{name}_sigma"] = values[part], known[part]
    if any(left):
        parts = listed(list(dict.fromkeys(f"{PARAMETERS[k].owner} {PARAMETERS[k].part}" for k in np.flatnonzero(left))))
        row["message"] = "; ".join(filter(None, [row["message"], _OPEN.format(parts)]))
    return row


def _at_rest(poses: Poses, imu: Imu) -> Json:
    """Return what a table keeps of a session's recording: when it rested, how it lay, and its gyroscope's rates."""
    real = np.asarray(poses.mask)
    force, rate = (
        imu.triad(name).recover_on_host(np.asarray(getattr(poses, f"{name}_mean"))[real])
        for name in ("accelerometer", "gyroscope")
    )
    times = ((np.asarray(poses.start) + np.asarray(poses.stop)) / 2)[real]
    return {"rest_time": times, "rest_up": (force / lengths_of(force)[:, None]).ravel(), "rest_rate": rate.ravel()}


def _require(fit: Fit, poses: int, where: str, sensor: str) -> None:
    if not fit.finite:
        raise NotPossibleError(f"{where}: {Failure.NONFINITE.value}.")
    require_spanning(fit.covariance / fit.sizes[:, None] / fit.sizes, fit.names, poses, where, sensor)
    if not fit.converged:
        raise NotPossibleError(f"{where}: {Failure.MAX_STEPS.value}.")


def _field(magnetometer: FieldUnit, fit: Fit, rms: FloatArray, where: str) -> Json:
    try:
        _require(fit, magnetometer.poses, where, "magnetometer")
    except NotPossibleError as error:
        return {"mag_message": _sentence(error)}
    return field_row(magnetometer, fit, float(rms[0]))
