"""The fleet as evidence: how its parameters are spread, which units do not belong, what lots and dates change.

A unit's parameters x are drawn from a population N(μ, Σ) and known as y = x + e, e ~ N(0, C), C the covariance of its
own fit. μ and Σ are found by maximum likelihood (EM; units that do not belong are left out), and give each unit a
posterior: empirical Bayes, which pulls a direction towards the population the more, the less the unit's own recording
tells of it (Efron and Morris, Journal of the American Statistical Association 70, 1975; here with full matrices).
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import scipy
from numpy.typing import NDArray

from jaximu.errors import InputError, NotPossibleError
from jaximu.fleet.rows import PARAMETERS, SCHEMA
from jaximu.formats.atomic import atomic_write

__all__ = ["Difference", "Fleet", "Population", "Stranger", "estimate_population", "read_fleet", "write_shrunk"]

FloatArray = NDArray[np.float64]
FEWEST = 8
"""Units from which a population is spoken of."""
_MOST = 4000
"""Units that the population is estimated from, evenly taken from a larger fleet: more change no digit that counts."""
_LEVEL = 0.01
"""Probability of one false alarm in the whole fleet, for each kind of question."""
_ROUNDS = 200
_COLUMNS = ("device", "file", "status", "verdict", "effects", "date", "lot", "accel_gain", "accel_bias", "gyro_gain",
            "gyro_bias", "accel_nominal", "gyro_nominal", "covariance", "accel_rms", "gyro_rms")  # fmt: skip


@dataclass(frozen=True)
class Population:
    """Mean (p,) and covariance (p, p) of parameters relative to the data sheet: gains in scales, biases in SI.

    alone: standard deviations (p,) of the estimates as they are, their own noise included. count: units it rests on.
    """

    names: tuple[str, ...]
    mean: FloatArray
    covariance: FloatArray
    alone: FloatArray
    count: int

    @property
    def spread(self) -> FloatArray:
        """Standard deviations (p,) between units, the noise of their estimates taken off."""
        return np.sqrt(np.diagonal(self.covariance))

    def shrink(self, values: FloatArray, covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the posterior means (n, p) and covariances (n, p, p) of estimates (n, p) with theirs (n, p, p)."""
        total = self.covariance + covariances
        gain = np.swapaxes(np.linalg.solve(total, np.broadcast_to(self.covariance, total.shape)), 1, 2)
        posterior = self.covariance - gain @ self.covariance
        mean = self.mean + np.einsum("nij,nj->ni", gain, values - self.mean)
        return mean, (posterior + np.swapaxes(posterior, 1, 2)) / 2

    def distances(self, values: FloatArray, covariances: FloatArray) -> FloatArray:
        """Return the squared distances (n,) from the population, χ² with p degrees for units that belong."""
        rest = values - self.mean
        return np.einsum("ni,ni->n", rest, np.linalg.solve(self.covariance + covariances, rest[..., None])[..., 0])


@dataclass(frozen=True)
class Stranger:
    """A unit that does not belong: p_value corrected for the number of units; its most extreme parameters."""

    device: str
    file: str
    p_value: float
    parameters: tuple[tuple[str, float, float], ...]  # name, value, in standard deviations


@dataclass(frozen=True)
class Difference:
    """What a lot, a date or an effect changes: group against the rest, slope against time, share against share.

    kind: "lot", "date", "device" or "effect". p_value: corrected for all questions of its kind. parameters: name,
    amount (per year for dates), sigma.
    """

    kind: str
    group: str
    count: int
    p_value: float
    parameters: tuple[tuple[str, float, float], ...]
    text: str


@dataclass(frozen=True)
class Fleet:
    """A table's units as a population, and what stands out.

    values, sigma, shrunk, shrunk_sigma: (n, p) of at most `_MOST` units, alone and with the population as prior. lots:
    theirs, "" where none is known. rms: (n, 2), of the norm of gravity (m/s²) and of carried gravity (degrees).
    """

    table: str
    recordings: int
    statuses: Counter
    verdicts: Counter
    effects: Counter
    population: Population | None
    strangers: tuple[Stranger, ...]
    differences: tuple[Difference, ...]
    values: FloatArray
    shrunk: FloatArray
    sigma: FloatArray
    shrunk_sigma: FloatArray
    lots: tuple[str, ...]
    rms: FloatArray
    notes: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """Return the findings as a JSON document of schema `jaximu.fleet/1`."""
        population = self.population
        return {
            "schema": "jaximu.fleet/1",
            "table": self.table,
            "recordings": self.recordings,
            "statuses": dict(sorted(self.statuses.items())),
            "verdicts": dict(sorted(self.verdicts.items())),
            "effects": dict(self.effects.most_common()),
            "population": None if population is None else {
                "units": population.count,
                "parameters": list(population.names),
                "mean": population.mean.tolist(),
                "spread": population.spread.tolist(),
                "covariance": population.covariance.tolist(),
            },
            "strangers": [
                {"device": each.device, "file": each.file, "p_value": each.p_value,
                 "parameters": [{"name": n, "value": v, "deviations": z} for n, v, z in each.parameters]}
                for each in self.strangers
            ],
            "differences": [
                {"kind": each.kind, "group": each.group, "count": each.count, "p_value": each.p_value,
                 "text": each.text,
                 "parameters": [{"name": n, "amount": a, "sigma": s} for n, a, s in each.parameters]}
                for each in self.differences
            ],
            "notes": list(self.notes),
        }  # fmt: skip


# --- the population ---------------------------------------------------------------------------------------------------


def estimate_population(names: Sequence[str], values: FloatArray, covariances: FloatArray) -> Population:
    """Estimate mean and covariance of a population from estimates (n, p) and their covariances (n, p, p).

    Units farther off than one in a hundred fleets would have are left out, at most half. With few units the covariance
    leans towards its diagonal: p units' worth of none. Raises `NotPossibleError` for fewer than `FEWEST` units.
    """
    count, size = values.shape
    if count < FEWEST:
        raise NotPossibleError(f"{count} calibrated units are too few for a population: it takes {FEWEST} or more.")
    mean = np.median(values, axis=0)
    own = np.median(np.diagonal(covariances, axis1=1, axis2=2), axis=0)
    scatter = np.square(1.4826 * np.median(np.abs(values - mean), axis=0))
    covariance = np.diag(np.maximum(scatter - own, 0.01 * scatter + 1e-18))
    limit = float(scipy.stats.chi2.isf(_LEVEL / count, size))
    kept = np.zeros(count, bool)
    for _ in range(10):
        distance = Population(tuple(names), mean, covariance, own, count).distances(values, covariances)
        again = distance <= max(limit, float(np.median(distance)))
        if (again == kept).all():
            break
        kept = again
        mean, covariance = _maximise(values[kept], covariances[kept], mean, covariance)
    return Population(tuple(names), mean, covariance, np.std(values[kept], axis=0, ddof=1), int(kept.sum()))


def _maximise(values, covariances, mean, covariance):
    """EM for the mean and covariance of the true parameters."""
    count, size = values.shape
    for _ in range(_ROUNDS):
        population = Population((), mean, covariance, mean, count)
        found, spread = population.shrink(values, covariances)
        better = found.mean(axis=0)
        rest = found - better
        summed = rest.T @ rest + spread.sum(axis=0)
        # p units without correlations: what keeps the matrix regular when there are hardly more units than parameters
        fresh = (summed + size * np.diag(np.diagonal(summed) / count)) / (count + size)
        change = np.max(np.abs(np.sqrt(np.diagonal(fresh) / np.diagonal(covariance)) - 1))
        mean, covariance = better, fresh
        if change < 1e-3:
            break
    return mean, covariance


# --- the table --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Units:
    """Calibrated units of a table: parameters relative to the data sheet, and what they are grouped by."""

    names: tuple[str, ...]
    values: FloatArray
    covariances: FloatArray
    rows: list[dict[str, Any]]


def _free(gyroscope: bool) -> list[int]:
    fixed = {"accelerometer.gain[0,1]", "accelerometer.gain[0,2]", "accelerometer.gain[1,2]"}
    return [place for place, name in enumerate(PARAMETERS)
            if name not in fixed and (gyroscope or name.startswith("accelerometer"))]  # fmt: skip


def _units(rows: Sequence[dict[str, Any]], gyroscope: bool) -> _Units:
    """Bring calibrated rows to one scale: gains in nominal scales, biases as inputs in SI."""
    places = _free(gyroscope)
    count, size = len(rows), len(PARAMETERS)
    raw, factor, offset = np.zeros((count, size)), np.ones((count, size)), np.zeros((count, size))
    for start, name in ((0, "accel"), (12, "gyro"))[: 1 + gyroscope]:
        gain, bias, nominal = (np.array([row[f"{name}_{part}"] for row in rows], float).reshape(count, -1)
                               for part in ("gain", "bias", "nominal"))  # fmt: skip
        raw[:, start : start + 9], raw[:, start + 9 : start + 12] = gain, bias
        factor[:, start : start + 9] = np.repeat(nominal[:, :3], 3, axis=1)
        factor[:, start + 9 : start + 12] = nominal[:, :3]
        offset[:, start + 9 : start + 12] = nominal[:, 3:]
    triangle = np.zeros((count, size, size))
    low = np.tril_indices(size)
    triangle[:, low[0], low[1]] = np.array([row["covariance"] for row in rows], float).reshape(count, -1)
    whole = triangle + np.swapaxes(np.tril(triangle, -1), 1, 2)
    whole = whole / factor[:, :, None] / factor[:, None, :]
    relative = (raw - offset) / factor
    grid = np.ix_(range(count), places, places)
    return _Units(tuple(PARAMETERS[place] for place in places), relative[:, places], whole[grid], list(rows))


def _groups(path: Path, gyroscope: bool, columns: Sequence[str] | None = None) -> Iterator[list[dict[str, Any]]]:
    """Give the calibrated rows of a table that have (or lack) a gyroscope, some at a time."""
    with pq.ParquetFile(path) as file:
        for batch in file.iter_batches(batch_size=1024, columns=None if columns is None else list(columns)):
            rows = batch.to_pylist()
            yield [row for row in rows if row["status"] == "ok" and (row["gyro_gain"] is not None) == gyroscope]


def read_fleet(table: str | os.PathLike[str]) -> Fleet:
    """Question a table of `jaximu fleet` as a whole. Raises `InputError` where it is no such table."""
    path = Path(table)
    try:
        with pq.ParquetFile(path) as file:
            schema = file.schema_arrow
    except (OSError, pa.ArrowException) as error:
        raise InputError(f"{path}: is not a fleet's table ({str(error).splitlines()[0]}).") from error
    missing = [name for name in (*_COLUMNS, "gyro_unit") if name not in schema.names]
    if missing:
        raise InputError(f"{path}: is not a fleet's table: the column {missing[0]} is missing.")
    statuses, verdicts, effects = Counter(), Counter(), Counter()
    with_gyroscope = without = 0
    with pq.ParquetFile(path) as file:
        for batch in file.iter_batches(batch_size=4096, columns=["status", "verdict", "effects", "gyro_unit"]):
            for row in batch.to_pylist():
                statuses[row["status"]] += 1
                if row["verdict"]:
                    verdicts[row["verdict"]] += 1
                effects.update(row["effects"] or ())
                if row["status"] == "ok":
                    with_gyroscope += row["gyro_unit"] is not None
                    without += row["gyro_unit"] is None
    gyroscope = with_gyroscope >= without
    total = max(with_gyroscope, without)
    notes = []
    if min(with_gyroscope, without):
        notes.append(
            f"{min(with_gyroscope, without)} units {'without' if gyroscope else 'with'} a gyroscope are not part of "
            "the population."
        )
    step = max(1, -(-total // _MOST))
    kept: list[dict[str, Any]] = []
    seen = 0
    for rows in _groups(path, gyroscope, _COLUMNS):
        kept += [row for number, row in enumerate(rows, seen) if number % step == 0]
        seen += len(rows)
    if step > 1:
        notes.append(f"the population was estimated from {len(kept)} of {total} units, evenly taken.")
    empty = np.empty((0, 0))
    base: dict[str, Any] = {
        "table": os.fspath(table), "recordings": sum(statuses.values()), "statuses": statuses, "verdicts": verdicts,
        "effects": effects, "population": None, "strangers": (), "differences": (), "values": empty, "shrunk": empty,
        "sigma": empty, "shrunk_sigma": empty, "lots": (), "rms": empty,
    }  # fmt: skip
    if len(kept) < FEWEST:
        return Fleet(**base, notes=(*notes, f"fewer than {FEWEST} calibrated units: no population."))
    units = _units(kept, gyroscope)
    differences, shift = _lots(units)
    centred = units.values - shift
    population = estimate_population(units.names, centred, units.covariances)
    differences += _dates(units, population, centred) + _repeated(units) + _shared_effects(units)
    shrunk, spread = population.shrink(centred, units.covariances)
    rms = [[each["accel_rms"], np.nan if each["gyro_rms"] is None else each["gyro_rms"]] for each in kept]
    return Fleet(
        **base
        | {
            "population": population,
            "strangers": _strangers(path, gyroscope, population, dict(zip(_names(units), shift, strict=True)), total),
            "differences": tuple(sorted(differences, key=lambda each: each.p_value)),
            "values": units.values,
            "shrunk": shrunk + shift,
            "sigma": np.sqrt(np.diagonal(units.covariances, axis1=1, axis2=2)),
            "shrunk_sigma": np.sqrt(np.maximum(np.diagonal(spread, axis1=1, axis2=2), 0.0)),
            "lots": tuple(_names(units)),
            "rms": np.array(rms, float),
        },
        notes=tuple(notes),
    )


def _names(units: _Units) -> list[str]:
    return [row["lot"] or "" for row in units.rows]


# --- what stands out --------------------------------------------------------------------------------------------------


def _strangers(path: Path, gyroscope: bool, population: Population, shift: dict[str, FloatArray], total: int):
    """Units farther from the population, or from their lot, than one in a hundred fleets would have."""
    found = []
    for rows in _groups(path, gyroscope, _COLUMNS):
        if not rows:
            continue
        units = _units(rows, gyroscope)
        none = np.zeros(len(population.names))
        centred = units.values - np.array([shift.get(lot, none) for lot in _names(units)])
        p_values = scipy.stats.chi2.sf(population.distances(centred, units.covariances), len(none)) * total
        for place in np.flatnonzero(p_values < _LEVEL):
            own = np.diagonal(units.covariances[place])
            z = (centred[place] - population.mean) / np.sqrt(np.diagonal(population.covariance) + own)
            worst = np.argsort(-np.abs(z))[:3]
            named = tuple((population.names[k], float(units.values[place, k]), float(z[k])) for k in worst)
            row = units.rows[place]
            found.append(Stranger(row["device"], row["file"], float(min(1.0, p_values[place])), named))
    return tuple(sorted(found, key=lambda each: each.p_value))


def _weighted(values: FloatArray, covariance: FloatArray, covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean of values (n, p), each with covariance + covariances[i], and its covariance (generalised least squares)."""
    weights = np.linalg.inv(covariance + covariances)
    spread = np.linalg.inv(weights.sum(axis=0))
    return spread @ np.einsum("nij,nj->i", weights, values), spread


def _lots(units: _Units) -> tuple[list[Difference], FloatArray]:
    """Lots whose mean differs from the other lots', and by how much each unit's lot is shifted (n, p)."""
    lots = np.array(_names(units))
    names, counts = np.unique(lots[lots != ""], return_counts=True)
    shift = np.zeros_like(units.values)
    names = names[counts >= 3]
    if len(names) < 2:
        return [], shift
    inlots = np.isin(lots, names)
    within = units.values - np.median(units.values, axis=0)
    for name in names:  # medians, so that a stranger does not shift its lot; a centre of its own takes one unit away
        own = units.values[lots == name]
        within[lots == name] = (own - np.median(own, axis=0)) * np.sqrt(len(own) / (len(own) - 1))
    if inlots.sum() < FEWEST:
        return [], shift
    inside = estimate_population(units.names, within[inlots], units.covariances[inlots])
    usual = inlots & (
        inside.distances(within, units.covariances) <= scipy.stats.chi2.isf(_LEVEL / len(lots), within.shape[1])
    )
    means = {
        name: _weighted(units.values[chosen], inside.covariance, units.covariances[chosen])
        for name in names
        if (chosen := (lots == name) & usual).any()
    }
    middle = np.median([mean for mean, _ in means.values()], axis=0)  # of lots: a bad one is one of many
    found = []
    questions, freedom = len(means) * len(units.names), max(1, int(usual.sum()) - len(means))
    for name, (mean, spread) in means.items():
        others = [other for key, other in means.items() if key != name]
        weights = [np.linalg.inv(other) for _, other in others]
        rest_spread = np.linalg.inv(np.sum(weights, axis=0))
        rest = rest_spread @ np.sum([w @ m for w, (m, _) in zip(weights, others, strict=True)], axis=0)
        if len(others) > 2:
            rest = middle
        change, sigma = mean - rest, np.sqrt(np.diagonal(spread + rest_spread))
        p_values = np.minimum(1.0, 2 * scipy.stats.t.sf(np.abs(change / sigma), freedom) * questions)
        told = [k for k in np.argsort(p_values) if p_values[k] < _LEVEL]
        if told:
            shift[np.ix_(lots == name, told)] = change[told]
            count = int(np.sum(lots == name))
            found.append(
                Difference(
                    "lot", str(name), count, float(p_values[told[0]]),
                    tuple((units.names[k], float(change[k]), float(sigma[k])) for k in told),
                    f"lot {name} ({count} units) differs from the other lots",
                )
            )  # fmt: skip
    return found, shift


def _dates(units: _Units, population: Population, centred: FloatArray) -> list[Difference]:
    """Parameters that drift with the date of the recording."""
    days = np.full(len(units.rows), np.nan)
    for place, row in enumerate(units.rows):
        try:
            days[place] = np.datetime64(row["date"] or "NaT").astype("datetime64[s]").astype(float) / 86400
        except ValueError:
            continue
    known = np.isfinite(days) & (days > -1e8)
    if known.sum() < FEWEST or np.ptp(days[known]) < 1:
        return []
    years = (days[known] - days[known].mean()) / 365.25
    total = population.covariance + units.covariances[known]
    distance = population.distances(centred[known], units.covariances[known])
    usual = distance <= scipy.stats.chi2.isf(_LEVEL / len(distance), centred.shape[1])
    found = []
    for k in range(len(units.names)):
        weight = 1 / total[usual, k, k]
        time = years[usual] - np.average(years[usual], weights=weight)
        information = float(np.sum(weight * time**2))
        slope, sigma = float(np.sum(weight * time * centred[known][usual, k])) / information, information**-0.5
        p_value = min(1.0, 2 * float(scipy.stats.norm.sf(abs(slope / sigma))) * len(units.names))
        if p_value < _LEVEL:
            found.append((p_value, (units.names[k], slope, sigma)))
    if not found:
        return []
    found.sort(key=lambda each: each[0])
    first, last = (str(np.datetime64(int(each * 86400), "s"))[:10] for each in (days[known].min(), days[known].max()))
    text = f"parameters drift with the date of the recording, {first} to {last}"
    return [Difference("date", f"{first} to {last}", int(known.sum()), found[0][0], tuple(e for _, e in found), text)]


def _repeated(units: _Units) -> list[Difference]:
    """Devices that were recorded again and are no longer what they were."""
    places: dict[str, list[int]] = {}
    for place, row in enumerate(units.rows):
        places.setdefault(row["device"], []).append(place)
    again = {device: each for device, each in places.items() if len(each) > 1}
    found = []
    for device, each in again.items():
        first, last = each[0], each[-1]
        change = units.values[last] - units.values[first]
        sigma = np.sqrt(np.diagonal(units.covariances[first] + units.covariances[last]))
        p_values = 2 * scipy.stats.norm.sf(np.abs(change / sigma)) * len(units.names) * len(again)
        told = [k for k in np.argsort(p_values) if p_values[k] < _LEVEL]
        if told:
            named = tuple((units.names[k], float(change[k]), float(sigma[k])) for k in told)
            found.append(Difference("device", device, len(each), float(p_values[told[0]]), named,
                                    f"device {device} changed between its recordings"))  # fmt: skip
    return found


def _shared_effects(units: _Units) -> list[Difference]:
    """Effects that the diagnoses name in one lot more often than in the others (Fisher's exact test)."""
    lots = np.array(_names(units))
    asked = np.array([row["verdict"] is not None for row in units.rows])
    names = sorted({name for row in units.rows for name in row["effects"] or ()})
    groups = sorted(set(lots[asked & (lots != "")]))
    if len(groups) < 2:
        return []
    found = []
    for effect in names:
        shown = np.array([effect in (row["effects"] or ()) for row in units.rows])
        for group in groups:
            inside, outside = asked & (lots == group), asked & (lots != group)
            table = [[int(np.sum(shown & side)), int(np.sum(~shown & side))] for side in (inside, outside)]
            p_value = float(scipy.stats.fisher_exact(table, "greater")[1]) * len(names) * len(groups)  # pyright: ignore
            if p_value < _LEVEL:
                text = (
                    f"lot {group} shares {effect}: found in {table[0][0]} of its {int(inside.sum())} units, in "
                    f"{table[1][0]} of {int(outside.sum())} others"
                )
                found.append(Difference("effect", group, table[0][0], p_value, (), text))
    return found


# --- shrunk estimates -------------------------------------------------------------------------------------------------


def write_shrunk(fleet: Fleet, path: str | os.PathLike[str]) -> None:
    """Write the units' parameters with the population as prior, in output units like the table's, beside its columns.

    Columns: device, file, and gains, biases and their sigmas (without gravity's uncertainty). Raises
    `NotPossibleError` where there is no population.
    """
    if fleet.population is None:
        raise NotPossibleError(f"{fleet.table}: there is no population to learn from: {' '.join(fleet.notes)}")
    population = fleet.population
    gyroscope = any(name.startswith("gyroscope") for name in population.names)
    shift: dict[str, FloatArray] = {}
    for each in fleet.differences:
        if each.kind == "lot":
            shift[each.group] = np.array([dict((n, a) for n, a, _ in each.parameters).get(name, 0.0)
                                          for name in population.names])  # fmt: skip
    numbers = ("accel_gain", "accel_bias", "gyro_gain", "gyro_bias")
    columns = [name for name in SCHEMA.names if name in ("device", "file") or name.startswith(numbers)]
    schema = pa.schema([SCHEMA.field(name) for name in columns])
    places = _free(gyroscope)
    with atomic_write(path) as temporary, pq.ParquetWriter(temporary, schema) as writer:
        for rows in _groups(Path(fleet.table), gyroscope, _COLUMNS):
            if not rows:
                continue
            units = _units(rows, gyroscope)
            moved = np.array([shift.get(lot, np.zeros(len(places))) for lot in _names(units)])
            mean, spread = population.shrink(units.values - moved, units.covariances)
            whole = np.zeros((len(rows), len(PARAMETERS), 2))
            whole[:, places, 0] = mean + moved
            whole[:, places, 1] = np.sqrt(np.maximum(np.diagonal(spread, axis1=1, axis2=2), 0.0))
            out: dict[str, list] = {name: [row[name] for row in rows] for name in ("device", "file")}
            for start, name in ((0, "accel"), (12, "gyro")):
                for part, first, size in (("gain", start, 9), ("bias", start + 9, 3)):
                    there = name == "accel" or gyroscope
                    for column, which in ((f"{name}_{part}", 0), (f"{name}_{part}_sigma", 1)):
                        out[column] = [_output(row, name, part, whole[k, first : first + size, which], which)
                                       if there else None for k, row in enumerate(rows)]  # fmt: skip
            writer.write_table(pa.table([pa.array(out[f.name], f.type) for f in schema], schema=schema))


def _output(row: dict[str, Any], name: str, part: str, relative: FloatArray, which: int) -> FloatArray:
    scale, offset = np.array(row[f"{name}_nominal"][:3]), np.array(row[f"{name}_nominal"][3:])
    if part == "gain":
        return relative * np.repeat(scale, 3)
    return relative * scale + (offset if which == 0 else 0.0)
