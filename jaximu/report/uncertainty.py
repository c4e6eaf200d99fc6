"""Where a calibration is still uncertain: corrected force over orientation, rate over rate, both over temperature."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from jaximu.acceptance.epochs import over_temperature, without_gravity
from jaximu.calibration import Calibration
from jaximu.estimation.projection import OutputUncertainty
from jaximu.estimation.uncertainty import direction_words
from jaximu.ground.array_types import BoolArray, FloatArray
from jaximu.ground.page import Part, Picture, Statement
from jaximu.ground.quantities import Z95, listed, number, readable, size
from jaximu.model.stimulus import Stimulus
from jaximu.report import figures
from jaximu.report.evidence import evidence
from jaximu.report.export import Range

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import GridSpec


Known = Callable[[Stimulus], dict[str, OutputUncertainty]]
Rest = Callable[[FloatArray], Stimulus]

_APART = 1e6  # s between samples: whatever lags has settled
_STEPS = 41
_GRID = np.linspace(-1.0, 1.0, 81)
_LEAST_RANGE = 0.8
"""Share of the worst value at which the colours begin at the latest: a map that is alike everywhere looks alike."""
_FACES = np.concatenate([np.eye(3), -np.eye(3)])


def steady(up: FloatArray, gravity: float, temperature: Any, rate: FloatArray | float = 0.0) -> Stimulus:
    """Return what a unit goes through in steady states.

    **Arguments:** `up` (n, 3): which way is up in the body; `gravity`: m/s²; `temperature`: °C; `rate` (n, 3): rad/s.
    """
    nothing = np.zeros(len(up))
    none = np.zeros_like(up)
    return Stimulus(
        specific_force=gravity * up,
        angular_rate=none + rate,
        angular_acceleration=none,
        temperature=nothing + temperature,
        temperature_rate=nothing,
        time=_APART * np.arange(len(up)),
        attitude=np.tile([1.0, 0.0, 0.0, 0.0], (len(up), 1)),
        vibration_power=nothing,
        magnetic_field=none,
        current=nothing,
    )


def uncertainty_parts(calibration: Calibration) -> Iterator[Part]:
    """Return what is uncertain of the corrected output, in sentences and pictures.

    Gravity's error is stated beside: it is alike in every orientation, and no pose makes it smaller.
    """
    triads, recorded, extent = calibration.triads(), without_gravity(calibration), Range.of(calibration)
    if "accelerometer" in triads:
        errors = evidence(calibration)
        poses, after = (np.zeros((0, 3)), []) if errors is None else (errors.directions, errors.norm_after)
        names = [f"pose {index}: error {size(error, 'm/s^2', 2)}" for index, error in enumerate(after, 1)]
        half = at_rest(calibration)
        yield Statement("At rest", " ".join(_at_rest(calibration, half)))
        if np.isfinite(half).any():
            yield Picture(
                "orientations",
                partial(sphere_figure, half, poses, names),
                "Map of the uncertainty of the corrected specific force at rest over orientation, with the poses",
                "The two halves of the sphere of directions that point up in the body, seen along z, areas true. "
                "Colours: 95 % of the corrected specific force at rest, along the direction in which it is least "
                "certain; misalignment counts against the body frame. Cross: the worst. "
                + "Numbers: the poses. " * bool(len(poses))
                + "Noise of single samples is not part of it, nor what the model lacks.",
            )
    if "gyroscope" in triads:
        yield Statement("Turning", _turning(recorded, extent))
    panels = [panel for panel in _panels(recorded, extent) if np.isfinite(panel[-1]).any()]
    if panels:
        yield Picture(
            "uncertainty",
            partial(_curves_figure, panels),
            "Uncertainty of the corrected output over rate and temperature",
            "95 % of the corrected output along the direction in which it is least certain, z up while turning; gaps "
            "are not determined. Biases are those after the recording, without another power-on.",
        )


def at_rest(calibration: Calibration) -> FloatArray:
    """Return `over_sphere` of a calibration, without gravity's own error."""
    rest = partial(
        steady, gravity=calibration.gravity.value, temperature=float(np.mean(Range.of(calibration).temperature))
    )
    return over_sphere(without_gravity(calibration).uncertainty_of, rest)


def over_sphere(known: Known, rest: Rest) -> FloatArray:
    """Return half the 95 % interval of the corrected specific force at rest at the points of the map (2, n, n), m/s².

    **Arguments:** `known`: the uncertainty of the output at an input; `rest`: what the unit goes through with some
    directions (n, 3) up.
    """
    _, points = _map_points()
    return Z95 * known(rest(points.reshape(-1, 3)))["accelerometer"].largest.reshape(points.shape[:-1])


def _at_rest(calibration: Calibration, half: FloatArray) -> Iterator[str]:
    """Say where the corrected force is least certain, and what that means; `half`: over the sphere."""
    (inside, points), gravity = _map_points(), calibration.gravity
    directions = points[:, inside].reshape(-1, 3)
    half = half[:, inside].reshape(-1)
    worst = int(half.argmax())
    where = f"the direction {direction_words(directions[worst])}"
    if not np.isfinite(half).all():
        sheet = [name for name in calibration.from_data_sheet if name.startswith("accelerometer")]
        why = f"the {listed(sheet)} is the data sheet's" if sheet else "a combination of parameters is open"
        yield f"With {where} up the corrected specific force is not determined: {why}."
        return
    tilt = np.degrees(half[worst] / gravity.value)
    yield (
        f"The corrected specific force is least certain with {where} up: ±{size(half[worst], 'm/s^2', 2)} (95 %, along "
        f"its worst direction), {number(tilt, 2)}° if it is used as a level; in the best orientation it is "
        f"±{size(half.min(), 'm/s^2', 2)}. `jaximu plan CALIBRATION` chooses the poses that make it smaller."
    )
    if calibration.gravity_shift().any():
        yield (
            f"Gravity's own uncertainty adds ±{size(Z95 * gravity.sigma, 'm/s^2', 2)} along the vertical in every "
            "orientation, which no pose makes smaller: state the local gravity."
        )


def _rate_known(calibration: Calibration, extent: Range, rates: FloatArray) -> FloatArray:
    """Return half the 95 % interval (n,) of the corrected rate, °/s, z up while turning at rates (n, 3), rad/s."""
    stimulus = steady(np.tile([0.0, 0.0, 1.0], (len(rates), 1)), extent.gravity, np.mean(extent.temperature), rates)
    return Z95 * np.degrees(calibration.uncertainty_of(stimulus)["gyroscope"].largest)


def _turning(calibration: Calibration, extent: Range) -> str:
    half = _rate_known(calibration, extent, np.concatenate([np.zeros((1, 3)), extent.rate * _FACES]))
    worst = 1 + int(half[1:].argmax())
    still, turning = (
        f"known to ±{number(value, 2)} °/s (95 %)" if np.isfinite(value) else "not determined"
        for value in (half[0], half[worst])
    )
    end = f"{np.degrees(extent.rate):.4g} °/s about {direction_words(_FACES[worst - 1])}, the worst axis"
    return f"The corrected rate is {still} at rest, and {turning} at {end}."


def _panels(calibration: Calibration, extent: Range) -> Iterator[tuple[str, str, str, dict[str, FloatArray], Any]]:
    """Return title, words of both axes, lines by name and their heights (lines, n) of each panel."""
    if "gyroscope" in calibration.triads():
        rates = np.linspace(0.0, np.degrees(extent.rate), _STEPS)
        both = np.radians(rates)[:, None, None] * _FACES
        half = _rate_known(calibration, extent, both.reshape(-1, 3)).reshape(-1, 2, 3)
        yield "Rate while turning", "rate (°/s)", "± 95 % (°/s)", {axis: rates for axis in "xyz"}, half.max(axis=1).T
    warm = over_temperature(calibration)
    low, high = calibration.data.get("temperature_range", extent.temperature)
    temperatures = np.linspace(low, high, _STEPS)
    stimulus = steady(np.tile(_FACES, (len(temperatures), 1)), extent.gravity, temperatures.repeat(len(_FACES)))
    uncertainty = calibration.uncertainty_of(stimulus) if warm & {"accelerometer", "gyroscope"} else {}
    for name, title, factor, unit in (
        ("accelerometer", "Specific force at rest, the worst of six faces up", 1e3, "mm/s²"),
        ("gyroscope", "Rate at rest", np.degrees(1.0), "°/s"),
    ):
        if name in warm:
            half = factor * Z95 * uncertainty[name].largest.reshape(-1, len(_FACES)).max(axis=1)
            yield title, "temperature (°C)", f"± 95 % ({unit})", {"": temperatures}, half[None]


def _map_points() -> tuple[BoolArray, FloatArray]:
    """Return which points (n, n) of the map's grid are on it, and the directions (2, n, n, 3) of both halves."""
    x, y = np.meshgrid(_GRID, _GRID)
    return x**2 + y**2 <= 1, np.stack([figures.raised_to_sphere(x, y, sign) for sign in (1, -1)])


def _curves_figure(panels: list) -> Figure:
    figure, grid = figures.stacked(len(panels), 2.6, 0.0, width=6.4)
    for axes, (title, across, up, lines, heights) in zip(grid, panels, strict=True):
        for (name, values), height in zip(lines.items(), heights, strict=True):
            axes.plot(
                values,
                np.where(np.isfinite(height), height, np.nan),
                color=figures.AXES.get(name, figures.AFTER),
                linewidth=1.8,
                label=f"about {name}" if name else None,
            )
        figures.dressed(axes, title, xlabel=across, ylabel=up, ylim=(0, None))
        if len(lines) > 1:
            figures.legend(axes, 3, "upper left")
    return figure


def poses_on_sphere(
    poses: FloatArray, names: Sequence[str], colors: Sequence[str] = ()
) -> tuple[Figure, list[Axes], GridSpec]:
    """Draw directions (P, 3) with their numbers on both halves of the sphere, hatched where nothing is known.

    **Arguments:** `names`: of the directions; `colors`: theirs, white if there are none.
    """
    from matplotlib.patches import Circle

    figure = figures.new_figure(4.6, 6.8)
    panels, grid = figures.hemispheres(
        figure,
        2,
        poses,
        names,
        np.array(colors or ["white"] * len(poses), dtype=object),
        s=60,
        edgecolors="black",
        linewidths=0.9,
    )
    for axes, sign, here, spot in panels:
        axes.add_patch(Circle((0, 0), 1, facecolor="white", edgecolor="#777777", hatch="///", linewidth=0, zorder=0))
        figures.number_dots(axes, spot, np.flatnonzero(here) + 1)
        middle, way = ("+z", "up") if sign > 0 else ("−z", "down")
        axes.set_title(f"z {way} ({middle} in the middle)", fontsize=10)
    return figure, [axes for axes, *_ in panels], grid


def sphere_figure(
    half: FloatArray,
    poses: FloatArray,
    names: Sequence[str],
    called: str = "Least certain",
    colors: Sequence[str] = (),
    most: float | None = None,
) -> Figure:
    """Draw how uncertain the corrected specific force is at rest over orientation, and where poses were or will be.

    **Arguments:** `half`: as `over_sphere` returns it; `poses` (P, 3): directions, with their `names` and `colors`;
    `most`: m/s² at the end of a scale that begins at zero, for maps that are compared; None: of this map alone.
    """
    import matplotlib
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap
    from matplotlib.patches import Circle
    from matplotlib.ticker import MaxNLocator

    figure, panels, grid = poses_on_sphere(poses, names, colors)
    inside, points = _map_points()
    finite = half[np.isfinite(half)]
    factor, unit = readable("m/s^2", float(finite.max()))
    best = factor * float(finite.min())
    worst = factor * float(finite.max())
    span = (min(best, _LEAST_RANGE * worst), worst) if most is None else (0.0, max(factor * most, worst))
    half = factor * half
    levels = MaxNLocator(8, steps=[1, 2, 2.5, 5, 10]).tick_values(*span)
    colormap = LinearSegmentedColormap.from_list("", matplotlib.colormaps["YlGnBu"](np.linspace(0.0, 0.6, 64)))
    norm = BoundaryNorm(levels, colormap.N)
    at = np.unravel_index(int(np.where(inside, half, -1.0).argmax()), half.shape)
    for panel, axes in enumerate(panels):
        edge = Circle((0, 0), 1, transform=axes.transData)
        shades = axes.contourf(
            _GRID, _GRID, np.ma.masked_invalid(half[panel]), levels=levels, norm=norm, cmap=colormap, zorder=1
        )
        shades.set_clip_path(edge)
        if at[0] == panel:
            text = f"±{number(half[at], 2)} {unit}" if np.isfinite(half[at]) else "not determined"
            x, y = _GRID[at[2]], _GRID[at[1]]
            axes.plot(x, y, "x", color="#CC0033", markersize=11, markeredgewidth=2.4, zorder=4)
            style = {"fontsize": 10, "color": "#CC0033", "fontweight": "bold", "zorder": 6, "ha": "center"}
            box = {"facecolor": "white", "alpha": 0.75, "linewidth": 0, "pad": 1.0}
            axes.annotate(text, (0.75 * x, y), (0, -17), textcoords="offset points", bbox=box, **style)
    bar = figure.colorbar(ScalarMappable(norm, colormap), cax=figure.add_subplot(grid[1, :2]), orientation="horizontal")
    bar.set_label(f"specific force at rest, ± 95 % ({unit})", fontsize=10)
    what = called if np.isfinite(half[at]) else "Not determined"
    figures.headed(figure, f"{what} with the direction {direction_words(points[at])} up")
    return figure
