"""The page of a calibration over temperature: what temperature does to the bias, what remains, what was covered."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from jaximu.calibration.calibration import Calibration
from jaximu.calibration.identifiability import ENOUGH
from jaximu.calibration.thermal import ThermalCalibration, change
from jaximu.calibration.thermal_regression import multifactor
from jaximu.calibration.thermal_selection import CUBIC
from jaximu.calibration.thermal_terms import LEARNED, NETWORK
from jaximu.data.rest_blocks import LEAST_RANGE, RATE_BANDWIDTH
from jaximu.estimation.track import TEMPERATURE_WINDOW
from jaximu.ground.array_types import FloatArray
from jaximu.ground.document import Json
from jaximu.ground.page import Items, Page, Part, Picture, Section, Statement, Table
from jaximu.ground.quantities import Z95, listed, number, readable, sentence, size, unit_text, with_interval
from jaximu.ground.units import PREFIXES, SENSOR_UNITS
from jaximu.mistakes.titles import effect_title
from jaximu.planning.ramps import next_ramps
from jaximu.recordings.recording import Recording, smoothed_slope
from jaximu.report.canvas import Axes, Figure
from jaximu.report.export.thermal_autopilot import AutopilotParameters
from jaximu.report.figures import beside, dressed, legend, new_figure
from jaximu.report.words import compensation, file_names, how_much_smaller

_ROWS = 45  # three to a term of a regression
_WORTH = 1.2  # times as large a share that a ramp must leave of some effect to be proposed
_LEAST_SHARE = 1e-3  # of an effect's shape that is stated
_MOST_DOTS = 600  # of a surface's data
_BESIDE_DATA = 0.04  # of the range of temperatures and of rates, about the blocks, to which a surface is drawn


def page_of(thermal: ThermalCalibration, exports: Sequence[AutopilotParameters] = ()) -> Page:
    """Return what temperature did to each sensor, what remains of it, by which model, and what an autopilot loses."""
    files, command = files_and_next(thermal.blocks.recordings)
    return Page(
        f"Bias over temperature of {files}",
        (*_verdict(thermal),),
        *_number(thermal),
        (
            *(_band_picture(thermal, name) for name in thermal.fits),
            _remainder(thermal),
            *(_model(thermal, name) for name in thermal.fits),
            Section("What these recordings can separate", [*thermal.identifiability.words, *_ways(thermal)]),
            Section("Effects", [effect_table(thermal.calibration)]),
            Section("Models that were tried", [*_candidates(thermal)]),
            *(
                Section(f"{export.name} parameters", [loss_words(export, thermal), Items(export.notes)])
                for export in exports
            ),
        ),
        partial(_rest, thermal),
        thermal.notes,
        command,
    )


def files_and_next(recordings: Sequence[Recording]) -> tuple[str, str]:
    """Return the names of the recordings' files, and the sentence on what to run next."""
    files = [str(source.path) for recording in recordings for source in recording.sources]
    return file_names(files), compensation(files, "applies it at the logged temperatures")


def _size(name: str, axes: FloatArray) -> str:
    """Return the rms of three axes together, SI, in the unit in which a person reads it."""
    return size(float(np.linalg.norm(axes)), SENSOR_UNITS[name])


def _unit(thermal: ThermalCalibration, name: str) -> tuple[float, str]:
    """Return the factor and the unit in which a person reads what temperature does to a triad."""
    return readable(SENSOR_UNITS[name], np.max(thermal.fits[name].after))


def _parts(thermal: ThermalCalibration) -> str:
    """Return what was left out of the fit and predicted."""
    return "ramps" if len(thermal.identifiability.legs) > 3 else "stretches"


def _verdict(thermal: ThermalCalibration) -> Iterator[str]:
    jumps = ", jumps included" * bool(thermal.jumps)
    span = "{:.0f} and {:.0f} °C".format(*thermal.blocks.range).replace("-", "−")
    for name, fit in thermal.fits.items():
        after = "no model of temperature improves it"
        if fit.candidate.names:
            after = f"with the model {_size(name, fit.after)} remain{jumps}"
        yield f"The {name}'s output at rest moves by {_size(name, fit.before)} (rms) between {span}; {after}."
    if all(part.apart < ENOUGH for part in thermal.identifiability.parts.values()):
        yield (
            "The recordings cannot separate temperature from its rate: use the calibration only where the temperature "
            "changes as it did here."
        )


def _number(thermal: ThermalCalibration) -> tuple[str, str]:
    corrected = [name for name, fit in thermal.fits.items() if fit.candidate.names]
    name = [*corrected, *thermal.fits][0]
    fit = thermal.fits[name]
    before, after = (float(np.linalg.norm(held.rms)) for held in (fit.held_before, fit.candidate.held))
    meaning = f"left of the {name}'s output, all axes together (rms), on {_parts(thermal)} that the fit did not use"
    meaning += ", jumps apart" * bool(thermal.jumps)
    return size(after, SENSOR_UNITS[name]), f"{meaning}: {how_much_smaller(before, after)} than without a model"


def _band_picture(thermal: ThermalCalibration, name: str) -> Picture:
    return Picture(
        f"bias_{name}",
        partial(band_figure, thermal, name),
        f"Bias of the {name} over temperature with its band",
        f"The {name}'s bias at steady temperature, counted from {thermal.reference:g} °C, with its 95 % band. The "
        "level of each rest, jumps included, is taken off the dots; dots off the band, warming on one side and "
        "cooling on the other, show a rate, a lag or a hysteresis.",
    )


def _remainder(thermal: ThermalCalibration) -> Table:
    rows = []
    jumps = ", jumps included" * bool(thermal.jumps)
    for name, fit in thermal.fits.items():
        factor, unit = _unit(thermal, name)
        sizes = factor * np.stack([fit.before, fit.after, fit.candidate.held.rms], axis=1)
        for axis, family, row in zip("xyz", fit.families, sizes.tolist(), strict=True):
            before, after, left_out = map(number, row)
            after += " (not corrected)" * (family == "constant")
            rows.append((f"{name} {axis} [{unit}]", before, after, left_out))
    return Table(
        ("output, rms", "over temperature", f"left by the model{jumps}", f"on {_parts(thermal)} left out"),
        rows,
        f"The {_parts(thermal)} left out are predicted from all other blocks, with what they show of slow noise: that "
        "may leave less than the model alone.",
    )


def _model(thermal: ThermalCalibration, name: str) -> Statement:
    fit = thermal.fits[name]
    effects = [effect_title(f"{PREFIXES[name]}.{effect}") for effect in fit.candidate.names]
    before, after = (_size(name, held.rms) for held in (fit.held_before, fit.candidate.held))
    apart = " (jumps apart)" * bool(thermal.jumps)
    text = f"No effect of temperature improves the prediction of {_parts(thermal)} left out: {after} remain{apart}."
    if effects:
        text = f"With {listed(effects)}, {after} remain on {_parts(thermal)} left out{apart}, {before} without a model."
    return Statement(f"Model of the {name}", text)


def _candidates(thermal: ThermalCalibration) -> Iterator[Part]:
    for name in thermal.fits:
        yield Section(sentence(name), [candidate_table(thermal, name)], 3)
    yield (
        "The arrow marks the simplest of those that did best: by log-likelihood on what was left out and in all, less "
        "the information criterion's penalty, counted from the best."
    )
    yield from _ambient(thermal)


def candidate_table(thermal: ThermalCalibration, name: str) -> Table:
    """Return family, effects, rms on what was left out and score of each model; those chosen first, with their axes."""
    fit = thermal.fits[name]
    best = np.max([candidate.scores for candidate in fit.candidates], axis=0)
    candidates = sorted(
        fit.candidates, key=lambda one: (one.family not in fit.families, one.family != CUBIC, -one.score)
    )
    rows = []
    for candidate in candidates:
        axes = [axis for axis, family in zip("xyz", fit.families, strict=True) if family == candidate.family]
        chosen = "" if not axes else "→ " if len(axes) == 3 else f"→ {', '.join(axes)}: "
        title = f"{candidate.family} (as the autopilots fit it)" if candidate.family == CUBIC else candidate.family
        gap = (candidate.scores - best).sum()
        effects = "; ".join(effect_title(f"{PREFIXES[name]}.{one}").removeprefix(f"{name} ") for one in candidate.names)
        rows.append(
            (chosen + title, effects or "none", _size(name, candidate.held.rms), f"{gap:+.1f}".replace("-", "−"))
        )
    chosen_rows = range(len({*fit.families}))
    return Table(
        ("model", "effects kept by the information criterion", "left out, rms", "score, nats"),
        rows,
        "",
        chosen_rows,
        brief=max(3, len(chosen_rows)),
    )


def effect_table(calibration: Calibration) -> Table:
    """Return effects' coefficients ± 95 %, three a row, and each inner parameter, of curves the largest change."""
    rows = []
    document = calibration.document()
    curves = False
    effects = ((owner, *effect) for owner in calibration.triads() for effect in document[owner]["effects"].items())
    for triad, name, entry in effects:
        plain = name.partition(".")[2]
        if plain in (LEARNED, NETWORK):
            curves = True
            rows.append((f"{effect_title(name)}, largest change", *_largest_change(calibration, triad, plain)))
        else:
            rows += _coefficient_rows(effect_title(name), entry)
        for key, parameter in entry["inner"].items():
            spread = parameter.get("sigma")
            value = number(parameter["value"], 4) if spread is None else with_interval(parameter["value"], spread)
            rows.append((f"  {key.replace('_', ' ')}", value, "", "", unit_text(parameter["unit"])))
    low, high = (number(end) for end in calibration.data["temperature_range"])
    caption = (
        f"In y = gain·u + bias + effects, counted from {calibration.imu.accelerometer.temperature_reference:g} °C, ± "
        f"half of the 95 % interval. They hold from {low} to {high} °C; beyond is extrapolation, and compensation "
        "reports it. Gain and bias are in calibration.json."
    )
    if curves:
        caption += " Of a learned curve the table has the largest change of steady bias in this range."
    return Table(("effect", "x", "y", "z", "unit"), rows, caption)


def _coefficient_rows(title: str, entry: Json) -> list[tuple[str, ...]]:
    coefficients = entry["coefficients"]
    sigma = entry["sigma"] or [0.0] * len(coefficients)
    factor, unit = readable(entry["unit"], max(map(abs, coefficients)))
    cells = [
        "–" if value == spread == 0 else with_interval(factor * value, factor * spread)
        for value, spread in zip(coefficients, sigma, strict=True)
    ]
    cells += [""] * (-len(cells) % 3)
    return [("" if k else title, *cells[k : k + 3], unit) for k in range(0, len(cells), 3)]


def _largest_change(calibration: Calibration, owner: str, plain: str) -> tuple[str, ...]:
    """Return the largest change of steady bias that an effect makes over the range, ± 95 %, by axis, and the unit."""
    low, high = calibration.data["temperature_range"]
    temperature = np.linspace(low, high, 101)
    scale = calibration.triads()[owner].scales
    value, sigma = (values / scale for values in change(calibration, owner, (plain,), temperature))
    rows = np.abs(value).argmax(axis=0), np.arange(3)
    factor, unit = readable(SENSOR_UNITS[owner], np.abs(value).max())
    cells = zip(factor * value[rows], factor * sigma[rows], strict=True)
    return *(with_interval(largest, spread) for largest, spread in cells), unit


def _rest(thermal: ThermalCalibration) -> Iterator[Part]:
    """Return the temperatures covered, each sensor's surface and residuals, and how it was done."""
    yield Section(
        "Temperatures covered",
        [
            Picture(
                "covered",
                partial(covered_figure, thermal),
                "Temperatures and rates covered",
                "Each dot is a block of the recording. Where dots lie on one line only, temperature and its rate go "
                "together, and their effects cannot be separated.",
            )
        ],
    )
    for name in thermal.fits:
        yield Section(
            f"The {name}",
            [
                Picture(
                    f"surface_{name}",
                    partial(surface_figure, thermal, name),
                    f"Bias of the {name} over temperature and its rate",
                    f"The {name}'s bias, counted from {thermal.reference:g} °C: the model as a surface, as far as the "
                    "data go, and the data as dots, less the level of each rest.",
                ),
                Picture(
                    f"residual_{name}",
                    partial(residual_figure, thermal, name),
                    f"Residuals of the {name}",
                    "Residuals of the model, less the level of each rest, jumps included; a slope, a curve or two "
                    "colours apart would be something it misses.",
                ),
            ],
        )
    yield Section(
        "How it was done",
        [
            f"{len(thermal.blocks)} blocks of {thermal.blocks.duration:.3g} s. The rate of temperature is the slope "
            f"of a line through {TEMPERATURE_WINDOW:g} s (attenuates {RATE_BANDWIDTH:.2g} Hz by 29 %). Least squares "
            "with the covariance of the noise, which ties blocks to each other: a long soak counts for no more than "
            f"it contains, and slow bias does not pass for temperature. jaximu {thermal.software['version']}."
        ],
    )


def _ways(thermal: ThermalCalibration) -> list[Part]:
    weak = [name for name, part in thermal.identifiability.parts.items() if part.apart < ENOUGH]
    if not weak:
        return []
    now, options = next_ramps(thermal.blocks)
    then = options[0].parts
    if all(then[name].apart < _WORTH * now[name].apart for name in weak):
        return []
    return [
        Statement(
            "What to record next",
            f"{sentence(options[0].text)}, with a soak at each end ({options[0].duration / 60:.0f} min), and give both "
            "recordings to `jaximu thermal`: of the ramps tried it separates best what looks alike now.",
            True,
        ),
        Table(
            ("effect", "share that no other can imitate, now", "with that ramp"),
            [(name.replace("_", " "), *(_share(parts[name].apart) for parts in (now, then))) for name in weak],
        ),
    ]


def _share(share: float) -> str:
    return f"{number(100 * share, 2)} %" if share > _LEAST_SHARE else f"< {100 * _LEAST_SHARE:g} %"


def _ambient(thermal: ThermalCalibration) -> Iterator[Statement]:
    """Say what a regression on the sensor's and the ambient temperature and their rates would leave, where it is known.

    The full quadratic of the four has 15 terms, of which an information criterion keeps some.
    """
    blocks = thermal.blocks
    if blocks.ambient is None or np.ptp(blocks.ambient) < LEAST_RANGE or len(blocks) < _ROWS:
        return
    rate = np.concatenate(
        [
            smoothed_slope((blocks.start + blocks.stop)[rows] / 2, blocks.ambient[rows], 3 * blocks.duration)
            for rows in (blocks.log == log for log in range(len(blocks.recordings)))
        ]
    )
    factors = {"T": blocks.temperature, "dT": blocks.rate, "To": blocks.ambient, "dTo": rate}
    for name, fit in thermal.fits.items():
        added = blocks.means[name] - fit.level.T[blocks.level]
        fits = [multifactor(factors, values) for values in added.T]
        held = np.array([rms for _, rms in fits])
        kept = max(len(terms) for terms, _ in fits)
        yield Statement(
            f"Regression of the {name} on sensor and ambient temperature and their rates",
            f"At most {kept} of 15 terms kept: {_size(name, held)} rms on fifths left out, against "
            f"{_size(name, fit.candidate.held.rms)} of the model above on {_parts(thermal)} left out.",
        )


def loss_words(parameters: AutopilotParameters, thermal: ThermalCalibration) -> str:
    """Say what the cubics written for an autopilot leave of the recordings, beside the full model."""
    parts = [
        f"{_size(name, left)} rms of the {name}'s output, the full model {_size(name, thermal.fits[name].after)}"
        for name, left in parameters.left.items()
    ] or [
        f"{_size(name, loss)} rms between them and the {name}'s full model at steady temperatures"
        for name, loss in parameters.loss.items()
    ]
    return f"The numbers written for {parameters.name} leave {'; '.join(parts)}."


# --- pictures ---------------------------------------------------------------------------------------------------------


def residual_dots(thermal: ThermalCalibration, name: str) -> FloatArray:
    """Return what the model leaves of each block (n, 3), SI, about its mean at each level: jumps are no residuals."""
    residual = thermal.fits[name].residual
    level = thermal.blocks.level
    mean = np.stack([np.bincount(level, axis) / np.bincount(level) for axis in residual.T], axis=1)
    return residual - mean[level]


def bias_dots(thermal: ThermalCalibration, name: str) -> FloatArray:
    """Return what temperature added to each block (n, 3), SI: the data less the level of its rest, jumps included."""
    return thermal.fits[name].fitted + residual_dots(thermal, name)


def _both_ways(thermal: ThermalCalibration) -> list[tuple[np.ndarray, dict[str, Any]]]:
    """Return the blocks while it warms and while it cools, as masks (n,), and how they are drawn."""
    up = np.zeros(len(thermal.blocks), bool)
    for leg in thermal.identifiability.legs:
        up[leg.blocks] = leg.up
    parts = [(up, {"color": "#D55E00", "label": "warming"}), (~up, {"color": "#0072B2", "label": "cooling"})]
    return [(part, style) for part, style in parts if part.any()]


def _plot_both_ways(panel: Axes, thermal: ThermalCalibration, x: FloatArray, y: FloatArray, dot: float) -> None:
    """Draw values (n,) of the blocks as dots this large, in one colour while it warms and another while it cools."""
    for part, style in _both_ways(thermal):
        panel.plot(x[part], y[part], ".", ms=dot, **style)


def _within_data(thermal: ThermalCalibration, temperature: FloatArray, rates: FloatArray) -> np.ndarray:
    """Return at which rates and temperatures (r, m) there are blocks, or blocks on either side at that temperature."""
    blocks = thermal.blocks
    margin = _BESIDE_DATA * np.ptp(rates)
    near = np.abs(temperature[:, None] - blocks.temperature) < _BESIDE_DATA * np.ptp(temperature)
    low = np.where(near, blocks.rate, np.inf).min(axis=1) - margin
    high = np.where(near, blocks.rate, -np.inf).max(axis=1) + margin
    return (low <= rates[:, None]) & (rates[:, None] <= high)


def _cells(points: FloatArray, drawn: np.ndarray) -> FloatArray:
    """Return the corners (k, 4, 3) of a grid's cells, of points (r, m, 3), whose four corners are all drawn (r, m)."""
    corners = [(slice(None, -1),) * 2, (slice(1, None), slice(None, -1)), (slice(1, None),) * 2]
    corners.append((slice(None, -1), slice(1, None)))
    whole = np.all([drawn[corner] for corner in corners], axis=0)
    return np.stack([points[corner][whole] for corner in corners], axis=1)


def surface_figure(thermal: ThermalCalibration, name: str) -> Figure:
    """Draw the bias over temperature and its rate with the data on it, an axis a panel."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    factor, unit = _unit(thermal, name)
    blocks = thermal.blocks
    figure = new_figure(4.2)
    temperature = np.linspace(*blocks.range, 61)
    rates = np.linspace(blocks.rate.min(), blocks.rate.max(), 41)
    surface = np.stack([thermal.bias(name, temperature, rate)[0] for rate in rates])  # (r, m, 3)
    drawn = _within_data(thermal, temperature, rates)
    data = bias_dots(thermal, name)
    x, y = np.meshgrid(temperature, 60 * rates)
    for axis in range(3):
        panel: Any = figure.add_subplot(1, 3, axis + 1, projection="3d")
        cells = _cells(np.stack([x, y, factor * surface[:, :, axis]], axis=-1), drawn)
        panel.add_collection3d(Poly3DCollection(cells, facecolors="#888888", alpha=0.45, linewidth=0))
        panel.auto_scale_xyz(*cells.reshape(-1, 3).T)
        for part, style in _both_ways(thermal):
            few = np.flatnonzero(part)[:: 1 + len(blocks) // _MOST_DOTS]
            panel.scatter(
                blocks.temperature[few],
                60 * blocks.rate[few],
                factor * data[few, axis],
                s=4,
                depthshade=False,
                **style,
            )
        panel.set_title(f"{'xyz'[axis]} [{unit}]", fontsize=11, fontweight="bold")
        panel.set_xlabel("T [°C]", fontsize=8)
        panel.set_ylabel("rate [K/min]", fontsize=8)
        panel.tick_params(labelsize=7)
    return figure


def band_figure(thermal: ThermalCalibration, name: str) -> Figure:
    """Draw the bias over temperature with its 95 % band, the data, and the cubic that autopilots fit."""
    factor, unit = _unit(thermal, name)
    temperature = np.linspace(*thermal.blocks.range, 201)
    value, sigma = thermal.bias(name, temperature)
    data = factor * bias_dots(thermal, name)
    figure, panels = beside(3, 3.4)
    for axis, panel in enumerate(panels):
        _plot_both_ways(panel, thermal, thermal.blocks.temperature, data[:, axis], 2.5)
        low, high = (factor * (value + sign * Z95 * sigma)[:, axis] for sign in (-1, 1))
        panel.fill_between(temperature, low, high, color="0.5", alpha=0.35, linewidth=0)
        panel.plot(temperature, factor * value[:, axis], color="black", lw=1.1, label="steady, with 95 % band")
        dressed(panel, f"{sentence(name)} {'xyz'[axis]} [{unit}]", xlabel="temperature [°C]")
    legend(panels[0])
    return figure


def residual_figure(thermal: ThermalCalibration, name: str) -> Figure:
    """Draw what the model leaves of each block against temperature and time, up and down in two colours."""
    factor, unit = _unit(thermal, name)
    blocks = thermal.blocks
    residual = factor * residual_dots(thermal, name)
    figure = new_figure(6.0)
    grid = figure.subplots(3, 2, sharey="row", sharex="col")
    for row, axis, values in zip(grid, "xyz", residual.T, strict=True):
        for panel, x in zip(row, (blocks.temperature, blocks.time / 3600), strict=True):
            _plot_both_ways(panel, thermal, x, values, 3)
            dressed(panel, level=0.0)
        row[0].set_ylabel(f"{name} {axis} [{unit}]", fontsize=9)
    dressed(grid[0, 0], "Residual bias by temperature")
    dressed(grid[0, 1], "by time")
    legend(grid[0, 0], 2)
    grid[2, 0].set_xlabel("temperature [°C]")
    grid[2, 1].set_xlabel("time [h]")
    return figure


def covered_figure(thermal: ThermalCalibration) -> Figure:
    """Draw the temperatures and rates that the recordings went through."""
    blocks = thermal.blocks
    figure, (left, right) = beside(2, 3.4)
    _plot_both_ways(left, thermal, blocks.temperature, 60 * blocks.rate, 4)
    _plot_both_ways(right, thermal, blocks.time / 3600, blocks.temperature, 3)
    dressed(
        left,
        "Temperatures and rates covered",
        0.0,
        1,
        xlabel="temperature [°C]",
        ylabel="rate of temperature [K/min]",
    )
    dressed(right, "Over time", xlabel="time [h]", ylabel="temperature [°C]")
    return figure
