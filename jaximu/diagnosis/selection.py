"""From scores to causes: which effects explain a misfit, alone or together, and which cannot be told from them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from jaximu.diagnosis.evidence import FAMILY_LEVEL, EffectBlock, Evidence, Scores
from jaximu.model.effects import CATALOGUE

LEVEL = FAMILY_LEVEL
"""Rate of false alarms over all tests together."""
_TIE = 7.0
"""Difference of the information criterion up to which a rival is not ruled out: beyond it is 33 times less likely."""
BESIDE = 0.1
"""Share of the level at which something must stand out beside what was found: chance must be ten times as unlikely."""
_DEFECT = 10.0
"""What a defect of the recording must lead by, which would be cut out, against an effect that explains as much."""
_STRONG, _SEPARATE = 2.0, 1.0
"""Detection limits that each of several must have beside the others: weak ones imitate what is outside the catalogue.
Fewer will do for the only one of its sensor, or of its recording, whose conditions hardly share any with the others':
nothing imitates both at once."""
_SHARED, _ALIKE = 0.1, 0.5
"""Share of one effect's conditions that another may make to be separate from it; and share of its statistic beyond
which two curves of one input are one curve that the catalogue lacks: each mends what the other is wrong by."""
_SECOND_ORDER = 0.02
"""Share of a strong effect's own χ² that it may leave and still be taken alone: columns are those about a fit without
the effect, so that a slope of 10 % against the gain leaves 1 % of χ² in the shape of a higher power."""
MOST = 3
"""Effects that one recording is trusted to name: beyond, combinations imitate what they are not."""
_PARTNERS = 12
"""Effects, or pairs of them, best first, that are tried with every other where they do not do by themselves."""
_TOGETHER = 4
"""Effects beside which drift is estimated: more than are ever named, fewer than imitate any misfit."""
_TRIED = 40
"""Pairs or triples, best first, that are asked whether they leave anything."""


@dataclass(frozen=True)
class SelectedCause:
    """A block that is taken for present, and the rivals (blocks of other names) that explain the data as well."""

    block: int
    rivals: tuple[int, ...]
    statistic: float
    freedom: int
    p_value: float  # of its absence, by its own test with the other causes present, its grid allowed for


@dataclass(frozen=True)
class Selection:
    """Causes jointly present, strongest first; none if nothing is missing.

    p_value: family-wise, that nothing is missing. complete: with the causes in the model no test stands out.
    scores: before any cause is taken in.
    """

    causes: tuple[SelectedCause, ...]
    complete: bool
    p_value: float
    scores: Scores

    @property
    def explained(self) -> bool:
        """Whether nothing is missing."""
        return self.complete and not self.causes


def select(evidence: Evidence, level: float = LEVEL) -> Selection:
    """Name what is missing: nothing, one effect, a pair, a triple, or the strongest one of what stays incomplete.

    A cause explains a misfit if, once it is in the model, no test of the whole family stands out any more, at a tenth
    of the level: at the level itself one true cause in twenty would be refused. Causes are ranked by
    S − (q + inner) ln(dof) and, for a place among many, −2 ln of their number; those close to the best are its rivals.
    """
    scores = evidence.scores()
    p_value = evidence.family_wise(scores.smallest)
    if p_value >= level:
        return Selection((), True, p_value, scores)

    def explain(*causes: int) -> bool:
        return evidence.family_wise(evidence.scores(causes).smallest) >= BESIDE * level

    def surprises(cause: int) -> bool:
        return evidence.family_wise(float(scores.p_value[cause])) < level

    best = _leaders(evidence, scores)
    close = [k for k in best if criterion(evidence, scores, k) > criterion(evidence, scores, best[0]) - _TIE]
    if named := [k for k in close if surprises(k) and explain(k)][:1]:
        rivals = [k for k in close if k not in named]
        return Selection((_cause(evidence, named + rivals, scores),), True, p_value, scores)
    if best and evidence.blocks[best[0]].kind == "effect" and _second_order(evidence, scores, best[0]):
        return Selection((_cause(evidence, close, scores),), True, p_value, scores)
    starts = [(k,) for k in best]
    while starts and len(starts[0]) < MOST:
        ranked = _with_one_more(evidence, starts[:_PARTNERS])
        if together := _explaining(evidence, ranked, explain):
            return Selection(_causes_together(evidence, together), True, p_value, scores)
        starts = list(ranked)
    # what lies outside all spans may be the only thing that stands out: then nothing deserves a name
    named = [k for k in close if evidence.blocks[k].kind == "effect" and surprises(k)][:1]
    rivals = [k for k in close if k not in named]
    return Selection((_cause(evidence, named + rivals, scores),) if named else (), False, p_value, scores)


def most(evidence: Evidence) -> int:
    """Return how many effects may be named: each of several recordings may have some that act in it alone."""
    names = [block.name for block in evidence.blocks if block.kind == "effect"]
    return MOST * max([1, *(CATALOGUE[name].recording for name in names)])


def standing_out(evidence: Evidence, selection: Selection, level: float) -> list[int]:
    """Return the blocks of all effects that stand out: the causes selected, and one after another beside those."""
    chosen = [cause.block for cause in selection.causes]
    while len(chosen) < _TOGETHER:
        scores, names = evidence.scores(chosen), {evidence.blocks[k].name for k in chosen}
        clear = [
            k
            for k in _leaders(evidence, scores)
            if evidence.blocks[k].kind == "effect"
            and evidence.blocks[k].name not in names
            and evidence.family_wise(float(scores.p_value[k])) < level
        ]
        if not clear:
            break
        chosen.append(clear[0])
    return chosen


def slow_change(evidence: Evidence, level: float) -> list[EffectBlock]:
    """Return the shapes of slow change, of no cause, that stand out."""
    slow = [k for k, block in enumerate(evidence.blocks) if (block.kind, block.curved) == ("generic", "time")]
    p_value = evidence.scores().p_value
    return [evidence.blocks[k] for k in slow if evidence.family_wise(float(p_value[k])) < level]


def shape_of(evidence: Evidence, level: float = LEVEL) -> tuple[EffectBlock, float] | None:
    """Return the shape without a cause that explains a misfit by itself, and what it gains, nats.

    If need be it lies between two places of a grid.
    """
    generic = [k for k, block in enumerate(evidence.blocks) if block.kind == "generic"]
    alone, chosen = evidence.scores(), []
    p_value = alone.p_value
    while generic and len(chosen) < 2:
        chosen.append(min(generic, key=lambda k: p_value[k]))
        left = evidence.scores(chosen)
        if len(chosen) == 1 and evidence.family_wise(float(p_value[chosen[0]])) >= level:
            return None
        if evidence.family_wise(left.smallest) >= BESIDE * level:
            return evidence.blocks[chosen[0]], criterion(evidence, alone, chosen[0]) / 2
        name, p_value = evidence.blocks[chosen[0]].name, left.p_value
        generic = [k for k in generic if evidence.blocks[k].name == name and k not in chosen]
    return None


def causes_of(evidence: Evidence, names: Sequence[str]) -> list[SelectedCause]:
    """Return effects that were chosen otherwise as causes: each beside the others, with the rivals it has there."""
    best: dict[str, int] = {}
    for _ in range(2):  # an inner parameter is another beside the other causes
        for name in names:
            scores = evidence.scores([block for other, block in best.items() if other != name])
            places = [k for k, block in enumerate(evidence.blocks) if block.name == name and scores.freedom[k]]
            if places:
                best[name] = max(places, key=lambda k: scores.statistic[k])
    causes = []
    for name, block in best.items():
        scores = evidence.scores([other for key, other in best.items() if key != name])
        rivals = [k for k in _leaders(evidence, scores) if evidence.blocks[k].name not in best]
        causes.append(_cause(evidence, [block, *rivals], scores))
    return sorted(causes, key=lambda cause: -cause.statistic)


def _second_order(evidence: Evidence, scores: Scores, block: int) -> bool:
    """Whether what a strong effect leaves may be its own second order: it is fitted before anything else is asked."""
    explained = float(scores.statistic[block]) * scores.unit**2
    left = float(evidence.residual @ evidence.residual) - explained - evidence.freedom
    return max(left, 4 * np.sqrt(2 * evidence.freedom)) < _SECOND_ORDER * explained


def criterion(evidence: Evidence, scores: Scores, block: int) -> float:
    """Return S − (q + inner) ln(dof), and −2 ln of the number of places for one of many.

    It is rounded: what data cannot tell apart at all is a tie, which the order of the blocks settles.
    """
    candidate = evidence.blocks[block]
    places = sum(other.name == candidate.name for other in evidence.blocks) if candidate.position else 1
    inner = 0 if candidate.position else len(candidate.inner)
    doubt = _DEFECT if candidate.kind == "data" else 0.0
    cost = (scores.freedom[block] + inner) * np.log(evidence.freedom) + 2 * np.log(places) + doubt
    return round(float(scores.statistic[block] - cost), 2)


def _leaders(evidence: Evidence, scores: Scores) -> list[int]:
    """Return the best block of every effect, by the criterion, whose own test is significant at all.

    One whose time goes on over all recordings is left out where what is best in each of them alone explains more.
    """
    leaders: dict[str, int] = {}
    for k, block in enumerate(evidence.blocks):
        if block.kind == "generic" or not scores.freedom[k] or scores.p_value[k] > LEVEL:
            continue
        if block.name not in leaders or scores.statistic[k] > scores.statistic[leaders[block.name]]:
            leaders[block.name] = k
    ranks = {name: criterion(evidence, scores, k) for name, k in leaders.items()}
    kinds = {name: CATALOGUE[name] for name in ranks if name in CATALOGUE}
    for name in [name for name, kind in kinds.items() if kind.throughout_all]:
        alone: dict[int, float] = {}
        for other, kind in kinds.items():
            if kind.recording and kind.owner == kinds[name].owner:
                alone[kind.recording] = max(alone.get(kind.recording, -np.inf), ranks[other])
        if len(alone) > 1 and sum(alone.values()) > ranks[name]:
            del leaders[name]
    return sorted(leaders.values(), key=lambda k: -ranks[evidence.blocks[k].name])


def _cause(evidence: Evidence, explaining: Sequence[int], scores: Scores) -> SelectedCause:
    first = explaining[0]
    top = criterion(evidence, scores, first)
    rivals = tuple(k for k in explaining[1:] if criterion(evidence, scores, k) > top - _TIE)
    places = sum(block.name == evidence.blocks[first].name for block in evidence.blocks)
    p_value = float(-np.expm1(places * np.log1p(-min(scores.p_value[first], 1 - 1e-16))))  # Šidák over its grid
    return SelectedCause(first, rivals, float(scores.statistic[first]), int(scores.freedom[first]), p_value)


def one_curve(evidence: Evidence, one: int, other: int) -> bool:
    """Whether two curves of one input take so much of each other's statistic that they are one the catalogue lacks."""
    curved = {evidence.blocks[k].curved for k in (one, other)}
    if len(curved) > 1 or "" in curved:
        return False
    return max(_taken(evidence, one, other), _taken(evidence, other, one)) > _ALIKE


def strength_needed(evidence: Evidence, block: int, others: Sequence[int]) -> float:
    """Return the detection limits that a cause must have beside others for them not to imitate what has no name."""
    mine = _acting(evidence, block)
    separate = all(
        any(one and other and one != other for one, other in zip(mine, _acting(evidence, k), strict=True))
        and evidence.shared(block, k) < _SHARED
        for k in others
    )
    return _SEPARATE if separate else _STRONG


def _acting(evidence: Evidence, block: int) -> tuple[str, int]:
    """Return the sensor that a block acts on, and the recording in which it acts alone, or 0."""
    name = evidence.blocks[block].name
    return name.partition(".")[0], CATALOGUE[name].recording if name in CATALOGUE else 0


def _taken(evidence: Evidence, one: int, other: int) -> float:
    """Share of its statistic that an effect loses when another is in the model."""
    alone, beside = evidence.scores(), evidence.scores([one])
    return 1 - float(beside.statistic[other] * beside.unit**2 / (alone.statistic[other] * alone.unit**2))


def _with_one_more(evidence: Evidence, starts: Sequence[tuple[int, ...]]) -> dict[tuple[int, ...], float]:
    """Return sets of one effect more than those to start from, best first, and their criteria."""
    ranked: dict[tuple[int, ...], float] = {}
    for start in starts:
        together = sum(criterion(evidence, evidence.scores(start[:k]), one) for k, one in enumerate(start))
        names, beside = {evidence.blocks[k].name for k in start}, evidence.scores(start)
        for other in _leaders(evidence, beside):
            if evidence.blocks[other].name not in names and beside.times(other) > _SEPARATE:
                ranked[tuple(sorted((*start, other)))] = together + criterion(evidence, beside, other)
    return dict(sorted(ranked.items(), key=lambda entry: -entry[1]))


def _explaining(
    evidence: Evidence, ranked: dict[tuple[int, ...], float], explain: Callable[..., bool]
) -> dict[tuple[int, ...], float]:
    """Return the sets that explain the misfit, with their criterion; the likeliest are tried, best first.

    Each effect must be so strong beside the others that chance leads to none, however many sets are tried.
    """

    def stands(one: int, blocks: tuple[int, ...]) -> bool:
        others = [k for k in blocks if k != one]
        strong = evidence.scores(others).times(one) > strength_needed(evidence, one, others)
        return strong and not any(one_curve(evidence, one, other) for other in others)

    together: dict[tuple[int, ...], float] = {}
    for blocks, value in list(ranked.items())[:_TRIED]:
        if together and value < max(together.values()) - _TIE:
            break
        if explain(*blocks) and all(stands(one, blocks) for one in blocks):
            together[blocks] = value
    return together


def _causes_together(evidence: Evidence, together: dict[tuple[int, ...], float]) -> tuple[SelectedCause, ...]:
    """Return the best set as causes, strongest first; rivals of each are what takes its place in sets as good."""
    chosen = max(together, key=lambda blocks: together[blocks])
    close = [set(blocks) for blocks, value in together.items() if value > together[chosen] - _TIE]
    causes = []
    for one in chosen:
        others = set(chosen) - {one}
        rivals = set().union(*(blocks for blocks in close if others <= blocks)) - set(chosen)
        causes.append(_cause(evidence, [one, *sorted(rivals)], evidence.scores(sorted(others))))
    return tuple(sorted(causes, key=lambda cause: -cause.statistic))
