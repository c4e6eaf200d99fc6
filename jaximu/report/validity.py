"""The report of a check: the sentence, what moved and what it does to the output, the errors before and after."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaximu.diagnosis import Validity
from jaximu.diagnosis.validity import Shift
from jaximu.estimation.rows import TIME
from jaximu.ground.quantities import change, number, probability, with_interval
from jaximu.report import figures
from jaximu.report.figures import legend, zero_line
from jaximu.report.html import Folder, write_page
from jaximu.report.tables import short_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["kind_words", "write_validity"]

_OUTPUTS = {
    "accelerometer": "accelerometer's output",
    "gyroscope": "gyroscope's output, its bias re-zeroed",
    "turns": "rotation over a turn",
}


def write_validity(validity: Validity, folder: Folder) -> Path:
    """Write pictures and `report.html`, whose path is returned. Raises `InputError` where they cannot be written."""
    name = Path(str(validity.data.get("file", "a recording"))).name
    moved = [shift.parameter.owner for shift in validity.moved if shift.parameter.owner in validity.output_errors]
    triad = (*moved, "accelerometer")[0]
    value = validity.output_errors.get(triad)
    shown = f"p {probability(validity.p_value)}"
    meaning = "probability of data at least this unusual if the old calibration is still valid (all tests together)"
    if value is not None:
        shown = with_interval(value.value, value.sigma, value.unit)
        meaning = f"largest error of the {triad} in this recording under the old calibration, 95 % interval"
    words = kind_words(validity)
    pictures = {"errors": partial(_errors, validity)}
    if any(_drawn(shift) for shift in validity.shifts):
        pictures = {"check": partial(_shifts, validity), **pictures}
    return write_page(
        folder,
        "validity",
        pictures,
        title=f"Is the calibration still valid for {name}?",
        lead=validity.headline(),
        number=shown,
        meaning=meaning,
        validity=validity,
        shifts=_shift_rows(validity),
        notes=validity.notes,
        errors=[(words[name], change(*sizes)) for name, sizes in validity.errors.items()],
        outputs=[
            (_OUTPUTS[key], with_interval(error.value, error.sigma, error.unit))
            for key, error in validity.output_errors.items()
        ],
    )


def kind_words(validity: Validity) -> dict[str, str]:
    """Return what each kind of error is called."""
    return {} if validity.experiment is None else {kind.name: kind.words for kind in validity.experiment.real.kinds}


def _shift_rows(validity: Validity) -> list[tuple]:
    """Return each parameter in words, its old value, its shift, that in the output, its significance; moved or not."""
    rows = []
    for shift in validity.shifts:
        cells = ("the recording does not determine it", "", "", "")
        if shift.comparable:
            p_value = probability(shift.p_value).removeprefix("= ") if shift.tested else "another after every power-on"
            cells = shift.amount, shift.output, f"{abs(shift.z):.1f}" if shift.tested else "", p_value
        rows.append((shift.words, number(shift.old, 6), *cells, bool(shift.moved)))
    return rows


def _drawn(shift: Shift) -> bool:
    return shift.in_si is not None and shift.tested


def _shifts(validity: Validity) -> Figure:
    """Gain and bias of both triads, in mm/s² and mrad/s."""
    figure = figures.new_figure(3.9)
    for panel, triad, unit in zip(
        figure.subplots(1, 2), ("accelerometer", "gyroscope"), ("mm/s²", "mrad/s"), strict=True
    ):
        shown = [shift for shift in validity.shifts if shift.parameter.owner == triad and _drawn(shift)][::-1]
        for row, shift in enumerate(shown):
            assert shift.in_si is not None and shift.sigma_in_si is not None
            colour = figures.FLAGGED if shift.moved else figures.BEFORE
            panel.errorbar(1e3 * shift.in_si, row, xerr=1.96e3 * shift.sigma_in_si, fmt="o", color=colour, markersize=5)
        panel.axvline(0.0, color="0.5", linewidth=0.8)
        figures.dressed(panel, triad, xlabel=f"shift [{unit}]")
        panel.set_yticks(range(len(shown)), [short_name(shift.parameter) for shift in shown], fontsize=8)
    return figure


def _errors(validity: Validity) -> Figure:
    figure = figures.new_figure(3.4)
    panels = figure.subplots(1, 2)
    experiment = validity.experiment
    if experiment is None:
        return _innovations(validity)
    real = experiment.real
    norms, turns = real.of_kind("gravity_norm"), real.of_kind("gravity_direction")
    times = real.covariates[TIME][norms], real.covariates[TIME][turns][::2]
    extended = [cause.title for cause in validity.causes if cause.scope != "parameter"]
    fresh = " with ".join(["fresh calibration", *([", ".join(extended)] if extended else [])])
    labels = (("old calibration", figures.FLAGGED), (fresh, figures.AFTER))
    for (label, colour), conditions in zip(labels, validity.conditions, strict=True):
        norm = 1e3 * conditions[norms]
        angle = np.degrees(np.linalg.norm(conditions[turns].reshape(-1, 2), axis=1))
        for panel, time, values in zip(panels, times, (norm, angle), strict=True):
            panel.plot(time, values, "o", color=colour, markersize=4, label=label)
    for panel, title, unit in zip(
        panels, ("gravity norm at rest", "gravity carried over a turn"), ("mm/s²", "°"), strict=True
    ):
        zero_line(panel)
        figures.dressed(panel, title, xlabel="time [s]", ylabel=f"error [{unit}]")
        legend(panel)
    return figure


def _innovations(validity: Validity) -> Figure:
    """Squared innovations of the filter in use over their expectation, update by update."""
    history = validity.history
    assert history is not None
    figure = figures.new_figure(3.0)
    panel = figure.subplots(1, 1)
    used = history.freedom > 0
    panel.plot(
        history.time[used], history.innovations[used] / history.freedom[used], "o", color=figures.FLAGGED, markersize=4
    )
    zero_line(panel, 1.0)
    figures.logarithmic(panel, "y")
    figures.dressed(panel, "innovations", xlabel="time [s]", ylabel="squared, over expected")
    return figure
