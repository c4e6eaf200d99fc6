"""No work is lost: not by a closed pipe, an encoding, a figure that fails or another calibration in the folder."""

import io
import json
import os
import re
import subprocess
import sys
import warnings
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from magnetic_motion import turned

from jaximu.calibration import calibrate, load_calibration
from jaximu.cli.app import main
from jaximu.cli.streams import _letter
from jaximu.data.by_hand import RecordedByHand
from jaximu.diagnosis import diagnose
from jaximu.diagnosis.experiment import Experiment
from jaximu.estimation.problem import flatten, names_of, typical_sizes
from jaximu.estimation.uncertainty import weak_directions
from jaximu.ground.gravity import LocalGravity
from jaximu.model.effects import CATALOGUE
from jaximu.model.sensor import Imu
from jaximu.recordings import write_recording
from jaximu.report import diagnosis as diagnosis_page
from jaximu.report.export.catalogue import WRITERS
from jaximu.report.html import write_report
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import Environment, HandHeld, Static

POSES = 12
EXACT = ("--gravity", "9.80665+-0")
THERMAL = {
    "accelerometer": {"accel.temperature": [1e-3, -2e-3, 1.5e-3]},
    "gyroscope": {"gyro.temperature": [1e-4, -2e-4, 1e-4]},
    "no gyroscope": {"accel.temperature": [1e-3, -2e-3, 1.5e-3]},
    "neither": {},
}
"""What depends on temperature."""


def hand_held(poses: int, seed: int):
    return simulate(draw_imu(seed), HandHeld(poses, 2.0), consumer_noise(), seed=seed)[0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Logs of poses: both sensors, either alone; one at rest; a magnetometer."""
    folder = tmp_path_factory.mktemp("logs")
    recording = hand_held(POSES, 5)
    write_recording(recording, folder / "log.csv")
    write_recording(replace(recording, gyroscope=None), folder / "accel.csv")
    write_recording(simulate(draw_imu(5), Static(60.0), consumer_noise(), seed=5)[0], folder / "rest.csv")
    gyroscope = recording.gyroscope
    table = np.column_stack([gyroscope.time, gyroscope.values])
    np.savetxt(folder / "gyro.csv", table, "%.9g", ",", header="time [s],gyro_x [rad/s],gyro_y [rad/s],gyro_z [rad/s]",
               comments="")  # fmt: skip
    case = turned(1)
    table = np.column_stack([case.magnetometer.time, case.magnetometer.values])
    np.savetxt(folder / "mag.csv", table, "%.9g", ",", header="time [s],mag_x [uT],mag_y [uT],mag_z [uT]",
               comments="")  # fmt: skip
    return folder


@pytest.fixture(scope="module")
def both(folder) -> Path:
    """A calibration of accelerometer and gyroscope."""
    assert run("calibrate", folder / "log.csv", *EXACT, "-o", folder / "both")[0] == 0
    return folder / "both" / "calibration.json"


@pytest.fixture(scope="module")
def heated(tmp_path_factory) -> dict[str, Path]:
    """Folders of what `thermal` writes of units of which one sensor alone depends on temperature."""
    folder, environment = tmp_path_factory.mktemp("thermal"), Environment(temperature=[[0.0, 20.0], [900.0, 41.0]])
    for name, effects in THERMAL.items():
        unit = draw_imu(3).with_effects(*(CATALOGUE[effect].make(value) for effect, value in effects.items()))
        recording, _ = simulate(unit, Static(900.0), consumer_noise(), rate=2.0, seed=1, environment=environment)
        write_recording(replace(recording, gyroscope=None) if name == "no gyroscope" else recording,
                        folder / f"{name}.csv")  # fmt: skip
    return {name: folder / f"{name}.csv" for name in THERMAL}


def run(*arguments: object) -> tuple[int, str, str]:
    """Run a command in this process; its exit status, and what it printed."""
    with redirect_stdout(io.StringIO()) as printed, redirect_stderr(io.StringIO()) as said:
        status = main(list(map(str, arguments)))
    return status, printed.getvalue(), said.getvalue()


def sound(*arguments: object) -> tuple[int, str, str]:
    """Run a command that may be refused, by one sentence, but meets no defect."""
    status, printed, said = run(*arguments)
    sentences = [line for line in said.splitlines() if line.startswith("jaximu: ")]
    assert "should not happen" not in said and "could not be drawn" not in said, (arguments, said)
    assert status in range(5) and len(sentences) == (status in (1, 2)), (arguments, status, said)
    return status, printed, said


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# --- pipes and encodings ----------------------------------------------------------------------------------------------

WORK = ("calibrate", "log.csv", "--method", "accelerometer")


def unread(folder: Path, *arguments: str, together: bool = False) -> tuple[int, str]:
    """Run the command as a process whose output nobody reads, its prose neither if `together`."""
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-m", "jaximu", *arguments], cwd=folder, stdout=writer, encoding="utf-8",
        stderr=subprocess.STDOUT if together else subprocess.PIPE, env=os.environ | {"PYTHONPATH": os.getcwd()},
    )  # fmt: skip
    os.close(writer)
    return done.returncode, done.stderr or ""


@pytest.mark.parametrize("together", [False, True])
def test_a_closed_pipe_costs_no_file(together, folder, tmp_path):
    status, said = unread(folder, *WORK, "-o", str(tmp_path), together=together)
    assert status == 0 and "Traceback" not in said and "jaximu: " not in said
    assert {"calibration.json", "report.html", "residuals.png"} <= set(content(tmp_path))
    assert together or said.splitlines()[-1].startswith("Written to ")


@pytest.mark.parametrize("arguments", ["--help", "effects", "effects --json", "info log.csv", "simulate --protocols"])
def test_a_closed_pipe_ends_quietly(arguments, folder):
    status, said = unread(folder, *arguments.split())
    assert status == 0 and all(re.search(r"…$|: done in \d+ s$", line) for line in said.splitlines()), said


def test_a_verdict_needs_no_reader(both, folder, tmp_path):
    """The exit status and the files written last do not depend on whether someone reads."""
    (tmp_path / "limits.toml").write_text('[limits]\n"accelerometer.bias" = "0.001 mg"\n')
    line = ("accept", str(both), "--limits", str(tmp_path / "limits.toml"), "--measurements", str(tmp_path / "m.csv"))
    assert unread(folder, *line)[0] == 3
    assert "fail" in (tmp_path / "m.csv").read_text()


def encoded(folder: Path, encoding: str, *arguments: str) -> tuple[int, str, str]:
    done = subprocess.run(
        [sys.executable, "-m", "jaximu", *arguments], cwd=folder, capture_output=True,
        env=os.environ | {"PYTHONPATH": os.getcwd(), "PYTHONIOENCODING": encoding, "PYTHONUTF8": "0"},
    )  # fmt: skip
    return done.returncode, done.stdout.decode(encoding), done.stderr.decode(encoding)


@pytest.mark.parametrize("encoding", ["cp1252", "ascii"])
def test_any_encoding_prints(encoding, folder, tmp_path):
    if encoding == "cp1252":
        status, printed, said = encoded(folder, encoding, *WORK, "-o", str(tmp_path))
        assert status == 0 and "Written to" in said and "calibration.json" in content(tmp_path)
        assert "m/s²" in printed and "->" in printed and "?" not in printed
    status, printed, said = encoded(folder, encoding, "effects", "gyro.lag")
    assert status == 0 and "tau_i omega'_i" in printed and said == ""
    status, printed, _ = encoded(folder, encoding, "effects", "gyro.lag", "--json")
    assert status == 0 and "ω" in json.loads(printed)["formula"]
    status, printed, said = encoded(folder, encoding, "info", "“none”.csv", "--json")
    assert status == 2 and json.loads(printed)["error"].startswith("“none”.csv")
    assert said == 'jaximu: "none".csv cannot be read: No such file or directory.\n' if encoding == "ascii" else True


def test_characters_are_spelled():
    assert "".join(map(_letter, "1.6 mm/s² ± 2·10⁻³, σ √Hz, µT, ω̇ → é 漢")) == (
        "1.6 mm/s^2 +- 2*10^-^3, sigma sqrt Hz, uT, omega' -> e ?"
    )


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_full_disk_is_said(folder):
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-m", "jaximu", "--version"], cwd=folder, stdout=full, encoding="utf-8",
                              stderr=subprocess.PIPE, env=os.environ | {"PYTHONPATH": os.getcwd()})  # fmt: skip
    assert done.returncode and "No space left" in done.stderr


# --- what lies in the folder ------------------------------------------------------------------------------------------


def holding(path: Path, both: Path, *sensors: str) -> Path:
    """Write a calibration of these sensors, as far as the check looks."""
    document = json.loads(both.read_text())
    parts = {name: document["accelerometer"] for name in sensors}
    path.mkdir()
    names = dict.fromkeys(("accelerometer", "gyroscope", "magnetometer"))
    (path / "calibration.json").write_text(json.dumps(document | names | parts))
    return path


@pytest.mark.parametrize("verb", [
    ["calibrate", "LOG"], ["diagnose", "LOG"], ["turntable", "LOG"], ["reference", "LOG"], ["filter", "LOG"],
    ["thermal", "LOG"], ["record", "--from", "LOG"], ["demo"],
])  # fmt: skip
def test_a_magnetometer_is_kept_before_any_work(verb, both, folder, tmp_path):
    target = holding(tmp_path / "out", both, "magnetometer")
    before = content(target)
    line = [str(folder / "log.csv") if word == "LOG" else word for word in verb]
    status, printed, said = sound(*line, "-o", target)
    assert status == 2 and printed == "" and "holds a calibration of the magnetometer, which the new one" in said
    assert "…" not in said.partition("jaximu: ")[0].replace("reading …", "") and content(target) == before
    assert "--force" in said


def test_a_sensor_is_kept_where_only_the_log_shows_that_it_lacks(both, folder, tmp_path):
    """The result is shown, nothing is written; --force replaces the file."""
    target = holding(tmp_path / "out", both, "accelerometer", "gyroscope")
    before, line = content(target), ("calibrate", folder / "accel.csv", *EXACT, "-o", target)
    status, printed, said = sound(*line)
    assert status == 2 and "of the gyroscope, which the new one lacks" in said and content(target) == before
    assert "scale x" in printed
    status, printed, _ = sound(*line, "--json")
    assert status == 2 and json.loads(printed)["schema"] == "jaximu.error/1" and content(target) == before
    assert sound("calibrate", folder / "log.csv", "--method", "accelerometer", "-o", target)[1] == ""  # known before
    assert sound(*line, "--force")[0] == 0
    assert json.loads((target / "calibration.json").read_text())["gyroscope"] is None


def test_what_holds_no_more_is_replaced(both, folder, tmp_path):
    target = holding(tmp_path / "out", both, "accelerometer")
    assert sound(*WORK[:1], folder / "log.csv", *WORK[2:], "-o", target)[0] == 0
    for text in ("{", '{"schema": "somebody/1", "magnetometer": 1}'):
        (target / "calibration.json").write_text(text)
        assert sound(*WORK[:1], folder / "log.csv", *WORK[2:], "-o", target)[0] == 0


@pytest.fixture(scope="module")
def compass(folder) -> Path:
    """A calibration of a magnetometer alone."""
    assert run("magnetometer", folder / "mag.csv", "--field", "48", "-o", folder / "mag")[0] == 0
    return folder / "mag" / "calibration.json"


def test_a_magnetometer_replaces_no_other_sensors(both, compass, folder, tmp_path):
    target = holding(tmp_path / "out", both, "accelerometer", "gyroscope")
    before = content(target)
    status, printed, said = sound("magnetometer", folder / "mag.csv", "--field", "48", "-o", target)
    assert status == 2 and "of the accelerometer and gyroscope, which the new one lacks" in said
    assert "Hard iron" in printed and content(target) == before


# --- what cannot be drawn ---------------------------------------------------------------------------------------------


def fails(*_, **__):
    raise IndexError("list index out of range")


def drawn(*arguments: object) -> tuple[int, str, str]:
    """Run a command as outside the test-suite, where a warning is no error."""
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        return run(*arguments)


def test_a_figure_that_fails_takes_nothing_else_with_it(folder, tmp_path, monkeypatch):
    monkeypatch.setattr("jaximu.report.figures.residual_figure", fails)
    line = (*WORK[:1], folder / "log.csv", *WORK[2:], "-o", tmp_path)
    status, printed, said = drawn(*line)
    assert status == 0 and "scale x" in printed
    told = "The figure “residuals” could not be drawn (IndexError: list index out of range)"
    assert f"note: {told}" in said
    page = (tmp_path / "report.html").read_text()
    assert told in page and "Map of the uncertainty" in page and "Parameters" in page
    assert {"calibration.json", "orientations.png"} <= set(content(tmp_path)) >= {"correlation.png"}
    assert "residuals.png" not in content(tmp_path)
    status, _, said = run(*line)  # the test-suite, where warnings are errors, meets it as a failure
    assert status == 1 and "could not be drawn" in said


@pytest.mark.parametrize("verb", ["calibrate", "allan"])
def test_a_page_that_fails_takes_no_result_with_it(verb, folder, tmp_path, monkeypatch):
    log = folder / ("log.csv" if verb == "calibrate" else "rest.csv")
    monkeypatch.setattr("jaximu.report.html.environment", fails)
    status, printed, said = drawn(verb, log, *(WORK[2:] if verb == "calibrate" else ()), "-o", tmp_path)
    assert status == 0 and printed and "note: The report could not be drawn (IndexError: list" in said
    assert "could not be drawn" in (tmp_path / "report.html").read_text()
    document = "calibration.json" if verb == "calibrate" else "allan.json"
    assert json.loads((tmp_path / document).read_text())


def test_what_cannot_be_printed_is_written(folder, tmp_path, monkeypatch):
    monkeypatch.setattr("jaximu.report.terminal.show", fails)
    assert run(*WORK[:1], folder / "log.csv", *WORK[2:], "-o", tmp_path)[0] == 1
    assert {"calibration.json", "report.html"} <= set(content(tmp_path))


# --- thermal, weak directions, twins ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", THERMAL)
def test_one_sensor_alone_depends_on_temperature(name, heated, both, tmp_path):
    log = heated[name]
    status, printed, _ = sound("thermal", log, "--json")
    document = json.loads(printed)
    sensors = ["accelerometer"] if name == "no gyroscope" else ["accelerometer", "gyroscope"]
    assert status == 0 and [each for each in sensors if each in document] == sensors
    status, printed, _ = sound("thermal", log, "-o", tmp_path)
    assert status == 0 and all(f"The {each}'s output at rest" in printed for each in sensors)
    assert {f"bias_{each}.png" for each in sensors} <= set(content(tmp_path))
    found = load_calibration(tmp_path / "calibration.json")
    assert list(found.triads()) == sensors
    effects = {effect.name for triad in found.triads().values() for effect in triad.effects}
    assert effects == set(THERMAL[name])


def test_a_thermal_calibration_without_gyroscope_is_planned_for_and_not_checked(heated, folder, tmp_path):
    assert sound("thermal", heated["no gyroscope"], "-o", tmp_path / "one")[0] == 0
    plan = ("plan", tmp_path / "one" / "calibration.json", "--equipment", "table", "--poses", "4", "--json")
    status, printed, _ = sound(*plan)
    assert status == 0 and len(json.loads(printed)["poses"]) == 4
    assert sound("thermal", heated["accelerometer"], "-o", tmp_path / "two")[0] == 0
    path = tmp_path / "two" / "calibration.json"
    assert load_calibration(path).from_data_sheet == ("accelerometer gain", "accelerometer bias", "gyroscope gain")
    status, _, said = sound("check", path, folder / "log.csv")
    assert status == 1 and "accelerometer gain, accelerometer bias and gyroscope gain of a data sheet" in said


def test_a_weak_direction_of_many_small_parts_has_words():
    """All 24 numbers take part alike: none of their weights reaches 0.3, and all are open; four are named in words."""
    imu = Imu.nominal()
    places = [place for place, name in enumerate(names_of(imu)) if name.part in ("gain", "bias")]
    names, sizes = [names_of(imu)[place] for place in places], np.asarray(flatten(typical_sizes(imu)))[places]
    even = np.ones((len(names), 1)) / np.sqrt(len(names))
    jacobian = 1e4 * (np.eye(len(names)) - even @ even.T)
    rank, weak = weak_directions(jacobian, names, sizes, imu)
    assert rank == len(names) - 1 and len(weak) == 1 and not weak[0].determined
    assert {name for name, _ in weak[0].parameters} == set(names)
    assert "and 20 others can trade off" in weak[0].text


def test_a_twin_with_another_number_of_poses_is_drawn(tmp_path, monkeypatch):
    """What is found still in a simulation need not be what was still in the recording."""
    found = diagnose(hand_held(12, 5), LocalGravity(9.80665, 0.0))
    for poses in (11, 13):
        other = calibrate(hand_held(poses, 5))
        twin = Experiment(RecordedByHand(other.segmentations, other.observations), found.experiment.start)
        monkeypatch.setattr(diagnosis_page, "twin_of", lambda _, twin=twin: twin)
        page = write_report(found, tmp_path).read_text(encoding="utf-8")
        assert len(page) > 10_000 and "could not be drawn" not in page


# --- every kind of calibration with every verb, and what is no file ---------------------------------------------------


@pytest.fixture(scope="module")
def calibrations(both, compass, heated, folder) -> dict[str, Path]:
    """Calibrations of each sensor alone, and one of temperature."""
    whole = load_calibration(both)
    kinds = {"magnetometer": load_calibration(compass)}
    for name in ("accelerometer", "gyroscope"):
        rows = [place for place, each in enumerate(whole.names) if each.owner == name]
        imu = replace(whole.imu, gyroscope=None) if name == "accelerometer" else whole.imu
        kinds[name] = replace(
            whole, imu=imu, names=tuple(whole.names[row] for row in rows), covariance=whole.covariance[rows][:, rows],
            absent=() if name == "accelerometer" else ("accelerometer",),
        )  # fmt: skip
    paths = {name: folder / f"{name}.json" for name in kinds}
    for name, calibration in kinds.items():
        calibration.save(paths[name])
    assert run("thermal", heated["accelerometer"], "-o", folder / "heated")[0] == 0
    return paths | {"thermal": folder / "heated" / "calibration.json"}


@pytest.mark.parametrize("kind", ["accelerometer", "gyroscope", "magnetometer", "thermal"])
def test_every_verb_takes_or_refuses_every_calibration(kind, calibrations, folder, tmp_path):
    path, logs = calibrations[kind], [folder / name for name in ("log.csv", "accel.csv", "gyro.csv", "mag.csv")]
    limits = [f'"{name}.scale" = "5 %"' for name in ("accelerometer", "gyroscope", "magnetometer")]
    limits += ['"navigation.position" = { within = "100 m", after = "60 s" }']
    (tmp_path / "limits.toml").write_text("\n".join(["[limits]", *limits]))
    assert sound("accept", path, "--limits", tmp_path / "limits.toml", "-o", tmp_path / "accept")[0] in (0, 3, 4)
    for other in calibrations.values():  # with itself: refused
        sound("compare", path, other, "--limits", tmp_path / "limits.toml", "-o", tmp_path / "compare")
    for log in logs[:2]:
        sound("check", path, log)
    for log in logs:
        out = tmp_path / f"{log.stem}.out.csv"
        status, _, _ = sound("compensate", path, log, "-o", out)
        # what is written was corrected
        assert (status == 0) == out.exists()
        assert status or out.read_text() != log.read_text()
    for name in WRITERS:
        sound("export", path, "--to", name, "-o", tmp_path / name)
    sound("filter", logs[0], "--online", path)
    sound("magnetometer", logs[3], "--field", "48", "--calibration", path)
    if kind != "thermal":  # planned for above; a minute
        sound("consequences", path, "--draws", "0", "--duration", "5", "-o", tmp_path / "consequences")
        sound("plan", path, "--equipment", "table", "--poses", "4", "-o", tmp_path / "plan")


@pytest.mark.slow
def test_a_budget_says_what_is_a_data_sheets(calibrations, tmp_path):
    line = ("consequences", calibrations["thermal"], "--draws", "0", "--duration", "5", "-o", tmp_path / "out")
    status, printed, _ = sound(*line)
    assert status == 0 and "of a data sheet, whose errors are not in the budget" in " ".join(printed.split())


def test_nothing_is_compensated_by_a_calibration_of_other_sensors(calibrations, folder, tmp_path):
    status, _, said = sound("compensate", calibrations["magnetometer"], folder / "log.csv", "-o", tmp_path / "out.csv")
    assert status == 2 and "has no magnetometer" in said and not (tmp_path / "out.csv").exists()


INPUTS = """
info X; calibrate X; calibrate X --means; calibrate LOG --static X; calibrate LOG --gyro-log X; diagnose X
diagnose X --thermal; diagnose LOG --reference X; check X LOG; check CALIBRATION X; compensate X LOG -o OUT
compensate CALIBRATION X -o OUT; allan X; turntable X; turntable LOG --reference X; reference X
reference LOG --reference X; array X X; filter X; filter LOG --online X; filter LOG --magnetometer X; magnetometer X
magnetometer LOG --mag-log X; magnetometer LOG --calibration X; magnetometer LOG --check X; plan X; budget X; thermal X
thermal LOG --calibration X; export X --to px4; export CALIBRATION --to kalibr --noise X; consequences X
consequences CALIBRATION --path X; consequences CALIBRATION --noise X; accept X --limits LIMITS
accept CALIBRATION --limits X; accept CALIBRATION --limits LIMITS --noise X; verify X; simulate X -o OUT
compare X CALIBRATION; compare CALIBRATION X
record --from X -o OUT; fleet LOG -o X
"""


@pytest.mark.parametrize("name", [".", "folder", "empty", "junk"])
def test_what_is_no_file_of_its_kind_is_a_sentence(name, both, folder, tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "empty").write_text("")
    (tmp_path / "junk").write_bytes(b"\x00\x01\xff\xfe" * 500)
    (tmp_path / "limits.toml").write_text('[limits]\n"accelerometer.bias" = "100 mg"\n')
    words = {"X": "." if name == "." else tmp_path / name, "LOG": folder / "log.csv", "CALIBRATION": both,
             "LIMITS": tmp_path / "limits.toml", "OUT": tmp_path / "out"}  # fmt: skip
    for line in INPUTS.strip().replace("\n", ";").split(";"):
        status, printed, said = sound(*(words.get(word, word) for word in line.split()))
        assert status in (1, 2) and printed == "", (line, status)
        assert "Errno" not in said, (line, said)


def test_what_is_read_is_not_written_over(both, folder, tmp_path):
    log, path = tmp_path / "log.csv", tmp_path / "calibration.json"
    log.write_bytes((folder / "log.csv").read_bytes())
    path.write_bytes(both.read_bytes())
    before = content(tmp_path)
    for line, output in ((["compensate", path, log], log), (["export", path, "--to", "csv"], path)):
        status, _, said = sound(*line, "-o", output)
        assert status == 2 and "which would be lost" in said and content(tmp_path) == before


def test_a_folder_is_no_file_to_write(both, folder, tmp_path):
    for line in (["export", both, "--to", "px4"], ["compensate", both, folder / "log.csv"]):
        status, _, said = sound(*line, "-o", tmp_path)
        assert status == 2 and str(tmp_path) in said
    assert list(tmp_path.iterdir()) == []
