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

from jaximu.calibration import FieldStrength, MagneticLog, calibrate_magnetometer
from jaximu.errors import NotPossibleError
from jaximu.formats import ReadOptions, read_magnetometer, read_recording
from jaximu.measurements.field import windows_of

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


def compass(folder: Path, name: str) -> MagneticLog:
    """One recording of the HMC5883L beside the MPU-6050."""
    recording = read_recording(folder / f"{name}.parquet", options=ReadOptions(axes=AXES))
    signal, start, _ = read_magnetometer(folder / f"{name}.mag.parquet")
    return MagneticLog(replace(signal, time=signal.time + (start - float(recording.start))), recording, name)


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
                  ["recording", "as logged", "calibrated"],
                  "Degrees, rms, less a straight line for the gyroscope's bias; the vertical is the accelerometer's, "
                  "which the hand shakes. Calibrated on the full sphere only.")  # fmt: skip
    for name in TURNS:
        log = compass(folder, name)
        pair = [heading_rms(log, each) for each in (raw, inverse)]
        table.add(name.replace("_", " "), *(f"{each:.1f}" for each in pair))
        figures[name] = pair
    return [spread, table], figures


def main() -> None:
    """Run all."""
    options = arguments(__doc__)
    units = 4 if options.small else 40
    table = Table(
        f"{units} simulated units a row: intervals and hard iron",
        ["motion", "refused", "95 % intervals that hold", "squared error of hard iron over its variance"],
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
        )
        figures[words] = {"held": held, "of": total, "lengths": found["lengths"].tolist()}
    tables, more = measured(Path(os.environ["JAXIMU_DATA"])) if os.environ.get("JAXIMU_DATA") else ([], {})
    finish("magnetometer", [table, *tables], figures | more, keep=not options.small)


if __name__ == "__main__":
    main()
