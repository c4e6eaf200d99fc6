"""What a logger wrote: `Signal` and `Recording`, its origin, its axes, and whether it is plausible. NumPy, host side.

Frames: body axes are right-handed and belong to the sensor's case; specific force is +g on the axis that points up at
rest; angular rate follows the right-hand rule.
"""

import math
import re
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import combinations
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from jaximu.ground.array_types import BoolArray, FloatArray, IntArray
from jaximu.ground.differences import interpolated, midpoints
from jaximu.ground.equality import Comparable
from jaximu.ground.errors import InputError
from jaximu.ground.gravity import STANDARD, LocalGravity
from jaximu.ground.page import Result
from jaximu.ground.parameters import data_frame
from jaximu.ground.reexport import later
from jaximu.ground.tracing import is_traced
from jaximu.ground.units import INERTIAL_QUANTITIES, PREFIXES, SENSORS, STANDARD_GRAVITY
from jaximu.ground.vectors import lengths_of
from jaximu.recordings.alignment import CORRELATED, Turning, turning, turns_backwards
from jaximu.recordings.stamps import missing_samples

if TYPE_CHECKING:
    import pandas as pd  # pyright: ignore[reportMissingImports]
    import pyarrow as pa
    from matplotlib.figure import Figure


def _unset() -> FloatArray:
    return np.empty(0)


@dataclass(frozen=True, eq=False)
class Signal(Comparable):
    """The samples of one sensor on their own time stamps.

    time: (n,) seconds since `Recording.start`, strictly increasing.
    values: (n, m) sensor output in `unit`.
    unit: the output unit: "m/s^2", "rad/s", "degC", "uT", "rad", "1" (known units are converted at reading), or
        "count" for raw counts, which stay counts.
    nominal_scale: (m,) output units per SI unit; ones (the default) where the unit is physical.
    nominal_offset: (m,) output at zero input, in `unit`; zeros by default.
    clock_sigma: one sigma of the share by which its clock runs fast, where its stamps were put on another's clock.
    """

    time: FloatArray
    values: FloatArray
    unit: str
    nominal_scale: FloatArray = field(default_factory=_unset)
    nominal_offset: FloatArray = field(default_factory=_unset)
    clock_sigma: float = 0.0

    def __post_init__(self) -> None:
        if is_traced(self.time, self.values):
            raise InputError(
                "a recording cannot be traced: what is read, cut into poses and searched for mistakes is on the host. "
                "Observe it there (jaximu.observe), and trace what follows (jaximu.fit)."
            )
        # column by column: sums over the samples, the bulk of all work on a recording, are three times quicker
        values = np.asarray(self.values, float, order="F")
        values = values[:, None] if values.ndim == 1 else values
        axes = values.shape[1]
        fill = object.__setattr__
        fill(self, "time", np.asarray(self.time, float))
        fill(self, "values", values)
        for name, default in (("nominal_scale", 1.0), ("nominal_offset", 0.0)):
            nominal = np.asarray(getattr(self, name), float)
            fill(self, name, np.array(np.broadcast_to(nominal if nominal.size else default, (axes,))))
        if self.time.shape != (len(values),):
            raise ValueError(f"{self.time.shape[0]} time stamps for {len(values)} samples")

    def __len__(self) -> int:
        return len(self.time)

    def si(self) -> FloatArray:
        """(n, m) the output turned into physical units by the nominal scale and offset: `values` where it is so."""
        if not self.nominal_offset.any() and (self.nominal_scale == 1.0).all():
            return self.values
        return (self.values - self.nominal_offset) / self.nominal_scale

    @cached_property
    def rate(self) -> float:
        """Sample rate in Hz: samples over time, gaps left out.

        One over the median interval would be the rate at which stamps are rounded, or a logger polls.
        """
        return float(1.0 / np.diff(self.time)[missing_samples(self.time) == 0].mean())

    @property
    def edges(self) -> FloatArray:
        """(n + 1,) where samples begin and end: half way between neighbours, half a period beyond the outer two."""
        half = 0.5 / self.rate
        return np.concatenate([[self.time[0] - half], midpoints(self.time), [self.time[-1] + half]])

    def at(self, times: FloatArray) -> FloatArray:
        """(..., m) the output at times (...), along straight lines; the first and last value beyond the ends."""
        return interpolated(self.time, self.values, times)

    def samples(self, seconds: float) -> int:
        """Return how many samples so many seconds are; of a half, rounding of the rate does not decide."""
        return int(seconds * self.rate + 0.5 + 1e-9)

    @cached_property
    def step(self) -> FloatArray:
        """(m,) the step that the output of each axis comes in, in SI: the least difference of two of its values."""
        return np.array([np.min(steps) if len(steps) else 0.0 for steps in map(steps_of, self.si()[:20000].T)])

    @property
    def rounding_variance(self) -> float:
        """Variance, summed over the axes (SI units squared), of rounding to the steps that the output comes in."""
        return max(np.sum(self.step**2) / 12, 1e-24)


class Defect(str):
    """A note of what is wrong with a file's rows, told by reading it; `name` is that of the finding: "data.order" …"""

    name: str

    def __new__(cls, name: str, text: str) -> "Defect":
        made = super().__new__(cls, text)
        made.name = name
        return made

    def __getnewargs__(self) -> tuple[str, str]:
        return self.name, str(self)  # other processes get it too


@dataclass(frozen=True)
class Source:
    """A file that a recording came from: its path as given, the SHA-256 of its bytes, the rows of data it holds."""

    path: str
    sha256: str
    rows: int

    def refused(self, why: str) -> InputError:
        """Return what is raised where the file cannot be used, and why."""
        return InputError(f"{self.path}: {why}")


@dataclass(frozen=True)
class Reading:
    """How a log was read: kept with a calibration, so that the next log is read alike.

    columns, gyro_columns: names stated for the columns of files whose header, a name a column, is `header`.
    rate: stated for a log without a time column, Hz. axes: map to body axes, see `parse_axes`; None: those of the log.
    frame: "FRD" where the format defines its axes as an autopilot's: forward, right, down.
    units: by signal, as the file has them. scales: by triad in counts, counts per SI unit (3,); offsets: counts at zero
    input (3,); both in the log's axes. topic, instance, stamp: what was taken of a bag or flight log. device: whose
    rows were taken of a table of several units. corrected: whether the values are what an autopilot has made of its
    sensors' outputs by its parameters; None where the format leaves it open. sensors: by triad, the sensor in a flight
    log: PX4's device ID, ArduPilot's number.
    """

    columns: str | None = None
    gyro_columns: str | None = None
    header: Sequence[str] = ()
    rate: float | None = None
    axes: str | None = None
    frame: str | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    scales: Mapping[str, Sequence[float]] = field(default_factory=dict)
    offsets: Mapping[str, Sequence[float]] = field(default_factory=dict)
    topic: str | None = None
    instance: int | None = None
    stamp: str = "header"
    device: str | None = None
    corrected: bool | None = None
    sensors: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> "Reading":
        """Return what a calibration.json has as `reading`. Raises `ValueError` or `InputError` for what is none."""
        reading = cls(**{key.name: document[key.name] for key in fields(cls) if key.name in document})
        counts = np.array([*reading.scales.values(), *reading.offsets.values()], float).reshape(-1, 3)
        if not (reading.maps and np.isfinite([*counts.ravel(), reading.rate or 1.0]).all()):
            raise ValueError("the reading's scales, offsets and rate must be finite numbers")
        if reading.corrected not in (None, True, False):
            raise ValueError("the reading's `corrected` must be true, false or null")
        sensors = {name: int(sensor) for name, sensor in reading.sensors.items()}
        return replace(reading, units=dict(reading.units), sensors=sensors)

    @property
    def maps(self) -> dict[str, FloatArray]:
        """The maps (3, 3) from the log's axes to the body's, by triad."""
        return parse_axes(self.axes or "FLU")

    @property
    def autopilot_maps(self) -> dict[str, FloatArray]:
        """The maps (3, 3) from an autopilot's axes (forward, right, down) to the body's: those of its own log."""
        return self.maps if self.frame == "FRD" else parse_axes("FRD")

    def mapped(self, spec: str) -> "Reading":
        """Return the reading of a recording that was put in other axes once more."""
        if self.axes is None:
            return replace(self, axes=spec)
        maps = {name: matrix @ self.maps[name] for name, matrix in parse_axes(spec).items()}
        return replace(self, axes=";".join(f"{PREFIXES[name]}={spelled_axes(maps[name])}" for name in maps))

    def require_alike(self, other: "Reading | None", where: str, triads: Container[str]) -> None:
        """Raise `InputError` where triads of a log were read in other axes, or counts in another scale."""
        if other is None:
            return
        for name in [name for name in self.maps if name in triads]:
            if not np.array_equal(self.maps[name], other.maps[name]):
                raise InputError(
                    f"{where}: {_axes_words(other.axes)} contradict the calibration, whose log was read with "
                    f"{_axes_words(self.axes)}; leave --axes out, or calibrate again with the axes that are right."
                )
            scales = [reading.scales[name] for reading in (other, self) if name in reading.scales]
            if len(scales) == 2 and not np.allclose(*scales, rtol=_SAME_RANGE):
                here, there = (f"{np.mean(scale):.5g} counts per SI unit" for scale in scales)
                raise InputError(
                    f"{where}: the {name}'s scale, {here}, contradicts the calibration, whose log was read "
                    f"with {there}; leave --{PREFIXES[name]}-scale out, or calibrate again in this range."
                )


Stated = str | float | Sequence[float]
"""Scale or offset of raw counts as a user states it: for all axes alike, or for each."""


@dataclass(frozen=True)
class ReadOptions:
    """What a file does not say about itself.

    columns: names in order for all columns of the file, with units in brackets, separated by commas; replaces the
        header. "_" ignores a column, "accel [g]" stands for three. With a gyroscope file it may name both files'.
    gyro_columns: the same for the gyroscope's file.
    rate: sample rate in Hz, for files without a time column.
    axes: map to body axes, see `jaximu.recordings.recording.parse_axes`.
    accel_scale, gyro_scale: nominal scale of raw counts, see `jaximu.recordings.columns.nominal.parse_scale`.
    accel_offset, gyro_offset: counts at zero input.
    gravity: local gravity, from which the scale of a raw accelerometer is found.
    check: refuse what is not plausible, see `jaximu.recordings.recording.plausibility`.
    alone: take a file of a gyroscope alone; its accelerometer then has no samples.
    device: whose rows to take of a table in which several units write in turn.
    topic: of a file that holds more than one sensor of a kind, name of the message or topic; two of them,
        "accelerometer,gyroscope", where they are apart.
    instance: which of several sensors, from 0.
    stamp: "header" (the sensor's own, default) or "receive" (the logger's).
    like: how the log of a calibration was read, which is used where options and file leave something open: columns
        where the header is the same, axes where the file's writer has not applied them, rate and scales where needed.
        Axes and scales that contradict it are refused.
    """

    columns: str | Sequence[str] | None = None
    gyro_columns: str | Sequence[str] | None = None
    rate: float | None = None
    axes: str | None = None
    accel_scale: Stated | None = None
    accel_offset: Stated | None = None
    gyro_scale: Stated | None = None
    gyro_offset: Stated | None = None
    gravity: LocalGravity = STANDARD
    check: bool = True
    alone: bool = False
    device: str | None = None
    topic: str | None = None
    instance: int | None = None
    stamp: str = "header"
    like: Reading | None = None

    @property
    def known(self) -> Reading:
        """How the calibrated log was read; without one a reading that says nothing."""
        return self.like or Reading()


_SAME_RANGE = 0.05
"""Share by which two nominal scales of one range may differ: data sheets round, and gravity finds a sensor's own."""


_ABSOLUTE = 1e8
"""Seconds from which on a stamp counts from an epoch, and not from when a logger was switched on: three years."""


def whole_stamp(first: float) -> float:
    """Return the whole seconds of the first of absolute stamps, from which they are to be counted; else zero."""
    return float(np.floor(first)) if abs(first) > _ABSOLUTE else 0.0


def _axes_words(axes: str | None) -> str:
    return "axes as they are (FLU)" if axes is None else f"axes {axes}"


@dataclass(frozen=True, repr=False, eq=False)
class Recording(Result, Comparable, page="recording"):
    """One recording of one unit. Sensors carry their own stamps, which may differ; absent ones are None.

    Of a gyroscope alone (`ReadOptions.alone`) the accelerometer has no samples.

    accelerometer, gyroscope, magnetometer: triads, m = 3, body axes.
    temperature, ambient_temperature: m = 1, degC. current: m = 1, A. table_angle: m = 1, rad. table_rate: m = 1, rad/s.
    attitude: m = 4, unit quaternion w, x, y, z from body to lab.
    start: the logger's absolute stamp of t = 0, seconds. Absolute stamps of signals are counted from the first one.
    notes: sentences about what reading it had to assume, and `Defect`s.
    reading: how its file was read; None where it was made in memory.
    """

    accelerometer: Signal
    gyroscope: Signal | None = None
    temperature: Signal | None = None
    ambient_temperature: Signal | None = None
    current: Signal | None = None
    magnetometer: Signal | None = None
    table_angle: Signal | None = None
    table_rate: Signal | None = None
    attitude: Signal | None = None
    start: float = 0.0
    sources: tuple[Source, ...] = ()
    notes: tuple[str, ...] = ()
    reading: Reading | None = None

    def __post_init__(self) -> None:
        first = min((signal.time[0] for signal in self.signals.values() if len(signal)), default=0.0)
        if whole := whole_stamp(first):
            counted = {name: replace(signal, time=signal.time - whole) for name, signal in self.signals.items()}
            vars(self).update(counted, start=self.start + whole)

    @property
    def signals(self) -> dict[str, Signal]:
        """The signals that are there, by field name."""
        return {
            name: value
            for name, value in vars(self).items()
            if isinstance(value, Signal) and (len(value) or name != "accelerometer")
        }

    @cached_property
    def turning(self) -> Turning | None:
        """How its gyroscope explains what its accelerometer sees turn; None without a gyroscope."""
        accelerometer, gyroscope = self.accelerometer, self.gyroscope
        if gyroscope is None:
            return None
        return turning(accelerometer.time, accelerometer.si(), gyroscope.time, gyroscope.si())

    @property
    def remarks(self) -> tuple[str, ...]:
        """The notes that tell of no defect: those are findings."""
        return tuple(note for note in self.notes if not isinstance(note, Defect))

    @property
    def name(self) -> str:
        """The files it came from, for messages."""
        return " and ".join(source.path for source in self.sources) or "recording"

    @classmethod
    def from_dataframe(cls, frame: Any, options: "ReadOptions | None" = None) -> "Recording":
        """Return the recording in a data frame of pandas or polars, an Arrow table, or a mapping of columns by name.

        **Arguments:** `frame`: a row a sample, columns named as in files: `time [s]`, `accel_x [m/s^2]`, …,
        `gyro_x [deg/s]`, …; the unit in brackets is read, not assumed. `options`: what the columns do not say, such as
        `ReadOptions(columns="time [s],accel [g],gyro [deg/s]")`.

        Raises `InputError` naming the column or the row (from 1), as `read_recording` does.
        """
        return later("recordings.readers.reader", "read_frame")(frame, options)

    def to_arrow(self) -> "pa.Table":
        """Return the samples as an Arrow table, for `polars.from_arrow` and others, in the columns of files.

        Sensors with stamps of their own are put at the union of the stamps, with nulls in between.
        """
        return later("recordings.write", "arrow_table")(self)

    def to_pandas(self) -> "pd.DataFrame":
        """Return the samples as a pandas data frame, in the columns of files. Raises `InputError` without pandas."""
        return data_frame(self.to_arrow())

    def plot(self) -> "Figure":
        """Return a figure of all signals against time, in SI units; it shows itself in a notebook."""
        return later("report.figures", "signals_figure")(self)


def recordings_of(recordings: Any, *others: type) -> list[Any]:
    """Return one recording or several as a list. Raises InputError for anything else, saying how to read a file.

    **Arguments:** `others`: what may stand among them.
    """
    several = list(recordings) if isinstance(recordings, (list, tuple)) else [recordings]
    for value in several:
        if isinstance(value, (Recording, *others)):
            continue
        is_path = isinstance(value, (str, PathLike))
        what = f"the path {str(value)!r}" if is_path else f"a value of type {type(value).__name__}"
        how = f"jaximu.read_recording({str(value)!r})" if is_path else "jaximu.read_recording(path)"
        frame = "" if is_path else ", or jaximu.Recording.from_dataframe(frame)"
        raise InputError(f"expected a recording, found {what}: read it with {how}{frame}.")
    return several


def one_after_another(recordings: Sequence[Recording]) -> list[float]:
    """Return how long (s) after the first of several recordings began each one's clock is at zero, by absolute stamps.

    Empty where they do not follow each other: their stamps overlap, or the pauses are longer than what was recorded.
    """
    stamps = [next(iter(log.signals.values())).time for log in recordings]
    begins, ends = ([log.start + time[end] for log, time in zip(recordings, stamps, strict=True)] for end in (0, -1))
    pauses, recorded = np.sort(begins)[1:] - np.sort(ends)[:-1], np.sum(ends) - np.sum(begins)
    if not len(pauses) or min(pauses) < 0 or np.sum(pauses) > recorded:
        return []
    return [log.start - min(begins) for log in recordings]


def same_outputs(recordings: Sequence[Recording], alone: bool = False) -> tuple[str, ...]:
    """Raise `InputError` where recordings of one unit have not the same sensors and units, or one is there twice.

    Return notes of those that were read in other axes than the first, whose reading a calibration keeps.

    **Arguments:** `alone`: whether a gyroscope without an accelerometer will do.
    """
    if not recordings:
        raise InputError("no recording was given.")
    first = recordings[0]
    lacking = [recording for recording in recordings if not len(recording.accelerometer)]
    if lacking and (not alone or len(lacking) < len(recordings)):
        needed = "the other recording has one" if alone else "one is needed"
        raise InputError(f"{lacking[0].name} has no accelerometer, but {needed}.")
    for other in recordings[1:]:
        for name in INERTIAL_QUANTITIES:
            a, b = getattr(first, name), getattr(other, name)
            if (a is None) != (b is None):
                raise InputError(
                    f"{(first if a is None else other).name} has no {name}, but the other recording has one."
                )
            if a is not None and (a.unit != b.unit or not np.allclose(a.nominal_scale, b.nominal_scale, rtol=0.2)):
                raise InputError(f"{first.name} and {other.name} give the {name} in different units or scales.")
    for before, other in combinations(recordings, 2):
        signals = before.signals
        if signals.keys() == other.signals.keys() and all(
            np.array_equal(signals[name].values, signal.values) for name, signal in other.signals.items()
        ):
            raise InputError(f"{other.name} is the same recording as {before.name}: name it once.")
    axes = [None if recording.reading is None else str(recording.reading.maps) for recording in recordings]
    return tuple(
        f"{recording.name} was read in other axes than {first.name}, whose reading the calibration keeps."
        for recording, other in zip(recordings, axes, strict=True)
        if None not in (axes[0], other) and other != axes[0]
    )


@dataclass(frozen=True, eq=False)
class PoseMeans(Comparable):
    """A table of poses at rest, a sample of `recording` a pose: its stamps count the rows and mean nothing.

    accelerometer_sigma, gyroscope_sigma: (P, 3) standard deviations of the means, in the signal's unit, or None.
    """

    recording: Recording
    accelerometer_sigma: FloatArray | None = None
    gyroscope_sigma: FloatArray | None = None


# --- axes -----------------------------------------------------------------------------------------------------------

_NAMED_AXES = {"FLU": "x,y,z", "FRD": "x,-y,-z"}


def axis_matrix(text: str) -> FloatArray:
    """(3, 3) signed permutation of one axis map: FLU (as it is), FRD, or three signed source axes such as "y,-x,z".

    Row i picks the source axis (with its sign) that becomes body axis i. Raises InputError.
    """
    axes = _NAMED_AXES.get(text.strip().upper(), text)
    terms = re.fullmatch(r"\s*([+-]?[xyz])\s*[, ]\s*([+-]?[xyz])\s*[, ]\s*([+-]?[xyz])\s*", axes, re.IGNORECASE)
    matrix = np.zeros((3, 3))
    for row, term in enumerate(terms.groups() if terms else ()):
        matrix[row, "xyz".index(term[-1].lower())] = -1.0 if term[0] == "-" else 1.0
    if abs(np.linalg.det(matrix)) != 1.0:
        raise InputError(f"--axes: axis map {text!r} is not understood; write FLU, FRD, or signed axes such as y,-x,z.")
    return matrix


def parse_axes(spec: str) -> dict[str, FloatArray]:
    """The (3, 3) map of each triad ("accelerometer", "gyroscope", "magnetometer") from an `--axes` text.

    Parts are separated by ";". A part is a map for all triads alike ("FRD", "y,-x,z"), a map for one triad
    ("accel=x,-y,-z", "gyro=…", "mag=…"), or "-f": the logger recorded −f, so the accelerometer's sign is turned.
    A single map must be right-handed; maps written for each triad may mirror. Raises InputError.
    """
    maps = dict.fromkeys(SENSORS.values(), np.eye(3))
    sign = 1.0
    for part in filter(None, (part.strip() for part in spec.split(";"))):
        key, equals, value = part.partition("=")
        if part == "-f":
            sign = -1.0
        elif equals and key.strip() in SENSORS:
            maps[SENSORS[key.strip()]] = axis_matrix(value)
        elif equals:
            raise InputError(f"--axes: axis map {part!r}: the triad must be accel, gyro or mag.")
        else:
            matrix = axis_matrix(part)
            if np.linalg.det(matrix) < 0.0:
                raise InputError(
                    f"--axes: axis map {part!r} is a mirror image, under which rates turn otherwise than forces; "
                    "write separate maps, such as accel=x,y,-z;gyro=-x,-y,z, or -f for a logger that records −f."
                )
            maps = dict.fromkeys(SENSORS.values(), matrix)
    return maps | {"accelerometer": sign * maps["accelerometer"]}


def spelled_axes(matrix: FloatArray) -> str:
    """The text of a signed permutation (3, 3) as `axis_matrix` reads it: "x,-z,y"."""
    columns = np.abs(matrix).argmax(axis=1)
    return ",".join("-" * bool(row[column] < 0) + "xyz"[column] for row, column in zip(matrix, columns, strict=True))


def map_signal(signal: Signal, matrix: FloatArray) -> Signal:
    """The signal in new axes, output' = A·output, with its nominal scale and offset taken along."""
    return replace(
        signal,
        values=signal.values @ matrix.T,
        nominal_scale=np.abs(matrix) @ signal.nominal_scale,
        nominal_offset=matrix @ signal.nominal_offset,
    )


def apply_axes(recording: Recording, spec: str) -> Recording:
    """The recording with its triads in body axes, mapped by `parse_axes(spec)`; a reference attitude stays as it is."""
    maps = parse_axes(spec)
    mapped = {name: map_signal(getattr(recording, name), maps[name]) for name in maps if getattr(recording, name)}
    reading = None if recording.reading is None else recording.reading.mapped(spec)
    return replace(recording, **mapped, notes=(*recording.notes, f"axes mapped: {spec}."), reading=reading)


# --- plausibility ---------------------------------------------------------------------------------------------------


def plausibility(recording: Recording, gravity: LocalGravity = STANDARD) -> tuple[str, ...]:
    """Checks that the physics fits the stated units; returns notes, raises InputError saying what to change.

    The median magnitude of the specific force must be near gravity; the gyroscope must explain how fast gravity turns
    in the body (this finds degrees taken for radians even in slow motion, and mirrored axes); temperatures must be
    above absolute zero.
    """
    where, accelerometer, gyroscope = recording.name, recording.accelerometer, recording.gyroscope
    level = np.median(lengths_of(accelerometer.si())) / gravity.value if len(accelerometer) else 1.0
    plausible = 0.5 < level < 2.0
    if not plausible:
        _require_own_columns(recording, gravity)
    if 0.0 < level < 0.06 and accelerometer.unit != "count" and _no_gravity(accelerometer):
        raise InputError(
            f"{where}: the median magnitude of accel_x, accel_y, accel_z is {level * gravity.value:.2g} m/s², and it "
            "has no constant part: gravity was taken out (a linear acceleration, data.gravity_free). Log the raw "
            "accelerometer."
        )
    _require_one_unit(recording)
    if not plausible:
        text = f"{where}: the median magnitude of accel_x, accel_y, accel_z is {level * gravity.value:.4g} m/s²"
        if accelerometer.unit == "count":
            raise InputError(f"{text} at this scale, not {gravity.value:.4g}; check --accel-scale and --accel-offset.")
        raise InputError(f"{text}, not {gravity.value:.4g} as gravity is; {_unit_advice(1.0 / level, _ACCEL_SLIPS)}.")
    for name, signal in recording.signals.items():
        if "temperature" in name and len(signal) and signal.values.min() < -273.15:
            raise InputError(f"{where}: column {name} falls to {signal.values.min():.4g} °C, below absolute zero.")
    if gyroscope is None or len(gyroscope) < 2 or len(accelerometer) < 2:
        return ()
    peak = np.percentile(lengths_of(gyroscope.si()), 99.0)
    assert recording.turning is not None
    *_, slope, correlation = recording.turning
    if abs(correlation) > CORRELATED and not 1.0 / 3.0 < abs(slope) < 3.0:
        raise InputError(
            f"{where}: gyro_x, gyro_y, gyro_z read {1.0 / abs(slope):.3g} times the rate at which gravity turns "
            f"in the accelerometer; {_time_advice(gyroscope) or _gyro_advice(gyroscope, abs(slope))}."
        )
    if len(gyroscope) > 1000 and (not _mean_rate(gyroscope) < FASTEST or _slowed(recording)):
        raise InputError(f"{where}: {_time_advice(gyroscope)}.")
    if peak > 100.0:
        raise InputError(
            f"{where}: gyro_x, gyro_y, gyro_z reach {peak:.4g} rad/s, faster than any such sensor measures; "
            f"{_gyro_advice(gyroscope, 1.0 / 57.3)}."
        )
    if correlation < -CORRELATED and turns_backwards(
        accelerometer.time, accelerometer.si(), gyroscope.time, gyroscope.si()
    ):
        return (
            "the gyroscope turns against the accelerometer: one of them is in mirrored or opposite axes; check --axes.",
        )
    return ()


_ACCEL_SLIPS = {
    "g": STANDARD_GRAVITY,
    "mg": STANDARD_GRAVITY * 1e-3,
    "m/s², stated as g": 1 / STANDARD_GRAVITY,
    "mg, stated as g": 1e-3,
}
_GYRO_SLIPS = {"deg/s": 1 / 57.29578, "rad/s, stated as deg/s": 57.29578, "mdeg/s": 1 / 57295.78, "mrad/s": 1e-3}


def _require_own_columns(recording: Recording, gravity: LocalGravity) -> None:
    """Raise `InputError` where the gyroscope's columns hold the gravity that the accelerometer's do not."""
    gyroscope = recording.gyroscope
    if gyroscope is None or not len(gyroscope) or _no_gravity(gyroscope):
        return
    level = np.median(lengths_of(gyroscope.values))
    if any(abs(level / size - 1) < 0.1 for size in (gravity.value, 1.0, 1000.0)):  # m/s², g, mg
        raise InputError(
            f"{recording.name}: the magnitude of gyro_x, gyro_y, gyro_z stays at {level:.4g} as gravity's does, and "
            "that of accel_x, accel_y, accel_z does not: these columns are exchanged; change the header or --columns."
        )


_PARTS, _ANOTHER_UNIT = 10, 5.0
"""Parts of a recording that are compared, and by what factor its beginning and its end differ in two units."""


def _require_one_unit(recording: Recording) -> None:
    """Raise `InputError` where a sensor's unit changes: gravity, or how fast it turns, is another from some time on."""
    accelerometer, gyroscope = recording.accelerometer, recording.gyroscope
    force, parts = accelerometer.si(), np.array_split(np.arange(len(accelerometer)), _PARTS)
    if len(parts[-1]) < 2:  # means of poses: nothing to compare
        return
    levels = {"accel_x, accel_y, accel_z": [np.median(lengths_of(force[part])) for part in parts]}
    if gyroscope is not None:
        rates, ratios = gyroscope.si(), []
        for part in parts:
            time = accelerometer.time[part]
            inside = slice(*np.searchsorted(gyroscope.time, time[[0, -1]]))
            turned = turning(time, force[part], gyroscope.time[inside], rates[inside])
            ratios.append(1 / abs(turned.slope) if abs(turned.correlation) > CORRELATED else np.nan)
        levels["gyro_x, gyro_y, gyro_z"] = ratios
    for columns, level in levels.items():
        step_part, factor = _step(np.log(np.maximum(level, 1e-9)))
        if not 1 / _ANOTHER_UNIT <= factor <= _ANOTHER_UNIT:
            raise InputError(
                f"{recording.name}: from about {accelerometer.time[parts[step_part][0]]:.3g} s on, {columns} read "
                f"{factor:.3g} times what they read before: the unit changes within the file (data.units). Cut the "
                "file there, or bring its rows to one unit."
            )


def _step(logarithms: FloatArray) -> tuple[int, float]:
    """Return the part at which a step lies, and its factor: 1 unless all before it and all after it are much alike."""
    clearest, result = 0.0, (0, 1.0)
    for part in range(1, len(logarithms) - 1):  # which may hold the step itself
        before, after = (side[np.isfinite(side)] for side in (logarithms[:part], logarithms[part + 1 :]))
        if len(before) < 2 or len(after) < 2:
            continue
        step, spread = np.median(after) - np.median(before), max(np.ptp(before), np.ptp(after))
        if spread < abs(step) / 2 and abs(step) - spread > clearest:
            changed = abs(logarithms[part] - np.median(after)) < abs(step) / 2
            clearest, result = abs(step) - spread, (part if changed else part + 1, float(np.exp(step)))
    return result


SLOWEST, FASTEST = 2.0, 50e3
"""Hz: beyond, the rate of a log of turns is that of stamps in another unit."""


def _mean_rate(signal: Signal) -> float:
    """Samples a second over the whole signal, because stamps may come in bursts."""
    return (len(signal) - 1) / float(signal.time[-1] - signal.time[0])


def _slowed(recording: Recording) -> bool:
    """Whether the rates explain how gravity turns only if the stamps, of a slow log, are a thousand times as close."""
    force, rate = recording.accelerometer, recording.gyroscope
    if rate is None or _mean_rate(rate) > SLOWEST:
        return False
    closer = (
        turning(force.time * factor, force.values, rate.time * factor, rate.values).correlation
        for factor in (1e-3, 1e-6)
    )
    return max(map(abs, closer)) > CORRELATED


def _time_advice(gyroscope: Signal) -> str:
    """What the stamps are likely to be in, where their rate is none of a log of turns."""
    rate = _mean_rate(gyroscope)
    if SLOWEST < rate < FASTEST:
        return ""
    return (
        f"the stamps make it {rate:.3g} samples a second: the unit of the time column is wrong "
        "(data.time_scale); change it in the header or with --columns"
    )


def _no_gravity(signal: Signal) -> bool:
    """Whether the norm varies as much as it is large: in another unit gravity's would stay the same at rest."""
    low, high = np.quantile(lengths_of(signal.si()), [0.2, 0.8])
    return bool(high > 1.3 * low)


def _gyro_advice(gyroscope: Signal, ratio: float) -> str:
    otherwise = "no unit makes this factor: check --columns, and whether one of the two sensors was smoothed"
    return "check --gyro-scale" if gyroscope.unit == "count" else _unit_advice(ratio, _GYRO_SLIPS, otherwise)


def _unit_advice(
    ratio: float, slips: Mapping[str, float], otherwise: str = "check the unit in the column name or in --columns"
) -> str:
    """What the column is likely to be in, when true = ratio · stated."""
    nearest, off = likeliest(ratio, slips)
    if off > np.log(1.6):
        return otherwise
    return f"these columns look like {nearest}: change the unit in the header or with --columns"


def likeliest(size: float, known: Mapping[str, float]) -> tuple[str, float]:
    """Return the name of the known size that is nearest to a size by their ratio, and the logarithm it is off by."""
    off = {name: abs(math.log(size / value)) for name, value in known.items()}
    nearest = min(off, key=off.__getitem__)
    return nearest, off[nearest]


def steps_of(values: FloatArray) -> FloatArray:
    """Return the differences (k,) of neighbouring levels of an axis (n,), rounding apart."""
    steps = np.diff(np.unique(values))
    return steps[steps > 1e-9 * np.ptp(values)]


def floor_of(values: FloatArray) -> float:
    """Return what values (n,) are where they are lowest: the median of those up to thrice the lowest twentieth's."""
    return float(np.median(values[values <= 3 * np.percentile(values, 5)]))


def runs_of(flags: BoolArray) -> IntArray:
    """(k, 2) first and last + 1 of every run of True."""
    return np.flatnonzero(np.diff(flags, prepend=False, append=False)).reshape(-1, 2)


def smoothed_slope(time: FloatArray, values: FloatArray, window: float) -> FloatArray:
    """(n,) rate of change of values (n,) per second: the slope of a straight line through `window` seconds about each.

    A step of height h becomes a bump of at most 1.5 h/window. At the ends the line goes through what there is of the
    window, at least two samples.
    """
    time, values = time - time.mean(), values - values.mean()
    here = np.arange(len(time))
    first = np.minimum(time.searchsorted(time - window / 2, "left"), np.maximum(here - 1, 0))
    last = np.maximum(time.searchsorted(time + window / 2, "right"), np.minimum(here + 2, len(time)))

    def total(terms: FloatArray) -> FloatArray:
        running = np.cumulative_sum(terms, include_initial=True)
        return running[last] - running[first]

    count, sum_time = last - first, total(time)
    across = total(time * values) - sum_time * total(values) / count
    spread = total(time**2) - sum_time**2 / count
    return np.divide(across, spread, out=np.zeros_like(time), where=spread > 0)
