"""Units on one rigid body: truth of an outside simulator, whose noise it is, what is refused, the command."""

import json
import sys
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import array_motion
import jax
import numpy as np
import pytest
import scipy.spatial.transform

from jaximu import InputError, LocalGravity, NotPossibleError, Recording
from jaximu.calibration import calibrate_array, fit_together
from jaximu.cli.app import main
from jaximu.data.array import UnitsOnOneBody
from jaximu.data.poses import condensed
from jaximu.model.effects import CATALOGUE
from jaximu.model.effects.reference_rotation import SetupReferenceRotation
from jaximu.recordings import write_recording
from jaximu.recordings.readers import ReadOptions, read_recording
from jaximu.recordings.recording import Signal

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from turns_left_out import leave_out_turns

GRAVITY = LocalGravity(array_motion.GRAVITY, 0.0)


def recordings(made) -> list[Recording]:
    return [Recording(Signal(unit.time, unit.force, "m/s^2"), Signal(unit.time, unit.rate, "rad/s")) for unit in made]


@lru_cache(maxsize=1)
def moved():
    return array_motion.array(5)


@pytest.fixture(scope="module")
def found():
    return calibrate_array(recordings(moved()), GRAVITY)


def test_truth_lies_within_the_intervals(found):
    for unit, truth in zip(found.units[1:], moved()[1:], strict=True):
        rotation = scipy.spatial.transform.Rotation.from_quat(unit.rotation, scalar_first=True)
        off = (rotation * truth.turned).as_rotvec() / unit.rotation_sigma  # turned: from the unit's axes to the body's
        placed = (unit.position - truth.place) / unit.position_sigma
        late = (unit.time_offset - truth.late) / unit.time_offset_sigma
        z = np.array([*off, *placed, late])
        assert np.abs(z).max() < 4 and np.sqrt(np.mean(z**2)) < 1.8
        assert unit.position_sigma.max() < 1e-4 and unit.time_offset_sigma < 1e-5
        assert np.degrees(unit.rotation_sigma).max() < 0.01


@pytest.fixture(scope="module")
def together(found):
    return fit_together(found)


def test_together_units_know_their_gyroscopes_better_and_state_it(found, together):
    """Sixteen rests: noise alone makes the units' own numbers, and what the others saw of the same turns helps."""
    errors, sigmas = {}, {}
    fits = {"alone": together.units_alone(), "together": together.units_together()}
    for words, units in fits.items():
        off = [[np.asarray(unit.gyroscope.gain) - truth.gains[1], np.asarray(unit.accelerometer.gain) - truth.gains[0]]
               for unit, truth in zip(units, moved(), strict=True)]  # fmt: skip
        errors[words] = np.array(off)
    names, spread = together.together.names, np.sqrt(np.diag(together.together.covariance))
    stated = [spread[k] for k, name in enumerate(names) if name.owner.endswith("gyroscope") and name.part == "gain"]
    sigmas["together"] = np.array(stated).reshape(3, 3, 3)
    z = errors["together"][:, 0] / sigmas["together"]
    assert 0.6 < np.sqrt(np.mean(z**2)) < 1.5
    rms = {words: np.sqrt(np.mean(each[:, 0] ** 2)) for words, each in errors.items()}
    assert rms["together"] < rms["alone"]
    for unit, known in zip(together.units_together()[1:], found.units[1:], strict=True):
        mounted = scipy.spatial.transform.Rotation.from_rotvec(unit.coefficients(SetupReferenceRotation))
        apart = mounted * scipy.spatial.transform.Rotation.from_quat(known.rotation, scalar_first=True)
        assert apart.magnitude() < 6 * np.linalg.norm(known.rotation_sigma)


def test_the_units_own_conditions_have_the_covariance_that_they_have_alone(together):
    """Two ways to it: derivatives written down for one unit, and those of all conditions taken by JAX."""
    board = jax.tree.map(lambda leaf: np.asarray(leaf)[None], together.together.imu)
    whole = UnitsOnOneBody(together.observations).about(board).covariance
    alone = jax.tree.map(lambda *leaves: np.stack(leaves), *(each.with_effects() for each in
                                                             together.together.imu.units()))  # fmt: skip
    own = jax.vmap(lambda each: each.dense())(condensed(alone, together.observations).covariance)
    size = own.used.shape[1]
    for unit in range(3):
        part = slice(unit * size, (unit + 1) * size)
        used = own.used[unit][:, None] * own.used[unit]
        known = used * own.measured[unit]
        np.testing.assert_allclose((used * whole.measured[0, part, part]), known, atol=1e-6 * np.abs(known).max())


def test_what_an_effect_adds_is_taken_off_before_units_are_fitted_together(found, together):
    """An effect of no size changes nothing; one of the gyroscope's acceleration sensitivity changes its fit."""
    kind, fits = CATALOGUE["gyro.g_sensitivity"], []
    for size in (0.0, 1e-4):
        imu = found.units[1].calibration.imu.with_effects(kind.make(size))
        other = replace(found.units[1], calibration=replace(found.units[1].calibration, imu=imu))
        fits.append(fit_together(replace(found, units=(found.units[0], other, *found.units[2:]))).together)
    sigma = np.sqrt(np.diag(together.together.covariance))
    none, some = (np.abs((each.values - together.together.values) / sigma).max() for each in fits)
    assert none < 1e-6 < 10.0 < some


def test_turns_left_out_are_met_better_together(found, together):
    left = leave_out_turns(found, together)
    assert left.count == 3 * 16 and left.gravity[1] < left.gravity[0] and left.apart[1] < left.apart[0] / 1.5


def test_what_turns_have_in_common_is_no_more_than_a_unit_alone_shows(found):
    """The body shakes alike for all units, six turns are fitted: by their likelihood it shakes nearly twice as much."""
    random = np.random.default_rng(8)
    kept = random.choice(16, 6, replace=False)
    shake = 3e-2 * np.random.default_rng(8).normal(size=(16, 3))  # rad/s, of each turn
    logs = []
    for unit, log in zip(moved(), recordings(moved()), strict=True):
        rate = np.array(log.gyroscope.values)
        for number, each in enumerate(unit.turned.inv().apply(shake) @ unit.gains[1].T):
            begun = 3.0 * number + 2.0 + unit.late
            rate[(log.gyroscope.time > begun) & (log.gyroscope.time < begun + 1.0)] += each
        logs.append(replace(log, gyroscope=Signal(log.gyroscope.time, rate, "rad/s")))
    shaken = fit_together(calibrate_array(logs, GRAVITY), np.setdiff1d(np.arange(16), kept).tolist())
    alone = np.asarray(shaken.alone.excess)[:, 1]
    assert shaken.in_common > 0.99 and alone.min() > 1e3
    # units of one kind have nearly the same noise
    assert 0.3 * alone.min() < shaken.together.excess[-1] < 1.05 * alone.max()


def test_other_rates_and_absolute_stamps():
    """The second unit has another rate, counts from two seconds later and is late by 0.1 s besides."""
    first, second = array_motion.array(5)[0], array_motion.array(5, rate=250.0, late=0.3)[2]
    logs = [Recording(Signal(unit.time, unit.force, "m/s^2"), Signal(unit.time, unit.rate, "rad/s"), start=start)
            for unit, start in ((first, 1.7e9), (second, 1.7e9 + 2.0))]  # fmt: skip
    unit = calibrate_array(logs, GRAVITY).units[1]
    assert unit.time_offset == pytest.approx(second.late + 2.0, abs=1e-4)
    np.testing.assert_allclose(unit.position, second.place, atol=3e-4)


def test_what_the_mean_gains_is_what_independent_noise_gives(found):
    for single, mean, expected in (found.averaged.rate, found.averaged.force):
        assert mean == pytest.approx(expected, rel=0.12)
        assert single / mean == pytest.approx(np.sqrt(3), rel=0.15)
    assert not found.suspects()


def test_a_noisy_unit_is_found(found):
    made = moved()
    noise = 0.02 * np.random.default_rng(0).normal(size=made[1].rate.shape)
    spoilt = [made[0], array_motion.Unit(*vars(made[1]).values()), made[2]]
    spoilt[1] = array_motion.Unit(made[1].time, made[1].force, made[1].rate + noise, *list(vars(made[1]).values())[3:])
    ((unit, words, times),) = calibrate_array(recordings(spoilt), GRAVITY).suspects()
    assert words == "rate" and times > 3 and unit.time_offset == pytest.approx(made[1].late, abs=1e-3)


def test_units_that_move_apart_are_refused():
    made = array_motion.array(6, together=False)
    with pytest.raises(NotPossibleError, match="does not turn as"):
        calibrate_array(recordings(made), GRAVITY)


def test_a_single_unit_and_one_without_gyroscope_are_refused():
    first, second, _ = recordings(moved())
    with pytest.raises(InputError, match="two units or more"):
        calibrate_array([first], GRAVITY)
    with pytest.raises(InputError, match="no gyroscope"):
        calibrate_array([first, Recording(second.accelerometer, None)], GRAVITY)


def test_the_command(tmp_path, capsys):
    files = []
    for number, recording in enumerate(recordings(moved())[:2], 1):
        files.append(str(tmp_path / f"unit{number}.csv"))
        write_recording(recording, files[-1])
    status = main(["array", *files, "--gravity", f"{array_motion.GRAVITY}+-0", "--json", "-o", str(tmp_path / "out")])
    said = capsys.readouterr()
    assert status == 0, said.err
    document = json.loads(said.out)
    assert document["schema"] == "jaximu.array/1" and len(document["units"]) == 2
    assert {"file", "rotation", "position", "time_offset"} <= set(document["units"][1])
    np.testing.assert_allclose(document["units"][1]["position"], moved()[1].place, atol=3e-4)
    assert document["units"][1]["scatter"] == {"rate": None, "force": None}  # of two nobody can tell
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"array.json", "report.html", "array.png", "calibration_1.json", "calibration_2.json"} == written
    assert "compensate calibration_1.json unit1.csv" in (tmp_path / "out" / "report.html").read_text()
    assert main(["array", files[0]]) == 2
    assert "two units or more" in capsys.readouterr().err


@pytest.mark.parametrize("layout", ["ids", "side by side", "columns for each log"])
def test_units_in_one_file_are_those_in_files_of_their_own(tmp_path, layout, capsys):
    """By the IDs of rows, by columns side by side, or from logs of different columns: the same array."""
    first, second = recordings(moved())[:2]
    values = [np.hstack([each.accelerometer.values, each.gyroscope.values]) for each in (first, second)]
    rows = min(map(len, values))
    time = first.accelerometer.time[:rows]
    left, right = (part[:rows] for part in values)
    if layout == "ids":
        files = [tmp_path / "rack.csv"]
        header = "time [s],id," + ",".join(names())
        lines = [
            f"{t:.4f},{unit}," + ",".join(f"{v:.9g}" for v in part)
            for t, *parts in zip(time, left, right, strict=True)
            for unit, part in zip(("left", "right"), parts, strict=True)
        ]
        options = ["--device", "left,right"]
        files[0].write_text("\n".join([header, *lines]))
    elif layout == "side by side":
        files = [tmp_path / "wide.csv"]
        np.savetxt(files[0], np.column_stack([time, left, right]), delimiter=",", fmt="%.9g")
        stated = "accel [m/s^2],gyro [rad/s]"
        options = ["--columns", f"time [s],{stated},_*6;time [s],_*6,{stated}"]
    else:
        files = [tmp_path / "left.csv", tmp_path / "right.csv"]
        np.savetxt(files[0], np.column_stack([time, left]), delimiter=",", fmt="%.9g")
        np.savetxt(files[1], np.column_stack([right, time * 1e3]), delimiter=",", fmt="%.9g")
        options = ["--columns", "time [s],accel [m/s^2],gyro [rad/s];accel [m/s^2],gyro [rad/s],time [ms]"]
    stated = [*map(str, files), *options, "--gravity", f"{array_motion.GRAVITY}+-0", "--json"]
    assert main(["array", *stated, "-o", str(tmp_path / "out")]) == 0
    document = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(document["units"][1]["position"], moved()[1].place, atol=3e-4)
    if len(files) == 1:
        assert f"{files[0].name} (2)" in (tmp_path / "out" / "report.html").read_text()
        assert main(["calibrate", *stated[:3]]) == 2
        assert "several in one log are for jaximu array" in capsys.readouterr().err
    if layout == "ids":
        second, corrected = str(tmp_path / "out" / "calibration_2.json"), tmp_path / "corrected.csv"
        assert main(["compensate", second, str(files[0]), "-o", str(corrected)]) == 0
        off = read_recording(corrected).accelerometer.values - right[:, :3]
        assert np.abs(off).max() < 0.5 < np.abs(right - left).max()  # the second unit's own rows
        assert main(["array", str(files[0])]) == 2
        assert "--device left,right" in capsys.readouterr().err


def names() -> list[str]:
    return [f"{sensor}_{axis} [{unit}]" for sensor, unit in (("accel", "m/s^2"), ("gyro", "rad/s")) for axis in "xyz"]


def test_a_measured_board(data_folder):
    """The board's drawing: unit 5 lies 18.9 mm beside unit 1. Gyroscopes that stop at the end of their range in one
    sample of forty made that 19.6 mm."""
    options = ReadOptions(accel_scale="2048 count/g", gyro_scale="16.4 count/(deg/s)")
    logs = [read_recording(data_folder / f"mimu4444/unit{number}_session1.parquet", None, options) for number in (1, 5)]
    unit = calibrate_array(logs, LocalGravity(9.818, 1e-3)).units[1]
    np.testing.assert_allclose(unit.position, [18.9e-3, 0.0, 0.0], atol=6e-4)
    assert np.degrees(2 * np.arccos(abs(unit.rotation[0]))) < 1.0
    assert any("its range is too small" in note for note in unit.calibration.notes)
