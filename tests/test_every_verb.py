"""Every verb × every kind of measured input × with and without an output folder and --json: no user meets a defect.

All of it, with what each run says: benchmarks/results/verbs.md. What takes long and is of the same kind as a shorter
recording here is `slow`.
"""

import json

import every_verb
import pytest

SLOW = ("diagnose", "plan", "fleet", "thermal", "consequences", "filter")
QUICK = [verb for verb in every_verb.VERBS if not verb.startswith(SLOW)]


@pytest.fixture(scope="module")
def calibration(tmp_path_factory, data_folder):
    folder = tmp_path_factory.mktemp("calibration")
    given = every_verb.INPUTS["MPU-9150 by hand"]
    assert every_verb.run(every_verb.arguments("calibrate", given, data_folder, folder), folder, False).status == 0
    return folder / "calibration.json"


def check(verb, name, calibration, data_folder, folder, as_json):
    line = every_verb.arguments(verb, every_verb.INPUTS[name], data_folder, calibration)
    outcome = every_verb.run(line, folder, as_json)
    assert not outcome.faults, (line, outcome.faults)
    if as_json and outcome.status == 0 and verb != "compensate":
        text = json.dumps(json.loads(outcome.stdout))
        assert "NaN" not in text and "Infinity" not in text
    return outcome


LONG = {
    "ADIS16405 at rest for hours": "MPU-6050 unmoved",
    "PSINS, 19 positions": "PSINS, vehicle",
    "BROAD, optical attitude": "EuRoC flight",
    "MIMU4444, counts": "MPU-6050 by hand, counts",
    "imu_tk's Xsens, counts, two files": "MPU-6050 by hand, counts",
}
"""Recordings that take long, and a shorter one of the same kind."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in LONG else ()) for name in every_verb.INPUTS]
)
def test_every_quick_verb(name, calibration, data_folder, tmp_path):
    for place, verb in enumerate(QUICK):
        check(verb, name, calibration, data_folder, tmp_path / "out", as_json=place % 2 == 0)


@pytest.mark.parametrize("name", [
    pytest.param("ADIS16405 at rest for hours", marks=pytest.mark.slow),
    pytest.param("BROAD, optical attitude", marks=pytest.mark.slow),
    "EuRoC flight", "PX4 log", "MPU-6050 unmoved", "HMC5883L alone", "a page of text",
])  # fmt: skip
@pytest.mark.parametrize("verb", ["diagnose", "diagnose --thermal", "diagnose --reference", "plan", "thermal", "fleet"])
def test_what_a_slow_verb_refuses(verb, name, calibration, data_folder, tmp_path):
    outcome = check(verb, name, calibration, data_folder, tmp_path / "out", as_json=False)
    assert outcome.status in (1, 2) or verb == "fleet", outcome.short


@pytest.mark.parametrize("name", ["EuRoC flight", "HMC5883L alone", "wrist accelerometer", "a page of text"])
def test_what_is_no_path_for_consequences(name, calibration, data_folder, tmp_path):
    outcome = check("consequences", name, calibration, data_folder, tmp_path / "out", as_json=False)
    assert outcome.status in (1, 2) and not outcome.written, outcome.short


@pytest.mark.parametrize("name", ["MPU-6050 unmoved", "HMC5883L alone", "a page of text"])
def test_what_a_filter_refuses(name, calibration, data_folder, tmp_path):
    outcome = check("filter --online", name, calibration, data_folder, tmp_path / "out", as_json=False)
    assert outcome.status in (1, 2) and not outcome.written, outcome.short


def test_a_filter_follows_the_unit_that_was_calibrated(calibration, data_folder, tmp_path):
    outcome = check("filter --online", "MPU-9150 by hand", calibration, data_folder, tmp_path / "out", as_json=True)
    assert outcome.status == 0 and "calibration.json" in outcome.written


def test_a_flight_is_no_recording_at_rest(calibration, data_folder, tmp_path):
    outcome = check("allan", "EuRoC flight", calibration, data_folder, tmp_path / "out", as_json=False)
    assert outcome.status == 1 and "did not rest" in outcome.stderr
