"""The report of a diagnosis: one sentence, one picture, one number, then the evidence."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaximu.diagnosis import Diagnosis, twin_of
from jaximu.diagnosis.experiment import Experiment, State
from jaximu.diagnosis.learned import LearnedTerm
from jaximu.estimation.rows import TIME
from jaximu.ground.array_types import FloatArray
from jaximu.ground.quantities import probability, readable, size
from jaximu.ground.summary import sentence
from jaximu.ground.units import SENSOR_UNITS
from jaximu.mistakes.titles import effect_title
from jaximu.model.effects import CATALOGUE
from jaximu.model.effects.learned import ZERO_CELSIUS
from jaximu.noise.deviations import deviation
from jaximu.report import figures
from jaximu.report.figures import band, dressed, legend, zero_line
from jaximu.report.html import Folder, TextRows, write_page

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["limit_rows", "write_diagnosis"]

_MEASURED, _TWIN, _EXTENDED = figures.FLAGGED, figures.BEFORE, figures.AFTER
_SHOWN = 12
_AN_ERROR = 1e-3  # m/s², rad/s: sizes that errors have, whose unit the axes take


def write_diagnosis(diagnosis: Diagnosis, folder: Folder) -> Path:
    """Write pictures and `report.html`, whose path is returned. Raises `InputError` where they cannot be written."""
    twin = twin_of(diagnosis)
    copied = twin.fit(asking=())  # its errors alone are shown
    drawn = {
        name: partial(figure, diagnosis, twin, copied)
        for name, figure in (("diagnosis", _lead), ("dependence", _dependence))
    }
    if diagnosis.experiment.still_parts("gyroscope")[0]:
        drawn["noise"] = partial(_noise, diagnosis, twin)
    gain, learned = diagnosis.gain, diagnosis.learned
    if learned is not None:
        drawn["learned"], gain = partial(_learned, learned), learned.gain
    words = {kind.name: kind.words for kind in diagnosis.experiment.real.kinds}
    index = _shown_kind(diagnosis)
    shown = diagnosis.experiment.real.kinds[index]
    measured, simulated = (
        size(np.sqrt(np.mean(np.square(errors[index]))), shown.unit, 2)
        for errors in (diagnosis.experiment.errors(diagnosis.base), twin.errors(copied))
    )
    number, meaning = measured, f"rms of {shown.words}: no more than noise, drift and handling leave"
    if diagnosis.verdict != "adequate":
        meaning = f"rms of {shown.words}; a simulation of this model and its noise leaves {simulated}"
    if gain is not None:
        kind = gain.best_kind(diagnosis.named[0].effect if learned is None else learned.effect)
        number = gain.errors(kind)
        meaning = f"rms of {words[kind]} on data that was not fitted ({gain.data}), without and with the extension"
    return write_page(
        folder,
        "diagnosis",
        drawn,
        title=f"Diagnosis of {diagnosis.files}",
        lead=diagnosis.headline(),
        number=number,
        meaning=meaning,
        diagnosis=diagnosis,
        notes=diagnosis.notes,
        effects=[(effect, CATALOGUE.get(effect.name), effect.numbers()) for effect in diagnosis.effects],
        gain=gain,
        gains=[] if gain is None else [(words[kind], gain.errors(kind)) for kind in gain.before.rms],
        options=_option_rows(diagnosis),
        limits=limit_rows(diagnosis),
        checks=[
            (check.text, probability(check.adjusted).removeprefix("= "), bool(check.adjusted < 0.01))
            for check in diagnosis.checks
        ],
        not_observable=_by_reason(diagnosis.not_observable),
    )


def limit_rows(diagnosis: Diagnosis) -> TextRows:
    """Return each effect with the size up to which it could be there unnoticed."""
    return [(effect_title(name), size(*limit, 2)) for name, limit in sorted(diagnosis.detection_limits.items())]


def _by_reason(reasons: Mapping[str, str]) -> TextRows:
    """Return each reason once, with the effects that it hides."""
    return [
        (sentence(reason), "; ".join(effect_title(name) for name in reasons if reasons[name] == reason))
        for reason in dict.fromkeys(reasons.values())
    ]


def _option_rows(diagnosis: Diagnosis) -> list[list[str]]:
    """Return the names of the causes, then of this recording and of each option the powers to tell them apart."""
    if not diagnosis.options:
        return []
    first = diagnosis.options[0]
    lines = [("this recording", first.before), *((option.text, option.powers) for option in diagnosis.options)]
    return [
        [effect_title(name) for name in first.powers],
        *([text, *(f"{100 * power:.0f} %" for power in powers.values())] for text, powers in lines),
    ]


def _shown_kind(diagnosis: Diagnosis) -> int:
    """The kind of error that the lead is about, as a place among the experiment's."""
    kinds = [kind.name for kind in diagnosis.experiment.real.kinds]
    if diagnosis.learned is not None:
        return kinds.index(diagnosis.learned.gain.best_kind(diagnosis.learned.effect))
    if diagnosis.named and diagnosis.gain is not None:
        return kinds.index(diagnosis.gain.best_kind(diagnosis.named[0].effect))
    present = np.unique(diagnosis.experiment.real.kind)
    first = diagnosis.checks[: len(present)]
    return int(present[first.index(min(first, key=lambda check: check.p_value))])


def _lead(diagnosis: Diagnosis, twin: Experiment, copied: State) -> Figure:
    figure = figures.new_figure(4.3)
    left, right = figure.subplots(1, 2, width_ratios=[1.35, 1])
    kind = _shown_kind(diagnosis)
    experiment = diagnosis.experiment
    shown = experiment.real.kinds[kind]
    factor, unit = readable(shown.unit, _AN_ERROR)
    series = [("twin", _TWIN, twin, copied), ("measured, base model", _MEASURED, experiment, diagnosis.base)]
    if diagnosis.extended.effects:
        series.append(("measured, extended model", _EXTENDED, experiment, diagnosis.extended))
    for label, colour, source, state in series:
        time = source.real.dependences(kind)[TIME]  # a twin need not have as many poses and turns
        left.plot(time, factor * source.errors(state)[kind], "o", color=colour, markersize=4, label=label)
    zero_line(left)
    dressed(left, shown.words, xlabel="time [s]", ylabel=f"error [{unit}]")
    legend(left)
    _ranking(right, diagnosis)
    return figure


def _ranking(panel: Axes, diagnosis: Diagnosis) -> None:
    evidence = diagnosis.base.evidence
    scores = evidence.scores()
    best: dict[str, float] = {}
    for k, block in enumerate(evidence.blocks):
        if block.kind == "effect" and scores.freedom[k]:
            best[block.name] = min(best.get(block.name, 1.0), max(float(scores.p_value[k]), 1e-300))
    named = {effect.name for effect in diagnosis.effects}
    # many may reach the end of the axis: what was named comes first among them
    order = sorted(best, key=lambda name: (best[name], name not in named))[:_SHOWN][::-1]
    rivals = {name for effect in diagnosis.effects for name in effect.rivals}
    colours = [_EXTENDED if n in named else ("#56B4E9" if n in rivals else "#C4C4C4") for n in order]
    labels = [effect_title(name).replace(" (", "\n(") for name in order]
    panel.barh(labels, [-np.log10(best[name]) for name in order], color=colours)
    panel.axvline(-np.log10(evidence.critical(0.05)), color="black", linestyle="--", linewidth=1)
    dressed(panel, "each effect, tested alone", xlabel="evidence: −log₁₀ of the p-value")
    panel.tick_params(axis="y", labelsize=7)


def _dependence(diagnosis: Diagnosis, twin: Experiment, copied: State) -> Figure:
    real = diagnosis.experiment.real
    rows = [int(kind) for kind in np.unique(real.kind)]
    covariates, shadow = ({row: source.dependences(row) for row in rows} for source in (real, twin.real))
    figure = figures.new_figure(2.1 * len(rows) + 0.4)
    panels = figure.subplots(len(rows), max(len(table) for table in covariates.values()), squeeze=False, sharey="row")
    measured, simulated = diagnosis.experiment.errors(diagnosis.base), twin.errors(copied)
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
    size, label = readable(SENSOR_UNITS[learned.triad], _AN_ERROR)
    figure = figures.new_figure(2.8)
    x = factor * learned.x - shift
    panels = figure.subplots(1, 3, sharey=True)
    for axis, panel in enumerate(panels):
        band(panel, x, size * learned.y[:, axis], size * learned.half_width[:, axis], _EXTENDED)
        zero_line(panel)
        dressed(panel, f"{learned.triad} {'xyz'[axis]}", xlabel=f"{learned.covariate} [{unit.replace('^2', '²')}]")
        panel.xaxis.label.set_size(8)
    panels[0].set_ylabel(f"[{label}]")
    return figure


def _noise(diagnosis: Diagnosis, twin: Experiment) -> Figure:
    figure = figures.new_figure(5.8)
    panels = figure.subplots(2, 2)
    for column, (name, unit) in enumerate((("accelerometer", "m/s²"), ("gyroscope", "rad/s"))):
        spectrum, allan = panels[:, column]
        for label, colour, experiment in (("measured", _MEASURED, diagnosis.experiment), ("twin", _TWIN, twin)):
            frequency, density = _density(experiment, name)
            spectrum.plot(frequency, np.sqrt(density), color=colour, linewidth=1, label=label)
            tau, value, low, high = _allan(experiment, name)
            allan.plot(tau, value, "o-", color=colour, linewidth=1, markersize=4, label=label)
            allan.fill_between(tau, low, high, color=colour, alpha=0.2, linewidth=0)
        middle = np.sqrt(np.median(density))
        low, high = spectrum.get_ylim()
        for panel in (spectrum, allan):
            figures.logarithmic(panel)
            legend(panel)
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
    longest = max(parts, key=len)
    curve = deviation(longest.T, rate)
    value = np.sqrt(np.mean(curve.value**2, axis=0))
    # three axes, taken as independent and alike, know their mean √3 times as well as each its own
    known = (curve.value > 0).all(axis=0)  # output may not change at all
    low, high = (
        value[known] * np.exp(np.mean(np.log(edge[:, known] / curve.value[:, known]), axis=0) / np.sqrt(3))
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
    power = np.mean(np.abs(np.fft.rfft(whole, axis=1)) ** 2, axis=(0, 2)) / (length * rate)
    return np.asarray(np.fft.rfftfreq(length, 1 / rate)[1:-1], np.float64), power[1:-1]
