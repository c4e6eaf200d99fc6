"""Magnetometers: simulated units against truth, measured ones on parts and recordings left out."""

import os
import sys
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import jax
import numpy as np
import scipy.stats
from common import Table, arguments, finish
from magnetic_motion import turned
from scipy.spatial.transform import Rotation

from jaximu.calibration import FieldStrength, MagneticLog, calibrate_magnetometer
from jaximu.calibration.magnetometer import ellipsoid
from jaximu.diagnosis import diagnose_magnetometer
from jaximu.errors import NotPossibleError
from jaximu.formats import ReadOptions, read_magnetometer, read_recording
from jaximu.measurements.field import windows_of
from jaximu.mistakes import make_ready
from jaximu.recording import Signal

jax.config.update("jax_enable_x64", True)
AXES = "accel=x,y,-z"
TURNS = ("rotate_ccw_around_x_pointing_up", "rotate_ccw_around_x_pointing_forward", "rotate_ccw_around_y_pointing_left",
         "rotate_ccw_around_z_pointing_up", "roll_and_tilt_at_45_90")  # fmt: skip


def simulated(units: int, reach: float) -> dict:
    """Errors of gain and bias over their standard deviations, and lengths of the bias's error."""
    errors, lengths = [], []
    for seed in range(units):
        case = turned(1000 + seed, reach=reach)
        log = MagneticLog(case.magnetometer, case.recording)
        try:
            found, _, _ = calibrate_magnetometer([log], FieldStrength(case.strength))
        except NotPossibleError:
            continue
        triad, (gain, bias) = found.imu.magnetometer, found.sigma("magnetometer")
        errors.append(np.concatenate([((triad.gain - case.gain) / gain).ravel(), (triad.bias - case.bias) / bias]))
        rows = [k for k, name in enumerate(found.names) if name.owner == "magnetometer" and name.part == "bias"]
        off = triad.bias - case.bias
        lengths.append(off @ np.linalg.solve(found.covariance[np.ix_(rows, rows)], off))
    return {"errors": np.array(errors), "lengths": np.array(lengths)}


def disturbed(units: int) -> dict:
    """Windows with and without a disturbance of 15 µT for four seconds of a minute, and how many were left out."""
    counts = {"found": 0, "disturbed": 0, "false": 0, "undisturbed": 0}
    for seed in range(units):
        start = 8.0 + 44.0 * seed / units
        case = turned(3000 + seed, disturbed=(start, start + 4.0))
        log = MagneticLog(case.magnetometer, case.recording)
        windows = windows_of(log.magnetometer, log.recording, np.zeros(3))
        found, _, _ = calibrate_magnetometer([log], FieldStrength(case.strength))
        left = {round(each[0], 6) for each in found.magnetic["disturbed"]}
        stop = windows.path.time[np.arange(len(windows)), windows.count.astype(int) - 1]
        inside = (windows.time[:, 0] >= start) & (stop <= start + 4.0)  # of the samples in its mean
        outside = (stop < start) | (windows.time[:, 0] > start + 4.0)
        out = np.array([round(each, 6) in left for each in windows.time[:, 0]])
        counts["found"] += int(out[inside].sum())
        counts["disturbed"] += int(inside.sum())
        counts["false"] += int(out[outside].sum())
        counts["undisturbed"] += int(outside.sum())
    return counts


def asked(units: int) -> dict:
    """Units of which an effect is hidden, and those with none: what a diagnosis names."""
    hidden = {"none": 0.0, "mag.lag, 10 ms": 1.0, "mag.hard_iron_step, 2 µT": 1.0, "mag.current, 1 µT/A": 1.0}
    named: dict = {name: [] for name in hidden}
    for seed in range(units):
        case = turned(4000 + seed)
        time, values = case.magnetometer.time, case.magnetometer.values
        flow = np.where(np.sin(2 * np.pi * time / 7) > 0, 2.0, 0.0)
        recording = replace(case.recording, current=Signal(time, flow, "A"))
        way = np.random.default_rng(seed).standard_normal(3)
        way /= np.linalg.norm(way)
        late = np.stack([np.interp(time - 0.01, time, axis) for axis in values.T], 1)
        outputs = (values, late, values + np.outer(time > 31.7, 2.0 * way), values + np.outer(flow, way))
        for name, output in zip(hidden, outputs, strict=True):
            log = MagneticLog(replace(case.magnetometer, values=output), recording)
            found, measurement, _ = calibrate_magnetometer([log], FieldStrength(case.strength))
            named[name].append([each.effect.name for each in diagnose_magnetometer(found, measurement).causes])
    return named


def against_optics(path: Path) -> tuple[Table, dict]:
    """Direction of north by the magnetometer in the frame of the optics, on parts left out of the calibration."""
    whole = read_recording(path)
    magnetometer = whole.magnetometer
    table = Table(
        "Heading on BROAD 02, magnetometer against optics, degrees rms, on the part that was left out",
        ["left out", "as logged", "calibrated", "algebraic ellipsoid"],
        "The vertical is the optics'. A constant is taken off each part, for nobody knows the optics' north.",
    )

    def cut(signal: Signal, edges: tuple[float, float]) -> Signal:
        rows = (signal.time >= edges[0]) & (signal.time < edges[1])
        return Signal(signal.time[rows], signal.values[rows], signal.unit)

    def logged(edges: tuple[float, float]) -> MagneticLog:
        part = replace(
            whole, accelerometer=cut(whole.accelerometer, edges), gyroscope=cut(whole.gyroscope, edges),
            magnetometer=None, attitude=None,
        )  # fmt: skip
        return MagneticLog(cut(magnetometer, edges), part)

    def errors(field, time) -> np.ndarray:
        optics = whole.attitude
        nearest = np.clip(np.searchsorted(optics.time, time), 0, len(optics) - 1)
        near = np.abs(optics.time[nearest] - time) < 0.01
        level = Rotation.from_quat(optics.values[nearest[near]], scalar_first=True).apply(field[near])
        turned = np.exp(1j * np.arctan2(level[:, 0], level[:, 1]))
        return np.degrees(np.angle(turned / np.mean(turned)))

    figures = {}
    ends = np.linspace(0.0, float(magnetometer.time[-1]) + 1.0, 11)
    plans = {"second half": [(5, 10)], "first half": [(0, 5)], "fifths in turn": [(k, k + 2) for k in range(0, 10, 2)]}
    for name, parts in plans.items():
        found: dict[str, list] = {"as logged": [], "calibrated": [], "algebraic": []}
        for first, last in parts:
            edges = [(ends[a], ends[b]) for a, b in ((0, first), (last, 10)) if b > a]
            triad = calibrate_magnetometer([logged(each) for each in edges])[0].imu.magnetometer
            shape = ellipsoid(np.concatenate([cut(magnetometer, each).values for each in edges]))
            rest = cut(magnetometer, (ends[first], ends[last]))
            found["as logged"].append(errors(rest.values, rest.time))
            found["calibrated"].append(errors(np.linalg.solve(triad.gain, (rest.values - triad.bias).T).T, rest.time))
            found["algebraic"].append(errors((rest.values - shape[1]) @ shape[0], rest.time))
        figures[name] = {k: float(np.sqrt(np.mean(np.concatenate(each) ** 2))) for k, each in found.items()}
        table.add(name, *(f"{each:.2f}" for each in figures[name].values()))
    return table, figures


def compass(folder: Path, name: str) -> MagneticLog:
    """One recording of the HMC5883L beside the MPU-6050."""
    recording = read_recording(folder / f"{name}.parquet", options=ReadOptions(axes=AXES))
    signal, start, _ = read_magnetometer(folder / f"{name}.mag.parquet")
    signal = replace(signal, time=signal.time + (start - float(recording.start)))
    return MagneticLog(signal, recording, name)


def mended(log: MagneticLog) -> MagneticLog:
    """Return a log with bursts of stamps and spikes mended, as a calibration sees it."""
    signal = make_ready(replace(log.recording, magnetometer=log.magnetometer), magnetometer=True).recording.magnetometer
    return MagneticLog(signal, make_ready(log.recording).recording, log.name)


def heading_rms(log: MagneticLog, inverse: np.ndarray) -> float:
    """Degrees, rms, by which the heading leaves the one that the gyroscope carries, less a straight line."""
    windows = windows_of(log.magnetometer, log.recording, np.zeros(3))
    field = np.einsum("nijk,jk->ni", windows.slope, inverse)
    east = np.cross(field, windows.up)
    east /= np.linalg.norm(east, axis=1, keepdims=True)
    level = np.stack([east, np.cross(windows.up, east), windows.up], axis=1)
    carried, yaw = level[0].copy(), []
    for k in range(len(windows)):
        turn = level[k] @ carried.T
        yaw.append(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
        carried = carried @ windows.carried[k]
    calm = windows.off < 0.1
    time = windows.time.mean(axis=1)
    design = np.stack([np.ones(len(time)), time - time.mean()], axis=1)
    angle = np.unwrap(yaw)
    line = np.linalg.lstsq(design[calm], angle[calm], rcond=None)[0]
    return float(np.degrees(np.sqrt(np.mean((angle - design @ line)[calm] ** 2))))


def measured(data: Path) -> tuple[list[Table], dict]:
    """The two measured magnetometers."""
    spread = Table(
        "Strength of the field on fifths left out, standard deviation over mean",
        ["recording", "as logged", "algebraic ellipsoid", "jaximu", "the sensor's noise", "coverage"],
    )
    figures = {}
    counts, _, _ = read_magnetometer(data / "magnetometer/qmc5883l_ellipsoid.csv", ReadOptions(columns="mag [count]"))
    folder = data / "mpu6050_hmc5883l"
    full = compass(folder, "full_sphere")
    logs = {"QMC5883L alone": MagneticLog(counts), "HMC5883L beside an MPU-6050": full}
    found = {}
    for name, log in logs.items():
        found[name], _, _ = calibrate_magnetometer([log])
        each = found[name].magnetic
        shares = [each["norm_spread"][key] for key in ("before", "algebraic", "after", "noise")]
        spread.add(name, *(f"{100 * share:.2f} %" for share in shares), f"{100 * each['coverage']:.0f} %")
        figures[name] = each
    triad = found["HMC5883L beside an MPU-6050"].imu.magnetometer
    inverse = np.asarray(triad.inverse())
    raw = np.concatenate([np.diag(np.sign(np.diagonal(np.asarray(triad.gain)))), np.zeros((3, 1))], axis=1)
    table = Table("Heading in other recordings of that unit, against the gyroscope's",
                  ["recording", "as logged", "calibrated", "calibrated, stamps mended"],
                  "Degrees, rms, less a straight line for the gyroscope's bias; the vertical is the accelerometer's, "
                  "which the hand shakes. Calibrated on the full sphere only.")  # fmt: skip
    for name in TURNS:
        log = compass(folder, name)
        pair = [heading_rms(log, each) for each in (raw, inverse)] + [heading_rms(mended(log), inverse)]
        table.add(name.replace("_", " "), *(f"{each:.1f}" for each in pair))
        figures[name] = pair
    optical, figures["broad"] = against_optics(data / "broad/02_undisturbed_slow_rotation_B.mat")
    return [spread, table, optical], figures


def main() -> None:
    """Run all."""
    options = arguments(__doc__)
    units = 4 if options.small else 24
    table = Table(
        f"{units} simulated units a row: intervals and hard iron",
        [
            "motion",
            "refused",
            "95 % intervals that hold",
            "squared error of hard iron over its variance",
            "rms error over bound, all twelve",
        ],
    )
    figures = {}
    for words, reach in (("all round, 60 s", np.pi), ("±30°, 60 s", 0.5)):
        found = simulated(units, reach)
        held, total = int(np.sum(np.abs(found["errors"]) < 1.96)), found["errors"].size
        done = len(found["lengths"])
        low, high = scipy.stats.chi2.ppf([0.025, 0.975], 3 * done) / (3 * done)
        table.add(
            words,
            f"{units - done}",
            f"{100 * held / total:.1f} %",
            f"{found['lengths'].mean() / 3:.2f} ({low:.2f} to {high:.2f})",
            f"{np.sqrt(np.mean(found['errors'] ** 2)):.3f}",
        )
        figures[words] = {"held": held, "of": total, "lengths": found["lengths"].tolist()}
    stretches = disturbed(units // 2)
    figures["disturbed"] = stretches
    other = Table("A field disturbed for four seconds of a minute by 15 µT", ["windows", "number", "left out"])
    other.add(
        "disturbed throughout",
        f"{stretches['disturbed']}",
        f"{100 * stretches['found'] / stretches['disturbed']:.1f} %",
    )
    other.add(
        "undisturbed", f"{stretches['undisturbed']}", f"{100 * stretches['false'] / stretches['undisturbed']:.2f} %"
    )
    names = Table("What a diagnosis names", ["hidden", "units", "named alone", "something else named", "nothing named"])
    figures["named"] = asked(2 if options.small else 4)
    for name, found in figures["named"].items():
        right = sum(each == [name.partition(",")[0]] for each in found)
        none = sum(not each for each in found)
        names.add(name, f"{len(found)}", f"{right}", f"{len(found) - right - none}", f"{none}")
    tables, more = measured(Path(os.environ["JAXIMU_DATA"])) if os.environ.get("JAXIMU_DATA") else ([], {})
    finish("magnetometer", [table, other, names, *tables], figures | more, keep=not options.small)


if __name__ == "__main__":
    main()
