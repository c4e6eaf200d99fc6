"""What a calibration's gains say of how the sensors are arranged: axes, signs, mounting, ranges, unit of time.

A calibration takes all of them in: its gain says how the output hangs together with the truth, whatever the file's
columns are called. They are mistakes where somebody relies on the file's axes and units.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from jaximu.calibration.calibration import Calibration
from jaximu.estimation.uncertainty import WeakDirection, gains_open
from jaximu.ground.array_types import FloatArray
from jaximu.ground.distributions import robust_sigma
from jaximu.ground.quantities import listed
from jaximu.ground.vectors import lengths_of
from jaximu.model.sensor import Imu, Triad
from jaximu.recordings.alignment import angle_of, rotation_of, signed_permutation
from jaximu.recordings.finding import Finding
from jaximu.recordings.recording import Recording, apply_axes, spelled_axes

_MOUNTED = np.radians(5.0)
"""Rotation of the gyroscope against the accelerometer beyond which it is a mounting and no misalignment."""
_BETWEEN = np.radians(20.0)
"""Rotation from the nearest axes beyond which it is not axes that were exchanged."""
_FACTORS = (0.125, 0.25, 0.5, 2.0, 4.0, 8.0, 16.0)
_NEAR = 0.08
"""Share by which a scale may differ from a whole factor: sensors' own scales do."""
_ODD = 0.2
"""Share by which a scale may differ from the data sheet's."""
_ALIKE = 3e-3
_MEANS, _CLEARER = 400, 4.0
"""Means over a recording in which gravity is looked at, and how much more its size must scatter as it stands."""
_SLOW = 0.012
"""Difference of all rates alike from which on the sample rate is in doubt."""


def arrangement(recording: Recording, calibration: Calibration) -> list[Finding]:
    """Return what is unusual in how a calibrated unit's gains differ from the recording's nominal scales.

    Gains that the recording leaves open say nothing.
    """
    scales = {name: signal.nominal_scale for name, signal in recording.signals.items()}
    return unusual_gains(calibration.imu, calibration.weak, scales)


def unusual_gains(imu: Imu, weak: Sequence[WeakDirection], scales: Mapping[str, FloatArray]) -> list[Finding]:
    """Return the same of a fitted unit; `scales` (3,) by sensor: the nominal ones, `weak`: what the data leave open."""
    if gains_open(weak):
        return []
    findings = _factors("accelerometer", scales["accelerometer"], imu.accelerometer)
    if imu.gyroscope is None or "gyroscope" not in scales:
        return findings
    scale = scales["gyroscope"]
    read = np.asarray(imu.gyroscope.gain) / scale[:, None]  # rates as read = read @ true rates
    arranged = signed_permutation(read.T).T
    rest = rotation_of((arranged.T @ read).T).T
    if angle_of(rest) > _BETWEEN and np.linalg.det(read) > 0:
        arranged, rest = np.eye(3), rotation_of(read.T).T
    if not np.array_equal(arranged, np.eye(3)):
        findings.append(_axes(arranged))
    if (angle := np.degrees(angle_of(rest))) > np.degrees(_MOUNTED):
        axis = np.array([rest[2, 1] - rest[1, 2], rest[0, 2] - rest[2, 0], rest[1, 0] - rest[0, 1]])
        axis /= -max(float(np.linalg.norm(axis)), 1e-300)
        shown = ", ".join(f"{component:.2f}" for component in axis)
        findings.append(
            Finding(
                "setup.mounting",
                (),
                f"gyroscope: it is mounted turned by {angle:.1f}° about ({shown}) against the accelerometer's axes, "
                "more than misalignments are. The calibration includes it: what it corrects is in the accelerometer's "
                "axes.",
            )
        )
    return findings + _factors("gyroscope", scale, imu.gyroscope)


def axes_unlike(recording: Recording, imu: Imu) -> str:
    """Say which axes of a recording are not those of a calibrated unit, as gravity turns in it; else nothing.

    Outputs f' = M f of an accelerometer make the rates look like det(M) M ω: so the calibration's own axes are undone.
    Where all signs of f are turned round, turns look the same, and gravity is the same size without the bias alone.
    """
    force = recording.accelerometer.values
    if not len(force):
        return ""
    means = np.array([part.mean(axis=0) for part in np.array_split(force, min(len(force), _MEANS))])
    sizes = [lengths_of(imu.accelerometer.recover_on_host(sign * means)) for sign in (1, -1)]
    kept, turned = (robust_sigma(size - np.median(size)) for size in sizes)
    if kept > _CLEARER * turned:
        return (
            " Against the calibration, the accelerometer has all its signs turned round, as a logger of −f has. Turn "
            "them round in the log, or calibrate it by itself."
        )
    motion, gyroscope = recording.turning, recording.gyroscope
    if motion is None or not motion.clear or gyroscope is None or imu.gyroscope is None:
        return ""
    force = signed_permutation(np.asarray(imu.accelerometer.gain).T).T
    rates = np.asarray(imu.gyroscope.gain) / gyroscope.nominal_scale[:, None]
    arranged = signed_permutation(np.linalg.det(force) * force.T @ motion.matrix @ rates)
    if np.array_equal(arranged, np.eye(3)):
        return ""
    return (
        f" Against the calibration, {_axes(arranged.T).text.partition('. --axes')[0]}. Give the columns in the "
        "calibration's order and signs, or calibrate this log by itself."
    )


def _axes(arranged: FloatArray) -> Finding:
    """Name the axes; `arranged` (3, 3): rates as read, in multiples of the true ones.

    A gyroscope in wrong axes looks like an accelerometer in the inverse ones, up to a sign that turns with handedness:
    f' = M f makes ω look like det(M) M ω. So an accelerometer can be at fault where the determinant is one.
    """
    causes = [("gyroscope", arranged.T)]
    rivals: list[str] = []
    if np.linalg.det(arranged) > 0:
        causes += [("accelerometer", arranged), ("accelerometer", -arranged)]
        # those of the fewest axes exchanged or turned round
        causes = sorted(causes, key=lambda cause: (np.diag(cause[1]) != 1).sum() + (cause[1] < 0).sum())[:2]
        rivals.append("setup.mounting")
    name, repaired = causes[0]
    option = f"{'gyro' if name == 'gyroscope' else 'accel'}={spelled_axes(repaired)}"
    text = f'{name}: {_described(repaired)}. --axes "{option}" puts it right; the calibration includes it either way.'
    if rivals:
        other, instead = causes[1]
        text += (
            f" The recording cannot distinguish this from {other} axes that are {spelled_axes(instead)}, or from a "
            "gyroscope "
            f"mounted turned by {np.degrees(angle_of(arranged)):.0f}°."
        )
    elif np.array_equal(arranged, -np.eye(3)):
        rivals.append("data.order")
        text += " Rows in reverse, or both sensors in left-handed axes, look exactly the same."
    return Finding(
        "data.swapped_axes",
        (),
        text,
        f'--axes "{option}"',
        tuple(rivals),
        apply=lambda recording: apply_axes(recording, option),
    )


def _described(matrix: FloatArray) -> str:
    """Say what a map of axes puts right."""
    exchanged = [axis for axis, row in zip("xyz", abs(np.diag(matrix)), strict=True) if row == 0]
    negative = [axis for axis, row in zip("xyz", matrix.sum(axis=1), strict=True) if row < 0]
    parts = []
    if exchanged:
        parts.append(f"its {listed(exchanged)} axes are exchanged")
    if negative:
        one = len(negative) == 1
        which = "all three axes" if len(negative) == 3 else f"its {listed(negative)} {'axis' if one else 'axes'}"
        parts.append(f"{which} {'has' if one else 'have'} the wrong sign")
    return ", and ".join(parts)


def _factors(name: str, scale: FloatArray, triad: Triad) -> list[Finding]:
    """Name scales that are a whole factor off the data sheet's, or off by more than sensors are."""
    sizes = triad.scales / scale
    logarithm = np.log(sizes)
    usual, odd = float(np.exp(logarithm.mean())), abs(logarithm) > _ODD
    option = "--accel-scale" if name == "accelerometer" else "--gyro-scale"
    like = "another full-scale range" + (", or a sample rate that is as far off" if name == "gyroscope" else "")
    near = abs(np.log(np.divide.outer(sizes, _FACTORS))) < _NEAR
    whole = (near * _FACTORS).max(axis=1)

    def of_range(sensor: str, size: float, text: str) -> Finding:
        return Finding("data.range", (), f"{sensor}: its gain is {size:.3g} times the nominal{text}")

    if whole.all() and len(set(whole)) == 1:
        text = f" on all axes, as with {like}. State the range that was set ({option}); the calibration includes it."
        return [of_range(name, usual, text)]
    if odd.all() and np.ptp(logarithm) < _NEAR:
        text = f" on all axes, more than such sensors differ. Check {option}; the calibration includes it."
        return [of_range(name, usual, text)]
    another = (
        ", a whole factor, as with another full-scale range or unit on this axis. The calibration includes it.",
        f", more than such sensors differ. Check {option}.",
    )
    findings = [
        of_range(f"{name} {axis}", size, another[0 if factor else 1])
        for axis, size, factor, far in zip("xyz", sizes, whole, odd, strict=True)
        if factor or far
    ]
    if name == "gyroscope" and not findings and abs(usual - 1) > _SLOW and np.ptp(sizes) < _ALIKE:
        findings.append(
            Finding(
                "data.time_scale",
                (),
                f"{name}: all its axes read {100 * (usual - 1):+.2f} % of the nominal alike. A sample rate or clock "
                f"that is {100 * abs(usual - 1):.2f} % {'slow' if usual > 1 else 'fast'} looks exactly the same: "
                "compare the recording's length with another clock.",
                rivals=("data.range",),
            )
        )
    return findings
