"""What the report says in numbers: parameters with intervals, the equation to apply, where it all comes from."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np

from jaximu.calibration import Calibration
from jaximu.estimation.problem import Name
from jaximu.estimation.uncertainty import describe, label
from jaximu.ground.array_types import BoolArray, FloatArray
from jaximu.ground.page import Matrices, Part
from jaximu.ground.quantities import Z95, number, plain, probability, raised, unit_text, with_interval
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.ground.vectors import root_or_zero
from jaximu.model.effects import Effect
from jaximu.model.sensor import Imu, Triad


class _Input(NamedTuple):
    """What a triad measures: symbol, in words, its unit as text and as code has it; what code calls the output."""

    symbol: str
    words: str
    si: str
    code: str
    letter: str
    output: str


_INPUTS = {
    "accelerometer": _Input("f", "specific force", "m/s²", "m/s^2", "f", "y_accel"),
    "gyroscope": _Input("ω", "angular rate", "rad/s", "rad/s", "w", "y_gyro"),
    "magnetometer": _Input("h", "magnetic field", "µT", "uT", "h", "y_mag"),
}
MOST_ROWS = 50
"""Rows of a table that may grow with the number of units: what is beyond is counted."""
_MILLI_G = 1e-3 * STANDARD_GRAVITY


def p_text(p_value: float) -> str:
    """Return a p-value as a cell of a table has it."""
    return probability(p_value).removeprefix("= ")


def short_name(name: Name, model: Imu | None = None) -> str:
    """Turn `accelerometer.gain[1,0]` into a.m_yx: scale s_x, misalignment m_yx (input x seen by output y), bias b_x.

    The number of an effect is called as the effect is, which takes the model.
    """
    if name.effect is not None and model is not None:
        return label(name, model)
    symbol = "b" if name.part == "bias" else "s" if name.is_scale else "m"
    return f"{name.owner[0]}.{symbol}_{''.join('xyz'[axis] for axis in dict.fromkeys(name.axes))}"


def snippet(calibration: Calibration) -> str:
    """Return lines of Python that apply a calibration, numbers in full precision; "" where triads have effects."""
    lines = ["import numpy as np"]
    for name, triad in calibration.triads().items():
        if triad.effects:
            return ""
        short = name[0]
        known = _INPUTS[name]
        gain = (",\n" + 16 * " ").join(map(str, np.asarray(triad.gain).tolist()))
        unit = "".join(letter for letter in triad.output_unit if letter.isprintable())
        lines += [
            f"K_{short} = np.array([{gain}])",
            f"b_{short} = np.array({np.asarray(triad.bias).tolist()})",
            f"{known.letter} = ({known.output} - b_{short}) @ np.linalg.inv(K_{short}).T"
            f"  # {known.code}, from {known.output}: (n, 3) in {unit}",
        ]
    return "\n".join(lines)


def _scaled(values: FloatArray) -> tuple[str, list[list[str]]]:
    """Return a common power of ten if needed, and a matrix's entries as text, the largest with seven digits."""
    size = int(np.floor(np.log10(np.abs(values).max(initial=1e-300))))
    power = 0 if -2 <= size <= 5 else size
    decimals = max(0, 6 - (size - power))
    cells = [
        [f"{value:.{decimals}f}".replace("-", "−") if value else "0" for value in row] for row in values / 10.0**power
    ]
    return f"10{raised(power)} ·" if power else "", cells


_GIVEN = "not determined: as the data sheet states it"
_EXCHANGED = "its axes are exchanged"
"""In place of what the scale and the misalignments of an output would be that is another axis'."""


def rows(calibration: Calibration, name: str, triad: Triad) -> list[tuple[str, str, str, str]]:
    """Return a triad's scales, misalignments and biases: symbol, words, value ± 95 % in output units, in other words.

    A star marks what the data determine weakly.
    """
    (gain, bias), (gain_sigma, bias_sigma) = map(np.asarray, (triad.gain, triad.bias)), calibration.sigma(name)
    fitted = {"gain": (gain, gain_sigma), "bias": (bias, bias_sigma)}
    nominal = None if calibration.nominal is None else getattr(calibration.nominal, name)
    unit = unit_text(triad.output_unit)
    si = _INPUTS[name].si
    counts = unit != si
    per = f"{unit} per {si}" if counts else ""
    weak = {parameter for direction in calibration.weak for parameter, _ in direction.parameters}
    scale = np.diagonal(gain)
    along, exchanged = _along(gain, gain_sigma)

    undetermined = f"{name} gain" in calibration.from_data_sheet

    def gain_words(i: int, j: int) -> str:
        if undetermined:
            return _GIVEN
        if not (gain[i, j] or gain_sigma[i, j]):
            return "by convention: fixes the body frame"
        if exchanged[i]:
            return _EXCHANGED
        return scale_words(i) if i == j else misalignment_words(i, j)

    def scale_words(i: int) -> str:
        if nominal is None and counts:
            return ""
        start = 1.0 if nominal is None else np.asarray(nominal.gain)[i, i]
        change = with_interval(100 * (scale[i] / start - 1), 100 * gain_sigma[i, i] / abs(start), "%", sign=True)
        origin = "nominal" if _started_nominal(calibration, name) else "where the fit started,"
        return f"{change} from {origin}" + (f" {plain(start)}" if counts else "")

    def misalignment_words(i: int, j: int) -> str:
        tilt = gain[i, j] / scale[i]
        sigma = _ratio_sigma(calibration, name, gain, i, j)
        in_mrad = with_interval(1e3 * tilt, 1e3 * sigma, "mrad", sign=True)
        return f"{in_mrad} = {with_interval(tilt, sigma, 'rad', sign=True)}"

    def bias_words(i: int) -> str:
        if counts:
            offset = 0.0 if nominal is None else np.asarray(nominal.bias)[i]
            change = with_interval((bias[i] - offset) / along[i], bias_sigma[i] / abs(along[i]), si, sign=True)
            return change + (f" from nominal {plain(offset)}" if nominal is not None else "")
        if name == "magnetometer":
            return "hard iron"
        factor, shown = (_MILLI_G, "mg") if name == "accelerometer" else (1.0, "rad/s")
        return with_interval(bias[i] / factor, bias_sigma[i] / factor, shown, sign=True)

    def row(part: str, axes: tuple[int, ...], meaning: str) -> tuple[str, str, str, str]:
        parameter = Name(name, part, axes)
        value, sigma = (matrix[axes] for matrix in fitted[part])
        of_part = per if part == "gain" else ""
        shown = "0" if meaning.startswith("by convention") else with_interval(value, sigma, of_part)
        if (not counts or part == "gain") and 0 < abs(value) <= Z95 * sigma:
            meaning = f"{meaning}; not different from zero".removeprefix("; ")
        if parameter in calibration.open_numbers:
            shown = with_interval(value, 0.0, of_part)
            meaning = "not determined"
        words = describe(parameter).removeprefix(f"{name} ") + " *" * (parameter in weak)
        # a bias as it is put out: what the equation takes
        return short_name(parameter), words, shown + f" {unit}" * (part == "bias"), meaning

    return [
        *(
            row("gain", axes, gain_words(*axes))
            for axes in sorted(np.ndindex(3, 3), key=lambda axes: axes[0] != axes[1])
        ),
        *(row("bias", (i,), bias_words(i)) for i in range(3)),
    ]


def _along(gain: FloatArray, sigma: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the gain (3,) of each output along the axis that it is of, and whether that is another's for certain."""
    axis = np.abs(gain).argmax(axis=1)
    along = gain[range(3), axis]
    return along, (axis != range(3)) & (np.abs(along) > Z95 * sigma[range(3), axis])


def _started_nominal(calibration: Calibration, name: str) -> bool:
    """Whether the fit started from the recording's nominal scale (a gyroscope's may have been corrected by gravity)."""
    if not calibration.segmentations or calibration.nominal is None:
        return True
    signal = getattr(calibration.segmentations[0].recording, name)
    start = np.asarray(getattr(calibration.nominal, name).gain).diagonal()
    return signal is None or np.allclose(signal.nominal_scale, start, rtol=1e-6)


def _ratio_sigma(calibration: Calibration, name: str, gain: FloatArray, i: int, j: int) -> float:
    """Return the standard deviation of gain[i, j] / gain[i, i], their correlation counted."""
    slope = np.zeros(len(calibration.names))
    for column, value in ((j, 1 / gain[i, i]), (i, -gain[i, j] / gain[i, i] ** 2)):
        if (entry := Name(name, "gain", (i, column))) in calibration.names:
            slope[calibration.names.index(entry)] = value
    return float(root_or_zero(slope @ calibration.covariance @ slope))


def equations(calibration: Calibration) -> Iterator[tuple[str, list[Part]]]:
    """Yield each triad's name and the equation that corrects its output, with K, its inverse, b and effects."""
    for name, triad in calibration.triads().items():
        known, unit, gain = _INPUTS[name], unit_text(triad.output_unit), np.asarray(triad.gain)
        factor, inverse = _scaled(np.linalg.inv(gain))
        bias_factor, bias = _scaled(np.asarray(triad.bias)[:, None])
        gain_factor, entries = _scaled(gain)
        per = "(no unit)" if unit == known.si else f"{unit} per {known.si}"
        parts: list[Part] = [
            Matrices([f"{known.symbol} = {factor}", inverse, f"· ( y − {bias_factor}", bias, ")"]),
            f"{known.symbol}: {known.words} in {known.si}; y: output x, y, z in {unit}; the matrix is K⁻¹, the column "
            "b.",
            Matrices([f"K = {gain_factor}", entries, per]),
        ]
        yield name, parts + [_effect_words(effect, triad.output_unit) for effect in triad.effects]


def _effect_words(effect: Effect, output_unit: str) -> str:
    numbers = ", ".join(number(coefficient, 6) for coefficient in np.asarray(effect.coefficients))
    unit = unit_text(effect.coefficient_unit(output_unit))
    for inner, parameter in effect.inner.items():  # time constants and the like, after the coefficients
        unit += f"; {inner.replace('_', ' ')} {number(float(getattr(effect, inner)), 6)} {parameter.unit}"
    return (
        f"Beyond the linear part: {effect.title}, `{effect.formula}`, coefficients {numbers} in {unit}. Then "
        f"`u = K⁻¹·(y − b − {effect.formula})` is solved by repetition; `jaximu compensate` does it."
    )


_TWO_STEPS = "two steps: the accelerometer by the magnitude of gravity, then the gyroscope by its direction"
_METHODS = {
    "joint": "joint maximum likelihood of accelerometer and gyroscope",
    "two-step": _TWO_STEPS,
    "two-step-rk4": f"{_TWO_STEPS} (fourth-order Runge–Kutta integration)",
    "accelerometer": "the accelerometer alone, by the magnitude of gravity",
}


def provenance(calibration: Calibration) -> list[tuple[str, str]]:
    """Return facts about the data, the method and the software, by name."""
    data = calibration.data
    gravity = calibration.gravity
    rates = [
        f"{name} {data[key]:.6g} Hz"
        for name, key in (("accelerometer", "rate"), ("gyroscope", "gyroscope_rate"))
        if key in data
    ]
    return [
        *[("Sample rate", ", ".join(rates))] * bool(rates),
        ("Used", f"{data.get('poses', 0)} poses at rest, {data.get('turns', 0)} turns between them"),
        *(
            (
                "Poses found",
                f"{len(part.intervals)}; still is a variance up to {part.threshold:g} times the noise floor (intervals "
                f"at each threshold tried: {part.table()})",
            )
            for part in calibration.segmentations
        ),
        ("Gravity", f"{gravity.value:.7g} m/s², standard deviation {gravity.sigma:g} m/s²"),
        ("Method", _METHODS.get(calibration.method, calibration.method)),
        ("Loss", "least squares" if calibration.loss == "linear" else f"robust ({calibration.loss})"),
        ("Rank", f"{calibration.rank} of {len(calibration.names)} parameters determined"),
        ("Solver", calibration.solver),
        ("Software", " ".join(str(value) for value in calibration.software.values())),
        ("Report written", written_now()),
    ]


def written_now() -> str:
    """Return when a page is written, in universal time."""
    return datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
