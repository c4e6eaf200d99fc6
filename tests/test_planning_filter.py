"""Sequences for the filter: predictions against the filter's own runs, the well-known sequence, and what stays open."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from jaximu import InputError, LocalGravity, NotPossibleError
from jaximu.calibration import calibrate_by_filter
from jaximu.cli import main
from jaximu.estimation.problem import flatten, names_of
from jaximu.model import Noise, White
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.sensor import Imu
from jaximu.planning import FILTERED, Filter, Known, propose_sequence
from jaximu.planning.sequences import filter_of
from jaximu.report.html import write_report
from jaximu.simulation import ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY, draw_imu, simulate
from jaximu.simulation.protocols import Rotations
from jaximu.simulation.protocols.course import attitude_of
from jaximu.simulation.protocols.rotations import NINETEEN, rotation_vector

GRAVITY = LocalGravity(9.80665, 1e-3)
TABLE = replace(FILTERED, rest=4.0, turn=4.0)
WHITE = NoiseModel(AxisNoise.of_white(ACCELEROMETER_DENSITY**2), AxisNoise.of_white(GYROSCOPE_DENSITY**2))
DRAWN = {"accelerometer": Noise((White(ACCELEROMETER_DENSITY),), "specific_force"),
         "gyroscope": Noise((White(GYROSCOPE_DENSITY),), "angular_rate")}  # fmt: skip
POSITIONS = 10


def known() -> Known:
    return Known(Imu.nominal(), gravity=GRAVITY)


def words_of(proposal) -> str:
    found = []
    for turn in proposal.turns:
        axis = int(np.argmax(np.abs(turn.axis)))
        found.append(f"{'xyz'[axis]}{np.sign(turn.axis[axis]) * np.degrees(turn.angle):.0f}")
    return " ".join(found)


@pytest.fixture(scope="module")
def proposal():
    return propose_sequence(known(), TABLE, POSITIONS, noise=WHITE)


@pytest.fixture(scope="module")
def asked() -> Filter:
    return filter_of(known(), TABLE, POSITIONS, (), WHITE)[0]


def test_rotations_one_by_one_tell_what_the_whole_sequence_does(asked):
    words, attitude, after = "y90 z180 x-90 y90".split(), attitude_of(np.array([0.0, 0.0, 1.0])), asked.rested()
    for word in words:
        after = asked.rotated(after, attitude, word)
        attitude = attitude * Rotation.from_rotvec(rotation_vector(word))
    one_by_one, whole = (np.sqrt(np.diagonal(asked.numbers(each))) for each in (after, asked.whole(words)))
    np.testing.assert_allclose(one_by_one, whole, rtol=1e-2)


@pytest.mark.slow
def test_errors_of_the_filter_are_those_predicted(proposal, asked):
    """χ² of 21 numbers of each unit that the filter calibrates from the proposed sequence, with noise."""
    kept = [place for place in range(len(asked.names)) if place not in asked.earth]
    words = words_of(proposal)
    predicted = asked.numbers(asked.whole(words.split()))[np.ix_(kept, kept)]
    np.testing.assert_allclose(np.sqrt(np.diagonal(predicted)), proposal.after[kept], rtol=1e-9)
    units, lengths = 3, []
    for seed in range(units):
        imu = draw_imu(seed, 0.01)
        recording, _ = simulate(imu, Rotations(words, TABLE.rest, TABLE.turn), DRAWN, rate=50.0, seed=seed)
        found, _ = calibrate_by_filter(replace(recording, attitude=None), GRAVITY, static=WHITE)
        truth, value = (dict(zip(map(str, names_of(each)), flatten(each), strict=True)) for each in (imu, found.imu))
        error = np.array([value[str(asked.names[k])] - truth[str(asked.names[k])] for k in kept]) / asked.size[kept]
        scaled = predicted / np.outer(asked.size[kept], asked.size[kept])
        lengths.append(error @ np.linalg.solve(scaled, error))
    low, high = chi2.ppf([1e-3, 1 - 1e-3], 21 * units) / (21 * units)
    assert low < np.mean(lengths) / 21 < 1.15 * high


def test_the_sequence_is_better_than_others_as_long(proposal, asked):
    weights = np.zeros(len(asked.names))
    value = np.log(proposal.criterion_after)
    classical = NINETEEN.split()[: POSITIONS - 1]
    assert value < asked.value(asked.whole(classical), "D", weights) - np.log(1.5)
    assert proposal.rank == len(proposal.names) and not proposal.open
    assert len(proposal.poses) == POSITIONS == len(proposal.turns) + 1
    rows = list(csv.DictReader(proposal.schedule.splitlines()))
    here = attitude_of(np.array([0.0, 0.0, 1.0]))
    for row in rows:
        vector = np.array([float(row[axis]) for axis in "xyz"])
        if row["kind"] == "turn":
            here = here * Rotation.from_rotvec(np.radians(float(row["angle [deg]"])) * vector)
        else:
            assert (here.inv() * attitude_of(vector, np.radians(float(row["heading [deg]"])))).magnitude() < 1e-6


def test_what_a_short_sequence_leaves_open_is_said_with_what_opens_it(tmp_path):
    found = propose_sequence(known(), TABLE, 2, noise=WHITE)
    assert found.rank < len(found.names) and found.open
    assert all("What to record" in each.text for each in found.open)
    write_report(found, tmp_path / "out")
    document = json.loads(found.text())
    assert len(document["turns"]) == 1 and document["open"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "jaximu filter LOG" in page and "Rounding" not in page and ">nan" not in page


def test_bad_input(tmp_path, capsys):
    with pytest.raises(InputError, match="at least two positions"):
        propose_sequence(known(), TABLE, 1)
    with pytest.raises(InputError, match="turn= 9"):
        propose_sequence(known(), replace(TABLE, fastest=20.0), 4)
    with pytest.raises(NotPossibleError, match="jaximu thermal"):
        propose_sequence(known(), TABLE, 4, effects=["gyro.temperature"])
    with pytest.raises(InputError, match="has none"):
        propose_sequence(Known(Imu(Imu.nominal().accelerometer, None), gravity=GRAVITY), TABLE, 4)
    with pytest.raises(InputError, match="is not an axis"):
        Rotations("w90")
    with pytest.raises(InputError, match="there is none"):
        Rotations(" ")
    path = tmp_path / "unit.toml"
    path.write_text('[protocol]\nkind = "positions"\n')
    for arguments, words in (
        (["--for", "filter", "--equipment", "robot"], "leave --turns"),
        (["--effect", "accel.quadratic"], "--for filter"),
    ):
        assert main(["plan", str(path), *arguments]) == 2
        assert words in capsys.readouterr().err
