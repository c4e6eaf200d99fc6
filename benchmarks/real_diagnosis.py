"""What a diagnosis finds in measured hand-held recordings, with the gain on parts left out in turn.

None of them comes with a recording of the same unit at rest, so the noise is that of the poses themselves. Their
held-out gain says whether a finding is more than chance; whether it is physics is judged in words, by a person.
"""

import os
import shutil
import tempfile
import time

os.environ.setdefault("JAX_PLATFORMS", "cpu")

from pathlib import Path

import jax
import numpy as np
from common import RESULTS, Table, arguments, finish

from jaximu import LocalGravity, ReadOptions, calibrate, read_recording
from jaximu.diagnosis import diagnose
from jaximu.report.diagnosis import write_diagnosis

jax.config.update("jax_enable_x64", True)

XSENS = ReadOptions(columns="time [s],accel [count],gyro [count]", accel_offset="32768",
                    gyro_scale="6258 count/(rad/s)", gravity=LocalGravity(9.81744, 0.0005))  # fmt: skip
KINDS = ("gravity_norm", 1.0), ("gravity_direction", 1.0), ("static_gyroscope", float(np.degrees(1.0)))
MPU9150 = ReadOptions(columns="accel [m/s^2],gyro [rad/s]", rate=100)
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


def main():
    """Diagnose every recording and keep the table."""
    options = arguments(__doc__)
    table = Table(
        "Diagnosis of measured recordings (own noise, parts left out in turn)",
        ["recording", "verdict", "named (or)", "largest", "noise looks larger by", "χ² per condition left out",
         "log-likelihood", "left out: gravity norm [m/s²], turns [°], rate at rest [°/s]", "time / calibration"],
    )  # fmt: skip
    figures = {}
    for name, recording, gravity in recordings(Path(os.environ["JAXIMU_DATA"])):
        seconds = []
        for task in (calibrate, diagnose):
            task(recording, gravity)
            started = time.perf_counter()
            found = task(recording, gravity)
            seconds.append(time.perf_counter() - started)
        if not figures and not options.small:  # the README's first picture
            with tempfile.TemporaryDirectory() as folder:
                write_diagnosis(found, folder)
                shutil.copy(Path(folder) / "diagnosis.png", RESULTS / "xsens_diagnosis.png")
        named = "; ".join(each.name + (f" ({', '.join(each.rivals)})" if each.rivals else "") for each in found.effects)
        largest = "; ".join(each.size() for each in found.named)
        gain = found.gain
        shown = ["", "", ""]
        if gain is not None:
            before, after = gain.before, gain.after
            shown = [f"{before.chi_squared / before.count:.1f} → {after.chi_squared / after.count:.1f}",
                     f"{gain.log_likelihood:+.0f}",
                     "; ".join(f"{factor * before.rms[kind][0]:.2g} → {factor * after.rms[kind][0]:.2g}"
                               for kind, factor in KINDS)]  # fmt: skip
        table.add(name, found.verdict, named, largest, f"{found.unit:.1f}", *shown, f"{seconds[1] / seconds[0]:.1f}")
        kept = ("verdict", "effects", "preflight", "p_value", "noise_scale", "checks")
        figures[name] = {key: found.document()[key] for key in kept} | {"seconds": seconds}
    finish("real_diagnosis", [table], figures, keep=not options.small)


if __name__ == "__main__":
    main()
