"""The page of what errors do to navigation: the budget of position over time, tracks of draws, noise for estimators."""

import shlex
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.page import Code, Items, Page, Picture, Section, Statement, Table
from jaximu.ground.quantities import Z95, number, sentence
from jaximu.navigation.consequences import Consequences, position
from jaximu.navigation.estimator_noise import EstimatorNoise
from jaximu.report import figures
from jaximu.report.canvas import Figure
from jaximu.report.figures import LEAST_SHARE, OTHERS, PALETTE, dressed, legend, legend_below

_SHOWN = (1.0, 10.0, 60.0, 600.0)  # s
_COMMON = 0.1  # by how much the calibration's terms together may differ from their root sum of squares unsaid


def page_of(
    consequences: Consequences,
    noise: Mapping[str, EstimatorNoise] = MappingProxyType({}),
    files: Mapping[str, bytes] = MappingProxyType({}),
) -> Page:
    """Return the budget of position over time; `noise` for estimators, by where it is from, and its `files`."""
    tracks = Picture(
        "tracks",
        partial(_tracks_figure, consequences),
        "Tracks of position error of all draws",
        "Each line is one draw of all errors, through the whole mechanisation: a unit as good as this calibration "
        "says. The ellipse holds 95 % of the draws if the budget is right.",
    )
    return Page(
        f"Navigating by {Path(consequences.calibration_file).name} alone",
        _verdict(consequences),
        _metres(_at_end(consequences.total)),
        f"error of position after {_end(consequences)} (1σ)",
        (
            Picture(
                "budget",
                partial(_budget_figure, consequences),
                "Position error over time, and the share of each term",
                "Above: the error of position in space (1σ) and its largest terms. Below: how the squares of the "
                "terms share the sum.",
            ),
            f"Path: {consequences.trajectory.words}. Position, velocity and attitude at the start are taken as known "
            "exactly.",
            *_statements(consequences),
            *_tables(consequences),
            *_for_estimators(noise, files),
        ),
        lambda: () if consequences.check is None else (tracks,),
        consequences.notes,
        _next(consequences),
    )


def _verdict(consequences: Consequences) -> tuple[str, ...]:
    name = _order(consequences)[0]
    return (
        f"Navigating by this unit alone, position is off by {_metres(_at_end(consequences.total))} (1σ) after "
        f"{_end(consequences)}.",
        f"The largest term is {name}: {_metres(_at_end(consequences.terms[name]))} by itself.",
    )


def _next(consequences: Consequences) -> str:
    if _at_end(consequences.calibration) < _at_end(consequences.noise):
        return ""
    file = consequences.calibration_file
    file = shlex.quote(file) if Path(file).suffix else "CALIBRATION"
    return f"`jaximu plan {file} -o plan` plans the poses and turns that improve the calibration most."


def _tables(consequences: Consequences) -> Iterator[Section]:
    times = [f"after {_seconds(consequences.times[row])}" for row in _places(consequences)]
    yield Section(
        "Position error by term (1σ)",
        [
            Table(
                ("", *times),
                _budget_rows(consequences),
                "Position: root sum of squares of east, north and up. A term is what it makes by itself; correlated "
                "terms of the calibration together are in the row “calibration, all together”. To first order along "
                "the path.",
                brief=8,
            )
        ],
    )
    yield Section("All errors, by direction (1σ)", [Table(("", *times), [*_total_rows(consequences)])])


def _for_estimators(noise: Mapping[str, EstimatorNoise], files: Mapping[str, bytes]) -> Iterator[Section]:
    for origin, one in noise.items():
        page = one.summary()
        yield Section(f"Noise for estimators, {origin}", (*page.verdict, *page.first, Items(page.notes)))
    yield Section(
        "Files for estimators", [Section(name, [Code(text.decode().rstrip())], 3) for name, text in files.items()]
    )


# --- words ------------------------------------------------------------------------------------------------------------


def _metres(value: float) -> str:
    for factor, unit in ((1e-3, "km"), (1.0, "m"), (1e3, "mm"), (1e6, "µm")):
        if value * factor >= 1.0:
            return f"{number(value * factor, 2 if value * factor < 100 else 3)} {unit}"
    return "below 1 µm"


def _seconds(value: float) -> str:
    return f"{round(value, 1):g} s"


def _at_end(variances: FloatArray) -> float:
    """Return the error of position at the end of the path."""
    return position(variances)[-1]


def _end(consequences: Consequences) -> str:
    return _seconds(consequences.times[-1])


def _places(consequences: Consequences) -> list[int]:
    """Rows of the times that are shown: 1, 10, 60, 600 s and the last, as far as the path goes."""
    wanted = [time for time in _SHOWN if time < consequences.times[-1]]
    nearest = [int(np.abs(consequences.times - time).argmin()) for time in wanted]
    return list(dict.fromkeys([*nearest, len(consequences.times) - 1]))


def _order(consequences: Consequences) -> list[str]:
    return sorted(consequences.terms, key=lambda name: -_at_end(consequences.terms[name]))


def _budget_rows(consequences: Consequences) -> list[tuple[str, ...]]:
    rows = _places(consequences)

    def row(name: str, variances: FloatArray) -> tuple[str, ...]:
        return name, *(_metres(error) for error in position(variances)[rows])

    shown = [row("everything", consequences.total)]
    if consequences.check is not None:
        shown.append(row(f"everything, {len(consequences.check.errors)} draws", consequences.check.sigma**2))
    shown.append(row("calibration, all together", consequences.calibration))
    return [*shown, *(row(name, consequences.terms[name]) for name in _order(consequences))]


def _total_rows(consequences: Consequences) -> Iterator[tuple[str, ...]]:
    rows = _places(consequences)
    sigma = np.sqrt(consequences.total)
    parts = (
        ("position, ", _metres),
        ("velocity, ", lambda value: f"{_metres(value)}/s"),
        ("attitude, about ", lambda value: f"{number(np.degrees(value), 2)}°"),
    )
    for part, (what, words) in enumerate(parts):
        for axis, direction in enumerate(("east", "north", "up")):
            yield what + direction, *map(words, sigma[rows, 3 * part + axis])


def _statements(consequences: Consequences) -> Iterator[Statement]:
    last = _at_end(consequences.total)
    end = _end(consequences)
    parts = [
        f"{name} from {round(start, 1):g} to {round(stop, 1):g} s" for name, start, stop in consequences.dominant()
    ]
    more = f" and {len(parts) - 6} changes more" if len(parts) > 6 else ""
    yield Statement("What dominates when", sentence(f"{'; '.join(parts[:6])}{more}."))

    def better(variances: FloatArray) -> float:
        return _at_end(variances + consequences.noise)

    best = min(consequences.known, key=lambda name: better(consequences.known[name]))
    buys = (
        f"Were {best} known exactly, the error after {end} would fall from {_metres(last)} to "
        f"{_metres(better(consequences.known[best]))}; with the whole calibration ten times better, to "
        f"{_metres(better(consequences.calibration / 100))}."
    )
    if consequences.noise.any():
        buys += f" Noise alone leaves {_metres(_at_end(consequences.noise))}, which no calibration can undo."
    yield Statement("What a better calibration buys", buys)
    apart = np.sqrt(sum(_at_end(consequences.terms[name]) ** 2 for name in consequences.known))
    together = _at_end(consequences.calibration)
    if abs(together / apart - 1) > _COMMON:
        yield Statement(
            "Correlation",
            f"The calibration's terms are not independent: together they make {_metres(together)} after {end}, where "
            f"their root sum of squares would be {_metres(apart)}.",
        )
    if consequences.left_out:
        lost = sorted(consequences.left_out.items(), key=lambda pair: -pair[1][-1])
        listed = "; ".join(f"{name} {_metres(error[-1])}" for name, error in lost)
        yield Statement(
            "What a simpler model costs", f"Left out of the correction, each by itself, after {end}: {listed}."
        )
    if consequences.check is not None:
        ratio = _at_end(consequences.check.sigma**2) / last
        draws = len(consequences.check.errors)
        chance = Z95 / np.sqrt(2 * draws)
        yield Statement(
            "Check",
            f"{draws} draws of all errors, through the whole mechanisation, scatter {ratio:.2f} times as much as the "
            f"budget says after {end} (by chance {1 - chance:.2f} to {1 + chance:.2f}).",
        )
    if consequences.against is not None and consequences.apart is not None:
        other = _metres(_at_end(consequences.against.total))
        off = _metres(float(np.linalg.norm(consequences.apart[-1, :3])))
        yield Statement(
            "The other calibration",
            f"With {Path(consequences.against.calibration_file).name} position is off by {other} (1σ) after "
            f"{end} if it is right, and it puts the unit {off} from where this one does.",
        )


# --- pictures ---------------------------------------------------------------------------------------------------------


def _budget_figure(consequences: Consequences) -> Figure:
    variances = {name: position(term) ** 2 for name, term in consequences.terms.items()}
    times = consequences.times
    whole = np.maximum(np.sum(list(variances.values()), axis=0), 1e-300)
    drawn = [name for name in _order(consequences) if (variances[name] / whole).max() >= LEAST_SHARE][: len(PALETTE)]
    end = f"after {_end(consequences)}"
    figure, (above, below) = figures.stacked(2, 3.2, sharex=True)
    for name, color in zip(drawn, PALETTE, strict=False):
        above.plot(times, np.sqrt(variances[name]), color=color, linewidth=1.4)
    above.plot(
        times,
        position(consequences.total),
        color="black",
        linewidth=2.4,
        linestyle="--",
        label="everything",
    )
    if consequences.check is not None:
        above.plot(times, position(consequences.check.sigma**2), color="#8A8A8A", linewidth=1.2, label="draws")
    figures.logarithmic(above, "y")
    legend(above, where="lower right")
    dressed(
        above,
        f"Position is off by {_metres(_at_end(consequences.total))} {end}",
        ylabel="position error, 1σ (m)",
    )
    shares = [100 * variances[name] / whole for name in drawn]
    rest = np.maximum(100 - np.sum(shares, axis=0), 0.0) if shares else 100 + 0 * whole
    below.stackplot(times, *shares, rest, colors=[*PALETTE[: len(drawn)], OTHERS], labels=[*drawn, "others"])
    dressed(
        below,
        "What it is made of",
        xlabel="time (s)",
        ylabel="share of the terms' squares (%)",
        ylim=(0, 100),
        xlim=(times[0], times[-1]),
    )
    legend_below(figure, below, 3)
    return figure


def _tracks_figure(consequences: Consequences) -> Figure:
    check = consequences.check
    assert check is not None
    figure, (plane, height) = figures.beside(2, 4.6)
    for track in check.errors[:100]:
        plane.plot(track[:, 0], track[:, 1], color="#0072B2", linewidth=0.6, alpha=0.4)
        height.plot(consequences.times, track[:, 2], color="#0072B2", linewidth=0.6, alpha=0.4)
    east, north = 2.45 * np.sqrt(
        consequences.total[-1, :2]
    )  # of two components, 95 % lie within 2.45 standard deviations
    angle = np.linspace(0, 2 * np.pi, 100)
    sigma = Z95 * np.sqrt(consequences.total[:, 2])
    plane.plot(east * np.cos(angle), north * np.sin(angle), color=figures.FLAGGED, linewidth=1.6)
    plane.set_aspect("equal", "datalim")
    for side in (-1, 1):
        height.plot(consequences.times, side * sigma, color=figures.FLAGGED, linewidth=1.6)
    dressed(
        plane,
        f"{min(100, len(check.errors))} draws over {_end(consequences)}",
        xlabel="error east (m)",
        ylabel="error north (m)",
    )
    dressed(height, "and their heights", xlabel="time (s)", ylabel="error up (m)")
    return figure
