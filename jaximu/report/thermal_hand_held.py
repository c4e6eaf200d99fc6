"""The page of poses by hand over temperature: what it does to bias and scale, what remains, what may still hide."""

from collections.abc import Iterator
from functools import partial

import numpy as np

from jaximu.calibration.thermal import change
from jaximu.calibration.thermal_terms import POWERS, SCALE
from jaximu.diagnosis.thermal_hand_held import HandHeldThermal
from jaximu.estimation.rows import TEMPERATURE
from jaximu.ground.page import Page, Part, Picture, Section, Statement, Table
from jaximu.ground.quantities import Z95, listed, readable, sentence, size
from jaximu.ground.quantities import change as changed
from jaximu.ground.units import SENSOR_UNITS
from jaximu.mistakes.titles import effect_title
from jaximu.model.effects import CATALOGUE
from jaximu.report.canvas import Figure
from jaximu.report.figures import AFTER, AXES, BEFORE, band, beside, dressed, legend, legend_below, new_figure
from jaximu.report.thermal import effect_table, files_and_next
from jaximu.report.words import how_much_smaller

_POWER = {name: power for power, name in enumerate(POWERS, 1)}


def page_of(thermal: HandHeldThermal) -> Page:
    """Return which effects of temperature are needed, the errors without and with them, and what may still hide."""
    files, command = files_and_next(thermal.experiment.recordings)
    return Page(
        f"Bias and scale over temperature of {files}",
        _verdict(thermal),
        *_number(thermal),
        (*_first(thermal),),
        partial(_rest, thermal),
        (*thermal.notes, f"Written by jaximu {thermal.software['version']}."),
        command,
    )


def _verdict(thermal: HandHeldThermal) -> list[str]:
    between = "between {:.0f} and {:.0f} °C".format(*thermal.range).replace("-", "−")
    titles = [CATALOGUE[name].english for name, *_ in thermal.steps]
    if not titles:
        return [
            f"Poses and turns by hand {between} show no effect of temperature: none improves the prediction of parts "
            "left out. What may still hide is below."
        ]
    improve = f"improve{'s' * (len(titles) == 1)} the prediction of parts left out"
    return [f"Temperature matters {between}: {listed(titles)} {improve}."]


def _sizes(thermal: HandHeldThermal) -> list[tuple[str, float, float, str]]:
    before, after = (thermal.experiment.real.rms(state.conditions) for state in (thermal.base, thermal.state))
    return [
        (kind.words, before[kind.name][0], after[kind.name][0], kind.unit) for kind in thermal.experiment.real.kinds
    ]


def _number(thermal: HandHeldThermal) -> tuple[str, str]:
    _, before, after, unit = _sizes(thermal)[0]
    if not thermal.steps:
        return size(after, unit), "error against gravity at rest, rms over all temperatures"
    smaller = f"{how_much_smaller(before, after)} than with one bias and scale for all temperatures"
    return size(after, unit), f"error against gravity at rest with these effects (rms), {smaller}"


def _first(thermal: HandHeldThermal) -> Iterator[Part]:
    reference = f"{thermal.calibration.imu.accelerometer.temperature_reference:g} °C"
    if _changed(thermal):
        yield Picture(
            "over_temperature",
            partial(_change_figure, thermal),
            "Bias and scale over temperature",
            f"Counted from {reference}, with 95 % bands. What is not drawn was not needed.",
        )
    yield Picture(
        "errors",
        partial(_error_figure, thermal),
        "Errors of poses and turns over temperature",
        "Each dot is a pose or a turn: how far gravity is from its size and, carried over a turn by the gyroscope, "
        "from its direction, and what the gyroscope shows at rest. What goes with temperature the model lacks.",
    )
    if thermal.steps:
        yield Table(
            ("error, rms", "one bias and scale → with the effects"),
            [(sentence(words), changed(before, after, unit)) for words, before, after, unit in _sizes(thermal)],
        )
        yield Section("Effects", [effect_table(thermal.calibration)])
    limits = Table(
        ("effect", "size that could hide", "at the end of the range"),
        [*_limit_rows(thermal)],
        "Effects that were tested and are not needed. Larger ones would have been found nine times in ten.",
    )
    undetermined = [
        Statement(sentence(effect_title(name)), f"Not determined: {why}.", True)
        for name, why in thermal.undetermined.items()
    ]
    untested = (
        "The rate of temperature, a lag and a hysteresis are not tested in poses by hand: record ramps at rest for "
        "them."
    )
    yield Section("What may still hide", [limits, *undetermined, untested])


def _limit_rows(thermal: HandHeldThermal) -> Iterator[tuple[str, ...]]:
    """Yield by effect that was not taken in: its detection limit, and what that is at the end of the range.

    Of a scale or a misalignment in percent.
    """
    extent = max(abs(end - thermal.calibration.imu.accelerometer.temperature_reference) for end in thermal.range)
    for name, (value, unit) in thermal.limits.items():
        kind = CATALOGUE[name]
        scale = float(np.mean(thermal.calibration.triads()[kind.owner].scales))
        most = value * extent ** _POWER.get(kind.plain, 1) / scale
        shown = size(most, SENSOR_UNITS[kind.owner], 2) if kind.plain in POWERS else size(100 * most, "%", 2)
        yield kind.title, size(value, unit, 2), shown


def _changed(thermal: HandHeldThermal) -> list[tuple[str, str, tuple[str, ...], float]]:
    """Return triad and number that temperature changes, the effects behind it, and the input they are drawn at."""
    kinds: list[tuple[str, tuple[str, ...], float]] = [("bias", POWERS, 0.0), ("scale", (SCALE,), 1.0)]
    return [
        (owner, word, names, force)
        for word, names, force in kinds
        for owner, triad in thermal.calibration.triads().items()
        if any(effect.plain in names for effect in triad.effects)
    ]


def _change_figure(thermal: HandHeldThermal) -> Figure:
    temperature = np.linspace(*thermal.range, 101)
    calibration = thermal.calibration
    drawn = []
    for owner, word, names, force in _changed(thermal):
        scale = calibration.triads()[owner].scales
        value, sigma = (values / scale for values in change(calibration, owner, names, temperature, force=force))
        factor, unit = readable(SENSOR_UNITS[owner], np.abs(value).max()) if word == "bias" else (100.0, "%")
        drawn.append((f"{sentence(owner)} {word} [{unit}]", factor * value, factor * sigma))
    rows = -(-len(drawn) // 2)
    figure = new_figure(2.9 * rows)
    panels = figure.subplots(rows, 2, squeeze=False).ravel()
    for panel in panels[len(drawn) :]:
        panel.remove()
    for panel, (title, value, sigma) in zip(panels, drawn, strict=False):
        for axis, (name, colour) in enumerate(AXES.items()):
            band(panel, temperature, value[:, axis], Z95 * sigma[:, axis], colour, label=name)
        dressed(panel, title, 0.0, xlabel="temperature [°C]")
    legend(panels[0], 3)
    return figure


def _error_figure(thermal: HandHeldThermal) -> Figure:
    real = thermal.experiment.real
    poses = real.of_kind("gravity_norm")
    temperature = np.full(len(real.spans), np.nan)
    temperature[real.first[poses]] = real.covariates[TEMPERATURE][poses]
    temperature = (temperature[real.first] + temperature[real.last]) / 2
    series = [("one bias and scale for all temperatures", BEFORE, thermal.base)]
    series += [("with the effects", AFTER, thermal.state)] if thermal.steps else []
    figure, panels = beside(len(real.kinds), 3.6)
    for index, (panel, kind) in enumerate(zip(panels, real.kinds, strict=True)):
        errors = [np.abs(thermal.experiment.errors(state)[index]).max() for _, _, state in series]
        factor, unit = readable(kind.unit, max(errors))
        warmth = temperature[real.kind == index][:: kind.components]
        for label, colour, state in series:
            panel.plot(warmth, factor * thermal.experiment.errors(state)[index], ".", ms=5, color=colour, label=label)
        dressed(panel, level=0.0, xlabel="temperature [°C]")
        panel.set_title(f"{sentence(kind.words)} [{unit}]", loc="left", fontsize=9, fontweight="bold")
    legend_below(figure, panels[0], 2)
    return figure


def _rest(thermal: HandHeldThermal) -> list[Section]:
    rows = [(effect_title(name), f"{statistic:.0f}", f"{gain:+.1f}") for name, statistic, gain in thermal.steps]
    return [
        Section(
            "What each effect gained",
            [
                Table(
                    ("effect", "χ²", "gain, nats"),
                    rows,
                    "In the order in which they were taken in: χ² of the score test when tested, and log-likelihood "
                    "gained on parts left out.",
                )
            ],
        )
    ]
