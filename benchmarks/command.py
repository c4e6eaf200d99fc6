"""Wall time of the command on a measured log of 51 000 rows. `JAXIMU_DATA=… python benchmarks/command.py`"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from common import Table, finish


def main() -> None:
    if "JAXIMU_DATA" not in os.environ:
        raise SystemExit("set JAXIMU_DATA to the folder of measured recordings")
    folder = Path(os.environ["JAXIMU_DATA"]) / "imu_tk_xsens"
    command = [
        sys.executable, "-m", "jaximu", "calibrate", str(folder / "xsens_acc.mat"), "--gyro-log",
        str(folder / "xsens_gyro.mat"), "--columns", "time [s],accel [count],gyro [count]", "--accel-offset", "32768",
        "--gyro-scale", "6258 count/(rad/s)", "--gravity", "9.81744+-0", "--json",
    ]  # fmt: skip
    with tempfile.TemporaryDirectory() as scratch:
        environment = {**os.environ, "XDG_CACHE_HOME": scratch}

        def run(*more: str) -> float:
            start = time.perf_counter()
            subprocess.run([*command, *more], env=environment, check=True, capture_output=True)
            return time.perf_counter() - start

        times = {"first run, empty cache": [run()]}
        times["--json, no report"] = [run() for _ in range(5)]
        times["--json, with report (-o)"] = [run("-o", str(Path(scratch) / "report")) for _ in range(3)]
    targets = {"--json, no report": "≤ 3"}
    table = Table("jaximu calibrate, imu_tk_xsens (51 175 rows)", ["", "median [s]", "all [s]", "goal"])
    for name, values in times.items():
        table.add(
            name, f"{sorted(values)[len(values) // 2]:.2f}", " ".join(f"{v:.2f}" for v in values), targets.get(name, "")
        )
    finish("command", [table], {"seconds": times})


if __name__ == "__main__":
    main()
