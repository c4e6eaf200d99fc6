"""What belongs to a unit, a session or the board: simulated boards, drawn estimates, and patterns that do not fit."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom
from simulated_board import PATTERN, board

from jaximu.cli.app import main
from jaximu.diagnosis import COMMON_DRIFT, attribute, places_of
from jaximu.diagnosis.attribution import attributed, split
from jaximu.diagnosis.common_drift import CommonDrift, RestingRates
from jaximu.diagnosis.lines import MOVING_LINE
from jaximu.ground.errors import InputError, NotPossibleError
from jaximu.model.effects import CATALOGUE
from jaximu.recordings import write_recording
from jaximu.report.html import write_report

UNITS, SESSIONS = 4, 3


@pytest.fixture(scope="module")
def attribution():
    """Two units in two sessions; the first feels specific force, and in the second session both warm up together."""
    recordings = board(1, 2, 2, {0: 4e-4}, [1])
    return attribute(recordings, PATTERN, candidates=("gyro.g_sensitivity", "gyro.warm_up"))


def test_a_boards_faults_go_to_their_owners(attribution):
    findings = {finding.name: finding for finding in attribution.findings}
    assert set(findings) == {COMMON_DRIFT, "gyro.g_sensitivity"}
    drift, sensitivity = findings[COMMON_DRIFT], findings["gyro.g_sensitivity"]
    assert (drift.belongs_to, drift.sessions, drift.units) == ("session", ("2",), ("1", "2"))
    assert (sensitivity.belongs_to, sensitivity.units, sensitivity.sessions) == ("unit", ("1",), ("1", "2"))
    assert drift.share > 0.8 and sensitivity.share > 0.8
    assert not attribution.single


def test_a_common_course_is_the_one_that_was_put_in(attribution):
    (drift,) = attribution.common
    truth = np.exp(-drift.times / (0.3 * 68.5))
    assert np.corrcoef(drift.curve, truth)[0, 1] > 0.98
    assert all(np.linalg.norm(loadings) > 1 for loadings in drift.loadings.values())


def test_drift_of_each_axis_alone_is_seldom_common():
    """As a fleet's table asks: means alone, compared with noise that is made as slow as they are."""
    seldom, boards = 0, 60
    for seed in range(boards):
        random = np.random.default_rng([54, seed])
        times = np.arange(24) * 6.0
        units = []
        for unit in range(3):
            up = random.standard_normal((24, 3))
            walk = np.cumsum(random.standard_normal((24, 3)), axis=0)
            means = walk + random.standard_normal((24, 3)) * random.uniform(0, 3)
            units.append(RestingRates.of_means(str(unit), "1", times, up, means, random))
        seldom += CommonDrift.of(units, random).p_value < 0.05
    assert seldom <= binom.ppf(0.999, boards, 0.05)


def test_a_common_course_is_taken_off_before_the_units_are_judged(attribution):
    verdicts = {(part.unit, part.session): part.diagnosis["verdict"] for part in attribution.recordings}
    alone = {(part.unit, part.session): part.alone for part in attribution.recordings}
    assert alone["2", "1"] == verdicts["2", "1"] == "adequate"
    assert alone["2", "2"] != "adequate" and verdicts["2", "2"] == "adequate"
    assert [part.diagnosis["effects"][0]["name"] for part in attribution.recordings if part.unit == "1"] == [
        "gyro.g_sensitivity"
    ] * 2


def test_a_curve_of_one_recording_belongs_to_nothing(attribution):
    parts = list(attribution.recordings)
    (sensitivity,) = parts[0].named
    curve = CATALOGUE["gyro.learned_time"].make(1e-3, low=0.0, high=60.0)
    parts[0] = replace(parts[0], named=(sensitivity, replace(sensitivity, effect=curve)))
    findings, single, _ = attributed(parts, [], 0.05)
    assert [finding.name for finding in findings] == ["gyro.g_sensitivity"]
    assert single == {"gyro.learned_time": ["unit 1 in session 1"]}


def test_an_effect_that_a_unit_has_is_named_where_it_does_not_repeat(attribution):
    parts = list(attribution.recordings)
    parts[1] = replace(parts[1], named=parts[0].named)
    assert attributed(parts, [], 0.05)[1] == {"gyro.g_sensitivity": ["unit 2 in session 1"]}


def test_what_repeats_is_not_denied_and_the_next_command_is_for_an_effect(attribution):
    (effect,) = [finding for finding in attribution.findings if finding.belongs_to == "unit"]
    assert "unit1_session1.csv unit1_session2.csv -o RESULTS` diagnoses all recordings of unit 1" in (
        replace(attribution, findings=(effect,)).suggestion
    )
    line = replace(effect, name=MOVING_LINE, values={"1": [18.9]}, unit="Hz")
    elsewhere = replace(attribution, findings=(line,), single={MOVING_LINE: ["unit 1 in session 1"]})
    assert not elsewhere.suggestion
    (note,) = elsewhere.notes
    assert "beside what repeats" in note and "neither" not in note
    (note,) = replace(elsewhere, findings=()).notes
    assert "repeats neither over sessions nor over units" in note


def test_document_and_page(attribution, tmp_path):
    document = json.loads(attribution.text())
    assert document["schema"] == "jaximu.diagnosis/1" and document["verdict"] == "effects"
    assert [entry["file"] for entry in document["recordings"]] == [part.file for part in attribution.recordings]
    for entry in document["recordings"]:
        assert {"file", "unit", "session", "verdict", "effects", "chi2_heldout"} <= set(entry)
        assert 0.2 < entry["chi2_heldout"] < 2
    for entry in document["attribution"]:
        assert {"name", "belongs_to", "units", "sessions", "share"} <= set(entry)
    assert {effect["name"] for effect in document["effects"]} == {"gyro.g_sensitivity"}
    text = write_report(attribution, tmp_path).read_text(encoding="utf-8")
    assert "belongs to unit 1" in text and "drift together in session 2" in text
    assert (tmp_path / "attribution.png").is_file()


def test_recordings_that_cannot_be_diagnosed_are_skipped_with_their_reason(monkeypatch):
    def refuse(recording, *arguments, **options):
        raise NotPossibleError("record twenty poses or more.")

    monkeypatch.setattr("jaximu.diagnosis.attribution.diagnose", refuse)
    with pytest.raises(NotPossibleError, match=r"0 units in 0 sessions.*record twenty poses or more"):
        attribute(board(1, 2, 2, {}, []), PATTERN)


def drawn(random, values, information=400.0):
    """Estimates of three numbers (units, sessions, 3), whitened, with noise."""
    estimates = []
    for value in np.broadcast_to(values, (UNITS, SESSIONS, 3)).reshape(-1, 3):
        root = np.sqrt(information) * np.tril(random.uniform(0.5, 1.5, (3, 3)))
        estimates.append((root @ value + random.standard_normal(3), root))
    return estimates


LABELS = (
    [str(unit) for unit in range(UNITS) for _ in range(SESSIONS)],
    [str(session) for _ in range(UNITS) for session in range(SESSIONS)],
)


@pytest.mark.parametrize("kind", ["unit", "session", "board"])
def test_estimates_are_split_by_what_they_repeat_over(kind):
    """A vector of a usual size on one unit, on one session, or on all, beside a tenth of it that repeats nowhere."""
    right, there = 0, 0
    for seed in range(40):
        random = np.random.default_rng([seed, 7])
        values = 0.1 * random.standard_normal((UNITS, SESSIONS, 3))
        values[{"unit": np.s_[1], "session": np.s_[:, 1], "board": np.s_[:]}[kind]] += random.standard_normal(3)
        parts = split(drawn(random, values), *LABELS, 0.05).parts
        right += [part.belongs_to for part in parts] == [kind]
        there += bool(parts) and [*parts[0].values] == (["1"] if kind != "board" else [""])
    assert right >= 36 and there >= 36  # of 40: 95 % right passes with 95 % probability


def test_what_repeats_nowhere_belongs_to_nothing():
    false = 0
    for seed in range(100):
        random = np.random.default_rng([seed, 8])
        values = random.standard_normal((UNITS, SESSIONS, 3))
        false += bool(split(drawn(random, values), *LABELS, 0.05).parts)
    assert false <= 10  # at 5 % more than ten have the probability 1 %


def test_the_board_s_part_and_the_units_own_are_told_apart():
    random = np.random.default_rng(9)
    common, apart = random.standard_normal(3), random.standard_normal((UNITS, 1, 3))
    parts = split(drawn(random, 3 * common + apart), *LABELS, 0.05).parts
    assert {part.belongs_to for part in parts} == {"board", "unit"}
    value = next(part for part in parts if part.belongs_to == "board").values[""]
    assert np.linalg.norm(value - 3 * common - apart.mean(axis=(0, 1))) < np.linalg.norm(common)


def test_what_the_others_tell_is_as_well_known_as_it_says():
    """The board's part is told of every recording, the own part of a unit by its other sessions; the rest scatters."""
    squares = []
    for seed in range(60):
        random = np.random.default_rng([seed, 10])
        common, apart = random.standard_normal(3), np.zeros((UNITS, 1, 3))
        apart[1] = random.standard_normal(3)
        values = common + apart + 0.2 * random.standard_normal((UNITS, SESSIONS, 3))
        divided = split(drawn(random, values), *LABELS, 0.05)
        for index in (0, SESSIONS + 1):
            mean, covariance = divided.predicted(index)
            off = values.reshape(-1, 3)[index] - mean
            squares.append(off @ np.linalg.solve(covariance, off))
    assert 0.8 < np.mean(squares) / 3 < 1.3  # 360 squares of normal numbers: 1 ± 0.07, the variances estimated


@pytest.mark.parametrize(
    ("pattern", "files", "places"),
    [
        (PATTERN, ["a/unit1_session1.csv", "a/unit1_session2.csv", "b/unit2_session1.csv"], "11 12 21"),
        ("{unit}/{session}", ["x/A/1.csv", "x/B/1.csv", "x/A/2.csv"], "A1 B1 A2"),
        ("{session}/unit{unit}.parquet", ["1/unit1.parquet", "2/unit2.parquet"], "11 22"),
        ("unit{unit}_day{session}", ["unit1_day1/imu.csv", "unit2_day2/imu.csv"], "11 22"),
    ],
)
def test_patterns_of_names_and_folders(pattern, files, places):
    assert ["".join(place) for place in places_of(files, pattern)] == places.split()


@pytest.mark.parametrize(
    ("pattern", "files", "error", "words"),
    [
        ("unit{unit}", ["unit1.csv"], InputError, "session"),
        ("{unit}{unit}_{session}", ["11_1.csv"], InputError, "once each"),
        ("{unit}_{session}_{day}", ["1_1_1.csv"], InputError, "once each"),
        (PATTERN, ["log1.csv", "log2.csv"], InputError, "log1.csv and 1 more"),
        (PATTERN, ["unit1_session1.csv", "other.csv"], InputError, "other.csv"),
        (PATTERN, ["a/unit1_session1.csv", "b/unit1_session1.csv"], InputError, "both unit 1 in session 1"),
        (PATTERN, ["unit1_session1.csv", "unit1_session2.csv"], NotPossibleError, "1 unit in 2 sessions"),
        (PATTERN, ["unit1_session1.csv", "unit2_session1.csv"], NotPossibleError, "2 units in 1 session"),
    ],
)
def test_patterns_that_do_not_fit_name_the_file(pattern, files, error, words):
    with pytest.raises(error, match=words):
        places_of(files, pattern)


def listing(folder, header, *rows):
    """A list of the logs of two units in two sessions, as a spreadsheet has it."""
    for recording in board(1, 2, 2, {}, [], poses=3):
        write_recording(recording, folder / recording.sources[0].path)
    path = folder / "table.csv"
    path.write_text("\n".join([header, *rows]), encoding="utf-8")
    return str(path)


LISTED = ["1,1,unit1_session1.csv", "1,2,unit1_session2.csv", "B,1,unit2_session1.csv", "B,2,unit2_session2.csv"]


@pytest.mark.parametrize(
    ("header", "rows", "options", "units"),
    [
        ("unit,session,file", LISTED, [], "11BB"),
        ("device,session,file", LISTED, [], "11BB"),
        ("device,lot,file", LISTED, ["--by", PATTERN], "1122"),
    ],
)
def test_a_table_names_the_recordings_of_units_and_sessions(header, rows, options, units, tmp_path, monkeypatch):
    asked = []

    def stand_in(recordings, *, places, **others):
        asked.extend(zip((recording.sources[0].path for recording in recordings), places, strict=True))
        raise NotPossibleError("enough.")

    monkeypatch.setattr("jaximu.diagnosis.attribution.attribute", stand_in)
    monkeypatch.setattr("jaximu.diagnosis.attribute", stand_in, raising=False)
    assert main(["diagnose", listing(tmp_path, header, *rows), *options]) == 1
    assert [unit for _, (unit, _) in asked] == [*units] and [session for _, (_, session) in asked] == [*"1212"]
    assert [path.rpartition("/")[2] for path, _ in asked] == [row.split(",")[2] for row in rows]


@pytest.mark.parametrize(
    ("header", "rows", "options", "status", "words"),
    [
        ("unit,session,file", [*LISTED[:3], "B,,unit2_session2.csv"], [], 2, "has no session"),
        ("unit,session,file", [*LISTED[:3], "B,1,unit2_session2.csv"], [], 2, "both unit B in session 1"),
        ("unit,session,file", LISTED[:2], [], 1, "1 unit in 2 sessions"),
        ("unit,session,file", LISTED, ["--thermal"], 2, "leave --thermal out"),
    ],
)
def test_a_table_that_cannot_be_split_says_why(header, rows, options, status, words, tmp_path, capsys):
    assert main(["diagnose", listing(tmp_path, header, *rows), *options]) == status
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "status", "words"),
    [
        (["--heldout", "x.csv"], 2, "--heldout"),
        (["--thermal"], 2, "--thermal"),
        (["--reference", "x.csv"], 2, "--reference"),
        ([], 2, "does not fit"),
    ],
)
def test_the_command_refuses_in_a_sentence(options, status, words, tmp_path, capsys):
    log = tmp_path / "log.csv"
    log.write_text("time [s]\n0\n", encoding="utf-8")
    assert main(["diagnose", str(log), "--by", PATTERN, *options]) == status
    assert words in capsys.readouterr().err
