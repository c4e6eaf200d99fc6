"""Samples that were lost although the stamps go on evenly, as the turns of a calibrated recording show them.

What a lost stretch turned by is missing from its turn: gravity carried over the turn misses the next pose. One long
stretch makes one turn stand out from all others, and the rate jumps where it was; that turn is left out. Samples lost
here and there take from each turn a whole number of its own samples' rotations: their covariance is a share of the
sum of squares of these (shot noise), which nothing else in a recording has. Rivals (scatter of all turns alike, rates
that the samples miss, every effect of the catalogue) stand beside it on equal terms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import scipy
from numpy.typing import NDArray

from jaximu.calibration.calibration import Calibration
from jaximu.data.by_hand import RecordedByHand
from jaximu.data.handling import missed_by_sampling
from jaximu.data.poses import condensed
from jaximu.estimation.fitting import effect_numbers, linearise, unwhitened
from jaximu.estimation.problem import without_equipment
from jaximu.ground.array_types import FloatArray, IntArray
from jaximu.ground.differences import midpoints
from jaximu.ground.quantities import counted
from jaximu.ground.rotation import conjugate, multiply, rotate, unit_vectors
from jaximu.ground.tracing import first, lifted
from jaximu.ground.vectors import dot_rows, lengths_of, submatrix
from jaximu.mistakes import without_rows
from jaximu.recordings.finding import Finding
from jaximu.recordings.observations import Turns
from jaximu.recordings.recording import Recording

_FEWEST = 6
"""Turns from which on the others tell what one should have been."""
_GATE = 9.0
"""Squared deviations of a turn, at the scatter of the fit, from which on it is looked at."""
_OUT = 25.0
"""The same at the scatter of the other turns, from which on it is off."""
_MOST = 0.3
"""Share of the turns that may be off for the others to tell."""
_SURE = 9.0
"""Nats by which a lost stretch must beat a turn that scatters more than others do."""
_TAIL = 4.0
"""Degrees of freedom of Student's law of turns that scatter."""
_SLACK = 0.3
"""Share of a stretch's rotation by which it may differ in direction from the mean of the rates at both its ends."""
_LEAST_JUMP = 3.0
"""Times the usual step of the rate's course that a jump is measured against."""
_FREE = 1e2
"""Variance, rad², of a turn that is free."""
_MEDIAN = 2 * np.log(2.0)  # of χ² with two degrees of freedom
_SCATTER = np.geomspace(0.1, 100.0, 9)
"""Standard deviations of turns that are tried, over their noise; about `_USUAL_SCATTER`, a factor e² either way."""
_USUAL_SCATTER, _SCATTER_SPREAD = 0.3, 2.0
_SAMPLING = np.array([1e-3, 0.1, 0.2, 0.4, 0.6, 1.0, 2.0, 5.0])
"""The same of what sampling misses, over what even and odd samples differ by; about a tenth, a factor e either way."""
_USUAL_SAMPLING, _SAMPLING_SPREAD = 0.1, 1.0
_SHARES = np.array([1e-3, 2e-3, 4e-3, 8e-3, 0.015, 0.03, 0.06, 0.12])
"""Shares of samples lost that are tried, all as likely."""
_SHOWN = 3.0
"""Nats by which lost samples must beat what scatters otherwise, with any effect beside it."""
_WORST, _ALSO = 1, 0.5
"""Turns, those off most, without which samples lost everywhere must show, too, and the nats by which."""
_COARSE = 10.0
"""Excess variance of turns, over their noise, below which no samples are missing."""
_PLAUSIBLE = 10.0
"""Usual sizes that an effect's coefficients may have."""
_MOST_EFFECTS = 3
_UNKNOWN = frozenset({"temperature", "temperature_rate", "vibration_power", "magnetic_field"})


@dataclass(frozen=True)
class _Turned:
    """The turns' conditions once all else is taken into account, two numbers each, in order.

    gram: NᵀP₀N (2T, 2T) and pull: NᵀP₀r (2T,), N the rows of the turns, P₀ = C₀⁻¹ − C₀⁻¹J(JᵀC₀⁻¹J)⁻¹JᵀC₀⁻¹ with the
    covariance C₀ without any scatter of the turns. real: their places among all turns. scatter, sampling, lost (T, 2,
    2): covariances at a size of one. constant: the logarithm of the probability of all but the turns.
    """

    gram: FloatArray
    pull: FloatArray
    real: IntArray
    scatter: FloatArray
    sampling: FloatArray
    lost: FloatArray
    constant: float = 0.0

    def at(self, covariance: FloatArray) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Return NᵀPN and NᵀPr where the turns scatter by `covariance` (T, 2, 2), by Woodbury's identity."""
        inner = np.eye(len(self.pull)) + self.gram @ scipy.linalg.block_diag(*covariance)
        return np.linalg.solve(inner, self.gram), np.linalg.solve(inner, self.pull)

    def deviations(self, variance: float, gone: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Return what each turn is off (T, 2) as the others tell it, and the squared deviation (T,).

        Both are zero where the others do not tell. `gone`: turns, by place here, that are not among the others.
        """
        covariance = variance * self.scatter
        covariance[list(gone)] = _FREE * np.eye(2)
        gram, pull = self.at(covariance)
        turn = np.arange(len(self.real))
        blocks = gram.reshape(len(turn), 2, len(turn), 2)[turn, :, turn]
        # the others are not asked where they know a turn to a radian, or worse
        known = np.linalg.eigvalsh(blocks)[:, 0] * (1.0 + np.linalg.eigvalsh(covariance)[:, 1]) >= 1.0
        off, squared = np.zeros((len(turn), 2)), np.zeros(len(turn))
        inverse = np.linalg.inv(blocks[known])
        off[known] = np.einsum("tab,tb->ta", inverse, pull.reshape(-1, 2)[known])
        spread = inverse - covariance[known] + variance * self.scatter[known]
        squared[known] = np.einsum("ta,tab,tb->t", off[known], np.linalg.inv(spread), off[known])
        return off, squared

    def usual(self, gone: Sequence[int]) -> float:
        """Return the excess variance at which half of the other turns are off by no more than noise would have it."""
        others = np.setdiff1d(np.arange(len(self.real)), gone)

        def too_much(exponent: float) -> bool:
            squared = self.deviations(10.0**exponent, gone)[1][others]
            return bool(np.median(np.concatenate([squared[squared > 0], [0.0]])) > _MEDIAN)

        low, high = -2.0, 7.0
        if not too_much(low):
            return 10.0**low
        for _ in range(10):
            middle = (low + high) / 2
            low, high = (middle, high) if too_much(middle) else (low, middle)
        return 10.0**high

    def beside(self, across: FloatArray, within: FloatArray, pull: FloatArray) -> _Turned:
        """Return the same with an effect beside, whose coefficients are known to its usual sizes beforehand.

        With its derivatives E by coefficients in usual sizes: `across` NᵀP₀E (2T, q), `within` EᵀP₀E (q, q), `pull`
        EᵀP₀r (q,).
        """
        whole = within + np.eye(len(within))
        taken = across @ np.linalg.inv(whole)
        gained = float(pull @ np.linalg.solve(whole, pull) - np.linalg.slogdet(whole)[1]) / 2
        return replace(
            self,
            gram=self.gram - taken @ across.T,
            pull=self.pull - taken @ pull,
            constant=self.constant + gained,
        )

    def without(self, turns: IntArray) -> _Turned:
        """Return the same with some turns, by place, free."""
        free = np.add.outer(2 * turns, np.arange(2)).ravel()
        size = np.sqrt(_FREE)
        return self.beside(size * self.gram[:, free], _FREE * submatrix(self.gram, free), size * self.pull[free])

    def evidence(self, share: float) -> tuple[float, float]:
        """Return the logarithm of the probability of the turns where a share of the samples was lost, and the excess.

        Over the grids of scatter and of what sampling misses, up to a constant: −½ log |1 + GB| + ½ qᵀB(1 + GB)⁻¹q.
        """
        evidence = np.zeros((len(_SCATTER), len(_SAMPLING)))
        for (k, scatter), (m, sampling) in product(enumerate(_SCATTER), enumerate(_SAMPLING)):
            covariance = scatter**2 * self.scatter + sampling**2 * self.sampling + share * self.lost
            whole = scipy.linalg.block_diag(*covariance)
            inner = np.eye(len(self.pull)) + self.gram @ whole
            evidence[k, m] = (self.pull @ whole @ np.linalg.solve(inner, self.pull) - np.linalg.slogdet(inner)[1]) / 2
        scatter = (np.log(_SCATTER / _USUAL_SCATTER) / _SCATTER_SPREAD) ** 2
        sampling = (np.log(np.maximum(_SAMPLING, 0.02) / _USUAL_SAMPLING) / _SAMPLING_SPREAD) ** 2
        beforehand = -np.add.outer(scatter, sampling) / 2
        evidence += beforehand - np.logaddexp.reduce(beforehand, axis=None)
        likeliest = int(evidence.argmax()) // len(_SAMPLING)
        return self.constant + float(np.logaddexp.reduce(evidence, axis=None)), float(_SCATTER[likeliest] ** 2)


class _Recorded:
    """A calibration's recordings, its turns' conditions, and the samples of each turn."""

    def __init__(self, calibration: Calibration) -> None:
        fitted, observations = calibration.fit, calibration.observations
        gyroscope = calibration.imu.triad("gyroscope")
        assert fitted is not None and observations is not None
        self.calibration, self.observations, self.gyroscope = calibration, observations, gyroscope
        self.signals = [part.recording.signals["gyroscope"] for part in calibration.segmentations]
        about = condensed(*lifted((fitted.imu.with_effects(), observations)))
        assert about.reaction is not None and about.running is not None
        self.turns: Turns = observations.turns
        self.force, self.running = about.force[0], np.asarray(about.running)
        self.output, self.interval = np.asarray(self.turns.output), np.asarray(self.turns.interval)
        chain = first(about.covariance)
        self.residual, slope = (rows[np.asarray(chain.used) > 0] for rows in unwhitened(fitted, chain))
        covariance = chain.dense()
        self.used = covariance.used > 0
        used = np.ix_(self.used, self.used)
        poses, turned, means = (covariance.component(number)[used] for number in range(3))
        excess = fitted.excess
        inverse = np.linalg.inv(covariance.measured[used] + excess[0] * poses + excess[2] * means)
        weighted = inverse @ slope
        self.projector = inverse - weighted @ np.linalg.pinv(slope.T @ weighted, 1e-12, hermitian=True) @ weighted.T
        real = np.flatnonzero(self.turns.mask)
        start = len(observations.poses.mask) + 2 * real[:, None]
        rows = self.rows = (self.used.cumsum() - 1)[start + np.arange(2)]
        # (T, S, 2): what a sample that is lost takes off its turn
        self.lacking = -np.einsum(
            "tasi,tsi->tsa",
            np.asarray(about.reaction.turn),
            (self.output - gyroscope.bias) * (self.interval > 0)[..., None],
        )[real]
        missed = missed_by_sampling(self.turns, gyroscope, about.running)[real]
        self.turned = _Turned(
            submatrix(self.projector, rows.ravel()),
            (self.projector @ self.residual)[rows.ravel()],
            real,
            turned[rows[:, :, None], rows[:, None, :]],
            (missed**2).sum(axis=1)[:, None, None] / 3 * np.eye(2),
            np.einsum("tsa,tsb->tab", self.lacking, self.lacking),
        )
        self.excess = float(excess[1])
        self.samples = [self._samples(int(turn)) for turn in real]
        self.counts = (self.interval[real] > 0).sum(axis=1)

    def _samples(self, turn: int) -> tuple[int, int, int]:
        """Return the recording of a turn, its first sample in it and the one after its last."""
        counts = np.cumsum([len(part.intervals) for part in self.calibration.segmentations])
        part = int(counts.searchsorted(turn, "right"))
        poses = self.observations.poses
        ends = [poses.stop[turn], poses.start[turn + 1]]
        first, last = self.signals[part].time.searchsorted(ends)
        return part, int(first), int(last)

    def span(self, turn: int) -> str:
        """Return when a turn, by place, begins and ends."""
        part, first, last = self.samples[turn]
        begin, end = self.signals[part].time[[first, last - 1]]
        return f"{begin:.1f} to {end:.1f} s"

    def jumps(self) -> list[FloatArray]:
        """Return for each turn (S − 1,) by how many times its usual step the course of the rate jumps in an interval.

        The jump is a difference of neighbours against those before and after it; the usual step is that of the
        intervals around, and at least three times that of half of all intervals in turns.
        """
        bends = []
        for signal in self.signals:
            difference = np.diff(self.gyroscope.recover_on_host(signal.values), axis=0)
            bend = np.zeros(len(difference))
            bend[1:-1] = lengths_of(difference[1:-1] - (difference[2:] + difference[:-2]) / 2)
            gaps = np.flatnonzero(np.diff(signal.time) > 1.6 / signal.rate)
            bend[(gaps[:, None] + np.arange(-1, 2)).clip(0, len(bend) - 1)] = 0.0
            bends.append(bend)
        usual = float(np.median(np.concatenate([bends[p][a : b - 1] for p, a, b in self.samples])))
        jumps = []
        for part, start, stop in self.samples:
            beside = np.arange(start, stop - 1)[:, None] + np.array([-3, -2, 2, 3])
            around = (bends[part][beside.clip(0, len(bends[part]) - 1)] ** 2).mean(axis=1)
            jumps.append(bends[part][start : stop - 1] / np.sqrt(around + (_LEAST_JUMP * usual) ** 2 + 1e-30))
        return jumps

    def missing(self, turn: int, off: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return for every interval (S − 1,) of a turn, by place, the time that must be missing there for the turn to
        be `off` (2,) by it, and the share of the misfit that it leaves.

        Seen from the frame at the interval, gravity as carried from before must turn about the rate there into gravity
        as carried from after: by an angle about a known axis, whose closed form it has.
        """
        real = int(self.turned.real[turn])
        after = unit_vectors(self.force[real + 1])
        before = unit_vectors(after - np.asarray(self.turns.basis)[real].T @ off)
        running = self.running[real][: self.counts[turn]]
        back = multiply(conjugate(running), np.broadcast_to(running[-1], running.shape))
        carried, wanted = (
            np.asarray(rotate(back, np.broadcast_to(gravity, (len(running), 3))))[:-1] for gravity in (before, after)
        )
        rate = self.gyroscope.recover_on_host(self.output[real][: len(running)])
        middle = midpoints(rate)
        speed = np.maximum(lengths_of(middle), 1e-9)
        axis = middle / speed[:, None]
        moved = wanted - carried
        left = abs(dot_rows(moved, axis)) / np.maximum(lengths_of(moved), 1e-12)
        carried, wanted = (gravity - axis * dot_rows(gravity, axis)[:, None] for gravity in (carried, wanted))
        angle = -np.arctan2(dot_rows(axis, np.cross(carried, wanted)), dot_rows(carried, wanted))
        return angle / speed, left


def tells_losses(calibration: Calibration) -> bool:
    """Whether a calibration has turns enough for some to tell what is missing in others."""
    turns = None if calibration.observations is None else calibration.observations.turns
    return turns is not None and calibration.imu.gyroscope is not None and int(turns.mask.sum()) > _FEWEST


def without_lost_stretches(calibration: Calibration) -> tuple[list[Recording], list[Finding]]:
    """Return a calibration's recordings without the rows around stretches of samples that were lost, and the findings.

    A turn is off that lies far out of the others' scatter. It lost a stretch where that explains it better than a tail
    of the scatter does: time is missing and not too much, the rate there turns the way that is missing, and the rate
    jumps there as it does in few other places.
    """
    recordings = [part.recording for part in calibration.segmentations]
    recorded = _Recorded(calibration)
    turned, count = recorded.turned, len(recorded.turned.real)
    if turned.deviations(recorded.excess, [])[1].max(initial=0.0) < _GATE:
        return recordings, []
    gone: list[int] = []
    while len(gone) <= _MOST * count:
        squared = turned.deviations(turned.usual(gone), gone)[1]
        squared[gone] = 0.0
        if squared.max() < _OUT:
            break
        gone.append(int(squared.argmax()))
    if not gone:
        return recordings, []
    off, squared = turned.deviations(turned.usual(gone), gone)
    judged = gone if len(gone) <= _MOST * count else gone[:1]  # a gross one may move all others: it goes first
    jumps = recorded.jumps()
    others = np.sort(np.concatenate([jumps[turn] for turn in range(count) if turn not in gone]))
    stretches, clipped = [], []
    for turn in judged:
        time, left = recorded.missing(turn, off[turn])
        if not len(time) or squared[turn] <= 0:
            continue
        rare = (1 + len(others) - others.searchsorted(jumps[turn])) / (1 + len(others))
        sure = (
            (_TAIL + 2) / 2 * np.log1p(squared[turn] / _TAIL)
            - np.log(2 * _SLACK * squared[turn])
            - (left / _SLACK) ** 2 / 2
            - np.log(len(time) * rare)
        )
        # where the rate is nearly zero, the time could be anything: nothing is lost for longer than the recording
        sure[(time <= 0) | (time > np.ptp(recorded.signals[recorded.samples[turn][0]].time))] = -np.inf
        interval = int(sure.argmax())
        if sure[interval] < _SURE:
            continue
        (clipped if _reaches_a_limit(recorded, turn) else stretches).append((turn, interval, float(time[interval])))
    return _left_out(recorded, recordings, off, stretches, clipped)


def _reaches_a_limit(recorded: _Recorded, turn: int) -> bool:
    """Whether an axis stays at the greatest or least value of its recording for two samples of a turn or more."""
    part, first, last = recorded.samples[turn]
    values = recorded.signals[part].values
    extremes = np.stack([values.max(axis=0), values.min(axis=0)])
    return bool((values[first:last] == extremes[:, None]).sum(axis=1).max() > 1)


def _left_out(
    recorded: _Recorded,
    recordings: list[Recording],
    off: FloatArray,
    stretches: list[tuple[int, int, float]],
    clipped: list[tuple[int, int, float]],
) -> tuple[list[Recording], list[Finding]]:
    rows: dict[int, list[int]] = {}
    losses, spots = [], []
    for turn, interval, time in sorted(stretches):
        part, first, last = recorded.samples[turn]
        stamps = recorded.signals[part].time
        losses.append(
            f"between {stamps[first]:.1f} and {stamps[last - 1]:.1f} s gravity turned by "
            f"{np.degrees(lengths_of(off[turn])):.2g}° more than the gyroscope says, as if about {time:.2g} s were "
            f"missing at {stamps[first + interval]:.2f} s, where the rate jumps"
        )
        spots.append(first + interval + 2)
    for turn, _, _ in (*stretches, *clipped):
        part, first, last = recorded.samples[turn]
        rows.setdefault(part, []).extend(range(first, last))
    kept = list(recordings)
    for part, gone in rows.items():
        kept[part] = without_rows(recordings[part], {"gyroscope": np.array(gone)})
    findings = []
    if losses:
        findings.append(
            Finding(
                "data.lost_samples",
                tuple(spots[:5]),
                f"Samples were lost although the stamps go on evenly: {'; '.join(losses[:3])}"
                f"{' …' if len(losses) > 3 else ''}. {counted(len(losses), 'turn')} left out. Log the sensor's own "
                "stamps or a counter, and look for what holds the logger up.",
                rivals=("data.order",),
            )
        )
    if clipped:
        where = ", ".join(recorded.span(turn) for turn, _, _ in clipped[:3])
        findings.append(
            Finding(
                "data.clipping",
                tuple(recorded.samples[turn][1] + 1 for turn, _, _ in clipped[:5]),
                "gyroscope: it turned further than it says in turns that stop at its greatest or least value "
                f"({where}): its range is too small for this motion. These turns are left out; choose a larger range, "
                "or turn more slowly.",
            )
        )
    return kept, findings


def lost_share(calibration: Calibration) -> list[Finding]:
    """Return whether samples were lost here and there in all turns, what share of them, and in which turns most."""
    assert calibration.fit is not None
    if calibration.fit.excess[1] < _COARSE:
        return []
    recorded = _Recorded(calibration)
    turned = recorded.turned
    share, gain = _gain(turned)
    if gain < _SHOWN:
        return []
    # samples lost everywhere show without the turns that are off most, which may be off for another reason
    squared = turned.deviations(turned.usual([]), [])[1]
    others = turned.without(squared.argsort()[-_WORST:])
    if others.evidence(share)[0] - others.evidence(0.0)[0] < _ALSO:
        return []
    if _effects(recorded) > turned.evidence(0.0)[0] + gain - _SHOWN:
        return []
    variance = turned.evidence(share)[1]
    pull = turned.at(variance * turned.scatter + share * turned.lost)[1].reshape(-1, 2)
    # of shot noise: the mean, and what covaries with the turn's misfit
    missing = share * (recorded.counts + np.einsum("tsa,ta->t", recorded.lacking, pull))
    total = share * recorded.counts.sum()
    worst = missing.argsort()[::-1][:3]
    period = float(np.median(recorded.interval[recorded.interval > 0]))
    where = "; ".join(f"{missing[turn]:.0f} from {recorded.span(turn)}" for turn in worst if missing[turn] >= 1)
    return [
        Finding(
            "data.lost_samples",
            tuple(recorded.samples[turn][1] + 1 for turn in worst),
            f"Turns misfit as if about {100 * share:.2g} % of the samples were lost, and the rest stamped as if none "
            f"were: about {total:.0f} samples, {total * period:.2g} s, in the turns"
            + (f" (most: {where})" if where else "")
            + ". Which ones cannot be determined, and all rates read too small by that share. Log the sensor's own "
            "stamps or a counter, and record again.",
            spoils=True,
        )
    ]


def _gain(turned: _Turned) -> tuple[float, float]:
    """Return the likeliest share of samples lost, and by how many nats losses beat none, averaged over the shares."""
    gains = np.array([turned.evidence(share)[0] for share in _SHARES]) - turned.evidence(0.0)[0]
    return float(_SHARES[gains.argmax()]), float(np.logaddexp.reduce(gains) - np.log(len(gains)))


def _effects(recorded: _Recorded) -> float:
    """Return the logarithm of the probability of the turns with the effects that explain most, one after another."""
    from jaximu.model.effects.catalogue import CATALOGUE  # a tenth of a second, which few recordings need

    calibration = recorded.calibration
    fitted = {effect.name for effect in calibration.imu.all_effects().values()}
    temperature = calibration.segmentations[0].recording.temperature
    unknown = _UNKNOWN if temperature is None else _UNKNOWN - {"temperature", "temperature_rate"}
    kinds = [
        kind
        for name, kind in CATALOGUE.items()
        if kind.cause
        and kind.owner in ("accelerometer", "gyroscope", "setup")
        and kind.scope != "fixture"
        and not unknown & set(kind.needs)
        and name not in fitted
    ]
    bare = calibration.imu.with_effects()
    measurement = RecordedByHand(calibration.segmentations, recorded.observations)
    linear = linearise(bare, measurement, without_equipment)
    extent = measurement.extent()
    reactions = measurement.dormant_columns(bare, linear.details, {kind: kind.grid(extent) for kind in kinds})
    candidates = [
        (
            columns[recorded.used] * _PLAUSIBLE * effect_numbers(bare.with_effects(kind.dormant()))[2][: kind.size],
            len(grid),
        )
        for kind, grid in reactions.items()
        for columns in grid
    ]
    projector, turned = recorded.projector, recorded.turned
    total = turned.evidence(0.0)[0]
    for _ in range(_MOST_EFFECTS):
        tried = []
        for columns, choices in candidates:
            weighted = projector @ columns
            beside = turned.beside(
                weighted[recorded.rows.ravel()], columns.T @ weighted, weighted.T @ recorded.residual
            )
            tried.append((beside.evidence(0.0)[0] - np.log(choices), beside, columns))
        best, beside, columns = max(tried, key=lambda candidate: candidate[0])
        if best < total + _SHOWN:
            break
        weighted = projector @ columns
        whole = columns.T @ weighted + np.eye(columns.shape[1])
        projector = projector - weighted @ np.linalg.solve(whole, weighted.T)
        total, turned = best, beside
    return total
