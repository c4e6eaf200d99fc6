"""Poses and turns by hand while the temperature changes: what was put in comes out, what is not told is said."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from commands import result_of

from jaximu.calibration import compensate, load_calibration
from jaximu.cli.app import main
from jaximu.diagnosis import thermal_hand_held
from jaximu.diagnosis.thermal_hand_held import calibrate_thermal_by_hand, turned_by_hand
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.gravity import LocalGravity
from jaximu.ground.page import Section, Table
from jaximu.model.effects import CATALOGUE
from jaximu.recordings import write_recording
from jaximu.simulation import simulate
from jaximu.simulation.draw import consumer_noise, draw_imu
from jaximu.simulation.protocols import Environment, HandHeld, SoakAndRamp

GRAVITY = LocalGravity(9.81, 0.0)
LENGTH = 50 * 5.5
WARM = [[0, 15.0], [LENGTH / 2, 45.0], [LENGTH, 15.0]]
EFFECTS = {
    "accel.temperature": [3e-3, -2e-3, 4e-3],
    "accel.scale_temperature": [3e-4, -2e-4, 2e-4],
    "gyro.temperature": [3e-4, -2e-4, 1e-4],
    "gyro.scale_temperature": [3e-4, -2e-4, 3e-4],
}


def by_hand(seed, effects=(), kelvin=WARM):
    unit = draw_imu(seed).with_effects(*(CATALOGUE[name].make(EFFECTS[name]) for name in effects))
    return simulate(unit, HandHeld(50), consumer_noise(), rate=50.0, seed=seed,
                    environment=Environment(gravity=9.81, temperature=kelvin))[0]  # fmt: skip


@pytest.fixture(scope="module")
def commanded(tmp_path_factory):
    """The command on a recording by hand: its folder, what was fitted in it and what it printed."""
    folder = tmp_path_factory.mktemp("by_hand")
    write_recording(by_hand(1, EFFECTS), folder / "log.csv")
    line = ["thermal", str(folder / "log.csv"), "--gravity", "9.81+-0", "-o", str(folder / "out"), "--json"]
    return folder, *result_of(line, thermal_hand_held, "calibrate_thermal_by_hand")


@pytest.fixture(scope="module")
def found(commanded):
    return commanded[1]


def test_what_was_put_in_comes_out_with_its_spread(found):
    assert {name for name, *_ in found.steps} == set(EFFECTS)
    assert all(gain > 0 for *_, gain in found.steps)
    document, z = found.calibration.document(), []
    for triad in ("accelerometer", "gyroscope"):
        for name, entry in document[triad]["effects"].items():
            z += list((np.array(entry["coefficients"]) - EFFECTS[name]) / np.array(entry["sigma"]))
    truth = draw_imu(1)
    sigma = dict(zip(found.calibration.names, np.sqrt(np.diag(found.calibration.covariance)), strict=True))
    for name, triad in found.calibration.triads().items():
        own = getattr(truth, name)
        z += [(triad.bias[k] - own.bias[k]) / sigma[f"{name}.bias[{k}]"] for k in range(3)]
    assert len(z) == 18 and np.max(np.abs(z)) < 4 and 0.3 < np.sqrt(np.mean(np.square(z))) < 1.6


def test_the_report_s_numbers(found):
    """Errors at rest with one bias by hand: the gyroscope's slope over temperature times the poses' warmth."""
    poses = found.experiment.data.observations.poses
    kelvin = np.asarray(poses.temperature)[np.asarray(poses.mask)]
    expected = np.degrees(np.linalg.norm(EFFECTS["gyro.temperature"]) * np.std(kelvin))
    (said,) = (line for line in str(found.summary()).splitlines() if line.startswith("Rate at rest"))
    ratio = float(re.findall(r"[\d.]+", said)[0]) / expected
    assert 0.995 < ratio < 1.02  # about a bias that the turns have a say in, errors are larger than about their mean
    names = [CATALOGUE[name].title for name, *_ in found.steps]
    (hiding,) = (part for part in found.summary().first if isinstance(part, Section) and "hide" in part.title)
    (table,) = (part for part in hiding.parts if isinstance(part, Table))
    rows = {name: size for name, _, size in table.rows}
    assert names and not set(rows) & set(names)
    limit, unit = found.limits["accel.temperature_squared"]
    assert unit == "(m/s^2)/K^2"
    shown = rows[CATALOGUE["accel.temperature_squared"].title]
    assert float(shown.split()[0]) == pytest.approx(1e3 * limit * 20**2, rel=0.03) and shown.endswith("mm/s²")


def test_what_is_not_there_is_not_taken_in_and_could_hide_below_a_limit(found):
    assert "accel.misalignment_temperature" in found.limits and "gyro.misalignment_temperature" in found.limits
    nothing = calibrate_thermal_by_hand(by_hand(2), gravity=GRAVITY)
    assert not nothing.steps and not nothing.calibration.imu.accelerometer.effects
    assert 0 < nothing.limits["accel.scale_temperature"][0] < 1e-4
    assert "show no effect of temperature" in nothing.summary().verdict[0]


def test_it_compensates_another_recording(found, tmp_path):
    """Gravity in the poses of another recording of the unit, at temperatures that change: by the file, and without."""
    found.calibration.save(tmp_path / "calibration.json")
    loaded = load_calibration(tmp_path / "calibration.json")
    other = by_hand(1, EFFECTS, [[0, 42.0], [LENGTH, 18.0]])
    errors = []
    for calibration in (loaded, replace(loaded, imu=loaded.imu.with_effects())):
        force = compensate(calibration, other).accelerometer
        part = force.values[(force.time > 0.5) & (force.time < 3.5)]
        errors.append(abs(np.linalg.norm(part.mean(axis=0)) - 9.81))
    assert errors[0] < 0.002 < 0.01 < errors[1]


def test_which_recordings_are_by_hand():
    assert turned_by_hand(by_hand(1, EFFECTS))
    chamber, _ = simulate(draw_imu(1), SoakAndRamp(low=0, high=40, rates=(4.0,), soak_duration=60.0), rate=2.0, seed=1)
    assert not turned_by_hand(chamber)
    assert not turned_by_hand(replace(chamber, gyroscope=None))


def test_it_needs_temperature_that_changes():
    recording = by_hand(1, EFFECTS)
    with pytest.raises(NotPossibleError, match="need gyroscope and temperature"):
        calibrate_thermal_by_hand(replace(recording, temperature=None))
    assert recording.temperature is not None
    still = replace(recording.temperature, values=np.full_like(recording.temperature.values, 20.0))
    with pytest.raises(NotPossibleError, match=r"only goes from 20\.00 to 20\.00"):
        calibrate_thermal_by_hand(replace(recording, temperature=still))


def test_the_command(commanded, tmp_path, capsys):
    folder, found, printed = commanded
    log, document = folder / "log.csv", json.loads(printed)
    assert document["kind"] == "hand-held"
    assert {each["name"] for each in document["effects"]} == set(EFFECTS)
    page = (folder / "out" / "report.html").read_text(encoding="utf-8")
    assert "accel.misalignment_temperature" in page and page.count("<svg ") == 2
    kept = load_calibration(folder / "out" / "calibration.json")
    assert kept.reading is not None and "temperature" in kept.reading.units
    for name, triad in found.calibration.triads().items():
        assert [each.name for each in kept.triads()[name].effects] == [each.name for each in triad.effects]
    assert main(["thermal", str(log), "--gravity", "9.81+-0"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "accel.scale_temperature" in shown and "could hide" in shown
    assert main(["thermal", str(log), "--to", "px4", "-o", str(tmp_path / "out")]) == 2
    assert "for a unit at rest" in capsys.readouterr().err
