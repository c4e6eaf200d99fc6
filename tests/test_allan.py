"""`jaximu allan`: terms, JSON and picture of recordings at rest; what is not at rest or not even is refused."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import scipy

from jaximu.cli import allan as command
from jaximu.cli import main
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.ground.quantities import number
from jaximu.model import BiasRepeatability, Noise, RandomWalk, White
from jaximu.noise.analysis import analyse_noise, evenly_sampled
from jaximu.recordings import write_recording
from jaximu.recordings.recording import Recording, Signal, Source
from jaximu.report.allan import kalibr_text, page_of, term_rows, unseen_notes
from jaximu.report.html import encoded
from jaximu.simulation import draw_imu, simulate
from jaximu.simulation.artefacts import Dropped, Gap, Jitter
from jaximu.simulation.protocols import HandHeld, Static

NOISE = {
    "accelerometer": Noise((White(0.019), RandomWalk(5e-3), BiasRepeatability(0.05)), "specific_force"),
    "gyroscope": Noise((White(0.014), RandomWalk(3e-3), BiasRepeatability(0.01)), "angular_rate"),
}
TRUE = {"accelerometer": {"N": 0.019, "K": 5e-3}, "gyroscope": {"N": 0.014, "K": 3e-3}}


CONSTANT = Signal(np.arange(6000) / 100, np.ones((6000, 3)), "rad/s")


def at_rest(duration=400.0, seed=1, **changes) -> Recording:
    return simulate(draw_imu(1), Static(duration), NOISE, rate=100.0, seed=seed, **changes)[0]


def test_the_document_and_the_picture(tmp_path, capsys):
    for power_on in range(3):
        write_recording(at_rest(400.0 if power_on == 0 else 60.0, power_on=power_on), tmp_path / f"{power_on}.parquet")
    logs = [str(tmp_path / f"{power_on}.parquet") for power_on in range(3)]
    assert main(["allan", *logs, "-o", str(tmp_path / "out")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "Continuous, two-sided" in printed and "°/√h" in printed and "Repeatability" in printed
    assert {each.name for each in (tmp_path / "out").iterdir()} == {
        "allan.json",
        "allan.png",
        "imu.yaml",
        "report.html",
    }
    assert (tmp_path / "out" / "allan.png").stat().st_size > 20_000
    assert "For a Kalman filter" in printed and "resolve averages up to" in printed and "m/s²/√Hz" in printed
    document = json.loads((tmp_path / "out" / "allan.json").read_text())
    assert document["schema"] == "jaximu.allan/1"
    inside = 0
    for name, terms in TRUE.items():
        assert len(document[name]) == 3
        for axis in document[name]:
            assert (
                len(axis["taus"]) == len(axis["deviation"]) == len(axis["deviation_low"]) == len(axis["deviation_high"])
            )
            assert set(axis["terms"]) == set("QNBKR")
            for term, true in terms.items():
                found = axis["terms"][term]
                inside += found is not None and found["low"] <= true <= found["high"]
    assert inside >= 9  # of twelve 95 % intervals
    assert document["gyroscope"][0]["terms"]["N"]["unit"] == "rad/s/sqrt(Hz)"
    assert document["accelerometer"][0]["terms"]["N"]["unit"] == "m/s^2/sqrt(Hz)"
    spread = document["repeatability"]["gyroscope"]
    assert spread["unit"] == "rad/s"
    assert (np.array(spread["low"]) < spread["value"]).all() and (np.array(spread["value"]) < spread["high"]).all()
    assert main(["allan", logs[0], "--json"]) == 0
    alone = json.loads(capsys.readouterr().out)
    assert alone["repeatability"] is None and alone["gyroscope"] == document["gyroscope"]
    for name, terms in TRUE.items():
        mean, numbers = document["mean"][name], document["filter"][name]
        assert mean["N"]["axes"] == "xyz" and mean["N"]["low"] < terms["N"] < mean["N"]["high"]
        found = [axis["terms"]["N"]["value"] for axis in document[name]]
        assert mean["N"]["value"] == pytest.approx(np.sqrt(np.mean(np.square(found))))
        assert numbers["rate"] == pytest.approx(100) and len(numbers["axes"]) == 3
        assert numbers["mean"]["measurement_variance"]["value"] == pytest.approx(mean["N"]["value"] ** 2 * 100)
        assert numbers["mean"]["walk_variance"]["value"] == pytest.approx(mean["K"]["value"] ** 2 / 100)
        yaml = (tmp_path / "out" / "imu.yaml").read_text()
        written = re.search(rf"^{name}_noise_density: (\S+)  # (\S+)$", yaml, re.MULTILINE)
        assert float(written[1]) == pytest.approx(mean["N"]["value"], rel=1e-5) and written[2] == mean["N"]["unit"]
    page = Page((tmp_path / "out" / "report.html").read_text(encoding="utf-8"))
    assert all(each in page.text for each in ("0.parquet", "°/√h", "rad/s/√Hz", "At the sample rate: discrete", "imu0"))
    assert "Standard deviation of the bias over 3 recordings" in page.text


class Page(HTMLParser):
    """The tags, addresses and text of a page; no number in it may be one that is none."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.addresses, self.words = [], [], []
        self.feed(text)
        self.text = " ".join(" ".join(self.words).split())
        assert not re.search(r"\b(nan|NaN|inf|None|undefined)\b", self.text)
        assert all(each.startswith(("data:image/png;base64,", "#")) for each in self.addresses)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [value for name, value in attrs if name in ("src", "href", "action", "data", "srcset")]

    def handle_data(self, data):
        if self.tags and self.tags[-1] not in ("style", "script"):
            self.words.append(data)


def html(analysis) -> str:
    return encoded(analysis.summary())[0].decode()


@pytest.fixture(scope="module")
def analysed():
    return analyse_noise(at_rest())


HOSTILE = '<script>alert(1)</script> & "x" {{ 7 * 7 }} </title> <img src=x onerror=alert(2)>\n# $\\frac$.csv'


def test_hostile_names_are_escaped(analysed):
    named = replace(analysed, files=(HOSTILE,), notes=(HOSTILE,))
    text = encoded(page_of(named, [Source(HOSTILE, "0" * 64, 7)]))[0].decode()
    page = Page(text)
    assert page.tags.count("script") == page.tags.count("svg") == 1
    assert "<script>alert" not in text and "{{ 7 * 7 }}" in text
    assert all(line.startswith("#") or re.match(r"[a-z_]+: \S+", line) for line in kalibr_text(named).splitlines())


def test_one_sensor_alone_and_what_is_not_seen_are_said(analysed):
    for name, other in (("gyroscope", "accelerometer"), ("accelerometer", "gyroscope")):
        alone = replace(analysed, axes={name: analysed.axes[name]}, rates={name: 100.0}, files=())
        page, lead = Page(html(alone)), " ".join(alone.summary().verdict)
        assert f"The recording has no {other}" in page.text and name in lead and other not in lead
        document = command.document(alone)
        assert document[other] is None and document["mean"][other] is None and document["filter"][other] is None
        limits = {"Q": 1e-9, "N": 1e-9, "B": 1e-9, "K": 1e-9, "R": 1e-9}
        bare = [replace(axis, terms=dict.fromkeys("QNBKR"), limits=limits) for axis in alone.axes[name]]
        nothing = replace(alone, axes={name: bare})
        assert term_rows(bare, "angular_rate") == [] and "none of N, B and K" in repr(nothing)
        (said,) = unseen_notes(bare, "angular_rate" if name == "gyroscope" else "specific_force")
        assert "rate random walk K (up to" in said and "NOT SEEN" in kalibr_text(nothing)
        assert "supports none of N, B and K" in Page(html(nothing)).text
        json.dumps(command.document(nothing), allow_nan=False)


def test_a_term_on_one_axis_counts_so_in_the_mean(analysed):
    axes = [replace(axis, terms=axis.terms | ({"K": None} if place else {}), limits={"K": 2e-6, **axis.limits})
            for place, axis in enumerate(analysed.axes["gyroscope"])]  # fmt: skip
    page = Page(html(replace(analysed, axes={"gyroscope": axes})))
    assert "K is supported by the data on x alone and counts as zero on the other axes in the mean." in page.text
    row = next(row for row in term_rows(axes, "angular_rate") if row.term == "K")
    assert row.texts()[1] == f"not seen\nup to {number(row.cells[1])}"
    assert row.cells[3][0] == pytest.approx(row.cells[0][0] / np.sqrt(3))


def test_the_printed_table_fits_and_is_whole(tmp_path, capsys):
    write_recording(at_rest(60.0), tmp_path / "log.parquet")
    assert main(["allan", str(tmp_path / "log.parquet")]) == 0
    printed = capsys.readouterr()
    lines = printed.out.splitlines()
    assert max(map(len, lines)) <= 100 and "Nothing was written" in printed.err
    for unit in ("m/s/√h", "m/s²/√Hz", "°/√h", "rad/s/√Hz", "(rad/s)²/Hz"):
        assert unit in printed.out
    row = next(line for line in lines if line.startswith("N white noise"))
    assert all(float(cell) > 0 for cell in row.split()[-4:])  # x, y, z and the mean, none cut off


@pytest.mark.parametrize(
    ("blocked", "left"), [("report.html", {"report.html", "allan.json", "imu.yaml"}), ("allan.json", {"allan.json"})]
)
def test_numbers_are_written_all_or_none_and_before_the_page(tmp_path, capsys, blocked, left):
    write_recording(at_rest(60.0), tmp_path / "log.parquet")
    (tmp_path / "out" / blocked).mkdir(parents=True)
    assert main(["allan", str(tmp_path / "log.parquet"), "-o", str(tmp_path / "out")]) == 2
    assert {each.name for each in (tmp_path / "out").iterdir()} == left
    printed = capsys.readouterr()
    assert "cannot be written" in printed.err and "white noise" in printed.out  # what was computed is shown


def test_lost_samples_are_left_out_and_said():
    whole, holed = analyse_noise(at_rest()), analyse_noise(at_rest(artefacts=[Dropped(0.002), Gap(100.0, 103.0)]))
    assert any("samples of the gyroscope are missing" in note for note in holed.notes)
    for one, two in zip(whole.axes["gyroscope"], holed.axes["gyroscope"], strict=True):
        assert two.terms["N"].value == pytest.approx(one.terms["N"].value, rel=0.05)


def with_magnetometer(field: np.ndarray) -> Recording:
    """A recording at rest, with a magnetometer's 20 Hz of 0.05 µT/√Hz beside, in this field (n, 3), µT."""
    recording = at_rest(120.0)
    noise = 0.05 * np.sqrt(20.0) * np.random.default_rng(3).standard_normal((len(field), 3))
    return replace(recording, magnetometer=Signal(np.arange(len(field)) / 20.0, field + noise, "uT"))


ONE_POLE = 1 - np.exp(-2 * np.pi * 20 / 200)


@pytest.mark.parametrize(
    ("rate", "top", "bottom"),
    [(200.0, [ONE_POLE], [1, ONE_POLE - 1]), (100.0, [0.72], [1, -0.28]), (400.0, *scipy.signal.butter(2, 41 / 200))],
    ids=["20 of 200 Hz", "20 of 100 Hz", "second order"],
)
def test_a_low_pass_hides_no_white_noise_and_shows_no_line(rate, top, bottom):
    """A filter too wide to matter to a hand: the noise is that below it, and rounding above it is no line."""
    random = np.random.default_rng(1)
    noise = 1e-3 * np.sqrt(rate) * random.normal(size=(round(600 * rate), 3))
    values = scipy.signal.lfilter(top, bottom, noise, axis=0)[1000:] + [0.1, 0.2, 9.8]
    signal = Signal(np.arange(len(values)) / rate, np.round(values, 9), "m/s^2")
    analysis = analyse_noise(Recording(accelerometer=signal))
    white = [axis.terms["N"].value for axis in analysis.axes["accelerometer"]]
    assert np.mean(white) == pytest.approx(1e-3, rel=0.04)
    assert any("low-pass filter" in note for note in analysis.notes)
    assert not any("periodic" in note for note in analysis.notes)


def test_a_magnetometer_has_its_noise_too(tmp_path, capsys):
    write_recording(with_magnetometer(np.tile([20.0, 5.0, -40.0], (2400, 1))), tmp_path / "log.parquet")
    assert main(["allan", str(tmp_path / "log.parquet"), "-o", str(tmp_path / "out")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    document = json.loads((tmp_path / "out" / "allan.json").read_text())
    for axis in document["magnetometer"]:
        white = axis["terms"]["N"]
        assert white["value"] == pytest.approx(0.05, rel=0.1) and white["unit"] == "uT/sqrt(Hz)"
    mean = document["filter"]["magnetometer"]["mean"]
    assert mean["measurement_variance"]["value"] == pytest.approx(0.05**2 * 20, rel=0.2)
    assert "integral_variance" not in mean and "nT/√Hz" in printed  # nobody integrates a field
    yaml = (tmp_path / "out" / "imu.yaml").read_text()
    assert "magnetometer_noise" not in yaml and "update_rate: 100.0" in yaml


def test_a_field_that_changes_leaves_out_the_magnetometer_alone():
    door = np.where(np.arange(2400) % 240 < 120, 0.0, 15.0)  # opened and closed
    found = analyse_noise(with_magnetometer(np.stack([20.0 + door, 5.0 - door, -40.0 + door], axis=1)))
    assert set(found.axes) == {"accelerometer", "gyroscope"}
    assert any("magnetometer" in note and "left out" in note for note in found.notes)


def test_the_grid_of_uneven_stamps():
    rng = np.random.default_rng(0)
    time = 3.0 + np.arange(1000) / 99.7 + 1e-4 * rng.standard_normal(1000)
    keep = np.sort(rng.choice(1000, 950, replace=False))
    keep = np.unique(np.concatenate([[0], keep, [999]]))
    values, rate, *_ = evenly_sampled(Signal(time[keep], np.arange(1000.0)[keep, None] * np.ones(3), "rad/s"))
    assert rate == pytest.approx(99.7, rel=1e-4) and values.shape == (3, 1000)
    np.testing.assert_array_equal(values[0][keep], keep)
    assert np.isnan(values[0]).sum() == 1000 - len(keep)


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: analyse_noise([]), InputError, "no recording"),
        (lambda: analyse_noise(at_rest(1.0)), NotPossibleError, "too few to identify noise"),
        (
            lambda: analyse_noise(simulate(draw_imu(1), HandHeld(12, 5.0), NOISE, seed=1)[0]),
            NotPossibleError,
            "did not rest: .* seconds scatter",
        ),
        (lambda: analyse_noise(at_rest(60.0, artefacts=[Jitter(0.004)])), InputError, "sampled unevenly"),
        (lambda: analyse_noise(replace(at_rest(60.0), accelerometer=CONSTANT)), InputError, "Nothing was measured"),
    ],
)
def test_what_tells_no_noise_is_refused(make, error, words):
    with pytest.raises(error, match=words):
        make()


def test_a_gyroscope_that_measured_nothing_is_left_out_of_the_analysis():
    found = analyse_noise(replace(at_rest(60.0), gyroscope=CONSTANT))
    assert set(found.axes) == {"accelerometer"}
    assert any("Nothing was measured" in note for note in found.notes)


def test_statuses_of_the_command(tmp_path, capsys):
    write_recording(at_rest(1.0), tmp_path / "short.csv")
    assert main(["allan", str(tmp_path / "short.csv"), "-o", str(tmp_path / "out")]) == 1
    assert "too few" in capsys.readouterr().err
    assert main(["allan", str(tmp_path / "none.csv")]) == 2
    assert not (tmp_path / "out").exists()
    capsys.readouterr()


def test_measured_runs_give_table_report_and_yaml(data_folder, tmp_path, capsys):
    logs = [str(data_folder / "adis16405_static" / f"run{run}.parquet") for run in (1, 2)]
    assert main(["allan", *logs, "-o", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert max(map(len, printed.splitlines())) <= 100 and "resolve averages up to" in printed
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert "run1.parquet, run2.parquet" in page.text and "2.78 h" in page.text
    numbers = dict(re.findall(r"^(\w+): ([-+.e0-9]+)  #", (tmp_path / "imu.yaml").read_text(), re.MULTILINE))
    # the data sheet's typical 2.0 °/√h and 0.2 m/s/√h
    assert 0.7 < float(numbers["gyroscope_noise_density"]) / (np.radians(2.0) / 60) < 1.5
    assert 0.7 < float(numbers["accelerometer_noise_density"]) / (0.2 / 60) < 1.5
    assert float(numbers["update_rate"]) == 100 and len(numbers) == 5


def test_measured_runs_agree_and_are_said_to_be_more_than_five_terms(data_folder, capsys):
    """ADIS16405, data sheet: 2.0 °/√h and 0.2 m/s/√h typical."""
    found = []
    for run in (1, 2):
        assert main(["allan", str(data_folder / "adis16405_static" / f"run{run}.parquet"), "--json"]) == 0
        found.append(json.loads(capsys.readouterr().out))
    for name, typical in (("gyroscope", np.radians(2.0) / 60), ("accelerometer", 0.2 / 60)):
        for one, two in zip(found[0][name], found[1][name], strict=True):
            a, b = one["terms"]["N"], two["terms"]["N"]
            assert a["low"] <= b["high"] and b["low"] <= a["high"]
            assert 0.7 < a["value"] / typical < 1.5
    assert any("no combination of the five terms" in note for note in found[0]["notes"])
