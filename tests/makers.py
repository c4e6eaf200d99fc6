"""More makers' habits, one a line: names as the maker writes them, and what stands below."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from dialects import ALL, DEG, EPOCH, Dialect, G, Log, clock, simulate, text, whole

_UNITS = {
    "f": {"": 1.0, "g": 1 / G, "mg": 1e3 / G, "cm": 100.0},
    "w": {"": 1.0, "dps": DEG, "mdps": 1e3 * DEG, "mrad": 1e3},
    "m": {"": 1.0, "G": 0.01, "mG": 10.0, "one": 1 / 46.0},
    "t": {"": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9, "fine": 1e4},
    "T": {"": 1.0, "hot": 1.0},
}


def _values(log: Log, token: str) -> Any:
    """Columns by a word: `f.mg` force in mg, `w.131` rate in counts of 131 to 1 deg/s, `t.us+` epoch in us, `=5` fives.

    A `~` before a word turns its columns round (z, y, x), `>` has z first (z, x, y).
    """
    if token[0] in "~>":
        return _values(log, token[1:])[:, [2, 1, 0] if token[0] == "~" else [2, 0, 1]]
    if token[0] == "=":
        return [token[1:]] * len(log.time)
    if token in _TEXTS:
        return _TEXTS[token](log)
    kind, _, unit = token.partition(".")
    since = EPOCH if unit.endswith("+") else 0
    unit = unit.rstrip("+")
    values = {"f": log.force, "w": log.rate, "m": log.field, "t": log.time, "T": log.heat + 45 * (unit == "hot")}[kind]
    if unit.isdigit() or "_" in unit:  # counts to 1 g or 1 deg/s
        return whole(values * float(unit.replace("_", ".")) * (1 / G if kind == "f" else DEG))
    values = values * _UNITS[kind][unit]
    if kind == "t" and unit:
        return whole(values) + since * round(_UNITS["t"][unit])
    return values + since


_TEXTS = {
    "n": lambda log: np.arange(len(log.time)),
    "zero": lambda log: np.zeros((len(log.time), 3)),
    "q": lambda log: log.attitude,
    "qxyz": lambda log: log.attitude[:, [1, 2, 3, 0]],
    "angles": lambda log: np.cumsum(log.rate, axis=0) * DEG / 100,
    "lin": lambda log: np.random.default_rng(1).normal(0, 0.02, (len(log.time), 3)),
    "lin1": lambda log: np.random.default_rng(2).normal(0, 0.02, len(log.time)),
    "nine": lambda log: np.zeros((len(log.time), 9)),
    "norm": lambda log: np.linalg.norm(log.force, axis=1),
    **{f"f{axis}.g": lambda log, at=at: log.force[:, at] / G for at, axis in enumerate("xyz")},
    **{f"w{axis}": lambda log, at=at: log.rate[:, at] * DEG for at, axis in enumerate("xyz")},
    "dt": lambda log: np.full(len(log.time), 0.01) + np.random.default_rng(3).normal(0, 1e-5, len(log.time)),
    "fdt": lambda log: log.force / 100,
    "wdt": lambda log: log.rate / 100,
    "clock": lambda log: clock(log.time),
    "hms": lambda log: [each[:-4] for each in clock(log.time)],
    "hundredths": lambda log: [each[:-1] for each in clock(log.time)],
    "rest.ms": lambda log: whole(log.time * 1e3) % 1000,
    "rest.us": lambda log: whole(log.time * 1e6) % 1_000_000,
    "rest.ns": lambda log: whole(log.time * 1e9) % 1_000_000_000,
    "whole.s": lambda log: whole(np.floor(log.time + 1e-7)) + EPOCH,
    "iso": lambda log: clock(log.time, day="2024-05-01T"),
    "isoz": lambda log: [f"{each}Z" for each in clock(log.time, day="2024-05-01T")],
    "isotz": lambda log: [f"{each}+02:00" for each in clock(log.time, day="2024-05-01 ")],
    "us.date": lambda log: clock(log.time, day="05/01/2024 "),
    "de.date": lambda log: clock(log.time, day="01.05.2024 "),
    "midnight": lambda log: clock((log.time + 36005.0 + 50400 - 50400) % 86400),
    **{
        f"{kind}{mark}": lambda log, kind=kind, form=form: [
            form.format(*row) for row in (log.force if kind == "f" else log.rate * DEG)
        ]
        for kind in "fw"
        for mark, form in (("[]", '"[{:.6f}, {:.6f}, {:.6f}]"'), ("||", "{:.6f}|{:.6f}|{:.6f}"))
    },
    "sec": lambda log: [f"{t:.2f} sec" for t in log.time],
}


def habit(
    name: str, names: str | None, values: str, *, kind: str = "poses", sensors: Sequence[str] = ("accel", "gyro"),
    answers: Sequence[str] = (), must: Sequence[str] = ("read", "line"), rough: float = 0.0, encoding: str = "",
    form: str = "", **how: Any,
) -> None:  # fmt: skip
    """Register a maker's table: its header, in which `{xyz}` stands for three names, and its columns by `_values`."""
    titles = None if names is None else [each for part in names.split("|") for each in _spread(part)]

    def write(folder: Path, log: Log) -> Path:
        columns = [_values(log, token) for token in values.split()]
        path = text(folder, titles, columns, **{"file": "log.csv", **how})
        if encoding:
            path.write_text(path.read_text(encoding="utf-8"), encoding=encoding)
        return path

    ALL[name] = Dialect(name, write, simulate(kind, seed=len(ALL) % 5), frozenset(sensors), tuple(answers), None,
                        tuple(must), rough)  # fmt: skip


def _spread(part: str) -> list[str]:
    for axes in ("xyz", "XYZ", "zyx", "zxy", "012", "123", "wxyz", "xyzw", "0123", "ENU", "uvw"):
        if f"{{{axes}}}" in part:
            return [part.replace(f"{{{axes}}}", axis) for axis in axes]
    return [part]


A, NONE, ASKED = ["accel"], [], ["asked"]
MT = "// General information:\n// MT Manager version: 2022.0\n// Update Rate: 100.0Hz\n// Filter Profile: General\n"

# --- inertial units
habit(
    "Xsens MT Manager: UTC, free acceleration and angles beside the sensors",
    "PacketCounter|SampleTimeFine|UTC_Nano|UTC_Year|UTC_Month|UTC_Day|UTC_Hour|UTC_Minute|UTC_Second|UTC_Valid|"
    "Acc_{XYZ}|FreeAcc_{ENU}|Gyr_{XYZ}|Mag_{XYZ}|Roll|Pitch|Yaw",
    "n t.fine rest.ns =2024 =5 =1 =13 =59 =50 =1 f lin w m.one angles",
    before=MT,
    sep="\t",
)
habit(
    "Xsens: VelInc and OriInc, increments alone",
    "PacketCounter|SampleTimeFine|VelInc_{XYZ}|OriInc_q{0123}",
    "n t.fine fdt q",
    sensors=A,
    before=MT,
    sep="\t",
)
habit(
    "Movella DOT: Euler and free acceleration",
    "PacketCounter|SampleTimeFine|Euler_{XYZ}|FreeAcc_{XYZ}|Status",
    "n t.us angles lin =0",
    sensors=NONE,
    must=ASKED,
)
habit(
    "Movella DOT: dq and dv",
    "PacketCounter|SampleTimeFine|dq_{wxyz}|dv[1]|dv[2]|dv[3]",
    "n t.us q fdt",
    sensors=NONE,
    must=ASKED,
)
habit(
    "MbientLab: a gyroscope's file",
    "epoc (ms)|timestamp (+0100)|elapsed (s)|{xyz}-axis (deg/s)",
    "t.ms+ iso t w.dps",
    sensors=["gyro"],
    must=ASKED,
    file="unit_Gyroscope_100.000Hz.csv",
)
habit(
    "Shimmer, raw channels",
    "Shimmer_D3A1_Timestamp_Unix_CAL|Shimmer_D3A1_Accel_WR_{XYZ}_RAW|Shimmer_D3A1_Gyro_{XYZ}_RAW",
    "t.ms+ f.16384 w.131",
    rough=0.03,
    after_names="\t".join(["ms", *["no_units"] * 6]) + "\n",
    sep="\t",
)
habit(
    "Epson: Gx dps, Ax mG",
    "Sample No.|G{xyz}(deg/s)|A{xyz}(mG)|Ts(deg.C)|Counter",
    "n w.dps f.mg T n",
    answers=["100"],
    must=["asked"],
)
habit(
    "Analog Devices: X_GYRO_OUT in counts",
    "DATA_CNTR|X_GYRO_OUT|Y_GYRO_OUT|Z_GYRO_OUT|X_ACCL_OUT|Y_ACCL_OUT|Z_ACCL_OUT|TEMP_OUT",
    "n w.10 f.800 =-12",
    answers=["100", "10 count/(deg/s)"],
    must=["asked"],
    rough=0.05,
)
habit(
    "x-io x-IMU: packets and no time",
    "Packet number|Gyroscope {XYZ} (deg/s)|Accelerometer {XYZ} (g)|Magnetometer {XYZ} (G)",
    "n w.dps f.g m.G",
    answers=["100"],
    must=["asked"],
)
habit(
    "SBG: units in brackets below the names",
    "timestamp|status|accel{XYZ}|gyro{XYZ}|temperature|deltaVel{XYZ}",
    "t.us =0 f w T f",
    after_names="\t".join(["(us)", "(na)", *["(m.s-2)"] * 3, *["(rad.s-1)"] * 3, "(degC)", *["(m.s-2)"] * 3]) + "\n",
    sep="\t",
)
habit(
    "Advanced Navigation: Unix Time and Microseconds",
    "Unix Time|Microseconds|Accelerometer {XYZ}|Gyroscope {XYZ}|Magnetometer {XYZ}|IMU Temperature",
    "whole.s rest.us f w.dps m.mG T",
)
habit("Inertial Sense: pqr[0], acc[0]", "time|pqr[{012}]|acc[{012}]", "t w f")
habit("VectorNav with two clocks", "TimeStartup [ns]|TimeGps|Accel{XYZ}|Gyro{XYZ}|Temp", "t.ns t.ns+ f w T")
habit(
    "Novatel's Inertial Explorer: GPSTime",
    "GPSTime (sec)|GyroX (deg/s)|GyroY (deg/s)|GyroZ (deg/s)|AccelX (m/s^2)|AccelY (m/s^2)|AccelZ (m/s^2)",
    "t w.dps f",
)
habit(
    "STIM300: G_X [deg/s], A_X [g], I_X",
    "time [s]|Gyro {XYZ} [deg/s]|Acc {XYZ} [g]|Inc {XYZ} [g]|Temp Gyro X [C]",
    "t w.dps f.g f.g T",
)
habit(
    "MicroStrain: HG1700 increments with rates",
    "Time|delta_theta_{xyz}|delta_v_{xyz}",
    "t wdt fdt",
    must=["read", "line", "asked"],
)

# --- boards and chips
habit(
    "ST Unico: no time",
    "A_{XYZ} [mg]|G_{XYZ} [dps]",
    "f.mg w.dps",
    before="STEVAL-MKI109V3\nLSM6DSOX\n\n",
    answers=["100"],
    must=["asked"],
    sep="\t",
)
habit("ST MEMS Studio", "time[us]|acc_{xyz}[mg]|gyro_{xyz}[dps]|temp[C]", "t.us f.mg w.dps T", sep="\t")
habit("ST HSDatalog", "Time|A_{xyz} [g]|G_{xyz} [mdps]", "t f.g w.mdps")
habit("Bosch BMI270, LSB", "Time stamp(us)|Acc_{xyz}(LSB)|Gyro_{xyz}(LSB)", "t.us f.8192 w.16_4", rough=0.03, sep=";")
habit(
    "BNO055 sketch with levels of calibration",
    "time_ms|accel_{xyz}|gyro_{xyz}|mag_{xyz}|q{wxyz}|sys|gyro|accel|mag",
    "t.ms f w.dps m q =3 =3 =1 =2",
)
habit(
    "BNO055: linear acceleration and gravity apart",
    "millis|lin_{xyz}|grav_{xyz}",
    "t.ms lin f",
    sensors=NONE,
    must=ASKED,
)
habit(
    "SparkFun OpenLog Artemis",
    "rtcDate|rtcTime|a{XYZ}|g{XYZ}|m{XYZ}|imu_degC|output_Hz",
    "=05/01/2024 hundredths f.mg w.dps m T =100.0",
    end=",",
)
habit("SparkFun Razor M0, no names", None, "t.ms f.g w.dps m", sep=", ")
habit(
    "M5Stack: no time", "acc{XYZ}|gyro{XYZ}|pitch|roll|yaw|temp", "f.g w.dps angles T", answers=["100"], must=["asked"]
)
habit("Arduino Nano 33: gestures without time", "a{XYZ}|g{XYZ}", "f.g w.dps", answers=["100"], must=["asked"])
habit(
    "micro:bit MakeCode: whole mg",
    "Time (seconds)|x|y|z",
    "t f.1024",
    sensors=A,
    answers=["count"],
    must=["asked"],
    rough=0.03,
)
habit("Sense HAT", "timestamp|yaw|pitch|roll|mag_{xyz}|accel_{xyz}|gyro_{xyz}|temp_h", "isoz angles m f.g w T")
habit(
    "Adafruit LSM6DSOX sketch with units behind the names",
    "Millis|Accel X m/s^2|Accel Y m/s^2|Accel Z m/s^2|Gyro X rad/s|Gyro Y rad/s|Gyro Z rad/s|Temp C",
    "t.ms f w T",
)
habit("Crazyflie: acc.x and gyro.x", "timestamp|acc.{xyz}|gyro.{xyz}|stabilizer.roll", "t.ms f.g w.dps lin1")
habit(
    "WitMotion with its start above",
    "address|Time(s)|ChipTime|a{xyz}(g)|w{xyz}(deg/s)|Angle{XYZ}(deg)|T(°)",
    "=0x50 clock us.date f.g w.dps angles T",
    before="StartTime: 2024-05-01 13:59:50.000\n",
    sep="\t",
)
habit("a column dt and no time", "dt|ax|ay|az|gx|gy|gz", "dt f w", answers=["100"], must=["asked", "line"])

# --- phones and watches
habit("phyphox in French", '"Temps (s)"|"Accélération {xyz} (m/s^2)"|"Gyroscope {xyz} (rad/s)"', "t f w", sep=";")
habit(
    "phyphox in Spanish",
    '"Tiempo (s)"|"Aceleración {xyz} (m/s^2)"|"Giroscopio {xyz} (rad/s)"',
    "t f w",
    sep=";",
    decimal=",",
)
habit(
    "Sensor Logger, Accelerometer.csv without gravity",
    "time|seconds_elapsed|z|y|x",
    "t.ns+ t ~lin",
    sensors=NONE,
    must=ASKED,
    file="Accelerometer.csv",
)
habit(
    "Sensor Logger, AccelerometerUncalibrated.csv",
    "time|seconds_elapsed|z|y|x",
    "t.ns+ t ~f",
    sensors=A,
    file="AccelerometerUncalibrated.csv",
)
habit(
    "Sensor Logger, AccelerometerUncalibrated.csv in g",
    "time|seconds_elapsed|z|y|x",
    "t.ns+ t ~f.g",
    sensors=A,
    file="AccelerometerUncalibrated.csv",
)
habit(
    "Sensor Logger, WatchMotion: gravity, user acceleration, rate",
    "time|seconds_elapsed|rotationRate{XYZ}|gravity{XYZ}|accelerationX|accelerationY|accelerationZ|quaternion{wxyz}",
    "t.ns+ t w f.g lin q",
    sensors=NONE,
    must=ASKED,
)
habit(
    "SensorLog for iOS, no units",
    "loggingTime|loggingSample|accelerometerTimestamp_sinceReboot|"
    "accelerometerAcceleration{XYZ}|gyroTimestamp_sinceReboot|gyroRotation{XYZ}",
    "isotz n t f.g t w",
)
habit(
    "a browser's DeviceMotion: alpha, beta, gamma",
    "timestamp|acceleration.{xyz}|accelerationIncludingGravity.{xyz}|"
    "rotationRate.alpha|rotationRate.beta|rotationRate.gamma|interval",
    "t.ms+ lin f >w.dps =16",
)
habit("acceleration with and without gravity", "t|acc_with_gravity_{xyz}|acc_no_g_{xyz}|gyro_{xyz}", "t f lin w")
habit("G-Force", "Time|G-Force {XYZ}|Gyro {XYZ}", "t f.g w")
habit("raw and calibrated side by side", "t|Acc_{xyz}_raw|Acc_{xyz}_cal|Gyro_{xyz}_cal", "t f.100 f w.dps")
habit("names of pandas for doubled columns", "t|X|Y|Z|X.1|Y.1|Z.1", "t f w")
habit("vectors in cells: brackets", "t|acc|gyro [dps]", "t f[] w[]")
habit("vectors in cells: bars", "t|acc|gyro [dps]", "t f|| w||")
habit(
    "Apple CoreMotion: attitude, rotation rate, gravity, user acceleration",
    "timestamp|attitude.roll|attitude.pitch|attitude.yaw|rotationRate.{xyz}|gravity.{xyz}|userAcceleration.{xyz}",
    "t angles w f.g lin",
    sensors=NONE,
    must=ASKED,
)
habit("Physics Toolbox: linear accelerometer", "time|a{xyz}|aT (m/s^2)", "t lin lin1", sensors=NONE, must=ASKED)
habit("HyperIMU", "Timestamp|bmi160_accelerometer.{xyz}|bmi160_gyroscope.{xyz}", "t.ms+ f w")
habit(
    "Sensor Kinetics",
    "time|X_value|Y_value|Z_value",
    "t f",
    sensors=A,
    file="Accelerometer Sensor.csv",
    before="# Sensor: accelerometer; units m/s^2\n",
)
habit("RealWorld: attr_time, attr_x", "id|attr_time|attr_{xyz}", "n t.ms+ f", sensors=A, file="acc_walking.csv")
habit(
    "HHAR: Index, Arrival_Time, Creation_Time",
    "Index|Arrival_Time|Creation_Time|{xyz}|User|Model|Device|gt",
    "n t.ms+ t.ns f =a =nexus4 =nexus4_1 =stand",
    sensors=A,
    file="Phones_accelerometer.csv",
)
habit("Myo: microseconds since 1970", "timestamp|{xyz}", "t.us+ f.g", sensors=A, file="accelerometer-1456704054.csv")
habit(
    "Vernier Graphical Analysis",
    "Data Set 1:Time(s)|Data Set 1:X-axis acceleration(m/s²)|"
    "Data Set 1:Y-axis acceleration(m/s²)|Data Set 1:Z-axis acceleration(m/s²)|Data Set 1:X-axis gyro(rad/s)|"
    "Data Set 1:Y-axis gyro(rad/s)|Data Set 1:Z-axis gyro(rad/s)",
    "t f w",
)
habit(
    "PASCO: the run behind the unit",
    "Time (s) Run #1|Acceleration - x (m/s²) Run #1|"
    "Acceleration - y (m/s²) Run #1|Acceleration - z (m/s²) Run #1|Angular Velocity - x (rad/s) Run #1|"
    "Angular Velocity - y (rad/s) Run #1|Angular Velocity - z (rad/s) Run #1",
    "t f w",
)
habit(
    "PocketLab",
    "Timestamp (Local)|Time (s)|Acceleration {XYZ} (g)|Acceleration Scalar (g)|"
    "Angular Velocity {XYZ} (°/s)|Magnetic Field {XYZ} (µT)",
    "us.date t f.g norm w.dps m",
)

# --- people who move
habit("Axivity AX6, no names", None, "us.date f.g w.dps", must=["read", "line"])
habit("Axivity cwa-convert: d/s", "Time|Accel-{XYZ} (g)|Gyro-{XYZ} (d/s)|Temperature (C)", "clock f.g w.dps T")
habit(
    "ActiGraph GT9X: accelerometer, temperature, gyroscope",
    "Timestamp|Accelerometer {XYZ}|Temperature|Gyroscope {XYZ}|Magnetometer {XYZ}",
    "iso f.g T w.dps m",
    before="------------ Data File Created By ActiGraph GT9X Link ActiLife v6.13.3 at 100 Hz  Filter Normal ----\n"
    "Serial Number: TAS1D\nStart Time 13:59:50\n--------------------------------------------------\n",
)
habit(
    "APDM, CSV",
    "Time|Accelerometer {XYZ} (m/s^2)|Gyroscope {XYZ} (rad/s)|Magnetometer {XYZ} (uT)|Temperature (C)",
    "t.us+ f w m T",
    must=["read", "line", "asked"],
    answers=["us"],
)
habit(
    "Noraxon: mG under the names of segments",
    "time|Pelvis Accel Sensor {XYZ} (mG)|Pelvis Gyroscope {XYZ} (deg/s)",
    "t f.mg w.dps",
)
habit(
    "Noraxon: segments and mG without a sensor's word",
    "time|Foot LT {XYZ} (mG)",
    "t f.mg",
    sensors=A,
    must=["read", "line"],
)
habit(
    "Delsys: X[s] before accelerometer and gyroscope",
    "X[s]|Avanti 1: ACC.X 1[g]|X[s]|Avanti 1: ACC.Y 1[g]|X[s]|"
    "Avanti 1: ACC.Z 1[g]|X[s]|Avanti 1: GYRO.X 1[deg/sec]|X[s]|Avanti 1: GYRO.Y 1[deg/sec]|X[s]|"
    "Avanti 1: GYRO.Z 1[deg/sec]",
    "t fx.g t fy.g t fz.g t wx t wy t wz",
)
habit(
    "Catapult: forward, side, up",
    "Timestamp|Seconds|Velocity|Acceleration|Acceleration.forward|Acceleration.side|"
    "Acceleration.up|Rotation.roll|Rotation.pitch|Rotation.yaw",
    "clock t lin1 lin1 f.g w.dps",
)
habit(
    "Vicon Nexus: Frame, Sub Frame",
    "Frame|Sub Frame|ACC_{XYZ}|GYRO_{XYZ}",
    "n =0 f.g w.dps",
    before="Devices\n100\n",
    after_names=",,g,g,g,deg/s,deg/s,deg/s\n",
    answers=["100"],
    must=["asked"],
)
habit(
    "GoPro telemetry: z, x, y with ms",
    '"cts"|"date"|"Accelerometer ({zxy}) [m/s²]"|"temperature [°C]"',
    "t.ms isoz >f T",
    sensors=A,
)
habit("GENEActiv-like, temperature of 70 °C", "time [s]|acc_{xyz} [g]|Temperatur [°C]", "t f.g T.hot", sensors=A)

# --- flight
habit(
    "Betaflight blackbox in units",
    "loopIteration| time (us)| gyroADC[{012}] (deg/s)| gyroUnfilt[{012}] (deg/s)| accSmooth[{012}] (g)",
    "n t.us w.dps w.dps f.g",
    sep=", ",
)
habit(
    "Betaflight blackbox explorer",
    '"loopIteration"|"time"|"gyroADC[{012}]"|"accSmooth[{012}]"|"motor[{0123}]"',
    "n t.us w.1 f.2048 =1000 =1001 =1002 =1003",
    rough=0.05,
    before='"Product","Blackbox flight data recorder"\n"acc_1G",2048\n"looptime",10000\n',
)
habit(
    "INAV blackbox: attitude[0] in tenths",
    "loopIteration|time (us)|gyroADC[{012}]|accSmooth[{012}]|attitude[{012}]|baroTemperature",
    "n t.us w.1 f.512 angles =31",
    rough=0.05,
)
habit(
    "mavlogdump, IMU",
    "timestamp|TimeUS|I|Gyr{XYZ}|Acc{XYZ}|EG|EA|T|GH|AH|GHz|AHz",
    "t.+ t.us =0 w f =0 =0 T =1 =1 =1000 =1000",
)
habit(
    "ulog2csv, sensor_accel",
    "timestamp|timestamp_sample|device_id|{xyz}|temperature|error_count|clip_counter[{012}]|samples",
    "t.us t.us =3670026 f T =0 zero =1",
    sensors=A,
    file="log_sensor_accel_0.csv",
)
habit(
    "ulog2csv, vehicle_imu: increments",
    "timestamp|timestamp_sample|accel_device_id|gyro_device_id|"
    "delta_angle[{012}]|delta_velocity[{012}]|delta_angle_dt|delta_velocity_dt",
    "t.us t.us =1 =2 wdt fdt =10000 =10000",
    sensors=NONE,
    must=ASKED,
)
habit(
    "old PX4: x, x_raw and scaling",
    "Timestamp|Error_count|{xyz}|temperature|range_m_s2|scaling|{xyz}_raw|temperature_raw",
    "t.us =0 f T =78.4 =0.0024 f.4096 =30",
    sensors=A,
    file="RawAccel.csv",
)
habit(
    "Tello: agx in cm/s²",
    "time_ms|pitch|roll|yaw|vg{xyz}|ag{xyz}|temph",
    "t.ms angles lin f.cm T",
    sensors=A,
    must=["asked", "unanswerable"],
)

# --- robots and data sets
habit("Kalibr bag extractor", "timestamp|omega_{xyz}|alpha_{xyz}", "t.ns+ w f")
habit("UZH-FPV: lin_acc_x holds gravity", "# id timestamp|ang_vel_{xyz}|lin_acc_{xyz}", "n t.+ w f", sep=" ")
habit("event camera data: no names, blanks", None, "t f w", sep=" ")
habit("4Seasons: nanoseconds, blanks, gyroscope first", None, "t.ns+ w f", sep=" ")
habit("NCLT: magnetometer first, no names", None, "t.us+ m.G f w")
habit(
    "Complex Urban: attitude, angles, rates, forces, field, no names",
    None,
    "t.ns+ qxyz angles w f m.G",
    must=["line", "asked"],
)
habit("KITTI-like: two accelerometers without names", None, "angles lin f f w w", sep=" ", must=["unanswerable"])
habit("ADVIO: accelerometer.csv without names", None, "t f", sensors=A, file="accelerometer.csv")
habit(
    "PAMAP2-like: activity, heart rate, two accelerometers, no names",
    None,
    "t =1 =100 T f f w m",
    sep=" ",
    must=["unanswerable"],
)
habit(
    "bagpy",
    "Time|header.seq|header.stamp.secs|header.stamp.nsecs|header.frame_id|orientation.{xyzw}|"
    "angular_velocity.{xyz}|linear_acceleration.{xyz}",
    "t.+ n whole.s rest.ns =imu qxyz w f",
)
habit(
    "PlotJuggler",
    "__time|/imu/data/angular_velocity/{xyz}|/imu/data/linear_acceleration/{xyz}|/imu/data/orientation/{xyzw}",
    "t.+ w f qxyz",
)
habit("Foxglove", "timestamp|topic|angular_velocity.{xyz}|linear_acceleration.{xyz}", "t.ns+ =/imu w f")
habit(
    "InfluxDB: annotated CSV",
    "|result|table|_time|ax|ay|az|gx|gy|gz",
    "= = =0 isoz f w",
    before="#group,false,false,false,false,false,false,false,false,false\n"
    "#datatype,string,long,dateTime:RFC3339,double,double,double,double,double,double\n"
    "#default,_result,,,,,,,,\n",
)
habit("Grafana", '"Time"|"accel_{xyz}"|"gyro_{xyz}"', "isotz f w")
habit("linear_acceleration_x that holds gravity", "time|linear_acceleration_{xyz}|angular_velocity_{xyz}", "t f w")
habit("raw_acceleration_x_gs", "ms|raw_acceleration_{xyz}_gs|raw_rotation_{xyz}_dps", "t.ms f.g w.dps")
habit("w_x and a_x", "seconds|w_{xyz}|a_{xyz}", "t w f")
habit(
    "a state with biases",
    "t|p_{xyz}|q_{wxyz}|v_{xyz}|bw_{xyz}|ba_{xyz}",
    "t lin q lin lin lin",
    sensors=NONE,
    must=ASKED,
)
habit("quaternions beside sensors", "us|acc_{xyz}|gyr_{xyz}|quat_{wxyz}", "t.us f w.dps q")
habit("small rates at rest in rad/s", "t [s]|acc_{xyz}|gyro_{xyz} [rad/s]", "t f w", kind="rest")

# --- time
habit("cells of 0.02 sec", "time|ax [g]|ay [g]|az [g]", "sec f.g", sensors=A)
habit("date and time in two columns", "Date|Time|acc_{xyz} [g]|gyr_{xyz} [dps]", "=2024-05-01 clock f.g w.dps")
habit(
    "time of day in whole seconds, ms beside it",
    "Time|ms|acc_{xyz} [g]|gyr_{xyz} [dps]",
    "hms rest.ms f.g w.dps",
    must=["read", "line", "asked"],
    answers=["100"],
)
habit("sec and usec", "sec|usec|acc_{xyz} [g]|gyr_{xyz} [dps]", "whole.s rest.us f.g w.dps")
habit("tv_sec and tv_usec", "tv_sec|tv_usec|ax [g]|ay [g]|az [g]", "whole.s rest.us f.g", sensors=A)
habit("epoch in seconds", "epoch|ax|ay|az|gx|gy|gz", "t.+ f w")
habit("epoch in ms, no names", None, "t.ms+ f w")
habit("epoch in us, units", "unix_us|ax [m/s^2]|ay [m/s^2]|az [m/s^2]", "t.us+ f", sensors=A)
habit("a time zone", "time|ax [g]|ay [g]|az [g]", "isotz f.g", sensors=A)
habit("midnight passes", "time|ax [g]|ay [g]|az [g]", "midnight f.g", sensors=A)

# --- laboratories and offices
habit(
    "LabVIEW .lvm",
    "X_Value|Accel {XYZ} (g)|Gyro {XYZ} (deg/s)|Comment",
    "t f.g w.dps =",
    before="LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\nDecimal_Separator\t.\n***End_of_Header***\t\n\t\n"
    "Channels\t6\nSamples\t4000\t4000\nX_Dimension\tTime\tTime\nDelta_X\t0.010000\t0.010000\n***End_of_Header***\n",
    file="log.lvm",
    sep="\t",
)
habit(
    "Excel in German: Latin-1, semicolons, decimal commas",
    "Zeit [s]|Beschl. {XYZ} [m/s²]|Drehrate {XYZ} [°/s]",
    "t f w.dps",
    sep=";",
    decimal=",",
    encoding="latin-1",
)
habit(
    "TDMS as text",
    "Time (s);Untitled/Accel X (g);Untitled/Accel Y (g);Untitled/Accel Z (g)".replace(";", "|"),
    "t f.g",
    sensors=A,
    sep=";",
    decimal=",",
)
habit("Russian names and units", "Время (с)|Ускорение {XYZ} (м/с²)|Угловая скорость {XYZ} (рад/с)", "t f w", sep=";")
habit("Japanese names", "時間(s)|加速度{XYZ}(m/s2)|角速度{XYZ}(rad/s)|温度(℃)", "t f w T")
habit(
    "m·s⁻² and rad·s⁻¹", "t (s)|a_x (m·s⁻²)|a_y (m·s⁻²)|a_z (m·s⁻²)|ω_x (rad·s⁻¹)|ω_y (rad·s⁻¹)|ω_z (rad·s⁻¹)", "t f w"
)
habit("m s^-2 and deg s^-1", "t [s]|acc_{xyz} [m s^-2]|gyr_{xyz} [deg s^-1]", "t f w.dps")
