"""`jaximu magnetometer`: soft and hard iron, alignment, dip and heading against known truth and measured data."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from magnetic_motion import PERFECT, bent, turned
from scipy.spatial.transform import Rotation

from jaximu.calibration import FieldStrength, MagneticLog, calibrate_magnetometer, compensate, load_calibration
from jaximu.calibration.magnetometer import field_advice, hard_iron
from jaximu.cli import main
from jaximu.diagnosis import check_magnetometer, diagnose_magnetometer
from jaximu.estimation.fitting import Prior, informed
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.mistakes import prepare
from jaximu.model.effects import CATALOGUE
from jaximu.recordings import write_recording
from jaximu.recordings.readers import ReadOptions, read_magnetometer
from jaximu.recordings.recording import Recording, Signal
from jaximu.report.magnetometer import next_words, page_of, statements

FULL = "mpu6050_hmc5883l/full_sphere"


def fitted(case, strength=48.0, recording=True, **options):
    log = MagneticLog(case.magnetometer, case.recording if recording else None)
    known = None if strength is None else FieldStrength(strength)
    return calibrate_magnetometer([log], known, PERFECT, **options)


def off(calibration, case):
    """Errors of gain and bias over their standard deviations."""
    triad = calibration.imu.magnetometer
    gain, bias = calibration.sigma("magnetometer")
    return np.concatenate([((triad.gain - case.gain) / gain).ravel(), (triad.bias - case.bias) / bias])


@pytest.fixture(scope="module")
def cases():
    return [turned(seed) for seed in range(6)]


@pytest.fixture(scope="module")
def calibrations(cases):
    return [fitted(case) for case in cases[:4]]


@pytest.fixture(scope="module")
def swung():
    """A unit that was turned by ±30° only, and its calibration."""
    case = turned(11, reach=0.5)
    return case, *fitted(case)[:2]


def test_iron_and_alignment_lie_within_their_intervals(cases, calibrations):
    errors = np.array([off(found, case) for case, (found, _, _) in zip(cases[:4], calibrations, strict=True)])
    inside = int(np.sum(np.abs(errors) < 1.96))
    assert inside >= 39, errors  # of 48; a binomial of 0.95 has fewer in one of 10 000
    gains = [np.abs(found.imu.magnetometer.gain - case.gain).max()
             for case, (found, _, _) in zip(cases[:4], calibrations, strict=True)]  # fmt: skip
    assert max(gains) < 0.005


def test_dip_and_heading(cases, calibrations):
    for case, (found, _, heading) in zip(cases[:4], calibrations, strict=True):
        dip = found.magnetic["field"]["dip"]
        assert abs(dip["value"] - np.degrees(case.dip)) < 4 * dip["sigma"] + 0.1
        assert found.magnetic["heading_error"]["rms"] < 0.5 < found.magnetic["heading_error"]["before"]["rms"]
        assert heading.sigma.shape == heading.before.shape == (6, 24)


def test_the_size_of_the_hard_iron_scatters_as_drawn_calibrations(calibrations):
    found, rng = calibrations[0][0], np.random.default_rng(0)
    rows = [k for k, name in enumerate(found.names) if name.owner == "magnetometer"]
    sizes = []
    for change in rng.multivariate_normal(np.zeros(len(rows)), found.covariance[np.ix_(rows, rows)], 2000):
        gain, bias = found.imu.magnetometer.gain.copy(), found.imu.magnetometer.bias.copy()
        for row, value in zip(rows, change, strict=True):
            (gain if found.names[row].part == "gain" else bias)[found.names[row].axes] += value
        sizes.append(np.linalg.norm(np.linalg.solve(gain, bias)))
    iron, sigma = hard_iron(found)
    assert iron == pytest.approx(np.mean(sizes), abs=0.2 * sigma) and sigma == pytest.approx(np.std(sizes), rel=0.1)
    assert f"± {1.96 * sigma:.2g} µT (95 %)" in "".join(line.text for line in statements(found))


def test_the_error_before_calibration_is_that_of_the_readings(cases, calibrations):
    """Less the hard iron it was 2.6 µT of 40."""
    found, values = calibrations[0][0], cases[0].magnetometer.values
    strength = found.magnetic["field"]["strength"]["value"]
    raw = np.sqrt(np.mean((np.linalg.norm(values, axis=1) - strength) ** 2))
    before, after, _ = found.rms["field_strength"]
    assert before == pytest.approx(raw, rel=0.1) and after < 0.1 * before


def test_heading_errors_are_those_of_drawn_calibrations(cases, calibrations):
    """The stated sigma is the scatter of headings that calibrations drawn from the covariance would give."""
    from scipy.spatial.transform import Rotation

    (found, _, heading), rng = calibrations[0], np.random.default_rng(0)
    gain, bias = found.imu.magnetometer.gain, found.imu.magnetometer.bias
    rows = [k for k, name in enumerate(found.names) if name.owner == "magnetometer"]
    names = [found.names[k] for k in rows]
    # strength as good as known: what it adds to all gains turns no heading
    covariance = found.covariance[np.ix_(rows, rows)]
    dip = np.radians(found.magnetic["field"]["dip"]["value"])
    north = found.magnetic["field"]["strength"]["value"] * np.array([0.0, np.cos(dip), -np.sin(dip)])
    attitude = Rotation.from_euler("ZYX", [[75.0, 0.0, 45.0]], degrees=True)  # heading 75, rolled by 45
    output = attitude.inv().apply(north) @ gain.T + bias
    drawn = []
    for change in rng.multivariate_normal(np.zeros(len(rows)), covariance, 4000):
        moved, shifted = gain.copy(), bias.copy()
        for name, value in zip(names, change, strict=True):
            (moved if name.part == "gain" else shifted)[name.axes] += value
        level = attitude.apply(np.linalg.solve(moved, (output - shifted)[0]))[0]
        drawn.append(np.degrees(np.arctan2(level[0], level[1])))
    assert np.std(drawn) == pytest.approx(heading.sigma[1, 5], rel=0.06)


def test_a_gyroscope_tells_hard_iron_from_small_turns(swung):
    """±30° of motion cover little of the sphere, on which no ellipsoid can be fitted."""
    case, found, _ = swung
    assert found.magnetic["coverage"] < 0.3
    rows = [k for k, name in enumerate(found.names) if name.owner == "magnetometer" and name.part == "bias"]
    error = found.imu.magnetometer.bias - case.bias
    assert error @ np.linalg.solve(found.covariance[np.ix_(rows, rows)], error) < 16.3  # χ², three, one in a thousand
    with pytest.raises(NotPossibleError, match="Turn the unit slowly"):
        fitted(case, recording=False)


def test_a_heading_that_is_less_certain_than_it_was_wrong_is_no_improvement():
    """Almost without iron, turned about the vertical with tilts of 4°: known to 12°, off by 2.4° as it was logged."""
    random, time = np.random.default_rng(4), np.arange(0, 120, 0.02)
    tilts = np.radians(4) * np.stack([np.sin(0.7 * time), np.cos(0.5 * time)], axis=1)
    attitude = Rotation.from_euler("ZXY", np.column_stack([0.5 * time, tilts]))
    turns = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / 0.02
    field = attitude.inv().apply(44.5 * np.array([0, np.cos(np.radians(65)), -np.sin(np.radians(65))]))
    noises = random.standard_normal((3, len(time), 3))
    force = attitude.inv().apply([0, 0, 9.80665]) + 0.02 * noises[0]
    rate = np.vstack([turns, turns[-1]]) + 0.001 * noises[1]
    recording = Recording(Signal(time, force, "m/s^2"), Signal(time, rate, "rad/s"))
    log = MagneticLog(Signal(time, field + [1.0, -0.5, 0.7] + 0.3 * noises[2], "uT"), recording)
    calibration, measurement, heading = calibrate_magnetometer([log])
    error = calibration.magnetic["heading_error"]
    assert error["rms"] > error["before"]["rms"]
    (note,) = [note for note in calibration.notes if "whether that improves it is open" in note]
    assert "--calibration" in note
    (verdict, *_) = page_of(calibration, measurement, heading).verdict
    assert "more than the" in verdict and "without calibration it is off" not in verdict


def test_an_axis_that_hardly_turned_gravity_keeps_its_sign():
    """About a nearly vertical axis gravity tells the gyroscope's sign wrong; then hard iron was off by µT."""
    case = turned(1003, reach=0.5)
    found, _, _ = calibrate_magnetometer([MagneticLog(case.magnetometer, case.recording)], FieldStrength(48.0))
    rows = [k for k, name in enumerate(found.names) if name.owner == "magnetometer" and name.part == "bias"]
    error = found.imu.magnetometer.bias - case.bias
    assert error @ np.linalg.solve(found.covariance[np.ix_(rows, rows)], error) < 16.3


def test_the_next_directions_buy_what_they_say(swung):
    """Of a unit that was turned by ±30°: windows are added where it says, and the heading's covariance shrinks so."""
    _, found, measurement = swung
    plan = found.magnetic["next"]
    assert plan["heading_then"] < 0.9 * plan["heading_now"]
    assert next_words(plan).startswith("more orientations buy little")  # a fifth of a twentieth of a degree
    assert next_words(plan | {"heading_now": 1.0}).startswith("hold the unit so that the field points along its ")
    covered = measurement.windows.field(found.imu)
    covered /= np.linalg.norm(covered, axis=1, keepdims=True)
    assert (np.array(plan["directions"]) @ covered.T).max(axis=1).min() < np.cos(np.radians(30))  # where nothing was
    # the same by the information matrix of all rows at once
    names = [k for k, name in enumerate(found.fit.names) if name.owner == "magnetometer"]
    spread = found.fit.covariance[np.ix_(names, names)]
    gain, noise = found.imu.magnetometer.gain, measurement.windows.noise / np.sqrt(np.median(measurement.windows.count))
    sigma = np.hypot(noise / np.linalg.norm(gain, axis=1).mean(), 0.1 * np.sqrt(found.excess["magnetometer"]))
    unit = np.array(plan["directions"])

    def reaction(direction):
        back = np.linalg.inv(gain).T @ direction
        return [back[n.axes[0]] * (1.0 if n.part == "bias" else 48.0 * direction[n.axes[1]])
                for n in (found.fit.names[k] for k in names)]  # fmt: skip

    rows = np.array([reaction(each) for each in unit]) / sigma
    after = np.linalg.inv(np.linalg.inv(spread) + rows.T @ rows)
    dip = np.radians(found.magnetic["field"]["dip"]["value"])
    total = {"now": 0.0, "then": 0.0}
    for angle in np.radians(np.arange(0, 360, 15)):
        body = np.array([np.cos(dip) * np.sin(angle), np.cos(dip) * np.cos(angle), -np.sin(dip)])
        east = np.linalg.inv(gain).T @ np.array([np.cos(angle), -np.sin(angle), 0.0]) / (48.0 * np.cos(dip))
        slope = np.array([east[n.axes[0]] * (1.0 if n.part == "bias" else 48.0 * body[n.axes[1]])
                          for n in (found.fit.names[k] for k in names)])  # fmt: skip
        total["now"] += slope @ spread @ slope / 24
        total["then"] += slope @ after @ slope / 24
    assert plan["heading_now"] == pytest.approx(np.degrees(np.sqrt(total["now"])), rel=1e-6)
    assert plan["heading_then"] == pytest.approx(np.degrees(np.sqrt(total["then"])), rel=1e-6)


def test_alone_the_axes_frame_is_its_own(cases):
    """Without other sensors the gain is a lower triangle: KKᵀ and the bias are those of the truth."""
    found, _, heading = fitted(cases[0], recording=False)
    gain = found.imu.magnetometer.gain
    assert heading is None and not np.triu(gain, 1).any()
    np.testing.assert_allclose(gain @ gain.T, cases[0].gain @ cases[0].gain.T, atol=0.02)
    np.testing.assert_allclose(found.imu.magnetometer.bias, cases[0].bias, atol=0.3)
    assert found.document()["accelerometer"] is None and not found.from_data_sheet


def test_a_disturbed_stretch_is_left_out_and_told():
    case = turned(3, disturbed=(20.0, 24.0))
    found, _, _ = fitted(case)
    left = np.array(found.magnetic["disturbed"])
    assert left.min() > 18.5 and left.max() < 25.5 and len(left) >= 5
    assert any("disturbed" in note for note in found.notes)
    assert np.abs(off(found, case)).max() < 4.5


def test_a_field_that_was_another_for_much_of_the_recording_is_reported():
    case = turned(3)
    signal, near = case.magnetometer, (case.magnetometer.time % 20.0 < 9.0)[:, None]
    values = np.where(near, case.bias + 0.7 * (signal.values - case.bias), signal.values)
    found, _, _ = fitted(case._replace(magnetometer=replace(signal, values=values)), recording=False)
    assert any("not the same throughout" in note for note in found.notes)


def test_a_shaken_vertical_is_no_disturbed_field(cases):
    """Pulled sideways by a fifth of gravity the force keeps its size, but leaves the vertical by 11°."""
    recording, time = cases[0].recording, cases[0].recording.accelerometer.time
    force = recording.accelerometer.values
    across = np.cross(force, [0.0, 0.0, 1.0]) * np.sin(9.0 * time)[:, None]
    pulled = np.where(time % 20 > 17, 0.2, 0.0)[:, None] * across
    shaken = replace(recording, accelerometer=replace(recording.accelerometer, values=force + pulled))
    found, _, _ = fitted(cases[0]._replace(recording=shaken))
    assert not found.magnetic["disturbed"] and not any("disturbed" in note for note in found.notes)


def test_a_disturbance_across_the_field_hides_neither_itself_nor_the_hard_iron():
    """Its strength stays within 3 µT, which a fit of all windows takes for 1.7 µT of hard iron."""
    case = turned(3002, disturbed=(12.4, 16.4))
    found, measurement, _ = fitted(case)
    inside = (measurement.windows.time[:, 0] >= 12.4) & (measurement.windows.time[:, 1] <= 16.4)
    assert inside.sum() >= 5 and not measurement.windows.used[inside].any()
    assert np.linalg.norm(found.imu.magnetometer.bias - case.bias) < 0.05


def test_what_a_data_sheet_says_joins_a_fit_as_two_normal_laws_do(calibrations):
    """Information adds up: (C⁻¹ + P⁻¹)⁻¹ (C⁻¹ x + P⁻¹ m)."""
    found = calibrations[0][0].fit
    rows = [k for k, name in enumerate(found.names) if name.owner == "magnetometer"][:2]
    names, block = tuple(found.names[k] for k in rows), np.ix_(rows, rows)
    prior = Prior(names, np.asarray(found.values)[rows] + [0.01, -0.02], np.diag([300.0, 500.0]))
    joined = informed(found, prior)
    information = np.linalg.inv(found.covariance)
    added = np.zeros_like(information)
    added[block] = prior.root.T @ prior.root
    np.testing.assert_allclose(joined.covariance, np.linalg.inv(information + added), rtol=1e-6, atol=1e-14)
    target = information @ found.values
    target[rows] += added[block] @ prior.mean
    np.testing.assert_allclose(joined.values, np.linalg.solve(information + added, target), rtol=1e-6, atol=1e-9)
    assert joined.imu.magnetometer.gain[names[0].axes] == joined.values[rows[0]]


def test_stamps_in_bursts_held_rows_and_spikes_are_mended(cases):
    """As hosts log: forty samples arrive at once, each row is there twice, some transfers fail."""

    case, rng = cases[4], np.random.default_rng(0)
    time, values = case.magnetometer.time, case.magnetometer.values.copy()
    values[rng.choice(np.arange(20, 2980, 20), 30, replace=False)] += 400.0
    last = np.minimum(np.arange(len(time)) // 40 * 40 + 39, len(time) - 1)
    arrived = time[last] + 1e-4 * (np.arange(len(time)) % 40)
    spoiled = case._replace(magnetometer=Signal(arrived, values, "uT"))
    found, _, _ = fitted(spoiled)
    triad = found.imu.magnetometer  # a steady clock fitted to arrivals stays some ms off
    assert np.abs(triad.gain - case.gain).max() < 0.006 and np.abs(triad.bias - case.bias).max() < 0.3
    assert found.magnetic["norm_spread"]["after"] < 0.006
    assert any("magnetometer: the stamps come in bursts" in note for note in found.notes)
    assert any("magnetometer: 30 outliers" in note for note in found.notes)
    held = Signal(np.arange(2 * len(time)) * 0.01, np.repeat(values, 2, axis=0), "uT")
    ready = prepare(Recording(held, magnetometer=held), magnetometer=True)
    assert len(ready.recording.magnetometer) <= len(time) and "data.resampled" in {f.name for f in ready.findings}


def test_axes_that_lie_otherwise_are_found():
    case = turned(5, axes=np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    found, _, _ = fitted(case)
    assert np.abs(off(found, case)).max() < 4.5
    assert any("lie along" in note for note in found.notes)


def test_mirrored_axes_are_told_by_the_hemisphere():
    case = turned(6, axes=-np.eye(3))
    found, _, _ = fitted(case, southern=False)
    assert np.abs(off(found, case)).max() < 4.5
    blind, _, _ = fitted(case)
    assert any("points upward" in note for note in blind.notes)


def test_a_stated_dip_is_used_unless_the_recording_contradicts_it(swung):
    """Of ±30° of motion: alignment gets narrower and stays within its interval; a dip that is off is left out."""
    case, free, _ = swung
    stated, _, _ = calibrate_magnetometer(
        [MagneticLog(case.magnetometer, case.recording)], FieldStrength(48.0, dip=62.0, dip_sigma=0.01), PERFECT
    )
    narrower = stated.sigma("magnetometer")[0] / free.sigma("magnetometer")[0]
    assert narrower.max() < 1.02 and narrower.min() < 0.9
    assert np.abs(off(stated, case)).max() < 4 and stated.notes == free.notes
    wrong = FieldStrength(48.0, 0.1, dip=70.0, dip_sigma=0.2)
    bent, _, _ = calibrate_magnetometer([MagneticLog(case.magnetometer, case.recording)], wrong, PERFECT)
    assert any("off the stated dip of 70°" in note for note in bent.notes)
    assert bent.magnetic["field"]["dip"]["value"] == pytest.approx(62.0, abs=0.5)
    assert bent.magnetic["field"]["strength"]["sigma"] == pytest.approx(48.0 * np.radians(8.0), rel=0.1)
    np.testing.assert_allclose(bent.imu.magnetometer.bias, free.imu.magnetometer.bias, atol=0.01)
    mirrored = turned(6, axes=-np.eye(3))
    found, _, _ = calibrate_magnetometer(
        [MagneticLog(mirrored.magnetometer, mirrored.recording)], FieldStrength(48.0, dip=62.0, dip_sigma=0.2)
    )
    assert np.abs(off(found, mirrored)).max() < 4.5


def test_what_is_open_is_said_with_the_turn_that_closes_it(cases, calibrations):
    """Strength: the axis along the field. Alignment: the axis east and west, where the angle to gravity tells most."""
    found, _, _ = calibrations[0]
    names = [name for name in found.names if name.owner == "magnetometer"]
    model = replace(found.imu, magnetometer=replace(found.imu.magnetometer, gain=np.eye(3)))

    def advice(**values):
        vector = [values.get(f"{name.part}{''.join(map(str, name.axes))}", 0.0) for name in names]
        return field_advice(np.array(vector), names, np.ones(len(names)), model)

    assert "x axis points along the field" in advice(gain00=1.0)
    assert "y axis points along the field" in advice(bias1=1.0)
    assert "z axis lies level and points east" in advice(gain01=-0.7, gain10=0.7)
    rng = np.random.default_rng(0)  # a turn about z of all that the magnetometer reads, by the definition of the dip
    attitude = Rotation.random(4000, random_state=rng)
    up, field = attitude.inv().apply([0, 0, 1]), attitude.inv().apply([0, np.cos(1.08), -np.sin(1.08)])
    change = np.abs(np.sum(up * (Rotation.from_rotvec([0, 0, 1e-3]).apply(field) - field), axis=1))
    east = attitude[int(np.argmax(change))].apply([0, 0, 1])  # of the unit's z axis
    assert abs(east[0]) > 0.99


def test_document_round_trip_and_compensation(cases, calibrations, tmp_path):
    found, _, _ = calibrations[0]
    found.save(tmp_path / "calibration.json")
    again = load_calibration(tmp_path / "calibration.json")
    assert again.magnetic == found.magnetic and again.names == found.names
    np.testing.assert_array_equal(again.imu.magnetometer.gain, found.imu.magnetometer.gain)
    corrected = compensate(again, replace(cases[0].recording, magnetometer=cases[0].magnetometer))
    length = np.linalg.norm(corrected.magnetometer.values, axis=1)
    assert corrected.magnetometer.unit == "uT" and abs(length.mean() - 48.0) < 0.05 and length.std() < 0.3


def test_other_verbs_take_what_is_theirs(calibrations, cases, tmp_path, capsys):
    """A file with a magnetometer alone is refused in a sentence by verbs that need the other sensors."""
    found, _, _ = calibrations[2]
    assert found.document()["gyroscope"] is None
    bias, sigma = (np.array(found.magnetic["gyroscope_bias"][key]) for key in ("value", "sigma"))
    assert (np.abs(bias) < 4 * sigma).all() and sigma.max() < 1e-3
    found.save(tmp_path / "calibration.json")
    write_recording(replace(cases[2].recording, magnetometer=cases[2].magnetometer), tmp_path / "log.csv")
    assert main(["export", str(tmp_path / "calibration.json"), "--to", "kalibr", "-o", str(tmp_path / "x")]) == 2
    assert "a magnetometer alone" in capsys.readouterr().err
    assert main(["compensate", str(tmp_path / "calibration.json"), str(tmp_path / "log.csv"), "-o",
                 str(tmp_path / "out.csv")]) == 0  # fmt: skip
    capsys.readouterr()
    assert main(["plan", str(tmp_path / "calibration.json")]) == 0
    assert "Magnetometer: more orientations buy little" in capsys.readouterr().out


@pytest.mark.parametrize(("unit", "factor"), [("G", 0.01), ("nT", 1e3), ("uT", 1.0)])
@pytest.mark.parametrize("named", [True, False])
def test_the_line_to_paste_keeps_a_magnetometer_with_hard_iron_and_no_unit(unit, factor, named, cases, tmp_path):
    case, path = cases[0], tmp_path / "log.csv"
    inertial = [case.recording.signals[name].values[::4] for name in ("accelerometer", "gyroscope")]
    field = (case.magnetometer.values + [60.0, 0.0, -20.0]) * factor
    header = ",".join(["t", *(f"{sensor}_{axis}" for sensor in ("acc", "gyr", "mag") for axis in "xyz")])
    columns = np.column_stack([case.magnetometer.time, *inertial, field])
    np.savetxt(path, columns, "%.6f", ",", header=header if named else "", comments="")
    with pytest.raises(InputError) as refusal:
        read_magnetometer(path)
    line = str(refusal.value).split('"')[1]
    assert line == f"time [s],accel [m/s^2],gyro [rad/s],mag [{unit}]"
    assert len(read_magnetometer(path, ReadOptions(columns=line))[0]) == len(field)


@pytest.mark.parametrize("verb", ["magnetometer", "calibrate", "info"])
def test_of_a_magnetometer_alone_nothing_is_to_be_answered_first(verb, cases, tmp_path, capsys):
    path = tmp_path / "log.csv"
    np.savetxt(path, np.round(30 * cases[0].magnetometer.values), "%.0f", ",", header="mx,my,mz", comments="")
    assert main([verb, str(path)]) == 2
    message = capsys.readouterr().err
    assert f"This file holds a magnetometer alone: jaximu magnetometer {path} --columns 'mag [count]'" in message
    assert "Answer first" not in message and "guess" not in message


def test_what_cannot_be_calibrated_is_a_sentence(cases):
    time = np.arange(0, 30, 0.02)
    still = np.array([20.0, 5.0, -40.0]) + 0.1 * np.random.default_rng(0).standard_normal((len(time), 3))
    with pytest.raises(NotPossibleError, match="hardly turned"):
        calibrate_magnetometer([MagneticLog(Signal(time, still, "uT"), None, "still.csv")])
    with pytest.raises(InputError, match="not the Earth's"):
        FieldStrength(0.5)
    other = MagneticLog(Signal(time, still, "count"))
    with pytest.raises(InputError, match="different units"):
        calibrate_magnetometer([MagneticLog(cases[0].magnetometer, None), other])


def test_turns_about_one_axis_do_not_show_the_strength():
    """Tilted by 2° at the most: an ellipsoid fits, of half the field's strength, and scales came out twice as large."""
    time, rng = np.arange(0, 90, 0.02), np.random.default_rng(0)
    tilts = 0.02 * np.stack([np.sin(0.7 * time), np.cos(0.5 * time)], axis=1)
    attitude = Rotation.from_euler("ZXY", np.column_stack([0.5 * time, tilts]))
    rates = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / 0.02
    values = attitude.inv().apply([18.0, -2.0, -44.0]) + [35.0, -20.0, 12.0] + 0.3 * rng.standard_normal((len(time), 3))
    force = Signal(time, attitude.inv().apply([0, 0, 9.80665]) + 0.02 * rng.standard_normal((len(time), 3)), "m/s^2")
    recording = Recording(force, Signal(time, np.vstack([rates, rates[-1]]) @ np.diag([1.01, 0.99, 1.01]), "rad/s"))
    log = MagneticLog(Signal(time, values, "uT"), recording, "flat.csv")
    with pytest.raises(NotPossibleError, match=r"flat.csv: the unit was turned about nearly one axis.*State it"):
        calibrate_magnetometer([log])


def test_a_field_that_changes_is_refused(cases):
    case = cases[5]
    time, values = case.magnetometer.time, case.magnetometer.values
    elsewhere = np.where((time > 30)[:, None], values + 0.15 * (values - case.bias), values)
    log = MagneticLog(Signal(time, elsewhere, "uT"), case.recording, "moved.csv")
    with pytest.raises(
        NotPossibleError, match=r"moved.csv: the field is of .* µT until (29|30)\.\d s and of .* it changed"
    ):
        calibrate_magnetometer([log], FieldStrength(48.0))


def test_a_range_that_is_too_small_is_told_and_left_out(cases):
    case = cases[5]
    values = case.magnetometer.values
    edge = 0.85 * np.abs(values).max()
    log = MagneticLog(replace(case.magnetometer, values=np.clip(values, -edge, edge)), case.recording)
    found, _, _ = calibrate_magnetometer([log], FieldStrength(48.0))
    assert any("its range is too small for this field" in note for note in found.notes)
    assert np.abs(found.imu.magnetometer.bias - case.bias).max() < 0.1


@pytest.mark.parametrize(("factor", "unit"), [(1e-2, "gauss"), (10.0, "mgauss"), (1e3, "nT")])
@pytest.mark.parametrize("strength", [None, FieldStrength(48.0)])
def test_a_unit_that_was_stated_wrong_is_named(factor, unit, strength, cases):
    log = MagneticLog(replace(cases[5].magnetometer, values=factor * cases[5].magnetometer.values), cases[5].recording)
    with pytest.raises(NotPossibleError, match=rf"in {unit} it would be one of (4|5)\d µT"):
        calibrate_magnetometer([log], strength)


def test_command(cases, tmp_path, capsys):
    whole = replace(cases[1].recording, magnetometer=cases[1].magnetometer)
    write_recording(whole, tmp_path / "log.csv")
    assert main(["magnetometer", str(tmp_path / "log.csv"), "--field", "48+-0.1", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["magnetometer"]["output_unit"] == "uT" and document["field"]["strength"]["sigma"] == 0.1
    assert set(document["heading_error"]) >= {"rms", "worst", "unit"} and 0 < document["coverage"] <= 1
    np.testing.assert_allclose(document["magnetometer"]["bias"], cases[1].bias, atol=0.5)
    place = ["--latitude", "46", "--longitude", "12", "--date", "2026-03-04"]  # where the field is much like the unit's
    assert main(["magnetometer", str(tmp_path / "log.csv"), *place, "-o", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    saved = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert saved["trace"] == {"date": "2026-03-04"} and any("WMM2025" in note for note in saved["fit"]["notes"])
    assert saved["field"]["strength"] == {"value": pytest.approx(48.21, abs=0.01), "sigma": 0.152, "unit": "uT"}
    assert "heading in this recording's surroundings is good to" in said and "Hard iron" in said
    assert saved["reading"]["units"]["magnetometer"] == "uT"
    page = (tmp_path / "out" / "report.html").read_text()
    assert "magnetometer" in page and (tmp_path / "out" / "calibration.json").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [(["--field", "weak"], "--field 'weak' is not understood"), (["--mag-log", "none.csv"], "none.csv cannot be read"),
     (["--field", "48+-1+-62"], "is not understood"),
     (["--field", "5000"], "not the Earth's"), (["--longitude", "12"], "--longitude needs --latitude and --date"),
     (["--longitude", "12", "--field", "48"], "either --field or --longitude"),
     (["--latitude", "46", "--longitude", "12", "--date", "2009-01-01"], "no field for 2009-01-01"),
     (["--columns", "time [s],mag"], "states no unit"), (["--mag-log", "LATE"], "they do not overlap")],
)  # fmt: skip
def test_wrong_usage(options, message, tmp_path, capsys):
    (tmp_path / "log.csv").write_text("time [s],mag_x [uT],mag_y [uT],mag_z [uT]\n0,1,2,3\n0.1,2,3,4\n")
    (tmp_path / "late.csv").write_text("time [s],mag_x [uT],mag_y [uT],mag_z [uT]\n900,1,2,3\n900.1,2,3,4\n")
    options = [str(tmp_path / "late.csv") if each == "LATE" else each for each in options]
    log = tmp_path / "log.csv"
    if "--mag-log" in options:
        log = tmp_path / "imu.csv"
        rows = [f"{k / 10},{0.01 * (k % 3)},{0.02 * (k % 2)},{9.8 + 0.01 * (k % 4)}" for k in range(40)]
        log.write_text("\n".join(["time [s],accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2]", *rows]))
    assert main(["magnetometer", str(log), *options]) == 2
    assert message in capsys.readouterr().err


# --- measured ---------------------------------------------------------------------------------------------------------


def test_measured_compass_beside_an_imu(data_folder, tmp_path, capsys):
    """HMC5883L beside an MPU-6050: the dip of its place, and the strength to a percent on parts left out."""
    log, mag = (str(data_folder / f"{FULL}{end}.parquet") for end in ("", ".mag"))
    assert main(["magnetometer", log, "--mag-log", mag, "--axes", "accel=x,y,-z", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["norm_spread"]["after"] < 0.007 < 0.13 < found["norm_spread"]["before"]
    assert 64 < found["field"]["dip"]["value"] < 69  # of Berlin 67.5
    assert found["heading_error"]["rms"] < 1.5 < 15 < found["heading_error"]["before"]["rms"]


def test_measured_counts_alone(data_folder, capsys):
    log = str(data_folder / "magnetometer/qmc5883l_ellipsoid.csv")
    assert main(["magnetometer", log, "--columns", "mag [count]", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["accelerometer"] is None and found["magnetometer"]["output_unit"] == "count"
    assert found["norm_spread"]["after"] < 0.031 < 0.09 < found["norm_spread"]["before"]
    assert found["coverage"] > 0.9


# --- effects ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def affected(cases):
    """A unit with a current of 2 A that comes and goes and a temperature that rises, by what is added to its output."""
    case = cases[4]
    time, values = case.magnetometer.time, case.magnetometer.values
    flow = np.where(np.sin(2 * np.pi * time / 7) > 0, 2.0, 0.0)
    warm = 20 + time / 10 + 0.5 * np.sin(time)
    recording = replace(case.recording, current=Signal(time, flow, "A"), temperature=Signal(time, warm, "degC"))
    late = np.stack([np.interp(time - 0.02, time, axis) for axis in values.T], 1)
    outputs = {
        "none": values, "mag.lag": late, "mag.current": values + np.outer(flow, [3.0, -2.0, 1.0]),
        "mag.temperature": values + np.outer(warm - 25, [0.3, -0.2, 0.1]),
        "mag.hard_iron_step": values + np.outer(time > 30.3, [4.0, 0.0, -6.0]),
    }  # fmt: skip
    return {name: MagneticLog(Signal(time, each, "uT"), recording) for name, each in outputs.items()}


TRUE = {"mag.lag": [0.02] * 3, "mag.current": [3.0, -2.0, 1.0], "mag.temperature": [0.3, -0.2, 0.1],
        "mag.hard_iron_step": [4.0, 0.0, -6.0]}  # fmt: skip
ALIKE = {"mag.current", "mag.temperature"}  # a number an axis times what is logged, as the step, whose onset is sought


@pytest.fixture(scope="module")
def extended(affected):
    """Calibrations with the effect that is there, by its name; a step by its onset, too."""

    @cache
    def of(name, onset):
        effect = name if onset is None else CATALOGUE[name].make(0.0, onset=onset)
        return calibrate_magnetometer([affected[name]], FieldStrength(48.0), effects=[effect])[:2]

    return of


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow if name in ALIKE else ()) for name in TRUE])
def test_an_effect_is_named_and_fitted(name, affected, extended, cases):
    found, measurement, _ = calibrate_magnetometer([affected[name]], FieldStrength(48.0))
    asked = diagnose_magnetometer(found, measurement)
    assert [each.effect.name for each in asked.causes] == [name]
    assert asked.causes[0].gain > 30 and asked.causes[0].p_value < 1e-6
    assert asked.causes[0].after < 0.6 * asked.causes[0].before
    onset = asked.causes[0].effect.onset if name.endswith("step") else None
    assert onset is None or abs(onset - 30.3) < 1.0
    explained, again = extended(name, onset)
    effect = explained.imu.magnetometer.effects[0]
    sigma = np.array([np.sqrt(explained.covariance[k, k]) for k, each in enumerate(explained.names)
                      if each.part == "coefficients"])  # fmt: skip
    loose = 0.3 if onset else 0.02 * np.abs(TRUE[name]).max()  # a window may hold the step
    assert (np.abs(np.asarray(effect.coefficients) - TRUE[name]) < 4 * sigma + loose).all()
    assert np.abs(explained.imu.magnetometer.bias - cases[4].bias).max() < 0.3
    plain, with_effect = (each.magnetic["norm_spread"]["after"] for each in (found, explained))
    assert with_effect == pytest.approx(0.15 / 48.0, rel=0.05)  # the noise of `turned`
    assert with_effect < 0.5 * plain or name == "mag.lag"
    assert not diagnose_magnetometer(explained, again).causes


def test_nothing_is_named_where_nothing_is(affected):
    found, measurement, _ = calibrate_magnetometer([affected["none"]], FieldStrength(48.0))
    asked = diagnose_magnetometer(found, measurement)
    assert not asked.causes and asked.p_value > 0.05 and asked.document()["verdict"] == "adequate"


def test_errors_that_data_sheets_allow_are_in_the_intervals(cases):
    """The gyroscope's errors turn the magnetometer's axes: they were three standard deviations off."""
    logs = [MagneticLog(case.magnetometer, bent(case, seed)) for seed, case in enumerate(cases[:3])]
    fits = [calibrate_magnetometer([log], FieldStrength(48.0))[0] for log in logs]
    errors = np.array([off(calibration, case) for calibration, case in zip(fits, cases, strict=False)])
    assert 0.5 < np.sqrt(np.mean(errors**2)) < 1.5, errors


def test_an_effect_that_cuts_no_error_is_not_named():
    """Per cents of scale of an IMU taken from its data sheet: parts left out gain nats by a step, and no error."""
    case = turned(2, reach=0.35)
    log = MagneticLog(case.magnetometer, bent(case, 2))
    asked = diagnose_magnetometer(*calibrate_magnetometer([log], FieldStrength(48.0))[:2])
    assert not asked.causes and "no better" in asked.not_asked["mag.hard_iron_step"]


def test_effects_are_compensated_and_saved(affected, extended, tmp_path):
    log, (found, _) = affected["mag.current"], extended("mag.current", None)
    found.save(tmp_path / "calibration.json")
    again = load_calibration(tmp_path / "calibration.json")
    corrected = compensate(again, replace(log.recording, magnetometer=log.magnetometer)).magnetometer
    assert np.linalg.norm(corrected.values, axis=1).std() < 0.3
    with pytest.raises(InputError, match=r"mag\.current needs the current, which this recording lacks"):
        compensate(again, replace(log.recording, magnetometer=log.magnetometer, current=None))


@pytest.mark.parametrize(
    ("effects", "message"),
    [(["gyro.lag"], "no effect of a magnetometer"), (["mag.current"], "needs a current"),
     (["mag.none"], "unknown effect 'mag.none'")],
)  # fmt: skip
def test_effects_that_cannot_be_fitted(effects, message, cases):
    with pytest.raises(InputError, match=message):
        fitted(cases[0], effects=effects)


def test_a_simulated_magnetometer_is_calibrated(tmp_path, capsys):
    """Field, dip, noise and a disturbance of a specification come back from `jaximu magnetometer`."""
    spec = """
    seed = 3
    rate = 50
    [protocol]
    kind = "hand-held"
    poses = 14
    [environment]
    field = 49
    dip = 66
    current = [[0, 0], [60, 3]]
    [accelerometer]
    scale = { mean = 0.02, sigma = 0.001 }
    [magnetometer]
    bias = [12, "-30 uT", 5]
    scale = { mean = 0, sigma = 0.05 }
    noise = { white = "30 nT/sqrt(Hz)", density = "one-sided" }
    [effects."setup.field_disturbance"]
    coefficients = [15, 0, 0]
    onset = 20
    duration = 3
    """
    (tmp_path / "spec.toml").write_text(spec)
    assert main(["simulate", str(tmp_path / "spec.toml"), "-o", str(tmp_path / "log.csv")]) == 0
    truth = json.loads((tmp_path / "log.csv.truth.json").read_text())
    capsys.readouterr()
    out = tmp_path / "out"
    assert main(["magnetometer", str(tmp_path / "log.csv"), "--field", "49", "-o", str(out)]) == 0
    printed, found = capsys.readouterr().out, json.loads((out / "calibration.json").read_text())
    # scales are compared with the data sheet's, and not with those of the calibration that came before
    scales = printed.partition("scale x")[2].partition("misalignment")[0]
    assert scales.count("% from nominal") == 3 and scales.count("+1.") + scales.count("+2.") == 3
    assert np.linalg.norm(truth["magnetic_field"]) == pytest.approx(49.0)
    assert found["field"]["dip"]["value"] == pytest.approx(66.0, abs=0.3)
    np.testing.assert_allclose(found["magnetometer"]["bias"], [12, -30, 5], atol=0.3)
    np.testing.assert_allclose(found["magnetometer"]["gain"], truth["magnetometer"]["gain"], atol=0.01)
    left = np.array(found["disturbed"])
    assert len(left) and left.min() > 18 and left.max() < 26
    (tmp_path / "spec.toml").write_text(spec.replace("dip = 66", "dip = 95"))
    assert main(["simulate", str(tmp_path / "spec.toml"), "-o", str(tmp_path / "log.csv")]) == 2
    assert "the dip must lie between" in capsys.readouterr().err


# --- an old calibration -----------------------------------------------------------------------------------------------


def again(case, seed, moved=(0.0, 0.0, 0.0)):
    """The same unit, turned otherwise on another day, its hard iron moved."""
    other = turned(seed)
    field = (other.magnetometer.values - other.bias) @ np.linalg.inv(other.gain).T
    values = field @ case.gain.T + case.bias + np.asarray(moved)
    return other._replace(magnetometer=Signal(other.magnetometer.time, values, "uT"), gain=case.gain, bias=case.bias)


def test_an_old_calibration_is_checked(cases, calibrations, tmp_path, capsys):
    old, _, _ = calibrations[0]
    same = check_magnetometer(old, fitted(again(cases[0], 21))[0])
    assert same.holds and same.p_value > 0.01 and same.freedom == 11 and same.heading < 0.5
    case = again(cases[0], 22, moved=[3.0, 0.0, 0.0])
    moved = check_magnetometer(old, fitted(case)[0])
    assert not moved.holds
    z = (moved.iron - np.linalg.solve(case.gain, [3.0, 0.0, 0.0])) / moved.iron_sigma  # the field of the iron
    assert np.abs(z).max() < 3.5
    # 3 µT along x of a horizontal field of 48 cos 62° = 22.5 µT: 7.6° at most, over √2 as rms
    assert moved.heading == pytest.approx(np.degrees(3.0 / 22.5) / np.sqrt(2), rel=0.15)
    old.save(tmp_path / "old.json")
    write_recording(replace(case.recording, magnetometer=case.magnetometer), tmp_path / "log.csv")
    assert main(["magnetometer", str(tmp_path / "log.csv"), "--check", str(tmp_path / "old.json")]) == 0
    assert "no longer holds" in capsys.readouterr().out
    bare = replace(old, magnetic=None)
    with pytest.raises(InputError, match="no magnetometer in one of the two"):
        check_magnetometer(bare, old)
    counts = replace(old, imu=replace(old.imu, magnetometer=replace(old.imu.magnetometer, output_unit="count")))
    with pytest.raises(InputError, match="in count, the new one in uT"):
        check_magnetometer(counts, old)
