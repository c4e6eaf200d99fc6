"""Accept, certify, follow: decisions against drawn truth, formulas against others' numbers, bad input in sentences."""

import json
from dataclasses import replace
from xml.etree import ElementTree

import jax
import numpy as np
import pyarrow.csv as pc
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from test_fleet_population import FREE, SIZE, draw, values_of, write

from jaximu.acceptance import Rule, accept, follow, read_limits
from jaximu.acceptance.decision import coverage, probability_of_conformity
from jaximu.acceptance.line import population_limits, read_table, write_verdicts
from jaximu.acceptance.quantities import measure, of_calibration
from jaximu.acceptance.statistics import capability, control_chart, drift, gauge, tolerance_factor
from jaximu.acceptance.verify import verify
from jaximu.acceptance.words import si_unit
from jaximu.calibration import calibrate, load_calibration
from jaximu.cli.app import main
from jaximu.ground.document import digest
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.gravity import LocalGravity
from jaximu.model.effects import CATALOGUE
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.trace import NEEDED, missing, read_trace
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld

LIMITS = """
source = "data sheet"
[limits]
"accelerometer.bias" = "100 mg"
"accelerometer.scale" = "5 %"
"gyroscope.bias" = "5 deg/s"
"accelerometer.output" = { within = "20 mg", over = "1 g" }
"""
TRACE = """
serial = "A-1"
model = "model"
operator = "operator"
date = "2026-03-04"
[environment]
temperature = "23 degC"
[[reference]]
name = "gravity"
certificate = "G-1"
expires = "2026-03-04"
[certificate]
number = "C-1"
laboratory = "laboratory"
address = "address"
customer = "customer"
authorised_by = "somebody"
"""


@pytest.fixture(scope="module")
def calibration():
    recording, _ = simulate(draw_imu(3), HandHeld(12, 1.5), consumer_noise(), seed=3)
    return calibrate(recording, LocalGravity(9.80665, 0.01))


@pytest.fixture
def limits(tmp_path):
    def written(text=LIMITS):
        path = tmp_path / "limits.toml"
        path.write_text(text, encoding="utf-8")
        return read_limits(path)

    return written


# --- decisions --------------------------------------------------------------------------------------------------------


@given(
    st.floats(-3, 3), st.floats(0.01, 2), st.floats(-2, 0), st.floats(0.1, 2), st.sampled_from([np.inf, 1.0, 4.0, 30.0])
)
def test_probability_of_conformity_is_the_mass_between_the_limits(value, sigma, low, high, freedom):
    law = stats.norm() if np.isinf(freedom) else stats.t(freedom)
    expected = law.cdf((high - value) / sigma) - law.cdf((low - value) / sigma)
    assert probability_of_conformity(value, sigma, low, high, freedom) == pytest.approx(expected, abs=1e-12)


@given(st.floats(0.001, 0.49), st.sampled_from([np.inf, 3.0, 20.0]), st.sampled_from([-1, 1]))
def test_guard_band_of_a_single_limit(risk, freedom, side):
    rule = Rule("guarded", risk)
    band = float(rule.multiple(freedom))
    for off, expected in ((-1e-6, "undecided"), (1e-6, "pass" if side < 0 else "fail")):
        value = 1 + side * (band + off)
        probability = probability_of_conformity(value, 1.0, -np.inf, 1.0, freedom)
        assert rule.verdicts(probability, value <= 1) == expected


def test_simple_acceptance_looks_at_the_value_alone():
    verdicts = Rule("simple").verdicts([0.5001, 0.499, 0.9], [True, False, True])
    assert verdicts.tolist() == ["pass", "fail", "pass"]
    assert probability_of_conformity([1.0, 1.1], 0.0, 0.0, 1.0).tolist() == [1.0, 0.0]


def test_coverage_of_twice_the_standard_uncertainty():
    np.testing.assert_allclose(coverage([np.inf, 10.0]), [0.9545, 0.9266], atol=5e-5)  # tables of normal and t


def units_at_the_limit(path, risk, count=4000):
    """Verdicts on units whose accelerometer bias x is 0.01 m/s² in truth, which is the limit."""
    rng = np.random.default_rng(5)
    factor = 1e-3 * (np.eye(SIZE) + 0.3 * rng.standard_normal((SIZE, SIZE)))
    values = rng.standard_normal((count, SIZE)) @ factor.T
    values[:, 6] += 0.01
    covariances = np.broadcast_to(factor @ factor.T, (count, SIZE, SIZE))
    zeros = [np.zeros(3)] * count
    write(path, values_of(values), covariances, excess=zeros, poses=[30] * count, turns=[29] * count,
          accel_gain_sigma=[np.sqrt(np.diagonal(padded(factor @ factor.T)))[:9]] * count)  # fmt: skip
    file = path.with_suffix(".toml")
    file.write_text('[limits]\n"accelerometer.bias[0]" = "0.01 m/s^2"\n')
    return follow(read_table(path), read_limits(file, risk=risk))


def padded(covariance):
    """The covariance of all 24 numbers of a row."""
    whole = np.zeros((24, 24))
    whole[np.ix_(FREE, FREE)] = covariance
    return whole


@pytest.mark.parametrize("risk", [0.01, 0.05])
def test_false_acceptances_are_as_frequent_as_the_stated_risk(risk, tmp_path):
    line = units_at_the_limit(tmp_path / "table.parquet", risk)
    accepted, count = line.counts["pass"], len(line.verdicts)
    assert abs(accepted - risk * count) < 4 * np.sqrt(risk * (1 - risk) * count)
    assert line.counts["undecided"] > 0.8 * count
    write_verdicts(line, tmp_path / "with.parquet")
    table = pq.read_table(tmp_path / "with.parquet")
    assert table["acceptance"].to_pylist() == line.verdicts.tolist()
    missed = [each == ["accelerometer.bias[0]"] for each in table["not_passed"].to_pylist()]
    assert missed == [verdict != "pass" for verdict in line.verdicts]


# --- quantities -------------------------------------------------------------------------------------------------------


def test_quantities_and_their_uncertainty_by_monte_carlo(calibration, limits):
    held = limits()
    units = of_calibration(calibration)
    measured = measure(units, {}, [each for each in held.limits if each.part == "output"])
    at = {name: place for place, name in enumerate(measured.names)}
    rng = np.random.default_rng(0)
    drawn = rng.multivariate_normal(np.zeros(len(calibration.names)), calibration.covariance, 4000, method="cholesky")
    gain, bias = (
        np.tile(calibration.imu.accelerometer.gain, (4000, 1, 1)),
        np.tile(calibration.imu.accelerometer.bias, (4000, 1)),
    )
    for column, name in enumerate(calibration.names):
        if name.owner == "accelerometer":
            (gain if name.part == "gain" else bias)[(slice(None), *name.axes)] += drawn[:, column]
    own = np.diagonal(gain, axis1=1, axis2=2)
    for name, values in (("bias[1]", bias[:, 1] / own[:, 1]), ("scale[2]", own[:, 2] - 1),
                         ("misalignment[2,0]", gain[:, 2, 0] / own[:, 2])):  # fmt: skip
        place = at[f"accelerometer.{name}"]
        assert np.std(values) == pytest.approx(measured.sigma[0, place], rel=0.05)
        assert np.mean(values) == pytest.approx(measured.value[0, place], abs=5 * np.std(values) / np.sqrt(4000))
    # the corrected output over a sphere of 1 g, in directions drawn at random
    direction = rng.standard_normal((60, 3))
    force = 9.80665 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    output = np.einsum("nij,mj->nmi", gain, force) + bias[:, None]
    triad = calibration.imu.accelerometer
    corrected = (output - triad.bias) @ np.linalg.inv(triad.gain).T - force
    worst = np.std(corrected, axis=0).max(axis=0)
    outputs = [measured.sigma[0, at[f"accelerometer.output[{axis}]"]] for axis in range(3)]
    assert np.all(worst < 1.05 * np.array(outputs))
    assert np.all(worst > 0.85 * np.array(outputs))


def test_gravity_acts_on_a_scale_as_the_fit_says(calibration):
    measured = measure(of_calibration(calibration), {}, [])
    fitted = np.asarray(calibration.fit.magnitude_sensitivity) * calibration.gravity.sigma
    reach = np.abs(measured.slope[0] @ fitted)
    places = [k for k, name in enumerate(measured.names) if ".scale" in name or ".bias" in name]
    tolerance = 0.02 * calibration.gravity.sigma / calibration.gravity.value
    np.testing.assert_allclose(measured.gravity[0, places][3:6], reach[places][3:6], rtol=0.02, atol=tolerance)
    assert np.all(measured.gravity[0, places][6:] == 0)


def test_raw_output_is_the_response_of_the_unit(calibration, limits):
    held = limits('[limits]\n"accelerometer.raw_output" = { within = "5 g", over = "1 g" }\n')
    measured = measure(of_calibration(calibration), {}, held.limits)
    ends = 9.80665 * np.concatenate([np.eye(3), -np.eye(3)])
    error = np.asarray(calibration.imu.accelerometer.respond(Stimulus(specific_force=ends))) - ends
    assert np.all(np.abs(measured.value[0, -3:]) >= np.abs(error).max(axis=0) - 1e-9)


def test_effect_depends_on_what_a_range_must_state(calibration, limits):
    effect = CATALOGUE["accel.temperature"].make([1e-3, 0.0, 0.0])
    triad = replace(calibration.imu.accelerometer, effects=(effect,))
    warm = replace(calibration, imu=replace(calibration.imu, accelerometer=triad))
    with pytest.raises(InputError, match=r"accelerometer\.output: the effect accel\.temperature needs the temperature"):
        accept(warm, limits())
    held = limits('[limits]\n"accelerometer.raw_output[0]" = { within = "5 g", over = "1 g", '
                  'temperature = ["5 degC", "65 degC"] }\n')  # fmt: skip
    cold = accept(replace(calibration), held).items[0].value
    assert abs(accept(warm, held).items[0].value - cold) == pytest.approx(0.04, rel=1e-6)  # 40 K off 25 °C


def test_what_was_not_determined_is_undecided_and_named(calibration, limits):
    found = accept(calibration, limits(
        '[limits]\n"accelerometer.misalignment[0,1]" = "1 mrad"\n"magnetometer.bias" = "1 uT"\n'
        '"gyroscope.N" = "1 deg/s/sqrt(Hz)"\n"accel.quadratic" = "1 (m/s^2)/(m/s^2)^2"\n'
    ))  # fmt: skip
    assert found.verdict == "undecided"
    said = {each.name: each.said() for each in found.items}
    assert "convention" in said["accelerometer.misalignment[0,1]"]
    assert "holds no magnetometer" in said["magnetometer.bias"]
    assert "--effect accel.quadratic" in said["accel.quadratic"]
    assert "--noise" in said["gyroscope.N[2]"]
    json.loads(found.text())


def test_a_sensor_that_was_not_calibrated_is_undecided(calibration, limits):
    kept = [place for place, name in enumerate(calibration.names) if name.owner == "gyroscope"]
    alone = replace(calibration, names=tuple(calibration.names[place] for place in kept),
                    covariance=calibration.covariance[np.ix_(kept, kept)])  # fmt: skip
    found = accept(alone, limits())
    said = {each.name: each.said() for each in found.items if each.verdict == "undecided"}
    assert set(said) == {"accelerometer.bias", "accelerometer.scale", "accelerometer.output"}
    assert all("holds no accelerometer" in text for text in said.values())


def test_nominal_scales_belong_to_counts(calibration, limits):
    held = limits(LIMITS + '[nominal]\naccelerometer = "2048 count/g"\n')
    assert accept(calibration, held).verdict == "pass"


def test_navigation_is_limited_after_a_time(calibration, limits):
    """A heading is off by the gyroscope's bias times the time until the path turns; that is an error about zero."""
    text = """[limits]
"navigation.heading" = { within = "30 deg", after = "20 s" }
"navigation.position" = { within = "1 mm", after = "20 s" }
"navigation.position[2]" = { within = "1000 m", after = "30 s" }
"""
    found = accept(calibration, limits(text), file="unit")
    items = {item.name: item for item in found.items}
    place = calibration.names.index("gyroscope.bias[2]")
    gain = calibration.imu.gyroscope.gain[2, 2]
    bias = np.sqrt(calibration.covariance[place, place]) / gain
    heading = items["navigation.heading"]
    assert heading.sigma == pytest.approx(np.degrees(20 * bias), rel=0.02)
    assert (heading.verdict, heading.value, heading.unit) == ("pass", 0.0, "deg")
    assert {name for name in items if "position" in name} == {f"navigation.position[{axis}]" for axis in range(3)}
    assert items["navigation.position[0]"].verdict == "fail"  # a millimetre in twenty seconds
    assert [note for note in found.notes if "level driving" in note] and "without --noise" in " ".join(found.notes)
    east = items["navigation.position[0]"].sigma
    noisy = accept(calibration, limits(text), ALLAN)
    more = {item.name: item for item in noisy.items}["navigation.position[0]"].sigma
    # white noise N of specific force alone: N √(t³/3), van Loan's integral of a double integrator
    white = ALLAN["accelerometer"][0]["terms"]["N"]["value"] * np.sqrt(20**3 / 3)
    assert np.sqrt(more**2 - east**2) == pytest.approx(white, rel=0.01)
    size = 1.5 * heading.sigma
    tight = f'[limits]\n"navigation.heading" = {{ within = "{size} deg", after = "20 s" }}'
    undecided = accept(calibration, limits(tight))
    assert undecided.verdict == "undecided" and "times as much" in undecided.items[0].advice
    # g/2 t² of gravity's own uncertainty, which no recording lowers
    up = accept(calibration, limits('[limits]\n"navigation.position[2]" = { within = "2.5 m", after = "20 s" }')).items[
        0
    ]
    assert up.gravity == pytest.approx(calibration.gravity.sigma / 2 * 20**2, rel=0.02)
    assert up.verdict == "undecided" and "State local gravity" in up.advice


ALLAN = {
    triad: [{"terms": {"N": {"value": value, "unit": unit}}} for _ in range(3)]
    for triad, value, unit in (("accelerometer", 0.05, "m/s^2/sqrt(Hz)"), ("gyroscope", 1e-9, "rad/s/sqrt(Hz)"))
}


def test_advice_names_what_would_decide(calibration, limits):
    items = {each.name: each for each in accept(calibration, limits()).items}
    scale, bias = items["accelerometer.scale[0]"], items["accelerometer.bias[0]"]
    assert scale.gravity > 3 * scale.recording  # gravity to 0.1 % is what is known least
    near = scale.value + 1.2 * scale.sigma
    held = limits(f'[limits]\n"accelerometer.scale[0]" = {{ high = "{near:.9f} 1" }}\n')
    assert "local gravity" in accept(calibration, held).items[0].advice
    held = limits(f'[limits]\n"accelerometer.bias[0]" = {{ high = "{bias.value + bias.sigma:.9f} m/s^2" }}\n')
    found = accept(calibration, held).items[0]
    assert found.verdict == "undecided"
    assert "Record about" in found.advice
    better = replace(calibration, covariance=calibration.covariance / float(found.advice.split()[2]) / 1.1)
    assert accept(better, held).items[0].verdict == "pass"  # the advice is enough


# --- limits -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("line", "said"), [
    ('"accelerometer.bias" = 3', "needs a number with its unit"),
    ('"accelerometer.bias" = "3"', "needs a number with its unit"),
    ('"accelerometer.bias" = "3 deg"', "different quantities"),
    ('"accelerometer.bias" = { low = "1 mg", high = "-1 mg" }', "contradict"),
    ('"accelerometer.bias" = "1 mg"\n"accelerometer.bias[0]" = { low = "2 mg" }', "contradict"),
    ('"accelerometer.bias" = { within = "1 mg", low = "1 mg" }', "state one of"),
    ('"accelerometer.bias" = "-1 mg"', "greater than zero"),
    ('"accelerometer.color" = "1 mg"', "no such quantity"),
    ('"accelerometer.bias[3]" = "1 mg"', "axes are"),
    ('"accelerometer.misalignment[1]" = "1 mrad"', "axes are"),
    ('"accelerometer.scale" = "1 mg"', "no ratio"),
    ('"accelerometer.output" = "1 mg"', "over ="),
    ('"accelerometer.bias" = "1 mg"\n"accelerometer.bias" = "2 mg"', "not a file of limits"),
    ('"accelerometer.output" = { within = "1 mg", over = "1 g", temperature = ["50 degC", "5 degC"] }', "lowest"),
    ('"navigation.position" = "1 m"', "after ="),
    ('"navigation.position" = { within = "1 m", after = "2 h" }', "up to 3600 s"),
    ('"navigation.position" = { low = "1 m", after = "2 s" }', "about zero"),
    ('"navigation.heading[1]" = { within = "1 deg", after = "2 s" }', "no such quantity"),
    ('"accelerometer.bias" = { within = "1 mg", after = "2 s" }', "belongs to limits of navigation"),
])  # fmt: skip
def test_bad_limits_are_refused_by_name(line, said, limits):
    with pytest.raises(InputError, match=said):
        limits(f"[limits]\n{line}\n")


def test_limits_of_a_data_sheet_and_of_a_population(limits, tmp_path):
    entry = limits('[limits]\n"accelerometer.bias" = { typical = "10 mg" }').limits[0]
    assert entry.high == pytest.approx(3 * 10e-3 * 9.80665)
    assert "typical" in entry.source
    _, _, _, y, noise = draw(1, 60)
    count = len(y)
    write(tmp_path / "t.parquet", values_of(y), noise, excess=[np.zeros(3)] * count, poses=[30] * count,
          turns=[29] * count,
          accel_gain_sigma=[np.sqrt(np.diagonal(padded(each)))[:9] for each in noise])  # fmt: skip
    held = population_limits(tmp_path / "t.parquet", Rule())
    entry = next(each for each in held.limits if each.key == "accelerometer.bias[0]")
    numbers = read_table(tmp_path / "t.parquet").units.numbers
    values = numbers[:, 9] / numbers[:, 0]
    assert entry.high - entry.low == pytest.approx(2 * tolerance_factor(count) * np.std(values, ddof=1), rel=0.02)
    assert "99 %" in entry.source


def test_tolerance_factors_of_the_tables():
    # ISO 16269-6, two-sided, 95 % confidence of 99 %: n = 10, 30, 100
    np.testing.assert_allclose([tolerance_factor(n) for n in (10, 30, 100)], [4.433, 3.350, 2.934], rtol=0.01)


# --- the line ---------------------------------------------------------------------------------------------------------


def test_gauge_recovers_its_parts():
    rng = np.random.default_rng(0)
    size, places, each = 40, 8, 3
    part, place = 5.0 * rng.standard_normal(size), 2.0 * rng.standard_normal(places)
    entries = [
        (str(i), str(j), part[i] + place[j] + rng.standard_normal())
        for i in range(size)
        for j in range(places)
        for _ in range(each)
    ]
    parts, stations, values = zip(*entries, strict=True)
    found = gauge(np.array(values), np.ones(len(values)), parts, stations)
    assert found.crossed
    assert found.repeatability[1] < 1.0 < found.repeatability[2]
    assert found.reproducibility == pytest.approx(np.std(place, ddof=1), rel=0.1)
    assert found.parts == pytest.approx(np.std(part, ddof=1), rel=0.05)
    assert found.categories == int(1.41 * found.parts / np.hypot(found.repeatability[0], found.reproducibility))
    alone = gauge(np.array(values), np.ones(len(values)), parts, [""] * len(values))
    assert not alone.crossed
    assert alone.p_value < 1e-6  # the stations' scatter is more than was stated
    assert gauge(np.array([1.0, 2.0]), np.ones(2), ["a", "b"], ["", ""]) is None


def test_stated_uncertainty_explains_what_it_does():
    rng = np.random.default_rng(1)
    sigma = rng.uniform(0.5, 2.0, 400)
    parts = [str(k // 4) for k in range(400)]
    values = 10 * rng.standard_normal(100).repeat(4) + sigma * rng.standard_normal(400)
    found = gauge(values, sigma, parts, [""] * 400)
    assert found.explained == pytest.approx(1.0, abs=0.12)
    assert 1e-3 < found.p_value < 1 - 1e-3


@pytest.mark.parametrize(("owner", "unit"), [("gyroscope", "rad/s"), ("magnetometer", "uT")])
def test_each_sensor_has_its_own_unit(owner, unit):
    assert [si_unit(f"{owner}.{part}") for part in ("bias[0]", "scale[1]", "misalignment[1,0]")] == [unit, "1", "rad"]


def test_charts_find_a_shift_and_are_quiet_without():
    rng = np.random.default_rng(2)
    quiet = [control_chart(rng.standard_normal(200), 0.05) for _ in range(200)]
    alarms = sum(bool(len(each.beyond) or len(each.drifting)) for each in quiet)
    assert alarms < 30  # 5 % for each of two, and some luck
    assert control_chart(rng.standard_normal(20), 0.05).bound == pytest.approx(3.0, abs=0.05)
    moved = rng.standard_normal(200)
    moved[100:] += 1.5
    assert len(control_chart(moved, 0.001).drifting)
    off = rng.standard_normal(200)
    off[50] = 9.0
    assert 50 in control_chart(off, 0.001).beyond


def test_capability_of_the_textbook():
    values = np.array([9.0, 10.0, 11.0] * 10)
    found = capability(values, 5.0, 17.0)
    deviation = np.std(values, ddof=1)
    assert found.cp[0] == pytest.approx(12 / 6 / deviation)
    assert found.cpk[0] == pytest.approx(5 / 3 / deviation)
    assert found.cp[1] < found.cp[0] < found.cp[2]
    assert np.isnan(capability(values, -np.inf, 17.0).cp[0])


def test_line_names_station_shift_and_golden_unit(tmp_path):
    rng = np.random.default_rng(7)
    count = 240
    y = 1e-3 * rng.standard_normal((count, SIZE))
    y[np.arange(count) % 2 == 1, 6] += 5e-3  # one station adds to the bias of x
    y[180:, 7] += 4e-3  # the line moves
    golden = np.arange(0, count, 20)
    y[golden, 8] += np.linspace(0, 0.02, len(golden))
    noise = np.broadcast_to(1e-8 * np.eye(SIZE), (count, SIZE, SIZE))
    device = [f"unit{k}" for k in range(count)]
    for k in golden:
        device[k] = "golden"
    write(tmp_path / "t.parquet", values_of(y), noise, device=device, excess=[np.zeros(3)] * count, poses=[30] * count,
          turns=[29] * count, station=[f"S{k % 2}" for k in range(count)],
          accel_gain_sigma=[np.sqrt(np.diagonal(padded(noise[0])))[:9]] * count,
          date=[str(np.datetime64("2026-01-01") + k) for k in range(count)])  # fmt: skip
    line = follow(read_table(tmp_path / "t.parquet"), golden="golden")
    kinds = {(each.kind, each.name) for each in line.alarms}
    assert ("station", "accelerometer.bias[0]") in kinds
    assert ("average", "accelerometer.bias[1]") in kinds
    assert ("golden", "accelerometer.bias[2]") in kinds
    assert {name for _, name in kinds} == {f"accelerometer.bias[{axis}]" for axis in range(3)}
    assert drift(np.zeros(5), np.arange(5.0)) is None
    with pytest.raises(InputError, match="no device 'gold'"):
        follow(line.table, golden="gold")
    json.dumps(line.document(), allow_nan=False)


def test_a_lot_that_is_off_is_named_and_its_capability_stated(tmp_path, limits):
    rng = np.random.default_rng(11)
    count, off = 120, 4e-3
    y = 1e-3 * rng.standard_normal((count, SIZE))
    lot = np.array(["A", "B", "C"])[np.arange(count) % 3]
    y[lot == "B", 6] += off
    noise = np.broadcast_to(1e-10 * np.eye(SIZE), (count, SIZE, SIZE))
    write(tmp_path / "t.parquet", values_of(y), noise, excess=[np.zeros(3)] * count, poses=[30] * count,
          turns=[29] * count, lot=lot.tolist(), station=["S"] * count,
          accel_gain_sigma=[np.sqrt(np.diagonal(padded(noise[0])))[:9]] * count)  # fmt: skip
    held = limits('[limits]\n"accelerometer.bias" = "0.01 m/s^2"\n"accelerometer.scale" = "10 %"\n')
    line = follow(read_table(tmp_path / "t.parquet"), held)
    (alarm,) = [each for each in line.alarms if each.kind == "lot"]
    assert (
        alarm.where == "B" and alarm.name == "accelerometer.bias[0]" and "lot B has accelerometer bias x" in alarm.text
    )
    assert not [each for each in line.alarms if each.kind == "station"]
    (bias,) = [each for each in line.followed if each.name == "accelerometer.bias[0]"]
    assert set(bias.lots) == {"A", "B", "C"}
    # by hand: (limit − mean) / 3 s of the lot's own units
    place = line.measured.names.index("accelerometer.bias[0]")
    own = line.measured.value[lot == "B", place]
    assert bias.lots["B"].cpk[0] == pytest.approx((0.01 - own.mean()) / (3 * own.std(ddof=1)), rel=1e-9)
    assert bias.lots["B"].cpk[0] < bias.lots["A"].cpk[0]
    json.dumps(line.document(), allow_nan=False)
    given_ = ["accept", str(tmp_path / "t.parquet"), "--limits", str(tmp_path / "limits.toml")]
    main([*given_, "-o", str(tmp_path / "out"), "--measurements", str(tmp_path / "m.csv")])
    assert "Lot B has accelerometer bias x" in (tmp_path / "out" / "report.html").read_text()
    rows = pc.read_csv(tmp_path / "m.csv").to_pylist()
    assert len(rows) == count * 6
    assert sum(row["verdict"] == "pass" for row in rows) == np.sum(line.judged.verdict == "pass")


def test_measurements_as_test_systems_take_them(folder, calibration, limits, tmp_path):
    path, wanted = str(folder / "calibration.json"), accept(calibration, limits(LIMITS))
    text = LIMITS.replace("100 mg", "0.001 mg") + '"gyroscope.N" = "1 deg/s/sqrt(Hz)"\n'
    (folder / "limits.toml").write_text(text)
    for name in ("m.csv", "m.xml", "m.json"):
        given_ = ["accept", path, "--limits", str(folder / "limits.toml"), "--measurements", str(tmp_path / name)]
        assert main([*given_, "--fail-on", "never"]) == 0
    rows = {row["name"]: row for row in pc.read_csv(tmp_path / "m.csv").to_pylist()}
    suite = ElementTree.parse(tmp_path / "m.xml").getroot()[0]
    cases = {case.get("name"): case for case in suite}
    record = json.loads((tmp_path / "m.json").read_text())
    found = record["phases"][0]["measurements"]
    assert set(rows) == set(cases) == set(found) and record["dut_id"] == suite.get("name") == "A-1"
    known = {item.name: item for item in wanted.items}
    for axis in range(3):
        scale, bias, noise = f"accelerometer.scale[{axis}]", f"accelerometer.bias[{axis}]", f"gyroscope.N[{axis}]"
        assert rows[scale]["value"] == found[scale]["measured_value"] == pytest.approx(known[scale].value)
        assert rows[scale]["uncertainty"] == pytest.approx(2 * known[scale].sigma)
        assert (found[scale]["outcome"], found[scale]["validators"]) == ("PASS", ["-0.05 <= x <= 0.05"])
        assert (rows[bias]["verdict"], found[bias]["outcome"], found[bias]["marginal"]) == ("fail", "FAIL", False)
        assert cases[bias].find("failure") is not None and cases[scale].find("failure") is None
        assert cases[noise].find("error") is not None and "recording at rest" in cases[noise][0].get("message")
        assert found[noise]["outcome"] == "UNSET" and rows[noise]["value"] is None
    count = {kind: sum(row["verdict"] == kind for row in rows.values()) for kind in ("fail", "undecided")}
    assert (suite.get("failures"), suite.get("errors")) == (str(count["fail"]), str(count["undecided"]))
    assert record["outcome"] == "FAIL" and record["start_time_millis"] == 1772582400000  # 2026-03-04
    assert main(["accept", path, "--limits", str(folder / "limits.toml"), "--measurements", "m.docx"]) == 2


def test_a_table_of_something_else_is_refused(tmp_path):
    (tmp_path / "t.parquet").write_bytes(b"no table")
    with pytest.raises(InputError, match="is not a fleet's table"):
        read_table(tmp_path / "t.parquet")
    write(tmp_path / "failed.parquet", np.zeros((2, SIZE)), np.zeros((2, SIZE, SIZE)), status=["failed"] * 2)
    with pytest.raises(NotPossibleError, match="no unit"):
        read_table(tmp_path / "failed.parquet")


# --- traces, hashes, certificates, the command ------------------------------------------------------------------------


def test_trace_is_checked(tmp_path):
    path = tmp_path / "trace.toml"
    path.write_text(TRACE)
    found = read_trace(path, {"serial": "B-2", "lot": None})
    assert found["serial"] == "B-2"
    assert not missing(found)
    assert missing({}) == list(NEEDED)
    for old, new, said in (
        ('expires = "2026-03-04"', 'expires = "2026-03-03"', "expired on 2026-03-03"),
        ('certificate = "G-1"', "", "certificate is missing"), ('date = "2026-03-04"', 'date = "soon"', "date"),
        ('model = "model"', 'modle = "model"', "unknown key 'modle'; did you mean 'model'"),
        ('date = "2026-03-04"', "", "state the date"),
        ('certificate = "G-1"', 'certificate = "G-1"\nfile = "none.pdf"', "cannot be read"),
    ):  # fmt: skip
        path.write_text(TRACE.replace(old, new))
        with pytest.raises(InputError, match=said):
            read_trace(path)


@pytest.fixture
def folder(calibration, tmp_path):
    """A calibration with its trace, and limits, on the disk; the recording is not."""
    (tmp_path / "limits.toml").write_text(LIMITS)
    (tmp_path / "trace.toml").write_text(TRACE)
    (tmp_path / "log.csv").write_text("a recording")
    data = calibration.data | {"files": [{"file": "log.csv", "rows": 1, "sha256":
                               "d2b9ce2d5e2b1b6d2fb9a27ab10f5f0c4f4bf2a3a4a2b8b4f6f5b7d9c8e7f6a5"}]}  # fmt: skip
    replace(calibration, trace=read_trace(tmp_path / "trace.toml"), data=data).save(tmp_path / "calibration.json")
    return tmp_path


def test_verify_follows_the_chain(folder, calibration):
    document = json.loads((folder / "calibration.json").read_text())
    assert document["digest"] == digest(document)
    assert load_calibration(folder / "calibration.json").digest == document["digest"]
    states = [(link.what, link.state) for link in verify(folder / "calibration.json")]
    assert states == [("document", "intact"), ("recording", "changed")]
    (folder / "log.csv").unlink()
    assert verify(folder / "calibration.json")[1].state == "not found"
    document["accelerometer"]["bias"][0] += 1e-9
    (folder / "calibration.json").write_text(json.dumps(document))
    assert verify(folder / "calibration.json")[0].state == "changed"


def test_the_command_decides_certifies_and_verifies(folder, capsys):
    given_ = ["accept", str(folder / "calibration.json"), "--limits", str(folder / "limits.toml")]
    assert main([*given_, "--json", "-o", str(folder / "out")]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["verdict"] == "pass"
    assert {"name", "value", "uncertainty", "low", "high", "unit", "verdict", "probability"} <= set(
        document["items"][0]
    )
    page = (folder / "out" / "certificate.html").read_text()
    for said in ("C-1", "A-1", "G-1", "k = 2", "degrees of freedom", "Guarded", document["digest"], "somebody"):
        assert said in page
    assert main(["verify", str(folder / "out" / "acceptance.json")]) == 3  # the recording was changed
    (folder / "limits.toml").write_text(LIMITS.replace("100 mg", "0.001 mg"))
    capsys.readouterr()
    assert main([*given_, "--json"]) == 3
    assert json.loads(capsys.readouterr().out)["verdict"] == "fail"
    assert main([*given_, "--fail-on", "never", "-o", str(folder / "out")]) == 0
    page = (folder / "out" / "certificate.html").read_text()
    first = page.partition("<h2")[0]
    assert '<p class="number caution"><b>Fail</b>' in first and "Fails: accelerometer bias x is" in first
    assert "limits ±0.001 mg" in first and "mm/s²" not in page  # the unit of the file of limits
    (folder / "limits.toml").write_text(LIMITS + '"gyroscope.N" = "1 deg/s/sqrt(Hz)"\n')
    assert main(given_) == 4
    assert main([*given_, "--fail-on", "fail"]) == 0


def test_the_command_refuses(folder, capsys):
    path = str(folder / "calibration.json")
    limits = ["--limits", str(folder / "limits.toml")]
    assert main(["accept", path]) == 2
    assert "--limits" in capsys.readouterr().err
    assert main(["accept", path, path, *limits]) == 2
    assert "same serial number, A-1" in capsys.readouterr().err
    document = json.loads((folder / "calibration.json").read_text())
    (folder / "calibration.json").write_text(json.dumps(document | {"trace": None}))
    assert main(["accept", path, *limits]) == 2
    assert "was changed after it was written" in capsys.readouterr().err
    del document["trace"]["certificate"]["customer"], document["trace"]["operator"], document["digest"]
    (folder / "calibration.json").write_text(json.dumps(document))
    assert main(["accept", path, *limits, "-o", str(folder / "out"), "--without-certificate"]) == 0
    assert "no certificate" not in capsys.readouterr().out


def test_without_what_a_certificate_needs_there_is_a_verdict(folder, calibration, capsys):
    """Exit status, table and JSON are those of the verdict; both say what the certificate lacks."""
    document = json.loads((folder / "calibration.json").read_text())
    del document["trace"]["certificate"]["customer"], document["trace"]["operator"], document["digest"]
    (folder / "calibration.json").write_text(json.dumps(document))
    given_ = ["accept", str(folder / "calibration.json"), "--limits", str(folder / "limits.toml")]
    said = "no certificate without operator, certificate.customer"
    assert main([*given_, "-o", str(folder / "out")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "Pass 12 pass, 0 fail, 0 undecided of 12 items" in printed and f"- N{said[1:]}" in printed
    assert [path.name for path in (folder / "out").iterdir()] == ["acceptance.json"]
    written = json.loads((folder / "out" / "acceptance.json").read_text())
    assert written["verdict"] == "pass" and any(note.startswith(said) for note in written["notes"])
    (folder / "limits.toml").write_text(LIMITS.replace("100 mg", "0.001 mg"))
    assert main([*given_, "-o", str(folder / "out"), "--json"]) == 3
    assert json.loads(capsys.readouterr().out)["verdict"] == "fail"
    replace(calibration, trace=read_trace(folder / "trace.toml") | {"serial": "A-2"}).save(folder / "whole.json")
    several = ["accept", str(folder / "calibration.json"), str(folder / "whole.json"), *given_[2:]]
    assert main([*several, "-o", str(folder / "two"), "--fail-on", "never"]) == 0
    assert {path.name for path in (folder / "two").iterdir()} == {
        "A-1-acceptance.json", "A-2-acceptance.json", "A-2-certificate.html"}  # fmt: skip


def test_the_page_of_a_line(tmp_path):
    line = units_at_the_limit(tmp_path / "table.parquet", 0.05, 200)
    assert line.verdict == "fail"
    given_ = ["accept", str(tmp_path / "table.parquet"), "--limits", str(tmp_path / "table.toml")]
    assert main([*given_, "-o", str(tmp_path / "out")]) == 3
    page = (tmp_path / "out" / "report.html").read_text()
    assert "What does not pass" in page and "Capability" in page and "accelerometer bias x" in page
    (worst,) = [quantity for quantity in line.followed if quantity.capability is not None]
    text = str(line.summary())
    number = f"{worst.capability.cpk[0]:.2f}".replace("-", "−")
    assert f"\n{number}" in text and "Cpk of accelerometer bias x, the worst quantity" in text
    assert "The line is not capable: accelerometer bias x has a mean, 0.0" in text
    assert pq.read_table(tmp_path / "out" / "table.parquet")["acceptance"].to_pylist() == line.verdicts.tolist()


def test_verdicts_need_double_precision(calibration, limits):
    held = limits()
    with jax.enable_x64(False), pytest.raises(InputError, match="double precision"):
        accept(calibration, held)
