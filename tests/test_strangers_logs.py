"""Logs as strangers have them: whose rows, clocks, names, layouts, and what only turns from rest to rest show."""

import gzip
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaximu import InputError, NotPossibleError, calibrate, check
from jaximu.calibration.arrangement import axes_unlike
from jaximu.calibration.refusals import require_carried
from jaximu.cli import main
from jaximu.mistakes import inspect, prepare
from jaximu.recordings.alignment import carried
from jaximu.recordings.readers import ReadOptions, advise_reading, read_recording
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.segmentation import segment
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld, Static

HEAD = "ax [m/s^2],ay [m/s^2],az [m/s^2],gx [rad/s],gy [rad/s],gz [rad/s]"


def by_hand(seed=3, rate=50.0, poses=14, unit=None) -> Recording:
    return simulate(draw_imu(unit or seed), HandHeld(poses, 2.0, 1.0), consumer_noise(), rate=rate, seed=seed)[0]


def columns(recording) -> np.ndarray:
    """(n, 7) time, force, rate."""
    return np.column_stack([recording.accelerometer.time, recording.accelerometer.si(), recording.gyroscope.si()])


def lines(values, form="{:.6f}", sep=",") -> list[str]:
    return [sep.join(form.format(value) for value in row) for row in values]


def save(path, *rows: str):
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


def same(recording, values, atol=1e-4) -> None:
    """A recording holds the samples (n, 7)."""
    np.testing.assert_allclose(recording.accelerometer.si(), values[:, 1:4], atol=atol)
    np.testing.assert_allclose(recording.gyroscope.si(), values[:, 4:], atol=atol)
    np.testing.assert_allclose(recording.gyroscope.time, values[:, 0] - values[0, 0], atol=1e-3)


# --- whose row


def in_turn(folder, count=2, late=0.0, rate=50.0):
    """Rows of some units that moved together, with nothing that says whose a row is."""
    units = [columns(by_hand(seed=3, rate=rate, unit=number + 1)) for number in range(count)]
    for number, unit in enumerate(units):
        unit[:, 0] += number * late
    return save(folder / "log.csv", f"time [s],{HEAD}", *lines(np.stack(units, axis=1).reshape(-1, 7))), units


@pytest.mark.parametrize(("count", "late"), [(2, 0.0), (2, 0.01), (3, 0.005)])
def test_units_that_write_in_turn_without_an_id(tmp_path, count, late):
    path, units = in_turn(tmp_path, count, late)
    with pytest.raises(InputError, match=f"rows are of {count} units, which write in turn"):
        read_recording(path)
    for number, unit in enumerate(units, 1):
        same(read_recording(path, options=ReadOptions(device=str(number))), unit)
    with pytest.raises(InputError, match="units, which write in turn"):
        read_recording(path, options=ReadOptions(device=str(count + 1)))


@pytest.mark.parametrize("rate", [12.5, 25.0, 100.0, 400.0])
@pytest.mark.parametrize("coarse", [False, True])
def test_one_unit_is_not_called_several(tmp_path, rate, coarse):
    """At any rate, with coarse steps and without, by hand and at rest; held rows are none of another unit."""
    rest = simulate(draw_imu(2), Static(30.0), consumer_noise(), rate=rate, seed=2)[0]
    for number, (recording, steps) in enumerate(((by_hand(rate=rate, poses=6), 0.15), (rest, 1e-3))):
        values, steps = columns(recording), steps * coarse
        values[:, 1:] = np.round(values[:, 1:] / steps) * steps if steps else values[:, 1:]
        for held in (1, 2):
            rows = values[np.arange(len(values)) // held * held] if held > 1 else values
            rows = np.column_stack([values[:, 0], rows[:, 1:]])
            path = save(tmp_path / f"{number}{held}.csv", f"time [s],{HEAD}", *lines(rows))
            assert read_recording(path, options=ReadOptions(check=False)).reading.device is None


def test_devices_by_their_address(tmp_path):
    one, other = columns(by_hand()), columns(by_hand(unit=5))
    rows = [f"{row},{address}" for pair in zip(lines(one), lines(other), strict=True)
            for row, address in zip(pair, ("D4:22:CD:00:12:A1", "D4:22:CD:00:12:B7"), strict=True)]  # fmt: skip
    path = save(tmp_path / "log.csv", f"time [s],{HEAD},mac", *rows)
    with pytest.raises(InputError, match=r"choose one of them, D4:22:CD:00:12:A1, .* `jaximu array .* takes all"):
        read_recording(path)
    same(read_recording(path, options=ReadOptions(device="D4:22:CD:00:12:B7")), other)


def test_a_recording_that_is_given_twice():
    recording = by_hand()
    with pytest.raises(InputError, match="is the same recording as"):
        calibrate([recording, replace(recording)])


# --- clocks, names, layouts


@pytest.mark.parametrize(
    ("name", "stamps"),
    [
        ("Date", lambda time: 45413.5 + time / 86400),
        ("sec_of_day", lambda time: (86400 - 20 + time) % 86400),
        ("datenum", lambda time: 739312.5 + time / 86400),
        ("gps_sow", lambda time: 400000.0 + time),
        ("esp_timer_us", lambda time: np.round(time * 1e6)),
        ("time [min]", lambda time: time / 60),
    ],
)
def test_clocks_by_their_names(tmp_path, name, stamps):
    values = columns(by_hand())
    rows = [f"{stamp:.10f},{row}" for stamp, row in zip(stamps(values[:, 0]), lines(values[:, 1:]), strict=True)]
    path = save(tmp_path / "log.csv", f"{name},{HEAD}", *rows)
    try:
        recording = read_recording(path)
    except InputError:
        advice = advise_reading(path)
        assert advice.columns and "?" not in advice.line()
        recording = read_recording(path, options=ReadOptions(columns=advice.columns))
    same(recording, values)


def test_minutes_and_seconds_go_on_after_an_hour(tmp_path):
    values = columns(by_hand())
    stamps = [f"{int(s // 60) % 60:02d}:{s % 60:05.2f}" for s in np.round(values[:, 0] + 3590.0, 2)]
    rows = [f"{stamp},{row}" for stamp, row in zip(stamps, lines(values[:, 1:]), strict=True)]
    same(read_recording(save(tmp_path / "log.csv", f"Time,{HEAD}", *rows)), values)


def test_units_that_names_end_in(tmp_path):
    """mG is thousandths of g of an accelerometer, and of gauss of a magnetometer."""
    values = columns(by_hand())
    field = np.random.default_rng(1).normal(0, 300, (len(values), 3))
    names = ["time_s", *(f"acc{axis}_mG" for axis in "XYZ"), *(f"gyr{axis}_mdps" for axis in "XYZ"),
             *(f"mag{axis}_mG" for axis in "XYZ")]  # fmt: skip
    stated = np.column_stack([values[:, :1], values[:, 1:4] / 9.80665e-3, np.degrees(values[:, 4:]) * 1e3, field])
    recording = read_recording(save(tmp_path / "log.csv", ",".join(names), *lines(stated)))
    same(recording, values)
    np.testing.assert_allclose(recording.magnetometer.si(), field / 10, atol=1e-4)


def test_gzip(tmp_path):
    values = columns(by_hand())
    text = "\n".join([f"time [s],{HEAD}", *lines(values)])
    path = tmp_path / "log.csv.gz"
    path.write_bytes(gzip.compress(text.encode()))
    same(read_recording(path), values)
    path.write_bytes(gzip.compress(text.encode())[:-200])
    with pytest.raises(InputError, match="cut off or damaged"):
        read_recording(path)
    path.write_bytes(gzip.compress(bytes(300_000_000)))
    with pytest.raises(InputError, match="as no recording does"):
        read_recording(path)


def test_units_behind_the_values(tmp_path):
    values = columns(by_hand())
    rows = [",".join(f"{value:.6f}{unit}" for value, unit in zip(row, ["s"] + ["m/s^2"] * 3 + ["rad/s"] * 3,
                                                                 strict=True)) for row in values]  # fmt: skip
    same(read_recording(save(tmp_path / "log.csv", "time,ax,ay,az,gx,gy,gz", *rows)), values)


def test_a_rule_between_names_and_rows(tmp_path):
    values = columns(by_hand())
    head = " ".join(f"{name:>14}" for name in f"time[s],{HEAD}".replace(" [", "[").split(","))
    for rule in ("-" * len(head), "=" * 20, "--- | --- | ---"):
        same(read_recording(save(tmp_path / "log.txt", head, rule, *lines(values, "{:14.6f}", " "))), values)


def test_rows_in_brackets(tmp_path):
    values = columns(by_hand())
    rows = [f"({row})" for row in lines(values, sep=", ")]
    path = save(tmp_path / "log.txt", "soft reboot", *rows)
    advice = advise_reading(path)
    same(read_recording(path, options=ReadOptions(columns=advice.columns)), values)


# --- what turns from rest to rest show


def accelerated(recording, size, seed=0) -> Recording:
    """The recording with a hand's accelerations (m/s²) while it turns, which hide how gravity does."""
    random = np.random.default_rng(seed)
    signal, rate = recording.accelerometer, recording.gyroscope.si()
    moving = np.linalg.norm(rate - np.median(rate, axis=0), axis=1) > 0.2
    shaken = np.stack([np.convolve(axis, np.hanning(7) / 2, "same") for axis in random.normal(size=(3, len(signal)))])
    return replace(recording, accelerometer=replace(signal, values=signal.values + size * shaken.T * moving[:, None]))


def names_of(recording):
    return [finding.name for finding in inspect(recording)]


@pytest.mark.parametrize("size", [0.0, 2.0, 6.0])
def test_accelerations_on_the_way_make_no_other_device(size):
    for seed in range(3):
        recording = accelerated(by_hand(seed=seed + 1, rate=25.0, poses=16), size, seed)
        assert "data.mixed_devices" not in names_of(recording) and "data.range" not in names_of(recording)


@pytest.mark.parametrize("factor", [1 / 8, 5.0])
@pytest.mark.parametrize("size", [2.0, 6.0])
def test_a_wrong_scale_is_named_by_the_angles_from_rest_to_rest(factor, size):
    recording = accelerated(by_hand(rate=25.0, poses=16), size)
    gyroscope = recording.gyroscope
    recording = replace(recording, gyroscope=replace(gyroscope, values=gyroscope.values * factor))
    with pytest.raises(InputError, match=r"reads [\d.]+ times the (angles|rate)"):
        calibrate(recording)


@pytest.mark.parametrize(("style", "delimiter"), [(",.", ","), (",.", ";"), (".,", ";"), (".,", "\t")])
def test_signs_that_group_thousands_are_no_decimal_signs(style, delimiter, tmp_path):
    rows = columns(by_hand()) * [1e3, *3 * [1e3 / 9.80665], *3 * [1e3]]
    names = ["time [ms]", "ax [mg]", "ay [mg]", "az [mg]", "gx [mrad/s]", "gy [mrad/s]", "gz [mrad/s]"]
    texts = [[f"{value:,.1f}".translate(str.maketrans(",.", style)) for value in row] for row in rows]
    quote = '"' if delimiter == "," else ""
    written = [delimiter.join(f"{quote}{cell}{quote}" for cell in row) for row in [names, *texts]]
    log = save(tmp_path / "log.csv", *written)
    read = read_recording(log)
    np.testing.assert_allclose(read.accelerometer.si(), rows[:, 1:4] * 9.80665e-3, atol=1e-3)
    np.testing.assert_allclose(read.gyroscope.si(), rows[:, 4:] / 1e3, atol=1e-4)


@pytest.mark.parametrize(
    ("header", "cell", "words"),
    [
        ("time,", "T+{}h,", "Column 'time' holds 'T+0h': this was not understood as time"),
        ("time,", "5,", "Column 'time' does not rise: this was not understood as time"),
        ("", "", "The file has no time column"),
    ],
)
def test_a_time_column_that_is_not_understood_is_named(header, cell, words, tmp_path):
    rows = [cell.format(at) + line for at, line in enumerate(lines(columns(by_hand())[:, 1:]))]
    (question,) = advise_reading(save(tmp_path / "log.csv", header + HEAD, *rows)).questions
    assert words in question.text


@pytest.mark.parametrize("seed", range(4))
def test_free_motion_without_a_rest_is_of_one_device(seed):
    """Moved about by 5 m/s² while it turns: the calmest stretches are no rests."""
    random, time = np.random.default_rng(seed), np.arange(0.0, 120.0, 0.01)

    def sway(fastest):
        waves = 2 * np.pi * random.uniform(0.1, 1.0, (3, 5)) * fastest * time[:, None, None]
        return np.sin(waves + random.uniform(0, 2 * np.pi, (3, 5))).sum(axis=2)

    attitude = Rotation.from_euler("ZYX", sway(0.25) * [0.7, 0.35, 0.7])
    rate = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / 0.01
    force = attitude.inv().apply(3.0 * sway(1.0) + [0.0, 0.0, 9.81]) + 0.01 * random.normal(size=(len(time), 3))
    recording = Recording(Signal(time, force, "m/s^2"), Signal(time, np.vstack([rate, rate[-1:]]), "rad/s"))
    assert "data.mixed_devices" not in names_of(recording)


def test_the_gyroscope_of_another_recording_is_of_another_device():
    first, other = accelerated(by_hand(poses=16), 1.0), by_hand(seed=9, poses=16)
    count = min(len(first.gyroscope), len(other.gyroscope))
    mixed = replace(first, gyroscope=replace(other.gyroscope, values=other.gyroscope.values[:count],
                                             time=first.gyroscope.time[:count]))  # fmt: skip
    assert "data.mixed_devices" in names_of(mixed)


@pytest.mark.parametrize("arranged", [np.eye(3), np.diag([1.0, -1.0, -1.0]), np.roll(np.eye(3), 1, 0), -np.eye(3)])
def test_gravity_is_carried_in_any_arrangement(arranged):
    recording = by_hand(rate=25.0)
    force, rate = recording.accelerometer, recording.gyroscope
    quiet = np.linalg.norm(rate.si() - np.median(rate.si(), axis=0), axis=1) < 0.05
    edges = np.flatnonzero(np.diff(np.concatenate([[0], quiet.astype(int), [0]]))).reshape(-1, 2)
    rests = np.array([[rate.time[a], rate.time[b - 1]] for a, b in edges if b - a > 25])
    whole = carried(force.time, force.si(), rate.time, rate.si() @ arranged.T / 2, rests)
    assert whole.turns > 8 and whole.error < np.radians(10) and abs(whole.factor) == pytest.approx(2.0, rel=0.15)


def test_turns_that_no_gyroscope_explains_are_refused():
    require_carried(3.0, "log.csv")
    with pytest.raises(NotPossibleError, match=r"off by 99° \(rms\) after the fit.*scale or unit"):
        require_carried(99.0, "log.csv")


def test_a_check_names_axes_that_are_not_those_of_the_calibration():
    calibration = calibrate(by_hand(seed=4))
    other = by_hand(seed=6, unit=4)
    signal = other.accelerometer
    mirrored = replace(other, accelerometer=replace(signal, values=signal.values * [-1, 1, 1]))
    with pytest.raises(InputError, match=r"Against the calibration, .*its x axis has the wrong sign"):
        check(calibration, mirrored)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_check_and_compensate_name_a_log_of_the_opposite_signs(tmp_path, capsys, sign):
    """Turns look the same in both, and the biases "moved" by twice their size."""
    calibration, other = calibrate(by_hand(seed=4)), by_hand(seed=6, unit=4)
    turned = replace(other.accelerometer, values=sign * other.accelerometer.values)
    validity = check(calibration, replace(other, accelerometer=turned))
    assert any("all its signs turned round" in note for note in validity.notes) == (sign < 0)
    calibration.save(tmp_path / "calibration.json")
    values = columns(other) * [1, sign, sign, sign, 1, 1, 1]
    path = save(tmp_path / "log.csv", f"time [s],{HEAD}", *lines(values))
    assert main(["compensate", str(tmp_path / "calibration.json"), str(path), "-o", str(tmp_path / "out.csv")]) == 0
    printed = capsys.readouterr()
    assert ("all its signs turned round" in printed.out + printed.err) == (sign < 0)


@pytest.mark.parametrize(
    ("order", "words"),
    [
        ([0, 1, 2, 3, 4, 5, 6], ""),
        ([0, 1, 2, 3, 5, 4, 6], "gyroscope: its x and y axes are exchanged"),
        ([0, 3, 2, 1, 4, 5, 6], "axes are exchanged"),
    ],
)
def test_compensate_notes_axes_that_are_not_those_of_the_calibration(tmp_path, capsys, order, words):
    calibrate(by_hand(seed=4)).save(tmp_path / "calibration.json")
    values = columns(by_hand(seed=6, unit=4, rate=25.0))
    path = save(tmp_path / "log.csv", f"time [s],{HEAD}", *lines(values[:, order]))
    assert main(["compensate", str(tmp_path / "calibration.json"), str(path), "-o", str(tmp_path / "out.csv")]) == 0
    printed = capsys.readouterr()
    said = (printed.out + printed.err).partition("Against the calibration, ")[2]
    assert words in said and bool(said) == bool(words)
    assert "--axes" not in said  # which a calibration's reading refuses


def test_axes_are_compared_with_those_that_the_calibration_has():
    """A unit whose own accelerometer and gyroscope are in other axes is like itself in all of them."""
    recording, imu = by_hand(seed=4), draw_imu(4)
    for arranged in (np.diag([-1.0, 1.0, 1.0]), np.eye(3)[[1, 2, 0]], np.eye(3)[[1, 0, 2]]):
        force, rate = recording.accelerometer, recording.gyroscope
        turned = replace(recording, accelerometer=replace(force, values=force.values @ arranged.T))
        unit = replace(imu, accelerometer=replace(imu.accelerometer, gain=arranged @ imu.accelerometer.gain))
        assert axes_unlike(turned, unit) == "" != axes_unlike(turned, imu)
        swapped = replace(turned, gyroscope=replace(rate, values=rate.values[:, [0, 2, 1]]))
        assert "gyroscope: its y and z axes are exchanged" in axes_unlike(swapped, unit)


def test_a_page_of_exchanged_axes(tmp_path, capsys):
    """Their scales start from nothing: no share of it is stated."""
    values = columns(by_hand(rate=25.0, poses=12))[:, [0, 1, 2, 3, 5, 4, 6]]
    path = save(tmp_path / "log.csv", f"time [s],{HEAD}", *lines(values))
    assert main(["calibrate", str(path)]) == 0
    printed = capsys.readouterr().out
    assert printed.count("its axes are exchanged") == 6 and "its x and y axes are exchanged. --axes" in printed


# --- layouts, words and units


@pytest.mark.parametrize("sep", ["|", ";"])
@pytest.mark.parametrize(("unit", "size"), [("rev/s", 2 * np.pi), ("U/min", np.pi / 30), ("tr/min", np.pi / 30)])
def test_bars_between_cells_and_turns_in_a_time(tmp_path, sep, unit, size):
    values = columns(by_hand(rate=25.0, poses=6)) / [1, *[1] * 3, *[size] * 3]
    head = HEAD.replace("rad/s", unit).replace(",", sep)
    same(read_recording(save(tmp_path / "log.csv", f"time [s]{sep}{head}", *lines(values, "{:.7f}", sep))),
         values * [1, *[1] * 3, *[size] * 3])  # fmt: skip


@pytest.mark.parametrize("every", [1, 40, 10**6])
def test_a_header_that_is_repeated_between_rows(tmp_path, every):
    """An app that was started again, or files that were joined: also where the second header stands far behind."""
    values = columns(by_hand(rate=25.0, poses=6))
    head, rows = f"time [s],{HEAD}", lines(values)
    parts = [rows[at : at + every] for at in range(0, len(rows), every)] if every < len(rows) else [rows, []]
    recording = read_recording(save(tmp_path / "log.csv", *(line for part in parts for line in (head, *part))))
    same(recording, values)
    assert any(f"{len(parts) - 1} line" in note and "repeated the header" in note for note in recording.notes)


def test_vectors_in_brackets_whose_commas_do_not_part_cells(tmp_path):
    values = columns(by_hand(rate=25.0, poses=6))
    rows = [f"{row[0]:.4f};[{', '.join(f'{x:.6f}' for x in row[1:4])}];[{', '.join(f'{x:.6f}' for x in row[4:])}]"
            for row in values]  # fmt: skip
    same(read_recording(save(tmp_path / "log.csv", "time [s];accel [m/s^2];gyro [rad/s]", *rows)), values)


def test_a_stated_unit_goes_before_that_of_a_program_with_such_names(tmp_path):
    """ "X Accel" and "X Gyro" are names of MIP Monitor, which writes rad/s, and of anybody else."""
    values = columns(by_hand(rate=25.0, poses=6)) * [1, *[1 / 9.80665] * 3, *[np.degrees(1)] * 3]
    head = [f"{axis} {name}" for name in ("Accel (Gs)", "Gyro (degrees per second)") for axis in "XYZ"]
    recording = read_recording(save(tmp_path / "log.csv", ",".join(["Time (s)", *head]), *lines(values)))
    same(recording, values * [1, *[9.80665] * 3, *[np.radians(1)] * 3])


@pytest.mark.parametrize(
    ("force", "rate"),
    [("acelerómetro", "giroscopio"), ("accéléromètre", "gyromètre"), ("Beschleunigungssensor", "Drehratensensor"),
     ("加速度计", "陀螺仪")],
)  # fmt: skip
def test_rows_of_sensors_that_are_named_in_other_languages(tmp_path, force, rate):
    values = columns(by_hand(rate=25.0, poses=6))
    rows = [f"{row[0]:.4f},{name},{x:.6f},{y:.6f},{z:.6f}"
            for row in values for name, (x, y, z) in ((force, row[1:4]), (rate, row[4:]))]  # fmt: skip
    path = save(tmp_path / "log.csv", "time [s],sensor,x,y,z", *rows)
    advice = advise_reading(path)
    assert advice is not None and not advice.questions
    same(read_recording(path, options=ReadOptions(columns=advice.columns)), values)


# --- info


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_info_says_which_sign_it_takes_for_up(tmp_path, capsys, sign):
    """With all signs of the accelerometer turned round the calibration is as good: only the person knows."""
    values = columns(by_hand(rate=25.0, poses=12)) * [1, sign, sign, sign, 1, 1, 1]
    path = save(tmp_path / "log.csv", f"time [s],{HEAD}", *lines(values))
    rms = []
    for options in ([], ["--axes=-f"]):
        assert main(["info", str(path), "--json", *options]) == 0
        findings = json.loads(capsys.readouterr().out)["findings"]
        first = values[:20, 1:4].mean(axis=0) * (-1 if options else 1)
        axis = int(np.argmax(np.abs(first)))
        words = f"{'xyz'[axis]} points {'up' if first[axis] > 0 else 'down'}, as the accelerometer has it"
        assert any(words in text for text in findings)
        rms.append(calibrate(read_recording(path, options=ReadOptions(axes="-f" if options else None))).rms)
    assert rms[0]["gravity_direction"][1] == pytest.approx(rms[1]["gravity_direction"][1], rel=1e-3)


def test_info_of_a_gyroscope_alone(tmp_path, capsys):
    """At rest its noise can be identified; a table's steady turn is no rest."""
    time = np.arange(6000) / 50
    rate = 0.01 + np.random.default_rng(0).normal(0, 1e-3, (6000, 3))
    head = "time [s],gyro_x [rad/s],gyro_y [rad/s],gyro_z [rad/s]"
    rest = save(tmp_path / "rest.csv", head, *lines(np.column_stack([time, rate])))
    turning = save(tmp_path / "turning.csv", head, *lines(np.column_stack([time, rate + [0, 0, 1.6]])))
    assert main(["info", str(rest)]) == 0 and "jaximu allan" in capsys.readouterr().out
    assert main(["info", str(turning)]) == 0 and "jaximu allan" not in capsys.readouterr().out


def test_info_offers_no_calibration_from_three_poses(tmp_path, capsys):
    path = save(tmp_path / "log.csv", f"time [s],{HEAD}", *lines(columns(by_hand(poses=3))))
    assert main(["info", str(path)]) == 0
    printed = capsys.readouterr().out
    assert "jaximu calibrate" not in printed and "3 poses are too few" in printed


def test_info_reads_the_gyroscopes_offset_from_any_rest(tmp_path, capsys):
    """Of a vehicle that stops, level all the time, and turns steadily for longer than it stands."""
    time, random = np.arange(12000) / 50, np.random.default_rng(0)
    standing = time % 60 < 20
    rate = [0.01, -0.02, 0.005] + random.normal(0, 2e-3, (12000, 3))
    rate[:, 2] += np.where(standing, 0.0, 0.3)
    force = [0.3, 0, 9.8] + random.normal(0, 0.02, (12000, 3))
    log = save(tmp_path / "log.csv", f"time [s],{HEAD}", *lines(np.column_stack([time, force, rate])))
    assert main(["info", str(log), "--json"]) == 0
    (said,) = (text for text in json.loads(capsys.readouterr().out)["findings"] if "gyroscope reads" in text)
    read = re.findall(r"([xyz]) (−?[\d.]+) ± ([\d.]+) °/s", said)
    for (_, *value), truth in zip(read, np.degrees([0.01, -0.02, 0.005]), strict=True):
        middle, half = (float(text.replace("−", "-")) for text in value)
        assert abs(middle - truth) < 2 * half < 0.1


def test_sections_put_together_are_not_two_devices(tmp_path):
    """Where the turns were cut out, gravity jumps and the gyroscope rests: it says nothing of the two sensors."""
    values = columns(by_hand())
    within = values[:, 0] % 3.0  # rests of two seconds, turns of one
    rests = values[(within > 0.2) & (within < 1.8)][:, 1:]
    log = save(tmp_path / "log.csv", HEAD, *lines(rests))
    recording = read_recording(log, options=ReadOptions(rate=50.0))
    assert not {finding.name for finding in inspect(recording)} & {"data.mixed_devices", "data.range"}
    calibration, alone = calibrate(recording), calibrate(recording, method="accelerometer")
    assert any("their motion is not in the log" in note for note in calibration.notes)
    assert {name.owner for name in calibration.open_numbers} == {"gyroscope"}
    np.testing.assert_allclose(calibration.imu.accelerometer.gain, alone.imu.accelerometer.gain, atol=1e-4)
    whole = by_hand()
    gyroscope = replace(whole.gyroscope, values=whole.gyroscope.values / 5)  # one that reads a fifth turns all the same
    assert not segment(replace(whole, gyroscope=gyroscope)).torn


# --- other languages, and what stands between the rows


@pytest.mark.parametrize(
    ("names", "encoding"),
    [
        ("Tempo (s)|Accelerazione {} (m/s²)|Velocità angolare {} (rad/s)", "utf-8"),
        ("Время, с|Ускорение {}, м/с²|Угловая скорость {}, рад/с", "utf-8"),
        ("Время, с|Ускорение {}, м/с2|Угловая скорость {}, рад/с", "cp1251"),
        ("時間（s）|加速度{}（m/s2）|角速度{}（rad/s）", "shift_jis"),
        ("时间(s)|加速度{}(m/s^2)|角速度{}(rad/s)", "gb18030"),
        ("Tijd [s]|Versnelling {} [meter/second^2]|Hoeksnelheid {} [radians per second]", "utf-8"),
        ("time [s]|{}acc [m/s^2]|{}speed [rad/s]", "utf-8"),
        ("Zaman (sn)|İvme {} (m/sn²)|Açısal hız {} (derece/sn)", "utf-8"),
        ("Tempo (s)|Aceleração {} (m/s²)|Velocidade angular {} (rad/s)", "utf-8"),
    ],
)
def test_names_in_other_languages(tmp_path, names, encoding):
    """Names and units in brackets, wide brackets or behind a comma: nothing is asked."""
    values = columns(by_hand())
    time, force, rate = names.split("|")
    written = values * np.array([1.0] * 4 + [np.degrees(1.0) if "derece" in rate else 1.0] * 3)
    axes = ["roll", "pitch", "yaw"] if rate.startswith("{}s") else "XYZ"
    head = [time, *(force.format(axis) for axis in "XYZ"), *(rate.format(axis) for axis in axes)]
    text = "\n".join([";".join(head), *lines(written, sep=";")]) + "\n"
    (tmp_path / "log.csv").write_bytes(text.encode(encoding))
    same(read_recording(tmp_path / "log.csv"), values)


@pytest.mark.parametrize("last", ["Comment", "Remarks", "Comment,Marker"])
@pytest.mark.parametrize("sep", [",", ";", "\t"])
def test_a_column_of_comments_that_stays_empty(tmp_path, last, sep):
    """Its name is there and its cells are not; any other name too many is not counted off, and said."""
    values, head = columns(by_hand()), f"time [s],{HEAD}"
    path = save(tmp_path / "log.csv", f"{head},{last}".replace(",", sep), *lines(values, sep=sep))
    same(read_recording(path), values)
    for names in (f"Date,{head}", f"{head},status", head.replace("gx", "temp,gx")):
        path = save(tmp_path / "other.csv", names.replace(",", sep), *lines(values, sep=sep))
        with pytest.raises(InputError, match="has 8 names and the rows below it have 7 cells"):
            read_recording(path)


@pytest.mark.parametrize(("sep", "decimal"), [("\t", "."), ("\t", ","), (",", "."), (";", "."), (";", ",")])
def test_lines_of_keys_with_numbers_above_the_names(tmp_path, sep, decimal):
    """As LabVIEW writes them: one line gives the units, and lines below the names may be a summary."""
    values = columns(by_hand())
    keys = (("Samples", *[str(len(values))] * 6), ("Date", *["2024/03/01"] * 6),
            ("Y_Unit_Label", *["m/s^2"] * 3, *["rad/s"] * 3), ("X0", *["0.00E+0"] * 6),
            ("Delta_X", *["0.020000"] * 6))  # fmt: skip
    head = [
        "***End_of_Header***" + 7 * sep,
        sep.join([*"X_Value,Acc X,Acc Y,Acc Z,Gyr X,Gyr Y,Gyr Z".split(","), "Comment"]),
    ]
    rows = lines(values, sep=sep)
    above = [f"LabVIEW Measurement{sep}", f"Writer_Version{sep}2", "", f"Channels{sep}6{6 * sep}", *map(sep.join, keys)]
    path = save(tmp_path / "log.lvm", *(row.replace(".", decimal) for row in (*above, *head, *rows)))
    advice = advise_reading(path)
    assert advice.columns in (None, "time [s],accel [m/s^2],gyro [rad/s]") and not advice.questions
    same(read_recording(path, options=ReadOptions(columns=advice.columns)), values)
    summary = sep.join(["max", *["9.9"] * 6])
    path = save(tmp_path / "more.csv", f"time [s],{HEAD}".replace(",", sep), summary, *lines(values, sep=sep))
    same(read_recording(path), values)


@pytest.mark.parametrize(
    "names",
    [
        "axb [m/s^2],ayb [m/s^2],azb [m/s^2],p [rad/s],q [rad/s],r [rad/s]",
        "ax_b [m/s^2],ay_b [m/s^2],az_b [m/s^2],p_b [rad/s],q_b [rad/s],r_b [rad/s]",
        "accxraw [m/s^2],accyraw [m/s^2],acczraw [m/s^2],p_imu [rad/s],q_imu [rad/s],r_imu [rad/s]",
        "NxOut [m/s^2],NyOut [m/s^2],NzOut [m/s^2],p_filt [rad/s],q_filt [rad/s],r_filt [rad/s]",
    ],
)
def test_letters_of_axes_within_names(tmp_path, names):
    values = columns(by_hand())
    path = save(tmp_path / "log.csv", f"time [s],{names}", *lines(values))
    advice = advise_reading(path)
    assert not advice.questions and advice.columns in (None, "time [s],accel [m/s^2],gyro [rad/s]")
    same(read_recording(path, options=ReadOptions(columns=advice.columns)), values)


@pytest.mark.parametrize(
    ("order", "names"),
    [
        ((1, 2, 3), "Longitudinal,Lateral,Vertical"),
        ((2, 1, 3), "Lateral,Longitudinal,Vertical"),
        ((1, 2, 3), "forward,left,up"),
        ((1, 2, 3), "one,two,three"),
    ],
)
def test_the_only_columns_in_a_unit_of_acceleration_are_asked_about(tmp_path, order, names):
    """Which way they point is for the person to say: neither is there no accelerometer, nor is one assumed."""
    values = columns(by_hand())
    force = ",".join(f"{name} acceleration (m/s^2)" for name in names.split(","))
    rows = lines(values[:, [0, *order, 4, 5, 6]])
    path = save(tmp_path / "log.csv", f"time [s],{force},Roll rate (rad/s),Pitch rate (rad/s),Yaw rate (rad/s)", *rows)
    with pytest.raises(InputError, match=r"Are .* the accelerometer along x, y and z"):
        read_recording(path)
    advice = advise_reading(path)
    assert advice.accelerometer and "[?]" in advice.columns
    same(read_recording(path, options=ReadOptions(columns=advice.columns.replace("?", "m/s^2"))), values)


def test_set_points_are_no_rates(tmp_path):
    values = columns(by_hand())
    names = "time [s],ax [m/s^2],ay [m/s^2],az [m/s^2],p_cmd [rad/s],q_cmd [rad/s],r_cmd [rad/s]"
    assert read_recording(save(tmp_path / "log.csv", names, *lines(values))).gyroscope is None


def test_angles_are_no_rates(tmp_path):
    """A sensor's own angles have the shape of a gyroscope's output, and its sign changes."""
    values = columns(by_hand())
    head = "time [s],accX [m/s^2],accY [m/s^2],accZ [m/s^2],{0}X,{0}Y,{0}Z"
    for name in ("Angle", "gyroAngle", "Euler"):
        path = save(tmp_path / f"{name}.csv", head.format(name), *lines(values))
        assert read_recording(path).gyroscope is None, name


@pytest.mark.parametrize(
    ("where", "line", "gone"),
    [
        (None, "Recording stopped by user", 0),
        (300, "% marker set by user", 0),
        (300, "// marker", 0),
        (300, "; marker", 0),
        (None, ",0.1,0.2,9.8,0,0,0", 1),
        (300, "1.23,ERR,0.2,9.8,0,0,0", 1),
        (300, "1.23,0.1,0.2,9.8,--,--,--", 1),
    ],
)
def test_what_is_no_row_costs_itself(tmp_path, where, line, gone):
    values = columns(by_hand())
    rows = lines(values)
    rows.insert(len(rows) if where is None else where, line.replace("1.23", f"{values[299, 0] + 0.003:.3f}"))
    recording = read_recording(save(tmp_path / "log.csv", f"time [s],{HEAD}", *rows))
    assert len(values) <= max(len(recording.accelerometer), len(recording.gyroscope)) <= len(values) + 1
    assert min(len(recording.accelerometer), len(recording.gyroscope)) == len(values)
    if not line.startswith(("%", "//")):
        assert any("left out" in note or "no whole sample" in note for note in recording.notes)


@pytest.mark.parametrize(
    "end", ["End of recording\nTotal,{}\n", "Mean,1,2,3\nMax,4,5,6\n", "{:.2f},0.1,-", "{:.2f},0.1"]
)
def test_what_follows_the_last_row_costs_itself(tmp_path, end):
    """A summary, and a row that is cut off where the file ends; between rows, and with its end, it is refused."""
    values = columns(by_hand())
    text = "\n".join([f"time [s],{HEAD}", *lines(values), end.format(len(values))])
    (tmp_path / "log.csv").write_text(text)
    recording = read_recording(tmp_path / "log.csv")
    same(recording, values)
    assert any("left out" in note for note in recording.notes)
    (tmp_path / "log.csv").write_text(f"{text.rstrip()}\n{lines(values[-1:])[0]}\n")
    with pytest.raises(InputError, match="cells where the others hold 7"):
        read_recording(tmp_path / "log.csv")


@pytest.mark.parametrize("late", [0.1, 0.3, 0.5, 0.6, 0.9])
def test_two_runs_are_not_sorted_into_each_other(tmp_path, late):
    """Whatever part of a step the second run is late by."""
    values = columns(by_hand(poses=16))
    half = len(values) // 2
    values[half:, 0] += late * 0.02 - values[half, 0] + values[0, 0]
    path = save(tmp_path / "log.csv", f"time [s],{HEAD}", *lines(values))
    with pytest.raises(InputError, match=f"row {half + 2}: the clock goes back .* two recordings in one file"):
        read_recording(path)


def test_a_dead_magnetometer_among_rows_of_one_sensor_each(tmp_path):
    values = columns(by_hand())
    rows = []
    for number, (time, *six) in enumerate(values):
        rows += [f"{time:.4f},ACC,{six[0]},{six[1]},{six[2]}", f"{time + 0.001:.4f},GYR,{six[3]},{six[4]},{six[5]}"]
        rows += [f"{time + 0.002:.4f},MAG,20,-5,43"] * (number % 5 == 0)
    path = save(tmp_path / "log.csv", "time [s],sensor,x,y,z", *rows)
    options = ReadOptions(columns="time [s],accel [m/s^2],gyro [rad/s],mag [uT]")
    assert read_recording(path, options=options).magnetometer is None


def test_temperatures_that_are_errors_of_transfer():
    """One reading is held for some rows, as of a thermometer that is read once a second; the rest is what it was."""
    recording = by_hand(rate=50.0, poses=16)
    time = recording.accelerometer.time
    celsius = 20.0 + 0.0625 * np.round((np.floor(time) / 4.0) / 0.0625)
    wrong = np.isin(np.floor(time), (7.0, 21.0, 40.0))
    values = np.where(wrong, np.where(time > 30.0, 85.0, -127.0), celsius)
    logged = replace(recording, temperature=Signal(time, values[:, None], "degC"))
    ready = prepare(logged)
    assert any("temperature: 150 readings far from those before and after" in note for note in ready.notes)
    temperature = ready.recording.temperature
    np.testing.assert_allclose(temperature.values[:, 0], celsius[~wrong])
    clean = prepare(replace(recording, temperature=Signal(time, celsius[:, None], "degC")))
    assert not any("far from those" in note for note in clean.notes)


@pytest.mark.parametrize("spoil", ["free", "copied"])
def test_info_offers_nothing_that_a_finding_refuses(tmp_path, capsys, spoil):
    """Gravity taken out, or an axis that repeats another: what needs the sensor is not offered."""
    values = columns(by_hand(poses=12))
    if spoil == "copied":
        values[:, 2] = values[:, 1]
    else:
        values[:, 1:4] = 0.3 * np.sin(7 * values[:, :1] + [0, 1, 2]) * np.random.default_rng(0).random((len(values), 1))
    path = save(tmp_path / "log.csv", f"time [s],{HEAD}", *lines(values))
    assert main(["info", str(path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert {use["verb"] for use in document["uses"]} <= {"allan", "thermal", "magnetometer", "compensate"}
    (reason, *_) = document["refused"]
    assert main(["calibrate", str(path)]) != 0
    capsys.readouterr()
    assert main([str(path), "--yes"]) == 1
    assert reason.rstrip(".") in " ".join(capsys.readouterr().err.split()).replace("Accelerometer:", "accelerometer:")


def test_compensate_says_what_is_wrong_with_the_log(tmp_path, capsys):
    values = columns(by_hand(poses=14))
    save(tmp_path / "log.csv", f"time [s],{HEAD}", *lines(values))
    assert main(["calibrate", str(tmp_path / "log.csv"), "-o", str(tmp_path / "r")]) == 0
    values[:, 1:4] = np.clip(values[:, 1:4], -9.6, 9.6)
    save(tmp_path / "clipped.csv", f"time [s],{HEAD}", *lines(values))
    calibration = str(tmp_path / "r/calibration.json")
    for name in ("clipped", "log"):
        capsys.readouterr()
        command = ["compensate", calibration, str(tmp_path / f"{name}.csv"), "-o", str(tmp_path / "out.csv")]
        assert main(command) == 0
        assert ("its range is too small" in capsys.readouterr().err) is (name == "clipped")
