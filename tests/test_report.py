"""The report: whole, offline, safe with hostile names, and saying what the calibration holds."""

import base64
import hashlib
import json
import re
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest

from jaximu import InputError, LocalGravity, calibrate, compensate, load_calibration
from jaximu.diagnosis.improvement import Gain, Prediction
from jaximu.estimation.problem import TOLERANCE, Parameters, names_of
from jaximu.estimation.uncertainty import WeakDirection, weak_directions
from jaximu.ground.quantities import number
from jaximu.model.effects import CATALOGUE
from jaximu.model.sensor import Imu
from jaximu.report import write_report
from jaximu.report.diagnosis import gained, with_another
from jaximu.report.evidence import evidence, largest_gap
from jaximu.report.figures import dressed, envelope, logarithmic, new_figure, residual_figure
from jaximu.report.tables import short_name, snippet
from jaximu.report.vector import drawing, named
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld

PNG = b"\x89PNG\r\n\x1a\n"
HOSTILE = "<script>alert(1)</script> & \"x\" 'y' {{ 7 * 7 }} </title> <img src=x onerror=alert(2)> $\\frac$.csv"


class Page(HTMLParser):
    """The tags, addresses and text of a page."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.addresses, self.handlers, self.words, self.scripts = [], [], [], [], []
        self.feed(text)
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [value for name, value in attrs if name in ("src", "href", "action", "data", "srcset")]
        self.handlers += [name for name, _ in attrs if name.startswith("on")]

    def handle_data(self, data):
        (self.scripts if self.tags[-1:] == ["script"] else self.words).append(data)

    def handle_endtag(self, tag):
        if tag == "script":
            self.tags.append("/script")


@pytest.fixture(scope="module")
def recording():
    # few samples, and a gravity whose uncertainty shows
    return simulate(draw_imu(3), HandHeld(20, 2.0, 1.0), consumer_noise(), rate=50.0, seed=3)[0]


@pytest.fixture(scope="module")
def calibration(recording):
    return calibrate(recording, LocalGravity(9.80665, 0.001))


@pytest.fixture(scope="module")
def written(calibration, tmp_path_factory):
    path = write_report(calibration, tmp_path_factory.mktemp("report") / "made" / "for it")
    return path, Page(path.read_text(encoding="utf-8"))


def test_report_and_pictures_are_written_whole(written):
    path, page = written
    names = {"report.html", "recording.png", "residuals.png", "correlation.png", "orientations.png", "uncertainty.png"}
    assert {each.name for each in path.parent.iterdir()} == names  # nothing temporary is left
    for name in names - {"report.html"}:
        assert (path.parent / name).read_bytes().startswith(PNG)
    assert path.read_text(encoding="utf-8").rstrip().endswith("</html>")
    assert page.tags.count("svg") == 5


def test_report_works_offline(written):
    path, page = written
    assert not re.search(r"https?://|url\((?!#)|@import", path.read_text(encoding="utf-8"))
    assert not {"img", "link", "iframe", "object", "embed", "base"} & set(page.tags)
    assert all(address.startswith(("data:image/png;base64,", "#")) for address in page.addresses)


def test_the_one_script_is_the_one_that_the_page_allows_and_asks_nobody(written):
    path, page = written
    text = path.read_text(encoding="utf-8")
    (script,) = page.scripts
    allowed = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{allowed}'" in text
    assert not re.search(
        r"fetch|XMLHttp|WebSocket|Beacon|import|eval|Function\(|innerHTML|[sS]torage|cookie|src", script
    )


def test_figures_are_whole_drawings_whose_ids_are_their_own(written):
    text = written[0].read_text(encoding="utf-8")
    found = re.findall(r"<svg.*?</svg>", text, re.DOTALL)
    assert len(found) == 5
    for each in found:
        assert ElementTree.fromstring(each).get("aria-label")
    ids = re.findall(r'\bid="([^"]+)"', text)
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'(?:href="#|url\(#)([^")]+)', text)) <= set(ids)
    for words in ("time (s)", "specific force (m/s²)", "before (m/s²)", "correlation (−1 to 1)", "a.s_x"):
        assert re.search(rf"<text[^>]*>{re.escape(words)}</text>", text), words
    assert len(text) < 800_000


def test_a_page_has_the_values_of_its_points(calibration):
    """What the script does, done here: from where a mark is drawn, by its panel's box and ends, back to its value."""
    found = evidence(calibration)
    drawn = drawing(residual_figure(found), "residuals")
    assert drawing(residual_figure(found), "residuals") == drawn  # equal figures, equal bytes
    tree = ElementTree.fromstring(f"<svg>{drawn.inner}</svg>")
    panels = {json.loads(each.get("data-panel"))["y"]["words"]: each for each in tree.iter() if each.get("data-panel")}
    assert list(panels) == ["before", "after", "angle error"]
    for words, name, x, y, unit in (
        ("after", "", np.arange(1, 21), 1e3 * found.norm_after, "mm/s²"),
        ("angle error", "after", found.turn + 1.5, found.angle_after, "°"),
    ):
        panel = json.loads(panels[words].get("data-panel"))
        assert panel["x"]["words"] == "pose" and panel["y"]["unit"] == unit
        (marks,) = [
            each for each in panels[words].iter() if each.get("data-name") == name and each.find(".//use") is not None
        ]
        left, top, right, bottom = panel["box"]
        across = [(float(use.get("x")) - left) / (right - left) for use in marks.iter("use")]
        up = [(bottom - float(use.get("y"))) / (bottom - top) for use in marks.iter("use")]
        low, high = panel["x"]["ends"]
        np.testing.assert_allclose(low + (high - low) * np.array(across), x, atol=1e-3 * (high - low))
        low, high = panel["y"]["ends"]
        if panel["y"].get("scale") == "log":
            np.testing.assert_allclose(low * (high / low) ** np.array(up), y, rtol=2e-3)
        else:
            np.testing.assert_allclose(low + (high - low) * np.array(up), y, atol=1e-3 * (high - low))


def test_what_has_too_many_points_is_an_image_and_the_words_stay_words():
    figure = new_figure(3.0)
    few, many = figure.subplots(1, 2)
    dots = few.scatter([1, 2, 3], [0.1, 1.0, 10.0])
    named(dots, ["one", "two & <b>", "three"])
    logarithmic(few, "y")
    dressed(few, xlabel="a [m]", ylabel="b")
    many.plot(np.linspace(0, 1, 200_000), np.sin(1e5 * np.linspace(0, 1, 200_000)), ".", label="all")
    many.set_xticks([0, 1, 2], ["cat", "dog", "owl"])
    drawn = drawing(figure, "f")
    tree = ElementTree.fromstring(f"<svg>{drawn.inner}</svg>")
    assert len(drawn.inner) < 200_000 and len(list(tree.iter("image"))) == 1
    assert {"a [m]", "b", "cat", "owl"} <= {each.text for each in tree.iter("text")}
    said = [json.loads(each.get("data-panel")) for each in tree.iter() if each.get("data-panel")]
    assert said[0]["x"]["words"] == "a" and said[0]["x"]["unit"] == "m" and said[0]["y"]["scale"] == "log"
    assert said[1]["x"]["names"] == ["cat", "dog", "owl"]
    (names,) = [each.get("data-names") for each in tree.iter() if each.get("data-names")]
    assert json.loads(names) == ["one", "two & <b>", "three"]


def test_report_leads_with_the_errors_before_and_after(written, calibration):
    _, page = written
    before, after, _ = calibration.rms["gravity_norm"]
    lead = re.search(r"(\d+) poses.* Error against gravity at rest: ([\d.]+) → ([\d.]+) mm/s²", page.text)
    assert lead is not None
    np.testing.assert_allclose([float(lead[2]), float(lead[3])], [1e3 * before, 1e3 * after], rtol=0.05)
    assert int(lead[1]) == calibration.data["poses"]
    assert re.search(r"Direction of gravity lost over a turn: [\d.]+ → [\d.]+°", page.text)


def test_table_gives_95_percent_intervals(written, calibration):
    _, page = written
    gain, sigma = np.asarray(calibration.imu.accelerometer.gain), calibration.sigma("accelerometer")[0]
    found = re.search(r"a\.s_y scale y ([\d.]+) ± ([\d.]+)", page.text)
    assert found is not None
    np.testing.assert_allclose([float(found[1]), float(found[2])], [gain[1, 1], 1.96 * sigma[1, 1]], rtol=0.05)
    assert abs(float(found[1]) - gain[1, 1]) < 0.1 * sigma[1, 1]
    found = re.search(r"g\.m_zx misalignment z from x .*? ([+−][\d.]+) ± ([\d.]+) mrad", page.text)
    assert found is not None
    gain, sigma = np.asarray(calibration.imu.gyroscope.gain), calibration.sigma("gyroscope")[0]
    expected = 1e3 * np.array([gain[2, 0], 1.96 * sigma[2, 0]]) / gain[2, 2]
    np.testing.assert_allclose([float(found[1].replace("−", "-")), float(found[2])], expected, rtol=0.05, atol=0.01)
    assert page.text.count("by convention: fixes the body frame") == 3


def test_hostile_names_and_notes_are_escaped(calibration, tmp_path):
    hostile = replace(
        calibration,
        data={**calibration.data, "files": [{"file": HOSTILE + "\udcff", "sha256": HOSTILE, "rows": HOSTILE}]},
        notes=(HOSTILE,),
        weak=(WeakDirection(0.1, True, (("accelerometer.bias[0]", 1.0),), HOSTILE),),
        excess={**calibration.excess, HOSTILE: 5.0},
        software={"name": HOSTILE, "version": HOSTILE},
        solver=HOSTILE,
        loss=HOSTILE,
    )
    text = write_report(hostile, tmp_path).read_text(encoding="utf-8")
    page = Page(text)
    assert page.tags.count("script") == 1 and "alert" not in page.scripts[0]
    assert page.tags.count("svg") == 5
    assert not page.handlers
    assert text.count("<title>") == text.count("</title>") == 1
    assert "49" not in page.text.partition("Notes")[2]  # {{ 7 * 7 }} is not computed
    assert page.text.count("<script>alert(1)</script>") >= 7  # shown as text


def test_nothing_is_written_where_the_folder_cannot_be(calibration, tmp_path):
    (tmp_path / "a file").write_text("kept")
    with pytest.raises(InputError, match="a file"):
        write_report(calibration, tmp_path / "a file")
    assert (tmp_path / "a file").read_text() == "kept"
    taken = tmp_path / "taken"
    (taken / "report.html").mkdir(parents=True)
    with pytest.raises(InputError, match=r"report\.html"):
        write_report(calibration, taken)
    assert [each.name for each in taken.iterdir()] == ["report.html"]  # no picture, nothing temporary


def test_accelerometer_alone(recording, tmp_path):
    path = write_report(calibrate(replace(recording, gyroscope=None)), tmp_path)
    page = Page(path.read_text(encoding="utf-8"))
    assert "the accelerometer alone was calibrated" in page.text
    assert "Direction of gravity" not in page.text
    assert "K_g" not in page.text
    assert "g.s_x" not in page.text
    assert page.tags.count("svg") == 4


def test_stored_calibration_reports_what_it_still_knows(calibration, tmp_path):
    calibration.save(tmp_path / "calibration.json")
    path = write_report(load_calibration(tmp_path / "calibration.json"), tmp_path)
    page = Page(path.read_text(encoding="utf-8"))
    assert "made from a stored calibration" in page.text
    assert page.tags.count("svg") == 3  # correlation, and what is uncertain
    assert snippet(calibration) in path.read_text(encoding="utf-8")


def test_snippet_does_what_compensate_does(calibration, recording):
    space = {"y_accel": recording.accelerometer.values, "y_gyro": recording.gyroscope.values}
    exec(snippet(calibration), space)
    corrected = compensate(calibration, recording)
    np.testing.assert_allclose(space["f"], corrected.accelerometer.values, rtol=0, atol=1e-12)
    np.testing.assert_allclose(space["w"], corrected.gyroscope.values, rtol=0, atol=1e-12)


def test_scatter_gravity_and_weak_directions_are_said_in_words(calibration, tmp_path):
    weak = WeakDirection(0.1, True, (("gyroscope.gain[1,1]", 1.0),), "gyroscope scale y is only known to ±2 % (95 %).")
    troubled = replace(calibration, excess={**calibration.excess, "turns": 19.25}, weak=(weak,))
    page = Page(write_report(troubled, tmp_path).read_text(encoding="utf-8"))
    assert "turns scatter 4.5 times as much as their measured noise" in page.text
    assert "Before you rely on it" in page.text and "those marked * only weakly" in page.text
    assert "Gyroscope scale y is only known to ±2 % (95 %)." in page.text
    assert "9.80665 ± 0.0020 m/s²" in page.text
    assert "by ±0.020 %" in page.text


@pytest.mark.parametrize(("sharpness", "known"), [(2.0, True), (0.1, False)])
def test_weak_directions_are_said_with_amounts_and_advice(sharpness, known):
    unit = draw_imu(0)
    parameters = Parameters.select(unit, lambda name: name in ("gyroscope.gain[1,1]", "gyroscope.gain[1,2]"))
    # the sum is known well; the difference to 1 / sharpness of 10 % of the scale, one sigma
    jacobian = np.array([[1e4, 1e4], [sharpness, -sharpness]]) / np.sqrt(2)
    rank, (weak,) = weak_directions(jacobian, parameters.names, np.asarray(parameters.size), unit)
    assert (rank, weak.determined) == (2 if known else 1, known)
    share = 1.96 * 0.1 / np.hypot(sharpness, 1 / TOLERANCE) / np.sqrt(2)
    assert f"gyroscope scale y (±{100 * share:.2g} %)" in weak.text
    assert f"gyroscope misalignment y from z (±{number(1e3 * share, 2)} mrad)" in weak.text
    assert "can trade off" in weak.text
    assert ("does not determine" in weak.text) is not known
    assert "What to record: turns of 90° or more about the " in weak.text


def test_errors_by_pose_and_turn_agree_with_the_calibration(calibration):
    found = evidence(calibration)
    assert found is not None
    np.testing.assert_allclose(np.linalg.norm(found.directions, axis=1), 1.0, rtol=1e-12)
    for name, before, after in (
        ("gravity_norm", found.norm_before, found.norm_after),
        ("gravity_direction", found.angle_before, found.angle_after),
    ):
        rms = [np.sqrt(np.mean(each**2)) for each in (before, after)]
        np.testing.assert_allclose(rms, calibration.rms[name][:2], rtol=1e-9)


def test_bands_hold_what_white_noise_leaves(calibration):
    found = evidence(calibration)
    assert found is not None
    # 20 poses and 19 turns of pure white noise, 9 and 12 parameters fitted to them: errors are smaller than the noise
    assert np.mean(np.abs(found.norm_after) < 2 * found.norm_sigma) > 0.9
    assert np.mean(found.angle_after < found.angle_limit) > 0.9
    assert 0.2 < np.sqrt(np.mean((found.norm_after / found.norm_noise) ** 2)) < 1.5
    assert 0.1 < np.median(found.angle_after / found.angle_noise) < 1.0


def test_largest_gap_of_the_six_faces_is_a_corner():
    gap, where = largest_gap(np.vstack([np.eye(3), -np.eye(3)]))
    assert abs(gap - np.degrees(np.arccos(1 / np.sqrt(3)))) < 2.0
    assert np.all(np.abs(np.abs(where) - 1 / np.sqrt(3)) < 0.05)


def test_envelope_of_a_long_log_keeps_its_extremes():
    time = np.arange(1_000_001) / 100.0
    values = np.zeros((len(time), 3))
    values[654_321, 1], values[-1, 2] = 7.0, -3.0
    thin_time, thin = envelope(time, values)
    assert len(thin_time) == len(thin) <= 3000
    assert (np.diff(thin_time) >= 0).all()
    assert thin[:, 1].max() == 7.0
    assert thin[:, 2].min() == -3.0
    assert abs(thin_time[np.argmax(thin[:, 1])] - time[654_321]) < 7.0
    np.testing.assert_array_equal(envelope(time[:100], values[:100])[1], values[:100])


def test_short_names():
    imu = Imu.nominal().with_effects(CATALOGUE["gyro.quadratic"].dormant())
    names = {str(name): short_name(name, imu) for name in names_of(imu)}
    assert names["accelerometer.gain[0,0]"] == "a.s_x" and names["gyroscope.gain[2,0]"] == "g.m_zx"
    assert (
        names["gyroscope.bias[1]"] == "g.b_y" and names["gyroscope.effects[0].coefficients[1]"] == "gyro.quadratic[1]"
    )


def test_importing_the_library_does_not_import_matplotlib():
    code = "import jaximu, jaximu.report, sys; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_pages_fit_a_phone_and_hide_folders(calibration, tmp_path):
    """Cells say which column they are in, folders of the machine are left out, and the style stacks rows."""
    files = [{"file": "/home/me/logs/log.csv", "sha256": "0", "rows": 3}]
    moved = replace(calibration, data={**calibration.data, "files": files}, notes=("kept in /tmp/a/b.csv.",))
    text = write_report(moved, tmp_path).read_text(encoding="utf-8")
    assert "log.csv" in text and "kept in b.csv." in text.replace("Kept", "kept")
    assert not re.search(r"/home|/tmp", re.sub(r"base64,[^\"]*", "", text))
    assert 'data-label="file">log.csv' in text and 'data-label="± 95 %"' in text
    assert "@media (max-width: 40rem)" in text and "prefers-color-scheme: dark" in text and "@media print" in text


def test_what_may_be_zero_is_marked(calibration, tmp_path):
    page = Page(write_report(calibration, tmp_path).read_text(encoding="utf-8"))
    marked = page.text.count("not different from zero")
    small = [
        each for each in calibration.parameters.values() if "scale" not in each.words and not each.different_from_zero
    ]
    assert marked == len(small)
    shifted = replace(calibration, covariance=1e4 * calibration.covariance)
    assert (
        Page(write_report(shifted, tmp_path).read_text(encoding="utf-8")).text.count("not different from zero") > marked
    )


@pytest.mark.parametrize(("rows", "columns"), [(1, 2), (3, 1), (2, 3)])
def test_panels_leave_room_for_their_words(rows, columns):
    """Reckoned from characters: drawn, no panel's words leave the figure or reach into another's."""
    figure = new_figure(2.4 * rows)
    for axes in figure.subplots(rows, columns, squeeze=False).ravel():
        axes.plot([1e-4, 3.0], [-12345.0, 98765.0])
        axes.set(xlabel="time [s]", ylabel="an error\n[mm/s²]", title="a panel")
    figure.suptitle("all of them")
    figure.canvas.draw()
    boxes = [axes.get_tightbbox() for axes in figure.axes]
    for place, box in enumerate(boxes):
        assert box.xmin >= 0 and box.ymin >= 0 and box.xmax <= figure.bbox.xmax and box.ymax <= figure.bbox.ymax
        assert not any(box.overlaps(other) for other in boxes[:place])


@pytest.mark.parametrize(
    ("after", "likelier", "says"),
    [
        (20.0, 9.0, "Modelling it cuts the error on data not fitted (5 parts) from 39.0 to 20.0 mm/s²."),
        (
            39.9,
            9.0,
            "more probable (log-likelihood +9.0), although their error does not fall: from 39.0 to 39.9 mm/s².",
        ),
        (39.9, -9.0, "Modelling it does not reduce the error on data not fitted (5 parts), 39.9 mm/s²."),
    ],
)
def test_a_gain_is_said_in_the_measure_that_is_shown(after, likelier, says):
    """An error that grows is not called the same, however much more probable the data became."""

    def predicted(rms, likelihood):
        return Prediction({"gravity_norm": (1e-3 * rms, "m/s^2")}, 1.0, 10, likelihood)

    gain = Gain(predicted(39.0, 0.0), predicted(after, likelier), "5 parts")
    cause = SimpleNamespace(effect=CATALOGUE["accel.step"].make(0.01))
    assert gained(SimpleNamespace(gain=gain, learned=None, named=[cause])).endswith(says)


@pytest.mark.parametrize(("count", "words"), [(1, "both recordings together"), (4, "all 5 recordings together")])
def test_recordings_are_counted_with_the_new_one(count, words):
    assert with_another(SimpleNamespace(calibration=SimpleNamespace(segmentations=[None] * count))) == words
