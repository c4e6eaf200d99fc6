"""What moved between calibrations of a unit: drawn calibrations whose truth is known, numbers alone, and whole runs."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy import stats

import jaximu
import jaximu.report
from jaximu.acceptance.epochs import in_own_axes
from jaximu.acceptance.limits import read_limits
from jaximu.acceptance.trend import StraightLine, sameness
from jaximu.calibration import Calibration
from jaximu.cli.app import main
from jaximu.estimation.problem import Name, flatten, names_of, unflatten, without_equipment
from jaximu.ground.gravity import LocalGravity
from jaximu.model.conventions import lower_triangular_frame
from jaximu.model.sensor import Imu, Triad
from jaximu.simulation import consumer_noise, simulate
from jaximu.simulation.protocols import HandHeld, Positions

GRAVITY = LocalGravity(9.81, 0.015)


def unit(bias=0.0):
    """A unit whose accelerometer's gain is lower triangular."""
    accelerometer = np.array([[1.01, 0, 0], [0.004, 0.99, 0], [-0.003, 0.002, 1.002]])
    gyroscope = np.array([[0.99, 0.003, 0.001], [0.002, 1.02, -0.004], [0.001, 0.002, 1.005]])
    return Imu(
        Triad(accelerometer, np.array([0.05, -0.02, 0.1]) + bias),
        Triad(gyroscope, np.array([0.01, 0.02, -0.01]), quantity="angular_rate", output_unit="rad/s"),
    )


def calibration(imu, random=None, size=1.0, gravity=GRAVITY, free=without_equipment, shared=0.0, **more):
    """A calibration of the unit with errors drawn from its covariance; `shared`: gravity's error, of one sigma."""
    names = [name for name in names_of(imu) if free(name)]
    places = [names_of(imu).index(name) for name in names]
    flat = np.array(flatten(imu))
    root = np.random.default_rng(1).normal(size=(len(names), len(names))) / 5 + np.eye(len(names))
    root = size * np.where([name.part == "bias" for name in names], 1e-3, 1e-4)[:, None] * root
    by_gravity = np.where([name.startswith("accelerometer.gain") for name in names], flat[places], 0.0)
    by_gravity *= gravity.sigma / gravity.value
    if random is not None:
        flat[places] += root @ random.normal(size=len(names))
    flat[places] += shared * by_gravity
    whole = root @ root.T + np.outer(by_gravity, by_gravity)
    about = {"method": "joint", "loss": "linear", "rms": {}, "rank": len(names), "weak": (), "excess": {}}
    about |= {"solver": "", "data": {"poses": 20, "turns": 19}} | more
    return Calibration(jax.tree.map(np.asarray, unflatten(imu, flat)), tuple(names), whole, gravity, **about)


def within(count, total, share, p=1e-3):
    return stats.binomtest(count, total, share).pvalue > p


# --- numbers alone ----------------------------------------------------------------------------------------------------


def test_the_joint_p_value_is_uniform_and_shared_errors_drop_out():
    random = np.random.default_rng(3)
    root = random.normal(size=(5, 5))
    shared = np.tile([100.0, 0, 0, 50.0, 0], 3)
    whole = np.kron(np.diag([1.0, 4.0, 0.25]), root @ root.T) + np.outer(shared, shared)
    draw = np.linalg.cholesky(whole)
    p_values = [sameness((draw @ random.normal(size=15)).reshape(3, 5), whole).p_value for _ in range(400)]
    assert sameness(np.zeros((3, 5)), whole).freedom == 10
    assert stats.kstest(p_values, "uniform").pvalue > 1e-3
    assert within(sum(p < 0.05 for p in p_values), 400, 0.05)


def test_two_values_are_compared_as_a_difference_is():
    covariance = np.array([[4.0, 1.0], [1.0, 9.0]])
    assert sameness(np.array([[1.0], [7.0]]), covariance).statistic == pytest.approx(36 / (4 + 9 - 2))


@pytest.mark.parametrize("scatter", [0.0, 5.0])
@pytest.mark.parametrize("times", [(0.0, 1.0, 2.1, 3.0, 4.2), (0.0, 0.3, 5.0, 5.1, 6.0, 9.0)])
def test_the_drift_lies_in_its_interval_as_often_as_it_says(times, scatter):
    random, times = np.random.default_rng(4), np.array(times)
    sigma = random.uniform(0.5, 2.0, len(times))
    hits = 0
    for _ in range(400):
        values = 3.0 + 0.7 * times + np.hypot(sigma, scatter) * random.normal(size=len(times))
        line = StraightLine.through(times - times[-1], values, np.diag(sigma**2))
        hits += abs(line.slope - 0.7) < line.half
    assert hits / 400 > 0.95 or within(hits, 400, 0.95)
    assert scatter or hits < 400


def test_a_line_is_that_of_weighted_least_squares():
    times, values, sigma = np.array([-3.0, -2.0, 0.0]), np.array([1.0, 2.0, 2.5]), np.array([1.0, 2.0, 0.5])
    line = StraightLine.through(times, values, np.diag(sigma**2))
    (slope, level), covariance = np.polyfit(times, values, 1, w=1 / sigma, cov="unscaled")
    assert (line.slope, line.level) == pytest.approx((slope, level))
    assert line.sigma == pytest.approx(np.sqrt(covariance[0, 0]))
    assert line.statistic == pytest.approx(np.sum(((values - level - slope * times) / sigma) ** 2))


@pytest.mark.parametrize("multiple", [0.0, 1.645, 6.3])
@pytest.mark.parametrize("values", [(0.0, 1.0, 2.0), (2.0, 1.0, 0.1), (0.0, 0.1, 0.0)])
def test_the_guard_band_is_reached_when_it_says(values, multiple):
    line = StraightLine.through(np.array([-2.0, -1.0, 0.0]), np.array(values), np.diag([0.01, 0.02, 0.01]))
    after = line.until(-7.0, 5.0, multiple)
    ahead = np.linspace(0, 1000, 200001)
    sigma = np.sqrt(line.covariance[0, 0] + 2 * line.covariance[0, 1] * ahead + line.covariance[1, 1] * ahead**2)
    value = line.level + line.slope * ahead
    beyond = (value + multiple * sigma > 5.0) | (value - multiple * sigma < -7.0)
    assert (after is None) == (not beyond.any())
    if after is not None:
        assert after == pytest.approx(ahead[np.argmax(beyond)], abs=0.006)
    assert line.until(-7.0, line.level - 0.01, multiple) == 0.0


# --- calibrations -----------------------------------------------------------------------------------------------------


def test_calibrations_of_one_unit_are_the_same_as_often_as_the_level_says():
    random, p_values, moved = np.random.default_rng(5), [], 0
    for _ in range(100):
        shared = random.normal()
        history = jaximu.compare(
            calibration(unit(), random, 3.0, shared=shared), calibration(unit(), random, shared=shared)
        )
        p_values.append(history.together["all"].p_value)
        moved += history.verdict == "moved"
    assert stats.kstest(p_values, "uniform").pvalue > 1e-3
    assert history.together["all"].freedom == 18  # 6 + 3 + 9: the gyroscope's bias is another after every power-on
    assert within(moved, 100, 0.05) or moved < 3


def test_what_moved_is_named_and_gravity_that_both_share_hides_nothing():
    other = unit()
    scaled = np.diag([1.0, 1.0007, 1.0]) @ other.accelerometer.gain  # half of gravity's uncertainty
    other = replace(other, accelerometer=replace(other.accelerometer, gain=scaled))
    history = jaximu.compare(calibration(unit()), calibration(other))
    assert [movement.name for movement in history.moved] == ["accelerometer.scale[1]"]
    assert history.verdict == "moved"
    assert history.moved[0].difference == pytest.approx(0.99 * 0.0007)
    assert history.output["accelerometer"].worst == pytest.approx(0.0007 * 9.80665, rel=0.02)
    elsewhere = jaximu.compare(calibration(unit()), calibration(other, gravity=LocalGravity(9.80, 0.015)))
    assert not elsewhere.moved


def test_the_output_moves_by_the_bias_that_moved():
    history = jaximu.compare(calibration(unit()), calibration(unit(bias=np.array([0.0, 0.2, 0.0]))))
    change = history.output["accelerometer"]
    assert change.worst == pytest.approx(0.2 / 0.99, rel=0.01)
    assert change.rms == pytest.approx(0.2 / 0.99, rel=0.01)
    assert 0 < change.expected < 0.01 and 0 < change.sigma < 0.01
    assert history.output["gyroscope"].worst < 1e-9


def test_axes_of_a_fixture_are_turned_to_the_units_own():
    """A unit on a table, in which it sits turned: gains are full; the same unit by hand is the same unit."""
    angle = 0.02
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    here = unit()
    there = replace(
        here,
        accelerometer=replace(here.accelerometer, gain=here.accelerometer.gain @ turn),
        gyroscope=replace(here.gyroscope, gain=here.gyroscope.gain @ turn),
    )
    table = calibration(there, free=lambda name: name.part in ("gain", "bias"), method="turntable")
    own, turned = in_own_axes(table)
    assert turned and len(own.names) == len(table.names) - 3
    np.testing.assert_allclose(own.imu.gyroscope.gain, here.gyroscope.gain, atol=1e-12)
    # its covariance is that of draws that are turned one by one
    random, size = np.random.default_rng(6), len(table.names)
    places = [names_of(there).index(name) for name in table.names]
    flats = np.tile(flatten(there), (2000, 1))
    flats[:, places] += random.normal(size=(2000, size)) @ np.linalg.cholesky(table.covariance).T
    units = [unflatten(there, flat) for flat in flats]
    gains = [np.stack([getattr(drawn, name).gain for drawn in units]) for name in ("accelerometer", "gyroscope")]
    draws = lower_triangular_frame(*gains)
    for owner, values in zip(("accelerometer", "gyroscope"), draws[:2], strict=True):
        ratio = np.std(values, axis=0)[own.sigma(owner)[0] > 0] / own.sigma(owner)[0][own.sigma(owner)[0] > 0]
        assert np.all(np.abs(ratio - 1) < 5 / np.sqrt(2 * 2000))
    history = jaximu.compare(calibration(here), table)
    assert history.verdict == "same" and history.together["all"].statistic < 1e-6
    assert any("accelerometer's own" in note for note in history.notes)


def test_a_history_has_a_drift_and_a_calibration_interval(tmp_path):
    path = tmp_path / "limits.toml"
    path.write_text('[limits]\n"accelerometer.bias" = "0.2 m/s^2"\n"gyroscope.N" = { high = "1 deg/s/sqrt(Hz)" }\n')
    days = ["2023-01-01", "2024-01-01", "2025-01-01", "2026-01-01"]
    random = np.random.default_rng(7)
    bias = np.array([0.02, 0.0, 0.0])
    histories = [calibration(unit(bias=k * bias), random, trace={"date": day}) for k, day in enumerate(days)]
    shuffled = [histories[k] for k in (2, 0, 3, 1)]
    history = jaximu.compare(*shuffled, limits=read_limits(path), files=["c", "a", "d", "b"])
    assert history.files == ("a", "b", "c", "d") and history.per == "year"
    movement = next(movement for movement in history.movements if movement.name == "accelerometer.bias[0]")
    assert movement.moved and abs(movement.line.slope - 0.02 / 1.01) < movement.line.half < 0.003
    reached = {limit.name: limit.after for limit in history.limits}
    now = (0.05 + 3 * 0.02) / 1.01
    assert reached["accelerometer.bias[0]"] == pytest.approx((0.2 - now) / 0.0198, rel=0.1)
    assert history.interval == min(after for after in reached.values() if after is not None)
    assert any("gyroscope.N" in text for text in history.left_out)
    document = history.document()
    assert document["limits"]["calibration_interval"] == history.interval
    json.dumps(document, allow_nan=False)
    assert jaximu.compare(*histories, dates=days[::-1]).files[0] == "calibration 4"


def test_names_are_those_of_limits():
    history = jaximu.compare(calibration(unit()), calibration(unit(bias=1e-4)))
    assert Name("accelerometer", "bias", (0,)) in {movement.name for movement in history.movements}
    assert history.per == "step" and "no date is known" in history.notes[0]


# --- what cannot be compared ------------------------------------------------------------------------------------------


def files_of(*names):
    return {"files": [{"file": name, "sha256": name, "rows": 1} for name in names]}


def test_what_is_no_comparison_is_a_sentence():
    one = calibration(unit(), data=files_of("a.csv", "b.csv"))
    other = calibration(unit(bias=1e-4), data=files_of("b.csv"))
    with pytest.raises(jaximu.NotPossibleError, match=r"rest on the same recording, b\.csv"):
        jaximu.compare(one, other)
    with pytest.raises(jaximu.InputError, match="two calibrations"):
        jaximu.compare(one)
    with pytest.raises(jaximu.InputError, match="given twice"):
        jaximu.compare(calibration(unit()), calibration(unit()))
    with pytest.raises(jaximu.InputError, match="expected a calibration"):
        jaximu.compare(one, "other")
    third = calibration(unit(bias=2e-4))
    with pytest.raises(jaximu.InputError, match="3 dates for 2"):
        jaximu.compare(one, third, dates=["2024-01-01"] * 3)
    with pytest.raises(jaximu.InputError, match="2026-03-04"):
        jaximu.compare(one, third, dates=["2024-01-01", "yesterday"])
    assert jaximu.compare(one, third, dates=["2024-01-01"] * 2).per == "step"


def only(owner, imu):
    """A calibration of one triad alone."""
    whole = calibration(imu)
    alone = whole.of_numbers(lambda name: name.owner == owner)
    if owner == "gyroscope":
        return replace(alone, absent=("accelerometer",))
    return replace(alone, imu=replace(imu, gyroscope=None))


def test_what_both_have_is_compared_and_the_rest_named():
    whole = calibration(unit(bias=1e-4))
    history = jaximu.compare(only("accelerometer", unit()), whole)
    assert set(history.output) == {"accelerometer"} and len(history.movements) == 9
    assert any("not compared: gyroscope, because" in text for text in history.left_out)
    gyroscope = jaximu.compare(only("gyroscope", unit()), whole)
    assert {movement.name.partition("[")[0] for movement in gyroscope.movements} == {"gyroscope.bias"}
    assert any("axes are the accelerometer's" in text for text in gyroscope.left_out)
    assert "gyroscope" not in gyroscope.output
    with pytest.raises(jaximu.NotPossibleError, match="nothing in common"):
        jaximu.compare(only("gyroscope", unit()), only("accelerometer", unit()))


def test_other_units_of_output_are_not_compared():
    imu = unit()
    scaled = Triad(100 * imu.accelerometer.gain, imu.accelerometer.bias, output_unit="count")
    history = jaximu.compare(calibration(imu), calibration(replace(imu, accelerometer=scaled)))
    assert any("m/s^2, calibration 2 in count" in text for text in history.left_out)
    assert all(movement.name.startswith("gyroscope") for movement in history.movements)


def thermal(slope, reference, bias, random=None):
    """A calibration whose accelerometer's bias is `bias` at 20 °C and changes by `slope` (m/s²)/K."""
    accelerometer = replace(
        unit().accelerometer,
        bias=np.full(3, bias + slope * (reference - 20.0)),
        effects=(jaximu.CATALOGUE["accel.temperature"].make(np.full(3, slope)),),
        temperature_reference=reference,
    )

    def free(name):
        return without_equipment(name) or name.effect is not None

    return calibration(replace(unit(), accelerometer=accelerometer), random, 0.2, free=free)


def test_over_temperature_biases_are_compared_at_one():
    """Of one unit, from two temperatures on; against a constant one at 30 °C, which has 10 K more of its slope."""
    history = jaximu.compare(thermal(2e-3, 15.0, 0.01), thermal(2e-3, 35.0, 0.01))
    assert history.verdict == "same" and history.together["accelerometer bias"].statistic < 1e-9
    assert any("not compared: accel.temperature, because" in text for text in history.left_out)
    constant = calibration(unit(), data={"temperature": 30.0})
    imu = replace(constant.imu, accelerometer=replace(constant.imu.accelerometer, bias=np.full(3, 0.03)))
    history = jaximu.compare(thermal(2e-3, 20.0, 0.01), replace(constant, imu=imu))
    assert history.together["accelerometer bias"].statistic < 1e-9
    assert history.output["accelerometer"].worst < 1e-9
    with pytest.raises(jaximu.NotPossibleError, match="holds at one temperature"):
        jaximu.compare(thermal(2e-3, 20.0, 0.01), calibration(unit()))


def test_a_bias_at_another_temperature_has_the_uncertainty_of_both():
    random = np.random.default_rng(8)
    p_values = [
        jaximu.compare(thermal(2e-3, 15.0, 0.01, random), thermal(2e-3, 25.0, 0.01, random))
        .together["accelerometer bias"]
        .p_value
        for _ in range(60)
    ]
    assert stats.kstest(p_values, "uniform").pvalue > 1e-3


def test_effects_are_compared_where_axes_are_alike():
    history = jaximu.compare(thermal(2e-3, 20.0, 0.01), thermal(9e-3, 20.0, 0.01))
    assert history.together["effects"].freedom == 3
    assert {movement.name for movement in history.moved} == {f"accel.temperature[{axis}]" for axis in range(3)}
    assert (
        history.movements[-1].unit == "rad/s"
        or "K" in {c.name: c.unit for c in history.movements}["accel.temperature[0]"]
    )
    history = jaximu.compare(thermal(2e-3, 20.0, 0.01), calibration(unit(), data={"temperature": 20.0}))
    assert any("not all calibrations have accel.temperature" in note for note in history.notes)


def test_the_document_and_the_page_say_the_same(tmp_path):
    histories = [calibration(unit(bias=k * 0.02), trace={"date": f"202{k}-03-04"}) for k in range(4)]
    warm = [replace(one, data={"temperature": 20.0 + k}) for k, one in enumerate(histories)]
    history = jaximu.compare(*warm)
    written = jaximu.report.write_report(history, tmp_path)
    text = str(history.summary())
    assert "3 of 18 numbers moved" in text and "accelerometer bias x" in text
    assert "could not be drawn" not in written.read_text(encoding="utf-8")
    assert {path.name for path in tmp_path.iterdir()} == {
        "report.html",
        "history.png",
        "changes.png",
        "temperature.png",
    }
    document = history.document()
    assert document["schema"] == "jaximu.compare/1" and document["verdict"] == "moved"
    assert document["calibrations"][0] == {
        "file": "calibration 1", "time": pytest.approx(-3.0, abs=0.01), "date": "2020-03-04", "temperature": 20.0
    }  # fmt: skip


def test_what_came_back_is_said_to_have_been_away():
    there_and_back = jaximu.compare(calibration(unit()), calibration(unit(0.1)), calibration(unit(1e-4)))
    assert "accelerometer bias x in between and back (p " in str(there_and_back.summary())


# --- from logs to the answer ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def logged(tmp_path_factory):
    """Calibrations of simulated logs: of one unit twice, and once after 0.1 m/s² more bias along y."""
    folder = tmp_path_factory.mktemp("history")
    moved = unit(bias=np.array([0.0, 0.1, 0.0]))
    for number, imu in enumerate([unit(), unit(), moved]):
        recording, _ = simulate(imu, HandHeld(20, 3.0, 1.5), consumer_noise(), rate=50.0, seed=70 + number)
        jaximu.write_recording(recording, folder / f"{number}.parquet")
        line = ["calibrate", str(folder / f"{number}.parquet"), "--gravity", "9.80665+-0.0005", "--date"]
        assert main([*line, f"202{number}-03-04", "-o", str(folder / str(number))]) == 0
    return [str(folder / str(number) / "calibration.json") for number in range(3)]


def test_the_command_compares(logged, tmp_path, capsys):
    capsys.readouterr()
    assert main(["compare", *logged[:2], "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["verdict"] == "same" and document["time_unit"] == "year"
    (tmp_path / "limits.toml").write_text('[limits]\n"accelerometer.bias" = "4 m/s^2"\n')
    line = ["compare", *logged[::-1], "--limits", str(tmp_path / "limits.toml"), "-o", str(tmp_path / "out")]
    assert main(line) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "1 of 18 numbers moved: accelerometer bias y by +1" in printed and "Calibrate again" in printed
    kept = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert kept["moved"] == ["accelerometer.bias[1]"]
    assert [entry["file"] for entry in kept["calibrations"]] == logged
    assert kept["output"]["accelerometer"]["worst"] == pytest.approx(0.1, abs=0.02)
    assert (tmp_path / "out" / "history.png").is_file()
    assert main(["compare", *logged[1:], "--fail-on", "moved"]) == 1


def test_a_unit_on_a_table_and_by_hand_is_one_unit(logged):
    """Turned by 30 mrad in its fixture; the table's calibration has its axes there."""
    angle, by_hand = 0.03, jaximu.load_calibration(logged[0])
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    imu = unit()
    turned = [replace(triad, gain=triad.gain @ turn) for triad in imu.triads().values()]
    on_table = Imu(*turned)
    recording, truth = simulate(on_table, Positions(12), consumer_noise(), rate=50.0, seed=9)
    table = jaximu.turntable(recording, truth.schedule, by_hand.gravity)
    history = jaximu.compare(table, by_hand)
    assert [test.freedom for test in history.together.values()] == [3, 6, 3, 9, 18]
    assert history.together["all"].p_value > 1e-3 and not history.moved and not history.left_out
    assert abs(table.imu.accelerometer.gain[1, 2]) > 0.02


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["{0}"], "two calibrations"),
        (["{0}", "{0}"], "is given twice"),
        (["{0}", "{1}", "--dates", "2020-01-01"], "1 dates for 2"),
        (["{0}", "{1}", "--dates", "2020-01-01,soon"], "2026-03-04"),
        (["{0}", "{1}", "--rate", "fast"], "--rate"),
        (["{0}", "{1}", "--rate", "-1 deg/s"], "above 0"),
        (["{0}", "{1}", "--level", "7"], "the level, 7, must lie between 0 and 1"),
        (["{0}", "nowhere.json"], "nowhere.json"),
        (["{0}", "{1}", "--limits", "{0}"], "limits"),
    ],
)
def test_mistakes_of_the_command_are_sentences(more, words, logged, capsys):
    assert main(["compare", *(text.format(*logged) for text in more)]) == 2
    assert words in " ".join(capsys.readouterr().err.split())


def test_a_measured_unit_over_its_sessions(data_folder, tmp_path):
    """One unit of the board, two sessions: nothing but its biases may move beyond chance."""
    paths = []
    for session in (1, 3):
        recording = jaximu.read_recording(
            data_folder / "mimu4444" / f"unit3_session{session}.parquet",
            options=jaximu.ReadOptions(accel_scale="2048 count/g", gyro_scale="16.4 count/(deg/s)"),
        )
        paths.append(jaximu.calibrate(recording))
    history = jaximu.compare(*paths)
    assert history.together["accelerometer gain"].p_value > 1e-6
    assert all(abs(movement.difference) < 0.05 for movement in history.movements if "bias" not in movement.name)
