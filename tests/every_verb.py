"""Every verb on every kind of measured input: what a user gets, in a sentence."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

from jaximu.cli.app import main

COUNTS = ["--columns", "accel [count],gyro [count]", "--rate", "100", "--accel-scale", "16384 count/g",
          "--gyro-scale", "131 count/(deg/s)"]  # fmt: skip
XSENS = ["--columns", "time [s],accel [count],gyro [count]", "--gyro-log", "imu_tk_xsens/xsens_gyro.mat",
         "--accel-offset", "32768", "--accel-scale", "415 count/(m/s^2)",
         "--gyro-scale", "6258 count/(rad/s)"]  # fmt: skip
INPUTS = {
    "imu_tk's Xsens, counts, two files": ["imu_tk_xsens/xsens_acc.mat", *XSENS],
    "MPU-9150 by hand": ["mikoff_mpu9150/imu0.log", "--columns", "accel [m/s^2],gyro [rad/s]", "--rate", "100"],
    "MPU-6050 by hand, counts": ["tomisuarez_mpu6050/example_data_calibration.csv", *COUNTS],
    "MPU-6050 unmoved": ["mpu6050_hmc5883l/unmoved_with_x_pointing_forward_10min.parquet"],
    "MPU-6050 turned without rests": ["mpu6050_hmc5883l/rotate_ccw_around_z_pointing_up.parquet"],
    "HMC5883L alone": ["mpu6050_hmc5883l/full_sphere.mag.parquet"],
    "MIMU4444, counts": ["mimu4444/unit1_session1.parquet", "--accel-scale", "2048 count/g",
                         "--gyro-scale", "16.4 count/(deg/s)"],
    "ADIS16405 at rest for hours": ["adis16405_static/run1.parquet"],
    "BROAD, optical attitude": ["broad/02_undisturbed_slow_rotation_B.mat"],
    "EuRoC flight": ["euroc/MH03.imu.txt"],
    "EuRoC truth": ["euroc/MH03.truth.txt"],
    "PSINS, vehicle": ["psins/mems.parquet"],
    "PSINS, fibre optics": ["psins/fibre_optic_ins.parquet"],
    "PSINS, 19 positions": ["psins/systematic_19_positions.parquet"],
    "PX4 log": ["px4/sample_px4_events.ulg"],
    "PX4 log, sparse": ["px4/sample_log_small.ulg"],
    "ArduPilot log": ["ardupilot/test.BIN"],
    "wrist accelerometer": ["ggir_wrist/spheredata.csv"],
    "chamber, cooling": ["tofupilot_cooling/cooling_leg.tsv", "--columns",
                         "time [us],gyro [rad/s],accel [m/s^2],_,temperature [degC]"],
    "imucal's session": ["imucal/example_ferraris_session.csv"],
    "a page of text": ["README.md"],
}  # fmt: skip
"""What is in the folder of measured data, with the options a user needs."""
VERBS = ("info", "calibrate", "diagnose", "diagnose --thermal", "diagnose --reference", "check", "compensate", "allan",
         "turntable", "magnetometer", "plan", "thermal", "fleet", "consequences", "accept", "verify",
         "filter --online")  # fmt: skip
_WITH_CALIBRATION = ("check", "compensate", "consequences")
WITHOUT_JSON, WITHOUT_OUTPUT = ("compensate", "demo"), ("info", "verify", "effects")
_OF_RESULTS = ("accept", "verify")  # they take no logs, and no options of reading
_FILES = {"compensate": "out.csv", "fleet": "table.parquet", "simulate": "log.parquet", "export": "exported"}
_VERDICTS = {"accept": (3, 4), "verify": (3, 4)}
"""Exit statuses of verbs that answer a question by them."""
_SHORT = ("", "effects", "export", "help", "record", "verify", "version")
"""Verbs that compute nothing, or say what they are at in lines of another form."""
_NEVER = ("should not happen", "Traceback", "Warning:", "could not be drawn")


@dataclass(frozen=True)
class Outcome:
    """How a run of the command line ended."""

    status: int
    stdout: str
    stderr: str
    seconds: float
    written: tuple[str, ...]
    warned: tuple[str, ...]
    verb: str = ""

    @property
    def refused(self) -> bool:
        """Whether the verb could not do what it was asked for."""
        return self.status in (1, 2)

    @property
    def faults(self) -> list[str]:
        """What no user should ever meet."""
        faults = [f"warned: {text}" for text in self.warned]
        lines = self.stderr.splitlines()
        sentences = [line for line in lines if line.startswith("jaximu: ")]
        if self.status not in (0, 1, 2, *_VERDICTS.get(self.verb, ())):
            faults.append(f"exit status {self.status}")
        for word in _NEVER:
            faults += [line for line in lines if word in line]
        if self.refused and not sentences:
            faults.append("failed without a word")
        if self.refused and self.written:
            faults.append(f"failed and left {', '.join(self.written)}")
        if not self.refused and self.verb not in _SHORT and "…" not in self.stderr:
            faults.append("no stage was said while it worked")
        if not self.refused and sentences:
            faults.append(f"exit status {self.status} with an error: {sentences[0]}")
        return faults

    @property
    def short(self) -> str:
        """The outcome in a few words."""
        said = [line for line in self.stderr.splitlines() if line.strip("│ ")]
        if self.status and said:
            first = next((line for line in said if line.startswith("jaximu: ")), said[-1])
            return first.removeprefix("jaximu: ").strip("│ ")
        with contextlib.suppress(ValueError):
            document = json.loads(self.stdout)
            if isinstance(document, dict):
                verdict = document.get("verdict") or document.get("headline")
                return str(verdict or "done")
        return "done"


def arguments(verb: str, given: list[str], folder: Path, calibration: Path) -> list[str]:
    """The command line of a verb with an input of `folder`."""
    name, _, option = verb.partition(" ")
    paths = [str(folder / each) if (folder / each).is_file() else each for each in given]
    if name == "consequences":  # the log is the path
        paths = ["--path", *paths]
    more = ["--online", str(calibration)] if name == "filter" else [option] if option else []
    if name in _OF_RESULTS:
        return [name, paths[0]]
    return [name, *([str(calibration)] if name in _WITH_CALIBRATION else []), *paths, *more,
            *(paths[:1] if option == "--reference" else [])]  # fmt: skip


def run(line: list[str], output: Path | None, as_json: bool, file: str | None = None) -> Outcome:
    """Run a command line in this process; what it writes goes into a new folder `output`, as `file` if it is one."""
    verb = line[0]
    if output is not None:
        shutil.rmtree(output, ignore_errors=True)
        output.mkdir(parents=True)
        if verb not in WITHOUT_OUTPUT:
            line = [*line, "-o", str(output / (_FILES.get(verb, "") if file is None else file))]
    if as_json and verb not in WITHOUT_JSON:
        line = [*line, "--json"]
    out, err = io.StringIO(), io.StringIO()
    began = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught, contextlib.redirect_stdout(out), \
            contextlib.redirect_stderr(err):  # fmt: skip
        warnings.simplefilter("always")
        status = main(line)
    seconds = time.perf_counter() - began
    written = () if output is None or not output.exists() else tuple(
        sorted(str(each.relative_to(output)) for each in output.rglob("*") if each.is_file())
    )  # fmt: skip
    warned = tuple(f"{each.category.__name__}: {each.message}" for each in caught
                   if "persistent compilation cache" not in str(each.message))  # fmt: skip
    return Outcome(status, out.getvalue(), err.getvalue(), seconds, written, warned, verb)
