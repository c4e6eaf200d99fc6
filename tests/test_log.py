"""`jaximu LOG`: what a log allows, run by the verbs' own functions, in one report."""

import io
import json
import re
import zipfile

import numpy as np
import pytest
from dialects import simulate as by_makers

from jaximu.cli import main, messages
from jaximu.cli.usage import command_of
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.page import Page
from jaximu.recordings import write_recording
from jaximu.recordings.readers import read_recording, reader
from jaximu.recordings.readers.archive import by_sensor
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld, Static


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Poses by hand and a rest of one unit, as CSV."""
    folder = tmp_path_factory.mktemp("logs")
    for name, protocol, rate in (("poses", HandHeld(14, 2.0, 1.0), 50.0), ("rest", Static(120.0), 50.0)):
        recording, _ = simulate(draw_imu(3), protocol, consumer_noise(), rate=rate, seed=3)
        write_recording(recording, folder / f"{name}.csv")
    return folder


@pytest.fixture(scope="module")
def phone(folder):
    """The files that a phone's app makes of the poses, by name: phyphox's text, and Sensor Logger's."""
    recording = read_recording(folder / "poses.csv")
    phyphox, logger = {}, {}
    for signal, name, other, unit in (
        (recording.accelerometer, "Accelerometer", "TotalAcceleration", "m/s^2"),
        (recording.gyroscope, "Gyroscope", "Gyroscope", "rad/s"),
    ):
        rows = list(zip(signal.time, *signal.values.T, strict=True))
        head = ",".join(f"{axis} ({unit})" for axis in "XYZ")
        text = "\n".join([f"Time (s),{head}", *(",".join(f"{value:.9e}" for value in row) for row in rows)])
        phyphox[f"{name}.csv"] = text
        logger[f"{other}.csv"] = "\n".join(
            ["time,seconds_elapsed,z,y,x"]
            + [f"{1_700_000_000_000_000_000 + round(1e9 * t)},{t:.9f},{z},{y},{x}" for t, x, y, z in rows]
        )
    return {
        "phyphox": phyphox | {"meta/device.csv": "property,value\nmodel,a", "meta/time.csv": "event\nSTART"},
        "Sensor Logger": logger
        | {"Accelerometer.csv": logger["TotalAcceleration.csv"].replace(",", ",0"), "Metadata.csv": "a,b\n1,2"},
    }


def packed(path, files):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return path


def answered(line, capsys):
    """The exit status, the document on stdout, and stderr."""
    status = main([*map(str, line), "--json"])
    printed = capsys.readouterr()
    return status, json.loads(printed.out), printed.err


@pytest.fixture
def verbs(monkeypatch):
    """Verbs that only note what they were run on: (verb, logs, arguments)."""
    calls = []

    def stand_in(verb):
        def run(command):
            arguments = vars(command)
            calls.append((verb, arguments.get("logs") or arguments["log_path"], arguments))
            names = ("diagnosis", "calibration") if verb == "diagnose" else ("calibration",)
            command.results.present(
                lambda: Page(f"About {verb}", ["It is done."]), **{name: Document() for name in names}
            )

        return run

    for verb in ("calibrate", "diagnose", "turntable", "reference", "magnetometer", "allan", "thermal"):
        monkeypatch.setattr(command_of(verb), "run", stand_in(verb))
    return calls


class Document:
    """A document that a verb prints."""

    def text(self):
        return json.dumps({"schema": "a"})

    def summary(self):
        return Page("About it", ["It is known."])


# --- what is run


def test_poses_by_hand_are_diagnosed_and_calibrated_by_one_fit(folder, tmp_path, capsys, monkeypatch):
    """The calibration is the diagnosis'; the file is parsed once; the documents are those on stdout."""
    parsed, tables_of = [], reader._tables_of
    monkeypatch.setattr(reader, "_tables_of", lambda path, choice: parsed.append(path) or tables_of(path, choice))
    monkeypatch.setattr("jaximu.calibration.calibrate", None)
    log, out = folder / "poses.csv", tmp_path / "out"
    status, document, said = answered([log, "-o", out, "--gravity", "9.80665+-0.001"], capsys)
    assert status == 0 and document["verbs"] == ["calibrate", "diagnose"] and len(parsed) == 1
    assert document["verdict"] == document["diagnose"]["verdict"] == "adequate"
    assert document["next"].startswith(f"jaximu compensate {out}/calibration.json {log} -o ")
    assert document["logs"][0]["signals"]["gyroscope"]["unit"] == "rad/s" and document["refused"] == {}
    for name, verb in (("calibration", "calibrate"), ("diagnosis", "diagnose")):
        assert json.loads((out / f"{name}.json").read_text()) == document[verb]
    page = (out / "report.html").read_text()
    assert page.count("<h1>") == 1 and page.count("Next: ") == 1 and "What was noticed" in page
    assert re.findall(r"<h2 id=\"(calibration|diagnosis)-of", page) == ["calibration", "diagnosis"]
    assert {path.name for path in out.glob("*.png")} >= {"calibrate_recording.png", "diagnose_diagnosis.png"}
    assert "Written to" in said
    monkeypatch.undo()
    capsys.readouterr()
    assert main(document["next"].replace("-o CORRECTED.csv", f"-o {tmp_path / 'c.csv'}").split()[1:]) == 0


def test_without_a_folder_the_page_is_printed(folder, verbs, capsys):
    assert main([str(folder / "poses.csv"), "--rate", "50"]) == 0
    printed = capsys.readouterr()
    lines = printed.out.splitlines()
    assert lines[:2] == ["poses.csv", "It is done."] and "About diagnose" in lines
    assert lines[-1] == f"Next: `jaximu {folder}/poses.csv --rate 50.0 -o results`" or printed.out.count("Next: ") == 1
    assert "-o DIR writes" in printed.err


def test_a_rest_states_the_noise_of_the_poses(folder, verbs, capsys):
    poses, rest = folder / "poses.csv", folder / "rest.csv"
    status, document, said = answered([rest, poses, "--yes"], capsys)
    assert status == 0 and document["verbs"] == ["calibrate", "diagnose", "allan"] and "is at rest" in said
    (_, first, arguments), (_, second, _) = verbs  # calibrate is what the diagnosis gave
    assert first == (poses,) and second == (rest,)
    assert arguments["noise"].static == rest and arguments["local"].gravity is None


def test_a_log_that_is_three_things_at_once(verbs, tmp_path, capsys):
    """Poses, a field, a table's columns, heat: each is run, on the log, in one order."""
    recording, _ = simulate(draw_imu(3), HandHeld(12, 2.0, 1.0), consumer_noise(), rate=50.0, seed=3)
    time, force = recording.accelerometer.time, recording.accelerometer.values
    columns = [time, *force.T, *recording.gyroscope.values.T, *(5.0 * force.T), np.linspace(20, 40, len(time)), time]
    names = "time [s]|accel_x [m/s^2]|accel_y [m/s^2]|accel_z [m/s^2]|gyro_x [rad/s]|gyro_y [rad/s]|gyro_z [rad/s]"
    names += "|mag_x [uT]|mag_y [uT]|mag_z [uT]|temperature [degC]|table_angle [deg]"
    path = tmp_path / "all.csv"
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=names.replace("|", ","), comments="", fmt="%.9g")
    status, document, _ = answered([path], capsys)
    assert status == 0 and document["verdict"] == "It is done."
    assert document["verbs"] == ["calibrate", "diagnose", "turntable", "magnetometer", "thermal"]
    assert {logs for _, logs, _ in verbs} == {(path,)}


def test_what_refuses_is_a_sentence_unless_nothing_is_left(folder, verbs, monkeypatch, capsys):
    def refuses(command):
        raise NotPossibleError("poses are missing.")

    monkeypatch.setattr(command_of("diagnose"), "run", refuses)
    status, document, _ = answered([folder / "poses.csv"], capsys)
    assert status == 0 and document["verbs"] == ["calibrate"] and verbs[0][0] == "calibrate"
    assert document["refused"] == {"diagnose": "poses are missing."}
    monkeypatch.setattr(command_of("calibrate"), "run", refuses)
    status, document, _ = answered([folder / "poses.csv"], capsys)
    assert status == 1 and "poses are missing." in document["error"] and "nine orientations" in document["error"]


def test_two_documents_of_one_name_are_both_kept(folder, verbs, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("jaximu.cli.log._HELD", {})
    assert answered([folder / "poses.csv", "-o", tmp_path], capsys)[0] == 0
    names = {path.name for path in tmp_path.glob("*.json")}
    assert names == {"calibration.json", "diagnosis.json", "diagnose_calibration.json"}


def test_a_short_log_of_one_orientation_allows_nothing(tmp_path, capsys):
    recording, _ = simulate(draw_imu(3), Static(20.0), consumer_noise(), rate=50.0, seed=3)
    write_recording(recording, tmp_path / "short.csv")
    status, document, _ = answered([tmp_path / "short.csv", "-o", tmp_path / "out"], capsys)
    assert status == 1 and "one orientation" in document["error"] and "record rests" in document["error"]
    assert not list((tmp_path / "out").glob("*"))


def test_an_attitude_needs_a_sensor_beside_it(folder, verbs, tmp_path, capsys):
    time = np.linspace(0, 40, 400)
    turned = np.column_stack([time, np.cos(time), 0 * time, np.sin(time), 0 * time])
    path = tmp_path / "truth.csv"
    np.savetxt(path, turned, delimiter=",", header="time [s],qw,qx,qy,qz", comments="")
    status, document, _ = answered([path], capsys)
    assert status == 2 and "holds an attitude and no sensor" in document["error"]
    assert answered([folder / "poses.csv", path], capsys)[1]["verbs"] == ["calibrate", "diagnose", "reference"]
    assert verbs[-1][1] == folder / "poses.csv" and verbs[-1][2]["reference"] == path


# --- questions


@pytest.fixture
def without_time(folder, tmp_path):
    lines = (folder / "poses.csv").read_text().splitlines()
    path = tmp_path / "no time.csv"
    path.write_text("\n".join(line.partition(",")[2] for line in lines))
    return path


@pytest.mark.parametrize("more", [[], ["--yes"]])
def test_without_a_terminal_the_default_is_taken_and_said(without_time, verbs, capsys, more, monkeypatch):
    monkeypatch.setattr("sys.stdin.readline", None)  # nobody is asked
    status, document, said = answered([without_time, *more], capsys)
    assert status == 0 and verbs[0][2]["log"].rate == 100.0
    assert "Assumed: 100; state it with --rate" in said and "--rate" in document["assumed"][0]


@pytest.mark.parametrize(("reply", "rate"), [("50\n", 50.0), ("\n", 100.0), ("", 100.0)])
def test_on_a_terminal_one_question_is_asked(without_time, verbs, capsys, monkeypatch, reply, rate):
    terminal = io.StringIO(reply)
    terminal.isatty = lambda: True
    monkeypatch.setattr("sys.stdin", terminal)
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    assert main([str(without_time), str(without_time), "--json"]) == 0
    said = capsys.readouterr().err
    plain = re.sub(r"\x1b\[[?\d;]*[A-Za-z]", "", said)
    assert plain.count("How many samples a second") == 1 and "states no rate. [100] " in plain
    assert verbs[0][2]["log"].rate == rate


def test_an_answer_that_is_no_number_is_refused(without_time, verbs, capsys, monkeypatch):
    terminal = io.StringIO("fast\n")
    terminal.isatty = lambda: True
    monkeypatch.setattr("sys.stdin", terminal)
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    status, document, _ = answered([without_time], capsys)
    assert status == 2 and "--rate: 'fast' is not a number" in document["error"]


def test_a_log_that_says_all_asks_nothing(folder, verbs, capsys, monkeypatch):
    monkeypatch.setattr("sys.stdin.readline", None)
    status, document, said = answered([folder / "poses.csv"], capsys)
    assert status == 0 and document["assumed"] == [] and "Assumed" not in said


def test_units_that_nothing_decides_are_assumed(tmp_path, verbs, capsys):
    """Stamps of 505 140 a row, and a gyroscope at rest without a unit."""
    random = np.random.default_rng(1)
    columns = [np.arange(4000) * 505_140.0, *random.normal([0.1, 0.2, 9.8], 0.02, (4000, 3)).T]
    columns += [*random.normal(0, 0.03, (4000, 3)).T, np.linspace(20, 40, 4000)]
    path = tmp_path / "log.csv"
    head = "timestamp,acc_x,acc_y,acc_z,gyr_x,gyr_y,gyr_z,temperature [degC]"
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=head, comments="", fmt="%.9g")
    status, document, _ = answered([path], capsys)
    assert status == 0 and document["verbs"] == ["thermal"] and len(document["assumed"]) == 2
    assert verbs[0][2]["log"].columns == "time [us],accel [m/s^2],gyro [rad/s],temperature [degC]"
    assert document["logs"][0]["guess"]["line"].startswith('--columns "time [us]')


def test_two_files_of_one_recording_are_one_log(phone, verbs, tmp_path, capsys):
    paths = [tmp_path / name for name in ("Gyroscope.csv", "Accelerometer.csv")]
    for path in paths:
        path.write_text(phone["phyphox"][path.name])
    status, document, _ = answered(paths, capsys)
    assert status == 0 and document["verbs"] == ["calibrate", "diagnose"]
    assert verbs[0][1] == (paths[1],) and verbs[0][2]["log"].gyro_log == paths[0]


_METAWEAR = "MetaWear_2020-09-13T12.26.40.000_C8D1A2B3_{}_{}Hz_1.4.4.csv"


def test_files_that_a_logger_calls_alike_but_for_the_sensor_are_one_log(tmp_path, capsys):
    """A folder of two is read; each of the two leads to the other, whatever the rates in their names."""
    log, folder = by_makers("poses"), tmp_path / "session"
    folder.mkdir()
    stated = {"Accelerometer": ("100.000", "g", log.force / 9.80665), "Gyroscope": ("50.000", "deg/s", log.rate * 57.3)}
    for sensor, (rate, unit, values) in stated.items():
        head = f"epoch (ms),elapsed (s),{','.join(f'{axis}-axis ({unit})' for axis in 'xyz')}"
        rows = np.column_stack([1.6e12 + 1e3 * log.time, log.time, values])
        np.savetxt(folder / _METAWEAR.format(sensor, rate), rows, delimiter=",", header=head, comments="", fmt="%.10g")
    (folder / "notes.txt").write_text("held by hand\n")
    accelerometer, gyroscope = (folder / _METAWEAR.format(name, rate) for name, (rate, *_) in stated.items())
    both = f"{accelerometer} --gyro-log {gyroscope}"
    for path, words in ((folder, f"jaximu calibrate {folder} "), (accelerometer, f"jaximu calibrate {both} ")):
        assert main(["info", str(path)]) == 0
        assert words in capsys.readouterr().out
    assert main(["info", str(gyroscope), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["findings"][-1].endswith(f"jaximu info {both}")
    other = folder / _METAWEAR.format("Accelerometer", "100.000").replace("12.26", "13.26")
    other.write_bytes(accelerometer.read_bytes())  # of another session: which one is meant?
    assert main(["info", str(folder)]) == 2


@pytest.mark.parametrize(
    ("names", "sensors"),
    [
        (["walk1_accelerometer.csv", "walk1_gyro.csv"], {"accel", "gyro"}),
        (["u1_accel.csv", "u2_gyro.csv"], set()),
        (["accelerometer.csv", "accelerometer_gyro.csv"], set()),
        (["a_Linear Accelerometer.csv", "a_Gyroscope.csv"], set()),
    ],
)
def test_names_of_files_that_belong_together(names, sensors):
    assert set(by_sensor(names)) == sensors


def test_several_logs_of_poses_are_one_unit_s(folder, verbs, tmp_path, capsys):
    other = tmp_path / "other.csv"
    other.write_bytes((folder / "poses.csv").read_bytes())
    assert answered([folder / "poses.csv", other], capsys)[0] == 0
    assert [logs for _, logs, _ in verbs] == [(folder / "poses.csv", other)]


def test_a_scale_of_counts_that_is_not_stated_comes_from_turning(folder, verbs, tmp_path, capsys):
    """23 counts to 1 °/s are no sensor's of the list: the turns of gravity show it."""
    recording = read_recording(folder / "poses.csv")
    counts = np.round(np.degrees(recording.gyroscope.values) * 23)
    columns = np.column_stack([recording.gyroscope.time, recording.accelerometer.values, counts])
    path = tmp_path / "counts.csv"
    head = ",".join(["time [s]", *(f"accel_{a} [m/s^2]" for a in "xyz"), *(f"gyro_{a} [count]" for a in "xyz")])
    np.savetxt(path, columns, delimiter=",", header=head, comments="", fmt="%.9g")
    status, document, _ = answered([path], capsys)
    scale, unit = verbs[0][2]["log"].gyro_scale.split()
    assert status == 0 and 20 < float(scale) < 26 and unit == "count/(deg/s)"
    assert "--gyro-scale" in document["assumed"][0]


def test_a_few_blocks_over_temperature_are_refused(tmp_path, capsys):
    random = np.random.default_rng(2)
    columns = [np.arange(1200) / 100, *random.normal([0.1, 0.2, 9.8], 0.02, (1200, 3)).T, np.linspace(20, 40, 1200)]
    path = tmp_path / "short.csv"
    head = "time [s],accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2],temperature [degC]"
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=head, comments="", fmt="%.9g")
    status, document, _ = answered([path], capsys)
    assert status == 1 and "at rest" in document["error"] and "should not happen" not in document["error"]


# --- what is a log


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("calibrat log.csv", ("no command 'calibrat'", "did you mean calibrate?")),
        ("lgo.csv", ("lgo.csv", "No such file")),
        ("nowhere/log", ("nowhere/log", "No such file")),
        ("lgo.csv --gravty 9.8", ("jaximu LOG has no option --gravty", "--gravity")),
    ],
)
def test_a_mistyped_verb_is_no_log(line, words, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.csv").write_text("a\n")
    assert main(line.split()) == 2
    said = capsys.readouterr().err
    assert all(word in said for word in words)


def test_help_shows_it(folder, capsys):
    for line in (["help", "LOG"], ["LOG", "--help"], [str(folder / "poses.csv"), "--help"]):
        assert main(line) == 0
        assert capsys.readouterr().out.startswith("usage: jaximu [OPTIONS] LOG [LOG ...]\n")
    assert main(["help"]) == 0 and "jaximu LOG [LOG ...] [--yes] [-o DIR]" in capsys.readouterr().out


def test_an_empty_file_is_refused(tmp_path, capsys):
    (tmp_path / "empty.csv").write_text("")
    status, document, _ = answered([tmp_path / "empty.csv", "-o", tmp_path / "out"], capsys)
    assert status == 2 and "is empty" in document["error"] and messages.level == 1


# --- folders and archives


@pytest.mark.parametrize("app", ["phyphox", "Sensor Logger"])
@pytest.mark.parametrize("kind", ["archive", "folder", "in a folder"])
def test_a_phone_s_files_are_one_recording(folder, phone, app, kind, tmp_path):
    path = tmp_path / "phone.zip"
    if kind == "folder":
        for name, text in phone[app].items():
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            (path / name).write_text(text)
    else:
        inside = "2026-03-04/" if kind == "in a folder" else ""
        packed(path, {inside + name: text for name, text in phone[app].items()})
    recording, log = read_recording(path), read_recording(folder / "poses.csv")
    for signal, same in ((recording.accelerometer, log.accelerometer), (recording.gyroscope, log.gyroscope)):
        np.testing.assert_allclose(signal.values, same.values, atol=1e-6)
        np.testing.assert_allclose(signal.time, same.time - same.time[0], atol=1e-6)
        assert signal.unit == same.unit
    assert [source.path for source in recording.sources] == [str(path)] and recording.sources[0].sha256


def test_a_magnetometer_without_a_unit_is_left_out(phone, tmp_path):
    files = phone["phyphox"] | {"Magnetometer.csv": "t,x,y,z\n1,2,3,4\n2,3,4,5\n3,4,5,7\n"}
    recording = read_recording(packed(tmp_path / "phone.zip", files))
    assert recording.magnetometer is None and any("Magnetometer.csv" in note for note in recording.notes)
    files["Magnetometer.csv"] = phone["phyphox"]["Gyroscope.csv"].replace("rad/s", "µT")
    recording = read_recording(packed(tmp_path / "phone.zip", files))
    assert recording.magnetometer is not None and recording.magnetometer.unit == "uT"


def test_files_of_a_folder_without_units_are_named_with_the_command_that_asks(tmp_path):
    for sensor in ("Accelerometer", "Gyroscope"):
        (tmp_path / f"{sensor}.csv").write_text("t,x,y,z\n1,2,3,4\n2,3,4,5\n3,4,5,7\n")
    with pytest.raises(InputError, match=r"jaximu info \S+Accelerometer\.csv --gyro-log \S+Gyroscope\.csv"):
        read_recording(tmp_path)


PROSE = (
    "IMU log of 4 March 2026, session 1, 14:05.\n\nSampled at 100 Hz: 3 axes, 16 bits, range 4 g.\nRecorded by hand.\n"
)


def test_one_log_in_an_archive_is_read_as_it_is(folder, tmp_path):
    text = (folder / "poses.csv").read_text()
    path = packed(
        tmp_path / "log.zip", {"log.csv": text, "notes.md": "", "__MACOSX/._log.csv": "", "README.txt": PROSE}
    )
    assert len(read_recording(path).accelerometer) == len(read_recording(folder / "poses.csv").accelerometer)


def hostile(path, name):
    """Archives that no phone writes."""
    log = "time [s],accel_x [g]\n"
    files = {
        "nothing in it": {},
        "only folders": {"a/": ""},
        "several": {"monday.csv": log, "tuesday.csv": log},
        "several accelerometers": {"a/Accelerometer.csv": log, "a/Gyroscope.csv": log, "b/Accelerometer.csv": log},
        "short names": {"a.csv": log, "g.csv": log},
        "nested": {"log.zip": "PK\x03\x04"},
        "too many": {f"{number}.csv": log for number in range(1001)},
        "too large": {"Accelerometer.csv": "0" * (140 << 20), "Gyroscope.csv": log},
        "paths": {"../../Accelerometer.csv": log, "../../Gyroscope.csv": log},
        "a workbook": {"xl/workbook.xml": ""},
        "empty log": {"Accelerometer.csv": "", "Gyroscope.csv": log},
    }
    return packed(path, files[name])


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nothing in it", "nothing in it"),
        ("only folders", "nothing in it"),
        ("several", "monday.csv, tuesday.csv"),
        ("several accelerometers", "not of one recording"),
        ("short names", "not of one recording"),
        ("nested", "log.zip"),
        ("too many", "1001 files"),
        ("too large", "as no recording does"),
        ("paths", "not of one recording"),
        ("a workbook", "Excel workbook"),
        ("empty log", "phone.zip/Accelerometer.csv: is empty"),
    ],
)
def test_hostile_archives_are_refused(name, words, tmp_path):
    path = hostile(tmp_path / "phone.zip", name)
    with pytest.raises(InputError, match=re.escape(words)):
        read_recording(path)
    assert [file.name for file in tmp_path.iterdir()] == ["phone.zip"]


def test_a_damaged_archive_is_refused(phone, tmp_path):
    data = packed(tmp_path / "phone.zip", phone["phyphox"]).read_bytes()
    for damaged in (data[:4000], data[:2000] + b"\x00" * 50 + data[2050:]):
        (tmp_path / "phone.zip").write_bytes(damaged)
        with pytest.raises(InputError, match="cut off or damaged"):
            read_recording(tmp_path / "phone.zip")


@pytest.mark.parametrize("verb", [[], ["info"], ["calibrate"], ["allan"]])
@pytest.mark.parametrize("files", [[], ["a.pdf", "b.png"]])
def test_a_folder_without_logs_is_not_advised_a_fleet(files, verb, tmp_path, capsys, monkeypatch):
    """The advice would refuse the same folder."""
    for name in files:
        (tmp_path / name).write_text("nothing")
    monkeypatch.chdir(tmp_path)
    assert main([*verb, "."]) in (1, 2)
    printed = capsys.readouterr().err
    assert "Name a log, or a folder of logs." in printed and "fleet" not in printed


@pytest.mark.parametrize("count", [2, 1000])
def test_a_folder_of_logs_offers_a_fleet(count, tmp_path, capsys, monkeypatch):
    for number in range(count):
        (tmp_path / f"unit{number}.csv").write_text("time [s]\n")
    monkeypatch.chdir(tmp_path)
    status, document, _ = answered(["."], capsys)
    assert status == 1 and "jaximu fleet . -o fleet.parquet" in document["error"] and len(document["error"]) < 300
