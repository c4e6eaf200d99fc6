"""How a log was read is part of the calibration: the next log is read alike, and exports are for the raw log's axes.

Each tool's own equation is written here from its documentation, and applied to what the logger wrote.
"""

import itertools
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from sample_logs import RAW, write_ulog

from jaximu.calibration import Calibration, calibrate, compensate, load_calibration
from jaximu.cli import main
from jaximu.diagnosis import check
from jaximu.estimation.problem import names_of
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import LocalGravity
from jaximu.model.effects import CATALOGUE
from jaximu.model.sensor import Imu, Triad
from jaximu.recordings import write_recording
from jaximu.recordings.readers import ReadOptions, read_magnetometer, read_recording
from jaximu.recordings.recording import Reading, Recording, Signal, apply_axes, axis_matrix, parse_axes, spelled_axes
from jaximu.report.export import ExportedUnit, Range, export, losses
from jaximu.report.export.catalogue import writer
from jaximu.report.export.thermal_autopilot import px4_parameters
from jaximu.simulation import consumer_noise, simulate
from jaximu.simulation.protocols import HandHeld

G = 9.80665
random = np.random.default_rng(7)
GAIN_A, GAIN_G = (np.eye(3) + random.normal(0, 0.02, (3, 3)) for _ in range(2))
BIAS_A, BIAS_G = np.array([0.11, -0.26, 0.53]), np.array([-0.009, 0.015, -0.017])
SENSITIVE = CATALOGUE["gyro.g_sensitivity"].make(random.normal(0, 1e-4, 9))
DIAGONAL = np.diag([1.01, 0.98, 1.03]), np.eye(3)
"""Gains of which an autopilot's parameters, a scale an axis and none of the gyroscope, lose nothing."""


def signed(axes: tuple[int, ...], signs: tuple[int, ...]) -> str:
    return ",".join("-" * (sign < 0) + "xyz"[axis] for axis, sign in zip(axes, signs, strict=True))


ROTATIONS = [
    text
    for axes in itertools.permutations(range(3))
    for signs in itertools.product((1, -1), repeat=3)
    if np.linalg.det(axis_matrix(text := signed(axes, signs))) > 0
]
"""All 24 right-handed maps from a logger's axes to the body's."""
FRD = np.diag([1.0, -1.0, -1.0])

# what a logger does, and the axes in which the one right-handed answer is: the body's, as an --axes map of the answer's
MIRRORED = {
    "-f": "x,y,z",
    "FRD;-f": "x,-y,-z",
    "y,-x,z;-f": "y,-x,z",
    "accel=x,y,-z;gyro=-x,-y,z": "-x,-y,z",  # left-handed throughout: rates by the right hand are minus the forces' map
    "accel=-x,y,z": "x,y,z",
    "gyro=y,-x,z": "x,y,z",
    "accel=-y,x,z;gyro=x,-y,-z": "x,y,z",
    "accel=z,y,x;gyro=x,z,y": "x,y,z",
}


def unit(axes: str | None, *effects, gains=(GAIN_A, GAIN_G), frame: str | None = None, known: bool = True):
    imu = Imu(Triad(gains[0], BIAS_A), Triad(gains[1], BIAS_G, quantity="angular_rate", output_unit="rad/s"))
    names = names_of(imu)
    reading = Reading(axes=axes, frame=frame, units={"accelerometer": "m/s^2", "gyroscope": "rad/s"})
    return Calibration(
        imu=imu.with_effects(*effects), names=names, covariance=np.diag(np.linspace(1e-8, 2e-8, len(names))),
        gravity=LocalGravity(G, 0.0), method="joint", loss="linear", rms={}, rank=24, weak=(), excess={}, solver="",
        data={"rate": 200.0}, reading=reading if known else None,
    )  # fmt: skip


def logged(calibration: Calibration, axes: str | None) -> tuple[np.ndarray, ...]:
    """True specific force and rate in the body frame (n, 3), and both as the logger writes them: y_body = A y_log.

    The first rows are rests with each axis up.
    """
    draws = np.random.default_rng(3)
    force = np.vstack([G * np.eye(3), -G * np.eye(3), draws.normal(0, 6, (20, 3))])
    rate = draws.normal(0, 2, (26, 3)) * (np.arange(26) > 5)[:, None]
    triads, maps = calibration.imu.with_effects().triads(), parse_axes(axes or "FLU")
    accel, gyro = triads["accelerometer"], triads["gyroscope"]
    sensitive = SENSITIVE.coefficients.reshape(3, 3) if calibration.imu.gyroscope.effects else np.zeros((3, 3))
    return (
        force, rate, (force @ np.asarray(accel.gain).T + accel.bias) @ maps["accelerometer"],
        (rate @ np.asarray(gyro.gain).T + gyro.bias + force @ sensitive.T) @ maps["gyroscope"],
    )  # fmt: skip


# --- each tool's own equation, from its documentation: outputs (n, 3) in, corrected (n, 3) out


def yaml(content: bytes) -> dict:
    ruamel = pytest.importorskip("ruamel.yaml")
    return ruamel.YAML(typ="safe").load(content.decode().removeprefix("%YAML:1.0"))


def numbers(text: str) -> np.ndarray:
    return np.array([float(each) for each in re.findall(r"-?\d+\.?\d*(?:e[+-]?\d+)?", text)])


def ros_yaml(files, y_a, y_g):
    triads = yaml(files[""])["/**"]["ros__parameters"]["imu_calibration"]
    accel, gyro = triads["accelerometer"], triads["gyroscope"]
    force = (y_a - np.array(accel["bias"])) @ np.reshape(accel["matrix"], (3, 3)).T
    sensitive = force @ np.reshape(gyro.get("g_sensitivity", [0] * 9), (3, 3)).T
    return force, (y_g - np.array(gyro["bias"]) - sensitive) @ np.reshape(gyro["matrix"], (3, 3)).T


def c_header(files, y_a, y_g):
    """The double precision lines of the header: d = y - b, u = row · d."""
    made = []
    for name, y in (("accelerometer", y_a), ("gyroscope", y_g)):
        body = re.search(rf"jaximu_{name}\(const double.*?\n}}", files[""].decode(), re.DOTALL)[0]
        offset = [numbers(each)[0] for each in re.findall(r"y\[\d\] - \((.*?)\)", body)]
        rows = [[numbers(each)[0] for each in re.findall(r"\((.*?)\) \* d", line)] for line in body.splitlines()
                if line.lstrip().startswith("u[")]  # fmt: skip
        made.append((y - offset) @ np.array(rows).T)
    return made


def csv(files, y_a, y_g):
    table: dict[tuple[str, str], np.ndarray] = {}
    for line in files[""].decode().splitlines()[1:]:
        triad, name, row, column, value, *_ = line.split(",")
        table.setdefault((triad, name), np.zeros((3, 3)))[int(row or 0), int(column or 0)] = float(value)
    return [
        (y - table[name, "bias"][:, 0]) @ table[name, "inverse_gain"].T
        for name, y in (("accelerometer", y_a), ("gyroscope", y_g))
    ]


def npz(files, y_a, y_g):
    import io

    with np.load(io.BytesIO(files[""])) as kept:
        return [
            (y - kept[f"{name}_bias"]) @ kept[f"{name}_inverse_gain"].T
            for name, y in (("accelerometer", y_a), ("gyroscope", y_g))
        ]


def realsense(files, y_a, y_g):
    """rs-imu-calibration.py: corrected = [y, −1]·X."""
    (imu,) = json.loads(files[""])["imus"]
    return [
        np.column_stack([y, -np.ones(len(y))]) @ np.reshape(imu[n]["scale_and_alignment"] + imu[n]["bias"], (4, 3))
        for n, y in (("accelerometer", y_a), ("gyroscope", y_g))
    ]


def imu_tk(files, y_a, y_g):
    """unbiasNormalize: mis_mat · scale_mat · (y − bias)."""
    made = []
    for ending, y in (("_acc", y_a), ("_gyro", y_g)):
        each = np.array(files[ending].decode().split(), float)
        made.append((y - each[18:]) @ (each[:9].reshape(3, 3) @ each[9:18].reshape(3, 3)).T)
    return made


def fusion(files, y_a, y_g):
    """FusionCalibrationInertial: misalignment · (sensitivity ∘ (y − offset)), in g and deg/s."""
    kept = {name: numbers(row) for name, row in re.findall(r"(\w+) = \{(.*)\};", files[""].decode())}
    made = [
        kept[f"{n}Sensitivity"] * (y - kept[f"{n}Offset"]) @ kept[f"{n}Misalignment"].reshape(3, 3).T
        for n, y in (("accelerometer", y_a), ("gyroscope", y_g))
    ]
    return made[0] * 9.80665, np.radians(made[1])


def kalibr(files, y_a, y_g):
    """y_a = M_a f + b_a, y_g = M_g C ω + A (C f) + b_g."""
    imu = yaml(files[""])["imu0"]
    accel, gyro = imu["accelerometers"], imu["gyroscopes"]
    matrix, rotation, sensitive = (np.array(gyro[key]) for key in ("M", "C_gyro_i", "A"))
    force = np.linalg.solve(accel["M"], (y_a - np.array(accel["bias"])).T)
    return force.T, (
        rotation.T @ np.linalg.solve(matrix, (y_g - np.array(gyro["bias"])).T - sensitive @ rotation @ force)
    ).T


def openvins(files, y_a, y_g):
    """ω = R_IMUtoGYROᵀ Tw⁻¹ (y_g − b_g − Tg a), a = R_IMUtoACCᵀ Ta⁻¹ (y_a − b_a); the filter finds the biases."""
    content = files[""].decode()
    bias = [numbers(re.search(rf"{name} bias (\[.*?\])", content)[1]) for name in ("accelerometer", "gyroscope")]
    imu = {key: np.array(each) for key, each in yaml(files[""])["imu0"].items() if isinstance(each, list)}
    force = imu["R_IMUtoACC"].T @ np.linalg.solve(imu["Ta"], (y_a - bias[0]).T)
    rate = np.linalg.solve(imu["Tw"], (y_g - bias[1]).T - imu["Tg"] @ force)
    return force.T, (imu["R_IMUtoGYRO"].T @ rate).T


def px4(files, y_a, y_g):
    """Accelerometer.hpp: (data − offset).emult(scale); Gyroscope.hpp: data − offset."""
    rows = [line.split("\t") for line in files[""].decode().splitlines() if not line.startswith("#")]
    kept = {row[2]: float(row[3]) for row in rows}
    offset, scale, zero = ([kept[f"CAL_{stem}_{axis}{word}"] for axis in "XYZ"]
                           for stem, word in (("ACC0", "OFF"), ("ACC0", "SCALE"), ("GYRO0", "OFF")))  # fmt: skip
    return (y_a - offset) * scale, y_g - zero


def ardupilot(files, y_a, y_g):
    """_rotate_and_correct_accel: accel −= offset; accel ∘= scale; gyro −= offset."""
    rows = [line.split(",") for line in files[""].decode().splitlines() if not line.startswith("#")]
    kept = {name: float(value) for name, value in rows}
    offset, scale, zero = ([kept[f"{stem}_{axis}"] for axis in "XYZ"]
                           for stem in ("INS_ACCOFFS", "INS_ACCSCAL", "INS_GYROFFS"))  # fmt: skip
    return (y_a - offset) * scale, y_g - zero


TOOLS = {"ros-yaml": ros_yaml, "c-header": c_header, "csv": csv, "npz": npz, "realsense": realsense, "imu_tk": imu_tk,
         "fusion": fusion, "kalibr": kalibr, "openvins": openvins}  # fmt: skip
SENSITIVE_TOOLS = ("ros-yaml", "kalibr", "openvins")
AUTOPILOTS = {"px4": px4, "ardupilot": ardupilot}


def answers(to: str, calibration: Calibration, *outputs: np.ndarray) -> list[np.ndarray]:
    parameters = ExportedUnit.of(calibration)
    written = writer(to).write(parameters)
    lost = losses(parameters, written, Range.of(calibration))  # reckoned in the same axes, it finds nothing but these
    assert all("uncertainty" in each.what for each in lost) or (
        to == "openvins" and lost[0].worst["accelerometer"] < 0.7
    )
    return [np.asarray(each) for each in (TOOLS | AUTOPILOTS)[to](written.files, *outputs)]


def close(one: np.ndarray, other: np.ndarray) -> None:
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-9)


def same_body(to: str, force: np.ndarray, rate: np.ndarray, truth: tuple[np.ndarray, np.ndarray]) -> None:
    """Kalibr's kind has a body frame of its own, turned by the accelerometer's misalignment alone; others have none."""
    turn = np.linalg.lstsq(force, truth[0], rcond=None)[0] if to in ("kalibr", "openvins") else np.eye(3)
    close(turn @ turn.T, np.eye(3))
    assert np.linalg.det(turn) > 0
    close(force @ turn, truth[0])
    close(rate @ turn, truth[1])


@pytest.mark.parametrize("to", TOOLS)
@pytest.mark.parametrize("axes", ROTATIONS)
def test_exports_hold_for_the_raw_log_in_every_orientation(axes, to):
    calibration = unit(axes, *([SENSITIVE] if to in SENSITIVE_TOOLS else []))
    force, rate, *outputs = logged(calibration, axes)
    matrix = axis_matrix(axes)  # body = A log, so the answer in the log's axes is Aᵀ of that in the body's
    same_body(to, *answers(to, calibration, *outputs), (force @ matrix, rate @ matrix))
    if to not in ("kalibr", "openvins"):
        up = answers(to, calibration, *outputs)[0][2]  # the rest with the body's z up
        close(axis_matrix(axes) @ up, np.array([0, 0, G]))


@pytest.mark.parametrize("to", TOOLS)
@pytest.mark.parametrize("axes", MIRRORED)
def test_exports_of_mirrored_loggers_answer_in_right_handed_axes_or_are_refused(axes, to):
    calibration = unit(axes)
    force, rate, *outputs = logged(calibration, axes)
    turn = axis_matrix(MIRRORED[axes])
    maps = {name: parse_axes(axes)[name].T @ turn for name in ("accelerometer", "gyroscope")}
    rotated = all(np.linalg.det(each) > 0 for each in maps.values())
    straight = all(np.diagonal(each).all() for each in maps.values())
    possible = rotated if to in ("kalibr", "openvins") else straight if to in ("imu_tk", "fusion") else True
    if not possible:
        with pytest.raises(NotPossibleError, match="c-header"):
            answers(to, calibration, *outputs)
        return
    if rotated and to in ("kalibr", "openvins"):  # axes of its own, nearest to the accelerometer's
        made = answers(to, calibration, *outputs)
        turn = np.linalg.lstsq(made[0], force, rcond=None)[0]
        assert np.linalg.det(turn) > 0
        return close(made[1] @ turn, rate)
    same_body(to, *answers(to, calibration, *outputs), (force @ turn, rate @ turn))


def test_mirrored_loggers_are_expressed_by_most_tools():
    """What the refusals above leave: matrices take all of them, tools of one scale an axis the loggers of −f."""
    for to, fewest in (("ros-yaml", 8), ("imu_tk", 5), ("fusion", 5), ("kalibr", 2)):
        made = 0
        for axes in MIRRORED:
            try:
                made += bool(writer(to).write(ExportedUnit.of(unit(axes))).files)
            except NotPossibleError:
                continue
        assert made == fewest, to


@pytest.mark.parametrize("to", AUTOPILOTS)
@pytest.mark.parametrize("axes", [*ROTATIONS, *MIRRORED, None])
def test_autopilots_have_their_own_axes(axes, to):
    """Whatever the logger: the body is forward, left, up, and the autopilot's own outputs forward, right, down."""
    calibration = unit(axes, gains=DIAGONAL)
    force, rate, *_ = logged(calibration, None)
    _, _, accel, gyro = logged(calibration, "FRD")  # what the autopilot has of the same sensor
    made = answers(to, calibration, accel, gyro)
    close(made[0], force @ FRD)
    close(made[1], rate @ FRD)
    close(made[0][2], np.array([0, 0, -G]))  # the body's z up: down is against it


@pytest.mark.parametrize("to", AUTOPILOTS)
@pytest.mark.parametrize("axes", [*ROTATIONS, None])
def test_an_autopilots_own_log_is_in_its_axes_already(axes, to):
    calibration = unit(axes, gains=DIAGONAL, frame="FRD")
    force, rate, *outputs = logged(calibration, axes)
    made = answers(to, calibration, *outputs)
    matrix = axis_matrix(axes or "FLU")
    close(made[0], force @ matrix)
    close(made[1], rate @ matrix)


def test_an_export_says_whose_axes_it_has(tmp_path, capsys):
    path = tmp_path / "calibration.json"
    for axes, frame, to, words in (
        ("FRD", None, "ros-yaml", "the log's own (it was read with --axes FRD)."),
        (None, None, "csv", "the log's own."),
        ("-f", None, "c-header", "minus specific force"),
        ("gyro=y,-x,z", None, "npz", "answers in the calibration's body axes"),
        ("FRD", None, "px4", "forward, right, down, with the calibration's body axes taken as forward, left, up"),
        ("FRD", "FRD", "ardupilot", "forward, right, down, as the log has them."),
    ):
        unit(axes, frame=frame).save(path)
        assert main(["export", str(path), "--to", to]) == 0
        assert "\nAxes: " in capsys.readouterr().out
        assert main(["export", str(path), "--to", to, "--json"]) == 0
        document = json.loads(capsys.readouterr().out)
        assert words in document["axes"]
        if to not in ("csv", "npz"):
            content = (tmp_path / f"calibration_{to}{writer(to).SUFFIX}").read_text()
            assert document["axes"] in content.splitlines()[0]


def test_export_axes_that_contradict_are_refused_and_equal_ones_taken(tmp_path, capsys):
    path = tmp_path / "calibration.json"
    unit("FRD").save(path)
    assert main(["export", str(path), "--to", "csv", "--axes", "FLU"]) == 2
    assert re.search(r"axes FLU contradict .* axes FRD", capsys.readouterr().err)
    assert [each.name for each in tmp_path.iterdir()] == ["calibration.json"]
    assert main(["export", str(path), "--to", "csv", "--axes", "x,-y,-z"]) == 0
    unit(None).save(path)
    assert main(["export", str(path), "--to", "csv", "--axes", "FRD"]) == 2
    assert "axes as they are" in capsys.readouterr().err


@pytest.mark.parametrize("to", ["ros-yaml", "px4"])
def test_a_file_without_reading_is_exported_as_before(tmp_path, to):
    """Its axes are those of the log, or those that --axes of `export` undoes; an autopilot's file has them, too."""
    old = unit("FRD", gains=DIAGONAL, known=False)
    old.save(tmp_path / "calibration.json")
    assert "reading" not in json.loads((tmp_path / "calibration.json").read_text())
    old = load_calibration(tmp_path / "calibration.json")
    assert old.reading is None
    for axes in (None, "FRD", "y,-x,z"):
        force, rate, *outputs = logged(old, axes)
        written = writer(to).write(ExportedUnit.of(old, axes))
        made = (TOOLS | AUTOPILOTS)[to](written.files, *outputs)
        close(made[0], force @ axis_matrix(axes or "FLU"))
        close(made[1], rate @ axis_matrix(axes or "FLU"))
    assert "does not say" in ExportedUnit.of(old).axes


def test_a_cubic_for_px4_is_in_its_axes():
    """What `thermal --to px4` writes: of each axis X, Y, Z what temperature adds to the autopilot's own output."""
    effect = CATALOGUE["accel.temperature"].make([0.01, 0.02, -0.03])
    whole = {
        axes: px4_parameters(
            replace(unit("FRD", effect, gains=DIAGONAL, known=axes), data={"temperature_range": [0.0, 50.0]})
        ).parameters
        for axes in (True, False)
    }
    for axis, sign in enumerate((1, -1, -1)):
        key = f"TC_A0_X1_{axis}"
        assert whole[True][key] == pytest.approx(sign * whole[False][key]) and abs(whole[True][key]) > 5e-3


# --- the next log is read alike


TRUE = Imu(Triad(DIAGONAL[0], BIAS_A), Triad(DIAGONAL[1], BIAS_G, quantity="angular_rate", output_unit="rad/s"))


@pytest.fixture(scope="module")
def recordings():
    """Two recordings of a unit by hand, in body axes, and their truth."""
    return [simulate(TRUE, HandHeld(12, 1.5), consumer_noise(), seed=[4, seed]) for seed in range(2)]


def ulog(path, recording: Recording):
    """The recording as PX4 logs it: forward, right, down."""
    raw = apply_axes(recording, "FRD")
    rows = []
    for time, force, rate in zip(raw.accelerometer.time, raw.accelerometer.values, raw.gyroscope.values, strict=True):
        at = round(1e6 * time) + 10**6
        rows += [("sensor_accel", 0, (at, at, *force, 31.5)), ("sensor_gyro", 0, (at, at, *rate, 31.5))]
    return write_ulog(path, {"sensor_accel": RAW, "sensor_gyro": RAW}, rows)


@pytest.fixture(scope="module")
def flown(tmp_path_factory, recordings):
    """A PX4 log, calibrated with --axes FRD by the command line; and a second log."""
    pytest.importorskip("pyulog")
    folder = tmp_path_factory.mktemp("flown")
    logs = [ulog(folder / f"{name}.ulg", each) for name, (each, _) in zip(("one", "two"), recordings, strict=True)]
    assert main(["calibrate", str(logs[0]), "--axes", "FRD", "-o", str(folder / "d"), "--quiet"]) == 0
    return folder / "d" / "calibration.json", *logs


def test_the_calibration_of_a_flight_log_says_how_it_was_read(flown):
    document = json.loads(flown[0].read_text())["reading"]
    assert document["axes"] == "FRD" and document["frame"] == "FRD" and document["columns"] is None
    assert document["units"]["accelerometer"] == "m/s^2" and document["units"]["gyroscope"] == "rad/s"
    assert load_calibration(flown[0]).reading == Reading.from_document(document)


@pytest.mark.parametrize("to", AUTOPILOTS)
def test_an_autopilots_parameters_correct_its_own_log(tmp_path, flown, recordings, to):
    """The fault seen: with --axes FRD at `calibrate` alone the signs of y and z were wrong, without a word."""
    path, log, _ = flown
    assert main(["export", str(path), "--to", to, "-o", str(tmp_path / "out"), "--quiet"]) == 0
    raw = read_recording(log)  # as the autopilot has it
    made = AUTOPILOTS[to]({"": (tmp_path / "out").read_bytes()}, raw.accelerometer.values, raw.gyroscope.values)
    truth = recordings[0][1].stimulus
    # of a diagonal unit the file leaves what the fit is uncertain by, and noise
    assert np.abs(np.mean(made[0] - truth.specific_force @ FRD, axis=0)).max() < 0.02
    assert np.abs(np.mean(made[1] - truth.angular_rate @ FRD, axis=0)).max() < 2e-3


def test_compensate_reads_the_next_log_alike(tmp_path, flown, recordings, capsys):
    """The fault seen: 10.18 m/s² at rest where --axes was not repeated."""
    path, _, log = flown
    for more in ([], ["--axes", "FRD"], ["--axes", "x,-y,-z"]):
        assert main(["compensate", str(path), str(log), "-o", str(tmp_path / "out.csv"), *more]) == 0
        assert ("is read as the calibrated log was: --axes FRD" in capsys.readouterr().err) == (not more)
        made, truth = read_recording(tmp_path / "out.csv"), recordings[1][1].stimulus
        assert np.abs(np.mean(made.accelerometer.values - truth.specific_force, axis=0)).max() < 0.02
        assert np.abs(np.mean(made.gyroscope.values - truth.angular_rate, axis=0)).max() < 2e-3
    assert main(["compensate", str(path), str(log), "-o", str(tmp_path / "other.csv"), "--axes", "y,-x,z"]) == 2
    message = capsys.readouterr().err
    assert re.search(r"two\.ulg: axes y,-x,z contradict .* axes FRD", message) and "Traceback" not in message
    assert not (tmp_path / "other.csv").exists()


def test_check_and_filter_read_the_next_log_alike(flown, capsys):
    path, _, log = flown
    assert main(["check", str(path), str(log), "--json", "--fail-on", "invalid"]) == 0
    assert json.loads(capsys.readouterr().out)["verdict"] in ("valid", "session")
    assert main(["filter", str(log), "--online", str(path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["filter"]["diverged"] is None and document["reading"]["axes"] == "FRD"
    for line in (["check", str(path), str(log)], ["filter", str(log), "--online", str(path)],
                 ["consequences", str(path), "--path", str(log)], ["thermal", str(log), "--calibration", str(path)],
                 ["magnetometer", str(log), "--calibration", str(path)]):  # fmt: skip
        if line[0] != "magnetometer":  # the log has none, and says that first
            assert main([*line, "--axes", "FLU"]) == 2, line
            assert re.search(r"axes FLU contradict .* axes FRD", capsys.readouterr().err)


COLUMNS = "time [ms],gyro [count],accel [count]"
COUNTS = ["--columns", COLUMNS.partition(",")[2], "--rate", "100", "--accel-scale", "2048 count/g", "--gyro-scale",
          "32.8 count/(deg/s)", "--axes", "y,-x,z;-f"]  # fmt: skip


def counted(path, recording: Recording, unit_a: float = 2048 / G, unit_g: float = 32.8 * 57.29578):
    """The recording as a logger writes it that has no header, counts, no time, and −f in other axes."""
    maps = parse_axes("y,-x,z;-f")
    rows = np.rint(np.hstack([unit_g * recording.gyroscope.values @ maps["gyroscope"],
                              unit_a * recording.accelerometer.values @ maps["accelerometer"]]))  # fmt: skip
    path.write_text("\n".join(",".join(f"{each:.0f}" for each in row) for row in rows) + "\n")
    return path


@pytest.fixture(scope="module")
def counts(tmp_path_factory, recordings):
    folder = tmp_path_factory.mktemp("counts")
    logs = [counted(folder / f"{name}.csv", each) for name, (each, _) in zip(("one", "two"), recordings, strict=True)]
    assert main(["calibrate", str(logs[0]), *COUNTS, "-o", str(folder / "d"), "--quiet"]) == 0
    return folder / "d" / "calibration.json", *logs


def test_columns_rate_scales_and_axes_are_kept(counts, recordings, tmp_path, capsys):
    path, _, log = counts
    reading = json.loads(path.read_text())["reading"]
    assert (reading["columns"], reading["rate"], reading["axes"]) == (COUNTS[1], 100.0, COUNTS[-1])
    assert reading["units"] == {"accelerometer": "count", "gyroscope": "count"} and reading["header"] == [""] * 6
    assert reading["scales"]["accelerometer"] == pytest.approx([2048 / G] * 3)
    assert reading["offsets"] == {"accelerometer": [0.0, 0.0, 0.0]}  # a gyroscope's is another at every power-on
    assert main(["compensate", str(path), str(log), "-o", str(tmp_path / "out.parquet")]) == 0
    assert f"--columns '{COUNTS[1]}'" in capsys.readouterr().err
    made, truth = read_recording(tmp_path / "out.parquet"), recordings[1][1].stimulus
    assert np.abs(np.mean(made.accelerometer.values - truth.specific_force, axis=0)).max() < 0.02
    assert np.abs(np.mean(made.gyroscope.values - truth.angular_rate, axis=0)).max() < 2e-3
    assert main(["check", str(path), str(log), "--json", "--fail-on", "invalid"]) == 0


def test_the_gyroscopes_file_of_the_next_log_is_asked_for(recordings, tmp_path, capsys):
    """The fault seen: "--columns names 7 columns, the file has 4", of columns that nobody had typed."""
    logs = []
    for name, (each, _) in zip(("one", "two"), recordings, strict=True):
        for signal in (each.accelerometer, each.gyroscope):
            rows = np.column_stack([signal.time, signal.values])
            logs.append(str(tmp_path / f"{name}_{'gyro' if signal is each.gyroscope else 'accel'}.csv"))
            np.savetxt(logs[-1], rows, fmt="%.9g", delimiter=",")
    line = ["--columns", "time [s],accel [m/s^2],gyro [rad/s]", "-o", str(tmp_path / "d"), "--quiet"]
    assert main(["calibrate", logs[0], "--gyro-log", logs[1], *line]) == 0
    line = ["compensate", str(tmp_path / "d" / "calibration.json"), logs[2], "-o", str(tmp_path / "out.csv")]
    assert main(line) == 2
    message = capsys.readouterr().err
    assert "two_accel.csv" in message and "--gyro-log" in message and "names 7 columns" not in message
    assert main([*line, "--gyro-log", logs[3]]) == 0


def test_an_export_of_counts_turns_the_sense_of_a_logger_of_minus_specific_force(counts, recordings):
    path, log, _ = counts
    written = writer("c-header").write(ExportedUnit.of(load_calibration(path)))
    rows = np.loadtxt(log, delimiter=",")
    force, rate = c_header(written.files, rows[:, 3:], rows[:, :3])
    truth, turn = recordings[0][1].stimulus, axis_matrix("y,-x,z")
    assert np.abs(np.mean(force - truth.specific_force @ turn, axis=0)).max() < 0.02
    assert np.abs(np.mean(rate - truth.angular_rate @ turn, axis=0)).max() < 2e-3


def test_a_scale_of_counts_that_contradicts_is_refused(counts, tmp_path, capsys):
    path, _, log = counts
    line = ["compensate", str(path), str(log), "-o", str(tmp_path / "out.csv")]
    assert main([*line, "--accel-scale", "4096 count/g"]) == 2
    assert "accelerometer's scale, 417.68 counts" in (message := capsys.readouterr().err) and "208.84" in message
    assert main([*line, "--gyro-scale", "16.4 count/(deg/s)"]) == 2
    assert "gyroscope's scale" in capsys.readouterr().err
    assert not (tmp_path / "out.csv").exists()
    agreeing = ["--accel-scale", "0.488 mg/count", "--gyro-scale", "32.8 count/(deg/s)"]
    assert main([*line, *agreeing, "--gyro-offset", "0"]) == 0


def simple(path, recording: Recording, axes: str = "FRD", unit_a: str = "m/s^2", factor: float = 1.0):
    """The recording in a CSV whose header says all but the axes."""
    raw = apply_axes(recording, axes)
    table = np.column_stack([raw.accelerometer.time, factor * raw.accelerometer.values, raw.gyroscope.values])
    head = ["time [s]", *(f"accel_{a} [{unit_a}]" for a in "xyz"), *(f"gyro_{a} [rad/s]" for a in "xyz")]
    np.savetxt(path, table, delimiter=",", header=",".join(head), comments="")
    return path


def test_stated_columns_are_for_a_log_of_the_same_header_alone(tmp_path, recordings):
    """A header that lies (g, stated as m/s²) lies again; a log that names its columns otherwise is read by its own."""
    recording = recordings[0][0]
    lying = simple(tmp_path / "lying.csv", recording, factor=1 / G)
    stated = ReadOptions(columns="time [s],accel [g],gyro [rad/s]", axes="FRD")
    reading = read_recording(lying, options=stated).reading
    assert reading is not None and reading.units["accelerometer"] == "g" and len(reading.header) == 7
    like = ReadOptions(like=Reading.from_document(json.loads(json.dumps(vars(reading)))))
    wanted = recording.accelerometer.values
    for path in (lying, simple(tmp_path / "milli.csv", recording, unit_a="mg", factor=1e3 / G)):
        made = read_recording(path, options=like)
        np.testing.assert_allclose(made.accelerometer.values, wanted, atol=1e-6)
        assert made.reading.axes == "FRD"
    own = read_recording(lying, options=replace(like, columns="time [s],accel [g],gyro [rad/s]", axes="FRD"))
    np.testing.assert_allclose(own.accelerometer.values, wanted, atol=1e-6)


def test_a_log_that_jaximu_wrote_is_not_mapped_twice(tmp_path, recordings):
    recording = recordings[0][0]
    raw = read_recording(simple(tmp_path / "raw.csv", recording), options=ReadOptions(axes="FRD"))
    wanted = recording.accelerometer.values
    np.testing.assert_allclose(raw.accelerometer.values, wanted, atol=1e-9)
    like = ReadOptions(like=raw.reading)
    write_recording(raw, tmp_path / "body.parquet")
    for body in (read_recording(tmp_path / "body.parquet"), read_recording(tmp_path / "body.parquet", options=like),
                 Recording.from_dataframe(raw.to_arrow(), like)):  # fmt: skip
        np.testing.assert_allclose(body.accelerometer.values, wanted, atol=1e-9)
        assert body.reading.axes == "FRD"  # the logger's own, of which an export is to be
    compensated = compensate(unit("FRD"), raw)
    write_recording(compensated, tmp_path / "corrected.parquet")
    again = read_recording(tmp_path / "corrected.parquet", options=like)
    np.testing.assert_allclose(again.accelerometer.values, compensated.accelerometer.values, atol=1e-9)
    with pytest.raises(InputError, match="contradict"):
        read_recording(tmp_path / "body.parquet", options=replace(like, axes="FRD"))
    write_recording(recording, tmp_path / "simulated.parquet")  # nothing was mapped: as any log's, its axes are open
    mapped = read_recording(tmp_path / "simulated.parquet", options=like)
    np.testing.assert_allclose(mapped.accelerometer.values, wanted @ FRD, atol=1e-9)


def test_a_scale_that_gravity_showed_serves_a_log_that_does_not_show_it(tmp_path, recordings):
    stated = ReadOptions(columns=COUNTS[1], rate=100.0, gyro_scale="32.8 count/(deg/s)", axes=COUNTS[-1])
    first = read_recording(counted(tmp_path / "poses.csv", recordings[0][0]), options=stated)
    assert first.reading.scales["accelerometer"] == pytest.approx([2048 / G] * 3, rel=0.03)
    still = counted(tmp_path / "still.csv", recordings[1][0])
    still.write_text("\n".join(still.read_text().splitlines()[:120]) + "\n")
    with pytest.raises(NotPossibleError, match="determine scale and offset"):
        read_recording(still, options=stated)
    alike = read_recording(still, options=ReadOptions(like=first.reading))
    np.testing.assert_array_equal(alike.accelerometer.nominal_scale, first.accelerometer.nominal_scale)
    np.testing.assert_array_equal(alike.accelerometer.nominal_offset, first.accelerometer.nominal_offset)


def test_python_refuses_a_recording_in_other_axes_and_takes_one_made_in_memory(tmp_path, recordings):
    recording = recordings[0][0]
    path = simple(tmp_path / "raw.csv", recording)
    calibration = unit("FRD")
    other = read_recording(path)
    with pytest.raises(InputError, match=r"raw\.csv: axes as they are \(FLU\) contradict .* axes FRD"):
        compensate(calibration, other)
    with pytest.raises(InputError, match="contradict"):
        check(calibration, other)
    same = read_recording(path, options=ReadOptions(axes="x,-y,-z"))
    assert compensate(calibration, same).reading == same.reading
    compensate(calibration, recording)
    compensate(replace(calibration, reading=None), other)


def test_axes_are_composed_and_kept_by_every_recipe(tmp_path, recordings):
    """Also where axes are mapped once more, as --repair does: the next log is the first map's and the second's."""
    recording = recordings[0][0]
    raw = read_recording(simple(tmp_path / "raw.csv", recording, axes="y,-x,z;-f"))
    once = apply_axes(raw, "FRD")
    twice = apply_axes(once, "gyro=y,z,x")
    assert once.reading.axes == "FRD" and raw.reading.axes is None and "gyro=-y,-z,x" in twice.reading.axes
    whole = apply_axes(raw, twice.reading.axes)
    for name in ("accelerometer", "gyroscope"):
        np.testing.assert_array_equal(getattr(whole, name).values, getattr(twice, name).values)
    assert [spelled_axes(axis_matrix(text)) for text in ROTATIONS] == ROTATIONS
    first = read_recording(simple(tmp_path / "first.csv", recording), options=ReadOptions(axes="FRD"))
    second = read_recording(simple(tmp_path / "second.csv", recordings[1][0], "y,-x,z"),
                            options=ReadOptions(axes="-y,x,z"))  # fmt: skip
    both = calibrate([first, second])
    assert both.reading == first.reading
    assert any("second.csv was read in other axes than" in note for note in both.notes)


def test_a_magnetometer_alone_is_read_alike(tmp_path, recordings):
    time = np.arange(50) / 50
    field = np.random.default_rng(1).normal(0, 30, (50, 3))
    write_recording(Recording(Signal(time, field, "m/s^2"), magnetometer=Signal(time, field, "uT")), tmp_path / "m.csv")
    like = Reading(axes="FRD", units={"magnetometer": "uT"})
    signal, _, _ = read_magnetometer(tmp_path / "m.csv", ReadOptions(like=like))
    np.testing.assert_allclose(signal.values, field @ FRD)
    with pytest.raises(InputError, match="contradict"):
        read_magnetometer(tmp_path / "m.csv", ReadOptions(axes="y,-x,z", like=like))
    # axes that a calibration of other sensors does not speak of are added
    inertial = Reading(axes="FRD", units={"accelerometer": "m/s^2"})
    signal, _, _ = read_magnetometer(tmp_path / "m.csv", ReadOptions(axes="FRD;mag=y,x,-z", like=inertial))
    np.testing.assert_allclose(signal.values, field @ parse_axes("mag=y,x,-z")["magnetometer"].T)


@pytest.mark.parametrize(
    ("key", "value"),
    [("axes", "up"), ("scales", {"accelerometer": [1.0, 2.0]}), ("offsets", {"gyroscope": "many"}), ("axes", 7)],
)
def test_a_damaged_reading_is_told(tmp_path, key, value):
    unit("FRD").save(path := tmp_path / "calibration.json")
    document = json.loads(path.read_text())
    document["reading"][key] = value
    path.write_text(json.dumps(document))
    with pytest.raises(InputError):
        load_calibration(path)
    document["reading"] = {"axes": "FRD", "of a later version": 1}
    path.write_text(json.dumps(document))
    assert load_calibration(path).reading == Reading(axes="FRD")


def test_standard_deviations_go_with_their_parameters():
    """A gain's row is the output's, as the logger has its axes, and its column the answer's, here in body axes."""
    calibration = unit("accel=-y,x,z;gyro=x,-y,-z")
    found = {}
    for line in writer("csv").write(ExportedUnit.of(calibration)).files[""].decode().splitlines()[1:]:
        triad, name, row, column, _, sigma, _ = line.split(",")
        found[triad, name, row, column] = sigma
    gain, bias = calibration.sigma("accelerometer")
    for logged_axis, body_axis in enumerate((1, 0, 2)):  # the log's x is the body's y
        assert float(found["accelerometer", "bias", str(logged_axis), ""]) == bias[body_axis]
        for column in range(3):
            assert float(found["accelerometer", "gain", str(logged_axis), str(column)]) == gain[body_axis, column]


def test_exports_of_one_triad_alone(tmp_path):
    calibration = replace(unit("FRD;-f"), imu=replace(unit(None).imu, gyroscope=None))
    calibration = replace(
        calibration, names=names_of(calibration.imu), covariance=np.eye(len(names_of(calibration.imu)))
    )
    export(ExportedUnit.of(calibration), "ros-yaml", tmp_path / "unit.yaml")
    _, _, y_a, _ = logged(unit("FRD;-f"), "FRD;-f")
    accel = yaml((tmp_path / "unit.yaml").read_bytes())["/**"]["ros__parameters"]["imu_calibration"]["accelerometer"]
    force = (y_a - accel["bias"]) @ np.reshape(accel["matrix"], (3, 3)).T
    close(force, logged(unit("FRD;-f"), None)[0] @ FRD)
