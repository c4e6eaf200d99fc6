"""Round trip to autopilots: parameters in force that are wrong by known amounts, composed, written, and applied again.

The firmwares' equations are written here from their own source, rotations axis by axis:
- PX4 (Accelerometer.hpp and Gyroscope.hpp, `Correct`): R ((y − thermal − OFF) ∘ SCALE), R the level adjustment after
  CAL_ACCn_ROT or, where that is -1, SENS_BOARD_ROT.
- ArduPilot (AP_InertialSensor_Backend.cpp, `_rotate_and_correct_accel`): (y − p(T) + p(CALTEMP) − OFFS) ∘ SCAL, then
  rotated by AHRS_ORIENTATION.
"""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from sample_logs import write_dataflash, write_ulog

from jaximu.calibration import Calibration
from jaximu.cli import main
from jaximu.estimation.problem import names_of
from jaximu.ground.errors import InputError
from jaximu.ground.gravity import LocalGravity
from jaximu.model.sensor import Imu, Triad
from jaximu.recordings.readers import read_recording
from jaximu.recordings.readers.parameters import read_parameters
from jaximu.recordings.recording import Reading, apply_axes, axis_matrix
from jaximu.report.export import Composition, ExportedUnit, Range, losses
from jaximu.report.export.catalogue import writer
from jaximu.simulation import consumer_noise, simulate
from jaximu.simulation.protocols import HandHeld

G = 9.80665
CELSIUS = 41.0
OLD_OFFSET, OLD_SCALE = np.array([0.31, -0.22, 0.17]), np.array([1.011, 0.984, 1.023])
OLD_ZERO = np.array([0.012, -0.021, 0.007])
TRUE_OFFSET, TRUE_SCALE = np.array([0.12, 0.27, -0.35]), np.array([0.992, 1.013, 0.997])
TRUE_ZERO = np.array([-0.018, 0.004, 0.031])
"""Offsets and scales in force, and those that are right: y = u / scale + offset."""
THERMAL = {"A": np.array([[0.05, -0.08, 0.02], [4e-3, -3e-3, 2e-3], [1e-5, 2e-5, -1e-5], [1e-7, 0, 2e-7]]),
           "G": np.array([[2e-3, 1e-3, -3e-3], [1e-4, 2e-4, -1e-4], [1e-6, 0, 1e-6], [0, 1e-8, 0]])}  # fmt: skip
TREF, TMIN, TMAX = 35.0, 10.0, 60.0
CALTEMP = 22.0
SIGMA_BIAS, SIGMA_GAIN, SIGMA_ZERO = 2e-3, 2e-4, 1e-4
LEVEL = (1.5, -2.25, 0.75)
THREE_SIGMA = 3.76
"""What 99.73 % of vectors of three numbers stay below, in their standard deviation."""
DIRECTIONS = np.random.default_rng(5).normal(size=(60, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


def about(axis: int, degrees: float) -> np.ndarray:
    """A turn about one axis by the right hand."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = cosine
    matrix[second, first], matrix[first, second] = sine, -sine
    return matrix


def turned(roll: float, pitch: float, yaw: float) -> np.ndarray:
    return about(2, yaw) @ about(1, pitch) @ about(0, roll)


NAMES = (
    "None Yaw45 Yaw90 Yaw135 Yaw180 Yaw225 Yaw270 Yaw315 Roll180 Roll180Yaw45 Roll180Yaw90 Roll180Yaw135 Pitch180 "
    "Roll180Yaw225 Roll180Yaw270 Roll180Yaw315 Roll90 Roll90Yaw45 Roll90Yaw90 Roll90Yaw135 Roll270 Roll270Yaw45 "
    "Roll270Yaw90 Roll270Yaw135 Pitch90 Pitch270 Pitch180Yaw90 Pitch180Yaw270 Roll90Pitch90 Roll180Pitch90 "
    "Roll270Pitch90 Roll90Pitch180 Roll270Pitch180 Roll90Pitch270 Roll180Pitch270 Roll270Pitch270 "
    "Roll90Pitch180Yaw90 Roll90Yaw270 Roll90Pitch68Yaw293 Pitch315 Roll90Pitch315"
).split()
"""What the documentation of SENS_BOARD_ROT and AHRS_ORIENTATION calls each number."""


def named(name: str) -> np.ndarray:
    angles = {key: float(value) for key, value in re.findall(r"(Roll|Pitch|Yaw)([\d.]+)", name)}
    return turned(*(angles.get(key, 0.0) for key in ("Roll", "Pitch", "Yaw")))


PX4 = dict(enumerate(map(named, NAMES)))
ARDUPILOT = PX4 | {38: turned(90, 68.8, 293.3), 41: turned(0, 7, 0), 42: turned(45, 0, 0), 43: turned(315, 0, 0),
                   100: turned(10, 20, 30), 101: turned(11, -21, 31), 102: turned(-12, 22, 132)}  # fmt: skip
CUSTOM = {"AHRS_CUSTOM_ROLL": 10, "AHRS_CUSTOM_PIT": 20, "AHRS_CUSTOM_YAW": 30, "CUST_ROT1_ROLL": 11,
          "CUST_ROT1_PITCH": -21, "CUST_ROT1_YAW": 31, "CUST_ROT2_ROLL": -12, "CUST_ROT2_PITCH": 22,
          "CUST_ROT2_YAW": 132}  # fmt: skip


def axes(pattern: str, values) -> dict[str, float]:
    return {pattern.format(axis): float(value) for axis, value in zip("XYZ", values, strict=True)}


def px4_in_force(rotation: int = 0, thermal: bool = False, number: int = 0, external: bool = False) -> dict[str, float]:
    values = {"SENS_BOARD_ROT": 2 if external else rotation, "TC_A_ENABLE": thermal, "TC_G_ENABLE": thermal}
    values |= axes("SENS_BOARD_{}_OFF", LEVEL)
    for name, offset in (("ACC", OLD_OFFSET), ("GYRO", OLD_ZERO)):
        values |= axes(f"CAL_{name}{number}_{{}}OFF", offset)
        values |= {f"CAL_{name}{number}_ID": 1310988, f"CAL_{name}{number}_ROT": rotation if external else -1}
        stem = f"TC_{name[0]}1_"  # of another number: the ID says whose it is
        values |= {f"{stem}ID": 1310988, f"{stem}TREF": TREF, f"{stem}TMIN": TMIN, f"{stem}TMAX": TMAX}
        values |= {f"{stem}X{k}_{axis}": THERMAL[name[0]][k, axis] for k in range(4) for axis in range(3)}
    return values | axes(f"CAL_ACC{number}_{{}}SCALE", OLD_SCALE)


def px4_equation(values, y_a, y_g, celsius, external: bool = False):
    """What PX4 makes of outputs."""
    turn = PX4[int(values["CAL_ACC0_ROT"] if external else values["SENS_BOARD_ROT"])]
    turn = turned(*(values[f"SENS_BOARD_{axis}_OFF"] for axis in "XYZ")) @ turn
    d = min(max(celsius, TMIN), TMAX) - TREF
    answers = []
    for name, y in (("ACC", y_a), ("GYRO", y_g)):
        thermal = np.zeros(3)
        if values[f"TC_{name[0]}_ENABLE"]:
            x = [np.array([values[f"TC_{name[0]}1_X{k}_{axis}"] for axis in range(3)]) for k in range(4)]
            thermal = x[0] + x[1] * d + x[2] * d**2 + x[3] * d**3
        offset = np.array([values[f"CAL_{name}0_{axis}OFF"] for axis in "XYZ"])
        scale = np.array([values.get(f"CAL_{name}0_{axis}SCALE", 1.0) for axis in "XYZ"])
        answers.append((y - thermal - offset) * scale @ turn.T)
    return answers


def ardupilot_in_force(rotation: int = 0, thermal: bool = False, digit: str = "") -> dict[str, float]:
    values = {"AHRS_ORIENTATION": rotation, f"INS_TCAL{digit or 1}_ENABLE": thermal, **CUSTOM}
    values |= {f"INS_TCAL{digit or 1}_TMIN": TMIN, f"INS_TCAL{digit or 1}_TMAX": TMAX}
    for name, offset in (("ACC", OLD_OFFSET), ("GYR", OLD_ZERO)):
        values |= axes(f"INS_{name}{digit}OFFS_{{}}", offset)
        values |= {f"INS_{name}{digit}_ID": 2753036, f"INS_{name}{digit or 1}_CALTEMP": CALTEMP}
        for k in (1, 2, 3):
            values |= axes(f"INS_TCAL{digit or 1}_{name}{k}_{{}}", 1e6 * THERMAL[name[0]][k])
    return values | axes(f"INS_ACC{digit}SCAL_{{}}", OLD_SCALE)


def ardupilot_equation(values, y_a, y_g, celsius):
    """What ArduPilot makes of outputs."""
    turn = ARDUPILOT[int(values["AHRS_ORIENTATION"])]

    def p(name, at):
        c = [np.array([values[f"INS_TCAL1_{name}{k}_{axis}"] for axis in "XYZ"]) for k in (1, 2, 3)]
        d = min(max(at, TMIN), TMAX) - 35.0
        return 1e-6 * (c[0] + (c[1] + c[2] * d) * d) * d

    answers = []
    for name, y in (("ACC", y_a), ("GYR", y_g)):
        if values["INS_TCAL1_ENABLE"]:
            y = y - p(name, celsius) + p(name, values[f"INS_{name}1_CALTEMP"])
        offset = np.array([values[f"INS_{name}OFFS_{axis}"] for axis in "XYZ"])
        scale = np.array([values.get(f"INS_{name}SCAL_{axis}", 1.0) for axis in "XYZ"])
        answers.append((y - offset) * scale @ turn.T)
    return answers


def written(path, values: dict[str, float], qgc: bool = False):
    """A parameter file: QGroundControl's, or Mission Planner's."""
    row = "1\t1\t{}\t{!r}\t9" if qgc else "{},{!r}"
    path.write_text(
        "# a comment\n" + "\n".join(row.format(name, float(value)) for name, value in values.items()) + "\n"
    )
    return path


def outputs(force, rate):
    """The sensor's outputs in its own axes at CELSIUS; what temperature adds is in the offsets that are right."""
    return force / TRUE_SCALE + TRUE_OFFSET, rate + TRUE_ZERO


FORCE, RATE = G * DIRECTIONS, 2.0 * DIRECTIONS[:, ::-1]


def calibration_of(logged, vehicle: bool, seed: int, body: str = "FRD", **reading) -> Calibration:
    """The calibration of a log: affine in what it saw, in error by a draw from its own covariance.

    logged: what the log held for forces and rates in its axes, as functions.
    """
    generator = np.random.default_rng(seed)
    turn = axis_matrix(body)
    triads = []
    for function, quantity, unit, (gain_sigma, bias_sigma) in zip(
        logged, ("specific_force", "angular_rate"), ("m/s^2", "rad/s"),
        ((SIGMA_GAIN, SIGMA_BIAS), (SIGMA_GAIN, SIGMA_ZERO)), strict=True
    ):  # fmt: skip
        bias = function(np.zeros((1, 3)))[0]
        gain = (function(np.eye(3)) - bias).T
        gain, bias = turn @ gain @ turn.T, turn @ bias
        gain = gain + generator.normal(0, gain_sigma, (3, 3))
        triads.append(Triad(gain, bias + generator.normal(0, bias_sigma, 3), (), quantity, unit))
    imu = Imu(*triads)
    names = names_of(imu)
    sigmas = [
        SIGMA_GAIN if n.part == "gain" else SIGMA_BIAS if n.owner == "accelerometer" else SIGMA_ZERO for n in names
    ]
    return Calibration(
        imu=imu, names=names, covariance=np.diag(np.square(sigmas)), gravity=LocalGravity(G, 0.0), method="joint",
        loss="linear", rms={}, rank=24, weak=(), excess={}, solver="", data={"files": [], "temperature": CELSIUS},
        reading=Reading(axes=body, frame="FRD", **reading),
    )  # fmt: skip


def round_trip(tmp_path, to, before, equation, corrected: bool, seed: int, more=None):
    """Compose a calibration of a log with the parameters in force; return those after writing, and the changes."""

    def logged(place):
        def function(u):
            u_vehicle = [np.zeros_like(u), np.zeros_like(u)]
            u_vehicle[place] = u
            if corrected:  # u in the vehicle's axes: what the sensor put out, as the autopilot corrected it
                inside = [part @ rotation for part in u_vehicle]
                return equation(before, *outputs(*inside), CELSIUS)[place]
            return outputs(*u_vehicle)[place]

        return function

    rotation = rotation_of(before, to)
    calibration = calibration_of(
        (logged(0), logged(1)), corrected, seed, corrected=corrected if corrected or to == "px4" else None,
        sensors=dict.fromkeys(("accelerometer", "gyroscope"), 1310988 if to == "px4" else 0),
    )  # fmt: skip
    path = written(tmp_path / "now.params", before, to == "px4")
    composition = Composition.of(
        ExportedUnit.of(calibration),
        to,
        read_parameters(path),
        None if to == "px4" else "corrected" if corrected else "raw",
    )
    content = writer(to).write(composition.unit).files[""].decode()
    rows = [re.split(r"[\t,]", line)[-4 if to == "px4" else 0 :] for line in content.splitlines() if line[0] != "#"]
    after = before | (
        {row[1]: float(row[2]) for row in rows} if to == "px4" else {row[0]: float(row[1]) for row in rows}
    )
    return after, composition, rotation


def rotation_of(values, to):
    if to == "ardupilot":
        return ARDUPILOT[int(values["AHRS_ORIENTATION"])]
    index = values["CAL_ACC0_ROT"] if values["CAL_ACC0_ROT"] >= 0 else values["SENS_BOARD_ROT"]
    return turned(*LEVEL) @ PX4[int(index)]


CASES = [
    *(("px4", rotation, corrected) for rotation in PX4 for corrected in (False, True)),
    *(("ardupilot", rotation, corrected) for rotation in ARDUPILOT for corrected in (False, True)),
]


@pytest.mark.parametrize(("to", "rotation", "corrected"), CASES)
@pytest.mark.parametrize("thermal", [False, True])
def test_gravity_to_three_sigma_after_writing(tmp_path, to, rotation, corrected, thermal):
    make, equation = (px4_in_force, px4_equation) if to == "px4" else (ardupilot_in_force, ardupilot_equation)
    before = make(rotation, thermal)
    after, composition, turn = round_trip(tmp_path, to, before, equation, corrected, rotation)
    assert set(after) == set(before)
    y = outputs(FORCE @ turn, RATE @ turn)
    wrong, right = equation(before, *y, CELSIUS), equation(after, *y, CELSIUS)
    # an offset's error, and that of a row of the gain on gravity, of three axes at once
    for truth, old, new, sigma in zip(
        (FORCE, RATE), wrong, right, (np.hypot(SIGMA_BIAS, G * SIGMA_GAIN), SIGMA_ZERO), strict=True
    ):
        misfit = np.sqrt(np.mean(np.sum((new - truth) ** 2, axis=1)))
        assert misfit < THREE_SIGMA * sigma < 0.1 * np.sqrt(np.mean(np.sum((old - truth) ** 2, axis=1)))
    # what was said of the change is what the firmware's own equation says of it
    still = equation(before, *outputs(FORCE @ turn, 0 * RATE), CELSIUS)
    moved = equation(after, *outputs(FORCE @ turn, 0 * RATE), CELSIUS)
    amounts, change = composition.at_rest(), moved[0] - still[0]
    assert np.linalg.norm(change, axis=1).max() == pytest.approx(amounts["force"], rel=0.05)
    assert np.linalg.norm(np.cross(change, DIRECTIONS), axis=1).max() == pytest.approx(G * amounts["horizon"], rel=0.1)
    assert np.linalg.norm(moved[1] - still[1], axis=1).max() == pytest.approx(amounts["rate"], rel=1e-6)


def test_an_external_sensor_has_its_own_rotation(tmp_path):
    before = px4_in_force(7, external=True)

    def equation(values, y_a, y_g, celsius):
        return px4_equation(values, y_a, y_g, celsius, external=True)

    after, _, turn = round_trip(tmp_path, "px4", before, equation, True, 1)
    new, _ = equation(after, *outputs(FORCE @ turn, RATE @ turn), CELSIUS)
    assert np.abs(new - FORCE).max() < 0.02


def test_the_rotations_are_mavlinks():
    """As MAVLink's own definition describes each number, which is a third source."""
    dialect = pytest.importorskip("pymavlink.dialects.v20.common")
    for index, entry in dialect.enums["MAV_SENSOR_ORIENTATION"].items():
        if index < 41 and index != 38:
            angles = {key: float(value) for key, value in re.findall(r"(Roll|Pitch|Yaw): (\d+)", entry.description)}
            np.testing.assert_allclose(
                PX4[index], turned(*(angles.get(k, 0) for k in ("Roll", "Pitch", "Yaw"))), atol=1e-12
            )


# --- what the files and the log say


DEVICE = [("uint64_t", "timestamp"), ("uint64_t", "timestamp_sample"), *(("float", axis) for axis in "xyz"),
          ("uint32_t", "device_id")]  # fmt: skip
COMBINED = [("uint64_t", "timestamp"), ("float[3]", "gyro_rad"), ("int32_t", "accelerometer_timestamp_relative"),
            ("float[3]", "accelerometer_m_s2")]  # fmt: skip
STAMPS = [10**6 + 10000 * step for step in range(400)]


def single(values: dict[str, float]) -> dict[str, tuple[float, ...]]:
    return {name: (float(np.float32(value)),) for name, value in values.items()}


def px4_log(path, values, changed=None, combined: bool = False):
    noise = np.random.default_rng(1).normal(0, 0.01, (len(STAMPS), 6))
    rows = []
    for at, shake in zip(STAMPS, noise, strict=True):
        force, rate = shake[:3] - [0, 0, G], shake[3:]
        if combined:
            rows.append(("sensor_combined", 0, (at, *rate, 0, *force)))
        else:
            rows += [("sensor_accel", 1, (at, at, *force, 7)), ("sensor_gyro", 1, (at, at, *rate, 1310988))]
    formats = {"sensor_combined": COMBINED} if combined else {"sensor_accel": DEVICE, "sensor_gyro": DEVICE}
    return write_ulog(path, formats, rows, values, changed)


def ardupilot_log(path, values):
    shake = np.random.default_rng(1).normal(0, 0.01, (len(STAMPS), 6))
    rows = [("PARM", (0, name.encode(), value)) for name, value in values.items()]
    rows += [("IMU", (at, 1, *row[:3], *(row[3:] - [0, 0, G]), 40.0)) for at, row in zip(STAMPS, shake, strict=True)]
    return write_dataflash(path, {"PARM": ("QNf", "TimeUS,Name,Value"),
                                  "IMU": ("QBfffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,T")}, rows)  # fmt: skip


def test_parameters_of_logs_and_lists(tmp_path):
    px4, ardupilot = px4_in_force(4), ardupilot_in_force(8)
    pytest.importorskip("pyulog")
    assert read_parameters(px4_log(tmp_path / "a.ulg", px4)).values == single(px4)
    pytest.importorskip("pymavlink")
    assert read_parameters(ardupilot_log(tmp_path / "a.bin", ardupilot)).values == single(ardupilot)
    assert read_parameters(written(tmp_path / "a.params", px4, True)).values.keys() == px4.keys()
    (tmp_path / "a.parm").write_text("INS_ACCOFFS_X    0.25  # old\n\nINS_ACC_ID=7\nINS_GYR_ID\t8 @READONLY\n")
    assert read_parameters(tmp_path / "a.parm").values == {
        "INS_ACCOFFS_X": (0.25,), "INS_ACC_ID": (7.0,), "INS_GYR_ID": (8.0,)}  # fmt: skip
    changed = read_parameters(px4_log(tmp_path / "b.ulg", px4, {"CAL_ACC0_XOFF": 0.5, "CAL_ACC0_YOFF": -0.22}))
    assert changed.value("CAL_ACC0_YOFF") == pytest.approx(-0.22)
    with pytest.raises(InputError, match=r"CAL_ACC0_XOFF is 0\.31, then 0\.5: which was in force is not known"):
        changed.value("CAL_ACC0_XOFF")


def test_a_log_shows_whether_it_was_corrected_and_of_which_sensor(tmp_path):
    pytest.importorskip("pyulog")
    raw = read_recording(px4_log(tmp_path / "a.ulg", {})).reading
    assert (raw.corrected, raw.sensors) == (False, {"accelerometer": 7, "gyroscope": 1310988})
    combined = read_recording(px4_log(tmp_path / "b.ulg", {}, combined=True)).reading
    assert (combined.corrected, combined.sensors) == (True, {})
    pytest.importorskip("pymavlink")
    ardupilot = read_recording(ardupilot_log(tmp_path / "a.bin", {"A": 1.0})).reading
    assert (ardupilot.corrected, ardupilot.sensors) == (True, {"accelerometer": 1, "gyroscope": 1})
    (tmp_path / "a.csv").write_text("time [s],accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2]\n" + "".join(
        f"{at / 100},{0.1 * (at % 3)},{0.1 * (at % 5)},{9.8 + 0.01 * (at % 2)}\n" for at in range(300)))  # fmt: skip
    assert read_recording(tmp_path / "a.csv").reading.corrected is None
    kept = Reading.from_document(json.loads(json.dumps(vars(raw))))
    assert (kept.corrected, kept.sensors) == (raw.corrected, raw.sensors)


# --- the command line


def plain(**reading) -> Calibration:
    """A calibration of an autopilot's own log, of perfect sensors but for the biases."""
    return calibration_of((lambda u: u + [0.1, 0.2, -0.3], lambda u: u + [0.01, 0.02, -0.03]), False, 1, **reading)


def exported(tmp_path, values, *arguments, to: str = "px4", status: int = 0, calibration=None, **reading):
    """Save, export with parameters in force."""
    (calibration or plain(**reading)).save(tmp_path / "calibration.json")
    path = written(tmp_path / "now.param", values, to == "px4")
    (tmp_path / "new.params").unlink(missing_ok=True)
    line = ["export", str(tmp_path / "calibration.json"), "--to", to, "--in-force", str(path), *arguments]
    assert main([*line, "-o", str(tmp_path / "new.params")]) == status
    assert (tmp_path / "new.params").exists() == (status == 0)


def test_what_is_printed_and_what_json_has(tmp_path, capsys):
    exported(tmp_path, px4_in_force(2), corrected=True)
    printed = " ".join(capsys.readouterr().out.split())
    assert "composed with those in force" in printed and "what the autopilot had corrected by them" in printed
    assert "as it shows" in printed and "temperature corrections stay in force" in printed
    assert "What changes:" in printed and re.search(r"CAL_ACC0_XOFF 0\.31 0\.\d+ ± 0\.\d+ .*m/s², horizon", printed)
    assert re.search(r"CAL_GYRO0_ZOFF .* °/s", printed) and "All together, at most at rest" in printed
    exported(tmp_path, px4_in_force(2), "--json", corrected=True)
    document = json.loads(capsys.readouterr().out)
    changes = {change["parameter"]: change for change in document["in_force"]["changes"]}
    assert len(changes) == 9 and changes["CAL_ACC0_XOFF"]["in_force"] == pytest.approx(0.31)
    # rotation 2 and a level adjustment, and the scale in force between the log and the parameter
    turn = rotation_of(px4_in_force(2), "px4")
    spread = np.sqrt(np.diag(turn.T @ turn)) * SIGMA_BIAS / OLD_SCALE
    for axis, name in enumerate("XYZ"):
        assert changes[f"CAL_ACC0_{name}OFF"]["half_width"] == pytest.approx(1.96 * spread[axis], rel=1e-3)
        assert changes[f"CAL_GYRO0_{name}OFF"]["half_width"] == pytest.approx(1.96 * SIGMA_ZERO, rel=1e-3)
        change = changes[f"CAL_ACC0_{name}OFF"]
        new_scale = changes[f"CAL_ACC0_{name}SCALE"]["new"]
        assert change["at_rest"]["force"] == pytest.approx(new_scale * (change["in_force"] - change["new"]))
        assert change["at_rest"]["horizon"] == pytest.approx(abs(change["at_rest"]["force"]) / G)
    assert set(document["in_force"]["at_rest"]) == {"force", "horizon", "rate"}


@pytest.mark.parametrize("to", ["px4", "ardupilot"])
def test_the_losses_are_those_of_the_vehicle(tmp_path, to):
    """After composing, what the file cannot carry is what it cannot carry of the sensor itself, however turned."""
    make, equation = (px4_in_force, px4_equation) if to == "px4" else (ardupilot_in_force, ardupilot_equation)
    _, composition, _ = round_trip(tmp_path, to, make(9), equation, True, 3)
    unit = composition.unit
    lost = losses(unit, writer(to).write(unit), Range.of(unit.calibration))
    assert lost[0].worst["accelerometer"] < 5 * G * SIGMA_GAIN and lost[0].worst["gyroscope"] < 10 * SIGMA_GAIN


def test_the_temperature_in_force_is_taken_off_a_raw_log(tmp_path, capsys):
    """PX4#9736: with the temperature correction on, the constant part is what remains after it."""
    for number in (0, 40):
        at = {"files": [], "temperature": 35.0 + number}
        exported(tmp_path, px4_in_force(0, True), "--json", calibration=replace(plain(corrected=False), data=at))
        changes = json.loads(capsys.readouterr().out)["in_force"]["changes"]
        d = min(number, TMAX - TREF)
        thermal = np.array([1, d, d**2, d**3]) @ THERMAL["A"]
        bias = np.array([0.1, 0.2, -0.3]) - thermal
        np.testing.assert_allclose([change["new"] for change in changes[:3]], bias, atol=4 * SIGMA_BIAS)
    exported(tmp_path, px4_in_force(0, True), status=2, calibration=replace(plain(corrected=False), data={"files": []}))
    assert "TC_A_ENABLE is on, and the calibration does not say its temperature" in capsys.readouterr().err
    exported(tmp_path, px4_in_force(0, True), calibration=replace(plain(corrected=True), data={"files": []}))


def without(values, *names):
    return {name: value for name, value in values.items() if name not in names}


SEVERAL = px4_in_force() | px4_in_force(number=1) | {"CAL_ACC1_ID": 7, "CAL_GYRO1_ID": 7}
BAD = [
    (ardupilot_in_force(), [], "expected parameters of PX4 .* found those of ArduPilot: export --to ardupilot"),
    ({"MPC_XY_VEL_MAX": 12.0}, [], "expected parameters of PX4 .* found none of an autopilot's sensors"),
    (without(px4_in_force(), "CAL_ACC0_XOFF") | {"CAL_ACC0_XOF": 1}, [], "no parameter CAL_ACC0_XOFF; .* CAL_ACC0_XOF"),
    (px4_in_force() | {"CAL_ACC0_XOFF": np.nan}, [], "CAL_ACC0_XOFF is nan, not a finite number"),
    (px4_in_force() | {"CAL_ACC0_YSCALE": 0.0}, [], "a scale of the accelerometer in force is 0"),
    (without(px4_in_force(), "CAL_ACC0_ROT"), [], "has no CAL_ACC0_ROT, so the sensor's rotation is not known"),
    (without(px4_in_force(), "SENS_BOARD_ROT"), [], "has no parameter SENS_BOARD_ROT"),
    (without(px4_in_force(), "SENS_BOARD_Y_OFF"), [], "has no parameter SENS_BOARD_Y_OFF"),
    (px4_in_force(41), [], "SENS_BOARD_ROT is 41, which is no rotation that PX4 lists"),
    (px4_in_force() | {"SENS_BOARD_ROT": 1.5}, [], "SENS_BOARD_ROT is 1.5"),
    (px4_in_force() | {"CAL_ACC0_ID": 0}, [], "which of them the accelerometer is.* with an ID: none"),
    (SEVERAL, [], r"with an ID: 0 \(ID 1310988\), 1 \(ID 7\)\. State it by --instance or --device"),
    (SEVERAL, ["--instance", "2"], "State it by --instance or --device"),
    (SEVERAL, ["--device", "8"], "State it by --instance or --device"),
    (px4_in_force(), ["--log-was", "raw"], "--log-was: the calibrated log held what the autopilot had corrected"),
]


@pytest.mark.parametrize(("values", "arguments", "words"), BAD)
def test_bad_parameters(tmp_path, capsys, values, arguments, words):
    exported(tmp_path, values, *arguments, status=2, corrected=True)
    message = capsys.readouterr().err
    assert re.search(words, " ".join(message.split())) and "Traceback" not in message


def test_which_of_several_sensors(tmp_path, capsys):
    values = SEVERAL | {"CAL_ACC1_XOFF": 0.5}
    for arguments, sensors in ((["--instance", "1"], {}), (["--device", "7"], {}),
                               ([], {"accelerometer": 7, "gyroscope": 7})):  # fmt: skip
        exported(tmp_path, values, "--json", *arguments, corrected=True, sensors=sensors)
        changes = json.loads(capsys.readouterr().out)["in_force"]["changes"]
        assert changes[0]["parameter"] == "CAL_ACC1_XOFF" and changes[0]["in_force"] == 0.5
    exported(tmp_path, values, status=2, corrected=True, sensors={"accelerometer": 7, "gyroscope": 1310988})
    assert "different numbers (accelerometer 1, gyroscope 0)" in capsys.readouterr().err
    exported(tmp_path, values, status=2, corrected=True, sensors={"accelerometer": 9, "gyroscope": 9})
    assert "(the log says 9)" in capsys.readouterr().err
    second = ardupilot_in_force() | ardupilot_in_force(digit="2")
    exported(tmp_path, second, "--json", to="ardupilot", corrected=True, sensors={"accelerometer": 1, "gyroscope": 1})
    assert json.loads(capsys.readouterr().out)["in_force"]["changes"][0]["parameter"] == "INS_ACC2OFFS_X"


def test_what_must_be_stated(tmp_path, capsys):
    exported(tmp_path, px4_in_force(), status=2)
    assert "state --log-was raw or corrected" in capsys.readouterr().err
    exported(tmp_path, px4_in_force(), "--log-was", "corrected")
    assert "as stated" in capsys.readouterr().out
    old = replace(plain(), reading=None)
    exported(tmp_path, px4_in_force(), "--log-was", "raw", status=2, calibration=old)
    assert "in which axes its log was read: state --axes" in capsys.readouterr().err
    exported(tmp_path, px4_in_force(), "--log-was", "raw", "--axes", "FRD", calibration=old)
    # another logger's axes: the board's or the vehicle's, if these differ
    other = replace(plain(), reading=Reading(axes="FRD"))
    exported(tmp_path, px4_in_force(), "--log-was", "raw", status=2, calibration=other)
    assert "whether its axes are the board's or the vehicle's" in capsys.readouterr().err
    level = px4_in_force() | axes("SENS_BOARD_{}_OFF", (0, 0, 0))
    exported(tmp_path, level, "--log-was", "raw", calibration=other)


def test_bad_files(tmp_path, capsys):
    calibration = tmp_path / "calibration.json"
    plain(corrected=True).save(calibration)
    for content, words in (
        (b"", "holds no parameters"), (b"# nothing\n", "holds no parameters"),
        (b"CAL_ACC0_ID 7\nCAL_ACC0_XOFF here\n", "row 2: expected a parameter's name and value"),
        (b"time,accel_x\n1,2\n", "row 1: expected"), (b"ULog\x01\x12\x35\x01", "cut off or damaged"),
        (b"\xa3\x95\x80\x80", "holds no parameters|cut off or damaged"), (b"\xff\xfe\x00", "row 1: expected"),
    ):  # fmt: skip
        (tmp_path / "now.params").write_bytes(content)
        assert main(["export", str(calibration), "--to", "px4", "--in-force", str(tmp_path / "now.params")]) == 2
        assert re.search(words, " ".join(capsys.readouterr().err.split())), content
    assert main(["export", str(calibration), "--to", "kalibr", "--in-force", str(tmp_path / "now.params")]) == 2
    assert main(["export", str(calibration), "--to", "px4", "--in-force", str(tmp_path / "none.params")]) == 2
    before = written(tmp_path / "calibration_px4.params", px4_in_force(), True).read_bytes()
    assert (
        main(["export", str(calibration), "--to", "px4", "--in-force", str(tmp_path / "calibration_px4.params")]) == 2
    )
    assert (tmp_path / "calibration_px4.params").read_bytes() == before
    assert main(["export", str(calibration), "--to", "px4"]) == 0
    assert "give those in force (--in-force FILE)" in capsys.readouterr().err


def test_from_a_flight_log_to_parameters_by_the_command_line(tmp_path, capsys):
    """A log that PX4 has corrected wrongly holds all that the round trip needs: calibrate, then export."""
    pytest.importorskip("pyulog")
    recording, truth = simulate(Imu.nominal(), HandHeld(12, 1.5), consumer_noise(), seed=[4, 1])
    vehicle = apply_axes(recording, "FRD")
    before = px4_in_force(13)
    turn = rotation_of(before, "px4")
    y = outputs(vehicle.accelerometer.values @ turn, vehicle.gyroscope.values @ turn)
    corrected = px4_equation(before, *y, CELSIUS)
    rows = [("sensor_combined", 0, (round(1e6 * time) + 10**6, *rate, 0, *force))
            for time, force, rate in zip(vehicle.accelerometer.time, *corrected, strict=True)]  # fmt: skip
    log = write_ulog(tmp_path / "flight.ulg", {"sensor_combined": COMBINED}, rows, before)
    assert main(["calibrate", str(log), "--axes", "FRD", "-o", str(tmp_path), "--quiet"]) == 0
    capsys.readouterr()
    line = ["export", str(tmp_path / "calibration.json"), "--to", "px4", "--in-force", str(log)]
    assert main([*line, "-o", str(tmp_path / "new.params"), "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["in_force"]["changes"]) == 9
    after = before | {name: value for name, (value,) in read_parameters(tmp_path / "new.params").values.items()}
    new = px4_equation(after, *y, CELSIUS)
    frame = np.diag([1.0, -1.0, -1.0])
    assert np.abs(np.mean(new[0] - truth.stimulus.specific_force @ frame, axis=0)).max() < 0.02
    assert np.abs(np.mean(new[1] - truth.stimulus.angular_rate @ frame, axis=0)).max() < 2e-3
    assert np.abs(np.mean(corrected[0] - truth.stimulus.specific_force @ frame, axis=0)).max() > 0.2


@pytest.mark.parametrize("reading", [{"corrected": "yes"}, {"sensors": [7]}, {"sensors": {"accelerometer": "x"}}])
def test_a_reading_that_is_none(tmp_path, capsys, reading):
    path = tmp_path / "calibration.json"
    plain().save(path)
    document = json.loads(path.read_text())
    document["reading"] |= reading
    path.write_text(json.dumps(document))
    assert main(["export", str(path), "--to", "px4"]) == 2
    assert "Traceback" not in capsys.readouterr().err
