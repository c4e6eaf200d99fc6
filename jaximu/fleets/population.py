"""The fleet as evidence: how its parameters are spread, which units do not belong, what lots and dates change.

A unit's parameters x are drawn from a population N(μ, Σ) and known as y = x + e, e ~ N(0, C), C the covariance of its
own fit. μ and Σ are found by maximum likelihood (EM; units that do not belong are left out), and give each unit a
posterior: empirical Bayes, which pulls a direction towards the population the more, the less the unit's own recording
tells of it (Efron and Morris, Journal of the American Statistical Association 70, 1975; here with full matrices).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import scipy

from jaximu.diagnosis.common_drift import CommonDrift, RestingRates
from jaximu.diagnosis.evidence import FAMILY_LEVEL
from jaximu.estimation.problem import Name
from jaximu.fleets.rows import COLUMN_PLACES, PARAMETERS, SCHEMA, covariances, free_places, require_table
from jaximu.ground.array_types import BoolArray, FloatArray, IntArray
from jaximu.ground.atomic import atomic_write
from jaximu.ground.distributions import normal_isf, normal_sf, robust_sigma
from jaximu.ground.document import Document, Json, entries
from jaximu.ground.errors import FilePath, NotPossibleError
from jaximu.ground.page import Result
from jaximu.ground.quantities import counted, in_order
from jaximu.ground.vectors import root_or_zero, sigmas_of, variances_of
from jaximu.mistakes.titles import effect_title

FEWEST = 8
"""Units from which a population is spoken of."""
_OF_SESSIONS = ["device", "unit", "session", "rest_time", "rest_up", "rest_rate"]
_SUMMED = ["file", "status", "message", "verdict", "effects", "gyro_unit"]
_MOST = 10_000
"""Units that the population is estimated from, evenly taken from a larger fleet: what keeps the memory bounded."""
_UNITS_COMPARED = 32
"""Units of a session that are asked for a drift in common, evenly taken: a time course needs no more."""
LEVEL = 0.01
"""Probability of one false alarm in the whole fleet, for each kind of question."""
_ROUNDS = 200
_YEAR = 365.25  # days
_COLUMNS = (
    "device",
    "file",
    "status",
    "verdict",
    "effects",
    "date",
    "lot",
    "accel_gain",
    "accel_bias",
    "gyro_gain",
    "gyro_bias",
    "accel_nominal",
    "gyro_nominal",
    "covariance",
    "accel_rms",
    "gyro_rms",
)


_SHRUNK = ("device", "file", *COLUMN_PLACES, *(f"{name}_sigma" for name in COLUMN_PLACES))


@dataclass(frozen=True)
class Population:
    """Mean (p,) and covariance (p, p) of parameters relative to the data sheet: gains in scales, biases in SI.

    alone: standard deviations (p,) of the estimates as they are, their own noise included. count: units it rests on.
    kept (n,): which of those that were asked they are.
    """

    names: tuple[Name, ...]
    mean: FloatArray
    covariance: FloatArray
    alone: FloatArray
    count: float
    kept: BoolArray

    @property
    def spread(self) -> FloatArray:
        """Standard deviations (p,) between units, the noise of their estimates taken off."""
        return sigmas_of(self.covariance)

    @property
    def farthest(self) -> float:
        """Standard deviations by which a unit may be off in one parameter before it stands out."""
        return float(scipy.stats.t.isf(LEVEL / (4 * len(self.names) * self.count), self.count - 2))

    def shrink(self, values: FloatArray, covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the posterior means (n, p) and covariances (n, p, p) of estimates (n, p) with theirs (n, p, p)."""
        total = self.covariance + covariances
        gain = np.linalg.solve(total, np.broadcast_to(self.covariance, total.shape)).swapaxes(1, 2)
        posterior = self.covariance - gain @ self.covariance
        mean = self.mean + np.einsum("nij,nj->ni", gain, values - self.mean)
        return mean, (posterior + posterior.swapaxes(1, 2)) / 2

    def scores(self, values: FloatArray, covariances: FloatArray, inside: BoolArray) -> FloatArray:
        """Return how far units (n,) are from all others, by parameter (n, p): normal for units that belong.

        What is estimated of a variance has Student's law: a deviation becomes the normal one of the same probability.
        A unit that is `inside` the population is taken out of it first (the externally studentised residual; Cook and
        Weisberg, Residuals and Influence in Regression, 1982, sec. 2.2.1).
        """
        inside, others, tiny = inside[:, None], self.count - 1, np.finfo(float).tiny
        variance = np.diagonal(self.covariance) + variances_of(covariances)
        share = self._share(covariances)
        rest = (values - self.mean) / np.sqrt(variance)
        factor = np.where(inside, others - share * rest**2, others + 2 * share) / (others - inside)
        tail = scipy.stats.t.sf(np.abs(rest) / np.sqrt(np.maximum(factor, tiny)), (others - inside) / share**2)
        return np.copysign(normal_isf(np.maximum(tail, tiny)), rest)

    def _share(self, covariances: FloatArray) -> FloatArray:
        """Return the shares (n, p) of estimates' variances that lie between units, and were estimated."""
        spread = np.diagonal(self.covariance)
        return spread / (spread + variances_of(covariances))

    def p_values(self, values: FloatArray, covariances: FloatArray, inside: BoolArray) -> FloatArray:
        """Return the probabilities (n,) that a unit that belongs is as far, by one parameter or by all together.

        Squared distances of all together have the laws of Hotelling's T², with as many units as `estimate_population`
        adds to the covariance and as the noise of estimates, which is known, is worth.
        """
        size, scores = len(self.names), self.scores(values, covariances, inside)
        total = self.covariance + covariances
        sigma = sigmas_of(total)
        alike = total / sigma[:, :, None] / sigma[:, None, :]
        squared = np.einsum("ni,ni->n", scores, np.linalg.solve(alike, scores[..., None])[..., 0])
        known = (self.count + size) / np.mean(self._share(covariances) ** 2, axis=1)
        inner = scipy.stats.beta.sf(squared * known / (known - 1) ** 2, size / 2, (known - size - 1) / 2)
        outer = scipy.stats.f.sf(squared * known * (known - size) / (known**2 - 1) / size, size, known - size)
        by_one = 2 * size * normal_sf(np.max(np.abs(scores), axis=1))
        return np.minimum(1.0, 2 * np.minimum(np.where(inside, inner, outer), by_one))


@dataclass(frozen=True)
class Stranger:
    """A unit that does not belong: p_value corrected for the number of units; its most extreme parameters."""

    device: str
    file: str
    p_value: float
    parameters: tuple[tuple[Name, float, float], ...]  # name, value, in standard deviations


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
    parameters: tuple[tuple[Name, float, float], ...]
    text: str


@dataclass(frozen=True)
class Shifts:
    """What lots add to the parameters (p,) of their units, and what a year adds, counted from `middle` (days of 1970).

    A unit without a date counts as one of the middle.
    """

    lots: dict[str, FloatArray]
    drift: FloatArray
    middle: float

    def of(self, rows: Sequence[Json]) -> FloatArray:
        """Return what is to be taken off (n, p) to make units of all lots and dates alike."""
        none = np.zeros_like(self.drift)
        lots = np.array([self.lots.get(row["lot"] or "", none) for row in rows]).reshape(len(rows), len(none))
        years = (days_of([row["date"] for row in rows]) - self.middle) / _YEAR
        return lots + np.outer(np.nan_to_num(years), self.drift)


@dataclass(frozen=True, eq=False, repr=False)
class Fleet(Result, Document, page="fleet"):
    """A table's units as a population, and what stands out.

    failed: the files that could not be calibrated by reason, most first; reasons that differ in numbers only are one.
    values, sigma, shrunk, shrunk_sigma: (n, p) of at most `_MOST` units, alone and with the population as prior. lots:
    theirs, "" where none is known; shifts: what lots and dates add. rms: (n, 2), of the norm of gravity (m/s²) and of
    carried gravity (degrees). places: unit and session of recordings whose session is stated. drifts: by session, what
    gyroscopes of its units have in common in time, by chance or not.
    """

    table: str
    recordings: int
    statuses: Counter
    verdicts: Counter
    effects: Counter
    failed: dict[str, list[str]]
    population: Population | None
    strangers: tuple[Stranger, ...]
    differences: tuple[Difference, ...]
    values: FloatArray
    shrunk: FloatArray
    sigma: FloatArray
    shrunk_sigma: FloatArray
    lots: tuple[str, ...]
    shifts: Shifts | None
    rms: FloatArray
    notes: tuple[str, ...]
    places: frozenset[tuple[str, str]] = frozenset()
    drifts: tuple[CommonDrift, ...] = ()

    @property
    def common(self) -> list[CommonDrift]:
        """The time courses that are more than chance."""
        return [drift for drift in self.drifts if drift.p_value * len(self.drifts) < FAMILY_LEVEL]

    def document(self) -> Json:
        """Return the findings as a JSON document of schema `jaximu.fleet/1`."""
        population = self.population
        return {
            "schema": "jaximu.fleet/1",
            **entries(self, "table", "recordings"),
            "statuses": dict(sorted(self.statuses.items())),
            "verdicts": dict(sorted(self.verdicts.items())),
            "effects": dict(self.effects.most_common()),
            "failed": [{"reason": reason, "files": files} for reason, files in self.failed.items()],
            "population": None
            if population is None
            else {
                "units": population.count,
                "parameters": list(population.names),
                **entries(population, "mean", "spread", "covariance"),
            },
            "strangers": [
                {
                    **entries(stranger, "device", "file", "p_value"),
                    "parameters": [{"name": n, "value": v, "deviations": z} for n, v, z in stranger.parameters],
                }
                for stranger in self.strangers
            ],
            "differences": [
                {
                    **entries(difference, "kind", "group", "count", "p_value", "text"),
                    "parameters": [{"name": n, "amount": a, "sigma": s} for n, a, s in difference.parameters],
                }
                for difference in self.differences
            ],
            "common_drift": [drift.document() for drift in self.drifts],
            "notes": list(self.notes),
        }


# --- the population ---------------------------------------------------------------------------------------------------


def estimate_population(names: Sequence[Name], values: FloatArray, covariances: FloatArray) -> Population:
    """Estimate mean and covariance of a population from estimates (n, p) and their covariances (n, p, p).

    Units farther off than one in a hundred fleets would have are left out, at most half. With few units the covariance
    leans towards its diagonal: p units' worth of none. Raises `NotPossibleError` for fewer than `FEWEST` units.
    """
    count = len(values)
    if count < FEWEST:
        raise NotPossibleError(f"{count} calibrated units are too few for a population: it takes {FEWEST} or more.")
    mean = np.median(values, axis=0)
    noise = np.median(variances_of(covariances), axis=0)
    scatter = np.square(robust_sigma(values - mean, axis=0))
    covariance = np.diag(np.maximum(scatter - noise, 0.01 * scatter + 1e-18))
    # medians know a variance as well as the squares of a third of the units do
    population = Population(tuple(names), mean, covariance, noise, count / 3, np.zeros(count, bool))
    for _ in range(10):
        p_values = population.p_values(values, covariances, population.kept)
        belongs = p_values >= min(LEVEL / count, float(np.median(p_values)))
        if (belongs == population.kept).all():
            break
        mean, covariance = _maximise(values[belongs], covariances[belongs], population.mean, population.covariance)
        alone = values[belongs].std(axis=0, ddof=1)
        population = Population(population.names, mean, covariance, alone, int(belongs.sum()), belongs)
    return population


def _maximise(values, covariances, mean, covariance):
    """EM for the mean and covariance of the true parameters."""
    count, size = values.shape
    for _ in range(_ROUNDS):
        # posteriors as in `Population.shrink`, of which only sums are needed
        weights = np.linalg.inv(covariance + covariances)
        means = mean + np.einsum("nij,nj->ni", weights, values - mean) @ covariance
        better = means.mean(axis=0)
        rest = means - better
        summed = rest.T @ rest + count * covariance - covariance @ weights.sum(axis=0) @ covariance
        # p units without correlations: what keeps the matrix regular when there are hardly more units than parameters
        fresh = (summed + size * np.diag(summed.diagonal() / count)) / (count + size)
        change = np.abs(np.sqrt(fresh.diagonal() / np.diagonal(covariance)) - 1).max()
        mean = better
        covariance = fresh
        if change < 1e-3:
            break
    return mean, covariance


# --- the table --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Units:
    """Calibrated units of a table: parameters relative to the data sheet, and what they are grouped by.

    factor, offset: (n, 24), outputs of the table are parameters times the one plus the other.
    """

    names: tuple[Name, ...]
    values: FloatArray
    covariances: FloatArray
    rows: list[Json]
    factor: FloatArray
    offset: FloatArray


def _units(rows: list[Json], gyroscope: bool) -> _Units:
    """Bring calibrated rows to one scale: gains in nominal scales, biases as inputs in SI."""
    indices = free_places(gyroscope)
    count = len(rows)
    size = len(PARAMETERS)
    factor, (raw, offset) = np.ones((count, size)), np.zeros((2, count, size))
    for name, part in list(COLUMN_PLACES.items())[: 2 + 2 * gyroscope]:
        scale, zero = np.split(np.array([row[f"{name.partition('_')[0]}_nominal"] for row in rows], float), 2, axis=1)
        raw[:, part] = np.array([row[name] for row in rows], float)
        factor[:, part] = np.repeat(scale, 3, axis=1) if name.endswith("gain") else scale
        offset[:, part] = 0.0 if name.endswith("gain") else zero
    whole = covariances(np.array([row["covariance"] for row in rows], float).reshape(count, -1))
    whole = whole / factor[:, :, None] / factor[:, None, :]
    relative = (raw - offset) / factor
    grid = np.ix_(range(count), indices, indices)
    return _Units(
        tuple(PARAMETERS[index] for index in indices), relative[:, indices], whole[grid], rows, factor, offset
    )


def _groups(path: Path, gyroscope: bool) -> Iterator[list[Json]]:
    """Give the calibrated rows of a table that have (or lack) a gyroscope, some at a time."""
    with pq.ParquetFile(path) as file:
        for batch in file.iter_batches(batch_size=1024, columns=list(_COLUMNS)):
            rows = batch.to_pylist()
            if rows := [row for row in rows if row["status"] == "ok" and (row["gyro_gain"] is not None) == gyroscope]:
                yield rows


def read_fleet(table: FilePath) -> Fleet:
    """Question a table of `jaximu fleet` as a whole. Raises `InputError` where it is no such table."""
    path = Path(table)
    require_table(path, (*_COLUMNS, "gyro_unit"))
    statuses, verdicts, effects = Counter(), Counter(), Counter()
    places: dict[tuple[str, str], Json] = {}
    failed = {}
    reasons = {}
    kinds, remarked = Counter(), 0  # with a gyroscope, or without
    with pq.ParquetFile(path) as file:
        with_sessions = [name for name in _OF_SESSIONS if name in file.schema_arrow.names]  # older tables have none
        for batch in file.iter_batches(batch_size=4096, columns=[*_SUMMED, *with_sessions]):
            for row in batch.to_pylist():
                if row.get("session"):
                    places[row["unit"] or row["device"], row["session"]] = row
                statuses[row["status"]] += 1
                if row["verdict"]:
                    verdicts[row["verdict"]] += 1
                effects.update(row["effects"] or ())
                if row["status"] == "ok":
                    kinds[row["gyro_unit"] is not None] += 1
                    remarked += row["message"] is not None
                else:
                    reason = (row["message"] or "").removeprefix(f"{row['file']}: ")
                    alike = reasons.setdefault(re.sub(r"\d+", "0", reason), reason)
                    failed.setdefault(alike, []).append(row["file"])
    gyroscope = kinds[True] >= kinds[False]
    total = kinds[gyroscope]
    others = kinds[not gyroscope]
    notes = []
    if others:
        notes.append(f"{others} units {'without' if gyroscope else 'with'} a gyroscope are not part of the population.")
    if remarked:
        notes.append(f"{counted(remarked, 'calibrated unit')}: see column message for what was not determined.")
    step = max(1, -(-total // _MOST))
    kept = list(islice(chain.from_iterable(_groups(path, gyroscope)), 0, None, step))
    if step > 1:
        notes.append(f"the population was estimated from {len(kept)} of {total} units, evenly taken.")
    failed = dict(sorted(failed.items(), key=lambda pair: -len(pair[1])))
    known: Json = dict.fromkeys(("values", "shrunk", "sigma", "shrunk_sigma", "rms"), np.empty((0, 0)))
    known |= {"population": None, "strangers": (), "differences": (), "lots": (), "shifts": None}
    if len(kept) < FEWEST:
        notes.append(f"fewer than {FEWEST} calibrated units: no population.")
    else:
        known = _of_population(path, _units(kept, gyroscope), gyroscope, total)
    drifts, apart = _common_drifts(places)
    known |= {"notes": (*notes, *apart), "places": frozenset(places), "drifts": drifts}
    return Fleet(str(table), statuses.total(), statuses, verdicts, effects, failed, **known)


def _common_drifts(places: Mapping[tuple[str, str], Json]) -> tuple[tuple[CommonDrift, ...], list[str]]:
    """Return what gyroscopes of each session's units have in common in time, and why some sessions cannot be asked."""
    random, drifts, reasons = np.random.default_rng(20260101), [], []
    for session in in_order(session for _, session in places):
        rows = [(unit, row) for (unit, of), row in places.items() if of == session and row.get("rest_time")]
        units = [
            RestingRates.of_means(
                unit,
                session,
                np.array(row["rest_time"]),
                np.reshape(row["rest_up"], (-1, 3)),
                np.reshape(row["rest_rate"], (-1, 3)),
                random,
            )
            for unit, row in rows[:: max(1, -(-len(rows) // _UNITS_COMPARED))]
        ]
        try:
            drifts += [CommonDrift.of(units, random)] if len(units) > 1 else []
        except NotPossibleError as error:
            reasons.append(str(error))
    sessions = counted(len(reasons), "session")
    return tuple(drifts), [f"{sessions} cannot be asked for a drift in common: {reasons[0]}"] if reasons else []


def _of_population(path: Path, units: _Units, gyroscope: bool, total: int) -> Json:
    """What units of a table say as a population, by the fields of `Fleet`; total: units of the table."""
    differences, shifts = _lots_and_dates(units)
    shift = shifts.of(units.rows)
    centred = units.values - shift
    population = estimate_population(units.names, centred, units.covariances)
    differences += _repeated(units) + _shared_effects(units)
    shrunk, spread = population.shrink(centred, units.covariances)
    return dict(
        population=population,
        strangers=_strangers(path, gyroscope, population, units, shifts, total),
        differences=tuple(sorted(differences, key=lambda difference: difference.p_value)),
        values=units.values,
        shrunk=shrunk + shift,
        sigma=sigmas_of(units.covariances),
        shrunk_sigma=root_or_zero(variances_of(spread)),
        lots=tuple(_names(units)),
        shifts=shifts,
        rms=np.array([[row["accel_rms"], row["gyro_rms"]] for row in units.rows], float),
    )


def _names(units: _Units) -> list[str]:
    return [row["lot"] or "" for row in units.rows]


# --- what stands out --------------------------------------------------------------------------------------------------


def _strangers(path: Path, gyroscope: bool, population: Population, sample: _Units, shifts: Shifts, total: int):
    """Units farther from the population, or from their lot and date, than one in a hundred fleets would have.

    sample: the units that the population was estimated from.
    """
    members = {(row["device"], row["file"]) for row, kept in zip(sample.rows, population.kept, strict=True) if kept}
    strangers = []
    for rows in _groups(path, gyroscope):
        units = _units(rows, gyroscope)
        inside = np.array([(row["device"], row["file"]) in members for row in rows], bool)
        compared = units.values - shifts.of(rows), units.covariances, inside
        p_values = population.p_values(*compared) * total
        scores = population.scores(*compared)
        for index in np.flatnonzero(p_values < LEVEL):
            z, row = scores[index], rows[index]
            worst = (-np.abs(z)).argsort()[:3]
            named = tuple((population.names[k], float(units.values[index, k]), float(z[k])) for k in worst)
            strangers.append(Stranger(row["device"], row["file"], float(min(1.0, p_values[index])), named))
    return tuple(sorted(strangers, key=lambda stranger: stranger.p_value))


def days_of(dates: Sequence[str | None]) -> FloatArray:
    """Return dates (n,) in days since 1970; NaN where there is none."""
    days = np.full(len(dates), np.nan)
    for index, date in enumerate(dates):
        with suppress(ValueError):
            days[index] = np.datetime64(date or "NaT").astype("datetime64[s]").astype(float) / 86400
    return np.where(days > -1e8, days, np.nan)  # no date is a very large negative number


@dataclass(frozen=True)
class _Groups:
    """The lots of units, and their dates: what may explain that units' parameters differ.

    lot: (n,) place in `names`, or past its end; years: (n,) since the middle of the dates, NaN where there is none.
    """

    names: tuple[str, ...]
    lot: IntArray
    years: FloatArray
    middle: float

    @classmethod
    def of(cls, units: _Units) -> _Groups:
        days = days_of([row["date"] for row in units.rows])
        lots = np.array(_names(units))
        known = np.isfinite(days)
        dated = bool(known.sum() >= FEWEST and np.ptp(days[known]) >= 1)
        middle = float(days[known].mean()) if dated else 0.0
        names, counts = np.unique(lots[lots != ""], return_counts=True)
        names = tuple(names[counts >= 3].tolist())
        names = names if len(names) > 1 else ()
        indices = {name: index for index, name in enumerate(names)}
        lot = np.array([indices.get(name, len(names)) for name in lots.tolist()])
        return cls(names, lot, (days - middle) / _YEAR if dated else np.full(len(days), np.nan), middle)

    @property
    def dated(self) -> bool:
        """Whether there are dates to ask about."""
        return bool(np.isfinite(self.years).any())

    def column(self, cause: int) -> FloatArray:
        """Return what a cause adds (n,): a lot by its place in `names`, the time by the place past their end."""
        return np.nan_to_num(self.years) if cause == len(self.names) else (self.lot == cause).astype(float)

    def products(self, values: FloatArray, power: int = 1) -> FloatArray:
        """Return the products of values (n,) with all causes' columns, or with a power of these."""
        count = len(self.names)
        by_lot = np.bincount(self.lot, values, minlength=count + 1)[:count].astype(float)
        return np.append(by_lot, [float(values @ self.column(count) ** power)] * self.dated)

    def within(self, values: FloatArray) -> FloatArray:
        """Return values (n, p) with their lot's middle, and what they change by in time within lots, taken off.

        By medians, so that a stranger moves nothing.
        """
        values = values - np.median(values, axis=0)
        years = np.array(self.years)
        for index in range(len(self.names) + 1):
            members = self.lot == index
            if members.sum() >= 3:
                # a centre of its own takes one unit away
                stretch = np.sqrt(members.sum() / (members.sum() - 1))
                values[members] = (values[members] - np.median(values[members], axis=0)) * stretch
            if np.isfinite(years[members]).any():
                years[members] -= np.nanmedian(years[members])
        order = years.argsort()[: int(np.isfinite(years).sum())]
        earlier, later = order[: len(order) // 2], order[(len(order) + 1) // 2 :]
        apart = years[later] - years[earlier]
        if not (apart > 0).any():
            return values
        far = apart >= np.median(apart[apart > 0])
        slope = np.median((values[later[far]] - values[earlier[far]]) / apart[far, None], axis=0)
        return values - np.nan_to_num(years)[:, None] * slope


def _lots_and_dates(units: _Units) -> tuple[list[Difference], Shifts]:
    """Lots whose mean differs from the others', parameters that drift with the date, and what to take off for both.

    Where lots follow each other in time, a drift makes lots differ and a bad lot looks like a drift. Parameter by
    parameter, what explains most (the time, or one lot) is taken first, then what explains most of the rest, until
    nothing is left that counts; then all that was taken is estimated together.
    """
    groups = _Groups.of(units)
    size = len(units.names)
    shifts = Shifts({}, np.zeros(size), groups.middle)
    if not (groups.names or groups.dated) or len(units.rows) < FEWEST:
        return [], shifts
    inside = estimate_population(units.names, groups.within(units.values), units.covariances)
    findings = {}
    for k, name in enumerate(units.names):
        weight = inside.kept / (inside.covariance[k, k] + units.covariances[:, k, k])
        for cause, amount, sigma, p_value in _causes(groups, units.values[:, k], weight, size):
            findings.setdefault(cause, []).append((p_value, (name, amount, sigma)))
            if cause == len(groups.names):
                shifts.drift[k] = amount
            else:
                shifts.lots.setdefault(groups.names[cause], np.zeros(size))[k] = amount
    differences = []
    for cause, parameters in findings.items():
        parameters.sort(key=lambda one: one[0])
        if cause == len(groups.names):
            known = groups.years[np.isfinite(groups.years)]
            first, last = (
                str(np.datetime64(round((year * _YEAR + groups.middle) * 86400), "s"))[:10]
                for year in (known.min(), known.max())
            )
            kind, group, count = "date", f"{first} to {last}", len(known)
            text = f"parameters drift with the date of the recording, {first} to {last}"
        else:
            kind, group, count = "lot", groups.names[cause], int(np.sum(groups.lot == cause))
            text = f"lot {group} ({count} units) differs from the other lots"
        differences.append(Difference(kind, group, count, parameters[0][0], tuple(one for _, one in parameters), text))
    return differences, shifts


def _causes(
    groups: _Groups, values: FloatArray, weight: FloatArray, parameters: int
) -> list[tuple[int, float, float, float]]:
    """Return which causes explain a parameter's values (n,): their places, amounts, sigmas and p-values.

    p-values are corrected for all questions of a kind: so many parameters, of so many lots.
    """
    lots = len(groups.names)
    questions = np.array([lots * parameters] * lots + [parameters] * groups.dated, float)
    freedom = max(1, int((weight > 0).sum()) - lots - 2)

    def p_value(z: FloatArray, causes) -> FloatArray:
        return np.minimum(1.0, 2 * scipy.stats.t.sf(np.abs(z), freedom) * questions[causes])

    taken = []
    given_up = []
    while True:
        design = np.stack([np.ones(len(values)), *map(groups.column, taken)])
        spread = np.linalg.inv((weight * design) @ design.T)
        amounts = spread @ (design @ (weight * values))
        sigmas = sigmas_of(spread)
        p_values = p_value((amounts / sigmas)[1:], taken)
        if (p_values >= LEVEL).any():  # what was taken after it explains it
            given_up.append(taken.pop(int(np.argmax(p_values))))
            continue
        crossed = np.stack([groups.products(weight * row) for row in design])
        squares = groups.products(weight, 2)
        left = squares - np.einsum("ij,ik,kj->j", crossed, spread, crossed)  # of each cause's column, off what is taken
        open_ = left > 1e-9 * squares
        open_[[*taken, *given_up]] = False
        if not open_.any():
            break
        z = np.zeros(len(left))
        z[open_] = (groups.products(weight * (values - amounts @ design)) / np.sqrt(np.where(open_, left, 1.0)))[open_]
        # the time last where it does as well as a lot: of two lots, each of one date
        best = int(np.flatnonzero(np.abs(z) >= (1 - 1e-9) * np.abs(z).max())[0])
        if p_value(z[best], best) >= LEVEL:
            break
        taken.append(best)
    return [(cause, float(amounts[k + 1]), float(sigmas[k + 1]), float(p_values[k])) for k, cause in enumerate(taken)]


def _repeated(units: _Units) -> list[Difference]:
    """Devices that were recorded again and are no longer what they were."""
    indices_of = {}
    for index, row in enumerate(units.rows):
        indices_of.setdefault(row["device"], []).append(index)
    repeated = {device: indices for device, indices in indices_of.items() if len(indices) > 1}
    differences = []
    for device, indices in repeated.items():
        first, last = indices[0], indices[-1]
        change = units.values[last] - units.values[first]
        sigma = sigmas_of(units.covariances[first] + units.covariances[last])
        p_values = 2 * scipy.stats.norm.sf(np.abs(change / sigma)) * len(units.names) * len(repeated)
        changed = [k for k in np.argsort(p_values) if p_values[k] < LEVEL]
        if changed:
            named = tuple((units.names[k], float(change[k]), float(sigma[k])) for k in changed)
            text = f"device {device} changed between its recordings"
            differences.append(Difference("device", device, len(indices), float(p_values[changed[0]]), named, text))
    return differences


def _shared_effects(units: _Units) -> list[Difference]:
    """Effects that the diagnoses name in one lot more often than in the others (Fisher's exact test)."""
    lots = np.array(_names(units))
    diagnosed = np.array([row["verdict"] is not None for row in units.rows])
    names = sorted({name for row in units.rows for name in row["effects"] or ()})
    groups = sorted(set(lots[diagnosed & (lots != "")]))
    if len(groups) < 2:
        return []
    differences = []
    for effect in names:
        shown = np.array([effect in (row["effects"] or ()) for row in units.rows])
        for group in groups:
            inside, outside = diagnosed & (lots == group), diagnosed & (lots != group)
            table = [[int((shown & side).sum()), int((~shown & side).sum())] for side in (inside, outside)]
            p_value = float(scipy.stats.fisher_exact(table, "greater")[1]) * len(names) * len(groups)
            if p_value < LEVEL:
                differences.append(
                    Difference(
                        "effect",
                        group,
                        table[0][0],
                        p_value,
                        (),
                        f"lot {group} shares {effect_title(effect)}: found in {table[0][0]} of its {int(inside.sum())} "
                        f"units, in {table[1][0]} of {int(outside.sum())} others",
                    )
                )
    return differences


# --- shrunk estimates -------------------------------------------------------------------------------------------------


def write_shrunk(fleet: Fleet, path: FilePath) -> None:
    """Write the units' parameters with the population as prior, in output units like the table's, beside its columns.

    Columns: device, file, and gains, biases and their sigmas (without gravity's uncertainty). Raises
    `NotPossibleError` where there is no population.
    """
    if fleet.population is None or fleet.shifts is None:
        raise NotPossibleError(f"{fleet.table}: there is no population to learn from: {' '.join(fleet.notes)}")
    population = fleet.population
    gyroscope = any(name.owner == "gyroscope" for name in population.names)
    schema = pa.schema([field for field in SCHEMA if field.name in _SHRUNK])
    places = free_places(gyroscope)
    with atomic_write(path) as temporary, pq.ParquetWriter(temporary, schema) as writer:
        for rows in _groups(Path(fleet.table), gyroscope):
            units = _units(rows, gyroscope)
            moved = fleet.shifts.of(rows)
            mean, spread = population.shrink(units.values - moved, units.covariances)
            values, sigma = np.zeros((2, len(rows), len(PARAMETERS)))
            values[:, places] = mean + moved
            sigma[:, places] = root_or_zero(variances_of(spread))
            values = values * units.factor + units.offset
            sigma = sigma * units.factor
            out: dict[str, list] = {name: [row[name] for row in rows] for name in ("device", "file")}
            for name, part in COLUMN_PLACES.items():
                there = gyroscope or name.startswith("accel")
                for column, numbers in ((name, values), (f"{name}_sigma", sigma)):
                    out[column] = list(numbers[:, part]) if there else [None] * len(rows)
            writer.write_table(pa.table([pa.array(out[f.name], f.type) for f in schema], schema=schema))
