"""What a Kalman filter found, and when: in words, and as pictures of its states over time with 95 % bands."""

from collections.abc import Iterable, Iterator, Sequence
from functools import partial

import numpy as np

from jaximu.calibration import Calibration, History
from jaximu.estimation.uncertainty import label
from jaximu.ground.array_types import FloatArray
from jaximu.ground.page import Page, Picture, Statement
from jaximu.ground.quantities import Z95, number, sentence
from jaximu.model.effects.earth_rotation import EARTH_RATE
from jaximu.model.effects.magnetic_field import SetupMagneticField
from jaximu.report.attitude import mounting_words
from jaximu.report.calibration import calibration_page
from jaximu.report.canvas import Figure
from jaximu.report.figures import AXES, band, dressed, legend, logarithmic, stacked
from jaximu.report.vehicle import vehicle_page
from jaximu.report.words import BEYOND, gravity_statements, limits

_PANELS = (
    ("gyroscope", "bias", "Gyroscope bias less its last value [°/s]", np.degrees(1.0)),
    ("accelerometer", "bias", "Accelerometer bias less its last value [mm/s²]", 1e3),
    ("gyroscope", "gain", "Gyroscope scale less its last value [%]", 100.0),
    ("accelerometer", "gain", "Accelerometer scale less its last value [%]", 100.0),
)
_HOUR = np.degrees(3600.0)


def statements(calibration: Calibration, history: History) -> Iterator[Statement]:
    """Say whether the innovations are noise, when each kind of number was known, and what the Earth's rotation is."""
    assert calibration.filter is not None
    if calibration.reference:
        yield Statement("The reference", " ".join(mounting_words(calibration)))
    if (text := calibration.filter.get("diverged")) is not None:
        yield Statement("Diverged", sentence(text), True)
    nis = calibration.filter["nis"]
    widened = float(np.sqrt(max(calibration.filter.get("noise", {}).values(), default=1.0)))
    fits = 0.7 < nis < 1.4 and text is None and widened < BEYOND
    cause = "noise explains them" if fits else "an unmodelled effect, or the noise stated is not this unit’s"
    text = (
        f"Over {np.sum(history.freedom > 0)} updates the squared innovations are {number(nis, 2)} times what their "
        "uncertainty expects"
        + (f", once their noise is taken as {number(widened, 2)} times the unit's" if widened >= BEYOND else "")
        + f": {cause}."
    )
    yield Statement("Innovations", text, not fits)
    yield Statement("Convergence", _convergence(history))
    if (earth := _earth(history)) is not None:
        yield earth
    if (field := np.asarray(calibration.imu.coefficients(SetupMagneticField))).any():
        strength = float(np.linalg.norm(field))
        yield Statement(
            "Magnetic field",
            f"{number(strength)} µT, {np.degrees(np.arcsin(-field[2] / strength)):.1f}° below the "
            "level: it shows the heading of every rest.",
        )


def _convergence(history: History) -> str:
    """Say after how long each kind of number was known to twice its last uncertainty."""
    parts = []
    never = []
    for owner, part, *_ in _PANELS:
        times = [history.converged(state) for state in _places(history, owner, part)]
        if times and None not in times:
            parts.append(f"{owner} {part} after {max(time for time in times if time is not None):.0f} s")
        elif times:
            never.append(f"{owner} {part}")
    text = f"Known to twice the last uncertainty: {', '.join(parts)}." * bool(parts)
    if never:
        text += f" Not every axis became twice as well known as it was at the start: {', '.join(never)}."
    return text.strip()


def _places(history: History, owner: str, part: str) -> list[int]:
    return [
        state for state, name in enumerate(history.names) if (name.owner, name.part, name.effect) == (owner, part, None)
    ]


def _earth(history: History) -> Statement | None:
    """Say what the Earth's rotation came out as, where it was seen; more than it can be has another cause."""
    places = list(history.earth)
    if not places:
        return None
    value, sigma = history.values[-1, places], history.sigmas[-1, places]
    total = np.linalg.norm(value)
    spread = np.linalg.norm(value * sigma) / max(total, 1e-30)
    near = abs(total - EARTH_RATE) < 4 * spread + 0.02 * EARTH_RATE
    if total < 4 * spread or (near and spread > 0.1 * EARTH_RATE):
        return Statement(
            "Earth's rotation",
            f"Not determined here: {total * _HOUR:.2g} ± {Z95 * spread * _HOUR:.2g} °/h beside the true 15.04 °/h. The "
            "intervals of the gyroscope's bias include it.",
        )
    rate = f"{number(total * _HOUR)} ± {number(Z95 * spread * _HOUR, 2)} °/h"
    if not near:
        return Statement(
            "Earth's rotation",
            f"What turns with the level frame is {rate}, and the Earth's rotation is 15.04 °/h: a rate that depends on "
            "orientation, such as gyroscope g-sensitivity, is in it. Run `jaximu diagnose`.",
            True,
        )
    latitude = np.degrees(np.arcsin((value[2] / total).clip(-1, 1)))
    return Statement(
        "Earth's rotation", f"Found as {rate} (15.04 °/h), which puts the unit at latitude {latitude:.2f}°."
    )


def page_of(calibration: Calibration, history: History) -> Page:
    """Return the page of a calibration by the filter."""
    assert calibration.filter is not None
    if "vehicle" in calibration.filter:
        return vehicle_page(calibration, history)
    bias = history.sigmas[-1, _places(history, "gyroscope", "bias")]
    worst = np.degrees(Z95 * max(bias) / np.mean(calibration.triads()["gyroscope"].scales))
    verdict = "diverged" if calibration.filter.get("diverged") else "followed the unit"
    return calibration_page(
        calibration,
        [
            Picture(
                "residuals",
                partial(_figure, calibration, history),
                "States of the filter over time with 95 % bands",
                "Lines: what the filter knew at each time from the recording so far; bands: 95 %. Grey: rests. "
                "Bottom: squared innovations over what their uncertainty expects; noise gives about 1.",
            )
        ],
        gravity_statements(calibration),
        partial(_limits, calibration, calibration.filter["open"]),
        (f"The filter {verdict} through {np.ptp(history.time) / 60:.1f} min of rests and motion.",),
        (f"±{number(worst, 2)} °/s", "how well the gyroscope's bias is known at the end (95 %, the worst axis)"),
        statements(calibration, history),
    )


def _limits(calibration: Calibration, left_open: Sequence[str]) -> Iterator[Statement]:
    for text in left_open or ["This sequence leaves no number of the unit open."]:
        yield Statement("Left open", text)
    yield from limits(calibration)


_Line = tuple[FloatArray, FloatArray, str, str]
"""A state over time, its standard deviation, colour and name."""


def _triads(calibration: Calibration, history: History) -> Iterator[tuple[str, list[_Line]]]:
    """Yield the title of each panel of biases and scales, and its lines, less their last values."""
    for owner, part, title, factor in _PANELS:
        gain = getattr(calibration.imu, owner).scales
        lines = []
        for state in _places(history, owner, part):
            axes = history.names[state].axes
            if len(set(axes)) == 1:
                unit = factor / gain[axes[0]]
                axis = "xyz"[axes[0]]
                value = history.values[:, state] - history.values[-1, state]
                lines.append((unit * value, abs(unit) * history.sigmas[:, state], AXES[axis], axis))
        yield title, lines


def _effects(calibration: Calibration, history: History) -> Iterable[tuple[str, list[_Line]]]:
    """Return the title of each panel of effects' numbers, and its lines."""
    groups = {}
    units = {name: triad.output_unit for name, triad in calibration.triads().items()}
    for state, name in enumerate(history.names):
        effect = calibration.imu.all_effects().get(name.key)
        if effect is not None and state not in history.earth:
            title = f"{sentence(effect.english)} [{effect.coefficient_unit(units.get(name.owner, ''))}]"
            lines = groups.setdefault(title, [])
            lines.append(
                (history.values[:, state], history.sigmas[:, state], f"C{len(lines)}", label(name, calibration.imu))
            )
    return groups.items()


def _figure(calibration: Calibration, history: History) -> Figure:
    drawn = [*_triads(calibration, history), *_effects(calibration, history)]
    figure, panels = stacked(len(drawn) + 1, 2.4, 0.0, sharex=True)
    time = history.time
    middle = np.searchsorted(time, (time[0] + time[-1]) / 2)
    for panel, (title, lines) in zip(panels, drawn, strict=False):
        limit = 0.0
        for line, sigma, color, name in lines:
            half = Z95 * sigma
            band(panel, time, line, half, color, label=name)
            limit = max(limit, (np.abs(line[middle:]) + half[middle:]).max())
        panel.set_ylim(-1.1 * limit, 1.1 * limit)  # the data sheet's uncertainty at the start would hide the rest
        legend(panel, 3, "upper right")
        dressed(panel, title)
    used = history.freedom > 0
    innovations = panels[-1]
    innovations.plot(
        time[used],
        np.maximum((history.innovations / np.maximum(history.freedom, 1))[used], 1e-3),
        ".",
        color=AXES["x"],
        markersize=3,
    )
    logarithmic(innovations, "y")
    dressed(innovations, "Squared innovations over their expectation", 1.0, xlabel="time [s]")
    for panel in panels:
        panel.fill_between(
            time, 0, 1, where=history.rest, color="0.93", transform=panel.get_xaxis_transform(), step="pre", zorder=-1
        )
    return figure
