"""What a diagnosis says of everyday recordings: sway, lost samples, jitter, instants, what swings, jumps and drifts."""

from dataclasses import replace

import hidden_effects as hidden
import numpy as np
import pytest
from everyday import Trial, instants, swaying, with_jitter, with_losses

from jaximu import LocalGravity, diagnose, read_recording
from jaximu.diagnosis.evidence import EffectBlock, Evidence
from jaximu.diagnosis.selection import select
from jaximu.mistakes import inspect
from jaximu.model.effects import CATALOGUE

GRAVITY = LocalGravity(hidden.GRAVITY, 0.0)


def drawn(seed, names=(), *, size=None, axis=None, amount=None, moved=None, logged=None, **options):
    """The case, its one hidden effect of a size on one axis."""
    plain = hidden.draw_case(seed, names, static_minutes=15, **options)
    hiding = plain.hidden
    if axis is not None:
        hiding = tuple(replace(each, unit_coefficients=size * np.eye(3)[axis]) for each in hiding)
    return Trial(plain.protocol, hiding, amount=amount, moved=moved, logged=logged)


def said(case, folder, static=False):
    """The diagnosis of a case."""
    files = case.write(folder, ("fit", "static") if static else ("fit",))
    return diagnose(read_recording(files["fit"]), GRAVITY, static=read_recording(files["static"]) if static else None)


def named(found):
    return [each.name for each in found.effects]


def test_sway_in_a_hand_is_neither_noise_of_the_unit_nor_a_line(tmp_path):
    found = said(drawn(1, moved=swaying, amount=0.05, poses=24), tmp_path, static=True)
    assert (found.verdict, named(found)) == ("adequate", [])
    assert [each.name for each in found.preflight] == ["data.moving_pose"]
    assert "in its poses" in found.not_observable["noise.correlated"]


def test_drift_that_rises_to_low_frequencies_is_no_line(tmp_path):
    case = drawn(2, flicker=36.0)
    assert inspect(read_recording(case.write(tmp_path, ("fit",))["fit"])) == []


def test_weak_effects_of_two_sensors_are_named_together(tmp_path):
    """Neither imitates what the other does; each is below twice its detection limit or little above."""
    case = drawn(5000, ("gyro.earth_rotation", "accel.asymmetry"))
    found = said(case.with_size({"gyro.earth_rotation": 1.0, "accel.asymmetry": 1.63}), tmp_path)
    assert found.verdict == "effects"
    assert {name for each in found.effects for name in (each.name, *each.rivals)} >= {each.name for each in case.hidden}
    assert len(found.effects) == 2


def test_a_lag_of_one_axis_is_named_where_axes_move(tmp_path):
    """What is common to all axes is hardly seen: it must not run away to where a lag is no derivative any more."""
    found = said(drawn(6005, ("gyro.lag",), size=2e-4, axis=2, two_axes=True), tmp_path)
    assert (found.verdict, named(found)) == ("effects", ["gyro.lag"])
    lag = np.asarray(found.named[0].effect.coefficients)
    np.testing.assert_allclose(lag - lag[0], [0.0, 0.0, 2e-4], atol=5e-5)
    assert np.max(np.abs(lag)) < 5e-3


def test_a_bias_that_swings_is_no_noise_and_its_period_is_told(tmp_path):
    case = drawn(9001, ("everyday.gyro_sine",), size=4.5e-4, axis=1)
    period = case.hidden[0].inner["period"]
    found = said(case, tmp_path)
    assert (found.verdict, named(found)) == ("unexplained", [])
    assert found.shape is not None and "gyroscope's bias swings" in found.summary().verdict[1]
    assert abs(float(found.shape.split()[-2]) / period - 1) < 0.1
    assert "cycles" in found.suggestion


def test_a_scale_that_jumps_is_named_with_its_time(tmp_path):
    case = drawn(11001, ("everyday.gyro_scale_jump",), size=2.5e-3, axis=2, poses=30)
    found = said(case, tmp_path)
    assert (found.verdict, named(found)) == ("effects", ["gyro.scale_step"])
    (effect,) = (each.effect for each in found.named)
    assert abs(effect.onset - case.protocol.duration / 2) < 6
    assert effect.coefficients[2] == pytest.approx(2.5e-3, rel=0.2)
    assert f"from {float(effect.onset):.4g} s on" in found.summary().verdict[0]


def test_turns_that_lost_a_sample_are_left_out_and_told(tmp_path):
    found = said(drawn(12000, logged=with_losses, amount=1e-3), tmp_path)
    assert (found.verdict, named(found)) == ("adequate", [])
    (lost,) = found.preflight
    assert lost.name == "data.lost_samples"
    assert "3 turns left out" in lost.text
    assert all(f"between {a} s" in lost.text for a in ("42.4 and 43.9", "81.0 and 82.3", "135.9 and 137.4"))


def test_two_curves_that_mend_each_other_are_no_pair():
    """Quadratic and asymmetry together fit a quartic to the noise; an odd curve is another matter."""
    rate = np.linspace(-5.0, 5.0, 80)
    curves = {"gyro.quadratic": rate**2, "gyro.asymmetry": np.abs(rate), "gyro.cubic": rate**3}
    blocks = [EffectBlock(k, each[:, None], np.ones(1), curved=CATALOGUE[k].curved()) for k, each in curves.items()]
    base = np.stack([np.ones(80), rate], axis=1)

    def causes(seed, shape):
        found = select(Evidence(np.random.default_rng(seed).standard_normal(80) + shape, base, blocks))
        return found.complete, {blocks[cause.block].name for cause in found.causes}

    for seed in (1, 4, 5):
        assert causes(seed, 0.03 * rate**4)[0] is False
        assert causes(seed, rate**2 + rate**3 / 2) == (True, {"gyro.quadratic", "gyro.cubic"})


def test_a_strong_quartic_is_not_called_by_two_other_names(tmp_path):
    found = said(drawn(13001, ("everyday.gyro_quartic",), size=1.62e-4, axis=1), tmp_path, static=True)
    assert found.verdict == "unexplained" and not named(found) and found.learned.effect.name == "gyro.learned_rate"


def test_stamps_that_jitter_past_each_other_get_a_steady_clock(tmp_path):
    case = drawn(14000, logged=with_jitter, amount=2e-3)
    assert (np.diff(case.fit.time) < 0).any()
    recording = read_recording(case.write(tmp_path, ("fit",))["fit"])
    np.testing.assert_allclose(np.diff(recording.accelerometer.time), 0.01, rtol=1e-4)
    np.testing.assert_array_equal(recording.accelerometer.values, case.fit.accel)
    assert [each.name for each in inspect(recording)] == ["data.jitter"]


def test_samples_of_instants_are_integrated_as_such(tmp_path):
    case = drawn(16000, moved=instants, amount=9, rate=25.0, oversampling=9, two_axes=True)
    found = said(case, tmp_path)
    assert (found.verdict, named(found)) == ("adequate", [])
    assert found.preflight[0].name == "data.sampling" and "instants" in found.preflight[0].text
    (rate,) = (each for each in found.preflight if "too quick" in each.text)
    assert 40 < float(rate.text.split("Log at ")[1].split()[0]) < 100
