"""The page of a noise analysis: the curve, every axis's terms, the numbers that a filter takes, Kalibr's file."""

import math
import shlex
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from jaximu._version import __version__
from jaximu.ground.array_types import FloatArray
from jaximu.ground.page import Code, Page, Part, Picture, Section, Statement, Table
from jaximu.ground.quantities import listed, number, sentence, unit_text
from jaximu.ground.units import INERTIAL_QUANTITIES, SENSOR_QUANTITIES
from jaximu.model.data_sheet import DATASHEET_UNITS, SI_UNITS, TERM_NAMES, convert, to_discrete
from jaximu.model.processes import TERM_PROCESSES
from jaximu.noise.analysis import NoiseAnalysis
from jaximu.noise.filter_noise import (
    FilterNumbers,
    filter_numbers,
    mean_terms,
    random_walk_only,
    recorded_seconds,
    white_noise_only,
)
from jaximu.noise.identification import Identified, Term
from jaximu.recordings.readers.kalibr import kalibr_yaml
from jaximu.recordings.recording import Source
from jaximu.report.canvas import Axes, Figure
from jaximu.report.figures import AXES, dressed, new_figure
from jaximu.report.tables import written_now
from jaximu.report.words import file_names

_DISCRETE_UNITS = {
    "angular_rate": ("deg/s", "rad/s"),
    "specific_force": ("mg", "m/s^2"),
    "magnetic_field": ("nT", "uT"),
}
_ORDER = ("gyroscope", "accelerometer", "magnetometer")
"""Whose noise matters most."""
_AXES = ("x", "y", "z", "mean")
_NONE = "The data supports none of N, B and K."
Cell = tuple[float, float, float] | float


@dataclass(frozen=True)
class TermRow:
    """One term in one unit: value, low and high for x, y, z and their mean; where not seen, how large it may be.

    first: whether it is the first row of its term.
    """

    term: str
    meaning: str
    unit: str
    cells: tuple[Cell, ...]
    first: bool

    def texts(self, intervals: bool = True) -> list[str]:
        """Return each value as a person reads it, with its interval on a line below."""
        pairs = [
            (number(cell[0], 4), f"{number(cell[1])} … {number(cell[2])}")
            if isinstance(cell, tuple)
            else ("not seen", f"up to {number(cell)}")
            for cell in self.cells
        ]
        return ["\n".join(pair) if intervals else pair[0] for pair in pairs]

    def row(self, name: str, intervals: bool = True) -> tuple[str, ...]:
        """Return the row of a table: its name where it is the first of its term, the unit, and the texts."""
        return name if self.first else "", unit_text(self.unit), *self.texts(intervals)


def _factor(quantity: str, term: str, unit: str) -> float:
    """Return how many of a unit the SI unit of a term is."""
    return float(convert(1.0, SI_UNITS[quantity][term], unit))


def _in_unit(value: float, quantity: str, term: str, digits: int = 3) -> str:
    """Return an SI value of a term in the unit of data sheets."""
    unit = DATASHEET_UNITS[quantity][term]
    return f"{number(value * _factor(quantity, term, unit), digits)} {unit_text(unit)}"


def _units(quantity: str, term: str) -> Sequence[str]:
    """Return the unit of data sheets, then SI; one unit where they are the same."""
    return list(dict.fromkeys((DATASHEET_UNITS[quantity][term], SI_UNITS[quantity][term])))


def term_rows(axes: Sequence[Identified], quantity: str) -> list[TermRow]:
    """Return two rows for each term that any axis supports: in the unit of data sheets, then in SI; continuous."""
    rows = []
    mean = mean_terms(axes)
    for term, meaning in TERM_NAMES.items():
        estimates: list[Term | None] = [*(axis.terms.get(term) for axis in axes), mean.get(term)]
        for unit in _units(quantity, term) if any(estimates) else ():
            factor = _factor(quantity, term, unit)
            cells = tuple(
                factor * axes[column].limits[term]
                if estimate is None
                else (factor * estimate.value, factor * estimate.low, factor * estimate.high)
                for column, estimate in enumerate(estimates)
            )
            rows.append(TermRow(term, meaning, unit, cells, unit == DATASHEET_UNITS[quantity][term]))
    return rows


def unseen_notes(axes: Sequence[Identified], quantity: str) -> list[str]:
    """Return a sentence for each term that only some axes show, and one for those that none does."""
    letters = "xyz"[: len(axes)]
    notes = [
        f"{term} is supported by the data on {', '.join(estimate.axes)} alone and counts as zero on the other axes "
        "in the mean."
        for term, estimate in mean_terms(axes).items()
        if estimate is not None and estimate.axes != letters
    ]
    missing = [
        f"{TERM_NAMES[term]} {term} (up to {_in_unit(max(limits), quantity, term, 2)})"
        for term in DATASHEET_UNITS[quantity]
        if len(limits := [axis.limits[term] for axis in axes if term in axis.limits]) == len(axes)
    ]
    return [*notes, f"Not seen on any axis: {listed(missing)}."] if missing else notes


def _hours(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.3g} s"
    return f"{seconds / 60:.3g} min" if seconds < 7200 else f"{seconds / 3600:.3g} h"


def _shown(analysis: NoiseAnalysis) -> Iterator[tuple[str, str, dict[str, Term]]]:
    """Yield each triad, the most important first, its quantity, and which of N, B and K show, means of the axes."""
    for name in sorted(analysis.axes, key=_ORDER.index):
        mean = mean_terms(analysis.axes[name])
        yield name, SENSOR_QUANTITIES[name], {term: one for term in "NBK" if (one := mean.get(term)) is not None}


def _verdict(analysis: NoiseAnalysis) -> Iterator[str]:
    start = f"In {_hours(recorded_seconds(next(iter(analysis.axes.values()))[0]))} at rest, the"
    for name, quantity, terms in _shown(analysis):
        sizes = [f"{TERM_NAMES[term]} of {_in_unit(mean.value, quantity, term)}" for term, mean in terms.items()]
        yield f"{start} {name} has {listed(sizes) if sizes else 'none of N, B and K'} (mean of the axes)."
        start = "The"


def _number(analysis: NoiseAnalysis) -> tuple[str, str]:
    for name, quantity, terms in _shown(analysis):
        for term, mean in terms.items():
            low, high = (_in_unit(end, quantity, term) for end in (mean.low, mean.high))
            return (
                _in_unit(mean.value, quantity, term),
                f"{TERM_NAMES[term]} of the {name} (mean of the axes), 95 % interval {low} … {high}",
            )
    return "", ""


def _lowest(axes: Sequence[Identified]) -> tuple[float, float]:
    """Return the lowest point of the mean of the fitted Allan variances: averaging time (s) and deviation (SI)."""
    deviation = axes[0].deviation
    tau = np.geomspace(deviation.tau[0], deviation.tau[-1], 400)
    total = _mean_deviation(axes, tau)
    index = int(total.argmin())
    return tau[index], total[index]


def _mean_deviation(axes: Sequence[Identified], tau: FloatArray) -> FloatArray:
    return np.sqrt(np.mean([axis.allan_deviation(tau) ** 2 for axis in axes], axis=0))


def allan_figure(analysis: NoiseAnalysis) -> Figure:
    """Draw each triad's overlapping Allan deviation with 95 % bands, the fits, the terms, and what is not resolved."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    figure = new_figure(5.0, max(6.2, 5.7 * len(analysis.axes)))
    panels = np.atleast_1d(figure.subplots(1, len(analysis.axes)))
    for panel, (name, axes) in zip(panels, analysis.axes.items(), strict=True):
        _panel(panel, name, axes)
    handles = [Line2D([], [], color=colour, marker=".", label=f"{axis} axis") for axis, colour in AXES.items()]
    handles += [
        Line2D([], [], color="0.3", marker=".", linestyle="none", label="measured"),
        Patch(color="0.3", alpha=0.25, linewidth=0, label="95 % band"),
        Line2D([], [], color="0.3", linewidth=1.2, label="fitted: all terms"),
        Line2D([], [], color="0.3", linewidth=0.9, linestyle="--", label="each term (mean of the axes)"),
    ]
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=7 if len(panels) > 1 else 4,
        fontsize=8.5,
        frameon=False,
        columnspacing=1.4,
        handlelength=1.8,
    )
    return figure


def _panel(panel: Axes, name: str, axes: Sequence[Identified]) -> None:
    from matplotlib.ticker import LogLocator

    quantity = SENSOR_QUANTITIES[name]
    unit = DATASHEET_UNITS[quantity]["B"]
    factor = _factor(quantity, "B", unit)
    tau = axes[0].deviation.tau
    longest = tau[-1]
    fine = np.geomspace(tau[0], longest, 200)
    for colour, fit in zip(AXES.values(), axes, strict=True):
        deviation = fit.deviation
        panel.fill_between(
            deviation.tau,
            factor * deviation.low,
            factor * deviation.high,
            color=colour,
            alpha=0.18,
            linewidth=0,
            zorder=2,
        )
        panel.plot(deviation.tau, factor * deviation.value, ".", color=colour, markersize=6, zorder=4)
        panel.plot(fine, factor * fit.allan_deviation(fine), color=colour, linewidth=1.2, zorder=3)
    bottom = factor * min(min(fit.deviation.low.min(), fit.deviation.value.min()) for fit in axes) / 4
    top = factor * max(fit.deviation.value.max() for fit in axes) * 1.8
    left, right = tau[0] / 1.4, max(recorded_seconds(axes[0]), 2 * longest)
    panel.set(xscale="log", yscale="log", xlim=(left, right), ylim=(bottom, top))
    whole = np.geomspace(left, right, 600)
    total = factor * _mean_deviation(axes, np.clip(whole, tau[0], longest))
    for term, mean in mean_terms(axes).items():
        if mean is None:
            continue
        line = factor * np.sqrt(TERM_PROCESSES[term](mean.value).allan_variance(whole))
        panel.plot(whole, line, "--", color="0.3", linewidth=0.9, zorder=2.5)
        _letter(panel, term, whole, line, total, bottom, top)
    panel.axvspan(longest, right, color="0.88", zorder=1)
    panel.text(
        math.sqrt(longest * right),
        top / 1.15,
        f"not resolved\nby {_hours(recorded_seconds(axes[0]))}",
        ha="center",
        va="top",
        fontsize=8.5,
        color="0.35",
        rotation=90 if math.log(right / longest) < 0.19 * math.log(right / left) else 0,  # narrow
    )
    panel.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if top / bottom < 300 else (1.0,)))
    panel.yaxis.set_major_formatter("{x:g}")
    panel.yaxis.set_minor_formatter("")
    panel.xaxis.set_major_formatter("{x:g}")
    panel.set(xlabel="averaging time τ [s]", ylabel=f"Allan deviation σ(τ) [{unit_text(unit)}]")
    si = panel.secondary_yaxis(
        "right", functions=(lambda value: np.asarray(value) / factor, lambda value: np.asarray(value) * factor)
    )
    si.set_ylabel(f"[{unit_text(SI_UNITS[quantity]['B'])}]", fontsize=9)
    si.tick_params(labelsize=8)
    dressed(panel, _headline(name, axes))
    panel.grid(True, which="both", color="#EBEBEB", linewidth=0.6)


def _letter(
    panel: Axes, term: str, tau: FloatArray, line: FloatArray, total: FloatArray, bottom: float, top: float
) -> None:
    """Name a term's line where it is farthest below the whole: there the letter covers no data."""
    inside = np.flatnonzero((line > bottom * 1.25) & (line < top / 1.25))
    if not len(inside):
        return
    end = inside[(total / line)[inside].argmax()]
    room = line[-1] < line[0] and end < 0.7 * len(tau)
    spot, align = end, "left" if room else "right"  # beside a line that leaves at the bottom
    if end < 12 or end > len(tau) - 12:  # on a line that leaves at the side
        spot, align = (8, "left") if end < 12 else (len(tau) - 8, "right")
    panel.annotate(
        f" {term}  {TERM_NAMES[term]} ",
        (tau[spot], line[spot]),
        fontsize=8.5,
        color="0.15",
        zorder=5,
        ha=align,
        va="center",
        bbox={"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
    )


def _headline(name: str, axes: Sequence[Identified]) -> str:
    quantity = SENSOR_QUANTITIES[name]
    white = mean_terms(axes).get("N")
    at, size = _lowest(axes)
    first = "" if white is None else f"N = {_in_unit(white.value, quantity, 'N')}, "
    return f"{name.capitalize()}: {first}lowest {_in_unit(size, quantity, 'B', 2)} at {number(at, 2)} s"


def kalibr_text(analysis: NoiseAnalysis) -> str:
    """Return Kalibr's `imu.yaml` for the analysis; comments say units and where each number comes from.

    One number a triad: the root mean square of its axes. A sensor that was not recorded is left out and said.
    """
    numbers = {}
    words = {
        "measured": "identified",
        "from B": "K not seen, instead B sqrt(2/T) of the bias instability B (its correlation time T: allan.json)",
        "upper limit": "NOT SEEN in the data, an upper limit (97.5 %), not an estimate",
    }

    def comment(origin: tuple[str, ...]) -> str:
        axes = {source: [a for a, o in zip("xyz", origin, strict=False) if o == source] for source in origin}
        return "; ".join(f"{', '.join(letters)}: {words[source]}" for source, letters in axes.items())

    inertial = [name for name in INERTIAL_QUANTITIES if name in analysis.axes]
    for name in inertial:
        white, walk = white_noise_only(analysis, name), random_walk_only(analysis, name)
        numbers[f"{name}_noise_density"] = (white.value, f"{name} N, white noise: {comment(white.origin)}")
        numbers[f"{name}_random_walk"] = (walk.value, f"{name} K, bias random walk: {comment(walk.origin)}")
    rates = {analysis.rates[name] for name in inertial}
    header = [
        f"Noise for Kalibr, identified by jaximu {__version__} from {', '.join(analysis.files) or 'a recording'}",
        "Continuous densities (two-sided, as Kalibr's model has them), not standard deviations per sample: Kalibr",
        "multiplies by the square root of update_rate itself. Root mean square over the axes x, y, z.",
        "These are the figures at rest, at a steady temperature. In motion others add (vibration, scale, temperature);",
        "Kalibr's users often enlarge them several times for that. rostopic is a placeholder: set yours.",
    ]
    if len(rates) > 1:
        header.append(
            f"The sensors differ in rate ({', '.join(f'{rate:.6g} Hz' for rate in rates)}): the lower stands."
        )
    return kalibr_yaml(numbers, float(f"{min(rates):.6g}"), comments=header)


def page_of(analysis: NoiseAnalysis, sources: Sequence[Source] = ()) -> Page:
    """Return the page of a noise analysis; `sources`: the files with their SHA-256 and rows, where they are known."""
    log = shlex.quote(analysis.files[0]) if analysis.files else "REST"
    terms = _by_triad(
        analysis,
        "The terms: continuous",
        "Continuous, two-sided densities with 95 % intervals below them; they belong to the sensor, whatever its "
        "sample rate. “Mean” is the root mean square of the axes, for a filter that takes one number per triad. Many "
        "data sheets call the lowest point of the curve bias instability; B is the height of its flat part over 0.664.",
        _terms,
    )
    return Page(
        f"Noise at rest: {file_names(analysis.files)}",
        [*_verdict(analysis)],
        *_number(analysis),
        (
            Picture(
                "allan",
                partial(allan_figure, analysis),
                "Allan deviation against averaging time for " + " and ".join(analysis.axes),
                "How to read it: average the output over τ seconds, and the difference between one average and the "
                "next is typically √2 times the height of the curve. On the left, averaging helps: white noise falls "
                "by √10 for ten times the time. Where the curve is flat (bias instability) or rises (random walk, "
                "ramp), the bias itself wanders and longer averages no longer help. The squares of the dashed lines "
                "add up to that of a solid one.",
            ),
            Section("Before you rely on it", [*_cautions(analysis)]),
            terms,
            _by_triad(
                analysis,
                "For a Kalman filter",
                "Of the mean of the axes, in SI; Δt is one over the sample rate.",
                _filter,
            ),
            *_limits(analysis),
        ),
        partial(_details, analysis, sources or [Source(path, "", 0) for path in analysis.files]),
        [*filter(None, analysis.notes)],
        f"`jaximu calibrate LOG --static {log} -o RESULTS` calibrates the unit with this noise."
        if "accelerometer" in analysis.axes and not analysis.unusable
        else "",
    )


def _cautions(analysis: NoiseAnalysis) -> Iterator[Statement]:
    poor = [name for name, axes in analysis.axes.items() if any(axis.excess for axis in axes)]
    missing = [name for name in INERTIAL_QUANTITIES if name not in {*analysis.axes, *analysis.unusable}]
    if poor:
        yield Statement(
            "More than the five terms",
            f"The five terms do not describe the {listed(poor)} completely; the intervals are widened for it, see "
            "the notes.",
            True,
        )
    if missing:
        yield Statement("Not recorded", f"The recording has no {listed(missing, 'and no')}.", True)


def _by_triad(
    analysis: NoiseAnalysis, title: str, text: str, content: Callable[[NoiseAnalysis, str], Iterable[Part]]
) -> Section:
    return Section(
        title,
        [
            text,
            *(
                Section(f"{sentence(name)}, {analysis.rates[name]:.6g} Hz", [*content(analysis, name)], 3)
                for name in analysis.axes
            ),
        ],
    )


def _terms(analysis: NoiseAnalysis, name: str) -> Iterator[Part]:
    axes = analysis.axes[name]
    quantity = SENSOR_QUANTITIES[name]
    rows = [row.row(f"{row.term} {row.meaning}", row.first) for row in term_rows(axes, quantity)]
    yield Table(("term", "unit", *_AXES), rows)
    yield from unseen_notes(axes, quantity)
    at, size = _lowest(axes)
    yield f"Lowest point of the mean's curve: {_in_unit(size, quantity, 'B', 2)} at {_hours(at)}."


def _terms_in_si(analysis: NoiseAnalysis, name: str) -> Iterator[Part]:
    quantity = SENSOR_QUANTITIES[name]
    rows = [
        replace(row, first=True).row(f"{row.term} {row.meaning}")
        for row in term_rows(analysis.axes[name], quantity)
        if row.unit == SI_UNITS[quantity][row.term]
    ]
    yield Table(("term", "unit", *_AXES), rows) or _NONE


def _filter(analysis: NoiseAnalysis, name: str) -> Iterator[Part]:
    rows = [row for row in _filter_rows(filter_numbers(analysis, name)[1]) if row[2]]
    yield Table(("formula", "number", "value", "unit"), rows) or _NONE


def _limits(analysis: NoiseAnalysis) -> Iterator[Part]:
    triads = {}
    for name, axes in analysis.axes.items():
        text = (
            f"{_hours(recorded_seconds(axes[0]))} at rest resolve averages up to {_hours(axes[0].deviation.tau[-1])}; "
            "what the bias does more slowly, and from one power-on to the next, does not show. Four times the "
            "recording resolves four times as long averages."
        )
        triads.setdefault(text, []).append(name)
    yield Section(
        "What the length cannot resolve", [Statement(sentence(listed(names)), text) for text, names in triads.items()]
    )
    text = (
        f"Standard deviation of the bias over {len(analysis.files)} recordings, with its 95 % interval. No Allan "
        "deviation sees it, and a filter needs it as the bias's standard deviation at the start."
        if analysis.repeatability
        else "One recording does not show how the bias changes from power-on to power-on, and the Allan deviation "
        "cannot see it. Give several recordings of the unit, lying alike: `jaximu allan LOG1 LOG2 LOG3 …`"
    )
    yield Section("Repeatability", [text, Table(("sensor", "unit", *_AXES[:3]), [*_repeatability_rows(analysis)])])


def _details(analysis: NoiseAnalysis, sources: Sequence[Source]) -> Iterator[Part]:
    yield _by_triad(analysis, "The terms in SI, with intervals", "", _terms_in_si)
    yield _by_triad(
        analysis,
        "At the sample rate: discrete",
        "These belong to the sensor at one sample rate: standard deviations of a sample or a step. They are not the "
        "numbers above, and change with the rate. A program that asks for a unit with √Hz or √h wants the continuous "
        "terms; one that asks for rad/s or m/s² a sample wants this.",
        _discrete,
    )
    yield _by_triad(
        analysis,
        "For a Kalman filter, by axis",
        "The bias is a random walk of density K² (if there is K) plus a first-order Gauss–Markov process of standard "
        "deviation B (if there is B). Flicker noise has no correlation time; T is chosen so that the process peaks "
        "(at 1.89 T) in the middle of the part where B rules. A filter that takes a sample as a measurement needs R; "
        "one that integrates samples, as navigation does, needs N²Δt.",
        _filter_by_axis,
    )
    yield Section("For Kalibr", ["The same, as `imu.yaml`:", Code(kalibr_text(analysis))])
    yield Section(
        "Where it comes from",
        [
            Table(
                ("file", "rows", "SHA-256"),
                [(source.path, str(source.rows or ""), source.sha256) for source in sources],
            ),
            Table(
                (),
                [
                    ("Sample rate", ", ".join(f"{name} {rate:.6g} Hz" for name, rate in analysis.rates.items())),
                    (
                        "Method",
                        "the five terms Q, N, B, K, R fitted together to the samples, those kept that the data "
                        "supports (jaximu.noise.identify); picture: overlapping Allan deviation at octaves",
                    ),
                    ("Software", f"jaximu {__version__}"),
                    ("Report written", written_now()),
                ],
            ),
        ],
    )


def _discrete(analysis: NoiseAnalysis, name: str) -> Iterator[Part]:
    axes, quantity, rate = analysis.axes[name], SENSOR_QUANTITIES[name], analysis.rates[name]
    rows = []
    for term, words in (("N", "white noise of one sample, σ = N √rate"), ("K", "step of the bias walk, σ = K/√rate")):
        estimates = [*(axis.terms.get(term) for axis in axes), mean_terms(axes).get(term)]
        sizes = [None if one is None else float(to_discrete(term, one.value, rate)) for one in estimates]
        for unit in _DISCRETE_UNITS[quantity] if any(sizes) else ():
            factor = _factor(quantity, "B", unit)
            rows.append((words, unit_text(unit), *["–" if one is None else number(factor * one, 4) for one in sizes]))
            words = ""
    yield Table(("", "unit", *_AXES), rows) or "The data supports neither N nor K."


def _filter_by_axis(analysis: NoiseAnalysis, name: str) -> Iterator[Part]:
    per_axis, mean = filter_numbers(analysis, name)
    rows = [
        (row[0][0], row[0][3], *(text or "–" for _, _, text, _ in row))
        for row in zip(*map(_filter_rows, per_axis), strict=True)
        if any(text for _, _, text, _ in row)
    ]
    yield Table(("formula", "unit", *_AXES[:3]), rows) or _NONE
    if mean.flat is not None:
        left, right = (_hours(end) for end in sorted(mean.flat))
        yield (
            f"In the mean, B rules between averaging times of {left} and {right}; T is their geometric mean over 1.89."
        )


def _filter_rows(numbers: FilterNumbers) -> list[tuple[str, str, str, str]]:
    """Return formula, words, value as text and unit of each number that a filter takes; no text where there is none."""
    return [
        (formula, words, "" if value is None else number(value, 8 if key == "decay" else 4), unit_text(unit))
        for key, formula, words, value, unit in numbers.rows()
    ]


def _repeatability_rows(analysis: NoiseAnalysis) -> Iterator[tuple[str, ...]]:
    for name, table in analysis.repeatability.items():
        quantity = SENSOR_QUANTITIES[name]
        for unit in _units(quantity, "B"):
            cells = tuple(map(tuple, _factor(quantity, "B", unit) * np.asarray(table)))
            yield TermRow("B", name, unit, cells, unit == DATASHEET_UNITS[quantity]["B"]).row(name)
