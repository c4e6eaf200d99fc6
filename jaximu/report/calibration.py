"""The page of a calibration: errors before and after, what to trust, every parameter, the equation to apply."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial

import numpy as np

from jaximu.calibration import Calibration
from jaximu.data.stations import station_errors
from jaximu.ground.page import Code, Page, Part, Picture, Section, Statement, Table
from jaximu.ground.quantities import Z95, change, counted, sentence, size, with_interval
from jaximu.ground.units import SENSOR_UNITS
from jaximu.report import figures, tables, words
from jaximu.report.canvas import Figure
from jaximu.report.evidence import evidence
from jaximu.report.uncertainty import uncertainty_parts

_ERRORS = {
    "gravity_norm": "Error against gravity at rest",
    "gravity_direction": "Direction of gravity lost over a turn",
    "static_gyroscope": "Rate at rest",
    "specific_force": "Error of the specific force",
    "rate_at_rest": "Error of the rate in poses",
    "turn_angle": "Error of the angle of turns",
    "rotation": "Error of the rate against the reference",
    "field_strength": "Error of the field's strength",
    "accelerometer": "Specific force at rest over temperature",
    "gyroscope": "Rate at rest over temperature",
}


def page_of(calibration: Calibration) -> Page:
    """Return the page of a calibration from poses, turns or rests."""
    return calibration_page(
        calibration,
        _pictures(calibration),
        words.trust(calibration),
        partial(words.limits, calibration, evidence(calibration)),
    )


def _pictures(calibration: Calibration) -> Iterator[Picture]:
    if calibration.fit is not None and calibration.nominal is not None and calibration.observations is not None:
        yield Picture(
            "residuals",
            partial(figures.residuals_of, calibration),
            "Errors of each pose and turn, before and after calibration",
            "“Before” is where the fit started: the nominal scale and offset, no misalignment. The inner band is "
            "what the noise, measured while the unit was still, explains; where a wider one surrounds it, the errors "
            "scatter more than that, and the intervals below count with the wider one.",
        )
    if calibration.fit is not None and calibration.stations is not None:
        yield Picture(
            "residuals" if calibration.observations is None else "table_residuals",
            partial(_stations_figure, calibration),
            "Errors of each pose and turn after calibration",
            "Mean outputs less what the calibrated model makes of what the set-up says, by axis, in SI.",
        )


def _stations_figure(calibration: Calibration) -> Figure:
    fit = calibration.fit
    stations = calibration.stations
    assert fit is not None and stations is not None
    panels = [panel for panel in station_errors(fit.imu, stations, np.asarray(fit.excess)) if len(panel.station)]
    across = "pose or turn, in order of time (bars: 95 % of the noise)"
    figure, grid = figures.stacked(len(panels), 2.3, 0.0, across=across)
    for axes, panel in zip(grid, panels, strict=True):
        for shift, (axis, color), error, sigma in zip(
            (-0.2, 0.0, 0.2), figures.AXES.items(), panel.error, panel.sigma, strict=True
        ):
            axes.errorbar(panel.station + shift, error, Z95 * sigma, fmt="o", ms=3.5, lw=0.8, color=color, label=axis)
        figures.dressed(axes, _error_words(panel.name), 0.0, ylabel=panel.unit)
    figures.legend(grid[0], 3, "upper right")
    return figure


def calibration_page(
    calibration: Calibration,
    pictures: Iterable[Picture],
    trust: Iterable[Statement],
    limits: Callable[[], Iterable[Part]],
    verdict: Sequence[str] = (),
    number: tuple[str, str] | None = None,
    findings: Iterable[Part] = (),
) -> Page:
    """Return the page of any calibration.

    **Arguments:** `trust`, `limits`: what to trust, what the data cannot show (only in the file); `verdict`: sentences
    before those on the errors; `number`: the one number and what it is, the first error after calibration if None;
    `findings`: what else was found, for the first screen.
    """
    trust = [
        *trust,
        *(
            Statement("Weakly known" if weak.determined else "Not determined", sentence(weak.text), True)
            for weak in calibration.weak
        ),
    ]

    def rest() -> Iterator[Part]:
        yield Section("What to trust", [statement for statement in trust if not statement.caution])
        yield Section("What is still uncertain", [*uncertainty_parts(calibration)])
        yield Section("What the data cannot show", [*limits()])
        yield from _equations(calibration)
        yield _correlation(calibration)
        yield from _origin(calibration)

    return Page(
        _title(calibration),
        (*verdict, *_errors(calibration), *_determined(calibration)),
        *(number or _number(calibration)),
        (
            *pictures,
            *findings,
            Section("Before you rely on it", [statement for statement in trust if statement.caution]),
            *_parameters(calibration),
        ),
        rest,
        calibration.notes,
        words.compensation(calibration.files, "applies it") if "accelerometer" in calibration.triads() else "",
    )


def _title(calibration: Calibration) -> str:
    data = calibration.data
    counts = [
        counted(data[kind + "s"], kind) for kind in ("pose", "turn", "interval", "window") if data.get(kind + "s")
    ]
    return f"Calibration of {words.file_names(calibration.files)}: {', '.join([*counts, f'{calibration.method} fit'])}"


def _error_words(name: str) -> str:
    """Return what a kind of residual is called; of several kinds of data it may have a number."""
    kind, _, number = name.partition(" ")
    words = _ERRORS.get(kind) or f"Error of the {kind.replace('_', ' ')}"
    return f"{words} {number}".strip()


def _errors(calibration: Calibration) -> Iterator[str]:
    for name, (before, after, unit) in calibration.rms.items():
        if name in calibration.exact:
            yield (
                f"{_error_words(name)}: {size(before, unit)} before calibration (rms); after it none by construction, "
                "for there are as many parameters as conditions: no degrees of freedom are left to check it by."
            )
        else:
            yield f"{_error_words(name)}: {change(before, after, unit)} (rms, before → after calibration)."


def _number(calibration: Calibration) -> tuple[str, str]:
    if calibration.exact or not calibration.rms:
        return "not checked", "there are as many parameters as conditions"
    name, (before, after, unit) = next(iter(calibration.rms.items()))
    what = _error_words(name)
    smaller = f", {words.how_much_smaller(before, after)} than before" if after < before else ""
    return size(after, unit, 2), f"{what[0].lower()}{what[1:]}, rms after calibration{smaller}"


def _determined(calibration: Calibration) -> Iterator[str]:
    count = len(calibration.names)
    if undetermined := sum(not direction.determined for direction in calibration.weak):
        what = f"{counted(undetermined, 'combination')} of the {count} parameters"
        yield f"The recording does not determine {what} (marked *)."
    elif calibration.weak:
        yield "All parameters are determined, those marked * only weakly."
    else:
        yield f"All {count} parameters are determined."
    if calibration.diagnosis:
        yield f"Diagnosis: {calibration.diagnosis['verdict']}."


def _parameters(calibration: Calibration) -> Iterator[Part]:
    parts = []
    for name, triad in calibration.triads().items():
        rows = tables.rows(calibration, name, triad)
        parts.append(
            Section(
                sentence(name),
                [
                    Table(
                        ("", "parameter", "± 95 %", "in other words"),
                        rows,
                        "",
                        [index for index, row in enumerate(rows) if "*" in row[1]],
                    )
                ],
                3,
            )
        )
    others = [
        (
            one.words + " *" * one.weak,
            with_interval(one.value, one.sigma, one.unit) if one.determined else "not determined",
        )
        for one in calibration.parameters.values()
        if "effects" in one.name
    ]
    yield Section("Parameters", [*parts, Section("Effects", [Table(("number", "± 95 %"), others)], 3)])
    yield (
        "Gain K = S·(1 + M): scales S on the diagonal, misalignments M beside it (1 mrad is 0.1 % of the input); "
        "“misalignment y from x” is how much of the input along x appears on output y."
        + " Rows marked * take part in a weak combination."
        * bool(calibration.weak)
    )
    if calibration.bias_sigma_recording:
        yield _biases_of_the_recording(calibration)


def _biases_of_the_recording(calibration: Calibration) -> str:
    means = []
    for name, sigma in calibration.bias_sigma_recording.items():
        if calibration.open_numbers.isdisjoint(f"{name}.bias[{axis}]" for axis in range(3)):
            worst = float(np.max(sigma / calibration.triads()[name].scales))
            means.append(f"± {size(Z95 * worst, SENSOR_UNITS[name], 2)} ({name})")
    return (
        "The biases, and their intervals, are for use after the recording, for as long again as it took and without "
        "another power-on."
        + f" As means over the recording itself they are known to {' and '.join(means)}, worst axis."
        * bool(means)
    )


def _equations(calibration: Calibration) -> Iterator[Part]:
    parts: list[Part] = [
        "The sensor's output is `y = K·u + b`, with the true input u in SI units. To correct a recording, turn it "
        "round: `u = K⁻¹·(y − b)`."
    ]
    parts += [Section(sentence(name), lines, 3) for name, lines in tables.equations(calibration)]
    if lines := tables.snippet(calibration):
        parts += ["In Python, with all digits:", Code(lines)]
    yield Section("The equation to apply", parts)


def _correlation(calibration: Calibration) -> Picture:
    shared = calibration.gravity.sigma > 0 and "accelerometer" in calibration.triads()
    return Picture(
        "correlation",
        partial(figures.correlation_figure, calibration),
        "Correlation of the fitted parameters",
        "a: accelerometer, g: gyroscope; s_x: scale of axis x; m_yx: misalignment, input along x seen by output y; "
        "b_x: bias. Near ±1, the recording determines only the sum or difference of the two, and their single "
        "intervals are wide."
        + " The accelerometer's scales go together as far as they share the uncertainty of gravity."
        * bool(shared),
    )


def _origin(calibration: Calibration) -> Iterator[Part]:
    parts = []
    if calibration.segmentations:
        parts.append(
            Picture(
                "recording",
                partial(figures.recording_of, calibration),
                "Accelerometer and gyroscope against time, poses shaded",
                "As recorded, turned into SI units by the nominal scale and offset. Numbers count the poses.",
            )
        )
    else:
        parts.append(
            "This report was made from a stored calibration: errors by pose and the recording are not kept there."
        )
    sources = [
        [str(file.get(key, "")) for key in ("file", "rows", "sha256")] for file in calibration.data.get("files", [])
    ]
    parts += [Table(("file", "rows", "SHA-256"), sources), Table((), tables.provenance(calibration))]
    yield Section("Where it comes from", parts)
