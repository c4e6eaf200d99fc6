"""Signals, axis maps and plausibility."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaximu.ground.errors import InputError
from jaximu.recordings.recording import Recording, Signal, apply_axes, axis_matrix, parse_axes, plausibility

RATE = 100.0


def turned(seconds: float = 40.0, seed: int = 0) -> Recording:
    """A unit turned slowly about a tumbling axis: rates of about 0.5 rad/s, white noise."""
    noise = np.random.default_rng(seed)
    time = np.arange(round(seconds * RATE)) / RATE
    rate = 0.5 * np.stack([np.sin(0.3 * time), np.cos(0.5 * time), np.sin(0.7 * time)], 1)
    up = np.empty((len(time), 3))
    up[0] = 0.0, 0.0, 1.0
    for at in range(1, len(time)):
        up[at] = up[at - 1] - np.cross(rate[at - 1], up[at - 1]) / RATE
        up[at] /= np.linalg.norm(up[at])
    force = 9.80665 * up + 0.05 * noise.standard_normal(up.shape)
    rate = rate + 0.01 * noise.standard_normal(rate.shape)
    return Recording(Signal(time, force, "m/s^2"), Signal(time, rate, "rad/s"))


def scaled(signal: Signal | None, factor: float) -> Signal:
    assert signal is not None
    return replace(signal, values=signal.values * factor)


def test_signal_defaults_and_si():
    signal = Signal(np.arange(4.0) / 50.0, np.ones((4, 3)), "m/s^2")
    assert signal.rate == pytest.approx(50.0)
    assert len(signal) == 4
    np.testing.assert_array_equal(signal.si(), signal.values)
    raw = Signal(np.arange(2.0), np.full((2, 3), 110.0), "count", np.array([10.0, 20.0, 5.0]), np.array([100.0]))
    np.testing.assert_allclose(raw.si(), [[1.0, 0.5, 2.0]] * 2)


def test_signal_refuses_unequal_lengths():
    with pytest.raises(ValueError, match="3 time stamps for 2 samples"):
        Signal(np.arange(3.0), np.zeros((2, 3)), "m/s^2")


def test_recording_lists_its_signals():
    assert list(turned(1.0).signals) == ["accelerometer", "gyroscope"]


# --- axes


signed_axes = st.tuples(st.permutations("xyz"), st.tuples(*[st.sampled_from(["", "+", "-"])] * 3)).map(
    lambda pair: [sign + axis for axis, sign in zip(*pair, strict=True)]
)


@given(signed_axes, st.sampled_from([",", " ", ", "]))
def test_axis_matrix_is_a_signed_permutation(terms, separator):
    matrix = axis_matrix(separator.join(terms))
    np.testing.assert_array_equal(matrix @ matrix.T, np.eye(3))
    source = np.array([1.0, 2.0, 3.0])
    expected = [(-1.0 if term[0] == "-" else 1.0) * source["xyz".index(term[-1])] for term in terms]
    np.testing.assert_array_equal(matrix @ source, expected)


@given(signed_axes)
def test_a_mapped_raw_signal_keeps_its_meaning(terms):
    raw = Signal(
        np.arange(2.0), np.array([[1.0, 2.0, 3.0], [4.0, 6.0, 8.0]]), "count", np.array([2.0, 4.0, 5.0]), np.arange(3.0)
    )
    text = ",".join(terms)
    mapped = apply_axes(Recording(raw), f"accel={text}").accelerometer
    np.testing.assert_allclose(mapped.si(), raw.si() @ axis_matrix(text).T)
    assert (mapped.nominal_scale > 0.0).all()


def test_axes_by_name_and_minus_f():
    maps = parse_axes("FRD;-f")
    np.testing.assert_array_equal(maps["gyroscope"], np.diag([1.0, -1.0, -1.0]))
    np.testing.assert_array_equal(maps["accelerometer"], np.diag([-1.0, 1.0, 1.0]))
    maps = parse_axes("accel=x,y,-z;gyro=-x,-y,z")
    np.testing.assert_array_equal(maps["accelerometer"], np.diag([1.0, 1.0, -1.0]))
    np.testing.assert_array_equal(maps["gyroscope"], np.diag([-1.0, -1.0, 1.0]))
    np.testing.assert_array_equal(maps["magnetometer"], np.eye(3))
    assert "axes mapped: FLU." in apply_axes(turned(1.0), "FLU").notes


@pytest.mark.parametrize("spec", ["x,y", "x,x,z", "a,b,c", "NED", "accel=x,y", "foot=x,y,z", "x,y,z,x"])
def test_bad_axes(spec):
    with pytest.raises(InputError, match="axis map"):
        parse_axes(spec)


def test_a_mirrored_single_map_is_refused():
    with pytest.raises(InputError, match=r"mirror image.*separate maps"):
        parse_axes("x,y,-z")


# --- plausibility


def test_a_sound_recording_is_plausible():
    recording = turned()
    assert plausibility(recording) == ()
    assert recording.gyroscope is not None
    found = recording.turning
    assert found is not None
    assert found.slope == pytest.approx(1.0, abs=0.05)
    assert found.correlation > 0.9


@pytest.mark.parametrize(
    ("factor", "advice"),
    [
        (1 / 9.80665, "like g"),
        (1e3 / 9.80665, "like mg"),
        (9.80665, "like m/s², stated as g"),
        (0.2, "check the unit"),
    ],
)
def test_wrong_accelerometer_unit(factor, advice):
    recording = turned(2.0)
    with pytest.raises(InputError, match=rf"accel_x.*{advice}"):
        plausibility(replace(recording, accelerometer=scaled(recording.accelerometer, factor)))


@pytest.mark.parametrize(
    ("factor", "advice"),
    [
        (57.29578, "like deg/s"),
        (1 / 57.29578, "like rad/s, stated as deg/s"),
        (57295.78, "like mdeg/s"),
        (6.0, "no unit makes this factor"),
    ],
)
def test_wrong_gyroscope_unit_is_seen_in_slow_motion(factor, advice):
    recording = turned()
    with pytest.raises(InputError, match=rf"gyro_x.*{advice}"):
        plausibility(replace(recording, gyroscope=scaled(recording.gyroscope, factor)))


def test_exchanged_columns_are_told():
    recording = turned()
    force, rate = recording.accelerometer, recording.gyroscope
    exchanged = Recording(replace(rate, unit="m/s^2"), replace(force, unit="rad/s"))
    with pytest.raises(InputError, match=r"stays at 9\.8.* columns are exchanged"):
        plausibility(exchanged)


def test_wrong_scale_of_counts_points_to_the_option():
    recording = turned()
    gyroscope = replace(scaled(recording.gyroscope, 57.0), unit="count")
    with pytest.raises(InputError, match="gyro_scale"):
        plausibility(replace(recording, gyroscope=gyroscope))
    accelerometer = replace(scaled(recording.accelerometer, 57.0), unit="count")
    with pytest.raises(InputError, match="accel_offset"):
        plausibility(replace(recording, accelerometer=accelerometer))


def test_impossible_rate_and_temperature():
    recording = turned(2.0)
    fast = Signal(recording.accelerometer.time, np.full((200, 3), 500.0), "rad/s")
    with pytest.raises(InputError, match="faster than any"):
        plausibility(replace(recording, gyroscope=fast))
    with pytest.raises(InputError, match=r"temperature.*absolute zero"):
        plausibility(replace(recording, temperature=Signal(np.arange(2.0), np.array([20.0, -300.0]), "degC")))


def test_opposite_axes_are_noted():
    recording = turned()
    (note,) = plausibility(replace(recording, gyroscope=scaled(recording.gyroscope, -1.0)))
    assert "--axes" in note
    assert plausibility(replace(recording, gyroscope=None)) == ()


def test_a_still_recording_is_not_judged_by_its_turns():
    noise = np.random.default_rng(1)
    time = np.arange(4000) / RATE
    force = np.array([0.0, 0.0, 9.8]) + 0.02 * noise.standard_normal((4000, 3))
    rate = 0.002 + 0.01 * noise.standard_normal((4000, 3))
    assert plausibility(Recording(Signal(time, force, "m/s^2"), Signal(time, rate, "rad/s"))) == ()
