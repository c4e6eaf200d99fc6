"""Against a measured attitude: fitted on one recording or half, tried on the other; simulated units with known truth.

`python benchmarks/reference.py [--small]`; with `JAXIMU_DATA` the measured recordings.
"""

import os
import sys
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import attitude_motion
import jax
import numpy as np
import scipy.spatial.transform
from common import Table, arguments, finish, share

from jaximu import LocalGravity, Recording, read_recording
from jaximu.calibration import calibrate_against_attitude
from jaximu.data.attitude import AgainstAttitude
from jaximu.recordings.attitude import Attitude
from jaximu.recordings.readers import read_attitude
from jaximu.recordings.recording import Signal

jax.config.update("jax_enable_x64", True)
LOW = np.tril_indices(3)
CASES = {
    **{f"tracker 50 Hz, {abs(late)} ms {'late' if late > 0 else 'early' if late else 'off'}": {"delay": 1e-3 * late}
       for late in (0, 5, -5, 200, -200)},
    "tracker 10 Hz, 200 ms early": {"tracked": 10.0, "delay": -0.2},
    "tracker 500 Hz, ten times its noise": {"tracked": 500.0, "attitude_noise": 3e-3},
    "a minute, log's clock 50 ppm fast": {"drift": 5e-5},
    "six minutes, log's clock 100 ppm fast": {"duration": 400.0, "drift": 1e-4},
    "tracker's filter: a lag of 20 ms": {"lag": 0.02},
    "tracker's filter: a lag of 50 ms": {"lag": 0.05},
    "tracker's filter: three lags of 20 ms": {"lag": 0.02, "stages": 3},
    "unit 150 mm beside the tracked point": {"arm": (0.12, -0.05, 0.08)},
}  # fmt: skip


def cut(recording, start, stop):
    """The recording between two times."""

    def part(signal):
        if signal is None:
            return None
        kept = (signal.time >= start) & (signal.time < stop)
        return Signal(signal.time[kept], signal.values[kept], signal.unit)

    return Recording(part(recording.accelerometer), part(recording.gyroscope), start=recording.start)


def open_loop(recording, attitude, imu):
    """Angle (deg) by which the integrated attitude is off after all of the reference, mounting and clocks known."""
    gyroscope = recording.gyroscope
    setup = {each.name: np.asarray(each.coefficients) for each in imu.setup}
    delay, scale = setup["setup.reference_delay"][0], 1 + setup["setup.clock_scale"][0]
    mounting = scipy.spatial.transform.Rotation.from_rotvec(setup["setup.reference_rotation"])
    stamps = (attitude.time + (attitude.start - float(recording.start)) - delay) * scale
    inside = np.flatnonzero((stamps > gyroscope.time[1]) & (stamps < gyroscope.time[-2]))
    first, last = inside[0], inside[-1]
    rate = (gyroscope.values - np.asarray(imu.gyroscope.bias)) @ np.linalg.inv(np.asarray(imu.gyroscope.gain)).T
    edges = np.concatenate([[gyroscope.time[0]], (gyroscope.time[1:] + gyroscope.time[:-1]) / 2, [gyroscope.time[-1]]])
    held = np.maximum(np.minimum(edges[1:], stamps[last]) - np.maximum(edges[:-1], stamps[first]), 0.0)
    used = held > 0
    turned = scipy.spatial.transform.Rotation.identity()
    steps = scipy.spatial.transform.Rotation.from_rotvec(rate[used] * held[used, None] / scale)
    quaternion = np.array([0.0, 0.0, 0.0, 1.0])
    for x, y, z, w in steps.as_quat():  # the plain product, sample by sample
        a, b, c, d = quaternion
        quaternion = np.array([d * x + a * w + b * z - c * y, d * y - a * z + b * w + c * x,
                               d * z + a * y - b * x + c * w, d * w - a * x - b * y - c * z])  # fmt: skip
    turned = scipy.spatial.transform.Rotation.from_quat(quaternion)
    rotation = attitude.rotation()
    said = (rotation[first] * mounting).inv() * (rotation[last] * mounting)
    return float(np.degrees((said.inv() * turned).magnitude()))


def measured(folder, table, figures):
    """PSINS by halves, EuRoC's flights against each other, BROAD before and after."""
    gravity = LocalGravity(9.80665, 0.015)
    recording = read_recording(folder / "psins/mems.parquet")
    attitude = read_attitude(folder / "psins/fibre_optic_ins.parquet").usable()
    halves = [cut(recording, 0.0, 50.0), cut(recording, 50.0, 101.0)]
    for place, name in enumerate(("first half, tried on the second", "second half, tried on the first")):
        calibration, _ = calibrate_against_attitude(halves[place], attitude, gravity)
        other = AgainstAttitude(halves[1 - place], attitude, gravity.value, offset=attitude.start)
        bare = calibration.nominal.with_effects(*calibration.imu.setup)
        before, after = (np.sqrt(np.mean(np.sum(other.errors(each)["rotation"][1] ** 2, axis=1)))
                         for each in (bare, calibration.imu))  # fmt: skip
        offset = calibration.reference["time_offset"]
        table.add(f"PSINS, {name}", f"{before:.4f} → {after:.4f} °/s", f"{1e3 * offset['value']:.2f} ± "
                  f"{1.96e3 * offset['sigma']:.2f} ms", "; ".join(calibration.reference["open"])[:200])  # fmt: skip
        figures[f"PSINS, {name}"] = {"before": before, "after": after, "offset": offset}
    flights = {
        name: (read_recording(folder / f"euroc/{name}.imu.txt"), read_attitude(folder / f"euroc/{name}.truth.txt"))
        for name in ("MH03", "V102")
    }
    for fitted, tried in (("MH03", "V102"), ("V102", "MH03")):
        found, _ = calibrate_against_attitude(*flights[fitted], gravity)
        own, _ = calibrate_against_attitude(*flights[tried], gravity)
        setup = own.imu.setup
        raw = own.nominal.with_effects(*setup)
        bias = replace(raw, gyroscope=replace(raw.gyroscope, bias=found.imu.gyroscope.bias))
        full = found.imu.transferable().with_effects(*setup)
        angles = [open_loop(*flights[tried], each) for each in (raw, bias, full, own.imu)]
        offset = found.reference["time_offset"]
        table.add(f"EuRoC {fitted}, tried on {tried}: attitude after the flight, raw, bias, all, all of its own",
                  ", ".join(f"{each:.2f}" for each in angles) + " °", f"{1e3 * offset['value']:.3f} ± "
                  f"{1.96e3 * offset['sigma']:.3f} ms", "; ".join(found.reference["open"])[:200])  # fmt: skip
        figures[f"EuRoC {fitted} to {tried}"] = {"degrees": angles, "offset": offset}
    path = folder / "broad/02_undisturbed_slow_rotation_B.mat"
    found, _ = calibrate_against_attitude(read_recording(path), read_attitude(path), gravity)
    before, after, _ = found.rms["rotation"]
    offset = found.reference["time_offset"]
    gain, sigma = np.asarray(found.imu.gyroscope.gain), found.sigma("gyroscope")[0]
    scales = ", ".join(f"{g:.4f} ± {1.96 * s:.4f}" for g, s in zip(np.diag(gain), np.diag(sigma), strict=True))
    table.add("BROAD 02, optics", f"{before:.3f} → {after:.3f} °/s; gyroscope scales {scales}",
              f"{1e3 * offset['value']:.2f} ± {1.96e3 * offset['sigma']:.2f} ms",
              "; ".join(found.reference["open"])[:200])  # fmt: skip
    figures["BROAD"] = {"before": before, "after": after, "offset": offset}


def errors(made):
    """Errors of a simulated unit's numbers, and of the set-up's, over their standard deviations."""
    recording = Recording(Signal(made.time, made.force, "m/s^2"), Signal(made.time, made.rate, "rad/s"))
    attitude = Attitude(made.stamp - made.stamp[0], made.quaternion, made.velocity, start=float(made.stamp[0]))
    found, _ = calibrate_against_attitude(recording, attitude, LocalGravity(attitude_motion.GRAVITY, 0.0))
    truth, row = made.truth, {}
    for triad in ("accelerometer", "gyroscope"):
        sigma, bias_sigma = found.sigma(triad)
        model, short = found.triads()[triad], triad[0]
        places = tuple(LOW) if triad == "accelerometer" else tuple(np.indices((3, 3)).reshape(2, -1))
        row[f"{triad} gain"] = (np.asarray(model.gain) - truth[f"gain_{short}"])[places] / sigma[places]
        row[f"{triad} bias"] = (np.asarray(model.bias) - truth[f"bias_{short}"]) / bias_sigma
    offset, smooth, arm = (found.reference[key] for key in ("time_offset", "filter", "lever_arm"))
    return row | {
        "offset": np.array([(offset["value"] - truth["delay"]) / offset["sigma"]]),
        "filter": np.array([(smooth["variance"] - truth["variance"]) / smooth["sigma"]]),
        "arm": (np.array(arm["value"]) - truth["arm"]) / np.array(arm["sigma"]),
    }


def simulated(units, table, figures):
    """How far the numbers are off, in their own standard deviations, and how often intervals hold."""
    whole = []
    for place, (name, changes) in enumerate(CASES.items()):
        scores, refused = [], 0
        for seed in range(100 * (place + 1), 100 * (place + 1) + units):
            try:
                scores.append(errors(attitude_motion.move(seed, **changes)))
            except Exception as error:
                refused += 1
                print(name, seed, error)
        whole += scores
        figures[name] = said(name, scores, refused, table)
        print(name, figures[name], flush=True)
    figures["all"] = said("all", whole, 0, table)


def said(name, scores, refused, table):
    """Add a case's row to the table and return its figures."""
    z = {key: np.array([each[key] for each in scores]) for key in scores[0]}
    numbers = np.concatenate([each.ravel() for key, each in z.items() if " " in key])
    held = int(np.sum(np.abs(numbers) < 1.96))
    rms = {key: float(np.sqrt(np.mean(each**2))) for key, each in z.items()}
    table.add(
        name, f"{len(scores)}", f"{refused}", share(held, numbers.size), *(f"{each:.2f}" for each in rms.values())
    )
    return {"units": len(scores), "refused": refused, "within": held / numbers.size, "rms": rms}


def main():
    """Measure and keep the tables."""
    options = arguments(__doc__)
    first = Table("Simulated units against a tracker", ["case", "units", "refused", "95 % intervals hold",
                  "error over its sigma (rms): accelerometer's gain", "bias", "gyroscope's gain", "bias", "time offset",
                  "filter", "lever arm"],
                  "Intervals: of gains and biases of both triads; the share's own interval takes them as independent. "
                  "60 s at 100 Hz where nothing else is said, tracker 50 Hz and 30 ms late.")  # fmt: skip
    figures = {}
    simulated(2 if options.small else 10, first, figures)
    tables = [first]
    if folder := os.environ.get("JAXIMU_DATA"):
        second = Table("Measured recordings against their reference", [
            "recording", "error of the mean rate, data sheet's unit → calibrated, on data not fitted (BROAD: fitted)",
            "reference late by", "open",
        ])  # fmt: skip
        measured(Path(folder), second, figures)
        tables.append(second)
    finish("reference", tables, figures, keep=not options.small)


if __name__ == "__main__":
    main()
