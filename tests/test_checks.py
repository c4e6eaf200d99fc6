"""Checks of what errors depend on: their law where nothing does, and a hidden dependence found by its own check."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
import synthetic

from jaximu import LocalGravity, calibrate
from jaximu.data.by_hand import RecordedByHand
from jaximu.diagnosis.checks import checks_of
from jaximu.diagnosis.evidence import Evidence
from jaximu.diagnosis.experiment import Experiment
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.recordings.recording import Recording
from jaximu.recordings.segmentation import observed_poses

NOISE = NoiseModel(AxisNoise.of_white(np.full(3, 2e-6)), AxisNoise.of_white(np.full(3, 1e-8)))
GRAVITY = LocalGravity(synthetic.GRAVITY, 0.0)


def fitted(recording: Recording):
    calibration = calibrate(recording, GRAVITY, static=NOISE)
    observations = observed_poses(calibration.segmentations, GRAVITY.value, noise=NOISE)
    experiment = Experiment(RecordedByHand(calibration.segmentations, observations), calibration.imu)
    return experiment.fit(), experiment


@pytest.fixture(scope="module")
def problem():
    recording, rests = synthetic.recording(4, poses=24, imu=synthetic.unit(3))
    return recording, rests, *fitted(recording)


def dependences(state, experiment):
    found = {check.name: check for check in checks_of(state, experiment) if " against " in check.name}
    del found["odd against even poses"]
    return found


def test_law_where_nothing_depends(problem):
    """Draws of pure noise in the linear problem: every p-value is uniform."""
    _, _, state, experiment = problem
    random = np.random.default_rng(2)
    found: dict[str, list[float]] = {}
    plain = [block for block in state.evidence.blocks if block.kind == "generic"]
    curves = {block.name for block in state.evidence.blocks if block.curved == "angular_rate"}
    assert {"gyro.quadratic", "gyro.asymmetry"} <= curves and not curves & {"gyro.scale_step", "gyro.bias_ramp"}
    for _ in range(200):
        drawn = random.standard_normal(len(state.evidence.residual))
        evidence = Evidence(drawn, state.evidence.jacobian, plain)
        for name, check in dependences(replace(state, evidence=evidence), experiment).items():
            found.setdefault(name, []).append(check.p_value)
    names = {"gravity norm at rest against time", "rate at rest against specific force z",
             "gravity direction over turns against angle", "gravity direction over turns against rate"}  # fmt: skip
    assert names <= set(found)
    for values in found.values():
        assert scipy.stats.kstest(values, "uniform").pvalue > 1e-3 / len(found)


def test_statistic_is_the_difference_of_two_fits(problem):
    """Least squares with and without the norms' polynomials of time, written out."""
    _, _, state, experiment = problem
    poses = experiment.data.observations.poses
    real = np.asarray(poses.mask)
    time = (np.asarray(poses.start) + np.asarray(poses.stop))[real] / 2
    rows = experiment.real.kind == 0
    extra = np.zeros((len(rows), 3))
    x = 2 * (time - time.min()) / np.ptp(time) - 1
    extra[rows] = np.stack([x, 3 * x**2 - 1, 5 * x**3 - 3 * x], axis=1)
    squares = []
    for columns in ([], [state.weights @ extra]):
        matrix = np.concatenate([state.evidence.jacobian, *columns], axis=1)
        matrix = matrix / np.linalg.norm(matrix, axis=0)
        rest = state.evidence.residual - matrix @ np.linalg.lstsq(matrix, state.evidence.residual, rcond=None)[0]
        squares.append(rest @ rest)
    check = dependences(state, experiment)["gravity norm at rest against time"]
    assert 3 * check.statistic == pytest.approx(squares[0] - squares[1], rel=1e-6)


def test_a_scale_that_grows_with_the_angle_is_seen_against_the_angle(problem):
    recording, rests, _, _ = problem
    signal = recording.gyroscope
    bias = np.median(signal.values[signal.time < rests[0, 1]], axis=0)
    values = np.array(signal.values)
    for start, stop in zip(rests[:-1, 1], rests[1:, 0], strict=True):
        inside = (signal.time >= start) & (signal.time < stop)
        rate = values[inside] - bias
        angle = np.sum(np.linalg.norm(rate, axis=1)) / signal.rate
        values[inside] = bias + rate * (1 + 2e-3 * (angle - 2))
    found = dependences(*fitted(replace(recording, gyroscope=replace(signal, values=values))))
    assert min(found.values(), key=lambda check: check.p_value).name == "gravity direction over turns against angle"
    assert found["gravity direction over turns against angle"].p_value < 1e-10
    assert found["rate at rest against time"].p_value > 1e-3


def test_a_norm_that_drifts_is_seen_against_time(problem):
    recording = problem[0]
    signal = recording.accelerometer
    share = (signal.time / signal.time[-1] - 0.5)[:, None]
    drifting = signal.values * (1 + 5e-3 * share**2)
    found = dependences(*fitted(replace(recording, accelerometer=replace(signal, values=drifting))))
    smallest = min(found.values(), key=lambda check: check.p_value)
    assert smallest.name == "gravity norm at rest against time"
    assert smallest.p_value < 1e-10
    assert found["rate at rest against time"].p_value > 1e-3


def test_what_does_not_vary_is_not_asked(problem):
    _, _, state, experiment = problem
    names = set(dependences(state, experiment))
    assert not any("temperature" in name for name in names)  # none was recorded
    assert "gravity direction over turns against time" in names


def test_odd_poses_are_predicted_from_even_ones(problem):
    """The statistic is the error of a prediction by least squares, written out, where the halves share no noise."""
    _, _, state, experiment = problem
    root = np.linalg.inv(state.weights)
    covariance, jacobian = root @ root.T, root @ state.evidence.jacobian
    first, kinds = experiment.real.first, experiment.real.kind
    alone = first == experiment.real.last
    parity = np.zeros(len(kinds), int)
    for kind in np.unique(kinds[alone]):
        rows = alone & (kinds == kind)
        parity[rows] = np.unique(first[rows], return_inverse=True)[1] % 2
    even, odd = alone & (parity == 0), alone & (parity == 1)
    apart = np.where(np.equal.outer(parity, parity), covariance, 0.0)
    made = replace(state, weights=np.linalg.inv(np.linalg.cholesky(apart)))
    made = replace(made, evidence=Evidence(state.evidence.residual, made.weights @ jacobian, []))
    (check,) = (c for c in checks_of(made, experiment) if c.name == "odd against even poses")

    seen = np.linalg.svd(jacobian[even], full_matrices=False)
    values = seen.S > 1e-8 * seen.S[0]
    columns = jacobian @ seen.Vh[values].T
    weights = np.linalg.inv(apart[np.ix_(even, even)])
    information = columns[even].T @ weights @ columns[even]
    estimate = np.linalg.solve(information, columns[even].T @ weights @ state.conditions[even])
    error = state.conditions[odd] - columns[odd] @ estimate
    spread = apart[np.ix_(odd, odd)] + columns[odd] @ np.linalg.solve(information, columns[odd].T)
    assert np.linalg.matrix_rank(jacobian[alone], 1e-8 * seen.S[0]) == values.sum()
    assert check.statistic == pytest.approx(error @ np.linalg.solve(spread, error) / odd.sum(), rel=1e-6)
