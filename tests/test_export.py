"""Writers: each other tool's own equation, stated here from its documentation, against `compensate`, and the losses."""

import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from jaximu.calibration import Calibration, compensate
from jaximu.cli import main
from jaximu.estimation.problem import names_of
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import LocalGravity
from jaximu.model.effects import CATALOGUE
from jaximu.model.sensor import Imu, Triad
from jaximu.recordings.readers.kalibr import read_noise
from jaximu.recordings.recording import Recording, Signal
from jaximu.report.export import WRITERS, ExportedUnit, Range, export, losses
from jaximu.report.export.catalogue import writer

G = 9.80665
rng = np.random.default_rng(7)
GAIN_A = np.tril(np.eye(3) + rng.normal(0, 0.02, (3, 3)))
GAIN_G = np.eye(3) + rng.normal(0, 0.02, (3, 3))
FULL_A = np.eye(3) + rng.normal(0, 0.02, (3, 3))
BIAS_A, BIAS_G = np.array([0.11, -0.26, 0.03]), np.array([-0.009, 0.015, -0.017])
NAMES = names_of(Imu.nominal())
SENSITIVE = CATALOGUE["gyro.g_sensitivity"].make(rng.normal(0, 1e-4, 9))
NOISE = {
    "accelerometer_noise_density": 1.2e-3, "accelerometer_random_walk": 3e-5,
    "gyroscope_noise_density": 9e-5, "gyroscope_random_walk": 2e-6, "update_rate": 200.0,
}  # fmt: skip


def unit(gain_a=GAIN_A, *effects, counts: bool = False, gyroscope: bool = True) -> Calibration:
    scale_a, scale_g = (16384 / G, 131 * 57.29578) if counts else (1.0, 1.0)
    names = ("count", "count") if counts else ("m/s^2", "rad/s")
    imu = Imu(
        Triad(gain_a * scale_a, BIAS_A * scale_a, (), "specific_force", names[0]),
        Triad(GAIN_G * scale_g, BIAS_G * scale_g, (), "angular_rate", names[1]) if gyroscope else None,
    )
    free = names_of(imu)
    return Calibration(
        imu=imu.with_effects(*effects), names=free, covariance=np.diag(np.full(len(free), 1e-8)),
        gravity=LocalGravity(G, 0.0), method="joint", loss="linear", rms={}, rank=24, weak=(), excess={},
        solver="", data={"rate": 200.0, "files": [{"file": "log\n.csv"}]},
    )  # fmt: skip


def raw(calibration: Calibration, samples: int = 64) -> Recording:
    """Random outputs: what a tool and `compensate` are both given."""
    generator = np.random.default_rng(3)
    accel, gyro = generator.normal(0, 6, (samples, 3)), generator.normal(0, 2, (samples, 3))
    time = np.arange(samples) * 0.01
    triads = calibration.imu.triads()
    outputs = {
        n: u @ np.asarray(triads[n].gain).T + triads[n].bias for n, u in zip(triads, (accel, gyro), strict=False)
    }
    outputs = {n: np.rint(y) if triads[n].output_unit == "count" else y for n, y in outputs.items()}
    return Recording(
        Signal(time, outputs["accelerometer"], triads["accelerometer"].output_unit),
        Signal(time, outputs["gyroscope"], triads["gyroscope"].output_unit) if "gyroscope" in outputs else None,
    )


def both(calibration: Calibration) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(raw accelerometer, raw gyroscope, compensated accelerometer, compensated gyroscope), each (n, 3)."""
    recording = raw(calibration)
    made = compensate(calibration, recording)
    assert recording.gyroscope is not None and made.gyroscope is not None
    return (
        recording.accelerometer.values, recording.gyroscope.values, made.accelerometer.values, made.gyroscope.values,
    )  # fmt: skip


def text(to: str, calibration: Calibration, **more) -> str:
    return writer(to).write(ExportedUnit.of(calibration, **more)).files[""].decode()


def yaml(content: str) -> dict:
    ruamel = pytest.importorskip("ruamel.yaml")
    return ruamel.YAML(typ="safe").load(content.removeprefix("%YAML:1.0"))


def close(one: np.ndarray, other: np.ndarray) -> None:
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-9)


# --- each tool's equation


@pytest.mark.parametrize("gain", [GAIN_A, FULL_A], ids=["kalibr's frame", "another frame"])
def test_kalibr(gain):
    """y_a = M_a f + b_a, y_g = M_g C ω + A (C f) + b_g (kalibr wiki; `ScaledMisalignedImu` rotates f before A)."""
    calibration = unit(gain, SENSITIVE)
    y_a, y_g, f, w = both(calibration)
    imu = yaml(text("kalibr", calibration, noise=NOISE))["imu0"]
    accel, gyro = imu["accelerometers"], imu["gyroscopes"]
    matrix, rotation, sensitivity = (np.array(gyro[key]) for key in ("M", "C_gyro_i", "A"))
    force = np.linalg.solve(np.array(accel["M"]), (y_a - accel["bias"]).T)
    rate = rotation.T @ np.linalg.solve(matrix, (y_g - gyro["bias"]).T - sensitivity @ rotation @ force)
    # kalibr's body frame: that in which the accelerometer's matrix is lower-triangular
    turn = np.linalg.solve(np.array(accel["M"]), gain)
    close(turn @ turn.T, np.eye(3))
    close(force.T @ turn, f)
    close(rate.T @ turn, w)
    assert imu["model"] == "scale-misalignment" and imu["update_rate"] == 200.0
    assert {key: imu[key] for key in NOISE if key in imu} == pytest.approx(NOISE)
    for each in (np.array(accel["M"]), matrix):
        assert np.all(np.triu(each, 1) == 0) and np.all(np.diag(each) > 0)
    close(rotation @ rotation.T, np.eye(3))


@pytest.mark.parametrize("gain", [GAIN_A, FULL_A])
def test_imu_tk(tmp_path, gain):
    """unbiasNormalize: u = mis_mat · scale_mat · (y − bias); the file is three blocks of 3×3, 3×3 and 3×1 numbers."""
    calibration = unit(gain)
    _, paths = export(ExportedUnit.of(calibration), "imu_tk", tmp_path / "unit.calib")
    assert [each.name for each in paths] == ["unit_acc.calib", "unit_gyro.calib"]
    y_a, y_g, f, w = both(calibration)
    for path, output, wanted in zip(paths, (y_a, y_g), (f, w), strict=True):
        numbers = np.array(path.read_text().split(), float)
        misalignment, scale, bias = numbers[:9].reshape(3, 3), numbers[9:18].reshape(3, 3), numbers[18:]
        assert np.count_nonzero(scale) == 3 and bias.shape == (3,)
        close((misalignment @ scale @ (output - bias).T).T, wanted)


@pytest.mark.parametrize("gain", [GAIN_A, FULL_A])
def test_openvins(gain):
    """ω = R_GYROtoIMU Dw (ω_m − Tg a − b_w), a = R_ACCtoIMU Da (a_m − b_a), D = T⁻¹ (OpenVINS, IMU intrinsics)."""
    calibration = unit(gain, SENSITIVE)
    y_a, y_g, f, w = both(calibration)
    imu = yaml(text("openvins", calibration))["imu0"]
    matrices = {key: np.array(imu[key]) for key in ("Tw", "Ta", "Tg", "R_IMUtoGYRO", "R_IMUtoACC")}
    # the filter estimates the biases: give it the true ones
    force = matrices["R_IMUtoACC"].T @ np.linalg.inv(matrices["Ta"]) @ (y_a - BIAS_A).T
    rate = matrices["R_IMUtoGYRO"].T @ np.linalg.inv(matrices["Tw"]) @ ((y_g - BIAS_G).T - matrices["Tg"] @ force)
    turn = np.linalg.solve(matrices["Ta"], gain)
    close(force.T @ turn, f)
    close(rate.T @ turn, w)


def test_vins():
    """What VINS expects of its own integral is what white samples of the stated density, and a bias walk, give it.

    The angle of `midPointIntegration` is the sum of (w_i + w_{i+1}) Δt/2; its covariance grows by V diag(n²) Vᵀ with
    two blocks Δt/2 a step, the bias's by (w Δt)².
    """
    content = text("vins", unit(), noise=NOISE)
    numbers = {key: float(value) for key, value in re.findall(r"^(\w+): (\S+)  #", content, re.MULTILINE)}
    assert content.startswith("%YAML:1.0\n")  # without it OpenCV, which VINS reads it with, refuses the file
    rate, steps, trials = NOISE["update_rate"], 100, 4000
    draws = np.random.default_rng(5).normal(size=(trials, steps + 1))
    for key, density in (("acc_n", "accelerometer_noise_density"), ("gyr_n", "gyroscope_noise_density")):
        samples = NOISE[density] * np.sqrt(rate) * draws
        angle = np.sum((samples[:, :-1] + samples[:, 1:]) / 2, axis=1) / rate
        expected = steps * 2 * (numbers[key] * 0.5 / rate) ** 2
        # √(2/4000) = 2.2 % of the variance, and half a sample of 100 lost at the ends
        assert np.var(angle) == pytest.approx(expected, rel=0.1)
    walk = np.sum(draws[:, 1:], axis=1) * NOISE["gyroscope_random_walk"] / np.sqrt(rate)
    assert np.var(walk) == pytest.approx(steps * (numbers["gyr_w"] / rate) ** 2, rel=0.1)
    assert numbers["acc_w"] / np.sqrt(rate) == pytest.approx(NOISE["accelerometer_random_walk"])
    assert numbers["g_norm"] == G
    with pytest.raises(NotPossibleError, match="jaximu allan"):
        text("vins", unit())


def qgroundcontrol(content: str) -> dict[str, float]:
    rows = [line.split("\t") for line in content.splitlines() if not line.startswith("#")]
    assert all(len(row) == 5 for row in rows)
    return {row[2]: float(row[3]) for row in rows}


def test_px4():
    """Accelerometer.hpp: (data − offset).emult(scale); Gyroscope.hpp: data − offset."""
    calibration = unit()
    values = qgroundcontrol(text("px4", calibration, instance=1, device=1310988))
    assert values["CAL_ACC1_ID"] == values["CAL_GYRO1_ID"] == 1310988
    offset, scale, zero = (
        np.array([values[f"CAL_{n}1_{axis}{end}"] for axis in "XYZ"])
        for n, end in (("ACC", "OFF"), ("ACC", "SCALE"), ("GYRO", "OFF"))
    )
    within_the_loss(calibration, "px4", lambda y: (y - offset) * scale, lambda y: y - zero)
    diagonal = replace(calibration, imu=Imu(Triad(np.diag([1.01, 0.98, 1.03]), BIAS_A), Triad(np.eye(3), BIAS_G,
                                                  quantity="angular_rate", output_unit="rad/s")))  # fmt: skip
    values = qgroundcontrol(text("px4", diagonal))
    y_a, y_g, f, w = both(diagonal)
    close((y_a - [values[f"CAL_ACC0_{a}OFF"] for a in "XYZ"]) * [values[f"CAL_ACC0_{a}SCALE"] for a in "XYZ"], f)
    close(y_g - [values[f"CAL_GYRO0_{a}OFF"] for a in "XYZ"], w)


@pytest.mark.parametrize("instance", [0, 2])
def test_ardupilot(tmp_path, instance):
    """_rotate_and_correct_accel: accel −= offset; accel ∘= scale; read by pymavlink, which MAVProxy loads with."""
    mavparm = pytest.importorskip("pymavlink.mavparm")
    calibration = unit()
    export(ExportedUnit.of(calibration, instance=instance), "ardupilot", tmp_path / "unit.param")
    values = mavparm.MAVParmDict()
    values.load(str(tmp_path / "unit.param"), check=False)
    number = str(instance + 1) if instance else ""
    offset, scale, zero = (
        np.array([values[f"INS_{n}{number}{end}_{axis}"] for axis in "XYZ"])
        for n, end in (("ACC", "OFFS"), ("ACC", "SCAL"), ("GYR", "OFFS"))
    )
    within_the_loss(calibration, "ardupilot", lambda y: (y - offset) * scale, lambda y: y - zero)


def within_the_loss(calibration: Calibration, to: str, accelerometer, gyroscope) -> None:
    """What a tool makes of outputs within the range differs from `compensate` by no more than was said, and by some."""
    extent = Range.of(calibration)
    parameters = ExportedUnit.of(calibration)
    said = losses(parameters, writer(to).write(parameters), extent)[0]
    directions = np.random.default_rng(1).normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    triads = calibration.imu.triads()
    for name, apply, reach in (
        ("accelerometer", accelerometer, extent.gravity),
        ("gyroscope", gyroscope, extent.rate),
    ):
        triad = triads[name]
        u = reach * directions
        worst = np.linalg.norm(apply(u @ triad.gain.T + triad.bias) - u, axis=1).max()
        assert worst == pytest.approx(said.worst[name], rel=0.1)


def test_realsense():
    """rs-imu-calibration.py: corrected = [y, −1]·X, X[:3] flattened as scale_and_alignment, X[3] as bias."""
    calibration = unit(FULL_A)
    (imu,) = json.loads(text("realsense", calibration))["imus"]
    y_a, y_g, f, w = both(calibration)
    for name, output, wanted in (("accelerometer", y_a, f), ("gyroscope", y_g, w)):
        x = np.array(imu[name]["scale_and_alignment"] + imu[name]["bias"]).reshape(4, 3)
        close(np.column_stack([output, -np.ones(len(output))]) @ x, wanted)


@pytest.mark.parametrize("counts", [False, True])
def test_ros_yaml(counts):
    calibration = unit(FULL_A, *([] if counts else [SENSITIVE]), counts=counts)
    found = yaml(text("ros-yaml", calibration))["/**"]["ros__parameters"]["imu_calibration"]
    y_a, y_g, f, w = both(calibration)
    force = (y_a - found["accelerometer"]["bias"]) @ np.reshape(found["accelerometer"]["matrix"], (3, 3)).T
    gyro = found["gyroscope"]
    known = 0.0 if counts else force @ np.reshape(gyro["g_sensitivity"], (3, 3)).T
    close(force, f)
    close((y_g - gyro["bias"] - known) @ np.reshape(gyro["matrix"], (3, 3)).T, w)
    assert gyro["output_unit"] == ("count" if counts else "rad/s")


def test_csv_and_npz(tmp_path):
    calibration = unit(FULL_A, CATALOGUE["accel.quadratic"].make([1e-4, 2e-4, 3e-4]))
    table: dict[tuple[str, str], np.ndarray] = {}
    for line in text("csv", calibration).splitlines()[1:]:
        triad, name, row, column, value, sigma, unit_ = line.split(",")
        place = (int(row or 0), int(column or 0))
        table.setdefault((triad, name), np.zeros((3, 3)))[place] = float(value)
        assert unit_ and (name != "gain" or float(sigma) == pytest.approx(1e-4))
    plain = replace(calibration, imu=calibration.imu.with_effects())
    y_a, y_g, f, w = both(plain)
    for name, output, wanted in (("accelerometer", y_a, f), ("gyroscope", y_g, w)):
        close((output - table[name, "bias"][:, 0]) @ table[name, "inverse_gain"].T, wanted)
    assert table["accelerometer", "accel.quadratic"][:, 0].tolist() == pytest.approx([1e-4, 2e-4, 3e-4])
    export(ExportedUnit.of(calibration), "npz", tmp_path / "unit.npz")
    with np.load(tmp_path / "unit.npz", allow_pickle=False) as arrays:
        close((y_g - arrays["gyroscope_bias"]) @ arrays["gyroscope_inverse_gain"].T, w)
        assert arrays["covariance"].shape == (24, 24) and tuple(arrays["parameters"]) == NAMES


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
@pytest.mark.parametrize("counts", [False, True])
def test_c_header_is_compiled_and_run(tmp_path, counts):
    calibration = unit(FULL_A, counts=counts)
    export(ExportedUnit.of(calibration), "c-header", tmp_path / "calibration.h")
    body = "".join(
        f"""
        for (k = 0; k < {{n}}; k++) {{{{
            for (i = 0; i < 3; i++) if (scanf("%lf", &y[i]) != 1) return 1;
            jaximu_{name}(y, u);
            for (i = 0; i < 3; i++) a[i] = (float)y[i];
            jaximu_{name}_float(a, a);
            for (i = 0; i < 3; i++) b[i] = (int32_t)({{scale}} * y[i] + (y[i] < 0 ? -0.5 : 0.5));
            jaximu_{name}_fixed(b, b);
            for (i = 0; i < 3; i++) printf("%.17g %.9g %.17g\\n", u[i], (double)a[i], b[i] / {2**bits}.0);
        }}}}"""
        for name, bits in (("accelerometer", 16), ("gyroscope", 20))
    )
    y_a, y_g, f, w = both(calibration)
    head = '#include <stdio.h>\n#include "calibration.h"\nint main(void) { int k, i; double y[3], u[3]; float a[3];'
    source = head + " int32_t b[3];" + body.format(n=len(y_a), scale=1 if counts else 65536) + " return 0; }\n"
    (tmp_path / "main.c").write_text(source)
    flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-fsanitize=undefined"]
    subprocess.run(["gcc", *flags, "-o", "run", "main.c"], cwd=tmp_path, check=True)
    given = "\n".join(repr(float(each)) for each in np.concatenate([y_a, y_g]).ravel())
    ran = subprocess.run(["./run"], cwd=tmp_path, input=given, capture_output=True, text=True, check=True)
    assert ran.stderr == ""
    double, single, fixed = np.array(ran.stdout.split(), float).reshape(-1, 3).T
    wanted = np.concatenate([f, w]).ravel()
    close(double, wanted)
    np.testing.assert_allclose(single, wanted, rtol=0, atol=1e-5 if not counts else 5e-3 * 16384 / 9.8 / 16384)
    half = f.size
    # rounding the input costs half a unit of it, the stated bound the rest (inputs here reach 2.5 times gravity)
    bounds = re.findall(r"off by at most (\S+) m/s\^2 and (\S+) rad/s", _convention("c-header", calibration))[0]
    for part, bound, gain in ((slice(0, half), bounds[0], FULL_A), (slice(half, None), bounds[1], GAIN_G)):
        rounding = 0.0 if counts else np.abs(np.linalg.inv(gain)).sum(1).max() * 0.5**17
        assert np.abs(fixed[part] - wanted[part]).max() < 2.5 * float(bound) + rounding
    extreme = subprocess.run(["./run"], cwd=tmp_path, input=" ".join(["0"] * 384), capture_output=True, text=True)
    assert extreme.stderr == ""


def _convention(to: str, calibration: Calibration) -> str:
    return writer(to).write(ExportedUnit.of(calibration)).convention


# --- losses


def test_a_loss_is_what_it_says():
    """A quadratic accelerometer effect, by hand: c f² through K⁻¹ is greatest with gravity along the axis."""
    effect = CATALOGUE["accel.quadratic"].make([3e-4, 0.0, 0.0])
    calibration = unit(np.eye(3), effect)
    parameters = ExportedUnit.of(calibration)
    found = losses(parameters, writer("imu_tk").write(parameters), Range.of(calibration))
    assert found[0].what == "the effect accel.quadratic"
    assert found[0].worst["accelerometer"] == pytest.approx(3e-4 * G**2, rel=1e-3)
    assert "uncertainty" in found[-1].what
    # σ = 1e-4 of each of the nine gains and 1e-4 of each bias: 1e-4 sqrt(3 (g² + 1)) for the vector; the effect changes
    # the scale of its axis by 2 c f
    assert found[-1].worst["accelerometer"] == pytest.approx(1e-4 * np.sqrt(3 * (G**2 + 1)), rel=2 * 2 * 3e-4 * G)


def test_temperature_counts_over_the_stated_range():
    calibration = unit(np.eye(3), CATALOGUE["gyro.temperature"].make(2e-4))
    parameters = ExportedUnit.of(calibration)
    written = writer("ros-yaml").write(parameters)
    for low, high in ((15.0, 35.0), (-20.0, 60.0)):
        (loss, *_) = losses(parameters, written, Range.of(calibration, temperature=(low, high)))
        assert loss.worst["gyroscope"] == pytest.approx(
            np.linalg.norm(np.linalg.solve(GAIN_G, np.full(3, 2e-4)))
            * (high - 25.0 if high - 25 > 25 - low else 25 - low),
            rel=1e-2,
        )


DEVICE = sorted(
    name for name, each in CATALOGUE.items() if each.scope == "device" and not name.startswith(("setup", "mag"))
)
SOME = ["accel.misalignment_temperature", "accel.size_effect", "gyro.dead_band", "gyro.lag", "gyro.thermal_hysteresis"]


@pytest.mark.parametrize("names", [SOME, pytest.param(DEVICE, marks=pytest.mark.slow)], ids=["some", "all"])
def test_every_effect_of_a_device_has_a_cost(names):
    calibration = unit(GAIN_A, *(CATALOGUE[name].make(CATALOGUE[name].typical) for name in names))
    parameters = ExportedUnit.of(calibration)
    found = losses(parameters, writer("npz").write(parameters), Range.of(calibration))
    assert all(np.isfinite(list(each.worst.values())).all() for each in found)
    assert set(names) <= {each.what.removeprefix("the effect ") for each in found}


def test_axes_are_undone():
    """A log read with FRD: the file is for outputs in the logger's own axes."""
    calibration = unit(FULL_A)
    turn = np.diag([1.0, -1.0, -1.0])
    y_a, y_g, f, w = both(calibration)
    found = yaml(text("ros-yaml", calibration, axes="FRD"))["/**"]["ros__parameters"]["imu_calibration"]
    for name, output, wanted in (("accelerometer", y_a, f), ("gyroscope", y_g, w)):
        matrix = np.reshape(found[name]["matrix"], (3, 3))
        close((output @ turn - found[name]["bias"]) @ matrix.T, wanted @ turn)
    parameters = ExportedUnit.of(calibration, axes="FRD")
    (only,) = losses(parameters, writer("ros-yaml").write(parameters), Range.of(calibration))
    assert "uncertainty" in only.what


# --- the command


@pytest.mark.parametrize("to", sorted(WRITERS))
def test_export_prints_the_equation_and_writes(tmp_path, capsys, to):
    unit().save(tmp_path / "calibration.json")
    noise = tmp_path / "imu.yaml"
    noise.write_text("".join(f"{key}: {value:.5e}  # unit\n" for key, value in NOISE.items()))
    before = set(tmp_path.iterdir())
    assert main(["export", str(tmp_path / "calibration.json"), "--to", to, "--noise", str(noise)]) == 0
    printed = capsys.readouterr()
    assert ("imu.yaml is not used" in printed.err) == (to not in ("kalibr", "openvins", "vins"))
    assert ("--noise-for" in printed.err) == (to in ("px4", "ardupilot"))
    assert "Convention:" in printed.out and "Apply:" in printed.out and "Written:" in printed.err
    assert len(set(tmp_path.iterdir()) - before) == (2 if to == "imu_tk" else 1)
    assert main(["export", str(tmp_path / "calibration.json"), "--to", to, "--noise", str(noise), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["format"] == to and document["files"]


@pytest.mark.parametrize("to", sorted(WRITERS))
def test_an_accelerometer_alone(tmp_path, to):
    export(ExportedUnit.of(unit(gyroscope=False), noise=NOISE), to, tmp_path / "unit.txt")


@pytest.mark.parametrize("to", ["px4", "ardupilot", "realsense", "openvins", "vins"])
def test_tools_that_never_see_counts(to):
    with pytest.raises(NotPossibleError, match="in count"):
        text(to, unit(counts=True), noise=NOISE)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--to", "kaliber"], "did you mean 'kalibr'"),
        (["--to", "px4", "--temperature-range", "50,10"], "lowest first"),
        (["--to", "px4", "--temperature-range", "warm"], "LOW,HIGH"),
        (["--to", "px4", "--rate-range", "-1"], "--rate-range"),
        (["--to", "px4", "--instance", "-1"], "--instance"),
        (["--to", "ardupilot", "--instance", "7"], "--instance"),
        (["--to", "px4", "--axes", "up"], "--axes"),
        (["--to", "vins", "--noise", "calibration.json"], "jaximu allan -o"),
        (["--to", "vins", "--noise", "nowhere.yaml"], "cannot be read"),
    ],
)
def test_bad_usage(tmp_path, monkeypatch, capsys, arguments, said):
    monkeypatch.chdir(tmp_path)
    unit().save("calibration.json")
    assert main(["export", "calibration.json", *arguments]) == 2
    message = capsys.readouterr().err
    assert said in message and "Traceback" not in message
    assert [each.name for each in tmp_path.iterdir()] == ["calibration.json"]


def test_noise_is_read_from_text_only(tmp_path):
    (tmp_path / "imu.yaml").write_text("!!python/object/apply:os.system ['true']\n")
    with pytest.raises(InputError, match="holds none of"):
        read_noise(tmp_path / "imu.yaml")


# --- magnetometers


GAIN_M, BIAS_M = np.eye(3) + np.random.default_rng(9).normal(0, 0.05, (3, 3)), np.array([12.0, -31.0, 7.5])
TURNED = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def compass(gain=GAIN_M, alone: bool = False) -> Calibration:
    """A unit with a magnetometer, and without what accelerometer and gyroscope were found to be, or alone."""
    base = unit()
    imu = replace(base.imu, magnetometer=Triad(gain, BIAS_M, (), "magnetic_field", "uT"))
    names = tuple(name for name in names_of(imu) if not alone or name.owner == "magnetometer")
    magnetic = {"field": {"strength": {"value": 48.0, "sigma": 0.1, "unit": "uT"}, "dip": None}, "heading_error": None,
                "coverage": 1.0, "norm_spread": {}, "gyroscope_bias": None, "disturbed": []}  # fmt: skip
    covariance = np.diag(np.full(len(names), 1e-8))
    absent = ("accelerometer", "gyroscope") if alone else ()
    return replace(base, imu=imu, names=names, covariance=covariance, magnetic=magnetic, absent=absent)


def seen(gain) -> tuple[np.ndarray, np.ndarray]:
    """Fields of 48 µT in all directions (n, 3), and what the magnetometer makes of them."""
    field = np.random.default_rng(2).normal(size=(4000, 3))
    field *= 48.0 / np.linalg.norm(field, axis=1, keepdims=True)
    return field, field @ gain.T + BIAS_M


def square(values, stem: str, words: tuple[str, str]) -> np.ndarray:
    """The symmetric matrix of an autopilot's diagonal and off-diagonal parameters."""
    (x, y, z), (xy, xz, yz) = ([values[stem.format(word=word, axis=axis)] for axis in "XYZ"] for word in words)
    return np.array([[x, xy, xz], [xy, y, yz], [xz, yz, z]])


@pytest.mark.parametrize("axes", [np.eye(3), TURNED], ids=["along", "turned"])
@pytest.mark.parametrize("alone", [False, True])
def test_px4_magnetometer(axes, alone):
    """Magnetometer.hpp: rotation · (scale · (data − offset)), gauss; exact for a symmetric gain."""
    symmetric = np.array([[1.05, 0.03, -0.02], [0.03, 0.97, 0.01], [-0.02, 0.01, 1.01]])
    for gain, worst in ((symmetric @ axes.T, 1e-9), (GAIN_M @ axes.T, None)):
        calibration = compass(gain, alone)
        written = writer("px4").write(ExportedUnit.of(calibration, instance=2, device=7))
        values = qgroundcontrol(written.files[""].decode())
        assert values["CAL_MAG2_ID" if alone else "CAL_ACC2_ID"] == 7 and ("CAL_ACC2_XOFF" in values) != alone
        assert ("CAL_MAG2_ID are the sensor's" in written.convention) != alone  # another device than the IMU
        matrix = square(values, "CAL_MAG2_{axis}{word}", ("SCALE", "ODIAG"))
        offset = np.array([values[f"CAL_MAG2_{axis}OFF"] for axis in "XYZ"])
        field, output = seen(gain)
        made = 100 * ((0.01 * output - offset) @ matrix.T) @ axes.T
        off = np.linalg.norm(made - field, axis=1).max()
        said = losses(ExportedUnit.of(calibration), written, Range.of(calibration))[0]
        assert off < worst if worst else off == pytest.approx(said.worst["magnetometer"], rel=0.1)
        assert ("CAL_MAG2_ROT" in written.convention) == (not np.array_equal(axes, np.eye(3)))


@pytest.mark.parametrize("axes", [np.eye(3), TURNED], ids=["along", "turned"])
def test_ardupilot_magnetometer(axes):
    """correct_field: mag += offsets; mag = [[dx, ox, oy], [ox, dy, oz], [oy, oz, dz]] mag; milligauss."""
    symmetric = np.array([[1.05, 0.03, -0.02], [0.03, 0.97, 0.01], [-0.02, 0.01, 1.01]])
    calibration = compass(symmetric @ axes.T)
    rows = [line.split(",") for line in text("ardupilot", calibration, instance=1).splitlines() if line[0] != "#"]
    values = {name: float(value) for name, value in rows}
    matrix = square(values, "COMPASS_{word}2_{axis}", ("DIA", "ODI"))
    offset = np.array([values[f"COMPASS_OFS2_{axis}"] for axis in "XYZ"])
    field, output = seen(symmetric @ axes.T)
    made = 0.1 * (10 * output @ axes.T + offset) @ matrix.T
    close(made, field)


@pytest.mark.parametrize("alone", [False, True])
@pytest.mark.parametrize("to", ["c-header", "fusion", "ros-yaml", "csv", "npz", "px4", "ardupilot"])
def test_a_magnetometer_is_exported(tmp_path, capsys, to, alone):
    compass(alone=alone).save(tmp_path / "calibration.json")
    assert main(["export", str(tmp_path / "calibration.json"), "--to", to]) == 0
    printed = capsys.readouterr().out
    assert "h [" in printed and ("magnetometer" in printed or to in ("px4", "ardupilot"))
    field, output = seen(GAIN_M)
    exact = writer(to).write(ExportedUnit.of(compass(alone=alone))).corrections["magnetometer"]
    if to not in ("px4", "ardupilot"):
        close(exact.apply(output), field)


FUSION_TYPES = """
typedef union { float array[3]; struct { float x, y, z; } axis; } FusionVector;
typedef union { float array[3][3]; struct { float xx, xy, xz, yx, yy, yz, zx, zy, zz; } element; } FusionMatrix;
"""


@pytest.mark.parametrize("counts", [False, True])
def test_fusion_makes_of_its_constants_what_the_calibration_does(tmp_path, counts):
    """FusionCalibrationInertial: misalignment · (sensitivity ∘ (y − offset)), in g and deg/s."""
    calibration = unit(FULL_A, counts=counts)
    export(ExportedUnit.of(calibration), "fusion", tmp_path / "calibration.h")
    if gcc := shutil.which("gcc"):
        (tmp_path / "Fusion.h").write_text(FUSION_TYPES)
        flags = ["-std=c11", "-Wall", "-Wextra", "-Werror", "-Wno-unused-variable", "-Wno-unused-const-variable"]
        (tmp_path / "main.c").write_text('#include "calibration.h"\nint main(void) { return 0; }\n')
        subprocess.run([gcc, *flags, "-fsyntax-only", "main.c"], cwd=tmp_path, check=True)
    constants = {name: np.array([float(each) for each in re.findall(r"(-?[\d.][\d.e+-]*)f", numbers)])
                 for name, numbers in re.findall(r"(\w+) = \{(.*)\};", text("fusion", calibration))}  # fmt: skip
    y_a, y_g, f, w = both(calibration)
    for triad, output, wanted in (("accelerometer", y_a, f / 9.80665), ("gyroscope", y_g, np.degrees(w))):
        matrix, scale, offset = (constants[triad + each] for each in ("Misalignment", "Sensitivity", "Offset"))
        close(scale * (output - offset) @ matrix.reshape(3, 3).T, wanted)
        assert np.diagonal(matrix.reshape(3, 3)).tolist() == [1.0, 1.0, 1.0]


def test_tools_without_a_magnetometer(tmp_path, capsys):
    compass(alone=True).save(tmp_path / "calibration.json")
    assert main(["export", str(tmp_path / "calibration.json"), "--to", "kalibr"]) == 2
    assert "a magnetometer alone" in capsys.readouterr().err
    compass().save(tmp_path / "calibration.json")
    assert main(["export", str(tmp_path / "calibration.json"), "--to", "realsense"]) == 0
