"""A table of `jaximu fleet` held to limits and followed in time: verdicts by row, capability, charts, gauge, drift."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from jaximu.acceptance.acceptance import SCHEMA, Judged, judge
from jaximu.acceptance.decision import FAIL, PASS, UNDECIDED, Rule, worst
from jaximu.acceptance.item import Item
from jaximu.acceptance.limits import OF_ONE_UNIT, Limit, Limits, Scales
from jaximu.acceptance.quantities import Measured, Units, measure, share_of
from jaximu.acceptance.statistics import (
    Capability,
    Chart,
    Drift,
    Gauge,
    capability,
    control_chart,
    drift,
    gauge,
    tolerance_factor,
    with_ends,
)
from jaximu.acceptance.words import amount, parts_of, si_unit, spoken
from jaximu.fleets.population import FEWEST, LEVEL, days_of, read_fleet
from jaximu.fleets.rows import COLUMN_PLACES, PARAMETERS, covariances, free_places, require_table
from jaximu.ground.array_types import BoolArray, FloatArray, IntArray
from jaximu.ground.atomic import atomic_write
from jaximu.ground.distributions import student_two_sided
from jaximu.ground.document import Document, Json, entries, file_digest
from jaximu.ground.errors import FilePath, InputError, NotPossibleError
from jaximu.ground.page import Result
from jaximu.ground.quantities import Z95
from jaximu.ground.units import SENSORS
from jaximu.ground.vectors import root_or_zero, variances_of
from jaximu.model.sensor import Imu

_SHOWN_ITEMS = 1000  # of a table, that its document holds
_ROW = (
    "device",
    "file",
    "status",
    "date",
    "lot",
    "accel_gain",
    "accel_bias",
    "accel_nominal",
    "gyro_gain",
    "gyro_bias",
    "gyro_nominal",
    "gyro_unit",
    "accel_unit",
    "covariance",
    "accel_gain_sigma",
    "excess",
    "poses",
    "turns",
)


@dataclass(frozen=True)
class Batch:
    """Calibrated units of a fleet's table: which rows they are, their parameters, and what they are grouped by.

    rows: (n,) places in the table; total: of all rows. units: outputs in the table's units. days: since 1970, NaN where
    no date is known. nominal: the first row's, by triad.
    """

    file: str
    total: int
    rows: IntArray
    units: Units
    devices: tuple[str, ...]
    files: tuple[str, ...]
    days: FloatArray
    lots: tuple[str, ...]
    stations: tuple[str, ...]
    nominal: Scales


@dataclass(frozen=True)
class Alarm:
    """What charts, stations, lots or a golden unit show. kind: value, jump, average, station, lot or golden.

    texts, amounts: a sentence, a text and an amount in turns; an amount is a number in SI and its digits.
    """

    kind: str
    name: str
    where: str
    texts: tuple[str, ...]
    amounts: tuple[tuple[float, int], ...]

    @property
    def text(self) -> str:
        """The sentence, as documents have it."""
        return self.words()

    def words(self, stated: str = "") -> str:
        """Return the sentence with amounts in the unit that a file of limits states."""
        amounts = [amount(value, si_unit(self.name), digits, stated) for value, digits in self.amounts]
        return "".join(map(str.__add__, self.texts, [*amounts, ""]))

    def document(self) -> dict[str, str]:
        """Return the alarm as JSON has it."""
        return entries(self, "kind", "name", "where", "text")


@dataclass(frozen=True)
class FollowedQuantity:
    """One quantity along the line. charts: by station ("" for all), with the places of their units in order.

    lots: capability by lot, of lots with eight units or more, where there are several.
    """

    name: str
    limit: Limit | None
    capability: Capability | None
    lots: dict[str, Capability]
    charts: dict[str, tuple[Chart, IntArray]]
    gauge: Gauge | None
    drift: Drift | None


@dataclass(frozen=True, eq=False, repr=False)
class Line(Result, Document, page="line"):
    """A table's verdicts and statistics. verdicts: (rows,) of the table, undecided for what was not calibrated."""

    table: Batch
    limits: Limits | None
    judged: Judged | None
    measured: Measured
    verdicts: NDArray[np.str_]
    followed: tuple[FollowedQuantity, ...]
    alarms: tuple[Alarm, ...]
    golden: str
    notes: tuple[str, ...]

    @property
    def counts(self) -> Counter:
        """How many rows have which verdict."""
        return Counter(self.verdicts.tolist())

    @property
    def verdict(self) -> str:
        """The worst of all rows."""
        return worst(self.verdicts)

    def missed(self, row: int) -> list[str]:
        """Return the items that a calibrated unit (by its place among these) does not pass."""
        judged = self.judged
        return [] if judged is None else [judged.names[at] for at in np.flatnonzero(judged.verdict[row] != PASS)]

    def items(self, most: int = _SHOWN_ITEMS) -> list[tuple[str, Item]]:
        """Return device and item of what does not pass, failed ones and least probable ones first, so many at most."""
        if (judged := self.judged) is None:
            return []
        worst_first = np.lexsort([judged.probability.ravel(), (judged.verdict != FAIL).ravel()])
        kept = worst_first[(judged.verdict != PASS).ravel()[worst_first]][:most]
        indices = zip(*np.unravel_index(kept, judged.verdict.shape), strict=True)
        return [(self.table.devices[row], self._item(judged, int(row), int(index))) for row, index in indices]

    def judgement(self, row: int) -> list[Item]:
        """Return every item of a calibrated unit (by its place among these)."""
        judged = self.judged
        return [] if judged is None else [self._item(judged, row, index) for index in range(len(judged.names))]

    def _item(self, judged: Judged, row: int, index: int) -> Item:
        at = judged.places[index]
        known = at >= 0 and judged.measured.determined[row, at]
        result = judged.result(row, index) if known else {"reason": "not determined"}
        return Item.of(judged.limits[index], judged.names[index], **result)

    def document(self) -> Json:
        """Return verdicts and statistics as JSON has them; single units' verdicts stand in the table."""
        items = [item.document() | {"device": device} for device, item in self.items()]
        limits = self.limits
        return {
            "schema": SCHEMA,
            "verdict": self.verdict if limits else None,
            "table": self.table.file,
            "counts": dict(self.counts) if limits else None,
            "limits": limits and entries(limits, "file", "sha256"),
            "decision": limits and limits.rule.document(),
            "items": items,
            "line": [_entry(quantity) for quantity in self.followed],
            "alarms": [alarm.document() for alarm in self.alarms],
            "golden": self.golden or None,
            "notes": list(self.notes),
        }


def _entry(quantity: FollowedQuantity) -> Json:
    able = quantity.capability
    return {
        "name": quantity.name,
        "capability": able
        and entries(able, "mean", "deviation")
        | {
            "units": able.count,
            "cp": None if np.isnan(able.cp[0]) else with_ends(able.cp),
            "cpk": with_ends(able.cpk),
        },
        "cpk_by_lot": {lot: with_ends(able.cpk) for lot, able in quantity.lots.items()},
        "charts": {
            where: entries(chart, "centre", "deviation")
            | {"reach": chart.bound}
            | {name: len(getattr(chart, name)) for name in ("beyond", "jumps", "drifting")}
            for where, (chart, _) in quantity.charts.items()
        },
        "gauge": quantity.gauge and quantity.gauge.document(),
        "drift": quantity.drift and vars(quantity.drift),
    }


# --- the table --------------------------------------------------------------------------------------------------------


def read_table(path: FilePath) -> Batch:
    """Read the calibrated rows of a fleet's table.

    Raises `InputError` where it is no such table, `NotPossibleError` where nothing in it was calibrated.
    """
    name = os.fspath(path)
    require_table(path, _ROW)
    table = pq.read_table(path)
    good = np.array(table["status"].to_pylist()) == "ok"
    whole = good & table["gyro_gain"].is_valid().to_numpy(zero_copy_only=False)
    gyroscope = bool(whole.any())
    rows = np.flatnonzero(whole if gyroscope else good)
    if not len(rows):
        raise NotPossibleError(f"{name}: no unit of the table was calibrated; its column `message` says why.")
    kept = table.take(rows)

    def numbers(column: str) -> FloatArray:
        values = kept[column].combine_chunks()
        flat = values.flatten() if pa.types.is_fixed_size_list(values.type) else values
        return np.asarray(flat.to_numpy(zero_copy_only=False), float).reshape(len(rows), -1)

    def words(column: str) -> tuple[str, ...]:
        known = column in kept.column_names
        return tuple(text or "" for text in kept[column].to_pylist()) if known else ("",) * len(rows)

    triads = {short: SENSORS[short] for short in ("accel", "gyro")[: 1 + gyroscope]}
    outputs = {}
    for short, owner in triads.items():
        output_units = sorted(set(words(f"{short}_unit")))
        if len(output_units) > 1:
            raise InputError(f"{name}: the {owner}s are in {' and '.join(output_units)}: one table, one unit.")
        outputs[f"{owner}_unit"] = output_units[0]
    like = Imu.nominal(**outputs)
    values = np.concatenate([numbers(column) for column in list(COLUMN_PLACES)[: 2 * len(triads)]], axis=1)
    free = free_places(gyroscope)
    covariance = covariances(numbers("covariance"))[np.ix_(range(len(rows)), free, free)]
    # gravity's part is in the sigmas and not in the covariance; it acts on the accelerometer's gain as a whole
    scales = [0, 4, 8]
    variances = variances_of(covariance)[:, [free.index(index) for index in scales]]
    added = numbers("accel_gain_sigma")[:, scales] ** 2 - variances
    gravity = root_or_zero((added / values[:, scales] ** 2).mean(axis=1))
    by_gravity = np.where(np.array(free) < 9, values[:, free], 0.0) * gravity[:, None]
    units = Units(
        like if gyroscope else Imu(like.accelerometer, None),
        values,
        tuple(PARAMETERS[index] for index in free),
        covariance + by_gravity[:, :, None] * by_gravity[:, None, :],
        gravity,
        _conditions(numbers, gyroscope),
    )
    nominal = {owner: (numbers(f"{short}_nominal")[0, :3], np.zeros(3)) for short, owner in triads.items()}
    device, file, lot, station = map(words, ("device", "file", "lot", "station"))
    return Batch(name, len(table), rows, units, device, file, days_of(words("date")), lot, station, nominal)


def _conditions(
    numbers: Callable[[str], FloatArray], gyroscope: bool
) -> dict[tuple[str, str], tuple[FloatArray, FloatArray]]:
    """Degrees of freedom and shares of the scatter beyond the noise, as `Units` has them, by a table's columns."""
    poses, turns = (np.nan_to_num(numbers(column)[:, 0]) for column in ("poses", "turns"))
    share = np.nan_to_num(share_of(numbers("excess")))
    accelerometer = np.maximum(1.0, poses - 9), share[:, 0]
    conditions = {("accelerometer", part): accelerometer for part in ("gain", "bias")}
    if gyroscope:
        conditions["gyroscope", "gain"] = np.maximum(1.0, 2 * turns - 9), share[:, 1]
        conditions["gyroscope", "bias"] = np.maximum(1.0, 3 * poses - 3), share[:, 2]
    return conditions


def population_limits(path: FilePath, rule: Rule) -> Limits:
    """Return limits that hold 99 % of a table's population with 95 % confidence, for each parameter of both triads.

    Units that do not belong to the population, as `jaximu fleet` names them, are left out, and of each device the first
    recording counts. Raises `NotPossibleError` for fewer than ten units.
    """
    table = read_table(path)
    strange = {stranger.device for stranger in read_fleet(path).strangers}
    kept = np.array([index for index in _first_recordings(table) if table.devices[index] not in strange], int)
    if len(kept) < 10:
        raise NotPossibleError(f"{table.file}: {len(kept)} units are too few for limits of a population: it takes ten.")
    nominal = _in_counts(table, table.nominal)
    measured = measure(table.units, nominal, ())
    factor = tolerance_factor(len(kept))
    source = f"population of {len(kept)} units in {Path(table.file).name}: 99 % of it with 95 % confidence"
    limits = []
    for index, name in enumerate(measured.names):
        if measured.fixed[index]:
            continue
        values = measured.value[kept, index]
        _, owner, part, axes = parts_of(name)
        middle = float(np.mean(values))
        half = factor * float(np.std(values, ddof=1))
        limits.append(Limit(name, owner, part, axes, middle - half, middle + half, si_unit(name), source))
    return Limits(tuple(limits), rule, nominal, table.file, file_digest(path))


def _in_counts(table: Batch, nominal: Scales) -> dict:
    triads = table.units.like.triads()
    return {owner: scales for owner, scales in nominal.items() if triads[owner].output_unit == "count"}


def _first_recordings(table: Batch) -> IntArray:
    """Return the place of each device's first recording, by date, in the order of the dates; undated ones come last."""
    order = np.where(np.isnan(table.days), np.inf, table.days).argsort(kind="stable")
    return order[np.sort(np.unique(np.array(table.devices)[order], return_index=True)[1])]


# --- the line ---------------------------------------------------------------------------------------------------------


def follow(table: Batch, limits: Limits | None = None, golden: str = "") -> Line:
    """Hold a table's units to limits and question their course.

    **Arguments:** `golden`: the device that is recorded again and again to watch the line; it is left out of charts and
    capability. Without limits there are no verdicts and no capability. Of every other device the first recording is
    part of the charts.

    Raises `InputError` where there is no such device.
    """
    if golden and golden not in table.devices:
        raise InputError(f"{table.file}: there is no device {golden!r}; --golden names one of its column `device`.")
    notes = []
    verdicts = np.full(table.total, UNDECIDED, dtype="<U9")
    judged = None
    if limits is not None:
        judged = judge(table.units, limits)
        verdicts[table.rows] = [worst(row) for row in judged.verdict] if len(judged.names) else UNDECIDED
        left = [limit.key for limit in limits.limits if limit.part in OF_ONE_UNIT]
        if left:
            notes.append(f"limits of noise and navigation are of single units and were left out: {', '.join(left)}.")
        if table.total > len(table.rows):
            notes.append(f"{table.total - len(table.rows)} rows were not calibrated and count as undecided.")
    nominal = {**table.nominal, **(limits.nominal if limits else {})}
    measured = measure(table.units, _in_counts(table, nominal), ())
    first = _first_recordings(table)
    first = first[np.array(table.devices)[first] != golden]
    stations = sorted(set(table.stations))
    watched = (np.array(table.devices) == golden) & np.isfinite(table.days)
    shown = [column for column in range(len(measured.names)) if not measured.fixed[column]]
    by_name = {} if judged is None else dict(zip(judged.names, judged.limits, strict=True))
    followed = []
    alarms = []
    for column in shown:
        name = measured.names[column]
        values = measured.value[:, column]
        recording = root_or_zero(measured.sigma[:, column] ** 2 - measured.gravity[:, column] ** 2)
        charts = {}
        for station in stations:
            some = first[np.array(table.stations)[first] == station]
            if len(some) >= FEWEST:
                charts[station] = control_chart(values[some], LEVEL / len(shown) / len(stations)), some
        limit = by_name.get(name)
        able = capability(values[first], limit.low, limit.high) if limit is not None and len(first) > 1 else None
        lots = _groups(table.lots, first).items()
        by_lot = {lot: capability(values[some], limit.low, limit.high) for lot, some in lots if limit}
        study = gauge(values, recording, table.devices, table.stations)
        course = drift(table.days[watched], values[watched])
        followed.append(FollowedQuantity(name, limit, able, by_lot, charts, study, course))
        alarms += _alarms(table, name, charts, course, golden, len(shown))
        for kind, labels in (("station", table.stations), ("lot", table.lots)):
            alarms += _compared(kind, _groups(labels, first), name, values[first], first, len(shown))
    if not any(quantity.charts for quantity in followed):
        notes.append(f"fewer than {FEWEST} units: no control chart.")
    elif np.isnan(table.days[first]).all():
        notes.append("no dates are known: the charts follow the order of the table.")
    return Line(table, limits, judged, measured, verdicts, tuple(followed), tuple(alarms), golden, tuple(notes))


def _when(table: Batch, row: int) -> str:
    if np.isnan(table.days[row]):
        return table.devices[row]
    return f"{np.datetime64(round(table.days[row] * 86400), 's').astype('datetime64[D]')} ({table.devices[row]})"


def _alarms(
    table: Batch,
    name: str,
    charts: dict[str, tuple[Chart, IntArray]],
    course: Drift | None,
    golden: str,
    questions: int,
) -> Iterator[Alarm]:
    for station, (chart, places) in charts.items():
        what = spoken(name) + (f" at station {station}" if station else "")
        off = np.abs(chart.average - chart.centre)
        if len(chart.drifting):
            start = int(chart.drifting[0])
            most = int(chart.drifting[off[chart.drifting].argmax()])
            side = "above" if chart.average[most] > chart.centre else "below"
            texts = (
                f"{what}: the moving average left its limits at {_when(table, int(places[start]))} and is farthest, ",
                f" {side} the mean of all, at {_when(table, int(places[most]))}",
            )
            yield Alarm("average", name, station, texts, ((float(off[most]), 3),))
        # a value far off is a jump, too: it is said once
        kind, hits = ("value", chart.beyond) if len(chart.beyond) else ("jump", chart.jumps)
        if len(hits):
            before = np.concatenate([[np.nan], chart.values[:-1]])
            away = chart.values - (chart.centre if kind == "value" else before)
            most = int(hits[np.abs(away[hits]).argmax()])
            relation = "is off the mean by" if kind == "value" else "differs from the unit before by"
            more = f"; {len(hits) - 1} more units are beyond the limits" if len(hits) > 1 else ""
            texts = (f"{what}: {_when(table, int(places[most]))} {relation} ", more)
            yield Alarm(kind, name, station, texts, ((float(away[most]), 3),))
    if course is not None and course.p_value * questions < LEVEL:
        texts = (f"{spoken(name)} of the golden unit {golden} drifts by ", " in 30 days (± ", ", 95 %)")
        amounts = ((30 * course.slope, 3), (30 * Z95 * course.sigma, 2))
        yield Alarm("golden", name, "", texts, amounts)


def _groups(labels: Sequence[str], first: IntArray) -> dict[str, IntArray]:
    """Return the places of units with the same label, of labels with enough of them; empty where there is but one."""
    of_first = np.array(labels)[first]
    names = [label for label in sorted(set(of_first.tolist())) if label]
    return {
        label: first[of_first == label] for label in names if len(names) > 1 and (of_first == label).sum() >= FEWEST
    }


def _compared(
    kind: str,
    groups: dict[str, IntArray],
    name: str,
    values: FloatArray,
    first: IntArray,
    questions: int,
) -> Iterator[Alarm]:
    """Name the stations or lots whose units (first,) differ from the others', the surest first."""
    left = dict(groups)
    while len(left) > 1:
        shifts = {
            label: _shift(values, np.isin(first, places), np.isin(first, np.concatenate([*left.values()])))
            for label, places in left.items()
        }
        label = min(shifts, key=lambda label: shifts[label][1])
        shift, p_value = shifts[label]
        if p_value * questions * len(groups) >= LEVEL:
            break
        verb = "measures" if kind == "station" else "has"
        than = f" {'more' if shift > 0 else 'less'} than the other {kind}s"
        yield Alarm(kind, name, label, (f"{kind} {label} {verb} {spoken(name)} ", than), ((abs(shift), 3),))
        del left[label]  # those that remain are compared without it


def _shift(values: FloatArray, inside: BoolArray, all_of: BoolArray) -> tuple[float, float]:
    """Return by how much the values inside differ from the others in the mean, and the p-value of Welch's test."""
    sides = values[inside], values[all_of & ~inside]
    parts = np.array([np.var(side, ddof=1) / len(side) for side in sides])
    shift = float(sides[0].mean() - sides[1].mean())
    variance = float(parts.sum())
    freedom = variance**2 / float((parts**2 / np.array([len(side) - 1 for side in sides])).sum())
    return shift, float(student_two_sided(shift / np.sqrt(variance), freedom))


def write_verdicts(line: Line, path: FilePath) -> None:
    """Write the fleet's table with the columns `acceptance` (pass, fail, undecided) and `not_passed` (items), whole.

    Raises `InputError` where it cannot be written.
    """
    table = pq.read_table(line.table.file)
    table = table.drop_columns([name for name in ("acceptance", "not_passed") if name in table.column_names])
    by_row = {row: line.missed(index) for index, row in enumerate(line.table.rows.tolist())}
    missed = [by_row.get(row, []) for row in range(line.table.total)]
    table = table.append_column("acceptance", pa.array(line.verdicts.tolist(), pa.string()))
    table = table.append_column("not_passed", pa.array(missed, pa.list_(pa.string())))
    with atomic_write(path) as temporary:
        pq.write_table(table, temporary)
