"""Nominal scale and offset of raw counts: as the user states them, or found from gravity and from rest."""

import re
from dataclasses import replace
from fractions import Fraction

import numpy as np

from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import LocalGravity
from jaximu.ground.units import unit
from jaximu.ground.vectors import lengths_of
from jaximu.recordings.recording import Signal, Stated

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?:/\d+\.?\d*)?"


def parse_scale(stated: Stated, quantity: str, option: str) -> FloatArray:
    """(1,) or (3,) counts per SI unit from a text: one value or three with commas, a fraction, a unit or none.

    "16384 count/g", "131 count/(deg/s)", "0.061 mg/count", "1/6258", "415,413,415". A bare number of 1 or more is
    counts per m/s² (rad/s), below 1 it is m/s² (rad/s) per count. Raises InputError.
    """
    numbers, rest = _split(stated, option)
    rest = rest.replace(" ", "")
    if not rest:
        scale = np.where(np.abs(numbers) < 1.0, 1.0 / numbers, numbers)
    elif match := re.fullmatch(r"(?:counts?|lsb|digits?)/\(?(.+?)\)?", rest, re.IGNORECASE):
        scale = numbers / unit(match[1], quantity, column=option).factor
    elif match := re.fullmatch(r"\(?(.+?)\)?/(?:counts?|lsb|digits?)", rest, re.IGNORECASE):
        scale = 1.0 / (numbers * unit(match[1], quantity, column=option).factor)
    else:
        raise InputError(f"{option}: {rest!r} is no unit of a scale; write count/UNIT or UNIT/count, such as count/g.")
    return np.asarray(scale, float)


def parse_offset(stated: Stated, option: str) -> FloatArray:
    """(1,) or (3,) counts at zero input from "32768" or "33124,33275,32364". Raises InputError."""
    numbers, rest = _split(stated, option, zero=True)
    if rest.strip().lower() not in ("", "count", "counts", "lsb"):
        raise InputError(f"{option}: an offset is in counts, not {rest.strip()!r}.")
    return numbers


def _split(stated: Stated, option: str, zero: bool = False) -> tuple[FloatArray, str]:
    text = stated if isinstance(stated, str) else ",".join(map(repr, map(float, np.atleast_1d(stated))))
    match = re.fullmatch(rf"\s*({_NUMBER}(?:\s*,\s*{_NUMBER})*)\s*(.*)", text)
    try:
        numbers = [float(_value(part)) for part in match[1].split(",")] if match else []
    except (ZeroDivisionError, ValueError, OverflowError):
        numbers = []
    if not match or len(numbers) not in (1, 3) or (not zero and 0.0 in numbers):
        raise InputError(f"{option}: {text!r} is not understood; give one value or three separated by commas.")
    return np.array(numbers), match[2]


def _value(text: str) -> Fraction:
    above, _, below = text.strip().partition("/")
    return Fraction(above) / Fraction(below or 1)


def scaled_accelerometer(
    signal: Signal, scale: Stated | None, offset: Stated | None, gravity: LocalGravity, file: str
) -> tuple[Signal, tuple[str, ...]]:
    """An accelerometer in counts with its nominal scale and offset, and notes on where they come from.

    Without a scale, gravity tells it: the quiet parts of the recording must lie on a sphere of radius g
    (`fit_sphere`). An offset that is given is kept, and serves as the sphere's centre where the orientations do not
    determine one. A scale without an offset means offset 0. Raises InputError or NotPossibleError.
    """
    if scale is not None:
        counts = parse_scale(scale, "acceleration", "--accel-scale")
        zero = parse_offset(offset, "--accel-offset") if offset is not None else np.zeros(1)
        return replace(signal, nominal_scale=counts, nominal_offset=zero), (
            _said("accelerometer", counts, "m/s²", "--accel-scale"),
        )
    means = quiet_means(signal)
    sphere = fit_sphere(means)
    if offset is not None:
        zero = np.array(np.broadcast_to(parse_offset(offset, "--accel-offset"), 3))
        radius = sphere[1] if sphere else np.median(lengths_of(means - zero))
    elif sphere:
        zero, radius = sphere
    else:
        raise NotPossibleError(
            f"{file}: the accelerometer is in raw counts and its still parts do not determine scale and offset: they "
            "must show gravity in directions all around. Give --accel-scale and --accel-offset, or record more poses."
        )
    listed = "" if offset is not None else f", offset {', '.join(f'{value:.1f}' for value in zero)} count"
    return replace(signal, nominal_scale=np.full(3, radius / gravity.value), nominal_offset=zero), (
        f"accelerometer scale found from gravity: {radius / gravity.value:.5g} count per m/s²{listed}.",
    )


def scaled_gyroscope(
    signal: Signal, scale: Stated | None, offset: Stated | None, file: str
) -> tuple[Signal, tuple[str, ...]]:
    """A gyroscope in counts with its nominal scale and offset; without an offset, the median of the quietest second.

    Raises InputError without a scale: nothing in a recording tells it before calibration.
    """
    if scale is None:
        raise InputError(
            f"{file}: the gyroscope is in raw counts; give its nominal scale from the data sheet with --gyro-scale, "
            'for example --gyro-scale "131 count/(deg/s)" or --gyro-scale 1/6258 (rad/s per count).'
        )
    counts = parse_scale(scale, "angular rate", "--gyro-scale")
    notes = [_said("gyroscope", counts, "rad/s", "--gyro-scale")]
    if offset is not None:
        zero = parse_offset(offset, "--gyro-offset")
    else:
        windows = _windows(signal, 1.0)
        zero = np.median(windows[np.argmin(windows.var(1).sum(1))], 0)
        listed = ", ".join(f"{value:.1f}" for value in zero)
        notes.append(f"gyroscope offset from its quietest second: {listed} count.")
    return replace(signal, nominal_scale=counts, nominal_offset=zero), tuple(notes)


def _said(sensor: str, scale: FloatArray, per: str, option: str) -> str:
    return f"{sensor} scale from {option}: {', '.join(f'{value:.5g}' for value in scale)} count per {per}."


def _windows(signal: Signal, seconds: float) -> FloatArray:
    """(windows, samples, 3) the values cut into windows of about `seconds`; the whole, if it is shorter."""
    span = min(len(signal), max(5, signal.samples(seconds)))
    count = len(signal) // span
    return signal.values[: count * span].reshape(count, span, -1)


def quiet_means(signal: Signal) -> FloatArray:
    """(windows, 3) means of the windows with the least variance; quantisation alone counts as quiet."""
    windows = _windows(signal, 0.5)
    variance = windows.var(1).sum(1)
    return windows[variance <= max(4.0 * np.percentile(variance, 10.0), 1.0)].mean(1)


def fit_sphere(points: FloatArray) -> tuple[FloatArray, float] | None:
    """Centre (3,) and radius of the sphere through the (n, 3) quiet means, by robust linear least squares.

    Points that lie together count once, so that a long rest does not outweigh the other poses. None if the
    orientations do not determine the sphere, or the points lie on none.
    """
    spread = float(np.linalg.norm(np.ptp(points, axis=0))) or 1.0
    _, cell = np.unique((points / (0.03 * spread)).round(), axis=0, return_inverse=True)
    cell = cell.ravel()
    root = np.sqrt(1.0 / np.bincount(cell)[cell])[:, None]
    middle = np.average(points, axis=0, weights=root[:, 0] ** 2)
    scaled = (points - middle) / spread
    design = np.column_stack([2.0 * scaled, np.ones(len(scaled))]) * root
    target = (scaled**2).sum(1) * root[:, 0]
    fitted, miss = np.ones(len(points), bool), np.zeros(len(points))
    solution, radius = np.zeros(4), 1.0
    for _ in range(5):
        fitted = miss <= max(4.0 * np.median(miss), 1e-6 * radius)
        solution = np.linalg.lstsq(design[fitted], target[fitted], rcond=None)[0]
        radius = np.sqrt(max(solution[3] + solution[:3] @ solution[:3], 1e-12))
        miss = np.abs(lengths_of(scaled - solution[:3]) - radius)
    weight = root[fitted] ** 2
    around = scaled[fitted] - (weight * scaled[fitted]).sum(0) / weight.sum()
    thinnest = np.linalg.svd(around * root[fitted], compute_uv=False)[-1] / np.sqrt(weight.sum())
    off_sphere = np.sqrt((miss[fitted] ** 2).mean()) > 0.05 * radius
    if len(np.unique(cell[fitted])) < 5 or thinnest < 0.1 * radius or off_sphere:
        return None
    return solution[:3] * spread + middle, radius * spread
