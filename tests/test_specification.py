"""The specification of a simulation, and the two verbs that go with it."""

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from test_protocols import SMALL

from jaximu.cli import main
from jaximu.ground.errors import InputError
from jaximu.model import White
from jaximu.model.effects import CATALOGUE
from jaximu.recordings.readers import read_recording
from jaximu.simulation import Specification, read_specification, specification
from jaximu.simulation.protocols import PROTOCOLS, HandHeld

HELD = '[protocol]\nkind = "hand-held"\nposes = 5\npose_duration = 1.0\nturn_duration = 0.5\n'


def spec(text: str) -> Specification:
    return Specification(tomllib.loads(text), "spec.toml")


def test_the_documented_example_is_understood():
    document = specification.__doc__
    example = "\n".join(line[4:] for line in document.splitlines() if line.startswith("    "))
    found = spec(example)
    assert (found.units, found.recordings) == (20, 2)
    case = found.case(3, 1)
    assert case.protocol == HandHeld(24) and case.rate == 100
    assert case.imu.accelerometer.output_unit == "count"
    np.testing.assert_allclose(np.diag(case.imu.accelerometer.gain) / 2048, 1, atol=0.02)
    assert case.imu.accelerometer.bias[0] == pytest.approx(2048 * 0.03 * 9.80665)
    assert [each.name for each in case.artefacts] == ["clipping", "gap", "gap"]
    assert case.plan.columns == ("temperature",) and len(case.plan.motion.frequency) == 1
    white, flicker = case.noise["accelerometer"].processes
    assert white.N == pytest.approx(100e-6 * 9.80665 / np.sqrt(2)) and flicker.B == pytest.approx(20e-6 * 9.80665)


def test_the_example_of_the_guide_is_understood():
    page = (Path(__file__).parents[1] / "notebooks" / "commands.md").read_text(encoding="utf-8")
    found = re.search(r"```toml\n(seed.*?)```", page, re.DOTALL)
    assert found
    case = spec(found[1]).case(19)
    assert [effect.name for effect in case.imu.accelerometer.effects] == ["accel.asymmetry"]


def test_ranges_are_drawn_for_each_unit_and_by_key():
    text = (
        HELD + "units = 300\n[accelerometer]\nscale = { low = -0.1, high = 0.3 }\nbias = { mean = 1.0, sigma = 0.2 }\n"
    )
    text = "units = 300\n" + text.replace("units = 300\n", "")
    found = spec(text)
    imus = [found.case(unit).imu for unit in range(300)]
    scales = np.array([np.diag(imu.accelerometer.gain) - 1 for imu in imus])
    biases = np.array([imu.accelerometer.bias for imu in imus])
    assert scales.min() > -0.1 and scales.max() < 0.3
    np.testing.assert_allclose(scales.mean(axis=0), 0.1, atol=0.03)
    np.testing.assert_allclose(scales.std(), 0.4 / np.sqrt(12), rtol=0.1)
    np.testing.assert_allclose([biases.mean(), biases.std()], [1.0, 0.2], rtol=0.1)
    assert np.abs(np.corrcoef(np.column_stack([scales, biases]).T) - np.eye(6)).max() < 0.25
    more = spec(text + "[gyroscope]\nbias = { low = 0, high = 1 }\n")  # another key changes no other draw
    np.testing.assert_array_equal(more.case(7).imu.accelerometer.gain, imus[7].accelerometer.gain)
    # unit and power-on
    one, two = found.case(7, 0), found.case(7, 1)
    np.testing.assert_array_equal(one.imu.accelerometer.gain, two.imu.accelerometer.gain)
    assert (one.power_on, two.power_on) == (0, 1)


def test_numbers_may_be_ranges_anywhere():
    text = (
        'rate = 50\n[protocol]\nkind = "rate-table"\nrates = [30, { low = 60, high = 90 }]\nrevolutions = 1\n'
        "[environment]\ngravity = { mean = 9.8, sigma = 0.01 }\n"
        "[artefacts]\njitter = { sigma = { low = 0, high = 1e-3 } }\n"
        '[effects."accel.thermal_lag"]\ncoefficients = 1e-3\ntime_constant = { low = 50, high = 60 }\n'
        '[gyroscope.noise]\nwhite = { low = "0.1 deg/sqrt(h)", high = "0.2 deg/sqrt(h)" }\n'
    )
    case = spec(text).case(0)
    assert case.protocol.rates[0] == 30 and 60 < case.protocol.rates[1] < 90
    assert case.plan.motion.gravity != 9.8 and abs(case.plan.motion.gravity - 9.8) < 0.05
    assert 0 < case.artefacts[0].sigma < 1e-3
    assert 50 < case.imu.accelerometer.effects[0].time_constant < 60
    (white,) = case.noise["gyroscope"].processes
    assert isinstance(white, White) and 0.1 < np.degrees(float(white.N)) * 60 < 0.2


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", r"no \[protocol\] table; its kind is one of static"),
        ('[protocol]\nkind = "hand_held"', "did you mean 'hand-held'"),
        ("[protocol]\nposes = 3", "protocol.kind is None"),
        (HELD + "pose = 3", r"unknown key 'pose' in \[protocol\]; did you mean 'poses'"),
        (HELD + "turn = { low = 1 }", "unknown key 'turn'"),
        (HELD.replace("poses = 5", "poses = 5.5"), "protocol.poses must be a whole number"),
        (HELD.replace("poses = 5", "poses = 0"), "poses must be greater than zero"),
        (HELD.replace("poses = 5", 'poses = "five"'), "protocol.poses must be a number"),
        (HELD.replace("poses = 5", "poses = { low = 5 }"), "a range is { low, high } or { mean, sigma }"),
        (HELD.replace("poses = 5", "poses = { low = 5, high = 2 }"), "low is above high"),
        ("rate = 0\n" + HELD, "rate must be a positive number of Hz, found 0"),
        ("rates = 100\n" + HELD, "unknown key 'rates'; did you mean 'rate'"),
        ("units = 0\n" + HELD, "units must be a whole number of at least 1"),
        ("seed = -1\n" + HELD, "seed must be a whole number of at least 0"),
        ("seed = 1.5\n" + HELD, "seed must be a whole number"),
        (HELD + '[effects."accel.quadratik"]\ncoefficients = 1', "did you mean 'accel.quadratic'"),
        (HELD + '[effects."accel.quadratic"]\ncoeff = 1', "unknown key 'coeff' in .*; did you mean 'coefficients'"),
        (HELD + '[effects."accel.quadratic"]', "needs coefficients, 3 or one for all"),
        (HELD + '[effects."accel.quadratic"]\ncoefficients = [1, 2]', "coefficients must be 3 numbers or one, found 2"),
        (HELD + '[effects."accel.quadratic"]\ncoefficients = nan', "must be a number"),
        (HELD + '[effects."accel.thermal_lag"]\ncoefficients = 1\ntime_constant = -5', "time_constant must be greater"),
        (HELD + "effects = 3", r"unknown key 'effects' in \[protocol\]"),
        ("effects = 3\n" + HELD, "effects must be a table"),
        (HELD + '[accelerometer]\noutput_unit = "g"', "output_unit must be 'm/s\\^2' or 'count'"),
        (HELD + '[accelerometer]\noutput_unit = "count"', "go together"),
        (HELD + "[accelerometer]\ncounts = 3", "go together"),
        (HELD + '[accelerometer]\noutput_unit = "count"\ncounts = 0', "counts must be greater than zero"),
        (HELD + "[accelerometer]\ngain = [[1, 0, 0], [0, 1, 0]]", "invertible 3×3"),
        (HELD + "[accelerometer]\ngain = [[1, 0, 0], [0, 1, 0], [0, 0, 0]]", "invertible 3×3"),
        (HELD + "[accelerometer]\ngain = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\nscale = 1", "either gain or scale"),
        (HELD + '[accelerometer]\nbias = "3 deg/s"', "accelerometer.bias.*different quantities"),
        (HELD + '[accelerometer]\nbias = "3 apples"', "is not understood"),
        (HELD + '[accelerometer.noise]\nwhite = "-1 ug/sqrt(Hz)"\ndensity = "two-sided"', "must not be negative"),
        (HELD + "[accelerometer.noise]\nwhite = -1e-3", r"noise\] White: N must be finite and must not be negative"),
        (HELD + '[accelerometer.noise]\nwhite = "100 ug/sqrt(Hz)"', "density must say"),
        (HELD + '[gyroscope.noise]\nbias_instability = "3 deg/h"', "bias_instability_is must say"),
        (HELD + '[gyroscope.noise]\nwhite = "3 deg/h"', "give the rate it belongs to"),
        (HELD + "[gyroscope.noise]\nwihte = 1", "did you mean 'white'"),
        (HELD + "[environment]\ntemperature = -300", "absolute zero"),
        (HELD + "[environment]\ntemperature = [[0, 20], [10, -300]]", "absolute zero"),
        (HELD + "[environment]\nlatitude = 100", "latitude"),
        (HELD + "[environment]\nvibration = [{ frequenzy = 3 }]", "did you mean 'frequency'"),
        (HELD + "[environment]\nvibration = [{ acceleration = 3 }]", "needs the key 'frequency'"),
        ('[protocol]\nkind = "soak-and-ramp"\n[environment]\ntemperature = 3', "sets the temperature itself"),
        ('[protocol]\nkind = "rate-table"\nrates = [0]', "rates must be greater than zero"),
        ('[protocol]\nkind = "positions"\ncount = 7', "6, 8, 12, 24 or 26"),
        (HELD + "[artefacts]\nclip = { accelerometer = 3 }", "unknown key 'clip'.*'clipping'"),
        (HELD + "[artefacts]\ngap = { start = 3 }", "needs the key 'stop'"),
        (HELD + '[artefacts]\nstuck_axis = { axis = "z", start = 1 }', "axis must be one of"),
        (HELD + "[artefacts]\nclipping = { accelerometer = -3 }", "must not be negative"),
        (HELD + '[artefacts]\nswapped_axes = { sensor = 3, axes = "x,y,z" }', "sensor must be text"),
    ],
)
def test_what_is_not_understood_is_said_in_a_sentence_and_nothing_is_written(text, words, tmp_path, capsys):
    path = tmp_path / "spec.toml"
    path.write_text(text)
    assert main(["simulate", str(path), "-o", str(tmp_path / "log.parquet")]) == 2
    error = capsys.readouterr().err
    assert re.search(words, error), error
    assert error.startswith(f"jaximu: {path}") and len(error.strip().splitlines()) == 1
    assert [each.name for each in tmp_path.iterdir()] == ["spec.toml"]


def test_files_that_cannot_be_read_or_written(tmp_path, capsys):
    good = tmp_path / "good.toml"
    good.write_text(HELD)
    (tmp_path / "bad.toml").write_text("rate = = 3")
    for arguments, words in (
        (["simulate", str(tmp_path / "none.toml"), "-o", "log.csv"], "cannot be read"),
        (["simulate", str(tmp_path / "bad.toml"), "-o", "log.csv"], "is not a TOML file"),
        (["simulate", str(good)], "where to write"),
        (["simulate"], "where to write"),
        (["simulate", str(good), "-o", str(tmp_path / "log.xyz")], "suffix must be one of"),
        (["simulate", str(good), "-o", str(tmp_path / "no" / "log.csv")], "does not exist"),
    ):
        assert main(arguments) == 2
        assert words in capsys.readouterr().err
    assert len(list(tmp_path.iterdir())) == 2
    with pytest.raises(InputError, match="must be a table"):
        Specification({"protocol": {"kind": "static"}, "effects": {"accel.cubic": 3}})


def test_simulate_writes_a_fleet_with_its_truth(tmp_path, capsys):
    path = tmp_path / "spec.toml"
    text = "units = 2\nrecordings = 2\n" + HELD + "[accelerometer]\nbias = { low = -1, high = 1 }\n"
    path.write_text(text + "[artefacts]\nclipping = { accelerometer = 9.0 }\n")
    assert main(["simulate", str(path), "-o", str(tmp_path / "log.csv"), "--json"]) == 0
    printed = capsys.readouterr()
    document = json.loads(printed.out)
    names = [Path(each["file"]).name for each in document["recordings"]]
    assert names == ["log-0000-0.csv", "log-0000-1.csv", "log-0001-0.csv", "log-0001-1.csv"]
    assert "left its range of ±9" in printed.err and "clipped" in document["recordings"][0]["notes"][0]
    truths = [json.loads((tmp_path / f"{name}.truth.json").read_text()) for name in names]
    biases = [truth["accelerometer"]["bias"] for truth in truths]
    assert biases[0] == biases[1] != biases[2] == biases[3]
    recordings = [read_recording(tmp_path / name) for name in names]
    assert np.abs(recordings[0].accelerometer.values).max() == 9.0
    assert np.abs(recordings[0].gyroscope.values - recordings[1].gyroscope.values).max() > 0.1  # another motion
    first = recordings[0].accelerometer.values
    assert main(["simulate", str(path), "-o", str(tmp_path / "again.csv")]) == 0
    np.testing.assert_array_equal(read_recording(tmp_path / "again-0000-0.csv").accelerometer.values, first)


EFFECTS = {
    "static": ("gyro.bias_ramp", "accel.warm_up"),
    "positions": ("accel.cubic", "gyro.earth_rotation", "setup.gravity"),
    "hand-held": ("accel.size_effect", "gyro.g_sensitivity", "setup.time_offset"),
    "rate-table": ("accel.lever_arm", "gyro.quadratic", "gyro.lag", "setup.table_tilt", "setup.table_rate_scale"),
    "dividing-head": ("gyro.dead_band", "accel.asymmetry", "setup.reference_delay", "setup.table_axis"),
    "ferraris": ("accel.quadratic", "gyro.asymmetry", "setup.table_tilt"),
    "rotations": ("accel.size_effect", "gyro.g_sensitivity"),
    "single-axis-table": ("accel.cross_coupling", "gyro.cubic", "setup.clock_scale"),
    "soak-and-ramp": ("accel.thermal_lag", "gyro.thermal_hysteresis", "accel.scale_temperature"),
    "vibration": ("accel.vibration_rectification", "gyro.vibration_rectification"),
}


@pytest.mark.parametrize("kind", PROTOCOLS)
def test_every_protocol_with_a_sample_of_effects_from_the_command_line(kind, tmp_path, capsys):
    """Each effect changes the recording, and one without any does not contain it."""
    protocol = SMALL[kind]
    keys = "".join(f"{name} = {json.dumps(value)}\n" for name, value in vars(protocol).items())
    noise = "[{}.noise]\nwhite = 1e-9\n"  # a reader takes an axis that never changes for a dead one
    base = f'seed = 3\n[protocol]\nkind = "{kind}"\n{keys}' + "".join(map(noise.format, ("accelerometer", "gyroscope")))
    effects = "".join(f'[effects."{n}"]\ncoefficients = {3 * CATALOGUE[n].typical}\n' for n in EFFECTS[kind])
    recordings = []
    for name, text in (("plain", base), ("flawed", base + effects)):
        (tmp_path / f"{name}.toml").write_text(text)
        assert main(["simulate", str(tmp_path / f"{name}.toml"), "-o", str(tmp_path / f"{name}.parquet")]) == 0
        recordings.append(read_recording(tmp_path / f"{name}.parquet"))
    truth = json.loads((tmp_path / "flawed.parquet.truth.json").read_text())
    named = [name for part in ("accelerometer", "gyroscope", "setup") for name in truth[part]["effects"]]
    assert sorted(named) == sorted(EFFECTS[kind])
    assert (tmp_path / "flawed.parquet.schedule.csv").exists() == ("attitude" in recordings[0].signals)
    plain, flawed = recordings
    for signal, prefix in (("accelerometer", "accel"), ("gyroscope", "gyro")):
        changed = np.abs(getattr(plain, signal).values - getattr(flawed, signal).values).max()
        meant = any(each.startswith((prefix, "setup")) for each in EFFECTS[kind])
        assert (changed > 1e-6) == meant
    capsys.readouterr()


def test_effects_prints_the_catalogue_from_the_code(capsys):
    assert main(["effects"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    for kind in CATALOGUE.values():
        assert kind.name in printed
        assert " ".join(kind.formula.split()) in printed
        assert kind.excited_by in printed
    assert main(["effects", "--json"]) == 0
    assert [each["name"] for each in json.loads(capsys.readouterr().out)] == list(CATALOGUE)


@pytest.mark.parametrize("name", ["accel.thermal_lag", "setup.table_axis", "gyro.dead_band"])
def test_effects_prints_one_entry_whole(name, capsys):
    kind = CATALOGUE[name]
    assert main(["effects", name]) == 0
    printed = "".join(capsys.readouterr().out.split())
    for text in (kind.formula, kind.unit, kind.scope, kind.excited_by, kind.source, kind.recovery, *kind.inner):
        assert "".join(text.replace("_", " ").split()) in printed or "".join(text.split()) in printed
    assert all(each in printed for each in kind.look_alikes)
    assert main(["effects", name, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["formula"] == kind.formula


def test_effects_names_the_nearest(capsys):
    assert main(["effects", "gyro.g_sensitivty"]) == 2
    assert "gyro.g_sensitivity" in capsys.readouterr().err


def test_simulate_explains_itself(capsys):
    assert main(["simulate", "--protocols"]) == 0
    printed = capsys.readouterr().out
    assert all(kind in printed for kind in PROTOCOLS) and "turn_duration = 1.5" in printed
    assert main(["simulate", "--explain"]) == 0
    assert '[effects."accel.quadratic"]' in capsys.readouterr().out


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=re.escape(str(tmp_path / "none.toml"))):
        read_specification(tmp_path / "none.toml")
