"""Budgets of navigation against the polynomial of level flight, against draws, and what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

from jaximu import InputError, LocalGravity, NotPossibleError
from jaximu.calibration import Calibration
from jaximu.cli.app import main
from jaximu.estimation.problem import names_of
from jaximu.model.effects import CATALOGUE
from jaximu.navigation.consequences import consequences, position
from jaximu.navigation.trajectory import Place, level_driving
from jaximu.noise.stated import read_sensor_noise
from jaximu.simulation import draw_imu

PLACE = Place(45.0, 0.0, LocalGravity(9.80665, 0.0))
SIGMA = {("accelerometer", "bias"): 3e-3, ("accelerometer", "gain"): 2e-4, ("gyroscope", "bias"): 2e-4,
         ("gyroscope", "gain"): 5e-4, ("gyroscope", "coefficients"): 1e-5}  # fmt: skip
NOISE = {
    "accelerometer": {"N": np.full(3, 2e-3), "K": np.full(3, 3e-4)},
    "gyroscope": {"N": np.full(3, 4e-4), "B": np.full(3, 2e-4)},
}
DURATION = 20.0


def calibration_of(imu, sigma=SIGMA):
    names = tuple(name for name in names_of(imu) if (name.owner, name.part) in sigma)
    covariance = np.diag([sigma[name.owner, name.part] ** 2 for name in names])
    return Calibration(
        imu, names, covariance, PLACE.gravity, "joint", "linear", {}, len(names), (), {}, "converged", {}
    )


@pytest.fixture(scope="module")
def unit():
    return draw_imu(2).with_effects(CATALOGUE["gyro.g_sensitivity"].make(3e-5))


@pytest.fixture(scope="module")
def found(unit):
    other = calibration_of(draw_imu(2).with_effects(CATALOGUE["gyro.g_sensitivity"].make(0.0)))
    return consequences(calibration_of(unit), level_driving(PLACE, DURATION), NOISE, draws=200, against=other)


def test_at_rest_terms_follow_the_polynomial(found, unit):
    # δp = ½ δb_a t² + (1/6) g δb_g t³ of each axis, and noise N t^(3/2)/√3; the unit's gain turns a bias by 2 %
    time, gravity = found.times[4], PLACE.gravity.value
    assert time == 5.0
    bias = position(found.terms["accelerometer bias"])[4]
    assert bias == pytest.approx(np.sqrt(3) * 3e-3 * time**2 / 2, rel=0.04)
    drift = position(found.terms["gyroscope bias"])[4]
    assert drift == pytest.approx(np.sqrt(2) * gravity * 2e-4 * time**3 / 6, rel=0.04)
    scale = position(found.terms["accelerometer scale"])[4]
    assert scale == pytest.approx(gravity * 2e-4 * time**2 / 2, rel=0.04)
    white = position(found.terms["accelerometer white noise N"])[4]
    assert white == pytest.approx(np.sqrt(3) * 2e-3 * time**1.5 / np.sqrt(3), rel=0.01)
    walk = position(found.terms["accelerometer rate random walk K"])[4]
    assert walk == pytest.approx(np.sqrt(3) * 3e-4 * time**2.5 / np.sqrt(20), rel=0.01)
    turning = position(found.terms["gyroscope white noise N"])[4]
    assert turning == pytest.approx(np.sqrt(2) * gravity * 4e-4 * time**2.5 / np.sqrt(20), rel=0.01)
    sensitivity = position(found.terms["gyroscope g-sensitivity"])[4]
    assert sensitivity == pytest.approx(np.sqrt(2) * gravity**2 * 1e-5 * time**3 / 6, rel=0.04)


def test_draws_scatter_as_the_budget_says(found):
    ratio = found.check.sigma / np.sqrt(found.total)
    assert found.check.errors.shape == (200, len(found.times), 9)
    assert np.abs(ratio - 1).max() < 4 / np.sqrt(2 * 200)


def test_the_budget_adds_up(found):
    parts = np.sum([position(each) ** 2 for each in found.terms.values()], axis=0)
    np.testing.assert_allclose(parts, position(found.total) ** 2, rtol=1e-9)  # a diagonal covariance
    for kind, rest in found.known.items():
        np.testing.assert_allclose(found.calibration - rest, found.terms[kind], atol=1e-9 * found.calibration.max())
    (first, start, stop), *rest = found.dominant()
    assert start == 0.0 and first in found.terms
    assert [each[1] for each in rest] == [stop, *(each[2] for each in rest)][:-1]


def test_what_is_left_out_shows_in_position(found, unit):
    gravity, time = PLACE.gravity.value, found.times[4]
    sensed = 3e-5 * gravity * np.array([1.0, 1.0])  # the drift that g-sensitivity makes about the level axes
    expected = gravity * np.linalg.norm(sensed) * time**3 / 6
    assert found.left_out["gyroscope g-sensitivity"][4] == pytest.approx(expected, rel=0.05)
    assert np.linalg.norm(found.apart[4, :3]) == pytest.approx(expected, rel=0.05)


def test_a_known_kind_takes_its_correlations_along(unit):
    calibration = calibration_of(unit)
    rows = [place for place, name in enumerate(calibration.names) if name.part == "bias" and name.owner == "gyroscope"]
    other = [place for place, name in enumerate(calibration.names) if name.part == "bias" and name.owner != "gyroscope"]
    covariance = calibration.covariance.copy()
    for a, b in zip(rows, other, strict=True):
        covariance[a, b] = covariance[b, a] = 0.99 * np.sqrt(covariance[a, a] * covariance[b, b])
    found = consequences(replace(calibration, covariance=covariance), level_driving(PLACE, 5.0), draws=0)
    left = found.known["gyroscope bias"]
    shrunk = position(found.terms["accelerometer bias"])[-1] * np.sqrt(1 - 0.99**2)
    others = [each for name, each in found.terms.items() if not name.endswith("bias")]
    assert position(left)[-1] == pytest.approx(np.hypot(shrunk, position(np.sum(others, axis=0))[-1]), rel=1e-6)


def test_a_calibration_that_states_nothing_is_refused(unit):
    path = level_driving(PLACE, 5.0)
    with pytest.raises(NotPossibleError, match="covariance"):
        consequences(calibration_of(unit, {}), path)
    with pytest.raises(NotPossibleError, match="gyroscope"):
        consequences(calibration_of(replace(draw_imu(0), gyroscope=None)), path)
    with pytest.raises(InputError, match="other units"):
        counts = replace(unit, accelerometer=replace(unit.accelerometer, output_unit="count"))
        consequences(calibration_of(unit), path, against=calibration_of(counts))


def test_a_path_beyond_the_range_is_refused():
    with pytest.raises(NotPossibleError, match=r"gyroscope's range of ±10 °/s.*after the start"):
        level_driving(PLACE, 60.0).require_range({"gyroscope": np.radians(10.0)})
    level_driving(PLACE, 60.0).require_range({"gyroscope": np.radians(60.0), "accelerometer": 20.0})
    with pytest.raises(NotPossibleError, match="duration="):
        level_driving(PLACE, 3600.0)


def noise_file(path, unit="rad/s/sqrt(Hz)"):
    term = {"value": 0.01, "low": 0.0, "high": 1.0} | ({"unit": unit} if unit else {})
    axes = [{"terms": {"N": term, "B": None, "K": None}}] * 3
    path.write_text(json.dumps({"schema": "jaximu.allan/1", "accelerometer": None, "gyroscope": axes}))
    return path


def test_noise_is_read_in_the_units_it_states(tmp_path):
    found = read_sensor_noise(noise_file(tmp_path / "a.json", "deg/s/sqrt(Hz)"))
    np.testing.assert_allclose(found["gyroscope"]["N"], np.radians(0.01))
    unstated = noise_file(tmp_path / "b.json", None).read_text()
    damaged = '{"schema": "jaximu.allan/1", "gyroscope": 3}'
    for text, said in ((unstated, "no unit"), ("gyro_n: 1e-3", "state its units"), ('{"N": 3}', "allan.json"),
                       (damaged, "damaged")):  # fmt: skip
        (tmp_path / "bad.json").write_text(text)
        with pytest.raises(InputError, match=said):
            read_sensor_noise(tmp_path / "bad.json")


SPECIFICATION = """
rate = 50
[protocol]
kind = "hand-held"
poses = 4
[artefacts]
clipping = { gyroscope = 5.0 }
"""


def test_the_command_writes_what_it_prints(unit, tmp_path, capsys):
    calibration_of(unit).save(tmp_path / "calibration.json")
    (tmp_path / "spec.toml").write_text(SPECIFICATION)
    noise = noise_file(tmp_path / "allan.json")
    line = ["consequences", str(tmp_path / "calibration.json"), "--path", str(tmp_path / "spec.toml"), "--draws", "25",
            "--duration", "12", "--noise", str(noise)]  # fmt: skip
    assert main([*line, "--json", "-o", str(tmp_path / "out")]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == json.loads((tmp_path / "out" / "consequences.json").read_text())
    assert document["schema"] == "jaximu.consequences/1" and document["times"][-1] == 12.0
    count = len(document["times"])
    for name in ("position_sigma", "velocity_sigma", "attitude_sigma"):
        assert np.shape(document[name]) == (count, 3)
    assert {"term", "position"} == set(document["budget"][0])
    assert all(len(each["position"]) == count for each in document["budget"])
    page = (tmp_path / "out" / "report.html").read_text()
    assert "position is off by" in page and str(tmp_path) not in page
    assert {"budget.png", "tracks.png"} <= {path.name for path in (tmp_path / "out").iterdir()}
    assert main([*line[:4], "--gyro-range", "30 deg/s", "-o", str(tmp_path / "none")]) == 1
    assert "leaves the gyroscope's range" in capsys.readouterr().err
    assert not any((tmp_path / "none").iterdir())


def test_a_recorded_motion_needs_a_start(data_folder, unit, tmp_path, capsys):
    calibration_of(unit).save(tmp_path / "calibration.json")
    line = ["consequences", str(tmp_path / "calibration.json"), "--path", str(data_folder / "euroc" / "MH03.imu.txt")]
    assert main(line) == 1
    assert "neither a rest" in capsys.readouterr().err
