"""Every mistake that samples show is known to every verb, in the same words."""

import json
from dataclasses import replace

import pytest
from test_mistakes import GRAVITY, planted, unit

import jaximu
from jaximu.calibration import calibrate_by_filter, calibrate_turntable
from jaximu.cli import main
from jaximu.diagnosis import diagnose_turntable
from jaximu.fleets import Settings, find_jobs, rows_of
from jaximu.mistakes import prepare
from jaximu.noise.analysis import analyse_noise
from jaximu.recordings import write_recording
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import Positions, Static

MISTAKES = ("zero_rows", "spikes", "clipped", "held")
SEED, RATE = 4, 50.0


def texts(recording) -> list[str]:
    """What is said of a recording by the one door: at least one finding, each a sentence."""
    findings = [finding.text for finding in prepare(recording).findings]
    assert findings
    return findings


@pytest.fixture(scope="module")
def flawed(tmp_path_factory):
    """A folder of logs by hand, each with one mistake, and the recordings by name."""
    folder = tmp_path_factory.mktemp("mistakes")
    recordings = {name: planted(name, SEED, RATE).log.to_recording() for name in MISTAKES}
    for name, recording in recordings.items():
        write_recording(recording, folder / f"{name}.parquet")
    return folder, recordings


@pytest.fixture(scope="module")
def calibration():
    """An older calibration of the unit, by a log without a mistake."""
    return jaximu.calibrate(unit(SEED, RATE)[0], GRAVITY)


def of_calibrate(recording, calibration):
    return jaximu.calibrate(recording, GRAVITY).notes


def of_diagnose(recording, calibration):
    return [finding.text for finding in jaximu.diagnose(recording, GRAVITY, candidates=[]).preflight]


def of_check(recording, calibration):
    return jaximu.check(calibration, recording, GRAVITY).notes


def of_filter(recording, calibration):
    return calibrate_by_filter(recording, GRAVITY)[0].notes


BY_HAND = [(verb, name) for verb in (of_calibrate, of_diagnose, of_check) for name in MISTAKES]


@pytest.mark.parametrize(("verb", "name"), [*BY_HAND, (of_filter, "zero_rows"), (of_filter, "clipped")])
def test_by_hand(verb, name, flawed, calibration):
    recording = flawed[1][name]
    try:
        said = " ".join(verb(recording, calibration))
    except jaximu.NotPossibleError as refusal:  # what stands in the way is named first
        said = str(refusal)
        assert texts(recording)[0] in said
        return
    assert [text for text in texts(recording) if text not in said] == []


def test_in_a_fleet(flawed):
    folder, recordings = flawed
    for row in rows_of(find_jobs([folder]), Settings(gravity=GRAVITY)):
        said = " ".join([*(row["notes"] or ()), row["message"] or ""])
        assert [text for text in texts(recordings[row["device"]]) if text not in said] == []


@pytest.mark.parametrize("name", MISTAKES)
def test_in_what_a_log_is_good_for(name, flawed, capsys):
    folder, recordings = flawed
    assert main(["info", str(folder / f"{name}.parquet"), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)["findings"]
    assert [text for text in texts(recordings[name]) if text not in shown] == []


def spoiled(recording, change):
    """Return a recording of which a mistake changed some of the gyroscope's samples."""
    values = recording.gyroscope.values.copy()
    change(values)
    return replace(recording, gyroscope=replace(recording.gyroscope, values=values))


def zero_rows(values):
    values[1000:1003] = 0.0


def spikes(values):
    values[[700, 1500, 2300]] += 5.0


@pytest.mark.parametrize("change", [zero_rows, spikes])
def test_on_a_table_and_at_rest(change):
    log, truth = simulate(draw_imu(4), Positions(12, 4.0, 2.0), consumer_noise(), rate=50.0, seed=4)
    table, rest = (
        spoiled(recording, change)
        for recording in (log, simulate(draw_imu(4), Static(240.0), consumer_noise(), rate=50.0, seed=4)[0])
    )
    verbs = {
        "turntable": lambda: calibrate_turntable(table, truth.schedule).notes,
        "diagnose": lambda: [f.text for f in diagnose_turntable(table, truth.schedule).preflight],
    }
    for verb, notes in verbs.items():
        said = " ".join(notes())
        assert [text for text in texts(table) if text not in said] == [], verb
    said = " ".join(analyse_noise([rest]).notes)
    assert [text for text in texts(rest) if text not in said] == []
