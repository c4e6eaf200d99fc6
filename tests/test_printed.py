"""Text as programs print it, and files whose names say what they are: read, or explained in a sentence."""

import json

import numpy as np
import pytest

from jaximu.calibration import calibrate_array, calibrate_turntable
from jaximu.cli import main
from jaximu.ground.errors import InputError
from jaximu.noise.analysis import analyse_noise
from jaximu.recordings.entry import ScheduleEntry
from jaximu.recordings.readers import ReadOptions, advise_reading, read_magnetometer, read_recording
from jaximu.recordings.recording import Recording, Signal
from jaximu.report.thermal import _share
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld

G = 9.80665
EPOCH = 1_700_000_000


@pytest.fixture(scope="module")
def made():
    """Times, specific force (m/s²) and rate (rad/s) of poses and turns at 50 Hz."""
    recording = simulate(draw_imu(6), HandHeld(12, 2.0), consumer_noise(), rate=50.0, seed=6)[0]
    return recording.accelerometer.time, recording.accelerometer.values, recording.gyroscope.values


def labelled(t, a, g):
    names = ("ax", "ay", "az", "gx", "gy", "gz")
    return [",".join(f"{name}:{v:.5f}" for name, v in zip(names, row, strict=True)) for row in np.hstack([a, g])]


def protocol(t, a, g):
    names = ("ax", "ay", "az", "gx", "gy", "gz")
    return [
        f"motion,room=lab,chip=icm42688 {','.join(f'{n}={v:.6f}' for n, v in zip(names, row, strict=True))} "
        f"{EPOCH * 10**9 + round(k * 1e9)}"
        for k, row in zip(t, np.hstack([a, g]), strict=True)
    ]


def sentences(t, a, g):
    lines = []
    for k in range(len(t)):
        lines += [
            f"t = {t[k]:.3f} s",
            f"Accel X: {a[k, 0]:.4f}, Y: {a[k, 1]:.4f}, Z: {a[k, 2]:.4f} m/s^2",
            f"Gyro X: {g[k, 0]:.5f}, Y: {g[k, 1]:.5f}, Z: {g[k, 2]:.5f} rad/s",
            "",
        ]
    return lines


def brackets(t, a, g):
    return [
        f"Acc=[{x[0]:.4f}, {x[1]:.4f}, {x[2]:.4f}] Gyr=[{w[0]:.5f}, {w[1]:.5f}, {w[2]:.5f}] t={round(1e6 * k)} us"
        for k, x, w in zip(t, a, g, strict=True)
    ]


def echoed(t, a, g):
    lines = []
    for k in range(len(t)):
        stamp = EPOCH * 10**9 + round(1e9 * t[k])
        lines += ["header:", "  stamp:", f"    sec: {stamp // 10**9}", f"    nanosec: {stamp % 10**9}"]
        lines += ["  frame_id: base"]
        for name, row in (("angular_velocity", g[k]), ("linear_acceleration", a[k])):
            lines += [f"{name}:", *(f"  {axis}: {v:.7f}" for axis, v in zip("xyz", row, strict=True))]
        lines += ["---"]
    return lines


def stamped(t, a, g):
    return [
        f"[{EPOCH + k:.6f}] $VNIMU,+0.1,+0.2,{0.3 + 0.01 * (i % 2):+.2f}," + ",".join(f"{v:+.6f}" for v in (*x, *w))
        + ",+25.0,+101.3*5F"
        for i, (k, x, w) in enumerate(zip(t, a, g, strict=True))
    ]  # fmt: skip


def monitor(t, a, g):
    return [
        f"09:{int(k // 60):02d}:{k % 60:06.3f} -> " + "\t".join(f"{v:.5f}" for v in (*x / G, *np.degrees(w)))
        for k, x, w in zip(t, a, g, strict=True)
    ]


def declared(t, a, g):
    lines = ["$FLYS,1", "$COL,BARO,time,pressure", "$UNIT,BARO,s,Pa", "$COL,IMU,time,wx,wy,wz,ax,ay,az,temperature",
             "$UNIT,IMU,s,deg/s,deg/s,deg/s,g,g,g,deg C", "$DATA"]  # fmt: skip
    for i, k in enumerate(t):
        lines += [f"$BARO,{k:.3f},101300"] if i % 10 == 0 else []
        lines.append(f"$IMU,{k:.3f}," + ",".join(f"{v:.6f}" for v in (*np.degrees(g[i]), *a[i] / G)) + ",24.5")
    return lines


def android(t, a, g):
    return [
        json.dumps({"type": f"android.sensor.{name}", "accuracy": 3, "timestamp": round(7e12 + 1e9 * t[k]),
                    "values": [round(float(v), 6) for v in values[k]]})
        for k in range(len(t)) for name, values in (("accelerometer", a), ("gyroscope", g))
    ]  # fmt: skip


def message_csv(t, a, g):
    none = ",".join(["0.0"] * 9)
    return [
        f"{EPOCH + int(k)},{round(k % 1 * 1e9)},base,0.0,0.0,0.0,1.0,{none},{','.join(f'{v:.7f}' for v in w)},{none},"
        f"{','.join(f'{v:.7f}' for v in x)},{none}"
        for k, x, w in zip(t, a, g, strict=True)
    ]


def decimal_commas(t, a, g):
    head = "Timestamp,Acc X (m/s²),Acc Y (m/s²),Acc Z (m/s²),Gyro X (rad/s),Gyro Y (rad/s),Gyro Z (rad/s)"
    rows = [
        f"02/05/2024 10:{int(k // 60):02d}:{k % 60:06.3f}," + ",".join(f'"{v:.5f}"'.replace(".", ",") for v in (*x, *w))
        for k, x, w in zip(t, a, g, strict=True)
    ]
    return [head, *rows]


def topic(prefix, between):
    def rows(t, a, g):
        names = [f"{prefix}angular_velocity{between}{axis}" for axis in "xyz"]
        names += [f"{prefix}linear_acceleration{between}{axis}" for axis in "xyz"]
        return [",".join(["__time", *names]), *(
            ",".join([f"{EPOCH + k:.6f}", *(f"{v:.6f}" for v in (*w, *x))]) for k, x, w in zip(t, a, g, strict=True)
        )]  # fmt: skip

    return rows


def rocket(t, a, g):
    names = [f"raw_acceleration_{axis}_gs" for axis in "xyz"] + [f"raw_gyro_{axis}_rads" for axis in "xyz"]
    return [",".join(["timestamp", *names]), *(
        ",".join([f"{k:.3f}", *(f"{v:.6f}" for v in (*x / G, *w))]) for k, x, w in zip(t, a, g, strict=True)
    )]  # fmt: skip


def german(t, a, g):
    names = [
        "Zeit [s]",
        *(f"Beschleunigung {axis} [m/s²]" for axis in "XYZ"),
        *(f"Drehrate {axis} [°/s]" for axis in "XYZ"),
    ]
    rows = [";".join(f"{v:.5f}" for v in (k, *x, *np.degrees(w), 24 + k / 50)) for k, x, w in zip(t, a, g, strict=True)]
    return [";".join([*names, "Temperatur [°C]"]), *(row.replace(".", ",") for row in rows)]


READ = {
    "sentences": (sentences, "log.txt"), "topic echo": (echoed, "log.txt"), "stamped NMEA": (stamped, "log.txt"),
    "declared rows": (declared, "log.csv"), "Android's records": (android, "log.jsonl"),
    "topic echo --csv": (message_csv, "log.csv"), "decimal commas": (decimal_commas, "log.csv"),
    "a topic before names": (topic("/imu/data/", "/"), "log.csv"),
    "names of a message": (topic("", "_"), "log.csv"), "German names": (german, "log.csv"),
}  # fmt: skip
ANSWERED = {
    "labels": (labelled, "log.txt", 50.0), "line protocol": (protocol, "log.txt", None),
    "brackets": (brackets, "log.txt", None), "serial monitor": (monitor, "log.txt", None),
    "units in names": (rocket, "log.csv", None),
}  # fmt: skip


def same(found: Recording, made) -> None:
    t, a, g = made
    for signal, values, tolerance in ((found.accelerometer, a, 2e-3), (found.gyroscope, g, 2e-4)):
        np.testing.assert_allclose(signal.si(), values[: len(signal)], atol=tolerance)
        assert len(signal) >= len(t) - 1
        np.testing.assert_allclose(signal.time, (t - t[0])[: len(signal)], atol=2e-3)


@pytest.mark.parametrize("kind", READ)
def test_what_says_it_all_is_read(made, tmp_path, kind):
    rows, name = READ[kind]
    (tmp_path / name).write_text("\n".join(rows(*made)) + "\n", encoding="utf-8")
    same(read_recording(tmp_path / name), made)


@pytest.mark.parametrize("kind", ANSWERED)
def test_what_lacks_units_is_answered_with_a_line_that_reads_it(made, tmp_path, kind):
    rows, name, rate = ANSWERED[kind]
    (tmp_path / name).write_text("\n".join(rows(*made)) + "\n")
    advice = advise_reading(tmp_path / name, rate)
    assert advice is not None and not advice.questions, advice.questions
    same(read_recording(tmp_path / name, options=ReadOptions(advice.columns, rate=rate)), made)


def test_a_refusal_says_what_reading_assumed(made, tmp_path, capsys):
    (tmp_path / "log.txt").write_text("\n".join(labelled(*made)) + "\n")
    assert main(["calibrate", str(tmp_path / "log.txt")]) == 2
    assert "Labels stand beside the numbers" in capsys.readouterr().err


def test_text_without_a_whole_sample_is_refused(tmp_path):
    (tmp_path / "log.txt").write_text("x: 1 y: 2 z: 3\n" * 4 + "nothing\n" * 2)
    with pytest.raises(InputError):
        read_recording(tmp_path / "log.txt")


def hexadecimal(a):
    return [" ".join(f"{int(v) & 0xFFFF:04X}" for v in (*row / G * 8192, -3900, 12, 7, -5)) for row in a]


def increments(a):
    return [f"%RAWIMUSA,2270,{k};2270,{k},00000077,{row[2]:.0f},{row[1]:.0f},{row[0]:.0f},1,2,3*1d5e2f3a"
            for k, row in enumerate(1e4 * a)]  # fmt: skip


def arrays(a):
    cells = ["|".join(f"{v:.3f}" for v in a[k : k + 25, 0]) for k in range(0, 500, 25)]
    return [
        "Type,Message,Field 1,Value 1,Units 1",
        *(f'Data,accelerometer_data,calibrated_accel_x,"{c}",g' for c in cells),
    ]


@pytest.mark.parametrize(
    ("rows", "words"), [(hexadecimal, "hexadecimal"), (increments, "RAWIMU"), (arrays, "vertical bars")]
)
def test_what_cannot_be_read_as_it_stands_is_explained(made, tmp_path, rows, words):
    (tmp_path / "log.csv").write_text("\n".join(rows(made[1])) + "\n")
    with pytest.raises(InputError, match=words):
        read_recording(tmp_path / "log.csv")


def written(path, names, *columns):
    rows = np.column_stack(columns)
    path.write_text("\n".join([",".join(names), *(",".join(f"{v:.6f}" for v in row) for row in rows)]) + "\n")
    return path


BOTH = [f"accel_{axis} [m/s^2]" for axis in "xyz"] + [f"gyro_{axis} [rad/s]" for axis in "xyz"]
RATES = [f"rotationRate_{axis} [rad/s]" for axis in "xyz"]


@pytest.mark.parametrize("together", [False, True])
def test_gravity_that_was_taken_out_is_said(made, tmp_path, capsys, together):
    t, a, g = made
    up = G * a / np.linalg.norm(a, axis=1, keepdims=True)
    names = ["time [s]", *(f"userAcceleration_{axis}" for axis in "xyz"), *RATES]
    parts = [t, a - up, g]
    if together:
        names, parts = [*names, *(f"gravity_{axis}" for axis in "xyz")], [*parts, up]
    main(["info", str(written(tmp_path / "log.csv", names, *parts))])
    said = " ".join(capsys.readouterr().out.split())
    assert ("their sum is what it measured" if together else "has gravity taken out") in said


def test_an_acceleration_that_is_called_linear_and_holds_gravity_is_the_accelerometer(made, tmp_path):
    names = ["time [s]", *(f"linearAcceleration_{axis} [m/s^2]" for axis in "xyz"), *RATES]
    log = written(tmp_path / "log.csv", names, *made)
    advice = advise_reading(log)
    assert (
        advice is not None and not advice.questions and any("gravity is in it" in reason for reason in advice.reasons)
    )
    same(read_recording(log, options=ReadOptions(advice.columns)), made)


def test_the_biases_of_an_estimated_state_are_no_sensors(made, tmp_path):
    t, a, g = made
    names = ["timestamp [s]", *(f"q_RS_{axis} []" for axis in "wxyz")]
    names += [f"b_w_RS_S_{axis} [rad s^-1]" for axis in "xyz"] + [f"b_a_RS_S_{axis} [m s^-2]" for axis in "xyz"]
    stood = np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1)) + 1e-5 * g[:, [0, 1, 2, 0]]
    advice = advise_reading(written(tmp_path / "state.csv", names, t, stood, 1e-3 * g, 1e-3 * a))
    assert advice is not None and "trajectory" in advice.questions[0].text and not advice.accelerometer


def test_an_attitude_beside_sensors_is_kept(made, tmp_path):
    t, a, g = made
    names = ["time", *(f"{stem}_{axis}" for stem in "aw" for axis in "xyz"), *(f"q_{axis}" for axis in "wxyz")]
    angle = 0.1 * np.sin(t)[:, None]
    stood = np.hstack([np.cos(angle), np.sin(angle), 0 * angle, 0 * angle])
    log = written(tmp_path / "log.csv", names, t, a, g, stood)
    advice = advise_reading(log)
    assert advice is not None and not advice.questions
    assert read_recording(log, options=ReadOptions(advice.columns)).attitude is not None


def test_a_steady_turn_does_not_decide_the_unit(tmp_path):
    random, t = np.random.default_rng(3), np.arange(0, 60, 0.02)
    a = [0.2, 0.1, 9.8] + 0.02 * random.normal(size=(len(t), 3))
    g = np.outer(0.8 + 0.1 * np.sin(0.5 * t), [0, 0, 1]) + 0.001 * random.normal(size=(len(t), 3))
    names = ["time", *(f"a{axis}" for axis in "xyz"), *(f"g{axis}" for axis in "xyz")]
    advice = advise_reading(written(tmp_path / "log.csv", names, t, a, g))
    assert advice is not None and "gyro [?]" in (advice.columns or "")
    asked = [question for question in advice.questions if "deg/s or rad/s" in question.text]
    assert [(one.option, one.blank, one.default) for one in asked] == [("columns", "gyro [?]", "rad/s")]


def test_a_hot_sensor_is_a_temperature_and_counts_are_said(made, tmp_path):
    t, a, g = made
    names = ["time [s]", *BOTH, "temp"]
    hot = advise_reading(written(tmp_path / "hot.csv", names, t, a, g, 60 + 20 * t / t[-1]))
    assert hot is not None and "temperature [degC]" in (hot.columns or "")
    chip = advise_reading(written(tmp_path / "chip.csv", names, t, a, g, np.round(-3000 + t)))
    assert chip is not None and any("no temperature in °C" in reason for reason in chip.reasons)
    columns = chip.columns or ""
    assert columns.endswith("temperature [count]")
    log = tmp_path / "chip.csv"
    counted = read_recording(log, options=ReadOptions(columns))
    assert counted.temperature is None and any("in counts" in note for note in counted.notes)
    celsius = read_recording(log, options=ReadOptions(columns.replace("count]", "count/340 + 36.53]")))
    assert celsius.temperature is not None
    np.testing.assert_allclose(celsius.temperature.values[:, 0], np.round(-3000 + t) / 340 + 36.53)


def test_a_rate_that_was_given_is_not_asked_for(made, tmp_path, capsys):
    log = written(tmp_path / "gyro.csv", ["gyro_x", "gyro_y", "gyro_z"], np.degrees(made[2]))
    main(["info", str(log), "--rate", "50"])
    said = "".join(capsys.readouterr())
    assert "--rate ?" not in said and "turntable" in said


def test_an_accelerometer_alone_is_not_sent_to_a_diagnosis(made, tmp_path, capsys):
    log = written(tmp_path / "log.csv", ["time [s]", *(f"accel_{axis} [m/s^2]" for axis in "xyz")], *made[:2])
    assert main(["info", str(log)]) == 0
    said = capsys.readouterr().out
    assert "jaximu calibrate" in said and "jaximu diagnose" not in said and "jaximu check" not in said


def test_a_magnetometer_needs_no_clock(tmp_path):
    random = np.random.default_rng(1)
    up = random.normal(size=(900, 3))
    field = np.round(300 * up / np.linalg.norm(up, axis=1, keepdims=True) + [100, -50, 20])
    log = written(tmp_path / "mag.csv", ["mag_x [count]", "mag_y [count]", "mag_z [count]"], field)
    signal, _, _ = read_magnetometer(log)
    np.testing.assert_array_equal(signal.values, field)
    bare = tmp_path / "bare.txt"
    np.savetxt(bare, field, "%d")
    advice = advise_reading(bare)
    assert advice is not None and "jaximu magnetometer" in advice.questions[0].text


def test_a_magnetometer_that_never_changes_costs_itself(made, tmp_path):
    names = ["time [s]", *BOTH, *(f"mag_{axis} [uT]" for axis in "xyz")]
    log = written(tmp_path / "log.csv", names, *made, np.full((len(made[0]), 3), 7.0))
    recording = read_recording(log)
    assert recording.magnetometer is None and any("never changes" in note for note in recording.notes)
    with pytest.raises(InputError, match="never changes"):
        read_magnetometer(log)


def test_one_column_is_too_few(tmp_path):
    np.savetxt(tmp_path / "log.txt", np.random.default_rng(0).normal(size=50))
    with pytest.raises(InputError, match="one column of numbers"):
        read_recording(tmp_path / "log.txt")


def test_a_table_of_means_is_not_too_short(tmp_path, capsys):
    faces = np.vstack([np.eye(3), -np.eye(3)]) * G + 0.05
    log = written(tmp_path / "means.csv", [f"accel_{axis} [m/s^2]" for axis in "xyz"], faces)
    main(["info", str(log)])
    said = capsys.readouterr().out
    assert "jaximu calibrate --means" in said and "too short" not in said


def test_a_file_given_twice_is_no_array(made, tmp_path):
    names = ["time [s]", *BOTH]
    log = read_recording(written(tmp_path / "log.csv", names, *made))
    with pytest.raises(InputError, match="given twice"):
        calibrate_array([log, log])


def test_what_follows_the_temperature_is_said_beside_the_noise():
    random, t = np.random.default_rng(2), np.arange(0, 900, 0.05)
    warm = 25 + 15 * (1 - np.exp(-t / 300))
    force = [0.0, 0.0, G] + 2e-3 * random.normal(size=(len(t), 3)) + np.outer(warm, [2e-3, -1e-3, 3e-3])
    rate = 1e-4 * random.normal(size=(len(t), 3))
    signals = Signal(t, force, "m/s^2"), Signal(t, rate, "rad/s")
    notes = " ".join(analyse_noise(Recording(*signals, temperature=Signal(t, warm[:, None], "degC"))).notes)
    assert "slow in the accelerometer follows it" in notes and "slow in the gyroscope" not in notes


def test_a_unit_that_sits_turned_in_its_fixture_is_said():
    from scipy.spatial.transform import Rotation

    faces, random = np.vstack([np.eye(3), -np.eye(3)]), np.random.default_rng(4)
    seat = Rotation.from_rotvec([0.5, 0.0, 1.5], degrees=True)
    time = np.arange(0, 60, 0.02)
    force = G * seat.apply(faces[np.minimum((time / 10).astype(int), 5)]) + 2e-3 * random.normal(size=(len(time), 3))
    recording = Recording(Signal(time, force, "m/s^2"))
    entries = [ScheduleEntry(10.0 * k + 1, 10.0 * k + 9, "pose", face) for k, face in enumerate(faces)]
    notes = " ".join(calibrate_turntable(recording, entries).notes)
    assert "turned as a whole by 1.6°" in notes
    assert "turned as a whole" not in " ".join(calibrate_turntable(
        Recording(Signal(time, seat.inv().apply(force), "m/s^2")), entries).notes)  # fmt: skip


def test_stops_in_one_orientation_are_no_poses(tmp_path, capsys):
    """A vehicle that stops: its rests are all level, and nothing is offered that would be refused."""
    random, t = np.random.default_rng(7), np.arange(0, 240, 0.02)
    moving = (t % 24 > 10)[:, None]
    a = [0.1, 0.0, G] + 0.02 * random.normal(size=(len(t), 3)) + 1.5 * moving * np.sin(2 * t)[:, None] * [1.0, 0.2, 0.0]
    g = 0.002 * random.normal(size=(len(t), 3)) + 0.4 * moving * np.sin(0.9 * t)[:, None] * [0.0, 0.0, 1.0]
    main(["info", str(written(tmp_path / "log.csv", ["time [s]", *BOTH], t, a, g))])
    said = " ".join(capsys.readouterr().out.split())
    assert "poses are of one orientation" in said and "jaximu calibrate" not in said and "and the turns" not in said


def test_two_poses_of_one_orientation_are_both(tmp_path, capsys):
    random, t = np.random.default_rng(7), np.arange(0, 60, 0.02)
    moving = ((t > 20) & (t < 35))[:, None]
    a = [0.1, 0.0, G] + 0.02 * random.normal(size=(len(t), 3)) + 3 * moving * np.sin(2 * t)[:, None] * [1.0, 0.2, 0.0]
    g = 0.002 * random.normal(size=(len(t), 3)) + 0.4 * moving * np.sin(0.9 * t)[:, None] * [1.0, 1.0, 1.0]
    main(["info", str(written(tmp_path / "log.csv", ["time [s]", *BOTH], t, a, g))])
    assert "Both poses are of one orientation" in " ".join(capsys.readouterr().out.split())


def test_a_whole_share_is_a_hundred_percent():
    assert [_share(share) for share in (1.0, 0.996, 0.034)] == ["100 %", "100 %", "3.4 %"]
