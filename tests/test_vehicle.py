"""A vehicle that stops, simulated without the library: intervals against truth, bad logs, and what each verb says."""

import json
from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from test_no_contradiction import sentences
from vehicle import about, drive

from jaximu.calibration import calibrate, calibrate_by_filter, compensate, load_calibration
from jaximu.calibration.vehicle import calibrate_at_stops
from jaximu.cli import main
from jaximu.ground.errors import NotPossibleError
from jaximu.ground.gravity import STANDARD
from jaximu.mistakes import prepare
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.segmentation import find_stops
from jaximu.report.filter import page_of
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld, Static

DRIVES = 100


def recorded(run):
    return Recording(Signal(run.time, run.force, "m/s^2"), Signal(run.time, run.rate, "rad/s"))


def part(run, kept):
    """A drive of some of its samples; its stops are no longer those of the log."""
    return replace(run, time=run.time[kept], force=run.force[kept], rate=run.rate[kept])


def angles(matrix):
    """Yaw, pitch and roll of the rotation from the unit's axes to the vehicle's."""
    return {
        "yaw": np.arctan2(matrix[1, 0], matrix[0, 0]),
        "pitch": -np.arcsin(matrix[2, 0]),
        "roll": np.arctan2(matrix[2, 1], matrix[2, 2]),
    }


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    run = drive(1)
    return run, str(run.save(tmp_path_factory.mktemp("drive") / "drive.csv"))


def test_intervals_hold_the_truth():
    """Of bias, mounting and direction, over drives of units mounted in any way on roads that slope at random."""
    inside = {name: [] for name in ("yaw", "pitch", "roll", "bias", "after", "change")}
    sigmas = {name: [] for name in ("yaw", "roll", "bias")}
    for seed in range(DRIVES):
        rng = np.random.default_rng(seed + 10_000)
        tilt, yaw = rng.uniform(-40, 40, 2), rng.uniform(-180, 180)
        run = drive(seed, int(rng.integers(4, 12)), tilt=tilt, yaw=yaw, bias=rng.normal(0, 0.01, 3))
        calibration, _ = calibrate_at_stops(find_stops(recorded(run)), STANDARD)
        vehicle = calibration.filter["vehicle"]
        for name, true in angles(run.mounting.T).items():
            error = (vehicle[name]["value"] - true + np.pi) % (2 * np.pi) - np.pi
            inside[name].append(abs(error) < 1.96 * vehicle[name]["sigma"])
        off = np.abs(np.asarray(calibration.imu.gyroscope.bias) - run.bias[0])
        sigma = calibration.bias_sigma_recording["gyroscope"]
        inside["bias"] += (off < 1.96 * sigma).tolist()
        inside["after"] += (off < 1.96 * calibration.sigma("gyroscope")[1]).tolist()
        change = vehicle["bias_change"]
        inside["change"] += (np.abs(change["value"]) < 1.96 * np.array(change["sigma"])).tolist()
        for name, value in (("yaw", vehicle["yaw"]["sigma"]), ("roll", vehicle["roll"]["sigma"]), ("bias", sigma[0])):
            sigmas[name].append(np.degrees(value))
    for name, held in inside.items():
        assert np.sum(held) >= scipy.stats.binom.ppf(1e-3, len(held), 0.95), (name, np.mean(held))
    assert np.median(sigmas["roll"]) < 0.5 and np.median(sigmas["yaw"]) < 0.5 and np.median(sigmas["bias"]) < 0.003


def test_slopes_widen_the_mounting_alone():
    level, hilly = (calibrate_at_stops(find_stops(recorded(drive(5, slope=slope))), STANDARD)[0] for slope in (0, 0.05))
    flat, steep = level.filter["vehicle"], hilly.filter["vehicle"]
    assert flat["slope"] < 1e-3 < 0.02 < steep["slope"]
    assert steep["roll"]["sigma"] > 20 * flat["roll"]["sigma"]
    assert hilly.sigma("gyroscope")[1][0] < 1.5 * level.sigma("gyroscope")[1][0]


def test_the_latitude_takes_the_vertical_part_of_the_earths_rotation_off():
    run = drive(6, stops=20, tilt=(0.0, 0.0), noise=(0.01, 1e-4), latitude=60.0)
    stops = find_stops(recorded(run))
    without, taken_off = (calibrate_at_stops(stops, replace(STANDARD, latitude=at))[0] for at in (None, 60.0))
    upwards = 7.292115e-5 * np.sin(np.radians(60.0))
    difference = np.asarray(without.imu.gyroscope.bias) - np.asarray(taken_off.imu.gyroscope.bias)
    assert difference == pytest.approx([0, 0, upwards], abs=2e-6)
    assert taken_off.imu.gyroscope.bias[2] == pytest.approx(0.009, abs=1e-5)
    assert taken_off.sigma("gyroscope")[1][2] < 0.5 * without.sigma("gyroscope")[1][2]


def test_a_bias_that_changes_is_said_and_widens_its_use_afterwards():
    steady, warming = (calibrate_at_stops(find_stops(recorded(drive(7, drift=by))), STANDARD)[0] for by in (0, 2e-3))
    change = warming.filter["vehicle"]["bias_change"]
    assert (np.array(change["value"]) > 1e-3).all() and (np.array(change["sigma"]) < 1e-3).all()
    assert (warming.sigma("gyroscope")[1] > 5 * steady.sigma("gyroscope")[1]).all()


def test_stated_noise_is_used():
    stops = find_stops(recorded(drive(8)))
    loud = NoiseModel(AxisNoise.of_white(1e-6), AxisNoise.of_white(1e-4))
    widened = calibrate_at_stops(stops, STANDARD, loud)[0].sigma("gyroscope")[1]
    assert widened == pytest.approx(np.sqrt(1e-4 / np.sum(np.diff(stops.intervals))), rel=0.1)


def test_reversing_does_not_turn_the_vehicle_round():
    run = drive(11, stops=10, reverse=2)
    vehicle = calibrate_at_stops(find_stops(recorded(run)), STANDARD)[0].filter["vehicle"]
    assert min(speed["along"] for speed in vehicle["speeds"]) < -1.0
    assert np.degrees(vehicle["yaw"]["value"]) == pytest.approx(25.0, abs=3.0) and vehicle["forward_share"] < 1.0


def test_a_direction_that_is_not_shown_is_null():
    """Rests of one orientation between which something else than driving happens: a unit that is knocked about."""
    run = drive(12)
    rng, moving = np.random.default_rng(0), np.ones(len(run.time), bool)
    for start, stop in run.stops:
        moving &= (run.time < start) | (run.time > stop)
    force = np.where(moving[:, None], [0.0, 0.0, 9.81] + rng.normal(0, 2.0, run.force.shape), run.force @ run.mounting)
    summary = calibrate_at_stops(find_stops(recorded(replace(run, force=force))), STANDARD)[0].filter
    assert summary["vehicle"]["yaw"] is None and summary["vehicle"]["forward"] is None
    assert any("Direction of driving" in text for text in summary["open"])


@pytest.mark.parametrize("idle", [5.0, 20.0])
def test_an_engine_that_shakes_the_unit_at_stops(idle):
    run = drive(3, idle=idle)
    stops = find_stops(recorded(run)).intervals
    assert len(stops) == len(run.stops)
    assert (stops[:, 0] > run.stops[:, 0] - 0.3).all() and (stops[:, 1] < run.stops[:, 1] + 0.3).all()


def test_a_unit_upside_down():
    run = drive(5, tilt=(178.0, 3.0))
    vehicle = calibrate_at_stops(find_stops(recorded(run)), STANDARD)[0].filter["vehicle"]
    for name, true in angles(run.mounting.T).items():
        assert np.degrees(vehicle[name]["value"]) == pytest.approx(np.degrees(true), abs=1.5), name
    up, ahead = np.array(vehicle["up"]), np.array(vehicle["forward"])
    assert (
        np.degrees(np.arccos(up @ run.mounting[:, 2])) < 1.5 and np.degrees(np.arccos(ahead @ run.mounting[:, 0])) < 2
    )


@pytest.mark.parametrize("lengths", [(1.0, 1.2), None])
def test_a_drive_without_stops_is_refused(lengths):
    run = drive(3, stops=3, cruise=(100.0, 120.0)) if lengths is None else drive(3, lengths=lengths)
    if lengths is None:
        first, second = run.stops[:2]
        run = part(run, (run.time > first[1] + 3) & (run.time < second[0] - 3))
    with pytest.raises(NotPossibleError, match=r"no stop was found.*Record a drive with stops"):
        calibrate_by_filter(recorded(run))


def test_one_stop_has_a_bias_and_no_interval_of_the_mounting():
    run = drive(9, stops=2)
    calibration, history = calibrate_by_filter(recorded(part(run, run.time < run.stops[0, 1] + 15)))
    summary = calibration.filter
    vehicle = summary["vehicle"]
    assert len(history.time) == 1 and summary["nis"] is None and vehicle["bias_change"]["value"] is None
    assert vehicle["roll"]["sigma"] is None and vehicle["slope"] is None
    assert any("one site" in text for text in summary["open"])
    assert json.loads(calibration.text())["filter"]["vehicle"]["yaw"] is None


@pytest.mark.parametrize("protocol", [HandHeld(14, 2.0, 1.0), Static(60.0)])
def test_other_recordings_are_no_vehicles(protocol):
    recording, _ = simulate(draw_imu(3), protocol, consumer_noise(), rate=50.0, seed=3)
    assert find_stops(recording) is None


def test_what_a_vehicle_does_not_determine_is_refused(log):
    run, _ = log
    with pytest.raises(NotPossibleError, match="leave effects= and magnetometer= out"):
        calibrate_by_filter(recorded(run), effects=["gyro.g_sensitivity"])


def test_the_command(log, tmp_path, capsys):
    run, path = log
    assert main(["filter", path, "--latitude", "48", "-o", str(tmp_path)]) == 0
    text = " ".join(capsys.readouterr().out.split())
    for words in (
        "stood still at 8 stops",
        "Roll 3",
        "Yaw 25",
        "sloped by",
        "What stays open",
        "not determined: as the",
    ):
        assert words in text, words
    assert "vertical part was taken off" in text
    calibration = load_calibration(tmp_path / "calibration.json")
    document = json.loads((tmp_path / "calibration.json").read_text())
    assert document["accelerometer"] is None and len(document["filter"]["vehicle"]["stops"]) == 8
    assert calibration.from_data_sheet == ("gyroscope gain",)
    corrected = compensate(calibration, recorded(run))
    first, last = run.stops[2] + [1, -1]
    still = (run.time > first) & (run.time < last)
    assert np.abs(corrected.gyroscope.values[still].mean(axis=0)).max() < 2e-4
    assert np.array_equal(corrected.accelerometer.values, run.force)


def test_other_verbs_lead_to_it(log, capsys):
    _, path = log
    assert main(["info", path, "--json"]) == 0
    uses = {use["verb"]: use["why"] for use in json.loads(capsys.readouterr().out)["uses"]}
    assert "8 stops" in uses["filter"] and "calibrate" not in uses
    assert main([path, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["verbs"] == ["filter"] and "8 stops" in document["verdict"] and not document["refused"]


@pytest.mark.parametrize(
    ("tilt", "words"),
    [((179.0, 0.0), "z axis points down"), ((3.0, -2.0), "z axis points up"), ((0.0, -88.0), "x axis points up"),
     ((-89.0, 0.0), "y axis points down")],
)  # fmt: skip
def test_which_axis_points_up_is_said_in_words_for_any_axes(tilt, words):
    """A level unit in forward, right, down axes is rolled by half a turn: its z axis points down."""
    run = drive(3, 4, lengths=(5.0, 8.0), tilt=tilt)
    assert (run.mounting @ [0.0, 0.0, 1.0])["xyz".index(words[0])] * (1 if words.endswith("up") else -1) > 0.9
    calibration, history = calibrate_by_filter(recorded(run))
    assert any(text.startswith(f"The unit's {words}.") for text in sentences(page_of(calibration, history)))


@pytest.mark.parametrize("verb", ["calibrate", "diagnose"])
def test_verbs_by_poses_name_the_filter_where_they_refuse_a_drive(log, tmp_path, capsys, verb):
    _, path = log
    assert main([verb, path, "-o", str(tmp_path)]) == 1
    assert "in the air, with 8 stops: `jaximu filter LOG`" in capsys.readouterr().err
    with pytest.raises(NotPossibleError, match=r"one orientation throughout[^`]*$"):
        calibrate(simulate(draw_imu(1), Static(60.0), consumer_noise(), seed=1)[0])


def test_the_simulated_mounting_is_the_one_that_is_asked_for():
    run = drive(2, tilt=(10.0, -20.0), yaw=30.0)
    assert run.mounting.T == pytest.approx(
        about(2, np.radians(30.0)) @ about(1, np.radians(-20.0)) @ about(0, np.radians(10.0))
    )


@pytest.mark.parametrize("seed", [45, 52])
def test_vibration_is_no_integer_overflow(seed):
    run = drive(seed, stops=2 + seed % 7, idle=(1.0, 5.0, 20.0)[seed % 3])
    assert not prepare(recorded(run)).findings
