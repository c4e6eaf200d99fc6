"""Diagnosis of recordings at rest over temperature: causes are named, what goes together in one way is tied."""

from dataclasses import replace

import numpy as np
import pytest

from jaximu.calibration import load_calibration
from jaximu.diagnosis.thermal import diagnose_thermal
from jaximu.ground.errors import NotPossibleError
from jaximu.model.effects import CATALOGUE
from jaximu.simulation import simulate
from jaximu.simulation.draw import consumer_noise, draw_imu
from jaximu.simulation.protocols import Environment, SoakAndRamp, Static

UNIT = draw_imu(3)
CYCLES = SoakAndRamp(low=0.0, high=50.0, rates=(3.0, 6.0), soak_duration=200.0)


def recorded(*effects, protocol=CYCLES, environment=None):
    return simulate(UNIT.with_effects(*effects), protocol, consumer_noise(), rate=1.0, seed=4,
                    environment=environment)[0]  # fmt: skip


@pytest.fixture(scope="module")
def lagging():
    effects = [CATALOGUE["accel.temperature"].make([1e-3, -2e-3, 1e-3]),
               CATALOGUE["accel.temperature_squared"].make([1e-5, 2e-5, -1e-5]),
               CATALOGUE["gyro.temperature"].make([1e-4, -2e-4, 1e-4]),
               CATALOGUE["gyro.temperature_cubed"].make([1e-8, -2e-8, 3e-8]),
               CATALOGUE["gyro.thermal_lag"].make([2e-4, -1e-4, 1e-4], time_constant=200.0)]  # fmt: skip
    return diagnose_thermal(recorded(*effects))


@pytest.fixture(scope="module")
def clean():
    return diagnose_thermal(recorded())


def test_nothing_hidden_is_adequate(clean):
    assert clean.verdict == "adequate" and not clean.effects
    assert "gyro.thermal_lag" in clean.detection_limits and "gyro.quadratic" in clean.not_observable


def test_a_lag_is_named_beyond_any_smooth_function_of_temperature(lagging):
    assert [each.name for each in lagging.effects] == ["gyro.thermal_lag"]
    (named,) = lagging.effects
    inner = float(named.effect.time_constant)
    assert inner == pytest.approx(200.0, rel=0.1)
    assert np.allclose(named.effect.coefficients, [2e-4, -1e-4, 1e-4], rtol=0.1)
    extended = lagging.extended_calibration()  # what it says of its fit is that of the model with the lag
    assert len(extended.names) == 10 and extended.rank >= 7
    assert max(extended.excess.values()) < 0.5
    assert any("smooth function of temperature" in note for note in lagging.notes)
    assert lagging.gain is not None and lagging.gain.log_likelihood > 0
    # what the page shows is what is beyond the smooth function, as is what was left out
    shown = lagging.experiment.errors(lagging.extended)
    for errors, (left_out, _) in zip(shown, lagging.gain.after.rms.values(), strict=True):
        assert np.sqrt(np.mean(errors**2)) < 1.5 * left_out


def test_where_only_smooth_functions_of_temperature_show_the_calibration_loads(tmp_path):
    effects = [CATALOGUE[f"{name}.temperature{power}"].make(np.array([1, -2, 1]) * size) for name, power, size in (
        ("accel", "", 1e-3), ("accel", "_squared", 1e-5), ("gyro", "", 1e-4), ("gyro", "_cubed", 1e-8))]  # fmt: skip
    found = diagnose_thermal(recorded(*effects))
    assert not found.effects
    found.extended_calibration().save(tmp_path / "calibration.json")
    assert load_calibration(tmp_path / "calibration.json").names == found.calibration.names


def test_a_warm_up_ties_temperature_with_what_goes_with_it_and_asks_for_a_cycle():
    environment = Environment(temperature=[[0, 20.0], [200, 27.0], [500, 33.0], [1000, 38.0], [1800, 41.0]])
    effect = CATALOGUE["gyro.temperature"].make([1e-5, -2e-5, 1e-5])
    found = diagnose_thermal(recorded(effect, protocol=Static(1800.0), environment=environment))
    assert found.verdict == "effects"
    names = {found.effects[0].name, *found.effects[0].rivals}
    assert "gyro.temperature" in names and len(names) > 1
    assert "cycle" in found.suggestion


def test_the_conditions_are_linear_in_the_effects(clean):
    """Columns are the derivatives of the conditions: an effect of known size moves them by as much."""
    experiment = clean.experiment
    imu = clean.base.imu
    plain = experiment.linearise(imu)
    kind = CATALOGUE["gyro.thermal_lag"]
    effect = kind.make([1e-4, 2e-4, -1e-4], time_constant=300.0)
    columns = experiment.dormant_columns(imu, plain.details, {kind: [{"time_constant": 300.0}]})[kind][0]
    moved = plain.conditions - experiment.linearise(imu.with_effects(effect)).conditions
    assert np.allclose(moved, columns @ np.asarray(effect.coefficients), atol=1e-12)
    # along the way, of which blocks are means: equal, but for rounding, where the temperature changes evenly
    ratio = experiment.largest(clean.base, effect)["gyroscope"] / np.abs(moved).max()
    assert 1 - 1e-9 < ratio < 1.1


def test_in_one_pose_scale_is_bias_over_temperature():
    """A hysteresis of the accelerometer once was named as the part of a linear bias that its misalignment makes."""
    effect = CATALOGUE["accel.thermal_hysteresis"].make([2e-5, -2e-5, 2e-5], half_width=4.0)
    rest, _ = simulate(UNIT, Static(3600.0), consumer_noise(), rate=1.0, seed=5)
    found = diagnose_thermal(recorded(effect), static=rest)
    assert "poses tell them apart" in found.not_observable["accel.misalignment_temperature"]
    assert any("accel.thermal_hysteresis" in (each.name, *each.rivals) for each in found.effects)


def test_it_needs_a_gyroscope():
    recording = recorded(protocol=Static(100.0))
    with pytest.raises(NotPossibleError, match="gyroscope"):
        diagnose_thermal(replace(recording, gyroscope=None))


@pytest.mark.slow
def test_false_alarms_stay_within_binomial_bounds():
    """Five per cent are asked for: of ten recordings with nothing hidden four are alarms once in a thousand."""
    alarms = 0
    for seed in range(10):
        recording, _ = simulate(draw_imu(100 + seed), CYCLES, consumer_noise(), rate=1.0, seed=100 + seed)
        alarms += diagnose_thermal(recording).verdict != "adequate"
    assert alarms <= 3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gyro.thermal_lag", "gyro.thermal_hysteresis", "gyro.warm_up"])
def test_what_is_hidden_alone_is_in_the_set(name):
    size = {"gyro.thermal_lag": 2e-6, "gyro.thermal_hysteresis": 2e-6, "gyro.warm_up": 2e-4}[name]
    found = diagnose_thermal(recorded(CATALOGUE[name].make([size, -size, size])))
    assert found.verdict == "effects"
    assert any(name in (each.name, *each.rivals) for each in found.effects)
