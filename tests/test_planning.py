"""Planning: the information against the real problem, optima against theory, predictions against estimates."""

import json
import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import rq
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from whitened_by_hand import gravity_direction, static_gyroscope

from jaximu import InputError, LocalGravity
from jaximu.calibration import fit_hand_held
from jaximu.cli import main
from jaximu.data.gravity_norm import gravity_norm
from jaximu.data.poses_covariance import condition_covariance
from jaximu.estimation.covariance import inverse_cholesky
from jaximu.estimation.problem import Name, Parameters, flatten, names_of, without_equipment
from jaximu.model.effects import CATALOGUE
from jaximu.model.sensor import Imu
from jaximu.planning import EQUIPMENT, Accuracy, Design, Known, hand_held_information, propose, table_information
from jaximu.planning.optimisation import Step, covariance, objective, score
from jaximu.planning.plan import _frame, _gravity_known, _in_hand_frame, question_of
from jaximu.planning.poses import attitude_words, pose_words, round_attitude, round_direction, short_order, up_of
from jaximu.recordings.observations import Observations, Poses, Turns
from jaximu.simulation import draw_imu
from jaximu.simulation.protocols.course import attitude_of
from jaximu.simulation.protocols.positions import directions

G = 9.80665
EXACT = LocalGravity(G, 0.0)
POSES = 12
SAMPLES = 16
HANDS, TABLE = EQUIPMENT["hands"], EQUIPMENT["table"]
SIGMA_A, SIGMA_G, DENSITY = 5e-4, 5e-5, 1e-8  # of pose means (m/s², rad/s), of rates ((rad/s)² s)
ACCURACY = Accuracy(
    SIGMA_A**2 * np.eye(3), SIGMA_G**2 * np.eye(3), DENSITY * np.eye(3), np.array([0.5, 2.0, 1.0]), np.asarray(1.5)
)


def known(imu=None, **values) -> Known:
    return Known(Imu.nominal() if imu is None else imu, gravity=EXACT, **values)


def observed(imu, quaternions, rng=None, turn=1.5, samples=SAMPLES):
    """Observations written out in NumPy: the shortest rotation between attitudes, equal samples."""
    attitudes = Rotation.from_quat(quaternions, scalar_first=True)
    count = len(quaternions)
    gain_a, bias_a = np.asarray(imu.accelerometer.gain), np.asarray(imu.accelerometer.bias)
    gain_g, bias_g = np.asarray(imu.gyroscope.gain), np.asarray(imu.gyroscope.bias)
    up = attitudes.inv().apply([0.0, 0.0, 1.0])
    vectors = (attitudes[:-1].inv() * attitudes[1:]).as_rotvec()
    rates = np.repeat(vectors[:, None] / turn, samples, axis=1)
    noise = (lambda shape, sigma: 0.0) if rng is None else (lambda shape, sigma: sigma * rng.standard_normal(shape))
    return Observations(
        Poses(
            G * up @ gain_a.T + bias_a + noise((count, 3), SIGMA_A), np.tile(SIGMA_A**2 * np.eye(3), (count, 1, 1)),
            np.tile(bias_g, (count, 1)) + noise((count, 3), SIGMA_G), np.tile(SIGMA_G**2 * np.eye(3), (count, 1, 1)),
            np.zeros(count), np.ones(count), np.full(count, 25.0), np.ones(count, bool),
        ),
        Turns(
            rates @ gain_g.T + bias_g + noise(rates.shape, np.sqrt(DENSITY * samples / turn)),
            np.full(rates.shape[:2], turn / samples), DENSITY * np.eye(3),
            np.linalg.svd(up[1:, None, :])[2][:, 1:, :], np.ones(count - 1, bool),
        ),
        np.asarray(G),
    )  # fmt: skip


def attitudes(count, seed):
    found = Rotation.random(count, np.random.default_rng(seed)).as_quat(scalar_first=True)
    for place in range(1, count):
        found[place] *= 1 if found[place] @ found[place - 1] > 0 else -1
    return found


def by_hand(quaternions) -> Design:
    return Design(quaternions, np.zeros((0, 4)), np.zeros(0))


@pytest.fixture(scope="module")
def proposal():
    return propose(known(), HANDS, POSES)


def test_information_by_hand_is_that_of_the_real_problem():
    """Gain, bias and two effects, whose columns the planner takes from the forward model, here from the inverse."""
    plain = draw_imu(3)
    imu = plain.with_effects(*(CATALOGUE[name].dormant() for name in ("accel.quadratic", "gyro.quadratic")))
    parameters = Parameters.select(
        jax.tree.map(np.asarray, imu), lambda name: name.effect is not None or without_equipment(name)
    )
    assert len(parameters.names) == 27
    quaternions = attitudes(5, 1)

    @jax.jit
    def real(observations):
        whole = condition_covariance(plain, observations).dense().total(ACCURACY.excess)
        joint = len(whole) - 3 * len(observations.poses.mask)  # norms and turns
        weights = inverse_cholesky(whole[:joint, :joint])
        rest = inverse_cholesky((1 + ACCURACY.excess[2]) * observations.poses.gyroscope_covariance)

        def residual(z):
            model = parameters.model(imu, z)
            norm = gravity_norm(model, observations, jnp.ones(len(observations.poses.mask)))
            turned = gravity_direction(
                model, observations, None, jnp.tile(jnp.eye(2), (len(observations.turns.mask), 1, 1))
            )
            still = static_gyroscope(model, observations, rest)
            return jnp.concatenate([weights @ jnp.concatenate([norm, turned]), still])

        jacobian = jax.jacfwd(residual)(jnp.zeros(len(parameters.names)))
        return jacobian.T @ jacobian

    # as many samples as the planner takes: what is not linear in the rate is not the same for any number
    expected = np.asarray(real(observed(plain, quaternions, samples=12)))
    found = np.asarray(
        jax.jit(lambda q: hand_held_information(imu, parameters, by_hand(q), ACCURACY, jnp.asarray(G)))(quaternions)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())


def test_information_of_a_table_is_that_of_the_linear_model():
    imu = draw_imu(4)
    parameters = Parameters.select(jax.tree.map(np.asarray, imu), lambda name: True)
    q, axes, rate = attitudes(7, 2), attitudes(5, 3), np.array([1.0, -0.7, 0.3, 1.2, -1.2])
    accuracy = replace(ACCURACY, excess=jnp.zeros(3))
    found = jax.jit(lambda design: table_information(imu, parameters, design, accuracy, jnp.asarray(G)))(
        Design(q, axes, rate)
    )
    size = np.asarray(parameters.size).reshape(2, 12)
    expected = np.zeros((24, 24))
    for offset, rows, sigma in (
        (0, np.c_[G * up_of(q), np.ones(7)], SIGMA_A),
        (12, np.c_[np.zeros((7, 3)), np.ones(7)], SIGMA_G),
        (12, np.c_[rate[:, None] * up_of(axes), np.ones(5)], np.sqrt(DENSITY / 1.5)),
    ):
        for axis in range(3):
            places = [*range(3 * axis, 3 * axis + 3), 9 + axis]
            scaled = rows / sigma * size[offset // 12, places]
            expected[np.ix_(offset + np.array(places), offset + np.array(places))] += scaled.T @ scaled
    np.testing.assert_allclose(np.asarray(found), expected, rtol=1e-9, atol=1e-9 * expected.max())


def test_gradient_is_that_of_finite_differences(proposal):
    question, _ = question_of(known(), HANDS, "D", None)
    design = by_hand(attitudes(POSES, 5))
    rng = np.random.default_rng(6)
    at, along = 0.1 * rng.standard_normal((2, POSES, 3))
    none = np.zeros((0, 3)), np.zeros(0)

    def value(amount):
        return objective(question, design, Step(at + amount * along, *none))[0]

    _, gradient = objective(question, design, Step(at, *none))
    slope = (value(1e-5) - value(-1e-5)) / 2e-5
    assert np.sum(np.asarray(gradient.attitude) * along) == pytest.approx(slope, rel=1e-6)


@pytest.mark.parametrize(("poses", "criterion"), [(6, "D"), (7, "D"), (7, "A")])
def test_a_spherical_design_is_reached_for_the_accelerometer_on_a_table(poses, criterion):
    """K u + b from poses with Σu = 0 and Σuuᵀ = P/3: no other design has a larger determinant, or a smaller trace of
    the inverse: both are convex and do not change with the unit's axes, so that a mean over all rotations is best.
    """
    imu = Imu(Imu.nominal().accelerometer, None)
    found = propose(known(imu), TABLE, poses, criterion)
    noise = 100e-6 * G / np.sqrt(TABLE.rest)
    information = np.array([poses * G**2 / 3 * 0.1**2] * 9 + [poses] * 3) / noise**2 + 1 / 25
    bound = np.exp(-np.log(information).sum() / 24) if criterion == "D" else np.sqrt(np.mean(1 / information))
    assert found.criterion_exact == pytest.approx(bound, rel=1e-6)
    assert found.criterion_after <= bound * 1.002
    if poses == 6:  # the faces of a cube, not some turned version of them
        assert {tuple(np.round(pose.up, 9)) for pose in found.poses} == {tuple(up) for up, _ in directions(6)}
    assert found.turns == () and found.rank == 12 and found.open == ()


def test_the_frame_of_the_laboratory_and_of_the_unit_do_not_matter(proposal):
    question, _ = question_of(known(), HANDS, "D", None)
    start = attitudes(POSES, 7)
    turned = (Rotation.from_euler("z", 1.1) * Rotation.from_quat(start, scalar_first=True)).as_quat(scalar_first=True)
    turned *= np.sign(np.sum(turned * start, axis=1))[0]  # one sign for all, or a turn goes the longer way
    for place in range(1, POSES):
        turned[place] *= 1 if turned[place] @ turned[place - 1] > 0 else -1
    a, b = (covariance(question, by_hand(each)).covariance for each in (start, turned))
    np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9 * np.abs(a).max())

    question, _ = question_of(known(), TABLE, "D", None)
    poses, axes, rate = attitudes(8, 8), attitudes(6, 9), np.radians([90.0, -90, 60, 90, -90, 30])
    tilt = Rotation.from_rotvec([0.4, -1.0, 0.3])
    other = [(Rotation.from_quat(each, scalar_first=True) * tilt).as_quat(scalar_first=True) for each in (poses, axes)]
    a, b = (covariance(question, Design(*each, rate)).covariance for each in ((poses, axes), other))
    assert not np.allclose(a, b, rtol=1e-3)
    assert score(question, a) == pytest.approx(score(question, b), rel=1e-6)


def test_a_plan_by_hand_beats_what_it_is_compared_with(proposal):
    question, _ = question_of(known(), HANDS, "D", None)

    def of(ups, headings):
        found = attitude_of(ups, headings).as_quat(scalar_first=True)
        for place in range(1, len(found)):
            found[place] *= 1 if found[place] @ found[place - 1] > 0 else -1
        return score(question, covariance(question, by_hand(found)).covariance)

    edges, headings = zip(*directions(POSES), strict=True)
    assert proposal.criterion_after < 0.9 * of(np.array(edges), np.array(headings))
    rng = np.random.default_rng(0)
    assert all(
        proposal.criterion_after < of(rng.standard_normal((POSES, 3)), rng.uniform(-3, 3, POSES)) for _ in range(8)
    )
    assert proposal.criterion_after / proposal.criterion_exact < 1.03
    # rounding gains next to nothing, and that by turns a little beyond the limit
    assert proposal.criterion_after > 0.9999 * proposal.criterion_exact
    assert max(turn.angle for turn in proposal.turns) < np.radians(HANDS.turn_limit + 20)
    assert proposal.rank == 21 and not proposal.open


def test_estimates_scatter_as_predicted(proposal):
    """Planned poses, fitted by the estimator: the errors' Mahalanobis lengths are χ² with the predicted covariance."""
    units = 60
    question, _ = question_of(known(), HANDS, "D", None)
    accuracy = replace(
        question.accuracy,
        accelerometer=SIGMA_A**2 * np.eye(3), gyroscope=SIGMA_G**2 * np.eye(3), density=DENSITY * np.eye(3),
    )  # fmt: skip
    quaternions = np.array([pose.attitude for pose in proposal.poses])
    predicted = covariance(replace(question, accuracy=accuracy), by_hand(quaternions)).covariance
    rng = np.random.default_rng(11)
    imus = [draw_imu(seed, 0.01) for seed in range(units)]

    def stack(trees):
        return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *trees)

    fit = fit_hand_held(
        stack([Imu.nominal()] * units), stack([observed(imu, quaternions, rng) for imu in imus]), "joint"
    )
    assert fit.converged.all()
    places = [names_of(imus[0]).index(name) for name in fit.names]
    error = (fit.values - np.stack([flatten(imu) for imu in imus])[:, places]) / np.asarray(question.parameters.size)
    assert fit.names == question.parameters.names
    lengths = np.einsum("ni,ij,nj->n", error, np.linalg.inv(predicted), error)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 21 * units) / (21 * units)
    # gains differ from nominal by up to 1 %, and the estimator weighs by scatter it estimates: some percent
    assert 0.95 * low < lengths.mean() / 21 < 1.1 * high


def test_next_poses_complement_what_is_known():
    """After poses with z up only, what to record next is z down, and one parameter can be asked for."""
    rng = np.random.default_rng(1)
    ups = np.array([[x, y, 1.0] for x in (-0.5, 0, 0.5) for y in (-0.5, 0, 0.5)]) + 0.01 * rng.standard_normal((9, 3))
    imu = Imu(Imu.nominal().accelerometer, None)
    empty = known(imu)
    question, _ = question_of(empty, TABLE, "D", None)
    first = covariance(question, Design(attitude_of(ups).as_quat(scalar_first=True), np.zeros((0, 4)), np.zeros(0)))
    size = np.asarray(question.parameters.size)
    after = replace(
        empty, names=question.parameters.names, covariance=np.asarray(first.covariance) * size[:, None] * size
    )
    found = propose(after, TABLE, 2)
    assert np.sum([pose.up for pose in found.poses], axis=0)[2] < -0.8
    asked = propose(after, TABLE, 2, parameter="accelerometer.gain[2,2]")
    place = asked.names.index("accelerometer.gain[2,2]")
    assert asked.criterion_after == pytest.approx(asked.after[place], rel=1e-9)
    assert asked.after[place] <= found.after[place] * 1.001
    assert (found.after <= found.before).all()


def test_z_is_never_down_on_a_dividing_head_and_rates_keep_to_the_limit():
    found = propose(known(), EQUIPMENT["dividing-head"], 7, turns=5)
    assert min(pose.up[2] for pose in found.poses) > -1e-9
    assert min(turn.axis[2] for turn in found.turns) > -1e-9
    assert max(abs(turn.rate) for turn in found.turns) <= np.radians(30) + 1e-9
    assert found.criterion_after < 1e-3 and found.rank == 24
    for line in found.schedule.splitlines()[1:]:
        start, stop, kind, x, y, z, angle, heading = line.split(",")
        assert float(stop) - float(start) == {"pose": 60, "turn": 9}[kind]
        assert float(x) ** 2 + float(y) ** 2 + float(z) ** 2 == pytest.approx(1, abs=1e-8)
        assert float(heading) == 0 and abs(float(angle)) == (270 if kind == "turn" else 0)


def test_too_few_poses_say_what_stays_open():
    found = propose(known(), TABLE, 2, turns=1)
    assert 0 < found.rank < 24
    assert len(found.open) >= 24 - found.rank
    assert any(not each.determined for each in found.open)


def test_rounded_poses_are_round_and_near():
    rng = np.random.default_rng(2)
    for step in np.radians([5.0, 15.0]):
        for up in rng.standard_normal((200, 3)):
            up /= np.linalg.norm(up)
            found = round_direction(up, step)
            assert np.arccos(np.clip(found @ up, -1, 1)) < 1.6 * step
            axis = np.argmax(np.abs(found) + [0, 1e-9, 2e-9])
            j, k = found[(axis + 1) % 3], found[(axis + 2) % 3]
            angles = np.array([np.arctan2(np.hypot(j, k), abs(found[axis])), np.arctan2(k, j)]) / step
            np.testing.assert_allclose(angles, np.round(angles), atol=1e-6)
            np.testing.assert_allclose(round_direction(found, step), found, atol=1e-9)
    for q in attitudes(50, 4):
        found = round_attitude(q, np.radians(15.0))
        turned = Rotation.from_quat(q, scalar_first=True).inv() * Rotation.from_quat(found, scalar_first=True)
        assert turned.magnitude() < np.radians(40)
        np.testing.assert_allclose(np.abs(round_attitude(found, np.radians(15.0)) @ found), 1, atol=1e-9)


def test_coarser_angles_cost_more():
    fine, coarse = (propose(known(), replace(TABLE, step=step), 7, turns=5) for step in (2.0, 40.0))
    assert coarse.criterion_exact == pytest.approx(fine.criterion_exact, rel=1e-9)
    assert coarse.rounding_loss > 10 * abs(fine.rounding_loss) and abs(fine.rounding_loss) < 1e-3


def decoded(words: str) -> np.ndarray:
    """The body direction that points up, from the words alone."""
    match = re.fullmatch(
        r"on its (top|bottom|[+−][xyz] side) \(([xyz]) (up|down)\)(?:, (.*) lifted by ([\d.]+)°)?", words
    )
    assert match is not None, words
    lies_on, axis, way, lifted, tilt = match.groups()
    below = {"top": "+z", "bottom": "−z"}.get(lies_on, lies_on.removesuffix(" side"))
    assert below == ("−" if way == "up" else "+") + axis  # both say the same

    def along(name: str) -> np.ndarray:
        return (1.0 if name[0] == "+" else -1.0) * np.eye(3)["xyz".index(name[1])]

    if lifted is None:
        return -along(below)
    if edge := re.fullmatch(r"edge ([\d.]+)° from (..) towards (..)", lifted):
        first, second, angle = along(edge[2]), along(edge[3]), np.radians(float(edge[1]))
    elif corner := re.fullmatch(r"(..)/(..) corner", lifted):
        first, second, angle = along(corner[1]), along(corner[2]), np.pi / 4
    else:
        first, second, angle = along(lifted.removesuffix(" side")), np.zeros(3), 0.0
    raised = np.cos(angle) * first + np.sin(angle) * second
    assert np.linalg.norm(raised) == pytest.approx(1) and abs(raised @ along(below)) < 1e-12
    return np.cos(np.radians(float(tilt))) * -along(below) + np.sin(np.radians(float(tilt))) * raised


SIDES = {
    "away from you": 0.0,
    "to your left": 90.0,
    "towards you": 180.0,
    "to your right": -90.0,
}


def decoded_attitude(words: str) -> Rotation:
    """The attitude in the frame of the person, x to the right and y away, from the words alone."""
    lying, pointing = words.split("; ")
    up = decoded(lying)
    match = re.fullmatch(r"\+([xyz]) points (.*?)(?:, ([\d.]+)° to the (left|right))?", pointing)
    assert match is not None, words
    heading = SIDES[match[2]]
    if match[3]:
        towards = {"left": 1, "right": -1}[match[4]] * float(match[3])
        heading = towards if heading == 0 else 180.0 - towards
    level = np.eye(3)["xyz".index(match[1])] - up["xyz".index(match[1])] * up
    ahead = np.array([-np.sin(np.radians(heading)), np.cos(np.radians(heading)), 0.0])
    return Rotation.align_vectors([[0.0, 0, 1], ahead], [up, level / np.linalg.norm(level)], weights=[np.inf, 1])[0]


def test_words():
    assert pose_words(np.array([0, 0, 1.0])) == "on its bottom (z up)"
    assert pose_words(np.array([0, -1.0, 0])) == "on its +y side (y down)"
    half = np.sqrt(0.5)
    assert pose_words(np.array([half / np.sqrt(2), -half / np.sqrt(2), -half - 1e-9])) == (
        "on its top (z down), −y/+x corner lifted by 45°"
    )
    tilted = np.array([np.sin(np.radians(35)), 0, np.cos(np.radians(35))])
    assert pose_words(tilted) == "on its bottom (z up), +x side lifted by 35°"
    # x up, z away: y to the right, since y = z × x
    matrix = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    q = Rotation.from_matrix(matrix).as_quat(scalar_first=True)
    np.testing.assert_allclose(up_of(q), [1, 0, 0], atol=1e-12)
    assert attitude_words(q) == "on its −x side (x up); +y points to your right"


def test_words_are_decoded_to_their_pose():
    rng = np.random.default_rng(12)
    wordings = set()
    for step in np.radians([5.0, 15.0, 45.0]):
        for up in rng.standard_normal((400, 3)):
            up = round_direction(up / np.linalg.norm(up), step)
            words = pose_words(up)
            np.testing.assert_allclose(decoded(words), up, atol=1e-5, err_msg=words)
            wordings.add(words)
    assert all(any(kind in words for words in wordings) for kind in ("side lifted", "corner lifted", "edge"))
    for q in attitudes(300, 13):
        q = round_attitude(q, np.radians(15.0))
        words = attitude_words(q)
        off = decoded_attitude(words).inv() * Rotation.from_quat(q, scalar_first=True)
        assert off.magnitude() < 1e-4, words


def test_short_order_turns_little():
    rng = np.random.default_rng(3)
    up = rng.standard_normal((14, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)

    def length(order):
        return np.arccos(np.clip(np.sum(up[order[1:]] * up[order[:-1]], axis=1), -1, 1)).sum()

    order = short_order(up)
    assert sorted(order) == list(range(14))
    assert length(order) < min(length(rng.permutation(14)) for _ in range(200))


def test_a_tables_covariance_in_the_frame_of_a_calibration_by_hand():
    """Against the frame change carried out: K_a R lower triangular by RQ, its derivative by differences."""
    imu = jax.tree.map(np.asarray, draw_imu(8))
    everything = Parameters.select(imu, lambda name: True)
    lower = Parameters.select(imu, without_equipment)
    rows = [everything.names.index(name) for name in lower.names]

    def moved(theta):
        gain_a, gain_g = theta[:9].reshape(3, 3), theta[12:21].reshape(3, 3)
        triangle, rotation = rq(gain_a[::-1])  # reversed rows and columns: lower in place of upper
        triangle, rotation = triangle[::-1, ::-1], rotation[::-1]
        sign = np.sign(np.diagonal(triangle))
        turn = rotation.T * sign
        return np.concatenate([np.ravel(triangle * sign), theta[9:12], np.ravel(gain_g @ turn), theta[21:]])[rows]

    flat = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(imu)])
    np.testing.assert_allclose(moved(flat), flat[rows], atol=1e-12)
    slope = np.stack([(moved(flat + d) - moved(flat - d)) / 2e-6 for d in 1e-6 * np.eye(24)], axis=1)
    rng = np.random.default_rng(0)
    root = 1e-3 * rng.standard_normal((24, 24))
    expected = slope @ root @ root.T @ slope.T
    found = _in_hand_frame(root @ root.T, everything.names, imu)[np.ix_(rows, rows)]
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-7 * expected.max())
    # and the frame's own directions are those that turning changes nothing but the frame
    assert np.abs(slope @ _frame(imu, everything.names)).max() < 1e-6


def test_gravity_is_taken_off_a_covariance():
    rng = np.random.default_rng(4)
    root = 1e-4 * rng.standard_normal((9, 9))
    reach = np.concatenate([rng.uniform(0.01, 0.02, 6), np.zeros(3)])
    own = root @ root.T
    found = _gravity_known(own + np.outer(reach, reach), reach)
    np.linalg.cholesky(found)
    across = np.linalg.svd(reach[None])[2][1:]
    expected = across @ own @ across.T
    np.testing.assert_allclose(across @ found @ across.T, expected, atol=2e-3 * expected.max())


# --- the command line -------------------------------------------------------------------------------------------------


SPECIFICATION = """
[protocol]
kind = "positions"
[accelerometer]
output_unit = "count"
counts = 2048
noise = { white = "200 ug/sqrt(Hz)", density = "two-sided" }
[effects."gyro.g_sensitivity"]
coefficients = 1e-4
[effects."accel.temperature"]
coefficients = 1e-4
"""


@pytest.fixture
def specification(tmp_path):
    path = tmp_path / "spec.toml"
    path.write_text(SPECIFICATION)
    return str(path)


def test_plan_writes_a_page_and_a_schedule(specification, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["plan", specification, "--equipment", "table", "--poses", "6", "-o", str(out)]) == 0
    printed = capsys.readouterr()
    assert "z up" in printed.out and "not known" in printed.out
    assert sorted(path.name for path in out.iterdir()) == [
        "orientations.png",
        "plan.json",
        "poses.png",
        "report.html",
        "schedule.csv",
    ]
    document = json.loads((out / "plan.json").read_text())
    assert document["schema"] == "jaximu.plan/1"
    assert len(document["poses"]) == len(document["turns"]) == 6
    assert document["parameters"] == len(document["sigma"]) == 33  # nine of g-sensitivity with the 24
    assert document["criterion"]["gain"] > 100
    assert any("accel.temperature" in note for note in document["notes"])
    page = (out / "report.html").read_text()
    assert "gyro.g_sensitivity[8]" in page and ">nan" not in page


def test_a_plan_for_one_parameter_names_it_first(specification, capsys):
    parameter = ("--parameter", "accelerometer.gain[1,0]")
    assert main(["plan", specification, "--equipment", "table", "--poses", "6", *parameter]) == 0
    printed = capsys.readouterr().out
    assert "shrink the uncertainty of the accelerometer misalignment y from x" in printed
    rows = printed.partition("times smaller")[2].splitlines()
    assert rows[2].startswith("accelerometer misalignment y from x")


def refused(capsys, *arguments) -> str:
    assert main(["plan", *arguments]) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and "should not happen" not in printed.err
    return printed.err.splitlines()[-1]


def test_bad_input_is_one_sentence(specification, tmp_path, capsys):
    assert "at least two poses" in refused(capsys, specification, "--poses", "1")
    assert "accelerometer.gain[1,0]" in refused(capsys, specification, "--parameter", "accelerometer.gian[1,0]")
    assert "by hand" in refused(capsys, specification, "--turns", "3")
    assert "not for hands" in refused(capsys, specification, "--fastest", "3")
    assert "greater than zero" in refused(capsys, specification, "--rest", "0")
    assert "states its gravity" in refused(capsys, specification, "--gravity", "9.81")
    assert "cannot be read" in refused(capsys, str(tmp_path / "none.json"))
    strange = tmp_path / "strange.txt"
    strange.write_text("hello, this is\nno log at all: 3\n")
    assert "neither a calibration nor a specification" in refused(capsys, str(strange))
    strange.write_text('{"schema": "jaximu.diagnosis/1"}')
    assert "jaximu.calibration/1" in refused(capsys, str(strange))
    out = tmp_path / "none" / "plan"
    refused(capsys, str(strange), "-o", str(out))
    assert not out.exists() or not list(out.iterdir())


def test_a_covariance_that_is_none_is_refused():
    imu = Imu.nominal()
    names = Name("accelerometer", "gain", (0, 0)), Name("accelerometer", "gain", (1, 1))
    wrong = np.array([[1.0, 2.0], [2.0, 1.0]]) * 1e-6
    with pytest.raises(InputError, match="positive definite"):
        propose(known(imu, names=names, covariance=wrong), TABLE, 6)
    with pytest.raises(InputError, match="criterion"):
        propose(known(imu), TABLE, 6, "E")
