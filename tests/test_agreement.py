"""The comparer of benchmarks/agreement.py: it finds what moved, changed or is missing, and nothing else."""

import copy
import importlib
import json
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

CALIBRATION = {
    "schema": "jaximu.calibration/1",
    "accelerometer": {
        "gain": [[1.01, 0.0, 0.0], [0.002, 0.99, 0.0], [0.001, 0.003, 1.02]],
        "gain_sigma": [[1e-4, 0.0, 0.0], [2e-5, 1e-4, 0.0], [2e-5, 3e-5, 1e-4]],
        "effects": {"accel.asymmetry": {"coefficients": [1e-3, 2e-3, 0.0], "sigma": [1e-5, 1e-5, 1e-5]}},
    },
    "covariance": {"parameters": ["a", "b", "c", "d"], "matrix": [[4e-6, 1e-9, 2e-9, 0.0], [1e-9, 9e-6, 0.0, 0.0],
                                                                [2e-9, 0.0, 1e-6, 5e-7], [0.0, 0.0, 5e-7, 1e-6]]},
    "fit": {"rms": 0.0123, "rank": 21, "notes": ["Noise was measured at rest."]},
    "diagnosis": {"verdict": "effects", "effects": [{"name": "accel.asymmetry", "p_value": 1e-9, "weak": False}]},
    "data": {"file": "/somewhere/log.csv", "sha256": "0123456789abcdef0123456789abcdef"},
    "digest": "fedcba9876543210fedcba9876543210",
}  # fmt: skip
VERBS = (
    "info calibrate diagnose check compensate allan simulate turntable reference array filter magnetometer plan budget "
    "thermal fleet export consequences accept verify"
).split()


@pytest.fixture(scope="module")
def agreement():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
        for name in ("JAX_PLATFORMS", "MPLBACKEND", "OPENBLAS_NUM_THREADS"):
            patch.setenv(name, "")  # the script sets them: put back afterwards
        yield importlib.import_module("agreement")


@pytest.fixture
def compared(agreement):
    """Compare the calibration with a changed one; both go through a file, as records do."""

    def compare(change=lambda document: None, status=0):
        other = copy.deepcopy(CALIBRATION)
        change(other)
        records = [
            {"status": code, "files": ["calibration.json"], "documents": {"printed": agreement.of_document(document)}}
            for code, document in ((status, other), (0, CALIBRATION))
        ]
        return agreement.compared(*json.loads(json.dumps(records)))

    return compare


ABSENT = object()


def changed_at(*path, to=ABSENT, by=None):
    """A change of a document: the value under the keys `path` is set, or multiplied, or taken away."""

    def change(document):
        for key in path[:-1]:
            document = document[key]
        if by is not None:
            document[path[-1]] *= by
        elif to is ABSENT:
            del document[path[-1]]
        else:
            document[path[-1]] = to

    return change


def test_equal_results_agree(compared):
    difference = compared()
    assert not difference.fails and difference.size == 0 and not difference.changed and not difference.new


@pytest.mark.parametrize(("sigmas", "fails"), [(2e-3, True), (5e-4, False), (-2e-3, True)])
def test_a_number_is_compared_in_its_standard_deviations(compared, sigmas, fails):
    moved = compared(changed_at("accelerometer", "gain", 2, 1, to=0.003 + sigmas * 3e-5))
    assert moved.fails == fails
    assert moved.size == pytest.approx(abs(sigmas), rel=1e-3) and moved.where == "printed/accelerometer/gain[2,1]"
    effect = "accelerometer", "effects", "accel.asymmetry", "coefficients"
    assert compared(changed_at(*effect, 2, to=sigmas * 1e-5)).fails == fails


@pytest.mark.parametrize(
    "path",
    [
        ("accelerometer", "gain_sigma", 1, 0),
        ("fit", "rms"),
        ("covariance", "matrix", 1, 1),
        ("diagnosis", "effects", 0, "p_value"),
    ],
)
def test_other_numbers_are_compared_with_themselves(compared, path):
    assert compared(changed_at(*path, by=1.02)).fails
    assert not compared(changed_at(*path, by=1 + 1e-5)).fails


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (changed_at("diagnosis", "verdict", to="adequate"), '"effects" → "adequate"'),
        (changed_at("diagnosis", "effects", 0, "name", to="accel.cubic"), "−accel.asymmetry +accel.cubic"),
        (changed_at("diagnosis", "effects", to=[]), "−accel.asymmetry"),
        (changed_at("diagnosis", "effects", 0, "weak", to=True), "false → true"),
        (changed_at("fit", "rank", to=20), "21"),
        (changed_at("fit", "rms"), "printed/fit/rms is missing"),
        (changed_at("fit", "rms", to=None), "0.0123 → null"),
        (changed_at("covariance", "parameters", 3, to="e"), '"d" → "e"'),
        (changed_at("accelerometer", "effects", "accel.cubic", to={}), "accel.cubic is new"),
    ],
)
def test_what_is_said_otherwise_is_a_change(compared, change, words):
    difference = compared(change)
    assert difference.fails and words in "; ".join(difference.changed)


def test_a_covariance_is_compared_by_its_correlations(compared):
    def correlated(document):
        document["covariance"]["matrix"][2][3] = document["covariance"]["matrix"][3][2] = 6e-7

    assert "correlations" in compared(correlated).where


def test_a_changed_exit_status_is_a_change(compared):
    assert compared(status=1).changed == ["status: 0 → 1"]


def test_new_keys_sentences_paths_and_hashes_make_no_difference(compared):
    def change(document):
        document["reading"] = {"rate": 50.0}
        document["fit"]["notes"] = ["Measured at rest.", "Two sentences."]
        document["data"] |= {"file": "elsewhere.csv", "sha256": "another"}
        document["digest"] = "another"

    difference = compared(change)
    assert not difference.fails and difference.new == ["printed/reading is new"]


def test_a_missing_file_and_a_crash_are_changes(agreement):
    record = {"status": 0, "files": ["a.json", "report.html"], "documents": {}}
    assert agreement.compared(record | {"files": ["a.json"]}, record).fails
    crashed = {"crashed": "KeyError: 'accelerometer'"}
    assert agreement.compared(crashed, record).fails and list(agreement.crashes({"case": crashed}))


def test_samples_of_a_table_are_compared_closely(agreement, tmp_path):
    tables = []
    for shift in (0.0, 1e-9, 1e-3):
        samples = pa.table({"accel_x [m/s^2]": [9.8 + 1e-3 * (row % 7) + shift * (row == 50) for row in range(100)]})
        pq.write_table(samples, tmp_path / "log.parquet")
        tables.append({"status": 0, "documents": {"log.parquet": agreement.of_table(tmp_path / "log.parquet")}})
    assert not agreement.compared(tables[1], tables[0]).fails
    assert agreement.compared(tables[2], tables[0]).fails


def test_the_cases_name_every_verb_and_only_earlier_cases(agreement):
    known, verbs = set(), set()
    for case in agreement.cases():
        assert case.name not in known
        known.add(case.name)
        words = case.arguments({"DATA": Path("data"), "MADE": Path("made"), "OUT": Path("out")})
        verbs.add(words[0])
        assert all(Path(word).parts[1] in known for word in words if word.startswith("out/"))
    assert verbs >= set(VERBS)


def test_a_case_runs_those_whose_files_it_reads_and_records_itself_alone(agreement, monkeypatch, tmp_path):
    run = []

    def recorded(chosen, folder, jobs, save):
        run.extend(case.name for case in chosen)
        save({case.name: {"status": 0} for case in chosen})
        return {case.name: {"status": 0} for case in chosen}

    monkeypatch.setattr(agreement, "recorded", recorded)
    monkeypatch.setattr(agreement, "committed", lambda quick: tmp_path / f"{quick}.json")
    monkeypatch.setattr("sys.argv", ["agreement.py", "--only", "plan thermal", "--write"])
    agreement.write(tmp_path / "False.json", {"plan thermal": {"status": 1}, "plan log": {"status": 2}})
    assert agreement.main() == 0
    assert {"simulate plain", "simulate chamber", "calibrate for thermal"} <= set(run) and "plan log" not in run
    assert run[-2:] == ["thermal with a calibration", "plan thermal"]
    assert agreement.read(tmp_path / "False.json") == {"plan log": {"status": 2}, "plan thermal": {"status": 0}}
    assert not (tmp_path / "True.json").exists()


def test_only_cases_that_are_named_so_are_refused(agreement):
    for quick in (True, False):
        for name, record in agreement.read(agreement.committed(quick)).items():
            assert (record["status"] in (1, 2)) == name.endswith("refused"), name
