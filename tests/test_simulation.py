"""Simulation: the same arguments give the same recording, in one piece or in blocks, alone or in a batch."""

import json

import equinox as eqx
import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_protocols import SMALL

from jaximu.ground.errors import InputError
from jaximu.model import BiasInstability, BiasRepeatability, Noise, RandomConstant, RandomWalk, White
from jaximu.model.effects import CATALOGUE
from jaximu.model.sensor import Imu, Triad
from jaximu.recordings.readers import read_recording
from jaximu.simulation import (
    ARTEFACTS,
    Case,
    Stream,
    consumer_noise,
    draw_imu,
    simulate,
    simulate_cases,
    write_case,
)
from jaximu.simulation.artefacts import (
    Clipping,
    Dropped,
    Gap,
    Jitter,
    LoggedRows,
    Periodic,
    QuantisedOutput,
    Repeated,
    StuckAxis,
    SwappedAxes,
)
from jaximu.simulation.protocols import Environment, HandHeld, Static

HELD = HandHeld(6, 1.0, 0.6)
WARMING = Environment(temperature=[[0, 20], [4, 45], [9, 30]])
RICH = {
    "accelerometer": Noise(
        (White(1e-3), RandomWalk(1e-4), BiasInstability(3e-4), RandomConstant(0.1)), "specific_force"
    ),
    "gyroscope": Noise((White(1e-4), BiasInstability(2e-5), BiasRepeatability(1e-3)), "angular_rate"),
}


def with_effects(*effects) -> Imu:
    return draw_imu(2).with_effects(*effects)


def values(recording) -> np.ndarray:
    return np.column_stack([signal.values for signal in recording.signals.values()])


def in_blocks(case, block) -> np.ndarray:
    parts = [samples for (samples,) in Stream([case], block)]
    columns = [np.concatenate([part.time for part in parts])[:, None]]
    return np.column_stack(columns + [np.concatenate([p.values[name] for p in parts]) for name in parts[0].values])


def test_without_noise_the_recording_is_the_response():
    imu = with_effects(CATALOGUE["accel.quadratic"].make(1e-3), CATALOGUE["gyro.g_sensitivity"].make(2e-4))
    recording, truth = simulate(imu, HELD, seed=1)
    force, rate = eqx.filter_jit(Imu.respond)(imu, truth.stimulus)
    np.testing.assert_allclose(recording.accelerometer.values, force, atol=1e-12)
    np.testing.assert_allclose(recording.gyroscope.values, rate, atol=1e-12)
    assert recording.temperature is None and recording.attitude is None
    assert len(recording.accelerometer) == truth.case.samples == round(100 * (6 * 1.0 + 5 * 0.6))


def test_the_same_arguments_give_the_same_recording():
    def made(**changes):
        arguments = {"rate": 100.0, "seed": 4, "power_on": 0} | changes
        return simulate(draw_imu(2), HELD, RICH, environment=WARMING, **arguments)[0]

    first = made()
    np.testing.assert_array_equal(values(first), values(made()))
    for changes in ({"seed": 5}, {"seed": (4, 0)}, {"power_on": 1}):
        assert np.abs(values(first) - values(made(**changes)))[:, :6].min(axis=1).max() > 0


def test_what_belongs_to_the_unit_stays_over_power_ons():
    constant = {"gyroscope": Noise((RandomConstant(0.1), BiasRepeatability(0.01)), "angular_rate")}
    bias = np.asarray(draw_imu(2).gyroscope.bias)

    def at_rest(seed, power_on):
        return simulate(draw_imu(2), Static(0.5), constant, seed=seed, power_on=power_on)[0].gyroscope.values[0] - bias

    means = np.array([[at_rest(seed, power_on) for power_on in range(3)] for seed in range(4)])
    within, between = means.std(axis=1).mean(), means.mean(axis=1).std()
    assert 0.003 < within < 0.02 < between < 0.25


@settings(max_examples=6, deadline=None)
@given(block=st.sampled_from([448, 1024]), seed=st.integers(0, 2**31), rate=st.sampled_from([50.0, 100.0]))
def test_blocks_make_no_difference(block, seed, rate):
    """Effects with a memory, a set-up error that looks at its neighbours, every artefact, all noise."""
    imu = with_effects(
        CATALOGUE["accel.thermal_lag"].make(1e-2, time_constant=3.0),
        CATALOGUE["gyro.thermal_hysteresis"].make(1e-2, half_width=1.0),
        CATALOGUE["setup.time_offset"].make(0.013),
        CATALOGUE["setup.clock_scale"].make(1e-3),
    )
    artefacts = [
        Periodic("accel_x", 0.1, 3.0), Clipping(9.0, 1.0), QuantisedOutput(1e-3, 1e-4, 0.1),
        StuckAxis("gyro_y", 2.0, 3.0), Repeated(0.1), Dropped(0.05), Gap(4.0, 5.0),
    ]  # fmt: skip
    case = Case.of(imu, HELD, RICH, rate, seed, 0, WARMING, artefacts)
    whole, pieces = in_blocks(case, None), in_blocks(case, block)
    assert whole.shape == pieces.shape
    different = np.abs(whole - pieces) > 1e-9
    # a value on the edge of a quantisation step may fall to either side by rounding
    assert different.mean() < 1e-3 and np.abs(whole - pieces).max() < 0.11


def test_blocks_make_no_difference_at_all_without_rounding_to_steps():
    imu = with_effects(CATALOGUE["accel.thermal_lag"].make(1e-2, time_constant=3.0))
    case = Case.of(imu, HELD, RICH, 100.0, 7, 0, WARMING, [Jitter(1e-3), StuckAxis("accel_z", 1.0)])
    np.testing.assert_allclose(in_blocks(case, 192)[:, 1:], in_blocks(case, None)[:, 1:], atol=1e-11)


def test_units_simulated_together_are_what_they_are_alone():
    units = [draw_imu(k) for k in range(3)]
    together = simulate_cases([Case.of(imu, HELD, RICH, 100.0, (9, k)) for k, imu in enumerate(units)])
    for k, (found, _) in enumerate(together):
        alone, _ = simulate(units[k], HELD, RICH, rate=100.0, seed=(9, k))
        np.testing.assert_allclose(found.accelerometer.values, alone.accelerometer.values, atol=1e-12)
        np.testing.assert_allclose(found.gyroscope.values, alone.gyroscope.values, atol=1e-12)


def test_cases_that_are_not_alike_are_not_simulated_together():
    a, b = Case.of(draw_imu(0), HELD), Case.of(draw_imu(1), HandHeld(7, 1.0, 0.6))
    with pytest.raises(ValueError, match="must share"):
        simulate_cases([a, b])


def test_noise_has_its_stated_size_and_counts_scale_it():
    noise = {"accelerometer": Noise((White(0.01),), "specific_force")}
    gain = np.diag([2000.0, 1000.0, 500.0])
    imu = Imu(Triad(gain, np.array([10.0, 0.0, -10.0]), output_unit="count"), None)
    recording, _ = simulate(imu, Static(100.0), noise, seed=1)
    scatter = recording.accelerometer.values.std(axis=0)
    np.testing.assert_allclose(scatter, 0.01 * 10 * np.diag(gain), rtol=0.02)
    assert recording.accelerometer.unit == "count" and recording.gyroscope is None
    np.testing.assert_allclose(recording.accelerometer.si().mean(axis=0), [0.005, 0, 9.80665 - 0.02], atol=0.01)


@pytest.mark.parametrize("name", ["setup.time_offset", "setup.reference_delay", "setup.clock_scale"])
def test_time_errors_of_the_set_up_shift_what_is_sensed(name):
    """A second look-up of the same motion at the shifted times; half a sample and more."""
    for size in (0.004, -0.023):
        size = size / 2 if name == "setup.clock_scale" else size
        ideal = Imu(Imu.nominal().accelerometer, Imu.nominal().gyroscope, (CATALOGUE[name].make(size),))
        recording, truth = simulate(ideal, HELD, seed=5)
        time = np.asarray(truth.stimulus.time)
        at = {"setup.time_offset": time - size, "setup.reference_delay": time + size,
              "setup.clock_scale": time / (1 + size)}[name]  # fmt: skip
        motion = jax.tree.map(np.asarray, truth.case.plan.motion)
        interval = 0.01 / (1 + size) if name == "setup.clock_scale" else 0.01
        moved = eqx.filter_jit(lambda m, t, h: m.at(t + 0.005, h))(motion, at, np.asarray(interval))
        error = recording.gyroscope.values - moved.angular_rate
        unshifted = recording.gyroscope.values - truth.stimulus.angular_rate
        assert np.abs(unshifted).max() > 0.02
        # cubic interpolation: worst where a turn begins or ends, whose sample is a mean over its edge
        assert np.abs(error).max() < 0.02 and np.sqrt(np.mean(error**2)) < 0.002 * np.abs(moved.angular_rate).max()
        shifted_force = np.abs(recording.accelerometer.values - truth.stimulus.specific_force).max() > 0.01
        assert shifted_force == (name != "setup.time_offset")


# --- artefacts ------------------------------------------------------------------------------------------------------


def rows(count=200, seed=0) -> LoggedRows:
    rng = np.random.default_rng(seed)
    time = np.arange(count) / 100.0
    return LoggedRows(
        np.arange(count), time,
        {"accelerometer": rng.standard_normal((count, 3)), "gyroscope": rng.standard_normal((count, 3)),
         "temperature": 25 + rng.standard_normal((count, 1))},
    )  # fmt: skip


def applied(artefact, **changes):
    samples = rows(**changes)
    kept = artefact.apply(samples, np.random.default_rng(1), None)
    return samples, rows(**changes), artefact.report(kept)


def test_clipping_stops_at_the_range_and_says_so():
    after, before, report = applied(Clipping(1.0))
    assert np.abs(after.values["accelerometer"]).max() == 1.0
    inside = np.abs(before.values["accelerometer"]) <= 1
    np.testing.assert_array_equal(after.values["accelerometer"][inside], before.values["accelerometer"][inside])
    np.testing.assert_array_equal(after.values["gyroscope"], before.values["gyroscope"])
    count = np.sum(~inside.all(axis=1))
    assert f"accelerometer left its range of ±1 in {count} samples" in report
    assert applied(Clipping(100.0, 100.0))[2] is None


def test_quantisation_rounds_to_steps():
    after, before, _ = applied(QuantisedOutput(0.25, None, 0.5))
    steps = after.values["accelerometer"] / 0.25
    np.testing.assert_array_equal(steps, np.round(steps))
    assert np.abs(after.values["accelerometer"] - before.values["accelerometer"]).max() <= 0.125
    np.testing.assert_array_equal(after.values["gyroscope"], before.values["gyroscope"])
    assert set(np.mod(after.values["temperature"], 0.5).ravel()) == {0.0}


def test_stuck_swapped_and_periodic_axes():
    after, before, _ = applied(StuckAxis("gyro_y", 0.5, 1.0))
    assert set(after.values["gyroscope"][50:100, 1]) == {before.values["gyroscope"][49, 1]}
    np.testing.assert_array_equal(after.values["gyroscope"][100:], before.values["gyroscope"][100:])
    np.testing.assert_array_equal(after.values["gyroscope"][:, 0], before.values["gyroscope"][:, 0])
    after, before, _ = applied(SwappedAxes("accelerometer", "y,-x,z"))
    x, y, z = before.values["accelerometer"].T
    np.testing.assert_array_equal(after.values["accelerometer"], np.column_stack([y, -x, z]))
    after, before, _ = applied(Periodic("accel_z", 0.3, 10.0))
    line = after.values["accelerometer"] - before.values["accelerometer"]
    assert np.abs(line[:, :2]).max() == 0 and np.argmax(np.abs(np.fft.rfft(line[:, 2]))) == 20
    np.testing.assert_allclose(line[:, 2].std(), 0.3 / np.sqrt(2), rtol=1e-6)


def test_lost_and_repeated_samples():
    after, before, _ = applied(Dropped(0.3), count=4000)
    assert 0.27 < 1 - len(after.time) / 4000 < 0.33
    np.testing.assert_array_equal(after.values["gyroscope"], before.values["gyroscope"][after.row])
    np.testing.assert_array_equal(after.time, after.row / 100)
    after, before, _ = applied(Gap(0.5, 0.8))
    assert len(after.time) == 170 and np.diff(after.time).max() == pytest.approx(0.31)
    after, before, _ = applied(Repeated(0.4), count=4000)
    same = (np.diff(after.values["accelerometer"], axis=0) == 0).all(axis=1)
    assert 0.37 < same.mean() < 0.43
    np.testing.assert_array_equal(same, (np.diff(after.values["gyroscope"], axis=0) == 0).all(axis=1))
    fresh = np.concatenate([[True], ~same])
    np.testing.assert_array_equal(after.values["gyroscope"][fresh], before.values["gyroscope"][fresh])


@given(sigma=st.floats(0.0, 0.1), share=st.floats(0.0, 0.8))
def test_jittered_stamps_increase(sigma, share):
    samples = rows()
    Dropped(share).apply(samples, np.random.default_rng(2), None)
    Jitter(sigma).apply(samples, np.random.default_rng(1), None)
    assert (np.diff(samples.time) > 0).all()
    assert np.abs(samples.time - samples.row / 100).max() <= 0.0045 + 1e-12


def test_artefacts_are_applied_in_the_order_in_which_they_happen():
    case = Case.of(draw_imu(0), HELD, artefacts=[Jitter(1e-3), QuantisedOutput(0.1), Clipping(9.03)])
    assert [type(each) for each in case.artefacts] == [Clipping, QuantisedOutput, Jitter]
    recording, truth = simulate_cases([case])[0]
    assert np.abs(recording.accelerometer.values).max() == pytest.approx(9.0)
    assert "left its range" in truth.notes[0]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Clipping(-1.0), "clipping: accelerometer must not be negative"),
        (lambda: QuantisedOutput(gyroscope=float("nan")), "quantisation: gyroscope must not be negative"),
        (lambda: StuckAxis("accel_w", 1.0), "axis must be one of accel_x"),
        (lambda: StuckAxis("accel_x", 2.0, 1.0), "start must be before stop"),
        (lambda: Gap(2.0, 2.0), "start must be before stop"),
        (lambda: Dropped(1.0), "share must be at least 0 and below 1"),
        (lambda: Repeated(-0.1), "share"),
        (lambda: Jitter(-1e-3), "sigma must not be negative"),
        (lambda: SwappedAxes("accelerometer", "x,x,z"), "signed axes"),
        (lambda: SwappedAxes("thermometer", "y,x,z"), "sensor must be"),
        (lambda: Periodic("mag_x", 1.0, 1.0), "axis must be one of"),
    ],
)
def test_artefacts_that_make_no_sense_are_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()


def test_every_artefact_says_under_which_name_it_is_found():
    assert all(kind.catalogue.startswith("data.") and kind.__doc__ for kind in ARTEFACTS.values())


# --- files ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".parquet", ".csv", ".npz"])
def test_a_written_case_is_the_recording(tmp_path, suffix):
    case = Case.of(draw_imu(1), SMALL["rate-table"], consumer_noise(), 100.0, 3, 0, WARMING, [Dropped(0.02)])
    truth = write_case(case, tmp_path / f"log{suffix}")
    back, recording = read_recording(tmp_path / f"log{suffix}"), simulate_cases([case])[0][0]
    assert set(back.signals) == set(recording.signals)
    assert {"temperature", "attitude", "table_rate"} < set(back.signals)
    for name, signal in recording.signals.items():
        np.testing.assert_allclose(back.signals[name].values, signal.values, atol=1e-12)
        np.testing.assert_allclose(back.signals[name].time + back.start, signal.time, atol=1e-9)
    assert truth.case is case


def test_parquet_is_streamed_in_blocks(tmp_path, monkeypatch):
    import pyarrow.parquet as pq

    monkeypatch.setattr("jaximu.simulation.protocols.motion.BLOCKS", (4096,))
    case = Case.of(draw_imu(1), Static(100.0), consumer_noise(), 100.0, 3)
    write_case(case, tmp_path / "log.parquet")
    written = pq.ParquetFile(tmp_path / "log.parquet")
    assert written.num_row_groups == 3 and written.metadata.num_rows == 10_000
    alone = simulate_cases([case])[0][0].accelerometer.values
    np.testing.assert_allclose(read_recording(tmp_path / "log.parquet").accelerometer.values, alone, atol=1e-12)


def test_nothing_is_left_behind_when_writing_fails(tmp_path):
    with pytest.raises(InputError):
        write_case(Case.of(draw_imu(1), HELD), tmp_path / "missing" / "log.parquet")
    with pytest.raises(InputError, match="no samples"):
        write_case(Case.of(draw_imu(1), HELD, artefacts=[Gap(-1.0, 1e9)]), tmp_path / "log.parquet")
    assert not list(tmp_path.iterdir())


def test_the_truth_tells_what_was_done(tmp_path):
    imu = with_effects(
        CATALOGUE["accel.thermal_lag"].make([1e-3, 0.0, -1e-3], time_constant=77.0),
        CATALOGUE["setup.table_tilt"].make(1e-3),
    )
    _, truth = simulate(imu, SMALL["single-axis-table"], RICH, artefacts=[StuckAxis("accel_x", 1.0)], seed=(3, 1))
    truth.save(tmp_path / "truth.json")
    document = json.loads((tmp_path / "truth.json").read_text())
    assert document["schema"] == "jaximu.truth/1" and document["seed"] == [3, 1]
    np.testing.assert_allclose(document["accelerometer"]["gain"], imu.accelerometer.gain)
    lag = document["accelerometer"]["effects"]["accel.thermal_lag"]
    assert lag["coefficients"] == [1e-3, 0.0, -1e-3] and lag["unit"] == "(m/s^2)/K"
    assert lag["inner"] == {"time_constant": {"value": 77.0, "unit": "s"}}
    assert document["setup"]["effects"]["setup.table_tilt"]["scope"] == "fixture"
    assert [each["process"] for each in document["gyroscope"]["noise"]] == [
        "White",
        "BiasInstability",
        "BiasRepeatability",
    ]
    assert document["protocol"]["kind"] == "single-axis-table" and document["artefacts"][0]["stop"] is None
    truth.save_schedule(tmp_path / "schedule.csv")
    lines = (tmp_path / "schedule.csv").read_text().splitlines()
    assert lines[0] == "start [s],stop [s],kind,x,y,z,angle [deg],heading [deg]"
    assert len(lines) - 1 == len(document["schedule"]) and all(len(line.split(",")) == 8 for line in lines)
    pose, turn = lines[1].split(","), lines[2].split(",")
    assert pose[2] == "pose" and pose[6] == "" and float(pose[7]) == pytest.approx(0.0)
    np.testing.assert_allclose([float(each) for each in pose[3:6]], [1, 0, 0], atol=1e-12)
    assert turn[2] == "turn" and float(turn[6]) == pytest.approx(180.0) and turn[7] == ""
