"""Bias over temperature: what was put into a chamber comes out; what one ramp cannot tell, and bad input, is said."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from commands import result_of

from jaximu import calibration
from jaximu.calibration import calibrate_thermal, compensate, load_calibration
from jaximu.calibration.thermal_linear import Held
from jaximu.calibration.thermal_regression import multifactor
from jaximu.calibration.thermal_selection import Candidate, best_by_axis
from jaximu.calibration.thermal_terms import POWERS
from jaximu.cli.app import main
from jaximu.data import without_startup
from jaximu.data.rest_blocks import folds_of, rest_blocks
from jaximu.estimation.problem import Name
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.mistakes import inspect
from jaximu.model import NoiseModel
from jaximu.model.effects import CATALOGUE
from jaximu.model.noise_model import AxisNoise
from jaximu.planning.ramps import next_ramps
from jaximu.recordings import write_recording
from jaximu.recordings.flags import without_flagged
from jaximu.recordings.readers import ReadOptions, read_recording
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.thermometer import course
from jaximu.report.export import ExportedUnit
from jaximu.report.export.catalogue import writer
from jaximu.report.export.thermal_autopilot import ardupilot_parameters, px4_parameters
from jaximu.report.thermal import bias_dots, effect_table, residual_dots
from jaximu.simulation import simulate
from jaximu.simulation.draw import consumer_noise, draw_imu
from jaximu.simulation.protocols import Environment, SoakAndRamp, Static

UNIT = draw_imu(3)
EFFECTS = {
    "accel.temperature": [1e-3, -2e-3, 1.5e-3],
    "accel.temperature_squared": [1e-5, 2e-5, -1e-5],
    "accel.thermal_lag": [1e-3, 1e-3, -1e-3],
    "gyro.temperature": [1e-4, -2e-4, 1e-4],
    "gyro.temperature_rate": [0.01, 0.02, -0.01],
}
LAG = 150.0
LEG = "time [us],gyro [rad/s],accel [m/s^2],_,temperature [degC]"


def hidden():
    return [
        CATALOGUE[name].make(value, **({"time_constant": LAG} if name.endswith("lag") else {}))
        for name, value in EFFECTS.items()
    ]


def truth_of(triad: str, kelvin, reference=25.0):
    """The steady bias that was put in, by hand."""
    prefix = {"accelerometer": "accel", "gyroscope": "gyro"}[triad]
    warmth = np.asarray(kelvin)[:, None] - reference
    power = {"temperature": 1, "temperature_squared": 2, "thermal_lag": 1}
    return sum(
        np.array(value) * warmth ** power[name.partition(".")[2]]
        for name, value in EFFECTS.items()
        if name.startswith(prefix) and name.partition(".")[2] in power
    )


@pytest.fixture(scope="module")
def chamber():
    return simulate(
        UNIT.with_effects(*hidden()), SoakAndRamp(rates=(1.0, 2.0, 4.0)), consumer_noise(), rate=2.0, seed=4
    )[0]


@pytest.fixture(scope="module")
def commanded(chamber, tmp_path_factory):
    """The command on the chamber: its folder, what was fitted in it and what it printed."""
    folder = tmp_path_factory.mktemp("chamber")
    write_recording(chamber, folder / "chamber.csv")
    line = ["thermal", str(folder / "chamber.csv"), "-o", str(folder / "out"), "--json"]
    return folder, *result_of([*line, "--to", "px4", "--to", "ardupilot"], calibration, "calibrate_thermal")


@pytest.fixture(scope="module")
def found(commanded):
    return commanded[1]


@pytest.fixture(scope="module")
def one_way():
    environment = Environment(temperature=[[0.0, 20.0], [1800.0, 41.0]])
    return simulate(UNIT.with_effects(*hidden()[3:]), Static(1800.0), consumer_noise(), rate=2.0, seed=1,
                    environment=environment)[0]  # fmt: skip


def test_the_model_that_was_put_in_is_chosen_with_its_numbers(found):
    assert set(found.fits["accelerometer"].candidate.names) == {"temperature", "temperature_squared", "thermal_lag"}
    assert set(found.fits["gyroscope"].candidate.names) == {"temperature", "temperature_rate"}
    value, sigma = found.fits["accelerometer"].inner["thermal_lag", "time_constant"]
    assert abs(value / LAG - 1) < 0.05 and abs(value - LAG) < 4 * sigma and sigma < 0.05 * LAG
    calibration = found.calibration
    spread = dict(zip(calibration.names, np.sqrt(np.diag(calibration.covariance)), strict=True))
    for owner, triad in calibration.triads().items():
        for place, effect in enumerate(triad.effects):
            sigmas = [spread[f"{owner}.effects[{place}].coefficients[{k}]"] for k in range(3)]
            assert np.all(np.abs(np.asarray(effect.coefficients) - EFFECTS[effect.name]) < 4.5 * np.array(sigmas))


def test_what_bends_may_lag_too():
    """A die that follows its thermometer, and a bias that bends with the die's temperature, not the thermometer's."""
    hidden = {"temperature": [2e-3, -3e-3, 1e-3], "temperature_squared": [3e-5, 0.0, -2e-5]}
    lagging = {"thermal_lag": "temperature", "thermal_lag_squared": "temperature_squared"}
    effects = [
        CATALOGUE[f"{prefix}.{name}"].make(share * np.array(hidden[like]), time_constant=60.0)
        for prefix, share in (("accel", 1.0), ("gyro", 0.1))
        for name, like in lagging.items()
    ]
    down_and_up = Environment(temperature=[[0.0, 25.0], [900.0, -15.0], [2100.0, 45.0]])
    log = simulate(UNIT.with_effects(*effects), Static(2100.0), consumer_noise(), rate=4.0, seed=2,
                   environment=down_and_up)[0]  # fmt: skip
    found = calibrate_thermal(log)
    for triad, share in (("accelerometer", 1.0), ("gyroscope", 0.1)):
        fit = found.fits[triad]
        assert set(fit.families) == {"thermal lag"}
        value, sigma = fit.inner["thermal_lag", "time_constant"]
        assert abs(value - 60.0) < 4 * sigma < 6.0
        assert ("thermal_lag_squared", "time_constant") not in fit.inner  # it is the lag's
        lag, squared = (next(effect for effect in fit.effects if effect.plain == name) for name in lagging)
        assert float(squared.time_constant) == float(lag.time_constant)
        wanted = share * np.array(hidden["temperature_squared"])
        np.testing.assert_allclose(np.asarray(squared.coefficients), wanted, rtol=0, atol=share * 2e-6)
        assert np.all(fit.candidate.held.rms < 1.3 * fit.after)
    corrected = compensate(found.calibration, log)
    assert np.ptp(corrected.accelerometer.values[:, 1].reshape(-1, 400).mean(axis=1)) < 0.02


def readings_of(thermometer, temperature):
    """What a thermometer shows of a temperature, twice a second: in steps of 1 K, held for 10 s, or with noise."""
    noise = np.random.default_rng(2).normal(size=len(temperature))
    return {
        "steps": np.round(temperature),
        "flicker": np.round(temperature + 0.1 * noise),
        "held": (temperature + 0.05 * noise)[np.arange(len(temperature)) // 20 * 20],
        "noise": temperature + 0.5 * noise,
    }[thermometer]


def warmed(temperature, readings):
    """An accelerometer at rest, twice a second, whose output is a quadratic of the true temperature."""
    warmth, time = temperature[:, None] - 25, np.arange(len(temperature)) / 2
    force = [0.1, 0, 9.81] + warmth * [4e-3, -2e-3, 1e-3] + warmth**2 * [2e-5, -3e-5, 1e-5]
    force = Signal(time, force + 1e-3 * np.random.default_rng(1).normal(size=force.shape), "m/s^2")
    return Recording(accelerometer=force, temperature=Signal(time, readings, "degC"))


@pytest.mark.parametrize("noise", [0.05, 0.0])
def test_a_stuck_thermometer_is_left_out(noise):
    """It had noise and has none any more; one without noise may stand still in a soak."""
    temperature = np.interp(np.arange(4800), [0, 2000, 4800], [20.0, 40.0, 60.0])
    readings = np.round(temperature + noise * np.random.default_rng(1).normal(size=4800), 2)
    readings[3000:4000] = readings[2999]
    log = warmed(temperature, readings)
    blocks = rest_blocks(log, 4.0)
    left_out = (blocks.start > 1500) & (blocks.stop < 2000)
    notes = [finding for finding in inspect(log) if finding.name == "data.stuck_axis"]
    if noise:
        assert not left_out.any() and len(blocks) > 460
        assert "for 500 s in all" in notes[0].text and notes[0].text in blocks.notes
    else:
        assert left_out.sum() > 100 and not notes


@pytest.mark.parametrize("thermometer", ["steps", "flicker", "held", "noise"])
def test_a_coarse_thermometer_is_no_lag(thermometer):
    """A quadratic of the true temperature, whose readings are smoothed: no lag, rate or hysteresis comes out."""
    temperature = 30 - 20 * np.cos(np.linspace(0.0, 2 * np.pi, 4800))
    readings = readings_of(thermometer, temperature)
    log = warmed(temperature, readings)
    assert np.std(course(log.temperature).values[:, 0] - temperature) < 0.4 * np.std(readings - temperature)
    fit = calibrate_thermal(log, block=8.0, families=("polynomial", "all")).fits["accelerometer"]
    assert set(fit.candidate.names) <= set(POWERS)
    assert np.all(fit.candidate.held.rms < 4e-4)


def test_no_model_is_taken_that_leaves_more_than_a_simpler_one():
    """The model with a lag is far likelier, and leaves twice as much of what was left out."""
    three = np.ones(3)

    def tried(family, numbers, rms, score):
        return Candidate(family, ((),) * 3, numbers * three, -numbers * three, Held(rms * three, score * three))

    likelier = [tried("constant", 0, 9.0, -90.0), tried("cubic", 3, 1.0, 0.0), tried("thermal lag", 5, 2.0, 50.0)]
    assert best_by_axis(likelier) == [1, 1, 1]
    assert best_by_axis([*likelier, tried("all", 6, 0.5, 50.0)]) == [3, 3, 3]


def test_the_residual_is_the_noise_and_the_cubic_is_not(found):
    for name, fit in found.fits.items():
        assert np.all(fit.chi_squared < 1.15)
        cubic = next(each for each in fit.candidates if each.family == "cubic")
        assert cubic.held.log_likelihood < fit.candidate.held.log_likelihood - 100
        white = getattr(found.noise, name).white
        assert np.all(fit.after > 0.5 * np.sqrt(white / found.blocks.duration))


def test_the_band_holds_the_truth(found):
    kelvin = np.linspace(*found.blocks.range, 50)
    for name in found.fits:
        value, sigma = found.bias(name, kelvin)
        away = np.abs(kelvin - 25.0) > 3
        z = ((value - truth_of(name, kelvin)) / np.maximum(sigma, 1e-12))[away]
        assert np.max(np.abs(z)) < 4.5  # three axes, points that go together
        assert np.median(np.abs(z)) > 0.02  # the band is not so wide that it could not miss


def test_the_bias_with_a_rate_is_that_of_a_steady_ramp(found):
    kelvin, rate = np.array([0.0, 30.0]), 0.05
    moving = found.bias("accelerometer", kelvin, rate)[0] - found.bias("accelerometer", kelvin)[0]
    fit = found.fits["accelerometer"]
    lag = next(effect for effect in fit.effects if effect.plain == "thermal_lag")
    assert np.allclose(moving, -rate * float(lag.time_constant) * np.asarray(lag.coefficients))
    moving = found.bias("gyroscope", kelvin, rate)[0] - found.bias("gyroscope", kelvin)[0]
    assert np.allclose(moving, rate * np.array(EFFECTS["gyro.temperature_rate"]), atol=2e-5)


def test_the_file_compensates_and_keeps_the_range(found, chamber, tmp_path):
    found.calibration.save(tmp_path / "calibration.json")
    loaded = load_calibration(tmp_path / "calibration.json")
    low, high = loaded.data["temperature_range"]
    assert abs(low + 20) < 0.1 and abs(high - 60) < 0.1
    left = compensate(loaded, chamber)
    for name in ("accelerometer", "gyroscope"):
        before, after = (getattr(each, name).values for each in (chamber, left))
        parts = (np.array_split(values, 60) for values in (before, after))
        drift = [np.ptp([part.mean(axis=0) for part in each], axis=0) for each in parts]
        assert np.all(drift[1] < 0.03 * drift[0])
    assert np.abs(left.gyroscope.values.mean(axis=0)).max() < 1e-5  # the bias at rest is taken off, too


def test_legs_and_folds(found):
    legs = found.identifiability.legs
    assert [leg.up for leg in legs] == [True, False] * 3
    assert np.allclose([abs(leg.rate) * 60 for leg in legs], [1, 1, 2, 2, 4, 4], rtol=0.02)
    folds = folds_of(legs)
    assert len(folds) == 6 and sorted(np.concatenate(folds)) == list(range(len(found.blocks)))


def test_one_way_tells_no_rate_and_says_so(one_way):
    found = calibrate_thermal(one_way)
    assert not {"temperature_rate", "thermal_lag", "thermal_hysteresis"} & set(found.identifiability.told)
    assert "cycle" in " ".join(found.identifiability.words)
    assert not any("rate" in name or "lag" in name for fit in found.fits.values() for name in fit.candidate.names)
    now, options = next_ramps(found.blocks)
    least = [min(each.apart for each in parts.values()) for parts in (now, options[0].parts)]
    assert least[1] > 5 * least[0]  # what it proposes would help
    assert options[0].gain > 5 and options[0].gain > 0.5 * max(each.gain for each in options)
    assert all(part.information > now[name].information for each in options for name, part in each.parts.items())


def test_several_logs_are_one_unit(chamber):
    """The same cycles in two recordings, between which the gyroscope's bias jumped: the jump is no effect."""
    half = float(chamber.accelerometer.time[-1]) * 0.62
    parts = []
    for keep, shift in ((lambda t: t < half, 0.0), (lambda t: t >= half, 1e-3)):
        cut = {name: replace(each, time=each.time[keep(each.time)], values=each.values[keep(each.time)])
               for name, each in chamber.signals.items()}  # fmt: skip
        cut["gyroscope"] = replace(cut["gyroscope"], values=cut["gyroscope"].values + shift)
        parts.append(replace(chamber, **cut))
    found = calibrate_thermal(parts, block=60.0)
    assert found.blocks.levels == 2
    assert set(found.fits["gyroscope"].candidate.names) >= {"temperature", "temperature_rate"}
    gap = np.diff(found.fits["gyroscope"].level, axis=1)[:, 0]
    assert np.allclose(gap, 1e-3, atol=1e-4)


def test_poses_tell_scale_from_bias():
    effects = [CATALOGUE["accel.temperature"].make([1e-3, -1e-3, 2e-3]),
               CATALOGUE["accel.scale_temperature"].make([3e-4, -2e-4, 1e-4])]  # fmt: skip
    parts = []
    for seed, up in enumerate(([0, 0, 1.0], [1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0], [-1.0, 0, 0], [0, 1.0, 0])):
        recording, _ = simulate(
            UNIT.with_effects(*effects), SoakAndRamp(low=0.0, high=40.0, rates=(4.0,), soak_duration=60.0),
            consumer_noise(), rate=2.0, seed=seed,
        )  # fmt: skip
        signal = recording.accelerometer
        warmth = np.interp(signal.time, recording.temperature.time, recording.temperature.values[:, 0]) - 25.0
        gain = np.asarray(UNIT.accelerometer.gain) + np.multiply.outer(warmth, np.diag([3e-4, -2e-4, 1e-4]))
        turned = 9.80665 * (np.array(up) - [0, 0, 1.0])
        parts.append(replace(recording, accelerometer=replace(signal, values=signal.values + gain @ turned)))
    found = calibrate_thermal(parts)
    assert "scale_temperature" in found.identifiability.told
    scale = next(e for e in found.calibration.imu.accelerometer.effects if e.name == "accel.scale_temperature")
    assert np.allclose(scale.coefficients, [3e-4, -2e-4, 1e-4], rtol=0.05)  # the force itself is known to some percent
    value, _ = found.bias("accelerometer", np.array([5.0]))
    assert np.allclose(value, -20 * np.array([[1e-3, -1e-3, 2e-3]]), atol=2e-3)


def test_the_base_calibration_keeps_its_gain_and_its_bias_at_its_temperature(found, chamber):
    base = replace(found.calibration, imu=UNIT, names=(), covariance=np.zeros((0, 0)),
                   data={"temperature": 10.0})  # fmt: skip
    joined = calibrate_thermal(chamber, base=base, block=60.0).calibration
    assert np.array_equal(joined.imu.accelerometer.gain, UNIT.accelerometer.gain)
    at = truth_of("accelerometer", [10.0])[0]
    assert np.allclose(joined.imu.accelerometer.bias + at, UNIT.accelerometer.bias, atol=2e-3)


def test_the_base_calibration_keeps_what_is_known_of_its_other_effects(found, chamber):
    """The thermal part takes the place of the base's own; an effect behind that moves up, with its uncertainty."""
    names = [Name("gyroscope", "coefficients", (k,), 1) for k in range(9)]
    effects = CATALOGUE["gyro.temperature"].make(1e-6), CATALOGUE["gyro.g_sensitivity"].make(1e-5)
    imu = replace(UNIT, gyroscope=replace(UNIT.gyroscope, effects=effects))
    base = replace(found.calibration, imu=imu, names=tuple(names), covariance=np.diag(np.arange(1.0, 10.0) ** 2))
    joined = calibrate_thermal(chamber, base=base, block=60.0).calibration
    document = joined.document()["gyroscope"]["effects"]
    assert document["gyro.g_sensitivity"]["sigma"] == list(np.arange(1.0, 10.0))
    assert None not in document["gyro.temperature"]["sigma"]


# --- noise ------------------------------------------------------------------------------------------------------------


def test_slow_noise_does_not_pass_for_temperature():
    """A random walk of the bias while the temperature goes up and down: nothing of temperature is claimed beyond it."""
    rng = np.random.default_rng(5)
    for _ in range(2):
        recording, _ = simulate(UNIT, SoakAndRamp(low=0.0, high=40.0, rates=(2.0,), soak_duration=300.0),
                                consumer_noise(), rate=1.0, seed=int(rng.integers(1 << 30)))  # fmt: skip
        signal = recording.gyroscope
        walk = np.cumsum(rng.normal(0, 3e-6, signal.values.shape), axis=0)
        found = calibrate_thermal(replace(recording, gyroscope=replace(signal, values=signal.values + walk)))
        value, sigma = found.bias("gyroscope", np.array([2.0, 38.0]))
        assert np.all(np.abs(value) < 4 * np.maximum(sigma, 1e-12))


def test_a_jump_is_said(one_way, found):
    """Inside the rest the gyroscope's y output steps by 0.1 °/s, its z output by a fifth; else no jump is spoken of."""
    assert not any("jumps" in note for note in found.notes)
    assert one_way.gyroscope is not None
    values = one_way.gyroscope.values + np.radians(0.1) * (one_way.gyroscope.time > 1000.0)[:, None] * [0, 1, -0.2]
    stepped = replace(one_way, gyroscope=replace(one_way.gyroscope, values=values))
    jumping = calibrate_thermal(stepped, families=("cubic",))
    (said,) = (note for note in jumping.notes if "jumps" in note)
    sizes = re.search(r"gyroscope's output jumps by (\S+) °/s \(y\) and −(\S+) °/s \(z\)", said)
    assert np.allclose([float(size) for size in sizes.groups()], [0.1, 0.02], rtol=0, atol=0.004)
    assert "at 1000 s" in said.replace("999 s", "1000 s")
    # what is said to be left is what `compensate` leaves, the jump included
    left = compensate(jumping.calibration, stepped).gyroscope
    ends = np.searchsorted(left.time, np.stack([jumping.blocks.start, jumping.blocks.stop]))
    means = np.array([left.values[a:b].mean(axis=0) for a, b in ends.T])
    np.testing.assert_allclose(jumping.fits["gyroscope"].after, means.std(axis=0), rtol=0.02)
    assert jumping.fits["gyroscope"].after[1] > 0.8 * np.radians(0.05)


def test_a_known_noise_is_used(chamber):
    noise = NoiseModel(AxisNoise.of_white(1e-2), AxisNoise.of_white(1e-4))
    found = calibrate_thermal(chamber, static=noise, block=60.0)
    assert found.noise is noise and np.all(found.fits["gyroscope"].chi_squared < 0.01)


# --- exports ----------------------------------------------------------------------------------------------------------


def px4_offset(p, stem, kelvin):
    """PX4's formula, stated anew: X0 + X1 d + X2 d² + X3 d³, the temperature held between TMIN and TMAX."""
    d = min(max(kelvin, p[f"{stem}_TMIN"]), p[f"{stem}_TMAX"]) - p[f"{stem}_TREF"]
    return np.array([sum(p[f"{stem}_X{n}_{axis}"] * d**n for n in range(4)) for axis in range(3)])


def ardupilot_correction(p, stem, kelvin, at):
    """ArduPilot's formula, stated anew: what is subtracted at a temperature, offsets calibrated at another."""
    low, high = p["INS_TCAL1_TMIN"], p["INS_TCAL1_TMAX"]

    def polynomial(t):
        d = min(max(t, low), high) - 35.0
        c = {n: np.array([p[f"{stem}{n}_{axis}"] for axis in "XYZ"]) for n in (1, 2, 3)}
        return d * (c[1] + d * (c[2] + d * c[3])) * 1e-6

    return polynomial(kelvin) - polynomial(at)


def read_parameters(text):
    found = {}
    for line in text.splitlines():
        if not line.startswith("#"):
            cells = line.split()
            name, value = (cells[2], cells[3]) if len(cells) == 5 else cells
            found[name] = float(value)
    return found


FORWARD_RIGHT_DOWN = np.array([1.0, -1.0, -1.0])
"""The axes of both autopilots, of a unit whose axes are forward, left, up."""


def test_autopilots_take_off_what_was_put_in(found):
    kelvin = np.linspace(-20, 60, 9)
    px4 = px4_parameters(found.calibration, 0, 1310988, 2162188)
    p = read_parameters(px4.text)
    assert p == pytest.approx(px4.parameters, rel=1e-6)
    assert p["TC_A0_ID"] == 1310988 and p["TC_G_ENABLE"] == 1
    ardupilot = ardupilot_parameters(found.calibration)
    q = read_parameters(ardupilot.text)
    for name, stem, short in (("accelerometer", "TC_A0", "INS_TCAL1_ACC"), ("gyroscope", "TC_G0", "INS_TCAL1_GYR")):
        wanted = found.bias(name, kelvin)[0] * FORWARD_RIGHT_DOWN
        offsets = np.array([px4_offset(p, stem, t) for t in kelvin])
        tolerance = 4 * px4.loss[name].max() + 1e-7
        assert np.allclose(offsets, wanted, atol=tolerance)
        assert np.allclose(px4_offset(p, stem, 90.0), px4_offset(p, stem, 60.0), atol=1e-4 * np.abs(wanted).max())
        moved = np.array([ardupilot_correction(q, short, t, 20.0) for t in kelvin])
        wanted = (found.bias(name, kelvin)[0] - found.bias(name, np.array([20.0]))[0]) * FORWARD_RIGHT_DOWN
        assert np.allclose(moved, wanted, atol=4 * ardupilot.loss[name].max() + 1e-7)
    assert "accel.thermal_lag" in " ".join(px4.notes) and "gyro.temperature_rate" in " ".join(px4.notes)


def test_px4_with_both_files_subtracts_the_bias_once(found):
    """Accelerometer.hpp, Gyroscope.hpp: (data − thermal offset − offset), scaled for the accelerometer."""
    imu, rest = found.calibration.imu, {"accelerometer": [0.2, -0.1, 0.3], "gyroscope": [0.01, -0.02, 0.03]}
    biased = {name: replace(triad, bias=np.array(rest[name])) for name, triad in imu.triads().items()}
    calibration = replace(found.calibration, imu=replace(imu, **biased))
    px4 = px4_parameters(calibration)
    p, q = (
        read_parameters(px4.text),
        read_parameters(writer("px4").write(ExportedUnit.of(calibration)).files[""].decode()),
    )
    for name, stem, cal in (("accelerometer", "TC_A0", "CAL_ACC0"), ("gyroscope", "TC_G0", "CAL_GYRO0")):
        offset = np.array([q[f"{cal}_{axis}OFF"] for axis in "XYZ"])
        for celsius in (-20.0, 25.0, 60.0):
            output = rest[name] + found.bias(name, np.array([celsius]))[0][0]  # no force, no rate
            output = output * FORWARD_RIGHT_DOWN
            assert np.all(np.abs(output - px4_offset(p, stem, celsius) - offset) < 4 * px4.loss[name] + 1e-6)


def test_a_cubic_loses_what_it_cannot_hold(found):
    """A curve beyond a cubic: the loss told is the distance to the nearest cubic, computed anew."""
    triad = found.calibration.imu.gyroscope
    kind = CATALOGUE["gyro.learned_temperature"]
    curve = kind.make(np.linspace(-1e-3, 1e-3, kind.size), low=253.15, high=333.15)
    imu = replace(found.calibration.imu, gyroscope=replace(triad, effects=(curve,)))
    calibration = replace(found.calibration, imu=imu)
    kelvin = np.linspace(*calibration.data["temperature_range"], 401)
    values = np.asarray(curve.shapes(kelvin + 273.15)) @ np.asarray(curve.coefficients).reshape(3, -1).T
    left = values - np.stack([np.polyval(np.polyfit(kelvin, each, 3), kelvin) for each in values.T], axis=1)
    wanted = np.sqrt(np.mean(left**2, axis=0))
    assert np.allclose(px4_parameters(calibration).loss["gyroscope"], wanted, rtol=1e-3)
    assert np.allclose(ardupilot_parameters(calibration).loss["gyroscope"], wanted, rtol=1e-2)


def test_exports_refuse_what_has_no_range(found):
    bare = replace(found.calibration, data={})
    with pytest.raises(NotPossibleError, match="over which temperatures"):
        px4_parameters(bare)
    with pytest.raises(InputError, match="0 to 3"):
        px4_parameters(found.calibration, 4)
    with pytest.raises(InputError, match="1 to 3"):
        ardupilot_parameters(found.calibration, 0)


# --- regression -------------------------------------------------------------------------------------------------------


def test_multifactor_keeps_what_was_put_in():
    rng = np.random.default_rng(2)
    factors = {name: rng.normal(size=400) for name in ("V", "T", "dT", "To", "dTo")}
    truth = 3 + 2 * factors["V"] - factors["T"] + 0.5 * factors["V"] * factors["T"] + 0.3 * factors["dT"] ** 2
    terms, held_out = multifactor(factors, truth + rng.normal(0, 0.01, 400))
    assert {"1", "V", "T", "V·T", "dT²"} <= set(terms) and len(terms) <= 10
    assert 0.009 < held_out < 0.012


# --- bad input --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def leg(data_folder):
    return read_recording(data_folder / "tofupilot_cooling" / "cooling_leg.tsv", None, ReadOptions(columns=LEG))


def test_the_measured_leg(leg):
    found = calibrate_thermal(leg)
    assert any("first row is a start-up transient" in note for note in found.notes)
    words = " ".join(found.identifiability.words)
    assert "cannot separate the rate of temperature, a lag or a hysteresis" in words and "cycle" in words
    assert any("gyroscope's output jumps" in note and "(x)" in note for note in found.notes)
    for fit in found.fits.values():
        assert np.all(np.std(fit.residual, axis=0) < 0.33 * fit.before)  # every axis; 0.07 to 0.3
        assert fit.candidate.family != "constant"
    for name, fit in found.fits.items():  # the dots that are drawn lie on the curve, but for what the model leaves
        assert not set(fit.candidate.names) & {"temperature_rate", "thermal_lag"}
        curve, level = found.bias(name, found.blocks.temperature)[0], found.blocks.level
        dots, residual = bias_dots(found, name), residual_dots(found, name)
        np.testing.assert_allclose(dots - curve, residual, atol=0.02 * float(np.ptp(curve)))
        assert level.max() == 1  # the knock's offset is in neither picture
        for rest in (level == 0, level == 1):
            np.testing.assert_allclose(residual[rest].mean(axis=0), 0.0, atol=1e-12)
            np.testing.assert_allclose(np.ptp((residual - fit.residual)[rest], axis=0), 0.0, atol=1e-12)
    (curve,) = (row for row in effect_table(found.calibration).rows if "learned_temperature" in row[0])
    largest = np.max(np.abs(found.bias("accelerometer", np.linspace(*found.blocks.range, 101))[0]), axis=0)
    shown = [abs(float(cell.split()[0].replace("−", "-"))) for cell in curve[1:4]]
    np.testing.assert_allclose(shown, largest, rtol=0.01)
    held = without_startup(leg)
    assert len(held.accelerometer) == len(leg.accelerometer) - 1


def test_stamps_need_a_unit(data_folder):
    with pytest.raises(InputError, match=r"states no unit.*time \[\?\]"):  # µs and ns are both plausible there
        read_recording(data_folder / "tofupilot_cooling" / "cooling_leg.tsv")


def test_stamps_in_the_wrong_unit(one_way):
    slow = {name: replace(each, time=each.time * 1e6) for name, each in one_way.signals.items()}
    with pytest.raises(InputError, match=r"not in the unit stated"):
        rest_blocks(replace(one_way, **slow))


def test_no_temperature(one_way):
    with pytest.raises(NotPossibleError, match="no temperature"):
        calibrate_thermal(replace(one_way, temperature=None))


def test_constant_temperature(one_way):
    assert one_way.temperature is not None
    still = replace(one_way.temperature, values=np.full_like(one_way.temperature.values, 25.0))
    with pytest.raises(NotPossibleError, match=r"only goes from 25\.00 to 25\.00"):
        calibrate_thermal(replace(one_way, temperature=still))


@pytest.mark.parametrize(("scale", "offset", "said"), [(1.0, 273.15, r"temperature \[K\]"), (326.8, 0, "raw counts")])
def test_temperature_in_another_unit(one_way, scale, offset, said):
    assert one_way.temperature is not None
    other = replace(one_way.temperature, values=scale * one_way.temperature.values + offset)
    with pytest.raises(InputError, match=said):
        calibrate_thermal(replace(one_way, temperature=other))


def test_start_up_rows_are_dropped_and_a_later_knock_is_not(one_way):
    values = one_way.gyroscope.values.copy()
    values[:7] += 0.5
    values[900] += 0.5
    cleaned = without_startup(replace(one_way, gyroscope=replace(one_way.gyroscope, values=values)))
    assert len(cleaned.accelerometer) == len(one_way.accelerometer) - 7
    assert cleaned.notes[-1].endswith("left out.") and "first 7 rows are" in cleaned.notes[-1]
    assert without_startup(one_way) is one_way


def test_the_first_of_coarse_steps_is_no_start_up(one_way):
    """Of a thermometer with steps of half a degree 65 rows were "far off what follows"."""
    steps = {"accelerometer": 0.02, "temperature": 0.5}
    signals = {name: getattr(one_way, name) for name in steps}
    rounded = {
        name: replace(each, values=steps[name] * np.round(each.values / steps[name])) for name, each in signals.items()
    }
    coarse = replace(one_way, **rounded)
    assert without_startup(coarse) is coarse


def test_blocks_in_which_the_unit_moved_are_left_out(one_way):
    values = one_way.accelerometer.values.copy()
    values[1000:1050] += np.random.default_rng(0).normal(0, 3.0, (50, 3))
    knocked = replace(one_way, accelerometer=replace(one_way.accelerometer, values=values))
    blocks = rest_blocks(knocked)
    assert any("was knocked, first about 500.0 s in" in note for note in blocks.notes)  # as every verb says it
    assert np.ptp(blocks.means["accelerometer"], axis=0).max() < 0.1
    values[1000:1400] += np.random.default_rng(0).normal(0, 3.0, (400, 3))  # too long for a knock
    blocks = rest_blocks(replace(one_way, accelerometer=replace(one_way.accelerometer, values=values)))
    assert 50 <= blocks.dropped <= 110 and any("moved" in note for note in blocks.notes)


def test_status_flags(tmp_path, one_way):
    path = tmp_path / "log.csv"
    rows = ["time [s],accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2],imu.status"]
    rows += [f"{k / 10},{k % 3},{k % 5},9.{k % 7},{4 if k in (3, 8) else 0}" for k in range(40)]
    path.write_text("\n".join(rows))
    recording = without_flagged(read_recording(path), path)
    assert len(recording.accelerometer) == 38 and "2 rows whose imu.status is not 0" in recording.notes[-1]


def test_a_block_too_short(one_way):
    with pytest.raises(InputError, match="less than two samples"):
        rest_blocks(one_way, 0.5)
    noise = 9.8 + np.random.default_rng(0).normal(0, 0.01, (40000, 3))
    with pytest.raises(InputError, match="more than"):
        rest_blocks(replace(one_way, accelerometer=Signal(np.arange(40000) / 10.0, noise, "m/s^2"),
                            gyroscope=None), 1.0)  # fmt: skip


# --- command line -----------------------------------------------------------------------------------------------------


def test_the_command(commanded, capsys):
    folder, _, printed = commanded
    document = json.loads(printed)
    assert document["schema"] == "jaximu.thermal/1"
    assert "accel.thermal_lag" in document["accelerometer"]["effects"]
    written = {path.name for path in (folder / "out").iterdir()}
    assert {"calibration.json", "thermal.json", "report.html", "px4.params", "ardupilot.param", "covered.png",
            "surface_gyroscope.png", "residual_accelerometer.png", "bias_gyroscope.png"} <= written  # fmt: skip
    saved = json.loads((folder / "out" / "calibration.json").read_text())
    assert saved["reading"]["units"]["temperature"] == "degC"
    assert "axes are the autopilot's own" in (folder / "out" / "px4.params").read_text()
    page = (folder / "out" / "report.html").read_text()
    assert "thermal_lag" in page and "http:" not in page and "https:" not in page  # base64 may hold "http"
    assert main(["thermal", str(folder / "chamber.csv"), "--block", "60"]) == 0
    shown = capsys.readouterr().out
    assert "of 15 terms" in " ".join(shown.split())  # the chamber's own temperature was recorded, too
    assert "cubic" in shown and "thermal" in shown
    assert "With accelerometer bias over temperature (accel.temperature)" in " ".join(shown.split())


def test_the_command_refuses(one_way, tmp_path, capsys):
    log = tmp_path / "log.csv"
    write_recording(replace(one_way, temperature=None), log)
    assert main(["thermal", str(log)]) == 1
    assert "no temperature" in capsys.readouterr().err
    assert main(["thermal", str(log), "--to", "px4"]) == 2
    assert main(["thermal"]) == 2
