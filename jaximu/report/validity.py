"""The report of a check: the sentence, what moved and what it does to the output, the errors before and after."""

import shlex
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from jaximu.diagnosis import Validity
from jaximu.diagnosis.experiment import Experiment
from jaximu.diagnosis.validity import Shift
from jaximu.estimation.rows import TIME
from jaximu.ground.page import Page, Part, Picture, Statement, Table
from jaximu.ground.quantities import change, listed, number, probability, sentence, with_interval
from jaximu.ground.vectors import lengths_of
from jaximu.mistakes.titles import effect_title
from jaximu.report import figures
from jaximu.report.canvas import Figure
from jaximu.report.tables import p_text, short_name

_OUTPUTS = {
    "accelerometer": "accelerometer's output",
    "gyroscope": "gyroscope's output, its bias re-zeroed",
    "turns": "rotation over a turn",
}


def page_of(validity: Validity) -> Page:
    """Return what moved, what explains it, what using the old calibration would cost, and the errors under both."""
    log = str(validity.data.get("file", "LOG"))
    following = {
        "valid": "`jaximu compensate CALIBRATION LOG -o CORRECTED.csv` applies the calibration.",
        "session": "`jaximu compensate CALIBRATION LOG -o CORRECTED.csv` applies the calibration.",
        "shifted": "`jaximu calibrate LOG -o RESULTS` calibrates the unit again.",
        "effect": "`jaximu diagnose LOG -o RESULTS` finds the effect and writes the extended calibration.",
        "unexplained": "`jaximu diagnose LOG -o RESULTS` shows what does not fit.",
    }
    return Page(
        f"Is the calibration still valid for {Path(log).name}?",
        (f"{sentence(validity.verdict)}: {validity.headline()}",),
        *_number(validity),
        (*_shifts(validity), *_statements(validity), *_errors_table(validity)),
        rest=lambda: [_picture(validity)],
        notes=validity.notes,
        next=following[validity.verdict].replace("LOG", shlex.quote(log)),
    )


def _number(validity: Validity) -> tuple[str, str]:
    moved = [shift.parameter.owner for shift in validity.moved if shift.parameter.owner in validity.output_errors]
    triad = (*moved, "accelerometer")[0]
    error = validity.output_errors.get(triad)
    if error is None:
        meaning = "probability of data at least this unusual if the old calibration is still valid (all tests together)"
        return f"p {probability(validity.p_value)}", meaning
    meaning = f"largest error of the {triad} in this recording under the old calibration, 95 % interval"
    return with_interval(error.value, error.sigma, error.unit), meaning


def _shifts(validity: Validity) -> Iterator[Part]:
    if any(_drawn(shift) for shift in validity.shifts):
        yield Picture(
            "check",
            partial(_shifts_figure, validity),
            "Shift of every parameter with its 95 % interval",
            "Each parameter of a fresh calibration of this recording less the old one's, in the calibrated output "
            "(gains at 1 g and 1 rad/s), with the 95 % interval of the difference. Coloured: moved, with all "
            "parameters allowed for.",
        )
    statistic, freedom, p_value = validity.difference
    together = f"All {freedom} together: χ² {statistic:.1f}, p {probability(p_value)}." if freedom else ""
    moved = range(len(validity.moved))
    shifts = sorted(validity.shifts, key=lambda shift: (not shift.moved, -abs(shift.z) if shift.tested else 0.0))
    yield Table(
        ("parameter", "old", "shift ± 95 %", "in the output ± 95 %", "σ", "p-value, all allowed for"),
        [_shift_row(shift) for shift in shifts],
        together,
        moved,
        brief=max(3, len(moved)),
    )


def _shift_row(shift: Shift) -> tuple[str, ...]:
    known = shift.words, number(shift.old, 6)
    if not shift.comparable:
        return *known, "not determined here", "", "", ""
    if not shift.tested:
        return *known, shift.amount, shift.output, "", "differs after every power-on"
    return *known, shift.amount, shift.output, f"{abs(shift.z):.1f}", p_text(shift.p_value)


def _statements(validity: Validity) -> Iterator[Statement]:
    for cause in validity.causes:
        text = f"{cause.sentence}, p {probability(cause.p_value)}."
        if cause.rivals:
            text += f" This recording cannot distinguish it from {listed([*map(effect_title, cause.rivals)])}."
        yield Statement("What explains the difference", text)
    errors = [
        f"{_OUTPUTS[name]} {with_interval(error.value, error.sigma, error.unit)}"
        for name, error in validity.output_errors.items()
    ]
    if errors:
        text = "Largest difference between the outputs under this calibration and under a new one in the recording: "
        yield Statement("What using it would do", f"{text}{'; '.join(errors)} (95 %).")
    yield Statement("Gyroscope bias", validity.bias_words())
    if validity.nis is not None:
        text = f"Over {validity.data['updates']} updates they are {validity.nis:.2f} times what is expected."
        yield Statement("Squared innovations of the filter", text)


def _errors_table(validity: Validity) -> Iterator[Table]:
    if validity.experiment is not None:
        words = {kind.name: kind.words for kind in validity.experiment.real.kinds}
        counts = f"{validity.data['poses']} poses, {validity.data['turns']} turns"
        yield Table(
            (f"error, rms ({counts})", "old calibration → fresh calibration"),
            [(words[name], change(*sizes)) for name, sizes in validity.errors.items()],
        )


def _picture(validity: Validity) -> Picture:
    if validity.experiment is None:
        return Picture(
            "errors",
            partial(_innovations, validity),
            "Squared innovations of the filter over time",
            "How far each rest, and the end of each motion, is from what the calibrated unit should have read, squared "
            "and over what is expected: noise gives about 1.",
        )
    return Picture(
        "errors",
        partial(_errors, validity, validity.experiment),
        "Errors of poses and turns under the old calibration and a fresh one",
        "What the recording should bring to zero, under the old calibration and under a fresh one. Where both scatter "
        "alike, the old one is as good.",
    )


def _drawn(shift: Shift) -> bool:
    return shift.in_si is not None and shift.tested


def _shifts_figure(validity: Validity) -> Figure:
    """Gain and bias of both triads, in mm/s² and mrad/s."""
    figure, panels = figures.beside(2, 3.9)
    for panel, triad, unit in zip(panels, ("accelerometer", "gyroscope"), ("mm/s²", "mrad/s"), strict=True):
        shown = [shift for shift in validity.shifts if shift.parameter.owner == triad and _drawn(shift)][::-1]
        for row, shift in enumerate(shown):
            assert shift.in_si is not None and shift.sigma_in_si is not None
            panel.errorbar(
                1e3 * shift.in_si,
                row,
                xerr=1.96e3 * shift.sigma_in_si,
                fmt="o",
                color=figures.FLAGGED if shift.moved else figures.BEFORE,
                markersize=5,
            )
        panel.axvline(0.0, color="0.5", linewidth=0.8)
        figures.dressed(panel, triad, xlabel=f"shift [{unit}]")
        panel.set_yticks(range(len(shown)), [short_name(shift.parameter) for shift in shown], fontsize=8)
    return figure


def _errors(validity: Validity, experiment: Experiment) -> Figure:
    figure, panels = figures.beside(2, 3.4)
    real = experiment.real
    norms = real.of_kind("gravity_norm")
    turns = real.of_kind("gravity_direction")
    times = real.covariates[TIME][norms], real.covariates[TIME][turns][::2]
    extended = ", ".join(cause.title for cause in validity.causes if cause.scope != "parameter")
    fresh = "fresh calibration" + f" with {extended}" * bool(extended)
    labels = ("old calibration", figures.FLAGGED), (fresh, figures.AFTER)
    for (label, colour), conditions in zip(labels, validity.conditions, strict=True):
        angles = np.degrees(lengths_of(conditions[turns].reshape(-1, 2)))
        for panel, time, values in zip(panels, times, (1e3 * conditions[norms], angles), strict=True):
            panel.plot(time, values, "o", color=colour, markersize=4, label=label)
    titles = ("gravity norm at rest", "gravity carried over a turn")
    for panel, title, unit in zip(panels, titles, ("mm/s²", "°"), strict=True):
        figures.dressed(panel, title, 0.0, 1, xlabel="time [s]", ylabel=f"error [{unit}]")
    return figure


def _innovations(validity: Validity) -> Figure:
    history = validity.history
    assert history is not None
    figure, (panel,) = figures.beside(1, 3.0)
    used = history.freedom > 0
    panel.plot(
        history.time[used], history.innovations[used] / history.freedom[used], "o", color=figures.FLAGGED, markersize=4
    )
    figures.dressed(panel, "innovations", 1.0, xlabel="time [s]", ylabel="squared, over expected")
    figures.logarithmic(panel, "y")
    return figure
