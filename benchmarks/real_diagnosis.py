"""What a diagnosis finds in measured hand-held recordings, cross-validated.

None of them comes with a recording of the same unit at rest, so noise and drift are estimated from the recordings
themselves. The cross-validated gain says whether a finding is more than chance; whether it is physics is judged in
words, by a person. Mistakes in the samples are repaired where that is possible.
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
from jaximu.errors import NotPossibleError
from jaximu.report.diagnosis import write_diagnosis

jax.config.update("jax_enable_x64", True)

XSENS = ReadOptions(columns="time [s],accel [count],gyro [count]", accel_offset="32768",
                    gyro_scale="6258 count/(rad/s)", gravity=LocalGravity(9.81744, 0.0005))  # fmt: skip
MPU9150 = ReadOptions(columns="accel [m/s^2],gyro [rad/s]", rate=100)
MIMU4444 = ReadOptions(accel_scale="2048 count/g", gyro_scale="16.4 count/(deg/s)")
STOCKHOLM = LocalGravity(9.8184, 0.0005)
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
    path = folder / "psins/mems.parquet"
    yield "PSINS, a MEMS unit in a vehicle", read_recording(path), LocalGravity(9.80665, 0.015)


def main():
    """Diagnose every recording and keep the table."""
    options = arguments(__doc__)
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
                write_diagnosis(found, folder)
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
            "" if found.learned is None else found.learned.covariate,
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
