"""Advice is executed: what an output suggests runs on the file that it was suggested for, or sends on; no cycle."""

import numpy as np
import pytest
from advice import commands_in, followed

from jaximu.recordings import write_recording
from jaximu.recordings.recording import Recording
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld, Static

SI = [f"{sensor}_{axis} [{unit}]" for sensor, unit in (("accel", "m/s^2"), ("gyro", "rad/s")) for axis in "xyz"]


def by_hand(poses=12, seed=3, rate=50.0) -> Recording:
    return simulate(draw_imu(seed), HandHeld(poses, 2.0, 1.0), consumer_noise(), rate=rate, seed=seed)[0]


def at_rest() -> Recording:
    return simulate(draw_imu(3), Static(180.0), consumer_noise(), rate=50.0, seed=3)[0]


def table(path, recording, names, columns, time="time [s]"):
    """Write columns (n,) of a recording under some names."""
    head = ",".join([*([time] if time else []), *names])
    values = np.column_stack([*([recording.accelerometer.time] if time else []), *columns])
    np.savetxt(path, values, "%.7g", ",", header=head, comments="")


def rows(recording):
    return [*recording.accelerometer.si().T, *recording.gyroscope.si().T]


def poses(folder):
    write_recording(by_hand(), folder / "log.csv")


def six(folder):
    write_recording(by_hand(6), folder / "log.csv")


def three(folder):
    write_recording(by_hand(3), folder / "log.csv")


def rest(folder):
    write_recording(at_rest(), folder / "log.csv")


def rest_in_g(folder):
    recording = at_rest()
    table(folder / "log.csv", recording, SI, [column / (9.80665 if k < 3 else 1) for k, column in
                                             enumerate(rows(recording))])  # fmt: skip


def gyroscope_at_rest(folder):
    recording = at_rest()
    table(folder / "log.csv", recording, SI[3:], rows(recording)[3:])


def accelerometer_alone(folder):
    recording = by_hand()
    table(folder / "log.csv", recording, SI[:3], rows(recording)[:3])


def no_units(folder):
    recording = by_hand()
    table(folder / "log.csv", recording, ["ax", "ay", "az", "gx", "gy", "gz"], rows(recording), "t")


def no_time(folder):
    recording = by_hand()
    table(folder / "log.csv", recording, SI, rows(recording), "")


def two_units(folder):
    one, other = by_hand(rate=50.0), simulate(draw_imu(5), HandHeld(12, 2.0, 1.0), consumer_noise(), rate=50.0, seed=3)
    mixed = [np.column_stack(pair).ravel() for pair in zip(rows(one), rows(other[0]), strict=True)]
    time = np.repeat(one.accelerometer.time, 2)
    np.savetxt(folder / "log.csv", np.column_stack([time, *mixed]), "%.7g", ",", comments="",
               header=",".join(["time [s]", *SI]))  # fmt: skip


def nothing(folder):
    (folder / "log.csv").mkdir()


def means(folder):
    recording = by_hand(9)
    parts = np.array_split(np.arange(len(recording.accelerometer)), 40)
    values = [np.array([column[part].mean() for part in parts]) for column in rows(recording)[:3]]
    scale = 9.80665 / np.linalg.norm(values, axis=0)
    table(folder / "log.csv", recording, SI[:3], [column * scale for column in values], "")


INPUTS = (poses, six, three, rest, rest_in_g, gyroscope_at_rest, accelerometer_alone, no_units, no_time, two_units,
          nothing, means)  # fmt: skip
COMMANDS = ("jaximu info log.csv", "jaximu log.csv --yes", "jaximu calibrate log.csv", "jaximu allan log.csv")
WHOLE = "jaximu log.csv --yes"
SLOW = {(poses, WHOLE), (no_units, WHOLE), (six, WHOLE), (two_units, WHOLE)} | {
    (two_units, f"jaximu {verb} log.csv") for verb in ("info", "allan", "calibrate")
}


def cases():
    for make in INPUTS:
        for command in COMMANDS:
            slow = (make, command) in SLOW
            yield pytest.param(make, command, id=f"{make.__name__}, {command}", marks=pytest.mark.slow if slow else ())


@pytest.mark.parametrize(("make", "command"), [*cases()])
def test_what_is_suggested_leads_on(make, command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    make(tmp_path)
    astray = [advice for advice in followed(command, tmp_path) if not advice.leads_on]
    assert astray == []


def test_commands_are_taken_out_of_pages_and_refusals():
    page = "Next: `jaximu compensate CALIBRATION\n  log.csv -o CORRECTED.csv` applies it.\n  jaximu info log.csv -v\n"
    assert commands_in(page, "") == ["jaximu compensate calibration.json log.csv -o corrected.csv",
                                     "jaximu info log.csv -v"]  # fmt: skip
    refusal = "jaximu: a: is a folder. Name one log, or calibrate all: jaximu fleet a -o fleet.parquet."
    assert commands_in("", refusal) == ["jaximu fleet a -o fleet.parquet"]
    assert commands_in("`jaximu turntable log.csv --reference REF`", "") == []
    assert commands_in('{"next": "jaximu log.csv -o results"}', "") == ["jaximu log.csv -o results"]
