"""Objects in Python: what they say of themselves, tables by name, data frames, pictures, and wrong arguments."""

import numpy as np
import pyarrow as pa
import pytest

import jaximu
from jaximu.ground.errors import InputError, command_line, worded
from jaximu.ground.quantities import Z95
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.noise.analysis import analyse_noise
from jaximu.noise.at_rest import fit_noise
from jaximu.recordings import write_recording
from jaximu.report import terminal
from jaximu.report.figures import envelope
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld, Static


@pytest.fixture(scope="module")
def recording():
    return simulate(draw_imu(3), HandHeld(20, 2.0, 1.0), consumer_noise(), rate=50.0, seed=3)[0]


@pytest.fixture(scope="module")
def calibration(recording):
    return jaximu.calibrate(recording, jaximu.LocalGravity(9.80665, 0.001))


def test_parameters_are_a_table_by_name(calibration):
    table = calibration.parameters
    assert list(table) == list(calibration.names) and len(table) == 21
    bias = table["gyroscope bias y"]
    assert bias is table["gyroscope.bias[1]"] and bias.unit == "rad/s"
    assert bias.value == calibration.imu.gyroscope.bias[1] and bias.sigma == calibration.sigma("gyroscope")[1][1]
    assert table["accelerometer misalignment z from x"].value == calibration.imu.accelerometer.gain[2, 0]
    np.testing.assert_array_equal(table.sigma, np.sqrt(np.diagonal(calibration.covariance)))
    with pytest.raises(KeyError, match="near it: gyroscope bias"):
        table["gyroscope bias w"]


def test_the_table_that_is_printed_holds_the_numbers(calibration):
    """Value and uncertainty are in the unit beside them, and parameters of a kind share it."""
    factors = {"mm/s²": 1e3, "m/s²": 1.0, "°/s": np.degrees(1.0), "mrad": 1e3, "": 1.0}
    rows = calibration.parameters.block().rows
    for parameter, (words, value, sigma, unit) in zip(calibration.parameters.values(), rows, strict=True):
        assert words == parameter.words
        printed = float(value.replace("−", "-")) / factors[unit]
        assert abs(printed - parameter.value) <= 0.06 * parameter.sigma
        assert float(sigma) / factors[unit] == pytest.approx(parameter.sigma, rel=0.06)
    assert len({unit for words, *_, unit in rows if "accelerometer bias" in words}) == 1


def test_parameters_with_effects(recording):
    found = jaximu.calibrate(recording, effects=["gyro.g_sensitivity"]).parameters
    effect = [each for each in found.values() if each.words.startswith("gyroscope g-sensitivity (gyro.g_sensitivity[")]
    assert found["gyro.g_sensitivity[0]"] is effect[0]
    assert len(effect) == 9 and {each.unit for each in effect} == {"(rad/s)/(m/s^2)"}
    hidden = sum(each.different_from_zero for each in effect)
    assert hidden <= 3  # none is there: each has a chance of one in twenty
    assert effect[0].different_from_zero == (abs(effect[0].value) > Z95 * effect[0].sigma)


def test_arrow_of_the_parameters(calibration):
    table = calibration.parameters.to_arrow()
    assert table.column_names[:2] == ["name", "words"] and table.num_rows == 21
    assert table["value"].to_pylist() == calibration.parameters.value.tolist()


def whole(calibration) -> str:
    """The page as text, with what only the file holds."""
    page = calibration.summary()
    return "\n".join(map(terminal.text, (page, *page.rest())))


def test_a_summary_says_the_verdict_the_numbers_and_what_is_open(calibration):
    text = str(calibration.summary())
    before, after, _ = calibration.rms["gravity_norm"]
    assert f"Error against gravity at rest: {1e3 * before:.0f} → {1e3 * after:.3f} mm/s²" in text
    assert "All 21 parameters are determined." in text and text.count("scale x ") == 2
    said = " ".join(whole(calibration).split())
    assert "jaximu.wgs84_gravity(latitude, height)" in said and "--" not in said  # Python's words
    with command_line():
        assert "--latitude" in whole(calibration)
    assert max(map(len, text.splitlines())) <= 100


def test_a_summary_names_what_is_not_determined(recording):
    """Turns about the vertical alone, and one pose: the accelerometer's z axis up throughout."""
    few, _ = simulate(draw_imu(1), HandHeld(9, 3.0), consumer_noise(), seed=5)
    found = jaximu.calibrate(few)
    starred = [row[0] for row in found.parameters.block().rows if row[0].endswith("*")]
    weak = {name for each in found.weak for name, _ in each.parameters}
    assert {each.words + " *" for each in found.parameters.values() if each.name in weak} == set(starred)
    for each in found.weak:
        assert worded(each.text)[1:] in " ".join(str(found.summary()).replace("\n ", "").split())


def test_reprs_are_short_and_pages_hold_the_summary(recording, calibration):
    still, _ = simulate(draw_imu(3), Static(1300.0), consumer_noise(), rate=10.0, seed=4)
    noise = fit_noise(still)
    stated = NoiseModel(AxisNoise.of_white(1e-6))
    for each in (recording, calibration, noise, stated, analyse_noise(still), jaximu.diagnose(recording, static=noise),
                 jaximu.check(calibration, recording)):  # fmt: skip
        assert len(repr(each)) < 300 and type(each).__name__ in repr(each)
        page = each._repr_html_()
        assert each.summary().verdict[0][:20] in page.replace("&#x27;", "'")
        assert page.count("<table") == page.count("</table>")
    assert "&lt;b&gt;" in jaximu.Recording(recording.accelerometer, notes=("<b>",))._repr_html_()
    assert "0.00100 m/s²/√Hz" in str(stated.summary()) or "1.00 mm/s²/√Hz" in str(stated.summary())


class Frame:
    """What pandas and polars have in common: the Arrow stream."""

    def __init__(self, table: pa.Table):
        self.table = table

    def __arrow_c_stream__(self, requested_schema=None):
        return self.table.__arrow_c_stream__(requested_schema)


def test_data_frames_there_and_back(recording, tmp_path):
    """The same as through a file, whichever kind of frame it is."""
    write_recording(recording, tmp_path / "log.parquet")
    read = jaximu.read_recording(tmp_path / "log.parquet")
    table = recording.to_arrow()
    columns = {name: table[name].to_numpy() for name in table.column_names}
    for frame in (table, columns, Frame(table)):
        found = jaximu.Recording.from_dataframe(frame)
        np.testing.assert_array_equal(found.accelerometer.values, read.accelerometer.values)
        np.testing.assert_array_equal(found.gyroscope.time, read.gyroscope.time)
    degrees = jaximu.Recording.from_dataframe(
        {"t": columns["time [s]"], **{f"g{axis}": columns[f"gyro_{axis} [rad/s]"] for axis in "xyz"},
         **{f"a{axis}": columns[f"accel_{axis} [m/s^2]"] / 9.80665 for axis in "xyz"}},
        jaximu.ReadOptions(columns="time [s],gyro [rad/s],accel [g]"),
    )  # fmt: skip
    np.testing.assert_allclose(degrees.accelerometer.values, read.accelerometer.values, rtol=1e-12)


def test_data_frames_that_are_none(recording):
    columns = recording.to_arrow().to_pydict()
    for frame, word in ((3, "value of type int"), ({"a": [1.0, 2.0], "b": [1.0]}, "equally long"),
                        ({**columns, "gyro_x [rad/s]": ["oops"] * len(columns["time [s]"])}, "gyro_x.*'oops'"),
                        ({"time [s]": columns["time [s]"]}, "accel_x")):  # fmt: skip
        with pytest.raises(InputError, match=word):
            jaximu.Recording.from_dataframe(frame)


def test_pandas_is_asked_for_in_a_sentence(recording, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pandas", None)
    with pytest.raises(InputError, match="pip install pandas"):
        recording.to_pandas()


def test_pictures_show_what_was_recorded(recording, calibration, tmp_path):
    figure = recording.plot()
    assert [axes.get_ylabel().partition("\n")[0] for axes in figure.axes] == ["accelerometer", "gyroscope"]
    _, expected = envelope(recording.gyroscope.time, recording.gyroscope.values)
    np.testing.assert_array_equal(figure.axes[1].lines[2].get_ydata(), expected[:, 2])
    for made in (calibration.plot_residuals(), calibration.plot_recording(), figure):
        assert made._repr_png_().startswith(b"\x89PNG")
    calibration.save(tmp_path / "calibration.json")
    loaded = jaximu.load_calibration(tmp_path / "calibration.json")
    assert str(loaded.summary()) == str(calibration.summary())
    for picture in (loaded.plot_residuals, loaded.plot_recording):
        with pytest.raises(InputError, match="do not keep"):
            picture()


def test_gravity_as_a_number_or_text(recording, calibration):
    number = jaximu.calibrate(recording, 9.81)
    assert number.gravity == jaximu.LocalGravity(9.81, 0.0)
    assert jaximu.calibrate(recording, "9.80665+-0.001").gravity == calibration.gravity


@pytest.mark.parametrize(
    ("arguments", "options", "words"),
    [
        (("log.csv",), {}, r"the path 'log.csv': read it with jaximu.read_recording\('log.csv'\)"),
        ((np.zeros((9, 3)),), {}, "value of type ndarray"),
        (([1, 2],), {}, "value of type int"),
        ((..., [9.81]), {}, "gravity is a number in m/s²"),
        ((..., 98.1), {}, "not plausible"),
        ((...,), {"static": "rest.csv"}, "read_recording"),
        ((...,), {"method": "jiont"}, "method: 'jiont' is none of 'joint'"),
        ((...,), {"loss": "l1"}, "loss: 'l1' is none of 'linear'"),
        ((...,), {"effects": ["gyro.nonsense"]}, "unknown effect"),
    ],
)
def test_wrong_arguments_are_answered_in_a_sentence(recording, arguments, options, words):
    given = [recording if each is ... else each for each in arguments]
    with pytest.raises(InputError, match=words):
        jaximu.calibrate(*given, **options)


def test_other_wrong_types_are_answered_in_a_sentence(recording, calibration):
    for call, words in (
        (lambda: jaximu.compensate(calibration, 5), "expected a recording, found a value of type int"),
        (lambda: jaximu.compensate("calibration.json", recording), "jaximu.load_calibration"),
        (lambda: jaximu.check("calibration.json", recording), "jaximu.load_calibration"),
        (lambda: jaximu.load_calibration(5), "expected the path of a file, found a value of type int"),
        (lambda: jaximu.read_recording(5), "expected the path of a file"),
    ):
        with pytest.raises(InputError, match=words):
            call()


def test_errors_name_the_arguments_of_who_called():
    error = InputError("x.csv: check --accel-scale and --gyro-log LOG; state --rate HZ, or run `jaximu info --json x`.")
    assert str(error) == (
        "x.csv: check ReadOptions(accel_scale=…) and gyro_log=; state ReadOptions(rate=…), or run "
        "`jaximu info --json x`."
    )
    with command_line():
        assert str(error) == error.args[0]
    line = "name the columns:\n  jaximu info x.csv --columns 'a,b'"
    assert worded(line) == line


def test_types_are_published():
    assert (jaximu.__spec__.submodule_search_locations and __import__("pathlib").Path(jaximu.__file__).with_name(
        "py.typed")).exists()  # fmt: skip
