"""The page of a diagnosis: what is wrong, how sure that is, what the extension gains, then the evidence."""

import shlex
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial

import numpy as np

from jaximu.diagnosis import Check, Diagnosis, Named, twin_of
from jaximu.diagnosis.experiment import Experiment, State
from jaximu.diagnosis.hidden import Hidden
from jaximu.diagnosis.improvement import Gain
from jaximu.diagnosis.learned import LearnedTerm
from jaximu.diagnosis.lines import MovingLine, spectrum_at_rest
from jaximu.diagnosis.noise import NoiseFinding
from jaximu.estimation.rows import TIME
from jaximu.estimation.uncertainty import describe
from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import rms
from jaximu.ground.page import Page, Part, Picture, Section, Statement, Table
from jaximu.ground.quantities import Z95, change, listed, number, probability, readable, sentence, size, with_interval
from jaximu.ground.units import SENSOR_UNITS
from jaximu.mistakes.titles import effect_title
from jaximu.model.effects import CATALOGUE, Effect
from jaximu.model.effects.learned import ZERO_CELSIUS
from jaximu.noise.deviations import deviation
from jaximu.recordings.finding import Finding
from jaximu.report import figures
from jaximu.report.canvas import Axes, Figure
from jaximu.report.figures import band, dressed, legend
from jaximu.report.tables import p_text
from jaximu.report.words import compensation, file_names

Twin = Callable[[], tuple[Experiment, State]]
"""The recording as the fitted model simulates it, and its fit; made when a picture first needs it."""


_MEASURED, _TWIN, _EXTENDED = figures.FLAGGED, figures.BEFORE, figures.AFTER
_SHOWN = 12
_PANELS = 3  # of axes with lines that move: more would fill pages
_AN_ERROR = 1e-3  # m/s², rad/s: sizes that errors have, whose unit the axes take
_DOUBT = 0.01
"""Probability below which chance is no longer offered as an explanation."""
_LITTLE = 0.95
"""Share of an error that must be left for a gain to be called little."""
_NOISY = 1.05
"""Scatter, in multiples of the noise, from which on it is reported."""
_SCOPES = {"device": "unit", "session": "recording", "fixture": "set-up"}


def page_of(diagnosis: Diagnosis) -> Page:
    """Return what is wrong, how sure that is, what it costs, what the extension gains, and what to do next."""

    @cache
    def twin() -> tuple[Experiment, State]:
        """Simulate the recording and fit it: its errors alone are shown."""
        simulated = twin_of(diagnosis)
        return simulated, simulated.fit(asking=())

    return Page(
        f"Diagnosis of {file_names(diagnosis.calibration.files)}: {diagnosis.verdict}",
        [*filter(None, (*_what_is_wrong(diagnosis), gained(diagnosis)))],
        *_number(diagnosis),
        [*_first(diagnosis, twin)],
        rest=partial(_rest, diagnosis, twin),
        notes=diagnosis.notes,
        next=_next(diagnosis),
    )


def _first(diagnosis: Diagnosis, twin: Twin) -> Iterator[Part]:
    yield Picture(
        "diagnosis",
        partial(_lead, diagnosis, twin),
        "Errors of the recording, its twin and the extended model",
        "Each dot is the error of one pose, turn or interval. Grey: the same recording simulated by the fitted model, "
        "noise included (its twin): errors scatter like this if nothing is missing. Right: the test of each effect, "
        "alone; beyond the dashed line an effect stands out from what chance produces in this many tests.",
    )
    yield from _certainty(diagnosis)
    yield from _cost(diagnosis)
    yield Section("The recording itself", [_mistake(diagnosis, finding) for finding in diagnosis.preflight])
    effects = [_effect_row(effect) for effect in diagnosis.effects]
    headers = ("effect", "adds up to", "coefficients ± 95 %", "evidence")
    yield Section("What is missing in the model", [Table(headers, effects)])
    if diagnosis.lines:
        picture = Picture(
            "lines",
            partial(_lines_figure, diagnosis),
            "Frequency over time, at rest",
            "Dark: power over the noise beside it, in windows at rest. Coloured: the lines that move, as followed; a "
            "line that reaches zero frequency or half the sample rate (the edges) goes on as its mirror image.",
        )
        yield Section("Lines that move", [picture])
    yield from _learned_part(diagnosis)
    yield Section("What the extension gains on data that was not fitted", [*_gains(diagnosis)])
    if diagnosis.verdict == "adequate":
        yield Section("What could still hide in this recording", [*_limits(diagnosis)])
    wrong = [check for check in diagnosis.checks if check.adjusted < _DOUBT]
    yield Section("What the fitted model gets wrong", [_checks_table(wrong)])


def _rest(diagnosis: Diagnosis, twin: Twin) -> Iterator[Part]:
    if diagnosis.options:
        yield Section("What would separate the causes", [*_options(diagnosis)])
    right = [check for check in diagnosis.checks if not check.adjusted < _DOUBT]
    yield Section("What the fitted model gets right", [_checks_table(right), *_evidence(diagnosis, twin)])
    if diagnosis.verdict != "adequate":
        yield Section("What could still hide in this recording", [*_limits(diagnosis)])
    reasons = diagnosis.not_observable
    rows = [
        (sentence(reason), "; ".join(effect_title(name) for name in reasons if reasons[name] == reason))
        for reason in dict.fromkeys(reasons.values())
    ]
    yield Section("Not observable here", [Table(("reason", "effects that it hides"), rows)])


def _what_is_wrong(diagnosis: Diagnosis) -> Iterator[str]:
    standing = _standing(diagnosis)
    if diagnosis.verdict == "adequate":
        yield _adequate(diagnosis)
    elif standing:
        yield f"No effect can be named from this recording. {standing[0].text}"
    elif diagnosis.verdict != "unexplained":
        sure = "Probably" if all(effect.weak for effect in diagnosis.effects) else "Found"
        yield f"{sure} {_causes(diagnosis)}."
    else:
        yield (
            "The model does not fit, and no known effect explains why."
            if diagnosis.p_value <= _DOUBT
            else "The model may not fit: of recordings that it describes completely, one in "
            f"{1 / diagnosis.p_value:.0f} looks like this, and no known effect explains it."
        )
        if diagnosis.shape is not None:
            yield f"It looks like this: {diagnosis.shape}."
        if diagnosis.learned is not None:
            yield f"The {diagnosis.learned.triad}'s misfit depends on {diagnosis.learned.covariate}."
        if diagnosis.effects:
            yield f"Part of it is {_causes(diagnosis)}."


def _standing(diagnosis: Diagnosis) -> list[Finding]:
    """Return the mistakes in the recording for which no effect can be named."""
    unexplained = diagnosis.verdict == "unexplained"
    return [finding for finding in diagnosis.preflight if finding.spoils or (finding.partial and unexplained)]


def _adequate(diagnosis: Diagnosis) -> str:
    sure = f"(p {probability(diagnosis.p_value)})"
    worst = min(diagnosis.checks, key=lambda check: check.adjusted, default=None)
    if worst is not None and worst.adjusted < _DOUBT:
        return (
            f"No effect shows {sure}, but the noise is not all that was assumed: {worst.text} "
            f"(p {probability(worst.adjusted)})."
        )
    if diagnosis.calibration.exact:
        words = _kind_words(diagnosis)
        unchecked = listed([words.get(name, name) for name in diagnosis.calibration.exact])
        return (
            f"No effect shows {sure}, but {unchecked} cannot be checked: there are as many parameters as conditions, "
            "and no degrees of freedom are left. Record more poses."
        )
    return f"The model fits: bias, scale and misalignment explain this recording to its noise {sure}."


def _causes(diagnosis: Diagnosis) -> str:
    return "; ".join(
        effect.sentence()
        + f", or {' or '.join(map(effect_title, effect.rivals))} (this recording cannot tell them apart)"
        * bool(effect.rivals)
        for effect in diagnosis.effects
    )


def gained(diagnosis: Diagnosis) -> str:
    """Say what modelling the causes, or else the smooth curve, gains on data that was not fitted."""
    gain = diagnosis.gain
    learned = diagnosis.learned
    effects = [cause.effect for cause in diagnosis.named]
    if gain is not None:
        subject = "them" if len(effects) > 1 else "it"
    elif learned is not None:
        gain, effects, subject = learned.gain, [learned.effect], "this as a smooth curve"
    else:
        return ""
    kind = gain.best_kind(*effects)
    (before, unit), (after, _) = gain.before.rms[kind], gain.after.rms[kind]
    data = f"the error on data not fitted ({gain.data})"
    if after >= before and gain.log_likelihood > 0:
        likelier = f"data not fitted ({gain.data}) more probable (log-likelihood {gain.log_likelihood:+.1f})"
        errors = change(before, after, unit).replace("→", "to")
        return f"Modelling {subject} makes {likelier}, although their error does not fall: from {errors}."
    if after >= before:
        return f"Modelling {subject} does not reduce {data}, {size(after, unit)}."
    little = "only " if after > _LITTLE * before else ""
    return f"Modelling {subject} cuts {data} {little}from {change(before, after, unit).replace('→', 'to')}."


def _number(diagnosis: Diagnosis) -> tuple[str, str]:
    gain, effects, subject = _extension(diagnosis)
    if gain is not None:
        kind = gain.best_kind(*effects)
        if gain.smaller(effects) or gain.log_likelihood <= 0:
            meaning = f"rms of {_kind_words(diagnosis)[kind]} on data not fitted ({gain.data}), without and with the "
            return gain.errors(kind), meaning + subject
        return (
            f"{gain.log_likelihood:+.1f}",
            f"log-likelihood that the {subject} gains on data not fitted ({gain.data})",
        )
    index = _shown_kind(diagnosis)
    shown = diagnosis.experiment.real.kinds[index]
    measured = rms(diagnosis.experiment.errors(diagnosis.base)[index])
    meaning = ": no more than noise, drift and handling leave"
    if diagnosis.verdict != "adequate":
        times = np.sqrt(diagnosis.checks[np.unique(diagnosis.experiment.real.kind).tolist().index(index)].statistic)
        meaning = f", {number(times, 2)} × what noise, drift and handling leave"
    return size(measured, shown.unit, 2), f"rms of {shown.words}{meaning}"


def _next(diagnosis: Diagnosis) -> str:
    files = [*map(shlex.quote, diagnosis.calibration.files)] or ["LOG"]
    repairs = dict.fromkeys(finding.repair for finding in _standing(diagnosis) if finding.repair)
    by_hand = diagnosis.experiment.data.by_hand  # else the command has more arguments
    if repairs and by_hand:
        command = f"`jaximu diagnose {' '.join([*files, *repairs])} -o RESULTS`"
        return f"{diagnosis.suggestion} {command} repeats the diagnosis."
    if diagnosis.suggestion:
        together = f"`jaximu diagnose {' '.join(files)} NEW_LOG -o RESULTS` diagnoses {with_another(diagnosis)}."
        recorded = by_hand and " record" in diagnosis.suggestion and not _standing(diagnosis)
        return diagnosis.suggestion + f" {together}" * recorded
    what = "extended calibration" if diagnosis.extended.effects else "calibration"
    return compensation(diagnosis.calibration.files, f"applies the {what}")


def with_another(diagnosis: Diagnosis) -> str:
    """Return how many recordings they are with a new one, in words."""
    count = len(diagnosis.calibration.segmentations)
    return f"{'both' if count == 1 else f'all {count + 1}'} recordings together"


def _mistake(diagnosis: Diagnosis, finding: Finding) -> Statement:
    texts = [] if finding in _standing(diagnosis)[:1] and diagnosis.verdict != "adequate" else [sentence(finding.text)]
    if finding.rows:
        texts.append(f"Row{'s' * (len(finding.rows) > 1)} {', '.join(map(str, finding.rows))}.")
    if finding.repair:
        texts.append(f"Repair: `{finding.repair}`.")
    if finding.rivals:
        texts.append(f"This recording cannot distinguish it from {listed([*map(effect_title, finding.rivals)], 'or')}.")
    return Statement(sentence(effect_title(finding.name)), " ".join(texts) or "See above.", caution=True)


def _effect_row(effect: Named | NoiseFinding) -> tuple[str, str, str, str]:
    evidence = effect.evidence + " (weak)" * effect.weak
    numbers = "\n".join(effect.numbers())
    if isinstance(effect, NoiseFinding):
        about = "the noise model is wrong by these factors; it was corrected before anything else was tested"
        return f"{effect_title(effect.name)}\n{about}", "", numbers, evidence
    about = f"{effect.effect.formula}; belongs to the {_SCOPES[effect.scope]} {effect.file}".rstrip()
    return f"{effect.effect.title}\n{about}", f"{effect.size()}\n({effect.triad})", numbers, evidence


def _lines_figure(diagnosis: Diagnosis) -> Figure:
    parts = diagnosis.calibration.segmentations
    lines: dict[tuple[int, str, int], list[MovingLine]] = {}
    for one in diagnosis.lines:
        lines.setdefault((one.recording, one.triad, one.line.axis), []).append(one)
    figure, grid = figures.stacked(min(len(lines), _PANELS), 2.4, 0.6, across="time (s)")
    for axes, (key, mine) in zip(grid, lines.items(), strict=False):
        times, power = spectrum_at_rest(parts[key[0]], *key[1:])
        axes.pcolormesh(
            times,
            np.linspace(0, mine[0].line.rate / 2, power.shape[1]),
            np.log10(power.T),
            cmap="Greys",
            vmin=0.0,
            vmax=2.0,
            rasterized=True,
        )
        for index, one in enumerate(mine):
            axes.plot(
                one.line.times,
                one.line.recorded,
                color=figures.PALETTE[index % len(figures.PALETTE)],
                linewidth=1.2,
                alpha=0.8,
            )
        files = [source.path for source in parts[key[0]].recording.sources]
        title = f"{mine[0].axis} in {file_names(files)}" if len(parts) > 1 else mine[0].axis
        dressed(axes, title, ylabel="frequency (Hz)")
    return figure


def _learned_part(diagnosis: Diagnosis) -> Iterator[Section]:
    for index, curve in enumerate(diagnosis.curves, 1):
        name, drift = curve.effect.name, bool(diagnosis.drifts)
        where = f" in recording {curve.effect.recording}" if curve.effect.recording else ""
        yield Section(
            f"How the {curve.triad}'s bias drifts{where}" if drift else "What the misfit depends on",
            [
                f"The {curve.triad}'s bias drifts{where} by more than its noise. The extended model has the drift as a "
                f"curve ({name}). It belongs to this recording, and `jaximu compensate` leaves it alone."
                if drift
                else f"No known effect explains it, but the {curve.triad}'s misfit depends on {curve.covariate}: a "
                f"smooth curve ({name}) follows it, and the extended calibration contains the curve.",
                Picture(
                    "learned" if index == 1 else f"learned_{index}",
                    partial(_learned, curve),
                    "The smooth curve that the misfit follows, with its band",
                    f"What the {curve.triad} puts out by {curve.covariate}, learned from the recording without a "
                    "cause, with its 95 % band; a constant is part of the bias. Beyond its ends the extended "
                    "calibration keeps the curve constant.",
                ),
            ],
        )


def _gains(diagnosis: Diagnosis) -> Iterator[Table]:
    if diagnosis.gain is not None:
        yield _gain_table(diagnosis, "extended model", diagnosis.gain)
    if diagnosis.learned is not None:
        yield _gain_table(diagnosis, "with the smooth curve", diagnosis.learned.gain)


def _gain_table(diagnosis: Diagnosis, what: str, gain: Gain) -> Table:
    words = _kind_words(diagnosis)
    caption = ""
    for way in (gain, gain.otherwise):
        if way is not None:
            before, after = (part.chi_squared / part.count for part in (way.before, way.after))
            caption += f"{'On' if caption else 'Measured on'} {way.data}: "
            caption += f"χ² per condition {before:.2f} → {after:.2f}, log-likelihood {way.log_likelihood:+.1f}. "
    return Table(
        ("error, rms", f"base model → {what}"),
        [(words[kind], gain.errors(kind)) for kind in gain.before.rms],
        f"{caption}A χ² of 1 is noise alone.",
    )


def _certainty(diagnosis: Diagnosis) -> Iterator[Statement]:
    verdict = "This is not chance"
    if diagnosis.p_value > _DOUBT:
        verdict = "This is consistent with noise" if diagnosis.verdict == "adequate" else "This may be chance"
    text = (
        f"{verdict}: if the model were complete, data at least this unusual would have the probability p "
        f"{probability(diagnosis.p_value)} (all tests together)."
    )
    if diagnosis.unit > _NOISY:
        text += f" Remaining scatter: {diagnosis.unit:.2f} × noise. The tests allow for it."
    yield Statement("How sure", text)
    for effect in diagnosis.effects:
        if effect.weak:
            text = f"{sentence(effect_title(effect.name))}: an effect outside the catalogue may take its name."
            yield Statement("The detection is weak", text, caution=True)


def _cost(diagnosis: Diagnosis) -> Iterator[Statement]:
    outputs = [
        f"{effect.effect.title} changes the {effect.triad}'s output by up to {effect.size()}"
        for effect in diagnosis.named
    ]
    learned = diagnosis.learned
    if learned is not None:
        peak = np.unravel_index(np.abs(learned.y).argmax(), learned.y.shape)
        swing = with_interval(abs(learned.y[peak]), learned.half_width[peak] / Z95, SENSOR_UNITS[learned.triad])
        outputs.append(f"{learned.covariate} changes the {learned.triad}'s output by up to {swing} (95 %)")
    if outputs:
        yield Statement("What it costs without the extension", f"In this recording, {'; '.join(outputs)}.")
    elif diagnosis.verdict == "unexplained":
        cause = "A mistake in the recording" if _standing(diagnosis) else "An unmodelled effect"
        yield Statement(
            "What it costs", f"{cause} may bias the parameters by more than their intervals show.", caution=True
        )


def _limits(diagnosis: Diagnosis) -> Iterator[Part]:
    yield (
        "An effect could be there unnoticed up to its detection limit: the size (coefficients in a random direction) "
        "that its test finds with 90 % power. It would shift the calibrated numbers by as much as the last column "
        "says, in their standard deviations (σ): the intervals do not include that; `jaximu accept` and `jaximu "
        "consequences` do, with --diagnosis."
    )
    yield Table(
        ("effect", "detection limit", "compared with a plausible size", "would shift most"),
        [
            (
                effect_title(cause.name),
                size(cause.limit, cause.unit, 2),
                f"{number(_in_plausible_sizes(diagnosis, cause.name, cause.limit), 2)} ×",
                _shift_words(diagnosis, cause),
            )
            for cause in diagnosis.hidden
        ],
        brief=6,
    )
    weakest = [
        f"{effect_title(cause.name)} {cause.combination}, "
        + (
            "which no test sees"
            if np.isinf(cause.weakest[1])
            else f"seen from {size(cause.weakest[1], cause.unit, 2)} on"
        )
        for cause in diagnosis.hidden
        if cause.combination
    ]
    if weakest:
        yield Statement("What a recording like this hardly shows", f"{sentence('; '.join(weakest))}.")


def _shift_words(diagnosis: Diagnosis, cause: Hidden) -> str:
    name, sigmas = cause.worst
    if not name:
        return "nothing"
    names = {str(known): known for known in diagnosis.extended.names}
    return f"{describe(names[name], diagnosis.extended.model)}, {number(sigmas, 2)} σ"


def _in_plausible_sizes(diagnosis: Diagnosis, name: str, limit: float) -> float:
    kind = CATALOGUE[name]
    imu = diagnosis.base.imu
    triad = imu.triads().get(kind.owner, imu.accelerometer)
    return limit / (kind.typical * (float(np.mean(triad.scales)) if kind.unit.startswith("output") else 1.0))


def _options(diagnosis: Diagnosis) -> Iterator[Part]:
    yield (
        "Each recording is simulated with this unit and its noise; the power is that of distinguishing the causes (at "
        "the 1 % level), or of finding the only one."
    )
    first = diagnosis.options[0]
    lines = [("this recording", first.before), *((option.text, option.powers) for option in diagnosis.options)]
    yield Table(
        ("do this", *map(effect_title, first.powers)),
        [(text, *(f"{100 * power:.0f} %" for power in powers.values())) for text, powers in lines],
    )


def _checks_table(checks: list[Check]) -> Table:
    return Table(
        ("check of the base model", "statistic", "p-value"),
        [
            (*check.text.rpartition(": ")[::2], p_text(check.adjusted))
            for check in sorted(checks, key=lambda check: check.adjusted)
        ],
        "p-values allow for all checks together: below 0.01 the model or its noise is wrong there; above, chance does "
        "as much.",
        brief=6,
    )


def _evidence(diagnosis: Diagnosis, twin: Twin) -> Iterator[Picture]:
    yield Picture(
        "dependence",
        partial(_dependence, diagnosis, twin),
        "Errors against time, temperature and orientation",
        "The base model's errors against what they may depend on; grey is the twin. A shape here that grey lacks is "
        "model error; scatter alike in both is noise.",
    )
    if diagnosis.experiment.still_parts("gyroscope")[0]:
        yield Picture(
            "noise",
            partial(_noise, diagnosis, twin),
            "Spectrum and Allan deviation at rest, measured and simulated",
            "What the sensors put out while the unit was still, measured and twin, mean of the axes. Above: spectrum, "
            "mean of all poses. Below: Allan deviation over the longest still part, with 95 % intervals. Where they "
            "differ, the noise model does not fit this recording.",
        )


def _kind_words(diagnosis: Diagnosis) -> dict[str, str]:
    return {kind.name: kind.words for kind in diagnosis.experiment.real.kinds}


def _extension(diagnosis: Diagnosis) -> tuple[Gain | None, Sequence[Effect], str]:
    """Return what a smooth curve gains on data not fitted, or else the named effects; these; and what it is called."""
    if diagnosis.learned is not None:
        return diagnosis.learned.gain, [diagnosis.learned.effect], "curve"
    return diagnosis.gain, [cause.effect for cause in diagnosis.named], "extension"


def _shown_kind(diagnosis: Diagnosis) -> int:
    gain, effects, _ = _extension(diagnosis)
    if effects and gain is not None:
        return list(_kind_words(diagnosis)).index(gain.best_kind(*effects))
    present = np.unique(diagnosis.experiment.real.kind)
    first = diagnosis.checks[: len(present)]
    return int(present[first.index(min(first, key=lambda check: check.p_value))])


def _lead(diagnosis: Diagnosis, twin: Twin) -> Figure:
    simulated, refit = twin()
    figure, (left, right) = figures.beside(2, 4.3, width_ratios=[1.35, 1])
    kind = _shown_kind(diagnosis)
    experiment = diagnosis.experiment
    shown = experiment.real.kinds[kind]
    factor, unit = readable(shown.unit, _AN_ERROR)
    series = [("twin", _TWIN, simulated, refit), ("measured, base model", _MEASURED, experiment, diagnosis.base)]
    if diagnosis.extended.effects:
        series.append(("measured, extended model", _EXTENDED, experiment, diagnosis.extended))
    for label, colour, source, state in series:
        time = source.real.dependences(kind)[TIME]  # a twin need not have as many poses and turns
        left.plot(time, factor * source.errors(state)[kind], "o", color=colour, markersize=4, label=label)
    dressed(left, shown.words, 0.0, 1, xlabel="time [s]", ylabel=f"error [{unit}]")
    _ranking(right, diagnosis)
    return figure


def _ranking(panel: Axes, diagnosis: Diagnosis) -> None:
    evidence = diagnosis.base.evidence
    scores = evidence.scores()
    best = {}
    for k, block in enumerate(evidence.blocks):
        if block.kind == "effect" and scores.freedom[k]:
            best[block.name] = min(best.get(block.name, 1.0), max(float(scores.p_value[k]), 1e-300))
    named = {effect.name for effect in diagnosis.effects}
    # many may reach the end of the axis: what was named comes first among them
    order = sorted(best, key=lambda name: (best[name], name not in named))[:_SHOWN][::-1]
    rivals = {name for effect in diagnosis.effects for name in effect.rivals}
    panel.barh(
        [effect_title(name).replace(" (", "\n(") for name in order],
        [-np.log10(best[name]) for name in order],
        color=[_EXTENDED if n in named else ("#56B4E9" if n in rivals else "#C4C4C4") for n in order],
    )
    panel.axvline(-np.log10(evidence.critical(0.05)), color="black", linestyle="--", linewidth=1)
    dressed(panel, "each effect, tested alone", xlabel="evidence: −log₁₀ of the p-value")
    panel.tick_params(axis="y", labelsize=7)


def _dependence(diagnosis: Diagnosis, twin: Twin) -> Figure:
    real, (simulation, refit) = diagnosis.experiment.real, twin()
    rows = [int(kind) for kind in np.unique(real.kind)]
    covariates, shadow = ({row: source.dependences(row) for row in rows} for source in (real, simulation.real))
    figure = figures.new_figure(2.1 * len(rows) + 0.4)
    panels = figure.subplots(len(rows), max(len(table) for table in covariates.values()), squeeze=False, sharey="row")
    measured = diagnosis.experiment.errors(diagnosis.base)
    simulated = simulation.errors(refit)
    for line, row in zip(panels, rows, strict=True):
        kind = real.kinds[row]
        factor, unit = readable(kind.unit, _AN_ERROR)
        line[0].set_ylabel(f"{kind.words}\n[{unit}]", fontsize=8)
        for panel in line[len(covariates[row]) :]:
            panel.remove()
        for panel, (name, values) in zip(line, covariates[row].items(), strict=False):
            if name in shadow[row]:
                panel.plot(shadow[row][name], factor * simulated[row], ".", color=_TWIN, markersize=4)
            panel.plot(values, factor * measured[row], ".", color=_MEASURED, markersize=5)
            dressed(panel)
            panel.set_xlabel(name, fontsize=8)
            panel.locator_params(nbins=4)
    return figure


def _learned(learned: LearnedTerm) -> Figure:
    unit, factor, shift = learned.effect.covariate_unit, 1.0, 0.0
    if learned.effect.words == "temperature":
        unit, shift = "°C", ZERO_CELSIUS
    elif unit == "rad/s":
        unit, factor = "°/s", np.degrees(1.0)
    scale, label = readable(SENSOR_UNITS[learned.triad], _AN_ERROR)
    figure, panels = figures.beside(3, 2.8, sharey=True)
    for axis, panel in enumerate(panels):
        value, half = (scale * values[:, axis] for values in (learned.y, learned.half_width))
        band(panel, factor * learned.x - shift, value, half, _EXTENDED)
        dressed(panel, f"{learned.triad} {'xyz'[axis]}", 0.0, xlabel=f"{learned.covariate} [{unit.replace('^2', '²')}]")
        panel.xaxis.label.set_size(8)
    panels[0].set_ylabel(f"[{label}]")
    return figure


def _noise(diagnosis: Diagnosis, twin: Twin) -> Figure:
    figure = figures.new_figure(5.8)
    panels = figure.subplots(2, 2)
    triads = (("accelerometer", "m/s²"), ("gyroscope", "rad/s"))
    for (spectrum, allan), (name, unit) in zip(panels.T, triads, strict=True):
        for label, colour, experiment in (("measured", _MEASURED, diagnosis.experiment), ("twin", _TWIN, twin()[0])):
            frequency, density = _density(experiment, name)
            spectrum.plot(frequency, np.sqrt(density), color=colour, linewidth=1, label=label)
            tau, value, low, high = _allan(experiment, name)
            allan.plot(tau, value, "o-", color=colour, linewidth=1, markersize=4, label=label)
            allan.fill_between(tau, low, high, color=colour, alpha=0.2, linewidth=0)
        for panel in (spectrum, allan):
            figures.logarithmic(panel)
            legend(panel)
        middle = np.sqrt(np.median(density))
        low, high = spectrum.get_ylim()
        dressed(
            spectrum,
            name,
            xlabel="frequency [Hz]",
            ylabel=f"density [{unit}/√Hz]",
            ylim=(min(low, middle / 3), max(high, middle * 3)),
        )
        dressed(allan, xlabel="averaging time [s]", ylabel=f"Allan deviation [{unit}]")
    return figure


def _allan(experiment: Experiment, name: str) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Averaging times (k,), s, Allan deviation of a triad over its longest pose, root mean square of axes; interval."""
    parts, rate = experiment.still_parts(name)
    curve = deviation(max(parts, key=len).T, rate)
    value = rms(curve.value, axis=0)
    # three axes, taken as independent and alike, know their mean √3 times as well as each its own
    known = (curve.value > 0).all(axis=0)  # output may not change at all
    low, high = (
        value[known] * np.exp(np.log(edge[:, known] / curve.value[:, known]).mean(axis=0) / np.sqrt(3))
        for edge in (curve.low, curve.high)
    )
    return curve.tau[known], value[known], low, high


def _density(experiment: Experiment, name: str) -> tuple[FloatArray, FloatArray]:
    """Two-sided density (k,) of a triad at rest, mean of axes and poses, and its frequencies, Hz."""
    segments, rate = experiment.still_parts(name)
    length = max(16, int(np.quantile([len(segment) for segment in segments], 0.25)))
    whole = np.stack(
        [segment[:length] - segment[:length].mean(axis=0) for segment in segments if len(segment) >= length]
    )
    power = (np.abs(np.fft.rfft(whole, axis=1)) ** 2).mean(axis=(0, 2)) / (length * rate)
    return np.asarray(np.fft.rfftfreq(length, 1 / rate)[1:-1], float), power[1:-1]
