"""Guided recording: what counts as a pose, which orientation comes next, sources of lines, and bad ones."""

import json
import os
import re
import socket
import sys
import threading
import time
from dataclasses import replace
from itertools import pairwise
from urllib.request import urlopen

import numpy as np
import pytest
from markupsafe import escape
from simulated_person import GRAVITY, Person

from jaximu.calibration import calibrate, load_calibration
from jaximu.cli import server
from jaximu.cli.app import main
from jaximu.estimation.problem import flatten, names_of
from jaximu.ground.errors import InputError
from jaximu.ground.gravity import LocalGravity
from jaximu.planning.goals import per_si
from jaximu.planning.guide import Guide
from jaximu.planning.poses import box_words, turned_to, up_of
from jaximu.recordings import write_recording
from jaximu.recordings.readers import read_recording
from jaximu.recordings.readers.stream import Lines
from jaximu.report.guide import Capture, LivePage
from jaximu.simulation.protocols.course import attitude_of

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


@pytest.fixture
def browser(monkeypatch):
    """A browser that follows the page of every recording: all that it is sent, event by event."""
    shown = []

    def read(address):
        with urlopen(f"{address}events", timeout=30) as stream:
            shown.extend(json.loads(line[6:]) for line in stream if line.startswith(b"data: {"))

    def opened(address):
        shown.append({"page": urlopen(address, timeout=30).read().decode()})
        threading.Thread(target=read, args=(address,), daemon=True).start()

    monkeypatch.setattr(server, "open_in_browser", opened)
    return shown


def test_a_log_played_again_stops_at_the_goal_and_calibrates_as_calibrate_does(log, session, browser, tmp_path, capsys):
    out = tmp_path / "out"
    given_ = ["record", "--from", str(log), "--gravity", f"{GRAVITY}", "--serial", "A-7", "-o", str(out)]
    assert main([*given_, "--goal", "accelerometer.bias 0.5 mg", "--json", "--page"]) == 0
    printed = capsys.readouterr()
    last = {name: text for parts in browser for name, text in parts.items()}
    assert last["headline"] == f"Calibrated: the report is {out / 'report.html'}"
    assert last["words"] == "nothing" and "accelerometer.bias 0.5 mg: reached" in last["poses"]
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


# --- the page ---------------------------------------------------------------------------------------------------------


def test_the_terminal_says_the_same_beside_a_page(log, browser, tmp_path, capsys):
    few = tmp_path / "few.csv"
    few.write_text("".join(log.read_text().splitlines(keepends=True)[:1500]))
    printed = []
    for name, more in (("plain", []), ("paged", ["--page"])):
        assert main(["record", "--from", str(few), *more, "-o", str(tmp_path / name)]) == 1
        printed.append(capsys.readouterr().err.replace(name, "…"))
    first, _, rest = printed[1].partition("\n")
    assert first.startswith("The page is http://127.0.0.1:")
    assert rest == printed[0] and "Pose 1 counts. Next: " in rest
    assert "<h1" in browser[0]["page"] and "Waiting for the first samples" in browser[0]["page"]
    news = [parts["news"] for parts in browser if parts.get("news")]
    assert news and all(str(text) in rest for text in news)
    assert browser[-1]["headline"].startswith("The recording has ended: ")


def test_a_page_that_cannot_be_served_stops_before_anything_is_recorded(log, tmp_path, capsys):
    out = tmp_path / "out"
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = str(other.getsockname()[1])
        assert main(["record", "--from", str(log), "--page", "--page-port", taken, "-o", str(out)]) == 2
    assert f"--page-port {taken} cannot be used" in capsys.readouterr().err
    assert main(["record", "--from", str(log), "--page", "--page-port", "70000", "-o", str(out)]) == 2
    assert "numbers from 1 to 65535" in capsys.readouterr().err
    assert main(["record", "--from", str(log), "--page-port", "8000", "-o", str(out)]) == 2
    assert "--page-port goes with --page" in capsys.readouterr().err
    assert not out.exists()


def test_a_recording_that_fails_says_so_on_the_page(browser, tmp_path, capsys):
    words = tmp_path / "words.txt"
    words.write_text("time,accel\n" + "nothing,<here>\n" * 2000)
    assert main(["record", "--from", str(words), "--page", "-o", str(tmp_path / "b")]) == 2
    error = capsys.readouterr().err.splitlines()[-1].removeprefix("jaximu: ")
    assert browser[-1]["headline"] == str(escape(f"The recording has ended: {error}"))


def test_the_page_draws_the_unit_and_what_is_still_uncertain(session):
    """The drawn unit has the next pose's direction up, and a map with a calibration fades on one scale."""
    _, moments, _ = session
    live, maps = LivePage(4.0), []
    assert live.parts() == {"headline": "Waiting for the first samples", "news": "", "stage": ""}
    for moment in moments:
        live.capture = Capture(4.0, moment, "a < b")
        parts = live.parts()
        assert parts["news"] == "a &lt; b" and "<svg" in parts["now"] + parts["next"]
        assert ("at most" in parts["map"]) == (moment.calibration is not None)
        maps += re.findall("at most. The first map had ±([^:]+):", parts["map"])
        again = live.parts()
        assert again == parts  # nothing has changed: nothing is drawn again
    assert len(maps) > 1 and len(set(maps)) == 1
    assert live.parts()["headline"] == f"Done: {len(moments[-1].taken)} poses count"
    assert len(re.findall("pose [0-9]+&", parts["map"])) == len(moments[-1].taken)


def test_headlines():
    person, guide = Person(1, careless=0.0), Guide(rest=3.0)
    live = LivePage(3.0)

    def headline():
        live.capture = Capture(3.0, guide.update(person.recording()))
        return live.parts()["headline"]

    person.hold(2.0, 0.0)
    assert headline() == "Hold still"
    person.turn_to([1.0, 0.0, 0.0])
    assert headline() == "Hold the unit still in any orientation"
    person.hold(3.5, 0.0)
    words = live.capture.moment.words
    assert words == "" and headline() == f"Pose 1 counts. Turn to {live.capture.moment.words}"
    person.turn_to(live.capture.moment.up)
    assert headline() == f"Turn to {live.capture.moment.words}"
    degrees = int(re.match("([0-9]+)° from the next pose", live.parts()["held"])[1])
    assert degrees < 25  # a person misses by some degrees
    live.capture = replace(live.capture, stage="Computing …", since=time.monotonic())
    assert live.parts()["stage"] == ""  # most take less than a second
    live.capture = replace(live.capture, since=time.monotonic() - 2)
    assert live.parts()["stage"] == "Computing …"


def test_the_shortest_turn_brings_a_direction_upwards():
    rng = np.random.default_rng(3)
    for before, after in [
        *rng.standard_normal((20, 2, 3)),
        *np.array([[[0, 0, 1], [0, 0, 1]], [[0, 0, 1], [0, 0, -1.0]]]),
    ]:
        before, after = before / np.linalg.norm(before), after / np.linalg.norm(after)
        first = attitude_of(before, 0.7).as_quat(scalar_first=True)
        turned = turned_to(first, after)
        np.testing.assert_allclose(up_of(turned), after, atol=1e-12)
        angle = 2 * np.arccos(np.clip(first @ turned, -1, 1))
        assert angle == pytest.approx(np.arccos(np.clip(before @ after, -1, 1)), abs=1e-6)


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
