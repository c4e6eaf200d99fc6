"""Whose fault a finding is: a unit's, a session's or the board's, from recordings of several units in several sessions.

Every recording is diagnosed by itself. Of each effect that one of them names, all give an estimate. The estimates β of
unit u in session s are split as β_us = m + a_u + c_s + e_us: a value of the board, one of each unit, one of each
session, and what scatters from recording to recording, each normally distributed with a variance of its own (Searle,
Casella and McCulloch, Variance Components, 1992, ch. 6). A value is there if it is significant beside the others.

A time course that is common to all units of a session is taken off before its recordings are judged once more.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import PurePath
from typing import Any

import numpy as np
import scipy

from jaximu.data.drift import restricted_likelihood
from jaximu.diagnosis.common_drift import COMMON_DRIFT, CommonDrift, RestingRates
from jaximu.diagnosis.diagnosis import Diagnosis, Named, diagnose
from jaximu.diagnosis.drift import DRAWS
from jaximu.diagnosis.evidence import BLIND, Evidence
from jaximu.diagnosis.experiment import KnownEffect
from jaximu.diagnosis.improvement import cross_validated
from jaximu.diagnosis.lines import MOVING_LINE, MovingLine, coincident
from jaximu.estimation.leave_out import off, orthonormal
from jaximu.estimation.track import TRIADS
from jaximu.ground.array_types import FloatArray, IntArray
from jaximu.ground.distributions import chi2_sf
from jaximu.ground.document import SOFTWARE, Document, Json, entries
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import STANDARD, Gravity, as_gravity
from jaximu.ground.page import Result
from jaximu.ground.quantities import counted, in_order, listed
from jaximu.ground.units import SENSOR_UNITS
from jaximu.ground.vectors import column_lengths, root_or_zero
from jaximu.mistakes.titles import effect_title
from jaximu.model.effects import CATALOGUE
from jaximu.recordings.recording import Recording, recordings_of

_WIDE = 8.0
"""Spread of the logarithm of a part's variance, in squares of usual sizes, beforehand: next to nothing is known."""


@dataclass(frozen=True)
class Rests:
    """The rates at rest that a fit leaves, and how the conditions react to outputs that are off in single poses.

    times (o,): middles of the poses, s. up (o, 3): direction of specific force. unwhiten (3 o, n): from whitened
    conditions to rates, rad/s. reaction: by triad, whitened conditions (n, o, 3) by outputs.
    """

    times: FloatArray
    up: FloatArray
    unwhiten: FloatArray
    reaction: Mapping[str, FloatArray]

    def rates(self, whitened: FloatArray) -> FloatArray:
        """Return rates at rest (o, 3, k), rad/s, of whitened conditions (n, k)."""
        return (self.unwhiten @ whitened).reshape(len(self.times), 3, -1)

    def columns(self, triad: str, curves: FloatArray) -> FloatArray:
        """Return how the whitened conditions (n, 3 k) react to curves (o, k) in each axis of a triad."""
        columns = np.einsum("noi,ok->nki", self.reaction[triad], curves)
        return columns.reshape(len(columns), -1)


@dataclass(frozen=True)
class BoardRecording:
    """A recording of one unit in one session: what its diagnosis says, and the evidence that estimates come from.

    diagnosis: the document. named: the effects that it names. chi2_heldout: per condition, on parts left out, with the
    effects in the model. alone: the verdict with what the session has in common. without_drift: that was taken off.
    lines: at rest, that move. taken_off: effects, as the other recordings have them.
    """

    file: str
    unit: str
    session: str
    diagnosis: Json
    named: tuple[Named, ...]
    chi2_heldout: float
    evidence: Evidence
    rests: Rests
    alone: str
    without_drift: bool = False
    lines: tuple[MovingLine, ...] = ()
    taken_off: tuple[str, ...] = ()

    @classmethod
    def of(cls, file: str, unit: str, session: str, diagnosis: Diagnosis) -> BoardRecording:
        """Return what is kept of a diagnosis."""
        experiment, base = diagnosis.experiment, diagnosis.base
        gain = diagnosis.gain or cross_validated(experiment, base)
        held = gain.after if diagnosis.gain is not None else gain.before
        observed = experiment.data.observed(base.imu, base.linear.details)
        real, used = experiment.real, experiment.used
        rest = real.of_kind("static_gyroscope")
        poses = np.eye(len(observed.share))
        reaction = {
            name: (base.weights @ observed.react(name, poses)[used]).reshape(len(base.weights), len(poses), 3)
            for name in TRIADS
        }
        unwhiten = np.linalg.inv(base.weights)[rest] * real.to_si[rest, None]
        times = real.spans[real.first[rest][::3]].mean(axis=1)
        assert observed.up is not None
        rests = Rests(times, observed.up, unwhiten, reaction)
        return cls(
            file,
            unit,
            session,
            diagnosis.document(),
            diagnosis.named,
            held.chi_squared / held.count,
            base.evidence,
            rests,
            diagnosis.verdict,
            lines=diagnosis.lines,
        )

    def at_rest(self, random: np.random.Generator, draws: int) -> RestingRates:
        """Return its rates at rest, with draws of noise that holds drift as the recording shows it, each axis alone."""
        noise = self.evidence.draws(random, draws)
        rates = self.rests.rates(np.concatenate([self.evidence.residual[:, None], noise], axis=1))
        return RestingRates(self.unit, self.session, self.rests.times, self.rests.up, np.moveaxis(rates, 2, 0))

    def repeated(self, other: BoardRecording, known: Sequence[KnownEffect], without_drift: bool) -> BoardRecording:
        """Return the recording as diagnosed once more, effects taken off; estimates still come from before that."""
        return replace(
            other,
            evidence=self.evidence,
            rests=self.rests,
            alone=self.alone,
            without_drift=without_drift,
            taken_off=tuple(one.effect.name for one in known),
        )

    @property
    def place(self) -> str:
        """Its unit and session, in words."""
        return f"unit {self.unit} in session {self.session}"

    def document(self) -> Json:
        """Return the recording as `diagnosis.json` has it."""
        return {
            **entries(self, "file", "unit", "session", "taken_off", "chi2_heldout"),
            "verdict": self.diagnosis["verdict"],
            "verdict_alone": self.alone,
            "without_common_drift": self.without_drift,
            "effects": self.diagnosis["effects"],
        }

    def block(self, name: str, inner: Mapping[str, float]) -> int | None:
        """Return the question for an effect, at inner parameters closest to these; None where it cannot be asked."""
        blocks = self.evidence.blocks
        mine = [k for k, block in enumerate(blocks) if block.kind == "effect" and block.name == name]

        def distance(k: int) -> float:
            return sum(abs(np.log(max(blocks[k].inner[key], 1e-9) / max(inner[key], 1e-9))) for key in inner)

        return min(mine, key=distance, default=None)

    def estimate(
        self,
        name: str,
        inner: Mapping[str, float],
        beside: Mapping[str, Mapping[str, float]],
        shared: FloatArray | None,
    ) -> tuple[FloatArray, FloatArray]:
        """Return a whitened estimate of an effect's coefficients β, in units of their sizes: z (k,), X (k, q).

        z ~ N(X β, 1), while other effects and a time course are free: those named here, those `beside`, with their
        inner parameters, and what the session has in common, `shared`, (t, 2) times and rates.
        """
        evidence, block = self.evidence, self.block(name, inner)
        if block is None:
            return np.zeros(0), np.zeros((0, CATALOGUE[name].size))
        known = {effect.name: _inner(effect) for effect in self.named} | dict(beside)
        blocks = [self.block(other, at) for other, at in known.items() if other != name]
        others = [evidence.columns[:, evidence.span([other for other in blocks if other is not None])]]
        if shared is not None:
            curve = np.interp(self.rests.times, *shared.T)[:, None]
            others += [evidence.off_base(self.rests.columns(triad, curve)) for triad in TRIADS]
        columns = evidence.columns[:, evidence.place(block)]
        basis = orthonormal(np.concatenate(others, axis=1))
        u, s, v = np.linalg.svd(off(basis, columns), full_matrices=False)
        kept = s > BLIND * np.max(column_lengths(columns), initial=1e-300)
        return u[:, kept].T @ evidence.residual, s[kept, None] * v[kept]

    def known(
        self, name: str, inner: Mapping[str, float], mean: FloatArray, covariance: FloatArray
    ) -> Iterator[KnownEffect]:
        """Yield an effect whose coefficients have this mean and covariance, in units of their sizes, if it can be."""
        block = self.block(name, inner)
        if block is not None:
            question = self.evidence.blocks[block]
            values, vectors = np.linalg.eigh(covariance)
            root = question.sizes[:, None] * vectors * root_or_zero(values)
            yield KnownEffect(CATALOGUE[name].make(mean * question.sizes, **question.inner), root)


def _inner(effect: Named) -> dict[str, float]:
    """Return an effect's inner parameters."""
    return {key: float(getattr(effect.effect, key)) for key in effect.effect.inner}


@dataclass(frozen=True)
class Part:
    """What of an effect belongs to units, to sessions or to the board.

    values: by unit or session in which it is (of the board: one), the coefficients (q,), each in units of its size.
    share: of the squares of all estimates, weighted with their information. p_value: of the first of them, all that
    were tried allowed for.
    """

    belongs_to: str
    values: dict[str, FloatArray]
    share: float
    p_value: float


@dataclass(frozen=True)
class Split:
    """Estimates of an effect, split into parts of the board, of units and of sessions.

    measured (n,): the whitened estimates z of all r recordings. rows (n, r, q): how they depend on each recording's
    coefficients. owner (n,): whose each is. shared (r, r): covariance of a coefficient between recordings.
    """

    parts: list[Part]
    measured: FloatArray
    rows: FloatArray
    owner: IntArray
    shared: FloatArray

    def predicted(self, index: int) -> tuple[FloatArray, FloatArray]:
        """Return what the other recordings say of a recording's coefficients: mean (q,) and covariance (q, q)."""
        others = self.owner != index
        common = np.tensordot(self.rows[others], self.shared, (1, 0))
        spread = np.tensordot(common, self.rows[others], ((1, 2), (2, 1))) + np.eye(int(others.sum()))
        pulled = np.linalg.solve(spread, np.column_stack([self.measured[others], common[..., index]]))
        before = self.shared[index, index] * np.eye(self.rows.shape[2])
        return common[..., index].T @ pulled[:, 0], before - common[..., index].T @ pulled[:, 1:]


def split(
    estimates: Sequence[tuple[FloatArray, FloatArray]], units: Sequence[str], sessions: Sequence[str], level: float
) -> Split:
    """Split estimates of an effect, one of each recording, into parts of the board, of units and of sessions.

    A unit's part is there, or a session's or the board's, if without it the estimates scatter by more than they do
    from recording to recording: a χ² test at the variances so far. The most significant part is taken in with a
    variance of its own, all variances are estimated again, and the others are asked once more.

    **Arguments:** `estimates`: whitened, as `BoardRecording.estimate` returns them; `units`, `sessions`: of each;
    `level`: of all parts together where nothing repeats.
    """
    measured = np.concatenate([z for z, _ in estimates])
    rows = scipy.linalg.block_diag(*(x for _, x in estimates)).reshape(len(measured), len(estimates), -1)
    groups = {"board": [""] * len(units), "unit": list(units), "session": list(sessions)}
    columns = {
        (kind, label): rows[:, np.equal(labels, label)].sum(axis=1)
        for kind, labels in groups.items()
        for label in dict.fromkeys(labels)
        if labels.count(label) > 1
    }
    alike = {key: np.equal(groups[key[0]], key[1]).astype(float) for key in columns}
    components = [sum(rows[:, k] @ rows[:, k].T for k in range(len(estimates)))]
    chosen: dict[tuple[str, str], float] = {}
    while True:
        wide = np.zeros(len(components)), np.full(len(components), _WIDE)
        nothing, white = np.zeros((len(measured), 0)), np.eye(len(measured))
        variances = np.exp(restricted_likelihood(measured, nothing, white, np.stack(components), *wide)[0])
        precision = np.asarray(np.linalg.inv(white + np.tensordot(variances, components, 1)), np.float64)
        p_values = {
            key: _absence(part, precision, measured) * len(columns)
            for key, part in columns.items()
            if key not in chosen
        }
        best = min(p_values, key=lambda key: p_values[key], default=None)
        if best is None or p_values[best] >= level:
            break
        chosen[best] = p_values[best]
        components.append(columns[best] @ columns[best].T)
    pulled = precision @ measured
    values = {key: v * columns[key].T @ pulled for key, v in zip(chosen, variances[1:], strict=True)}
    parts = []
    for kind in dict.fromkeys(kind for kind, _ in chosen):
        mine = {label: value for (of, label), value in values.items() if of == kind}
        left = measured - sum(columns[kind, label] @ value for label, value in mine.items())
        share = 1 - float(left @ left) / float(measured @ measured)
        p_value = min(p for (of, _), p in chosen.items() if of == kind)
        parts.append(Part(kind, mine, min(max(share, 0.0), 1.0), p_value))
    shared = variances[0] * np.eye(len(estimates))
    shared += sum(v * np.outer(alike[key], alike[key]) for key, v in zip(chosen, variances[1:], strict=True))
    owner = np.repeat(np.arange(len(estimates)), [len(z) for z, _ in estimates])
    return Split(parts, measured, rows, owner, shared)


def _absence(columns: FloatArray, precision: FloatArray, values: FloatArray) -> float:
    """Return the p-value of values (n,) if nothing is added along columns (n, q)."""
    information = columns.T @ precision @ columns
    score = columns.T @ precision @ values
    rank = int(np.linalg.matrix_rank(information, hermitian=True))
    return float(chi2_sf(float(score @ np.linalg.pinv(information, hermitian=True) @ score), rank)) if rank else 1.0


@dataclass(frozen=True)
class Attributed:
    """A finding, and what it belongs to: "unit", "session" or "board".

    values: by unit or session, coefficients in SI where an effect has them, in `unit`; the board's have no name.
    """

    name: str
    belongs_to: str
    units: tuple[str, ...]
    sessions: tuple[str, ...]
    share: float
    p_value: float
    values: dict[str, list[float]] = field(default_factory=dict)
    unit: str = ""

    def document(self) -> Json:
        """Return the finding as `diagnosis.json` has it."""
        return {**vars(self), "units": list(self.units), "sessions": list(self.sessions)}


@dataclass(frozen=True, repr=False, eq=False)
class Attribution(Result, Document, page="attribution"):
    """What belongs to units, to sessions and to the board, from recordings of several units in several sessions.

    recordings: as diagnosed, a time course common to their session taken off. findings: what they belong to. drifts:
    by session, what its units have in common in time. single: recordings that show an effect, by its name, which
    repeats nowhere there. skipped: recordings that could not be diagnosed, and why.
    """

    recordings: tuple[BoardRecording, ...]
    findings: tuple[Attributed, ...]
    drifts: tuple[CommonDrift, ...]
    single: dict[str, list[str]]
    skipped: dict[str, str]
    latitude: float | None

    @property
    def units(self) -> list[str]:
        """The units, by name."""
        return in_order(part.unit for part in self.recordings)

    @property
    def sessions(self) -> list[str]:
        """The sessions, by name."""
        return in_order(part.session for part in self.recordings)

    @property
    def verdict(self) -> str:
        """The board's: "unexplained" where a recording is, "effects" where something was named, or "adequate"."""
        verdicts = {part.diagnosis["verdict"] for part in self.recordings}
        if "unexplained" in verdicts:
            return "unexplained"
        return "effects" if "effects" in verdicts or self.findings else "adequate"

    def document(self) -> Json:
        """Return the board's diagnosis as a document of schema `jaximu.diagnosis/1`.

        Of effects, checks and what could hide it keeps the most striking recording's, by name.
        """
        documents = [part.diagnosis for part in self.recordings]
        limits = [(name, limit) for document in documents for name, limit in document["detection_limits"].items()]
        blind = set.intersection(*(set(document["not_observable"]) for document in documents))
        return {
            "schema": documents[0]["schema"],
            "verdict": self.verdict,
            "effects": _by_name(documents, "effects", lambda effect: effect["p_value"]),
            "preflight": [
                finding | {"file": part.file} for part in self.recordings for finding in part.diagnosis["preflight"]
            ],
            "detection_limits": dict(sorted(limits, key=lambda entry: entry[1]["value"])),
            "hidden": _by_name(documents, "hidden", lambda cause: -cause["limit"]),
            "not_observable": {name: documents[0]["not_observable"][name] for name in sorted(blind)},
            "checks": _by_name(documents, "checks", lambda check: check["adjusted"]),
            "suggestion": self.suggestion,
            "next": [],
            "p_value": min(1.0, len(documents) * min(document["p_value"] for document in documents)),
            "noise_scale": max(document["noise_scale"] for document in documents),
            "notes": self.notes,
            "shape": None,
            "learned": None,
            "data": {"files": [file for document in documents for file in document["data"]["files"]]},
            "software": SOFTWARE,
            "recordings": [part.document() for part in self.recordings],
            "attribution": [finding.document() for finding in self.findings],
            "common_drift": [drift.document() for drift in self.drifts],
        }

    @property
    def common(self) -> list[CommonDrift]:
        """The time courses that are more than chance."""
        there = {session for finding in self.findings if finding.name == COMMON_DRIFT for session in finding.sessions}
        return [drift for drift in self.drifts if drift.session in there]

    @property
    def suggestion(self) -> str:
        """What to do next."""
        if self.common:
            return (
                "Log the temperature and the supply of the board with the next session: if the common time course "
                "follows one of them, it can be compensated. It is no part of any unit's calibration."
            )
        effects = (one for one in self.findings if one.belongs_to == "unit" and one.name in CATALOGUE)
        units = in_order(unit for finding in effects for unit in finding.units)
        if not units:
            return ""
        files = shlex.join(part.file for part in self.recordings if part.unit == units[0])
        others = f" Likewise unit{'s' * (len(units) > 2)} {listed(units[1:])}." if len(units) > 1 else ""
        return (
            f"`jaximu diagnose {files} -o RESULTS` diagnoses all recordings of unit {units[0]} together and writes its "
            f"calibration with what belongs to it.{others}"
        )

    @property
    def notes(self) -> list[str]:
        """What a reader should know beside the verdict."""
        repeated = {finding.name for finding in self.findings}
        return [
            f"{effect_title(name)}: beside what repeats there are others, in {listed(places)}."
            if name in repeated
            else f"{effect_title(name)} repeats neither over sessions nor over units; it shows in {listed(places)}."
            for name, places in self.single.items()
        ] + [f"{file} was skipped: {why}" for file, why in self.skipped.items()]


def _by_name(documents: Sequence[Json], key: str, rank: Callable[[Json], float]) -> list[dict]:
    """Return of all recordings' entries of a list the first of each name, in order of rank."""
    entries: dict[str, Json] = {}
    for entry in sorted((entry for document in documents for entry in document[key]), key=rank):
        entries.setdefault(entry["name"], entry)
    return list(entries.values())


def places_of(files: Sequence[str], pattern: str) -> list[tuple[str, str]]:
    """Return the unit and the session of each file, as a pattern of file names or folders has them.

    **Arguments:** `pattern`: such as "unit{unit}_session{session}" or "{unit}/{session}", of the file's name, its
    suffix left out or not, or of its folders.

    Raises `InputError` for a pattern without both fields, a file that it does not fit, and two files of one place;
    `NotPossibleError` for one unit or one session alone.
    """
    names = re.findall(r"\{(.*?)\}", pattern)
    if sorted(names) != ["session", "unit"]:
        raise InputError(
            f"--by {pattern!r}: a pattern names {{unit}} and {{session}} once each, such as "
            "'unit{unit}_session{session}'."
        )
    parts = re.split(r"(\{(?:unit|session)\})", pattern)
    fields = {f"{{{name}}}": f"(?P<{name}>[^/]+?)" for name in names}
    shape = re.compile("(?:.*/)?" + "".join(fields.get(part) or re.escape(part) for part in parts) + r"(?:\.[^/]*)?")
    places: list[tuple[str, str]] = []
    strangers = []
    for file in files:
        path = PurePath(file)
        match = next(filter(None, (shape.fullmatch(folder.as_posix()) for folder in (path, *path.parents))), None)
        if match is None:
            strangers.append(file)
        else:
            places.append((match["unit"], match["session"]))
    if strangers:
        more = f" and {len(strangers) - 1} more" if len(strangers) > 1 else ""
        raise InputError(
            f"--by {pattern!r} does not fit {strangers[0]}{more}: it is to fit the name or folder of every LOG."
        )
    return require_apart(files, places)


def require_apart(files: Sequence[str], places: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return the unit and session of each file. Raises `InputError` where two are of one, else as `require_several`."""
    owners: dict[tuple[str, str], str] = {}
    for file, owner in zip(files, places, strict=True):
        if owner in owners:
            raise InputError(
                f"{owners[owner]} and {file} are both unit {owner[0]} in session {owner[1]}. Leave one out, or let the "
                "pattern or the table tell them apart."
            )
        owners[owner] = file
    require_several(owners)
    return list(owners)


def require_several(places: Iterable[tuple[str, str]], why: str = "") -> None:
    """Raise `NotPossibleError` unless places are of two units and two sessions; `why`: what others were skipped for."""
    units, sessions = map(set, zip(*places, strict=True)) if (places := list(places)) else (set(), set())
    if len(units) < 2 or len(sessions) < 2:
        raise NotPossibleError(
            f"--by needs two units and two sessions or more to tell them apart, found {counted(len(units), 'unit')} in "
            f"{counted(len(sessions), 'session')}: record the others, or diagnose the logs without --by. {why}".rstrip()
        )


def _finding(drift: CommonDrift) -> Attributed:
    """Return a common drift as what belongs to its session."""
    return Attributed(COMMON_DRIFT, "session", tuple(drift.loadings), (drift.session,), drift.share, drift.p_value)


def common_drift(parts: Sequence[BoardRecording], draws: int = DRAWS) -> CommonDrift:
    """Return what recordings of a session have most in common in time; `draws`: for what chance has in common."""
    random = np.random.default_rng(20260101)
    return CommonDrift.of([part.at_rest(random, draws) for part in parts], random)


def attribute(
    recordings: Sequence[Recording],
    pattern: str = "",
    gravity: Gravity = STANDARD,
    *,
    places: Sequence[tuple[str, str]] = (),
    statics: Sequence[Any] = (),
    level: float = 0.05,
    report: Callable[[str], None] = lambda text: None,
    **options: Any,
) -> Attribution:
    """Diagnose recordings of several units in several sessions, and split what is named by what it belongs to.

    A time course that all units of a session have in common is taken off its recordings, as the other units show it,
    and they are diagnosed once more. What stays unexplained is diagnosed with what the other recordings say of its
    unit's own effects taken off. Each recording keeps the diagnosis that explains it with fewer effects.

    **Arguments:** `pattern`: of their files, see `places_of`; `places`: the unit and session of each instead;
    `statics`: a recording at rest of each, or its noise, where there is one; `level`: of all attributions together
    where nothing belongs to anything; `report`: is given each step in words; `options`: as for [`jaximu.diagnose`][].

    Recordings that cannot be diagnosed are skipped. Raises what `places_of` does, and `InputError` as `diagnose` does.
    """
    recordings, gravity = recordings_of(list(recordings)), as_gravity(gravity)
    files = [recording.sources[0].path if recording.sources else recording.name for recording in recordings]
    places, skipped = require_apart(files, places) if places else places_of(files, pattern), {}
    at_rest = list(statics) or [None] * len(recordings)

    def ask(index: int, recording: Recording, what: str, known: Sequence[KnownEffect] = ()) -> BoardRecording | None:
        unit, session = places[index]
        report(f"unit {unit} in session {session}{what}, {index + 1} of {len(recordings)}")
        try:
            diagnosis = diagnose(recording, gravity, level=level, known=known, **{"static": at_rest[index]} | options)
        except NotPossibleError as error:
            skipped[files[index] + what] = str(error)
            return None
        return BoardRecording.of(files[index], unit, session, diagnosis)

    first = {index: ask(index, recording, "") for index, recording in enumerate(recordings)}
    parts = {index: part for index, part in first.items() if part is not None}
    require_several([(part.unit, part.session) for part in parts.values()], next(iter(skipped.values()), ""))
    members = [[p for p in parts.values() if p.session == s] for s in in_order(p.session for p in parts.values())]
    drifts = [common_drift(of) for of in members if len(of) > 1]
    common = [drift for drift in drifts if drift.p_value * len(drifts) < level]
    steady = _without_common_drift(parts, recordings, common)
    for index, part in parts.items():
        second = ask(index, steady[index], ", its common drift taken off") if index in steady else None
        if second is not None:
            parts[index] = min(replace(second, alone=part.alone, without_drift=True), part, key=_rank)
    predictions = attributed(list(parts.values()), common, level)[2]
    for (index, part), known in zip(parts.items(), predictions, strict=True):
        if known and part.diagnosis["verdict"] == "unexplained":
            second = ask(index, (dict(enumerate(recordings)) | steady)[index], ", as the others show its unit", known)
            if second is not None:
                parts[index] = min(part.repeated(second, known, index in steady), part, key=_rank)
    split_up, single, _ = attributed(list(parts.values()), common, level)
    lines, apart = attributed_lines(list(parts.values()), level)
    findings = (*(_finding(drift) for drift in common), *split_up, *lines)
    return Attribution(tuple(parts.values()), findings, tuple(drifts), single | apart, skipped, gravity.latitude)


def _without_common_drift(
    parts: Mapping[int, BoardRecording], recordings: Sequence[Recording], common: Sequence[CommonDrift]
) -> dict[int, Recording]:
    """Return the recordings of sessions with a common time course without it, as the other units show it."""
    sessions, steady = {drift.session for drift in common}, {}
    for index, part in parts.items():
        if part.session in sessions:
            others = [other for other in parts.values() if other.session == part.session and other is not part]
            steady[index] = _taken_off(common_drift(others, 0), recordings[index], part)
    return steady


def _taken_off(drift: CommonDrift, recording: Recording, part: BoardRecording) -> Recording:
    """Return a recording without the curve, in each axis as large as the recording shows it.

    **Arguments:** `part`: the recording as it was diagnosed, which is no part of the curve.
    """
    rests, off_base = part.rests, part.evidence.off_base
    curve = np.interp(rests.times, drift.times, drift.curve)[:, None]
    questions = [rests.columns(triad, curve) for triad in TRIADS]
    columns = off_base(np.concatenate([*questions, rests.columns("gyroscope", rests.up)], axis=1))
    size = np.maximum(column_lengths(columns), 1e-300)
    amounts = np.linalg.lstsq(columns / size, part.evidence.residual, rcond=BLIND)[0] / size
    changed = {}
    for triad, amount in zip(TRIADS, amounts[:6].reshape(2, 3), strict=True):
        signal = recording.signals[triad]
        course = np.interp(signal.time, drift.times, drift.curve)
        changed[triad] = replace(signal, values=signal.values - course[:, None] * amount)
    return replace(recording, **changed)


def _rank(part: BoardRecording) -> tuple[bool, int, float]:
    """Return what of several diagnoses of a recording is kept by, the least: unexplained, effects, error left out."""
    return part.diagnosis["verdict"] == "unexplained", len(part.diagnosis["effects"]), part.chi2_heldout


def attributed(
    parts: Sequence[BoardRecording], common: Sequence[CommonDrift], level: float
) -> tuple[list[Attributed], dict[str, list[str]], list[list[KnownEffect]]]:
    """Return what each effect that a recording names belongs to, and where those show that belong to nothing.

    The most significant one comes first; others are estimated beside it, and all beside the common time courses. With
    it what of the units' own effects the other recordings tell of each.
    """
    named = sorted((effect for part in parts for effect in part.named), key=lambda effect: effect.p_value)
    strongest = {effect.name: effect for effect in reversed(named)}
    shared = {drift.session: np.stack([drift.times, drift.curve], axis=1) for drift in common}
    questions = {block.name for part in parts for block in part.evidence.blocks}
    findings, beside = [], {}
    single = {name: _places(parts, name) for name in strongest if name not in questions}  # a curve is of one recording
    predictions: list[list[KnownEffect]] = [[] for _ in parts]
    for name, strong in sorted(strongest.items(), key=lambda entry: entry[1].p_value):
        if name in single:
            continue
        inner, kind = _inner(strong), CATALOGUE[name]
        sizes = np.asarray(kind(np.zeros(kind.size), **inner).typical_sizes(1.0).coefficients)
        estimates = [part.estimate(name, inner, beside, shared.get(part.session)) for part in parts]
        owners = {
            "board": [""] * len(parts),
            "unit": [part.unit for part in parts],
            "session": [part.session for part in parts],
        }
        divided = split(estimates, owners["unit"], owners["session"], level / len(strongest))
        apart = _places(parts, name)
        for share in divided.parts:
            mine = [part for part, owner in zip(parts, owners[share.belongs_to], strict=True) if owner in share.values]
            apart = [where for where in apart if where not in {part.place for part in mine}]
            findings.append(
                Attributed(
                    name,
                    share.belongs_to,
                    tuple(in_order(part.unit for part in mine)),
                    tuple(in_order(part.session for part in mine)),
                    share.share,
                    share.p_value,
                    {label: (values * sizes).tolist() for label, values in share.values.items()},
                    kind.coefficient_unit(SENSOR_UNITS.get(strong.triad, "")),
                )
            )
        if divided.parts:
            beside[name] = inner
        if apart:
            single[name] = apart
        if divided.parts and kind.scope == "device":
            for index, part in enumerate(parts):
                predictions[index] += part.known(name, inner, *divided.predicted(index))
    return findings, single, predictions


def _places(parts: Sequence[BoardRecording], name: str) -> list[str]:
    """Return where an effect is named, in words."""
    return [part.place for part in parts if name in [effect.name for effect in part.named]]


def attributed_lines(parts: Sequence[BoardRecording], level: float) -> tuple[list[Attributed], dict[str, list[str]]]:
    """Return what lines that move belong to, and where there are some that belong to nothing.

    A line belongs to a unit if it lies closer to where it lay in other sessions than chance has it, and to a session if
    several units show it at the same frequency at the start and at the end. Of all that are said to belong to something
    a share of `level` may be wrong (Y. Benjamini and Y. Hochberg, Journal of the Royal Statistical Society B 57, 1995).
    """
    lines = [(part, one) for part in parts for one in part.lines]
    groups = sorted(_coincidences(lines, level))
    steps = [p_value * len(groups) / (rank + 1) for rank, (p_value, *_) in enumerate(groups)]
    kept = max((rank + 1 for rank, step in enumerate(steps) if step < level), default=0)
    shared: dict[str, dict[int, float]] = {"unit": {}, "session": {}}
    for step, (_, kind, members) in zip(steps[:kept], groups, strict=False):
        shared[kind] |= dict.fromkeys(members, step)
    findings = []
    for kind, members in shared.items():
        if members:
            mine = [lines[index] for index in members]
            values: dict[str, list[float]] = {}
            for part, one in mine:
                values.setdefault(getattr(part, kind), []).append(one.middle)
            units, sessions = (in_order(getattr(part, name) for part, _ in mine) for name in ("unit", "session"))
            share, p_value = len(members) / len(lines), min(members.values())
            findings.append(Attributed(MOVING_LINE, kind, tuple(units), tuple(sessions), share, p_value, values, "Hz"))
    apart = [part.place for index, (part, _) in enumerate(lines) if index not in shared["unit"] | shared["session"]]
    return findings, {MOVING_LINE: list(dict.fromkeys(apart))} if apart else {}


def _coincidences(
    lines: Sequence[tuple[BoardRecording, MovingLine]], level: float
) -> Iterator[tuple[float, str, list[int]]]:
    """Yield groups of lines that lie close together: how probable by chance, what they have in common, their places.

    Of a unit's axis over sessions, where each lies in the middle; of a session's units, where each begins and ends.
    """
    questions: dict[tuple[str, str, str], list[int]] = {}
    for index, (part, one) in enumerate(lines):
        questions.setdefault(("unit", part.unit, one.axis), []).append(index)
        questions.setdefault(("session", part.session, one.triad), []).append(index)
    for (kind, *_), left in questions.items():
        while len({lines[index][0].place for index in left}) > 1:
            parts, moving = zip(*(lines[index] for index in left), strict=True)
            if kind == "unit":
                at = np.array([[one.middle] for one in moving])
            else:
                ends = np.array([one.line.times[[0, -1]] for one in moving])
                times = [ends[:, 0].max(), ends[:, 1].min()]
                at = np.array([np.interp(times, one.line.times, one.line.recorded) for one in moving])
            labels = [part.session if kind == "unit" else part.unit for part in parts]
            group, p_value = coincident(labels, at, max(one.line.rate / 2 for one in moving))
            yield p_value, kind, [left[index] for index in group]
            if p_value >= level:
                break
            left = [index for number, index in enumerate(left) if number not in group]
