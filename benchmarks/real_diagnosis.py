"""What a diagnosis finds in measured recordings: of poses by hand, cross-validated, and of every other kind.

None of them comes with a recording of the same unit at rest, so noise and drift are estimated from the recordings
themselves. The cross-validated gain says whether a finding is more than chance; whether it is physics is judged in
words, by a person. Mistakes in the samples are repaired where that is possible. `--others`: those not turned by hand
alone, with a table of their own: against a measured attitude, with equipment, over temperature, and logs of flights.
"""

import os
import shutil
import tempfile
import time

os.environ.setdefault("JAX_PLATFORMS", "cpu")

from pathlib import Path

import jax
from common import RESULTS, Table, arguments, finish

from jaximu import LocalGravity, ReadOptions, diagnose, read_recording
from jaximu.diagnosis import diagnose_against_attitude, diagnose_thermal, diagnose_turntable
from jaximu.ground.errors import JaximuError, NotPossibleError
from jaximu.recordings.readers import read_attitude, read_reference
from jaximu.report.html import write_report

jax.config.update("jax_enable_x64", True)

XSENS = ReadOptions(columns="time [s],accel [count],gyro [count]", accel_offset="32768",
                    gyro_scale="6258 count/(rad/s)", gravity=LocalGravity(9.81744, 0.0005))  # fmt: skip
MPU9150 = ReadOptions(columns="accel [m/s^2],gyro [rad/s]", rate=100)
MIMU4444 = ReadOptions(accel_scale="2048 count/g", gyro_scale="16.4 count/(deg/s)")
STOCKHOLM = LocalGravity(9.8184, 0.0005)
IMUCAL = ReadOptions(columns="_,_,accel [count],gyro [count]", rate=204.8, gyro_scale="16.4 count/(deg/s)")
COOLING = ReadOptions(columns="time [us],gyro [rad/s],accel [m/s^2],_,temperature [degC]")
MPU6050 = ReadOptions(columns="accel [count],gyro [count]", rate=100, accel_scale="16384 count/g",
                      gyro_scale="131 count/(deg/s)")  # fmt: skip


def recordings(folder):
    """Name, recording and gravity of each."""
    accelerometer, gyroscope = (folder / f"imu_tk_xsens/xsens_{each}.mat" for each in ("acc", "gyro"))
    yield "imu_tk's Xsens", read_recording(accelerometer, gyroscope, XSENS), XSENS.gravity
    for unit in range(3):
        path = folder / f"mikoff_mpu9150/imu{unit}.log"
        yield f"MPU-9150, unit {unit}", read_recording(path, options=MPU9150), LocalGravity(9.80665, 0.0)
    path = folder / "tomisuarez_mpu6050/example_data_calibration.csv"
    yield "MPU-6050", read_recording(path, options=MPU6050), LocalGravity(9.80665, 0.0)
    for unit in range(1, 9):
        for session in range(1, 5):
            path = folder / f"mimu4444/unit{unit}_session{session}.parquet"
            yield f"MIMU4444, unit {unit}, session {session}", read_recording(path, options=MIMU4444), STOCKHOLM
    path = folder / "mpu6050_hmc5883l/full_sphere.parquet"
    yield "MPU-6050 beside a compass", read_recording(path), LocalGravity(9.80665, 0.015)


def others(folder):
    """Name, kind and diagnosis, not yet begun, of each recording that is not one of poses by hand."""
    gravity = LocalGravity(9.80665, 0.015)

    def against(log, reference):
        def ask():
            attitude = read_attitude(folder / reference).usable()
            return diagnose_against_attitude(read_recording(folder / log), attitude, gravity, repair=True)

        return ask

    def session():
        path = folder / "imucal/annotated_session.csv"
        recording = read_recording(path, options=IMUCAL)
        return diagnose_turntable(recording, read_reference(path, recording), LocalGravity(9.81, 0.0))

    def by_hand(log):
        return lambda: diagnose(read_recording(folder / log), gravity, repair=True)

    def cooling():
        return diagnose_thermal(read_recording(folder / "tofupilot_cooling/cooling_leg.tsv", options=COOLING))

    broad, psins, attitude = "broad/02_undisturbed_slow_rotation_B.mat", "psins/mems.parquet", "measured attitude"
    yield "PSINS, a MEMS unit beside fibre optics", attitude, against(psins, "psins/fibre_optic_ins.parquet")
    for flight in ("MH03", "V102"):
        yield f"EuRoC, flight {flight}", attitude, against(f"euroc/{flight}.imu.txt", f"euroc/{flight}.truth.txt")
    yield "BROAD 02, optics", attitude, against(broad, broad)
    yield "imucal's session", "six positions, three turns", session
    yield "a chamber that cools, 52 to -18 °C", "temperature, at rest", cooling
    yield "accelerometer worn on a wrist", "poses, no gyroscope", by_hand("ggir_wrist/spheredata.csv")
    for name, log in (("PX4", "px4/sample_px4_events.ulg"), ("ArduPilot", "ardupilot/test.BIN")):
        yield f"flight log, {name}", "as if by hand", by_hand(log)


def other_kinds(folder):
    """Diagnose the recordings that are not of poses by hand, and keep their table."""
    table = Table(
        "Diagnosis of measured recordings that are not of poses by hand",
        ["recording", "asked as", "verdict", "named (or)", "what is said", "said of the samples",
         "χ² per condition, left out", "seconds"],
    )  # fmt: skip
    figures = {}
    for name, kind, ask in others(folder):
        started = time.perf_counter()
        try:
            found = ask()
        except JaximuError as error:
            reason = str(error).split(": ", 1)[-1]
            table.add(name, kind, "refused", "", reason[:300], *[""] * 3)
            figures[name] = {"refused": reason}
            continue
        seconds = time.perf_counter() - started
        named = "; ".join(each.name + (f" ({', '.join(each.rivals)})" if each.rivals else "") for each in found.effects)
        gain = found.gain
        left = "" if gain is None else " → ".join(f"{each.chi_squared / each.count:.2f}"
                                                  for each in (gain.before, gain.after))  # fmt: skip
        said = ", ".join(dict.fromkeys(each.name for each in found.preflight))
        table.add(
            name, kind, found.verdict, named, " ".join(found.summary().verdict)[:300], said, left, f"{seconds:.1f}"
        )
        kept = ("verdict", "effects", "preflight", "p_value", "checks", "notes")
        figures[name] = {key: found.document()[key] for key in kept if key in found.document()} | {"seconds": seconds}
    finish("real_diagnosis_others", [table], figures, script="real_diagnosis")


def main():
    """Diagnose every recording and keep the table."""
    options = arguments(__doc__, others="those alone that are not of poses by hand")
    if options.others:
        return other_kinds(Path(os.environ["JAXIMU_DATA"]))
    table = Table(
        "Diagnosis of measured recordings (noise and drift from the recordings themselves)",
        ["recording", "verdict", "named (or)", "largest", "depends on", "said of the samples",
         "bias instability (accelerometer, gyroscope)", "poses move", "turns undersampled",
         "χ² per condition, cross-validated", "log-likelihood", "remaining scatter", "seconds"],
        "Bias instability in multiples of white noise over a second. Poses move: the error of means at rest in "
        "multiples of what the accelerometer sees poses tilt; 1 is expected. Turns undersampled: the error of a turn "
        "in multiples of what even and odd samples differ by.",
    )  # fmt: skip
    figures = {}
    for name, recording, gravity in recordings(Path(os.environ["JAXIMU_DATA"])):
        if options.small and "MIMU4444" in name and "unit 1, session 1" not in name:
            continue
        started = time.perf_counter()
        try:
            found = diagnose(recording, gravity, repair=True)
        except NotPossibleError as error:
            reason = str(error).split(": ", 1)[-1]
            table.add(name, "refused", "", "", "", reason[:160], *[""] * 7)
            figures[name] = {"refused": reason}
            continue
        seconds = time.perf_counter() - started
        if not figures and not options.small:  # the README's first picture
            with tempfile.TemporaryDirectory() as folder:
                write_report(found, folder)
                shutil.copy(Path(folder) / "diagnosis.png", RESULTS / "xsens_diagnosis.png")
        named = "; ".join(each.name + (f" ({', '.join(each.rivals)})" if each.rivals else "") for each in found.effects)
        gain = found.gain
        shown = ["", ""]
        if gain is not None:
            before, after = gain.before, gain.after
            shown = [f"{before.chi_squared / before.count:.2f} → {after.chi_squared / after.count:.2f}",
                     f"{gain.log_likelihood:+.0f}"]  # fmt: skip
        drift = found.experiment.drift
        assert drift is not None
        sizes = {kind: size for kind, (size, _) in drift.sizes.items()}
        table.add(
            name, found.verdict, named, "; ".join(each.size() for each in found.named),
            next((curve.covariate for curve in found.curves), ""),
            ", ".join(dict.fromkeys(each.name for each in found.preflight)),
            f"{sizes['accelerometer bias instability']:.2g}, {sizes['gyroscope bias instability']:.2g}",
            f"{sizes['poses that move']:.2g}", f"{sizes['turns undersampled']:.2g}", *shown, f"{found.unit:.2f}",
            f"{seconds:.1f}",
        )  # fmt: skip
        kept = ("verdict", "effects", "preflight", "p_value", "noise_scale", "checks")
        figures[name] = {key: found.document()[key] for key in kept} | {"seconds": seconds, "drift": drift.sizes}
    finish("real_diagnosis", [table], figures, keep=not options.small)


if __name__ == "__main__":
    main()
