"""Magnetometers: simulated units against truth, measured ones on parts and recordings left out."""

import os
import sys
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import jax
import numpy as np
import scipy.stats
from common import Table, arguments, finish
from magnetic_motion import PERFECT, Turned, bent, turned
from scipy.spatial.transform import Rotation

from jaximu.calibration import FieldStrength, MagneticLog, calibrate_magnetometer, nominal_imu
from jaximu.calibration.magnetometer import carried_headings, ellipsoid
from jaximu.data.field import windows_of
from jaximu.diagnosis import diagnose_magnetometer
from jaximu.fleets import FleetUnit, fit_units
from jaximu.fleets.field import field_unit
from jaximu.ground.errors import NotPossibleError
from jaximu.mistakes import prepare
from jaximu.model import Noise, White
from jaximu.model.sensor import Imu, Triad
from jaximu.recordings.readers import ReadOptions, read_magnetometer, read_recording
from jaximu.recordings.recording import Signal
from jaximu.recordings.segmentation import observed_poses, segment
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import Environment, HandHeld

jax.config.update("jax_enable_x64", True)
AXES = "accel=x,y,-z"
TURNS = ("rotate_ccw_around_x_pointing_up", "rotate_ccw_around_x_pointing_forward", "rotate_ccw_around_y_pointing_left",
         "rotate_ccw_around_z_pointing_up", "roll_and_tilt_at_45_90")  # fmt: skip


def simulated(units: int, by_data_sheet: float = 0.0, **motion: float) -> dict:
    """Errors of units that are turned, against their stated standard deviations and beside an algebraic ellipsoid's.

    by_data_sheet: share by which gains of accelerometer and gyroscope are off, which no calibration knows; 0: exact.

    errors (u, 12): of gain and bias over their own; lengths (u,): of the bias's error, squared, over its covariance;
    heading (u, 6, 24): errors over their own by attitude. hard_iron, algebraic: how far the bias is off, µT; radius:
    error of the algebraic ellipsoid's mean radius over itself. fitted, tried: ellipsoids.
    """
    found: dict[str, list] = {key: [] for key in ("errors", "lengths", "heading", "hard_iron", "algebraic", "radius")}
    for seed in range(units):
        case = turned(1000 + seed, **motion)
        shape = ellipsoid(case.magnetometer.values)
        if shape is not None:
            found["algebraic"].append(float(np.linalg.norm(shape[1] - case.bias)))
            true = case.strength * np.cbrt(np.linalg.det(case.gain))
            found["radius"].append(float(1 / np.cbrt(np.linalg.det(shape[0])) / true - 1))
        log = MagneticLog(case.magnetometer, bent(case, seed, by_data_sheet))
        known = None if by_data_sheet else PERFECT
        try:
            calibration, _, heading = calibrate_magnetometer([log], FieldStrength(case.strength), known)
        except NotPossibleError:
            continue
        triad, (gain, bias) = calibration.imu.magnetometer, calibration.sigma("magnetometer")
        off = triad.bias - case.bias
        found["errors"].append(np.concatenate([((triad.gain - case.gain) / gain).ravel(), off / bias]))
        rows = [k for k, name in enumerate(calibration.names) if name.owner == "magnetometer" and name.part == "bias"]
        found["lengths"].append(off @ np.linalg.solve(calibration.covariance[np.ix_(rows, rows)], off))
        found["hard_iron"].append(float(np.linalg.norm(off)))
        found["heading"].append(heading_off(case, triad, heading) / heading.sigma)
    return {key: np.array(each) for key, each in found.items()} | {"tried": units}


def heading_off(case: Turned, triad, heading) -> np.ndarray:
    """Errors (6, 24), degrees, of headings in the true field, of a unit whose vertical is known."""
    angles = np.stack(np.broadcast_arrays(heading.heading[None], heading.tilts[:, 1:], heading.tilts[:, :1]), axis=-1)
    attitude = Rotation.from_euler("ZYX", angles.reshape(-1, 3), degrees=True)
    body = attitude.inv().apply(case.strength * np.array([0.0, np.cos(case.dip), -np.sin(case.dip)]))
    level = attitude.apply(np.linalg.solve(triad.gain, (body @ case.gain.T + case.bias - triad.bias).T).T)
    return np.degrees(np.arctan2(level[:, 0], level[:, 1])).reshape(angles.shape[:2])


def share(held: np.ndarray) -> str:
    """Write the share of intervals that hold (u, k), with its own 95 % interval: units are apart, their numbers not."""
    each = held.reshape(len(held), -1).mean(axis=1)
    return f"{100 * each.mean():.1f} ± {196 * each.std(ddof=1) / np.sqrt(len(each)):.1f} %"


def rms(values) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def disturbed(units: int) -> dict:
    """Windows with and without a disturbance of 15 µT for four seconds of a minute, and how many were left out."""
    counts = {"found": 0, "disturbed": 0, "false": 0, "undisturbed": 0}
    for seed in range(units):
        start = 8.0 + 44.0 * seed / units
        case = turned(5000 + seed, disturbed=(start, start + 4.0))
        log = MagneticLog(case.magnetometer, case.recording)
        windows = windows_of(log.magnetometer, log.recording, np.zeros(3))
        found, _, _ = calibrate_magnetometer([log], FieldStrength(case.strength), PERFECT)
        left = {round(each[0], 6) for each in found.magnetic["disturbed"]}
        stop = windows.samples.track.stimulus.time[np.arange(len(windows)), windows.count.astype(int) - 1]
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
            found, measurement, _ = calibrate_magnetometer([log], FieldStrength(case.strength), PERFECT)
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
    signal = prepare(replace(log.recording, magnetometer=log.magnetometer), magnetometer=True).recording.magnetometer
    return MagneticLog(signal, prepare(log.recording).recording, log.name)


def alignment(calibration) -> tuple[np.ndarray, np.ndarray]:
    """Return the turn (3,), degrees, from the accelerometer's axes to the magnetometer's, and standard deviations (3,).

    The rotation of the gain's polar decomposition; what is uncertain of the gain is carried through by differences.
    """

    def turn(gain) -> np.ndarray:
        left, _, right = np.linalg.svd(gain)
        return Rotation.from_matrix(signs @ left @ right).as_rotvec(degrees=True)

    gain = np.asarray(calibration.imu.magnetometer.gain)
    signs = np.diag(np.sign(np.diagonal(gain)))
    rows = [k for k, name in enumerate(calibration.names) if name.owner == "magnetometer" and name.part == "gain"]
    slopes = []
    for row in rows:
        step = np.zeros((3, 3))
        step[calibration.names[row].axes] = 1e-6
        slopes.append((turn(gain + step) - turn(gain - step)) / 2e-6)
    spread = np.array(slopes).T @ calibration.covariance[np.ix_(rows, rows)] @ np.array(slopes)
    return turn(gain), np.sqrt(np.diagonal(spread))


def heading_rms(log: MagneticLog, inverse: np.ndarray) -> float:
    """Degrees, rms, by which the heading leaves the one that the gyroscope carries, less a straight line."""
    windows = windows_of(log.magnetometer, log.recording, np.zeros(3))
    gain = np.linalg.inv(inverse[:, :3])
    imu = replace(Imu.nominal(), magnetometer=Triad(gain, -gain @ inverse[:, 3], quantity="magnetic_field"))
    return float(np.degrees(rms(carried_headings(windows, imu, np.arange(len(windows))))))


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
    turns = Table(
        "Turn from the accelerometer's axes to the magnetometer's, degrees, 95 %",
        ["calibrated on", "about x", "about y", "about z"],
        "Each recording by itself, accelerometer and gyroscope by their data sheets: no recording calibrates them.",
    )
    for name in ("full_sphere", *TURNS):
        try:
            calibration, _, _ = calibrate_magnetometer([compass(folder, name)])
        except NotPossibleError as error:
            turns.add(name.replace("_", " "), f"refused: {str(error).partition(': ')[2].partition('.')[0]}", "", "")
            continue
        value, sigma = alignment(calibration)
        turns.add(name.replace("_", " "), *(f"{a:.2f} ± {1.96 * b:.2f}" for a, b in zip(value, sigma, strict=True)))
        figures[f"{name}, alignment"] = [value.tolist(), sigma.tolist()]
    optical, figures["broad"] = against_optics(data / "broad/02_undisturbed_slow_rotation_B.mat")
    return [spread, table, turns, optical], figures


def left_out(small: bool) -> None:
    """Write how many windows of a disturbed field are left out."""
    stretches = disturbed(2 if small else 20)
    other = Table("A field disturbed for four seconds of a minute by 15 µT", ["windows", "number", "left out"])
    other.add(
        "disturbed throughout",
        f"{stretches['disturbed']}",
        f"{100 * stretches['found'] / stretches['disturbed']:.1f} %",
    )
    other.add(
        "undisturbed", f"{stretches['undisturbed']}", f"{100 * stretches['false'] / stretches['undisturbed']:.2f} %"
    )
    finish("magnetometer_disturbed", [other], stretches, keep=not small, script="magnetometer")


def fleet(small: bool) -> None:
    """Write the time of many magnetometers beside that of their accelerometers, in turns, both from the same rests."""
    noise = consumer_noise() | {"magnetometer": Noise((White(0.03),), "magnetic_field")}
    made: dict[str, list] = {"accelerometers": [], "magnetometers": []}
    reduced = dict.fromkeys(made, 0.0)
    for seed in range(8 if small else 64):
        rng = np.random.default_rng(seed)
        gain, bias = np.eye(3) + 0.05 * rng.standard_normal((3, 3)), rng.normal(0, 20.0, 3)
        imu = replace(draw_imu(seed), magnetometer=Triad(gain, bias, quantity="magnetic_field", output_unit="uT"))
        recording, _ = simulate(
            imu, HandHeld(40 - seed % 5, 1.5), noise, seed=seed, environment=Environment(field=50.0, dip=60.0)
        )
        found = segment(recording)
        alone = replace(found, recording=replace(recording, gyroscope=None, magnetometer=None))
        ways = {
            "accelerometers": lambda part=alone: FleetUnit(
                observed_poses(part, 9.80665), nominal_imu(part.recording), False
            ),
            "magnetometers": lambda one=recording.magnetometer, part=found: field_unit(one, part, None, "").unit,
        }
        for name, way in ways.items():
            began = time.process_time()
            made[name].append(way())
            reduced[name] += time.process_time() - began
    count = 256 if small else 10_000
    spent: dict[str, list[float]] = {name: [] for name in made}
    for _ in range(4):  # the first compiles
        for name, units in made.items():
            many = (units * (count // len(units) + 1))[:count]
            began = time.process_time()
            for first in range(0, count, 1024):  # as a run takes them
                assert all(each.converged for each, _ in fit_units(many[first : first + 1024]))
            spent[name].append((time.process_time() - began) / count)
    table = Table(
        f"A fleet of {count} units, 36 to 40 rests: ms of the processor a unit",
        ["", "fit", "from samples to means and start"],
        "Least of three times, in turns. Hard and soft iron by the field's strength, in the program of accelerometers.",
    )
    fits = {name: min(times[1:]) for name, times in spent.items()}
    starts = {name: each / len(made[name]) for name, each in reduced.items()}
    for name in made:
        table.add(name, f"{1e3 * fits[name]:.3f}", f"{1e3 * starts[name]:.2f}")
    table.add("magnetometers over accelerometers (goal ≤ 2)",
              *(f"{each['magnetometers'] / each['accelerometers']:.2f}" for each in (fits, starts)))  # fmt: skip
    finish("magnetometer_fleet", [table], {"fit": fits, "start": starts}, keep=not small, script="magnetometer")


def main() -> None:
    """Run all."""
    options = arguments(
        __doc__, fleet="many units at once", disturbed="stretches that are left out", measured="measured recordings"
    )
    if options.fleet:
        return fleet(options.small)
    if options.disturbed:
        return left_out(options.small)
    if options.measured:
        tables, more = measured(Path(os.environ["JAXIMU_DATA"]))
        return finish("magnetometer_measured", tables, more, keep=not options.small, script="magnetometer")
    units = 4 if options.small else 200
    table = Table(
        "Simulated units, a minute each: intervals and bounds",
        ["motion", "units", "refused", "95 % intervals that hold, all twelve", "of headings, by attitude",
         "squared error of hard iron over its variance", "rms error over bound, all twelve"],
        "± is 95 %, units taken as independent.",
    )  # fmt: skip
    beside = Table(
        "The same units beside an algebraic ellipsoid",
        ["motion", "hard iron off, jaximu, µT rms", "algebraic, µT rms (median)", "no ellipsoid",
         "bias of its mean radius"],
    )  # fmt: skip
    figures = {}
    motions = {"all round": (units, {}), "±30°": (units, {"reach": 0.5}),
               "±60°, noise 1.5 µT": (units // 4, {"reach": 1.0, "noise": 1.5}),
               "all round, IMU off by 2 %": (units // 4, {"by_data_sheet": 0.02})}  # fmt: skip
    for words, (count, motion) in motions.items():
        found = simulated(count, **motion)
        done = len(found["lengths"])
        low, high = scipy.stats.chi2.ppf([0.025, 0.975], 3 * done) / (3 * done)
        table.add(
            words,
            f"{count}",
            f"{count - done}",
            share(np.abs(found["errors"]) < 1.96),
            share(np.abs(found["heading"]) < 1.96),
            f"{found['lengths'].mean() / 3:.2f} ({low:.2f} to {high:.2f} where intervals are right)",
            f"{rms(found['errors']):.3f}",
        )
        radius, fits = found["radius"], len(found["algebraic"])
        beside.add(
            words,
            f"{rms(found['hard_iron']):.2g}",
            f"{rms(found['algebraic']):.2g} ({np.median(found['algebraic']):.2g})",
            f"{count - fits} of {count}",
            f"{100 * radius.mean():+.2f} ± {196 * radius.std(ddof=1) / np.sqrt(fits):.2f} %",
        )
        print(table.rows[-1], beside.rows[-1], file=sys.stderr)
        figures[words] = {key: np.asarray(each).tolist() for key, each in found.items() if key != "heading"}
    names = Table("What a diagnosis names", ["hidden", "units", "named alone", "something else named", "nothing named"])
    figures["named"] = asked(2 if options.small else 4)
    for name, found in figures["named"].items():
        right = sum(each == [name.partition(",")[0]] for each in found)
        none = sum(not each for each in found)
        names.add(name, f"{len(found)}", f"{right}", f"{len(found) - right - none}", f"{none}")
    finish("magnetometer", [table, beside, names], figures, keep=not options.small)


if __name__ == "__main__":
    main()
