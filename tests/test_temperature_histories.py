"""Any history of temperature will do: lag and hysteresis are found where the path shows them, axis by axis."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from temperature_histories import Unit, record

from jaximu.calibration import calibrate_thermal, compensate
from jaximu.cli.app import main
from jaximu.ground.errors import NotPossibleError
from jaximu.recordings import write_recording
from jaximu.report.export.thermal_autopilot import ardupilot_parameters, px4_parameters

TRIADS = {"accelerometer": 1.0, "gyroscope": 0.1}
SPAN = 30.0  # s, of the means that are compared


def unit(beyond: str, third: float = 1.0) -> Unit:
    """A unit whose z axes have nothing beyond temperature at once, and `third` of the usual of that."""
    polynomial = np.array([[1e-3, -5e-4, 8e-4 * third], [1e-5, 5e-6, -8e-6 * third], [0.0, 0.0, 0.0]])
    late, slack = np.array([1e-3, -6e-4, 0.0]), np.array([5e-4, 8e-4, 0.0])
    parts = ({name: size * each for name, size in TRIADS.items()} for each in (polynomial, late, slack))
    at_once, lagging, playing = parts
    return Unit(at_once, lagging, playing, 60.0, 3.0, beyond)


def means(signal) -> np.ndarray:
    """Means over half a minute, about the mean of all."""
    samples = round(SPAN * signal.rate)
    count = len(signal) // samples
    found = signal.values[: count * samples].reshape(count, samples, 3).mean(axis=1)
    return found - found.mean(axis=0)


def rms(values) -> np.ndarray:
    return np.sqrt(np.mean(values**2, axis=0))


@cache
def calibrated(kind: str, beyond: str):
    return calibrate_thermal(record(unit(beyond), kind, 4, rate=2.0)[0])


@pytest.fixture
def wandering():
    return calibrated("sines", "lag")


# all histories and units: benchmarks/results/thermal_histories.md
@pytest.mark.parametrize(
    ("kind", "beyond"),
    [("sines", "lag"), pytest.param("walk", "hysteresis", marks=pytest.mark.slow), ("steps", "both")],
)
def test_what_is_left_of_another_history_is_its_noise(kind, beyond):
    hidden, found = unit(beyond), calibrated(kind, beyond)
    other, quiet = record(hidden, kind, 5, rate=2.0)
    left = compensate(found.calibration, other)
    wanted = {"lag": {"thermal_lag"}, "hysteresis": {"thermal_hysteresis"},
              "both": {"thermal_lag", "thermal_hysteresis"}}[beyond]  # fmt: skip
    for name, fit in found.fits.items():
        assert np.all(rms(means(getattr(left, name))) < 1.1 * rms(means(getattr(quiet, name))))
        assert wanted == {effect for effect, _ in fit.inner}
        for (effect, _), (value, sigma) in fit.inner.items():
            true = hidden.lag if effect == "thermal_lag" else hidden.width
            assert abs(value - true) < 3.5 * sigma and sigma < 0.15 * true


def test_each_axis_has_its_own_terms(wandering):
    for fit in wandering.fits.values():
        own = [{term.name for term in terms} for terms in fit.candidate.model]
        assert "thermal_lag" in own[0] and "thermal_lag" in own[1] and "thermal_lag" not in own[2]
        lag = next(effect for effect in fit.effects if effect.plain == "thermal_lag")
        assert lag.coefficients[2] == 0.0
    document = wandering.document()["gyroscope"]
    assert document["model_by_axis"][0] == "thermal lag" != document["model_by_axis"][2]


def test_one_statement_says_what_the_path_separates(wandering):
    words = " ".join(wandering.identifiability.words)
    assert "separates" in words and "passed once" not in words and "cannot" not in words
    assert {"thermal_lag", "thermal_hysteresis"} <= set(wandering.identifiability.told)
    assert wandering.identifiability.parts["thermal_lag"].alone > 0.3


def test_an_axis_that_no_model_corrects_is_left_as_it_is():
    """The z axes have no temperature in them: neither the calibration nor an autopilot's file touches them."""
    found = calibrate_thermal(record(unit("none", third=0.0), "sines", 6, rate=2.0)[0])
    for name, fit in found.fits.items():
        assert fit.families[2] == "constant" and fit.families[0] != "constant"
        for effect in found.calibration.triads()[name].effects:
            assert not np.asarray(effect.coefficients).reshape(3, -1)[2].any()
    px4, ardupilot = px4_parameters(found).parameters, ardupilot_parameters(found).parameters
    assert all(px4[f"TC_{letter}0_X{power}_2"] == 0.0 for letter in "AG" for power in range(4))
    assert all(ardupilot[f"INS_TCAL1_{short}{power}_Z"] == 0.0 for short in ("ACC", "GYR") for power in (1, 2, 3))


def test_autopilots_get_the_cubic_that_fits_the_recording(wandering):
    """With a lag in the unit the written numbers leave what the best cubic leaves, and that is what is said."""
    blocks, px4 = wandering.blocks, px4_parameters(wandering)
    stems = {"accelerometer": "TC_A0", "gyroscope": "TC_G0"}
    for name, stem in stems.items():
        difference = blocks.temperature - px4.parameters[f"{stem}_TREF"]
        for axis in range(3):
            numbers = [px4.parameters[f"{stem}_X{power}_{axis}"] for power in (3, 2, 1, 0)]
            own = np.std(blocks.means[name][:, axis] - np.polyval(numbers, difference))
            best = np.polyval(np.polyfit(difference, blocks.means[name][:, axis], 3), difference)
            assert own < 1.02 * np.std(blocks.means[name][:, axis] - best)
            assert px4.left[name][axis] == pytest.approx(own, rel=1e-6)
        assert np.all(px4.loss[name][:2] > 3 * wandering.fits[name].after[:2])  # no cubic has the lag


def stepped():
    """A chamber with a lag, and a knock that moves the gyroscope's y output by 0.1 °/s."""
    recording, _ = record(unit("lag"), "chamber", 8, rate=2.0)
    signal = recording.gyroscope
    assert signal is not None
    values = signal.values + np.radians(0.1) * (signal.time > 4000.0)[:, None] * [0, 1, 0]
    return replace(recording, gyroscope=replace(signal, values=values))


def test_a_jump_is_kept_apart():
    found = calibrate_thermal(stepped())
    assert found.blocks.levels == 2 and len(found.jumps) == 1
    assert found.jumps[0][1] == pytest.approx(4000.0, abs=2 * found.blocks.duration)
    value, sigma = found.fits["gyroscope"].inner["thermal_lag", "time_constant"]
    assert abs(value - 60.0) < 3.5 * sigma and sigma < 12.0
    assert np.diff(found.fits["gyroscope"].level[1]) == pytest.approx(np.radians(0.1), rel=0.05)


def test_diagnose_names_the_lag_that_thermal_selects_and_writes_everything(tmp_path, capsys):
    log, out = tmp_path / "log.parquet", tmp_path / "out"
    write_recording(stepped(), log)
    assert main(["diagnose", "--thermal", str(log), "-o", str(out), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    named = {each["name"]: each for each in document["effects"]}
    assert {"accel.thermal_lag", "gyro.thermal_lag"} <= set(named)
    improvement = named["gyro.thermal_lag"]["improvement"]
    assert improvement["heldout_loglik"] > 100 and "left out" in improvement["data"]
    assert improvement["heldout_rms_after"] < 0.7 * improvement["heldout_rms_before"]
    assert any("jumps by" in note for note in document["notes"])
    assert {"diagnosis.json", "calibration.json", "report.html"} <= {path.name for path in out.iterdir()}
    extended = json.loads((out / "calibration.json").read_text())
    lag = extended["gyroscope"]["effects"]["gyro.thermal_lag"]["inner"]["time_constant"]
    assert lag["value"] == pytest.approx(60.0, abs=4 * lag["sigma"])


@pytest.mark.parametrize("spoilt", ["quantised", "dead axis", "no number", "no gyroscope", "one minute"])
def test_bad_recordings_end_in_numbers_or_in_a_sentence(spoilt):
    recording, _ = record(unit("lag"), "sines", 10, hours=0.5, rate=2.0)
    assert recording.gyroscope is not None and recording.temperature is not None
    gyroscope, temperature = recording.gyroscope, recording.temperature
    missing = np.where(np.arange(len(temperature))[:, None] % 50 == 7, np.nan, temperature.values)
    short = {name: replace(each, time=each.time[each.time < 60], values=each.values[each.time < 60])
             for name, each in recording.signals.items()}  # fmt: skip
    changed = {
        "quantised": {"gyroscope": replace(gyroscope, values=np.round(gyroscope.values / 0.003) * 0.003)},
        "dead axis": {"gyroscope": replace(gyroscope, values=gyroscope.values * [1, 1, 0])},
        "no number": {"temperature": replace(temperature, values=missing)},
        "no gyroscope": {"gyroscope": None},
        "one minute": short,
    }[spoilt]
    if spoilt == "one minute":
        with pytest.raises(NotPossibleError):
            calibrate_thermal(replace(recording, **changed))
        return
    found = calibrate_thermal(replace(recording, **changed))
    assert not {"NaN", "Infinity"} & set(found.text().replace('"', " ").replace(",", " ").split())
    if spoilt == "dead axis":
        assert found.fits["gyroscope"].families[2] == "constant"
    if spoilt == "no number":
        assert any("no numbers" in note for note in found.notes)


def test_fahrenheit_called_celsius_is_said():
    recording, _ = record(unit("none"), "sines", 9, hours=0.5, rate=2.0)
    assert recording.temperature is not None
    other = replace(recording.temperature, values=32.0 + 1.8 * recording.temperature.values)
    notes = calibrate_thermal(replace(recording, temperature=other), families=("cubic",)).notes
    assert any("temperature [degF]" in note for note in notes)
    assert not any("degF" in note for note in calibrate_thermal(recording, families=("cubic",)).notes)
