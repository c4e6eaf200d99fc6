"""Plans for a robot: predictions against the calibration of recordings that SciPy makes of the planned motion."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from jaximu import InputError, LocalGravity, Recording
from jaximu.calibration import calibrate_against_attitude
from jaximu.cli import main
from jaximu.estimation.problem import flatten, names_of
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.sensor import Imu
from jaximu.planning import EQUIPMENT, Design, Known, propose
from jaximu.planning.optimisation import covariance, score
from jaximu.planning.plan import question_of
from jaximu.recordings.attitude import Attitude
from jaximu.recordings.recording import Signal
from jaximu.report.html import write_report
from jaximu.simulation import ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY, draw_imu
from jaximu.simulation.protocols.course import attitude_of

G = 9.80665
EXACT = LocalGravity(G, 0.0)
ROBOT = EQUIPMENT["robot"]
POSES, RATE, FINE = 8, 100.0, 8
NOISE = NoiseModel(AxisNoise.of_white(ACCELEROMETER_DENSITY**2), AxisNoise.of_white(GYROSCOPE_DENSITY**2))


def known() -> Known:
    return Known(Imu.nominal(), gravity=EXACT)


@pytest.fixture(scope="module")
def proposal():
    return propose(known(), ROBOT, POSES)


def course(time):
    """Share of a turn that is done: its rate rises and falls by half cosines within a fifth each."""
    whole = np.linspace(0, 1, 4001)
    rate = (1 - np.cos(np.pi * np.clip(np.minimum(whole, 1 - whole) / 0.2, 0, 1))) / 2
    done = np.concatenate([[0], np.cumsum(rate[1:] + rate[:-1])])
    return np.interp(time, whole, done / done[-1])


def attitudes(proposal, time) -> Rotation:
    robot, starts = proposal.equipment, np.array([pose.attitude for pose in proposal.poses])
    vectors = np.array([turn.axis * turn.angle for turn in proposal.turns] + [np.zeros(3)])
    place = np.clip((time // (robot.rest + robot.turn)).astype(int), 0, len(starts) - 1)
    done = course((time - place * (robot.rest + robot.turn) - robot.rest) / robot.turn)
    return Rotation.from_quat(starts[place], scalar_first=True) * Rotation.from_rotvec(done[:, None] * vectors[place])


def recorded(proposal, imu, seed) -> tuple[Recording, Attitude]:
    """The planned motion, recorded at 100 Hz, and a robot's report of it: late, askew, tilted and noisy."""
    robot, random = proposal.equipment, np.random.default_rng(seed)
    length = POSES * robot.rest + (POSES - 1) * robot.turn
    count = round(length * RATE)
    edges = np.arange(count * FINE + 1) / (RATE * FINE)
    stood = attitudes(proposal, edges)
    rate = (stood[:-1].inv() * stood[1:]).as_rotvec() * RATE * FINE
    force = attitudes(proposal, (edges[1:] + edges[:-1]) / 2).inv().apply([0.0, 0.0, G])
    signals = []
    for values, triad, density, unit in ((force, imu.accelerometer, ACCELEROMETER_DENSITY, "m/s^2"),
                                         (rate, imu.gyroscope, GYROSCOPE_DENSITY, "rad/s")):  # fmt: skip
        mean = values.reshape(count, FINE, 3).mean(axis=1) @ np.asarray(triad.gain).T + np.asarray(triad.bias)
        noisy = mean + density * np.sqrt(RATE) * random.standard_normal(mean.shape)
        signals.append(Signal((np.arange(count) + 0.5) / RATE, noisy, unit))
    stamps = np.arange(0.2, length - 0.2, length / 760)  # of which every fourth is an interval's end
    said = Rotation.from_rotvec([2e-3, -1e-3, 0.0]) * attitudes(proposal, stamps)
    said = said * Rotation.from_rotvec([0.3, -0.5, 0.2]).inv()
    said = said * Rotation.from_rotvec(np.radians(robot.accuracy) * random.standard_normal((len(stamps), 3)))
    return Recording(*signals), Attitude(stamps + 0.02, said.as_quat(scalar_first=True))


def design_of(proposal) -> Design:
    found = np.array([pose.attitude for pose in proposal.poses])
    for place in range(1, len(found)):  # the sign says which way a turn goes
        step = Rotation.from_rotvec(proposal.turns[place - 1].axis * proposal.turns[place - 1].angle).as_quat(
            scalar_first=True
        )
        reached = Rotation.from_quat(found[place - 1], scalar_first=True) * Rotation.from_quat(step, scalar_first=True)
        long = proposal.turns[place - 1].angle > np.pi
        sign = np.sign(found[place] @ found[place - 1]) * (-1 if long else 1)
        assert (reached.inv() * Rotation.from_quat(found[place], scalar_first=True)).magnitude() < 1e-6
        found[place] *= sign
    return Design(found, np.zeros((0, 4)), np.zeros(0))


@pytest.mark.slow  # benchmarks/results/planning.md: predicted and measured, by hand
def test_errors_are_those_predicted(proposal):
    """χ² of 21 numbers of each unit, their errors as the reference's own calibration leaves them."""
    question, _ = question_of(known(), ROBOT, "D", None, POSES)
    predicted = np.asarray(covariance(question, design_of(proposal)).covariance)
    names, size = question.parameters.names, np.asarray(question.parameters.size)
    np.testing.assert_allclose(np.sqrt(np.diagonal(predicted)) * size, proposal.after, rtol=1e-6)
    units, lengths = 3, []
    for seed in range(units):
        imu = draw_imu(seed, 0.01)
        found, _ = calibrate_against_attitude(*recorded(proposal, imu, seed), EXACT, static=NOISE)
        assert found.reference is not None
        # and not by a turn and a rest, after which the next turn looks alike but for its axis
        assert abs(found.reference["time_offset"]["value"] - 0.02) < 0.01
        truth, value = (dict(zip(names_of(each), flatten(each), strict=True)) for each in (imu, found.imu))
        error = np.array([value[name] - truth[name] for name in names]) / size
        lengths.append(error @ np.linalg.solve(predicted, error))
    low, high = chi2.ppf([1e-3, 1 - 1e-3], 21 * units) / (21 * units)
    # the estimator finds the noise's five parts from these few seconds: its errors are some percent larger
    assert low < np.mean(lengths) / 21 < 1.15 * high


def test_the_plan_keeps_to_the_robot(proposal):
    assert proposal.rank == len(proposal.names) == 21 and not proposal.open
    assert len(proposal.turns) == POSES - 1
    fastest = max(turn.angle / proposal.equipment.turn / 0.8 for turn in proposal.turns)  # the rate of a trapezoid
    assert fastest < 1.02 * np.radians(ROBOT.fastest)
    rows = list(csv.DictReader(proposal.schedule.splitlines()))
    assert [row["kind"] for row in rows] == ["pose", "turn"] * (POSES - 1) + ["pose"]
    here = None
    for row in rows:
        vector = np.array([float(row[axis]) for axis in "xyz"])
        if row["kind"] == "pose":
            stood = attitude_of(vector, np.radians(float(row["heading [deg]"])))
            assert here is None or (here.inv() * stood).magnitude() < 1e-6
            here = stood
        else:
            assert here is not None
            here = here * Rotation.from_rotvec(np.radians(float(row["angle [deg]"])) * vector)
    question, _ = question_of(known(), ROBOT, "D", None, POSES)
    random = np.random.default_rng(0)
    for _ in range(3):  # nearest ways between attitudes at random
        other = Rotation.random(POSES, random).as_quat(scalar_first=True)
        for place in range(1, POSES):
            other[place] *= np.sign(other[place] @ other[place - 1])
        plain = covariance(question, Design(other, np.zeros((0, 4)), np.zeros(0))).covariance
        assert proposal.criterion_after < score(question, plain)


def test_a_better_attitude_and_longer_rests_tell_more(proposal):
    def sigmas(**changes):
        question, _ = question_of(known(), replace(ROBOT, **changes), "D", None, POSES)
        return np.sqrt(np.diagonal(np.asarray(covariance(question, design_of(proposal)).covariance)))

    plain, sharp, slow = sigmas(), sigmas(accuracy=0.005), sigmas(rest=8.0)
    bias = [place for place, name in enumerate(proposal.names) if ".bias" in name]
    assert np.all(sharp < plain) and np.all(slow[bias] < plain[bias])
    gain = [place for place, name in enumerate(proposal.names) if name.startswith("gyroscope.gain")]
    assert np.all(sharp[gain] > 0.1 * plain[gain])  # then the gyroscope's own noise is what is left


def test_page_document_and_refusals(proposal, tmp_path, capsys):
    write_report(proposal, tmp_path / "out")
    document = json.loads(proposal.text())
    assert document["equipment"] == "robot" and document["accuracy"] == {"value": 0.05, "unit": "deg"}
    page = (tmp_path / "out" / "report.html").read_text()
    assert "jaximu reference LOG" in page and "° about (" in page and ">nan" not in page
    path = tmp_path / "unit.toml"
    path.write_text('[protocol]\nkind = "positions"\n')
    for arguments, words in (
        (["--accuracy", "0.1"], "--equipment robot"),
        (["--equipment", "robot", "--accuracy", "0"], "greater than zero"),
        (["--equipment", "robot", "--turns", "3"], "on a robot"),
        (["--equipment", "robot", "--poses", "1"], "at least two poses"),
    ):
        assert main(["plan", str(path), *arguments]) == 2
        assert words in capsys.readouterr().err
    with pytest.raises(InputError, match="has none"):
        propose(Known(Imu(Imu.nominal().accelerometer, None), gravity=EXACT), ROBOT, POSES)
