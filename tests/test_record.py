"""Guided recording: what counts as a pose, which orientation comes next, sources of lines, and bad ones."""

import json
import os
import sys
import threading
from itertools import pairwise

import numpy as np
import pytest
from simulated_person import GRAVITY, Person

from jaximu.calibration import calibrate, load_calibration
from jaximu.cli.app import main
from jaximu.estimation.problem import flatten, names_of
from jaximu.ground.errors import InputError
from jaximu.ground.gravity import LocalGravity
from jaximu.planning.goals import per_si
from jaximu.planning.guide import Guide
from jaximu.planning.poses import box_words
from jaximu.recordings import write_recording
from jaximu.recordings.readers import read_recording
from jaximu.recordings.readers.stream import Lines

KNOWN = LocalGravity(GRAVITY, 0.0)


@pytest.fixture(scope="module")
def session():
    """A careless person led to a goal: the person, every moment, and the directions that were asked for."""
    person, guide = Person(5, careless=0.2), Guide(["accelerometer.bias 0.06 mg", "gyroscope.scale 0.5 %"], KNOWN)
    up, asked, moments = np.array([0.0, 0.0, 1.0]), [], []
    while not (moments and moments[-1].done) and len(asked) < 30:
        person.pose(up)
        asked.append(up)
        moments.append(guide.update(person.recording()))
        up = up if moments[-1].up is None else moments[-1].up
    return person, moments, asked


def test_a_careless_person_is_led_to_the_goal(session):
    person, moments, asked = session
    last = moments[-1]
    assert last.done and all(goal.reached for goal in last.goals)
    assert not any(moment.done for moment in moments[:-1])
    found = last.calibration
    sigma = np.sqrt(np.diagonal(found.covariance))
    bias = max(s / per_si(n, found.imu) for n, s in zip(found.names, sigma, strict=True) if "accelerometer.bias" in n)
    assert last.goals[0].now == pytest.approx(bias) and last.goals[0].size == pytest.approx(0.06e-3 * 9.80665)
    truth = np.concatenate([np.append(g.ravel(), b) for g, b in zip(person.gains, person.bias, strict=True)])
    places = [names_of(found.imu).index(name) for name in found.names]
    off = (np.asarray(flatten(found.imu)) - truth)[places] / sigma
    assert np.max(np.abs(off)) < 4
    # nobody is sent where the last pose is, or by a turn that is hard to make by hand
    assert all(-0.95 < before @ after < 0.95 for before, after in pairwise(asked) if before is not after)


def test_short_and_moving_rests_do_not_count(session):
    person, moments, _ = session
    counted = moments[-1].taken
    fates = []
    for start, stop, turned in person.moved:
        hit = np.any(np.minimum(counted[:, 1], stop) - np.maximum(counted[:, 0], start) > 1.0)
        fates.append((stop - start, turned, bool(hit)))
    assert all(hit for length, turned, hit in fates if length > 4.4 and turned == 0)
    assert not any(hit for length, turned, hit in fates if length < 3.5 or turned > 0.5)
    assert {length < 3.5 for length, *_ in fates} == {turned > 0.5 for _, turned, _ in fates} == {True, False}


def test_the_next_pose_is_where_the_goal_is_open():
    """Poses about x alone leave the x axis of the accelerometer open: it is sent there, and said which face that is."""
    person, guide = Person(7, careless=0.0, off=0.0), Guide(["accelerometer.bias[0] 0.1 mg"], KNOWN)
    for angle in np.radians([0, 50, 100, 150]):
        person.pose([0.0, np.sin(angle), np.cos(angle)])
        moment = guide.update(person.recording())
    assert len(moment.taken) == 4 and abs(moment.up[0]) > 0.5 and "x" in moment.words
    assert moment.goals[0].now == np.inf and not moment.done


def test_rest_is_followed_as_it_goes():
    person, guide = Person(1, careless=0.0), Guide(rest=3.0)
    person.hold(2.0, 0.0)
    assert 1.5 < guide.update(person.recording()).still <= 2.0  # less what trembling may hide at both ends
    person.turn_to([1.0, 0.0, 0.0])
    moment = guide.update(person.recording())
    assert (moment.still, len(moment.taken)) == (0.0, 0) and moment.short == pytest.approx(2.0, abs=0.4)
    person.hold(3.5, 0.0)
    moment = guide.update(person.recording())
    assert len(moment.taken) == 1 and moment.still > 3.0 and moment.words


def test_words_of_a_box():
    half = np.sqrt(0.5)
    assert box_words(np.array([0.0, -1.0, 0.0])) == "face −y up"
    assert box_words(np.array([half, 0.0, -half])) == "the edge of faces +x and −z up"
    assert box_words(np.array([1, -1, 1]) / np.sqrt(3)) == "the corner of faces +x, −y and +z up"


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def log(session, tmp_path_factory):
    path = tmp_path_factory.mktemp("record") / "hand.csv"
    write_recording(session[0].recording(), path)
    return path


def test_a_log_played_again_stops_at_the_goal_and_calibrates_as_calibrate_does(log, session, tmp_path, capsys):
    out = tmp_path / "out"
    given_ = ["record", "--from", str(log), "--gravity", f"{GRAVITY}", "--serial", "A-7", "-o", str(out)]
    assert main([*given_, "--goal", "accelerometer.bias 0.5 mg", "--json"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["trace"]["serial"] == "A-7"
    assert "Next: " in printed.err and "accelerometer.bias 0.5 mg: reached" in printed.err
    recorded = read_recording(out / "log.csv")
    whole = session[0].recording()
    assert len(recorded.accelerometer) < 0.95 * len(whole.accelerometer)  # a pose earlier at the least
    same = whole.accelerometer.values[: len(recorded.accelerometer)]
    np.testing.assert_allclose(recorded.accelerometer.values, same, rtol=1e-12)
    again = calibrate(recorded, LocalGravity(GRAVITY, 0.0))
    np.testing.assert_allclose(flatten(load_calibration(out / "calibration.json").imu), flatten(again.imu), rtol=1e-9)
    assert main(given_) == 2
    assert "log.csv exists; name another folder" in capsys.readouterr().err


def test_what_cannot_be_recorded_is_refused(log, tmp_path, capsys):
    for given_, said in (
        (["--from", str(log)], "-o DIR"),
        (["--from", "no-such-command x", "-o", str(tmp_path / "a")], "no file, port or command"),
        (["--from", str(log), "--goal", "accelerometer.colour 1 mg", "-o", str(tmp_path / "a")], "no parameter"),
        (["--from", str(log), "--goal", "accelerometer.bias", "-o", str(tmp_path / "a")], "what and how much"),
        (["--from", str(log), "--rest", "0", "-o", str(tmp_path / "a")], "more than zero"),
    ):
        assert main(["record", *given_]) == 2
        assert said in capsys.readouterr().err
        assert not (tmp_path / "a").exists()
    words = tmp_path / "words.txt"
    words.write_text("time,accel\n" + "nothing,here\n" * 2000)
    assert main(["record", "--from", str(words), "-o", str(tmp_path / "b")]) == 2
    assert "has what was recorded" in capsys.readouterr().err
    few = tmp_path / "few.csv"
    few.write_text("".join(log.read_text().splitlines(keepends=True)[:600]))
    assert main(["record", "--from", str(few), "-o", str(tmp_path / "c")]) == 1
    told = capsys.readouterr().err
    assert "ended before the goal" in told and "static pose" in told and (tmp_path / "c" / "log.csv").is_file()


# --- sources ----------------------------------------------------------------------------------------------------------


def everything(lines, count=2):
    found = []
    while some := lines.take(count):
        found += some
    return found


def test_lines_of_a_command_without_the_garbled_ones(tmp_path):
    script = "import sys\nfor row in ('t,a,b', '1,2,3', '4,5', '6,7,8,9', '', '# said', 'ä,2,3', '7,8,9'): print(row)\n"
    path = tmp_path / "sensor.py"
    path.write_text(script + "sys.stdout.write('10,11,12')\n", encoding="utf-8")  # the last line is cut off
    with Lines(f"{sys.executable} -X utf8 {path}") as it:
        assert everything(it) == [b"t,a,b\n", b"1,2,3\n", b"# said\n", b"7,8,9\n"]
        assert (it.garbled, it.stopped) == (4, "")


def test_a_preamble_is_kept_and_a_long_garbled_file_ends(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("Sensor ready\nt,a,b\n1,2,3\n4,5\n" + "6\n" * 5000)
    with Lines(str(path)) as lines:
        assert everything(lines) == [b"Sensor ready\n", b"t,a,b\n", b"1,2,3\n"]
        assert lines.garbled == 5001


def test_silence_is_said():
    with Lines(f'{sys.executable} -c "import time; print(1, flush=True); time.sleep(60)"', patience=1.0) as lines:
        assert lines.take(1) == [b"1\n"]
        with pytest.raises(InputError, match=r"no line has come for 1 s\. Is the sensor on\?"):
            lines.take(1)


def test_a_serial_port(monkeypatch):
    master, slave = os.openpty()
    name = os.ttyname(slave)

    def send():
        os.write(master, b"3,4\n")  # cut: the port was opened in the middle of a line
        for row in range(5):
            os.write(master, b"%d,0.5\n" % row)

    sender = threading.Timer(0.3, send)
    sender.start()
    with Lines(name, patience=2.0) as lines:
        assert lines.take(5) == [b"%d,0.5\n" % row for row in range(5)]
        with pytest.raises(InputError, match="baud= right"):
            lines.take(1)
        os.close(master)
    sender.join()
    os.close(slave)
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(InputError, match=r"pip install 'jaximu\[serial\]'"):
        Lines("COM99")


def test_a_port_that_cannot_be_opened():
    with pytest.raises(InputError, match="cannot be opened"):
        Lines("COM99")
