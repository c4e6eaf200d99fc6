"""The report of a diagnosis: one sentence, one picture, one number, then the evidence."""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from jaximu.diagnosis import Diagnosis, twin_of
from jaximu.diagnosis.diagnosis import probability
from jaximu.diagnosis.hand_held import HandHeld, State
from jaximu.diagnosis.improvement import KINDS
from jaximu.effects import CATALOGUE
from jaximu.errors import InputError
from jaximu.formats.atomic import atomic_write
from jaximu.report import figures
from jaximu.report.html import Picture, template

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["write_diagnosis"]

FloatArray = NDArray[np.float64]
_MEASURED, _TWIN, _EXTENDED = "#D55E00", "#8A8A8A", "#0072B2"
_SHOWN = 12
_KIND_WORDS = {
    "gravity_norm": "gravity norm at rest",
    "gravity_direction": "gravity carried over a turn",
    "static_gyroscope": "rate at rest",
}


def write_diagnosis(diagnosis: Diagnosis, folder: str | os.PathLike[str]) -> Path:
    """Write `report.html` and its pictures as PNGs into `folder`; all are drawn before anything is written.

    **Returns:** the path of `report.html`. Raises `InputError` where the folder cannot be made or written to.
    """
    twin = twin_of(diagnosis)
    copied = twin.fit()
    pictures = [
        Picture(
            "diagnosis", _lead(diagnosis, twin, copied), "Errors of the recording, its twin and the extended model",
            "Each dot is a pose. Grey: the same recording simulated by the fitted model, noise included (its twin): "
            "that is how far errors scatter if nothing is missing. Right: the test of each effect, alone; beyond the "
            "dashed line an effect stands out from all that chance produces in a family of so many tests.",
        ),
        Picture(
            "dependence", _dependence(diagnosis, twin, copied), "Errors against time, temperature and orientation",
            "The base model's errors against what they may depend on; grey is the twin. What has a shape here, and "
            "none in grey, is model error; scatter alike in both is noise.",
        ),
        Picture(
            "noise", _spectra(diagnosis, twin), "Spectrum of the still parts, measured and simulated",
            "Spectrum of what the sensors put out while the unit was still, measured and twin, mean of the axes. If "
            "they differ, the noise model does not fit this recording.",
        ),
    ]  # fmt: skip
    text = _render(diagnosis, {each.name: each for each in pictures})
    target = Path(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{target} cannot be made a folder for the report: {error.strerror}.") from error
    contents = {f"{each.name}.png": each.data for each in pictures}
    contents["report.html"] = text.encode("utf-8", "backslashreplace")
    with ExitStack() as stack:
        for name, content in contents.items():
            stack.enter_context(atomic_write(target / name)).write_bytes(content)
    return target / "report.html"


def _errors(experiment: HandHeld, state: State) -> dict[str, FloatArray]:
    """Errors of each kind: signed norms (m/s²); lengths of the turns' (deg) and of the rests' (rad/s)."""
    kinds = experiment.kinds
    conditions = experiment.in_si(state.conditions)
    parts = [conditions[kinds == place].reshape(-1, size) for place, size in enumerate((1, 2, 3))]
    found = {"gravity_norm": parts[0][:, 0]}
    found["gravity_direction"] = np.degrees(np.linalg.norm(parts[1], axis=1))
    found["static_gyroscope"] = np.linalg.norm(parts[2] - parts[2].mean(axis=0), axis=1) if len(parts[2]) else parts[2]
    return found


def _covariates(experiment: HandHeld) -> dict[str, FloatArray]:
    """What pose errors may depend on, by name with unit."""
    poses = experiment.observations.poses
    real = np.asarray(poses.mask)
    triad = experiment.start.accelerometer
    force = (np.asarray(poses.accelerometer_mean) - np.asarray(triad.bias)) @ np.linalg.inv(np.asarray(triad.gain)).T
    found = {"time [s]": ((np.asarray(poses.start) + np.asarray(poses.stop)) / 2)[real]}
    temperature = np.asarray(poses.temperature)[real]
    if np.ptp(temperature) > 0.1:
        found["temperature [°C]"] = temperature
    return found | {f"specific force, {axis} [m/s²]": force[real, k] for k, axis in enumerate("xyz")}


def _shown_kind(diagnosis: Diagnosis) -> str:
    """The kind of error that the lead is about."""
    if diagnosis.effects and diagnosis.gain is not None:
        return diagnosis.gain.best_unit(diagnosis.effects[0].name)
    worst = min(diagnosis.checks[:3], key=lambda check: check.p_value)
    return KINDS[diagnosis.checks.index(worst)]


def _lead(diagnosis: Diagnosis, twin: HandHeld, copied: State) -> bytes:
    figure = figures.new_figure(4.3)
    left, right = figure.subplots(1, 2, width_ratios=[1.35, 1])
    kind = _shown_kind(diagnosis)
    factor, unit = {"gravity_norm": (1e3, "mm/s²"), "gravity_direction": (1.0, "°"),
                    "static_gyroscope": (np.degrees(1.0), "°/s")}[kind]  # fmt: skip
    experiment = diagnosis.experiment
    time = _covariates(experiment)["time [s]"]
    if kind == "gravity_direction":
        mask = np.asarray(experiment.observations.turns.mask)
        starts, stops = (np.asarray(each) for each in (experiment.observations.poses.stop,
                                                       experiment.observations.poses.start))  # fmt: skip
        time = ((starts[:-1] + stops[1:]) / 2)[mask]
    series = [
        ("twin", _TWIN, _errors(twin, copied)),
        ("measured, base model", _MEASURED, _errors(experiment, diagnosis.base)),
    ]
    if diagnosis.effects:
        series.append(("measured, extended model", _EXTENDED, _errors(experiment, diagnosis.extended)))
    for label, colour, errors in series:
        values = factor * errors[kind]
        left.plot(time[: len(values)], values, "o", color=colour, markersize=4, label=label)
    left.axhline(0.0, color="0.7", linewidth=0.8)
    left.set(xlabel="time [s]", ylabel=f"error [{unit}]", title=_KIND_WORDS[kind])
    left.legend(fontsize=8)
    _ranking(right, diagnosis)
    return figures.png(figure)


def _ranking(panel: Axes, diagnosis: Diagnosis) -> None:
    evidence = diagnosis.base.evidence
    scores = evidence.scores()
    best: dict[str, float] = {}
    for k, block in enumerate(evidence.blocks):
        if block.kind == "effect" and scores.freedom[k]:
            best[block.name] = min(best.get(block.name, 1.0), max(float(scores.p_value[k]), 1e-300))
    order = sorted(best, key=best.__getitem__)[:_SHOWN][::-1]
    named = {each.name for each in diagnosis.effects}
    rivals = {name for each in diagnosis.effects for name in each.rivals}
    colours = [_EXTENDED if n in named else ("#56B4E9" if n in rivals else "#C4C4C4") for n in order]
    panel.barh(order, [-np.log10(best[name]) for name in order], color=colours)
    panel.axvline(-np.log10(evidence.critical(0.05)), color="black", linestyle="--", linewidth=1)
    panel.set(xlabel="evidence: −log₁₀ of the p-value", title="each effect, tested alone")
    panel.tick_params(axis="y", labelsize=8)


def _dependence(diagnosis: Diagnosis, twin: HandHeld, copied: State) -> bytes:
    experiment = diagnosis.experiment
    covariates, shadow = _covariates(experiment), _covariates(twin)
    rows = ["gravity_norm", "static_gyroscope"]
    figure = figures.new_figure(2.1 * len(rows) + 0.4)
    panels = figure.subplots(len(rows), len(covariates), squeeze=False, sharey="row", sharex="col")
    measured, simulated = _errors(experiment, diagnosis.base), _errors(twin, copied)
    scales = ((1e3, "norm [mm/s²]"), (np.degrees(1.0), "rate at rest [°/s]"))
    for row, (kind, (factor, label)) in enumerate(zip(rows, scales, strict=True)):
        for column, name in enumerate(covariates):
            panel = panels[row, column]
            panel.plot(shadow[name], factor * simulated[kind], ".", color=_TWIN, markersize=4)
            panel.plot(covariates[name], factor * measured[kind], ".", color=_MEASURED, markersize=5)
            panel.grid(True, color="0.92")
            if row == len(rows) - 1:
                panel.set_xlabel(name, fontsize=8)
            if column == 0:
                panel.set_ylabel(label, fontsize=8)
    return figures.png(figure)


def _spectra(diagnosis: Diagnosis, twin: HandHeld) -> bytes:
    figure = figures.new_figure(3.2)
    panels = figure.subplots(1, 2)
    for panel, name, unit in zip(panels, ("accelerometer", "gyroscope"), ("m/s²/√Hz", "rad/s/√Hz"), strict=True):
        for label, colour, experiment in (("measured", _MEASURED, diagnosis.experiment), ("twin", _TWIN, twin)):
            frequency, density = _density(experiment, name)
            panel.plot(frequency, np.sqrt(density), color=colour, linewidth=1, label=label)
        middle = float(np.sqrt(np.median(density)))
        low, high = panel.get_ylim()
        panel.set(
            xscale="log", yscale="log", xlabel="frequency [Hz]", ylabel=f"density [{unit}]", title=name,
            ylim=(min(low, middle / 3), max(high, middle * 3)),
        )  # fmt: skip
        panel.grid(True, which="both", color="0.92")
        panel.legend(fontsize=8)
    return figures.png(figure)


def _density(experiment: HandHeld, name: str) -> tuple[FloatArray, FloatArray]:
    """Two-sided density (k,) of a triad at rest, mean of axes and poses, and its frequencies, Hz."""
    segments: list[FloatArray] = []
    rate = 1.0
    for part in experiment.segmentations:
        signal = getattr(part.recording, name)
        rate = signal.rate
        values = signal.si()
        segments += [values[(signal.time >= a) & (signal.time < b)] for a, b in part.intervals]
    length = max(16, int(np.quantile([len(each) for each in segments], 0.25)))
    whole = np.stack([each[:length] - each[:length].mean(axis=0) for each in segments if len(each) >= length])
    power = np.mean(np.abs(np.fft.rfft(whole, axis=1)) ** 2, axis=(0, 2)) / (length * rate)
    return np.asarray(np.fft.rfftfreq(length, 1 / rate)[1:-1], np.float64), power[1:-1]


def _render(diagnosis: Diagnosis, pictures: dict[str, Picture]) -> str:
    gain = diagnosis.gain
    number, meaning = f"p {probability(diagnosis.p_value)}", "that nothing is missing, over all tests together"
    if gain is not None and diagnosis.effects:
        kind = gain.best_unit(diagnosis.effects[0].name)
        (before, unit), (after, _) = gain.before.rms[kind], gain.after.rms[kind]
        number = f"{before:.3g} → {after:.3g} {unit}"
        meaning = (
            f"rms of {_KIND_WORDS[kind]} on data that was not fitted ({gain.data}), without and with the extension"
        )
    gains: list[Any] = []
    if gain is not None:
        gains = [
            (_KIND_WORDS[kind], gain.before.rms[kind], gain.after.rms[kind])
            for kind in KINDS
            if kind in gain.before.rms
        ]
    name = diagnosis.calibration.data.get("file", "recording")
    return template("diagnosis.html.jinja").render(
        title=f"Diagnosis of {name}",
        diagnosis=diagnosis,
        headline=diagnosis.headline(),
        number=number,
        meaning=meaning,
        pictures=pictures,
        effects=[(each, CATALOGUE[each.name], _numbers(each)) for each in diagnosis.effects],
        gain=gain,
        gains=gains,
        limits=sorted(diagnosis.detection_limits.items()),
    )


def _numbers(named) -> list[str]:
    """Coefficients with half their 95 % intervals."""
    values = zip(np.asarray(named.effect.coefficients), named.sigma, strict=True)
    texts = [f"{value:.3g} ± {1.96 * sigma:.2g}" for value, sigma in values]
    for name, each in named.effect.inner.items():
        sigma = named.inner_sigma.get(name)
        width = "" if sigma is None else f" ± {1.96 * sigma:.2g}"
        texts.append(f"{name.replace('_', ' ')} {float(getattr(named.effect, name)):.3g}{width} {each.unit}")
    return texts
