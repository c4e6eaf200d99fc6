"""Act three: causes are taken into the model, which is fitted and asked again, until nothing more can be named."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from jaximu.diagnosis.evidence import EffectBlock, Evidence, strength
from jaximu.diagnosis.experiment import Experiment, State
from jaximu.diagnosis.improvement import on_held_out
from jaximu.diagnosis.selection import (
    BESIDE,
    SelectedCause,
    Selection,
    causes_of,
    most,
    one_curve,
    select,
    strength_needed,
)
from jaximu.ground.errors import NotPossibleError
from jaximu.mistakes.titles import effect_title
from jaximu.model.effects import CATALOGUE, Effect
from jaximu.model.sensor import Imu
from jaximu.recordings.finding import Finding

_DECISIVE = 5.0
"""Log-likelihood of another recording by which one of several causes must fall behind to be dropped: 150 to 1."""


@dataclass(frozen=True)
class Extension:
    """What was taken into the model, the fit with it, and the recording and its base fit without defects cut out.

    complete: nothing is left unexplained. findings: the defects. beside: the shape that stands out beside causes which
    would explain all otherwise.
    """

    found: list[Found]
    state: State
    experiment: Experiment
    base: State
    complete: bool
    findings: list[Finding]
    beside: str = ""


@dataclass(frozen=True)
class Found:
    """A cause taken into the model: its name, its rivals' names, its p-value, statistic and degrees of freedom."""

    name: str
    rivals: tuple[str, ...]
    p_value: float
    statistic: float
    freedom: int

    @property
    def times(self) -> float:
        """Its strength in detection limits."""
        return strength(self.statistic, self.freedom)

    @property
    def weak(self) -> bool:
        """Whether it is below twice its detection limit."""
        return self.times < 2


def extend(
    experiment: Experiment, base: State, selection: Selection, level: float, taken: Sequence[Effect] = ()
) -> Extension:
    """Take causes into the model, refit and ask again, until nothing is missing or nothing more can be named.

    **Arguments:** `base`: a fit, whose effects stay in the model. `selection`: of what it lacks. `taken`: effects that
    another selection has chosen; they are in the model from the start, and stay.
    """
    entries: list[Found] = []
    state, poses = base, []
    causes = causes_of(base.evidence, [effect.name for effect in taken]) if selection.causes or taken else []
    if causes and not selection.explained:
        blocks = base.evidence.blocks
        entries = [_named(blocks, cause) for cause in causes]
        state = _refitted(experiment, base, (*base.effects, *taken), entries)
        selection = select(state.evidence, level / 100)
    chosen = len(entries)
    guessed = False  # a cause was taken in that did not explain the misfit
    while selection.causes:
        guessed |= not selection.complete
        if len(entries) - chosen + len(poses) + len(selection.causes) > most(base.evidence):
            break
        effects, blocks = list(state.effects), state.evidence.blocks
        coefficients, _ = state.evidence.most_likely([cause.block for cause in selection.causes])
        edges = np.cumsum([0, *(len(blocks[cause.block].sizes) for cause in selection.causes)])
        bumped, before = [], len(entries)
        for cause, a, b in zip(selection.causes, edges[:-1], edges[1:], strict=True):
            block = blocks[cause.block]
            if block.kind == "data":
                bumped.append(int(block.inner["pose"]))
                continue
            entries.append(_named(blocks, cause))
            effects.append(CATALOGUE[block.name].make(coefficients[a:b] * block.sizes, **block.inner))
        for pose in bumped:
            poses.append(_bumped(experiment, pose))
            experiment = experiment.without(pose)
        if bumped:
            base = experiment.fit(base.effects, base.imu, base.prior)
        try:
            state = _refitted(experiment, base, effects, entries, state.imu) if entries else base
        except NotPossibleError:  # what looks like these effects to first order is none of them
            entries = entries[:before]
            state = _refitted(experiment, base, state.effects, entries) if bumped else state
            break
        # what is found once all was explained is mostly chance, or a shape that the refit did not quite meet
        selection = select(state.evidence, level if guessed else level / 100)
    complete = selection.complete and not selection.causes
    return _doubted(Extension(entries, state, experiment, base, complete, poses), chosen, guessed, level)


def _refitted(
    experiment: Experiment, base: State, among: Iterable[Effect], entries: Sequence[Found], imu: Imu | None = None
) -> State:
    """Fit the effects of the base, and those among others that were found."""
    names = {effect.name for effect in base.effects} | {entry.name for entry in entries}
    return experiment.fit([effect for effect in among if effect.name in names], imu or base.imu, base.prior)


def _doubted(extension: Extension, chosen: int, guessed: bool, level: float) -> Extension:
    """Return an extension without causes that others make needless, or that only imitate what no catalogue has.

    The first, `chosen` otherwise, stay.
    """
    entries, state, complete = extension.found, extension.state, extension.complete
    experiment, base = extension.experiment, extension.base
    p_value, beside = experiment.beside(state) if complete and entries else (1.0, "")
    imitated = p_value < level * BESIDE  # by something that the causes look like
    complete, beside = complete and not imitated, beside if imitated else ""
    causes = causes_of(base.evidence, [entry.name for entry in entries[chosen:]])
    if any(one_curve(base.evidence, a.block, b.block) for a, b in combinations(causes, 2)):
        complete = False  # a curve of one input, imitated by two that are in the catalogue
        entries = [*entries[:chosen], max(entries[chosen:], key=lambda entry: entry.statistic)]
        state = _refitted(experiment, base, state.effects, entries)
    for entry in sorted(entries[chosen:], key=lambda entry: entry.statistic) if complete else ():
        others = [other for other in entries if other is not entry]
        if others and not state.differs(entry.name, level):
            without = _refitted(experiment, base, state.effects, others, state.imu)
            if select(without.evidence, level).explained:
                entries, state = others, without
    imitating = _imitating(base.evidence, entries[chosen:], causes) if guessed else []
    if imitating and len(entries) > 1:
        complete = False
        entries = [entry for entry in entries if entry not in imitating]
        state = _refitted(experiment, base, state.effects, entries)
    return replace(extension, found=entries, state=state, complete=complete, beside=beside)


def _imitating(evidence: Evidence, entries: Sequence[Found], causes: Sequence[SelectedCause]) -> list[Found]:
    """Return causes that are too weak beside the others: combinations of such imitate what no catalogue has."""
    blocks = {evidence.blocks[cause.block].name: cause.block for cause in causes}

    def stands(entry: Found) -> bool:
        others = [block for name, block in blocks.items() if name != entry.name]
        return entry.name in blocks and entry.times > strength_needed(evidence, blocks[entry.name], others)

    return [entry for entry in entries if not stands(entry)]


def settled(extension: Extension, held: Experiment) -> tuple[Extension, list[str]]:
    """Let another recording of the unit choose among causes that this one cannot tell apart, and say what it chose.

    Each rival takes its cause's place in a fit. Effects of the unit that predict the other recording worse than the
    best of them, or than none, are no rivals any more; those of a session may be gone or still there: they stay.
    """
    evidence, state, entries, notes = extension.base.evidence, extension.state, list(extension.found), []
    for index, entry in enumerate(extension.found):
        others = [other.name for other in entries if other is not entry]
        causes = {
            name: cause for name in entry.rivals if name in CATALOGUE and (cause := _beside(evidence, name, others))
        }
        device = {name: CATALOGUE[name].scope == "device" for name in (entry.name, *causes)}
        if not causes or not any(device.values()):
            continue
        states = {entry.name: state}
        for name, cause in list(causes.items()):
            try:
                states[name] = _fitted(extension, state, entry.name, cause)
            except NotPossibleError:  # it is no rival whose fit comes to nothing
                del causes[name]
        gains = {
            name: on_held_out(held, extension.base, states[name]).log_likelihood for name in states if device[name]
        }
        least = max(0.0, *gains.values()) - _DECISIVE
        kept = [name for name in states if gains.get(name, least) >= least]
        dropped = [name for name in states if name not in kept]
        if not dropped:
            continue
        chosen = entry
        if entry.name not in kept:
            if not kept:
                continue  # none of them is there in the other recording
            _, name = max((gains.get(name, 0.0), name) for name in kept)
            chosen, state = _named(evidence.blocks, causes[name]), states[name]
        stay = {*kept, *(name for name in entry.rivals if name not in causes)} - {chosen.name}
        entries[index] = replace(chosen, rivals=tuple(sorted(stay)))
        notes.append(f"the held-out recording speaks against {' and '.join(map(effect_title, dropped))}.")
    return replace(extension, found=entries, state=state), notes


def _beside(evidence: Evidence, name: str, others: Sequence[str]) -> SelectedCause | None:
    """Return an effect as a cause beside others, if it can be told from them."""
    causes = causes_of(evidence, [*others, name])
    return next((cause for cause in causes if evidence.blocks[cause.block].name == name), None)


def _fitted(extension: Extension, state: State, name: str, cause: SelectedCause) -> State:
    """Return a fit with a cause in the place of the effect of this name."""
    evidence = extension.base.evidence
    block = evidence.blocks[cause.block]
    coefficients = evidence.most_likely([cause.block])[0] * block.sizes
    others = [effect for effect in state.effects if effect.name != name]
    return extension.experiment.fit([*others, CATALOGUE[block.name].make(coefficients, **block.inner)], state.imu)


def _named(blocks: Sequence[EffectBlock], cause: SelectedCause) -> Found:
    name = blocks[cause.block].name
    rivals = tuple(sorted({blocks[k].name for k in cause.rivals} - {name}))
    return Found(name, rivals, cause.p_value, cause.statistic, cause.freedom)


def _bumped(experiment: Experiment, observation: int) -> Finding:
    text = f"{experiment.real.describe(observation)} does not fit the others: bumped, or not still. It was left out."
    return Finding("data.bumped_pose", (), text)
