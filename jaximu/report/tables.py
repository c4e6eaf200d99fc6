"""What the report says in numbers: parameters with intervals, the equation to apply, where it all comes from."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaximu.calibration import Calibration
from jaximu.problem import Name
from jaximu.quantities import Z95, number, plain, raised, unit_text, with_interval
from jaximu.sensor import Imu, Triad
from jaximu.uncertainty import describe, label
from jaximu.units import STANDARD_GRAVITY

__all__ = ["Row", "equations", "provenance", "rows", "short_name", "snippet"]

FloatArray = NDArray[np.float64]

_SI = {"accelerometer": "m/s²", "gyroscope": "rad/s", "magnetometer": "µT"}
_CODE = {"accelerometer": ("a", "f", "y_accel", "m/s^2"), "gyroscope": ("g", "w", "y_gyro", "rad/s"),
         "magnetometer": ("m", "h", "y_mag", "uT")}  # fmt: skip
_INPUTS = {"accelerometer": ("f", "specific force"), "gyroscope": ("ω", "angular rate"),
           "magnetometer": ("h", "magnetic field")}  # fmt: skip
_MILLI_G = 1e-3 * STANDARD_GRAVITY


@dataclass(frozen=True)
class Row:
    """One parameter: its symbol, its words, value ± 95 % in output units, the same in words a person compares."""

    symbol: str
    words: str
    value: str
    meaning: str
    weak: bool = False


def short_name(name: Name, model: Imu | None = None) -> str:
    """Turn `accelerometer.gain[1,0]` into a.m_yx: scale s_x, misalignment m_yx (input x seen by output y), bias b_x.

    The number of an effect is called as the effect is, which takes the model.
    """
    if name.effect is not None and model is not None:
        return label(name, model)
    symbol = "b" if name.part == "bias" else "s" if name.axes[0] == name.axes[1] else "m"
    return f"{name.owner[0]}.{symbol}_{''.join('xyz'[axis] for axis in dict.fromkeys(name.axes))}"


def snippet(calibration: Calibration) -> str:
    """Return lines of plain Python that apply the calibration (triads without effects), numbers in full precision."""

    def listed(values: FloatArray) -> str:
        return "[" + ", ".join(repr(float(value)) for value in values) + "]"

    lines = ["import numpy as np"]
    for name, triad in calibration.triads().items():
        short, symbol, output, si = _CODE[name]
        gain = (",\n" + 16 * " ").join(listed(row) for row in np.asarray(triad.gain))
        unit = "".join(letter for letter in triad.output_unit if letter.isprintable())
        lines += [
            f"K_{short} = np.array([{gain}])",
            f"b_{short} = np.array({listed(np.asarray(triad.bias))})",
            f"{symbol} = ({output} - b_{short}) @ np.linalg.inv(K_{short}).T  # {si}, from {output}: (n, 3) in {unit}",
        ]
    return "\n".join(lines)


def _scaled(values: FloatArray, digits: int = 7) -> tuple[list[list[str]], str]:
    """Return a matrix's entries as text, all with the decimals of the largest, and a common power of ten if needed."""
    size = int(np.floor(np.log10(np.abs(values).max(initial=1e-300))))
    power = 0 if -2 <= size <= 5 else size
    decimals = max(0, digits - 1 - (size - power))
    scaled = values / 10.0**power
    cells = [[f"{value:.{decimals}f}".replace("-", "−") if value else "0" for value in row] for row in scaled]
    return cells, f"10{raised(power)} ·" if power else ""


def rows(calibration: Calibration, name: str, triad: Triad) -> list[Row]:
    """Return the triad's parameters with their 95 % intervals: scales, misalignments, biases."""
    gain, bias = np.asarray(triad.gain), np.asarray(triad.bias)
    gain_sigma, bias_sigma = calibration.sigma(name)
    nominal = None if calibration.nominal is None else getattr(calibration.nominal, name)
    unit, si = unit_text(triad.output_unit), _SI[name]
    counts = unit != si
    per = f"{unit} per {si}" if counts else ""
    weak = {parameter for each in calibration.weak for parameter, _ in each.parameters}
    scale = np.diagonal(gain)
    made = []

    def add(part: str, axes: tuple[int, ...], value: str, meaning: str) -> None:
        parameter = Name(name, part, axes)
        words = describe(parameter).removeprefix(f"{name} ")
        if not counts or part == "gain":
            fitted = float({"gain": gain, "bias": bias}[part][axes])
            sigma = float({"gain": gain_sigma, "bias": bias_sigma}[part][axes])
            if 0 < abs(fitted) <= Z95 * sigma:
                meaning = f"{meaning}; not different from zero".removeprefix("; ")
        made.append(Row(short_name(parameter), words, value, meaning, parameter in weak))

    start_name = "nominal" if _started_nominal(calibration, name) else "where the fit started,"
    for i in range(3):
        meaning = ""
        if nominal is not None or not counts:
            start = 1.0 if nominal is None else float(np.asarray(nominal.gain)[i, i])
            change = with_interval(100 * (scale[i] / start - 1), 100 * gain_sigma[i, i] / abs(start), "%", sign=True)
            meaning = f"{change} from {start_name}" + (f" {plain(start)}" if counts else "")
        add("gain", (i, i), with_interval(scale[i], gain_sigma[i, i], per), meaning)
    for i, j in ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)):
        value, meaning = "0", "by convention: fixes the body frame"
        if gain[i, j] or gain_sigma[i, j]:
            tilt, sigma = gain[i, j] / scale[i], _ratio_sigma(calibration, name, gain, i, j)
            value = with_interval(gain[i, j], gain_sigma[i, j], per)
            meaning = with_interval(1e3 * tilt, 1e3 * sigma, "mrad", sign=True)
            meaning += f" = {with_interval(tilt, sigma, 'rad', sign=True)}"
        add("gain", (i, j), value, meaning)
    for i in range(3):
        value = f"{with_interval(bias[i], bias_sigma[i])} {unit}"  # as it is put out: what the equation takes
        if counts:
            offset = 0.0 if nominal is None else float(np.asarray(nominal.bias)[i])
            meaning = with_interval((bias[i] - offset) / scale[i], bias_sigma[i] / scale[i], si, sign=True)
            meaning += f" from nominal {plain(offset)}" if nominal is not None else ""
        elif name == "magnetometer":
            meaning = "hard iron"
        elif name == "gyroscope":
            meaning = with_interval(bias[i], bias_sigma[i], "rad/s", sign=True)
        else:
            meaning = with_interval(bias[i] / _MILLI_G, bias_sigma[i] / _MILLI_G, "mg", sign=True)
        add("bias", (i,), value, meaning)
    return made


def _started_nominal(calibration: Calibration, name: str) -> bool:
    """Whether the fit started from the recording's nominal scale (a gyroscope's may have been corrected by gravity)."""
    if not calibration.segmentations or calibration.nominal is None:
        return True
    signal = getattr(calibration.segmentations[0].recording, name)
    start = np.diagonal(np.asarray(getattr(calibration.nominal, name).gain))
    return signal is None or np.allclose(signal.nominal_scale, start, rtol=1e-6)


def _ratio_sigma(calibration: Calibration, name: str, gain: FloatArray, i: int, j: int) -> float:
    """Return the standard deviation of gain[i, j] / gain[i, i], their correlation counted."""
    slope = np.zeros(len(calibration.names))
    for column, value in ((j, 1 / gain[i, i]), (i, -gain[i, j] / gain[i, i] ** 2)):
        if (entry := Name(name, "gain", (i, column))) in calibration.names:
            slope[calibration.names.index(entry)] = value
    return float(np.sqrt(max(slope @ calibration.covariance @ slope, 0.0)))


def equations(calibration: Calibration) -> list[dict[str, Any]]:
    """Return what the equation to apply needs, for each triad: names, units, K, its inverse, b, effects, as text."""
    made = []
    for name, triad in calibration.triads().items():
        gain = np.asarray(triad.gain)
        effects = []
        for effect in triad.effects:
            coefficients = [number(float(each), 6) for each in np.asarray(effect.coefficients)]
            unit = unit_text(effect.coefficient_unit(triad.output_unit))
            for inner, each in effect.inner.items():  # time constants and the like, after the coefficients
                unit += f"; {inner.replace('_', ' ')} {number(float(getattr(effect, inner)), 6)} {each.unit}"
            effects.append((effect.title, effect.formula, coefficients, unit))
        made.append(
            {
                "name": name,
                "input": _INPUTS[name],
                "unit": unit_text(triad.output_unit),
                "si": _SI[name],
                "gain": _scaled(gain),
                "inverse": _scaled(np.linalg.inv(gain)),
                "bias": _scaled(np.asarray(triad.bias)[:, None]),
                "effects": effects,
            }
        )
    return made


_METHODS = {
    "joint": "joint maximum likelihood of accelerometer and gyroscope",
    "two-step": "two steps: the accelerometer by the magnitude of gravity, then the gyroscope by its direction",
    "two-step-rk4": "two steps: the accelerometer by the magnitude of gravity, then the gyroscope by its direction "
    "(fourth-order Runge–Kutta integration)",
    "accelerometer": "the accelerometer alone, by the magnitude of gravity",
}


def provenance(calibration: Calibration) -> list[tuple[str, str]]:
    """Return facts about the data, the method and the software, by name."""
    data = calibration.data
    facts = []
    rates = [f"accelerometer {data['rate']:.6g} Hz"] if "rate" in data else []
    rates += [f"gyroscope {data['gyroscope_rate']:.6g} Hz"] if "gyroscope_rate" in data else []
    if rates:
        facts.append(("Sample rate", ", ".join(rates)))
    facts.append(("Used", f"{data.get('poses', 0)} poses at rest, {data.get('turns', 0)} turns between them"))
    for part in calibration.segmentations:
        text = (
            f"{len(part.intervals)}; still is a variance up to {part.threshold:g} times the noise floor (intervals at "
            f"each threshold tried: {part.table()})"
        )
        facts.append(("Poses found", text))
    gravity = calibration.gravity
    facts += [
        ("Gravity", f"{gravity.value:.7g} m/s², standard deviation {gravity.sigma:g} m/s²"),
        ("Method", _METHODS.get(calibration.method, calibration.method)),
        ("Loss", "least squares" if calibration.loss == "linear" else f"robust ({calibration.loss})"),
        ("Rank", f"{calibration.rank} of {len(calibration.names)} parameters determined"),
        ("Solver", calibration.solver),
        ("Software", " ".join(str(value) for value in calibration.software.values())),
        ("Report written", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")),
    ]
    return facts
