"""Bags, flight logs and other programs' tables: the samples come back, choices are asked for, and defects are told."""

import builtins
import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sample_logs import (
    FORMATS,
    IMU,
    RATE,
    RAW,
    ROWS,
    START,
    imu_message,
    imu_messages,
    message_types,
    samples,
    write_bag,
    write_dataflash,
    write_ulog,
)

from jaximu.cli import main
from jaximu.ground.errors import InputError
from jaximu.mistakes import inspect
from jaximu.recordings.readers import ReadOptions, read_recording
from jaximu.recordings.recording import Recording

AS_IS = ReadOptions(check=False)
SINGLE = {"ulog", "dataflash"}  # formats that keep single precision


def read(path: Path, **options) -> Recording:
    return read_recording(path, options=replace(AS_IS, **options))


def gyroscope(recording: Recording) -> np.ndarray:
    assert recording.gyroscope is not None
    return recording.gyroscope.values


def said(recording: Recording, text: str) -> bool:
    return any(text in note for note in recording.notes)


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("logs")
    return {name: write(folder / name.replace(" ", "_")) for name, write in FORMATS.items()}


@pytest.mark.parametrize("name", FORMATS)
def test_the_samples_come_back(files, name, tmp_path):
    """In every format, whatever the file is called."""
    renamed = tmp_path / "log.bin"
    renamed.symlink_to(files[name])
    for path in (files[name], renamed):
        recording = read(path)
        _, force, rate = samples()
        tolerance = {"rtol": 1e-6, "atol": 1e-6} if name in SINGLE else {"rtol": 1e-15}
        np.testing.assert_allclose(recording.accelerometer.values, force, **tolerance)
        np.testing.assert_allclose(gyroscope(recording), rate, **tolerance)
        assert recording.accelerometer.rate == pytest.approx(RATE, rel=1e-6)
        assert recording.accelerometer.time[0] == 0.0
        np.testing.assert_allclose(np.diff(recording.accelerometer.time), 1 / RATE, atol=1e-9)
        (source,) = recording.sources
        assert source.rows == ROWS and len(source.sha256) == 64


@pytest.mark.parametrize("compression", ["", "message", "file"])
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_that_is_a_folder(tmp_path, storage, compression):
    path = write_bag(tmp_path / "bag", imu_messages(2), storage=storage, compression=compression)
    recording = read(path)
    np.testing.assert_array_equal(recording.accelerometer.values, samples()[1])
    assert recording.start == START / 1e9
    assert len(recording.sources[0].sha256) == 64


@pytest.mark.parametrize("version", [1, 2])
def test_stamps_of_a_bag(tmp_path, version):
    """The header's stamps unless the logger's are asked for; how late the messages came is told."""
    messages = imu_messages(version)
    generator = np.random.default_rng(2)
    delays = generator.integers(1_000_000, 3_000_000, len(messages))
    messages = [(a, b, c + int(d), m) for (a, b, c, m), d in zip(messages, delays, strict=True)]
    path = write_bag(tmp_path / "bag", messages, version)
    recording = read(path)
    assert recording.start == START / 1e9
    assert said(recording, "time is the header stamp") and said(recording, f"{(2e6 + np.median(delays)) / 1e6:.3g} ms")
    received = read(path, stamp="receive")
    stamps = np.array([received for _, _, received, _ in messages])
    np.testing.assert_allclose(received.accelerometer.time, (stamps - stamps[0]) / 1e9, atol=1e-9)
    assert said(received, "receive stamp")
    with pytest.raises(InputError, match="stamp"):
        read(path, stamp="arrival")


def test_header_stamps_that_are_empty(tmp_path):
    types = message_types(2)
    messages = [(a, b, c, imu_message(types, 2, 0, [0, 0, 9.8 + i % 3], [i % 2, 0.1 * (i % 3), i % 5]))
                for i, (a, b, c, _) in enumerate(imu_messages(2))]  # fmt: skip
    for at, message in enumerate(messages):
        message[3].linear_acceleration.x, message[3].linear_acceleration.y = float(at % 2), float(at % 3)
    recording = read(write_bag(tmp_path / "bag", messages))
    assert recording.accelerometer.rate == pytest.approx(RATE)
    assert said(recording, "header stamps are all the same")


def test_several_topics_are_listed(tmp_path):
    path = write_bag(tmp_path / "bag", imu_messages(2, "/a/imu") + imu_messages(2, "/b/imu"))
    with pytest.raises(InputError, match=r"/a/imu \(400 messages\), /b/imu \(400 .*: choose one with .*topic"):
        read(path)
    assert len(read(path, topic="/b/imu").accelerometer) == ROWS
    with pytest.raises(InputError, match="has no IMU topic /c"):
        read(path, topic="/c")


@pytest.mark.parametrize("topic", [None, "/camera/accel/sample,/camera/gyro/sample"])
def test_realsense_bag(tmp_path, topic):
    """Accelerometer and gyroscope as two topics of sensor_msgs/Imu, each with its own stamps."""
    types = message_types(1)
    kind, messages = "sensor_msgs/msg/Imu", []
    for stamp, force, rate in zip(*samples(), strict=True):
        at = int(stamp)
        messages.append(("/camera/accel/sample", kind, at, imu_message(types, 1, at, force, [0] * 3)))
        messages.append(("/camera/gyro/sample", kind, at + 10**6, imu_message(types, 1, at + 10**6, [0] * 3, rate)))
    recording = read(write_bag(tmp_path / "bag", messages, 1), topic=topic)
    np.testing.assert_array_equal(recording.accelerometer.values, samples()[1])
    np.testing.assert_array_equal(gyroscope(recording), samples()[2])
    assert recording.gyroscope is not None
    assert recording.gyroscope.time[0] == pytest.approx(1e-3)
    assert said(recording, "separate time stamps")


def test_what_a_message_does_not_hold(tmp_path):
    """A covariance that begins with -1 says that the quantity is not there."""
    recording = read(write_bag(tmp_path / "bag", imu_messages(2, absent="gyro")))
    assert recording.gyroscope is None


def test_temperature_and_field_beside_the_imu(tmp_path):
    types = message_types(2)
    messages = imu_messages(2, "/imu/data")
    for at, (_, _, received, message) in enumerate(messages[::10]):
        temperature = types["sensor_msgs/msg/Temperature"](header=message.header, temperature=20.0 + at, variance=0.0)
        field = types["sensor_msgs/msg/MagneticField"](
            header=message.header,
            magnetic_field=types["geometry_msgs/msg/Vector3"](2e-5, 1e-6 * at, -4e-5 - 1e-7 * at),
            magnetic_field_covariance=np.zeros(9),
        )  # fmt: skip
        field.magnetic_field.x += 1e-7 * (at % 4)
        messages += [("/imu/temperature", "sensor_msgs/msg/Temperature", received, temperature),
                     ("/imu/mag", "sensor_msgs/msg/MagneticField", received, field)]  # fmt: skip
    recording = read(write_bag(tmp_path / "bag", sorted(messages, key=lambda each: each[2])))
    assert recording.temperature is not None and recording.magnetometer is not None
    assert recording.temperature.values[:3, 0].tolist() == [20, 21, 22]
    assert recording.magnetometer.values[2, 1] == pytest.approx(2.0)
    assert recording.temperature.rate == pytest.approx(RATE / 10)


def test_a_bag_without_an_imu(tmp_path):
    types = message_types(2)
    header = imu_messages(2, rows=1)[0][3].header
    message = types["sensor_msgs/msg/Temperature"](header=header, temperature=20.0, variance=0.0)
    path = write_bag(tmp_path / "bag", [("/t", "sensor_msgs/msg/Temperature", START, message)])
    with pytest.raises(InputError, match="holds no sensor_msgs/Imu; it holds sensor_msgs/Temperature"):
        read(path)


# --- order, repeats, gaps


def shuffled(messages: list, at: int) -> list:
    messages[at], messages[at + 1] = messages[at + 1], messages[at]
    return [(a, b, START + 10**6 * i, m) for i, (a, b, _, m) in enumerate(messages)]


def test_disorder_and_repeats_are_told_and_put_right(tmp_path):
    messages = imu_messages(2)
    messages.insert(21, messages[20])
    recording = read(write_bag(tmp_path / "bag", shuffled(messages, 100)))
    np.testing.assert_array_equal(recording.accelerometer.values, samples()[1])
    assert said(recording, "1 messages came out of order, by up to 5 ms")
    assert said(recording, "1 messages repeat the stamp of another")
    for each in (recording, pickle.loads(pickle.dumps(recording))):
        assert [finding.name for finding in inspect(each)] == ["data.order", "data.duplicate"]
    (note,) = [each for each in inspect(recording) if each.name == "data.order"]
    assert "sorted by their stamps" in note.text


def test_a_clock_that_was_set_back(tmp_path):
    messages = imu_messages(2)
    for _, _, _, message in messages[200:]:
        message.header.stamp.sec -= 60
    path = write_bag(tmp_path / "bag", messages)
    with pytest.raises(InputError, match=r"message 201: the clock goes back, by up to 59.995 s"):
        read(path)
    assert len(read(path, stamp="receive").accelerometer) == ROWS


def test_stamps_shared_by_a_batch(tmp_path):
    messages = imu_messages(2)
    for at, (_, _, _, message) in enumerate(messages):
        message.header.stamp.nanosec = at // 10 * 50_000_000 % 10**9
        message.header.stamp.sec = START // 10**9 + at // 200
    path = write_bag(tmp_path / "bag", messages)
    with pytest.raises(InputError, match="360 of 400 messages share the stamp"):
        read(path)


def test_gaps_are_findings_of_info(tmp_path, capsys):
    messages = imu_messages(2)
    del messages[150:190]
    path = write_bag(tmp_path / "bag", messages)
    assert main(["info", str(path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert any("1 gap, 40 samples missing" in each for each in document["findings"])
    assert document["signals"]["accelerometer"]["longest_gap"] == pytest.approx(41 / RATE)


# --- flight logs


def test_px4_raw_sensors(files):
    recording = read(files["ulog"])
    assert recording.gyroscope is not None and recording.temperature is not None
    assert recording.gyroscope.time[0] == pytest.approx(1e-3)
    assert recording.start == 1.0
    assert recording.temperature.values[0, 0] == 31.5
    assert said(recording, "forward, right, down") and said(recording, "read: sensor_accel")
    assert read(files["ulog"], stamp="receive").start == 1.0003


def test_px4_chooses_the_dense_message_and_lists_the_others(tmp_path):
    combined = [("uint64_t", "timestamp"), ("float[3]", "gyro_rad"), ("int32_t", "accelerometer_timestamp_relative"),
                ("float[3]", "accelerometer_m_s2")]  # fmt: skip
    delta = [("uint64_t", "timestamp"), ("float[3]", "delta_angle"), ("float[3]", "delta_velocity"),
             ("uint16_t", "delta_angle_dt"), ("uint16_t", "delta_velocity_dt")]  # fmt: skip
    rows, (_, force, rate) = [], samples()
    for at in range(ROWS):
        stamp = 10**6 + at * 5000
        rows.append(("sensor_combined", 0, (stamp, *rate[at], 2**31 - 1 if at == 7 else -400, *force[at])))
        if at % 40 == 0:
            rows += [("sensor_accel", place, (stamp, stamp, *force[at], 30.0)) for place in (0, 1)]
            rows += [("sensor_gyro", place, (stamp, stamp, *rate[at], 30.0)) for place in (0, 1)]
        if at % 2 == 0:
            rows.append(("vehicle_imu", 0, (stamp, *rate[at] * 0.008, *force[at] * 0.01, 8000, 10000)))
    formats = {"sensor_combined": combined, "sensor_accel": RAW, "sensor_gyro": RAW, "vehicle_imu": delta}
    path = write_ulog(tmp_path / "log.ulg", formats, rows)
    recording = read(path)
    assert recording.gyroscope is not None
    assert len(recording.gyroscope) == ROWS and len(recording.accelerometer) == ROWS - 1
    assert recording.gyroscope.time[0] - recording.accelerometer.time[0] == pytest.approx(4e-4)
    assert said(recording, "there are also sensor_accel (10 samples), vehicle_imu (200 samples)")
    assert said(recording, "instances 0, 1 (--instance)")
    mean = read(path, topic="vehicle_imu")
    np.testing.assert_allclose(mean.accelerometer.values, force[::2], rtol=1e-5)
    np.testing.assert_allclose(gyroscope(mean), rate[::2], rtol=1e-5)
    assert len(read(path, instance=1).accelerometer) == 10
    with pytest.raises(InputError, match="sensor_mag: there are sensor_accel, sensor_combined, vehicle_imu"):
        read(path, topic="sensor_mag")
    with pytest.raises(InputError, match=r"of instance 4 \(instances 0, 1\)"):
        read(path, instance=4)


@pytest.mark.parametrize("older", [False, True])
def test_px4_every_sample_of_the_fifos(tmp_path, older):
    """Four samples a message, the last at its stamp; versions that wrote no scale leave the averages to be read."""
    time, force, rate = samples()
    at = (time - START) // 1000 + 10**6
    scales, rows = {"accel": 2.0**-11, "gyro": 2.0**-18}, []
    for last in range(3, ROWS, 4):
        for name, values in (("accel", force), ("gyro", rate)):
            block = np.rint(values[last - 3 : last + 1] / scales[name]).astype(int)
            filled = [each for axis in block.T for each in (*axis, *[77] * 28)]
            scale = () if older else (scales[name],)
            rows.append((f"sensor_{name}_fifo", 0, (at[last] + 200, at[last], 5000.0, *scale, 4, *filled)))
            rows.append((f"sensor_{name}", 0, (at[last] + 200, at[last], *values[last - 3 : last + 1].mean(0), 30.0)))
    fifo = [("uint64_t", "timestamp"), ("uint64_t", "timestamp_sample"), ("float", "dt"), ("float", "scale"),
            ("uint8_t", "samples"), *(("int16_t[32]", axis) for axis in "xyz")]  # fmt: skip
    fifo = [each for each in fifo if not older or each[1] != "scale"]
    formats = {f"sensor_{name}_fifo": fifo for name in scales} | {f"sensor_{name}": RAW for name in scales}
    recording = read(write_ulog(tmp_path / "log.ulg", formats, rows))
    if older:
        assert len(recording.accelerometer) == ROWS // 4
        return
    assert said(recording, "sensor_accel_fifo") and said(recording, f"sensor_accel ({ROWS // 4} samples)")
    np.testing.assert_allclose(recording.accelerometer.values, force, atol=scales["accel"] / 2 + 1e-9)
    np.testing.assert_allclose(gyroscope(recording), rate, atol=scales["gyro"] / 2 + 1e-9)
    np.testing.assert_allclose(recording.accelerometer.time, (time - START) / 1e9, atol=1e-9)
    assert recording.temperature is not None


def test_ardupilot_instances(files):
    assert said(read(files["dataflash"]), "instance 0 of 0, 1")
    second = read(files["dataflash"], instance=1)
    np.testing.assert_allclose(second.accelerometer.values, -samples()[1], rtol=1e-6)
    assert second.temperature is not None and second.temperature.values[0, 0] == 41.5
    with pytest.raises(InputError, match=r"of instance 2; there are instances 0, 1"):
        read(files["dataflash"], instance=2)


def test_ardupilot_raw_samples(tmp_path):
    """ACC and GYR of older and newer logs; the denser is read, the temperature comes from IMU."""
    rows, (_, force, rate) = [], samples()
    for at in range(ROWS):
        stamp = 10**6 + at * 5000
        rows += [("ACC1", (stamp + 90, stamp, *force[at])), ("GYR1", (stamp + 90, stamp + 10, *rate[at]))]
        if at % 10 == 0:
            rows.append(("IMU", (stamp, 0, *rate[at], *force[at], 35.0)))
    formats = {"ACC1": ("QQfff", "TimeUS,SampleUS,AccX,AccY,AccZ"), "GYR1": ("QQfff", "TimeUS,SampleUS,GyrX,GyrY,GyrZ"),
               "IMU": IMU}  # fmt: skip
    path = write_dataflash(tmp_path / "log.bin", formats, rows)
    recording = read(path)
    assert recording.gyroscope is not None and recording.temperature is not None
    assert len(recording.accelerometer) == ROWS and recording.start == 1.0
    assert recording.gyroscope.time[0] == pytest.approx(1e-5)
    assert len(recording.temperature) == 40
    late = read(path, stamp="receive")
    assert late.accelerometer.time[0] == pytest.approx(90e-6)  # the temperature's first stamp is t = 0
    sparse = read(path, topic="imu")
    assert len(sparse.accelerometer) == 40 and said(sparse, "--topic ACC")


def test_ardupilot_text_form(tmp_path):
    lines = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns", f"FMT, 140, 56, IMU, {IMU[0]}, {IMU[1]}"]
    for stamp, force, rate in zip(*samples(), strict=True):
        at = int(stamp - START) // 1000 + 10**6
        lines.append(f"IMU, {at}, 0, " + ", ".join(f"{value:.9f}" for value in (*rate, *force)) + ", 40.25")
    path = tmp_path / "log.log"
    path.write_text("\n".join(lines) + "\n")
    np.testing.assert_allclose(read(path).accelerometer.values, samples()[1], atol=1e-8)


# --- tables of other programs


def test_attitude_of_broad(files):
    recording = read(files["broad"])
    assert recording.attitude is not None and recording.magnetometer is not None
    assert len(recording.attitude) == ROWS - 10
    assert said(recording, "the BROAD data set") and said(recording, "10 of 400 rows hold no whole sample")


@pytest.mark.parametrize(("name", "program"), [("euroc", "EuRoC"), ("kalibr", "Kalibr's bag extractor")])
def test_units_that_a_program_implies_are_told(files, name, program):
    assert said(read(files[name]), program)


@pytest.mark.parametrize(("name", "shift"), [("android", 1e-3), ("realsense", 1e-3)])
def test_two_clocks(files, name, shift):
    recording = read(files[name])
    assert recording.gyroscope is not None
    assert recording.gyroscope.time[0] - recording.accelerometer.time[0] == pytest.approx(shift)
    assert said(recording, "separate time stamps")
    assert "data.clocks" in [each.name for each in inspect(recording)]


def test_realsense_host_stamps(files):
    recording = read(files["realsense"], stamp="receive")
    assert recording.start == pytest.approx(7.5e-3) and said(recording, "host's stamp")


def test_sensor_logger_of_a_phone(tmp_path):
    """One file a sensor, named after it, all with the same header."""
    time, force, rate = samples()
    for name, values in (("TotalAcceleration.csv", force), ("Gyroscope.csv", rate)):
        rows = [
            f"{t},{(t - START) / 1e9!r},{z!r},{y!r},{x!r}" for t, (x, y, z) in zip(time, values.tolist(), strict=True)
        ]
        (tmp_path / name.replace("Total", "accelerometer_")).write_text(
            "\n".join(["time,seconds_elapsed,z,y,x", *rows])
        )
    paths = tmp_path / "accelerometer_Acceleration.csv", tmp_path / "Gyroscope.csv"
    recording = read_recording(*paths, AS_IS)
    np.testing.assert_array_equal(recording.accelerometer.values, force)
    np.testing.assert_array_equal(gyroscope(recording), rate)


def test_mars_logger(tmp_path):
    time, force, rate = samples()
    axes = "xyz"
    head = ",".join(
        ["Timestamp[nanosec]", *(f"g{a}[rad/s]" for a in axes), *(f"a{a}[m/s^2]" for a in axes), "Unix time[nanosec]"]
    )
    rows = (
        f"{t}," + ",".join(repr(float(v)) for v in (*w, *f)) + f",{t}"
        for t, f, w in zip(time, force, rate, strict=True)
    )
    (tmp_path / "gyro_accel.csv").write_text("\n".join([head, *rows]))
    np.testing.assert_array_equal(gyroscope(read(tmp_path / "gyro_accel.csv")), rate)


@pytest.mark.parametrize("prefix", ["", "field."])
@pytest.mark.parametrize("stamp", ["sec,nanosec", "secs,nsecs", ""])
def test_tables_of_ros_messages(tmp_path, prefix, stamp):
    """As bags are exported: stamps in one column or in two, the receive stamp beside them, SI units unsaid."""
    time, force, rate = samples()
    stamps = [f"header.stamp.{each}" for each in stamp.split(",")] if stamp else ["header.stamp"]
    vectors = [f"{name}.{axis}" for name in ("angular_velocity", "linear_acceleration") for axis in "xyz"]
    head = ",".join(["%time" if prefix else "Time", *(prefix + each for each in ("header.seq", *stamps, *vectors))])
    rows = [
        f"{t + 7},{at}," + (f"{t // 10**9},{t % 10**9}" if stamp else f"{t}") + "," + ",".join(map(repr, (*w, *f)))
        for at, (t, f, w) in enumerate(zip(time.tolist(), force.tolist(), rate.tolist(), strict=True))
    ]
    (tmp_path / "imu.csv").write_text("\n".join([head, *rows]))
    recording = read(tmp_path / "imu.csv")
    np.testing.assert_array_equal(recording.accelerometer.values, force)
    np.testing.assert_array_equal(gyroscope(recording), rate)
    np.testing.assert_allclose(recording.accelerometer.time, (time - START) / 1e9, atol=1e-12)
    assert recording.start == START / 1e9
    assert said(recording, "sensor_msgs/Imu") and said(recording, "nanosec") == (stamp == "sec,nanosec")


def test_stamps_in_two_columns_of_any_table(tmp_path):
    time, force, _ = samples()
    rows = [
        f"{t // 10**9},{t % 10**9}," + ",".join(map(repr, f))
        for t, f in zip(time.tolist(), force.tolist(), strict=True)
    ]
    (tmp_path / "log.csv").write_text("\n".join(["sec,nanosec,ax [m/s^2],ay [m/s^2],az [m/s^2]", *rows]))
    recording = read(tmp_path / "log.csv")
    np.testing.assert_allclose(recording.accelerometer.time, (time - START) / 1e9, atol=1e-12)
    named = read(tmp_path / "log.csv", columns="_,_,accel [m/s^2]", rate=RATE)
    np.testing.assert_array_equal(named.accelerometer.values, force)


# --- usage


@pytest.mark.parametrize("name", ["db3", "ulog", "dataflash", "android"])
def test_columns_are_for_tables(files, name):
    with pytest.raises(InputError, match="names its columns and units itself"):
        read(files[name], columns="time [s],accel [m/s^2]")


@pytest.mark.parametrize(("name", "package"), [("mcap", "rosbags"), ("ros1", "rosbags"), ("ulog", "pyulog"),
                                               ("dataflash", "pymavlink")])  # fmt: skip
def test_a_missing_package_is_named(files, name, package, monkeypatch):
    real = builtins.__import__

    def without(module, *arguments, **keywords):
        if module.split(".")[0] == package:
            raise ModuleNotFoundError(f"No module named {package!r}")
        return real(module, *arguments, **keywords)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(
        InputError, match=rf"needs the package {package}: install it with pip install 'jaximu\[formats\]'"
    ):
        read(files[name])


def test_a_folder_that_is_no_bag(tmp_path):
    with pytest.raises(InputError, match="no ROS 2 bag"):
        read(tmp_path)


def test_the_library_behind_is_quiet(files, capfd, tmp_path):
    data = files["dataflash"].read_bytes()
    (tmp_path / "log.bin").write_bytes(data[:3000] + b"\x00" * 300 + data[3000:])
    recording = read(tmp_path / "log.bin")
    assert said(recording, "damaged")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", FORMATS)
def test_info_and_compensate_run_on_every_format(files, name, tmp_path, capsys):
    from test_export import unit

    assert main(["info", str(files[name]), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["signals"]["accelerometer"]["samples"] == ROWS
    assert "compensate" in [each["verb"] for each in document["uses"]]
    unit().save(tmp_path / "calibration.json")
    output = tmp_path / "out.parquet"
    assert main(["compensate", str(tmp_path / "calibration.json"), str(files[name]), "-o", str(output)]) == 0
    assert len(read(output).accelerometer) == ROWS


# --- measured logs


def test_measured_flight_logs(data_folder):
    events = read(data_folder / "px4" / "sample_px4_events.ulg")
    assert events.accelerometer.rate == pytest.approx(250) and len(events.accelerometer) == 7783
    small = read(data_folder / "px4" / "sample_log_small.ulg")
    assert said(small, "dropout") and len(small.accelerometer) == 1298
    assert len(read(data_folder / "px4" / "sample_log_small.ulg", topic="vehicle_imu", instance=2).accelerometer) == 12
    copter = read(data_folder / "ardupilot" / "test.BIN")
    assert len(copter.accelerometer) == 45 and copter.temperature is not None
    assert np.median(np.linalg.norm(copter.accelerometer.values, axis=1)) == pytest.approx(9.8, abs=0.2)
    second = read(data_folder / "ardupilot" / "test.BIN", instance=1)
    assert second.temperature is not None and second.temperature.values[0, 0] == pytest.approx(39.92, abs=0.01)


def test_measured_optical_attitude(data_folder):
    """Turned to the lab by the optical attitude, gravity at rest points up: it is the sensor's, body to lab."""
    from scipy.spatial.transform import Rotation

    recording = read(data_folder / "broad" / "02_undisturbed_slow_rotation_B.mat")
    attitude = recording.attitude
    assert attitude is not None
    turn = Rotation.from_quat(attitude.values, scalar_first=True)
    body = np.stack(
        [np.interp(attitude.time, recording.accelerometer.time, v) for v in recording.accelerometer.values.T], 1
    )
    mean = turn.apply(body).mean(axis=0)
    np.testing.assert_allclose(mean, [0, 0, 9.8], atol=0.1)


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_a_topic_without_messages(tmp_path, storage):
    """A damaged MCAP was the first to have one."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    plugin = rosbag2.StoragePlugin[storage.upper()]
    with rosbag2.Writer(tmp_path / "bag", version=9, storage_plugin=plugin) as writer:
        writer.add_connection("/imu", "sensor_msgs/msg/Imu", typestore=store)
    with pytest.raises(InputError, match="bag"):
        read(tmp_path / "bag")
