"""Whether two versions of the library give the same estimates of every hand-held recording in `JAXIMU_DATA`.

`python benchmarks/agreement.py --write FILE` keeps this version's numbers; `--against FILE` compares them with those of
another, in standard deviations, and keeps the table. The script uses nothing that versions do not share.
"""

import argparse
import json
import os
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import numpy as np
from common import Table, finish

from jaximu import LocalGravity, ReadOptions, calibrate, read_recording
from jaximu.diagnosis import diagnose

jax.config.update("jax_enable_x64", True)

STANDARD = LocalGravity(9.80665, 0.0)
XSENS = ReadOptions(columns="time [s],accel [count],gyro [count]", accel_offset="32768",
                    gyro_scale="6258 count/(rad/s)", gravity=LocalGravity(9.81744, 0.0005))  # fmt: skip
MPU9150 = ReadOptions(columns="accel [m/s^2],gyro [rad/s]", rate=100)
MPU6050 = ReadOptions(columns="accel [count],gyro [count]", rate=100, accel_scale="16384 count/g",
                      gyro_scale="131 count/(deg/s)")  # fmt: skip
MIMU = ReadOptions(accel_scale="2048 count/g", gyro_scale="16.4 count/(deg/s)", check=False)
GOAL = 1e-3


def recordings(folder: Path) -> Iterator:
    """Name, recording and gravity of each."""
    files = [folder / f"imu_tk_xsens/xsens_{each}.mat" for each in ("acc", "gyro")]
    yield "imu_tk's Xsens", read_recording(*files, XSENS), XSENS.gravity
    for unit in range(3):
        path = folder / f"mikoff_mpu9150/imu{unit}.log"
        yield f"MPU-9150, unit {unit}", read_recording(path, options=MPU9150), STANDARD
    path = folder / "tomisuarez_mpu6050/example_data_calibration.csv"
    yield "MPU-6050", read_recording(path, options=MPU6050), STANDARD
    for unit in (1, 5):
        path = folder / f"mimu4444/unit{unit}_session1.parquet"
        yield f"MIMU4444, unit {unit}", read_recording(path, options=MIMU), STANDARD
    for unit in "abcde":
        yield f"practice, unit {unit}", read_recording(folder.parent / f"practice/{unit}.fit.parquet"), STANDARD


def estimates(recording, gravity) -> dict[str, dict[str, list]]:
    """Names, values and standard deviations by kind of fit; of an extended one, gain and bias alone."""
    found = {}
    for kind in ("joint", "two-step", "extended"):
        try:
            calibration = (
                diagnose(recording, gravity).extended_calibration()
                if kind == "extended"
                else calibrate(recording, gravity, method=kind)
            )
        except Exception as error:  # a refusal is an answer, too
            found[kind] = {"refused": str(error)}
            continue
        numbers = {f"{name}.{part}": np.asarray(getattr(triad, part)) for name, triad in calibration.triads().items()
                   for part in ("gain", "bias")}  # fmt: skip
        sigma = np.sqrt(np.diag(calibration.covariance))
        rows = [(str(name), sigma[k]) for k, name in enumerate(calibration.names) if "effects" not in name]
        values = []
        for name, _ in rows:
            stem, _, place = name.rstrip("]").partition("[")
            values.append(float(numbers[stem][tuple(map(int, place.split(",")))]))
        effects = sorted(each.name for triad in calibration.triads().values() for each in triad.effects)
        found[kind] = {"names": [name for name, _ in rows], "values": values, "effects": effects,
                       "sigma": [float(s) for _, s in rows]}  # fmt: skip
    return found


def compared(ours: dict, theirs: dict) -> tuple[str, float]:
    """The largest difference of a number in the other version's standard deviations, and what differs by it."""
    if "refused" in ours or "refused" in theirs:
        alike = "refused" in ours and "refused" in theirs
        return ("both refused" if alike else f"refused by {'this' if 'refused' in ours else 'the other'}"), float("nan")
    if ours["effects"] != theirs["effects"]:
        return f"{', '.join(theirs['effects']) or 'nothing'} → {', '.join(ours['effects']) or 'nothing'}", float("nan")
    off = np.abs(np.subtract(ours["values"], theirs["values"])) / np.array(theirs["sigma"])
    worst = int(np.argmax(off))
    spread = float(np.max(np.abs(np.divide(ours["sigma"], theirs["sigma"]) - 1)))
    return f"{off[worst]:.1e} ({ours['names'][worst]}); σ {100 * spread:.2g} %", float(off[worst])


def main() -> None:
    """Write this version's numbers, or compare them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", type=Path)
    parser.add_argument("--against", type=Path)
    parser.add_argument("--note", default="", help="what the other version is")
    options = parser.parse_args()
    found = {name: estimates(*given) for name, *given in recordings(Path(os.environ["JAXIMU_DATA"]))}
    if options.write:
        options.write.write_text(json.dumps(found), encoding="utf-8")
    if options.against:
        other = json.loads(options.against.read_text(encoding="utf-8"))
        table = Table(
            f"Largest difference of a number between two versions, in standard deviations (goal ≤ {GOAL:g})",
            ["recording", "joint", "two-step", "extended"],
            f"σ: the largest relative change of a standard deviation. {options.note}".strip(),
        )
        figures: dict = {}
        for name, ours in found.items():
            cells = {kind: compared(ours[kind], other[name][kind]) for kind in ours}
            table.add(name, *(text for text, _ in cells.values()))
            figures[name] = {kind: size for kind, (_, size) in cells.items()}
        finish("agreement", [table], figures)


if __name__ == "__main__":
    main()
