"""The report of a check: the sentence, what moved and what it does to the output, the errors before and after."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jaximu.diagnosis import Validity
from jaximu.effects import effect_title
from jaximu.quantities import change, number, probability, size, with_interval
from jaximu.report import figures
from jaximu.report.html import Picture, template, write_page
from jaximu.report.tables import short_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["write_validity"]

FloatArray = NDArray[np.float64]
_OLD, _FRESH, _PLAIN = "#D55E00", "#0072B2", "#8A8A8A"
_OUTPUTS = {"accelerometer": "accelerometer's output", "gyroscope": "gyroscope's output, its bias re-zeroed",
            "turns": "rotation over a turn"}  # fmt: skip


def write_validity(validity: Validity, folder: str | os.PathLike[str]) -> Path:
    """Write `report.html` and its pictures as PNGs into `folder`; all are drawn before anything is written.

    **Returns:** the path of `report.html`. Raises `InputError` where the folder cannot be made or written to.
    """
    pictures = [
        Picture(
            "check", _shifts(validity), "Shift of every parameter with its 95 % interval",
            "Each parameter of a fresh calibration of this recording less the old one's, in the calibrated output "
            "(gains at 1 g and 1 rad/s), with the 95 % interval of the difference. Coloured: moved, with all "
            "parameters allowed for.",
        ),
        Picture(
            "errors", _errors(validity), "Errors of poses and turns under the old calibration and a fresh one",
            "What the recording should bring to zero, under the old calibration and under a fresh one. Where both "
            "scatter alike, the old one is as good.",
        ),
    ]  # fmt: skip
    name = Path(str(validity.data.get("file", "a recording"))).name
    value = validity.output_errors.get("accelerometer")
    shown = f"p {probability(validity.p_value)}"
    meaning = "probability of data at least this unusual if the old calibration is still valid (all tests together)"
    if validity.verdict != "valid" and value is not None:
        shown = size(value.value, value.unit, 2)
        meaning = "largest error of the accelerometer in this recording under the old calibration"
    text = template("validity.html.jinja").render(
        title=f"Is the calibration still valid for {name}?",
        validity=validity,
        title_of=effect_title,
        words={kind.name: kind.words for kind in validity.experiment.residual_kinds},
        probability=probability,
        with_interval=with_interval,
        number_of=number,
        change=change,
        number=shown,
        meaning=meaning,
        pictures={each.name: each for each in pictures},
        outputs=[(_OUTPUTS[key], each) for key, each in validity.output_errors.items()],
    )
    return write_page(folder, text, pictures)[-1]


def _shifts(validity: Validity) -> bytes:
    """Gain and bias of both triads, in mm/s² and mrad/s."""
    figure = figures.new_figure(3.9)
    panels = figure.subplots(1, 2)
    for panel, triad, unit in zip(panels, ("accelerometer", "gyroscope"), ("mm/s²", "mrad/s"), strict=True):
        shown = [
            each for each in validity.shifts if each.in_si is not None and each.parameter.owner == triad and each.tested
        ][::-1]
        for row, each in enumerate(shown):
            assert each.in_si is not None and each.sigma_in_si is not None
            colour = _OLD if each.moved else _PLAIN
            panel.errorbar(1e3 * each.in_si, row, xerr=1.96e3 * each.sigma_in_si, fmt="o", color=colour, markersize=5)
        panel.set_yticks(range(len(shown)), [short_name(each.parameter) for each in shown], fontsize=8)
        panel.axvline(0.0, color="0.5", linewidth=0.8)
        panel.grid(True, axis="x", color="0.92")
        panel.set(xlabel=f"shift [{unit}]", title=triad)
    return figures.png(figure)


def _errors(validity: Validity) -> bytes:
    figure = figures.new_figure(3.4)
    panels = figure.subplots(1, 2)
    experiment = validity.experiment
    poses, turns = experiment.observations.poses, experiment.observations.turns
    start, stop = np.asarray(poses.start), np.asarray(poses.stop)
    places = ((start + stop)[np.asarray(poses.mask)] / 2, ((stop[:-1] + start[1:]) / 2)[np.asarray(turns.mask)])
    extended = [each.title for each in validity.causes if each.scope != "parameter"]
    fresh = " with ".join(["fresh calibration", *([", ".join(extended)] if extended else [])])
    labels = (("old calibration", _OLD), (fresh, _FRESH))
    for (label, colour), conditions in zip(labels, validity.conditions, strict=True):
        norm = 1e3 * conditions[experiment.kinds == 0]
        angle = np.degrees(np.linalg.norm(conditions[experiment.kinds == 1].reshape(-1, 2), axis=1))
        for panel, time, values in zip(panels, places, (norm, angle), strict=True):
            panel.plot(time, values, "o", color=colour, markersize=4, label=label)
    _dressed(panels[0], "gravity norm at rest", "error [mm/s²]")
    _dressed(panels[1], "gravity carried over a turn", "error [°]")
    return figures.png(figure)


def _dressed(panel: Axes, title: str, label: str) -> None:
    panel.axhline(0.0, color="0.7", linewidth=0.8)
    panel.set(xlabel="time [s]", ylabel=label, title=title)
    panel.legend(fontsize=8)
